"""What a campaign costs beside its runs, and what a second worker saves:
`python -m benchmarks.campaigns [--walks 40] [--duration 3]`.

The same walks are done in four ways, one after the other, each as a process of its own from its
start to its end: in a plain loop, in two plain loops side by side with half of the walks each, as
a campaign on one worker, and as a campaign on two. The two loops say what this machine's second
core is worth: cores that share a cache or a clock give less than twice.
"""

import argparse
import itertools
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fbse_drake.campaign.campaign import Campaign, dump_campaign
from fbse_drake.campaign.design import Grid
from fbse_drake.campaign.steps import Simulate

_SCENARIO = "paper_walk"
# A script without campaigns: arguments are the first seed, the last, and a value of the scenario.
_LOOP = f"""
import sys
from fbse_drake import load_scenario, simulate
from fbse_drake.report.metrics import run_metrics

first, last, override = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
for seed in range(first, last):
    result = simulate(load_scenario("{_SCENARIO}", overrides=[override, f"seed={{seed}}"]))
    run_metrics(result.log, result.wall_time)
"""


def duration_of(*commands: list[str]) -> float:
    """How long Python takes for some commands, started at the same time [s]."""
    start = time.perf_counter()
    processes = [
        subprocess.Popen([sys.executable, *command], stderr=subprocess.DEVNULL)
        for command in commands
    ]
    if any(process.wait() for process in processes):
        raise SystemExit(f"failed: {commands}")
    return time.perf_counter() - start


def plain_loops(walks: int, override: str, loops: int) -> float:
    """Of the walks as scripts without campaigns do them, side by side [s]."""
    bounds = [walks * k // loops for k in range(loops + 1)]
    return duration_of(
        *(
            ["-c", _LOOP, str(first), str(last), override]
            for first, last in itertools.pairwise(bounds)
        )
    )


def as_campaign(walks: int, override: str, workers: int) -> float:
    """Of the same walks as a campaign, in a folder of its own [s]."""
    campaign = Campaign(
        {"walk": Simulate()}, scenarios=[_SCENARIO], set=[override], design=Grid(seeds=walks)
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "campaign.yaml")
        file.write_text(dump_campaign(campaign))
        command = ["-m", "fbse_drake", "campaign", str(file), "--out", str(Path(folder, "out"))]
        return duration_of([*command, "--workers", str(workers)])


def main() -> None:
    """Prints the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--walks", type=int, default=40, help="how many walks")
    parser.add_argument("--duration", type=float, default=3.0, help="of each [s]")
    options = parser.parse_args()
    walks, override = options.walks, f"duration={options.duration}"
    plain_loops(1, override, 1)  # Compiles what is compiled once.
    loop, one = plain_loops(walks, override, 1), as_campaign(walks, override, 1)
    two_loops, two = plain_loops(walks, override, 2), as_campaign(walks, override, 2)
    print(f"{walks} walks of {options.duration:g} s ({_SCENARIO}), in this run:")
    print(f"  a plain loop                     {loop / walks:6.2f} s a walk")
    print(f"  a campaign on one worker         {one / loop:6.3f} times as long as the plain loop")
    print(f"  a campaign on two workers        {one / two:6.2f} times as fast as on one")
    print(f"  two plain loops side by side     {loop / two_loops:6.2f} times as fast as one")


if __name__ == "__main__":
    main()
