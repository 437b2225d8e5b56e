"""Long work tells its progress now and then, and ends when it is asked to."""

import os
import signal
import subprocess
import sys

import pytest

from fbse_drake.progress import Interrupted, ProgressLines


class Clock:
    """A clock that is set by hand [s]."""

    def __init__(self) -> None:
        self.time = 0.0

    def __call__(self) -> float:
        return self.time


def test_lines_are_seldom_and_say_what_is_left() -> None:
    clock, lines = Clock(), []
    progress = ProgressLines(lines.append, clock=clock, every=3.0)
    for tick in range(100):
        clock.time = 0.1 * tick
        progress("looking", tick / 100)
    assert len(lines) == 3
    assert lines[0] == "3 s: looking, 30 % of this step, about 7 s of it left"
    clock.time = 20.0
    progress("writing")
    assert lines[-1] == "20 s: writing"


def test_the_time_limit_ends_the_work_once() -> None:
    clock, lines = Clock(), []
    progress = ProgressLines(lines.append, 5.0, clock=clock)
    progress("looking")
    clock.time = 4.0
    progress("looking", 0.5)
    assert lines == ["4 s: looking, 50 % of this step, about 4 s of it left; at most 1 s in all"]
    clock.time = 5.1
    with pytest.raises(Interrupted, match="the time limit of 5 s was reached"):
        progress("looking")
    clock.time = 9.0
    progress("writing down what is known")


def test_ctrl_c_ends_the_work_and_a_second_one_aborts_it() -> None:
    progress = ProgressLines(lambda _: None)
    before = signal.getsignal(signal.SIGINT)
    with progress.stopped_by_keyboard():
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(Interrupted, match="it was interrupted"):
            progress("looking")
        progress("writing")
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_help_waits_for_nothing_heavy() -> None:
    code = (
        "import sys\nfrom fbse_drake.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([name for name in ('pydrake', 'numpy', 'numba', 'scipy', 'rich', 'dask', 'pyarrow') "
        "if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "diagnose" in done.stdout
