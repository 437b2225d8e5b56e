"""Files: written so that nobody ever sees half of one, and JSON that every reader accepts."""

import fcntl
import hashlib
import json
import math
import os
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np

from fbse_drake.errors import InputError

# Of our JSON files; it grows when a key changes its meaning or goes away.
SCHEMA_VERSION = 1

# At the end of the names of files that are being written.
_PARTIAL = ".fbse-part"
# Larger JSON is not ours [bytes].
_LARGEST_JSON = 2**28


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Lets `write` fill a temporary file beside `path`, then renames it.

    Several programs may write the same file at once: the last one's stays. What killed ones left
    behind in the folder is removed.

    Raises:
        OSError: it cannot be written, as on a full disk; `path` is then what it was before.
    """
    try:
        _remove_left_behind(path.parent)
        with _partial(path) as partial:
            write(partial)
            partial.replace(path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from None


def write_text(path: Path, text: str) -> None:
    """Writes a text file (UTF-8)."""
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"))


@contextmanager
def _partial(path: Path) -> Iterator[Path]:
    """A file beside `path` with a name of its own, locked while it is being written."""
    while True:
        partial = path.with_name(f".{path.name[:200]}.{secrets.token_hex(4)}{_PARTIAL}")
        with partial.open("xb") as file:
            _lock(file, fcntl.LOCK_EX)
            # Somebody may have taken it for left behind before it was locked.
            if not partial.exists():
                continue
            try:
                yield partial
            finally:
                partial.unlink(missing_ok=True)
        return


def _remove_left_behind(folder: Path) -> None:
    """Removes files that nobody is writing any more: who did was killed, so they are not locked."""
    for left in folder.glob(f".*{_PARTIAL}"):
        with suppress(OSError), left.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()


def _lock(file: BufferedWriter, kind: int) -> None:
    # Where a file system has no locks, nobody removes anything either.
    with suppress(OSError):
        fcntl.flock(file, kind)


def to_json(content: Any, *, indent: int | None = None) -> str:
    """JSON text by its standard, which knows neither NaN nor Infinity: they become null."""
    return json.dumps(_standard(content), indent=indent, allow_nan=False)


def write_json(path: str | Path, content: Any) -> None:
    """Writes a JSON file; see `to_json`."""
    write_text(Path(path), to_json(content, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Reads a JSON file; see `from_json`.

    Raises:
        InputError: no such file, or not JSON.
    """
    try:
        if path.stat().st_size > _LARGEST_JSON:
            raise InputError(f"{path}: expected at most {_LARGEST_JSON} bytes")
        return from_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: not a JSON file: {error}") from None


def from_json(text: str | bytes) -> Any:
    """Parses JSON. NaN and Infinity, which our older files have, become None as null does.

    Raises:
        ValueError: it is not JSON, or has halves of characters, which no file can hold.
    """
    try:
        tree = json.loads(text, parse_constant=lambda _: None, parse_float=_finite)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    raw = text.encode() if isinstance(text, str) else text
    if b"\\ud" in raw.lower():
        json.dumps(tree, ensure_ascii=False).encode()
    return tree


def origin(logs: Sequence[Path] = (), scenario: Path | None = None) -> dict[str, Any]:
    """Keys that say what a JSON file was made by, and of what.

    Args:
        logs, scenario: what it was made of, if anything.

    Returns:
        The versions, and the hashes of what it was made of: `log_sha256`, one for each log, and
        `scenario_sha256`.
    """
    hashes = {"log_sha256": [_sha256(path) for path in logs]} if logs else {}
    made_of = hashes if scenario is None else hashes | {"scenario_sha256": _sha256(scenario)}
    return {
        "schema_version": SCHEMA_VERSION,
        "package_version": version("fbse_drake"),
        **made_of,
    }


def _sha256(path: Path) -> str:
    """Of a file; of a folder, as some bags are, of its files in the order of their names."""
    digest = hashlib.sha256()
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    for file in (file for file in files if file.is_file()):
        with file.open("rb") as content:
            while block := content.read(2**20):
                digest.update(block)
    return digest.hexdigest()


def _finite(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None


def _standard(value: Any) -> Any:
    """A tree without numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: _standard(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_standard(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _standard(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
