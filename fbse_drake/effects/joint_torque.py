"""Joint torque effects: one definition each for simulation, prediction and identification.

An effect is a torque loss u in `tau_command = u + tau_link` (paper eq. 34), positive when it eats positive torque. It is written as

    u(motion) = sum over linear parameters k of  theta_k * basis_k(motion; nonlinear parameters)

so that the same lines simulate it, predict it over a whole log and give the regressor to identify it.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
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

    A subclass gives the class variables below and the basis.
    """

    # One sentence each: what it is, what it looks like in data, which experiment shows it.
    description: ClassVar[str]
    signature: ClassVar[str]
    experiment: ClassVar[str]
    parameters: ClassVar[dict[str, Parameter]]

    @staticmethod
    @abstractmethod
    def basis(motion: JointMotion, nonlinear: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray | float]]:
        """Torque per unit of each linear parameter, and its derivative with respect to the joint velocity.

        Args:
            nonlinear: values of the nonlinear parameters in the order of `parameters`, shape (parameters, ..., n).

        Returns:
            Two sequences in the order of the linear parameters, items of shape (..., n).
        """

    def resolve(self, names: RobotDescription, *, key: str = "") -> "ResolvedEffect":
        """This effect with its values as arrays in joint order.

        Raises:
            InputError: unknown joint, a value out of bounds, or a nonlinear parameter without a value.
        """
        linear, nonlinear = [], []
        for name, parameter in self.parameters.items():
            default = 0.0 if parameter.linear else None
            values = names.per_joint(getattr(self, name), key=f"{key}.{name}".lstrip("."), default=default)
            low, high = parameter.bounds
            if not np.all((low <= values) & (values <= high)):
                raise InputError(f"{key}.{name}: expected values in [{low:g}, {high:g}] {parameter.unit}, found {values.tolist()}")
            (linear if parameter.linear else nonlinear).append(values)
        return ResolvedEffect(type(self), np.array(linear), np.array(nonlinear).reshape(-1, len(names.joint_names)))


@dataclass(frozen=True)
class ResolvedEffect:
    """A joint torque effect with values per joint."""

    effect: type[JointTorqueEffect]
    # In the order of the effect's `parameters`; each of shape (parameters, n).
    linear: np.ndarray
    nonlinear: np.ndarray

    def torque_and_slope(self, motion: JointMotion) -> tuple[np.ndarray, np.ndarray]:
        """Torque loss u [Nm] and its derivative with respect to the joint velocity [Nm s/rad], each of shape (..., n)."""
        nonlinear = self.nonlinear
        if motion.velocity.ndim > 1:
            # (parameters, n) -> (parameters, 1, ..., n), to go with the leading axes of the motion.
            nonlinear = np.expand_dims(nonlinear, tuple(range(1, motion.velocity.ndim)))
        basis, slopes = self.effect.basis(motion, nonlinear)
        torque, slope = self.linear[0] * basis[0], self.linear[0] * slopes[0]
        for theta, b, db in zip(self.linear[1:], basis[1:], slopes[1:], strict=True):
            torque, slope = torque + theta * b, slope + theta * db
        return torque, slope


def total_torque_and_slope(effects: Sequence[ResolvedEffect], motion: JointMotion) -> tuple[np.ndarray, np.ndarray]:
    """Torque loss of several effects together [Nm] and its slope [Nm s/rad], each of shape (..., n)."""
    if not effects:
        return np.zeros_like(motion.velocity), np.zeros_like(motion.velocity)
    torque, slope = effects[0].torque_and_slope(motion)
    for effect in effects[1:]:
        more_torque, more_slope = effect.torque_and_slope(motion)
        torque, slope = torque + more_torque, slope + more_slope
    return torque, slope
