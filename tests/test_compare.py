"""Comparison of a model with a log: failures with a known cause, intervals that hold, and silence
where there is only noise."""

import dataclasses
import json

import numpy as np
import pytest

from fbse_drake import load_scenario
from fbse_drake.discrepancy.diagnosis.compare import (
    Comparison,
    compare,
    compare_residual,
    comparison_json,
)
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.discrepancy.residual.rows import residual_rows
from fbse_drake.scenario import build_robot

BLOCKS, PERIOD = 1500, 0.01
NOISE = 0.2
ROBOT = build_robot(load_scenario("paper_walk").believed)
ROWS = residual_rows(ROBOT)
NAMES = [row.name for row in ROWS]
JOINTS = ROBOT.joint_names


def made_residual(seed: int = 0) -> Residual:
    """Noise alone, a moving average of order one as differenced white noise leaves it; a walk of
    steps of 0.7 s."""
    random = np.random.default_rng(seed)
    time = (np.arange(BLOCKS) + 0.5) * PERIOD
    shape = (BLOCKS, len(ROWS))
    white = random.normal(size=(BLOCKS + 1, len(ROWS)))
    value = 0.8 * NOISE * random.normal(size=shape) + 0.6 * NOISE / np.sqrt(2) * np.diff(
        white, axis=0
    )
    variance, covariance = np.full(shape, NOISE**2), np.full(shape, -0.5 * (0.6 * NOISE) ** 2)
    # Left leg, both, right leg, both.
    phase = (time / 0.7).astype(int) % 4
    standing = np.stack([phase != 2, phase != 0], axis=1)
    known = np.ones(shape, dtype=bool)
    for foot, side in enumerate(("left", "right")):
        known[:, [name.startswith(f"{side}_sole/") for name in NAMES]] &= standing[:, foot, None]
    known[:, [name.startswith("soles/") for name in NAMES]] &= standing.all(axis=1)[:, None]
    angle = 0.3 * np.sin(2 * np.pi * time[:, None] / 2.3 + np.arange(12))
    signals = Instants(
        joint_position=angle,
        joint_velocity=np.gradient(angle, PERIOD, axis=0),
        joint_acceleration=np.zeros_like(angle),
        angular_velocity=np.zeros((BLOCKS, 3)),
        angular_acceleration=np.zeros((BLOCKS, 3)),
        specific_force=np.zeros((BLOCKS, 3)),
        pad_force=np.zeros((BLOCKS, 8, 3)),
        torque_command=20 * np.cos(2 * np.pi * time[:, None] / 3.1 + np.arange(12)),
        motor_position=np.zeros((BLOCKS, 0)),
    )
    return Residual(ROWS, time, value, known, variance, covariance, standing, signals)


def with_error(residual: Residual, row: str, error: np.ndarray | float) -> Residual:
    value = residual.value.copy()
    value[:, NAMES.index(row)] += error
    return dataclasses.replace(residual, value=value)


def compared(residual: Residual) -> Comparison:
    loads = {side: 400.0 * residual.standing[:, k] for k, side in enumerate(("left", "right"))}
    zero = np.where([row.kind == "kinematic" for row in ROWS], np.nan, 14.0)
    return compare_residual(residual, ROBOT.description, zero, loads)


def test_noise_alone_has_no_failures():
    totals = []
    for seed in range(20):
        comparison = compared(made_residual(seed))
        assert comparison.failures == ()
        totals.append(comparison.rmse)
    assert np.mean(totals) == pytest.approx(1.0, abs=0.005)


def test_intervals_hold_the_mean_that_is_there():
    """A constant in every channel: 95 % of the intervals of its mean over anything hold it."""
    held, seen = 0, 0
    for seed in range(10):
        residual = made_residual(seed)
        comparison = compared(dataclasses.replace(residual, value=residual.value + 0.3))
        for channel in comparison.channels:
            for variable, bins in channel.bins.items():
                for b in bins if variable != "speed" else ():
                    held += b.interval[0] <= 0.3 <= b.interval[1]
                    seen += 1
    assert 0.95 <= held / seen < 0.995


def test_noise_of_a_mean_is_that_of_many_logs():
    """The noise of neighbouring blocks partly cancels in their mean."""
    joints = [
        channel
        for seed in range(12)
        for channel in compared(made_residual(seed)).channels
        if channel.row.kind == "joint"
    ]
    whole = [channel.bins["none"][0] for channel in joints]
    assert np.std([b.error for b in whole]) == pytest.approx(whole[0].noise_floor, rel=0.2)
    assert whole[0].noise_floor < 0.85 * NOISE / np.sqrt(BLOCKS)


def test_in_the_error_as_a_whole_what_lasts_counts_more():
    """Noise of differences cancels from one average to the next."""
    quiet = made_residual()
    quiet = dataclasses.replace(quiet, value=np.zeros_like(quiet.value))
    alternating = 3 * NOISE * (-1.0) ** np.arange(len(quiet.time))
    lasting, short = (with_error(quiet, "left_knee_pitch", e) for e in (3 * NOISE, alternating))
    single = [
        next(c.rmse for c in compared(of).channels if c.row.name == "left_knee_pitch")
        for of in (lasting, short)
    ]
    assert single[0] == pytest.approx(single[1])
    assert compared(lasting).rmse > 1.2 * compared(short).rmse


def test_dry_friction_follows_the_speed():
    residual = made_residual()
    knee = JOINTS.index("left_knee_pitch")
    velocity = residual.signals.joint_velocity[:, knee]
    comparison = compared(with_error(residual, "left_knee_pitch", 0.9 * np.sign(velocity)))
    (failure,) = comparison.failures
    assert failure.row.name == "left_knee_pitch"
    assert failure.where.variable == "speed"
    assert failure.where.error == pytest.approx(0.9, abs=0.03)
    assert failure.text.startswith("left knee pitch: model torque 0.9 Nm too low along the motion")
    assert failure.where.ratio == pytest.approx(0.9 / failure.where.noise_floor, rel=0.05)


def test_an_error_at_low_speed_in_one_phase_is_said_to_be_there():
    residual = made_residual()
    knee = JOINTS.index("left_knee_pitch")
    speed = np.abs(residual.signals.joint_velocity[:, knee])
    swing = ~residual.standing[:, 0]
    (failure,) = compared(
        with_error(residual, "left_knee_pitch", -0.9 * (swing & (speed < 0.3)))
    ).failures
    assert failure.where.phase == "swing"
    assert failure.where.variable in ("speed", "velocity")
    assert -0.95 < failure.where.error < -0.5
    assert "swing" in failure.text
    assert "too high" in failure.text


def test_a_spring_follows_the_angle_and_fails_on_both_sides():
    residual = made_residual()
    angle = residual.signals.joint_position[:, JOINTS.index("right_hip_roll")]
    failures = compared(with_error(residual, "right_hip_roll", 5.0 * angle)).failures
    assert {f.where.variable for f in failures} == {"position"}
    signs = {np.sign(f.where.error): f for f in failures}
    assert len(failures) == len(signs) == 2
    assert signs[1].where.low > 0
    assert signs[-1].where.high < 0
    assert "model torque" in signs[1].text
    assert "too low" in signs[1].text


def test_a_drift_follows_the_time():
    residual = made_residual()
    late = residual.time > 10.0
    (failure,) = compared(with_error(residual, "left_hip_yaw", 0.5 * late)).failures
    assert failure.where.variable == "time"
    assert 9.0 <= failure.where.low <= 10.5
    assert np.isinf(failure.where.high)


@pytest.mark.parametrize(
    ("row", "error", "text"),
    [
        ("base/force_z", -4.0, "base: the feet push 4 N less upwards than the model's masses need"),
        (
            "base/force_y",
            4.0,
            "base: the feet push 4 N more to the left than the model's masses need",
        ),
        (
            "base/moment_y",
            -4.0,
            "base: the feet's moment about the y axis is 4 Nm smaller than the model's masses need",
        ),
        (
            "left_sole/angular_velocity_x",
            4.0,
            "left sole: turns at 4 rad/s about its x axis although it stands",
        ),
        (
            "right_sole/specific_force_y",
            4.0,
            "right sole: 4 m/s² along its y axis that a level sole at rest has not",
        ),
        (
            "soles/relative_velocity_x",
            4.0,
            "soles: move at 4 m/s along x against each other although both stand",
        ),
        ("right_knee_pitch", 4.0, "right knee pitch: model torque 4 Nm too low"),
    ],
)
def test_constant_errors_in_plain_words(row: str, error: float, text: str):
    comparison = compared(with_error(made_residual(), row, error))
    (failure,) = comparison.failures
    assert failure.text == text
    assert (failure.where.phase, failure.where.variable) == ("all", "none")
    # All of it is an offset.
    assert comparison.rmse > 1.5
    assert comparison.held_out_rmse == pytest.approx(1.0, abs=0.02)


def test_an_error_in_one_support_is_said_to_be_there():
    residual = made_residual()
    only_left = residual.standing[:, 0] & ~residual.standing[:, 1]
    (failure,) = compared(with_error(residual, "base/force_z", 3.0 * only_left)).failures
    assert failure.where.phase == "left_support"
    assert failure.text.startswith("base, left support: the feet push 3 N more upwards")


def test_an_error_that_follows_nothing_is_a_failure_too():
    random = np.random.default_rng(5)
    (failure,) = compared(
        with_error(made_residual(), "left_ankle_roll", 0.6 * random.choice([-1.0, 1.0], BLOCKS))
    ).failures
    assert failure.where.variable == "scatter"
    assert failure.where.error == pytest.approx(np.hypot(0.6, NOISE), rel=0.05)
    assert failure.where.interval[0] < failure.where.error < failure.where.interval[1]


def test_worst_comes_first_and_the_smallest_errors_do_not_count():
    residual = with_error(with_error(made_residual(), "left_hip_roll", 0.5), "right_hip_roll", 2.0)
    comparison = compared(with_error(residual, "left_hip_pitch", 0.2 * NOISE))
    assert [failure.row.name for failure in comparison.failures] == [
        "right_hip_roll",
        "left_hip_roll",
    ]


def test_json_has_the_contracts_keys_and_numbers():
    residual = with_error(made_residual(), "left_knee_pitch", 0.9 * ~made_residual().standing[:, 0])
    comparison = compared(residual)
    content = json.loads(json.dumps(comparison_json(comparison)))
    assert set(content) >= {"total", "channels", "failures"}
    assert set(content["total"]) == {"rmse", "noise_floor", "held_out_rmse"}
    assert content["total"]["noise_floor"] == 1.0
    assert list(content["channels"]) == NAMES
    knee = content["channels"]["left_knee_pitch"]
    assert set(knee) >= {"rmse", "nrmse", "noise_floor", "by_phase", "worst"}
    assert set(knee["by_phase"]) == {"stance", "swing", "double_support"}
    assert knee["by_phase"]["swing"]["rmse"] == pytest.approx(np.hypot(0.9, NOISE), rel=0.03)
    assert knee["by_phase"]["stance"]["rmse"] == pytest.approx(NOISE, rel=0.05)
    assert knee["by_phase"]["stance"]["noise_floor"] == pytest.approx(NOISE)
    assert knee["nrmse"] == pytest.approx(knee["rmse"] / 14.0)
    assert knee["worst"]["ratio"] > 20
    assert np.isnan(content["channels"]["left_sole/angular_velocity_x"]["nrmse"])
    (failure,) = content["failures"]
    assert {
        "channel",
        "phase",
        "variable",
        "range",
        "error",
        "unit",
        "noise_floor",
        "ratio",
        "text",
    } <= set(failure)
    assert (failure["channel"], failure["phase"], failure["range"]) == (
        "left_knee_pitch",
        "swing",
        [None, None],
    )


def test_a_walk_with_the_right_model_has_no_failures(run):
    """The whole way from a simulated log: sensors, equation of motion, noise."""
    comparison = compare(
        Predictor(load_scenario("frictionless_walk"), run("frictionless_walk", "duration=3"))
    )
    assert [failure.text for failure in comparison.failures] == []
    assert comparison.rmse == pytest.approx(1.0, abs=0.05)
    force = next(c for c in comparison.channels if c.row.name == "base/force_z")
    # The feet carry the weight, which a model without masses does not know of.
    assert force.nrmse == pytest.approx(force.rmse / 850, rel=0.1)


def test_a_walk_with_friction_that_the_model_lacks_fails_in_every_joint_and_nowhere_else(run):
    log = run("paper_walk", "duration=3")
    comparison = compare(Predictor(load_scenario("paper_walk"), log))
    assert {failure.row.name for failure in comparison.failures} == set(log.joints)
    truth = log["truth/joint/friction_torque"]
    for channel, friction in zip(comparison.channels, truth.T, strict=False):
        assert channel.rmse == pytest.approx(
            np.hypot(np.sqrt(np.mean(friction**2)), channel.noise_floor), rel=0.1
        )


def test_a_robot_in_a_gantry_is_compared_by_its_joints(run):
    comparison = compare(
        Predictor(load_scenario("leg_swing_gantry"), run("leg_swing_gantry", "duration=3"))
    )
    assert {channel.row.kind for channel in comparison.channels} == {"joint"}
    assert comparison.failures
    # Its feet never stand: nothing is said of phases.
    assert all("swing" not in failure.text for failure in comparison.failures)


def test_a_log_of_one_stretch_says_no_interval_of_its_error():
    whole, count = with_error(made_residual(), "left_knee_pitch", 2.0), 10
    parts = ("time", "value", "known", "variance", "covariance", "standing")
    signals = {name: values[:count] for name, values in vars(whole.signals).items()}
    short = {name: getattr(whole, name)[:count] for name in parts}
    comparison = compared(dataclasses.replace(whole, **short, signals=Instants(**signals)))
    (failure,) = (f for f in comparison.failures if f.row.name == "left_knee_pitch")
    assert failure.where.interval == (0.0, np.inf)
    assert failure.where.error == pytest.approx(2.0, rel=0.1)
