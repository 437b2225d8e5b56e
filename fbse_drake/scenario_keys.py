"""What a scenario file can say, read from the classes behind it: for the documentation, and as a
JSON schema for editors."""

import dataclasses
import inspect
import re
import types
import typing
from typing import Any

from fbse_drake.effects.effect import Effect
from fbse_drake.scenario import Scenario
from fbse_drake.schema import alternatives_of, defaults_of, fields_of

_SCALARS = {bool: "boolean", int: "integer", float: "number", str: "string"}
# A field of a dataclass as it stands in a source file.
_FIELD = re.compile(r"    (\w+): ")


@dataclasses.dataclass(frozen=True)
class Key:
    """One key of a mapping."""

    name: str
    kind: Any
    # As written in Python; None where the key must be given.
    default: str | None
    # What it means, with its unit.
    text: str


def keys(config: type) -> list[Key]:
    """The keys of a mapping that becomes an object of this class."""
    defaults, texts = defaults_of(config), _comments(config)
    return [
        Key(
            name,
            kind,
            repr(defaults[name]) if name in defaults else None,
            texts.get(name, "") or _usual_text(config, name, kind),
        )
        for name, kind in fields_of(config).items()
    ]


def _usual_text(config: type, name: str, kind: Any) -> str:
    """What a key without a comment means: a parameter of an effect, or what its class says."""
    if issubclass(config, Effect) and name in config.parameters:
        parameter = config.parameters[name]
        low, high = parameter.plausible
        return f"By {config.acts_on} [{parameter.unit}]; plausible: {low:g} to {high:g}."
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return inspect.cleandoc(kind.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
    if config.__module__.startswith("pydrake"):
        return "See Drake's MultibodyPlantConfig."
    return ""


def mappings() -> list[type]:
    """All classes that a scenario file can name or hold, the scenario first."""
    found: dict[type, None] = {}
    waiting: list[Any] = [Scenario]
    while waiting:
        kind = waiting.pop(0)
        if isinstance(kind, type) and _is_mapping(kind) and kind not in found:
            found[kind] = None
            waiting += fields_of(kind).values()
        waiting += parts_of(kind)
    return list(found)


def parts_of(kind: Any) -> tuple[Any, ...]:
    """What stands for a type in a file: its alternatives, or what it holds."""
    if isinstance(kind, type) and alternatives_of(kind):
        return alternatives_of(kind)
    return tuple(part for part in typing.get_args(kind) if not isinstance(part, str))


def json_schema() -> dict[str, Any]:
    """The JSON schema of a scenario file. Of alternatives it knows the keys, not the tags."""
    definitions = {
        config.__name__: {
            "type": "object",
            "description": inspect.cleandoc(config.__doc__ or ""),
            "additionalProperties": False,
            "properties": {
                key.name: _schema_of(key.kind) | ({"description": key.text} if key.text else {})
                for key in keys(config)
            },
            "required": [key.name for key in keys(config) if key.default is None],
        }
        for config in mappings()
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Scenarios of fbse_drake",
        "type": "object",
        "additionalProperties": {"$ref": f"#/$defs/{Scenario.__name__}"},
        "$defs": definitions,
    }


def _schema_of(kind: Any) -> dict[str, Any]:
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if kind in _SCALARS:
        return {"type": _SCALARS[kind]}
    if origin is typing.Literal:
        return {"enum": list(args)}
    if origin in (list, tuple):
        return {"type": "array", "items": _schema_of(args[0])}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema_of(args[1])}
    if origin in (typing.Union, types.UnionType) or parts_of(kind):
        return {"anyOf": [_schema_of(part) for part in parts_of(kind)]}
    if kind is type(None):
        return {"type": "null"}
    return {"$ref": f"#/$defs/{kind.__name__}"} if _is_mapping(kind) else {}


def _is_mapping(kind: Any) -> bool:
    known = dataclasses.is_dataclass(kind) or hasattr(kind, "__fields__")
    return known and not alternatives_of(kind)


def _comments(config: type) -> dict[str, str]:
    """The comment above each field, or above several, also of those that it inherits."""
    found: dict[str, str] = {}
    for base in reversed(config.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        comment: list[str] = []
        ended = True
        for line in inspect.getsource(base).splitlines():
            if line.startswith("    # "):
                comment = [*([] if ended else comment), line.removeprefix("    # ")]
                ended = False
            elif match := _FIELD.match(line):
                # What it has no comment of its own for, it has inherited, or shares with the last.
                if not ended or match[1] not in found:
                    found[match[1]] = " ".join(comment)
                ended = True
            elif not line.strip():
                comment = []
    return found
