"""Where benchmarks keep what their runs give: a benchmark is a campaign."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.cases import Case, Result
from fbse_drake.campaign.campaign import Run
from fbse_drake.campaign.results import StoredRuns
from fbse_drake.progress import ProgressLines

# Lines of progress are so far apart [s].
_EVERY = 10.0


class Runs(StoredRuns):
    """Runs of a benchmark, each with a result, and the folder that they are kept in."""

    def __init__(
        self,
        folder: Path,
        function: str,
        values: Sequence[Mapping[str, Any]],
        sources: str | None,
    ):
        """As `StoredRuns`."""
        super().__init__(str(folder), function, values, sources)

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
        """Does what has not been done, and tells the console.

        Args:
            workers: how many at once; None for one on each core.
            only: which of the runs.
        """

        def tell(line: str) -> None:
            console.print(f"{title}: {line}", highlight=False, markup=False, soft_wrap=True)

        lines = ProgressLines(tell, every=_EVERY)
        with lines.stopped_by_keyboard():
            outcome = self.do(workers=workers, only=only, progress=lines, tell=tell)
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
