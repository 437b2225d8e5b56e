"""How slow the foot sensors' low-pass is: forces that it smooths answer to the acceleration that
they make in another way than forces that only come late.

Of a first-order low-pass with time constant t the true force is the one that is read, plus t times
its rate. So the acceleration a that the other sensors show, d ticks before, and the push p of the
forces that are read obey g a(d) = p + t dp/dt + c, with a gain and a constant that are nobody's
business here. By IMU and joints there is much more noise than by the forces: a is regressed on p
and dp/dt, by least squares for every delay d, and what their own noise adds is taken off first
(W. A. Fuller, "Measurement Error Models", 1987).
"""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.force_delay import delays_of_period, is_uneven, room_for_delays
from fbse_drake.estimators.innovations import LOG_OF_THREE
from fbse_drake.estimators.records import Record, record_type
from fbse_drake.estimators.recursive import Clock
from fbse_drake.estimators.spatial import Vector, add, dot, put, scale, subtract, vector

# Time constant by which both sides are smoothed, how long what a start or a fault leaves takes to
# fade, for how long it counts what was measured, and by which time the forces' noise is learned
# [s].
_SMOOTHING, _SETTLED, _MEMORY, _NOISE_TIME = 0.005, 0.06, 1.0, 0.3
# How much of that time it takes to know the noise.
_LEAST = 0.15
# The shortest and the longest time constant that is told [s].
_SHORTEST, _LONGEST = 3e-4, 3e-2
# How many times as large as what noise adds the squares of the forces' rate must be: what is
# taken off for it is known to some percent only.
_CLEAR = 10.0
# How much of the way in which accelerations change forces must explain to tell their lag.
_EXPLAINED = 0.5
# How much likelier one of two hypotheses must be to be the one that shows, as the logarithm of the
# ratio. Where neither does, none has a lag if that is known to this [s].
_SHOWN, _SHARP = 3.0, 2e-4
# A sensor's low-pass does not come and go: for how long it counts what has shown [s], how long a
# lag must have shown to be taken [s], and how many times as long as none.
_USUAL_TIME, _SEEN, _LONGER = 10.0, 0.03, 2.0


def force_lag_type(clock: Clock) -> np.dtype:
    """What `watch_force_lag` remembers.

    `smooth` (2, 3), smoothed accelerations by the other sensors and by the forces; `shown`
    (room, 3), the former so many ticks ago [m/s^2]; `read` and `change` (3,), the latter, not
    smoothed, and their change; `noise`, logarithm of the variance of their noise; `ticks` since it
    began; sums over the last time, of `count` ticks: `total` (room, 3), `square`, `cross` and
    `rate_cross` (room,) of `shown`, of its square and its products with the forces and with their
    rate, and those of the latter two, `push_total`, `rate_total` (3,), `push_square`, `push_rate`
    and `rate_square`, of which what noise adds is taken off, of the last `spurious`; `lag_time` and
    `none_time`, for how long a lag, and that there is none, has shown [s]; the `time_constant` [s],
    0 without one, and the `delay` besides [ticks].
    """
    room = room_for_delays(clock)
    shapes: dict[str, tuple[int, ...]] = {"smooth": (2, 3)}
    shapes |= dict.fromkeys(("shown", "total"), (room, 3))
    shapes |= dict.fromkeys(("square", "cross", "rate_cross"), (room,))
    shapes |= dict.fromkeys(("push_total", "rate_total", "read", "change"), (3,))
    numbers = ["ticks", "count", "push_square", "push_rate", "rate_square", "noise", "spurious"]
    numbers += ["lag_time", "none_time", "time_constant", "delay"]
    return record_type(**shapes, **dict.fromkeys(numbers, ()))


@njit(cache=True)
def forget_force_lag(x: Record) -> None:
    """Begins anew; what has been found stays."""
    x.total[:], x.square[:], x.cross[:], x.rate_cross[:] = 0.0, 0.0, 0.0, 0.0
    x.push_total[:], x.rate_total[:] = 0.0, 0.0
    x.push_square = x.push_rate = x.rate_square = x.spurious = x.ticks = x.count = 0.0


@njit(cache=True)
def watch_force_lag(
    x: Record, acceleration: Vector, push: Vector, noise: float, elapsed: float, period: float
) -> bool:
    """One tick.

    Args:
        x: record of `force_lag_type`, of the tick before; filled.
        acceleration, push: specific force of the centre of mass by IMU and joints, and by the
            forces as they are read [m/s^2].
        noise: of the accelerometer [m/s^2].
        elapsed, period: of this tick, and of one that is neither early nor late [s].

    Returns:
        Has a lag been found, or given up?
    """
    if is_uneven(elapsed, period):
        forget_force_lag(x)
        return False
    delays, before = delays_of_period(period), vector(x.smooth[1])
    _learn_noise(x, push, elapsed)
    blend = 1.0 - math.exp(-elapsed / _SMOOTHING)
    of_first = blend if x.ticks > 0 else 1.0
    for i in range(3):
        x.smooth[0, i] += of_first * (acceleration[i] - x.smooth[0, i])
        x.smooth[1, i] += of_first * (push[i] - x.smooth[1, i])
    for age in range(delays - 1, 0, -1):
        x.shown[age] = x.shown[age - 1]
    x.shown[0] = x.smooth[0]
    x.ticks += 1.0
    if x.ticks * elapsed < _SETTLED or x.ticks < delays + 3:
        return False
    smooth = vector(x.smooth[1])
    rate = scale(1.0 / elapsed, subtract(smooth, before))
    # White noise behind a low-pass: its variance in all axes, its covariance with the noise of the
    # rate, and the variance of that.
    variance = 3.0 * math.exp(x.noise) * blend / (2.0 - blend)
    covariance = variance * blend / elapsed
    spurious = (variance, covariance, 2.0 * covariance / elapsed)
    _add_up(x, smooth, rate, spurious, math.exp(-elapsed / _MEMORY), delays)
    if x.count * elapsed < _LEAST * _MEMORY:
        return False
    forces, best, plain, time_constant = _of_forces(x), 0, 0, 0.0
    lowest = lowest_plain = math.inf
    for late in range(delays):
        shown = _of_delay(x, late)
        of_delay = _time_constant(forces, shown)
        mismatch, mismatch_plain = (
            _mismatch(forces, shown, of_delay),
            _mismatch(forces, shown, 0.0),
        )
        if mismatch < lowest:
            best, time_constant, lowest = late, of_delay, mismatch
        if mismatch_plain < lowest_plain:
            plain, lowest_plain = late, mismatch_plain
    smoothed = 2.0 * _SMOOTHING / period
    variance = max(noise**2 / smoothed, lowest / (3.0 * x.count))
    # Of the smoothed readings so many are as good as one.
    variance *= 1.0 + smoothed
    keep = math.exp(-elapsed / _USUAL_TIME)
    x.lag_time *= keep
    x.none_time *= keep
    is_clear = forces[2] > _CLEAR * x.spurious
    has_lag = _SHORTEST < time_constant < _LONGEST and _explains(x, best, lowest)
    lag_shows = is_clear and has_lag and lowest_plain - lowest > 2.0 * variance * _SHOWN
    if lag_shows:
        x.lag_time += elapsed
    elif (
        is_clear
        and _explains(x, plain, lowest_plain)
        and _none_shows(x, forces, plain, lowest_plain, variance)
    ):
        x.none_time += elapsed
    had_lag, ours = x.time_constant > 0.0, int(x.delay)
    if not (x.lag_time > _SEEN and x.lag_time > _LONGER * x.none_time):
        x.time_constant = x.delay = 0.0
        return had_lag
    if not lag_shows:
        return False
    if had_lag and best != ours:
        # Delay and lag are much alike.
        shown = _of_delay(x, ours)
        of_ours = _time_constant(forces, shown)
        if _mismatch(forces, shown, of_ours) - lowest < 2.0 * variance * _SHOWN:
            best, time_constant = ours, of_ours
    x.time_constant, x.delay = time_constant, float(best)
    return not had_lag or best != ours


@njit(cache=True)
def _learn_noise(x: Record, push: Vector, elapsed: float) -> None:
    """Learns the forces' noise from second differences, of which few are of a landing."""
    change = subtract(push, vector(x.read))
    bend = subtract(change, vector(x.change))
    put(x.read, push)
    put(x.change, change)
    if x.ticks >= 2:
        log = math.log(max(dot(bend, bend) / 18.0, 1e-12)) - LOG_OF_THREE
        blend = 1.0 - math.exp(-elapsed / _NOISE_TIME)
        x.noise += max(blend, 1.0 / (x.ticks - 1.0)) * (log - x.noise)


@njit(cache=True)
def _add_up(
    x: Record, push: Vector, rate: Vector, spurious: Vector, keep: float, delays: int
) -> None:
    """Adds a tick to the sums.

    Args:
        spurious: what noise adds to the squares of the push, to its products with the rate, and to
            the squares of that (errors in variables).
    """
    x.count = keep * x.count + 1.0
    x.push_square = keep * x.push_square + dot(push, push) - spurious[0]
    x.push_rate = keep * x.push_rate + dot(push, rate) - spurious[1]
    x.rate_square = keep * x.rate_square + dot(rate, rate) - spurious[2]
    x.spurious = keep * x.spurious + spurious[2]
    put(x.push_total, add(scale(keep, vector(x.push_total)), push))
    put(x.rate_total, add(scale(keep, vector(x.rate_total)), rate))
    for late in range(delays):
        shown = vector(x.shown[late])
        x.square[late] = keep * x.square[late] + dot(shown, shown)
        x.cross[late] = keep * x.cross[late] + dot(shown, push)
        x.rate_cross[late] = keep * x.rate_cross[late] + dot(shown, rate)
        put(x.total[late], add(scale(keep, vector(x.total[late])), shown))


@njit(cache=True)
def _both(product: float, one: np.ndarray, other: np.ndarray, count: float) -> float:
    """Sum of products about the means, from that of products and those of each, (3,)."""
    return product - dot(vector(one), vector(other)) / count


@njit(cache=True)
def _of_forces(x: Record) -> Vector:
    """Sums about the means of the squares of the push, of its products with the rate, and of the
    squares of that."""
    push = _both(x.push_square, x.push_total, x.push_total, x.count)
    push_rate = _both(x.push_rate, x.push_total, x.rate_total, x.count)
    rate = _both(x.rate_square, x.rate_total, x.rate_total, x.count)
    return max(push, 1e-9), push_rate, max(rate, 1e-9)


@njit(cache=True)
def _of_delay(x: Record, late: int) -> Vector:
    """Sums about the means of the squares of what was shown so many ticks ago, and of its products
    with the forces and with their rate."""
    square = _both(x.square[late], x.total[late], x.total[late], x.count)
    cross = _both(x.cross[late], x.total[late], x.push_total, x.count)
    return square, cross, _both(x.rate_cross[late], x.total[late], x.rate_total, x.count)


@njit(cache=True)
def _time_constant(forces: Vector, shown: Vector) -> float:
    """That of least squares with a delay, at least 0 [s].

    Args:
        forces, shown: see `_of_forces` and `_of_delay`.
    """
    push, push_rate, rate = forces
    _, cross, rate_cross = shown
    of_push, of_rate = cross * rate - rate_cross * push_rate, rate_cross * push - cross * push_rate
    if of_push <= 0.0 or push * rate <= push_rate**2:
        return 0.0
    return max(0.0, of_rate / of_push)


@njit(cache=True)
def _mismatch(forces: Vector, shown: Vector, time_constant: float) -> float:
    """Sum of squares that a delay and a time constant [s] leave, with the best gain; see
    `_time_constant`."""
    push, push_rate, rate = forces
    square, cross, rate_cross = shown
    true = push + 2.0 * time_constant * push_rate + time_constant**2 * rate
    return square - max(0.0, cross + time_constant * rate_cross) ** 2 / max(true, 1e-9)


@njit(cache=True)
def _explains(x: Record, late: int, mismatch: float) -> bool:
    """Is what is left a small part of what was shown?"""
    return mismatch < (1.0 - _EXPLAINED) * _of_delay(x, late)[0]


@njit(cache=True)
def _none_shows(
    x: Record, forces: Vector, plain: int, lowest_plain: float, variance: float
) -> bool:
    """Does it show that there is no lag?

    Args:
        plain, lowest_plain: the best delay without one, and what it leaves.
    """
    if x.time_constant > 0.0:
        ours = _mismatch(forces, _of_delay(x, int(x.delay)), x.time_constant)
        return ours - lowest_plain > 2.0 * variance * _SHOWN
    push, push_rate, rate = forces
    gain = _of_delay(x, plain)[1] / push
    return variance < (gain * _SHARP) ** 2 * (rate - push_rate**2 / push)


@njit(cache=True)
def undo_lag(
    result: np.ndarray, read: np.ndarray, before: np.ndarray, time_constant: float, elapsed: float
) -> None:
    """Fills the forces (P, 3) that a low-pass has turned into those that are read [N].

    Args:
        read, before: as they are read, and a tick ago, (P, 3) [N].
    """
    for pad in range(len(read)):
        for i in range(3):
            rate = (read[pad, i] - before[pad, i]) / elapsed
            result[pad, i] = read[pad, i] + time_constant * rate
