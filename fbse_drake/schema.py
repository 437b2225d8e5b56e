"""Typed YAML: builds frozen dataclasses from a document, with errors that name the file, the key
and what is allowed.

The document is parsed by `pydrake.common.yaml` (tags choose between alternatives:
`reference: !Squat {...}`). Its typed loader assigns to attributes, which frozen dataclasses refuse,
so the last step, tree to dataclass, is done here.
"""

import collections.abc
import contextlib
import dataclasses
import difflib
import math
import re
import textwrap
import types
import typing
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load

from fbse_drake.errors import InputError

T = TypeVar("T")

_SCALARS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}

# No length, force, count or seed is larger; squares and ratios of such numbers are still numbers.
LARGEST_NUMBER = 1e15
# What somebody wrote by hand has fewer bytes, and fewer values once its aliases are written out.
_LARGEST_FILE, _MOST_VALUES = 2**24, 10**6


def load_tree(path: Path) -> dict[str, Any]:
    """Parses a YAML file; a tag becomes the key `_tag` of its mapping.

    Raises:
        InputError: see `read_text` and `parse_mapping`.
    """
    return parse_mapping(read_text(path), file=str(path))


def read_text(path: Path) -> str:
    """Contents of a file.

    Raises:
        InputError: the file cannot be read, is too large or no text.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise InputError(f"{path}: expected at most {_LARGEST_FILE} bytes")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None


def parse_mapping(text: str, *, file: str) -> dict[str, Any]:
    """As `parse`.

    Raises:
        InputError: also if it is no mapping.
    """
    tree = parse(text, file=file)
    if not isinstance(tree, dict):
        raise InputError(f"{file}: expected a mapping of keys to values, found {describe(tree)}")
    return tree


def parse(text: str, *, file: str) -> Any:
    """Parses YAML text into mappings with texts as keys, lists, texts, numbers, true, false and
    nothing.

    Args:
        file: where it stands, for messages.

    Raises:
        InputError: it is no YAML, has other types (as dates), or more values than anybody writes.
    """
    try:
        _check_size(text, file)
        tree = yaml_load(data=f"{text}\n")
        _check_types(tree, file, "")
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
        raise InputError(f"{file}{where}: not valid YAML: {problem}") from None
    except RecursionError:
        raise InputError(f"{file}: not valid YAML: nested too deeply") from None
    except ValueError as error:
        # As of the 45th of a month.
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file}: not valid YAML: {error}") from None
    return tree


def _check_size(text: str, file: str) -> None:
    """Refuses aliases and merges that stand for more than anybody can have meant."""
    counts: dict[int, int] = {}

    def count(node: yaml.Node) -> int:
        if id(node) not in counts:
            # What holds itself is endless.
            counts[id(node)] = _MOST_VALUES
            children = node.value if isinstance(node, yaml.CollectionNode) else []
            if isinstance(node, yaml.MappingNode):
                children = [child for pair in children for child in pair]
            counts[id(node)] = 1 + sum(map(count, children))
        return counts[id(node)]

    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None:
        return
    if count(root) > _MOST_VALUES:
        raise InputError(f"{file}: not valid YAML: its aliases stand for too many values")
    for key, _ in root.value if isinstance(root, yaml.MappingNode) else []:
        if key.tag not in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"):
            raise InputError(
                f'{file}: expected a text as key, found {key.value}; write "{key.value}"'
            )


def _check_types(value: Any, file: str, key: str) -> None:
    if isinstance(value, str) and re.search(r"[\ud800-\udfff]", value):
        raise InputError(f"{file}: {key}: half of a character, which no file can hold: {value!a}")
    if isinstance(value, dict):
        for name, item in value.items():
            if not isinstance(name, str):
                raise InputError(
                    f'{file}: {key}: expected a text as key, found {name}; write "{name}"'
                )
            _check_types(name, file, key)
            _check_types(item, file, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for i, item in enumerate(value):
            _check_types(item, file, f"{key}[{i}]")
    elif value is not None and not isinstance(value, bool | int | float | str):
        kind = type(value).__name__
        raise InputError(f"{file}: {key}: expected a text or a number, found the {kind} {value}")


def merge(tree: dict[str, Any], override: dict[str, Any]) -> dict[str, Any]:
    """`tree` with the values of `override` on top: a mapping with another tag replaces, others
    merge key by key, null removes."""
    merged = dict(tree)
    for key, value in override.items():
        if value is None:
            merged.pop(key, None)
            continue
        old = merged.get(key)
        if (
            isinstance(old, dict)
            and isinstance(value, dict)
            and value.get("_tag", old.get("_tag")) == old.get("_tag")
        ):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged


def build(
    schema: type[T],
    tree: Any,
    *,
    file: str,
    key: str = "",
    default: T | None = None,
    further_keys: bool = False,
) -> T:
    """Builds an object of the dataclass `schema` from a parsed document.

    Args:
        tree: what `load_tree` or `read_json` returned, or a part of it.
        file, key: where the tree stands, for messages.
        default: takes the place of the schema's own defaults.
        further_keys: may the document say more than the schema? What it says more is left out.

    Raises:
        InputError: unknown key, wrong type or a value that the dataclass itself refuses.
    """
    if further_keys:
        tree = _known_part(schema, tree)
    return _build(schema, tree, default, f"{file}: ", key)


def check(schema: Any, value: Any, key: str = "") -> None:
    """Refuses an object made in code in which a field has not the type that its class states.

    Args:
        schema: as of `build`; also the type of a field.
        key: where the value stands, for messages.

    Raises:
        InputError: a wrong type, or a number that is not finite or too large.
    """
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    options = args if origin in (typing.Union, types.UnionType) else alternatives_of(schema)
    where = key or "top level"
    if schema is Any or (value is None and type(None) in options):
        return
    if options:
        options = tuple(option for option in options if option is not type(None))
        if type(value) in options or (isinstance(schema, type) and isinstance(value, schema)):
            # One of a user's own need not be known to files.
            check(type(value), value, key)
        elif len(options) == 1:
            check(options[0], value, key)
        else:
            names = ", ".join(option.__name__ for option in options)
            raise InputError(f"{where}: expected one of {names}; found {describe(value)}")
    elif schema in _SCALARS:
        if isinstance(value, str) and schema is not str:
            raise InputError(f"{where}: expected {_SCALARS[schema]}, found {describe(value)}")
        _scalar(schema, value.item() if isinstance(value, np.generic) else value, "", where)
    elif origin is typing.Literal:
        _build(schema, value, None, "", where)
    elif origin in (list, tuple):
        if not isinstance(value, (list, tuple)):
            raise InputError(f"{where}: expected a list, found {describe(value)}")
        for i, item in enumerate(value):
            check(args[0], item, f"{key}[{i}]")
    elif origin is dict:
        if not isinstance(value, dict):
            raise InputError(f"{where}: expected a dict, found {describe(value)}")
        for name, item in value.items():
            check(str, name, f"{where}: key")
            check(args[1], item, f"{key}.{name}")
    elif not isinstance(value, schema):
        raise InputError(f"{where}: expected a {schema.__name__}, found {describe(value)}")
    else:
        for name, kind in fields_of(schema).items():
            check(kind, getattr(value, name), f"{key}.{name}".lstrip("."))


def dump(value: Any, *, child_name: str | None = None) -> str:
    """YAML text of a dataclass, as the child of a document or as a document of its own; `build` of
    it gives an equal object.

    Drake's own `yaml_dump_typed` leaves out the tag of the first alternative, which would tie a
    file to the order of alternatives.
    """
    tree = _tree(type(value), value)
    return yaml.dump(
        tree if child_name is None else {child_name: tree},
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=120,
    )


class _Tagged(dict):
    """A mapping with a YAML tag."""

    def __init__(self, tag: str, content: dict[str, Any]):
        super().__init__(content)
        self.tag = tag


class _Dumper(yaml.SafeDumper):
    """Writes tags, and no anchors."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002
        return True


_Dumper.add_representer(_Tagged, lambda dumper, value: dumper.represent_mapping(value.tag, value))


def _tree(schema: Any, value: Any) -> Any:
    """The plain tree of a value: what is None is left out, alternatives are tagged."""
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (typing.Union, types.UnionType) or alternatives_of(schema):
        tree = _tree(type(value), value)
        optional = len(args) == 2 and type(None) in args
        return tree if optional else _Tagged(f"!{type(value).__name__}", tree)
    if origin in (list, tuple):
        return [_tree(args[0], item) for item in value]
    if origin is dict:
        return {key: _tree(args[1], item) for key, item in value.items()}
    if schema is Any:
        return _tagged(value)
    if schema in _SCALARS or origin is typing.Literal:
        return value.item() if isinstance(value, np.generic) else value
    fields = {name: (kind, getattr(value, name)) for name, kind in fields_of(schema).items()}
    return {name: _tree(kind, item) for name, (kind, item) in fields.items() if item is not None}


def _tagged(value: Any) -> Any:
    """A tree as `load_tree` has it, its tags as they are written."""
    if isinstance(value, list):
        return [_tagged(item) for item in value]
    if not isinstance(value, dict):
        return value
    content = {key: _tagged(item) for key, item in value.items() if key != "_tag"}
    return _Tagged(value["_tag"], content) if "_tag" in value else content


def _known_part(schema: Any, value: Any) -> Any:
    """A tree without what a schema of dataclasses, lists and mappings does not have."""
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (list, tuple) and isinstance(value, list):
        return [_known_part(args[0], item) for item in value]
    if origin is dict and isinstance(value, dict):
        return {key: _known_part(args[1], item) for key, item in value.items()}
    if dataclasses.is_dataclass(schema) and isinstance(value, dict):
        fields = fields_of(schema)
        return {k: _known_part(fields[k], item) for k, item in value.items() if k in fields}
    return value


def _build(schema: Any, value: Any, default: Any, file: str, key: str) -> Any:
    if schema is Any:
        return value
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if schema in _SCALARS:
        return _scalar(schema, value, file, key)
    if origin in (typing.Union, types.UnionType):
        return _alternative(args, value, default, file, key)
    if origin is typing.Literal:
        if value not in args:
            allowed = ", ".join(map(str, args))
            raise InputError(f"{file}{key}: expected one of {allowed}; found {describe(value)}")
        return value
    if alternatives_of(schema):
        return _alternative(alternatives_of(schema), value, default, file, key)
    if origin is list:
        if not isinstance(value, (list, tuple)):
            raise InputError(f"{file}{key}: expected a list, found {describe(value)}")
        return [_build(args[0], item, None, file, f"{key}[{i}]") for i, item in enumerate(value)]
    if origin is tuple:
        return tuple(_build(types.GenericAlias(list, args[:1]), value, None, file, key))
    if origin is dict:
        if not isinstance(value, dict):
            raise InputError(f"{file}{key}: expected a mapping, found {describe(value)}")
        old = default or {}
        items = {
            str(k): _build(args[1], v, old.get(k), file, f"{key}.{k}") for k, v in value.items()
        }
        return {**old, **items}
    tag = value.get("_tag") if isinstance(value, dict) else None
    if tag not in (None, f"!{schema.__name__}"):
        raise InputError(f"{file}{key or 'top level'}: expected no tag, found {describe(tag)}")
    return _mapping(schema, value, default, file, key)


def alternatives_of(schema: Any) -> tuple[Any, ...]:
    """What an open class can be: its own static method `alternatives` says so. A union says it by
    itself."""
    return schema.alternatives() if "alternatives" in getattr(schema, "__dict__", ()) else ()


def _scalar(schema: type, value: Any, file: str, key: str) -> Any:
    if schema is float and isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)  # YAML 1.1 reads 1e6 as a text
    matches = isinstance(value, schema) or (schema is float and isinstance(value, int))
    if not matches or (isinstance(value, bool) and schema is not bool):
        raise InputError(f"{file}{key}: expected {_SCALARS[schema]}, found {describe(value)}")
    if schema is float and not math.isfinite(value):
        raise InputError(f"{file}{key}: expected a finite number, found {value}")
    if schema in (int, float) and abs(value) > LARGEST_NUMBER:
        raise InputError(
            f"{file}{key}: expected a number of size at most {LARGEST_NUMBER:g}, "
            f"found {describe(value)}"
        )
    return schema(value)


def _alternative(options: tuple[Any, ...], value: Any, default: Any, file: str, key: str) -> Any:
    if type(None) in options:
        if value is None:
            return None
        options = tuple(option for option in options if option is not type(None))
        if len(options) == 1:
            return _build(options[0], value, default, file, key)
    names = {option.__name__: option for option in options}
    tag = value.get("_tag") if isinstance(value, dict) else None
    if not isinstance(tag, str | None):
        raise InputError(f"{file}{key}._tag: expected a text, found {describe(tag)}")
    if tag is None and type(default) in options:
        tag = f"!{type(default).__name__}"
    if tag is None or tag[1:] not in names:
        found = f"the tag {tag}" if tag else f"{describe(value)} without a tag"
        raise InputError(
            f"{file}{key}: expected one of {', '.join(f'!{name}' for name in names)}, found {found}"
        )
    schema = names[tag[1:]]
    return _mapping(schema, value, default if type(default) is schema else None, file, key)


def _mapping(schema: Any, value: Any, default: Any, file: str, key: str) -> Any:
    if not isinstance(value, collections.abc.Mapping):
        raise InputError(f"{file}{key}: expected a mapping, found {describe(value)}")
    fields = fields_of(schema)
    content = {k: v for k, v in value.items() if k != "_tag"}
    prefix = f"{key}." if key else ""
    for name in content:
        if name not in fields:
            close = difflib.get_close_matches(str(name), fields, n=1)
            hint = f", did you mean {close[0]}?" if close else ""
            raise InputError(
                f"{file}{prefix}{name}: unknown key{hint} (allowed: {', '.join(fields)})"
            )
    defaults = defaults_of(schema)
    if default is not None:
        defaults = {name: getattr(default, name) for name in fields}
    missing = [name for name in fields if name not in defaults and name not in content]
    if missing:
        raise InputError(f"{file}{key or 'top level'}: the key {missing[0]} is missing")
    values = {}
    for name, v in content.items():
        values[name] = _build(fields[name], v, defaults.get(name), file, prefix + name)
    try:
        return schema(**defaults | values)
    except InputError as error:
        raise InputError(f"{file}{prefix}{error}") from None


def defaults_of(schema: Any) -> dict[str, Any]:
    """Values of the fields that have a default, as they are before an object is made of them: it
    may make others of those that it was not given."""
    if not dataclasses.is_dataclass(schema):
        usual = schema()
        return {name: getattr(usual, name) for name in fields_of(schema)}
    defaults = {}
    for field in dataclasses.fields(schema):
        if field.default is not dataclasses.MISSING:
            defaults[field.name] = field.default
        elif field.default_factory is not dataclasses.MISSING:
            defaults[field.name] = field.default_factory()
    return defaults


def fields_of(schema: Any) -> dict[str, Any]:
    """The fields of a dataclass, or of one of Drake's serialisable classes, with their types."""
    if dataclasses.is_dataclass(schema):
        hints = _hints(typing.cast(type, schema))
        return {field.name: hints[field.name] for field in dataclasses.fields(schema)}
    return {field.name: field.type for field in schema.__fields__}


@lru_cache(maxsize=256)
def _hints(schema: type) -> dict[str, Any]:
    return typing.get_type_hints(schema)


def describe(value: Any) -> str:
    """What a value of a document is, in a few words."""
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, int) and abs(value) > LARGEST_NUMBER:
        return "a larger one"
    return textwrap.shorten(repr(value), 80, placeholder="...")
