"""Proposals: which candidates, alone, would take off enough of what an explanation leaves over."""

from collections.abc import Sequence

import numpy as np

from fbse_drake.discrepancy.explanation import Candidate, Explanation
from fbse_drake.discrepancy.fits import Fits, project
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.effects.joint_torque import JointTorqueEffect

# How often a grid of nonlinear values is narrowed down around its best point, and to how many points.
_NARROWINGS = 2
_POINTS = 9
# How often friction of all joints is fitted in turn.
_SWEEPS = 3


class Proposals:
    """Candidates that are worth a fit; see the module."""

    def __init__(self, fits: Fits):
        self.fits = fits
        self._found: dict[tuple[str, tuple[str, ...], bytes], Candidate] = {}

    def promising(self, base: Explanation, rows: np.ndarray | None) -> list[Candidate]:
        """Candidates that, alone, would take off enough of what an explanation leaves over."""
        left, projection = self.fits.room(base)
        if rows is None:
            rows = np.arange(left.shape[1])
        scale = self.fits.white.scale(base.sse)
        result = []
        for candidate in self.fits.fixed_candidates:
            taken = any(
                c.effect is candidate.effect and c.targets == candidate.targets
                for c in base.candidates
            )
            touches = np.intersect1d(candidate.signature.rows, rows).size > 0
            if (
                touches
                and not taken
                and fixed_gain(self.fits, candidate, left, projection, scale)
                > 0.5 * self.fits.threshold[1]
            ):
                result.append(candidate)
        coarse: dict[tuple[str, ...], list[tuple[float, type[JointTorqueEffect], int]]] = {
            group: [] for group in self.fits.dictionary.groups
        }
        for effect in self.fits.dictionary.joint_effects:
            taken = {joint for c in base.candidates if c.effect is effect for joint in c.targets}
            columns = self.fits.grid(effect)[1]
            moments = [
                row_moments(self.fits, columns[j], j, left, projection, scale)
                for j in range(len(self.fits.dictionary.joints))
            ]
            for group in self.fits.dictionary.groups:
                places = [self.fits.dictionary.joints.index(joint) for joint in group]
                if taken & set(group) or not np.intersect1d(places, rows).size:
                    continue
                gain = grid_gain(
                    effect, sum(moments[j][0] for j in places), sum(moments[j][1] for j in places)
                )
                coarse[group].append((float(gain.max()), effect, int(gain.argmax())))
        for group, found in coarse.items():
            # What the grid shows far behind the best does not catch up between its points.
            # (A share of measured torque seems to explain more than it does.)
            honest = (
                gain
                for gain, effect, _ in found
                if self.fits.dictionary.per_step or not self.fits.dictionary.takes_torque(effect)
            )
            least = max(0.5 * self.fits.threshold[1], 0.4 * max(honest, default=0.0))
            for gain, effect, best in found:
                if gain > least:
                    result.append(self._best_on(effect, group, best, left, projection, scale))
        return result

    def plain_friction(self) -> Explanation:
        """Coulomb and viscous friction and a bias in every joint, fitted together; what identification of inertia begins with."""
        explanation = self.fits.explain([])
        for _ in range(_SWEEPS):
            for effect in (CoulombViscousFriction, TorqueBias):
                for joint in self.fits.dictionary.joints:
                    others = [
                        c
                        for c in explanation.candidates
                        if (c.effect, c.targets) != (effect, (joint,))
                    ]
                    explanation = self.fits.explain(
                        [*others, self.best_beside(self.fits.explain(others), effect, joint)]
                    )
        return explanation

    def best_beside(
        self, base: Explanation, effect: type[JointTorqueEffect], joint: str
    ) -> Candidate:
        """A joint torque effect with the nonlinear values that fit best beside an explanation."""
        left, projection = self.fits.room(base)
        scale, row = self.fits.white.scale(base.sse), self.fits.dictionary.joints.index(joint)
        gain = grid_gain(
            effect,
            *row_moments(self.fits, self.fits.grid(effect)[1][row], row, left, projection, scale),
        )
        return self._best_on(effect, (joint,), int(gain.argmax()), left, projection, scale)

    def _best_on(
        self,
        effect: type[JointTorqueEffect],
        group: tuple[str, ...],
        best: int,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
        scale: np.ndarray,
    ) -> Candidate:
        """A joint torque effect with the nonlinear values that fit best; found once for what is left in the group's rows."""
        places = [self.fits.dictionary.joints.index(joint) for joint in group]
        key = (effect.__name__, group, left[:, places].tobytes())
        if key not in self._found:
            nonlinear = self._narrowed(effect, places, best, left, projection, scale)
            self._found[key] = self.fits.candidate(effect, group, nonlinear, left, projection)
        return self._found[key]

    def _narrowed(
        self,
        effect: type[JointTorqueEffect],
        places: Sequence[int],
        best: int,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
        scale: np.ndarray,
    ) -> np.ndarray:
        """Nonlinear values between the grid's points that fit best, shape (m,)."""
        points = self.fits.grid(effect)[0][..., places[0]]
        chosen = points[:, best].copy()
        ranges = [
            p.plausible
            for p in self.fits.dictionary.parameters(
                effect, self.fits.dictionary.joints[places[0]]
            ).values()
            if not p.linear
        ]
        steps = []
        for axis in points:
            values = np.unique(axis)
            steps.append(np.log(values[1] / values[0]) if len(values) > 1 else 0.0)
        for _ in range(_NARROWINGS):
            for k in range(len(chosen)):
                if steps[k] == 0:
                    continue
                trial = np.repeat(chosen[:, None], _POINTS, axis=1)
                trial[k] = np.clip(
                    chosen[k] * np.exp(np.linspace(-steps[k], steps[k], _POINTS)), *ranges[k]
                )
                columns = self.fits.dictionary.columns(effect, np.array(places), trial)
                whitened = [self.fits.white.whiten(j, columns[:, r]) for r, j in enumerate(places)]
                moments = [
                    row_moments(self.fits, X, j, left, projection, scale)
                    for X, j in zip(whitened, places, strict=True)
                ]
                gain = grid_gain(effect, sum(m[0] for m in moments), sum(m[1] for m in moments))
                chosen[k] = trial[k, int(gain.argmax())]
                steps[k] *= 2.0 / (_POINTS - 1)
        return chosen


def fixed_gain(
    fits: Fits,
    candidate: Candidate,
    left: np.ndarray,
    projection: dict[int, np.ndarray],
    scale: np.ndarray,
) -> float:
    """Drop of the sum of squares by a candidate that is no joint torque effect, roughly."""
    s = candidate.signature
    X = np.concatenate(
        [
            project(s.values[:, k], projection.get(row)) / np.sqrt(scale[row])
            for k, row in enumerate(s.rows)
        ]
    )
    y = (left[:, s.rows] / np.sqrt(scale[s.rows])).T.ravel()
    right = (
        X.T @ y
        if not fits.always
        else np.einsum("brp,br->p", s.values / scale[s.rows, None], left[:, s.rows])
    )
    return float(right @ np.linalg.lstsq(X.T @ X, right, rcond=1e-10)[0])


def row_moments(
    fits: Fits,
    columns: np.ndarray,
    row: int,
    left: np.ndarray,
    projection: dict[int, np.ndarray],
    scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gram matrices (G, p, p), right sides (G, p) of a row's columns (B, p, G)."""
    X = project(columns.reshape(len(columns), -1), projection.get(row)).reshape(columns.shape)
    # Beside inertia, what is left is orthogonal to the columns of an explanation in all rows together, not in each.
    against = columns if fits.always else X
    return np.einsum("bpg,bqg->gpq", X, X, optimize=True) / scale[row], np.einsum(
        "bpg,b->gp", against, left[:, row]
    ) / scale[row]


def grid_gain(effect: type[Effect], gram: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Drop of the sum of squares for each set of nonlinear values, shape (G,)."""
    if not any(parameter.linear for parameter in effect.parameters.values()):
        return 2 * right[:, 0] - gram[:, 0, 0]
    if right.shape[1] == 1:
        parameter = next(p for p in effect.parameters.values() if p.linear)
        theta = np.divide(
            right[:, 0], gram[:, 0, 0], out=np.zeros(len(right)), where=gram[:, 0, 0] > 1e-12
        )
        theta = np.clip(theta, *parameter.bounds)
        return 2 * theta * right[:, 0] - theta**2 * gram[:, 0, 0]
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(
        gram.shape[1]
    ) + 1e-12 * np.eye(gram.shape[1])
    return np.einsum("gp,gp->g", right, np.linalg.solve(gram + ridge, right[:, :, None])[:, :, 0])
