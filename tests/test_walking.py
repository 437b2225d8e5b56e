import dataclasses

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from fbse_drake.errors import InputError
from fbse_drake.robot.plant import Ground, Robot, Stairs, make_robot
from fbse_drake.walking.leg_kinematics import LegKinematics, UnreachableError
from fbse_drake.walking.plan import support_margin
from fbse_drake.walking.reference import (
    JointSines,
    Reference,
    load_shares,
    make_plan,
    make_reference,
)
from fbse_drake.walking.stand import Squat, Sway
from fbse_drake.walking.walk import Walk

TIME = np.arange(0, 11.5005, 0.005)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return make_robot("biped")[0]


@pytest.fixture(scope="module")
def walk(robot: Robot) -> Reference:
    return make_reference(Walk(), robot, TIME)


def test_a_plan_needs_no_joints(robot: Robot, walk: Reference):
    plan = make_plan(Walk(), robot, TIME)
    assert plan is not None
    assert walk.plan is not None
    np.testing.assert_array_equal(plan.com.position, walk.plan.com.position)
    for side in plan.feet:
        np.testing.assert_array_equal(plan.support(side), walk.plan.support(side))
        np.testing.assert_array_equal(plan.feet[side].position, walk.plan.feet[side].position)
    with pytest.raises(InputError, match="zmp_margin"):
        make_plan(Walk(zmp_inward=0.045), robot, TIME)
    assert make_plan(JointSines(), robot, TIME) is None


def random_angles(samples: int, seed: int = 0) -> np.ndarray:
    lower = np.array([-0.5, -0.4, -1.2, 0.1, -1.0, -0.4])
    upper = np.array([0.5, 0.4, 0.5, 1.8, 0.6, 0.4])
    return np.random.default_rng(seed).uniform(lower, upper, size=(samples, 6))


@pytest.mark.parametrize("side", ["left", "right"])
def test_inverse_kinematics_round_trip(robot: Robot, side: str):
    leg = LegKinematics.from_robot(robot, side)
    q = random_angles(500)
    pose = leg.forward(q)
    np.testing.assert_allclose(leg.inverse(pose.R_BF, pose.p_BF), q, atol=1e-10)


@pytest.mark.parametrize("side", ["left", "right"])
def test_leg_kinematics_agree_with_drake(robot: Robot, side: str):
    leg, plant = LegKinematics.from_robot(robot, side), robot.plant
    q, v = random_angles(1, seed=3), np.random.default_rng(4).normal(size=(1, 6))
    motion = leg.forward(q, v)
    columns = slice(
        6 * robot.description.sides.index(side), 6 * robot.description.sides.index(side) + 6
    )
    context = plant.CreateDefaultContext()
    joint_q, joint_v = np.zeros(12), np.zeros(12)
    joint_q[columns], joint_v[columns] = q, v
    robot.set_state(context, joint_q, joint_v, RigidTransform())
    world, sole = plant.world_frame(), robot.sole(side)
    X = sole.CalcPoseInWorld(context)
    J = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, sole, [0, 0, 0], world, world
    )
    bias = plant.CalcBiasSpatialAcceleration(
        context, JacobianWrtVariable.kV, sole, [0, 0, 0], world, world
    )
    np.testing.assert_allclose(motion.p_BF[0], X.translation(), atol=1e-12)
    np.testing.assert_allclose(motion.R_BF[0], X.rotation().matrix(), atol=1e-12)
    np.testing.assert_allclose(motion.J[0], J[:, robot.velocity_index[columns]], atol=1e-12)
    np.testing.assert_allclose(
        motion.Jdot_v[0], np.concatenate([bias.rotational(), bias.translational()]), atol=1e-10
    )


def test_leg_out_of_reach_is_refused(robot: Robot):
    leg = LegKinematics.from_robot(robot, "left")
    with pytest.raises(UnreachableError, match=r"the leg allows 0\.550 m"):
        leg.inverse(np.eye(3)[None], leg.offsets[0] + np.array([[0.0, 0.0, -0.7]]))


def test_timeline_is_the_papers(walk: Reference):
    singles = [
        (phase.start, phase.end, phase.support[0]) for phase in walk.plan.phases if phase.is_single
    ]
    assert singles == [
        (0.5, 1.1, "left"),
        (2.0, 2.6, "right"),
        (3.5, 4.1, "left"),
        (5.0, 5.6, "right"),
        (6.5, 7.1, "left"),
        (8.0, 8.6, "right"),
        (9.5, 10.1, "left"),
    ]


def test_com_of_the_reference_posture_is_the_planned_com(robot: Robot, walk: Reference):
    context = robot.plant.CreateDefaultContext()
    for k in range(0, len(TIME), 173):
        V_WB = np.concatenate([np.zeros(3), walk.base.velocity[k]])
        robot.set_state(
            context,
            walk.joint_position[k],
            walk.joint_velocity[k],
            RigidTransform(walk.base.position[k]),
            V_WB,
        )
        np.testing.assert_allclose(
            robot.plant.CalcCenterOfMassPositionInWorld(context),
            walk.plan.com.position[k],
            atol=1e-10,
        )
        np.testing.assert_allclose(
            robot.plant.CalcCenterOfMassTranslationalVelocityInWorld(context),
            walk.plan.com.velocity[k],
            atol=1e-10,
        )
        for side, foot in walk.plan.feet.items():
            pose = robot.sole(side).CalcPoseInWorld(context)
            np.testing.assert_allclose(pose.translation(), foot.position[k], atol=1e-10)
            assert pose.rotation().IsNearlyIdentity(1e-10)


def test_joint_velocity_and_acceleration_are_the_derivatives(robot: Robot):
    h, middle = 1e-4, np.array([0.2, 0.8, 1.5, 2.3, 6.8, 9.9])
    t = np.sort(np.concatenate([middle - h, middle, middle + h, [0.0, 11.5]]))
    reference = make_reference(Walk(), robot, t)
    k = np.searchsorted(t, middle)
    q = reference.joint_position
    np.testing.assert_allclose(
        (q[k + 1] - q[k - 1]) / (2 * h), reference.joint_velocity[k], atol=2e-5
    )
    np.testing.assert_allclose(
        (q[k + 1] - 2 * q[k] + q[k - 1]) / h**2, reference.joint_acceleration[k], atol=2e-3
    )


def test_walk_starts_and_ends_at_rest(walk: Reference):
    for k in (0, -1):
        np.testing.assert_allclose(walk.plan.com.velocity[k], 0, atol=1e-9)
        np.testing.assert_allclose(walk.plan.com.acceleration[k], 0, atol=1e-9)
        np.testing.assert_allclose(walk.joint_velocity[k], 0, atol=1e-9)


def test_planned_zmp_keeps_its_margin(robot: Robot, walk: Reference):
    for phase in walk.plan.phases:
        inside = (phase.start < TIME) & (phase.end > TIME)
        corners = [
            walk.plan.feet[s].position[inside][0, :2] + robot.pad_positions(s)[:, :2]
            for s in phase.support
        ]
        assert (
            support_margin(walk.plan.zmp[inside], np.concatenate(corners)).min()
            >= Walk().zmp_margin
        )


def test_support_margin_of_a_square():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_allclose(
        support_margin(np.array([[0.5, 0.5], [0.9, 0.5], [1.2, 0.5]]), square), [0.5, 0.1, -0.2]
    )


def test_shared_load_gives_the_zmp_and_sums_to_one(walk: Reference):
    shares = load_shares(walk.plan)
    np.testing.assert_allclose(sum(shares.values()), 1.0)
    both = np.all([walk.plan.support(side) for side in shares], axis=0)
    zmp = sum(shares[side][:, None] * walk.plan.anchor(side) for side in shares)
    # On the line between the feet; the CoM sways a little beyond at start and end.
    middle = both & (TIME > 1.0) & (TIME < 10.0)
    np.testing.assert_allclose(zmp[middle], walk.plan.zmp[middle], atol=1e-12)
    assert all(np.all((share >= 0) & (share <= 1)) for share in shares.values())
    # No jumps: a foot takes over the load gradually.
    assert max(np.abs(np.diff(share)).max() for share in shares.values()) < 0.03


def test_feedforward_at_rest_carries_the_weight(robot: Robot, walk: Reference):
    """Virtual work: lifting the base by dz with the feet on the ground costs m g dz."""
    context = robot.plant.CreateDefaultContext()
    robot.set_state(
        context, walk.joint_position[0], np.zeros(12), RigidTransform(walk.base.position[0])
    )
    weight = robot.plant.CalcTotalMass(context) * 9.81
    step = 1e-5
    higher = make_reference(Squat(com_height=Walk().com_height), robot, np.array([0.0, 1.0]))
    lifted = make_reference(Squat(com_height=Walk().com_height + step), robot, np.array([0.0, 1.0]))
    dq = lifted.joint_position[0] - higher.joint_position[0]
    assert higher.feedforward_torque[0] @ dq == pytest.approx(weight * step, rel=1e-3)


def test_step_out_of_reach_names_the_step_and_the_limit(robot: Robot):
    with pytest.raises(
        InputError, match=r"step \d .* out of reach: hip to ankle 0\.\d+ m, the leg allows 0\.550 m"
    ):
        make_reference(Walk(step_length=0.40), robot, TIME)


def test_joint_limit_names_the_joint(robot: Robot):
    with pytest.raises(InputError, match=r"needs \w+ at .* rad, its limits are"):
        make_reference(Walk(com_height=0.30, step_length=0.02), robot, TIME)


def test_zmp_outside_its_margin_names_the_phase(robot: Robot):
    with pytest.raises(
        InputError, match=r"phase 1 \(left support\), t = .* zmp_margin asks for 0\.020 m"
    ):
        make_reference(Walk(zmp_inward=0.045), robot, TIME)


@pytest.mark.parametrize(
    ("field", "value"), [("single_support", 0.0), ("single_supports", 0), ("step_height", -0.1)]
)
def test_impossible_values_are_refused(field: str, value: float):
    with pytest.raises(InputError, match=field):
        dataclasses.replace(Walk(), **{field: value})


def test_sway_zmp_of_a_point_mass(robot: Robot):
    """A point mass that sways has its ZMP where gravity and inertia balance."""
    reference = make_reference(Sway(amplitude=0.04, frequency=0.3), robot, np.arange(0, 8, 0.01))
    com = reference.plan.com
    moment = (
        com.position[:, 2] * com.acceleration[:, 1]
        - (com.position[:, 1] - reference.plan.zmp[:, 1]) * 9.81
    )
    np.testing.assert_allclose(moment, 0, atol=1e-9)
    assert np.abs(reference.plan.zmp[:, 1]).max() > 0.04


SHORT = np.arange(0, 3.6, 0.005)
WALKS = {
    "turning": {"step_length": 0.08, "step_turn": 0.15},
    "sideways": {"step_length": 0.0, "step_left": 0.05},
    "backwards and round": {"step_length": -0.05, "step_left": -0.03, "step_turn": -0.2},
    "stairs": {"step_length": 0.2, "step_rise": 0.04, "com_height": 0.6},
    "down": {"step_length": 0.2, "step_rise": -0.03, "com_height": 0.6},
    "slope": {"slope": [0.05, -0.08], "com_height": 0.63},
}


@pytest.fixture(scope="module", params=list(WALKS))
def other(request: pytest.FixtureRequest, robot: Robot) -> tuple[Walk, Reference]:
    walk = Walk(single_supports=2, **WALKS[request.param])
    return walk, make_reference(walk, robot, SHORT)


def test_base_and_joints_of_any_walk_move_as_planned(robot: Robot, other: tuple[Walk, Reference]):
    """Drake's forward kinematics of posture and velocities is the plan's CoM and feet."""
    plan, reference = other[1].plan, other[1]
    context, trunk = robot.plant.CreateDefaultContext(), plan.trunk_yaw
    for k in range(0, len(SHORT), 73):
        turn = np.concatenate([trunk.angular_velocity[k], reference.base.velocity[k]])
        X_WB = RigidTransform(RotationMatrix(trunk.rotation[k]), reference.base.position[k])
        state = (reference.joint_position[k], reference.joint_velocity[k])
        robot.set_state(context, *state, X_WB, turn)
        plant = robot.plant
        com = plant.CalcCenterOfMassPositionInWorld(context)
        speed = plant.CalcCenterOfMassTranslationalVelocityInWorld(context)
        np.testing.assert_allclose(com, plan.com.position[k], atol=1e-10)
        np.testing.assert_allclose(speed, plan.com.velocity[k], atol=1e-10)
        for side, foot in plan.feet.items():
            X_WF = robot.sole(side).CalcPoseInWorld(context)
            V_WF = robot.sole(side).CalcSpatialVelocityInWorld(context)
            yaw = plan.yaw[side]
            np.testing.assert_allclose(X_WF.translation(), foot.position[k], atol=1e-10)
            np.testing.assert_allclose(X_WF.rotation().matrix(), yaw.rotation[k], atol=1e-10)
            np.testing.assert_allclose(V_WF.translational(), foot.velocity[k], atol=1e-9)
            np.testing.assert_allclose(V_WF.rotational(), yaw.angular_velocity[k], atol=1e-9)


@pytest.mark.parametrize("name", list(WALKS))
def test_accelerations_of_any_walk_are_the_derivatives(robot: Robot, name: str):
    h, middle = 1e-4, np.array([0.2, 0.85, 1.0, 1.5, 2.33, 2.5])
    time = np.sort(np.concatenate([middle - h, middle, middle + h, [0.0, 3.5]]))
    reference = make_reference(Walk(single_supports=2, **WALKS[name]), robot, time)
    k, base = np.searchsorted(time, middle), reference.base
    for rate, acceleration in (
        (reference.joint_velocity, reference.joint_acceleration),
        (base.velocity, base.acceleration),
    ):
        difference = (rate[k + 1] - rate[k - 1]) / (2 * h)
        np.testing.assert_allclose(difference, acceleration[k], atol=2e-4)


def test_a_point_mass_balances_on_the_zmp_of_any_walk(other: tuple[Walk, Reference]):
    """Inertia and gravity of the CoM have no horizontal moment about the ZMP, which lies on the
    ground, or on the line through the footholds."""
    walk, plan = other[0], other[1].plan
    ascent = walk.step_rise / walk.step_length if walk.step_rise else 0.0
    height = ascent * (plan.zmp[:, 0] - walk.start - walk.zmp_forward)
    arm = plan.com.position - np.column_stack([plan.zmp, height])
    moment = np.cross(arm, plan.com.acceleration - plan.gravity)
    np.testing.assert_allclose(moment[:, :2], 0, atol=1e-8)


def test_feedforward_and_the_ground_carry_the_robot(robot: Robot, other: tuple[Walk, Reference]):
    """The ground's forces that are left when the joints give the feed-forward have their ZMP under
    the feet that stand: the base's rows of the equation of motion close with them alone."""
    reference, plan, plant = other[1], other[1].plan, robot.plant
    context, forces = plant.CreateDefaultContext(), MultibodyForces(plant)
    start, trunk = robot.base.floating_velocities_start_in_v(), plan.trunk_yaw
    for k in range(0, len(SHORT), 73):
        turn = np.concatenate([trunk.angular_velocity[k], reference.base.velocity[k]])
        X_WB = RigidTransform(RotationMatrix(trunk.rotation[k]), reference.base.position[k])
        state = (reference.joint_position[k], reference.joint_velocity[k])
        robot.set_state(context, *state, X_WB, turn)
        plant.mutable_gravity_field().set_gravity_vector(plan.gravity)
        plant.CalcForceElementsContribution(context, forces)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -9.81])
        rate = np.zeros(plant.num_velocities())
        rate[start : start + 3] = trunk.angular_acceleration[k]
        rate[start + 3 : start + 6] = reference.base.acceleration[k]
        rate[robot.velocity_index] = reference.joint_acceleration[k]
        left = plant.CalcInverseDynamics(context, rate, forces)
        left[robot.velocity_index] -= reference.feedforward_torque[k]
        # Wrenches of the feet that stand, by least squares over all rows.
        world, columns = plant.world_frame(), []
        for side in plan.feet:
            if plan.support(side)[k]:
                J = plant.CalcJacobianSpatialVelocity(
                    context, JacobianWrtVariable.kV, robot.sole(side), [0, 0, 0], world, world
                )
                columns.append(J.T)
        J_T = np.hstack(columns)
        wrench = np.linalg.lstsq(J_T, left, rcond=None)[0]
        np.testing.assert_allclose(J_T @ wrench, left, atol=1e-6)
        for moment, force in wrench.reshape(-1, 2, 3):
            if force[2] > 1.0:
                assert np.abs(moment[:2] / force[2]).max() < 0.1


def test_swing_feet_clear_the_edges_of_the_stairs(robot: Robot):
    """With treads as deep as a step, edges in the middle between footholds."""
    walk = Walk(
        step_length=0.26,
        step_rise=0.04,
        step_height=0.03,
        com_height=0.58,
        single_support=1.0,
        single_supports=2,
    )
    plan = make_reference(walk, robot, SHORT).plan
    edges = walk.start + 0.13 + 0.26 * np.arange(walk.single_supports - 1)
    for side, foot in plan.feet.items():
        pads = foot.position[:, None] + robot.pad_positions(side)
        ground = 0.04 * np.searchsorted(edges, pads[:, :, 0])
        assert (pads[:, :, 2] - ground).min() > -1e-9


def test_stairs_are_where_they_are_said_to_be():
    builder = DiagramBuilder()
    stairs = Stairs(begin=0.4, depth=0.25, rise=0.05, count=3)
    _, scene_graph = make_robot("biped", builder=builder, ground=Ground(stairs=stairs))
    diagram = builder.Build()
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    for x, height in ((0.39, 0.0), (0.41, 0.05), (0.64, 0.05), (0.66, 0.1), (5.0, 0.15)):
        below, above = (
            min(
                found.distance
                for found in query.ComputeSignedDistanceToPoint([x, 3.0, height + offset])
            )
            for offset in (-1e-3, 1e-3)
        )
        assert (below, above) == (pytest.approx(-1e-3), pytest.approx(1e-3))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"step_rise": 0.03, "step_turn": 0.1}, "straight ahead"),
        ({"step_rise": 0.03, "step_length": 0.0}, "straight ahead"),
        ({"slope": [0.1]}, "expected two numbers"),
    ],
)
def test_walks_that_make_no_sense_are_refused(changes: dict[str, object], told: str):
    with pytest.raises(InputError, match=told):
        Walk(**changes)


def test_feet_of_a_leg_can_be_tilted(robot: Robot):
    """The inverse holds for any attitude of the foot, also one the walk never uses."""
    leg = LegKinematics.from_robot(robot, "right")
    R = Rotation.from_euler("xyz", [[0.1, -0.2, 0.3]]).as_matrix()
    p = leg.offsets[0] + np.array([[0.05, -0.02, -0.6]])
    pose = leg.forward(leg.inverse(R, p))
    np.testing.assert_allclose(pose.R_BF, R, atol=1e-12)
    np.testing.assert_allclose(pose.p_BF, p, atol=1e-12)
