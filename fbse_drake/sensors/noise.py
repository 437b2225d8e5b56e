"""White noise as a function of the tick: the same seed, channel and tick always give the same numbers."""

from functools import lru_cache
from zlib import crc32

import numpy as np

from fbse_drake.sampling import tick_index

_BLOCK = 1024


@lru_cache(maxsize=64)
def _block(seed: int, channel: str, size: int, block: int) -> np.ndarray:
    generator = np.random.default_rng([seed, crc32(channel.encode()), block])
    values = generator.standard_normal((_BLOCK, size))
    values.flags.writeable = False
    return values


def white_noise(seed: int, channel: str, size: int, time: float, period: float) -> np.ndarray:
    """Standard normal numbers held over a sampling period, independent between ticks and channels.

    A pure function of its arguments, so a sensor needs no generator in its state, and a diagram that is run again, or with
    another plant step, sees the same noise at the same times.

    Returns:
        Shape (size,), read-only.
    """
    tick = tick_index(time, period)
    return _block(seed, channel, size, tick // _BLOCK)[tick % _BLOCK]
