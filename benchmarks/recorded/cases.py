"""Recordings that nobody chose: a machine, what it has beside its model, how it moves and what
records it, drawn at random."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from benchmarks.cases import judged, sources_checksum
from benchmarks.recorded.course import Course, inverse_dynamics, swings
from benchmarks.recorded.machine import Machine, random_machine
from benchmarks.recorded.physics import Hidden, random_physics
from benchmarks.recorded.recorder import Recorder, random_recorder
from benchmarks.recorded.setup import random_setup, stamped
from fbse_drake import Log, Scenario
from fbse_drake.campaign.steps import Material
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose, diagnosis_json
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.scenario import RobotConfig
from fbse_drake.walking.reference import Recorded

Outcome = Literal["right", "missed", "unsure", "wrong"]

# Of what is recorded, and step at which it is computed [s].
_DURATION, _STEP = (15.0, 30.0), 0.001
_LATE = "TorqueReadingLag"
# Laws of friction that are one law where the other part is none.
_FRICTION = {
    "CoulombFriction": ("CoulombViscousFriction",),
    "ViscousFriction": ("CoulombViscousFriction",),
    "StribeckFriction": ("CoulombFriction", "CoulombViscousFriction"),
}


@dataclass(frozen=True)
class Case:
    """A number that everything is drawn from."""

    name: str
    number: int

    @staticmethod
    def of(number: int) -> "Case":
        """The case of this number."""
        return Case(f"recording-{number}", number)


@dataclass(frozen=True)
class Recording:
    """A machine that moved, and what was recorded of it."""

    machine: Machine
    recorder: Recorder
    hidden: tuple[Hidden, ...]
    scenario: Scenario
    log: Log

    @property
    def truth(self) -> Mapping[str, set[str]]:
        """Effects that rightly say something about a target. What a link has may look like what its
        joint could have, and is then said of the joint, and the other way round; and the first
        joint's zero is the mount's, about its axis."""
        alike = [{link.name, link.joint} for link in self.machine.links]
        alike.append({self.machine.joints[0], "robot"})
        found: dict[str, set[str]] = {}
        for hidden in self.hidden:
            for target in hidden.targets:
                for name in hidden.names:
                    for place in {target}.union(*(pair for pair in alike if target in pair)):
                        found.setdefault(place, set()).update((name, *_FRICTION.get(name, ())))
        if self.recorder.late:
            for joint in self.machine.joints:
                found.setdefault(joint, set()).add(_LATE)
        return found


def record(number: int, folder: Path) -> Recording:
    """The recording of this number: the same each time.

    Args:
        folder: where the machine's description is written.
    """
    random = np.random.default_rng([number, 71])
    believed, recorder = random_machine(random), random_recorder(random)
    duration = random.uniform(*_DURATION)
    instants = np.arange(round(duration / _STEP) + 1) * _STEP
    motion = swings(random, instants, np.array(believed.posture), np.array(believed.amplitude))

    def course(machine: Machine, name: str) -> Course:
        (folder / name).mkdir()
        return Course(instants, *motion, inverse_dynamics(machine.robot(folder / name), *motion))

    known = course(believed, "believed")
    hidden = random_physics(random, believed, known)
    # Of its own, so that all else of a number stays what it was.
    of_setup = np.random.default_rng([number, 72])
    hidden += random_setup(of_setup, believed)
    machine = believed
    for physics in hidden:
        machine = physics.change(machine)
    real = known if machine == believed else course(machine, "real")
    torque = real.torque + sum(physics.loss(real) for physics in hidden)
    for physics in hidden:
        torque = physics.told(torque)
    sensors, recording = recorder.scenario(believed.joints, known)
    body = RobotConfig(str(folder / "believed" / "machine.yaml"), rotor_inertia=believed.rotors())
    scenario = Scenario(
        title="A machine that was drawn.",
        duration=duration,
        robot=body,
        model=body,
        reference=Recorded(),
        sensors=sensors,
        recording=recording,
    )
    shown = real
    for physics in hidden:
        shown = physics.read(shown)
    log = stamped(of_setup, recorder.log(random, believed.joints, shown, np.asarray(torque)))
    return Recording(believed, recorder, hidden, scenario, log)


def judge(material: Material) -> dict[str, str]:
    """Runs the case of this number; see `benchmarks.store.Store`."""
    case = Case.of(material.values["case"]["number"])
    with TemporaryDirectory() as folder:
        recording = record(case.number, Path(folder))
        start = time.perf_counter()
        diagnosis = diagnosis_json(diagnose(Predictor(recording.scenario, recording.log)))
        duration = time.perf_counter() - start
    found = {
        "outcome": outcome(recording, diagnosis),
        "hidden": [{"names": h.names, "targets": h.targets} for h in recording.hidden],
        "recorder": recording.recorder.text(),
        "wall_time": duration,
        "diagnoses": [diagnosis],
    }
    return judged(case, found, sources())


def outcome(recording: Recording, diagnosis: Mapping[str, Any]) -> Outcome:
    """How a recording's diagnosis is: right if everything that shows is named and nothing else.

    What the whole robot has may be declared confusable with what a joint has, and the other way
    round: a mount's tilt is an encoder offset of a joint that is level, and a spring or a
    counterbalance of one that shows no other direction of gravity.
    """
    truth = recording.truth
    everywhere = set().union(*truth.values())
    of_robot = {name for h in recording.hidden if "robot" in h.targets for name in h.names}
    chosen = [finding for finding in diagnosis["ranking"] if finding["chosen"]]

    def is_right(finding: Mapping[str, Any], target: str) -> bool:
        said = {finding["effect"], *finding["confusable_with"]}
        there = truth.get(target, set()) | of_robot
        if said & (everywhere if target == "robot" else there):
            return True
        # It may be declared confusable with another effect elsewhere, which then is listed.
        return any(
            listed["effect"] in finding["confusable_with"]
            and all(listed["effect"] in truth.get(place, ()) for place in listed["joints"])
            for listed in diagnosis["ranking"]
            if not listed["chosen"]
        )

    wrong = [f for f in chosen if not all(is_right(f, target) for target in f["joints"])]
    if wrong:
        return "wrong" if diagnosis["verdict"] == "effect_found" else "unsure"
    if diagnosis["verdict"] == "unknown_effect":
        return "unsure"
    named = {
        name for finding in chosen for name in (finding["effect"], *finding["confusable_with"])
    }
    small = {f["effect"] for f in diagnosis["ranking"] if f["too_small"]}
    missed = [
        hidden
        for hidden in recording.hidden
        if not set(hidden.names) & (named | small) and shows(hidden, diagnosis)
    ]
    return "missed" if missed else "right"


def shows(hidden: Hidden, diagnosis: Mapping[str, Any]) -> bool:
    """Does the diagnosis state of each of its names that it would have shown, and of the first that
    it would in the size that it has?"""

    def smallest(name: str, target: str) -> float:
        sizes = diagnosis["effects"].get(name, {}).get("smallest_detectable_by_target", {})
        return sizes.get(target) or math.inf

    def is_large(target: str, size: float) -> bool:
        visible = all(math.isfinite(smallest(name, target)) for name in hidden.names)
        return visible and smallest(hidden.names[0], target) < size

    sizes = hidden.sizes or [math.inf] * len(hidden.targets)
    return any(is_large(*there) for there in zip(hidden.targets, sizes, strict=True))


def sources() -> str:
    """Checksum of what decides on a case."""
    return sources_checksum(*sorted(Path(__file__).parent.glob("*.py")))
