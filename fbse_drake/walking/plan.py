"""What a reference motion is before it becomes joint angles: CoM, feet, ZMP and support over time,
in the world frame."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from fbse_drake.errors import InputError


@dataclass(frozen=True)
class PointMotion:
    """A point's position, velocity and acceleration over time, each of shape
    (N, 3) [m, m/s, m/s^2]."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


@dataclass(frozen=True)
class YawMotion:
    """A level body's turn to the left from the world's x axis, and its first two derivatives over
    time, each of shape (N,) [rad, rad/s, rad/s^2]."""

    angle: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray

    @classmethod
    def none(cls, samples: int) -> "YawMotion":
        """One that looks along x all the time."""
        return cls(*(np.zeros(samples) for _ in range(3)))

    @cached_property
    def rotation(self) -> np.ndarray:
        """R_WB of the body, (N, 3, 3)."""
        R = np.zeros((len(self.angle), 3, 3))
        R[:, 0, 0] = R[:, 1, 1] = np.cos(self.angle)
        R[:, 1, 0], R[:, 0, 1] = np.sin(self.angle), -np.sin(self.angle)
        R[:, 2, 2] = 1.0
        return R

    @cached_property
    def angular_velocity(self) -> np.ndarray:
        """In the world, (N, 3) [rad/s]."""
        return _along_z(self.rate)

    @cached_property
    def angular_acceleration(self) -> np.ndarray:
        """In the world, (N, 3) [rad/s^2]."""
        return _along_z(self.acceleration)


def _along_z(values: np.ndarray) -> np.ndarray:
    return np.stack([np.zeros_like(values), np.zeros_like(values), values], axis=1)


@dataclass(frozen=True)
class Phase:
    """A stretch of time [s] with the same feet on the ground."""

    start: float
    end: float
    # Sides that stand.
    support: tuple[str, ...]
    # How many legs there are.
    legs: int = 2

    @property
    def is_single(self) -> bool:
        """Do some feet stand and others not?"""
        return 0 < len(self.support) < self.legs

    @property
    def label(self) -> str:
        """`DS` for double support, `AS` for that of all of more legs, else the supporting legs'
        initials and S, as `LS` or `FL+RRS`; empty without support."""
        if len(self.support) == self.legs:
            return "DS" if self.legs == 2 else "AS"
        initials = ["".join(word[0].upper() for word in side.split("_")) for side in self.support]
        return f"{'+'.join(initials)}S" if initials else ""


@dataclass(frozen=True)
class TaskPlan:
    """A reference motion in task space; feet and trunk level."""

    time: np.ndarray
    com: PointMotion
    # Sole frame origins, and how the soles are turned.
    feet: dict[str, PointMotion]
    yaw: dict[str, YawMotion]
    # (N, 2) [m].
    zmp: np.ndarray
    phases: tuple[Phase, ...]
    # Place in each sole frame where the ZMP rests when the foot carries all the load, (2,) [m].
    rest_point: dict[str, np.ndarray]
    # Of the world, whose ground is z = 0 where it is even, (3,) [m/s^2].
    gravity: np.ndarray

    @cached_property
    def trunk_yaw(self) -> YawMotion:
        """The trunk looks where the feet look in the mean."""
        yaws = self.yaw.values()
        return YawMotion(
            np.mean([yaw.angle for yaw in yaws], axis=0),
            np.mean([yaw.rate for yaw in yaws], axis=0),
            np.mean([yaw.acceleration for yaw in yaws], axis=0),
        )

    def anchor(self, side: str) -> np.ndarray:
        """Where the ZMP rests when the foot carries all the load, (N, 2) [m]."""
        turned = self.yaw[side].rotation[:, :2, :2] @ self.rest_point[side]
        return self.feet[side].position[:, :2] + turned

    def support(self, side: str) -> np.ndarray:
        """Does the foot stand at each sample? Shape (N,), bool."""
        standing = np.zeros(len(self.time), dtype=bool)
        for phase in self.phases:
            if side in phase.support:
                standing |= (phase.start <= self.time) & (self.time <= phase.end)
        return standing

    def phase_at(self, time: float) -> tuple[int, Phase]:
        """Number and phase of a time."""
        for number, phase in enumerate(self.phases):
            if time <= phase.end:
                return number, phase
        return len(self.phases) - 1, self.phases[-1]


def smooth_step(s: np.ndarray, derivative: int = 0) -> np.ndarray:
    """Quintic from 0 to 1 over s in [0, 1] with zero velocity and acceleration at both ends;
    constant outside."""
    inside = (0 < s) & (s < 1)
    s = np.clip(s, 0, 1)
    value = {
        0: s**3 * (10 - 15 * s + 6 * s**2),
        1: 30 * s**2 * (1 - s) ** 2,
        2: 60 * s * (1 - s) * (1 - 2 * s),
    }[derivative]
    return value if derivative == 0 else np.where(inside, value, 0.0)


def support_margin(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance from points to the edge of the convex hull of corners, positive inside.

    Args:
        point: (N, 2) [m]; corners: (K, 2) [m].

    Returns:
        Shape (N,) [m].
    """
    equations = ConvexHull(corners).equations
    return -(point @ equations[:, :2].T + equations[:, 2]).max(axis=1)


def check_zmp(plan: TaskPlan, foot_corners: dict[str, np.ndarray], margin: float) -> None:
    """Refuses a plan whose ZMP comes closer than `margin` [m] to the edge of the support polygon.

    Args:
        foot_corners: places of the pads in each sole frame, (pads, 3) [m].

    Two point feet have no polygon; nothing is said of them.

    Raises:
        InputError: names the phase, time and margin.
    """
    for number, phase in enumerate(plan.phases):
        inside = (phase.start < plan.time) & (plan.time < phase.end)
        if not inside.any():
            continue
        first = int(inside.argmax())
        corners = [
            plan.feet[side].position[first, :2]
            + foot_corners[side][:, :2] @ plan.yaw[side].rotation[first, :2, :2].T
            for side in phase.support
        ]
        if sum(len(points) for points in corners) < 3:
            continue  # Point feet: the ZMP has to be on the line between them.
        distance = support_margin(plan.zmp[inside], np.concatenate(corners))
        if distance.min() < margin:
            time = plan.time[inside][distance.argmin()]
            raise InputError(
                f"phase {number} ({' and '.join(phase.support)} support), t = {time:.2f} s: the "
                f"ZMP is {distance.min():.3f} m inside the "
                f"support polygon, zmp_margin asks for {margin:.3f} m; shorten the step, lengthen "
                "the phase or lower zmp_margin"
            )
