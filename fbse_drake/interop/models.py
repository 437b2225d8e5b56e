"""A robot's model, with what was found of it, as files of other programs: URDF and MJCF (MuJoCo).

Both have the bodies with their inertia, as added masses and moved joints have changed it, rotor
inertia, viscous friction and Coulomb friction. What they cannot say, as a delay of a torque, stands
in a comment. Shapes are left out: they are in the original.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import (
    Joint,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
    WeldJoint,
)

from fbse_drake.effects.effect import spaced
from fbse_drake.effects.friction import CoulombFriction, CoulombViscousFriction, ViscousFriction
from fbse_drake.effects.geometry import GeometryEffect
from fbse_drake.effects.inertia import InertiaEffect
from fbse_drake.files import write_text
from fbse_drake.robot.plant import Robot, is_point_mass
from fbse_drake.scenario import RobotConfig, build_robot

_WORLD = "world"
_SLIDES = PrismaticJoint.kTypeName


@dataclass(frozen=True)
class Axis:
    """A joint that moves, and what resists its motion."""

    slides: bool
    # Shape (3,), in the frame of its link.
    direction: np.ndarray
    lower: float
    upper: float
    # [kg m^2], [Nm s/rad], [Nm]; of a prismatic joint [kg], [N s/m], [N].
    rotor_inertia: float
    damping: float
    friction: float


@dataclass(frozen=True)
class Link:
    """A body L and the joint that carries it. Its frame is that of the joint, which in Drake's
    plant may be another than the body's."""

    name: str
    # In L; None for a body without mass.
    inertia: SpatialInertia | None
    # What carries it; None for one that floats.
    parent: str | None
    joint: str
    # Its pose in the parent's frame, where its joint is at zero.
    X_PL: RigidTransform
    # None for one that is fixed.
    axis: Axis | None


def links_of(config: RobotConfig) -> tuple[list[Link], list[str]]:
    """The links of a robot, parents first, and the effects of it that links cannot say.

    Raises:
        InputError: see `build_robot`.
    """
    robot = build_robot(config)
    resistance = {
        parameter: _resistance(config, robot, parameter) for parameter in ("viscous", "coulomb")
    }
    unsaid = [
        f"{name}: {spaced(type(effect).__name__)}"
        for name, effect in config.effects.items()
        if not (
            isinstance(effect, InertiaEffect | _Resistance)
            or (isinstance(effect, GeometryEffect) and effect.in_links)
        )
    ]
    return list(_links(robot, resistance)), unsaid


def write_urdf(config: RobotConfig, path: str | Path) -> None:
    """Writes a robot's model as URDF. Rotor inertia is in the transmissions, with Drake's tag.

    Raises:
        InputError: see `build_robot`.
        OSError: the file cannot be written.
    """
    write_text(Path(path), urdf_of(config, Path(path).stem))


def urdf_of(config: RobotConfig, name: str, shapes: Sequence[Element] = ()) -> str:
    """The same as text.

    Args:
        name: of the robot.
        shapes: links, whose visual shapes are taken over by name, and materials of a URDF.

    Raises:
        InputError: see `build_robot`.
    """
    links, unsaid = links_of(config)
    root = Element("robot", name=name)
    root.extend(part for part in shapes if part.tag == "material")
    seen = {part.get("name"): part.findall("visual") for part in shapes if part.tag == "link"}
    _comment(root, unsaid)
    if any(link.parent == _WORLD for link in links):
        SubElement(root, "link", name=_WORLD)
    for link in links:
        element = SubElement(root, "link", name=link.name)
        element.extend(seen.get(link.name, []))
        if link.inertia is not None:
            com, moments = _central(link.inertia)
            inertial = SubElement(element, "inertial")
            SubElement(inertial, "origin", xyz=_text(com), rpy="0 0 0")
            SubElement(inertial, "mass", value=repr(link.inertia.get_mass()))
            names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            values = zip(names, moments.tolist(), strict=True)
            SubElement(inertial, "inertia", {name: repr(value) for name, value in values})
        if link.parent is not None:
            _urdf_joint(root, link, link.parent)
    return _text_of(root)


def write_mjcf(config: RobotConfig, path: str | Path) -> None:
    """Writes a robot's model as MJCF, with `armature`, `damping` and `frictionloss`.

    Raises:
        InputError: see `build_robot`.
        OSError: the file cannot be written.
    """
    links, unsaid = links_of(config)
    root = Element("mujoco", model=Path(path).stem)
    _comment(root, unsaid)
    SubElement(root, "compiler", angle="radian", autolimits="false")
    bodies = {_WORLD: SubElement(root, "worldbody")}
    for link in links:
        parent = bodies[link.parent or _WORLD]
        quaternion = link.X_PL.rotation().ToQuaternion().wxyz()
        place = {
            "pos": _text(np.array(link.X_PL.translation())),
            "quat": _text(np.array(quaternion)),
        }
        body = bodies[link.name] = SubElement(parent, "body", {"name": link.name, **place})
        if link.parent is None:
            SubElement(body, "freejoint", name=link.joint)
        elif link.axis is not None:
            _mjcf_joint(body, link.joint, link.axis)
        if link.inertia is not None:
            com, moments = _central(link.inertia)
            SubElement(
                body,
                "inertial",
                pos=_text(com),
                mass=repr(link.inertia.get_mass()),
                fullinertia=_text(moments),
            )
    write_text(Path(path), _text_of(root))


_Resistance = ViscousFriction | CoulombFriction | CoulombViscousFriction


def _resistance(config: RobotConfig, robot: Robot, parameter: str) -> dict[str, float]:
    """The sum of a parameter of the friction effects, by joint."""
    names = robot.description
    total = np.zeros(len(names.joint_names))
    for name, effect in config.effects.items():
        if isinstance(effect, _Resistance) and hasattr(effect, parameter):
            values = getattr(effect, parameter)
            total += names.per_joint(values, key=f"effects.{name}.{parameter}", default=0.0)
    return dict(zip(names.joint_names, total.tolist(), strict=True))


def _links(robot: Robot, resistance: dict[str, dict[str, float]]) -> Iterator[Link]:
    plant = robot.plant
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    carried = {joint.child_body().name(): joint for joint in joints}
    # Of the link's frame L in the body's frame B.
    X_BL = {_WORLD: RigidTransform()}
    waiting = [
        plant.get_body(index)
        for index in plant.GetBodyIndices(robot.base.model_instance())
        if not is_point_mass(plant.get_body(index))
    ]
    while waiting:
        body = waiting.pop(0)
        joint = carried.get(body.name())
        parent = _WORLD if joint is None else joint.parent_body().name()
        if parent not in X_BL:
            waiting.append(body)
            continue
        floats = joint is None or joint.num_velocities() > 1
        X_BL[body.name()] = (
            RigidTransform()
            if floats or joint is None
            else joint.frame_on_child().GetFixedPoseInBodyFrame()
        )
        yield Link(
            body.name(),
            _inertia(robot, body, X_BL[body.name()]),
            None if floats else parent,
            f"{body.name()}_joint" if joint is None else joint.name(),
            RigidTransform()
            if floats or joint is None
            else X_BL[parent].inverse() @ _pose_at_zero(joint),
            None if floats or joint is None else _axis(robot, joint, resistance),
        )


def _pose_at_zero(joint: Joint) -> RigidTransform:
    """Of the joint's frame M on the child in the parent's body frame."""
    X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
    return X_PF @ joint.X_FM() if isinstance(joint, WeldJoint) else X_PF


def _axis(robot: Robot, joint: Joint, resistance: dict[str, dict[str, float]]) -> Axis | None:
    if joint.num_velocities() == 0:
        return None
    slides = joint.type_name() == _SLIDES
    assert isinstance(joint, RevoluteJoint | PrismaticJoint)
    direction = (
        joint.translation_axis() if isinstance(joint, PrismaticJoint) else joint.revolute_axis()
    )
    name = joint.name()
    return Axis(
        slides,
        np.array(direction),
        float(joint.position_lower_limits()[0]),
        float(joint.position_upper_limits()[0]),
        robot.rotor_inertia(name),
        resistance["viscous"].get(name, 0.0),
        resistance["coulomb"].get(name, 0.0),
    )


def _inertia(robot: Robot, body: RigidBody, X_BL: RigidTransform) -> SpatialInertia | None:
    """Of a body with what is added to it, about Lo in L."""
    # A sum in place, but not in the body's own inertia.
    total = copy(body.default_spatial_inertia())
    for added in robot.added_to(body.name()):
        total += added.default_spatial_inertia()
    if total.get_mass() == 0.0:
        return None
    return total.Shift(X_BL.translation()).ReExpress(X_BL.rotation().inverse())


def _central(inertia: SpatialInertia) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass, (3,) [m], and moments and products of inertia about it, xx, yy, zz, xy, xz,
    yz, (6,) [kg m^2]."""
    com = inertia.get_com()
    central = inertia.Shift(com).CalcRotationalInertia()
    return np.array(com), np.concatenate([central.get_moments(), central.get_products()])


def _urdf_joint(root: Element, link: Link, parent: str) -> None:
    kind = "fixed" if link.axis is None else _urdf_kind(link.axis)
    joint = SubElement(root, "joint", name=link.joint, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=link.name)
    rpy = link.X_PL.rotation().ToRollPitchYaw().vector()
    SubElement(
        joint, "origin", xyz=_text(np.array(link.X_PL.translation())), rpy=_text(np.array(rpy))
    )
    if (axis := link.axis) is None:
        return
    SubElement(joint, "axis", xyz=_text(axis.direction))
    if kind != "continuous":
        # Torques and velocities are limited by the controller.
        limits = {"lower": repr(axis.lower), "upper": repr(axis.upper)}
        SubElement(joint, "limit", {**limits, "effort": "1e9", "velocity": "1e9"})
    SubElement(joint, "dynamics", damping=repr(axis.damping), friction=repr(axis.friction))
    transmission = SubElement(root, "transmission", name=f"{link.joint}_transmission")
    SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    interface = "EffortJointInterface"
    hardware = f"hardware_interface/{interface}"
    SubElement(
        SubElement(transmission, "joint", name=link.joint), "hardwareInterface"
    ).text = hardware
    actuator = SubElement(transmission, "actuator", name=f"{link.joint}_motor")
    SubElement(actuator, "hardwareInterface").text = hardware
    SubElement(actuator, "mechanicalReduction").text = "1"
    SubElement(actuator, "drake:gear_ratio", value="1")
    SubElement(actuator, "drake:rotor_inertia", value=repr(axis.rotor_inertia))
    root.set("xmlns:drake", "http://drake.mit.edu")


def _urdf_kind(axis: Axis) -> str:
    if axis.slides:
        return "prismatic"
    return "revolute" if np.isfinite([axis.lower, axis.upper]).all() else "continuous"


def _mjcf_joint(body: Element, name: str, axis: Axis) -> None:
    limited = bool(np.isfinite([axis.lower, axis.upper]).all())
    limits = {"limited": "true", "range": _text(np.array([axis.lower, axis.upper]))}
    SubElement(
        body,
        "joint",
        {
            "name": name,
            "type": "slide" if axis.slides else "hinge",
            "axis": _text(axis.direction),
            "armature": repr(axis.rotor_inertia),
            "damping": repr(axis.damping),
            "frictionloss": repr(axis.friction),
            **(limits if limited else {}),
        },
    )


def _comment(root: Element, unsaid: list[str]) -> None:
    if unsaid:
        # Two hyphens would end it.
        text = "; ".join(unsaid).replace("--", "- -")
        root.append(ElementTree.Comment(f" Not in this file, which cannot say it: {text} "))


def _text(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))


def _text_of(root: Element) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
