"""Effects that explain a part of what is left, of which more stays: the completed model gets them,
and nobody is told that they are there.

Truth: inverse dynamics of an arm, with friction and with something that no library has.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import ARM

from fbse_drake import add
from fbse_drake.discrepancy.diagnosis.add import read_findings
from fbse_drake.discrepancy.diagnosis.diagnose import (
    Diagnosis,
    Finding,
    diagnose,
    diagnosis_json,
)
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.explanation import Candidate
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.naming import is_named
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.diagnosis.refinement import converged
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.identification.structure import leftover_structure
from fbse_drake.effects.effect import library
from fbse_drake.report.sentences import diagnosis_outcome

MACHINE = replace(ARM, duration=12.0)
TRIED = [
    library()[name]
    for name in ("CoulombFriction", "ViscousFriction", "JointSpring", "TorqueGain", "TorqueBias")
]
NOISE = np.array(MACHINE.torque_noise)


def diagnosis_of(
    *, friction: float = 5.0, spring: float = 2.0, stranger: float = 3.0, told: float = 1.0
) -> Diagnosis:
    """Of an arm with Coulomb friction in its first two joints, and in the second a spring and a
    stranger as well.

    Args:
        friction, spring, stranger: root mean squares in multiples of the noise of a torque.
        told: noise that is believed in, of what there is.
    """
    course = MACHINE.course(1)
    given, lift = course.torque.copy(), course.position[:, 1] - course.position[:, 1].mean()
    given[:, :2] += friction * NOISE[:2] * np.tanh(course.velocity[:, :2] / 0.02)
    given[:, 1] += spring * NOISE[1] * lift / lift.std()
    # A wave that follows nothing that the log has.
    given[:, 1] += stranger * NOISE[1] * np.sqrt(2) * np.sin(2 * np.pi * 3.7 * course.time)
    machine = replace(MACHINE, torque_noise=tuple(told * NOISE))
    return diagnose(machine.predictor(MACHINE.log(course, given)), TRIED)


def named(findings: Iterable[Finding]) -> set[tuple[str, str]]:
    return {(finding.effect, target) for finding in findings for target in finding.targets}


FRICTION = {("CoulombFriction", "axis_1"), ("CoulombFriction", "axis_2")}
SPRING = ("JointSpring", "axis_2")


@pytest.fixture(scope="module")
def beside_a_stranger() -> Diagnosis:
    return diagnosis_of()


def test_what_takes_less_than_it_leaves_is_not_named(beside_a_stranger: Diagnosis):
    found = beside_a_stranger
    assert found.verdict == "unknown_effect"
    assert named(found.chosen) == FRICTION
    assert named(found.tentative) == {SPRING}
    # Of squares: 4 of 4 + 9.
    (one,) = found.tentative
    taken, stays = one.held_out_before**2 - one.held_out_after**2, one.held_out_after**2 - 1.0
    assert taken / (taken + stays) == pytest.approx(4.0 / 13.0, abs=0.1)


def test_the_completed_model_gets_it_all_the_same(beside_a_stranger: Diagnosis):
    written = read_findings(diagnosis_json(beside_a_stranger))
    assert named(written) == FRICTION | {SPRING}
    completed = add(MACHINE.scenario, beside_a_stranger)
    effects = {type(effect).__name__ for effect in completed.believed.effects.values()}
    assert effects == {"CoulombFriction", "JointSpring"}


def test_it_is_said_to_be_tentative(beside_a_stranger: Diagnosis):
    outcome = diagnosis_outcome(beside_a_stranger)
    assert "The model also lacks Coulomb friction in axis 1, axis 2." in outcome
    assert "Tentative: joint spring in axis 2. The completed model has it, but more is" in outcome
    statuses = beside_a_stranger.effects
    assert statuses["CoulombFriction"].verdict == "present"
    assert statuses["JointSpring"].verdict == "confusable"
    (entry,) = (e for e in diagnosis_json(beside_a_stranger)["ranking"] if e["tentative"])
    assert (entry["effect"], entry["chosen"]) == ("JointSpring", False)


@pytest.mark.parametrize(("stranger", "told"), [(0.0, 1.0), (1.0, 1.0), (0.0, 0.87)])
def test_what_takes_most_is_named(stranger: float, told: float):
    """Also if a little stays, or if the noise was told 15 % too small."""
    found = diagnosis_of(stranger=stranger, told=told)
    assert named(found.chosen) == FRICTION | {SPRING}
    assert not found.tentative


@pytest.mark.parametrize("stranger", [1.0, 12.0])
def test_a_hump_that_takes_less_than_is_left_is_not_named(stranger: float):
    """Beside what nobody explains, a law with more parameters than Coulomb and viscous friction
    takes some of it. Its hump is 4 times the noise here."""
    course = MACHINE.course(2)
    given, velocity = course.torque.copy(), course.velocity[:, 1]
    hump = np.tanh(velocity / 0.02) * np.exp(-((velocity / 0.3) ** 2))
    friction = 60.0 * np.tanh(velocity / 0.02) + 20.0 * velocity + 4.0 * hump / hump.std()
    wave = stranger * np.sqrt(2) * np.sin(2 * np.pi * 3.7 * course.time)
    given[:, 1] += NOISE[1] * (friction + wave)
    law = library()["StribeckFriction"]
    predictor = MACHINE.predictor(MACHINE.log(course, given))
    proposals = Proposals(Fits(Dictionary(predictor, [*TRIED, law])))
    fits, nothing = proposals.fits, proposals.fits.explain([])
    final = converged(fits, proposals.beside(nothing, law, ("axis_2",)))
    (member,) = final.candidates
    left = leftover_structure(predictor.motion, fits.white, fits.leftover(final))
    assert is_named(proposals, final, member, nothing, left) == (stranger == 1.0)


@pytest.mark.parametrize(("share", "expected"), [(0.3, False), (0.7, True), (10.0, True)])
def test_play_that_would_rather_be_less_than_any_that_is_sought_is_not_named(
    share: float, expected: bool
):
    """The smallest gap that is tried is half the least that is plausible."""
    play, course = library()["Backlash"], MACHINE.course(1)
    predictor = MACHINE.predictor(MACHINE.log(course))
    dictionary, clean = Dictionary(predictor, [play]), predictor.residual
    least = dictionary.parameters(play, "axis_1")["gap"].plausible[0]

    def with_gap(fits: Fits, gap: float) -> Candidate:
        values = np.array([gap, MACHINE.rotor_inertia[0], 1e-3])
        return fits.candidate(play, ("axis_1",), values, fits.remainder(fits.explain([])))

    there = replace(clean, value=clean.value.copy())
    there.value[:, 0] += with_gap(Fits(dictionary), share * least).raw.offset[:, 0]
    fits = Fits(dictionary, WhitenedResidual(there))
    member, nothing = with_gap(fits, max(0.5, share) * least), fits.explain([])
    assert is_named(Proposals(fits), fits.explain([member]), member, nothing, []) == expected
