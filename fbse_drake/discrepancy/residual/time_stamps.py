"""When the samples of a log were taken, where its stamps scatter.

A recorder that samples by an even clock and stamps a sample when it comes to it writes stamps that
scatter though the samples do not; interpolating between such stamps would put motion where none is.
Which of the two it is, smooth motion shows.
"""

import numpy as np

from fbse_drake.log import Log

# Stamps that scatter by less than this share of a period are even enough; samples further from an
# even clock than so many periods have gaps.
_SCATTER, _FARTHEST = 0.01, 1.0
# By how much smoother angles have to be by an even clock than by the stamps, as variance.
_SMOOTHER = 1.2
# Neighbours on either side that tell an angle.
_REACH = 2
# Fewer samples than this say nothing.
_FEWEST_SAMPLES = 100


def sampled_evenly(log: Log) -> Log:
    """The log with the stamps of an even clock, if its angles show that it was sampled by one; else
    as it is."""
    time, period = log.time, float(log.meta["period"])
    if len(time) < _FEWEST_SAMPLES:
        return log
    place = np.arange(len(time))
    even = np.polyval(np.polyfit(place, time - time[0], 1), place) + time[0]
    off = (time - even) / period
    if off.std() < _SCATTER or np.abs(off).max() > _FARTHEST:
        return log
    angles = log["joint/position"]
    by_stamps, by_clock = (_roughness(at, angles) for at in (time, even))
    tells = by_clock > 0
    if not tells.any() or np.mean(by_stamps[tells] / by_clock[tells]) < _SMOOTHER:
        return log
    meta = log.meta | {"period": float(even[1] - even[0])}
    return Log(log.channels | {"time": even}, meta)


def _roughness(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean square by which values (N, n) differ from the cubic through their neighbours, (n,);
    white noise of them counts alike however their times lie."""
    offsets = [k for k in range(-_REACH, _REACH + 1) if k]
    inner = np.arange(_REACH, len(time) - _REACH)
    at = np.stack([time[inner + k] - time[inner] for k in offsets], axis=1)
    # Lagrange's polynomials at 0.
    weights = np.ones_like(at)
    for i in range(len(offsets)):
        for j in range(len(offsets)):
            if i != j:
                weights[:, i] *= at[:, j] / (at[:, j] - at[:, i])
    neighbours = np.stack([values[inner + k] for k in offsets], axis=1)
    missed = values[inner] - np.einsum("mk,mkn->mn", weights, neighbours)
    return (missed**2 / (1.0 + (weights**2).sum(axis=1, keepdims=True))).mean(axis=0)
