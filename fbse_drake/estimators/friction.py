"""From the measured friction, which is noisy, to the friction estimate.

Two LeafSystems with the same ports: `RecursiveLeastSquares` is the paper's: the measurement while
the leg stands, a model identified from it while the leg swings. `ModelAided` weighs both at all
times.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.errors import InputError, require_not_negative, require_positive
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.force_delay import room_for_delays
from fbse_drake.estimators.innovations import AGREEMENT, AGREEMENT_TIME, LARGEST_SHARE, NOISE_TIME
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, start_share
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import leg_of_joint

_MEASURED = {"measurements": "sensor_monitor", "link_torque": "link_torque"}


def _adopted_model() -> CoulombViscousFriction:
    return CoulombViscousFriction(transition={"all": 1.0e-6})


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Recursive least squares (64)-(67), one joint at a time.

    The covariance of the paper's 12 parameters never couples joints.
    """

    allows_for_delay: ClassVar[bool] = False
    # Does it know how well it knows the parameters of its model?
    states_variance: ClassVar[bool] = False
    # What feeds it, by input, and the stages whose work it does as well.
    sources: ClassVar[dict[str, str]] = _MEASURED
    stands_for: ClassVar[tuple[str, ...]] = ()

    # Adopted friction model, by default (57) with a sharp sign. Its linear parameters are
    # identified, from their values here on; the others stay as they are.
    model: FrictionModel = field(default_factory=_adopted_model)
    # Initial covariance of every parameter, Table II.
    covariance: float = 10.0
    # Weight that a tick of 1 ms keeps after the next; 1 never forgets.
    forgetting: float = 1.0
    # The covariance is set back to its initial value this often [s]; 0 never.
    reset_period: float = 0.0
    # Cut-off of the low-pass on the measured friction [Hz]; 0 does not filter, as the paper.
    cutoff: float = 0.0
    # What is taken while a leg swings: `model` as in the paper, or the `measurement` (which needs
    # fused accelerations).
    swing: str = "model"

    def __post_init__(self) -> None:
        if not 0 < self.forgetting <= 1:
            raise InputError(f"forgetting: expected a number in (0, 1], found {self.forgetting:g}")
        require_positive(self, "covariance")
        require_not_negative(self, "reset_period", "cutoff")
        if self.swing not in ("model", "measurement"):
            raise InputError(f"swing: expected model or measurement, found {self.swing}")

    def system(
        self,
        sensors: SensorBeliefs,  # noqa: ARG002
        robot: Robot,
        **arguments: Any,
    ) -> "FrictionEstimator":
        """The estimator with these settings; arguments as of its class."""
        return RecursiveLeastSquaresEstimator(self, robot, **arguments)


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
    states_variance: ClassVar[bool] = True
    sources: ClassVar[dict[str, str]] = _MEASURED
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


FrictionConfig = RecursiveLeastSquares | ModelAided

# An innovation counts as little as makes it just likely beyond so many standard deviations, ...
_GATE = 5.0
# ... and what the model does not explain, or a tick adds to it, is not known for so long [s].
_DOUBT_TIME = 0.1
# How fast the legs of a walking robot reverse, in its order of magnitude [rad/s^2].
_REVERSAL = 3.0


@dataclass(frozen=True)
class FrictionRegressor:
    """A joint torque effect as a regressor.

    It gives the basis torques, (n,) for each parameter, at a velocity (n,).
    """

    effect: type[JointTorqueEffect]
    # Values of the nonlinear parameters (nonlinear, n), and of the linear ones to start with
    # (n, parameters).
    nonlinear: np.ndarray
    initial: np.ndarray
    # The nonlinear parameters may be wrong by these factors: beside each basis torque that they
    # change there is its difference for each factor, with a weight of zero to start with.
    factors: tuple[float, ...] = ()

    @staticmethod
    def of(
        model: JointTorqueEffect, robot: Robot, factors: tuple[float, ...] = ()
    ) -> "FrictionRegressor":
        """Raises InputError for an unknown joint."""
        resolved = model.resolve(robot.description, key="estimator.friction.model")
        effect, nonlinear = resolved.effect, resolved.nonlinear
        return FrictionRegressor(effect, nonlinear, resolved.linear.T.copy(), factors)

    @property
    def parameters(self) -> int:
        """How many linear parameters the model has."""
        return self.initial.shape[1]

    @cached_property
    def shaped(self) -> np.ndarray:
        """Which parameters' basis torques change with the nonlinear parameters."""
        # Slow and fast: a sharp sign has long levelled off where a blunt one still rises.
        velocity = np.geomspace(1e-6, 10.0, 50)[:, None] * np.ones(len(self.initial))
        one, two = (f * self.nonlinear[:, None] for f in (1.0, 2.0))
        basis, other = (self.effect.basis(JointMotion(velocity), x)[0] for x in (one, two))
        changes = [np.any(x != y) for x, y in zip(basis, other, strict=True)]
        return np.flatnonzero(changes) if self.factors else np.empty(0, dtype=int)

    @property
    def weights(self) -> int:
        """How many parameters and differences there are."""
        return self.parameters + len(self.shaped) * len(self.factors)

    @cached_property
    def _all_nonlinear(self) -> np.ndarray:
        return np.hstack([f * self.nonlinear for f in (1.0, *self.factors)])

    @cached_property
    def _all_joints(self) -> np.ndarray:
        return np.tile(np.arange(len(self.initial)), 1 + len(self.factors))

    def __call__(self, velocity: np.ndarray) -> np.ndarray:
        """Basis torque of each parameter, and its slope over the velocity: (2, parameters, ...).

        Of all joints as adopted, then with each factor.
        """
        motion = JointMotion(velocity[self._all_joints])
        torques, slopes = self.effect.basis(motion, self._all_nonlinear)
        law = np.empty((2 * len(torques), len(self._all_joints)))
        for row, values in enumerate((*torques, *slopes)):
            law[row] = values  # A slope may be one number for all.
        return law.reshape(2, len(torques), -1)


def recursive_least_squares(
    parameters: np.ndarray, P: np.ndarray, phi: np.ndarray, measured: np.ndarray, forgetting: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One tick of (64)-(67) for n joints at once.

    Args:
        parameters: (n, m); P: their covariances (n, m, m).
        phi: regressors (n, m); measured: friction (n,) [Nm].
        forgetting: weight of the past, 1 for the paper's.

    Returns:
        Parameters, covariances, innovation (n,) and its variance (n,), in units of the measurement
        noise.
    """
    innovation = measured - (phi * parameters).sum(axis=1)  # (65)
    P_phi = (P @ phi[:, :, None])[:, :, 0]
    S = forgetting + (phi * P_phi).sum(axis=1)
    K = P_phi / S[:, None]  # (66)
    P_new = (P - K[:, :, None] * P_phi[:, None, :]) / forgetting  # (67)
    return parameters + K * innovation[:, None], P_new, innovation, S  # (64)


class FrictionEstimator(RecursiveEstimator):
    """What both friction estimators share.

    .. pydrake_system::

        name: FrictionEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior
        - (one for each field)

    Inputs: posteriors of `SensorMonitor` and `LinkTorqueEstimator`. Fields of the posterior:
    `friction` (n,) [Nm], the estimate for the tick that ends now; `parameters` (n, m), their
    `parameter_variance` (n, m) and `covariance` (n, m, m) of the model; `innovation` and
    `innovation_variance` (n,).
    """

    def __init__(
        self,
        regressor: FrictionRegressor,
        robot: Robot,
        measurements: np.dtype,
        link_torque: np.dtype,
        clock: Clock,
        covariance_size: int,
        **further: tuple[int, ...],
    ):
        """Declares ports and state.

        Args:
            regressor: of the friction.
            measurements, link_torque: types of the inputs' posteriors.
            covariance_size: how many states each joint's covariance has.
            further: shapes of further fields of the posterior.
        """
        self._regressor = regressor
        n, m = len(robot.joint_names), self._regressor.parameters
        posterior_type = record_type(
            time=(),
            status=(),
            friction=(n,),
            parameters=(n, m),
            parameter_variance=(n, m),
            covariance=(n, covariance_size, covariance_size),
            innovation=(n,),
            innovation_variance=(n,),
            **further,
        )
        super().__init__(posterior_type, clock)
        self._leg = leg_of_joint(robot)
        self._measurements = self._declare_record_input("measurements", measurements)
        self._link = self._declare_record_input("link_torque", link_torque)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        n, feet = len(robot.joint_names), len(robot.description.sides)
        measured = ("residual", "torque_variance", "impulse_variance", "own_inertia", "valid")
        return {
            # Joints of no leg ask for the last one's, so there is at least one.
            "measurements": record_type(
                trust=(2 + feet,), support=(max(1, feet),), joint_velocity=(n,)
            ),
            "link_torque": record_type(**dict.fromkeys(measured, (n,)), late=(), duration=()),
        }


class RecursiveLeastSquaresEstimator(FrictionEstimator):
    """Friction as in the paper (Sec. 6-7): measured in stance, modelled in swing.

    See `RecursiveLeastSquares` and `FrictionEstimator`.

    .. pydrake_system::

        name: RecursiveLeastSquaresEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior
        - (one for each field)

    Further fields: `filtered` (2, n), state of the low-pass [Nm]; `age` [s], time since the last
    reset of the covariance.
    """

    def __init__(
        self,
        config: RecursiveLeastSquares,
        robot: Robot,
        measurements: np.dtype,
        link_torque: np.dtype,
        clock: Clock,
    ):
        further = {"filtered": (2, len(robot.joint_names)), "age": ()}
        regressor = FrictionRegressor.of(config.model, robot)
        size = regressor.parameters
        super().__init__(regressor, robot, measurements, link_torque, clock, size, **further)
        self._config = config

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, link_torque = self._measurements.Eval(context), self._link.Eval(context)
        config = self._config
        posterior[...] = last
        posterior["status"] = max(measured["trust"].tolist())
        parameters, P = posterior["parameters"], posterior["covariance"]
        if math.isnan(elapsed):
            parameters[:] = self._regressor.initial
        age = math.inf if math.isnan(elapsed) else last["age"] + elapsed
        reset = config.reset_period
        if age == math.inf or (reset and age >= reset * (1 - 1e-9)):
            P[:], age = config.covariance * np.eye(P.shape[1]), 0.0
        posterior["age"] = age
        phi = self._regressor(measured["joint_velocity"])[0].T
        valid = link_torque["valid"] > 0
        if config.swing == "model":
            valid &= measured["support"][self._leg] > 0
        residual, filtered = link_torque["residual"], posterior["filtered"]
        if config.cutoff > 0 and not math.isnan(elapsed):
            # Two equal poles; a joint that was not measured starts afresh from its model.
            keep = math.exp(-2 * math.pi * config.cutoff * 1.55 * elapsed)
            modelled = (phi * parameters).sum(axis=1)
            once = keep * filtered[0] + (1 - keep) * residual
            filtered[0] = np.where(valid, once, modelled)
            twice = keep * filtered[1] + (1 - keep) * filtered[0]
            filtered[1] = np.where(valid, twice, modelled)
            smooth = filtered[1]
        else:
            smooth = residual
        if valid.any():
            forgets = config.forgetting != 1
            forgetting = config.forgetting ** (elapsed / 1e-3) if forgets else 1.0
            new, P_new, innovation, S = recursive_least_squares(
                parameters, P, phi, residual, forgetting
            )
            parameters[valid], P[valid] = new[valid], P_new[valid]
            posterior["innovation"], posterior["innovation_variance"] = innovation * valid, S
        posterior["parameter_variance"] = np.diagonal(P, axis1=1, axis2=2)
        posterior["friction"] = np.where(valid, smooth, (phi * parameters).sum(axis=1))


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
    posterior: np.ndarray,
    last: np.ndarray,
    measured: np.ndarray,
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
def put_regressor(
    row: np.ndarray, basis: np.ndarray, shaped: np.ndarray, joint: int, n: int
) -> None:
    """Fills the regressor of the weights of one of n joints, see `FrictionRegressor`."""
    k, other = len(basis), n + joint
    for parameter in range(k):
        row[parameter] = basis[parameter, joint]
    while k < len(row) - 1:
        for parameter in shaped:
            row[k] = basis[parameter, other] - basis[parameter, joint]
            k += 1
        other += n


@njit(cache=True)
def _estimate_friction(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    link_torque: np.ndarray,
    phi: np.ndarray,
    slopes: np.ndarray,
    phi_now: np.ndarray,
    shaped: np.ndarray,
    seen: float,
    known: np.ndarray,
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
        regressor = FrictionRegressor.of(config.model, robot, config.factors)
        further = ("disturbance", "impulse", "velocity", "joint_velocity", "friction_std")
        further += ("noise", "agreement", "doubt")
        shapes = dict.fromkeys(further, (n,))
        shapes["weights"] = shapes["settled"] = (n, regressor.weights)
        shapes["past_velocity"] = (room_for_delays(clock), n)
        super().__init__(
            regressor, robot, measurements, link_torque, clock, regressor.weights + 2, **shapes
        )
        self._config, self._smoothing = config, config.velocity_smoothing
        if self._smoothing is None:
            self._smoothing = smoothing_time(sensors.joint_velocity_noise, clock.period)
        measures_swing = config.swing == "measurement"
        self._known = record(
            config=config,
            joint_leg=self._leg,
            measures_swing=measures_swing,
            velocity_variance=sensors.joint_velocity_noise**2,
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
