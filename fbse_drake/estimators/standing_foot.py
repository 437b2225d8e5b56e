"""What a foot that stands tells of the base, and how far it is trusted."""

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from numba import njit

from fbse_drake.estimators.innovations import AGREEMENT_TIME, LARGEST_SHARE, LEAST_HABIT
from fbse_drake.estimators.invariant_error import (
    ATTITUDE,
    FEET,
    GATE,
    GYRO_BIAS,
    IDENTITY,
    NONE,
    POSITION,
    VELOCITY,
    isotropic,
    update,
)
from fbse_drake.estimators.records import Record
from fbse_drake.estimators.spatial import (
    Vector,
    add,
    conjugate,
    cross,
    dot,
    matrix_product,
    norm,
    put,
    quaternion,
    quaternion_of,
    quaternion_product,
    rotate,
    rotate_back,
    rotation,
    rotation_matrix,
    rotation_vector,
    scale,
    scaled,
    skew,
    subtract,
    transposed,
    vector,
)

# What a standing foot tells, and how many things that are. (numpy integers, see `invariant_error`.)
FOOT_POSITION, FOOT_ORIENTATION, FOOT_VELOCITY, FOOT_RATE = cast(Sequence[int], np.arange(4))
TOLD = 4
# A foot does little in spite of all while the robot rests: this share of what it does from this
# speed of the robot on [m/s].
_AT_REST, _WALKING_SPEED = 0.02, 0.03
# How long it takes to learn what a standing foot does at present [s], by what it tells; how much of
# that, and of larger innovations, one tick may tell; and the least that it is taken to do, as a
# share of the variance believed.
_RESTLESSNESS_TIME, _LEAST_RESTLESSNESS = (0.1, 0.1, 0.03, 0.03), 1e-4
_MOST_TOLD, _LARGEST_SURPRISE = 0.05, 100.0
# For how long feet must have erred less than believed to be trusted more [s].
_HABIT_TIME = 0.4
# Beyond so many times the variance believed of a standing foot's velocity it is not usual, and the
# robot's velocity is wrong.
_LARGEST_HABIT = 36.0
# A foot slides that is faster along its sole than so many times what it does in spite of all.
SLIDES = 3.0
# A foot that carries more than this share of the weight stands firmly ...
FIRM_SHARE = 0.3
# ... and one that carries less than this moves more easily the less it carries.
_FIRM_LOAD = 0.5


@njit(cache=True)
def trusted(x: Record, foot: int, told: int, axis: int) -> float:
    """Share of the variance believed of what a standing foot does that it is taken to do: what it
    usually does, or does at present, and never more than is believed. (More shows as an error that
    lasts.)"""
    shown = max(x.foot_habit[foot, told, axis], x.foot_restlessness[foot, told, axis])
    return min(1.0, max(LEAST_HABIT, shown))


@njit(cache=True)
def unrest(v: Vector) -> float:
    """Share of what a standing foot does in spite of all, for it comes of the robot's motion.

    Args:
        v: velocity of the IMU [m/s].
    """
    return min(1.0, max(_AT_REST, norm(v) / _WALKING_SPEED))


@njit(cache=True)
def centre_of_pressure(wrench: np.ndarray, sole: np.ndarray) -> Vector:
    """Where the load of a foot is, on its sole, in the sole frame [m]; the middle without a load.

    Args:
        wrench: [moment, force] at the sole's origin in the sole frame, (6,) [Nm, N].
        sole: least and largest x and y, (2, 2) [m].
    """
    load = wrench[5]
    if not load > 0.0:
        return (0.5 * (sole[0, 0] + sole[1, 0]), 0.5 * (sole[0, 1] + sole[1, 1]), 0.0)
    return (
        min(max(-wrench[1] / load, sole[0, 0]), sole[1, 0]),
        min(max(wrench[0] / load, sole[0, 1]), sole[1, 1]),
        0.0,
    )


@njit(cache=True)
def land(
    x: Record,
    P: np.ndarray,
    correction: np.ndarray,
    foot: int,
    model: Record,
    known: Record,
) -> None:
    """The errors of a foot that lands are those of the base, as is what is known of them."""
    p_IF = subtract(vector(model.foot_position[foot]), vector(known.mount.p_BI))
    moved = rotate(rotation(x.rotation), p_IF)
    put(x.foot_position[foot], add(vector(x.imu_position), moved))
    q_BF = quaternion_of(rotation(model.foot_rotation[foot]))
    put(x.foot_orientation[foot], quaternion_product(quaternion(x.orientation), q_BF))
    x.foot_agreement[foot] = 0.0
    x.foot_stood[foot] = 0.0
    for part, source in ((0, POSITION), (3, ATTITUDE)):
        start = FEET + 6 * foot + part
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
def _diagonal(x: Record, foot: int, told: int, variance: float, sensed: float) -> np.ndarray:
    """Diagonal matrix of a variance believed, as far as the foot is not trusted, and a rest."""
    S = np.zeros((3, 3))
    for i in range(3):
        S[i, i] = trusted(x, foot, told, i) * variance + sensed
    return S


@njit(cache=True)
def listen_to_foot(
    x: Record,
    P: np.ndarray,
    correction: np.ndarray,
    foot: int,
    share: float,
    pivot: Vector,
    w_raw: Vector,
    model: Record,
    elapsed: float,
    known: Record,
) -> tuple[bool, float, Vector]:
    """What a foot that stands tells: where it is, how it is turned, and that it rests. (A point
    foot may turn, and tells nothing of that.)

    Args:
        share: of the weight, that it carries.
        pivot: centre of pressure in the sole frame [m]: a foot that rolls rests there.
        w_raw: the gyro's reading in base axes.

    Returns:
        Has it moved of late by the robot's velocity, more than a foot does in spite of all? The
        square of how fast it slides by it, less what a foot does [m^2/s^2]; and its mean velocity
        by it along the sole, in world axes [m/s].
    """
    config, sensors, J = known.config, known.sensors, model.foot_jacobian[foot]
    R, v, p = rotation(x.rotation), vector(x.imu_velocity), vector(x.imu_position)
    R_BF = rotation(model.foot_rotation[foot])
    p_IF = subtract(vector(model.foot_position[foot]), vector(known.mount.p_BI))
    start, keep = FEET + 6 * foot, math.exp(-elapsed / AGREEMENT_TIME)
    # Errors that last for some time, as white noise that leaves as much over many ticks.
    light = max(1.0, _FIRM_LOAD / share) ** 2
    lasting = max(1.0, 2.0 * config.foot_time / elapsed)
    held = unrest(v) ** 2 - 1.0
    angle, rate = sensors.joint_position_noise**2, sensors.joint_velocity_noise**2
    gyro = x.gyro.noise * sensors.angular_velocity_noise**2
    turning, moving = _leg_noise(J, 0), _leg_noise(J, 3)
    agreement, innovation = x.foot_agreement[foot], x.foot_innovation[foot]
    explained = np.empty((2, 3))
    # All in axes of the sole.
    R_FW = transposed(rotation_matrix(quaternion(x.foot_orientation[foot])))
    opposite = scaled(-1.0, R_FW)
    is_flat = known.is_flat[foot] > 0
    x.foot_age[foot] += elapsed
    x.foot_stood[foot] += elapsed

    own, sensed = light * config.foot_position**2, moving * angle
    z = rotate(R_FW, subtract(rotate(R, p_IF), subtract(vector(x.foot_position[foot]), p)))
    noise = _diagonal(x, foot, FOOT_POSITION, own * lasting, sensed)
    update(
        P, correction, z, start, R_FW, POSITION, opposite, noise, keep,
        agreement[FOOT_POSITION], innovation[FOOT_POSITION], explained,
    )  # fmt: skip
    _learn_motion(x, foot, FOOT_POSITION, own, sensed, explained, elapsed)

    if is_flat:
        own, sensed = light * config.foot_orientation**2, turning * angle
        q_BF = quaternion_of(R_BF)
        seen = quaternion_product(quaternion(x.orientation), q_BF)
        z = rotation_vector(
            quaternion_product(seen, conjugate(quaternion(x.foot_orientation[foot])))
        )
        noise = _diagonal(x, foot, FOOT_ORIENTATION, own * lasting, sensed)
        noise[2, 2] += held * trusted(x, foot, FOOT_ORIENTATION, 2) * own * lasting
        update(
            P, correction, rotate(R_FW, z), start + 3, R_FW, ATTITUDE, opposite, noise,
            keep, agreement[FOOT_ORIENTATION], innovation[FOOT_ORIENTATION], explained,
        )  # fmt: skip
        _learn_motion(x, foot, FOOT_ORIENTATION, own, sensed, explained, elapsed)

    w_F, v_F = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for j in range(6, J.shape[1]):
        w_F = add(w_F, scale(model.velocity[j], (J[0, j], J[1, j], J[2, j])))
        v_F = add(v_F, scale(model.velocity[j], (J[3, j], J[4, j], J[5, j])))
    w_BF, v_BP = rotate(R_BF, w_F), rotate(R_BF, add(v_F, cross(w_F, pivot)))
    p_IP = add(p_IF, rotate(R_BF, pivot))
    w = subtract(w_raw, vector(x.gyro_bias_B))
    own = light * config.foot_velocity**2
    sensed = moving * rate + dot(p_IP, p_IP) * gyro
    z = rotate(R_FW, subtract(scale(-1.0, rotate(R, add(cross(w, p_IP), v_BP))), v))
    of_bias = matrix_product(R_FW, matrix_product(R, skew(p_IP)))
    noise = _diagonal(x, foot, FOOT_VELOCITY, own * lasting, sensed)
    update(
        P, correction, z, VELOCITY, R_FW, GYRO_BIAS, of_bias, noise, keep,
        agreement[FOOT_VELOCITY], innovation[FOOT_VELOCITY], explained,
    )  # fmt: skip
    _learn_motion(x, foot, FOOT_VELOCITY, own, sensed, explained, elapsed)
    possible = min(max(1.0, x.foot_habit[foot, FOOT_VELOCITY].mean()), _LARGEST_HABIT) * own
    for i in range(3):
        possible += P[VELOCITY + i, VELOCITY + i] / 3.0
    mean = vector(agreement[FOOT_VELOCITY])
    moves = dot(mean, mean) > GATE * possible
    # Soft ground gives way along the sole's normal.
    along = (mean[0], mean[1], 0.0)
    slides = max(0.0, dot(along, along) - SLIDES**2 * own)
    sliding = rotate(rotation_matrix(quaternion(x.foot_orientation[foot])), along)

    if is_flat:
        own, sensed = light * config.foot_rate**2, turning * rate + gyro
        z = rotate_back(R_BF, add(w, w_BF))
        noise = _diagonal(x, foot, FOOT_RATE, own * lasting, sensed)
        noise[2, 2] += held * trusted(x, foot, FOOT_RATE, 2) * own * lasting
        update(
            P, correction, z, GYRO_BIAS, transposed(R_BF), GYRO_BIAS, NONE, noise, keep,
            agreement[FOOT_RATE], innovation[FOOT_RATE], explained,
        )  # fmt: skip
        _learn_motion(x, foot, FOOT_RATE, own, sensed, explained, elapsed)
    if is_flat and config.level_ground > 0.0:
        # The turn that makes the sole's normal vertical; of a turn about it nothing is said.
        n = rotate(rotation_matrix(quaternion(x.foot_orientation[foot])), (0.0, 0.0, 1.0))
        lasts = max(config.foot_time, x.foot_stood[foot])
        noise = isotropic(config.level_ground**2 * max(1.0, 2.0 * lasts / elapsed) * light)
        noise[2, 2] += 1e6
        spare = np.zeros(3)
        z = cross(n, (0.0, 0.0, 1.0))
        update(
            P, correction, z, start + 3, IDENTITY, ATTITUDE, NONE, noise, 0.0, spare,
            spare.copy(), np.empty((2, 3)),
        )  # fmt: skip
    return moves, slides, sliding


@njit(cache=True)
def _learn_motion(
    x: Record,
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
        explained: see `update`.
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
        habit[i] = max(LEAST_HABIT, habit[i] * (1.0 + slow * (shown - 1.0)))
