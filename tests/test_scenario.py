import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import scenario

from fbse_drake import InputError, Scenario, build_station, load_scenario, resources, simulate
from fbse_drake.effects.friction import CoulombFriction, StribeckFriction
from fbse_drake.errors import require_not_negative, require_positive
from fbse_drake.scenario import RobotConfig, dump_scenario
from fbse_drake.walking.stand import Squat
from fbse_drake.wiring import release

SHIPPED = sorted(path.stem for path in resources.folder("scenarios").glob("*.yaml"))


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_scenario_loads_and_builds(name: str):
    release(build_station(scenario(name)))


@pytest.mark.parametrize("name", SHIPPED)
def test_scenario_survives_being_written_and_read(name: str, tmp_path: Path):
    original = load_scenario(name, overrides=["seed=7"])
    again = load_scenario(written(tmp_path, dump_scenario(original, name)), name)
    assert dump_scenario(again, name) == dump_scenario(original, name)
    assert again == original
    other = load_scenario(name, overrides=["seed=7", "plant.stiction_tolerance=0.0123"])
    assert other != original


def test_a_named_child_is_chosen(tmp_path: Path):
    path = written(tmp_path, "a: {seed: 1}\nb: {seed: 2}\nmine: {seed: 3}\n")
    assert load_scenario(path, "b").seed == 2
    assert load_scenario(path).seed == 3
    with pytest.raises(InputError, match=r"no scenario called c \(there are: a, b, mine\)"):
        load_scenario(path, "c")


def test_overrides_go_on_top():
    result = load_scenario(
        "paper_walk",
        overrides=["reference.step_length=0.05", "control.kp.hip_roll=2500", "log.period=2e-3"],
    )
    assert result.reference.step_length == 0.05
    assert result.reference.single_supports == 7
    assert result.control.kp["hip_roll"] == 2500.0
    assert result.control.kp["hip_yaw"] == 6000.0
    assert result.log.period == 0.002


def test_an_override_can_choose_another_reference():
    result = load_scenario("paper_walk", overrides=["reference=!Squat {amplitude: 0.01}"])
    assert result.reference == Squat(amplitude=0.01)


def test_an_override_can_take_an_effect_away():
    assert isinstance(load_scenario("paper_walk").robot.effects["joint_friction"], StribeckFriction)
    assert (
        load_scenario("paper_walk", overrides=["robot.effects.joint_friction=null"]).robot.effects
        == {}
    )


def test_the_model_is_the_robot_without_its_effects():
    robot = load_scenario("hrp2_friction_walk").robot
    believed = load_scenario("hrp2_friction_walk").believed
    assert believed == RobotConfig(robot.description, robot.gantry_height, robot.rotor_inertia)
    assert believed.effects == {}


def bomb(begin: str, end: str) -> str:
    """YAML each of whose lines stands for ten times as many values as the one before."""
    lines = (f"a{i}: &a{i} {begin}{', '.join([f'*a{i - 1}'] * 10)}{end}" for i in range(1, 12))
    return "\n".join(["a0: &a0 {x: 1}", *lines])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "mine: {sed: 1}",
            r"mine\.yaml: mine: sed: unknown key, did you mean seed\? \(allowed: title, seed,",
        ),
        (
            "mine: {reference: !Walk {step_lenght: 1}}",
            r"reference\.step_lenght: unknown key, did you mean step_length\?",
        ),
        (
            "mine: {reference: !Hop {}}",
            (
                r"reference: expected one of !Walk, !Trot, !Squat, !Sway, !JointSines, "
                r"!Recorded, found the tag !Hop"
            ),
        ),
        ("mine: {robot: !Hop {}}", r"mine\.yaml: mine: robot: expected no tag, found '!Hop'"),
        ("mine: {duration: long}", r"duration: expected a number, found 'long'"),
        ("mine: {duration: .nan}", r"duration: expected a finite number, found nan"),
        ("mine: {duration: -1}", r"duration: expected a number > 0, found -1"),
        ("mine: {seed: 1.5}", r"seed: expected a whole number, found 1\.5"),
        ("mine: {seed: true}", r"seed: expected a whole number, found True"),
        ("mine: {control: 3}", r"control: expected a mapping, found 3"),
        (
            "mine: {control: {kp: {hip_yw: 1}}}",
            r"control\.kp\.hip_yw: unknown joint \(allowed: all, hip_yaw",
        ),
        ("mine: {control: {kd: {all: -1}}}", r"control\.kd\.all: expected a number >= 0, found -1"),
        (
            "mine: {control: {period: 0.0015}}",
            r"control\.period: expected a whole multiple of plant\.time_step",
        ),
        (
            "mine: {plant: {time_step: 0.002}, control: {period: 0.001}}",
            (
                r"control\.period: expected a whole multiple of plant\.time_step = 0\.002 s, "
                r"found 0\.001"
            ),
        ),
        (
            "mine: {plant: {time_step: 0.002}, sensors: {encoders: {period: 0.003}}}",
            r"sensors\.encoders\.period: expected a whole multiple of plant\.time_step = 0\.002 s",
        ),
        ("mine: {log: {period: 0}}", r"log\.period: expected a whole multiple"),
        (
            "mine: {sensors: {imu: {period: 0}}}",
            r"sensors\.imu\.period: expected a number > 0, found 0",
        ),
        ("mine: {plant: {time_step: 0}}", r"plant\.time_step: expected a number > 0"),
        (
            "mine: {ground: {stiffness: .inf}}",
            r"ground\.stiffness: expected a finite number, found inf",
        ),
        ("mine: {ground: {stiffness: 0}}", r"ground\.stiffness: expected a number > 0, found 0"),
        (
            "mine: {duration: 0.0005}",
            r"duration: expected at least control\.period = 0\.001 s, found 0\.0005",
        ),
        ("mine: {plant: {contact_model: soft}}", r"plant: Unknown contact_model: 'soft'"),
        (
            "mine: {plant: {stiction_tolerance: -1}}",
            r"plant\.stiction_tolerance: expected a number > 0, found -1",
        ),
        ("mine: {plant: {time_stp: 0}}", r"plant\.time_stp: unknown key, did you mean time_step\?"),
        (
            "mine: {robot: {description: nobody}}",
            r"nobody: no such file, and no such name in models/ \(there are: .*biped",
        ),
        ("mine: {robot: {rotor_inertia: {knee: 1}}}", r"robot\.rotor_inertia\.knee: unknown joint"),
        (
            "mine: {robot: {effects: {f: {gamma1: {all: 1}}}}}",
            r"robot\.effects\.f: expected one of .*!StribeckFriction",
        ),
        (
            "mine: {robot: {effects: {f: !StribeckFriction {gamma4: {all: -1}}}}}",
            r"robot\.effects\.f\.gamma4: expected values in",
        ),
        (
            "mine: {sensors: {imu: {acceleration_bias: 1}}}",
            r"sensors\.imu\.acceleration_bias: expected a list, found 1",
        ),
        ("mine: [1, 2]", r"expected a mapping, found a list"),
        ("- 1", r"mine\.yaml: expected a mapping of keys to values, found a list"),
        ("mine: {a: [}", r"mine\.yaml:1: not valid YAML"),
        ("mine: {title: 2020-01-01}", r"mine\.title: .* found the date 2020-01-01"),
        (r'"mine\ud83d": {}', r"half of a character, which no file can hold: 'mine\\ud83d'"),
        (r'mine: {ground: "\udc00"}', r"mine\.yaml: mine\.ground: half of a character"),
        ("mine: {duration: 2020-13-45}", r"mine\.yaml: not valid YAML: month must be in"),
        ("mine: {seed: " + "9" * 5000 + "}", r"mine\.yaml: not valid YAML: Exceeds the limit"),
        ("mine: {seed: 1" + "0" * 30 + "}", r"seed: expected a number of size at most 1e\+15"),
        ("mine: {ground: {stiffness: 1e300}}", r"ground\.stiffness: .* of size at most 1e\+15"),
        ("mine: {duration: 1e9}", r"duration: expected at most 1e\+08 steps of plant\.time_step"),
        ("mine: {reference: !Walk {single_supports: 99999}}", r"single_supports: .* at most 10000"),
        ("1: {}", r'mine\.yaml: expected a text as key, found 1; write "1"'),
        ("mine: {1: {}}", r'mine\.yaml: mine: expected a text as key, found 1; write "1"'),
        ("mine: {reference: {_tag: 5}}", r"reference\._tag: expected a text, found 5"),
        ("mine: &me {robot: *me}", r"not valid YAML: its aliases stand for too many values"),
        (bomb("[", "]"), r"not valid YAML: its aliases stand for too many values"),
        (bomb("{<<: [", "]}"), r"not valid YAML: its aliases stand for too many values"),
        ("mine: " + "[" * 5000 + "]" * 5000, r"not valid YAML: nested too deeply"),
    ],
)
def test_bad_input_gets_one_line_with_file_and_key(tmp_path: Path, text: str, message: str):
    with pytest.raises(InputError, match=message) as error:
        load_scenario(written(tmp_path, text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed", r"--set seed: expected KEY=VALUE"),
        ("=3", r"--set =3: expected KEY=VALUE"),
        ("seed={", r"--set seed=\{:1: not valid YAML: "),
        ("control.kp.hip=1", r"control\.kp\.hip: unknown joint"),
    ],
)
def test_bad_override_gets_one_line(override: str, message: str):
    with pytest.raises(InputError, match=message):
        load_scenario("squat", overrides=[override])


@pytest.mark.parametrize("overrides", ["duration=2", {"duration": 2}])
def test_overrides_are_a_list(overrides: object):
    with pytest.raises(InputError, match="overrides: expected a list of 'KEY=VALUE'"):
        load_scenario("paper_walk", overrides=overrides)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration": "2"}, "duration: expected a number, found '2'"),
        ({"seed": 1.5}, "seed: expected a whole number, found 1.5"),
        ({"estimator": "Fbse"}, "estimator: expected one of NoEstimator, .*; found 'Fbse'"),
        ({"reference": Squat}, "reference: expected one of Walk, .*; found <class .*Squat'>"),
        ({"plant": {}}, "plant: expected a MultibodyPlantConfig, found a mapping"),
        ({"robot": CoulombFriction()}, "robot: expected a RobotConfig, found CoulombFriction"),
        ({"robot": RobotConfig(effects=[CoulombFriction()])}, "robot.effects: expected a dict"),
        (
            {"robot": RobotConfig(effects={"rub": CoulombFriction(1.0)})},
            "robot.effects.rub.coulomb: expected a dict, found 1.0",
        ),
        (
            {"model": RobotConfig(effects={"rub": CoulombFriction({"all": "1"})})},
            "model.effects.rub.coulomb.all: expected a number, found '1'",
        ),
        (
            {"robot": RobotConfig(effects={"rub": CoulombFriction({"all": np.nan})})},
            "robot.effects.rub.coulomb.all: expected a finite number, found nan",
        ),
    ],
)
def test_what_is_made_in_code_is_refused_as_what_is_read(changes: dict, message: str):
    with pytest.raises(InputError, match=f"^{message}"):
        Scenario(**changes)


def test_an_effect_of_ones_own_need_not_be_in_the_library():
    class Rubbing(CoulombFriction):
        pass

    made = Scenario(robot=RobotConfig(effects={"rub": Rubbing({"all": 0.5})}))
    assert isinstance(made.robot.effects["rub"], Rubbing)
    with pytest.raises(InputError, match=r"^robot.effects.rub.coulomb.all: expected a number"):
        Scenario(robot=RobotConfig(effects={"rub": Rubbing({"all": "0.5"})}))


def test_numbers_of_numpy_are_numbers(tmp_path: Path):
    friction = CoulombFriction({"all": np.float32(0.5)}, {"all": np.float64(0.25)})
    robot = RobotConfig(effects={"rub": friction})
    made = Scenario(seed=np.int64(3), duration=np.float64(2.0), robot=robot)
    assert load_scenario(written(tmp_path, dump_scenario(made, "mine"))) == made


@pytest.mark.parametrize("call", [require_positive, require_not_negative])
def test_what_is_no_number_is_refused_as_such(call: Callable):
    with pytest.raises(InputError, match=r"^duration: expected a number, found 'long'$"):
        call(SimpleNamespace(duration="long"), "duration")


def test_the_model_has_the_robots_joints():
    """Also where the robot's effects are then of other joints than the model plans to move."""
    friction = "robot.effects={f: !ViscousFriction {viscous: {all: 1}}}"
    with pytest.raises(InputError, match=r"model: expected the robot's joints .*found \['servo'\]"):
        build_station(load_scenario("squat", None, [friction, "model={description: pendulum}"]))


def test_missing_file_lists_what_there_is():
    with pytest.raises(
        InputError,
        match=r"paper_wolk: no such file, and no such name in scenarios/ \(there are: .*paper_walk",
    ):
        load_scenario("paper_wolk")


def test_defaults_are_a_whole_scenario():
    assert Scenario().duration == 11.5


SENSORS = "sensors={joint_torque: {noise: 0.1}, more: {winding: !JointTemperature {}}}"


def periods(scenario: Scenario) -> list[float]:
    """Of the control, the log and every sensor."""
    parts = (scenario.control, scenario.log, *scenario.sensors.by_name.values())
    return [part.period for part in parts]


@pytest.mark.parametrize(
    ("time_step", "period"),
    [(0.002, 0.002), (0.001, 0.001), (0.0005, 0.001), (0.0001, 0.001), (0.0003, 0.0012)],
)
def test_periods_that_are_not_given_follow_the_plants_step(time_step: float, period: float):
    step = f"plant.time_step={time_step}"
    result = load_scenario("paper_walk", overrides=[step, SENSORS])
    assert periods(result) == pytest.approx(7 * [period], rel=1e-12)


def test_periods_that_are_given_stay():
    given = ["control.period=0.004", "sensors.encoders.period=0.004", "log.period=0.006"]
    result = load_scenario("paper_walk", overrides=["plant.time_step=0.002", *given])
    assert periods(result) == [0.004, 0.006, 0.004, 0.002, 0.002]


def test_scenario_at_a_longer_step_survives_being_written_and_read(tmp_path: Path):
    original = load_scenario("paper_walk", overrides=["plant.time_step=0.002", SENSORS])
    again = load_scenario(written(tmp_path, dump_scenario(original, "mine")))
    assert again.plant.time_step == 0.002
    assert dataclasses.replace(again, plant=original.plant) == original


@pytest.mark.parametrize("time_step", [0.002, 0.0005])
def test_plants_step_can_be_chosen_alone(time_step: float):
    overrides = [f"plant.time_step={time_step}", "duration=0.05"]
    log = simulate(load_scenario("hrp2_walk_fbse", overrides=overrides)).log
    assert log.meta["outcome"]["finished"]
    np.testing.assert_allclose(np.diff(log.time), max(time_step, 0.001), rtol=1e-9)
    assert np.isfinite(log["estimate/joint/friction_torque"]).all()


def test_a_solver_that_leaves_out_friction_is_refused():
    with pytest.raises(InputError, match="expected sap, similar or lagged, which solve joint"):
        load_scenario("squat", overrides=["plant.discrete_contact_approximation=tamsi"])
