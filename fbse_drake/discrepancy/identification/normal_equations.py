"""Normal equations of a regression row by row, and their solution between bounds.

They are small and there are many of them, so that what calls them in Python would take longer than
they do.
"""

import numpy as np
from numba import njit

# Columns, scaled to the same length, of which one keeps less than this share of its length beside
# the others are collinear.
_COLLINEAR = 1e-4
# Of collinear columns, singular values that are a smaller share of the largest are none.
_SINGULAR = 1e-10
# Rounding of a sum of products as a share of its terms, and the share of the sum that may be
# rounding.
_ROUNDING, _NEGLIGIBLE = 1e-15, 1e-7


@njit(cache=True)
def weighted_equations(
    gram: np.ndarray, target: np.ndarray, weight: np.ndarray, fitted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of all rows together.

    Args:
        gram, target: inner products of the columns in each row with each other, (r, Q, Q), and with
            the residual, (r, Q).
        weight: of each row, (r,).
        fitted: places of the P columns that have a parameter, (P,); of the others, offsets, there
            is one each.

    Returns:
        Of the columns that have a parameter with each other, (P, P), and with the residual less the
        offsets, (P,).
    """
    r, Q, P = len(weight), gram.shape[1], len(fitted)
    is_offset = np.ones(Q, dtype=np.bool_)
    is_offset[fitted] = False
    offsets = np.flatnonzero(is_offset)
    products, right = np.zeros((P, P)), np.zeros(P)
    for row in range(r):
        for i in range(P):
            of_row, left = gram[row, fitted[i]], target[row, fitted[i]]
            for q in offsets:
                left -= of_row[q]
            right[i] += weight[row] * left
            for j in range(P):
                products[i, j] += weight[row] * of_row[fitted[j]]
    return products, right


@njit(cache=True)
def squares_left(
    gram: np.ndarray, target: np.ndarray, square: np.ndarray, amounts: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Sums of squares that columns leave of a residual.

    Args:
        gram, target: as of `weighted_equations`.
        square: of the residual in each row, (r,).
        amounts: of each column, (Q,).

    Returns:
        In each row, (r,); and whether these differences of large numbers may be rounding in any.
    """
    left, is_rounded, Q = np.empty(len(square)), False, len(amounts)
    for row in range(len(square)):
        total, size = square[row], np.sqrt(square[row])
        for i in range(Q):
            product = 0.0
            for j in range(Q):
                product += gram[row, i, j] * amounts[j]
            total += amounts[i] * (product - 2.0 * target[row, i])
            size += abs(amounts[i]) * np.sqrt(gram[row, i, i])
        left[row] = total
        is_rounded |= _ROUNDING * size**2 > _NEGLIGIBLE * max(total, 0.0)
    return left, is_rounded


@njit(cache=True)
def bounded_least_squares(
    gram: np.ndarray, right: np.ndarray, lowest: np.ndarray, highest: np.ndarray
) -> np.ndarray:
    """Least squares with parameters between their bounds: what would be beyond is held there.

    Args:
        gram, right: normal equations, (P, P) and (P,), of columns of about the same length.
        lowest, highest: the bounds, (P,) each.

    Returns:
        Parameters (P,); those of least norm where columns are collinear.
    """
    theta, free = np.zeros(len(right)), np.arange(len(right))
    is_free = np.ones(len(right), dtype=np.bool_)
    while len(free) > 0:
        products, rest = np.empty((len(free), len(free))), np.empty(len(free))
        for i in range(len(free)):
            rest[i] = right[free[i]]
            for j in range(len(right)):
                if not is_free[j]:
                    rest[i] -= gram[free[i], j] * theta[j]
            for j in range(len(free)):
                products[i, j] = gram[free[i], free[j]]
        theta[free] = _least_squares(products, rest)
        for k in free:
            bound = min(max(theta[k], lowest[k]), highest[k])
            if bound != theta[k]:
                theta[k], is_free[k] = bound, False
        still = np.flatnonzero(is_free)
        if len(still) == len(free):
            break
        free = still
    return theta


@njit(cache=True)
def _least_squares(gram: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution of the normal equations; that of least norm if columns are collinear."""
    size, U, theta = len(right), gram.copy(), right.copy()
    least, largest = np.inf, 0.0
    for k in range(size):
        # Cholesky's factor U, gram = U^T U, row by row, and U^-T right.
        if not U[k, k] > 0.0:
            least = 0.0
            break
        pivot = np.sqrt(U[k, k])
        least, largest = min(least, pivot), max(largest, pivot)
        U[k, k:] /= pivot
        theta[k] /= pivot
        for i in range(k + 1, size):
            theta[i] -= U[k, i] * theta[k]
            for j in range(i, size):
                U[i, j] -= U[k, i] * U[k, j]
    if not least > _COLLINEAR * largest:
        return np.linalg.lstsq(gram, right, _SINGULAR)[0]
    for k in range(size - 1, -1, -1):
        for j in range(k + 1, size):
            theta[k] -= U[k, j] * theta[j]
        theta[k] /= U[k, k]
    return theta
