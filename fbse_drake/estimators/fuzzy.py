"""Friction by a fuzzy system, to be compared with FBSE."""

from dataclasses import dataclass, field

import numpy as np

from fbse_drake.errors import InputError
from fbse_drake.estimators.estimator import in_library
from fbse_drake.estimators.learned import LearnedFriction


@in_library
@dataclass(frozen=True)
class FuzzyFriction(LearnedFriction):
    """Takagi-Sugeno rules "if w is about c then u = a + b w" whose a and b are adapted (Wang 1993).

    Membership falls linearly from 1 at a rule's velocity to 0 at its neighbours', and stays 1
    beyond the outermost ones, so that memberships add up to 1 and every law that is straight
    between neighbours is met exactly. Rules of velocities that were not visited are not learned.
    """

    # Velocities of the rules on one side of zero [rad/s]; there are as many on the other, and zero.
    speeds: list[float] = field(default_factory=lambda: [0.005, 0.02, 0.1, 0.5, 2.0])

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.speeds or any(np.diff([0.0, *self.speeds]) <= 0):
            raise InputError("speeds: expected numbers > 0 in rising order")

    @property
    def parameters(self) -> int:
        return 2 * (2 * len(self.speeds) + 1)

    def memberships(self, velocity: np.ndarray) -> np.ndarray:
        """How far each rule holds, (n, rules)."""
        speeds = np.array(self.speeds)
        centres = np.concatenate([-speeds[::-1], [0.0], speeds])
        return np.stack([np.interp(velocity, centres, one) for one in np.eye(len(centres))], axis=1)

    def regressor(
        self,
        velocity: np.ndarray,
        memory: np.ndarray,
        elapsed: float,  # noqa: ARG002
    ) -> tuple[np.ndarray, np.ndarray]:
        membership = self.memberships(velocity)
        return np.hstack([membership, membership * velocity[:, None]]), memory
