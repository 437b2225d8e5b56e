"""Noise that is in an effect's own columns: what it feigns, and that it shows nothing.

And how large what is left is where noise is quick.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario

from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.detectability import smallest_detectable
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.fits import _SPURIOUS, Fits, _noise_drop
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.regression import Signature
from fbse_drake.effects.contact import GroundCompliance
from fbse_drake.effects.inertia import BodyCentreOfMass

BLOCKS = 400
SQUAT = (
    "duration=6",
    "estimator=!NoEstimator {}",
    "reference=!Squat {amplitude: 0.0073, ramp: 1.0, com_height: 0.365, foot_spacing: 0.34, "
    "wheelbase: 0.5, zmp_forward: -0.0156, zmp_margin: 0.068}",
)
TROT = ("duration=1.6", "reference.initial_double_support=0.3", "reference.single_supports=3")


def columns(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two columns (B, 1, 2) that see one large signal, what is noise in them, and a residual of
    which that noise is a part, (B, 1)."""
    signal = 100.0 * np.sin(np.arange(BLOCKS) / 20.0)
    own = generator.normal(0.0, 1.0, (BLOCKS, 2))
    rest = generator.normal(0.0, 0.5, BLOCKS)
    values = np.stack([signal, 2.0 * signal], axis=1) + own
    return values[:, None], own[:, None], (own[:, 1] + rest)[:, None]


def test_noise_feigns_a_drop_by_what_is_left_of_columns_beside_each_other():
    """Neither column alone explains anything of the residual, the two together a third of it: what
    is expected of another realization of the noise is what least squares then finds."""
    rows = np.zeros(1, dtype=int)
    values, noise, realization = columns(np.random.default_rng(0))
    expected = _noise_drop(Signature(rows, values), Signature(rows, noise), realization) / _SPURIOUS
    drops, alone = [], []
    for seed in range(1, 30):
        x, _, y = columns(np.random.default_rng(seed))
        drops.append((y**2).sum() - np.linalg.lstsq(x[:, 0], y[:, 0], rcond=None)[1][0])
        alone.append(max((x[:, 0, k] @ y[:, 0]) ** 2 / (x[:, 0, k] ** 2).sum() for k in (0, 1)))
    assert expected == pytest.approx(np.mean(drops), rel=0.2)
    assert np.mean(alone) < 0.05 * expected


@pytest.mark.parametrize("seed", range(3))
def test_it_does_not_depend_on_how_the_parameters_are_chosen(seed: int):
    generator, rows = np.random.default_rng(seed), np.zeros(1, dtype=int)
    values, noise, realization = columns(generator)
    mixed = generator.normal(size=(2, 2))
    drops = [
        _noise_drop(Signature(rows, values @ mix), Signature(rows, noise @ mix), realization)
        for mix in (np.eye(2), mixed)
    ]
    assert drops[1] == pytest.approx(drops[0], rel=1e-6)


@pytest.fixture(scope="module")
def squat(run) -> tuple[Scenario, Log]:
    """A quadruped that squats on springs, and what is believed of it: firm ground."""
    log = run("quadruped_trot", *SQUAT, "robot.effects.soft=!GroundCompliance {compliance: 1.2e-6}")
    config = scenario("quadruped_trot", *SQUAT)
    return replace(config, model=config.robot), log


def test_a_centre_of_mass_is_asked_for_more_than_noise_feigns_where_it_is(
    squat: tuple[Scenario, Log],
):
    """High above its body a mass feels how the body turns, which is noise where it stands."""
    fits = Fits(Dictionary(Predictor(*squat), [BodyCentreOfMass]))
    nothing = fits.explain([])
    for hip in (c for c in fits.fixed_candidates if "hip" in c.targets[0]):
        assert fits.about(hip, np.zeros(3)).spurious == pytest.approx(hip.spurious, rel=0.05)
        high = fits.about(hip, np.array([0.0, 0.0, 0.3]))
        assert not 0.8 < high.spurious / hip.spurious < 1.25
        assert nothing.deviance - fits.explain([high]).deviance < fits.required(high)


def test_springs_under_a_steady_load_are_not_said_to_be_absent(squat: tuple[Scenario, Log], run):
    """The load on its feet hardly changes: what moves in the prediction is noise of the force
    sensors, which shows nothing. In a trot feet are loaded and relieved."""
    found = diagnose(Predictor(*squat), [GroundCompliance])
    assert found.verdict == "not_visible"
    assert found.effects["GroundCompliance"].smallest_detectable["robot"] > 1.2e-6
    trot = scenario("quadruped_trot", *TROT)
    log = run("quadruped_trot", *TROT, "estimator=!NoEstimator {}")
    walking = Fits(Dictionary(Predictor(replace(trot, model=trot.robot), log), [GroundCompliance]))
    smallest = smallest_detectable(walking, walking.explain([]), GroundCompliance)
    assert smallest["robot"] < 0.3e-6


def test_what_is_left_is_measured_by_its_size_not_by_how_slow_it_is(squat: tuple[Scenario, Log]):
    """Four thousandths of a joint's torque, held for seconds, are far beyond the noise of rates
    whose differences are accelerations; a thirtieth is large enough to matter."""
    fits = Fits(Dictionary(Predictor(*squat), [GroundCompliance]))
    significance, white = fits.dictionary.significance, fits.white
    row = white.residual.row_index["rear_left_knee"]
    torque = fits.dictionary.predictor.motion.blocks.torque_command[:, row]
    for share, matters in ((0.004, False), (0.03, True)):
        slow = share * np.sqrt((torque**2).mean()) * np.ones(len(torque))
        left = white.y.copy()
        left[:, row] += white.whiten(row, slow)
        assert (left[:, row] ** 2).sum() > 1.5 * (white.y[:, row] ** 2).sum()
        assert significance.matters(significance.left_share(row, left, white)) == matters
    assert significance.left_share(row, left, white) == pytest.approx(0.03, rel=0.2)
