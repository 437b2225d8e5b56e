"""A step in time of the whole robot, whose friction is implicit, and the covariance of its end."""

import numpy as np
from numba import njit

from fbse_drake.estimators.friction_regressor import put_regressor
from fbse_drake.estimators.records import Record


@njit(cache=True)
def inverse_of(A: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric positive definite matrix."""
    inverse = np.linalg.inv(A)
    return 0.5 * (inverse + inverse.T)


@njit(cache=True)
def linearise(
    x: Record, velocity: np.ndarray, law: np.ndarray, shaped: np.ndarray, believed: Record
) -> None:
    """Fills the linearisation of the friction, without any acceleration.

    Args:
        velocity, law, shaped: of the joints (n,), and what `FrictionRegressor` says there.
        believed: what the model's own effects take besides, see `believed_torque_type`.
    """
    phi, slopes = law[0], law[1]
    n, of_law = len(x.weights), x.weights.shape[1] - 1
    row = np.ones(of_law + 1)
    for joint in range(n):
        put_regressor(row, slopes, shaped, joint, n)
        slope, ahead = believed.slope[joint], velocity[joint] - believed.velocity[joint]
        there = believed.torque[joint] + slope * ahead
        for k in range(of_law):
            slope += row[k] * x.weights[joint, k]
        put_regressor(row, phi, shaped, joint, n)
        for k in range(of_law):
            x.regressor[joint, k] = row[k]
            there += row[k] * x.weights[joint, k]
        # A law that falls would make the step in time unstable.
        x.slope[joint], x.friction_there[joint] = max(0.0, slope), there
        x.law_velocity[joint], x.regressor[joint, of_law] = velocity[joint], 0.0


@njit(cache=True)
def implicit_step(
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
    inverse = inverse_of(implicit)
    return velocity + inverse @ impulse, inverse


@njit(cache=True)
def impulse_covariance(x: Record, tick: Record) -> np.ndarray:
    """Covariance of the tick's impulse, friction included, with the states, (r, size)."""
    P, impulse, (n, m) = x.covariance, tick.impulse.copy(), x.weights.shape
    first = len(P) - n * m
    for joint in range(n):
        for j in range(m):
            share = tick.duration * x.regressor[joint, j]
            for k in range(len(P)):
                impulse[3 + joint, k] -= share * P[first + m * joint + j, k]
    return impulse


@njit(cache=True)
def own_covariance(
    x: Record, A: np.ndarray, inverse: np.ndarray, impulse: np.ndarray, tick: Record
) -> np.ndarray:
    """Covariance of the velocities after a step in time, (r, r).

    Args:
        x: record with the states before the step and the friction's linearisation.
        inverse: see `implicit_step`; impulse: see `impulse_covariance`.
    """
    T, (n, m) = tick.duration, x.weights.shape
    r = 3 + n
    own = np.ascontiguousarray(impulse[:, :r]) @ A + T * T * tick.variance
    for i in range(r):
        for k in range(r):
            own[i, k] -= T * impulse[i, r + k]
        for joint in range(n):
            for j in range(m):
                share = T * x.regressor[joint, j]
                own[i, 3 + joint] -= share * impulse[i, 2 * r + m * joint + j]
    own = inverse @ own @ inverse
    return 0.5 * (own + own.T)


@njit(cache=True)
def mirror(P: np.ndarray, r: int) -> None:
    """Fills the first columns of a symmetric matrix from its first rows."""
    for i in range(r):
        for j in range(r, len(P)):
            P[j, i] = P[i, j]
