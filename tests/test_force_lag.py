"""Foot forces that are read through a low-pass: its time constant, and the friction without it."""

import dataclasses
import re

import numpy as np
import pytest
from conftest import scenario
from numba import njit
from rig import CLOCK
from scipy.signal import lfilter
from test_believed_effects import error
from test_force_delay import specific_force

from fbse_drake import simulate
from fbse_drake.effects.sensor import FootForceLag
from fbse_drake.estimation import estimate
from fbse_drake.estimators.force_lag import (
    force_lag_type,
    forget_force_lag,
    undo_lag,
    watch_force_lag,
)
from fbse_drake.estimators.recursive import Clock
from fbse_drake.estimators.spatial import vector

TICK = CLOCK.period


def low_passed(signal: np.ndarray, time_constant: float, period: float = TICK) -> np.ndarray:
    """Behind a low-pass of first order, exact for a signal that is held over each tick."""
    stays = np.exp(-period / time_constant)
    start = stays * signal[:1]
    return lfilter([1.0 - stays], [1.0, -stays], signal, axis=0, zi=start)[0]


@njit
def _watch(
    record: np.ndarray, shown: np.ndarray, read: np.ndarray, usable: np.ndarray, period: float
) -> np.ndarray:
    x, result = record[()], np.empty((len(shown), 2))
    for k in range(len(shown)):
        if usable[k]:
            watch_force_lag(x, vector(shown[k]), vector(read[k]), 0.02, period, period)
        else:
            forget_force_lag(x)
        result[k, 0], result[k, 1] = x.time_constant, x.delay
    return result


def found(
    truth: np.ndarray,
    forces: np.ndarray,
    gaps: tuple[int, ...] = (),
    period: float = TICK,
    noise: float = 0.02,
) -> tuple[np.ndarray, np.ndarray]:
    """Time constant [s] and delay [ticks] after every tick, by noisy IMU and joints and by forces,
    (N, 3) each."""
    generator = np.random.default_rng(0)
    shown = truth + 0.2 * generator.standard_normal(truth.shape)
    read = forces + noise * generator.standard_normal(forces.shape)
    record = np.zeros((), force_lag_type(Clock.every(period)))
    usable = ~np.isin(np.arange(len(truth)), gaps)
    time_constant, delay = _watch(record, shown, read, usable, period).T
    return time_constant, delay


def late(signal: np.ndarray, ticks: int) -> np.ndarray:
    return np.concatenate([np.repeat(signal[:1], ticks, axis=0), signal[: len(signal) - ticks]])


@pytest.mark.parametrize("time_constant", [0.005, 0.008, 0.02])
@pytest.mark.parametrize("ticks", [0, 4])
@pytest.mark.parametrize("gain", [0.9, 1.1])
def test_a_lag_is_found(time_constant: float, ticks: int, gain: float):
    """Within two steps of the walk, whatever delay, gain and bias the sensors have."""
    truth = specific_force(TICK * np.arange(3000))
    forces = late(gain * low_passed(truth, time_constant) + [0.3, 0.0, -0.5], ticks)
    lag, delay = found(truth, forces, gaps=(700, 1300, 1301))
    # As an implicit step has it, a low-pass is half a tick slower than in continuous time.
    assert np.abs(lag[1200:] + TICK / 2 - time_constant).max() < 0.1 * time_constant + TICK / 2
    assert np.all(np.abs(delay[1200:] - ticks) <= 1)


@pytest.mark.parametrize("time_constant", [0.001, 0.002, 0.003])
def test_what_may_as_well_be_a_delay_is_never_another_lag(time_constant: float):
    """By these noisy joints nobody can tell; then there is none, but no wrong one."""
    truth = specific_force(TICK * np.arange(3000))
    lag, delay = found(truth, low_passed(truth, time_constant))
    told = lag > 0
    assert np.abs((lag + delay * TICK + TICK / 2 - time_constant)[told]).max(initial=0.0) < 1e-3


@pytest.mark.parametrize("period", [5e-4, 2e-3])
def test_a_lag_is_found_at_other_rates(period: float):
    truth = specific_force(period * np.arange(round(3.0 / period)))
    lag, _ = found(truth, low_passed(truth, 0.008, period), period=period)
    settled = lag[round(1.5 / period) :]
    assert np.abs(settled + period / 2 - 0.008).max() < 1e-3


@pytest.mark.parametrize("ticks", [0, 1, 3, 8])
@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_what_only_comes_late_has_no_lag(ticks: int, noise: float):
    """Decoys: a delay, a gain, a bias, and noise of any size."""
    truth = specific_force(TICK * np.arange(6000))
    lag, _ = found(truth, late(1.2 * truth + [0.5, -0.2, 1.0], ticks), noise=noise)
    assert not lag.any()


def test_forces_that_answer_to_nothing_have_no_lag():
    """As where the robot hangs, or leans on something."""
    truth = specific_force(TICK * np.arange(4000))
    other = low_passed(np.random.default_rng(3).standard_normal(truth.shape), 0.01)
    lag, _ = found(truth, other)
    assert not lag.any()


@pytest.mark.parametrize("time_constant", [0.003, 0.03])
def test_a_low_pass_that_comes_and_goes_is_a_fault(time_constant: float):
    """It is not allowed for, for it would be allowed for when it is over."""
    truth = specific_force(TICK * np.arange(6000))
    forces = truth.copy()
    forces[2000:3000] = low_passed(truth, time_constant)[2000:3000]
    lag, _ = found(truth, forces)
    assert not lag.any()


def test_a_lag_that_is_no_more_is_given_up():
    truth = specific_force(TICK * np.arange(12000))
    forces = truth.copy()
    forces[:3000] = low_passed(truth, 0.005)[:3000]
    lag, _ = found(truth, forces)
    assert lag[2999] > 0.004
    assert not lag[9000:].any()


def test_a_lag_is_undone_exactly_where_it_came_by_implicit_steps():
    generator = np.random.default_rng(5)
    true, result = generator.standard_normal((50, 4, 3)), np.empty((4, 3))
    share = 0.007 / (0.007 + TICK)
    read = true[0]
    for force in true[1:]:
        before, read = read, share * read + (1.0 - share) * force
        undo_lag(result, read, before, 0.007, TICK)
        np.testing.assert_allclose(result, force, atol=1e-12)


@pytest.mark.parametrize("time_constant", [0.002, 0.006])
def test_friction_of_a_walk_whose_foot_sensors_lag(time_constant: float):
    """Nobody tells it. By the first landing it is known, and the friction as good as without."""
    walk = scenario("paper_walk_fbse", "duration=3.2")
    lag = FootForceLag(dict.fromkeys(("left", "right"), time_constant))
    robot = dataclasses.replace(walk.robot, effects={**walk.robot.effects, "lag": lag})
    log = simulate(dataclasses.replace(walk, robot=robot, model=walk.believed)).log
    assert error(log, 1.5) < 0.1
    remark = estimate(walk, log).remarks[-1]
    (found_time,) = re.findall(r"low-pass of ([0-9.]+) ms", remark)
    assert float(found_time) == pytest.approx(1e3 * time_constant, rel=0.1)
    # Behind the same model there is nothing more to find.
    completed = dataclasses.replace(
        walk, model=dataclasses.replace(walk.believed, effects={"l": lag})
    )
    told = estimate(completed, log)
    assert not any("found to be" in text for text in told.remarks)
    assert error(told.log, 1.0) < 0.06


def test_soft_landings_of_late_forces_show_no_lag():
    """On a slope the robot lands so softly that noise is a fifth of what the forces' rate shows: a
    delay of 6 ms then was half a low-pass, which made 17 Nm of noise of the next landing."""
    slope = ("ground.slope=[0.0116, 0.0265]", "sensors.foot_force.delay=0.006")
    common = ("duration=2", "compensation=!NoCompensation {}")
    log = simulate(scenario("hrp2_walk_fbse", *common, *slope, "estimator=!NoEstimator {}")).log
    remark = estimate(scenario("hrp2_walk_fbse", *common), log).remarks[-1]
    assert remark == "Foot forces were found to be 6 ms late."
