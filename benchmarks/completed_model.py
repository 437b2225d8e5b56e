"""What it brings the friction estimate to know an effect: `python -m benchmarks.completed_model`.

A walk with a hidden effect is estimated with the model as it is, which has no such effect, and with
the effect added to it, as a diagnosis would add it, here with its true values. Beside them stands
the momentum observer, with the bandwidth that is best for it without the effect.

Options: [--seed N] [--duration SECONDS] [--out DIR]. Prints a table and writes
DIR/completed_model.json; an effect takes some 20 s.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.progress import track

from benchmarks.console import print_table
from benchmarks.off_nominal import Figures
from fbse_drake import load_scenario, simulate
from fbse_drake.estimation import estimate
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.files import write_json
from fbse_drake.report.html import Table

_SCENARIO = "paper_walk_fbse"
_BANDWIDTHS = (2.0, 5.0, 10.0, 20.0, 40.0)
# By what is said of it, as in a scenario file.
EFFECTS = {
    "foot forces 5 % too small, left": "!FootForceGain {gain: {left: -0.05}}",
    "foot sensor turned by 0.05 rad, left": "!FootForceMisalignment {x: {left: 0.05}}",
    "foot forces 5 N off, left": "!FootForceBias {z: {left: 5}}",
    "foot forces behind a low-pass of 5 ms": (
        "!FootForceLag {time_constant: {left: 0.005, right: 0.005}}"
    ),
    "IMU turned by 0.03 rad": "!ImuMisalignment {x: 0.03}",
    "accelerometer reads 3 % too much": "!AccelerometerGain {gain: 0.03}",
    "encoders of two joints 10 mrad off": (
        "!EncoderOffset {offset: {left_knee_pitch: 0.01, right_hip_pitch: -0.01}}"
    ),
    "gears twist by 0.05 mrad/Nm": "!TransmissionElasticity {compliance: {all: 5.0e-5}}",
    "motors give 5 % less": "!TorqueGain {shortfall: {all: 0.05}}",
    "motors lag by 0.5 ms": "!TorqueLag {time_constant: {all: 0.0005}}",
    "friction of 5 % of the load": "!LoadDependentFriction {coefficient: {all: 0.05}}",
    "presliding friction of 1.5 Nm": "!PreslidingHysteresis {coulomb: {all: 1.5}}",
    "springs of 5 Nm/rad": "!JointSpring {stiffness: {all: 5.0}}",
    "thighs 1.2 kg heavier": "!BodyMass {mass: {left_thigh: 1.2, right_thigh: 1.2}}",
}


@dataclass(frozen=True)
class Row:
    """Friction NRMSE, mean over the joints but the hip yaws, with one effect in the robot."""

    effect: str
    as_given: float
    completed: float
    observer: float


def rows(seed: int, duration: float) -> Iterator[Row]:
    """Does them one after the other."""
    common = [f"seed={seed}", f"duration={duration}"]
    nobody, given = "estimator=!NoEstimator {}", load_scenario(_SCENARIO, overrides=common)
    for name, text in track(EFFECTS.items(), "walking"):
        hidden = [*common, nobody, f"robot.effects.hidden={text}"]
        log = simulate(load_scenario(_SCENARIO, overrides=hidden)).log
        completed = load_scenario(_SCENARIO, overrides=[*common, f"model.effects.found={text}"])
        observers = [replace(given, estimator=DisturbanceObserver(b)) for b in _BANDWIDTHS]
        errors = [
            Figures.of(estimate(scenario, log).log).nrmse
            for scenario in (given, completed, *observers)
        ]
        yield Row(name, errors[0], errors[1], min(errors[2:]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description="The friction estimate with a completed model.")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    parser.add_argument("--duration", type=float, default=4.3, help="of a walk [s] (default 4.3)")
    parser.add_argument("--out", type=Path, default=Path("out/fbse"), help="default out/fbse")
    options = parser.parse_args(arguments)
    found = list(rows(options.seed, options.duration))
    header = ("In the robot", "model as given", "completed model", "momentum observer")
    lines = tuple((row.effect, row.as_given, row.completed, row.observer) for row in found)
    console = Console(width=110)
    print_table(console, "Friction NRMSE from 1 s on", Table(header, lines))
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "completed_model.json", [vars(row) for row in found])


if __name__ == "__main__":
    main()
