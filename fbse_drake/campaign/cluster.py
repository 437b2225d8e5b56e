"""Runs a campaign on the workers of a Dask cluster: those of this machine, or of any scheduler."""

import logging
import queue
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from distributed import Client, Future
from distributed.scheduler import KilledWorker

from fbse_drake.campaign.campaign import Campaign, Run, dump_campaign
from fbse_drake.campaign.rows import Folder, schema_of
from fbse_drake.campaign.work import Job, cells, work
from fbse_drake.campaign.workers import local_cluster
from fbse_drake.errors import InputError
from fbse_drake.progress import Interrupted, Progress, silent

# Runs that are with the scheduler at a time, for each thread of a worker, so that none waits for
# the next; and how many there are at least.
_AHEAD, _LEAST = 4, 16
# The command looks after itself so often [s].
_PERIOD = 0.5
# Time to reach a scheduler [s].
_REACH = 10.0


@dataclass
class Outcome:
    """What became of a campaign."""

    total: int
    # Of these runs, how many had their rows before.
    before: int
    done: int = 0
    # Runs that failed now, with their lines.
    failed: list[tuple[Run, str]] = field(default_factory=list)
    # Why it ended early, or None.
    stopped: str | None = None


def run_campaign(
    campaign: Campaign,
    place: str,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    only: Callable[[Run], bool] = lambda _: True,
    others: bool = False,
    progress: Progress = silent,
    tell: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Does the runs of a campaign that have no row yet.

    Args:
        place: the campaign's folder, a path or an address that fsspec knows; workers on other
            machines must reach it too.
        scheduler: address of a Dask scheduler; by default one is started, with workers.
        workers: how many are started; by default one for each core.
        only: which of the runs are done now; by default all.
        others: may the folder have rows of runs that this campaign does not have?
        progress: is told how much is done; if it interrupts, what is done is kept.
        tell: is told, in lines, what the reader should know.

    Raises:
        InputError: a campaign that cannot be run, a folder of another campaign, no scheduler.
    """
    folder, runs, schema = Folder(place), campaign.runs, schema_of(campaign.columns)
    keys = {run.key for run in runs}
    done = folder.done()
    if (foreign := done - keys) and not others:
        raise InputError(
            f"--out {place}: has {len(foreign)} rows of runs that this campaign does not have; "
            "give another folder, or undo the change of the campaign"
        )
    folder.make(dump_campaign(campaign), schema)
    waiting = deque(
        Job(run, campaign.steps, place, campaign.logs)
        for run in runs
        if run.key not in done and only(run)
    )
    outcome = Outcome(len(runs), len(done & keys))
    if waiting:
        with _client(scheduler, workers) as client:
            tell(f"Dask's dashboard: {client.dashboard_link}")
            try:
                _work_off(client, waiting, outcome, progress, tell)
            except Interrupted as stop:
                outcome.stopped = str(stop)
    if outcome.stopped is None:
        folder.write_table([run.key for run in runs])
    return outcome


def _work_off(
    client: Client,
    waiting: deque[Job],
    outcome: Outcome,
    progress: Progress,
    tell: Callable[[str], None],
) -> None:
    """Keeps the workers busy until there is no more to do.

    Futures are dropped as soon as they are done: a scheduler would repeat what a dead worker did
    if somebody still held the result.
    """
    finished: queue.SimpleQueue[Future] = queue.SimpleQueue()
    running: dict[str, tuple[Job, Future]] = {}
    todo, text = len(waiting), f"running {len(waiting)} runs"
    try:
        while waiting or running:
            threads = sum(client.nthreads().values())
            while waiting and len(running) < max(_LEAST, _AHEAD * threads):
                job = waiting.popleft()
                future = client.submit(work, job, key=job.run.key, pure=False)
                running[job.run.key] = job, future
                future.add_done_callback(finished.put)
            progress(text if threads else "waiting for a worker", outcome.done / todo)
            try:
                future = finished.get(timeout=_PERIOD)
            except queue.Empty:
                continue
            job, future = running.pop(str(future.key))
            failure = _failure_of(future, job)
            outcome.done += 1
            if failure is not None:
                outcome.failed.append((job.run, failure))
                tell(f"{_name(job.run)}: {failure}")
    except (OSError, TimeoutError):
        raise Interrupted("the scheduler is gone") from None


def _failure_of(future: Future, job: Job) -> str | None:
    """Why a run failed, or None.

    Raises:
        Interrupted: the scheduler is gone, or the workers cannot do the runs at all.
    """
    folder = Folder(job.place)
    if future.status == "finished":
        # The row says it, also if the worker has died since.
        return folder.failure(job.run.key)
    if future.status != "error":
        raise Interrupted("the scheduler is gone")
    error = future.exception()
    if not isinstance(error, KilledWorker):
        raise Interrupted(f"the workers cannot run it: {type(error).__name__}: {error}")
    failure = "every worker that tried it died: killed, or out of memory"
    folder.write_row(job.run.key, cells(job.run) | {"failure": failure})
    return failure


def _name(run: Run) -> str:
    """A run in words."""
    values = [f"{key}={value}" for key, value in run.values.items()]
    return ", ".join(filter(None, (run.scenario, f"seed={run.seed}", *values)))


@contextmanager
def _client(scheduler: str | None, workers: int | None) -> Iterator[Client]:
    """A client of the scheduler, or of one that is started with workers for as long."""
    # That workers end is no news, and what they say of it would stand in the progress.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_REACH, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"--scheduler {scheduler}: cannot be reached: {error}") from None
        with client:
            yield client
        return
    with local_cluster(workers) as cluster, Client(cluster, set_as_default=False) as client:
        yield client
