"""What an explanation leaves of a residual, and what further columns could take of it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fbse_drake.discrepancy.diagnosis.grid_sets import GridSets
from fbse_drake.discrepancy.identification.regression import Regression, Signature, connected

# Directions with less than this share of the largest inner product are there by rounding alone.
_SINGULAR = 1e-12
# Of a column of which no more than this share is left beside others nothing is left.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class _Beside:
    """The columns that an explanation has in one row."""

    # Those with columns there, and the place of the row in each.
    signatures: tuple[Signature, ...]
    # Of each column, 1 for an offset, (Q,); and which have a parameter.
    amounts: np.ndarray
    fitted: np.ndarray
    # Of the fitted columns X: a root of what stands for (X^T X)^-1, (P, k), and what a fit to what
    # is left would change in the parameters.
    root: np.ndarray
    shift: np.ndarray
    # What that fit would take off the sum of squares, which bounds and beliefs hold back.
    held_back: float

    @cached_property
    def key(self) -> tuple[object, ...]:
        """Equal for explanations that are equal in this row."""
        return (*self.signatures, self.amounts.tobytes(), self.shift.tobytes(), self.root.tobytes())


class Remainder:
    """What an explanation leaves.

    Of new columns x in one row its columns X there leave x - X (X^T X)^-1 X^T x. Columns that are
    in several rows however tie these together: what a foot's gain explains of one joint as well as
    the joint's motor would, it cannot take from it without being wrong in the others. With all
    columns X that are tied to each other, rows one below the other and weighted, new columns in row
    r keep x^T x - x^T X_r (X^T X)^-1 X_r^T x of their sum of squares.
    """

    def __init__(
        self,
        regression: Regression,
        signatures: tuple[Signature, ...],
        parameters: np.ndarray,
        scale: np.ndarray,
        *,
        tied: bool,
    ):
        """What is left.

        Args:
            signatures: of the explanation, whitened, and their parameters.
            scale: what the noise of each row is to be multiplied with, (R,).
            tied: are all rows tied together, by inertia that is fitted along?
        """
        self._regression, self._signatures, self.scale = regression, signatures, scale
        stops = np.cumsum([s.parameters for s in signatures], dtype=int)
        self._slices = [
            slice(stop - s.parameters, stop) for s, stop in zip(signatures, stops, strict=True)
        ]
        self._parameters = parameters
        groups = [[*range(len(signatures))]] if tied else connected(signatures)
        # By signature: those that it is tied to, if they are in more than one row.
        self._tied_to: dict[int, tuple[int, ...]] = {
            k: tuple(group)
            for group in groups
            if tied or len({row for member in group for row in signatures[member].rows}) > 1
            for k in group
        }
        self._rows: dict[int, _Beside] = {}
        self._of_groups: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = {}

    def beside(self, row: int) -> _Beside:
        """What the explanation has in a row."""
        if row not in self._rows:
            self._rows[row] = self._beside(row)
        return self._rows[row]

    def moments(self, signature: Signature) -> list[tuple[np.ndarray, np.ndarray]]:
        """Inner products of a signature's columns in each of its rows, with each other (p, p) and
        with what is left (p,), of the parts that the explanation leaves."""
        within, rights = (
            self._regression.products(signature, signature)[2],
            self._regression.right(signature),
        )
        found = []
        for place, (gram, right) in enumerate(zip(within, rights, strict=True)):
            if self.beside(int(signature.rows[place])).signatures:
                (gram,), (right,) = self.moments_of_sets(signature, place, gram[None])
            found.append((gram, right))
        return found

    def moments_of_sets(
        self, signature: Signature, place: int, gram: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same for G sets of p columns each, one set after the other.

        Args:
            gram: inner products within each set, (G, p, p).

        Returns:
            Shapes (G, p, p) and (G, p).
        """
        right = self._regression.right(signature)[place]
        row = int(signature.rows[place])
        return self._left(row, gram, right, lambda other: self._cross(signature, place, other))

    def moments_of_grid(self, grid: GridSets) -> tuple[np.ndarray, np.ndarray]:
        """The same for the sets of a grid."""

        def cross(other: Signature) -> np.ndarray:
            return grid.with_columns(other, int(np.flatnonzero(other.rows == grid.row)[0]))

        return self._left(grid.row, grid.gram, grid.right, cross)

    def _left(
        self,
        row: int,
        gram: np.ndarray,
        right: np.ndarray,
        cross_with: Callable[[Signature], np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inner products of new columns in a row that are left beside the explanation.

        Args:
            gram, right: with each other and with the residual, (G, p, p) and (G p,).
            cross_with: with the columns of a signature, (G p, q).
        """
        beside, sets = self.beside(row), gram.shape[:2]
        if beside.signatures:
            cross = np.concatenate([cross_with(other) for other in beside.signatures], axis=1)
            of_fitted = cross[:, beside.fitted]
            right = right - cross @ beside.amounts - of_fitted @ beside.shift
            taken = (of_fitted @ beside.root).reshape(*sets, -1)
            left = gram - taken @ np.swapaxes(taken, 1, 2)
            gone = np.einsum("gpp->gp", left) < _ROUNDING * np.einsum("gpp->gp", gram)
            right = np.where(gone, 0.0, right.reshape(sets))
            gram = np.where(gone[:, :, None] | gone[:, None, :], 0.0, left)
        return gram, right.reshape(sets)

    def _cross(self, signature: Signature, place: int, other: Signature) -> np.ndarray:
        of_new, _, products = self._regression.products(signature, other)
        return products[np.flatnonzero(of_new == place)[0]]

    def _beside(self, row: int) -> _Beside:
        there = [k for k, s in enumerate(self._signatures) if row in s.rows]
        signatures = tuple(self._signatures[k] for k in there)
        if not signatures:
            return _Beside((), np.zeros(0), np.zeros(0, bool), np.zeros((0, 0)), np.zeros(0), 0.0)
        gram, right, fitted = self._row_moments(row, signatures)
        amounts = np.ones(len(right))
        amounts[fitted] = np.concatenate([self._parameters[self._slices[k]] for k in there])
        of_fitted, left = gram[np.ix_(fitted, fitted)], right[fitted] - gram[fitted] @ amounts

        def beside(root: np.ndarray, shift: np.ndarray) -> _Beside:
            held_back = max(0.0, float(2.0 * shift @ left - shift @ of_fitted @ shift))
            return _Beside(signatures, amounts, fitted, root, shift, held_back)

        if there[0] in self._tied_to:
            at = np.concatenate([np.arange(len(self._parameters))[self._slices[k]] for k in there])
            inverse, correction = self._of_group(self._tied_to[there[0]])
            root = _root(inverse[np.ix_(at, at)] / self.scale[row])
            return beside(root, correction[at])
        root = _inverse_root(of_fitted)
        return beside(root, root @ (root.T @ left))

    def _row_moments(
        self, row: int, signatures: tuple[Signature, ...]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inner products of an explanation's columns in a row with each other and with the
        residual; which have a parameter."""
        places = [int(np.flatnonzero(s.rows == row)[0]) for s in signatures]
        rights = [
            self._regression.target(s)[:, place].sum(axis=0)
            for s, place in zip(signatures, places, strict=True)
        ]
        fitted = np.concatenate(
            [
                np.arange(len(right)) < s.parameters
                for s, right in zip(signatures, rights, strict=True)
            ]
        )
        stops = np.cumsum([len(right) for right in rights])
        gram = np.zeros((stops[-1], stops[-1]))
        for i, a in enumerate(signatures):
            for j, b in enumerate(signatures[: i + 1]):
                of_a, _, products = self._regression.gram(a, b)
                block = products[:, np.flatnonzero(of_a == places[i])[0]].sum(axis=0)
                rows = slice(stops[i] - len(rights[i]), stops[i])
                columns = slice(stops[j] - len(rights[j]), stops[j])
                gram[rows, columns], gram[columns, rows] = block, block.T
        return gram, np.concatenate(rights), fitted

    def _of_group(self, group: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """(X^T X)^-1 of the columns of some signatures in all rows, weighted, and what a fit
        without any prior would change in their parameters; zero for the others."""
        if group not in self._of_groups:
            self._of_groups[group] = self._fit_of(group)
        return self._of_groups[group]

    def _fit_of(self, group: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        size = len(self._parameters)
        own = np.concatenate([np.arange(size)[self._slices[k]] for k in group])
        signatures = [self._signatures[k] for k in group]
        gram, right = self._regression.normal_equations(signatures, self.scale)
        left = right - gram @ self._parameters[own]
        inverse, change = np.zeros((size, size)), np.zeros(size)
        root = _inverse_root(gram)
        inverse[np.ix_(own, own)], change[own] = root @ root.T, root @ (root.T @ left)
        return inverse, change


def _inverse_root(gram: np.ndarray) -> np.ndarray:
    """L with L L^T = gram^-1, (P, k), without directions that are there by rounding."""
    norm = np.sqrt(np.diag(gram))
    norm[norm == 0] = 1.0
    power, directions = np.linalg.eigh(gram / np.outer(norm, norm))
    seen = power > _SINGULAR * max(power.max(), 0.0)
    return directions[:, seen] / np.sqrt(power[seen]) / norm[:, None]


def _root(inverse: np.ndarray) -> np.ndarray:
    """L with L L^T equal to a positive semidefinite matrix, (P, k)."""
    power, directions = np.linalg.eigh(inverse)
    seen = power > 0
    return directions[:, seen] * np.sqrt(power[seen])
