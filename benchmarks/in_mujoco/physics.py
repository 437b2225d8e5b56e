"""Physics that a robot in MuJoCo has beside its model: by MuJoCo's own means, or between
controller, motors and sensors.

None of it is made with `fbse_drake.effects`, whose names it only gives as the answer.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from fbse_drake.discrepancy.exercises.hidden import HiddenEffect
from fbse_drake.robot.plant import Robot

# Torques of the motors in a step of MuJoCo [Nm], from commands [Nm], joint positions [rad] and
# velocities [rad/s], (n,) each.
Drive = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Readings:
    """What sensors read over a run of N ticks, but for their noise, (N, 3) each, forces (N, P, 3)
    in the axes of the soles.
    """

    specific_force: np.ndarray
    angular_velocity: np.ndarray
    pad_force: np.ndarray


def _values(effect: str, targets: tuple[str, ...], size: float, **values: float) -> HiddenEffect:
    parameters = {name: dict.fromkeys(targets, value) for name, value in values.items()}
    return HiddenEffect(effect, targets, size, parameters)


@dataclass(frozen=True)
class Physics:
    """Base of the hidden physics; what it does not override stays as it is."""

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        """Effects of the library, each of which says it truly; none for a stranger."""
        return ()

    @property
    def targets(self) -> tuple[str, ...]:
        """Joints of what the library does not have."""
        return ()

    @property
    def imu_shift(self) -> tuple[float, float, float]:
        """How far the IMU is from where the model has it, in its axes [m]."""
        return (0.0, 0.0, 0.0)

    def edit(self, spec: mujoco.MjSpec) -> None:
        """Changes the robot before it is compiled."""

    def change(self, model: mujoco.MjModel) -> None:
        """Changes the compiled robot."""

    @property
    def behind(self) -> Mapping[str, str]:
        """See `benchmarks.in_mujoco.robot.Machine`."""
        return {}

    def drive(self, robot: Robot, time_step: float) -> Drive:
        """What the motors make of the commands."""
        del robot, time_step
        return lambda command, _position, _velocity: command

    def encoder(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """What the encoders read, (n,) [rad]."""
        del robot
        return q

    def read(self, robot: Robot, readings: Readings) -> Readings:
        """What the other sensors read."""
        del robot
        return readings


@dataclass(frozen=True)
class Nothing(Physics):
    """A decoy."""


@dataclass(frozen=True)
class JointProperty(Physics):
    """MuJoCo's `dof_damping`, `dof_frictionloss` or `dof_armature` of joints."""

    field: str
    joints: tuple[str, ...]
    value: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        effect, parameter = {
            "dof_damping": ("ViscousFriction", "viscous"),
            "dof_frictionloss": ("CoulombFriction", "coulomb"),
            "dof_armature": ("ReflectedInertia", "inertia"),
        }[self.field]
        return (_values(effect, self.joints, self.value, **{parameter: self.value}),)

    def change(self, model: mujoco.MjModel) -> None:
        for name in self.joints:
            getattr(model, self.field)[model.joint(name).dofadr[0]] += self.value


@dataclass(frozen=True)
class Spring(Physics):
    """MuJoCo's joint spring, at rest at an angle [rad]."""

    joint: str
    stiffness: float
    rest: float = 0.0

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        preload = -self.stiffness * self.rest
        values = {"stiffness": self.stiffness, "preload": preload}
        return (_values("JointSpring", (self.joint,), self.stiffness, **values),)

    def change(self, model: mujoco.MjModel) -> None:
        joint = model.joint(self.joint)
        model.jnt_stiffness[joint.id] = self.stiffness
        model.qpos_spring[joint.qposadr[0]] = self.rest


@dataclass(frozen=True)
class Mass(Physics):
    """A mass at the centre of mass of a body [kg]."""

    body: str
    mass: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("BodyMass", (self.body,), abs(self.mass), mass=self.mass),)

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.body(self.body).mass += self.mass


@dataclass(frozen=True)
class CentreOfMass(Physics):
    """A centre of mass that is moved in its body's frame [m]."""

    body: str
    shift: tuple[float, float, float]

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        values = dict(zip("xyz", self.shift, strict=True))
        size = float(np.linalg.norm(self.shift))
        return (_values("BodyCentreOfMass", (self.body,), size, **values),)

    def edit(self, spec: mujoco.MjSpec) -> None:
        body = spec.body(self.body)
        body.ipos = body.ipos + np.array(self.shift)


@dataclass(frozen=True)
class LongLink(Physics):
    """A link that is longer [m]: the body behind it is further away, and no mass is moved."""

    body: str
    length: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("LinkLength", (self.body,), abs(self.length), length=self.length),)

    def edit(self, spec: mujoco.MjSpec) -> None:
        (behind,) = spec.body(self.body).bodies
        behind.pos = behind.pos * (1.0 + self.length / np.linalg.norm(behind.pos))


@dataclass(frozen=True)
class Payload(Physics):
    """A ball that is fixed to a body off its centre of mass."""

    body: str
    mass: float
    place: tuple[float, float, float]
    radius: float = 0.05

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        place = dict(zip("xyz", self.place, strict=True))
        return (_values("Payload", (self.body,), self.mass, mass=self.mass, **place),)

    def edit(self, spec: mujoco.MjSpec) -> None:
        moment = 0.4 * self.mass * self.radius**2
        spec.body(self.body).add_body(
            name="payload",
            pos=self.place,
            # What is not given here is taken from `pos`.
            ipos=(0.0, 0.0, 0.0),
            mass=self.mass,
            inertia=[moment] * 3,
            explicitinertial=True,
        )


@dataclass(frozen=True)
class MotorGain(Physics):
    """The gain of MuJoCo's actuator."""

    joint: str
    gain: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        shortfall = 1.0 - self.gain
        return (_values("TorqueGain", (self.joint,), abs(shortfall), shortfall=shortfall),)

    def change(self, model: mujoco.MjModel) -> None:
        model.actuator_gainprm[model.actuator(self.joint).id, 0] = self.gain


@dataclass(frozen=True)
class MotorLag(Physics):
    """MuJoCo's actuator with a first-order filter [s]."""

    joint: str
    time_constant: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        value = self.time_constant
        return (_values("TorqueLag", (self.joint,), value, time_constant=value),)

    def edit(self, spec: mujoco.MjSpec) -> None:
        motor = spec.actuator(self.joint)
        motor.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        motor.dynprm[0] = self.time_constant


@dataclass(frozen=True)
class MotorDelay(Physics):
    """Commands that come late [s]."""

    joint: str
    delay: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("TorqueDelay", (self.joint,), self.delay, delay=self.delay),)

    def drive(self, robot: Robot, time_step: float) -> Drive:
        steps, column = round(self.delay / time_step), robot.joint_names.index(self.joint)
        waiting: deque[float] = deque()

        def torque(command: np.ndarray, *_motion: np.ndarray) -> np.ndarray:
            waiting.append(command[column])
            late = waiting.popleft() if len(waiting) > steps else waiting[0]
            return _with(command, column, late)

        return torque


@dataclass(frozen=True)
class MotorBias(Physics):
    """A constant torque that is missing [Nm]."""

    joint: str
    bias: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("TorqueBias", (self.joint,), abs(self.bias), bias=self.bias),)

    def drive(self, robot: Robot, time_step: float) -> Drive:
        del time_step
        column = robot.joint_names.index(self.joint)
        return lambda command, _position, _velocity: _with(
            command, column, command[column] - self.bias
        )


@dataclass(frozen=True)
class MotorLimit(Physics):
    """MuJoCo's limit of an actuator's force [Nm]."""

    joint: str
    limit: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("TorqueSaturation", (self.joint,), self.limit, limit=self.limit),)

    def edit(self, spec: mujoco.MjSpec) -> None:
        motor = spec.actuator(self.joint)
        motor.forcelimited = True
        motor.forcerange = [-self.limit, self.limit]


@dataclass(frozen=True)
class Ripple(Physics):
    """Cogging: torque that repeats with the joint's angle [Nm]."""

    joint: str
    amplitude: float
    cycles: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        values = {"sine": self.amplitude, "cosine": 0.0, "cycles": self.cycles}
        return (_values("TorqueRipple", (self.joint,), self.amplitude, **values),)

    def drive(self, robot: Robot, time_step: float) -> Drive:
        del time_step
        column = robot.joint_names.index(self.joint)
        return lambda command, position, _velocity: _with(
            command,
            column,
            command[column] - self.amplitude * np.sin(self.cycles * position[column]),
        )


@dataclass(frozen=True)
class Drag(Physics):
    """Resistance with the square of the velocity [Nm s^2/rad^2]."""

    joint: str
    drag: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("QuadraticDrag", (self.joint,), self.drag, drag=self.drag),)

    def drive(self, robot: Robot, time_step: float) -> Drive:
        del time_step
        column = robot.joint_names.index(self.joint)
        return lambda command, _position, velocity: _with(
            command,
            column,
            command[column] - self.drag * velocity[column] * abs(velocity[column]),
        )


@dataclass(frozen=True)
class Elasticity(Physics):
    """A spring joint behind the motor's, whose encoder is on the motor [Nm/rad], [Nm s/rad]."""

    joint: str
    stiffness: float
    damping: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        compliance = 1.0 / self.stiffness
        values = {"compliance": compliance, "time_constant": self.damping * compliance}
        return (_values("TransmissionElasticity", (self.joint,), compliance, **values),)

    def edit(self, spec: mujoco.MjSpec) -> None:
        _second_joint(spec, self.joint)

    def change(self, model: mujoco.MjModel) -> None:
        joint = model.joint(_behind(self.joint))
        model.jnt_stiffness[joint.id] = self.stiffness
        model.dof_damping[joint.dofadr[0]] = self.damping


@dataclass(frozen=True)
class Play(Physics):
    """A joint behind the motor's that turns freely in a gap [rad]; the encoder is on the link."""

    joint: str
    gap: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("Backlash", (self.joint,), self.gap, gap=self.gap),)

    @property
    def behind(self) -> Mapping[str, str]:
        return {self.joint: _behind(self.joint)}

    def edit(self, spec: mujoco.MjSpec) -> None:
        joint = _second_joint(spec, self.joint)
        joint.limited = True
        joint.range = [-0.5 * self.gap, 0.5 * self.gap]
        joint.solref_limit = [0.002, 1.0]
        joint.solimp_limit = [0.95, 0.99, 1e-4, 0.5, 2.0]


@dataclass(frozen=True)
class EncoderOffset(Physics):
    """An encoder reads too much [rad], also for the controller."""

    joint: str
    offset: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("EncoderOffset", (self.joint,), abs(self.offset), offset=self.offset),)

    def encoder(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        column = robot.joint_names.index(self.joint)
        return _with(q, column, q[column] + self.offset)


@dataclass(frozen=True)
class EncoderScale(Physics):
    """An encoder reads so many times the angle, but the right velocity: not in the library."""

    joint: str
    scale: float

    @property
    def targets(self) -> tuple[str, ...]:
        return (self.joint,)

    def encoder(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        column = robot.joint_names.index(self.joint)
        return _with(q, column, q[column] * self.scale)


@dataclass(frozen=True)
class ImuError(Physics):
    """Base of the errors of the IMU, a vector in its frame."""

    vector: tuple[float, float, float]
    # What the library calls it.
    effect: ClassVar[str]

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        values = dict(zip("xyz", self.vector, strict=True))
        return (_values(self.effect, ("robot",), float(np.linalg.norm(self.vector)), **values),)


@dataclass(frozen=True)
class AccelerometerBias(ImuError):
    """A bias [m/s^2]."""

    effect: ClassVar[str] = "AccelerometerBias"

    def read(self, robot: Robot, readings: Readings) -> Readings:
        del robot
        return replace(readings, specific_force=readings.specific_force + self.vector)


@dataclass(frozen=True)
class GyroscopeBias(ImuError):
    """A bias [rad/s]."""

    effect: ClassVar[str] = "GyroscopeBias"

    def read(self, robot: Robot, readings: Readings) -> Readings:
        del robot
        return replace(readings, angular_velocity=readings.angular_velocity + self.vector)


@dataclass(frozen=True)
class Misalignment(ImuError):
    """Axes that are turned by a rotation vector [rad]."""

    effect: ClassVar[str] = "ImuMisalignment"

    def read(self, robot: Robot, readings: Readings) -> Readings:
        del robot
        # From axes of the frame to those of the sensor.
        turn = Rotation.from_rotvec(self.vector).inv()
        return replace(
            readings,
            specific_force=turn.apply(readings.specific_force),
            angular_velocity=turn.apply(readings.angular_velocity),
        )


@dataclass(frozen=True)
class MovedImu(ImuError):
    """An IMU that sits elsewhere [m]."""

    effect: ClassVar[str] = "ImuPosition"

    @property
    def imu_shift(self) -> tuple[float, float, float]:
        return self.vector


@dataclass(frozen=True)
class FootGain(Physics):
    """The force sensors of a foot read so many times the force."""

    side: str
    gain: float

    @property
    def answers(self) -> tuple[HiddenEffect, ...]:
        return (_values("FootForceGain", (self.side,), abs(self.gain - 1), gain=self.gain - 1),)

    def read(self, robot: Robot, readings: Readings) -> Readings:
        force, first = readings.pad_force.copy(), 0
        for side, leg in robot.description.legs.items():
            if side == self.side:
                force[:, first : first + leg.points] *= self.gain
            first += leg.points
        return replace(readings, pad_force=force)


@dataclass(frozen=True)
class Tether(Physics):
    """A spring of MuJoCo's from a body to a point of the world [N/m]: not in the library."""

    body: str
    anchor: tuple[float, float, float]
    stiffness: float
    length: float
    # Joints that it loads; where the base floats, the body itself.
    joints: tuple[str, ...] = ()

    @property
    def targets(self) -> tuple[str, ...]:
        return self.joints or (self.body,)

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_site(name="anchor", pos=self.anchor)
        spec.body(self.body).add_site(name="tethered")
        tendon = spec.add_tendon(name="tether", springlength=[self.length, self.length])
        tendon.wrap_site("anchor")
        tendon.wrap_site("tethered")

    def change(self, model: mujoco.MjModel) -> None:
        model.tendon_stiffness[model.tendon("tether").id] = self.stiffness


def _behind(joint: str) -> str:
    return f"{joint}_behind"


def _second_joint(spec: mujoco.MjSpec, name: str) -> Any:
    """A joint of the same axis behind a joint, which keeps the rotor's inertia."""
    first = spec.joint(name)
    return first.parent.add_joint(
        name=_behind(name), type=mujoco.mjtJoint.mjJNT_HINGE, pos=first.pos, axis=first.axis
    )


def _with(values: np.ndarray, column: int, value: float) -> np.ndarray:
    result = values.copy()
    result[column] = value
    return result
