"""Reading npz files that anybody may have written: nothing is allocated that the file cannot
hold."""

import math
import os
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy

# Deflate makes at most so many bytes of one.
_COMPRESSION = 1032
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged, or has arrays that are no plain numbers or texts, or larger than
            the file or this machine's memory can hold.
    """
    with Path(path).open("rb") as content:
        try:
            return _arrays(content)
        # Parsers of damaged headers raise anything.
        except Exception as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise ValueError(reason) from None


def _arrays(content: BinaryIO) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(content) as file:
        members = file.infolist()
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if (size := sum(member.file_size for member in members)) > memory:
            raise ValueError(f"{size} bytes are more than this machine's memory")
        return {member.filename.removesuffix(".npy"): _array(file, member) for member in members}


def _array(file: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    if member.file_size > _COMPRESSION * (member.compress_size + 1):
        raise ValueError(f"{member.filename} cannot be as large as it says")
    with file.open(member) as content:
        version = npy.read_magic(content)
        if version not in _HEADERS:
            raise ValueError(f"{member.filename} has a header of version {version}")
        shape, in_columns, kind = _HEADERS[version](content)
        if kind.hasobject:
            raise ValueError(f"{member.filename} holds objects, not numbers")
        if any(length < 0 for length in shape):
            raise ValueError(f"{member.filename} has a shape of {shape}")
        size = math.prod(shape) * kind.itemsize
        data = content.read(member.file_size)
    if size != len(data):
        raise ValueError(f"{member.filename} has {len(data)} bytes of data, expected {size}")
    return np.frombuffer(data, kind).reshape(shape, order="F" if in_columns else "C").copy()
