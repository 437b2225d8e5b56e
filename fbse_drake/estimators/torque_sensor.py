"""Friction from joint torque sensors, to be compared with estimates that go without."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator


@in_library
@dataclass(frozen=True)
class TorqueSensor(Estimator):
    """Friction from joint torque sensors (`sensors.joint_torque`).

    It is the command minus the measured link torque, low-passed.
    """

    knows: ClassVar[str] = "nothing"
    measures: ClassVar[str] = "torque behind each joint"
    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {"cutoff": (2.0, 200.0)}

    # Cut-off of the low-pass of first order [Hz].
    cutoff: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "cutoff")

    def check_sensors(self, ports: Collection[str]) -> None:
        if "measured_torque" not in ports:
            example = "sensors.joint_torque: {noise: 0.3}"
            raise InputError(f"!TorqueSensor needs sensors.joint_torque (as in {example})")

    def add(self, chain: Chain) -> None:
        n = len(chain.robot.joint_names)
        chain.add("friction", partial(TorqueSensorEstimator, self, n))


class TorqueSensorEstimator(RecursiveEstimator):
    """Friction from joint torque sensors.

    .. pydrake_system::

        name: TorqueSensorEstimator
        input_ports:
        - measured_torque
        - torque_command
        output_ports:
        - posterior
        - (one for each field)

    `measured_torque` (n,) [Nm] is the link torque over the tick that ends now; field `friction`
    (n,) [Nm].
    """

    def __init__(self, config: TorqueSensor, joints: int, clock: Clock):
        super().__init__(record_type(time=(), status=(), friction=(joints,)), clock)
        self._rate = 2 * math.pi * config.cutoff
        self._measured = self.DeclareVectorInputPort("measured_torque", joints)
        self._torque_command = self._declare_remembered_input("torque_command", joints)
        self._declare_posterior()

    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        if math.isnan(elapsed):
            posterior[...] = last
            return
        residual = self._torque_command.Eval(context) - self._measured.Eval(context)
        keep = math.exp(-self._rate * elapsed)
        posterior["status"] = 0.0
        posterior["friction"] = keep * last["friction"] + (1 - keep) * residual
