"""Data that was set aside before anything was fitted: errors with intervals, and what heads a
result."""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import swinging_legs
from scipy.signal import lfilter

import fbse_drake
from fbse_drake import Log, Scenario, load_scenario
from fbse_drake.cli import DONE, main
from fbse_drake.discrepancy.diagnosis.diagnose import Estimate, Finding, diagnose
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.discrepancy.diagnosis.identify import identify
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import study, train_and_rest
from fbse_drake.discrepancy.diagnosis.validation import (
    Measured,
    Validation,
    batch_length,
    root_of_ratio,
    validated,
)
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.effects.inertia import BodyMass
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.files import write_text
from fbse_drake.report.html import number
from fbse_drake.report.sentences import (
    Inputs,
    diagnosis_outcome,
    set_aside_rows,
    steps_after_diagnosis,
    steps_after_study,
    study_outcome,
)
from fbse_drake.scenario import IdentifyConfig, RecordingConfig, dump_scenario

VELOCITY_NOISE = 0.1  # [rad/s]
NOISE, KNEE = 0.05, "left_knee_pitch"


@pytest.fixture(scope="module")
def swing() -> tuple[Scenario, Log]:
    """Legs that swing in a gantry, as planned, with noise of the torques."""
    scenario = load_scenario("leg_swing_gantry", overrides=["duration=12", "log.period=0.01"])
    bare = dataclasses.replace(scenario.robot, effects={})
    recording = RecordingConfig(rows="instantaneous", block=0.02, torque_noise={"all": NOISE})
    scenario = dataclasses.replace(scenario, robot=bare, model=bare, recording=recording)
    log = planned_log(scenario)
    noise = NOISE * np.random.default_rng(5).standard_normal((len(log.time), len(log.joints)))
    return scenario, with_torque(log, noise)


def with_torque(log: Log, added: np.ndarray) -> Log:
    name = "joint/torque_command"
    return Log(log.channels | {name: log[name] + added}, log.meta)


def rubbing(log: Log, size: float, size_at_the_end: float) -> Log:
    """With Coulomb friction in one joint that has another size in the last fifth of the log."""
    added = np.zeros_like(log["joint/velocity"])
    place = log.joints.index(KNEE)
    late = log.time > 0.8 * log.time[-1]
    sizes = np.where(late, size_at_the_end, size)
    added[:, place] = sizes * np.tanh(log["joint/velocity"][:, place] / 0.01)
    return with_torque(log, added)


def believing(scenario: Scenario, *effects: object) -> Scenario:
    model = dataclasses.replace(
        scenario.believed, effects={f"effect_{k}": effect for k, effect in enumerate(effects)}
    )
    return dataclasses.replace(scenario, model=model)


def generalised_norm(values: np.ndarray, residual: Residual) -> float:
    """sqrt(r' C^-1 r) of all rows, with dense covariances C."""
    total = 0.0
    for known, row, variance, covariance in zip(
        residual.known.T, values.T, residual.variance.T, residual.covariance.T, strict=True
    ):
        at = np.flatnonzero(known)
        beside = np.diag(np.where(np.diff(at) == 1, covariance[at[:-1]], 0.0), 1)
        total += row[at] @ np.linalg.solve(np.diag(variance[at]) + beside + beside.T, row[at])
    return float(np.sqrt(total))


@pytest.mark.parametrize(("memory", "blocks"), [(0.0, 1500), (0.9, 1500), (0.0, 50), (0.9, 75)])
def test_intervals_hold_the_truth_as_often_as_they_say(memory: float, blocks: int):
    """Squares of first-order autoregressions of known variances: the root of the ratio of these,
    also of two or three batches."""
    random, held = np.random.default_rng(1), 0
    for _ in range(300):
        above, below = (
            size * lfilter([1.0], [1.0, -memory], random.standard_normal(blocks + 100))[100:]
            for size in (1.3, 1.0)
        )
        low, high = root_of_ratio(above**2, below**2, batch_length(blocks, 0.01)).interval
        held += low < 1.3 < high
    assert 0.87 < held / 300 < 0.985


def test_errors_are_those_of_norms_and_the_change_is_surer_than_either(
    swing: tuple[Scenario, Log],
):
    scenario, log = swing
    rubbed = rubbing(log, 1.0, 1.0)
    given, right = (
        Predictor(one, rubbed)
        for one in (scenario, believing(scenario, CoulombFriction({KNEE: 1.0})))
    )
    result = validated(given, right)
    assert result.course == "falls"
    first, last = given.residual, right.residual
    # Planned velocities are differences of angles, which the first and the last have none of.
    known = first.known
    assert known.mean() > 0.99
    torque = first.signals.torque_command[known]
    for error, residual in (("relative_before", first), ("relative_after", last)):
        expected = np.linalg.norm(residual.value[known]) / np.linalg.norm(torque)
        assert getattr(result, error).value == pytest.approx(expected)
    of_first, of_last = (generalised_norm(residual.value, first) for residual in (first, last))
    ratio = of_last / of_first
    assert result.change.value == pytest.approx(ratio)
    assert result.change.value == pytest.approx(result.after.value / result.before.value)
    # A bias that is tiny beside all else does not show beyond doubt, nor does a model beside
    # itself.
    same = validated(given, given)
    assert same.course == "unclear"
    assert same.change.interval == pytest.approx((1.0, 1.0))
    wrong = validated(right, Predictor(believing(scenario, TorqueBias({KNEE: 0.4})), rubbed))
    assert wrong.course == "rises"


def test_more_inertia_passes_on_more_noise_and_is_no_worse_for_it(swing: tuple[Scenario, Log]):
    """Velocities so noisy that a mass which the model lacks hardly shows block by block, but does
    beyond doubt in what is slow."""
    scenario, log = swing
    heavy = believing(scenario, BodyMass({"left_shank": 1.0}))
    planned = planned_log(dataclasses.replace(heavy, robot=heavy.believed))
    noise = np.random.default_rng(6).standard_normal(log["joint/velocity"].shape)
    noisy = {"joint/velocity": planned["joint/velocity"] + VELOCITY_NOISE * noise}
    noisy = Log(planned.channels | noisy, planned.meta)
    given, right = (Predictor(one, noisy) for one in (scenario, heavy))
    unwhitened = [np.sum(one.residual.value[one.residual.known] ** 2) for one in (given, right)]
    assert unwhitened[1] > 0.98 * unwhitened[0]
    assert validated(given, right).course == "falls"
    # Three times what lacks is worse than nothing.
    wrong = believing(scenario, BodyMass({"left_shank": 3.0}))
    assert validated(given, Predictor(wrong, noisy)).course == "rises"


def test_a_log_too_short_to_be_parted_is_fitted_whole(swing: tuple[Scenario, Log]):
    scenario, log = swing
    train, rest = train_and_rest(scenario, log)
    assert rest is not None
    assert len(train.time) + len(rest.time) == len(log.time)
    assert rest.time[0] == pytest.approx(0.8 * log.time[-1], abs=0.02)
    short = log.part(slice(0, 150))
    train, rest = train_and_rest(scenario, short)
    assert rest is None
    assert len(train.time) == len(short.time)


FEW = [CoulombFriction, TorqueBias]


@pytest.mark.parametrize(("at_the_end", "course"), [(2.0, "falls"), (-2.0, "rises")])
def test_a_study_is_headed_by_what_was_set_aside(
    swing: tuple[Scenario, Log], at_the_end: float, course: str
):
    """What held-out blocks of the fitted part say is not enough: friction whose sign changes later
    on."""
    scenario, log = swing
    train, rest = train_and_rest(scenario, rubbing(log, 2.0, at_the_end))
    result = study(scenario, train, FEW, rollouts=False, tests={"rest of the log": rest})
    assert [finding.effect for finding in result.found] == ["CoulombFriction"]
    assert result.steps[-1].held_out_rmse < 0.3 * result.steps[0].held_out_rmse
    validation = result.set_aside["rest of the log"]
    assert validation.course == course
    low, high = validation.change.interval
    assert (high < 0.5) if course == "falls" else (low > 1.5)
    outcome = study_outcome(result)
    assert outcome.startswith("Not confirmed: on the rest of the log") == (course == "rises")
    assert f"which was set aside, the error {course}: from " in outcome
    # What its own test refuses is neither stated nor proposed.
    refuted, inputs = course == "rises", Inputs("legs", "legs.yaml", ("log.npz",), "out")
    assert ("What was fitted suggests that the model lacks Coulomb friction" in outcome) == refuted
    assert ("The model lacked Coulomb friction" in outcome) != refuted
    assert ("before it is used" in steps_after_study(result, inputs)[0].text) == refuted
    watched = dataclasses.replace(result.scenario, estimator=Fbse())
    for of_study in (result, dataclasses.replace(result, scenario=watched)):
        commands = [step.command or "" for step in steps_after_study(of_study, inputs)]
        estimates = "fbse estimate out/completed.yaml log.npz" in commands
        assert estimates == (of_study.scenario is watched and not refuted)
    diagnosis = dataclasses.replace(result.diagnoses[0], set_aside=result.set_aside)
    assert ("suggests that the model lacks" in diagnosis_outcome(diagnosis)) == refuted
    command = steps_after_diagnosis(diagnosis, inputs)[0].command
    assert command.startswith("fbse diagnose" if refuted else "fbse add")
    # What a study found, but did not add.
    nothing = dataclasses.replace(
        result, steps=result.steps[:1], diagnoses=(diagnosis,), set_aside={}
    )
    assert study_outcome(nothing).startswith("Nothing was added: Coulomb friction in left knee")
    assert not any(
        "fbse add" in (step.command or "") for step in steps_after_study(nothing, inputs)
    )


@pytest.mark.parametrize(
    ("share", "course", "said"),
    [(0.5, "falls", True), (0.999, "falls", False), (1.3, "rises", True)],
)
def test_the_share_of_the_torque_is_told_where_it_shows_what_is_said(
    share: float, course: str, said: bool
):
    """What is found in the feet, or amid noise, hardly changes it, and would seem nothing."""
    same = Measured(1.0, (0.9, 1.1))
    low, high = (0.4, 0.6) if course == "falls" else (1.2, 1.4)
    change = Measured((low + high) / 2, (low, high))
    result = Validation(
        same, change, change, same, Measured(share, (0.0, 9.0)), Measured(share, (0.0, 9.0))
    )
    ((_, text),) = set_aside_rows({"rest of the log": result})
    value, bounds = number(change.value), f"{number(low)} to {number(high)}"
    assert f"the error {course}: from 1.00 to {value} times" in text
    assert f"which is {value} ({bounds}) of it" in text
    assert ("% of the torque" in text) == said


def test_a_part_too_short_for_an_interval_refutes_only_what_does_not_fall():
    """Less than half a second is a single batch."""
    scenario, log = swinging_legs(6, NOISE, "log.period=0.005")
    rubbed = rubbing(log, 2.0, 2.0)
    right = believing(scenario, CoulombFriction({KNEE: 2.0}))
    long, short = (
        validated(*(Predictor(one, part) for one in (scenario, right)))
        for part in (rubbed, rubbed.part(slice(0, 81)))
    )
    assert long.course == "falls"
    assert short.course == "unclear"
    assert short.change.interval == (0.0, np.inf)
    assert short.change.value < 0.5
    assert not long.refutes
    assert not short.refutes
    worse = validated(*(Predictor(one, rubbed.part(slice(0, 81))) for one in (right, scenario)))
    assert worse.refutes
    # So does one long enough to say that the error falls, and which does not.
    assert dataclasses.replace(long, change=Measured(0.9, (0.7, 1.2))).refutes


@pytest.mark.parametrize("command", ["diagnose", "study"])
def test_terminal_json_and_report_are_headed_by_what_was_set_aside(
    command: str,
    swing: tuple[Scenario, Log],
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
):
    """The rest of the log gets worse, another log better."""
    if command == "diagnose":
        monkeypatch.setattr(
            "fbse_drake.analysis.write_diagnosis_report",
            lambda path, diagnosis, *_: path.write_text(diagnosis_outcome(diagnosis)),
        )
    function = {
        "diagnose": fbse_drake.diagnose,
        "study": functools.partial(fbse_drake.study, rollouts=False),
    }[command]
    monkeypatch.setattr(f"fbse_drake.commands.{command}", functools.partial(function, effects=FEW))
    scenario, log = swing
    write_text(tmp_path / "legs.yaml", dump_scenario(scenario, "legs"))
    rubbing(log, 2.0, -2.0).save(tmp_path / "log.npz")
    rubbing(log, 2.0, 2.0).save(tmp_path / "other.npz")
    out = tmp_path / "out"
    paths = [str(tmp_path / name) for name in ("legs.yaml", "log.npz", "other.npz")]
    assert main([command, *paths[:2], "--test", paths[2], "--out", str(out)]) == DONE
    printed = " ".join(capsys.readouterr().out.split())
    assert "Not confirmed: on the rest of the log, which was set aside, the error rises" in printed
    assert "On other, which was set aside, the error falls" in printed
    kind = {"diagnose": "diagnosis", "study": "study"}[command]
    content = json.loads((out / f"{kind}.json").read_text())
    courses = {name: one["course"] for name, one in content["set_aside"].items()}
    assert courses == {"rest of the log": "rises", "other": "falls"}
    rest = content["set_aside"]["rest of the log"]
    low, high = rest["change"]["interval"]
    assert 1.0 < low < rest["change"]["value"] < high
    assert rest["level"] == 0.95
    report = (out / "report.html").read_text()
    assert "Not confirmed: on the rest of the log" in report
    assert "On data set aside" in report or command == "diagnose"


def test_a_study_keeps_plain_identification_where_that_leaves_less(
    swing: tuple[Scenario, Log], monkeypatch: pytest.MonkeyPatch
):
    """A search that finds the wrong thing: inertia and plain friction are taken in its place."""
    scenario, log = swing
    scenario = dataclasses.replace(scenario, identify=IdentifyConfig(inertia=["left_shank"]))
    log = rubbing(log, 2.0, 2.0)
    plain = identify(scenario, log)
    wrong = dataclasses.replace(
        diagnose(Predictor(scenario, log), FEW),
        ranking=(
            Finding(
                "TorqueBias", (KNEE,), 9.0, 1.0, {"bias": Estimate(1.5, (1.4, 1.6), "Nm")}, (), True
            ),
        ),
        held_out_after=0.5,
    )
    search = "fbse_drake.discrepancy.diagnosis.study.diagnose_confirmed"
    monkeypatch.setattr(search, lambda *_, **__: wrong)
    result = study(scenario, log, FEW, rollouts=False)
    first, last = (result.steps[k].errors["train"].relative_by_joint[KNEE] for k in (0, -1))
    assert last < 0.2 * first
    assert last == pytest.approx(plain.after["train"].relative_by_joint[KNEE], rel=1e-6)
    assert {f.effect for f in result.steps[1].added} >= {
        "InertialParameters",
        "CoulombViscousFriction",
    }
    # What such a search proposes next makes it worse, and is left.
    assert len(result.steps) == 2
