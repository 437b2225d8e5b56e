"""Sensors; importing the package fills their library."""

from fbse_drake.sensors import (
    base_wrench,
    encoders,
    foot_force,
    imu,
    joint_temperature,
    joint_torque,
)

__all__ = [
    "base_wrench",
    "encoders",
    "foot_force",
    "imu",
    "joint_temperature",
    "joint_torque",
]
