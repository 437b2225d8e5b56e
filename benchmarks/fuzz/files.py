"""A right file of each kind, and the command that reads it."""

import base64
import hashlib
import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.fuzz import mutations
from fbse_drake import Log, load_scenario, simulate
from fbse_drake.campaign.campaign import load_campaign
from fbse_drake.cli import main
from fbse_drake.discrepancy.exercises.hidden import Answer, HiddenEffect, seal
from fbse_drake.resources import folder

ARM = """\
arm:
  duration: 0.02
  robot:
    description: arm.yaml
    rotor_inertia: {all: 0.01}
    effects:
      friction: !CoulombFriction {coulomb: {all: 0.1}, transition: {all: 0.01}}
      delay: !TorqueDelay {delay: {servo: 0.002}}
  model: {description: arm.yaml}
  reference: !JointSines {amplitude: {all: 0.2}, frequency: {all: 1.0}}
  sensors:
    encoders: {resolution: 1.0e-4}
    more: {winding: !JointTemperature {}}
  control: {kp: {all: 100}, kd: {all: 1}, torque_limit: {all: 50}}
  recording: {block: 0.01, cutoff: 60, torque_noise: {all: 0.01}}
  log: {period: 0.001}
  identify: {inertia: [all]}
"""
BIPED = """\
biped:
  duration: 0.01
  robot: {effects: {friction: !ViscousFriction {viscous: {knee_pitch: 0.5}}}}
  ground: {friction: 0.7, slope: [0.0, 0.01]}
  reference: !Squat {amplitude: 0.02}
  sensors: {imu: {acceleration_noise: 0.02}, foot_force: {noise: 0.5}}
  estimator: !Fbse {}
  fall: {tilt: 0.5}
"""
WALK = """\
walk:
  duration: 0.01
  plant: {time_step: 0.001}
  reference: !Walk {step_length: 0.08, single_supports: 3, first_support: left}
  compensation: !IntegralCompensation {}
"""
CAMPAIGN = """\
title: A campaign
scenarios: [arm.scenario.yaml]
set: ["duration=0.1"]
steps: {walk: !Simulate {}, blind: !Hide {what: TorqueBias, count: 1}}
design: !Random
  runs: 3
  seed: 1
  values:
    robot.rotor_inertia.all: !Uniform {low: 0.0, high: 0.1}
    control.kd.all: !LogUniform {low: 0.1, high: 2.0}
"""
MAP = """\
joints: [servo]
time: {column: t, unit: ms}
period: 0.01
channels:
  joint/position: {columns: [q], unit: deg, offsets: [1.0]}
  joint/torque_command: {columns: [i], times: [gain], gain: 0.09, signed_bits: 0}
  joint/velocity: {columns: [q, i], matrix: [[0.5, 0.5]], optional: true}
"""
FINDING = {
    "effect": "CoulombFriction",
    "joints": ["servo"],
    "held_out_before": 2.0,
    "held_out_after": 1.0,
    "parameters": {
        "coulomb": {"value": 0.5, "interval": [0.4, 0.6], "unit": "Nm"},
        "transition": {"value": 0.01, "interval": [None, 0.02], "unit": "rad/s"},
    },
    "confusable_with": ["ViscousFriction"],
    "chosen": True,
    "too_small": False,
    "share": 0.1,
}
DIAGNOSIS = {
    "schema_version": 1,
    "verdict": "effect_found",
    "ranking": [FINDING],
    "unexplained": [{"row": "servo", "ratio": 1.0}],
}
ANSWER = {
    "kind": "library",
    "size": "small",
    "shrunk": 1.0,
    "effects": [
        {
            "effect": "CoulombFriction",
            "targets": ["servo"],
            "size": 0.5,
            "parameters": {"coulomb": {"servo": 0.5}, "transition": {"servo": 0.01}},
        }
    ],
}
# Of the logs [s].
DURATIONS = {"arm": 0.4, "biped": 0.25}
OPTIONS = ("--out", "out", "--quiet")


@dataclass(frozen=True)
class Kind:
    """A kind of file: what it is called, how a wrong one is made, and the commands that read it."""

    # Of the files in the folder of right ones, one of which is made wrong.
    files: tuple[str, ...]
    wrong: Callable[[bytes, np.random.Generator], bytes]
    # One of these, in which {} is the name of the file without its suffixes.
    commands: tuple[tuple[str, ...], ...]
    # How often it is tried, as a share of the others.
    weight: float = 1.0
    run: Callable[[Sequence[str]], int] = main


def right_files(place: Path, logs: Sequence[str] = ("arm", "biped")) -> None:
    """Writes a right file of each kind, and the logs of these robots."""
    texts = {
        "arm.scenario.yaml": ARM,
        "biped.scenario.yaml": BIPED,
        "walk.scenario.yaml": WALK,
        "campaign.yaml": CAMPAIGN,
        "recorded.map.yaml": MAP,
        "diagnosis.json": json.dumps(DIAGNOSIS),
        "study.json": json.dumps({"diagnoses": [DIAGNOSIS, DIAGNOSIS]}),
        "arm.urdf": (folder("models") / "pendulum.urdf").read_text(encoding="utf-8"),
        "arm.yaml": "urdf: arm.urdf\nbase: bench\nfixed_base: true\njoints: [servo]\nheld: {}\n",
        "canary.py": "from pathlib import Path\n\nPath('RAN').write_text('')\n",
        "t.csv": "t,q,i,gain\n" + "".join(f"{10 * k},{k},{0.1 * k},1\n" for k in range(40)),
    }
    for name, text in texts.items():
        (place / name).write_text(text, encoding="utf-8")
    effect = HiddenEffect("CoulombFriction", ("servo",), 0.5, ANSWER["effects"][0]["parameters"])
    (place / "answer.sealed").write_text(seal(Answer("library", "small", 1.0, (effect,))))
    for name in logs:
        description = place / "arm.yaml" if name == "arm" else "biped"
        overrides = [f"duration={DURATIONS[name]}", f"robot.description={description}"]
        if name == "arm":
            overrides.append(f"model.description={description}")
        log = simulate(load_scenario(place / f"{name}.scenario.yaml", overrides=overrides)).log
        measured = {name: log[name] for name in log if not name.startswith("truth/")}
        segment = {"start": 0.0, "end": 0.2, "source": "a", "recorded_start": 0.0, "gain": 2.0}
        Log(measured, {**log.meta, "segments": [segment], "findings": ["x"]}).save(
            place / f"{name}.npz"
        )


def _json(content: bytes, random: np.random.Generator) -> bytes:
    if random.integers(4) == 0:
        return mutations.damaged(content, random)
    return json.dumps(mutations.changed(json.loads(content), random)).encode("utf-8", "replace")


def _yaml(content: bytes, random: np.random.Generator) -> bytes:
    if random.integers(5) == 0:
        return mutations.damaged(content, random)
    return mutations.changed_yaml(content.decode(), random).encode("utf-8", "replace")


def _npz(content: bytes, random: np.random.Generator) -> bytes:
    kind = random.integers(5)
    if kind == 0:
        return mutations.damaged(content, random)
    change = mutations.read_otherwise if kind == 1 else mutations.changed_npz
    return change(content, random)


def _sealed(content: bytes, random: np.random.Generator) -> bytes:
    """An answer that is sealed as ours are, but says something else."""
    if random.integers(4) == 0:
        return mutations.damaged(content, random)
    data = zlib.compress(json.dumps(mutations.changed(ANSWER, random)).encode("utf-8", "replace"))
    return f"{hashlib.sha256(data).hexdigest()}\n{base64.b64encode(data).decode()}\n".encode()


def _campaign(arguments: Sequence[str]) -> int:
    campaign = load_campaign(arguments[0])
    return 0 if campaign.runs and campaign.columns else 1


KINDS = {
    "scenario": Kind(
        ("arm.scenario.yaml", "arm.scenario.yaml", "biped.scenario.yaml", "walk.scenario.yaml"),
        _yaml,
        (("simulate", "{}.scenario.yaml", *OPTIONS),),
        weight=3.0,
    ),
    "override": Kind(
        ("arm.scenario.yaml",),
        lambda content, _: content,
        (("simulate", "arm.scenario.yaml", "--set", "OVERRIDE", *OPTIONS),),
    ),
    "description": Kind(("arm.yaml",), _yaml, (("simulate", "arm.scenario.yaml", *OPTIONS),)),
    "urdf": Kind(
        ("arm.urdf",),
        mutations.damaged_text,
        (("simulate", "arm.scenario.yaml", *OPTIONS),),
    ),
    "campaign": Kind(("campaign.yaml",), _yaml, (("campaign.yaml",),), run=_campaign),
    "map": Kind(
        ("recorded.map.yaml",),
        _yaml,
        (("convert", "t.csv", "out/log.npz", "--map", "recorded.map.yaml", "--quiet"),),
        weight=2.0,
    ),
    "recording": Kind(
        ("t.csv",),
        mutations.damaged_text,
        (("convert", "t.csv", "out/log.npz", "--map", "recorded.map.yaml", "--quiet"),),
    ),
    "diagnosis": Kind(
        ("diagnosis.json",),
        _json,
        (
            ("add", "arm.scenario.yaml", "diagnosis.json", "--out", "out/new.yaml"),
            ("add", "arm.scenario.yaml", ".", "--effect", "CoulombFriction", "--out", "out/n.yaml"),
        ),
        weight=3.0,
    ),
    "study": Kind(("study.json",), _json, (("reveal", "."),)),
    "seal": Kind(("answer.sealed",), _sealed, (("reveal", "."),), weight=2.0),
    "log": Kind(
        ("arm.npz",),
        _npz,
        (
            ("convert", "arm.npz", "out/log.csv"),
            ("convert", "arm.npz", "out/log.mcap"),
            ("compare", "arm.scenario.yaml", "arm.npz", *OPTIONS),
            ("identify", "arm.scenario.yaml", "arm.npz", *OPTIONS),
        ),
        weight=3.0,
    ),
    "legged log": Kind(
        ("biped.npz",),
        _npz,
        (
            ("convert", "biped.npz", "out/log.mcap"),
            ("estimate", "biped.scenario.yaml", "biped.npz", *OPTIONS),
            ("compare", "biped.scenario.yaml", "biped.npz", *OPTIONS),
        ),
        weight=2.0,
    ),
    "studied log": Kind(
        ("arm.npz",),
        _npz,
        (("study", "arm.scenario.yaml", "arm.npz", "--time-limit", "2", *OPTIONS),),
        weight=0.1,
    ),
}
