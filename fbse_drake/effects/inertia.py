"""Effects on a plant's inertia.

The same lines change the plant that is simulated, the model that is believed, and the model that the diagnosis tries out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from pydrake.multibody.tree import RigidBody

from fbse_drake.effects.effect import Effect, Parameter, in_library
from fbse_drake.errors import located
from fbse_drake.robot.plant import PointMass, Robot


@dataclass(frozen=True)
class InertiaEffect(Effect):
    """Base of the inertia effects. One that acts on joints adds rotor inertia to them, one that acts on bodies adds point masses; a
    subclass gives the one of the two functions that it needs. All its parameters are linear.
    """

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


def inertia_changes(effects: Mapping[str, Effect], robot: Robot) -> tuple[np.ndarray, list[PointMass]]:
    """What the inertia effects among some effects add to a robot: rotor inertia of each joint, shape (n,) [kg m^2], and point masses.

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
    """Inertia of rotor and gears as the joint feels it (that of the rotor times the gear ratio squared), beside a configured
    `rotor_inertia`."""

    description: ClassVar[str] = "Inertia of motor and gears, as felt at the joint."
    signature: ClassVar[str] = "Torque in step with the joint's own acceleration, also where the link barely loads the joint."
    experiment: ClassVar[str] = "Swing each joint fast, with the robot hanging and its feet free."
    parameters: ClassVar[dict[str, Parameter]] = {"inertia": Parameter("kg m^2", linear=True, plausible=(0.02, 0.6))}

    inertia: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def rotor_inertia(values: np.ndarray) -> np.ndarray:
        return values[0]


@in_library
@dataclass(frozen=True)
class BodyMass(InertiaEffect):
    """Mass at the centre of mass of a body; negative where the model has too much. A payload elsewhere is this with `BodyCentreOfMass`."""

    description: ClassVar[str] = "A body is heavier or lighter than the model says."
    signature: ClassVar[str] = "Too much or too little force under the feet, and torque in the joints that carry the body, with its weight."
    experiment: ClassVar[str] = "Squat and sway; for a leg's body also lift that leg."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"
    parameters: ClassVar[dict[str, Parameter]] = {"mass": Parameter("kg", linear=True, plausible=(-10.0, 10.0), bounds=(-np.inf, np.inf))}

    mass: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def point_masses(body: RigidBody, values: np.ndarray) -> list[PointMass]:
        return [PointMass(body.name(), values[0], body.default_com())]


@in_library
@dataclass(frozen=True)
class BodyCentreOfMass(InertiaEffect):
    """The centre of mass of a body, moved in the body's frame; its mass and its rotational inertia about the centre of mass stay.

    A body of mass m whose centre of mass moves from c to c + d differs by the point masses -m at c and m at c + d: exactly what is said
    above, and linear in d but for the part d^2 of the rotational inertia.
    """

    description: ClassVar[str] = "The centre of mass of a body is elsewhere than the model says."
    signature: ClassVar[str] = "Moments and joint torques with the body's weight and tilt, but the right force under the feet."
    experiment: ClassVar[str] = "Squat and sway slowly; for its height, tilt or accelerate the body."
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "body"
    parameters: ClassVar[dict[str, Parameter]] = {
        axis: Parameter("m", linear=True, plausible=(-0.05, 0.05), bounds=(-np.inf, np.inf)) for axis in "xyz"
    }

    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def point_masses(body: RigidBody, values: np.ndarray) -> list[PointMass]:
        mass, com = body.default_mass(), body.default_com()
        return [PointMass(body.name(), -mass, com), PointMass(body.name(), mass, com + values)]
