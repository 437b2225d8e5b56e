"""A spring that holds a link is found as what it is, and is not seen where nothing or a stop is."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import PENDULUM, Course, Machine

from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.effects.effect import library

# What could be meant by what acts here; the whole library takes longer.
NAMES = (
    "BodyMass",
    "CoulombFriction",
    "Counterbalance",
    "EncoderOffset",
    "JointSpring",
    "ReflectedInertia",
    "TorqueBias",
    "TorqueGain",
    "ViscousFriction",
)
STIFFNESS, POST, CRANK = 60.0, np.array([0.05, 0.12]), 0.1
TRUTH = STIFFNESS * CRANK * np.array([POST[1], -POST[0]])


def spring_torque(angle: np.ndarray) -> np.ndarray:
    """Of a spring without free length from a post to the end of a crank, about the crank's pivot:
    the pull's moment, from where both ends are."""
    end = CRANK * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pull = STIFFNESS * (POST - end)
    return end[..., 0] * pull[..., 1] - end[..., 1] * pull[..., 0]


def diagnosis(machine: Machine, course: Course, helped: np.ndarray | float) -> Diagnosis:
    """Of a log whose drives give what the links need, less what helps them."""
    log = machine.log(course, course.torque - helped)
    return diagnose(machine.predictor(log), [library()[name] for name in NAMES])


@pytest.fixture(scope="module")
def course() -> Course:
    made = PENDULUM.course(3)
    assert np.ptp(made.position) > 0.5 * np.pi
    return made


def test_a_spring_over_a_crank_is_a_counterbalance(course: Course) -> None:
    """Its torque is that of a geometry: nothing in it was made by the law."""
    found = diagnosis(PENDULUM, course, spring_torque(course.position))
    (finding,) = found.chosen
    assert (finding.effect, found.verdict) == ("Counterbalance", "effect_found")
    assert not finding.confusable_with
    for name, truth in zip(("cosine", "sine"), -TRUTH, strict=True):
        least, most = finding.parameters[name].interval
        assert least <= truth <= most
        assert most - least < 0.2 * np.hypot(*TRUTH)


@pytest.mark.parametrize(
    ("effect", "of_position"),
    [("JointSpring", lambda q: -0.7 * q - 0.1), ("TorqueBias", lambda q: 0.2 + 0 * q)],
)
def test_what_is_no_wave_over_the_angle_is_no_counterbalance(
    course: Course, effect: str, of_position: Callable[[np.ndarray], np.ndarray]
) -> None:
    found = diagnosis(PENDULUM, course, of_position(course.position))
    assert [finding.effect for finding in found.chosen] == [effect]


def test_nothing_is_balanced_where_nothing_helps(course: Course) -> None:
    assert diagnosis(PENDULUM, course, 0.0).verdict == "nothing_missing"


def test_a_joint_that_hardly_turns_does_not_show_it_but_that_it_may_be_there() -> None:
    short = replace(PENDULUM, amplitude=(0.3,))
    course = short.course(3)
    found = diagnosis(short, course, spring_torque(course.position))
    assert found.chosen
    for finding in found.chosen:
        assert finding.effect != "Counterbalance"
        assert "Counterbalance" in finding.confusable_with
    assert found.effects["Counterbalance"].verdict == "confusable"
