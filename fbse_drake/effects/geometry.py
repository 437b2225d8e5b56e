"""Effects on a robot's shape: what the model's joints are placed by.

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
from fbse_drake.robot.plant import Robot

# Joints that are closer to each other than this have no link between them that could be longer [m].
_SHORTEST_LINK = 0.02


@dataclass(frozen=True)
class GeometryEffect(Effect):
    """Base of the effects on a robot's shape; a subclass moves joints against the bodies that carry
    them."""

    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"

    @staticmethod
    def suspected_bodies(robot: Robot) -> list[str]:
        """Bodies that the diagnosis tries it on."""
        raise NotImplementedError

    @staticmethod
    def joint_shifts(robot: Robot, body: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """How far joints are moved in the frames of the bodies that carry them, (3,) [m], by joint.

        Args:
            values: of the parameters for this body, shape (parameters,).

        Raises:
            InputError: the robot has no such body, or one that this does not act on.
        """
        raise NotImplementedError


def joint_shifts(effects: Mapping[str, Effect], robot: Robot) -> dict[str, np.ndarray]:
    """How far the geometry effects among some effects move joints, by joint.

    Args:
        effects: by name, of any kind.
        robot: without them.

    Raises:
        InputError: unknown body, a value out of bounds.
    """
    result: dict[str, np.ndarray] = {}
    for name, effect in effects.items():
        if not isinstance(effect, GeometryEffect):
            continue
        values = effect.resolve(robot.description, key=f"effects.{name}")
        with located(f"effects.{name}: "):
            for body, of_body in zip(values.targets, values.linear.T, strict=True):
                for joint, shift in effect.joint_shifts(robot, body, of_body).items():
                    result[joint] = result.get(joint, 0.0) + shift
    return result


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
    def joint_shifts(robot: Robot, body: str, values: np.ndarray) -> dict[str, np.ndarray]:
        robot.body(body)
        following = _next_joint(robot, body)
        if following is None:
            links = ", ".join(name for name in robot.body_names if _next_joint(robot, name))
            raise InputError(f"{body}: expected a link between two joints (there are: {links})")
        joint, along = following
        return {joint.name(): values[0] * along / np.linalg.norm(along)}


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
