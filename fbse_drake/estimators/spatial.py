"""Three-dimensional vectors, rotations and quaternions as tuples of floats.

In compiled code they stay in registers. The estimators' numerics are compiled by numba and cached
next to the source. A cached function is compiled again when its own file changes, not when a
function that it calls from another file does: after a change here delete
`fbse_drake/estimators/__pycache__` (`make` keeps a cache of its own for every state of the
sources).
"""

import math

import numpy as np
from numba import njit

# Acceleration of gravity, as Drake has it [m/s^2].
GRAVITY = 9.81

Vector = tuple[float, float, float]
# [w, x, y, z].
Quaternion = tuple[float, float, float, float]
# Rotation matrix, row by row.
Rotation = tuple[float, float, float, float, float, float, float, float, float]


@njit(cache=True)
def vector(x: np.ndarray) -> Vector:
    """The components of an array of shape (3,)."""
    return x[0], x[1], x[2]


@njit(cache=True)
def quaternion(x: np.ndarray) -> Quaternion:
    """The components of an array of shape (4,)."""
    return x[0], x[1], x[2], x[3]


@njit(cache=True)
def rotation(R: np.ndarray) -> Rotation:
    """The components of an array of shape (3, 3)."""
    return R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]


@njit(cache=True)
def put(x: np.ndarray, values: tuple[float, ...]) -> None:
    """Fills an array (of any shape, row by row) with as many values."""
    x = x.ravel()
    for i in range(len(values)):
        x[i] = values[i]


@njit(cache=True)
def add(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True)
def subtract(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def scale(factor: float, a: Vector) -> Vector:
    """Factor times a."""
    return factor * a[0], factor * a[1], factor * a[2]


@njit(cache=True)
def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def rotate(R: Rotation, a: Vector) -> Vector:
    """R a."""
    return (
        R[0] * a[0] + R[1] * a[1] + R[2] * a[2],
        R[3] * a[0] + R[4] * a[1] + R[5] * a[2],
        R[6] * a[0] + R[7] * a[1] + R[8] * a[2],
    )


@njit(cache=True)
def rotate_back(R: Rotation, a: Vector) -> Vector:
    """R^T a."""
    return (
        R[0] * a[0] + R[3] * a[1] + R[6] * a[2],
        R[1] * a[0] + R[4] * a[1] + R[7] * a[2],
        R[2] * a[0] + R[5] * a[1] + R[8] * a[2],
    )


@njit(cache=True)
def quaternion_product(a: Quaternion, b: Quaternion) -> Quaternion:
    """a * b of quaternions [w, x, y, z]."""
    w, x, y, z = a
    s, i, j, k = b
    return (
        w * s - x * i - y * j - z * k,
        w * i + x * s + y * k - z * j,
        w * j - x * k + y * s + z * i,
        w * k + x * j - y * i + z * s,
    )


@njit(cache=True)
def rotation_vector_to_quaternion(r: Vector) -> Quaternion:
    """Quaternion of a rotation by |r| [rad] about r."""
    half = 0.5 * math.sqrt(dot(r, r))
    factor = 0.5 if half < 1e-8 else math.sin(half) / (2.0 * half)
    return math.cos(half), factor * r[0], factor * r[1], factor * r[2]


@njit(cache=True)
def norm(a: Vector) -> float:
    """Length of a vector."""
    return math.sqrt(dot(a, a))


@njit(cache=True)
def normalized(q: Quaternion) -> Quaternion:
    """The norm correction: the quaternion of unit length in q's direction."""
    factor = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * factor, q[1] * factor, q[2] * factor, q[3] * factor


@njit(cache=True)
def yaw_of(q: Quaternion) -> float:
    """z-Euler angle of a quaternion (z-y-x order) [rad]."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@njit(cache=True)
def quaternion_from_gravity(up: Vector, yaw: float) -> Quaternion:
    """Quaternion with the x- and y-Euler angles that make `up` vertical, and this z-Euler angle.

    Args:
        up: direction of the specific force at rest, in the rotated frame, any length.
    """
    roll = math.atan2(up[1], up[2])
    pitch = math.atan2(-up[0], math.hypot(up[1], up[2]))
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@njit(cache=True)
def rotation_matrix(q: Quaternion) -> Rotation:
    """Matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@njit(cache=True)
def skew(a: Vector) -> Rotation:
    """Matrix of a x, row by row."""
    return 0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0


@njit(cache=True)
def matrix_product(A: Rotation, B: Rotation) -> Rotation:
    """A B of 3 x 3 matrices."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )


@njit(cache=True)
def transposed(A: Rotation) -> Rotation:
    """Its inverse."""
    return (A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8])


@njit(cache=True)
def scaled(factor: float, A: Rotation) -> Rotation:
    """A matrix times a number."""
    return (
        factor * A[0],
        factor * A[1],
        factor * A[2],
        factor * A[3],
        factor * A[4],
        factor * A[5],
        factor * A[6],
        factor * A[7],
        factor * A[8],
    )


@njit(cache=True)
def conjugate(q: Quaternion) -> Quaternion:
    """The inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


@njit(cache=True)
def rotation_vector(q: Quaternion) -> Vector:
    """Rotation vector of a unit quaternion, of at most half a turn [rad]."""
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    sign = 1.0 if q[0] >= 0 else -1.0
    factor = 2.0 * sign if sine < 1e-9 else 2.0 * math.atan2(sine, abs(q[0])) * sign / sine
    return factor * q[1], factor * q[2], factor * q[3]


@njit(cache=True)
def quaternion_of(R: Rotation) -> Quaternion:
    """Unit quaternion of a rotation matrix, by its largest component."""
    trace = R[0] + R[4] + R[8]
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        return 0.25 * s, (R[7] - R[5]) / s, (R[2] - R[6]) / s, (R[3] - R[1]) / s
    if R[0] > R[4] and R[0] > R[8]:
        s = 2.0 * math.sqrt(1.0 + R[0] - R[4] - R[8])
        return (R[7] - R[5]) / s, 0.25 * s, (R[1] + R[3]) / s, (R[2] + R[6]) / s
    if R[4] > R[8]:
        s = 2.0 * math.sqrt(1.0 + R[4] - R[0] - R[8])
        return (R[2] - R[6]) / s, (R[1] + R[3]) / s, 0.25 * s, (R[5] + R[7]) / s
    s = 2.0 * math.sqrt(1.0 + R[8] - R[0] - R[4])
    return (R[3] - R[1]) / s, (R[2] + R[6]) / s, (R[5] + R[7]) / s, 0.25 * s
