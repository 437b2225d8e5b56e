"""Compares methods as campaigns of runs, which go on where they were stopped."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fbse_drake.campaign.campaign import Run
from fbse_drake.campaign.results import StoredRuns
from fbse_drake.estimation import estimate
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.progress import Interrupted, Progress, silent
from fbse_drake.resources import package_checksum
from fbse_drake.rivals import runs
from fbse_drake.rivals.comparison import Comparison
from fbse_drake.rivals.methods import measured, methods, tuning_walk
from fbse_drake.scenario import Scenario, dump_scenario
from fbse_drake.simulation import simulate


@dataclass(frozen=True)
class Plan:
    """What is compared, and how often."""

    scenario: Scenario
    name: str
    # Of `CASES`.
    cases: Sequence[str]
    seeds: int
    # Settings that are tried of each method.
    trials: int


class Campaigns:
    """The three campaigns of a comparison, in folders of their own."""

    def __init__(
        self,
        out: Path,
        *,
        workers: int | None = None,
        progress: Progress = silent,
        tell: Callable[[str], None] = lambda _: None,
    ):
        """Notes where results go.

        Args:
            workers, progress, tell: see `StoredRuns.do`.
        """
        self._out, self._workers, self._progress, self._tell = out, workers, progress, tell
        self._sources = package_checksum()

    def do(
        self,
        name: str,
        values: Sequence[Mapping[str, Any]],
        arguments: Mapping[str, Any],
        prepare: Callable[[], None] = lambda: None,
    ) -> list[tuple[Run, Any, str | None]]:
        """Does the runs of one campaign that are not done; returns all, with result and failure.

        Args:
            name: of its folder, and of the function in `fbse_drake.rivals.runs` that does a run.
            prepare: makes what the runs need, if any is to be done.

        Raises:
            Interrupted: it was stopped before it was done.
        """
        place, function = str(self._out / name), f"{runs.__name__}:{name}"
        stored = StoredRuns(place, function, values, self._sources, arguments)
        if len(stored.read()) < len(values):
            prepare()
        outcome = stored.do(workers=self._workers, progress=self._progress, tell=self._tell)
        if outcome.stopped is not None:
            raise Interrupted(outcome.stopped)
        return stored.read()


def compare_methods(plan: Plan, campaigns: Campaigns, out: Path) -> Comparison:
    """Tunes all methods that can run in a scenario, lets them watch, and feeds them back.

    Args:
        out: folder for what the runs share.

    Raises:
        InputError: FBSE itself cannot run in the scenario.
        Interrupted: it was stopped; what is done is kept.
    """
    found, unfit = methods(plan.scenario)
    scenario, log = dump_scenario(plan.scenario, plan.name), out / "tuning_walk.npz"
    tunings = campaigns.do(
        "tuning",
        [{"method": method.text} for method in found],
        {"scenario": scenario, "log": str(log), "trials": plan.trials},
        lambda: _walk_to_tune_on(plan.scenario, log),
    )
    tuned = [runs.read_tuned(result) for _, result, failure in tunings if failure is None]
    comparison = Comparison(tuned, unfit)
    comparison.broken += [f"{_of(run)}: {failure}" for run, _, failure in tunings if failure]
    texts, seeds = [of.method.text for of in tuned], range(plan.seeds)
    watched = campaigns.do(
        "watching",
        [{"case": case, "seed": seed} for seed in seeds for case in plan.cases],
        {"scenario": scenario, "methods": texts},
    )
    walks = campaigns.do(
        "feeding_back",
        [{"method": who, "seed": seed} for seed in seeds for who in (*runs.REFERENCES, *texts)],
        {"scenario": scenario},
    )
    for run, result, failure in watched:
        if failure is None:
            comparison.add_watched(run.values["case"], run.seed, result)
    names = {of.method.text: of.method.name for of in tuned}
    loops = {
        (names.get(run.values["method"], run.values["method"]), run.seed): result
        for run, result, failure in walks
        if failure is None
    }
    comparison.add_loops(loops)
    done = (*watched, *walks)
    comparison.broken += [f"{_of(run)}: {failure}" for run, _, failure in done if failure]
    return comparison


def _walk_to_tune_on(scenario: Scenario, path: Path) -> None:
    """Simulates it, and writes its log with FBSE's estimates."""
    walk = tuning_walk(measured(scenario))
    log = estimate(replace(walk, estimator=Fbse()), simulate(runs.unobserved(walk)).log).log
    log.save(path)


def _of(run: Run) -> str:
    """A run in words."""
    return ", ".join([*(" ".join(str(v).split()) for v in run.values.values()), f"seed {run.seed}"])
