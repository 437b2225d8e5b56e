"""An IMU that is noisier than anybody said, and what the base filter makes of it."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from rig import estimated

from fbse_drake import Log
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.imu_noise import imu_noise_type, watch_noise

Run = Callable[..., Log]
NORMAL_99 = 2.58


@pytest.mark.parametrize("times", [1.0, 5.0])
def test_noise_is_told_from_motion(times: float):
    """A motion of 2 Hz that is a thousand times as large as the noise bends by a sixth of it."""
    generator, T, believed = np.random.default_rng(0), 1e-3, 0.02
    x, found = np.zeros((), imu_noise_type()), []
    for tick in range(3000):
        motion = 1e3 * believed * np.sin(4 * math.pi * T * tick)
        reading = motion + times * believed * generator.standard_normal(3)
        watch_noise(x[()], tuple(reading.tolist()), believed, T if tick else math.nan)
        found.append(float(x["noise"]))
    learned = np.array(found[1000:])
    assert learned.min() >= 1.0
    assert np.sqrt(np.median(learned)) == pytest.approx(times, rel=0.15)


def test_a_noisy_accelerometer_makes_no_velocity(run: Run):
    """Nine times as noisy as believed. Measured: 0.9 mm/s; where the noise was not learned, feet
    that contradicted the velocity were taken to move, and it ran away: 23 mm/s, and it was within
    its 99 % band for 56 % of the time."""
    walk = ("paper_walk_fbse", "duration=3.5")
    log = run(*walk, "sensors.imu.acceleration_noise=0.18")
    believed = scenario(*walk)
    result = estimated(log, believed, believed.estimator)
    later = result.time > 1.0
    error = (result["estimate/base/velocity"] - result["truth/base/velocity"])[later]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 3e-3
    within = np.abs(error) <= NORMAL_99 * result["estimate/base/velocity_std"][later]
    assert within.mean() > 0.95


def test_a_noisy_gyro_makes_no_velocity(run: Run):
    """Five times as noisy as believed. Measured: 0.8 mm/s."""
    walk = ("paper_walk_fbse", "duration=2.5")
    log = run(*walk, "sensors.imu.angular_velocity_noise=0.005")
    result = estimated(log, scenario(*walk), Fbse())
    later = result.time > 1.0
    error = (result["estimate/base/velocity"] - result["truth/base/velocity"])[later]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 2e-3
    within = np.abs(error) <= NORMAL_99 * result["estimate/base/velocity_std"][later]
    assert within.mean() > 0.95
