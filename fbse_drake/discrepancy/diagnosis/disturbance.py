"""Short disturbances: something pushed the robot for a moment, and never again.

No law of the robot explains that, and a fit that tries to is spoilt. So stretches that stand out
from all the rest of a row that nothing explains are left out, and said.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from fbse_drake.discrepancy.identification.regression import WhitenedResidual

# Probability of any false alarm on a log of noise.
_FALSE_ALARM = 1e-3
# What is left in a block stands out if its square is so many times that of this quantile of its
# row.
_STANDS_OUT, _USUAL = 10.0, 0.9
# Stretches that are no further apart are one [s]; it has so many blocks that stand out, and is no
# longer than this [s].
_APART, _FEWEST_BLOCKS, _LONGEST = 0.1, 2, 1.0
# A log has at most so many of them, over this share of its time, with this share of what their rows
# have beyond the noise: what comes again and again is no disturbance.
_MOST, _MOST_TIME, _LEAST_SHARE = 3, 0.05, 0.7
# So much around a stretch is left out with it [s].
_AROUND = 0.05


@dataclass(frozen=True)
class Disturbance:
    """A stretch of a log in which something acted that no law of the robot explains."""

    # [s]
    start: float
    end: float
    # Of the residual, in which it shows.
    rows: tuple[str, ...]


def disturbances(
    white: WhitenedResidual, left: np.ndarray, rows: Sequence[int]
) -> tuple[Disturbance, ...]:
    """Short stretches that stand out in rows in which something is left.

    Args:
        left: what is left of the residual, whitened, (B, R).
        rows: places of the rows that are looked at.
    """
    time = white.residual.time
    block = float(time[1] - time[0])
    names = [row.name for row in white.residual.rows]
    found = [
        (start, end, names[row])
        for row in rows
        for start, end in _stretches(white, left[:, row] ** 2, row, block)
    ]
    merged: list[Disturbance] = []
    for start, end, name in sorted(found):
        # What acts for a while may pass through zero, for no longer than it has acted.
        if merged and start - merged[-1].end <= merged[-1].end - merged[-1].start:
            last = merged.pop()
            start, end = last.start, max(end, last.end)
            merged.append(Disturbance(start, end, tuple(dict.fromkeys((*last.rows, name)))))
        else:
            merged.append(Disturbance(start, end, (name,)))
    total = sum(one.end - one.start for one in merged)
    few = len(merged) <= _MOST and total <= _MOST_TIME * len(time) * block
    return tuple(merged) if few else ()


def _stretches(
    white: WhitenedResidual, square: np.ndarray, row: int, block: float
) -> list[tuple[float, float]]:
    """Start and end [s] of the stretches of one row; none if it has more than disturbances.

    Args:
        square: of what is left, (B,).
    """
    time, known = white.residual.time, white.residual.known[:, row]
    if known.sum() < _FEWEST_BLOCKS:
        return []
    least = chi2.isf(_FALSE_ALARM / white.count.sum(), 1)
    least = max(least, _STANDS_OUT * float(np.quantile(square[known], _USUAL)))
    places = np.flatnonzero(known & (square > least))
    clusters = np.split(places, np.flatnonzero(np.diff(places) * block > _APART + block) + 1)
    if not places.size or len(clusters) > _MOST:
        return []
    inside = np.zeros(len(time), dtype=bool)
    for cluster in clusters:
        if len(cluster) < _FEWEST_BLOCKS or time[cluster[-1]] - time[cluster[0]] > _LONGEST:
            return []
        around = _AROUND + 0.5 * block
        inside |= (time > time[cluster[0]] - around) & (time < time[cluster[-1]] + around)
    beyond = np.maximum(square[known] - 1.0, 0.0)
    if beyond[inside[known]].sum() < _LEAST_SHARE * beyond.sum():
        return []
    edges = np.flatnonzero(np.diff(inside, prepend=False, append=False))
    return [
        (float(time[a]) - 0.5 * block, float(time[b - 1]) + 0.5 * block)
        for a, b in edges.reshape(-1, 2)
    ]
