"""Designs: which runs a campaign has."""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fbse_drake.errors import (
    InputError,
    require_at_most,
    require_not_negative,
    require_positive,
)

# Of a campaign, in one scenario.
_MOST_RUNS = 10**6


@dataclass(frozen=True)
class Uniform:
    """Any number between two bounds."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError(f"high: expected more than low = {self.low:g}, found {self.high:g}")

    def draw(self, random: np.random.Generator) -> float:
        """A value."""
        return float(random.uniform(self.low, self.high))


@dataclass(frozen=True)
class LogUniform(Uniform):
    """A positive number between two bounds, whose logarithm is uniform."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "low")

    def draw(self, random: np.random.Generator) -> float:
        """A value."""
        return math.exp(random.uniform(math.log(self.low), math.log(self.high)))


@dataclass(frozen=True)
class Normal:
    """A normal distribution."""

    mean: float
    deviation: float

    def __post_init__(self) -> None:
        require_not_negative(self, "deviation")

    def draw(self, random: np.random.Generator) -> float:
        """A value."""
        return float(random.normal(self.mean, self.deviation))


@dataclass(frozen=True)
class Choice:
    """One of some values, each as likely."""

    of: list[Any]

    def __post_init__(self) -> None:
        if not self.of:
            raise InputError("of: expected at least one value, found none")

    def draw(self, random: np.random.Generator) -> Any:
        """A value."""
        return self.of[random.integers(len(self.of))]


@dataclass(frozen=True)
class Point:
    """What one run has for itself."""

    seed: int
    # By key of the scenario, as `a.b.c`.
    values: dict[str, Any]


@dataclass(frozen=True)
class Design(ABC):
    """Base of the designs."""

    @staticmethod
    def alternatives() -> tuple[type["Design"], ...]:
        """What can stand for a design in a campaign (see `fbse_drake.schema`)."""
        return Grid, Random, Listed

    @abstractmethod
    def points(self) -> Iterator[Point]:
        """All runs in one scenario. Of a larger design of the same kind they are the first ones,
        or among them."""


@dataclass(frozen=True)
class Grid(Design):
    """Every combination of values, for each of some seeds."""

    values: dict[str, list[Any]] = field(default_factory=dict)
    # How many seeds, from `first_seed` on.
    seeds: int = 1
    first_seed: int = 0

    def __post_init__(self) -> None:
        require_positive(self, "seeds")
        require_at_most(self, seeds=_MOST_RUNS)
        require_not_negative(self, "first_seed")
        for key, values in self.values.items():
            if not values:
                raise InputError(f"values.{key}: expected at least one value, found none")
        runs = self.seeds * math.prod(map(len, self.values.values()))
        if runs > _MOST_RUNS:
            raise InputError(f"values: expected at most {_MOST_RUNS} combinations, found {runs}")

    def points(self) -> Iterator[Point]:
        for seed in range(self.first_seed, self.first_seed + self.seeds):
            for combination in itertools.product(*self.values.values()):
                yield Point(seed, dict(zip(self.values, combination, strict=True)))


@dataclass(frozen=True)
class Random(Design):
    """Values drawn at random; every run has a seed of its own."""

    runs: int
    values: dict[str, Uniform | LogUniform | Normal | Choice] = field(default_factory=dict)
    # Of the values. Run k has the seed first_seed + k in its scenario.
    seed: int = 0
    first_seed: int = 0

    def __post_init__(self) -> None:
        require_positive(self, "runs")
        require_at_most(self, runs=_MOST_RUNS)
        require_not_negative(self, "seed", "first_seed")

    def points(self) -> Iterator[Point]:
        for k in range(self.runs):
            random = np.random.default_rng([self.seed, k])
            values = {key: drawn.draw(random) for key, drawn in self.values.items()}
            yield Point(self.first_seed + k, values)


@dataclass(frozen=True)
class Listed(Design):
    """Runs that are listed, each with its values by key; one may be `seed`."""

    runs: list[dict[str, Any]]

    def __post_init__(self) -> None:
        keys = self.runs[0].keys() if self.runs else set()
        for k, values in enumerate(self.runs):
            if values.keys() != keys:
                raise InputError(f"runs[{k}]: expected the keys {', '.join(keys)} as in runs[0]")
            if not isinstance(values.get("seed", 0), int):
                raise InputError(f"runs[{k}].seed: expected a whole number")

    def points(self) -> Iterator[Point]:
        for values in self.runs:
            others = {key: value for key, value in values.items() if key != "seed"}
            yield Point(values.get("seed", 0), others)
