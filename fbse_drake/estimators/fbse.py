"""Foot base sensor estimation: the stages, wired."""

from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from fbse_drake.errors import InputError
from fbse_drake.estimators.attitude import AttitudeConfig
from fbse_drake.estimators.base_filter import InvariantFilter
from fbse_drake.estimators.base_state import AdaptiveLipm, ContactAided
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.floating_base import FloatingBaseModel
from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.estimators.joint_acceleration import (
    JointAccelerationConfig,
    JointAccelerationEstimator,
)
from fbse_drake.estimators.link_torque import LinkTorqueEstimator
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.recursive_least_squares import RecursiveLeastSquares
from fbse_drake.estimators.sensor_monitor import SensorMonitorConfig
from fbse_drake.estimators.support import MeasuredSupport, PlannedSupport, SupportConfig
from fbse_drake.estimators.whole_body import WholeBody
from fbse_drake.robot.description import RobotDescription

BaseStateConfig = InvariantFilter | AdaptiveLipm | ContactAided


@in_library
@dataclass(frozen=True)
class Fbse(Estimator):
    """Foot base sensor estimation.

    It goes by attitude, base state, joint accelerations and link torque to the friction. The
    defaults are the best variant of every stage; `scenarios/paper_walk_fbse.yaml` also has the
    paper's.
    """

    knows: ClassVar[str] = "inertia of all links"
    measures: ClassVar[str] = "IMU, foot forces"

    sensor_monitor: SensorMonitorConfig = field(default_factory=SensorMonitorConfig)
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)
    # !ContactAided or the paper's !AdaptiveLipm.
    base_state: BaseStateConfig = field(default_factory=InvariantFilter)
    # What is not given follows from the scenario's `sensors`.
    sensors: SensorBeliefs = field(default_factory=SensorBeliefs)
    # !MeasuredSupport or the paper's !PlannedSupport.
    support: SupportConfig = field(default_factory=MeasuredSupport)
    joint_acceleration: JointAccelerationConfig = field(default_factory=JointAccelerationConfig)
    # !WholeBody, !ModelAided or the paper's !RecursiveLeastSquares.
    friction: RecursiveLeastSquares | ModelAided | WholeBody = field(default_factory=WholeBody)

    @staticmethod
    def paper() -> "Fbse":
        """The paper's own method, stage by stage."""
        return Fbse(
            attitude=AttitudeConfig(level_feet=0.0),
            base_state=AdaptiveLipm(),
            sensors=SensorBeliefs(learns_force_noise=False),
            support=PlannedSupport(),
            joint_acceleration=JointAccelerationConfig(method="minimum_norm"),
            friction=RecursiveLeastSquares(),
        )

    @classmethod
    def variants(cls) -> dict[str, Estimator]:
        joint_by_joint = cls(friction=ModelAided())
        return {"": cls(), "joint by joint": joint_by_joint, "the paper's": cls.paper()}

    def believed_sensors(self, usual: SensorBeliefs) -> SensorBeliefs:
        return self.sensors.completed(usual)

    def remarks(self, sensors: SensorBeliefs) -> tuple[str, ...]:
        unused = "joint_acceleration" in self.friction.stands_for
        if unused and self.joint_acceleration != JointAccelerationConfig():
            which = type(self.friction).__name__
            return sensors.text, f"joint_acceleration: only used without torques, see !{which}"
        return (sensors.text,)

    def check(self, names: RobotDescription) -> None:
        self.friction.model.resolve(names, key="friction.model")

    def add(self, chain: Chain) -> None:
        self.add_base(chain)
        friction = self.friction
        if not chain.knows_torque or "joint_acceleration" not in friction.stands_for:
            self._add_joint_acceleration(chain)
        if not chain.knows_torque:
            return
        if "link_torque" not in friction.stands_for:
            self._add_link_torque(chain)
        make = partial(friction.system, chain.sensors, chain.robot)
        if friction.allows_for_effects and chain.torque_effects:
            make = partial(make, torque_effects=chain.torque_effects)
        chain.add("friction", make, **friction.sources)
        chain.friction_law = FrictionRegressor.of(friction.model, chain.robot)
        for stage in friction.stands_for:
            chain.alias("friction", stage)

    def _add_joint_acceleration(self, chain: Chain) -> None:
        config, robot = self.joint_acceleration, chain.robot
        chain.add(
            "joint_acceleration",
            partial(JointAccelerationEstimator, config, chain.sensors, robot),
            measurements="sensor_monitor",
            attitude="attitude",
            model_over_step="model.over_step",
        )

    def _add_link_torque(self, chain: Chain) -> None:
        asks_for_delay = self.base_state.feeds_back and self.friction.allows_for_delay
        chain.add(
            "link_torque",
            partial(LinkTorqueEstimator, chain.sensors, chain.robot),
            measurements="sensor_monitor",
            model_over_step="model.over_step",
            joint_acceleration="joint_acceleration",
            **({"base_state": "base_state"} if asks_for_delay else {}),
        )

    def add_base(self, chain: Chain) -> None:
        """Adds `sensor_monitor`, `model`, `attitude` and `base_state`, which chains share.

        Raises:
            InputError: a robot without a floating base and feet, or a planned support without a
                plan.
        """
        robot = chain.robot
        if not robot.has_floating_base or not robot.description.legs:
            raise InputError(
                "estimator: needs a robot with a floating base and feet (no gantry_height)"
            )
        stages = (self.sensor_monitor, self.support, self.attitude, self.base_state)
        chain.share(stages, partial(self._add_stages, chain))

    def _add_stages(self, chain: Chain) -> None:
        feeds_back = self.base_state.feeds_back
        self.sensor_monitor.add(chain, self.support, hears_doubt=feeds_back)
        make_model = partial(FloatingBaseModel, chain.robot, knows_bias=feeds_back)
        chain.add("model", make_model, measurements="sensor_monitor")
        self.base_state.add(chain, self.attitude, _middle_of_feet(chain))


def _middle_of_feet(chain: Chain) -> tuple[float, float]:
    """Where the middle of the soles is at the start, (x, y) [m]."""
    if chain.plan is None:
        return 0.0, 0.0
    sides = chain.robot.description.sides
    x, y = np.mean([chain.plan.feet[side].position[0, :2] for side in sides], axis=0)
    return float(x), float(y)
