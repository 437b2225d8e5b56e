"""Fits of explanations to one residual: how well effects explain it together, and what they leave."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from fbse_drake.discrepancy.dictionary import Dictionary
from fbse_drake.discrepancy.explanation import Candidate, Explanation
from fbse_drake.discrepancy.regression import (
    Signature,
    WhitenedResidual,
    bounded_least_squares,
)
from fbse_drake.discrepancy.residual import Residual
from fbse_drake.effects.joint_torque import JointTorqueEffect

# Probability of any false alarm on a log that hides nothing.
_FALSE_ALARM = 1e-3
# Explanations whose deviances differ by less are not told apart (a likelihood ratio of some 150).
MARGIN = 10.0
# What a parameter must earn beyond what it costs on held-out data.
COMPLEXITY = 4.0
# Share of the doubt about known laws that an effect could mimic.
_SYSTEMATIC = 0.5
# Safety on what the noise in an effect's own columns may feign.
_SPURIOUS = 3.0


class Fits:
    """Explanations of one residual by one dictionary, weighted by the residual's noise."""

    def __init__(self, dictionary: Dictionary, residual: Residual | None = None):
        """Whitens the residual.

        Args:
            residual: with the noise to weigh by; by default the predictor's.
        """
        self.dictionary = dictionary
        self.white = WhitenedResidual(
            dictionary.predictor.residual if residual is None else residual
        )
        inertia = dictionary.inertia
        # Whitened columns of inertia that is not trusted.
        self.always = (
            [] if inertia is None else [self.white.whiten_signature(dictionary.inertia_signature)]
        )
        self._grids: dict[str, tuple[np.ndarray, list[np.ndarray]]] = {}

    def doubting(self, explanation: Explanation) -> tuple["Fits", Explanation]:
        """Fits that weigh the residual anew, and an explanation in them: friction laws that it takes off make the residual noisier."""
        predictor = self.dictionary.predictor
        resolved = [effect.resolve(predictor.robot.description) for effect in explanation.effects]
        fits = Fits(self.dictionary, predictor.doubted(predictor.residual, resolved))
        moved = [
            replace(c, signature=fits.white.whiten_signature(c.raw)) for c in explanation.candidates
        ]
        return fits, fits.explain(moved)

    @cached_property
    def fixed_candidates(self) -> list[Candidate]:
        """All candidates that are no joint torque effects: one for each target that moves the residual."""
        result = []
        for fixed in self.dictionary.fixed:
            signature = self.white.whiten_signature(fixed.signature)
            spurious = (
                0.0
                if fixed.noise is None
                else self.spurious(signature, self.white.whiten_signature(fixed.noise))
            )
            parameters = self.dictionary.parameters(fixed.effect, fixed.target)
            result.append(
                Candidate(
                    fixed.effect,
                    (fixed.target,),
                    parameters,
                    fixed.nonlinear,
                    signature,
                    fixed.signature,
                    spurious,
                )
            )
        return result

    def spurious(self, signature: Signature, noise: Signature) -> float:
        """Drop of the deviance that the noise in a signature may feign."""
        both = np.einsum("brp,br->p", noise.values, self._noise[:, signature.rows])
        power = (signature.values**2).sum(axis=(0, 1))
        return _SPURIOUS * float((both**2 / np.maximum(power, 1e-30)).sum())

    @cached_property
    def _noise(self) -> np.ndarray:
        """A realization of the residual's noise, whitened, (B, R)."""
        realization = self.dictionary.predictor.noise_realization
        return np.stack(
            [self.white.whiten(row, values) for row, values in enumerate(realization.T)], axis=1
        )

    @cached_property
    def threshold(self) -> np.ndarray:
        """Drop of the deviance that k parameters must bring before they count, by k."""
        tests = len(self.fixed_candidates)
        for effect in self.dictionary.joint_effects:
            tests += len(self.dictionary.groups) * max(
                1, self.dictionary.grid(effect)[0].shape[1] // 4
            )
        return np.array([np.inf, *(chi2.isf(_FALSE_ALARM / tests, k) for k in range(1, 13))])

    def explain(self, candidates: Sequence[Candidate]) -> Explanation:
        """Fits candidates together."""
        if not candidates and not self.always:
            return Explanation(
                (), None, self.white.sse, self.white.sse, self.white.deviance(self.white.sse)
            )
        fit = self.white.fit([*(c.signature for c in candidates), *self.always])
        charge = COMPLEXITY * sum(c.signature.values.shape[2] for c in candidates)
        factor = self.torque_factor(candidates, fit.parameters)
        sse, held_out_sse = fit.sse * factor, fit.held_out_sse * factor
        return Explanation(
            tuple(candidates), fit, sse, held_out_sse, self.white.deviance(held_out_sse) + charge
        )

    def torque_factor(
        self, candidates: Sequence[Candidate], parameters: np.ndarray
    ) -> np.ndarray | float:
        """What the squares of each row are to be multiplied with where torque is measured and effects take a share of it, (R,).

        With u = share * torque, the rest torque - u - ... is the error of the torque times 1 - share: a share near 1 would explain
        everything. As the error of the torque itself it is the larger the more is taken.
        """
        if self.dictionary.per_step:
            return 1.0
        torque = self.dictionary.predictor.motion.blocks.torque_command
        taken, start = np.zeros_like(torque), 0
        for c in candidates:
            stop = start + c.signature.values.shape[2]
            if self.dictionary.takes_torque(c.effect):
                taken[:, c.raw.rows] += c.raw.values @ parameters[start:stop] + c.raw.offset
            start = stop
        known = self.white.residual.known[:, : torque.shape[1]]
        factor = np.ones(self.white.y.shape[1])
        own, rest = (
            (np.where(known, values, 0.0) ** 2).sum(axis=0) for values in (torque, torque - taken)
        )
        factor[: len(own)] = np.divide(
            own, rest, out=np.ones_like(own), where=(own > 0) & (rest > 0)
        )
        return factor

    @property
    def noise_alone(self) -> Explanation:
        """What an explanation that leaves nothing but noise would be, without any effects."""
        return Explanation((), None, 1.0 * self.white.count, 1.0 * self.white.count, 0.0)

    def systematic(self, rows: np.ndarray) -> float:
        """Drop of the deviance that doubtful laws alone may give to an effect in these rows: what is doubted need not be random."""
        return (
            _SYSTEMATIC * float(self.white.doubt[rows].sum()) if self.dictionary.per_step else 0.0
        )

    def grid(self, effect: type[JointTorqueEffect]) -> tuple[np.ndarray, list[np.ndarray]]:
        """First grid of an effect's nonlinear values for each joint, (m, G, n), and its whitened columns, (B, p, G) for each joint."""
        if effect.__name__ not in self._grids:
            points, columns = self.dictionary.grid(effect)
            whitened = [self.white.whiten(j, columns[:, j]) for j in range(columns.shape[1])]
            self._grids[effect.__name__] = (points, whitened)
        return self._grids[effect.__name__]

    def candidate(
        self,
        effect: type[JointTorqueEffect],
        group: tuple[str, ...],
        nonlinear: np.ndarray,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
    ) -> Candidate:
        """A joint torque effect with nonlinear values, linearised about them."""
        places = np.array([self.dictionary.joints.index(joint) for joint in group])
        columns = self.dictionary.columns(effect, places, nonlinear[:, None])[..., 0]
        parameters = self.dictionary.parameters(effect, group[0])
        names = [name for name, parameter in parameters.items() if not parameter.linear]
        has_linear = len(names) < len(parameters)
        amounts = np.ones(1)
        if has_linear:
            whitened = [self.white.whiten(j, columns[:, r]) for r, j in enumerate(places)]
            X = np.concatenate(
                [
                    project(columns, projection.get(j))
                    for columns, j in zip(whitened, places, strict=True)
                ]
            )
            amounts = np.linalg.lstsq(X, left[:, places].T.ravel())[0]
            smallest = np.array([p.bounds[0] for p in parameters.values() if p.linear])
            if np.any(amounts < smallest):
                # A slope for an amount that cannot be would mimic just that.
                amounts = bounded_least_squares(X.T @ X, X.T @ left[:, places].T.ravel(), smallest)
        # Slopes with respect to the nonlinear parameters, for amounts that fit best.
        slopes = []
        for k in range(len(nonlinear)):
            step = 0.02 * nonlinear[k]
            moved = np.repeat(nonlinear[:, None], 2, axis=1)
            moved[k] += [-step, step]
            pair = self.dictionary.columns(effect, places, moved)
            slopes.append((pair[..., 1] - pair[..., 0]) @ amounts / (2 * step))
        slope_columns = (
            np.stack(slopes, axis=2) if slopes else np.zeros((len(columns), len(places), 0))
        )
        # A weak belief in the plausible range keeps values that the data say nothing about from running away.
        ranges = [np.log(parameters[name].plausible) for name in names]
        belief = [
            1.0 / (0.25 * (high - low) * value) ** 2
            for (low, high), value in zip(ranges, nonlinear, strict=True)
        ]
        # Nonlinear parameters do not fall far below their plausible range.
        lows = 0.5 * np.array([parameters[name].plausible[0] for name in names])
        lowest = [parameters[name].bounds[0] for name in parameters if name not in names]
        lowest += np.maximum(-0.6 * nonlinear, np.minimum(lows - nonlinear, 0.0)).tolist()
        if has_linear:
            values = np.concatenate([columns, slope_columns], axis=2)
            raw = Signature(
                places,
                values,
                prior=np.array([0.0] * columns.shape[2] + belief),
                lowest=np.array(lowest),
            )
        else:
            raw = Signature(
                places,
                slope_columns,
                offset=columns[:, :, 0],
                prior=np.array(belief),
                lowest=np.array(lowest),
            )
        noisier = (
            self.dictionary.columns(effect, places, nonlinear[:, None], noisier=True)[..., 0]
            - columns
        )
        signature = self.white.whiten_signature(raw)
        clean = self.white.whiten_signature(Signature(places, columns))
        spurious = self.spurious(clean, self.white.whiten_signature(Signature(places, noisier)))
        return Candidate(effect, group, parameters, nonlinear, signature, raw, spurious)

    def leftover(self, base: Explanation) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Whitened residual after an explanation, (B, R), and by row an orthonormal basis of the columns it has there."""
        left, by_row = self.white.y.copy(), {}
        start = 0
        for s in self.signatures(base):
            stop = start + s.values.shape[2]
            left[:, s.rows] -= s.values @ base.fit.parameters[start:stop] + s.offset
            for k, row in enumerate(s.rows):
                by_row.setdefault(row, []).append(s.values[:, k])
            start = stop
        return left, {
            row: np.linalg.qr(np.concatenate(columns, axis=1))[0] for row, columns in by_row.items()
        }

    def signatures(self, explanation: Explanation) -> list[Signature]:
        """Whitened, in the order of the explanation's parameters."""
        return [
            *(c.signature for c in explanation.candidates),
            *(self.always if explanation.fit is not None else []),
        ]

    def room(self, base: Explanation) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """What further effects could explain: as `leftover`; columns of inertia however tie all rows together.

        With an orthonormal basis Q of all columns, rows one below the other, new columns x in one row keep x^T (1 - Q_r Q_r^T) x of their
        sum of squares, Q_r being the row's part of Q. In place of a row's basis stands the matrix B with (1 - B B^T)^2 = 1 - Q_r Q_r^T.
        """
        left, by_row = self.leftover(base)
        signatures = self.signatures(base)
        if not self.always or not signatures:
            return left, by_row
        scale = np.sqrt(self.white.scale(base.sse))
        columns = []
        for s in signatures:
            of_all = np.zeros((*left.shape, s.values.shape[2]))
            of_all[:, s.rows] = s.values / scale[s.rows, None]
            columns.append(of_all)
        X = np.concatenate(columns, axis=2)
        lengths = np.linalg.norm(X, axis=(0, 1))
        X /= np.where(lengths > 0, lengths, 1.0)
        Q = np.linalg.qr(X.reshape(-1, X.shape[2]))[0].reshape(X.shape)
        left = left - scale * (Q @ np.einsum("brp,br->p", Q, left / scale))
        for row in range(left.shape[1]):
            U, s, _ = np.linalg.svd(Q[:, row], full_matrices=False)
            by_row[row] = U * np.sqrt(1.0 - np.sqrt(np.clip(1.0 - s**2, 0.0, 1.0)))
        return left, by_row

    def needed(self, parameters: int) -> float:
        """Sum of squares that an effect with so many parameters must have to be found."""
        return float(self.threshold[min(12, parameters)] + (COMPLEXITY + 1) * parameters)


def project(X: np.ndarray, Q: np.ndarray | None) -> np.ndarray:
    """Columns (B, ...) without what an orthonormal basis Q (B, k) has of them."""
    return X if Q is None else X - Q @ (Q.T @ X)
