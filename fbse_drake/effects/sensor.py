"""Effects in sensors: what is read beside the truth.

The same lines distort the readings of a simulation, tick by tick, and those of a whole log, where
the diagnosis asks what an effect would have added.
"""

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from fbse_drake.effects.effect import Effect, Parameter, ResolvedEffect, in_library
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot

_ANY = (-np.inf, np.inf)
# How much larger an offset of an encoder may be where nobody would fall by it.
_UNHOMED = 10.0
# An effect that has no opposite is taken off the signals until they would be read as they were but
# for this share of the largest reading, and so often at most.
_UNDONE, _MOST_UNDOINGS = 1e-9, 50
# Of what is measured a sensor reads this share at least, or it is not to be had from the readings.
_LEAST_READ = 1e-3


@dataclass(frozen=True)
class SensorSignals:
    """What the sensors measure; any leading axes (time). IMU signals in the IMU frame, forces in
    the sole frames."""

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
    # Of second encoders, on the motors' side, shape (..., n) [rad]; (..., 0) where there are none.
    motor_position: np.ndarray
    # Torque that passed the gears as the step before began and as it ended, linear in between,
    # shape (..., n) each [Nm]: the command less what friction, other effects and the rotors'
    # acceleration took of it.
    load_begin: np.ndarray
    load_end: np.ndarray


@dataclass(frozen=True)
class SensorEffect(Effect):
    """Base of the sensor effects.

    A subclass gives `reading`. One that depends on the past, on torque commands for instance, sets
    `memory_size` and gives `remembered`; its memory is 0 at first.
    """

    # Numbers that it remembers for each target.
    memory_size: ClassVar[int] = 0

    @classmethod
    def follows_load(cls) -> bool:
        """Does a joint's reading follow what passes its gear? The noise of that is in it then."""
        return cls.memory_size > 0 and cls.acts_on == "joint"

    @staticmethod
    @abstractmethod
    def reading(
        signals: SensorSignals, memory: np.ndarray, values: ResolvedEffect, robot: Robot
    ) -> SensorSignals:
        """What the sensors read if this is what they ought to read.

        Args:
            signals: any leading axes. The reading must not depend on `torque_command`, which is
                only known after it.
            memory: what is remembered from the ticks before, shape (memory_size, ..., targets).
        """

    @staticmethod
    def remembered(
        signals: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,
        robot: Robot,
        period: float,
    ) -> np.ndarray:
        """The memory at the next tick, shape (memory_size, targets).

        Args:
            signals: of one tick, without leading axes, before the effect.
            memory: of that tick.
            period: time from tick to tick [s].
        """
        raise NotImplementedError

    @classmethod
    def memory_over_time(
        cls, signals: SensorSignals, values: ResolvedEffect, robot: Robot, period: float
    ) -> np.ndarray:
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
                memory[:, k + 1] = cls.remembered(tick, memory[:, k], values, robot, period)
        return memory

    @staticmethod
    def opposite(linear: np.ndarray) -> np.ndarray | None:  # noqa: ARG004
        """Linear parameters with which the effect undoes itself with these, (p, targets); None
        where there are none."""
        return None

    @classmethod
    def undone(
        cls,
        measured: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,
        robot: Robot,
        period: float,  # noqa: ARG003
    ) -> SensorSignals:
        """What the sensors ought to read over a whole log if this is what they read.

        By the effect's opposite; without one by taking off, again and again, what the effect adds:
        it is small, and each time leaves a share of its own size.

        Args:
            measured: with the ticks as the leading axis.
            memory: what is remembered at each tick; see `memory_over_time`.
        """
        opposite = cls.opposite(values.linear)
        if opposite is not None:
            return cls.reading(measured, memory, replace(values, linear=opposite), robot)
        signals = measured
        for _ in range(_MOST_UNDOINGS):
            read = vars(cls.reading(signals, memory, values, robot))
            # What it does not distort is what was measured.
            off = {
                name: getattr(measured, name) - read[name]
                for name, signal in vars(signals).items()
                if read[name] is not signal
            }
            if not any(_differs(off[name], getattr(measured, name)) for name in off):
                break
            signals = replace(
                signals, **{name: getattr(signals, name) + more for name, more in off.items()}
            )
        return signals

    @classmethod
    def undone_now(
        cls,
        measured: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,
        robot: Robot,
        period: float,
    ) -> SensorSignals:
        """What the sensors ought to read at one tick if this is what they read.

        Args:
            measured: of one tick, without leading axes.
            memory: of that tick, see `remembered`.
        """
        of_log = SensorSignals(*(channel[None] for channel in vars(measured).values()))
        undone = cls.undone(of_log, memory[:, None], values, robot, period)
        return SensorSignals(*(channel[0] for channel in vars(undone).values()))

    @classmethod
    def distorted(
        cls, signals: SensorSignals, values: ResolvedEffect, robot: Robot, period: float
    ) -> SensorSignals:
        """What the sensors read over a whole log; see `memory_over_time` and `reading`."""
        return cls.reading(
            signals, cls.memory_over_time(signals, values, robot, period), values, robot
        )

    def resolve(
        self, names: RobotDescription, *, key: str = "", is_change: bool = False
    ) -> "ResolvedSensorEffect":
        """See `Effect.resolve`."""
        resolved = super().resolve(names, key=key, is_change=is_change)
        return ResolvedSensorEffect(
            type(self), resolved.targets, resolved.linear, resolved.nonlinear
        )


@dataclass(frozen=True)
class ResolvedSensorEffect(ResolvedEffect):
    """A sensor effect with values per target."""

    effect: type[SensorEffect]


def _wrenches(pad_force: np.ndarray, robot: Robot) -> np.ndarray:
    """Wrench [moment, force] on each foot in its sole frame, (..., feet, 6) [Nm, N], from
    (..., P, 3)."""
    parts, start = [], 0
    for grasp in robot.grasp_maps:
        stop = start + grasp.shape[1] // 3
        parts.append(pad_force[..., start:stop, :].reshape(*pad_force.shape[:-2], -1) @ grasp.T)
        start = stop
    return np.stack(parts, axis=-2)


def _with_wrenches(signals: SensorSignals, added: np.ndarray, robot: Robot) -> SensorSignals:
    """Signals with wrenches (..., feet, 6) added to those on the feet, by the smallest forces that
    have them."""
    forces = [
        added[..., foot, :] @ np.linalg.pinv(grasp).T for foot, grasp in enumerate(robot.grasp_maps)
    ]
    more = np.concatenate([force.reshape(*force.shape[:-1], -1, 3) for force in forces], axis=-2)
    return replace(signals, pad_force=signals.pad_force + more)


def _pads_of(values: np.ndarray, robot: Robot) -> np.ndarray:
    """Values for each pad from those for each foot, (..., feet) -> (..., P)."""
    return np.repeat(values, [leg.points for leg in robot.description.legs.values()], axis=-1)


class ShiftOrTurn(SensorEffect):
    """Base of effects that add to readings or turn their axes."""

    @staticmethod
    def opposite(linear: np.ndarray) -> np.ndarray:
        return -linear


class Gain(SensorEffect):
    """Base of effects by which a sensor reads (1 + gain) times what it measures."""

    @staticmethod
    def opposite(linear: np.ndarray) -> np.ndarray:
        return 1.0 / np.maximum(1.0 + linear, _LEAST_READ) - 1.0


@in_library
@dataclass(frozen=True)
class FootForceGain(Gain):
    """The force sensors of a foot read (1 + gain) times the force."""

    description: ClassVar[str] = (
        "The force sensors of a foot read a share more or less than the force."
    )
    signature: ClassVar[str] = (
        "The feet seem to carry more or less than the weight, in proportion to the load on the one "
        "foot."
    )
    experiment: ClassVar[str] = "Shift the weight slowly from foot to foot."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "foot"
    parameters: ClassVar[dict[str, Parameter]] = {
        "gain": Parameter(
            "1", linear=True, plausible=(-0.2, 0.2), bounds=(-1.0, np.inf), everything=-1.0
        )
    }

    gain: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,
    ) -> SensorSignals:
        gain = _pads_of(values.linear[0], robot)
        return replace(signals, pad_force=(1.0 + gain[:, None]) * signals.pad_force)


@in_library
@dataclass(frozen=True)
class FootForceBias(ShiftOrTurn):
    """Each pad of a foot, or its six-axis sensor, reads this force too much, in the axes of the
    sole."""

    description: ClassVar[str] = "The force sensors of a foot read a constant force too much."
    signature: ClassVar[str] = "Force on the foot while it is in the air."
    experiment: ClassVar[str] = "Lift each foot."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "foot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("N", linear=True, plausible=(-20.0, 20.0), bounds=_ANY, belief=20.0)
        for axis in "xyz"
    }

    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,
    ) -> SensorSignals:
        has_pads = np.array([not leg.has_six_axes for leg in robot.description.legs.values()])
        signals = replace(
            signals, pad_force=signals.pad_force + _pads_of(has_pads * values.linear, robot).T
        )
        if has_pads.all():
            return signals
        return _with_wrenches(
            signals,
            np.concatenate([np.zeros_like(values.linear), ~has_pads * values.linear]).T,
            robot,
        )


@in_library
@dataclass(frozen=True)
class FootMomentBias(ShiftOrTurn):
    """The force sensors of a foot together read this moment too much, about the origin of the sole
    and in its axes."""

    description: ClassVar[str] = "The force sensors of a foot read a constant moment too much."
    signature: ClassVar[str] = "Moment on the foot while it is in the air."
    experiment: ClassVar[str] = "Lift each foot."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "foot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("Nm", linear=True, plausible=(-5.0, 5.0), bounds=_ANY, belief=5.0)
        for axis in "xyz"
    }

    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,
    ) -> SensorSignals:
        return _with_wrenches(
            signals, np.concatenate([values.linear, np.zeros_like(values.linear)]).T, robot
        )


@in_library
@dataclass(frozen=True)
class FootForceMisalignment(ShiftOrTurn):
    """The force sensors of a foot are turned against the sole by this rotation vector, about its
    origin; force and moment are read in the turned axes. As a rotation it is linear for small
    angles only.
    """

    description: ClassVar[str] = "The force sensors of a foot are mounted askew."
    signature: ClassVar[str] = (
        "Horizontal force under a foot in proportion to its load, that no motion needs."
    )
    experiment: ClassVar[str] = "Stand still on level ground, on one foot and then on the other."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "foot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter(
            "rad", linear=True, plausible=(-0.1, 0.1), bounds=(-np.pi, np.pi), belief=0.1
        )
        for axis in "xyz"
    }

    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,
    ) -> SensorSignals:
        wrenches = _wrenches(signals.pad_force, robot)
        # S: the axes that the sensors really have.
        R_FS = Rotation.from_rotvec(values.linear.T).as_matrix()
        turned = np.einsum(
            "...fki,fij->...fkj", wrenches.reshape(*wrenches.shape[:-1], 2, 3), R_FS
        ).reshape(wrenches.shape)
        return _with_wrenches(signals, turned - wrenches, robot)


@in_library
@dataclass(frozen=True)
class FootForceLag(SensorEffect):
    """The wrench that the force sensors of a foot read follows the true one through a low-pass of
    first order.

    In steps of the sampling period, so that a log shows the time constant linearly: the true wrench
    is the one that is read, plus time_constant times its rate.
    """

    description: ClassVar[str] = (
        "The force sensors of a foot are read through a low-pass, and so come late."
    )
    signature: ClassVar[str] = (
        "Force under the foot that lags behind what the motion needs, and is smoother, at "
        "touch-down most of all."
    )
    experiment: ClassVar[str] = "Shift the weight to and fro fast; step on the spot."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "foot"
    parameters: ClassVar[dict[str, Parameter]] = {
        "time_constant": Parameter("s", linear=True, plausible=(0.0, 0.1))
    }
    # The wrench that was read last, and the share of it that stays.
    memory_size: ClassVar[int] = 7

    time_constant: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,  # noqa: ARG004
        robot: Robot,
    ) -> SensorSignals:
        read_last, stays = np.moveaxis(memory[:6], 0, -1), memory[6][..., None]
        return _with_wrenches(
            signals, stays * (read_last - _wrenches(signals.pad_force, robot)), robot
        )

    @classmethod
    def remembered(
        cls,
        signals: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,
        robot: Robot,
        period: float,
    ) -> np.ndarray:
        read = _wrenches(cls.reading(signals, memory, values, robot).pad_force, robot)
        return np.concatenate([read.T, [_what_stays(values.linear[0], period)]])

    @classmethod
    def memory_over_time(
        cls, signals: SensorSignals, values: ResolvedEffect, robot: Robot, period: float
    ) -> np.ndarray:
        true, stays = _wrenches(signals.pad_force, robot), _what_stays(values.linear[0], period)
        memory = np.zeros((cls.memory_size, *true.shape[:2]))
        for foot, share in enumerate(stays):
            read = lfilter(
                [1.0 - share], [1.0, -share], true[:, foot], axis=0, zi=share * true[:1, foot]
            )[0]
            memory[:6, 1:, foot], memory[6, 1:, foot] = read[:-1].T, share
        return memory

    @classmethod
    def undone(
        cls,
        measured: SensorSignals,
        memory: np.ndarray,  # noqa: ARG003
        values: ResolvedEffect,
        robot: Robot,
        period: float,
    ) -> SensorSignals:
        read, stays = (
            _wrenches(measured.pad_force, robot),
            _what_stays(values.linear[0], period)[:, None],
        )
        return _with_wrenches(
            measured, stays / (1.0 - stays) * np.diff(read, axis=0, prepend=read[:1]), robot
        )

    @classmethod
    def undone_now(
        cls,
        measured: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,  # noqa: ARG003
        robot: Robot,
        period: float,  # noqa: ARG003
    ) -> SensorSignals:
        read_last, stays = np.moveaxis(memory[:6], 0, -1), memory[6][..., None]
        rise = _wrenches(measured.pad_force, robot) - read_last
        return _with_wrenches(measured, stays / (1.0 - stays) * rise, robot)


def _what_stays(time_constant: np.ndarray, period: float) -> np.ndarray:
    """Share of what a low-pass of first order holds that is left after a period, as by an implicit
    Euler step."""
    return time_constant / (time_constant + period)


@in_library
@dataclass(frozen=True)
class AccelerometerGain(Gain):
    """The accelerometer reads (1 + gain) times the specific force."""

    description: ClassVar[str] = (
        "The accelerometer reads a share more or less than the specific force."
    )
    signature: ClassVar[str] = (
        "A resting robot whose specific force is not gravity, in whatever way it is tilted."
    )
    experiment: ClassVar[str] = "Stand still, then with the trunk tilted."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        "gain": Parameter("1", linear=True, plausible=(-0.05, 0.05), bounds=(-1.0, np.inf))
    }

    gain: float = 0.0

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
    ) -> SensorSignals:
        return replace(signals, specific_force=(1.0 + values.linear[0, 0]) * signals.specific_force)


@in_library
@dataclass(frozen=True)
class AccelerometerBias(ShiftOrTurn):
    """The accelerometer reads this specific force too much, in the IMU frame."""

    description: ClassVar[str] = "The accelerometer reads a constant too much."
    signature: ClassVar[str] = (
        "A specific force at rest that is not gravity; a trunk that seems tilted."
    )
    experiment: ClassVar[str] = "Stand still on level ground, then with the trunk turned or tilted."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("m/s^2", linear=True, plausible=(-0.5, 0.5), bounds=_ANY, belief=0.5)
        for axis in "xyz"
    }

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
    ) -> SensorSignals:
        return replace(signals, specific_force=signals.specific_force + values.linear[:, 0])


@in_library
@dataclass(frozen=True)
class GyroscopeBias(ShiftOrTurn):
    """The gyroscope reads this rate too much, in the IMU frame."""

    description: ClassVar[str] = "The gyroscope reads a constant rate too much."
    signature: ClassVar[str] = "Standing feet seem to turn at a constant rate."
    experiment: ClassVar[str] = "Stand still."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("rad/s", linear=True, plausible=(-0.05, 0.05), bounds=_ANY, belief=0.05)
        for axis in "xyz"
    }

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
    ) -> SensorSignals:
        return replace(signals, angular_velocity=signals.angular_velocity + values.linear[:, 0])


@in_library
@dataclass(frozen=True)
class ImuMisalignment(ShiftOrTurn):
    """The IMU's axes are turned against the IMU frame by this rotation vector; both of its sensors
    read in the turned axes.

    As a rotation it is linear for small angles only.
    """

    description: ClassVar[str] = "The IMU is mounted askew."
    signature: ClassVar[str] = (
        "A trunk that seems tilted at rest, and turns about axes that seem turned."
    )
    experiment: ClassVar[str] = (
        "Stand still on level ground; sway and turn for the angle about the vertical."
    )
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter(
            "rad", linear=True, plausible=(-0.05, 0.05), bounds=(-np.pi, np.pi), belief=0.05
        )
        for axis in "xyz"
    }

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
    ) -> SensorSignals:
        # S: the axes that the sensors really have.
        R_IS = Rotation.from_rotvec(values.linear[:, 0]).as_matrix()
        return replace(
            signals,
            specific_force=signals.specific_force @ R_IS,
            angular_velocity=signals.angular_velocity @ R_IS,
        )


@in_library
@dataclass(frozen=True)
class EncoderOffset(ShiftOrTurn):
    """The encoder of a joint reads this angle too much."""

    description: ClassVar[str] = "The zero of a joint's encoder is off."
    signature: ClassVar[str] = (
        "Gravity torques of another posture, and feet that do not fit the ground: tilted while "
        "they stand flat."
    )
    experiment: ClassVar[str] = "Stand in several postures; squat and sway."
    parameters: ClassVar[dict[str, Parameter]] = {
        "offset": Parameter("rad", linear=True, plausible=(-0.01, 0.01), bounds=_ANY)
    }

    offset: dict[str, float] = field(default_factory=dict)

    @classmethod
    def parameters_on(cls, robot: Robot, target: str) -> dict[str, Parameter]:
        """A machine on a fixed base moves all the same where its joints were not homed; a robot on
        its feet would fall."""
        parameters = super().parameters_on(robot, target)
        if robot.has_floating_base:
            return parameters
        return {name: parameter.enlarged(_UNHOMED) for name, parameter in parameters.items()}

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
    ) -> SensorSignals:
        return replace(signals, joint_position=signals.joint_position + values.linear[0])


@in_library
@dataclass(frozen=True)
class MotorEncoderOffset(ShiftOrTurn):
    """The second encoder of a joint, on the motor's side, reads this angle too much."""

    description: ClassVar[str] = (
        "The zero of a joint's second encoder, on the motor's side, is not that of the first."
    )
    signature: ClassVar[str] = "The angles of motor and link differ by a constant."
    experiment: ClassVar[str] = "Load each joint in one direction and in the other."
    needs_motor: ClassVar[bool] = True
    needs_motor_encoder: ClassVar[bool] = True
    # Where a motor stands as it is switched on may be its zero.
    parameters: ClassVar[dict[str, Parameter]] = {
        "offset": Parameter("rad", linear=True, plausible=(-np.pi, np.pi), bounds=_ANY)
    }

    offset: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,  # noqa: ARG004
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
    ) -> SensorSignals:
        motors = signals.motor_position.shape[-1]
        read = signals.motor_position + values.linear[0, :motors]
        return replace(signals, motor_position=read)


@in_library
@dataclass(frozen=True)
class TransmissionElasticity(ShiftOrTurn):
    """A massless damped spring between gear and link, with the encoder on the motor's side: it
    reads q + d, where

    time_constant d_dot = compliance * load - d

    The load is the torque that reaches the link: the command less what motor and gear take of it,
    friction and the rotor's acceleration (Spong 1987; the link moves as if the joint were rigid).
    With encoders on both sides the second one reads this, and the first the link's angle. The load
    is linear in time within a step, and the solution is exact. A loop of derivative gain kd over
    such an encoder needs kd * compliance < time_constant.
    """

    description: ClassVar[str] = (
        "The transmission twists under torque, and the encoder sits on the motor's side of it."
    )
    signature: ClassVar[str] = (
        "Joint angles off in proportion to the torque behind the friction; a foot that stands "
        "seems to give way under load."
    )
    experiment: ClassVar[str] = (
        "Stand on one leg and shift the weight, or squat: large torques with little motion."
    )
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        # From stiff harmonic drives to series elastic actuators.
        "compliance": Parameter("rad/Nm", linear=True, plausible=(1e-5, 1e-3)),
        "time_constant": Parameter(
            "s", linear=False, plausible=(4e-3, 2e-2), bounds=(1e-6, np.inf)
        ),
    }
    # The load that the spring followed at the tick before, and what `_following` gives.
    memory_size: ClassVar[int] = 3

    compliance: dict[str, float] = field(default_factory=dict)
    time_constant: dict[str, float] = field(default_factory=lambda: {"all": 5e-3})

    @staticmethod
    def reading(
        signals: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
    ) -> SensorSignals:
        (compliance,), (time_constant,) = values.linear, values.nonlinear
        followed = _followed(signals, memory)
        if signals.motor_position.shape[-1]:
            twisted = signals.motor_position + compliance * followed
            return replace(signals, motor_position=twisted)
        rate = (signals.load_end - followed) / time_constant
        return replace(
            signals,
            joint_position=signals.joint_position + compliance * followed,
            joint_velocity=signals.joint_velocity + compliance * rate,
        )

    @staticmethod
    def remembered(
        signals: SensorSignals,
        memory: np.ndarray,
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG004
        period: float,
    ) -> np.ndarray:
        return np.stack([_followed(signals, memory), *_following(values.nonlinear[0], period)])

    @classmethod
    def memory_over_time(
        cls,
        signals: SensorSignals,
        values: ResolvedEffect,
        robot: Robot,  # noqa: ARG003
        period: float,
    ) -> np.ndarray:
        begin, end = signals.load_begin, signals.load_end
        stays, behind = _following(values.nonlinear[0], period)
        memory = np.zeros((cls.memory_size, *end.shape))
        memory[1, 1:], memory[2, 1:] = stays, behind
        # Before the first tick it followed at once.
        driven = (behind - stays) * begin + (1.0 - behind) * end
        driven[0] = end[0]
        for joint, share in enumerate(stays):
            memory[0, 1:, joint] = lfilter([1.0], [1.0, -share], driven[:-1, joint])
        return memory


def _followed(signals: SensorSignals, memory: np.ndarray) -> np.ndarray:
    """Load that a spring has followed so far, (..., n) [Nm]."""
    before, stays, behind = memory
    begin, end = signals.load_begin, signals.load_end
    return stays * before + (behind - stays) * begin + (1.0 - behind) * end


def _following(time_constant: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """How a low-pass of first order follows what is linear in time over a period: share of where
    it was that stays, and by what share of the change it is behind in the end, had it begun where
    that began."""
    stays = np.exp(-period / time_constant)
    return stays, (1.0 - stays) * time_constant / period


def _differs(difference: np.ndarray, measured: np.ndarray) -> bool:
    """Is a reading another one than what was measured, beyond rounding? What is not a number is
    left as it is."""
    largest = np.fmax.reduce(np.abs(measured), axis=None, initial=0.0)
    return bool((np.abs(difference) > _UNDONE * largest).any())
