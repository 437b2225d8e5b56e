"""The errors this package raises on purpose."""

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """Bad input from a user; the message is one line that says what, where and what is allowed."""


@contextmanager
def located(where: str) -> Iterator[None]:
    """Puts `where` in front of the message of an InputError raised inside."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}{error}") from None
