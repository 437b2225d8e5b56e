"""A robot with four legs of three joints on point feet: it stands, sways and trots on the same
code."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from conftest import scenario
from pydrake.math import RigidTransform, RotationMatrix
from rig import Base, rms

from fbse_drake import Log
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.residual.equation_of_motion import EquationOfMotion
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.discrepancy.residual.rows import residual_rows
from fbse_drake.effects.contact import GroundCompliance
from fbse_drake.effects.effect import library
from fbse_drake.errors import InputError
from fbse_drake.estimators.joint_acceleration import no_slip_condition, still_rows
from fbse_drake.estimators.records import record
from fbse_drake.report.metrics import attitude_rmse_deg, friction_nrmse
from fbse_drake.robot.plant import Robot, grasp_map, make_robot
from fbse_drake.scenario import build_robot
from fbse_drake.walking.contact_forces import contact_forces, foot_weights
from fbse_drake.walking.leg_kinematics import LegKinematics
from fbse_drake.walking.reference import Reference, make_reference
from fbse_drake.walking.stand import Squat
from fbse_drake.walking.walk import Trot, Walk

WEIGHT = 26.0 * 9.81
TIME = np.arange(0, 2.0, 0.01)
SHORT = ("duration=1.6", "reference.initial_double_support=0.3", "reference.single_supports=3")


@pytest.fixture(scope="module")
def robot() -> Robot:
    return make_robot("quadruped")[0]


@pytest.fixture(scope="module")
def trot(robot: Robot) -> Reference:
    turning = Trot(step_length=0.04, step_left=0.02, step_turn=0.1, single_supports=3)
    return make_reference(turning, robot, TIME)


@pytest.fixture(scope="module")
def log(run) -> Log:
    return run("quadruped_trot", *SHORT)


def test_inverse_kinematics_of_a_point_foot(robot: Robot):
    leg = LegKinematics.from_robot(robot, "rear_right")
    angles = np.random.default_rng(0).uniform([-0.5, 0.2, -2.2], [0.5, 1.2, -0.7], size=(200, 3))
    pose = leg.forward(angles)
    # How the foot is turned does not matter.
    turned = np.broadcast_to(np.eye(3), (200, 3, 3))
    np.testing.assert_allclose(leg.inverse(turned, pose.p_BF), angles, atol=1e-9)


def test_drake_finds_the_robot_where_the_trot_wants_it(robot: Robot, trot: Reference):
    plan, context, plant = trot.plan, robot.plant.CreateDefaultContext(), robot.plant
    for k in range(0, len(TIME), 17):
        yaw = plan.trunk_yaw
        X_WB = RigidTransform(RotationMatrix(yaw.rotation[k]), trot.base.position[k])
        V_WB = np.concatenate([yaw.angular_velocity[k], trot.base.velocity[k]])
        robot.set_state(context, trot.joint_position[k], trot.joint_velocity[k], X_WB, V_WB)
        com = plant.CalcCenterOfMassPositionInWorld(context)
        speed = plant.CalcCenterOfMassTranslationalVelocityInWorld(context)
        np.testing.assert_allclose(com, plan.com.position[k], atol=1e-10)
        np.testing.assert_allclose(speed, plan.com.velocity[k], atol=1e-9)
        for side, foot in plan.feet.items():
            sole = robot.sole(side)
            place = sole.CalcPoseInWorld(context).translation()
            velocity = sole.CalcSpatialVelocityInWorld(context).translational()
            np.testing.assert_allclose(place, foot.position[k], atol=1e-10)
            np.testing.assert_allclose(velocity, foot.velocity[k], atol=1e-9)


def test_diagonal_legs_step_together_and_the_zmp_is_between_them(trot: Reference):
    plan = trot.plan
    singles = [phase for phase in plan.phases if phase.is_single]
    assert [set(phase.support) for phase in singles[:2]] == [
        {"front_left", "rear_right"},
        {"front_right", "rear_left"},
    ]
    for phase in singles:
        k = int(np.searchsorted(TIME, (phase.start + phase.end) / 2))
        one, other = (plan.feet[side].position[k, :2] for side in phase.support)
        np.testing.assert_allclose(plan.zmp[k], (one + other) / 2, atol=1e-9)


def test_a_hexapod_is_a_description_and_walks_on_tripods():
    robot = make_robot("hexapod")[0]
    walk = Trot(wheelbase=0.7, single_supports=2)
    plan = make_reference(walk, robot, np.arange(0, 1.5, 0.02)).plan
    tripods = [set(phase.support) for phase in plan.phases if phase.is_single]
    assert tripods == [
        {"front_left", "middle_right", "rear_left"},
        {"front_right", "middle_left", "rear_right"},
    ]
    for side, foot in plan.feet.items():
        assert foot.position[0, 0] == pytest.approx(
            {"front": 0.35, "middle": 0.0, "rear": -0.35}[side.split("_")[0]]
        )


def test_feet_are_loaded_and_relieved_smoothly(trot: Reference):
    weights = foot_weights(trot.plan)
    np.testing.assert_allclose(weights.sum(axis=1), 2.0)
    for k, side in enumerate(trot.plan.feet):
        assert not weights[~trot.plan.support(side), k].any()
    assert np.abs(np.diff(weights, axis=0)).max() < 0.12


def test_three_or_six_joints_and_two_or_four_legs(robot: Robot):
    with pytest.raises(InputError, match="a walk takes two legs"):
        make_reference(Walk(first_support="front_left"), robot, TIME)
    with pytest.raises(InputError, match="a trot takes pairs of legs"):
        make_reference(Trot(first_support="left"), make_robot("biped")[0], TIME)


CORNERS = np.array([[0.3, 0.2, 0.0], [0.3, -0.2, 0.0], [-0.3, 0.2, 0.0], [-0.3, -0.2, 0.0]])


def forces_under(wrench: np.ndarray, weights: np.ndarray, points: np.ndarray = CORNERS):
    return contact_forces(wrench[None], points[None], weights[None])[0]


def test_a_weight_in_the_middle_is_shared_evenly():
    forces = forces_under(np.array([0, 0, 0, 0, 0, 100.0]), np.ones(4))
    np.testing.assert_allclose(forces, np.tile([0, 0, 25.0], (4, 1)), atol=0.01)


def test_where_no_cone_is_in_the_way_forces_are_the_smallest():
    wrench = np.array([4.0, -6.0, 1.0, 5.0, -3.0, 100.0])
    forces = forces_under(wrench, np.ones(4))
    # Moments count with the mean distance of the points; the wrench is met exactly, so no scale
    # matters.
    smallest = np.linalg.pinv(grasp_map(CORNERS)) @ wrench
    np.testing.assert_allclose(forces.ravel(), smallest, atol=0.01)


@pytest.mark.parametrize("sideways", [45.0, -40.0])
def test_forces_push_and_stay_in_their_cones(sideways: float):
    """Pushed at the limit, with the load on one side: the smallest forces would leave the cones."""
    wrench = np.array([12.0, 0.0, 0.0, 0.0, sideways, 100.0])
    free = np.linalg.pinv(grasp_map(CORNERS)) @ wrench
    assert min(0.5 * f[2] - np.hypot(f[0], f[1]) for f in free.reshape(-1, 3)) < -1.0
    forces = forces_under(wrench, np.ones(4))
    np.testing.assert_allclose(grasp_map(CORNERS) @ forces.ravel(), wrench, atol=0.02)
    assert (np.hypot(*forces[:, :2].T) <= 0.5 * forces[:, 2] + 1e-3).all()
    # Of forces of the same wrench none in the cones are smaller.
    null = np.linalg.svd(grasp_map(CORNERS))[2][6:]
    draw = np.random.default_rng(0)
    for size in (0.1, 1.0):
        others = forces.ravel() + size * draw.normal(size=(500, len(null))) @ null
        x, y, z = others.reshape(500, 4, 3).transpose(2, 0, 1)
        inside = (np.hypot(x, y) <= 0.5 * z).all(axis=1)
        assert (np.linalg.norm(others[inside], axis=1) > np.linalg.norm(forces) - 0.01).all()


def test_two_points_give_all_but_the_moment_about_their_line():
    line = CORNERS[0] - CORNERS[3]
    wrench = np.array([3.0, 1.0, 0.5, 4.0, 2.0, 100.0])
    forces = forces_under(wrench, np.array([1.0, 0.0, 0.0, 1.0]))
    left = wrench - grasp_map(CORNERS) @ forces.ravel()
    assert not forces[1:3].any()
    np.testing.assert_allclose(left[3:], 0.0, atol=0.01)
    about = line / np.linalg.norm(line)
    np.testing.assert_allclose(left[:3], about * (about @ wrench[:3]), atol=0.01)


def test_feedforward_at_rest_carries_the_weight(robot: Robot):
    """Virtual work: lifting the base by dz with the feet on the ground costs m g dz."""
    low, high = (
        make_reference(
            Squat(com_height=z, foot_spacing=0.34, wheelbase=0.5, zmp_forward=0.0),
            robot,
            np.array([0.0, 1.0]),
        )
        for z in (0.38, 0.38001)
    )
    work = low.feedforward_torque[0] @ (high.joint_position[0] - low.joint_position[0])
    assert work == pytest.approx(WEIGHT * 1e-5, rel=1e-3)


def test_two_point_feet_fix_the_base_but_for_a_turn_about_their_line(robot: Robot):
    """Paper eq. (41) of the diagonal: six rows, of rank five in the base's accelerations."""
    posture = np.tile([0.05, 0.7, -1.3], 4)
    model = Base.of("quadruped").model_of(joint_position=posture, support=np.ones(4))
    stands, upright = np.array([True, False, False, True]), record(rotation=np.eye(3))
    gravity = np.array([0.0, 0.0, -9.81])
    J, y = no_slip_condition(model, upright, stands, still_rows(robot), gravity)
    assert J.shape == (6, 18)
    assert y.shape == (6,)
    _, sizes, rows = np.linalg.svd(J[:, :6])
    assert sizes[4] > 0.1
    assert sizes[5] < 1e-9
    one, other = model["foot_position"][[0, 3]]
    w, v = rows[5].reshape(2, 3)
    np.testing.assert_allclose(np.cross(w, one - other), 0.0, atol=1e-9)
    np.testing.assert_allclose(v + np.cross(w, one), 0.0, atol=1e-9)


def test_standing_feet_carry_the_weight(log: Log):
    still = log.time < 0.25
    load = sum(log[f"truth/foot/{side}/pad_force"][still, 0, 2] for side in log.sides)
    level = sum(np.linalg.norm(log[f"foot/{s}/pad_force"][still, 0], axis=1) for s in log.sides)
    assert load[-1] == pytest.approx(WEIGHT, rel=0.02)
    assert level[-1] == pytest.approx(WEIGHT, rel=0.02)


def test_it_trots_and_its_friction_is_known(log: Log):
    assert not log.meta["outcome"]["fell"]
    assert rms(log["reference/joint/position"] - log["truth/joint/position"]) < 2e-3
    for phase, errors in friction_nrmse(log).items():
        assert np.mean(list(errors.values())) < 0.15, phase
    assert max(attitude_rmse_deg(log).values()) < 0.1


def test_the_equation_of_motion_of_the_base_closes_on_point_feet(log: Log):
    config = scenario("quadruped_trot", *SHORT)
    motion = RecordedMotion(build_robot(config.believed), config.sensors, config.recording, log)
    residual = motion.residual
    base = [k for k, row in enumerate(residual.rows) if row.kind == "base"]
    white = residual.value[:, base] / np.sqrt(residual.variance[:, base])
    assert rms(white) < 2.0
    # How a point foot is turned nobody knows.
    soles = [k for k, row in enumerate(residual.rows) if "_sole/" in row.name]
    assert not residual.known[:, soles].any()


def test_between_two_point_feet_all_but_a_turn_about_their_line_shows(robot: Robot):
    """Relative velocities are w x (p - q) and what the legs' joints do, by Drake's places of the
    feet."""
    random = np.random.default_rng(3)
    q = np.tile([0.05, 0.7, -1.3], 4) + random.uniform(-0.2, 0.2, 12)
    rate, w, lean = random.normal(size=(3, 12)), random.normal(size=(3, 3)), 1e-6
    context = robot.plant.CreateDefaultContext()

    def place(side: str, angles: np.ndarray) -> np.ndarray:
        robot.set_state(context, angles, np.zeros(12), RigidTransform(), np.zeros(6))
        return robot.sole(side).CalcPoseInWorld(context).translation()

    sides = robot.description.sides
    here = {side: place(side, q) for side in sides}
    motion = EquationOfMotion(robot)
    rows = residual_rows(robot)
    zeros = {"joint_acceleration": (3, 12), "angular_acceleration": (3, 3), "pad_force": (3, 4, 3)}
    at = Instants(
        joint_position=np.tile(q, (3, 1)),
        joint_velocity=rate,
        angular_velocity=w @ motion.R_BI,
        specific_force=np.zeros((3, 3)),
        torque_command=np.zeros((3, 12)),
        motor_position=np.zeros((3, 0)),
        **{name: np.zeros(shape) for name, shape in zeros.items()},
    )

    def relative(at: Instants, one: str, other: str) -> np.ndarray:
        index = [k for k, row in enumerate(rows) if row.feet == (one, other)]
        return motion.residual(at)[:, index]

    for one, other in combinations(sides, 2):
        by_joints = [
            (place(one, q + lean * r) - place(other, q + lean * r)) / lean
            - (here[one] - here[other]) / lean
            for r in rate
        ]
        line = here[one] - here[other]
        found = relative(at, one, other)
        np.testing.assert_allclose(found, np.cross(w, line) + by_joints, atol=1e-5)
        turned = replace(at, angular_velocity=at.angular_velocity + line @ motion.R_BI)
        np.testing.assert_allclose(relative(turned, one, other), found, atol=1e-12)


def test_pairs_of_feet_say_a_motion_once(log: Log):
    """Of feet that stand one row less than they are; none of a foot that swings."""
    config = scenario("quadruped_trot", *SHORT)
    motion = RecordedMotion(build_robot(config.believed), config.sensors, config.recording, log)
    rows = residual_rows(motion.robot)
    pairs = [k for k, row in enumerate(rows) if row.name.endswith("relative_velocity_z")]
    counts = motion.known[:, pairs].sum(axis=1)
    assert counts.max() == 3
    assert (counts <= np.maximum(motion.standing.sum(axis=1) - 1, 0)).all()
    for k in pairs:
        feet = [motion.robot.description.sides.index(side) for side in rows[k].feet]
        assert motion.standing[motion.known[:, k]][:, feet].all()


@pytest.mark.parametrize("compliance", [0.0, 2e-6])
def test_soft_ground_shows_between_point_feet(run, compliance: float):
    """Least squares over the rows finds what is simulated, and on firm ground nothing; noise is
    white."""
    soft = f"robot.effects.soft=!GroundCompliance {{compliance: {compliance}}}"
    log = run(
        "quadruped_trot", *SHORT, "estimator=!NoEstimator {}", *([soft] if compliance else [])
    )
    config = scenario("quadruped_trot", *SHORT)
    predictor = Predictor(replace(config, model=config.robot), log)
    residual = predictor.residual
    rows = [k for k, row in enumerate(residual.rows) if "relative_velocity" in row.name]
    known = residual.known[:, rows]
    deviation = np.sqrt(residual.variance[:, rows])[known]
    signature = predictor.signature(GroundCompliance, "robot", np.zeros(1))
    places = [list(signature.rows).index(k) for k in rows]
    column = signature.values[:, places, 0][known] / deviation
    value = residual.value[:, rows][known] / deviation
    found, error = (column @ value) / (column @ column), 1 / np.sqrt(column @ column)
    assert error < 0.05 * 2e-6
    assert abs(found - compliance) < 4 * error + 0.05 * compliance
    assert rms(value - found * column) < 1.4


def test_a_foot_at_the_limit_of_friction_is_not_known_to_stand(run):
    """Its forces pull sideways as hard as friction holds, from 0.2 to 0.3 s: rows in which it has a
    part are not known then, and a little before and after; all others are."""
    log = run("quadruped_trot", *SHORT, "estimator=!NoEstimator {}")
    config = scenario("quadruped_trot", *SHORT)
    side = make_robot("quadruped")[0].description.sides[0]
    name = f"foot/{side}/pad_force"
    force = log[name].copy()
    pulls = (log.time >= 0.2) & (log.time < 0.3)
    force[pulls] = np.linalg.norm(force[pulls], axis=-1, keepdims=True) * [0.7, 0.0, 0.7]
    before, after = (
        Predictor(replace(config, model=config.robot), one).residual
        for one in (log, Log(log.channels | {name: force}, log.meta))
    )
    lost = before.known & ~after.known
    mine = np.array([side in row.feet for row in before.rows])
    assert not lost[:, ~mine].any()
    at = before.time - log.time[0]
    assert before.known[(at > 0.2) & (at < 0.3)][:, mine].any()
    assert not after.known[(at > 0.2) & (at < 0.3)][:, mine].any()
    assert np.all(np.abs(at[lost.any(axis=1)] - 0.25) < 0.1)


def test_four_feet_that_read_too_much_are_not_taken_for_weak_motors_and_payloads(run):
    """Alone none of the front feet explains anything."""
    gains = dict.fromkeys(make_robot("quadruped")[0].description.sides, 0.05)
    feet = f"robot.effects.feet=!FootForceGain {{gain: {gains}}}".replace("'", "")
    log = run("quadruped_trot", *SHORT, "estimator=!NoEstimator {}", "seed=11", feet)
    given = scenario("quadruped_trot", *SHORT)
    names = ("FootForceGain", "TorqueGain", "BodyMass", "Payload", "CoulombFriction")
    found = diagnose(
        Predictor(replace(given, model=given.robot), log), [library()[name] for name in names]
    )
    assert found.verdict == "effect_found"
    assert {(f.effect, *f.targets) for f in found.chosen} == {
        ("FootForceGain", side) for side in gains
    }
    for finding in found.chosen:
        low, high = finding.parameters["gain"].interval
        assert low < 0.05 < high < low + 0.02


def diagnosed_hips(run, changes: tuple[str, ...], signs: tuple[int, ...]):
    """All hips are read crooked by 6.6 mrad: what a diagnosis finds, and what there is."""
    legs = make_robot("quadruped")[0].description.sides
    offsets = {
        f"{leg}_hip_abduction": -0.0066 * sign for leg, sign in zip(legs, signs, strict=True)
    }
    hips = f"robot.effects.hips=!EncoderOffset {{offset: {offsets}}}".replace("'", "")
    log = run("quadruped_trot", *changes, "estimator=!NoEstimator {}", hips)
    given = scenario("quadruped_trot", *changes)
    names = ("EncoderOffset", "ImuMisalignment", "AccelerometerBias", "GyroscopeBias", "BodyMass")
    found = diagnose(
        Predictor(replace(given, model=given.robot), log), [library()[name] for name in names]
    )
    assert found.verdict == "effect_found"
    return found.chosen, offsets


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (1, -1, 1, -1)])
def test_four_hips_that_are_read_crooked_are_not_taken_for_a_crooked_imu(run, signs):
    """Alone none of the front hips explains anything: the sum over all is as if the base tilted."""
    chosen, offsets = diagnosed_hips(run, ("duration=3", "seed=11"), signs)
    values = {f.targets[0]: f.parameters["offset"].value for f in chosen}
    assert {f.effect for f in chosen} == {"EncoderOffset"}
    assert values == pytest.approx(offsets, abs=6e-4)


def test_of_a_log_that_is_too_short_to_tell_hips_from_imu_both_are_named(run):
    (found,), _ = diagnosed_hips(run, (*SHORT, "seed=12"), (1, 1, 1, 1))
    assert found.effect == "ImuMisalignment"
    assert "EncoderOffset" in found.confusable_with
