"""Forces of the ground on many feet that together have one wrench: a quadratic program at each
instant."""

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from fbse_drake.walking.plan import TaskPlan, smooth_step

# Tangential over normal force that any ground bears on which one walks.
_CONE = 0.5
# How much the forces' squares count beside those of the missing wrench [1].
_SMALLNESS = 1e-4
# A foot with less than this weight carries nothing; less force [N] beyond a cone is none.
_LEAST_WEIGHT, _LEAST_FORCE = 1e-9, 1e-6


def foot_weights(plan: TaskPlan) -> np.ndarray:
    """How much each foot is to carry, (N, feet), each in [0, 1]: 1 while it stands and others
    swing, 0 while it swings, and in between it takes over or is relieved smoothly."""
    weights = np.zeros((len(plan.time), len(plan.feet)))
    for k, side in enumerate(plan.feet):
        # Nothing is known of what was before the first phase and comes after the last.
        carries = [
            (1.0 if side in phase.support else 0.0) if phase.is_single else np.nan
            for phase in plan.phases
        ]
        for number, phase in enumerate(plan.phases):
            before, after = (
                carries[number + d] if 0 <= number + d < len(carries) else 0.5 for d in (-1, 1)
            )
            inside = (phase.start <= plan.time) & (plan.time <= phase.end)
            s = (plan.time[inside] - phase.start) / (phase.end - phase.start)
            level = before + (after - before) * smooth_step(s)
            weights[inside, k] = carries[number] if phase.is_single else level
    return weights


def contact_forces(
    wrench: np.ndarray, points: np.ndarray, weights: np.ndarray, cone: float = _CONE
) -> np.ndarray:
    """The smallest forces at some points that have a wrench, or come nearest to it: they push, and
    within the friction cone.

    Smallest is the sum of their squares over the points' weights. What two points cannot give is a
    moment about the line between them; it is left out.

    Args:
        wrench: [moment about the world's origin, force], (N, 6) [Nm, N].
        points: where they act, (N, points, 3) [m].
        weights: how much each is to carry, (N, points), in [0, 1].
        cone: tangential over normal force.

    Returns:
        (N, points, 3) [N].
    """
    root = np.sqrt(np.where(weights > _LEAST_WEIGHT, weights, 0.0))
    # About the middle of the points that carry, in units of their distance from it.
    share = weights / weights.sum(axis=1, keepdims=True)
    middle = np.einsum("np,npi->ni", share, points)
    arm = points - middle[:, None]
    size = np.sqrt(np.einsum("np,npi,npi->n", share, arm, arm))[:, None]
    scaled = wrench.copy()
    scaled[:, :3] = (wrench[:, :3] - np.cross(middle, wrench[:, 3:])) / size
    # Of root times each force: the least squares without cones, which mostly are not in the way.
    A = _grasp_maps(arm / size[:, :, None], root)
    A_T = A.transpose(0, 2, 1)
    dual = np.linalg.solve(A @ A_T + _SMALLNESS * np.eye(6), scaled[:, :, None])
    result = root[:, :, None] * (A_T @ dual).reshape(points.shape)
    slack = cone * result[:, :, 2] - np.linalg.norm(result[:, :, :2], axis=2)
    for k in np.flatnonzero(slack.min(axis=1) < -_LEAST_FORCE):
        result[k] = _in_cones(A[k], scaled[k], root[k], cone)
    return result


def _grasp_maps(arm: np.ndarray, root: np.ndarray) -> np.ndarray:
    """What the wrench [moment, force] is of forces with these arms (N, points, 3), each times its
    root (N, points); (N, 6, 3 points)."""
    maps = np.zeros((len(arm), 6, arm.shape[1], 3))
    for axis, unit in enumerate(np.eye(3)):
        maps[:, :3, :, axis] = np.cross(arm, unit).transpose(0, 2, 1)
        maps[:, 3 + axis, :, axis] = 1.0
    return (maps * root[:, None, :, None]).reshape(len(arm), 6, -1)


def _in_cones(A: np.ndarray, wrench: np.ndarray, root: np.ndarray, cone: float) -> np.ndarray:
    """The forces (points, 3) where cones bound them: root times g, which minimise
    |A g - wrench|^2 + smallness |g|^2."""
    program = MathematicalProgram()
    # In newtons of the whole, for the solver's sake.
    size = np.linalg.norm(wrench)
    g = program.NewContinuousVariables(len(root), 3)
    flat = g.ravel()
    program.Add2NormSquaredCost(
        np.vstack([A, np.sqrt(_SMALLNESS) * np.eye(len(flat))]),
        np.concatenate([wrench / size, np.zeros(len(flat))]),
        flat,
    )
    for x, y, z in g:
        program.AddLorentzConeConstraint(np.array([cone * z, x, y]))
    solved = ClarabelSolver().Solve(program)
    if not solved.is_success():
        raise RuntimeError(f"no contact forces found: {solved.get_solution_result()}")
    return size * root[:, None] * solved.GetSolution(g)
