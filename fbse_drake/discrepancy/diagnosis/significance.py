"""Which findings matter: their size beside the torques, forces and motions of the rows that they
are in.

What is significant statistically may be too small for anybody to care: long logs with little noise
show a millionth of a radian.
"""

import numpy as np

from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.residual import rms


class Significance:
    """Sizes of effects over one log as shares of what the log's rows are made of."""

    def __init__(self, predictor: Predictor):
        """Measures the log.

        Joint rows are measured by their torque, base rows by what the feet give, those of soles by
        how fast single joints turn and move them, and by gravity; deflections by how they vary, for
        the zero of a second encoder may be anywhere.
        """
        self._tolerance = predictor.scenario.identify.tolerance
        motion, equation = predictor.motion, predictor.motion.equation
        blocks, rows = motion.blocks, motion.residual.rows
        self._known = motion.known
        self._sizes = np.full(len(rows), np.nan)
        n = len(predictor.robot.joint_names)
        self._sizes[:n] = rms(blocks.torque_command, motion.known[:, :n])
        if predictor.robot.has_floating_base:
            wrench = equation.feet_wrench(blocks)
            # A sole that stays level is turned to and fro by joints that cancel each other.
            legs = np.sqrt((equation.joint_shares(blocks) ** 2).sum(axis=3)).reshape(-1, 6)
            for kind, size in (
                ("base/moment", _length(wrench[:, :3])),
                ("base/force", _length(wrench[:, 3:])),
                ("sole/angular_velocity", _length(legs[:, :3])),
                ("sole/specific_force", equation.gravity),
                ("relative_velocity", _length(legs[:, 3:])),
            ):
                self._sizes[[kind in row.name for row in rows]] = size

        if motors := blocks.motor_position.shape[1]:
            deflection = blocks.motor_position - blocks.joint_position
            known = motion.known[:, -motors:]
            mean = np.average(deflection, axis=0, weights=np.maximum(known, 1e-12))
            self._sizes[-motors:] = rms(deflection - mean, known)

    def matters(self, share: float) -> bool:
        """Is a share large enough to matter, see `IdentifyConfig.tolerance`, or not known?"""
        return not share < self._tolerance

    def share(self, explanation: Explanation, candidate: Candidate) -> float:
        """Largest root mean square of what a member of an explanation adds to a row, as a share of
        its size; NaN if no row has one."""
        shares = self.shares(explanation, candidate)
        return float(np.nanmax(shares)) if np.isfinite(shares).any() else np.nan

    def shares(self, explanation: Explanation, candidate: Candidate) -> np.ndarray:
        """The same in each row of the member's, (r,), NaN for those without a size."""
        start, raw = explanation.start(candidate), candidate.raw
        parameters = explanation.solved.parameters[start : start + raw.parameters]
        added = rms(raw.values @ parameters + raw.offset, self._known[:, raw.rows])
        sizes = self._sizes[raw.rows]
        measured = np.isfinite(sizes) & np.isfinite(added) & (sizes > 0)
        return np.divide(added, sizes, out=np.full(len(sizes), np.nan), where=measured)

    def left_share(self, row: int, left: np.ndarray, white: WhitenedResidual) -> float:
        """What is left in a row beyond the sensors' noise, as a share of the row's size; NaN if it
        has none.

        The smaller of two measures. In units of noise, what is slow counts for many times its size
        where noise is quick, as that of rates whose differences are accelerations. As it is, what
        is left cannot be told from the chance in the noise's own mean square.

        Args:
            row: its place.
            left: what is left of the whitened residual, (B, R).
        """
        count, noise = max(1, white.count[row]), white.residual.noise_floor[row]
        beyond = float((left[:, row] ** 2).sum()) / count - 1.0
        chance = 2.0 * np.sqrt(2.0 / count)
        as_it_is = float((white.coloured(left)[:, row] ** 2).sum()) / count / noise**2 - 1.0
        larger = min(max(beyond, 0.0), max(as_it_is, 0.0) + chance)
        return float(np.sqrt(larger) * noise / self._sizes[row])


def _length(vectors: np.ndarray) -> float:
    """Root mean square of the lengths of vectors (M, 3)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
