"""A public humanoid: the legs of PAL Robotics' TALOS, from the package example-robot-data."""

import dataclasses
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rig import rms

from fbse_drake import Scenario, load_scenario, simulate
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.errors import InputError
from fbse_drake.report.metrics import joint_sides
from fbse_drake.robot.plant import make_robot

ELBOWS = ["arm_left_4_joint", "arm_right_4_joint"]

WALK = """
talos_walk:
  duration: 2
  reference: !Walk {{com_height: 0.86, foot_spacing: 0.17, zmp_forward: 0.0, double_support: 0.6,
    single_supports: 3, posture: {posture}}}
  robot:
    description: {path}
    rotor_inertia: {{all: 0.2}}
    effects:
      friction: !CoulombViscousFriction {{coulomb: {{all: 3.0, ankle_roll: 1.5}},
        viscous: {{all: 2.0}}, transition: {{all: 0.02}}}}
  sensors:
    encoders: {{resolution: 4.8e-5, velocity_noise: 5.0e-4}}
    imu: {{acceleration_noise: 0.02, angular_velocity_noise: 1.0e-3}}
    foot_force: {{noise: 0.5, moment_noise: 0.05}}
  control: {{kp: {{all: 5000}}, kd: {{all: 30}}}}
"""


@pytest.fixture(scope="module")
def talos() -> dict:
    """TALOS on driven legs; its torso and head are held, its arms hang beside the body."""
    try:
        files = metadata.files("example-robot-data") or []
    except metadata.PackageNotFoundError:
        pytest.skip(
            "the package example-robot-data, which has the model of TALOS, is not installed"
        )
    urdf = Path(
        next(file for file in files if file.name == "talos_reduced.urdf").locate()
    ).resolve()

    def leg(side: str) -> dict:
        return {
            "joints": [f"leg_{side}_{number}_joint" for number in range(1, 7)],
            "foot": f"leg_{side}_6_link",
            "sole": f"{side}_sole_link",
            "corners": [[x, y, 0.0] for x in (0.1, -0.1) for y in (0.06, -0.06)],
        }

    return {
        "urdf": str(urdf),
        "base": "base_link",
        "imu": "imu_link",
        "leg_joints": ["hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll"],
        "legs": {side: leg(side) for side in ("left", "right")},
        "held": {"arm_left_2_joint": 0.2, "arm_right_2_joint": -0.2, **dict.fromkeys(ELBOWS, -0.5)},
    }


def described(folder: Path, description: dict) -> Path:
    path = folder / "talos.yaml"
    path.write_text(yaml.safe_dump(description, sort_keys=False))
    return path


def walking(folder: Path, description: dict, *overrides: str, posture: str = "{}") -> Scenario:
    path = folder / "talos_walk.yaml"
    path.write_text(WALK.format(path=described(folder, description), posture=posture))
    return load_scenario(path, overrides=overrides)


def with_driven_elbows(talos: dict) -> dict:
    held = {joint: angle for joint, angle in talos["held"].items() if joint not in ELBOWS}
    return talos | {"joints": ELBOWS, "held": held}


def test_it_weighs_what_its_urdf_says(talos: dict, tmp_path: Path):
    robot, _ = make_robot(described(tmp_path, talos))
    masses = [float(mass.get("value")) for mass in ElementTree.parse(talos["urdf"]).iter("mass")]
    context = robot.plant.CreateDefaultContext()
    assert robot.plant.CalcTotalMass(context) == pytest.approx(sum(masses))
    # Joints that are not named do not move: 12 and the base.
    assert robot.plant.num_velocities() == 18
    # An elbow held at -0.5 rad is where it would be if it were driven there.
    (tmp_path / "driven").mkdir()
    driven, _ = make_robot(described(tmp_path / "driven", with_driven_elbows(talos)))
    other = driven.plant.CreateDefaultContext()
    driven.set_joint_positions(other, np.concatenate([np.zeros(12), [-0.5, -0.5]]))
    hands = [
        plant.GetFrameByName("gripper_left_base_link") for plant in (robot.plant, driven.plant)
    ]
    poses = [
        hand.CalcPoseInWorld(at).GetAsMatrix34()
        for hand, at in zip(hands, (context, other), strict=True)
    ]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-12)


def test_it_walks_and_its_friction_is_estimated(talos: dict, tmp_path: Path):
    log = simulate(walking(tmp_path, talos, "estimator=!Fbse {}")).log
    assert not log.meta["outcome"]["fell"]
    assert rms(log["reference/joint/position"] - log["truth/joint/position"]) < 2e-3
    weight = sum(log[f"foot/{side}/wrench"][:, 5] for side in log.sides)[1:].mean()
    assert weight == pytest.approx(90.272 * 9.81, rel=2e-3)
    settled = log.time > 0.5
    truth = log["truth/joint/friction_torque"][settled]
    error = log["estimate/joint/friction_torque"][settled] - truth
    relative = np.sqrt(np.mean(error**2, axis=0) / np.mean(truth**2, axis=0))
    # The hip yaws hardly turn in a straight walk.
    turning = np.array([not joint.endswith("_1_joint") for joint in log.joints])
    assert relative[turning].max() < 0.12


def test_driven_elbows_are_estimated_too(talos: dict, tmp_path: Path):
    """Before the walk begins the elbows are moved by nothing but the body's sway; their friction is
    small, and so is the error."""
    posture = "{arm_left_4_joint: -0.5, arm_right_4_joint: -0.5}"
    log = simulate(
        walking(
            tmp_path, with_driven_elbows(talos), "estimator=!Fbse {}", "duration=1", posture=posture
        )
    ).log
    error = (log["estimate/joint/friction_torque"] - log["truth/joint/friction_torque"])[
        log.time > 0.5
    ]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 0.5
    assert joint_sides(log)[6:] == ["right"] * 6 + [None] * 2


def test_with_driven_arms_a_hidden_mass_is_found(talos: dict, tmp_path: Path):
    hidden = "robot.effects.hidden=!BodyMass {mass: {torso_2_link: 2.0}}"
    posture = "{arm_left_4_joint: -0.5, arm_right_4_joint: -0.7}"
    case = walking(tmp_path, with_driven_elbows(talos), hidden, posture=posture)
    friction = {"friction": case.robot.effects["friction"]}
    case = dataclasses.replace(case, model=dataclasses.replace(case.robot, effects=friction))
    log = simulate(case).log
    assert log.joints[12:] == ELBOWS
    np.testing.assert_allclose(
        log["truth/joint/position"][:, 12:], np.tile([-0.5, -0.7], (len(log.time), 1)), atol=5e-3
    )
    diagnosis = diagnose(Predictor(case, log))
    assert diagnosis.verdict == "effect_found"
    (found,) = diagnosis.chosen
    assert (found.effect, found.targets) == ("BodyMass", ("torso_2_link",))
    assert found.parameters["mass"].value == pytest.approx(2.0, abs=0.05)
    assert found.held_out_after < 0.2 * found.held_out_before


def test_an_imu_on_a_driven_torso_is_refused(talos: dict, tmp_path: Path):
    with pytest.raises(InputError, match=r"imu: imu_link moves against base_link"):
        make_robot(described(tmp_path, talos | {"joints": ["torso_1_joint"]}))
