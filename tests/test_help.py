"""What the command line says of itself: version, help, examples, lists, completion."""

import argparse
import json
import os
import shlex
import subprocess
import sys
from importlib.metadata import version

import pytest

from fbse_drake import libraries, load_scenario
from fbse_drake.cli import DONE, LISTED, _parser, main


def commands() -> dict[str, argparse.ArgumentParser]:
    (chosen,) = (
        action for action in _parser()._actions if isinstance(action, argparse._SubParsersAction)
    )
    return dict(chosen.choices)


def test_every_example_of_the_help_is_a_command_line_that_is_understood():
    for name, command in commands().items():
        examples = [line.strip() for line in command.epilog.splitlines()[1:]]
        assert examples
        for example in examples:
            program, *arguments = shlex.split(example)
            assert (program, arguments[0]) == ("fbse", name)
            _parser().parse_args(arguments)


def test_version(capsys: pytest.CaptureFixture):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == DONE
    assert capsys.readouterr().out == f"fbse {version('fbse_drake')}\n"


def test_everything_that_is_listed_has_a_line_and_exists(capsys: pytest.CaptureFixture):
    assert main(["list", "--json"]) == DONE
    listed = json.loads(capsys.readouterr().out)
    assert tuple(listed) == LISTED
    assert [
        f"{kind}: {n}" for kind, lines in listed.items() for n, t in lines.items() if not t
    ] == []
    for kind in ("effects", "estimators", "sensors", "compensations"):
        assert set(listed[kind]) >= set(getattr(libraries, f"{kind}_by_name")())
    for command in listed["scenarios"]:
        options = _parser().parse_args(["simulate", *command.split()])
        if not options.scenario.startswith("real/"):
            load_scenario(options.scenario, options.name)
    assert "paper_walk_fbse --name paper_method" in listed["scenarios"]


def test_a_list_for_people_has_a_line_for_each(capsys: pytest.CaptureFixture):
    assert main(["list", "sensors"]) == DONE
    printed = capsys.readouterr().out
    for name in libraries.sensors_by_name():
        assert name in printed
    assert "CoulombFriction" not in printed


def completions(line: str) -> list[str]:
    """What a shell would offer, as argcomplete's own protocol has it."""
    read, write = os.pipe()
    program = f"import os; os.dup2({write}, 8); from fbse_drake.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={
            **os.environ,
            "_ARGCOMPLETE": "1",
            "_ARGCOMPLETE_IFS": "\n",
            "COMP_LINE": line,
            "COMP_POINT": str(len(line)),
        },
        pass_fds=[write],
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr
    os.close(write)
    with os.fdopen(read) as pipe:
        return [word.strip() for word in pipe.read().split("\n")]


def test_commands_and_scenarios_are_completed():
    pytest.importorskip("argcomplete")
    assert set(completions("fbse es")) == {"estimate"}
    assert "paper_walk_pd" in completions("fbse simulate paper")
    assert "squat" not in completions("fbse simulate paper")
