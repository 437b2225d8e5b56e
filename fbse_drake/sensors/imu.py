"""Inertial measurement unit."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, MatrixGain, Multiplexer
from pydrake.systems.sensors import Accelerometer, Gyroscope
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from fbse_drake.errors import InputError, require_not_negative, require_positive, required
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise
from fbse_drake.sensors.sensor import Run, Sensor, in_library
from fbse_drake.signals import Signal, signals_of


@in_library
@dataclass(frozen=True)
class ImuConfig(Sensor):
    """Errors of the IMU; all 0 measures exactly."""

    has_own_key: ClassVar[bool] = True
    signals: ClassVar[tuple[Signal, ...]] = signals_of("measured_imu")

    # Standard deviation of white noise per axis and sample [m/s^2], [rad/s].
    acceleration_noise: float = 0.0
    angular_velocity_noise: float = 0.0
    # Constant errors, in the IMU frame [m/s^2], [rad/s].
    acceleration_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    angular_velocity_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Rotation vector from the IMU frame to the axes that the sensor really has [rad].
    misalignment: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Random walk of the errors [m/s^2/sqrt(s)], [rad/s/sqrt(s)].
    acceleration_bias_walk: float = 0.0
    angular_velocity_bias_walk: float = 0.0
    # Sampling period [s], held in between; by default `Scenario.usual_period`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_not_negative(
            self,
            "acceleration_noise",
            "angular_velocity_noise",
            "acceleration_bias_walk",
            "angular_velocity_bias_walk",
        )
        for name in ("acceleration_bias", "angular_velocity_bias", "misalignment"):
            if len(getattr(self, name)) != 3:
                raise InputError(f"{name}: expected three numbers, found {getattr(self, name)}")
        require_positive(self, "period")

    def system(self, robot: Robot, run: Run) -> "Imu":
        return Imu(self, robot, run.seed, run.duration)

    def channels(self, robot: Robot, recorded: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """None of a robot that has no IMU."""
        return super().channels(robot, recorded) if robot.description.imu else {}

    def readings(self, robot: Robot, log: Log) -> dict[str, np.ndarray]:
        """Zeros of a fixed robot that has no IMU, as nobody needs it."""
        if robot.description.imu or robot.has_floating_base:
            return super().readings(robot, log)
        return {"measured_imu": np.zeros((len(log.time), 6))}


def imu_errors(config: ImuConfig, seed: int, duration: float) -> np.ndarray:
    """What is added to the ideal signals at each tick, shape (ticks, 6) [m/s^2, rad/s]: bias, its
    random walk, white noise."""
    period = required(config.period, "period")
    ticks = ticks_until(duration, period)
    noise = np.repeat([config.acceleration_noise, config.angular_velocity_noise], 3)
    walk = np.repeat(
        [config.acceleration_bias_walk, config.angular_velocity_bias_walk], 3
    ) * np.sqrt(period)
    drift = np.cumsum(white_noise(seed, "imu bias", ticks, 6), axis=0)
    bias = np.concatenate([config.acceleration_bias, config.angular_velocity_bias])
    return bias + walk * drift + noise * white_noise(seed, "imu", ticks, 6)


class Imu(Diagram):
    """IMU at the robot's IMU frame I: Drake's ideal accelerometer and gyroscope, plus errors.

    .. pydrake_system::

        name: Imu
        input_ports:
        - body_poses
        - body_spatial_velocities
        - body_spatial_accelerations
        output_ports:
        - measured_imu

    `measured_imu` is [specific force (3) [m/s^2], angular velocity (3) [rad/s]] in the IMU frame.
    The acceleration is that of the plant's last step, from its velocity before to its velocity
    after.
    """

    def __init__(self, config: ImuConfig, robot: Robot, seed: int, duration: float):
        """Puts the IMU together.

        Args:
            seed: of the errors.
            duration: errors are drawn for this time [s].
        """
        super().__init__()
        builder = DiagramBuilder()
        body, X_BI = robot.imu.body(), robot.imu.GetFixedPoseInBodyFrame()
        gravity = robot.plant.gravity_field().gravity_vector()
        accelerometer = builder.AddNamedSystem("accelerometer", Accelerometer(body, X_BI, gravity))
        gyroscope = builder.AddNamedSystem("gyroscope", Gyroscope(body, X_BI))
        ideal = builder.AddNamedSystem("ideal", Multiplexer([3, 3]))
        period = required(config.period, "period")
        errors = builder.AddNamedSystem(
            "errors", held_signal(imu_errors(config, seed, duration), period)
        )
        measured = builder.AddNamedSystem("measured", Adder(2, 6))
        builder.Connect(accelerometer.get_output_port(), ideal.get_input_port(0))
        builder.Connect(gyroscope.get_output_port(), ideal.get_input_port(1))
        read = ideal.get_output_port()
        if any(config.misalignment):
            R_SI = Rotation.from_rotvec(config.misalignment).as_matrix().T
            turned = builder.AddNamedSystem("turned", MatrixGain(block_diag(R_SI, R_SI)))
            builder.Connect(read, turned.get_input_port())
            read = turned.get_output_port()
        builder.Connect(read, measured.get_input_port(0))
        builder.Connect(errors.get_output_port(), measured.get_input_port(1))
        for name in ("body_poses", "body_spatial_velocities", "body_spatial_accelerations"):
            port = builder.ExportInput(accelerometer.GetInputPort(name), name)
            if name != "body_spatial_accelerations":
                builder.ConnectInput(port, gyroscope.GetInputPort(name))
        builder.ExportOutput(measured.get_output_port(), "measured_imu")
        builder.BuildInto(self)
