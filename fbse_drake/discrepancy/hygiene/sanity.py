"""Is it calibration or the model? A log whose signs, units or frames are wrong is said to be so,
before anybody looks for physics in it."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from pydrake.multibody.tree import RevoluteJoint

from fbse_drake.discrepancy.hygiene.torque_checks import check_torque
from fbse_drake.discrepancy.residual.evidence import Evidence
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.errors import InputError

# Gravity on the IMU and the weight on the feet may be off by this share; an error of calibration is
# an effect of the library.
_TOLERANCE = 0.3
# A torque that is so many times what the model needs is in another unit.
_ANOTHER_UNIT = 20.0
# Angles this many times as large as the joint's limits and beyond them by so much are no angles in
# radians [rad]; nor, of a joint without limits, beyond this if it is so fast on the mean [rad/s].
_BEYOND_LIMITS, _BEYOND = 3.0, 1.0
_LARGEST_ANGLE, _LARGEST_RATE = 4 * np.pi, 20.0
# A joint that moves less than this, root mean square, says nothing about its second encoder [rad].
_SMALLEST_MOTION = 0.05
# A base that turns less than this, root mean square, says nothing about its gyroscope [rad/s].
_SMALLEST_RATE = 0.02
# Of rates of which one follows the other, inner product over the larger square.
_AGREES = 0.8


def check_sensors(motion: RecordedMotion, evidence: Evidence | None = None) -> None:
    """Checks signs, units and frames of a log against what every robot on the ground shows.

    Args:
        evidence: of this motion, where there is one already.

    Raises:
        InputError: one line on the first channel that cannot be what it is said to be.
    """
    robot = motion.robot
    _check_angles(motion)
    _check_velocity(motion)
    _check_motor_angles(motion)
    if robot.has_floating_base:
        _check_gravity(motion)
        _check_weight(motion)
        _check_gyroscope(motion)
    _check_torque(Evidence(motion) if evidence is None else evidence)


def _check_angles(motion: RecordedMotion) -> None:
    robot = motion.robot
    angles = motion.signals.joint_position
    largest = np.abs(angles).max(axis=0)
    # So long an average that no digit of an encoder counts.
    length = motion.length
    rates = np.abs(np.diff(angles[::length], axis=0)).mean(axis=0) / (length * motion.period)
    for joint, angle, rate in zip(robot.joint_names, largest, rates, strict=True):
        model = robot.plant.GetJointByName(joint)
        if model.type_name() != RevoluteJoint.kTypeName:
            continue
        limit = float(max(-model.position_lower_limits()[0], model.position_upper_limits()[0]))
        is_beyond = angle > max(_BEYOND_LIMITS * limit, limit + _BEYOND)
        spins = not np.isfinite(limit) and angle > _LARGEST_ANGLE and rate > _LARGEST_RATE
        if is_beyond or spins:
            allowed = f" (the model's limit is {limit:.2g} rad)" if np.isfinite(limit) else ""
            raise InputError(
                f"channel joint/position: {joint} reaches {angle:.3g} "
                f"rad{allowed}; are these degrees?"
            )


def _check_velocity(motion: RecordedMotion) -> None:
    """Joint velocities must be the derivative of joint angles."""
    length = motion.length
    q = motion.signals.joint_position[
        : len(motion.signals.joint_position) // length * length : length
    ]
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
            raise InputError(
                f"channel joint/velocity: {joint} reads {slope:.2g} times the rate "
                f"of joint/position; {hint}"
            )


def _check_motor_angles(motion: RecordedMotion) -> None:
    """A second encoder must turn as the joint does, but for what the transmission gives."""
    of_motor = motion.signals.motor_position
    moved = motion.signals.joint_position - motion.signals.joint_position.mean(axis=0)
    power = (moved**2).mean(axis=0)
    for k in np.flatnonzero(np.sqrt(power[: of_motor.shape[1]]) > _SMALLEST_MOTION):
        slope = float((of_motor[:, k] * moved[:, k]).mean() / power[k])
        if not 0.7 < slope < 1.3:
            raise InputError(
                f"channel joint/motor_position: {motion.robot.joint_names[k]} turns {slope:.3g} "
                "times as far as joint/position; expected the motor's angle divided by the gear's "
                "ratio, in the joint's direction"
            )


def _check_gravity(motion: RecordedMotion) -> None:
    g = motion.equation.gravity
    mean = motion.signals.specific_force.mean(axis=0) @ motion.equation.R_BI.T
    channel = (
        "channel imu/linear_acceleration: in base axes its mean is ["
        + ", ".join(f"{x:.2f}" for x in mean)
        + "] m/s^2"
    )
    if np.linalg.norm(mean) < _TOLERANCE * g:
        raise InputError(
            f"{channel}; gravity is missing (expected the specific force, "
            f"{g:.2f} m/s^2 upwards at rest)"
        )
    if mean[2] < -(1 - _TOLERANCE) * g:
        raise InputError(
            f"{channel}; its sign is reversed (expected the specific force, "
            f"{g:.2f} m/s^2 upwards at rest)"
        )
    if not abs(np.linalg.norm(mean) / g - 1) < _TOLERANCE:
        raise InputError(f"{channel}; its unit is wrong (expected {g:.2f} m/s^2 upwards at rest)")
    if mean[2] < (1 - _TOLERANCE) * g:
        raise InputError(f"{channel}; its frame is wrong (expected {g:.2f} m/s^2 upwards at rest)")


def _check_weight(motion: RecordedMotion) -> None:
    """The feet together must carry what the base's specific force makes of the robot's mass, on
    average the weight."""
    wrenches = motion.equation.wrenches(motion.steps.pad_force)
    for side, wrench in zip(motion.robot.description.sides, wrenches, strict=True):
        pull, push = -np.quantile(wrench[:, 5], (0.02, 0.98)) / motion.equation.weight
        if (
            pull > _TOLERANCE > -push
            and len(wrenches) > 1
            and sum(w[:, 5].mean() < 0 for w in wrenches) < len(wrenches)
        ):
            raise InputError(
                f"channel foot/{side}: this foot pulls at the ground, with up to "
                f"{100 * pull:.0f} % of the weight; its sign is reversed (expected the ground's "
                "force on the foot, upwards)"
            )
    total = np.sum([wrench[:, 3:].mean(axis=0) for wrench in wrenches], axis=0)
    weight = motion.equation.weight
    text = (
        "["
        + ", ".join(f"{x:.0f}" for x in total)
        + f"] N in the sole frames, the robot weighs {weight:.0f} N"
    )
    share = total[2] / weight
    sideways = np.abs(total[:2]).max() / weight
    if -1 - _TOLERANCE < share < -1 + _TOLERANCE:
        raise InputError(
            f"channel foot/<side>: the mean force on the feet is {text}; its sign is "
            "reversed (expected upwards)"
        )
    if sideways > 0.5:
        raise InputError(
            f"channel foot/<side>: the mean force on the feet is {text}; its frame is "
            "wrong (expected along z)"
        )
    if abs(share - 1) > _TOLERANCE:
        raise InputError(
            f"channel foot/<side>: the mean force on the feet is {text}; unit, scale or "
            "the model's mass is wrong"
        )


def rate_by_legs(motion: RecordedMotion, at: Instants) -> tuple[np.ndarray, np.ndarray]:
    """How the base turns while a sole stands, told by the joints of that leg alone.

    Returns:
        Angular velocity of the base in its axes, (M, 3) [rad/s], and when a sole stands, (M,).
    """
    still = replace(
        at,
        angular_velocity=np.zeros_like(at.angular_velocity),
        angular_acceleration=np.zeros_like(at.angular_acceleration),
    )
    of_soles = motion.equation.residual(still)[:, len(motion.robot.joint_names) + 6 :]
    # A point foot may turn while it stands.
    is_flat = [not leg.is_point for leg in motion.robot.description.legs.values()]
    standing = motion.equation.standing(at.pad_force) & np.array(is_flat)
    rates = np.zeros((len(standing), 3))
    for foot, R_BF in enumerate(motion.equation.sole_rotations(at.joint_position)):
        here = standing[:, foot] & ~standing[:, :foot].any(axis=1)
        rates[here] = -np.einsum("mij,mj->mi", R_BF, of_soles[:, 6 * foot : 6 * foot + 3])[here]
    return rates, standing.any(axis=1)


def _check_gyroscope(motion: RecordedMotion) -> None:
    """While a sole stands, its leg tells how the base turns."""
    at = motion.blocks
    gyro = at.angular_velocity @ motion.equation.R_BI.T
    rates, stands = rate_by_legs(motion, at)
    power = (rates[stands] ** 2).sum()
    if not stands.any() or np.sqrt(power / stands.sum()) < _SMALLEST_RATE:
        return
    slope = float((rates[stands] * gyro[stands]).sum() / power)
    if not 0.5 < slope < 2.0:
        hint = (
            "its sign is reversed"
            if slope < -0.5
            else "are these degrees per second?"
            if 40 < slope < 75
            else _exchanged_joints(motion, at, gyro)
            or "its unit or frame is wrong, or joints or feet change places"
        )
        raise InputError(
            f"channel imu/angular_velocity: reads {slope:.2g} times the rate at which the legs "
            f"that stand turn the base; {hint}"
        )


def _exchanged_joints(motion: RecordedMotion, at: Instants, gyro: np.ndarray) -> str:
    """Says which two joints of legs change places, if with each other's the gyroscope is right;
    else empty.

    Args:
        gyro: angular velocity of the base in its axes, (M, 3) [rad/s].
    """
    names, best, said = motion.robot.joint_names, _AGREES, ""
    legs = motion.robot.description.legs.values()
    places = [names.index(joint) for leg in legs for joint in leg.joints]
    for i, j in combinations(places, 2):
        order = np.arange(len(names))
        order[[i, j]] = j, i
        moved = ("joint_position", "joint_velocity", "joint_acceleration")
        exchanged = replace(at, **{name: getattr(at, name)[:, order] for name in moved})
        rates, stands = rate_by_legs(motion, exchanged)
        product = float((rates[stands] * gyro[stands]).sum())
        agreement = product / max((rates[stands] ** 2).sum(), (gyro[stands] ** 2).sum(), 1e-300)
        if agreement > best:
            best = agreement
            said = (
                f"the joints {names[i]} and {names[j]} change places: with each other's it agrees"
            )
    return said


def _check_torque(evidence: Evidence) -> None:
    """Torques whose sign is wrong, or whose unit is another."""
    for finding in evidence.found_by(check_torque):
        if finding.kind == "torque_sign":
            raise InputError(f"channel {finding.text}")
        if finding.kind == "torque_scale" and finding.severity == "untrustworthy":
            worst, size = finding.where[0], finding.size
            if size > _ANOTHER_UNIT:
                raise InputError(
                    f"channel {finding.channel}: {worst} reads {size:.3g} times what the model "
                    "needs; its unit is wrong (Nm)"
                )
