"""Files that hold rows: CSV, JSON records, MATLAB and npz."""

import contextlib
import csv
import faulthandler
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from io import TextIOWrapper
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

from fbse_drake.errors import InputError
from fbse_drake.npz import read_npz

# Rows of a CSV file that are read at a time.
_CHUNK = 65536
# Names that an error lists.
_LISTED = 12

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Table:
    """A file whose rows are samples."""

    path: Path
    # Columns, of one or several numbers in a row.
    names: list[str]
    # Single numbers and texts.
    constants: dict[str, float | str]
    # Reads some of the columns: (N,) or (N, k) each.
    read: Callable[[Sequence[str], Progress], dict[str, np.ndarray]]


class Growing:
    """An array to which rows are added; it grows in place, so that it is not in memory twice."""

    def __init__(self, shape: tuple[int, ...], dtype: type):
        self._values: np.ndarray = np.empty((0, *shape), dtype)
        self._count = 0

    def extend(self, rows: np.ndarray) -> None:
        """Adds rows, (k, ...)."""
        count = self._count + len(rows)
        if count > len(self._values):
            self._resize(count + count // 8)
        self._values[self._count : count] = rows
        self._count = count

    def rows(self) -> np.ndarray:
        """All rows; the array is not to grow any more."""
        self._resize(self._count)
        return self._values

    def _resize(self, count: int) -> None:
        self._values.resize((count, *self._values.shape[1:]), refcheck=False)


@contextlib.contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Makes an InputError of whatever a library says about a damaged file."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise InputError(f"{path}: No such file or directory") from None
    except (
        Exception
    ) as error:  # Parsers of other people's formats raise anything when bytes are damaged.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: damaged, or not {kind}: {reason[:200]}") from None


def listed(names: Sequence[str]) -> str:
    """The first names of a list."""
    more = f", ... ({len(names)} in all)" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more or "none"


def open_table(path: Path, records: str) -> Table:
    """Opens a file by its suffix.

    Args:
        records: the key of a JSON file's records; empty for its only list of records.

    Raises:
        InputError: not a readable file of a known kind.
    """
    kinds = {
        ".csv": ("a CSV file", _open_csv),
        ".txt": ("a CSV file", _open_csv),
        ".json": ("a JSON file", lambda p: _open_json(p, records)),
        ".mat": ("a MATLAB file", _open_mat),
        ".npz": ("an npz file", _open_npz),
    }
    if path.suffix.lower() not in kinds:
        known = ", ".join([*kinds, ".db3, .mcap or .bag (or the folder of a bag)"])
        raise InputError(f"{path}: unknown kind of file (known: {known})")
    kind, open_file = kinds[path.suffix.lower()]
    with readable(path, kind):
        table = open_file(path)

    def read(names: Sequence[str], progress: Progress) -> dict[str, np.ndarray]:
        with readable(path, kind):
            return {
                name: _numbers(name, values) for name, values in table.read(names, progress).items()
            }

    return Table(table.path, table.names, table.constants, read)


def _numbers(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub" or array.ndim not in (1, 2):
        raise InputError(
            f"column {name}: expected numbers in rows, found an array of {array.dtype} with "
            f"{array.ndim} dimensions"
        )
    return array.astype(float, copy=False)


def _open_csv(path: Path) -> Table:
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline()
    if not first.strip():
        raise InputError("empty, or without a first line")
    delimiter = max(",;\t", key=first.count)
    fields = [name.strip() for name in next(csv.reader([first.lstrip("# ")], delimiter=delimiter))]
    headless = all(_is_number(name) for name in fields)
    names = [str(i) for i in range(len(fields))] if headless else fields
    if len(set(names)) != len(names):
        raise InputError(f"line 1: the column {max(names, key=names.count)} is there twice")

    def read(wanted: Sequence[str], progress: Progress) -> dict[str, np.ndarray]:
        indices = [names.index(name) for name in wanted]
        widths = _widths(path, delimiter, headless=headless, indices=indices)
        line, size = 1 if headless else 2, path.stat().st_size
        rows = Growing((sum(widths.values()),), float)
        with (
            path.open("rb") as raw,
            TextIOWrapper(raw, encoding="utf-8-sig", newline="") as file,
        ):
            if not headless:
                file.readline()
            while lines := list(islice(file, _CHUNK)):
                rows.extend(_csv_rows(lines, line, delimiter, fields=names, widths=widths))
                line += len(lines)
                progress(f"reading {path.name}: {min(1.0, raw.tell() / size):.0%}")
        ends = np.cumsum(list(widths.values()))[:-1]
        columns = np.split(rows.rows(), ends, axis=1)
        return {
            name: values[:, 0] if values.shape[1] == 1 else values
            for name, values in zip(wanted, columns, strict=True)
        }

    return Table(path, names, {}, read)


def _widths(
    path: Path, delimiter: str, *, headless: bool, indices: Sequence[int]
) -> dict[int, int]:
    """How many numbers the cells of some columns hold, as the first ones that are not empty do."""
    widths: dict[int, int] = {}
    with path.open(encoding="utf-8-sig", newline="") as file:
        for cells in islice(csv.reader(file, delimiter=delimiter), 0 if headless else 1, _CHUNK):
            for i in indices:
                if i not in widths and i < len(cells) and (count := len(_listed_texts(cells[i]))):
                    widths[i] = count
            if len(widths) == len(set(indices)):
                break
    return {i: widths.get(i, 1) for i in indices}


def _listed_texts(cell: str) -> list[str]:
    """The numbers of a cell as texts: one, or a list of them as `[1, 2]`, `(1; 2)` or `1 2`."""
    return re.split(r"[\s,;]+", inner) if (inner := cell.strip(" \t[](){}")) else []


def _csv_rows(
    lines: list[str],
    first: int,
    delimiter: str,
    *,
    fields: list[str],
    widths: Mapping[int, int],
) -> np.ndarray:
    """Numbers of some lines, (N, sum of the widths); what is empty is NaN.

    Args:
        first: number of the first line, for messages.
        widths: of the wanted columns: how many numbers their cells hold.
    """
    # Numpy looks at the wanted columns only: it would not see that a line has too many.
    plain = all(width == 1 for width in widths.values()) and all(
        line.count(delimiter) == len(fields) - 1 and not line.isspace() for line in lines
    )
    if plain:
        with contextlib.suppress(ValueError):
            return np.loadtxt(
                lines,
                delimiter=delimiter,
                usecols=list(widths),
                ndmin=2,
                comments=None,
                quotechar='"',
            )
    rows = []
    for number, line in enumerate(lines, first):
        cells = next(csv.reader([line], delimiter=delimiter), [])
        if not cells:
            continue
        if len(cells) != len(fields):
            raise InputError(f"line {number}: expected {len(fields)} columns, found {len(cells)}")
        row: list[float] = []
        for i, width in widths.items():
            texts = _listed_texts(cells[i]) or ["nan"] * width
            if len(texts) != width or not all(map(_is_number, texts)):
                expected = "a number" if width == 1 else f"{width} numbers"
                raise InputError(
                    f"line {number}, column {fields[i]}: "
                    f"expected {expected}, found {cells[i].strip()[:40]!r}"
                )
            row.extend(map(float, texts))
        rows.append(row)
    return np.array(rows).reshape(-1, sum(widths.values()))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _open_json(path: Path, records: str) -> Table:
    content = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(content, list):
        content = {"": content}
    if not isinstance(content, dict):
        raise InputError("expected records, or a mapping that has them")
    lists = [
        key
        for key, value in content.items()
        if isinstance(value, list) and value and isinstance(value[0], dict)
    ]
    if records:
        lists = [key for key in lists if key == records]
    if len(lists) != 1:
        raise InputError(
            f"expected one list of records{records and f' under {records}'}, found "
            f"{listed(lists)}; the map's key records names one"
        )
    rows = content[lists[0]]
    names = list(rows[0])

    def read(wanted: Sequence[str], _: Progress) -> dict[str, np.ndarray]:
        return {
            name: np.array([_json_number(row, name, number) for number, row in enumerate(rows)])
            for name in wanted
        }

    constants = {
        key: value for key, value in content.items() if isinstance(value, int | float | str)
    }
    return Table(path, names, constants, read)


def _json_number(row: Any, name: str, number: int) -> Any:
    """A number, or a list of numbers, of a record; NaN where there is none."""
    value = row.get(name) if isinstance(row, dict) else None
    if value is None:
        return np.nan
    if not isinstance(value, int | float | list):
        raise InputError(f"record {number}, {name}: expected a number, found {str(value)[:40]!r}")
    return value


def _open_mat(path: Path) -> Table:
    if h5py.is_hdf5(path):
        return _open_hdf5(path)
    # Some damaged files crash scipy's parser (1.17: one in fifty with a few wrong bytes), so it
    # gets a process of its own.
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as process:
        try:
            content = process.submit(_load_mat, path).result()
        except BrokenProcessPool:
            raise InputError("damaged, or not a MATLAB file: its parser crashes") from None
    return _table_of_arrays(path, _flattened(content, ""))


def _load_mat(path: Path) -> dict[str, Any]:
    faulthandler.disable()
    with path.open("rb") as file:
        return scipy.io.loadmat(file, simplify_cells=True)


def _open_hdf5(path: Path) -> Table:
    """MATLAB 7.3. There, arrays are stored transposed."""
    shapes: dict[str, tuple[int, ...]] = {}
    constants: dict[str, float | str] = {}
    with h5py.File(path) as file:

        def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
            if (
                name.startswith("#")
                or not isinstance(item, h5py.Dataset)
                or item.dtype.kind not in "fiub"
            ):
                return
            if item.attrs.get("MATLAB_class") == b"char":
                constants[name.replace("/", ".")] = "".join(map(chr, item[()].ravel()))
            elif item.size == 1:
                constants[name.replace("/", ".")] = float(item[()].item())
            elif 1 <= item.ndim <= 2:
                shapes[name.replace("/", ".")] = item.shape[::-1]

        file.visititems(visit)

    def read(wanted: Sequence[str], _: Progress) -> dict[str, np.ndarray]:
        with h5py.File(path) as file:
            return {name: _in_rows(file[name.replace(".", "/")][()].T) for name in wanted}

    return Table(path, list(shapes), constants, read)


def _flattened(content: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Nested structs as `outer.inner`."""
    flat: dict[str, Any] = {}
    for name, value in content.items():
        if name.startswith("__"):
            continue
        flat |= (
            _flattened(value, f"{prefix}{name}.")
            if isinstance(value, dict)
            else {f"{prefix}{name}": value}
        )
    return flat


def _open_npz(path: Path) -> Table:
    return _table_of_arrays(path, read_npz(path))


def _table_of_arrays(path: Path, arrays: Mapping[str, Any]) -> Table:
    columns: dict[str, np.ndarray] = {}
    constants: dict[str, float | str] = {}
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind == "U" and array.ndim == 0:
            constants[name] = str(value)
        elif array.dtype.kind in "fiub" and array.size == 1:
            constants[name] = float(array.item())
        elif array.dtype.kind in "fiub" and array.ndim in (1, 2):
            columns[name] = _in_rows(array)
    return Table(
        path, list(columns), constants, lambda wanted, _: {name: columns[name] for name in wanted}
    )


def _in_rows(array: np.ndarray) -> np.ndarray:
    """MATLAB's vectors are matrices."""
    return array.ravel() if array.ndim == 2 and 1 in array.shape else array
