"""White noise of sampled values: the step in which they come, and the frequencies above which there
is little else."""

import numpy as np
from scipy.signal import welch

# Length of the windows of a spectrum [s]; it is more than noise where it is so many times it.
_SPECTRUM, _ABOVE_NOISE = 1.0, 3.0


def step_of(column: np.ndarray) -> float:
    """Step in which values come; 0 if there is none."""
    levels = np.unique(column)
    if not 2 < len(levels) < 0.5 * len(column):
        return 0.0
    differences = np.diff(levels)
    step = float(differences[differences > 1e-9 * np.ptp(column)].min())
    off = np.abs(differences / step - np.rint(differences / step))
    return step if off.max() < 0.05 else 0.0


def noise_corners(
    values: np.ndarray, variance: np.ndarray, period: float, *, of_rates: bool = False
) -> list[float]:
    """Frequency above which each joint's values (N, n) are little but noise [Hz]; 0 for none.

    Args:
        variance: of the white noise of a sample, (n,).
        of_rates: are the values differences over a period, and the white noise that of what they
            are differences of?
    """
    window = min(len(values), round(_SPECTRUM / period))
    frequency, power = welch(values, 1.0 / period, nperseg=window, axis=0)
    gain = (2.0 * np.sin(np.pi * frequency * period) / period) ** 2 if of_rates else 1.0
    corners = []
    for density, white in zip(power.T, 2 * variance * period, strict=True):
        above = np.flatnonzero(density > _ABOVE_NOISE * white * gain)
        last = above[-1] + 1 if len(above) else 1
        corners.append(float(frequency[last]) if last < len(frequency) - 1 else 0.0)
    return [c if v > 0 else 0.0 for c, v in zip(corners, variance, strict=True)]
