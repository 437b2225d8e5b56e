"""Logs whose time stamps scatter, though their samples do not, and the other way round. Truth:
sines that are sampled at known times."""

from dataclasses import replace

import numpy as np
import pytest

from fbse_drake import load_scenario
from fbse_drake.discrepancy.diagnosis import reading
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.discrepancy.residual.time_stamps import sampled_evenly
from fbse_drake.log import Log
from fbse_drake.scenario import RecordingConfig

PERIOD, SAMPLES = 0.004, 2000


def scatter(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.3, 0.3, SAMPLES) * PERIOD


def log_of(stamps: np.ndarray, sampled: np.ndarray, noise: float = 0.0) -> Log:
    """Of two joints whose angles were sampled at other times than the stamps say."""
    angles = np.stack([np.sin(3.0 * sampled), 0.3 * np.cos(7.0 * sampled)], axis=1)
    angles += noise * np.random.default_rng(1).standard_normal(angles.shape)
    meta = {"joints": ["a", "b"], "sides": [], "period": PERIOD}
    return Log({"time": stamps, "joint/position": angles}, meta)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_stamps_that_scatter_about_an_even_clock_are_made_even(noise: float) -> None:
    """Also where the clock runs faster than the log says."""
    even = 5.0 + 1.01 * PERIOD * np.arange(SAMPLES)
    found = sampled_evenly(log_of(even + scatter(), even, noise))
    np.testing.assert_allclose(found.time, even, atol=0.05 * PERIOD)
    assert found.meta["period"] == pytest.approx(1.01 * PERIOD, rel=1e-4)


def test_samples_that_scatter_keep_their_stamps() -> None:
    at = PERIOD * np.arange(SAMPLES) + scatter()
    for noise in (0.0, 1e-4, 1e-2):
        log = log_of(at, at, noise)
        assert sampled_evenly(log) is log


def test_what_shows_nothing_or_has_gaps_keeps_its_stamps() -> None:
    even = PERIOD * np.arange(SAMPLES)
    resting = log_of(even + scatter(), np.zeros(SAMPLES), 1e-4)
    late = even + 3 * PERIOD * (np.arange(SAMPLES) > SAMPLES // 2)
    for log in (resting, log_of(even, even), log_of(late + scatter(), late)):
        assert sampled_evenly(log) is log


def test_the_residual_of_an_arm_is_that_of_even_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the stamps it is ten times as large; and the hygiene says how they are read."""
    scenario = load_scenario("bsc_arm", overrides=["duration=8", f"log.period={PERIOD}"])
    bare = replace(scenario.robot, effects={})
    recording = RecordingConfig(rows="instantaneous", velocity="differenced")
    scenario = replace(scenario, robot=bare, model=bare, recording=recording)
    log = planned_log(scenario)
    moved = log.time.copy()
    moved[:SAMPLES] += scatter()
    scattered = Log(log.channels | {"time": moved}, log.meta)
    even, found = (Predictor(scenario, one).motion for one in (log, scattered))
    left = np.abs(even.residual.value).max(axis=0)
    assert (np.abs(found.residual.value).max(axis=0) < 1.5 * left).all()
    (note,) = (finding for finding in inspect(found).findings if finding.kind == "jitter")
    assert note.severity == "note"
    assert "taken to be even" in note.text
    monkeypatch.setattr(reading, "sampled_evenly", lambda log: log)
    by_stamps = Predictor(scenario, scattered).motion.residual.value
    assert (np.abs(by_stamps).max(axis=0) > 10 * left).all()
