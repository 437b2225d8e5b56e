"""Friction holds a joint that rests by as much as is needed, anything up to what moves it.

Truth: inverse dynamics of an arm that goes from place to place and waits there, with friction by
formulas of this file.
"""

from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import ARM, Machine

from benchmarks.recorded.course import Course, inverse_dynamics
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.friction import (
    CoulombFriction,
    DirectionalFriction,
    StribeckFriction,
    ViscousFriction,
)
from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque
from fbse_drake.effects.transmission import PreslidingHysteresis

MACHINE = replace(ARM, duration=20.0)
COULOMB = 30.0 * np.array(ARM.torque_noise)
VISCOUS = 0.4 * COULOMB
TRIED = (
    "CoulombFriction",
    "ViscousFriction",
    "StribeckFriction",
    "PreslidingHysteresis",
    "TorqueBias",
    "TorqueLag",
)


def stops(machine: Machine, seed: int) -> Course:
    """Every joint goes to and fro by smooth steps (fifth order) and rests for half a second after
    each."""
    random = np.random.default_rng(seed)
    time = np.arange(round(machine.duration / machine.period) + 1) * machine.period
    motion = np.zeros((3, len(time), len(machine.posture)))
    for joint, (middle, amplitude) in enumerate(
        zip(machine.posture, machine.amplitude, strict=True)
    ):
        start, here = 0.0, middle
        while start < time[-1]:
            lasts, to = random.uniform(0.6, 1.4), middle + amplitude * random.uniform(-1, 1)
            s = np.clip((time - start) / lasts, 0.0, 1.0)
            now, way = (time >= start) & (time < start + lasts + 0.5), to - here
            shapes = (
                here + way * s**3 * (10 - 15 * s + 6 * s**2),
                way / lasts * 30 * s**2 * (1 - s) ** 2,
                way / lasts**2 * 60 * s * (1 - s) * (1 - 2 * s),
            )
            motion[:, now, joint] = [shape[now] for shape in shapes]
            start, here = start + lasts + 0.5, to
    rotors = machine.by_joint(machine.rotor_inertia)
    return Course(time, *motion, inverse_dynamics(machine.robot(rotors), *motion))


def held(course: Course, share: float) -> np.ndarray:
    """Coulomb and viscous friction; where a joint rests, this share of Coulomb friction is left of
    the last motion."""
    friction = VISCOUS * course.velocity
    for joint, coulomb in enumerate(COULOMB):
        last = 0.0
        for k, velocity in enumerate(course.velocity[:, joint]):
            moves = abs(velocity) > 1e-6
            last = np.sign(velocity) if moves else last
            friction[k, joint] += coulomb * last * (1.0 if moves else share)
    return friction


def found_in(course: Course, given: np.ndarray) -> Diagnosis:
    tried: list[type[Effect]] = [library()[name] for name in TRIED]
    return diagnose(MACHINE.predictor(MACHINE.log(course, given)), tried)


@pytest.mark.parametrize(("share", "seed"), [(-0.3, 42), (0.8, 3), (0.9, 6)])
def test_what_holds_a_joint_at_rest_is_no_law_of_its_own(share: float, seed: int):
    """It was hysteresis, a Stribeck hump and a lag of 18 ms."""
    course = stops(MACHINE, seed)
    diagnosis = found_in(course, course.torque + held(course, share))
    assert {f.effect for f in (*diagnosis.chosen, *diagnosis.tentative)} == {
        "CoulombFriction",
        "ViscousFriction",
    }
    for finding in diagnosis.chosen:
        name, truth = (
            ("coulomb", COULOMB) if finding.effect == "CoulombFriction" else ("viscous", VISCOUS)
        )
        of_joints = [truth[MACHINE.joints.index(joint)] for joint in finding.targets]
        assert finding.parameters[name].value == pytest.approx(np.mean(of_joints), rel=0.02)
    assert diagnosis.verdict == "effect_found"


def test_at_rest_a_joint_without_dry_friction_shows_its_torque():
    """Nothing holds it but its motor: a bias is told there as anywhere."""
    course, bias = stops(MACHINE, 43), 0.2 * COULOMB
    diagnosis = found_in(course, course.torque + VISCOUS * course.velocity + bias)
    assert {f.effect for f in diagnosis.chosen} == {"TorqueBias", "ViscousFriction"}
    for finding in diagnosis.chosen:
        if finding.effect == "TorqueBias":
            (joint,) = finding.targets
            place = MACHINE.joints.index(joint)
            estimate = finding.parameters["bias"]
            assert estimate.value == pytest.approx(bias[place], rel=0.02)
            # As sure as white noise of all samples makes it, but for what others explain of it.
            samples = len(course.time)
            assert np.diff(estimate.interval) < 12 * ARM.torque_noise[place] / np.sqrt(samples)


def test_rows_at_rest_are_as_uncertain_as_friction_is_large():
    course = stops(MACHINE, 44)
    log = MACHINE.log(course)
    by_joint = MACHINE.by_joint(tuple(COULOMB))
    plain = MACHINE.predictor(log)
    model = replace(plain.scenario.model, effects={"dry": CoulombFriction(coulomb=by_joint)})
    known = plain.of(replace(plain.scenario, model=model)).residual
    length, n = plain.motion.length, len(MACHINE.joints)
    fastest = np.abs(course.velocity[: len(known.time) * length]).reshape(-1, length, n).max(axis=1)
    rests = np.ones(fastest.shape, dtype=bool)
    for shift in (-2, -1, 0, 1, 2):
        rests &= np.roll(fastest, shift, axis=0) < 1e-9
    rests[:2] = rests[-2:] = False
    doubt = np.sqrt(known.variance[:, :n] - plain.residual.variance[:, :n])
    assert rests.mean() > 0.1
    # But for a velocity whose noise is out of the ordinary.
    assert np.isclose(doubt, COULOMB, rtol=0.02)[rests].mean() > 0.999
    moves = fastest > 0.1
    assert (doubt[moves] / np.broadcast_to(COULOMB, moves.shape)[moves]).max() < 0.01


def test_law_holds_by_what_it_jumps_by():
    motion = JointMotion(np.zeros((5, 1)), load=np.full((5, 1), 40.0), time_step=1e-3)

    def holds(effect: type[Effect], linear: list[float], nonlinear: list[float]) -> np.ndarray:
        columns = (np.array(values, dtype=float).reshape(-1, 1) for values in (linear, nonlinear))
        return ResolvedJointTorque(effect, ("joint",), *columns).held_at_rest(motion)

    assert holds(CoulombFriction, [7.0], [0.01]) == pytest.approx(7.0, rel=0.01)
    assert holds(PreslidingHysteresis, [7.0], [0.005]) == pytest.approx(7.0, rel=0.06)
    # gamma1 of the hump is gone where gamma3 has levelled off as well.
    assert holds(StribeckFriction, [0.0, 7.0, 3.0], [100, 10, 50]) == pytest.approx(7.0, rel=0.01)
    assert holds(StribeckFriction, [2.0, 7.0, 3.0], [1e4, 1e-3, 50]) == pytest.approx(9, rel=0.01)
    assert holds(library()["LoadDependentFriction"], [0.1], [0.01]) == pytest.approx(4, rel=0.01)
    assert not holds(ViscousFriction, [7.0], []).any()
    assert not holds(DirectionalFriction, [7.0], [0.01]).any()
