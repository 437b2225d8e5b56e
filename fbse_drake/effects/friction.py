"""Joint friction."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, Parameter


@dataclass(frozen=True)
class StribeckFriction(JointTorqueEffect):
    """Continuously differentiable friction with static, Stribeck, Coulomb and viscous parts (Makkar et al. 2005, paper eq. 56):

    u = gamma1 (tanh(gamma2 w) - tanh(gamma3 w)) + gamma4 tanh(gamma5 w) + gamma6 w
    """

    description: ClassVar[str] = "Friction that is largest just after the joint starts to move, then falls, then grows with speed."
    signature: ClassVar[str] = "Torque changes sign with the velocity and peaks at a few hundredths of a rad/s."
    experiment: ClassVar[str] = "Move each joint to and fro at several constant speeds, some below 0.05 rad/s."
    parameters: ClassVar[dict[str, Parameter]] = {
        "gamma1": Parameter("Nm", linear=True, plausible=(0.0, 20.0)),
        "gamma2": Parameter("s/rad", linear=False, plausible=(20.0, 500.0)),
        "gamma3": Parameter("s/rad", linear=False, plausible=(1.0, 50.0)),
        "gamma4": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "gamma5": Parameter("s/rad", linear=False, plausible=(20.0, 500.0)),
        "gamma6": Parameter("Nm s/rad", linear=True, plausible=(0.0, 30.0)),
    }

    # Defaults are the paper's Table I where all joints share a value.
    gamma1: dict[str, float] = field(default_factory=dict)
    gamma2: dict[str, float] = field(default_factory=lambda: {"all": 100.0})
    gamma3: dict[str, float] = field(default_factory=lambda: {"all": 10.0})
    gamma4: dict[str, float] = field(default_factory=dict)
    gamma5: dict[str, float] = field(default_factory=lambda: {"all": 100.0})
    gamma6: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(motion: JointMotion, nonlinear: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray | float]]:
        # Rows: gamma2, gamma3, gamma5.
        tanh = np.tanh(nonlinear * motion.velocity)
        slope = nonlinear * (1.0 - tanh * tanh)
        return (tanh[0] - tanh[1], tanh[2], motion.velocity), (slope[0] - slope[1], slope[2], 1.0)


@dataclass(frozen=True)
class CoulombViscousFriction(JointTorqueEffect):
    """Coulomb and viscous friction (paper eq. 57) with the sign smoothed: u = coulomb tanh(w / transition) + viscous w."""

    description: ClassVar[str] = "Friction of constant size against the motion, plus a part that grows with speed."
    signature: ClassVar[str] = "Torque jumps when the velocity changes sign and rises linearly with it."
    experiment: ClassVar[str] = "Move each joint to and fro at several constant speeds."
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "viscous": Parameter("Nm s/rad", linear=True, plausible=(0.0, 30.0)),
        "transition": Parameter("rad/s", linear=False, plausible=(1e-3, 5e-2), bounds=(1e-9, np.inf)),
    }

    coulomb: dict[str, float] = field(default_factory=dict)
    viscous: dict[str, float] = field(default_factory=dict)
    transition: dict[str, float] = field(default_factory=lambda: {"all": 0.01})

    @staticmethod
    def basis(motion: JointMotion, nonlinear: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray | float]]:
        (transition,) = nonlinear
        tanh = np.tanh(motion.velocity / transition)
        return (tanh, motion.velocity), ((1.0 - tanh * tanh) / transition, 1.0)


# The friction laws that a scenario can name.
FrictionModel = StribeckFriction | CoulombViscousFriction
