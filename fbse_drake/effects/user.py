"""Classes of a user's own, from Python files or modules that a scenario names."""

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path

from fbse_drake.errors import InputError


def import_effect_modules(entries: Iterable[str], folder: Path) -> list[str]:
    """Imports modules, whose classes then are in the libraries; each once per process.

    Args:
        entries: names of modules, or paths of Python files (`*.py`), relative to `folder`.

    Returns:
        The entries with absolute paths.

    Raises:
        InputError: a module that is not there or fails.
    """
    imported = []
    for entry in entries:
        name = str((folder / entry).resolve()) if entry.endswith(".py") else entry
        try:
            _import_file(name) if entry.endswith(".py") else importlib.import_module(name)
        except Exception as error:
            message = str(error).partition("\n")[0]
            raise InputError(
                f"effect_modules: {name}: cannot be imported: {type(error).__name__}: {message}"
            ) from None
        imported.append(name)
    return imported


def _import_file(path: str) -> None:
    if path in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(path, path)
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up while it is still being made.
    sys.modules[path] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[path]
        raise
