"""Torque that reaches the links, and what of the motor's torque does not: the measured friction (paper eqs. 34-49)."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from pydrake.systems.framework import Context, State

from fbse_drake.errors import require_positive
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, Status, starts
from fbse_drake.robot.plant import Robot, grasp_map
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches, leg_of_joint

_NOT_FINITE = float(Status.NOT_FINITE)


@dataclass(frozen=True)
class LinkTorqueConfig:
    """Noise of the sensors as it is believed, for the variance of the measured friction."""

    # Standard deviation of white noise per axis and sample: accelerometer [m/s^2], gyro [rad/s], joint velocity [rad/s], pad force [N].
    acceleration_noise: float = 0.02
    angular_velocity_noise: float = 1.0e-3
    joint_velocity_noise: float = 5.0e-4
    force_noise: float = 0.5

    def __post_init__(self) -> None:
        require_positive(self, "acceleration_noise", "angular_velocity_noise", "joint_velocity_noise", "force_noise")


@njit(cache=True)
def _estimate_link_torque(
    posterior: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    model: np.ndarray,
    acceleration: np.ndarray,
    torque_command: np.ndarray,
    pad_position: np.ndarray,
    pad_foot: np.ndarray,
    wrench_variance: np.ndarray,
    smallest_load: np.ndarray,
    joint_leg: np.ndarray,
    places: np.ndarray,
    noise: np.ndarray,
) -> None:
    """One tick of `LinkTorqueEstimator`; fills the posterior.

    Args:
        torque_command: where the tick began, shape (n,) [Nm].
        wrench_variance: of each foot's measured wrench, shape (feet, 6) [(Nm)^2, N^2].
        smallest_load: that counts, shape (feet,) [N].
        joint_leg: which leg each joint belongs to, shape (n,).
        places: of what is read, see the first line.
        noise: standard deviations of accelerometer, gyro and joint velocities, see `LinkTorqueConfig`.
    """
    if not np.isfinite(torque_command).all():
        posterior[STATUS], posterior[STATUS + 1 :] = _NOT_FINITE, 0.0
        return
    trust, pad_force, mass_matrix, bias, foot_jacobian, acceleration_at, known, sensitivity_at = to_fixed_tuple(places, 8)
    acceleration_noise, angular_velocity_noise, joint_velocity_noise = to_fixed_tuple(noise, 3)
    n, feet = len(torque_command), len(smallest_load)
    v = 6 + n
    posterior[STATUS] = measured[trust : trust + 2 + feet].max()
    if math.isnan(elapsed):
        posterior[STATUS + 1 :] = 0.0
        return
    sensitivity = acceleration[sensitivity_at : sensitivity_at + v * v].reshape(v, v)
    wrench = foot_wrenches(measured[pad_force:], pad_position, pad_foot, feet)
    to_sensors = np.empty(v)
    for i in range(n):
        # Inertia and bias forces, (35) without the wrenches; and what the sensors' noise makes of them.
        link_torque, row = model[bias + i], mass_matrix + i * v
        to_sensors[:] = 0.0
        for k in range(v):
            inertia = model[row + k]
            if inertia != 0.0:  # A joint of another leg.
                link_torque += inertia * acceleration[acceleration_at + k]
                for j in range(v):
                    to_sensors[j] += inertia * sensitivity[k, j]
        torque_variance, impulse_variance = 0.0, 0.0
        for j in range(v):
            if j < 3:
                impulse_variance += (to_sensors[j] * angular_velocity_noise) ** 2
            elif j < 6:
                torque_variance += (to_sensors[j] * acceleration_noise) ** 2
            else:
                impulse_variance += (to_sensors[j] * joint_velocity_noise) ** 2
        for foot in range(feet):
            if wrench[foot, 5] > smallest_load[foot]:
                for k in range(6):
                    lever = model[foot_jacobian + (6 * foot + k) * v + 6 + i]
                    link_torque -= wrench[foot, k] * lever
                    torque_variance += wrench_variance[foot, k] * lever * lever
        trusted = measured[trust] == 0 and measured[trust + 1] == 0 and measured[trust + 2 + joint_leg[i]] == 0
        # Field by field in the posterior's order.
        fields = posterior[STATUS + 1 + i :: n]
        fields[0], fields[1] = link_torque, torque_command[i] - link_torque
        fields[2], fields[3] = torque_variance, impulse_variance
        fields[4] = acceleration[known + i] if trusted else 0.0


class LinkTorqueEstimator(RecursiveEstimator):
    """Link torque by the reduced model, and the friction measured with it: u_F = tau - tau_link (eqs. 34-38, 45, 49).

    .. pydrake_system::

        name: LinkTorqueEstimator
        input_ports:
        - measurements
        - model_at_step_start
        - joint_acceleration
        - torque_command
        output_ports:
        - posterior

    All terms belong to the tick that ends now: posture, velocities and torque command where it began, accelerations and forces over it. So
    they have one group delay, and only their difference, the friction, is ever filtered. `torque_command` (n,) [Nm] is remembered for the
    next tick, so that the estimate of a tick does not depend on the command that is made from it. Fields of the posterior, each (n,):

        link_torque        tau_link [Nm]; what passes the joint to its link
        residual           tau - tau_link [Nm]; friction, with the sensors' noise unfiltered
        torque_variance    of the residual's part that is white: accelerometer and foot forces [Nm^2]
        impulse_variance   of that part's time integral that is white: gyro and encoders, which are differentiated [(Nm s)^2]
        valid              1 where all that the residual needs was known

    A foot that shows less load than its sensors' noise counts as unloaded.
    """

    def __init__(
        self,
        config: LinkTorqueConfig,
        robot: Robot,
        measurements: dict[str, slice],
        model: dict[str, slice],
        acceleration: dict[str, slice],
        clock: Clock,
    ):
        n, legs = len(robot.joint_names), robot.description.legs
        super().__init__({"status": 1, "link_torque": n, "residual": n, "torque_variance": n, "impulse_variance": n, "valid": n}, clock)
        self._pads = FootPads(robot)
        grasp = [grasp_map(robot.pad_positions(side)) for side in legs]
        self._wrench_variance = np.array([config.force_noise**2 * (G**2).sum(axis=1) for G in grasp])
        self._smallest_load = np.array([config.force_noise * math.sqrt(len(leg.pads)) for leg in legs.values()])
        self._joint_leg = leg_of_joint(robot)
        self._places = np.array(
            [
                *starts(measurements, "trust", "pad_force"),
                *starts(model, "mass_matrix", "bias", "foot_jacobian"),
                *starts(acceleration, "base_angular_acceleration", "known", "sensitivity"),
            ]
        )
        self._noise = np.array([config.acceleration_noise, config.angular_velocity_noise, config.joint_velocity_noise], dtype=float)
        for name, parts in (("measurements", measurements), ("model_at_step_start", model), ("joint_acceleration", acceleration)):
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        names = ("measurements", "model_at_step_start", "joint_acceleration")
        self._measurements, self._model, self._acceleration = (self.GetInputPort(name) for name in names)
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        self.DeclareDiscreteState(n)  # the last command
        self._declare_posterior(*names)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:  # noqa: ARG002
        _estimate_link_torque(
            posterior,
            elapsed,
            self._measurements.Eval(context),
            self._model.Eval(context),
            self._acceleration.Eval(context),
            context.get_discrete_state().value(1),
            self._pads.position,
            self._pads.foot,
            self._wrench_variance,
            self._smallest_load,
            self._joint_leg,
            self._places,
            self._noise,
        )

    def _remember(self, context: Context, state: State) -> None:
        super()._remember(context, state)
        state.get_mutable_discrete_state().set_value(1, self._torque_command.Eval(context))
