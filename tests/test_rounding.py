"""Angles that are rounded look like laws where a joint moves evenly; they are not taken for any."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.recorded.cases import record
from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.rounding import chance_bound
from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.recorded_velocity import Lateness
from fbse_drake.effects.friction import CoulombFriction, ViscousFriction
from fbse_drake.effects.transmission import TorqueRipple

# A machine of which nothing is hidden, whose first joint moves by up to fifteen counts a sample.
NUMBER = 8004


@dataclass(frozen=True)
class Rail:
    """What was recorded of that machine."""

    scenario: Scenario
    log: Log
    # Of its encoders.
    count: float

    def read(self, seed: int, ripple: float = 0.0) -> Predictor:
        """What it would be if the encoders' steps began elsewhere: the motion is that of a smooth
        curve through what they read.

        Args:
            ripple: amplitude of a torque in the first joint that repeats 60 times by unit [N].
        """
        angle = Predictor(self.scenario, self.log).motion.without_noise(self.log["joint/position"])
        moved = angle / self.count + np.random.default_rng(seed).random(angle.shape[1])
        torque = self.log["joint/torque_command"].copy()
        torque[:, 0] += ripple * np.sin(60.0 * angle[:, 0])
        channels = {
            "joint/position": self.count * np.round(moved),
            "joint/torque_command": torque,
        }
        return Predictor(self.scenario, replace(self.log, channels=self.log.channels | channels))

    def diagnosed(self, seed: int, ripple: float = 0.0) -> Diagnosis:
        return diagnose(self.read(seed, ripple), [TorqueRipple, CoulombFriction, ViscousFriction])


@pytest.fixture(scope="module")
def rail(tmp_path_factory: pytest.TempPathFactory) -> Rail:
    folder: Path = tmp_path_factory.mktemp("rail")
    recording = record(NUMBER, folder)
    assert not recording.hidden
    return Rail(recording.scenario, recording.log, recording.recorder.count)


def test_where_the_steps_of_encoders_begin_says_nothing(rail: Rail) -> None:
    found = [rail.diagnosed(seed) for seed in range(8)]
    said = [(one.verdict, [finding.effect for finding in one.chosen]) for one in found]
    assert said == [("nothing_missing", [])] * 8


def test_a_ripple_beside_rounded_angles_is_found(rail: Rail) -> None:
    found = rail.diagnosed(0, ripple=15.0)
    assert [(f.effect, f.targets) for f in found.chosen] == [("TorqueRipple", ("joint_1",))]
    values = found.chosen[0].parameters
    assert values["cycles"].value == pytest.approx(60.0, rel=0.01)
    amplitude = np.hypot(values["sine"].value, values["cosine"].value)
    assert amplitude == pytest.approx(15.0, rel=0.2)


def test_what_angles_feign_is_nothing_where_velocities_are_measured(rail: Rail) -> None:
    predictor = rail.read(0)
    assert len(predictor.motion.rounding_noise)
    measured = replace(
        rail.log,
        channels=rail.log.channels
        | {"joint/velocity": predictor.motion.signals.joint_velocity + 0.01},
    )
    recording = replace(rail.scenario.recording, velocity="measured")
    other = Predictor(replace(rail.scenario, recording=recording), measured)
    assert len(other.motion.rounding_noise) == 0
    fits = Fits(Dictionary(other, [TorqueRipple]))
    candidate = fits.candidate(
        TorqueRipple, ("joint_1",), np.array([60.0]), fits.remainder(fits.explain([]))
    )
    assert fits.feigned(candidate) == 0.0


@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_rounding_shows_in_velocities_behind_a_filter(speed: float) -> None:
    """A recorder takes differences of rounded angles at 20 kHz, filters them, and writes every
    hundredth: of a joint that moves by so many steps from row to row, which is more slowly than
    the filter follows, and faster."""
    late, period, every = 3e-3, 5e-3, 100
    time = np.arange(0.0, 60.0, period / every)
    counts = speed / period * (time + 0.3 * np.sin(time)) + 0.4
    kept = np.exp(-period / every / late)
    rate = np.gradient(np.round(counts) - counts, period / every)
    error = lfilter([1 - kept], [1, -kept], rate)[::every, None]
    lateness = Lateness(np.array([late]), np.array([1e-5]))
    # In time again, as what was recorded is.
    error, known = lateness.in_time(error, np.ones(len(error), dtype=bool), period)
    starts = np.random.default_rng(0).random(8)
    drawn = [lateness.rounding_error(counts[::every, None] + start, period) for start in starts]

    def powers(values: np.ndarray) -> list[float]:
        """Of the error, and of its means over ten rows."""
        inside = values[known][20:, 0]
        return [float(np.mean(block_means(inside, size) ** 2)) for size in (1, 10)]

    found = np.mean([powers(values) for values in drawn], axis=0)
    np.testing.assert_allclose(found, powers(error), rtol=0.25)


def test_the_largest_of_many_is_bounded_by_some_draws_of_it() -> None:
    """Of 200 squares of normal numbers: the bound is exceeded about as often as it says."""
    random = np.random.default_rng(2)
    largest = (random.standard_normal((40_000, 200)) ** 2).max(axis=1)
    bounds = np.array([chance_bound(largest[k : k + 16], 0.01) for k in range(0, 1600, 16)])
    exceeded = np.mean([(largest[2000:] > bound).mean() for bound in bounds])
    assert 0.005 < exceeded < 0.04
