"""Work in processes of its own (fbse_drake/processes.py)."""

import multiprocessing
import os
import signal
from concurrent.futures import CancelledError

import pytest

from fbse_drake.errors import InputError
from fbse_drake.processes import Processes
from fbse_drake.progress import Interrupted, Progress, silent


def of_process(number: int) -> tuple[int, int]:
    return number, os.getpid()


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_results_come_in_the_order_of_the_tasks(jobs: int):
    with Processes(jobs) as processes:
        tasks = [processes.begin(lambda told, k=k: of_process(k)) for k in range(5)]  # noqa: ARG005
        results = processes.results(tasks, silent, "working")
    assert [number for number, _ in results] == list(range(5))
    assert all((pid == os.getpid()) == (jobs == 1) for _, pid in results)


def test_tasks_go_on_while_other_work_tells_its_progress():
    told: list[str] = []

    def progress(text: str, share: float = 0.0) -> None:  # noqa: ARG001
        told.append(text)

    with Processes(2) as processes:
        tasks = [processes.begin(lambda told, k=k: k) for k in range(3)]  # noqa: ARG005
        beside = processes.beside(progress)
        while not all(task.is_done for task in tasks):
            beside("other work")
    assert set(told) == {"other work"}


def test_with_one_job_nothing_is_done_before_it_is_asked_for():
    done: list[int] = []

    def work(told: Progress) -> None:
        told("working", 0.5)
        done.append(1)

    shares: list[float] = []

    def progress(text: str, share: float = 0.0) -> None:  # noqa: ARG001
        shares.append(share)

    with Processes() as processes:
        tasks = [processes.begin(work), processes.begin(work)]
        processes.beside(silent)("other work")
        assert not done
        processes.results(tasks, progress, "working")
    assert shares == [0.25, 0.75]


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_is_that_of_the_task(jobs: int):
    def fail(told: Progress) -> None:  # noqa: ARG001
        raise ValueError("no solution")

    with Processes(jobs) as processes, pytest.raises(ValueError, match="no solution"):
        processes.results([processes.begin(fail)], silent, "working")


def test_a_process_that_is_killed_is_an_error():
    """As by a machine that runs out of memory."""

    def die(told: Progress) -> None:  # noqa: ARG001
        os._exit(9)

    with Processes(2) as processes, pytest.raises(InputError, match="ended from outside"):
        processes.results([processes.begin(die)], silent, "working")


def endless(told: Progress) -> None:  # noqa: ARG001
    while True:
        pass


def interrupted(text: str, share: float = 0.0) -> None:  # noqa: ARG001
    raise Interrupted("enough")


def test_tasks_are_cancelled_when_the_work_that_they_are_done_for_is_interrupted():
    with Processes(2) as processes:
        tasks = [processes.begin(endless), processes.begin(endless)]
        with pytest.raises(Interrupted, match="enough"):
            processes.results(tasks, interrupted, "working")
        assert not multiprocessing.active_children()
        with pytest.raises(CancelledError):
            processes.results(tasks, silent, "working")


def test_tasks_are_cancelled_when_the_work_beside_them_is_interrupted():
    with Processes(3) as processes:
        done = processes.begin(lambda told: 1)  # noqa: ARG005
        assert processes.results([done], silent, "working") == [1]
        tasks = [processes.begin(endless) for _ in range(3)]
        assert len(multiprocessing.active_children()) == 2
        with pytest.raises(Interrupted, match="enough"):
            processes.beside(interrupted)("other work")
        assert not multiprocessing.active_children()
        assert all(isinstance(task.error, CancelledError) for task in tasks)
        # What is known is kept, and written down with tasks that begin after that.
        again = processes.begin(lambda told: 2)  # noqa: ARG005
        assert processes.results([done, again], silent, "writing") == [1, 2]


def test_a_process_that_heeds_no_signal_is_ended_with_the_context():
    def deaf(told: Progress) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        endless(told)

    with Processes(2) as processes:
        processes.begin(deaf)
        assert multiprocessing.active_children()
    assert not multiprocessing.active_children()
