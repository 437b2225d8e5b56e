"""Records: named numbers in one piece of memory, as `posterior.anchor[foot]`.

A posterior is a plain vector for Drake and a record for the estimators. A record is handed on as an
array without axes: in Python its fields are views, `posterior["anchor"][foot]`; a compiled function
takes the record out of it, `posterior[()]`, and writes `posterior.anchor[foot]`. (It could be
called with the record itself, but numba needs ten times as long to unpack one.)
"""

from dataclasses import is_dataclass
from functools import cache
from hashlib import sha256
from typing import Any, TypeAlias

import numpy as np
from numba import types

# A record in a compiled function, whose fields are its attributes.
Record: TypeAlias = Any


def _layout(record: types.Record) -> tuple[str, tuple[str, ...]]:
    """What tells a record from others in the names of functions that are compiled for it.

    numba takes a number that counts the types of a process. Two processes then may give one name to
    what each compiles for another robot, and whoever loads both from the cache calls the one for
    the other, with a record in which everything is elsewhere.
    """
    return "Record", (sha256(record.name.encode()).hexdigest(),)


types.Record.mangling_args = property(_layout)  # type: ignore[assignment, method-assign]


def record_type(**fields: tuple[int, ...] | np.dtype) -> np.dtype:
    """The type of a record of floats.

    Args:
        fields: shape of each, () for a number; or the type of a record within the record.
    """
    kinds = fields.items()
    return _only(np.dtype([(n, k if isinstance(k, np.dtype) else (float, k)) for n, k in kinds]))


def size_of(kind: np.dtype) -> int:
    """How many numbers a record has."""
    return kind.itemsize // np.dtype(float).itemsize


def as_record(vector: np.ndarray, kind: np.dtype) -> np.ndarray:
    """A vector (size,) seen as a record, not copied. (`vector.view` takes five times as long.)"""
    return np.ndarray((), kind, vector)


def parts(kind: np.dtype) -> dict[str, slice]:
    """Where the fields of a record are in its vector; fields without numbers are left out."""
    found, number = {}, np.dtype(float).itemsize
    for name, (field, offset, *_) in (kind.fields or {}).items():
        if field.itemsize > 0:
            start = offset // number
            found[name] = slice(start, start + size_of(field))
    return found


def record(**values: Any) -> np.ndarray:
    """A record of constants for compiled functions.

    Args:
        values: numbers, arrays, records, or dataclasses, whose numbers are taken.
    """
    arrays = {name: _as_array(value) for name, value in values.items()}
    kind = np.dtype([(name, x.dtype, x.shape) for name, x in arrays.items()], align=True)
    result = np.empty((), _only(kind))
    for name, array in arrays.items():
        result[name] = array
    return result


@cache
def _only(kind: np.dtype) -> np.dtype:
    """The first type that is equal to this one.

    Where two are equal but not the same, numba compares them, field by field, at every call.
    """
    return kind


def _as_array(value: Any) -> np.ndarray:
    if is_dataclass(value):
        return record(**{name: x for name, x in vars(value).items() if isinstance(x, int | float)})
    return np.asarray(float(value) if type(value) is int else value)
