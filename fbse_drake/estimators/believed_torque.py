"""What the model's own effects take of the joints' torques, tick by tick.

A filter of the friction need not learn it: its law is what is left beside these effects.
"""

from collections.abc import Sequence

import numpy as np

from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque
from fbse_drake.estimators.records import record_type


def believed_torque_type(n: int) -> np.dtype:
    """Torque loss of the effects in a tick, (n,) [Nm], linear about a velocity at its end: `torque`
    there, its `slope` [Nm s/rad], and that `velocity` [rad/s]."""
    return record_type(torque=(n,), slope=(n,), velocity=(n,))


class BelievedTorque:
    """Joint torque effects that a model has, with the memories that they need."""

    def __init__(self, effects: Sequence[ResolvedJointTorque], joints: int, period: float):
        """None of them remembers anything yet.

        Args:
            period: of a tick [s].
        """
        self.effects, self._joints, self._period = tuple(effects), joints, period
        still = JointMotion(np.zeros(joints), command=np.zeros(joints), time_step=period)
        self._rows: list[slice] = []
        rows = 0
        for effect in self.effects:
            start = rows
            if effect.effect.has_memory:
                rows += len(effect.effect.start(still, effect.nonlinear))
            self._rows.append(slice(start, rows))
        # What is remembered before the first tick: positions at its start, and memories.
        self.start = np.full((1 + rows) * joints, np.nan)

    def torque_and_slope(
        self, memory: np.ndarray, motion: JointMotion
    ) -> tuple[np.ndarray, np.ndarray]:
        """Torque loss in a tick [Nm] and its derivative with respect to the velocity [Nm s/rad],
        (n,) each.

        Args:
            memory: see `start`; motion: of the tick, but for its `position` and `memory`.
        """
        total, slopes = np.zeros(self._joints), np.zeros(self._joints)
        for effect, of_effect in zip(self.effects, self._motions(memory, motion), strict=True):
            torque, slope = effect.torque_and_slope(of_effect)
            total, slopes = total + torque, slopes + slope
        return total, slopes

    def remembered(
        self, memory: np.ndarray, motion: JointMotion, position: np.ndarray
    ) -> np.ndarray:
        """The memory at the end of a tick.

        Args:
            memory, motion: see `torque_and_slope`; position: where the tick ends, (n,) [rad].
        """
        if np.isnan(memory[0]):
            # Nobody knows yet what is commanded.
            return np.concatenate([position, memory[self._joints :]])
        parts = [position]
        for effect, of_effect in zip(self.effects, self._motions(memory, motion), strict=True):
            if effect.effect.has_memory:
                parts.append(effect.effect.advance(of_effect, effect.nonlinear).ravel())
        return np.concatenate(parts)

    def _motions(self, memory: np.ndarray, motion: JointMotion) -> list[JointMotion]:
        """A tick as each effect sees it."""
        position, rows = memory[: self._joints], memory[self._joints :].reshape(-1, self._joints)
        motion = motion._replace(position=np.nan_to_num(position), time_step=self._period)
        motions = []
        for effect, part in zip(self.effects, self._rows, strict=True):
            of_effect = rows[part]
            if np.isnan(of_effect).any():
                of_effect = effect.effect.start(motion, effect.nonlinear)
            motions.append(motion._replace(memory=of_effect) if len(of_effect) else motion)
        return motions
