"""Several logs fitted together: how they are put together, and how far they agree.

Truth comes from planned motions, with torques that are added to them here by formulas.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import swinging_legs

from fbse_drake import Log, Scenario
from fbse_drake.cli import main
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.spread import spread_of
from fbse_drake.effects.effect import library
from fbse_drake.effects.friction import CoulombFriction, ViscousFriction
from fbse_drake.errors import InputError
from fbse_drake.log import joined
from fbse_drake.scenario import dump_scenario

NOISE = 0.05
KNEE = "left_knee_pitch"


@pytest.fixture(scope="module")
def swing() -> tuple[Scenario, Log]:
    return swinging_legs(6, NOISE)


def with_friction(log: Log, coulomb: float, seed: int) -> Log:
    torque = log["joint/torque_command"].copy()
    place = log.joints.index(KNEE)
    torque[:, place] += coulomb * np.tanh(log["joint/velocity"][:, place] / 0.01)
    torque += NOISE * np.random.default_rng(seed).standard_normal(torque.shape)
    return Log(log.channels | {"joint/torque_command": torque}, log.meta)


def diagnosis_of(swing: tuple[Scenario, Log], sizes: dict[str, float]) -> Diagnosis:
    scenario, log = swing
    logs = {name: with_friction(log, size, k) for k, (name, size) in enumerate(sizes.items())}
    return diagnose(Predictor(scenario, joined(logs)), [CoulombFriction, ViscousFriction])


def test_logs_that_agree(swing: tuple[Scenario, Log]) -> None:
    (finding,) = diagnosis_of(swing, {"a": 1.5, "b": 1.5, "c": 1.5}).chosen
    assert (finding.effect, finding.targets) == ("CoulombFriction", (KNEE,))
    low, high = finding.parameters["coulomb"].interval
    spread = finding.spread["coulomb"]
    assert not spread.differs
    assert spread.between < 0.02
    assert list(spread.by_log) == ["a", "b", "c"]
    for own in spread.by_log.values():
        assert own.interval[0] < 1.5 < own.interval[1]
        assert high - low < own.interval[1] - own.interval[0]


def test_logs_that_do_not_agree(swing: tuple[Scenario, Log]) -> None:
    sizes = {"cold": 1.5, "warm": 1.2}
    found = [f for f in diagnosis_of(swing, sizes).chosen if f.effect == "CoulombFriction"]
    spread = found[0].spread["coulomb"]
    assert spread.differs
    assert spread.between == pytest.approx(np.std(list(sizes.values()), ddof=1), rel=0.1)
    for name, size in sizes.items():
        low, high = spread.by_log[name].interval
        assert low < size < high


def test_one_log_has_no_spread(swing: tuple[Scenario, Log]) -> None:
    (finding,) = diagnosis_of(swing, {"alone": 1.5}).chosen
    assert finding.spread == {}


def test_spread_has_the_stated_error_rate() -> None:
    """Of values that differ by their uncertainty alone; and finds what lies between them."""
    random, count, logs = np.random.default_rng(0), 4000, 5
    names, freedom = [str(k) for k in range(logs)], np.full(logs, np.inf)
    deviation = random.uniform(0.5, 2.0, (count, logs))
    noise = deviation * random.standard_normal((count, logs))
    alike = [spread_of(names, *one, freedom) for one in zip(noise, deviation, strict=True)]
    assert np.mean([s.probability < 0.05 for s in alike]) == pytest.approx(0.05, abs=0.012)
    values = noise + 3.0 * random.standard_normal((count, logs))
    unlike = [spread_of(names, *one, freedom) for one in zip(values, deviation, strict=True)]
    assert np.mean([s.between**2 for s in unlike]) == pytest.approx(9.0, rel=0.06)


def test_what_a_log_says_nothing_of_is_left_out() -> None:
    told = spread_of(
        ["a", "b", "c"], np.array([1.0, np.nan, 5.0]), np.array([1.0, 1.0, 0.0]), np.full(3, 9.0)
    )
    assert list(told.by_log) == ["a"]
    assert (told.between, told.probability) == (0.0, 1.0)


def test_logs_are_joined_with_gaps_and_keep_their_segments(swing: tuple[Scenario, Log]) -> None:
    log = swing[1]
    size, half = len(log.time), len(log.time) // 2
    both = joined({"first": log.part(slice(0, half)), "second": log.part(slice(half, None))})
    assert len(both.time) == size
    assert np.diff(both.time).max() == pytest.approx(1.0)
    again = joined({"both": both.part(slice(10, None)), "third": log})
    assert [part["source"] for part in again.meta["segments"]] == ["first", "second", "third"]
    for part, (first, last) in zip(
        again.meta["segments"],
        ((0, half - 11), (half - 10, size - 11), (size - 10, -1)),
        strict=True,
    ):
        assert (part["start"], part["end"]) == pytest.approx((again.time[first], again.time[last]))
    other = Log(log.channels, log.meta | {"period": 0.02})
    with pytest.raises(InputError, match="second: cannot be one log with first: its period"):
        joined({"first": log, "second": other})


def test_the_command_shows_the_spread(
    swing: tuple[Scenario, Log], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, log = swing
    others = sorted(library().keys() - {"CoulombFriction", "ViscousFriction"})
    identify = dataclasses.replace(scenario.identify, ruled_out=others)
    scenario = dataclasses.replace(scenario, identify=identify)
    path = tmp_path / "swing.yaml"
    path.write_text(dump_scenario(scenario, "swing"))
    for seed, (name, size) in enumerate({"cold": 1.5, "warm": 1.2}.items()):
        with_friction(log, size, seed).save(tmp_path / f"{name}.npz")
    logs = [str(tmp_path / f"{name}.npz") for name in ("cold", "warm")]
    out = tmp_path / "out"
    assert main(["diagnose", str(path), *logs, "--out", str(out)]) == 0
    # The terminal breaks lines.
    assert "The recordings do not agree in" in " ".join(capsys.readouterr().out.split())
    tree = json.loads((out / "diagnosis.json").read_text())
    first = next(f for f in tree["ranking"] if f["effect"] == "CoulombFriction")
    assert set(first["spread"]["coulomb"]["by_log"]) == {"cold", "warm"}
    assert set(tree["set_aside"]) == {"rest of cold", "rest of warm"}
    assert "recording to recording" in (out / "report.html").read_text()
    assert main(["diagnose", str(path), logs[0], logs[0], "--out", str(out)]) == 2
