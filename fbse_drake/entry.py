# PYTHON_ARGCOMPLETE_OK
"""Where the `fbse` command begins: who ends it early is answered in one line."""

import os
import signal
from types import FrameType
from typing import NoReturn

FAILED = 1
_STDERR = 2
_LIKE_CTRL_C = (signal.SIGTERM, signal.SIGHUP)
INTERRUPTED = "interrupted; no file was left half-written"


def entry() -> None:
    """The console script."""
    end_as_at_ctrl_c()
    from fbse_drake.cli import entry

    entry()


def end_as_at_ctrl_c() -> None:
    """Lets Ctrl-C, SIGTERM and SIGHUP end the program without a traceback."""
    for number in _LIKE_CTRL_C:
        # What `nohup` ignores stays ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end_at_once)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)


def keep_what_is_known() -> None:
    """From here on they raise KeyboardInterrupt, for there may be something to keep."""
    for number in _LIKE_CTRL_C:
        if signal.getsignal(number) is end_at_once:
            signal.signal(number, _as_ctrl_c)
    if signal.getsignal(signal.SIGINT) is end_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def end_at_once(number: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001
    """Ends the program. An exception would not do: extension modules that are being imported make
    errors of their own of it."""
    os.write(_STDERR, f"fbse: {INTERRUPTED}\n".encode())
    os._exit(FAILED)


def _as_ctrl_c(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
    handler = signal.getsignal(signal.SIGINT)
    # A shell lets what it starts in the background ignore Ctrl-C, but not SIGTERM.
    (handler if callable(handler) else signal.default_int_handler)(signal.SIGINT, frame)
