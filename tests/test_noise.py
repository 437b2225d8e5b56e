"""Noise that is larger than believed is said once, and used; it is not taken for an effect, and
hides none."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from recorded_arm import ARM

from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose, diagnosis_json
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.selection import is_shown
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.identification.untold_noise import likeliest_noise
from fbse_drake.discrepancy.residual.evidence import HygieneFinding
from fbse_drake.discrepancy.residual.noise import Noise, channel_noise, noise_power
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import library
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.effects.transmission import Backlash
from fbse_drake.log import Log
from fbse_drake.report.sentences import diagnosis_outcome
from fbse_drake.scenario import RecordingConfig, RobotConfig, Scenario, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.simulation import simulate
from fbse_drake.walking.reference import JointSines

TORQUE_NOISE, VELOCITY_NOISE = 0.03, 1e-3
TRIED = ("CoulombFriction", "ViscousFriction", "TorqueGain", "TorqueLag", "TorqueBias")


@cache
def run(coulomb: float = 0.0) -> tuple[Scenario, Log]:
    """A double pendulum without noise, and what is believed of it."""
    hidden = {"rub": CoulombFriction({"shoulder": coulomb, "elbow": 0.0})} if coulomb else {}
    scenario = Scenario(
        duration=5.0,
        robot=RobotConfig("double_pendulum", effects=hidden),
        reference=JointSines(
            amplitude={"shoulder": 0.8, "elbow": 0.6},
            frequency={"shoulder": 0.6, "elbow": 0.9},
            ramp=0.5,
        ),
        control=PositionLoopConfig(kp={"all": 20.0}, kd={"all": 0.5}),
    )
    believed = replace(
        scenario,
        model=RobotConfig("double_pendulum"),
        sensors=SensorsConfig(encoders=EncoderConfig(velocity_noise=VELOCITY_NOISE)),
        recording=RecordingConfig(torque_noise={"all": TORQUE_NOISE}),
    )
    return believed, simulate(scenario).log


def noisy(log: Log, seed: int, torque: float, velocity: float) -> Log:
    """With so many times the noise that is believed."""
    random = np.random.default_rng(seed)
    added = {
        "joint/torque_command": torque * TORQUE_NOISE,
        "joint/velocity": velocity * VELOCITY_NOISE,
    }
    channels = {
        name: log[name] + deviation * random.standard_normal(log[name].shape)
        for name, deviation in added.items()
    }
    return replace(log, channels=log.channels | channels)


def said_and_found(
    torque: float, velocity: float, coulomb: float = 0.0
) -> tuple[list[HygieneFinding], Diagnosis]:
    """What is said of the noise, and what is found."""
    scenario, log = run(coulomb)
    predictor = Predictor(scenario, noisy(log, 7, torque, velocity))
    return said_of(predictor), diagnose(predictor, [library()[name] for name in TRIED])


def said_of(predictor: Predictor) -> list[HygieneFinding]:
    findings = inspect(predictor.motion, predictor.noise).findings
    return [finding for finding in findings if finding.kind == "noise_level"]


def test_noise_as_believed_is_not_worth_a_word() -> None:
    said, diagnosis = said_and_found(1.0, 1.0)
    assert not said
    assert diagnosis.verdict == "nothing_missing"


@pytest.mark.parametrize(("torque", "velocity"), [(1.6, 1.0), (3.0, 1.0), (1.0, 3.0), (2.0, 2.0)])
def test_more_noise_is_said_once_and_used(torque: float, velocity: float) -> None:
    said, diagnosis = said_and_found(torque, velocity)
    (finding,) = said
    assert "what was measured is used" in finding.text
    assert 0.8 * min(torque, velocity) < finding.size < 1.25 * max(torque, velocity)
    assert (diagnosis.verdict, diagnosis.chosen, diagnosis.unexplained) == (
        "nothing_missing",
        [],
        (),
    )
    assert diagnosis.held_out_after == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("torque", "velocity"), [(2.0, 1.0), (1.0, 2.5)])
def test_effect_is_found_beside_more_noise(torque: float, velocity: float) -> None:
    said, diagnosis = said_and_found(torque, velocity, coulomb=0.08)
    assert len(said) == 1
    (finding,) = diagnosis.chosen
    assert (finding.effect, finding.targets) == ("CoulombFriction", ("shoulder",))
    low, high = finding.parameters["coulomb"].interval
    assert low < 0.08 < high


def test_noise_of_a_sensor_is_told_from_that_of_the_torque() -> None:
    """The channel of a sensor shows its noise by itself; what the rows have beyond it is the
    torque's."""
    scenario, log = run()
    by_torque, by_velocity = (
        Predictor(scenario, noisy(log, 3, *times)).noise for times in ((3.0, 1.0), (1.0, 3.0))
    )
    np.testing.assert_allclose(np.sqrt(by_torque.white), np.sqrt(8) * TORQUE_NOISE, rtol=0.25)
    assert not by_torque.channels
    (channel,) = by_velocity.channels
    assert channel.channel == "joint/velocity"
    assert channel.level == pytest.approx(3 * VELOCITY_NOISE, rel=0.05)
    np.testing.assert_allclose(by_velocity.white, 0.0)


def test_noise_that_nobody_believes_in_is_measured() -> None:
    scenario, log = run()
    ideal = replace(scenario, recording=RecordingConfig(), sensors=SensorsConfig())
    noise = np.random.default_rng(4).normal(
        scale=TORQUE_NOISE, size=log["joint/torque_command"].shape
    )
    channels = {"joint/torque_command": log["joint/torque_command"] + noise}
    for seen, worth in ((replace(log, channels=log.channels | channels), True), (log, False)):
        predictor = Predictor(ideal, seen)
        # What the contact solver's tolerance leaves is a millionth of the torque.
        assert len(said_of(predictor)) == worth
        np.testing.assert_allclose(
            np.sqrt(predictor.noise.white), TORQUE_NOISE * worth, rtol=0.25, atol=1e-5
        )


def test_slow_effects_jumps_and_gaps_are_no_noise() -> None:
    random = np.random.default_rng(5)
    rows = 300
    shape, time = (600, rows), np.arange(600)[:, None]
    noise = random.standard_normal(shape)
    slow = 50 * np.sin(time / 12 + np.arange(rows)) + 20 * np.sign(np.sin(time / 40))
    known = np.broadcast_to((time % 150) > 10, shape)
    alone, beside = (noise_power(values, known, np.ones(shape)) for values in (noise, noise + slow))
    assert alone.ratio.mean() == pytest.approx(1.0, abs=0.06)
    # As many degrees of freedom as it says.
    assert alone.ratio.var() == pytest.approx(2 / alone.freedom[0], rel=0.3)
    assert beside.ratio.mean() < 1.35


@pytest.mark.parametrize("ringing", [1, 2])
def test_a_joint_that_rings_is_said_to_and_is_no_noise(ringing: int) -> None:
    """A velocity that alternates from sample to sample, in one joint or in both, does not make the
    rows noisier; white noise beside it is measured in the joint that does not ring."""
    scenario, log = run()
    log = noisy(log, 3, torque=1.0, velocity=2.0)
    assert channel_noise(log, "joint/velocity") == pytest.approx(2 * VELOCITY_NOISE, rel=0.1)
    velocity = log["joint/velocity"].copy()
    velocity[::2, :ringing] += 0.3
    rung = replace(log, channels=log.channels | {"joint/velocity": velocity})
    level = channel_noise(rung, "joint/velocity")
    assert np.isnan(level) if ringing == 2 else level == pytest.approx(2e-3, rel=0.1)
    said = {
        name: [f for f in inspect(Predictor(scenario, one).motion).findings if f.kind == "ringing"]
        for name, one in (("clean", log), ("rung", rung))
    }
    assert not said["clean"]
    assert len(said["rung"]) == 1
    assert said["rung"][0].size == pytest.approx(0.15, rel=0.02)
    assert len(said["rung"][0].where) == ringing
    assert said["rung"][0].severity == "warning"
    # A transmission that yields may ring, and is to be found; nothing is fitted to a joint whose
    # ringing drowns its motion.
    for size, drowned in ((8.0, False), (80.0, True)):
        loud = velocity.copy()
        loud[::2, 0] += size
        changed = replace(log, channels=log.channels | {"joint/velocity": loud})
        hygiene = inspect(Predictor(scenario, changed).motion)
        said = [f.where for f in hygiene.untrustworthy if f.kind == "ringing"]
        assert said == ([(log.joints[0],)] if drowned else [])
        assert (log.joints[0] in hygiene.untrusted_joints()) == drowned


def arm(torque_noise: float, bits: int = 0, seed: int = 1) -> tuple[Predictor, np.ndarray]:
    """An arm of which nobody says how it was recorded, with a torque bias in its fifth axis, and
    the deviations of its torques' noise; with rounded angles and no velocities if so wished."""
    machine = replace(ARM, period=2e-3, duration=10.0)
    deviations = torque_noise * np.array(ARM.torque_noise)
    course = machine.course(seed)
    given = course.torque + 0.6 * np.eye(6)[4]
    noise = deviations * np.random.default_rng(seed).standard_normal(given.shape)
    log = machine.log(course, seed=seed, read=lambda _: given + noise)
    channels = dict(log.channels)
    if bits:
        step = 2 * np.pi / 2**bits
        channels["joint/position"] = step * np.round(log["joint/position"] / step)
        del channels["joint/velocity"]
    scenario = replace(
        machine.scenario, sensors=SensorsConfig(), recording=RecordingConfig(rows="instantaneous")
    )
    return Predictor(scenario, replace(log, channels=channels)), deviations


def test_noise_of_torques_shows_beside_that_of_accelerations() -> None:
    """Accelerations of noisy velocities hide it in differences of neighbouring averages, and
    everything that is slow would be many times the noise."""
    predictor, deviations = arm(1.0)
    residual = predictor.residual
    hidden = slice(0, 3)
    assert (-residual.covariance[:-1, hidden] > 0.2 * residual.variance[:-1, hidden]).all()
    measured = np.sqrt(predictor.noise.white)
    assert (measured > 0.7 * deviations).sum() >= 5
    assert (measured < 1.6 * deviations).all()
    diagnosis = diagnose(predictor, [library()[name] for name in TRIED])
    (found,) = diagnosis.chosen
    assert (diagnosis.verdict, found.effect, found.targets) == (
        "effect_found",
        "TorqueBias",
        ("axis_5",),
    )


def test_noise_that_only_what_is_left_shows_is_used() -> None:
    predictor, _ = arm(0.3, bits=20)
    diagnosis = diagnose(predictor, [library()[name] for name in TRIED])
    assert (diagnosis.verdict, diagnosis.unexplained) == ("effect_found", ())
    assert [finding.effect for finding in diagnosis.chosen] == ["TorqueBias"]
    assert diagnosis.held_out_after == pytest.approx(1.0, abs=0.15)
    assert diagnosis.noisier
    assert "it was taken for noise" in diagnosis_outcome(diagnosis)
    assert diagnosis_json(diagnosis)["noisier"] == list(diagnosis.noisier)


@pytest.mark.parametrize("bits", [14, 17])
def test_angles_that_are_differenced_have_the_noise_of_their_steps(bits: int) -> None:
    predictor, _ = arm(0.0, bits=bits)
    encoders = predictor.motion.sensors.encoders
    step = 2 * np.pi / 2**bits
    assert encoders.angle_noise == pytest.approx(step / np.sqrt(12), rel=0.15)
    of_velocity = encoders.angle_noise / (np.sqrt(2) * 2e-3)
    assert encoders.velocity_noise == pytest.approx(of_velocity)
    # Of joints that move over many steps from one sample to the next.
    residual = predictor.residual
    whitened = WhitenedResidual(residual)
    spread = np.median(np.abs(whitened.y), axis=0)[:2] / 0.6745
    np.testing.assert_allclose(spread, 1.0, atol=0.3)


def left_in_a_row(
    white: float, wave: float, seed: int, sensors: float = 1.0, believed: float = 0.0
) -> Residual:
    """Noise as of differenced velocities, of a variance beside the believed 1, with white noise, of
    which so much is believed, and a wave beside."""
    residual, random = arm(0.0)[0].motion.residual, np.random.default_rng(seed)
    blocks = len(residual.time)
    steps = np.sqrt(0.5 * sensors) * np.diff(random.standard_normal(blocks + 1))
    value = np.zeros_like(residual.value)
    value[:, 0] = steps + np.sqrt(white) * random.standard_normal(blocks)
    value[:, 0] += wave * np.sin(0.7 * np.arange(blocks))
    variance, covariance = np.full_like(value, 1.0 + believed), np.full_like(value, -0.5)
    return replace(residual, value=value, variance=variance, covariance=covariance)


def test_the_likeliest_noise_is_that_which_is_there() -> None:
    found = [likeliest_noise(left_in_a_row(0.05, 0.0, seed), 5, [0]) for seed in range(10)]
    white = [noise.white[0] / 5 for noise in found if noise is not None]
    assert len(white) == 10
    assert np.mean(white) == pytest.approx(0.05, rel=0.1)
    assert all(noise.white[1:].max() == 0.0 for noise in found if noise is not None)


@pytest.mark.parametrize(("white", "wave"), [(0.0, 0.0), (0.0, 0.5), (0.05, 0.5)])
def test_what_is_as_believed_or_no_noise_is_not_taken_for_more_noise(
    white: float, wave: float
) -> None:
    assert likeliest_noise(left_in_a_row(white, wave, 3), 5, [0]) is None
    assert likeliest_noise(left_in_a_row(0.05, 0.0, 3), 5, []) is None


def test_jolts_are_no_noise() -> None:
    """Impacts now and then, at random, are white too; their tails are none of noise. Small ones are
    let pass: what happens between rare samples has such tails."""
    random = np.random.default_rng(5)
    for jolt, is_noise in ((0.0, True), (6.0, True), (50.0, False)):
        residual = left_in_a_row(0.05, 0.0, 3)
        hit = random.random(len(residual.time)) < 0.01
        value = residual.value.copy()
        value[:, 0] += jolt * random.standard_normal(len(hit)) * hit
        found = likeliest_noise(replace(residual, value=value), 5, [0])
        assert (found is not None) == is_noise


def test_sensors_may_be_less_noisy_than_they_look() -> None:
    """Noise of a filtered velocity is measured where it is loudest. What white noise there is
    beside shows all the same."""
    found = [likeliest_noise(left_in_a_row(0.05, 0.0, seed, 0.4), 5, [0]) for seed in range(10)]
    white = [noise.white[0] / 5 for noise in found if noise is not None]
    sensors = [noise.sensors[0] for noise in found if noise is not None]
    assert len(white) == 10
    assert np.mean(white) == pytest.approx(0.05, rel=0.1)
    assert np.mean(sensors) == pytest.approx(0.4, rel=0.05)


def test_white_noise_is_found_behind_sensors_that_are_less_noisy_than_believed() -> None:
    """In all there is no more noise than is believed: only what is slow is more."""
    left = [left_in_a_row(0.15, 0.0, seed, 0.4, believed=0.05) for seed in range(10)]
    assert all((WhitenedResidual(row).y[:, 0] ** 2).mean() < 1.0 for row in left)
    found = [likeliest_noise(row, 5, [0]) for row in left]
    white = [noise.white[0] / 5 + 0.05 * noise.sensors[0] for noise in found if noise is not None]
    assert len(white) == 10
    assert np.mean(white) == pytest.approx(0.15, rel=0.1)
    quieter = [left_in_a_row(0.02, 0.0, seed, 0.4, believed=0.05) for seed in range(10)]
    assert [likeliest_noise(row, 5, [0]) for row in quieter] == [None] * 10


def test_noise_that_is_found_twice_adds_up() -> None:
    """Also when the model changes, and its rows' noise is measured anew."""
    predictor, _ = arm(0.3)
    rows = predictor.rows
    once, twice = (
        Noise((), np.full(rows, white), np.full(rows, sensors), np.full(rows, 2.0))
        for white, sensors in ((0.02, 0.5), (0.03, 2.0))
    )
    noisier = predictor.noisier(once).noisier(twice)
    white = (predictor.noise.white * 0.5 + 0.02) * 2.0 + 0.03
    np.testing.assert_allclose(noisier.noise.white, white)
    np.testing.assert_allclose(noisier.noise.sensors, predictor.noise.sensors)
    model = replace(predictor.scenario.believed, effects={"bias": TorqueBias({"all": 0.1})})
    changed = replace(predictor.scenario, model=model)
    anew = Predictor(changed, predictor.log)
    white = (anew.noise.white * 0.5 + 0.02) * 2.0 + 0.03
    np.testing.assert_allclose(noisier.of(changed).noise.white, white)


def test_nothing_is_no_noise() -> None:
    residual = left_in_a_row(0.0, 0.0, 1)
    nothing = np.zeros_like(residual.value)
    silent = replace(residual, value=nothing, variance=nothing, covariance=nothing)
    assert likeliest_noise(silent, 5, [0]) is None


def test_coloured_undoes_whitening() -> None:
    residual = left_in_a_row(0.3, 0.0, 1)
    known = residual.known.copy()
    known[50:60, 0] = False
    gappy = replace(residual, known=known)
    white = WhitenedResidual(gappy)
    np.testing.assert_allclose(white.coloured(white.y)[known], gappy.value[known], atol=1e-12)
    assert not white.coloured(white.y)[~known].any()


def test_blocks_of_differenced_angles_share_none() -> None:
    """A velocity is had from the angles before and after it: at 100 Hz a block of 10 ms would share
    them with its neighbours, and their noise would not be what is believed."""
    machine = replace(ARM, period=1e-2, duration=20.0, torque_noise=(0.0,) * 6)
    log = machine.log(machine.course(1))
    step = 2 * np.pi / 2**14
    position = step * np.round(log["joint/position"] / step)
    channels = {name: log[name] for name in ("time", "joint/torque_command")}
    recording = RecordingConfig(rows="instantaneous")
    scenario = replace(machine.scenario, sensors=SensorsConfig(), recording=recording)
    motion = Predictor(
        scenario, replace(log, channels=channels | {"joint/position": position})
    ).motion
    assert motion.length == 3
    left = motion.residual
    np.testing.assert_allclose(left.value.std(axis=0), left.noise_floor, rtol=0.12)
    neighbours = (left.value[1:] * left.value[:-1]).mean(axis=0) / (left.value**2).mean(axis=0)
    np.testing.assert_allclose(neighbours, -0.5, atol=0.1)


def test_noise_of_a_machine_that_turns_does_not_add_up_to_nothing() -> None:
    """Rates are differences of velocities, whose noise the next block takes off again, but by
    another mass matrix: what is left of it is slow, and slow laws are told by what is slow."""
    machine = replace(
        ARM,
        posture=(0.0, 0.8, 0.9, 0.0, 0.6, 0.0),
        amplitude=(1.2, 1.0, 1.2, 1.5, 1.2, 1.5),
        rotor_inertia=(0.1, 0.1, 0.05, 0.02, 0.02, 0.01),
        torque_noise=(0.0,) * 6,
    )
    course, logs = machine.course(), 12
    residuals = [machine.predictor(machine.log(course, seed=seed)).residual for seed in range(logs)]
    white = WhitenedResidual(residuals[0])
    y = np.array([[white.whiten(j, left.value[:, j]) for j in range(6)] for left in residuals])
    # But for what is the same in all.
    noise = (y - y.mean(axis=0)) * np.sqrt(logs / (logs - 1))
    power = np.abs(np.fft.rfft(noise, axis=2)) ** 2 / noise.shape[2]
    slow, fast = (power[:, :, part].mean(axis=(0, 2)) for part in (slice(1, 16), slice(16, None)))
    np.testing.assert_allclose(fast, 1.0, atol=0.1)
    # Of the 360 squares in the slow part of each joint. If nothing were left, it would be 1.3 to 3.
    assert np.all((0.7 < slow) & (slow < 1.6)), slow


@pytest.mark.parametrize("bits", [0, 12])
def test_play_finer_than_the_steps_of_an_encoder_does_not_show(bits: int) -> None:
    predictor, _ = arm(1.0, bits=bits)
    fits = Fits(Dictionary(predictor, [Backlash]))
    rest = fits.remainder(fits.explain([]))

    def shows(gap: float) -> bool:
        nonlinear = np.array([gap, 0.2, 1e-3])
        return is_shown(fits, fits.candidate(Backlash, ("axis_4",), nonlinear, rest))

    assert shows(5e-3)
    assert shows(5e-4) == (bits == 0)
