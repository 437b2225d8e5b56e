"""One run of a campaign, as a worker does it."""

import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fbse_drake.campaign.campaign import Run, tree_of
from fbse_drake.campaign.rows import Folder
from fbse_drake.campaign.steps import Material, Step
from fbse_drake.errors import InputError


@dataclass(frozen=True)
class Job:
    """All that a worker needs to be told of a run."""

    run: Run
    steps: dict[str, Step]
    # The campaign's folder; see `Folder`.
    place: str
    logs: bool


def work(job: Job) -> None:
    """Does a run and writes its row, unless it has one."""
    folder = Folder(job.place)
    if folder.has(job.run.key):
        return
    figures: dict[str, Any] = {}
    failure = log = None
    try:
        material = Material(job.run.seed, job.run.values)
        if job.run.tree is not None:
            tree = tree_of(job.run)
            material = Material(job.run.seed, job.run.values, tree, tree.build())
        for name, step in job.steps.items():
            material, found = step.run(material)
            figures |= {f"{name}.{key}": value for key, value in found.items()}
        failure = material.failure
        if job.logs and material.log is not None:
            log = folder.write_log(job.run.key, material.log)
    except Exception as error:  # One bad run must not stop the others.
        failure = reason(error)
    folder.write_row(job.run.key, cells(job.run) | figures | {"failure": failure, "log": log})


def cells(run: Run) -> dict[str, Any]:
    """Cells of a row that are known before the run."""
    return {"run": run.key, "scenario": run.scenario, "seed": run.seed, **run.values}


def reason(error: Exception) -> str:
    """An error in one line: as it says itself, or with the place where it was raised."""
    message = " ".join(str(error).split("\n")[0].split())
    if isinstance(error, InputError):
        return message
    *_, last = traceback.extract_tb(error.__traceback__)
    return f"{type(error).__name__}: {message} ({Path(last.filename).name}:{last.lineno})"
