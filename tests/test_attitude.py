"""Attitude from IMU and feet, against closed forms and textbook filters."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import Accelerometer, Gyroscope
from rig import CLOCK, TICK, Base, Rig, numbers, pack, rms, robot_copy
from scipy.spatial.transform import Rotation

from fbse_drake.estimators.attitude import AttitudeConfig, AttitudeEstimator
from fbse_drake.estimators.beliefs import USUAL_SENSORS, SensorBeliefs
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.estimators.spatial import (
    normalized,
    quaternion_from_gravity,
    quaternion_product,
    rotation_matrix,
    rotation_vector_to_quaternion,
    yaw_of,
)

GRAVITY = 9.81
BASE = Base.of()
# From the IMU alone, with no special start.
IMU_ONLY = {"level_feet": 0.0, "standing_time": 0.0}


class Attitude(Rig):
    """An AttitudeEstimator on feet that are level when the base is."""

    def __init__(self, base: Base = BASE, sensors: SensorBeliefs = USUAL_SENSORS, **config: float):
        types = base.monitor.posterior_type, base.model.posterior_type
        super().__init__(
            AttitudeEstimator(
                AttitudeConfig(**config), sensors, ImuMount(base.robot).R_BI, *types, CLOCK
            )
        )
        self._base = base
        self.fix(model=self.feet(np.eye(3)))

    def feet(self, R_BF: np.ndarray) -> np.ndarray:
        """Model input with both soles turned like this in the base."""
        return pack(self._base.model, foot_rotation=np.tile(np.ravel(R_BF), 2))

    def read(
        self,
        specific_force: np.ndarray,
        rate: np.ndarray,
        *,
        stands: bool = False,
        **inputs: np.ndarray,
    ) -> np.ndarray:
        readings = self._base.measurements(
            specific_force=specific_force,
            angular_velocity=rate,
            support=np.full(2, float(stands)),
        )
        return self.tick(measurements=readings, **inputs)


def matrix(posterior: np.ndarray) -> np.ndarray:
    return posterior["rotation"]


def test_quaternion_helpers_agree_with_scipy():
    generator = np.random.default_rng(0)
    for _ in range(50):
        a, b = Rotation.random(rng=generator), Rotation.random(rng=generator)
        p, q = (tuple(r.as_quat(scalar_first=True)) for r in (a, b))
        np.testing.assert_allclose(
            rotation_matrix(quaternion_product(p, q)), (a * b).as_matrix().ravel(), atol=1e-14
        )
        np.testing.assert_allclose(normalized(tuple(3.0 * np.array(p))), p, atol=1e-15)
        np.testing.assert_allclose(yaw_of(p), a.as_euler("ZYX")[0], atol=1e-12)
        r = generator.normal(size=3) * 10 ** generator.uniform(-12, 0)
        turn = Rotation.from_quat(rotation_vector_to_quaternion(tuple(r)), scalar_first=True)
        np.testing.assert_allclose(turn.as_rotvec(), r, rtol=1e-10)
        up = a.inv().apply([0, 0, generator.uniform(1, 20)])
        from_gravity = Rotation.from_quat(
            quaternion_from_gravity(tuple(up), a.as_euler("ZYX")[0]), scalar_first=True
        )
        np.testing.assert_allclose(from_gravity.as_matrix(), a.as_matrix(), atol=1e-9)


def test_gravity_filter_is_the_textbook_kalman_filter():
    """Nine states [gravity, acceleration, bias] with full matrices; the estimator has one
    covariance for all axes."""
    sensors = replace(USUAL_SENSORS, acceleration_noise=0.1, angular_velocity_noise=2e-3)
    config = AttitudeConfig(**IMU_ONLY, acceleration_bias=0.05)
    attitude = Attitude(sensors=sensors, **IMU_ONLY, acceleration_bias=0.05)
    readings = np.array([0.3, -0.2, 9.8]) + np.random.default_rng(1).normal(
        scale=0.3, size=(400, 3)
    )
    # A first reading, of which nothing is known but how large its parts may be: P0 H^T
    # (H P0 H^T + R)^-1 y.
    I3, H = np.eye(3), np.hstack([np.eye(3)] * 3)
    P = np.kron(
        np.diag([GRAVITY**2, config.standing_acceleration**2, config.acceleration_bias**2]), I3
    )
    R = sensors.acceleration_noise**2 * I3
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    x, P = K @ readings[0], P - K @ H @ P
    fade = math.exp(-TICK / config.motion_time)
    F = np.kron(np.diag([1.0, fade, 1.0]), I3)
    walk = (GRAVITY * TICK * sensors.angular_velocity_noise) ** 2
    Q = np.kron(np.diag([walk, (1 - fade**2) * config.motion_acceleration**2, 0.0]), I3)
    attitude.read(readings[0], np.zeros(3))
    for y in readings[1:]:
        x, P = F @ x, F @ P @ F.T + Q
        S = H @ P @ H.T + R
        K, e = P @ H.T @ np.linalg.inv(S), y - H @ x
        x, P = x + K @ e, P - K @ H @ P
        posterior = attitude.read(y, np.zeros(3))
        estimated = np.concatenate(
            [posterior[name] for name in ("gravity", "acceleration", "acceleration_bias")]
        )
        np.testing.assert_allclose(estimated, x, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(posterior["innovation"]["gravity"], e, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(posterior["innovation_variance"]["gravity"], S[0, 0], rtol=1e-8)
        of_x = P[np.ix_([0, 3, 6], [0, 3, 6])]
        found, expected = posterior["covariance"]["gravity"], of_x[np.triu_indices(3)]
        np.testing.assert_allclose(numbers(found), expected, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(P, np.kron(of_x, I3), atol=1e-12)


def test_quaternion_filter_about_one_axis_is_the_textbook_kalman_filter():
    """Two states [angle, gyro bias], corrected with the angle of the gravity filter's gravity."""
    settings = {
        **IMU_ONLY,
        "angular_velocity_bias": 0.02,
        "motion_acceleration": 0.05,
        "motion_time": 0.1,
    }
    config, attitude = AttitudeConfig(**settings), Attitude(**settings)
    generator = np.random.default_rng(2)
    time = np.arange(2000) * TICK
    truth, rate = 0.1 * np.sin(2 * time), 0.2 * np.cos(2 * time)
    gyro = rate + 0.015 + generator.normal(scale=1e-3, size=len(time))
    correlated = 2 * config.motion_time / TICK
    F, H = np.array([[1.0, -TICK], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = np.diag([(TICK * USUAL_SENSORS.angular_velocity_noise) ** 2, 0.0])
    x = P = None
    for k in range(len(time)):
        f = GRAVITY * np.array([0, math.sin(truth[k]), math.cos(truth[k])]) + generator.normal(
            scale=0.02, size=3
        ) * [0, 1, 1]
        posterior = attitude.read(f, [gyro[k], 0, 0])
        angle = math.atan2(posterior["gravity"][1], posterior["gravity"][2])
        variance = posterior["covariance"]["gravity"]["gg"] / GRAVITY**2
        if x is None:
            x, P = np.array([angle, 0.0]), np.diag([variance, config.angular_velocity_bias**2])
        else:
            x, P = F @ x + [TICK * gyro[k], 0.0], F @ P @ F.T + Q
            S = H @ P @ H.T + variance * correlated
            K = P @ H.T / S
            x, P = x + K[:, 0] * (angle - x[0]), P - K @ H @ P
        estimated = Rotation.from_quat(posterior["imu_orientation"], scalar_first=True).as_rotvec()
        np.testing.assert_allclose(estimated, [x[0], 0, 0], atol=1e-7)
        np.testing.assert_allclose(posterior["angular_velocity_bias"], [x[1], 0, 0], atol=1e-7)
        found = numbers(posterior["covariance"]["quaternion"])
        np.testing.assert_allclose(found, [P[0, 0], P[0, 1], P[1, 1]], rtol=1e-6)
        np.testing.assert_allclose(posterior["angular_velocity"][0], gyro[k] - x[1], atol=1e-7)
    # The filters agree; they also do their work.
    assert x[1] == pytest.approx(0.015, abs=0.002)


@pytest.mark.parametrize("config", [IMU_ONLY, {"level_feet": 0.0}, {}])
@pytest.mark.parametrize(("roll", "pitch"), [(0.3, -0.2), (-0.7, 0.4), (0.0, 1.2)])
def test_tilted_at_rest(config: dict[str, float], roll: float, pitch: float):
    R_WB = Rotation.from_euler("ZYX", [0, pitch, roll])
    attitude = Attitude(**config)
    # Standing feet that are level, as the legs tell it.
    standing = {"stands": True, "model": attitude.feet(R_WB.inv().as_matrix())}
    for _ in range(100):
        posterior = attitude.read(R_WB.inv().apply([0, 0, GRAVITY]), np.zeros(3), **standing)
        np.testing.assert_allclose(matrix(posterior), R_WB.as_matrix(), atol=1e-9)


def test_it_does_not_matter_how_the_imu_sits(tmp_path: Path):
    """The same motion felt by an IMU that is turned on the base."""
    straight, turned_mount = (
        '<origin xyz="0.01 -0.01 0.02"/>',
        '<origin xyz="0.01 -0.01 0.02" rpy="0.3 -0.2 1.0"/>',
    )
    description = robot_copy(tmp_path / "models", lambda urdf: urdf.replace(straight, turned_mount))
    R_BI = Rotation.from_euler("ZYX", [1.0, -0.2, 0.3])
    for config in (IMU_ONLY, {}):
        turned, plain = Attitude(Base.of(description), **config), Attitude(**config)
        for k in range(400):
            R_WB = Rotation.from_euler("ZYX", [0.3 * k * TICK, 0.02, -0.01])
            f, w = R_WB.inv().apply([0, 0, GRAVITY]), R_WB.inv().apply([0, 0, 0.3])
            standing = {"stands": True, "model": plain.feet(R_WB.inv().as_matrix())}
            expected = plain.read(f, w, **standing)
            posterior = turned.read(R_BI.inv().apply(f), R_BI.inv().apply(w), **standing)
            np.testing.assert_allclose(matrix(posterior), matrix(expected), atol=1e-9)
            np.testing.assert_allclose(
                posterior["angular_velocity"], expected["angular_velocity"], atol=1e-9
            )
            np.testing.assert_allclose(matrix(posterior), R_WB.as_matrix(), atol=1e-3)


def test_yaw_is_the_gyros():
    """A tilted body turns about the vertical: the accelerometer sees nothing of it."""
    rate = 1.5
    start = Rotation.from_euler("ZYX", [0, -0.3, 0.4])
    attitude = Attitude(**IMU_ONLY)
    for k in range(1500):
        truth = Rotation.from_rotvec([0, 0, rate * k * TICK]) * start
        posterior = attitude.read(
            truth.inv().apply([0, 0, GRAVITY]), truth.inv().apply([0, 0, rate])
        )
        np.testing.assert_allclose(matrix(posterior), truth.as_matrix(), atol=1e-8)
    still = Attitude(**IMU_ONLY)
    for k in range(1500):
        truth = Rotation.from_rotvec([0, 0, rate * k * TICK]) * start
        posterior = still.read(truth.inv().apply([0, 0, GRAVITY]), np.zeros(3))
    # The negative case: without the gyro, no yaw.
    np.testing.assert_allclose(matrix(posterior), start.as_matrix(), atol=1e-8)


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, 0, 1.0], [0.6, 0, 0.8]])
def test_quaternion_stays_on_one_sheet_through_two_turns(axis: list[float]):
    """Its measured counterpart jumps from q to -q on the way."""
    rate = 2 * math.pi
    attitude = Attitude(**IMU_ONLY)
    last, opposite = None, False
    for k in range(2001):
        truth = Rotation.from_rotvec(np.array(axis) * rate * k * TICK)
        posterior = attitude.read(truth.inv().apply([0, 0, GRAVITY]), rate * np.array(axis))
        q = posterior["orientation"]
        assert np.linalg.norm(q) == pytest.approx(1, abs=1e-12)
        assert last is None or np.linalg.norm(q - last) < 1.2 * 0.5 * rate * TICK
        # After one turn it is at minus where it began.
        opposite |= q[0] < -0.99
        last = q
    error = Rotation.from_quat(last, scalar_first=True).inv() * truth
    assert opposite
    assert error.magnitude() < 0.01


def test_correction_is_the_same_on_either_sheet():
    """After one turn q is minus what the measured quaternion is; an error of the tilt must shrink
    all the same."""
    tilt = []
    for turns in (0, 1):
        attitude = Attitude(**IMU_ONLY, motion_acceleration=0.05)
        for _ in range(1001):
            posterior = attitude.read([0, 0, GRAVITY], [0, 0, 2 * math.pi * turns])
        assert posterior["orientation"][0] == pytest.approx(1 - 2 * turns, abs=1e-3)
        for _ in range(2000):
            posterior = attitude.read(
                Rotation.from_euler("x", 0.02).inv().apply([0, 0, GRAVITY]), np.zeros(3)
            )
        tilt.append(Rotation.from_matrix(matrix(posterior)).as_rotvec()[0])
    assert tilt[1] == pytest.approx(tilt[0], rel=1e-3)
    assert 0.25 * 0.02 < tilt[0] < 0.021


def test_gyro_bias_is_recovered():
    """About the horizontal axes from gravity; about the vertical only from a robot that stands at
    first."""
    bias, generator = np.array([0.02, -0.03, 0.01]), np.random.default_rng(3)
    sure = {"angular_velocity_bias": 0.05, "motion_acceleration": 0.05}
    walking, standing, blind = (
        Attitude(**IMU_ONLY, **sure),
        Attitude(level_feet=0.0, **sure),
        Attitude(**IMU_ONLY),
    )
    f = np.array([0, 0, GRAVITY]) + generator.normal(scale=0.02, size=(3000, 3))
    w = bias + generator.normal(scale=1e-3, size=(3000, 3))
    for k in range(len(f)):
        moved, stood, ignored = (
            attitude.read(f[k], w[k]) for attitude in (walking, standing, blind)
        )
    np.testing.assert_allclose(moved["angular_velocity_bias"][:2], bias[:2], atol=2e-3)
    assert moved["angular_velocity_bias"][2] == pytest.approx(0, abs=1e-3)
    np.testing.assert_allclose(stood["angular_velocity_bias"], bias, atol=3e-3)
    np.testing.assert_allclose(ignored["angular_velocity_bias"], 0, atol=0)
    # 3 s of 0.02 rad/s would be 3 deg.
    assert np.abs(Rotation.from_matrix(matrix(stood)).as_rotvec()[:2]).max() < 2e-3


def test_level_feet_hold_the_tilt_against_acceleration():
    """A constant acceleration looks like a tilt of a / g to the IMU; the feet know better."""
    f = np.array([0.3, 0.0, GRAVITY])
    with_feet, without = Attitude(standing_time=0.0), Attitude(**IMU_ONLY)
    for _ in range(1500):
        held, fooled = (
            attitude.read(f, np.zeros(3), stands=True) for attitude in (with_feet, without)
        )
    tilt = [Rotation.from_matrix(matrix(posterior)).as_rotvec()[1] for posterior in (held, fooled)]
    assert tilt[1] == pytest.approx(-0.3 / GRAVITY, rel=0.05)
    assert abs(tilt[0]) < 0.3 * abs(tilt[1])


def test_innovations_are_as_large_as_believed():
    """Noise as configured, trunk at rest: the gravity filter's normalized innovation squared has
    mean 1."""
    generator = np.random.default_rng(4)
    attitude = Attitude(**IMU_ONLY, motion_acceleration=1e-6, standing_acceleration=1e-6)
    nis = []
    for _ in range(2000):
        posterior = attitude.read(
            [0, 0, GRAVITY] + generator.normal(scale=0.02, size=3),
            generator.normal(scale=1e-3, size=3),
        )
        if posterior["innovation_variance"]["gravity"] > 0:
            nis.append(
                posterior["innovation"]["gravity"] ** 2
                / posterior["innovation_variance"]["gravity"]
            )
    # 6000 values of chi-square with one degree of freedom, 4 sigma.
    assert np.mean(nis) == pytest.approx(1, abs=4 * math.sqrt(2 / 6000))
    assert rms(posterior["rotation"] - np.eye(3)) < 1e-3


def test_an_imu_in_a_diagram_of_ones_own_tells_the_tilt():
    """Drake's own sensors on a pendulum that swings by 0.1 rad, and its IMU turned on the link."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    link = plant.AddRigidBody("link", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    X_LA = RigidTransform([0.0, 0.0, 1.0])
    hinge = plant.AddJoint(
        RevoluteJoint(
            "hinge",
            plant.world_frame(),
            plant.AddFrame(FixedOffsetFrame("a", link.body_frame(), X_LA)),
            [0, 1, 0],
        )
    )
    plant.Finalize()
    X_LI = RigidTransform(RollPitchYaw(0.3, -0.2, 0.5), [0.05, 0.0, 0.1])
    gravity = plant.gravity_field().gravity_vector()
    accelerometer = builder.AddSystem(Accelerometer(link, X_LI, gravity))
    gyroscope = builder.AddSystem(Gyroscope(link, X_LI))
    poses = plant.get_body_poses_output_port()
    velocities = plant.get_body_spatial_velocities_output_port()
    accelerations = plant.get_body_spatial_accelerations_output_port()
    builder.Connect(poses, accelerometer.get_body_poses_input_port())
    builder.Connect(velocities, accelerometer.get_body_velocities_input_port())
    builder.Connect(accelerations, accelerometer.get_body_accelerations_input_port())
    builder.Connect(poses, gyroscope.get_body_poses_input_port())
    builder.Connect(velocities, gyroscope.get_body_velocities_input_port())
    config = AttitudeConfig(level_feet=0.0, motion_acceleration=0.3, standing_time=0.0)
    ports = accelerometer.get_measurement_output_port(), gyroscope.get_measurement_output_port()
    R_LI = X_LI.rotation().matrix()
    attitude = AttitudeEstimator.AddToBuilder(
        builder, *ports, period=1e-3, R_BI=R_LI, config=config
    )
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    hinge.set_angle(plant.GetMyMutableContextFromRoot(context), 0.1)
    orientation, errors = attitude.GetOutputPort("orientation"), []
    for time in np.arange(0.5, 6.0, 0.1):
        simulator.AdvanceTo(time)
        q = orientation.Eval(attitude.GetMyContextFromRoot(context))
        true = plant.EvalBodyPoseInWorld(plant.GetMyContextFromRoot(context), link)
        up = Rotation.from_quat(q, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
        errors.append(np.linalg.norm(np.cross(up, true.rotation().matrix()[2])))
    # Gravity alone, whose direction the acceleration hides, would be off by the whole swing.
    assert np.sqrt(np.mean(np.square(errors))) < 0.02
