"""Torque that reaches the links, and what of the motor's torque does not: the measured friction (paper eqs. 34-49)."""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, State

from fbse_drake.errors import InputError
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.robot.plant import Robot, grasp_map


@dataclass(frozen=True)
class LinkTorqueConfig:
    """Noise of the sensors as it is believed, for the variance of the measured friction."""

    # Standard deviation of white noise per axis and sample: accelerometer [m/s^2], gyro [rad/s], joint velocity [rad/s], pad force [N].
    acceleration_noise: float = 0.02
    angular_velocity_noise: float = 1.0e-3
    joint_velocity_noise: float = 5.0e-4
    force_noise: float = 0.5

    def __post_init__(self) -> None:
        for name in ("acceleration_noise", "angular_velocity_noise", "joint_velocity_noise", "force_noise"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected a number > 0, found {getattr(self, name):g}")


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
        n = len(robot.joint_names)
        v = 6 + n
        super().__init__({"link_torque": n, "residual": n, "torque_variance": n, "impulse_variance": n, "valid": n}, clock)
        self._measured, self._model, self._acceleration = measurements, model, acceleration
        self._n, self._v, self._feet = n, v, len(robot.description.sides)
        self._all = slice(acceleration["base_angular_acceleration"].start, acceleration["joint_acceleration"].stop)
        self._impulse_noise = np.zeros(v)
        self._impulse_noise[:3] = config.angular_velocity_noise**2
        self._impulse_noise[6:] = config.joint_velocity_noise**2
        self._torque_noise = np.zeros(v)
        self._torque_noise[3:6] = config.acceleration_noise**2
        self._grasp, self._pads, self._wrench_noise, self._legs = [], [], [], []
        start = measurements["pad_force"].start
        for side, leg in robot.description.legs.items():
            grasp = grasp_map(robot.pad_positions(side))
            self._grasp.append(grasp)
            self._pads.append(slice(start, start + grasp.shape[1]))
            start += grasp.shape[1]
            self._wrench_noise.append(config.force_noise**2 * (grasp**2).sum(axis=1))
            self._legs.append([robot.joint_names.index(name) for name in leg.joints])
        self._smallest_load = [config.force_noise * math.sqrt(len(leg.pads)) for leg in robot.description.legs.values()]
        for name, parts in (("measurements", measurements), ("model_at_step_start", model), ("joint_acceleration", acceleration)):
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        names = ("measurements", "model_at_step_start", "joint_acceleration")
        self._ports = [self.GetInputPort(name) for name in names]
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        self._last_command = self.DeclareDiscreteState(n)
        self._declare_posterior(*names)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        fields = self.fields
        posterior = np.zeros(fields.size)
        measured, model, acceleration = (port.Eval(context) for port in self._ports)
        trust = measured[self._measured["trust"]].tolist()
        posterior[0] = max(trust)
        if math.isnan(elapsed):
            return posterior
        tau = context.get_discrete_state(self._last_command).value()
        M = model[self._model["mass_matrix"]].reshape(self._n, self._v)
        J = model[self._model["foot_jacobian"]].reshape(self._feet, 6, self._v)
        link_torque = M @ acceleration[self._all] + model[self._model["bias"]]
        sensitivity = (M @ acceleration[self._acceleration["sensitivity"]].reshape(self._v, self._v)) ** 2
        torque_variance = sensitivity @ self._torque_noise
        valid = acceleration[self._acceleration["known"]].copy()
        for k in range(self._feet):
            wrench = self._grasp[k] @ measured[self._pads[k]]
            if wrench[5] > self._smallest_load[k]:
                J_joints = J[k][:, 6:]
                link_torque -= wrench @ J_joints
                torque_variance += self._wrench_noise[k] @ (J_joints * J_joints)
            if trust[2 + k]:
                valid[self._legs[k]] = 0.0
        if trust[0] or trust[1]:
            valid[:] = 0.0
        posterior[fields["link_torque"]] = link_torque
        posterior[fields["residual"]] = tau - link_torque
        posterior[fields["torque_variance"]] = torque_variance
        posterior[fields["impulse_variance"]] = sensitivity @ self._impulse_noise
        posterior[fields["valid"]] = valid
        return posterior

    def _remember(self, context: Context, state: State) -> None:
        super()._remember(context, state)
        command = self._torque_command.Eval(context)
        if not math.isfinite(command.sum()):
            state.get_mutable_discrete_state(self._last)[0] = Status.NOT_FINITE
            return
        state.get_mutable_discrete_state(self._last_command).set_value(command)
