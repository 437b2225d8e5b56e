"""How good the friction estimate is off the beaten path: `python -m benchmarks.off_nominal`.

Walks with another timing, ground, robot or sensors than the defaults were chosen on. The estimators
are told the planned motion and nothing else: errors are put into the robot and its sensors when the
walk is simulated, and every estimator runs over the log with the scenario as it is without them.
The momentum observer has the bandwidth that is best in each case, which nobody can know beforehand.

Options: [--only CASE]... [--random N] [--trots N] [--first NUMBER] [--seeds N] [--duration SECONDS]
[--default] [--jobs N] [--out DIR]. --random walks N walks instead that are drawn by their numbers:
other steps, and a quarter of all that can be wrong with ground, robot, sensors and friction laws;
--trots has a quadruped trot, likewise.
Prints a table of means over the seeds, with the median and the worst of the NRMSE, and writes
DIR/off_nominal.json. One process does it unless --jobs 2 says otherwise; a case takes about half a
minute, or 10 s with --default, which leaves out the methods that the default is compared with.
"""

import argparse
import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from scipy.spatial.transform import Rotation

from benchmarks import off_nominal_walks
from benchmarks.console import print_table
from benchmarks.off_nominal_walks import CASES, PAPER_WALK, Case, case_of, random_name, trot_name
from benchmarks.store import Runs
from fbse_drake import Log, load_scenario, simulate
from fbse_drake.campaign.steps import Material
from fbse_drake.estimation import estimate
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.estimator import Estimator
from fbse_drake.files import write_json
from fbse_drake.report.html import Table
from fbse_drake.report.metrics import friction_error, joint_sides, run_metrics, settled, stance
from fbse_drake.resources import package_checksum

_PHASES = ("stance", "swing")
_BANDWIDTHS = (2.0, 5.0, 10.0, 20.0, 40.0)
# Figures count from 1 s on; those of `run_metrics` leave out the first 0.2 s of a log.
_START = 0.8
# Standard deviations within which 99 % of the errors are to be.
_CONFIDENCE = 2.58
# Share of time in which they have to be [1].
_LEAST_COVERED = 0.95


def watchers(
    default: Estimator, joint_by_joint: Estimator, alone: bool
) -> Iterator[tuple[str, str, Estimator]]:
    """Method, variant and estimator of each that runs over a log; or of the default alone."""
    yield "default", "", default
    if alone:
        return
    yield "joint by joint", "", joint_by_joint
    for bandwidth in _BANDWIDTHS:
        yield "momentum observer", f"{bandwidth:g} Hz", DisturbanceObserver(bandwidth)
    yield "paper's method", "", load_scenario(PAPER_WALK, "paper_method").estimator


@dataclass(frozen=True)
class Figures:
    """How good an estimator is on a walk; means over all joints but the hip yaws."""

    # Friction: rms of the error over that of the friction [1], and the rms itself [Nm].
    nrmse_stance: float
    nrmse_swing: float
    rmse: float
    # Base: velocity [m/s], roll and pitch [deg].
    velocity: float
    tilt: float
    # Share of time in which the friction is as close to the truth as the estimator says [1].
    covered_stance: float
    covered_swing: float

    @property
    def nrmse(self) -> float:
        """Of stance and swing together [1]."""
        return (self.nrmse_stance + self.nrmse_swing) / 2

    @staticmethod
    def of(log: Log) -> "Figures":
        log = log.part(slice(int(np.searchsorted(log.time, _START - 1e-6)), None))
        metrics = run_metrics(log, 1.0)
        nrmse = [_mean(metrics["friction_nrmse"][phase]) for phase in _PHASES]
        rmse = [_mean(metrics["friction_rmse"][phase]) for phase in _PHASES]
        return Figures(
            *nrmse,
            float(np.mean(rmse)),
            math.hypot(*metrics["base_velocity_rmse"].values()),
            math.hypot(*metrics["attitude_rmse_deg"].values()),
            *_covered(log),
        )

    @staticmethod
    def mean(figures: Sequence["Figures"]) -> "Figures":
        return Figures(*np.mean([list(vars(of_seed).values()) for of_seed in figures], axis=0))


def _counts(joint: str) -> bool:
    """The hip yaws do not: they tremble at rest, see docs/accuracy.md."""
    return not joint.endswith("hip_yaw")


def _mean(values: Mapping[str, float]) -> float:
    return float(np.mean([value for joint, value in values.items() if _counts(joint)]))


def _covered(log: Log) -> list[float]:
    """Share of time in which the error is as small as the estimator says, in stance and swing."""
    if "estimate/joint/friction_torque_std" not in log:
        return [math.nan, math.nan]
    bound = _CONFIDENCE * log["estimate/joint/friction_torque_std"]
    inside, rows, stands = np.abs(friction_error(log)) <= bound, settled(log), stance(log)
    sides = dict(zip(log.joints, joint_sides(log), strict=True))
    shares = np.array(
        [
            [inside[rows & (stands[side] == stood), number].mean() for stood in (True, False)]
            for number, (joint, side) in enumerate(sides.items())
            if _counts(joint)
        ]
    )
    return shares.mean(axis=0).tolist()


@dataclass(frozen=True)
class Walked:
    """What became of a case with one seed: figures by method and variant."""

    case: str
    failure: str | None
    figures: dict[tuple[str, str], Figures]


def walk(material: Material) -> dict[str, str]:
    """Does a run; see `benchmarks.store.Runs`."""
    case = case_of(material.values["case"])
    walked = run(case, material.seed, material.values["duration"], material.values["alone"])
    figures = [[*watcher, vars(of_watcher)] for watcher, of_watcher in walked.figures.items()]
    return {"sources": _sources(), "result": json.dumps([case.name, walked.failure, figures])}


def _sources() -> str:
    return package_checksum(Path(__file__), Path(off_nominal_walks.__file__))


def read(case: str, failure: str | None, figures: Sequence[Sequence[Any]]) -> Walked:
    """What `walk` has written."""
    return Walked(
        case, failure, {(method, variant): Figures(**of) for method, variant, of in figures}
    )


def run(case: Case, seed: int, duration: float, alone: bool) -> Walked:
    """Simulates a case with a seed for a duration [s], and has it watched, see `watchers`, if it
    does not fall."""
    common = [f"seed={seed}", f"duration={duration}", *case.told]
    nobody = ["estimator=!NoEstimator {}"]
    happens = load_scenario(case.scenario, overrides=[*common, *nobody, *case.untold])
    result = simulate(happens)
    if result.failure is not None:
        return Walked(case.name, result.failure, {})
    log = _levelled(result.log, happens.ground.slope)
    believed = load_scenario(case.scenario, overrides=common)
    # The same model of the friction, by the other filter.
    told = [text.replace("!WholeBody", "!ModelAided") for text in common]
    other = load_scenario(case.scenario, overrides=["estimator.friction=!ModelAided {}", *told])
    figures = {
        (method, variant): Figures.of(estimate(replace(believed, estimator=config), log).log)
        for method, variant, config in watchers(believed.estimator, other.estimator, alone)
    }
    return Walked(case.name, result.failure, figures)


def _levelled(log: Log, slope: Sequence[float]) -> Log:
    """A log whose true base is not in axes of sloping ground but in level ones, as it is for
    estimators that nobody told of the slope [rad]."""
    level, base = Rotation.from_rotvec([*slope, 0.0]), "truth/base"
    orientation = Rotation.from_quat(log[f"{base}/orientation"], scalar_first=True)
    channels = {f"{base}/orientation": (level * orientation).as_quat(scalar_first=True)}
    for name in ("position", "velocity"):
        channels[f"{base}/{name}"] = level.apply(log[f"{base}/{name}"])
    return replace(log, channels={**log.channels, **channels})


@dataclass(frozen=True)
class Row:
    """A method in a case."""

    case: str
    method: str
    variant: str
    # Means over the seeds.
    figures: Figures
    # NRMSE of the median and of the worst seed.
    median: float
    worst: float

    @staticmethod
    def of(case: str, watcher: tuple[str, str], seeds: Sequence["Walked"]) -> "Row":
        figures = [walked.figures[watcher] for walked in seeds]
        nrmse = [of_seed.nrmse for of_seed in figures]
        return Row(case, *watcher, Figures.mean(figures), float(np.median(nrmse)), max(nrmse))


def all_rows(walks: Sequence[Walked]) -> list[Row]:
    """Every variant of every method in every case."""
    by_case: dict[str, list[Walked]] = defaultdict(list)
    for walked in walks:
        if walked.failure is None:
            by_case[walked.case].append(walked)
    return [
        Row.of(case, watcher, seeds)
        for case, seeds in by_case.items()
        for watcher in seeds[0].figures
    ]


def best_rows(rows: Sequence[Row]) -> list[Row]:
    """The best variant of every method in every case."""
    best: dict[tuple[str, str], Row] = {}
    for row in rows:
        key = row.case, row.method
        if key not in best or row.figures.nrmse < best[key].figures.nrmse:
            best[key] = row
    return list(best.values())


def table(rows: Sequence[Row]) -> Table:
    """A line for each of these rows."""
    header = ("Walk", "method", "NRMSE", "median", "worst", "stance", "swing", "error [Nm]")
    header += ("velocity [m/s]", "tilt [deg]", "within 99 %, stance", "swing")
    lines: list[tuple[str | float, ...]] = []
    for row in rows:
        method = ", ".join(filter(None, (row.method, row.variant)))
        nrmse = row.figures.nrmse, row.median, row.worst
        lines.append((row.case, method, *nrmse, *vars(row.figures).values()))
    return Table(header, tuple(lines))


def weak(rows: Sequence[Row]) -> Iterator[Case]:
    """Cases in which the best of another method is better than the default, or the default is
    further off than it says in 5 % of the time."""
    by_case: dict[str, list[Row]] = defaultdict(list)
    for row in best_rows(rows):
        by_case[row.case].append(row)
    for name, of_case in by_case.items():
        default, *others = (row.figures for row in of_case)
        covered = min(default.covered_stance, default.covered_swing)
        if covered < _LEAST_COVERED or any(other.nrmse < default.nrmse for other in others):
            yield case_of(name)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the cases and prints the table."""
    parser = argparse.ArgumentParser(description="The friction estimate off the beaten path.")
    names = [case.name for case in CASES]
    parser.add_argument("--only", action="append", choices=names, help="a case; may be repeated")
    parser.add_argument("--random", type=int, default=0, help="walks that are drawn at random")
    parser.add_argument("--trots", type=int, default=0, help="trots that are drawn at random")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds (default 1)")
    parser.add_argument("--duration", type=float, default=4.3, help="of a walk [s] (default 4.3)")
    alone = "run no other method over the logs"
    parser.add_argument("--default", action="store_true", help=alone)
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--out", type=Path, default=Path("out/fbse"), help="default out/fbse")
    options = parser.parse_args(arguments)
    console = Console(width=190)
    drawn = ((random_name, options.random), (trot_name, options.trots))
    at_random = [name(options.first + k) for name, count in drawn for k in range(count)]
    wanted = at_random or options.only or names
    values = [
        {"case": case, "duration": options.duration, "seed": seed, "alone": options.default}
        for case in wanted
        for seed in range(options.seeds)
    ]
    runs = Runs(options.out / "off_nominal", "benchmarks.off_nominal:walk", values, _sources())
    runs.run(console, "walking", workers=options.jobs)
    walks = [read(*result) for result in runs.results()]
    rows = all_rows(walks)
    title = f"Off the beaten path: friction from 1 s on, {options.seeds} seed(s)"
    print_table(console, title, table(best_rows(rows)))
    for walked in walks:
        if walked.failure is not None:
            console.print(f"{walked.case}: {walked.failure}", highlight=False, markup=False)
    for case in weak(rows):
        lines = "\n  ".join([f"To be looked at: {case.name}", *case.told, *case.untold])
        console.print(lines, highlight=False, markup=False)
    records = [
        {"case": row.case, "method": row.method, "variant": row.variant}
        | {"nrmse": row.figures.nrmse, "median": row.median, "worst": row.worst}
        | vars(row.figures)
        for row in rows
    ]
    path = options.out / "off_nominal.json"
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(path, records)
    console.print(f"All variants: {path}", highlight=False)


if __name__ == "__main__":
    main()
