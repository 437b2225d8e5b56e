"""When standing feet contradict the velocity: do they move, or is it wrong, and why?

Of the posterior of `InvariantBaseFilter` it keeps `lost_*`, `sliding*` and `slides_by`.
"""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.bias_limits import unleash_biases
from fbse_drake.estimators.invariant_error import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    GYRO_BIAS,
    POSITION,
    VELOCITY,
    add_noise,
)
from fbse_drake.estimators.records import Record
from fbse_drake.estimators.spatial import GRAVITY, Vector, add, dot, put, scale, vector
from fbse_drake.estimators.standing_foot import SLIDES, land

# When all feet that stand have contradicted the velocity for so long [s], it is not they that slip.
_AFTER = 0.25
# When that happens again within this time [s], and still after this time [s], it is the IMU's
# biases: a fault that lasts for a second is over by then.
_AGAIN, _LONG = 3.0, 0.75
# When all feet that stand firmly slide, for how long they do so until the velocity is as uncertain
# as they are fast [s]; and the tilt that makes such a velocity in half a second [rad s/m].
_SLIDING_TIME = 0.1
TILT_BY_VELOCITY = 1.0 / (GRAVITY * 0.5)
# It is they that slip, and not the velocity that is wrong, unless they slide for more than this
# share of about this time [s].
_SLIDING_SHARE, _SLIDING_MEMORY = 0.25, 1.0
# Feet slide one way all the time if that share of their mean square velocity is its mean's.
_ONE_WAY = 0.6


@njit(cache=True)
def doubt_velocity(
    x: Record,
    slides: float,
    sliding: Vector,
    elapsed: float,
    model: Record,
    known: Record,
) -> None:
    """Feet that keep sliding by the robot's velocity show that it is wrong; if they do so one way
    all the time, that is the IMU's biases.

    The tilt that may make it is only stated: the foot forces that would correct it err by more
    than that in real robots.

    Args:
        slides: square of how fast all of them slide that carry the robot [m^2/s^2].
        sliding: velocity of the slowest of them [m/s].
    """
    recent = 1.0 - math.exp(-elapsed / _SLIDING_MEMORY)
    x.sliding_share += recent * ((1.0 if slides > 0.0 else 0.0) - x.sliding_share)
    put(x.sliding, add(scale(1.0 - recent, vector(x.sliding)), scale(recent, sliding)))
    x.sliding_square += recent * (dot(sliding, sliding) - x.sliding_square)
    steady, least = dot(vector(x.sliding), vector(x.sliding)), SLIDES * known.config.foot_velocity
    if steady > max(least**2, _ONE_WAY * x.sliding_square):
        _forget_state(x, model, known)
        _forget_biases(x, known)
    if x.sliding_share > _SLIDING_SHARE:
        x.slides_by = math.sqrt(slides)
        add_noise(x.error_covariance, VELOCITY, slides * elapsed / _SLIDING_TIME)


@njit(cache=True)
def never_lost(x: Record) -> None:
    """As it is at the start."""
    x.lost_ago = 2.0 * _AGAIN


@njit(cache=True)
def watch_for_losses(
    x: Record, imu_is_wrong: bool, elapsed: float, model: Record, known: Record
) -> None:
    """A filter whose velocity all standing feet contradict for too long starts over, and without
    the IMU's biases if that goes on happening.

    Args:
        imu_is_wrong: it is found to be implausible: then it was so before, and no foot slips.
    """
    x.lost_ago += elapsed
    x.lost_since += elapsed
    if not (x.lost_for > _AFTER or (x.lost_for > 0.0 and imu_is_wrong)):
        return
    _forget_state(x, model, known)
    if x.lost_ago > _AGAIN:
        x.lost_since = 0.0
    if x.lost_since > _LONG:
        _forget_biases(x, known)
    x.lost_for, x.lost_ago = 0.0, 0.0


@njit(cache=True)
def _forget_state(x: Record, model: Record, known: Record) -> None:
    """Attitude, velocity and place are no better known than at the start; all feet that stand are
    put down anew."""
    P, spare = x.error_covariance, np.zeros(len(x.error_covariance))
    add_noise(P, ATTITUDE, known.start.tilt**2)
    add_noise(P, VELOCITY, known.start.velocity**2)
    add_noise(P, POSITION, (known.start.velocity * _AFTER) ** 2)
    for foot in range(len(x.foot_standing)):
        if x.foot_standing[foot] > 0:
            land(x, P, spare, foot, model, known)
    x.sliding_share = 0.0
    forget_sliding(x)


@njit(cache=True)
def forget_sliding(x: Record) -> None:
    """Which way feet slide while a sensor is doubted, or before a start, shows nothing."""
    x.sliding[:] = 0.0
    x.sliding_square = 0.0


@njit(cache=True)
def _forget_biases(x: Record, known: Record) -> None:
    """The IMU's biases are no better known than at the start."""
    P = x.error_covariance
    add_noise(P, GYRO_BIAS, known.sensors.angular_velocity_bias**2)
    add_noise(P, ACCELEROMETER_BIAS, known.sensors.acceleration_bias**2)
    unleash_biases(x)
