"""Foot forces that come late: by how much, and what the link torque and the friction make of it."""

import dataclasses
import math

import numpy as np
import pytest
from numba import njit
from rig import CLOCK, Base, Rig, pack
from test_friction_estimation import Friction, regressor
from test_link_torque import MODEL, READINGS, accelerations

from fbse_drake.estimators.beliefs import USUAL_SENSORS
from fbse_drake.estimators.force_delay import (
    delays_of,
    force_delay_type,
    forget_force_delay,
    tick_of,
    watch_force_delay,
)
from fbse_drake.estimators.link_torque import LinkTorqueEstimator
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, Past
from fbse_drake.estimators.spatial import vector

TICK = CLOCK.period


def specific_force(time: np.ndarray, step: float = 0.5) -> np.ndarray:
    """Of a walk: it rolls from side to side and jerks where a foot lands, (N, 3) [m/s^2]."""
    landing = np.exp(-(time % step) / 0.02) * np.sin(2 * np.pi * 25 * (time % step))
    sway = 2 * np.pi / (2 * step) * time
    return np.stack([landing, 0.5 * np.sin(sway), 9.81 + 5 * landing + 0.3 * np.cos(2 * sway)], 1)


@njit
def _watch(
    record: np.ndarray,
    shown: np.ndarray,
    read: np.ndarray,
    usable: np.ndarray,
    elapsed: np.ndarray,
    period: float,
) -> np.ndarray:
    x, result = record[()], np.empty(len(shown))
    for k in range(len(shown)):
        if usable[k]:
            watch_force_delay(x, vector(shown[k]), vector(read[k]), 0.02, elapsed[k], period)
        else:
            forget_force_delay(x)
        result[k] = x.delay / period
    return result


def found(
    truth: np.ndarray,
    forces: np.ndarray,
    gaps: tuple[int, ...] = (),
    elapsed: float | np.ndarray = TICK,
    period: float = TICK,
) -> np.ndarray:
    """The delay after every tick, by noisy IMU and joints and by forces, (N, 3) each [ticks]."""
    generator = np.random.default_rng(0)
    shown = truth + 0.2 * generator.standard_normal(truth.shape)
    read = forces + 0.02 * generator.standard_normal(forces.shape)
    usable = ~np.isin(np.arange(len(truth)), gaps)
    ticks = np.broadcast_to(elapsed, len(truth)).copy()
    record = np.zeros((), force_delay_type(Clock.every(period)))
    return _watch(record, shown, read, usable, ticks, period)


@pytest.mark.parametrize("late", [0, 1, 5, 9])
def test_a_delay_is_found_and_forgotten(late: int):
    """To a tick, within two steps of the walk, and at each step again when it is over.

    After two it is over for good. Gaps do not matter.
    """
    truth = specific_force(TICK * np.arange(4000))
    forces = truth.copy()
    forces[late:2000] = truth[: 2000 - late]
    ticks = found(truth, forces, gaps=(700, 1300, 1301))
    assert np.all(np.abs(ticks[1050:2000] - late) <= 1)
    assert np.all((ticks[2000:] == 0) | (np.abs(ticks[2000:] - late) <= 1))
    assert np.all(ticks[3050:] == 0)


@pytest.mark.parametrize(("period", "late"), [(5e-4, 7), (2e-3, 4)])
def test_a_delay_is_found_at_other_rates(period: float, late: int):
    """Slower clocks have fewer delays than there is room for."""
    truth = specific_force(period * np.arange(round(7.0 / period)))
    forces, end = truth.copy(), round(3.0 / period)
    forces[late:end] = truth[: end - late]
    ticks = found(truth, forces, elapsed=period, period=period)
    assert np.all(np.abs(ticks[round(1.5 / period) : end] - late) <= 1)
    assert np.all(ticks[round(5.0 / period) :] == 0)


def test_a_delay_that_begins_is_no_shorter_one_first():
    """What was in time before it began is no evidence against it."""
    time, late = TICK * np.arange(3000), 6
    truth = np.stack([np.sin(2 * np.pi * f * time) for f in (2.0, 3.1, 4.3)], axis=1)
    forces = truth.copy()
    forces[1500:] = truth[1500 - late : -late]
    ticks = found(truth, forces)
    assert not ticks[:1500].any()
    assert np.all((ticks[1500:] == 0) | (np.abs(ticks[1500:] - late) <= 1))
    assert np.all(np.abs(ticks[1700:] - late) <= 1)


def test_a_delay_that_came_with_a_fault_goes_with_it():
    """Though the robot then hardly moves, and nothing says that it is over."""
    time, late = TICK * np.arange(4000), 5
    truth = specific_force(time)
    truth[2700:] = [0.0, 0.0, 9.81] + 0.02 * np.sin(2 * np.pi * time[2700:, None])
    forces = truth.copy()
    forces[1900:2900] = truth[1900 - late : 2900 - late]
    ticks = found(truth, forces)
    assert not ticks[:1900].any()
    assert (np.abs(ticks[1900:2900] - late) <= 1).any()
    assert not ticks[3300:].any()


def test_a_delay_longer_than_any_looked_for_is_not_allowed_for():
    """The longest that is looked for is the best of them, and wrong; nor is it there afterwards."""
    truth = specific_force(TICK * np.arange(4000))
    forces = truth.copy()
    forces[1020:2000] = truth[1000:1980]
    ticks = found(truth, forces)
    assert np.all(ticks[1500:2000] == 0)
    assert np.all(ticks[2600:] == 0)


@pytest.mark.parametrize("gain", [0.9, 1.1])
def test_a_wrong_gain_or_bias_is_no_delay(gain: float):
    truth = specific_force(TICK * np.arange(2000))
    assert not found(truth, gain * truth).any()
    assert not found(truth, truth + [0.3, -0.3, 0.3]).any()


def test_what_does_not_change_tells_no_delay():
    """At rest noise alone decides, and must not; a delay that was found is kept."""
    still = np.tile([0.0, 0.0, 9.81], (3000, 1))
    assert not found(still, still).any()
    truth = np.concatenate([specific_force(TICK * np.arange(1500)), still])
    late = np.concatenate([truth[:4], truth[:-4]])
    assert np.all(np.abs(found(truth, late)[1000:] - 4) <= 1)


def test_a_sensor_that_becomes_noisy_is_no_delay():
    """The readings of ten ticks ago stay clean ten ticks longer: they must not look better."""
    truth = specific_force(TICK * np.arange(3000))
    for seed in range(5):
        noise = 7.0 * np.random.default_rng(seed).standard_normal(truth.shape)
        noise[:1000] = 0.0
        assert not found(truth + noise, truth).any()


def test_on_an_uneven_clock_no_delay_is_found():
    """A velocity's difference over a tick is then off by as much as the tick: chance decides."""
    generator, late = np.random.default_rng(2), 4
    truth = specific_force(TICK * np.arange(3000))
    forces = np.concatenate([truth[:late], truth[:-late]])
    uneven = TICK * (1.0 + 0.1 * generator.uniform(-1, 1, len(truth)))
    shown = truth * (TICK / uneven)[:, None]
    assert not found(shown, forces, elapsed=uneven).any()
    assert np.all(np.abs(found(truth, forces)[1000:] - late) <= 1)


def test_the_tick_that_ended_so_long_ago():
    ring = np.zeros(4, record_type(duration=()))
    assert tick_of(0.0, Past(3, ring), 3.0) == 4  # None is remembered yet.
    # The newest is the second; the one before it is the first, and the one before that the last.
    ring["duration"], past = [2.0, 1.0, 1.0, 1.0], Past(1, ring)
    assert [tick_of(1.0, past, delay) for delay in (0.0, 1.1, 1.9, 2.9, 3.1, 5.0)] == [
        0, 1, 2, 2, 3, 4,
    ]  # fmt: skip
    assert tick_of(1.0, past, math.nan) == 0


def test_delays_that_are_looked_for():
    assert delays_of(CLOCK) == 31
    assert delays_of(Clock.every(5e-4)) == 61
    # Slower sensors than that cannot be late by a whole tick.
    assert delays_of(Clock.every(0.05)) == 1


def test_usual_clocks_share_compiled_functions():
    """These are made for types, and a type holds the sizes of its arrays."""
    for period in (5e-4, 2e-3, 0.01, 0.05):
        assert force_delay_type(Clock.every(period)) is force_delay_type(CLOCK)
    assert force_delay_type(Clock.every(2.5e-4))["shown"].shape == (121, 3)


BASE_STATE = record_type(force_delay=record_type(delay=()), pad_force=(8, 3))


def test_link_torque_with_late_forces_is_that_of_the_tick_they_belong_to():
    generator, late, ticks = np.random.default_rng(1), 3, 12
    base, acceleration = Base.of(), accelerations()
    types = READINGS, MODEL, acceleration.posterior_type, CLOCK
    # What is learned of the forces' noise is of the past.
    sensors = dataclasses.replace(USUAL_SENSORS, learns_force_noise=False)
    usual = Rig(LinkTorqueEstimator(sensors, base.robot, *types))
    delayed = Rig(LinkTorqueEstimator(sensors, base.robot, *types, BASE_STATE))
    forces = generator.uniform(0, 200, size=(ticks, 8, 3))
    fields = "link_torque", "residual", "torque_variance", "impulse_variance", "own_inertia"
    told = np.zeros((), BASE_STATE)
    told["force_delay"]["delay"] = late * TICK
    expected, compared = [], 0
    for k in range(ticks):
        start = base.model_of(joint_position=generator.uniform(-0.4, 0.4, size=12))
        inputs = {
            "model_over_step": start,
            "joint_acceleration": pack(
                acceleration,
                joint_acceleration=generator.normal(size=12),
                known=generator.integers(0, 2, size=12),
                sensitivity=generator.normal(size=(18, 18)),
            ),
            "torque_command": generator.normal(size=12),
        }
        expected.append(usual.tick(measurements=base.measurements(pad_force=forces[k]), **inputs))
        old = base.measurements(pad_force=forces[max(0, k - late)])
        told["pad_force"] = old["mean"]["pad_force"]
        posterior = delayed.tick(measurements=old, base_state=told, **inputs)
        # An update without a tick is no further one to remember.
        delayed.system.ExecuteForcedEvents(delayed.context, publish=False)
        if k <= late:  # There is no tick before the first.
            assert not posterior["valid"].any()
            continue
        for name in fields:
            np.testing.assert_allclose(posterior[name], expected[k - late][name], rtol=1e-12)
        np.testing.assert_array_equal(posterior["valid"], expected[k - late]["valid"])
        compared += 1
    assert compared > 5


def test_friction_is_of_now_though_it_was_measured_some_ticks_ago():
    """Its law is found from the residual of five ticks ago, and told for the present velocity.

    Whoever takes the residual for that of now is wrong.
    """
    truth, late, errors = np.array([3.0, 2.0]), 5, {}
    time = TICK * np.arange(1500)
    velocity = 0.5 * np.sin(2 * np.pi * np.outer(time, np.linspace(1, 3, 12)))
    friction = regressor(velocity) @ truth
    for told in (late, 0):
        estimator = Friction(ModelAided(velocity_smoothing=0.0))
        error = []
        for k in range(len(time)):
            residual = friction[max(0, k - late)]
            posterior = estimator.see(velocity[k], residual, torque=1e-3, late=told)
            error.append(posterior["friction"] - friction[k])
        errors[told] = math.sqrt(np.mean(np.square(error[500:])))
    assert errors[late] < 0.02
    assert errors[0] > 0.3
