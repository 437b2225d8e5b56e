"""A real servo that swings a pendulum: from the motor's constants alone to the friction that it
has, and simulated against its records."""

import os
from pathlib import Path

import numpy as np
import pytest

from fbse_drake import Log, Scenario, load_scenario
from fbse_drake.discrepancy.diagnosis.add import add
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import model_error
from fbse_drake.discrepancy.residual.rollout import RolloutError, rollout
from fbse_drake.interop.convert import convert
from fbse_drake.interop.mapping import load_map

DATA = Path(os.environ.get("FBSE_DATA_DIR", "")) / "bam_xl330" / "raw"
pytestmark = pytest.mark.skipif(
    "FBSE_DATA_DIR" not in os.environ or not DATA.is_dir(),
    reason="needs the recordings bam_xl330 in the folder that FBSE_DATA_DIR names",
)


def records(*gains: int) -> Log:
    """The records that were made with these gains of the firmware."""
    files = [
        path
        for path in sorted(DATA.glob("*.json"))
        if any(f'"kp": {gain},' in path.read_text()[:200] for gain in gains)
    ]
    return convert(files, load_map("real/xl330"))


@pytest.fixture(scope="module")
def train() -> Log:
    return records(100, 400)


@pytest.fixture(scope="module")
def believed() -> Scenario:
    return load_scenario("real/xl330")


@pytest.fixture(scope="module")
def diagnosis(train: Log, believed: Scenario) -> Diagnosis:
    return diagnose(Predictor(believed, train))


@pytest.fixture(scope="module")
def found(diagnosis: Diagnosis, believed: Scenario) -> Scenario:
    return add(believed, diagnosis.completing)


def mean_error(error: RolloutError | None) -> float:
    assert error is not None
    assert error.failure is None
    return error.mean_absolute_position["servo"]


def test_the_firmware_commands_what_the_model_of_it_says(train: Log, believed: Scenario):
    """Duty cycle over position error, in every record: the recorded command is the position
    loop's."""
    for segment in train.meta["segments"]:
        rows = (
            (train.time >= segment["start"])
            & (train.time <= segment["end"])
            & (train["joint/enabled"][:, 0] > 0)
        )
        error = (train["reference/joint/position"] - train["joint/position"])[rows, 0]
        command, limit = (
            train["joint/torque_command"][rows, 0],
            believed.control.torque_limit["servo"],
        )
        expected = np.clip(segment["kp"] * believed.control.kp["servo"] * error, -limit, limit)
        assert np.linalg.norm(command - expected) < 0.05 * np.linalg.norm(expected)


def test_friction_that_grows_with_the_load_is_found(diagnosis: Diagnosis):
    chosen = {finding.effect: finding for finding in diagnosis.chosen}
    assert set(chosen) >= {"LoadDependentFriction", "ReflectedInertia"}
    # That torque rolls off takes less than what nobody explains.
    assert "TorqueRollOff" in {finding.effect for finding in diagnosis.completing}
    assert len(chosen) <= 4
    low, high = chosen["LoadDependentFriction"].parameters["coefficient"].interval
    assert 0.25 < low < high < 0.6
    # What the published models say of the rotor: 0.0016 to 0.0021 kg m^2.
    assert 0.0012 < chosen["ReflectedInertia"].parameters["inertia"].value < 0.0025


def test_the_torque_is_explained_on_records_that_were_not_fitted(
    train: Log, believed: Scenario, found: Scenario
):
    test = records(200, 800)
    for log in (train, test):
        before, after = (model_error(Predictor(model, log)).relative for model in (believed, found))
        assert before > 0.4
        assert after < 0.15


def test_the_simulated_servo_comes_near_its_records(believed: Scenario, found: Scenario):
    """One record: the fast one at a gain of 100."""
    log = convert([DATA / "2026-01-15_10h28m32.json"], load_map("real/xl330"))
    before, after = (mean_error(rollout(model, log)) for model in (believed, found))
    assert before > 0.08
    assert after < 0.03
