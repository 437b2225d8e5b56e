"""Cases of hidden physics: what came out of them, and how it is judged."""

import argparse
import hashlib
import json
import random
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

import fbse_drake
from fbse_drake.discrepancy.exercises.hidden import HiddenEffect

C = TypeVar("C")

NOTHING, UNKNOWN = "nothing", "unknown"


class Case(Protocol):
    """One log and its diagnosis, a frozen dataclass."""

    @property
    def name(self) -> str:
        """What it is called."""


def judged(case: Case, result: dict[str, Any], sources: str) -> dict[str, str]:
    """Figures of a run, see `benchmarks.store.Store`.

    Args:
        result: "answer", "score" and "diagnoses" of the case.
        sources: checksum of the sources that made it.
    """
    tree = {"sources": sources, "case": asdict(case), **result}
    return {"sources": sources, "result": json.dumps(tree, default=float)}


@dataclass(frozen=True)
class Result:
    """What came out of a case: the contents of its file."""

    tree: dict[str, Any]

    @property
    def name(self) -> str:
        return self.tree["case"]["name"]

    @property
    def group(self) -> str:
        return self.tree["case"]["group"]

    @property
    def size(self) -> str:
        return self.tree["case"]["size"]

    @property
    def hidden(self) -> list[dict[str, Any]]:
        return self.tree["answer"]["effects"]

    @property
    def score(self) -> dict[str, Any]:
        return self.tree["score"]

    @property
    def diagnosis(self) -> dict[str, Any]:
        return self.tree["diagnoses"][0]

    @cached_property
    def chosen(self) -> list[dict[str, Any]]:
        return [finding for finding in self.diagnosis["ranking"] if finding["chosen"]]

    @property
    def label(self) -> str:
        """What the diagnosis says, in a word."""
        if self.diagnosis["verdict"] == "unknown_effect" and (
            self.group == "stranger" or not self.chosen
        ):
            return UNKNOWN
        return self.chosen[0]["effect"] if self.chosen else NOTHING

    @property
    def truth(self) -> str:
        return self.hidden[0]["effect"] if self.hidden else NOTHING

    def is_found(self, *, alternatives: bool = True) -> bool:
        """Is everything found that is hidden, or else declared to be an alternative?"""
        return all(
            found or (alternatives and self.score["confusable"][name])
            for name, found in self.score["found"].items()
        )

    def is_alternative(self) -> bool:
        """Is the hidden effect declared to be an alternative to what is ranked first?"""
        return bool(self.chosen) and self.truth in self.chosen[0]["confusable_with"]

    def is_visible(self, stated: dict[str, dict[str, float]]) -> bool:
        """Is every hidden effect, on some target, larger than the smallest size that can be found?

        Where nothing is found, also larger than the size that this log's own diagnosis states: what
        is hidden may keep a joint still.
        """
        own = {
            name: status["smallest_detectable_by_target"]
            for name, status in self.diagnosis["effects"].items()
        }
        limits = [stated] if self.chosen else [stated, own]

        def shows(hidden: HiddenEffect, target: str) -> bool:
            known = (sizes.get(hidden.effect, {}).get(target) for sizes in limits)
            return all(hidden.exceeds(target, size) for size in known)

        effects = [HiddenEffect(**effect) for effect in self.hidden]
        return all(any(shows(hidden, target) for target in hidden.targets) for hidden in effects)

    def is_wrong(self, allowed: Iterable[str] = ()) -> bool:
        """Does it name effects with confidence that are not there?"""
        return self.diagnosis["verdict"] == "effect_found" and bool(
            set(self.score["wrong"]) - set(allowed)
        )

    def text(self) -> str:
        """One line."""
        hidden = (
            ", ".join(
                f"{e['effect']} {e['size']:.3g} ({' '.join(e['targets'])})" for e in self.hidden
            )
            or NOTHING
        )
        chosen = (
            ", ".join(f"{f['effect']} ({' '.join(f['joints'])})" for f in self.chosen) or NOTHING
        )
        left = " ".join(row["row"] for row in self.diagnosis["unexplained"]) or "nothing"
        return (
            f"{self.name}: {hidden} -> {self.diagnosis['verdict']}: {chosen}; unexplained: {left}"
        )


def share(values: Iterable[bool]) -> tuple[str, str]:
    """Percentage and number of cases."""
    values = list(values)
    return (f"{100 * np.mean(values):.1f} %" if values else "n/a"), f"{len(values)}"


def drawn(cases: Sequence[C], options: argparse.Namespace) -> list[C]:
    """The cases that the options ask for, see `add_options`: all, or the first of them in random
    order, so that what is done of a sample when it is stopped is a sample as well."""
    if options.sample is None:
        return list(cases)
    return random.Random(options.sample_seed).sample(cases, len(cases))[: options.sample]


def sources_checksum(*more: Path, note: str = "") -> str:
    """Checksum of what decides on a case.

    Args:
        more: files beside those of diagnosis and effects.
        note: whatever else it depends on.
    """
    package = Path(fbse_drake.__file__).parent
    files = sorted(
        file for room in ("discrepancy", "effects") for file in (package / room).rglob("*.py")
    )
    contents = [file.read_bytes() for file in (*files, *more)]
    return hashlib.sha256(b"".join([*contents, note.encode()])).hexdigest()


def add_options(parser: argparse.ArgumentParser, out: str, quick: str, names: str) -> None:
    """Options of a benchmark of cases.

    Args:
        out: where everything goes by default.
        quick: what is done in short.
        names: examples of parts of names.
    """
    parser.add_argument("--quick", action="store_true", help=quick)
    sample = "run only so many cases, drawn at random from all of them"
    parser.add_argument("--sample", type=int, default=None, metavar="N", help=sample)
    seed = "of what is drawn (default 0)"
    parser.add_argument("--sample-seed", type=int, default=0, metavar="SEED", help=seed)
    only = f"run only cases with this in their names, as {names}"
    parser.add_argument("--only", default="", metavar="NAME", help=only)
    jobs = "cases that run at once (default: all cores)"
    parser.add_argument("--jobs", type=int, default=None, help=jobs)
    parser.add_argument("--keep", action="store_true", help="keep results of other sources")
    where = f"where everything goes (default {out})"
    parser.add_argument("--out", type=Path, default=Path(out), help=where)
