"""Ground that gives way: how soles sink into it, and whether a diagnosis says how soft it is."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig

from fbse_drake import Log, Scenario, load_scenario
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.validation import validated
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.effects.contact import (
    FootCreep,
    GroundCompliance,
    GroundSlope,
    PadContact,
    spring_force,
)
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.sensor import AccelerometerBias, FootForceGain, ImuMisalignment
from fbse_drake.robot.plant import Ground
from fbse_drake.simulation import simulate

# What soft ground might be taken for, and itself.
TRIED: list[type[Effect]] = [
    GroundCompliance,
    GroundSlope,
    FootCreep,
    AccelerometerBias,
    ImuMisalignment,
    FootForceGain,
]


@cache
def walk(stiffness: float, dissipation: float) -> tuple[Scenario, Log]:
    """A walk over ground of one stiffness [N/m] and dissipation [s/m], and the scenario that knows
    it."""
    changes = ["duration=4.5", "seed=4", "log.period=0.004", "estimator=!NoEstimator {}"]
    scenario = load_scenario("paper_walk", overrides=changes)
    scenario = replace(scenario, ground=replace(scenario.ground, stiffness=stiffness))
    scenario = replace(scenario, ground=replace(scenario.ground, dissipation=dissipation))
    return replace(scenario, model=scenario.robot), simulate(scenario).log


def on_firm_ground(scenario: Scenario) -> Scenario:
    """The same where the ground is that of the shipped scenarios."""
    return replace(scenario, ground=Ground())


@cache
def diagnosed(stiffness: float, dissipation: float) -> Diagnosis:
    scenario, log = walk(stiffness, dissipation)
    return diagnose(Predictor(on_firm_ground(scenario), log), TRIED)


def test_small_changes_of_a_load_sink_in_as_through_a_low_pass() -> None:
    """About a load F the law s (1 + retardation ds/dt) = f is retardation F ds/dt = f - s, a
    first-order low-pass."""
    load, retardation, period, rate = 100.0, 2e-4, 1e-4, 2 * np.pi * 4.0
    time = period * np.arange(20_000)
    force = load + 0.1 * np.sin(rate * time)
    spring = spring_force(force[:, None], retardation, period)[:, 0] - load
    lag = retardation * load
    expected = 0.1 / (1.0 + 1j * rate * lag)
    # Whole periods.
    steady = time >= 0.25
    found = 2.0 * np.mean((spring * np.exp(-1j * (rate * time - np.pi / 2)))[steady])
    assert found == pytest.approx(expected, rel=0.02)
    np.testing.assert_array_equal(spring_force(force[:, None], 0.0, period)[:, 0], force)


def test_a_contact_has_the_compliance_and_the_retardation_that_are_said() -> None:
    ground, plant = Ground(stiffness=5e5, dissipation=80.0), MultibodyPlantConfig()
    soft, _ = GroundCompliance(3e-6, retardation=1e-3).contact(ground, plant, 0.9)
    assert 1.0 / soft.stiffness == pytest.approx(1.0 / 5e5 + 3e-6)
    contact = PadContact(soft.stiffness, soft.dissipation, creep=0.0, friction=0.8)
    assert contact.retardation == pytest.approx(1e-3)


@pytest.mark.parametrize(("stiffness", "dissipation"), [(1e5, 100.0), (6e4, 30.0), (3e5, 400.0)])
def test_soft_ground_is_named_with_its_compliance_and_damping(
    stiffness: float, dissipation: float
) -> None:
    """The log is of a scenario with another ground, and of no effect at all."""
    found = diagnosed(stiffness, dissipation)
    assert found.verdict == "effect_found"
    assert [finding.effect for finding in found.chosen] == ["GroundCompliance"]
    parameters = found.chosen[0].parameters
    for name, true in (
        ("compliance", 1.0 / stiffness - 1.0 / Ground().stiffness),
        ("retardation", dissipation / stiffness),
    ):
        low, high = parameters[name].interval
        width = high - low
        assert low - 0.5 * width < true < high + 0.5 * width
        assert parameters[name].value == pytest.approx(true, rel=0.1)
        assert width < 0.3 * true
    assert found.held_out_after < 1.2


def test_ground_that_only_damps_otherwise_is_not_said_to_be_soft() -> None:
    found = diagnosed(Ground().stiffness, 25.0)
    assert not found.chosen


def test_a_model_that_knows_its_ground_leaves_nothing_also_where_a_recording_begins() -> None:
    """Half-way through a step nobody knows how far soles have sunk in; a tenth of a second later
    they still do, where the ground is soft and damps."""
    scenario, log = walk(6e4, 100.0)
    later = log.part(slice(int(np.searchsorted(log.time, 2.7)), None))
    residual = Predictor(scenario, later).residual
    kinematic = np.array([row.kind == "kinematic" for row in residual.rows])
    white = WhitenedResidual(residual)

    def error() -> float:
        return float(np.sqrt(white.sse[kinematic].sum() / white.count[kinematic].sum()))

    assert white.count[kinematic].sum() > 100
    assert error() < 1.5
    first = residual.time[residual.known[:, kinematic].any(axis=1)][0] - later.time[0]
    assert 0.3 < first < 1.5
    # The same on firm ground is known after a tenth of a second.
    firm = Predictor(on_firm_ground(scenario), later).residual
    assert firm.time[firm.known[:, kinematic].any(axis=1)][0] - later.time[0] < 0.2


def test_data_in_which_models_do_not_differ_say_nothing_of_them() -> None:
    scenario, log = walk(6e4, 100.0)
    given, knowing = Predictor(on_firm_ground(scenario), log), Predictor(scenario, log)
    same = validated(given, given)
    assert not same.tells
    assert not same.refutes
    for before, after, course in ((given, knowing, "falls"), (knowing, given, "rises")):
        differ = validated(before, after)
        assert differ.tells
        assert differ.course == course
