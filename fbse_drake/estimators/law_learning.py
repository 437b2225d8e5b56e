"""Which friction laws are learned from a tick, how far they hold, and what they may not be."""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.innovations import AGREEMENT_TIME
from fbse_drake.estimators.missing_inertia import is_read
from fbse_drake.estimators.records import Record
from fbse_drake.estimators.whole_body_updates import DOUBT_TIME, GATE, NOTICED, is_contradicted

# A law is known, and well known, when it is so many times surer than at the start.
_KNOWN, _WELL_KNOWN = 10.0, 30.0
# What is contradicted in more than this share of the rows is no lack in one of them.
_MANY = 0.3


@njit(cache=True)
def _is_law_contradicted(x: Record, judged: Record, joint: int) -> bool:
    """Do this tick, or those before it, contradict what is known of a joint beyond chance?

    Args:
        x: record with the innovations of this tick; judged: with means of those before.
    """
    row = 3 + joint
    no_noise = judged.agreement[row] > NOTICED**2
    outlier = x.innovation[row] ** 2 > GATE**2 * x.innovation_variance[row]
    return is_contradicted(judged, row) or no_noise or outlier


@njit(cache=True)
def learning_states(x: Record, last: Record, T: float, known: Record) -> np.ndarray:
    """Which states are corrected: 1, but 0 for laws of joints that teach nothing, (size,).

    A joint whose velocity has not been known from zero for some time says nothing of its law:
    coefficient and velocity, known by their product alone, would drift apart. Of what contradicts a
    law that is known by now nobody knows whether it is the law or what it is learned from. So it is
    where torque keeps being lacking in the joint's row, where innovations are no noise, and in a
    tick whose innovation is an outlier. What contradicts many rows is wrong with the base or with a
    foot: innovations that are near noise already teach laws that are well known no more. And an
    acceleration that is not read says nothing of an inertia.

    Args:
        x: record with the innovations of this tick.
        T: duration of the tick [s].
    """
    learning, r, (n, m) = np.ones(len(last.covariance)), len(last.velocity), last.weights.shape
    doubted = x.contradiction > x.innovation_variance
    many = doubted.sum() > _MANY * r
    for joint in range(n):
        row = 3 + joint
        if not is_read(x, last, joint, T):
            learning[2 * r + m * (joint + 1) - 1] = 0.0
        rests = last.rested[joint] > DOUBT_TIME
        if (
            rests
            or (_is_law_contradicted(x, last, joint) and _is_known(last, joint, _KNOWN, known))
            or (many and doubted[row] and _is_known(last, joint, _WELL_KNOWN, known))
        ):
            learning[2 * r + m * joint : 2 * r + m * (joint + 1)] = 0.0
    return learning


@njit(cache=True)
def forget_unproven(x: Record, T: float, known: Record) -> None:
    """Laws that are contradicted before they have held for some time begin anew.

    What a joint does first, a jerk as its foot leaves the ground, can teach a wrong law within some
    ticks. Known by then, it would stay: what contradicts it teaches it no more.

    Args:
        x: record with for how long each law has been known and held, less for how long it was
            contradicted, until it has proved itself, `proven` (n,) [s]; goes on.
        T: duration of the tick [s].
    """
    for joint in range(len(x.weights)):
        if x.proven[joint] > DOUBT_TIME or not _is_known(x, joint, _KNOWN, known):
            continue
        x.proven[joint] += -T if _is_law_contradicted(x, x, joint) else T
        if x.proven[joint] < -AGREEMENT_TIME:
            x.proven[joint] = 0.0
            _forget_law(x, joint, known)


@njit(cache=True)
def remember_speeds(x: Record, velocity: np.ndarray, learning: np.ndarray) -> None:
    """Keeps the highest speed that has taught each law, `fastest`, and its friction there.

    Args:
        velocity: of the joints in this tick (n,) [rad/s].
        learning: see `learning_states`.
    """
    n, m = x.weights.shape
    for joint in range(n):
        speed = abs(velocity[joint])
        if learning[len(learning) + m * (joint - n)] > 0.0 and speed > x.fastest[joint]:
            x.fastest[joint], x.at_fastest[joint] = speed, abs(x.friction_there[joint])


@njit(cache=True)
def beyond_known_speeds(x: Record, joint: int, velocity: float, known: Record) -> float:
    """Standard deviation of a law's friction at a speed above those that taught it [Nm].

    Its parameters' covariance takes its form for granted. Friction that is known up to a speed goes
    on between Coulomb's, which stays as it is, and viscous, which grows with the speed; but nothing
    is known less than at the start.
    """
    beyond = abs(velocity) - x.fastest[joint]
    if beyond <= 0.0 or x.fastest[joint] == 0.0:
        return 0.0
    grown = 0.5 * x.at_fastest[joint] * beyond / x.fastest[joint]
    return min(grown, math.sqrt(_variance_at_start(x, joint, known)))


@njit(cache=True)
def _variance_at_start(x: Record, joint: int, known: Record) -> float:
    """Variance of a joint's friction, where its law is asked, when nothing was known yet [Nm^2]."""
    variance = 0.0
    for j in range(x.weights.shape[1]):
        variance += x.regressor[joint, j] ** 2 * known.weight_variance[j]
    return variance


@njit(cache=True)
def _is_known(x: Record, joint: int, times: float, known: Record) -> bool:
    """Is a joint's law, where it is asked, known so many times as well as at the start?"""
    n, m = x.weights.shape
    first, now = len(x.covariance) + m * (joint - n), 0.0
    for j in range(m):
        for k in range(m):
            both = x.regressor[joint, j] * x.regressor[joint, k]
            now += both * x.covariance[first + j, first + k]
    return now * times**2 < _variance_at_start(x, joint, known)


@njit(cache=True)
def make_dissipative(x: Record, believed: Record) -> None:
    """Projects laws whose friction pushes a joint, beyond their doubt, on those where it is zero.

    At the velocity that they are linearised at, as an estimate is projected on a constraint (D.
    Simon, "Kalman filtering with state constraints: a survey of linear and nonlinear algorithms",
    IET Control Theory & Applications 4, 2010). Where a joint moves little, noise would teach laws
    that fall at rest or are much too steep there. What is within the doubt stays: of a joint
    without friction only one side would be taken away, tick by tick. A law may take off what the
    model believes too large.

    Args:
        believed: friction that the model has besides, see `believed_torque_type`.
    """
    n, m = x.weights.shape
    for joint in range(n):
        row, first = x.regressor[joint, : m - 1], len(x.covariance) + m * (joint - n)
        last = first + m - 1
        torque = row @ x.weights[joint, : m - 1]
        if believed.torque[joint] * x.law_velocity[joint] > 0.0:
            torque += believed.torque[joint]
        if torque * x.law_velocity[joint] < 0.0:
            column = np.ascontiguousarray(x.covariance[first : first + m, first:last]) @ row
            variance = row @ column[: m - 1]
            if torque**2 > variance:
                x.weights[joint] -= column * (torque / variance)


@njit(cache=True)
def forget_laws(x: Record, known: Record) -> None:
    """The laws are those of the start."""
    for joint in range(len(x.weights)):
        _forget_law(x, joint, known)


@njit(cache=True)
def _forget_law(x: Record, joint: int, known: Record) -> None:
    """The law of a joint is that of the start."""
    P, (n, m) = x.covariance, x.weights.shape
    first = len(P) + m * (joint - n)
    x.weights[joint], x.settled[joint] = known.weights[joint], known.weights[joint]
    x.fastest[joint], x.at_fastest[joint] = 0.0, 0.0
    for at in range(first, first + m):
        P[at], P[:, at] = 0.0, 0.0
        P[at, at] = known.weight_variance[at - first]
