"""Cases of hidden physics: how the benchmarks that hide it run, keep and show them."""

import hashlib
import json
import multiprocessing
import os
import traceback
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table as ConsoleTable

from fbse_drake.discrepancy.diagnose import diagnose
from fbse_drake.effects.effect import library
from fbse_drake.files import write_text
from fbse_drake.report.html import Table, number

NOTHING, UNKNOWN = "nothing", "unknown"


class Case(Protocol):
    """One log and its diagnosis, a frozen dataclass."""

    @property
    def name(self) -> str:
        """What it is called, also as a file."""


# Runs a case and tells its "answer", "score" and "diagnoses", as JSON has them.
Judge = Callable[[Any], dict[str, Any]]


def run(job: tuple[Case, Path, str, Judge]) -> None:
    """Runs a case and writes what came out.

    Args:
        job: the case, the file that is written, a checksum of the sources, and who runs it.
    """
    case, path, sources, judge = job
    try:
        result = judge(case)
    except Exception:  # One bad case must not stop the others.
        result = {"error": traceback.format_exc()}
    write_text(
        path,
        json.dumps({"sources": sources, "case": asdict(case), **result}, indent=1, default=float)
        + "\n",
    )


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

        Where nothing is found, also larger than the size that this log's own diagnosis states: what is hidden may keep a joint still.
        """
        own = {
            name: status["smallest_detectable_by_target"]
            for name, status in self.diagnosis["effects"].items()
        }
        limits = [stated] if self.chosen else [stated, own]

        def exceeds(hidden: dict[str, Any], target: str) -> bool:
            return all(
                _strength(hidden, target) > _limit(sizes, hidden, target) for sizes in limits
            )

        return all(
            any(exceeds(hidden, target) for target in hidden["targets"]) for hidden in self.hidden
        )

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


def _strength(hidden: dict[str, Any], target: str) -> float:
    """How large a hidden effect is on a target, so that more is easier to find: its first parameter, or the length of a vector."""
    name, parameter = next(iter(library()[hidden["effect"]].parameters.items()))
    if parameter.neutral == np.inf:
        return -hidden["parameters"][name][target]
    if not parameter.linear:
        return hidden["parameters"][name][target]
    parameters = library()[hidden["effect"]].parameters
    return float(
        np.linalg.norm(
            [
                hidden["parameters"].get(n, {}).get(target, 0.0)
                for n, p in parameters.items()
                if p.linear and p.unit == parameter.unit
            ]
        )
    )


def _limit(stated: dict[str, dict[str, float]], hidden: dict[str, Any], target: str) -> float:
    """The smallest strength that can be found."""
    parameter = next(iter(library()[hidden["effect"]].parameters.values()))
    limit = stated.get(hidden["effect"], {}).get(target, np.inf)
    return -limit if parameter.neutral == np.inf and np.isfinite(limit) else limit


def share(values: Iterable[bool]) -> tuple[str, str]:
    """Percentage and number of cases."""
    values = list(values)
    return (f"{100 * np.mean(values):.1f} %" if values else "n/a"), f"{len(values)}"


def sources_checksum(*more: Path, note: str = "") -> str:
    """Checksum of what decides on a case.

    Args:
        more: files beside those of diagnosis and effects.
        note: whatever else it depends on.
    """
    folder = Path(diagnose.__code__.co_filename).parent
    files = sorted([*folder.glob("*.py"), *(folder.parent / "effects").glob("*.py")])
    contents = [file.read_bytes() for file in (*files, *more)]
    return hashlib.sha256(b"".join([*contents, note.encode()])).hexdigest()


class Store:
    """The folder that holds a file for every case."""

    def __init__(self, folder: Path, sources: str, *, keep: bool):
        """Makes the folder.

        Args:
            sources: checksum of the sources; files made by others do not count.
            keep: they do count.
        """
        self._folder, self._sources, self._keep = folder, sources, keep
        folder.mkdir(parents=True, exist_ok=True)

    def read(self, cases: Iterable[Case]) -> list[Result]:
        """Results of those cases that have been run."""
        trees = [json.loads(path.read_text()) for path in map(self._path, cases) if path.exists()]
        return [Result(tree) for tree in trees if self._keep or tree["sources"] == self._sources]

    def run(
        self, cases: Iterable[Case], judge: Judge, jobs: int, console: Console, title: str
    ) -> None:
        """Runs those cases that have not been run."""
        cases = list(cases)
        done = {result.name for result in self.read(cases)}
        todo = [
            (case, self._path(case), self._sources, judge)
            for case in cases
            if case.name not in done
        ]
        # Numerical libraries must not start threads of their own beside a process for every core.
        os.environ |= dict.fromkeys(
            ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
        )
        # The shells of systems written in Python are never freed: a process grows slowly.
        with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=10) as pool:
            for _ in track(pool.imap_unordered(run, todo), title, len(todo), console=console):
                pass

    def _path(self, case: Case) -> Path:
        return self._folder / f"{case.name}.json"


def print_table(console: Console, title: str, table: Table) -> None:
    """Prints a table of texts and numbers."""
    shown = ConsoleTable(title=title, title_justify="left")
    for head in table.header:
        shown.add_column(head)
    for row in table.rows:
        shown.add_row(*(cell if isinstance(cell, str) else number(cell) for cell in row))
    console.print(shown)
