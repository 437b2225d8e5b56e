"""Sensors that are read more seldom than the plant steps: what they tell, and what uses them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from fbse_drake import Log, simulate
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import library
from fbse_drake.estimation import estimate
from fbse_drake.report.metrics import friction_nrmse
from fbse_drake.sensors.sample_and_hold import SampleAndHold

Run = Callable[..., Log]
SQUAT = ("squat", "duration=0.6", "estimator=!NoEstimator {}")


@pytest.mark.parametrize("period", [0.004, 0.0025])
def test_a_line_is_held_from_each_tick_to_the_next(period: float):
    builder = DiagramBuilder()
    line = PiecewisePolynomial.FirstOrderHold([0.0, 1.0], [[0.0, 1.0], [2.0, -1.0]])
    source = builder.AddSystem(TrajectorySource(line))
    hold = builder.AddSystem(SampleAndHold(period, 2))
    builder.Connect(source.get_output_port(), hold.get_input_port())
    builder.ExportOutput(hold.held)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    for k in range(1, 40):
        time = k * 0.001
        simulator.AdvanceTo(time)
        tick = np.floor(time / period + 1e-6) * period
        held = diagram.get_output_port().Eval(simulator.get_context())
        np.testing.assert_allclose(held, [tick, 2.0 - 3.0 * tick], atol=1e-12)


@pytest.mark.parametrize(
    ("sensor", "exact", "channel"),
    [
        ("foot_force", "noise: 0", "foot/left/pad_force"),
        ("encoders", "resolution: 0", "joint/position"),
        ("encoders", "velocity_noise: 0", "joint/velocity"),
    ],
)
def test_a_slow_sensor_tells_the_truth_of_its_last_tick(
    run: Run, sensor: str, exact: str, channel: str
):
    slow = f"sensors.{sensor}={{{exact}, period: 0.002}}"
    log = run(*SQUAT, slow, "control.kd={all: 6}")
    truth, rows = log[f"truth/{channel}"], np.arange(len(log.time))
    assert np.any(truth[1:] != truth[:-1])
    np.testing.assert_allclose(log[channel], truth[rows // 2 * 2], atol=1e-12)


def test_a_differenced_velocity_is_the_mean_since_the_last_reading(run: Run):
    slow = "sensors.encoders={velocity: differenced, period: 0.004}"
    log = run(*SQUAT, slow, "control.period=0.004", "control.kd={all: 20}")
    angle, velocity = log["joint/position"][::4], log["joint/velocity"][::4]
    np.testing.assert_allclose(velocity[1:], np.diff(angle, axis=0) / 0.004, atol=1e-12)
    assert np.abs(velocity).max() > 0.01


@pytest.mark.parametrize("sensor", ["foot_force", "imu"])
def test_slow_sensors_are_no_effect(run: Run, sensor: str):
    walk = ("paper_walk", "duration=3.2", f"sensors.{sensor}.period=0.005", "seed=12")
    believed = scenario(*walk, "estimator=!NoEstimator {}")
    believed = replace(believed, model=believed.robot)
    tried = [library()[n] for n in ("FootForceLag", "ImuMisalignment", "TorqueLag", "TorqueGain")]
    found = diagnose(Predictor(believed, run(*walk, "estimator=!NoEstimator {}")), tried)
    assert (found.verdict, found.chosen) == ("nothing_missing", [])


def test_the_station_estimates_when_joints_and_feet_are_read(run: Run):
    """As `estimate` does over its log: with the mean of the commands that were given meanwhile."""
    walk = ("paper_walk_fbse", "duration=3", "sensors.foot_force.period=0.005")
    log = run(*walk)
    friction = log["estimate/joint/friction_torque"]
    assert np.all(np.diff(friction, axis=0)[np.arange(len(friction) - 1) % 5 != 4] == 0)
    again = estimate(scenario(*walk), log).log["estimate/joint/friction_torque"]
    np.testing.assert_allclose(friction, again, atol=1e-6)
    for phase, errors in friction_nrmse(log).items():
        without_yaw = [e for joint, e in errors.items() if "hip_yaw" not in joint]
        assert np.mean(without_yaw) < 0.2, phase


def test_a_fall_of_a_loop_that_held_readings_excite_says_so():
    walk = scenario("paper_walk", "duration=3", "sensors.encoders.period=0.004")
    failure = simulate(walk).failure
    assert failure is not None
    assert "held readings and commands leave the control a damping of -8 Nms/rad in" in failure
