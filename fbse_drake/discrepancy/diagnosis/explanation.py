"""Candidates for what is missing, and explanations: candidates that are fitted together."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fbse_drake.discrepancy.identification.regression import Fit, Signature
from fbse_drake.effects.effect import Effect, Parameter

# An effect and its targets.
Name = tuple[type[Effect], tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect on one or more targets that share its values."""

    effect: type[Effect]
    # Joints, bodies, sides or `robot`.
    targets: tuple[str, ...]
    # Of the effect, in the units of the targets.
    parameters: Mapping[str, Parameter]
    # Values of its nonlinear parameters, shape (m,).
    nonlinear: np.ndarray
    # Whitened; columns are the linear parameters, then, if they are fitted, the change of the
    # nonlinear ones.
    signature: Signature
    # The same as it is, or what makes it: it is seldom asked for.
    source: Signature | Callable[[], Signature]
    # Drop of the deviance that it brings because the sensors' noise is in its columns and in the
    # residual alike, or what finds it: it is seldom asked for as well.
    noise_drop: float | Callable[[], float] = 0.0
    # Sum of squares of the noise in its columns, whitened, by row and column, (r, p) or 0.
    noise_power: np.ndarray | float = 0.0

    @property
    def name(self) -> str:
        return self.effect.__name__

    @property
    def key(self) -> Name:
        """What it is, whatever its values are."""
        return self.effect, self.targets

    @cached_property
    def raw(self) -> Signature:
        """Its signature, not whitened."""
        return self.source if isinstance(self.source, Signature) else self.source()

    @cached_property
    def spurious(self) -> float:
        """Drop of the deviance that noise in its columns feigns."""
        return self.noise_drop() if callable(self.noise_drop) else self.noise_drop

    @property
    def has_linear(self) -> bool:
        """Does it have an amount, or nonlinear parameters alone?"""
        return bool(self.linear_names)

    @property
    def linear_names(self) -> list[str]:
        return [name for name, parameter in self.effect.parameters.items() if parameter.linear]

    @property
    def nonlinear_names(self) -> list[str]:
        return [name for name, parameter in self.effect.parameters.items() if not parameter.linear]

    @property
    def fitted_names(self) -> list[str]:
        """Of its columns."""
        names = [*self.linear_names, *self.nonlinear_names]
        return names[: self.signature.parameters]


@dataclass(frozen=True, eq=False)
class Explanation:
    """Effects that are fitted together; their parameters stand one candidate after the other, then
    those of untrusted inertia."""

    candidates: tuple[Candidate, ...]
    # None for no effects at all.
    fit: Fit | None
    sse: np.ndarray
    held_out_sse: np.ndarray
    # Of held-out data, with the charge for every parameter; smaller is better.
    deviance: float

    @property
    def solved(self) -> Fit:
        """The fit, of an explanation with effects."""
        assert self.fit is not None
        return self.fit

    def start(self, candidate: Candidate) -> int:
        """Place of a candidate's first parameter."""
        return sum(
            c.signature.parameters
            for c in itertools.takewhile(lambda c: c is not candidate, self.candidates)
        )

    def fitted(self, candidate: Candidate) -> tuple[list[str], np.ndarray, slice]:
        """Names of a candidate's fitted parameters, their values (m,), and their places in the
        fit."""
        names = candidate.fitted_names
        offsets = np.concatenate([np.zeros(len(candidate.linear_names)), candidate.nonlinear])
        start = self.start(candidate)
        part = slice(start, start + len(names))
        return names, self.solved.parameters[part] + offsets[: len(names)], part

    def as_fitted(self, candidate: Candidate) -> Candidate:
        """A candidate with the nonlinear values that were found; its columns are as they were."""
        names, values, _ = self.fitted(candidate)
        found = dict(zip(names, values, strict=True))
        known = zip(candidate.nonlinear_names, candidate.nonlinear, strict=True)
        return replace(candidate, nonlinear=np.array([found.get(*one) for one in known]))

    def values(
        self, candidate: Candidate
    ) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
        """Values of a candidate's parameters and their 95 % intervals, by name, within the
        parameters' bounds.

        A nonlinear parameter that was not fitted has its plausible range as interval.
        """
        fitted, values, part = self.fitted(candidate)
        intervals = self.solved.interval()[part] + (values - self.solved.parameters[part])[:, None]
        found, between = {}, {}
        for name, value, interval in zip(fitted, values, intervals, strict=True):
            bounds = candidate.parameters[name].bounds
            found[name], between[name] = (
                float(np.clip(value, *bounds)),
                tuple(np.clip(interval, *bounds).tolist()),
            )
        for name, value in zip(candidate.nonlinear_names, candidate.nonlinear, strict=True):
            if name not in found:
                found[name], between[name] = float(value), candidate.parameters[name].plausible
        return found, between

    @property
    def effects(self) -> list[Effect]:
        """The candidates' effects with the values that were found."""
        found = []
        for candidate in self.candidates:
            values, _ = self.values(candidate)
            same = {name: [value] * len(candidate.targets) for name, value in values.items()}
            found.append(candidate.effect.from_values(candidate.targets, same))
        return found
