"""Logs to files of other programs."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fbse_drake.errors import InputError, located
from fbse_drake.files import to_json, write_atomically, write_text
from fbse_drake.interop.bags import ARRAY, IMU, JOINT_STATE, METADATA, WRENCH
from fbse_drake.interop.foxglove import foxglove_layout
from fbse_drake.interop.messages import Layout
from fbse_drake.interop.transforms import Transform, robot_frames
from fbse_drake.log import Log

# Fields of the standard messages, and the channels that they hold.
_NAMES = {
    "/joint_states": {
        "position": "joint/position",
        "velocity": "joint/velocity",
        "effort": "joint/torque_command",
    },
    "/imu": {field: f"imu/{field}" for field in ("angular_velocity", "linear_acceleration")},
}
TF, STRING = "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"
_IN_STANDARD_MESSAGES = {"time", *(name for of in _NAMES.values() for name in of.values())}
# Messages that are made at a time.
_BLOCK = 4096


def writer_for(path: Path) -> Callable[[Log, Path], None]:
    """What writes a log to a file of this name.

    Raises:
        InputError: nothing does.
    """
    writers = {".npz": Log.save, ".mcap": write_mcap, ".csv": write_csv}
    if path.suffix not in writers:
        raise InputError(f"{path}: expected a file name that ends in {', '.join(writers)}")
    return writers[path.suffix]


def write_mcap(log: Log, path: Path) -> None:
    """Writes the sensors' channels as ROS 2 messages: sensor_msgs/JointState on /joint_states
    (effort is the commanded torque), sensor_msgs/Imu on /imu and geometry_msgs/WrenchStamped on
    /foot/<side>/wrench, at the sole frame `<side>_sole`. Where the log says of which robot it is,
    its frames are on /tf and /tf_static and its URDF is on /robot_description (`robot_frames`).
    Every other channel becomes std_msgs/Float64MultiArray on the topic of its name, as
    /estimate/com/position. The units are in the metadata of the topics, and what the log says
    beside its channels in the file's: it can be read back. Beside the file a layout for Foxglove
    is written, unless it is there: `<name>.layout.json`.


    Raises:
        InputError: times are negative, or it is not known where a foot's force sensors are.
    """
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    stamps = np.rint(log.time * 1e9).astype(np.int64)
    if stamps[0] < 0:
        raise InputError(
            f"{path}: messages cannot have times before 0; this log begins at {log.time[0]:g} s"
        )
    store = get_typestore(Stores.ROS2_HUMBLE)
    frames = robot_frames(log)
    topics = list(_topics(log, store.types))
    once: list[tuple[str, Any]] = []
    if frames is not None:
        moving = [frame for frame in frames.transforms if not frame.is_fixed]
        fixed = [frame for frame in frames.transforms if frame.is_fixed]
        topics += _moving_frames(moving, store.types)
        once = [
            ("/tf_static", _tf_message(fixed, stamps[0], store.types)),
            ("/robot_description", store.types[STRING](frames.urdf)),
        ]

    def write(partial: Path) -> None:
        with partial.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2", library="fbse_drake")
            made = []
            schemas: dict[str, int] = {}

            def schema_of(kind: str) -> int:
                if kind not in schemas:
                    definition = store.generate_msgdef(kind, ros_version=2)[0].encode()
                    schemas[kind] = writer.register_schema(kind, "ros2msg", definition)
                return schemas[kind]

            for topic, message, fields in topics:
                kind = message.__msgtype__
                schema = schema_of(kind)
                raw = bytes(store.serialize_cdr(message, kind))
                layout = Layout.of(raw, kind, store.fielddefs, cdr=True)
                units = {field: log.unit(name) for field, name in _NAMES.get(topic, {}).items()}
                if kind == ARRAY:
                    units = {"data": log.unit(topic[1:])}
                channel = writer.register_channel(topic, "cdr", schema, metadata=units)
                made.append((channel, layout, raw, fields))
            writer.add_metadata(METADATA, {"meta": to_json(log.meta)})
            for topic, message in once:
                kind = message.__msgtype__
                writer.add_message(
                    writer.register_channel(topic, "cdr", schema_of(kind)),
                    log_time=int(stamps[0]),
                    data=bytes(store.serialize_cdr(message, kind)),
                    publish_time=int(stamps[0]),
                )
            for start in range(0, len(stamps), _BLOCK):
                rows = slice(start, start + _BLOCK)
                stamp = np.stack(np.divmod(stamps[rows], 10**9), axis=1)
                blocks = [
                    (
                        channel,
                        layout.encode(
                            raw,
                            {
                                **_stamps(layout, stamp),
                                **{name: values[rows] for name, values in fields.items()},
                            },
                        ),
                    )
                    for channel, layout, raw, fields in made
                ]
                for row, time in enumerate(stamps[rows].tolist()):
                    for channel, block in blocks:
                        writer.add_message(
                            channel,
                            log_time=time,
                            data=block[row].tobytes(),
                            publish_time=time,
                            sequence=start + row,
                        )
            writer.finish()

    write_atomically(path, write)
    beside = path.with_suffix(".layout.json")
    if not beside.exists():
        write_text(beside, to_json(foxglove_layout(log, has_frames=frames is not None)))


def _stamps(layout: Layout, stamp: np.ndarray) -> dict[str, np.ndarray]:
    """Of the headers of a message of this layout: seconds and nanoseconds, (N, 2) each."""
    paths = ("header.stamp", "transforms.header.stamp")
    return {
        path: np.repeat(stamp, layout.width(path) // 2, axis=1)
        for path in paths
        if layout.width(path)
    }


def _tf_message(frames: Sequence[Transform], stamp: int, types: dict[str, Any]) -> Any:
    """Frames at their first sample."""
    time = types["builtin_interfaces/msg/Time"](*(int(part) for part in divmod(stamp, 10**9)))
    transforms = [
        types["geometry_msgs/msg/TransformStamped"](
            types["std_msgs/msg/Header"](time, frame.parent),
            frame.child,
            types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*frame.translation[0].tolist()),
                types["geometry_msgs/msg/Quaternion"](*frame.rotation[0].tolist()),
            ),
        )
        for frame in frames
    ]
    return types[TF](transforms)


def _moving_frames(
    frames: Sequence[Transform], types: dict[str, Any]
) -> list[tuple[str, Any, dict[str, np.ndarray]]]:
    """As `_topics`; a field of all elements of a list holds one component after the other."""
    if not frames:
        return []
    fields = {
        f"transforms.transform.{kind}": np.stack(
            [getattr(frame, kind) for frame in frames], axis=2
        ).reshape(len(frames[0].translation), -1)
        for kind in ("translation", "rotation")
    }
    return [("/tf", _tf_message(frames, 0, types), fields)]


def write_csv(log: Log, path: Path) -> None:
    """Writes all channels as columns: `joint/position/<joint>`, `imu/angular_velocity[0]`, ..."""
    names: list[str] = []
    for name, values in log.items():
        width = values[0].size
        parts = (
            [""]
            if values.ndim == 1
            else [f"/{j}" for j in log.joints]
            if "joint/" in name
            else [f"[{i}]" for i in range(width)]
        )
        names.extend(f"{name}{part}" for part in parts)
    rows = np.hstack([values.reshape(len(log.time), -1) for values in log.values()])
    write_atomically(
        path,
        lambda partial: np.savetxt(
            partial, rows, fmt="%.17g", delimiter=",", header=",".join(names), comments=""
        ),
    )


def _topics(log: Log, types: dict[str, Any]) -> Iterator[tuple[str, Any, dict[str, np.ndarray]]]:
    """Topic, a message of the right layout, and the fields whose numbers change, (N, k)."""

    def header(frame: str) -> Any:
        return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), frame)

    def zero() -> Any:
        return types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)

    joints = {field: log[name] for field, name in _NAMES["/joint_states"].items() if name in log}
    zeros = [
        np.zeros(len(log.joints) if field in joints else 0)
        for field in ("position", "velocity", "effort")
    ]
    yield "/joint_states", types[JOINT_STATE](header(""), list(log.joints), *zeros), joints

    imu = {field: log[name] for field, name in _NAMES["/imu"].items() if name in log}
    if imu:
        # The convention for: no orientation is measured.
        no_orientation = np.array([-1.0, *np.zeros(8)])
        upright = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        yield (
            "/imu",
            types[IMU](
                header("imu"), upright, no_orientation, zero(), np.zeros(9), zero(), np.zeros(9)
            ),
            imu,
        )

    wrenches = {f"foot/{side}/wrench" for side in log.sides}
    for name, values in log.items():
        if name not in _IN_STANDARD_MESSAGES and name not in wrenches:
            rows = values.reshape(len(values), -1)
            layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
            yield f"/{name}", types[ARRAY](layout, np.zeros(rows.shape[1])), {"data": rows}

    for side in log.sides:
        wrench = _wrench(log, side)
        if wrench is not None:
            message = types[WRENCH](
                header(f"{side}_sole"), types["geometry_msgs/msg/Wrench"](zero(), zero())
            )
            yield (
                f"/foot/{side}/wrench",
                message,
                {"wrench.torque": wrench[:, :3], "wrench.force": wrench[:, 3:]},
            )


def _wrench(log: Log, side: str) -> np.ndarray | None:
    """Moment and force on a foot at its sole frame, in the sole frame, (N, 6) [Nm, N]; None where
    they were not measured."""
    if f"foot/{side}/wrench" in log:
        return log[f"foot/{side}/wrench"]
    if f"foot/{side}/pad_force" not in log:
        return None
    with located(f"channel foot/{side}/pad_force: "):
        forces, places = (
            log[f"foot/{side}/pad_force"],
            np.array(log.meta.get("pads", {}).get(side, [])),
        )
        if places.shape != forces.shape[1:]:
            raise InputError(
                "meta has no pads for it: where the force sensors are, in the sole frame"
            )
    return np.hstack([np.cross(places, forces).sum(axis=1), forces.sum(axis=1)])
