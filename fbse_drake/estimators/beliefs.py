"""What the estimators believe of their sensors, once for all stages."""

from dataclasses import dataclass

from fbse_drake.errors import require_not_negative, require_positive


@dataclass(frozen=True)
class SensorBeliefs:
    """Noise and biases of the sensors, as standard deviations.

    Noise is white, per axis and sample. A bias of 0 is not estimated.
    """

    # Joint angle [rad] and velocity [rad/s].
    joint_position_noise: float = 1.5e-5
    joint_velocity_noise: float = 5.0e-4
    # Accelerometer [m/s^2] and gyro [rad/s].
    acceleration_noise: float = 0.02
    angular_velocity_noise: float = 1.0e-3
    # Force of a pad [N].
    force_noise: float = 0.5
    # How large a constant bias of accelerometer [m/s^2] and gyro [rad/s] may be.
    acceleration_bias: float = 0.3
    angular_velocity_bias: float = 0.05

    def __post_init__(self) -> None:
        require_positive(
            self,
            "joint_position_noise",
            "joint_velocity_noise",
            "acceleration_noise",
            "angular_velocity_noise",
            "force_noise",
        )
        require_not_negative(self, "acceleration_bias", "angular_velocity_bias")
