"""Recordings to logs."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from fbse_drake.errors import InputError, located
from fbse_drake.interop.bags import is_bag, open_bag, own_meta
from fbse_drake.interop.mapping import ChannelMap, LogMap, load_map
from fbse_drake.interop.tables import Progress, Table, listed, open_table
from fbse_drake.interop.units import si_factor
from fbse_drake.log import Log, check_recorded

# Sensors are interpolated between samples that are at most so many of their periods apart.
_NEIGHBOURS = 3.0
# Times of a map are meant this exactly [s].
_TICK = 1e-9
# A median period that differs from the nominal one by this factor is another unit of time.
_OTHER_UNIT = 2.0


@dataclass(frozen=True)
class _Recording:
    """One file, before its rows are looked at."""

    source: str
    joints: list[str]
    # Time [s], (N,), from any origin; `origin` is what its zero is in the recording.
    time: np.ndarray
    origin: float
    channels: dict[str, np.ndarray]
    constants: dict[str, float | str]
    findings: list[str]
    # What our own log said that became the file.
    meta: dict[str, Any] = field(default_factory=dict)


def read_log(path: Path, log_map: str | Path | None = None) -> Log:
    """Reads a log: an npz file of this package, or a recording that is converted on the way.

    Args:
        log_map: a map, see `load_map`.

    Raises:
        InputError: see `Log.load` and `convert`.
    """
    return read_logs([path], log_map)


def read_logs(
    paths: Sequence[Path], log_map: str | Path | None = None, *, progress: Progress = lambda _: None
) -> Log:
    """As `read_log`, with several recordings as one log."""
    if len(paths) == 1 and paths[0].suffix == ".npz" and log_map is None:
        return Log.load(paths[0])
    return convert(paths, load_map(log_map) if log_map else LogMap(), progress=progress)


def convert(paths: Sequence[Path], log_map: LogMap, *, progress: Progress = lambda _: None) -> Log:
    """Makes one log of one or several recordings: bags, CSV, JSON, MATLAB and npz files.

    Files of rows are recordings one after another, unless the map's channels are of several topics:
    then those are what the files are called, and files lie side by side in time, of which those
    without the joint positions are interpolated at the rows of the one that has them.

    Rows that lack a number, and rows at the time of the row before, are left out. What was left out
    is said in `meta["findings"]`; the stretch that each file became is in `meta["segments"]`
    ("start", "end" [s], "source", "recorded_start" [s], and the map's constants). Time begins at
    zero.

    Args:
        log_map: what columns and topics mean; not needed for bags with standard messages.
        progress: called with what is being done.

    Raises:
        InputError: a file is damaged, does not fit the map, or its time runs backwards.
    """
    recordings = []
    for files in _recordings(paths, log_map):
        first = next(iter(files.values()))
        progress(f"reading {first.name}")
        recording = (
            _read_bag(first, log_map, progress)
            if is_bag(first)
            else _read_tables(files, log_map, progress)
        )
        with located(f"{first}: "):
            recordings.append(_cleaned(recording, log_map))
    return _joined(recordings, log_map)


def _recordings(paths: Sequence[Path], log_map: LogMap) -> list[dict[str, Path]]:
    """The files of each recording by topic: several where files of rows lie side by side, else one.

    Raises:
        InputError: a file is of no topic or of two, or a topic lacks a file.
    """
    topics = list(dict.fromkeys(channel.topic for channel in log_map.channels.values()))
    if len(paths) < 2 or len(topics) < 2 or any(map(is_bag, paths)):
        return [{"": path} for path in paths]
    files: dict[str, list[Path]] = {topic: [] for topic in topics}
    for path in paths:
        fitting = [topic for topic in topics if fnmatchcase(path.stem, topic)]
        if len(fitting) != 1:
            found = listed(fitting)
            raise InputError(
                f"{path}: its name is to fit one of the topics {listed(topics)}, it fits {found}"
            )
        files[fitting[0]].append(path)
    counts = [len(found) for found in files.values()]
    if len(set(counts)) != 1:
        there = ", ".join(f"{topic}: {len(found)}" for topic, found in files.items())
        raise InputError(f"side by side there are to be as many files of each topic; found {there}")
    return [
        dict(zip(topics, together, strict=True)) for together in zip(*files.values(), strict=True)
    ]


@dataclass(frozen=True)
class _Rows:
    """Rows of one file: columns, (N, k) each, and the clock's readings, (N,)."""

    columns: dict[str, np.ndarray]
    clock: np.ndarray
    constants: dict[str, float | str]


def _read_tables(files: Mapping[str, Path], log_map: LogMap, progress: Progress) -> _Recording:
    """Files side by side, each with the channels of its topic; a single one, whose topic is empty,
    with all of them. Rows are those of the file that has the joint positions, or of the first."""
    single = len(files) == 1
    tables = {topic: open_table(path, log_map.records) for topic, path in files.items()}
    channels: dict[str, ChannelMap] = {}
    parts: dict[str, _Rows] = {}
    for topic, table in tables.items():
        own = {
            name: replace(channel, topic=topic)
            for name, channel in log_map.channels.items()
            if single or channel.topic == topic
        }
        own = {name: channel for name, channel in own.items() if _is_there(channel, table)}
        parts[topic] = _read_rows(table, own, log_map, progress)
        channels |= own
    positions = channels.get("joint/position")
    base = positions.topic if positions else next(iter(files))
    # Seconds since 1970 are not as fine as the clock's own unit.
    clock = parts[base].clock
    origin = clock[np.isfinite(clock)][:1].sum()
    unit = si_factor(log_map.time.unit, "s") if log_map.time.column else log_map.period
    times = {topic: (rows.clock - origin) * unit for topic, rows in parts.items()}

    def take(topic: str, column: str) -> np.ndarray:
        values = _taken(column, parts[topic].columns)
        if topic == base:
            return values
        with located(f"{files[topic]}: "):
            return _interpolated(times[base], times[topic], values)

    in_order = {name: channels[name] for name in log_map.channels if name in channels}
    with located(f"{files[base]}: "):
        made = _channels(in_order, take, len(log_map.joints))
    constants = {name: value for rows in parts.values() for name, value in rows.constants.items()}
    for name in log_map.constants:
        if name not in constants:
            known = [name for table in tables.values() for name in table.constants]
            raise InputError(
                f"{files[base]}: constants: {name} is not in this file (there are: {listed(known)})"
            )
    source = " and ".join(path.name for path in files.values())
    return _Recording(source, log_map.joints, times[base], origin * unit, made, constants, [])


def _is_there(channel: ChannelMap, table: Table) -> bool:
    """Whether a file is to have a channel: all that are not optional, or whose columns it has."""
    return not channel.optional or all(
        _split(column, table.names)[0] in table.names for column in channel.columns
    )


def _read_rows(
    table: Table, channels: Mapping[str, ChannelMap], log_map: LogMap, progress: Progress
) -> _Rows:
    with located(f"{table.path}: "):
        if not log_map.joints or not log_map.channels:
            raise InputError(
                "a map must name the joints and say what the columns are "
                f"(columns: {listed(table.names)})"
            )
        fields = [
            column for channel in channels.values() for column in (*channel.columns, *channel.times)
        ]
        wanted = dict.fromkeys(
            _split(column, table.names)[0]
            for column in [*fields, *filter(None, [log_map.time.column])]
        )
        for name in wanted:
            if name not in table.names:
                raise InputError(f"column {name} is missing (there are: {listed(table.names)})")
    columns = table.read(list(wanted), progress)
    with located(f"{table.path}: "):
        samples = (
            len(columns[log_map.time.column])
            if log_map.time.column
            else max(values.shape[0] for values in columns.values())
        )
        rows = {name: _in_rows(name, values, samples) for name, values in columns.items()}
    clock = rows[log_map.time.column][:, 0] if log_map.time.column else np.arange(float(samples))
    constants = {
        name: value for name, value in table.constants.items() if name in log_map.constants
    }
    return _Rows(rows, clock, constants)


def _read_bag(path: Path, log_map: LogMap, progress: Progress) -> _Recording:
    with open_bag(path) as bag:
        channels, left_out = bag.channels(log_map)
        recorded = (
            log_map.recorded_joints
            or log_map.joints
            or bag.joints(channels["joint/position"].topic)
        )
        if not recorded:
            raise InputError("the map names no joints")
        wanted: dict[str, list[str]] = {}
        for channel in channels.values():
            fields = wanted.setdefault(channel.topic, [])
            fields.extend(_split(column, [])[0] for column in (*channel.columns, *channel.times))
        topics, foreign = bag.read(wanted, recorded, progress)
        base = channels["joint/position"].topic
        # Clocks of headers and of the recorder are not mixed.
        stamped = all(rows.stamps.any() for rows in topics.values())
        times = {name: rows.stamps if stamped else rows.received for name, rows in topics.items()}
        if not len(times[base]):
            raise InputError(f"topic {base}: no messages of these joints")
        origin = int(times[base][0])

        def take(topic: str, column: str) -> np.ndarray:
            values = _taken(column, topics[topic].columns)
            if topic == base:
                return values
            with located(f"topic {topic}: "):
                return _interpolated(
                    (times[base] - origin) / 1e9, (times[topic] - origin) / 1e9, values
                )

        made = _channels(channels, take, len(recorded))
    joints = log_map.joints or list(recorded)
    return _Recording(
        path.name,
        joints,
        (times[base] - origin) / 1e9,
        origin / 1e9,
        made,
        {},
        [*left_out, *foreign],
        own_meta(path),
    )


def _split(column: str, names: Sequence[str]) -> tuple[str, slice]:
    """`q[0:3]` -> name and part; names that look like this themselves are left alone."""
    match = re.fullmatch(r"(.+)\[(\d+)(?::(\d+))?\]", column)
    if column in names or not match:
        return column, slice(None)
    first = int(match[2])
    return match[1], slice(first, int(match[3]) if match[3] else first + 1)


def _taken(column: str, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """A column, or a part of one, (N, k)."""
    name, part = _split(column, list(columns))
    width = columns[name].shape[1]
    if part != slice(None) and not part.start < part.stop <= width:
        raise InputError(f"{column}: {name} has {width} numbers in a row")
    return columns[name][:, part]


def _in_rows(name: str, values: np.ndarray, samples: int) -> np.ndarray:
    """(samples, k), also of an array that has its samples in columns."""
    rows = values[:, None] if values.ndim == 1 else values if len(values) == samples else values.T
    if len(rows) != samples:
        raise InputError(
            f"column {name}: expected {samples} rows as in the time, found "
            f"{' x '.join(map(str, values.shape))}"
        )
    return rows


def _channels(
    channels: Mapping[str, ChannelMap], take: Callable[[str, str], np.ndarray], joints: int
) -> dict[str, np.ndarray]:
    """Makes the channels of a recording.

    Args:
        take: topic and column -> numbers, (N, k).
    """

    def together(topic: str, columns: Sequence[str]) -> np.ndarray:
        parts = [take(topic, column) for column in columns]
        return parts[0] if len(parts) == 1 else np.hstack(parts)

    made = {}
    for name, channel in channels.items():
        with located(f"channels.{name}: "):
            if not channel.columns:
                raise InputError("no columns are named")
            times = together(channel.topic, channel.times) if channel.times else None
            made[name] = channel.channel(
                name, together(channel.topic, channel.columns), times, joints
            )
    return made


def _interpolated(base: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values at other times, (N, k), linearly; NaN where their neighbours are far apart.

    Args:
        base: where they are wanted [s], (N,).
        time: where they are known [s], (M,).
        values: (M, k).
    """
    if np.array_equal(base, time):
        return values
    fresh = _later(time)
    time, values = time[fresh], values[fresh]
    result = np.full((len(base), values.shape[1]), np.nan)
    if len(time) > 1:
        after = np.clip(np.searchsorted(time, base), 1, len(time) - 1)
        gap = time[after] - time[after - 1]
        known = (
            (gap <= _NEIGHBOURS * np.median(np.diff(time))) & (base >= time[0]) & (base <= time[-1])
        )
        for column, result_column in zip(values.T, result.T, strict=True):
            result_column[known] = np.interp(base[known], time, column)
    return result


def _later(time: np.ndarray) -> np.ndarray:
    """Which rows are later than the one before, (N,).

    Raises:
        InputError: a row is earlier.
    """
    steps = np.diff(time)
    if (steps < 0).any():
        row = int((steps < 0).argmax()) + 1
        raise InputError(
            f"time runs backwards {int((steps < 0).sum())} times, first at row {row}: "
            f"{time[row - 1]:.6f} s, then {time[row]:.6f} s"
        )
    return np.concatenate([[True], steps > 0])


def _cleaned(recording: _Recording, log_map: LogMap) -> _Recording:
    """The stretch of a recording that is wanted, without rows that cannot be used."""
    time, channels, findings = recording.time, dict(recording.channels), list(recording.findings)
    if not len(time):
        raise InputError("no rows")
    whole = np.ones(len(time), dtype=bool)
    for name, values in {"time": time, **channels}.items():
        known = np.isfinite(values).reshape(len(time), -1).all(axis=1)
        if not known.any():
            # Drivers fill fields of standard messages that they do not know with NaN.
            if name in channels and name != "joint/position" and name not in log_map.channels:
                findings.append(f"{name} is left out: no row has numbers in it")
                del channels[name]
                continue
            raise InputError(f"no row has numbers in {name}")
        if not known.all():
            findings.append(
                f"{int((~known).sum())} rows without numbers in {name} are left out (the first is "
                f"row {int(known.argmin())})"
            )
        whole &= known
    rows = np.flatnonzero(whole)
    if rows.size:
        rows = rows[_later(time[rows])]
    if rows.size < whole.sum():
        findings.append(
            f"{int(whole.sum()) - rows.size} rows at the time of the row before are left out"
        )
    elapsed = time[rows] - time[rows[:1]]
    end = np.inf if log_map.end is None else log_map.end
    rows = rows[(elapsed >= log_map.start - _TICK) & (elapsed <= end + _TICK)]
    if rows.size < 2:
        raise InputError("fewer than two rows are left")
    _check_period(time[rows], log_map.period)
    part = slice(rows[0], rows[-1] + 1) if rows.size == rows[-1] + 1 - rows[0] else rows
    return replace(
        recording,
        time=time[part] - time[rows[0]],
        origin=recording.origin + float(time[rows[0]]),
        channels={name: values[part] for name, values in channels.items()},
        findings=findings,
    )


def _check_period(time: np.ndarray, period: float | None) -> None:
    median = float(np.median(np.diff(time)))
    if period is not None and not 1 / _OTHER_UNIT < median / period < _OTHER_UNIT:
        raise InputError(
            f"time: rows are {median:g} s apart, but the map's period is {period:g} s; is the "
            "time's unit right?"
        )


def _joined(recordings: Sequence[_Recording], log_map: LogMap) -> Log:
    first = recordings[0]
    for other in recordings[1:]:
        for what, ours, theirs in (
            ("joints", first.joints, other.joints),
            ("channels", list(first.channels), list(other.channels)),
        ):
            if ours != theirs:
                raise InputError(
                    f"{other.source}: cannot be one log with {first.source}: its {what} are "
                    f"{listed(theirs)}, not {listed(ours)}"
                )
    segments: list[dict[str, Any]] = []
    times, begin = [], 0.0
    for recording in recordings:
        times.append(begin + recording.time)
        span = {"start": float(times[-1][0]), "end": float(times[-1][-1])}
        segments.append(
            span
            | {"source": recording.source, "recorded_start": recording.origin}
            | recording.constants
        )
        begin = span["end"] + log_map.gap
    channels = {"time": _chained(times)} | {
        name: _chained([r.channels[name] for r in recordings]) for name in first.channels
    }
    several = len(recordings) > 1
    source = f"{first.source} and {len(recordings) - 1} more" if several else first.source
    sides = dict.fromkeys(
        match[1] for name in channels if (match := re.match(r"foot/(\w+)/", name))
    )
    meta: dict[str, Any] = {
        "joints": list(first.joints),
        "sides": list(sides),
        "period": log_map.period or float(f"{np.median(np.diff(channels['time'])):.6g}"),
        "title": f"Recording {source}",
        "source": source,
        "segments": segments,
        "findings": [
            f"{r.source}: {finding}" if several else finding
            for r in recordings
            for finding in r.findings
        ],
    }
    if first.meta and not several:
        made = {key: meta[key] for key in ("joints", "sides", "period")}
        # Its stretches are those of its own time.
        moved = {"segments": segments} if first.origin else {}
        left_out = {"findings": first.findings} if first.findings else {}
        meta = first.meta | made | moved | left_out
    said = {key: getattr(log_map, key) for key in ("pads", "reading_time", "command_time")}
    meta |= {key: value for key, value in said.items() if value not in (None, {})}
    log = Log(channels, meta)
    check_recorded(log)
    return log


def _chained(parts: Sequence[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
