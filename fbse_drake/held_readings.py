"""Channels of sensors that are read more seldom than a log has rows, and held in between."""

from itertools import pairwise

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.stats import norm

# The line through readings jumps where it bends by more standard deviations of its noise.
_SIGNIFICANT = 3.0
# Fewer changes of a channel do not tell how often it is read.
_FEWEST_CHANGES = 20
# This share of the times from one change to the next must be alike within a row: a sensor's clock
# need not be the log's, but a coarse encoder changes as its joint turns.
_REGULAR = 0.9
# A sensor is not read sooner than its clock ticks, as what changes in steps of its own is: so many
# readings take so many times as long as one, less these rows, or more.
_READINGS, _JITTER = 10, 2.0


def rows_of_readings(values: np.ndarray) -> np.ndarray:
    """Rows of a log in which a channel is read, also what happens to equal the reading before; all
    rows of a channel that is read in every row, irregularly, or that seldom changes.

    Args:
        values: of the channel, (N, ...).

    >>> import numpy as np
    >>> rows_of_readings(np.repeat(np.arange(30.0), 4))[:4]
    array([ 0,  4,  8, 12])
    """
    rows = np.arange(len(values))
    changes = 1 + np.flatnonzero(np.any(np.diff(values.reshape(len(values), -1), axis=0), axis=1))
    if len(changes) < _FEWEST_CHANGES:
        return rows
    apart = np.diff(changes)
    usual = int(np.median(apart))
    alike = np.abs(apart - usual) <= 1
    if usual == 1 or np.mean(alike) < _REGULAR:
        return rows
    together = changes[_READINGS:] - changes[:-_READINGS]
    if np.mean(together >= _READINGS * apart[alike].mean() - _JITTER) < _REGULAR:
        return rows
    # Between changes that are further apart, readings equal the one before.
    ends = pairwise([*changes, len(values) + usual // 2])
    after = (np.arange(start, max(end - usual // 2, start + 1), usual) for start, end in ends)
    return np.concatenate([np.arange(changes[0] % usual, changes[0], usual), *after])


def rows_per_reading(values: np.ndarray) -> float:
    """Rows of a log for which each reading of a channel (N, ...) is held, in the mean; 1 for one
    that is not, see `rows_of_readings`."""
    return len(values) / len(rows_of_readings(values))


def between_readings(values: np.ndarray) -> np.ndarray:
    """Values (N, ...) of a channel, linear between its readings: held ones are late by half the
    time from one to the next on average."""
    read = rows_of_readings(values)
    if len(read) == len(values):
        return values
    line = make_interp_spline(read, values[read], k=1)
    return np.asarray(line(np.arange(len(values)).clip(read[0], read[-1])))


def unseen_variance(
    values: np.ndarray, noise: np.ndarray | float, seen: float, read: np.ndarray
) -> np.ndarray:
    """What jumps between a channel's readings, and nobody knows when: variance of white noise in
    every row, (N, k), that leaves as much in an average; 0 where readings go on as before.

    A jump J within the time T from one reading to the next, of which a reading is the mean over t,
    makes the integral of a straight line between them wrong by J sqrt((T^2 - t^2) / 12). It shows
    as bends of the line through the readings, to one side and back, that are larger than noise and
    most others.

    Args:
        values: of the channel, (N, k).
        noise: standard deviation of a reading, scalar or (k,).
        seen: t, in rows of the log.
        read: the rows that are readings, see `rows_of_readings`.
    """
    intervals, result = np.diff(read), np.zeros(values.shape)
    if len(read) < 3 or intervals.max() <= seen:
        return result
    bends = np.abs(np.diff(values[read], 2, axis=0))
    # Of both ends of an interval the smaller one; nobody knows those before and after all readings.
    usual = np.maximum(np.sqrt(6.0) * noise, np.median(bends, axis=0) / norm.ppf(0.75))
    bends = np.concatenate([bends[:1], bends, bends[-1:]])
    jumps = np.minimum(bends[:-1], bends[1:])
    beyond = np.maximum(jumps**2 - (_SIGNIFICANT * usual) ** 2, 0.0)
    unseen = np.maximum(intervals - seen**2 / intervals, 0.0) / 12.0
    result[read[0] : read[-1]] = np.repeat(beyond * unseen[:, None], intervals, axis=0)
    return result
