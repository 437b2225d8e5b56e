"""The double pendulum of the DFKI, measured: inertia and plain friction, and what the diagnosis
adds to it. Fitted is the first 70 % of one record, the rest is for the test."""

import os
from pathlib import Path

import numpy as np
import pytest

from fbse_drake import Log, Scenario, load_scenario
from fbse_drake.discrepancy.diagnosis.identify import Identification, identify
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import Study, study, train_and_rest
from fbse_drake.effects.effect import library
from fbse_drake.effects.inertia import pseudo_inertia
from fbse_drake.interop.convert import read_log

RECORD = (
    Path(os.environ.get("FBSE_DATA_DIR", ""))
    / "double_pendulum"
    / "20220812-061157-PM_measured.csv"
)
pytestmark = pytest.mark.skipif(
    not RECORD.is_file(), reason="FBSE_DATA_DIR does not hold the records of the double pendulum"
)
MAP = Path(__file__).parent.parent / "scenarios" / "real" / "double_pendulum.map.yaml"
# Of the library, those that decide and some that do not; `fbse study real/double_pendulum` tries
# all of it.
EFFECTS = (
    "CoulombFriction",
    "ViscousFriction",
    "DirectionalFriction",
    "LoadDependentFriction",
    "PreslidingHysteresis",
    "TorqueBias",
    "TorqueLag",
)


@pytest.fixture(scope="module")
def recording() -> tuple[Scenario, Log, Log]:
    """The scenario, what is fitted, and the rest."""
    scenario = load_scenario("real/double_pendulum")
    return scenario, *train_and_rest(scenario, read_log(RECORD, MAP))


@pytest.fixture(scope="module")
def identified(recording: tuple[Scenario, Log, Log]) -> Identification:
    scenario, train, rest = recording
    return identify(scenario, train, {"rest": rest})


@pytest.fixture(scope="module")
def found(recording: tuple[Scenario, Log, Log]) -> Study:
    scenario, train, rest = recording
    return study(
        scenario, train, [library()[name] for name in EFFECTS], rollouts=False, tests={"rest": rest}
    )


def test_the_model_is_the_published_one(recording: tuple[Scenario, Log, Log]) -> None:
    """Without friction its equation of motion in closed form, with the makers' parameters, leaves
    the same."""
    scenario, train, _ = recording
    predictor = Predictor(scenario, train)
    at, g = predictor.motion.steps, 9.81
    I1, I2, m2, r2, l1, m1_r1, Ir = (
        0.0534708,
        0.0239237,
        0.6043459,
        0.1837769,
        0.3,
        0.5593806 * 0.3,
        36 * 7.6593e-5,
    )
    q1, q2, v1, v2, a1, a2 = np.hstack(
        [at.joint_position, at.joint_velocity, at.joint_acceleration]
    ).T
    c, s = m2 * l1 * r2 * np.cos(q2), m2 * l1 * r2 * np.sin(q2)
    first = (I1 + m2 * l1**2 + Ir + 2 * c + I2) * a1 + (I2 + c) * a2 - s * v2 * (2 * v1 + v2)
    first += g * ((m1_r1 + m2 * l1) * np.sin(q1) + m2 * r2 * np.sin(q1 + q2))
    second = (I2 + c) * a1 + (I2 + Ir) * a2 + s * v1**2 + g * m2 * r2 * np.sin(q1 + q2)
    torque = predictor.motion.equation.residual(at)
    np.testing.assert_allclose(
        torque, at.torque_command - np.stack([first, second], axis=1), atol=2e-4
    )


def test_plain_friction_and_inertia(identified: Identification) -> None:
    """A plain fit leaves 14.2 % without friction and 6.1 % with it; on the rest 7.7 and 15.1 %."""
    assert identified.before["train"].relative == pytest.approx(0.147, abs=0.005)
    assert identified.after["train"].relative < 0.061
    assert identified.after["rest"].relative_by_joint["shoulder"] < 0.077
    assert identified.after["rest"].relative_by_joint["elbow"] < 0.151
    assert (
        np.linalg.eigvalsh(
            pseudo_inertia(identified.inertia.model + identified.inertia.change)
        ).min()
        > 0
    )


def test_what_the_diagnosis_names_holds_on_the_rest(
    identified: Identification, found: Study
) -> None:
    """Friction that grows with the load, and builds up over some milliradians."""
    error = found.steps[-1].errors
    assert error["train"].relative < 0.050
    assert error["rest"].relative_by_joint["shoulder"] < 0.071
    assert error["rest"].relative_by_joint["elbow"] < 0.147
    assert error["rest"].relative < 0.9 * identified.after["rest"].relative
    load = [finding for finding in found.found if finding.effect == "LoadDependentFriction"]
    assert any(
        "shoulder" in finding.targets and finding.parameters["coefficient"].interval[0] > 0
        for finding in load
    )


def test_no_round_makes_the_rest_worse(found: Study) -> None:
    errors = [step.errors["rest"].relative for step in found.steps]
    assert np.all(np.diff(errors) < 0.002)


def test_the_model_keeps_what_the_search_promised(found: Study) -> None:
    """The search predicts the held-out error with a law made linear in its parameters; the model
    has the law itself."""
    step = found.steps[1]
    assert step.train_rmse < 1.1 * step.held_out_rmse
