"""What recorded velocities are worth: when they are so, and by how much they err
(fbse_drake/discrepancy/residual/recorded_velocity.py).

Truth: sines, whose values at any time are known; inverse dynamics of an arm.
"""

from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import ARM, Course, Machine

from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.discrepancy.residual.recorded_velocity import (
    Lateness,
    are_differences,
    velocity_error,
)
from fbse_drake.effects.effect import library
from fbse_drake.scenario import SensorsConfig

SEED = 3
WHOLE = [slice(0, 5001)]
TRANSITION = 0.01
COULOMB = 20.0 * np.array(ARM.torque_noise)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return replace(ARM, duration=20.0)


@pytest.fixture(scope="module")
def course(machine: Machine) -> Course:
    return machine.course(SEED)


def in_counts(position: np.ndarray, bits: int) -> np.ndarray:
    """As an encoder with so many bits by turn reads it."""
    count = 2 * np.pi / 2**bits
    return count * np.round(position / count)


def changed(log: Log, **channels: np.ndarray) -> Log:
    given = {f"joint/{name}": values for name, values in channels.items()}
    return replace(log, channels=log.channels | given)


@pytest.mark.parametrize("late", [-0.003, 0.0, 0.0004, 0.003, 0.0075])
def test_late_velocities_are_found_late(machine: Machine, course: Course, late: float) -> None:
    """By less than a sample or by more, or before their time; of angles of 14 bits."""
    noise = 2e-3 * np.random.default_rng(0).standard_normal(course.velocity.shape)
    velocity = machine.motion(SEED, course.time - late)[1] + noise
    found = Lateness.of(in_counts(course.position, 14), velocity, course.period, WHOLE)
    if late == 0.0:
        assert not found.seconds.any()
        assert (found.deviation > 0.0).all()
        return
    sure = np.abs(late) > 8.0 * found.deviation
    assert sure.any()
    error = found.seconds[sure] - late
    assert (np.abs(error) < 4.0 * found.deviation[sure] + 0.01 * abs(late)).all()


def test_the_doubt_of_the_lateness_is_true(machine: Machine, course: Course) -> None:
    """Errors over their standard deviations, of many noises: their mean square is one."""
    late, ratios = 0.006, []
    exact = machine.motion(SEED, course.time - late)[1]
    for seed in range(20):
        noise = 0.02 * np.random.default_rng(seed).standard_normal(exact.shape)
        found = Lateness.of(course.position, exact + noise, course.period, WHOLE)
        ratios.append((found.seconds - late) / found.deviation)
    assert 0.6 < np.mean(np.square(ratios)) < 1.8


def test_few_windows_call_nothing_late_by_chance(course: Course) -> None:
    """Of four windows, whose spread is not well known; four deviations would be passed in one of
    thirty joints."""
    stretch, called, passed = [slice(0, 2000)], 0, 0
    for seed in range(150):
        noise = 0.05 * np.random.default_rng(seed).standard_normal((2000, 6))
        velocity = course.velocity[:2000] + noise
        read = Lateness.of(course.position[:2000], velocity, course.period, stretch)
        called += bool(read.seconds.any())
        passed += np.count_nonzero(read.deviation)
    assert passed == 900
    assert called <= 2


def test_a_joint_that_hardly_tells_is_as_late_as_the_others(
    machine: Machine, course: Course
) -> None:
    """All come from one recorder; but a joint that is in time for sure is left as it is."""
    late, size = 0.004, 0.02 * np.ones(6)
    size[1] = 10.0
    velocity = machine.motion(SEED, course.time - late)[1]
    velocity[:, 4] = course.velocity[:, 4]
    velocity += size * np.random.default_rng(3).standard_normal(velocity.shape)
    found = Lateness.of(course.position, velocity, course.period, WHOLE)
    assert found.deviation[1] > 0.3 * late
    others = [0, 1, 2, 3, 5]
    assert found.seconds[others] == pytest.approx(late, rel=0.05)
    assert found.seconds[4] == 0.0


def test_velocities_are_read_when_they_were(machine: Machine, course: Course) -> None:
    late = 0.0075
    velocity = machine.motion(SEED, course.time - late)[1]
    known = np.ones(len(course.time), dtype=bool)
    known[2000:2010] = False
    found = Lateness(np.full(6, late), np.zeros(6))
    read, still = found.in_time(velocity, known, course.period)
    assert np.abs(read - course.velocity)[still].max() < 2e-3 * np.abs(course.velocity).max()
    # What comes from beyond the end or out of a gap is not known; nothing else is lost.
    lost = known & ~still
    assert lost.sum() == 4
    assert lost[-2:].all()


def test_differences_are_told_from_what_was_measured(course: Course) -> None:
    angle = in_counts(course.position, 14)
    backward = np.diff(angle, axis=0, prepend=angle[:1]) / course.period
    central = np.gradient(angle, course.period, axis=0)
    assert are_differences(course.time, angle, backward)
    assert are_differences(course.time, angle, central)
    assert not are_differences(course.time, angle, course.velocity)
    smooth = 0.5 * (backward[1:] + backward[:-1])
    assert not are_differences(course.time[1:], angle[1:], 0.5 * (smooth + course.velocity[1:]))


def test_the_error_of_a_velocity(course: Course) -> None:
    """White noise is averaged; that of an exact channel is next to nothing, however fast it is."""
    length, size = 5, 0.05
    noise = size * np.random.default_rng(1).standard_normal(course.velocity.shape)
    given = (course.period, WHOLE, length)
    exact = velocity_error(course.position, course.velocity, *given)
    noisy = velocity_error(course.position, course.velocity + noise, *given)
    assert (exact < 1e-3 * np.abs(course.velocity).max(axis=0)).all()
    np.testing.assert_allclose(noisy, size / np.sqrt(length), rtol=0.1)


def friction(course: Course) -> np.ndarray:
    return COULOMB * np.tanh(course.velocity / TRANSITION)


def coarse(machine: Machine, course: Course, torque: np.ndarray) -> tuple[Scenario, Log]:
    """Velocities that a logger had by differences of angles of 12 bits, which nobody tells."""
    angle = in_counts(course.position, 12)
    velocity = np.diff(angle, axis=0, prepend=angle[:1]) / course.period
    log = changed(machine.log(course, torque, SEED), position=angle, velocity=velocity)
    return replace(machine.scenario, sensors=SensorsConfig()), log


def test_laws_are_doubted_where_a_joint_turns(machine: Machine, course: Course) -> None:
    """By as much as the torque of a law differs whose velocity is wrong by that error."""
    # Far beyond the noise of the accelerations.
    size = 30.0 * COULOMB
    scenario, log = coarse(machine, course, course.torque + 30.0 * friction(course))
    predictor = Predictor(scenario, log)
    law = library()["CoulombFriction"](
        coulomb=machine.by_joint(tuple(size)), transition={"all": TRANSITION}
    ).resolve(predictor.robot.description)
    doubt, motion = predictor.law_variance([law]), predictor.motion
    error = velocity_error(
        motion.signals.joint_position,
        predictor.joint_motion.velocity,
        motion.period,
        motion.stretches,
        motion.length,
    )
    random, drawn = np.random.default_rng(2), []
    blocks = len(doubt)
    velocity = predictor.joint_motion.velocity[: blocks * motion.length]
    for _ in range(50):
        wrong = (error * random.standard_normal((blocks, 6))).repeat(motion.length, axis=0)
        change = np.tanh((velocity + wrong) / TRANSITION) - np.tanh(velocity / TRANSITION)
        drawn.append(size * change.reshape(blocks, motion.length, 6).mean(axis=1))
    expected = np.mean(np.square(drawn), axis=(0, 1))
    # It is nothing beside the noise of the accelerations where it is not doubted.
    noise = motion.residual.variance[:, :6].mean(axis=0)
    doubted = doubt.any(axis=0)
    assert doubted.sum() >= 3
    np.testing.assert_allclose(doubt.mean(axis=0)[doubted], expected[doubted], rtol=0.4)
    assert (expected[~doubted] < 0.01 * noise[~doubted]).all()
    # Far from a turn the sign of a velocity is sure.
    slowest = np.abs(velocity).reshape(blocks, motion.length, 6).min(axis=1)
    fast = slowest > 10.0 * error + 10.0 * TRANSITION
    assert doubt[fast].max() < 1e-6 * doubt.max()


def found(scenario: Scenario, log: Log, effects: tuple[str, ...]) -> Diagnosis:
    return diagnose(Predictor(scenario, log), [library()[name] for name in effects])


def test_coarse_velocities_make_no_friction_that_is_not_there(
    machine: Machine, course: Course
) -> None:
    """What joints turn at is not known from such velocities: it is no static friction."""
    tried = ("CoulombFriction", "StribeckFriction", "DirectionalFriction", "PreslidingHysteresis")
    scenario, log = coarse(machine, course, course.torque + friction(course))
    diagnosis = found(scenario, log, tried)
    assert {f.effect for f in diagnosis.chosen} == {"CoulombFriction"}
    for finding in diagnosis.chosen:
        size = dict(zip(machine.joints, COULOMB, strict=True))[finding.targets[0]]
        assert finding.parameters["coulomb"].value == pytest.approx(size, rel=0.05)


@pytest.mark.parametrize("late", [0.0, 0.006])
def test_a_filtered_velocity_is_no_late_torque(
    machine: Machine, course: Course, late: float
) -> None:
    """Inertia seen by late accelerations looks like a drive that is early, or like damping."""
    velocity = machine.motion(SEED, course.time - late)[1]
    log = changed(machine.log(course, seed=SEED), velocity=velocity)
    tried = ("TorqueDelay", "TorqueLag", "TorqueReadingLag", "ViscousFriction")
    diagnosis = found(machine.scenario, log, tried)
    assert (diagnosis.verdict, diagnosis.chosen) == ("nothing_missing", [])
    findings = inspect(machine.predictor(log).motion).findings
    said = [f for f in findings if f.kind == "velocity_clock"]
    assert [f.size for f in said] == ([pytest.approx(late, rel=0.02)] if late else [])


def test_a_late_torque_beside_a_filtered_velocity_is_found(
    machine: Machine, course: Course
) -> None:
    velocity = machine.motion(SEED, course.time - 0.006)[1]
    delay = 0.008
    steps = round(delay / course.period)
    given = np.concatenate([course.torque[steps:], course.torque[-1:].repeat(steps, axis=0)])
    log = changed(machine.log(course, given, SEED), velocity=velocity)
    diagnosis = found(machine.scenario, log, ("TorqueDelay", "ViscousFriction"))
    assert {f.effect for f in diagnosis.chosen} == {"TorqueDelay"}
    for finding in diagnosis.chosen:
        assert finding.parameters["delay"].value == pytest.approx(delay, rel=0.05)


def test_what_has_no_central_difference_is_not_known(machine: Machine, course: Course) -> None:
    """The first and the last angle: differences of one side are half a sample off, and would be
    hundreds of times the noise."""
    exact = replace(machine, torque_noise=(1e-6,) * 6)
    log = exact.log(course)
    bare = replace(log, channels={k: v for k, v in log.channels.items() if k != "joint/velocity"})
    motion = exact.predictor(bare).motion
    known = motion.known[:, :6]
    left = np.abs(motion.residual.value[:, :6]) / np.abs(course.torque).max(axis=0)
    assert not known[0].any()
    assert known[1:-2].all()
    assert left[known].max() < 2e-3
    assert left[0].max() > 10.0 * left[known].max()
