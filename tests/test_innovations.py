"""How much noisier than believed sensors are, from what they read."""

import numpy as np
import pytest
from scipy.special import digamma

from fbse_drake.estimators.innovations import LOG_OF_SIX, LOG_OF_THREE, learned_noise

TICK = 1e-3
MEAN_LOG = {3: LOG_OF_THREE, 6: LOG_OF_SIX}


def learned(variance: np.ndarray, count: int) -> np.ndarray:
    """Of a mean square of so many normal numbers, whose variance changes, (N,)."""
    squares = np.random.default_rng(0).normal(size=(len(variance), count)) ** 2
    noise, found = 1.0, []
    for square in variance * squares.mean(axis=1):
        noise = learned_noise(noise, square / noise, MEAN_LOG[count], TICK)
        found.append(noise)
    return np.array(found)


@pytest.mark.parametrize("count", MEAN_LOG)
def test_noise_is_found_when_it_begins_and_when_it_ends(count: int):
    assert MEAN_LOG[count] == pytest.approx(digamma(count / 2) - np.log(count / 2), abs=1e-4)
    ticks = np.arange(3000)
    found = learned(np.where((ticks >= 1000) & (ticks < 2000), 100.0, 1.0), count)
    assert np.median(found[1500:2000]) == pytest.approx(100.0, rel=0.3)
    # As believed it is at least, so it is somewhat above it.
    assert 1.0 <= np.median(found[500:1000]) < 1.3
    # As long after the end as after the beginning, as much of it is left as is missing, in
    # decibels.
    half = 1000 + int(np.argmax(found[1000:] > 10.0)), 2000 + int(np.argmax(found[2000:] < 10.0))
    assert abs((half[1] - 2000) - (half[0] - 1000)) < 40
    assert found[2500:].max() < 2.0


def test_a_single_large_reading_tells_little():
    assert learned_noise(1.0, 1e6, LOG_OF_SIX, TICK) < 1.03
