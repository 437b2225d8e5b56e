"""Fits by inner products are those of plain least squares, and columns meet the data once."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from fbse_drake.discrepancy.diagnosis.grid_sets import GridSets
from fbse_drake.discrepancy.diagnosis.remainder import Remainder
from fbse_drake.discrepancy.identification import regression
from fbse_drake.discrepancy.identification.regression import (
    FOLDS,
    Regression,
    Signature,
    Spread,
    WhitenedResidual,
)
from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.discrepancy.residual.rows import Row

ROWS = 3


def white_of(values: np.ndarray) -> WhitenedResidual:
    """A residual (B, R) of unit noise."""
    one = np.ones_like(values)
    rows = [Row(f"joint_{k}", "joint", "Nm") for k in range(values.shape[1])]
    time = 0.01 * np.arange(len(values))
    return WhitenedResidual(
        Residual(rows, time, values, one > 0, one, 0 * one, one[:, :1] > 0, signals=None)
    )


def some_signatures(rng: np.random.Generator, blocks: int) -> list[Signature]:
    """In single rows and in all, with and without an offset, a belief and bounds; of very
    different units."""
    return [
        Signature(np.array([0]), 1e-4 * rng.normal(size=(blocks, 1, 2))),
        Signature(np.array([1]), rng.normal(size=(blocks, 1, 1)), rng.normal(size=(blocks, 1))),
        Signature(
            np.arange(ROWS),
            1e3 * rng.normal(size=(blocks, ROWS, 2)),
            prior=np.array([1e9, 0.0]),
            expected=np.array([2.0, 0.0]),
        ),
        Signature(np.array([2]), rng.normal(size=(blocks, 1, 1)), lowest=np.array([0.5])),
        Signature(
            np.array([2]),
            rng.normal(size=(blocks, 1, 2)),
            lowest=np.array([-np.inf, -9.0]),
            highest=np.array([-7.0, 9.0]),
        ),
    ]


def test_a_belief_in_what_does_not_show_leaves_the_rest_as_it_is() -> None:
    """A column far below rounding, as the slope of a jump that no sample meets, and what is
    believed of it in its own unit."""
    rng = np.random.default_rng(8)
    x = rng.normal(size=(400, 1, 2))
    white = white_of(3.0 * x[:, :, 0] + rng.normal(size=(400, 1)))
    x[:, :, 1] *= 1e-25
    both = Signature(np.array([0]), x, prior=np.array([0.0, 1e8]))
    alone = Signature(np.array([0]), x[:, :, :1])
    found, expected = (Regression(white).fit([s]).parameters[0] for s in (both, alone))
    assert expected == pytest.approx(3.0, abs=0.3)
    assert found == pytest.approx(expected, rel=1e-9)


def test_normal_equations_are_those_of_the_columns_in_the_order_that_is_asked_for() -> None:
    """Of rows with weights of their own, less the offset; whatever was fitted first, and if not all
    were."""
    rng = np.random.default_rng(11)
    white, signatures = white_of(rng.normal(size=(200, ROWS))), some_signatures(rng, 200)
    fits, scale = Regression(white), np.array([1.0, 4.0, 0.25])
    fits.fit([signatures[k] for k in (3, 0, 2)])
    asked = [signatures[k] for k in (2, 1, 3, 0)]
    X, y, start = np.zeros((200, ROWS, 6)), white.y.copy(), 0
    for s in asked:
        stop = start + s.values.shape[2]
        X[:, s.rows, start:stop] = s.values
        y[:, s.rows] -= s.offset
        start = stop
    gram, right = fits.normal_equations(asked, scale)
    size = np.sqrt(np.einsum("brp,brp->p", X, X))
    unit = np.outer(size, size)
    assert gram / unit == pytest.approx(np.einsum("brp,brq,r->pq", X, X, 1 / scale) / unit)
    assert right / size == pytest.approx(np.einsum("brp,br,r->p", X, y, 1 / scale) / size)


def test_what_is_believed_needs_no_stretches_to_be_known() -> None:
    """Two columns that are one, of which the log shows the sum, in two of many stretches of time;
    one parameter is known beforehand. How sure the other is follows from that alone, and its
    intervals hold the truth as often as they say."""
    rng, known, held, halves = np.random.default_rng(4), 0.3, 0, []
    x = np.zeros((1000, 1, 1))
    x[100:110], x[700:710] = 40.0, -40.0
    for _ in range(300):
        truth = np.array([2.0, known * rng.normal()])
        white = white_of(x[:, :, 0] * truth.sum() + rng.normal(size=(1000, 1)))
        both = Signature(np.array([0]), np.repeat(x, 2, axis=2), prior=np.array([0.0, known**-2]))
        low, high = Regression(white).fit([both]).interval()[0]
        held += low < truth[0] < high
        halves.append(0.5 * (high - low))
    assert np.median(halves) == pytest.approx(1.96 * known, rel=0.02)
    assert 0.92 < held / 300 < 0.98


def test_a_signature_that_shows_in_no_row_is_whitened_like_others() -> None:
    white = white_of(np.ones((20, 2)))
    nowhere = Signature(np.array([], dtype=int), np.zeros((20, 0, 3)), np.zeros((20, 0)))
    whitened = white.whiten_signature(nowhere)
    assert whitened.values.shape == (20, 0, 3)
    assert whitened.offset.shape == (20, 0)


def plain_least_squares(
    white: WhitenedResidual, signatures: Sequence[Signature], held_out: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and what is left (B, R), from the columns one below the other; rows are weighted
    as `Regression` says."""
    size = sum(s.values.shape[2] for s in signatures)
    X, y = np.zeros((*white.y.shape, size)), white.y.copy()
    prior, expected, start = np.zeros(size), np.zeros(size), 0
    lowest, highest = np.full(size, -np.inf), np.full(size, np.inf)
    for s in signatures:
        part = slice(start, start + s.values.shape[2])
        X[:, s.rows, part], prior[part], expected[part] = s.values, s.prior, s.expected
        lowest[part], highest[part] = s.lowest, s.highest
        y[:, s.rows] -= s.offset
        start = part.stop

    def solved(blocks: np.ndarray, scale: np.ndarray) -> np.ndarray:
        weight = 1.0 / np.sqrt(scale)
        A = (X[blocks] * weight[:, None]).reshape(-1, size)
        b = (y[blocks] * weight).ravel()
        believed = np.sqrt(prior)
        A, b = np.concatenate([A, np.diag(believed)]), np.concatenate([b, believed * expected])
        norm = np.linalg.norm(A, axis=0)
        bounds = lowest * norm, highest * norm
        return lsq_linear(A / norm, b, bounds, method="bvls", tol=1e-15).x / norm

    every = np.ones(len(y), dtype=bool)
    scale = np.ones(ROWS)
    for _ in range(3):
        left = y - X @ solved(every, scale)
        scale = np.maximum((left**2).sum(axis=0) / white.count, 1.0)
    theta = solved(every if held_out is None else white.fold != held_out, scale)
    return theta, y - X @ theta


@pytest.mark.parametrize("noise", [1.0, 1e-6])
def test_fits_by_inner_products_are_those_of_plain_least_squares(noise: float) -> None:
    """Also where a residual of some thousands of noises is explained to the last millionth: squares
    must not cancel."""
    rng = np.random.default_rng(4)
    signatures = some_signatures(rng, 500)
    values = noise * rng.normal(size=(500, ROWS))
    for s in signatures:
        amounts = rng.normal(size=s.values.shape[2]) / np.abs(s.values).mean()
        values[:, s.rows] += 3e3 * s.values @ amounts + s.offset
    white = white_of(values)
    fit = Regression(white).fit(signatures)
    theta, left = plain_least_squares(white, signatures)
    np.testing.assert_allclose(fit.parameters, theta, rtol=1e-7)
    np.testing.assert_allclose(fit.sse, (left**2).sum(axis=0), rtol=1e-6)
    held_out = np.zeros(ROWS)
    for fold in range(FOLDS):
        _, left = plain_least_squares(white, signatures, fold)
        held_out += (left[white.fold == fold] ** 2).sum(axis=0)
    np.testing.assert_allclose(fit.held_out_sse, held_out, rtol=1e-6)


def test_what_is_expected_decides_what_the_data_do_not() -> None:
    """Of two columns that are one the data tell the sum, 3; that of an amount which is believed to
    be 5 within 0.1 is left to the other, however sure it is of nothing."""
    rng = np.random.default_rng(8)
    one = rng.normal(size=(400, 1, 1))
    white = white_of(3.0 * one[:, :, 0] + 0.1 * rng.normal(size=(400, 1)))
    columns, prior = np.concatenate([one, one], axis=2), np.array([0.01, 1.0]) / 0.1**2
    signature = Signature(np.array([0]), columns, prior=prior, expected=np.array([0.0, 5.0]))
    fit = Regression(white).fit([signature])
    assert fit.parameters.sum() == pytest.approx(3.0, abs=0.1)
    # The sum is 2 too small, of which the surer one takes a hundredth.
    assert fit.parameters[1] == pytest.approx(5.0 - 2.0 / 101, abs=0.01)


def test_what_is_known_of_others_makes_surer() -> None:
    """Deviations of a normal distribution given some of its variables: those of the rest in the
    inverse of the covariance (the information)."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(5, 5)) * np.array([[1e3], [1.0], [1e-3], [1.0], [1e5]])
    covariance = root @ root.T
    deviation = np.sqrt(np.diag(covariance))
    spread = Spread(deviation, np.full(5, 9.0), covariance)
    # Of the last four variables, whatever the first is.
    correlation = (covariance / np.outer(deviation, deviation))[1:, 1:]
    given = np.linalg.inv(np.linalg.inv(correlation)[:2, :2])
    share = spread.if_known(slice(3, 5), slice(1, 3))
    np.testing.assert_allclose(share, np.sqrt(np.diag(given)), rtol=1e-6)
    assert np.all(share < 1.0)
    assert np.all(spread.if_known(slice(3, 3), slice(1, 3)) == 1.0)


def test_what_keeps_a_fit_near_makes_nobody_surer() -> None:
    """Of two columns that are nearly one the data tell the sum. A step that is kept small says
    nothing of the difference; a belief does."""
    rng = np.random.default_rng(8)
    one = rng.normal(size=(400, 1, 1))
    columns = np.concatenate([one, one + 1e-4 * rng.normal(size=one.shape)], axis=2)
    white = white_of(0.1 * rng.normal(size=(400, 1)) + 2.0 * one[:, :, 0])
    weak, strong = np.full(2, 1.0), np.full(2, 1e4)
    free, kept, sure = (
        Regression(white).fit([Signature(np.array([0]), columns, prior=prior, steadying=steadying)])
        for prior, steadying in ((weak, 0 * weak), (weak, strong), (strong, 0 * weak))
    )
    assert np.abs(kept.parameters).max() < 0.2
    assert free.parameters.sum() == pytest.approx(2.0, abs=0.02)
    np.testing.assert_allclose(kept.deviation, free.deviation, rtol=0.5)
    assert np.all(sure.deviation < 0.1 * free.deviation)


@pytest.mark.parametrize(("tied", "across"), [(False, False), (True, True), (False, True)])
def test_what_is_left_for_new_columns_is_that_of_a_wider_fit(tied: bool, across: bool) -> None:
    """Also beside columns that are in several rows: in one of them alone they would take all."""
    rng = np.random.default_rng(5)
    known = [Signature(np.array([row]), rng.normal(size=(400, 1, 2))) for row in range(ROWS)]
    if across:
        known = [Signature(np.arange(ROWS), rng.normal(size=(400, ROWS, 4)))]
    new = Signature(np.array([1]), rng.normal(size=(400, 1, 2)) + known[0].values[:, -1:, :2])
    white = white_of(rng.normal(size=(400, ROWS)) + known[0].values.sum(axis=(1, 2))[:, None])
    found = Regression(white)
    base = found.fit(known)
    scale = np.ones(ROWS)
    beside = Remainder(found, tuple(known), base.parameters, scale, tied=tied)
    gram, right = beside.moments(new)[0]

    def columns(signatures: Sequence[Signature]) -> np.ndarray:
        parts = []
        for s in signatures:
            full = np.zeros((400, ROWS, s.values.shape[2]))
            full[:, s.rows] = s.values
            parts.append(full.reshape(-1, full.shape[2]))
        return np.concatenate(parts, axis=1)

    Q, _ = np.linalg.qr(columns(known))
    own, y = columns([new]), white.y.ravel()
    own, y = (values - Q @ (Q.T @ values) for values in (own, y))
    np.testing.assert_allclose(gram, own.T @ own, rtol=1e-9)
    np.testing.assert_allclose(right, own.T @ y, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("tied", [False, True])
def test_what_a_bound_holds_back_is_what_a_fit_without_it_takes_off_more(tied: bool) -> None:
    rng = np.random.default_rng(8)
    columns = rng.normal(size=(400, 1, 2))
    values = rng.normal(size=(400, ROWS))
    values[:, 0] += columns[:, 0] @ [-3.0, 2.0]
    white = white_of(values)
    found = Regression(white)
    bounded = Signature(np.array([0]), columns, lowest=np.array([0.0, -np.inf]))
    held, free = (found.fit([s]) for s in (bounded, Signature(np.array([0]), columns)))
    beside = Remainder(found, (bounded,), held.parameters, np.ones(ROWS), tied=tied)
    taken = held.sse[0] - free.sse[0]
    assert taken > 1000
    assert beside.beside(0).held_back == pytest.approx(taken, rel=1e-9)
    assert beside.beside(1).held_back == 0.0


@pytest.mark.parametrize("tied", [False, True])
def test_columns_that_stay_as_they_are_leave_what_their_whitened_copies_leave(tied: bool) -> None:
    """With differenced noise, other in every block, and gaps."""
    rng, blocks = np.random.default_rng(7), 300
    known, variance = rng.random((blocks, ROWS)) > 0.2, 1.0 + rng.random((blocks, ROWS))
    white = WhitenedResidual(
        replace(
            white_of(rng.normal(size=(blocks, ROWS))).residual,
            known=known,
            variance=variance,
            covariance=-0.49 * np.sqrt(variance * np.roll(variance, -1, axis=0)),
        )
    )
    columns = rng.normal(size=(blocks, 2, 5))
    grid = GridSets(white, 1, columns)
    by_set = np.swapaxes(columns, 1, 2).reshape(blocks, 1, -1)
    copies = white.whiten_signature(Signature(np.array([1]), by_set))
    signatures = tuple(map(white.whiten_signature, some_signatures(rng, blocks)))
    found = Regression(white)
    parameters = found.fit(signatures).parameters
    beside = Remainder(found, signatures, parameters, np.ones(ROWS), tied=tied)
    for of_grid, of_copies in zip(
        beside.moments_of_grid(grid), beside.moments_of_sets(copies, 0, grid.gram), strict=True
    ):
        np.testing.assert_allclose(of_grid, of_copies, rtol=1e-9, atol=1e-9)
    flat = copies.values[:, 0]
    np.testing.assert_allclose(grid.right, flat.T @ white.y[:, 1], rtol=0, atol=1e-9)
    together = (flat.T @ flat).reshape(5, 2, 5, 2)
    np.testing.assert_allclose(grid.gram, np.einsum("gpgq->gpq", together), rtol=1e-9, atol=1e-9)


def test_columns_meet_the_data_once_and_twice_as_long_a_log_costs_twice_as_much(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numbers that are read from columns are counted, in a search of fits that share members."""
    read = 0
    original = regression.columns_of

    def counted(signature: Signature) -> np.ndarray:
        nonlocal read
        read += signature.values.size
        return original(signature)

    monkeypatch.setattr(regression, "columns_of", counted)
    rng = np.random.default_rng(6)
    counts = []
    for blocks in (500, 1000):
        signatures = some_signatures(rng, blocks)
        found = Regression(white_of(rng.normal(size=(blocks, ROWS))))
        read = 0
        found.fit(signatures)
        counts.append(read)
        assert read == sum(s.values.size for s in signatures)
        for left_out in signatures:
            found.fit([s for s in signatures if s is not left_out])
        assert read == counts[-1]
    assert counts[1] <= 2.0 * counts[0]


def test_what_was_not_asked_for_the_longest_is_forgotten() -> None:
    memory: Memory[np.ndarray] = Memory(10, np.size)
    memory["a"], memory["b"] = np.zeros(4), np.zeros(4)
    assert memory["a"].size == 4
    memory["c"] = np.zeros(4)
    assert "b" not in memory
    assert "a" in memory
    assert "c" in memory
    memory["large"] = np.zeros(20)
    assert "large" in memory
    assert "c" not in memory
    assert memory.or_made("large", lambda: np.zeros(1)).size == 20
