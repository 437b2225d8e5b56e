"""Short disturbances are left out and said; what comes again and again, or belongs to a law, is
not."""

from collections.abc import Callable

import numpy as np
import pytest
from recorded_arm import PENDULUM, Course

from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.effects.effect import library

NAMES = ("CoulombFriction", "ViscousFriction", "TorqueBias", "TorqueGain", "TorqueSaturation")
Push = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def course() -> Course:
    return PENDULUM.course()


def diagnosis_of(course: Course, push: Push, read: Push = np.array) -> Diagnosis:
    """Of a pendulum with friction, of which the model has none, and a push."""
    friction = 0.3 * np.tanh(course.velocity / 0.01)
    given = course.torque + friction + push(course.time)[:, None]
    log = PENDULUM.log(course, given, read=read)
    return diagnose(PENDULUM.predictor(log), [library()[name] for name in NAMES])


def pulse(*starts: float, size: float = 0.8, length: float = 0.2) -> Push:
    def push(time: np.ndarray) -> np.ndarray:
        return size * sum((time >= start) & (time < start + length) for start in starts)

    return push


def test_a_push_is_left_out_and_what_is_left_is_explained(course: Course) -> None:
    diagnosis = diagnosis_of(course, pulse(3.2))
    (disturbance,) = diagnosis.disturbances
    assert disturbance.rows == tuple(PENDULUM.joints)
    assert 3.05 < disturbance.start < 3.2
    assert 3.4 < disturbance.end < 3.55
    assert diagnosis.verdict == "effect_found"
    (friction,) = diagnosis.chosen
    assert friction.effect == "CoulombFriction"
    low, high = friction.parameters["coulomb"].interval
    assert low < 0.3 < high
    assert high - low < 0.02


def test_two_pushes_are_two(course: Course) -> None:
    first, second = diagnosis_of(course, pulse(2.0, 5.5, length=0.08)).disturbances
    assert first.end < 2.4 < 5.4 < second.start


def test_a_push_that_becomes_a_pull_is_one(course: Course) -> None:
    def push(time: np.ndarray) -> np.ndarray:
        return pulse(3.2, length=0.06)(time) - pulse(3.4, length=0.06)(time)

    diagnosis = diagnosis_of(course, push)
    (disturbance,) = diagnosis.disturbances
    assert 3.05 < disturbance.start < 3.2
    assert 3.46 < disturbance.end < 3.6
    assert {finding.effect for finding in diagnosis.chosen} == {"CoulombFriction"}


def test_pushes_again_and_again_are_unknown(course: Course) -> None:
    diagnosis = diagnosis_of(course, pulse(*np.arange(0.5, 7.5, 0.9)))
    assert diagnosis.disturbances == ()
    assert diagnosis.verdict == "unknown_effect"


def test_a_long_push_is_none(course: Course) -> None:
    diagnosis = diagnosis_of(course, pulse(2.0, length=2.5))
    assert diagnosis.disturbances == ()
    assert diagnosis.verdict == "unknown_effect"


def test_nothing_acts_on_a_pendulum_that_nobody_pushes(course: Course) -> None:
    diagnosis = diagnosis_of(course, np.zeros_like)
    assert diagnosis.disturbances == ()
    assert [f.effect for f in diagnosis.chosen] == ["CoulombFriction"]
