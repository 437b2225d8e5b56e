"""What happens in the walks that methods are compared on: what they are told, and what not."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from fbse_drake.effects.effect import Effect, Parameter
from fbse_drake.effects.friction import smooth_sign
from fbse_drake.effects.inertia import BodyMass
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, Rise, law_over_time
from fbse_drake.robot.description import load_description
from fbse_drake.robot.plant import make_robot
from fbse_drake.robot.push import Push
from fbse_drake.scenario import RobotConfig, Scenario

# The robot's bodies are heavier than the model's by this share.
_EXCESS = 0.05
# Biases of the IMU's axes [m/s^2], [rad/s].
_ACCELERATION_BIAS, _RATE_BIAS = [0.3, -0.3, 0.3], [0.05, -0.05, 0.05]
# A push changes the robot's velocity by this [m/s], within this time [s].
_PUSH, _PUSH_TIME = 0.03, 0.1
# Friction grows by this share of what it is at this velocity [rad/s].
_GROWTH, _TYPICAL_SPEED = 0.5, 0.1
# Velocity over which it changes its sign [rad/s].
_TRANSITION = np.array(0.01)
# The ground is tilted by this about the sideways axis [rad]: 2 deg.
_SLOPE = 0.0349


@dataclass(frozen=True)
class SuddenFriction(JointTorqueEffect):
    """Coulomb friction from some time on: u = coulomb tanh(w / 0.01 rad/s) for t >= begin.

    It is none of the library, for a diagnosis has no use for it.
    """

    description: ClassVar[str] = "Friction that begins at some time."
    signature: ClassVar[str] = "Torque against the motion from some time on."
    experiment: ClassVar[str] = "Walk for long."
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "begin": Parameter("s", linear=False, plausible=(0.1, 1000.0)),
    }

    coulomb: dict[str, float] = field(default_factory=dict)
    begin: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        begun = np.asarray(motion.time >= nonlinear[0], dtype=float)
        sign, slope = smooth_sign(motion.velocity, _TRANSITION)
        return (begun * sign,), (begun * slope,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(speeds=(_TRANSITION,))


def _as_told(scenario: Scenario) -> Scenario:
    return scenario


def _heavier(scenario: Scenario) -> Scenario:
    robot, _ = make_robot(scenario.robot.description)
    excess = {body: _EXCESS * robot.body(body).default_mass() for body in robot.body_names}
    return _with_effect(scenario, BodyMass(mass=excess))


def _biased(scenario: Scenario) -> Scenario:
    imu = replace(
        scenario.sensors.imu,
        acceleration_bias=_ACCELERATION_BIAS,
        angular_velocity_bias=_RATE_BIAS,
    )
    return replace(scenario, sensors=replace(scenario.sensors, imu=imu))


def _pushed(scenario: Scenario) -> Scenario:
    robot, _ = make_robot(scenario.robot.description)
    mass = robot.total_mass
    force = [0.0, mass * _PUSH / _PUSH_TIME, 0.0]
    push = Push(robot.base.name(), force, scenario.duration / 2, _PUSH_TIME)
    return replace(scenario, robot=replace(scenario.robot, pushes={"push": push}))


def _growing(scenario: Scenario) -> Scenario:
    names, _ = load_description(scenario.robot.description)
    effects = scenario.robot.effects_of(JointTorqueEffect, names, key="robot")
    speed = np.full((1, len(names.joint_names)), _TYPICAL_SPEED)
    (friction,) = law_over_time(effects, JointMotion(speed, np.zeros_like(speed)))
    sizes = dict(zip(names.joint_names, (_GROWTH * np.abs(friction)).tolist(), strict=True))
    middle = {"all": scenario.duration / 2}
    return _with_effect(scenario, SuddenFriction(sizes, middle))


def _sloped(scenario: Scenario) -> Scenario:
    return replace(scenario, ground=replace(scenario.ground, slope=[0.0, _SLOPE]))


def _with_effect(scenario: Scenario, effect: Effect) -> Scenario:
    robot = scenario.robot
    effects = robot.effects | {f"of_the_case_{len(robot.effects)}": effect}
    return replace(scenario, robot=replace(robot, effects=effects))


NOMINAL = "as believed"
# What really happens, of which nobody is told; by name.
CASES: dict[str, Callable[[Scenario], Scenario]] = {
    NOMINAL: _as_told,
    "bodies 5 % heavier": _heavier,
    "biased IMU": _biased,
    "a push": _pushed,
    "friction grows by half": _growing,
    "slope of 2 deg": _sloped,
}


def without_friction(scenario: Scenario) -> Scenario:
    """The same robot without its joint torque effects."""
    robot: RobotConfig = scenario.robot
    kept = {
        name: effect
        for name, effect in robot.effects.items()
        if not isinstance(effect, JointTorqueEffect)
    }
    return replace(scenario, robot=replace(robot, effects=kept))
