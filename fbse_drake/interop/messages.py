"""Where the numbers of a ROS message stand in its bytes.

Messages of one topic have the same layout as long as their texts and the lengths of their lists
stay the same. It is worked out once and then whole blocks of messages are decoded at a time, which
is some twenty times faster than one message object after another.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Nodetype

from fbse_drake.errors import InputError

_DTYPES = {
    name: name
    for name in (
        "int8",
        "int16",
        "int32",
        "int64",
        "uint8",
        "uint16",
        "uint32",
        "uint64",
        "float32",
        "float64",
    )
}
_DTYPES |= {"bool": "uint8", "byte": "uint8", "char": "uint8"}

# Fields of message types, as rosbags.typesys.store.Typestore.fielddefs.
Definitions = Mapping[str, Any]


@dataclass(frozen=True)
class Layout:
    """The layout of a message of `size` bytes."""

    size: int
    # Field, as `wrench.force.x` -> type and places of its numbers. Fields of all elements of a list
    # have one name.
    numbers: dict[str, tuple[np.dtype, np.ndarray]]
    texts: dict[str, list[str]]
    # Places of the bytes that decide on the layout, and these bytes.
    fixed: np.ndarray
    fixed_bytes: np.ndarray

    @classmethod
    def of(cls, raw: bytes, kind: str, definitions: Definitions, *, cdr: bool) -> "Layout":
        """Works out the layout of a message.

        Args:
            kind: its type, as `sensor_msgs/msg/Imu`.
            cdr: a ROS 2 message; else one of ROS 1.

        Raises:
            InputError: the bytes are not such a message.
        """
        try:
            walk = _Walk(raw, definitions, cdr)
            walk.message(kind, "")
        except (struct.error, UnicodeDecodeError, KeyError, ValueError) as error:
            raise InputError(f"a damaged {kind} message: {' '.join(str(error).split())}") from None
        fixed = np.array(walk.fixed, dtype=int)
        numbers = {
            path: (dtype, np.concatenate(places)) for path, (dtype, places) in walk.numbers.items()
        }
        return cls(len(raw), numbers, walk.texts, fixed, np.frombuffer(raw, np.uint8)[fixed])

    def leaves(self, path: str) -> list[str]:
        """The fields with numbers that are meant by a field's name: itself or all below it."""
        return [name for name in self.numbers if name == path or name.startswith(f"{path}.")]

    def width(self, path: str) -> int:
        """How many numbers a field has."""
        return sum(len(self.numbers[name][1]) for name in self.leaves(path))

    def fits(self, block: np.ndarray) -> np.ndarray:
        """Which messages of this size, bytes (B, size), have this layout, (B,)."""
        return (block[:, self.fixed] == self.fixed_bytes).all(axis=1)

    def decode(self, block: np.ndarray, path: str) -> np.ndarray:
        """A field's numbers in messages of this layout, bytes (B, size) -> (B, k)."""
        return np.hstack(
            [self._decode(block, *self.numbers[name]) for name in self.leaves(path)]
            or [np.empty((len(block), 0))]
        )

    def encode(self, raw: bytes, fields: Mapping[str, np.ndarray]) -> np.ndarray:
        """Copies of a message of this layout with other numbers in some fields, (B, k)
        each -> bytes (B, size)."""
        block = np.tile(np.frombuffer(raw, np.uint8), (len(next(iter(fields.values()))), 1))
        for path, values in fields.items():
            first = 0
            for name in self.leaves(path):
                dtype, places = self.numbers[name]
                numbers = np.ascontiguousarray(values[:, first : first + len(places)], dtype=dtype)
                block[:, (places[:, None] + np.arange(dtype.itemsize)).ravel()] = numbers.view(
                    np.uint8
                )
                first += len(places)
        return block

    @staticmethod
    def _decode(block: np.ndarray, dtype: np.dtype, places: np.ndarray) -> np.ndarray:
        taken = block.take((places[:, None] + np.arange(dtype.itemsize)).ravel(), axis=1)
        return taken.view(dtype).astype(float)


class _Walk:
    """Goes through a message field by field."""

    def __init__(self, raw: bytes, definitions: Definitions, cdr: bool):
        if cdr and raw[:2] not in (b"\0\0", b"\0\1"):
            raise ValueError("an unknown encapsulation")
        self.raw, self.definitions, self.cdr = raw, definitions, cdr
        # CDR has four bytes in front that say how it is encoded; numbers stand at multiples of
        # their size after these.
        self.position = 4 if cdr else 0
        self.order: Literal["<", ">"] = ">" if cdr and raw[1] == 0 else "<"
        self.numbers: dict[str, tuple[np.dtype, list[np.ndarray]]] = {}
        self.texts: dict[str, list[str]] = {}
        self.fixed: list[int] = list(range(self.position))

    def message(self, kind: str, prefix: str) -> None:
        _, fields = self.definitions[kind]
        for name, description in fields:
            self.field(prefix + name, *description)

    def field(self, path: str, node: Nodetype, content: Any) -> None:
        if node == Nodetype.NAME:
            self.message(content, f"{path}.")
        elif node == Nodetype.BASE:
            self.values(path, content[0], 1)
        else:
            (kind, element), count = content
            if node == Nodetype.SEQUENCE:
                count = self.length()
            if kind == Nodetype.BASE:
                self.values(path, element[0], count)
            else:
                for _ in range(self.checked(count)):
                    self.message(element, f"{path}.")

    def values(self, path: str, kind: str, count: int) -> None:
        if kind == "string":
            texts = self.texts.setdefault(path, [])
            texts.extend(self.text() for _ in range(self.checked(count)))
            return
        dtype = np.dtype(_DTYPES[kind]).newbyteorder(self.order)
        if count:
            self.align(dtype.itemsize)
        start = self.advance(count * dtype.itemsize)
        self.numbers.setdefault(path, (dtype, []))[1].append(
            start + dtype.itemsize * np.arange(count)
        )

    def length(self) -> int:
        self.align(4)
        start = self.advance(4)
        self.fixed.extend(range(start, start + 4))
        return struct.unpack_from(f"{self.order}I", self.raw, start)[0]

    def text(self) -> str:
        size = self.length()
        start = self.advance(size)
        self.fixed.extend(range(start, start + size))
        return self.raw[start : start + size].rstrip(b"\0").decode()

    def align(self, size: int) -> None:
        if self.cdr:
            self.position += (4 - self.position) % size

    def advance(self, size: int) -> int:
        """Goes on; returns where it was."""
        start, self.position = self.position, self.position + self.checked(size)
        return start

    def checked(self, size: int) -> int:
        if size > len(self.raw) - self.position:
            raise ValueError(f"{len(self.raw)} bytes are too few")
        return size
