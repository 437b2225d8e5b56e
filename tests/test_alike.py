"""Laws of which a log shows a part: what they may be is told, and what the log speaks against is
not named.

Truth comes from planned motions and from torques that are added to them here, by formulas of this
file.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import swinging_legs

from benchmarks.recorded.cases import record
from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import library

NOISE, KNEE = 0.05, "left_knee_pitch"
OF_ANGLE = ("TorqueBias", "JointSpring", "TorqueRipple", "Counterbalance")
DIRECTIONAL = "DirectionalViscousFriction"
# A torque that is lost [Nm] at angles [rad] and link torques [Nm].
Loss = Callable[[np.ndarray, np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def swing() -> tuple[Scenario, Log]:
    return swinging_legs(12, NOISE, "reference.amplitude.knee_pitch=0.15")


def travel(swing: tuple[Scenario, Log]) -> float:
    _, log = swing
    return float(np.ptp(log["joint/position"][:, log.joints.index(KNEE)]))


def diagnosis_of(swing: tuple[Scenario, Log], loss: Loss, *effects: str) -> Diagnosis:
    """What is found in the planned motion with a loss in a knee, and noise."""
    scenario, log = swing
    place, torque = log.joints.index(KNEE), log["joint/torque_command"].copy()
    torque[:, place] += loss(log["joint/position"][:, place], torque[:, place])
    torque += NOISE * np.random.default_rng(3).standard_normal(torque.shape)
    log = Log(log.channels | {"joint/torque_command": torque}, log.meta)
    return diagnose(Predictor(scenario, log), [library()[name] for name in effects])


def alternatives(diagnosis: Diagnosis) -> dict[str, set[str]]:
    """What each finding may be instead."""
    assert all(finding.targets == (KNEE,) for finding in diagnosis.chosen)
    return {finding.effect: set(finding.confusable_with) for finding in diagnosis.chosen}


def ripple(swing: tuple[Scenario, Log], waves: float, size: float = 1.0) -> Loss:
    """So many waves within the travel of the knee."""
    return lambda angle, _: size * np.sin(2 * np.pi * waves / travel(swing) * angle)


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_a_third_of_a_wave_may_be_a_ripple_whatever_it_is_called(
    swing: tuple[Scenario, Log], size: float
):
    """It is no straight line, so that something that is not there would be named beside a spring;
    nothing is named that could not be the ripple."""
    found = alternatives(
        diagnosis_of(swing, ripple(swing, 1 / 3, size), *OF_ANGLE, DIRECTIONAL, "QuadraticDrag")
    )
    assert "JointSpring" in found
    assert "TorqueRipple" not in found
    assert all("TorqueRipple" in of_one for of_one in found.values())


def test_three_waves_are_a_ripple_and_nothing_else(swing: tuple[Scenario, Log]):
    found = alternatives(diagnosis_of(swing, ripple(swing, 3.0), *OF_ANGLE, DIRECTIONAL))
    assert found == {"TorqueRipple": set()}


def test_a_spring_may_be_a_part_of_a_wave_and_a_constant_torque_is_not_one(
    swing: tuple[Scenario, Log],
):
    """Near where it crosses zero a wave is a straight line. Where a spring is loaded all the time,
    the slowest ripple of gears would bend away by three times the noise; a counterbalance would
    not."""
    _, log = swing
    middle = log["joint/position"][:, log.joints.index(KNEE)].mean()
    relaxed, loaded, bias = (
        alternatives(diagnosis_of(swing, loss, *OF_ANGLE))
        for loss in (
            lambda angle, _: 2.0 * (angle - middle),
            lambda angle, _: 2.0 * angle,
            lambda angle, _: 1.0 + 0.0 * angle,
        )
    )
    assert relaxed.keys() == loaded.keys() == {"JointSpring"}
    assert "TorqueRipple" in relaxed["JointSpring"]
    assert "TorqueRipple" not in loaded["JointSpring"]
    assert "Counterbalance" in loaded["JointSpring"]
    assert bias.keys() == {"TorqueBias"}
    assert bias["TorqueBias"] <= {"JointSpring"}


@pytest.mark.parametrize(("steepness", "named"), [(50.0, {"TorqueSaturation"}), (0.5, set())])
def test_a_limit_leaves_nothing_of_what_is_commanded_beyond_it(
    swing: tuple[Scenario, Log], steepness: float, named: set[str]
):
    """Beyond a torque the command rises by `1 + steepness` times what the link gets: 98 % of what
    is commanded beyond are lost, or a third, of which a limit explains most all the same."""

    def loss(_: np.ndarray, torque: np.ndarray) -> np.ndarray:
        sign = np.sign(torque.mean())
        along = sign * torque
        limit = along.min() + 0.9 * np.ptp(along)
        return sign * steepness * np.maximum(along - limit, 0.0)

    assert set(alternatives(diagnosis_of(swing, loss, "TorqueBias", "TorqueSaturation"))) == named


def test_a_fit_in_the_model_is_not_compared_with_linear_ones(tmp_path: Path) -> None:
    """A drive that gives too little torque, which less inertia explains as well as long as both are
    linear; what that leaves when it is in the model says nothing of what the other would."""
    recording = record(14054, tmp_path)
    (gain,) = (hidden for hidden in recording.hidden if hidden.names == ("TorqueGain",))
    found = diagnose(Predictor(recording.scenario, recording.log)).chosen
    said = [{f.effect, *f.confusable_with} for f in found if f.targets == gain.targets]
    assert any("TorqueGain" in names for names in said)
