"""The IMU's biases hardly walk: what they can be by what was known of them before."""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.invariant_error import ACCELEROMETER_BIAS, GYRO_BIAS, correct
from fbse_drake.estimators.records import Record
from fbse_drake.estimators.spatial import put, vector

# Biases of the IMU of at least so long ago [s] are taken back when a sensor is not trusted.
_MEMORY = 0.1
# Their variance is then at least this share of what it was: while they were being found out, most
# of that came from sensors that were about to fail.
_STILL_UNKNOWN = 0.25
# They stay within so many standard deviations of what was known of them so long ago [s]: they
# hardly walk, and a sensor that drifts faster is at fault. What a filter finds out moves its
# estimate by a variance as large as what it takes from its own; and at least by so many random
# walks.
_LEASH, _LEASH_TIME, _LEAST_WALKS = 2.0, 1.0, 20.0
# Where the biases of gyro and accelerometer begin in the error state.
_BIASES = GYRO_BIAS, ACCELEROMETER_BIAS


@njit(cache=True)
def leash_biases(x: Record, first: bool, elapsed: float, config: Record) -> None:
    """Keeps the IMU's biases where they can be by what was known of them."""
    leash, P = x.leash, x.error_covariance
    x.leashed_for = 0.0 if first else x.leashed_for + elapsed
    if first or x.leashed_for > _LEASH_TIME:
        x.leashed_for = 0.0
        _copy_rows(leash[0], leash[1])
        _put_biases(leash[1], x)
        for i in range(3):
            for sensor in range(2):
                walk = config.gyro_walk if sensor == 0 else config.accelerometer_walk
                leash[1, 2 + sensor, i] += (_LEAST_WALKS * walk) ** 2 * _LEASH_TIME
        if first:
            _copy_rows(leash[0], leash[1])
    for sensor in range(2):
        bias = x.gyro_bias_B if sensor == 0 else x.accelerometer_bias_B
        for i in range(3):
            at = _BIASES[sensor] + i
            middle, learned = leash[0, sensor, i], max(0.0, leash[0, 2 + sensor, i] - P[at, at])
            reach = _LEASH * math.sqrt(learned)
            _set_bias(x, sensor, i, min(max(bias[i], middle - reach), middle + reach))


@njit(cache=True)
def unleash_biases(x: Record) -> None:
    """Of the IMU's biases nothing is known any more but by their covariance."""
    P, leash = x.error_covariance, x.leash
    for sensor in range(2):
        for i in range(3):
            at = _BIASES[sensor] + i
            leash[0, 2 + sensor, i] = leash[1, 2 + sensor, i] = P[at, at]


@njit(cache=True)
def _set_bias(x: Record, sensor: int, axis: int, value: float) -> None:
    """Sets a bias of the gyro (0) or the accelerometer (1), and moves with it what is known by it.

    What the filter took for a bias it also took for a tilt.
    """
    at = _BIASES[sensor] + axis
    bias = x.gyro_bias_B if sensor == 0 else x.accelerometer_bias_B
    P, change = x.error_covariance, value - bias[axis]
    if change != 0.0 and P[at, at] > 0.0:
        correct(x, P[at] * (change / P[at, at]))


@njit(cache=True)
def _copy_rows(to: np.ndarray, source: np.ndarray) -> None:
    """Fills a matrix. (numba takes ten times as long to compile `to[:] = source`.)"""
    for i in range(to.shape[0]):
        for j in range(to.shape[1]):
            to[i, j] = source[i, j]


@njit(cache=True)
def _put_biases(to: np.ndarray, x: Record) -> None:
    """Fills (4, 3) with the biases of gyro and accelerometer in base axes, and their variances."""
    put(to[0], vector(x.gyro_bias_B))
    put(to[1], vector(x.accelerometer_bias_B))
    for sensor in range(2):
        for i in range(3):
            at = _BIASES[sensor] + i
            to[2 + sensor, i] = x.error_covariance[at, at]


@njit(cache=True)
def remember_biases(x: Record, is_doubtful: bool, first: bool, elapsed: float) -> None:
    """While sensors are doubtful the IMU's biases are those from before they began to fail, and
    hardly better known."""
    kept, P = x.kept_biases, x.error_covariance
    if first:
        _put_biases(kept[0], x)
        _put_biases(kept[1], x)
        x.kept_for = 0.0
    elif is_doubtful:
        _copy_rows(kept[1], kept[0])
        for sensor in range(2):
            for axis in range(3):
                _set_bias(x, sensor, axis, kept[0, sensor, axis])
                at = _BIASES[sensor] + axis
                P[at, at] = max(P[at, at], _STILL_UNKNOWN * kept[0, 2 + sensor, axis])
        x.kept_for = 0.0
    else:
        x.kept_for += elapsed
        if x.kept_for > _MEMORY:
            _copy_rows(kept[0], kept[1])
            _put_biases(kept[1], x)
            x.kept_for = 0.0
