"""What no effect of the library explains: is anything left in a residual, where, and which variable
does it live in?"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.identification.rounding import (
    DOUBTFUL,
    chance_bound,
    noise_of_rounding,
)
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion

# Averages of a row from which on something is told of what is left in it; and from which on a test
# that does not see that the averages are correlated says that it is noise: correlations of 0.2 at
# the lags that are looked at pass for chance in a hundred of them.
_FEWEST, _TELLING = 50, 200
# Pieces of a piecewise linear function of one variable.
_PIECES = 8
# A row whose held-out residual exceeds the sensors' noise by more than this factor has something
# left.
EXCESS = 1.2
# What tells nothing of what comes later passes for noise up to so many times what is tolerated.
_LOUD = 3.0
# Drop of the held-out deviance at which a smooth function of several variables counts as found,
# beside what is doubted about known laws.
_DROP = 25.0
# How many times as large as it was taken the doubt about known laws may be.
_DOUBT = 3.0
# Of which later averages what is left may tell something: not of the next one, with which noise is
# correlated if there is more or less of it white than believed, and less or more differenced. And
# how often noise seems to.
_LAGS, _FALSE_ALARM = np.arange(2, 7), 1e-3
# A foot's impact tells of itself alone: what is left counts up to so many of its usual deviations,
# which are had from the median of their sizes.
_LARGEST, _NORMAL_MEDIAN = 3.0, 0.6745
# Kinematic rows show the slightest give of the ground: they must exceed the noise by this.
_KINEMATIC_EXCESS = 3.0


@dataclass(frozen=True)
class Structure:
    """What is left in one row."""

    row: str
    # Place of the row.
    index: int
    # Root mean square of what is left, in multiples of the sensors' noise.
    ratio: float
    # Variable that explains most of it: position, velocity, load, acceleration, time or phase; and
    # the share that it explains.
    variable: str
    share: float


def leftover_structure(
    motion: RecordedMotion, white: WhitenedResidual, left: np.ndarray
) -> list[Structure]:
    """Rows in which more than noise is left: it lives in variables that were measured, or it is
    more than the sensors' noise and tells of what comes later.

    What does neither is noise all the same, of feet's impacts or of what happens between rare
    samples.

    Args:
        white: the residual by which it is measured.
        left: what is left of it, (B, R).
    """
    result = []
    size = np.sqrt((left**2).sum(axis=0) / np.maximum(white.count, 1))
    if motion.robot.has_floating_base:
        left = _without_impacts(left, white.residual.known)
    for k, row in enumerate(white.residual.rows):
        if white.count[k] < _FEWEST:
            continue
        ratio = float(size[k])
        usual = np.sqrt((left[:, k] ** 2).sum() / white.count[k])
        variables = _variables(motion, white, k)
        if row.kind == "kinematic":
            if ratio < _KINEMATIC_EXCESS:
                continue
        else:
            everything = np.concatenate(list(variables.values()), axis=1)
            is_noise = usual < tolerated(white, k) or is_white(left[:, k], int(white.count[k]))
            if is_noise:
                drop = _drop(white, left, k, everything)
                if drop < _DROP + _DOUBT * white.doubt[k]:
                    continue
                if drop < DOUBTFUL * _DROP and drop < _feigned(motion, white, k, everything):
                    continue
        excess = max(usual**2 - 1.0, 1e-3) * white.count[k]
        shares = {
            name: _explained(white, left, k, basis) / excess for name, basis in variables.items()
        }
        best = max(shares, key=lambda name: shares[name])
        result.append(Structure(row.name, k, ratio, best, float(np.clip(shares[best], 0.0, 1.0))))
    return result


def untested_rows(
    motion: RecordedMotion,
    white: WhitenedResidual,
    left: np.ndarray,
    structures: Sequence[Structure],
) -> tuple[str, ...]:
    """Rows in which more is left than noise, but in too few averages to tell it from noise.

    Soles are not asked: feet stand for a short time.

    Args:
        white, left: see `leftover_structure`.
        structures: what that found.
    """
    louder = _louder_thantolerated(motion, white, left, structures)
    return tuple(white.residual.rows[k].name for k in louder if white.count[k] < _TELLING)


def noisy_rows(
    motion: RecordedMotion,
    white: WhitenedResidual,
    left: np.ndarray,
    structures: Sequence[Structure],
) -> list[int]:
    """Places of rows in which far more is left than the sensors' noise, although it tells nothing:
    noise that nobody told of, or impacts, as in a gear with backlash.

    Feet's own impacts do not count, nor do soles, which give.

    Args:
        white, left: see `leftover_structure`.
        structures: what that found.
    """
    louder = _louder_thantolerated(motion, white, left, structures)
    return [k for k, times in louder.items() if times > _LOUD and white.count[k] >= _FEWEST]


def _louder_thantolerated(
    motion: RecordedMotion,
    white: WhitenedResidual,
    left: np.ndarray,
    structures: Sequence[Structure],
) -> dict[int, float]:
    """By place of a row in which no structure was found, soles left out: how many times what is
    tolerated is left there, but for feet's impacts, where that is more than once."""
    if motion.robot.has_floating_base:
        left = _without_impacts(left, white.residual.known)
    told = {structure.index for structure in structures}
    result = {}
    for k, row in enumerate(white.residual.rows):
        if row.kind == "kinematic" or k in told or not white.count[k]:
            continue
        times = np.sqrt((left[:, k] ** 2).sum() / white.count[k]) / tolerated(white, k)
        if times > 1.0:
            result[k] = float(times)
    return result


def tolerated(white: WhitenedResidual, row: int) -> float:
    """Root mean square of what may be left in a row, in multiples of the sensors' noise."""
    return float(np.sqrt(EXCESS**2 + _DOUBT * white.doubt[row] / white.count[row]))


def _without_impacts(left: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What is left, (B, R), as far as it counts."""
    usual = [
        np.median(np.abs(row[of])) if of.any() else 0.0
        for row, of in zip(left.T, known.T, strict=True)
    ]
    largest = _LARGEST * np.maximum(np.array(usual) / _NORMAL_MEDIAN, 1.0)
    return np.clip(left, -largest, largest)


def is_white(left: np.ndarray, count: int) -> bool:
    """Does what is left of a row (B,) tell nothing of what comes later? (G. M. Ljung and G. E. P.
    Box, "On a measure of lack of fit in time series models", Biometrika 65, 1978.)

    Args:
        count: how many of the averages are known; the others are 0.
    """
    correlation = np.array([left[lag:] @ left[:-lag] for lag in _LAGS]) / (left @ left)
    told = count * (count + 2) * (correlation**2 / (count - _LAGS)).sum()
    return bool(told < chi2.isf(_FALSE_ALARM, len(_LAGS)))


def _variables(motion: RecordedMotion, white: WhitenedResidual, row: int) -> dict[str, np.ndarray]:
    """Piecewise linear functions of the variables that a row's residual may live in, (B, pieces)
    each."""
    blocks, n = motion.quiet_blocks, len(motion.robot.joint_names)
    result = {"time": hat_functions(motion.time)}

    def without_own_noise(values: np.ndarray) -> np.ndarray:
        # The noise of a block is in its residual too: its neighbours beyond the next ones tell what
        # was measured without it.
        padded = np.concatenate([values[:1]] * 3 + [values] + [values[-1:]] * 3)
        n = len(values)
        return 0.25 * (padded[:n] + padded[1 : n + 1] + padded[5 : n + 5] + padded[6 : n + 6])

    if joint := white.residual.rows[row].joint:
        own = white.residual.row_index[joint]
        velocity = without_own_noise(blocks.joint_velocity[:, own])
        result["position"] = hat_functions(blocks.joint_position[:, own])
        # Fine near standstill, coarse elsewhere.
        result["velocity"] = hat_functions(np.arcsinh(velocity / 0.02))
        result["load"] = hat_functions(without_own_noise(blocks.torque_command[:, own]))
        result["acceleration"] = hat_functions(
            np.arcsinh(without_own_noise(blocks.joint_acceleration[:, own]))
        )
        others = [j for j in range(n) if j != own]
        result["other joints' torque"] = blocks.torque_command[:, others]
    else:
        result["angular velocity"] = without_own_noise(blocks.angular_velocity)
        result["specific force"] = without_own_noise(blocks.specific_force)
    result["phase"] = white.residual.standing.astype(float)
    return result


def hat_functions(x: np.ndarray) -> np.ndarray:
    """Piecewise linear functions with knots at the quantiles of x, (B, pieces); they sum to one."""
    knots = np.unique(np.quantile(x, np.linspace(0, 1, _PIECES + 1)))
    if len(knots) < 2:
        return np.ones((len(x), 1))
    return np.stack([np.interp(x, knots, np.eye(len(knots))[k]) for k in range(len(knots))], axis=1)


def _fit(
    white: WhitenedResidual, left: np.ndarray, row: int, basis: np.ndarray
) -> tuple[float, float]:
    """Sums of squares of a row on held-out data, without and with a smooth function."""
    X = white.whiten(row, basis)
    X = X[:, np.abs(X).max(axis=0) > 0]
    y = left[:, row]
    parts = [(X[white.fold == fold], y[white.fold == fold]) for fold in range(white.fold.max() + 1)]
    grams, rights = [A.T @ A for A, _ in parts], [A.T @ b for A, b in parts]
    gram, right = sum(grams), sum(rights)
    ridge = 1e-3 * np.diag(np.diag(gram))
    left_over = [
        b - A @ np.linalg.solve(gram - G + ridge, right - r)
        for (A, b), G, r in zip(parts, grams, rights, strict=True)
    ]
    held_out = np.concatenate(left_over)
    return float((y**2).sum()), float((held_out**2).sum())


def _drop(white: WhitenedResidual, left: np.ndarray, row: int, basis: np.ndarray) -> float:
    count = white.count[row]
    before, after = (max(sse / count, 1e-9) for sse in _fit(white, left, row, basis))
    return float(
        count
        * (
            np.log(max(before, 1))
            + before / max(before, 1)
            - np.log(max(after, 1))
            - after / max(after, 1)
        )
    )


def _feigned(motion: RecordedMotion, white: WhitenedResidual, row: int, basis: np.ndarray) -> float:
    """What rounded angles make the deviance drop by a smooth function, see `rounding`; 0 where
    angles are not rounded."""
    draws = noise_of_rounding(motion, white)
    drops = np.array([_drop(white, draw, row, basis) for draw in draws])
    return chance_bound(drops, _FALSE_ALARM / draws.shape[2]) if len(drops) else 0.0


def _explained(white: WhitenedResidual, left: np.ndarray, row: int, basis: np.ndarray) -> float:
    before, after = _fit(white, left, row, basis)
    return before - after
