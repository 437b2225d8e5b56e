"""By how much gyro and accelerometer are noisier than believed, by second differences of what they
read: motion hardly bends within two ticks, noise does."""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.innovations import LOG_OF_THREE, learned_noise
from fbse_drake.estimators.records import Record, record_type
from fbse_drake.estimators.spatial import Vector, dot, put, subtract, vector


def imu_noise_type() -> np.dtype:
    """What `watch_noise` remembers of a sensor: by what the variance of its `noise` is larger than
    believed, at least 1; its last `reading` (3,); and the last `change` of that, (3,)."""
    return record_type(noise=(), reading=(3,), change=(3,))


@njit(cache=True)
def watch_noise(x: Record, reading: Vector, believed: float, elapsed: float) -> None:
    """Learns from a tick's reading.

    Args:
        x: record of `imu_noise_type`, of the tick before.
        believed: standard deviation of each of the three numbers that are read.
        elapsed: of the tick [s]; NaN of the first.
    """
    if math.isnan(elapsed):
        x.noise = 1.0
        put(x.reading, reading)
        return
    change = subtract(reading, vector(x.reading))
    bend = subtract(change, vector(x.change))
    share = dot(bend, bend) / (18.0 * x.noise * believed**2)
    x.noise = learned_noise(x.noise, share, LOG_OF_THREE, elapsed)
    put(x.reading, reading)
    put(x.change, change)
