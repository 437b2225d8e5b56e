"""What rounded angles feign in a residual where velocities are had from them.

The error of a rounded angle is no white noise: it repeats with every step of the encoder, and where
a joint moves evenly, by so many steps from sample to sample, it is slow, and looks like a law of
the angle or of the velocity. By how much is found from angles that are rounded elsewhere
(parametric bootstrap, B. Efron and R. J. Tibshirani, "An Introduction to the Bootstrap", 1993).
"""

import numpy as np
from scipy.stats import gumbel_r

from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion

# What brings less than so many times what is required may be what rounded angles feign.
DOUBTFUL = 5.0


def noise_of_rounding(motion: RecordedMotion, white: WhitenedResidual) -> np.ndarray:
    """K draws of a residual's noise as far as it is that of rounded angles, and white for the rest,
    whitened, (K, B, R); none where velocities are not had from angles that come in steps.

    Args:
        white: the residual whose noise it is.
    """
    drawn = motion.rounding_noise
    rounding = np.zeros(drawn.shape)
    for row in range(drawn.shape[2]):
        rounding[:, :, row] = white.whiten(row, drawn[:, :, row].T).T
    power = (rounding**2).sum(axis=(0, 1)) / np.maximum(len(drawn) * white.count, 1)
    rest = np.sqrt(np.maximum(1.0 - power, 0.0)) * white.residual.known
    return rounding + rest * np.random.default_rng(0).standard_normal(drawn.shape)


def chance_bound(largest: np.ndarray, probability: float) -> float:
    """What the largest of many exceeds with this probability only, by some draws of it, (K,), to
    which its distribution is fitted (E. J. Gumbel, "Statistics of Extremes", 1958)."""
    scale = np.sqrt(6.0) / np.pi * largest.std(ddof=1)
    return float(gumbel_r.isf(probability, largest.mean() - np.euler_gamma * scale, scale))
