"""Do IMU, joints and feet contradict each other, and whom is to be doubted?"""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.force_delay import room_for_delays
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock
from fbse_drake.estimators.spatial import (
    Vector,
    add,
    norm,
    put,
    rotate,
    rotation,
    scale,
    subtract,
    vector,
)
from fbse_drake.estimators.standing_foot import FIRM_SHARE, centre_of_pressure

# Over which times accelerations are compared [s], and after how long without contradiction the
# sensors are believed again.
_BRIEF, _LONG, _AGREED = 0.01, 0.05, 0.02
# By how much accelerometer, joints and foot forces may contradict each other: sensors that are 6 %
# off in a robot at rest [m/s^2], and the share of what changes over `_BRIEF` that 3 ms make; and
# how many standard deviations of what they always do.
_CONTRADICTION, _TIMING, _HABIT_DOUBT = 0.6, 0.3, 3.0
# What they always do is an acceleration and a share of what each foot carries. How large these are
# at first, and how they wander: [m/s^2], [m/s^2/sqrt(s)]; [1], [1/sqrt(s)].
_HABIT, _HABIT_WALK, _GAIN, _GAIN_WALK = 1.0, 0.01, 0.1, 0.01
# What else they usually contradict each other by [m/s^2], and for how long it lasts [s].
_USUAL, _USUAL_TIME = 0.2, 0.05
# The fastest that a foot rolls that stands firmly [rad/s].
_ROLLING = 0.4
# A foot rolls over an edge of its sole, where its load is then: beyond this share of the way there
# from the middle.
_NEAR_EDGE = 0.9
# A gyro that changes by so much in a tick, and a standing foot says it does not, is doubted until
# that foot rests again [rad/s], or for so long [s].
_RATE_STEP, _RESTING, _PATIENCE = 0.05, 0.05, 2.0
# A reading counts at most as much [m/s^2], so that it is soon forgotten.
_LARGEST_ACCELERATION = 50.0


def cross_check_type(feet: int, clock: Clock) -> np.dtype:
    """What `cross_check` remembers: `doubt` (1 + feet,) of the IMU and of each foot, and more."""
    return record_type(
        doubt=(1 + feet,),
        past=(room_for_delays(clock), 2, 3),
        newest=(),
        mean=(2, 3, 3),
        load=(2, feet, 3),
        rolling=(3,),
        habit=(3 + feet,),
        habit_covariance=(3 + feet, 3 + feet),
        habit_known=(),
        last_rate=(3,),
        last_rolling=(3,),
        was_firm=(),
        stepped=(),
        spread=(),
        age=(),
        agreed=(),
    )


@njit(cache=True)
def _clipped(a: Vector, limit: float) -> Vector:
    return (
        min(max(a[0], -limit), limit),
        min(max(a[1], -limit), limit),
        min(max(a[2], -limit), limit),
    )


@njit(cache=True)
def cross_check(
    x: np.ndarray,
    f_raw: Vector,
    relative: Vector,
    push: Vector,
    load: np.ndarray,
    rests: bool,
    rolling: Vector,
    rate: Vector,
    late: int,
    elapsed: float,
) -> None:
    """Compares IMU, joints and foot forces, and says whom to doubt.

    The accelerometer shows, with the joints' motion, how the centre of mass accelerates, and so do
    the foot forces. The gyro shows, with the joints' motion, that a standing foot rests. Where they
    contradict each other whoever changed more is doubted.

    Args:
        x: record of `cross_check_type`, filled.
        f_raw, relative, push: acceleration of the IMU, of the centre of mass relative to it, and
            by the foot forces, in base axes [m/s^2].
        load: the feet's forces by the robot's mass, (feet, 3) [m/s^2].
        rests: is there a foot that stands firmly?
        rolling: its angular velocity, else zero [rad/s].
        rate: the gyro's reading [rad/s].
        late: how many ticks ago the forces were what is read now.
    """
    limit, room = _LARGEST_ACCELERATION, len(x.past)
    newest = (int(x.newest) + 1) % room
    x.newest = newest
    put(x.past[newest, 0], f_raw)
    put(x.past[newest, 1], relative)
    if x.age == 0.0:
        for tick in range(room):
            x.past[tick] = x.past[newest]
    then = x.past[(newest - min(late, room - 1)) % room]
    a, b = _clipped(vector(then[0]), limit), _clipped(vector(then[1]), limit)
    c = _clipped(push, limit)
    if x.age == 0.0:
        for span in range(2):
            put(x.mean[span, 0], a)
            put(x.mean[span, 1], (0.0, 0.0, 0.0))
            put(x.mean[span, 2], c)
            for foot in range(len(load)):
                put(x.load[span, foot], _clipped(vector(load[foot]), limit))
        x.spread, x.rolling[:], x.doubt[:], x.agreed = 0.0, 0.0, 0.0, 0.0
        x.was_firm = x.stepped = 0.0
    brief, long = 1.0 - math.exp(-elapsed / _BRIEF), 1.0 - math.exp(-elapsed / _LONG)
    x.age += elapsed
    changes = 0.0
    for i in range(3):
        changes += min((a[i] - x.mean[0, 0, i]) ** 2 + (c[i] - x.mean[0, 2, i]) ** 2, 400.0)
    x.spread += brief * (changes - x.spread)
    for span in range(2):
        gain = brief if span == 0 else long
        for i in range(3):
            x.mean[span, 0, i] += gain * (a[i] - x.mean[span, 0, i])
            x.mean[span, 1, i] += gain * (b[i] - x.mean[span, 1, i])
            x.mean[span, 2, i] += gain * (c[i] - x.mean[span, 2, i])
            for foot in range(len(load)):
                reading = min(max(load[foot, i], -limit), limit)
                x.load[span, foot, i] += gain * (reading - x.load[span, foot, i])
    for i in range(3):
        x.rolling[i] += brief * (min(max(rolling[i], -10.0), 10.0) - x.rolling[i])
    turned = norm(subtract(rate, vector(x.last_rate)))
    rolled = norm(subtract(rolling, vector(x.last_rolling)))
    if rests and x.was_firm > 0 and min(turned, rolled) > _RATE_STEP and x.stepped == 0:
        x.doubt[:], x.doubt[0], x.stepped = 0.0, 1.0, elapsed
    elif x.stepped > 0:
        x.stepped += elapsed
    x.was_firm = 1.0 if rests else 0.0
    put(x.last_rate, rate)
    put(x.last_rolling, rolling)
    beyond_habit = norm(_unusual(x, 0)) - _HABIT_DOUBT * _habit_deviation(x)
    excess = beyond_habit - _TIMING * math.sqrt(x.spread)
    is_late = 0.0 < x.stepped < _PATIENCE
    turns = norm(vector(x.rolling)) > (_RESTING if is_late else _ROLLING)
    turns = turns or (is_late and not rests)
    if x.age < _LONG:
        return
    if not turns and excess < _CONTRADICTION:
        x.agreed += elapsed
    else:
        x.agreed = 0.0
        if x.doubt.max() == 0:
            _blame(x, turns)
    if x.agreed > _AGREED:
        x.doubt[:], x.stepped = 0.0, 0.0
    # Neither who is doubted nor an impact or a spike is a habit.
    _learn_habit(x, x.doubt.max() == 0 and beyond_habit < _CONTRADICTION, elapsed)
    if _HABIT_DOUBT * _habit_deviation(x) < _CONTRADICTION:
        x.habit_known = 1.0


@njit(cache=True)
def _unusual(x: np.ndarray, span: int) -> Vector:
    """What contradicts that does not always [m/s^2].

    Args:
        span: 0 for the last `_BRIEF`, 1 for the last `_LONG`.
    """
    return (_unusual_along(x, span, 0), _unusual_along(x, span, 1), _unusual_along(x, span, 2))


@njit(cache=True)
def _unusual_along(x: np.ndarray, span: int, i: int) -> float:
    """The same along an axis of the base."""
    return _contradiction_along(x, span, i) - _habit_row(x, span, i) @ x.habit


@njit(cache=True)
def _contradiction_along(x: np.ndarray, span: int, i: int) -> float:
    """What accelerometer, joints and feet contradict each other by there [m/s^2]."""
    return x.mean[span, 0, i] + x.mean[span, 1, i] - x.mean[span, 2, i]


@njit(cache=True)
def _habit_deviation(x: np.ndarray) -> float:
    """Standard deviation of what always contradicts [m/s^2], by what the feet carry in the long
    run: a spike is no reason to doubt the habit."""
    variance = 0.0
    for i in range(3):
        h = _habit_row(x, 1, i)
        variance += h @ x.habit_covariance @ h
    return math.sqrt(max(variance, 0.0))


@njit(cache=True)
def _habit_row(x: np.ndarray, span: int, i: int) -> np.ndarray:
    """How what contradicts along an axis depends on the habit."""
    h = np.zeros(len(x.habit))
    h[i] = 1.0
    h[3:] = x.load[span, :, i]
    return h


@njit(cache=True)
def _learn_habit(x: np.ndarray, learns: bool, elapsed: float) -> None:
    """A Kalman filter of what sensors always contradict each other by; where it may not learn, it
    only forgets."""
    P = x.habit_covariance
    for i in range(len(P)):
        deviation, walk = (_HABIT, _HABIT_WALK) if i < 3 else (_GAIN, _GAIN_WALK)
        P[i, i] = deviation**2 if P[i, i] == 0.0 else P[i, i] + walk**2 * elapsed
    if not learns:
        return
    noise = _USUAL**2 * max(1.0, 2.0 * _USUAL_TIME / elapsed)
    for i in range(3):
        h = _habit_row(x, 0, i)
        shared = P @ h
        gain = shared / (h @ shared + noise)
        x.habit[:] += gain * (_contradiction_along(x, 0, i) - h @ x.habit)
        P -= np.outer(gain, shared)


@njit(cache=True)
def force_contradiction(x: np.ndarray, largest: Vector) -> float:
    """By how much foot forces and joints have contradicted the accelerometer of late [m/s^2].

    What they always do does not count, and less than what the forces may be wrong by is none, nor
    is what may be a habit that is still being learned.

    Args:
        x: record of `cross_check_type`.
        largest: what they may be wrong by, along each axis of the base [m/s^2].
    """
    if x.age < _LONG:
        return 0.0
    z = _unusual(x, 1)
    room = 0.0 if x.habit_known > 0 else _HABIT_DOUBT * _habit_deviation(x)
    for i in range(3):
        if abs(z[i]) > largest[i] + room:
            return norm(z)
    return 0.0


@njit(cache=True)
def _blame(x: np.ndarray, turns: bool) -> None:
    """Sets who is doubted: the IMU, or the feet whose forces changed most."""
    change = np.zeros(4)
    for k in range(3):
        change[k] = norm(subtract(vector(x.mean[0, k]), vector(x.mean[1, k])))
    if turns or change[0] + change[1] > change[2]:
        x.doubt[0] = 1.0
        return
    feet, largest = len(x.doubt) - 1, 0.0
    for foot in range(feet):
        moved = norm(subtract(vector(x.load[0, foot]), vector(x.load[1, foot])))
        x.doubt[1 + foot] = moved
        largest = max(largest, moved)
    for foot in range(feet):
        x.doubt[1 + foot] = 1.0 if x.doubt[1 + foot] >= 0.5 * largest else 0.0


@njit(cache=True)
def firm_foot_rate(
    stands: np.ndarray,
    wrench: np.ndarray,
    soles: np.ndarray,
    weight: float,
    w: Vector,
    model: np.ndarray,
) -> tuple[bool, Vector]:
    """Angular velocity of the standing foot that carries most, in base axes [rad/s].

    Args:
        wrench: [moment, force] on each foot at the sole's origin in the sole frame, (feet, 6).
        soles: least and largest x and y of each sole, (feet, 2, 2) [m].

    Returns:
        Does it carry enough, and not on an edge, to stand firmly? If not, the velocity is zero.
    """
    best = -1
    for foot in range(len(stands)):
        if stands[foot] > 0 and (best < 0 or wrench[foot, 5] > wrench[best, 5]):
            best = foot
    if best < 0 or wrench[best, 5] < FIRM_SHARE * weight:
        return False, (0.0, 0.0, 0.0)
    centre = centre_of_pressure(wrench[best], soles[best])
    for i in range(2):
        least, largest = soles[best, 0, i], soles[best, 1, i]
        if abs(centre[i] - 0.5 * (least + largest)) > _NEAR_EDGE * 0.5 * (largest - least):
            return False, (0.0, 0.0, 0.0)
    J, w_F = model.foot_jacobian[best], (0.0, 0.0, 0.0)
    for j in range(6, J.shape[1]):
        w_F = add(w_F, scale(model.velocity[j], (J[0, j], J[1, j], J[2, j])))
    return True, add(w, rotate(rotation(model.foot_rotation[best]), w_F))
