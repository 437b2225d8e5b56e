"""Finds the models and scenarios that ship with the package."""

import hashlib
from pathlib import Path

from fbse_drake.errors import InputError

_PACKAGE = Path(__file__).resolve().parent


def folder(name: str) -> Path:
    """The folder `models` or `scenarios`: inside an installed package, beside the package in a
    checkout."""
    installed = _PACKAGE / name
    return installed if installed.is_dir() else _PACKAGE.parent / name


def find(name_or_path: str | Path, *, kind: str) -> Path:
    """The YAML file that a user means by a path or by the name of a file in the folder `kind`.

    Raises:
        InputError: no such file; the message lists the names that exist.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    named = folder(kind) / f"{name_or_path}.yaml"
    if path.suffix == "" and named.is_file():
        return named
    raise InputError(
        f"{name_or_path}: no such file, and no such name in {kind}/ (there are: "
        f"{', '.join(shipped(kind))})"
    )


def shipped(kind: str) -> list[str]:
    """Names of the files in the folder `models` or `scenarios`, in order."""
    files = (p.relative_to(folder(kind)).with_suffix("") for p in folder(kind).rglob("*.yaml"))
    return sorted(p.as_posix() for p in files if p.suffix not in (".dmd", ".map"))


def package_checksum(*more: Path) -> str:
    """Checksum of the package, its models and its scenarios.

    Args:
        more: further files.
    """
    folders = (_PACKAGE, *map(folder, ("models", "scenarios")))
    files = {file for folder in folders for file in folder.rglob("*.*") if file.is_file()}
    sources = sorted(file for file in files if file.suffix in (".py", ".yaml", ".urdf"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in (*sources, *more))).hexdigest()
