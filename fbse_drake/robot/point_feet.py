"""Proposes point feet for legs of three joints, and a posture in which the robot stands on them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.tree import Joint
from scipy.optimize import least_squares

from fbse_drake.errors import InputError
from fbse_drake.robot.urdf_model import Chain, UrdfModel, words

# Height of the hip over the length of thigh and shank, in the posture that is proposed.
_HEIGHT = 0.8
# How far joints stay away from their limits [rad]; a joint without any is tried within half a turn.
_AWAY, _HALF_TURN = 0.1, np.pi
# A foot is where it should be if it misses that by no more [m].
_MISSED = 1e-4
# A foot touches the ground amid what of it is this near to its lowest point [m].
_RIDGE = 0.001
# A foot that reaches less far from its last joint has no place that could be told [m].
_NO_LEG = 0.01
# Rows of legs, from front to rear, by how many there are.
_ROWS = {2: ("front", "rear"), 3: ("front", "middle", "rear")}
_LEFT, _RIGHT = (
    {"l", "left", "fl", "lf", "rl", "hl", "lh"},
    {"r", "right", "fr", "rf", "rr", "hr", "rh"},
)
_FRONT, _REAR = (
    {"front", "fl", "lf", "fr", "rf"},
    {"rear", "hind", "rl", "rr", "hl", "lh", "hr", "rh"},
)


class NoStanceError(ValueError):
    """Legs that cannot stand within their limits."""


@dataclass(frozen=True)
class Stance:
    """Legs that stand on points, below the hips."""

    # By side: its leg, the joints' angles [rad], and the point in the base's axes [m].
    legs: dict[str, Chain]
    angles: dict[str, np.ndarray]
    points: dict[str, np.ndarray]
    # What could not be found, in words.
    remarks: list[str]


def propose_stance(model: UrdfModel, legs: Sequence[Chain]) -> Stance:
    """Finds the points of legs of three joints, and how the robot stands on them with bent knees.

    Leaves the model in that posture. Where joints may bend both ways, knees point backwards.

    Raises:
        InputError: legs that are not in pairs, or a base whose axes do not point forwards and up.
        NoStanceError: there is no posture with level feet below the hips.
    """
    by_side = _sides(model, legs)
    remarks: list[str] = []
    tips = {side: _lowest(model, leg, side, remarks) for side, leg in by_side.items()}
    remarks = list(dict.fromkeys(remarks))
    angles = _angles(model, by_side, tips)
    both = {side for side, found in angles.items() if len(found) > 1}
    chosen = {side: found[0] for side, found in angles.items()}
    for side, leg in by_side.items():
        _set(model, leg.joints, chosen[side])
    points = {side: _lowest(model, leg, side, []) for side, leg in by_side.items()}
    if both:
        remarks.append(
            "Nothing says which way the knees bend: they point backwards (see `stance`)."
        )
    return Stance(by_side, chosen, points, remarks)


def _sides(model: UrdfModel, legs: Sequence[Chain]) -> dict[str, Chain]:
    """Legs by what they are called, from front to rear, left before right.

    Raises:
        InputError: they are not in pairs, or their names say that the base's axes point elsewhere.
    """
    for leg in legs:
        said, name = set(words(leg.joints[0].name())), leg.joints[0].name()
        for place, positive, negative, where in (
            (leg.hip[1], _LEFT, _RIGHT, ("left", "right")),
            (
                leg.hip[0] - np.mean([each.hip[0] for each in legs]),
                _FRONT,
                _REAR,
                ("front", "rear"),
            ),
        ):
            if said & (negative if place > 0 else positive):
                raise InputError(
                    f"{model.urdf}: {name} is on the {where[int(place < 0)]} side of "
                    f"{model.base.name()}, whose axes must point forwards (x) and up (z): fix a "
                    "frame with such axes to it and make it the root"
                )
    left, right = (
        sorted((leg for leg in legs if sign * leg.hip[1] > 0), key=lambda leg: -leg.hip[0])
        for sign in (1, -1)
    )
    if len(left) != len(right) or len(left) not in _ROWS:
        raise InputError(
            f"{model.urdf}: {len(left)} legs are on the left and {len(right)} on the right; "
            "a robot on point feet stands on two or three pairs"
        )
    return {
        f"{row}_{side}": leg
        for row, *pair in zip(_ROWS[len(left)], left, right, strict=True)
        for side, leg in zip(("left", "right"), pair, strict=True)
    }


def _lowest(model: UrdfModel, leg: Chain, side: str, remarks: list[str]) -> np.ndarray:
    """The lowest point of a leg in the base's axes, (3,) [m]; adds what it could not find."""
    reason = f"{leg.foot.name()} has no shape"
    try:
        points = model.points(leg.foot)
    except InputError as error:
        points, reason = np.empty((0, 3)), str(error).removeprefix(f"{model.urdf}: ")
    if len(points):
        ground = points[:, 2].min()
        return np.array([*points[points[:, 2] < ground + _RIDGE, :2].mean(axis=0), ground])
    ankle = model.pose(leg.joints[-1].child_body())[:3, 3]
    places = {body.name(): model.pose(body)[:3, 3] for body in model.fixed_to(leg.foot)}
    name = max(places, key=lambda body: float(np.linalg.norm(places[body] - ankle)))
    if np.linalg.norm(places[name] - ankle) < _NO_LEG:
        raise InputError(f"{reason}, so nothing says where the {side} foot meets the ground")
    remarks.append(f"{reason}: the {side} foot is taken to be at the origin of {name}.")
    return places[name]


def _angles(
    model: UrdfModel, legs: Mapping[str, Chain], tips: Mapping[str, np.ndarray]
) -> dict[str, list[np.ndarray]]:
    """Joint angles that put all feet level below their hips, the knee that is furthest back first.

    Raises:
        NoStanceError: a leg has none within its limits.
    """
    hips, lengths = {}, []
    for side, leg in legs.items():
        _, hip, knee = (model.pose(joint.child_body())[:3, 3] for joint in leg.joints)
        hips[side] = hip
        lengths.append(np.linalg.norm(knee - hip) + np.linalg.norm(tips[side] - knee))
    height = np.mean([hip[2] for hip in hips.values()]) - _HEIGHT * np.mean(lengths)
    return {
        side: _leg_angles(
            model, leg, side, tips[side], np.array([*hips[side][:1], tips[side][1], height])
        )
        for side, leg in legs.items()
    }


def _leg_angles(
    model: UrdfModel, leg: Chain, side: str, tip: np.ndarray, target: np.ndarray
) -> list[np.ndarray]:
    """Angles with which a leg's tip, given in the zero posture, is at a place, (3,) [rad] each."""
    plant, context, base = model.plant, model.context, model.base.body_frame()
    p_FT = np.linalg.inv(model.pose(leg.foot)) @ [*tip, 1.0]

    def missed(angles: np.ndarray) -> np.ndarray:
        _set(model, leg.joints, angles)
        return (
            plant.CalcPointsPositions(context, leg.foot.body_frame(), p_FT[:3], base)[:, 0] - target
        )

    def knee(angles: np.ndarray) -> float:
        _set(model, leg.joints, angles)
        return float(model.pose(leg.joints[-1].child_body())[0, 3])

    low, high = (np.array(limits) for limits in zip(*map(_range, leg.joints), strict=True))
    bend = float(np.arccos(_HEIGHT))
    found: list[np.ndarray] = []
    best = np.inf
    for hip in (bend, -bend):
        for knee_angle in (2 * bend, -2 * bend):
            start = np.clip([0.0, hip, knee_angle], low, high)
            solved = least_squares(missed, start, bounds=(low, high), xtol=1e-12, ftol=1e-12)
            best = min(best, float(np.linalg.norm(solved.fun)))
            is_new = all(np.abs(solved.x - other).max() > _AWAY for other in found)
            if np.linalg.norm(solved.fun) < _MISSED and is_new:
                found.append(solved.x)
    order = sorted(found, key=knee)
    _set(model, leg.joints, np.zeros(len(leg.joints)))
    if not order:
        raise NoStanceError(
            f"no posture was found with the {side} foot below its hip: it misses that by "
            f"{1e3 * best:.0f} mm"
        )
    return order


def _range(joint: Joint) -> tuple[float, float]:
    """Of the angles that are tried of a joint [rad]."""
    low = max(float(joint.position_lower_limits()[0]), -_HALF_TURN)
    high = min(float(joint.position_upper_limits()[0]), _HALF_TURN)
    away = min(_AWAY, 0.1 * (high - low))
    return low + away, high - away


def _set(model: UrdfModel, joints: Sequence[Joint], angles: np.ndarray) -> None:
    positions = model.plant.GetPositions(model.context)
    positions[[joint.position_start() for joint in joints]] = angles
    model.plant.SetPositions(model.context, positions)
