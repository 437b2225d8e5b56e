"""The walk of a real iCub: no joint torques, so that only the six rows of the base and the standing
soles say something."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import model_error, study
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene, inspect
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.discrepancy.residual.evidence import Evidence
from fbse_drake.discrepancy.residual.residual import rms
from fbse_drake.effects.inertia import BodyMass
from fbse_drake.effects.sensor import FootForceGain, FootForceLag, FootForceMisalignment
from fbse_drake.errors import InputError
from fbse_drake.estimation import EstimationResult, estimate
from fbse_drake.interop.convert import read_log
from fbse_drake.log import Log
from fbse_drake.resources import folder
from fbse_drake.scenario import Scenario, load_scenario

DATA = os.environ.get("FBSE_DATA_DIR", "")
RECORD = Path(DATA) / "icub_walking" / "sync-walkingFrontAndBackGoodTrial.mat"
pytestmark = pytest.mark.skipif(
    not (DATA and RECORD.is_file()), reason="FBSE_DATA_DIR does not name a folder with icub_walking"
)
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
    found = model_error(
        Predictor(everything, read_log(RECORD, str(folder("scenarios") / "real" / "icub.map.yaml")))
    ).rms
    expected = {
        "base/force_x": 33.4,
        "base/force_y": 24.1,
        "base/force_z": 12.9,
        "base/moment_x": 14.3,
        "base/moment_y": 20.5,
    }
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
    assert {f.kind for f in hygiene.findings if f.severity == "untrustworthy"} == {
        "force_against_motion"
    }


def test_what_the_scenario_rules_out_is_ruled_out_by_the_record(
    scenario: Scenario, log: Log, hygiene: Hygiene
) -> None:
    evidence = Evidence(Predictor(scenario, log).motion)
    # No offset of the forces: nothing is read in the air.
    assert not [f for f in hygiene.findings if f.kind == "air_reading"]
    # No fault of the accelerometer: the record begins with a robot that stands still.
    still = log["imu/linear_acceleration"][:300]
    assert np.linalg.norm(still.mean(axis=0)) == pytest.approx(
        evidence.motion.equation.gravity, rel=3e-3
    )
    # By IMU and angles both soles stand level.
    whole = Predictor(load_scenario("real/icub", overrides=["recording.unused_rows=[]"]), log)
    rows = whole.residual.row_index
    for side in ("left", "right"):
        for axis in "xy":
            row = rows[f"{side}_sole/specific_force_{axis}"]
            tilt = (
                whole.residual.value[whole.residual.known[:, row], row].mean()
                / evidence.motion.equation.gravity
            )
            assert abs(tilt) < 0.01


def test_study_closes_the_vertical_row_and_keeps_what_cannot_be_told_apart(
    scenario: Scenario, log: Log
) -> None:
    effects = [FootForceMisalignment, FootForceGain, FootForceLag, BodyMass]
    result = study(scenario, log, effects, rollouts=False)
    found = {(f.effect, f.targets[0]): f for f in result.found}
    assert set(found) >= {
        ("FootForceMisalignment", "left"),
        ("FootForceMisalignment", "right"),
        ("FootForceGain", "right"),
    }
    for side in ("left", "right"):
        assert 0.06 < found["FootForceMisalignment", side].parameters["y"].value < 0.12
    before, after = (result.steps[k].errors["train"].rms for k in (0, -1))
    assert before["base/force_z"] > 12
    assert after["base/force_z"] < 5
    assert after["base/force_x"] < 5
    assert after["base/moment_y"] < 3
    # A gain, or a mass: named as what this record cannot tell apart.
    assert any("BodyMass" in f.confusable_with for f in result.diagnoses[0].chosen)
    # With a mass in its place the larger of the two gains leaves nearly as little, too.
    masses = [
        f for f in result.diagnoses[0].ranking if f.effect == "BodyMass" and f.held_out_before > 0.7
    ]
    assert all(
        1.0 < f.parameters["mass"].value < 2.0
        and f.held_out_after < 1.1 * found["FootForceGain", "right"].held_out_after
        for f in masses
    )


def test_half_of_the_record_foretells_the_other_half(scenario: Scenario, log: Log) -> None:
    """Nothing was fitted to the rest."""
    middle = len(log.time) // 2
    result = study(
        scenario, log.part(slice(0, middle)), [FootForceMisalignment, FootForceGain], rollouts=False
    )
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
        Predictor(
            load_scenario("real/icub", overrides=["recording.unused_rows=[base/force_w]"]), log
        )
    residual = Predictor(scenario, log).residual
    assert np.isnan(rms(residual.value, residual.known)[residual.row_index["base/force_y"]])


@pytest.fixture(scope="module")
def estimated(scenario: Scenario, log: Log) -> EstimationResult:
    return estimate(scenario, log)


def own_pose_is_fresh(log: Log) -> np.ndarray:
    """Rows in which the recording's own pose is neither held for more than 40 ms nor about to jump,
    (N,) bool.

    Eight times it stands still for a quarter of a second while the gyro shows a turning base.
    """
    angles = Rotation.from_quat(log["recorded/base/orientation"], scalar_first=True)
    step = np.r_[0.0, (angles[:-1].inv() * angles[1:]).magnitude()]
    held = np.cumsum(step > 0)
    near_jump = np.convolve(step > np.deg2rad(2), np.ones(9), "same") > 0
    return (np.bincount(held)[held] <= 4) & ~near_jump


def yaw(orientation: Rotation) -> np.ndarray:
    R = orientation.as_matrix()
    return np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))


def tilt_between(one: Rotation, other: Rotation) -> np.ndarray:
    """Angle between the verticals of two attitudes, (N,) [rad]."""
    up, other_up = (rotation.inv().apply([0, 0, 1]) for rotation in (one, other))
    return np.arccos(np.clip((up * other_up).sum(axis=1), -1, 1))


def test_base_pose_is_the_recordings_own(estimated: EstimationResult) -> None:
    """The own pose is off by 0.9 deg from the robot's own attitude sensor; while it stands by 0.4
    to 1.1 deg from the accelerometer. So nobody can be much nearer to it."""
    log = estimated.log
    found, own = (
        Rotation.from_quat(log[f"{source}/base/orientation"], scalar_first=True)
        for source in ("estimate", "recorded")
    )
    tilt, fresh = np.rad2deg(tilt_between(found, own)), own_pose_is_fresh(log)
    assert fresh.mean() > 0.95
    assert np.sqrt(np.mean(tilt[fresh] ** 2)) < 0.7
    # Yaw is that of the start.
    drift = np.rad2deg(yaw(found) - yaw(own))
    assert np.abs(drift - drift[:100].mean())[fresh].max() < 3.0


@pytest.mark.parametrize("start", [1300, 2300, 4300, 6300])
def test_an_estimate_may_begin_in_mid_walk(
    scenario: Scenario, log: Log, estimated: EstimationResult, start: int
) -> None:
    """It agrees with the one that began at rest, within what both state, and within 0.3 deg after
    ten seconds: what a foot that gives does in one stance is not taken for the gyro's bias."""
    rows = slice(start, start + 1200)
    part = estimate(scenario, log.part(rows)).log
    names = "estimate/base/orientation", "estimate/base/attitude_std"
    (own, own_std), (whole, whole_std) = (
        [found[name] for name in names]
        for found in (part, {name: estimated.log[name][rows] for name in names})
    )
    tilt = tilt_between(*(Rotation.from_quat(x, scalar_first=True) for x in (own, whole)))
    stated = np.hypot(own_std[:, :2].max(axis=1), whole_std[:, :2].max(axis=1))
    assert np.mean(tilt < 2.0 * stated) > 0.98
    assert np.rad2deg(tilt[-200:].max()) < 0.3


def test_at_rest_the_tilt_is_that_of_the_accelerometer(estimated: EstimationResult) -> None:
    """Stretches of some seconds in which the robot stands, long after the start."""
    log = estimated.log
    R_BI = Rotation.from_euler("xyz", [-2.09439521059, 0.0, -1.57079632679])
    found, own = (
        Rotation.from_quat(log[f"{source}/base/orientation"], scalar_first=True)
        for source in ("estimate", "recorded")
    )
    seconds = log.time - log.time[0]
    own_error = []
    for start, end in ((16, 20), (32, 37), (54, 60), (71, 75), (85, 88)):
        rows = np.flatnonzero((seconds >= start) & (seconds < end))
        up = R_BI.apply(log["imu/linear_acceleration"][rows].mean(axis=0))
        up /= np.linalg.norm(up)
        expected, own_up = (poses[rows].apply(up).mean(axis=0) for poses in (found, own))
        # What is left is believed to be the accelerometer's bias.
        assert np.rad2deg(np.hypot(*expected[:2])) < 0.55
        own_error.append(np.rad2deg(np.hypot(*own_up[:2])))
    # The recording's own pose is no better a truth than this.
    assert np.sqrt(np.mean(np.square(own_error))) > 0.6


def test_no_joint_is_stuck(estimated: EstimationResult) -> None:
    status = estimated.log["estimate/sensors/status"]
    assert (status[:, :2] == 0).all()
    assert (status[:, 2:] > 0).mean() < 0.01


def test_friction_is_not_known_without_torques(estimated: EstimationResult) -> None:
    log = estimated.log
    assert not [name for name in log if "friction" in name or "link_torque" in name]
    for name in ("base/velocity", "base/position", "imu/angular_velocity_bias", "support", "zmp"):
        assert np.isfinite(log[f"estimate/{name}"]).all()
    believed, unknown = estimated.remarks
    assert "gyro 0.007 rad/s" in believed
    assert unknown == "The friction is not known: the log has no joint/torque_command."


def test_friction_comes_with_torques(scenario: Scenario, log: Log) -> None:
    short = log.part(slice(0, 300))
    zeros = np.zeros_like(short["joint/position"])
    with_torques = Log({**short.channels, "joint/torque_command": zeros}, short.meta)
    result = estimate(scenario, with_torques)
    # In the recording the feet do carry more than the model weighs, whatever its torques are.
    _, carried = result.remarks
    told = re.match(r"The feet carry (.*) % more than the model weighs", carried)
    assert told
    assert 1.0 < float(told[1]) < 3.5
    torque = result.log["estimate/joint/friction_torque"]
    assert torque.shape == (300, 26)
    assert np.isfinite(torque).all()


@pytest.mark.parametrize("quarter", [1, 3])
def test_a_quarter_of_the_record_tells_what_all_of_it_does(
    scenario: Scenario, log: Log, quarter: int
) -> None:
    """With the whole library. How a foot's sensor is turned about its vertical hardly shows in a
    third of a minute; no more does a payload far from the robot, in its place."""
    length = len(log.time) // 4
    part = log.part(slice(quarter * length, (quarter + 1) * length))
    diagnosis = diagnose(Predictor(scenario, part))
    found = {(f.effect, *f.targets): f for f in diagnosis.chosen}
    assert {"Payload"}.isdisjoint(effect for effect, *_ in found)
    for side in ("left", "right"):
        estimate = found["FootForceMisalignment", side].parameters["y"]
        assert 0.06 < estimate.value < 0.13
        assert estimate.interval[0] > 0
