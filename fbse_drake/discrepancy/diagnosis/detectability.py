"""What a log would have shown: the smallest size of an effect that is found, and how well two
effects are told apart."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fbse_drake.discrepancy.diagnosis.explanation import Explanation
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.grid_sets import grid_gain
from fbse_drake.discrepancy.identification.normal_equations import bounded_least_squares
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.joint_torque import JointTorqueEffect

# A size that is this many times the largest plausible one is none.
_HOPELESS = 1e3


def smallest_detectable(fits: Fits, base: Explanation, effect: type[Effect]) -> dict[str, float]:
    """Size of an effect's first parameter that would have been found beside an explanation, by
    target; infinite where none would. Where the explanation has the effect itself: beside the rest
    of it.

    The size at which the effect's sum of squares reaches what its parameters must bring and cost,
    in a joint whatever its others are: a spring may be slack where the joint is.
    """
    sizes = _sizes_that_reach(fits, base, effect)
    for found in (c for c in base.candidates if c.effect is effect):
        others = fits.explain([c for c in base.candidates if c is not found])
        # The noise is what the whole leaves.
        beside_others = _sizes_that_reach(fits, replace(others, sse=base.sse), effect)
        sizes |= {target: beside_others[target] for target in found.targets}
    return {
        target: size
        if size < _HOPELESS * fits.dictionary.largest_plausible(effect, target)
        else np.inf
        for target, size in sizes.items()
    }


def _sizes_that_reach(fits: Fits, base: Explanation, effect: type[Effect]) -> dict[str, float]:
    beside = fits.remainder(base)
    result = {}
    if not issubclass(effect, JointTorqueEffect):
        for candidate in (c for c in fits.fixed_candidates if c.effect is effect):
            s = candidate.signature
            # What is noise in its columns shows nothing.
            noise = np.broadcast_to(candidate.noise_power, s.values.shape[1:])[:, 0]
            power = sum(
                (gram[0, 0] - of_noise) / beside.scale[row]
                for row, of_noise, (gram, _) in zip(s.rows, noise, beside.moments(s), strict=True)
            )
            result[candidate.targets[0]] = float(
                np.sqrt(
                    (fits.needed(s.parameters) + fits.systematic(s.rows) + candidate.spurious)
                    / max(power, 1e-30)
                )
            )
        return result
    if not fits.dictionary.groups_of(effect):
        # It is not looked for.
        return {}
    grid = fits.grid(effect)
    has_linear = any(parameter.linear for parameter in effect.parameters.values())
    for row, joint in enumerate(fits.dictionary.joints):
        here = grid.points[..., row]
        usual = (
            int(
                np.abs(np.log(here / fits.dictionary.usual_at(effect, joint)[:, None]))
                .sum(axis=0)
                .argmin()
            )
            if len(here)
            else 0
        )
        rows = fits.dictionary.rows_of(effect, [joint])
        needed = fits.needed(len(effect.parameters)) + fits.systematic(rows)
        grams = {at: beside.moments_of_grid(grid.sets[at])[0] for at in rows.tolist()}
        whole = sum(gram / beside.scale[at] for at, gram in grams.items())
        if not fits.dictionary.is_shown(effect, joint) or not np.all(
            effect.shows_within(
                fits.dictionary.travel[row], fits.dictionary.usual_at(effect, joint)
            )
        ):
            result[joint] = np.inf
        elif has_linear:
            bounds = [p.bounds[0] for p in effect.parameters.values() if p.linear]
            power = least_power(whole[usual], np.array(bounds[1:]))
            result[joint] = float(np.sqrt(needed / max(power, 1e-30)))
        else:
            # Sizes in the order of the grid, from weak to strong.
            power = whole[:, 0, 0]
            strong = power > needed
            order = np.argsort(power)
            enough = np.flatnonzero(strong[order])
            result[joint] = (
                _crossing(here[0][order], power[order], needed) if len(enough) else np.inf
            )
    return result


def least_power(gram: np.ndarray, lowest: np.ndarray) -> float:
    """Sum of squares of a column and the least favourable amounts of others.

    Args:
        gram: inner products of the column and the others, (p, p).
        lowest: amounts of the others, (p - 1,).
    """
    others = bounded_least_squares(gram[1:, 1:], -gram[1:, 0], lowest, np.full(len(lowest), np.inf))
    return float(gram[0, 0] + 2 * gram[0, 1:] @ others + others @ gram[1:, 1:] @ others)


def separation(
    fits: Fits,
    effect: type[Effect],
    targets: Sequence[str],
    values: Mapping[str, float],
    rival: type[Effect],
) -> float:
    """How much of what an effect would do here a rival could not mimic: a sum of squares in units
    of noise.

    Args:
        values: of the effect's parameters.
    """
    signal = np.zeros_like(fits.white.y)
    names = effect.parameters
    nonlinear = np.array(
        [values[name] for name, parameter in names.items() if not parameter.linear]
    )
    amounts = np.array(
        [values[name] for name, parameter in names.items() if parameter.linear] or [1.0]
    )
    for target in targets:
        raw = fits.dictionary.predictor.signature(effect, target, nonlinear)
        whitened = fits.white.whiten_signature(raw)
        signal[:, whitened.rows] += whitened.values @ amounts
    total = float((signal**2).sum())
    if issubclass(rival, JointTorqueEffect):
        grid = fits.grid(rival)
        for joint in (joint for joint in fits.dictionary.joints if joint in targets):
            rows = fits.dictionary.rows_of(rival, [joint]).tolist()
            if signal[:, rows].any():
                sets = [grid.sets[row] for row in rows]
                rights = [s.times(signal[:, [s.row]]).reshape(s.gram.shape[:2]) for s in sets]
                parameters = fits.dictionary.parameters(rival, joint)
                gain = grid_gain(
                    parameters, np.sum([s.gram for s in sets], axis=0), np.sum(rights, axis=0)
                )
                total -= float(gain.max())
        return total
    gains = []
    for s in (c.signature for c in fits.fixed_candidates if c.effect is rival):
        # What it adds whatever its parameters are has none to be fitted.
        size, apart = s.parameters, signal[:, s.rows] - s.offset
        right = np.einsum("brp,br->p", s.values, apart)
        gram = fits.regression.products(s, s)[2].sum(axis=0)[:size, :size]
        fitted = float(right @ np.linalg.lstsq(gram, right, rcond=1e-10)[0])
        gains.append(fitted + float((signal[:, s.rows] ** 2).sum() - (apart**2).sum()))
    return total - max(gains, default=0.0)


def _crossing(sizes: np.ndarray, power: np.ndarray, needed: float) -> float:
    """Size at which increasing power reaches what is needed, interpolated in logarithms."""
    first = int(np.argmax(power > needed))
    if first == 0:
        # Small effects grow in proportion to their size; a limit is the weaker the larger it is.
        return (
            float(sizes[0] * np.sqrt(needed / power[0]))
            if sizes[0] < sizes[-1]
            else float(sizes[0])
        )
    low, high = np.log(np.maximum(power[first - 1 : first + 1], 1e-30))
    share = (np.log(needed) - low) / (high - low)
    return float(np.exp((1 - share) * np.log(sizes[first - 1]) + share * np.log(sizes[first])))
