"""Where benchmarks keep what their runs give: a benchmark is a campaign."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.cases import Case, Result
from fbse_drake import resources
from fbse_drake.campaign.campaign import Campaign, Run
from fbse_drake.campaign.cluster import run_campaign
from fbse_drake.campaign.design import Listed
from fbse_drake.campaign.rows import Folder
from fbse_drake.campaign.steps import Call
from fbse_drake.progress import ProgressLines

# Lines of progress are so far apart [s].
_EVERY = 10.0


def package_checksum(*more: Path) -> str:
    """Checksum of the package, its models and its scenarios.

    Args:
        more: further files.
    """
    folders = (Path(resources.__file__).parent, *map(resources.folder, ("models", "scenarios")))
    files = {file for folder in folders for file in folder.rglob("*.*") if file.is_file()}
    sources = sorted(file for file in files if file.suffix in (".py", ".yaml", ".urdf"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in (*sources, *more))).hexdigest()


class Runs:
    """Runs of a benchmark, each with a result, and the folder that they are kept in."""

    def __init__(
        self,
        folder: Path,
        function: str,
        values: Sequence[Mapping[str, Any]],
        sources: str | None,
    ):
        """Forgets what was made by other sources.

        Args:
            function: what does a run, as `!Call` takes it; it gives `sources`, the checksum of what
                it was made by, and `result`, JSON text.
            values: of each run.
            sources: checksum of those whose results count; None for any.
        """
        self.campaign = Campaign(
            {"benchmark": Call(function, gives={"sources": "text", "result": "text"})},
            design=Listed(list(map(dict, values))),
        )
        self._folder = Folder(str(folder))
        if sources is not None:
            rows = self._rows()
            old = [key for key, row in rows.items() if row["benchmark.sources"] != sources]
            self._folder.forget(old)

    def _rows(self) -> dict[str, dict[str, Any]]:
        """Rows by run."""
        if self._folder.known_schema() is None:
            return {}
        return {row["run"]: row for row in self._folder.table().to_pylist()}

    def read(self) -> list[tuple[Run, Any, str | None]]:
        """Run, result and failure of what has been run, in order."""
        rows = self._rows()
        return [
            (run, json.loads(rows[run.key]["benchmark.result"] or "null"), rows[run.key]["failure"])
            for run in self.campaign.runs
            if run.key in rows
        ]

    def results(self) -> list[Any]:
        """Results of what has been run, in order; ends the benchmark if a run failed."""
        found = self.read()
        for run, _, failure in found:
            if failure is not None:
                raise SystemExit(f"{run.values}: {failure}")
        return [result for _, result, _ in found]

    def run(
        self,
        console: Console,
        title: str,
        *,
        workers: int | None,
        only: Callable[[Run], bool] = lambda _: True,
    ) -> None:
        """Does what has not been done.

        Args:
            workers: how many at once; None for one on each core.
            only: which of the runs.
        """

        def tell(line: str) -> None:
            console.print(f"{title}: {line}", highlight=False, markup=False, soft_wrap=True)

        lines = ProgressLines(tell, every=_EVERY)
        with lines.stopped_by_keyboard():
            outcome = run_campaign(
                self.campaign,
                self._folder.place,
                workers=workers,
                only=only,
                others=True,
                progress=lines,
                tell=tell,
            )
        if outcome.stopped is not None:
            raise SystemExit(f"{title}: {outcome.stopped}; the same command goes on")


class Store:
    """Cases of hidden physics as runs; see `Runs`."""

    def __init__(self, folder: Path, judge: str, cases: Sequence[Case], sources: str | None):
        """As `Runs`.

        Args:
            judge: gets the case as the value `case`, and gives what `benchmarks.cases.judged` does.
        """
        self._runs = Runs(folder, judge, [{"case": asdict(case)} for case in cases], sources)

    def read(self) -> list[Result]:
        """Results of those cases that have been run, in order."""
        return [
            Result(tree if failure is None else _failed(run, failure))
            for run, tree, failure in self._runs.read()
        ]

    def run(self, console: Console, title: str, *, only: str, workers: int | None) -> None:
        """Runs those cases that have not been run, of those with this in their names."""
        self._runs.run(
            console, title, workers=workers, only=lambda run: only in run.values["case"]["name"]
        )


def _failed(run: Run, failure: str) -> dict[str, Any]:
    return {"sources": "", "case": run.values["case"], "error": failure}
