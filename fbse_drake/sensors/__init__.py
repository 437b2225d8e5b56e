"""Sensors; importing the package fills their library."""

from fbse_drake.sensors import encoders, foot_force, imu, joint_temperature, joint_torque

__all__ = ["encoders", "foot_force", "imu", "joint_temperature", "joint_torque"]
