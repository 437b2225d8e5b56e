"""What estimators make of effects that the model has: taken off readings, left out of laws."""

import dataclasses
from collections.abc import Mapping
from functools import lru_cache

import numpy as np
import pytest
from conftest import scenario
from rig import Replay, coverage, diagram, estimated, inputs_of

from fbse_drake import Log, Scenario, simulate
from fbse_drake.effects.actuation import TorqueDelay, TorqueGain, TorqueLag
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.friction import LoadDependentFriction
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, law_over_time
from fbse_drake.effects.sensor import (
    AccelerometerBias,
    EncoderOffset,
    FootForceBias,
    FootForceGain,
    FootForceLag,
    FootForceMisalignment,
    ImuMisalignment,
    SensorEffect,
    SensorSignals,
    TransmissionElasticity,
)
from fbse_drake.effects.sensor_systems import SensorCorrections, SensorEffects
from fbse_drake.effects.transmission import PreslidingHysteresis
from fbse_drake.estimation import estimate
from fbse_drake.estimators.believed_torque import BelievedTorque
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import RobotConfig

TICK = 1e-3
# Each would by itself spoil the friction.
IN_SENSORS: dict[str, Effect] = {
    "gain": FootForceGain({"left": -0.05, "right": 0.03}),
    "lag": FootForceLag({"left": 0.004, "right": 0.002}),
    "askew": FootForceMisalignment(x={"left": 0.03}),
    "imu": ImuMisalignment(0.02, -0.03, 0.01),
    "offset": EncoderOffset({"left_knee_pitch": 0.005}),
    "elastic": TransmissionElasticity({"all": 2e-5}),
}
IN_JOINTS: dict[str, Effect] = {
    "gain": TorqueGain({"all": 0.05}),
    "lag": TorqueLag({"all": 2e-4}),
    "load": LoadDependentFriction({"all": 0.03}),
    "presliding": PreslidingHysteresis({"all": 1.0}),
}


def with_effects(base: Scenario, effects: Mapping[str, Effect], *places: str) -> Scenario:
    """The scenario with effects in its robot, its model, or both."""
    for place in places:
        config: RobotConfig = getattr(base, place) or base.believed
        config = dataclasses.replace(config, effects={**config.effects, **effects})
        base = dataclasses.replace(base, **{place: config})
    return base


WALK = scenario("paper_walk_fbse", "duration=2.2")


@lru_cache(maxsize=2)
def walked(which: str) -> Log:
    """A walk with effects that are known, and allowed for as it walks."""
    effects = {"sensors": IN_SENSORS, "joints": IN_JOINTS}[which]
    return simulate(with_effects(WALK, effects, "robot", "model")).log


def error(log: Log, start: float = 1.0) -> float:
    """Root mean square of the friction's error over that of the friction, from a time on [s], mean
    over the joints but the hip yaws."""
    truth = log["truth/joint/friction_torque"][:-1]
    found = log["estimate/joint/friction_torque"][1:]
    after = log.time[1:] > start
    moving = [not joint.endswith("hip_yaw") for joint in log.joints]
    squares = ((found - truth)[after] ** 2).mean(axis=0) / (truth[after] ** 2).mean(axis=0)
    return float(np.sqrt(squares[moving]).mean())


@pytest.mark.parametrize("which", ["sensors", "joints"])
def test_what_the_model_has_does_not_spoil_the_friction(which: str):
    known = walked(which)
    unknown = estimate(WALK, known).log
    assert error(unknown) > 5 * error(known)
    assert error(known) < 0.08
    assert coverage(known) > 0.98


def test_what_one_believes_counts():
    """A decoy: of a log that has no such thing the estimate is spoilt, and says so."""
    honest = simulate(WALK).log
    fooled = estimate(with_effects(WALK, {"gain": IN_SENSORS["gain"]}, "model"), honest).log
    assert error(fooled) > 3 * error(honest)
    assert coverage(fooled) > 0.95


@pytest.mark.parametrize("which", ["sensors", "joints"])
def test_replay_is_what_ran_live(which: str):
    known, effects = walked(which), {"sensors": IN_SENSORS, "joints": IN_JOINTS}[which]
    again = estimate(with_effects(WALK, effects, "model"), known).log
    for name in (name for name in known if name.startswith("estimate/")):
        np.testing.assert_array_equal(again[name], known[name], err_msg=name)


def test_every_estimator_gets_readings_that_are_corrected():
    """A momentum observer asks for other signals, and gets the same corrections."""
    known, observer = walked("sensors"), DisturbanceObserver(10.0)
    model = with_effects(WALK, IN_SENSORS, "model")
    corrected = error(estimated(known, model, observer))
    assert corrected < 0.7 * error(estimated(known, WALK, observer))


def test_a_log_without_torques_is_corrected_too():
    known = walked("sensors")
    channels = {n: c for n, c in known.channels.items() if n != "joint/torque_command"}
    log = dataclasses.replace(known, channels=channels)
    effects = {n: e for n, e in IN_SENSORS.items() if n != "elastic"}

    def tilted(model: Scenario) -> float:
        """Root mean square of the error of base orientation [1]."""
        found = estimate(model, log).log["estimate/base/orientation"]
        return float(np.linalg.norm(found - known["truth/base/orientation"], axis=1).mean())

    assert tilted(with_effects(WALK, effects, "model")) < 0.3 * tilted(WALK)


# Sensors that are put in wrong by up to a tenth of a turn, or read half as much again.
GROSSLY: dict[str, Effect] = IN_SENSORS | {
    "gain": FootForceGain({"left": -0.4, "right": 0.5}),
    "askew": FootForceMisalignment(x={"left": 0.4}, y={"left": -0.3}),
    "imu": ImuMisalignment(0.2, -0.6, 0.1),
}


@pytest.mark.parametrize("effects_by_name", [IN_SENSORS, GROSSLY], ids=["slightly", "grossly"])
def test_corrections_undo_effects_tick_by_tick(effects_by_name: Mapping[str, Effect]) -> None:
    """Whatever the sensors read, also with what effects remember."""
    robot, _ = make_robot("biped")
    effects = [e.resolve(robot.description) for e in effects_by_name.values()]
    there, back = (kind(effects, robot, TICK) for kind in (SensorEffects, SensorCorrections))
    contexts = {system: system.CreateDefaultContext() for system in (there, back)}
    random, cuts = np.random.default_rng(1), np.cumsum(list(there.sizes.values()))[:-1]

    def passed(system: SensorEffects | SensorCorrections, signals: np.ndarray) -> np.ndarray:
        context = contexts[system]
        for name, values in zip(system.sizes, np.split(signals, cuts), strict=True):
            system.GetInputPort(name).FixValue(context, values)
        return system.get_output_port().Eval(context)

    sizes = np.concatenate([np.full(24, 0.5), np.full(6, 5.0), np.full(24, 200.0)])
    friction = np.zeros(12)
    for _ in range(30):
        true, command = sizes * random.normal(size=len(sizes)), 50.0 * random.normal(size=12)
        there.GetInputPort("friction").FixValue(contexts[there], friction)
        read = passed(there, true)
        assert np.abs(read - true).max() > 1.0
        np.testing.assert_allclose(passed(back, read), true, rtol=1e-12, atol=1e-9)
        # What is estimated of the friction is known a tick later.
        friction = 10.0 * random.normal(size=12)
        back.GetInputPort("friction").FixValue(contexts[back], friction)
        for system, context in contexts.items():
            system.GetInputPort("torque_command").FixValue(context, command)
            system.ExecuteForcedEvents(context)


class WithoutOpposite(FootForceGain):
    """An effect that does not say how it is undone, as one of a user's own."""

    @staticmethod
    def opposite(linear: np.ndarray) -> None:  # noqa: ARG004
        return None


@pytest.mark.parametrize("gain", [1e-12, 0.05, -0.4])
def test_what_has_no_opposite_is_undone_all_the_same(gain: float) -> None:
    """Also where a reading is missing."""
    robot, _ = make_robot("biped")
    values = WithoutOpposite({"left": gain}).resolve(robot.description)
    random, ticks = np.random.default_rng(2), 50
    joint, imu, force = (random.normal(size=(ticks, *size)) for size in ((12,), (3,), (8, 3)))
    joints = (joint, np.zeros((ticks, 0)), joint, joint)
    true = SensorSignals(joint, joint, imu, imu, 200.0 * force, *joints)
    memory = np.zeros((0, ticks, 1))
    read = WithoutOpposite.reading(true, memory, values, robot)
    read.pad_force[7] = np.nan
    found = WithoutOpposite.undone(read, memory, values, robot, TICK)
    assert found.specific_force is true.specific_force
    known = np.arange(ticks) != 7
    np.testing.assert_allclose(found.pad_force[known], true.pad_force[known], atol=1e-6)
    assert np.isnan(found.pad_force[7]).all()


@pytest.mark.parametrize("first", [IN_SENSORS["askew"], IN_SENSORS["imu"]])
def test_what_came_last_into_the_readings_is_taken_off_first(first: SensorEffect):
    """A gain of one axis and a rotation do not commute."""
    robot, _ = make_robot("biped")
    biased = "FootForceBias" if isinstance(first, FootForceMisalignment) else "AccelerometerBias"
    second = {
        "FootForceBias": FootForceBias(z={"left": 20.0}),
        "AccelerometerBias": AccelerometerBias(z=3.0),
    }[biased]
    effects = [effect.resolve(robot.description) for effect in (first, second)]
    true = np.linspace(-1.0, 1.0, 54) * np.repeat([1.0, 10.0, 100.0], [24, 6, 24])

    def passed(kind: type[SensorEffects | SensorCorrections], values: np.ndarray) -> np.ndarray:
        system = kind(effects, robot, TICK)
        context = system.CreateDefaultContext()
        parts = np.split(values, np.cumsum(list(system.sizes.values()))[:-1])
        for name, part in zip(system.sizes, parts, strict=True):
            system.GetInputPort(name).FixValue(context, part)
        return system.get_output_port().Eval(context)

    read = passed(SensorEffects, true)
    np.testing.assert_allclose(passed(SensorCorrections, read), true, atol=1e-3)


def test_a_reading_that_is_no_number_spoils_its_ticks_alone():
    """What effects remember of it is forgotten with the next reading."""
    known, model = walked("sensors"), with_effects(WALK, IN_SENSORS, "model")
    inputs = inputs_of(known)
    inputs["measured_pad_force"][1200:1203] = np.nan
    inputs["torque_command"][1300] = np.nan
    replay = Replay(diagram(Fbse(), model))
    found = replay.run(known.time, inputs, "friction_estimate", "estimate/sensors/status")
    status = found["estimate/sensors/status"]
    assert status[1200:1203].any(axis=1).all()
    assert not status[1210:].any()
    friction = known["estimate/joint/friction_torque"]
    assert np.abs(found["friction_estimate"] - friction)[1600:].max() < 0.2


@pytest.mark.parametrize(
    "effect",
    [
        TorqueGain({"all": 0.1}),
        TorqueDelay({"all": 0.0034}),
        TorqueLag({"all": 0.004}),
        PreslidingHysteresis({"all": 2.0}),
    ],
)
def test_believed_torque_tick_by_tick_is_that_over_a_whole_log(effect: JointTorqueEffect):
    """From the second tick on: nobody knows what was commanded before the first."""
    robot, _ = make_robot("biped")
    resolved = effect.resolve(robot.description)
    time, n = np.arange(200)[:, None] * TICK, 12
    position = 0.3 * np.sin(20 * time + np.arange(n))
    velocity = 6.0 * np.cos(20 * time + np.arange(n))
    command = 30.0 * np.sin(31 * time + np.arange(n))
    # Step k goes from tick k to tick k + 1.
    steps = JointMotion(velocity[1:], position[:-1], command[:-1], time[:-1], TICK)
    expected = law_over_time([resolved], steps)
    believed = BelievedTorque([resolved], n, TICK)
    memory, found = believed.start, []
    for k in range(len(time)):
        before = command[k - 1] if k else np.zeros(n)
        tick = JointMotion(velocity[k], command=before, time=time[k] - TICK)
        found.append(believed.torque_and_slope(memory, tick)[0])
        memory = believed.remembered(memory, tick, position[k])
    np.testing.assert_allclose(found[1:], expected, atol=1e-9)
