"""What a campaign costs beside its runs, and what a second worker saves:
`python -m benchmarks.campaigns [--walks 40] [--duration 3]`.

The walks are done in groups of eight, and every group in four ways: in a plain loop, in two plain
loops side by side, as a campaign on one worker, and as a campaign on two, which take turns, so that
whatever else the computer does slows down all alike. What the first row of a campaign waits for
(Python, the cluster, its imports, which are there once) is added to its time, and so it is for the
loop. The two loops say what this machine's second core is worth: cores that share a cache or a
clock give less than twice.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing import get_context
from multiprocessing.pool import Pool
from pathlib import Path

import numpy as np
from distributed import LocalCluster

from fbse_drake import load_scenario, simulate
from fbse_drake.campaign.campaign import Campaign, dump_campaign
from fbse_drake.campaign.cluster import run_campaign
from fbse_drake.campaign.design import Listed
from fbse_drake.campaign.steps import Simulate
from fbse_drake.campaign.workers import local_cluster
from fbse_drake.report.metrics import run_metrics

_SCENARIO = "paper_walk"
_GROUP = 8
# Starts are timed so often.
_STARTS = 3


def walk(seed: int, duration: float) -> None:
    """One walk as a script without campaigns does it."""
    overrides = [f"duration={duration}", f"seed={seed}"]
    result = simulate(load_scenario(_SCENARIO, overrides=overrides))
    run_metrics(result.log, result.wall_time)


def campaign_of(seeds: Sequence[int], duration: float) -> Campaign:
    """The same walks."""
    return Campaign(
        {"walk": Simulate()},
        scenarios=[_SCENARIO],
        set=[f"duration={duration}"],
        design=Listed([{"seed": seed} for seed in seeds]),
    )


def duration_of(work: Callable[[], object]) -> float:
    """How long something takes [s]."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def starts() -> tuple[float, float]:
    """How long a plain loop and a campaign take to start and to end, medians [s]."""
    least = load_scenario(_SCENARIO).plant.time_step
    loop = ["-c", f"from benchmarks.campaigns import walk; walk(0, {least})"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "campaign.yaml")
        file.write_text(dump_campaign(campaign_of((0,), least)))
        campaign = ["-m", "fbse_drake", "campaign", str(file), "--workers", "1", "--out"]

        def start(*command: str) -> float:
            run = partial(subprocess.run, [sys.executable, *command], check=True)
            return duration_of(partial(run, capture_output=True))

        # Each campaign in a folder of its own: what is done is not done again.
        times = [(start(*loop), start(*campaign, f"{folder}/{k}")) for k in range(_STARTS)]
    of_loop, of_campaign = np.median(times, axis=0)
    return float(of_loop), float(of_campaign)


def main() -> None:
    """Prints the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--walks", type=int, default=40, help="how many walks")
    parser.add_argument("--duration", type=float, default=3.0, help="of each [s]")
    options = parser.parse_args()
    seeds, duration = range(options.walks), options.duration

    def as_campaign(group: Sequence[int], cluster: LocalCluster) -> None:
        with tempfile.TemporaryDirectory() as folder:
            campaign = campaign_of(group, duration)
            outcome = run_campaign(campaign, folder, scheduler=cluster.scheduler_address)
        if outcome.done < len(group) or outcome.failed:
            raise SystemExit(f"campaign: {outcome}")

    spawn = get_context("spawn")
    with (
        local_cluster(1) as one,
        local_cluster(2) as two,
        # This process has two schedulers to look after.
        spawn.Pool(1) as alone,
        spawn.Pool(2) as pair,
    ):

        def in_loops(group: Sequence[int], loops: Pool) -> None:
            loops.starmap(walk, [(seed, duration) for seed in group], chunksize=1)

        ways: dict[str, Callable[[Sequence[int]], object]] = {
            "loop": lambda group: in_loops(group, alone),
            "one worker": lambda group: as_campaign(group, one),
            "two loops": lambda group: in_loops(group, pair),
            "two workers": lambda group: as_campaign(group, two),
        }
        for way in ways.values():
            way(range(4))  # All import and compile what they need.
        taken = dict.fromkeys(ways, 0.0)
        for first in range(0, len(seeds), _GROUP):
            for name, way in ways.items():
                taken[name] += duration_of(partial(way, seeds[first : first + _GROUP]))
    of_loop, of_campaign = starts()
    loop, two_loops = (taken[name] + of_loop for name in ("loop", "two loops"))
    one_worker, two_workers = (taken[name] + of_campaign for name in ("one worker", "two workers"))
    print(f"{options.walks} walks of {duration:g} s ({_SCENARIO}), in this run:")
    print(f"  start and end of a loop, of a campaign {of_loop:5.1f}, {of_campaign:.1f} s")
    print(f"  a walk in a plain loop                 {taken['loop'] / options.walks:5.2f} s")
    print(f"  a campaign on one worker               {one_worker / loop:6.3f} times the plain loop")
    print(f"  of that, once it has started           {taken['one worker'] / taken['loop']:6.3f}")
    print(f"  on two workers                         {one_worker / two_workers:5.2f} times as fast")
    print(f"  two plain loops side by side           {loop / two_loops:5.2f} times as fast as one")


if __name__ == "__main__":
    main()
