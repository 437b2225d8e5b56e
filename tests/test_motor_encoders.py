"""A second encoder per joint, on the motor's side of the gear: what it reads, and what a diagnosis
tells by it that one encoder alone confuses."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from fbse_drake import Log, Scenario, simulate
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.parsimony import Judge
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.sensor import EncoderOffset, MotorEncoderOffset, TransmissionElasticity
from fbse_drake.effects.transmission import Backlash
from fbse_drake.errors import InputError
from fbse_drake.interop.convert import convert
from fbse_drake.interop.mapping import ChannelMap, LogMap
from fbse_drake.scenario import dump_scenario, load_scenario
from fbse_drake.sensors.motor_encoders import MotorEncoderConfig

TICK, NOISE = 0.001, 2e-5
# Whose torque changes its sign, and one whose torque never does.
ANKLE, KNEE = "right_ankle_pitch", "left_knee_pitch"
TRIED = (
    "Backlash",
    "BodyCentreOfMass",
    "EncoderOffset",
    "JointSpring",
    "MotorEncoderOffset",
    "TorqueDelay",
    "TorqueGain",
    "TransmissionElasticity",
)
COMPLIANCE, TIME_CONSTANT = 8e-5, 8e-3


def swinging(*hidden: Effect, duration: float = 3.0, seed: int = 1) -> Scenario:
    """Legs that swing in a gantry, with encoders on both sides; the model lacks what is hidden."""
    known = load_scenario("leg_swing_gantry")
    robot, model = known.robot, replace(known.believed, effects=known.robot.effects)
    more = {f"hidden_{k}": effect for k, effect in enumerate(hidden)}
    second = MotorEncoderConfig(noise=NOISE, period=known.usual_period)
    return replace(
        known,
        duration=duration,
        seed=seed,
        robot=replace(robot, effects=robot.effects | more),
        model=model,
        sensors=replace(known.sensors, motor_encoders=second),
    )


@cache
def log_of(*hidden: tuple[str, str], duration: float = 3.0) -> Log:
    return simulate(swinging(*(HIDDEN[key] for key in hidden), duration=duration)).log


HIDDEN: dict[tuple[str, str], Effect] = {
    (name, joint): effect
    for joint in (ANKLE, KNEE)
    for name, effect in {
        "elastic": TransmissionElasticity({joint: COMPLIANCE}, {"all": TIME_CONSTANT}),
        "play": Backlash({joint: 3e-3}, {"all": 0.2}),
        "motor": MotorEncoderOffset({joint: -0.05}),
        "link": EncoderOffset({joint: 4e-3}),
    }.items()
}


def found_in(log: Log) -> Diagnosis:
    return diagnose(Predictor(swinging(), log), [library()[name] for name in TRIED])


def names(diagnosis: Diagnosis) -> set[tuple[str, tuple[str, ...]]]:
    return {(finding.effect, finding.targets) for finding in diagnosis.chosen}


def deflection(log: Log, joint: str) -> np.ndarray:
    column = log.joints.index(joint)
    return (log["joint/motor_position"] - log["truth/joint/position"])[:, column]


def test_a_spring_shows_between_the_encoders_and_not_in_the_links_angle():
    log = log_of(("elastic", KNEE))
    knee = log.joints.index(KNEE)
    keep = np.exp(-TICK / TIME_CONSTANT)
    load = (log["joint/torque_command"] - log["truth/joint/friction_torque"])[:, knee]
    twist = lfilter([0.0, 1.0 - keep], [1.0, -keep], COMPLIANCE * load)
    left = deflection(log, KNEE) - twist
    assert np.abs(twist).max() > 20 * NOISE
    assert left.std() == pytest.approx(NOISE, rel=0.05)
    link = (log["joint/position"] - log["truth/joint/position"])[:, knee]
    assert np.abs(link).max() < 5e-5
    assert deflection(log, ANKLE).std() == pytest.approx(NOISE, rel=0.05)


def test_a_rotor_crosses_its_gap_by_its_own_inertia_and_stops_at_the_sides():
    log, half = log_of(("play", ANKLE)), 1.5e-3
    command = log["joint/torque_command"][:, log.joints.index(ANKLE)]
    place, rate, expected = half * np.sign(command[0]), 0.0, []
    for torque in command:
        expected.append(place)
        rate += TICK * torque / 0.2
        place += TICK * rate
        if abs(place) >= half:
            place, rate = half * np.sign(place), 0.0
    # At first no command is known yet.
    ahead = deflection(log, ANKLE)[1:]
    np.testing.assert_allclose(ahead, expected[1:], atol=6 * NOISE)
    assert ahead.min() < -0.9 * half
    assert ahead.max() > 0.9 * half


def test_counts_and_noise_are_of_the_seed_and_touch_nothing_else(tmp_path: Path):
    def run(seed: int = 0, second: MotorEncoderConfig | None = None) -> Log:
        scenario = swinging(duration=0.3, seed=seed)
        return simulate(
            replace(scenario, sensors=replace(scenario.sensors, motor_encoders=second))
        ).log

    second = MotorEncoderConfig(noise=1e-3, resolution=5e-4, period=TICK)
    log, without = run(0, second), run()
    read = log["joint/motor_position"]
    assert read.shape == log["joint/position"].shape
    assert log.unit("joint/motor_position") == "rad"
    np.testing.assert_allclose(read / 5e-4, np.round(read / 5e-4), atol=1e-9)
    assert (read - log["truth/joint/position"]).std() == pytest.approx(second.angle_noise, rel=0.05)
    np.testing.assert_array_equal(read, run(0, second)["joint/motor_position"])
    assert not np.array_equal(read, run(1, second)["joint/motor_position"])
    assert set(log) - set(without) == {"joint/motor_position"}
    assert all(np.array_equal(values, log[name]) for name, values in without.items())
    log.save(tmp_path / "log.npz")
    np.testing.assert_array_equal(Log.load(tmp_path / "log.npz")["joint/motor_position"], read)


def test_a_scenario_says_it_and_reads_it_back(tmp_path: Path):
    path = tmp_path / "two.yaml"
    path.write_text("two:\n  sensors: {motor_encoders: {resolution: 1.0e-5}}\n")
    two = load_scenario(path)
    assert two.sensors.motor_encoders == MotorEncoderConfig(1e-5, period=two.usual_period)
    path.write_text(dump_scenario(two, "two"))
    assert load_scenario(path).sensors == two.sensors
    path.write_text("two:\n  sensors: {motor_encoders: {noise: -1}}\n")
    with pytest.raises(InputError, match=r"motor_encoders\.noise: expected a number >= 0"):
        load_scenario(path)


def test_a_map_divides_the_motors_angle_by_the_gears_ratio(tmp_path: Path):
    time = np.arange(50) * 0.01
    link = np.stack([np.sin(time), np.cos(time)], axis=1)
    motor = np.rad2deg(link + 1e-3) * [100.0, -50.0]
    rows = np.column_stack([time, link, motor])
    path = tmp_path / "arm.csv"
    np.savetxt(path, rows, delimiter=",", header="time,q1,q2,m1,m2", comments="", fmt="%.12f")
    channels = {
        "joint/position": ChannelMap(columns=["q1", "q2"]),
        "joint/motor_position": ChannelMap(
            columns=["m1", "m2"], unit="deg", gains=[1 / 100.0, -1 / 50.0]
        ),
    }
    log = convert([path], LogMap(joints=["one", "two"], channels=channels))
    np.testing.assert_allclose(log["joint/motor_position"], link + 1e-3, atol=1e-9)


def test_an_angle_before_the_gear_is_refused():
    log = log_of()
    for ratio in (100.0, -1.0):
        channels = {**log.channels, "joint/motor_position": ratio * log["joint/motor_position"]}
        with pytest.raises(
            InputError, match=r"joint/motor_position: \w+ turns .* the gear's ratio"
        ):
            check_sensors(Predictor(swinging(), Log(channels, log.meta)).motion)
    check_sensors(Predictor(swinging(), log).motion)


def test_nothing_hidden_is_nothing_found():
    diagnosis = found_in(log_of())
    assert diagnosis.verdict == "nothing_missing"
    # What one encoder cannot show at all.
    sizes = diagnosis.effects["TransmissionElasticity"].smallest_detectable
    assert sizes[KNEE] < 0.02 * COMPLIANCE


def test_a_second_encoder_that_hangs_is_said():
    log = log_of()
    motion = Predictor(swinging(), log).motion
    assert not [f for f in inspect(motion).findings if f.channel == "joint/motor_position"]
    column = log.joints.index(KNEE)
    read = log["joint/motor_position"].copy()
    read[1500:2500, column] = read[1500, column]
    stuck = Log({**log.channels, "joint/motor_position": read}, log.meta)
    found = inspect(Predictor(swinging(), stuck).motion).findings
    assert ("joint/motor_position", (KNEE,), "stuck") in [
        (f.channel, f.where, f.kind) for f in found
    ]


def test_what_is_noisier_than_believed_is_nothing_either():
    log = log_of()
    noise = np.random.default_rng(0).normal(scale=5 * NOISE, size=log["joint/position"].shape)
    channels = {
        **log.channels,
        "joint/motor_position": log["joint/motor_position"] + noise,
    }
    assert found_in(Log(channels, log.meta)).verdict == "nothing_missing"


# The ankle's torque is a tenth of the knee's.
@pytest.mark.parametrize(("joint", "duration"), [(ANKLE, 6.0), (KNEE, 3.0)])
def test_stiffness_is_found_and_nothing_else(joint: str, duration: float):
    diagnosis = found_in(log_of(("elastic", joint), duration=duration))
    assert names(diagnosis) == {("TransmissionElasticity", (joint,))}
    (finding,) = diagnosis.chosen
    estimate = finding.parameters["compliance"]
    assert estimate.interval[0] <= COMPLIANCE <= estimate.interval[1]
    assert np.ptp(estimate.interval) < 0.1 * COMPLIANCE
    assert finding.parameters["time_constant"].value == pytest.approx(TIME_CONSTANT, rel=0.25)
    assert finding.confusable_with == ()


def test_an_elastic_joint_whose_encoders_have_two_zeros():
    diagnosis = found_in(log_of(("elastic", KNEE), ("motor", KNEE)))
    assert names(diagnosis) == {
        ("TransmissionElasticity", (KNEE,)),
        ("MotorEncoderOffset", (KNEE,)),
    }
    values = {finding.effect: finding.parameters for finding in diagnosis.chosen}
    assert values["MotorEncoderOffset"]["offset"].value == pytest.approx(-0.05, abs=2e-5)
    compliance = values["TransmissionElasticity"]["compliance"].value
    assert compliance == pytest.approx(COMPLIANCE, rel=0.05)


def test_what_rounding_leaves_takes_nothing_from_an_offset():
    """Two encoders that round alike differ by their zeros and by numbers' last digits, which may be
    correlated over the whole log."""
    log, offset = log_of(), 1e-4
    read = log["joint/position"].copy()
    read[:, log.joints.index(KNEE)] += offset + 1e-9 * np.sin(0.5 * log.time)
    predictor = Predictor(swinging(), Log({**log.channels, "joint/motor_position": read}, log.meta))
    fits = Fits(Dictionary(predictor, [MotorEncoderOffset]))
    (knee,) = (c for c in fits.fixed_candidates if c.targets == (KNEE,))
    nothing, found = fits.explain([]), fits.explain([knee])
    judge, row = Judge(fits, found), knee.signature.rows
    drop, gain = (f(nothing, found)[row] for f in (judge.drop_by_row, judge.gain_by_row))
    assert drop > 1000
    assert gain == pytest.approx(drop)


def test_which_of_two_encoders_is_off():
    (link,) = found_in(log_of(("link", KNEE))).chosen
    assert (link.effect, link.targets) == ("EncoderOffset", (KNEE,))
    assert link.parameters["offset"].value == pytest.approx(4e-3, abs=2e-5)
    assert link.confusable_with == ()


def test_play_is_found_with_its_rotor():
    diagnosis = found_in(log_of(("play", ANKLE)))
    assert names(diagnosis) == {("Backlash", (ANKLE,))}
    (finding,) = diagnosis.chosen
    assert finding.parameters["gap"].value == pytest.approx(3e-3, rel=0.01)
    assert finding.parameters["rotor_inertia"].value == pytest.approx(0.2, rel=0.05)


def test_a_spring_and_play_in_one_joint_have_their_own_values():
    """The spring's time constant is sought between the values that are tried first: at the nearest
    of these 15 times the noise is left, and the rotor is a fifth too light. The ankle shakes by
    9 rad/s, for which friction, at velocities that are smoothed, is known worse than elsewhere."""
    diagnosis = found_in(log_of(("elastic", ANKLE), ("play", ANKLE), duration=6.0))
    assert names(diagnosis) == {("TransmissionElasticity", (ANKLE,)), ("Backlash", (ANKLE,))}
    values = {f.effect: f.parameters for f in diagnosis.chosen}
    spring, play = values["TransmissionElasticity"], values["Backlash"]
    assert spring["compliance"].value == pytest.approx(COMPLIANCE, rel=0.05)
    assert spring["time_constant"].value == pytest.approx(TIME_CONSTANT, rel=0.07)
    assert play["gap"].value == pytest.approx(3e-3, rel=0.02)
    assert play["rotor_inertia"].value == pytest.approx(0.2, rel=0.1)
    assert diagnosis.held_out_after < 1.2
    assert all(structure.ratio < 4.0 for structure in diagnosis.unexplained)


def test_play_under_a_torque_of_one_sign_is_not_told_from_an_offset():
    log = log_of(("play", KNEE))
    assert np.ptp(np.sign(log["joint/torque_command"][:, log.joints.index(KNEE)])) == 0
    (finding,) = found_in(log).chosen
    assert finding.targets == (KNEE,)
    assert {finding.effect, *finding.confusable_with} >= {"MotorEncoderOffset", "Backlash"}


@pytest.mark.parametrize(
    "what", [("elastic", KNEE), ("play", ANKLE), ("motor", KNEE), ("link", KNEE)]
)
def test_a_model_that_has_it_leaves_noise_between_the_encoders(what: tuple[str, str]):
    scenario, log = swinging(), log_of(what)
    without = Predictor(scenario, log).residual
    model = replace(scenario.model, effects={**scenario.model.effects, "found": HIDDEN[what]})
    residual = Predictor(replace(scenario, model=model), log).residual
    row = residual.row_index[f"{what[1]}/deflection"]
    known = residual.known[:, row]
    before, left = (
        np.sqrt(np.mean(r.value[known, row] ** 2 / r.variance[known, row]))
        for r in (without, residual)
    )
    assert before > 3.0
    assert left == pytest.approx(1.0, abs=0.15)
