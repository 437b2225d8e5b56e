import functools
import html
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pytest

from fbse_drake import InputError, Log, diagnose, load_scenario, simulate, study
from fbse_drake.campaign.campaign import load_campaign
from fbse_drake.cli import BAD_INPUT, DONE, FAILED, main
from fbse_drake.commands import _start_meshcat
from fbse_drake.console import Console
from fbse_drake.effects.effect import library
from fbse_drake.effects.user import require_trusted
from fbse_drake.schema import load_tree
from fbse_drake.simulation import fall_reason

FILES = ["log.npz", "metrics.json", "report.html", "scenario.yaml"]
# One foot swings from 0.5 s on.
WALK = ["paper_walk_fbse", "--set", "duration=1"]


@pytest.mark.usefixtures("blank_pictures")
def test_simulate_writes_everything(tmp_path: Path, capsys: pytest.CaptureFixture):
    status = main(
        [
            "simulate",
            "squat",
            "--set",
            "duration=0.5",
            "--set",
            "seed=4",
            "--out",
            str(tmp_path / "out"),
        ]
    )
    assert status == DONE
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["fell"] is False
    assert metrics["simulated_time"] == pytest.approx(0.5)
    assert metrics["real_time_factor"] == pytest.approx(0.5 / metrics["wall_time"])
    assert set(metrics["joint_tracking_rms"]) == set(Log.load(tmp_path / "out/log.npz").joints)
    assert metrics["friction_rmse"]["stance"]["left_hip_yaw"] is None
    assert load_scenario(tmp_path / "out/scenario.yaml").seed == 4
    printed = capsys.readouterr().out
    assert "squat" in printed
    assert "report.html" in printed


@pytest.mark.usefixtures("undrawn")
def test_the_written_scenario_runs_again_to_the_same_log(tmp_path: Path):
    main(["simulate", "sway", "--set", "duration=0.2", "--out", str(tmp_path / "a"), "--quiet"])
    main(["simulate", str(tmp_path / "a/scenario.yaml"), "--out", str(tmp_path / "b"), "--quiet"])
    assert (tmp_path / "a/log.npz").read_bytes() == (tmp_path / "b/log.npz").read_bytes()


@pytest.mark.usefixtures("blank_pictures")
def test_quiet_prints_nothing(tmp_path: Path, capsys: pytest.CaptureFixture):
    assert (
        main(["simulate", "squat", "--set", "duration=0.1", "--out", str(tmp_path), "--quiet"])
        == DONE
    )
    assert capsys.readouterr() == ("", "")


@pytest.mark.usefixtures("undrawn")
def test_meshcat_is_recorded(tmp_path: Path):
    assert (
        main(
            [
                "simulate",
                "squat",
                "--set",
                "duration=0.1",
                "--meshcat",
                "--out",
                str(tmp_path),
                "--quiet",
            ]
        )
        == DONE
    )
    assert "animation" in (tmp_path / "meshcat.html").read_text()


@pytest.mark.usefixtures("blank_pictures")
def test_a_fall_ends_the_run_and_keeps_the_log(tmp_path: Path, capsys: pytest.CaptureFixture):
    options = ["--set", "duration=4.5", "--out", str(tmp_path), "--quiet"]
    assert main(["simulate", "paper_walk_pd", *options]) == FAILED
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "fell: the base is" in message
    log = Log.load(tmp_path / "log.npz")
    assert 1.0 < log.time[-1] < 4.0
    assert log.meta["outcome"]["fell"]
    assert f"t = {log.time[-1]:.3f} s" in log.meta["outcome"]["reason"]
    assert json.loads((tmp_path / "metrics.json").read_text())["fell"] is True
    assert (tmp_path / "report.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["simulat", "squat"], "invalid choice: 'simulat'"),
        (["simulate"], "the following arguments are required: SCENARIO"),
        (["estimate", "squat"], "the following arguments are required: LOG"),
        (["simulate", "squat", "--sed", "3"], "unrecognized arguments: --sed 3"),
        (["simulate", "squid"], "squid: no such file, and no such name in scenarios/"),
        (
            ["simulate", "squat", "--set", "duration=0"],
            "squat: duration: expected a number > 0, found 0",
        ),
        (["simulate", "squat", "--name", "other"], "no scenario called other (there are: squat)"),
        (
            ["simulate", "paper_walk", "--set", "reference.step_length=0.5"],
            "reference: step 2 (left leg",
        ),
        (
            ["simulate", "squat", "--set", "robot.gantry_height=1.0"],
            "a robot with a fixed base cannot follow Squat",
        ),
        (["compare", "squat"], "the following arguments are required: LOG"),
        (["diagnose", "squat", "nowhere.npz"], "nowhere.npz: No such file or directory"),
        (["add", "squat", "nowhere"], "the following arguments are required: --out"),
        (["hide", "squat"], "the following arguments are required: --seed"),
        (
            ["hide", "squat", "--seed", "-1"],
            "argument --seed: expected a whole number >= 0, found -1",
        ),
        (
            ["reveal", "nowhere"],
            "nowhere/answer.sealed: No such file or directory; fbse hide makes one",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture
):
    if "simulate" in arguments:
        arguments = [*arguments, "--out", str(tmp_path / "out")]
    assert main(arguments) == BAD_INPUT
    printed = capsys.readouterr()
    assert printed.err.startswith("fbse: ")
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("out/*"))


def test_an_output_folder_that_is_a_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture):
    (tmp_path / "file").write_text("mine")
    assert main(["simulate", "squat", "--out", str(tmp_path / "file")]) == BAD_INPUT
    assert "--out" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.usefixtures("blank_pictures")
def test_an_interrupted_run_keeps_what_was_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    """Ctrl-C while it runs: the log ends there, and everything is written."""

    def interrupted(*arguments: object) -> str | None:
        os.kill(os.getpid(), signal.SIGINT)
        return fall_reason(*arguments)

    monkeypatch.setattr(import_module("fbse_drake.simulation"), "fall_reason", interrupted)
    options = ["--set", "duration=1", "--out", str(tmp_path), "--quiet"]
    assert main(["simulate", "squat", *options]) == FAILED
    message = capsys.readouterr().err
    assert "interrupted" in message
    assert message.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == FILES
    log = Log.load(tmp_path / "log.npz")
    assert log.time[-1] == pytest.approx(0.01)
    assert log.meta["outcome"]["reason"].endswith("interrupted")


# Where the tests run in the background, these may be ignored, and so by all that they start.
HEEDED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_whatever_ends_a_command_ends_it_as_ctrl_c_does(name: str):
    """As soon as it has begun, and so also while it imports what it needs."""
    script = f"""{HEEDED}
from fbse_drake import cli
parse = cli._parser
def interrupted():
    os.kill(os.getpid(), signal.{name})
    return parse()
cli._parser = interrupted
sys.argv = ["fbse", "reveal", "nowhere"]
cli.entry()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == FAILED
    assert done.stderr == "fbse: interrupted; no file was left half-written\n"


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("ignored", [False, True])
def test_the_command_can_be_ended_before_anything_is_imported(name: str, ignored: bool):
    """Also where a shell started it in the background, so that it ignores Ctrl-C."""
    script = f"""{HEEDED}
if {ignored}:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
class Interrupter:
    def find_spec(self, name, *_):
        if name == "fbse_drake.cli":
            os.kill(os.getpid(), signal.{name})
sys.meta_path.insert(0, Interrupter())
from fbse_drake.entry import entry
assert not {{"numpy", "pydrake"}} & set(sys.modules)
sys.argv = ["fbse", "reveal", "nowhere"]
entry()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    if ignored and name == "SIGINT":
        assert done.returncode == BAD_INPUT
        return
    assert done.returncode == FAILED
    assert done.stderr == "fbse: interrupted; no file was left half-written\n"


def test_ctrl_c_while_drake_is_imported_shows_no_traceback():
    """Drake's extension modules make an ImportError of an exception in what they import."""
    script = f"""{HEEDED}
class Interrupter:
    def find_spec(self, name, *_):
        if name == "pydrake.common.cpp_param":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupter())
sys.argv = ["fbse", "reveal", "nowhere"]
from fbse_drake import cli
cli.entry()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == FAILED
    assert done.stderr == "fbse: interrupted; no file was left half-written\n"


@pytest.mark.usefixtures("blank_pictures")
def test_an_interrupted_report_leaves_no_half_written_file(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    """Ctrl-C while results are written, in the middle of the last file."""
    replace = Path.replace

    def interrupted(path: Path, target: Path) -> Path:
        if target.name == "report.html":
            os.kill(os.getpid(), signal.SIGINT)
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    # Where the tests run in the background, it would be ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    options = ["--set", "duration=0.05", "--out", str(tmp_path), "--quiet"]
    try:
        assert main(["simulate", "squat", *options]) == FAILED
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "fbse: interrupted; no file was left half-written\n"
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == [name for name in FILES if name != "report.html"]


@pytest.mark.usefixtures("blank_pictures")
def test_a_copied_scenario_does_not_overwrite_the_original(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("squat: {duration: 0.05, reference: !Squat {}}\n")
    assert main(["simulate", "mine.yaml", "--quiet"]) == DONE
    assert (tmp_path / "out/mine/log.npz").is_file()


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports are empty, which saves the time to draw them."""
    monkeypatch.setattr(
        "fbse_drake.report.run.write_run_report", lambda path, *_, **__: path.write_text("report")
    )


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a walk whose friction was estimated while it walked."""
    folder = tmp_path_factory.mktemp("walk")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "fbse_drake.report.run.write_run_report",
            lambda path, *_, **__: path.write_text("report"),
        )
        assert main(["simulate", *WALK, "--out", str(folder), "--quiet"]) == DONE
    return folder


@pytest.mark.usefixtures("undrawn")
def test_metrics_tell_the_law_error_of_every_joint(tmp_path: Path):
    options = ["--set", "duration=1", "--out", str(tmp_path), "--quiet"]
    assert main(["simulate", "paper_walk", *options]) == DONE
    error = json.loads((tmp_path / "metrics.json").read_text())["friction_law_error"]
    assert list(error) == Log.load(tmp_path / "log.npz").joints
    # The hip yaw of the foot that swings hardly moves: it trembles where its law is steepest.
    trembling = error.pop("right_hip_yaw")
    assert 0 < trembling < 0.05
    assert all(0 < value < 0.02 for value in error.values())


@pytest.mark.usefixtures("blank_pictures")
def test_a_run_that_does_not_follow_a_law_says_so(tmp_path: Path, capsys: pytest.CaptureFixture):
    reversing = "robot.effects.extra=!DirectionalFriction {asymmetry: {all: 2.0}}"
    options = ["--set", "duration=1", "--set", reversing, "--out", str(tmp_path)]
    assert main(["simulate", "paper_walk", *options]) == DONE
    error = json.loads((tmp_path / "metrics.json").read_text())["friction_law_error"]
    worst = max(error, key=error.get)
    assert error[worst] > 0.05
    share = f"{100 * error[worst]:.1f} %"
    printed = capsys.readouterr().out
    assert f"{share} ({worst})" in printed
    (line,) = (line for line in printed.splitlines() if "differs from its law" in line)
    for joint, value in error.items():
        assert (joint.replace("_", " ") in line) == (value > 0.01)
    said = f"in {worst.replace('_', ' ')} ({share})"
    assert said in line
    assert "--set solve_twice=true" in line
    assert said in (tmp_path / "report.html").read_text()


@pytest.mark.usefixtures("blank_pictures")
def test_a_run_that_follows_its_laws_says_no_more(tmp_path: Path, capsys: pytest.CaptureFixture):
    options = ["--set", "duration=1", "--out", str(tmp_path)]
    assert main(["simulate", "hrp2_friction_walk", *options]) == DONE
    error = json.loads((tmp_path / "metrics.json").read_text())["friction_law_error"]
    assert all(0 < value < 0.01 for value in error.values())
    printed = capsys.readouterr().out
    assert "torque less its law, worst" in printed
    for text in (printed, (tmp_path / "report.html").read_text()):
        assert "differs from its law" not in text


@pytest.mark.usefixtures("undrawn")
def test_a_robot_without_effects_has_no_law_error(tmp_path: Path, capsys: pytest.CaptureFixture):
    options = ["--set", "duration=0.2", "--out", str(tmp_path)]
    assert main(["simulate", "frictionless_walk", *options]) == DONE
    error = json.loads((tmp_path / "metrics.json").read_text())["friction_law_error"]
    assert len(error) == 12
    assert all(value is None for value in error.values())
    printed = capsys.readouterr().out
    assert "its law" not in printed
    assert "nan" not in printed


def without_estimates(log: Log, *beginnings: str) -> Log:
    """The log without its estimates and channels with these beginnings."""
    return Log(
        {
            name: values
            for name, values in log.items()
            if not name.startswith(("estimate/", *beginnings))
        },
        log.meta,
    )


@pytest.mark.usefixtures("undrawn")
def test_estimate_writes_everything_and_equals_the_live_estimates(
    walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    live = Log.load(walk / "log.npz")
    without_estimates(live).save(tmp_path / "recorded.npz")
    assert (
        main(["estimate", *WALK, str(tmp_path / "recorded.npz"), "--out", str(tmp_path / "out")])
        == DONE
    )
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    replayed = Log.load(tmp_path / "out/log.npz")
    assert set(replayed) == set(live)
    for name in live:
        np.testing.assert_allclose(replayed[name], live[name], rtol=1e-9, atol=1e-9, err_msg=name)
    assert load_scenario(tmp_path / "out/scenario.yaml").duration == 1.0
    before, after = (
        json.loads((folder / "metrics.json").read_text()) for folder in (walk, tmp_path / "out")
    )
    assert set(after) == set(before) | {"remarks"}
    assert 0.01 < after["friction_nrmse"]["swing"]["right_knee_pitch"] < 0.5
    assert after["friction_nrmse"]["swing"]["left_knee_pitch"] is None
    for key in ("friction_rmse", "friction_nrmse"):
        for phase in ("stance", "swing"):
            assert after[key][phase] == pytest.approx(before[key][phase], nan_ok=True)
    assert after["friction_law_error"] == pytest.approx(before["friction_law_error"])
    assert after["attitude_rmse_deg"] == pytest.approx(before["attitude_rmse_deg"])
    assert 0 < after["tick_us"]["median"] <= after["tick_us"]["p99"]
    assert before["tick_us"]["median"] is None
    printed = capsys.readouterr().out
    for text in (
        "right_knee_pitch",
        "stance",
        "attitude error",
        "base velocity error",
        "estimator tick",
        "report.html",
    ):
        assert text in printed


@pytest.mark.usefixtures("undrawn")
def test_simulate_tells_the_errors_of_estimates(tmp_path: Path, capsys: pytest.CaptureFixture):
    options = ["--set", "duration=0.4", "--set", "estimator=!Fbse {}", "--out", str(tmp_path)]
    assert main(["simulate", "squat", *options]) == DONE
    printed = capsys.readouterr().out
    assert "friction error, NRMSE" in printed
    assert "base velocity error" in printed
    assert "estimator tick" not in printed


@pytest.mark.usefixtures("blank_pictures")
def test_a_recording_of_a_robot_is_enough(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """No truth, no plan, no velocities; a tenth of the samples lost, the others late by up to 0.3
    ms, on a clock of their own."""
    live, random = Log.load(walk / "log.npz"), np.random.default_rng(0)
    kept = np.sort(random.choice(len(live.time), len(live.time) * 9 // 10, replace=False))
    bare = without_estimates(live, "truth/", "reference/", "joint/velocity")
    channels = {name: values[kept] for name, values in bare.items()}
    channels["time"] = channels["time"] + random.uniform(0, 3e-4, len(kept)) + 100.0
    Log(channels, {key: live.meta[key] for key in ("joints", "sides", "period")}).save(
        tmp_path / "robot.npz"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["estimate", *WALK, "robot.npz"]) == DONE
    out = tmp_path / "out/paper_walk_fbse_estimate"
    estimated = Log.load(out / "log.npz")
    np.testing.assert_array_equal(estimated.time, channels["time"])
    friction, truth = (
        estimated["estimate/joint/friction_torque"],
        live["truth/joint/friction_torque"],
    )
    settled = kept > 300
    error = friction[settled] - truth[kept[settled] - 1]
    assert np.sqrt(np.mean(error**2)) < 0.6 * np.sqrt(np.mean(truth**2))
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["fell"], metrics["outcome"]) == (None, "recorded")
    assert metrics["friction_nrmse"]["stance"]["left_knee_pitch"] is None
    assert metrics["tick_us"]["median"] > 0
    assert all(value is None for value in metrics["friction_law_error"].values())
    assert "A recording of 1.00 s." in (out / "report.html").read_text()
    printed = capsys.readouterr().out
    assert "estimator tick" in printed
    assert "friction error" not in printed
    assert "nan" not in printed


@pytest.mark.usefixtures("blank_pictures")
def test_estimate_without_torques_says_so_in_a_line(
    walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    untold = without_estimates(Log.load(walk / "log.npz"), "truth/", "joint/torque_command")
    untold.save(tmp_path / "untold.npz")
    arguments = ["estimate", *WALK, str(tmp_path / "untold.npz"), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--set", "reference=!Recorded {}"]) == DONE
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    printed = capsys.readouterr().out.splitlines()
    assert "The friction is not known: the log has no joint/torque_command." in printed
    assert (
        sum(line.startswith("Noise believed in, per sample: joint angle") for line in printed) == 1
    )
    remarks = json.loads((tmp_path / "out/metrics.json").read_text())["remarks"]
    page = (tmp_path / "out/report.html").read_text()
    assert remarks
    assert all(remark in printed and html.escape(remark) in page for remark in remarks)
    log = Log.load(tmp_path / "out/log.npz")
    assert "estimate/base/velocity" in log
    assert "estimate/joint/friction_torque" not in log


def cut(log: Log, path: Path) -> None:
    log.save(path)
    path.write_bytes(path.read_bytes()[:-5000])


def single_array(_: Log, path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.ones(3))


def texts(log: Log, path: Path) -> None:
    meta = np.array(json.dumps({"format_version": 1, **log.meta}))
    np.savez(
        path, meta=meta, **(log.channels | {"joint/velocity": log["joint/velocity"].astype(str)})
    )


def renamed(log: Log, path: Path) -> None:
    Log(log.channels, log.meta | {"joints": [f"other_{name}" for name in log.joints]}).save(path)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("scenario", "damage", "message"),
    [
        ("paper_walk_fbse", lambda *_: None, "log.npz: No such file or directory"),
        ("paper_walk_fbse", cut, "log.npz: truncated or not a log file (npz)"),
        (
            "paper_walk_fbse",
            lambda _, path: path.write_text("time,position"),
            "log.npz: truncated or not a log file (npz)",
        ),
        ("paper_walk_fbse", single_array, "log.npz: truncated or not a log file (npz)"),
        ("paper_walk_fbse", texts, "log.npz: channel joint/velocity: expected numbers"),
        ("paper_walk_fbse", renamed, "are not the model's"),
        (
            "paper_walk_fbse",
            lambda log, path: without_estimates(log, "foot/").save(path),
            "measured_pad_force (foot/<side>/pad_force, foot/<side>/wrench)",
        ),
        (
            "paper_walk_fbse",
            lambda log, path: without_estimates(log, "imu/").save(path),
            "measured_imu (imu/linear_acceleration",
        ),
        ("squat", Log.save, "squat over"),
        ("squid", Log.save, "squid: no such file"),
    ],
)
def test_a_bad_log_is_one_line_and_status_2(
    scenario: str,
    damage: Callable[[Log, Path], None],
    message: str,
    walk: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
):
    damage(Log.load(walk / "log.npz"), tmp_path / "log.npz")
    assert (
        main(["estimate", scenario, str(tmp_path / "log.npz"), "--out", str(tmp_path / "out")])
        == BAD_INPUT
    )
    printed = capsys.readouterr()
    assert printed.err.startswith("fbse: ")
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("out/*"))


def test_estimates_do_not_overwrite_the_log_they_are_made_from(
    walk: Path, capsys: pytest.CaptureFixture
):
    before = (walk / "log.npz").read_bytes()
    assert main(["estimate", *WALK, str(walk / "log.npz"), "--out", str(walk)]) == BAD_INPUT
    assert "would overwrite" in capsys.readouterr().err
    assert (walk / "log.npz").read_bytes() == before


@pytest.fixture
def undrawn_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports of compare, diagnose and study are empty."""
    for kind in ("compare", "diagnosis", "study"):
        monkeypatch.setattr(
            f"fbse_drake.analysis.write_{kind}_report",
            lambda path, *_, **__: path.write_text("report"),
        )


@pytest.fixture(scope="module")
def biased(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a robot whose left knee lacks 1 Nm, of which the model knows nothing."""
    folder = tmp_path_factory.mktemp("biased")
    bias = "robot.effects={hidden: !TorqueBias {bias: {left_knee_pitch: 1.0}}}"
    simulate(load_scenario("frictionless_walk", overrides=["duration=1.5", bias])).log.save(
        folder / "log.npz"
    )
    return folder / "log.npz"


# What the log was made with, without what is hidden.
BIASED = ["frictionless_walk", "--set", "duration=1.5"]
FOUND = ["metrics.json", "report.html", "scenario.yaml"]


@pytest.mark.usefixtures("undrawn_findings")
def test_compare_says_where_the_model_fails(
    biased: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    assert main(["compare", *BIASED, str(biased), "--out", str(tmp_path)]) == DONE
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*FOUND, "compare.json"])
    content = json.loads((tmp_path / "compare.json").read_text())
    assert (tmp_path / "metrics.json").read_text() == (tmp_path / "compare.json").read_text()
    worst = content["failures"][0]
    assert worst["channel"] == "left_knee_pitch"
    assert worst["error"] == pytest.approx(1.0, abs=0.1)
    assert load_scenario(tmp_path / "scenario.yaml").duration == 1.5
    printed = capsys.readouterr().out
    assert "left knee pitch: model torque" in printed
    assert "report.html" in printed


@pytest.mark.usefixtures("undrawn_findings")
def test_diagnose_then_add_then_compare(
    biased: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    """From a log to a model that fits it."""
    few = [library()[name] for name in ("TorqueBias", "ViscousFriction")]
    monkeypatch.setattr("fbse_drake.commands.diagnose", functools.partial(diagnose, effects=few))
    monkeypatch.setattr(
        "fbse_drake.analysis.write_diagnosis_report",
        lambda path, *given: path.write_text(given[2].changed_scenario),
    )
    found = tmp_path / "found"
    assert main(["diagnose", *BIASED, str(biased), "--out", str(found)]) == DONE
    assert sorted(path.name for path in found.iterdir()) == sorted([*FOUND, "diagnosis.json"])
    assert json.loads((found / "diagnosis.json").read_text())["verdict"] == "effect_found"
    printed = capsys.readouterr().out
    assert "Torque bias" in printed
    assert "The model lacks torque bias in left knee pitch" in printed

    completed = tmp_path / "new/completed.yaml"
    assert main(["add", *BIASED, str(found), "--out", str(completed)]) == DONE
    printed = capsys.readouterr().out
    assert "left knee pitch" in printed
    assert str(completed) in printed
    (effect,) = load_scenario(completed, "frictionless_walk").believed.effects.values()
    assert effect.bias == {"left_knee_pitch": pytest.approx(1.0, abs=0.1)}
    comments = [line for line in completed.read_text().splitlines() if line.startswith("# ")]
    assert (
        comments[0]
        == f"# Effects added by fbse add to frictionless_walk, from {found}/diagnosis.json."
    )
    assert comments[1].startswith("# TorqueBias in left knee pitch: held-out error ")
    assert comments[2].startswith("# TorqueBias in left knee pitch: bias ")
    assert comments[2].endswith("with its 95 % interval")
    # The commands that it proposes read the scenario as it was read.
    assert (found / "report.html").read_text() == " ".join(BIASED)

    # What fbse add wrote may be written again, but not over the scenario that is added to, nor over
    # a file of somebody else.
    assert (
        main(
            [
                "add",
                *BIASED,
                str(found / "diagnosis.json"),
                "--effect",
                "TorqueBias",
                "--out",
                str(completed),
                "--quiet",
            ]
        )
        == DONE
    )
    assert capsys.readouterr() == ("", "")
    mine = tmp_path / "mine.yaml"
    mine.write_text("squat: {}")
    for scenario, out, message in (
        ("frictionless_walk", mine, "exists already"),
        ("frictionless_walk", tmp_path, "exists already"),
        (str(completed), completed, "would overwrite"),
    ):
        options = ["--name", "frictionless_walk", str(found), "--out", str(out)]
        assert main(["add", scenario, *options]) == BAD_INPUT
        assert message in capsys.readouterr().err
    assert mine.read_text() == "squat: {}"

    again = tmp_path / "again"
    assert (
        main(
            [
                "compare",
                str(completed),
                "--name",
                "frictionless_walk",
                str(biased),
                "--out",
                str(again),
                "--quiet",
            ]
        )
        == DONE
    )
    assert json.loads((again / "compare.json").read_text())["failures"] == []


@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "--time-limit"])
def test_a_diagnosis_that_is_ended_early_is_alone_and_keeps_what_is_known(
    how: str, biased: Path, tmp_path: Path
):
    """What each effect would do is predicted in a process beside it, here without end."""
    limit = ["--time-limit", "0.01"] if how == "--time-limit" else []
    arguments = [*BIASED, str(biased), "--jobs", "2", *limit, "--out", str(tmp_path)]
    script = f"""{HEEDED}
import multiprocessing, time
from fbse_drake import analysis, cli
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
def predict(dictionary, progress):
    if {not limit}:
        os.kill(os.getppid(), signal.{"SIGINT" if limit else how})
    while True:
        time.sleep(1.0)
Dictionary._fixed = predict
search = analysis.diagnose_confirmed
def searched(*arguments, **options):
    found = search(*arguments, **options)
    print("beside it:", multiprocessing.active_children())
    return found
analysis.diagnose_confirmed = searched
analysis.write_diagnosis_report = lambda path, *_: path.write_text("report")
sys.argv = ["fbse", "diagnose", *{arguments}]
cli.entry()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == FAILED, done.stderr
    assert "beside it: []" in done.stdout
    assert "Traceback" not in done.stderr
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    assert content["partial"]
    assert content["interrupted_because"].startswith("the time limit" if limit else "it was")
    assert (tmp_path / "report.html").read_text() == "report"


@pytest.mark.usefixtures("undrawn_findings")
def test_study_writes_the_completed_scenario(
    biased: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    few = [library()[name] for name in ("TorqueBias", "ViscousFriction")]
    monkeypatch.setattr("fbse_drake.commands.study", functools.partial(study, effects=few))
    assert main(["study", *BIASED, str(biased), "--out", str(tmp_path)]) == DONE
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [*FOUND, "study.json", "replay.html"]
        + ["completed.yaml", "completed.urdf", "completed.xml"]
    )
    content = json.loads((tmp_path / "study.json").read_text())
    first, *_, last = content["steps"]
    assert first["held_out_rmse"] > 1.5 * content["noise_floor"]
    assert last["held_out_rmse"] == pytest.approx(1.0, abs=0.05)
    assert last["rollout_rmse"]["joint_position"] < first["rollout_rmse"]["joint_position"]
    (effect,) = load_scenario(
        tmp_path / "completed.yaml", "frictionless_walk"
    ).believed.effects.values()
    assert effect.bias == {"left_knee_pitch": pytest.approx(1.0, abs=0.1)}
    printed = capsys.readouterr().out
    assert "the model as given" in printed
    assert "The model lacked torque bias in left knee pitch" in printed


def negative(name: str) -> Callable[[Log, Path], None]:
    return lambda log, path: Log(log.channels | {name: -log[name]}, log.meta).save(path)


@pytest.mark.parametrize("command", ["compare", "diagnose", "study"])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut, "truncated or not a log file (npz)"),
        (renamed, "are not the model's"),
        (
            lambda log, path: without_estimates(log, "imu/").save(path),
            "the log has no channel imu/linear_acceleration",
        ),
        (negative("imu/linear_acceleration"), "its sign is reversed"),
        (negative("joint/velocity"), "channel joint/velocity"),
    ],
)
def test_a_log_that_cannot_be_compared_is_one_line_and_status_2(
    command: str,
    damage: Callable[[Log, Path], None],
    message: str,
    biased: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
):
    damage(Log.load(biased), tmp_path / "log.npz")
    assert (
        main([command, *BIASED, str(tmp_path / "log.npz"), "--out", str(tmp_path / "out")])
        == BAD_INPUT
    )
    printed = capsys.readouterr()
    assert printed.err.startswith("fbse: ")
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("out/*"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file or directory"),
        ("not json", "not a JSON file"),
        ("[1, 2]", "not the contents of a diagnosis.json"),
        ('{"verdict": "nothing_missing", "ranking": []}', "the diagnosis has no effect to add"),
    ],
)
def test_a_bad_diagnosis_is_one_line_and_status_2(
    content: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture
):
    if content is not None:
        (tmp_path / "diagnosis.json").write_text(content)
    assert main(["add", "squat", str(tmp_path), "--out", str(tmp_path / "new.yaml")]) == BAD_INPUT
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "new.yaml").exists()


@pytest.mark.parametrize("line_break", ["\n", "\r", "\x85", "\u2028"])
def test_a_diagnosis_puts_nothing_but_its_effects_into_a_scenario(line_break: str, tmp_path: Path):
    """Its texts stand in comments of the new scenario, and end none of them."""
    smuggled = f"Nm{line_break}effect_modules: [mine.py]{line_break}"
    bias = {"value": 1.0, "interval": [0.9, 1.1], "unit": smuggled}
    finding = {
        "effect": "TorqueBias",
        "joints": ["left_knee_pitch"],
        "held_out_before": 2.0,
        "held_out_after": 1.0,
        "parameters": {"bias": bias},
        "confusable_with": [],
        "chosen": True,
    }
    (tmp_path / "diagnosis.json").write_text(json.dumps({"ranking": [finding]}))
    (tmp_path / "mine.py").write_text("raise SystemExit('run')")
    new = tmp_path / "new.yaml"
    assert main(["add", "squat", str(tmp_path), "--out", str(new), "--quiet"]) == DONE
    assert list(load_tree(new)) == ["squat"]
    (effect,) = load_scenario(new).believed.effects.values()
    assert effect.bias == {"left_knee_pitch": 1.0}


@pytest.mark.usefixtures("undrawn")
def test_hide_and_reveal(tmp_path: Path, capsys: pytest.CaptureFixture):
    options = ["--set", "duration=0.5", "--what", "TorqueBias", "--out", str(tmp_path)]
    assert main(["hide", "squat", "--seed", "5", *options]) == DONE
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*FILES, "answer.sealed"])
    printed = capsys.readouterr().out
    assert "fbse study" in printed
    assert "bias" not in printed.lower()
    for name in ("scenario.yaml", "metrics.json", "answer.sealed"):
        assert "TorqueBias" not in (tmp_path / name).read_text()
    assert not [name for name in Log.load(tmp_path / "log.npz") if name.startswith("truth/")]
    assert main(["reveal", str(tmp_path)]) == DONE
    assert "Torque bias" in capsys.readouterr().out
    answer = json.loads((tmp_path / "answer.json").read_text())["answer"]
    assert answer["effects"][0]["effect"] == "TorqueBias"
    (tmp_path / "answer.sealed").write_text("0 0")
    assert main(["reveal", str(tmp_path)]) == BAD_INPUT
    assert "damaged" in capsys.readouterr().err


def test_code_that_came_with_a_log_is_not_run_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture
):
    """A scenario whose module tells that it ran, alone and beside a log."""
    (tmp_path / "mine.py").write_text("from pathlib import Path; raise OSError('it ran')")
    (tmp_path / "mine.yaml").write_text("mine: {effect_modules: [mine.py]}")
    (tmp_path / "many.yaml").write_text("steps: {one: !Call {function: mine.py:f, gives: {}}}")
    command = ["simulate", str(tmp_path / "mine.yaml")]
    assert main(command) == BAD_INPUT
    assert "it ran" in capsys.readouterr().err
    (tmp_path / "log.npz").touch()
    assert main(command) == BAD_INPUT
    refused = r"may have come with log\.npz, and it runs .*mine\.py.*--allow-code"
    assert re.search(refused, capsys.readouterr().err)
    with pytest.raises(InputError, match=refused):
        require_trusted(tmp_path / "many.yaml", load_campaign(tmp_path / "many.yaml").code)
    assert main([*command, "--allow-code"]) == BAD_INPUT
    assert "it ran" in capsys.readouterr().err


def test_meshcat_listens_on_this_machine_alone():
    console = Console(quiet=True)
    assert urlparse(_start_meshcat(console).web_url()).hostname == "localhost"
