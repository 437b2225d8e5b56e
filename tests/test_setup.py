"""Machines that are not set up as their model says: tilted a little, which is an effect, or mounted
on a wall, or with joints that count otherwise, which the hygiene says. Truth: gravity weighed body
by body, plans of tilted arms, and channels that are counted anew."""

import dataclasses
import re

import numpy as np
import pytest
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.spatial.transform import Rotation

from fbse_drake import InputError, load_scenario
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.refinement import added
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.evidence import HygieneFinding
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.geometry import BaseTilt
from fbse_drake.effects.inertia import Payload
from fbse_drake.effects.sensor import EncoderOffset
from fbse_drake.log import Log
from fbse_drake.robot.plant import gravity_on_slope, slope_of_gravity
from fbse_drake.scenario import RecordingConfig, RobotConfig, Scenario, build_robot

TILT = (0.04, -0.03)


def arm_that_moves(**effects: Effect) -> tuple[Scenario, Log]:
    """An arm with these effects as it was planned to move, with noise of its torques, and a
    scenario whose model has none."""
    scenario = load_scenario("bsc_arm", overrides=["duration=8", "log.period=0.01"])
    bare = dataclasses.replace(scenario.robot, effects={})
    real = dataclasses.replace(bare, effects=effects)
    log = planned_log(dataclasses.replace(scenario, robot=real, model=real))
    torque = log["joint/torque_command"]
    noisy = torque + 0.3 * np.random.default_rng(5).standard_normal(torque.shape)
    recording = RecordingConfig(rows="instantaneous", torque_noise={"all": 0.3})
    believed = dataclasses.replace(scenario, robot=bare, model=bare, recording=recording)
    return believed, Log(log.channels | {"joint/torque_command": noisy}, log.meta)


def test_on_a_tilted_mount_every_body_weighs_in_another_direction() -> None:
    """The torques that hold an arm at rest are those of its bodies' weights, each on its lever."""
    turned = Rotation.from_rotvec([*TILT, 0.0])
    for tilt, gravity in (((0.0, 0.0), [0, 0, -9.81]), (TILT, turned.inv().apply([0, 0, -9.81]))):
        arm = build_robot(RobotConfig("arm", effects={"mount": BaseTilt(*tilt)}))
        plant, context = arm.plant, arm.plant.CreateDefaultContext()
        arm.set_joint_positions(context, np.array([0.3, 0.5, -0.4, 0.2, 0.7, -0.1]))
        expected = np.zeros(plant.num_velocities())
        for name in arm.body_names:
            body, at = arm.body(name), arm.body(name).CalcCenterOfMassInBodyFrame(context)
            J = plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(), at, *[plant.world_frame()] * 2
            )
            expected += J.T @ (body.get_mass(context) * np.asarray(gravity))
        found = plant.CalcGravityGeneralizedForces(context)
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found).max() > 10.0


def test_robots_on_their_feet_have_no_mount() -> None:
    with pytest.raises(InputError, match="only a base that is fixed can be mounted tilted"):
        build_robot(RobotConfig(effects={"mount": BaseTilt(*TILT)}))
    hanging = build_robot(RobotConfig(gantry_height=1.0, effects={"mount": BaseTilt(*TILT)}))
    assert hanging.plant.gravity_field().gravity_vector()[1] == pytest.approx(
        -9.81 * 0.04, rel=0.01
    )


def test_a_tilted_mount_is_found_and_nothing_else() -> None:
    scenario, log = arm_that_moves(mount=BaseTilt(*TILT))
    found = diagnose(Predictor(scenario, log))
    assert [(f.effect, f.targets) for f in found.chosen] == [("BaseTilt", ("robot",))]
    assert found.verdict == "effect_found"
    assert not found.chosen[0].confusable_with
    for axis, tilt in zip("xy", TILT, strict=True):
        estimate = found.chosen[0].parameters[axis]
        assert estimate.value == pytest.approx(tilt, abs=1e-3)
        assert estimate.interval[0] <= tilt <= estimate.interval[1]


def test_a_mount_whose_tilt_is_known_is_taken_for_granted() -> None:
    """And a level one has none, so nothing is found in it."""
    scenario, log = arm_that_moves(mount=BaseTilt(*TILT))
    told = dataclasses.replace(scenario.believed, effects={"mount": BaseTilt(*TILT)})
    level, level_log = arm_that_moves()
    for believed, of_log in ((dataclasses.replace(scenario, model=told), log), (level, level_log)):
        assert diagnose(Predictor(believed, of_log)).verdict == "nothing_missing"


def test_a_large_tilt_is_found_where_it_is_and_not_along_its_slope() -> None:
    """Gravity turns by sines and cosines: by a quarter of a radian 3 % of it are not linear."""
    scenario, log = arm_that_moves(mount=BaseTilt(0.2, 0.15))
    (found,) = diagnose(Predictor(scenario, log)).chosen
    assert found.effect == "BaseTilt"
    assert [found.parameters[a].value for a in "xy"] == pytest.approx([0.2, 0.15], abs=1e-3)


def test_a_pendulum_shows_no_tilt_of_its_axis() -> None:
    """A tilt out of the plane in which it swings makes its weight less by a cosine to either side.

    A weight that is larger than believed is none of it, although along the slope beside the middle,
    where the cosine rises again, a tilt seems to make it more. A tilt in the plane is an angle.
    """
    scenario = load_scenario("real/xl330")
    model = dataclasses.replace(scenario.believed, effects={})
    recording = RecordingConfig(rows="instantaneous", torque_noise={"servo": 2e-3})
    scenario = dataclasses.replace(scenario, model=model, recording=recording)
    time = np.arange(0.0, 20.0, 0.01)
    angle = 1.2 * np.sin(2.0 * time) + 0.4 * np.sin(5.1 * time)
    velocity = 2.4 * np.cos(2.0 * time) + 2.04 * np.cos(5.1 * time)
    acceleration = -4.8 * np.sin(2.0 * time) - 10.404 * np.sin(5.1 * time)
    inertia, weight, tilt = 1.5e-4 + 0.49 * 0.1**2, 0.49 * 9.81 * 0.1, 0.03
    noise = 2e-3 * np.random.default_rng(8).standard_normal(len(time))
    torque = inertia * acceleration + 1.04 * weight * np.sin(angle + tilt) + noise
    of_joint = {"position": angle, "velocity": velocity, "torque_command": torque}
    channels = {f"joint/{name}": values[:, None] for name, values in of_joint.items()}
    log = Log({"time": time} | channels, {"joints": ["servo"], "period": 0.01})
    found = diagnose(Predictor(scenario, log))
    (mount,) = (f for f in found.ranking if f.effect == "BaseTilt")
    assert mount.parameters["x"].value == 0.0
    # The servo turns about -y.
    assert mount.parameters["y"].value == pytest.approx(-tilt, rel=0.1)


def about_torques(scenario: Scenario, log: Log) -> list[HygieneFinding]:
    """What the hygiene says of the torques."""
    findings = inspect(Predictor(scenario, log).motion).findings
    return [finding for finding in findings if finding.channel == "joint/torque_command"]


def with_friction(log: Log) -> Log:
    """The same of joints with a twentieth of their torque of friction."""
    torque, v = log["joint/torque_command"], log["joint/velocity"]
    loss = 0.05 * torque.std(axis=0) * (np.tanh(v / 0.01) + v / v.std(axis=0))
    return Log(log.channels | {"joint/torque_command": torque + loss}, log.meta)


@pytest.mark.parametrize("zero", [0.05, 0.25])
def test_an_encoder_that_was_homed_badly_is_found(zero: float) -> None:
    """By 3 deg, which would make a robot fall and moves an arm's centre of mass by a centimetre;
    and by nearly as much as the hygiene begins to say."""
    scenario, log = arm_that_moves()
    found = diagnose(Predictor(scenario, counted(log, 2, zero=zero))).chosen
    assert [(f.effect, f.targets) for f in found] == [("EncoderOffset", ("axis_3",))]
    low, high = found[0].parameters["offset"].interval
    assert low <= zero <= high
    assert high - low < 5e-3


def test_what_repeats_with_the_angle_does_so_with_the_joint_s_and_not_with_what_is_read() -> None:
    """A ripple of 40 waves per radian in a joint whose encoder is off by 0.06 rad, 2.4 rad of the
    wave: amounts are those of the joint's angle, so that a model with both leaves nothing."""
    scenario, log = arm_that_moves()
    angle, torque = log["joint/position"][:, 2], log["joint/torque_command"].copy()
    torque[:, 2] += 6.0 * np.sin(40.0 * angle + 0.7)
    log = Log(log.channels | {"joint/torque_command": torque}, log.meta)
    diagnosis = diagnose(Predictor(scenario, counted(log, 2, zero=0.06)))
    assert diagnosis.verdict == "effect_found"
    found = {f.effect: f for f in diagnosis.chosen}
    assert found.keys() == {"EncoderOffset", "TorqueRipple"}
    assert all(f.targets == ("axis_3",) for f in found.values())
    ripple = found["TorqueRipple"].parameters
    assert ripple["sine"].value == pytest.approx(6.0 * np.cos(0.7), abs=0.3)
    assert ripple["cosine"].value == pytest.approx(6.0 * np.sin(0.7), abs=0.3)


def test_torques_that_come_very_late_are_said_to_be_so_late() -> None:
    """And one alone, which wants to be as late because something else is wrong with it, is not."""
    scenario, log = arm_that_moves()
    log = with_friction(log)
    torque, samples = log["joint/torque_command"], 15
    late = np.concatenate([np.repeat(torque[:1], samples, axis=0), torque[:-samples]])
    (found,) = about_torques(scenario, Log(log.channels | {"joint/torque_command": late}, log.meta))
    assert (found.kind, found.where) == ("clock_offset", ())
    assert found.size == pytest.approx(samples * log.meta["period"], abs=0.01)
    alone = torque.copy()
    alone[:, 2] = late[:, 2]
    one = Log(log.channels | {"joint/torque_command": alone}, log.meta)
    assert "clock_offset" not in {finding.kind for finding in about_torques(scenario, one)}


ANOTHER = {
    "mount": "gravity pulls from elsewhere than the model says, by",
    "joint_direction": "axis_3 counts its angle and torque the other way than the model does",
    "joint_zero": r"axis_2 counts its angle from another zero than the model does, by 90 deg",
    "without_gravity": "torques are without what gravity needs",
}


def counted(log: Log, joint: int, *, sign: float = 1.0, zero: float = 0.0) -> Log:
    """The same of a joint that counts its angle and torque the other way, or from another zero."""
    channels = dict(log.channels)
    for name in ("joint/position", "joint/velocity", "joint/torque_command"):
        channels[name] = channels[name].copy()
        channels[name][:, joint] *= sign
    channels["joint/position"][:, joint] += zero
    return Log(channels, log.meta)


@pytest.mark.parametrize("tilt", [(0.0, np.pi / 2), (np.pi, 0.0), (0.5, -0.3), (-1.2, 1.2)])
def test_an_arm_on_a_wall_is_said_to_be_there(tilt: tuple[float, float]) -> None:
    """And where the model has it there, nothing is said."""
    scenario, log = arm_that_moves(mount=BaseTilt(*tilt))
    log = with_friction(log)
    (found,) = about_torques(scenario, log)
    assert (found.kind, found.severity, found.where) == ("mount", "untrustworthy", ())
    assert found.size == pytest.approx(np.hypot(*tilt), abs=0.02)
    told = dataclasses.replace(scenario.believed, effects={"mount": BaseTilt(*tilt)})
    assert about_torques(dataclasses.replace(scenario, model=told), log) == []
    with pytest.raises(InputError, match=r"BaseTilt with x: .* allows for it"):
        inspect(Predictor(scenario, log).motion).trusted(scenario, Predictor(scenario, log).robot)


def test_joints_that_count_otherwise_are_named() -> None:
    """Also two at a time, one after the other; and what allows for another zero does."""
    scenario, log = arm_that_moves()
    log = with_friction(log)
    turned, moved = counted(log, 2, sign=-1.0), counted(log, 1, zero=np.pi / 2)
    for kind, wrong in (("joint_direction", turned), ("joint_zero", moved)):
        (found,) = about_torques(scenario, wrong)
        assert (found.kind, found.severity) == (kind, "untrustworthy")
        assert re.search(ANOTHER[kind], found.text)
        assert "; or " not in found.text
    both = about_torques(scenario, counted(turned, 1, zero=np.pi / 2))
    assert {finding.kind for finding in both} == {"joint_direction", "joint_zero"}
    on_a_wall = counted(with_friction(arm_that_moves(mount=BaseTilt(0.0, 1.2))[1]), 2, sign=-1.0)
    both = about_torques(scenario, on_a_wall)
    assert {finding.kind for finding in both} == {"joint_direction", "mount"}
    known = {"zero": EncoderOffset({"axis_2": np.pi / 2})}
    told = dataclasses.replace(scenario.believed, effects=known)
    assert about_torques(dataclasses.replace(scenario, model=told), moved) == []


def test_torques_without_those_of_gravity_are_said_to_be_so() -> None:
    scenario, log = arm_that_moves()
    arm, q = build_robot(scenario.believed), log["joint/position"]
    context = arm.plant.CreateDefaultContext()
    torque = with_friction(log)["joint/torque_command"].copy()
    for row, posture in zip(torque, q, strict=True):
        arm.set_joint_positions(context, posture)
        row += arm.plant.CalcGravityGeneralizedForces(context)[arm.velocity_index]
    (found,) = about_torques(
        scenario, Log(log.channels | {"joint/torque_command": torque}, log.meta)
    )
    assert found.kind == "without_gravity"
    assert re.search(ANOTHER["without_gravity"], found.text)


def test_the_usual_setup_is_not_called_another() -> None:
    """With reversed torques, another unit, a heavy load, a counterbalance; and a small tilt."""
    scenario, log = arm_that_moves()
    log = with_friction(log)
    torque, q = log["joint/torque_command"], log["joint/position"]

    def read_as(torque: np.ndarray) -> Log:
        return Log(log.channels | {"joint/torque_command": torque}, log.meta)

    balanced = torque.copy()
    balanced[:, 1] += 150.0 * np.sin(q[:, 1] - 0.4)
    coupled = torque.copy()
    coupled[:, 2] += torque[:, 1]
    loaded = with_friction(arm_that_moves(load=Payload({"link_6": 8.0}, z={"link_6": 0.1}))[1])
    tilted = with_friction(arm_that_moves(mount=BaseTilt(0.2, 0.1))[1])
    reversed_ = read_as(-torque)
    others = (read_as(2.5 * torque), read_as(balanced), read_as(coupled), loaded, tilted)
    for decoy in (reversed_, *others):
        assert not {finding.kind for finding in about_torques(scenario, decoy)} & set(ANOTHER)
    assert about_torques(scenario, reversed_)[0].kind == "torque_sign"


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.2), (-1.5, 0.4), (np.pi, 0.0)])
def test_a_slope_is_told_by_the_gravity_on_it(slope: tuple[float, float]) -> None:
    gravity = gravity_on_slope(np.array([0.0, 0.0, -9.81]), slope)
    again = gravity_on_slope(np.array([0.0, 0.0, -9.81]), slope_of_gravity(gravity))
    np.testing.assert_allclose(again, gravity, atol=1e-12)
    if np.hypot(*slope) < np.pi:
        np.testing.assert_allclose(slope_of_gravity(gravity), slope, atol=1e-12)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_what_is_left_with_a_tilt_in_the_model_is_measured_by_one_noise(factor: float) -> None:
    """What a search took for noise before it knew of friction is none in a model that has it, and
    effects seem to leave more there than without them."""
    predictor = Predictor(*arm_that_moves(mount=BaseTilt(*TILT)))
    told = predictor.residual
    noisier = dataclasses.replace(
        told, variance=factor * told.variance, covariance=factor * told.covariance
    )
    fits = Fits(Dictionary(predictor, [BaseTilt]), WhitenedResidual(noisier))
    linear = fits.explain(fits.fixed_candidates)
    final, _, left = added(fits, linear)
    assert final.sse.sum() == pytest.approx(linear.sse.sum(), rel=0.1)
    assert (left**2).sum() == pytest.approx(factor * final.sse.sum(), rel=0.02)
