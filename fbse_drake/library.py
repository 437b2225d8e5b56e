"""Libraries of classes that YAML files name by their tags.

There are effects, sensors, estimators and compensations. Each kind has a base class with a static
method `alternatives`, see `fbse_drake.schema`, and a class decorator `in_library` in the module of
that base class.
"""

from abc import ABCMeta
from collections.abc import Mapping

from fbse_drake.errors import InputError


def require_new(library: Mapping[str, type], kind: str, entry: ABCMeta) -> None:
    """Checks a class before it is put into a library.

    Raises:
        InputError: it lacks a method, or there is another class of its name.
    """
    if entry.__abstractmethods__:
        missing = min(entry.__abstractmethods__)
        raise InputError(f"{kind} {entry.__name__}: the method {missing} is missing")
    known = library.get(entry.__name__)
    if known is not None and _place(known) != _place(entry):
        other = f"the library has another {kind} of this name, in {known.__module__}"
        raise InputError(f"{kind} {entry.__name__}: {other}")


def _place(entry: type) -> tuple[str, str]:
    return entry.__module__, entry.__qualname__
