"""How late foot forces come: the acceleration that they make shows in the other sensors as well.

Delays are compared by cumulative sums of their log likelihoods after E. S. Page, "Continuous
inspection schemes", Biometrika 41, 1954.
"""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, Past, ticks_ago
from fbse_drake.estimators.spatial import Vector, add, dot, put, scale, subtract, vector

# The longest delay that is looked for, and for how long it counts what gain and bias the forces
# had, and how noisy they were [s].
_LONGEST, _MEMORY = 0.03, 0.3
# Slower clocks keep as many ticks as one of this period [s] does: compiled functions are made for
# the size of what they remember, and one for every rate would take half a minute each to compile.
_FASTEST_USUAL_PERIOD = 0.0005
# How much of that time it takes to know the noise.
_LEAST = 0.5
# By how much of itself a tick may be longer or shorter for its velocities' difference to be an
# acceleration that is worth comparing, and for its number to be a time.
_UNEVEN = 0.01
# Time constant by which readings are smoothed before they are compared [s].
_SMOOTHING = 0.005
# How much of the way in which forces change the other sensors must explain to tell their delay.
_EXPLAINED = 0.9
# The logarithm of how likely a delay is at least (one in a thousand), for it may begin at any time;
# and of how likely one is in whose place another has shown (one in a hundred thousand).
_LEAST_LIKELY, _LEAST_USUAL = -math.log(1.0e3), -math.log(1.0e5)
# How much likelier than any other a delay must be by what is counted to be one that shows, as the
# logarithm of the ratio, and for how long it counts what has shown [s].
_SHOWN, _USUAL_TIME = 3.0, 2.0
# What speaks for another delay than the usual one is forgotten so fast [s]; when no more than this
# is left of it, as such a logarithm, the usual one is taken again.
_FORGOTTEN, _NOTHING_LEFT = 0.1, 1.0


def force_delay_type(clock: Clock) -> np.dtype:
    """What `watch_force_delay` remembers, of delays of 0, 1, ... ticks.

    `smooth` (2, 3), smoothed readings of how the centre of mass accelerates, by the other sensors
    and by the forces; `shown` and `read` (room, 3), the same so many ticks ago [m/s^2]; `filled`,
    how many of these are known; sums over the last time, of `shown`, `total` (room, 3), of its
    `square` and of its product `cross` with the forces, (room,), and of the forces,
    `push_total` (3,) and `push_square` [m^2/s^4]; `count`, over how many ticks; `likelihood`
    (2, room) of each delay, as the logarithm of its ratio to the largest, by the latest forces and
    by the earliest acceleration; `usual` (room,), for how long each delay has shown [s]; and the
    `delay` [s]. Of `room_for_delays` the first `delays_of` the clock are used.
    """
    room = room_for_delays(clock)
    shapes = {"shown": (room, 3), "read": (room, 3), "total": (room, 3)}
    shapes |= {"square": (room,), "cross": (room,), "usual": (room,)}
    shapes |= {"likelihood": (2, room)}
    numbers = ("push_square", "filled", "count", "delay")
    return record_type(**shapes, smooth=(2, 3), push_total=(3,), **dict.fromkeys(numbers, ()))


def delays_of(clock: Clock) -> int:
    """How many delays there are, from none to the longest."""
    return delays_of_period(clock.period)


def room_for_delays(clock: Clock) -> int:
    """How many ticks are remembered: the delays of the clock, and no fewer than at 0.5 ms."""
    return max(delays_of_period(clock.period), delays_of_period(_FASTEST_USUAL_PERIOD))


@njit(cache=True)
def delays_of_period(period: float) -> int:
    """See `delays_of`."""
    return 1 + math.floor(_LONGEST / period + 1e-6)


def remembered_ticks(clock: Clock) -> int:
    """How many ticks before the present one are remembered, at least one."""
    return max(1, delays_of(clock) - 1)


@njit(cache=True)
def tick_of(elapsed: float, past: Past, delay: float) -> int:
    """How many ticks ago one ended that ended so long ago [s].

    The nearest of those that are remembered; the present one if the delay is no number.

    Args:
        elapsed: how long the present tick took [s].
        past: what is remembered of the ticks before, with their `duration` [s].
    """
    age, best, nearest = elapsed, 0, abs(delay)
    for tick in range(1, len(past.of_tick) + 1):
        if abs(age - delay) <= nearest:
            best, nearest = tick, abs(age - delay)
        age += ticks_ago(past, tick).duration
    return best


@njit(cache=True)
def forget_force_delay(x: np.ndarray) -> None:
    """A tick that cannot be compared, by whose sensors the ones before may be spoilt as well.

    The delay that has been found stays.
    """
    x.total[:], x.square[:], x.cross[:], x.push_total[:] = 0.0, 0.0, 0.0, 0.0
    x.push_square = x.filled = x.count = 0.0


@njit(cache=True)
def is_uneven(elapsed: float, period: float) -> bool:
    """Is a tick too long or too short to compare what was read in ticks before it [s]?"""
    return abs(elapsed - period) > _UNEVEN * period


@njit(cache=True)
def take_force_delay(x: np.ndarray, delay: float) -> None:
    """Has a delay [s], as it was found otherwise; none has shown before."""
    forget_force_delay(x)
    x.usual[:], x.delay = 0.0, delay


@njit(cache=True)
def watch_force_delay(
    x: np.ndarray,
    acceleration: Vector,
    push: Vector,
    noise: float,
    elapsed: float,
    period: float,
) -> None:
    """One tick: the delay is that of the sensors by which the forces are explained best.

    A delay that comes, as with a fault of the sensors, may go again, while nothing happens that
    shows it: another one than the usual must show again and again.

    What explains them is a gain times how the centre of mass accelerated, and a constant: a gain or
    a bias that is wrong, or the robot's mass, does not count. Where forces hardly change all delays
    are alike, and it stays what it is. So it does on a clock that is not even.

    Args:
        x: record of `force_delay_type`, of the tick before; filled.
        acceleration, push: specific force of the centre of mass by IMU and joints, and by the
            forces [m/s^2].
        noise: of the accelerometer, that no difference is below [m/s^2].
        elapsed, period: of this tick, and of one that is neither early nor late [s].
    """
    if is_uneven(elapsed, period):
        forget_force_delay(x)
        return
    if x.filled == 0:
        _begin_with(x.likelihood, round(x.delay / period))
    # Accelerations are differences of velocities, whose noise averages out fast.
    blend = 1.0 - math.exp(-elapsed / _SMOOTHING) if x.filled > 0 else 1.0
    for i in range(3):
        x.smooth[0, i] += blend * (acceleration[i] - x.smooth[0, i])
        x.smooth[1, i] += blend * (push[i] - x.smooth[1, i])
    acceleration, push = vector(x.smooth[0]), vector(x.smooth[1])
    delays = delays_of_period(period)
    for age in range(delays - 1, 0, -1):
        x.shown[age], x.read[age] = x.shown[age - 1], x.read[age - 1]
    put(x.shown[0], acceleration)
    put(x.read[0], push)
    x.filled = min(x.filled + 1.0, float(delays))
    if x.filled < delays:
        return
    keep = math.exp(-elapsed / _MEMORY)
    x.count = keep * x.count + 1.0
    x.push_square = keep * x.push_square + dot(push, push)
    put(x.push_total, add(scale(keep, vector(x.push_total)), push))
    middle = scale(1.0 / x.count, vector(x.push_total))
    push_square = x.push_square - dot(vector(x.push_total), middle)
    gain, mismatch = np.empty(delays), np.empty(delays)
    # Squares of what the latest forces that are read are off by, and of what those are that answer
    # to the earliest acceleration.
    off, last = np.empty((2, delays)), delays - 1
    for late in range(delays):
        shown = vector(x.shown[late])
        x.square[late] = keep * x.square[late] + dot(shown, shown)
        x.cross[late] = keep * x.cross[late] + dot(shown, push)
        put(x.total[late], add(scale(keep, vector(x.total[late])), shown))
        total = vector(x.total[late])
        square = x.square[late] - dot(total, total) / x.count
        cross = max(0.0, x.cross[late] - dot(total, middle))
        gain[late] = cross / max(square, 1e-9)
        mismatch[late] = push_square - gain[late] * cross
        offset = subtract(middle, scale(gain[late] / x.count, total))
        off[0, late] = _square_off(push, gain[late], shown, offset)
        answer = vector(x.read[last - late])
        off[1, late] = _square_off(answer, gain[late], vector(x.shown[last]), offset)
    if x.count * elapsed < _LEAST * _MEMORY:
        return
    # What no delay explains is noise.
    variance = max(noise**2, mismatch.min() / (3.0 * x.count), off[0].min() / 3.0)
    # Of the smoothed readings so many are as good as one.
    alike = 1.0 + 2.0 * _SMOOTHING / period
    likelihood, now = x.likelihood[:, :delays], round(x.delay / period)
    doubled = 2.0 * variance * alike
    usual = _usual_delay(x.usual[:delays], mismatch, doubled, elapsed, now)
    least = _LEAST_USUAL if usual >= 0 and abs(now - usual) <= 1 else _LEAST_LIKELY
    for way in range(2):
        largest = -math.inf
        for late in range(delays):
            likelihood[way, late] -= off[way, late] / doubled
            largest = max(largest, likelihood[way, late])
        for late in range(delays):
            likelihood[way, late] = max(least, likelihood[way, late] - largest)
    best = 0
    for late in range(1, delays):
        if likelihood[0, late] + likelihood[1, late] > likelihood[0, best] + likelihood[1, best]:
            best = late
    # Noise that begins reaches the delays one after the other, in the one way in the opposite order
    # as in the other.
    is_likelier = likelihood[0, best] > likelihood[0, now]
    is_likelier = is_likelier and likelihood[1, best] > likelihood[1, now]
    if is_likelier and mismatch[best] < (1.0 - _EXPLAINED) * push_square:
        # At the longest delay the true one may be longer, and nobody knows it.
        x.delay = best * period if best < last else 0.0
        if usual >= 0 and abs(best - usual) > 1:
            _begin_with(likelihood, best)
    elif usual >= 0 and abs(now - usual) > 1:
        longest_lead = -math.inf
        for way in range(2):
            lead = likelihood[way, now] - likelihood[way, usual]
            likelihood[way, usual] += (1.0 - math.exp(-elapsed / _FORGOTTEN)) * lead
            longest_lead = max(longest_lead, lead)
        if longest_lead < _NOTHING_LEFT:
            x.delay = usual * period
            _begin_with(likelihood, usual)


@njit(cache=True)
def _begin_with(likelihood: np.ndarray, delay: int) -> None:
    """Of a delay that has just been taken all others are as unlikely as they may be."""
    likelihood[:] = _LEAST_LIKELY
    likelihood[:, delay] = 0.0


@njit(cache=True)
def _usual_delay(
    shown: np.ndarray, mismatch: np.ndarray, doubled: float, elapsed: float, now: int
) -> int:
    """The delay that has shown for the longest time, -1 if none has.

    Args:
        shown: for how long each has [s]; filled.
        mismatch, doubled: what each delay does not explain, and twice the variance that it has by
            noise: by what is counted, their ratio is minus the logarithm of its likelihood.
    """
    keep, shows = math.exp(-elapsed / _USUAL_TIME), True
    for other in range(len(mismatch)):
        shown[other] *= keep
        if abs(other - now) > 1 and mismatch[other] / doubled - mismatch[now] / doubled < _SHOWN:
            shows = False
    if shows:
        shown[now] += elapsed
    usual = np.argmax(shown)
    return usual if shown[usual] > 0.0 else -1


@njit(cache=True)
def _square_off(push: Vector, gain: float, shown: Vector, offset: Vector) -> float:
    """Square of how far forces are off a gain times an acceleration and an offset [m^2/s^4]."""
    off = subtract(push, add(scale(gain, shown), offset))
    return dot(off, off)
