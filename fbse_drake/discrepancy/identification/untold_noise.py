"""Noise that nobody told of and that shows only in what is left when everything is explained."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded
from scipy.optimize import minimize
from scipy.stats import chi2, kurtosis

from fbse_drake.discrepancy.identification.structure import is_white
from fbse_drake.discrepancy.residual.noise import Noise
from fbse_drake.discrepancy.residual.residual import Residual

# Probability of calling any noise larger than believed by chance.
_FALSE_ALARM = 1e-3
# White noise beside that of the sensors, as a share of its variance: none, and a guess.
_NO_SHARE, _SHARE = 1e-9, 1e-2
# Logarithms of the least that there may be of what is believed, for noise of a velocity that is
# filtered is measured where it is loudest, and of more than there is in any log.
_LEAST, _MOST = -3.0, 30.0
# Noise has no such tails: that much excess kurtosis is of jolts, as of a gear that is hit. (What
# stiction leaves has some 8.) What happens between rare samples has them too, but is not so many
# times as loud as what is believed.
_JOLTS, _LOUDEST_JOLTS = 20.0, 3.0
# Variance below which a row without any noise is rounding.
_ROUNDING = 1e-18


def likeliest_noise(residual: Residual, length: int, rows: Sequence[int]) -> Noise | None:
    """Noise of rows in which nothing but noise is left, by maximum likelihood: how many times there
    is that of the sensors, and how much white noise beside; None if none of these rows has more
    than is believed, in all or of what is slow, or what is left is not such noise.

    Args:
        length: of a block [steps].
    """
    count = residual.value.shape[1]
    white, sensors, factor = np.zeros(count), np.ones(count), np.ones(count)
    least = chi2.isf(_FALSE_ALARM / max(1, len(rows)), 2)
    for row in rows:
        left = _Left.of(residual, row)
        more, beside = left.likeliest()
        # Of sensors that are believed to be noisier than they are, torques that are hide behind it.
        louder = max(left.loudness, left.slow_factor(more, beside))
        if louder <= 1.0:
            continue
        gained = left.deviance(1.0, 0.0) - left.deviance(more, beside)
        is_jolted = louder > _LOUDEST_JOLTS and left.kurtosis(more, beside) > _JOLTS
        if gained > least and not is_jolted and left.is_noise(more, beside):
            sensors[row], white[row], factor[row] = more, beside * length, louder
    return Noise((), white, sensors, factor) if (factor > 1.0).any() else None


@dataclass(frozen=True)
class _Left:
    """What is left in a row where it is known, and its noise as it is believed, (B,)."""

    value: np.ndarray
    variance: np.ndarray
    # With the next value.
    covariance: np.ndarray

    @staticmethod
    def of(residual: Residual, row: int) -> "_Left":
        index = np.flatnonzero(residual.known[:, row])
        adjacent = np.append(np.diff(index) == 1, False)
        covariance = np.where(adjacent, residual.covariance[index, row], 0.0)
        variance = np.maximum(residual.variance[index, row], _ROUNDING)
        return _Left(residual.value[index, row], variance, covariance)

    def _factor(self, more: float, beside: float) -> np.ndarray:
        """Of Cholesky, of so many times that noise and white noise of a variance beside."""
        band = np.stack([more * self.variance + beside, more * self.covariance])
        return cholesky_banded(band, lower=True)

    def whitened(self, more: float, beside: float) -> np.ndarray:
        return solve_banded((1, 0), self._factor(more, beside), self.value)

    @property
    def loudness(self) -> float:
        """Root mean square, in multiples of the noise as it is believed."""
        return float(np.sqrt((self.whitened(1.0, 0.0) ** 2).mean()))

    def slow_factor(self, more: float, beside: float) -> float:
        """How many times as large as it is believed that noise is in averages over a long time."""
        believed = float((self.variance + 2 * self.covariance).mean())
        return float(np.sqrt(more + beside / max(believed, _ROUNDING)))

    def is_noise(self, more: float, beside: float) -> bool:
        """Is nothing but that noise left?"""
        return is_white(self.whitened(more, beside), len(self.value))

    def kurtosis(self, more: float, beside: float) -> float:
        """In excess of a normal distribution's, whitened by that noise."""
        return float(kurtosis(self.whitened(more, beside)))

    def deviance(self, more: float, beside: float) -> float:
        """With that noise."""
        spread = 2 * np.log(self._factor(more, beside)[0]).sum()
        return float(spread + (self.whitened(more, beside) ** 2).sum())

    def likeliest(self) -> tuple[float, float]:
        """How many times the noise, and the variance of white noise beside."""
        typical = float(self.variance.mean())
        found = minimize(
            lambda x: self.deviance(np.exp(x[0]), typical * np.exp(x[1])),
            np.log([1.0, _SHARE]),
            bounds=[(_LEAST, _MOST), (np.log(_NO_SHARE), _MOST)],
            method="L-BFGS-B",
        )
        return float(np.exp(found.x[0])), typical * float(np.exp(found.x[1]))
