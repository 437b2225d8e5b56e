"""Links that are longer, and an IMU that sits elsewhere, than the model says. Truth: models whose
joints and IMU are placed elsewhere in the file."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from rig import BENT, robot_copy

from fbse_drake import InputError, load_scenario, simulate
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import library
from fbse_drake.effects.geometry import ImuPosition, LinkLength
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.interop.models import links_of
from fbse_drake.robot.plant import Robot, make_robot
from fbse_drake.scenario import RobotConfig, Scenario, build_robot
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.sensors.imu import ImuConfig

KNEE_TO_ANKLE = '<child link="left_ankle_link"/>\n    <origin xyz="0 0 -0.27"/>'


def longer_shank(folder: Path, length: float) -> str:
    """Description of a biped whose left ankle is further below the knee."""
    return robot_copy(
        folder,
        lambda urdf: urdf.replace(KNEE_TO_ANKLE, KNEE_TO_ANKLE.replace("0.27", f"{0.27 + length}")),
    )


def mass_matrix_and_sole(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """In the order of our joints, and the place of the left sole, bent legs."""
    context = robot.plant.CreateDefaultContext()
    robot.set_joint_positions(context, BENT)
    order = np.concatenate([np.arange(6), robot.velocity_index])
    H = robot.plant.CalcMassMatrix(context)[np.ix_(order, order)]
    return H, robot.sole("left").CalcPoseInWorld(context).translation()


def test_the_effect_makes_the_robot_that_another_file_describes(tmp_path: Path) -> None:
    changed = build_robot(RobotConfig(effects={"long": LinkLength({"left_shank": 0.008})}))
    expected, _ = make_robot(longer_shank(tmp_path / "copy", 0.008))
    for found, truth in zip(
        mass_matrix_and_sole(changed), mass_matrix_and_sole(expected), strict=True
    ):
        np.testing.assert_allclose(found, truth, atol=1e-12)
    # The shank leans by the angles of hip and knee: the sole is further along it.
    lean = BENT[2] + BENT[3]
    _, before = mass_matrix_and_sole(make_robot("biped")[0])
    _, after = mass_matrix_and_sole(changed)
    np.testing.assert_allclose(
        after - before, 0.008 * np.array([-np.sin(lean), 0.0, -np.cos(lean)]), atol=1e-12
    )


def test_limits_and_the_order_of_joints_stay() -> None:
    plain = build_robot(RobotConfig())
    changed = build_robot(RobotConfig(effects={"long": LinkLength({"left_thigh": 0.01})}))
    assert changed.position_index.tolist() == plain.position_index.tolist()
    assert changed.plant.num_actuators() == plain.plant.num_actuators()
    for name in plain.joint_names:
        old, new = (robot.plant.GetJointByName(name) for robot in (plain, changed))
        assert new.position_lower_limits() == old.position_lower_limits()
        assert new.velocity_upper_limits() == old.velocity_upper_limits()


def test_only_a_link_between_two_joints_has_a_length() -> None:
    with pytest.raises(
        InputError, match=r"effects\.long: trunk: expected a link between two joints .* left_thigh"
    ):
        build_robot(RobotConfig(effects={"long": LinkLength({"trunk": 0.01})}))
    with pytest.raises(InputError, match="hand: the model has no body of this name"):
        build_robot(RobotConfig(effects={"long": LinkLength({"hand": 0.01})}))


def test_links_of_legs_are_suspected_and_no_others() -> None:
    biped, _ = make_robot("biped")
    assert LinkLength.suspected_bodies(biped) == [
        f"{side}_{link}" for side in ("left", "right") for link in ("thigh", "shank")
    ]
    # Nothing but the torques would tell that a link of an arm is longer.
    assert LinkLength.suspected_bodies(make_robot("arm")[0]) == []


def test_a_longer_shank_is_found_in_a_walk(tmp_path: Path) -> None:
    scenario = load_scenario(
        "frictionless_walk", overrides=["duration=2.5", "reference.single_supports=1"]
    )
    scenario = dataclasses.replace(scenario, model=scenario.robot)
    robot = dataclasses.replace(scenario.robot, description=longer_shank(tmp_path / "copy", 0.005))
    log = simulate(dataclasses.replace(scenario, robot=robot)).log
    assert log.meta["outcome"]["finished"]
    rivals = [
        library()[name]
        for name in (
            "LinkLength",
            "EncoderOffset",
            "TransmissionElasticity",
            "GroundSlope",
            "ImuMisalignment",
            "BodyMass",
            "BodyCentreOfMass",
            "Payload",
            "FootForceGain",
            "TorqueGain",
            "TorqueBias",
        )
    ]
    found = diagnose(Predictor(scenario, log), rivals).chosen
    assert [(f.effect, f.targets) for f in found] == [("LinkLength", ("left_shank",))]
    assert found[0].parameters["length"].value == pytest.approx(0.005, abs=3e-4)


@pytest.mark.parametrize("length", [-0.006, 0.006])
def test_a_robot_with_unequal_legs_starts_on_the_ground(length: float) -> None:
    """No sole begins inside the ground, which would push it out for half a second, nor hangs above
    it: what the feet feel from the first millisecond on is about the weight."""
    log = simulate(
        load_scenario(
            "squat",
            overrides=[f"robot.effects.long=!LinkLength {{length: {{right_thigh: {length}}}}}"]
            + ["duration=0.1"],
        )
    ).log
    robot = build_robot(RobotConfig())
    weight = 9.81 * robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
    height = {side: log[f"truth/foot/{side}/position"][0, 2] for side in log.sides}
    # The sole's centre of a foot 0.1 m wide that stands on its edge.
    assert all(-1e-4 < z < 2e-3 for z in height.values())
    force = sum(log[f"foot/{side}/pad_force"][5:, :, 2].sum(axis=1) for side in log.sides)
    assert 0.5 * weight < force.mean() < 1.5 * weight
    assert force.max() < 3 * weight


IMU_MOVED = (0.03, -0.02, 0.04)


def moved_imu(folder: Path) -> str:
    """Description of a biped whose IMU is at another place on the trunk, which its axes are
    parallel to."""
    place = " ".join(f"{a + b:g}" for a, b in zip((0.01, -0.01, 0.02), IMU_MOVED, strict=True))
    return robot_copy(folder, lambda urdf: urdf.replace('xyz="0.01 -0.01 0.02"', f'xyz="{place}"'))


def exact_trot() -> Scenario:
    scenario = load_scenario("quadruped_trot", overrides=["duration=1.5", "estimator=null"])
    sensors = dataclasses.replace(scenario.sensors, imu=ImuConfig(), encoders=EncoderConfig())
    return dataclasses.replace(scenario, sensors=sensors)


def test_a_moved_imu_is_where_another_file_has_it(tmp_path: Path) -> None:
    changed = build_robot(RobotConfig(effects={"imu": ImuPosition(*IMU_MOVED)}))
    expected, _ = make_robot(moved_imu(tmp_path / "copy"))
    found, truth = ImuMount(changed), ImuMount(expected)
    np.testing.assert_allclose(found.p_BI, truth.p_BI, atol=1e-15)
    np.testing.assert_allclose(found.R_BI, truth.R_BI, atol=1e-15)


def test_a_moved_imu_reads_what_a_rigid_body_has_there() -> None:
    """Of a trunk that turns: w_dot x p + w x (w x p) more, and the same rate."""
    scenario = exact_trot()
    effects = {**scenario.robot.effects, "imu": ImuPosition(*IMU_MOVED)}
    moved = dataclasses.replace(
        scenario, robot=dataclasses.replace(scenario.robot, effects=effects)
    )
    here, there = simulate(scenario).log, simulate(moved).log
    w = here["imu/angular_velocity"]
    np.testing.assert_array_equal(there["imu/angular_velocity"], w)
    # A reading is the mean over the step before it.
    w_dot, p = np.diff(w, axis=0) / here.meta["period"], np.array(IMU_MOVED)
    expected = np.cross(w_dot, p) + np.cross(w[1:], np.cross(w[1:], p))
    found = (there["imu/linear_acceleration"] - here["imu/linear_acceleration"])[1:]
    assert expected.std() > 0.01
    assert np.abs(found - expected).max() < 0.02 * np.abs(expected).max()


def test_links_do_not_say_where_an_imu_sits() -> None:
    effects = {"imu": ImuPosition(*IMU_MOVED), "long": LinkLength({"left_thigh": 0.01})}
    _, unsaid = links_of(RobotConfig(effects=effects))
    assert unsaid == ["imu: IMU position"]


def test_a_moved_imu_is_found_in_a_walk(tmp_path: Path) -> None:
    scenario = load_scenario(
        "frictionless_walk", overrides=["duration=3.5", "reference.single_supports=2"]
    )
    scenario = dataclasses.replace(scenario, model=scenario.robot)
    robot = dataclasses.replace(scenario.robot, description=moved_imu(tmp_path / "copy"))
    log = simulate(dataclasses.replace(scenario, robot=robot)).log
    rivals = [
        library()[name]
        for name in (
            "ImuPosition",
            "ImuMisalignment",
            "AccelerometerBias",
            "AccelerometerGain",
            "GyroscopeBias",
            "LinkLength",
            "EncoderOffset",
            "BodyMass",
            "BodyCentreOfMass",
            "FootForceGain",
            "TransmissionElasticity",
        )
    ]
    found = diagnose(Predictor(scenario, log), rivals).chosen
    assert [(f.effect, f.targets) for f in found] == [("ImuPosition", ("robot",))]
    for axis, place in zip("xyz", IMU_MOVED, strict=True):
        assert found[0].parameters[axis].value == pytest.approx(place, abs=5e-3)


def test_what_a_moved_imu_adds_is_the_difference_of_both_models_residuals() -> None:
    """Of exact sensors, of which no impact is smoothed away."""
    scenario = exact_trot()
    scenario = dataclasses.replace(scenario, model=scenario.robot)
    log = simulate(scenario).log
    predictor = Predictor(scenario, log)
    moved = dataclasses.replace(
        scenario.believed,
        effects={**scenario.believed.effects, "imu": ImuPosition(*IMU_MOVED)},
    )
    difference = (
        predictor.motion.residual.value
        - Predictor(dataclasses.replace(scenario, model=moved), log).motion.residual.value
    )
    signature = predictor.signature(ImuPosition, "robot", np.zeros(0))
    expected = difference[:, signature.rows]
    np.testing.assert_allclose(
        signature.values @ IMU_MOVED, expected, atol=2e-3 * np.abs(expected).max()
    )
