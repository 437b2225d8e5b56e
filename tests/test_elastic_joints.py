"""Elastic transmissions behind the friction of motor and gear."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario
from recorded_arm import ARM

from benchmarks.recorded.course import Course
from fbse_drake import simulate
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import library
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.effects.sensor import SensorSignals, TransmissionElasticity
from fbse_drake.effects.sensor_systems import SensorCorrections, SensorEffects
from fbse_drake.effects.transmission import Backlash
from fbse_drake.estimators.believed_friction import BelievedFriction
from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.log import Log
from fbse_drake.robot.plant import make_robot

TICK = 1e-3
STIFFNESS = np.array([2e4, 2e4, 1e4, 3e3, 3e3, 2e3])
COULOMB = 30.0 * np.array(ARM.torque_noise)
VISCOUS = 0.4 * COULOMB


@pytest.mark.parametrize("time_constant", [1e-5, 5e-3, 0.3])
def test_a_spring_follows_a_rising_load_as_the_differential_equation_says(time_constant: float):
    """d = c slope (t - T + T exp(-t / T)) for a load slope t from rest, and its rate."""
    robot, _ = make_robot("biped")
    compliance, slope, joints = 1e-4, 30.0, len(robot.joint_names)
    time = np.arange(500) * TICK
    end = np.tile(slope * time[:, None], joints)
    begin = np.maximum(end - slope * TICK, 0.0)
    none, still = np.zeros((500, joints)), np.zeros((500, 3))
    signals = SensorSignals(
        none, none, still, still, np.zeros((500, 8, 3)), none, np.zeros((500, 0)), begin, end
    )
    spring = TransmissionElasticity({"all": compliance}, {"all": time_constant})
    read = spring.distorted(signals, spring.resolve(robot.description), robot, TICK)
    decay = np.exp(-time / time_constant)
    twist = compliance * slope * (time - time_constant * (1.0 - decay))
    np.testing.assert_allclose(read.joint_position[:, 3], twist, atol=1e-12)
    rate = compliance * slope * (1.0 - decay)
    np.testing.assert_allclose(read.joint_velocity[:, 3], rate, rtol=1e-6, atol=1e-9)


def test_a_rotor_on_its_spring_rings_as_the_differential_equation_says():
    """B d'' + D d' + K d = torque, from rest, before a link that is held; half the error at half
    the tick. What is known of it all is taken off again."""
    robot, _ = make_robot("biped", rotor_inertia={"all": 0.25})
    compliance, time_constant, torque, n = 1e-4, 2e-3, 20.0, len(robot.joint_names)
    spring = TransmissionElasticity({"all": compliance}, {"all": time_constant})
    effects, errors = [spring.resolve(robot.description)], []
    frequency = 1.0 / np.sqrt(compliance * 0.25)
    damping = 0.5 * time_constant * frequency
    fast = frequency * np.sqrt(1.0 - damping**2)
    for tick in (1e-4, 5e-5):
        there, back = (kind(effects, robot, tick) for kind in (SensorEffects, SensorCorrections))
        contexts = {system: system.CreateDefaultContext() for system in (there, back)}
        there.GetInputPort("true_joint_state").FixValue(contexts[there], np.zeros(2 * n))
        still, twist = np.zeros(2 * n), []
        for system, context in contexts.items():
            system.GetInputPort("imu").FixValue(context, np.zeros(6))
            system.GetInputPort("pad_force").FixValue(context, np.zeros(24))
            system.GetInputPort("torque_command").FixValue(context, np.full(n, torque))
        for _ in range(round(0.1 / tick)):
            read = still
            for system, context in contexts.items():
                system.GetInputPort("joint_state").FixValue(context, read)
                read = system.get_output_port().Eval(context)[: 2 * n].copy()
                if system is there:
                    twist.append(read[3])
            assert np.abs(read).max() < 1e-9
            for system, context in contexts.items():
                system.ExecuteForcedEvents(context)
        time = np.arange(len(twist)) * tick
        swing = np.cos(fast * time) + damping * frequency / fast * np.sin(fast * time)
        expected = compliance * torque * (1.0 - np.exp(-damping * frequency * time) * swing)
        errors.append(np.abs(np.array(twist) - expected).max() / (compliance * torque))
    assert errors[0] < 0.05
    assert errors[1] == pytest.approx(0.5 * errors[0], rel=0.15)


def elastic_arm(seed: int) -> Log:
    """An arm whose encoders sit on the motors, before springs that pass what friction leaves."""
    course = replace(ARM, duration=20.0).course(seed)
    friction = COULOMB * np.tanh(course.velocity / 0.01) + VISCOUS * course.velocity
    twist = course.torque / STIFFNESS
    rate = np.gradient(twist, course.period, axis=0)
    motors = Course(
        course.time,
        course.position + twist,
        course.velocity + rate,
        course.acceleration,
        course.torque,
    )
    return ARM.log(motors, course.torque + friction)


def test_elastic_joints_with_friction_on_the_motors_side_are_no_payload():
    """A spring that twists by the friction as well would be nowhere, and masses in its place."""
    names = ("BodyMass", "CoulombFriction", "Payload", "TransmissionElasticity", "ViscousFriction")
    found = diagnose(Predictor(ARM.scenario, elastic_arm(50)), [library()[n] for n in names])
    assert found.verdict == "effect_found"
    by_effect: dict[str, dict[str, float]] = {}
    for finding in found.chosen:
        value = next(iter(finding.parameters.values())).value
        by_effect.setdefault(finding.effect, {}).update(dict.fromkeys(finding.targets, value))
    assert set(by_effect) == {"CoulombFriction", "TransmissionElasticity", "ViscousFriction"}
    compliance = by_effect["TransmissionElasticity"]
    # Those of the wrist twist by less than shows.
    assert {"axis_1", "axis_2"} <= set(compliance) <= {"axis_1", "axis_2", "axis_3"}
    for joint, value in compliance.items():
        assert value * STIFFNESS[int(joint[-1]) - 1] == pytest.approx(1.0, rel=0.3)
    for effect, true in (("CoulombFriction", COULOMB), ("ViscousFriction", VISCOUS)):
        sizes = [by_effect[effect][f"axis_{k + 1}"] for k in range(6)]
        np.testing.assert_allclose(sizes, true, rtol=0.02)


def test_an_arm_without_springs_has_none():
    """The same motion; what its inverse dynamics need is the load, and nothing follows it."""
    course = replace(ARM, duration=20.0).course(50)
    friction = COULOMB * np.tanh(course.velocity / 0.01) + VISCOUS * course.velocity
    log = ARM.log(course, course.torque + friction)
    names = ("CoulombFriction", "TransmissionElasticity", "ViscousFriction")
    found = diagnose(Predictor(ARM.scenario, log), [library()[n] for n in names])
    assert {f.effect for f in found.chosen} == {"CoulombFriction", "ViscousFriction"}
    # Springs that are looked for and not found would show.
    smallest = found.effects["TransmissionElasticity"].smallest_detectable
    assert smallest["axis_2"] < 0.3 / STIFFNESS[1]


@pytest.mark.parametrize("is_learned", [False, True], ids=["by the model", "by a law"])
def test_friction_by_its_laws_is_what_a_simulation_loses(is_learned: bool):
    given = scenario("leg_swing_gantry", "duration=0.5", noise=False)
    log, (name, law) = simulate(given).log, *given.robot.effects.items()
    assert isinstance(law, JointTorqueEffect), name
    robot, _ = make_robot("biped", gantry_height=1.2)
    play = Backlash({"all": 1e-3}).resolve(robot.description)
    if is_learned:
        regressor = FrictionRegressor.of(law, robot)
        system = BelievedFriction([play], robot, TICK, regressor)
    else:
        system = BelievedFriction([law.resolve(robot.description), play], robot, TICK)
    context = system.CreateDefaultContext()
    if is_learned:
        system.GetInputPort("parameters").FixValue(context, regressor.initial.ravel())
    state = np.hstack([log["joint/position"], log["joint/velocity"]])
    found = []
    for k, command in enumerate(log["joint/torque_command"]):
        context.SetTime(k * TICK)
        system.GetInputPort("joint_state").FixValue(context, state[k])
        system.GetInputPort("torque_command").FixValue(context, command)
        found.append(system.get_output_port().Eval(context))
        system.ExecuteForcedEvents(context)
    # At first next to nothing moves.
    moves = slice(50, None)
    true, told = log["truth/joint/friction_torque"][:-1][moves], np.array(found)[1:][moves]
    if not is_learned:
        assert np.abs(told - true).max() < 0.02 * np.abs(true).max()
        return
    # Parameters are taken over slowly: half of them after ln 2 of a second.
    share = np.sum(told * true, axis=1) / np.sum(true * true, axis=1)
    np.testing.assert_allclose(share, 1.0 - np.exp(-log.time[1:][moves]), atol=0.01)
