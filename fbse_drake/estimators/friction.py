"""From the measured friction, which is noisy, to the friction estimate: two LeafSystems with the same ports.

`RecursiveLeastSquares` is the paper's: the measurement while the leg stands, a model identified from it while the leg swings.
`ModelAided` weighs both at all times.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from pydrake.systems.framework import Context

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.errors import InputError, require_not_negative, require_positive
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, starts
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import leg_of_joint


def _adopted_model() -> CoulombViscousFriction:
    return CoulombViscousFriction(transition={"all": 1.0e-6})


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Recursive least squares (64)-(67), one joint at a time: the covariance of the paper's 12 parameters never couples joints."""

    # Adopted friction model, by default (57) with a sharp sign. Its linear parameters are identified, from their values here on; the others
    # stay as they are.
    model: FrictionModel = field(default_factory=_adopted_model)
    # Initial covariance of every parameter, Table II.
    covariance: float = 10.0
    # Weight that a tick of 1 ms keeps after the next; 1 never forgets.
    forgetting: float = 1.0
    # The covariance is set back to its initial value this often [s]; 0 never.
    reset_period: float = 0.0
    # Cut-off of the low-pass on the measured friction [Hz]; 0 does not filter, as the paper.
    cutoff: float = 0.0
    # What is taken while a leg swings: `model` as in the paper, or the `measurement` (which needs fused accelerations).
    swing: str = "model"

    def __post_init__(self) -> None:
        if not 0 < self.forgetting <= 1:
            raise InputError(f"forgetting: expected a number in (0, 1], found {self.forgetting:g}")
        require_positive(self, "covariance")
        require_not_negative(self, "reset_period", "cutoff")
        if self.swing not in ("model", "measurement"):
            raise InputError(f"swing: expected model or measurement, found {self.swing}")


@dataclass(frozen=True)
class ModelAided:
    """Kalman filter, joint by joint, for a friction model's parameters and what the model does not explain.

    The friction is u = phi(velocity)^T parameters + d with constant parameters and d a random walk. Compared is not the measured friction
    itself but its impulse, the integral over time: errors of velocities, which accelerations differentiate, are white in it. So sharp
    features come from the model without delay, and the measurement decides over everything slower.
    """

    # Friction model, of which the linear parameters are identified, from their values here on; the others stay as they are.
    model: FrictionModel = field(default_factory=CoulombViscousFriction)
    # Initial standard deviation of every parameter [its unit].
    parameter_uncertainty: float = 3.0
    # Random walk of d [Nm/sqrt(s)], and its initial standard deviation [Nm].
    disturbance_walk: float = 0.3
    disturbance_uncertainty: float = 0.1
    # Random walk of the parameters [its unit/sqrt(s)].
    parameter_walk: float = 0.0
    # Time constant of the smoothing of the velocity that the model sees [s].
    velocity_smoothing: float = 0.0015
    # What is taken while a leg swings: the `measurement` as in stance, or the `model` alone.
    swing: str = "measurement"

    def __post_init__(self) -> None:
        require_not_negative(
            self, "parameter_uncertainty", "disturbance_walk", "disturbance_uncertainty", "parameter_walk", "velocity_smoothing"
        )
        if self.swing not in ("model", "measurement"):
            raise InputError(f"swing: expected model or measurement, found {self.swing}")


FrictionConfig = RecursiveLeastSquares | ModelAided


@dataclass(frozen=True)
class FrictionRegressor:
    """A joint torque effect as a regressor: its basis torques, (n,) for each parameter, at a velocity (n,)."""

    effect: type[JointTorqueEffect]
    # Values of the nonlinear parameters (nonlinear, n), and of the linear ones to start with (n, parameters).
    nonlinear: np.ndarray
    initial: np.ndarray

    @staticmethod
    def of(model: JointTorqueEffect, robot: Robot) -> "FrictionRegressor":
        """Raises InputError for an unknown joint."""
        resolved = model.resolve(robot.description, key="estimator.friction.model")
        return FrictionRegressor(resolved.effect, resolved.nonlinear, resolved.linear.T.copy())

    @property
    def parameters(self) -> int:
        return self.initial.shape[1]

    def __call__(self, velocity: np.ndarray) -> Sequence[np.ndarray]:
        basis, _ = self.effect.basis(JointMotion(velocity), self.nonlinear)
        return basis


def recursive_least_squares(
    parameters: np.ndarray, P: np.ndarray, phi: np.ndarray, measured: np.ndarray, forgetting: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One tick of (64)-(67) for n joints at once.

    Args:
        parameters: (n, m); P: their covariances (n, m, m); phi: regressors (n, m); measured: friction (n,) [Nm].
        forgetting: weight of the past, 1 for the paper's.

    Returns:
        Parameters, covariances, innovation (n,) and its variance (n,), in units of the measurement noise.
    """
    innovation = measured - (phi * parameters).sum(axis=1)  # (65)
    P_phi = (P @ phi[:, :, None])[:, :, 0]
    S = forgetting + (phi * P_phi).sum(axis=1)
    K = P_phi / S[:, None]  # (66)
    return parameters + K * innovation[:, None], (P - K[:, :, None] * P_phi[:, None, :]) / forgetting, innovation, S  # (64), (67)


class FrictionEstimator(RecursiveEstimator):
    """What both friction estimators share.

    .. pydrake_system::

        name: FrictionEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior

    Inputs: posteriors of `SensorMonitor` and `LinkTorqueEstimator`. Fields of the posterior: `friction` (n,) [Nm], the estimate for the
    tick that ends now; `parameters` (n, m) and `covariance` (n, m, m) of the model; `innovation` and `innovation_variance` (n,).
    """

    def __init__(
        self,
        model: JointTorqueEffect,
        robot: Robot,
        measurements: dict[str, slice],
        link_torque: dict[str, slice],
        clock: Clock,
        covariance_size: int,
        further: dict[str, int],
    ):
        self._regressor = FrictionRegressor.of(model, robot)
        n, m = len(robot.joint_names), self._regressor.parameters
        super().__init__(
            {
                "status": 1,
                "friction": n,
                "parameters": n * m,
                "parameter_variance": n * m,
                "covariance": n * (m + covariance_size) ** 2,
                "innovation": n,
                "innovation_variance": n,
                **further,
            },
            clock,
        )
        self._measured, self._link_torque, self._n, self._m = measurements, link_torque, n, m
        self._leg = leg_of_joint(robot)
        for name, parts in (("measurements", measurements), ("link_torque", link_torque)):
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        names = ("measurements", "link_torque")
        self._measurements, self._link = (self.GetInputPort(name) for name in names)
        self._declare_posterior(*names)


class RecursiveLeastSquaresEstimator(FrictionEstimator):
    """Friction as in the paper (Sec. 6-7): measured in stance, modelled in swing; see `RecursiveLeastSquares` and `FrictionEstimator`.

    .. pydrake_system::

        name: RecursiveLeastSquaresEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior

    Further fields: `filtered` (2, n), state of the low-pass [Nm]; `age` [s], time since the last reset of the covariance.
    """

    def __init__(
        self, config: RecursiveLeastSquares, robot: Robot, measurements: dict[str, slice], link_torque: dict[str, slice], clock: Clock
    ):
        n = len(robot.joint_names)
        super().__init__(config.model, robot, measurements, link_torque, clock, 0, {"filtered": 2 * n, "age": 1})
        self._config = config

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        measured, link_torque = self._measurements.Eval(context), self._link.Eval(context)
        support = measured[self._measured["support"]]
        config, fields, n, m = self._config, self.fields, self._n, self._m
        posterior[:] = last
        posterior[STATUS] = max(measured[self._measured["trust"]].tolist())
        parameters = posterior[fields["parameters"]].reshape(n, m)
        P = posterior[fields["covariance"]].reshape(n, m, m)
        if math.isnan(elapsed):
            parameters[:] = self._regressor.initial
        age = math.inf if math.isnan(elapsed) else posterior[fields["age"]][0] + elapsed
        if age == math.inf or (config.reset_period and age >= config.reset_period * (1 - 1e-9)):
            P[:], age = config.covariance * np.eye(m), 0.0
        posterior[fields["age"]] = age
        phi = np.array(self._regressor(measured[self._measured["joint_velocity"]])).T
        valid = link_torque[self._link_torque["valid"]] > 0
        if config.swing == "model":
            valid &= support[self._leg] > 0
        residual = link_torque[self._link_torque["residual"]]
        filtered = posterior[fields["filtered"]].reshape(2, n)
        if config.cutoff > 0 and not math.isnan(elapsed):
            # Two equal poles; a joint that was not measured starts afresh from its model.
            keep = math.exp(-2 * math.pi * config.cutoff * 1.55 * elapsed)
            modelled = (phi * parameters).sum(axis=1)
            filtered[0] = np.where(valid, keep * filtered[0] + (1 - keep) * residual, modelled)
            filtered[1] = np.where(valid, keep * filtered[1] + (1 - keep) * filtered[0], modelled)
            smooth = filtered[1]
        else:
            smooth = residual
        if valid.any():
            forgetting = 1.0 if config.forgetting == 1 else config.forgetting ** (elapsed / 1e-3)
            new, P_new, innovation, S = recursive_least_squares(parameters, P, phi, residual, forgetting)
            parameters[valid], P[valid] = new[valid], P_new[valid]
            posterior[fields["innovation"]], posterior[fields["innovation_variance"]] = innovation * valid, S
        posterior[fields["parameter_variance"]] = np.diagonal(P, axis1=1, axis2=2).ravel()
        posterior[fields["friction"]] = np.where(valid, smooth, (phi * parameters).sum(axis=1))


@njit(cache=True)
def smooth_velocity(
    velocity: np.ndarray, last: np.ndarray, measured: np.ndarray, elapsed: float, places: np.ndarray, time_constant: float
) -> None:
    """Low-pass of first order over joint velocities.

    Args:
        velocity: to be filled, shape (n,) [rad/s].
        last, measured: posteriors of `ModelAidedEstimator` a tick ago and of `SensorMonitor`.
        places: of what is read, see the first line.
        time_constant: of the low-pass [s], 0 does not smooth.
    """
    joint_velocity, smoothed, measured_last = to_fixed_tuple(places, 3)
    keep = math.exp(-elapsed / time_constant) if time_constant > 0 else 0.0
    for joint in range(len(velocity)):
        # The joint's velocity over the tick is the mean of those at its ends.
        mean = 0.5 * (measured[joint_velocity + joint] + last[measured_last + joint])
        velocity[joint] = keep * last[smoothed + joint] + (1 - keep) * mean


@njit(cache=True)
def _estimate_friction(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    link_torque: np.ndarray,
    phi: tuple[np.ndarray, ...],
    joint_leg: np.ndarray,
    places: np.ndarray,
    measures_swing: bool,
    walks: np.ndarray,
) -> None:
    """One tick of `ModelAidedEstimator` but the first: a Kalman filter for each joint; fills the posterior but for its `velocity`.

    Args:
        phi: the model's regressors, m of shape (n,).
        joint_leg: which leg each joint belongs to, shape (n,).
        places: of what is read and written, see the first lines.
        measures_swing: whether the measurement counts while the leg swings.
        walks: random walks of disturbance and parameters, see `ModelAided`.
    """
    trust, joint_velocity, support_start, support_stop = to_fixed_tuple(places, 4)
    residual, torque_variance, impulse_variance, valid_at = to_fixed_tuple(places[4:], 4)
    friction, parameters, variances, covariance, innovations, innovation_variances = to_fixed_tuple(places[8:], 6)
    disturbance, impulse_at, measured_at = to_fixed_tuple(places[14:], 3)
    disturbance_walk, parameter_walk = to_fixed_tuple(walks, 2)
    support, m, n = measured[support_start:support_stop], len(phi), len(joint_leg)
    size = m + 2
    regressor, x, column = np.ones(m + 1), np.empty(m + 1), np.empty(size)
    posterior[STATUS] = measured[trust : trust + 2 + len(support)].max()
    stop = covariance + n * size * size
    posterior[covariance:stop] = last[covariance:stop]
    covariances = posterior[covariance:stop].reshape(n, size, size)
    for joint in range(n):
        valid = link_torque[valid_at + joint] > 0 and (measures_swing or support[joint_leg[joint]] > 0)
        # Parameters and disturbance, whose regressor is one.
        for k in range(m):
            regressor[k], x[k] = phi[k][joint], last[parameters + joint * m + k]
        x[m] = last[disturbance + joint]
        P, impulse_uncertainty = covariances[joint], covariances[joint, 0, 0]
        # Prediction: the impulse error grows by the friction's error times the tick.
        innovation = last[impulse_at + joint] + elapsed * link_torque[residual + joint]
        added = elapsed**2 * link_torque[torque_variance + joint]
        for k in range(m + 1):
            innovation -= elapsed * regressor[k] * x[k]
        for i in range(size):
            c = 0.0
            for k in range(m + 1):
                c += elapsed * P[i, 1 + k] * regressor[k]
            P[i, 0] += c
            if i > 0:
                added += elapsed * regressor[i - 1] * c
        # Its own row and column are the same.
        P[0, 0] += P[0, 0] - impulse_uncertainty + added
        P[size - 1, size - 1] += disturbance_walk**2 * elapsed
        for i in range(1, m + 1):
            P[0, i] = P[i, 0]
            P[i, i] += parameter_walk**2 * elapsed
        P[0, size - 1] = P[size - 1, 0]
        # Update.
        column[:] = P[:, 0]
        S = column[0] + link_torque[impulse_variance + joint]
        impulse = innovation
        if valid:
            for i in range(size):
                gain = column[i] / S
                if i == 0:
                    impulse -= gain * innovation
                else:
                    x[i - 1] += gain * innovation
                for k in range(size):
                    P[i, k] -= gain * column[k]
        else:
            # A joint that is not measured is left to its model.
            x[m] = impulse = 0.0
            P[0, :] = 0.0
            P[:, 0] = 0.0
        total = 0.0
        for k in range(m + 1):
            total += regressor[k] * x[k]
        for k in range(m):
            posterior[parameters + joint * m + k], posterior[variances + joint * m + k] = x[k], P[1 + k, 1 + k]
        posterior[friction + joint] = total
        posterior[disturbance + joint], posterior[impulse_at + joint] = x[m], impulse
        posterior[innovations + joint], posterior[innovation_variances + joint] = innovation if valid else 0.0, S
        posterior[measured_at + joint] = measured[joint_velocity + joint]


class ModelAidedEstimator(FrictionEstimator):
    """Friction from measurement and model together; see `ModelAided` and `FrictionEstimator`.

    .. pydrake_system::

        name: ModelAidedEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior

    Further fields, each (n,): `disturbance` d [Nm]; `impulse`, measured minus estimated impulse [Nm s], after the update; `velocity` that
    the model sees and `last_velocity` as measured [rad/s]. `innovation` is that of the impulse [Nm s]; `covariance` (n, m + 2, m + 2) is
    that of [impulse, parameters, disturbance].
    """

    def __init__(self, config: ModelAided, robot: Robot, measurements: dict[str, slice], link_torque: dict[str, slice], clock: Clock):
        n = len(robot.joint_names)
        further = {"disturbance": n, "impulse": n, "velocity": n, "last_velocity": n}
        super().__init__(config.model, robot, measurements, link_torque, clock, 2, further)
        self._config, self._measures_swing = config, config.swing == "measurement"
        self._velocity_places = np.array(
            [*starts(measurements, "joint_velocity"), *starts(self.fields.slices, "velocity", "last_velocity")]
        )
        self._smoothing, self._walks = float(config.velocity_smoothing), np.array([config.disturbance_walk, config.parameter_walk], float)
        self._velocity = self.fields["velocity"]
        model, innovation = ("parameters", "parameter_variance", "covariance"), ("innovation", "innovation_variance")
        written = ("friction", *model, *innovation, "disturbance", "impulse", "last_velocity")
        self._places = np.array(
            [
                *starts(measurements, "trust", "joint_velocity", "support"),
                measurements["support"].stop,
                *starts(link_torque, "residual", "torque_variance", "impulse_variance", "valid"),
                *starts(self.fields.slices, *written),
            ]
        )

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        measured, link_torque = self._measurements.Eval(context), self._link.Eval(context)
        if math.isnan(elapsed):
            self._start(posterior, measured)
            return
        velocity = posterior[self._velocity]
        smooth_velocity(velocity, last, measured, elapsed, self._velocity_places, self._smoothing)
        _estimate_friction(
            posterior,
            last,
            elapsed,
            measured,
            link_torque,
            self._regressor(velocity),
            self._leg,
            self._places,
            self._measures_swing,
            self._walks,
        )

    def _start(self, posterior: np.ndarray, measured: np.ndarray) -> None:
        config, n, m = self._config, self._n, self._m
        P = np.diag([0.0, *[config.parameter_uncertainty**2] * m, config.disturbance_uncertainty**2])
        now = measured[self._measured["joint_velocity"]]
        posterior[:] = self.fields.pack(
            status=measured[self._measured["trust"]].max(),
            parameters=self._regressor.initial,
            covariance=np.tile(P, (n, 1, 1)),
            velocity=now,
            last_velocity=now,
        )
