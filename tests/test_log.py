import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import scenario

from fbse_drake import InputError, Log, simulate
from fbse_drake.log import plausible_part

META = {"joints": ["a", "b"], "period": 0.01}


def channels(samples: int = 5) -> dict[str, np.ndarray]:
    return {
        "time": np.arange(samples) * 0.01,
        "joint/position": np.ones((samples, 2)),
        "joint/torque_command": np.zeros((samples, 2)),
    }


def test_round_trip(tmp_path: Path):
    log = Log(
        channels()
        | {"foot/left/pad_force": np.ones((5, 4, 3)), "truth/base/velocity": np.zeros((5, 3))},
        META,
    )
    log.save(tmp_path / "log.npz")
    again = Log.load(tmp_path / "log.npz")
    assert again.meta == log.meta
    assert list(again) == list(log)
    for name in log:
        np.testing.assert_array_equal(again[name], log[name])
    assert again.unit("foot/left/pad_force") == "N"
    assert again.unit("truth/joint/friction_torque") == "Nm"
    assert [path.name for path in tmp_path.iterdir()] == ["log.npz"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint/position": None}, r"channel joint/position is missing"),
        (
            {"joint/position": np.ones((5, 3))},
            r"channel joint/position: expected shape 5 x 2, found 5 x 3",
        ),
        (
            {"joint/velocity": np.ones((4, 2))},
            r"channel joint/velocity: expected shape 5 x 2, found 4 x 2",
        ),
        (
            {"joint/velocity": np.full((5, 2), np.nan)},
            r"channel joint/velocity: not a finite number in row 0",
        ),
        (
            {"time": np.array([0.0, 0.01, 0.01, 0.02, 0.03])},
            r"channel time: does not increase at row 2",
        ),
        ({"elbow/position": np.ones(5)}, r"channel elbow/position: not a channel of a log"),
    ],
)
def test_impossible_logs_are_refused(change: dict, message: str):
    content = {name: values for name, values in (channels() | change).items() if values is not None}
    with pytest.raises(InputError, match=message):
        Log(content, META)


@pytest.mark.parametrize("key", ["joints", "sides"])
def test_names_are_given_once(key: str):
    with pytest.raises(InputError, match=f"meta: {key}: a name is given twice"):
        Log(channels(), META | {key: ["a", "a"]})


def test_unknown_channel_names_the_known_ones():
    with pytest.raises(KeyError, match="no channel imu/angular_velocity in this log"):
        Log(channels(), META)["imu/angular_velocity"]


@pytest.mark.parametrize("kept", [0, 10, 200, 0.5, 0.99])
def test_truncated_file_gets_one_line(tmp_path: Path, kept: float):
    path = tmp_path / "log.npz"
    Log(channels(200), META).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: kept if isinstance(kept, int) else int(kept * len(content))])
    with pytest.raises(InputError, match=r"log\.npz: .*not a log") as error:
        Log.load(path)
    assert "\n" not in str(error.value)


def test_foreign_files_get_one_line(tmp_path: Path):
    np.savez(tmp_path / "foreign.npz", x=np.ones(3))
    with pytest.raises(InputError, match="not a log file: it has no meta"):
        Log.load(tmp_path / "foreign.npz")
    np.savez(tmp_path / "pickled.npz", x=np.array([{}], dtype=object))
    with pytest.raises(InputError, match=r"pickled\.npz"):
        Log.load(tmp_path / "pickled.npz")
    np.savez(
        tmp_path / "newer.npz", meta=np.array(json.dumps({"format_version": 99})), **channels()
    )
    with pytest.raises(InputError, match="log format version 99, this program reads 1"):
        Log.load(tmp_path / "newer.npz")
    with pytest.raises(InputError, match=r"absent\.npz: No such file"):
        Log.load(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("time,position\n0,1\n")
    with pytest.raises(InputError, match=r"text\.npz: .*not a log"):
        Log.load(tmp_path / "text.npz")


def test_a_run_with_sensors_that_say_nothing_can_be_read_again(tmp_path: Path):
    """Noise may be as large as a number may, and a variance is its square."""
    deaf = ("duration=0.01", "sensors.foot_force.noise=1e15", "estimator=!Fbse {}")
    simulate(scenario("squat", *deaf)).log.save(tmp_path / "log.npz")
    variance = Log.load(tmp_path / "log.npz")["estimate/base_state/force_innovation_variance"]
    assert variance.max() > 1e15


def test_a_log_that_could_not_be_read_again_is_not_written(tmp_path: Path):
    large = channels() | {"joint/position": np.full((5, 2), 1e16)}
    with pytest.raises(InputError, match=r"l.npz: channel joint/position: .* size at most 1e\+15"):
        Log(large, META).save(tmp_path / "l.npz")
    assert not list(tmp_path.iterdir())


def test_only_rows_before_the_first_implausible_number_are_kept():
    growing = channels()
    growing["joint/position"] = 10.0 ** np.array([[0, 3], [15, 15], [3, 0], [16, 0], [0, 0]])
    part = plausible_part(Log(growing, META))
    np.testing.assert_array_equal(part["joint/position"], growing["joint/position"][:3])
    whole = Log(channels(), META)
    np.testing.assert_array_equal(plausible_part(whole).time, whole.time)
    growing["joint/velocity"] = np.full((5, 2), -1e17)
    with pytest.raises(InputError, match="joint/velocity: expected numbers of size at most"):
        plausible_part(Log(growing, META))


def test_same_scenario_and_seed_give_the_same_bytes(tmp_path: Path):
    for name in ("first", "second"):
        simulate(scenario("paper_walk", "duration=0.8"), name="paper_walk").log.save(
            tmp_path / f"{name}.npz"
        )
    assert (tmp_path / "first.npz").read_bytes() == (tmp_path / "second.npz").read_bytes()


def test_another_seed_changes_the_noise_and_nothing_else_at_first(run: Callable[..., Log]):
    one, other = run("squat", "duration=0.3"), run("squat", "duration=0.3", "seed=1")
    assert not np.array_equal(one["imu/linear_acceleration"], other["imu/linear_acceleration"])
    np.testing.assert_array_equal(one["truth/joint/position"][0], other["truth/joint/position"][0])
    np.testing.assert_array_equal(
        one["reference/joint/position"], other["reference/joint/position"]
    )


def test_noise_levels_are_the_scenarios(run: Callable[..., Log]):
    noisy, exact = (
        run("leg_swing_gantry", "duration=3"),
        run("leg_swing_gantry", "duration=3", noise=False),
    )
    gyro = noisy["imu/angular_velocity"] - exact["imu/angular_velocity"]
    assert gyro.std() == pytest.approx(1e-3, rel=0.05)
    pads = noisy["foot/left/pad_force"] - noisy["truth/foot/left/pad_force"]
    assert pads.std() == pytest.approx(0.5, rel=0.05)
    angle = noisy["joint/position"] - noisy["truth/joint/position"]
    assert np.abs(angle).max() <= 0.5 * 4.8e-5 + 1e-12
    assert angle.std() == pytest.approx(4.8e-5 / np.sqrt(12), rel=0.1)


def test_log_follows_the_contract(run: Callable[..., Log]):
    log = run("squat", "duration=0.3")
    samples = 301
    shapes = {
        "time": (samples,),
        "joint/position": (samples, 12),
        "joint/velocity": (samples, 12),
        "joint/torque_command": (samples, 12),
        "imu/linear_acceleration": (samples, 3),
        "imu/angular_velocity": (samples, 3),
        "foot/left/pad_force": (samples, 4, 3),
        "foot/right/pad_force": (samples, 4, 3),
    }
    assert {name: log[name].shape for name in shapes} == shapes
    assert all(values.dtype == np.float64 for values in log.values())
    assert log.joints[:2] == ["left_hip_yaw", "left_hip_roll"]
    np.testing.assert_array_equal(log.time, np.arange(samples) * 0.001)


def test_a_run_that_diverges_keeps_what_was_recorded(monkeypatch: pytest.MonkeyPatch):
    calls = []

    def diverging(command: np.ndarray, *_: np.ndarray) -> None:
        calls.append(1)
        command[:] = np.nan if len(calls) > 100 else 0.0

    monkeypatch.setattr("fbse_drake.control.position_loop._command", diverging)
    result = simulate(scenario("leg_swing_gantry", "duration=0.5"))
    assert result.failure is not None
    assert result.log.meta["outcome"]["fell"]
    assert 0.05 < result.log.time[-1] <= 0.12
    assert all(np.isfinite(values).all() for values in result.log.values())
