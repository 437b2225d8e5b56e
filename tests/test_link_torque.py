"""Joint accelerations and link torque, against textbook algebra, Drake, and the truth of simulated
motions."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import scenario
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from rig import BENT, CLOCK, Base, Rig, estimated, pack, part, rms, robot_copy
from scipy.spatial.transform import Rotation

from fbse_drake import Log, load_scenario
from fbse_drake.estimators.attitude import AttitudeConfig, AttitudeEstimator
from fbse_drake.estimators.base_filter import InvariantFilter
from fbse_drake.estimators.base_state import ContactAided
from fbse_drake.estimators.beliefs import USUAL_SENSORS, SensorBeliefs
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.estimators.joint_acceleration import (
    JointAccelerationConfig,
    JointAccelerationEstimator,
    fuse,
    minimum_norm,
)
from fbse_drake.estimators.link_torque import LinkTorqueEstimator
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.support import PlannedSupport
from fbse_drake.scenario import RobotConfig

GRAVITY = 9.81
BASE = Base.of()
READINGS, MODEL = BASE.monitor.posterior_type, BASE.model.posterior_type
ATTITUDE = AttitudeEstimator(
    AttitudeConfig(), USUAL_SENSORS, ImuMount(BASE.robot).R_BI, READINGS, MODEL, CLOCK
)
PAPER = load_scenario("paper_walk_fbse", "paper_method").estimator
# What an estimator believes of sensors without errors.
EXACT = Fbse(
    base_state=InvariantFilter(gyro_walk=0.0, accelerometer_walk=0.0),
    sensors=SensorBeliefs(
        acceleration_noise=1e-6,
        angular_velocity_noise=1e-9,
        joint_velocity_noise=1e-9,
        force_noise=1e-3,
        acceleration_bias=0.0,
        angular_velocity_bias=0.0,
    ),
)
Run = Callable[..., Log]


def accelerations(config: JointAccelerationConfig | None = None) -> JointAccelerationEstimator:
    config = config or JointAccelerationConfig()
    types = READINGS, ATTITUDE.posterior_type, MODEL
    return JointAccelerationEstimator(config, USUAL_SENSORS, BASE.robot, *types, CLOCK)


def link_torques() -> LinkTorqueEstimator:
    types = READINGS, MODEL, accelerations().posterior_type
    return LinkTorqueEstimator(USUAL_SENSORS, BASE.robot, *types, CLOCK)


def test_minimum_norm_is_the_pseudo_inverse():
    generator = np.random.default_rng(0)
    J, y = generator.normal(size=(6, 9)), generator.normal(size=6)
    np.testing.assert_allclose(minimum_norm(J, y), np.linalg.pinv(J) @ y, rtol=1e-9)


def test_fusion_is_weighted_least_squares():
    generator = np.random.default_rng(1)
    J, y, measured = (
        generator.normal(size=(12, 18)),
        generator.normal(size=12),
        generator.normal(size=18),
    )
    variance, constraint = generator.uniform(0.1, 3, size=18), generator.uniform(0.1, 3, size=12)
    rows = np.vstack([np.eye(18) / np.sqrt(variance)[:, None], J / np.sqrt(constraint)[:, None]])
    right = np.concatenate([measured / np.sqrt(variance), y / np.sqrt(constraint)])
    x, sensitivity, innovation, innovation_variance = fuse(measured, variance, J, y, constraint)
    np.testing.assert_allclose(x, np.linalg.lstsq(rows, right, rcond=None)[0], rtol=1e-9)
    for k in range(18):
        moved, *_ = fuse(measured + np.eye(18)[k], variance, J, y, constraint)
        np.testing.assert_allclose(moved - x, sensitivity[:, k], atol=1e-9)
    np.testing.assert_allclose(innovation, y - J @ measured, atol=1e-12)
    np.testing.assert_allclose(
        innovation_variance, np.diag(J @ np.diag(variance) @ J.T) + constraint, rtol=1e-9
    )


@pytest.mark.parametrize("seed", range(5))
def test_link_torque_is_drakes_wherever_the_base_is(seed: int):
    """The estimator knows neither attitude nor velocity of the base; Drake does, and says the same.

    So neither an error of the estimated attitude nor one of the base's velocity can spoil the link
    torque.
    """
    generator = np.random.default_rng(seed)
    robot, plant = BASE.robot, BASE.robot.plant
    q, v, v_dot = (
        BENT + generator.uniform(-0.3, 0.3, size=12),
        generator.normal(size=12),
        generator.normal(scale=5, size=12),
    )
    R_WB, p_WB = Rotation.random(rng=generator), generator.normal(size=3)
    w, velocity, w_dot, acceleration = generator.normal(scale=[[1], [2], [5], [5]], size=(4, 3))
    pads = generator.uniform(-50, 50, size=(8, 3)) + [0, 0, 80]
    # In Drake, in the world.
    context, forces = plant.CreateDefaultContext(), MultibodyForces(plant)
    robot.set_state(
        context,
        q,
        v,
        RigidTransform(RotationMatrix(R_WB.as_matrix()), p_WB),
        np.concatenate([w, velocity]),
    )
    generalized = np.zeros(plant.num_velocities())
    generalized[robot.velocity_index], generalized[:6] = (
        v_dot,
        np.concatenate([w_dot, acceleration]),
    )
    plant.CalcForceElementsContribution(context, forces)
    needed = plant.CalcInverseDynamics(context, generalized, forces)
    for k, side in enumerate(robot.description.sides):
        sole, world = robot.sole(side), plant.world_frame()
        R_WF = sole.CalcPoseInWorld(context).rotation().matrix()
        places = robot.pad_positions(side).T
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, sole, places, world, world
        )
        needed -= J.T @ (pads[4 * k : 4 * k + 4] @ R_WF.T).ravel()
    # By the estimator, in the base.
    readings = {
        "joint_position": q,
        "joint_velocity": v,
        "angular_velocity": R_WB.inv().apply(w),
        "pad_force": pads,
    }
    known = pack(
        accelerations(),
        base_angular_acceleration=R_WB.inv().apply(w_dot),
        base_specific_force=R_WB.inv().apply(acceleration + [0, 0, GRAVITY]),
        joint_acceleration=v_dot,
        known=np.ones(12),
    )
    command = generator.normal(scale=50, size=12)
    estimator = Rig(link_torques())
    model = BASE.model_of(**readings)
    estimator.fix(
        measurements=BASE.measurements(**readings), model_over_step=model, joint_acceleration=known
    )
    estimator.tick(torque_command=command)
    # The command of the next tick is not yet in it.
    posterior = estimator.tick(torque_command=np.full(12, 1e6))
    np.testing.assert_allclose(
        posterior["link_torque"], needed[robot.velocity_index], rtol=1e-9, atol=1e-8
    )
    np.testing.assert_allclose(
        posterior["residual"], command - needed[robot.velocity_index], rtol=1e-9, atol=1e-8
    )


def link_torque_under(left: np.ndarray) -> np.ndarray:
    """Of a robot that rests on its right foot; each pad of the left has the same force (3,) [N]."""
    pads = np.vstack([np.tile(left, (4, 1)), np.tile([0.0, 0.0, 200.0], (4, 1))])
    known = pack(accelerations(), base_specific_force=[0.0, 0.0, GRAVITY], known=np.ones(12))
    estimator = Rig(link_torques())
    for _ in range(2):
        posterior = estimator.tick(
            measurements=BASE.measurements(pad_force=pads),
            model_over_step=BASE.model_of(),
            joint_acceleration=known,
            torque_command=np.zeros(12),
        )
    return posterior["link_torque"]


def test_a_foot_that_touches_the_ground_may_be_held_sideways_only():
    """What the forces do is linear in them, however small the load; noise alone is no force."""
    none, light, firm = (link_torque_under(np.array([10.0, 40.0, z])) for z in (0.0, 20.0, 40.0))
    np.testing.assert_allclose(none, 2 * light - firm, atol=1e-9)
    noise = USUAL_SENSORS.force_noise * np.array([0.5, -0.5, -0.1])
    np.testing.assert_array_equal(link_torque_under(noise), link_torque_under(np.zeros(3)))


def residual_with(attitude: Rotation, support: list[float], method: str = "fused") -> np.ndarray:
    """Residual of two made-up ticks with an attitude, right or wrong."""
    generator = np.random.default_rng(7)
    chain, torque = Rig(accelerations(JointAccelerationConfig(method=method))), Rig(link_torques())
    for rig in (chain, torque):
        rig.tick(
            **{"measurements": BASE.measurements(), "model_over_step": pack(BASE.model)},
            **({"attitude": pack(ATTITUDE, rotation=np.eye(3))} if rig is chain else {}),
            **(
                {"joint_acceleration": pack(accelerations()), "torque_command": np.full(12, 3.0)}
                if rig is torque
                else {}
            ),
        )
    moving = {
        "joint_velocity": generator.normal(size=12),
        "angular_velocity": generator.normal(size=3),
    }
    model = BASE.model_of(**moving)
    readings = BASE.measurements(
        **{name: value + 0.01 for name, value in moving.items()}, support=support
    )
    known = chain.tick(
        measurements=readings,
        model_over_step=model,
        attitude=pack(ATTITUDE, rotation=attitude.as_matrix()),
    )
    inputs = {"measurements": readings, "model_over_step": model}
    return torque.tick(**inputs, joint_acceleration=known)["residual"]


def test_residual_does_not_know_the_attitude():
    level, wrong = Rotation.identity(), Rotation.from_rotvec([0.3, -0.2, 1.0])
    turned = Rotation.from_rotvec([0, 0, 1.0])
    np.testing.assert_allclose(
        residual_with(wrong, [0, 0]), residual_with(level, [0, 0]), atol=1e-12
    )
    # No-slip needs to know the vertical, but no yaw.
    np.testing.assert_allclose(
        residual_with(turned, [1, 1]), residual_with(level, [1, 1]), atol=1e-8
    )
    # The fused method would give up a condition that the other sensors deny as these do.
    wrongly, rightly = (residual_with(attitude, [1, 1], "gyro") for attitude in (wrong, level))
    assert np.abs(wrongly - rightly).max() > 0.1


@pytest.mark.parametrize("method", ["minimum_norm", "gyro", "fused"])
def test_joint_accelerations_keep_standing_feet_where_they_are(method: str):
    """All methods solve the no-slip condition, the fused one as far as it believes in it."""
    generator = np.random.default_rng(8)
    moving = {
        "joint_velocity": generator.normal(scale=0.01, size=12),
        "angular_velocity": generator.normal(scale=0.01, size=3),
    }
    terms = BASE.model_of(**moving)
    config = JointAccelerationConfig(
        method=method, foot_angular_acceleration=1e-6, foot_acceleration=1e-6
    )
    rig = Rig(accelerations(config))
    attitude = pack(ATTITUDE, rotation=np.eye(3))
    # Sensors that deny it are believed in the end, so velocities hardly change.
    after = {name: x + generator.normal(scale=1e-6, size=x.shape) for name, x in moving.items()}
    readings = BASE.measurements(**moving)
    rig.tick(measurements=readings, model_over_step=pack(BASE.model), attitude=attitude)
    x = rig.tick(measurements=BASE.measurements(**after), model_over_step=terms)
    names = ("base_angular_acceleration", "base_specific_force", "joint_acceleration")
    a = np.concatenate([x[name] for name in names]) - np.concatenate(
        [np.zeros(3), [0, 0, GRAVITY], np.zeros(12)]
    )
    feet = terms["foot_jacobian"].reshape(12, 18) @ a + terms["foot_bias"].ravel()
    np.testing.assert_allclose(feet, 0, atol=1e-4)


def residual_error(log: Log, result: Log) -> np.ndarray:
    """Measured minus true friction, of the worst joint, from the third row on."""
    # The torque of a step is in the row where it begins.
    error = result["estimate/joint/residual_torque"][2:] - log["truth/joint/friction_torque"][1:-1]
    return np.abs(error).max(axis=1)


def test_residual_is_the_friction_where_sensors_are_exact(run: Run):
    """Measured: half of the ticks within 0.7 mNm, all within 4 mNm but one or two in a run, of some
    10 mNm, at which Drake's solver stops at its tolerance.

    What is left: the IMU gives the specific force in its axes at the step's end, the posture is
    that of its start.
    """
    log = part(run("paper_walk", "duration=3", noise=False), 1.6)
    friction = rms(log["truth/joint/friction_torque"])
    walk = scenario("paper_walk", "duration=3", noise=False)
    fused = residual_error(log, estimated(log, walk, EXACT))
    assert friction > 0.2
    assert np.median(fused) < 2e-3
    assert np.quantile(fused, 0.99) < 6e-3
    assert fused.max() < 5e-2
    # In double support the paper's condition leaves nine unknowns to six equations for each foot,
    # in single support it drops the swing leg.
    shortest = residual_error(
        log,
        estimated(
            log,
            walk,
            Fbse(
                joint_acceleration=JointAccelerationConfig(method="minimum_norm"),
                friction=ModelAided(),
            ),
        ),
    )
    assert np.median(shortest) > 20 * np.median(fused)
    assert rms(shortest) > 1.0


def heavier(urdf: str, link: str) -> str:
    """A URDF with a link that weighs a tenth more."""
    before, after = urdf.split(f'<link name="{link}">')
    mass = after[after.index('<mass value="') :].split('"')[1]
    return f'{before}<link name="{link}">' + after.replace(
        f'<mass value="{mass}"', f'<mass value="{1.1 * float(mass):g}"', 1
    )


def test_residual_does_not_know_the_trunks_mass(run: Run, tmp_path: Path):
    """The joint rows of a leg hold only what hangs on it.

    The invariant filter learns the accelerometer's bias from the foot forces and the whole mass, so
    this is about the other; and that feet read right is believed, or the mass were asked for that.
    """
    log = part(run("paper_walk", "duration=3", noise=False), 0.8)
    believed = SensorBeliefs(force_gain=0.0)
    config = Fbse(support=PlannedSupport(), base_state=ContactAided(), sensors=believed)
    walk = scenario("paper_walk", "duration=3", noise=False)
    residual = {"right": estimated(log, walk, config)["estimate/joint/residual_torque"]}
    for link in ("trunk", "left_thigh"):
        model = RobotConfig(
            robot_copy(tmp_path / link, lambda urdf, link=link: heavier(urdf, link))
        )
        residual[link] = estimated(log, walk, config, model=model)["estimate/joint/residual_torque"]
    np.testing.assert_allclose(residual["trunk"], residual["right"], atol=1e-9)
    # The negative case: 1.2 kg more at the left thigh.
    assert rms(residual["left_thigh"][:, :6] - residual["right"][:, :6]) > 0.1
    np.testing.assert_allclose(residual["left_thigh"][:, 6:], residual["right"][:, 6:], atol=1e-9)
