"""Progress of long work: what is being done, how much of it is done, and whether to go on."""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Protocol

# Lines are not printed more often than this [s].
_EVERY = 3.0
# Time left is guessed from no less work than this share of a step.
_ENOUGH = 0.05


class Progress(Protocol):
    """Is told what is being done, often.

    Args:
        text: the step, as `trying what explains more`.
        share: of the step that is done.

    Raises:
        Interrupted: the work is to end here.
    """

    def __call__(self, text: str, share: float = 0.0) -> None: ...


def silent(text: str, share: float = 0.0) -> None:
    """Progress that nobody looks at."""


class Interrupted(Exception):
    """Work is to end with what is known so far; says why."""


class ProgressLines:
    """Tells the progress of work in lines, and ends the work, once, at a time limit or when it is
    asked to.

    What is done after that, to write down what is known, is not interrupted again.
    """

    def __init__(
        self,
        write: Callable[[str], None],
        limit: float | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        every: float = _EVERY,
    ):
        """Starts the clock.

        Args:
            write: is given each line.
            limit: time that the work may take [s]; None for any.
            every: lines are at least so far apart [s].
        """
        self._write, self._limit, self._clock, self._every = write, limit, clock, every
        self._start = self._step_start = self._last = clock()
        self._step = ""
        self._reason: str | None = None
        self._ended = False

    def __call__(self, text: str, share: float = 0.0) -> None:
        """See `Progress`."""
        now = self._clock()
        if self._ended:
            return
        if self._limit is not None and now - self._start > self._limit:
            self._reason = f"the time limit of {self._limit:g} s was reached"
        if self._reason is not None:
            self._ended = True
            raise Interrupted(self._reason)
        if text != self._step:
            self._step, self._step_start = text, now
        if now - self._last < self._every:
            return
        self._last = now
        left = ""
        if share > _ENOUGH:
            rest = (now - self._step_start) * (1 - share) / share
            left = f", {100 * share:.0f} % of this step, about {max(rest, 1.0):.0f} s of it left"
        if self._limit is not None:
            left += f"; at most {self._limit - (now - self._start):.0f} s in all"
        self._write(f"{now - self._start:.0f} s: {text}{left}")

    def stop(self, reason: str) -> None:
        """Ends the work the next time that it tells its progress."""
        self._reason = reason

    @contextmanager
    def stopped_by_keyboard(self) -> Iterator[None]:
        """Within it the first Ctrl-C ends the work with what is known; a second one aborts it."""

        def handler(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
            if self._reason is not None:
                raise KeyboardInterrupt
            self.stop("it was interrupted")
            print("fbse: stopping with what is known; once more to abort", file=sys.stderr)

        try:
            before = signal.signal(signal.SIGINT, handler)
        except ValueError:
            # Only the main thread hears signals.
            yield
            return
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)
