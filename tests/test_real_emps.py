"""EMPS, a carriage on a ball screw, as recorded for a benchmark (Janot, Gautier and Brunot 2019):
what its publishers identified, and what they missed. The record with force pulses is never
fitted."""

import os
from pathlib import Path

import pytest

from fbse_drake import Log, Scenario, load_scenario
from fbse_drake.discrepancy.diagnosis.identify import Identification, identify
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import Study, model_error, study
from fbse_drake.discrepancy.residual.rollout import rollout
from fbse_drake.effects.effect import library
from fbse_drake.interop.convert import read_log

DATA = Path(os.environ.get("FBSE_DATA_DIR", "")) / "emps"
pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="FBSE_DATA_DIR does not hold the records of EMPS"
)
MAP = Path(__file__).parent.parent / "scenarios" / "real" / "emps.map.yaml"
# Published; also that of the model's file [kg].
MASS = 95.1089
# Of the library, those that decide and some that do not; `fbse study real/emps` tries all of it.
EFFECTS = (
    "CoulombFriction",
    "ViscousFriction",
    "DirectionalFriction",
    "DirectionalViscousFriction",
    "QuadraticDrag",
    "PreslidingHysteresis",
    "TorqueBias",
    "TorqueDelay",
    "TorqueGain",
)


@pytest.fixture(scope="module")
def record() -> Log:
    return read_log(DATA / "DATA_EMPS.mat", MAP)


@pytest.fixture(scope="module")
def pulses() -> Log:
    return read_log(DATA / "DATA_EMPS_PULSES.mat", MAP)


@pytest.fixture(scope="module")
def identified(record: Log, pulses: Log) -> Identification:
    """From a frictionless carriage of half the mass."""
    overrides = [f"model.effects={{half: !BodyMass {{mass: {{carriage: {-0.5 * MASS}}}}}}}"]
    return identify(load_scenario("real/emps", overrides=overrides), record, {"pulses": pulses})


@pytest.fixture(scope="module")
def found(record: Log, pulses: Log) -> Study:
    scenario = load_scenario("real/emps")
    return study(
        scenario,
        record,
        [library()[name] for name in EFFECTS],
        rollouts=False,
        tests={"pulses": pulses},
    )


@pytest.fixture(scope="module")
def published() -> Scenario:
    return load_scenario("real/emps", "emps_published")


def test_the_publishers_parameters_are_found(identified: Identification) -> None:
    values = {
        name: estimate.value
        for finding in identified.findings[:2]
        for name, estimate in finding.parameters.items()
    }
    assert 0.5 * MASS + identified.inertia.change[0, 0] == pytest.approx(MASS, rel=0.01)
    assert values["viscous"] == pytest.approx(203.5034, rel=0.01)
    assert values["coulomb"] == pytest.approx(20.3935, rel=0.01)
    assert values["bias"] == pytest.approx(-3.1648, rel=0.01)
    assert identified.findings[0].parameters["viscous"].unit == "N s/m"


def test_their_model_leaves_what_they_say(
    identified: Identification, published: Scenario, record: Log, pulses: Log
) -> None:
    """They say 4.08 % of the decimated force, and 5.98 % on the record with pulses."""
    assert identified.after["train"].relative == pytest.approx(0.0408, rel=0.01)
    assert model_error(Predictor(published, record)).relative == pytest.approx(
        identified.after["train"].relative, rel=0.01
    )
    assert model_error(Predictor(published, pulses)).relative == pytest.approx(0.0598, rel=0.06)


def test_what_they_missed_is_named_and_holds_on_the_pulses(found: Study) -> None:
    """Friction that grows faster with speed backwards than forwards, which they took for an offset;
    and a force that comes late."""
    first, last = found.steps[0].errors, found.steps[-1].errors
    assert first["train"].relative > 0.6
    assert last["train"].relative < 0.031
    assert last["pulses"].relative < 0.0535
    values = {finding.effect: finding.parameters for finding in found.found}
    assert values["DirectionalViscousFriction"]["asymmetry"].interval[1] < -20
    assert 2e-4 < values["TorqueDelay"]["delay"].value < 1.5e-3
    assert "TorqueGain" not in values
    assert abs(values["TorqueBias"]["bias"].value if "TorqueBias" in values else 0.0) < 1.5


def test_the_model_keeps_what_the_search_promised(found: Study) -> None:
    """The search predicts the held-out error with a law made linear in its parameters; the model
    has the law itself."""
    step = found.steps[1]
    assert step.train_rmse < 1.1 * step.held_out_rmse


def test_simulated_in_closed_loop_it_stays_near_the_record(
    found: Study, published: Scenario, record: Log
) -> None:
    """They say 0.0138 % of the position. Here over one of the four cycles."""
    cycle = record.part(slice(0, 6240))
    errors = [rollout(scenario, cycle) for scenario in (published, found.scenario)]
    assert all(error is not None and error.failure is None for error in errors)
    assert errors[0].relative_position["slider"] < 1.38e-4
    assert errors[1].relative_position["slider"] < 1.38e-4
    assert errors[1].torque_command["slider"] < errors[0].torque_command["slider"]
