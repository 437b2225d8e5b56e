"""What the controller makes of a friction estimate, alone and in the closed loop."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from rig import CLOCK, TICK, Rig, rms

from fbse_drake import InputError, Log, Scenario, load_scenario, simulate
from fbse_drake.control.compensation import (
    FeedforwardCompensation,
    FrictionCompensation,
    IntegralCompensation,
    NoCompensation,
)
from fbse_drake.estimators.estimator import NoEstimator
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.torque_sensor import TorqueSensor, TorqueSensorEstimator
from fbse_drake.estimators.true_friction import TrueFriction
from fbse_drake.report.metrics import joint_tracking_rms
from fbse_drake.robot.description import load_description
from fbse_drake.sensors.joint_torque import JointTorqueConfig

NAMES, _ = load_description("biped")
Run = Callable[..., Log]


def test_integral_law_is_a_low_pass():
    """Step response 1 - exp(-k t) of (69), joint by joint with its gain."""
    gain = {
        "hip_yaw": 2.0,
        "hip_roll": 2.0,
        "hip_pitch": 1.0,
        "knee_pitch": 3.0,
        "ankle_pitch": 2.0,
        "left_ankle_roll": 4.0,
        "ankle_roll": 0.0,
    }
    rig = Rig(FrictionCompensation(IntegralCompensation(gain=gain), NAMES, CLOCK))
    rate, step = np.array([2.0, 2, 1, 3, 2, 4, 2, 2, 1, 3, 2, 0]), np.linspace(-5, 6, 12)
    for k in range(1001):
        torque = rig.tick(friction_estimate=step)["torque"]
        np.testing.assert_allclose(
            torque, step * (1 - np.exp(-rate * k * TICK)), rtol=1e-9, atol=1e-12
        )
    assert torque[-1] == 0


def test_feedforward_has_its_cutoff_share_and_limit():
    config = FeedforwardCompensation(cutoff=20.0, share=0.8, limit=10.0)
    rig = Rig(FrictionCompensation(config, NAMES, CLOCK))
    time, amplitude = np.arange(2000) * TICK, 6.0
    torque = np.array(
        [
            rig.tick(friction_estimate=amplitude * np.sin(2 * np.pi * 20 * t) * np.ones(12))[
                "torque"
            ][4]
            for t in time
        ]
    )
    # At the cut-off a first-order low-pass passes 1 / sqrt(2).
    assert np.abs(torque[1000:]).max() == pytest.approx(0.8 * amplitude / np.sqrt(2), rel=0.05)
    for _ in range(200):
        posterior = rig.tick(friction_estimate=np.repeat([1000.0, -1000.0], 6))
    np.testing.assert_allclose(posterior["torque"], np.repeat([10.0, -10.0], 6), rtol=1e-6)


def test_torque_sensor_measures_command_minus_link_torque():
    """The command of the tick before, for that is whose torque is measured."""
    rig = Rig(TorqueSensorEstimator(TorqueSensor(cutoff=1e6), 12, CLOCK))
    generator = np.random.default_rng(0)
    command = generator.normal(size=(20, 12))
    friction = generator.normal(size=(20, 12))
    for k in range(1, 20):
        posterior = rig.tick(
            torque_command=command[k], measured_torque=command[k - 1] - friction[k - 1]
        )
        if k > 1:
            np.testing.assert_allclose(posterior["friction"], friction[k - 1], atol=1e-12)


@pytest.fixture(scope="module")
def tracking(run: Run) -> dict[str, np.ndarray]:
    """Root mean square tracking error of each joint [rad] in the first 2 s of the walk with HRP-2's
    friction."""
    walk = load_scenario("hrp2_walk_fbse", overrides=("duration=2",))
    ideal = dataclasses.replace(
        walk, compensation=NoCompensation(), robot=dataclasses.replace(walk.robot, effects={})
    )
    logs = {
        "none": run("hrp2_friction_walk", "duration=2"),
        "fbse": run("hrp2_walk_fbse", "duration=2"),
        "oracle": simulate(dataclasses.replace(walk, estimator=TrueFriction())).log,
        "frictionless": simulate(dataclasses.replace(ideal, estimator=NoEstimator())).log,
    }
    assert not any(log.meta["outcome"]["fell"] for log in logs.values())
    return {name: joint_tracking_rms(log) for name, log in logs.items()}


def test_compensation_tracks_better(tracking: dict[str, np.ndarray]):
    """Hip yaws stick: they stay within two counts of an encoder with or without compensation."""
    assert rms(tracking["fbse"]) < rms(tracking["none"]) / 4
    moved = tracking["none"] > 2 * 4.8e-5
    assert moved.sum() == 10
    assert np.all(tracking["fbse"][moved] < tracking["none"][moved] / 2)
    assert rms(tracking["fbse"]) < 1.2 * rms(tracking["frictionless"])


def test_oracle_makes_the_robot_frictionless(tracking: dict[str, np.ndarray]):
    assert rms(tracking["oracle"]) == pytest.approx(rms(tracking["frictionless"]), rel=0.1)


def test_estimate_in_the_loop_is_the_friction(run: Run):
    """Feeding the estimate forward does not spoil the estimate."""
    log = run("hrp2_walk_fbse", "duration=2")
    error = (log["estimate/joint/friction_torque"][1:] - log["truth/joint/friction_torque"][:-1])[
        300:
    ]
    truth = log["truth/joint/friction_torque"][300:]
    # The hip's yaw hardly moves; what is left there is noise.
    assert np.all(
        np.sqrt(np.mean(error**2, axis=0)) < 0.05 * np.sqrt(np.mean(truth**2, axis=0)) + 0.2
    )
    assert rms(truth) > 5


def test_oracle_is_the_truth():
    short = dataclasses.replace(
        load_scenario("paper_walk_integral", overrides=("duration=0.3",)), estimator=TrueFriction()
    )
    log = simulate(short).log
    np.testing.assert_array_equal(
        log["estimate/joint/friction_torque"][1:], log["truth/joint/friction_torque"][:-1]
    )


def test_integral_compensation_reaches_the_command():
    """Command = position loop + feed-forward + low-passed estimate, from logged channels alone."""
    short = load_scenario("paper_walk_integral", overrides=("duration=0.5",))
    log = simulate(short).log
    kp = NAMES.per_joint(short.control.kp, key="kp")
    kd = NAMES.per_joint(short.control.kd, key="kd")
    loop = kp * (log["reference/joint/position"] - log["joint/position"]) + kd * (
        log["reference/joint/velocity"] - log["joint/velocity"]
    )
    added = log["joint/torque_command"] - loop - log["reference/joint/feedforward_torque"]
    gain = NAMES.per_joint(short.compensation.gain, key="gain")
    expected = np.zeros_like(added)
    for k in range(1, len(added)):
        expected[k] = expected[k - 1] + (1 - np.exp(-gain * TICK)) * (
            log["estimate/joint/friction_torque"][k] - expected[k - 1]
        )
    np.testing.assert_allclose(added, expected, atol=1e-9)
    assert np.abs(expected[-1]).max() > 0.05


def test_torque_sensor_in_the_loop():
    """With noise-free sensors its estimate is the friction behind a low-pass."""
    base = scenario("paper_walk", "duration=0.5", noise=False)
    sensors = dataclasses.replace(base.sensors, joint_torque=JointTorqueConfig())
    log = simulate(
        dataclasses.replace(base, sensors=sensors, estimator=TorqueSensor(cutoff=50.0))
    ).log
    keep = np.exp(-2 * np.pi * 50.0 * TICK)
    expected = np.zeros(12)
    for k in range(1, len(log.time)):
        expected = keep * expected + (1 - keep) * log["truth/joint/friction_torque"][k - 1]
        np.testing.assert_allclose(log["estimate/joint/friction_torque"][k], expected, atol=1e-9)


def refusal(make: Callable[[], object]) -> str:
    with pytest.raises(InputError) as refused:
        make()
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_refusals():
    assert "needs an estimator" in refusal(lambda: Scenario(compensation=IntegralCompensation()))
    assert "needs an estimator" in refusal(lambda: Scenario(compensation=FeedforwardCompensation()))
    assert "sensors.joint_torque" in refusal(lambda: Scenario(estimator=TorqueSensor()))
    assert "hip_yw" in refusal(
        lambda: FrictionCompensation(IntegralCompensation(gain={"hip_yw": 1.0}), NAMES, CLOCK)
    )
    assert "no value for" in refusal(
        lambda: FrictionCompensation(IntegralCompensation(gain={"hip_yaw": 1.0}), NAMES, CLOCK)
    )
    assert "cutoff" in refusal(lambda: FeedforwardCompensation(cutoff=0.0))
    assert "share" in refusal(lambda: FeedforwardCompensation(share=1.1))
    assert "gain.hip_yaw" in refusal(lambda: IntegralCompensation(gain={"hip_yaw": -1.0}))
    # With what they need they are not refused.
    Scenario(compensation=IntegralCompensation(), estimator=Fbse())
    with_sensor = dataclasses.replace(Scenario().sensors, joint_torque=JointTorqueConfig())
    Scenario(estimator=TorqueSensor(), sensors=with_sensor)
