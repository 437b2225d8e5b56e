"""What the equation of motion leaves over on a log: joint, base, kinematic and transmission
residuals, with the noise that the sensors put into them.

All are averaged over blocks of time. Averages of one and the same window have one group delay,
telescope what is differentiated, and leave noise whose covariance is known: white noise
(accelerometer, forces) stays white, differenced noise (gyro, joint velocity) becomes a moving
average of order one, so that each row's covariance is tridiagonal. Its sum over blocks is not
nothing, for the mass matrix that it goes through changes as the robot turns.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.discrepancy.residual.rows import Row


@dataclass(frozen=True)
class Residual:
    """Block averages of the residual of a model over a log; B blocks, R rows."""

    rows: list[Row]
    # Centre of each block [s], shape (B,).
    time: np.ndarray
    # (B, R); and which are known: no gap in the log and no force at the end of its sensor's range,
    # for joint rows a torque, for kinematic rows a sole that stands; no unused row.
    value: np.ndarray
    known: np.ndarray
    # Noise of the sensors: variance of each average, and its covariance with the next block's, each
    # (B, R).
    variance: np.ndarray
    covariance: np.ndarray
    # Which soles stand, (B, feet).
    standing: np.ndarray
    # Averages of the signals, for tables and plots.
    signals: Instants
    # What of the variance is no noise of sensors but doubt about laws that were taken off, (B, R)
    # or 0.
    doubt: np.ndarray | float = 0.0

    @cached_property
    def row_index(self) -> dict[str, int]:
        return {row.name: k for k, row in enumerate(self.rows)}

    @cached_property
    def noise_floor(self) -> np.ndarray:
        """Root mean square of the sensors' noise in each row, shape (R,); NaN for a row that is
        never known."""
        return rms(np.sqrt(self.variance), self.known)

    def minus(self, predicted: np.ndarray) -> "Residual":
        """What is left when a prediction (B, R) is taken off."""
        return replace(self, value=self.value - predicted)

    def by_larger_noise(self, other: "Residual") -> "Residual":
        """The same where both are known, with the larger noise of both in every block.

        What two models leave is compared by one noise. One with more inertia or softer ground
        passes on more of the sensors' noise, and would seem worse otherwise; and where friction was
        taken off, what was noise of the torque before is none any more.
        """
        known = self.known & other.known
        mine, others = (rms(np.sqrt(r.variance), known) for r in (self, other))
        return replace(
            self,
            known=known,
            variance=np.maximum(self.variance, other.variance),
            # Its noise moves together in blocks as that of the one that has more of it.
            covariance=np.where(others > mine, other.covariance, self.covariance),
            doubt=np.where(other.variance > self.variance, other.doubt, self.doubt),
        )


def rms(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Root mean square over the first axis where known; NaN where nothing is."""
    counts = known.sum(axis=0)
    total = (np.where(known, values, 0.0) ** 2).sum(axis=0)
    return np.sqrt(np.divide(total, counts, out=np.full(total.shape, np.nan), where=counts > 0))
