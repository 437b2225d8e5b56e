"""Kinematics of a leg of n revolute joints, whatever their axes: six that turn and move a flat
foot, or three that move a point foot.

A leg with hip yaw, roll, pitch in one point, knee pitch, and ankle pitch, roll in one point has a
closed inverse; any other is inverted by Newton's method. All functions work on arrays over time. B
is the base frame, F the sole frame; quantities are expressed in B's axes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from pydrake.multibody.tree import RevoluteJoint
from scipy.spatial.transform import Rotation

from fbse_drake.errors import InputError
from fbse_drake.robot.description import Leg
from fbse_drake.robot.plant import Robot

# Axes of the leg with a closed inverse.
_CLOSED_AXES = np.array(
    [[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=float
)
_AXIS_TOLERANCE = 1e-9
# A sole's pose is found to this [rad, m].
_POSE_TOLERANCE = 1e-12
_MAX_ITERATIONS = 100


class UnreachableError(ValueError):
    """A foot pose that the leg cannot reach; holds the index in time."""

    def __init__(self, index: int, reason: str):
        super().__init__(reason)
        self.index = index


@dataclass(frozen=True)
class LegMotion:
    """A leg's motion relative to its base, N samples."""

    # Sole: rotation (N, 3, 3), position (N, 3) [m].
    R_BF: np.ndarray
    p_BF: np.ndarray
    # Jacobian of the sole's spatial velocity [angular, linear], (N, 6, n), and its rate times the
    # joint velocity, (N, 6).
    J: np.ndarray
    Jdot_v: np.ndarray
    # First moment of mass (mass times centre of mass), (N, 3) [kg m], with Jacobian (N, 3, n) and
    # bias (N, 3).
    moment: np.ndarray
    J_moment: np.ndarray
    Jdot_v_moment: np.ndarray


@dataclass(frozen=True)
class LegKinematics:
    """Geometry and masses of one leg, read from the plant by `from_robot`; all vectors in B's axes,
    in the zero posture."""

    # Unit axes of the joints, from hip to foot, shape (n, 3).
    axes: np.ndarray
    # First joint in B; then from joint to joint, last from the last joint to the sole; shape
    # (n + 1, 3) [m].
    offsets: np.ndarray
    # Attitude of the sole, R_BF, shape (3, 3).
    sole: np.ndarray
    # Mass that moves with each joint but not the next [kg], (n,), and its centre from the joint,
    # (n, 3) [m].
    masses: np.ndarray
    centers: np.ndarray
    # Near which it stands [rad], shape (n,): which way a knee bends.
    stance: np.ndarray
    # Which of a twist [angular, linear] of the sole its joints determine: all of a flat foot, what
    # is linear of a point foot.
    ruled: slice

    @classmethod
    def from_robot(cls, robot: Robot, side: str) -> "LegKinematics":
        """Raises InputError where the leg has not six revolute joints (with a point foot three),
        one behind the other, that begin at the base."""
        plant, leg = robot.plant, robot.description.legs[side]
        context = plant.CreateDefaultContext()
        robot.set_joint_positions(context, np.zeros(len(robot.joint_names)))
        base = robot.base.body_frame()
        named = [plant.GetJointByName(name) for name in leg.joints]
        joints = [joint for joint in named if isinstance(joint, RevoluteJoint)]
        ruled, needed = (slice(3, 6), "three") if leg.is_point else (slice(0, 6), "six")
        if not len(joints) == len(named) == ruled.stop - ruled.start:
            raise InputError(
                f"legs.{side}.joints: a walking robot's leg needs {needed} revolute joints, found "
                f"{len(named)} joints"
            )
        if leg.is_point and np.linalg.norm(robot.pad_positions(side)) > _AXIS_TOLERANCE:
            raise InputError(f"legs.{side}.sole: expected the origin of a point foot in its pad")
        X_BJ = [joint.frame_on_parent().CalcPose(context, base) for joint in joints]
        axes = np.array(
            [X.rotation() @ joint.revolute_axis() for X, joint in zip(X_BJ, joints, strict=True)]
        )
        sole = robot.sole(side).CalcPose(context, base)
        origins = np.array([X.translation() for X in X_BJ] + [sole.translation()])
        moved = [set(plant.GetBodiesKinematicallyAffectedBy([joint.index()])) for joint in joints]
        carried = {robot.sole(side).body().index()}
        if not all(after <= before for before, after in pairwise([*moved, carried])):
            raise InputError(
                f"legs.{side}.joints: expected them from hip to foot, one behind the other, found "
                f"{', '.join(leg.joints)}"
            )
        for name in robot.description.joints:
            if carried <= set(
                plant.GetBodiesKinematicallyAffectedBy([plant.GetJointByName(name).index()])
            ):
                raise InputError(
                    f"joints: {name} carries the {side} leg; a walking robot's legs begin at its "
                    "base"
                )
        moved.append(set())
        masses, centers = [], []
        for i, origin in enumerate(origins[:-1]):
            bodies = [plant.get_body(index) for index in moved[i] - moved[i + 1]]
            mass = sum(body.get_mass(context) for body in bodies)
            moment = sum(
                body.get_mass(context)
                * (
                    body.body_frame().CalcPose(context, base)
                    @ body.CalcCenterOfMassInBodyFrame(context)
                )
                for body in bodies
            )
            masses.append(mass)
            centers.append(moment / mass - origin if mass > 0 else np.zeros(3))
        return cls(
            # An axis along one of the base's is exactly so.
            np.where(np.abs(axes - axes.round()) < _AXIS_TOLERANCE, axes.round() + 0.0, axes),
            np.diff(origins, axis=0, prepend=np.zeros((1, 3))),
            sole.rotation().matrix(),
            np.array(masses),
            np.array(centers),
            _stance(robot, leg),
            ruled,
        )

    @property
    def joints(self) -> int:
        """How many there are."""
        return len(self.axes)

    @cached_property
    def has_closed_inverse(self) -> bool:
        """Are the hip's axes z, x, y in one point, knee and ankle straight below, the ankle's axes
        y, x in one point, the sole level?"""
        if not np.array_equal(self.axes, _CLOSED_AXES):
            return False
        in_line = np.concatenate([self.offsets[[1, 2, 5]].ravel(), self.offsets[3:5, :2].ravel()])
        return np.allclose(in_line, 0, atol=_AXIS_TOLERANCE) and np.allclose(
            self.sole, np.eye(3), atol=_AXIS_TOLERANCE
        )

    def inverse(
        self, R_BF: np.ndarray, p_BF: np.ndarray, start: np.ndarray | None = None
    ) -> np.ndarray:
        """Joint angles that put the sole at a pose; the knee bent as its range has it.

        Args:
            R_BF, p_BF: sole's pose in the base, shapes (N, 3, 3) and (N, 3) [m]; how a point foot
                is turned does not matter.
            start: angles near the solution, shape (N, n) [rad], if known; by default the
                description's `stance`.

        Returns:
            Angles from hip to foot, shape (N, n) [rad].

        Raises:
            UnreachableError: the leg is too short or too long for a pose.
        """
        if self.has_closed_inverse:
            return self._closed_inverse(R_BF, p_BF)
        # Levenberg-Marquardt, damped by the error itself: robust far away, quadratic near the
        # solution (Sugihara 2011, IEEE Transactions on Robotics 27(5)).
        q = np.tile(self.stance, (len(p_BF), 1)) if start is None else start
        for _ in range(_MAX_ITERATIONS):
            R, p, J = self._pose(q)
            J, error = J[:, self.ruled], p_BF - p
            if J.shape[1] == 6:
                turn = Rotation.from_matrix(R_BF @ R.transpose(0, 2, 1)).as_rotvec()
                error = np.concatenate([turn, error], axis=1)
            size = np.linalg.norm(error, axis=1)
            if size.max() < _POSE_TOLERANCE:
                return q
            normal = J @ J.transpose(0, 2, 1) + (0.5 * size**2)[:, None, None] * np.eye(self.joints)
            q = q + np.einsum("nji,nj->ni", J, np.linalg.solve(normal, error[:, :, None])[:, :, 0])
        worst = int(size.argmax())
        raise UnreachableError(worst, f"the leg misses it by {size[worst]:.3f} m or rad")

    def _closed_inverse(self, R_BF: np.ndarray, p_BF: np.ndarray) -> np.ndarray:
        """Knee bent forward."""
        a, b = -self.offsets[3, 2], -self.offsets[4, 2]
        p_ankle = p_BF - R_BF @ self.offsets[6]
        # From ankle to hip, in the sole's axes.
        r = np.einsum("nij,ni->nj", R_BF, self.offsets[0] - p_ankle)
        distance = np.linalg.norm(r, axis=1)
        for limit, violation in ((a + b, distance - (a + b)), (abs(a - b), abs(a - b) - distance)):
            if violation.max() > 0:
                worst = int(violation.argmax())
                raise UnreachableError(
                    worst, f"hip to ankle {distance[worst]:.3f} m, the leg allows {limit:.3f} m"
                )
        knee = np.arccos(np.clip((distance**2 - a**2 - b**2) / (2 * a * b), -1, 1))
        ankle_roll = np.arctan2(r[:, 1], r[:, 2])
        lean = np.arctan2(-a * np.sin(knee), b + a * np.cos(knee))
        ankle_pitch = lean - np.arctan2(r[:, 0], np.hypot(r[:, 1], r[:, 2]))
        # What the three hip joints must add: Rz(yaw) Rx(roll) Ry(pitch).
        hip = (
            R_BF
            @ _rotation(self.axes[5], -ankle_roll)
            @ _rotation(self.axes[4], -(knee + ankle_pitch))
        )
        hip_yaw = np.arctan2(-hip[:, 0, 1], hip[:, 1, 1])
        hip_roll = np.arctan2(hip[:, 2, 1], np.hypot(hip[:, 0, 1], hip[:, 1, 1]))
        hip_pitch = np.arctan2(-hip[:, 2, 0], hip[:, 2, 2])
        return np.stack([hip_yaw, hip_roll, hip_pitch, knee, ankle_pitch, ankle_roll], axis=1)

    def _pose(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sole's rotation (N, 3, 3), position (N, 3) and Jacobian (N, 6, n) for angles q (N, n)."""
        R, p, axes, origins = (
            np.broadcast_to(np.eye(3), (len(q), 3, 3)),
            np.zeros((len(q), 3)),
            [],
            [],
        )
        for i in range(self.joints):
            p = p + R @ self.offsets[i]
            axes.append(R @ self.axes[i])
            origins.append(p)
            R = R @ _rotation(self.axes[i], q[:, i])
        p = p + R @ self.offsets[-1]
        return R @ self.sole, p, _jacobian(axes, origins, p)

    def _links(
        self, q: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Of each link, from base to foot: its joint's place from the joint before, and from the
        base, and axis, (N, 3) each, and its rotation (N, 3, 3)."""
        R, position = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        for i in range(self.joints):
            r = R @ self.offsets[i]
            position = position + r
            axis = R @ self.axes[i]
            R = R @ _rotation(self.axes[i], q[:, i])
            yield r, position, axis, R

    def forward(self, q: np.ndarray, v: np.ndarray | None = None) -> LegMotion:
        """Sole pose, Jacobians and mass distribution for angles q and rates v, shapes
        (N, n) [rad, rad/s]; without rates, nothing moves."""
        links = list(self._links(q))
        axes, origins = [axis for *_, axis, _ in links], [origin for _, origin, *_ in links]
        R = links[-1][3]
        sole = origins[-1] + R @ self.offsets[-1]
        # First moments of mass of what moves with each joint, from foot to hip.
        J_moment = np.empty((len(q), 3, self.joints))
        mass, moment = 0.0, np.zeros((len(q), 3))
        for i, (_, origin, axis, R_BL) in reversed(list(enumerate(links))):
            mass = mass + self.masses[i]
            moment = moment + self.masses[i] * (origin + R_BL @ self.centers[i])
            J_moment[:, :, i] = np.cross(axis, moment - mass * origin)
        twist, bias = (np.zeros((len(q), 6)), 0 * moment) if v is None else self._bias(links, v)
        return LegMotion(
            R @ self.sole, sole, _jacobian(axes, origins, sole), twist, moment, J_moment, bias
        )

    def _bias(
        self, links: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]], v: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`Jdot_v` and `Jdot_v_moment`: motion for rates v and zero joint accelerations, recursed
        from base to foot."""
        omega, alpha, bias, bias_moment = np.zeros((4, len(v), 3))

        def carried(r: np.ndarray) -> np.ndarray:
            return bias + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))

        for i, (r, _, axis, R) in enumerate(links):
            bias = carried(r)
            alpha = alpha + np.cross(omega, axis) * v[:, i, None]
            omega = omega + axis * v[:, i, None]
            bias_moment = bias_moment + self.masses[i] * carried(R @ self.centers[i])
        bias = carried(R @ self.offsets[-1])
        return np.concatenate([alpha, bias], axis=1), bias_moment


def _stance(robot: Robot, leg: Leg) -> np.ndarray:
    """Angles near which a leg stands, (n,) [rad]: the description's, else the middle of a range."""
    names = robot.description
    known = names.per_joint(names.stance, key="stance", default=np.nan)
    given = dict(zip(names.joint_names, known, strict=True))
    joints = [robot.plant.GetJointByName(name) for name in leg.joints]
    middle = [
        0.5 * (joint.position_lower_limits().item() + joint.position_upper_limits().item())
        for joint in joints
    ]
    stance = [given[name] for name in leg.joints]
    chosen = np.where(np.isnan(stance), middle, stance)
    return np.nan_to_num(chosen, nan=0.0, posinf=0.0, neginf=0.0)


def _jacobian(axes: list[np.ndarray], origins: list[np.ndarray], point: np.ndarray) -> np.ndarray:
    """Of a point's spatial velocity [angular, linear] with respect to the rates about the axes
    through the origins, (N, 6, joints)."""
    return np.stack(
        [
            np.concatenate([e, np.cross(e, point - o)], axis=1)
            for e, o in zip(axes, origins, strict=True)
        ],
        axis=2,
    )


def _rotation(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotation matrices about a fixed unit axis, shape (N, 3, 3)."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    parts = np.stack([np.eye(3), K, K @ K]).reshape(3, 9)
    weights = np.stack([np.ones_like(angle), np.sin(angle), 1 - np.cos(angle)], axis=-1)
    return (weights @ parts).reshape(-1, 3, 3)
