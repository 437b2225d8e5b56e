"""Combinations of inertial parameters that a log shows, and physically consistent values of all.

The joint and base rows of the residual are linear in the ten inertial parameters phi of every body
(see `InertialParameters`):

    residual = Y(motion) (phi of the robot - phi of the model)

A change of a body is measured relative to the body itself. With the model's pseudo-inertia
J0 = L L^T, the changed one is J = L (1 + Z) L^T with a symmetric 4 x 4 matrix Z. Its ten
coordinates z (orthonormal: |z| = |Z|) have no unit and do not depend on the frame; to first order
|z| is the geodesic distance of Lee and Park (2018). The prior of each is normal about the model
with standard deviation 1, that is, a change of about the body's own size; where the log says
nothing, the model stays. A body is physically consistent if and only if 1 + Z is positive
semidefinite (Wensing, Kim and Slotine 2018), which is a convex constraint.

If the log shows a change of many of these standard deviations (a hand that holds a load), the prior
was too narrow: the body is then measured relative to the mean of its size before and after.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from fbse_drake.discrepancy.identification.regression import Fit, Signature, WhitenedResidual
from fbse_drake.discrepancy.residual.equation_of_motion import EquationOfMotion
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.inertia import (
    InertiaEffect,
    InertialParameters,
    inertia_changes,
    inertial_parameters,
    pseudo_inertia,
)
from fbse_drake.errors import InputError
from fbse_drake.robot.plant import Robot

PARAMETERS = tuple(InertialParameters.parameters)
# A body's mass is taken to be spread by at least this in every direction [m], also where its model
# is a point.
_LEAST_SPREAD = 0.02
# A direction that raises the sum of squares, in units of the sensors' noise, by less than this per
# unit is left to the belief in the model; so is one that is there by rounding alone.
_LEAST_POWER = 1e-2
_ROUNDING = 1e-12
# A pseudo-inertia stays above this share of the model's own.
_LEAST_SHARE = 1e-3
# A combination counts as identified if its standard deviation is below this share of the prior's,
# and as weak otherwise.
IDENTIFIED = 0.1
# Half the width of a 95 % interval of a normal distribution, in standard deviations.
_QUANTILE = 1.96
# A coordinate z of a body is in conflict with its prior beyond so many standard deviations.
_CONFLICT = 4.0
# Terms below this share of the largest one are not written out.
_SMALLEST_TERM = 0.01


def untrusted_bodies(robot: Robot, wanted: Sequence[str]) -> list[str]:
    """Names of bodies; `all` stands for all that have a mass.

    Raises:
        InputError: the model has no body of such a name with a mass.
    """
    return robot.body_names if "all" in wanted else [robot.body(name).name() for name in wanted]


def inertial_regressor(equation: EquationOfMotion, at: Instants, body: str) -> np.ndarray:
    """What a unit of each inertial parameter of a body B adds to the joint and base rows.

    J^T times the moment and force on the body, with its Jacobian J, spatial velocity and spatial
    acceleration at its origin Bo, all expressed in B.

    Returns:
        Shape (M, rows, 10).
    """
    plant, frame = equation.robot.plant, equation.robot.body(body).body_frame()
    states, accelerations = equation.plant_motion(at)
    # The specific force of a floating base stands for gravity.
    gravity = (
        np.zeros(3) if equation.robot.has_floating_base else plant.gravity_field().gravity_vector()
    )
    dynamics = equation.dynamics
    wanted = [dynamics.jacobian(frame), dynamics.bias_acceleration(frame), dynamics.rotation(frame)]
    J, bias, R_WB = dynamics.evaluated(wanted, states)
    g = gravity @ R_WB
    V = np.einsum("mij,mj->mi", J, states[:, plant.num_positions() :])
    A = np.einsum("mij,mj->mi", J, accelerations) + bias
    return np.swapaxes(J, 1, 2)[:, equation.row_velocities] @ body_wrench(
        V[:, :3], A[:, :3], A[:, 3:] - g
    )


def inertia_addition(
    equation: EquationOfMotion,
    at: Instants,
    effect: InertiaEffect,
    regressor: Callable[[str], np.ndarray],
) -> np.ndarray:
    """What an effect on the inertia of bodies adds to the joint and base rows of the model.

    Args:
        regressor: `inertial_regressor` of a body at these instants.

    Returns:
        Shape (M, rows).
    """
    rotor_inertia, point_masses = inertia_changes({"effect": effect}, equation.robot)
    result = np.zeros((len(at.joint_acceleration), len(equation.row_velocities)))
    result[:, : len(rotor_inertia)] = rotor_inertia * at.joint_acceleration
    by_body: dict[str, np.ndarray] = {}
    for point in point_masses:
        so_far = by_body.get(point.body, 0.0)
        by_body[point.body] = so_far + inertial_parameters(point.inertia)
    for body, parameters in by_body.items():
        # As one matrix: a product of many small ones is slow.
        columns = regressor(body).reshape(-1, len(parameters))
        result += (columns @ parameters).reshape(result.shape)
    return result


def body_wrench(w: np.ndarray, alpha: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Wrench [moment about Bo, force] that a motion of a body B needs, per unit of each parameter.

    Args:
        w: angular velocity, (M, 3), expressed in B like all others.
        alpha: angular acceleration, (M, 3).
        a: acceleration of Bo less gravity, (M, 3).

    Returns:
        Shape (M, 6, 10).
    """
    result = np.zeros((len(w), 6, len(PARAMETERS)))
    W = _cross(w)
    result[:, 3:, 0] = a
    result[:, 3:, 1:4] = _cross(alpha) + W @ W
    result[:, :3, 1:4] = -_cross(a)
    result[:, :3, 4:] = _times_inertia(alpha) + W @ _times_inertia(w)
    return result


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrices of the cross product, (M, 3, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.moveaxis(np.array([[o, -z, y], [z, o, -x], [-y, x, o]]), 2, 0)


def _times_inertia(w: np.ndarray) -> np.ndarray:
    """I w per unit of ixx, iyy, izz, ixy, ixz, iyz, (M, 3, 6)."""
    x, y, z = w.T
    o = np.zeros_like(x)
    return np.moveaxis(np.array([[x, o, o, y, z, o], [o, y, o, x, o, z], [o, o, z, o, x, y]]), 2, 0)


def _symmetric_basis() -> np.ndarray:
    """Orthonormal symmetric 4 x 4 matrices, (10, 4, 4)."""
    basis = []
    for i in range(4):
        for j in range(i + 1):
            E = np.zeros((4, 4))
            E[i, j] = E[j, i] = 1.0 if i == j else np.sqrt(0.5)
            basis.append(E)
    return np.array(basis)


_BASIS = _symmetric_basis()
# Pseudo-inertia of each parameter, and the inverse of that linear map, (10, 16).
_FROM_PSEUDO = np.linalg.pinv(pseudo_inertia(np.eye(10)).reshape(10, 16).T)


def body_coordinates(parameters: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates z of one body.

    Args:
        parameters: of the model's body, phi0, (10,).
        size: of the body in whose size changes are measured, (10,).

    Returns:
        T in phi = phi0 + T z, shape (10, 10), in the parameters' units; and L^-1 J0 L^-T, shape
        (4, 4), which is the identity if the body is measured relative to itself and is no smaller
        than any body is taken to be.
    """
    J0 = pseudo_inertia(parameters)
    spread = size[0] * _LEAST_SPREAD**2 * np.diag([1.0, 1.0, 1.0, 0.0])
    L = np.linalg.cholesky(pseudo_inertia(size) + spread)
    own = np.linalg.solve(L, np.linalg.solve(L, J0).T)
    return _FROM_PSEUDO @ (L @ _BASIS @ L.T).reshape(10, 16).T, own


@dataclass(frozen=True)
class UntrustedInertia:
    """What changes of bodies' inertial parameters add to a residual; P = 10 times the bodies."""

    bodies: list[str]
    # Of the model as it stands, (P,), body by body.
    model: np.ndarray
    # Change of the parameters per unit of the coordinates z, (P, P).
    scale: np.ndarray
    # Pseudo-inertia of each body in the coordinates of z, (bodies, 4, 4), to which Z is added.
    own: np.ndarray
    # What a unit of each coordinate adds to the joint and base rows, averaged over blocks,
    # (B, rows, P).
    columns: np.ndarray

    @cached_property
    def names(self) -> list[tuple[str, str]]:
        """Body and parameter of each of the P."""
        return [(body, name) for body in self.bodies for name in PARAMETERS]

    def signature(self, directions: np.ndarray | None = None) -> Signature:
        """As a signature for the regression, in the coordinates z or in `directions` (P, D)."""
        values = self.columns if directions is None else self.columns @ directions
        return Signature(np.arange(self.columns.shape[1]), values, prior=np.ones(values.shape[2]))

    def measured_by(self, change: np.ndarray) -> "UntrustedInertia":
        """With bodies whose change (bodies, 10) is in conflict with their prior measured anew.

        They are measured relative to the mean of their size before and after the change.
        """
        size = len(PARAMETERS)
        scale, own, columns = self.scale.copy(), self.own.copy(), self.columns.copy()
        conflicts = 0
        for k, of_body in enumerate(change):
            part = slice(k * size, (k + 1) * size)
            z = np.linalg.solve(self.scale[part, part], of_body)
            if np.abs(z).max() < _CONFLICT:
                continue
            conflicts += 1
            model = self.model[part]
            scale[part, part], own[k] = body_coordinates(model, model + 0.5 * of_body)
            columns[:, :, part] = self.columns[:, :, part] @ np.linalg.solve(
                self.scale[part, part], scale[part, part]
            )
        return replace(self, scale=scale, own=own, columns=columns) if conflicts else self

    def visible_directions(self, white: WhitenedResidual) -> np.ndarray:
        """Orthonormal directions of z that the log shows at all, best first, (P, D)."""
        values = white.whiten_signature(self.signature()).values
        power, directions = np.linalg.eigh(np.einsum("brp,brq->pq", values, values, optimize=True))
        return directions[:, power > max(_LEAST_POWER, _ROUNDING * power.max())][:, ::-1]


def untrusted_inertia(motion: RecordedMotion, bodies: Sequence[str]) -> UntrustedInertia:
    """Columns of the bodies' inertial parameters over a log."""
    rows = sum(row.kind in ("joint", "base") for row in motion.rows)
    size = len(PARAMETERS)
    model = np.concatenate([_of_body(motion.robot, body) for body in bodies])
    scale, columns = (
        np.zeros((len(model), len(model))),
        np.empty((len(motion.time), rows, len(model))),
    )
    own = np.empty((len(bodies), 4, 4))
    for k, body in enumerate(bodies):
        part = slice(k * size, (k + 1) * size)
        scale[part, part], own[k] = body_coordinates(model[part], model[part])
        columns[:, :, part] = (
            motion.averages(inertial_regressor(motion.equation, motion.steps, body))
            @ scale[part, part]
        )
    return UntrustedInertia(list(bodies), model, scale, own, columns)


def _of_body(robot: Robot, name: str) -> np.ndarray:
    """Inertial parameters of a body of the plant with what inertia effects added to it, (10,)."""
    return np.sum(
        [
            inertial_parameters(body.default_spatial_inertia())
            for body in [robot.body(name), *robot.added_to(name)]
        ],
        axis=0,
    )


@dataclass(frozen=True)
class BaseParameter:
    """A combination of inertial parameters that the log shows: one, and others that look alike."""

    body: str
    parameter: str
    unit: str
    # Factor of each further parameter, by body and name.
    others: dict[tuple[str, str], float]
    # Of the model, and as identified with its 95 % confidence interval.
    model: float
    value: float
    interval: tuple[float, float]
    # Standard deviation if the remaining residual were white noise, as a share of the prior's.
    uncertainty: float

    @property
    def identified(self) -> bool:
        return self.uncertainty < IDENTIFIED

    @property
    def short(self) -> str:
        """As `upper_arm izz, with others`."""
        return f"{self.body} {self.parameter}{', with others' if self.others else ''}"

    @property
    def text(self) -> str:
        """As `upper_arm izz + 0.612 forearm mz`."""
        terms = [f"{self.body} {self.parameter}"]
        for (body, name), factor in self.others.items():
            terms.append(
                f"{'-' if factor < 0 else '+'} {abs(factor):.3g} {body} {name}".replace(" 1 ", " ")
            )
        return " ".join(terms)


@dataclass(frozen=True)
class IdentifiedInertia:
    """Inertial parameters of bodies as identified from a log; physically consistent."""

    bodies: list[str]
    # Changes from the model (bodies, 10) in the order of `InertialParameters`, and half the width
    # of their 95 % confidence intervals.
    change: np.ndarray
    half_width: np.ndarray
    # Standard deviation of each as a share of the prior's: near 1 where the log says nothing of it.
    uncertainty: np.ndarray
    # Of the model, (bodies, 10).
    model: np.ndarray
    # What the log shows of them, and the condition number of that least-squares problem with its
    # columns scaled to the same length.
    base_parameters: tuple[BaseParameter, ...]
    condition: float
    # Bodies whose values are at the edge of what a distribution of mass can have.
    at_the_edge: tuple[str, ...]

    @property
    def effect(self) -> Effect:
        """The changes as they stand in a scenario."""
        return InertialParameters.from_values(
            self.bodies, dict(zip(PARAMETERS, self.change.T.tolist(), strict=True))
        )


def identified_inertia(
    inertia: UntrustedInertia,
    white: WhitenedResidual,
    fit: Fit,
    z: np.ndarray,
    directions: np.ndarray,
) -> IdentifiedInertia:
    """What a fit says of inertial parameters.

    Args:
        fit: whose last parameters are those of `directions` (P, D).
        z: physically consistent coordinates, (P,).
    """
    T, P = inertia.scale, len(z)
    signature = white.whiten_signature(inertia.signature())
    columns = (signature.values / np.sqrt(white.scale(fit.sse))[signature.rows, None]).reshape(
        -1, P
    )
    # Covariance of the parameters' changes: before the log, and after it if the remaining residual
    # is white noise. Then squared half widths of their intervals, with the residual as it is.
    believed = T @ T.T
    informed = T @ np.linalg.inv(columns.T @ columns + np.eye(P)) @ T.T
    last = slice(len(fit.parameters) - directions.shape[1], None)
    half_width = np.minimum(fit.interval()[last, 1] - fit.parameters[last], _QUANTILE)
    spread = half_width / np.maximum(fit.deviation[last], 1e-300)
    covariance = directions @ (fit.covariance[last, last] * np.outer(spread, spread)) @ directions.T
    between = T @ (covariance + _QUANTILE**2 * (np.eye(P) - directions @ directions.T)) @ T.T

    sizes = np.sqrt(np.diag(believed))
    W = columns @ np.linalg.inv(T)
    kept, S = base_columns(W, sizes)
    change = T @ z
    base = []
    for place, row in zip(kept, S, strict=True):
        body, name = inertia.names[place]
        terms = np.abs(row) * sizes
        others = {
            inertia.names[p]: float(row[p])
            for p in np.flatnonzero(terms > _SMALLEST_TERM * terms.max())
            if p != place
        }
        now, value, width = (
            float(row @ inertia.model),
            float(row @ (inertia.model + change)),
            float(np.sqrt(row @ between @ row)),
        )
        unit = InertialParameters.parameters[name].unit
        share = float(np.sqrt((row @ informed @ row) / (row @ believed @ row)))
        base.append(
            BaseParameter(
                body, name, unit, others, now, value, (value - width, value + width), share
            )
        )
    lengths = np.linalg.norm(W[:, kept], axis=0)
    of_bodies = (len(inertia.bodies), -1)
    edges = np.linalg.eigvalsh(
        inertia.own + np.einsum("bk,kij->bij", z.reshape(of_bodies), _BASIS)
    ).min(axis=1)
    return IdentifiedInertia(
        inertia.bodies,
        change.reshape(of_bodies),
        np.sqrt(np.diag(between)).reshape(of_bodies),
        np.sqrt(np.diag(informed) / np.diag(believed)).reshape(of_bodies),
        inertia.model.reshape(of_bodies),
        tuple(base),
        float(np.linalg.cond(W[:, kept] / lengths)) if kept else 1.0,
        tuple(
            body
            for body, edge in zip(inertia.bodies, edges, strict=True)
            if edge < 2 * _LEAST_SHARE
        ),
    )


def base_columns(W: np.ndarray, sizes: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Columns that the log tells apart, and the others in terms of them (Gautier 1991).

    Args:
        W: regressor in units of noise, (N, P).
        sizes: change of each parameter that is about its own size, (P,). A column is not told
            apart if, for a change of that size, what the columns before it do not explain of it
            is below the noise.

    Returns:
        Indices of the D base columns in ascending order, and the factors with which all parameters
        enter each, (D, P); that of its own parameter is 1.
    """
    R = np.asarray(np.linalg.qr(W, mode="r"))
    kept: list[int] = []
    for p in range(W.shape[1]):
        own = R[:, p] - (R[:, kept] @ np.linalg.lstsq(R[:, kept], R[:, p])[0] if kept else 0.0)
        if np.linalg.norm(own) * sizes[p] > 1.0:
            kept.append(p)
    factors = np.eye(W.shape[1])[kept]
    others = [p for p in range(W.shape[1]) if p not in kept]
    if kept and others:
        factors[:, others] = np.linalg.lstsq(R[:, kept], R[:, others])[0]
    return kept, factors


def consistent_parameters(
    X: np.ndarray, y: np.ndarray, prior: np.ndarray, lowest: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least squares with physically consistent bodies, by Drake's MathematicalProgram.

    Args:
        X: columns of K other parameters, then of the P coordinates z of the bodies, body by body,
            in units of noise, (N, K + P).
        y: the residual in units of noise, (N,).
        prior: inverse variance of what is believed of each parameter, which is 0, (K + P,).
        lowest: lower bounds of the K others.
        own: pseudo-inertia of each body in the coordinates of z, (bodies, 4, 4), see
            `UntrustedInertia`.

    Returns:
        Other parameters (K,) and coordinates z (P,).

    Raises:
        InputError: the solver finds none.
    """
    K = len(lowest)
    # Units must not decide on the solver's tolerances.
    norm = np.linalg.norm(X[:, :K], axis=0)
    norm[norm == 0] = 1.0
    norm = np.concatenate([norm, np.ones(X.shape[1] - K)])
    Q, R = np.linalg.qr(np.concatenate([X / norm, np.diag(np.sqrt(prior) / norm)]))
    target = Q.T @ np.concatenate([y, np.zeros(len(prior))])
    size = max(1.0, float(np.linalg.norm(target)))

    def solved(is_bounded: np.ndarray) -> np.ndarray:
        # What is bounded is told from its bound: it will be near to it, and zero may be far.
        least = np.where(is_bounded, lowest, 0.0)
        shift = np.concatenate([least, np.zeros(X.shape[1] - K)]) * norm
        program = MathematicalProgram()
        variables = program.NewContinuousVariables(X.shape[1])
        rest = (target - R @ shift) / np.sqrt(size)
        program.Add2NormSquaredCost(R / np.sqrt(size), rest, variables)
        if K:
            lower = np.where(is_bounded, 0.0, -np.inf)
            program.AddBoundingBoxConstraint(lower, np.full(K, np.inf), variables[:K])
        for z, J in zip(np.split(variables[K:], len(own)), own, strict=True):
            program.AddLinearMatrixInequalityConstraint([J - _LEAST_SHARE * np.eye(4), *_BASIS], z)
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            raise InputError(
                "inertial parameters: no physically consistent values found "
                f"({result.get_solution_result().name})"
            )
        return (result.GetSolution(variables) + shift) / norm

    # Bounds that are far from zero are heard where they are needed: the solver fails at many that
    # bound nothing.
    is_bounded = lowest == 0.0
    solution = solved(is_bounded)
    while (beyond := ~is_bounded & (solution[:K] < lowest)).any():
        is_bounded |= beyond
        solution = solved(is_bounded)
    return solution[:K], solution[K:]
