"""Feet that read their forces wrong, by what the robot weighs: against a brute-force average over
hypotheses, truth that is drawn, and walks."""

import re
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from conftest import scenario
from rig import coverage, rms
from scipy.stats import multivariate_normal
from test_sampling_rates import decimated

from fbse_drake import Log
from fbse_drake.estimation import estimate
from fbse_drake.estimators import force_balance
from fbse_drake.estimators.force_balance import force_balance_type, watch_balance
from fbse_drake.report.metrics import friction_error
from fbse_drake.scenario import build_robot

Run = Callable[..., Log]
TICK, GAIN = 0.002, 0.05
STEP_TIME = 0.7


def loads(time: np.ndarray, feet: int) -> np.ndarray:
    """What each foot carries of the weight, (T, feet): in turns, one of them all of it."""
    phase = time[:, None] / STEP_TIME - np.arange(feet)
    alone = np.clip(2.0 * np.cos(2 * np.pi * phase / feet), 0.0, 1.0) + 0.02
    return alone / alone.sum(axis=1, keepdims=True)


def watched(read: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """What is known in the end of loads that are read, (T, feet), and the weight of the model."""
    balance = np.zeros((), force_balance_type(read.shape[1]))
    for load, of_tick in zip(read, weight, strict=True):
        watch_balance(balance[()], load, of_tick, TICK, GAIN)
    return balance


def drawn(
    seed: int, gains: list[float], mass: float = 0.0, seconds: float = 4.0
) -> tuple[np.ndarray, np.ndarray]:
    """Loads as they are read, and the model's weight, with noise of sensors."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, TICK)
    accelerated = 1.0 + 0.1 * np.sin(9.0 * time)
    true = accelerated[:, None] * loads(time, len(gains))
    noise = 0.003 * generator.standard_normal((2, *true.shape))
    return true / (1.0 + np.array(gains)) + noise[0], accelerated / (1.0 + mass) + noise[1, :, 0]


@pytest.mark.parametrize(
    "gains", [[0.05, 0.0], [0.0, -0.02], [0.03, -0.03], [0.0, 0.0, 0.04, 0.0], [-0.03, 0.01, 0.03]]
)
def test_feet_that_read_wrong_are_found(gains: list[float]):
    """One of them, or several; to 0.3 % of their forces, with any noise."""
    for seed in range(5):
        found = watched(*drawn(seed, gains))
        np.testing.assert_allclose(found["gains"], gains, atol=0.003)


@pytest.mark.parametrize("feet", [1, 2, 4])
@pytest.mark.parametrize(("gain", "mass"), [(0.0, 0.0), (0.0, 0.05), (0.05, 0.0)])
def test_what_all_feet_have_in_common_is_taken_for_the_mass(feet: int, gain: float, mass: float):
    """Decoy: nobody can tell a robot that is heavier than its model from feet that all read too
    much; and of one foot there is nothing to compare."""
    for seed in range(5):
        found = watched(*drawn(seed, [gain] * feet, mass))
        assert np.abs(found["gains"]).max() < (0.002 if feet > 1 else 0.01)
        assert found["mass"] == pytest.approx(mass - gain, abs=0.004 if feet > 1 else 0.01)


def test_spikes_are_no_gains():
    """One reading in fifty of a foot is at full scale: as if it were not there."""
    read, weight = drawn(0, [0.0, 0.02])
    read[::50, 0] = 10.0
    np.testing.assert_allclose(watched(read, weight)["gains"], [0.0, 0.02], atol=0.003)


def test_while_the_load_stays_where_it_is_no_foot_is_blamed():
    """A foot that reads 5 % too little is as likely as a robot that is 2.5 % lighter."""
    noise = 0.003 * np.random.default_rng(0).standard_normal((2000, 3))
    found = watched(noise[:, :2] + [0.5 / (1.0 + GAIN), 0.5], 1.0 + noise[:, 2])
    assert np.abs(found["gains"]).max() < 0.3 * GAIN


def test_gains_are_the_mean_over_hypotheses_by_their_likelihoods():
    """Made of the likelihood of all readings at once, without normal equations."""
    generator = np.random.default_rng(3)
    read, weight = drawn(3, [0.03, 0.0, -0.01], mass=0.01, seconds=0.4)
    read, weight = read[::4], weight[::4] + 0.01 * generator.standard_normal(len(read[::4]))
    # Such noise of the balance that nothing is certain, and nothing is learned of it or forgotten.
    balance, noise = np.zeros((), force_balance_type(3)), 0.03
    lacks = weight - read.sum(axis=1)
    rows = np.column_stack([read, -read.sum(axis=1)])
    balance["information"] = rows.T @ rows / noise**2
    balance["right"] = rows.T @ lacks / noise**2
    force_balance._weigh_hypotheses(balance[()], GAIN)
    masses = {
        force_balance._MASS: 1.0 - force_balance._NOT_WEIGHED,
        force_balance._UNKNOWN_MASS: force_balance._NOT_WEIGHED,
    }
    wrong = [[], [0], [1], [2], [0, 1, 2]]
    is_wrong = force_balance._WRONG / (len(wrong) - 1)
    likelihoods, means = [], []
    for feet, (mass, prior) in product(wrong, masses.items()):
        deviations = np.zeros(4)
        deviations[feet], deviations[3] = GAIN, mass
        D = np.diag(deviations**2)
        S = rows @ D @ rows.T + noise**2 * np.eye(len(rows))
        prior *= is_wrong if feet else 1.0 - force_balance._WRONG
        likelihoods.append(prior * multivariate_normal.pdf(lacks, cov=S))
        means.append(D @ rows.T @ np.linalg.solve(S, lacks))
    expected = np.average(means, axis=0, weights=likelihoods)
    assert 0.05 < max(likelihoods) / sum(likelihoods) < 0.9
    np.testing.assert_allclose(balance["gains"], expected[:3], rtol=1e-6)
    np.testing.assert_allclose(balance["mass"], expected[3], rtol=1e-6)


FOOT = re.compile(r"Forces of the (.*) foot were found to be read (.*) % too (small|large)")


def told(remarks: tuple[str, ...]) -> list[tuple[str, float]]:
    """Feet of which is told, and by how much they read too little [%]."""
    found = [match for remark in remarks if (match := FOOT.match(remark))]
    return [(m[1], float(m[2]) * (1 if m[3] == "small" else -1)) for m in found]


@pytest.mark.parametrize("share", [-0.05, 0.02])
def test_friction_of_a_walk_with_a_foot_that_reads_wrong(run: Run, share: float):
    """Nobody tells it. The friction is at most twice as wrong as with feet that read right; where
    feet are believed it is six times as wrong again and more."""
    effect = f"robot.effects.gain=!FootForceGain {{gain: {{left: {share}}}}}"
    log = run("paper_walk_fbse", "duration=3", effect)
    right = run("paper_walk_fbse", "duration=3")
    walk = scenario("paper_walk_fbse", "duration=3")
    believing = scenario("paper_walk_fbse", "duration=3", "estimator.sensors.force_gain=0")
    later = log.time > 1.2
    result = estimate(walk, log)
    error, nominal, believed = (
        rms(friction_error(of)[later]) for of in (result.log, right, estimate(believing, log).log)
    )
    assert error < 2.0 * nominal
    assert error < believed / 6
    assert coverage(result.log) > 0.98
    ((foot, found),) = told(result.remarks)
    assert foot == "left"
    assert found == pytest.approx(-100 * share, abs=0.3)


def test_a_foot_that_reads_far_too_little_does_not_make_the_imu_suspect(run: Run):
    """A share of what the foot carries is what accelerometer and feet always contradict each other
    by: nobody is doubted for it, and the velocity is as good as with feet that read right."""
    effect = "robot.effects.gain=!FootForceGain {gain: {left: -0.12}}"
    log = run("paper_walk_fbse", "duration=3", effect)
    assert not log["estimate/sensors/status"].any()
    later = log.time > 1.0
    error = (log["estimate/base/velocity"] - log["truth/base/velocity"])[later]
    assert rms(error) < 1e-3
    assert coverage(log) > 0.98


@pytest.mark.parametrize(
    "override",
    [
        "sensors.foot_force.delay=0.012",
        "ground.stiffness=1.0e5",
        "sensors.imu.acceleration_bias=[0.2, 0.1, -0.2]",
        "robot.effects.thighs=!BodyMass {mass: {left_thigh: 1.2}}",
        "robot.effects.offset=!EncoderOffset {offset: {left_knee_pitch: 0.01}}",
    ],
)
def test_feet_that_read_right_are_not_blamed(run: Run, override: str):
    """Decoys: soft ground, wrong IMU, masses and encoders, and forces that are late."""
    log = run("paper_walk_fbse", "duration=3", override, "estimator=!NoEstimator {}")
    assert not told(estimate(scenario("paper_walk_fbse", "duration=3"), log).remarks)


def test_a_robot_that_is_heavier_than_its_model_is_told(run: Run):
    """By its thighs; nothing is said of one that is not."""
    heavier = "robot.effects.thighs=!BodyMass {mass: {left_thigh: 1.2, right_thigh: 1.2}}"
    walk = scenario("paper_walk_fbse", "duration=3")
    (share,) = (
        float(found[1])
        for remark in estimate(walk, run("paper_walk_fbse", "duration=3", heavier)).remarks
        if (found := re.match("The feet carry (.*) % more than the model weighs", remark))
    )
    plant = build_robot(walk.believed).plant
    assert share == pytest.approx(240 / plant.CalcTotalMass(plant.CreateDefaultContext()), abs=0.3)
    right = estimate(walk, run("paper_walk_fbse", "duration=3"))
    assert not any("carry" in remark for remark in right.remarks)


@pytest.mark.parametrize("every", [5, 20])
def test_rare_readings_tell_it_as_well(run: Run, every: int):
    """At 200 and 50 Hz."""
    effect = "robot.effects.gain=!FootForceGain {gain: {left: -0.05}}"
    log = decimated(run("paper_walk_fbse", "duration=3", effect), every)
    ((foot, found),) = told(estimate(scenario("paper_walk_fbse", "duration=3"), log).remarks)
    assert foot == "left"
    assert found == pytest.approx(5.0, abs=0.5)


def test_a_foot_of_four_that_reads_wrong(run: Run):
    effect = "robot.effects.gain=!FootForceGain {gain: {front_right: 0.05}}"
    log = run("quadruped_trot", "duration=2.5", effect, "estimator=!NoEstimator {}")
    ((foot, found),) = told(estimate(scenario("quadruped_trot", "duration=2.5"), log).remarks)
    assert foot == "front_right"
    assert found == pytest.approx(-5.0, abs=1.0)
