"""Forces of the ground on many feet that together have one wrench: a quadratic program at each instant."""

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from fbse_drake.robot.plant import grasp_map
from fbse_drake.walking.plan import TaskPlan, smooth_step

# Tangential over normal force that any ground bears on which one walks.
_CONE = 0.5
# How much the forces' squares count beside those of the missing wrench [1].
_SMALLNESS = 1e-4
# A foot with less than this weight carries nothing.
_LEAST_WEIGHT = 1e-9


def foot_weights(plan: TaskPlan) -> np.ndarray:
    """How much each foot is to carry, (N, feet), each in [0, 1]: 1 while it stands and others swing,
    0 while it swings, and in between it takes over or is relieved smoothly."""
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
    result = np.empty_like(points)
    for k in range(len(points)):
        A = grasp_map(arm[k] / size[k]) * np.repeat(root[k], 3)
        normal = A @ A.T + _SMALLNESS * np.eye(6)
        force = (np.repeat(root[k], 3) * (A.T @ np.linalg.solve(normal, scaled[k]))).reshape(-1, 3)
        slack = cone * force[:, 2] - np.linalg.norm(force[:, :2], axis=1)
        if slack.min() < -_LEAST_WEIGHT:
            force = _in_cones(A, scaled[k], root[k], cone)
        result[k] = force
    return result


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
