"""The `fbse` command. Exit status: 0 done, 1 the run failed (what was recorded is written), 2 bad input."""

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from pydrake.geometry import Meshcat, StartMeshcat
from rich.console import Console, Group
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from fbse_drake.errors import InputError, located
from fbse_drake.estimate import estimate
from fbse_drake.files import write_text
from fbse_drake.log import Log
from fbse_drake.report.metrics import run_metrics, write_json
from fbse_drake.report.run import write_run_report
from fbse_drake.scenario import Scenario, dump_scenario, read_scenario
from fbse_drake.simulate import simulate

DONE, FAILED, BAD_INPUT = 0, 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command line; returns the exit status."""
    try:
        options = _parser().parse_args(arguments)
        return options.run(options)
    except InputError as error:
        print(f"fbse: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("fbse: interrupted; no file was left half-written", file=sys.stderr)
        return FAILED


def entry() -> None:
    """The console script."""
    sys.exit(main())


class _Parser(argparse.ArgumentParser):
    """Complains in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="fbse", description="Find the friction, and the missing physics, of a legged robot.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    run = commands.add_parser("simulate", help="run a scenario", description="Simulates a scenario; writes log, metrics and report.")
    _add_scenario(run)
    run.add_argument("--meshcat", action="store_true", help="show the run in a browser; also writes meshcat.html")
    _add_output(run, "out/ and the name of the scenario or of its file")
    run.set_defaults(run=_simulate)

    run = commands.add_parser(
        "estimate",
        help="run a scenario's estimator over a recorded log",
        description="Runs a scenario's estimator over a recorded log; writes the log with the estimates, metrics and report.",
    )
    _add_scenario(run)
    run.add_argument("log", metavar="LOG", type=Path, help="a log file (npz), from a simulation or from a robot")
    _add_output(run, "as for simulate, with _estimate at its end")
    run.set_defaults(run=_estimate)
    return parser


def _add_scenario(run: argparse.ArgumentParser) -> None:
    run.add_argument("scenario", metavar="SCENARIO", help="a YAML file, or the name of one in scenarios/")
    run.add_argument("--name", help="which scenario of the file (default: its only one, or the one called like the file)")
    run.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], dest="overrides", help="changes a value, as in seed=3; repeatable"
    )


def _add_output(run: argparse.ArgumentParser, default: str) -> None:
    run.add_argument("--out", metavar="DIR", type=Path, help=f"where the results go (default: {default})")
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _simulate(options: argparse.Namespace) -> int:
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
    out = _output_folder(options, "")
    console = Console(quiet=options.quiet)
    meshcat = _start_meshcat(console) if options.meshcat else None
    with located(f"{options.scenario}: "), _progress(console, f"simulating {name}", scenario.duration) as progress:
        result = simulate(scenario, name=name, meshcat=meshcat, progress=progress)
    _write_results(console, out, name, scenario, result.log, run_metrics(result.log, result.wall_time))
    if meshcat is not None:
        write_text(out / "meshcat.html", meshcat.StaticHtml())
    if result.failure is not None:
        print(f"fbse: {name}: {result.failure}; what was recorded until then is in {out}", file=sys.stderr)
        return FAILED
    return DONE


def _estimate(options: argparse.Namespace) -> int:
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
    log = Log.load(options.log)
    out = _output_folder(options, "_estimate")
    if (out / "log.npz").exists() and (out / "log.npz").samefile(options.log):
        raise InputError(f"--out {out}: the log with the estimates would overwrite {options.log}")
    console = Console(quiet=options.quiet)
    start, end = float(log.time[0]), float(log.time[-1])
    with located(f"{options.scenario} over {options.log}: "), _progress(console, f"estimating with {name}", end - start) as progress:
        result = estimate(scenario, log, progress=lambda time: progress(time - start))
    estimated = replace(result.log, meta=result.log.meta | {"estimator_scenario": dump_scenario(scenario, name)})
    metrics = run_metrics(estimated, float(result.tick_time.sum()), result.tick_time)
    _write_results(console, out, name, scenario, estimated, metrics)
    return DONE


def _write_results(console: Console, out: Path, name: str, scenario: Scenario, log: Log, metrics: dict[str, Any]) -> None:
    """Writes log, metrics, scenario and report, and says what came out."""
    with console.status("writing the report"):
        log.save(out / "log.npz")
        write_json(out / "metrics.json", metrics)
        write_text(out / "scenario.yaml", dump_scenario(scenario, name))
        write_run_report(out / "report.html", log, metrics, name=name)
    console.print(_summary(name, metrics))
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
    columns = (TextColumn(title), BarColumn(), TextColumn("{task.completed:.1f} of {task.total:.1f} s"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=duration)
        yield lambda time: bar.update(task, completed=time)


def _summary(name: str, metrics: dict[str, Any]) -> Group:
    table = Table(title=name, show_header=False, title_justify="left")
    table.add_row("outcome", metrics["outcome"])
    table.add_row("length", f"{metrics['simulated_time']:.2f} s")
    table.add_row("real time factor", f"{metrics['real_time_factor']:.2f}")
    tracking, creep, tick = (metrics[key] for key in ("joint_tracking_rms", "stance_creep_max", "tick_us"))
    worst = max(tracking, key=tracking.get)
    largest = max((value for value in creep.values() if not np.isnan(value)), default=np.nan)
    for label, values, text in (
        ("joint tracking rms, worst", tracking, f"{1e3 * tracking[worst]:.2f} mrad ({worst})"),
        ("CoM error, mean", metrics["com_rse_mean"], _by_name(metrics["com_rse_mean"], "{:.2f} mm", 1e3)),
        ("stance creep, largest", creep, f"{1e3 * largest:.3f} mm"),
        ("attitude error, rms", metrics["attitude_rmse_deg"], _by_name(metrics["attitude_rmse_deg"], "{:.3f} deg")),
        ("base velocity error, rms", metrics["base_velocity_rmse"], _by_name(metrics["base_velocity_rmse"], "{:.2f} mm/s", 1e3)),
        ("estimator tick", tick, f"median {tick['median']:.0f} µs, 99 % below {tick['p99']:.0f} µs"),
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
        table.add_row(joint, *(_percent(values[joint]) for values in nrmse.values()))
    return [table]


def _by_name(values: Mapping[str, float], text: str, scale: float = 1.0) -> str:
    return ", ".join(f"{name} {text.format(scale * value)}" for name, value in values.items())


def _percent(share: float) -> str:
    return "n/a" if np.isnan(share) else f"{100 * share:.1f} %"


def _unknown(values: Mapping[str, float]) -> bool:
    return all(np.isnan(value) for value in values.values())
