"""Do recordings that are fitted together agree? What was found is fitted to each of them alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.servo import stretches

# Level of the intervals; a parameter differs if chance would make it so less often than this.
_LEVEL, _FALSE_ALARM = 0.95, 1e-3
# So many degrees of freedom are taken for known exactly.
_MOST_FREEDOM = 1e6
# A recording of fewer blocks says nothing by itself.
_FEWEST_BLOCKS = 40


@dataclass(frozen=True)
class OwnValue:
    """What one recording alone says of a parameter, with its 95 % interval."""

    value: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class Spread:
    """One parameter in several recordings."""

    # By recording; those that say nothing of it are left out.
    by_log: Mapping[str, OwnValue]
    # Standard deviation between recordings beyond what their own uncertainty brings (DerSimonian
    # and Laird 1986), and the probability that it is not there (Cochran's Q).
    between: float
    probability: float

    @property
    def differs(self) -> bool:
        return self.probability < _FALSE_ALARM


def spreads(fits: Fits, explanation: Explanation) -> dict[Candidate, dict[str, Spread]]:
    """By member of an explanation and parameter; empty if the log is of one recording."""
    parts = recordings(fits.dictionary.predictor.motion)
    if len(parts) < 2 or not explanation.candidates:
        return {}
    own = [_fitted_to(fits, explanation, inside) for inside in parts.values()]
    result: dict[Candidate, dict[str, Spread]] = {}
    for k, member in enumerate(explanation.candidates):
        told = [_told(one, one.candidates[k]) for one in own]
        values, deviation, freedom = (np.array(part) for part in zip(*told, strict=True))
        names, _, _ = explanation.fitted(member)
        result[member] = {
            name: spread_of(list(parts), values[:, p], deviation[:, p], freedom[:, p])
            for p, name in enumerate(names)
        }
    return result


def recordings(motion: RecordedMotion) -> dict[str, np.ndarray]:
    """Which blocks of a log are of which recording, (B,) each, by name."""
    found: dict[str, np.ndarray] = {}
    for k, (part, segment) in enumerate(stretches(motion.log), start=1):
        start, end = motion.log.time[part][[0, -1]]
        inside = (motion.time >= start) & (motion.time <= end)
        if inside.sum() >= _FEWEST_BLOCKS:
            name = str(segment.get("source", k))
            found[name if name not in found else f"{name} ({k})"] = inside
    return found


def _fitted_to(fits: Fits, explanation: Explanation, inside: np.ndarray) -> Explanation:
    """An explanation fitted to some blocks alone."""
    residual = fits.white.residual
    white = WhitenedResidual(replace(residual, known=residual.known & inside[:, None]))
    alone = Fits(fits.dictionary, white)
    return alone.explain(
        [replace(c, signature=white.whiten_signature(c.raw)) for c in explanation.candidates]
    )


def _told(explanation: Explanation, member: Candidate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values of a member's parameters, their standard deviations and degrees of freedom, (m,)
    each."""
    _, values, part = explanation.fitted(member)
    spread = explanation.solved.spread
    # What does not move a row of these blocks is not told by them.
    seen = (member.signature.values**2).sum(axis=(0, 1))[: len(values)] > 0
    return np.where(seen, values, np.nan), spread.deviation[part], spread.freedom[part]


def spread_of(
    names: Sequence[str], values: np.ndarray, deviation: np.ndarray, freedom: np.ndarray
) -> Spread:
    """How far values of one parameter differ between K recordings.

    Args:
        names: of the recordings.
        values, deviation, freedom: with standard deviations and their degrees of freedom, (K,)
            each; NaN or a deviation of 0 where a recording says nothing.
    """
    told = np.isfinite(values) & np.isfinite(deviation) & (deviation > 0)
    freedom = np.minimum(freedom, _MOST_FREEDOM)
    half = student.ppf((1 + _LEVEL) / 2, freedom) * deviation
    by_log = {
        names[k]: OwnValue(
            float(values[k]), (float(values[k] - half[k]), float(values[k] + half[k]))
        )
        for k in np.flatnonzero(told).tolist()
    }
    # The variance of Student's distribution; below three degrees of freedom it has next to none.
    variance = deviation[told] ** 2 * freedom[told] / np.maximum(freedom[told] - 2, 0.5)
    count = len(variance)
    if count < 2:
        return Spread(by_log, 0.0, 1.0)
    weight = 1.0 / variance
    mean = weight @ values[told] / weight.sum()
    square = float(weight @ (values[told] - mean) ** 2)
    excess = max(0.0, square - (count - 1)) / (weight.sum() - (weight**2).sum() / weight.sum())
    return Spread(by_log, float(np.sqrt(excess)), float(chi2.sf(square, count - 1)))


def spreads_json(by_parameter: Mapping[str, Spread]) -> dict[str, Any]:
    """As they stand in diagnosis.json with a finding; empty for one recording."""
    spread = {
        name: {
            "by_log": {
                log: {"value": own.value, "interval": list(own.interval)}
                for log, own in one.by_log.items()
            },
            "between": one.between,
            "probability": one.probability,
        }
        for name, one in by_parameter.items()
    }
    return {"spread": spread} if spread else {}
