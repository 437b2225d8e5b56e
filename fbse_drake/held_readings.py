"""Channels of sensors that are read more seldom than a log has rows, and held in between."""

import numpy as np
from scipy.interpolate import interp1d

# Fewer changes of a channel do not tell how often it is read.
_FEWEST_CHANGES = 20


def rows_per_reading(values: np.ndarray) -> int:
    """Rows of a log for which each reading of a channel is held: 1 for one that is read in every
    row, at no fixed period, or seldom changes at all.

    Args:
        values: of the channel, (N, ...).

    >>> import numpy as np
    >>> rows_per_reading(np.repeat(np.arange(30.0), 4))
    4
    """
    changes = _changes(values)
    return int(np.gcd.reduce(np.diff(changes))) if len(changes) >= _FEWEST_CHANGES else 1


def rows_of_readings(values: np.ndarray) -> np.ndarray:
    """Rows in which a channel (N, ...) is read, also what happens to equal the reading before; all
    of one whose readings are not held."""
    held = rows_per_reading(values)
    first = _changes(values)[0] % held if held > 1 else 0
    return np.arange(first, len(values), held)


def between_readings(values: np.ndarray) -> np.ndarray:
    """Values (N, ...) of a channel, linear between its readings: held ones are late by half the
    time from one to the next on average."""
    read = rows_of_readings(values)
    if len(read) == len(values):
        return values
    ends = values[read[0]], values[read[-1]]
    line = interp1d(read, values[read], axis=0, bounds_error=False, fill_value=ends)
    return np.asarray(line(np.arange(len(values))))


def _changes(values: np.ndarray) -> np.ndarray:
    """Rows that do not equal the row before."""
    return 1 + np.flatnonzero(np.any(np.diff(values.reshape(len(values), -1), axis=0), axis=1))
