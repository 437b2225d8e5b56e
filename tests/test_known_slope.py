"""Ground that slopes: where a scenario says so it is no effect, and elsewhere it is found as it is,
however steep."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fbse_drake.discrepancy.diagnosis.add import add
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.contact import GroundCompliance, GroundSlope
from fbse_drake.effects.inertia import BodyCentreOfMass
from fbse_drake.effects.sensor import AccelerometerBias, ImuMisalignment
from fbse_drake.log import Log
from fbse_drake.scenario import Scenario
from tests.conftest import scenario

WALK = ("walks/slope", "duration=3", "estimator=!NoEstimator {}")
STEEPNESS = -0.087
TRIED = [GroundSlope, AccelerometerBias, ImuMisalignment, BodyCentreOfMass, GroundCompliance]


def believed(ground: float, **effects: GroundSlope) -> Scenario:
    """The walk up that slope, by someone who thinks that the ground has this slope, and whose model
    has some effects."""
    walk = scenario(*WALK)
    model = replace(walk.robot, effects=walk.robot.effects | effects)
    return replace(walk, model=model, ground=replace(walk.ground, slope=[0.0, ground]))


@pytest.mark.parametrize(
    "case",
    [
        believed(STEEPNESS),
        believed(0.0, slope=GroundSlope(y=STEEPNESS)),
        believed(-0.05, slope=GroundSlope(y=STEEPNESS + 0.05)),
        believed(0.0, one=GroundSlope(y=STEEPNESS + 0.03), other=GroundSlope(y=-0.03)),
    ],
)
def test_a_slope_that_is_known_is_no_effect(run: Callable[..., Log], case: Scenario):
    found = diagnose(Predictor(case, run(*WALK)), TRIED)
    assert found.verdict == "nothing_missing"
    assert found.held_out_before < 1.1


@pytest.mark.parametrize("known", [0.0, -0.05])
def test_a_slope_is_found_as_it_is_and_leaves_nothing(run: Callable[..., Log], known: float):
    """In its second order too: level soles on 5 degrees would read 0.04 m/s^2 more along their
    normal, ten times what the noise leaves."""
    case, log = believed(known), run(*WALK)
    found = diagnose(Predictor(case, log), TRIED)
    (slope,) = found.chosen
    assert (found.verdict, slope.effect) == ("effect_found", "GroundSlope")
    low, high = slope.parameters["y"].interval
    assert low < STEEPNESS - known < high
    assert high - low < 2e-3
    completed = diagnose(Predictor(add(case, found.chosen), log), TRIED)
    assert completed.verdict == "nothing_missing"


@pytest.mark.parametrize("known", [False, True])
def test_a_slope_is_told_by_a_robot_that_turns_on_it(run: Callable[..., Log], known: bool):
    """Four turns of 8.6 degrees: soles that headed along world x all the time would read something
    that no slope explains."""
    walk = ("walks/turning", "duration=5", "estimator=!NoEstimator {}")
    slope, case = [0.01, -0.03], scenario(*walk)
    log = run(*walk, f"ground.slope={slope}", f"reference.slope={slope}")
    ground = replace(case.ground, slope=slope) if known else case.ground
    found = diagnose(Predictor(replace(case, model=case.robot, ground=ground), log), TRIED)
    if known:
        assert (found.verdict, found.chosen) == ("nothing_missing", [])
        assert found.held_out_before < 1.1
    else:
        (finding,) = found.chosen
        assert (found.verdict, finding.effect) == ("effect_found", "GroundSlope")
        assert found.held_out_before > 5.0
        assert found.held_out_after < 1.1
        for axis, true in zip("xy", slope, strict=True):
            low, high = finding.parameters[axis].interval
            assert low < true < high < low + 1e-3


def test_what_a_slope_adds_is_gravity_in_turned_axes(run: Callable[..., Log]):
    predictor = Predictor(believed(0.0), run(*WALK))
    signature = predictor.signature(GroundSlope, "robot", np.zeros(0))
    about = predictor.signature_near(
        GroundSlope, "robot", np.array([0.0, 0.3]), np.zeros(0), signature
    )
    names = [predictor.motion.rows[row].name for row in signature.rows]
    added = (about.values @ [0.0, 0.3] + about.offset)[0]
    g = predictor.motion.equation.gravity
    for side in ("left", "right"):
        turned = [added[names.index(f"{side}_sole/specific_force_{axis}")] for axis in "xz"]
        np.testing.assert_allclose(turned, [-g * np.sin(0.3), g * (np.cos(0.3) - 1.0)], rtol=1e-9)
