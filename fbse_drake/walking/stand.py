"""Motions with all feet on the ground: squatting and swaying."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fbse_drake.errors import require_positive
from fbse_drake.walking.plan import (
    Phase,
    PointMotion,
    TaskPlan,
    YawMotion,
    check_zmp,
    smooth_step,
)


def smooth_sine(
    time: np.ndarray, frequency: float, ramp: float, duration: float, phase: float = 0.0
) -> list[np.ndarray]:
    """A sine that swells from rest over `ramp` [s] and dies out before `duration` [s]; with its
    first two derivatives."""
    rise = [smooth_step(time / ramp, k) / ramp**k for k in range(3)]
    fall = [(-1.0) ** k * smooth_step((duration - time) / ramp, k) / ramp**k for k in range(3)]
    envelope = [
        rise[0] * fall[0],
        rise[1] * fall[0] + rise[0] * fall[1],
        rise[2] * fall[0] + 2 * rise[1] * fall[1] + rise[0] * fall[2],
    ]
    w = 2 * np.pi * frequency
    sine = [
        np.sin(w * time + phase),
        w * np.cos(w * time + phase),
        -(w**2) * np.sin(w * time + phase),
    ]
    return [
        envelope[0] * sine[0],
        envelope[1] * sine[0] + envelope[0] * sine[1],
        envelope[2] * sine[0] + 2 * envelope[1] * sine[1] + envelope[0] * sine[2],
    ]


@dataclass(frozen=True)
class _Stand:
    """All feet stand side by side."""

    # Amplitude of the CoM's motion [m], its frequency [Hz], and the time in which it swells and
    # dies out [s].
    amplitude: float = 0.03
    frequency: float = 0.4
    ramp: float = 2.0
    # Height of the centre of mass above the ground at rest [m].
    com_height: float = 0.66
    # Distance between the soles' centres [m], and that of front and rear feet, where there are
    # such.
    foot_spacing: float = 0.20
    wheelbase: float = 0.0
    # Where the CoM stands ahead of the sole frames [m].
    zmp_forward: float = 0.025
    # Smallest distance of the planned ZMP to the edge of the support polygon [m].
    zmp_margin: float = 0.02
    # Where joints that are no leg's are held, by joint [rad]; 0 by default.
    posture: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_positive(self, "frequency", "ramp", "com_height", "foot_spacing")

    def _plan(
        self,
        axis: int,
        time: np.ndarray,
        stance: Mapping[str, np.ndarray],
        foot_corners: dict[str, np.ndarray],
        gravity: np.ndarray,
    ) -> TaskPlan:
        com = [np.zeros((len(time), 3)) for _ in range(3)]
        com[0][:, 2] = self.com_height
        for order, values in enumerate(
            smooth_sine(time, self.frequency, self.ramp, float(time[-1]))
        ):
            com[order][:, axis] += self.amplitude * values
        still, reach = np.zeros((len(time), 3)), self.wheelbase / 2
        feet = {
            side: PointMotion(
                still + [sign[0] * reach - self.zmp_forward, sign[1] * self.foot_spacing / 2, 0.0],
                still,
                still,
            )
            for side, sign in stance.items()
        }
        # A point mass: the ZMP is where the line along (acceleration - gravity) meets the ground.
        lever = com[0][:, 2] / (com[2][:, 2] - gravity[2])
        zmp = com[0][:, :2] - com[2][:, :2] * lever[:, None]
        rest_point = {side: np.array([self.zmp_forward, 0.0]) for side in stance}
        plan = TaskPlan(
            time,
            PointMotion(*com),
            feet,
            dict.fromkeys(stance, YawMotion.none(len(time))),
            zmp,
            (Phase(0.0, float(time[-1]), tuple(stance), len(stance)),),
            rest_point,
            gravity,
        )
        check_zmp(plan, foot_corners, self.zmp_margin)
        return plan


@dataclass(frozen=True)
class Squat(_Stand):
    """The CoM moves up and down."""

    def plan(
        self,
        time: np.ndarray,
        stance: Mapping[str, np.ndarray],
        foot_corners: dict[str, np.ndarray],
        gravity: np.ndarray,
    ) -> TaskPlan:
        """See `Walk.plan`."""
        return self._plan(2, time, stance, foot_corners, gravity)


@dataclass(frozen=True)
class Sway(_Stand):
    """The CoM moves to the left and right."""

    def plan(
        self,
        time: np.ndarray,
        stance: Mapping[str, np.ndarray],
        foot_corners: dict[str, np.ndarray],
        gravity: np.ndarray,
    ) -> TaskPlan:
        """See `Walk.plan`."""
        return self._plan(1, time, stance, foot_corners, gravity)
