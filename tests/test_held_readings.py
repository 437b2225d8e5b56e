"""Sensors that are read more seldom than a log has rows, and held in between."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import library
from fbse_drake.estimation import estimate
from fbse_drake.held_readings import (
    between_readings,
    rows_of_readings,
    rows_per_reading,
    unseen_variance,
)
from fbse_drake.log import Log
from fbse_drake.report.metrics import friction_nrmse
from fbse_drake.scenario import Scenario
from tests.conftest import scenario

WALK = ("paper_walk", "duration=3.2", "estimator=!NoEstimator {}", "seed=11")
# What late forces, angles or motions of the base may be taken for.
TRIED = (
    "FootForceLag",
    "FootForceBias",
    "TorqueLag",
    "TorqueDelay",
    "TorqueGain",
    "TransmissionElasticity",
)


def held(log: Log, kinds: tuple[str, ...], rows: float) -> Log:
    """As if the sensors of some channels were read every so many rows."""
    read = np.ceil(np.arange(0, len(log.time), rows)).astype(int)
    latest = read[np.searchsorted(read, np.arange(len(log.time)), side="right") - 1]
    channels = {
        name: values[latest] if name.startswith(kinds) else values
        for name, values in log.channels.items()
    }
    return replace(log, channels=channels)


@pytest.fixture(scope="module")
def believed() -> Scenario:
    walk = scenario(*WALK)
    return replace(walk, model=walk.robot)


@pytest.mark.parametrize(("rows", "first"), [(2, 0), (5, 3), (10, 9)])
def test_a_line_is_read_back_from_what_is_held_of_it(rows: int, first: int):
    row = np.arange(600)
    line = np.stack([0.3 * row, -2.0 * row], axis=1)
    # A sensor that was read in rows `first`, `first + rows`, ...
    latest = (row - first) // rows * rows + first
    kept = np.stack([0.3 * latest, -2.0 * latest], axis=1)
    assert rows_per_reading(kept) == pytest.approx(rows, rel=0.02)
    np.testing.assert_array_equal(rows_of_readings(kept), np.arange(first, 600, rows))
    inner = slice(rows, 600 - rows)
    np.testing.assert_allclose(between_readings(kept)[inner], line[inner], atol=1e-9)
    # The last reading is held: nobody knows the next.
    assert np.all(between_readings(kept)[-1] == kept[-1])


def test_readings_that_repeat_by_chance_are_readings():
    """A foot in the air reads zero again and again."""
    force = np.maximum(np.sin(0.13 * np.arange(200)), 0.0)
    kept = np.repeat(force, 3)
    between = between_readings(kept)
    np.testing.assert_allclose(between[::3], force, atol=1e-12)
    np.testing.assert_allclose(between[1:-3:3], (2 * force[:-1] + force[1:]) / 3, atol=1e-12)


def test_a_coarse_encoder_and_a_channel_without_change_are_left_as_they_are():
    coarse = np.round(np.sin(0.01 * np.arange(2000)), 2)
    for values in (coarse, np.zeros(2000), np.random.default_rng(0).normal(size=2000)):
        assert rows_per_reading(values) == 1
        assert between_readings(values) is values


def test_joints_in_coarse_steps_are_no_slow_sensor():
    """Together they change almost every other row, now one and then the other; a sensor's clock
    that is not the log's ticks after two rows or three."""
    rng = np.random.default_rng(3)
    apart = rng.choice([1, 2, 3], p=[0.3, 0.4, 0.3], size=1000)
    rows = np.arange(apart.sum())
    steps = np.searchsorted(np.cumsum(apart), rows, side="right")
    coarse = np.stack([steps // 2, (steps + 1) // 2], axis=1).astype(float)
    assert rows_per_reading(coarse) == 1
    assert between_readings(coarse) is coarse
    assert rows_per_reading(np.floor(rows / 2.5)) == pytest.approx(2.5, rel=0.02)


def test_readings_in_rows_beside_each_other_are_kept():
    """By a clock of three rows that is a row early once: neither reading is lost."""
    rows = np.r_[np.arange(0, 300, 3), 301, np.arange(302, 602, 3)]
    values = np.zeros(600)
    values[rows[rows < 600]] = 1.0
    values = np.cumsum(values)
    assert {301, 302} <= set(rows_of_readings(values).tolist())


def test_a_jump_between_readings_is_as_bad_as_the_noise_that_is_said():
    """Jumps of 7 at any time between two readings, against the integral of the line through
    these; all else is smooth."""
    rows, count, apart = 10, 3000, 80
    step = np.zeros(apart * count + rows)
    jumps = apart * np.arange(count) + rows * (2 + np.random.default_rng(2).uniform(size=count))
    step[np.ceil(jumps).astype(int)] = 7.0 * (-1.0) ** np.arange(count)
    truth = np.sin(np.arange(len(step)) / 300) + np.cumsum(step)
    held_on = np.repeat(truth[::rows], rows)

    def around_each_jump(values: np.ndarray) -> np.ndarray:
        return values[: apart * count].reshape(count, apart)

    error = around_each_jump(between_readings(held_on) - truth).sum(axis=1)
    read = rows_of_readings(held_on)
    said = around_each_jump(unseen_variance(held_on[:, None], 0.0, 1.0, read)[:, 0])
    assert np.mean(error**2) == pytest.approx(said.sum(axis=1).mean(), rel=0.05)
    amid = np.arange(apart) // rows == 2
    assert np.all(said[:, amid] > 10)
    assert np.all(said[:, ~amid] < 1e-3)


def test_noise_and_smooth_motion_are_no_jumps():
    noise = 0.3 * np.random.default_rng(1).normal(size=(3000, 2))
    values = np.repeat(np.sin(np.arange(3000) / 20)[:, None] + noise, 5, axis=0)
    # Of what the noise itself leaves in an average: five rows of a reading's variance.
    of_held = unseen_variance(values, 0.3, 1.0, np.arange(0, len(values), 5))
    assert np.all(of_held.mean(axis=0) < 0.01 * 5 * 0.3**2)
    jump = 1e3 * (np.arange(3000) > 1000)[:, None]
    assert not unseen_variance(jump, 0.3, 1.0, np.arange(3000)).any()
    assert unseen_variance(jump, 0.3, 0.2, np.arange(3000)).any()


@pytest.mark.parametrize("read", ["sensors.foot_force", "sensors.imu", "log"])
def test_impacts_between_readings_are_no_effect(run: Callable[..., Log], read: str):
    """Forces and moments of a trot's base lacked something unknown, up to seven times the noise."""
    trot = (
        "quadruped_trot",
        "duration=3",
        "estimator=!NoEstimator {}",
        f"{read}.period=0.005",
    )
    believed = scenario(*trot)
    believed = replace(believed, model=believed.robot)
    found = diagnose(Predictor(believed, run(*trot)), [library()[name] for name in TRIED])
    assert (found.verdict, found.chosen) == ("nothing_missing", [])
    assert found.held_out_after < 1.2


@pytest.mark.parametrize(
    ("kinds", "rows"),
    [
        (("foot/",), 5),
        (("foot/",), 2.5),
        (("foot/",), 10.2),
        (("joint/position", "joint/velocity"), 4),
        (("foot/", "imu/", "joint/position", "joint/velocity"), 5),
    ],
)
def test_slow_sensors_are_no_effect(
    run: Callable[..., Log], believed: Scenario, kinds: tuple[str, ...], rows: float
):
    """Held forces were taken for lags of feet and ankles, held angles for something unknown."""
    log = held(run(*WALK), kinds, rows)
    found = diagnose(Predictor(believed, log), [library()[name] for name in TRIED])
    assert (found.verdict, found.chosen) == ("nothing_missing", [])


def test_a_lag_is_found_behind_slow_sensors(run: Callable[..., Log], believed: Scenario):
    lag = "robot.effects.lag=!FootForceLag {time_constant: {left: 0.02}}"
    log = held(run(*WALK, lag), ("foot/",), 5)
    (finding,) = diagnose(Predictor(believed, log), [library()[n] for n in TRIED]).chosen
    assert (finding.effect, finding.targets) == ("FootForceLag", ("left",))
    assert finding.parameters["time_constant"].value == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("kinds", "rows"), [(("foot/",), 10), (("joint/position", "joint/velocity"), 4)]
)
def test_an_estimator_ticks_when_its_slowest_sensor_is_read(
    run: Callable[..., Log], kinds: tuple[str, ...], rows: int
):
    """As it does over a log that has these rows alone, and says what was commanded meanwhile."""
    walk = ("paper_walk_fbse", "duration=2")
    log = held(run(*walk), kinds, rows)
    found = estimate(scenario(*walk), log)
    read = log.part(slice(0, None, rows))
    torque = log["joint/torque_command"]
    means = [torque[start : start + rows].mean(axis=0) for start in range(0, len(torque), rows)]
    channels = read.channels | {"joint/torque_command": np.array(means)}
    meta = read.meta | {"command_time": read.meta["period"]}
    alone = estimate(scenario(*walk), Log(channels, meta))
    for name in ("estimate/joint/friction_torque", "estimate/base/orientation"):
        assert len(found.log[name]) == len(log.time)
        np.testing.assert_allclose(found.log[name][::rows], alone.log[name], atol=1e-6)
        held_on = found.log[name][rows - 1 :: rows]
        np.testing.assert_array_equal(held_on, found.log[name][: -rows + 1 : rows][: len(held_on)])
    assert any(f"is read every {rows} ms" in remark for remark in found.remarks)
    assert len(alone.remarks) == len(found.remarks) - 1


def test_friction_is_told_from_forces_at_100_hz(run: Callable[..., Log]):
    """When every row counted as a reading, the error was twice the friction."""
    walk = ("paper_walk_fbse", "duration=4.3")
    found = estimate(scenario(*walk), held(run(*walk), ("foot/",), 10)).log
    for phase, errors in friction_nrmse(found).items():
        without_yaw = [e for joint, e in errors.items() if "hip_yaw" not in joint]
        assert np.mean(without_yaw) < 0.25, phase
