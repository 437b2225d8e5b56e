"""Other ways to have the friction, in the same place of the diagram as FBSE, to be compared with it."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Context, State

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.effects.joint_torque import JointMotion
from fbse_drake.errors import require_positive
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, Status
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
    """Friction from joint torque sensors (`sensors.joint_torque`): command minus measured link torque, low-passed."""

    # Cut-off of the low-pass of first order [Hz].
    cutoff: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "cutoff")


@dataclass(frozen=True)
class DisturbanceObserver:
    """Momentum-based disturbance observer of a floating-base robot (De Luca et al. 2006), contact wrenches from the foot sensors."""

    # Bandwidth of the observer [Hz].
    bandwidth: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "bandwidth")


@dataclass(frozen=True)
class FixedFriction:
    """A friction model with parameters identified beforehand, evaluated at the measured velocity."""

    model: FrictionModel = field(default_factory=CoulombViscousFriction)


class TrueFrictionSource(RecursiveEstimator):
    """The oracle.

    .. pydrake_system::

        name: TrueFrictionSource
        input_ports:
        - torque_loss
        output_ports:
        - posterior

    `torque_loss` (n,) [Nm] and field `friction` (n,) are those of the step that ends now.
    """

    def __init__(self, joints: int, clock: Clock):
        super().__init__({"status": 1, "friction": joints}, clock)
        self._torque_loss = self.DeclareVectorInputPort("torque_loss", joints)
        self._declare_posterior("torque_loss")

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:  # noqa: ARG002
        posterior[STATUS], posterior[STATUS + 1 :] = 0.0, self._torque_loss.Eval(context)


class TorqueSensorEstimator(RecursiveEstimator):
    """Friction from joint torque sensors.

    .. pydrake_system::

        name: TorqueSensorEstimator
        input_ports:
        - measured_torque
        - torque_command
        output_ports:
        - posterior

    `measured_torque` (n,) [Nm] is the link torque over the tick that ends now; field `friction` (n,) [Nm].
    """

    def __init__(self, config: TorqueSensor, joints: int, clock: Clock):
        super().__init__({"status": 1, "friction": joints}, clock)
        self._rate = 2 * math.pi * config.cutoff
        self._measured = self.DeclareVectorInputPort("measured_torque", joints)
        self._torque_command = self.DeclareVectorInputPort("torque_command", joints)
        self._last_command = self.DeclareDiscreteState(joints)
        self._declare_posterior("measured_torque")

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        posterior[:] = last
        if math.isnan(elapsed):
            return
        residual = context.get_discrete_state(self._last_command).value() - self._measured.Eval(context)
        keep = math.exp(-self._rate * elapsed)
        friction = self.fields["friction"]
        posterior[STATUS], posterior[friction] = 0.0, keep * last[friction] + (1 - keep) * residual

    def _remember(self, context: Context, state: State) -> None:
        super()._remember(context, state)
        state.get_mutable_discrete_state(self._last_command).set_value(self._torque_command.Eval(context))


class FixedFrictionModel(RecursiveEstimator):
    """Friction of a fixed model at the measured velocity.

    .. pydrake_system::

        name: FixedFrictionModel
        input_ports:
        - measurements
        output_ports:
        - posterior

    `measurements` is the posterior of a `SensorMonitor`; field `friction` (n,) [Nm].
    """

    def __init__(self, config: FixedFriction, robot: Robot, measurements: dict[str, slice], clock: Clock):
        super().__init__({"status": 1, "friction": len(robot.joint_names)}, clock)
        self._model = config.model.resolve(robot.description, key="estimator.model")
        self._inputs = measurements
        self._measurements = self.DeclareVectorInputPort("measurements", max(part.stop for part in measurements.values()))
        self._declare_posterior("measurements")

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:  # noqa: ARG002
        measured = self._measurements.Eval(context)
        torque, _ = self._model.torque_and_slope(JointMotion(measured[self._inputs["joint_velocity"]]))
        posterior[STATUS], posterior[STATUS + 1 :] = measured[self._inputs["trust"]][0], torque


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

    Posteriors as for FBSE; the base's velocity is the estimated one, accelerations are not used at all. The observer integrates
    u_dot = K (tau + J^T F + beta - p_dot - u), with beta = H_dot v - C v - g, so that u is the friction behind a low-pass of first order.
    Fields: `friction` (n,) [Nm], `momentum` (n,) [Nm s].
    """

    def __init__(
        self,
        config: DisturbanceObserver,
        robot: Robot,
        measurements: dict[str, slice],
        attitude: dict[str, slice],
        base_state: dict[str, slice],
        model: dict[str, slice],
        clock: Clock,
    ):
        n = len(robot.joint_names)
        super().__init__({"status": 1, "friction": n, "momentum": n}, clock)
        self._parts = {"measurements": measurements, "attitude": attitude, "base_state": base_state, "model": model}
        self._parts["model_at_step_start"] = model
        self._gain, self._n = 2 * math.pi * config.bandwidth, n
        self._gravity = robot.plant.gravity_field().gravity_vector()
        self._pads, self._feet = FootPads(robot), len(robot.description.sides)
        for name, parts in self._parts.items():
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        self._last_command = self.DeclareDiscreteState(n)
        self._ports = {name: self.GetInputPort(name) for name in self._parts}
        self._declare_posterior(*self._parts)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        values = {
            name: {part: vector[place] for part, place in self._parts[name].items()}
            for name, vector in ((name, port.Eval(context)) for name, port in self._ports.items())
        }
        measured, model, start = values["measurements"], values["model"], values["model_at_step_start"]
        n = self._n
        R_WB = values["attitude"]["rotation"].reshape(3, 3)
        v_B = R_WB.T @ values["base_state"]["base_velocity"]
        velocity = model["velocity"].copy()
        velocity[3:6] = v_B
        M, M_start = (terms["mass_matrix"].reshape(n, 6 + n) for terms in (model, start))
        momentum = M @ velocity
        applied = context.get_discrete_state(self._last_command).value().copy()
        trust = max(measured["trust"].tolist()) if math.isfinite(applied.dot(applied)) else float(Status.NOT_FINITE)
        # The momentum is differentiated: both ends of the tick must be trusted.
        if math.isnan(elapsed) or trust or last.item(STATUS):
            posterior[:] = self.fields.pack(status=trust, friction=last[self.fields["friction"]], momentum=momentum)
            return
        # Components in base axes, which turn: their rate has -w x v besides the acceleration.
        turning = np.cross(velocity[:3], v_B)
        gravity = M_start[:, 3:6] @ (R_WB.T @ self._gravity)
        beta = (M - M_start) @ velocity / elapsed - M_start[:, 3:6] @ turning - start["bias"] + gravity
        J = start["foot_jacobian"].reshape(6 * self._feet, 6 + n)[:, 6:]
        applied += foot_wrenches(measured["pad_force"], self._pads.position, self._pads.foot, self._feet).ravel() @ J
        rate = (momentum - last[self.fields["momentum"]]) / elapsed
        keep = math.exp(-self._gain * elapsed)
        friction = keep * last[self.fields["friction"]] + (1 - keep) * (applied + beta - rate)
        posterior[:] = self.fields.pack(status=0.0, friction=friction, momentum=momentum)

    def _remember(self, context: Context, state: State) -> None:
        super()._remember(context, state)
        state.get_mutable_discrete_state(self._last_command).set_value(self._torque_command.Eval(context))
