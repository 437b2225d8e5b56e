"""Processes of this machine that do the runs of a campaign.

What they import takes seconds. On Linux they are forked from a process that has imported it once,
and that begins as early as possible. Elsewhere each imports for itself: system libraries there do
not bear a fork.
"""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, get_context
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import LocalCluster

_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
_PRELOAD = ["distributed.nanny", "fbse_drake.campaign.work"]


def begin_to_import() -> None:
    """Begins to import what workers need, in a process of its own; returns at once."""
    if _METHOD == "forkserver":
        get_context(_METHOD).set_forkserver_preload(_PRELOAD)
        # Memory that was freed goes back to the system from so many bytes on, as Dask advises.
        os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", "65536")
        forkserver.ensure_running()


@contextmanager
def local_cluster(workers: int | None = None) -> "Iterator[LocalCluster]":
    """A cluster of this machine's cores, or of so many workers; each is a process with a thread."""
    begin_to_import()
    # Imported here, beside what the workers import.
    import dask
    from distributed import LocalCluster

    settings = {
        "distributed.worker.multiprocessing-method": _METHOD,
        # Samples of what a worker does cost its thread some 5 %, and nobody reads them. Memory that
        # is looked at ten times a second costs as much in the processes that look.
        "distributed.worker.profile.enabled": False,
        "distributed.worker.memory.monitor-interval": "1s",
        "distributed.admin.system-monitor.interval": "2s",
    }
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address="localhost:0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster
