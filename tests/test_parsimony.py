"""The smallest explanation: effective samples, laws that contain simpler ones, pooling, and what
does not pay.

Truth comes from planned motions and from torques that are added to them here, by formulas of this
file.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from conftest import swinging_legs
from recorded_arm import ARM, Course
from scipy.optimize import minimize

from fbse_drake import Log, Scenario, load_scenario
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.explanation import Explanation
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.parsimony import Judge, blocks_per_sample, frugal
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.exercises.hidden import make_exercise
from fbse_drake.effects.effect import library
from fbse_drake.effects.inertia import BodyMass
from fbse_drake.effects.joint_torque import (
    JointMotion,
    JointTorqueEffect,
    Reduction,
    basis_over_time,
)

NOISE = 0.05
LEFT, RIGHT = "left_knee_pitch", "right_knee_pitch"
FRICTION = ("CoulombFriction", "ViscousFriction", "StribeckFriction", "PreslidingHysteresis")
Law = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def swing() -> tuple[Scenario, Log]:
    return swinging_legs(12, NOISE)


def diagnosis_of(
    swing: tuple[Scenario, Log], laws: Mapping[str, Law], effects: tuple[str, ...] = FRICTION
) -> Diagnosis:
    """What is found in the planned motion with laws of the velocity in some joints, and noise."""
    scenario, log = swing
    random = np.random.default_rng(3)
    channels = dict(log.channels)
    torque = channels["joint/torque_command"].copy()
    velocity = channels["joint/velocity"]
    for joint, law in laws.items():
        place = log.joints.index(joint)
        torque[:, place] += law(velocity[:, place])
    torque += NOISE * random.standard_normal(torque.shape)
    channels["joint/torque_command"] = torque
    return diagnose(
        Predictor(scenario, Log(channels, log.meta)), [library()[name] for name in effects]
    )


def found(diagnosis: Diagnosis) -> dict[str, tuple[str, ...]]:
    return {finding.effect: finding.targets for finding in diagnosis.chosen}


def coulomb(size: float) -> Law:
    return lambda velocity: size * np.tanh(velocity / 0.01)


def test_a_joint_that_rests_has_no_law_of_its_motion():
    """Where a velocity is noise alone, a torque that goes with it is no friction."""
    joint = "left_hip_yaw"
    scenario, log = swinging_legs(4, NOISE, "reference.amplitude.hip_yaw=0")
    place, random = log.joints.index(joint), np.random.default_rng(7)
    channels = {name: values.copy() for name, values in log.channels.items()}
    noise = 5e-3 * random.standard_normal(len(log.time))
    channels["joint/velocity"][:, place] += noise
    channels["joint/torque_command"][:, place] += 20 * noise
    resting = scenario, Log(channels, log.meta)
    assert not np.ptp(channels["joint/position"][:, place])
    diagnosis = diagnosis_of(resting, {LEFT: coulomb(0.5)}, (*FRICTION, "ThermalDrift"))
    assert found(diagnosis) == {"CoulombFriction": (LEFT,)}


def test_blocks_per_sample_is_the_integrated_autocorrelation_time():
    """White noise: 1. A first-order autoregression: (1 + a) / (1 - a); times a wave, 1 / its
    spectrum there."""
    random, count = np.random.default_rng(0), 20_000
    white = random.standard_normal((count, 3))
    coloured = white.copy()
    for k in range(1, count):
        coloured[k, 1:] = 0.8 * coloured[k - 1, 1:] + white[k, 1:]
    wave = np.cos(0.2 * np.arange(count))
    scores = coloured * np.stack([np.ones(count), np.ones(count), wave], axis=1)
    of_wave = (1 - 0.8**2) / (1 - 2 * 0.8 * np.cos(0.2) + 0.8**2)
    assert blocks_per_sample(scores) == pytest.approx([1.0, 9.0, of_wave], rel=0.2)


REDUCTIONS = [
    (effect, reduction)
    for effect in library().values()
    if issubclass(effect, JointTorqueEffect)
    for reduction in effect.reductions
]


@pytest.mark.parametrize(
    ("effect", "reduction"),
    REDUCTIONS,
    ids=lambda value: "-".join(value.at) if isinstance(value, Reduction) else value.__name__,
)
def test_a_law_turns_into_the_simpler_ones_that_it_declares(
    effect: type[JointTorqueEffect], reduction: Reduction
):
    """At the declared values its torque is one that the simpler laws can have together."""
    time = np.arange(2e-3, 4.0, 2e-3)[:, None]
    position = np.sin(2.0 * time) + 0.3 * np.sin(7.0 * time)
    velocity = 2.0 * np.cos(2.0 * time) + 2.1 * np.cos(7.0 * time)
    motion = JointMotion(velocity, position, time=time, time_step=2e-3)

    def columns(law: type[JointTorqueEffect], nonlinear: np.ndarray) -> np.ndarray:
        return basis_over_time(law, motion, nonlinear[:, None])[..., 0].T

    values = {}
    for k, (name, parameter) in enumerate(effect.parameters.items()):
        usual = getattr(effect(), name).get("all", 0.7 + 0.3 * k)
        values[name] = reduction.at.get(name, usual)
        if name in reduction.at and not parameter.linear:
            values[name] = max(reduction.at[name], 1e-9)
    linear, nonlinear = (
        np.array([v for name, v in values.items() if effect.parameters[name].linear is kind])
        for kind in (True, False)
    )
    torque = columns(effect, nonlinear) @ linear
    searched = [sum(not p.linear for p in law.parameters.values()) for law in reduction.effects]

    def left(logarithms: np.ndarray) -> float:
        parts = np.split(np.exp(logarithms), np.cumsum(searched)[:-1])
        X = np.concatenate(
            [columns(law, part) for law, part in zip(reduction.effects, parts, strict=True)], axis=1
        )
        return float(np.linalg.norm(torque - X @ np.linalg.lstsq(X, torque)[0]))

    starts = (np.full(sum(searched), np.log(start)) for start in (0.01, 1e-6))
    best = min(
        minimize(left, start, method="Nelder-Mead").fun if sum(searched) else left(start)
        for start in starts
    )
    assert best < 1e-3 * np.linalg.norm(torque)


def test_coulomb_and_viscous_friction_is_not_called_stribeck(swing: tuple[Scenario, Log]):
    law = coulomb(1.5)
    diagnosis = diagnosis_of(swing, {LEFT: lambda v: law(v) + 1.2 * v})
    assert found(diagnosis) == {"CoulombFriction": (LEFT,), "ViscousFriction": (LEFT,)}
    values = {f.effect: next(iter(f.parameters.values())) for f in diagnosis.chosen}
    assert values["CoulombFriction"].value == pytest.approx(1.5, rel=0.03)
    assert values["ViscousFriction"].value == pytest.approx(1.2, rel=0.03)


def test_friction_of_a_recorded_arm_is_the_smallest_law_that_holds():
    """Coulomb friction alone levels off at ten times the velocity at which it does beside viscous
    friction: from there a few steps do not lead to where both fit."""
    course = ARM.course()
    velocity = course.velocity[:, 2]
    friction = np.zeros_like(course.torque)
    friction[:, 2] = 4.0 * np.tanh(velocity / 0.01) + 5.0 * velocity
    for hump in (0.0, 3.0):
        hidden = friction.copy()
        hidden[:, 2] += hump * (np.tanh(velocity / 0.02) - np.tanh(velocity / 0.2))
        found = diagnose(ARM.predictor(ARM.log(course, course.torque + hidden))).chosen
        expected = {"StribeckFriction"} if hump else {"CoulombFriction", "ViscousFriction"}
        assert {finding.effect for finding in found} == expected
        assert all(finding.targets == ("axis_3",) for finding in found)


def test_joints_that_need_no_hump_have_none():
    """Friction in all joints of an arm that steps as sharply as its velocity is read, and a hump in
    one of them."""
    course = ARM.course()
    velocity, sizes = course.velocity, 0.2 * course.torque.std(axis=0)
    friction = sizes * (np.tanh(velocity / 0.002) + velocity / velocity.std(axis=0))
    hump = np.tanh(velocity[:, 0] / 0.02) - np.tanh(velocity[:, 0] / 0.3)
    friction[:, 0] += 3.0 * sizes[0] * hump
    diagnosis = diagnose(ARM.predictor(ARM.log(course, course.torque + friction)))
    named = {(f.effect, joint) for f in diagnosis.chosen for joint in f.targets}
    first, *others = ARM.joints
    plain = ("CoulombFriction", "ViscousFriction")
    assert named == {("StribeckFriction", first)} | {(law, j) for law in plain for j in others}


@pytest.mark.parametrize("seed", [1, 3])
def test_a_hump_in_one_joint_makes_none_in_others(seed: int) -> None:
    """Coulomb and viscous friction of all joints, of which one has a hump as well: what others take
    of it does not pay for what a hump costs."""
    course = ARM.course(seed)
    velocity, torque = course.velocity, np.sqrt((course.torque**2).mean(axis=0))
    speed = np.sqrt((velocity**2).mean(axis=0))
    friction = torque * (0.2 * np.tanh(velocity / 0.03) + 0.15 * velocity / speed)
    humped = velocity[:, 3]
    hump = np.tanh(humped / 0.02) - np.tanh(humped / (0.3 * speed[3]))
    friction[:, 3] += 0.5 * torque[3] * hump
    names = (*FRICTION[:3], "TorqueBias")
    diagnosis = diagnose(
        ARM.predictor(ARM.log(course, course.torque + friction, seed)),
        [library()[name] for name in names],
    )
    laws: dict[str, set[str]] = {}
    for finding in diagnosis.chosen:
        laws.setdefault(finding.effect, set()).update(finding.targets)
    others = {*ARM.joints} - {"axis_4"}
    assert laws == {
        "CoulombFriction": others,
        "ViscousFriction": others,
        "StribeckFriction": {"axis_4"},
    }


def test_a_law_with_a_hump_is_called_stribeck(swing: tuple[Scenario, Log]):
    diagnosis = diagnosis_of(
        swing,
        {LEFT: lambda v: 1.5 * (np.tanh(100 * v) - np.tanh(10 * v)) + np.tanh(100 * v) + v},
    )
    assert found(diagnosis) == {"StribeckFriction": (LEFT,)}


def test_knees_that_agree_are_one_finding_and_knees_that_differ_are_two(
    swing: tuple[Scenario, Log],
):
    alike, unlike = (
        diagnosis_of(swing, {LEFT: coulomb(1.0), RIGHT: coulomb(other)}, FRICTION[:2])
        for other in (1.0, 1.6)
    )
    assert [(f.effect, f.targets) for f in alike.chosen] == [("CoulombFriction", (LEFT, RIGHT))]
    assert sorted(f.targets for f in unlike.chosen) == [(LEFT,), (RIGHT,)]
    values = {f.targets[0]: f.parameters["coulomb"] for f in unlike.chosen}
    assert values[LEFT].interval[1] < values[RIGHT].interval[0]


def test_slow_errors_of_the_model_are_no_findings(swing: tuple[Scenario, Log]):
    """A friction that is found, beside a slow random walk of the torque that the library does not
    have."""
    walk = np.cumsum(np.random.default_rng(1).standard_normal(len(swing[1].time)))
    walk *= 0.5 / walk.std()
    effects = (*FRICTION, "TorqueRipple", "JointSpring", "QuadraticDrag", "ThermalDrift")
    diagnosis = diagnosis_of(swing, {LEFT: lambda v: 3.0 * np.tanh(v / 0.01) + walk}, effects)
    assert set(found(diagnosis)) == {"CoulombFriction"}
    assert diagnosis.verdict == "unknown_effect"
    (coulomb_found,) = diagnosis.chosen
    low, high = coulomb_found.parameters["coulomb"].interval
    assert low < 3.0 < high


@pytest.mark.parametrize(("size", "named"), [(0.7, {"CoulombFriction"}), (3.0, set())])
def test_a_law_names_a_row_only_if_it_explains_half_of_it(
    swing: tuple[Scenario, Log], size: float, named: set[str]
):
    """Coulomb friction of 1 Nm beside a vibration that the library does not have."""
    law, time = coulomb(1.0), swing[1].time
    diagnosis = diagnosis_of(swing, {LEFT: lambda v: law(v) + size * np.sin(23.0 * time)})
    assert diagnosis.verdict == "unknown_effect"
    assert set(found(diagnosis)) == named
    assert [structure.row for structure in diagnosis.unexplained] == [LEFT]


def friction_in_all_joints(
    swing: tuple[Scenario, Log], size: float
) -> tuple[Proposals, Explanation]:
    """Coulomb friction, so many times slow random walks of the torques of all joints, and its
    fit."""
    scenario, log = swing
    random = np.random.default_rng(3)
    torque = log["joint/torque_command"].copy()
    walks = np.cumsum(random.standard_normal(torque.shape), axis=0)
    walks += size * walks.std(axis=0) * np.tanh(log["joint/velocity"] / 0.01)
    sizes = 0.5 + 0.05 * np.arange(torque.shape[1])
    torque += sizes * walks / walks.std(axis=0) + NOISE * random.standard_normal(torque.shape)
    log = Log(log.channels | {"joint/torque_command": torque}, log.meta)
    laws = [library()[name] for name in FRICTION[:2]]
    proposals = Proposals(Fits(Dictionary(Predictor(scenario, log), laws)))
    explanation = proposals.fits.explain([])
    for joint in log.joints:
        explanation = proposals.beside(explanation, laws[0], (joint,))
    return proposals, explanation


def test_joints_prove_together_what_none_proves_alone(swing: tuple[Scenario, Log]):
    proposals, explanation = friction_in_all_joints(swing, 1.3)
    judge = Judge(proposals.fits, explanation)
    for member in explanation.candidates:
        rest = [c for c in explanation.candidates if c is not member]
        assert not judge.pays(proposals.fits.explain(rest), explanation, member)
    kept = frugal(proposals, explanation).candidates
    assert {c.name for c in kept} == {"CoulombFriction"}
    assert sum(len(c.targets) for c in kept) >= 4


def test_slow_errors_of_all_joints_prove_nothing_together(swing: tuple[Scenario, Log]):
    assert frugal(*friction_in_all_joints(swing, 0.0)).candidates == ()


def test_nothing_is_found_in_noise(swing: tuple[Scenario, Log]):
    assert diagnosis_of(swing, {}).verdict == "nothing_missing"


def test_a_row_in_which_a_mass_hardly_shows_is_no_worse_for_the_noise_that_it_brings() -> None:
    """It explains 7,300 of the deviance in eleven rows and makes one 0.7 % worse, which once was
    enough to name nothing."""
    exact = load_scenario("paper_walk", overrides=["identify.tolerance=0"])
    exercise = make_exercise(
        exact, "paper_walk", 4071129597, what="BodyMass", size="small", count=1
    )
    diagnosis = diagnose(Predictor(exercise.scenario, exercise.log), [BodyMass])
    (hidden,) = exercise.answer.effects
    (finding,) = diagnosis.chosen
    assert finding.targets == hidden.targets
    low, high = finding.parameters["mass"].interval
    assert low < hidden.size < high


def laws_of(
    seed: int, duration: float, friction: Callable[[Course, np.ndarray], np.ndarray], *names: str
) -> dict[str, set[str]]:
    """Joints in which laws are named, of an arm with friction: of its course and of the root mean
    squares of its torques."""
    machine = replace(ARM, duration=duration)
    course = machine.course(seed)
    given = course.torque + friction(course, np.sqrt((course.torque**2).mean(axis=0)))
    diagnosis = diagnose(
        machine.predictor(machine.log(course, given, seed)), [library()[name] for name in names]
    )
    assert diagnosis.verdict == "effect_found"
    found: dict[str, set[str]] = {}
    for finding in diagnosis.chosen:
        found.setdefault(finding.effect, set()).update(finding.targets)
    return found


def plain(velocity: np.ndarray, coulomb: float, viscous: float) -> np.ndarray:
    speed = np.sqrt((velocity**2).mean(axis=0))
    return coulomb * np.tanh(velocity / 0.01) + viscous * velocity / speed


@pytest.mark.parametrize(
    ("seed", "duration", "drag"),
    [(2, 10.0, 0.25), (5, 10.0, 0.25), (8, 10.0, 0.25), (4, 20.0, 0.06), (5, 20.0, 0.06)],
)
def test_drag_beside_plain_friction_is_no_hump(seed: int, duration: float, drag: float):
    """A hump bends the law as drag does, with more parameters: one that nothing tells from zero,
    and, in a long log, one that differs from it."""

    def friction(course: Course, size: np.ndarray) -> np.ndarray:
        v = course.velocity
        bent = drag * np.eye(6)[1] * v * np.abs(v) / np.sqrt((v**4).mean(axis=0))
        return size * (plain(v, 0.1, 0.15) + bent)

    names = ("CoulombFriction", "ViscousFriction", "QuadraticDrag")
    found = laws_of(seed, duration, friction, *names, "StribeckFriction")
    assert found.keys() == set(names)
    assert found["QuadraticDrag"] == {"axis_2"}


@pytest.mark.parametrize("seed", [19, 27, 40])
def test_a_real_hump_beside_makes_none_that_costs_more_than_it_brings(seed: int):
    """Also where the interval of one that is not there leaves zero out."""

    def friction(course: Course, size: np.ndarray) -> np.ndarray:
        v = course.velocity
        hump = np.tanh(v / 0.02) - np.tanh(v / (0.3 * np.sqrt((v**2).mean(axis=0))))
        return size * (plain(v, 0.12, 0.1) + 0.15 * np.eye(6)[1] * hump)

    found = laws_of(seed, 20.0, friction, *FRICTION[:3])
    assert found["StribeckFriction"] == {"axis_2"}


def test_where_a_larger_law_does_not_pay_a_simpler_one_may_though_it_explains_less():
    """Of seldom samples, beside torques that are late by a part of one: next to nothing is known of
    what happens where a joint turns, and all the more of its friction."""
    machine = replace(ARM, period=0.01, duration=20.0)
    course = replace(machine, period=0.001).course(10)
    size = np.sqrt((course.torque**2).mean(axis=0))
    speed = np.sqrt((course.velocity**2).mean(axis=0))
    friction = 0.2 * np.tanh(course.velocity / 0.02) + 0.2 * course.velocity / speed
    read = np.roll(course.torque + size * friction, 3, axis=0)
    rare = Course(*(values[10::10] for values in vars(course).values()))
    log = machine.log(rare, read[10::10], 10)
    names = (*FRICTION, "TorqueReadingLag", "TorqueLag", "TorqueDelay")
    diagnosis = diagnose(machine.predictor(log), [library()[name] for name in names])
    named: dict[str, set[str]] = {}
    for finding in diagnosis.chosen:
        named.setdefault(finding.effect, set()).update(finding.targets)
    assert diagnosis.verdict == "effect_found"
    assert named.keys() == {"CoulombFriction", "ViscousFriction", "TorqueReadingLag"}
    assert all(targets == set(machine.joints) for targets in named.values())
