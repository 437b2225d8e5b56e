"""Effects that the library does not have. Blind exercises hide them, to see whether the diagnosis
admits that it does not know."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from fbse_drake.effects.effect import Parameter
from fbse_drake.effects.friction import smooth_sign
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, Rise

# Velocity over which friction changes its sign [rad/s].
_TRANSITION = 0.01
_SHARP = Rise(speeds=(np.array(_TRANSITION),))
# Frequencies of the two waves that make dropouts look random [Hz]; their ratio is that of the
# golden section.
_DROPOUT_FREQUENCIES = (1.9, 1.9 * (1 + 5**0.5) / 2)
# The torque drops while the sum of the two waves is above this.
_DROPOUT_LEVEL = 1.7


@dataclass(frozen=True)
class TorqueHum(JointTorqueEffect):
    """A torque that swings in time, whatever the joint does: u = amplitude sin(2 pi frequency
    t)."""

    description: ClassVar[str] = "A torque of fixed frequency, as from a fan or the mains."
    signature: ClassVar[str] = "One line in the spectrum."
    experiment: ClassVar[str] = "Hold each joint still."
    parameters: ClassVar[dict[str, Parameter]] = {
        "amplitude": Parameter("Nm", linear=True, plausible=(0.0, 10.0)),
        "frequency": Parameter("Hz", linear=False, plausible=(0.5, 20.0)),
    }

    amplitude: dict[str, float] = field(default_factory=dict)
    frequency: dict[str, float] = field(default_factory=lambda: {"all": 5.0})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        return (np.sin(2 * np.pi * nonlinear[0] * motion.time),), (0.0,)


@dataclass(frozen=True)
class NeighbourTorque(JointTorqueEffect):
    """Some of the torque that is commanded to the joint before it in the order of the joints: u =
    share * command of the neighbour."""

    description: ClassVar[str] = (
        "A joint feels the torque of its neighbour, as through crossed wires or a coupled gear."
    )
    signature: ClassVar[str] = "Torque in proportion to another joint's command."
    experiment: ClassVar[str] = "Load one joint at a time."
    parameters: ClassVar[dict[str, Parameter]] = {
        "share": Parameter("1", linear=True, plausible=(-0.5, 0.5), bounds=(-np.inf, np.inf)),
    }

    share: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        return (np.roll(motion.command, 1, axis=-1),), (0.0,)


@dataclass(frozen=True)
class UnevenFriction(JointTorqueEffect):
    """Coulomb friction that changes along the way: u = coulomb (1 + unevenness sin(3 q)) tanh(w /
    0.01 rad/s)."""

    description: ClassVar[str] = "Friction that depends on the angle, as of a bent shaft."
    signature: ClassVar[str] = (
        "Torque against the motion whose size is a wave over the joint angle."
    )
    experiment: ClassVar[str] = "Move each joint to and fro through a large angle."
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "unevenness": Parameter("1", linear=False, plausible=(0.1, 1.0)),
    }

    coulomb: dict[str, float] = field(default_factory=dict)
    unevenness: dict[str, float] = field(default_factory=lambda: {"all": 0.9})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        size = 1.0 + nonlinear[0] * np.sin(3.0 * motion.position)
        sign, slope = smooth_sign(motion.velocity, _TRANSITION)
        return (size * sign,), (size * slope,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return _SHARP


@dataclass(frozen=True)
class TorqueDropouts(JointTorqueEffect):
    """The motor lacks a share of the commanded torque for moments that seem to come at random: u =
    depth * command, or 0 between them."""

    description: ClassVar[str] = "The motor fails for moments, as from a loose contact."
    signature: ClassVar[str] = "Torque in proportion to the command, now and then."
    experiment: ClassVar[str] = "Hold each joint under load for long."
    parameters: ClassVar[dict[str, Parameter]] = {
        "depth": Parameter("1", linear=True, plausible=(0.0, 1.0))
    }

    depth: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        wave = np.sum([np.sin(2 * np.pi * f * motion.time) for f in _DROPOUT_FREQUENCIES], axis=0)
        return (motion.command * (wave > _DROPOUT_LEVEL),), (0.0,)


@dataclass(frozen=True)
class RoughSpot(JointTorqueEffect):
    """Friction about one angle only: u = coulomb exp(-((q - angle) / width)^2) tanh(w / 0.01
    rad/s)."""

    description: ClassVar[str] = "A joint that sticks at one angle, as from a dent in a bearing."
    signature: ClassVar[str] = "Torque against the motion within a small range of angles."
    experiment: ClassVar[str] = "Move each joint slowly through a large angle."
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "angle": Parameter("rad", linear=False, plausible=(-3.0, 3.0), bounds=(-np.inf, np.inf)),
        "width": Parameter("rad", linear=False, plausible=(0.01, 0.2), bounds=(1e-9, np.inf)),
    }

    coulomb: dict[str, float] = field(default_factory=dict)
    angle: dict[str, float] = field(default_factory=lambda: {"all": 0.0})
    width: dict[str, float] = field(default_factory=lambda: {"all": 0.05})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        angle, width = nonlinear
        bump = np.exp(-(((motion.position - angle) / width) ** 2))
        sign, slope = smooth_sign(motion.velocity, _TRANSITION)
        return (bump * sign,), (bump * slope,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return _SHARP


STRANGERS: dict[str, type[JointTorqueEffect]] = {
    effect.__name__: effect
    for effect in (TorqueHum, NeighbourTorque, UnevenFriction, TorqueDropouts, RoughSpot)
}
