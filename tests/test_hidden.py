"""Blind exercises: what is drawn, that it is in the log and nowhere else, and how answers are
scored."""

import base64
import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fbse_drake import InputError, Log, Scenario, load_scenario
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.exercises.hidden import (
    Answer,
    HiddenEffect,
    draw,
    make_exercise,
    record,
    reveal,
    score,
    seal,
    unseal,
)
from fbse_drake.discrepancy.exercises.sizes import SIZES
from fbse_drake.discrepancy.exercises.strangers import STRANGERS
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.effects.effect import library
from fbse_drake.effects.joint_torque import JointMotion
from fbse_drake.robot.description import load_description
from fbse_drake.scenario import dump_scenario

JOINT = "left_knee_pitch"


@pytest.fixture(scope="module")
def walk() -> Scenario:
    return load_scenario("paper_walk", overrides=["duration=0.3"])


def answer(
    effect: str = "TorqueBias", *targets: str, kind: str = "library", **parameters: float
) -> Answer:
    values = {name: dict.fromkeys(targets, value) for name, value in parameters.items()}
    return Answer(kind, "medium", 1.0, (HiddenEffect(effect, targets, 1.0, values),))


def diagnosis(
    *findings: tuple[str, tuple[str, ...], dict],
    verdict: str = "effect_found",
    unexplained: tuple[str, ...] = (),
) -> dict:
    """What diagnosis.json has of such findings: effect, targets, and intervals or
    `confusable_with`."""
    ranking = []
    for effect, targets, more in findings:
        parameters = {
            name: {"value": sum(i) / 2, "interval": list(i), "unit": ""}
            for name, i in more.get("intervals", {}).items()
        }
        confusable = more.get("confusable_with", [])
        ranking.append(
            {
                "effect": effect,
                "joints": list(targets),
                "parameters": parameters,
                "confusable_with": confusable,
                "chosen": True,
            }
        )
    return {
        "verdict": verdict,
        "ranking": ranking,
        "unexplained": [{"row": row} for row in unexplained],
    }


# Strangers.


def test_strangers_are_not_in_the_library():
    assert not set(STRANGERS) & set(library())


@pytest.mark.parametrize("name", STRANGERS)
def test_slope_of_a_stranger_is_the_derivative_of_its_torque(name: str):
    effect = STRANGERS[name]
    nonlinear = np.array([[0.4], [0.1]])[: sum(not p.linear for p in effect.parameters.values())]
    v, h = np.array([[-0.03, 0.002, 0.02]]), 1e-7

    def torque(velocity: np.ndarray) -> np.ndarray:
        return np.asarray(
            effect.basis(
                JointMotion(velocity, np.array([0.3, 0.45, 0.6]), np.array([5.0, -3.0, 8.0]), 0.7),
                nonlinear,
            )[0][0]
        )

    slope = effect.basis(
        JointMotion(v, np.array([0.3, 0.45, 0.6]), np.array([5.0, -3.0, 8.0]), 0.7), nonlinear
    )[1][0]
    assert np.allclose((torque(v + h) - torque(v - h)) / (2 * h), slope, rtol=1e-5, atol=1e-6)


def test_hum_has_one_frequency():
    time = np.arange(2000)[:, None] * 1e-3
    (torque,), _ = STRANGERS["TorqueHum"].basis(
        JointMotion(np.zeros((2000, 1)), time=time), np.array([[7.0]])
    )
    spectrum = np.abs(np.fft.rfft(torque[:, 0])) / 1000
    assert np.argmax(spectrum) == 14  # 7 Hz over 2 s
    assert spectrum[14] == pytest.approx(1.0)
    assert np.delete(spectrum, 14).max() < 1e-9


def test_neighbour_torque_is_that_of_the_joint_before():
    (torque,), _ = STRANGERS["NeighbourTorque"].basis(
        JointMotion(np.zeros(3), command=np.array([1.0, 2.0, 3.0])), np.zeros((0, 3))
    )
    assert torque.tolist() == [3.0, 1.0, 2.0]


def test_dropouts_take_the_command_for_short_moments():
    time = np.arange(20000)[:, None] * 1e-3
    (torque,), _ = STRANGERS["TorqueDropouts"].basis(
        JointMotion(np.zeros((20000, 1)), command=4.0, time=time), np.zeros((0, 1))
    )
    assert set(np.unique(torque)) == {0.0, 4.0}
    starts = np.flatnonzero(np.diff(torque[:, 0]) > 0)
    lengths = np.flatnonzero(np.diff(torque[:, 0]) < 0)[: len(starts)] - starts
    assert 0.02 < (torque > 0).mean() < 0.2
    assert lengths.max() < 150  # [ms]
    # Not periodic.
    assert np.ptp(np.diff(starts)) > 100


# What is drawn.


@pytest.mark.parametrize(
    "name", [name for name, effect in library().items() if not effect.composite] + list(STRANGERS)
)
def test_every_effect_is_drawn_with_values_that_it_accepts(name: str, walk: Scenario):
    names, _ = load_description("biped")
    (hidden,) = draw(walk, 3, what=name, size="medium").effects
    assert hidden.effect == name
    resolved = hidden.make().resolve(names)
    if resolved.effect.acts_on == "joint" and any(
        parameter.linear for parameter in resolved.effect.parameters.values()
    ):
        acts = np.any(resolved.linear != 0, axis=0)
        assert acts.tolist() == np.isin(names.joint_names, hidden.targets).tolist()


def test_a_rough_spot_has_a_width_in_a_joint_that_stands_still(walk: Scenario):
    names, _ = load_description("biped")
    drawn = [draw(walk, seed, what="RoughSpot").effects[0] for seed in range(40)]
    assert any("left_hip_yaw" in hidden.targets for hidden in drawn)
    for hidden in drawn:
        hidden.make().resolve(names)


@pytest.mark.parametrize("name", ["CoulombFriction", "GroundSlope", "Backlash"])
def test_sizes_are_thirds_and_shrinking_scales_them(name: str, walk: Scenario):
    sizes = [draw(walk, 3, what=name, size=size).effects[0] for size in SIZES]
    assert sizes[0].targets == sizes[1].targets == sizes[2].targets
    ratios = [b.size / a.size for a, b in itertools.pairwise(sizes)]
    assert ratios[0] == pytest.approx(ratios[1])
    assert ratios[0] > 1.5
    half = draw(walk, 3, what=name, size="large", shrunk=0.5).effects[0]
    parameter = next(iter(half.parameters))
    for target in half.targets:
        assert half.parameters[parameter][target] == pytest.approx(
            0.5 * sizes[2].parameters[parameter][target]
        )


def test_saturation_cuts_off_a_share_of_the_planned_torque(walk: Scenario):
    hidden = draw(walk, 0, what="TorqueSaturation", size="large").effects[0]
    log = make_exercise(walk, "walk", 0, what="decoy").log
    for target, limit in hidden.parameters["limit"].items():
        largest = np.abs(
            log["reference/joint/feedforward_torque"][:, log.joints.index(target)]
        ).max()
        assert limit == pytest.approx((1 - hidden.size) * largest, rel=0.02)


def test_a_seed_decides_and_all_kinds_come_up(walk: Scenario):
    drawn = [draw(walk, seed) for seed in range(32)]
    assert drawn[7] == draw(walk, 7)
    kinds = [a.kind for a in drawn]
    assert 1 <= kinds.count("decoy") <= 10
    assert 1 <= kinds.count("stranger") <= 10
    effects = [a.effects[0].effect for a in drawn if a.kind == "library"]
    assert len(set(effects)) > 10
    assert all(not a.effects for a in drawn if a.kind == "decoy")


def test_several_effects_differ_and_share_no_joint(walk: Scenario):
    for seed in range(5):
        hidden = draw(walk, seed, what="library", count=3).effects
        assert len({effect.effect for effect in hidden}) == 3
        joints = [
            t
            for effect in hidden
            if library()[effect.effect].acts_on == "joint"
            for t in effect.targets
        ]
        assert len(joints) == len(set(joints))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"what": "Rust"}, "what: expected one of any, library, decoy, stranger, .*found Rust"),
        ({"size": "huge"}, "size: expected one of small, medium, large, found huge"),
        ({"what": "library", "count": 0}, "count: expected 1 to"),
    ],
)
def test_bad_wishes_are_refused(walk: Scenario, arguments: dict, message: str):
    with pytest.raises(InputError, match=message):
        draw(walk, 0, **arguments)


# Exercises.


def test_hidden_bias_is_what_the_command_has_more():
    """In a gantry the joint follows its reference, so the motor must be told to give the missing
    torque as well."""
    swing = load_scenario("leg_swing_gantry", overrides=["duration=1"])
    hidden = make_exercise(swing, "swing", 5, what="TorqueBias", size="large")
    without = make_exercise(swing, "swing", 5, what="decoy")
    bias = hidden.answer.effects[0].make().resolve(load_description("biped")[0]).linear[0]
    assert np.abs(bias).max() > 4
    rows = slice(300, None)
    more = (hidden.log["joint/torque_command"] - without.log["joint/torque_command"])[rows].mean(
        axis=0
    )
    assert np.allclose(more, bias, atol=0.02 * np.abs(bias).max())


def test_a_gantry_hides_only_what_acts_on_joints():
    swing = load_scenario("leg_swing_gantry", overrides=["duration=1"])
    names = {draw(swing, seed, what="library").effects[0].effect for seed in range(30)}
    assert {library()[name].acts_on for name in names} == {"joint"}


def test_exercise_tells_nothing_but_what_a_robot_would(walk: Scenario, tmp_path: Path):
    make_exercise(walk, "paper_walk", 2, what="StribeckFriction").save(tmp_path)
    log, scenario = Log.load(tmp_path / "log.npz"), load_scenario(tmp_path / "scenario.yaml")
    assert not [name for name in log if name.startswith(("truth/", "estimate/"))]
    # The model has what the robot was known to have, and the robot in the file no more.
    assert dump_scenario(scenario, "paper_walk") == dump_scenario(
        replace(walk, model=walk.robot), "paper_walk"
    )
    assert (tmp_path / "scenario.yaml").read_text() == log.meta["scenario"]
    sealed = (tmp_path / "answer.sealed").read_text()
    assert "Stribeck" not in sealed
    assert b"Stribeck" not in base64.b64decode(sealed.split()[1])
    revealed = reveal(tmp_path)
    assert revealed.answer.effects[0].effect == "StribeckFriction"
    assert revealed.score is None
    again = make_exercise(walk, "paper_walk", 2, what="StribeckFriction")
    assert np.array_equal(again.log["joint/torque_command"], log["joint/torque_command"])


def test_noise_is_not_that_of_the_public_seed(walk: Scenario, run):
    shown = make_exercise(walk, "paper_walk", 0, what="decoy").log
    public = run("paper_walk", "duration=0.3")
    # The same walk in other noise.
    difference = shown["imu/linear_acceleration"][0] - public["imu/linear_acceleration"][0]
    assert 1e-4 < np.abs(difference).max() < 0.2


def test_a_robot_that_falls_gets_half_the_size(walk: Scenario):
    """An encoder that is off by an angle tilts the trunk by about as much."""
    touchy = replace(walk, fall=replace(walk.fall, tilt=2e-3))
    whole = draw(touchy, 1, what="EncoderOffset", size="large").effects[0]
    exercise = make_exercise(touchy, "walk", 1, what="EncoderOffset", size="large")
    shrunk = exercise.answer.shrunk
    assert shrunk in (0.5, 0.25, 0.125, 0.0625)
    assert exercise.answer.effects[0].size == pytest.approx(shrunk * whole.size)
    assert exercise.log.meta["outcome"]["finished"]
    with pytest.raises(InputError, match=r"nothing can be hidden in this scenario: t = .* s: fell"):
        make_exercise(
            replace(walk, fall=replace(walk.fall, tilt=1e-7)), "walk", 1, what="EncoderOffset"
        )


@pytest.mark.parametrize("coulomb", [0.3, 8.0])
def test_steep_friction_explains_its_log(coulomb: float):
    """At rest, 8 Nm that change their sign within 5 mrad/s would turn an ankle of 0.01 kg m^2 a
    hundred times in one step; what the answer leaves over is little more than noise."""
    walk = load_scenario("paper_walk", overrides=["duration=1.5"])
    steep = answer("CoulombFriction", "right_ankle_roll", coulomb=coulomb, transition=0.005)
    exercise = record(walk, "paper_walk", steep, 3)
    effects = exercise.scenario.believed.effects | {"hidden": steep.effects[0].make()}
    model = replace(exercise.scenario.believed, effects=effects)
    predictor = Predictor(replace(exercise.scenario, model=model), exercise.log)
    white = WhitenedResidual(predictor.residual)
    row = predictor.robot.joint_names.index("right_ankle_roll")
    assert white.sse[row] <= 1.5**2 * white.count[row]


# Answers and scores.


def test_a_sealed_answer_opens_again_unless_it_was_touched():
    hidden = answer("CoulombFriction", JOINT, "right_knee_pitch", coulomb=2.0)
    text = seal(hidden)
    assert unseal(text) == hidden
    checksum, content = text.split()
    data = bytearray(base64.b64decode(content))
    data[-1] ^= 1
    for damaged in (
        f"{checksum}\n{base64.b64encode(bytes(data)).decode()}\n",
        content,
        f"{checksum}\n???\n",
        "",
    ):
        with pytest.raises(InputError, match="the sealed answer is damaged"):
            unseal(damaged)


def test_right_answer():
    found = diagnosis(("TorqueBias", (JOINT,), {"intervals": {"bias": (1.5, 2.5)}}))
    result = score(answer("TorqueBias", JOINT, bias=2.0), [found])
    assert result.verdict
    assert result.first
    assert result.found == result.targets == {"TorqueBias": True}
    assert result.covered == {f"TorqueBias.{JOINT}.bias": True}
    assert result.wrong == ()


def test_interval_that_misses_and_joint_that_is_too_much():
    found = diagnosis(("TorqueBias", (JOINT, "left_hip_yaw"), {"intervals": {"bias": (2.1, 2.5)}}))
    result = score(answer("TorqueBias", JOINT, bias=2.0), [found])
    assert result.found == {"TorqueBias": True}
    assert result.targets == {"TorqueBias": False}
    assert result.covered == {f"TorqueBias.{JOINT}.bias": False}


def test_an_interval_of_several_targets_counts_once_for_each_true_value():
    found = diagnosis(
        (
            "TorqueBias",
            (JOINT, "right_knee_pitch", "left_hip_yaw"),
            {"intervals": {"bias": (1.5, 2.5)}},
        )
    )
    hidden = answer("TorqueBias", JOINT, "right_knee_pitch", bias=2.0)
    assert list(score(hidden, [found]).covered.values()) == [True]
    values = {"bias": {JOINT: 2.0, "right_knee_pitch": 3.0}}
    different = replace(hidden, effects=(replace(hidden.effects[0], parameters=values),))
    assert sorted(score(different, [found]).covered.values()) == [False, True]


def test_declared_alternative_is_neither_found_nor_wrong():
    found = diagnosis(("JointSpring", (JOINT,), {"confusable_with": ["TorqueBias"]}))
    result = score(answer("TorqueBias", JOINT, bias=2.0), [found])
    assert result.found == {"TorqueBias": False}
    assert result.confusable == {"TorqueBias": True}
    assert not result.first
    assert result.wrong == ()


def test_wrong_name():
    result = score(
        answer("TorqueBias", JOINT, bias=2.0), [diagnosis(("JointSpring", (JOINT,), {}))]
    )
    assert result.confusable == {"TorqueBias": False}
    assert result.wrong == ("JointSpring",)


def test_what_a_later_round_finds_counts():
    two = replace(
        answer("TorqueBias", JOINT),
        effects=answer("TorqueBias", JOINT).effects + answer("BodyMass", "trunk").effects,
    )
    rounds = [diagnosis(("BodyMass", ("trunk",), {})), diagnosis(("TorqueBias", (JOINT,), {}))]
    assert score(two, rounds).found == {"TorqueBias": True, "BodyMass": True}
    assert score(two, rounds[:1]).found == {"TorqueBias": False, "BodyMass": True}


@pytest.mark.parametrize("is_small", [True, False])
def test_who_says_that_what_is_hidden_is_too_small_to_matter_is_right(is_small: bool):
    """Who has it among what may be there instead does not say so."""
    found = diagnosis(("TorqueBias", (JOINT,), {}), verdict="nothing_missing")
    found["ranking"][0] |= {"chosen": False, "too_small": is_small}
    result = score(answer("TorqueBias", JOINT, bias=2.0), [found])
    assert result.verdict is is_small
    assert result.found == {"TorqueBias": is_small}
    assert result.wrong == ()


@pytest.mark.parametrize(
    ("shown", "is_visible"),
    [({JOINT: 1.9}, True), ({JOINT: 2.1, "left_hip_yaw": 0.1}, False), ({JOINT: None}, False)],
)
def test_who_misses_what_a_log_cannot_show_is_right(shown: dict, is_visible: bool):
    """By what the diagnosis itself states of the joint that has it."""
    status = {"TorqueBias": {"smallest_detectable_by_target": shown}}
    nothing = diagnosis(verdict="nothing_missing") | {"effects": status}
    result = score(answer("TorqueBias", JOINT, bias=-2.0), [nothing])
    assert result.visible == {"TorqueBias": is_visible}
    assert result.verdict is not is_visible
    assert not result.first
    assert ("too small to show in this log" in result.text) is not is_visible
    found = diagnosis(("TorqueBias", (JOINT,), {})) | {"effects": status}
    assert score(answer("TorqueBias", JOINT, bias=-2.0), [found]).visible == {"TorqueBias": True}


def test_a_low_limit_and_a_long_vector_are_large_effects():
    limit = answer("TorqueSaturation", JOINT, limit=20.0).effects[0]
    assert limit.exceeds(JOINT, 30.0)
    assert not limit.exceeds(JOINT, 10.0)
    assert not limit.exceeds(JOINT, np.inf)
    slope = answer("GroundSlope", "robot", x=0.003, y=0.004).effects[0]
    assert slope.exceeds("robot", 0.0049)
    assert not slope.exceeds("robot", 0.0051)


def test_decoy():
    decoy = Answer("decoy", "small", 1.0, ())
    assert score(decoy, [diagnosis(verdict="nothing_missing")]).verdict
    alarm = score(decoy, [diagnosis(("TorqueBias", (JOINT,), {}))])
    assert not alarm.verdict
    assert alarm.wrong == ("TorqueBias",)


def test_stranger():
    hum = answer("TorqueHum", JOINT, kind="stranger")
    # Rows that are no joints do not count.
    admitted = score(
        hum,
        [diagnosis(verdict="unknown_effect", unexplained=(JOINT, "left_sole/angular_velocity_x"))],
    )
    assert admitted.verdict
    assert admitted.joints
    elsewhere = score(
        hum, [diagnosis(verdict="unknown_effect", unexplained=(JOINT, "left_hip_yaw"))]
    )
    assert not elsewhere.joints
    named = score(hum, [diagnosis(("TorqueRipple", (JOINT,), {}))])
    assert not named.verdict
    assert named.wrong == ("TorqueRipple",)


def test_reveal_scores_what_is_in_the_folder(tmp_path: Path):
    hidden = answer("TorqueBias", JOINT, bias=2.0)
    (tmp_path / "answer.sealed").write_text(seal(hidden))
    (tmp_path / "diagnosis.json").write_text(json.dumps(diagnosis(("JointSpring", (JOINT,), {}))))
    assert reveal(tmp_path).score.wrong == ("JointSpring",)
    assert reveal(tmp_path).answer == hidden
    # A study knows more than a diagnosis.
    right = diagnosis(("TorqueBias", (JOINT,), {}))
    (tmp_path / "study.json").write_text(json.dumps({"diagnoses": [right]}))
    assert reveal(tmp_path).score.first
    (tmp_path / "study.json").write_text("{}")
    with pytest.raises(
        InputError, match=r"study.json: not the contents of a study.json: .*diagnoses is missing"
    ):
        reveal(tmp_path)


def test_reveal_without_an_exercise(tmp_path: Path):
    with pytest.raises(
        InputError, match=r"answer.sealed: No such file or directory; fbse hide makes one"
    ):
        reveal(tmp_path)
    (tmp_path / "answer.sealed").write_text("nothing")
    with pytest.raises(InputError, match=r"answer.sealed: the sealed answer is damaged"):
        reveal(tmp_path)
