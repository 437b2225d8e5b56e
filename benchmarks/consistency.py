"""Are the estimators as sure as they say? `python -m benchmarks.consistency [--seeds N]`.

Over five walks of two robots, error squared over the stated variance (NEES) of every state and
innovation squared over its variance (NIS) of every update, component by component. If noise is
white, Gaussian and as large as believed, each has a chi-square distribution with one degree of
freedom, a mean of 1, and is within the distribution's central 99 % for 99 % of the time
(Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sec.
5.4). A mean below 1 is that of a careful estimator: lasting errors, such as those of a foot that
creeps, have to be stated as larger white noise.

Options: [--seeds N] [--jobs N] [--out DIR]. Prints a table of means over the seeds and writes
DIR/consistency.json. A walk takes about ten seconds.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks.console import print_table
from benchmarks.store import Runs
from fbse_drake import Log, load_scenario, simulate
from fbse_drake.campaign.steps import Material
from fbse_drake.files import write_json
from fbse_drake.report.html import Table
from fbse_drake.report.metrics import (
    friction_error,
    joint_sides,
    normalised_innovations,
    stance,
)
from fbse_drake.resources import package_checksum

_DURATION = "duration=4.3"
_STEPS = "reference.single_support={}", "reference.double_support={}"
# Scenario and overrides of each walk.
WALKS = {
    "paper_walk_fbse": ("paper_walk_fbse",),
    "steps of 0.5 / 0.5 s": ("paper_walk_fbse", *(text.format(0.5) for text in _STEPS)),
    "steps of 0.4 / 0.3 s": ("paper_walk_fbse", _STEPS[0].format(0.4), _STEPS[1].format(0.3)),
    "hrp2_walk_fbse": ("hrp2_walk_fbse",),
    "strider_walk": ("strider_walk",),
}
_BAND = chi2.interval(0.99, 1)
# The filters have settled [s].
_START = 1.0


def normalised_errors(log: Log) -> Iterator[tuple[str, np.ndarray]]:
    """Errors squared over stated variances, by state; each (N, components) [1]."""
    estimate, truth = (
        Rotation.from_quat(log[f"{kind}/base/orientation"], scalar_first=True)
        for kind in ("estimate", "truth")
    )
    turned = (estimate * truth.inv()).as_rotvec()
    yield "NEES of attitude", (turned / log["estimate/base/attitude_std"]) ** 2
    for state in ("velocity", "position"):
        error = log[f"estimate/base/{state}"] - log[f"truth/base/{state}"]
        yield f"NEES of {state}", (error / log[f"estimate/base/{state}_std"]) ** 2
    friction = (friction_error(log) / log["estimate/joint/friction_torque_std"]) ** 2
    stands = np.stack([stance(log)[side] for side in joint_sides(log)], axis=1)
    yield "NEES of friction, stance", np.where(stands, friction, np.nan)
    yield "NEES of friction, swing", np.where(stands, np.nan, friction)


def work(material: Material) -> dict[str, str]:
    """Does a run; see `benchmarks.store.Runs`."""
    result = run(material.values["walk"], material.seed)
    return {
        "sources": _sources(),
        "result": json.dumps({"walk": material.values["walk"], "figures": result}),
    }


def _sources() -> str:
    return package_checksum(Path(__file__))


def run(walk: str, seed: int) -> dict[str, tuple[float, float, float]]:
    """Walks with a seed; returns, by state and update, the mean of the normalised squares, the
    share of them in the band, and the share above it."""
    scenario, *overrides = WALKS[walk]
    log = simulate(load_scenario(scenario, overrides=[_DURATION, f"seed={seed}", *overrides])).log
    log = log.part(slice(int(np.searchsorted(log.time, _START - 1e-6)), None))
    squares = dict(normalised_errors(log))
    for estimator, parts in normalised_innovations(log).items():
        if estimator == "friction":
            parts = {"all joints": np.hstack(list(parts.values()))}
        squares |= {f"NIS of {estimator}, {part}": values for part, values in parts.items()}
    result = {}
    for name, values in squares.items():
        counted = values[np.isfinite(values)]
        if len(counted):
            within = (counted >= _BAND[0]) & (counted <= _BAND[1])
            shares = within.mean(), np.mean(counted > _BAND[1])
            result[name] = (float(counted.mean()), *map(float, shares))
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """Walks and prints the table."""
    parser = argparse.ArgumentParser(description="Are the estimators as sure as they say?")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds (default 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--out", type=Path, default=Path("out/fbse"), help="default out/fbse")
    options = parser.parse_args(arguments)
    console = Console(width=190)
    values = [{"walk": walk, "seed": seed} for walk in WALKS for seed in range(options.seeds)]
    runs = Runs(options.out / "consistency", "benchmarks.consistency:work", values, _sources())
    runs.run(console, "walking", workers=options.jobs)
    found = defaultdict(list)
    for result in runs.results():
        for name, figures in result["figures"].items():
            found[result["walk"], name].append(figures)
    lines = [(*key, *np.mean(figures, axis=0).tolist()) for key, figures in found.items()]
    header = ("Walk", "quantity", "mean", "within the central 99 %", "above it")
    print_table(console, f"Consistency from {_START:g} s on", Table(header, tuple(lines)))
    path = options.out / "consistency.json"
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(path, [dict(zip(header, line, strict=True)) for line in lines])


if __name__ == "__main__":
    main()
