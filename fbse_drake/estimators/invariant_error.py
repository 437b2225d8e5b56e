"""Errors of base, standing feet and IMU biases on a group: how they propagate, are measured and are
corrected.

The errors are right-invariant, as in R. Hartley, M. Ghaffari, R. M. Eustice and J. W. Grizzle,
"Contact-aided invariant extended Kalman filtering for robot state estimation", Int. J. Robotics
Research 39(4), 2020.
"""

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from numba import njit

from fbse_drake.estimators.innovations import AGREEMENT
from fbse_drake.estimators.records import Record
from fbse_drake.estimators.spatial import (
    Rotation,
    Vector,
    add,
    cross,
    dot,
    matrix_product,
    normalized,
    put,
    quaternion,
    quaternion_product,
    rotate,
    rotation,
    rotation_matrix,
    rotation_vector_to_quaternion,
    scale,
    scaled,
    skew,
    vector,
)

# Where three errors each start in the filter's error state; every foot has six, of its position and
# its orientation.
# (numpy integers: of a Python integer the value is part of the types that a function is compiled
# for.)
ATTITUDE, VELOCITY, POSITION, GYRO_BIAS, ACCELEROMETER_BIAS, FEET = cast(
    Sequence[int], np.arange(0, 18, 3)
)
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# An innovation is taken for a fault, and counts as little as makes it just likely, above this
# quantile of chi^2 with three degrees of freedom (one in 3000).
GATE = 18.5


@njit(cache=True)
def add_product(to: np.ndarray, row: int, A: Rotation, source: np.ndarray, block: int) -> None:
    """to[row : row + 3] += A source[block : block + 3]."""
    for i in range(3):
        x, y, z = A[3 * i], A[3 * i + 1], A[3 * i + 2]
        for j in range(to.shape[1]):
            total = x * source[block, j] + y * source[block + 1, j] + z * source[block + 2, j]
            to[row + i, j] += total


@njit(cache=True)
def propagate(P: np.ndarray, x: Record, gravity: Vector, T: float) -> None:
    """P becomes F P F^T, with F = I + T A of the right-invariant error.

    Args:
        x: record of the posterior where the step begins.
    """
    R = rotation(x.rotation)
    TR = scaled(-T, R)
    fall = scaled(T, skew(gravity))
    of_velocity = matrix_product(skew(vector(x.imu_velocity)), TR)
    of_position = matrix_product(skew(vector(x.imu_position)), TR)
    for _ in range(2):
        M = P.copy()
        add_product(M, ATTITUDE, TR, P, GYRO_BIAS)
        add_product(M, VELOCITY, fall, P, ATTITUDE)
        add_product(M, VELOCITY, of_velocity, P, GYRO_BIAS)
        add_product(M, VELOCITY, TR, P, ACCELEROMETER_BIAS)
        add_product(M, POSITION, of_position, P, GYRO_BIAS)
        for i in range(3):
            for j in range(len(P)):
                M[POSITION + i, j] += T * P[VELOCITY + i, j]
        for foot in range(len(x.foot_standing)):
            if x.foot_standing[foot] > 0:
                of_foot = matrix_product(skew(vector(x.foot_position[foot])), TR)
                add_product(M, FEET + 6 * foot, of_foot, P, GYRO_BIAS)
        for i in range(len(P)):
            for j in range(len(P)):
                P[i, j] = M[j, i]


@njit(cache=True)
def put_columns(to: np.ndarray, start: int, A: Rotation) -> None:
    """Fills three columns of a matrix of three rows."""
    for i in range(3):
        for j in range(3):
            to[i, start + j] = A[3 * i + j]


@njit(cache=True)
def add_noise(P: np.ndarray, start: int, variance: float) -> None:
    """Adds a variance to each of three errors."""
    for i in range(start, start + 3):
        P[i, i] += variance


@njit(cache=True)
def add_noise_along(P: np.ndarray, start: int, F: Rotation, density: np.ndarray, T: float) -> None:
    """Adds random walks of these densities (3,) along the columns of F."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                P[start + i, start + j] += T * density[k] * F[3 * i + k] * F[3 * j + k]


@njit(cache=True)
def turn_to(x: Record, q: tuple[float, float, float, float]) -> None:
    """Sets the attitude."""
    q = normalized(q)
    put(x.orientation, q)
    put(x.rotation, rotation_matrix(q))


@njit(cache=True)
def _inverse(S: np.ndarray) -> Rotation:
    """Inverse of a symmetric 3 x 3 matrix."""
    a, b, c, d, e, f = S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    scaling = 1.0 / (a * A + b * B + c * C)
    return scaled(scaling, (A, B, C, B, D, E, C, E, F))


@njit(cache=True)
def update(
    P: np.ndarray,
    correction: np.ndarray,
    z: Vector,
    first: int,
    A: Rotation,
    second: int,
    B: Rotation,
    noise: np.ndarray,
    keep: float,
    agreement: np.ndarray,
    innovation: np.ndarray,
    explained: np.ndarray,
) -> None:
    """Kalman update with z = A error[first] + B error[second] + noise, in place.

    Innovations that agree with each other are no white noise, whatever P and the noise say: as
    many as agree count as one with their mean as its error. One beyond all likelihood counts as
    little as makes it likely.

    Args:
        P, correction: covariance of the errors, and what is known of them since P was made, (n,).
        noise: covariance of z's noise, (3, 3).
        keep: what a tick leaves of the running mean of innovations `agreement` (3,).
        innovation: filled, (3,).
        explained: filled with the innovation's variance along each axis by the covariance, and by
            an error that lasts, (2, 3).
    """
    n = len(P)
    PH, S = np.zeros((3, n)), noise.copy()
    for i in range(3):
        e = z[i]
        for k in range(3):
            a, b = A[3 * i + k], B[3 * i + k]
            e -= a * correction[first + k] + b * correction[second + k]
            for j in range(n):
                PH[i, j] += a * P[first + k, j] + b * P[second + k, j]
        innovation[i] = e
    for i in range(3):
        for j in range(3):
            for k in range(3):
                S[i, j] += PH[i, first + k] * A[3 * j + k] + PH[i, second + k] * B[3 * j + k]
    # An error that lasts mostly points one way, so the sum over the axes counts; it makes all of
    # them doubtful, and shows in that way.
    count, excess, length = (1.0 + keep) / (1.0 - keep), 0.0, 1e-300
    for i in range(3):
        agreement[i] = keep * agreement[i] + (1.0 - keep) * innovation[i]
        excess += count * agreement[i] ** 2 - AGREEMENT * S[i, i] / 3.0
        length += agreement[i] ** 2
    W = _inverse(S)
    distance = dot(vector(innovation), rotate(W, vector(innovation)))
    lasting = max(0.0, excess)
    widening = lasting
    if distance > GATE:
        widening += (distance / GATE - 1.0) * (S[0, 0] + S[1, 1] + S[2, 2]) / 3.0
    for i in range(3):
        explained[0, i] = S[i, i] - noise[i, i]
        explained[1, i] = lasting * agreement[i] ** 2 / (length * count)
    if widening > 0.0:
        for i in range(3):
            S[i, i] += widening
        W = _inverse(S)
    gain = np.empty((3, n))
    for i in range(3):
        x, y, z_ = W[3 * i], W[3 * i + 1], W[3 * i + 2]
        for j in range(n):
            gain[i, j] = x * PH[0, j] + y * PH[1, j] + z_ * PH[2, j]
    e0, e1, e2 = innovation[0], innovation[1], innovation[2]
    for i in range(n):
        a, b, c = gain[0, i], gain[1, i], gain[2, i]
        correction[i] += a * e0 + b * e1 + c * e2
        for j in range(n):
            P[i, j] -= a * PH[0, j] + b * PH[1, j] + c * PH[2, j]


@njit(cache=True)
def _moved(phi: Vector, a: Vector, xi: Vector) -> Vector:
    """Where the group's exponential takes a: Exp(phi) a + J xi, J the left Jacobian of rotations.

    To first order it would be Exp(phi) a + xi; but far from the world's origin, where both parts
    are large and cancel each other, that is not enough.
    """
    angle = math.sqrt(dot(phi, phi))
    once, twice = 0.5, 1.0 / 6.0
    if angle > 1e-4:
        once = (1.0 - math.cos(angle)) / angle**2
        twice = (angle - math.sin(angle)) / angle**3
    across = cross(phi, xi)
    shift = add(xi, add(scale(once, across), scale(twice, cross(phi, across))))
    return add(rotate(rotation_matrix(rotation_vector_to_quaternion(phi)), a), shift)


@njit(cache=True)
def correct(x: Record, error: np.ndarray) -> None:
    """Moves the estimate along the group by an error (n,)."""
    phi = vector(error[ATTITUDE:VELOCITY])
    turn_to(x, quaternion_product(rotation_vector_to_quaternion(phi), quaternion(x.orientation)))
    for part, start in ((x.imu_velocity, VELOCITY), (x.imu_position, POSITION)):
        put(part, _moved(phi, vector(part), vector(error[start : start + 3])))
    for i in range(3):
        x.gyro_bias_B[i] += error[GYRO_BIAS + i]
        x.accelerometer_bias_B[i] += error[ACCELEROMETER_BIAS + i]
    for foot in range(len(x.foot_standing)):
        if not x.foot_standing[foot] > 0:
            continue
        start = FEET + 6 * foot
        part = x.foot_position[foot]
        put(part, _moved(phi, vector(part), vector(error[start : start + 3])))
        turn = rotation_vector_to_quaternion(vector(error[start + 3 : start + 6]))
        q = quaternion_product(turn, quaternion(x.foot_orientation[foot]))
        put(x.foot_orientation[foot], normalized(q))


@njit(cache=True)
def isotropic(variance: float) -> np.ndarray:
    """Covariance (3, 3) of three independent errors of one variance."""
    S = np.zeros((3, 3))
    S[0, 0] = S[1, 1] = S[2, 2] = variance
    return S


@njit(cache=True)
def moved_std(P: np.ndarray, block: int, i: int, a: Vector) -> float:
    """Standard deviation of component i of error[block] + attitude error x a."""
    j, k = (i + 1) % 3, (i + 2) % 3
    # Component i of phi x a is phi_j a_k - phi_k a_j.
    m, s, t = block + i, ATTITUDE + j, ATTITUDE + k
    variance = P[m, m] + a[k] ** 2 * P[s, s] + a[j] ** 2 * P[t, t]
    variance += 2.0 * (a[k] * P[m, s] - a[j] * P[m, t] - a[j] * a[k] * P[s, t])
    return math.sqrt(max(0.0, variance))
