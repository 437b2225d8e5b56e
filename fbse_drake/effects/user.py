"""Classes of a user's own, from Python files or modules that a scenario names."""

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

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


# What logs, exercises and recordings are called.
_DATA = (".npz", ".sealed", ".mcap", ".db3", ".bag", ".mat", ".csv")
# Where browsers and download tools note that a file came from elsewhere.
_ORIGINS = ("user.xdg.origin.url", "com.apple.quarantine")


def require_trusted(file: Path, code: Any) -> None:
    """Refuses to run code that may be somebody else's.

    Args:
        file: that says what is to be run.
        code: what it says; empty or None if nothing.

    Raises:
        InputError: the file was downloaded, or lies beside a log or a recording, with which it may
            have come.
    """
    if code and (reason := _why_not_trusted(file)) is not None:
        raise InputError(
            f"{file}: this file {reason}, and it runs Python code ({code}); "
            "--allow-code lets it, if you trust where it is from"
        )


def _why_not_trusted(file: Path) -> str | None:
    attributes = getattr(os, "listxattr", lambda _: ())
    with suppress(OSError):
        if any(name in _ORIGINS for name in attributes(file)):
            return "was downloaded"
    beside = sorted(path.name for path in file.resolve().parent.iterdir() if path.suffix in _DATA)
    return f"may have come with {beside[0]}" if beside else None


def _import_file(path: str) -> None:
    if path in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(path, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up while it is still being made.
    sys.modules[path] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[path]
        raise
