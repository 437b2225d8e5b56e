"""Effects on a plant's inertia.

The same lines change the plant that is simulated, the model that is believed, and the model that
the diagnosis tries out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from pydrake.multibody.tree import RigidBody, SpatialInertia

from fbse_drake.effects.effect import Effect, Parameter, in_library
from fbse_drake.errors import InputError, located
from fbse_drake.robot.plant import PointMass, Robot

# The model's masses and centres of mass are suspected in bodies heavier than this share of the
# robot.
_LIGHT_BODY = 0.01
# A body may plausibly weigh that much more or less than its model says, as a share of it.
_PLAUSIBLE_SHARE = 0.25
# Share of an inertia that may be lost in rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class InertiaEffect(Effect):
    """Base of the inertia effects. One that acts on joints adds rotor inertia to them, one that
    acts on bodies adds point masses; a subclass gives the one of the two functions that it needs.
    All its parameters are linear, at least about some values.
    """

    # Simpler effects on the same body, one of which and something else may look like it.
    parts: ClassVar[tuple[type["InertiaEffect"], ...]] = ()

    @staticmethod
    def suspected_bodies(robot: Robot) -> list[str]:
        """Bodies that the diagnosis tries it on: those that weigh something."""
        total = robot.total_mass
        return [
            name
            for name in robot.body_names
            if robot.body(name).default_mass() > _LIGHT_BODY * total
        ]

    @staticmethod
    def expansion_point(body: RigidBody) -> np.ndarray | None:  # noqa: ARG004
        """Values about which it is linear enough for a search to begin with, shape (parameters,);
        None for zeros."""
        return None

    @staticmethod
    def nearby(about: np.ndarray, values: np.ndarray) -> np.ndarray:  # noqa: ARG004
        """Values about which to be linear next, where a fit that is linear about some values found
        others, (parameters,)."""
        return values

    @staticmethod
    def lowest_nearby(about: np.ndarray) -> np.ndarray | float:  # noqa: ARG004
        """Smallest values for which what is linear about some values holds, (parameters,)."""
        return -np.inf

    @staticmethod
    def rotor_inertia(values: np.ndarray) -> np.ndarray:
        """What is added to the rotor inertia of each joint, shape (n,) [kg m^2].

        Args:
            values: of the parameters, shape (parameters, n).
        """
        raise NotImplementedError

    @staticmethod
    def point_masses(body: RigidBody, values: np.ndarray) -> list[PointMass]:
        """What is added to a body, as its model file has it.

        Args:
            values: of the parameters for this body, shape (parameters,).
        """
        raise NotImplementedError


def inertia_changes(
    effects: Mapping[str, Effect], robot: Robot
) -> tuple[np.ndarray, list[PointMass]]:
    """What the inertia effects among some effects add to a robot: rotor inertia of each joint,
    shape (n,) [kg m^2], and point masses.

    Args:
        effects: by name, of any kind.
        robot: without them.

    Raises:
        InputError: unknown joint or body, a value out of bounds.
    """
    rotor_inertia, point_masses = np.zeros(len(robot.joint_names)), []
    for name, effect in effects.items():
        if not isinstance(effect, InertiaEffect):
            continue
        values = effect.resolve(robot.description, key=f"effects.{name}")
        if effect.acts_on == "joint":
            rotor_inertia = rotor_inertia + effect.rotor_inertia(values.linear)
            continue
        with located(f"effects.{name}: "):
            for body, of_body in zip(values.targets, values.linear.T, strict=True):
                point_masses += effect.point_masses(robot.body(body), of_body)
    return rotor_inertia, point_masses


@in_library
@dataclass(frozen=True)
class ReflectedInertia(InertiaEffect):
    """Inertia of rotor and gears as the joint feels it (that of the rotor times the gear ratio
    squared), beside a configured `rotor_inertia`; negative where that is too large."""

    description: ClassVar[str] = "Inertia of motor and gears, as felt at the joint."
    signature: ClassVar[str] = (
        "Torque in step with the joint's own acceleration, also where the link barely loads the "
        "joint."
    )
    experiment: ClassVar[str] = "Swing each joint fast, with the robot hanging and its feet free."
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "inertia": Parameter("kg m^2", linear=True, plausible=(0.02, 0.6), bounds=(-np.inf, np.inf))
    }

    inertia: dict[str, float] = field(default_factory=dict)

    @classmethod
    def parameters_on(cls, robot: Robot, target: str) -> dict[str, Parameter]:
        """A rotor behind a gear is often felt as much as all that the joint moves."""
        parameters = super().parameters_on(robot, target)
        low, high = parameters["inertia"].plausible
        moved = float(robot.joint_inertia[robot.joint_names.index(target)])
        return {"inertia": replace(parameters["inertia"], plausible=(low, max(high, moved)))}

    @classmethod
    def lowest_values(cls, robot: Robot, target: str) -> np.ndarray:
        """No rotor has less inertia than none."""
        return np.array([-robot.rotor_inertia(target)])

    @staticmethod
    def rotor_inertia(values: np.ndarray) -> np.ndarray:
        return values[0]


@in_library
@dataclass(frozen=True)
class BodyMass(InertiaEffect):
    """Mass at the centre of mass of a body; negative where the model has too much. Mass elsewhere
    is a `Payload`."""

    description: ClassVar[str] = "A body is heavier or lighter than the model says."
    signature: ClassVar[str] = (
        "Too much or too little force under the feet, and torque in the joints that carry the "
        "body, with its weight."
    )
    experiment: ClassVar[str] = "Squat and sway; for a leg's body also lift that leg."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"
    parameters: ClassVar[dict[str, Parameter]] = {
        "mass": Parameter("kg", linear=True, plausible=(-10.0, 10.0), bounds=(-np.inf, np.inf))
    }

    mass: dict[str, float] = field(default_factory=dict)

    @classmethod
    def parameters_on(cls, robot: Robot, target: str) -> dict[str, Parameter]:
        """A body that is most of a heavy machine may be wrong by a share of what it weighs."""
        parameters = super().parameters_on(robot, target)
        most = _PLAUSIBLE_SHARE * robot.body(target).default_mass()
        high = max(parameters["mass"].plausible[1], most)
        return {"mass": replace(parameters["mass"], plausible=(-high, high))}

    @classmethod
    def lowest_values(cls, robot: Robot, target: str) -> np.ndarray:
        """No body loses more than it weighs."""
        bodies = [robot.body(target), *robot.added_to(target)]
        return np.array([-sum(body.default_mass() for body in bodies)])

    @staticmethod
    def point_masses(body: RigidBody, values: np.ndarray) -> list[PointMass]:
        return [PointMass(body.name(), values[0], body.default_com())]


@in_library
@dataclass(frozen=True)
class BodyCentreOfMass(InertiaEffect):
    """The centre of mass of a body, moved in the body's frame; its mass and its rotational inertia
    about the centre of mass stay.

    A body of mass m whose centre of mass moves from c to c + d differs by the point masses -m at c
    and m at c + d: exactly what is said above, and linear in d but for the part d^2 of the
    rotational inertia.
    """

    description: ClassVar[str] = "The centre of mass of a body is elsewhere than the model says."
    signature: ClassVar[str] = (
        "Moments and joint torques with the body's weight and tilt, but the right force under the "
        "feet."
    )
    experiment: ClassVar[str] = (
        "Squat and sway slowly; for its height, tilt or accelerate the body."
    )
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"
    linear_nearby: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter(
            "m", linear=True, plausible=(-0.05, 0.05), bounds=(-np.inf, np.inf), belief=0.1
        )
        for axis in "xyz"
    }

    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def point_masses(body: RigidBody, values: np.ndarray) -> list[PointMass]:
        mass, com = body.default_mass(), body.default_com()
        return [PointMass(body.name(), -mass, com), PointMass(body.name(), mass, com + values)]


# Half the distance of the masses that stand for a second moment [m]; what they add does not depend
# on it.
_ARM = 0.1
# Mass of the payload about which a search for one begins [kg]; and the smallest one, as a share of
# it, for which what is linear about a mass says where it is.
_SOME_MASS, _LEAST_SHARE = 1.0, 0.25


@in_library
@dataclass(frozen=True)
class Payload(InertiaEffect):
    """A rigid mass that a body B carries: its mass, the place p_BoP_B of its centre P, and its
    second moments about P along the axes of B, as sxx = integral of (x - x_P)^2 dm; all of them 0
    for a point mass.

    Second moments that are not negative are those of some distribution of mass. The rotational
    inertia about P is ixx = syy + szz and so on; products of inertia are left out.
    """

    description: ClassVar[str] = "A body carries something: a payload, a tool, a load on the back."
    signature: ClassVar[str] = (
        "Torque in all joints that carry the body, as of one weight at one place; under the feet "
        "its weight."
    )
    experiment: ClassVar[str] = (
        "Move all joints that carry the body, through many postures and fast."
    )
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"
    linear_nearby: ClassVar[bool] = True
    parts: ClassVar[tuple[type[InertiaEffect], ...]] = (BodyMass, BodyCentreOfMass)
    parameters: ClassVar[dict[str, Parameter]] = {
        "mass": Parameter("kg", linear=True, plausible=(0.0, 10.0), neutral=0.0),
        **{
            axis: Parameter(
                "m", linear=True, plausible=(-0.5, 0.5), bounds=(-np.inf, np.inf), belief=0.5
            )
            for axis in "xyz"
        },
        **{
            f"s{axis}{axis}": Parameter("kg m^2", linear=True, plausible=(0.0, 0.5), belief=0.1)
            for axis in "xyz"
        },
    }

    mass: dict[str, float] = field(default_factory=dict)
    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)
    sxx: dict[str, float] = field(default_factory=dict)
    syy: dict[str, float] = field(default_factory=dict)
    szz: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def suspected_bodies(robot: Robot) -> list[str]:
        """Of bodies that are fixed to each other the heaviest, however light it is; none that is
        fixed to the world."""
        plant, names = robot.plant, robot.body_names
        at_rest = {body.name() for body in plant.GetBodiesWeldedTo(plant.world_body())}
        carriers = (
            max(
                (b for b in plant.GetBodiesWeldedTo(robot.body(name)) if b.name() in names),
                key=lambda body: body.default_mass(),
            ).name()
            for name in names
            if name not in at_rest
        )
        return list(dict.fromkeys(carriers))

    @staticmethod
    def expansion_point(body: RigidBody) -> np.ndarray:
        return np.array([_SOME_MASS, *body.default_com(), 0.0, 0.0, 0.0])

    @staticmethod
    def nearby(about: np.ndarray, values: np.ndarray) -> np.ndarray:
        """With no less than a share of the mass, where the first moment is the one that was fitted:
        what has no mass has no place."""
        mass, place = max(values[0], _LEAST_SHARE * about[0]), values[1:4]
        first_moment = about[0] * place + (values[0] - about[0]) * about[1:4]
        return np.array([mass, *first_moment / mass, *values[4:]])

    @staticmethod
    def lowest_nearby(about: np.ndarray) -> np.ndarray:
        return np.append(_LEAST_SHARE * about[0], np.full(6, -np.inf))

    @staticmethod
    def point_masses(body: RigidBody, values: np.ndarray) -> list[PointMass]:
        mass, place, second_moments = values[0], values[1:4], values[4:]
        result = [PointMass(body.name(), mass, place)]
        for arm, moment in zip(_ARM * np.eye(3), second_moments, strict=True):
            if moment:
                # A pair of masses, and what they weigh taken off between them.
                each = moment / (2 * _ARM**2)
                result += [
                    PointMass(body.name(), each, place + arm),
                    PointMass(body.name(), each, place - arm),
                    PointMass(body.name(), -2 * each, place),
                ]
        return result


# Parameters of a body's inertia: mass, first moment and rotational inertia about the origin of the
# body's frame, in that frame.
_INERTIAL = {
    "mass": ("kg", 10.0),
    **{f"m{axis}": ("kg m", 1.0) for axis in "xyz"},
    **{f"i{axes}": ("kg m^2", 1.0) for axes in ("xx", "yy", "zz", "xy", "xz", "yz")},
}


@in_library
@dataclass(frozen=True)
class InertialParameters(InertiaEffect):
    """All ten inertial parameters of a body, as changes from what the model says, in its frame B.

    They are mass, first moment m p_BoBcm, and rotational inertia about Bo (ixy is the element of
    the matrix). A log shows them only in combinations; see
    `fbse_drake.discrepancy.identification.inertial`, which finds values that some distribution of
    mass has.
    """

    description: ClassVar[str] = (
        "Mass, centre of mass and rotational inertia of a body are not what the model says."
    )
    signature: ClassVar[str] = (
        "Torque with posture, velocity and acceleration, in all joints that carry the body."
    )
    experiment: ClassVar[str] = (
        "Move all joints that carry the body at once, through many postures and fast."
    )
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"
    composite: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        name: Parameter(unit, linear=True, plausible=(-size, size), bounds=(-np.inf, np.inf))
        for name, (unit, size) in _INERTIAL.items()
    }

    mass: dict[str, float] = field(default_factory=dict)
    mx: dict[str, float] = field(default_factory=dict)
    my: dict[str, float] = field(default_factory=dict)
    mz: dict[str, float] = field(default_factory=dict)
    ixx: dict[str, float] = field(default_factory=dict)
    iyy: dict[str, float] = field(default_factory=dict)
    izz: dict[str, float] = field(default_factory=dict)
    ixy: dict[str, float] = field(default_factory=dict)
    ixz: dict[str, float] = field(default_factory=dict)
    iyz: dict[str, float] = field(default_factory=dict)

    def __add__(self, further: "InertialParameters") -> "InertialParameters":
        """Both changes at once."""
        values = {}
        for name in self.parameters:
            ours, theirs = getattr(self, name), getattr(further, name)
            values[name] = {
                body: ours.get(body, 0.0) + theirs.get(body, 0.0)
                for body in dict.fromkeys([*ours, *theirs])
            }
        return InertialParameters(**values)

    @staticmethod
    def point_masses(body: RigidBody, values: np.ndarray) -> list[PointMass]:
        before = pseudo_inertia(inertial_parameters(body.default_spatial_inertia()))
        # The body as it shall be, and against it as it is.
        return [
            PointMass(body.name(), sign * mass, position)
            for sign, J in ((1.0, before + pseudo_inertia(values)), (-1.0, before))
            for mass, position in equal_point_masses(J, body.name())
        ]


def inertial_parameters(inertia: SpatialInertia) -> np.ndarray:
    """The ten parameters of a spatial inertia in the order of `InertialParameters`, shape (10,)."""
    mass, I_BBo = inertia.get_mass(), inertia.CalcRotationalInertia()
    return np.array(
        [mass, *(mass * inertia.get_com()), *I_BBo.get_moments(), *I_BBo.get_products()]
    )


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    """Pseudo-inertia [[integral of p p^T dm, m c], [m c^T, m]], (..., 4, 4), of parameters
    (..., 10); linear in them.

    A distribution of mass has these parameters just if it is positive semidefinite (Wensing, Kim
    and Slotine 2018).
    """
    m, mx, my, mz, xx, yy, zz, xy, xz, yz = np.moveaxis(np.asarray(parameters), -1, 0)
    half = 0.5 * (xx + yy + zz)
    rows = [
        [half - xx, -xy, -xz, mx],
        [-xy, half - yy, -yz, my],
        [-xz, -yz, half - zz, mz],
        [mx, my, mz, m],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def equal_point_masses(J: np.ndarray, name: str) -> list[tuple[float, np.ndarray]]:
    """Four equal masses [kg] and their places [m] that have a pseudo-inertia: the corners of a
    tetrahedron.

    Raises:
        InputError: no distribution of mass has it; `name` is the body's.
    """
    mass = J[3, 3]
    spread, axes = (
        np.linalg.eigh(J[:3, :3] - np.outer(J[:3, 3], J[:3, 3]) / mass)
        if mass > 0
        else (np.array([-1.0]), np.eye(3))
    )
    if spread.min() < -_ROUNDING * np.trace(J):
        raise InputError(
            f"{name}: expected the inertia of a body, found one that no distribution of mass has"
        )
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    places = J[:3, 3] / mass + corners * np.sqrt(np.maximum(spread, 0.0) / mass) @ axes.T
    return [(mass / 4, place) for place in places]
