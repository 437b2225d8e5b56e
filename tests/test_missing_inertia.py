"""Rotors behind gears that a model leaves out, or has too large: their torque is no friction."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario
from rig import coverage, estimated, rms
from scipy.linalg import block_diag

from fbse_drake import Log
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.missing_inertia import (
    full_inertia,
    is_read,
    make_inertia_possible,
    put_acceleration,
)
from fbse_drake.estimators.records import record
from fbse_drake.estimators.whole_body import WholeBody
from fbse_drake.report.metrics import friction_error

Run = Callable[..., Log]
# Both legs have swung by then.
WALK = ("paper_walk_fbse", "duration=2.8")
LEGS = ("hip_roll", "hip_pitch", "knee_pitch", "ankle_pitch")


def columns(log: Log) -> list[int]:
    return [k for k, joint in enumerate(log.joints) if joint.endswith(LEGS)]


@pytest.mark.parametrize("inertia", [0.05, 0.1])
def test_rotors_that_the_model_lacks_are_found_and_their_torque_is_no_friction(
    run: Run, inertia: float
):
    """Without it the torque that accelerates them, half of the friction and more, is taken for
    friction."""
    log = run(*WALK, f"robot.effects.rotors=!ReflectedInertia {{inertia: {{all: {inertia}}}}}")
    of_legs, late = columns(log), log.time >= 1.2
    found = log["estimate/joint/missing_inertia"][-1, of_legs]
    np.testing.assert_allclose(found, inertia, atol=0.006)
    assert np.all(log["estimate/joint/missing_inertia_std"][-1, of_legs] < 0.1 * inertia)
    believing = Fbse(friction=WholeBody(inertia_uncertainty=0.0))
    other = estimated(log, scenario(*WALK), believing)
    assert not other["estimate/joint/missing_inertia"].any()
    error, without = (rms(friction_error(one)[late][:, of_legs]) for one in (log, other))
    assert error < 0.1 * rms(log["truth/joint/friction_torque"][late][:, of_legs])
    assert error < 0.2 * without
    assert coverage(log) > 0.98


def test_rotors_that_the_robot_lacks_are_found_too(run: Run):
    """The model's own are taken back; without any, there is nothing to take."""
    log, walk = run(*WALK), scenario(*WALK)
    of_legs = columns(log)
    for believed in (0.0, 0.05):
        description = replace(walk.robot, rotor_inertia={"all": believed})
        other = estimated(log, replace(walk, robot=description, model=None), walk.estimator)
        found = other["estimate/joint/missing_inertia"]
        assert found.min() >= -believed - 1e-12
        np.testing.assert_allclose(found[-1, of_legs], -believed, atol=0.005)
        late = other.time >= 1.2
        error = rms(friction_error(other)[late][:, of_legs])
        assert error < 0.1 * rms(log["truth/joint/friction_torque"][late][:, of_legs])


@pytest.mark.parametrize("cut", [20, 300])
def test_rotors_are_found_without_the_first_jerk_of_the_walk(run: Run, cut: int):
    """Of light feet the model foresees far more motion than there is, which seems noise of the
    encoders, beyond which nothing accelerates."""
    effect = "robot.effects.rotors=!ReflectedInertia {inertia: {all: 0.05}}"
    steps = ("reference.single_support=0.5", "reference.double_support=0.3")
    walk = ("paper_walk_fbse", "duration=2.8", *steps)
    log = run(*walk, effect).part(slice(cut, None))
    result = estimated(log, scenario(*walk), scenario(*walk).estimator)
    late = result.time >= 2.0
    error = friction_error(result)[late]
    std = result["estimate/joint/missing_inertia_std"][-1]
    missing = result["estimate/joint/missing_inertia"][-1] - 0.05
    assert np.all(np.abs(missing) < 3 * std + 0.01)
    assert rms(error) < 0.05


def test_noise_of_a_velocity_is_no_acceleration():
    """Only what is beyond three standard deviations of the change counts."""
    n, sigma, T = 2, 5e-4, 1e-3
    known = record(variance=np.full(3 + n, sigma**2))
    noise = {name: np.ones(3 + n) for name in ("noise", "bend_noise")}
    x = record(velocity=np.zeros(3 + n), **noise, regressor=np.ones((n, 3)))
    tick = record(velocity=np.sqrt(2.0) * sigma * np.array([2.9, -3.1]), duration=T)
    put_acceleration(x[()], tick[()], known[()])
    np.testing.assert_allclose(x["regressor"][:, -1], [0.0, tick["velocity"][1] / T])
    np.testing.assert_array_equal(x["regressor"][:, :-1], 1.0)
    # Noise that only a model sees is the model's error, if it is far beyond that of the readings.
    for noisier, accelerates in ((24.0, False), (26.0, True)):
        x["noise"] = noisier
        put_acceleration(x[()], tick[()], known[()])
        assert (x["regressor"][1, -1] != 0.0) == accelerates


def test_an_acceleration_that_only_noisy_forces_foresee_is_not_read():
    """The reading follows it at least by half, and to the same side."""
    T, sign = 1e-3, np.array([1.0, -1.0])
    x = record(reading=np.zeros(5), regressor=4.0 * np.outer(sign, [0.0, 1.0]))
    last = record(reading=np.zeros(5))
    for share, reads in ((1.1, True), (0.6, True), (0.4, False), (0.0, False), (-1.1, False)):
        x["reading"][3:] = share * sign * 4.0 * T
        assert [is_read(x[()], last[()], joint, T) for joint in range(2)] == [reads, reads]
    # Nothing accelerates, and nothing has to be read.
    x["regressor"][:] = 0.0
    assert is_read(x[()], last[()], 0, T)


@pytest.mark.parametrize("is_doubt", [False, True])
def test_a_model_lacks_no_less_than_minus_its_own_rotors_and_the_law_beside_it_knows(
    is_doubt: bool,
):
    """What is most likely among what can be: equality-constrained least squares, by its KKT
    conditions. Within the doubt of the inertia, the law stays."""
    root = np.random.default_rng(1).standard_normal((2, 2, 2))
    of_joint = root @ root.transpose(0, 2, 1)
    of_joint *= (0.2 / (2.0 if not is_doubt else 0.5)) ** 2 / of_joint[0, 1, 1]
    x = record(weights=np.array([[1.0, -0.3], [2.0, 0.4]]), covariance=block_diag(*of_joint))
    known = record(rotor_inertia=np.array([0.1, 0.0]))
    conditions = np.eye(3)
    conditions[:2, :2], conditions[2, 2] = np.linalg.inv(of_joint[0]), 0.0
    conditions[1, 2] = conditions[2, 1] = 1.0
    right = [*(conditions[:2, :2] @ [1.0, -0.3]), -0.1]
    make_inertia_possible(x[()], known[()])
    expected = [1.0, -0.1] if is_doubt else np.linalg.solve(conditions, right)[:2]
    np.testing.assert_allclose(x["weights"][0], expected)
    np.testing.assert_array_equal(x["weights"][1], [2.0, 0.4])
    np.testing.assert_allclose(x["weights"][0, 1], -0.1)
    inertia = full_inertia(x[()], np.eye(5))
    np.testing.assert_allclose(inertia, np.diag([1.0, 1.0, 1.0, 0.9, 1.4]))
