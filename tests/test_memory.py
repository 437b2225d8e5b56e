"""Memory of a process that simulates and estimates again and again."""

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import scenario
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, System

from fbse_drake import build_station, simulate
from fbse_drake.estimate import estimate
from fbse_drake.wiring import release

_PAGE = 4096 / 2**20
_STATISTICS = Path("/proc/self/statm")


def resident() -> float:
    """Memory of this process [MiB]."""
    return _PAGE * int(_STATISTICS.read_text().split()[1])


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("squat", ["sensors.encoders={velocity: differenced}"]),
        (
            "paper_walk_fbse",
            ["sensors.joint_torque={noise: 0.3}", "sensors.more={winding: !JointTemperature {}}"],
        ),
        ("paper_walk_fbse", ["robot.effects.gain=!FootForceGain {gain: {left: 0.1}}"]),
    ],
)
def test_a_released_station_and_all_systems_in_it_are_freed(
    name: str, overrides: list[str]
) -> None:
    def systems(diagram: Diagram) -> Iterator[System]:
        for inner in diagram.GetSystems():
            yield inner
            if isinstance(inner, Diagram):
                yield from systems(inner)

    station = build_station(scenario(name, "duration=0.1", *overrides))
    simulator = Simulator(station)
    simulator.AdvanceTo(0.01)
    references = [weakref.ref(station), *map(weakref.ref, systems(station))]
    release(station)
    del simulator, station
    gc.collect()
    assert [type(kept()).__name__ for kept in references if kept() is not None] == []


@pytest.mark.skipif(
    not _STATISTICS.exists(), reason="the memory of a process is read as Linux has it"
)
def test_memory_levels_off_over_simulations_and_estimates() -> None:
    """What is not freed of a run is 10 MiB of its station and 2 MiB of its estimators."""
    walk = scenario("paper_walk_fbse", "duration=0.3")
    used = []
    for _ in range(7):
        estimate(walk, simulate(walk).log)
        used.append(resident())
    assert used[-1] - used[2] < 6.0
