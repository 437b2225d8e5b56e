"""Effects in sensors: what is read beside the truth.

The same lines distort the readings of a simulation, tick by tick, and those of a whole log, where the diagnosis asks what an effect would
have added.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State
from scipy.spatial.transform import Rotation

from fbse_drake.effects.effect import Effect, Parameter, ResolvedEffect, in_library
from fbse_drake.robot.plant import Robot

_ANY = (-np.inf, np.inf)


@dataclass(frozen=True)
class SensorSignals:
    """What the sensors measure; any leading axes (time). IMU signals in the IMU frame, forces in the sole frames."""

    # Shape (..., n) [rad], [rad/s].
    joint_position: np.ndarray
    joint_velocity: np.ndarray
    # Shape (..., 3) [m/s^2], [rad/s].
    specific_force: np.ndarray
    angular_velocity: np.ndarray
    # All pads, side by side in the description's order, shape (..., P, 3) [N].
    pad_force: np.ndarray
    # Of the step that begins, shape (..., n) [Nm].
    torque_command: np.ndarray


@dataclass(frozen=True)
class SensorEffect(Effect):
    """Base of the sensor effects.

    A subclass gives `reading`. One that depends on the past, on torque commands for instance, sets `memory_size` and gives `remembered`;
    its memory is 0 at first.
    """

    # Numbers that it remembers for each target.
    memory_size: ClassVar[int] = 0

    @staticmethod
    @abstractmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:
        """What the sensors read if this is what they ought to read.

        Args:
            signals: any leading axes. The reading must not depend on `torque_command`, which is only known after it.
            memory: what is remembered from the ticks before, shape (memory_size, ..., targets).
        """

    @staticmethod
    def remembered(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, period: float) -> np.ndarray:
        """The memory at the next tick, shape (memory_size, targets).

        Args:
            signals: of one tick, without leading axes, before the effect.
            memory: of that tick.
            period: time from tick to tick [s].
        """
        raise NotImplementedError

    @classmethod
    def memory_over_time(cls, signals: SensorSignals, values: ResolvedEffect, period: float) -> np.ndarray:
        """What is remembered at each tick of a log, shape (memory_size, ticks, targets).

        Args:
            signals: what the sensors ought to read, with the ticks as the leading axis.
            values: the parameters.
            period: time from tick to tick [s].
        """
        ticks = len(signals.joint_position)
        memory = np.zeros((cls.memory_size, ticks, len(values.targets)))
        if cls.memory_size:
            for k in range(ticks - 1):
                tick = SensorSignals(*(channel[k] for channel in vars(signals).values()))
                memory[:, k + 1] = cls.remembered(tick, memory[:, k], values, period)
        return memory

    @classmethod
    def distorted(cls, signals: SensorSignals, values: ResolvedEffect, robot: Robot, period: float) -> SensorSignals:
        """What the sensors read over a whole log; see `memory_over_time` and `reading`."""
        return cls.reading(signals, cls.memory_over_time(signals, values, period), values, robot)


def _pads_of(values: np.ndarray, robot: Robot) -> np.ndarray:
    """Values for each pad from those for each foot, (..., feet) -> (..., P)."""
    return np.repeat(values, [leg.points for leg in robot.description.legs.values()], axis=-1)


@in_library
@dataclass(frozen=True)
class FootForceGain(SensorEffect):
    """The force sensors of a foot read (1 + gain) times the force."""

    description: ClassVar[str] = "The force sensors of a foot read a share more or less than the force."
    signature: ClassVar[str] = "The feet seem to carry more or less than the weight, in proportion to the load on the one foot."
    experiment: ClassVar[str] = "Shift the weight slowly from foot to foot."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "foot"
    parameters: ClassVar[dict[str, Parameter]] = {"gain": Parameter("1", linear=True, plausible=(-0.2, 0.2), bounds=(-1.0, np.inf))}

    gain: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:  # noqa: ARG004
        gain = _pads_of(values.linear[0], robot)
        return replace(signals, pad_force=(1.0 + gain[:, None]) * signals.pad_force)


@in_library
@dataclass(frozen=True)
class FootForceBias(SensorEffect):
    """Each pad of a foot reads this force too much, in the axes of the sole."""

    description: ClassVar[str] = "The force sensors of a foot read a constant force too much."
    signature: ClassVar[str] = "Force on the foot while it is in the air."
    experiment: ClassVar[str] = "Lift each foot."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "foot"
    parameters: ClassVar[dict[str, Parameter]] = {axis: Parameter("N", linear=True, plausible=(-20.0, 20.0), bounds=_ANY) for axis in "xyz"}

    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:  # noqa: ARG004
        return replace(signals, pad_force=signals.pad_force + _pads_of(values.linear, robot).T)


@in_library
@dataclass(frozen=True)
class AccelerometerBias(SensorEffect):
    """The accelerometer reads this specific force too much, in the IMU frame."""

    description: ClassVar[str] = "The accelerometer reads a constant too much."
    signature: ClassVar[str] = "A specific force at rest that is not gravity; a trunk that seems tilted."
    experiment: ClassVar[str] = "Stand still on level ground, then with the trunk turned or tilted."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("m/s^2", linear=True, plausible=(-0.5, 0.5), bounds=_ANY) for axis in "xyz"
    }

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @staticmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:  # noqa: ARG004
        return replace(signals, specific_force=signals.specific_force + values.linear[:, 0])


@in_library
@dataclass(frozen=True)
class GyroscopeBias(SensorEffect):
    """The gyroscope reads this rate too much, in the IMU frame."""

    description: ClassVar[str] = "The gyroscope reads a constant rate too much."
    signature: ClassVar[str] = "Standing feet seem to turn at a constant rate."
    experiment: ClassVar[str] = "Stand still."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("rad/s", linear=True, plausible=(-0.05, 0.05), bounds=_ANY) for axis in "xyz"
    }

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @staticmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:  # noqa: ARG004
        return replace(signals, angular_velocity=signals.angular_velocity + values.linear[:, 0])


@in_library
@dataclass(frozen=True)
class ImuMisalignment(SensorEffect):
    """The IMU's axes are turned against the IMU frame by this rotation vector; both of its sensors read in the turned axes.

    As a rotation it is linear for small angles only.
    """

    description: ClassVar[str] = "The IMU is mounted askew."
    signature: ClassVar[str] = "A trunk that seems tilted at rest, and turns about axes that seem turned."
    experiment: ClassVar[str] = "Stand still on level ground; sway and turn for the angle about the vertical."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("rad", linear=True, plausible=(-0.05, 0.05), bounds=(-np.pi, np.pi)) for axis in "xyz"
    }

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @staticmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:  # noqa: ARG004
        # S: the axes that the sensors really have.
        R_IS = Rotation.from_rotvec(values.linear[:, 0]).as_matrix()
        return replace(signals, specific_force=signals.specific_force @ R_IS, angular_velocity=signals.angular_velocity @ R_IS)


@in_library
@dataclass(frozen=True)
class EncoderOffset(SensorEffect):
    """The encoder of a joint reads this angle too much."""

    description: ClassVar[str] = "The zero of a joint's encoder is off."
    signature: ClassVar[str] = "Gravity torques of another posture, and feet that do not fit the ground: tilted while they stand flat."
    experiment: ClassVar[str] = "Stand in several postures; squat and sway."
    parameters: ClassVar[dict[str, Parameter]] = {"offset": Parameter("rad", linear=True, plausible=(-0.01, 0.01), bounds=_ANY)}

    offset: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:  # noqa: ARG004
        return replace(signals, joint_position=signals.joint_position + values.linear[0])


@in_library
@dataclass(frozen=True)
class TransmissionElasticity(SensorEffect):
    """A massless damped spring between motor and joint, with the encoder on the motor's side: it reads q + d, where

    time_constant d_dot = compliance * command - d

    The command is held from tick to tick, and the solution is exact. A loop of derivative gain kd over such an encoder needs
    kd * compliance < time_constant.
    """

    description: ClassVar[str] = "The transmission twists under torque, and the encoder sits on the motor's side of it."
    signature: ClassVar[str] = "Joint angles off in proportion to the torque command; a foot that stands seems to give way under load."
    experiment: ClassVar[str] = "Stand on one leg and shift the weight, or squat: large torques with little motion."
    parameters: ClassVar[dict[str, Parameter]] = {
        "compliance": Parameter("rad/Nm", linear=True, plausible=(1e-5, 1e-4)),
        "time_constant": Parameter("s", linear=False, plausible=(4e-3, 2e-2), bounds=(1e-6, np.inf)),
    }
    memory_size: ClassVar[int] = 2

    compliance: dict[str, float] = field(default_factory=dict)
    time_constant: dict[str, float] = field(default_factory=lambda: {"all": 5e-3})

    @staticmethod
    def reading(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot) -> SensorSignals:  # noqa: ARG004
        (compliance,), (time_constant,) = values.linear, values.nonlinear
        followed, command = memory
        return replace(
            signals,
            joint_position=signals.joint_position + compliance * followed,
            joint_velocity=signals.joint_velocity + compliance * (command - followed) / time_constant,
        )

    @staticmethod
    def remembered(signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, period: float) -> np.ndarray:
        """Torque that the spring has followed so far, and the command of the tick's step, (2, n) [Nm]."""
        command = signals.torque_command
        return np.stack([command + (memory[0] - command) * np.exp(-period / values.nonlinear[0]), command])


class SensorEffects(LeafSystem):
    """Distorts the readings of the sensors by effects, one after the other.

    .. pydrake_system::

        name: SensorEffects
        input_ports:
        - joint_state
        - imu
        - pad_force
        - torque_command
        output_ports:
        - measured

    `joint_state` is [positions, velocities], shape (2n,) [rad, rad/s]; `imu` [specific force, angular velocity], shape (6,)
    [m/s^2, rad/s]; `pad_force` three components pad by pad [N]; `torque_command` (n,) [Nm]. `measured` is [joint_state, imu, pad_force] as
    read; it does not depend on the command of its own tick, which is computed from it. Discrete state: each effect's memory.
    """

    def __init__(self, effects: Sequence[ResolvedEffect], robot: Robot, period: float):
        """Declares ports, state and the update.

        Args:
            effects: sensor effects.
            robot: whose sensors these are.
            period: of the control [s].
        """
        super().__init__()
        n, pads = len(robot.joint_names), len(_pads_of(np.zeros(len(robot.description.sides)), robot))
        self._effects, self._robot, self._period = list(effects), robot, period
        sizes = {"joint_state": 2 * n, "imu": 6, "pad_force": 3 * pads}
        self._readings = [self.DeclareVectorInputPort(name, size) for name, size in sizes.items()]
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        self._memories = [self.DeclareDiscreteState(effect.effect.memory_size * len(effect.targets)) for effect in effects]
        sources = {self.input_port_ticket(port.get_index()) for port in self._readings} | {self.xd_ticket()}
        self.DeclareVectorOutputPort("measured", sum(sizes.values()), self._calc, sources)
        if any(effect.effect.memory_size for effect in effects):
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._remember)

    def _signals(self, context: Context, torque_command: np.ndarray) -> SensorSignals:
        joint_state, imu, pad_force = (port.Eval(context) for port in self._readings)
        position, velocity = np.split(joint_state, 2)
        return SensorSignals(position, velocity, imu[:3], imu[3:], pad_force.reshape(-1, 3), torque_command)

    def _memory(self, context: Context, place: int) -> np.ndarray:
        values = context.get_discrete_state(self._memories[place]).value()
        return values.reshape(-1, len(self._effects[place].targets))

    def _calc(self, context: Context, output: BasicVector) -> None:
        signals = self._signals(context, np.full(self._torque_command.size(), np.nan))
        for place, effect in enumerate(self._effects):
            signals = effect.effect.reading(signals, self._memory(context, place), effect, self._robot)
        read = (signals.joint_position, signals.joint_velocity, signals.specific_force, signals.angular_velocity, signals.pad_force.ravel())
        output.SetFromVector(np.concatenate(read))

    def _remember(self, context: Context, state: State) -> None:
        signals = self._signals(context, self._torque_command.Eval(context))
        for place, effect in enumerate(self._effects):
            memory = self._memory(context, place)
            if effect.effect.memory_size:
                later = effect.effect.remembered(signals, memory, effect, self._period)
                state.get_mutable_discrete_state(self._memories[place]).set_value(later.ravel())
            signals = effect.effect.reading(signals, memory, effect, self._robot)
