"""What all results have in common: they show themselves, write a report, and are saved to a folder
as the command of their name does."""

from abc import ABC, abstractmethod
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fbse_drake.errors import InputError
from fbse_drake.files import origin, write_json, write_text
from fbse_drake.log import Log
from fbse_drake.scenario import Scenario, dump_scenario

if TYPE_CHECKING:
    from fbse_drake.report.html import Table


class Result(ABC):
    """Base of the results. Matplotlib and templates are imported when they are needed."""

    @property
    @abstractmethod
    def outcome(self) -> str:
        """The result in one or two sentences."""

    @abstractmethod
    def table(self) -> "Table":
        """Its most important numbers."""

    @abstractmethod
    def report(self, path: str | Path) -> None:
        """Writes the report, one HTML file that holds all it shows."""

    @abstractmethod
    def save(self, folder: str | Path) -> None:
        """Writes everything to a folder, which is made if need be."""

    def _repr_html_(self) -> str:
        """Outcome and table, for notebooks."""
        from fbse_drake.report.html import render_fragment

        return render_fragment(self.outcome, (self.table(),))


class RunResult(Result):
    """A run: a log, and the scenario that it was simulated or estimated with."""

    log: Log
    scenario: Scenario
    name: str

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Contents of metrics.json, see `fbse_drake.report.metrics.run_metrics`."""
        return self._metrics()

    @abstractmethod
    def _metrics(self) -> dict[str, Any]:
        """Computes the metrics."""

    @property
    def outcome(self) -> str:
        from fbse_drake.report.run import run_outcome

        return run_outcome(self.metrics)

    def table(self) -> "Table":
        from fbse_drake.report.run import key_figures

        return key_figures(self.metrics)

    def report(self, path: str | Path) -> None:
        from fbse_drake.report.run import write_run_report

        write_run_report(path, self.log, self.metrics, name=self.name)

    def save(self, folder: str | Path) -> None:
        """Writes log.npz, metrics.json, scenario.yaml and report.html.

        Raises:
            InputError: the folder cannot be made.
            OSError: a file cannot be written; none is half-written.
        """
        from fbse_drake.report.run import write_run_report

        out = made_folder(folder)
        self.log.save(out / "log.npz")
        write_text(out / "scenario.yaml", dump_scenario(self.scenario, self.name))
        made_of = origin([out / "log.npz"], out / "scenario.yaml")
        write_json(out / "metrics.json", made_of | self.metrics)
        write_run_report(
            out / "report.html", self.log, self.metrics, name=self.name, folder=Path(folder)
        )


def made_folder(folder: str | Path) -> Path:
    """A folder for results, made if need be.

    Raises:
        InputError: it cannot be made.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    return path
