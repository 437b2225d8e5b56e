"""Runs that give a result each, as JSON text: a campaign whose rows only its own program reads."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fbse_drake.campaign.campaign import Campaign, Run
from fbse_drake.campaign.cluster import Outcome, run_campaign
from fbse_drake.campaign.design import Listed
from fbse_drake.campaign.rows import Folder
from fbse_drake.campaign.steps import Call
from fbse_drake.progress import Progress, silent


class StoredRuns:
    """Runs, each with a result, and the folder that they are kept in."""

    def __init__(
        self,
        place: str,
        function: str,
        values: Sequence[Mapping[str, Any]],
        sources: str | None,
        arguments: Mapping[str, Any] | None = None,
    ):
        """Forgets what was made by other sources.

        Args:
            place: the folder, see `Folder`.
            function: what does a run, as `!Call` takes it; it gives `sources`, the checksum of what
                it was made by, and `result`, JSON text.
            values: of each run.
            sources: checksum of those whose results count; None for any.
            arguments: of the function in every run.
        """
        gives = {"sources": "text", "result": "text"}
        call = Call(function, gives=gives, arguments=dict(arguments or {}))
        self.campaign = Campaign({"benchmark": call}, design=Listed(list(map(dict, values))))
        self._folder = Folder(place)
        if sources is not None:
            rows = self._rows()
            old = [key for key, row in rows.items() if row["benchmark.sources"] != sources]
            self._folder.forget(old)

    def _rows(self) -> dict[str, dict[str, Any]]:
        """Rows by run."""
        if self._folder.known_schema() is None:
            return {}
        return {row["run"]: row for row in self._folder.table().to_pylist()}

    def read(self) -> list[tuple[Run, Any, str | None]]:
        """Run, result and failure of what has been run, in order."""
        rows = self._rows()
        return [
            (run, json.loads(rows[run.key]["benchmark.result"] or "null"), rows[run.key]["failure"])
            for run in self.campaign.runs
            if run.key in rows
        ]

    def do(
        self,
        *,
        workers: int | None,
        only: Callable[[Run], bool] = lambda _: True,
        progress: Progress = silent,
        tell: Callable[[str], None] = lambda _: None,
    ) -> Outcome:
        """Does what has not been done.

        Args:
            workers: how many at once; None for one on each core.
            only, progress, tell: see `run_campaign`.
        """
        return run_campaign(
            self.campaign,
            self._folder.place,
            workers=workers,
            only=only,
            others=True,
            progress=progress,
            tell=tell,
        )
