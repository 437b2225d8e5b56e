"""The paper's friction estimate (Sec. 6-7): the measurement in stance, and in swing a model that
recursive least squares identify.
"""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.errors import InputError, require_not_negative, require_positive
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.friction import MEASURED, FrictionEstimator
from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.estimators.recursive import Clock
from fbse_drake.robot.plant import Robot


def _adopted_model() -> CoulombViscousFriction:
    return CoulombViscousFriction(transition={"all": 1.0e-6})


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Recursive least squares (64)-(67), one joint at a time.

    The covariance of the paper's 12 parameters never couples joints.
    """

    allows_for_delay: ClassVar[bool] = False
    allows_for_effects: ClassVar[bool] = False
    # Does it know how well it knows the parameters of its model?
    states_variance: ClassVar[bool] = False
    # What feeds it, by input, and the stages whose work it does as well.
    sources: ClassVar[dict[str, str]] = MEASURED
    stands_for: ClassVar[tuple[str, ...]] = ()

    # Adopted friction model, by default (57) with a sharp sign. Its linear parameters are
    # identified, from their values here on; the others stay as they are.
    model: FrictionModel = field(default_factory=_adopted_model)
    # Initial covariance of every parameter, Table II.
    covariance: float = 10.0
    # Weight that a tick of 1 ms keeps after the next; 1 never forgets.
    forgetting: float = 1.0
    # The covariance is set back to its initial value this often [s]; 0 never.
    reset_period: float = 0.0
    # Cut-off of the low-pass on the measured friction [Hz]; 0 does not filter, as the paper.
    cutoff: float = 0.0
    # What is taken while a leg swings: `model` as in the paper, or the `measurement` (which needs
    # fused accelerations).
    swing: str = "model"

    def __post_init__(self) -> None:
        if not 0 < self.forgetting <= 1:
            raise InputError(f"forgetting: expected a number in (0, 1], found {self.forgetting:g}")
        require_positive(self, "covariance")
        require_not_negative(self, "reset_period", "cutoff")
        if self.swing not in ("model", "measurement"):
            raise InputError(f"swing: expected model or measurement, found {self.swing}")

    def system(
        self,
        sensors: SensorBeliefs,  # noqa: ARG002
        robot: Robot,
        **arguments: Any,
    ) -> "FrictionEstimator":
        """The estimator with these settings; arguments as of its class."""
        return RecursiveLeastSquaresEstimator(self, robot, **arguments)


def recursive_least_squares(
    parameters: np.ndarray, P: np.ndarray, phi: np.ndarray, measured: np.ndarray, forgetting: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One tick of (64)-(67) for n joints at once.

    Args:
        parameters: (n, m); P: their covariances (n, m, m).
        phi: regressors (n, m); measured: friction (n,) [Nm].
        forgetting: weight of the past, 1 for the paper's.

    Returns:
        Parameters, covariances, innovation (n,) and its variance (n,), in units of the measurement
        noise.
    """
    innovation = measured - (phi * parameters).sum(axis=1)  # (65)
    P_phi = (P @ phi[:, :, None])[:, :, 0]
    S = forgetting + (phi * P_phi).sum(axis=1)
    K = P_phi / S[:, None]  # (66)
    P_new = (P - K[:, :, None] * P_phi[:, None, :]) / forgetting  # (67)
    return parameters + K * innovation[:, None], P_new, innovation, S  # (64)


class RecursiveLeastSquaresEstimator(FrictionEstimator):
    """Friction as in the paper (Sec. 6-7): measured in stance, modelled in swing.

    See `RecursiveLeastSquares` and `FrictionEstimator`.

    .. pydrake_system::

        name: RecursiveLeastSquaresEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior
        - (one for each field)

    Further fields: `filtered` (2, n), state of the low-pass [Nm]; `age` [s], time since the last
    reset of the covariance.
    """

    def __init__(
        self,
        config: RecursiveLeastSquares,
        robot: Robot,
        measurements: np.dtype,
        link_torque: np.dtype,
        clock: Clock,
    ):
        further = {"filtered": (2, len(robot.joint_names)), "age": ()}
        regressor = FrictionRegressor.of(config.model, robot)
        size = regressor.parameters
        super().__init__(regressor, robot, measurements, link_torque, clock, size, **further)
        self._config = config

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, link_torque = self._measurements.Eval(context), self._link.Eval(context)
        config = self._config
        posterior[...] = last
        posterior["status"] = max(measured["trust"].tolist())
        parameters, P = posterior["parameters"], posterior["covariance"]
        if math.isnan(elapsed):
            parameters[:] = self._regressor.initial
        age = math.inf if math.isnan(elapsed) else last["age"] + elapsed
        reset = config.reset_period
        if age == math.inf or (reset and age >= reset * (1 - 1e-9)):
            P[:], age = config.covariance * np.eye(P.shape[1]), 0.0
        posterior["age"] = age
        phi = self._regressor(measured["joint_velocity"])[0].T
        valid = link_torque["valid"] > 0
        if config.swing == "model":
            valid &= measured["support"][self._leg] > 0
        residual, filtered = link_torque["residual"], posterior["filtered"]
        if config.cutoff > 0 and not math.isnan(elapsed):
            # Two equal poles; a joint that was not measured starts afresh from its model.
            keep = math.exp(-2 * math.pi * config.cutoff * 1.55 * elapsed)
            modelled = (phi * parameters).sum(axis=1)
            once = keep * filtered[0] + (1 - keep) * residual
            filtered[0] = np.where(valid, once, modelled)
            twice = keep * filtered[1] + (1 - keep) * filtered[0]
            filtered[1] = np.where(valid, twice, modelled)
            smooth = filtered[1]
        else:
            smooth = residual
        if valid.any():
            forgets = config.forgetting != 1
            forgetting = config.forgetting ** (elapsed / 1e-3) if forgets else 1.0
            new, P_new, innovation, S = recursive_least_squares(
                parameters, P, phi, residual, forgetting
            )
            parameters[valid], P[valid] = new[valid], P_new[valid]
            posterior["innovation"], posterior["innovation_variance"] = innovation * valid, S
        posterior["parameter_variance"] = np.diagonal(P, axis1=1, axis2=2)
        posterior["friction"] = np.where(valid, smooth, (phi * parameters).sum(axis=1))
