"""Friction by measurement and model at all times, joint by joint."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.errors import InputError, require_not_negative, required
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.force_delay import room_for_delays
from fbse_drake.estimators.friction import MEASURED, FrictionEstimator
from fbse_drake.estimators.friction_regressor import FrictionRegressor, put_regressor
from fbse_drake.estimators.innovations import AGREEMENT, AGREEMENT_TIME, LARGEST_SHARE, NOISE_TIME
from fbse_drake.estimators.records import Record, record
from fbse_drake.estimators.recursive import Clock, start_share
from fbse_drake.robot.plant import Robot

# An innovation counts as little as makes it just likely beyond so many standard deviations, ...
_GATE = 5.0
# ... and what the model does not explain, or a tick adds to it, is not known for so long [s].
_DOUBT_TIME = 0.1
# How fast the legs of a walking robot reverse, in its order of magnitude [rad/s^2].
_REVERSAL = 3.0


@dataclass(frozen=True)
class ModelAided:
    """Kalman filter for a friction model's parameters and what the model does not explain.

    It goes joint by joint. The friction is u = phi(velocity)^T parameters + d with constant
    parameters and d a random walk. Compared is not the measured friction itself but its impulse,
    the integral over time: errors of velocities, which accelerations differentiate, are white in
    it. So sharp features come from the model without delay, and the measurement decides over
    everything slower.
    """

    # Does it go back to the tick that late forces belong to?
    allows_for_delay: ClassVar[bool] = True
    allows_for_effects: ClassVar[bool] = False
    states_variance: ClassVar[bool] = True
    sources: ClassVar[dict[str, str]] = MEASURED
    stands_for: ClassVar[tuple[str, ...]] = ()

    # Friction model, of which the linear parameters are identified, from their values here on; the
    # others stay as they are.
    model: FrictionModel = field(default_factory=CoulombViscousFriction)
    # Initial standard deviation of every parameter [its unit].
    parameter_uncertainty: float = 3.0
    # Random walk of d [Nm/sqrt(s)], and its initial standard deviation [Nm].
    disturbance_walk: float = 0.15
    disturbance_uncertainty: float = 0.1
    # Random walk of the parameters [its unit/sqrt(s)].
    parameter_walk: float = 0.0
    # Time constant of the smoothing of the velocity that the model sees [s]; by default as long as
    # the noise of the velocities asks for.
    velocity_smoothing: float | None = None
    # What is taken while a leg swings: the `measurement` as in stance, or the `model` alone.
    swing: str = "measurement"
    # By what the nonlinear parameters (a transition velocity) may be wrong: the model is a mixture
    # of such shapes; and the initial standard deviation of each one's weight [Nm].
    factors: list[float] = field(default_factory=lambda: [0.2, 5.0])
    shape_uncertainty: float = 3.0

    def __post_init__(self) -> None:
        require_not_negative(self, "parameter_uncertainty", "parameter_walk")
        require_not_negative(self, "disturbance_walk", "disturbance_uncertainty")
        if self.velocity_smoothing is not None:
            require_not_negative(self, "velocity_smoothing")
        if self.swing not in ("model", "measurement"):
            raise InputError(f"swing: expected model or measurement, found {self.swing}")

    def system(self, sensors: SensorBeliefs, robot: Robot, **arguments: Any) -> "FrictionEstimator":
        """The estimator with these settings; arguments as of its class."""
        return ModelAidedEstimator(self, sensors, robot, **arguments)


def smoothing_time(noise: float, period: float) -> float:
    """Time constant of a low-pass of first order that blurs as much as it lets noise through [s].

    Over a reversal at acceleration a the time constant T lags by a T, and of white noise s at every
    `period` h it leaves s sqrt(h / 2 T).

    Args:
        noise: standard deviation of a velocity [rad/s].
        period: between two velocities [s].
    """
    return (noise**2 * period / (2 * _REVERSAL**2)) ** (1 / 3)


@njit(cache=True)
def smooth_velocity(
    posterior: Record,
    last: Record,
    measured: Record,
    elapsed: float,
    share: float,
    time: float,
) -> float:
    """Velocity that a friction law sees: a joint's over the tick, behind a low-pass of first order.

    Args:
        posterior, last: of `ModelAidedEstimator`, now, whose `velocity` is filled, and a tick ago.
        measured: posterior of `SensorMonitor`.
        share: of the velocity where the tick began in that over the tick, see `start_share`.
        time: time constant of the low-pass [s], 0 does not smooth.

    Returns:
        Share of what is measured now.
    """
    posterior, last, measured = posterior[()], last[()], measured[()]
    keep = math.exp(-elapsed / time) if time > 0 else 0.0
    for joint in range(len(posterior.velocity)):
        now, before = measured.joint_velocity[joint], last.joint_velocity[joint]
        over_tick = now + share * (before - now)
        posterior.velocity[joint] = keep * last.velocity[joint] + (1 - keep) * over_tick
    return (1.0 - keep) * (1.0 - share)


@njit(cache=True)
def _estimate_friction(
    posterior: Record,
    last: Record,
    elapsed: float,
    measured: Record,
    link_torque: Record,
    phi: np.ndarray,
    slopes: np.ndarray,
    phi_now: np.ndarray,
    shaped: np.ndarray,
    seen: float,
    known: Record,
) -> None:
    """One tick of `ModelAidedEstimator` but the first: a Kalman filter for each joint.

    Fills the posterior but for its `velocity`.

    Args:
        phi, slopes, shaped: see `FrictionRegressor`; of the tick that the link torque is of.
        phi_now: of the present tick.
        seen: share of the velocity that is measured now in that which the model sees.
        known: record with the numbers of `ModelAided` as `config`; `joint_leg` (n,), which leg each
            joint belongs to; `measures_swing`, whether the measurement counts while the leg swings;
            and `velocity_variance` of the encoders' noise [rad^2/s^2].
    """
    posterior, last, known = posterior[()], last[()], known[()]
    measured, link, config = measured[()], link_torque[()], known.config
    support, n, parameters = measured.support, len(known.joint_leg), len(phi)
    m = posterior.weights.shape[1]
    size = m + 2
    # Of the weights and of the disturbance, whose regressor is one.
    regressor, rise, x, column = np.ones(m + 1), np.zeros(m + 1), np.empty(m + 1), np.empty(size)
    posterior.status = measured.trust.max()
    keep, keep_doubt = math.exp(-elapsed / AGREEMENT_TIME), math.exp(-elapsed / _DOUBT_TIME)
    count, learning = (1.0 + keep) / (1.0 - keep), 1.0 - math.exp(-elapsed / NOISE_TIME)
    # Of the tick that was measured.
    T = link.duration if link.late > 0 else elapsed
    for joint in range(n):
        stands = support[known.joint_leg[joint]] > 0
        valid = link.valid[joint] > 0 and (known.measures_swing or stands)
        for k in range(m):
            x[k] = last.weights[joint, k]
        x[m] = last.disturbance[joint]
        posterior.past_velocity[0, joint] = posterior.velocity[joint]
        for age in range(1, len(last.past_velocity)):
            posterior.past_velocity[age, joint] = last.past_velocity[age - 1, joint]
        # By how much the friction rises with the velocity.
        put_regressor(rise, slopes, shaped, joint, n)
        put_regressor(regressor, phi, shaped, joint, n)
        slope = 0.0
        for k in range(m):
            slope += x[k] * rise[k]
        slope = max(0.0, seen * slope)
        P, noise = posterior.covariance[joint], last.noise[joint]
        for i in range(size):
            for k in range(size):
                P[i, k] = last.covariance[joint, i, k]
        impulse_uncertainty = P[0, 0]
        # Prediction: the impulse error grows by the friction's error times the tick ...
        innovation = last.impulse[joint] + T * link.residual[joint]
        added = T**2 * noise * link.torque_variance[joint]
        for k in range(m + 1):
            innovation -= T * regressor[k] * x[k]
        for i in range(size):
            c = 0.0
            for k in range(m + 1):
                c += T * P[i, 1 + k] * regressor[k]
            P[i, 0] += c
            if i > 0:
                added += T * regressor[i - 1] * c
        # ... which also comes of the noise in the velocity that the model sees. The measured
        # impulse has it, too, as it is made of the same velocity.
        velocity_variance = noise * known.velocity_variance
        through_model, through_link = T * slope, link.own_inertia[joint]
        added += through_model**2 * velocity_variance
        # Its own row and column are the same.
        P[0, 0] += P[0, 0] - impulse_uncertainty + added
        P[size - 1, size - 1] += config.disturbance_walk**2 * elapsed
        for i in range(1, m + 1):
            P[0, i] = P[i, 0]
            P[i, i] += config.parameter_walk**2 * elapsed
        P[0, size - 1] = P[size - 1, 0]
        # Update.
        for i in range(size):
            column[i] = P[i, 0]
        shared = through_model * through_link * velocity_variance
        column[0] += shared
        S = column[0] + shared + noise * link.impulse_variance[joint]
        impulse, velocity_error, unlikely = innovation, 0.0, 0.0
        if valid:
            likely = min(1.0, _GATE * math.sqrt(S) / max(abs(innovation), 1e-300))
            S_gate = S / likely**2
            # Nobody knows which is wrong, estimate or measurement.
            unlikely = abs(innovation) / T if likely < 1.0 else 0.0
            # From what it cannot explain the model learns nothing, the disturbance all.
            learns = count * last.agreement[joint] ** 2 <= _GATE**2 * S
            for i in range(size):
                gain, is_weight = column[i] / S_gate, 0 < i <= m
                if i == 0:
                    impulse -= gain * innovation
                elif learns or not is_weight:
                    x[i - 1] += gain * innovation
                for k in range(size):
                    if learns or not (is_weight and 0 < k <= m):
                        P[i, k] -= gain * column[k]
            of_velocity = -(through_model + through_link) * velocity_variance
            velocity_error = of_velocity / S_gate * innovation
            velocity_variance -= of_velocity**2 / S_gate
            # Differences of innovations show the noise, whatever the model is wrong by ...
            change = innovation - last.innovation[joint]
            rough = (
                min(LARGEST_SHARE, change * change / (2.0 * S)) if last.noise[joint] > 0 else 1.0
            )
            noise = max(1.0, noise * (1.0 + learning * (rough - 1.0)))
            # ... and their mean what the model is wrong by, beyond the noise.
            agreement = keep * last.agreement[joint] + (1.0 - keep) * likely * innovation
            posterior.agreement[joint] = agreement
            excess = count * agreement * agreement - AGREEMENT * S
            if excess > 0.0:
                unexplained = (column[0] / (S * T)) ** 2 * excess / count
                P[size - 1, size - 1] += unexplained * (1.0 - keep)
        else:
            # A joint that is not measured is left to its model.
            P[size - 1, size - 1] += x[m] ** 2
            x[m] = impulse = posterior.agreement[joint] = 0.0
            for i in range(size):
                P[0, i] = P[i, 0] = 0.0
        if link.late > 0:
            # What was measured is of some ticks ago, the estimate of now.
            put_regressor(regressor, phi_now, shaped, joint, n)
            velocity_error, velocity_variance = 0.0, noise * known.velocity_variance
        total = -slope * velocity_error
        variance = slope**2 * max(0.0, velocity_variance)
        for i in range(m + 1):
            total += regressor[i] * x[i]
            for k in range(m + 1):
                variance += regressor[i] * regressor[k] * P[1 + i, 1 + k]
        unsettled = 0.0
        for k in range(m):
            posterior.weights[joint, k] = x[k]
            settled = keep_doubt * last.settled[joint, k] + (1.0 - keep_doubt) * x[k]
            posterior.settled[joint, k] = settled
            unsettled += regressor[k] * (x[k] - settled)
        for k in range(parameters):
            posterior.parameters[joint, k] = x[k]
            posterior.parameter_variance[joint, k] = P[1 + k, 1 + k]
        posterior.friction[joint], posterior.noise[joint] = total, noise
        # What the model learned just now is not confirmed yet.
        doubt = max(abs(x[m]) + abs(unsettled), unlikely, keep_doubt * last.doubt[joint])
        posterior.doubt[joint] = doubt
        posterior.friction_std[joint] = math.sqrt(max(0.0, variance) + doubt**2)
        posterior.disturbance[joint], posterior.impulse[joint] = x[m], impulse
        posterior.innovation[joint] = innovation if valid else 0.0
        posterior.innovation_variance[joint] = S
        posterior.joint_velocity[joint] = measured.joint_velocity[joint] - velocity_error


class ModelAidedEstimator(FrictionEstimator):
    """Friction from measurement and model together; see `ModelAided` and `FrictionEstimator`.

    .. pydrake_system::

        name: ModelAidedEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior
        - (one for each field)

    Further fields, each (n,): `disturbance` d [Nm]; `impulse`, measured minus estimated impulse
    [Nm s], after the update; `velocity` that the model sees, `past_velocity` (room, n), that
    one now and in the ticks before, and `joint_velocity`, that measured less what is known of its
    noise [rad/s]. `innovation` is that of the impulse [Nm s]; `covariance` (n, m + 2, m + 2) is
    that of [impulse, weights, disturbance]; `weights` (n, ...) are the parameters and those of
    other shapes; `friction_std` (n,) [Nm] is the estimate's standard deviation; `noise` (n,) by how
    much the variance of the measurement's noise is larger than believed, at least 1; `agreement`
    (n,) the running mean of the innovation [Nm s]; `settled` (n, ...) the weights of some time ago;
    `doubt` (n,) the largest disturbance of late, with what has been learned since then [Nm].
    """

    def __init__(
        self,
        config: ModelAided,
        sensors: SensorBeliefs,
        robot: Robot,
        measurements: np.dtype,
        link_torque: np.dtype,
        clock: Clock,
    ):
        n = len(robot.joint_names)
        regressor = FrictionRegressor.of(config.model, robot, tuple(config.factors))
        further = ["disturbance", "impulse", "velocity", "joint_velocity", "friction_std"]
        further += ["noise", "agreement", "doubt"]
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(further, (n,))
        shapes["weights"] = shapes["settled"] = (n, regressor.weights)
        shapes["past_velocity"] = (room_for_delays(clock), n)
        super().__init__(
            regressor, robot, measurements, link_torque, clock, regressor.weights + 2, **shapes
        )
        noise = required(sensors.joint_velocity_noise, "joint_velocity_noise")
        usual, told = smoothing_time(noise, clock.period), config.velocity_smoothing
        self._config, self._smoothing = config, usual if told is None else told
        measures_swing = config.swing == "measurement"
        self._known = record(
            config=config,
            joint_leg=self._leg,
            measures_swing=measures_swing,
            velocity_variance=noise**2,
        )
        self._reading = clock.reading

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, link_torque = self._measurements.Eval(context), self._link.Eval(context)
        if math.isnan(elapsed):
            self._start(posterior, measured)
            return
        share = start_share(elapsed, self._reading)
        seen = smooth_velocity(posterior, last, measured, elapsed, share, self._smoothing)
        phi, slopes = phi_now, _ = self._regressor(posterior["velocity"])
        past, late = last["past_velocity"], float(link_torque["late"])
        if 0 < late <= len(past):
            phi, slopes = self._regressor(past[int(late) - 1])
        _estimate_friction(
            posterior,
            last,
            elapsed,
            measured,
            link_torque,
            phi,
            slopes,
            phi_now,
            self._regressor.shaped,
            seen,
            self._known,
        )

    def _start(self, posterior: np.ndarray, measured: np.ndarray) -> None:
        config, m = self._config, self._regressor.parameters
        uncertainty = [config.parameter_uncertainty**2] * m
        uncertainty += [config.shape_uncertainty**2] * (self._regressor.weights - m)
        posterior[...] = np.zeros((), self.posterior_type)
        posterior["status"] = measured["trust"].max()
        posterior["parameters"] = posterior["weights"][:, :m] = self._regressor.initial
        posterior["settled"] = posterior["weights"]
        posterior["noise"] = 1.0
        posterior["covariance"] = np.diag([0.0, *uncertainty, config.disturbance_uncertainty**2])
        posterior["velocity"] = posterior["joint_velocity"] = measured["joint_velocity"]
        posterior["past_velocity"] = posterior["velocity"]
