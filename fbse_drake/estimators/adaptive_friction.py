"""Friction by an adaptive model of its known shape, to be compared with FBSE."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fbse_drake.errors import require_positive
from fbse_drake.estimators.estimator import in_library
from fbse_drake.estimators.learned import LearnedFriction


@in_library
@dataclass(frozen=True)
class AdaptiveFriction(LearnedFriction):
    """Coulomb, viscous and Stribeck friction whose sizes are adapted (Slotine and Li 1987, 1989).

    u = coulomb s + viscous w / (1 rad/s) + stribeck exp(-(w / stribeck_velocity)^2) s with
    s = tanh(w / transition); none of the three is negative. Where the shape is right it learns the
    friction itself; of a joint at rest it knows nothing, for there the friction takes any value.
    """

    knows: ClassVar[str] = "inertia of all links, shape of the friction law"

    # Velocity at which the smoothed sign has grown to tanh(1) [rad/s].
    transition: float = 0.01
    # Velocity at which the static friction's excess has fallen to 1/e [rad/s].
    stribeck_velocity: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "transition", "stribeck_velocity")

    @property
    def parameters(self) -> int:
        return 3

    @property
    def smallest(self) -> float:
        return 0.0

    def regressor(
        self,
        velocity: np.ndarray,
        memory: np.ndarray,
        elapsed: float,  # noqa: ARG002
    ) -> tuple[np.ndarray, np.ndarray]:
        sign = np.tanh(velocity / self.transition)
        falling = np.exp(-((velocity / self.stribeck_velocity) ** 2)) * sign
        return np.stack([sign, velocity, falling], axis=1), memory
