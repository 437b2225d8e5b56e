"""The foot forces tell how the centre of mass accelerates."""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.innovations import LARGEST_SHARE, LEAST_HABIT, LOG_OF_ONE, SMALLEST_SHARE
from fbse_drake.estimators.invariant_error import (
    ACCELEROMETER_BIAS,
    GYRO_BIAS,
    IDENTITY,
    NONE,
    update,
)
from fbse_drake.estimators.records import Record
from fbse_drake.estimators.spatial import Vector, add, cross, dot, scale, subtract, vector

# Beyond so many standard deviations of what forces are wrong by, they contradict the accelerometer.
_CONTRADICTION = 3.0
# For how long forces must have erred less than believed to be trusted more [s].
_FORCE_HABIT_TIME = 3.0


@njit(cache=True)
def force_errors(f_raw: Vector, config: Record) -> Vector:
    """What the mean acceleration by the foot forces is hardly ever wrong by [m/s^2]."""
    any_way, gain = config.force_error**2, config.force_gain_error**2
    return (
        _CONTRADICTION * math.sqrt(any_way + gain * f_raw[0] ** 2),
        _CONTRADICTION * math.sqrt(any_way + gain * f_raw[1] ** 2),
        _CONTRADICTION * math.sqrt(any_way + gain * f_raw[2] ** 2),
    )


@njit(cache=True)
def listen_to_forces(
    x: Record,
    P: np.ndarray,
    correction: np.ndarray,
    force: Vector,
    f_raw: Vector,
    w: Vector,
    away: Vector,
    away_before: Vector,
    model: Record,
    elapsed: float,
    known: Record,
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
    sensed = _acceleration_noise(x, model, elapsed, known)
    own, noise, once = np.empty(3), np.zeros((3, 3)), np.empty(3)
    explained = np.empty((2, 3))
    for i in range(3):
        for j in range(3):
            noise[i, j] = config.force_gain_error**2 * lasting * f_raw[i] * f_raw[j]
        own[i] = x.force_habit[i] * config.force_error**2
        once[i] = own[i] + noise[i, i] / lasting + sensed[i]
        noise[i, i] += own[i] * lasting + sensed[i]
    update(
        P, correction, z, ACCELEROMETER_BIAS, IDENTITY, GYRO_BIAS, NONE, noise,
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
        gained, at = (config.force_gain_error * f_raw[i]) ** 2, ACCELEROMETER_BIAS + i
        by_habit = 0.5 * (own[i] + gained) + P[at, at]
        shown = max(SMALLEST_SHARE, (x.force_agreement[i] / filled) ** 2 / by_habit)
        told = math.log(min(shown, LARGEST_SHARE)) - LOG_OF_ONE
        learned = x.force_habit[i] * math.exp(gain * own[i] / (own[i] + gained) * told)
        x.force_habit[i] = min(1.0, max(LEAST_HABIT, learned))


@njit(cache=True)
def _acceleration_noise(x: Record, model: Record, elapsed: float, known: Record) -> np.ndarray:
    """Variance of what the sensors' noise adds to the acceleration of the centre of mass by them,
    less that by the foot forces, (3,)."""
    sensors = known.sensors
    rate = 2.0 * (sensors.joint_velocity_noise / elapsed) ** 2
    turning = 2.0 * x.gyro.noise * (sensors.angular_velocity_noise / elapsed) ** 2
    arm = subtract(vector(model.com), vector(known.mount.p_BI))
    variance = np.empty(3)
    for i in range(3):
        moved = 0.0
        for joint in range(len(model.mass_matrix)):
            moved += (model.mass_matrix[joint, 3 + i] / known.mass) ** 2
        turned = dot(arm, arm) - arm[i] ** 2
        variance[i] = rate * moved + turning * turned
        variance[i] += x.accelerometer.noise * sensors.acceleration_noise**2
        variance[i] += known.force_variance / known.mass**2
    return variance
