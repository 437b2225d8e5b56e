"""What is put into a log is found, with intervals that hold it; what is not is not; and what cannot
be seen is said to be so."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from fbse_drake.discrepancy.diagnosis.add import add, read_findings
from fbse_drake.discrepancy.diagnosis.detectability import smallest_detectable
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose, diagnosis_json
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.discrepancy.diagnosis.explanation import Candidate
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.diagnosis.rivals import indistinguishable
from fbse_drake.discrepancy.diagnosis.search import simplified_in_model
from fbse_drake.discrepancy.diagnosis.selection import (
    best_additions,
    is_disbelieved,
    is_significant,
)
from fbse_drake.discrepancy.diagnosis.study import study, study_json
from fbse_drake.discrepancy.identification.regression import Signature
from fbse_drake.discrepancy.residual.rollout import RolloutError, rollout
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.effects.sensor import FootForceGain, FootForceMisalignment
from fbse_drake.effects.transmission import JointSpring
from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.processes import Processes
from fbse_drake.progress import Interrupted
from fbse_drake.scenario import IdentifyConfig, Scenario, load_scenario
from fbse_drake.simulation import simulate

# Effects that look alike, and some that do not; the whole library is tried by `make hidden`.
NAMES = (
    "CoulombFriction",
    "ViscousFriction",
    "DirectionalFriction",
    "LoadDependentFriction",
    "QuadraticDrag",
    "JointSpring",
    "TorqueBias",
    "TorqueGain",
    "TorqueLag",
    "ReflectedInertia",
    "BodyMass",
    "FootForceGain",
    "AccelerometerBias",
)


def effects() -> list[type[Effect]]:
    return [library()[name] for name in NAMES]


def walking(*overrides: str) -> Scenario:
    return load_scenario("paper_walk", overrides=["duration=3.2", *overrides])


@cache
def scenario() -> Scenario:
    """What is believed: the robot without what is hidden."""
    clean = walking()
    return replace(clean, model=clean.robot)


@cache
def log_with(hidden: str) -> Log:
    return simulate(walking("seed=11", *([f"robot.effects.hidden={hidden}"] if hidden else []))).log


@cache
def diagnosis_of(hidden: str) -> Diagnosis:
    return diagnose(Predictor(scenario(), log_with(hidden)), effects())


@pytest.fixture(scope="module", autouse=True)
def forgotten() -> Iterator[None]:
    """Logs and diagnoses are kept for this file alone: its worker goes on with others."""
    yield
    for kept in (log_with, diagnosis_of):
        kept.cache_clear()


HIDDEN = {
    "!TorqueGain {shortfall: {left_knee_pitch: 0.04}}": (
        "TorqueGain",
        "left_knee_pitch",
        {"shortfall": 0.04},
    ),
    "!CoulombFriction {coulomb: {right_hip_pitch: 1.5}}": (
        "CoulombFriction",
        "right_hip_pitch",
        {"coulomb": 1.5},
    ),
    "!LoadDependentFriction {coefficient: {left_knee_pitch: 0.03}}": (
        "LoadDependentFriction",
        "left_knee_pitch",
        {"coefficient": 0.03},
    ),
    "!BodyMass {mass: {trunk: 2.0}}": ("BodyMass", "trunk", {"mass": 2.0}),
    "!AccelerometerBias {x: 0.1, y: -0.05}": (
        "AccelerometerBias",
        "robot",
        {"x": 0.1, "y": -0.05, "z": 0.0},
    ),
}


def test_effects_that_are_predicted_in_another_process_are_those_of_this_one():
    @dataclass(frozen=True)
    class Local(library()["FootForceGain"]):  # type: ignore[misc]
        """Nobody finds it by its name."""

    predictor = Predictor(scenario(), log_with(""))
    tried = [*effects(), Local]
    here, beside = (Dictionary(predictor, tried) for _ in range(2))
    with Processes(2) as processes:
        beside.begin(processes)
        there = beside.fixed
    assert list(there) == list(here.fixed)
    for effect, columns in here.fixed.items():
        assert [c.target for c in columns] == [c.target for c in there[effect]]
        for one, other in zip(columns, there[effect], strict=True):
            np.testing.assert_array_equal(one.signature.values, other.signature.values)
            np.testing.assert_array_equal(one.signature.rows, other.signature.rows)


def test_a_dictionary_serves_no_other_log_model_or_effects():
    predictor = Predictor(scenario(), log_with(""))
    dictionary = Dictionary(predictor, effects())
    assert dictionary.serves(Predictor(scenario(), log_with("")), effects())
    recording = replace(scenario().recording, unused_rows=["left_knee_pitch"])
    distrusting = replace(scenario(), recording=recording)
    assert not dictionary.serves(predictor.of(distrusting), effects())
    assert not dictionary.serves(predictor.without([(1.0, 1.1)]), effects())
    assert not dictionary.serves(
        Predictor(scenario(), Log(log_with("").channels, log_with("").meta)), effects()
    )
    assert not dictionary.serves(predictor, effects()[1:])


@pytest.mark.parametrize("hidden", HIDDEN)
def test_what_is_hidden_is_found(hidden: str) -> None:
    name, target, truth = HIDDEN[hidden]
    diagnosis = diagnosis_of(hidden)
    assert diagnosis.verdict == "effect_found"
    first = diagnosis.ranking[0]
    assert (first.effect, first.targets) == (name, (target,))
    assert len(diagnosis.chosen) == 1
    assert first.held_out_after < 1.2 < first.held_out_before
    for parameter, value in truth.items():
        found = first.parameters[parameter]
        half = max(abs(end - found.value) for end in found.interval)
        # Twice the half width of a 95 % interval: a single draw.
        assert abs(found.value - value) < 2 * half, (parameter, found)
        assert half < 0.1 * max(abs(v) for v in truth.values())
    statuses = diagnosis.effects
    assert statuses[name].verdict == "present"
    assert all(
        status.verdict in ("absent", "confusable", "not_visible")
        for other, status in statuses.items()
        if other != name
    )


def test_nothing_is_found_where_nothing_is_hidden() -> None:
    diagnosis = diagnosis_of("")
    assert diagnosis.verdict == "nothing_missing"
    assert not diagnosis.ranking
    assert all(status.verdict in ("absent", "not_visible") for status in diagnosis.effects.values())
    assert diagnosis.held_out_after == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("every", [2, 5])
@pytest.mark.parametrize(
    "hidden",
    [
        "",
        "!BodyMass {mass: {trunk: 2.0}}",
        "!TorqueGain {shortfall: {left_knee_pitch: 0.04}}",
    ],
)
def test_of_a_log_that_is_rarer_than_the_control_the_same_is_found(hidden: str, every: int) -> None:
    rare = log_with(hidden).part(slice(None, None, every))
    found = diagnose(Predictor(scenario(), rare), effects()).chosen
    whole = diagnosis_of(hidden).chosen
    assert [(f.effect, f.targets) for f in found] == [(f.effect, f.targets) for f in whole]
    for one, other in zip(found, whole, strict=True):
        for name, parameter in one.parameters.items():
            assert parameter.value == pytest.approx(other.parameters[name].value, rel=0.03)


@pytest.mark.parametrize("hidden", ["", "!BodyMass {mass: {trunk: 2.0}}"])
def test_samples_that_are_rarer_than_the_control_show_when_commands_act(hidden: str) -> None:
    """What happens between them is noise, and nothing unknown; but a command acts in the
    millisecond after it was read, which is no fault of the drive."""
    rare = log_with(hidden).part(slice(None, None, 2))
    recording = replace(scenario().recording, rows="instantaneous")
    diagnosis = diagnose(Predictor(replace(scenario(), recording=recording), rare), effects())
    assert diagnosis.verdict == ("effect_found" if hidden else "not_visible")
    assert {finding.effect for finding in diagnosis.chosen} == ({"BodyMass"} if hidden else set())
    (lag,) = diagnosis.tentative
    assert lag.effect == "TorqueLag"
    assert lag.parameters["time_constant"].value == pytest.approx(1e-3, rel=0.2)


@pytest.mark.parametrize("seed", [11, 12])
def test_noise_in_the_regressors_is_not_taken_for_an_effect(seed: int) -> None:
    """In a squat the feet hardly move: what their accelerations show is noise, and it is in the
    residual too."""
    squat = load_scenario("squat", overrides=["duration=4", f"seed={seed}"])
    squat = replace(squat, model=squat.robot)
    names = ("BodyCentreOfMass", "BodyMass", "ReflectedInertia", "ThermalDrift")
    diagnosis = diagnose(Predictor(squat, simulate(squat).log), [library()[name] for name in names])
    assert diagnosis.verdict == "nothing_missing"


def injected(log: Log, effect: Effect) -> Log:
    """The log of a robot whose motors, to move the same way against a further torque, were
    commanded more."""
    names = Predictor(scenario(), log)
    resolved = effect.resolve(names.robot.description)
    velocity, position = (log[f"truth/joint/{name}"] for name in ("velocity", "position"))
    torque, _ = resolved.torque_and_slope(JointMotion(velocity[1:], position[:-1]))
    command = log["joint/torque_command"].copy()
    command[:-1] += torque
    return replace(log, channels=log.channels | {"joint/torque_command": command})


@pytest.mark.parametrize("joint", ["left_knee_pitch", "right_hip_roll"])
def test_smallest_detectable_size_is_right_within_a_factor_of_two(joint: str) -> None:
    log, viscous = log_with(""), library()["ViscousFriction"]
    size = diagnosis_of("").effects["ViscousFriction"].smallest_detectable[joint]
    found = {}
    for factor in (0.5, 2.0):
        weak = viscous.from_values([joint], {"viscous": [factor * size]})
        # However small a size is.
        exact = replace(scenario(), identify=IdentifyConfig(tolerance=0.0))
        found[factor] = diagnose(Predictor(exact, injected(log, weak)), effects()).chosen
    assert not found[0.5]
    assert found[2.0]
    assert all(finding.targets == (joint,) for finding in found[2.0])


def test_a_spring_is_seen_from_the_stated_size_on_wherever_it_is_slack() -> None:
    """Also where it is slack in the mean of the joint's angles, so that least of it shows."""
    joint, spring, log = "left_knee_pitch", library()["JointSpring"], log_with("")
    tried = [*effects(), spring]
    exact = replace(scenario(), identify=IdentifyConfig(tolerance=0.0))
    stated = diagnose(Predictor(exact, log), tried).effects["JointSpring"].smallest_detectable
    angle = log["truth/joint/position"][:, log.joints.index(joint)]
    for factor, is_seen in ((0.5, False), (2.0, True)):
        stiffness = factor * stated[joint]
        preload = -stiffness * angle.mean()
        hidden = spring.from_values([joint], {"stiffness": [stiffness], "preload": [preload]})
        found = diagnose(Predictor(exact, injected(log, hidden)), tried).chosen
        assert [(f.effect, f.targets) for f in found] == [("JointSpring", (joint,))] * is_seen


@pytest.mark.parametrize("hidden", HIDDEN)
def test_what_was_found_would_have_been_seen_from_the_size_on_that_nothing_hides(
    hidden: str,
) -> None:
    """Where it was found too, though beside itself nothing of it is left to be seen."""
    name, target, _ = HIDDEN[hidden]
    alone, found = (
        diagnosis_of(there).effects[name].smallest_detectable[target] for there in ("", hidden)
    )
    assert found == pytest.approx(alone, rel=0.2)


def test_a_standing_robot_shows_no_friction() -> None:
    """Too little excitation reads `not_visible`, never `absent`, with the experiment that would
    show it."""
    standing = load_scenario(
        "squat", overrides=["duration=2.5", "reference.amplitude=1e-6", "robot.effects=null"]
    )
    names = ("ViscousFriction", "QuadraticDrag")
    diagnosis = diagnose(
        Predictor(standing, planned_log(standing)), [library()[name] for name in names]
    )
    assert diagnosis.verdict == "not_visible"
    for status in diagnosis.effects.values():
        assert status.verdict == "not_visible"
        assert status.scenario is not None
        assert status.command.startswith("fbse simulate ")


@dataclass(frozen=True)
class Grip(JointTorqueEffect):
    """Not in the library: the joint sticks at one angle."""

    description: ClassVar[str] = ""
    signature: ClassVar[str] = ""
    experiment: ClassVar[str] = ""
    parameters: ClassVar[dict] = {}
    grip: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(motion: JointMotion, nonlinear: np.ndarray) -> tuple:  # noqa: ARG004
        return (np.exp(-(((motion.position - 0.9) / 0.05) ** 2)) * np.sin(25 * motion.time),), (
            0.0,
        )


def test_what_the_library_does_not_know_is_called_unknown() -> None:
    log = log_with("")
    joint = log.joints.index("left_knee_pitch")
    motion = JointMotion(
        log["joint/velocity"], position=log["joint/position"], time=log.time[:, None]
    )
    command = log["joint/torque_command"].copy()
    command[:, joint] += 4.0 * Grip.basis(motion, np.zeros(0))[0][0][:, joint]
    strange = replace(log, channels=log.channels | {"joint/torque_command": command})
    diagnosis = diagnose(Predictor(scenario(), strange), effects())
    assert diagnosis.verdict == "unknown_effect"
    assert [structure.row for structure in diagnosis.unexplained] == ["left_knee_pitch"]
    # No guess explains any of it.
    assert not diagnosis.ranking


def test_how_far_a_single_guess_goes_is_told_where_nothing_can_be_named() -> None:
    """Viscous friction beside something larger that the library does not know: it takes less than
    it leaves, so it is no name for that, but it is listed with what it takes."""
    log = log_with("")
    velocity = log["joint/velocity"]
    joint = log.joints.index("left_knee_pitch")
    command = log["joint/torque_command"].copy()
    strange = 4.0 * np.sin(25 * log.time) * np.sin(40 * log["joint/position"][:, joint])
    command[:, joint] += strange + 1.0 * velocity[:, joint]
    disguised = replace(log, channels=log.channels | {"joint/torque_command": command})
    diagnosis = diagnose(Predictor(scenario(), disguised), effects())
    assert diagnosis.verdict == "unknown_effect"
    assert not diagnosis.chosen
    viscous = next(f for f in diagnosis.ranking if f.effect == "ViscousFriction")
    low, high = viscous.parameters["viscous"].interval
    assert low < 1.0 < high
    errors = [finding.held_out_after for finding in diagnosis.ranking]
    assert all(error > 0.7 * viscous.held_out_before for error in errors)
    assert errors[0] == min(errors) < viscous.held_out_before
    # It can be added by name, and by name only.
    content = diagnosis_json(diagnosis)
    assert [f.targets for f in read_findings(content, "ViscousFriction")] == [("left_knee_pitch",)]
    with pytest.raises(InputError, match="no effect to add"):
        read_findings(content)


def test_friction_of_all_joints_is_named_as_what_it_is() -> None:
    """Coulomb and viscous friction as measured on HRP-2's legs: where viscous friction takes less
    than what Coulomb friction of a fitted shape may be wrong by, it was called Stribeck's. Of hips
    that hardly turn nothing can be said."""
    name, changes = "hrp2_friction_walk", ("duration=3", "estimator=!NoEstimator {}")
    walk = load_scenario(name, overrides=[*changes])
    true = walk.robot.effects["joint_friction"]
    diagnosis = diagnose(Predictor(walk, simulate(walk).log))
    assert diagnosis.verdict == "effect_found"
    assert {f.effect for f in diagnosis.chosen} == {"CoulombFriction", "ViscousFriction"}
    turning = {joint for joint in true.coulomb if not joint.endswith("hip_yaw")}
    for effect, amount in (("CoulombFriction", "coulomb"), ("ViscousFriction", "viscous")):
        found = {
            joint: f.parameters[amount].value
            for f in diagnosis.chosen
            if f.effect == effect
            for joint in f.targets
        }
        assert turning <= set(found)
        for joint in turning:
            assert found[joint] == pytest.approx(getattr(true, amount)[joint], rel=0.1)


def test_small_friction_beside_a_large_bias_is_found() -> None:
    """A bias has the shape that it has: what it leaves is no misfit, however little that is of what
    it takes."""
    biased, rubbing = (
        library()[name].from_values(["left_knee_pitch"], values)
        for name, values in (
            ("TorqueBias", {"bias": [10.0]}),
            ("CoulombFriction", {"coulomb": [1.2], "transition": [0.01]}),
        )
    )
    log = injected(injected(log_with(""), biased), rubbing)
    few = [library()[name] for name in ("TorqueBias", "CoulombFriction", "ViscousFriction")]
    found = {f.effect: f for f in diagnose(Predictor(scenario(), log), few).chosen}
    assert set(found) == {"TorqueBias", "CoulombFriction"}
    low, high = found["CoulombFriction"].parameters["coulomb"].interval
    assert low < 1.2 < high
    assert high - low < 0.4


def test_two_effects_at_once_are_both_found() -> None:
    log = log_with("!TorqueGain {shortfall: {left_knee_pitch: 0.04}}")
    viscous = library()["ViscousFriction"].from_values(["right_hip_pitch"], {"viscous": [1.5]})
    found = diagnose(Predictor(scenario(), injected(log, viscous)), effects()).chosen
    assert {(finding.effect, finding.targets[0]) for finding in found} == {
        ("TorqueGain", "left_knee_pitch"),
        ("ViscousFriction", "right_hip_pitch"),
    }


def test_feet_that_all_read_too_much_are_not_taken_for_weak_motors_and_a_heavier_robot() -> None:
    """A trunk that is heavier explains more than one foot does, and then every motor is weaker."""
    hidden = "!FootForceGain {gain: {left: 0.05, right: 0.05}}"
    tried = [*effects(), library()["Payload"]]
    found = diagnose(Predictor(scenario(), log_with(hidden)), tried)
    assert found.verdict == "effect_found"
    assert {(f.effect, f.targets) for f in found.chosen} == {
        ("FootForceGain", ("left",)),
        ("FootForceGain", ("right",)),
    }
    for finding in found.chosen:
        low, high = finding.parameters["gain"].interval
        assert low < 0.05 < high < low + 0.01


def test_a_weak_motor_is_found_beside_feet_that_read_too_much() -> None:
    """In the motor's own row nobody could tell which of the two it is."""
    feet = "!FootForceGain {gain: {left: 0.05, right: 0.05}}"
    motor = "robot.effects.motor=!TorqueGain {shortfall: {left_knee_pitch: 0.06}}"
    log = simulate(walking("seed=11", f"robot.effects.feet={feet}", motor)).log
    found = diagnose(Predictor(scenario(), log), effects())
    assert found.verdict == "effect_found"
    assert {(f.effect, f.targets) for f in found.chosen} == {
        ("FootForceGain", ("left",)),
        ("FootForceGain", ("right",)),
        ("TorqueGain", ("left_knee_pitch",)),
    }


def test_offsets_of_both_hips_are_not_taken_for_a_trunk_that_leans() -> None:
    """One offset alone explains less than a turned IMU with a moved mass; both together explain
    all."""
    log = log_with("!EncoderOffset {offset: {hip_roll: 0.007}}")
    candidates = [
        library()[name]
        for name in ("EncoderOffset", "ImuMisalignment", "BodyCentreOfMass", "TorqueBias")
    ]
    diagnosis = diagnose(Predictor(scenario(), log), candidates)
    assert diagnosis.verdict == "effect_found"
    assert sorted((f.effect, *f.targets) for f in diagnosis.chosen) == [
        ("EncoderOffset", f"{side}_hip_roll") for side in ("left", "right")
    ]
    assert all(
        f.parameters["offset"].value == pytest.approx(0.007, rel=0.02) for f in diagnosis.chosen
    )


def test_a_heavier_model_moves_by_the_plan_that_the_robot_had() -> None:
    """Planned anew with the mass that was found, it would walk otherwise than the robot did."""
    clean, log = scenario(), log_with("!BodyMass {mass: {trunk: 2.0}}").part(slice(0, 1201))
    heavier = replace(
        clean,
        model=replace(
            clean.model,
            effects={**clean.model.effects, "found": library()["BodyMass"]({"trunk": 2.0})},
        ),
    )
    before, after = (rollout(model, log, planned_with=clean.believed) for model in (clean, heavier))
    assert after.mean_position < 0.1 * before.mean_position
    assert after.mean_torque_command < 0.1 * before.mean_torque_command


@pytest.mark.parametrize(
    ("errors", "failing", "beside", "median", "drawn"),
    [
        ([1.0, 1.05, 9.0], (), None, 1.05, 2),
        ([1.05, 1.0, 9.0], (), None, 1.05, 2),
        ([1.0, 2.0, 1.3], (), None, 1.3, 3),
        ([9.0, 1.0, 1.3], (), None, 1.3, 3),
        ([1.0, 1.0, 9.0], (1,), None, 9.0, 3),
        ([1.0, 1.0, 9.0], (0, 1), None, 1.0, 3),
        # Beside a model that is far worse they agree, unless one is nearly as bad or falls.
        ([1.0, 2.0, 1.3], (), 20.0, 2.0, 2),
        ([1.0, 4.0, 1.3], (), 20.0, 1.3, 3),
        ([1.0, 2.0, 1.3], (1,), 20.0, 1.3, 3),
    ],
)
def test_a_single_draw_of_the_noise_does_not_decide_about_a_model(
    monkeypatch: pytest.MonkeyPatch,
    errors: list[float],
    failing: tuple[int, ...],
    beside: float | None,
    median: float,
    drawn: int,
) -> None:
    walk, seeds = load_scenario("paper_walk", overrides=["seed=3"]), []

    def simulated(scenario: Scenario, *_: object) -> RolloutError:
        seeds.append(scenario.seed)
        k = len(seeds) - 1
        failure = "it fell" if k in failing else None
        return RolloutError({"knee": errors[k]}, {}, {}, 1.0, failure)

    monkeypatch.setattr("fbse_drake.discrepancy.residual.rollout._simulated_error", simulated)
    channels = {"time": np.arange(2.0), "joint/position": np.zeros((2, 1))}
    log = Log(channels, {"joints": ["knee"], "period": 1.0})
    other = None if beside is None else RolloutError({"knee": beside}, {}, {}, 1.0, None)
    assert rollout(walk, log, beside=other).mean_position == pytest.approx(median)
    assert seeds == [4, 5, 6][:drawn]


@pytest.mark.parametrize(
    ("step", "found"),
    [
        ("predicting", []),
        ("looking", []),
        ("finding what would", ["TorqueGain"]),
    ],
)
def test_an_interrupted_diagnosis_says_what_is_known(step: str, found: list[str]) -> None:
    """It never says that nothing is missing, rules nothing out, and its JSON is whole."""

    def progress(text: str, share: float = 0.0) -> None:  # noqa: ARG001
        nonlocal interrupted
        if text.startswith(step) and not interrupted:
            interrupted = True
            raise Interrupted("time is up")

    interrupted = False
    hidden = "!TorqueGain {shortfall: {left_knee_pitch: 0.04}}"
    few = [library()[name] for name in ("TorqueGain", "TorqueBias", "ViscousFriction")]
    partial = diagnose(Predictor(scenario(), log_with(hidden)), few, progress=progress)
    assert partial.partial == "time is up"
    assert [finding.effect for finding in partial.chosen] == found
    assert partial.verdict in (("effect_found",) if found else ("unknown_effect", "not_visible"))
    content = json.loads(json.dumps(diagnosis_json(partial)))
    assert content["partial"]
    assert content["interrupted_because"] == "time is up"
    assert not any(status["verdict"] == "absent" for status in content["effects"].values())


def test_an_interrupted_study_keeps_what_was_found() -> None:
    """The simulation of the model is left out."""

    def progress(text: str, share: float = 0.0) -> None:  # noqa: ARG001
        if text.startswith("simulating"):
            raise Interrupted("time is up")

    hidden = "!TorqueGain {shortfall: {left_knee_pitch: 0.04}}"
    result = study(scenario(), log_with(hidden), [library()["TorqueGain"]], progress=progress)
    assert result.partial
    assert result.stopped_because == "time is up"
    assert [finding.effect for finding in result.found] == ["TorqueGain"]
    assert all(step.rollout is None for step in result.steps)
    assert study_json(result)["partial"]


def test_a_simpler_effect_is_an_alternative_unless_chance_cannot_explain_the_difference() -> None:
    predictor = Predictor(scenario(), log_with("!TorqueBias {bias: {left_knee_pitch: 5.0}}"))
    fits = Fits(Dictionary(predictor, [JointSpring, TorqueBias]))
    additions = best_additions(Proposals(fits), fits.explain([]))
    spring, bias = (
        next(e for e in additions if e.candidates[0].effect is c) for c in (JointSpring, TorqueBias)
    )
    for charge, as_good in ((11.0, True), (60.0, False)):
        better = replace(spring, deviance=bias.deviance - charge)
        assert bool(indistinguishable(fits, {0: [bias]}, better)[0]) == as_good
        # The other way round, parameters that are not needed are none in its favour.
        better = replace(bias, deviance=spring.deviance - charge)
        assert indistinguishable(fits, {0: [spring]}, better) == {0: []}


@pytest.mark.parametrize(
    "hidden",
    ["!BodyMass {mass: {left_foot: 3.5}}", "!FootForceLag {time_constant: {right: 0.045}}"],
)
def test_what_a_large_effect_leaves_over_is_noise(hidden: str) -> None:
    """A heavy foot hits the ground harder than smoothed accelerations tell; a foot that reads late
    seems to stand while it lifts."""
    candidates = [
        library()[name]
        for name in (hidden[1:].split()[0], "CoulombFriction", "TorqueBias", "FootForceGain")
    ]
    diagnosis = diagnose(Predictor(scenario(), log_with(hidden)), candidates)
    assert diagnosis.verdict == "effect_found"
    assert [f.effect for f in diagnosis.chosen] == [hidden[1:].split()[0]]
    assert not diagnosis.unexplained
    assert diagnosis.held_out_after < 1.1 < 5.0 < diagnosis.held_out_before


@pytest.mark.parametrize(
    ("hidden", "expected"),
    [
        ("!BodyMass {mass: {left_foot: 3.5}}", "BodyMass"),
        ("!Payload {mass: {left_foot: 2.0}, x: {left_foot: 0.06}}", "Payload"),
    ],
)
def test_a_payload_is_compared_with_a_mass_where_a_foot_lands_as_hard_as_it_is_heavy(
    hidden: str, expected: str
) -> None:
    """That is in the model; made linear, a payload takes some of what smoothed accelerations do not
    tell of an impact."""
    effects = [library()[name] for name in ("BodyMass", "Payload")]
    proposals = Proposals(Fits(Dictionary(Predictor(scenario(), log_with(hidden)), effects)))
    fits, nothing = proposals.fits, proposals.fits.explain([])
    (payload,) = (
        c for c in fits.fixed_candidates if (c.name, c.targets) == ("Payload", ("left_foot",))
    )
    explanation = fits.explain([proposals.settled(payload, nothing)])
    (member,) = simplified_in_model(proposals, explanation).candidates
    assert member.name == expected


def test_a_ripple_is_not_seen_in_a_joint_that_stands_still() -> None:
    """Within a milliradian a ripple of any period is a bias and a spring."""
    candidates = [library()[name] for name in ("TorqueRipple", "JointSpring", "TorqueBias")]
    values = (
        "sine: {left_hip_yaw: 2.0, left_knee_pitch: 1.0}, cosine: {left_hip_yaw: 0.5, "
        "left_knee_pitch: 0.5}, cycles: {all: 100}"
    )
    hidden = f"!TorqueRipple {{{values}}}"
    diagnosis = diagnose(Predictor(scenario(), log_with(hidden)), candidates)
    named = {target: finding.effect for finding in diagnosis.chosen for target in finding.targets}
    assert named["left_knee_pitch"] == "TorqueRipple"
    assert named["left_hip_yaw"] in ("JointSpring", "TorqueBias")
    assert diagnosis.effects["TorqueRipple"].smallest_detectable["left_hip_yaw"] == np.inf
    assert diagnosis.effects["TorqueRipple"].smallest_detectable["left_knee_pitch"] < 1.0


def test_no_body_loses_more_than_it_weighs() -> None:
    predictor, mass = Predictor(scenario(), log_with("")), library()["BodyMass"]
    foot = predictor.robot.body("left_foot").default_mass()
    assert [
        predictor.is_possible(mass, "left_foot", np.array([share * foot]))
        for share in (-1.1, -0.9, 5.0)
    ] == [False, True, True]


def test_study_adds_what_it_finds_and_the_errors_fall() -> None:
    hidden = "!TorqueGain {shortfall: {left_knee_pitch: 0.04}}"
    result = study(scenario(), log_with(hidden).part(slice(0, 1601)), effects())
    before, after = result.steps
    assert after.held_out_rmse < 1.2 < before.held_out_rmse
    assert (
        after.rollout.position["left_knee_pitch"] < 0.5 * before.rollout.position["left_knee_pitch"]
    )
    assert "noise floor" in result.stopped_because
    added = result.scenario.believed.effects["torque_gain"]
    assert added.shortfall["left_knee_pitch"] == pytest.approx(0.04, rel=0.05)
    content = study_json(result)
    assert set(content) >= {"steps", "noise_floor", "stopped_because"}
    assert set(content["steps"][1]) >= {"added", "held_out_rmse", "train_rmse"}


def test_added_effects_are_taken_off_the_residual_exactly_as_they_were_fitted() -> None:
    for hidden in ("!BodyMass {mass: {trunk: 2.0}}", "!AccelerometerBias {x: 0.1, y: -0.05}"):
        wiser = add(scenario(), read_findings(diagnosis_json(diagnosis_of(hidden))))
        assert not diagnose(Predictor(wiser, log_with(hidden)), effects()).chosen


def test_adding_what_a_diagnosis_has_not_got() -> None:
    content = diagnosis_json(diagnosis_of("!TorqueGain {shortfall: {left_knee_pitch: 0.04}}"))
    with pytest.raises(InputError, match="no effect Backlash"):
        read_findings(content, "Backlash")
    with pytest.raises(InputError, match="not the contents of a diagnosis"):
        read_findings({"verdict": "effect_found"})


def test_planned_motion_satisfies_the_equation_of_motion() -> None:
    """A log made from a plan alone leaves no residual, on one leg and on two."""
    wanted = load_scenario("frictionless_walk", overrides=["duration=3"])
    residual = Predictor(wanted, planned_log(wanted)).residual
    dynamic = [k for k, row in enumerate(residual.rows) if row.kind != "kinematic"]
    assert np.sqrt((residual.value[:, dynamic] ** 2).mean()) < 0.5
    fits = Fits(Dictionary(Predictor(wanted, planned_log(wanted)), [library()["ViscousFriction"]]))
    size = smallest_detectable(fits, fits.noise_alone, library()["ViscousFriction"])
    # The hip yaw does not move in a straight walk.
    assert size["left_hip_yaw"] > 100 * size["left_knee_pitch"]


@pytest.mark.parametrize(("compliance", "matters"), [(4e-8, False), (1e-6, True)])
def test_ground_that_gives_a_little_more_is_nobodys_concern(
    compliance: float, matters: bool
) -> None:
    """The ground believed gives way by 1e-6 m/N."""
    log = log_with(f"!GroundCompliance {{compliance: {compliance}}}")
    diagnosis = diagnose(Predictor(scenario(), log), [library()["GroundCompliance"]])
    assert bool(diagnosis.chosen) == matters
    assert diagnosis.verdict == ("effect_found" if matters else "nothing_missing")


@pytest.mark.parametrize(
    ("offset", "deviation", "can_be"),
    [(0.02, 0.001, True), (0.031, 0.001, True), (0.1, 0.001, False), (0.62, 0.2, False)],
)
def test_an_implausible_offset_is_no_finding_however_badly_it_is_known(
    offset: float, deviation: float, can_be: bool
) -> None:
    """An encoder's zero is off by some hundredths of a radian; an interval that reaches there from
    0.62 rad does not make it so."""
    effect = library()["EncoderOffset"]
    signature = Signature(np.array([0]), np.zeros((5, 1, 1)))
    candidate = Candidate(
        effect, ("knee",), effect.parameters, np.zeros(0), signature, source=signature
    )
    fit = SimpleNamespace(
        parameters=np.array([offset]),
        deviation=np.array([deviation]),
        interval=lambda: offset + 2 * deviation * np.array([[-1.0, 1.0]]),
    )
    fits = SimpleNamespace(
        required=lambda _: 20.0,
        explain=lambda _: base,
        dictionary=SimpleNamespace(
            per_step=True, predictor=SimpleNamespace(is_possible=lambda *_: True)
        ),
    )
    base, wider = (
        SimpleNamespace(deviance=d, sse=np.array([d]), solved=fit, start=lambda _: 0, candidates=())
        for d in (1e4, 1e2)
    )
    assert is_significant(fits, base, wider, candidate) is can_be


def test_what_is_believed_of_a_vector_holds_in_all_axes() -> None:
    """With a belief of 1 nothing longer than 3 is believed, whichever axes it is measured in."""
    generator = np.random.default_rng(4)
    sure, one = np.zeros(3), np.ones(3)
    for length, is_long in ((2.9, False), (3.1, True)):
        for direction in generator.normal(size=(20, 3)):
            vector = length * direction / np.linalg.norm(direction)
            interval = np.stack([vector, vector], axis=1)
            assert is_disbelieved(vector, one, one, sure, interval) == is_long
            # What is plausible is believed.
            assert not is_disbelieved(vector, one, 4.0 * one, sure, interval)
            # Of a number of which nothing is believed nothing is disbelieved.
            arguments = [
                np.append(of_vector, [more], axis=0)
                for of_vector, more in (
                    (vector, 1e6),
                    (one, np.inf),
                    (one, 1.0),
                    (sure, 1.0),
                    (interval, [1e6, 1e6]),
                )
            ]
            assert is_disbelieved(*arguments) == is_long


def test_what_the_log_does_not_tell_from_nothing_does_not_make_a_vector_long() -> None:
    """A component of 5 +- 4 with a belief of 1 is 5 / 17 beside that belief; one of 5 +- 1 is 5,
    for the log tells it from nothing."""
    for deviation, is_long in ((4.0, False), (1.0, True)):
        values, half, one = np.array([0.1, 5.0]), 2.0 * deviation, np.ones(2)
        intervals = np.array([[0.09, 0.11], [5.0 - half, 5.0 + half]])
        deviations = np.array([0.01, deviation])
        assert is_disbelieved(values, one, one, deviations, intervals) == is_long


def test_what_two_effects_add_together_is_no_third_one() -> None:
    """A foot's sensor that is turned by a quarter of a rad and reads a fifth too much: more than a
    hundred times the sensors' noise."""
    effects = {
        "turned": FootForceMisalignment(x={"right": 0.15}, y={"right": 0.2}),
        "gain": FootForceGain({"right": 0.2}),
    }
    given = load_scenario("paper_walk", overrides=["duration=3"])
    robot = replace(given.robot, effects=given.robot.effects | effects)
    log = simulate(replace(given, robot=robot)).log
    diagnosis = diagnose(
        Predictor(replace(given, model=given.robot), log), [FootForceGain, FootForceMisalignment]
    )
    assert diagnosis.verdict == "effect_found"
    assert diagnosis.held_out_before > 100
    assert diagnosis.held_out_after < 1.1
    found = {f.effect: f.parameters for f in diagnosis.chosen}
    assert found.keys() == {"FootForceGain", "FootForceMisalignment"}
    for effect, values in (
        ("FootForceMisalignment", {"x": 0.15, "y": 0.2, "z": 0.0}),
        ("FootForceGain", {"gain": 0.2}),
    ):
        for name, value in values.items():
            assert found[effect][name].value == pytest.approx(value, abs=1e-3)
