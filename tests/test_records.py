"""Posteriors as records: in the vectors that Drake keeps, on ports, and in two contexts at once."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import scenario
from rig import Base, Replay, Rig, diagram, inputs_of, numbers

from fbse_drake import Log, load_scenario
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.estimator import Estimator
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.fixed_friction import FixedFriction
from fbse_drake.estimators.records import as_record, parts, record, record_type, size_of
from fbse_drake.estimators.recursive import RecursiveEstimator
from fbse_drake.estimators.support import MeasuredSupport

FEW = record_type(time=(), anchor=(2, 3), covariance=record_type(pp=(), pv=(3,)), none=(0, 3))
Run = Callable[..., Log]
ESTIMATORS: dict[str, Estimator] = {
    "best": Fbse(),
    "paper": load_scenario("paper_walk_fbse", "paper_method").estimator,
    "observer": DisturbanceObserver(),
    "fixed": FixedFriction(),
}


def estimator_of(name: str) -> Replay:
    """One of the estimators as a walk's station has it."""
    return Replay(diagram(ESTIMATORS[name], scenario("paper_walk_fbse", "duration=3")))


def test_a_record_is_a_view_of_its_vector():
    assert size_of(FEW) == 11
    vector = np.arange(11.0)
    seen = as_record(vector, FEW)
    np.testing.assert_array_equal(seen["anchor"], [[1, 2, 3], [4, 5, 6]])
    assert seen["covariance"]["pp"] == 7
    # What is written to either is in both.
    seen["anchor"][1] = -1.0
    seen["covariance"]["pv"][2] = 20.0
    vector[0] = 5.0
    np.testing.assert_array_equal(vector, [5, 1, 2, 3, -1, -1, -1, 7, 8, 9, 20])
    assert seen["time"] == 5
    np.testing.assert_array_equal(numbers(seen), vector)
    read_only = vector.view()
    read_only.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        as_record(read_only, FEW)["anchor"][0] = 0.0


def test_parts_are_where_the_fields_are():
    expected = {"time": slice(0, 1), "anchor": slice(1, 7), "covariance": slice(7, 11)}
    assert parts(FEW) == expected


def test_constants_are_numbers_arrays_records_and_dataclasses():
    pads = record(foot=np.array([0, 0, 1]))
    known = record(mass=87, pads=pads, support=MeasuredSupport(on=0.2), watches=True)
    assert known["mass"].dtype == float
    assert known["pads"]["foot"].tolist() == [0, 0, 1]
    assert known["support"]["on"] == 0.2
    assert known["watches"].dtype == bool


@pytest.mark.parametrize("name", ESTIMATORS)
def test_each_field_is_a_port(run: Run, name: str):
    walk = run("paper_walk_fbse", "duration=3")
    replay, inputs = estimator_of(name), inputs_of(walk)
    replay.run(walk.time[:50], inputs, "friction_estimate")
    replay.fix({port: values[50] for port, values in inputs.items()}, walk.time[50])
    systems = [s for s in replay.estimator.GetSystems() if isinstance(s, RecursiveEstimator)]
    for system in systems:
        context = system.GetMyContextFromRoot(replay.context)
        vector = system.GetOutputPort("posterior").Eval(context)
        posterior = as_record(vector, system.posterior_type)
        assert posterior.dtype.names[:2] == ("time", "status")
        assert posterior["time"] == walk.time[50]
        for field in posterior.dtype.names:
            expected = posterior[field]
            expected = numbers(expected) if expected.dtype.names else expected.ravel()
            np.testing.assert_array_equal(system.GetOutputPort(field).Eval(context), expected)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_two_contexts_do_not_know_of_each_other(run: Run, name: str):
    """Two stretches of a walk, whose ticks take turns, give what each gives alone."""
    walk, replay = run("paper_walk_fbse", "duration=3"), estimator_of(name)
    inputs, ticks = inputs_of(walk), 60
    stretches = [{port: values[s : s + ticks] for port, values in inputs.items()} for s in (0, 900)]
    alone = [replay.fork().run(walk.time[:ticks], stretch) for stretch in stretches]
    contexts = [replay.fork() for _ in stretches]
    outputs = {name: replay.estimator.GetOutputPort(name) for name in alone[0]}
    for k in range(ticks):
        for context, stretch in zip(contexts, stretches, strict=True):
            context.fix({port: values[k] for port, values in stretch.items()}, walk.time[k])
        # Channel by channel, so that each is computed between two of the other context.
        for channel, port in outputs.items():
            for context, expected in zip(contexts, alone, strict=True):
                found = port.Eval(context.context)
                np.testing.assert_array_equal(found, expected[channel][k], err_msg=channel)
        for context in contexts:
            replay.estimator.ExecuteForcedEvents(context.context, publish=False)


def test_the_models_plant_belongs_to_its_context():
    """A plant is in the posture of one context while the model is asked about the other."""
    base = Base.of()
    straight = np.zeros(12)
    bent, upright = Rig(base.model), Rig(base.model)
    bent.fix(measurements=base.measurements())
    upright.fix(measurements=base.measurements(joint_position=straight))
    port = base.model.GetOutputPort("com")
    before = port.Eval(bent.context)
    assert np.abs(port.Eval(upright.context) - before).max() > 0.01
    # A clone has a plant of its own as well.
    clone = Rig(base.model)
    clone.context = bent.context.Clone()
    clone.fix(measurements=base.measurements(joint_position=straight))
    np.testing.assert_array_equal(port.Eval(clone.context), port.Eval(upright.context))
    bent.context.SetTime(1.0)
    np.testing.assert_array_equal(port.Eval(bent.context), before)


def test_what_processes_compile_for_other_records_is_not_mistaken_for_each_other(
    tmp_path: Path,
) -> None:
    """The function within is too long to become part of what calls it, and has a name."""
    (tmp_path / "compiled.py").write_text(
        """
import numpy as np
from numba import njit
from fbse_drake.estimators.records import record

@njit(cache=True)
def within(values):
    x = values[()]
    return np.linalg.inv(np.diag(np.sort(x.before) + 1.0)).sum() * x.last

@njit(cache=True)
def last(values):
    return within(values) / len(values[()].before)

def lasts(*sizes):
    print([last(record(before=np.zeros(n), last=float(n))) for n in sizes])
"""
    )

    def lasts(*sizes: int) -> str:
        script = f"import compiled; compiled.lasts{sizes}"
        path = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))
        places = {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        command = [sys.executable, "-c", script]
        return subprocess.check_output(command, env={**os.environ, **places}, text=True)

    assert lasts(1) == "[1.0]\n"
    assert lasts(4) == "[4.0]\n"
    assert lasts(1, 4) == "[1.0, 4.0]\n"
