"""What explains a log and raises the error of data set aside is not named
(fbse_drake/discrepancy/diagnosis/confirmation.py)."""

import json
from functools import cache

import numpy as np
import pytest
from conftest import pendulum

from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.confirmation import diagnose_confirmed
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnosis_json
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import library
from fbse_drake.report.sentences import diagnosis_outcome
from fbse_drake.scenario import RecordingConfig

G, MASS, ARM, INERTIA, PERIOD, NOISE = 9.81, 2.0, 0.3, 0.25, 0.005, 0.02
COULOMB, STIFFNESS = 0.8, 0.5
EFFECTS = ("CoulombFriction", "ViscousFriction", "JointSpring", "TorqueBias")


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    """A pendulum that is believed to swing without friction and spring."""
    believed = pendulum(tmp_path_factory.mktemp("pendulum"), MASS, ARM, INERTIA)
    recording = RecordingConfig(rows="instantaneous", block=0.05, torque_noise={"all": NOISE})
    return Scenario(robot=believed, model=believed, recording=recording)


@cache
def log(*, spring: bool, seed: int, duration: float = 20.0, noise: float = NOISE) -> Log:
    """In closed form, with Coulomb friction."""
    t = np.arange(round(duration / PERIOD)) * PERIOD
    sizes, speeds = np.array([0.9, 0.4]), np.array([2.1 + 0.3 * seed, 5.3])
    q, v, a = (
        (sizes * speeds**k * np.sin(np.outer(t, speeds) + seed + k * np.pi / 2)).sum(axis=1)
        for k in range(3)
    )
    tau = INERTIA * a + MASS * ARM * G * np.sin(q) + COULOMB * np.tanh(v / 0.01)
    tau += spring * STIFFNESS * q + noise * np.random.default_rng(seed).standard_normal(len(t))
    channels = {"position": q, "velocity": v, "torque_command": tau}
    return Log(
        {"time": t} | {f"joint/{name}": values[:, None] for name, values in channels.items()},
        {"joints": ["pivot"], "sides": [], "period": PERIOD, "source": "closed form"},
    )


def found(scenario: Scenario, test: Log) -> Diagnosis:
    predictor = Predictor(scenario, log(spring=True, seed=1))
    return diagnose_confirmed(
        predictor,
        [library()[name] for name in EFFECTS],
        {"test": Predictor(predictor.scenario, test)},
    )


def test_what_raises_the_error_of_data_set_aside_is_not_named(scenario: Scenario) -> None:
    """A spring that only one log has."""
    diagnosis = found(scenario, log(spring=False, seed=2))
    assert [f.effect for f in diagnosis.refuted] == ["JointSpring"]
    assert "CoulombFriction" in {f.effect for f in diagnosis.chosen}
    assert "JointSpring" not in {f.effect for f in diagnosis.ranking}
    assert diagnosis.effects["JointSpring"].verdict == "absent"
    text = "Joint spring in pivot would explain more of the log, but raises the error of data that"
    assert text in diagnosis_outcome(diagnosis)
    content = json.loads(json.dumps(diagnosis_json(diagnosis)))
    assert content["refuted"] == [{"effect": "JointSpring", "joints": ["pivot"]}]


def test_what_data_set_aside_bears_out_is_named(scenario: Scenario) -> None:
    diagnosis = found(scenario, log(spring=True, seed=2))
    values = {f.effect: f.parameters for f in diagnosis.chosen}
    assert values.keys() == {"CoulombFriction", "JointSpring"}
    assert values["CoulombFriction"]["coulomb"].value == pytest.approx(COULOMB, rel=0.02)
    assert values["JointSpring"]["stiffness"].value == pytest.approx(STIFFNESS, rel=0.05)
    assert not diagnosis.refuted


def test_data_too_short_to_tell_refutes_nothing(scenario: Scenario) -> None:
    """Of torques with as much noise as the spring has torque."""
    loud = 20 * NOISE
    diagnosis = found(scenario, log(spring=False, seed=4, duration=1.05, noise=loud))
    assert not diagnosis.refuted
    assert "JointSpring" in {f.effect for f in diagnosis.chosen}
    longer = found(scenario, log(spring=False, seed=4, noise=loud))
    assert [f.effect for f in longer.refuted] == ["JointSpring"]
