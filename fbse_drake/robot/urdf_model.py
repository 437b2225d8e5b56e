"""A URDF as `fbse init` looks at it: its legs, and where its shapes are."""

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)

from fbse_drake.errors import InputError
from fbse_drake.robot.bare_urdf import bare_urdf
from fbse_drake.robot.shapes import link_points

# The instance that holds the robot: the first after Drake's own two.
_MODEL = ModelInstanceIndex(2)
# A leg ends no higher above the lowest end than this share of the robot's height.
_LOW = 0.15
# Of a body that is no link: the world's.
_NO_SHAPES = ElementTree.Element("link")


@dataclass(frozen=True)
class Chain:
    """Joints from the base to an end that carries nothing that moves."""

    joints: list[Joint]
    foot: RigidBody
    # Of the foot's lowest point in the base's frame, [m].
    height: float
    # Of its first joint.
    hip: np.ndarray


class UrdfModel:
    """A URDF's bodies and joints, in the zero posture until another is set.

    Raises:
        InputError: no URDF, or one in which nothing is free to move.
    """

    def __init__(self, urdf: Path):
        self.urdf, self.plant = urdf, MultibodyPlant(0.0)
        try:
            self.file = bare_urdf(urdf)
            self.links = {
                link.get("name", ""): link for link in ElementTree.parse(urdf).iter("link")
            }
            Parser(self.plant).AddModelsFromString(self.file.text, "urdf")
        except OSError as error:
            raise InputError(f"{urdf}: {error.strerror}") from None
        except (RuntimeError, ValueError, ElementTree.ParseError) as error:
            raise InputError(f"{urdf}: not a URDF: {str(error).splitlines()[0]}") from None
        self.plant.Finalize()
        self.context = self.plant.CreateDefaultContext()
        joints = [self.plant.get_joint(index) for index in self.plant.GetJointIndices(_MODEL)]
        one = (RevoluteJoint.kTypeName, PrismaticJoint.kTypeName)
        self.joints = [joint for joint in joints if joint.type_name() in one]
        roots = [body for body in self._bodies() if body.is_floating_base_body()]
        # A link called world is the world for Drake: what it carries is the base.
        self.is_fixed = not roots
        world = self.plant.world_body()
        self.base = (
            roots or [joint.child_body() for joint in joints if joint.parent_body() is world]
        )[0]
        if self.plant.CalcTotalMass(self.context) == 0.0:
            raise InputError(f"{urdf}: no link has a mass (<inertial>), so nothing would move it")

    def _bodies(self) -> list[RigidBody]:
        return [self.plant.get_body(index) for index in self.plant.GetBodyIndices(_MODEL)]

    def pose(self, body: RigidBody) -> np.ndarray:
        """Of a body in the base's frame, (4, 4)."""
        return body.body_frame().CalcPose(self.context, self.base.body_frame()).GetAsMatrix4()

    def fixed_to(self, body: RigidBody) -> list[RigidBody]:
        """A body and those that do not move against it."""
        return list(self.plant.GetBodiesWeldedTo(body))

    def points(self, body: RigidBody) -> np.ndarray:
        """Of the collision shapes of a body and what is fixed to it, or else of the visual ones, in
        the base's frame, (N, 3) [m]."""
        for kind in ("collision", "visual"):
            parts = [np.empty((0, 3))]
            for part in self.fixed_to(body):
                X_BP = self.pose(part)
                link = self.links.get(part.name(), _NO_SHAPES)
                local = link_points(link, kind, self.urdf, X_BP[:3, :3].T)
                parts.append(local @ X_BP[:3, :3].T + X_BP[:3, 3])
            points = np.vstack(parts)
            if len(points):
                break
        return points

    def chains(self) -> list[Chain]:
        """From the base to every end, those that share a joint with none other."""
        above = {joint.child_body().index(): joint for joint in self.joints}
        fixed = {
            body.index(): {other.index() for other in self.fixed_to(body)}
            for body in self._bodies()
        }
        carrying = set().union(*(fixed[joint.parent_body().index()] for joint in self.joints))
        found = []
        for joint in self.joints:
            if joint.child_body().index() in carrying:
                continue
            chain, body = [joint], joint.parent_body()
            while not fixed[body.index()] & fixed[self.base.index()]:
                (inner,) = (above[index] for index in fixed[body.index()] if index in above)
                chain.append(inner)
                body = inner.parent_body()
            lowest = min(self.pose(other)[2, 3] for other in self.fixed_to(joint.child_body()))
            hip = self.pose(chain[-1].child_body())[:3, 3]
            found.append(Chain(chain[::-1], joint.child_body(), float(lowest), hip))
        counts: dict[str, int] = {}
        for one in found:
            for joint in one.joints:
                counts[joint.name()] = counts.get(joint.name(), 0) + 1
        return [c for c in found if all(counts[joint.name()] == 1 for joint in c.joints)]

    def legs(self) -> list[Chain]:
        """Chains of equal length that end lowest; none if there is one alone."""
        chains = self.chains()
        if not chains:
            return []
        heights = [self.pose(body)[2, 3] for body in self._bodies()]
        limit = min(chain.height for chain in chains) + _LOW * float(np.ptp(heights))
        low = [chain for chain in chains if chain.height <= limit]
        lengths = [len(chain.joints) for chain in low]
        common = max(set(lengths), key=lengths.count)
        legs = [chain for chain in low if len(chain.joints) == common]
        return legs if len(legs) > 1 and common > 1 else []


def words(name: str) -> list[str]:
    """As `LHipYaw_joint` -> l, hip, yaw, joint."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]
