"""Linear regression of residuals on signatures of effects: noise whitened, intervals that respect what is left of correlation in time, and
scores on held-out blocks of time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded
from scipy.stats import t as student

from fbse_drake.discrepancy.residual import Residual

# Length of a stretch whose errors may be correlated in any way [s], not less than so many blocks, and in how many folds these stretches are
# held out in turn. Folds and stretches of a step have no common divisor, so that no phase of the gait is held out as a whole.
STRETCH = 0.25
_FEWEST_BLOCKS = 10
FOLDS = 5
# Long stretches are this many short ones.
_LONG = 4
# How often the rows are weighted anew by what is left in them.
_REWEIGHTINGS = 3


@dataclass(frozen=True)
class Signature:
    """What one effect adds to some rows of the residual: offset + values @ parameters, for p parameters."""

    # Places of the rows, shape (r,).
    rows: np.ndarray
    # Per unit of each parameter, shape (B, r, p).
    values: np.ndarray
    # What it adds whatever the parameters are, shape (B, r) or 0.
    offset: np.ndarray | float = 0.0
    # What is believed of the parameters beforehand: that they are 0, with this inverse variance, shape (p,) or 0.
    prior: np.ndarray | float = 0.0
    # Smallest value that each parameter can have, shape (p,) or -inf.
    lowest: np.ndarray | float = -np.inf


@dataclass(frozen=True)
class Fit:
    """Regression on several signatures at once; P parameters in their order, R rows."""

    parameters: np.ndarray
    # Standard deviation of each parameter, shape (P,): sandwich estimate by stretches of time, not less than what the noise alone gives.
    deviation: np.ndarray
    # Degrees of freedom of each parameter's interval: stretches that bear on it, shape (P,).
    freedom: np.ndarray
    # Covariance with these deviations, (P, P); correlations as of white noise.
    covariance: np.ndarray
    # Sum of squares of the whitened residual in each row: over all blocks, and with each block predicted from the other folds, (R,).
    sse: np.ndarray
    held_out_sse: np.ndarray

    def interval(self, confidence: float = 0.95) -> np.ndarray:
        """Confidence interval of each parameter, shape (P, 2)."""
        half = student.ppf((1 + confidence) / 2, self.freedom) * self.deviation
        return np.stack([self.parameters - half, self.parameters + half], axis=1)


class WhitenedResidual:
    """A residual with its noise made white and of unit variance, row by row; zero where a row is not known."""

    def __init__(self, residual: Residual):
        self.residual = residual
        self._index = [np.flatnonzero(known) for known in residual.known.T]
        self._factor = []
        for row, index in enumerate(self._index):
            band = np.zeros((2, len(index)))
            # A row without any noise, as from ideal sensors, is still told apart from rounding.
            band[0] = np.maximum(residual.variance[index, row], 1e-18)
            adjacent = np.diff(index) == 1
            band[1, :-1] = (
                np.where(adjacent, residual.covariance[index[:-1], row], 0.0) if len(index) else 0.0
            )
            self._factor.append(cholesky_banded(band, lower=True) if len(index) else band)
        # Values (B, R).
        self.y = np.stack(
            [self.whiten(row, values) for row, values in enumerate(residual.value.T)], axis=1
        )
        # Blocks that are known in each row, (R,).
        self.count = residual.known.sum(axis=0)
        # How many blocks' worth of each row's variance is doubt about laws rather than noise of sensors, (R,).
        self.doubt = np.where(
            residual.known, residual.doubt / np.maximum(residual.variance, 1e-18), 0.0
        ).sum(axis=0)
        blocks = len(residual.time)
        per_stretch = max(_FEWEST_BLOCKS, round(STRETCH / (residual.time[1] - residual.time[0])))
        self.stretch = np.arange(blocks) // per_stretch
        self.fold = self.stretch % FOLDS

    def whiten(self, row: int, values: np.ndarray) -> np.ndarray:
        """Values (B, ...) of a row, whitened."""
        index = self._index[row]
        result = np.zeros(values.shape)
        if len(index):
            flat = values[index].reshape(len(index), -1)
            result[index] = solve_banded(
                (1, 0), self._factor[row], flat, check_finite=False
            ).reshape(values[index].shape)
        return result

    def whiten_signature(self, signature: Signature) -> Signature:
        """A signature, whitened."""
        values = [self.whiten(row, signature.values[:, k]) for k, row in enumerate(signature.rows)]
        offset = signature.offset
        if isinstance(offset, np.ndarray):
            offset = np.stack(
                [self.whiten(row, offset[:, k]) for k, row in enumerate(signature.rows)], axis=1
            )
        return replace(signature, values=np.stack(values, axis=1), offset=offset)

    @cached_property
    def sse(self) -> np.ndarray:
        """Sum of squares of each row, shape (R,)."""
        return (self.y**2).sum(axis=0)

    def scale(self, sse: np.ndarray) -> np.ndarray:
        """Mean square of each row's whitened residual, not less than 1: what the sensors' noise is to be multiplied with, shape (R,)."""
        return np.maximum(sse / np.maximum(self.count, 1), 1.0)

    def deviance(self, sse: np.ndarray) -> float:
        """Minus twice the log-likelihood of whitened residuals, whose variance is what it is but at least 1, up to a constant."""
        scale = self.scale(sse)
        return float((self.count * np.log(scale) + sse / scale).sum())

    def fit(self, signatures: Sequence[Signature]) -> Fit:
        """Fits all signatures together, each row weighted by the inverse of what is left in it.

        Args:
            signatures: whitened.
        """
        sizes = [s.values.shape[2] for s in signatures]
        places = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        parameters, deviation, freedom = (
            np.zeros(sum(sizes)),
            np.zeros(sum(sizes)),
            np.ones(sum(sizes)),
        )
        covariance = np.zeros((sum(sizes), sum(sizes)))
        sse, held_out_sse = self.sse.copy(), self.sse.copy()
        # Those that share no row have nothing to do with each other.
        for group in _connected(signatures):
            part = self._fit_together([signatures[k] for k in group])
            at = np.concatenate([places[k] for k in group])
            rows = np.unique(np.concatenate([signatures[k].rows for k in group]))
            parameters[at], deviation[at], freedom[at] = (
                part.parameters,
                part.deviation,
                part.freedom,
            )
            covariance[np.ix_(at, at)] = part.covariance
            sse[rows], held_out_sse[rows] = part.sse[rows], part.held_out_sse[rows]
        return Fit(parameters, deviation, freedom, covariance, sse, held_out_sse)

    def _fit_together(self, signatures: Sequence[Signature]) -> Fit:
        rows = np.unique(np.concatenate([s.rows for s in signatures]))
        size = sum(s.values.shape[2] for s in signatures)
        X, prior, lowest = (
            np.zeros((len(self.y), len(rows), size)),
            np.zeros(size),
            np.full(size, -np.inf),
        )
        y = self.y[:, rows]
        start = 0
        for s in signatures:
            stop, places = start + s.values.shape[2], np.searchsorted(rows, s.rows)
            X[:, places, start:stop], prior[start:stop], lowest[start:stop] = (
                s.values,
                s.prior,
                s.lowest,
            )
            y[:, places] -= s.offset
            start = stop
        # Units must not decide what counts as singular.
        norm = np.sqrt((X**2).sum(axis=(0, 1)))
        norm[norm == 0] = 1.0
        X, prior, lowest = X / norm, np.diag(prior / norm**2), lowest * norm
        scale = self.scale(self.sse)[rows]
        for _ in range(_REWEIGHTINGS if len(rows) > 1 else 1):
            grams, rights = _moments(X, y, scale)
            theta = bounded_least_squares(grams.sum(axis=0) + prior, rights.sum(axis=0), lowest)
            scale = np.maximum(
                ((y - X @ theta) ** 2).sum(axis=0) / np.maximum(self.count[rows], 1), 1.0
            )
        grams, rights = _moments(X, y, scale)
        gram, right = grams.sum(axis=0) + prior, rights.sum(axis=0)
        theta = bounded_least_squares(gram, right, lowest)
        left = y - X @ theta

        # Sandwich: what is left in a stretch may be correlated in any way. Of many short stretches and few long ones, the wider counts.
        bread = np.linalg.pinv(gram, hermitian=True)
        deviation, freedom = np.sqrt(np.diag(bread)), np.full(size, np.inf)
        for stretch in (self.stretch, self.stretch // _LONG):
            edges = np.flatnonzero(np.diff(stretch, prepend=-1))
            scores = np.add.reduceat(rights - grams @ theta, edges, axis=0)
            sandwich = ((scores @ bread) ** 2).sum(axis=0) * len(edges) / max(1, len(edges) - size)
            information = np.add.reduceat(np.diagonal(grams, axis1=1, axis2=2), edges, axis=0)
            bearing = np.divide(
                information.sum(axis=0) ** 2,
                (information**2).sum(axis=0),
                out=np.ones(size),
                where=information.any(axis=0),
            )
            spread, degrees = (
                np.sqrt(np.maximum(sandwich, np.diag(bread))),
                np.maximum(bearing - 1, 1.0),
            )
            wider = student.ppf(0.975, degrees) * spread > student.ppf(0.975, freedom) * deviation
            deviation, freedom = (
                np.where(wider, spread, deviation),
                np.where(wider, degrees, freedom),
            )

        held_out = np.empty_like(left)
        for fold in range(FOLDS):
            out = self.fold == fold
            held_out[out] = y[out] - X[out] @ bounded_least_squares(
                gram - grams[out].sum(axis=0), right - rights[out].sum(axis=0), lowest
            )
        sse, held_out_sse = self.sse.copy(), self.sse.copy()
        sse[rows], held_out_sse[rows] = (left**2).sum(axis=0), (held_out**2).sum(axis=0)
        # White noise alone would give the deviations of the bread.
        wider = deviation / np.maximum(np.sqrt(np.diag(bread)), 1e-300) / norm
        return Fit(
            theta / norm,
            deviation / norm,
            freedom,
            bread * np.outer(wider, wider),
            sse,
            held_out_sse,
        )


def _connected(signatures: Sequence[Signature]) -> list[list[int]]:
    """Places of signatures that share rows, directly or through others."""
    groups: list[tuple[set[int], list[int]]] = []
    for k, signature in enumerate(signatures):
        rows, members = set(signature.rows.tolist()), [k]
        apart = []
        for group in groups:
            if group[0] & rows:
                rows, members = rows | group[0], group[1] + members
            else:
                apart.append(group)
        groups = [*apart, (rows, members)]
    return [sorted(members) for _, members in groups]


def _moments(X: np.ndarray, y: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gram matrix (B, P, P) and right side (B, P) of every block."""
    weighted = np.swapaxes(X / scale[:, None], 1, 2)
    return weighted @ X, (weighted @ y[:, :, None])[:, :, 0]


def bounded_least_squares(gram: np.ndarray, right: np.ndarray, lowest: np.ndarray) -> np.ndarray:
    """Least squares with parameters not below their bounds: what would be below is held there."""
    free, theta = np.ones(len(right), dtype=bool), np.zeros(len(right))
    while free.any():
        rest = right[free] - gram[np.ix_(free, ~free)] @ theta[~free]
        theta[free] = np.linalg.lstsq(gram[np.ix_(free, free)], rest, rcond=1e-10)[0]
        below = free & (theta < lowest)
        if not below.any():
            break
        theta[below], free = lowest[below], free & ~below
    return theta
