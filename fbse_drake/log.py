"""Logs: named channels over time, from a simulation or from a robot.

Row k holds what is known at `time[k]`: joint positions and velocities at that time; IMU and foot forces over the plant's step that ends
then; commanded torque, friction torque and the law of the friction (at the velocity that comes out
of the step) of the step that begins then.
"""

import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fbse_drake.errors import InputError, located
from fbse_drake.files import write_atomically
from fbse_drake.signals import channel_kind

if TYPE_CHECKING:
    import pandas
    import xarray

FORMAT_VERSION = 1

_REQUIRED = ("time", "joint/position")


@dataclass(frozen=True)
class Log(Mapping[str, np.ndarray]):
    """Channels by name, `log["joint/position"]`, and what is known about them.

    The contract's channels (N samples, n joints, SI, float64): `time` (N,), `joint/position`, `joint/velocity` and
    `joint/torque_command` (N, n), `imu/linear_acceleration` (specific force) and `imu/angular_velocity` (N, 3) in the IMU frame,
    `foot/<side>/pad_force` (N, pads, 3) in the sole frame or `foot/<side>/wrench` (N, 6) [moment, force]; further channels begin with
    `reference/`, `estimate/` or `truth/`, or are those of further sensors. Units and shapes of all
    are in `fbse_drake.signals`. A robot that does not know its joint torques has no
    `joint/torque_command`; nothing is said about the torques of its joints then.

    Raises:
        InputError: a channel is missing, unknown, of the wrong shape or not finite; time does not increase.
    """

    channels: dict[str, np.ndarray]
    # "joints": names in column order; "sides"; "legs": joints by side;
    # "frames"; "pads": places in the sole frames [m]; "period" [s]; "source"; "title";
    # "scenario": YAML text; "outcome"; "estimator_scenario": YAML text of the scenario whose estimator ran over the log afterwards.
    # Of a converted recording: "segments": the stretch that each file became; "findings": what was left out, in words.
    meta: dict[str, Any]

    def __post_init__(self) -> None:
        for name in _REQUIRED:
            if name not in self.channels:
                raise InputError(f"channel {name} is missing (required: {', '.join(_REQUIRED)})")
        for key in ("joints", "period"):
            if key not in self.meta:
                raise InputError(f"meta has no {key}")
        n, samples = len(self.meta["joints"]), len(self.channels["time"])
        if samples == 0:
            raise InputError("no samples")
        for name, values in self.channels.items():
            _, sample_shape = channel_kind(name)
            expected = (samples, *(n if size == "n" else size for size in sample_shape))
            if len(values.shape) != len(expected) or any(
                e not in ("m", s) for e, s in zip(expected, values.shape, strict=True)
            ):
                raise InputError(
                    f"channel {name}: expected shape {_shape_text(expected)}, found {_shape_text(values.shape)}"
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
                f"channel time: does not increase at row {row} (t = {self.channels['time'][row]:g} s)"
            )

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

    def part(self, rows: slice) -> "Log":
        """Some of its samples."""
        return Log({name: values[rows] for name, values in self.channels.items()}, self.meta)

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
        """Writes an npz file (compressed, no pickles), to a temporary name first. The same log gives the same bytes."""
        meta = {
            "format_version": FORMAT_VERSION,
            **self.meta,
            "units": {name: self.unit(name) for name in self.channels},
        }

        def write(partial: Path) -> None:
            with partial.open("wb") as file:
                np.savez_compressed(file, meta=np.array(json.dumps(meta)), **self.channels)

        write_atomically(Path(path), write)

    @classmethod
    def load(cls, path: str | Path) -> "Log":
        """Reads what `save` wrote.

        Raises:
            InputError: no such file, truncated, not a log, or another format version.
        """
        try:
            file = np.load(path, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise ValueError("a single array")
            with file:
                content = {name: file[name] for name in file.files}
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or 'not a log file (npz)'}") from None
        except (zipfile.BadZipFile, ValueError, EOFError, zlib.error) as error:
            raise InputError(f"{path}: truncated or not a log file (npz): {error}") from None
        if "meta" not in content:
            raise InputError(f"{path}: not a log file: it has no meta")
        try:
            meta = json.loads(str(content.pop("meta")))
        except json.JSONDecodeError:
            raise InputError(f"{path}: meta is not JSON text") from None
        version = meta.pop("format_version", None)
        meta.pop("units", None)
        if version != FORMAT_VERSION:
            raise InputError(
                f"{path}: log format version {version}, this program reads {FORMAT_VERSION}"
            )
        with located(f"{path}: "):
            return cls(content, meta)


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
                    f"{other_name}: cannot be one log with {name}: its {what} is {theirs}, not {ours}"
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
