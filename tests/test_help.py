"""What the command line says of itself: version, help, examples, lists, completion."""

import argparse
import json
import os
import shlex
import subprocess
import sys
from importlib.metadata import version

import pytest

from fbse_drake import libraries, load_scenario, resources
from fbse_drake.cli import DONE, LISTED, _parser, main
from fbse_drake.schema import load_tree


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
            program, *arguments = shlex.split(example.partition(" > ")[0])
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


def test_the_schema_documents_every_key_and_accepts_the_shipped_scenarios(
    capsys: pytest.CaptureFixture,
):
    assert main(["schema"]) == DONE
    schema = json.loads(capsys.readouterr().out)
    undocumented = [
        f"{name}.{key}"
        for name, mapping in schema["$defs"].items()
        for key, value in mapping["properties"].items()
        if not value.get("description")
    ]
    assert undocumented == []
    # An editor that validates by it finds nothing wrong with what is shipped, and a typo.
    squat = load_tree(resources.find("squat", kind="scenarios"))
    assert wrong_keys(squat["squat"], schema["$defs"]["Scenario"], schema["$defs"]) == []
    squat["squat"]["reference"]["amplitud"] = 1.0
    assert wrong_keys(squat["squat"], schema["$defs"]["Scenario"], schema["$defs"]) == ["amplitud"]


def wrong_keys(tree: object, schema: dict, definitions: dict) -> list[str]:
    """Keys of a document that a schema does not know; of alternatives that which knows most."""
    if "$ref" in schema:
        return wrong_keys(tree, definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        found = (wrong_keys(tree, one, definitions) for one in schema["anyOf"])
        return min(found, key=len)
    if not isinstance(tree, dict):
        return []
    known, others = schema.get("properties", {}), schema.get("additionalProperties", False)
    wrong = []
    for key, value in tree.items():
        inner = known.get(key, others)
        if key == "_tag":
            continue
        wrong += wrong_keys(value, inner, definitions) if inner else [key]
    return wrong
