"""A joint that no motor moves: its torque is known to be zero, and what it lacks is found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fbse_drake import Log, Scenario, load_description, simulate
from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.exercises.hidden import make_exercise
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.effects.actuation import TorqueGain
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.friction import CoulombFriction, LoadDependentFriction, ViscousFriction
from fbse_drake.errors import InputError
from fbse_drake.scenario import RecordingConfig, RobotConfig, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.walking.reference import JointSines

MODELS = Path(__file__).parent.parent / "models"
TRIED = ("CoulombFriction", "ViscousFriction", "LoadDependentFriction", "TorqueGain", "DcMotor")


@pytest.fixture(scope="module")
def description(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A double pendulum whose elbow nothing drives."""
    folder = tmp_path_factory.mktemp("passive")
    text = (MODELS / "double_pendulum.yaml").read_text() + "passive: [elbow]\n"
    (folder / "hanging.yaml").write_text(text)
    (folder / "double_pendulum.urdf").write_text((MODELS / "double_pendulum.urdf").read_text())
    return str(folder / "hanging.yaml")


def run(description: str, hidden: Effect | None = None) -> tuple[Scenario, Log]:
    """The shoulder swings, and the elbow as it likes."""
    scenario = Scenario(
        duration=6.0,
        robot=RobotConfig(description, effects={"hidden": hidden} if hidden else {}),
        model=RobotConfig(description),
        reference=JointSines(amplitude={"shoulder": 0.6}, frequency={"shoulder": 0.7}, ramp=0.5),
        control=PositionLoopConfig(kp={"all": 20.0}, kd={"all": 0.5}),
        sensors=SensorsConfig(encoders=EncoderConfig(velocity_noise=1e-3)),
        recording=RecordingConfig(torque_noise={"shoulder": 0.03, "elbow": 5.0}),
    )
    return scenario, simulate(scenario).log


def found(predictor: Predictor) -> Diagnosis:
    return diagnose(predictor, [library()[name] for name in TRIED])


def test_nothing_drives_it(description: str) -> None:
    _, log = run(description)
    command, angle = (log[f"joint/{name}"][:, 1] for name in ("torque_command", "position"))
    assert not command.any()
    assert np.std(angle) > 0.1


@pytest.mark.parametrize(
    "hidden",
    [CoulombFriction({"elbow": 0.02}), ViscousFriction({"elbow": 0.05})],
    ids=["coulomb", "viscous"],
)
def test_what_it_lacks_is_found(description: str, hidden: Effect) -> None:
    """A load that is nothing but the friction itself explains it as well, and a motor's law too:
    they are not tried where there is no motor."""
    predictor = Predictor(*run(description, hidden))
    assert "dead_torque" not in [
        f.kind for f in inspect(predictor.motion, predictor.noise).findings
    ]
    (finding,) = found(predictor).chosen
    assert (finding.effect, finding.targets) == (type(hidden).__name__, ("elbow",))
    name, values = next(iter(vars(hidden).items()))
    assert finding.parameters[name].value == pytest.approx(values["elbow"], rel=0.02)
    assert finding.confusable_with == ()


def test_what_the_motor_beside_it_lacks_is_found(description: str) -> None:
    (finding,) = found(Predictor(*run(description, TorqueGain({"shoulder": 0.1})))).chosen
    assert (finding.effect, finding.targets) == ("TorqueGain", ("shoulder",))
    assert finding.parameters["shortfall"].value == pytest.approx(0.1, abs=0.01)


def test_a_robot_without_a_fault_lacks_nothing(description: str) -> None:
    assert found(Predictor(*run(description))).verdict == "nothing_missing"


def test_laws_of_motors_are_tried_where_motors_are(description: str) -> None:
    predictor = Predictor(*run(description))
    groups = Dictionary(predictor, [CoulombFriction, LoadDependentFriction]).groups_of
    assert groups(CoulombFriction) == [("shoulder",), ("elbow",), ("shoulder", "elbow")]
    assert groups(LoadDependentFriction) == [("shoulder",)]


def test_what_a_log_says_of_its_torque_counts_for_nothing(description: str) -> None:
    scenario, log = run(description)
    random = np.random.default_rng(1)
    torque = log["joint/torque_command"] + [0.0, 1.0] * random.normal(size=(len(log.time), 2))
    read = Predictor(scenario, Log(log.channels | {"joint/torque_command": torque}, log.meta))
    assert not read.motion.signals.torque_command[:, 1].any()
    assert not read.motion.torque_variance(torque)[:, 1].any()


def test_a_joint_that_is_not_there_is_refused(tmp_path: Path) -> None:
    text = (MODELS / "double_pendulum.yaml").read_text() + "passive: [wrist]\n"
    (tmp_path / "robot.yaml").write_text(text)
    with pytest.raises(
        InputError, match=r"passive: unknown joint wrist \(allowed: shoulder, elbow"
    ):
        load_description(tmp_path / "robot.yaml")


def test_nothing_of_a_motor_is_hidden_in_it(description: str) -> None:
    scenario, _ = run(description)
    scenario = replace(scenario, duration=0.2)
    hidden = [
        effect
        for seed in range(6)
        for effect in make_exercise(scenario, "hanging", seed, what="library").answer.effects
    ]
    assert any(library()[effect.effect].needs_motor for effect in hidden)
    for effect in hidden:
        assert not (library()[effect.effect].needs_motor and "elbow" in effect.targets)
