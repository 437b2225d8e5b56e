"""Sensor errors as signals of time, drawn from the scenario's seed when the diagram is built.

The same seed, channel and tick always give the same numbers, so a diagram that is run again, or
with another plant step, sees the same errors at the same times, and no system keeps a random
generator.
"""

from zlib import crc32

import numpy as np
from pydrake.math import BsplineBasis
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import BsplineTrajectory


def ticks_until(duration: float, period: float) -> int:
    """Number of sampling ticks from 0 to `duration` [s], both included."""
    return int(duration / period + 1e-6) + 1


def white_noise(seed: int, channel: str, ticks: int, size: int) -> np.ndarray:
    """Standard normal numbers, independent between ticks, channels and seeds, shape
    (ticks, size)."""
    return np.random.default_rng([seed, crc32(channel.encode())]).standard_normal((ticks, size))


def held_signal(values: np.ndarray, period: float) -> TrajectorySource:
    """Source of `values` (ticks, size), each held for `period` [s]; the last one for ever."""
    # A B-spline of order 1 is piecewise constant. Its knots lie a hair before the ticks, so that a
    # tick has its own value.
    knots = (np.arange(len(values) + 1) - 1e-6) * period
    return TrajectorySource(
        BsplineTrajectory(BsplineBasis(1, list(knots)), list(values[:, :, None]))
    )
