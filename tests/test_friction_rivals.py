"""Every method of estimating the friction against each other: `fbse rivals`."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import scenario
from scipy.stats import t as student

from fbse_drake import Log, build_station, load_scenario
from fbse_drake.cli import BAD_INPUT, DONE, main
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, law_over_time
from fbse_drake.errors import InputError
from fbse_drake.estimation import estimate, friction_estimates
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.estimator import NoEstimator
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.fixed_friction import FixedFriction
from fbse_drake.estimators.radial_basis import RadialBasisFriction
from fbse_drake.estimators.torque_sensor import TorqueSensor
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import dump_scenario
from fbse_drake.walking.walk import Walk

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")

from fbse_drake.campaign.steps import Material
from fbse_drake.report.rivals import ahead_text, error_table, write_rivals_report
from fbse_drake.rivals import methods as rival_methods
from fbse_drake.rivals import runs
from fbse_drake.rivals.cases import CASES, NOMINAL, without_friction
from fbse_drake.rivals.comparison import Comparison, Mean, comparison_json
from fbse_drake.rivals.methods import OURS, Method, Tuned, candidates, methods, trials, tuning_walk

Run = Callable[..., Log]
WALK = load_scenario("paper_walk")


def test_every_estimator_takes_part_and_says_what_it_needs():
    found = {method.name: method for method in candidates()}
    assert {OURS, "!Fbse, the paper's", "!DisturbanceObserver", "!TorqueSensor"} < found.keys()
    assert "!TrueFriction" not in found
    for method in found.values():
        assert method.estimator.knows
        assert method.estimator.measures
        assert Method.read(method.text) == method
    assert found["!Fbse, the paper's"].estimator == (
        load_scenario("paper_walk_fbse", "paper_method").estimator
    )


def test_methods_that_do_not_fit_are_named_and_without_fbse_nothing_is_compared():
    _, unfit = methods(WALK)
    assert "!TorqueSensor" not in unfit
    with pytest.raises(InputError, match=r"nothing to compare: !Fbse: estimator: needs a robot"):
        methods(load_scenario("leg_swing_gantry"))


def test_all_are_tuned_by_the_same_budget_within_their_ranges():
    for method in candidates():
        tried = list(trials(method.estimator, 6))
        assert tried[0] == method.estimator
        assert len(tried) == (6 if method.estimator.tunable else 1)
        for key, (low, high) in method.estimator.tunable.items():
            values = [getattr(estimator, key) for estimator in tried[1:]]
            assert low <= min(values) < max(values) <= high
            # Evenly on a logarithmic scale: both halves are looked at.
            assert min(values) < np.sqrt(low * high) < max(values)
    # More trials begin with the fewer.
    observer = RadialBasisFriction()
    assert list(trials(observer, 9))[:6] == list(trials(observer, 6))


def test_side_by_side_each_tells_what_it_tells_alone(run: Run):
    """Those that share the base, one with another base, one with none, and one twice."""
    log = run("paper_walk", "duration=0.3")
    estimators = [
        DisturbanceObserver(),
        Fbse(),
        Fbse.paper(),
        FixedFriction(),
        DisturbanceObserver(bandwidth=5.0),
        RadialBasisFriction(),
        Fbse(),
    ]
    together = friction_estimates(WALK, estimators, log)
    for estimator, friction in zip(estimators, together, strict=True):
        alone = estimate(replace(WALK, estimator=estimator), log).log
        np.testing.assert_array_equal(friction, alone["estimate/joint/friction_torque"])
    assert not np.array_equal(together[0], together[4])
    with pytest.raises(InputError, match="expected estimators of the friction only"):
        friction_estimates(WALK, [Fbse(), NoEstimator()], log)


def test_the_walk_that_is_tuned_on_is_none_of_those_compared():
    tuned_on = tuning_walk(WALK)
    assert isinstance(tuned_on.reference, Walk)
    assert tuned_on.seed not in range(100)
    assert tuned_on.reference.step_length != WALK.reference.step_length
    assert tuned_on.robot == WALK.robot


def test_the_offline_model_is_that_of_the_log_it_is_identified_from(run: Run):
    log = run("paper_walk_fbse", "duration=0.9")
    found = FixedFriction().identified(log).model
    later = log.time > 0.5
    motion = JointMotion(log["joint/velocity"][later])
    law = found.resolve(make_robot("biped")[0].description).torque_and_slope(motion)[0]
    measured = log["estimate/joint/residual_torque"][later]
    # Least squares leaves a residual across what it explains.
    explained = (law * (measured - law)).sum(axis=0) / (law**2).sum(axis=0)
    np.testing.assert_allclose(explained, 0.0, atol=0.05)


def test_cases_change_the_robot_and_nobody_is_told():
    for name, happen in CASES.items():
        happens = happen(WALK)
        assert happens.believed == WALK.believed
        assert happens.reference == WALK.reference
        assert (dump_scenario(happens, "a") == dump_scenario(WALK, "a")) == (name == NOMINAL)


def test_friction_grows_by_half_in_mid_walk():
    names = make_robot("biped")[0].description
    before, after = (
        scenario.robot.effects_of(JointTorqueEffect, names, key="robot")
        for scenario in (WALK, CASES["friction grows by half"](WALK))
    )
    time = np.array([[WALK.duration / 2 - 0.01], [WALK.duration / 2 + 0.01]])
    motion = JointMotion(np.full((2, 12), 0.1), np.zeros((2, 12)), time=time)
    law, grown = law_over_time(before, motion), law_over_time(after, motion)
    np.testing.assert_allclose(grown[0], law[0])
    np.testing.assert_allclose(grown[1], 1.5 * law[1], rtol=1e-6)
    assert not without_friction(WALK).robot.effects


def test_a_push_moves_the_centre_of_mass_as_newton_says(run: Run):
    """What neither feet nor weight explain of the robot's vertical momentum is the push."""
    lifted = "robot.pushes.lift={body: trunk, force: [0, 0, 120], start: 0.1, duration: 0.1}"
    log = run("squat", "duration=0.3", lifted, noise=False)
    load = sum(log[f"truth/foot/{side}/pad_force"][:, :, 2].sum(axis=1) for side in log.sides)
    plant = make_robot("biped")[0].plant
    mass = plant.CalcTotalMass(plant.CreateDefaultContext())
    rate = mass * np.diff(log["truth/com/velocity"][:, 2]) / log.meta["period"]
    pushed = rate + mass * 9.81 - load[1:]
    begun = log.time[:-1] + 1e-9
    np.testing.assert_allclose(pushed, 120.0 * ((begun >= 0.1) & (begun < 0.2)), atol=0.5)


def test_a_push_on_no_body_gets_one_line():
    push = "robot.pushes.a={body: tail, force: [1, 0, 0], start: 0, duration: 1}"
    pushed = load_scenario("squat", overrides=["duration=0.1", push])
    with pytest.raises(InputError, match=r"pushes\.a\.body: tail: the model has no body"):
        build_station(pushed)


def test_a_mean_has_students_interval():
    values = np.array([0.3, 0.5, 0.4, 0.8])
    low, high = student.interval(0.95, 3, values.mean(), values.std(ddof=1) / 2)
    assert vars(Mean.of(values)) == pytest.approx(
        {"value": values.mean(), "low": low, "high": high}
    )
    assert np.isnan(Mean.of([0.3]).low)
    assert np.isnan(Mean.of([0.3, np.nan]).value)


def made_up() -> Comparison:
    """Two seeds of FBSE and an observer that is better in one joint and phase."""
    tuned = [
        Tuned(Method(Fbse()), 1, 0.1, 0.1),
        Tuned(Method(DisturbanceObserver()), 4, 0.5, 0.4),
    ]
    comparison = Comparison(tuned, {"!Other": "it cannot"})
    for seed in range(2):
        errors = {
            name: {"stance": {"hip": hip, "knee": 0.2}, "swing": {"hip": 0.4, "knee": 0.1 + seed}}
            for name, hip in ((OURS, 0.1), ("!DisturbanceObserver", 0.05))
        }
        watched = {name: {"nrmse": of, "tick": 10.0} for name, of in errors.items()}
        comparison.add_watched(NOMINAL, seed, {"failure": None, "watched": watched})
        comparison.add_watched("a push", seed, {"failure": "fell", "watched": watched})
    tracking = {
        runs.UNCOMPENSATED: 5.0,
        runs.ORACLE: 1.0,
        runs.FRICTIONLESS: 1.0,
        OURS: 2.0,
        "!DisturbanceObserver": 7.0,
    }
    comparison.add_loops(
        {
            (who, seed): {
                "failure": None if who != "!DisturbanceObserver" else "fell",
                "tracking": value,
                "com": [[value + seed, 0.0]] * 5,
            }
            for who, value in tracking.items()
            for seed in range(2)
        }
    )
    return comparison


def test_what_is_recovered_is_a_share_of_what_the_true_friction_takes_away():
    comparison = made_up()
    assert comparison.recovered(OURS, "tracking").value == pytest.approx(0.75)
    assert comparison.recovered("!DisturbanceObserver", "tracking").value == pytest.approx(-0.5)
    # The centre of mass of the walk without friction is as far away as the tracking error differs.
    assert comparison.loop(OURS, "com_deviation").value == pytest.approx(1.0)
    assert comparison.recovered(OURS, "com_deviation").value == pytest.approx(0.75)
    assert comparison.falls("!DisturbanceObserver") == 2
    # Where there is nothing to win, nobody wins.
    nothing = Comparison(comparison.tuned, {})
    nothing.add_loops(
        {
            (who, 0): {"failure": None, "tracking": value, "com": [[0.0, 0.0]]}
            for who, value in ((runs.UNCOMPENSATED, 1.0), (runs.ORACLE, 0.99), (OURS, 0.9))
        }
    )
    assert np.isnan(nothing.recovered(OURS, "tracking").value)


def test_who_is_ahead_is_said_joint_by_joint(tmp_path: Path):
    comparison = made_up()
    (ahead,) = comparison.ahead()
    assert (ahead.method, ahead.phase, ahead.joint) == ("!DisturbanceObserver", "stance", "hip")
    assert "!DisturbanceObserver is ahead of !Fbse in hip in stance" in ahead_text(comparison)
    assert comparison.error(NOMINAL, OURS, ("stance",)).value == pytest.approx(np.sqrt(0.02))
    content = json.loads(json.dumps(comparison_json(comparison)))
    assert content["methods"][OURS]["friction_nrmse"][NOMINAL]["by_joint"]["swing"]["hip"] == (
        pytest.approx({"value": 0.4, "low": 0.4, "high": 0.4})
    )
    assert content["not_compared"] == {"!Other": "it cannot"}
    assert [row[0] for row in error_table(comparison).rows] == [OURS, "!DisturbanceObserver"]
    write_rivals_report(tmp_path / "report.html", comparison, name="walk", seeds=2, scenario="a: b")
    text = (tmp_path / "report.html").read_text()
    for part in ("!DisturbanceObserver", "Not compared: !Other", "a push, seed 0: fell"):
        assert part in text


def test_runs_tune_watch_and_feed_back(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Each on a moment of a walk: the sensor's cut-off is the best of those that are tried, all
    watch the same log, and what is compensated is what was estimated."""
    monkeypatch.setattr(rival_methods, "START", 0.15)
    short = replace(scenario("paper_walk"), duration=0.4)
    text = dump_scenario(short, "walk")
    sensor = Method(TorqueSensor())

    def done(give: dict[str, str]) -> dict:
        return json.loads(give["result"])

    walk = tuning_walk(rival_methods.measured(short))
    log = runs.simulate(runs.unobserved(walk)).log
    log.save(tmp_path / "log.npz")
    values = {"method": sensor.text}
    tuned = runs.read_tuned(
        done(runs.tuning(Material(0, values), text, str(tmp_path / "log.npz"), 4))
    )
    tried = {
        estimator.cutoff: rival_methods.score(estimate(replace(walk, estimator=estimator), log).log)
        for estimator in trials(TorqueSensor(), 4)
    }
    assert tuned.method.estimator.cutoff == min(tried, key=tried.__getitem__)
    assert (tuned.trials, tuned.before) == (4, tried[20.0])
    watched = done(
        runs.watching(Material(3, {"case": NOMINAL}), text, [sensor.text, tuned.method.text])
    )
    assert watched["failure"] is None
    assert watched["watched"].keys() == {"!TorqueSensor"}
    loops = {
        who: done(runs.feeding_back(Material(3, {"method": who}), text))
        for who in (runs.UNCOMPENSATED, runs.ORACLE, sensor.text)
    }
    tracking = {who: walk["tracking"] for who, walk in loops.items()}
    assert tracking[sensor.text] != tracking[runs.UNCOMPENSATED]
    assert tracking[sensor.text] == pytest.approx(tracking[runs.ORACLE], rel=0.1)


def test_the_command_writes_what_was_compared(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("fbse_drake.rivals.campaign.compare_methods", lambda *_: made_up())
    assert main(["rivals", "paper_walk", "--seeds", "2", "--out", str(tmp_path)]) == DONE
    written = {path.name for path in tmp_path.iterdir()}
    assert written >= {"rivals.json", "metrics.json", "report.html", "scenario.yaml"}
    content = json.loads((tmp_path / "rivals.json").read_text())
    assert content["seeds"] == 2
    assert content["ahead_of_fbse"][0]["joint"] == "hip"
    told = capsys.readouterr().out
    assert "!DisturbanceObserver is ahead of !Fbse in hip in stance" in told


def test_bad_input_gets_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    out = ["--out", str(tmp_path)]
    for arguments, message in (
        (["paper_walk", "--case", "rain"], "--case rain: expected one of as believed, bodies"),
        (["leg_swing_gantry"], "leg_swing_gantry: nothing to compare: !Fbse: estimator: needs"),
        (["paper_walk", "--seeds", "0"], "expected a whole number > 0, found 0"),
    ):
        assert main(["rivals", *arguments, *out]) == BAD_INPUT
        assert message in capsys.readouterr().err
