"""Torques of gears and cables: springs, ripple, hysteresis, backlash."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numba import njit

from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import Parameter, in_library
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.effects.joint_torque import (
    JointMotion,
    JointTorqueEffect,
    Reduction,
    Rise,
    affine_recursion,
)


@in_library
@dataclass(frozen=True)
class TorqueRipple(JointTorqueEffect):
    """Torque that repeats with the joint's angle: u = sine sin(cycles q) + cosine cos(cycles q)."""

    description: ClassVar[str] = (
        "Torque that repeats with the angle of the joint, from gear teeth or motor poles."
    )
    signature: ClassVar[str] = "A wave over the joint angle, the same in both directions of motion."
    experiment: ClassVar[str] = "Move each joint slowly through a large angle."
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "sine": Parameter("Nm", linear=True, plausible=(-5.0, 5.0), bounds=(-np.inf, np.inf)),
        "cosine": Parameter("Nm", linear=True, plausible=(-5.0, 5.0), bounds=(-np.inf, np.inf)),
        # Over 1 rad of motion, a factor of 1.02 near the upper end is a quarter of a wave off.
        "cycles": Parameter(
            "1/revolution", linear=False, plausible=(6.0, 400.0), grid=200, closed=True
        ),
    }

    sine: dict[str, float] = field(default_factory=dict)
    cosine: dict[str, float] = field(default_factory=dict)
    cycles: dict[str, float] = field(default_factory=lambda: {"all": 50.0})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        angle = nonlinear[0] * motion.position
        return (np.sin(angle), np.cos(angle)), (0.0, 0.0)

    @classmethod
    def shows_within(cls, travel: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:
        """Half a wave at least: less of it is a spring."""
        return nonlinear[0] * travel > np.pi

    @staticmethod
    def in_part() -> type[JointTorqueEffect]:
        return JointSpring


@in_library
@dataclass(frozen=True)
class JointSpring(JointTorqueEffect):
    """A spring beside the motor, as of cables and hoses over the joint: u = stiffness
    q + preload."""

    description: ClassVar[str] = "A spring across the joint, as of cables and hoses."
    signature: ClassVar[str] = "Torque rises linearly with the joint angle."
    experiment: ClassVar[str] = "Hold each joint at several angles."
    parameters: ClassVar[dict[str, Parameter]] = {
        "stiffness": Parameter("Nm/rad", linear=True, plausible=(0.0, 200.0)),
        # The torque at angle zero.
        "preload": Parameter("Nm", linear=True, plausible=(-30.0, 30.0), bounds=(-np.inf, np.inf)),
    }
    reductions: ClassVar[tuple[Reduction, ...]] = (Reduction({"stiffness": 0.0}, (TorqueBias,)),)

    stiffness: dict[str, float] = field(default_factory=dict)
    preload: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray | float], Sequence[float]]:
        return (motion.position, 1.0), (0.0, 0.0)


@in_library
@dataclass(frozen=True)
class PreslidingHysteresis(JointTorqueEffect):
    """Coulomb friction that builds up over a displacement, like a bristle that bends before it
    slips (Dahl 1968):

    u = coulomb z,   dz/dt = w / displacement (1 - z sign(w))

    z, in [-1, 1], starts at 0 and is exact for a velocity that is constant over the step.
    """

    description: ClassVar[str] = (
        "Friction that builds up like a spring before the joint really slips."
    )
    signature: ClassVar[str] = (
        "After each reversal the torque changes over an angle, not at once: a loop over the joint "
        "angle."
    )
    experiment: ClassVar[str] = (
        "Move each joint to and fro by amounts from a thousandth to a tenth of a rad."
    )
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "displacement": Parameter(
            "rad", linear=False, plausible=(2e-4, 5e-2), bounds=(1e-9, np.inf)
        ),
    }
    has_memory: ClassVar[bool] = True
    reductions: ClassVar[tuple[Reduction, ...]] = (
        Reduction({"displacement": 0.0}, (CoulombFriction,)),
    )

    coulomb: dict[str, float] = field(default_factory=dict)
    displacement: dict[str, float] = field(default_factory=lambda: {"all": 0.005})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        (z,), rate = motion.memory, motion.time_step / nonlinear[0]
        sign = np.sign(motion.velocity)
        bent = (z - sign) * np.exp(-np.abs(motion.velocity) * rate)
        return (sign + bent,), (-bent * sign * rate + (sign == 0) * rate,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(speeds=(nonlinear[0] / typical.time_step,))

    @staticmethod
    def lean(memory: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return memory[0]

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return np.zeros((1, *nonlinear.shape[1:]))

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        (z,), _ = PreslidingHysteresis.basis(motion, nonlinear)
        return z[None]

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        keep = np.exp(-np.abs(motion.velocity) * motion.time_step / nonlinear[0])
        return affine_recursion(0.0, keep, (1.0 - keep) * np.sign(motion.velocity))[None]


@in_library
@dataclass(frozen=True)
class Backlash(JointTorqueEffect):
    """Play between motor and link: when the torque changes sign the motor crosses the gap, and
    until then nothing reaches the link.

    In the gap the rotor turns against the link with the acceleration command / rotor_inertia; the
    link's own motion is left out, and so is the impact at the other side. The step in which the gap
    closes counts in part. An encoder on the motor's side shows where the rotor is in the gap.
    """

    description: ClassVar[str] = (
        "Play in the gear, which the motor must cross whenever its torque changes sign."
    )
    signature: ClassVar[str] = (
        "No torque reaches the link for some milliseconds after the command changes sign."
    )
    experiment: ClassVar[str] = "Swing each joint so that its torque changes sign often."
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "gap": Parameter("rad", linear=False, plausible=(2e-4, 2e-2), neutral=0.0),
        "rotor_inertia": Parameter(
            "kg m^2", linear=False, plausible=(0.02, 1.0), bounds=(1e-9, np.inf), grid=3
        ),
    }
    has_memory: ClassVar[bool] = True
    deflects: ClassVar[bool] = True

    gap: dict[str, float] = field(default_factory=dict)
    rotor_inertia: dict[str, float] = field(default_factory=lambda: {"all": 0.25})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        _, _, share = _cross(motion, nonlinear)
        return (share * motion.command,), (0.0,)

    @classmethod
    def shows_in(cls, motion: JointMotion) -> bool:
        """Where the torque never changes sign the motor stays on one side, as with another zero of
        its encoder."""
        return bool(np.min(motion.command) < 0 < np.max(motion.command))

    @staticmethod
    def deflection(memory: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return memory[0]

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        gap, _ = nonlinear
        return np.stack([0.5 * gap * np.sign(motion.command), np.zeros_like(gap)])

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        offset, velocity, _ = _cross(motion, nonlinear)
        return np.stack([offset, velocity])

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        first = Backlash.start(motion._replace(command=motion.command[:1]), nonlinear)
        # Time first, all else in one axis.
        command, *values = np.broadcast_arrays(motion.command, *nonlinear)
        steps = [
            np.ascontiguousarray(np.moveaxis(array, -2, 0)).reshape(array.shape[-2], -1)
            for array in (command, *values)
        ]
        ends = _crossings(first[0].ravel(), first[1].ravel(), *steps, motion.time_step)[:2, :-1]
        ends = np.moveaxis(ends.reshape(2, -1, *command.shape[:-2], command.shape[-1]), 1, -2)
        return np.concatenate([first, ends], axis=-2)


def _cross(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
    """Result of `_crossings` for one step, (3, ...); the memory is offset and velocity at its
    start."""
    arrays = np.broadcast_arrays(*motion.memory, motion.command, *nonlinear)
    offset, velocity, *step = (np.ascontiguousarray(array).reshape(1, -1) for array in arrays)
    return _crossings(offset[0], velocity[0], *step, motion.time_step).reshape(3, *arrays[0].shape)


@njit(cache=True)
def _crossings(
    offset: np.ndarray,
    velocity: np.ndarray,
    command: np.ndarray,
    gap: np.ndarray,
    inertia: np.ndarray,
    time_step: float,
) -> np.ndarray:
    """Offset [rad] and velocity [rad/s] of rotors against their links at the end of each step, and
    for which share of the step they were free, (3, N, C).

    Args:
        offset, velocity: at the start, (C,); the offset is within half the gap to either side.
        command, gap, inertia: of each step, (N, C).
    """
    result = np.empty((3, *command.shape))
    for j in range(command.shape[1]):
        x, v = offset[j], velocity[j]
        for k in range(command.shape[0]):
            v += time_step * command[k, j] / inertia[k, j]
            travel, side = time_step * v, 0.5 * gap[k, j]
            room = side - np.sign(travel) * x
            share = 1.0
            if abs(travel) >= room:
                if travel != 0:
                    share = room / abs(travel)
                x, v = side * np.sign(travel), 0.0
            else:
                x += travel
            result[0, k, j], result[1, k, j], result[2, k, j] = x, v, share
    return result
