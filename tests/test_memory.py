"""Memory of a process that simulates and estimates again and again."""

import weakref
from pathlib import Path

import pytest
from conftest import scenario
from pydrake.systems.analysis import Simulator

from fbse_drake import build_station, simulate
from fbse_drake.estimate import estimate
from fbse_drake.wiring import release

_PAGE = 4096 / 2**20
_STATISTICS = Path("/proc/self/statm")


def resident() -> float:
    """Memory of this process [MiB]."""
    return _PAGE * int(_STATISTICS.read_text().split()[1])


def test_a_released_station_is_freed() -> None:
    station = build_station(scenario("squat", "duration=0.1"))
    simulator = Simulator(station)
    simulator.AdvanceTo(0.01)
    reference = weakref.ref(station)
    release(station)
    del simulator, station
    assert reference() is None


@pytest.mark.skipif(
    not _STATISTICS.exists(), reason="the memory of a process is read as Linux has it"
)
def test_memory_levels_off_over_simulations_and_estimates() -> None:
    """Each run has 20 MiB and more of diagrams and records."""
    walk = scenario("paper_walk_fbse", "duration=1")
    used = []
    for _ in range(7):
        estimate(walk, simulate(walk).log)
        used.append(resident())
    assert used[-1] - used[2] < 16.0
