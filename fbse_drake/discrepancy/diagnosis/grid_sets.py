"""Columns of the first grid of nonlinear values that a search tries."""

from collections.abc import Mapping
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from fbse_drake.discrepancy.identification.regression import (
    Signature,
    WhitenedResidual,
    columns_of,
)
from fbse_drake.effects.effect import Parameter


class GridSets:
    """Columns of a joint torque effect in one row for the first G sets of its nonlinear values.

    They stay as they are, and what they meet is whitened twice instead: whitened copies would be
    most of the memory of a search.
    """

    def __init__(self, white: WhitenedResidual, row: int, columns: np.ndarray):
        """Whitens columns (B, p, G) once, for their inner products."""
        self._white, self.row, self._columns = white, row, columns
        by_set = np.transpose(white.whiten(row, columns), (2, 1, 0))
        # Within each set, (G, p, p).
        self.gram = by_set @ np.swapaxes(by_set, 1, 2)
        self._products: WeakKeyDictionary[Signature, np.ndarray] = WeakKeyDictionary()

    @cached_property
    def right(self) -> np.ndarray:
        """Inner products with the residual, (G p,)."""
        return self.times(self._white.y[:, [self.row]])[:, 0]

    def with_columns(self, signature: Signature, place: int) -> np.ndarray:
        """Inner products with those of a whitened signature in one of its rows, which is this one,
        an offset the last, (G p, q)."""
        if signature not in self._products:
            self._products[signature] = self.times(columns_of(signature)[place])
        return self._products[signature]

    def times(self, whitened: np.ndarray) -> np.ndarray:
        """Inner products with whitened columns (B, q), one set after the other, (G p, q)."""
        twice = self._white.whiten_back(self.row, whitened)
        flat = self._columns.reshape(len(self._columns), -1)
        products = (flat.T @ twice).reshape(*self._columns.shape[1:], -1)
        return np.swapaxes(products, 0, 1).reshape(-1, whitened.shape[1])


def grid_gain(
    parameters: Mapping[str, Parameter], gram: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Drop of the sum of squares for each set of nonlinear values, shape (G,)."""
    linear = [parameter for parameter in parameters.values() if parameter.linear]
    if not linear:
        return 2 * right[:, 0] - gram[:, 0, 0]
    if right.shape[1] == 1:
        theta = np.divide(
            right[:, 0], gram[:, 0, 0], out=np.zeros(len(right)), where=gram[:, 0, 0] > 1e-12
        )
        theta = np.clip(theta, *linear[0].bounds)
        return 2 * theta * right[:, 0] - theta**2 * gram[:, 0, 0]
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(
        gram.shape[1]
    ) + 1e-12 * np.eye(gram.shape[1])
    return np.einsum("gp,gp->g", right, np.linalg.solve(gram + ridge, right[:, :, None])[:, :, 0])
