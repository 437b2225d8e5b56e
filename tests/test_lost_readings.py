"""Torques that a recorder lost, and wrote as 0: they are not fitted as such.

Truth: an arm's inverse dynamics, with friction by formulas of this file.
"""

from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import ARM

from fbse_drake import compare
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.residual.lost_readings import between_lost, lost_readings
from fbse_drake.effects.effect import library

MACHINE = replace(ARM, duration=15.0)
COULOMB, VISCOUS = (share * np.array(ARM.torque_noise) for share in (30.0, 12.0))
TRIED = ("CoulombFriction", "ViscousFriction", "StribeckFriction", "TorqueGain", "TorqueBias")


def test_friction_is_found_as_if_nothing_was_lost():
    """It was 3.5 % too small."""
    course, random = MACHINE.course(5), np.random.default_rng(6)
    friction = COULOMB * np.tanh(course.velocity / 0.01) + VISCOUS * course.velocity

    def read(torque: np.ndarray) -> np.ndarray:
        return np.where(random.random(torque.shape) < 0.03, 0.0, torque)

    log = MACHINE.log(course, course.torque + friction, read=read)
    diagnosis = diagnose(MACHINE.predictor(log), [library()[name] for name in TRIED])
    assert {f.effect for f in diagnosis.chosen} == {"CoulombFriction", "ViscousFriction"}
    assert not diagnosis.tentative
    for finding in diagnosis.chosen:
        name, truth = (
            ("coulomb", COULOMB) if finding.effect == "CoulombFriction" else ("viscous", VISCOUS)
        )
        expected = np.mean([truth[MACHINE.joints.index(joint)] for joint in finding.targets])
        assert finding.parameters[name].value == pytest.approx(expected, rel=0.01)
    (told,) = (f for f in compare(MACHINE.scenario, log).hygiene.findings if f.kind == "lost")
    assert told.severity == "warning"
    assert set(told.where) == set(MACHINE.joints)


def test_what_was_lost_lies_between_what_was_not():
    time = np.arange(500) * 0.01
    torque = np.stack([20 + np.sin(3 * time), 5 * np.sin(time)], axis=1)
    random = np.random.default_rng(7)
    lost = random.random(torque.shape) < 0.03
    # An arm's other joint passes 0, where nobody can say.
    lost &= np.abs(torque) > 2.0
    lost[[0, -1]] = False
    read = np.where(lost, 0.0, torque)
    np.testing.assert_array_equal(lost_readings(read), lost)
    # Three samples at most, over which a sine bends by less than an eighth of (4 w dt)^2.
    np.testing.assert_allclose(between_lost(read), torque, atol=(4 * 3 * 0.01) ** 2 / 8)
    np.testing.assert_array_equal(between_lost(torque), torque)


def test_what_is_off_or_chatters_is_not_lost():
    torque = np.full((300, 3), 8.0) + np.random.default_rng(8).normal(0, 0.1, (300, 3))
    torque[100:110, 0] = 0.0
    torque[::2, 1] *= -1
    torque[[50, 150], 2] = 0.0
    assert not lost_readings(torque).any()
