"""The joints' equation of motion over a tick, by the change of momentum: no accelerations."""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import require_positive
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.floating_base import model_type
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches

# What an observer on the balance is fed by in a chain that has `Fbse.add_base`.
SOURCES = {
    "measurements": "sensor_monitor",
    "attitude": "attitude",
    "base_state": "base_state",
    "model": "model",
    "model_at_step_start": "model.at_step_start",
}


class Balance(NamedTuple):
    """The joint rows of the equation of motion over the tick that ends now."""

    # What is left of it, (n,) [Nm]: the friction, with the noise of all that is differentiated.
    remainder: np.ndarray
    # Change of the joints' part of the momentum H v, (n,) [Nm s], over the tick.
    momentum_change: np.ndarray
    # Joint angles (n,) [rad], now.
    angle: np.ndarray
    # Change of the joint velocities over the tick, (n,) [rad/s].
    velocity_change: np.ndarray
    # Joint rows of the mass matrix where the tick began, (n, 6 + n) [kg m^2, kg m].
    inertia: np.ndarray
    # Joint columns of the feet's Jacobians there, (6 feet, n), in the sole frames.
    foot_jacobian: np.ndarray


@dataclass(frozen=True)
class BandwidthObserver(Estimator):
    """Base of the settings of an observer on the balance that has a bandwidth."""

    knows: ClassVar[str] = "inertia of all links"
    measures: ClassVar[str] = "IMU, foot forces"
    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {"bandwidth": (1.0, 100.0)}

    # Of the observer [Hz].
    bandwidth: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "bandwidth")

    @property
    def pole(self) -> float:
        """Absolute value of the observer's poles [rad/s]."""
        return 2 * math.pi * self.bandwidth


class MomentumBalance(RecursiveEstimator):
    """Base of the observers on the generalized momentum of the joints, p = H v.

    .. pydrake_system::

        name: MomentumBalance
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
    all. Over a tick p_dot = tau + J^T F + beta - u, with beta = H_dot v - C v - g, of which the
    friction u is unknown. Fields: `friction` (n,) [Nm], `momentum` (n,) [Nm s], and those of the
    observer.
    """

    def __init__(
        self,
        robot: Robot,
        measurements: np.dtype,
        attitude: np.dtype,
        base_state: np.dtype,
        model: np.dtype,
        model_at_step_start: np.dtype,
        clock: Clock,
        **fields: tuple[int, ...],
    ):
        """Declares ports and state.

        Args:
            measurements, attitude, base_state, model, model_at_step_start: types of the inputs.
            fields: of the observer, their shapes.
        """
        n = len(robot.joint_names)
        kind = record_type(time=(), status=(), friction=(n,), momentum=(n,), **fields)
        super().__init__(kind, clock)
        self._own_fields = tuple(fields)
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

    @abstractmethod
    def _observe(
        self, balance: Balance, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        """Makes the friction and the observer's own fields.

        Args:
            last: posterior of the tick before, whose sensors were trusted; its fields are zero
                before the first tick.
            elapsed: length of the tick [s].
            posterior: to be filled; has its momentum and status.
        """

    def _wait(self, last: np.ndarray, posterior: np.ndarray) -> None:
        """Makes the same where the tick has no balance, as its sensors are not trusted: the last
        ones are held."""
        for name in ("friction", *self._own_fields):
            posterior[name] = last[name]

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
            self._wait(last, posterior)
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
        change = momentum - last["momentum"]
        balance = Balance(
            applied + beta - change / elapsed,
            change,
            measured["joint_position"],
            velocity[6:] - start["velocity"][6:],
            M_start,
            J,
        )
        self._observe(balance, last, elapsed, posterior)


def add_observer(chain: Chain, name: str, make: Callable[..., MomentumBalance]) -> None:
    """Adds an observer on the balance, and before it what it needs, see `Fbse.add_base`.

    Args:
        make: the observer's class, or a partial call of it, as `Chain.add` takes it.
    """
    Fbse().add_base(chain)
    chain.add(name, make, **SOURCES)
