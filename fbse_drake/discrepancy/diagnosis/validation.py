"""Errors of models: is a completed one better on data that was set aside before anything was looked
at?

Both models are put against the same blocks, whitened by the same noise (see
`Residual.by_larger_noise`), so that what both do not know cancels in the change of the error.
(Unwhitened, noise that is differentiated would drown what is slow.) Its intervals are those of a
ratio of sums by batch means: consecutive blocks are taken together until their sums are hardly
correlated (with B blocks, a multiple of sqrt(B) at a time; Flegal and Jones 2010).
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.stats import t as student

from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.regression import STRETCH, WhitenedResidual
from fbse_drake.discrepancy.residual.residual import rms

# Of the intervals, unless they are simultaneous.
LEVEL = 0.95

Course = Literal["falls", "rises", "unclear"]


@dataclass(frozen=True)
class Measured:
    """A number that a log gives, with its 95 % interval."""

    value: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class Validation:
    """Errors of a model as given and completed on one log that nothing was fitted to."""

    # Root mean square of all whitened rows, in multiples of the sensors' noise, and the second over
    # the first.
    before: Measured
    after: Measured
    change: Measured
    # |residual| / |torque|, 2-norms over all joints, and the second over the first, or over what
    # more noise of the sensors, as the completed model passes it on, makes of that. NaN without
    # torques.
    relative_before: Measured
    relative_after: Measured
    relative_change: Measured

    @property
    def course(self) -> Course:
        """`falls` or `rises` if the interval of the change says so; one that rises counts more."""
        changes = [c for c in (self.change, self.relative_change) if np.isfinite(c.value)]
        if any(c.interval[0] > 1.0 for c in changes):
            return "rises"
        return "falls" if self.change.interval[1] < 1.0 else "unclear"

    @property
    def tells(self) -> bool:
        """Is there anything in the log in which the models differ?"""
        return self.change.value != 1.0

    @property
    def refutes(self) -> bool:
        """Does the log speak against the completed model? One that is too short for an interval
        does so only if the error does not fall there."""
        if self.course == "falls" or not self.tells:
            return False
        tested = np.isfinite(self.change.interval[1])
        return bool(tested or not self.change.value < 1.0)


@dataclass(frozen=True)
class ModelError:
    """What a model leaves over on one log, averaged over blocks (`recording.block`)."""

    # |residual| / |torque|, 2-norms over all joints, and of each joint; NaN without torques.
    relative: float
    relative_by_joint: dict[str, float]
    # Root mean square of every row, in its unit.
    rms: dict[str, float]


def model_error(predictor: Predictor) -> ModelError:
    """What the model of a predictor leaves over on its log."""
    residual, n = predictor.residual, len(predictor.robot.joint_names)
    known = residual.known[:, :n]
    left, torque = (
        rms(values[:, :n], known) * np.sqrt(known.sum(axis=0))
        for values in (residual.value, residual.signals.torque_command)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        by_joint = dict(zip(predictor.robot.joint_names, (left / torque).tolist(), strict=True))
        relative = float(np.sqrt(np.nansum(left**2)) / np.sqrt(np.nansum(torque**2)))
    of_rows = rms(residual.value, residual.known).tolist()
    return ModelError(
        relative, by_joint, dict(zip((row.name for row in residual.rows), of_rows, strict=True))
    )


def validated(given: Predictor, completed: Predictor, level: float = LEVEL) -> Validation:
    """Compares two models on the log that both predict.

    Args:
        level: of the intervals.
    """
    first, last, n = given.residual, completed.residual, len(given.robot.joint_names)
    white = WhitenedResidual(first.by_larger_noise(last))
    known = white.residual.known
    before, after = (
        (values**2).sum(axis=1)
        for values in (
            white.y,
            np.stack([white.whiten(k, values) for k, values in enumerate(last.value.T)], axis=1),
        )
    )
    left, left_after, torque, noise, noise_after = (
        np.where(known[:, :n], values[:, :n], 0.0).sum(axis=1)
        for values in (
            first.value**2,
            last.value**2,
            first.signals.torque_command**2,
            first.variance,
            last.variance,
        )
    )
    batch = batch_length(len(first.time), first.time[1] - first.time[0])
    return Validation(
        root_of_ratio(before, known.sum(axis=1), batch, level),
        root_of_ratio(after, known.sum(axis=1), batch, level),
        root_of_ratio(after, before, batch, level),
        root_of_ratio(left, torque, batch, level),
        root_of_ratio(left_after, torque, batch, level),
        root_of_ratio(left_after, left + np.maximum(noise_after - noise, 0.0), batch, level),
    )


def batch_length(blocks: int, block: float) -> int:
    """How many blocks are taken together, of so many that are so long [s]."""
    return max(round(STRETCH / block), int(2 * np.sqrt(blocks)), 1)


def root_of_ratio(
    above: np.ndarray, below: np.ndarray, batch: int, level: float = LEVEL
) -> Measured:
    """Root of the ratio of two sums over B blocks, with its interval by batch means.

    Args:
        above, below: not negative, (B,).
        batch: so many blocks are taken together; a rest at the end goes to the last batch.
        level: of the interval.
    """
    edges = np.arange(max(1, len(above) // batch)) * batch
    over, under = (np.add.reduceat(values, edges) for values in (above, below))
    over, under = over[under > 0], under[under > 0]
    if not len(under):
        return Measured(np.nan, (np.nan, np.nan))
    ratio, count = float(over.sum() / under.sum()), len(under)
    # Of the logarithm, which is nearly normal where a ratio of sums of squares is not; half of it,
    # for the root. One batch says nothing of how much the error scatters.
    half = np.inf
    if count > 1 and ratio > 0:
        scatter = float(((over - ratio * under) ** 2).sum()) * count / (count - 1)
        spread = np.sqrt(scatter) / float(over.sum())
        half = 0.5 * float(student.ppf((1 + level) / 2, count - 1)) * spread
    root = float(np.sqrt(ratio))
    return Measured(root, (root * float(np.exp(-half)), root * float(np.exp(half))))


def validation_json(validation: Validation) -> dict[str, Any]:
    """As it stands in diagnosis.json and study.json, under `set_aside` and the name of a log."""
    numbers = {
        name: {"value": number.value, "interval": list(number.interval)}
        for name, number in vars(validation).items()
    }
    return {"course": validation.course, "level": LEVEL, **numbers}
