"""What MkDocs builds beside the pages that are written: reference pages from the code itself."""

import argparse
import ast
import inspect
import re
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter
from signatures import signature

from fbse_drake import signals
from fbse_drake.cli import _parser
from fbse_drake.effects.effect import Effect, spaced
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.libraries import effects_by_name, estimators_by_name, sensors_by_name
from fbse_drake.scenario_keys import keys, mappings, parts_of

ROOT = Path(__file__).resolve().parent.parent

# Of code on a page.
_WIDTH = 80

LIBRARY = """\
# Effect library

Each effect is one class: it is simulated, predicted and identified by the same lines. A scenario
gives it to the robot (`effects`) or to the model that is believed (`model: {effects}`), and the
diagnosis looks for all of them.

Pictures of joint effects show the torque that is lost in one joint that swings fast and slowly
under a load that comes in steps, over time, velocity, angle and commanded torque: where the points
lie on one line, the effect depends on nothing else. Those of all other effects show what the
effect adds to the [residual](../missing_physics.md) of a walk of 3.5 s, or of legs that swing in a
gantry where the base has to be fixed, in its three strongest rows, as multiples of the sensors'
noise there. Linear parameters are a tenth of the largest
plausible ones, others as usual. The pictures are drawn by the effects' own code when these pages
are built.

What is plausible is so on robots of up to 100 kg. Of heavier ones it grows as torques, inertias and
compliances do between robots of one shape; and a rotor may be felt as much as all that its joint
moves.
"""


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
    for name, effect in effects_by_name().items():
        picture = File.generated(config, _picture(name), content=signature(effect))
        files.append(picture)
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for path, content in tutorial(notebook):
            files.append(File.generated(config, path, content=content))
    return files


def tutorial(notebook: Path) -> Iterator[tuple[str, str | bytes]]:
    """Path and content of a notebook's page and of its pictures, as it was run last."""
    text, resources = MarkdownExporter().from_filename(str(notebook))
    text = re.sub(r"\]\((\w+)\.ipynb\)", r"](\1.md)", text)
    # Files of the repository are no pages.
    text = re.sub(r"\[([^]]+)\]\(\.\./[^)]+\)", r"\1", text)
    for name, content in resources["outputs"].items():
        text = text.replace(f"({name})", f"({notebook.stem}/{name})")
        yield f"tutorials/{notebook.stem}/{name}", content
    yield f"tutorials/{notebook.stem}.md", text


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
    """The library of effects: joint torques first, then by how many there are of a kind."""
    by_module: dict[str, dict[str, type[Effect]]] = {}
    for name, effect in effects_by_name().items():
        by_module.setdefault(effect.__module__, {})[name] = effect

    def rank(found: dict[str, type[Effect]]) -> tuple[bool, int]:
        return not issubclass(next(iter(found.values())), JointTorqueEffect), -len(found)

    contents, sections = [], []
    for found in sorted(by_module.values(), key=rank):
        module = inspect.getmodule(next(iter(found.values())))
        title = (inspect.getdoc(module) or "").splitlines()[0].partition(":")[0].rstrip(".")
        links = ", ".join(f"[{spaced(name)}](#{name.lower()})" for name in found)
        contents += [f"* **{title}**: {links}"]
        sections += ["", f"## {title}"]
        for name, effect in found.items():
            sections += ["", *_effect(name, effect)]
    return "\n".join([LIBRARY, *contents, *sections])


def _effect(name: str, effect: type[Effect]) -> Iterator[str]:
    yield from (f"### {name}", "", effect.description, "", "**Law.** " + _law(effect), "")
    yield from (f"![{effect.signature}]({Path(_picture(name)).name})" + "{ .signature }", "")
    yield from (f"**In data.** {effect.signature}", "", f"**Experiment.** {effect.experiment}", "")
    rows = [
        (
            f"`{key}`",
            parameter.meaning,
            parameter.unit,
            "{:g} to {:g}".format(*parameter.plausible),
            "linear" if parameter.linear else "searched",
        )
        for key, parameter in effect.parameters.items()
    ]
    yield from _table(("parameter", "what it is", "unit", "plausible", "identified"), rows)
    yield from ("", f"Given by {effect.acts_on}; `{effect.__module__}`.")


def _law(effect: type[Effect]) -> str:
    """What its docstring says, formulas as code."""
    # Up to the next sentence or clause.
    ends = r"(?=,\s+[a-z_]+\b(?!\))|[.:;]?(?:\s[A-Z]|\n\n|\Z))"
    formula = r"(?<![`\w])(u = (?:.|\n(?!\n))+?)" + ends
    return re.sub(formula, r"`\1`", _text(effect))


def _picture(name: str) -> str:
    return f"reference/{name}.svg"


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
        yield f"```python\n{_call(name, value)}\n```\n"
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
        yield ""
        yield from (f"- `{member}`: {_first(text)}" for member, text in members if text)


def _call(name: str, value: Callable) -> str:
    """How it is called, one argument a line where they do not fit into one."""
    signature = inspect.signature(value)
    end = ")"
    # Classes are said to return None.
    if not inspect.isclass(value) and signature.return_annotation is not signature.empty:
        end += f" -> {_short(inspect.formatannotation(signature.return_annotation))}"
    arguments = [_short(argument) for argument in _arguments(signature)]
    line = f"{name}({', '.join(arguments)}{end}"
    if len(line) <= _WIDTH:
        return line
    return "\n".join([f"{name}(", *(f"    {argument}," for argument in arguments), end])


def _short(text: str) -> str:
    """Types without their modules, and defaults that are made without saying how."""
    return re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Z])", "", text).replace("<factory>", "...")


def _arguments(signature: inspect.Signature) -> Iterator[str]:
    starred = False
    for argument in signature.parameters.values():
        starred |= argument.kind is argument.VAR_POSITIONAL
        if argument.kind is argument.KEYWORD_ONLY and not starred:
            starred = True
            yield "*"
        yield str(argument)


def _markdown(lines: list[str]) -> Iterator[str]:
    """Sections of a docstring as lists, its examples as code."""
    inside = example = False
    for line in lines:
        if line.startswith(">>>") and not example:
            example = True
            yield "```pycon"
        if example:
            example = bool(line)
            yield line or "```\n"
        elif line in ("Args:", "Returns:", "Raises:"):
            inside = True
            yield f"\n**{line[:-1]}**\n"
        elif inside and line.startswith("    ") and not line.startswith("     "):
            name, _, text = line.strip().partition(": ")
            yield f"- `{name}`: {text}" if text else f"- {line.strip()}"
        else:
            yield line.strip() if inside else line
    if example:
        yield "```"


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
