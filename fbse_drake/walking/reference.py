"""Reference motions for the joints: inverse kinematics, feed-forward torque, and the Drake source
that plays them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from fbse_drake.errors import InputError, require_positive
from fbse_drake.log import Log
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Ground, Robot
from fbse_drake.walking.contact_forces import contact_forces, foot_weights
from fbse_drake.walking.leg_kinematics import LegKinematics, LegMotion, UnreachableError
from fbse_drake.walking.plan import PointMotion, TaskPlan
from fbse_drake.walking.stand import Squat, Sway, smooth_sine
from fbse_drake.walking.walk import Trot, Walk

# A sample that is late by less than this share of a step still belongs to it.
_EARLY = 0.1
# Legs that begin less far from each other are beside each other [m].
_SAME_PLACE = 1e-3
# The base position is found to this [m].
_COM_TOLERANCE = 1e-12
_MAX_ITERATIONS = 100
# Soles nearer to the ground than this are on it [m].
_STANDS = 1e-5


@dataclass(frozen=True)
class JointSines:
    """Every joint swings about a posture on its own: q = posture + amplitude
    sin(2 pi frequency t + phase), from rest to rest.

    For a robot on a gantry (`robot.gantry_height`); the feet are free.
    """

    # By joint: posture [rad], amplitude [rad], frequency [Hz], phase [rad].
    posture: dict[str, float] = field(default_factory=dict)
    amplitude: dict[str, float] = field(default_factory=dict)
    frequency: dict[str, float] = field(default_factory=lambda: {"all": 0.5})
    phase: dict[str, float] = field(default_factory=dict)
    # Time in which the motion swells and dies out [s].
    ramp: float = 2.0

    def __post_init__(self) -> None:
        require_positive(self, "ramp")


@dataclass(frozen=True)
class Recorded:
    """What the robot was asked for is in its log, or nobody knows: for recordings, which are
    compared with the model but not simulated without the log.
    """

    # Name of a number that the log keeps with each of its stretches and that multiplies the gains
    # of `control`, as `kp`.
    gain: str = ""


# Motions that are planned in task space.
_TaskMotion = Walk | Trot | Squat | Sway
ReferenceConfig = _TaskMotion | JointSines | Recorded


@dataclass(frozen=True)
class Reference:
    """A reference motion sampled at `time`, N samples; joint quantities of shape (N, n) in the
    description's joint order."""

    time: np.ndarray
    joint_position: np.ndarray
    joint_velocity: np.ndarray
    joint_acceleration: np.ndarray
    # What the model needs to follow the reference [Nm].
    feedforward_torque: np.ndarray
    base: PointMotion
    # None for motions that are not planned in task space.
    plan: TaskPlan | None

    def source(self, time_step: float) -> System:  # noqa: ARG002
        """What plays it, see `ReferenceSource`."""
        return ReferenceSource(self)

    def set_start(self, robot: Robot, ground: Ground) -> None:
        """Makes its start a robot's default positions: standing on the ground, also where its legs
        are not as long as those of the model it was planned with, and as deep as the ground carries
        the weight."""
        plant = robot.plant
        context = plant.CreateDefaultContext()
        if robot.has_floating_base:
            pads = sum(leg.points for leg in robot.description.legs.values())
            weight = -plant.CalcTotalMass(context) * plant.gravity_field().gravity_vector()[2]
            penetration = weight / (pads * ground.stiffness)
            X_WB = RigidTransform(self.base.position[0])
            plant.SetPositions(context, robot.base_pose_positions(X_WB))
            robot.set_joint_positions(context, self.joint_position[0])
            X_WB = self._stood(robot, context) @ X_WB
            sunk = RigidTransform(X_WB.rotation(), X_WB.translation() - [0.0, 0.0, penetration])
            plant.SetPositions(context, robot.base_pose_positions(sunk))
        robot.set_joint_positions(context, self.joint_position[0])
        plant.SetDefaultPositions(plant.GetPositions(context))

    def _stood(self, robot: Robot, context: Context) -> RigidTransform:
        """How a robot is to be moved for the soles that stand at the start to rest on the ground:
        raised and tilted as fits their pads best, with none of them under it."""
        stand = [
            side
            for side in robot.description.sides
            if self.plan is not None and self.plan.support(side)[0]
        ]
        soles = [robot.sole(side).CalcPoseInWorld(context) for side in stand]
        pads = [X_WF @ robot.pad_positions(side).T for side, X_WF in zip(stand, soles, strict=True)]
        p = np.hstack(pads) if pads else np.zeros((3, 1))
        if np.abs(p[2]).max() < _STANDS:
            return RigidTransform()
        centre = np.array([*p[:2].mean(axis=1), 0.0])
        x, y, z = p - centre[:, None]
        raised, roll, pitch = np.linalg.pinv(np.stack([np.ones_like(x), y, -x], axis=1)) @ -z
        tilt = RotationMatrix(RollPitchYaw(roll, pitch, 0.0))
        X = RigidTransform(tilt, centre - tilt @ centre + [0.0, 0.0, raised])
        lowest = (X @ p)[2].min()
        return RigidTransform(tilt, X.translation() - [0.0, 0.0, min(lowest, 0.0)])


@dataclass(frozen=True)
class RecordedReference:
    """What a robot was asked for while a log was recorded, whose start is time 0.

    Where the robot starts is not the reference's: who simulates sets it.
    """

    log: Log
    # Nobody knows what the motion was planned from.
    plan: None = None

    @property
    def time(self) -> np.ndarray:
        """Of the log's samples, (N,) [s]."""
        return self.log.time - self.log.time[0]

    @property
    def joint_position(self) -> np.ndarray:
        """Where the joints were, (N, n) [rad]."""
        return self.log["joint/position"]

    @property
    def joint_velocity(self) -> np.ndarray:
        """How the joints moved, (N, n) [rad/s]."""
        if "joint/velocity" in self.log or len(self.log.time) < 2:
            return self.log.get("joint/velocity", np.zeros_like(self.log["joint/position"]))
        return np.gradient(self.log["joint/position"], self.log.time, axis=0)

    @property
    def feedforward_torque(self) -> np.ndarray:
        """What moved them, as far as the log tells, (N, n) [Nm]."""
        return self.log.get("joint/torque_command", np.zeros_like(self.log["joint/position"]))

    def source(self, time_step: float) -> System:
        """What plays it on a plant with this step [s], see `RecordedSource`."""
        return RecordedSource(self.log, time_step)

    def set_start(self, robot: Robot, ground: Ground) -> None:  # noqa: ARG002
        """Raises InputError for a robot with a floating base, whose start no log tells."""
        if robot.has_floating_base:
            allowed = "a robot with a fixed base"
            raise InputError(f"reference: a recorded motion is only simulated for {allowed}")


def make_plan(config: ReferenceConfig, robot: Robot, time: np.ndarray) -> TaskPlan | None:
    """What feet and centre of mass of a robot are to do in a motion, without its joints.

    None if nobody knows it (`Recorded`) or if it is not planned in task space (`JointSines`).

    Args:
        config, robot, time: see `make_reference`.

    Raises:
        InputError: the ZMP is too near the edge of a foot, or the robot's base is fixed.
    """
    if isinstance(config, JointSines | Recorded):
        return None
    return _plan(config, robot, _legs(config, robot), time)


def make_reference(config: ReferenceConfig, robot: Robot, time: np.ndarray) -> Reference:
    """Plans a motion for a robot.

    Args:
        config: the motion.
        robot: the model (not what it will be played on): kinematics, masses and inverse dynamics.
        time: increasing sample times (N,) [s].

    Raises:
        InputError: a step out of reach, the ZMP too near the edge, a joint beyond its limits, an
            unknown joint.
    """
    if isinstance(config, Recorded):
        raise InputError(
            "a recorded motion is not simulated without its log: see fbse compare and fbse study"
        )
    if isinstance(config, JointSines):
        return _joint_sines(config, robot, time)
    legs = _legs(config, robot)
    plan = _plan(config, robot, legs, time)
    try:
        joint_motion, base, motions = _inverse_kinematics(
            robot, legs, plan, _posture(config.posture, robot.description)
        )
    except np.linalg.LinAlgError:
        raise InputError(
            "a leg is stretched out straight, where its joint velocities are not defined; lower "
            "com_height"
        ) from None
    _check_limits(robot, time, joint_motion.position, plan)
    torque = _feedforward(robot, plan, joint_motion, base, motions)
    return Reference(
        time,
        joint_motion.position,
        joint_motion.velocity,
        joint_motion.acceleration,
        torque,
        base,
        plan,
    )


def _legs(config: _TaskMotion, robot: Robot) -> dict[str, LegKinematics]:
    if not robot.has_floating_base:
        raise InputError(
            f"a robot with a fixed base cannot follow {type(config).__name__}; use JointSines"
        )
    return {side: LegKinematics.from_robot(robot, side) for side in robot.description.sides}


def _plan(
    config: _TaskMotion,
    robot: Robot,
    legs: Mapping[str, LegKinematics],
    time: np.ndarray,
) -> TaskPlan:
    corners = {side: robot.pad_positions(side) for side in legs}
    gravity = robot.plant.gravity_field().gravity_vector()
    return config.plan(time, _stance(legs), corners, gravity)


def _stance(legs: Mapping[str, LegKinematics]) -> dict[str, np.ndarray]:
    """Direction of each leg from the middle of the legs, (x, y), each +1, 0 or -1."""
    begins = np.array([leg.offsets[:, :2].sum(axis=0) for leg in legs.values()])
    away = begins - begins.mean(axis=0)
    away[np.abs(away) < _SAME_PLACE] = 0.0
    return dict(zip(legs, np.sign(away), strict=True))


def _posture(posture: Mapping[str, float], names: RobotDescription) -> np.ndarray:
    """Positions of all joints, those of the legs at zero, shape (n,)."""
    for joint in posture:
        if joint not in names.joints:
            raise InputError(
                f"posture.{joint}: expected a joint that is no leg's (there are: "
                f"{', '.join(names.joints) or 'none'})"
            )
    return names.per_joint(posture, key="posture", default=0.0)


def _inverse_kinematics(
    robot: Robot, legs: dict[str, LegKinematics], plan: TaskPlan, posture: np.ndarray
) -> tuple[PointMotion, PointMotion, dict[str, LegMotion]]:
    """Joints and base that put the robot's own CoM and the feet where the plan wants them; trunk
    level, other joints still."""
    plant, samples = robot.plant, len(plan.time)
    context = plant.CreateDefaultContext()
    total_mass = plant.CalcTotalMass(context)
    plant.SetPositions(context, robot.base_pose_positions(RigidTransform()))
    robot.set_joint_positions(context, posture)
    # The legs' first moment is known in closed form; what is left belongs to the base.
    rest = {side: leg.forward(np.zeros((1, leg.joints))).moment[0] for side, leg in legs.items()}
    base_moment = total_mass * plant.CalcCenterOfMassPositionInWorld(context) - sum(rest.values())

    trunk = plan.trunk_yaw
    R_BW = trunk.rotation.transpose(0, 2, 1)
    R_BF = {side: R_BW @ plan.yaw[side].rotation for side in legs}
    p_WB = plan.com.position.copy()
    q: dict[str, np.ndarray] = {}
    for _ in range(_MAX_ITERATIONS):
        for side, leg in legs.items():
            try:
                p_BF = _turned(R_BW, plan.feet[side].position - p_WB)
                q[side] = leg.inverse(R_BF[side], p_BF, start=q.get(side))
            except UnreachableError as found:
                raise InputError(_unreachable(plan, side, found)) from None
        # Feet: V_F - V_B = J qdot. CoM: cdot = v_B + J_moment qdot / m. All in the trunk's axes.
        still = {side: leg.forward(q[side]) for side, leg in legs.items()}
        inverse = {
            side: m.J_moment @ np.linalg.inv(m.J[:, legs[side].ruled]) / total_mass
            for side, m in still.items()
        }
        gain = {side: values[:, :, -3:] for side, values in inverse.items()}
        # How the CoM moves with the base while the feet stay.
        lever = np.eye(3) - sum(gain.values())
        moment = base_moment + sum(m.moment for m in still.values())
        error = plan.com.position - p_WB - _turned(trunk.rotation, moment / total_mass)
        if np.abs(error).max() < _COM_TOLERANCE:
            break
        step = np.linalg.solve(lever, _turned(R_BW, error)[:, :, None])[:, :, 0]
        p_WB = p_WB + _turned(trunk.rotation, step)
    else:
        raise InputError(
            f"no posture found for the planned CoM, {np.abs(error).max():.1e} m off; change "
            "com_height"
        )

    def solve(
        com: np.ndarray, feet: dict[str, np.ndarray], turning: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """How the base moves, and how the feet move relative to it, turning and moving (N, 6); or
        accelerate, each as a trunk sees it that only turns."""
        right = com
        for side, leg in legs.items():
            twist = np.hstack([turning[side], feet[side]])[:, leg.ruled]
            turned = _turned(inverse[side][:, :, :-3], twist[:, :-3])
            right = right - (_turned(gain[side], feet[side]) + turned)
        base = np.linalg.solve(lever, right[:, :, None])[:, :, 0]
        return base, {side: np.hstack([turning[side], feet[side] - base]) for side in legs}

    # The trunk turns: points that rest in its axes move and accelerate.
    w, w_dot = trunk.angular_velocity, trunk.angular_acceleration
    arm = {side: plan.feet[side].position - p_WB for side in legs}
    com_arm = plan.com.position - p_WB

    def seen(velocity: np.ndarray, arm: np.ndarray) -> np.ndarray:
        return _turned(R_BW, velocity - np.cross(w, arm))

    turning = {side: _turned(R_BW, plan.yaw[side].angular_velocity - w) for side in legs}
    v_WB, relative = solve(
        seen(plan.com.velocity, com_arm),
        {side: seen(plan.feet[side].velocity, arm[side]) for side in legs},
        turning,
    )
    v = {side: _solve_leg(leg, still[side].J, relative[side]) for side, leg in legs.items()}
    motions = {side: leg.forward(q[side], v[side]) for side, leg in legs.items()}
    com_velocity = seen(plan.com.velocity, com_arm) - v_WB
    # The same with accelerations; what the joint rates alone cause is taken off first.
    foot_bias, com_bias = {}, np.zeros((samples, 3))
    for side, motion in motions.items():
        solved = _solve_leg(legs[side], motion.J, motion.Jdot_v)
        foot_bias[side] = solved
        com_bias += (motion.Jdot_v_moment - _turned(motion.J_moment, solved)) / total_mass

    def felt(acceleration: np.ndarray, arm: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Less what the trunk's turning makes of a point that moves relative to it."""
        carried = np.cross(w_dot, arm) + np.cross(w, np.cross(w, arm))
        return _turned(R_BW, acceleration - carried) - 2.0 * np.cross(w, velocity)

    a_WB, relative = solve(
        felt(plan.com.acceleration, com_arm, com_velocity) - com_bias,
        {
            side: felt(plan.feet[side].acceleration, arm[side], relative[side][:, 3:])
            for side in legs
        },
        {side: _turned(R_BW, plan.yaw[side].angular_acceleration - w_dot) for side in legs},
    )
    a = {
        side: _solve_leg(leg, motions[side].J, relative[side]) - foot_bias[side]
        for side, leg in legs.items()
    }

    others = np.tile(posture[sum(leg.joints for leg in legs.values()) :], (samples, 1))
    joints = PointMotion(
        *(
            np.hstack([*values.values(), still])
            for values, still in ((q, others), (v, 0 * others), (a, 0 * others))
        )
    )
    v_WB, a_WB = (_turned(trunk.rotation, values) for values in (v_WB, a_WB))
    return joints, PointMotion(p_WB, v_WB, a_WB), motions


def _turned(A: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, k) times vectors (N, k)."""
    return np.einsum("nij,nj->ni", A, vectors)


def _solve_leg(leg: LegKinematics, J: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Joint rates (N, n) that give the sole a twist [angular, linear] (N, 6), as far as they rule
    it."""
    return np.linalg.solve(J[:, leg.ruled], twist[:, leg.ruled, None])[:, :, 0]


def _unreachable(plan: TaskPlan, side: str, error: UnreachableError) -> str:
    time = plan.time[error.index]
    number, _ = plan.phase_at(time)
    step = (number + 1) // 2
    where = f"step {step}" if step else "the starting posture"
    return (
        f"{where} ({side} leg, t = {time:.2f} s) is out of reach: {error}; "
        "shorten step_length or change com_height"
    )


def _check_limits(robot: Robot, time: np.ndarray, q: np.ndarray, plan: TaskPlan | None) -> None:
    lower = robot.plant.GetPositionLowerLimits()[robot.position_index]
    upper = robot.plant.GetPositionUpperLimits()[robot.position_index]
    excess = np.maximum(lower - q, q - upper)
    if excess.max() > 0:
        sample, joint = np.unravel_index(excess.argmax(), excess.shape)
        step = (
            f"step {(plan.phase_at(float(time[sample]))[0] + 1) // 2}, " if plan is not None else ""
        )
        unit = robot.position_units[joint]
        raise InputError(
            f"{step}t = {time[sample]:.2f} s: needs {robot.joint_names[joint]} at "
            f"{q[sample, joint]:.3f} {unit}, "
            f"its limits are {lower[joint]:.3f} to {upper[joint]:.3f} {unit}"
        )


def _feedforward(
    robot: Robot,
    plan: TaskPlan,
    joints: PointMotion,
    base: PointMotion,
    motions: dict[str, LegMotion],
) -> np.ndarray:
    """Joint torques that let the model follow the reference.

    Inverse dynamics gives the total contact wrench in its base rows, which the feet share.
    """
    plant, samples, trunk = robot.plant, len(plan.time), plan.trunk_yaw
    context = plant.CreateDefaultContext()
    forces = MultibodyForces(plant)
    positions = np.tile(robot.base_pose_positions(RigidTransform()), (samples, 1))
    pose = positions[:, robot.base.floating_positions_start() :]
    pose[:, 0], pose[:, 3] = np.cos(trunk.angle / 2), np.sin(trunk.angle / 2)
    pose[:, 4:7] = base.position
    positions[:, robot.position_index] = joints.position
    start = robot.base.floating_velocities_start_in_v()
    rates, accelerations = (
        np.zeros((samples, plant.num_velocities())),
        np.zeros((samples, plant.num_velocities())),
    )
    # Another gravity than the plant's is as if all accelerated by the difference.
    felt = base.acceleration + (plant.gravity_field().gravity_vector() - plan.gravity)
    for target, angular, linear, joint in (
        (rates, trunk.angular_velocity, base.velocity, joints.velocity),
        (accelerations, trunk.angular_acceleration, felt, joints.acceleration),
    ):
        target[:, start : start + 3] = angular
        target[:, start + 3 : start + 6] = linear
        target[:, robot.velocity_index] = joint
    generalized = np.empty((samples, plant.num_velocities()))
    for k in range(samples):
        plant.SetPositions(context, positions[k])
        plant.SetVelocities(context, rates[k])
        plant.CalcForceElementsContribution(context, forces)
        generalized[k] = plant.CalcInverseDynamics(context, accelerations[k], forces)

    # Total contact wrench: moment about the base origin and force, world axes.
    moment, force = generalized[:, start : start + 3], generalized[:, start + 3 : start + 6]
    on_two_soles = len(plan.feet) == 2 and not any(
        leg.is_point for leg in robot.description.legs.values()
    )
    share = _share_by_zmp if on_two_soles else _share_by_least_forces
    wrenches = share(robot, plan, base, moment, force)
    R_BW = trunk.rotation.transpose(0, 2, 1)
    torque, first = generalized[:, robot.velocity_index].copy(), 0
    for side, motion in motions.items():
        joints_of_leg = slice(first, first + motion.J.shape[2])
        M, F = (_turned(R_BW, part) for part in wrenches[side])
        wrench = np.concatenate([M, F], axis=1)
        torque[:, joints_of_leg] -= np.einsum("nji,nj->ni", motion.J, wrench)
        first = joints_of_leg.stop
    return torque


def _share_by_zmp(
    robot: Robot,  # noqa: ARG001
    plan: TaskPlan,
    base: PointMotion,
    moment: np.ndarray,
    force: np.ndarray,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Moments about the soles' origins and forces, in the world, of two flat feet.

    One weight per foot (`load_shares`); the centres of pressure are the points where the ZMP rests
    in each foot (`TaskPlan.anchor`), moved together so that the ZMP comes out exactly.

    Args:
        moment, force: what both together give, about the base's origin, (N, 3) each [Nm, N].
    """
    # Its ZMP: where the horizontal moment vanishes at the height of the feet that carry it.
    shares = load_shares(plan)
    ground = sum(shares[side] * plan.feet[side].position[:, 2] for side in plan.feet)
    height = (base.position[:, 2] - ground)[:, None]
    zmp = (
        base.position[:, :2]
        + (np.stack([-moment[:, 1], moment[:, 0]], axis=1) - height * force[:, :2]) / force[:, 2:]
    )
    offset = zmp - sum(shares[side][:, None] * plan.anchor(side) for side in plan.feet)
    spin = moment[:, 2] - (
        (zmp[:, 0] - base.position[:, 0]) * force[:, 1]
        - (zmp[:, 1] - base.position[:, 1]) * force[:, 0]
    )
    wrenches = {}
    for side, foot in plan.feet.items():
        F = shares[side][:, None] * force
        arm = np.zeros_like(F)
        arm[:, :2] = plan.anchor(side) + offset - foot.position[:, :2]
        M = np.cross(arm, F) + np.stack([0 * spin, 0 * spin, shares[side] * spin], axis=1)
        wrenches[side] = M, F
    return wrenches


def _share_by_least_forces(
    robot: Robot, plan: TaskPlan, base: PointMotion, moment: np.ndarray, force: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The same of any feet, see `contact_forces`; each pad is a point."""
    pads = {side: robot.pad_positions(side) for side in plan.feet}
    arms = {side: pads[side] @ plan.yaw[side].rotation.transpose(0, 2, 1) for side in pads}
    points = [plan.feet[side].position[:, None] + arms[side] for side in pads]
    counts = [len(places) for places in pads.values()]
    weights = np.repeat(foot_weights(plan), counts, axis=1)
    about_origin = moment + np.cross(base.position, force)
    wrench = np.concatenate([about_origin, force], axis=1)
    forces = contact_forces(wrench, np.concatenate(points, axis=1), weights)
    parts = np.split(forces, np.cumsum(counts)[:-1], axis=1)
    return {
        side: (np.cross(arms[side], part).sum(axis=1), part.sum(axis=1))
        for side, part in zip(pads, parts, strict=True)
    }


def load_shares(plan: TaskPlan) -> dict[str, np.ndarray]:
    """Load share of each foot, in [0, 1]; they sum to 1; (N,) each.

    The share follows the planned ZMP along the line between the points where it rests in each foot.
    """
    first, second = plan.feet
    between = plan.anchor(first) - plan.anchor(second)
    place = np.einsum("ni,ni->n", plan.zmp - plan.anchor(second), between) / np.einsum(
        "ni,ni->n", between, between
    )
    share = np.where(
        plan.support(first), np.where(plan.support(second), np.clip(place, 0.0, 1.0), 1.0), 0.0
    )
    return {first: share, second: 1.0 - share}


def _joint_sines(config: JointSines, robot: Robot, time: np.ndarray) -> Reference:
    if robot.has_floating_base:
        raise InputError("JointSines needs a robot with a fixed base (robot.gantry_height)")
    names = robot.description
    posture, amplitude, frequency, phase = (
        names.per_joint(getattr(config, key), key=key, default=0.0)
        for key in ("posture", "amplitude", "frequency", "phase")
    )
    motion = [np.empty((len(time), len(posture))) for _ in range(3)]
    for joint in range(len(posture)):
        for order, values in enumerate(
            smooth_sine(time, frequency[joint], config.ramp, float(time[-1]), phase[joint])
        ):
            motion[order][:, joint] = amplitude[joint] * values + (
                posture[joint] if order == 0 else 0.0
            )
    plant = robot.plant
    context, forces = plant.CreateDefaultContext(), MultibodyForces(plant)
    torque = np.empty_like(motion[0])
    rates, accelerations = np.zeros(plant.num_velocities()), np.zeros(plant.num_velocities())
    for k in range(len(time)):
        rates[robot.velocity_index], accelerations[robot.velocity_index] = (
            motion[1][k],
            motion[2][k],
        )
        robot.set_joint_positions(context, motion[0][k])
        plant.SetVelocities(context, rates)
        plant.CalcForceElementsContribution(context, forces)
        torque[k] = plant.CalcInverseDynamics(context, accelerations, forces)[robot.velocity_index]
    _check_limits(robot, time, motion[0], None)
    still = np.zeros((len(time), 3))
    X_WB = robot.base.EvalPoseInWorld(context)
    base = PointMotion(still + X_WB.translation(), still, still)
    position, velocity, acceleration = motion
    return Reference(time, position, velocity, acceleration, torque, base, None)


class ReferenceSource(Diagram):
    """Plays a reference.

    .. pydrake_system::

        name: ReferenceSource
        output_ports:
        - desired_state
        - feedforward_torque

    `desired_state` is [joint positions, joint velocities], shape (2n,) [rad, rad/s];
    `feedforward_torque` has shape (n,) [Nm]. Both are exact at the reference's sample times; before
    its start and after its end the robot is to stand still.
    """

    def __init__(self, reference: Reference):
        super().__init__()
        builder = DiagramBuilder()
        position = PiecewisePolynomial.CubicHermite(
            reference.time, reference.joint_position.T, reference.joint_velocity.T
        )
        torque = PiecewisePolynomial.FirstOrderHold(reference.time, reference.feedforward_torque.T)
        desired_state = builder.AddNamedSystem(
            "desired_state", TrajectorySource(position, output_derivative_order=1)
        )
        feedforward = builder.AddNamedSystem("feedforward_torque", TrajectorySource(torque))
        builder.ExportOutput(desired_state.get_output_port(), "desired_state")
        builder.ExportOutput(feedforward.get_output_port(), "feedforward_torque")
        builder.BuildInto(self)


class RecordedSource(Diagram):
    """Plays what a log says that its robot was asked for, each sample held until the next.

    .. pydrake_system::

        name: RecordedSource
        output_ports:
        - desired_state
        - feedforward_torque
        - enabled

    `desired_state` is [joint positions, joint velocities], shape (2n,) [rad, rad/s], at rest where
    the log has no velocities; `feedforward_torque` (n,) [Nm] and `enabled` (n,) (0 for a drive that
    is switched off) are there where the log has them.
    """

    def __init__(self, log: Log, time_step: float):
        """Reads the log.

        Args:
            log: with `reference/joint/position`.
            time_step: the plant's step [s].
        """
        super().__init__()
        builder = DiagramBuilder()
        position = log["reference/joint/position"]
        velocity = log.get("reference/joint/velocity", np.zeros_like(position))
        held = {
            "desired_state": np.hstack([position, velocity]),
            "feedforward_torque": log.get("reference/joint/feedforward_torque"),
            "enabled": log.get("joint/enabled"),
        }
        time = log.time - log.time[0] - _EARLY * time_step
        for name, values in held.items():
            if values is not None:
                hold = PiecewisePolynomial.ZeroOrderHold(time, values.T)
                source = builder.AddNamedSystem(name, TrajectorySource(hold))
                builder.ExportOutput(source.get_output_port(), name)
        builder.BuildInto(self)
