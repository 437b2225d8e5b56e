"""What is estimated from logs of 50 Hz to 2 kHz, with one configuration."""

from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from rig import rms

from fbse_drake import Log, simulate
from fbse_drake.estimation import estimate
from fbse_drake.estimators.recursive import start_share

Run = Callable[..., Log]
WALK = scenario("paper_walk_fbse", "duration=3")


def decimated(log: Log, every: int) -> Log:
    """Every so manieth row; forces and specific force stay means over one millisecond.

    The truth of the friction becomes its mean over the tick that begins at a row.
    """
    rows = {name: values[::every] for name, values in log.channels.items()}
    truth = log["truth/joint/friction_torque"]
    whole = len(truth) // every * every
    means = truth[:whole].reshape(-1, every, truth.shape[1]).mean(axis=1)
    rows["truth/joint/friction_torque"] = np.concatenate([means, truth[-1:]])[: len(rows["time"])]
    kept = {name: values for name, values in rows.items() if not name.startswith("estimate/")}
    return Log(kept, log.meta | {"period": every * log.meta["period"]})


def friction_errors(log: Log, later: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (rows, n) [Nm], and NRMSE of the joints but for hip yaws; at ticks that begin at
    rows."""
    truth = log["truth/joint/friction_torque"][later - 1]
    error = log["estimate/joint/friction_torque"][later] - truth
    moving = [k for k, joint in enumerate(log.joints) if "yaw" not in joint]
    return error, np.sqrt((error**2).mean(axis=0) / (truth**2).mean(axis=0))[moving]


# Measured, the worst of three seeds: friction 0.04, 0.06, 0.12, 0.18, 0.22, of a joint 0.08, 0.08,
# 0.23, 0.36, 0.37; of five 0.7, 0.8, 1.0, 1.7, 2.0 mm/s; 0.01, 0.01, 0.03, 0.05, 0.07 deg. What
# rare readings miss is learned neither as noise nor as law: taken for the mean over a tick, they
# make a joint's error as large as its friction at 100 Hz.
@pytest.mark.parametrize(
    ("every", "friction", "worst", "velocity", "tilt"),
    [
        (1, 0.07, 0.12, 1.0e-3, 0.02),
        (2, 0.09, 0.14, 1.2e-3, 0.02),
        (5, 0.14, 0.25, 1.5e-3, 0.04),
        (10, 0.2, 0.4, 2.2e-3, 0.07),
        (20, 0.3, 0.6, 2.6e-3, 0.10),
    ],
)
def test_errors_grow_gently(
    run: Run, every: int, friction: float, worst: float, velocity: float, tilt: float
):
    log = estimate(WALK, decimated(run("paper_walk_fbse", "duration=3"), every)).log
    later = np.flatnonzero(log.time >= 1.0)
    assert (log["estimate/sensors/status"] == 0).all()
    error, nrmse = friction_errors(log, later)
    assert nrmse.mean() < friction
    assert nrmse.max() < worst
    wrong = log["estimate/base/velocity"] - log["truth/base/velocity"]
    assert max(rms(wrong[later, i]) for i in range(3)) < velocity
    turned = 2 * np.abs(log["estimate/base/orientation"] - log["truth/base/orientation"])
    assert np.rad2deg(max(rms(turned[later, 1 + i]) for i in range(2))) < tilt
    # The standard deviation grows with the error.
    std = log["estimate/joint/friction_torque_std"][later]
    assert np.mean(np.abs(error) < 2.58 * std) > 0.96


JOINT_BY_JOINT = scenario("paper_walk_fbse", "duration=3", "estimator.friction=!ModelAided {}")


# Measured, the worst of five seeds: 0.09, 0.25, 0.33, 0.49.
@pytest.mark.parametrize(("every", "friction"), [(2, 0.12), (5, 0.32), (10, 0.42), (20, 0.62)])
def test_joint_by_joint_errors_grow_gently(run: Run, every: int, friction: float):
    log = estimate(JOINT_BY_JOINT, decimated(run("paper_walk_fbse", "duration=3"), every)).log
    later = np.flatnonzero(log.time >= 1.0)
    error, nrmse = friction_errors(log, later)
    assert nrmse.mean() < friction
    std = log["estimate/joint/friction_torque_std"][later]
    assert np.mean(np.abs(error) < 2.58 * std) > 0.96


def test_two_kilohertz():
    step = 5e-4
    periods = (f"sensors.{name}.period={step}" for name in ("encoders", "imu", "foot_force"))
    settings = (f"plant.time_step={step}", f"control.period={step}", f"log.period={step}", *periods)
    log = simulate(scenario("paper_walk_fbse", "duration=1.5", *settings)).log
    later = np.flatnonzero(log.time >= 1.0)
    assert (log["estimate/sensors/status"] == 0).all()
    wrong = log["estimate/base/velocity"] - log["truth/base/velocity"]
    assert max(rms(wrong[later, i]) for i in range(3)) < 1.5e-3
    truth = log["truth/joint/friction_torque"][later - 1]
    error = log["estimate/joint/friction_torque"][later] - truth
    assert rms(error) < 0.25 * rms(truth)


def test_mean_over_a_tick():
    """Readings that last a tick are its mean already; samples are joined by straight lines."""
    assert start_share(1e-3, 1e-3) == 0.0
    assert start_share(float("nan"), 1e-3) == 0.0
    assert start_share(1e-2, 0.0) == 0.5
    # A straight line from 0 to 1 over 10 ms, whose last millisecond was read: 0.95.
    share = start_share(1e-2, 1e-3)
    before, now = -0.05, 0.95
    assert now + share * (before - now) == pytest.approx(0.5)
