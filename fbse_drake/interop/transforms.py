"""Where the links of a log's robot are over time, and its model as text."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import LoadModelDirectives, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame
from scipy.spatial.transform import Rotation

from fbse_drake import schema
from fbse_drake.errors import InputError
from fbse_drake.interop.models import Link, links_of, urdf_of
from fbse_drake.log import Log
from fbse_drake.robot.description import load_description
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import RobotConfig, Scenario, build_robot

WORLD = "world"


@dataclass(frozen=True)
class Transform:
    """The pose of a frame in its parent's, over N samples or for good."""

    parent: str
    child: str
    # (N, 3) [m] and quaternions [x, y, z, w], (N, 4); of a frame that is fixed N is 1.
    translation: np.ndarray
    rotation: np.ndarray

    @property
    def is_fixed(self) -> bool:
        return len(self.translation) == 1


@dataclass(frozen=True)
class RobotFrames:
    """The frames of a log's robot, parents first, and its URDF with shapes as far as its model has
    them."""

    transforms: list[Transform]
    urdf: str


def robot_frames(log: Log) -> RobotFrames | None:
    """The frames of the robot of a log's scenario: of all links, soles (`<side>_sole`) and IMU
    (`imu`).

    The base is where `truth/base/...` says, or else `estimate/base/...`. None for a log of which
    nobody knows the robot, as a recording, or where its base was.
    """
    config = _robot_config(log)
    if config is None:
        return None
    try:
        links, _ = links_of(config)
        robot = build_robot(config)
    except InputError:
        return None
    kind = next((k for k in ("truth/", "estimate/") if f"{k}base/orientation" in log), None)
    if robot.joint_names != log.joints or (robot.has_floating_base and kind is None):
        return None
    known = kind == "truth/" and "truth/joint/position" in log
    q = log["truth/joint/position" if known else "joint/position"]
    transforms = []
    for link in links:
        if link.parent is None:
            xyzw = np.roll(log[f"{kind}base/orientation"], -1, axis=1)
            transforms.append(Transform(WORLD, link.name, log[f"{kind}base/position"], xyzw))
        else:
            moved = q[:, log.joints.index(link.joint)] if link.axis is not None else np.zeros(1)
            transforms.append(_joint_transform(link, moved))
    taken = {WORLD, *(link.name for link in links)}
    transforms += [frame for frame in _sensor_frames(robot) if frame.child not in taken]
    return RobotFrames(transforms, urdf_of(config, "robot", _shapes(config.description)))


def _robot_config(log: Log) -> RobotConfig | None:
    """The robot of the scenario that a log holds. Code that it names is not run."""
    text = log.meta.get("scenario")
    if not isinstance(text, str):
        return None
    try:
        tree = schema.parse(text, file="log")
        scenario = schema.build(Scenario, next(iter(tree.values())), file="log")
    except (InputError, AttributeError, StopIteration):
        # Of another version, or with effects of somebody's own.
        return None
    return scenario.robot


def _joint_transform(link: Link, moved: np.ndarray) -> Transform:
    """Of a link whose joint is moved so far, (N,) [rad or m]."""
    assert link.parent is not None
    R, p = link.X_PL.rotation().matrix(), link.X_PL.translation()
    along = np.zeros(3) if link.axis is None else link.axis.direction
    if link.axis is not None and link.axis.slides:
        place, turn = p + np.outer(moved, R @ along), np.zeros((len(moved), 3))
    else:
        place, turn = np.tile(p, (len(moved), 1)), np.outer(moved, along)
    rotation = Rotation.from_matrix(R) * Rotation.from_rotvec(turn)
    return Transform(link.parent, link.name, place, rotation.as_quat())


def _sensor_frames(robot: Robot) -> Iterator[Transform]:
    frames: dict[str, Frame] = {
        f"{side}_sole": robot.sole(side) for side in robot.description.sides
    }
    for name, frame in {**frames, "imu": robot.imu}.items():
        X: RigidTransform = frame.GetFixedPoseInBodyFrame()
        xyzw = np.roll(X.rotation().ToQuaternion().wxyz(), -1)[None]
        yield Transform(frame.body().name(), name, np.array(X.translation())[None], xyzw)


def _shapes(description: str) -> list[Element]:
    """Links and materials of a robot's URDF, for what is to be seen of them; none of an SDF."""
    names, path = load_description(description)
    if names.urdf:
        files = [path.parent / names.urdf]
    else:
        packages = Parser(MultibodyPlant(0.0)).package_map()
        packages.AddPackageXml(path.parent / "package.xml")
        directives = LoadModelDirectives(path.parent / names.directives).directives
        models = [directive.add_model for directive in directives if directive.add_model]
        files = [Path(packages.ResolveUrl(model.file)) for model in models]
    roots = [ElementTree.parse(file).getroot() for file in files if file.suffix == ".urdf"]
    return [part for root in roots for part in root if part.tag in ("link", "material")]
