"""Other ways to have the friction, in the place of FBSE, to be compared with it."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Context, State

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.effects.joint_torque import JointMotion
from fbse_drake.errors import require_positive
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches


@dataclass(frozen=True)
class NoEstimator:
    """Nobody knows the friction; the estimate is zero."""


@dataclass(frozen=True)
class TrueFriction:
    """The friction that acted in the last tick, as only a simulation can tell (oracle)."""


@dataclass(frozen=True)
class TorqueSensor:
    """Friction from joint torque sensors (`sensors.joint_torque`).

    It is the command minus the measured link torque, low-passed.
    """

    # Cut-off of the low-pass of first order [Hz].
    cutoff: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "cutoff")


@dataclass(frozen=True)
class DisturbanceObserver:
    """Momentum-based disturbance observer of a floating-base robot (De Luca et al. 2006).

    It has the contact wrenches from the foot sensors.
    """

    # Bandwidth of the observer [Hz].
    bandwidth: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "bandwidth")


@dataclass(frozen=True)
class FixedFriction:
    """A friction model with known parameters, evaluated at the measured velocity."""

    model: FrictionModel = field(default_factory=CoulombViscousFriction)


class TrueFrictionSource(RecursiveEstimator):
    """The oracle.

    .. pydrake_system::

        name: TrueFrictionSource
        input_ports:
        - torque_loss
        output_ports:
        - posterior
        - (one for each field)

    `torque_loss` (n,) [Nm] and field `friction` (n,) are those of the step that ends now.
    """

    def __init__(self, joints: int, clock: Clock):
        super().__init__(record_type(time=(), status=(), friction=(joints,)), clock)
        self._torque_loss = self.DeclareVectorInputPort("torque_loss", joints)
        self._declare_posterior("torque_loss")

    def _tick(
        self,
        context: Context,
        last: np.ndarray,  # noqa: ARG002
        elapsed: float,  # noqa: ARG002
        posterior: np.ndarray,
    ) -> None:
        posterior["status"], posterior["friction"] = 0.0, self._torque_loss.Eval(context)


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
        self._torque_command = self.DeclareVectorInputPort("torque_command", joints)
        self._last_command = self.DeclareDiscreteState(joints)
        self._declare_posterior("measured_torque")

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
        command = context.get_discrete_state(self._last_command).value()
        residual, keep = command - self._measured.Eval(context), math.exp(-self._rate * elapsed)
        posterior["status"] = 0.0
        posterior["friction"] = keep * last["friction"] + (1 - keep) * residual

    def _remember(self, context: Context, state: State) -> None:
        super()._remember(context, state)
        last_command = state.get_mutable_discrete_state(self._last_command)
        last_command.set_value(self._torque_command.Eval(context))


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
        self._declare_posterior("measurements")

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
        clock: Clock,
    ):
        """Declares ports and state.

        Args:
            measurements, attitude, base_state, model: types of the inputs' posteriors.
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
            "model_at_step_start": model,
        }
        self._inputs = [self._declare_record_input(name, kind) for name, kind in inputs.items()]
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        self._last_command = self.DeclareDiscreteState(n)
        self._declare_posterior(*inputs)

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
        applied = context.get_discrete_state(self._last_command).value().copy()
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

    def _remember(self, context: Context, state: State) -> None:
        super()._remember(context, state)
        last_command = state.get_mutable_discrete_state(self._last_command)
        last_command.set_value(self._torque_command.Eval(context))
