"""Observers that take friction for a disturbance or a fault, against closed forms."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from rig import CLOCK, TICK, Rig, estimated, part
from scipy.linalg import solve_discrete_are
from scipy.signal import cont2discrete
from scipy.stats import binom, chi2

from fbse_drake import InputError, Log, build_station
from fbse_drake.control.compensation import FaultReconfiguration
from fbse_drake.estimators.actuator_fault import (
    ActuatorFault,
    is_fault,
    with_fault,
    without_fault,
)
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.extended_state import ExtendedState, extended_state
from fbse_drake.estimators.filtered_model import gauss_seidel
from fbse_drake.estimators.q_filter import FilteredDisturbance, second_order_low_pass
from fbse_drake.robot.plant import make_robot
from fbse_drake.wiring import release

Run = Callable[..., Log]
POLE = 2 * np.pi * 20.0


@pytest.mark.parametrize("damping", [0.2, np.sqrt(0.5), 1.0, 1.7])
def test_q_is_the_low_pass_it_is_said_to_be(damping: float):
    """Against SciPy's zero-order hold of w^2 / (s^2 + 2 d w s + w^2), in another realisation."""
    A, B = np.array([[0, 1], [-(POLE**2), -2 * damping * POLE]]), np.array([[0], [POLE**2]])
    Ad, Bd, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), 3 * TICK)
    expected, states = np.zeros(2), np.zeros((2, 1))
    for value in np.random.default_rng(0).normal(size=50):
        expected = Ad @ expected + Bd[:, 0] * value
        states = second_order_low_pass(states, np.array([value]), POLE, damping, 3 * TICK)
        np.testing.assert_allclose(states[:, 0], expected, rtol=1e-9, atol=1e-9)


def test_q_meets_what_is_constant_and_lags_behind_what_rises():
    for damping in (0.5, 1.0):
        states = np.zeros((2, 2))
        for k in range(600):
            value = np.array([3.0, 2.0 * (k + 1) * TICK])
            states = second_order_low_pass(states, value, POLE, damping, TICK)
        assert states[0, 0] == pytest.approx(3.0, rel=1e-9)
        # The input is held for a tick: half a tick comes to the delay, a whole one is ahead.
        error = 2.0 * (600 * TICK) - states[0, 1]
        assert error == pytest.approx(2.0 * (2 * damping / POLE - TICK / 2), rel=1e-6)


def test_all_poles_of_the_extended_state_observer_lie_at_its_bandwidth():
    """The map of its errors from tick to tick, column by column, has one eigenvalue three times."""
    error = np.column_stack(
        [
            extended_state(column[:, None], np.zeros(1), np.zeros(1), POLE, TICK)[:, 0]
            for column in np.eye(3)
        ]
    )
    # Units of a tick, or else a triple eigenvalue is known to a third of all digits only.
    scale = np.array([1.0, TICK, TICK**2])
    found = np.poly(error / scale[:, None] * scale)
    np.testing.assert_allclose(found, np.poly([np.exp(-POLE * TICK)] * 3), atol=1e-12)


def test_the_extended_state_meets_what_is_constant_and_lags_behind_what_rises():
    """Joints that are accelerated by what the model explains, and by a disturbance of f = 2 and 3
    t."""
    angle, velocity, states = np.zeros(2), np.array([0.3, -0.2]), np.zeros((3, 2))
    for k in range(1500):
        f, explained = np.array([2.0, 3.0 * (k + 0.5) * TICK]), np.array([np.sin(k * 0.01), 1.0])
        angle = angle + TICK * velocity + 0.5 * TICK**2 * (explained + f)
        velocity = velocity + TICK * (explained + f)
        states = extended_state(states, angle, explained, POLE, TICK)
    np.testing.assert_allclose(states[:, 0], [angle[0], velocity[0], 2.0], rtol=1e-6)
    # What is told at the end of a tick is ahead of its middle.
    assert f[1] - states[2, 1] == pytest.approx(3.0 * (3.0 / POLE - TICK), rel=5e-3)


def test_a_fault_is_as_uncertain_as_the_riccati_equation_says():
    walk, measurement, disturbance = 2.0, np.array([1e-6, 4e-6]), np.array([1e-7, 1e-8])
    augmented = np.vstack([np.zeros(2), measurement, np.zeros(2), np.ones(2)])
    for _ in range(3000):
        augmented, _ = with_fault(
            augmented,
            np.zeros(2),
            np.zeros(2),
            np.zeros(2),
            (measurement, disturbance, walk),
            TICK,
        )
    for j in range(2):
        A, C = np.array([[1.0, -TICK], [0.0, 1.0]]), np.array([[1.0, 0.0]])
        Q = np.diag([disturbance[j], walk**2 * TICK])
        prior = solve_discrete_are(A.T, C.T, Q, measurement[j : j + 1, None])
        gain = prior @ C.T / (C @ prior @ C.T + measurement[j])
        posterior = prior - gain @ C @ prior
        expected = [posterior[0, 0], posterior[0, 1], posterior[1, 1]]
        np.testing.assert_allclose(augmented[1:, j], expected, rtol=1e-6)


def test_faults_are_isolated_and_false_alarms_as_rare_as_stated():
    """Momenta of 400 joints that are disturbed and measured with noise; the last 50 lose 0.3 Nm."""
    random, joints, false_alarms = np.random.default_rng(1), 400, 0.01
    measurement, disturbance = np.full(joints, 1e-6), np.full(joints, 2.5e-7)
    fault = np.where(np.arange(joints) < 350, 0.0, 0.3)
    momentum, estimate = np.zeros(joints), np.zeros(joints)
    healthy = np.stack([momentum, measurement])
    augmented = np.vstack([momentum, measurement, momentum, np.ones(joints)])
    evidence, keep, told = np.zeros(joints), np.exp(-TICK / 0.1), []
    for k in range(1500):
        momentum = momentum - TICK * fault + np.sqrt(disturbance) * random.normal(size=joints)
        measured = momentum + np.sqrt(measurement) * random.normal(size=joints)
        nothing = np.zeros(joints)
        healthy, innovation = without_fault(healthy, measured, nothing, measurement, disturbance)
        noise = (measurement, disturbance, 1.0)
        augmented, estimate = with_fault(augmented, estimate, measured, nothing, noise, TICK)
        evidence = keep * evidence + (1 - keep) * innovation
        if k >= 500 and k % 200 == 0:
            told.append(is_fault(evidence, keep, chi2.isf(false_alarms, 1)))
    told = np.array(told)
    assert told[:, 350:].mean() > 0.95
    # Five looks, each two windows after the last: as good as independent.
    alarms = told[:, :350]
    assert binom.cdf(alarms.sum(), alarms.size, false_alarms) > 1e-3
    assert binom.sf(alarms.sum() - 1, alarms.size, false_alarms) > 1e-3
    np.testing.assert_allclose(estimate[350:].mean(), 0.3, atol=0.03)


def test_only_what_a_faulty_actuator_loses_is_compensated():
    names = make_robot("double_pendulum")[0].description
    rig = Rig(FaultReconfiguration(cutoff=100.0).system(names, CLOCK))
    faults = {"estimate/joint/fault": np.array([1.0, 0.0])}
    for _ in range(200):
        torque = rig.tick(friction_estimate=np.array([0.7, 0.7]), **faults)["torque"]
    np.testing.assert_allclose(torque, [0.7, 0.0], atol=1e-9)


def test_reconfiguration_needs_an_estimator_that_isolates_faults():
    isolating, watching = (
        dataclasses.replace(
            scenario("squat", "duration=0.1"),
            estimator=estimator,
            compensation=FaultReconfiguration(),
        )
        for estimator in (ActuatorFault(), DisturbanceObserver())
    )
    release(build_station(isolating))
    with pytest.raises(InputError, match="compensation: input estimate/joint/fault: there is no"):
        build_station(watching)


def test_gauss_seidel_comes_to_least_squares_and_stays_within_limits():
    random = np.random.default_rng(3)
    phi, truth = random.normal(size=(2, 200, 3)), np.array([[0.5, 2.0, 1.0], [1.5, 0.2, -4.0]])
    information = np.einsum("nti,ntj->nij", phi, phi)
    seen = np.einsum("nij,nj->ni", information, truth)
    theta = np.zeros((2, 3))
    for _ in range(60):
        theta = gauss_seidel(theta, information, seen, (0.0, 50.0))
    np.testing.assert_allclose(theta[0], truth[0], rtol=1e-3)
    # The best within the limits: no gradient where it is free, one that leads out where it is not.
    gradient, is_free = seen[1] - information[1] @ theta[1], theta[1] > 0
    assert theta[1, 2] == 0.0
    np.testing.assert_allclose(gradient[is_free], 0.0, atol=1e-2)
    assert np.all(gradient[~is_free] < 0)


def test_on_a_walk_they_are_as_good_as_the_momentum_observer(run: Run):
    """All see the same balance: with the same delay they differ by their filters only."""
    log, walk = part(run("paper_walk_fbse", "duration=3"), 1.6), scenario("paper_walk_fbse")
    truth = log["truth/joint/friction_torque"][700:-1]

    def error(config: object) -> float:
        found = estimated(log, walk, config)["estimate/joint/friction_torque"][701:]
        return float(np.sqrt(np.mean((found - truth) ** 2) / np.mean(truth**2)))

    reference = error(DisturbanceObserver(10.0))
    assert error(FilteredDisturbance(14.0)) == pytest.approx(reference, rel=0.3)
    assert error(ExtendedState(20.0)) < 2.0 * reference
    assert error(ActuatorFault()) < 2.0 * reference


def test_friction_of_one_joint_is_a_fault_of_that_joint(run: Run):
    friction = "robot.effects.joint_friction=!CoulombFriction {coulomb: {left_knee_pitch: 3}}"
    log = run("frictionless_walk", "duration=1.1", friction, "sensors.encoders.velocity_noise=5e-4")
    walk = scenario("frictionless_walk", "duration=1.1")
    fault = estimated(log, walk, ActuatorFault())["estimate/joint/fault"][700:]
    share = dict(zip(log.joints, fault.mean(axis=0), strict=True))
    assert share.pop("left_knee_pitch") > 0.9
    assert max(share.values()) < 0.05


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FilteredDisturbance(damping=0.0), "damping: expected a number > 0, found 0"),
        (lambda: ExtendedState(bandwidth=-1.0), "bandwidth: expected a number > 0, found -1"),
        (lambda: ActuatorFault(false_alarms=1.0), r"false_alarms: expected a number in \(0, 1\)"),
    ],
)
def test_bad_values_get_one_line(make: Callable[[], object], message: str):
    with pytest.raises(InputError, match=message):
        make()
