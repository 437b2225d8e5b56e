"""What MkDocs builds beside the pages that are written: reference pages from the code itself."""

import argparse
import ast
import inspect
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from fbse_drake import signals
from fbse_drake.cli import _parser
from fbse_drake.libraries import effects_by_name, estimators_by_name, sensors_by_name
from fbse_drake.scenario_keys import keys, mappings, parts_of

ROOT = Path(__file__).resolve().parent.parent


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages."""
    pages = {
        "commands": commands(),
        "scenario": scenario(),
        "effects": effects(),
        "estimators": estimators(),
        "channels": channels(),
        "api": api(),
        "contributing": (ROOT / "CONTRIBUTING.md").read_text(),
        "changelog": (ROOT / "CHANGELOG.md").read_text(),
    }
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def commands() -> str:
    """The help of every command."""
    (chosen,) = (
        action for action in _parser()._actions if isinstance(action, argparse._SubParsersAction)
    )
    lines = ["# Commands", "", "Exit status: 0 done; 1 the run failed or was interrupted, what is "]
    lines[-1] += "known is written; 2 bad input, said in one line.\n"
    for name, command in chosen.choices.items():
        lines += [f"## fbse {name}", "", "```text", command.format_help().strip(), "```", ""]
    return "\n".join(lines)


def scenario() -> str:
    """Every key of a scenario file."""
    lines = [
        "# Scenario keys",
        "",
        "What a scenario file can say. `fbse schema` prints the same as a JSON schema for editors. "
        "Values by joint take `all`, a leg joint (`knee_pitch`) or one joint (`left_knee_pitch`); "
        "the more special one wins.",
        "",
    ]
    for config in mappings():
        if config in effects_by_name().values():
            continue
        lines += [f"## {config.__name__}", "", _text(config), ""]
        rows = [
            (f"`{key.name}`", _kind(key.kind), f"`{key.default}`" if key.default else "", key.text)
            for key in keys(config)
        ]
        lines += [*_table(("key", "type", "default", "meaning"), rows), ""]
    return "\n".join(lines)


def effects() -> str:
    """The library of effects."""
    lines = ["# Effect library", ""]
    for name, effect in effects_by_name().items():
        lines += [f"## {name}", "", effect.description, "", _text(effect), ""]
        rows = [
            (
                f"`{key}`",
                parameter.unit,
                "{:g} to {:g}".format(*parameter.plausible),
                "linear" if parameter.linear else "searched",
            )
            for key, parameter in effect.parameters.items()
        ]
        lines += _table(("parameter", "unit", "plausible", "identified"), rows)
        lines += [
            "",
            f"**In data:** {effect.signature}",
            "",
            f"**Experiment:** {effect.experiment}",
            "",
            f"Acts on: {effect.acts_on}. Written in `{effect.__module__}`.",
            "",
        ]
    return "\n".join(lines)


def estimators() -> str:
    """Estimators and sensors."""
    lines = ["# Estimators and sensors", ""]
    for name, kind in (estimators_by_name() | sensors_by_name()).items():
        lines += [f"## {name}", "", _text(kind), "", f"Written in `{kind.__module__}`.", ""]
    return "\n".join(lines)


def channels() -> str:
    """The table of signals."""
    lines = ["# Channels of a log", "", "n: a number for each joint; m: as many as there are.", ""]
    rows = [
        (f"`{row.text}`", row.unit, " x ".join(map(str, row.shape)) or "1", f"`{row.port}`")
        for row in signals._TABLE
        if row.channel
    ]
    return "\n".join(
        [*lines, *_table(("channel", "unit", "one sample", "port of the station"), rows)]
    )


def api() -> str:
    """Every public name, in the groups of the stub."""
    stub = ROOT / "fbse_drake/__init__.pyi"
    places = {
        statement.lineno: (f"fbse_drake.{statement.module}", alias.name, alias.asname)
        for statement in ast.parse(stub.read_text()).body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    lines = ["# Python API", "", "All of this is in `fbse_drake` itself.", ""]
    for number, line in enumerate(stub.read_text().splitlines(), start=1):
        if line.startswith("# "):
            lines += [f"## {line[2:].rstrip('.')}", ""]
        elif number in places:
            module, name, alias = places[number]
            lines += [f"### `{alias}`", "", *_described(module, name), ""]
    return "\n".join(lines)


def _described(module: str, name: str) -> Iterator[str]:
    value = getattr(__import__(module, fromlist=[name]), name)
    # An exception's is that of Python.
    if callable(value) and not (inspect.isclass(value) and issubclass(value, Exception)):
        signature = str(inspect.signature(value)).replace("fbse_drake.", "")
        yield f"```python\n{name}{signature}\n```\n"
    doc = inspect.getdoc(value) or ""
    yield "\n".join(_markdown(doc.splitlines()))
    if inspect.isclass(value):
        members = [
            (member, inspect.getdoc(found) or "")
            for member, found in inspect.getmembers(value)
            if not member.startswith("_")
            and (inspect.isfunction(found) or isinstance(found, property))
            and (found.fget if isinstance(found, property) else found).__module__ == module
        ]
        yield "\n".join(f"- `{member}`: {_first(text)}" for member, text in members if text)


def _markdown(lines: list[str]) -> Iterator[str]:
    """Sections of a docstring, as lists."""
    inside = False
    for line in lines:
        if line in ("Args:", "Returns:", "Raises:"):
            inside = True
            yield f"\n**{line[:-1]}**\n"
        elif inside and line.startswith("    ") and not line.startswith("     "):
            name, _, text = line.strip().partition(": ")
            yield f"- `{name}`: {text}" if text else f"- {line.strip()}"
        else:
            yield line.strip() if inside else line


def _first(text: str) -> str:
    return text.partition("\n\n")[0].replace("\n", " ")


def _text(kind: type) -> str:
    return "\n".join(_markdown((inspect.getdoc(kind) or "").splitlines()))


def _kind(kind: Any) -> str:
    """A type in words."""
    parts = [part for part in parts_of(kind) if part is not type(None)]
    if typing.get_origin(kind) in (list, tuple):
        return f"list of {_kind(parts[0])}"
    if typing.get_origin(kind) is dict:
        return f"{_kind(parts[1])} by name"
    if typing.get_origin(kind) is typing.Literal:
        return " or ".join(f"`{value}`" for value in typing.get_args(kind))
    if len(parts) > 6:
        return f"one of the {kind.__name__.lower()}s"
    if parts:
        return " or ".join(map(_kind, parts))
    return getattr(kind, "__name__", str(kind))


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    lines = [header, tuple("---" for _ in header), *rows]
    return [
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines
    ]
