"""What the checks of a recording look at, and how they say what they find."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np

from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.discrepancy.residual.white_noise import step_of

Severity = Literal["note", "warning", "untrustworthy"]

# Samples at which channels are compared at the log's own rate.
_SAMPLES = 4000
# A joint that moves less than this does not move [rad or m]; nor one that moves by few of its
# encoder's steps.
STILL, _STEPS = 1e-4, 3
# A foot is in the air while it carries less than this share of the weight and the others more than
# that one.
_UNLOADED, _LOADED = 0.06, 0.85


@dataclass(frozen=True)
class HygieneFinding:
    """One thing that is wrong, or remarkable, with a channel."""

    # As `joint/torque_command`, and which joints, axes or feet of it; empty for all.
    channel: str
    where: tuple[str, ...]
    # As `gap`, `clock_offset`, `swapped_joints`.
    kind: str
    size: float
    unit: str
    severity: Severity
    # One line: what it is, and what it does to a diagnosis.
    text: str


@dataclass(frozen=True)
class NoiseLevel:
    """White noise of a channel: standard deviation of a sample of a typical component."""

    channel: str
    level: float
    unit: str
    # What the scenario believes; NaN where it says nothing.
    believed: float


Check: TypeAlias = Callable[["Evidence"], Iterable[HygieneFinding]]


class Evidence:
    """A recording and what several checks need of it."""

    def __init__(self, motion: RecordedMotion):
        self.motion, self.log, self.robot = motion, motion.log, motion.robot
        self.joints, self.sides = self.robot.joint_names, self.robot.description.sides
        self.period = motion.period
        self._found: dict[Check, list[HygieneFinding]] = {}

    def found_by(self, check: Check) -> list[HygieneFinding]:
        """What a check finds; it looks once."""
        if check not in self._found:
            self._found[check] = list(check(self))
        return self._found[check]

    @cached_property
    def channels(self) -> dict[str, tuple[np.ndarray, list[str]]]:
        """Sensor channels as they are in the log: values (N, components), and what each component
        is called."""
        axes = ["x", "y", "z"]
        names = {
            "joint/position": self.joints,
            "joint/velocity": self.joints,
            "joint/motor_position": self.joints,
            "joint/torque_command": self.joints,
            "imu/linear_acceleration": axes,
            "imu/angular_velocity": axes,
        }
        for side in self.sides:
            names[f"foot/{side}/wrench"] = [
                f"{kind}_{axis}" for kind in ("moment", "force") for axis in axes
            ]
            if (pads := f"foot/{side}/pad_force") in self.log:
                names[pads] = [
                    f"pad {pad + 1} {axis}"
                    for pad in range(self.log[pads].shape[1])
                    for axis in axes
                ]
        return {
            name: (self.log[name].reshape(len(self.log.time), -1), parts)
            for name, parts in names.items()
            if name in self.log
        }

    @cached_property
    def quantum(self) -> dict[str, np.ndarray]:
        """Steps in which each channel's components come; 0 where there are none."""
        return {
            name: np.array([step_of(column) for column in values.T])
            for name, (values, _) in self.channels.items()
        }

    @cached_property
    def instants(self) -> Instants:
        """Steps at the log's own rate and not filtered for the diagnosis, at most some thousand
        from its middle."""
        motion = self._read(cutoff=0.0)
        start = max(0, (len(motion.steps.joint_position) - _SAMPLES) // 2)
        return Instants(
            **{
                name: values[start : start + _SAMPLES]
                for name, values in vars(motion.steps).items()
            }
        )

    def _read(self, **changes: Any) -> RecordedMotion:
        """The log read in another way."""
        motion = self.motion
        return RecordedMotion(
            motion.robot, motion.sensors, replace(motion.recording, **changes), motion.log
        )

    @cached_property
    def known(self) -> np.ndarray:
        """Which averages of which rows are known, those that nothing is fitted to as well, (B,
        R)."""
        return self._read(unused_rows=[]).known

    def needed_and_given(self, at: Instants) -> tuple[np.ndarray, np.ndarray]:
        """What the masses need of the feet and what the feet give, [moment, force] on the base in
        its axes, (M, 6) each."""
        unloaded = replace(at, pad_force=np.zeros_like(at.pad_force))
        without, left = (
            self.motion.equation.residual(one, kinematic=False)[:, len(self.joints) :]
            for one in (unloaded, at)
        )
        return -without, left - without

    @cached_property
    def over_blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """The same over the blocks of the whole log."""
        return self.needed_and_given(self.motion.blocks)

    @cached_property
    def wrenches(self) -> list[np.ndarray]:
        """Wrench [moment, force] on each foot in the axes of its sole, (B, 6) each."""
        return self.motion.equation.wrenches(self.motion.blocks.pad_force)

    @cached_property
    def aloft(self) -> list[np.ndarray]:
        """When each foot is in the air, (B,) each."""
        return self.aloft_among(self.wrenches)

    def aloft_among(self, wrenches: list[np.ndarray]) -> list[np.ndarray]:
        """The same for other wrenches on the feet: the others carry the robot."""
        weight = self.motion.equation.weight
        loads = np.stack([np.abs(wrench[:, 5]) for wrench in wrenches])
        return [
            (load < _UNLOADED * weight) & (loads.sum(axis=0) - load > _LOADED * weight)
            for load in loads
        ]

    @cached_property
    def link_torque(self) -> np.ndarray:
        """What the model needs in the joints, block by block, (B, n)."""
        n = len(self.joints)
        return self.motion.blocks.torque_command - self.motion.residual.value[:, :n]

    @cached_property
    def units(self) -> dict[str, dict[str, str]]:
        """Unit of each joint in the joint channels."""
        of_angle = {
            joint: "m" if unit == "N" else "rad"
            for joint, unit in zip(self.joints, self.robot.torque_units, strict=True)
        }
        return {
            "joint/position": of_angle,
            "joint/motor_position": of_angle,
            "joint/velocity": {joint: f"{unit}/s" for joint, unit in of_angle.items()},
            "joint/torque_command": dict(zip(self.joints, self.robot.torque_units, strict=True)),
        }


def remark(
    kind: str,
    severity: Severity,
    channel: str,
    size: float,
    unit: str,
    text: str,
    where: Iterable[str] = (),
) -> HygieneFinding:
    """A finding whose line begins with its channel."""
    return HygieneFinding(
        channel, tuple(where), kind, float(size), unit, severity, f"{channel}: {text}"
    )


def remarks(
    kind: str,
    severity: Severity,
    channel: str,
    sizes: Mapping[str, float],
    unit: str | Mapping[str, str],
    text: str,
) -> list[HygieneFinding]:
    """One finding for all components of a channel that show the same; the worst comes first, and
    its size is that of the finding.

    Args:
        sizes: by component; empty for no finding.
        unit: of all or of each component.
        text: with {where} and {size}.
    """
    if not sizes:
        return []
    first, *others = where = sorted(sizes, key=lambda name: -abs(sizes[name]))
    unit = unit if isinstance(unit, str) else unit[first]
    size = f"{sizes[first]:.3g}" if unit == "1" else f"{sizes[first]:.3g} {unit}"
    named = f"{first} and {len(others)} more" if others else first
    return [
        remark(
            kind, severity, channel, sizes[first], unit, text.format(where=named, size=size), where
        )
    ]


def travel_of(position: np.ndarray) -> np.ndarray:
    """How far joints move in measured positions (N, n), from the smallest to the largest, (n,) [rad
    or m].

    It is 0 where their sensors do not tell it from rest.
    """
    travel = np.ptp(position, axis=0)
    least = [max(STILL, _STEPS * step_of(column)) for column in position.T]
    return np.where(travel < least, 0.0, travel)
