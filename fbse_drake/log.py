"""Logs: named channels over time, from a simulation or from a robot.

Row k holds what is known at `time[k]`: joint positions and velocities at that time; IMU and foot
forces over the plant's step that ends then; commanded torque, friction torque and the law of the
friction (at the velocity that comes out of the step) of the step that begins then.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fbse_drake import schema
from fbse_drake.errors import (
    InputError,
    located,
    require_not_negative,
    require_positive,
    require_type,
)
from fbse_drake.files import from_json, to_json, write_atomically
from fbse_drake.npz import read_npz
from fbse_drake.signals import channel_kind

if TYPE_CHECKING:
    import pandas
    import xarray

FORMAT_VERSION = 1

_REQUIRED = ("time", "joint/position")
# Keys of `LogMeta` with numbers that are calculated with.
_NUMBERS = ("period", "reading_time", "command_time", "pads", "segments")
# Not even a recording with gaps lacks more rows for each that it has.
_MOST_GAPS = 100


@dataclass(frozen=True)
class Outcome:
    """How a simulation ended."""

    # None of a recording, of which nobody knows.
    fell: bool | None
    reason: str
    finished: bool = True
    time: float | None = None


@dataclass(frozen=True)
class Frames:
    """Frames in the robot's model; the soles by side."""

    base: str = ""
    imu: str = ""
    soles: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class LogMeta:
    """What a log says beside its channels."""

    # Names, in the order of the columns.
    joints: list[str]
    # Nominal time between rows [s].
    period: float
    # A reading of accelerometer or foot force is the mean over so long before its row, a command is
    # held for so long from its row on [s]; by default the period. Rows that are rarer know nothing
    # of what is in between.
    reading_time: float | None = None
    command_time: float | None = None
    sides: list[str] = field(default_factory=list)
    # Joints by side.
    legs: dict[str, list[str]] = field(default_factory=dict)
    frames: Frames = field(default_factory=Frames)
    # Where the force sensors are in the sole frames [m], by side.
    pads: dict[str, list[list[float]]] = field(default_factory=dict)
    source: str = ""
    title: str = ""
    # YAML texts: of the scenario, and of the one whose estimator ran over the log afterwards.
    scenario: str = ""
    estimator_scenario: str = ""
    outcome: Outcome | None = None
    # Of a converted recording: the stretch that each file became ("start", "end" [s], and numbers
    # and texts that the map keeps), and what was left out, in words.
    segments: list[dict[str, Any]] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        require_positive(self, "period")
        require_not_negative(self, "reading_time", "command_time")
        for key in ("joints", "sides"):
            names = getattr(self, key)
            if len(set(names)) != len(names):
                raise InputError(f"{key}: a name is given twice")
        for side, places in self.pads.items():
            if any(len(place) != 3 for place in places):
                raise InputError(f"pads.{side}: expected places of three coordinates")
        segments = []
        for number, segment in enumerate(self.segments):
            span = {key: segment.get(key) for key in ("start", "end")}
            segments.append(
                segment | schema.build(dict[str, float], span, file=f"segments[{number}]")
            )
        object.__setattr__(self, "segments", segments)


@dataclass(frozen=True)
class Log(Mapping[str, np.ndarray]):
    """Channels by name, `log["joint/position"]`, and what is known about them.

    The contract's channels (N samples, n joints, SI, float64): `time` (N,), `joint/position`,
    `joint/velocity` and `joint/torque_command` (N, n), `imu/linear_acceleration` (specific force)
    and `imu/angular_velocity` (N, 3) in the IMU frame, `foot/<side>/pad_force` (N, pads, 3) in the
    sole frame or `foot/<side>/wrench` (N, 6) [moment, force]; further channels begin with
    `reference/`, `estimate/` or `truth/`, or are those of further sensors. Units and shapes of all
    are in `fbse_drake.signals`. A robot that does not know its joint torques has no
    `joint/torque_command`; nothing is said about the torques of its joints then.

    Raises:
        InputError: a channel is missing, unknown, of the wrong shape or not finite; time does not
            increase.

    >>> import numpy as np
    >>> from fbse_drake import Log
    >>> time = np.arange(0.0, 1.0, 0.01)
    >>> angle = 0.2 * np.sin(time)[:, None]
    >>> channels = {"time": time, "joint/position": angle}
    >>> log = Log(channels, {"joints": ["knee"], "period": 0.01})
    >>> log["joint/position"].shape, log.unit("joint/position")
    ((100, 1), 'rad')
    >>> log
    Log of 100 rows, 0 to 0.99 s, one every 0.01 s; joints: knee
      time            (100,)    s
      joint/position  (100, 1)  rad
    >>> Log({"time": time}, log.meta)
    Traceback (most recent call last):
    fbse_drake.errors.InputError: channel joint/position is missing (required: time, joint/position)
    """

    channels: dict[str, np.ndarray]
    # See `LogMeta`; further keys are kept.
    meta: dict[str, Any]

    def __post_init__(self) -> None:
        for name in _REQUIRED:
            if name not in self.channels:
                raise InputError(f"channel {name} is missing (required: {', '.join(_REQUIRED)})")
        for key in ("joints", "period"):
            if key not in self.meta:
                raise InputError(f"meta has no {key}")
        said = schema.build(LogMeta, self.meta, file="meta", further_keys=True)
        # Numbers that are written as texts, as YAML has 1e6, are numbers from here on.
        numbers = {key: getattr(said, key) for key in _NUMBERS if key in self.meta}
        object.__setattr__(self, "meta", self.meta | numbers)
        if self.time.ndim != 1:
            raise InputError(f"channel time: expected one row, found {self.time.ndim} dimensions")
        n, samples = len(self.meta["joints"]), len(self.time)
        if samples == 0:
            raise InputError("no samples")
        for name, values in self.channels.items():
            _, sample_shape = channel_kind(name)
            expected = (samples, *(n if size == "n" else size for size in sample_shape))
            if len(values.shape) != len(expected) or any(
                e not in ("m", s) for e, s in zip(expected, values.shape, strict=True)
            ):
                raise InputError(
                    f"channel {name}: expected shape {_shape_text(expected)}, found "
                    f"{_shape_text(values.shape)}"
                )
            if values.dtype.kind not in "fiub":
                raise InputError(f"channel {name}: expected numbers, found {values.dtype}")
            finite = np.isfinite(values).reshape(samples, -1).all(axis=1)
            if not finite.all():
                raise InputError(
                    f"channel {name}: not a finite number in row {int(finite.argmin())}"
                )
        backwards = np.diff(self.channels["time"]) <= 0
        if backwards.any():
            row = int(backwards.argmax()) + 1
            raise InputError(
                f"channel time: does not increase at row {row} (t = {self.channels['time'][row]:g} "
                "s)"
            )

    def __repr__(self) -> str:
        """Rows, joints, and the channels with their shapes and units: what a notebook shows."""
        start, end, period = self.time[0], self.time[-1], self.meta["period"]
        head = f"Log of {len(self.time)} rows, {start:g} to {end:g} s, one every {period:g} s"
        names = max(map(len, self))
        shapes = {name: str(values.shape) for name, values in self.items()}
        wide = max(map(len, shapes.values()))
        rows = [f"  {name:{names}}  {shapes[name]:{wide}}  {self.unit(name)}" for name in self]
        return "\n".join([f"{head}; joints: {', '.join(self.joints)}", *rows])

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.channels:
            raise KeyError(f"no channel {name} in this log (there are: {', '.join(self.channels)})")
        return self.channels[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.channels)

    def __len__(self) -> int:
        return len(self.channels)

    @property
    def time(self) -> np.ndarray:
        return self.channels["time"]

    @property
    def joints(self) -> list[str]:
        return self.meta["joints"]

    @property
    def sides(self) -> list[str]:
        return self.meta.get("sides", [])

    def unit(self, name: str) -> str:
        """Unit of a channel, as `rad/s`."""
        return channel_kind(name)[0]

    def part(self, rows: slice | np.ndarray) -> "Log":
        """Some of its samples; of every k-th the period is k times as long, k being the median if
        rows are given one by one."""
        channels = {name: values[rows] for name, values in self.channels.items()}
        apart = (rows.step or 1) if isinstance(rows, slice) else int(np.median(np.diff(rows)))
        return Log(channels, self.meta | {"period": self.meta["period"] * apart})

    def to_pandas(self) -> "pandas.DataFrame":
        """As a data frame, see `fbse_drake.interop.frames`.

        Raises:
            InputError: pandas is not installed (`fbse_drake[data]`).
        """
        from fbse_drake.interop.frames import to_pandas

        return to_pandas(self)

    def to_xarray(self) -> "xarray.Dataset":
        """As a data set, see `fbse_drake.interop.frames`.

        Raises:
            InputError: xarray is not installed (`fbse_drake[data]`).
        """
        from fbse_drake.interop.frames import to_xarray

        return to_xarray(self)

    def save(self, path: str | Path) -> None:
        """Writes an npz file (compressed, no pickles), to a temporary name first. The same log
        gives the same bytes.

        Raises:
            InputError: it could not be read again, see `check_recorded`.
        """
        with located(f"{path}: "):
            check_recorded(self)
        meta = {
            "format_version": FORMAT_VERSION,
            **self.meta,
            "units": {name: self.unit(name) for name in self.channels},
        }

        arrays: dict[str, Any] = {"meta": np.array(to_json(meta)), **self.channels}

        def write(partial: Path) -> None:
            with partial.open("wb") as file:
                np.savez_compressed(file, **arrays)

        write_atomically(Path(path), write)

    @classmethod
    def load(cls, path: str | Path) -> "Log":
        """Reads what `save` wrote.

        Raises:
            InputError: no such file, truncated, not a log, or another format version.
        """
        try:
            content = read_npz(path)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}") from None
        except ValueError as error:
            raise InputError(f"{path}: truncated or not a log file (npz): {error}") from None
        if "meta" not in content:
            raise InputError(f"{path}: not a log file: it has no meta")
        try:
            meta = from_json(str(content.pop("meta")))
        except ValueError:
            raise InputError(f"{path}: meta is not JSON text") from None
        if not isinstance(meta, dict):
            raise InputError(f"{path}: meta: expected a mapping, found {schema.describe(meta)}")
        version = meta.pop("format_version", None)
        meta.pop("units", None)
        if version != FORMAT_VERSION:
            raise InputError(
                f"{path}: log format version {version}, this program reads {FORMAT_VERSION}"
            )
        # Other programs may write integers, truth values or numbers of less digits.
        numbers = {
            name: values.astype(float, copy=False) if values.dtype.kind in "fiub" else values
            for name, values in content.items()
        }
        with located(f"{path}: "):
            log = cls(numbers, meta)
            check_recorded(log)
        return log


def check_recorded(log: Log) -> None:
    """Checks what only a damaged recording or a meaningless simulation has, however its numbers
    came about.

    Raises:
        InputError: numbers that nothing measurable has, or a period that is not that of the rows.
    """
    for name, values in log.items():
        most = _largest_number(name)
        if (largest := float(np.abs(values).max(initial=0.0))) > most:
            raise InputError(
                f"channel {name}: expected numbers of size at most {most:g}, found {largest:g}"
            )
    periods = float(log.time[-1] - log.time[0]) / float(log.meta["period"])
    if periods > _MOST_GAPS * len(log.time):
        raise InputError(
            f"meta.period: expected about the time between rows, found {log.meta['period']:g} s, "
            f"{periods:g} times in all for {len(log.time)} rows"
        )


def plausible_part(log: Log) -> Log:
    """The rows before the first with numbers that nothing measurable has.

    Raises:
        InputError: the first row has such numbers.
    """
    end = len(log.time)
    for name, values in log.items():
        beyond = np.abs(values[:end].reshape(end, -1)) > _largest_number(name)
        end = int(np.append(beyond.any(axis=1), True).argmax())
        if end == 0:
            check_recorded(log.part(slice(1)))
    return log.part(slice(end))


def _largest_number(channel: str) -> float:
    # What is believed of a sensor may be as large, and its variance is the square of that.
    return schema.LARGEST_NUMBER ** (2 if channel.endswith("_variance") else 1)


def joined(logs: Mapping[str, "Log"], gap: float = 1.0) -> Log:
    """Recordings of one robot as one log, one after the other.

    Channels that not all of them have are left out.

    Args:
        logs: by the names that they have in meta["segments"].
        gap: time between them [s].

    Raises:
        InputError: they have other joints or another period.
    """
    (name, first), *others = logs.items()
    if not others:
        return first
    for other_name, other in others:
        for what, ours, theirs in (
            ("joints", first.joints, other.joints),
            ("period", first.meta["period"], other.meta["period"]),
        ):
            if ours != theirs:
                raise InputError(
                    f"{other_name}: cannot be one log with {name}: its {what} is {theirs}, not "
                    f"{ours}"
                )
    segments: list[dict[str, Any]] = []
    times, begin = [], float(first.time[0])
    for name, log in logs.items():
        shift = begin - float(log.time[0])
        times.append(log.time + shift)
        whole = {"start": float(log.time[0]), "end": float(log.time[-1]), "source": name}
        for part in log.meta.get("segments", [whole]):
            # Part of a log has the segments of all of it.
            start = max(part["start"], whole["start"])
            end = min(part["end"], whole["end"])
            if start < end:
                segments.append(part | {"start": start + shift, "end": end + shift})
        begin = float(times[-1][-1]) + gap
    shared = [channel for channel in first if all(channel in log for log in logs.values())]
    channels = {
        channel: np.concatenate([log[channel] for log in logs.values()])
        for channel in shared
        if channel != "time"
    }
    return Log({"time": np.concatenate(times)} | channels, first.meta | {"segments": segments})


def _shape_text(shape: tuple[Any, ...]) -> str:
    return " x ".join(map(str, shape))


def require_log(log: object) -> None:
    """Refuses what is no log, as its file."""
    require_type("log", log, Log, "Log.load or convert")
