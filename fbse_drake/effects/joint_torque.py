"""Joint torque effects: one definition each for simulation, prediction and identification.

An effect is a torque loss u in `tau_command = u + tau_link` (paper eq. 34), positive when it eats positive torque. It is written as

    u(motion) = sum over linear parameters k of  theta_k * basis_k(motion; nonlinear parameters)

so that the same lines simulate it, predict it over a whole log and give the regressor to identify it.
"""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fbse_drake.errors import InputError
from fbse_drake.robot.description import RobotDescription


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect, per joint."""

    unit: str
    # Does the torque depend on it linearly?
    linear: bool
    # What it plausibly is on a legged robot.
    plausible: tuple[float, float]
    # What it can be at all.
    bounds: tuple[float, float] = (0.0, np.inf)


@dataclass(frozen=True)
class JointMotion:
    """What a joint torque effect can depend on; any leading axes (time), the last one is the joints."""

    # Joint velocity [rad/s], shape (..., n).
    velocity: np.ndarray


@dataclass(frozen=True)
class JointTorqueEffect(ABC):
    """Base of the joint torque effects: a frozen dataclass with one field per parameter, each a value by joint
    (see `RobotDescription.per_joint`); a joint that is not named has the value 0 for linear parameters.

    A subclass gives the class variables below and the two basis functions.
    """

    # One sentence each: what it is, what it looks like in data, which experiment shows it.
    description: ClassVar[str]
    signature: ClassVar[str]
    experiment: ClassVar[str]
    parameters: ClassVar[dict[str, Parameter]]

    @staticmethod
    @abstractmethod
    def basis(motion: JointMotion, nonlinear: Mapping[str, np.ndarray]) -> Sequence[np.ndarray]:
        """Torque per unit of each linear parameter, in the order of `parameters`; each of shape (..., n)."""

    @staticmethod
    @abstractmethod
    def basis_slope(motion: JointMotion, nonlinear: Mapping[str, np.ndarray]) -> Sequence[np.ndarray]:
        """Derivative of `basis` with respect to the joint velocity."""

    def resolve(self, names: RobotDescription, *, key: str = "") -> "ResolvedEffect":
        """This effect with its values as arrays in joint order.

        Raises:
            InputError: unknown joint, a value out of bounds, or a nonlinear parameter without a value.
        """
        linear, nonlinear = [], {}
        for name, parameter in self.parameters.items():
            default = 0.0 if parameter.linear else None
            values = names.per_joint(getattr(self, name), key=f"{key}.{name}".lstrip("."), default=default)
            low, high = parameter.bounds
            if not np.all((low <= values) & (values <= high)):
                raise InputError(f"{key}.{name}: expected values in [{low:g}, {high:g}] {parameter.unit}, found {values.tolist()}")
            if parameter.linear:
                linear.append(values)
            else:
                nonlinear[name] = values
        return ResolvedEffect(type(self), linear, nonlinear)


@dataclass(frozen=True)
class ResolvedEffect:
    """A joint torque effect with values per joint, arrays of shape (n,)."""

    effect: type[JointTorqueEffect]
    linear: list[np.ndarray]
    nonlinear: dict[str, np.ndarray]

    def torque(self, motion: JointMotion) -> np.ndarray:
        """Torque loss u [Nm], shape (..., n)."""
        return sum(t * b for t, b in zip(self.linear, self.effect.basis(motion, self.nonlinear), strict=True))

    def slope(self, motion: JointMotion) -> np.ndarray:
        """Derivative of the torque loss with respect to the joint velocity [Nm s/rad], shape (..., n)."""
        return sum(t * b for t, b in zip(self.linear, self.effect.basis_slope(motion, self.nonlinear), strict=True))


def check_parameters(effect: type[JointTorqueEffect]) -> None:
    """Raises TypeError where the fields of an effect and its `parameters` differ."""
    fields = [field.name for field in dataclasses.fields(effect)]
    if fields != list(effect.parameters):
        raise TypeError(f"{effect.__name__}: fields {fields} and parameters {list(effect.parameters)} must be the same")
