"""Work in processes of its own, beside what this one does."""

import math
import multiprocessing
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Generic, TypeVar

from fbse_drake.errors import InputError
from fbse_drake.progress import Interrupted, Progress, silent

T = TypeVar("T")
# How often processes are looked at while nothing else is done [s].
_LOOK_PERIOD = 0.2
# And while something else is done, at most [s].
_LEAST_PERIOD = 0.02


def usual_jobs() -> int:
    """How many things are best done side by side: one for each core that this process may use.

    Elsewhere than on Linux one, for system libraries there do not bear a fork.
    """
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1


@dataclass(eq=False)
class Task(Generic[T]):
    """A piece of work and what came out of it, one result or an error, if it is done."""

    work: Callable[[Progress], T]
    outcome: list[T] = field(default_factory=list)
    error: Exception | None = None

    @property
    def is_done(self) -> bool:
        return bool(self.outcome) or self.error is not None


class Processes:
    """Tasks, so many at a time. With one job each is done when its result is asked for.

    Processes are forked: a plant's configuration does not go through a pipe, and a user's own
    effects are known in this process only. What is not done is cancelled at the end of the context,
    and as soon as a progress interrupts the work that it is done beside or for.
    """

    def __init__(self, jobs: int = 1):
        self._jobs = jobs
        self._waiting: deque[Task[Any]] = deque()
        self._running: dict[Connection, tuple[Task[Any], BaseProcess]] = {}

    def __enter__(self) -> "Processes":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.cancel()

    def begin(self, work: Callable[[Progress], T]) -> Task[T]:
        """A task, which is begun as soon as a process is free for it beside this one.

        Args:
            work: is told where to tell its progress.
        """
        task = Task(work)
        if self._jobs > 1:
            self._waiting.append(task)
            self._look(self._jobs - 1)
        return task

    def cancel(self) -> None:
        """Ends the tasks that are not done; none of their processes is left."""
        given_up = [*self._waiting, *(task for task, _ in self._running.values())]
        processes = {receiver: process for receiver, (_, process) in self._running.items()}
        self._waiting.clear()
        self._running.clear()
        for task in given_up:
            task.error = CancelledError("it was cancelled")
        for process in processes.values():
            # One that has just been forked still has this process's handler of SIGTERM.
            process.kill()
        for receiver, process in processes.items():
            process.join()
            receiver.close()

    def beside(self, progress: Progress) -> Progress:
        """A progress of other work at which it is also seen to it that tasks go on; all are
        cancelled where it interrupts that work."""

        looked = -math.inf

        def told(text: str, share: float = 0.0) -> None:
            nonlocal looked
            # Told a thousand times in a second, looking would take much of it.
            if (now := time.monotonic()) - looked > _LEAST_PERIOD:
                self._look(self._jobs - 1)
                looked = now
            self._tell(progress, text, share)

        return told

    def results(self, tasks: list[Task[T]], progress: Progress, text: str) -> list[T]:
        """What comes out of tasks; waits for it.

        Args:
            progress: is told it under this text; all tasks are cancelled where it interrupts.

        Raises:
            Exception: that of the first task that raised one.
            CancelledError: one was cancelled.
            Interrupted: see `Progress`.
        """
        for k, task in enumerate(tasks):
            if self._jobs == 1 and not task.is_done:
                task.outcome.append(task.work(_part(progress, k, len(tasks))))
        while not all(task.is_done for task in tasks):
            self._tell(progress, text, sum(task.is_done for task in tasks) / len(tasks))
            self._look(self._jobs, _LOOK_PERIOD)
        for task in tasks:
            if task.error is not None:
                raise task.error
        return [result for task in tasks for result in task.outcome]

    def _tell(self, progress: Progress, text: str, share: float) -> None:
        try:
            progress(text, share)
        except Interrupted:
            self.cancel()
            raise

    def _look(self, at_most: int, timeout: float = 0.0) -> None:
        """Takes results that have come and starts what waits.

        Args:
            at_most: so many processes run.
            timeout: waits so long for results [s].
        """
        self._start(at_most)
        ready = wait(list(self._running), timeout=timeout)
        for receiver in [one for one in self._running if one in ready]:
            task, process = self._running.pop(receiver)
            try:
                outcome, task.error = receiver.recv()
                task.outcome += outcome
            except EOFError:
                task.error = InputError("a process was ended from outside before it was done")
            process.join()
        self._start(at_most)

    def _start(self, at_most: int) -> None:
        context = multiprocessing.get_context("fork")
        while self._waiting and len(self._running) < at_most:
            task = self._waiting.popleft()
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_send_result, args=(sender, task.work), daemon=True)
            process.start()
            sender.close()
            self._running[receiver] = task, process


def _part(progress: Progress, done: int, count: int) -> Progress:
    """Progress of one of several pieces of work."""

    def told(text: str, share: float = 0.0) -> None:
        progress(text, (done + share) / count)

    return told


def _send_result(sender: Connection, work: Callable[[Progress], object]) -> None:
    """In a process of its own; who started it decides about its end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        sender.send(([work(silent)], None))
    except Exception as error:
        sender.send(([], error))
