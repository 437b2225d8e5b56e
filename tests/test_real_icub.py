"""The walk of a real iCub: no joint torques, so that only the six rows of the base and the standing soles say something."""

import os
from pathlib import Path

import numpy as np
import pytest

from fbse_drake.discrepancy.diagnose import diagnose
from fbse_drake.discrepancy.evidence import Evidence
from fbse_drake.discrepancy.hygiene import Hygiene, inspect
from fbse_drake.discrepancy.prediction import Predictor
from fbse_drake.discrepancy.residual import rms
from fbse_drake.discrepancy.sanity import check_sensors
from fbse_drake.discrepancy.study import model_error, study
from fbse_drake.effects.inertia import BodyMass
from fbse_drake.effects.sensor import FootForceGain, FootForceLag, FootForceMisalignment
from fbse_drake.errors import InputError
from fbse_drake.interop.convert import read_log
from fbse_drake.log import Log
from fbse_drake.resources import folder
from fbse_drake.scenario import Scenario, load_scenario

DATA = os.environ.get("FBSE_DATA_DIR", "")
RECORD = Path(DATA) / "icub_walking" / "sync-walkingFrontAndBackGoodTrial.mat"
pytestmark = pytest.mark.skipif(not (DATA and RECORD.is_file()), reason="FBSE_DATA_DIR does not name a folder with icub_walking")
SAGITTAL = ("base/moment_y", "base/force_x", "base/force_z")


@pytest.fixture(scope="module")
def log() -> Log:
    return read_log(RECORD, str(folder("scenarios") / "real" / "icub.map.yaml"))


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("real/icub")


@pytest.fixture(scope="module")
def hygiene(scenario: Scenario, log: Log) -> Hygiene:
    return inspect(Predictor(scenario, log).motion)


def test_nothing_is_said_of_joints_whose_torque_nobody_knows(scenario: Scenario, log: Log) -> None:
    predictor = Predictor(scenario, log)
    check_sensors(predictor.motion)
    assert "joint/torque_command" not in log
    joints = [row.kind == "joint" for row in predictor.residual.rows]
    assert sum(joints) == 26
    assert not predictor.residual.known[:, joints].any()


def test_rows_of_the_base_as_the_urdf_leaves_them() -> None:
    """What the data set is known for: 12 N in the vertical row; the others do not close either."""
    everything = load_scenario("real/icub", overrides=["recording.unused_rows=[]"])
    found = model_error(Predictor(everything, read_log(RECORD, str(folder("scenarios") / "real" / "icub.map.yaml")))).rms
    expected = {"base/force_x": 33.4, "base/force_y": 24.1, "base/force_z": 12.9, "base/moment_x": 14.3, "base/moment_y": 20.5}
    for row, value in expected.items():
        assert found[row] == pytest.approx(value, rel=0.05), row


def test_hygiene_names_what_is_calibration(hygiene: Hygiene) -> None:
    found = {(f.kind, f.channel): f for f in hygiene.findings}
    # The sideways force moves the wrong way in both feet: nothing that it enters can close.
    for side in ("left", "right"):
        against = found["force_against_motion", f"foot/{side}"]
        assert (against.severity, against.where) == ("untrustworthy", ("force_y",))
        # Both sensors lean forwards by some 6 degrees although the soles stand level.
        lean = found["force_frame", f"foot/{side}"]
        assert "force_x" in lean.where
        assert "stands level" in lean.text
        assert 0.08 < abs(lean.size) < 0.13
    # A low-pass of the forces before they were recorded.
    assert 0.03 < found["low_pass", "foot/<side>"].size < 0.07
    weight = found["weight", "foot/<side>"]
    assert weight.size == pytest.approx(10.5, abs=1.0)
    assert "no motion tells them apart" in weight.text
    assert {f.kind for f in hygiene.findings if f.severity == "untrustworthy"} == {"force_against_motion"}


def test_what_the_scenario_rules_out_is_ruled_out_by_the_record(scenario: Scenario, log: Log, hygiene: Hygiene) -> None:
    evidence = Evidence(Predictor(scenario, log).motion)
    # No offset of the forces: nothing is read in the air.
    assert not [f for f in hygiene.findings if f.kind == "air_reading"]
    # No fault of the accelerometer: the record begins with a robot that stands still.
    still = log["imu/linear_acceleration"][:300]
    assert np.linalg.norm(still.mean(axis=0)) == pytest.approx(evidence.motion.equation.gravity, rel=3e-3)
    # By IMU and angles both soles stand level.
    whole = Predictor(load_scenario("real/icub", overrides=["recording.unused_rows=[]"]), log)
    rows = whole.residual.row_index
    for side in ("left", "right"):
        for axis in "xy":
            row = rows[f"{side}_sole/specific_force_{axis}"]
            tilt = whole.residual.value[whole.residual.known[:, row], row].mean() / evidence.motion.equation.gravity
            assert abs(tilt) < 0.01


def test_study_closes_the_vertical_row_and_keeps_what_cannot_be_told_apart(scenario: Scenario, log: Log) -> None:
    effects = [FootForceMisalignment, FootForceGain, FootForceLag, BodyMass]
    result = study(scenario, log, effects, rollouts=False)
    found = {(f.effect, f.targets[0]): f for f in result.found}
    assert set(found) >= {("FootForceMisalignment", "left"), ("FootForceMisalignment", "right"), ("FootForceGain", "right")}
    for side in ("left", "right"):
        assert 0.06 < found["FootForceMisalignment", side].parameters["y"].value < 0.12
    before, after = (result.steps[k].errors["train"].rms for k in (0, -1))
    assert before["base/force_z"] > 12
    assert after["base/force_z"] < 5
    assert after["base/force_x"] < 5
    assert after["base/moment_y"] < 3
    # Gains of both feet, or a mass: named as what this record cannot tell apart.
    assert ("FootForceGain", "left") in found
    assert any("BodyMass" in f.confusable_with for f in result.diagnoses[0].chosen)
    # With a mass in its place the larger of the two gains leaves nearly as little, too.
    masses = [f for f in result.diagnoses[0].ranking if f.effect == "BodyMass" and f.held_out_before > 0.7]
    assert all(
        1.0 < f.parameters["mass"].value < 2.0 and f.held_out_after < 1.1 * found["FootForceGain", "right"].held_out_after for f in masses
    )


def test_half_of_the_record_foretells_the_other_half(scenario: Scenario, log: Log) -> None:
    """Nothing was fitted to the rest."""
    middle = len(log.time) // 2
    result = study(scenario, log.part(slice(0, middle)), [FootForceMisalignment, FootForceGain], rollouts=False)
    rest = log.part(slice(middle, None))
    before, after = (model_error(Predictor(s, rest)).rms for s in (scenario, result.scenario))
    for row in SAGITTAL:
        assert after[row] < 0.5 * before[row], row
    assert after["base/force_z"] < 6


def test_without_torques_the_scale_is_never_explained_away(scenario: Scenario, log: Log) -> None:
    """Lighter bodies and deafer feet together would explain everything."""
    diagnosis = diagnose(Predictor(scenario, log), [FootForceGain, BodyMass])
    gains = {f.targets[0] for f in diagnosis.chosen if f.effect == "FootForceGain"}
    masses = [f for f in diagnosis.chosen if f.effect == "BodyMass"]
    assert not (gains == {"left", "right"} and masses)


def test_unknown_rows_and_effects_are_refused(scenario: Scenario, log: Log) -> None:
    with pytest.raises(InputError, match="ruled_out: FootForceBas: no such effect"):
        load_scenario("real/icub", overrides=["identify.ruled_out=[FootForceBas]"])
    with pytest.raises(InputError, match="unused_rows: base/force_w: there is no such row"):
        Predictor(load_scenario("real/icub", overrides=["recording.unused_rows=[base/force_w]"]), log)
    residual = Predictor(scenario, log).residual
    assert np.isnan(rms(residual.value, residual.known)[residual.row_index["base/force_y"]])
