"""The zero moment point from foot forces (paper eqs. 8-9)."""

import numpy as np

# Below this vertical load [N] nobody stands, and there is no ZMP.
_SMALLEST_LOAD = 1.0


def zero_moment_point(force: np.ndarray, position: np.ndarray) -> np.ndarray:
    """ZMP of forces on level ground: the mean of the pads' places weighted with their vertical
    forces.

    That is eq. (8) with the centres of pressure (9) written out. While nothing stands the last ZMP
    is kept.

    Args:
        force: of the ground on each pad, world axes, shape (N, pads, 3) [N].
        position: of each pad in the world, shape (N, pads, 3) [m].

    Returns:
        Shape (N, 2) [m]; zeros if nothing ever stands.
    """
    load = force[:, :, 2]
    total = load.sum(axis=1)
    stands = total > _SMALLEST_LOAD
    if not stands.any():
        return np.zeros((len(force), 2))
    zmp = np.einsum("np,npi->ni", load[stands], position[stands, :, :2]) / total[stands, None]
    # Rows that do not stand take the last row that did; those before the first take the first.
    return zmp[np.maximum(np.cumsum(stands) - 1, 0)]
