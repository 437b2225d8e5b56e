"""What the estimators believe of their sensors, once for all stages."""

import math
from dataclasses import dataclass, fields, replace

from fbse_drake.errors import require_not_negative, require_positive, required
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.sensors.foot_force import FootForceConfig
from fbse_drake.sensors.imu import ImuConfig

_NOISES = (
    "joint_position_noise",
    "joint_velocity_noise",
    "acceleration_noise",
    "angular_velocity_noise",
    "force_noise",
    "moment_noise",
)


@dataclass(frozen=True)
class SensorBeliefs:
    """Noise and biases of the sensors, as standard deviations.

    Noise is white, per axis and sample. What is not given follows from the scenario's `sensors`,
    see `beliefs_of`. A bias of 0 is not estimated.
    """

    # Joint angle [rad] and velocity [rad/s].
    joint_position_noise: float | None = None
    joint_velocity_noise: float | None = None
    # Are joint velocities differences of counted angles, which may repeat themselves?
    joint_velocity_counted: bool | None = None
    # Are they made of the angles by the reader of a log, so that they cannot contradict them?
    joint_velocity_derived: bool | None = None
    # Accelerometer [m/s^2] and gyro [rad/s].
    acceleration_noise: float | None = None
    angular_velocity_noise: float | None = None
    # Force of a pad, or of a six-axis sensor [N], and the moment of the latter [Nm].
    force_noise: float | None = None
    moment_noise: float | None = None
    # Are foot forces watched for noise that is larger than that?
    learns_force_noise: bool = True
    # By what share forces of a foot may all be read wrong [1]; 0 where they are known to be right.
    force_gain: float = 0.05
    # How large a constant bias of accelerometer [m/s^2] and gyro [rad/s] may be.
    acceleration_bias: float = 0.3
    angular_velocity_bias: float = 0.05

    def __post_init__(self) -> None:
        require_positive(self, *_NOISES)
        require_not_negative(self, "force_gain", "acceleration_bias", "angular_velocity_bias")

    def completed(self, usual: "SensorBeliefs") -> "SensorBeliefs":
        """The same with what is not given taken from another one."""
        missing = [field.name for field in fields(self) if getattr(self, field.name) is None]
        return replace(self, **{name: getattr(usual, name) for name in missing})

    @property
    def text(self) -> str:
        """One line for the reader."""
        parts = (
            f"joint angle {self.joint_position_noise:.2g} rad",
            f"joint velocity {self.joint_velocity_noise:.2g} rad/s",
            f"accelerometer {self.acceleration_noise:.2g} m/s² (bias {self.acceleration_bias:.2g})",
            f"gyro {self.angular_velocity_noise:.2g} rad/s (bias {self.angular_velocity_bias:.2g})",
            f"foot force {self.force_noise:.2g} N, {self.moment_noise:.2g} Nm",
        )
        return f"Noise believed in, per sample: {'; '.join(parts)}."


# Of good sensors: what is believed where nobody says anything.
USUAL_SENSORS = SensorBeliefs(
    joint_position_noise=1.5e-5,
    joint_velocity_noise=5.0e-4,
    joint_velocity_counted=False,
    joint_velocity_derived=False,
    acceleration_noise=0.02,
    angular_velocity_noise=1.0e-3,
    force_noise=0.5,
    moment_noise=0.02,
)
# No sensor is believed to be better than the usual ones by more than this.
_FINEST = 0.1


def beliefs_of(
    encoders: EncoderConfig, imu: ImuConfig, foot_force: FootForceConfig
) -> SensorBeliefs:
    """What a scenario says of its robot's sensors; a noise of zero becomes a small one."""
    angle = encoders.angle_noise
    differenced = encoders.velocity == "differenced"
    rate = encoders.velocity_noise
    if differenced:
        rate = math.sqrt(2.0) * angle / required(encoders.period, "period")
    stated = {
        "joint_position_noise": angle,
        "joint_velocity_noise": rate,
        "acceleration_noise": imu.acceleration_noise,
        "angular_velocity_noise": imu.angular_velocity_noise,
        "force_noise": foot_force.noise,
        "moment_noise": foot_force.moment_noise,
    }
    floors = {name: _FINEST * getattr(USUAL_SENSORS, name) for name in stated}
    noises = {name: max(noise, floors[name]) for name, noise in stated.items()}
    counted = differenced and encoders.resolution > 0
    return SensorBeliefs(**noises, joint_velocity_counted=counted, joint_velocity_derived=False)
