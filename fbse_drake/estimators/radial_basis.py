"""Friction by a network of radial basis functions, to be compared with FBSE."""

from dataclasses import dataclass

import numpy as np

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.estimator import in_library
from fbse_drake.estimators.learned import LearnedFriction


@in_library
@dataclass(frozen=True)
class RadialBasisFriction(LearnedFriction):
    """Gaussian functions of the velocity whose weights are adapted (Sanner and Slotine 1992).

    Centres lie evenly on asinh(w / finest), densely where friction changes its sign, from minus to
    plus the fastest velocity; half-way between two of them a function has fallen to
    exp(-1/8) = 0.88. Any continuous law between these velocities is approximated, and no shape is
    assumed: what was not visited is not known, and beyond the fastest velocity the estimate fades
    to zero.
    """

    # How many functions there are.
    centres: int = 21
    # Velocity on whose scale the functions are narrowest [rad/s].
    finest: float = 0.01
    # Outermost centres [rad/s].
    fastest: float = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "finest", "fastest")
        if not 3 <= self.centres <= 200:
            raise InputError(f"centres: expected a number from 3 to 200, found {self.centres}")

    @property
    def parameters(self) -> int:
        return self.centres

    def regressor(
        self,
        velocity: np.ndarray,
        memory: np.ndarray,
        elapsed: float,  # noqa: ARG002
    ) -> tuple[np.ndarray, np.ndarray]:
        end = np.arcsinh(self.fastest / self.finest)
        centres, spacing = np.linspace(-end, end, self.centres, retstep=True)
        distance = (np.arcsinh(velocity / self.finest)[:, None] - centres) / spacing
        return np.exp(-0.5 * distance * distance), memory
