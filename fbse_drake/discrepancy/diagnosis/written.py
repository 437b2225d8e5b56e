"""What is read back of diagnosis.json and study.json; they say more."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fbse_drake import schema
from fbse_drake.discrepancy.diagnosis.diagnose import Verdict
from fbse_drake.errors import InputError
from fbse_drake.files import from_json, to_json


@dataclass(frozen=True)
class WrittenParameter:
    """A value of an effect with its 95 % interval."""

    value: float
    # A bound that is null is infinite.
    interval: list[float | None]
    unit: str = ""

    def __post_init__(self) -> None:
        if len(self.interval) != 2:
            raise InputError(f"interval: expected two bounds, found {len(self.interval)}")
        low, high = self.interval
        bounds = [-math.inf if low is None else low, math.inf if high is None else high]
        # Frozen from here on: nobody has seen it yet.
        object.__setattr__(self, "interval", bounds)


@dataclass(frozen=True)
class WrittenFinding:
    """An effect of the ranking."""

    effect: str
    joints: list[str]
    parameters: dict[str, WrittenParameter]
    confusable_with: list[str]
    chosen: bool
    tentative: bool = False
    too_small: bool = False
    # Null where it is not known.
    held_out_before: float | None = None
    held_out_after: float | None = None


@dataclass(frozen=True)
class WrittenStatus:
    """What a diagnosis says of an effect of the library."""

    # Null where no size would have shown.
    smallest_detectable_by_target: dict[str, float | None] = field(default_factory=dict)


@dataclass(frozen=True)
class WrittenStructure:
    """A row with something that no effect explains."""

    row: str


@dataclass(frozen=True)
class WrittenDiagnosis:
    """The contents of diagnosis.json."""

    ranking: list[WrittenFinding]
    verdict: Verdict | None = None
    effects: dict[str, WrittenStatus] = field(default_factory=dict)
    unexplained: list[WrittenStructure] = field(default_factory=list)


@dataclass(frozen=True)
class WrittenStudy:
    """The contents of study.json."""

    diagnoses: list[WrittenDiagnosis]

    def __post_init__(self) -> None:
        if not self.diagnoses:
            raise InputError("diagnoses: expected at least one, found none")


def written_diagnosis(content: Mapping[str, Any]) -> WrittenDiagnosis:
    """The contents of a diagnosis.json, checked; what was not written yet may be infinite.

    Raises:
        InputError: they are not such.
    """
    file, standard = "not the contents of a diagnosis.json", from_json(to_json(content))
    return schema.build(WrittenDiagnosis, standard, file=file, further_keys=True)


def written_study(content: Mapping[str, Any]) -> WrittenStudy:
    """The contents of a study.json, checked; what was not written yet may be infinite.

    Raises:
        InputError: they are not such.
    """
    file, standard = "not the contents of a study.json", from_json(to_json(content))
    return schema.build(WrittenStudy, standard, file=file, further_keys=True)
