"""The channels of a log as signals on an even grid, and what a robot did in every step of it."""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.signal import butter, sosfiltfilt

from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.lost_readings import between_lost
from fbse_drake.discrepancy.residual.recorded_velocity import are_differences
from fbse_drake.effects.sensor import SensorSignals
from fbse_drake.errors import InputError
from fbse_drake.held_readings import between_readings
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import RecordingConfig
from fbse_drake.sensors.foot_pads import FootPads, measured_pad_forces

# Order of the low-pass of a recording, and how far it continues a stretch beyond its ends
# [samples].
_ORDER, _PADDING = 4, 100


@dataclass(frozen=True)
class Instants:
    """What the equation of motion needs at M instants; IMU quantities in the IMU frame."""

    joint_position: np.ndarray
    joint_velocity: np.ndarray
    joint_acceleration: np.ndarray
    angular_velocity: np.ndarray
    angular_acceleration: np.ndarray
    specific_force: np.ndarray
    # (M, P, 3) [N].
    pad_force: np.ndarray
    torque_command: np.ndarray
    # (M, n), or (M, 0) without second encoders.
    motor_position: np.ndarray


@dataclass(frozen=True)
class Timing:
    """When what a row of a log tells is so, see `RecordingConfig.rows`; all in [s]."""

    # From one row to the next.
    period: float
    # A reading of accelerometer or foot force is the mean over this before its row.
    reading: float = 0.0
    # The command of a row is held for this from then on.
    command: float = 0.0
    # Steps in which the motion was integrated; 0 for continuous motion.
    integration: float = 0.0

    @staticmethod
    def of(log: Log, recording: RecordingConfig) -> "Timing":
        """That of a log's rows, but for the integration of its motion."""
        period = float(log.meta["period"])
        if recording.is_sampled:
            return Timing(period)
        said = (log.meta.get(key) for key in ("reading_time", "command_time"))
        reading, command = (period if time is None else min(time, period) for time in said)
        return Timing(period, reading, command)

    @property
    def reading_share(self) -> float:
        """Between the readings at both ends of a step, where that of its middle is, as a share."""
        return 0.5 + 0.5 * self.reading / self.period

    @property
    def command_share(self) -> float:
        """The same of commands."""
        return 0.5 - 0.5 * self.command / self.period

    @property
    def motion_share(self) -> float:
        """Where in a step its forces have their posture and velocities: a simulation has its forces
        from where its own, semi-implicit steps began, which is half of such a step earlier."""
        return 0.5 - 0.5 * self.integration / self.period

    @property
    def law_share(self) -> float:
        """Where in a step the velocity is that friction has: a simulated law holds at the end of
        its integration step."""
        return 0.5 + 0.5 * self.integration / self.period


def read_signals(
    robot: Robot, log: Log, recording: RecordingConfig, *, differenced: bool
) -> tuple[SensorSignals, np.ndarray]:
    """Sensor channels of a log on an even grid of its nominal period.

    Late samples are interpolated, what sensors hold between their readings, and measured torques
    that were lost; what lies in a gap is marked. Without `joint/torque_command` torques are 0.

    Args:
        differenced: see `differences_angles`.

    Returns:
        The signals, N samples, and which of them are measured (not interpolated over a gap), shape
        (N,).

    Raises:
        InputError: other joints than the model's, missing IMU or foot channels of a floating robot.
    """
    if log.joints != robot.joint_names:
        raise InputError(f"the log's joints {log.joints} are not the model's {robot.joint_names}")
    period, time = float(log.meta["period"]), log.time
    grid = time[0] + np.arange(round((time[-1] - time[0]) / period) + 1) * period
    even = len(grid) == len(time) and np.allclose(grid, time, rtol=0, atol=1e-6 * period)
    after = (
        np.clip(np.searchsorted(time, grid - 1e-9 * period), 1, len(time) - 1)
        if len(time) > 1
        else np.zeros(1, dtype=int)
    )
    known = np.ones(len(grid), dtype=bool)
    if not even:
        known = (time[after] - time[after - 1] < 1.5 * period) | (
            time[after] - grid < 1e-3 * period
        )
    # What is smoothed or differenced is not so across the switching of a drive, where torques jump.
    latest = np.clip(np.searchsorted(time, grid + 1e-9 * period) - 1, 0, None)
    stretches = unbroken(known, log["joint/enabled"][latest] if "joint/enabled" in log else None)

    def filtered(values: np.ndarray) -> np.ndarray:
        return low_passed(values, recording.cutoff, period, stretches)

    def on_grid(values: np.ndarray) -> np.ndarray:
        values = between_readings(values)
        if even:
            return filtered(values)
        share = ((grid - time[after - 1]) / (time[after] - time[after - 1])).clip(0.0, 1.0)
        share = share.reshape(-1, *[1] * (values.ndim - 1))
        return filtered((1 - share) * values[after - 1] + share * values[after])

    def held(values: np.ndarray) -> np.ndarray:
        return filtered(values if even else values[latest])

    def rate(values: np.ndarray) -> np.ndarray:
        result = np.zeros_like(values)
        for stretch in stretches:
            if len(values[stretch]) > 1:
                result[stretch] = np.gradient(values[stretch], period, axis=0)
        return result

    zeros = np.zeros((len(grid), 3))
    specific_force = angular_velocity = zeros
    pad_force = np.zeros((len(grid), len(FootPads(robot).foot), 3))
    if robot.has_floating_base:
        for name in ("imu/linear_acceleration", "imu/angular_velocity"):
            if name not in log:
                raise InputError(
                    f"the log has no channel {name}, which the residual of a floating robot needs"
                )
        specific_force, angular_velocity = (
            on_grid(log["imu/linear_acceleration"]),
            on_grid(log["imu/angular_velocity"]),
        )
        pad_force = on_grid(measured_pad_forces(robot, log))
    q = on_grid(log["joint/position"])
    if differenced:
        # Where a stretch ends there is no central difference.
        inside = np.zeros_like(known)
        for stretch in stretches:
            inside[stretch.start + 1 : stretch.stop - 1] = True
        known = inside
    torque = log.get("joint/torque_command", np.zeros_like(log["joint/position"]))
    torque = np.where(robot.description.has_motor, torque, 0.0)
    command = on_grid(between_lost(torque)) if recording.is_sampled else held(torque)
    signals = SensorSignals(
        joint_position=q,
        joint_velocity=rate(q) if differenced else on_grid(log["joint/velocity"]),
        specific_force=specific_force,
        angular_velocity=angular_velocity,
        pad_force=pad_force,
        torque_command=command,
        motor_position=on_grid(log.get("joint/motor_position", np.zeros((len(log.time), 0)))),
        load_begin=command,
        load_end=command,
    )
    return signals, known


def differences_angles(recording: RecordingConfig, log: Log) -> bool:
    """Are velocities had from the angles, by central differences? Also where those of a log that is
    sampled are such differences, which would be half a sample late as they are."""
    if recording.velocity == "differenced" or "joint/velocity" not in log:
        return True
    return recording.is_sampled and are_differences(
        log.time, log["joint/position"], log["joint/velocity"]
    )


def low_passed(
    values: np.ndarray, cutoff: float, period: float, stretches: list[slice]
) -> np.ndarray:
    """Values (N, ...) through a low-pass without delay, stretch by stretch; as they are for a
    corner of 0, or of half the rate of samples, beyond which they hold nothing."""
    if cutoff == 0 or 2 * cutoff * period >= 1:
        return values
    result = values.copy()
    filter_ = _butterworth(cutoff, period)
    for stretch in stretches:
        result[stretch] = sosfiltfilt(
            filter_, values[stretch], axis=0, padlen=min(len(values[stretch]) - 1, _PADDING)
        )
    return result


@cache
def _butterworth(cutoff: float, period: float) -> np.ndarray:
    return butter(_ORDER, cutoff, fs=1 / period, output="sos")


def unbroken(known: np.ndarray, enabled: np.ndarray | None = None) -> list[slice]:
    """Runs of samples between gaps, in which no drive is switched on or off.

    Args:
        enabled: which drives are on, (N, n).
    """
    switched = np.zeros(len(known), dtype=bool)
    if enabled is not None:
        switched[1:] = np.any(np.diff(enabled, axis=0) != 0, axis=1)
    run = np.where(known, 1 + np.cumsum(switched), 0)
    edges = np.flatnonzero(np.diff(run, prepend=0, append=0))
    return [slice(start, stop) for start, stop in pairwise(edges) if known[start]]


def steps(signals: SensorSignals, timing: Timing) -> Instants:
    """Every step between two samples, M = N - 1: all that is measured is taken amid the step, the
    accelerations are those over it."""
    at_readings, at_commands = timing.reading_share, timing.command_share
    at_motion, period = timing.motion_share, timing.period
    return Instants(
        joint_position=within_steps(signals.joint_position, at_motion),
        joint_velocity=within_steps(signals.joint_velocity, at_motion),
        joint_acceleration=np.diff(signals.joint_velocity, axis=0) / period,
        angular_velocity=within_steps(signals.angular_velocity, at_motion),
        angular_acceleration=np.diff(signals.angular_velocity, axis=0) / period,
        specific_force=within_steps(signals.specific_force, at_readings),
        pad_force=within_steps(signals.pad_force, at_readings),
        torque_command=within_steps(signals.torque_command, at_commands),
        motor_position=within_steps(signals.motor_position, at_motion),
    )


def within_steps(values: np.ndarray, share: float) -> np.ndarray:
    """Samples (N, ...) interpolated in every step, (N - 1, ...): at its start for a share of 0, at
    its end for 1."""
    return (1.0 - share) * values[:-1] + share * values[1:]


def averaged(instants: Instants, length: int) -> Instants:
    """The instants averaged over blocks."""
    return Instants(
        **{name: block_means(values, length) for name, values in vars(instants).items()}
    )
