"""Memory of a process that simulates and estimates again and again."""

import gc
import pickle
import subprocess
import sys
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import scenario
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, System

from fbse_drake import Log, build_station, load_scenario, simulate
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.residual.equation_of_motion import EquationOfMotion
from fbse_drake.effects.friction import CoulombFriction, ViscousFriction
from fbse_drake.estimation import estimate
from fbse_drake.wiring import release

_PAGE = 4096 / 2**20
_STATISTICS = Path("/proc/self/statm")
_PUSH = "robot.pushes.lift={body: trunk, force: [0, 0, 9], start: 0, duration: 1}"


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
        ("sway", ["solve_twice=true", _PUSH]),
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


def memory_of_walks() -> list[float]:
    """What is used after each of some walks that are simulated and estimated [MiB]."""
    walk = scenario("paper_walk_fbse", "duration=0.3")
    used = []
    for _ in range(7):
        estimate(walk, simulate(walk).log)
        used.append(resident())
    return used


@pytest.mark.skipif(
    not _STATISTICS.exists(), reason="the memory of a process is read as Linux has it"
)
def test_memory_levels_off_over_simulations_and_estimates() -> None:
    """What is not freed of a run is 10 MiB of its station and 2 MiB of its estimators.

    In a process of its own: where other tests have been, free memory lies in pieces.
    """
    code = "from test_memory import memory_of_walks; print(*memory_of_walks())"
    command, here = [sys.executable, "-c", code], Path(__file__).parent
    found = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True)
    used = [float(word) for word in found.stdout.split()]
    assert used[-1] - used[2] < 6.0


def test_a_diagnosis_keeps_nothing_of_what_it_was_made_with() -> None:
    """Columns and fits are gone with it, and at once: nothing is left for the garbage collector."""
    swing = load_scenario("leg_swing_gantry", overrides=["duration=4", "log.period=0.01"])
    bare = replace(swing.robot, effects={})
    believed = replace(swing, robot=bare, model=bare)
    log = planned_log(believed)
    torque = log["joint/torque_command"] + 2.0 * np.tanh(100 * log["joint/velocity"])
    log = Log(log.channels | {"joint/torque_command": torque}, log.meta)

    def working() -> set[int]:
        kinds = (Fits, Dictionary, Predictor, EquationOfMotion)
        return {id(kept) for kept in gc.get_objects() if isinstance(kept, kinds)}

    gc.collect()
    gc.disable()
    try:
        before = working()
        diagnosis = diagnose(Predictor(believed, log), [CoulombFriction, ViscousFriction])
        assert diagnosis.chosen
        assert working() == before
    finally:
        gc.enable()
    assert len(pickle.dumps(diagnosis)) < 100_000
