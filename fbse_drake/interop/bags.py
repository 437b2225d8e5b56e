"""ROS 1 and ROS 2 bags, read with `rosbags`."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fbse_drake.errors import InputError, located
from fbse_drake.files import from_json
from fbse_drake.interop.mapping import ChannelMap, LogMap
from fbse_drake.interop.messages import Layout
from fbse_drake.interop.tables import Growing, Progress, listed, readable
from fbse_drake.signals import is_channel

# What reads bags is imported where there is one.
if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

JOINT_STATE, IMU, WRENCH = (
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Imu",
    "geometry_msgs/msg/WrenchStamped",
)
# What holds channels that have no standard message, and what our own files say beside their
# channels.
ARRAY, METADATA = "std_msgs/msg/Float64MultiArray", "fbse_drake"
# Channel -> field of the standard message.
JOINT_STATE_FIELDS = {
    "joint/position": "position",
    "joint/velocity": "velocity",
    "joint/torque_command": "effort",
}
IMU_FIELDS = {
    "imu/linear_acceleration": "linear_acceleration",
    "imu/angular_velocity": "angular_velocity",
}
_WRENCH_FIELDS = ["wrench.torque", "wrench.force"]
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
# Messages that are decoded at a time.
_BLOCK = 4096
_SUFFIXES = (".bag", ".db3", ".mcap")


@dataclass(frozen=True)
class TopicRows:
    """Messages of one topic, in the order of the bag."""

    # Times in the messages' headers (0 where there are none), and of their receipt [ns], (N,).
    stamps: np.ndarray
    received: np.ndarray
    # Fields, (N, k); NaN where a message has another number of them.
    columns: dict[str, np.ndarray]


def is_bag(path: Path) -> bool:
    """Whether a path is that of a bag, by its name."""
    return path.is_dir() or path.suffix in _SUFFIXES


class Bag:
    """An open bag."""

    def __init__(self, reader: "AnyReader"):
        self._reader = reader
        self._definitions = reader.typestore.fielddefs
        self._connections: dict[str, Connection] = {}
        for connection in reader.connections:
            self._connections.setdefault(connection.topic, connection)
        self._first: dict[str, Layout] = {}

    def topics(self) -> dict[str, str]:
        """Those that have messages, with the messages' type."""
        return {
            topic: connection.msgtype
            for topic, connection in self._connections.items()
            if connection.msgcount
        }

    def channels(self, log_map: LogMap) -> tuple[dict[str, ChannelMap], list[str]]:
        """Channels of the standard messages, with the map's on top; what was left out, in words.

        Raises:
            InputError: a topic that the map names is not there, it is not clear which is meant, or
                there are no joint positions.
        """
        present = self.topics()
        mapped = {
            name: c
            for name, c in log_map.channels.items()
            if not (c.optional and c.topic and c.topic not in present)
        }
        for topic in [
            *log_map.topics,
            *(channel.topic for channel in mapped.values() if channel.topic),
        ]:
            if topic not in present:
                raise InputError(
                    f"topic {topic}: not in this bag, or empty (there are: {listed(list(present))})"
                )
        standard, left_out = self._standard_channels(
            mapped, {topic: present[topic] for topic in log_map.topics or present}
        )
        channels = dict(standard)
        for name, channel in mapped.items():
            known = standard.get(name, ChannelMap())
            topic = channel.topic or known.topic
            if not topic:
                raise InputError(f"channels.{name}: no topic is named")
            wrench = _WRENCH_FIELDS if present[topic] == WRENCH else []
            channels[name] = replace(
                channel, topic=topic, columns=channel.columns or known.columns or wrench
            )
        if "joint/position" not in channels:
            raise InputError(
                f"no {JOINT_STATE} topic, and no map names joint/position (topics: "
                f"{listed(list(present))})"
            )
        return channels, left_out

    def _standard_channels(
        self, mapped: Mapping[str, ChannelMap], present: Mapping[str, str]
    ) -> tuple[dict[str, ChannelMap], list[str]]:
        channels: dict[str, ChannelMap] = {}
        left_out = []
        for kind, fields in ((JOINT_STATE, JOINT_STATE_FIELDS), (IMU, IMU_FIELDS)):
            chosen = dict.fromkeys(
                mapped[name].topic for name in fields if name in mapped and mapped[name].topic
            )
            topics = [topic for topic in chosen or present if present.get(topic) == kind]
            if len(topics) > 1 and not chosen:
                raise InputError(
                    f"several {kind} topics ({listed(topics)}); a map's key topics chooses"
                )
            for topic in topics[:1]:
                first, names = self.first(topic), self.joints(topic)
                columns = {
                    name: field
                    for name, field in fields.items()
                    if first.width(field) == (len(names) or 3)
                }
                channels |= {
                    name: ChannelMap(topic=topic, columns=[field])
                    for name, field in columns.items()
                }
        chosen = dict.fromkeys(channel.topic for channel in mapped.values())
        for topic in (
            topic for topic, kind in present.items() if kind == WRENCH and topic not in chosen
        ):
            side = _side(topic)
            name = f"foot/{side}/wrench"
            if side is None:
                left_out.append(
                    f"topic {topic}, a wrench, is left out: its name says neither left nor right; "
                    "a map can"
                )
            elif name in channels:
                raise InputError(
                    f"topics {channels[name].topic} and {topic} are both {side}; a map's key "
                    "topics chooses"
                )
            elif not (name in mapped and mapped[name].topic):
                channels[name] = ChannelMap(topic=topic, columns=_WRENCH_FIELDS)
        for topic, kind in present.items():
            if kind == ARRAY and is_channel(topic[1:]):
                channels[topic[1:]] = ChannelMap(topic=topic, columns=["data"])
                # The wrench of a foot whose pads are known is made of these.
                if topic.endswith("/pad_force"):
                    channels.pop(topic[1:].replace("pad_force", "wrench"), None)
        return channels, left_out

    def first(self, topic: str) -> Layout:
        """The layout of a topic's first message."""
        if topic not in self._first:
            _, _, raw = next(self._reader.messages([self._connections[topic]]))
            self._first[topic] = self._layout(topic, raw)
        return self._first[topic]

    def joints(self, topic: str) -> list[str]:
        """The joints that the messages of a topic name."""
        return (
            self.first(topic).texts.get("name", [])
            if self._connections[topic].msgtype == JOINT_STATE
            else []
        )

    def read(
        self, wanted: Mapping[str, Sequence[str]], joints: Sequence[str], progress: Progress
    ) -> tuple[dict[str, TopicRows], list[str]]:
        """Reads fields of topics, in one pass.

        Args:
            wanted: topic -> fields.
            joints: these are taken of JointState messages, in this order.

        Returns:
            What was read; what was left out, in words.

        Raises:
            InputError: a topic has no such joints or fields.
        """
        topics: dict[str, _Collected] = {}
        for name, paths in wanted.items():
            first, names = self.first(name), self.joints(name)
            for path in paths:
                if not first.width(path):
                    raise InputError(
                        f"topic {name}: its messages have no numbers {path} (there are: "
                        f"{listed(list(first.numbers))})"
                    )
            for joint in joints:
                if names and joint not in names:
                    raise InputError(
                        f"joints: {joint} is not in the messages of {name} (there are: "
                        f"{listed(names)})"
                    )
            widths = {path: len(joints) if names else first.width(path) for path in paths}
            topics[name] = _Collected(widths, joints if names else [])
        connections = [
            c
            for c in self._reader.connections
            if c.topic in wanted and c.msgtype == self._connections[c.topic].msgtype
        ]
        total = sum(connection.msgcount for connection in connections)
        for count, (connection, received, raw) in enumerate(self._reader.messages(connections)):
            topic = topics[connection.topic]
            topic.received.append(received)
            topic.pending.append(raw)
            if len(topic.pending) == _BLOCK:
                topic.decode(partial(self._layout, connection.topic))
                progress(f"reading messages: {min(1.0, count / total):.0%}")
        for name, topic in topics.items():
            topic.decode(partial(self._layout, name))
        left_out = [
            f"{topic.foreign} messages of {name} are left out: they have not all of the joints "
            f"{listed(joints)}"
            for name, topic in topics.items()
            if topic.foreign
        ]
        return {name: topic.rows() for name, topic in topics.items()}, left_out

    def _layout(self, topic: str, raw: bytes) -> Layout:
        with located(f"topic {topic}: "):
            return Layout.of(
                bytes(raw),
                self._connections[topic].msgtype,
                self._definitions,
                cdr=self._reader.is2,
            )


@dataclass
class _Collected:
    """What has been read of a topic."""

    # Field -> how many numbers it has.
    widths: dict[str, int]
    joints: Sequence[str]
    # Messages that are not decoded yet, and when they were received [ns].
    pending: list[bytes] = field(default_factory=list)
    received: list[int] = field(default_factory=list)
    # Messages that are not about these joints.
    foreign: int = 0

    def __post_init__(self) -> None:
        self._stamps, self._received = Growing((), np.int64), Growing((), np.int64)
        self._columns = {path: Growing((width,), float) for path, width in self.widths.items()}

    def decode(self, layout_of: Callable[[bytes], Layout]) -> None:
        """Decodes the pending messages, all of one layout at once."""
        count = len(self.pending)
        stamps, ours = np.zeros(count, dtype=np.int64), np.ones(count, dtype=bool)
        columns = {path: np.full((count, width), np.nan) for path, width in self.widths.items()}
        sizes = np.array([len(raw) for raw in self.pending])
        todo = np.arange(count)
        while todo.size:
            layout = layout_of(self.pending[todo[0]])
            rows = todo[sizes[todo] == layout.size]
            block = np.frombuffer(b"".join(self.pending[row] for row in rows), np.uint8).reshape(
                -1, layout.size
            )
            fits = layout.fits(block)
            rows, block = rows[fits], block[fits]
            todo = np.setdiff1d(todo, rows, assume_unique=True)
            if layout.width("header.stamp") == 2:
                seconds, nanoseconds = layout.decode(block, "header.stamp").astype(np.int64).T
                stamps[rows] = seconds * 10**9 + nanoseconds
            names = layout.texts.get("name", [])
            if self.joints and not set(self.joints) <= set(names):
                ours[rows] = False
                continue
            order = [names.index(joint) for joint in self.joints]
            for path, values in columns.items():
                decoded = layout.decode(block, path)
                if order and decoded.shape[1] == len(names):
                    decoded = decoded[:, order]
                if decoded.shape[1] == values.shape[1]:
                    values[rows] = decoded
        self._stamps.extend(stamps[ours])
        self._received.extend(np.array(self.received, dtype=np.int64)[ours])
        for path, values in columns.items():
            self._columns[path].extend(values[ours])
        self.foreign += count - int(ours.sum())
        self.pending, self.received = [], []

    def rows(self) -> TopicRows:
        """All that was decoded."""
        return TopicRows(
            self._stamps.rows(),
            self._received.rows(),
            {path: column.rows() for path, column in self._columns.items()},
        )


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Opens a bag: a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.

    Raises:
        InputError: not a bag, damaged or truncated; also when that shows while it is being read.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with readable(path, "a bag"):
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            files = sorted(file for file in path.iterdir() if file.suffix in _SUFFIXES)
            if len(files) != 1:
                raise InputError(
                    "expected the folder of a bag, with a metadata.yaml or one bag file; found "
                    f"{len(files)} bag files"
                )
            path = files[0]
        if not path.is_dir() and path.stat().st_size == 0:
            raise InputError("empty")
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield Bag(reader)


def own_meta(path: Path) -> dict[str, Any]:
    """What a log that became this bag said beside its channels; nothing in a bag of others.

    Raises:
        InputError: a damaged bag.
    """
    if path.suffix != ".mcap":
        return {}
    from mcap.reader import make_reader

    with readable(path, "a bag"), path.open("rb") as file:
        for record in make_reader(file).iter_metadata():
            if record.name == METADATA:
                meta = from_json(record.metadata.get("meta", ""))
                return meta if isinstance(meta, dict) else {}
    return {}


def _side(topic: str) -> str | None:
    """The side that a topic's name tells."""
    sides = {_SIDES[word] for word in re.split(r"[^a-z]+", topic.lower()) if word in _SIDES}
    return sides.pop() if len(sides) == 1 else None
