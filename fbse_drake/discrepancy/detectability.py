"""What a log would have shown: the smallest size of an effect that is found, and how well two effects are told apart."""

from collections.abc import Mapping, Sequence

import numpy as np

from fbse_drake.discrepancy.explanation import Explanation
from fbse_drake.discrepancy.fits import Fits, project
from fbse_drake.discrepancy.proposals import fixed_gain, grid_gain, row_moments
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.joint_torque import JointTorqueEffect

# A size that is this many times the largest plausible one is none.
_HOPELESS = 1e3


def smallest_detectable(fits: Fits, base: Explanation, effect: type[Effect]) -> dict[str, float]:
    """Size of an effect's first parameter that would have been found beside an explanation, by target; infinite where none would.

    The size at which the effect's sum of squares reaches what its parameters must bring and cost.
    """
    sizes = _sizes_that_reach(fits, base, effect)
    return {
        target: size
        if size < _HOPELESS * fits.dictionary.largest_plausible(effect, target)
        else np.inf
        for target, size in sizes.items()
    }


def _sizes_that_reach(fits: Fits, base: Explanation, effect: type[Effect]) -> dict[str, float]:
    _, projection = fits.room(base)
    scale = fits.white.scale(base.sse)
    result = {}
    if not issubclass(effect, JointTorqueEffect):
        for candidate in (c for c in fits.fixed_candidates if c.effect is effect):
            s = candidate.signature
            power = sum(
                (project(s.values[:, k, :1], projection.get(row)) ** 2).sum() / scale[row]
                for k, row in enumerate(s.rows)
            )
            result[candidate.targets[0]] = float(
                np.sqrt(
                    (fits.needed(s.values.shape[2]) + fits.systematic(s.rows) + candidate.spurious)
                    / max(power, 1e-30)
                )
            )
        return result
    points, columns = fits.grid(effect)
    has_linear = any(parameter.linear for parameter in effect.parameters.values())
    for row, joint in enumerate(fits.dictionary.joints):
        here = points[..., row]
        usual = (
            int(
                np.abs(np.log(here / fits.dictionary.usual_at(effect, joint)[:, None]))
                .sum(axis=0)
                .argmin()
            )
            if len(here)
            else 0
        )
        needed = fits.needed(len(effect.parameters)) + fits.systematic(np.array([row]))
        first = columns[row][:, 0]
        power = (project(first, projection.get(row)) ** 2).sum(axis=0) / scale[row]
        if not np.all(
            effect.shows_within(
                fits.dictionary.travel[row], fits.dictionary.usual_at(effect, joint)
            )
        ):
            result[joint] = np.inf
        elif has_linear:
            result[joint] = float(np.sqrt(needed / max(power[usual], 1e-30)))
        else:
            # Sizes in the order of the grid, from weak to strong.
            strong = power > needed
            order = np.argsort(power)
            enough = np.flatnonzero(strong[order])
            result[joint] = (
                _crossing(here[0][order], power[order], needed) if len(enough) else np.inf
            )
    return result


def separation(
    fits: Fits,
    effect: type[Effect],
    targets: Sequence[str],
    values: Mapping[str, float],
    rival: type[Effect],
) -> float:
    """How much of what an effect would do here a rival could not mimic: a sum of squares in units of noise.

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
    scale = np.ones(signal.shape[1])
    if issubclass(rival, JointTorqueEffect):
        left = 0.0
        columns = fits.grid(rival)[1]
        for row, joint in enumerate(fits.dictionary.joints):
            power = float((signal[:, row] ** 2).sum())
            if joint in targets and power > 0:
                power -= float(
                    grid_gain(rival, *row_moments(fits, columns[row], row, signal, {}, scale)).max()
                )
            left += power
        return left + float((signal[:, len(fits.dictionary.joints) :] ** 2).sum())
    total = float((signal**2).sum())
    return total - max(
        (
            fixed_gain(fits, c, signal, {}, scale)
            for c in fits.fixed_candidates
            if c.effect is rival
        ),
        default=0.0,
    )


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
