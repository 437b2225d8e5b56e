"""The `fbse` command line.

Exit status: 0 done, 1 the run failed or was interrupted (what is known is written), 2 bad input.
"""

import argparse
import errno
import gc
import io
import os
import sys
import textwrap
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from fbse_drake.entry import FAILED, INTERRUPTED, end_as_at_ctrl_c, keep_what_is_known
from fbse_drake.errors import InputError, on_one_line

DONE, BAD_INPUT = 0, 2
# Objects that may be made before those that hold each other are looked for.
_COLLECTED = 100_000
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
# What can be listed.
LISTED = ("scenarios", "robots", "effects", "estimators", "sensors", "compensations")
_FIRST_STEPS = """first steps:
  fbse simulate squat
  fbse list effects
  fbse study paper_walk out/paper_walk/log.npz

To complete commands with the tab key: pip install 'fbse_drake[completion]', then
eval "$(register-python-argcomplete fbse)" in your shell's start-up file."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command line; returns the exit status."""
    try:
        parser = _parser()
        if "_ARGCOMPLETE" in os.environ:
            _complete(parser)
        options = parser.parse_args(arguments)
        # Matrices are small here: more threads of the linear algebra wait for each other, at three
        # times the cost.
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            os.environ.setdefault(name, "1")
        if "workers" in options and not getattr(options, "scheduler", None):
            from fbse_drake.campaign.workers import begin_to_import

            begin_to_import()
        # What the commands need takes seconds to import: `fbse --help` must not wait for it.
        from fbse_drake.commands import COMMANDS

        keep_what_is_known()
        return DONE if COMMANDS[options.command](options) else FAILED
    except InputError as error:
        _complain(str(error))
        return BAD_INPUT
    except KeyboardInterrupt:
        _complain(INTERRUPTED)
    except MemoryError:
        _complain("there is not enough memory for this; no file was left half-written")
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _complain(f"{place}{error.strerror or error}; no file was left half-written")
        # That a disk is full is nobody's wrong input; that a folder cannot be written to is.
        return FAILED if error.errno in _DISK else BAD_INPUT
    return FAILED


def _complain(line: str) -> None:
    print(f"fbse: {on_one_line(line)}", file=sys.stderr)


def entry() -> None:
    """The command. It ends at SIGTERM and SIGHUP as it does at Ctrl-C."""
    end_as_at_ctrl_c()
    # By default all that lives is looked through so often that it is a tenth of a diagnosis' time.
    gc.set_threshold(_COLLECTED)
    for stream in (sys.stdout, sys.stderr):
        # What a terminal of an old locale cannot show becomes a question mark.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    status = main()
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        from fbse_drake.console import silence_stdout

        silence_stdout()
    sys.exit(status)


class _Parser(argparse.ArgumentParser):
    """Complains in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


class _Version(argparse.Action):
    """Prints the version, which takes longer to find than all of the help."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        import fbse_drake

        print(f"{parser.prog} {fbse_drake.__version__}")
        parser.exit()


def _complete(parser: argparse.ArgumentParser) -> None:
    """Answers a shell that wants to complete a command line, if argcomplete is installed."""
    with suppress(ModuleNotFoundError):
        import argcomplete

        argcomplete.autocomplete(parser)


def _scenario_names(prefix: str, **_: object) -> list[str]:
    """Scenarios that ship with the package, and files, for completion."""
    from argcomplete.completers import FilesCompleter

    from fbse_drake.resources import shipped

    names = [name for name in shipped("scenarios") if name.startswith(prefix)]
    return [*names, *FilesCompleter(("yaml",))(prefix)]


def _add_command(
    commands: Any, name: str, *, help: str, description: str, examples: Sequence[str]
) -> argparse.ArgumentParser:
    lines = "\n".join(f"  {example}" for example in examples)
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=help,
        description=textwrap.fill(description, 79),
        epilog=f"examples:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return command


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="fbse",
        description="Find the friction, and the missing physics, of a legged robot.",
        epilog=_FIRST_STEPS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=_Parser
    )

    run = _add_command(
        commands,
        "simulate",
        help="run a scenario",
        description="Simulates a scenario; writes log, metrics and report.",
        examples=(
            "fbse simulate squat",
            (
                "fbse simulate paper_walk --set reference.step_length=0.05 --set seed=3 --out "
                "out/short"
            ),
            "fbse simulate my_scenario.yaml --meshcat",
        ),
    )
    _add_scenario(run)
    run.add_argument(
        "--meshcat", action="store_true", help="show the run in a browser; also writes meshcat.html"
    )
    _add_output(run, "out/ and the name of the scenario or of its file")

    run = _add_command(
        commands,
        "estimate",
        help="run a scenario's estimator over a recorded log",
        description=(
            "Runs a scenario's estimator over a recorded log; writes the log with the "
            "estimates, metrics and report."
        ),
        examples=(
            "fbse estimate paper_walk_fbse out/paper_walk/log.npz",
            "fbse estimate paper_walk_fbse --name paper_method out/paper_walk/log.npz",
            "fbse estimate my_robot.yaml recording.mcap",
        ),
    )
    _add_scenario(run)
    _add_log(run)
    _add_output(run, "as for simulate, with _estimate at its end")

    for name, file, short, description, examples in (
        (
            "compare",
            "compare",
            "where a scenario's model fails on a log",
            "Says where a scenario's model fails on a log.",
            (
                "fbse compare paper_walk out/paper_walk/log.npz",
                "fbse compare my_robot.yaml recording.csv --map my_map.yaml",
            ),
        ),
        (
            "diagnose",
            "diagnosis",
            "which physical effect a model lacks",
            "Finds the physical effects that a scenario's model lacks, on a log.",
            (
                "fbse diagnose paper_walk out/paper_walk/log.npz",
                "fbse diagnose my_robot.yaml monday.npz --test tuesday.npz --time-limit 300",
            ),
        ),
        (
            "identify",
            "identify",
            "inertial parameters and plain friction",
            (
                "Identifies the inertial parameters that a scenario does not trust "
                "(identify.inertia), with plain friction."
            ),
            ("fbse identify real/ur10 ur10_exciting_trajectory.db3",),
        ),
        (
            "study",
            "study",
            "diagnose, add, and again",
            "Adds what a scenario's model lacks until a log shows nothing more.",
            (
                "fbse study paper_walk out/paper_walk/log.npz",
                "fbse study my_robot.yaml monday.npz --test tuesday.npz --jobs 2",
            ),
        ),
    ):
        run = _add_command(
            commands,
            name,
            help=short,
            description=f"{description} Writes {file}.json and a report.",
            examples=examples,
        )
        _add_scenario(run)
        if name in ("diagnose", "identify"):
            run.add_argument(
                "logs",
                metavar="LOG",
                type=Path,
                nargs="+",
                help="a log file (npz), or a recording (see convert); several are fitted together",
            )
            _add_map(run)
        else:
            _add_log(run)
        if name != "compare":
            run.add_argument(
                "--test",
                metavar="LOG",
                type=Path,
                action="append",
                default=[],
                help="another log to test on; nothing is fitted to it",
            )
        if name in ("diagnose", "study"):
            run.add_argument(
                "--time-limit",
                metavar="SECONDS",
                type=_positive_number,
                help="end after this time with what is known then (also: Ctrl-C)",
            )
        if name in ("diagnose", "study"):
            run.add_argument(
                "--jobs",
                metavar="N",
                type=_positive_whole_number,
                help="do so many things side by side: predict, search, draw, simulate "
                "(default: one for each core on Linux, else 1)",
            )
        _add_output(run, f"as for simulate, with _{name} at its end")

    run = _add_command(
        commands,
        "convert",
        help="make a log of a recording, or a bag of a log",
        description=(
            "Makes a log of recordings (ROS bags, CSV, JSON, MATLAB, npz), or of a log a "
            "file for other programs (mcap, csv)."
        ),
        examples=(
            "fbse convert recording.mcap recording.npz",
            "fbse convert run1.csv run2.csv recording.npz --map my_map.yaml",
            "fbse convert out/paper_walk/log.npz walk.mcap",
        ),
    )
    run.add_argument(
        "inputs",
        metavar="IN",
        type=Path,
        nargs="+",
        help="a recording or a log; several recordings become one log",
    )
    run.add_argument(
        "out", metavar="OUT", type=Path, help="the file to write: .npz (a log), .mcap or .csv"
    )
    _add_map(run)
    run.add_argument(
        "--strict",
        action="store_true",
        help="refuse recordings of which something must be left out",
    )
    run.add_argument("--force", action="store_true", help="replace OUT if it exists")
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "add",
        help="add what a diagnosis found to a scenario's model",
        description="Writes a scenario whose model has what a diagnosis found.",
        examples=(
            "fbse add paper_walk out/paper_walk_diagnose --out completed.yaml",
            (
                "fbse add paper_walk out/paper_walk_diagnose --effect StribeckFriction --out "
                "completed.yaml"
            ),
        ),
    )
    _add_scenario(run)
    run.add_argument(
        "diagnosis",
        metavar="DIAGNOSIS",
        type=Path,
        help="what diagnose wrote: its folder, or diagnosis.json",
    )
    run.add_argument(
        "--effect",
        help="an effect of the diagnosis' ranking (default: all that the diagnosis chose)",
    )
    run.add_argument(
        "--out",
        metavar="NEW_SCENARIO",
        type=Path,
        required=True,
        help="the new scenario's file (yaml)",
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "hide",
        help="make an exercise: a log with a hidden effect",
        description=(
            "Hides an effect in a scenario's robot and writes the log without it in the "
            "model, and the answer sealed (see reveal)."
        ),
        examples=(
            "fbse hide paper_walk --seed 7 --out out/mystery",
            "fbse hide paper_walk --seed 7 --what decoy --out out/decoy",
        ),
    )
    _add_scenario(run)
    run.add_argument(
        "--seed",
        type=_whole_number,
        required=True,
        help="decides on what is hidden and on the sensors' noise",
    )
    run.add_argument(
        "--what",
        default="any",
        help=(
            "any, library, decoy (nothing), stranger (none of the library) or the name of an effect"
        ),
    )
    run.add_argument(
        "--size",
        choices=("small", "medium", "large"),
        help="how large it is (default: drawn as well)",
    )
    run.add_argument(
        "--count", type=_whole_number, default=1, help="how many effects are hidden (default: 1)"
    )
    _add_output(run, "as for simulate, with _hidden at its end")

    run = _add_command(
        commands,
        "reveal",
        help="open the answer of an exercise",
        description="Opens the answer of an exercise, and scores what was found in its folder.",
        examples=("fbse reveal out/mystery",),
    )
    run.add_argument("folder", metavar="DIR", type=Path, help="what hide wrote")
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "rivals",
        help="every method of estimating the friction against each other",
        description="Tunes every estimator that fits a scenario on another walk, each in as many "
        "trials, and compares them on the "
        "same walks and sensors; writes rivals.json and a report. The same command "
        "goes on where it was stopped.",
        examples=(
            "fbse rivals paper_walk --seeds 1 --set duration=4",
            "fbse rivals hrp2_walk_fbse --case 'a push' --case 'biased IMU' --out out/rivals",
            "fbse rivals my_scenario.yaml --seeds 10 --trials 12 --workers 2",
        ),
    )
    _add_scenario(run)
    run.add_argument(
        "--seeds",
        metavar="N",
        type=_positive_whole_number,
        default=3,
        help="walks of every case (default: 3)",
    )
    run.add_argument(
        "--trials",
        metavar="N",
        type=_positive_whole_number,
        default=8,
        help="settings that are tried of each estimator (default: 8)",
    )
    run.add_argument(
        "--case",
        action="append",
        help=(
            "only this case beside the walk as believed, as in 'a push'; repeatable (default: all)"
        ),
    )
    run.add_argument(
        "--workers",
        metavar="N",
        type=_positive_whole_number,
        help="processes (default: one for each core)",
    )
    _add_output(run, "as for simulate, with _rivals at its end")

    run = _add_command(
        commands,
        "report",
        help="runs beside each other in one report",
        description="Puts the figures of runs side by side, the best of each marked, and their "
        "pictures with the same axes; writes report.json and report.html.",
        examples=(
            "fbse report out/paper_walk out/paper_walk_fbse",
            "fbse report out/a out/b/log.npz monday.npz --out out/week",
        ),
    )
    run.add_argument(
        "runs",
        metavar="RUN",
        type=Path,
        nargs="+",
        help="a folder that simulate or estimate wrote, or a log; differences are from the first",
    )
    run.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("out/report"),
        help="where the files go (default: out/report)",
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "campaign",
        help="many runs at once, on this machine or a Dask cluster",
        description=(
            "Does the runs of a campaign that are not done, each of which becomes a row of "
            "a table; the same command goes on."
        ),
        examples=(
            "fbse campaign friction.yaml --out out/friction",
            "fbse campaign friction.yaml --out s3://lab/friction --scheduler tcp://host:8786",
        ),
    )
    run.add_argument("campaign", metavar="CAMPAIGN", type=Path, help="a YAML file")
    _add_allow_code(run, "it names (!Call, and effect_modules of its scenarios)")
    run.add_argument(
        "--out",
        metavar="DIR",
        help=(
            "where the rows go: a folder, or an address as s3://... (default: out/ and the "
            "file's name)"
        ),
    )
    place = run.add_mutually_exclusive_group()
    place.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask scheduler, as tcp://host:8786 (default: one is started here)",
    )
    place.add_argument(
        "--workers",
        metavar="N",
        type=_positive_whole_number,
        help="processes that are started here (default: one for each core)",
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "table",
        help="what the rows of a campaign say",
        description=(
            "Prints medians (of truth values: shares) with 95 %% intervals, by group; "
            "writes table.csv (all rows) and groups.csv."
        ),
        examples=(
            "fbse table out/friction --value walk.com_rse_mean",
            (
                "fbse table out/friction --by reference.step_length --plot walk.com_rse_mean.x "
                "reference.step_length"
            ),
        ),
    )
    run.add_argument("folder", metavar="DIR", help="what campaign wrote")
    run.add_argument(
        "--by",
        metavar="COLUMN",
        action="append",
        help=(
            "a column that makes groups; repeatable (default: the design's, if they have "
            "few values)"
        ),
    )
    run.add_argument(
        "--value",
        metavar="COLUMN",
        action="append",
        default=[],
        help="a value to show, or the beginning of several's names; repeatable",
    )
    run.add_argument(
        "--plot", metavar=("Y", "X"), nargs=2, help="writes a picture of one column over another"
    )
    run.add_argument("--out", metavar="DIR", type=Path, help="where files go (default: DIR)")
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "init",
        help="make a robot of yours ready: description, scenario, map, picture",
        description="Proposes what must be said of a robot from its URDF, writes it with a "
        "scenario that runs, and tries that. A robot on two legs of six joints squats, and so does "
        "one on two or three pairs of legs of three; of any other the joints swing.",
        examples=(
            "fbse init my_robot.urdf",
            "fbse init robots/g1.urdf --name g1 --out g1",
            "fbse init my_robot.urdf --recording monday.mcap",
        ),
    )
    run.add_argument("urdf", metavar="URDF", type=Path, help="the robot's model")
    run.add_argument(
        "--recording",
        metavar="BAG",
        type=Path,
        help="a bag (.mcap, .db3, .bag, or the folder of one), for whose topics the map is made",
    )
    run.add_argument("--name", help="what the robot is called (default: as the file)")
    run.add_argument(
        "--out", metavar="DIR", type=Path, help="where the files go (default: the robot's name)"
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "list",
        help="what there is: scenarios, effects, estimators, sensors",
        description="Lists what a scenario can be made of, a line for each.",
        examples=("fbse list", "fbse list effects", "fbse list scenarios --json"),
    )
    run.add_argument("what", choices=LISTED, nargs="?", help="list these alone")
    run.add_argument("--json", action="store_true", help="print JSON: a text by name, by kind")
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")

    run = _add_command(
        commands,
        "schema",
        help="what a scenario file can say, as a JSON schema for editors",
        description="Prints the JSON schema of scenario files: keys, types and what they mean.",
        examples=("fbse schema > scenario.schema.json",),
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _whole_number(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number >= 0, found {text}")
    return int(text)


def _positive_whole_number(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a whole number > 0, found {text}")
    return int(text)


def _positive_number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0.0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number > 0, found {text}")
    return number


def _add_scenario(run: argparse.ArgumentParser) -> None:
    scenario = run.add_argument(
        "scenario", metavar="SCENARIO", help="a YAML file, or a name of `fbse list scenarios`"
    )
    scenario.completer = _scenario_names  # type: ignore[attr-defined]
    run.add_argument(
        "--name",
        help="which scenario of the file (default: its only one, or the one called like the file)",
    )
    run.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        dest="overrides",
        help="changes a value, as in seed=3; repeatable",
    )
    _add_allow_code(run, "the scenario names (effect_modules)")


def _add_allow_code(run: argparse.ArgumentParser, which: str) -> None:
    run.add_argument(
        "--allow-code",
        action="store_true",
        help=f"run the Python code that {which} also where the file came with a log or a download",
    )


def _add_log(run: argparse.ArgumentParser) -> None:
    run.add_argument(
        "log", metavar="LOG", type=Path, help="a log file (npz), or a recording (see convert)"
    )
    _add_map(run)


def _add_map(run: argparse.ArgumentParser) -> None:
    run.add_argument(
        "--map",
        metavar="MAP",
        help="what a recording's columns or topics mean (yaml); standard messages need none",
    )


def _add_output(run: argparse.ArgumentParser, default: str) -> None:
    run.add_argument(
        "--out", metavar="DIR", type=Path, help=f"where the results go (default: {default})"
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")
