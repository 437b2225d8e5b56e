"""Campaigns: every run becomes one row, whatever dies in between, and rows do not depend on who
made them."""

import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

from fbse_drake import Log, load_scenario, simulate
from fbse_drake.cli import BAD_INPUT, DONE, main
from fbse_drake.discrepancy.diagnosis.study import study
from fbse_drake.discrepancy.exercises.hidden import make_exercise
from fbse_drake.errors import InputError
from fbse_drake.estimation import estimate
from fbse_drake.report.metrics import run_metrics

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")

import pyarrow as pa
import pyarrow.parquet as pq
from distributed import LocalCluster

from benchmarks import hidden
from benchmarks.store import Runs
from fbse_drake import schema
from fbse_drake.campaign import cluster as campaign_cluster
from fbse_drake.campaign.campaign import Campaign, dump_campaign, load_campaign
from fbse_drake.campaign.cluster import Outcome, run_campaign
from fbse_drake.campaign.design import Choice, Grid, Listed, LogUniform, Normal, Random, Uniform
from fbse_drake.campaign.rows import Folder, units_of
from fbse_drake.campaign.steps import Call, Estimate, Hide, Simulate, Study
from fbse_drake.campaign.table import Summary, groups, picture, usual_groups
from fbse_drake.campaign.workers import local_cluster

STEPS = """
import time

def area(material, file, pause=0.0):
    with open(file, "a") as ran:
        ran.write(f"{material.seed} {material.values['side']}\\n")
    time.sleep(pause)
    if material.seed == 7:
        raise RuntimeError("out of luck")
    side = material.values["side"]
    return {"area": side**2, "corners": 4, "large": side > 1}
"""


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a scheduler with a worker in this process."""
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


def squares(folder: Path, design: Grid | Random | Listed, pause: float = 0.0) -> Campaign:
    (folder / "steps.py").write_text(STEPS)
    arguments = {"file": str(folder / "ran.txt"), "pause": pause}
    gives = {"area": "m^2", "corners": "whole", "large": "truth"}
    call = Call(f"{folder}/steps.py:area", gives=gives, arguments=arguments)
    return Campaign({"square": call}, design=design)


def ran(folder: Path) -> Counter[str]:
    """How often each run was begun."""
    path = folder / "ran.txt"
    return Counter(path.read_text().splitlines()) if path.exists() else Counter()


def test_a_random_design_draws_what_it_says_and_a_longer_one_begins_with_it():
    values = {"a": Uniform(1, 3), "b": LogUniform(0.1, 10), "c": Normal(5, 2), "d": Choice(["x"])}
    points = list(Random(500, values).points())
    assert list(Random(20, values).points()) == points[:20]
    assert [point.seed for point in points[:3]] == [0, 1, 2]
    drawn = {key: np.array([point.values[key] for point in points]) for key in "abc"}
    assert kstest(drawn["a"], "uniform", (1, 2)).pvalue > 1e-3
    assert kstest(np.log10(drawn["b"]), "uniform", (-1, 2)).pvalue > 1e-3
    assert kstest(drawn["c"], "norm", (5, 2)).pvalue > 1e-3
    assert list(Random(20, values, seed=1).points()) != points[:20]


def test_a_grid_has_every_combination_once(tmp_path: Path):
    design = Grid({"side": [1.0, 2.0, 2.0], "name": ["a", "b"]}, seeds=2, first_seed=5)
    runs = squares(tmp_path, design).runs
    assert sorted((run.seed, run.values["side"], run.values["name"]) for run in runs) == [
        (seed, side, name) for seed in (5, 6) for side in (1.0, 2.0) for name in "ab"
    ]
    longer = squares(tmp_path, Grid(design.values, seeds=3, first_seed=5)).runs
    assert {run.key for run in runs} < {run.key for run in longer}


def test_every_run_becomes_a_row_and_a_failed_one_its_line(tmp_path: Path, scheduler: str):
    campaign = squares(tmp_path, Grid({"side": [0.5, 3.0]}, seeds=8))
    outcome = run_campaign(campaign, str(tmp_path / "out"), scheduler=scheduler)
    assert (outcome.total, outcome.before, outcome.done) == (16, 0, 16)
    rows = pq.read_table(tmp_path / "out/rows")
    assert rows.schema.equals(Folder(str(tmp_path / "out")).schema(), check_metadata=True)
    assert units_of(rows.schema)["square.area"] == "m^2"
    for row in rows.to_pylist():
        if row["seed"] == 7:
            assert row["failure"] == "RuntimeError: out of luck (steps.py:9)"
            assert row["square.area"] is None
        else:
            assert row["failure"] is None
            assert row["square.area"] == row["side"] ** 2
            assert row["square.large"] is (row["side"] > 1)
    table = pq.read_table(tmp_path / "out/table.parquet")
    assert table["run"].to_pylist() == [run.key for run in campaign.runs]
    assert [run.seed for run, _ in outcome.failed] == [7, 7]


def test_what_is_done_is_not_repeated_and_a_design_may_grow(tmp_path: Path, scheduler: str):
    def run(design: Grid) -> Outcome:
        return run_campaign(squares(tmp_path, design), str(tmp_path / "out"), scheduler=scheduler)

    run(Grid({"side": [1.0]}, seeds=3))
    assert run(Grid({"side": [1.0]}, seeds=3)).done == 0
    assert run(Grid({"side": [1.0, 2.0]}, seeds=4)).done == 5
    assert set(ran(tmp_path).values()) == {1}
    with pytest.raises(InputError, match="has 4 rows of runs that this campaign does not have"):
        run(Grid({"side": [1.0]}, seeds=4))


def test_rows_of_other_columns_are_refused(tmp_path: Path, scheduler: str):
    out = tmp_path / "out"
    run_campaign(squares(tmp_path, Grid({"side": [1.0]})), str(out), scheduler=scheduler)
    for path in (out / "rows").glob("*.parquet"):
        path.unlink()
    other = squares(tmp_path, Grid({"side": [1.0], "length": [1]}))
    with pytest.raises(InputError, match=r"another campaign \(columns: length\)"):
        run_campaign(other, str(out), scheduler=scheduler)


def test_the_row_of_a_simulation_is_that_of_a_plain_simulation(tmp_path: Path, scheduler: str):
    campaign = Campaign(
        {"squat": Simulate()},
        scenarios=["squat"],
        set=["duration=0.05"],
        design=Listed([{"reference.frequency": f, "seed": k} for k, f in enumerate((0.3, 0.5))]),
        logs=True,
    )
    run_campaign(campaign, str(tmp_path), scheduler=scheduler)
    rows = Folder(str(tmp_path)).table()
    assert len(rows) == 2
    for row in rows.to_pylist():
        changes = [f"{key}={row[key]}" for key in ("seed", "reference.frequency")]
        log = simulate(load_scenario("squat", overrides=["duration=0.05", *changes])).log
        tracking = run_metrics(log, 1.0)["joint_tracking_rms"]
        assert {joint: row[f"squat.joint_tracking_rms.{joint}"] for joint in tracking} == tracking
        kept = Log.load(tmp_path / row["log"])
        assert all(np.array_equal(kept[name], log[name]) for name in log)
    assert units_of(rows.schema)["squat.joint_tracking_rms.left_knee_pitch"] == "rad"


def test_a_scenario_that_cannot_be_built_is_refused_before_anything_runs(
    tmp_path: Path, scheduler: str
):
    campaign = Campaign(
        {"walk": Simulate()}, scenarios=["squat"], design=Grid({"reference.lenght": [1.0]})
    )
    with pytest.raises(InputError, match=r"reference\.lenght: unknown key"):
        run_campaign(campaign, str(tmp_path / "out"), scheduler=scheduler)
    assert not (tmp_path / "out").exists()


def test_a_killed_worker_loses_what_it_was_doing_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The worker is killed once some rows are there, by the look after the progress."""
    campaign = squares(tmp_path, Grid({"side": [2.0]}, seeds=7), pause=0.05)
    clusters, before = [], []

    @contextmanager
    def cluster(workers: int | None) -> Iterator[LocalCluster]:
        with local_cluster(workers) as made:
            clusters.append(made)
            yield made

    def kill_once(text: str, share: float = 0.0) -> None:  # noqa: ARG001
        rows = list((tmp_path / "out/rows").glob("*.parquet"))
        if len(rows) >= 3 and not before:
            before.extend(pq.read_table(path)["seed"][0].as_py() for path in rows)
            (nanny,) = clusters[0].workers.values()
            os.kill(nanny.pid, signal.SIGKILL)

    monkeypatch.setattr(campaign_cluster, "local_cluster", cluster)
    outcome = run_campaign(campaign, str(tmp_path / "out"), workers=1, progress=kill_once)
    assert before
    assert outcome.done == 7
    rows = pq.read_table(tmp_path / "out/rows")
    assert sorted(rows["seed"].to_pylist()) == list(range(7))
    assert rows["failure"].null_count == 7
    begun = ran(tmp_path)
    assert all(begun[f"{seed} 2.0"] == 1 for seed in before)
    assert sum(begun.values()) <= 8


def test_campaign_files_are_read_and_written(tmp_path: Path):
    text = """
title: Friction and step length
scenarios: [paper_walk]
set: [duration=3]
steps: {walk: !Simulate {}, estimate: !Estimate {set: ["estimator=!Fbse {}"]}}
design: !Random
  runs: 3
  values: {reference.step_length: !Uniform {low: 0.05, high: 0.1},
    ground: !Choice {of: [{slope: [0.0, 0.0]}]}}
"""
    (tmp_path / "a.yaml").write_text(text)
    campaign = load_campaign(tmp_path / "a.yaml")
    (tmp_path / "b.yaml").write_text(dump_campaign(campaign))
    assert load_campaign(tmp_path / "b.yaml") == campaign
    kinds = {column.name: column.kind for column in campaign.columns}
    assert kinds["ground"] == "text"
    assert kinds["reference.step_length"] == "number"
    assert kinds["estimate.friction_nrmse.swing.left_knee_pitch"] == "number"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps: {}", "steps: expected at least one, found none"),
        ("steps: {a: !Simulat {}}", "expected one of !Simulate"),
        ("steps: {a: !Simulate {}}\nsceanrios: [squat]", "did you mean scenarios?"),
        ("steps: {run: !Simulate {}}", "run: there is a column of this name"),
        ("steps: {a: !Simulate {}}\ndesign: !Grid {values: {a.b: [1]}}", "begins so too"),
        ("steps: {a: !Simulate {}}\ndesign: !Grid {seeds: 0}", "seeds: expected a number > 0"),
        (
            (
                "steps: {a: !Simulate {}}\ndesign: !Random {runs: 2, values: {b: !Uniform {low: 1, "
                "high: 0}}}"
            ),
            "high: expected more than low",
        ),
        ("steps: {a: !Simulate {}}", "steps.a: this step needs a scenario"),
        ("steps: {a: !Hide {size: huge}}", "expected one of small, medium, large; found 'huge'"),
    ],
)
def test_a_bad_file_gets_one_line(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture
):
    (tmp_path / "bad.yaml").write_text(text)
    out = tmp_path / "out"
    assert main(["campaign", str(tmp_path / "bad.yaml"), "--out", str(out)]) == BAD_INPUT
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_without_the_extra_there_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    for name in [n for n in sys.modules if n.startswith("fbse_drake.campaign.")]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("distributed", "pyarrow"):
        monkeypatch.setitem(sys.modules, name, None)
    for command in (["campaign", str(tmp_path / "a.yaml")], ["table", str(tmp_path)]):
        assert main(command) == BAD_INPUT
        error = capsys.readouterr().err
        assert "pip install 'fbse_drake[cluster]'" in error
        assert error.count("\n") == 1


def test_intervals_hold_the_true_median_and_share_as_often_as_they_say():
    random, held = np.random.default_rng(0), []
    for _ in range(200):
        numbers = Summary.of(pa.array(random.lognormal(0.0, 1.0, 25)))
        shares = Summary.of(pa.array(random.random(60) < 0.3))
        held.append((numbers.low <= 1.0 <= numbers.high, shares.low <= 0.3 <= shares.high))
    assert (np.mean(held, axis=0) > 0.91).all()
    assert np.mean(held) < 0.995
    assert np.isnan(Summary.of(pa.array([1.0, 2.0, None])).low)


def test_a_table_of_many_values_has_a_row_for_each(
    tmp_path: Path, scheduler: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    """Side by side they would not fit; names are not cut."""
    out = tmp_path / "out"
    campaign = squares(tmp_path, Grid({"side": [1.0, 2.0]}, seeds=2))
    run_campaign(campaign, str(out), scheduler=scheduler)
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["table", str(out), "--by", "seed", "--value", "square.area"]) == DONE
    assert "square.area" in capsys.readouterr().out
    values = [f"a_rather_long_name_of_value_{k}" for k in range(9)]
    monkeypatch.setattr("fbse_drake.campaign.table.figures", lambda *_: values)
    monkeypatch.setattr(
        "fbse_drake.campaign.table.summary_rows", lambda *_: [(0, 2, 0, *[0.5] * 27)]
    )
    monkeypatch.setattr("fbse_drake.campaign.rows.units_of", lambda _: dict.fromkeys(values, "1"))
    assert main(["table", str(out), "--by", "seed"]) == DONE
    shown = capsys.readouterr().out
    assert all(value in shown for value in values)
    assert shown.count("0.500 (0.500 to 0.500)") == len(values)


def test_a_table_groups_by_the_design_and_draws(tmp_path: Path, scheduler: str):
    sides = [1.0, 2.0, 3.0]
    campaign = squares(tmp_path, Grid({"side": sides}, seeds=8))
    out = tmp_path / "out"
    run_campaign(campaign, str(out), scheduler=scheduler)
    rows = Folder(str(out)).table()
    assert usual_groups(rows) == ["side"]
    found = groups(rows, ["side"])
    assert [group.same["side"] for group in found] == sides
    assert [group.failed for group in found] == [1, 1, 1]
    axes = picture(rows, "square.area", "side", ["side"]).axes[0]
    drawn = np.vstack([collection.get_offsets() for collection in axes.collections[:1]])
    assert len(drawn) == 21
    assert np.allclose(drawn[:, 1], drawn[:, 0] ** 2)

    arguments = ["table", str(out), "--plot", "square.area", "side", "--quiet"]
    assert main(arguments) == DONE
    assert (out / "square.area_over_side.png").stat().st_size > 1000
    lines = (out / "groups.csv").read_text().splitlines()
    assert lines[0].startswith("side,runs,failed,square.area,square.area from")
    assert lines[2].startswith("2.0,8,1,4.0")
    assert main([*arguments[:2], "--value", "square.volume"]) == BAD_INPUT
    assert main(["table", str(tmp_path)]) == BAD_INPUT
    assert main(["table", "memory://nowhere"]) == BAD_INPUT


def test_a_stopped_campaign_goes_on(tmp_path: Path, scheduler: str):
    """Rows of another time are kept as they are, to the last bit of their files."""
    campaign = squares(tmp_path, Grid({"side": [2.0]}, seeds=6))
    out = tmp_path / "out"
    run_campaign(campaign, str(out), scheduler=scheduler)
    files = sorted((out / "rows").glob("*.parquet"))
    whole = {path.name: path.read_bytes() for path in files}
    for path in files[:2]:
        path.unlink()
    # What a command that was killed leaves behind.
    (out / "rows" / f".{files[0].name}.0123.part").write_bytes(b"half")
    times = {path: path.stat().st_mtime_ns for path in files[2:]}
    time.sleep(0.01)
    assert run_campaign(campaign, str(out), scheduler=scheduler).done == 2
    assert {path.name: path.read_bytes() for path in files} == whole
    assert {path: path.stat().st_mtime_ns for path in files[2:]} == times
    assert len(pq.read_table(out / "rows")) == 6


def test_cases_of_hidden_physics_come_back_from_plain_values():
    """As a worker gets them."""
    some = [*hidden.cases(1, ("large",), quick=True), *hidden.length_cases()]
    assert any(case.answer is not None for case in some)
    for case in some:
        assert schema.build(hidden.Case, asdict(case), file="", key="case") == case


def test_runs_of_a_benchmark_that_other_sources_made_are_forgotten(tmp_path: Path, scheduler: str):
    (tmp_path / "walk.py").write_text(
        "def walk(material):\n"
        "    return {'sources': material.values['sources'], 'result': str(material.seed)}\n"
    )
    values = [{"seed": k, "sources": "new" if k else "old"} for k in range(3)]

    def runs(sources: str | None) -> Runs:
        return Runs(tmp_path / "out", f"{tmp_path}/walk.py:walk", values, sources)

    run_campaign(runs(None).campaign, str(tmp_path / "out"), scheduler=scheduler)
    assert runs(None).results() == [0, 1, 2]
    assert runs("new").results() == [1, 2]
    assert runs(None).results() == [1, 2]


PENDULUM = """
pendulum:
  duration: 5
  robot: {description: pendulum}
  reference: !JointSines {amplitude: {servo: 0.6}, frequency: {servo: 0.7}, ramp: 0.5}
  control: {kp: {all: 100}, kd: {all: 2}}
  sensors: {encoders: {velocity_noise: 1.0e-4}}
"""


def test_steps_hand_on_what_they_made(tmp_path: Path, scheduler: str):
    """Hidden, then found: the row says what exercise and study say by themselves."""
    path = tmp_path / "pendulum.yaml"
    path.write_text(PENDULUM)
    campaign = Campaign(
        {"hide": Hide(what="CoulombFriction", size="large"), "study": Study()},
        scenarios=[str(path)],
        design=Grid(seeds=1),
    )
    run_campaign(campaign, str(tmp_path / "out"), scheduler=scheduler)
    (row,) = Folder(str(tmp_path / "out")).table().to_pylist()
    scenario = load_scenario(str(path), overrides=["seed=0"])
    exercise = make_exercise(scenario, "pendulum", 0, what="CoulombFriction", size="large")
    alone = study(exercise.scenario, exercise.log, rollouts=False)
    assert row["failure"] is None
    assert (row["hide.effects"], row["hide.targets"]) == ("CoulombFriction", "servo")
    assert row["study.added"] == ", ".join(found.effect for found in alone.found)
    assert row["study.held_out_before"] == alone.steps[0].held_out_rmse
    assert row["study.held_out_after"] == alone.steps[-1].held_out_rmse
    assert all(row[f"study.{name}"] for name in ("right_verdict", "all_found", "first"))
    assert row["study.held_out_after"] < 0.5 * row["study.held_out_before"]


def test_an_estimate_is_that_of_the_log_of_the_step_before(tmp_path: Path, scheduler: str):
    """With two settings: each sees the log as it was recorded, not the other's estimate."""
    settings = ["estimator=!DisturbanceObserver {}"]
    slow = ["estimator=!DisturbanceObserver {bandwidth: 1.0}"]
    campaign = Campaign(
        {"walk": Simulate(), "quick": Estimate(set=settings), "slow": Estimate(set=slow)},
        scenarios=["sway"],
        set=["duration=0.5"],
        design=Grid(seeds=1),
    )
    run_campaign(campaign, str(tmp_path), scheduler=scheduler)
    (row,) = Folder(str(tmp_path)).table().to_pylist()
    log = simulate(load_scenario("sway", overrides=["duration=0.5", "seed=0"])).log
    for name, changed in (("quick", settings), ("slow", slow)):
        scenario = load_scenario("sway", overrides=["duration=0.5", "seed=0", *changed])
        found = run_metrics(estimate(scenario, log).log, 1.0)["friction_rmse"]["stance"]
        assert found == {joint: row[f"{name}.friction_rmse.stance.{joint}"] for joint in found}
        assert np.isfinite(list(found.values())).all()
    joint = "friction_rmse.stance.left_knee_pitch"
    assert row[f"quick.{joint}"] != row[f"slow.{joint}"]
