"""Sensors; importing the package fills their library."""

from fbse_drake.sensors import (
    base_wrench,
    encoders,
    foot_force,
    imu,
    joint_temperature,
    joint_torque,
    motor_encoders,
)

__all__ = [
    "base_wrench",
    "encoders",
    "foot_force",
    "imu",
    "joint_temperature",
    "joint_torque",
    "motor_encoders",
]
