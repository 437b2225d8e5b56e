"""What gyro, encoders and standing feet say of the whole robot's velocities, and contradict."""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.implicit_friction import inverse_of, mirror
from fbse_drake.estimators.innovations import AGREEMENT_TIME, LOG_OF_ONE, learned_noise
from fbse_drake.estimators.records import Record

# An innovation counts as little as makes it just likely beyond so many standard deviations, ...
GATE = 5.0
# ... and what the law does not explain, or a tick adds to it, is not known for so long [s].
DOUBT_TIME = 0.1
# Corrections whose mean is beyond so many standard deviations show that torque is lacking, and
# innovations whose root mean square is that they are no noise; a velocity that is, that a joint
# moves.
NOTICED = 3.0
# A foot that carries less than the first of these shares of the load does not stand, and below the
# second it moves more easily the less it carries.
_LEAST_LOAD, _FIRM_LOAD = 0.05, 0.5


@njit(cache=True)
def correct(
    x: Record, columns: np.ndarray, gain: np.ndarray, innovation: np.ndarray, learning: np.ndarray
) -> None:
    """Kalman update, in place.

    States that do not learn are considered, as in a Schmidt-Kalman filter: their uncertainty counts
    and stays.

    Args:
        columns: covariance of the innovations (m,) with the states, (m, size).
        gain: of the states, transposed, (m, size).
        learning: see `learning_states`.
    """
    P, r, size = x.covariance, len(x.velocity), len(learning)
    change, less = learning * (innovation @ gain), columns.T @ gain
    x.velocity += change[:r]
    x.lacking += change[r : 2 * r]
    x.weights += change[2 * r :].reshape(x.weights.shape)
    for j in range(size):
        if learning[j] > 0.0:
            for k in range(size):
                P[j, k] -= less[j, k]
        else:
            for k in range(size):
                P[j, k] -= learning[k] * less[j, k]


@njit(cache=True)
def confirmed(now: float, before: float) -> float:
    """What two ticks say is no outlier: the smaller of them, 0 if they have not the same sign."""
    return min(abs(now), abs(before)) if now * before > 0.0 else 0.0


@njit(cache=True)
def is_contradicted(x: Record, row: int) -> bool:
    """Do the measurements keep saying, beyond chance, that torque is lacking in this row?"""
    return x.unexplained[row] ** 2 > GATE**2 * x.unexplained_variance[row]


@njit(cache=True)
def judge(
    x: Record, last: Record, missed: np.ndarray, elapsed: float, known: Record
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the innovations of gyro and encoders say of the model and of the sensors' noise.

    Args:
        x: record whose velocities are those before the update.
        missed: what is added to their variances, as pushes between rare readings are missed, (r,).

    Returns:
        By what the variances of the readings (r,) are larger, so that no innovation is too large;
        the inverse of the innovations' covariance, (r, r); and how they would correct the
        velocities if none were too large to count, (r,).
    """
    P, r = x.covariance, len(x.velocity)
    innovation, excess = x.reading - x.velocity, np.zeros(r)
    keep, forget = math.exp(-elapsed / AGREEMENT_TIME), math.exp(-elapsed / DOUBT_TIME)
    # The standard deviation of an exponential mean of white squares is the root.
    beyond_chance = GATE * math.sqrt(2.0 * (1.0 - keep) / (1.0 + keep))
    for i in range(r):
        # How noisy a sensor is shows in its steps, whatever the model is wrong by.
        step = x.reading[i] - last.reading[i] - (x.velocity[i] - last.velocity[i])
        believed = 2.0 * last.noise[i] * known.variance[i] + missed[i]
        x.noise[i] = learned_noise(last.noise[i], step * step / believed, LOG_OF_ONE, elapsed)
        # Unless steps are foreseen wrong: noise is in the second differences of readings as well.
        x.reading_step[i] = x.reading[i] - last.reading[i]
        bend = x.reading_step[i] - last.reading_step[i]
        share = bend * bend / (6.0 * last.bend_noise[i] * known.variance[i])
        x.bend_noise[i] = learned_noise(last.bend_noise[i], share, LOG_OF_ONE, elapsed)
        S = P[i, i] + x.noise[i] * known.variance[i]
        share = innovation[i] ** 2 / S
        # The velocity is elsewhere, and nobody knows why.
        twice = confirmed(innovation[i], last.innovation[i]) ** 2
        if twice > GATE**2 * S:
            P[i, i] += twice
            S += twice
        x.innovation[i], x.innovation_variance[i] = innovation[i], S
        x.agreement[i] += (1.0 - keep) * (share - x.agreement[i])
        # The reading's noise is known from its steps: the velocity's variance is too small.
        excess_now = (x.agreement[i] - 1.0) * S if x.agreement[i] > 1.0 + beyond_chance else 0.0
        x.contradiction[i] = max(excess_now, forget * last.contradiction[i])
        # An innovation counts as little as makes it just likely.
        excess[i] = max(0.0, (innovation[i] / GATE) ** 2 - S)
    expected = P[:r, :r].copy()
    weight = inverse_of(expected + np.diag(x.noise * known.variance))
    whitened = weight @ innovation
    correction = expected @ whitened
    # Mean square, which has the mean 1 and the variance 2 / r.
    surprise = innovation @ whitened / r
    if surprise < 1.0 + GATE * math.sqrt(2.0 / r):
        surprise = 1.0
    x.surprise = max(surprise, 1.0 + forget * (last.surprise - 1.0))
    if excess.max() > 0.0:
        weight = inverse_of(expected + np.diag(x.noise * known.variance + excess))
    return excess, weight, correction


@njit(cache=True)
def listen(
    x: Record,
    excess: np.ndarray,
    weight: np.ndarray,
    learning: np.ndarray,
    elapsed: float,
    known: Record,
) -> None:
    """Kalman update with gyro and encoders.

    Args:
        excess, weight: see `judge`.
        learning: see `learning_states`.
    """
    P, r = x.covariance, len(x.velocity)
    columns = P[:r].copy()
    gain = weight @ columns
    correct(x, columns, gain, x.innovation, learning)
    # R S^-1 P is P - P S^-1 P without the difference of large numbers.
    for i in range(r):
        P[i] = (x.noise[i] * known.variance[i] + excess[i]) * gain[i]
    P[:r, :r] = 0.5 * (P[:r, :r] + P[:r, :r].T)
    mirror(P, r)
    _restore_variance(x, elapsed, known)


@njit(cache=True)
def _restore_variance(x: Record, elapsed: float, known: Record) -> None:
    """What rounding leaves less uncertain of `lacking` than a tick makes it is as at the start."""
    P, r, config = x.covariance, len(x.velocity), known.config
    for i in range(r):
        walk = config.moment_walk if i < 3 else config.disturbance_walk
        if P[r + i, r + i] < 1e-3 * walk**2 * elapsed:
            forget_lacking(x, i, known)


@njit(cache=True)
def forget_lacking(x: Record, row: int, known: Record) -> None:
    """Of the torque that is lacking in a row, no more is known than at the start, and its size."""
    P, at, config = x.covariance, len(x.velocity) + row, known.config
    start = config.moment_uncertainty if row < 3 else config.disturbance_uncertainty
    P[at], P[:, at] = 0.0, 0.0
    P[at, at] = start**2 + x.lacking[row] ** 2


@njit(cache=True)
def listen_to_feet(
    x: Record,
    last: Record,
    then: Record,
    measured: Record,
    learning: np.ndarray,
    T: float,
    known: Record,
) -> None:
    """Kalman updates with flat feet that stand: they do not turn about their normals."""
    P, r, load = x.covariance, len(x.velocity), 0.0
    for foot in range(len(known.is_flat)):
        load += max(0.0, x.wrench[foot, 5])
    for foot in range(len(known.is_flat)):
        share = x.wrench[foot, 5] / max(load, 1.0)
        if not known.is_flat[foot] or not measured.support[foot] > 0 or share < _LEAST_LOAD:
            continue
        # Where the tick ends, of which the model knows where it began.
        row = then.lever[foot, 2:3]
        columns = row @ P[:r]
        innovation = -(row @ x.velocity) - T * then.turning[foot]
        believed = (known.config.foot_turning * max(1.0, _FIRM_LOAD / share)) ** 2
        S = columns[0, :r] @ row[0] + last.foot_noise[foot] * believed
        surprise = innovation[0] ** 2 / S
        x.foot_noise[foot] = learned_noise(last.foot_noise[foot], surprise, LOG_OF_ONE, T)
        # A foot that turns is no measurement.
        if surprise < GATE**2:
            correct(x, columns, columns / S, innovation, learning)


@njit(cache=True)
def watch_corrections(
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
    torque = A @ correction / T
    halfway = A @ (covariance - P[:r, :r])
    for i in range(r):
        variance = max(0.0, halfway[i] @ A[i]) / (T * T)
        x.correction[i], x.correction_variance[i] = torque[i], variance
        x.unexplained[i] = keep * last.unexplained[i] + (1.0 - keep) * torque[i]
        of_last = last.unexplained_variance[i]
        x.unexplained_variance[i] = keep**2 * of_last + (1.0 - keep) ** 2 * variance
        excess = x.unexplained[i] ** 2 - NOTICED**2 * x.unexplained_variance[i]
        if excess > 0.0:
            P[r + i, r + i] += (1.0 - keep) * excess
        twice = confirmed(torque[i], last.correction[i]) ** 2
        if twice > GATE**2 * variance:
            P[r + i, r + i] += twice
