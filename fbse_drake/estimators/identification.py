"""Identification of a friction model from many samples at once (paper eqs. 50-55, 63)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.errors import InputError


@dataclass(frozen=True)
class IdentifiedEffect:
    """A joint torque effect with identified values, one column for each joint."""

    effect: type[JointTorqueEffect]
    # Joints, in column order.
    joints: list[str]
    # Values and standard deviations by parameter name, each (n,) in the parameter's unit. The
    # deviations take the residual as white.
    values: dict[str, np.ndarray]
    deviations: dict[str, np.ndarray]
    # What the model leaves unexplained, rms (n,) [Nm].
    residual_rms: np.ndarray

    def config(self) -> JointTorqueEffect:
        """The effect as it stands in a scenario."""
        return self.effect.from_values(self.joints, self.values)


def batch_least_squares(phi: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares over all samples, paper eq. (63).

    Args:
        phi: regressors (N, m); torque: (N,) [Nm].

    Returns:
        Parameters (m,) and their standard deviations (m,), for white errors of the size of the
        residual. A parameter that the samples do not excite gets the smallest value that fits, and
        a deviation of infinity if no sample moves it.
    """
    parameters, *_ = np.linalg.lstsq(phi, torque)
    residual = torque - phi @ parameters
    variance = residual @ residual / max(1, len(torque) - phi.shape[1])
    information = phi.T @ phi
    excited = np.diag(information) > 0
    deviation = np.full(phi.shape[1], np.inf)
    inverse = np.linalg.pinv(information[np.ix_(excited, excited)], hermitian=True)
    deviation[excited] = np.sqrt(variance * np.diag(inverse))
    return parameters, deviation


def identify(
    effect: type[JointTorqueEffect], joints: list[str], velocity: np.ndarray, torque: np.ndarray
) -> IdentifiedEffect:
    """Fits an effect to friction samples of each joint: the nonlinear least squares (51), (55).

    Parameters that enter linearly are solved for at every step of the search over the others
    (variable projection, Golub and Pereyra 1973), which starts in the middle of their plausible
    ranges and stays inside them. A linear value stays within the parameter's bounds, so that a
    joint that hardly moves does not get a negative friction.

    Args:
        joints: names, in column order.
        velocity: (N, n) [rad/s]; torque: (N, n) [Nm].

    Raises:
        InputError: arrays that do not go together, or fewer samples than parameters.
    """
    if velocity.ndim != 2 or velocity.shape != torque.shape or velocity.shape[1] != len(joints):
        raise InputError(
            f"expected velocity and torque of shape N x {len(joints)}, found "
            f"{velocity.shape} and {torque.shape}"
        )
    if len(velocity) <= len(effect.parameters):
        raise InputError(
            f"expected more than {len(effect.parameters)} samples for "
            f"{effect.__name__}, found {len(velocity)}"
        )
    linear = [name for name, parameter in effect.parameters.items() if parameter.linear]
    nonlinear = {
        name: parameter for name, parameter in effect.parameters.items() if not parameter.linear
    }
    values = {name: np.empty(len(joints)) for name in effect.parameters}
    deviations = {name: np.empty(len(joints)) for name in effect.parameters}
    rms = np.empty(len(joints))
    bounds = np.array([effect.parameters[name].bounds for name in linear]).T
    low, high = (
        np.log([parameter.plausible for parameter in nonlinear.values()]).T
        if nonlinear
        else (np.zeros(0), np.zeros(0))
    )
    for joint in range(len(joints)):
        motion, measured = JointMotion(velocity[:, joint]), torque[:, joint]

        def regressors(logarithms: np.ndarray, motion: JointMotion = motion) -> np.ndarray:
            basis, _ = effect.basis(motion, np.exp(logarithms)[:, None])
            return np.stack([np.broadcast_to(b, motion.velocity.shape) for b in basis], axis=1)

        def misfit(
            logarithms: np.ndarray, measured: np.ndarray = measured, regressors: Any = regressors
        ) -> np.ndarray:
            phi = regressors(logarithms)
            return phi @ _bounded_least_squares(phi, measured, bounds) - measured

        chosen = (low + high) / 2
        uncertainty = np.zeros(0)
        if nonlinear:
            solution = least_squares(misfit, chosen, bounds=(low, high))
            chosen = solution.x
            information = solution.jac.T @ solution.jac
            variance = 2 * solution.cost / max(1, len(measured) - len(effect.parameters))
            uncertainty = np.sqrt(
                variance * np.abs(np.diag(np.linalg.pinv(information, hermitian=True)))
            ) * np.exp(chosen)
        phi = regressors(chosen)
        _, deviation = batch_least_squares(phi, measured)
        parameters = _bounded_least_squares(phi, measured, bounds)
        rms[joint] = np.sqrt(np.mean((phi @ parameters - measured) ** 2))
        for names, numbers, errors in (
            (linear, parameters, deviation),
            (list(nonlinear), np.exp(chosen), uncertainty),
        ):
            for name, number, error in zip(names, numbers, errors, strict=True):
                values[name][joint], deviations[name][joint] = number, error
    return IdentifiedEffect(effect, joints, values, deviations, rms)


def _bounded_least_squares(phi: np.ndarray, torque: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Least squares with parameters in [bounds[0], bounds[1]]; for most samples the plain solution
    is there already."""
    parameters, *_ = np.linalg.lstsq(phi, torque)
    if np.all((bounds[0] <= parameters) & (parameters <= bounds[1])):
        return parameters
    return lsq_linear(phi, torque, (bounds[0], bounds[1])).x
