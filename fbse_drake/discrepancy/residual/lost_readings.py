"""Readings of torques that were lost: exactly 0, amid others that are all but that."""

import numpy as np

from fbse_drake.discrepancy.residual.white_noise import step_of

# They are 0 for so many samples at most, that many times farther from those around them than
# neighbours usually are; so many of them are no chance.
_LONGEST, _FAR_FROM_USUAL, _FEWEST = 3, 10.0, 3


def lost_readings(torque: np.ndarray) -> np.ndarray:
    """Which of these samples (N, n) were lost, (N, n) bool.

    >>> import numpy as np
    >>> lost = np.isin(np.arange(100), [10, 40, 41, 70])
    >>> bool((lost_readings(np.where(lost, 0.0, 5.0)[:, None])[:, 0] == lost).all())
    True
    """
    return np.stack([_lost(column) for column in torque.T], axis=1)


def _lost(column: np.ndarray) -> np.ndarray:
    """The same of one joint, (N,)."""
    size, index, zero = len(column), np.arange(len(column)), column == 0.0
    before = np.maximum.accumulate(np.where(zero, -1, index))
    after = np.minimum.accumulate(np.where(zero, size, index)[::-1])[::-1]
    lost = zero & (before >= 0) & (after < size) & (after - before - 1 <= _LONGEST)
    if not lost.any():
        return lost
    left, right = column[before[lost]], column[after[lost]]
    usual = max(float(np.median(np.abs(np.diff(column)))), step_of(column))
    lost[lost] = np.minimum(left * np.sign(right), np.abs(right)) > _FAR_FROM_USUAL * usual
    return lost if len(np.unique(before[lost])) >= _FEWEST else np.zeros(size, dtype=bool)


def between_lost(torque: np.ndarray) -> np.ndarray:
    """Torques (N, n) with what was lost on straight lines between the samples around it."""
    result, lost = torque.copy(), lost_readings(torque)
    for joint in np.flatnonzero(lost.any(axis=0)):
        there = lost[:, joint]
        at, known = np.flatnonzero(there), np.flatnonzero(~there)
        result[at, joint] = np.interp(at, known, torque[known, joint])
    return result
