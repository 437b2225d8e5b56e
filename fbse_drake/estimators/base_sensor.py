"""Friction of a fixed robot's joints from the wrench under its base, to be compared with others.

Base sensor control is where the idea of the paper comes from (Morel, Iagnemma and Dubowsky 2000;
paper Sec. 1.1). Newton and Euler go backwards from the base: what passes a joint to the links
beyond it is the wrench under the base less what moves, and carries, the links before it. So the
links beyond the joint, and what they hold, need not be known.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context, ValueProducer

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.estimators.recursive_least_squares import RecursiveLeastSquares
from fbse_drake.estimators.sensor_monitor import SensorMonitorConfig
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot
from fbse_drake.wiring import weakly


@in_library
@dataclass(frozen=True)
class BaseSensor(Estimator):
    """Friction by base sensor control, from `sensors: {more: {base: !BaseWrench {}}}`.

    What is measured goes through the same filter as FBSE's.
    """

    knows: ClassVar[str] = "inertia of the links before each joint"
    measures: ClassVar[str] = "wrench under a fixed base"

    # !ModelAided or the paper's !RecursiveLeastSquares.
    friction: RecursiveLeastSquares | ModelAided = field(default_factory=ModelAided)
    # Noise of the sensor as it is believed, standard deviation of force [N] and moment [Nm].
    force_noise: float = 0.5
    moment_noise: float = 0.05

    def __post_init__(self) -> None:
        require_positive(self, "force_noise", "moment_noise")

    def check(self, names: RobotDescription) -> None:
        self.friction.model.resolve(names, key="friction.model")

    def check_sensors(self, ports: Collection[str]) -> None:
        if "measured_base_wrench" not in ports:
            example = "sensors.more: {base: !BaseWrench {noise: 0.5}}"
            raise InputError(f"!BaseSensor needs a sensor under the base (as in {example})")

    def add(self, chain: Chain) -> None:
        robot, sensors = chain.robot, chain.sensors
        if robot.has_floating_base:
            raise InputError("estimator: !BaseSensor needs a robot whose base is fixed")
        SensorMonitorConfig().add(chain)
        velocity_noise = float(sensors.joint_velocity_noise or 0.0)
        make = partial(BaseSensorTorque, self, velocity_noise, robot)
        chain.add("link_torque", make, measurements="sensor_monitor")
        chain.add(
            "friction",
            partial(self.friction.system, sensors, robot),
            measurements="sensor_monitor",
            link_torque="link_torque",
        )


class Links(NamedTuple):
    """The links of a robot in a posture; wrenches and twists [angular, linear] about the world's
    origin in its axes."""

    # Momentum [Nm s, N s] of each of b links per velocity of each of n joints, (b, 6, n).
    momentum: np.ndarray
    # Wrench of gravity on each link [Nm, N], (b, 6).
    weight: np.ndarray
    # Twist of each joint per unit of its velocity, (n, 6).
    axes: np.ndarray


class LinkModel:
    """Links of a fixed robot, from Drake.

    `before` (n, b) is 1 where a link is not beyond a joint.
    """

    def __init__(self, robot: Robot):
        plant = robot.plant
        indices = plant.GetBodyIndices(robot.base.model_instance())
        self._robot = robot
        self._bodies = [
            plant.get_body(index) for index in indices if plant.get_body(index).default_mass() > 0
        ]
        self._carried = [
            plant.GetJointByName(name).child_body().index() for name in robot.joint_names
        ]
        context = plant.CreateDefaultContext()
        inertia = [body.CalcSpatialInertiaInBodyFrame(context) for body in self._bodies]
        self._mass = np.array([of.get_mass() for of in inertia])
        self._com = np.array([of.get_com() for of in inertia])
        self._inertia = np.array(
            [of.Shift(of.get_com()).CalcRotationalInertia().CopyToFullMatrix3() for of in inertia]
        )
        self._gravity = plant.gravity_field().gravity_vector()
        motors = [plant.GetJointActuatorByName(name) for name in self._motor_names()]
        self.rotor_inertia = np.array([motor.calc_reflected_inertia(context) for motor in motors])
        X_WB = robot.base.EvalPoseInWorld(context)
        self._R_WB, self._p_WB = X_WB.rotation().matrix(), X_WB.translation()
        moves = np.abs(self._twists(context)[0]).max(axis=1) > 0
        self.before = 1.0 - moves.T

    def _motor_names(self) -> list[str]:
        plant, names = self._robot.plant, self._robot.joint_names
        motors = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        # The first of a joint; further ones are its friction.
        by_joint: dict[str, str] = {}
        for motor in motors:
            by_joint.setdefault(motor.joint().name(), motor.name())
        return [by_joint[name] for name in names]

    def _twists(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Of links (b, 6, n) and joints (n, 6), about the world's origin."""
        plant, world = self._robot.plant, self._robot.plant.world_frame()
        links = {}
        for index in {*(body.index() for body in self._bodies), *self._carried}:
            body = plant.get_body(index)
            # Of the body's point that is where the world's origin is.
            origin: Any = np.zeros(3)
            place = plant.CalcPointsPositions(context, world, origin, body.body_frame())
            p_BoWo_B: Any = place.ravel()
            J = plant.CalcJacobianSpatialVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(), p_BoWo_B, world, world
            )
            links[index] = J[:, self._robot.velocity_index]
        axes = np.array([links[index][:, j] for j, index in enumerate(self._carried)])
        return np.array([links[body.index()] for body in self._bodies]), axes

    def links(self, context: Context) -> Links:
        """The links in the posture of a plant's context."""
        twists, axes = self._twists(context)
        poses = [body.EvalPoseInWorld(context) for body in self._bodies]
        R = np.array([X.rotation().matrix() for X in poses])
        c = np.array([X.translation() for X in poses])
        c = c + np.einsum("bij,bj->bi", R, self._com)
        w, v = twists[:, :3], twists[:, 3:]
        linear = self._mass[:, None, None] * (v + np.cross(w, c[:, :, None], axis=1))
        inertia = R @ self._inertia @ R.transpose(0, 2, 1)
        angular = inertia @ w + np.cross(c[:, :, None], linear, axis=1)
        pull = self._mass[:, None] * self._gravity
        return Links(
            np.concatenate([angular, linear], axis=1),
            np.concatenate([np.cross(c, pull), pull], axis=1),
            axes,
        )

    def about_the_origin(self, wrench: np.ndarray) -> np.ndarray:
        """A wrench at the base's origin in its axes, (6,), about the world's origin in its axes."""
        force = self._R_WB @ wrench[3:]
        moment = self._R_WB @ wrench[:3] + np.cross(self._p_WB, force)
        return np.concatenate([moment, force])


class BaseSensorTorque(RecursiveEstimator):
    """Torque that reaches the links, and what of the motor's torque does not, from the base.

    .. pydrake_system::

        name: BaseSensorTorque
        input_ports:
        - measurements
        - measured_base_wrench
        - torque_command
        output_ports:
        - posterior
        - (one for each field)

    `measurements` is the posterior of a `SensorMonitor`; `measured_base_wrench` (6,) [Nm, N] see
    `BaseReaction`. Over a tick of length T the torque of joint i is

        tau_i = s_i . (F_base - sum over the links before i of (change of momentum / T - weight))

    with its axis s_i and wrenches about the world's origin, where the tick began. No acceleration
    is needed. Fields are those of `LinkTorqueEstimator` that a friction filter takes, of the tick
    that ends now (`late` is 0), with `link_torque` (n,) [Nm]; and `momentum` (b, 6), `weight` (b,
    6) and `axes` (n, 6) of the links now, `velocity` (n,).
    """

    def __init__(
        self,
        config: BaseSensor,
        velocity_noise: float,
        robot: Robot,
        measurements: np.dtype,
        clock: Clock,
    ):
        """Declares ports and state.

        Args:
            velocity_noise: of the joints, standard deviation [rad/s].
            measurements: type of the input's posterior.
        """
        self._model, self._robot = LinkModel(robot), robot
        n, b = self._model.before.shape
        torques = ("link_torque", "residual", "torque_variance", "impulse_variance")
        of_joint = (*torques, "own_inertia", "valid", "velocity")
        kind = record_type(
            time=(),
            status=(),
            **dict.fromkeys(of_joint, (n,)),
            momentum=(b, 6),
            weight=(b, 6),
            axes=(n, 6),
            late=(),
            duration=(),
        )
        super().__init__(kind, clock)
        self._measurements = self._declare_record_input("measurements", measurements)
        self._wrench = self.DeclareVectorInputPort("measured_base_wrench", 6)
        self._torque_command = self._declare_remembered_input("torque_command", n)
        noise = np.repeat([config.moment_noise, config.force_noise], 3)
        self._to_origin = np.column_stack([self._model.about_the_origin(e) for e in np.eye(6)])
        self._wrench_variance, self._velocity_variance = noise**2, velocity_noise**2
        # Never computed anew: an entry of the cache is what a context can keep for itself.
        never: Any = ValueProducer.NoopCalc
        self._workspace = self.DeclareCacheEntry(
            "workspace", ValueProducer(weakly(self._allocate), never), {self.nothing_ticket()}
        )
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        n, feet = len(robot.joint_names), len(robot.description.sides)
        measured = record_type(trust=(2 + feet,), joint_position=(n,), joint_velocity=(n,))
        return {"measurements": measured}

    def _allocate(self) -> AbstractValue:
        return AbstractValue.Make(self._robot.plant.CreateDefaultContext())

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, model = self._measurements.Eval(context), self._model
        command: np.ndarray = self._torque_command.Eval(context)
        wrench: Any = self._wrench.Eval(context)
        posterior[...] = last
        posterior["status"] = measured["trust"][0]
        if not math.isfinite(wrench.dot(wrench) + command.dot(command)):
            posterior["status"] = float(Status.NOT_FINITE)
        plant_context: Any = self._workspace.Eval(context)
        self._robot.set_joint_positions(plant_context, measured["joint_position"])
        links, velocity = model.links(plant_context), measured["joint_velocity"]
        posterior["momentum"] = links.momentum @ velocity
        posterior["weight"], posterior["axes"] = links.weight, links.axes
        posterior["velocity"], posterior["valid"] = velocity, 0.0
        # The momentum is differentiated: both ends of the tick must be trusted.
        if math.isnan(elapsed) or posterior["status"] or last["status"]:
            return
        axes, rate = last["axes"], (posterior["momentum"] - last["momentum"]) / elapsed
        passed = model.about_the_origin(wrench) - model.before @ (rate - last["weight"])
        rotors = model.rotor_inertia
        link_torque = (axes * passed).sum(axis=1)
        acceleration = (velocity - last["velocity"]) / elapsed
        posterior["link_torque"] = link_torque
        posterior["residual"] = command - link_torque - rotors * acceleration
        posterior["torque_variance"] = (axes @ self._to_origin) ** 2 @ self._wrench_variance
        # What the velocities' noise makes of the momentum of the links before each joint.
        before = np.einsum("nb,bkj->nkj", model.before, links.momentum)
        to_velocity = np.diag(rotors) - np.einsum("nk,nkj->nj", axes, before)
        posterior["impulse_variance"] = self._velocity_variance * (to_velocity**2).sum(axis=1)
        posterior["own_inertia"] = np.diag(to_velocity)
        posterior["valid"], posterior["duration"] = 1.0, elapsed
