"""A friction law as the regressor of its linear parameters."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.robot.plant import Robot


@dataclass(frozen=True)
class FrictionRegressor:
    """A joint torque effect as a regressor.

    It gives the basis torques, (n,) for each parameter, at a velocity (n,).
    """

    effect: type[JointTorqueEffect]
    # Values of the nonlinear parameters (nonlinear, n), and of the linear ones to start with
    # (n, parameters).
    nonlinear: np.ndarray
    initial: np.ndarray
    # The nonlinear parameters may be wrong by these factors: beside each basis torque that they
    # change there is its difference for each factor, with a weight of zero to start with.
    factors: tuple[float, ...] = ()

    @staticmethod
    def of(
        model: JointTorqueEffect, robot: Robot, factors: tuple[float, ...] = ()
    ) -> "FrictionRegressor":
        """Raises InputError for an unknown joint."""
        resolved = model.resolve(robot.description, key="estimator.friction.model")
        effect, nonlinear = resolved.effect, resolved.nonlinear
        return FrictionRegressor(effect, nonlinear, resolved.linear.T.copy(), factors)

    @property
    def parameters(self) -> int:
        """How many linear parameters the model has."""
        return self.initial.shape[1]

    @cached_property
    def shaped(self) -> np.ndarray:
        """Which parameters' basis torques change with the nonlinear parameters."""
        # Slow and fast: a sharp sign has long levelled off where a blunt one still rises.
        velocity = np.geomspace(1e-6, 10.0, 50)[:, None] * np.ones(len(self.initial))
        one, two = (f * self.nonlinear[:, None] for f in (1.0, 2.0))
        basis, other = (self.effect.basis(JointMotion(velocity), x)[0] for x in (one, two))
        changes = [np.any(x != y) for x, y in zip(basis, other, strict=True)]
        return np.flatnonzero(changes) if self.factors else np.empty(0, dtype=int)

    @property
    def weights(self) -> int:
        """How many parameters and differences there are."""
        return self.parameters + len(self.shaped) * len(self.factors)

    @cached_property
    def _all_nonlinear(self) -> np.ndarray:
        return np.hstack([f * self.nonlinear for f in (1.0, *self.factors)])

    @cached_property
    def _all_joints(self) -> np.ndarray:
        return np.tile(np.arange(len(self.initial)), 1 + len(self.factors))

    def __call__(self, velocity: np.ndarray) -> np.ndarray:
        """Basis torque of each parameter, and its slope over the velocity: (2, parameters, ...).

        Of all joints as adopted, then with each factor.
        """
        motion = JointMotion(velocity[self._all_joints])
        torques, slopes = self.effect.basis(motion, self._all_nonlinear)
        law = np.empty((2 * len(torques), len(self._all_joints)))
        for row, values in enumerate((*torques, *slopes)):
            law[row] = values  # A slope may be one number for all.
        return law.reshape(2, len(torques), -1)


@njit(cache=True)
def put_regressor(
    row: np.ndarray, basis: np.ndarray, shaped: np.ndarray, joint: int, n: int
) -> None:
    """Fills the regressor of the weights of one of n joints, see `FrictionRegressor`."""
    k, other = len(basis), n + joint
    for parameter in range(k):
        row[parameter] = basis[parameter, joint]
    while k < len(row) - 1:
        for parameter in shaped:
            row[k] = basis[parameter, other] - basis[parameter, joint]
            k += 1
        other += n
