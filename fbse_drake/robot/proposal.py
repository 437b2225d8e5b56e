"""Proposes the description of a robot from its URDF: legs, soles, IMU.

The robot is looked at in its zero posture, which for most legged robots is standing upright.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fbse_drake.errors import InputError
from fbse_drake.robot.description import AddedFrame, Leg, RobotDescription
from fbse_drake.robot.point_feet import NoStanceError, propose_stance
from fbse_drake.robot.urdf_model import Chain, UrdfModel, words

# A sole is what of a foot is within this of its lowest point [m].
_FLAT = 0.004
# A frame is in the sole if it is no further from its plane [m], and its axes are along the base's.
_IN_SOLE, _PARALLEL = 0.003, 1e-3
# How many legs stand on points, and the joints that each has.
_ON_POINTS = ((4, 3), (6, 3))
# Angles that differ by less are the same [rad].
_SAME_ANGLE = 0.01
# Parts of an IMU frame's name, the better ones first.
_IMU_NAMES = ("imu", "gyro", "accelerometer")


@dataclass(frozen=True)
class Proposal:
    """A description, and what its reader should know of it."""

    description: RobotDescription
    remarks: list[str] = field(default_factory=list)


def propose(urdf: Path, file: str) -> Proposal:
    """A description of the robot of a URDF.

    Two legs of six joints become legs with soles, two or three pairs of legs of three joints legs
    on point feet; of every other robot all joints become `joints`.

    Args:
        urdf: its file.
        file: how the description is to name it.

    Raises:
        InputError: no URDF, or a foot of which nothing says where it meets the ground.
    """
    model = UrdfModel(urdf)
    if not model.joints:
        raise InputError(f"{urdf}: no joint turns or slides")
    legs, imu = [] if model.is_fixed else model.legs(), _imu(model)
    remarks = [f"{remark}." for remark in model.file.remarks]
    if imu:
        remarks.append(f"IMU: {imu}.")
    elif legs:
        remarks.append("No frame is called IMU: it measures in the base's axes.")
    imu = imu or (model.base.name() if legs else "")
    kind = (len(legs), len(legs[0].joints)) if legs else None
    found: list[str]
    try:
        if kind == (2, 6):
            description, found = _on_soles(model, legs, file, imu)
        elif kind in _ON_POINTS:
            description, found = _on_points(model, legs, file, imu)
        else:
            description, found = _swinging(model, file), _no_legs_to_stand_on(model, legs)
    except NoStanceError as error:
        description, found = _swinging(model, file), [f"It only swings: {error}."]
    remarks += found
    others = {joint.name() for joint in model.joints} - set(description.joint_names)
    following = others & set(model.file.mimicking)
    if following:
        remarks.append(f"Joints that follow others are held at 0: {', '.join(sorted(following))}.")
    if held := len(others - following):
        remarks.append(f"{held} joints that are no leg's are held at 0 (see `held`).")
    return Proposal(description, remarks)


def _no_legs_to_stand_on(model: UrdfModel, legs: list[Chain]) -> list[str]:
    """Why a robot does not stand; nothing of one that is fixed to the world."""
    if model.is_fixed:
        return []
    needed = "a robot on two legs of six, or four of three, would stand"
    if not legs:
        return [f"No legs were found; {needed}."]
    joints = len(legs[0].joints)
    alike = sum(len(chain.joints) == joints for chain in model.chains())
    if (alike, joints) in ((2, 6), *_ON_POINTS):
        return [
            f"{alike} chains of {joints} joints leave {model.base.name()}, of which only "
            f"{len(legs)} end low: do its axes point forwards (x) and up (z)? If not, fix a frame "
            "with such axes to it and make it the root."
        ]
    return [f"{len(legs)} legs of {joints} joints were found; {needed}."]


def _swinging(model: UrdfModel, file: str) -> RobotDescription:
    """Of a robot of which all joints are alike, but those that follow another one."""
    names = [j.name() for j in model.joints if j.name() not in model.file.mimicking]
    return RobotDescription(model.base.name(), urdf=file, fixed_base=model.is_fixed, joints=names)


def _on_soles(
    model: UrdfModel, legs: list[Chain], file: str, imu: str
) -> tuple[RobotDescription, list[str]]:
    """Of a robot on two flat feet; with what its reader should know."""
    legs.sort(key=lambda leg: (_named_side(leg), -leg.hip[1]))
    if legs[0].hip[1] < legs[1].hip[1]:
        raise InputError(
            f"{model.urdf}: {legs[0].joints[0].name()} is on the right of {model.base.name()}, "
            "whose axes "
            "must point forwards (x) and up (z): fix a frame with such axes to it and make it the "
            "root"
        )
    sides = ("left", "right")
    soles = [_sole(model, leg, side) for leg, side in zip(legs, sides, strict=True)]
    description = RobotDescription(
        model.base.name(),
        urdf=file,
        imu=imu,
        leg_joints=_roles([[joint.name() for joint in leg.joints] for leg in legs]),
        legs={
            side: Leg([j.name() for j in leg.joints], leg.foot.name(), name, corners=corners)
            for side, leg, (name, _, corners) in zip(sides, legs, soles, strict=True)
        },
        frames={name: frame for name, frame, _ in soles if frame is not None},
    )
    remarks = []
    for side, (name, frame, corners) in zip(sides, soles, strict=True):
        size = np.ptp(corners, axis=0)
        kind = "a frame was added" if frame else f"its frame is {name}"
        text = f"{side} sole: {1e3 * size[0]:.0f} by {1e3 * size[1]:.0f} mm; {kind}."
        remarks.append(text)
    return description, remarks


def _on_points(
    model: UrdfModel, legs: list[Chain], file: str, imu: str
) -> tuple[RobotDescription, list[str]]:
    """The same of one on point feet."""
    stance = propose_stance(model, legs)
    names = {side: [j.name() for j in leg.joints] for side, leg in stance.legs.items()}
    roles = _roles(list(names.values()))
    # What is the same in all legs is said once.
    angles = np.round(list(stance.angles.values()), 4)
    by_joint = {
        name: float(angle)
        for leg, row in zip(names.values(), angles, strict=True)
        for name, angle in zip(leg, row, strict=True)
    }
    common = dict(zip(roles, angles[0].tolist(), strict=True))
    is_common = np.ptp(angles, axis=0).max() < _SAME_ANGLE
    frames = {}
    for side, leg in stance.legs.items():
        X_BS = np.eye(4)
        X_BS[:3, 3] = stance.points[side]
        frames[f"{side}_foot_point"] = _added_frame(model, leg, X_BS)
    description = RobotDescription(
        model.base.name(),
        urdf=file,
        imu=imu,
        leg_joints=roles,
        legs={
            side: Leg(names[side], leg.foot.name(), point, corners=[[0.0, 0.0, 0.0]])
            for (side, leg), point in zip(stance.legs.items(), frames, strict=True)
        },
        stance=common if is_common else by_joint,
        frames=frames,
    )
    size = np.ptp(list(stance.points.values()), axis=0)
    text = f"{len(legs)} point feet, {size[0]:.3f} m from front to rear, {size[1]:.3f} m across."
    return description, [text, *stance.remarks]


def _named_side(leg: Chain) -> int:
    """-1 if the names of a leg's joints say left, 1 if right, 0 if nothing."""
    said = set(words(leg.joints[0].name()))
    return bool(said & {"r", "right"}) - bool(said & {"l", "left"})


def _imu(model: UrdfModel) -> str:
    """The frame of an IMU that is fixed to the base, or nothing."""
    names = [body.name() for body in model.fixed_to(model.base)]
    for part in _IMU_NAMES:
        for name in names:
            if part in name.lower():
                return name
    return ""


def _sole(
    model: UrdfModel, leg: Chain, side: str
) -> tuple[str, AddedFrame | None, list[list[float]]]:
    """Name of a sole's frame, the frame if it must be added, and the corners in it."""
    points = model.points(leg.foot)
    if not len(points):
        raise InputError(
            f"{model.urdf}: {leg.foot.name()} has no shape, so nothing says where the {side} foot "
            "meets the ground"
        )
    ground = points[:, 2].min()
    sole = points[points[:, 2] < ground + _FLAT]
    low, high = sole[:, :2].min(axis=0), sole[:, :2].max(axis=0)
    if min(high - low) < 0.01:
        raise InputError(
            f"{model.urdf}: {leg.foot.name()} meets the ground in a point or a line, in the zero "
            "posture: no sole can be told from that"
        )
    name, X_BS, frame = _sole_frame(model, leg, side, ground)
    corners = [
        [round(float(x - X_BS[0, 3]), 4), round(float(y - X_BS[1, 3]), 4), 0.0]
        for x in (high[0], low[0])
        for y in (high[1], low[1])
    ]
    return name, frame, corners


def _sole_frame(
    model: UrdfModel, leg: Chain, side: str, ground: float
) -> tuple[str, np.ndarray, AddedFrame | None]:
    for body in model.fixed_to(leg.foot):
        X_BS = model.pose(body)
        if abs(X_BS[2, 3] - ground) < _IN_SOLE and np.allclose(
            X_BS[:3, :3], np.eye(3), atol=_PARALLEL
        ):
            return body.name(), X_BS, None
    # Below the ankle, with the axes of the base.
    X_BS = np.eye(4)
    X_BS[:3, 3] = [*model.pose(leg.foot)[:2, 3], ground]
    return f"{side}_sole", X_BS, _added_frame(model, leg, X_BS)


def _added_frame(model: UrdfModel, leg: Chain, X_BS: np.ndarray) -> AddedFrame:
    """A frame on a foot that is at this pose in the base's axes."""
    X_FS = np.linalg.inv(model.pose(leg.foot)) @ X_BS
    angles = Rotation.from_matrix(X_FS[:3, :3]).as_euler("xyz")
    return AddedFrame(
        leg.foot.name(),
        [round(float(x), 6) + 0.0 for x in X_FS[:3, 3]],
        [round(float(angle), 9) + 0.0 for angle in angles],
    )


def _roles(legs: Sequence[Sequence[str]]) -> list[str]:
    """What the joints of all legs have in common in their names; numbers where that is nothing."""
    roles = []
    for names in zip(*legs, strict=True):
        first, *others = (words(name) for name in names)
        common = [word for word in first if all(word in other for other in others)]
        roles.append("_".join(word for word in common if word != "joint"))
    unique = len(set(roles)) == len(roles) and all(roles)
    safe = not set(roles) & {name for leg in legs for name in leg}
    return roles if unique and safe else [f"joint_{k + 1}" for k in range(len(roles))]
