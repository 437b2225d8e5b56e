"""Torques that hold a link's weight: springs and weights of a counterbalance."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from fbse_drake.effects.effect import Parameter, in_library
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect


@in_library
@dataclass(frozen=True)
class Counterbalance(JointTorqueEffect):
    """What a counterbalance takes, as a spring over a crank: u = k cos(q - q0).

    Written as u = cosine cos q + sine sin q, which is linear: k = hypot(cosine, sine) and
    q0 = atan2(sine, cosine).
    """

    description: ClassVar[str] = (
        "A spring or a weight that holds the link up, or that the model holds and the robot lacks."
    )
    signature: ClassVar[str] = (
        "One wave of torque over a whole turn of the joint, whatever its speed and acceleration."
    )
    experiment: ClassVar[str] = (
        "Hold each joint at several angles, more than a quarter of a turn apart."
    )
    parameters: ClassVar[dict[str, Parameter]] = {
        name: Parameter("Nm", linear=True, plausible=(-500.0, 500.0), bounds=(-np.inf, np.inf))
        for name in ("cosine", "sine")
    }

    cosine: dict[str, float] = field(default_factory=dict)
    sine: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        return (np.cos(motion.position), np.sin(motion.position)), (0.0, 0.0)

    @classmethod
    def shows_within(cls, travel: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG003
        """A quarter of a turn at least, over which its slope changes by all of itself: less of it
        is a spring."""
        return travel > 0.5 * np.pi

    @staticmethod
    def in_part() -> type[JointTorqueEffect]:
        # Modules are imported in the order of the library, by which exercises are drawn.
        from fbse_drake.effects.transmission import JointSpring

        return JointSpring
