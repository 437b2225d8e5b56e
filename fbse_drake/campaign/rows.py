"""The folder of a campaign: a Parquet file for each run, and logs; on a disk or in an object store.

    campaign.yaml               the campaign, with all defaults
    rows/_common_metadata       the schema of all rows, with units
    rows/<run>.parquet          one row
    logs/<run>.npz              its log, where it is kept
    table.parquet               all rows, once the campaign is done

A run is done when its row is there, and nothing else is remembered of it. Files appear whole, for
they are renamed to their names, and the names of a run's files are its own: who runs it again
writes the same.
"""

import io
import json
import tempfile
import uuid
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from fsspec.core import url_to_fs

from fbse_drake.campaign.columns import Column
from fbse_drake.errors import InputError
from fbse_drake.log import Log

_TYPES = {"number": pa.float64(), "whole": pa.int64(), "truth": pa.bool_(), "text": pa.string()}


def schema_of(columns: Sequence[Column]) -> pa.Schema:
    """The columns as Parquet has them; units are in their metadata."""
    return pa.schema(
        pa.field(
            column.name,
            _TYPES[column.kind],
            metadata={"unit": column.unit, "of_design": str(column.of_design)},
        )
        for column in columns
    )


def units_of(schema: pa.Schema) -> dict[str, str]:
    """Unit of each column, "" of one without."""
    return {field.name: field.metadata[b"unit"].decode() for field in schema}


def design_of(schema: pa.Schema) -> list[str]:
    """Columns that the design gives."""
    return [field.name for field in schema if field.metadata[b"of_design"] == b"True"]


def as_cell(value: Any, kind: pa.DataType) -> Any:
    """A value as the cell of a column: what is no text in one of texts becomes JSON."""
    if value is None:
        return None
    if pa.types.is_string(kind):
        return value if isinstance(value, str) else json.dumps(value, sort_keys=True, default=str)
    if pa.types.is_boolean(kind):
        return bool(value)
    return int(value) if pa.types.is_integer(kind) else float(value)


class Folder:
    """The folder of a campaign."""

    def __init__(self, place: str):
        """Looks at it, and makes nothing.

        Args:
            place: a path, or an address that fsspec knows, as `s3://bucket/campaign`.

        Raises:
            InputError: there is no file system for this address.
        """
        self.place = place
        try:
            self._files, root = url_to_fs(place)
        except (ImportError, ValueError) as error:
            raise InputError(f"--out {place}: {error}") from None
        self._root = root.rstrip("/")

    def make(self, campaign: str, schema: pa.Schema) -> None:
        """Makes the folder, or checks that it is that of this campaign.

        Args:
            campaign: contents of campaign.yaml.
            schema: of all rows.

        Raises:
            InputError: it has rows with other columns, or cannot be written to.
        """
        known = self.known_schema()
        if known is not None and not known.equals(schema, check_metadata=True):
            new, old = set(schema.names) - set(known.names), set(known.names) - set(schema.names)
            differ = ", ".join(sorted(new | old)) or "their kinds or units"
            raise InputError(
                f"--out {self.place}: has the rows of another campaign (columns: {differ})"
            )
        try:
            for name in ("rows", "logs"):
                self._files.makedirs(self._path(name), exist_ok=True)
            self._write("campaign.yaml", campaign.encode())
            if known is None:
                stream = io.BytesIO()
                pq.write_metadata(schema, stream)
                self._write("rows/_common_metadata", stream.getvalue())
        except OSError as error:
            raise InputError(f"--out {self.place}: {error.strerror or error}") from None

    def done(self) -> set[str]:
        """Keys of the runs that have a row."""
        self._files.invalidate_cache()
        if not self._files.isdir(self._path("rows")):
            return set()
        names = [Path(path).name for path in self._files.ls(self._path("rows"), detail=False)]
        return {
            name.removesuffix(".parquet")
            for name in names
            if name.endswith(".parquet") and not name.startswith(".")
        }

    def has(self, run: str) -> bool:
        """Has this run a row?"""
        return self._files.exists(self._path(f"rows/{run}.parquet"))

    def failure(self, run: str) -> str | None:
        """Why a run that has a row failed, or None."""
        content = io.BytesIO(self._files.cat_file(self._path(f"rows/{run}.parquet")))
        return pq.read_table(content, columns=["failure"])["failure"][0].as_py()

    def write_row(self, run: str, cells: Mapping[str, Any]) -> None:
        """Writes the row of a run; what it does not say is null.

        Raises:
            ValueError: a cell without a column.
        """
        schema = self.schema()
        if unknown := cells.keys() - set(schema.names):
            raise ValueError(f"no such column: {', '.join(sorted(unknown))}")
        row = {f.name: [as_cell(cells.get(f.name), f.type)] for f in schema}
        self._write(f"rows/{run}.parquet", _parquet(pa.table(row, schema=schema)))

    def write_log(self, run: str, log: Log) -> str:
        """Writes the log of a run; returns its name in the folder."""
        name = f"logs/{run}.npz"
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "log.npz"
            log.save(path)
            self._put(name, lambda partial: self._files.put_file(str(path), partial))
        return name

    def forget(self, runs: Iterable[str]) -> None:
        """Removes the rows of some runs."""
        for run in runs:
            self._files.rm_file(self._path(f"rows/{run}.parquet"))

    def write_table(self, runs: Collection[str]) -> None:
        """Writes table.parquet, in the order of these runs."""
        table = self.table()
        place = {run: k for k, run in enumerate(runs)}
        order = sorted(
            range(len(table)), key=lambda k: place.get(table["run"][k].as_py(), len(place))
        )
        self._write("table.parquet", _parquet(table.take(order) if order else table))

    def table(self) -> pa.Table:
        """All rows, with the units in the metadata of the columns.

        Raises:
            InputError: this is no folder of a campaign.
        """
        schema = self.schema()
        paths = [self._path(f"rows/{run}.parquet") for run in sorted(self.done())]
        if not paths:
            return schema.empty_table()
        rows = ds.dataset(paths, schema=schema, format="parquet", filesystem=self._files)
        return rows.to_table()

    def schema(self) -> pa.Schema:
        """That of all rows.

        Raises:
            InputError: this is no folder of a campaign.
        """
        return _schema(self.place)

    def known_schema(self) -> pa.Schema | None:
        """That of all rows as the folder says, None if it is no folder of a campaign."""
        path = self._path("rows/_common_metadata")
        if not self._files.exists(path):
            return None
        return pq.read_schema(io.BytesIO(self._files.cat_file(path)))

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"

    def _write(self, name: str, content: bytes) -> None:
        self._put(name, lambda partial: self._files.pipe_file(partial, content))

    def _put(self, name: str, write: Callable[[str], None]) -> None:
        """Lets `write` fill a file of another name, which then gets its name."""
        folder, _, file = self._path(name).rpartition("/")
        partial = f"{folder}/.{file}.{uuid.uuid4().hex}.part"
        write(partial)
        self._files.mv(partial, f"{folder}/{file}")


@lru_cache(maxsize=8)
def _schema(place: str) -> pa.Schema:
    """Read once in a process: it does not change."""
    known = Folder(place).known_schema()
    if known is None:
        raise InputError(f"{place}: not the folder of a campaign (no rows/_common_metadata)")
    return known


def _parquet(table: pa.Table) -> bytes:
    stream = io.BytesIO()
    pq.write_table(table, stream, write_statistics=False, use_dictionary=False)
    return stream.getvalue()
