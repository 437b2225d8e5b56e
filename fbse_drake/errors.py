"""The errors this package raises on purpose."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from numbers import Real


def on_one_line(text: str) -> str:
    """The text with what is not printable escaped: nothing that it quotes can end a line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class InputError(ValueError):
    """Bad input from a user; the message is one line that says what, where and what is allowed."""

    def __init__(self, message: str):
        """Whatever is quoted in the message, it stays one line."""
        super().__init__(on_one_line(message))


@contextmanager
def located(where: str) -> Iterator[None]:
    """Puts `where` in front of the message of an InputError raised inside."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}{error}") from None


def require_type(name: str, value: object, expected: type, made_by: str) -> None:
    """Refuses an argument of another type.

    Args:
        made_by: where one comes from, as `load_scenario`.
    """
    if not isinstance(value, expected):
        raise InputError(
            f"{name}: expected a {expected.__name__} (as {made_by} gives), found "
            f"{type(value).__name__}"
        )


def _numbers(config: object, names: Iterable[str]) -> Iterator[tuple[str, float]]:
    """Those of these fields that are given (not None)."""
    for name in names:
        value = getattr(config, name)
        if value is None:
            continue
        if not isinstance(value, Real):
            raise InputError(f"{name}: expected a number, found {value!r:.80}")
        yield name, float(value)


def require_positive(config: object, *names: str) -> None:
    """Refuses a configuration in which one of these is given (not None) and no number > 0."""
    for name, value in _numbers(config, names):
        if not value > 0:
            raise InputError(f"{name}: expected a number > 0, found {value:g}")


def required(value: float | None, name: str) -> float:
    """A number that a configuration may leave open, which is known by now: a `Scenario` gives its
    parts the periods that they have not.

    Raises:
        InputError: it is still open.
    """
    if value is None:
        raise InputError(f"{name}: expected a number, as nothing else gives one")
    return value


def require_not_negative(config: object, *names: str) -> None:
    """Refuses a configuration in which one of these is given (not None) and no number >= 0."""
    for name, value in _numbers(config, names):
        if not value >= 0:
            raise InputError(f"{name}: expected a number >= 0, found {value:g}")


def require_at_most(config: object, **largest: float) -> None:
    """Refuses a configuration in which one of these is given (not None) and too large."""
    for name, value in _numbers(config, largest):
        if value > largest[name]:
            raise InputError(f"{name}: expected at most {largest[name]:g}, found {value:g}")
