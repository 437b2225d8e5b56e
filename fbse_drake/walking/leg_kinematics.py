"""Analytic kinematics of a leg with hip yaw, roll, pitch in one point, knee pitch, and ankle pitch, roll in one point.

All functions work on arrays over time. B is the base frame, F the sole frame; quantities are expressed in B's axes.
"""

from dataclasses import dataclass

import numpy as np

from fbse_drake.errors import InputError
from fbse_drake.robot.plant import Robot

_AXES = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=float)
_AXIS_TOLERANCE = 1e-9


class UnreachableError(ValueError):
    """A foot pose that the leg cannot reach; holds the index in time and the distance asked for and allowed [m]."""

    def __init__(self, index: int, distance: float, limit: float):
        super().__init__(f"hip to ankle {distance:.3f} m, the leg allows {limit:.3f} m")
        self.index = index


@dataclass(frozen=True)
class LegMotion:
    """A leg's motion relative to its base, N samples."""

    # Sole: rotation (N, 3, 3), position (N, 3) [m].
    R_BF: np.ndarray
    p_BF: np.ndarray
    # Jacobian of the sole's spatial velocity [angular, linear], (N, 6, 6), and its rate times the joint velocity, (N, 6).
    J: np.ndarray
    Jdot_v: np.ndarray
    # First moment of mass (mass times centre of mass), (N, 3) [kg m], with Jacobian (N, 3, 6) and bias (N, 3).
    moment: np.ndarray
    J_moment: np.ndarray
    Jdot_v_moment: np.ndarray


@dataclass(frozen=True)
class LegKinematics:
    """Geometry and masses of one leg, read from the plant by `from_robot`."""

    # Hip centre in B; then from joint to joint, last from the ankle to the sole; shape (7, 3) [m], zero posture.
    offsets: np.ndarray
    # Mass that moves with each joint but not the next [kg], (6,), and its centre from the joint, (6, 3) [m], zero posture.
    masses: np.ndarray
    centers: np.ndarray

    @classmethod
    def from_robot(cls, robot: Robot, side: str) -> "LegKinematics":
        """Raises InputError where the leg is built otherwise than this module assumes."""
        plant, leg = robot.plant, robot.description.legs[side]
        context = plant.CreateDefaultContext()
        robot.set_joint_positions(context, np.zeros(len(robot.joint_names)))
        base = robot.base.body_frame()
        joints = [plant.GetJointByName(name) for name in leg.joints]
        X_BJ = [joint.frame_on_parent().CalcPose(context, base) for joint in joints]
        axes = np.array([X.rotation() @ joint.revolute_axis() for X, joint in zip(X_BJ, joints, strict=True)])
        sole = robot.sole(side).CalcPose(context, base)
        origins = np.array([X.translation() for X in X_BJ] + [sole.translation()])
        offsets = np.diff(origins, axis=0, prepend=np.zeros((1, 3)))
        if len(joints) != 6 or np.abs(axes - _AXES).max() > _AXIS_TOLERANCE:
            raise InputError(f"legs.{side}.joints: the analytic leg needs axes z, x, y, y, y, x from hip to foot, found {axes.tolist()}")
        if not (
            np.allclose(offsets[[1, 2, 5]], 0, atol=_AXIS_TOLERANCE)
            and np.allclose(offsets[3:5, :2], 0, atol=_AXIS_TOLERANCE)
            and sole.rotation().IsNearlyIdentity(_AXIS_TOLERANCE)
        ):
            raise InputError(
                f"legs.{side}: the analytic leg needs hip axes in one point, knee and ankle straight below it, "
                f"ankle axes in one point and a level sole in the zero posture"
            )
        moved = [set(plant.GetBodiesKinematicallyAffectedBy([joint.index()])) for joint in joints] + [set()]
        masses, centers = [], []
        for i, origin in enumerate(origins[:6]):
            bodies = [plant.get_body(index) for index in moved[i] - moved[i + 1]]
            mass = sum(body.get_mass(context) for body in bodies)
            moment = sum(
                body.get_mass(context) * (body.body_frame().CalcPose(context, base) @ body.CalcCenterOfMassInBodyFrame(context))
                for body in bodies
            )
            masses.append(mass)
            centers.append(moment / mass - origin if mass > 0 else np.zeros(3))
        return cls(offsets, np.array(masses), np.array(centers))

    @property
    def thigh(self) -> float:
        return float(-self.offsets[3, 2])

    @property
    def shank(self) -> float:
        return float(-self.offsets[4, 2])

    def inverse(self, R_BF: np.ndarray, p_BF: np.ndarray) -> np.ndarray:
        """Joint angles that put the sole at a pose; knee bent forward.

        Args:
            R_BF, p_BF: sole's pose in the base, shapes (N, 3, 3) and (N, 3) [m].

        Returns:
            Angles from hip yaw to ankle roll, shape (N, 6) [rad].

        Raises:
            UnreachableError: the leg is too short or too long for a pose.
        """
        a, b = self.thigh, self.shank
        p_ankle = p_BF - R_BF @ self.offsets[6]
        # From ankle to hip, in the sole's axes.
        r = np.einsum("nij,ni->nj", R_BF, self.offsets[0] - p_ankle)
        distance = np.linalg.norm(r, axis=1)
        for limit, violation in ((a + b, distance - (a + b)), (abs(a - b), abs(a - b) - distance)):
            if violation.max() > 0:
                worst = int(violation.argmax())
                raise UnreachableError(worst, float(distance[worst]), limit)
        knee = np.arccos(np.clip((distance**2 - a**2 - b**2) / (2 * a * b), -1, 1))
        ankle_roll = np.arctan2(r[:, 1], r[:, 2])
        lean = np.arctan2(-a * np.sin(knee), b + a * np.cos(knee))
        ankle_pitch = lean - np.arctan2(r[:, 0], np.hypot(r[:, 1], r[:, 2]))
        # What the three hip joints must add: Rz(yaw) Rx(roll) Ry(pitch).
        hip = R_BF @ _rotation(_AXES[5], -ankle_roll) @ _rotation(_AXES[4], -(knee + ankle_pitch))
        hip_yaw = np.arctan2(-hip[:, 0, 1], hip[:, 1, 1])
        hip_roll = np.arctan2(hip[:, 2, 1], np.hypot(hip[:, 0, 1], hip[:, 1, 1]))
        hip_pitch = np.arctan2(-hip[:, 2, 0], hip[:, 2, 2])
        return np.stack([hip_yaw, hip_roll, hip_pitch, knee, ankle_pitch, ankle_roll], axis=1)

    def forward(self, q: np.ndarray, v: np.ndarray | None = None) -> LegMotion:
        """Sole pose, Jacobians and mass distribution for angles q and rates v, shapes (N, 6) [rad, rad/s]."""
        samples = len(q)
        v = np.zeros_like(q) if v is None else v
        R = np.broadcast_to(np.eye(3), (samples, 3, 3))
        position, axes, origins = np.zeros((samples, 3)), [], []
        # Motion for the given rates and zero joint accelerations, recursed from base to foot.
        omega, alpha, bias = np.zeros((samples, 3)), np.zeros((samples, 3)), np.zeros((samples, 3))
        moment, J_moment, bias_moment = np.zeros((samples, 3)), np.zeros((samples, 3, 6)), np.zeros((samples, 3))

        def carried(r: np.ndarray) -> np.ndarray:
            return bias + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))

        for i in range(6):
            r = R @ self.offsets[i]
            bias, position = carried(r), position + r
            axis = R @ _AXES[i]
            axes.append(axis)
            origins.append(position)
            alpha = alpha + np.cross(omega, axis) * v[:, i, None]
            omega = omega + axis * v[:, i, None]
            R = R @ _rotation(_AXES[i], q[:, i])
            r = R @ self.centers[i]
            moment = moment + self.masses[i] * (position + r)
            bias_moment = bias_moment + self.masses[i] * carried(r)
            for j in range(i + 1):
                J_moment[:, :, j] += self.masses[i] * np.cross(axes[j], position + r - origins[j])
        r = R @ self.offsets[6]
        bias, position = carried(r), position + r
        J = np.stack([np.concatenate([e, np.cross(e, position - o)], axis=1) for e, o in zip(axes, origins, strict=True)], axis=2)
        return LegMotion(R, position, J, np.concatenate([alpha, bias], axis=1), moment, J_moment, bias_moment)


def _rotation(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotation matrices about a fixed unit axis, shape (N, 3, 3)."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle)[:, None, None] * K + (1 - np.cos(angle))[:, None, None] * (K @ K)
