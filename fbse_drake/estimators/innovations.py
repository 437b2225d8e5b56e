"""What innovations say of noise and models, for all filters.

White innovations differ from tick to tick; what they keep saying is no noise but something that the
model lacks.
"""

import math

from numba import njit

# For how long innovations must agree to be no white noise [s], and how much larger than white noise
# leaves it their mean square must be.
AGREEMENT_TIME, AGREEMENT = 0.02, 3.0
# How long it takes to learn that sensors are noisier than believed [s], and how much of that one
# tick may tell, as a share of the variance.
NOISE_TIME, LARGEST_SHARE = 0.3, 9.0
# The same where a tick tells of several numbers; and the least that it may tell.
_SEVERAL_TIME, SMALLEST_SHARE = 0.1, 1e-3
# The least that feet and forces are taken to err, as a share of the variance believed.
LEAST_HABIT = 0.01
# Means of the logarithm of a mean square of so many normal numbers of variance one: psi(k / 2) -
# log(k / 2) with the digamma function psi.
LOG_OF_ONE, LOG_OF_THREE, LOG_OF_SIX = -1.2704, -0.3690, -0.1758


@njit(cache=True)
def learned_noise(noise: float, share: float, mean_log: float, elapsed: float) -> float:
    """By how much the variance of several numbers' noise is larger than believed; at least 1.

    Its logarithm is learned: noise that begins and noise that ends are then found out equally fast,
    and single large readings tell little.

    Args:
        noise: what was known of it.
        share: mean square of what was read, as a share of the variance by that.
        mean_log: of how many numbers the mean is, see `LOG_OF_SIX`.
        elapsed: of the tick [s].
    """
    told = math.log(min(max(share, SMALLEST_SHARE), LARGEST_SHARE)) - mean_log
    return max(1.0, noise * math.exp((1.0 - math.exp(-elapsed / _SEVERAL_TIME)) * told))
