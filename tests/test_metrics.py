"""Figures of merit of hand-made logs, whose figures are known."""

import dataclasses
import math

import numpy as np
import pytest

from fbse_drake.log import Log
from fbse_drake.report.metrics import (
    attitude_error_deg,
    attitude_rmse_deg,
    base_velocity_rmse,
    broken_laws,
    consistency,
    friction_error,
    friction_law_error,
    friction_nrmse,
    friction_rmse,
    joint_sides,
    nis_bounds,
    roll_and_pitch_deg,
    run_metrics,
    stance,
    worst_joint,
)

SAMPLES = 2000
JOINTS = ["left_hip", "left_knee", "right_hip", "right_knee"]
# Rows in which filters settle: 0.2 s of 1 ms.
SETTLING = 200


def made_log(**further: np.ndarray) -> Log:
    """Two legs of two joints, 2 s: the left leg stands in the first second, the right one in the
    second; friction is a sine."""
    time = np.arange(SAMPLES) * 0.001
    friction = np.sin(7 * time)[:, None] * np.array([1.0, 2.0, 3.0, 4.0])
    left = time < 1.0
    channels = {
        "time": time,
        "joint/position": np.zeros((SAMPLES, 4)),
        "joint/torque_command": np.zeros((SAMPLES, 4)),
        "truth/joint/friction_torque": friction,
        "reference/foot/left/support": left.astype(float),
        "reference/foot/right/support": (~left).astype(float),
    }
    return Log(channels | further, {"joints": JOINTS, "sides": ["left", "right"], "period": 0.001})


def late(truth: np.ndarray) -> np.ndarray:
    """What an exact estimator says: in each row the friction of the step before."""
    return np.concatenate([truth[:1], truth[:-1]])


def with_estimate(log: Log, estimate: np.ndarray) -> Log:
    return dataclasses.replace(
        log, channels=log.channels | {"estimate/joint/friction_torque": estimate}
    )


def every(figures: dict[str, dict[str, float]]) -> list[float]:
    return [value for values in figures.values() for value in values.values()]


def test_an_exact_estimate_is_that_of_the_step_that_ends():
    log = made_log()
    truth = log["truth/joint/friction_torque"]
    exact = with_estimate(log, late(truth))
    assert every(friction_nrmse(exact)) == [0.0] * 8
    assert every(friction_rmse(exact)) == [0.0] * 8
    assert np.isnan(friction_error(exact)[0]).all()
    # The same numbers a row earlier are of a step that has not been yet.
    assert min(every(friction_nrmse(with_estimate(log, truth)))) > 1e-3


def test_rows_that_are_rarer_than_steps_are_compared_with_the_nearest_step():
    """Of every tenth row: a step is a tenth of what the row before is off by."""
    log = made_log()
    exact = with_estimate(log, late(log["truth/joint/friction_torque"]))
    rarer = Log(
        {name: values[::10] for name, values in exact.channels.items()},
        exact.meta | {"period": 0.01, "reading_time": 0.001},
    )
    assert max(every(friction_nrmse(rarer))) < 0.02
    with_rows_of_steps = dataclasses.replace(rarer, meta=rarer.meta | {"reading_time": 0.01})
    assert min(every(friction_nrmse(with_rows_of_steps))) > 0.03


def test_nrmse_is_the_error_over_the_friction_and_rmse_in_nm():
    log = made_log()
    truth = late(log["truth/joint/friction_torque"])
    log = with_estimate(log, 1.1 * truth)
    assert every(friction_nrmse(log)) == pytest.approx([0.1] * 8)
    rows = np.arange(SETTLING, 1000)
    assert friction_rmse(log)["stance"]["left_knee"] == pytest.approx(
        0.1 * np.sqrt(np.mean(truth[rows, 1] ** 2))
    )


def test_phases_are_those_of_the_joints_own_leg():
    log = made_log()
    estimate = late(log["truth/joint/friction_torque"])
    # Wrong by 1 Nm while the left leg stands.
    estimate[:1000] += 1.0
    rmse = friction_rmse(with_estimate(log, estimate))
    assert [rmse["stance"][joint] for joint in JOINTS] == pytest.approx([1, 1, 0, 0])
    assert [rmse["swing"][joint] for joint in JOINTS] == pytest.approx([0, 0, 1, 1])


def test_without_a_plan_the_estimated_support_tells_the_phase():
    log = made_log()
    estimate = late(log["truth/joint/friction_torque"])
    estimate[:1000] += 1.0
    left = (log.time < 1.5).astype(float)
    channels = {name: values for name, values in log.items() if not name.startswith("reference/")}
    channels |= {
        "estimate/joint/friction_torque": estimate,
        "estimate/support": np.stack([left, 1 - left], axis=1),
    }
    rmse = friction_rmse(Log(channels, log.meta))
    assert rmse["swing"]["left_hip"] == pytest.approx(0.0)
    assert rmse["stance"]["left_hip"] == pytest.approx(math.sqrt(800 / 1300))
    del channels["estimate/support"]
    unknown = Log(channels, log.meta)
    assert stance(unknown) == {}
    assert all(math.isnan(value) for value in every(friction_rmse(unknown)))


def test_settling_of_the_filters_is_left_out():
    log = made_log()
    estimate = late(log["truth/joint/friction_torque"])
    estimate[:SETTLING] = 1e6
    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (SAMPLES, 1))
    started = attitude.copy()
    started[:SETTLING] = [0.0, 1.0, 0.0, 0.0]
    log = made_log(
        **{
            "estimate/joint/friction_torque": estimate,
            "estimate/base/orientation": started,
            "truth/base/orientation": attitude,
        }
    )
    assert every(friction_rmse(log)) == [0.0] * 8
    assert attitude_rmse_deg(log) == {"roll": 0.0, "pitch": 0.0}
    short = Log({name: values[:SETTLING] for name, values in log.items()}, log.meta)
    assert all(
        math.isnan(value)
        for value in (*every(friction_rmse(short)), *attitude_rmse_deg(short).values())
    )


def test_a_robot_without_friction_has_no_normalised_error():
    log = made_log(
        **{
            "truth/joint/friction_torque": np.zeros((SAMPLES, 4)),
            "estimate/joint/friction_torque": np.ones((SAMPLES, 4)),
        }
    )
    assert all(math.isnan(value) for value in every(friction_nrmse(log)))
    assert every(friction_rmse(log)) == [1.0] * 8


def log_with_law(torque: np.ndarray, law: np.ndarray) -> Log:
    channels = {"truth/joint/friction_torque": torque, "truth/joint/friction_law_torque": law}
    return made_log(**channels)


def test_a_log_that_does_not_say_how_it_ended_is_a_recording():
    log = made_log()
    for meta in (log.meta, log.meta | {"outcome": None}):
        assert run_metrics(Log(log.channels, meta), 1.0)["outcome"] == "recorded"


def test_law_error_is_the_difference_over_the_law():
    law = made_log()["truth/joint/friction_torque"]
    torque = law * [1.0, 0.9, 1.005, 3.0]
    log = log_with_law(torque, law)
    error = friction_law_error(log)
    assert list(error) == JOINTS
    assert list(error.values()) == pytest.approx([0.0, 0.1, 0.005, 2.0])
    assert run_metrics(log, 1.0)["friction_law_error"] == error
    assert list(broken_laws(error)) == ["right_knee", "left_knee"]
    # An error that is no multiple of the law: 1 Nm in half of the rows, of a law of 2 Nm.
    law, torque = np.full((SAMPLES, 4), 2.0), np.full((SAMPLES, 4), 2.0)
    torque[::2] += 1.0
    log = log_with_law(torque, law)
    assert list(friction_law_error(log).values()) == pytest.approx([math.sqrt(0.5) / 2] * 4)


def test_a_joint_without_an_effect_and_a_log_without_truth_have_no_law_error():
    law = made_log()["truth/joint/friction_torque"] * [0.0, 0.0, 1.0, 1.0]
    log = log_with_law(law * 1.02, law)
    error = friction_law_error(log)
    assert list(error.values()) == pytest.approx([math.nan, math.nan, 0.02, 0.02], nan_ok=True)
    assert list(broken_laws(error)) == ["right_hip", "right_knee"]
    assert worst_joint(error).startswith("right")
    for missing in ("truth/joint/friction_torque", "truth/joint/friction_law_torque"):
        channels = {name: values for name, values in log.items() if name != missing}
        unknown = friction_law_error(dataclasses.replace(log, channels=channels))
        assert list(unknown) == JOINTS
        assert all(math.isnan(value) for value in unknown.values())
        assert broken_laws(unknown) == {}


def test_a_law_is_followed_up_to_one_per_cent():
    assert broken_laws({"hip": 0.01, "knee": 0.0101, "toe": math.nan}) == {"knee": 0.0101}


def quaternion(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """[w, x, y, z] of z-y-x Euler angles [deg], one axis after another."""
    result = np.array([1.0, 0.0, 0.0, 0.0])
    for angle, axis in ((yaw, 3), (pitch, 2), (roll, 1)):
        turn = np.zeros(4)
        turn[0], turn[axis] = math.cos(math.radians(angle) / 2), math.sin(math.radians(angle) / 2)
        (w, v), (s, u) = (result[0], result[1:]), (turn[0], turn[1:])
        result = np.array([w * s - v @ u, *(w * u + s * v + np.cross(v, u))])
    return result


def test_roll_and_pitch_are_z_y_x_euler_angles():
    angles = [(10.0, -20.0, 130.0), (-170.0, 80.0, -5.0), (0.0, 0.0, 77.0)]
    found = roll_and_pitch_deg(np.array([quaternion(*angle) for angle in angles]))
    np.testing.assert_allclose(found, [angle[:2] for angle in angles], atol=1e-9)


def test_attitude_error_ignores_yaw_and_the_quaternions_sign():
    truth = np.tile(quaternion(1.0, -2.0, 3.0), (SAMPLES, 1))
    estimate = np.tile(-quaternion(1.5, -2.3, 40.0), (SAMPLES, 1))
    log = made_log(**{"estimate/base/orientation": estimate, "truth/base/orientation": truth})
    rmse = attitude_rmse_deg(log)
    assert (rmse["roll"], rmse["pitch"]) == pytest.approx((0.5, 0.3))
    round_the_back = {
        "estimate/base/orientation": quaternion(179.0, 0.0, 0.0),
        "truth/base/orientation": quaternion(-179.0, 0.0, 0.0),
    }
    log = made_log(
        **{name: np.tile(values, (SAMPLES, 1)) for name, values in round_the_back.items()}
    )
    np.testing.assert_allclose(attitude_error_deg(log)[:, 0], -2.0)


def test_base_velocity_is_compared_at_the_same_time():
    truth = np.cumsum(np.full((SAMPLES, 3), 0.01), axis=0)
    log = made_log(
        **{"estimate/base/velocity": truth + [0.1, -0.2, 0.0], "truth/base/velocity": truth}
    )
    assert base_velocity_rmse(log) == pytest.approx({"x": 0.1, "y": 0.2, "z": 0.0}, abs=1e-12)


def innovations(scale: float) -> dict[str, np.ndarray]:
    """White innovations of the attitude's filters, `scale` times as large as they are said to be;
    no level feet."""
    random = np.random.default_rng(1)
    deviation = np.array([0.1, 0.1, 0.1, 2.0, 2.0, 2.0])
    innovation = np.hstack(
        [scale * deviation * random.standard_normal((SAMPLES, 6)), np.zeros((SAMPLES, 3))]
    )
    return {
        "estimate/attitude/innovation": innovation,
        "estimate/attitude/innovation_variance": np.tile([0.01, 4.0, 0.0], (SAMPLES, 1)),
    }


def test_consistent_filters_are_within_the_bounds_and_others_are_not():
    good, bad = (
        consistency(made_log(**innovations(1.0)))["attitude"],
        consistency(made_log(**innovations(2.0)))["attitude"],
    )
    assert list(good) == ["gravity", "attitude by gravity"]
    for part, found in good.items():
        assert found.count == 3 * (SAMPLES - SETTLING)
        assert found.lower < found.nis < found.upper
        assert bad[part].nis == pytest.approx(4 * found.nis)
    # Half the width of the bounds is about 1.96 standard deviations of the mean of squares of
    # normal variables.
    assert (found.upper - found.lower) / 2 == pytest.approx(
        1.96 * math.sqrt(2 / found.count), rel=0.01
    )
    assert nis_bounds(np.array([1, 10])).shape == (2, 2)


def test_rows_without_an_update_do_not_count():
    channels = innovations(1.0)
    plain = consistency(made_log(**channels))["attitude"]["gravity"]
    held = {name: values.copy() for name, values in channels.items()}
    for values in held.values():
        values[500:900] = values[499]
    held["estimate/attitude/innovation_variance"][900:1000] = 0.0
    found = consistency(made_log(**held))["attitude"]["gravity"]
    assert found.count == plain.count - 3 * 500
    squares = channels["estimate/attitude/innovation"][:, :3] ** 2 / 0.01
    counted = np.r_[SETTLING:500, 1000:SAMPLES]
    assert found.nis == pytest.approx(squares[counted].mean())


def test_every_filter_is_named_by_what_it_measures():
    ones = np.random.default_rng(2).standard_normal((SAMPLES, 12))
    channels = {
        "estimate/base_state/innovation": ones[:, :6],
        "estimate/base_state/innovation_variance": np.ones((SAMPLES, 2)),
        "estimate/joint_acceleration/innovation": ones,
        "estimate/joint_acceleration/innovation_variance": np.ones((SAMPLES, 12)),
        "estimate/friction/innovation": ones[:, :4],
        "estimate/friction/innovation_variance": np.ones((SAMPLES, 4)),
    }
    found = consistency(made_log(**channels))
    assert list(found) == ["base_state", "joint_acceleration", "friction"]
    assert list(found["base_state"]) == ["position", "velocity"]
    feet = ["left foot, angular", "left foot, linear", "right foot, angular", "right foot, linear"]
    assert list(found["joint_acceleration"]) == feet
    assert list(found["friction"]) == JOINTS
    channels |= {
        name: channels[name][:, :2]
        for name in ("estimate/base_state/innovation", "estimate/base_state/innovation_variance")
    }
    assert list(consistency(made_log(**channels))["base_state"]) == ["ZMP x", "ZMP y"]


def test_joints_belong_to_legs_by_name_or_by_place():
    log = made_log()
    assert joint_sides(log) == ["left", "left", "right", "right"]
    legs = {"left": JOINTS[:2], "right": JOINTS[2:]}
    one_foot = dataclasses.replace(log, meta=log.meta | {"legs": legs, "sides": ["left"]})
    assert joint_sides(one_foot) == ["left", "left", None, None]
    renamed = dataclasses.replace(log, meta=log.meta | {"joints": ["LH", "LK", "RH", "RK"]})
    assert joint_sides(renamed) == ["left", "left", "right", "right"]
    assert (
        joint_sides(dataclasses.replace(log, meta={"joints": JOINTS, "period": 0.001}))
        == [None] * 4
    )


def test_a_recording_has_nothing_but_its_length_and_cost():
    channels = {
        name: values
        for name, values in made_log().items()
        if not name.startswith(("truth/", "reference/"))
    }
    channels["estimate/joint/friction_torque"] = np.ones((SAMPLES, 4))
    ticks = np.full(SAMPLES, 0.0005)
    ticks[:40] = 0.002
    metrics = run_metrics(Log(channels, made_log().meta), 1.0, ticks)
    assert (metrics["fell"], metrics["outcome"]) == (None, "recorded")
    assert metrics["simulated_time"] == pytest.approx(1.999)
    assert metrics["tick_us"] == pytest.approx({"median": 500.0, "p99": 2000.0})
    unknown = (
        "joint_tracking_rms",
        "com_rse_mean",
        "stance_creep_max",
        "attitude_rmse_deg",
        "base_velocity_rmse",
    )
    assert all(math.isnan(value) for key in unknown for value in metrics[key].values())
    assert all(
        math.isnan(value)
        for key in ("friction_rmse", "friction_nrmse")
        for value in every(metrics[key])
    )


def test_only_a_measured_tick_has_a_cost():
    assert all(math.isnan(value) for value in run_metrics(made_log(), 1.0)["tick_us"].values())
