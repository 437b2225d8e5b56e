"""Joint friction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from fbse_drake.effects.effect import Parameter, in_library
from fbse_drake.effects.joint_torque import (
    JointMotion,
    JointTorqueEffect,
    OnDemand,
    Reduction,
    Rise,
)

_COULOMB = Parameter("Nm", linear=True, plausible=(0.0, 50.0))
_VISCOUS = Parameter("Nm s/rad", linear=True, plausible=(0.0, 30.0))
# Velocity at which the smoothed sign has grown to tanh(1) = 0.76.
_TRANSITION = Parameter("rad/s", linear=False, plausible=(1e-3, 5e-2), bounds=(1e-9, np.inf))
# Friction that falls with speed does so by this share of what it falls to; what hardly does is a
# Coulomb friction that is smeared.
_LEAST_FALL = 0.05
# Where time is told from place: by so many ranges of the angle and both directions, of which at
# least this share of the scatter of time does not follow.
_PLACES, _REPEATED = 8, 0.5


def _sharp() -> dict[str, float]:
    return {"all": 0.01}


def smooth_sign(
    velocity: np.ndarray, transition: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """tanh(velocity / transition) and its derivative with respect to the velocity."""
    tanh = np.tanh(velocity / transition)
    return tanh, (1.0 - tanh * tanh) / transition


def _tanh_each_once(rates: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """tanh(rates * velocity). A search tries many sets of rates, (m, G, 1, 1), that differ in one:
    what repeats is evaluated once."""
    if rates.ndim < 4 or rates.shape[2:] != (1, 1):
        return np.tanh(rates * velocity)
    values, place = np.unique(rates, return_inverse=True)
    return np.tanh(values[:, None, None] * velocity)[place.reshape(rates.shape[:2])]


@in_library
@dataclass(frozen=True)
class CoulombFriction(JointTorqueEffect):
    """Coulomb friction with the sign smoothed: u = coulomb tanh(w / transition)."""

    description: ClassVar[str] = "Friction of constant size against the motion."
    signature: ClassVar[str] = (
        "Torque jumps when the velocity changes sign and is constant otherwise."
    )
    experiment: ClassVar[str] = "Move each joint to and fro."
    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {"coulomb": _COULOMB, "transition": _TRANSITION}

    coulomb: dict[str, float] = field(default_factory=dict)
    transition: dict[str, float] = field(default_factory=_sharp)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray | float]]:
        sign, slope = smooth_sign(motion.velocity, nonlinear[0])
        return (sign,), (slope,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(speeds=(nonlinear[0],))

    @staticmethod
    def in_part() -> type[JointTorqueEffect]:
        """Below its transition."""
        return ViscousFriction


@in_library
@dataclass(frozen=True)
class ViscousFriction(JointTorqueEffect):
    """Viscous friction: u = viscous w."""

    description: ClassVar[str] = (
        "Friction in proportion to speed, as of grease and of the motor's own damping."
    )
    signature: ClassVar[str] = "Torque rises linearly with the velocity, without a jump at rest."
    experiment: ClassVar[str] = "Move each joint at several constant speeds."
    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {"viscous": _VISCOUS}

    viscous: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        return (motion.velocity,), (1.0,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(damping=linear[0])


@in_library
@dataclass(frozen=True)
class CoulombViscousFriction(JointTorqueEffect):
    """Coulomb and viscous friction (paper eq. 57) with the sign smoothed: u = coulomb
    tanh(w / transition) + viscous w."""

    description: ClassVar[str] = (
        "Friction of constant size against the motion, plus a part that grows with speed."
    )
    signature: ClassVar[str] = (
        "Torque jumps when the velocity changes sign and rises linearly with it."
    )
    experiment: ClassVar[str] = "Move each joint to and fro at several constant speeds."
    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": _COULOMB,
        "viscous": _VISCOUS,
        "transition": _TRANSITION,
    }
    composite: ClassVar[bool] = True
    reductions: ClassVar[tuple[Reduction, ...]] = (
        Reduction({"viscous": 0.0}, (CoulombFriction,)),
        Reduction({"coulomb": 0.0}, (ViscousFriction,)),
    )

    coulomb: dict[str, float] = field(default_factory=dict)
    viscous: dict[str, float] = field(default_factory=dict)
    transition: dict[str, float] = field(default_factory=_sharp)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray | float]]:
        sign, slope = smooth_sign(motion.velocity, nonlinear[0])
        return (sign, motion.velocity), (slope, 1.0)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(linear[1], (nonlinear[0],))


@in_library
@dataclass(frozen=True)
class StribeckFriction(JointTorqueEffect):
    """Continuously differentiable friction with static, Stribeck, Coulomb and viscous parts (Makkar
    et al. 2005, paper eq. 56):

    u = gamma1 (tanh(gamma2 w) - tanh(gamma3 w)) + gamma4 tanh(gamma5 w) + gamma6 w
    """

    description: ClassVar[str] = (
        "Friction that is largest just after the joint starts to move, then falls, then grows with "
        "speed."
    )
    signature: ClassVar[str] = (
        "Torque changes sign with the velocity and peaks at a few hundredths of a rad/s."
    )
    experiment: ClassVar[str] = (
        "Move each joint to and fro at several constant speeds, some below 0.05 rad/s."
    )
    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "gamma1": Parameter(
            "Nm",
            linear=True,
            plausible=(0.0, 20.0),
            meaning="friction at the start of a motion in excess of Coulomb friction",
        ),
        "gamma2": Parameter(
            "s/rad",
            linear=False,
            plausible=(50.0, 500.0),
            meaning="how steeply that excess rises with speed",
        ),
        "gamma3": Parameter(
            "s/rad",
            linear=False,
            plausible=(1.0, 25.0),
            meaning="how fast it falls again with more speed (Stribeck effect)",
        ),
        "gamma4": Parameter("Nm", linear=True, plausible=(0.0, 50.0), meaning="Coulomb friction"),
        "gamma5": Parameter(
            "s/rad",
            linear=False,
            plausible=(20.0, 500.0),
            meaning="how steeply Coulomb friction rises with speed",
        ),
        "gamma6": Parameter(
            "Nm s/rad", linear=True, plausible=(0.0, 30.0), meaning="viscous friction"
        ),
    }
    reductions: ClassVar[tuple[Reduction, ...]] = (
        Reduction({"gamma1": 0.0, "gamma6": 0.0}, (CoulombFriction,)),
        Reduction({"gamma1": 0.0, "gamma4": 0.0}, (ViscousFriction,)),
        Reduction({"gamma1": 0.0}, (CoulombViscousFriction,)),
        Reduction({"gamma1": 0.0}, (CoulombFriction, ViscousFriction)),
    )

    # Defaults are the paper's Table I where all joints share a value.
    gamma1: dict[str, float] = field(default_factory=dict)
    gamma2: dict[str, float] = field(default_factory=lambda: {"all": 100.0})
    gamma3: dict[str, float] = field(default_factory=lambda: {"all": 10.0})
    gamma4: dict[str, float] = field(default_factory=dict)
    gamma5: dict[str, float] = field(default_factory=lambda: {"all": 100.0})
    gamma6: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def is_itself(values: Mapping[str, float], reached: float) -> bool:
        """Does it fall with speed, viscous friction aside? Of that is all that is a straight line
        at the speed that was reached."""
        gamma1, gamma4 = values["gamma1"], values["gamma4"]
        rises, falls, coulomb = (values[name] for name in ("gamma2", "gamma3", "gamma5"))
        speed = np.geomspace(min(0.1 / max(rises, coulomb), 0.1 * reached), reached, 200)
        friction = gamma1 * (np.tanh(rises * speed) - np.tanh(falls * speed))
        friction += gamma4 * np.tanh(coulomb * speed)
        friction -= np.gradient(friction, speed)[-1] * speed
        return bool(friction.max() > (1.0 + _LEAST_FALL) * friction[-1])

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray | float]]:
        # Rows: gamma2, gamma3, gamma5.
        tanh = _tanh_each_once(nonlinear, motion.velocity)

        def slopes() -> Sequence[np.ndarray | float]:
            slope = nonlinear * (1.0 - tanh * tanh)
            return slope[0] - slope[1], slope[2], 1.0

        return (tanh[0] - tanh[1], tanh[2], motion.velocity), OnDemand(slopes)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        with np.errstate(divide="ignore"):
            return Rise(linear[2], (1.0 / nonlinear[0], 1.0 / nonlinear[2]))


@in_library
@dataclass(frozen=True)
class DirectionalFriction(JointTorqueEffect):
    """What friction has more in one direction than in the other: u = asymmetry
    tanh(w / transition)^2.

    Beside Coulomb friction, whose size is then coulomb + asymmetry forwards and coulomb - asymmetry
    backwards.
    """

    description: ClassVar[str] = "Friction is larger in one direction of motion than in the other."
    signature: ClassVar[str] = "Torque of the same sign in both directions, none at rest."
    experiment: ClassVar[str] = "Move each joint to and fro, with stops between."
    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "asymmetry": Parameter(
            "Nm", linear=True, plausible=(-10.0, 10.0), bounds=(-np.inf, np.inf)
        ),
        "transition": _TRANSITION,
    }

    asymmetry: dict[str, float] = field(default_factory=dict)
    transition: dict[str, float] = field(default_factory=_sharp)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        sign, slope = smooth_sign(motion.velocity, nonlinear[0])
        return (sign * sign,), (2.0 * sign * slope,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(speeds=(nonlinear[0],))


@in_library
@dataclass(frozen=True)
class DirectionalViscousFriction(JointTorqueEffect):
    """What viscous friction has more in one direction than in the other: u = asymmetry |w|.

    Beside viscous friction, whose coefficient is then viscous + asymmetry forwards and
    viscous - asymmetry backwards.
    """

    description: ClassVar[str] = (
        "Friction grows faster with speed in one direction of motion than in the other."
    )
    signature: ClassVar[str] = (
        "Torque of the same sign in both directions that rises with the speed."
    )
    experiment: ClassVar[str] = "Move each joint to and fro at several constant speeds."
    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "asymmetry": Parameter(
            "Nm s/rad", linear=True, plausible=(-10.0, 10.0), bounds=(-np.inf, np.inf)
        ),
    }

    asymmetry: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        return (np.abs(motion.velocity),), (np.sign(motion.velocity),)


@in_library
@dataclass(frozen=True)
class LoadDependentFriction(JointTorqueEffect):
    """Coulomb friction in proportion to what the gear transmits: u = coefficient |load|
    tanh(w / transition).

    The load is what reaches the link. To lift it slowly takes a command of (1 + coefficient) load,
    to let it down one of (1 - coefficient) load.
    """

    description: ClassVar[str] = "Friction that grows with the torque through the gear."
    signature: ClassVar[str] = (
        "Torque against the motion that is large in stance and small in swing."
    )
    experiment: ClassVar[str] = "Move each joint to and fro with and without load."
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "coefficient": Parameter("1", linear=True, plausible=(0.0, 0.5), bounds=(0.0, 1.0)),
        "transition": _TRANSITION,
    }

    coefficient: dict[str, float] = field(default_factory=dict)
    transition: dict[str, float] = field(default_factory=_sharp)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        load = np.abs(motion.load)
        sign, slope = smooth_sign(motion.velocity, nonlinear[0])
        return (load * sign,), (load * slope,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(speeds=(nonlinear[0],))


@in_library
@dataclass(frozen=True)
class QuadraticDrag(JointTorqueEffect):
    """Drag of a fluid, as in a flooded or fast turning joint: u = drag w |w|."""

    description: ClassVar[str] = "Drag that grows with the square of the speed."
    signature: ClassVar[str] = "Torque against the motion that only shows at high speed."
    experiment: ClassVar[str] = "Move each joint slowly and as fast as it can."
    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "drag": Parameter("Nm s^2/rad^2", linear=True, plausible=(0.0, 10.0))
    }

    drag: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        speed = np.abs(motion.velocity)
        return (motion.velocity * speed,), (2.0 * speed,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(damping=linear[0] * typical.velocity)


@in_library
@dataclass(frozen=True)
class ThermalDrift(JointTorqueEffect):
    """Coulomb friction that changes while the joint warms up: u = change (1 - exp(-t / warm_up))
    tanh(w / transition)."""

    description: ClassVar[str] = "Friction that changes over minutes as the joint warms up."
    signature: ClassVar[str] = (
        "Torque against (or with) the motion that is not there at first and settles slowly."
    )
    experiment: ClassVar[str] = (
        "Repeat one motion from a cold start for longer than the warm-up takes."
    )
    parameters: ClassVar[dict[str, Parameter]] = {
        "change": Parameter("Nm", linear=True, plausible=(-20.0, 20.0), bounds=(-np.inf, np.inf)),
        # Much faster, and it would be Coulomb friction by another name.
        "warm_up": Parameter(
            "s", linear=False, plausible=(3.0, 1000.0), bounds=(1e-9, np.inf), grid=5
        ),
        "transition": _TRANSITION,
    }
    reductions: ClassVar[tuple[Reduction, ...]] = (Reduction({"warm_up": 0.0}, (CoulombFriction,)),)

    change: dict[str, float] = field(default_factory=dict)
    warm_up: dict[str, float] = field(default_factory=lambda: {"all": 60.0})
    transition: dict[str, float] = field(default_factory=_sharp)

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        warm_up, transition = nonlinear
        warmth = -np.expm1(-motion.time / warm_up)
        sign, slope = smooth_sign(motion.velocity, transition)
        return (warmth * sign,), (warmth * slope,)

    @classmethod
    def shows_in(cls, motion: JointMotion) -> bool:
        """Where the joint does again what it did before: of one way there and back nobody can say
        whether time has changed the friction or the angle has."""
        sign = smooth_sign(motion.velocity, _sharp()["all"])[0].ravel()
        time, position = np.ravel(motion.time), np.ravel(motion.position)
        edges = np.quantile(position, np.linspace(0.0, 1.0, _PLACES + 1)[1:-1])
        place = np.searchsorted(edges, position)
        left, whole = 0.0, 0.0
        for forward in (True, False):
            weight = np.where((sign > 0) == forward, sign**2, 0.0)
            at = np.bincount(place, weight, _PLACES)
            mean = np.bincount(place, weight * time, _PLACES) / np.maximum(at, 1e-12)
            left += float(weight @ (time - mean[place]) ** 2)
            whole += float(weight @ (time - weight @ time / max(weight.sum(), 1e-12)) ** 2)
        return left > _REPEATED * whole

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(speeds=(nonlinear[1],))


# The friction laws that an estimator can adopt: those that depend on the velocity alone, with all
# that friction has at least.
FrictionModel = StribeckFriction | CoulombViscousFriction
