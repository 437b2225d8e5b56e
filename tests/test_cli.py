import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fbse_drake import Log, load_scenario
from fbse_drake.cli import BAD_INPUT, DONE, FAILED, main


def test_simulate_writes_everything(tmp_path: Path, capsys: pytest.CaptureFixture):
    status = main(["simulate", "squat", "--set", "duration=0.5", "--set", "seed=4", "--out", str(tmp_path / "out")])
    assert status == DONE
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["log.npz", "metrics.json", "report.html", "scenario.yaml"]
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["fell"] is False
    assert metrics["simulated_time"] == pytest.approx(0.5)
    assert metrics["real_time_factor"] == pytest.approx(0.5 / metrics["wall_time"])
    assert set(metrics["joint_tracking_rms"]) == set(Log.load(tmp_path / "out/log.npz").joints)
    assert math.isnan(metrics["friction_rmse"]["stance"]["left_hip_yaw"])
    assert load_scenario(tmp_path / "out/scenario.yaml").seed == 4
    printed = capsys.readouterr().out
    assert "squat" in printed
    assert "report.html" in printed


def test_the_written_scenario_runs_again_to_the_same_log(tmp_path: Path):
    main(["simulate", "sway", "--set", "duration=0.2", "--out", str(tmp_path / "a"), "--quiet"])
    main(["simulate", str(tmp_path / "a/scenario.yaml"), "--out", str(tmp_path / "b"), "--quiet"])
    assert (tmp_path / "a/log.npz").read_bytes() == (tmp_path / "b/log.npz").read_bytes()


def test_quiet_prints_nothing(tmp_path: Path, capsys: pytest.CaptureFixture):
    assert main(["simulate", "squat", "--set", "duration=0.1", "--out", str(tmp_path), "--quiet"]) == DONE
    assert capsys.readouterr() == ("", "")


def test_meshcat_is_recorded(tmp_path: Path):
    assert main(["simulate", "squat", "--set", "duration=0.1", "--meshcat", "--out", str(tmp_path), "--quiet"]) == DONE
    assert "animation" in (tmp_path / "meshcat.html").read_text()


def test_a_fall_ends_the_run_and_keeps_the_log(tmp_path: Path, capsys: pytest.CaptureFixture):
    assert main(["simulate", "paper_walk_pd", "--out", str(tmp_path), "--quiet"]) == FAILED
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
        (["simulate", "squat", "--sed", "3"], "unrecognized arguments: --sed 3"),
        (["simulate", "squid"], "squid: no such file, and no such name in scenarios/"),
        (["simulate", "squat", "--set", "duration=0"], "squat: duration: expected a number > 0, found 0"),
        (["simulate", "squat", "--name", "other"], "no scenario called other (there are: squat)"),
        (["simulate", "paper_walk", "--set", "reference.step_length=0.5"], "reference: step 2 (left leg"),
        (["simulate", "squat", "--set", "robot.gantry_height=1.0"], "a robot with a fixed base cannot follow Squat"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture):
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


def test_an_interrupted_run_leaves_no_half_written_file(tmp_path: Path):
    command = [sys.executable, "-m", "fbse_drake", "simulate", "squat", "--set", "duration=20", "--set", "plant.time_step=1e-4"]
    process = subprocess.Popen([*command, "--out", str(tmp_path / "out")], stderr=subprocess.PIPE, text=True, env={**os.environ})
    # By now it has planned the motion and runs, which takes a minute.
    time.sleep(12)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=60)
    assert process.returncode == FAILED
    assert "interrupted" in message
    assert message.count("\n") == 1
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert not [name for name in names if name.endswith(".part")]
    if names:
        assert names == ["log.npz", "metrics.json", "report.html", "scenario.yaml"]
        assert Log.load(tmp_path / "out/log.npz").meta["outcome"]["reason"].endswith("interrupted")


def test_a_copied_scenario_does_not_overwrite_the_original(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("squat: {duration: 0.05, reference: !Squat {}}\n")
    assert main(["simulate", "mine.yaml", "--quiet"]) == DONE
    assert (tmp_path / "out/mine/log.npz").is_file()
