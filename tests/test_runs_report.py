"""Runs beside each other: which is best, by how much, and pictures that can be compared by eye."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from test_report import joints_only_log, walking_log

from fbse_drake import Log
from fbse_drake.cli import BAD_INPUT, DONE, main
from fbse_drake.report.figures import joints, walk
from fbse_drake.report.figures.kind import FigureKind
from fbse_drake.report.html import FigureBlock
from fbse_drake.report.runs import Merit, figure_row, read_runs


def tracking_worse(log: Log, factor: float) -> Log:
    """The same run with a tracking error that is so many times as large."""
    angle = log["truth/joint/position"]
    error = log["reference/joint/position"] - angle
    return Log(log.channels | {"reference/joint/position": angle + factor * error}, log.meta)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """A run, and one that tracks half as well and stopped its clock."""
    good, bad = tmp_path / "good", tmp_path / "bad"
    for folder, log in ((good, walking_log()), (bad, tracking_worse(walking_log(), 2.0))):
        folder.mkdir()
        log.save(folder / "log.npz")
    measured = {"wall_time": 2.0, "real_time_factor": 1.995, "tick_us": None}
    (bad / "metrics.json").write_text(json.dumps(measured))
    return good, bad


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """All figures are empty, which saves the time to draw them."""
    monkeypatch.setattr(FigureKind, "block", lambda kind, _: FigureBlock(kind.title, "", Figure))


def strict(path: Path) -> dict:
    """JSON as other languages' readers take it."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


@pytest.mark.usefixtures("undrawn")
def test_the_same_numbers_are_in_table_and_json(folders: tuple[Path, Path], tmp_path: Path):
    out = tmp_path / "out"
    assert main(["report", *map(str, folders), "--out", str(out), "--quiet"]) == DONE
    content = strict(out / "report.json")
    assert list(content["runs"]) == ["good", "bad"]
    assert len(content["log_sha256"]) == 2
    tracking = content["figures"]["Joint tracking error, RMS, mean of the joints"]
    assert tracking["values"] == pytest.approx({"good": 1.0, "bad": 2.0})
    assert tracking["relative_differences"] == pytest.approx({"good": 0.0, "bad": 1.0})
    assert tracking["best"] == ["good"]
    # Equal in both, so nobody is best.
    assert content["figures"]["CoM error in x, mean"]["best"] == []
    # What only one run knows is no competition.
    speed = content["figures"]["Length per wall time"]
    assert speed["values"] == {"good": None, "bad": 1.995}
    assert speed["best"] == []
    knee = content["joints"]["Tracking error, RMS"]["left knee"]
    assert knee["values"] == pytest.approx({"good": 1.0, "bad": 2.0})
    page = (out / "report.html").read_text(encoding="utf-8")
    assert '1.00 <span class="mark">best</span>' in page
    assert '2.00 <span class="note">+100 %</span>' in page


@pytest.mark.parametrize(
    ("better", "values", "best"),
    [
        ("lower", (3.0, 1.0, 2.0), (1,)),
        ("higher", (3.0, 1.0, 2.0), (0,)),
        (None, (3.0, 1.0, 2.0), ()),
        # As far as is shown, the first two are equal.
        ("lower", (1.0001, 1.0, 2.0), (0, 1)),
        ("lower", (1.0001, 1.0, 1.0), ()),
        ("lower", (math.nan, 2.0, 1.0), (2,)),
        ("lower", (math.nan, math.nan, 1.0), ()),
        ("lower", (math.inf, 2.0, 1.0), (2,)),
    ],
)
def test_the_best_is_marked_where_runs_differ(better, values, best):
    assert Merit("error", "mm", better, values).best == best


def test_differences_are_shares_of_the_first():
    np.testing.assert_allclose(Merit("", "", None, (-2.0, -1.0)).differences, [0.0, 0.5])
    assert np.isnan(Merit("", "", None, (0.0, 1.0)).differences).all()
    assert np.isnan(Merit("", "", None, (math.nan, 1.0)).differences).all()


@pytest.mark.parametrize("kind", [joints.torques, walk.footprints])
def test_pictures_of_runs_have_the_same_axes(kind: FigureKind, tmp_path: Path):
    log = walking_log()
    shift = {
        "joint/torque_command": 10 * log["joint/torque_command"],
        "truth/com/position": log["truth/com/position"] + [0.5, 0.2, 0.0],
    }
    for name, one in (("a", log), ("b", Log(log.channels | shift, log.meta))):
        one.save(tmp_path / f"{name}.npz")
    runs = read_runs([tmp_path / "a.npz", tmp_path / "b.npz"])
    alone = [kind(run.log).axes for run in runs]
    row = figure_row(kind, runs)
    assert [name for name, _ in row.drawings] == ["a", "b"]
    assert row.caption.endswith("The same axes in all runs.")
    for panel, (first, second) in enumerate(
        zip(*(draw().axes for _, draw in row.drawings), strict=True)
    ):
        assert first.get_xlim() == second.get_xlim()
        assert first.get_ylim() == second.get_ylim()
        for axes in alone:
            for name in ("xlim", "ylim"):
                low, high = getattr(first, f"get_{name}")()
                own_low, own_high = getattr(axes[panel], f"get_{name}")()
                assert low <= own_low < own_high <= high


def test_robots_with_other_joints_keep_their_own_axes(tmp_path: Path):
    walking_log().save(tmp_path / "walker.npz")
    joints_only_log().save(tmp_path / "arm.npz")
    runs = read_runs([tmp_path / "walker.npz", tmp_path / "arm.npz"])
    assert "axes of its own" in figure_row(joints.joint_angles, runs).caption
    # Only one has feet.
    assert [name for name, _ in figure_row(walk.feet, runs).pictures] == ["walker"]
    assert figure_row(walk.feet, runs[1:]) is None


@pytest.mark.usefixtures("undrawn")
def test_a_run_that_fell_is_said(tmp_path: Path, capsys: pytest.CaptureFixture):
    for name, fell in (("stood", False), ("fell", True)):
        walking_log(fell=fell).save(tmp_path / f"{name}.npz")
    logs = [str(tmp_path / "stood.npz"), str(tmp_path / "fell.npz")]
    assert main(["report", *logs, "--out", str(tmp_path / "out")]) == DONE
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Not all came to their end: fell." in page
    assert "fell: &lt;tilted&gt;" in page
    assert 'class="outcome failed"' in page
    assert "side by side" in capsys.readouterr().out


def test_runs_of_one_name_are_told_apart(tmp_path: Path):
    for name in ("a", "b"):
        (tmp_path / name / "walk").mkdir(parents=True)
        walking_log().save(tmp_path / name / "walk" / "log.npz")
    paths = [tmp_path / name / "walk" for name in ("a", "b")]
    assert [run.name for run in read_runs(paths)] == list(map(str, paths))


@pytest.mark.parametrize(
    ("runs", "complaint"),
    [
        (["good"], "expected at least two runs"),
        (["good", "good/log.npz"], "good/log.npz: a run is given twice"),
        (["good", "empty"], "empty: no log.npz"),
        (["good", "nowhere.npz"], "nowhere.npz"),
        (["good", "damaged"], "damaged/metrics.json: not a JSON file"),
    ],
)
def test_bad_input_is_one_line(
    runs: list[str],
    complaint: str,
    folders: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
):
    (tmp_path / "empty").mkdir()
    folders[1].rename(tmp_path / "damaged")
    (tmp_path / "damaged" / "metrics.json").write_text("{")
    out = tmp_path / "out"
    assert main(["report", *(str(tmp_path / run) for run in runs), "--out", str(out)]) == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line
    assert not out.exists()


def test_metrics_of_another_shape_are_not_taken(folders: tuple[Path, Path]):
    for content in ("[]", '{"wall_time": "long", "tick_us": [1]}'):
        (folders[1] / "metrics.json").write_text(content)
        run = read_runs(folders)[1]
        assert math.isnan(run.metrics["wall_time"])
        assert math.isnan(run.metrics["tick_us"]["median"])
