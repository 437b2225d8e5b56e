"""Cases that nobody chose: a robot, how it moves, the noise of its torques and what is hidden in
it, drawn at random."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import exp, log

import numpy as np

from benchmarks.in_mujoco.cases import Case, run_and_judge, setting
from benchmarks.in_mujoco.loop import Run
from benchmarks.in_mujoco.physics import (
    AccelerometerBias,
    CentreOfMass,
    Drag,
    EncoderOffset,
    FootGain,
    GyroscopeBias,
    JointProperty,
    LongLink,
    Mass,
    Misalignment,
    MotorBias,
    MotorDelay,
    MotorGain,
    MotorLag,
    MotorLimit,
    MovedImu,
    Payload,
    Physics,
    Play,
    Ripple,
    Spring,
)
from fbse_drake.campaign.steps import Material
from fbse_drake.effects.geometry import LinkLength
from fbse_drake.effects.inertia import BodyCentreOfMass
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import build_robot
from fbse_drake.walking.reference import Reference

# So often nothing is hidden.
_DECOYS = 0.2
# Deviation of the torques' noise over the usual one.
_TORQUE_NOISE = (0.0, 0.0, 0.5, 1.0, 2.0)
# What is hidden in a joint takes such a share of the torque that its motion needs.
_SHARE = (0.02, 0.3)
# A joint moves if the deviation of its velocity is more than this [rad/s].
_MOVES = 0.1


def random_case(number: int) -> Case:
    """The case of this number: the same each time."""
    random = np.random.default_rng(number)
    robot = ("arm", "biped", "quadruped")[random.integers(3)]
    decoy = Case(
        f"random-{robot}-{number}",
        "decoy",
        robot,
        motion=number,
        overrides=_steps(random) if robot == "biped" else (),
        torque_noise=float(random.choice(_TORQUE_NOISE)),
    )
    if random.random() < _DECOYS:
        return decoy
    scenario, reference = setting(decoy)
    physics = _Draw(random, build_robot(scenario.believed), reference).physics()
    return replace(decoy, group="effect", physics=physics)


def judge(material: Material) -> dict[str, str]:
    """Runs the case of this number; see `benchmarks.store.Store`."""
    return run_and_judge(random_case(material.values["case"]["motion"]))


def _steps(random: np.random.Generator) -> tuple[str, ...]:
    """Other steps of the walk: lengths and heights [m], times of both supports [s]."""
    ranges = {
        "step_length": (0.03, 0.12),
        "step_height": (0.02, 0.05),
        "single_support": (0.5, 1.0),
        "double_support": (0.3, 0.8),
    }
    return tuple(f"reference.{key}={random.uniform(*ends):.3f}" for key, ends in ranges.items())


@dataclass(frozen=True)
class _Draw:
    """Draws physics that a robot shows along a motion."""

    random: np.random.Generator
    robot: Robot
    reference: Reference

    def physics(self) -> Physics:
        """Of any kind that the robot can have."""
        kinds = self._kinds
        return kinds[str(self.random.choice(list(kinds)))]()

    @cached_property
    def _joint(self) -> str:
        moving = self.reference.joint_velocity.std(axis=0) > _MOVES
        return str(self.random.choice(np.array(self.robot.joint_names)[moving]))

    @cached_property
    def _column(self) -> int:
        return self.robot.joint_names.index(self._joint)

    @cached_property
    def _torque(self) -> np.ndarray:
        """That the model needs in the joint, (N,) [Nm]."""
        return self.reference.feedforward_torque[:, self._column]

    @cached_property
    def _velocity(self) -> np.ndarray:
        return self.reference.joint_velocity[:, self._column]

    def _size(self, low: float, high: float) -> float:
        """Between these, as often in every octave."""
        return exp(self.random.uniform(log(low), log(high)))

    def _sign(self) -> float:
        return float(self.random.choice([-1.0, 1.0]))

    def _vector(self, size: float) -> tuple[float, float, float]:
        x, y, z = self.random.normal(size=3)
        length = np.linalg.norm([x, y, z])
        return float(size * x / length), float(size * y / length), float(size * z / length)

    def _loss(self) -> float:
        """Root mean square of what is hidden in the joint [Nm]."""
        return self._size(*_SHARE) * _rms(self._torque)

    def _rate(self, values: np.ndarray) -> float:
        return _rms(np.gradient(values, self.reference.time))

    def _body(self) -> str:
        return str(self.random.choice(BodyCentreOfMass.suspected_bodies(self.robot)))

    def _mass(self, body: str) -> float:
        return self._size(0.04, 0.6) * float(self.robot.body(body).default_mass())

    def _angles(self) -> tuple[float, float]:
        angle = self.reference.joint_position[:, self._column]
        return float(angle.min()), float(angle.max())

    @cached_property
    def _kinds(self) -> Mapping[str, Callable[[], Physics]]:
        on_a_base = self._of_base if self.robot.has_floating_base else self._of_arm
        return self._of_joint | self._of_body | on_a_base

    @property
    def _of_joint(self) -> dict[str, Callable[[], Physics]]:
        def friction() -> Physics:
            return JointProperty("dof_frictionloss", (self._joint,), self._loss())

        def damping() -> Physics:
            value = self._loss() / _rms(self._velocity)
            return JointProperty("dof_damping", (self._joint,), value)

        def armature() -> Physics:
            value = self._loss() / self._rate(self._velocity)
            return JointProperty("dof_armature", (self._joint,), value)

        def spring() -> Physics:
            low, high = self._angles()
            stiffness = self._loss() / max(high - low, 0.05)
            return Spring(self._joint, stiffness, rest=float(self.random.uniform(low, high)))

        def delay() -> Physics:
            value = min(self._loss() / self._rate(self._torque), 0.01)
            # Of whole steps of MuJoCo.
            step = Run.time_step
            return MotorDelay(self._joint, max(1, round(value / step)) * step)

        def limit() -> Physics:
            quantile = self.random.uniform(0.7, 0.97)
            return MotorLimit(self._joint, float(np.quantile(np.abs(self._torque), quantile)))

        return {
            "friction": friction,
            "damping": damping,
            "armature": armature,
            "spring": spring,
            "delay": delay,
            "limit": limit,
            "lag": lambda: MotorLag(
                self._joint, min(self._loss() / self._rate(self._torque), 0.01)
            ),
            "gain": lambda: MotorGain(self._joint, 1.0 + self._sign() * self._size(*_SHARE)),
            "bias": lambda: MotorBias(self._joint, self._sign() * self._loss()),
            "drag": lambda: Drag(self._joint, self._loss() / _rms(self._velocity**2)),
            "ripple": lambda: Ripple(
                self._joint, 1.4 * self._loss(), cycles=float(self.random.integers(6, 60))
            ),
            "play": lambda: Play(self._joint, self._size(2e-3, 1e-2)),
            "offset": lambda: EncoderOffset(self._joint, self._sign() * self._size(3e-3, 3e-2)),
        }

    @property
    def _of_body(self) -> dict[str, Callable[[], Physics]]:
        def mass() -> Physics:
            body = self._body()
            return Mass(body, self._mass(body))

        return {
            "mass": mass,
            "com": lambda: CentreOfMass(self._body(), self._vector(self._size(5e-3, 3e-2))),
        }

    @property
    def _of_base(self) -> dict[str, Callable[[], Physics]]:
        kinds: dict[str, Callable[[], Physics]] = {
            "accelerometer": lambda: AccelerometerBias(self._vector(self._size(0.05, 0.5))),
            "gyroscope": lambda: GyroscopeBias(self._vector(self._size(5e-3, 5e-2))),
            "misalignment": lambda: Misalignment(self._vector(self._size(5e-3, 5e-2))),
            "moved-imu": lambda: MovedImu(self._vector(self._size(0.01, 0.06))),
            "foot-gain": lambda: FootGain(
                str(self.random.choice(self.robot.description.sides)),
                1.0 + self._sign() * self._size(0.02, 0.15),
            ),
        }
        if links := LinkLength.suspected_bodies(self.robot):
            kinds["length"] = lambda: LongLink(
                str(self.random.choice(links)), self._sign() * self._size(2e-3, 8e-3)
            )
        return kinds

    @property
    def _of_arm(self) -> dict[str, Callable[[], Physics]]:
        def payload() -> Physics:
            body = self._body()
            return Payload(body, self._mass(body), self._vector(0.1))

        return {"payload": payload}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
