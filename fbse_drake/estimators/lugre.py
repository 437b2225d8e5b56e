"""Friction by an observer of the bristles' deflection, to be compared with FBSE."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.estimator import in_library
from fbse_drake.estimators.learned import LearnedFriction


@in_library
@dataclass(frozen=True)
class LuGreFriction(LearnedFriction):
    """The LuGre model with its sizes adapted (Canudas de Wit and Lischinsky 1997).

    A bristle's deflection z, in units of the one that carries the Coulomb torque, follows
    z_dot = (w - |w| z / h(w)) / breakaway with h(w) = 1 + (static - 1) exp(-(w / v)^2); then
    u = coulomb z + viscous w / (1 rad/s). Below the breakaway the joint is a spring, which is what
    it knows of friction at rest; there the encoder must resolve the deflection.
    """

    knows: ClassVar[str] = "inertia of all links, shape of the friction law and its bristles"

    # Deflection that carries the Coulomb torque [rad].
    breakaway: float = 1e-4
    # Static over Coulomb torque, and the velocity v at which the excess has fallen to 1/e [rad/s].
    static: float = 1.3
    stribeck_velocity: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "breakaway", "stribeck_velocity")
        if not self.static >= 1:
            raise InputError(f"static: expected a number >= 1, found {self.static:g}")

    @property
    def parameters(self) -> int:
        return 2

    @property
    def memory(self) -> int:
        return 1

    @property
    def smallest(self) -> float:
        return 0.0

    def regressor(
        self, velocity: np.ndarray, memory: np.ndarray, elapsed: float
    ) -> tuple[np.ndarray, np.ndarray]:
        level = 1 + (self.static - 1) * np.exp(-((velocity / self.stribeck_velocity) ** 2))
        # Exact for a velocity that is constant over the tick, and so stable at any length of it.
        travel = np.abs(velocity) * elapsed / (self.breakaway * level)
        end = level * np.sign(velocity)
        deflection = end + (memory[:, 0] - end) * np.exp(-travel)
        return np.stack([deflection, velocity], axis=1), deflection[:, None]
