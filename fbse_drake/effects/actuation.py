"""Motors and drives: torques that are commanded and not given, or given and not commanded."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from fbse_drake.effects.effect import Effect, Parameter, in_library
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, Rise, affine_recursion


@in_library
@dataclass(frozen=True)
class TorqueGain(JointTorqueEffect):
    """The motor gives (1 - shortfall) of the commanded torque: u = shortfall * command."""

    description: ClassVar[str] = (
        "The motor gives another share of the commanded torque than believed, as from a wrong "
        "torque constant."
    )
    signature: ClassVar[str] = "Torque in proportion to the command."
    experiment: ClassVar[str] = "Hold each joint under several loads."
    shows_at_rest: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "shortfall": Parameter(
            "1", linear=True, plausible=(-0.5, 0.5), bounds=(-np.inf, np.inf), everything=1.0
        ),
    }

    shortfall: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray | float], Sequence[float]]:
        return (motion.command,), (0.0,)


@in_library
@dataclass(frozen=True)
class TorqueBias(JointTorqueEffect):
    """The motor lacks a constant torque: u = bias."""

    description: ClassVar[str] = (
        "A constant torque is missing, as from the offset of a current sensor."
    )
    signature: ClassVar[str] = "The same torque at all times."
    experiment: ClassVar[str] = "Hold each joint still without load."
    shows_at_rest: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "bias": Parameter("Nm", linear=True, plausible=(-20.0, 20.0), bounds=(-np.inf, np.inf)),
    }

    bias: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,  # noqa: ARG004
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[float], Sequence[float]]:
        return (1.0,), (0.0,)


@in_library
@dataclass(frozen=True)
class TorqueDelay(JointTorqueEffect):
    """The motor gives the command of some time ago: u = command(t) - command(t - delay), linear
    between the steps.

    Before the first step the command is taken to have been what it is then.
    """

    description: ClassVar[str] = "The commanded torque comes late by a fixed time."
    signature: ClassVar[str] = "Torque in proportion to how fast the command changes."
    experiment: ClassVar[str] = "Command torques that change fast."
    shows_at_rest: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "delay": Parameter("s", linear=False, plausible=(5e-4, 3e-2), neutral=0.0)
    }
    has_memory: ClassVar[bool] = True

    delay: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        # Memory: past commands, the last one first.
        commands = np.concatenate(
            [np.broadcast_to(motion.command, motion.memory[:1].shape), motion.memory]
        )
        whole = np.floor(nonlinear / motion.time_step).astype(int)
        share = nonlinear / motion.time_step - whole
        late = (1.0 - share) * np.take_along_axis(
            commands, whole, axis=0
        ) + share * np.take_along_axis(commands, whole + 1, axis=0)
        return (motion.command - late[0],), (0.0,)

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        rows = int(np.floor(nonlinear.max() / motion.time_step)) + 1
        return np.broadcast_to(motion.command, (rows, *nonlinear.shape[1:]))

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return np.concatenate(
            [np.broadcast_to(motion.command, motion.memory[:1].shape), motion.memory[:-1]]
        )

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        rows, samples = int(np.floor(nonlinear.max() / motion.time_step)) + 1, len(motion.command)
        command = np.concatenate([np.repeat(motion.command[:1], rows, axis=0), motion.command])
        past = np.stack([command[rows - k : rows - k + samples] for k in range(1, rows + 1)])
        return past.reshape(rows, *[1] * (nonlinear.ndim - 3), *motion.command.shape)


@in_library
@dataclass(frozen=True)
class TorqueLag(JointTorqueEffect):
    """The motor's torque follows the command like a low-pass y of first order: u = command - y,
    time_constant dy/dt = command - y.

    Exact for a command that is held over the step; y is then its mean over the step. It starts at
    the command.
    """

    description: ClassVar[str] = (
        "The commanded torque builds up gradually, as in a slow current loop or an elastic gear."
    )
    signature: ClassVar[str] = "After each change of the command a torque that fades away."
    experiment: ClassVar[str] = "Command torques that change fast."
    shows_at_rest: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "time_constant": Parameter("s", linear=False, plausible=(5e-4, 5e-2), neutral=0.0),
    }
    has_memory: ClassVar[bool] = True

    time_constant: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        change = motion.command - motion.memory[0]
        return (change * (1.0 - _kept(motion, nonlinear)) * nonlinear[0] / motion.time_step,), (
            0.0,
        )

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        return np.broadcast_to(motion.command, (1, *nonlinear.shape[1:]))

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        return (motion.command + (motion.memory[0] - motion.command) * _kept(motion, nonlinear))[
            None
        ]

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        keep = _kept(motion, nonlinear)
        return affine_recursion(motion.command[0], keep, (1.0 - keep) * motion.command)[None]


@in_library
@dataclass(frozen=True)
class TorqueReadingLag(JointTorqueEffect):
    """The torque that a log has follows the one that is given like a low-pass of first order:
    u = -time_constant d(command)/dt.

    The given torque is the one that is read, plus time_constant times its rate: in steps, so that a
    log shows the time constant linearly. In a simulation the command is what is read, and the motor
    is ahead of it. Of a log whose model has it torques are read so much earlier: friction that
    jumps has no rate.
    """

    description: ClassVar[str] = (
        "The recorded torque comes late, as a motor current behind a filter or by another clock."
    )
    signature: ClassVar[str] = (
        "Torque against the rate of the command: of inertia like damping, of friction like play."
    )
    experiment: ClassVar[str] = "Move fast and slowly; record the torques as they are commanded."
    shows_at_rest: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    needs_sampled_torque: ClassVar[bool] = True
    opposites: ClassVar[tuple[type[Effect], ...]] = (TorqueDelay, TorqueLag)
    parameters: ClassVar[dict[str, Parameter]] = {
        "time_constant": Parameter("s", linear=True, plausible=(0.0, 2e-2)),
    }
    has_memory: ClassVar[bool] = True

    time_constant: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        # Memory: the last command.
        return ((motion.memory[0] - motion.command) / motion.time_step,), (0.0,)

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        return np.broadcast_to(motion.command, (1, *nonlinear.shape[1:]))

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        return np.broadcast_to(motion.command, (1, *nonlinear.shape[1:]))

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return np.concatenate([motion.command[:1], motion.command[:-1]])[None]

    @staticmethod
    def in_time(torque: np.ndarray, time_constant: np.ndarray, period: float) -> np.ndarray:
        """Torques (N, n) of rows so much earlier as each joint's come late, (n,) [s]."""
        at = np.arange(len(torque))
        earlier = [
            np.interp(at + late / period, at, column)
            for late, column in zip(time_constant, torque.T, strict=True)
        ]
        return np.stack(earlier, axis=1)


def _kept(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
    """How much of a deviation a low-pass keeps over the step."""
    return np.exp(-motion.time_step / np.maximum(nonlinear[0], 1e-9))


@in_library
@dataclass(frozen=True)
class TorqueSaturation(JointTorqueEffect):
    """The motor gives no more than a limit: u = command - clip(command, -limit, limit)."""

    description: ClassVar[str] = "The motor gives no torque beyond a limit."
    signature: ClassVar[str] = (
        "Torque only where the command is large, and then all that is beyond."
    )
    experiment: ClassVar[str] = "Load each joint up to its rated torque."
    shows_at_rest: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "limit": Parameter("Nm", linear=False, plausible=(2.0, 300.0), neutral=np.inf, grid=300),
    }

    limit: dict[str, float] = field(default_factory=dict)

    @classmethod
    def parameters_in(
        cls, motion: JointMotion, parameters: dict[str, Parameter]
    ) -> dict[str, Parameter]:
        """A motor that most of the time gives less than is commanded moves nothing as it is
        wished."""
        limit = parameters["limit"]
        least, (low, high) = float(np.median(np.abs(motion.command))), limit.plausible
        plausible = (min(max(low, least), 0.5 * high), high)
        bounds = (least, limit.bounds[1])
        return parameters | {"limit": replace(limit, plausible=plausible, bounds=bounds)}

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        return (motion.command - np.clip(motion.command, -nonlinear[0], nonlinear[0]),), (0.0,)


@in_library
@dataclass(frozen=True)
class TorqueRollOff(JointTorqueEffect):
    """The motor gives ever less of what is commanded:
    u = command - command / (1 + |command| / half)."""

    description: ClassVar[str] = (
        "The harder a motor is driven, the less of the command it gives: iron saturates, the "
        "supply gives way."
    )
    signature: ClassVar[str] = "Torque that grows with the square of the command."
    experiment: ClassVar[str] = "Load each joint up to its rated torque."
    shows_at_rest: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        # The command of which half arrives.
        "half": Parameter(
            "Nm",
            linear=False,
            plausible=(0.5, 2000.0),
            bounds=(1e-9, np.inf),
            neutral=np.inf,
            grid=30,
        ),
    }

    half: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        return (motion.command - motion.command / (1.0 + np.abs(motion.command) / nonlinear[0]),), (
            0.0,
        )


@in_library
@dataclass(frozen=True)
class DcMotor(JointTorqueEffect):
    """A DC motor of which the voltage is commanded, behind its gear: torque = kt / R
    (voltage - kt w).

    `torque_command` is then the torque at standstill, kt / R times the voltage, and what the
    motor's own voltage takes off it is the loss u = kt^2 / R w. A limited voltage is a limited
    command (`control.torque_limit`). A command of exactly zero is a drive that is switched off: the
    motor is open, and nothing brakes it.
    """

    description: ClassVar[str] = (
        "A motor that is driven by a voltage has less torque the faster it turns."
    )
    signature: ClassVar[str] = (
        "Torque rises linearly with the velocity, but not while the drive is switched off."
    )
    experiment: ClassVar[str] = (
        "Move each joint at several constant speeds, and let it swing with the drive switched off."
    )
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        # At the joint: of the motor's own constant, times the gear ratio.
        "kt": Parameter("Nm/A", linear=False, plausible=(1e-2, 20.0), neutral=0.0),
        "resistance": Parameter(
            "ohm", linear=False, plausible=(1e-2, 20.0), bounds=(1e-9, np.inf), neutral=np.inf
        ),
    }
    composite: ClassVar[bool] = True

    kt: dict[str, float] = field(default_factory=dict)
    resistance: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        kt, resistance = nonlinear
        damping = kt * kt / resistance * (np.asarray(motion.command) != 0)
        return (damping * motion.velocity,), (damping,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        kt, resistance = nonlinear
        return Rise(damping=kt * kt / resistance)
