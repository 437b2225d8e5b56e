"""Is it calibration or the model? A log whose signs, units or frames are wrong is said to be so, before anybody looks for physics in it."""

import numpy as np

from fbse_drake.discrepancy.residual import RecordedMotion
from fbse_drake.errors import InputError

# Gravity on the IMU and the weight on the feet may be off by this share; an error of calibration is an effect of the library.
_TOLERANCE = 0.3
# Joints whose model torque is smaller than this [Nm] say nothing about the sign of their torque.
_SMALLEST_TORQUE = 3.0
# Angles beyond this are no angles in radians [rad].
_LARGEST_ANGLE = 4 * np.pi


def check_sensors(motion: RecordedMotion) -> None:
    """Checks signs, units and frames of a log against what every robot on the ground shows.

    Raises:
        InputError: one line on the first channel that cannot be what it is said to be.
    """
    robot, signals = motion.robot, motion.signals
    largest = np.abs(signals.joint_position).max(axis=0)
    if largest.max() > _LARGEST_ANGLE:
        joint = robot.joint_names[int(largest.argmax())]
        raise InputError(f"channel joint/position: {joint} reaches {largest.max():.0f} rad; are these degrees?")
    _check_velocity(motion)
    if robot.has_floating_base:
        _check_gravity(motion)
        _check_weight(motion)
    _check_torque(motion)


def _check_velocity(motion: RecordedMotion) -> None:
    """Joint velocities must be the derivative of joint angles."""
    length = motion.length
    q = motion.signals.joint_position[: len(motion.signals.joint_position) // length * length : length]
    from_angles = np.diff(q, axis=0) / (length * motion.period)
    measured = motion.blocks.joint_velocity[: len(from_angles)]
    power = (from_angles**2).sum(axis=0)
    for k in np.flatnonzero(np.sqrt(power / len(from_angles)) > 0.05):
        slope = float((from_angles[:, k] * measured[: len(from_angles), k]).sum() / power[k])
        if not 0.7 < slope < 1.3:
            hint = (
                "its sign is reversed"
                if -1.3 < slope < -0.7
                else "are these degrees per second?"
                if 40 < slope < 75
                else "unit or joint is wrong"
            )
            joint = motion.robot.joint_names[k]
            raise InputError(f"channel joint/velocity: {joint} reads {slope:.2g} times the rate of joint/position; {hint}")


def _check_gravity(motion: RecordedMotion) -> None:
    g = motion.equation.gravity
    mean = motion.signals.specific_force.mean(axis=0) @ motion.equation.R_BI.T
    channel = "channel imu/linear_acceleration: in base axes its mean is [" + ", ".join(f"{x:.2f}" for x in mean) + "] m/s^2"
    if np.linalg.norm(mean) < _TOLERANCE * g:
        raise InputError(f"{channel}; gravity is missing (expected the specific force, {g:.2f} m/s^2 upwards at rest)")
    if mean[2] < -(1 - _TOLERANCE) * g:
        raise InputError(f"{channel}; its sign is reversed (expected the specific force, {g:.2f} m/s^2 upwards at rest)")
    if not abs(np.linalg.norm(mean) / g - 1) < _TOLERANCE:
        raise InputError(f"{channel}; its unit is wrong (expected {g:.2f} m/s^2 upwards at rest)")
    if mean[2] < (1 - _TOLERANCE) * g:
        raise InputError(f"{channel}; its frame is wrong (expected {g:.2f} m/s^2 upwards at rest)")


def _check_weight(motion: RecordedMotion) -> None:
    """The feet together must carry what the base's specific force makes of the robot's mass, on average the weight."""
    wrenches = motion.equation.wrenches(motion.steps.pad_force)
    total = np.sum([wrench[:, 3:].mean(axis=0) for wrench in wrenches], axis=0)
    weight = motion.equation.weight
    text = "[" + ", ".join(f"{x:.0f}" for x in total) + f"] N in the sole frames, the robot weighs {weight:.0f} N"
    share = total[2] / weight
    sideways = np.abs(total[:2]).max() / weight
    if -1 - _TOLERANCE < share < -1 + _TOLERANCE:
        raise InputError(f"channel foot/<side>/pad_force: the mean force on the feet is {text}; its sign is reversed (expected upwards)")
    if sideways > 0.5:
        raise InputError(f"channel foot/<side>/pad_force: the mean force on the feet is {text}; its frame is wrong (expected along z)")
    if abs(share - 1) > _TOLERANCE:
        raise InputError(f"channel foot/<side>/pad_force: the mean force on the feet is {text}; unit, scale or the model's mass is wrong")


def _check_torque(motion: RecordedMotion) -> None:
    n = len(motion.robot.joint_names)
    command = motion.blocks.torque_command
    link = command - motion.residual.value[:, :n]
    for k in np.flatnonzero(np.sqrt((link**2).mean(axis=0)) > _SMALLEST_TORQUE):
        slope = float((link[:, k] * command[:, k]).sum() / (link[:, k] ** 2).sum())
        joint = motion.robot.joint_names[k]
        if slope < -0.3:
            raise InputError(
                f"channel joint/torque_command: {joint} pulls against what the model needs ({slope:.2g} times); its sign is reversed"
            )
        if not slope < 20:
            raise InputError(f"channel joint/torque_command: {joint} reads {slope:.3g} times what the model needs; its unit is wrong (Nm)")
