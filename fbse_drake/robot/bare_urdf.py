"""A URDF as plants take it: bodies, joints and frames, with inertias that bodies can have."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from fbse_drake.errors import InputError

# Of shapes meshes need not be there; friction is an effect; every joint that is named has an
# actuator; and what is not named is held, also if it mimics another joint.
_TAKEN = {
    "robot": ("link", "joint", "frame"),
    "link": ("inertial",),
    "joint": ("origin", "parent", "child", "axis", "limit"),
}
# A share of the largest moment of inertia that is rounding.
_ROUNDING = 1e-9
_MOMENTS = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))


@dataclass(frozen=True)
class BareUrdf:
    """What a plant takes of a URDF."""

    text: str
    # What could not be taken as it is, in words.
    remarks: tuple[str, ...]
    # Joints that follow another one.
    mimicking: tuple[str, ...]


def bare_urdf(urdf: Path) -> BareUrdf:
    """A URDF with bodies, joints and frames only.

    Limits of which the lower one is the upper one are none: who writes 0 and 0 did not know them.
    An inertia that no body can have becomes one near to it that a body can (Drake would take that
    of a solid sphere instead); one of a body without mass is left out.

    Raises:
        OSError: the file cannot be read.
        InputError: it is something else, as a xacro that has not been expanded, or has an inertia
            that is not finite.
        ElementTree.ParseError, ValueError: it is no URDF.
    """
    return _bare(urdf.read_bytes())


# A diagnosis makes its robot many times, of large files too.
@lru_cache(maxsize=4)
def _bare(urdf: bytes) -> BareUrdf:
    root = ElementTree.fromstring(urdf)
    if root.tag != "robot":
        raise InputError(f"expected <robot> as its root, found <{root.tag}>")
    macros = any("xacro}" in child.tag for child in root)
    joints, links = [*root.iter("joint")], [*root.iter("link")]
    mimicking = tuple(j.get("name", "") for j in joints if j.find("mimic") is not None)
    for element in [root, *links, *joints]:
        for part in [part for part in element if part.tag not in _TAKEN[element.tag]]:
            element.remove(part)
    values = [value for element in root.iter() for value in element.attrib.values()]
    if macros or any("$(" in value or "${" in value for value in values):
        raise InputError("this is a xacro; expand it first: xacro robot.xacro > robot.urdf")
    for joint in joints:
        _without_empty_range(joint)
    changed: dict[str, list[str]] = {}
    for link in links:
        if what := _made_possible(link):
            changed.setdefault(what, []).append(link.get("name", ""))
    remarks = tuple(f"{', '.join(names)}: {what}" for what, names in changed.items())
    return BareUrdf(ElementTree.tostring(root, encoding="unicode"), remarks, mimicking)


def _without_empty_range(joint: Element) -> None:
    limit = joint.find("limit")
    if joint.get("type") == "revolute" and limit is not None:
        low, high = (float(limit.get(end, "0")) for end in ("lower", "upper"))
        if low == high:
            joint.set("type", "continuous")
            for end in ("lower", "upper"):
                limit.attrib.pop(end, None)


def _made_possible(link: Element) -> str:
    """Gives a link an inertia that a body can have; says what was done if it had another one.

    Raises:
        InputError: it has one that is not finite.
    """
    inertial = link.find("inertial")
    inertia = None if inertial is None else inertial.find("inertia")
    mass = None if inertial is None else inertial.find("mass")
    if inertial is None or inertia is None or mass is None:
        return ""
    given = np.array([[float(inertia.get(key, "0")) for key in row] for row in _MOMENTS])
    if not np.isfinite(given).all():
        raise InputError(f"{link.get('name', '')}: its inertia is not finite")
    if float(mass.get("value", "0")) == 0.0:
        link.remove(inertial)
        return "moments of inertia without a mass are left out" if given.any() else ""
    moments, axes = np.linalg.eigh(given)
    possible = _possible_moments(moments)
    if possible is None:
        return ""
    changed = axes @ np.diag(possible) @ axes.T
    for row, values in zip(_MOMENTS, changed, strict=True):
        for key, value in zip(row, values, strict=True):
            inertia.set(key, repr(float(value)))
    was, now = (", ".join(f"{m:.4g}" for m in values) for values in (moments, possible))
    return (
        f"no body has the principal moments of inertia {was} kg m^2 (one is more than the others "
        f"together, or negative); {now} are taken"
    )


def _possible_moments(moments: np.ndarray) -> np.ndarray | None:
    """Principal moments of inertia that a body can have in the place of these, (3,); None if it can
    have these.

    How far mass reaches along an axis, its second moment, is half the sum of the moments of inertia
    minus that about this axis. A body can have what leaves none of these negative (Wensing, Kim and
    Slotine 2018); a negative one becomes zero.
    """
    along = 0.5 * moments.sum() - moments
    least = _ROUNDING * np.abs(moments).max()
    if along.min() >= -least:
        return None
    along = np.maximum(along, least)
    return along.sum() - along
