"""The `fbse` command. Exit status: 0 done, 1 the run failed (what was recorded is written), 2 bad input."""

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from pydrake.geometry import Meshcat, StartMeshcat
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from fbse_drake.errors import InputError, located
from fbse_drake.files import write_text
from fbse_drake.report.metrics import simulation_metrics, write_json
from fbse_drake.report.simulation import write_simulation_report
from fbse_drake.scenario import dump_scenario, read_scenario
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
    run.add_argument("scenario", metavar="SCENARIO", help="a YAML file, or the name of one in scenarios/")
    run.add_argument("--name", help="which scenario of the file (default: its only one, or the one called like the file)")
    run.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], dest="overrides", help="changes a value, as in seed=3; repeatable"
    )
    run.add_argument("--meshcat", action="store_true", help="show the run in a browser; also writes meshcat.html")
    run.add_argument(
        "--out", metavar="DIR", type=Path, help="where the results go (default: out/ and the name of the scenario or of its file)"
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")
    run.set_defaults(run=_simulate)
    return parser


def _simulate(options: argparse.Namespace) -> int:
    name, scenario = read_scenario(options.scenario, options.name, options.overrides)
    out = _output_folder(options.out or Path("out") / (options.name or Path(options.scenario).stem))
    console = Console(quiet=options.quiet)
    meshcat = _start_meshcat(console) if options.meshcat else None
    with located(f"{options.scenario}: "), _progress(console, f"simulating {name}", scenario.duration) as progress:
        result = simulate(scenario, name=name, meshcat=meshcat, progress=progress)
    with console.status("writing the report"):
        metrics = simulation_metrics(result.log, result.wall_time)
        result.log.save(out / "log.npz")
        write_json(out / "metrics.json", metrics)
        write_text(out / "scenario.yaml", dump_scenario(scenario, name))
        write_simulation_report(out / "report.html", result.log, metrics, name=name)
        if meshcat is not None:
            write_text(out / "meshcat.html", meshcat.StaticHtml())
    console.print(_summary(name, metrics))
    console.print(f"Report: {out / 'report.html'}", highlight=False, soft_wrap=True)
    if result.failure is not None:
        print(f"fbse: {name}: {result.failure}; what was recorded until then is in {out}", file=sys.stderr)
        return FAILED
    return DONE


def _output_folder(path: Path) -> Path:
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
    """A bar over simulated time; its value is the function to call with it."""
    columns = (TextColumn(title), BarColumn(), TextColumn("{task.completed:.1f} of {task.total:.1f} s"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=duration)
        yield lambda time: bar.update(task, completed=time)


def _summary(name: str, metrics: dict[str, Any]) -> Table:
    table = Table(title=name, show_header=False, title_justify="left")
    table.add_row("outcome", metrics["outcome"])
    table.add_row("simulated time", f"{metrics['simulated_time']:.2f} s")
    table.add_row("real time factor", f"{metrics['real_time_factor']:.2f}")
    tracking = metrics["joint_tracking_rms"]
    worst = max(tracking, key=tracking.get)
    table.add_row("joint tracking rms, worst", f"{1e3 * tracking[worst]:.2f} mrad ({worst})")
    rse = metrics["com_rse_mean"]
    if not np.isnan(rse["x"]):
        table.add_row("CoM error, mean", f"x {1e3 * rse['x']:.2f} mm, y {1e3 * rse['y']:.2f} mm")
    creep = np.array(list(metrics["stance_creep_max"].values()))
    if not np.isnan(creep).all():
        table.add_row("stance creep, largest", f"{1e3 * np.nanmax(creep):.3f} mm")
    return table
