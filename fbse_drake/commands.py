"""What the `fbse` commands do; each says whether it came to its end."""

import argparse
import csv
import json
import os
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, StartMeshcat
from rich.console import Console, Group
from rich.markup import escape
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table
from rich.text import Text

from fbse_drake.discrepancy.diagnosis.add import add, read_findings
from fbse_drake.discrepancy.diagnosis.compare import compare, comparison_json
from fbse_drake.discrepancy.diagnosis.diagnose import Finding, diagnose, diagnosis_json
from fbse_drake.discrepancy.diagnosis.identify import (
    identifiability_text,
    identification_json,
    identify,
)
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import study, study_json, train_and_rest
from fbse_drake.discrepancy.diagnosis.validation import validated
from fbse_drake.discrepancy.exercises.hidden import hide, reveal
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene, hygiene_json, inspect
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.errors import InputError, located
from fbse_drake.estimate import estimate
from fbse_drake.files import write_atomically, write_text
from fbse_drake.interop.convert import read_log, read_logs
from fbse_drake.interop.export import writer_for
from fbse_drake.log import Log
from fbse_drake.progress import Progress, ProgressLines
from fbse_drake.report.discrepancy import (
    Inputs,
    compare_outcome,
    diagnosis_outcome,
    parameter_text,
    parameters_text,
    study_outcome,
    write_compare_report,
    write_diagnosis_report,
    write_study_report,
)
from fbse_drake.report.discrepancy_figures import by_effect, spaced, targets_text
from fbse_drake.report.html import number, percent
from fbse_drake.report.identification import (
    BASE_HEADER,
    ERROR_HEADER,
    base_row,
    error_rows,
    identification_outcome,
    write_identification_report,
)
from fbse_drake.report.metrics import run_metrics, worst_joint, write_json
from fbse_drake.report.run import law_sentence, write_run_report
from fbse_drake.scenario import Scenario, dump_scenario, read_scenario
from fbse_drake.simulate import simulate

# Failures and findings that are printed.
_SHOWN = 8
# A line that changes does so this often [s].
_STATUS_PERIOD = 0.5
# Beginning of what `fbse add` writes.
_ADDED = "# Effects added by fbse add"


def _simulate(options: argparse.Namespace) -> bool:
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
    out = _output_folder(options, "")
    console = Console(quiet=options.quiet)
    meshcat = _start_meshcat(console) if options.meshcat else None
    with (
        located(f"{options.scenario}: "),
        _progress(console, f"simulating {name}", scenario.duration) as progress,
    ):
        result = simulate(scenario, name=name, meshcat=meshcat, progress=progress)
    _write_results(
        console, out, name, scenario, result.log, run_metrics(result.log, result.wall_time)
    )
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
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
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
        result = estimate(scenario, log, progress=lambda time: progress(time - start))
    estimated = replace(
        result.log, meta=result.log.meta | {"estimator_scenario": dump_scenario(scenario, name)}
    )
    metrics = run_metrics(estimated, float(result.tick_time.sum()), result.tick_time)
    _write_results(console, out, name, scenario, estimated, metrics)
    for remark in result.remarks:
        console.print(remark, highlight=False, markup=False, soft_wrap=True)
    return True


def _compare(options: argparse.Namespace) -> bool:
    console, scenario, inputs, log, out = _scenario_and_log(options, "_compare")
    with _errors_located(options), console.status("comparing the model with the log"):
        # Nothing is fitted, so nothing is set aside.
        predictor = _checked(scenario, log)
        inputs = replace(inputs, hygiene=inspect(predictor.motion, predictor.noise))
        comparison = compare(predictor)
    _write_findings(out, "compare", comparison_json(comparison), scenario, inputs)
    with console.status("writing the report"):
        write_compare_report(out / "report.html", comparison, predictor, inputs)
    table = Table("failure, worst first", title=inputs.name, title_justify="left")
    for failure in comparison.failures[:_SHOWN]:
        table.add_row(failure.text)
    _conclude(console, out, inputs.hygiene, compare_outcome(comparison), table)
    return True


def _diagnose(options: argparse.Namespace) -> bool:
    console, scenario, inputs, log, out = _scenario_and_log(options, "_diagnose")
    train, tests = _train_and_tests(scenario, log, options)
    with _errors_located(options), _told(console, options.time_limit) as progress:
        predictor = _checked(scenario, train)
        inputs = replace(
            inputs,
            hygiene=inspect(predictor.motion, predictor.noise),
            tests=tuple(map(str, options.test)),
        )
        comparison = compare(predictor)
        trusted = inputs.hygiene.trusted(scenario, predictor.robot)
        diagnosis = diagnose(Predictor(trusted, train), progress=progress)
        if diagnosis.chosen:
            completed = add(trusted, diagnosis.chosen)
            set_aside = {
                name: validated(Predictor(trusted, test), Predictor(completed, test))
                for name, test in tests.items()
            }
            diagnosis = replace(diagnosis, set_aside=set_aside)
    _write_findings(out, "diagnosis", diagnosis_json(diagnosis), scenario, inputs)
    with console.status("writing the report"):
        write_diagnosis_report(out / "report.html", diagnosis, comparison, predictor, inputs)
    _conclude(
        console,
        out,
        inputs.hygiene,
        diagnosis_outcome(diagnosis),
        _findings_table(inputs.name, diagnosis.ranking[:_SHOWN]),
    )
    return diagnosis.partial is None


def _study(options: argparse.Namespace) -> bool:
    console, scenario, inputs, log, out = _scenario_and_log(options, "_study")
    train, tests = _train_and_tests(scenario, log, options)
    with _errors_located(options), _told(console, options.time_limit) as progress:
        predictor = _checked(scenario, train)
        inputs = replace(
            inputs,
            hygiene=inspect(predictor.motion, predictor.noise),
            tests=tuple(map(str, options.test)),
        )
        comparison = compare(predictor)
        scenario = inputs.hygiene.trusted(scenario, predictor.robot)
        result = study(scenario, train, tests=tests, progress=progress, jobs=options.jobs)
        after = Predictor(result.scenario, train) if result.found else predictor
        completed = (after, compare(after) if result.found else comparison)
    _write_findings(out, "study", study_json(result), scenario, inputs)
    if result.found:
        write_text(out / "completed.yaml", dump_scenario(result.scenario, inputs.name))
    with console.status("writing the report"):
        write_study_report(
            out / "report.html", result, (predictor, comparison), completed, inputs, tests
        )
    relative = (
        [name for name, error in result.steps[0].errors.items() if np.isfinite(error.relative)]
        if tests
        else []
    )
    columns = [f"relative error, {name}" for name in relative]
    table = Table(
        "added",
        "held-out error / noise",
        "fitted error / noise",
        *columns,
        title=inputs.name,
        title_justify="left",
    )
    for step in result.steps:
        effects = [
            f"{spaced(effect)} ({targets_text(targets)})"
            for effect, targets in by_effect(step.added).items()
        ]
        added = ", ".join(effects) or "the model as given"
        shares = (f"{100 * step.errors[name].relative:.2f} %" for name in relative)
        table.add_row(added, number(step.held_out_rmse), number(step.train_rmse), *shares)
    _conclude(
        console,
        out,
        inputs.hygiene,
        f"{study_outcome(result)} Stopped because {result.stopped_because}.",
        table,
    )
    return not result.partial


def _identify(options: argparse.Namespace) -> bool:
    console, scenario, inputs, log, out = _scenario_and_log(options, "_identify")
    train, tests = _train_and_tests(scenario, log, options)
    with _errors_located(options), _told(console) as progress:
        predictor = _checked(scenario, train)
        inputs = replace(inputs, hygiene=inspect(predictor.motion, predictor.noise))
        result = identify(scenario, train, tests, progress=progress)
    _write_findings(out, "identify", identification_json(result), scenario, inputs)
    write_text(out / "completed.yaml", dump_scenario(result.scenario, inputs.name))
    write_identification_report(out / "report.html", result, inputs.name)
    console.print(identifiability_text(result.inertia), highlight=False)
    table = Table(*BASE_HEADER, title=inputs.name, title_justify="left")
    for base in result.inertia.base_parameters:
        table.add_row(
            f"{base.body} {base.parameter}{', with others' if base.others else ''}",
            *base_row(base)[1:],
        )
    console.print(table)
    errors = Table(*ERROR_HEADER)
    for row in error_rows(result):
        errors.add_row(*row)
    _conclude(console, out, inputs.hygiene, identification_outcome(result), errors)
    return True


def _train_and_tests(
    scenario: Scenario, log: Log, options: argparse.Namespace
) -> tuple[Log, dict[str, Log]]:
    """What models are fitted to, and logs to test them on, by name."""
    train, rest = train_and_rest(scenario, log)
    tests = {"rest of the log": rest} if rest is not None else {}
    return train, tests | {path.stem: read_log(path, options.map) for path in options.test}


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
            raise InputError(
                f"{findings[0]}{f' (and {len(findings) - 1} more findings)' if findings[1:] else ''}"
            )
        status.update(f"writing {escape(out.name)}")
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            write(log, out)
        except OSError as error:
            raise InputError(f"{out}: {error.strerror or error}") from None
    table = Table(title=escape(str(out)), show_header=False, title_justify="left")
    table.add_row(
        "rows",
        f"{len(log.time)} in {log.time[-1] - log.time[0]:.6g} s, nominally {log.meta['period']:g} s apart",
    )
    table.add_row("joints", ", ".join(log.joints))
    table.add_row("channels", ", ".join(name for name in log if name != "time"))
    for finding in findings:
        table.add_row("left out", escape(finding))
    console.print(table)
    return True


def _scenario_and_log(
    options: argparse.Namespace, suffix: str
) -> tuple[Console, Scenario, Inputs, Log, Path]:
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
    log = read_log(options.log, options.map)
    out = _output_folder(options, suffix)
    return (
        Console(quiet=options.quiet),
        scenario,
        Inputs(name, options.scenario, str(options.log), str(out)),
        log,
        out,
    )


def _errors_located(options: argparse.Namespace) -> AbstractContextManager[None]:
    return located(f"{options.scenario} over {options.log}: ")


@contextmanager
def _told(
    console: Console,
    limit: float | None = None,
    *,
    first: str = "comparing the model with the log",
) -> Iterator[Progress]:
    """Tells the progress of long work: in a line that changes, or without a terminal in lines below each other.

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
    lines = ProgressLines(
        lambda line: console.print(line, highlight=False, markup=False, soft_wrap=True), limit
    )
    with lines.stopped_by_keyboard():
        yield lines


def _checked(scenario: Scenario, log: Log) -> Predictor:
    """The scenario's model over a log whose sensors are what they are said to be."""
    predictor = Predictor(scenario, log)
    check_sensors(predictor.motion)
    return predictor


def _write_findings(
    out: Path, kind: str, content: dict[str, Any], scenario: Scenario, inputs: Inputs
) -> None:
    """Writes what was found, under its own name and as metrics.json, and the scenario."""
    content = {**content, "hygiene": hygiene_json(inputs.hygiene)}
    write_json(out / f"{kind}.json", content)
    write_json(out / "metrics.json", content)
    write_text(out / "scenario.yaml", dump_scenario(scenario, inputs.name))


def _conclude(console: Console, out: Path, hygiene: Hygiene, outcome: str, table: Table) -> None:
    """Prints the result, after what is remarkable about the log."""
    if hygiene.findings:
        remarks = Table("data hygiene", "", title_justify="left")
        for finding in hygiene.findings[:_SHOWN]:
            remarks.add_row(finding.severity, finding.text)
        console.print(remarks)
    if table.row_count:
        console.print(table)
    console.print(hygiene.before(outcome), highlight=False)
    console.print(f"Report: {out / 'report.html'}", highlight=False, soft_wrap=True)


def _findings_table(title: str, findings: Sequence[Finding]) -> Table:
    table = Table(
        "effect",
        "in",
        "held-out error before",
        "after",
        "values (95 % interval)",
        title=title,
        title_justify="left",
    )
    for finding in findings:
        name = spaced(finding.effect) if finding.chosen else f"({spaced(finding.effect)})"
        errors = (number(error) for error in (finding.held_out_before, finding.held_out_after))
        cells = (name, targets_text(finding.targets), *errors, parameters_text(finding))
        table.add_row(*map(Text, cells))
    return table


def _add(options: argparse.Namespace) -> bool:
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
    path = options.diagnosis / "diagnosis.json" if options.diagnosis.is_dir() else options.diagnosis
    try:
        diagnosis = json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except ValueError:
        raise InputError(f"{path}: not a JSON file") from None
    with located(f"{path}: "):
        findings = read_findings(diagnosis, options.effect)
        completed = add(scenario, findings)
    out = options.out
    # Nobody's own file is lost.
    if out.is_dir() or (out.exists() and not out.read_bytes().startswith(_ADDED.encode())):
        raise InputError(f"--out {out}: this exists already, and fbse add did not write it")
    if out.exists() and Path(options.scenario).is_file() and out.samefile(options.scenario):
        raise InputError(f"--out {out}: the new scenario would overwrite the old one")
    lines = [
        f"{_ADDED} to {options.scenario}, from {path}.",
        *(f"# {line}" for finding in findings for line in _value_lines(finding)),
    ]
    header = "\n".join(map(_on_one_line, lines))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text(out, f"{header}\n{dump_scenario(completed, name)}")
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror}") from None
    console = Console(quiet=options.quiet)
    console.print(_findings_table(name, findings))
    console.print(f"Scenario: {out}", highlight=False, soft_wrap=True)
    return True


def _on_one_line(text: str) -> str:
    """The text with what is not printable escaped: no file that it comes from can end a comment."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _value_lines(finding: Finding) -> list[str]:
    """Values with their 95 % intervals, and what they bring; for the comments of a scenario."""
    where = f"{finding.effect} in {targets_text(finding.targets)}"
    errors = f"{where}: held-out error {finding.held_out_before:.3g} times the noise before, {finding.held_out_after:.3g} after"
    values = [
        f"{where}: {parameter_text(name, estimate)}, with its 95 % interval"
        for name, estimate in finding.parameters.items()
    ]
    return [errors, *values]


def _hide(options: argparse.Namespace) -> bool:
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
    out = _output_folder(options, "_hidden")
    console = Console(quiet=options.quiet)
    start = clock.perf_counter()
    with (
        located(f"{options.scenario}: "),
        _progress(console, f"simulating {name}", scenario.duration) as progress,
    ):
        hide(
            scenario,
            name,
            options.seed,
            out,
            what=options.what,
            size=options.size,
            count=options.count,
            progress=progress,
        )
    log, (_, public) = Log.load(out / "log.npz"), read_scenario(str(out / "scenario.yaml"))
    _write_results(console, out, name, public, log, run_metrics(log, clock.perf_counter() - start))
    console.print(
        f"Find it: fbse study {out}/scenario.yaml {out}/log.npz --out {out}; then fbse reveal {out}",
        highlight=False,
        soft_wrap=True,
    )
    return True


def _reveal(options: argparse.Namespace) -> bool:
    revealed = reveal(options.folder)
    answer, score = revealed["answer"], revealed["score"]
    write_json(options.folder / "answer.json", revealed)
    console = Console(quiet=options.quiet)
    table = Table(
        "hidden", "in", "values", title=f"{options.folder}: {answer['kind']}", title_justify="left"
    )
    for effect in answer["effects"]:
        values = (
            f"{key} {number(float(next(iter(by_target.values()))))}"
            for key, by_target in effect["parameters"].items()
        )
        table.add_row(spaced(effect["effect"]), targets_text(effect["targets"]), ", ".join(values))
    console.print(table if answer["effects"] else "Nothing was hidden.")
    if score is None:
        console.print(
            f"No diagnosis.json or study.json in {options.folder} to score.", highlight=False
        )
        return True
    verdict = "right" if score["verdict"] else "wrong"
    found = ", ".join(
        f"{spaced(name)} {'found' if hit else 'not found'}" for name, hit in score["found"].items()
    )
    console.print(
        "; ".join(part for part in (f"Verdict: {verdict}", found) if part) + ".", highlight=False
    )
    return True


def _campaign(options: argparse.Namespace) -> bool:
    with _extra_installed("campaigns"):
        from fbse_drake.campaign.campaign import load_campaign
        from fbse_drake.campaign.cluster import run_campaign
    campaign = load_campaign(options.campaign)
    place = options.out or str(Path("out") / options.campaign.stem)
    console = Console(quiet=options.quiet)

    def tell(line: str) -> None:
        console.print(line, highlight=False, markup=False, soft_wrap=True)

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
    shown = Table(*by, "runs", "failed", title=options.folder, title_justify="left")
    for value in values:
        shown.add_column(f"{value} [{units[value]}]" if units[value] else value)
    for row in summaries:
        same, (count, failed), numbers = row[: len(by)], row[len(by) :][:2], row[len(by) + 2 :]
        cells = (
            f"{number(middle)} ({number(low)} to {number(high)})"
            for middle, low, high in zip(*[iter(numbers)] * 3, strict=True)
        )
        shown.add_row(*map(str, same), str(count), str(failed), *cells)
    console.print(shown)
    try:
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
            console.print(f"Picture: {path}", highlight=False, soft_wrap=True)
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror}") from None
    console.print(f"Rows: {out / 'table.csv'}", highlight=False, soft_wrap=True)
    return True


def _write_lines(path: Path, lines: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(lines)


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


def _write_results(
    console: Console, out: Path, name: str, scenario: Scenario, log: Log, metrics: dict[str, Any]
) -> None:
    """Writes log, metrics, scenario and report, and says what came out."""
    with console.status("writing the report"):
        log.save(out / "log.npz")
        write_json(out / "metrics.json", metrics)
        write_text(out / "scenario.yaml", dump_scenario(scenario, name))
        write_run_report(out / "report.html", log, metrics, name=name)
    console.print(_summary(name, metrics))
    if sentence := law_sentence(metrics["friction_law_error"]):
        console.print(sentence, highlight=False, markup=False, soft_wrap=True)
    console.print(f"Report: {out / 'report.html'}", highlight=False, soft_wrap=True)


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
    meshcat = StartMeshcat()
    # From the right front, near enough for a robot.
    meshcat.SetCameraPose([2.2, -2.2, 1.3], [0.2, 0.0, 0.5])
    console.print(f"Watch the run at {meshcat.web_url()}", highlight=False)
    return meshcat


@contextmanager
def _progress(console: Console, title: str, duration: float) -> Iterator[Callable[[float], None]]:
    """A bar over simulated or recorded time; its value is the function to call with it."""
    columns = (
        TextColumn(title),
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
    "convert": _convert,
    "add": _add,
    "hide": _hide,
    "reveal": _reveal,
    "campaign": _campaign,
    "table": _table,
}
