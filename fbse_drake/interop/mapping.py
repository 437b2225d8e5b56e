"""What a recording's columns and topics mean: the schema of MAP.yaml.

    joints: [hip, knee]
    time: {column: t, unit: ms}
    channels:
      joint/position: {columns: [q1, q2], unit: deg}
      # Motor current [A] times Nm/A.
      joint/torque_command: {columns: [i1, i2], gains: [0.091, -0.091]}

A column that has several numbers in a row is meant with all of them (`q`), one (`q[0]`) or some
(`q[0:3]`). Joints that share motors are combinations of columns, and what another file recorded is
said by its name:

      joint/velocity: {columns: [m1, m2], matrix: [[0.5, 0.5], [0.5, -0.5]]}
      imu/angular_velocity: {topic: imu_*, columns: [wx, wy, wz]}
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix

from fbse_drake import resources, schema
from fbse_drake.errors import InputError, located, require_not_negative, require_positive
from fbse_drake.interop.units import si_factor
from fbse_drake.signals import channel_kind


@dataclass(frozen=True)
class ChannelMap:
    """Where the numbers of a channel come from:
    unit * (gain * gains_i * column_i [* times_i] + offsets_i), turned by the rotation.

    With a matrix, column_i stands for row i of it times all columns.
    """

    # Of a bag; by default the one that has the channel's standard message. Of files of rows that
    # lie side by side: what the file is called without its suffix, where `*` is any text.
    topic: str = ""
    # One for each component, or fewer that have several numbers in a row. Of a message: a field, as
    # `wrench.force`. An orientation is a quaternion [w, x, y, z] or roll, pitch and yaw.
    columns: list[str] = field(default_factory=list)
    # The columns are multiplied by these: one, or as many.
    times: list[str] = field(default_factory=list)
    # Columns that hold signed numbers of so many bits, recorded as if they had no sign; 0 if they
    # do not.
    signed_bits: int = 0
    # One row of factors for each component, one factor in it for each column.
    matrix: list[list[float]] = field(default_factory=list)
    gain: float = 1.0
    # One for each component.
    gains: list[float] = field(default_factory=list)
    offsets: list[float] = field(default_factory=list)
    # Of gain times column, and of the offsets; SI by default.
    unit: str = ""
    # Of an IMU's or a foot's channel: roll, pitch and yaw of the recorded frame in the frame that
    # the log wants [deg].
    rotation_deg: list[float] = field(default_factory=list)
    # Of a foot's wrench: where it was recorded, origin in the sole frame [m].
    position: list[float] = field(default_factory=list)
    # The channel is left out where a file has no such columns.
    optional: bool = False

    def __post_init__(self) -> None:
        for key in ("rotation_deg", "position"):
            if len(getattr(self, key)) not in (0, 3):
                raise InputError(f"{key}: expected three numbers, found {len(getattr(self, key))}")
        if len(self.times) not in (0, 1, len(self.columns)):
            raise InputError(
                f"times: expected one column or {len(self.columns)} as in columns, found "
                f"{len(self.times)}"
            )
        if len(set(map(len, self.matrix))) > 1:
            raise InputError("matrix: its rows are not of one length")
        if not 0 <= self.signed_bits <= 32:
            raise InputError(
                f"signed_bits: expected a number from 0 to 32, found {self.signed_bits}"
            )

    def channel(
        self, name: str, columns: np.ndarray, times: np.ndarray | None, joints: int
    ) -> np.ndarray:
        """Makes a channel, (N, ...), of recorded columns, (N, k).

        Args:
            name: of the channel.
            times: the columns that these are multiplied by, (N, 1) or (N, k), if any.
            joints: how many the log has.

        Raises:
            InputError: the number of columns does not fit the channel.
        """
        unit, shape = channel_kind(name)
        values = self._combined(columns, times)
        width = values.shape[1]
        if name.endswith("/orientation") and width == 3:
            return self._quaternions(values)
        expected = ("n" in shape and joints) or int(
            np.prod([size for size in shape if isinstance(size, int)])
        )
        if width != expected and not ("m" in shape and width and width % expected == 0):
            several = (
                " for each pad"
                if "m" in shape
                else f", one for each of {joints} joints"
                if "n" in shape
                else ""
            )
            raise InputError(f"columns: expected {expected} in all{several}, found {width}")
        for key in ("gains", "offsets"):
            if len(getattr(self, key)) not in (0, width):
                raise InputError(
                    f"{key}: expected {width} numbers, one for each component, found "
                    f"{len(getattr(self, key))}"
                )
        factor = si_factor(self.unit, unit, joint="n" in shape) if self.unit else 1.0
        if self.gain != 1.0 or factor != 1.0 or self.gains:
            values = values * (factor * self.gain * np.array(self.gains or 1.0))
        if self.offsets:
            values = values + factor * np.array(self.offsets)
        if self.rotation_deg or self.position:
            values = self._in_log_frame(values)
        return values.reshape(
            len(values), *(-1 if size == "m" else joints if size == "n" else size for size in shape)
        )

    def _combined(self, columns: np.ndarray, times: np.ndarray | None) -> np.ndarray:
        """Signed columns times others, and combinations of them, (N, components)."""
        values = columns
        if self.signed_bits:
            half = 2.0 ** (self.signed_bits - 1)
            values = np.mod(values + half, 2 * half) - half
        if times is not None:
            values = values * times
        if not self.matrix:
            return values
        if len(self.matrix[0]) != values.shape[1]:
            raise InputError(
                f"matrix: expected {values.shape[1]} factors in a row, one for each column, "
                f"found {len(self.matrix[0])}"
            )
        return values @ np.array(self.matrix).T

    def _quaternions(self, columns: np.ndarray) -> np.ndarray:
        """Orientations [w, x, y, z], (N, 4), of recorded roll, pitch and yaw, (N, 3)."""
        angles = si_factor(self.unit or "rad", "rad") * columns
        return np.array([RollPitchYaw(row).ToQuaternion().wxyz() for row in angles])

    def _in_log_frame(self, values: np.ndarray) -> np.ndarray:
        R_LS = RotationMatrix(
            RollPitchYaw(np.deg2rad(self.rotation_deg or [0.0, 0.0, 0.0]))
        ).matrix()
        vectors = values.reshape(len(values), -1, 3) @ R_LS.T
        if self.position:
            moment, force = vectors[:, 0], vectors[:, 1]
            vectors = np.stack([moment + np.cross(self.position, force), force], axis=1)
        return vectors.reshape(values.shape)


@dataclass(frozen=True)
class TimeMap:
    """The time of a file's rows. Messages of a bag bring their own."""

    # Empty: there is none, rows are one period apart.
    column: str = "time"
    unit: str = "s"

    def __post_init__(self) -> None:
        si_factor(self.unit, "s")


@dataclass(frozen=True)
class LogMap:
    """How a log is made of a recording."""

    # Names, in the order of the log's columns. Needed for files; by default those of the JointState
    # messages.
    joints: list[str] = field(default_factory=list)
    # What the same joints are called in JointState messages, if otherwise.
    recorded_joints: list[str] = field(default_factory=list)
    channels: dict[str, ChannelMap] = field(default_factory=dict)
    time: TimeMap = field(default_factory=TimeMap)
    # Nominal time between rows [s]; by default the median.
    period: float | None = None
    # See `LogMeta`: of a robot whose control is faster than the recording.
    reading_time: float | None = None
    command_time: float | None = None
    # The only topics of a bag that are read; by default all with standard messages.
    topics: list[str] = field(default_factory=list)
    # The key of a JSON file under which the records are; by default its only list of records.
    records: str = ""
    # Numbers and texts of a file that are kept with its stretch of the log, in meta["segments"].
    constants: list[str] = field(default_factory=list)
    # The stretch that is taken of each file [s], from its first row on.
    start: float = 0.0
    end: float | None = None
    # Time between the stretches of several files [s].
    gap: float = 1.0
    # Where a foot's force sensors are, in the sole frame [m].
    pads: dict[str, list[list[float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_positive(self, "gap", "period")
        require_not_negative(self, "reading_time", "command_time")
        if self.end is not None and not self.end > self.start:
            raise InputError(f"end: expected a number > start = {self.start:g}, found {self.end:g}")
        if len(set(self.joints)) != len(self.joints):
            raise InputError("joints: a name is given twice")
        if self.recorded_joints and len(self.recorded_joints) != len(self.joints):
            raise InputError(
                f"recorded_joints: expected {len(self.joints)} names as in joints, found "
                f"{len(self.recorded_joints)}"
            )
        if not self.time.column and self.period is None:
            raise InputError("period: needed where time has no column")
        for name, channel in self.channels.items():
            with located(f"channels.{name}: "):
                unit, shape = channel_kind(name)
                if name == "time":
                    raise InputError("not here: see the key time")
                if channel.unit:
                    si_factor(channel.unit, unit, joint="n" in shape)
                if channel.rotation_deg and not name.startswith(("imu/", "foot/")):
                    raise InputError(
                        "rotation_deg: only channels imu/... and foot/... can be turned"
                    )
                if channel.position and not name.endswith("/wrench"):
                    raise InputError("position: only wrenches have one")


def load_map(name_or_path: str | Path) -> LogMap:
    """Reads a map: a file, or one that ships with the package, as `real/emps` for
    `scenarios/real/emps.map.yaml`.

    Raises:
        InputError: file not found, unknown key, wrong type, unit or channel.
    """
    shipped = resources.folder("scenarios")
    file = next(
        (
            path
            for path in (Path(name_or_path), shipped / f"{name_or_path}.map.yaml")
            if path.is_file()
        ),
        None,
    )
    if file is None:
        names = sorted(
            str(path.relative_to(shipped)).removesuffix(".map.yaml")
            for path in shipped.rglob("*.map.yaml")
        )
        raise InputError(
            f"{name_or_path}: no such file, and no such map in scenarios/ (there are: "
            f"{', '.join(names)})"
        )
    return schema.build(LogMap, schema.load_tree(file), file=str(file))
