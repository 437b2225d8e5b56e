"""A robot that shares nothing with the biped: names, order, axes and lengths of its joints,
six-axis sensors in its feet."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import scenario
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from rig import rms

from fbse_drake import Log, build_station, estimate, resources, simulate
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.residual.residual import rms as row_rms
from fbse_drake.effects.friction import LoadDependentFriction
from fbse_drake.errors import InputError
from fbse_drake.estimators.estimator import NoEstimator
from fbse_drake.robot.plant import Robot, grasp_map, make_robot
from fbse_drake.scenario import Scenario, SensorsConfig
from fbse_drake.walking.leg_kinematics import LegKinematics, UnreachableError
from fbse_drake.walking.reference import make_reference
from fbse_drake.walking.stand import Squat
from fbse_drake.wiring import release

WEIGHT = 50.0 * 9.81


@pytest.fixture(scope="module")
def robot() -> Robot:
    return make_robot("strider")[0]


@pytest.fixture(scope="module")
def log(run) -> Log:
    return run("strider_walk", "duration=3")


def angles(robot: Robot, side: str, samples: int) -> np.ndarray:
    """Postures with a bent knee, well inside the joints' limits."""
    joints = [robot.plant.GetJointByName(name) for name in robot.description.legs[side].joints]
    lower, upper = (
        np.array([getattr(joint, f"position_{end}_limit")() for joint in joints])
        for end in ("lower", "upper")
    )
    return np.random.default_rng(0).uniform(
        0.85 * lower + 0.15 * upper, 0.15 * lower + 0.85 * upper, size=(samples, 6)
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_newtons_inverse_kinematics_round_trip(robot: Robot, side: str):
    leg, q = LegKinematics.from_robot(robot, side), angles(robot, side, 300)
    assert not leg.has_closed_inverse
    pose = leg.forward(q)
    found = leg.inverse(pose.R_BF, pose.p_BF)
    again = leg.forward(found)
    np.testing.assert_allclose(again.R_BF, pose.R_BF, atol=1e-11)
    np.testing.assert_allclose(again.p_BF, pose.p_BF, atol=1e-11)
    # It is the posture that was asked for, and not another one with the same pose.
    np.testing.assert_allclose(found, q, atol=1e-9)


@pytest.mark.parametrize("side", ["right", "left"])
def test_leg_kinematics_agree_with_drake(robot: Robot, side: str):
    leg, plant = LegKinematics.from_robot(robot, side), robot.plant
    q, v = angles(robot, side, 1), np.random.default_rng(4).normal(size=(1, 6))
    motion = leg.forward(q, v)
    columns = slice(
        6 * robot.description.sides.index(side), 6 * robot.description.sides.index(side) + 6
    )
    context = plant.CreateDefaultContext()
    joint_q, joint_v = np.zeros(12), np.zeros(12)
    joint_q[columns], joint_v[columns] = q, v
    robot.set_state(context, joint_q, joint_v, RigidTransform())
    world, sole, index = plant.world_frame(), robot.sole(side), robot.velocity_index[columns]
    X = sole.CalcPoseInWorld(context)
    J = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, sole, [0, 0, 0], world, world
    )
    bias = plant.CalcBiasSpatialAcceleration(
        context, JacobianWrtVariable.kV, sole, [0, 0, 0], world, world
    )
    J_com = plant.CalcJacobianCenterOfMassTranslationalVelocity(
        context, JacobianWrtVariable.kV, world, world
    )
    np.testing.assert_allclose(motion.p_BF[0], X.translation(), atol=1e-12)
    np.testing.assert_allclose(motion.R_BF[0], X.rotation().matrix(), atol=1e-12)
    np.testing.assert_allclose(motion.J[0], J[:, index], atol=1e-12)
    np.testing.assert_allclose(
        motion.Jdot_v[0], np.concatenate([bias.rotational(), bias.translational()]), atol=1e-10
    )
    np.testing.assert_allclose(
        motion.J_moment[0], plant.CalcTotalMass(context) * J_com[:, index], atol=1e-11
    )


def test_a_leg_out_of_reach_is_refused(robot: Robot):
    leg = LegKinematics.from_robot(robot, "right")
    with pytest.raises(UnreachableError, match=r"misses it by 0\.2"):
        leg.inverse(np.eye(3)[None], leg.offsets.sum(axis=0) + np.array([[0.0, 0.0, -0.2]]))


def test_feedforward_at_rest_carries_the_weight(robot: Robot):
    """Virtual work: lifting the base by dz with the feet on the ground costs m g dz."""
    low, high = (
        make_reference(Squat(com_height=z, foot_spacing=0.21), robot, np.array([0.0, 1.0]))
        for z in (0.74, 0.74001)
    )
    work = low.feedforward_torque[0] @ (high.joint_position[0] - low.joint_position[0])
    assert work == pytest.approx(WEIGHT * 1e-5, rel=1e-3)


def test_it_walks(log: Log):
    assert not log.meta["outcome"]["fell"]
    assert rms(log["reference/joint/position"] - log["truth/joint/position"]) < 2e-3
    np.testing.assert_allclose(log["truth/com/position"], log["reference/com/position"], atol=4e-3)
    # Forward, on alternate feet.
    assert log["truth/com/position"][-1, 0] > 0.2
    assert log.sides == ["right", "left"]
    for stance, swing, time in (("right", "left", 0.8), ("left", "right", 2.0)):
        k = np.searchsorted(log.time, time)
        assert log[f"truth/foot/{swing}/position"][k, 2] > 0.03
        assert abs(log[f"truth/foot/{stance}/position"][k, 2]) < 1e-3


def test_wrenches_change_the_momentum(log: Log):
    """Newton: what the feet feel in a step is the weight and what the centre of mass's velocity
    changes in it."""
    force = sum(log[f"truth/foot/{side}/wrench"][1:, 3:] for side in log.sides)
    change = 50.0 * np.diff(log["truth/com/velocity"], axis=0) / 1e-3
    np.testing.assert_allclose(force.mean(axis=0), change.mean(axis=0) + [0, 0, WEIGHT], atol=0.3)
    # The soles, in whose axes forces are, are level but for a milliradian.
    assert rms(force - change - [0, 0, WEIGHT]) < 1.5


def test_wrench_is_that_of_drakes_contacts():
    quiet = scenario("strider_walk", "duration=0.3", noise=False)
    station = build_station(dataclasses.replace(quiet, estimator=NoEstimator()))
    simulator = Simulator(station)
    simulator.AdvanceTo(0.25)
    context, plant = simulator.get_context(), station.robot.plant
    plant_context = plant.GetMyContextFromRoot(context)
    forces = station.GetOutputPort("measured_pad_force").Eval(context).reshape(2, 4, 3)
    contacts = plant.get_contact_results_output_port().Eval(plant_context)
    for foot, side in enumerate(station.robot.description.sides):
        X_WF = station.robot.sole(side).CalcPoseInWorld(plant_context)
        expected = np.zeros(6)
        for i in range(contacts.num_point_pair_contacts()):
            info = contacts.point_pair_contact_info(i)
            names = [
                plant.get_body(index).name() for index in (info.bodyA_index(), info.bodyB_index())
            ]
            if any(name.startswith(f"{side}_corner") for name in names):
                sign = 1.0 if names[1].startswith(f"{side}_corner") else -1.0
                f = sign * info.contact_force()
                expected += np.concatenate(
                    [np.cross(info.contact_point() - X_WF.translation(), f), f]
                )
        turn = X_WF.rotation().matrix().T
        expected = np.concatenate([turn @ expected[:3], turn @ expected[3:]])
        G = grasp_map(station.robot.pad_positions(side))
        assert expected[5] > 50
        np.testing.assert_allclose(G @ forces[foot].ravel(), expected, rtol=1e-4, atol=1e-3)
    release(station)


def test_corners_are_as_good_as_pads(run, tmp_path: Path):
    """The paper's biped, its four pads under each foot replaced by a six-axis sensor with corners
    in the same places."""

    def feels_wrenches(d: dict) -> dict:
        places = [[x, y, 0.0] for x in (0.11, -0.11) for y in (0.05, -0.05)]
        legs = {
            side: {key: leg[key] for key in ("joints", "foot", "sole")} | {"corners": places}
            for side, leg in d["legs"].items()
        }
        return {key: value for key, value in d.items() if key != "directives"} | {
            "urdf": "biped.urdf",
            "legs": legs,
        }

    pads = run("paper_walk", "duration=1", noise=False)
    case = scenario("paper_walk", "duration=1", noise=False)
    description = described(tmp_path / "models", "biped", feels_wrenches)
    corners = simulate(
        dataclasses.replace(case, robot=dataclasses.replace(case.robot, description=description))
    ).log
    np.testing.assert_allclose(corners["joint/position"], pads["joint/position"], atol=5e-6)
    for side in pads.sides:
        wrench = (
            pads[f"foot/{side}/pad_force"].reshape(len(pads.time), -1)
            @ grasp_map(np.array(pads.meta["pads"][side])).T
        )
        np.testing.assert_allclose(corners[f"foot/{side}/wrench"], wrench, atol=0.2)


def test_six_axis_sensors_are_noisy_late_and_scaled(log: Log):
    for side in log.sides:
        noise = log[f"foot/{side}/wrench"] - log[f"truth/foot/{side}/wrench"]
        np.testing.assert_allclose(noise.std(axis=0), np.repeat([0.02, 0.5], 3), rtol=0.05)
    errors = "sensors.foot_force={noise: 0, moment_noise: 0, delay: 0.005, gain: 1.02}"
    late = simulate(
        scenario("strider_walk", "duration=0.2", "estimator=!NoEstimator {}", errors)
    ).log
    np.testing.assert_allclose(
        late["foot/left/wrench"][5:], 1.02 * late["truth/foot/left/wrench"][:-5], atol=1e-9
    )
    assert not late["foot/left/wrench"][:5].any()


def test_its_friction_is_estimated(log: Log):
    settled = log.time > 0.5
    error = (log["estimate/joint/friction_torque"] - log["truth/joint/friction_torque"])[settled]
    relative = np.sqrt(
        np.mean(error**2, axis=0)
        / np.mean(log["truth/joint/friction_torque"][settled] ** 2, axis=0)
    )
    assert relative.max() < 0.12
    assert np.median(relative) < 0.07


def test_the_estimator_runs_over_recorded_wrenches(log: Log):
    watching = scenario("strider_walk", "duration=3")
    assert not any(name.endswith("pad_force") for name in log if name.startswith("foot/"))
    beginning = dataclasses.replace(
        log, channels={name: values[:600] for name, values in log.channels.items()}
    )
    again = estimate(watching, beginning).log["estimate/joint/friction_torque"]
    np.testing.assert_allclose(again, log["estimate/joint/friction_torque"][:600], atol=1e-6)


def believed(robot_with: Scenario) -> Scenario:
    """A model that knows the friction, and nothing else."""
    known = {"joint_friction": robot_with.robot.effects["joint_friction"]}
    return dataclasses.replace(
        robot_with,
        estimator=NoEstimator(),
        model=dataclasses.replace(robot_with.robot, effects=known),
    )


def test_a_hidden_effect_is_found():
    hidden = (
        "robot.effects.hidden=!LoadDependentFriction {coefficient: {r_knee: 0.08}, "
        "transition: {all: 0.02}}"
    )
    case = believed(scenario("strider_walk", "duration=3", hidden))
    diagnosis = diagnose(Predictor(case, simulate(case).log))
    assert diagnosis.verdict == "effect_found"
    (found,) = diagnosis.chosen
    assert (found.effect, found.targets) == (LoadDependentFriction.__name__, ("r_knee",))
    low, high = found.parameters["coefficient"].interval
    assert low < 0.08 < high < 1.1 * low
    assert found.held_out_after < 0.15 * found.held_out_before


def test_nothing_is_found_where_nothing_is_hidden():
    case = believed(scenario("strider_walk", "duration=2"))
    assert diagnose(Predictor(case, simulate(case).log)).verdict == "nothing_missing"


def described(folder: Path, name: str, edit: Callable[[dict], dict]) -> str:
    """A copy of a robot with another description."""
    shutil.copytree(resources.folder("models"), folder)
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(edit(yaml.safe_load(path.read_text())), sort_keys=False))
    return str(path)


def test_the_noise_floor_is_that_of_six_axis_sensors():
    """Of a robot without any friction, whose law adds doubt."""
    case = dataclasses.replace(
        scenario("strider_walk", "duration=2", "robot.effects.joint_friction=null"),
        estimator=NoEstimator(),
    )
    log = simulate(case).log
    residual = Predictor(case, log).residual
    dynamic = [k for k, row in enumerate(residual.rows) if row.kind in ("joint", "base")]
    ratio = row_rms(residual.value, residual.known)[dynamic] / residual.noise_floor[dynamic]
    np.testing.assert_allclose(ratio, 1.0, atol=0.12)
    # Of one sensor's noise alone, it is that of the wrench through the leg: on level soles the
    # base's rows add up both feet.
    forces = dataclasses.replace(
        case, sensors=dataclasses.replace(SensorsConfig(), foot_force=case.sensors.foot_force)
    )
    floor = dict(
        zip(
            (row.name for row in residual.rows),
            Predictor(forces, simulate(forces).log).residual.noise_floor,
            strict=True,
        )
    )
    assert floor["base/force_z"] == pytest.approx(0.5 * np.sqrt(2 / 10), rel=0.02)
    assert floor["l_ankle_inversion"] < 0.1 * 0.5 / np.sqrt(10)


def test_the_order_in_which_legs_are_listed_does_not_matter(tmp_path: Path):
    """What depends on it is the order of joints and feet in a log, and nothing else."""
    swapped = described(
        tmp_path / "models", "strider", lambda d: d | {"legs": dict(reversed(d["legs"].items()))}
    )
    case = dataclasses.replace(
        scenario("strider_walk", "duration=1.2", noise=False), estimator=NoEstimator()
    )
    one = simulate(case).log
    other = simulate(
        dataclasses.replace(case, robot=dataclasses.replace(case.robot, description=swapped))
    ).log
    assert other.sides == ["left", "right"]
    assert other.joints == one.joints[6:] + one.joints[:6]
    columns = [other.joints.index(name) for name in one.joints]
    np.testing.assert_allclose(
        other["joint/position"][:, columns], one["joint/position"], atol=1e-6
    )
    np.testing.assert_allclose(
        other["joint/torque_command"][:, columns], one["joint/torque_command"], atol=1e-2
    )
    for side in one.sides:
        np.testing.assert_allclose(
            other[f"foot/{side}/wrench"], one[f"foot/{side}/wrench"], atol=0.5
        )


def edited(side: str, **values: object) -> Callable[[dict], dict]:
    return lambda d: d | {"legs": d["legs"] | {side: d["legs"][side] | values}}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            edited("left", joints=["l_hip_flexion"] * 5 + ["l_toe"]),
            r"joints: l_hip_flexion is named twice",
        ),
        (edited("left", sole="l_soul"), r"legs\.left\.sole: the model has no frame called l_soul"),
        (edited("left", foot="l_shoe"), r"legs\.left\.foot: the model has no body called l_shoe"),
        (
            edited("left", pads=["l_sole_weld"]),
            r"legs\.left\.pads: expected either these .* or corners",
        ),
        (edited("left", corners=[]), r"legs\.left\.pads: expected either these .* or corners"),
        (
            edited("left", corners=[[0, 0, 0], [0.1, 0.05, 0], [0.2, 0.1, 0]]),
            r"legs\.left.*corners: .* not in one line",
        ),
        (
            edited("left", corners=[[0, 0], [0.1, 0], [0, 0.1]]),
            r"legs\.left.*corners: expected points of three coordinates",
        ),
        (lambda d: d | {"imu": "l_foot"}, r"imu: l_foot moves against torso"),
        (
            lambda d: d | {"held": {"r_knee": 0.3}},
            r"held\.r_knee: expected a joint of the model that is not named elsewhere",
        ),
        (
            lambda d: d | {"joints": ["waist"]},
            r"joints: the model has no revolute or prismatic joint called waist",
        ),
    ],
)
def test_a_description_that_does_not_fit_is_refused(tmp_path: Path, edit, message: str):
    with pytest.raises(InputError, match=message) as error:
        make_robot(described(tmp_path / "models", "strider", edit))
    assert "\n" not in str(error.value)


def test_legs_that_cannot_walk_are_refused(tmp_path: Path):
    turned = described(
        tmp_path / "turned",
        "strider",
        lambda d: edited("left", joints=d["legs"]["left"]["joints"][::-1])(d),
    )
    with pytest.raises(
        InputError,
        match=r"legs\.left\.joints: expected them from hip to foot, one behind the other",
    ):
        LegKinematics.from_robot(make_robot(turned)[0], "left")
    waisted = described(
        tmp_path / "waisted", "strider", lambda d: d | {"joints": ["waist"], "imu": "torso"}
    )
    urdf = tmp_path / "waisted" / "strider.urdf"
    waist = """<link name="pelvis"/><joint name="waist" type="revolute">
    <parent link="torso"/><child link="pelvis"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="100" velocity="10"/></joint></robot>"""
    text = urdf.read_text().replace("</robot>", waist)
    for side in "lr":
        joint = f'<joint name="{side}_hip_flexion" type="revolute">\n    <parent link='
        text = text.replace(f'{joint}"torso"', f'{joint}"pelvis"')
    urdf.write_text(text)
    with pytest.raises(
        InputError,
        match=r"joints: waist carries the left leg; a walking robot's legs begin at its base",
    ):
        LegKinematics.from_robot(make_robot(waisted)[0], "left")
    with pytest.raises(
        InputError, match=r"posture\.r_knee: expected a joint that is no leg's \(there are: none\)"
    ):
        make_reference(
            Squat(posture={"r_knee": 0.1}), make_robot("strider")[0], np.array([0.0, 1.0])
        )
