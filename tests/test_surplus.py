"""What a model believes too much of is found, and taken from what believes it."""

from dataclasses import replace
from functools import cache
from typing import ClassVar

import numpy as np
import pytest

from fbse_drake.discrepancy.diagnosis.add import add
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import Effect, Parameter
from fbse_drake.effects.friction import (
    CoulombFriction,
    CoulombViscousFriction,
    StribeckFriction,
    ViscousFriction,
)
from fbse_drake.effects.joint_torque import JointMotion
from fbse_drake.effects.surplus import without_surplus
from fbse_drake.effects.transmission import PreslidingHysteresis
from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.report.sentences import diagnosis_outcome
from fbse_drake.robot.description import load_description
from fbse_drake.scenario import Scenario, load_scenario
from fbse_drake.simulation import simulate

NAMES, _ = load_description("arm")
BELIEVED = CoulombViscousFriction(
    coulomb={"all": 4.0, "axis_2": 9.0}, viscous={"all": 3.0}, transition={"all": 0.02}
)


def torque(effects: dict[str, Effect]) -> np.ndarray:
    """Of all effects, at some velocities, (V, 6) [Nm]."""
    motion = JointMotion(np.linspace(-1.0, 1.0, 41)[:, None] * np.ones(6))
    resolved = [effect.resolve(NAMES, is_change=True) for effect in effects.values()]
    return sum(effect.torque_and_slope(motion)[0] for effect in resolved)


def test_a_model_less_what_it_has_too_much_of_is_the_model_and_the_change() -> None:
    change = CoulombViscousFriction(
        coulomb={"axis_2": -2.5, "axis_3": -4.0, "axis_4": 1.0},
        viscous={"axis_2": -3.0, "axis_5": 0.5},
        transition={"all": 0.02},
    )
    lowered, beside = without_surplus({"own": BELIEVED}, change, NAMES)
    assert beside is not None
    both = torque({"own": BELIEVED, "change": change})
    assert torque(lowered | {"beside": beside}) == pytest.approx(both, abs=1e-12)
    # Nothing in the lowered model or beside it drives a joint.
    for effect in (*lowered.values(), beside):
        effect.resolve(NAMES)


def test_what_is_taken_whole_leaves_nothing_beside() -> None:
    change = CoulombFriction(coulomb={"axis_1": -4.0}, transition={"all": 0.02})
    lowered, beside = without_surplus({"own": BELIEVED}, change, NAMES)
    assert beside is None
    assert lowered["own"].resolve(NAMES).linear_values("coulomb").tolist() == [0, 9, 4, 4, 4, 4]


@pytest.mark.parametrize(
    "own",
    [
        # It has less than that, none, and something else that has the name.
        CoulombFriction(coulomb={"axis_1": 3.0}),
        ViscousFriction(viscous={"axis_1": 5.0}),
        PreslidingHysteresis(coulomb={"axis_1": 5.0}, displacement={"all": 1e-3}),
    ],
)
def test_nobody_gives_what_he_has_not(own: Effect) -> None:
    _, beside = without_surplus({"own": own}, CoulombFriction(coulomb={"axis_1": -4.0}), NAMES)
    assert beside is not None
    with pytest.raises(InputError, match=r"coulomb: expected values in \[0, inf\] Nm"):
        beside.resolve(NAMES)


def test_a_nonlinear_parameter_of_the_same_name_is_something_else() -> None:
    class Bent(ViscousFriction):
        parameters: ClassVar[dict[str, Parameter]] = {
            "coulomb": Parameter("Nm", linear=False, plausible=(0.1, 1.0), neutral=1.0)
        }

    assert CoulombFriction.shares("coulomb", CoulombViscousFriction)
    assert not CoulombFriction.shares("coulomb", Bent)


def test_of_a_joint_that_the_robot_has_not_nothing_is_taken() -> None:
    change = CoulombFriction(coulomb={"elbow": -1.0})
    lowered, beside = without_surplus({"own": BELIEVED}, change, NAMES)
    assert (lowered, beside) == ({"own": BELIEVED}, change)


@cache
def arm() -> tuple[Scenario, Log]:
    scenario = load_scenario("bsc_arm", overrides=["duration=4", "seed=3"])
    return scenario, simulate(scenario).log


def believing(effects: dict[str, Effect], rotors: dict[str, float] | None = None) -> Scenario:
    scenario, _ = arm()
    model = replace(scenario.robot, effects=scenario.robot.effects | effects)
    return replace(
        scenario, model=replace(model, rotor_inertia=model.rotor_inertia | (rotors or {}))
    )


def test_a_fit_takes_away_no_more_than_the_model_has() -> None:
    _, log = arm()
    scenario = believing({"joint_friction": BELIEVED})
    dictionary = Dictionary(Predictor(scenario, log), [CoulombFriction, StribeckFriction])

    def lowest(effect: type[Effect], name: str, *joints: str) -> float:
        return dictionary.parameters(effect, *joints)[name].bounds[0]

    assert lowest(CoulombFriction, "coulomb", "axis_2") == -9.0
    assert lowest(CoulombFriction, "coulomb", "axis_2", "axis_3") == -4.0
    assert lowest(ViscousFriction, "viscous", "axis_2") == -3.0
    assert lowest(StribeckFriction, "gamma4", "axis_2") == 0.0
    assert lowest(PreslidingHysteresis, "coulomb", "axis_2") == 0.0


def test_friction_that_a_model_has_too_much_of_is_found_and_taken_from_it() -> None:
    scenario, log = arm()
    true = scenario.robot.effects["joint_friction"]
    assert isinstance(true, CoulombViscousFriction)
    wrong = replace(
        true, coulomb=true.coulomb | {"axis_2": 18.0}, viscous=true.viscous | {"axis_5": 4.0}
    )
    model = believing({"joint_friction": wrong})
    diagnosis = diagnose(Predictor(model, log))
    assert diagnosis.verdict == "effect_found"
    found = {(f.effect, f.targets): f.parameters for f in diagnosis.chosen}
    assert set(found) == {("CoulombFriction", ("axis_2",)), ("ViscousFriction", ("axis_5",))}
    for (effect, joint), name, surplus in (
        (("CoulombFriction", ("axis_2",)), "coulomb", 4.0),
        (("ViscousFriction", ("axis_5",)), "viscous", 2.0),
    ):
        assert found[effect, joint][name].value == pytest.approx(-surplus, rel=0.01)
    assert diagnosis_outcome(diagnosis).startswith("The model lacks ")
    assert "Where a value is negative, the model has too much." in diagnosis_outcome(diagnosis)
    mended = add(model, diagnosis.chosen)
    assert set(mended.believed.effects) == {"joint_friction"}
    resolved, truth = (
        s.effects["joint_friction"].resolve(NAMES).linear for s in (mended.believed, scenario.robot)
    )
    assert resolved == pytest.approx(truth, rel=0.01)
    assert diagnose(Predictor(mended, log)).verdict == "nothing_missing"


def test_friction_that_a_robot_has_not_is_found_to_be_none() -> None:
    """Where the fit ends at its bound."""
    scenario, _ = arm()
    free = replace(scenario, robot=replace(scenario.robot, effects={}))
    true = scenario.robot.effects["joint_friction"]
    assert isinstance(true, CoulombViscousFriction)
    model = replace(scenario, robot=free.robot, model=replace(free.robot, effects={"own": true}))
    diagnosis = diagnose(Predictor(model, simulate(free).log))
    assert diagnosis.verdict == "effect_found"
    mended = add(model, diagnosis.chosen).believed.effects
    motion = JointMotion(np.linspace(-0.5, 0.5, 21)[:, None] * np.ones(6))
    before, after = (
        sum(
            np.abs(effect.resolve(NAMES).torque_and_slope(motion)[0]).max()
            for effect in effects.values()
        )
        for effects in (model.believed.effects, mended)
    )
    assert after < 1e-3 * before


def test_rotors_that_a_model_has_too_much_of_are_found() -> None:
    _, log = arm()
    model = believing({}, {"axis_3": 1.4, "axis_5": 0.5})
    diagnosis = diagnose(Predictor(model, log))
    assert {(f.effect, f.targets) for f in diagnosis.chosen} == {
        ("ReflectedInertia", ("axis_3",)),
        ("ReflectedInertia", ("axis_5",)),
    }
    found = {f.targets[0]: f.parameters["inertia"] for f in diagnosis.chosen}
    for joint, surplus in (("axis_3", 0.6), ("axis_5", 0.3)):
        assert found[joint].value == pytest.approx(-surplus, rel=0.01)
    assert diagnose(Predictor(add(model, diagnosis.chosen), log)).verdict == "nothing_missing"
