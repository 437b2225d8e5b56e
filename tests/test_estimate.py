"""Estimation over a recorded log."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario

from fbse_drake import InputError, Log, Scenario, load_scenario, simulate
from fbse_drake.estimation import estimate
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.estimator import NoEstimator, make_estimator
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.support import PlannedSupport
from fbse_drake.robot.plant import make_robot
from fbse_drake.sensors.encoders import differentiate
from fbse_drake.walking.reference import Recorded

Run = Callable[..., Log]
# The plan, of which the duration is, only says where the feet stand at first.
WALK = scenario("paper_walk_fbse", "duration=0.1")


def cut(log: Log, rows: slice | np.ndarray, **channels: np.ndarray) -> Log:
    """Some rows of a log, with other values in some channels (`time`, ...)."""
    return dataclasses.replace(
        log,
        channels={name: channels.get(name, values)[rows] for name, values in log.channels.items()},
    )


def without(log: Log, *prefixes: str) -> Log:
    return dataclasses.replace(
        log,
        channels={
            name: values for name, values in log.channels.items() if not name.startswith(prefixes)
        },
    )


def estimates(log: Log) -> dict[str, np.ndarray]:
    return {name: values for name, values in log.items() if name.startswith("estimate/")}


def assert_same(found: Log, expected: Log, atol: float = 1e-9) -> None:
    assert estimates(found).keys() == estimates(expected).keys()
    for name, values in estimates(expected).items():
        np.testing.assert_allclose(
            found[name], values, rtol=0, atol=atol * max(1.0, np.abs(values).max()), err_msg=name
        )


def error(log: Log) -> float:
    """Root mean square friction error over the friction's, after 0.3 s."""
    truth = log["truth/joint/friction_torque"][:-1]
    found = log["estimate/joint/friction_torque"][1:]
    after = log.time[1:] > 0.3
    return float(np.sqrt(np.mean((found - truth)[after] ** 2) / np.mean(truth[after] ** 2)))


@pytest.mark.parametrize(
    "walk",
    [
        load_scenario("paper_walk_fbse", overrides=("duration=1.2",)),
        load_scenario("paper_walk_fbse", "paper_method", overrides=("duration=1.2",)),
        load_scenario("hrp2_walk_fbse", overrides=("duration=0.8",)),
        dataclasses.replace(
            load_scenario("paper_walk", overrides=("duration=0.8",)),
            estimator=DisturbanceObserver(),
        ),
    ],
    ids=["best", "paper", "compensated", "observer"],
)
def test_replay_is_what_ran_live(walk: Scenario):
    live = simulate(walk).log
    assert len(estimates(live)) > 10
    # From sensor channels alone.
    bare = without(live, "estimate/", "truth/", "reference/")
    assert_same(estimate(walk, bare).log, live)


def test_replay_is_repeatable_to_the_bit(run: Run):
    log = cut(run("paper_walk_fbse", "duration=3"), slice(0, 400))
    first, second = (estimate(WALK, log).log for _ in range(2))
    for name, values in estimates(first).items():
        assert np.array_equal(values, second[name]), name


def test_log_is_not_changed(run: Run):
    log = cut(run("paper_walk_fbse", "duration=3"), slice(0, 50))
    before = {name: values.copy() for name, values in log.items()}
    result = estimate(WALK, log)
    assert all(np.array_equal(log[name], values) for name, values in before.items())
    assert result.tick_time.shape == (50,)
    assert np.all(result.tick_time > 0)


def test_samples_may_be_missing_and_late(run: Run):
    """One in twenty is missing, and the clock that stamps them jitters by a twentieth of a tick."""
    log = cut(run("paper_walk_fbse", "duration=3"), slice(0, 2001))
    generator = np.random.default_rng(0)
    kept = generator.random(len(log.time)) > 0.05
    kept[0] = True
    jittered = log.time + generator.uniform(-5e-5, 5e-5, size=len(log.time)) * (log.time > 0)
    result = estimate(WALK, cut(log, kept, time=jittered)).log
    assert len(result.time) < 0.97 * len(log.time)
    assert all(np.isfinite(values).all() for values in estimates(result).values())
    assert (result["estimate/sensors/status"] == 0).all()
    assert error(log) < 0.2
    assert error(result) < 1.3 * error(log)


def test_a_log_says_for_how_long_its_commands_are_held(run: Run):
    """As a scenario says of those that do not."""
    rare = run("paper_walk_fbse", "duration=1").part(slice(None, None, 5))
    unsaid = {key: value for key, value in rare.meta.items() if key != "command_time"}

    def estimated(log: Log, held: float) -> Log:
        periods = (f"control.period={held}", "duration=0.1")
        return estimate(scenario("paper_walk_fbse", *periods), log).log

    held = estimated(dataclasses.replace(rare, meta=unsaid | {"command_time": 0.005}), held=0.001)
    assert_same(held, estimated(dataclasses.replace(rare, meta=unsaid), held=0.005), atol=0.0)
    sampled = estimated(rare, held=0.005)
    assert_same(sampled, estimated(dataclasses.replace(rare, meta=unsaid), held=0.001), atol=0.0)
    assert error(sampled) < error(held)


def test_without_joint_velocities(run: Run):
    log = cut(run("paper_walk_fbse", "duration=3"), slice(0, 2001))
    result = estimate(WALK, without(log, "joint/velocity")).log
    assert "joint/velocity" not in result
    assert all(np.isfinite(values).all() for values in estimates(result).values())
    assert (result["estimate/sensors/status"] == 0).all()
    assert error(result) < 0.6


def test_differentiation():
    """A ramp gives its slope, after two time constants in series; a sine its derivative, late by
    both."""
    time = np.arange(2000) * 1e-3
    ramp = differentiate(time, np.outer(time, [1.0, -2.0]), 0.004)
    t = time[1:, None]
    response = 1 - np.exp(-t / 0.004) * (1 + t / 0.004)
    np.testing.assert_allclose(ramp[1:], response * [1.0, -2.0], atol=0.1)
    np.testing.assert_allclose(ramp[100:], np.tile([1.0, -2.0], (1900, 1)), rtol=1e-9)
    w = 2 * np.pi * 2
    sine = differentiate(time, np.sin(w * time)[:, None], 0.004)[:, 0]
    np.testing.assert_allclose(sine[200:], w * np.cos(w * (time - 0.0075))[200:], atol=0.02 * w)


def test_refusals(run: Run):
    log = cut(run("paper_walk_fbse", "duration=3"), slice(0, 5))
    for scenario_, bad, message in (
        (WALK, without(log, "imu/"), "imu/linear_acceleration"),
        (
            WALK,
            without(log, "foot/left/pad_force"),
            "no channel foot/left/pad_force, nor foot/left/wrench",
        ),
        (WALK, without(log, "foot/"), "foot/<side>/pad_force"),
        (dataclasses.replace(WALK, estimator=NoEstimator()), log, "the scenario has none"),
        (
            WALK,
            dataclasses.replace(log, meta={**log.meta, "joints": log.joints[::-1]}),
            "the log's joints",
        ),
        (
            WALK,
            dataclasses.replace(log, meta={**log.meta, "period": 0.2 * log.meta["period"]}),
            "most of its samples are 0.001 s apart",
        ),
        (
            WALK,
            cut(log, slice(0, 5), **{"foot/left/pad_force": log["foot/left/pad_force"][:, :3]}),
            "expected 4 pads",
        ),
    ):
        with pytest.raises(InputError) as refused:
            estimate(scenario_, bad)
        assert message in str(refused.value)
        assert "\n" not in str(refused.value)


def test_without_torque_commands_all_but_the_friction(run: Run):
    """What needs no torques is what it is with them."""
    log = cut(run("paper_walk_fbse", "duration=3"), slice(0, 400))
    walk = dataclasses.replace(WALK, estimator=Fbse(friction=ModelAided()))
    told, untold = (estimate(walk, x) for x in (log, without(log, "joint/torque_command")))
    assert untold.remarks == (
        *told.remarks,
        "The friction is not known: the log has no joint/torque_command.",
    )
    found = estimates(untold.log)
    assert "estimate/base/velocity" in found
    assert not [name for name in found if "friction" in name or "torque" in name]
    for name, values in found.items():
        np.testing.assert_array_equal(values, told.log[name])
    observer = dataclasses.replace(WALK, estimator=DisturbanceObserver())
    with pytest.raises(
        InputError, match=r"^the log has no channel for .* torque_command \(joint/torque_command\)$"
    ):
        estimate(observer, without(log, "joint/torque_command"))


def test_recorded_motion_starts_at_the_origin(run: Run):
    log = cut(run("paper_walk_fbse", "duration=3"), slice(0, 100))
    planned, recorded = (
        estimate(dataclasses.replace(WALK, reference=reference), log).log["estimate/base/position"]
        for reference in (WALK.reference, Recorded())
    )
    moved = recorded - planned
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-4)
    assert np.linalg.norm(moved[0]) > 0.01


def test_what_is_believed_of_the_sensors():
    """Stated by the scenario; a noise of zero is a small one; the estimator's own word wins."""
    believed = WALK.believed_sensors
    assert believed.joint_position_noise == pytest.approx(4.8e-5 / np.sqrt(12))
    assert (believed.joint_velocity_noise, believed.acceleration_noise) == (5e-4, 0.02)
    assert (believed.angular_velocity_noise, believed.force_noise) == (1e-3, 0.5)
    exact = scenario(
        "paper_walk_fbse", "estimator.sensors.force_noise=3", noise=False
    ).believed_sensors
    assert exact.force_noise == 3
    assert exact.acceleration_noise == pytest.approx(0.002)
    assert not exact.joint_velocity_counted
    counted = "sensors.encoders={resolution: 0.0015, period: 0.01, velocity: differenced}"
    coarse = scenario("paper_walk_fbse", counted).believed_sensors
    assert coarse.joint_velocity_counted
    assert coarse.joint_velocity_noise == pytest.approx(np.sqrt(2) * 0.0015 / np.sqrt(12) / 0.01)


def test_old_places_of_noise_are_refused():
    for key in (
        "joint_acceleration.acceleration_noise",
        "attitude.acceleration_noise",
        "link_torque",
    ):
        with pytest.raises(InputError, match="unknown key"):
            scenario("paper_walk_fbse", f"estimator.{key}=0.1")


def test_planned_support_needs_a_plan():
    robot, _ = make_robot("biped")
    with pytest.raises(
        InputError, match=r"!PlannedSupport needs a planned walk or stand \(use !MeasuredSupport\)"
    ):
        make_estimator(Fbse(support=PlannedSupport()), robot, period=1e-3)
    assert make_estimator(Fbse(), robot, period=1e-3) is not None
