"""Noise that is in the residual and in a regressor alike: that of a measured torque, and that of
the accelerations by a coarse encoder."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig
from recorded_arm import ARM, Course, Machine
from scipy.ndimage import uniform_filter1d

from benchmarks.recorded.course import inverse_dynamics
from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.explanation import Explanation
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.regression import Regression, WhitenedResidual
from fbse_drake.discrepancy.residual.residual import rms
from fbse_drake.effects.actuation import TorqueBias, TorqueDelay, TorqueGain, TorqueLag
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.inertia import ReflectedInertia
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.log import Log
from fbse_drake.scenario import RecordingConfig, RobotConfig, Scenario, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.simulation import simulate
from fbse_drake.walking.reference import JointSines

# As large as the torque's own deviation, which is what a current sensor gives of a light
# joint [Nm].
NOISE = 0.4
_RUNS = 5
HIDDEN = {
    "gain": (TorqueGain, 0.03),
    "lag": (TorqueLag, 0.006),
    "delay": (TorqueDelay, 0.006),
}


@cache
def run(hidden: str) -> tuple[Scenario, Log]:
    """A double pendulum with something hidden in its elbow, and what is believed of it."""
    effect, value = HIDDEN[hidden]
    (parameter,) = effect.parameters
    body = RobotConfig(
        "double_pendulum", effects={"hidden": effect(**{parameter: {"elbow": value}})}
    )
    scenario = Scenario(
        duration=5.0,
        robot=body,
        plant=MultibodyPlantConfig(
            time_step=0.002, contact_model="point", discrete_contact_approximation="lagged"
        ),
        reference=JointSines(
            amplitude={"shoulder": 0.8, "elbow": 1.0},
            frequency={"shoulder": 0.6, "elbow": 1.3},
            ramp=0.5,
        ),
        control=PositionLoopConfig(kp={"all": 20.0}, kd={"all": 0.5}),
        sensors=SensorsConfig(encoders=EncoderConfig(velocity_noise=2e-4)),
    )
    believed = replace(
        scenario,
        model=RobotConfig("double_pendulum"),
        recording=RecordingConfig(torque_noise={"all": NOISE}),
    )
    return believed, simulate(scenario).log


def noisy(hidden: str, seed: int) -> Predictor:
    scenario, log = run(hidden)
    torque = log["joint/torque_command"]
    torque = torque + NOISE * np.random.default_rng(seed).standard_normal(torque.shape)
    return Predictor(
        scenario, replace(log, channels=log.channels | {"joint/torque_command": torque})
    )


def fitted(
    predictor: Predictor, effect: type[JointTorqueEffect], start: Sequence[float]
) -> Explanation:
    """The effect alone in the elbow, linearised again where it was found."""
    fits, nonlinear = Fits(Dictionary(predictor, [effect])), np.array(start)
    nothing = fits.remainder(fits.explain([]))
    for _ in range(3):
        candidate = fits.candidate(effect, ("elbow",), nonlinear, nothing)
        explanation = fits.explain([candidate])
        values, _ = explanation.values(candidate)
        nonlinear = np.array([values[name] for name in candidate.nonlinear_names])
    return explanation


@pytest.mark.parametrize("hidden", HIDDEN)
def test_noise_of_the_torque_biases_no_value(hidden: str) -> None:
    effect, value = HIDDEN[hidden]
    start = () if effect is TorqueGain else (value,)
    found, inside = [], 0
    for seed in range(_RUNS):
        explanation = fitted(noisy(hidden, seed), effect, start)
        (estimates, intervals) = explanation.values(explanation.candidates[0])
        (name,) = effect.parameters
        found.append(estimates[name])
        inside += intervals[name][0] < value < intervals[name][1]
    # Within three standard deviations of their mean.
    assert abs(np.mean(found) - value) < 3 * np.std(found) / np.sqrt(_RUNS)
    assert inside >= _RUNS - 1


def test_noise_speaks_for_no_lag_where_a_delay_is() -> None:
    """A lag that smoothes the noise away would win against the delay by hundreds."""
    for seed in range(2):
        predictor = noisy("delay", seed)
        lag, delay = (
            fitted(predictor, effect, (0.006,)).deviance for effect in (TorqueLag, TorqueDelay)
        )
        assert abs(lag - delay) < 10


@pytest.mark.parametrize("hidden", ["lag", "delay"])
def test_lag_and_delay_are_confusable_where_noise_hides_the_difference(hidden: str) -> None:
    tried: list[type[Effect]] = [TorqueLag, TorqueDelay, TorqueGain, TorqueBias]
    (finding,) = diagnose(noisy(hidden, 1), tried).chosen
    assert finding.targets == ("elbow",)
    assert {finding.effect, *finding.confusable_with} >= {"TorqueLag", "TorqueDelay"}


def test_friction_that_steps_is_no_elasticity() -> None:
    """Torques that step with friction look like a twist that steps, and their noise is in both."""
    for seed in range(4):
        course = ARM.course(seed)
        friction = 0.2 * course.torque.std(axis=0) * np.tanh(course.velocity / 0.01)
        chosen = diagnose(ARM.predictor(ARM.log(course, course.torque + friction, seed))).chosen
        assert {finding.effect for finding in chosen} == {"CoulombFriction"}
        assert {joint for finding in chosen for joint in finding.targets} == set(ARM.joints)


def by_angles(machine: Machine, course: Course, bits: int, torque: np.ndarray, seed: int) -> Log:
    """A log of a course without velocities, of encoders of so many bits."""
    log, count = machine.log(course, torque, seed), 2 * np.pi / 2**bits
    channels = {name: log[name] for name in log.channels if name != "joint/velocity"}
    channels["joint/position"] = count * np.round(course.position / count)
    return replace(log, channels=channels)


@pytest.mark.parametrize("bits", [12, 14])
def test_noise_of_a_coarse_encoder_biases_no_inertia(bits: int) -> None:
    """Accelerations by rounded angles are nearly all noise, which the inertia of the model brings
    into the residual: an inertia that is missing is then found too small, or negative."""
    more, machine = np.array([0.2, 0.2, 0.1, 0.05, 0.05, 0.03]), replace(ARM, duration=20.0)
    by_signature, by_rough = [], []
    for seed in range(3):
        course = machine.course(seed, tuple(np.array(ARM.rotor_inertia) + more))
        predictor = machine.predictor(by_angles(machine, course, bits, course.torque, seed))
        white = WhitenedResidual(predictor.residual)
        rough = predictor.motion.blocks.joint_acceleration
        for place, joint in enumerate(machine.joints):
            signature = predictor.signature(ReflectedInertia, joint, np.zeros(0))
            own = replace(signature, rows=np.array([place]), values=-rough[:, place, None, None])
            for found, columns in ((by_signature, signature), (by_rough, own)):
                fit = Regression(white).fit([white.whiten_signature(columns)])
                found.append((fit.parameters[0] / more[place], fit.deviation[0] / more[place]))
    values, deviations = np.array(by_signature).T
    assert np.abs((values - 1.0) / deviations).max() < 4.0
    weight = deviations**-2 / (deviations**-2).sum()
    assert weight @ values == pytest.approx(1.0, abs=0.01)
    assert np.median(np.array(by_rough)[:, 0]) < 0.95


def test_the_square_of_a_velocitys_noise_is_no_torque() -> None:
    """Velocities by rounded angles are off by half a rad/s, whose square turns links outwards: the
    inverse dynamics of such velocities asks for torques that no drive gives."""
    machine = replace(ARM, period=0.001, duration=10.0)
    course = machine.course(2)
    motion = machine.predictor(by_angles(machine, course, 12, course.torque, 0)).motion
    q, v, a = (
        0.5 * (values[1:] + values[:-1])[2:-2]
        for values in (course.position, course.velocity, course.acceleration)
    )
    rough = 0.5 * (motion.signals.joint_velocity[1:] + motion.signals.joint_velocity[:-1])[2:-2]
    robot = machine.robot(machine.by_joint(machine.rotor_inertia))
    needed = inverse_dynamics(robot, q, v, a)

    def feigned(velocity: np.ndarray) -> np.ndarray:
        return np.abs((inverse_dynamics(robot, q, velocity, a) - needed).mean(axis=0))

    turning = feigned(rough) > 0.02
    assert turning.sum() >= 2
    by_steps = feigned(motion.steps.joint_velocity[2:-2])
    assert (by_steps < 0.1 * feigned(rough))[turning].all()


@pytest.mark.parametrize("bits", [11, 12])
def test_what_is_small_beside_the_noise_of_accelerations_is_no_noise(bits: int) -> None:
    """That noise is fast: a gain is many times as large at the speed of the motion, but passes for
    white noise of the torque in tests of what is left from average to average."""
    quiet = tuple(0.1 * np.array(ARM.torque_noise))
    machine = replace(ARM, duration=20.0, torque_noise=quiet)
    course = machine.course(1)
    torque = course.torque.copy()
    torque[:, 2] *= 1.08
    encoders = EncoderConfig(resolution=2 * np.pi / 2**bits)
    scenario = replace(machine.scenario, sensors=SensorsConfig(encoders=encoders))
    tried = ("TorqueGain", "TorqueBias", "JointSpring", "ViscousFriction", "CoulombFriction")
    predictor = Predictor(scenario, by_angles(machine, course, bits, torque, 1))
    (found,) = diagnose(predictor, [library()[name] for name in tried]).chosen
    assert (found.effect, found.targets) == ("TorqueGain", ("axis_3",))
    assert found.parameters["shortfall"].value == pytest.approx(1.0 - 1.0 / 1.08, abs=0.005)


def test_an_effect_is_rewarded_for_no_torque_that_it_adds() -> None:
    """A gain takes a share of the torque with its error; the torque's noise is not in its column,
    and what a joint is said to get beside makes nothing smaller."""
    fits = Fits(Dictionary(ARM.predictor(ARM.log(ARM.course())), [TorqueGain]))
    nothing = fits.remainder(fits.explain([]))
    gain = fits.candidate(TorqueGain, ("axis_2",), np.zeros(0), nothing)
    taking, giving = (fits.torque_factor([gain], np.array([share])) for share in (0.5, -0.5))
    row = ARM.joints.index("axis_2")
    assert taking[row] == pytest.approx(4.0, rel=0.01)
    np.testing.assert_array_equal(np.delete(taking, row), 1.0)
    np.testing.assert_array_equal(giving, 1.0)


def test_a_gain_pays_for_no_noise_that_its_regressor_has_not() -> None:
    """A wrist's torque is nearly all inertia and friction: as if the error of the torque grew with
    the gain, a rotor that is as large explained more, with confidence."""
    course = ARM.course()
    torque = course.torque + 0.6 * course.velocity
    torque[:, 3] /= 1.0 - 0.1
    (found,) = (
        finding
        for finding in diagnose(ARM.predictor(ARM.log(course, torque))).chosen
        if finding.effect != "ViscousFriction"
    )
    assert found.targets == ("axis_4",)
    assert "TorqueGain" in {found.effect, *found.confusable_with}


@pytest.mark.parametrize(("bits", "worst"), [(12, 1.5), (14, 0.5), (20, 0.1)])
def test_the_load_of_a_joint_has_little_of_the_noise_of_the_residual(
    bits: int, worst: float
) -> None:
    """What the links get is the command less what the residual shows, which by a coarse encoder is
    many times the friction that is in it: that noise would be in the load."""
    machine = replace(ARM, period=2e-3, duration=6.0, torque_noise=(0.01,) * 6)
    course, step = machine.course(), 2 * np.pi / 2**bits
    friction = np.array([20.0, 20.0, 10.0, 2.0, 2.0, 1.0]) * np.tanh(course.velocity / 0.05)
    log = machine.log(course, course.torque + friction)
    channels = {name: log[name] for name in ("time", "joint/torque_command")}
    channels["joint/position"] = step * np.round(log["joint/position"] / step)
    scenario = replace(machine.scenario, sensors=SensorsConfig())
    load = Predictor(scenario, replace(log, channels=channels)).joint_motion.load
    known = np.ones(load.shape, dtype=bool)
    assert np.all(rms(load - course.torque, known) < worst * rms(friction, known))


def test_where_a_joint_turns_its_load_is_not_off_by_its_friction() -> None:
    """Coulomb friction jumps there. Smoothed over the jump it would be in the load, by half of it
    on either side of the turn."""
    machine = replace(ARM, period=2e-3, duration=6.0, torque_noise=(0.01,) * 6)
    course, step = machine.course(), 2 * np.pi / 2**20
    size = np.array([20.0, 20.0, 10.0, 2.0, 2.0, 1.0])
    log = machine.log(course, course.torque + size * np.tanh(course.velocity / 0.01))
    channels = {name: log[name] for name in ("time", "joint/torque_command")}
    channels["joint/position"] = step * np.round(log["joint/position"] / step)
    scenario = replace(machine.scenario, sensors=SensorsConfig())
    predictor = Predictor(scenario, replace(log, channels=channels))
    # Law for law what matters is the load times how much of the friction acts.
    acts = np.abs(np.tanh(course.velocity / 0.01))
    error = acts * (predictor.joint_motion.load - course.torque) / size
    sign = np.sign(course.velocity)
    turned = np.diff(sign, axis=0, prepend=sign[:1]) != 0
    near = uniform_filter1d(turned.astype(float), 50, axis=0) > 0
    assert near.any(axis=0).all()
    assert np.all(rms(error, near) < 0.2)
