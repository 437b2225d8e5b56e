"""Effects of the ground, and in the contact of soles with it.

To simulate one is to change ground and contact solver; to predict what the contact does is to say
how a standing sole moves because of it.
"""

import math
from abc import abstractmethod
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numba import njit
from pydrake.geometry import ProximityProperties
from pydrake.multibody.plant import (
    CalcContactFrictionFromSurfaceProperties,
    CoulombFriction,
    MultibodyPlantConfig,
)

from fbse_drake.effects.effect import Effect, Parameter, in_library
from fbse_drake.errors import InputError
from fbse_drake.robot.plant import Ground, make_robot

# A pad that carries less than this counts as carrying it, where forces are ratios to the load [N].
_LEAST_LOAD = 1.0
# Contact approximations that hold a sole by friction that is regularised, so that it creeps.
_CREEPING = ("lagged", "similar")


@dataclass(frozen=True)
class GroundEffect(Effect):
    """Base of the effects of the ground, which act on the robot as a whole. A diagnosis predicts
    `GroundSlope` and every `ContactEffect`."""

    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "robot"

    @abstractmethod
    def contact(
        self, ground: Ground, plant: MultibodyPlantConfig, friction: float
    ) -> tuple[Ground, MultibodyPlantConfig]:
        """The ground and the plant's settings with this effect.

        Args:
            friction: Coulomb friction coefficient between pads and ground.

        Raises:
            InputError: settings with which it cannot be simulated.
        """


@dataclass(frozen=True)
class ContactEffect(GroundEffect):
    """Base of the contact effects, which move standing soles in proportion to their linear
    parameters."""

    @classmethod
    def usual(cls, contact: "PadContact") -> np.ndarray:  # noqa: ARG003
        """Values of the nonlinear parameters that are usual on this contact, (m,); by default those
        of an effect of which nothing is said."""
        names = [name for name, parameter in cls.parameters.items() if not parameter.linear]
        return np.array([getattr(cls(), name) for name in names], dtype=float)

    @staticmethod
    def retardation_of(nonlinear: np.ndarray, contact: "PadContact") -> float:  # noqa: ARG004
        """That of a contact with the effect, see `PadContact` [s/N].

        Args:
            nonlinear: values of the nonlinear parameters, shape (m,).
            contact: without it.
        """
        return contact.retardation

    @staticmethod
    @abstractmethod
    def sole_motion(
        pad_force: np.ndarray, pad_positions: np.ndarray, time: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """How a sole that stands moves against one on level, rigid ground that holds it, per unit
        of each of the p parameters.

        Args:
            pad_force: force of the ground on each pad, in the sole frame, shape (N, P, 3) [N]; that
                of a row is of the step that ends then. Its normal component is what the contact's
                spring carries, see `spring_force`.
            pad_positions: in the sole frame, shape (P, 3) [m].
            time: of the rows, shape (N,) [s].

        Returns:
            Rotation vector [rad] and displacement of the sole's origin [m], in the sole frame, each
            of shape (p, N, 3).
        """


def contact_with_effects(
    effects: Iterable[Effect], ground: Ground, plant: MultibodyPlantConfig, description: str
) -> tuple[Ground, MultibodyPlantConfig]:
    """The ground and the plant's settings with the effects of the ground among some effects.

    Args:
        description: of the robot that stands there.

    Raises:
        InputError: settings with which an effect cannot be simulated, a robot without pads.
    """
    effects = [effect for effect in effects if isinstance(effect, GroundEffect)]
    if effects:
        friction = _friction(description, ground)
        for effect in effects:
            ground, plant = effect.contact(ground, plant, friction)
    return ground, plant


def _pad_properties(description: str) -> ProximityProperties:
    """Contact properties of a robot's pads; those of corners are the ground's."""
    robot, scene_graph = make_robot(description)
    pads = [pad for leg in robot.description.legs.values() for pad in leg.pads]
    if not robot.description.legs:
        raise InputError(f"{description}: contact effects need a robot with feet")
    if not pads:
        return ProximityProperties()
    pad = robot.plant.GetJointByName(pads[0]).child_body()
    (geometry,) = robot.plant.GetCollisionGeometriesForBody(pad)
    return scene_graph.model_inspector().GetProximityProperties(geometry)


def _friction(description: str, ground: Ground) -> float:
    """Friction coefficient between pads and ground as Drake combines it."""
    of_ground = CoulombFriction(ground.friction, ground.friction)
    properties = _pad_properties(description)
    of_pad = (
        properties.GetProperty("material", "coulomb_friction")
        if properties.HasProperty("material", "coulomb_friction")
        else of_ground
    )
    return CalcContactFrictionFromSurfaceProperties(of_pad, of_ground).dynamic_friction()


@in_library
@dataclass(frozen=True)
class GroundSlope(GroundEffect):
    """Ground that is tilted by a rotation vector about world x and y.

    In a simulation the world's frame is fixed to the ground, and gravity is turned. To a diagnosis
    world x is where the base heads when a log begins; how it turns from there the gyro tells.
    """

    description: ClassVar[str] = "The ground is not level."
    signature: ClassVar[str] = (
        "Standing soles that are tilted against gravity, both feet alike, wherever the robot steps."
    )
    experiment: ClassVar[str] = (
        "Stand still; then turn the robot, to tell the slope from a tilted IMU."
    )
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("rad", linear=True, plausible=(-0.1, 0.1), bounds=(-1.0, 1.0))
        for axis in "xy"
    }

    x: float = 0.0
    y: float = 0.0

    def contact(
        self,
        ground: Ground,
        plant: MultibodyPlantConfig,
        friction: float,  # noqa: ARG002
    ) -> tuple[Ground, MultibodyPlantConfig]:
        return replace(ground, slope=[ground.slope[0] + self.x, ground.slope[1] + self.y]), plant


@in_library
@dataclass(frozen=True)
class GroundCompliance(ContactEffect):
    """Ground and soles that give way: each pad sinks by compliance * (its normal force), more than
    the contact's stiffness says.

    By how long it sinks late grows with the force (Hunt and Crossley 1975): by retardation * force,
    where retardation is the dissipation over the stiffness of the contact that has the effect.
    """

    description: ClassVar[str] = "Ground or soles give way under load."
    signature: ClassVar[str] = "Standing feet sink and tilt as load and centre of pressure move."
    experiment: ClassVar[str] = "Sway from foot to foot, and lean forward and back."
    parameters: ClassVar[dict[str, Parameter]] = {
        # From rubber soles to a foam mat.
        "compliance": Parameter("m/N", linear=True, plausible=(5e-7, 1e-4)),
        "retardation": Parameter(
            "s/N",
            linear=False,
            plausible=(1e-5, 1e-2),
            meaning="by how long soles sink late, per force; 0 for as long as without the effect",
        ),
    }

    compliance: float = 0.0
    retardation: float = 0.0

    def contact(
        self,
        ground: Ground,
        plant: MultibodyPlantConfig,
        friction: float,  # noqa: ARG002
    ) -> tuple[Ground, MultibodyPlantConfig]:
        # Drake puts the springs of both surfaces in series, so this adds to the compliance of the
        # contact as a whole.
        stiffness = 1.0 / (1.0 / ground.stiffness + self.compliance)
        retardation = self.retardation or ground.dissipation / ground.stiffness
        return replace(ground, stiffness=stiffness, dissipation=retardation * stiffness), plant

    @classmethod
    def usual(cls, contact: "PadContact") -> np.ndarray:
        return np.array([contact.retardation])

    @staticmethod
    def retardation_of(nonlinear: np.ndarray, contact: "PadContact") -> float:
        return float(nonlinear[0]) or contact.retardation

    @staticmethod
    def sole_motion(
        pad_force: np.ndarray, pad_positions: np.ndarray, time: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        # Height of a pad: that of the origin plus the tilt's, h + a y - b x; the plane that fits
        # the pads best.
        x, y, _ = pad_positions.T
        h, a, b = np.linalg.pinv(np.stack([np.ones_like(x), y, -x], axis=1)) @ -pad_force[:, :, 2].T
        zero = np.zeros(len(time))
        return np.stack([a, b, zero], axis=1)[None], np.stack([zero, zero, h], axis=1)[None]


@in_library
@dataclass(frozen=True)
class FootCreep(ContactEffect):
    """Soles that creep while they stand: each pad with the velocity creep * (tangential
    force) / (normal force), along the force that the robot exerts on the ground.

    It is what Drake's `lagged` and `similar` contact do anyhow,
    v = stiction_tolerance * r / sqrt(1 - r^2) where r is the tangential force over the friction
    limit, which is the law above for small r. So slippery ground looks like creep of
    stiction_tolerance / friction as long as the limit is not reached. How fast a sole slides beyond
    it no force tells: that is no creep, and no effect here.
    """

    description: ClassVar[str] = "Feet slip slowly while they stand."
    signature: ClassVar[str] = (
        "The distance between standing feet changes, the faster the more they push sideways."
    )
    experiment: ClassVar[str] = "Stand and sway with the feet pushing apart; walk."
    parameters: ClassVar[dict[str, Parameter]] = {
        "creep": Parameter("m/s", linear=True, plausible=(1e-3, 5e-2))
    }

    creep: float = 0.0

    def contact(
        self, ground: Ground, plant: MultibodyPlantConfig, friction: float
    ) -> tuple[Ground, MultibodyPlantConfig]:
        if plant.discrete_contact_approximation not in _CREEPING:
            found = plant.discrete_contact_approximation
            raise InputError(
                "plant.discrete_contact_approximation: FootCreep needs lagged or similar, found "
                f"{found}"
            )
        changed = copy(plant)
        changed.stiction_tolerance += self.creep * friction
        return ground, changed

    @staticmethod
    def sole_motion(
        pad_force: np.ndarray, pad_positions: np.ndarray, time: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        # Velocity (v_x, v_y) of the origin and rate w about z so that the pads' forces -F_n
        # (v + w x p) add up to what they are; a point has no such rate.
        x, y, _ = pad_positions.T
        ones, zeros = np.ones_like(x), np.zeros_like(x)
        motion = np.stack(
            [np.stack([ones, zeros, -y], axis=1), np.stack([zeros, ones, x], axis=1)], axis=1
        )
        load = np.maximum(pad_force[:, :, 2], _LEAST_LOAD)
        resistance = np.einsum("np,pia,pib->nab", load, motion, motion)
        push = np.einsum("npi,pia->na", pad_force[:, :, :2], motion)
        known, rate = 3 if len(x) > 1 else 2, np.zeros_like(push)
        right = push[:, :known, None]
        rate[:, :known] = -np.linalg.solve(resistance[:, :known, :known], right)[:, :, 0]
        v_x, v_y, w = np.cumsum(rate * np.diff(time, prepend=time[:1])[:, None], axis=0).T
        zero = np.zeros(len(time))
        return np.stack([zero, zero, w], axis=1)[None], np.stack([v_x, v_y, zero], axis=1)[None]


@dataclass(frozen=True)
class PadContact:
    """How the contact of one pad gives way: normal
    force = stiffness * depth * (1 + dissipation * d(depth)/dt) (Hunt and Crossley 1975)."""

    # [N/m], [s/m]; of pad and ground together.
    stiffness: float
    dissipation: float
    # Velocity at which it creeps per tangential over normal force [m/s].
    creep: float
    # Coulomb friction coefficient.
    friction: float

    @property
    def retardation(self) -> float:
        """By how long depth follows a force late, per force [s/N]."""
        return self.dissipation / self.stiffness


def pad_contact(description: str, ground: Ground, plant: MultibodyPlantConfig) -> PadContact:
    """The contact between a robot's pads and the ground, as Drake combines the two and solves it
    with these settings."""
    slides = plant.discrete_contact_approximation in _CREEPING
    friction = _friction(description, ground)
    creep = plant.stiction_tolerance / friction if slides and ground.friction > 0 else 0.0
    properties = _pad_properties(description)
    of_pad = properties.GetPropertyOrDefault("material", "point_contact_stiffness", np.inf)
    dissipation = properties.GetPropertyOrDefault(
        "material", "hunt_crossley_dissipation", ground.dissipation
    )
    if np.isinf(of_pad):
        return PadContact(ground.stiffness, ground.dissipation, creep, friction)
    total = of_pad + ground.stiffness
    return PadContact(
        of_pad * ground.stiffness / total,
        (ground.stiffness * dissipation + of_pad * ground.dissipation) / total,
        creep,
        friction,
    )


def spring_force(normal_force: np.ndarray, retardation: float, period: float) -> np.ndarray:
    """Share of the normal force on each pad that the contact's spring carries: stiffness times
    depth, without the dissipation.

    Args:
        normal_force: shape (N, P) [N].
        retardation: dissipation over stiffness, see `PadContact` [s/N].
        period: between samples [s].
    """
    pushed = np.maximum(normal_force, 0.0)
    if retardation == 0.0:
        return pushed
    result = np.empty_like(pushed)
    _fill_spring_force(result, pushed, period / retardation)
    return result


@njit(cache=True)
def _fill_spring_force(spring: np.ndarray, force: np.ndarray, rate: float) -> None:
    # d(spring)/dt = (force / spring - 1) / retardation, by implicit Euler: stable
    # however shallow the contact is.
    samples, pads = force.shape
    for pad in range(pads):
        last = force[0, pad]
        for k in range(samples):
            b = rate - last
            last = 0.5 * (-b + math.sqrt(b * b + 4.0 * rate * force[k, pad]))
            spring[k, pad] = last
