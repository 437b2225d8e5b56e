"""Inertial measurement unit."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem, State
from pydrake.systems.sensors import Accelerometer, Gyroscope

from fbse_drake.errors import InputError
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.noise import white_noise


@dataclass(frozen=True)
class ImuConfig:
    """Errors of the IMU; all 0 measures exactly."""

    # Standard deviation of white noise per axis and sample [m/s^2], [rad/s].
    acceleration_noise: float = 0.0
    angular_velocity_noise: float = 0.0
    # Constant errors, in the IMU frame [m/s^2], [rad/s].
    acceleration_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    angular_velocity_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Random walk of the errors [m/s^2/sqrt(s)], [rad/s/sqrt(s)].
    acceleration_bias_walk: float = 0.0
    angular_velocity_bias_walk: float = 0.0
    # Sampling period [s].
    period: float = 0.001

    def __post_init__(self) -> None:
        for name in ("acceleration_noise", "angular_velocity_noise", "acceleration_bias_walk", "angular_velocity_bias_walk"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected a number >= 0, found {getattr(self, name):g}")
        for name in ("acceleration_bias", "angular_velocity_bias"):
            if len(getattr(self, name)) != 3:
                raise InputError(f"{name}: expected three numbers, found {getattr(self, name)}")
        if self.period <= 0:
            raise InputError(f"period: expected a number > 0, found {self.period:g}")


class ImuErrors(LeafSystem):
    """Adds bias and noise to ideal IMU signals in the IMU frame I.

    .. pydrake_system::

        name: ImuErrors
        input_ports:
        - specific_force
        - angular_velocity
        output_ports:
        - measured_imu

    `measured_imu` is [specific force (3) [m/s^2], angular velocity (3) [rad/s]]. Discrete state: the bias, (6,).
    """

    def __init__(self, config: ImuConfig, seed: int):
        super().__init__()
        self._config, self._seed = config, seed
        self._noise = np.repeat([config.acceleration_noise, config.angular_velocity_noise], 3)
        self._walk = np.repeat([config.acceleration_bias_walk, config.angular_velocity_bias_walk], 3) * np.sqrt(config.period)
        self._specific_force = self.DeclareVectorInputPort("specific_force", 3)
        self._angular_velocity = self.DeclareVectorInputPort("angular_velocity", 3)
        self._bias = self.DeclareDiscreteState(np.concatenate([config.acceleration_bias, config.angular_velocity_bias]))
        sources = {self.all_input_ports_ticket(), self.time_ticket(), self.xd_ticket()}
        self.DeclareVectorOutputPort("measured_imu", 6, self._calc, sources)
        if self._walk.any():
            self.DeclarePeriodicUnrestrictedUpdateEvent(config.period, 0.0, self._walk_bias)

    def _calc(self, context: Context, output: BasicVector) -> None:
        ideal = np.concatenate([self._specific_force.Eval(context), self._angular_velocity.Eval(context)])
        noise = white_noise(self._seed, "imu", 6, context.get_time(), self._config.period)
        output.SetFromVector(ideal + context.get_discrete_state(self._bias).value() + self._noise * noise)

    def _walk_bias(self, context: Context, state: State) -> None:
        noise = white_noise(self._seed, "imu_bias", 6, context.get_time(), self._config.period)
        state.get_mutable_discrete_state(self._bias).set_value(context.get_discrete_state(self._bias).value() + self._walk * noise)


class Imu(Diagram):
    """IMU at the robot's IMU frame: Drake's ideal accelerometer and gyroscope, and their errors.

    .. pydrake_system::

        name: Imu
        input_ports:
        - body_poses
        - body_spatial_velocities
        - body_spatial_accelerations
        output_ports:
        - measured_imu

    The acceleration is that of the plant's last step, from its velocity before to its velocity after.
    """

    def __init__(self, config: ImuConfig, robot: Robot, seed: int):
        super().__init__()
        builder = DiagramBuilder()
        body, X_BI = robot.imu.body(), robot.imu.GetFixedPoseInBodyFrame()
        gravity = robot.plant.gravity_field().gravity_vector()
        accelerometer = builder.AddNamedSystem("accelerometer", Accelerometer(body, X_BI, gravity))
        gyroscope = builder.AddNamedSystem("gyroscope", Gyroscope(body, X_BI))
        errors = builder.AddNamedSystem("errors", ImuErrors(config, seed))
        builder.Connect(accelerometer.get_output_port(), errors.GetInputPort("specific_force"))
        builder.Connect(gyroscope.get_output_port(), errors.GetInputPort("angular_velocity"))
        for name in ("body_poses", "body_spatial_velocities", "body_spatial_accelerations"):
            port = builder.ExportInput(accelerometer.GetInputPort(name), name)
            if name != "body_spatial_accelerations":
                builder.ConnectInput(port, gyroscope.GetInputPort(name))
        builder.ExportOutput(errors.get_output_port(), "measured_imu")
        builder.BuildInto(self)
