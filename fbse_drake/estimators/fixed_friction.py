"""Friction by a model with known parameters, to be compared with estimates."""

from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, cast

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.effects.joint_torque import JointMotion
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.identification import identify
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.estimators.sensor_monitor import SensorMonitorConfig
from fbse_drake.log import Log
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot

# Beginning of a log that is not identified from [s].
_SETTLING_TIME = 0.5


@in_library
@dataclass(frozen=True)
class FixedFriction(Estimator):
    """A friction model with known parameters, evaluated at the measured velocity.

    They are had from another walk beforehand, as `identified` does with the measured friction.
    """

    knows: ClassVar[str] = "the friction law, identified beforehand"
    measures: ClassVar[str] = "nothing, once it is identified"

    # The law, with its values.
    model: FrictionModel = field(default_factory=CoulombViscousFriction)

    def identified(self, log: Log) -> "FixedFriction":
        """The Coulomb and viscous friction of a log, behind the filters' settling."""
        rows = log.time > log.time[0] + _SETTLING_TIME
        found = identify(
            CoulombViscousFriction,
            log.joints,
            log["joint/velocity"][rows],
            log["estimate/joint/residual_torque"][rows],
        )
        return FixedFriction(cast(CoulombViscousFriction, found.config()))

    def check(self, names: RobotDescription) -> None:
        self.model.resolve(names, key="model")

    def add(self, chain: Chain) -> None:
        SensorMonitorConfig().add(chain)
        make = partial(FixedFrictionModel, self, chain.robot)
        chain.add("friction", make, measurements="sensor_monitor")


class FixedFrictionModel(RecursiveEstimator):
    """Friction of a fixed model at the measured velocity.

    .. pydrake_system::

        name: FixedFrictionModel
        input_ports:
        - measurements
        output_ports:
        - posterior
        - (one for each field)

    `measurements` is the posterior of a `SensorMonitor`; field `friction` (n,) [Nm].
    """

    def __init__(self, config: FixedFriction, robot: Robot, measurements: np.dtype, clock: Clock):
        n = len(robot.joint_names)
        super().__init__(record_type(time=(), status=(), friction=(n,)), clock)
        self._model = config.model.resolve(robot.description, key="estimator.model")
        self._measurements = self._declare_record_input("measurements", measurements)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        n, feet = len(robot.joint_names), len(robot.description.sides)
        return {"measurements": record_type(trust=(2 + feet,), joint_velocity=(n,))}

    def _tick(
        self,
        context: Context,
        last: np.ndarray,  # noqa: ARG002
        elapsed: float,  # noqa: ARG002
        posterior: np.ndarray,
    ) -> None:
        measured = self._measurements.Eval(context)
        torque, _ = self._model.torque_and_slope(JointMotion(measured["joint_velocity"]))
        posterior["status"], posterior["friction"] = measured["trust"][0], torque
