"""The benchmark of recordings that are drawn (benchmarks/recordings.py): what is recorded is what
is said to be, and outcomes are judged as they should be."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import recordings
from benchmarks.recorded.cases import Recording, outcome, record
from benchmarks.recorded.course import Course, inverse_dynamics
from benchmarks.recorded.machine import random_machine
from benchmarks.recorded.physics import Hidden, random_physics
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose, diagnosis_json
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.robot.plant import make_robot


def test_a_number_is_a_recording(tmp_path: Path) -> None:
    both = []
    for folder in ("one", "other"):
        (tmp_path / folder).mkdir()
        both.append(record(5, tmp_path / folder))
    one, other = both
    assert one.machine == other.machine
    assert one.recorder == other.recorder
    for name, values in one.log.channels.items():
        np.testing.assert_array_equal(values, other.log[name])


def test_heavier_links_weigh_what_they_have_more(tmp_path: Path) -> None:
    """At rest the first joint of a machine carries the moments of all links behind it: by a mass
    at its link's centre, found here by the change of the potential energy."""
    machine = random_machine(np.random.default_rng(4))
    last, more = len(machine.links) - 1, 0.7
    posture = np.array([machine.posture])
    still = np.zeros_like(posture)
    torques, energies = [], []
    for k, mass in enumerate((machine.links[last].mass, machine.links[last].mass + more)):
        folder = tmp_path / str(k)
        folder.mkdir()
        robot = machine.with_link(last, mass=mass).robot(folder)
        torques.append(inverse_dynamics(robot, posture, still, still)[0])

        def energy(q: np.ndarray, folder: Path = folder) -> float:
            plant = make_robot(folder / "machine.yaml")[0].plant
            context = plant.CreateDefaultContext()
            plant.SetPositions(context, q)
            return float(plant.CalcPotentialEnergy(context))

        step = 1e-6 * np.eye(len(machine.joints))
        energies.append([(energy(posture[0] + d) - energy(posture[0] - d)) / 2e-6 for d in step])
    np.testing.assert_allclose(torques, energies, atol=1e-6)
    assert np.abs(torques[1] - torques[0]).max() > 1e-3


def diagnosis(verdict: str, *named: tuple[str, list[str], list[str]]) -> dict:
    findings = [
        {
            "effect": effect,
            "joints": joints,
            "confusable_with": alike,
            "chosen": True,
            "too_small": False,
        }
        for effect, joints, alike in named
    ]
    shown = {"smallest_detectable_by_target": {"joint_1": 0.1, "joint_2": 0.1}}
    effects = dict.fromkeys(("TorqueBias", "QuadraticDrag"), shown)
    return {"verdict": verdict, "ranking": findings, "effects": effects}


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (diagnosis("effect_found", ("TorqueBias", ["joint_1"], [])), "right"),
        (diagnosis("effect_found", ("JointSpring", ["joint_1"], ["TorqueBias"])), "right"),
        (diagnosis("effect_found", ("TorqueBias", ["joint_2"], [])), "wrong"),
        (diagnosis("effect_found", ("TorqueBias", ["joint_1", "joint_2"], [])), "wrong"),
        (diagnosis("effect_found", ("QuadraticDrag", ["joint_1"], [])), "wrong"),
        (diagnosis("unknown_effect", ("QuadraticDrag", ["joint_1"], [])), "unsure"),
        (diagnosis("unknown_effect", ("TorqueBias", ["joint_1"], [])), "unsure"),
        (diagnosis("nothing_missing"), "missed"),
    ],
)
def test_outcomes(tmp_path: Path, said: dict, expected: str) -> None:
    drawn = record(5, tmp_path)
    hidden = (Hidden(("TorqueBias",), ("joint_1",)),)
    punctual = type(drawn.recorder)(**{**vars(drawn.recorder), "late": 0.0})
    one = Recording(drawn.machine, punctual, hidden, drawn.scenario, drawn.log)
    assert outcome(one, said) == expected


def test_what_a_link_has_is_said_of_its_joint_and_the_other_way_round(tmp_path: Path) -> None:
    """About a vertical axis a centre of mass elsewhere is nothing but an inertia, as a rotor's;
    where a joint's zero is off, the weight of its link is elsewhere; and in a joint to which
    gravity has one direction only a mount that is askew may be a counterbalance."""
    drawn = record(5, tmp_path)
    for has, at, named, target, confusable, expected in (
        ("BodyCentreOfMass", "link_1", "ReflectedInertia", "joint_1", "BodyCentreOfMass", "right"),
        ("BodyCentreOfMass", "link_1", "ReflectedInertia", "joint_2", "BodyCentreOfMass", "wrong"),
        ("BodyCentreOfMass", "link_1", "ReflectedInertia", "joint_1", "BodyMass", "wrong"),
        ("EncoderOffset", "joint_2", "BodyCentreOfMass", "link_2", "EncoderOffset", "right"),
        ("EncoderOffset", "joint_2", "BodyCentreOfMass", "link_1", "EncoderOffset", "wrong"),
        ("EncoderOffset", "joint_2", "BodyCentreOfMass", "link_2", "JointSpring", "wrong"),
        ("BaseTilt", "robot", "Counterbalance", "joint_2", "BaseTilt", "right"),
        ("BaseTilt", "robot", "Counterbalance", "joint_2", "JointSpring", "wrong"),
        ("TorqueBias", "joint_1", "JointSpring", "joint_2", "TorqueBias", "wrong"),
    ):
        hidden = (Hidden((has,), (at,)),)
        one = Recording(drawn.machine, drawn.recorder, hidden, drawn.scenario, drawn.log)
        said = diagnosis("effect_found", (named, [target], [confusable]))
        assert outcome(one, said) == expected


@pytest.mark.parametrize(("place", "expected"), [("joint_2", "right"), ("joint_3", "wrong")])
def test_what_is_declared_confusable_may_be_elsewhere(
    tmp_path: Path, place: str, expected: str
) -> None:
    """Where a joint's zero is off, the next link weighs elsewhere as well."""
    drawn = record(5, tmp_path)
    hidden = (Hidden(("EncoderOffset",), ("joint_2",)),)
    one = Recording(drawn.machine, drawn.recorder, hidden, drawn.scenario, drawn.log)
    said = diagnosis("effect_found", ("BodyCentreOfMass", ["link_3"], ["EncoderOffset"]))
    rival = {**said["ranking"][0], "effect": "EncoderOffset", "joints": [place], "chosen": False}
    assert outcome(one, said | {"ranking": [*said["ranking"], rival]}) == expected


def test_what_does_not_show_is_not_missed(tmp_path: Path) -> None:
    """What would show in sizes of 0.1 in two joints does not in others, nor if it is smaller."""
    drawn = record(5, tmp_path)
    for joint, size, expected in (
        ("joint_3", 1.0, "right"),
        ("joint_1", 0.09, "right"),
        ("joint_1", 0.11, "missed"),
    ):
        hidden = (Hidden(("TorqueBias",), (joint,), (size,)),)
        one = Recording(drawn.machine, drawn.recorder, hidden, drawn.scenario, drawn.log)
        assert outcome(one, diagnosis("nothing_missing")) == expected


def test_a_loss_is_as_large_as_it_is_said_to_be() -> None:
    """At unit velocities, accelerations and torques a law is its first amount."""
    random = np.random.default_rng(4)
    machine = random_machine(random)
    known = Course(np.arange(50.0), *random.normal(size=(4, 50, len(machine.joints))))
    still = np.zeros((3, len(machine.joints)))
    unit = Course(np.arange(3.0), still, still + 1.0, still + 1.0, still + 1.0)
    laws = {"CoulombFriction", "ViscousFriction", "QuadraticDrag"}
    laws |= {"ReflectedInertia", "TorqueBias", "LoadDependentFriction"}
    met = set()
    for hidden in (h for _ in range(100) for h in random_physics(random, machine, known)):
        name = hidden.names[0]
        if name in laws and len(hidden.targets) == 1:
            met.add(name)
            assert np.abs(hidden.loss(unit)).max() == pytest.approx(hidden.sizes[0]), name
        if name == "TorqueGain":
            wrong = np.abs(1.0 / hidden.told(np.ones(len(machine.joints))) - 1.0)
            assert wrong.max() == pytest.approx(hidden.sizes[0])
    assert met == laws


@pytest.mark.parametrize("number", [10, 17, 232, 4045, 6004, 6029, 17013, 17034, 20036, 7331, 7405])
def test_what_was_wrong_once(tmp_path: Path, number: int) -> None:
    """Nothing hidden, and angles alone that nobody tells the noise of; filtered velocities whose
    torques have the noise that is told; the same where nobody tells it; a centre of mass of which
    only the moment about one axis shows; a drag in one joint of two; friction that follows the load
    of a link that is too light in the model, by torques in coarse steps; two joints that stick more
    than they slide, by other humps than the library's; a mount that is askew about an axis that
    shows; a bias beside friction that would be negative without it; and a mass on a slide."""
    drawn = record(number, tmp_path)
    found = diagnose(Predictor(drawn.scenario, drawn.log))
    assert outcome(drawn, diagnosis_json(found)) == "right"


def test_what_would_fit_but_cannot_be_is_not_tried(tmp_path: Path) -> None:
    """A wrong gain and a centre of mass elsewhere look, linearised, like a mount that is turned by
    more than half a turn."""
    drawn = record(17051, tmp_path)
    found = diagnose(Predictor(drawn.scenario, drawn.log))
    assert outcome(drawn, diagnosis_json(found)) in ("right", "unsure")


def test_a_line_says_what_went_wrong() -> None:
    tree = {
        "case": {"number": 7},
        "outcome": "wrong",
        "recorder": "100 Hz, nothing told",
        "hidden": [{"names": ["TorqueBias", "JointSpring"], "targets": ["joint_1"]}],
        "diagnoses": [
            diagnosis("effect_found", ("TorqueGain", ["joint_1"], [])) | {"unexplained": []}
        ],
    }
    assert recordings.text(tree) == (
        "recording-7, wrong (100 Hz, nothing told): TorqueBias (joint_1) -> effect_found: "
        "TorqueGain (joint_1); unexplained: nothing"
    )
