"""Serial machines that nobody built: any number of joints about any axes."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from fbse_drake.files import write_text
from fbse_drake.robot.plant import Robot, make_robot

# Numbers of joints, and how often one slides.
_JOINTS, _RAILS = (2, 7), 0.12
# How far a joint swings to either side [rad], [m].
_SWING, _SLIDE = (0.3, 1.5), (0.08, 0.3)
# Of the first link of a machine of usual size [kg], [m]; each further link has this share of it.
_MASS, _LENGTH, _SMALLER = 10.0, 0.35, 0.75
# How much larger or smaller machines are.
_SCALE = (0.3, 3.0)
# Reflected inertia of the rotors over that of all links behind a joint.
_ROTOR = (0.05, 0.5)


@dataclass(frozen=True)
class Link:
    """A link and the joint before it."""

    name: str
    joint: str
    slides: bool
    axis: tuple[float, float, float]
    # Where the joint is in the frame of the link before [m].
    origin: tuple[float, float, float]
    mass: float
    centre: tuple[float, float, float]
    # Lengths of a box of uniform density [m].
    size: tuple[float, float, float]

    @property
    def moments(self) -> tuple[float, float, float]:
        """About the centre of mass, in the link's axes [kg m^2]."""
        x, y, z = np.square(self.size)
        return tuple(self.mass / 12 * np.array([y + z, x + z, x + y]))


@dataclass(frozen=True)
class Machine:
    """A serial machine on a fixed base, and how it swings."""

    links: tuple[Link, ...]
    # By joint.
    rotor_inertia: tuple[float, ...]
    posture: tuple[float, ...]
    amplitude: tuple[float, ...]
    # Rotation vector about x and y by which it is not mounted level [rad].
    tilt: tuple[float, float] = (0.0, 0.0)

    @property
    def joints(self) -> list[str]:
        return [link.joint for link in self.links]

    def rotors(self) -> dict[str, float]:
        return dict(zip(self.joints, self.rotor_inertia, strict=True))

    def description(self, folder: Path) -> Path:
        """Writes the robot's description and its URDF into a folder."""
        write_text(folder / "machine.urdf", _urdf(self.links, self.tilt))
        lines = ["urdf: machine.urdf", "base: base", "fixed_base: true"]
        write_text(
            folder / "machine.yaml", "\n".join([*lines, f"joints: [{', '.join(self.joints)}]", ""])
        )
        return folder / "machine.yaml"

    def robot(self, folder: Path) -> Robot:
        """With its rotors."""
        return make_robot(self.description(folder), rotor_inertia=self.rotors())[0]

    def with_link(self, number: int, **changes: object) -> "Machine":
        """The same with another link."""
        links = list(self.links)
        links[number] = replace(links[number], **changes)
        return replace(self, links=tuple(links))


def random_machine(random: np.random.Generator) -> Machine:
    """Of any size and shape; gravity may act along any of its joints, or along none."""
    count = int(random.integers(_JOINTS[0], _JOINTS[1] + 1))
    scale = float(np.exp(random.uniform(*np.log(_SCALE))))
    links = [_link(random, number, scale) for number in range(count)]
    swing = [random.uniform(*(_SLIDE if link.slides else _SWING)) for link in links]
    # What all links behind a joint have in all, roughly.
    reach = np.array([sum(link.mass for link in links[k:]) for k in range(count)])
    lever = np.array([1.0 if link.slides else 0.3 * scale for link in links])
    return Machine(
        tuple(links),
        tuple(random.uniform(*_ROTOR, count) * reach * lever**2),
        tuple(0.0 if link.slides else float(random.uniform(-1.0, 1.0)) for link in links),
        tuple(swing),
    )


def _link(random: np.random.Generator, number: int, scale: float) -> Link:
    smaller = _SMALLER**number
    length = scale * _LENGTH * smaller * float(random.uniform(0.6, 1.5))
    axis = np.eye(3)[random.integers(3)] if random.random() < 0.8 else random.normal(size=3)
    axis = axis / np.linalg.norm(axis)
    along = np.array([0.0, 0.0, length])
    wide = 0.3 * length
    return Link(
        f"link_{number + 1}",
        f"joint_{number + 1}",
        bool(random.random() < _RAILS),
        tuple(axis.tolist()),
        tuple((along + random.normal(scale=0.1 * length, size=3)).tolist()),
        _MASS * scale**3 * smaller**2 * float(random.uniform(0.6, 1.6)),
        tuple((0.5 * along + random.normal(scale=0.1 * length, size=3)).tolist()),
        (wide, wide, length),
    )


def _urdf(links: tuple[Link, ...], tilt: tuple[float, float]) -> str:
    robot = ElementTree.Element("robot", name="machine")
    ElementTree.SubElement(robot, "link", name="base")
    for before, link in zip(("base", *(link.name for link in links)), links, strict=False):
        body = ElementTree.SubElement(robot, "link", name=link.name)
        inertial = ElementTree.SubElement(body, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=_text(link.centre))
        ElementTree.SubElement(inertial, "mass", value=repr(float(link.mass)))
        moments = dict(zip(("ixx", "iyy", "izz"), map(repr, map(float, link.moments)), strict=True))
        products = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        ElementTree.SubElement(inertial, "inertia", moments | products)
        kind = "prismatic" if link.slides else "revolute"
        joint = ElementTree.SubElement(robot, "joint", name=link.joint, type=kind)
        ElementTree.SubElement(joint, "parent", link=before)
        ElementTree.SubElement(joint, "child", link=link.name)
        mount = Rotation.from_rotvec([*tilt, 0.0] if before == "base" else np.zeros(3))
        turned = {"xyz": _text(mount.apply(link.origin)), "rpy": _text(mount.as_euler("xyz"))}
        ElementTree.SubElement(joint, "origin", turned)
        ElementTree.SubElement(joint, "axis", xyz=_text(link.axis))
        limits = {"lower": "-6.3", "upper": "6.3", "effort": "1e5", "velocity": "100"}
        ElementTree.SubElement(joint, "limit", limits)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _text(vector: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in vector)
