"""Friction laws that are learned while the robot moves."""

from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from rig import CLOCK, TICK, Rig, estimated

from fbse_drake import InputError, Log
from fbse_drake.effects.friction import CoulombViscousFriction, StribeckFriction
from fbse_drake.effects.joint_torque import JointMotion
from fbse_drake.estimators.adaptive_friction import AdaptiveFriction
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.fuzzy import FuzzyFriction
from fbse_drake.estimators.learned import FrictionLearner, LearnedFriction, learned
from fbse_drake.estimators.lugre import LuGreFriction
from fbse_drake.estimators.radial_basis import RadialBasisFriction
from fbse_drake.estimators.recursive import Status
from fbse_drake.robot.plant import make_robot

Run = Callable[..., Log]
LAWS: list[LearnedFriction] = [
    AdaptiveFriction(),
    LuGreFriction(),
    RadialBasisFriction(),
    FuzzyFriction(),
]
ROBOT, _ = make_robot("pendulum")
TIME = TICK * np.arange(20_000)
# Rich, with reversals, slow and fast: up to 2.5 rad/s.
MOTION = np.sin(2 * np.pi * 0.3 * TIME) * (1.5 + np.sin(2 * np.pi * 0.11 * TIME))


def name(law: LearnedFriction) -> str:
    return type(law).__name__


def learn(law: LearnedFriction, velocity: np.ndarray, friction: np.ndarray) -> list[np.ndarray]:
    """Posteriors while a joint moves, of whose friction the observer tells what its filter
    passes."""
    types = FrictionLearner.input_types(ROBOT)
    rig = Rig(FrictionLearner(law, ROBOT, **types, clock=CLOCK))
    keep, behind, posteriors = np.exp(-2 * np.pi * law.bandwidth * TICK), 0.0, []
    for k, (w, u) in enumerate(zip(velocity, friction, strict=True)):
        behind = keep * behind + (1 - keep) * u if k else behind
        measured, observed = (np.zeros((), types[port]) for port in ("measurements", "disturbance"))
        measured["joint_velocity"], observed["friction"] = w, behind
        posteriors.append(rig.tick(measurements=measured, disturbance=observed))
    return posteriors


def stribeck(velocity: np.ndarray) -> np.ndarray:
    """The friction of the paper's Table I, hip pitch, as the library has it [Nm]."""
    law = StribeckFriction(gamma1={"all": 0.6}, gamma4={"all": 0.5}, gamma6={"all": 0.6})
    torque, _ = law.resolve(ROBOT.description).torque_and_slope(JointMotion(velocity[:, None]))
    return torque[:, 0]


def test_no_step_moves_parameters_away_from_the_true_ones():
    """At any rate, whatever the motion; the step is the projection that Goodwin and Sin prove it
    for."""
    generator = np.random.default_rng(0)
    truth = generator.normal(size=(3, 4))
    for gain in (1e-3, 1.0, 1e6):
        theta = np.zeros_like(truth)
        for _ in range(300):
            phi = generator.normal(size=truth.shape) * generator.exponential(3.0, size=(3, 1))
            before = np.linalg.norm(theta - truth, axis=1)
            theta = learned(theta, phi, (phi * truth).sum(axis=1), gain)
            assert np.all(np.linalg.norm(theta - truth, axis=1) <= before + 1e-12)
    # With the largest gain every step fits its own sample: excited in all directions it converges.
    np.testing.assert_allclose(theta, truth, atol=1e-6)


def test_adaptive_friction_learns_the_sizes_of_a_law_of_its_shape():
    """The truth comes from the effect library. Slowly, for what is fast fits each sample by
    itself."""
    effect = CoulombViscousFriction(
        coulomb={"all": 1.2}, viscous={"all": 0.7}, transition={"all": 0.01}
    )
    torque, _ = effect.resolve(ROBOT.description).torque_and_slope(JointMotion(MOTION[:, None]))
    last = learn(AdaptiveFriction(rate=5.0), MOTION, torque[:, 0])[-1]
    np.testing.assert_allclose(last["parameters"][0], [1.2, 0.7, 0.0], atol=0.03)


def test_motion_that_does_not_excite_leaves_parameters_open():
    """At one velocity the torque is learned, not what it is made of: the parameters keep to the
    direction of the regressor."""
    w = 0.3
    law = AdaptiveFriction()
    last = learn(law, np.full(3000, w), np.full(3000, 1.0 + 0.5 * w))[-1]
    assert last["friction"][0] == pytest.approx(1.0 + 0.5 * w, rel=1e-3)
    phi, _ = law.regressor(np.array([w]), np.zeros((1, 0)), TICK)
    cosine = (
        phi[0] @ last["parameters"][0] / np.linalg.norm(phi) / np.linalg.norm(last["parameters"])
    )
    assert cosine == pytest.approx(1.0, abs=1e-6)
    assert abs(last["parameters"][0, 0] - 1.0) > 0.05


def test_parameters_stay_in_their_range():
    """Torque that drives the joint is no friction; what is larger than anything is not followed."""
    for torque, law in (
        (-2.0 * np.sign(MOTION[:4000]), AdaptiveFriction()),
        (1e3 * np.sign(MOTION[:4000]), FuzzyFriction(largest=5.0)),
    ):
        found = np.array([p["parameters"] for p in learn(law, MOTION[:4000], torque)])
        assert found.min() >= law.smallest
        assert found.max() <= law.largest
    assert found.max() == law.largest


@pytest.mark.parametrize("law", [LAWS[0], LAWS[2], LAWS[3]], ids=name)
def test_laws_of_no_or_another_shape_come_near(law: LearnedFriction):
    """Stribeck friction of another formula; without the first half, in which it is learned."""
    torque = stribeck(MOTION)
    found = np.array([p["friction"][0] for p in learn(law, MOTION, torque)])
    rms = np.sqrt(np.mean((found - torque)[10_000:] ** 2)) / np.sqrt(np.mean(torque**2))
    assert rms < 0.06


def test_memberships_add_up_and_straight_laws_are_met():
    law, velocity = FuzzyFriction(speeds=[0.1, 1.0]), np.linspace(-3, 3, 401)
    membership = law.memberships(velocity)
    np.testing.assert_allclose(membership.sum(axis=1), 1.0, atol=1e-12)
    assert membership.min() >= 0
    phi, _ = law.regressor(velocity, np.zeros((401, 0)), TICK)
    np.testing.assert_allclose(phi @ ([0.5] * 5 + [2.0] * 5), 0.5 + 2 * velocity)


def test_radial_functions_fade_beyond_the_fastest_velocity():
    law = RadialBasisFriction(fastest=2.0)
    phi, _ = law.regressor(np.array([0.0, 1.0, 500.0]), np.zeros((3, 0)), TICK)
    assert np.all(phi[:2].sum(axis=1) > 1)
    assert phi[2].max() < 1e-6


def deflection(law: LuGreFriction, velocity: np.ndarray, elapsed: float) -> np.ndarray:
    memory, found = np.zeros((1, 1)), []
    for w in velocity:
        _, memory = law.regressor(np.array([w]), memory, elapsed)
        found.append(memory[0, 0])
    return np.array(found)


def test_bristles_are_springs_at_rest_and_a_stribeck_curve_in_motion():
    law = LuGreFriction()
    # Far below the breakaway the deflection is the travel.
    creep = np.full(100, 1e-4)
    expected = 1e-4 * TICK * np.arange(1, 101) / law.breakaway
    np.testing.assert_allclose(deflection(law, creep, TICK), expected, rtol=0.06)
    for w in (-1.0, 0.05, 0.2):
        end = deflection(law, np.full(500, w), TICK)[-1]
        excess = (law.static - 1) * np.exp(-((w / law.stribeck_velocity) ** 2))
        assert end == pytest.approx(np.sign(w) * (1 + excess), rel=1e-6)
    # Exact at a constant velocity: ten ticks are one that is ten times as long.
    fine, coarse = deflection(law, np.full(10, 0.1), TICK), deflection(law, [0.1], 10 * TICK)
    assert fine[-1] == pytest.approx(coarse[0], rel=1e-12)


def test_without_measurements_nothing_is_learned():
    """The law goes on with what it has learned, and says that the observer has no trust."""
    law, types = AdaptiveFriction(), FrictionLearner.input_types(ROBOT)
    rig = Rig(FrictionLearner(law, ROBOT, **types, clock=CLOCK))
    measured, observed = (np.zeros((), types[port]) for port in ("measurements", "disturbance"))
    measured["joint_velocity"], observed["friction"] = 0.5, 2.0
    for _ in range(300):
        before = rig.tick(measurements=measured, disturbance=observed)
    observed["status"], observed["friction"] = Status.NOT_FINITE, 99.0
    measured["joint_velocity"] = -0.5
    after = rig.tick(measurements=measured, disturbance=observed)
    np.testing.assert_array_equal(after["parameters"], before["parameters"])
    assert after["friction"] == pytest.approx(-before["friction"])
    assert after["status"] == Status.NOT_FINITE
    measured["trust"][0] = Status.STUCK
    measured["joint_velocity"] = 0.1
    assert rig.tick(measurements=measured, disturbance=observed)["friction"] == after["friction"]


@pytest.mark.parametrize("law", LAWS, ids=name)
def test_friction_of_a_walk_is_learned(law: LearnedFriction, run: Run):
    """Nearer to the paper's friction than the observer that each learns from, once it has moved."""
    log = run("paper_walk_fbse", "duration=3")
    walk = scenario("paper_walk_fbse", "duration=3")
    truth = log["truth/joint/friction_torque"][1500:-1]

    def error(config: LearnedFriction | DisturbanceObserver) -> float:
        found = estimated(log, walk, config)["estimate/joint/friction_torque"][1501:]
        return float(np.sqrt(np.mean((found - truth) ** 2)))

    assert error(law) < error(DisturbanceObserver(law.bandwidth))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LuGreFriction(static=0.9), "static: expected a number >= 1, found 0.9"),
        (lambda: RadialBasisFriction(centres=2), "centres: expected a number from 3 to 200"),
        (lambda: FuzzyFriction(speeds=[1.0, 0.5]), "speeds: expected numbers > 0 in rising order"),
        (lambda: AdaptiveFriction(rate=0.0), "rate: expected a number > 0, found 0"),
    ],
)
def test_bad_values_get_one_line(make: Callable[[], LearnedFriction], message: str):
    with pytest.raises(InputError, match=message):
        make()
