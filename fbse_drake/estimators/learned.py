"""Friction laws that are learned while the robot moves, to be compared with FBSE.

A law is linear in its parameters, u = phi(w, memory) theta for each joint. What it is learned from
is the filtered equation of motion: the momentum observer gives the friction behind a low-pass
without any acceleration, and the regressor goes through the same low-pass, so that both sides of
phi_f theta = u_f are the same filter's outputs (Middleton and Goodwin 1988; the part of Slotine and
Li's composite adaptation, 1989, that goes by the prediction error). The law itself, which knows no
delay, is the estimate.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import require_positive
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.estimator import Estimator
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.robot.plant import Robot


@dataclass(frozen=True)
class LearnedFriction(Estimator):
    """Base of the learned laws: a frozen dataclass with their settings.

    Regressors are without unit, so that all parameters are torques.
    """

    knows: ClassVar[str] = "inertia of all links"
    measures: ClassVar[str] = "IMU, foot forces"
    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {
        "bandwidth": (2.0, 100.0),
        "rate": (1.0, 1000.0),
    }

    # Bandwidth of the low-pass that the equation of motion goes through [Hz].
    bandwidth: float = 20.0
    # How fast parameters follow what the motion shows [1/s].
    rate: float = 80.0
    # No parameter is larger than this [Nm].
    largest: float = 50.0

    def __post_init__(self) -> None:
        require_positive(self, "bandwidth", "rate", "largest")

    @property
    @abstractmethod
    def parameters(self) -> int:
        """How many a joint has."""

    @property
    def memory(self) -> int:
        """How many numbers a joint's law remembers."""
        return 0

    @property
    def smallest(self) -> float:
        """No parameter is smaller than this [Nm]."""
        return -self.largest

    @abstractmethod
    def regressor(
        self, velocity: np.ndarray, memory: np.ndarray, elapsed: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The law at the end of a tick.

        Args:
            velocity: of the joints (n,) [rad/s].
            memory: of the tick before, (n, memory).
            elapsed: length of the tick [s].

        Returns:
            phi (n, parameters), and the memory (n, memory).
        """

    def add(self, chain: Chain) -> None:
        DisturbanceObserver(self.bandwidth).add_observer(chain, "momentum_observer")
        chain.add(
            "friction",
            partial(self.learner, chain.robot),
            measurements="sensor_monitor",
            disturbance="momentum_observer",
        )

    def learner(self, robot: Robot, **arguments: Any) -> "FrictionLearner":
        """What learns its parameters; arguments as of its class."""
        return FrictionLearner(self, robot, **arguments)


class FrictionLearner(RecursiveEstimator):
    """Learns the parameters of a friction law, joint by joint.

    .. pydrake_system::

        name: FrictionLearner
        input_ports:
        - measurements
        - disturbance
        output_ports:
        - posterior
        - (one for each field)

    `measurements` is the posterior of a `SensorMonitor`, `disturbance` that of a
    `MomentumObserver` of the law's bandwidth. Fields: `friction` (n,) [Nm], `parameters` (n, k)
    [Nm], `regressor` (n, k) behind the low-pass, `memory` (n, m).

    The normalised gradient, theta += rate dt phi_f e / (1 + rate dt phi_f phi_f) with
    e = u_f - phi_f theta, is stable at any rate, and without noise no step of it moves the
    parameters away from the true ones (Goodwin and Sin 1984, Sec. 3.3); nor does the projection
    onto the range that they are known to be in. They come to the true ones only if the motion
    excites all of them.
    """

    def __init__(
        self,
        config: LearnedFriction,
        robot: Robot,
        measurements: np.dtype,
        disturbance: np.dtype,
        clock: Clock,
        **fields: tuple[int, ...],
    ):
        """Declares ports and state.

        Args:
            measurements, disturbance: types of the inputs.
            fields: of a learner with more than these, their shapes.
        """
        n, k = len(robot.joint_names), config.parameters
        kind = record_type(
            time=(),
            status=(),
            friction=(n,),
            parameters=(n, k),
            regressor=(n, k),
            memory=(n, config.memory),
            **fields,
        )
        super().__init__(kind, clock)
        self._law = config
        self._pole = 2 * np.pi * config.bandwidth
        self._measurements = self._declare_record_input("measurements", measurements)
        self._disturbance = self._declare_record_input("disturbance", disturbance)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        n, feet = len(robot.joint_names), len(robot.description.sides)
        return {
            "measurements": record_type(trust=(2 + feet,), joint_velocity=(n,)),
            "disturbance": record_type(status=(), friction=(n,)),
        }

    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        measured, disturbance = self._measurements.Eval(context), self._disturbance.Eval(context)
        posterior[...] = last
        posterior["status"] = disturbance["status"]
        if np.isnan(elapsed) or measured["trust"][0]:
            return
        phi, memory = self._law.regressor(measured["joint_velocity"], last["memory"], elapsed)
        keep = np.exp(-self._pole * elapsed)
        filtered = keep * last["regressor"] + (1 - keep) * phi
        posterior["regressor"], posterior["memory"] = filtered, memory
        if not disturbance["status"]:
            self._learn(last, disturbance["friction"], elapsed, posterior)
        posterior["friction"] = (phi * posterior["parameters"]).sum(axis=1)

    def _learn(
        self, last: np.ndarray, torque: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        """Fills the parameters of a tick, and what else there is to learn.

        Args:
            last: posterior of the tick before, of which the present one is a copy but for its
                regressor.
            torque: the friction behind the low-pass, (n,) [Nm].
        """
        law, phi = self._law, posterior["regressor"]
        theta = learned(last["parameters"], phi, torque, law.rate * elapsed)
        posterior["parameters"] = theta.clip(law.smallest, law.largest)


def learned(
    parameters: np.ndarray, regressor: np.ndarray, torque: np.ndarray, gain: float
) -> np.ndarray:
    """One step of the normalised gradient, (n, k).

    Args:
        parameters, regressor: (n, k).
        torque: that regressor times parameters is to be, (n,).
        gain: rate times length of the step.
    """
    error = torque - (regressor * parameters).sum(axis=1)
    size = (regressor * regressor).sum(axis=1)
    return parameters + (gain * error / (1.0 + gain * size))[:, None] * regressor
