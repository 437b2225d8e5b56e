"""Effects that look alike are told apart, or said to be confusable: each is fitted by itself."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario
from pydrake.multibody.tree import JacobianWrtVariable
from recorded_arm import ARM, PENDULUM, Course, Machine
from scipy.spatial.transform import Rotation

from fbse_drake.discrepancy.diagnosis.detectability import separation
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.experiment import Experiments
from fbse_drake.discrepancy.diagnosis.explanation import Explanation
from fbse_drake.discrepancy.diagnosis.fits import MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.diagnosis.refinement import polished
from fbse_drake.discrepancy.diagnosis.rivals import fitted, indistinguishable, rivals
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import library
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.effects.sensor import ImuMisalignment, TransmissionElasticity

ELBOW = 2
# What could be meant by what is hidden below; the whole library takes longer.
NAMES = (
    "Backlash",
    "BodyCentreOfMass",
    "BodyMass",
    "CoulombFriction",
    "EncoderOffset",
    "JointSpring",
    "TorqueBias",
    "TorqueDelay",
    "TorqueGain",
    "TorqueLag",
    "TransmissionElasticity",
    "ViscousFriction",
)


@pytest.fixture(scope="module")
def arm() -> Course:
    return ARM.course(2)


def diagnosis_of(course: Course, torque: np.ndarray, names: Sequence[str] = NAMES) -> Diagnosis:
    return diagnose(ARM.predictor(ARM.log(course, torque)), [library()[name] for name in names])


def named(diagnosis: Diagnosis) -> dict[str, tuple[str, ...]]:
    """What is chosen, and what each is confusable with."""
    return {finding.effect: finding.confusable_with for finding in diagnosis.chosen}


def late_elbow(arm: Course, seconds: float) -> np.ndarray:
    """Torques whose elbow's drive gives what it is told so much later."""
    torque = arm.torque.copy()
    torque[:, ELBOW] = np.interp(arm.time + seconds, arm.time, torque[:, ELBOW])
    return torque


@pytest.mark.parametrize("seconds", [0.004, 0.008])
def test_a_delay_is_not_told_from_a_lag_of_slow_motion(arm: Course, seconds: float) -> None:
    """A lag that smoothed the noise of the torque would seem to explain more."""
    diagnosis = diagnosis_of(arm, late_elbow(arm, seconds))
    ((effect, rivals),) = named(diagnosis).items()
    assert {effect, *rivals} >= {"TorqueDelay", "TorqueLag"}
    assert diagnosis.chosen[0].targets == ("axis_3",)
    assert diagnosis.effects["TorqueDelay"].verdict in ("present", "confusable")


def elastic(arm: Course, joint: int, stiffness: float) -> tuple[Course, np.ndarray]:
    """An encoder before the spring of its gear, which passes what the link needs without its rotor,
    and the torque that the rotor needs to twist it."""
    rotors = np.array(ARM.rotor_inertia)
    load = arm.torque - rotors * arm.acceleration
    twist, torque = np.zeros_like(arm.torque), arm.torque.copy()
    twist[:, joint] = load[:, joint] / stiffness
    rate = arm.rate(twist)
    torque += rotors * arm.rate(rate)
    moved = replace(arm, position=arm.position + twist, velocity=arm.velocity + rate)
    return moved, torque


def test_an_elastic_elbow_is_no_encoder_offset_and_no_lag(arm: Course) -> None:
    """How stiff it is, is asked for where torques hardly have noise: other joints tell it then. In
    its own row the model's rotor turns with the link, and the spring seems stiffer."""
    course, torque = elastic(arm, ELBOW, 4000.0)
    quiet = replace(ARM, torque_noise=tuple(0.02 * noise for noise in ARM.torque_noise))
    for machine in (ARM, quiet):
        log, effects = machine.log(course, torque), [library()[name] for name in NAMES]
        diagnosis = diagnose(machine.predictor(log), effects)
        first = diagnosis.ranking[0]
        assert (first.effect, first.targets) == ("TransmissionElasticity", ("axis_3",))
        assert len(diagnosis.chosen) == 1
    compliance = first.parameters["compliance"]
    assert compliance.value == pytest.approx(1 / 4000, rel=0.03)
    assert compliance.interval[0] < 1 / 4000 < compliance.interval[1]


def test_noise_of_the_torque_is_no_motion_of_an_elastic_joint(arm: Course) -> None:
    """With its elasticity in the model little is left but noise, and the rounding of the twist's
    second derivative."""
    course, torque = elastic(arm, 1, 4000.0)
    log, believed = ARM.log(course, torque), ARM.scenario
    effect = TransmissionElasticity({"axis_2": 1 / 4000}, {"all": 4e-3})
    known = replace(believed, model=replace(believed.model, effects={"gear": effect}))
    residual = Predictor(known, log).residual
    left = np.sqrt((residual.value**2).mean(axis=0))
    assert np.all(left < 2.0 * residual.noise_floor)


def tethered(arm: Course) -> np.ndarray:
    """Torques of an arm with a rope from its forearm to a post, in N and m: 40 N/m beyond 0.3 m."""
    robot, torque = ARM.robot(), arm.torque.copy()
    plant, world = robot.plant, robot.plant.world_frame()
    context, frame = plant.CreateDefaultContext(), plant.GetFrameByName("link_4")
    q = np.zeros(plant.num_positions())
    for k, position in enumerate(arm.position):
        q[robot.position_index] = position
        plant.SetPositions(context, q)
        place = plant.CalcPointsPositions(context, frame, np.zeros(3), world).ravel()
        rope = np.array([0.6, 0.9, 0.2]) - place
        length = np.linalg.norm(rope)
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
        )[:, robot.velocity_index]
        torque[k] -= J.T @ rope * 40.0 * max(0.0, length - 0.3) / length
    return torque


def test_a_tether_is_unknown(arm: Course) -> None:
    names = ("BodyMass", "JointSpring", "TorqueBias")
    assert diagnosis_of(arm, tethered(arm), names).verdict == "unknown_effect"


def test_play_with_the_encoder_on_the_link_is_backlash(arm: Course) -> None:
    """Where the torque changes its sign, the rotor crosses the gap, in some 40 ms; the link does
    not feel it."""
    torque, own = arm.torque.copy(), arm.torque[:, 0]
    crossing = own / (np.abs(arm.rate(own)).std() * 0.04)
    gap = 0.005 * np.tanh(3 * crossing)
    torque[:, 0] += ARM.rotor_inertia[0] * arm.rate(arm.rate(gap))
    diagnosis = diagnosis_of(arm, torque)
    assert diagnosis.ranking[0].effect == "Backlash" or diagnosis.verdict == "unknown_effect"


@pytest.fixture(scope="module")
def crooked(run) -> Predictor:
    """A walk whose IMU is mounted askew by 2 deg."""
    log, believed = run("paper_walk", "duration=3"), scenario("paper_walk", "duration=3")
    R = Rotation.from_rotvec([0.02, -0.028, 0.0]).as_matrix()
    turned = {name: log[name] @ R for name in ("imu/linear_acceleration", "imu/angular_velocity")}
    return Predictor(
        replace(believed, model=believed.robot), replace(log, channels=log.channels | turned)
    )


@pytest.mark.parametrize(
    ("coulomb", "transition", "expected"),
    [
        (0.3, 0.001, ("CoulombFriction", "coulomb", 0.3)),
        (50.0, 0.5, ("ViscousFriction", "viscous", 100.0)),
    ],
)
def test_friction_of_what_hardly_moves_is_what_its_speed_reaches(
    coulomb: float, transition: float, expected: tuple[str, str, float]
) -> None:
    """A servo that turns by 5 mrad, at 9 mrad/s at most: friction that levels off far beyond that
    is viscous, however much of it there is, or the beginning of Coulomb friction."""
    servo = replace(PENDULUM, amplitude=tuple(0.003 * a for a in PENDULUM.amplitude))
    course = servo.course(1)
    assert 0.005 < np.abs(course.velocity).max() < 0.01
    friction = coulomb * np.tanh(course.velocity / transition)
    diagnosis = diagnose(servo.predictor(servo.log(course, course.torque + friction)))
    effect, parameter, value = expected
    (finding,) = diagnosis.chosen
    assert finding.effect == effect
    assert finding.parameters[parameter].value == pytest.approx(value, rel=0.01)
    assert ("CoulombFriction" in finding.confusable_with) == (effect == "ViscousFriction")


def test_a_crooked_imu_is_no_bias_and_no_slope(crooked: Predictor) -> None:
    names = ("AccelerometerBias", "BodyCentreOfMass", "GroundSlope", "GyroscopeBias")
    effects = [ImuMisalignment, *(library()[name] for name in names)]
    diagnosis = diagnose(crooked, effects)
    first = diagnosis.chosen[0]
    assert "ImuMisalignment" in (first.effect, *first.confusable_with)
    if first.effect == "ImuMisalignment":
        assert first.parameters["y"].value == pytest.approx(-0.028, abs=1e-3)


def test_a_rival_is_compared_where_it_fits(crooked: Predictor) -> None:
    """A rotation is linear for small angles only: at 2 deg its slope at zero leaves what the
    rotation does not."""
    fits = Fits(Dictionary(crooked, [ImuMisalignment]))
    at_zero = fits.explain(fits.fixed_candidates)
    there = fitted(fits, at_zero)
    assert there.deviance < at_zero.deviance - 3 * MARGIN
    errors = np.abs(there.fit.parameters - [0.02, -0.028, 0.0])
    assert np.all(errors < 3 * there.fit.deviation + 1e-4)


def test_a_load_could_be_mistaken_for_a_mass(arm: Course) -> None:
    """A load is linear about values of its own: its columns have an offset."""
    predictor, mass = ARM.predictor(ARM.log(arm)), library()["BodyMass"]
    payload, other = (library()[name] for name in ("Payload", "GyroscopeBias"))
    by_load, by_nothing = (
        separation(Fits(Dictionary(predictor, [rival])), mass, ["link_5"], {"mass": 1.0}, rival)
        for rival in (payload, other)
    )
    assert abs(by_load) < 1e-3 * by_nothing


def test_experiments_of_an_arm_are_planned() -> None:
    """Another scenario's estimator may need sensors that the arm does not have."""
    experiments = Experiments(ARM.scenario)
    assert experiments.that_shows(library()["CoulombFriction"]) is not None


class Wrench(TorqueBias):
    """Not in the library: a constant torque by another name."""


TWO_LINKS = Machine(
    "double_pendulum",
    posture=(0.3, 0.2),
    amplitude=(0.8, 0.9),
    rotor_inertia=(0.0, 0.0),
    torque_noise=(0.6, 0.05),
)


def test_a_rival_that_differs_where_drift_hides_it_is_not_passed_over() -> None:
    """A bias of two joints and one of the first joint alone differ in the second, whose torque
    drifts: few samples there are independent. How many are in the first joint does not matter.
    """
    course = TWO_LINKS.course(1)
    torque = course.torque + 0.3
    torque[:, 1] += 0.2 * np.sin(2 * np.pi * course.time / TWO_LINKS.duration)
    predictor = TWO_LINKS.predictor(TWO_LINKS.log(course, torque))
    proposals = Proposals(Fits(Dictionary(predictor, [TorqueBias, Wrench])))
    fits, first = proposals.fits, (TWO_LINKS.joints[0],)
    both = proposals.beside(fits.explain([]), TorqueBias, tuple(TWO_LINKS.joints))
    alone = proposals.beside(fits.explain([]), Wrench, first)
    assert list(indistinguishable(fits, {0: [alone]}, both)[0]) == [alone]
    of_both = indistinguishable(fits, rivals(proposals, both), both)[0]
    assert (Wrench, first) in [(e.candidates[-1].effect, e.candidates[-1].targets) for e in of_both]


def test_what_does_not_fit_better_when_moved_holds_no_other_joint_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    course, (shoulder, elbow) = TWO_LINKS.course(1), TWO_LINKS.joints
    torque = course.torque + np.array([3.0, 0.3]) * np.tanh(course.velocity / [0.03, 0.1])
    predictor = TWO_LINKS.predictor(TWO_LINKS.log(course, torque))
    fits = Fits(Dictionary(predictor, [CoulombFriction]))
    made, beside = fits.candidate, fits.remainder(fits.explain([]))
    start = {shoulder: np.array([0.03]), elbow: np.array([0.02])}
    first, second = (made(CoulombFriction, (j,), x, beside) for j, x in start.items())

    def worse_in_the_shoulder(effect, targets, nonlinear, remainder):
        there = nonlinear if targets == (elbow,) else np.array([1.0])
        return made(effect, targets, there, remainder)

    monkeypatch.setattr(fits, "candidate", worse_in_the_shoulder)
    before = fits.explain([first, second])
    after = polished(fits, before)
    assert after.candidates[0] is first
    assert start[elbow] < after.candidates[1].nonlinear < 0.1
    assert after.deviance < before.deviance - MARGIN


@pytest.fixture
def pushed(monkeypatch: pytest.MonkeyPatch) -> Predictor:
    """A constant torque, which has two names; the one that a search finds first does not pay."""

    def frugal(proposals: Proposals, explanation: Explanation) -> Explanation:
        held = [c for c in explanation.candidates if c.effect is not TorqueBias]
        return proposals.fits.explain(held)

    monkeypatch.setattr("fbse_drake.discrepancy.diagnosis.search.frugal", frugal)
    course = PENDULUM.course(1)
    return PENDULUM.predictor(PENDULUM.log(course, course.torque + 0.3))


def test_a_search_whose_first_find_does_not_hold_goes_another_way(pushed: Predictor) -> None:
    diagnosis = diagnose(pushed, [TorqueBias, Wrench])
    assert [finding.effect for finding in diagnosis.chosen] == ["Wrench"]
    assert diagnosis.chosen[0].parameters["bias"].value == pytest.approx(0.3, rel=0.05)


def test_a_rival_that_does_not_pay_takes_no_place(
    pushed: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def settled(proposals: Proposals, final: Explanation) -> tuple[Explanation, dict]:
        rest = proposals.fits.explain([])
        return proposals.beside(rest, TorqueBias, final.candidates[0].targets), {}

    monkeypatch.setattr("fbse_drake.discrepancy.diagnosis.search.settled", settled)
    diagnosis = diagnose(pushed, [TorqueBias, Wrench])
    assert [finding.effect for finding in diagnosis.chosen] == ["Wrench"]


@pytest.mark.parametrize("hidden", ["TorqueDelay", "TorqueLag"])
def test_lag_and_delay_that_do_the_same_but_for_what_friction_may_hide_are_confusable(
    hidden: str,
) -> None:
    """Sharp friction is fitted by a law that is not quite its own: which of the two fits better
    beside it says nothing."""
    course = ARM.course()
    given = course.torque + 25.0 * np.tanh(course.velocity / 0.002) * (np.arange(6) == 0)
    late, time = 0.008, course.time
    if hidden == "TorqueDelay":
        given[:, 0] = np.interp(time + late, time, given[:, 0])
    else:
        given[:, 0] += late * course.rate(given)[:, 0]
    chosen = diagnose(ARM.predictor(ARM.log(course, given))).chosen
    (found,) = (finding for finding in chosen if finding.effect.startswith("Torque"))
    assert hidden in {found.effect, *found.confusable_with}
