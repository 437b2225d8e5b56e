"""Runs beside each other: their figures of merit in one table, their pictures with the same
axes."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from fbse_drake.errors import InputError, located
from fbse_drake.files import read_json
from fbse_drake.interop.convert import read_log
from fbse_drake.log import Log
from fbse_drake.report.figures import TOPICS
from fbse_drake.report.figures.kind import FigureKind
from fbse_drake.report.html import (
    Cell,
    Details,
    FigureRow,
    Measure,
    Report,
    Section,
    Table,
    number,
    write_report,
)
from fbse_drake.report.metrics import PHASES, run_metrics
from fbse_drake.report.run import run_outcome

_TITLES = {
    "walk": "Motion",
    "joints": "Joints",
    "forces": "Foot forces",
    "friction": "Friction",
    "base": "Base state",
    "consistency": "Consistency",
    "sensors": "Sensors",
}
_SAME_AXES = "The same axes in all runs."
_OWN_AXES = "The runs have different panels, so each has axes of its own."


@dataclass(frozen=True)
class Run:
    """A run to compare: its log and its figures of merit."""

    name: str
    # As given, and the log itself.
    path: Path
    file: Path
    log: Log
    # See `run_metrics`.
    metrics: Mapping[str, Any]


@dataclass(frozen=True)
class Merit:
    """One figure of merit of all runs."""

    name: str
    unit: str
    # None if neither is better.
    better: Literal["lower", "higher"] | None
    # NaN where a run does not have it.
    values: tuple[float, ...]

    @cached_property
    def differences(self) -> tuple[float, ...]:
        """Of each run from the first, as a share of the first; NaN where that says nothing."""
        first = self.values[0]
        if first == 0:
            return (math.nan,) * len(self.values)
        return tuple((value - first) / abs(first) for value in self.values)

    @cached_property
    def best(self) -> tuple[int, ...]:
        """Places of the best runs: of those that have it, unless all are equal as far as shown."""
        known = [place for place, value in enumerate(self.values) if math.isfinite(value)]
        shown = {place: number(self.values[place]) for place in known}
        if self.better is None or len(set(shown.values())) < 2:
            return ()
        choose = min if self.better == "lower" else max
        winner = choose(known, key=lambda place: self.values[place])
        return tuple(place for place in known if shown[place] == shown[winner])


def read_runs(paths: Sequence[Path]) -> tuple[Run, ...]:
    """Reads runs: folders that simulate or estimate wrote, or logs.

    Raises:
        InputError: there are fewer than two, one is given twice, or one is not a run.
    """
    if len(paths) < 2:
        raise InputError("expected at least two runs to compare")
    files = [path / "log.npz" if path.is_dir() else path for path in paths]
    for place, file in enumerate(files):
        if file.resolve() in [other.resolve() for other in files[:place]]:
            raise InputError(f"{paths[place]}: a run is given twice")
    short = [file.parent.resolve().name if file.name == "log.npz" else file.stem for file in files]
    names = short if len(set(short)) == len(short) else [str(path) for path in paths]
    return tuple(map(_read_run, names, paths, files))


def _read_run(name: str, path: Path, file: Path) -> Run:
    if path.is_dir() and not file.exists():
        raise InputError(f"{path}: no log.npz; expected a folder that simulate or estimate wrote")
    log = read_log(file)
    with located(f"{file}: "):
        metrics = run_metrics(log, math.nan)
    # What a log does not tell.
    beside = file.with_name("metrics.json")
    measured = read_json(beside) if file.name == "log.npz" and beside.exists() else {}
    return Run(name, path, file, log, metrics | _measured(measured))


def _measured(content: Any) -> dict[str, Any]:
    """Times that were measured when a run was made, of its metrics.json."""
    if not isinstance(content, Mapping):
        return {}
    times: dict[str, Any] = {
        key: float(content[key])
        for key in ("wall_time", "real_time_factor")
        if isinstance(content.get(key), int | float)
    }
    tick = content.get("tick_us")
    if isinstance(tick, Mapping):
        known = {key: value for key, value in tick.items() if isinstance(value, int | float)}
        times["tick_us"] = {"median": math.nan, "p99": math.nan} | known
    return times


def merits(runs: Sequence[Run]) -> list[Merit]:
    """The figures of merit that at least one run has."""
    return [merit for merit in _all_merits(runs) if not np.isnan(merit.values).all()]


def joint_merits(runs: Sequence[Run]) -> dict[str, list[Merit]]:
    """The figures of merit of the joints, by what they are; joints of all runs."""
    joints = dict.fromkeys(joint for run in runs for joint in run.log.joints)
    kinds = {
        "Tracking error, RMS": ("mrad", 1e3, [run.metrics["joint_tracking_rms"] for run in runs])
    }
    for phase in PHASES:
        nrmse = [run.metrics["friction_nrmse"][phase] for run in runs]
        kinds[f"Friction error in {phase}, NRMSE"] = ("%", 100.0, nrmse)
    found = {}
    for title, (unit, scale, of_runs) in kinds.items():
        of_joints = [
            Merit(
                joint.replace("_", " "),
                unit,
                "lower",
                tuple(scale * values.get(joint, math.nan) for values in of_runs),
            )
            for joint in joints
        ]
        if known := [merit for merit in of_joints if not np.isnan(merit.values).all()]:
            found[title] = known
    return found


def _all_merits(runs: Sequence[Run]) -> Iterator[Merit]:
    def merit(
        name: str,
        unit: str,
        value: Callable[[Mapping[str, Any]], float],
        better: Literal["lower", "higher"] | None = "lower",
    ) -> Merit:
        return Merit(name, unit, better, tuple(float(value(run.metrics)) for run in runs))

    def by_key(name: str, unit: str, key: str, scale: float = 1.0) -> Iterator[Merit]:
        """For each of the values that are under one key of the metrics."""
        for part in dict.fromkeys(part for run in runs for part in run.metrics[key]):
            values = tuple(scale * run.metrics[key].get(part, math.nan) for run in runs)
            yield Merit(name.format(part), unit, "lower", values)

    yield merit("Length of the run", "s", lambda of: of["simulated_time"], None)
    yield merit("Length per wall time", "1", lambda of: of["real_time_factor"], "higher")
    yield merit(
        "Joint tracking error, RMS, mean of the joints",
        "mrad",
        lambda of: 1e3 * float(np.mean(list(of["joint_tracking_rms"].values()))),
    )
    yield merit(
        "Joint tracking error, RMS, largest of the joints",
        "mrad",
        lambda of: 1e3 * _largest(of["joint_tracking_rms"]),
    )
    yield merit(
        "Simulated torque less its law, largest of the joints",
        "% of law",
        lambda of: 100 * _largest(of["friction_law_error"]),
    )
    yield from by_key("CoM error in {}, mean", "mm", "com_rse_mean", 1e3)
    yield merit(
        "Creep of a foot in a stance, largest",
        "mm",
        lambda of: 1e3 * _largest(of["stance_creep_max"]),
    )
    friction = "Friction error in {}, NRMSE, geometric mean of the joints"
    for phase in PHASES:
        errors = (100 * _geometric_mean(run.metrics["friction_nrmse"][phase]) for run in runs)
        yield Merit(friction.format(phase), "%", "lower", tuple(errors))
    yield from by_key("Estimated {}, RMS error", "deg", "attitude_rmse_deg")
    velocity = "Estimated base velocity in {}, RMS error"
    yield from by_key(velocity, "mm/s", "base_velocity_rmse", 1e3)
    yield from by_key("Estimator tick, {}", "µs", "tick_us")


def _largest(values: Mapping[str, float]) -> float:
    known = [value for value in values.values() if not math.isnan(value)]
    return max(known, default=math.nan)


def _geometric_mean(values: Mapping[str, float]) -> float:
    known = [value for value in values.values() if value > 0]
    return math.exp(np.mean(np.log(known))) if known else math.nan


def runs_json(runs: Sequence[Run]) -> dict[str, Any]:
    """Contents of report.json: the numbers of the report."""

    def content(merit: Merit) -> dict[str, Any]:
        names = [run.name for run in runs]
        return {
            "unit": merit.unit,
            "better": merit.better,
            "values": dict(zip(names, merit.values, strict=True)),
            "relative_differences": dict(zip(names, merit.differences, strict=True)),
            "best": [names[place] for place in merit.best],
        }

    return {
        "runs": {
            run.name: {
                "path": str(run.path),
                "fell": run.metrics["fell"],
                "outcome": run.metrics["outcome"],
            }
            for run in runs
        },
        "figures": {merit.name: content(merit) for merit in merits(runs)},
        "joints": {
            title: {merit.name: content(merit) for merit in of_joints}
            for title, of_joints in joint_merits(runs).items()
        },
    }


def write_runs_report(path: str | Path, runs: Sequence[Run]) -> None:
    """Writes runs beside each other as one HTML file."""
    figures = {
        topic: tuple(row for kind in kinds if (row := figure_row(kind, runs)) is not None)
        for topic, kinds in TOPICS.items()
    }
    outcomes = tuple((run.name, run_outcome(run.metrics), str(run.path)) for run in runs)
    by_joint = tuple(
        merit_table(runs, of_joints, title) for title, of_joints in joint_merits(runs).items()
    )
    scenarios = tuple(
        Details(f"{run.name}: {title}", run.log.meta[key])
        for run in runs
        for key, title in (("scenario", "YAML"), ("estimator_scenario", "YAML of the estimator"))
        if run.log.meta.get(key)
    )
    caption = (
        f"Differences are from {runs[0].name}, as a share of its figure. The best is marked where "
        "the runs differ."
    )
    sections = (
        Section("Runs", tables=(Table(("Run", "How it ended", "Where"), outcomes),)),
        Section("Figures", caption, (merit_table(runs, merits(runs)), *by_joint)),
        *(
            Section(_TITLES[topic], figures=pictures)
            for topic, pictures in figures.items()
            if pictures
        ),
        *([Section("Scenarios", details=scenarios)] if scenarios else []),
    )
    fell = [run.name for run in runs if run.metrics["fell"]]
    outcome = f"{len(runs)} runs beside each other." + (
        f" Not all came to their end: {', '.join(fell)}." if fell else ""
    )
    write_report(
        path, Report(" | ".join(run.name for run in runs), not fell, outcome, tuple(sections))
    )


def merit_table(runs: Sequence[Run], found: Sequence[Merit], folded: str = "") -> Table:
    """Figures of merit, a column for each run.

    Args:
        folded: the caption behind which the table is folded away, if it is.
    """
    rows: list[tuple[Cell, ...]] = [(merit.name, merit.unit, *_measures(merit)) for merit in found]
    return Table(
        ("Figure", "Unit", *(run.name for run in runs)), tuple(rows), folded, folded=bool(folded)
    )


def _measures(merit: Merit) -> Iterator[Measure]:
    for place, (value, change) in enumerate(zip(merit.values, merit.differences, strict=True)):
        note = "" if place == 0 or math.isnan(change) else f"{100 * change:+.3g} %"
        yield Measure(value, note, best=place in merit.best)


def figure_row(kind: FigureKind, runs: Sequence[Run]) -> FigureRow | None:
    """A picture of each run that has the channels, with the same axes."""
    blocks = {run.name: kind.block(run.log) for run in runs if kind.available(run.log)}
    if not blocks:
        return None
    figures = {name: block.draw() for name, block in blocks.items()}
    said = _SAME_AXES if _share_axes(list(figures.values())) else _OWN_AXES
    captions = list(dict.fromkeys(block.caption for block in blocks.values()))
    caption = " ".join([max(captions, key=len), *([said] if len(blocks) > 1 else [])])
    pictures = tuple((name, _drawn(figure)) for name, figure in figures.items())
    return FigureRow(kind.title, caption, pictures)


def _drawn(figure: Figure) -> Callable[[], Figure]:
    return lambda: figure


def _share_axes(figures: Sequence[Figure]) -> bool:
    """Gives panels in the same place the same limits; says whether the figures have such panels."""
    panels = [figure.axes for figure in figures]
    titles = [[axes.get_title(loc="left") for axes in of_one] for of_one in panels]
    if any(other != titles[0] for other in titles):
        return False
    limits = [
        (
            together,
            _union([axes.get_xlim() for axes in together]),
            _union([axes.get_ylim() for axes in together]),
        )
        for together in zip(*panels, strict=True)
    ]
    # Only when all are known: panels of a figure may share their limits.
    for together, x, y in limits:
        for axes in together:
            # Where both axes have one scale, the panel gets smaller instead of the limits wider.
            axes.set_adjustable("box")
            axes.set(xlim=x, ylim=y)
    return True


def _union(limits: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Limits that hold all; those that run backwards go on to."""
    low, high = min(map(min, limits)), max(map(max, limits))
    return (high, low) if limits[0][0] > limits[0][1] else (low, high)
