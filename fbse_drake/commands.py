"""What the `fbse` commands do; each says whether it came to its end."""

import argparse
import csv
import os
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from rich.console import Group
from rich.markup import escape
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table
from rich.text import Text

from fbse_drake.analysis import AnalysisResult, compare, diagnose, identify, reveal, study
from fbse_drake.cli import LISTED
from fbse_drake.console import Console
from fbse_drake.discrepancy.diagnosis.add import add, read_findings, settled
from fbse_drake.discrepancy.diagnosis.diagnose import Finding
from fbse_drake.discrepancy.diagnosis.identify import identifiability_text
from fbse_drake.discrepancy.exercises.hidden import make_exercise, seal
from fbse_drake.effects.effect import spaced
from fbse_drake.effects.user import require_trusted
from fbse_drake.errors import InputError, located, on_one_line
from fbse_drake.estimation import estimate
from fbse_drake.files import origin, read_json, to_json, write_atomically, write_json, write_text
from fbse_drake.init_robot import init_robot
from fbse_drake.interop.convert import read_log, read_logs
from fbse_drake.interop.export import writer_for
from fbse_drake.listing import listing
from fbse_drake.log import Log
from fbse_drake.processes import usual_jobs
from fbse_drake.progress import Interrupted, Progress, ProgressLines
from fbse_drake.report.discrepancy_figures import targets_text
from fbse_drake.report.discrepancy_tables import findings_table
from fbse_drake.report.html import Table as ReportTable
from fbse_drake.report.html import number, percent
from fbse_drake.report.identification import base_table
from fbse_drake.report.metrics import worst_joint
from fbse_drake.report.run import law_step
from fbse_drake.report.sentences import Inputs, parameter_text
from fbse_drake.results import RunResult, made_folder
from fbse_drake.scenario import Scenario, check_joints, dump_scenario, read_scenario
from fbse_drake.scenario_keys import json_schema
from fbse_drake.simulation import SimulationResult, simulate

# Failures and findings that are printed.
_SHOWN = 8
# A line that changes does so this often [s].
_STATUS_PERIOD = 0.5
# Beginning of what `fbse add` writes.
_ADDED = "# Effects added by fbse add"


def _simulate(options: argparse.Namespace) -> bool:
    name, scenario = _read_scenario(options)
    out = _output_folder(options, "")
    console = Console(quiet=options.quiet)
    meshcat = _start_meshcat(console) if options.meshcat else None
    with (
        located(f"{options.scenario}: "),
        _progress(console, f"simulating {name}", scenario.duration) as progress,
    ):
        result = simulate(scenario, name=name, meshcat=meshcat, progress=progress)
    _write_run(console, out, result)
    if meshcat is not None:
        write_text(out / "meshcat.html", meshcat.StaticHtml())
    if result.failure is not None:
        print(
            f"fbse: {name}: {result.failure}; what was recorded until then is in {out}",
            file=sys.stderr,
        )
        return False
    return True


def _estimate(options: argparse.Namespace) -> bool:
    name, scenario = _read_scenario(options)
    log = read_log(options.log, options.map)
    out = _output_folder(options, "_estimate")
    if (out / "log.npz").exists() and (out / "log.npz").samefile(options.log):
        raise InputError(f"--out {out}: the log with the estimates would overwrite {options.log}")
    console = Console(quiet=options.quiet)
    start, end = float(log.time[0]), float(log.time[-1])
    with (
        located(f"{options.scenario} over {options.log}: "),
        _progress(console, f"estimating with {name}", end - start) as progress,
    ):
        result = estimate(scenario, log, name=name, progress=lambda time: progress(time - start))
    _write_run(console, out, result)
    for remark in result.remarks:
        console.print(remark, soft_wrap=True)
    return True


def _compare(options: argparse.Namespace) -> bool:
    given = _scenario_and_logs(options, [options.log], "_compare")
    with (
        _errors_located(given.inputs),
        given.console.status("comparing the model with the log"),
    ):
        result = compare(given.scenario, given.log, name=given.inputs.name)
    _conclude(given, result)
    return True


def _diagnose(options: argparse.Namespace) -> bool:
    given = _scenario_and_logs(options, options.logs, "_diagnose")
    with _errors_located(given.inputs), _told(given.console, options.time_limit) as progress:
        result = diagnose(
            given.scenario,
            given.recordings,
            tests=_tests(options),
            name=given.inputs.name,
            progress=progress,
            jobs=options.jobs or usual_jobs(),
        )
    _conclude(given, result)
    return result.partial is None


def _study(options: argparse.Namespace) -> bool:
    given = _scenario_and_logs(options, [options.log], "_study")
    with _errors_located(given.inputs), _told(given.console, options.time_limit) as progress:
        result = study(
            given.scenario,
            given.log,
            tests=_tests(options),
            name=given.inputs.name,
            progress=progress,
            jobs=options.jobs or usual_jobs(),
        )
    _conclude(given, result)
    return not result.partial


def _identify(options: argparse.Namespace) -> bool:
    given = _scenario_and_logs(options, options.logs, "_identify")
    with _errors_located(given.inputs), _told(given.console) as progress:
        result = identify(
            given.scenario,
            given.recordings,
            tests=_tests(options),
            name=given.inputs.name,
            progress=progress,
        )
    given.console.print(identifiability_text(result.inertia))
    given.console.print(_printed(base_table(result), given.inputs.name))
    _conclude(given, result)
    return True


def _tests(options: argparse.Namespace) -> dict[str, Log]:
    """Logs to test models on, by name."""
    return {path.stem: read_log(path, options.map) for path in options.test}


def _report(options: argparse.Namespace) -> bool:
    from fbse_drake.report.runs import merit_table, merits, read_runs, runs_json, write_runs_report

    console = Console(quiet=options.quiet)
    with console.status("reading") as status:
        runs = read_runs(options.runs)
        out = made_folder(options.out)
        status.update("writing the report")
        logs = [run.file for run in runs]
        write_json(out / "report.json", origin(logs) | runs_json(runs))
        write_runs_report(out / "report.html", runs)
    console.print(_printed(merit_table(runs, merits(runs)), "side by side"))
    console.print(f"Report: {out / 'report.html'}", soft_wrap=True)
    return True


def _convert(options: argparse.Namespace) -> bool:
    out, console = options.out, Console(quiet=options.quiet)
    write = writer_for(out)
    if out.exists() and not options.force:
        raise InputError(f"{out}: this exists already; --force replaces it")
    if out.exists() and any(path.exists() and path.samefile(out) for path in options.inputs):
        raise InputError(f"{out}: this is what is to be converted")
    with console.status("reading") as status:
        log = read_logs(
            options.inputs, options.map, progress=lambda text: status.update(escape(text))
        )
        findings = log.meta.get("findings", [])
        if findings and options.strict:
            further = f" (and {len(findings) - 1} more findings)" if findings[1:] else ""
            raise InputError(f"{findings[0]}{further}")
        status.update(f"writing {escape(out.name)}")
        out.parent.mkdir(parents=True, exist_ok=True)
        write(log, out)
    table = Table(title=str(out), show_header=False, title_justify="left")
    table.add_row(
        "rows",
        (
            f"{len(log.time)} in {log.time[-1] - log.time[0]:.6g} s, nominally "
            f"{log.meta['period']:g} "
            "s apart"
        ),
    )
    table.add_row("joints", ", ".join(log.joints))
    table.add_row("channels", ", ".join(name for name in log if name != "time"))
    for finding in findings:
        table.add_row("left out", finding)
    console.print(table)
    return True


@dataclass(frozen=True)
class _Given:
    """What the discrepancy commands are given."""

    console: Console
    scenario: Scenario
    # By name.
    logs: dict[str, Log]
    inputs: Inputs
    out: Path

    @property
    def log(self) -> Log:
        """The only one."""
        (log,) = self.logs.values()
        return log

    @property
    def recordings(self) -> Log | dict[str, Log]:
        """One log as it is, several by name."""
        return self.logs if len(self.logs) > 1 else self.log


def _read_scenario(options: argparse.Namespace) -> tuple[str, Scenario]:
    """The scenario and its name; says whose code it runs."""
    name, scenario = read_scenario(
        options.scenario, options.name, options.overrides, allow_code=options.allow_code
    )
    if scenario.effect_modules:
        modules = ", ".join(scenario.effect_modules)
        Console(quiet=options.quiet).print(f"Code of the scenario: {modules}", soft_wrap=True)
    return name, scenario


def _scenario_and_logs(options: argparse.Namespace, paths: Sequence[Path], suffix: str) -> _Given:
    name, scenario = _read_scenario(options)
    if len(set(paths)) < len(paths):
        raise InputError(f"{paths[0]}: a log is given twice")
    alike = len({path.stem for path in paths}) < len(paths)
    logs = {str(path) if alike else path.stem: read_log(path, options.map) for path in paths}
    out = _output_folder(options, suffix)
    inputs = Inputs(
        name,
        options.scenario,
        tuple(map(str, paths)),
        str(out),
        changes=_changes(options),
        reading=("--map", str(options.map)) if options.map else (),
        tests=tuple(map(str, getattr(options, "test", ()))),
    )
    return _Given(Console(quiet=options.quiet), scenario, logs, inputs, out)


def _changes(options: argparse.Namespace) -> tuple[str, ...]:
    """The options with which a scenario is read, as they were given."""
    named = ("--name", options.name) if options.name else ()
    return (*named, *(part for change in options.overrides for part in ("--set", change)))


def _errors_located(inputs: Inputs) -> AbstractContextManager[None]:
    return located(f"{inputs.scenario} over {', '.join(inputs.logs)}: ")


@contextmanager
def _told(
    console: Console,
    limit: float | None = None,
    *,
    first: str = "comparing the model with the log",
) -> Iterator[Progress]:
    """Tells the progress of long work: in a line that changes, or without a terminal in lines below
    each other.

    Args:
        limit: time after which the work ends with what is known [s].
        first: what is said before the work tells anything.
    """
    if console.is_terminal and not console.quiet:
        with console.status(first) as status:
            lines = ProgressLines(
                lambda line: status.update(escape(line)), limit, every=_STATUS_PERIOD
            )
            with lines.stopped_by_keyboard():
                yield lines
        return
    lines = ProgressLines(lambda line: console.print(line, soft_wrap=True), limit)
    with lines.stopped_by_keyboard():
        yield lines


def _conclude(given: _Given, result: AnalysisResult) -> None:
    """Writes a result, and prints it after what is remarkable about the log."""
    console = given.console
    with console.status("writing the report"):
        result.save(given.out, given.inputs)
    if result.hygiene.findings:
        remarks = Table("data hygiene", "", title_justify="left")
        for finding in result.hygiene.findings[:_SHOWN]:
            remarks.add_row(finding.severity, finding.text)
        console.print(remarks)
    if (table := result.table()).rows:
        console.print(_printed(table, given.inputs.name))
    for further in result.further_tables():
        console.print(_printed(further, given.inputs.name))
    console.print(result.outcome)
    console.print(f"Report: {given.out / 'report.html'}", soft_wrap=True)


def _folding(title: str, header: Sequence[str]) -> Table:
    """An empty table in which names that are too long go on in the next line."""
    shown = Table(title=title, title_justify="left")
    for head in header:
        shown.add_column(head, overflow="fold")
    return shown


def _printed(table: ReportTable, title: str) -> Table:
    """A table of a report for the terminal; names and texts as they are."""
    shown = _folding(title, table.header)
    if table.caption:
        shown.caption, shown.caption_justify = Text(table.caption), "left"
    for row in table.rows:
        shown.add_row(
            *(Text(number(cell) if isinstance(cell, float) else str(cell)) for cell in row)
        )
    return shown


def _add(options: argparse.Namespace) -> bool:
    name, scenario = _read_scenario(options)
    path = options.diagnosis / "diagnosis.json" if options.diagnosis.is_dir() else options.diagnosis
    diagnosis = read_json(path)
    with located(f"{path}: "):
        findings = read_findings(diagnosis, options.effect)
        completed = add(scenario, findings)
        check_joints(completed)
    out = options.out
    # Nobody's own file is lost.
    if out.is_dir() or (out.exists() and not out.read_bytes().startswith(_ADDED.encode())):
        raise InputError(f"--out {out}: this exists already, and fbse add did not write it")
    if out.exists() and Path(options.scenario).is_file() and out.samefile(options.scenario):
        raise InputError(f"--out {out}: the new scenario would overwrite the old one")
    lines = [
        f"{_ADDED} to {options.scenario}, from {path}.",
        *(
            f"# {line}"
            for finding, added in zip(findings, settled(findings), strict=True)
            for line in _value_lines(finding, added)
        ),
    ]
    header = "\n".join(map(on_one_line, lines))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(out, f"{header}\n{dump_scenario(completed, name)}")
    console = Console(quiet=options.quiet)
    console.print(_printed(findings_table(findings), name))
    console.print(f"Scenario: {out}", soft_wrap=True)
    return True


def _value_lines(finding: Finding, added: Finding) -> list[str]:
    """Values with their 95 % intervals, and what they bring; for the comments of a scenario.

    Args:
        added: the same with the values that its model gets.
    """
    where = f"{finding.effect} in {targets_text(finding.targets)}"
    lines = [
        f"{where}: held-out error {finding.held_out_before:.3g} times the noise before, "
        f"{finding.held_out_after:.3g} after"
    ]
    for name, found in finding.parameters.items():
        value = added.parameters[name].value
        other = "" if value == found.value else f"; it is {value:g} here, the default"
        lines.append(f"{where}: {parameter_text(name, found)}, with its 95 % interval{other}")
    return lines


def _hide(options: argparse.Namespace) -> bool:
    name, scenario = _read_scenario(options)
    out = _output_folder(options, "_hidden")
    console = Console(quiet=options.quiet)
    with (
        located(f"{options.scenario}: "),
        _progress(console, f"simulating {name}", scenario.duration) as progress,
    ):
        start = clock.perf_counter()
        exercise = make_exercise(
            scenario,
            name,
            options.seed,
            what=options.what,
            size=options.size,
            count=options.count,
            progress=progress,
        )
    took = clock.perf_counter() - start
    _write_run(console, out, SimulationResult(exercise.log, None, took, exercise.scenario, name))
    write_text(out / "answer.sealed", seal(exercise.answer))
    console.print(
        (
            f"Find it: fbse study {out}/scenario.yaml {out}/log.npz --out {out}; then fbse reveal "
            f"{out}"
        ),
        soft_wrap=True,
    )
    return True


def _reveal(options: argparse.Namespace) -> bool:
    revealed = reveal(options.folder)
    answer = revealed.answer
    made_by = origin()
    write_json(options.folder / "answer.json", made_by | revealed.json())
    console = Console(quiet=options.quiet)
    table = Table(
        "hidden", "in", "values", title=f"{options.folder}: {answer.kind}", title_justify="left"
    )
    for effect in answer.effects:
        values = (
            f"{key} {number(float(next(iter(by_target.values()))))}"
            for key, by_target in effect.parameters.items()
        )
        table.add_row(spaced(effect.effect), targets_text(effect.targets), ", ".join(values))
    console.print(table if answer.effects else "Nothing was hidden.")
    if revealed.score is None:
        console.print(f"No diagnosis.json or study.json in {options.folder} to score.")
    else:
        console.print(revealed.score.text)
    return True


def _campaign(options: argparse.Namespace) -> bool:
    with _extra_installed("campaigns"):
        from fbse_drake.campaign.campaign import load_campaign
        from fbse_drake.campaign.cluster import run_campaign
    campaign = load_campaign(options.campaign)
    if not options.allow_code:
        require_trusted(options.campaign, campaign.code)
    place = options.out or str(Path("out") / options.campaign.stem)
    console = Console(quiet=options.quiet)

    def tell(line: str) -> None:
        console.print(line, soft_wrap=True)

    with _told(console, first="starting") as progress:
        outcome = run_campaign(
            campaign,
            place,
            scheduler=options.scheduler,
            workers=options.workers,
            progress=progress,
            tell=tell,
        )
    table = Table(show_header=False, title=campaign.title or place, title_justify="left")
    table.add_row("runs", f"{outcome.total}")
    table.add_row("done before, now", f"{outcome.before}, {outcome.done}")
    table.add_row("failed now", f"{len(outcome.failed)}")
    console.print(table)
    if outcome.stopped is not None:
        print(f"fbse: {outcome.stopped}; the same command goes on", file=sys.stderr)
        return False
    tell(f"Table: {place}/table.parquet, or fbse table {place}")
    return True


def _table(options: argparse.Namespace) -> bool:
    with _extra_installed("tables of campaigns"):
        from pyarrow.csv import write_csv

        from fbse_drake.campaign import table as tables
        from fbse_drake.campaign.rows import Folder, units_of
    if options.out is None and "://" in options.folder:
        raise InputError(f"--out: needed, for files cannot be written to {options.folder}")
    rows, out = Folder(options.folder).table(), options.out or Path(options.folder)
    by = tables.usual_groups(rows) if options.by is None else options.by
    found, values = tables.groups(rows, by), tables.figures(rows, options.value)
    summaries = list(tables.summary_rows(found, values))
    units, console = units_of(rows.schema), Console(quiet=options.quiet)
    labels = (f"{value} [{units[value]}]" if units[value] else value for value in values)
    lines = [[*by, "runs", "failed", *labels]]
    for row in summaries:
        same, (count, failed), numbers = row[: len(by)], row[len(by) :][:2], row[len(by) + 2 :]
        # Few runs have no interval.
        cells = (
            number(middle) + f" ({number(low)} to {number(high)})" * (not np.isnan(low + high))
            for middle, low, high in zip(*[iter(numbers)] * 3, strict=True)
        )
        lines.append([*map(str, same), str(count), str(failed), *cells])
    if len(values) > len(summaries):
        lines = list(map(list, zip(*lines, strict=True)))
    shown = _folding(options.folder, lines[0])
    for line in lines[1:]:
        shown.add_row(*line)
    console.print(shown)
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "table.csv", lambda partial: write_csv(rows, partial))
    bounds = (f"{value}{end}" for value in values for end in ("", " from", " to"))
    lines = [[*by, "runs", "failed", *bounds], *summaries]
    write_atomically(out / "groups.csv", lambda partial: _write_lines(partial, lines))
    if options.plot is not None:
        y, x = options.plot
        path = out / f"{y}_over_{x}.png"
        figure = tables.picture(rows, y, x, by)
        write_atomically(path, lambda partial: figure.savefig(partial, format="png", dpi=120))
        console.print(f"Picture: {path}", soft_wrap=True)
    console.print(f"Rows: {out / 'table.csv'}", soft_wrap=True)
    return True


def _rivals(options: argparse.Namespace) -> bool:
    with _extra_installed("comparisons of methods"):
        from fbse_drake.report import rivals as report
        from fbse_drake.rivals.campaign import Campaigns, Plan, compare_methods
        from fbse_drake.rivals.cases import CASES, NOMINAL
        from fbse_drake.rivals.comparison import comparison_json
    name, scenario = _read_scenario(options)
    cases = [case for case in CASES if case in (NOMINAL, *(options.case or CASES))]
    for case in options.case or ():
        if case not in CASES:
            raise InputError(f"--case {case}: expected one of {', '.join(CASES)}")
    out, console = _output_folder(options, "_rivals"), Console(quiet=options.quiet)
    plan = Plan(scenario, name, cases, options.seeds, options.trials)

    def tell(line: str) -> None:
        console.print(line, soft_wrap=True)

    try:
        with (
            located(f"{options.scenario}: "),
            _told(console, first="simulating the walk to tune on") as progress,
        ):
            campaigns = Campaigns(out, workers=options.workers, progress=progress, tell=tell)
            comparison = compare_methods(plan, campaigns, out)
    except Interrupted as stop:
        print(f"fbse: {stop}; the same command goes on", file=sys.stderr)
        return False
    text = dump_scenario(scenario, name)
    write_text(out / "scenario.yaml", text)
    settings = {"seeds": options.seeds, "trials": options.trials}
    made_of = origin(scenario=out / "scenario.yaml")
    for file in ("rivals", "metrics"):
        write_json(out / f"{file}.json", made_of | settings | comparison_json(comparison))
    with console.status("writing the report"):
        report.write_rivals_report(
            out / "report.html", comparison, name=name, seeds=options.seeds, scenario=text
        )
    for title, make in (
        ("Friction", report.error_table),
        ("In the loop", report.loop_table),
        ("What each needs", report.needs_table),
    ):
        table = make(comparison)
        console.print(_printed(table, title))
        tell(table.caption)
    tell(report.ahead_text(comparison))
    tell(report.outcome_text(comparison, options.seeds))
    tell(f"Report: {out / 'report.html'}")
    return not comparison.broken


def _write_lines(path: Path, lines: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(lines)


def _init(options: argparse.Namespace) -> bool:
    console = Console(quiet=options.quiet)
    with console.status("looking at the robot"):
        made = init_robot(options.urdf, options.out, name=options.name, recording=options.recording)
    table = Table(title=made.description.stem, show_header=False, title_justify="left")
    for what, path in (
        ("description", made.description),
        ("scenario", made.scenario),
        ("map of recordings", made.log_map),
        ("picture", made.picture),
    ):
        table.add_row(what, Text(str(path)))
    console.print(table)
    for remark in made.remarks:
        console.print(remark, highlight=False, markup=False, soft_wrap=True)
    for problem in made.problems:
        print(f"fbse: {made.scenario}: {problem}", file=sys.stderr)
    console.print(f"Next: fbse simulate {made.scenario}", highlight=False, soft_wrap=True)
    return not made.problems


def _list(options: argparse.Namespace) -> bool:
    kinds = [options.what] if options.what else LISTED
    found = {kind: listing(kind) for kind in kinds}
    if options.json:
        print(to_json(found, indent=2))
        return True
    console = Console(quiet=options.quiet)
    for kind, lines in found.items():
        table = Table(title=kind, show_header=False, title_justify="left", box=None)
        for name, text in lines.items():
            table.add_row(Text(name), Text(text))
        console.print(table)
    return True


def _schema(options: argparse.Namespace) -> bool:
    if not options.quiet:
        print(to_json(json_schema(), indent=2))
    return True


@contextmanager
def _extra_installed(what: str) -> Iterator[None]:
    """Says what to install if an import inside fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("fbse_drake"):
            raise
        needed = "pip install 'fbse_drake[cluster]'"
        raise InputError(f"{what} need {error.name}: {needed}") from None


def _write_run(console: Console, out: Path, result: RunResult) -> None:
    """Writes log, metrics, scenario and report, and says what came out."""
    with console.status("writing the report"):
        result.save(out)
    console.print(_summary(result.name, result.metrics))
    if step := law_step(result.metrics["friction_law_error"]):
        console.print(Text(str(step)), soft_wrap=True)
    console.print(f"Report: {out / 'report.html'}", soft_wrap=True)


def _output_folder(options: argparse.Namespace, suffix: str) -> Path:
    """The folder for the results, made if need be.

    Args:
        suffix: of its default name.
    """
    path = options.out or Path("out") / f"{options.name or Path(options.scenario).stem}{suffix}"
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {path}: {error.strerror}") from None
    if not os.access(path, os.W_OK):
        raise InputError(f"--out {path}: this folder cannot be written to")
    return path


def _start_meshcat(console: Console) -> Meshcat:
    # On this machine alone.
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    # From the right front, near enough for a robot.
    camera, target = [2.2, -2.2, 1.3], [0.2, 0.0, 0.5]
    meshcat.SetCameraPose(camera, target)  # type: ignore[arg-type]
    console.print(f"Watch the run at {meshcat.web_url()}")
    return meshcat


@contextmanager
def _progress(console: Console, title: str, duration: float) -> Iterator[Callable[[float], None]]:
    """A bar over simulated or recorded time; its value is the function to call with it."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.1f} of {task.total:.1f} s"),
        TimeElapsedColumn(),
    )
    with ProgressBar(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(title, total=duration)
        yield lambda time: bar.update(task, completed=time)


def _summary(name: str, metrics: dict[str, Any]) -> Group:
    table = Table(title=name, show_header=False, title_justify="left")
    table.add_row("outcome", metrics["outcome"])
    table.add_row("length", f"{metrics['simulated_time']:.2f} s")
    table.add_row("real time factor", f"{metrics['real_time_factor']:.2f}")
    tracking, creep, tick = (
        metrics[key] for key in ("joint_tracking_rms", "stance_creep_max", "tick_us")
    )
    law = metrics["friction_law_error"]
    worst, farthest = worst_joint(tracking), worst_joint(law)
    largest = max((value for value in creep.values() if not np.isnan(value)), default=np.nan)
    for label, values, text in (
        ("joint tracking rms, worst", tracking, f"{1e3 * tracking[worst]:.2f} mrad ({worst})"),
        ("torque less its law, worst", law, f"{percent(law[farthest])} ({farthest})"),
        (
            "CoM error, mean",
            metrics["com_rse_mean"],
            _by_name(metrics["com_rse_mean"], "{:.2f} mm", 1e3),
        ),
        ("stance creep, largest", creep, f"{1e3 * largest:.3f} mm"),
        (
            "attitude error, rms",
            metrics["attitude_rmse_deg"],
            _by_name(metrics["attitude_rmse_deg"], "{:.3f} deg"),
        ),
        (
            "base velocity error, rms",
            metrics["base_velocity_rmse"],
            _by_name(metrics["base_velocity_rmse"], "{:.2f} mm/s", 1e3),
        ),
        (
            "estimator tick",
            tick,
            f"median {tick['median']:.0f} µs, 99 % below {tick['p99']:.0f} µs",
        ),
    ):
        if not _unknown(values):
            table.add_row(label, text)
    return Group(table, *_friction_summary(metrics))


def _friction_summary(metrics: dict[str, Any]) -> list[Table]:
    """The errors of the friction estimate by joint, if there is one and the truth is known."""
    nrmse = metrics["friction_nrmse"]
    if all(_unknown(values) for values in nrmse.values()):
        return []
    table = Table("joint", *nrmse, title="friction error, NRMSE", title_justify="left")
    for joint in metrics["joint_tracking_rms"]:
        table.add_row(joint, *(percent(values[joint]) for values in nrmse.values()))
    return [table]


def _by_name(values: Mapping[str, float], text: str, scale: float = 1.0) -> str:
    return ", ".join(f"{name} {text.format(scale * value)}" for name, value in values.items())


def _unknown(values: Mapping[str, float]) -> bool:
    return all(np.isnan(value) for value in values.values())


COMMANDS: dict[str, Callable[[argparse.Namespace], bool]] = {
    "simulate": _simulate,
    "estimate": _estimate,
    "compare": _compare,
    "diagnose": _diagnose,
    "study": _study,
    "identify": _identify,
    "report": _report,
    "convert": _convert,
    "add": _add,
    "hide": _hide,
    "reveal": _reveal,
    "campaign": _campaign,
    "table": _table,
    "init": _init,
    "list": _list,
    "schema": _schema,
    "rivals": _rivals,
}
