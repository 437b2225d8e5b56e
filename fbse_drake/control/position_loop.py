"""Joint position control (paper eq. 68)."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from fbse_drake.errors import InputError, require_positive, required
from fbse_drake.robot.description import RobotDescription
from fbse_drake.sampling import is_tick
from fbse_drake.wiring import weakly


@dataclass(frozen=True)
class PositionLoopConfig:
    """Gains by joint (see `RobotDescription.per_joint`)."""

    # Proportional gain [Nm/rad] and derivative gain [Nm s/rad].
    kp: dict[str, float] = field(default_factory=lambda: {"all": 3000.0})
    kd: dict[str, float] = field(default_factory=lambda: {"all": 1.0})
    # Largest torque in either direction [Nm].
    torque_limit: dict[str, float] = field(default_factory=lambda: {"all": 300.0})
    # Is the reference's feed-forward torque (gravity and inertia) added?
    feedforward: bool = True
    # Period of the control [s]; by default `Scenario.usual_period`. See `damping`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_positive(self, "period")
        for name in ("kp", "kd", "torque_limit"):
            values: Mapping[str, Any] = getattr(self, name)
            for joint, value in values.items():
                if value < 0:
                    raise InputError(f"{name}.{joint}: expected a number >= 0, found {value:g}")

    def damping(self, names: RobotDescription, reading: float, time_step: float) -> np.ndarray:
        """How much the loop damps each joint, (n,) [Nms/rad]: kd - kp (T - h) / 2.

        What is read or commanded every T, and held, is late by T / 2 on average; a plant's step h
        of semi-implicit Euler gives half of it back.

        Args:
            reading: period of the encoders [s]; T is this one or the control's, the longer one.
            time_step: of the plant [s].
        """
        kp, kd = (names.per_joint(getattr(self, k), key=f"control.{k}") for k in ("kp", "kd"))
        held = max(required(self.period, "control.period"), reading)
        return kd - kp * (held - time_step) / 2


def position_loop(
    error: np.ndarray, error_rate: np.ndarray, kp: np.ndarray, kd: np.ndarray
) -> np.ndarray:
    """Torque of the position loop, tau_pos = kp (theta_ref - theta) + kd
    (theta_ref_dot - theta_dot), paper eq. (68) [Nm]."""
    return kp * error + kd * error_rate


_law = njit(cache=True)(position_loop)


@njit(cache=True)
def _command(
    command: np.ndarray,
    desired: np.ndarray,
    estimated: np.ndarray,
    feedforward: np.ndarray,
    friction: np.ndarray,
    enabled: np.ndarray,
    kp: np.ndarray,
    kd: np.ndarray,
    limit: np.ndarray,
) -> None:
    """Fills the command of a `PositionLoop` from its inputs."""
    n = len(command)
    for i in range(n):
        torque = (
            _law(desired[i] - estimated[i], desired[n + i] - estimated[n + i], kp[i], kd[i])
            + feedforward[i]
            + friction[i]
        )
        command[i] = np.minimum(np.maximum(torque, -limit[i]), limit[i]) * enabled[i]


class PositionLoop(LeafSystem):
    """Position loop with feed-forward and friction compensation, held between its ticks.

    .. pydrake_system::

        name: PositionLoop
        input_ports:
        - estimated_state
        - desired_state
        - feedforward_torque
        - friction_estimate
        - enabled
        output_ports:
        - torque_command

    States are [positions, velocities], shape (2n,) [rad, rad/s]; torques have shape (n,) [Nm]. The
    command is the position loop's torque plus feed-forward plus friction estimate, within the
    limits; `friction_estimate` may be left unconnected and counts as zero. `enabled` (n,) is 0 for
    a drive that is switched off, which commands no torque. A loop may have no `feedforward_torque`,
    and no `enabled`: then all drives are on. At a tick the command is that of the tick's own
    inputs. Discrete state: the command being held.
    """

    def __init__(
        self,
        config: PositionLoopConfig,
        names: RobotDescription,
        time_step: float,
        inputs: Collection[str] = ("feedforward_torque", "enabled"),
    ):
        """Declares ports, state and, where the command must be held, the update.

        Args:
            time_step: the plant's step [s]; if it is the control period, the command never has to
                be held.
            inputs: which of those that it need not have it has. (To ask a port whether it is
                connected costs a tick half as much as to read it.)

        Raises:
            InputError: an unknown joint, or one without a gain.
        """
        super().__init__()
        n = len(names.joint_names)
        self._period = required(config.period, "control.period")
        self._kp = names.per_joint(config.kp, key="control.kp")
        self._kd = names.per_joint(config.kd, key="control.kd")
        limit = names.per_joint(config.torque_limit, key="control.torque_limit")
        self._limit = np.where(names.has_motor, limit, 0.0)
        self._estimated_state = self.DeclareVectorInputPort("estimated_state", 2 * n)
        self._desired_state = self.DeclareVectorInputPort("desired_state", 2 * n)
        self._friction_estimate = self.DeclareVectorInputPort("friction_estimate", n)
        # What inputs count as that are not there.
        self._zero, self._one = np.zeros(n), np.ones(n)
        self._feedforward_torque = self._enabled = None
        if "feedforward_torque" in inputs:
            self._feedforward_torque = self.DeclareVectorInputPort("feedforward_torque", n)
        if "enabled" in inputs:
            self._enabled = self.DeclareVectorInputPort("enabled", n)
        self._held = self.DeclareDiscreteState(n)
        sources = {self.all_input_ports_ticket(), self.time_ticket(), self.xd_ticket()}
        self.torque_command = self.DeclareVectorOutputPort(
            "torque_command", n, weakly(self._calc), sources
        )
        self._holds = time_step < self._period
        if self._holds:
            self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, 0.0, weakly(self._hold))

    def _calc(self, context: Context, output: BasicVector) -> None:
        if self._holds and not is_tick(context.get_time(), self._period):
            output.SetFromVector(context.get_discrete_state(self._held).value())
            return
        friction, feedforward, enabled = self._zero, self._zero, self._one
        if self._friction_estimate.HasValue(context):
            friction = self._friction_estimate.Eval(context)
        if self._feedforward_torque is not None:
            feedforward = self._feedforward_torque.Eval(context)
        if self._enabled is not None:
            enabled = self._enabled.Eval(context)
        states = self._desired_state.Eval(context), self._estimated_state.Eval(context)
        command, gains = output.get_mutable_value(), (self._kp, self._kd, self._limit)
        _command(command, *states, feedforward, friction, enabled, *gains)

    def _hold(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._held).set_value(self.torque_command.Eval(context))
