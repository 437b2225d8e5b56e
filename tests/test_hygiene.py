"""Faults of a recording are found, with their size, and a good recording shows none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario
from scipy.signal import butter, lfilter, sosfilt
from scipy.spatial.transform import Rotation

from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.channel_checks import estimated_noise
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene, hygiene_json, inspect
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.discrepancy.residual.evidence import HygieneFinding
from fbse_drake.errors import InputError
from fbse_drake.log import Log

H = 1e-3
WALK, GANTRY = ("paper_walk", "duration=2.6"), ("leg_swing_gantry", "duration=3")
KNEE, HIP = 3, 2
SIDES = (("left", "right"), ("right", "left"))
Run = Callable[..., Log]


def changed(log: Log, **channels: np.ndarray) -> Log:
    return replace(
        log,
        channels=log.channels
        | {name.replace("__", "/"): values for name, values in channels.items()},
    )


def findings(which: tuple[str, str], log: Log) -> list[HygieneFinding]:
    predictor = Predictor(scenario(*which), log)
    return list(inspect(predictor.motion, predictor.noise).findings)


def only(found: list[HygieneFinding]) -> HygieneFinding:
    assert len(found) == 1, [f.text for f in found]
    assert "\n" not in found[0].text
    return found[0]


def of_kind(kind: str, found: list[HygieneFinding]) -> HygieneFinding:
    return only([f for f in found if f.kind == kind])


def late(values: np.ndarray, steps: int) -> np.ndarray:
    """The same a whole number of samples later."""
    return np.concatenate([np.repeat(values[:1], steps, axis=0), values[:-steps]])


def early(values: np.ndarray, steps: int) -> np.ndarray:
    return np.concatenate([values[steps:], np.repeat(values[-1:], steps, axis=0)])


@pytest.mark.parametrize("which", [WALK, GANTRY], ids=["walk", "gantry"])
def test_a_good_log_shows_nothing(run: Run, which: tuple[str, str]) -> None:
    assert [f.text for f in findings(which, run(*which))] == []
    assert [f.text for f in findings(which, run(*which, noise=False)) if f.severity != "note"] == []


@pytest.mark.parametrize("which", [WALK, GANTRY], ids=["walk", "gantry"])
def test_noise_is_that_of_the_sensors(run: Run, which: tuple[str, str]) -> None:
    levels = {
        level.channel: level
        for level in estimated_noise(Predictor(scenario(*which), run(*which)).motion)
    }
    for channel in (
        "joint/position",
        "imu/linear_acceleration",
        "imu/angular_velocity",
        "foot/left/pad_force",
    ):
        assert levels[channel].level == pytest.approx(levels[channel].believed, rel=0.25), channel
    assert levels["joint/position"].believed == pytest.approx(4.8e-5 / np.sqrt(12))


def test_more_noise_than_is_believed(run: Run) -> None:
    log = run(*GANTRY)
    noisier = log["joint/velocity"] + np.random.default_rng(1).normal(
        scale=0.02, size=log["joint/velocity"].shape
    )
    found = of_kind("noise_level", findings(GANTRY, changed(log, joint__velocity=noisier)))
    assert found.size == pytest.approx(0.02 / 5e-4, rel=0.2)
    assert found.severity == "warning"


def test_gaps_and_jitter(run: Run) -> None:
    log, random = run(*GANTRY), np.random.default_rng(2)
    keep = np.ones(len(log.time), dtype=bool)
    keep[500:540] = keep[2000:2200] = False
    torn = replace(log, channels={name: values[keep] for name, values in log.channels.items()})
    gap = only(findings(GANTRY, torn))
    assert gap.kind == "gap"
    assert gap.size == pytest.approx(0.24, abs=2e-3)
    assert gap.severity == "note"
    jittered = of_kind(
        "jitter",
        findings(
            GANTRY, changed(log, time=log.time + random.normal(scale=0.05 * H, size=len(log.time)))
        ),
    )
    # Two neighbouring stamps are off.
    assert jittered.size == pytest.approx(np.sqrt(2) * 0.05 * H, rel=0.1)


def test_velocity_that_comes_late(run: Run) -> None:
    log = run(*GANTRY)
    found = of_kind(
        "clock_offset",
        findings(GANTRY, changed(log, joint__velocity=late(log["joint/velocity"], 7))),
    )
    assert (found.channel, found.severity) == ("joint/velocity", "warning")
    assert found.size == pytest.approx(7 * H, abs=0.5 * H)


def test_gyroscope_that_comes_late(run: Run) -> None:
    log = run(*WALK)
    found = of_kind(
        "clock_offset",
        findings(WALK, changed(log, imu__angular_velocity=late(log["imu/angular_velocity"], 6))),
    )
    assert found.channel == "imu/angular_velocity"
    assert found.size == pytest.approx(6 * H, abs=H)


def forces(
    log: Log, change: Callable[[np.ndarray], np.ndarray], sides: tuple[str, ...] = ("left", "right")
) -> Log:
    return changed(
        log, **{f"foot__{side}__pad_force": change(log[f"foot/{side}/pad_force"]) for side in sides}
    )


def test_forces_that_come_late_are_told_from_forces_behind_a_low_pass(run: Run) -> None:
    # Without the first samples, when the feet are put down.
    log = run(*WALK).part(slice(100, None))
    delayed = findings(WALK, forces(log, lambda f: late(f, 8)))
    assert of_kind("clock_offset", delayed).size == pytest.approx(8 * H, abs=1.5 * H)
    assert "low_pass" not in [f.kind for f in delayed]
    stays = np.exp(-1 / 20)
    smooth = findings(
        WALK,
        forces(log, lambda f: lfilter([1 - stays], [1, -stays], f, axis=0, zi=stays * f[:1])[0]),
    )
    assert of_kind("low_pass", smooth).size == pytest.approx(0.020, rel=0.35)
    assert "clock_offset" not in [f.kind for f in smooth]


def test_a_torque_after_its_motion_is_a_clock_before_it_the_robot_s_own(run: Run) -> None:
    """No motor moves a joint before it is told to; that it does so later is a delay as robots have
    it."""
    log = run(*GANTRY)
    torque = log["joint/torque_command"]
    after = of_kind(
        "clock_offset", findings(GANTRY, changed(log, joint__torque_command=late(torque, 40)))
    )
    assert after.channel == "joint/torque_command"
    assert after.size == pytest.approx(0.040, rel=0.3)
    before = findings(GANTRY, changed(log, joint__torque_command=early(torque, 40)))
    assert of_kind("command_ahead", before).size == pytest.approx(0.040, rel=0.3)
    assert "clock_offset" not in [f.kind for f in before]


def test_stuck_channels(run: Run) -> None:
    log = run(*GANTRY)
    angles = log["joint/position"].copy()
    angles[1000:1600, KNEE] = angles[1000, KNEE]
    found = of_kind("stuck", findings(GANTRY, changed(log, joint__position=angles)))
    assert found.where == ("left_knee_pitch",)
    assert found.size == pytest.approx(0.6, abs=0.01)
    assert found.severity == "untrustworthy"
    log = run(*WALK)
    rates = log["imu/angular_velocity"].copy()
    rates[1200:1700] = rates[1200]
    found = of_kind("stuck", findings(WALK, changed(log, imu__angular_velocity=rates)))
    assert set(found.where) == set("xyz")


def test_lost_samples(run: Run) -> None:
    log, random = run(*GANTRY), np.random.default_rng(3)
    torque = log["joint/torque_command"].copy()
    assert "lost" not in {f.kind for f in findings(GANTRY, log)}
    torque[random.random(len(torque)) < 0.03, KNEE] = 0.0
    found = of_kind("lost", findings(GANTRY, changed(log, joint__torque_command=torque)))
    assert found.where == ("left_knee_pitch",)
    assert found.severity == "untrustworthy"
    # Of torques near 0 nobody can say.
    assert 1.0 < found.size < 3.5
    # A drive that is switched off for a while, and one that chatters, lose nothing.
    torque = log["joint/torque_command"].copy()
    torque[100:200, KNEE] = 0.0
    torque[:, HIP] *= np.arange(len(torque)) % 2
    assert "lost" not in {
        f.kind for f in findings(GANTRY, changed(log, joint__torque_command=torque))
    }


def test_clipped_torque_and_coarse_velocity_and_held_samples(run: Run) -> None:
    log = run(*GANTRY)
    torque = log["joint/torque_command"].copy()
    torque[:, KNEE] = np.clip(torque[:, KNEE], *np.quantile(torque[:, KNEE], (0.1, 0.9)))
    found = of_kind("clipped", findings(GANTRY, changed(log, joint__torque_command=torque)))
    assert found.where == ("left_knee_pitch",)
    # At a limit that is reached more than once.
    assert 9 < found.size < 21
    coarse = of_kind(
        "quantised",
        findings(
            GANTRY, changed(log, joint__velocity=0.05 * np.rint(log["joint/velocity"] / 0.05))
        ),
    )
    assert coarse.size == pytest.approx(0.05)
    assert len(coarse.where) == 12
    fourth = np.repeat(log["joint/torque_command"][::4], 4, axis=0)[: len(log.time)]
    held = of_kind("held", findings(GANTRY, changed(log, joint__torque_command=fourth)))
    assert held.size == pytest.approx(4, rel=0.05)
    # A command is meant to be held.
    assert "late on average" in held.text
    fourth = np.repeat(log["joint/velocity"][::4], 4, axis=0)[: len(log.time)]
    held = of_kind("held", findings(GANTRY, changed(log, joint__velocity=fourth)))
    assert "interpolated between its readings" in held.text


def test_filtered_before_it_was_recorded(run: Run) -> None:
    log = run(*GANTRY)
    filtered = sosfilt(butter(4, 60, fs=1 / H, output="sos"), log["joint/velocity"], axis=0)
    found = of_kind("filtered", findings(GANTRY, changed(log, joint__velocity=filtered)))
    assert found.channel == "joint/velocity"
    assert 30 < found.size < 250


def test_a_motion_is_no_filter(run: Run) -> None:
    """Its spectrum falls with the eighth power of the frequency; impacts are some samples long."""
    log, random = run(*GANTRY), np.random.default_rng(3)
    smooth = random.standard_normal(log["joint/velocity"].shape)
    for _ in range(4):
        smooth = np.cumsum(smooth, axis=0)
        smooth -= np.linspace(0.0, 1.0, len(smooth))[:, None] * smooth[-1]
    smooth /= smooth.std(axis=0)
    smooth[[500, 1500, 2400]] += 0.1 * np.sin(np.arange(12))
    found = findings(GANTRY, changed(log, joint__velocity=smooth))
    assert not [f for f in found if f.kind == "filtered"]


@pytest.mark.parametrize("joint", ["knee_pitch", "hip_roll"])
def test_joints_that_change_places_are_found_by_the_gyroscope(run: Run, joint: str) -> None:
    log = run(*WALK)
    places = [log.joints.index(f"{side}_{joint}") for side in ("left", "right")]
    order = np.arange(len(log.joints))
    order[places] = places[::-1]
    swapped = {
        f"joint__{name}": log[f"joint/{name}"][:, order] for name in ("position", "velocity")
    }
    predictor = Predictor(scenario(*WALK), changed(log, **swapped))
    with pytest.raises(
        InputError, match=f"the joints left_{joint} and right_{joint} change places"
    ):
        check_sensors(predictor.motion)
    # Feet that do, or a gyroscope in another frame, are no exchange of joints.
    feet = {f"foot__{a}__pad_force": log[f"foot/{b}/pad_force"] for a, b in SIDES}
    turned = {"imu__angular_velocity": log["imu/angular_velocity"][:, [1, 2, 0]]}
    for wrong in (feet, turned):
        predictor = Predictor(scenario(*WALK), changed(log, **wrong))
        with pytest.raises(InputError, match="wrong, or joints or feet change places"):
            check_sensors(predictor.motion)


@pytest.mark.parametrize(
    ("factor", "severity"), [(0.1, "untrustworthy"), (5.0, "untrustworthy"), (0.6, "warning")]
)
def test_scale_of_the_torque(run: Run, factor: float, severity: str) -> None:
    log = run(*GANTRY)
    found = of_kind(
        "torque_scale",
        findings(GANTRY, changed(log, joint__torque_command=factor * log["joint/torque_command"])),
    )
    assert found.severity == severity
    assert found.size == pytest.approx(factor, rel=0.25)
    assert "left_knee_pitch" in found.where


def test_duty_cycle_in_the_place_of_a_torque(run: Run) -> None:
    """A weak motor behind much back-EMF: what its driver gives is the speed rather than the
    torque."""
    log = run(*GANTRY)
    resistance, constant, supply = 0.2, 8.0, 12.0
    volts = resistance / constant * log["joint/torque_command"] + constant * log["joint/velocity"]
    duty = 885 * np.clip(volts / supply * 2.0, -1, 1)
    found = of_kind("not_a_torque", findings(GANTRY, changed(log, joint__torque_command=duty)))
    assert found.severity == "untrustworthy"
    assert found.size == pytest.approx(885)
    assert "left_knee_pitch" in found.where


def test_dead_torque_and_a_joint_that_does_not_move(run: Run) -> None:
    log = run(*GANTRY)
    torque = log["joint/torque_command"].copy()
    torque[:, KNEE] = 0.1
    found = of_kind("dead_torque", findings(GANTRY, changed(log, joint__torque_command=torque)))
    assert found.where == ("left_knee_pitch",)
    resting = "reference.amplitude={hip_yaw: 0.0}"
    held = findings(
        ("leg_swing_gantry", resting), run("leg_swing_gantry", "duration=1", resting, noise=False)
    )
    assert set(of_kind("no_motion", held).where) == {"left_hip_yaw", "right_hip_yaw"}


def exchanged(values: np.ndarray, first: list[int], second: list[int]) -> np.ndarray:
    result = values.copy()
    result[:, first], result[:, second] = values[:, second], values[:, first]
    return result


@pytest.mark.parametrize("which", [WALK, GANTRY], ids=["walk", "gantry"])
@pytest.mark.parametrize(
    ("channels", "first", "second"),
    [
        (("joint__torque_command",), [HIP], [KNEE]),
        (("joint__position", "joint__velocity"), [HIP], [KNEE]),
        (("joint__position", "joint__velocity", "joint__torque_command"), [HIP], [KNEE + 6]),
    ],
)
def test_swapped_joints(
    run: Run, which: tuple[str, str], channels: tuple[str, ...], first: list[int], second: list[int]
) -> None:
    log = run(*which)
    wrong = changed(
        log, **{name: exchanged(log[name.replace("__", "/")], first, second) for name in channels}
    )
    found = of_kind("swapped_joints", findings(which, wrong))
    assert set(found.where) == {log.joints[k] for k in (*first, *second)}
    assert found.severity == "untrustworthy"


def test_swapped_legs(run: Run) -> None:
    log, left, right = run(*GANTRY), list(range(6)), list(range(6, 12))
    wrong = changed(log, joint__torque_command=exchanged(log["joint/torque_command"], left, right))
    found = of_kind("swapped_joints", findings(GANTRY, wrong))
    assert found.where == tuple(log.joints)


def test_what_makes_the_equation_meaningless_is_refused(run: Run) -> None:
    gantry, walk = run(*GANTRY), run(*WALK)
    both = {
        "joint__position": np.rad2deg(gantry["joint/position"]),
        "joint__velocity": np.rad2deg(gantry["joint/velocity"]),
    }
    for which, wrong, words in (
        (GANTRY, changed(gantry, **both), "degrees"),
        (WALK, forces(walk, lambda f: -f, ("right",)), "foot/right: this foot pulls at the ground"),
        (
            WALK,
            changed(walk, imu__angular_velocity=np.rad2deg(walk["imu/angular_velocity"])),
            "degrees per second",
        ),
        (
            WALK,
            changed(walk, imu__angular_velocity=-walk["imu/angular_velocity"]),
            "imu/angular_velocity.*sign is reversed",
        ),
    ):
        with pytest.raises(InputError, match=words) as error:
            check_sensors(Predictor(scenario(*which), wrong).motion)
        assert "\n" not in str(error.value)


def test_weight_direction_and_offset_of_the_foot_forces(run: Run) -> None:
    log = run(*WALK)
    weight = of_kind("weight", findings(WALK, forces(log, lambda f: 1.06 * f)))
    assert weight.size == pytest.approx(0.06 * 87 * 9.81, rel=0.05)
    tilt = Rotation.from_rotvec([0, 0.08, 0]).as_matrix().T
    leaning = of_kind("force_frame", findings(WALK, forces(log, lambda f: f @ tilt.T, ("left",))))
    assert (leaning.channel, leaning.where) == ("foot/left", ("force_x",))
    assert abs(leaning.size) == pytest.approx(0.08, rel=0.2)
    assert "sole stands level" in leaning.text
    # Four pads.
    offset = of_kind(
        "air_reading", findings(WALK, forces(log, lambda f: f + [0, 0, 5.0], ("right",)))
    )
    assert (offset.channel, offset.where) == ("foot/right", ("force_z",))
    assert offset.size == pytest.approx(20, rel=0.1)


def test_force_that_moves_against_the_motion(run: Run) -> None:
    """The sideways force has the right mean, so that no frame is wrong, but the wrong course."""

    def mirrored(force: np.ndarray) -> np.ndarray:
        loaded = force[:, :, 2].sum(axis=1) > 600
        result = force.copy()
        result[loaded, :, 1] = 2 * force[loaded, :, 1].mean(axis=0) - force[loaded, :, 1]
        return result

    log = run("paper_walk", "duration=2.8")
    found = [
        f
        for f in findings(("paper_walk", "duration=2.8"), forces(log, mirrored, ("left",)))
        if f.kind == "force_against_motion"
    ]
    assert only(found).channel == "foot/left"
    assert only(found).where == ("force_y",)
    assert "accelerometer" not in only(found).text
    # What both feet show may be what they share.
    found = findings(("paper_walk", "duration=2.8"), forces(log, mirrored, ("left", "right")))
    both = [f for f in found if f.kind == "force_against_motion"]
    assert {f.channel for f in both} == {"foot/left", "foot/right"}
    assert all("or, as every foot shows it, the accelerometer's axes are" in f.text for f in both)


def test_a_robot_that_trembles_has_no_wrong_forces(run: Run) -> None:
    """At 40 Hz the accelerometer reads 3 m/s^2, and feet that are pressed by it the other way."""

    def pressed(force: np.ndarray) -> np.ndarray:
        result = force.copy()
        result[:, :, 1] -= 15.0 * tremble[:, None] * (force[:, :, 2] > 20)
        return result

    log = run("paper_walk", "duration=2.8")
    tremble = np.sin(2 * np.pi * 40.0 * log.time)
    acceleration = log["imu/linear_acceleration"] + 3.0 * tremble[:, None] * [0.0, 1.0, 0.0]
    trembling = forces(log, pressed, ("left", "right"))
    trembling = changed(trembling, imu__linear_acceleration=acceleration)
    found = findings(("paper_walk", "duration=2.8"), trembling)
    assert not [f for f in found if f.kind == "force_against_motion"]


def test_gravity_on_the_accelerometer(run: Run) -> None:
    log = run(*WALK)
    found = of_kind(
        "gravity",
        findings(
            WALK, changed(log, imu__linear_acceleration=1.03 * log["imu/linear_acceleration"])
        ),
    )
    assert found.size == pytest.approx(0.03 * 9.81, rel=0.05)


def test_json_and_the_words_of_a_summary(run: Run) -> None:
    log = run(*GANTRY)
    motion = Predictor(
        scenario(*GANTRY), changed(log, joint__torque_command=0.1 * log["joint/torque_command"])
    ).motion
    hygiene = inspect(motion)
    content = hygiene_json(hygiene)
    assert content["findings"][0]["kind"] == "torque_scale"
    assert content["noise"][0]["channel"] == "joint/position"
    assert hygiene.before("The model lacks nothing.").startswith(
        "Not to be trusted: joint/torque_command"
    )
    assert Hygiene().before("The model lacks nothing.") == "The model lacks nothing."
