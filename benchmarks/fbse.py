"""How good the friction estimate is, and what it is good for:
`python -m benchmarks.fbse [--seeds N] [--out DIR]`.

Simulates the walks for several seeds on all cores, prints every table, and writes them as
DIR/report.html and DIR/figures.json. A table holds means over the seeds. Estimates are online and
causal; the methods that only watch are run over the log of the same walk.
"""

import argparse
import json
import math
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console

from benchmarks.console import print_table
from benchmarks.store import Runs
from fbse_drake import Log, load_scenario, schema, simulate
from fbse_drake.campaign.steps import Material
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.estimation import estimate
from fbse_drake.estimators.identification import identify
from fbse_drake.files import write_json
from fbse_drake.report.html import Report, Section, Table, write_report
from fbse_drake.report.metrics import run_metrics
from fbse_drake.resources import folder, package_checksum

# The seed of the walk from which the fixed friction model is identified; none of the others.
_OFFLINE_SEED = 1000
_BIASES = (
    "sensors.imu.acceleration_bias=[0.05, -0.05, 0.05]",
    "sensors.imu.angular_velocity_bias=[0.01, -0.01, 0.01]",
)
_TORQUE_SENSOR = "sensors.joint_torque={noise: 0.3}"
_UNFILTERED = "compensation=!FeedforwardCompensation {cutoff: 100000}"
# What limits the estimate of a joint that hardly moves: sensors with a tenth of the noise.
_FINER = (
    "sensors.encoders.resolution=4.8e-6",
    "sensors.encoders.velocity_noise=5.0e-5",
    "sensors.imu.acceleration_noise=0.002",
    "sensors.imu.angular_velocity_noise=1.0e-4",
    "sensors.foot_force.noise=0.05",
)
# The errors of the robustness table, by what a scenario says of them; the trunk's, see
# `_model_override`.
_DISTURBED = {
    "trunk mass + 10 %": ("heavy",),
    "trunk CoM + 10 mm in x": ("shifted",),
    "force sensors + 2 %": ("sensors.foot_force.gain=1.02",),
    "force sensors 5 ms late": ("sensors.foot_force.delay=0.005",),
    "IMU turned by 0.5 deg about y": ("sensors.imu.misalignment=[0, 0.00873, 0]",),
    "all sensors ten times finer": _FINER,
    "friction model twice as steep": (
        "estimator.friction=!WholeBody {model: {transition: {all: 0.005}}}",
    ),
}


@dataclass(frozen=True)
class Case:
    """One walk, simulated for a seed."""

    name: str
    scenario: str
    child: str | None = None
    overrides: tuple[str, ...] = ()
    # Estimators that are run over its log besides, by name: as in `--set estimator=...`, or the
    # name of another child of the scenario.
    watchers: dict[str, str] | None = None


def walk(material: Material) -> dict[str, str]:
    """Does a run; see `benchmarks.store.Runs`."""
    case = schema.build(Case, material.values["case"], file="", key="case")
    return {"sources": _sources(), "result": json.dumps(run(case, material.seed))}


def _sources() -> str:
    return package_checksum(Path(__file__))


def run(case: Case, seed: int) -> dict[str, dict[str, Any]]:
    """Simulates a case; returns the figures of the walk (under the case's name) and of each
    watcher."""
    with tempfile.TemporaryDirectory() as scratch:
        overrides = [
            f"seed={seed}",
            *(_model_override(text, Path(scratch)) for text in case.overrides),
        ]
        scenario = load_scenario(case.scenario, case.child, overrides)
        result = simulate(scenario, name=case.name)
        log = result.log
        results = {case.name: _figures(log, result.failure, math.nan)}
        if "estimate/joint/friction_torque" in log:
            results[case.name]["tick_us"] = 1e6 * float(
                np.median(estimate(scenario, _start(log, 2000)).tick_time)
            )
        for name, estimator in (case.watchers or {}).items():
            child, change = (
                (estimator, [])
                if not estimator.startswith("!")
                else (case.child, [f"estimator={estimator}"])
            )
            watched = estimate(load_scenario(case.scenario, child, overrides + change), log)
            results[name] = _figures(
                watched.log, result.failure, 1e6 * float(np.median(watched.tick_time))
            )
    return results


def _start(log: Log, samples: int) -> Log:
    return Log({name: values[:samples] for name, values in log.channels.items()}, log.meta)


def _figures(log: Log, failure: str | None, tick_us: float) -> dict[str, Any]:
    metrics = run_metrics(log, 1.0)
    return {
        "failure": failure,
        "nrmse": {
            phase: list(values.values()) for phase, values in metrics["friction_nrmse"].items()
        },
        "attitude": list(metrics["attitude_rmse_deg"].values()),
        "base_velocity": list(metrics["base_velocity_rmse"].values()),
        "tracking": 1e3 * float(np.mean(list(metrics["joint_tracking_rms"].values()))),
        "com_error": [1e3 * value for value in metrics["com_rse_mean"].values()],
        "com": log["truth/com/position"][:, :2].tolist(),
        "tick_us": tick_us,
        "joints": log.joints,
    }


def _model_override(text: str, scratch: Path) -> str:
    """An override as it is, or that of a model with another trunk, whose files are written to
    `scratch`."""
    changes = {
        "heavy": ('<mass value="50"/>', '<mass value="55"/>'),
        "shifted": (
            '<origin xyz="0.025 0 0.15"/>\n      <mass',
            '<origin xyz="0.035 0 0.15"/>\n      <mass',
        ),
    }
    if text not in changes:
        return text
    models = scratch / "models"
    shutil.copytree(folder("models"), models)
    urdf = (models / "biped.urdf").read_text()
    old, new = changes[text]
    if urdf.count(old) != 1:
        raise ValueError(f"biped.urdf: expected {old} once")
    (models / "biped.urdf").write_text(urdf.replace(old, new))
    return f"model.description={models / 'biped.yaml'}"


def _changes(changes: tuple[str, ...], scenario: str) -> tuple[str, ...]:
    """Overrides of a robustness case; a model that is spelt out needs the scenario's rotor inertia
    as well."""
    if not set(changes) & {"heavy", "shifted"}:
        return changes
    inertia = load_scenario(scenario).believed.rotor_inertia
    return (*changes, f"model.rotor_inertia={json.dumps(inertia)}")


def fixed_friction(scenario: str, child: str | None = None) -> str:
    """A friction model identified offline from the measured friction of one walk, as
    `--set estimator=` takes it."""
    log = simulate(load_scenario(scenario, child, [f"seed={_OFFLINE_SEED}"])).log
    rows = slice(500, None)
    found = identify(
        CoulombViscousFriction,
        log.joints,
        log["joint/velocity"][rows],
        log["estimate/joint/residual_torque"][rows],
    )
    text = yaml.dump({"model": dict(vars(found.config()))}, default_flow_style=True, width=10**6)
    return "!FixedFriction " + text.strip().replace(
        "{model: {", "{model: !CoulombViscousFriction {"
    )


def cases(fixed: Mapping[str, str]) -> list[Case]:
    """All walks of the tables.

    Args:
        fixed: friction models identified offline, by scenario.
    """
    watchers = {
        "Table I, paper's method": "paper_method",
        "Table I, disturbance observer": "!DisturbanceObserver {}",
        "Table I, torque sensors": "!TorqueSensor {}",
        "Table I, fixed model": fixed["paper_walk_fbse"],
    }
    paper = (
        "estimator=!Fbse {attitude: {level_feet: 0}, base_state: !AdaptiveLipm {}, "
        "support: !PlannedSupport {}, "
    )
    paper += "joint_acceleration: {method: minimum_norm}, friction: !RecursiveLeastSquares {}}"
    hrp2 = {
        "no compensation": ("compensation=!NoCompensation {}", _TORQUE_SENSOR),
        "oracle": ("estimator=!TrueFriction {}", _UNFILTERED),
        "FBSE": (),
        "disturbance observer": ("estimator=!DisturbanceObserver {}",),
        "torque sensors": ("estimator=!TorqueSensor {}", _TORQUE_SENSOR),
        "fixed model": (f"estimator={fixed['hrp2_walk_fbse']}",),
        "no friction": (
            "robot.effects=null",
            "estimator=!NoEstimator {}",
            "compensation=!NoCompensation {}",
        ),
    }
    seen = {
        "no compensation": {
            "HRP-2 watched, disturbance observer": "!DisturbanceObserver {}",
            "HRP-2 watched, torque sensors": "!TorqueSensor {}",
            "HRP-2 watched, fixed model": fixed["hrp2_walk_fbse"],
        }
    }
    return [
        Case(
            "Table I, best variant",
            "paper_walk_fbse",
            overrides=(_TORQUE_SENSOR,),
            watchers=watchers,
        ),
        Case("Table I, biased IMU", "paper_walk_fbse", overrides=_BIASES),
        Case("integral law, best variant", "paper_walk_integral"),
        Case("integral law, paper's method", "paper_walk_integral", overrides=(paper,)),
        Case(
            "integral law, true friction",
            "paper_walk_integral",
            overrides=("estimator=!TrueFriction {}",),
        ),
        Case("Table I, no friction", "paper_walk_fbse", overrides=("robot.effects=null",)),
        *(
            Case(f"HRP-2, {name}", "hrp2_walk_fbse", overrides=changes, watchers=seen.get(name))
            for name, changes in hrp2.items()
        ),
        Case("HRP-2, biased IMU", "hrp2_walk_fbse", overrides=_BIASES),
    ]


def robustness_cases() -> list[Case]:
    """Walks with one error each, in the estimator's model or sensors."""
    return [
        Case(f"{walk}, {error}", scenario, overrides=_changes(changes, scenario))
        for walk, scenario in (("Table I", "paper_walk_fbse"), ("HRP-2", "hrp2_walk_fbse"))
        for error, changes in _DISTURBED.items()
    ]


class Results:
    """Figures of all runs, by name; every method is the mean over the seeds."""

    def __init__(self) -> None:
        self._runs: dict[str, list[dict[str, Any]]] = defaultdict(list)

    def add(self, figures: Mapping[str, dict[str, Any]]) -> None:
        for name, values in figures.items():
            self._runs[name].append(values)

    def mean(self, name: str, pick: Callable[[dict[str, Any]], Any]) -> np.ndarray:
        return np.mean(
            [np.asarray(pick(values), dtype=float) for values in self._runs[name]], axis=0
        )

    def nrmse(self, name: str, phase: str) -> np.ndarray:
        """Mean NRMSE of the friction of each leg joint, both legs together."""
        values = self.mean(name, lambda figures: figures["nrmse"][phase])
        return values.reshape(2, -1).mean(axis=0)

    def falls(self, name: str) -> int:
        return sum(values["failure"] is not None for values in self._runs[name])

    def leg_joints(self) -> list[str]:
        joints = next(iter(self._runs.values()))[0]["joints"]
        return [joint.split("_", 1)[1].replace("_", " ") for joint in joints[: len(joints) // 2]]

    def com_deviation(self, name: str, other: str) -> np.ndarray:
        """Mean distance of the CoM to that of the same walk `other`, in x and y [mm]."""
        pairs = zip(self._runs[name], self._runs[other], strict=True)
        rows = [
            np.abs(np.subtract(a["com"][: len(b["com"])], b["com"][: len(a["com"])])).mean(axis=0)
            for a, b in pairs
        ]
        return 1e3 * np.mean(rows, axis=0)


def tables(results: Results, robust: Results) -> dict[str, Table]:
    """All tables by title."""
    joints = results.leg_joints()
    methods = [
        "HRP-2, FBSE",
        "HRP-2, no compensation",
        *(f"Table I, {name}" for name in ("best variant", "paper's method")),
    ]
    rows = [
        (name, phase, *results.nrmse(name, phase))
        for name in methods
        for phase in ("stance", "swing")
    ]
    friction = Table(("Friction NRMSE", "leg in", *joints), tuple(rows))

    states = Table(
        ("RMS error", "roll [deg]", "pitch [deg]", "base vx [m/s]", "vy [m/s]", "vz [m/s]"),
        tuple(
            (
                name,
                *results.mean(name, lambda f: f["attitude"]),
                *results.mean(name, lambda f: f["base_velocity"]),
            )
            for name in (*methods, "Table I, biased IMU", "HRP-2, biased IMU")
        ),
    )

    plain = results.mean("Table I, best variant", lambda f: f["com_error"])
    claim_rows: list[tuple[str | float, ...]] = []
    laws = ("best variant", "paper's method", "true friction")
    for name in (
        "Table I, best variant",
        *(f"integral law, {law}" for law in laws),
        "Table I, no friction",
    ):
        label = {
            "Table I, best variant": "position loop alone",
            "Table I, no friction": "position loop alone, no friction",
        }.get(name, name)
        error = results.mean(name, lambda f: f["com_error"])
        claim_rows.append(
            (
                label,
                *error,
                *(100 * (error / plain - 1)),
                float(results.mean(name, lambda f: f["tracking"])),
            )
        )
    claim = Table(
        ("Paper's gains", "CoM error x [mm]", "y [mm]", "change x [%]", "y [%]", "tracking [mrad]"),
        tuple(claim_rows),
    )

    def recovered(values: Mapping[str, float], name: str) -> float:
        return (
            100
            * (values["no compensation"] - values[name])
            / (values["no compensation"] - values["oracle"])
        )

    compared = (
        "no compensation",
        "oracle",
        "FBSE",
        "disturbance observer",
        "torque sensors",
        "fixed model",
    )
    tracking = {
        name: float(results.mean(f"HRP-2, {name}", lambda f: f["tracking"])) for name in compared
    }
    deviation = {
        name: results.com_deviation(f"HRP-2, {name}", "HRP-2, no friction") for name in compared
    }
    sides = [{name: float(value[axis]) for name, value in deviation.items()} for axis in range(2)]
    both = {name: float(np.hypot(*value)) for name, value in deviation.items()}
    header = (
        "tracking [mrad]",
        "recovered [%]",
        "CoM deviation x [mm]",
        "y [mm]",
        "recovered x [%]",
        "y [%]",
        "both [%]",
    )
    recovery_rows: list[tuple[str | float, ...]] = []
    for name in compared:
        shares = (recovered(values, name) for values in (*sides, both))
        recovery_rows.append(
            (name, tracking[name], recovered(tracking, name), *deviation[name], *shares)
        )
    recovery = Table(("HRP-2 friction, fed forward", *header), tuple(recovery_rows))

    reference_rows: list[tuple[str | float, ...]] = []
    for name in (
        *(
            f"Table I, {method}"
            for method in (
                "best variant",
                "paper's method",
                "disturbance observer",
                "torque sensors",
                "fixed model",
            )
        ),
        "HRP-2, no compensation",
        *(
            f"HRP-2 watched, {method}"
            for method in ("disturbance observer", "torque sensors", "fixed model")
        ),
    ):
        tick = float(results.mean(name, lambda f: f["tick_us"]))
        for phase in ("stance", "swing"):
            label = {"HRP-2, no compensation": "HRP-2 watched, best variant"}.get(name, name)
            reference_rows.append((label, phase, *results.nrmse(name, phase), tick))
    reference = Table(("Friction NRMSE", "leg in", *joints, "tick [us]"), tuple(reference_rows))

    robust_rows: list[tuple[str | float, ...]] = []
    for walk, undisturbed in (("Table I", "Table I, best variant"), ("HRP-2", "HRP-2, FBSE")):
        sources = [
            (f"{walk}, no error", results, undisturbed),
            *((f"{walk}, {e}", robust, f"{walk}, {e}") for e in _DISTURBED),
        ]
        for name, source, key in sources:
            tilt = float(np.max(source.mean(key, lambda f: f["attitude"])))
            velocity = float(np.max(source.mean(key, lambda f: f["base_velocity"])))
            walked = (
                tilt,
                velocity,
                float(source.mean(key, lambda f: f["tracking"])),
                float(source.falls(key)),
            )
            robust_rows += [
                (name, phase, *source.nrmse(key, phase), *walked) for phase in ("stance", "swing")
            ]
    header = ("tilt [deg]", "velocity [m/s]", "tracking [mrad]", "falls")
    robustness = Table(("Friction NRMSE", "leg in", *joints, *header), tuple(robust_rows))
    return {
        "Friction estimate": friction,
        "Attitude and base velocity": states,
        "The paper's claim: integral law": claim,
        "Realistic friction: feed-forward": recovery,
        "Against the reference methods": reference,
        "Robustness": robustness,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs everything and prints the tables."""
    parser = argparse.ArgumentParser(description="Figures of merit of the friction estimate.")
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds (default 10)")
    parser.add_argument(
        "--robustness-seeds",
        type=int,
        default=3,
        help="number of seeds of the robustness table (default 3)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/fbse"),
        help="where the report goes (default out/fbse)",
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    console = Console(width=190)
    fixed = {
        scenario: fixed_friction(scenario) for scenario in ("paper_walk_fbse", "hrp2_walk_fbse")
    }
    results, robust = Results(), Results()
    for into, title, all_cases, seeds in (
        (results, "walking", cases(fixed), options.seeds),
        (robust, "walking with errors", robustness_cases(), options.robustness_seeds),
    ):
        values = [
            {"case": asdict(case), "seed": seed} for seed in range(seeds) for case in all_cases
        ]
        runs = Runs(options.out / "runs", "benchmarks.fbse:walk", values, _sources())
        runs.run(console, title, workers=None)
        for figures in runs.results():
            into.add(figures)
    made = tables(results, robust)
    for title, table in made.items():
        print_table(console, title, table)
    content = {title: {"header": t.header, "rows": t.rows} for title, t in made.items()}
    write_json(options.out / "figures.json", content)
    sections = tuple(Section(title, tables=(table,)) for title, table in made.items())
    outcome = (
        f"Means over {options.seeds} seeds ({options.robustness_seeds} in the robustness table)."
    )
    write_report(
        options.out / "report.html",
        Report("Friction estimation in figures", True, outcome, sections),
    )
    console.print(f"Report: {options.out / 'report.html'}", highlight=False)


if __name__ == "__main__":
    main()
