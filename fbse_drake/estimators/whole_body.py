"""Friction through the equation of motion of the whole robot.

One extended Kalman filter takes the velocities of base and joints from the equation of motion and
identifies the friction law in it at the same time. So the law is asked for the velocity that fits
the torques, not for the one that a noisy encoder shows, and is identified at it.
"""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.errors import require_not_negative, required
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.floating_base import ImuMount, model_type
from fbse_drake.estimators.force_delay import room_for_delays
from fbse_drake.estimators.friction import FrictionRegressor, put_regressor
from fbse_drake.estimators.innovations import AGREEMENT, AGREEMENT_TIME, LOG_OF_ONE, learned_noise
from fbse_drake.estimators.link_torque import wrench_variance
from fbse_drake.estimators.records import Record, record, record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, start_share
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.estimators.spatial import (
    cross,
    put,
    rotate,
    rotation,
    skew,
    subtract,
    vector,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads

# A wrench, or the force on a pad, is beyond its sensors' noise above these quantiles of chi^2 with
# six and three degrees of freedom (one in 3000).
_WRENCH_GATE, _PAD_GATE = 25.1, 18.5
# An innovation counts as little as makes it just likely beyond so many standard deviations, ...
_GATE = 5.0
# ... and what the law does not explain, or a tick adds to it, is not known for so long [s].
_DOUBT_TIME = 0.1
# A foot that carries less than the first of these shares of the load does not stand, and below the
# second it moves more easily the less it carries.
_LEAST_LOAD, _FIRM_LOAD = 0.05, 0.5
# The law is linearised where a tick is expected to end, then where the measurements say that it
# ended.
_ITERATIONS = 2


@dataclass(frozen=True)
class WholeBody:
    """Extended Kalman filter for velocities and friction laws of the whole robot.

    Its states are the angular velocity of the base, the velocities of the joints, the linear
    parameters of each joint's friction law, and what the equation of motion lacks in each of its
    rows (wrong masses, friction that follows no law), a random walk. It takes command, foot forces
    and accelerometer for granted but for their noise; gyro and encoders are measurements, and flat
    feet that stand do not turn. Friction that rises steeply with the velocity is solved implicitly,
    and linearised where the measurements say that a tick ended: velocity and law are learned
    together, and one that does not fit the other would be learned wrong.

    Foot forces that come late belong to the tick in which they were: the filter is then so many
    ticks behind, and the law is asked for the velocity that is measured now. What else is wrong
    with forces and commands makes the laws wrong.
    """

    # Does it go back to the tick that late forces belong to?
    allows_for_delay: ClassVar[bool] = True
    # Does it know how well it knows the parameters of its model?
    states_variance: ClassVar[bool] = True
    # What it hears beside measurements and link torque.
    sources: ClassVar[dict[str, str]] = {
        "model_over_step": "model.over_step",
        "attitude": "attitude",
    }

    # Friction model, of which the linear parameters are identified, from their values here on; the
    # others stay as they are.
    model: FrictionModel = field(default_factory=CoulombViscousFriction)
    # Initial standard deviation of every parameter [its unit].
    parameter_uncertainty: float = 3.0
    # By what the nonlinear parameters (a transition velocity) may be wrong: the model is a mixture
    # of such shapes; and the initial standard deviation of each one's weight [Nm].
    factors: list[float] = field(default_factory=lambda: [0.2, 5.0])
    shape_uncertainty: float = 3.0
    # Random walk of the torque that a joint's row lacks [Nm/sqrt(s)], and its initial standard
    # deviation [Nm]; and of the moment that the base's rows lack.
    disturbance_walk: float = 0.1
    disturbance_uncertainty: float = 0.1
    moment_walk: float = 0.5
    moment_uncertainty: float = 0.5
    # How fast a flat foot turns about its normal while it stands, in spite of all [rad/s]; more is
    # learned.
    foot_turning: float = 1.0e-4

    def __post_init__(self) -> None:
        require_not_negative(self, "parameter_uncertainty", "shape_uncertainty")
        require_not_negative(self, "disturbance_walk", "disturbance_uncertainty")
        require_not_negative(self, "moment_walk", "moment_uncertainty", "foot_turning")

    def system(self, sensors: SensorBeliefs, robot: Robot, **arguments: Any) -> "WholeBodyFilter":
        """The estimator with these settings; arguments as of its class."""
        return WholeBodyFilter(self, sensors, robot, **arguments)


@njit(cache=True)
def _put_equation_of_motion(
    past: Record,
    at: int,
    measured: Record,
    model: Record,
    attitude: Record,
    torque_command: np.ndarray,
    known: Record,
) -> None:
    """Rows of base turning and joints, where the base's acceleration is taken at the IMU.

    The accelerometer measures there, so what it says is no function of the unknown angular
    acceleration; moments are about the IMU.

    Args:
        past: filled, see `WholeBodyFilter`: of inertia a = push + what feet push - friction, with a
            the base's angular acceleration and those of the joints.
        at: where in it.
    """
    R_BI, p = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    # a_B = a_I - w_dot x p - w x (w x p), of the IMU's origin I seen from the base's.
    w, moved = vector(model.velocity), np.empty((3, 3))
    put(moved, skew(p))
    force = subtract(vector(measured.mean.specific_force), vector(attitude.acceleration_bias))
    linear = np.empty(3)
    put(linear, subtract(rotate(R_BI, force), cross(w, cross(w, p))))
    base, joints = model.base_inertia, model.mass_matrix
    A, of_linear, push = past.inertia[at], past.of_linear[at], past.push[at]
    of_linear[:3] = base[:3, 3:] + moved.T @ np.ascontiguousarray(base[3:, 3:])
    of_linear[3:] = joints[:, 3:6]
    A[:3, :3] = base[:3, :3] + moved.T @ np.ascontiguousarray(base[3:, :3]) + of_linear[:3] @ moved
    A[3:, :3] = joints[:, :3] + of_linear[3:] @ moved
    A[:3, 3:] = A[3:, :3].T
    A[3:, 3:] = joints[:, 6:]
    push[:3] = -model.base_bias[:3] - moved.T @ model.base_bias[3:]
    push[3:] = torque_command - model.bias
    push -= of_linear @ linear
    for foot in range(len(known.has_pads)):
        J, lever = model.foot_jacobian[foot], past.lever[at, foot]
        lever[:, :3] = J[:, :3] + np.ascontiguousarray(J[:, 3:6]) @ moved
        lever[:, 3:] = J[:, 6:]
        past.turning[at, foot] = model.foot_bias[foot, 2]


@njit(cache=True)
def _pushed(
    past: Record, at: int, measured: Record, link: Record, known: Record
) -> tuple[np.ndarray, np.ndarray]:
    """The push (r,) in an equation of motion, feet included, and its variance (r, r)."""
    push, of_linear = past.push[at].copy(), past.of_linear[at]
    variance = known.sensors.acceleration_noise**2 * (of_linear @ of_linear.T)
    for foot in range(len(known.has_pads)):
        lever, wrench, excess = past.lever[at, foot], link.wrench[foot], link.force_noise[foot]
        of_wrench = excess * known.wrench_variance[foot]
        if not known.has_pads[foot] and _pushes(wrench, of_wrench, _WRENCH_GATE):
            push += lever.T @ wrench
            variance += (lever.T * of_wrench) @ lever
        if known.has_pads[foot]:
            _add_pads(push, variance, lever, measured.mean.pad_force, foot, excess, known)
    return push, variance


@njit(cache=True)
def _pushes(force: np.ndarray, variance: np.ndarray, gate: float) -> bool:
    """Does a sensor show more than its noise? What does not touch the ground has no force."""
    distance = 0.0
    for i in range(len(force)):
        # A point foot has no moment.
        if variance[i] > 0.0:
            distance += force[i] ** 2 / variance[i]
    return distance > gate


@njit(cache=True)
def _add_pads(
    push: np.ndarray,
    variance: np.ndarray,
    lever: np.ndarray,
    force: np.ndarray,
    foot: int,
    excess: float,
    known: Record,
) -> None:
    """Adds what the pads of a foot that touch the ground push, (r,), and its variance, (r, r).

    Args:
        lever: of the wrench on the sole, (6, r).
        force: of all pads, (P, 3) [N].
        excess: by how much the variance of the forces is larger than believed.
    """
    pads, of_force = known.pads, np.full(3, excess * known.sensors.force_noise**2)
    for pad in range(len(force)):
        if pads.foot[pad] == foot and _pushes(force[pad], of_force, _PAD_GATE):
            arm = np.empty((3, 3))
            put(arm, skew(vector(pads.position[pad])))
            # A force f at p has the moment p x f.
            of_pad = lever[3:] + arm.T @ lever[:3]
            push += of_pad.T @ force[pad]
            variance += of_force[0] * (of_pad.T @ of_pad)


@njit(cache=True)
def _inverse(A: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric positive definite matrix."""
    inverse = np.linalg.inv(A)
    return 0.5 * (inverse + inverse.T)


@njit(cache=True)
def _implicit_step(
    x: Record, velocity: np.ndarray, A: np.ndarray, push: np.ndarray, T: float
) -> tuple[np.ndarray, np.ndarray]:
    """A Newton step of velocity' = velocity + T A^-1 (push - lacking - friction(velocity')).

    Args:
        x: record with `lacking` (r,), and the friction's linearisation: `friction_there` (n,) and
            `slope` (n,) at `law_velocity` (n,).
        velocity: where the step in time begins, (r,).

    Returns:
        velocity' (r,), and the inverse (r, r) of A + T slope.
    """
    implicit, impulse = A.copy(), T * (push - x.lacking)
    for joint in range(len(x.slope)):
        slope, ahead = x.slope[joint], velocity[3 + joint] - x.law_velocity[joint]
        implicit[3 + joint, 3 + joint] += T * slope
        impulse[3 + joint] -= T * (x.friction_there[joint] + slope * ahead)
    inverse = _inverse(implicit)
    return velocity + inverse @ impulse, inverse


@njit(cache=True)
def _linearise(
    x: Record,
    velocity: np.ndarray,
    weights: np.ndarray,
    phi: tuple[np.ndarray, ...],
    slopes: tuple[np.ndarray, ...],
    shaped: np.ndarray,
) -> None:
    """Fills the linearisation of the friction at velocities of the joints (n,) and weights (n, m).

    Args:
        phi, slopes, shaped: see `FrictionRegressor`.
    """
    n, m = x.weights.shape
    row = np.ones(m + 1)
    for joint in range(n):
        put_regressor(row, slopes, shaped, joint, n)
        slope = 0.0
        for k in range(m):
            slope += row[k] * weights[joint, k]
        put_regressor(row, phi, shaped, joint, n)
        there = 0.0
        for k in range(m):
            x.regressor[joint, k] = row[k]
            there += row[k] * x.weights[joint, k]
        # A law that falls would make the step in time unstable.
        x.slope[joint], x.friction_there[joint] = max(0.0, slope), there
        x.law_velocity[joint] = velocity[joint]


@njit(cache=True)
def _propagate(
    x: Record, A: np.ndarray, inverse: np.ndarray, variance: np.ndarray, T: float
) -> None:
    """Covariance after a step in time, in place: that of the velocities (r,) that come first.

    The others, `lacking` (r,) and `weights` (n, m), stay.

    Args:
        inverse: see `_implicit_step`; variance: of the push, (r, r).
    """
    P, (n, m) = x.covariance, x.weights.shape
    r, size = 3 + n, len(x.covariance)
    moved = A @ P[:r]
    for i in range(r):
        for k in range(size):
            moved[i, k] -= T * P[r + i, k]
    for joint in range(n):
        for j in range(m):
            at, share = 2 * r + m * joint + j, T * x.regressor[joint, j]
            for k in range(size):
                moved[3 + joint, k] -= share * P[at, k]
    moved = inverse @ moved
    own = np.ascontiguousarray(moved[:, :r]) @ A
    for i in range(r):
        for k in range(r):
            own[i, k] -= T * moved[i, r + k]
        for joint in range(n):
            for j in range(m):
                at, share = 2 * r + m * joint + j, T * x.regressor[joint, j]
                own[i, 3 + joint] -= share * moved[i, at]
    own = own @ inverse + T * T * (inverse @ variance @ inverse)
    P[:r] = moved
    P[:, :r] = moved.T
    P[:r, :r] = 0.5 * (own + own.T)


@njit(cache=True)
def _state(x: Record) -> np.ndarray:
    """[velocities, lacking, weights], a copy."""
    return np.concatenate((x.velocity, x.lacking, x.weights.copy().ravel()))


@njit(cache=True)
def _put_state(x: Record, state: np.ndarray) -> None:
    r = len(x.velocity)
    x.velocity[:], x.lacking[:] = state[:r], state[r : 2 * r]
    x.weights[:] = state[2 * r :].reshape(x.weights.shape)


@njit(cache=True)
def _learning(x: Record, last: Record) -> np.ndarray:
    """Which states are corrected: 1, but 0 for the laws of late after a contradiction, (size,).

    What is contradicted may be a law or what laws are learned from, and nobody knows.
    """
    learning, of_laws = np.ones(len(x.covariance)), 2 * len(x.velocity)
    learning[of_laws:] = 1.0 if last.calm >= _DOUBT_TIME else 0.0
    return learning


@njit(cache=True)
def _is_contradicted(x: Record, row: int) -> bool:
    """Do the measurements keep saying, beyond chance, that torque is lacking in this row?"""
    return x.unexplained[row] ** 2 > _GATE**2 * x.unexplained_variance[row]


@njit(cache=True)
def _correct(
    state: np.ndarray, P: np.ndarray, column: np.ndarray, learning: np.ndarray, S: float, y: float
) -> None:
    """Kalman update with an innovation y of variance S, in place.

    States that do not learn are considered, as in a Schmidt-Kalman filter: their uncertainty counts
    and stays.

    Args:
        column: covariance of the states with the innovation, overwritten.
    """
    size = len(state)
    corrected = column * learning
    for j in range(size):
        gain, others = column[j] / S, column if learning[j] > 0.0 else corrected
        state[j] += learning[j] * gain * y
        for k in range(size):
            P[j, k] -= gain * others[k]


@njit(cache=True)
def _confirmed(now: float, before: float) -> float:
    """What two ticks say is no outlier: the smaller of them, 0 if they have not the same sign."""
    return min(abs(now), abs(before)) if now * before > 0.0 else 0.0


@njit(cache=True)
def _listen(
    x: Record,
    last: Record,
    predicted: np.ndarray,
    missed: np.ndarray,
    learning: np.ndarray,
    elapsed: float,
    known: Record,
) -> np.ndarray:
    """Kalman updates with gyro and encoders, one after the other.

    Returns:
        How they would correct the velocities if no innovation were too large to count, (r,).

    Args:
        predicted: velocities (r,) before the updates.
        missed: what is added to their variances, as pushes between rare readings are missed, (r,).
        learning: see `_learning`.
    """
    P, r, state = x.covariance, len(x.velocity), _state(x)
    column, correction = np.empty(len(P)), np.zeros(r)
    for i in range(r):
        # How noisy a sensor is shows in its steps, whatever the model is wrong by.
        step = x.reading[i] - last.reading[i] - (predicted[i] - last.velocity[i])
        believed = 2.0 * last.noise[i] * known.variance[i] + missed[i]
        share = step * step / believed
        x.noise[i] = learned_noise(last.noise[i], share, LOG_OF_ONE, elapsed)
        innovation, variance = x.reading[i] - state[i], x.noise[i] * known.variance[i]
        S = P[i, i] + variance
        twice = _confirmed(innovation, last.innovation[i])
        if twice**2 > _GATE**2 * S:
            P[i, i] += twice**2
            S += twice**2
        x.innovation[i], x.innovation_variance[i] = innovation, S
        S_gate = S * max(1.0, innovation**2 / (_GATE**2 * S))
        column[:] = P[i]
        correction += column[:r] * (innovation / S)
        _correct(state, P, column, learning, S_gate, innovation)
    _put_state(x, state)
    return correction


@njit(cache=True)
def _watch_corrections(
    x: Record,
    last: Record,
    A: np.ndarray,
    correction: np.ndarray,
    covariance: np.ndarray,
    T: float,
) -> None:
    """Learns what is lacking from corrections of the velocities that agree from tick to tick.

    As torques they show the row in which it is. A good filter's corrections are white.

    Args:
        A: inertia (r, r).
        correction: of the velocities, had no innovation been too large to count, (r,).
        covariance: of the velocities before they were corrected, (r, r).
    """
    P, r = x.covariance, len(x.velocity)
    keep = math.exp(-T / AGREEMENT_TIME)
    x.calm = last.calm + T
    torque = A @ correction / T
    halfway = A @ (covariance - P[:r, :r])
    for i in range(r):
        variance, before = max(0.0, halfway[i] @ A[i]) / (T * T), last.correction[i]
        x.correction[i], x.correction_variance[i] = torque[i], variance
        x.unexplained[i] = keep * last.unexplained[i] + (1.0 - keep) * torque[i]
        of_last = last.unexplained_variance[i]
        x.unexplained_variance[i] = keep**2 * of_last + (1.0 - keep) ** 2 * variance
        excess = x.unexplained[i] ** 2 - AGREEMENT * x.unexplained_variance[i]
        if excess > 0.0:
            P[r + i, r + i] += (1.0 - keep) * excess
        twice = _confirmed(torque[i], before)
        if twice**2 > _GATE**2 * variance:
            P[r + i, r + i] += twice**2
        if _is_contradicted(x, i):
            x.calm = 0.0


@njit(cache=True)
def _tick_of_forces(x: Record) -> int:
    """Where in the past the tick is to which the forces belong that are read now."""
    return (int(x.newest) - int(x.late)) % len(x.past.duration)


@njit(cache=True)
def _listen_to_feet(
    x: Record,
    last: Record,
    measured: Record,
    link: Record,
    learning: np.ndarray,
    T: float,
    known: Record,
) -> None:
    """Kalman updates with flat feet that stand: they do not turn about their normals."""
    P, r, state, load = x.covariance, len(x.velocity), _state(x), 0.0
    past, at = x.past, _tick_of_forces(x)
    for foot in range(len(known.is_flat)):
        load += max(0.0, link.wrench[foot, 5])
    for foot in range(len(known.is_flat)):
        share = link.wrench[foot, 5] / max(load, 1.0)
        if not known.is_flat[foot] or not measured.support[foot] > 0 or share < _LEAST_LOAD:
            continue
        # Where the tick ends, of which the model knows where it began.
        row = past.lever[at, foot, 2]
        column = row @ P[:r]
        innovation = -(row @ state[:r]) - T * past.turning[at, foot]
        believed = (known.config.foot_turning * max(1.0, _FIRM_LOAD / share)) ** 2
        S = column[:r] @ row + last.foot_noise[foot] * believed
        surprise = innovation**2 / S
        x.foot_noise[foot] = learned_noise(last.foot_noise[foot], surprise, LOG_OF_ONE, T)
        # A foot that turns is no measurement.
        if surprise < _GATE**2:
            _correct(state, P, column, learning, S, innovation)
    _put_state(x, state)


@njit(cache=True)
def _forget_motion(posterior: Record, known: Record) -> None:
    """Where a sensor is not trusted, velocities are what was measured, and nothing is lacking."""
    x, known = posterior[()], known[()]
    P, r = x.covariance, len(x.velocity)
    P[:r] = 0.0
    P[:, :r] = 0.0
    for i in range(r):
        P[i, i] = x.noise[i] * known.variance[i]
        P[r + i, r + i] += x.lacking[i] ** 2
    x.velocity[:], x.lacking[:], x.unexplained[:] = x.reading, 0.0, 0.0
    x.correction[:] = 0.0


@njit(cache=True)
def _conclude(
    posterior: Record,
    last: Record,
    elapsed: float,
    velocity: np.ndarray,
    phi: tuple[np.ndarray, ...],
    slopes: tuple[np.ndarray, ...],
    shaped: np.ndarray,
    known: Record,
) -> None:
    """Fills friction and its standard deviation, by the law where the tick ends.

    Args:
        velocity: see `_present_velocity`.
        phi, slopes, shaped: see `FrictionRegressor`.
    """
    x, last, known = posterior[()], last[()], known[()]
    _linearise(x, velocity, x.weights, phi, slopes, shaped)
    P, (n, m) = x.covariance, x.weights.shape
    r, keep = 3 + n, math.exp(-elapsed / _DOUBT_TIME)
    # Where readings contradict the model, all that follows from both is as uncertain as they are
    # apart (the Birge ratio).
    share = x.innovation**2 / np.maximum(x.innovation_variance, 1e-300)
    surprise = share.mean() if share.max() > _GATE**2 else 1.0
    x.surprise = max(1.0, surprise, 1.0 + keep * (last.surprise - 1.0))
    for joint in range(n):
        of_velocity, of_lacking, first = 3 + joint, r + 3 + joint, 2 * r + m * joint
        slope, lacking = x.slope[joint], x.lacking[3 + joint]
        variance = P[of_lacking, of_lacking]
        if x.late > 0.0:
            variance += slope * slope * x.noise[of_velocity] * known.variance[of_velocity]
            slope = 0.0
        variance += slope * slope * P[of_velocity, of_velocity]
        variance += 2.0 * slope * P[of_velocity, of_lacking]
        unsettled = 0.0
        for j in range(m):
            share, at = x.regressor[joint, j], first + j
            variance += 2.0 * share * (slope * P[of_velocity, at] + P[of_lacking, at])
            for k in range(m):
                variance += share * x.regressor[joint, k] * P[at, first + k]
            settled = keep * last.settled[joint, j] + (1.0 - keep) * x.weights[joint, j]
            x.settled[joint, j] = settled
            unsettled += share * (x.weights[joint, j] - settled)
        x.friction[joint] = x.friction_there[joint] + lacking
        # What the law does not explain, or learned just now, is not confirmed yet; and nobody
        # knows which of model and measurement is wrong that contradict each other.
        contradicted = abs(x.unexplained[of_velocity]) if _is_contradicted(x, of_velocity) else 0.0
        if x.correction[of_velocity] ** 2 > _GATE**2 * x.correction_variance[of_velocity]:
            contradicted = max(contradicted, abs(x.correction[of_velocity]))
        doubt = max(abs(lacking) + abs(unsettled), contradicted)
        x.doubt[joint] = max(doubt, keep * last.doubt[joint])
        x.friction_std[joint] = math.sqrt(x.surprise * max(0.0, variance) + x.doubt[joint] ** 2)
        for k in range(x.parameters.shape[1]):
            x.parameters[joint, k] = x.weights[joint, k]
            x.parameter_variance[joint, k] = P[first + k, first + k]


@njit(cache=True)
def _begin(
    posterior: Record,
    last: Record,
    elapsed: float,
    measured: Record,
    model: Record,
    link_torque: Record,
    attitude: Record,
    torque_command: np.ndarray,
    known: Record,
) -> float:
    """Takes over what was known a tick ago, and remembers the tick but for its forces.

    Args:
        elapsed: of the tick [s], 0 of the first.

    Returns:
        Duration of the tick to which the forces belong that are read now [s]; 0 unless all is known
        that its equation of motion needs.
    """
    x, last, measured = posterior[()], last[()], measured[()]
    model, attitude, known, link = model[()], attitude[()], known[()], link_torque[()]
    posterior[()] = last
    x.status, x.late = measured.trust.max(), min(link.late, len(x.past.duration) - 1.0)
    x.innovation[:] = 0.0
    ticks, of_past = len(x.past.duration), x.past
    newest = (int(last.newest) + 1) % ticks
    x.newest = newest
    of_past.duration[newest] = elapsed
    rate = subtract(vector(measured.angular_velocity), vector(attitude.angular_velocity_bias))
    put(of_past.reading[newest, :3], rotate(rotation(known.mount.R_BI), rate))
    of_past.reading[newest, 3:] = measured.joint_velocity
    is_known = x.status == 0.0 and last.status == 0.0 and np.isfinite(torque_command).all()
    is_known = elapsed > 0.0 and is_known and model.velocity.any()
    of_past.known[newest] = 1.0 if is_known else 0.0
    if is_known:
        _put_equation_of_motion(of_past, newest, measured, model, attitude, torque_command, known)
    then = _tick_of_forces(x)
    x.reading[:] = of_past.reading[then]
    r = len(x.lacking)
    for i in range(r):
        walk = known.config.moment_walk if i < 3 else known.config.disturbance_walk
        x.covariance[r + i, r + i] += walk**2 * elapsed
    if x.late != last.late:
        _distrust_laws(x, known)
        return 0.0
    return of_past.duration[then] * of_past.known[then] if is_known else 0.0


@njit(cache=True)
def _distrust_laws(x: Record, known: Record) -> None:
    """What was learned with forces of another time is as uncertain as at the start."""
    P, r, (n, m) = x.covariance, len(x.velocity), x.weights.shape
    for joint in range(n):
        for k in range(m):
            at = 2 * r + m * joint + k
            P[at, :] = 0.0
            P[:, at] = 0.0
            P[at, at] = known.weight_variance[k]


@njit(cache=True)
def _predict(
    posterior: Record,
    last: Record,
    elapsed: float,
    measured: Record,
    link_torque: Record,
    known: Record,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The velocities at which the tick ends, (r,), with the law linearised where it was last.

    Returns:
        Them, what `_pushed` returns, and the variance (r,) of what pushed between the readings,
        independent in each row.
    """
    x, last, known = posterior[()], last[()], known[()]
    at = _tick_of_forces(x)
    push, variance = _pushed(x.past, at, measured[()], link_torque[()], known)
    velocity, _ = _implicit_step(x, x.velocity, x.past.inertia[at], push, elapsed)
    # What rare readings leave out is as large as they differ.
    missed = (start_share(elapsed, known.reading) * (push - last.pushed)) ** 2
    x.pushed[:] = push
    return velocity, push, variance, missed


@njit(cache=True)
def _update(
    posterior: Record,
    last: Record,
    elapsed: float,
    begun: tuple[np.ndarray, np.ndarray],
    ahead: tuple[np.ndarray, np.ndarray],
    motion: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    phi: tuple[np.ndarray, ...],
    slopes: tuple[np.ndarray, ...],
    shaped: np.ndarray,
    measured: Record,
    link_torque: Record,
    known: Record,
) -> None:
    """Covariance and measurements of a tick, the law linearised where it is expected to end.

    Args:
        begun: state and covariance that `_begin` has made.
        ahead: velocities of the joints (n,) and weights (n, m) where the law is linearised.
        motion: see `_predict`.
        phi, slopes, shaped: see `FrictionRegressor`.
    """
    x, last, known = posterior[()], last[()], known[()]
    _, push, variance, missed = motion
    inertia = x.past.inertia[_tick_of_forces(x)]
    _put_state(x, begun[0])
    x.covariance[:] = begun[1]
    _linearise(x, ahead[0], ahead[1], phi, slopes, shaped)
    predicted, inverse = _implicit_step(x, x.velocity, inertia, push, elapsed)
    x.velocity[:] = predicted
    _propagate(x, inertia, inverse, variance + np.diag(missed), elapsed)
    of_velocity = elapsed * elapsed * (inverse**2 @ missed)
    r, learning = len(push), _learning(x, last)
    expected = x.covariance[:r, :r].copy()
    correction = _listen(x, last, predicted, of_velocity, learning, elapsed, known)
    _listen_to_feet(x, last, measured[()], link_torque[()], learning, elapsed, known)
    _watch_corrections(x, last, inertia, correction, expected, elapsed)


@njit(cache=True)
def _begun(posterior: Record) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance, copies."""
    return _state(posterior[()]), posterior[()].covariance.copy()


@njit(cache=True)
def _present_velocity(posterior: Record) -> np.ndarray:
    """Of the joints, (n,) [rad/s]: of what was long ago nobody knows more than is measured."""
    x = posterior[()]
    if x.late == 0.0:
        return x.velocity[3:].copy()
    return x.past.reading[int(x.newest), 3:].copy()


class WholeBodyFilter(RecursiveEstimator):
    """Friction through the whole robot's equation of motion, see `WholeBody`.

    .. pydrake_system::

        name: WholeBodyFilter
        input_ports:
        - measurements
        - link_torque
        - model_over_step
        - attitude
        - torque_command
        output_ports:
        - posterior
        - (one for each field)

    Inputs: posteriors of `SensorMonitor`, `LinkTorqueEstimator`, `FloatingBaseModel` over the step
    and `AttitudeEstimator` or `InvariantBaseFilter`; `torque_command` (n,) [Nm] is remembered for
    the next tick. Fields of the posterior, for n joints, r = 3 + n and m weights of each law:

        friction, friction_std   (n,)    the estimate for the tick that ends now [Nm]
        parameters, parameter_variance   (n, ...)  linear parameters of the law
        velocity                 (r,)    of the base's turning in its axes, and of the joints
                                         [rad/s]
        lacking                  (r,)    torque that the equation of motion lacks [Nm]
        weights, settled         (n, m)  parameters and those of other shapes; the same some time
                                         ago
        covariance               of [velocity, lacking, weights], (2 r + n m, 2 r + n m)
        innovation, innovation_variance, agreement   (r,)  of gyro and encoders [rad/s]; the last
                                         is the innovation's running mean
        pushed                   (r,)    commands, feet and all that is not friction [Nm]
        noise                    (r,)    by how much the variance of these is larger than believed,
                                         at least 1
        foot_noise               (feet,) the same of standing feet's turning
        reading                  (r,)    what they read, free of the bias [rad/s]
        late                     ()      how many ticks ago the forces were what is read now
        past, newest             what is known of the latest ticks but for the forces, and which is
                                 the newest of them: `duration` (room,) [s], `known` (room,),
                                 `reading` (room, r), and of the equation of motion `inertia`
                                 (room, r, r), `push` (room, r), its part `of_linear` (room, r, 3)
                                 in the base's linear acceleration, the `lever` (room, feet, 6, r)
                                 of the wrenches, and how soles turn without accelerations,
                                 `turning` (room, feet) [rad/s^2]; see `room_for_delays`
        doubt                    (n,)    the largest `lacking` of late, with what has been learned
                                         since then, or torque by which measurements contradict the
                                         model [Nm]
        law_velocity, friction_there, slope, regressor   the law where it was linearised
    """

    def __init__(
        self,
        config: WholeBody,
        sensors: SensorBeliefs,
        robot: Robot,
        measurements: np.dtype,
        link_torque: np.dtype,
        model_over_step: np.dtype,
        attitude: np.dtype,
        clock: Clock,
    ):
        """Declares ports and state.

        Args:
            measurements, link_torque, model_over_step, attitude: types of the inputs.
        """
        self._config = config
        self._regressor = FrictionRegressor.of(config.model, robot, tuple(config.factors))
        n, m = len(robot.joint_names), self._regressor.weights
        r, pads, legs = 3 + n, FootPads(robot), robot.description.legs
        per_row = ("velocity", "lacking", "innovation", "innovation_variance", "unexplained")
        per_row += ("unexplained_variance", "correction", "correction_variance")
        per_joint = ("friction", "friction_std", "doubt", "law_velocity", "friction_there", "slope")
        room, feet = room_for_delays(clock), len(legs)
        posterior_type = record_type(
            time=(),
            status=(),
            late=(),
            newest=(),
            surprise=(),
            calm=(),
            past=record_type(
                duration=(room,),
                known=(room,),
                reading=(room, r),
                inertia=(room, r, r),
                of_linear=(room, r, 3),
                push=(room, r),
                lever=(room, feet, 6, r),
                turning=(room, feet),
            ),
            **dict.fromkeys((*per_row, "noise", "reading", "pushed"), (r,)),
            **dict.fromkeys(per_joint, (n,)),
            foot_noise=(feet,),
            **dict.fromkeys(("parameters", "parameter_variance"), (n, self._regressor.parameters)),
            **dict.fromkeys(("weights", "settled", "regressor"), (n, m)),
            covariance=(2 * r + n * m, 2 * r + n * m),
        )
        super().__init__(posterior_type, clock)
        gyro = required(sensors.angular_velocity_noise, "angular_velocity_noise")
        encoder = required(sensors.joint_velocity_noise, "joint_velocity_noise")
        self._known = record(
            config=config,
            sensors=sensors,
            reading=clock.reading,
            mount=record(**vars(ImuMount(robot))),
            pads=record(position=pads.position, foot=pads.foot),
            is_flat=np.array([float(not leg.is_point) for leg in legs.values()]),
            has_pads=np.array([float(not leg.has_six_axes) for leg in legs.values()]),
            wrench_variance=np.array([wrench_variance(sensors, robot, side) for side in legs]),
            weight_variance=self._weight_deviations() ** 2,
            variance=np.repeat([gyro**2, encoder**2], [3, n]),
        )
        self._measurements = self._declare_record_input("measurements", measurements)
        self._link = self._declare_record_input("link_torque", link_torque)
        self._model = self._declare_record_input("model_over_step", model_over_step)
        self._attitude = self._declare_record_input("attitude", attitude)
        self._torque_command = self._declare_remembered_input("torque_command", n)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        feet = len(robot.description.legs)
        return {
            "measurements": measurements_type(robot),
            "link_torque": record_type(wrench=(feet, 6), force_noise=(feet,), late=()),
            "model_over_step": model_type(robot),
            "attitude": record_type(acceleration_bias=(3,), angular_velocity_bias=(3,)),
        }

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, attitude = self._measurements.Eval(context), self._attitude.Eval(context)
        model, known, shaped = self._model.Eval(context), self._known, self._regressor.shaped
        torque_command = self._torque_command.Eval(context)
        if math.isnan(elapsed):
            last, elapsed = self._start(), 0.0
        link = self._link.Eval(context)
        duration = _begin(
            posterior, last, elapsed, measured, model, link, attitude, torque_command, known
        )
        if duration > 0.0:
            motion = _predict(posterior, last, duration, measured, link, known)
            # Where the law is steep, velocity and law have to fit each other to be learned.
            begun = _begun(posterior)
            ahead = motion[0][3:], posterior["weights"].copy()
            for _ in range(_ITERATIONS):
                phi, slopes = self._regressor(ahead[0])
                _update(
                    posterior, last, duration, begun, ahead, motion, phi, slopes, shaped,
                    measured, link, known,
                )  # fmt: skip
                ahead = posterior["velocity"][3:].copy(), posterior["weights"].copy()
        else:
            _forget_motion(posterior, known)
        velocity = _present_velocity(posterior)
        phi, slopes = self._regressor(velocity)
        _conclude(posterior, last, elapsed, velocity, phi, slopes, shaped, known)

    def _start(self) -> np.ndarray:
        """What is known before the first tick."""
        config, regressor, start = self._config, self._regressor, np.zeros((), self.posterior_type)
        n = len(start["weights"])
        start["weights"][:, : regressor.parameters] = regressor.initial
        start["settled"], start["noise"] = start["weights"], 1.0
        start["foot_noise"] = start["surprise"] = 1.0
        start["calm"] = _DOUBT_TIME
        lacking = np.repeat([config.moment_uncertainty, config.disturbance_uncertainty], [3, n])
        weights = np.tile(self._weight_deviations(), n)
        deviations = np.concatenate([np.zeros(3 + n), lacking, weights])
        start["covariance"] = np.diag(deviations**2)
        return start

    def _weight_deviations(self) -> np.ndarray:
        """Initial standard deviation of the weights of a law, (m,)."""
        weights = np.full(self._regressor.weights, self._config.shape_uncertainty)
        weights[: self._regressor.parameters] = self._config.parameter_uncertainty
        return weights
