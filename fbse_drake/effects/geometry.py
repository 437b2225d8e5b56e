"""Effects on a robot's shape: where the model has its joints and its IMU, and how it is mounted.

The same lines change the plant that is simulated, the model that is believed, and the model that
the diagnosis tries out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from pydrake.multibody.tree import Frame, Joint

from fbse_drake.effects.effect import Effect, Parameter, in_library
from fbse_drake.errors import InputError, located
from fbse_drake.robot.plant import Robot, Shifts

# Joints that are closer to each other than this have no link between them that could be longer [m].
_SHORTEST_LINK = 0.02


@dataclass(frozen=True)
class GeometryEffect(Effect):
    """Base of the effects on a robot's shape; a subclass moves joints against the bodies that carry
    them, or the IMU, or tilts a base that is fixed."""

    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"
    # Does a file of links and joints say it?
    in_links: ClassVar[bool] = True

    @staticmethod
    def shifts(robot: Robot, target: str, values: np.ndarray) -> Shifts:
        """What is moved, and how far.

        Args:
            values: of the parameters for this target, shape (parameters,).

        Raises:
            InputError: the robot has no such body, or one that this does not act on.
        """
        raise NotImplementedError


def shifts(effects: Mapping[str, Effect], robot: Robot) -> Shifts:
    """What the geometry effects among some effects move, all together.

    Args:
        effects: by name, of any kind.
        robot: without them.

    Raises:
        InputError: unknown body, a value out of bounds.
    """
    joints: dict[str, np.ndarray] = {}
    imu, tilt = np.zeros(3), np.zeros(2)
    for name, effect in effects.items():
        if not isinstance(effect, GeometryEffect):
            continue
        values = effect.resolve(robot.description, key=f"effects.{name}")
        with located(f"effects.{name}: "):
            for target, of_target in zip(values.targets, values.linear.T, strict=True):
                moved = effect.shifts(robot, target, of_target)
                imu += moved.imu
                tilt += moved.tilt
                for joint, shift in moved.joints.items():
                    joints[joint] = joints.get(joint, 0.0) + shift
    return Shifts(joints, imu, tilt)


@in_library
@dataclass(frozen=True)
class LinkLength(GeometryEffect):
    """A link is longer than the model says, along the line from the joint that moves it to the next
    joint; its mass stays where it is."""

    description: ClassVar[str] = "A link is longer or shorter than the model says."
    signature: ClassVar[str] = (
        "Standing feet that move against each other as the leg swings, and forces under them on "
        "another lever."
    )
    experiment: ClassVar[str] = (
        "Stand on both feet, squat and sway: the legs and the ground are a closed chain."
    )
    parameters: ClassVar[dict[str, Parameter]] = {
        "length": Parameter("m", linear=True, plausible=(-0.02, 0.02), bounds=(-np.inf, np.inf))
    }

    length: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def suspected_bodies(robot: Robot) -> list[str]:
        """Links of legs, between two joints: feet on the ground show how long they are."""
        if not robot.has_floating_base:
            return []
        return [name for name in robot.body_names if _next_joint(robot, name) is not None]

    @staticmethod
    def shifts(robot: Robot, target: str, values: np.ndarray) -> Shifts:
        robot.body(target)
        following = _next_joint(robot, target)
        if following is None:
            links = ", ".join(name for name in robot.body_names if _next_joint(robot, name))
            raise InputError(f"{target}: expected a link between two joints (there are: {links})")
        joint, along = following
        return Shifts({joint.name(): values[0] * along / np.linalg.norm(along)})


@in_library
@dataclass(frozen=True)
class ImuPosition(GeometryEffect):
    """The IMU is this far from where the model has it, in the axes of the IMU frame."""

    description: ClassVar[str] = "The IMU sits elsewhere than the model says."
    signature: ClassVar[str] = (
        "Forces on the trunk that no foot feels, in proportion to how fast it begins to turn."
    )
    experiment: ClassVar[str] = "Sway and turn the trunk fast, to and fro, about all axes."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter(
            "m", linear=True, plausible=(-0.1, 0.1), bounds=(-np.inf, np.inf), belief=0.1
        )
        for axis in "xyz"
    }
    # Links stay where they are.
    in_links: ClassVar[bool] = False

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @staticmethod
    def shifts(robot: Robot, target: str, values: np.ndarray) -> Shifts:  # noqa: ARG004
        return Shifts(imu=values)


@in_library
@dataclass(frozen=True)
class BaseTilt(GeometryEffect):
    """A base that is fixed is not mounted level: it is turned by a rotation vector about world x
    and y. The world's frame stays fixed to the mount, and gravity is turned."""

    description: ClassVar[str] = "The mount of a machine on a fixed base is not level."
    signature: ClassVar[str] = (
        "Torque in all joints as of gravity from another direction, also in those whose axes the "
        "model has upright."
    )
    experiment: ClassVar[str] = "Move all joints slowly through many postures."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"
    needs_fixed_base: ClassVar[bool] = True
    linear_nearby: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter(
            "rad", linear=True, plausible=(-0.1, 0.1), bounds=(-np.pi, np.pi), belief=0.15
        )
        for axis in "xy"
    }
    # Links stay as they are.
    in_links: ClassVar[bool] = False

    x: float = 0.0
    y: float = 0.0

    @staticmethod
    def shifts(robot: Robot, target: str, values: np.ndarray) -> Shifts:  # noqa: ARG004
        return Shifts(tilt=values)


def _next_joint(robot: Robot, body: str) -> tuple[Joint, np.ndarray] | None:
    """The one joint that a body carries, and the way to it from the joint that moves the body, in
    the body's frame, (3,) [m]; None where there are not just these two joints, apart from each
    other."""
    joints = [robot.plant.GetJointByName(name) for name in robot.joint_names]
    moving = [joint for joint in joints if joint.child_body().name() == body]
    carried = [joint for joint in joints if joint.parent_body().name() == body]
    if len(moving) != 1 or len(carried) != 1:
        return None
    along = _place(carried[0].frame_on_parent()) - _place(moving[0].frame_on_child())
    return (carried[0], along) if np.linalg.norm(along) > _SHORTEST_LINK else None


def _place(frame: Frame) -> np.ndarray:
    return frame.GetFixedPoseInBodyFrame().translation()
