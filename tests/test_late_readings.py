"""Torques that were measured, as motor currents are, come late: behind a filter, or by another
clock."""

from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import ARM, Course
from scipy.signal import lfilter

from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.search import best_search
from fbse_drake.effects.actuation import TorqueBias, TorqueReadingLag
from fbse_drake.effects.effect import library
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.scenario import RecordingConfig

TRIED = (
    "CoulombFriction",
    "ViscousFriction",
    "StribeckFriction",
    "PreslidingHysteresis",
    "ReflectedInertia",
    "TorqueGain",
    "TorqueBias",
    "TorqueLag",
    "TorqueDelay",
    "TorqueReadingLag",
)
MACHINE = replace(ARM, duration=12.0)


def course_of(seed: int) -> Course:
    """At 1 kHz, as the drive runs."""
    return replace(MACHINE, period=1e-3).course(seed)


def diagnosis_of(seed: int, late: float, friction: float, *, by_clock: bool = False) -> Diagnosis:
    """Of torques that are recorded so late [s], at 250 Hz, of an arm with so much friction."""
    course = course_of(seed)
    size = np.sqrt((course.torque**2).mean(axis=0))
    given = course.torque + friction * size * np.tanh(course.velocity / 0.02)
    if by_clock:
        read = late_by_clock(replace(course, torque=given), late)
    else:
        kept = np.exp(-1e-3 / late) if late else 0.0
        read, _ = lfilter([1 - kept], [1, -kept], given, axis=0, zi=kept * given[:1])
    log = MACHINE.log(rarely(course), read[::4], seed)
    return diagnose(MACHINE.predictor(log), [library()[name] for name in TRIED])


def late_by_clock(course: Course, late: float) -> np.ndarray:
    """The torques of a course, at 1 kHz, as a clock that is late [s] has them."""
    samples = round(late * 1e3)
    first = course.torque[:1].repeat(samples, axis=0)
    return np.concatenate([first, course.torque[: len(course.torque) - samples]])


def rarely(course: Course) -> Course:
    """As it is recorded, at 250 Hz."""
    return Course(*(values[::4] for values in vars(course).values()))


def found(diagnosis: Diagnosis) -> dict[str, set[str]]:
    result: dict[str, set[str]] = {}
    for finding in diagnosis.chosen:
        result.setdefault(finding.effect, set()).update(finding.targets)
    return result


@pytest.mark.parametrize(("late", "by_clock"), [(0.004, False), (0.006, False), (0.004, True)])
def test_late_torques_are_no_friction(late: float, by_clock: bool):
    diagnosis = diagnosis_of(3, late, 0.0, by_clock=by_clock)
    assert diagnosis.verdict == "effect_found"
    assert found(diagnosis) == {"TorqueReadingLag": set(MACHINE.joints)}
    (finding,) = diagnosis.chosen
    assert finding.parameters["time_constant"].value == pytest.approx(late, rel=0.15)


@pytest.mark.parametrize(("late", "by_clock"), [(0.004, False), (0.006, False), (0.004, True)])
@pytest.mark.parametrize("seed", [5, 7])
def test_friction_is_found_beside_late_torques(seed: int, late: float, by_clock: bool):
    """And nothing else: that jumps come late is no presliding."""
    diagnosis = diagnosis_of(seed, late, 0.2, by_clock=by_clock)
    assert diagnosis.verdict == "effect_found"
    named, everywhere = found(diagnosis), set(MACHINE.joints)
    assert named == {"CoulombFriction": everywhere, "TorqueReadingLag": everywhere}
    (finding,) = (f for f in diagnosis.chosen if f.effect == "TorqueReadingLag")
    assert finding.parameters["time_constant"].value == pytest.approx(late, rel=0.2)
    assert diagnosis.effects["TorqueReadingLag"].verdict == "present"
    assert diagnosis.held_out_before > 10.0
    assert diagnosis.held_out_after < 1.0


def test_a_model_that_knows_of_late_torques_reads_them_in_time():
    """Friction that jumps leaves noise when both are in the model."""
    course, late, size = course_of(2), 0.004, 30.0 * np.array(MACHINE.torque_noise)
    given = course.torque + size * np.tanh(course.velocity / 0.005)
    read = late_by_clock(replace(course, torque=given), late)
    log = MACHINE.log(rarely(course), read[::4], 2)
    friction = CoulombFriction(coulomb=MACHINE.by_joint(tuple(size)), transition={"all": 0.005})
    errors = []
    for effects in (
        {"friction": friction},
        {"friction": friction, "late": TorqueReadingLag(time_constant={"all": late})},
    ):
        model = replace(MACHINE.scenario.model, effects=effects)
        residual = Predictor(replace(MACHINE.scenario, model=model), log).residual
        errors.append(np.sqrt((residual.value**2).mean(axis=0)) / residual.noise_floor)
    assert (errors[0] > 2.0).all()
    assert (errors[1] < 1.1).all()


def test_what_is_late_in_one_joint_is_read_in_time_in_all_that_are():
    """Though it is small beside that joint's torque, for it carries a load."""
    course, late, load = course_of(3), 0.004, 350.0
    read = course.torque.copy()
    read[:, :2] = late_by_clock(course, late)[:, :2] + [load, 0.0]
    carrying = TorqueBias(bias={"axis_1": load})
    model = replace(MACHINE.scenario.model, effects={"load": carrying})
    log = MACHINE.log(rarely(course), read[::4], 3)
    predictor = Predictor(replace(MACHINE.scenario, model=model), log)
    effects = [library()[name] for name in ("CoulombFriction", "TorqueReadingLag")]
    best = best_search(Dictionary(predictor, effects), effects)
    assert best.late is not None
    read_earlier = best.late.effect.time_constant
    assert read_earlier == {
        "axis_1": pytest.approx(late, rel=0.15),
        "axis_2": pytest.approx(late, rel=0.15),
    }
    assert best.search.error < 1.0
    small, matters = diagnose(predictor, effects).ranking
    assert (small.effect, small.targets) == ("TorqueReadingLag", ("axis_1",))
    assert (matters.effect, matters.targets) == ("TorqueReadingLag", ("axis_2",))
    assert (small.too_small, small.chosen) == (True, False)
    assert (matters.too_small, matters.chosen) == (False, True)


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_torques_in_time_are_not_late(friction: float):
    named = found(diagnosis_of(5, 0.0, friction))
    assert named.keys() == ({"CoulombFriction"} if friction else set())


def test_commands_are_not_read():
    """Of a controller's own commands it is not tried."""
    course = MACHINE.course(1)
    scenario = replace(MACHINE.scenario, recording=RecordingConfig())
    predictor = Predictor(scenario, MACHINE.log(course))
    dictionary = Dictionary(predictor, [TorqueReadingLag], lambda *_: None)
    assert not dictionary.groups_of(TorqueReadingLag)
    status = diagnose(predictor, [TorqueReadingLag]).effects["TorqueReadingLag"]
    assert (status.verdict, status.smallest_detectable) == ("not_visible", {})
    sampled = Dictionary(
        MACHINE.predictor(MACHINE.log(course)), [TorqueReadingLag], lambda *_: None
    )
    assert tuple(MACHINE.joints) in sampled.groups_of(TorqueReadingLag)


def test_a_lag_of_the_drive_and_one_of_the_reading_are_not_both_named():
    """Only their difference shows."""
    for finding in diagnosis_of(6, 0.006, 0.2).chosen:
        assert finding.effect not in ("TorqueLag", "TorqueDelay")
