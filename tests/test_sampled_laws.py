"""Laws of rows that are sampled at an instant hold at the samples, as their torques do, however
much a joint's speed changes between two of them.

Truth: inverse dynamics of an arm, with friction by formulas of this file.
"""

from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import ARM, Course
from scipy.signal import lfilter

from fbse_drake.discrepancy.diagnosis.bandwidth import averaged_to_bandwidth
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import library
from fbse_drake.report.sentences import diagnosis_outcome
from fbse_drake.scenario import Scenario

TRANSITION = 0.01
# Of a torque in multiples of its noise: a law that is off by a tenth shows.
LOUD = 30.0
SIZE = LOUD * np.array(ARM.torque_noise)


def coulomb(course: Course) -> np.ndarray:
    return SIZE * np.tanh(course.velocity / TRANSITION)


def believing(scenario: Scenario, effect: str, **values: dict[str, float]) -> Scenario:
    effects = {"known": library()[effect](**values)}
    return replace(scenario, model=replace(scenario.model, effects=effects))


@pytest.mark.parametrize("period", [0.005, 0.01])
def test_a_known_law_leaves_noise_where_joints_turn(period: float):
    """In a hundredth of a second an axis goes from full friction to full friction."""
    machine = replace(ARM, period=period, duration=20.0)
    course = machine.course(2)
    change = np.abs(np.diff(course.velocity, axis=0)).max(axis=0)
    assert (change > TRANSITION).all()
    scenario = believing(
        machine.scenario,
        "CoulombFriction",
        coulomb=machine.by_joint(tuple(SIZE)),
        transition={"all": TRANSITION},
    )
    log = machine.log(course, course.torque + coulomb(course))
    predictor, _ = averaged_to_bandwidth(Predictor(scenario, log))
    plain, _ = averaged_to_bandwidth(machine.predictor(machine.log(course)))
    # What friction adds to what is left, by the same noise.
    added = (predictor.residual.value - plain.residual.value) / plain.residual.noise_floor
    assert np.sqrt((added**2).mean(axis=0)).max() < 0.3
    middle = 0.5 * (course.velocity[1:] + course.velocity[:-1])
    amid = SIZE * np.tanh(middle / TRANSITION) - 0.5 * (coulomb(course)[1:] + coulomb(course)[:-1])
    # As it would be by the speed amid two samples.
    assert np.sqrt((amid**2).mean(axis=0) / np.array(machine.torque_noise) ** 2).min() > 0.6


@pytest.mark.parametrize(("displacement", "named"), [(1e-4, False), (5e-3, True)])
def test_what_is_over_when_a_late_torque_has_followed_is_not_named(
    displacement: float, named: bool
):
    """Friction that builds up over a displacement, of joints that pass it in some milliseconds or
    in some tens of them."""
    machine = replace(ARM, period=0.004, duration=20.0)
    course = machine.course(4)
    # Dahl's law for what moves on between samples, by Dahl's own formula.
    z, given = np.zeros(6), course.torque.copy()
    for k, v in enumerate(course.velocity):
        sign = np.sign(v)
        given[k] += SIZE * (sign + (z - sign) * np.exp(-np.abs(v) * 0.5 * 0.004 / displacement))
        z = sign + (z - sign) * np.exp(-np.abs(v) * 0.004 / displacement)
    tried = ("CoulombFriction", "ViscousFriction", "PreslidingHysteresis")
    diagnosis = diagnose(
        machine.predictor(machine.log(course, given)), [library()[name] for name in tried]
    )
    assert ("PreslidingHysteresis" in {f.effect for f in diagnosis.chosen}) is named
    if named:
        assert {f.effect for f in diagnosis.chosen} == {"PreslidingHysteresis"}
        for finding in diagnosis.chosen:
            found = finding.parameters["displacement"].value
            assert found == pytest.approx(displacement, rel=0.15)


@pytest.mark.parametrize(("hump", "noise", "seed"), [(0.0, 0.3, 3), (0.0, 0.1, 4), (0.8, 0.1, 4)])
def test_a_filter_of_the_torque_makes_no_stribeck_hump(hump: float, noise: float, seed: int):
    """Behind a current filter friction that jumps comes smeared, about which rows of some
    milliseconds say little; a hump of joints that are slow for longer is there all the same.

    Args:
        noise: of the torques, as a share of the arm's.
    """
    torque_noise = tuple(noise * np.array(ARM.torque_noise))
    fine = replace(ARM, period=0.001, duration=30.0, torque_noise=torque_noise)
    course, every, late = fine.course(seed), 4, 0.003
    law = SIZE * np.tanh(course.velocity / TRANSITION)
    friction = law * (1.0 + hump * np.exp(-((course.velocity / 0.15) ** 2)))
    share = 1.0 - np.exp(-fine.period / late)
    given = lfilter([share], [1.0, share - 1.0], course.torque + friction, axis=0)
    seen = Course(*(np.asarray(values)[::every] for values in vars(course).values()))
    machine = replace(fine, period=fine.period * every)
    tried = ("CoulombFriction", "ViscousFriction", "StribeckFriction", "TorqueReadingLag")
    diagnosis = diagnose(
        machine.predictor(machine.log(seen, given[::every])), [library()[name] for name in tried]
    )
    law_found = "StribeckFriction" if hump else "CoulombFriction"
    assert {f.effect for f in diagnosis.chosen} == {law_found, "TorqueReadingLag"}
    # One recorder reads all joints, also those that hardly tell.
    for effect in (law_found, "TorqueReadingLag"):
        having = {joint for f in diagnosis.chosen if f.effect == effect for joint in f.targets}
        assert having == set(ARM.joints)


@pytest.mark.parametrize(("late", "is_named"), [(2, False), (8, True)])
def test_a_delay_between_two_samples_is_tentative(late: int, is_named: bool):
    """Torques are not known between samples that are 4 ms apart.

    Args:
        late: how many milliseconds after their commands torques act.
    """
    fine = replace(ARM, period=0.001, duration=30.0)
    course, every = fine.course(5), 4
    commands = np.concatenate([course.torque[late:], course.torque[-late:]])
    seen = Course(*(np.asarray(values)[::every] for values in vars(course).values()))
    machine = replace(fine, period=fine.period * every)
    tried = [library()[name] for name in ("CoulombFriction", "ViscousFriction", "TorqueDelay")]
    diagnosis = diagnose(machine.predictor(machine.log(seen, commands[::every])), tried)
    assert {f.effect for f in diagnosis.chosen} == ({"TorqueDelay"} if is_named else set())
    assert {f.effect for f in diagnosis.tentative} == (set() if is_named else {"TorqueDelay"})
    assert diagnosis.verdict == ("effect_found" if is_named else "not_visible")
    if not is_named:
        text = diagnosis_outcome(diagnosis)
        assert "cannot tell whether something is missing: what the model leaves over looks" in text


def test_a_motor_is_not_saturated_most_of_the_time():
    """Friction that depends on the angle is in no library. Of a motor that gave hardly more than
    the friction next to nothing would be left to explain: so it was said to be, by a limit that
    torques exceeded for three quarters of the time."""
    machine = replace(ARM, duration=20.0)
    course = machine.course(16)
    given = course.torque + coulomb(course) * (1.0 + 0.5 * np.sin(2.0 * course.position))
    names = ("CoulombFriction", "TorqueSaturation", "ReflectedInertia")
    tried = [library()[name] for name in names]
    diagnosis = diagnose(machine.predictor(machine.log(course, given)), tried)
    assert diagnosis.verdict == "unknown_effect"
    assert {f.effect for f in (*diagnosis.chosen, *diagnosis.tentative)} == {"CoulombFriction"}
    assert {structure.index for structure in diagnosis.unexplained} == set(range(6))
