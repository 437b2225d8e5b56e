"""Noise that is larger than believed is said once, and used; it is not taken for an effect, and
hides none."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.discrepancy.residual.evidence import HygieneFinding
from fbse_drake.discrepancy.residual.noise import channel_noise, noise_power
from fbse_drake.effects.effect import library
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.log import Log
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
