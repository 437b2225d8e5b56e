"""Attitude, velocity and position of the base, the feet that stand and the IMU's biases together.

A right-invariant extended Kalman filter after R. Hartley, M. Ghaffari, R. M. Eustice and
J. W. Grizzle, "Contact-aided invariant extended Kalman filtering for robot state estimation",
Int. J. Robotics Research 39(4), 2020; with the orientation of feet that stand, after M. Bloesch et
al., "State estimation for legged robots on unstable and slippery terrain", IROS 2013; and with the
acceleration of the centre of mass from the foot forces.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.errors import require_not_negative, require_positive
from fbse_drake.estimators.attitude import AttitudeConfig
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.cross_check import (
    cross_check,
    cross_check_type,
    firm_foot_rate,
    force_contradiction,
)
from fbse_drake.estimators.floating_base import ImuMount, model_type
from fbse_drake.estimators.force_delay import (
    force_delay_type,
    forget_force_delay,
    watch_force_delay,
)
from fbse_drake.estimators.innovations import (
    AGREEMENT,
    AGREEMENT_TIME,
    LARGEST_SHARE,
    LOG_OF_ONE,
    SMALLEST_SHARE,
)
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import LONGEST_COMPARED_TICK, Clock, RecursiveEstimator, Status
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.estimators.spatial import (
    Rotation,
    Vector,
    add,
    conjugate,
    cross,
    dot,
    matrix_product,
    normalized,
    put,
    quaternion,
    quaternion_from_gravity,
    quaternion_of,
    quaternion_product,
    rotate,
    rotate_back,
    rotation,
    rotation_matrix,
    rotation_vector,
    rotation_vector_to_quaternion,
    scale,
    skew,
    subtract,
    vector,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches

_NOT_FINITE, _IMPLAUSIBLE = float(Status.NOT_FINITE), float(Status.IMPLAUSIBLE)
# Where three errors each start in the filter's error state; every foot has six, of its position and
# its orientation.
# (numpy integers: of a Python integer the value is part of the types that a function is compiled
# for.)
_ATTITUDE, _VELOCITY, _POSITION, _GYRO_BIAS, _ACCELEROMETER_BIAS, _FEET = np.arange(0, 18, 3)
# What a standing foot tells.
_FOOT_POSITION, _FOOT_ORIENTATION, _FOOT_VELOCITY, _FOOT_RATE, _TOLD = range(5)
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# While the IMU is not trusted, what its readings are taken to be wrong by [rad/s, m/s^2], and how
# long that lasts [s].
_UNKNOWN_RATE, _UNKNOWN_ACCELERATION, _UNKNOWN_TIME = 0.3, 3.0, 0.1
# An innovation is taken for a fault, and counts as little as makes it just likely, above this
# quantile of chi^2 with three degrees of freedom (one in 3000).
_GATE = 18.5
# Biases of the IMU of at least so long ago [s] are taken back when a sensor is not trusted.
_MEMORY = 0.1
# They stay within so many standard deviations of what was known of them so long ago [s]: they
# hardly walk, and a sensor that drifts faster is at fault. What a filter finds out moves its
# estimate by a variance as large as what it takes from its own; and at least by so many random
# walks.
_LEASH, _LEASH_TIME, _LEAST_WALKS = 2.0, 1.0, 20.0
# Beyond so many standard deviations of what forces are wrong by, they contradict the accelerometer.
_CONTRADICTION = 3.0
# When all feet that stand have contradicted the velocity for so long [s], it is not they that slip.
_LOST_AFTER = 0.25
# What the rate is off by that standing feet show [rad/s].
_FOOT_RATE_ERROR = 0.05
# A foot does little in spite of all while the robot rests: this share of what it does from this
# speed of the robot on [m/s].
_AT_REST, _WALKING_SPEED = 0.1, 0.03
# How long it takes to learn what a standing foot does at present [s], by what it tells; how much of
# that, and of larger innovations, one tick may tell; and the least that it is taken to do, as a
# share of the variance believed.
_RESTLESSNESS_TIME, _LEAST_RESTLESSNESS = (0.1, 0.1, 0.03, 0.03), 1e-4
_MOST_TOLD, _LARGEST_SURPRISE = 0.05, 100.0
# For how long feet [s], and forces, must have erred less than believed to be trusted more, and the
# least that they are taken to err, as a share of the variance believed.
_HABIT_TIME, _FORCE_HABIT_TIME, _LEAST_HABIT = 0.4, 3.0, 0.01
# Below this share of its weight, the robot is not carried by its feet.
_CARRIED = 0.3
# A foot that carries less than this share of the weight moves more easily the less it carries.
_FIRM_LOAD = 0.5


@dataclass(frozen=True)
class InvariantFilter:
    """What the filter believes of the robot; what it believes of the sensors, see `SensorBeliefs`.

    Errors that last are given by their size (standard deviation) and by how long they last. Feet
    and forces that show less than that are trusted more, up to ten times as much; the more, the
    longer they do so.
    """

    # Do monitor and model hear what it knows?
    feeds_back: ClassVar[bool] = True

    # What a standing foot does in spite of all, because it rolls, tilts, slips or sinks: position
    # [m], orientation [rad], velocity [m/s] and angular velocity [rad/s] ...
    foot_position: float = 3.5e-4
    foot_orientation: float = 5.0e-3
    foot_velocity: float = 1.5e-3
    foot_rate: float = 1.5e-2
    # ... and how long that lasts [s].
    foot_time: float = 0.1
    # How far a standing foot creeps: random walk of position [m/sqrt(s)] and orientation
    # [rad/sqrt(s)].
    foot_creep: float = 1.0e-3
    foot_turning: float = 1.0e-3
    # How wrong the mean acceleration of the robot by its foot forces is: any way [m/s^2] and as a
    # share of the whole, through wrong masses and gains; and how long that lasts [s].
    force_error: float = 0.05
    force_gain_error: float = 0.05
    force_time: float = 0.3
    # How level the ground is under standing soles [rad]; 0 says nothing of it.
    level_ground: float = 0.0
    # Random walks of the biases of gyro [rad/s/sqrt(s)] and accelerometer [m/s^2/sqrt(s)].
    gyro_walk: float = 1.0e-5
    accelerometer_walk: float = 1.0e-4

    def __post_init__(self) -> None:
        require_positive(
            self,
            "foot_position",
            "foot_orientation",
            "foot_velocity",
            "foot_rate",
            "foot_time",
            "force_error",
            "force_time",
        )
        require_not_negative(
            self,
            "foot_creep",
            "foot_turning",
            "force_gain_error",
            "level_ground",
            "gyro_walk",
            "accelerometer_walk",
        )

    def add(self, chain: Chain, attitude: AttitudeConfig, origin: tuple[float, float]) -> None:  # noqa: ARG002
        """Adds `base_state`, which is `attitude` as well, to a chain.

        Args:
            attitude: of the stage that it replaces.
            origin: see `InvariantBaseFilter`.
        """
        make = partial(InvariantBaseFilter, self, chain.sensors, chain.robot, origin=origin)
        chain.add("base_state", make, measurements="sensor_monitor", model="model")
        chain.alias("base_state", "attitude")
        chain.connect_field(
            "base_state.last", "angular_velocity_bias", "model.angular_velocity_bias"
        )
        chain.connect_field("base_state.last", "check.doubt", "sensor_monitor.doubt")


@njit(cache=True)
def _add_product(to: np.ndarray, row: int, A: Rotation, source: np.ndarray, block: int) -> None:
    """to[row : row + 3] += A source[block : block + 3]."""
    for i in range(3):
        x, y, z = A[3 * i], A[3 * i + 1], A[3 * i + 2]
        for j in range(to.shape[1]):
            total = x * source[block, j] + y * source[block + 1, j] + z * source[block + 2, j]
            to[row + i, j] += total


@njit(cache=True)
def _propagate(P: np.ndarray, x: np.ndarray, gravity: Vector, T: float) -> None:
    """P becomes F P F^T, with F = I + T A of the right-invariant error.

    Args:
        x: record of the posterior where the step begins.
    """
    R = rotation(x.rotation)
    TR = _scaled(-T, R)
    fall = _scaled(T, skew(gravity))
    of_velocity = matrix_product(skew(vector(x.imu_velocity)), TR)
    of_position = matrix_product(skew(vector(x.imu_position)), TR)
    for _ in range(2):
        M = P.copy()
        _add_product(M, _ATTITUDE, TR, P, _GYRO_BIAS)
        _add_product(M, _VELOCITY, fall, P, _ATTITUDE)
        _add_product(M, _VELOCITY, of_velocity, P, _GYRO_BIAS)
        _add_product(M, _VELOCITY, TR, P, _ACCELEROMETER_BIAS)
        _add_product(M, _POSITION, of_position, P, _GYRO_BIAS)
        for i in range(3):
            for j in range(len(P)):
                M[_POSITION + i, j] += T * P[_VELOCITY + i, j]
        for foot in range(len(x.foot_standing)):
            if x.foot_standing[foot] > 0:
                of_foot = matrix_product(skew(vector(x.foot_position[foot])), TR)
                _add_product(M, _FEET + 6 * foot, of_foot, P, _GYRO_BIAS)
        for i in range(len(P)):
            for j in range(len(P)):
                P[i, j] = M[j, i]


@njit(cache=True)
def _transposed(A: Rotation) -> Rotation:
    return (A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8])


@njit(cache=True)
def _scaled(factor: float, A: Rotation) -> Rotation:
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
def _put_columns(to: np.ndarray, start: int, A: Rotation) -> None:
    """Fills three columns of a matrix of three rows."""
    for i in range(3):
        for j in range(3):
            to[i, start + j] = A[3 * i + j]


@njit(cache=True)
def _add_noise(P: np.ndarray, start: int, variance: float) -> None:
    for i in range(start, start + 3):
        P[i, i] += variance


@njit(cache=True)
def _trusted(x: np.ndarray, foot: int, told: int, axis: int) -> float:
    """Share of the variance believed of what a standing foot does that it is taken to do: what it
    usually does, or does at present, and never more than is believed. (More shows as an error that
    lasts.)"""
    shown = max(x.foot_habit[foot, told, axis], x.foot_restlessness[foot, told, axis])
    return min(1.0, max(_LEAST_HABIT, shown))


@njit(cache=True)
def _add_noise_along(P: np.ndarray, start: int, F: Rotation, density: np.ndarray, T: float) -> None:
    """Adds random walks of these densities (3,) along the columns of F."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                P[start + i, start + j] += T * density[k] * F[3 * i + k] * F[3 * j + k]


@njit(cache=True)
def _predict(
    x: np.ndarray,
    P: np.ndarray,
    w: Vector,
    f: Vector,
    rate_variance: float,
    T: float,
    known: np.ndarray,
) -> None:
    """The step that ends now, in place.

    Args:
        x: record of the posterior where the step begins.
        w, f: angular velocity and specific force of the IMU in base axes, free of biases.
        rate_variance: of w and of the velocity change by f over the step, see below.
        known: see `_estimate_base`.
    """
    config, gravity = known.config, vector(known.gravity)
    _propagate(P, x, gravity, T)
    # Noise of the gyro turns attitude, and by the group all that turns with it: also feet, or what
    # is known of the legs would depend on how far from the world's origin they are.
    v, p = vector(x.imu_velocity), vector(x.imu_position)
    G = np.zeros((3, len(P)))
    _put_columns(G, _ATTITUDE, _IDENTITY)
    _put_columns(G, _VELOCITY, _transposed(skew(v)))
    _put_columns(G, _POSITION, _transposed(skew(p)))
    for foot in range(len(x.foot_standing)):
        if x.foot_standing[foot] > 0:
            _put_columns(G, _FEET + 6 * foot, _transposed(skew(vector(x.foot_position[foot]))))
    q = rate_variance * T * T
    for i in range(len(P)):
        for j in range(len(P)):
            P[i, j] += q * (G[0, i] * G[0, j] + G[1, i] * G[1, j] + G[2, i] * G[2, j])
    _add_noise(P, _GYRO_BIAS, config.gyro_walk**2 * T)
    _add_noise(P, _ACCELEROMETER_BIAS, config.accelerometer_walk**2 * T)
    creep, turn, lasts = np.empty(3), np.empty(3), 2.0 * AGREEMENT_TIME
    for foot in range(len(x.foot_standing)):
        if x.foot_standing[foot] > 0:
            at, restless = _FEET + 6 * foot, x.foot_restlessness[foot]
            # A foot that moves more than it does in spite of all does not stay.
            moving, turning = lasts * config.foot_velocity**2, lasts * config.foot_rate**2
            F = rotation_matrix(quaternion(x.foot_orientation[foot]))
            for i in range(3):
                creep[i] = _trusted(x, foot, _FOOT_POSITION, i) * config.foot_creep**2
                creep[i] += max(0.0, restless[_FOOT_VELOCITY, i] - 1.0) * moving
                turn[i] = _trusted(x, foot, _FOOT_ORIENTATION, i) * config.foot_turning**2
                if i == 2:
                    turn[i] *= _unrest(v) ** 2
                turn[i] += max(0.0, restless[_FOOT_RATE, i] - 1.0) * turning
            _add_noise_along(P, at, F, creep, T)
            _add_noise_along(P, at + 3, F, turn, T)
    acceleration = add(rotate(rotation(x.rotation), f), gravity)
    put(x.imu_position, add(p, add(scale(T, v), scale(0.5 * T * T, acceleration))))
    put(x.imu_velocity, add(v, scale(T, acceleration)))
    _turn(
        x, quaternion_product(quaternion(x.orientation), rotation_vector_to_quaternion(scale(T, w)))
    )


@njit(cache=True)
def _unrest(v: Vector) -> float:
    """Share of what a standing foot does in spite of all, for it comes of the robot's motion.

    Args:
        v: velocity of the IMU [m/s].
    """
    return min(1.0, max(_AT_REST, math.sqrt(dot(v, v)) / _WALKING_SPEED))


@njit(cache=True)
def _turn(x: np.ndarray, q: tuple[float, float, float, float]) -> None:
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
    return _scaled(scaling, (A, B, C, B, D, E, C, E, F))


@njit(cache=True)
def _update(
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
    if distance > _GATE:
        widening += (distance / _GATE - 1.0) * (S[0, 0] + S[1, 1] + S[2, 2]) / 3.0
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
def _correct(x: np.ndarray, error: np.ndarray) -> None:
    """Moves the estimate along the group by an error (n,)."""
    phi = vector(error[_ATTITUDE:_VELOCITY])
    _turn(x, quaternion_product(rotation_vector_to_quaternion(phi), quaternion(x.orientation)))
    for part, start in ((x.imu_velocity, _VELOCITY), (x.imu_position, _POSITION)):
        put(part, _moved(phi, vector(part), vector(error[start : start + 3])))
    for i in range(3):
        x.gyro_bias_B[i] += error[_GYRO_BIAS + i]
        x.accelerometer_bias_B[i] += error[_ACCELEROMETER_BIAS + i]
    for foot in range(len(x.foot_standing)):
        if not x.foot_standing[foot] > 0:
            continue
        start = _FEET + 6 * foot
        part = x.foot_position[foot]
        put(part, _moved(phi, vector(part), vector(error[start : start + 3])))
        turn = rotation_vector_to_quaternion(vector(error[start + 3 : start + 6]))
        q = quaternion_product(turn, quaternion(x.foot_orientation[foot]))
        put(x.foot_orientation[foot], normalized(q))


@njit(cache=True)
def _land(
    x: np.ndarray,
    P: np.ndarray,
    correction: np.ndarray,
    foot: int,
    model: np.ndarray,
    known: np.ndarray,
) -> None:
    """The errors of a foot that lands are those of the base, as is what is known of them."""
    p_IF = subtract(vector(model.foot_position[foot]), vector(known.mount.p_BI))
    moved = rotate(rotation(x.rotation), p_IF)
    put(x.foot_position[foot], add(vector(x.imu_position), moved))
    q_BF = quaternion_of(rotation(model.foot_rotation[foot]))
    put(x.foot_orientation[foot], quaternion_product(quaternion(x.orientation), q_BF))
    x.foot_agreement[foot] = 0.0
    for part, source in ((0, _POSITION), (3, _ATTITUDE)):
        start = _FEET + 6 * foot + part
        for i in range(3):
            correction[start + i] = correction[source + i]
            for j in range(len(P)):
                P[start + i, j] = P[source + i, j]
        for j in range(len(P)):
            for i in range(3):
                P[j, start + i] = P[j, source + i]


@njit(cache=True)
def _leg_noise(J: np.ndarray, first: int) -> float:
    """Mean square over three rows of what joint velocities with an error of one make there."""
    total = 0.0
    for i in range(first, first + 3):
        for j in range(6, J.shape[1]):
            total += J[i, j] ** 2
    return total / 3.0


@njit(cache=True)
def _isotropic(variance: float) -> np.ndarray:
    S = np.zeros((3, 3))
    S[0, 0] = S[1, 1] = S[2, 2] = variance
    return S


@njit(cache=True)
def _diagonal(x: np.ndarray, foot: int, told: int, variance: float, sensed: float) -> np.ndarray:
    """Diagonal matrix of a variance believed, as far as the foot is not trusted, and a rest."""
    S = np.zeros((3, 3))
    for i in range(3):
        S[i, i] = _trusted(x, foot, told, i) * variance + sensed
    return S


@njit(cache=True)
def _listen_to_foot(
    x: np.ndarray,
    P: np.ndarray,
    correction: np.ndarray,
    foot: int,
    share: float,
    w_raw: Vector,
    model: np.ndarray,
    elapsed: float,
    known: np.ndarray,
) -> bool:
    """What a foot that stands tells: where it is, how it is turned, and that it rests. (A point
    foot may turn, and tells nothing of that.)

    Args:
        share: of the weight, that it carries.
        w_raw: the gyro's reading in base axes.

    Returns:
        Has it moved of late by the robot's velocity, more than a foot does in spite of all?
    """
    config, sensors, J = known.config, known.sensors, model.foot_jacobian[foot]
    R, v, p = rotation(x.rotation), vector(x.imu_velocity), vector(x.imu_position)
    R_BF = rotation(model.foot_rotation[foot])
    p_IF = subtract(vector(model.foot_position[foot]), vector(known.mount.p_BI))
    start, keep = _FEET + 6 * foot, math.exp(-elapsed / AGREEMENT_TIME)
    # Errors that last for some time, as white noise that leaves as much over many ticks.
    light = max(1.0, _FIRM_LOAD / share) ** 2
    lasting = max(1.0, 2.0 * config.foot_time / elapsed)
    held = _unrest(v) ** 2 - 1.0
    angle, rate = sensors.joint_position_noise**2, sensors.joint_velocity_noise**2
    gyro = sensors.angular_velocity_noise**2
    turning, moving = _leg_noise(J, 0), _leg_noise(J, 3)
    agreement, innovation = x.foot_agreement[foot], x.foot_innovation[foot]
    explained = np.empty((2, 3))
    # All in axes of the sole.
    R_FW = _transposed(rotation_matrix(quaternion(x.foot_orientation[foot])))
    opposite = _scaled(-1.0, R_FW)
    is_flat = known.is_flat[foot] > 0
    x.foot_age[foot] += elapsed

    own, sensed = light * config.foot_position**2, moving * angle
    z = rotate(R_FW, subtract(rotate(R, p_IF), subtract(vector(x.foot_position[foot]), p)))
    noise = _diagonal(x, foot, _FOOT_POSITION, own * lasting, sensed)
    _update(
        P, correction, z, start, R_FW, _POSITION, opposite, noise, keep,
        agreement[_FOOT_POSITION], innovation[_FOOT_POSITION], explained,
    )  # fmt: skip
    _learn_motion(x, foot, _FOOT_POSITION, own, sensed, explained, elapsed)

    if is_flat:
        own, sensed = light * config.foot_orientation**2, turning * angle
        q_BF = quaternion_of(R_BF)
        seen = quaternion_product(quaternion(x.orientation), q_BF)
        z = rotation_vector(
            quaternion_product(seen, conjugate(quaternion(x.foot_orientation[foot])))
        )
        noise = _diagonal(x, foot, _FOOT_ORIENTATION, own * lasting, sensed)
        noise[2, 2] += held * _trusted(x, foot, _FOOT_ORIENTATION, 2) * own * lasting
        _update(
            P, correction, rotate(R_FW, z), start + 3, R_FW, _ATTITUDE, opposite, noise,
            keep, agreement[_FOOT_ORIENTATION], innovation[_FOOT_ORIENTATION], explained,
        )  # fmt: skip
        _learn_motion(x, foot, _FOOT_ORIENTATION, own, sensed, explained, elapsed)

    w_F, v_F = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for j in range(6, J.shape[1]):
        w_F = add(w_F, scale(model.velocity[j], (J[0, j], J[1, j], J[2, j])))
        v_F = add(v_F, scale(model.velocity[j], (J[3, j], J[4, j], J[5, j])))
    w_BF, v_BF = rotate(R_BF, w_F), rotate(R_BF, v_F)
    w = subtract(w_raw, vector(x.gyro_bias_B))
    own = light * config.foot_velocity**2
    sensed = moving * rate + dot(p_IF, p_IF) * gyro
    z = rotate(R_FW, subtract(scale(-1.0, rotate(R, add(cross(w, p_IF), v_BF))), v))
    of_bias = matrix_product(R_FW, matrix_product(R, skew(p_IF)))
    noise = _diagonal(x, foot, _FOOT_VELOCITY, own * lasting, sensed)
    _update(
        P, correction, z, _VELOCITY, R_FW, _GYRO_BIAS, of_bias, noise, keep,
        agreement[_FOOT_VELOCITY], innovation[_FOOT_VELOCITY], explained,
    )  # fmt: skip
    _learn_motion(x, foot, _FOOT_VELOCITY, own, sensed, explained, elapsed)
    possible = max(1.0, x.foot_habit[foot, _FOOT_VELOCITY].mean()) * own
    for i in range(3):
        possible += P[_VELOCITY + i, _VELOCITY + i] / 3.0
    mean = vector(agreement[_FOOT_VELOCITY])
    moves = dot(mean, mean) > _GATE * possible

    if is_flat:
        own, sensed = light * config.foot_rate**2, turning * rate + gyro
        z = rotate_back(R_BF, add(w, w_BF))
        noise = _diagonal(x, foot, _FOOT_RATE, own * lasting, sensed)
        noise[2, 2] += held * _trusted(x, foot, _FOOT_RATE, 2) * own * lasting
        _update(
            P, correction, z, _GYRO_BIAS, _transposed(R_BF), _GYRO_BIAS, _NONE, noise, keep,
            agreement[_FOOT_RATE], innovation[_FOOT_RATE], explained,
        )  # fmt: skip
        _learn_motion(x, foot, _FOOT_RATE, own, sensed, explained, elapsed)
    if is_flat and config.level_ground > 0.0:
        # The turn that makes the sole's normal vertical; of a turn about it nothing is said.
        n = rotate(rotation_matrix(quaternion(x.foot_orientation[foot])), (0.0, 0.0, 1.0))
        noise = _isotropic(config.level_ground**2 * lasting * light)
        noise[2, 2] += 1e6
        spare = np.zeros(3)
        z = cross(n, (0.0, 0.0, 1.0))
        _update(
            P, correction, z, start + 3, _IDENTITY, _ATTITUDE, _NONE, noise, 0.0, spare,
            spare.copy(), np.empty((2, 3)),
        )  # fmt: skip
    return moves


@njit(cache=True)
def _learn_motion(
    x: np.ndarray,
    foot: int,
    told: int,
    own: float,
    sensed: float,
    explained: np.ndarray,
    elapsed: float,
) -> None:
    """A standing foot may do less than is believed, or more, and its innovations show it.

    They are stated as large as they have just been.

    Args:
        told: what the innovation is of.
        own, sensed: variance believed of what the foot does there, and of what sensors add.
        explained: see `_update`.
    """
    innovation, variance = x.foot_innovation[foot, told], x.foot_innovation_variance[foot, told]
    restless, habit = x.foot_restlessness[foot, told], x.foot_habit[foot, told]
    fast = min(_MOST_TOLD, 1.0 - math.exp(-elapsed / _RESTLESSNESS_TIME[told]))
    slow = elapsed / min(_HABIT_TIME, x.foot_age[foot])
    for i in range(3):
        square = innovation[i] * innovation[i]
        known = explained[0, i] + sensed
        variance[i] = known + explained[1, i] + restless[i] * own
        surprise = min(_LARGEST_SURPRISE, square / variance[i])
        learned = restless[i] * (1.0 + fast * (surprise - 1.0))
        restless[i] = max(_LEAST_RESTLESSNESS, learned)
        shown = min(LARGEST_SHARE, square / (known + habit[i] * own))
        habit[i] = max(_LEAST_HABIT, habit[i] * (1.0 + slow * (shown - 1.0)))


@njit(cache=True)
def _force_errors(f_raw: Vector, config: np.ndarray) -> Vector:
    """What the mean acceleration by the foot forces is hardly ever wrong by [m/s^2]."""
    any_way, gain = config.force_error**2, config.force_gain_error**2
    return (
        _CONTRADICTION * math.sqrt(any_way + gain * f_raw[0] ** 2),
        _CONTRADICTION * math.sqrt(any_way + gain * f_raw[1] ** 2),
        _CONTRADICTION * math.sqrt(any_way + gain * f_raw[2] ** 2),
    )


@njit(cache=True)
def _listen_to_forces(
    x: np.ndarray,
    P: np.ndarray,
    correction: np.ndarray,
    force: Vector,
    f_raw: Vector,
    w: Vector,
    away: Vector,
    away_before: Vector,
    model: np.ndarray,
    elapsed: float,
    known: np.ndarray,
) -> None:
    """The foot forces tell how the centre of mass accelerates, and so the accelerometer's bias.

    Args:
        force: of the ground on the robot, in base axes [N].
        f_raw: the accelerometer's reading in base axes [m/s^2].
        w: angular velocity of the base [rad/s].
        away, away_before: velocity of the centre of mass relative to the IMU in base axes, now and
            a tick ago [m/s].
    """
    config = known.config
    relative = add(scale(1.0 / elapsed, subtract(away, away_before)), cross(w, away))
    f = subtract(f_raw, vector(x.accelerometer_bias_B))
    z = subtract(add(f, relative), scale(1.0 / known.mass, force))
    lasting = max(1.0, 2.0 * config.force_time / elapsed)
    sensed = _acceleration_noise(model, elapsed, known)
    own, noise, once = np.empty(3), np.zeros((3, 3)), np.empty(3)
    explained = np.empty((2, 3))
    for i in range(3):
        for j in range(3):
            noise[i, j] = config.force_gain_error**2 * lasting * f_raw[i] * f_raw[j]
        own[i] = x.force_habit[i] * config.force_error**2
        once[i] = own[i] + noise[i, i] / lasting + sensed[i]
        noise[i, i] += own[i] * lasting + sensed[i]
    _update(
        P, correction, z, _ACCELEROMETER_BIAS, _IDENTITY, _GYRO_BIAS, _NONE, noise,
        math.exp(-elapsed / config.force_time), x.force_agreement, x.force_innovation, explained,
    )  # fmt: skip
    for i in range(3):
        x.force_innovation_variance[i] = once[i] + explained[0, i] + explained[1, i]
    # What lasts shows in the mean over that time, once there is one.
    x.force_age += elapsed
    if x.force_age < config.force_time:
        return
    gain = elapsed / min(_FORCE_HABIT_TIME, x.force_age)
    filled = 1.0 - math.exp(-x.force_age / config.force_time)
    for i in range(3):
        gained, at = (config.force_gain_error * f_raw[i]) ** 2, _ACCELEROMETER_BIAS + i
        by_habit = 0.5 * (own[i] + gained) + P[at, at]
        shown = max(SMALLEST_SHARE, (x.force_agreement[i] / filled) ** 2 / by_habit)
        told = math.log(min(shown, LARGEST_SHARE)) - LOG_OF_ONE
        learned = x.force_habit[i] * math.exp(gain * own[i] / (own[i] + gained) * told)
        x.force_habit[i] = min(1.0, max(_LEAST_HABIT, learned))


@njit(cache=True)
def _acceleration_noise(model: np.ndarray, elapsed: float, known: np.ndarray) -> np.ndarray:
    """Variance of what the sensors' noise adds to the acceleration of the centre of mass by them,
    less that by the foot forces, (3,)."""
    sensors = known.sensors
    rate = 2.0 * (sensors.joint_velocity_noise / elapsed) ** 2
    turning = 2.0 * (sensors.angular_velocity_noise / elapsed) ** 2
    arm = subtract(vector(model.com), vector(known.mount.p_BI))
    variance = np.empty(3)
    for i in range(3):
        moved = 0.0
        for joint in range(len(model.mass_matrix)):
            moved += (model.mass_matrix[joint, 3 + i] / known.mass) ** 2
        turned = dot(arm, arm) - arm[i] ** 2
        variance[i] = rate * moved + turning * turned + sensors.acceleration_noise**2
        variance[i] += known.force_variance / known.mass**2
    return variance


@njit(cache=True)
def _start(x: np.ndarray, measured: np.ndarray, model: np.ndarray, known: np.ndarray) -> None:
    """The first posterior: upright by the accelerometer, looking ahead, soles where they are said
    to be."""
    sensors, P = known.sensors, x.error_covariance
    R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    f = rotate(R_BI, vector(measured.specific_force))
    _turn(x, quaternion_from_gravity(f, 0.0))
    x.foot_restlessness[:] = 1.0
    x.foot_habit[:] = 1.0
    x.foot_age[:] = known.config.foot_time
    x.force_habit[:] = 1.0
    R, middle, feet = rotation(x.rotation), (0.0, 0.0, 0.0), len(x.foot_standing)
    for foot in range(feet):
        middle = add(middle, scale(1.0 / feet, vector(model.foot_position[foot])))
    base = subtract(vector(known.origin), rotate(R, middle))
    put(x.imu_position, add(base, rotate(R, p_BI)))
    for i in range(2):  # Yaw is what it is said to be ...
        P[_ATTITUDE + i, _ATTITUDE + i] = known.start.tilt**2
    # ... and so is the place of the soles, about which the error of the tilt turns the base.
    about = skew(vector(known.origin))
    _add_product(P, _POSITION, about, P, _ATTITUDE)
    _add_product(P.T, _POSITION, about, P.T, _ATTITUDE)
    _add_noise(P, _VELOCITY, known.start.velocity**2)
    _add_noise(P, _GYRO_BIAS, sensors.angular_velocity_bias**2 + 1e-12)
    _add_noise(P, _ACCELEROMETER_BIAS, sensors.acceleration_bias**2 + 1e-12)
    # What the accelerometer reads is gravity, its bias and some motion.
    correction, spare = np.zeros(len(P)), np.zeros(3)
    reading = rotate(R, f)
    z = add(reading, vector(known.gravity))
    noise = _isotropic(known.start.acceleration**2 + sensors.acceleration_noise**2)
    _update(
        P, correction, z, _ATTITUDE, skew(reading), _ACCELEROMETER_BIAS, R, noise, 0.0, spare,
        spare.copy(), np.empty((2, 3)),
    )  # fmt: skip
    _correct(x, correction)


@njit(cache=True)
def _estimate_base(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> None:
    """One tick of `InvariantBaseFilter`; fills the posterior.

    Args:
        known: record with the numbers of `InvariantFilter` and `SensorBeliefs`, `mount`, see
            `ImuMount`, `pads`, see `FootPads`, `is_flat` (feet,), 1 of a foot that is no point,
            `mass` [kg], `gravity` (3,) [m/s^2], `start`, how sure the first posterior is, `origin`,
            where the middle of the soles is at the start (3,) [m], and the `period` of ticks [s].
    """
    posterior[()] = last[()]
    x, last, measured, model, known = posterior[()], last[()], measured[()], model[()], known[()]
    trust, feet, sensors, P = (
        measured.trust,
        len(measured.support),
        known.sensors,
        x.error_covariance,
    )
    first = math.isnan(elapsed)
    if first and trust[:2].max() > 0:
        x.status = _NOT_FINITE
        return
    x.status = trust.max()
    R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    w_raw = rotate(R_BI, vector(measured.angular_velocity))
    f_mean = rotate(R_BI, vector(measured.mean.specific_force))
    wrench = foot_wrenches(measured.pad_force, known.pads.position, known.pads.foot, feet)
    mean_force = measured.mean.pad_force
    mean_wrench = foot_wrenches(mean_force, known.pads.position, known.pads.foot, feet)
    weight = known.mass * 9.81
    w_now = subtract(w_raw, vector(x.gyro_bias_B))
    firm = x.foot_standing * known.is_flat
    rests, rolling = firm_foot_rate(firm, wrench, weight, w_now, model)
    contradiction = force_contradiction(x.check, _force_errors(f_mean, known.config))
    if first:
        _start(x, measured, model, known)
    else:
        w = rotate(R_BI, vector(measured.mean.angular_velocity))
        w = subtract(w, vector(x.gyro_bias_B))
        f = subtract(f_mean, vector(x.accelerometer_bias_B))
        rate_noise, force_noise = sensors.angular_velocity_noise, sensors.acceleration_noise
        if trust[1] > 0:
            f = rotate_back(rotation(x.rotation), scale(-1.0, vector(known.gravity)))
            rate_noise, force_noise = _UNKNOWN_RATE, _UNKNOWN_ACCELERATION
            if rests and trust[0] == 0 and trust[2:].max() == 0:
                w, rate_noise = subtract(w_now, rolling), _FOOT_RATE_ERROR
            else:
                w = (0.0, 0.0, 0.0)
            lasting = math.sqrt(max(1.0, 2.0 * _UNKNOWN_TIME / elapsed))
            rate_noise, force_noise = lasting * rate_noise, lasting * force_noise
        elif contradiction > 0.0:
            # Or velocities that it makes would be put down to a tilt.
            force_noise += contradiction * math.sqrt(max(1.0, 2.0 * _UNKNOWN_TIME / elapsed))
        _predict(x, P, w, f, rate_noise**2, elapsed, known)
        _add_noise(P, _VELOCITY, (force_noise * elapsed) ** 2)
    force, carried = (0.0, 0.0, 0.0), 0.0
    load_by_mass = np.empty((feet, 3))
    x.foot_innovation[:] = 0.0
    x.foot_innovation_variance[:] = 0.0
    correction = np.zeros(len(P))
    all_move, resting = True, False
    for foot in range(feet):
        load, stands = wrench[foot, 5], measured.support[foot] > 0
        if stands and not x.foot_standing[foot] > 0:
            _land(x, P, correction, foot, model, known)
        elif stands and not first and trust[0] == 0 and trust[1] == 0 and trust[2 + foot] == 0:
            share = max(load, 1.0) / weight
            moves = _listen_to_foot(x, P, correction, foot, share, w_raw, model, elapsed, known)
            all_move, resting = all_move and moves, True
        x.foot_standing[foot] = measured.support[foot]
        R_BF = rotation(model.foot_rotation[foot])
        in_foot = (mean_wrench[foot, 3], mean_wrench[foot, 4], mean_wrench[foot, 5])
        foot_force = rotate(R_BF, in_foot)
        force = add(force, foot_force)
        put(load_by_mass[foot], scale(1.0 / known.mass, foot_force))
        carried += load
    # Velocity of the centre of mass relative to the IMU.
    w = subtract(w_raw, vector(x.gyro_bias_B))
    away = subtract(vector(model.com_velocity), cross(w, p_BI))
    was_known = last.away_known > 0 and not first
    is_fresh = trust[0] == 0
    for sensor in range(1, len(trust)):
        is_fresh = is_fresh and (trust[sensor] == 0 or trust[sensor] == _IMPLAUSIBLE)
    if was_known and is_fresh and elapsed <= LONGEST_COMPARED_TICK:
        relative = scale(1.0 / elapsed, subtract(away, vector(last.away)))
        relative = add(relative, cross(w, away))
        push = scale(1.0 / known.mass, force)
        # The gyro's own reading: a bias that is learned within a tick is no step of it.
        cross_check(x.check, f_mean, relative, push, load_by_mass, rests, rolling, w_raw, elapsed)
        if trust.max() == 0:
            shown = subtract(add(f_mean, relative), vector(x.accelerometer_bias_B))
            noise, period = sensors.acceleration_noise, known.period
            watch_force_delay(x.force_delay, shown, push, noise, elapsed, period)
        else:
            forget_force_delay(x.force_delay)
    else:
        forget_force_delay(x.force_delay)
        if not is_fresh or elapsed > LONGEST_COMPARED_TICK:
            x.check.age = 0.0
            x.check.doubt[:] = 0.0
    if was_known and trust.max() == 0 and carried > _CARRIED * weight:
        before = vector(last.away)
        _listen_to_forces(x, P, correction, force, f_mean, w, away, before, model, elapsed, known)
    put(x.away, away)
    x.away_known = 1.0 if trust[0] == 0 and trust[1] in (0.0, _IMPLAUSIBLE) else 0.0
    _correct(x, correction)
    if resting:
        x.lost_for = x.lost_for + elapsed if all_move and contradiction == 0.0 else 0.0
    # Nor is it they if the IMU is found to be wrong meanwhile: it was so before.
    if x.lost_for > _LOST_AFTER or (x.lost_for > 0.0 and trust[1] == _IMPLAUSIBLE):
        _start_over(x, model, known)
    _leash_biases(x, first, elapsed, known.config)
    is_doubtful = trust.max() > 0 or x.check.doubt.max() > 0
    is_doubtful = is_doubtful or contradiction > 0.0 or x.lost_for > 0.0
    _remember_biases(x, is_doubtful, first, elapsed)
    _conclude(x, w_raw, wrench, measured, model, known)


@njit(cache=True)
def _start_over(x: np.ndarray, model: np.ndarray, known: np.ndarray) -> None:
    """Attitude, velocity and place are no better known than at the start; biases are.

    All feet that stand are put down anew.
    """
    P, spare = x.error_covariance, np.zeros(len(x.error_covariance))
    _add_noise(P, _ATTITUDE, known.start.tilt**2)
    _add_noise(P, _VELOCITY, known.start.velocity**2)
    _add_noise(P, _POSITION, (known.start.velocity * _LOST_AFTER) ** 2)
    for foot in range(len(x.foot_standing)):
        if x.foot_standing[foot] > 0:
            _land(x, P, spare, foot, model, known)
    x.lost_for = 0.0


@njit(cache=True)
def _leash_biases(x: np.ndarray, first: bool, elapsed: float, config: np.ndarray) -> None:
    """Keeps the IMU's biases where they can be by what was known of them."""
    leash, P = x.leash, x.error_covariance
    x.leashed_for = 0.0 if first else x.leashed_for + elapsed
    if first or x.leashed_for > _LEASH_TIME:
        x.leashed_for = 0.0
        _copy_rows(leash[0], leash[1])
        for i in range(3):
            leash[1, 0, i], leash[1, 1, i] = x.gyro_bias_B[i], x.accelerometer_bias_B[i]
            for sensor in range(2):
                at = (_GYRO_BIAS if sensor == 0 else _ACCELEROMETER_BIAS) + i
                walk = config.gyro_walk if sensor == 0 else config.accelerometer_walk
                least = _LEAST_WALKS * walk * math.sqrt(_LEASH_TIME)
                leash[1, 2 + sensor, i] = P[at, at] + least**2
        if first:
            _copy_rows(leash[0], leash[1])
    for sensor in range(2):
        bias = x.gyro_bias_B if sensor == 0 else x.accelerometer_bias_B
        for i in range(3):
            at = (_GYRO_BIAS if sensor == 0 else _ACCELEROMETER_BIAS) + i
            middle, learned = leash[0, sensor, i], max(0.0, leash[0, 2 + sensor, i] - P[at, at])
            reach = _LEASH * math.sqrt(learned)
            _set_bias(x, sensor, i, min(max(bias[i], middle - reach), middle + reach))


@njit(cache=True)
def _set_bias(x: np.ndarray, sensor: int, axis: int, value: float) -> None:
    """Sets a bias of the gyro (0) or the accelerometer (1), and moves with it what is known by it.

    What the filter took for a bias it also took for a tilt.
    """
    at = (_GYRO_BIAS if sensor == 0 else _ACCELEROMETER_BIAS) + axis
    bias = x.gyro_bias_B if sensor == 0 else x.accelerometer_bias_B
    P, change = x.error_covariance, value - bias[axis]
    if change != 0.0 and P[at, at] > 0.0:
        _correct(x, P[at] * (change / P[at, at]))


@njit(cache=True)
def _copy_rows(to: np.ndarray, source: np.ndarray) -> None:
    """Fills a matrix. (numba takes ten times as long to compile `to[:] = source`.)"""
    for i in range(to.shape[0]):
        for j in range(to.shape[1]):
            to[i, j] = source[i, j]


@njit(cache=True)
def _put_biases(to: np.ndarray, x: np.ndarray) -> None:
    """Fills (2, 3) with the biases of gyro and accelerometer in base axes."""
    put(to[0], vector(x.gyro_bias_B))
    put(to[1], vector(x.accelerometer_bias_B))


@njit(cache=True)
def _remember_biases(x: np.ndarray, is_doubtful: bool, first: bool, elapsed: float) -> None:
    """While sensors are doubtful the IMU's biases are those from before they began to fail."""
    kept = x.kept_biases
    if first:
        _put_biases(kept[0], x)
        _put_biases(kept[1], x)
        x.kept_for = 0.0
    elif is_doubtful:
        _copy_rows(kept[1], kept[0])
        for sensor in range(2):
            for axis in range(3):
                _set_bias(x, sensor, axis, kept[0, sensor, axis])
        x.kept_for = 0.0
    else:
        x.kept_for += elapsed
        if x.kept_for > _MEMORY:
            _copy_rows(kept[0], kept[1])
            _put_biases(kept[1], x)
            x.kept_for = 0.0


@njit(cache=True)
def _conclude(
    x: np.ndarray,
    w_raw: Vector,
    wrench: np.ndarray,
    measured: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> None:
    """Fills what follows from the state: the base, the centre of mass and the ZMP."""
    P, R = x.error_covariance, rotation(x.rotation)
    R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    w = subtract(w_raw, vector(x.gyro_bias_B))
    if measured.trust[1] == 0:
        put(x.angular_velocity, w)
    w = vector(x.angular_velocity)
    position = subtract(vector(x.imu_position), rotate(R, p_BI))
    velocity = subtract(vector(x.imu_velocity), rotate(R, cross(w, p_BI)))
    put(x.base_position, position)
    put(x.base_velocity, velocity)
    put(x.com_position, add(position, rotate(R, vector(model.com))))
    put(x.com_velocity, add(velocity, rotate(R, vector(model.com_velocity))))
    put(x.angular_velocity_bias, rotate_back(R_BI, vector(x.gyro_bias_B)))
    put(x.acceleration_bias, rotate_back(R_BI, vector(x.accelerometer_bias_B)))
    total, zmp_x, zmp_y = 0.0, 0.0, 0.0
    for foot in range(len(x.foot_standing)):
        load = wrench[foot, 5]
        if x.foot_standing[foot] > 0 and measured.trust[2 + foot] == 0 and load > 1.0:
            lever = (-wrench[foot, 1] / load, wrench[foot, 0] / load, 0.0)
            R_WF = rotation_matrix(quaternion(x.foot_orientation[foot]))
            centre = add(vector(x.foot_position[foot]), rotate(R_WF, lever))
            zmp_x, zmp_y, total = zmp_x + load * centre[0], zmp_y + load * centre[1], total + load
    if total > 0:
        put(x.zmp, (zmp_x / total, zmp_y / total))
    # The group's errors turn with the attitude's: v - v_hat = xi_v + phi x v.
    for i in range(3):
        x.attitude_std[i] = math.sqrt(max(0.0, P[_ATTITUDE + i, _ATTITUDE + i]))
        x.angular_velocity_bias_std[i] = math.sqrt(max(0.0, P[_GYRO_BIAS + i, _GYRO_BIAS + i]))
        at = _ACCELEROMETER_BIAS + i
        x.acceleration_bias_std[i] = math.sqrt(max(0.0, P[at, at]))
        x.velocity_std[i] = _moved_std(P, _VELOCITY, i, velocity)
        x.position_std[i] = _moved_std(P, _POSITION, i, position)


@njit(cache=True)
def _moved_std(P: np.ndarray, block: int, i: int, a: Vector) -> float:
    """Standard deviation of component i of error[block] + attitude error x a."""
    j, k = (i + 1) % 3, (i + 2) % 3
    # Component i of phi x a is phi_j a_k - phi_k a_j.
    m, s, t = block + i, _ATTITUDE + j, _ATTITUDE + k
    variance = P[m, m] + a[k] ** 2 * P[s, s] + a[j] ** 2 * P[t, t]
    variance += 2.0 * (a[k] * P[m, s] - a[j] * P[m, t] - a[j] * a[k] * P[s, t])
    return math.sqrt(max(0.0, variance))


class InvariantBaseFilter(RecursiveEstimator):
    """Attitude, velocity and position of the base with the IMU's biases, see `InvariantFilter`.

    .. pydrake_system::

        name: InvariantBaseFilter
        input_ports:
        - measurements
        - model
        output_ports:
        - posterior
        - (one for each field)
        - last

    Inputs: posteriors of `SensorMonitor` and `FloatingBaseModel`. `last` is the posterior of the
    tick before, for those that feed it. World axes unless said. Yaw and place are those of the
    start, as far as standing feet hold them. Fields of the posterior:

        orientation            (4,)    quaternion [w, x, y, z] of the base; its sign never jumps
        rotation               (3, 3)  R_WB
        angular_velocity       (3,)    of the base in base axes, free of the bias [rad/s]
        base_position, base_velocity   (3,)  of the base's origin [m, m/s]
        com_position, com_velocity     (3,)  [m, m/s]
        zmp                    (2,)    from the foot forces (eqs. 8, 9) [m]
        attitude_std, velocity_std, position_std   (3,)  standard deviations, of a rotation vector
                                       in world axes [rad], [m/s], [m]
        angular_velocity_bias, acceleration_bias   (3,)  of the IMU in its axes [rad/s, m/s^2], and
                                       `..._std` in base axes
        imu_position, imu_velocity     (3,)  of the IMU [m, m/s]
        gyro_bias_B, accelerometer_bias_B   (3,)  in base axes
        foot_standing          (feet,)     who stood at the last tick
        foot_position, foot_orientation   (feet, 3), (feet, 4)  of each sole while it stands
        error_covariance       (n, n)  of the errors [attitude, velocity, position, gyro bias,
                                       accelerometer bias, (position, orientation) of each foot] on
                                       the group, n = 15 + 6 feet
        foot_innovation, foot_innovation_variance   (feet, 4, 3)  of a standing foot's position,
                                       orientation, velocity and angular velocity, in axes of the
                                       sole
        force_innovation, force_innovation_variance   (3,)  of the centre of mass's acceleration, in
                                       base axes
        foot_agreement, force_agreement   running means of the innovations
        foot_restlessness, foot_habit  (feet, 4, 3)  of what a standing foot may do, in these four,
                                       how much it does at present and usually, as a share of the
                                       variance
        force_habit            (3,)    the same of the forces' error
        foot_age, force_age    (feet,), ()  for how long each has been listened to [s]
        check                  what `cross_check` remembers: `doubt` (1 + feet,), positive for the
                               IMU and the feet that contradict the rest; `mean` (2, 3, 3) and
                               `load` (2, feet, 3) of the last 10 ms and 50 ms; `spread`; `rolling`
                               (3,); `habit` (3,), what always contradicts; `last_rate`,
                               `last_rolling` (3,) and `was_firm` of the tick before; `stepped`,
                               `age`, `habit_age` and `agreed`, for how long the gyro is doubted for
                               its step, all is watched, the habit is learned, and nothing
                               contradicts [s]
        force_delay            what `watch_force_delay` remembers: the `delay` of the foot forces
                               [s], and more, see `force_delay_type`
        kept_biases, kept_for  (2, 2, 3), ()  biases of gyro and accelerometer, older and newer, in
                               base axes, and the newer's age [s]
        lost_for               ()      for how long all feet that stand have contradicted the
                                       velocity [s]
        leash, leashed_for     (2, 4, 3), ()  biases and their standard deviations, older and newer,
                               and the newer's age [s]
        away, away_known       (3,), ()  velocity of the centre of mass relative to the IMU in base
                                       axes [m/s], and whether it was measured
    """

    def __init__(
        self,
        config: InvariantFilter,
        sensors: SensorBeliefs,
        robot: Robot,
        measurements: np.dtype,
        model: np.dtype,
        clock: Clock,
        origin: tuple[float, float],
    ):
        """Declares ports and state.

        Args:
            measurements, model: types of the inputs' posteriors.
            origin: where the middle of the soles is at the start, (x, y) [m].
        """
        super().__init__(base_filter_type(robot, clock), clock)
        pads, plant = FootPads(robot), robot.plant
        self._known = record(
            config=config,
            sensors=sensors,
            mount=record(**vars(ImuMount(robot))),
            pads=record(position=pads.position, foot=pads.foot),
            is_flat=np.array([float(not leg.is_point) for leg in robot.description.legs.values()]),
            force_variance=sensors.force_noise**2 * len(pads.foot),
            mass=plant.CalcTotalMass(plant.CreateDefaultContext()),
            gravity=plant.gravity_field().gravity_vector(),
            start=record(tilt=0.2, velocity=0.1, acceleration=0.05),
            origin=np.array([*origin, 0.0]),
            period=clock.period,
        )
        self._measurements = self._declare_record_input("measurements", measurements)
        self._model = self._declare_record_input("model", model)
        self._declare_posterior()
        self.DeclareStateOutputPort("last", self._last)

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        return {"measurements": measurements_type(robot), "model": model_type(robot)}

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, model = self._measurements.Eval(context), self._model.Eval(context)
        _estimate_base(posterior, last, elapsed, measured, model, self._known)


def base_filter_type(robot: Robot, clock: Clock) -> np.dtype:
    """Type of the posterior of `InvariantBaseFilter`."""
    feet = len(robot.description.sides)
    n = _FEET + 6 * feet
    triples = (
        "angular_velocity",
        "base_position",
        "base_velocity",
        "com_position",
        "com_velocity",
        "attitude_std",
        "velocity_std",
        "position_std",
        "angular_velocity_bias",
        "acceleration_bias",
        "angular_velocity_bias_std",
        "acceleration_bias_std",
        "imu_position",
        "imu_velocity",
        "gyro_bias_B",
        "accelerometer_bias_B",
        "away",
        "force_innovation",
        "force_agreement",
    )
    return record_type(
        time=(),
        status=(),
        orientation=(4,),
        rotation=(3, 3),
        **dict.fromkeys(triples, (3,)),
        zmp=(2,),
        away_known=(),
        force_innovation_variance=(3,),
        force_habit=(3,),
        force_age=(),
        foot_standing=(feet,),
        foot_position=(feet, 3),
        foot_orientation=(feet, 4),
        foot_agreement=(feet, _TOLD, 3),
        foot_restlessness=(feet, _TOLD, 3),
        foot_habit=(feet, _TOLD, 3),
        foot_age=(feet,),
        foot_innovation=(feet, _TOLD, 3),
        foot_innovation_variance=(feet, _TOLD, 3),
        error_covariance=(n, n),
        kept_biases=(2, 2, 3),
        kept_for=(),
        leash=(2, 4, 3),
        leashed_for=(),
        lost_for=(),
        check=cross_check_type(feet),
        force_delay=force_delay_type(clock),
    )
