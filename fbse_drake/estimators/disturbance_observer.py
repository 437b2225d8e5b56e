"""Friction by a disturbance observer on the momentum, to be compared with FBSE."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import require_positive
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.floating_base import model_type
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches


@in_library
@dataclass(frozen=True)
class DisturbanceObserver(Estimator):
    """Momentum-based disturbance observer of a floating-base robot (De Luca et al. 2006).

    It has the contact wrenches from the foot sensors.
    """

    # Bandwidth of the observer [Hz].
    bandwidth: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "bandwidth")

    def add(self, chain: Chain) -> None:
        self.add_observer(chain, "friction")

    def add_observer(self, chain: Chain, name: str) -> None:
        """Adds the observer, and before it what it needs, see `Fbse.add_base`."""
        Fbse().add_base(chain)
        chain.add(
            name,
            partial(MomentumObserver, self, chain.robot),
            measurements="sensor_monitor",
            attitude="attitude",
            base_state="base_state",
            model="model",
            model_at_step_start="model.at_step_start",
        )


class MomentumObserver(RecursiveEstimator):
    """Disturbance observer on the generalized momentum of the joints, p = H v.

    .. pydrake_system::

        name: MomentumObserver
        input_ports:
        - measurements
        - attitude
        - base_state
        - model
        - model_at_step_start
        - torque_command
        output_ports:
        - posterior
        - (one for each field)

    Posteriors as for FBSE; the base's velocity is the estimated one, accelerations are not used at
    all. The observer integrates u_dot = K (tau + J^T F + beta - p_dot - u), with
    beta = H_dot v - C v - g, so that u is the friction behind a low-pass of first order. Fields:
    `friction` (n,) [Nm], `momentum` (n,) [Nm s].
    """

    def __init__(
        self,
        config: DisturbanceObserver,
        robot: Robot,
        measurements: np.dtype,
        attitude: np.dtype,
        base_state: np.dtype,
        model: np.dtype,
        model_at_step_start: np.dtype,
        clock: Clock,
    ):
        """Declares ports and state.

        Args:
            measurements, attitude, base_state, model, model_at_step_start: types of the inputs.
        """
        n = len(robot.joint_names)
        super().__init__(record_type(time=(), status=(), friction=(n,), momentum=(n,)), clock)
        self._gain = 2 * math.pi * config.bandwidth
        self._gravity = robot.plant.gravity_field().gravity_vector()
        self._pads, self._feet = FootPads(robot), len(robot.description.sides)
        inputs = {
            "measurements": measurements,
            "attitude": attitude,
            "base_state": base_state,
            "model": model,
            "model_at_step_start": model_at_step_start,
        }
        self._inputs = [self._declare_record_input(name, kind) for name, kind in inputs.items()]
        self._torque_command = self._declare_remembered_input("torque_command", n)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        return {
            "measurements": measurements_type(robot),
            "attitude": record_type(rotation=(3, 3)),
            "base_state": record_type(base_velocity=(3,)),
            "model": model_type(robot),
            "model_at_step_start": model_type(robot),
        }

    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        records = (port.Eval(context) for port in self._inputs)
        measured, attitude, base_state, model, start = records
        R_WB = attitude["rotation"]
        v_B = R_WB.T @ base_state["base_velocity"]
        velocity = model["velocity"].copy()
        velocity[3:6] = v_B
        M, M_start = model["mass_matrix"], start["mass_matrix"]
        momentum = M @ velocity
        applied = self._torque_command.Eval(context).copy()
        trust = float(Status.NOT_FINITE)
        if math.isfinite(applied.dot(applied)):
            trust = max(measured["trust"].tolist())
        posterior["status"], posterior["momentum"] = trust, momentum
        # The momentum is differentiated: both ends of the tick must be trusted.
        if math.isnan(elapsed) or trust or last["status"]:
            posterior["friction"] = last["friction"]
            return
        # Components in base axes, which turn: their rate has -w x v besides the acceleration.
        turning = np.cross(velocity[:3], v_B)
        gravity = M_start[:, 3:6] @ (R_WB.T @ self._gravity)
        beta = (M - M_start) @ velocity / elapsed - M_start[:, 3:6] @ turning
        beta = beta - start["bias"] + gravity
        J = start["foot_jacobian"].reshape(6 * self._feet, -1)[:, 6:]
        pads = self._pads
        wrench = foot_wrenches(measured["pad_force"], pads.position, pads.foot, self._feet)
        applied += wrench.ravel() @ J
        rate = (momentum - last["momentum"]) / elapsed
        keep = math.exp(-self._gain * elapsed)
        u = last["friction"]
        posterior["friction"] = keep * u + (1 - keep) * (applied + beta - rate)
