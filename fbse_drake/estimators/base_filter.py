"""Base state from IMU, standing feet and foot forces in one filter (right-invariant EKF).

After R. Hartley, M. Ghaffari, R. M. Eustice, J. W. Grizzle, "Contact-aided invariant extended Kalman
filtering for robot state estimation", Int. J. Robotics Research 39(4), 2020, with the orientation of
standing feet (Bloesch et al., RSS 2012) and foot forces besides.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

# Blocks of three of the error state: attitude, velocity, position, biases of gyro and accelerometer;
# then for each foot its position and orientation.
_ATTITUDE, _VELOCITY, _POSITION, _GYRO, _ACCELEROMETER, _FEET = range(0, 18, 3)
# Groups of what a standing foot tells.
POSITION, ORIENTATION, VELOCITY, RATE = range(4)


@njit(cache=True)
def skew(a: np.ndarray) -> np.ndarray:
    """Matrix of a x."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@njit(cache=True)
def exp_so3(r: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector [rad]."""
    angle2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if angle2 < 1e-12:
        a, b = 1.0 - angle2 / 6, 0.5 - angle2 / 24
    else:
        angle = math.sqrt(angle2)
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
    K = skew(r)
    R = np.eye(3)
    for i in range(3):
        for j in range(3):
            R[i, j] += a * K[i, j] + b * (r[i] * r[j])
        R[i, i] -= b * angle2
    return R


@njit(cache=True)
def log_so3(R: np.ndarray) -> np.ndarray:
    """Rotation vector of a rotation of less than half a turn [rad]."""
    r = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = 0.5 * math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1)
    angle = math.atan2(sine, cosine)
    return r * (0.5 if sine < 1e-9 else 0.5 * angle / sine)


@njit(cache=True)
def mul(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """A B of 3 x 3 matrices."""
    C = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@njit(cache=True)
def mulT(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """A B^T of 3 x 3 matrices."""
    C = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]
    return C


@njit(cache=True)
def apply(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A b."""
    return np.array([A[i, 0] * b[0] + A[i, 1] * b[1] + A[i, 2] * b[2] for i in range(3)])


@njit(cache=True)
def apply_T(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A^T b."""
    return np.array([A[0, i] * b[0] + A[1, i] * b[1] + A[2, i] * b[2] for i in range(3)])


@njit(cache=True)
def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return np.array([x, y, z])


@njit(cache=True)
def _add_rows(to: np.ndarray, row: int, A: np.ndarray, source: np.ndarray, block: int) -> None:
    """to[row] += A source[block], blocks of three rows."""
    for i in range(3):
        for k in range(3):
            a = A[i, k]
            if a != 0.0:
                for j in range(to.shape[1]):
                    to[row + i, j] += a * source[block + k, j]


@njit(cache=True)
def predict(x, P, w, f, elapsed, gravity, gyro_variance, acc_variance, walks, standing):
    """x: named arrays."""
    R, v, p, feet = x[0], x[1], x[2], x[3]
    n, T = len(P), elapsed
    TR = R * (-T)
    F_v, F_p = mul(skew(v), TR), mul(skew(p), TR)
    G = skew(gravity) * T
    eye = np.eye(3) * T
    F_d = [mul(skew(feet[k]), TR) for k in range(len(feet))]
    for transposed in range(2):
        M = P.copy()
        _add_rows(M, _ATTITUDE, TR, P, _GYRO)
        _add_rows(M, _VELOCITY, G, P, _ATTITUDE)
        _add_rows(M, _VELOCITY, F_v, P, _GYRO)
        _add_rows(M, _VELOCITY, TR, P, _ACCELEROMETER)
        _add_rows(M, _POSITION, eye, P, _VELOCITY)
        _add_rows(M, _POSITION, F_p, P, _GYRO)
        for k in range(len(feet)):
            _add_rows(M, _FEET + 6 * k, F_d[k], P, _GYRO)
        for i in range(n):
            for j in range(n):
                P[i, j] = M[j, i]
    # Noise of the gyro enters attitude and, by the group, all that turns with it.
    q = gyro_variance
    blocks = [(_ATTITUDE, TR), (_VELOCITY, F_v), (_POSITION, F_p)]
    for k in range(len(feet)):
        blocks.append((_FEET + 6 * k, F_d[k]))
    for a in range(len(blocks)):
        for b in range(len(blocks)):
            C = mulT(blocks[a][1], blocks[b][1])
            for i in range(3):
                for j in range(3):
                    P[blocks[a][0] + i, blocks[b][0] + j] += q * C[i, j]
    for i in range(3):
        P[_VELOCITY + i, _VELOCITY + i] += acc_variance * T * T
        P[_GYRO + i, _GYRO + i] += walks[0] ** 2 * T
        P[_ACCELEROMETER + i, _ACCELEROMETER + i] += walks[1] ** 2 * T
        for k in range(len(feet)):
            if standing[k] > 0:
                P[_FEET + 6 * k + i, _FEET + 6 * k + i] += walks[2] ** 2 * T
                P[_FEET + 6 * k + 3 + i, _FEET + 6 * k + 3 + i] += walks[3] ** 2 * T
    acceleration = apply(R, f) + gravity
    turned = mul(R, exp_so3(w * T))
    for i in range(3):
        p[i] += T * v[i] + 0.5 * T * T * acceleration[i]
        v[i] += T * acceleration[i]
        for j in range(3):
            R[i, j] = turned[i, j]


@njit(cache=True)
def inverse3(S: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric 3 x 3 matrix."""
    a, b, c, d, e, f = S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    return np.array([[A, B, C], [B, D, E], [C, E, F]]) / det


@njit(cache=True)
def update(P, dx, z, blocks, signs, matrices, noise, keep, mean, limit):
    """Kalman update with a vector z (3,) = sum of signs * matrices * error blocks + noise.

    `dx` (n,) collects the correction. `mean` is the running mean of the innovation, which widens the
    noise; returns NIS.
    """
    n = len(P)
    e = z.copy()
    PH = np.zeros((n, 3))
    for k in range(len(blocks)):
        b, A = blocks[k], matrices[k]
        for i in range(3):
            for j in range(3):
                a = signs[k] * A[i, j]
                if a != 0.0:
                    e[i] -= a * dx[b + j]
                    for m in range(n):
                        PH[m, i] += a * P[m, b + j]
    S = noise.copy()
    for k in range(len(blocks)):
        b, A = blocks[k], matrices[k]
        for i in range(3):
            for j in range(3):
                a = signs[k] * A[i, j]
                if a != 0.0:
                    for m in range(3):
                        S[i, m] += a * PH[b + j, m]
    # What the innovations have in common is no white noise: as many of them count as one.
    count = (1 + keep) / (1 - keep)
    excess = 0.0
    for i in range(3):
        mean[i] = keep * mean[i] + (1 - keep) * e[i]
        excess += (count * mean[i] ** 2 - limit * S[i, i]) / 3
    if excess > 0:
        for i in range(3):
            S[i, i] += excess
    W = inverse3(S)
    nis = 0.0
    for i in range(3):
        for j in range(3):
            nis += e[i] * W[i, j] * e[j]
    # One that is out of all likelihood counts as little as makes it likely.
    if nis > 16.0:
        W *= 16.0 / nis
    K = np.zeros((n, 3))
    for m in range(n):
        for i in range(3):
            K[m, i] = PH[m, 0] * W[0, i] + PH[m, 1] * W[1, i] + PH[m, 2] * W[2, i]
    for m in range(n):
        dx[m] += K[m, 0] * e[0] + K[m, 1] * e[1] + K[m, 2] * e[2]
        for k in range(m + 1):
            P[m, k] -= K[m, 0] * PH[k, 0] + K[m, 1] * PH[k, 1] + K[m, 2] * PH[k, 2]
            P[k, m] = P[m, k]
    return nis, e, S


@njit(cache=True)
def retract(x, bg, ba, dx, feet_R):
    R, v, p, d = x
    turn = exp_so3(dx[_ATTITUDE : _ATTITUDE + 3])
    R[:] = mul(turn, R)
    v[:] = apply(turn, v) + dx[_VELOCITY : _VELOCITY + 3]
    p[:] = apply(turn, p) + dx[_POSITION : _POSITION + 3]
    bg += dx[_GYRO : _GYRO + 3]
    ba += dx[_ACCELEROMETER : _ACCELEROMETER + 3]
    for k in range(len(d)):
        b = _FEET + 6 * k
        d[k] = apply(turn, d[k]) + dx[b : b + 3]
        feet_R[k] = mul(exp_so3(dx[b + 3 : b + 6]), feet_R[k])
    dx[:] = 0.0


@njit(cache=True)
def land(P, foot, position_variance, orientation_variance):
    """The error of a foot that lands is that of the base and of the leg."""
    n = len(P)
    for part in range(2):
        to, source = _FEET + 6 * foot + 3 * part, _ATTITUDE if part else _POSITION
        for i in range(3):
            for j in range(n):
                P[to + i, j] = P[source + i, j]
        for i in range(3):
            for j in range(n):
                P[j, to + i] = P[j, source + i]
        for i in range(3):
            P[to + i, to + i] += orientation_variance if part else position_variance
