"""Linear regression of residuals on signatures of effects: noise whitened, intervals that respect
what is left of correlation in time, and scores on held-out blocks of time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numba import njit
from scipy.linalg import cholesky_banded
from scipy.special import stdtrit

from fbse_drake.discrepancy.identification.normal_equations import (
    bounded_least_squares,
    squares_left,
    weighted_equations,
)
from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.discrepancy.residual.residual import Residual

# Length of a stretch whose errors may be correlated in any way [s], not less than so many blocks,
# and in how many folds these stretches are held out in turn. Folds and stretches of a step have no
# common divisor, so that no phase of the gait is held out as a whole.
STRETCH = 0.25
_FEWEST_BLOCKS = 10
FOLDS = 5
# Long stretches are this many short ones.
_LONG = 4
# How often the rows are weighted anew by what is left in them.
_REWEIGHTINGS = 3
# Of a variance; what is less counts as this much.
_LEAST_SHARE = 1e-3
# So many numbers are kept of columns by fold, and of inner products; and so many fits.
_MOST_NUMBERS, _KEPT_FITS = 3_000_000, 500


@dataclass(frozen=True, eq=False)
class Signature:
    """What one effect adds to some rows of the residual: offset + values @ parameters, for p
    parameters."""

    # Places of the rows, shape (r,).
    rows: np.ndarray
    # Per unit of each parameter, shape (B, r, p).
    values: np.ndarray
    # What it adds whatever the parameters are, shape (B, r) or 0.
    offset: np.ndarray | float = 0.0
    # What is believed of the parameters beforehand: that they are as expected, with this inverse
    # variance, shape (p,) or 0.
    prior: np.ndarray | float = 0.0
    expected: np.ndarray | float = 0.0
    # The same of what is not believed, but keeps them where the columns hold: it moves a fit, and
    # makes nobody surer.
    steadying: np.ndarray | float = 0.0
    # Smallest and largest value that each parameter can have, shape (p,) or infinite.
    lowest: np.ndarray | float = -np.inf
    highest: np.ndarray | float = np.inf
    # Values about which it is linear, shape (p,), or 0.
    about: np.ndarray | float = 0.0

    @property
    def parameters(self) -> int:
        """How many."""
        return self.values.shape[2]

    @property
    def columns(self) -> int:
        """How many, an offset among them."""
        return self.parameters + isinstance(self.offset, np.ndarray)

    @cached_property
    def beliefs(self) -> np.ndarray:
        """Prior, what is expected, steadying, lowest and highest of each parameter, (5, p)."""
        believed = self.prior, self.expected, self.steadying, self.lowest, self.highest
        return np.stack([np.broadcast_to(values, self.parameters) for values in believed])


# Places of the rows that two signatures share in each of them, and inner products of their columns.
_Products = WeakKeyDictionary[
    Signature, WeakKeyDictionary[Signature, tuple[np.ndarray, np.ndarray, np.ndarray]]
]


@dataclass(frozen=True)
class Spread:
    """How sure P fitted parameters are."""

    # Standard deviation of each parameter, shape (P,): sandwich estimate by stretches of time, not
    # less than what the noise alone gives.
    deviation: np.ndarray
    # Degrees of freedom of each parameter's interval: stretches that bear on it, shape (P,).
    freedom: np.ndarray
    # Covariance with these deviations, (P, P); correlations as of white noise.
    covariance: np.ndarray

    def if_known(self, known: slice, of: slice) -> np.ndarray:
        """Share of their deviations that parameters keep if others are known, (p,)."""
        deviation = np.maximum(self.deviation, 1e-300)
        correlation = self.covariance / np.outer(deviation, deviation)
        by_known = correlation[of, known]
        told = by_known @ np.linalg.pinv(correlation[known, known], hermitian=True) @ by_known.T
        return np.sqrt(np.clip(1.0 - np.diag(told), 0.0, 1.0))


@dataclass(frozen=True)
class Fit:
    """Regression on several signatures at once; P parameters in their order, R rows."""

    parameters: np.ndarray
    # Sum of squares of the whitened residual in each row: over all blocks, and with each block
    # predicted from the other folds, (R,).
    sse: np.ndarray
    held_out_sse: np.ndarray
    # What was fitted together, and where its parameters stand.
    parts: tuple[tuple[np.ndarray, "PartialFit"], ...]

    @cached_property
    def spread(self) -> Spread:
        """Found when it is asked for: most fits are not worth it."""
        size = len(self.parameters)
        deviation, freedom, covariance = np.zeros(size), np.ones(size), np.zeros((size, size))
        for at, part in self.parts:
            deviation[at], freedom[at] = part.spread.deviation, part.spread.freedom
            covariance[np.ix_(at, at)] = part.spread.covariance
        return Spread(deviation, freedom, covariance)

    @property
    def deviation(self) -> np.ndarray:
        return self.spread.deviation

    @property
    def covariance(self) -> np.ndarray:
        return self.spread.covariance

    def interval(self, confidence: float = 0.95) -> np.ndarray:
        """Confidence interval of each parameter, shape (P, 2)."""
        half = stdtrit(self.spread.freedom, (1 + confidence) / 2) * self.spread.deviation
        return np.stack([self.parameters - half, self.parameters + half], axis=1)


class WhitenedResidual:
    """A residual with its noise made white and of unit variance, row by row; zero where a row is
    not known. It does not change."""

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
        # How many blocks' worth of each row's variance is doubt about laws rather than noise of
        # sensors, (R,).
        self.doubt = np.where(
            residual.known, residual.doubt / np.maximum(residual.variance, 1e-18), 0.0
        ).sum(axis=0)
        blocks = len(residual.time)
        per_stretch = max(_FEWEST_BLOCKS, round(STRETCH / (residual.time[1] - residual.time[0])))
        self.stretch = np.arange(blocks) // per_stretch
        self.fold = self.stretch % FOLDS

    def whiten(self, row: int, values: np.ndarray) -> np.ndarray:
        """Values (B, ...) of a row, whitened."""
        index, (diagonal, below) = self._index[row], self._factor[row]
        flat = np.ascontiguousarray(values).reshape(len(values), -1)
        result = np.zeros(flat.shape)
        _divide_by_bidiagonal(result, flat, index, diagonal, below)
        return result.reshape(values.shape)

    def coloured(self, values: np.ndarray) -> np.ndarray:
        """What gives these values (B, R) when it is whitened; 0 where a row is not known."""
        result = np.zeros(values.shape)
        for row, (index, (diagonal, below)) in enumerate(
            zip(self._index, self._factor, strict=True)
        ):
            known = values[index, row]
            result[index, row] = diagonal * known
            result[index[1:], row] += below[:-1] * known[:-1]
        return result

    def whiten_back(self, row: int, values: np.ndarray) -> np.ndarray:
        """The transpose of `whiten`: inner products of what is whitened with values (B, ...) are
        those of what is not with this."""
        index, (diagonal, below) = self._index[row], self._factor[row]
        flat = np.ascontiguousarray(values).reshape(len(values), -1)
        result = np.zeros(flat.shape)
        backwards = (np.ascontiguousarray(v[::-1]) for v in (index, diagonal, below[:-1]))
        _divide_by_bidiagonal(result, flat, *backwards)
        return result.reshape(values.shape)

    def whiten_signature(self, signature: Signature) -> Signature:
        """A signature, whitened."""
        values = np.empty((len(signature.rows), len(self.y), signature.parameters))
        for k, row in enumerate(signature.rows):
            values[k] = self.whiten(row, signature.values[:, k])
        offset = signature.offset
        if isinstance(offset, np.ndarray):
            whitened = np.empty_like(offset)
            for k, row in enumerate(signature.rows):
                whitened[:, k] = self.whiten(row, offset[:, k])
            offset = whitened
        # The columns of a row stand together in memory: it is row by row that they meet the data.
        return replace(signature, values=np.moveaxis(values, 0, 1), offset=offset)

    @cached_property
    def sse(self) -> np.ndarray:
        """Sum of squares of each row, shape (R,)."""
        return (self.y**2).sum(axis=0)

    def scale(self, sse: np.ndarray) -> np.ndarray:
        """Mean square of each row's whitened residual, not less than 1: what the sensors' noise is
        to be multiplied with, shape (R,)."""
        return np.maximum(sse / np.maximum(self.count, 1), 1.0)

    def deviance_by_row(self, sse: np.ndarray) -> np.ndarray:
        """Minus twice the log-likelihood of whitened residuals, up to a constant, (R,).

        Their variance is what it is, but at least 1.
        """
        scale = self.scale(sse)
        return self.count * np.log(scale) + sse / scale

    def deviance(self, sse: np.ndarray) -> float:
        """The same of all rows."""
        return float(self.deviance_by_row(sse).sum())


@njit(cache=True)
def _divide_by_bidiagonal(
    result: np.ndarray,
    values: np.ndarray,
    index: np.ndarray,
    diagonal: np.ndarray,
    below: np.ndarray,
) -> None:
    """Solves L X = Y forwards, all columns of a row together: column after column, as LAPACK does
    it, takes ten times as long.

    Args:
        result: X in the rows of the index, (B, K); filled.
        values: Y in the same rows, (B, K).
        index: of the N rows of the system, (N,).
        diagonal, below: of L, (N,) each; the last below is not looked at.
    """
    for i in range(len(index)):
        row = index[i]
        if i == 0:
            for k in range(values.shape[1]):
                result[row, k] = values[row, k] / diagonal[i]
            continue
        last = index[i - 1]
        for k in range(values.shape[1]):
            result[row, k] = (values[row, k] - below[i - 1] * result[last, k]) / diagonal[i]


class PartialFit:
    """Signatures that share rows, fitted together; P parameters, r rows."""

    def __init__(
        self,
        white: WhitenedResidual,
        signatures: tuple[Signature, ...],
        rows: np.ndarray,
        gram: np.ndarray,
        scale: np.ndarray,
        parameters: np.ndarray,
        sse: np.ndarray,
        held_out_sse: np.ndarray,
    ):
        """What the fit came to.

        Args:
            gram: with the rows weighted by the inverse of their `scale`, and what is believed
                beforehand, (P, P).
        """
        self._white, self._signatures, self._gram, self._scale = white, signatures, gram, scale
        self.rows, self.parameters, self.sse, self.held_out_sse = (
            rows,
            parameters,
            sse,
            held_out_sse,
        )

    @cached_property
    def spread(self) -> Spread:
        """Sandwich: what is left in a stretch may be correlated in any way. Of many short stretches
        and few long ones, the wider counts.

        What is believed beforehand is no estimate from stretches: variances that it leaves are
        added to those by the data, and degrees of freedom are as after F. E. Satterthwaite, "An
        approximate distribution of estimates of variance components", Biometrics 2, 1946.
        """
        white, size = self._white, len(self.parameters)
        left = leftover(white, self._signatures, self.parameters)[:, self.rows] / self._scale
        by_block, information = np.empty((len(left), size)), np.empty((len(left), size))
        start = 0
        for s in self._signatures:
            stop, places = start + s.parameters, np.searchsorted(self.rows, s.rows)
            by_block[:, start:stop] = np.einsum("brp,br->bp", s.values, left[:, places])
            information[:, start:stop] = np.einsum(
                "brp,r->bp", s.values**2, 1.0 / self._scale[places]
            )
            start = stop
        # Units must not decide what counts as singular.
        norm = np.sqrt(np.diag(self._gram))
        norm[norm == 0] = 1.0
        bread = np.linalg.pinv(self._gram / np.outer(norm, norm), hermitian=True)
        bread /= np.outer(norm, norm)
        least = np.sqrt(np.diag(bread))
        prior = np.concatenate([s.beliefs[0] for s in self._signatures])
        believed = np.minimum(((bread**2) * prior).sum(axis=1), least**2)
        deviation, freedom = least, np.full(size, np.inf)
        for stretch in (white.stretch, white.stretch // _LONG):
            edges = np.flatnonzero(np.diff(stretch, prepend=-1))
            scores = np.add.reduceat(by_block, edges, axis=0)
            sandwich = ((scores @ bread) ** 2).sum(axis=0) * len(edges) / max(1, len(edges) - size)
            borne = np.add.reduceat(information, edges, axis=0)
            bearing = np.divide(
                borne.sum(axis=0) ** 2,
                (borne**2).sum(axis=0),
                out=np.ones(size),
                where=borne.any(axis=0),
            )
            by_data = np.maximum(sandwich, least**2 - believed)
            spread = np.sqrt(believed + by_data)
            degrees = np.maximum(bearing - 1, 1.0)
            degrees /= np.maximum(by_data / np.maximum(spread**2, 1e-300), _LEAST_SHARE) ** 2
            wider = stdtrit(degrees, 0.975) * spread > stdtrit(freedom, 0.975) * deviation
            deviation, freedom = (
                np.where(wider, spread, deviation),
                np.where(wider, degrees, freedom),
            )
        # White noise alone would give the deviations of the bread.
        wider = deviation / np.maximum(least, 1e-300)
        return Spread(deviation, freedom, bread * np.outer(wider, wider))


@dataclass(frozen=True)
class _Assembled:
    """Inner products of several signatures' columns and the residual, by fold and row: F folds, r
    rows, Q columns, offsets among them."""

    rows: np.ndarray
    # (F, r, Q, Q) and (F, r, Q).
    gram: np.ndarray
    target: np.ndarray
    # Places of the columns that have a parameter, (P,); offsets have none.
    fitted: np.ndarray

    @cached_property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Over all folds, (r, Q, Q) and (r, Q)."""
        return self.gram.sum(axis=0), self.target.sum(axis=0)

    def of(self, fold: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Of one fold, or of all."""
        return self.whole if fold is None else (self.gram[fold], self.target[fold])

    def weighted(self, scale: np.ndarray, fold: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of one fold, or of all, each row weighted by the inverse of its scale
        (r,): (P, P) and (P,) of the P columns that have a parameter."""
        return weighted_equations(*self.of(fold), 1.0 / scale, self.fitted)


class Regression:
    """Fits of signatures to one whitened residual.

    Columns meet the data, and each other, once: their inner products by row and fold are kept, and
    a fit is algebra with them. Where a sum of squares is too small a difference of theirs, it is
    found from the data.
    """

    def __init__(self, white: WhitenedResidual):
        self.white = white
        self._of_fold = [np.flatnonzero(white.fold == fold) for fold in range(FOLDS)]
        self._y = [white.y[blocks].T for blocks in self._of_fold]
        self._square = np.array([(y**2).sum(axis=1) for y in self._y])
        self._split: Memory[list[np.ndarray]] = Memory(
            _MOST_NUMBERS, lambda parts: sum(part.size for part in parts)
        )
        self._targets: WeakKeyDictionary[Signature, np.ndarray] = WeakKeyDictionary()
        self._grams: _Products = WeakKeyDictionary()
        self._products: _Products = WeakKeyDictionary()
        self._rights: WeakKeyDictionary[Signature, np.ndarray] = WeakKeyDictionary()
        # In the order in which signatures were first seen: what is tried last stands last, and all
        # before it are known together already.
        self._age: WeakKeyDictionary[Signature, int] = WeakKeyDictionary()
        self._assembled: Memory[_Assembled] = Memory(_MOST_NUMBERS, lambda a: a.gram.size)
        self._parts: Memory[PartialFit] = Memory(_KEPT_FITS)

    def fit(self, signatures: Sequence[Signature]) -> Fit:
        """Fits all signatures together, each row weighted by the inverse of what is left in it.

        Args:
            signatures: whitened.
        """
        sizes = [s.parameters for s in signatures]
        places = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        age = self._ages(signatures)
        parameters, parts = np.zeros(sum(sizes)), []
        sse, held_out_sse = self.white.sse.copy(), self.white.sse.copy()
        # Those that share no row have nothing to do with each other.
        for group in connected(signatures):
            members = sorted(group, key=lambda k: age[k])
            part = self._part(tuple(signatures[k] for k in members))
            at = np.concatenate([places[k] for k in members])
            parameters[at] = part.parameters
            sse[part.rows], held_out_sse[part.rows] = part.sse, part.held_out_sse
            parts.append((at, part))
        return Fit(parameters, sse, held_out_sse, tuple(parts))

    def _ages(self, signatures: Sequence[Signature]) -> list[int]:
        """Places of signatures in the order in which all were first seen."""
        return [self._age.setdefault(signature, len(self._age)) for signature in signatures]

    def gram(self, a: Signature, b: Signature) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inner products of the columns of two whitened signatures in the rows that they share.

        Returns:
            Places of these rows in each of the two, (s,), and the products by fold, (F, s, p_a,
            p_b); an offset is a last column.
        """
        known = self._grams.setdefault(a, WeakKeyDictionary())
        if b not in known and a in self._grams.get(b, ()):
            of_b, of_a, products = self._grams[b][a]
            return of_a, of_b, np.swapaxes(products, 2, 3)
        if b not in known:
            of_a, of_b = _shared(a, b)
            by_fold = [
                np.swapaxes(x[of_a], 1, 2) @ z[of_b]
                for x, z in zip(self._by_fold(a), self._by_fold(b), strict=True)
            ]
            known[b] = of_a, of_b, np.array(by_fold)
        return known[b]

    def target(self, signature: Signature) -> np.ndarray:
        """Inner products of a signature's columns with the residual, (F, r, p); an offset is a last
        column."""
        if signature not in self._targets:
            self._targets[signature] = np.array(
                [
                    (np.swapaxes(x, 1, 2) @ y[signature.rows, :, None])[..., 0]
                    for x, y in zip(self._by_fold(signature), self._y, strict=True)
                ]
            )
        return self._targets[signature]

    def products(self, a: Signature, b: Signature) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `gram`, over all folds, (s, p_a, p_b); for columns that need not be fitted."""
        known = self._products.setdefault(a, WeakKeyDictionary())
        if b not in known:
            of_a, of_b = _shared(a, b)
            x, z = (columns_of(s)[at] for s, at in ((a, of_a), (b, of_b)))
            known[b] = of_a, of_b, np.swapaxes(x, 1, 2) @ z
        return known[b]

    def right(self, signature: Signature) -> np.ndarray:
        """As `target`, over all folds, (r, p)."""
        if signature not in self._rights:
            self._rights[signature] = np.stack(
                [
                    columns.T @ self.white.y[:, row]
                    for columns, row in zip(columns_of(signature), signature.rows, strict=True)
                ]
            )
        return self._rights[signature]

    def _by_fold(self, signature: Signature) -> list[np.ndarray]:
        """Columns of a signature, its offset the last, in the blocks of each fold, (r, B_f, p)."""

        def made() -> list[np.ndarray]:
            columns = columns_of(signature)
            return [columns[:, blocks] for blocks in self._of_fold]

        return self._split.or_made(signature, made)

    def _together(self, signatures: tuple[Signature, ...]) -> _Assembled:
        """Of all these; those before the last are most often together already."""
        return self._assembled.or_made(signatures, lambda: self._assemble(signatures))

    def _assemble(self, signatures: tuple[Signature, ...]) -> _Assembled:
        # What was there before the last is asked for again and again.
        before = (
            self._assembled.or_made(signatures[:-1], lambda: self._join(signatures[:-1]))
            if len(signatures) > 1
            else None
        )
        return self._join(signatures[-1:], signatures[:-1], before)

    def _join(
        self,
        added: tuple[Signature, ...],
        known: tuple[Signature, ...] = (),
        before: _Assembled | None = None,
    ) -> _Assembled:
        """Signatures put to others that are together already."""
        signatures = known + added
        rows = np.unique(np.concatenate([s.rows for s in signatures]))
        stops = np.cumsum([s.columns for s in signatures])
        gram = np.zeros((FOLDS, len(rows), stops[-1], stops[-1]))
        target = np.zeros((FOLDS, len(rows), stops[-1]))
        if before is not None:
            start = stops[len(known) - 1]
            at = np.searchsorted(rows, before.rows)
            gram[:, at, :start, :start], target[:, at, :start] = before.gram, before.target
        parts = [slice(stop - s.columns, stop) for s, stop in zip(signatures, stops, strict=True)]
        for k in range(len(known), len(signatures)):
            new, part = signatures[k], parts[k]
            target[:, np.searchsorted(rows, new.rows), part] = self.target(new)
            for other, place in zip(signatures[: k + 1], parts, strict=False):
                of_other, _, products = self.gram(other, new)
                at = np.searchsorted(rows, other.rows[of_other])
                gram[:, at, place, part] = products
                gram[:, at, part, place] = np.swapaxes(products, 2, 3)
        fitted = [
            part.start + np.arange(s.parameters) for s, part in zip(signatures, parts, strict=True)
        ]
        return _Assembled(rows, gram, target, np.concatenate(fitted))

    def normal_equations(
        self, signatures: Sequence[Signature], scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of several signatures in all their rows, each weighted by the inverse of its scale (R,).

        Returns:
            Inner products of the columns that have a parameter with each other, (P, P), and with
            the residual less the offsets, (P,).
        """
        order = np.argsort(self._ages(signatures))
        together = self._together(tuple(signatures[k] for k in order))
        sizes = [s.parameters for s in signatures]
        places = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        at = np.argsort(np.concatenate([places[k] for k in order]))
        gram, right = together.weighted(scale[together.rows])
        return gram[np.ix_(at, at)], right[at]

    def _part(self, signatures: tuple[Signature, ...]) -> PartialFit:
        return self._parts.or_made(signatures, lambda: self._fit_together(signatures))

    def _fit_together(self, signatures: tuple[Signature, ...]) -> PartialFit:
        together, white = self._together(signatures), self.white
        rows, count = together.rows, np.maximum(white.count[together.rows], 1)
        fitted = together.fitted
        amounts = np.ones(together.target.shape[2])
        prior, expected, steadying, lowest, highest = np.hstack([s.beliefs for s in signatures])
        # Units must not decide what counts as singular, nor a column that is next to nothing beside
        # what is believed of it.
        norm = np.sqrt(np.einsum("rqq->q", together.whole[0])[fitted] + prior + steadying)
        norm[norm == 0] = 1.0
        held, believed = np.diag((prior + steadying) / norm**2), prior * expected / norm
        norms, bounds = np.outer(norm, norm), (lowest * norm, highest * norm)

        def weighted(fold: int | None) -> tuple[np.ndarray, np.ndarray]:
            gram, right = together.weighted(scale, fold)
            return gram / norms, right / norm

        def solved(gram: np.ndarray, right: np.ndarray) -> np.ndarray:
            found = bounded_least_squares(gram, right, *bounds) / norm
            # What is rounded beyond a bound would be impossible.
            return np.minimum(np.maximum(found, lowest), highest)

        # From the sensors' noise on: weighted by what is there before anything is fitted,
        # beliefs would hold back what the data say clearly.
        scale = np.ones(len(rows))
        for _ in range(_REWEIGHTINGS):
            gram, right = weighted(None)
            amounts[fitted] = solved(gram + held, right + believed)
            scale = np.maximum(self._squares(signatures, together, amounts) / count, 1.0)
        gram, right = weighted(None)
        gram, right = gram + held, right + believed
        amounts[fitted] = solved(gram, right)
        parameters = amounts[fitted]
        sse = self._squares(signatures, together, amounts)
        held_out_sse = np.zeros(len(rows))
        for fold in range(FOLDS):
            of_fold = weighted(fold)
            amounts[fitted] = solved(gram - of_fold[0], right - of_fold[1])
            held_out_sse += self._squares(signatures, together, amounts, fold)
        return PartialFit(
            white,
            signatures,
            rows,
            gram * norms - np.diag(steadying),
            scale,
            parameters,
            sse,
            held_out_sse,
        )

    def _squares(
        self,
        signatures: tuple[Signature, ...],
        together: _Assembled,
        amounts: np.ndarray,
        fold: int | None = None,
    ) -> np.ndarray:
        """Sum of squares of what is left in each row, in one fold or in all, (r,).

        Args:
            amounts: of each column, 1 for an offset, (Q,).
        """
        part = slice(None) if fold is None else slice(fold, fold + 1)
        square = self._square[part, together.rows].sum(axis=0)
        result, is_rounded = squares_left(*together.of(fold), square, amounts)
        if is_rounded:
            y = self._y if fold is None else self._y[fold : fold + 1]
            left = [values[together.rows].copy() for values in y]
            start = 0
            for s in signatures:
                stop, at = start + s.columns, np.searchsorted(together.rows, s.rows)
                for values, columns in zip(left, self._by_fold(s)[part], strict=True):
                    values[at] -= columns @ amounts[start:stop]
                start = stop
            result = sum((values**2).sum(axis=1) for values in left)
        return result


def _shared(a: Signature, b: Signature) -> tuple[np.ndarray, np.ndarray]:
    """Places of the rows that two signatures share, in each of them."""
    at = np.searchsorted(b.rows, a.rows)
    of_a = np.flatnonzero(b.rows[np.minimum(at, len(b.rows) - 1)] == a.rows)
    return of_a, at[of_a]


def columns_of(signature: Signature) -> np.ndarray:
    """Columns of a signature row by row, its offset the last, (r, B, p)."""
    columns = np.moveaxis(signature.values, 1, 0)
    if not isinstance(signature.offset, np.ndarray):
        return columns
    return np.concatenate([columns, signature.offset.T[:, :, None]], axis=2)


def leftover(
    white: WhitenedResidual, signatures: Sequence[Signature], parameters: np.ndarray
) -> np.ndarray:
    """Whitened residual without what signatures with these parameters add, (B, R)."""
    left, start = white.y.copy(), 0
    for s in signatures:
        stop = start + s.parameters
        left[:, s.rows] -= s.values @ parameters[start:stop] + s.offset
        start = stop
    return left


def connected(signatures: Sequence[Signature]) -> list[list[int]]:
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
