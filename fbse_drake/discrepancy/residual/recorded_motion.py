"""A log seen by a model: its residual, and when what of it is known."""

import fnmatch
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.ndimage import binary_erosion

from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.equation_of_motion import (
    EquationOfMotion,
    SensorNoise,
    Unseen,
    joint_velocity_noise,
)
from fbse_drake.discrepancy.residual.integration import integration_step
from fbse_drake.discrepancy.residual.recorded_signals import (
    Instants,
    Timing,
    averaged,
    differences_angles,
    low_passed,
    read_signals,
    steps,
    unbroken,
    within_steps,
)
from fbse_drake.discrepancy.residual.recorded_velocity import Lateness, rounding_error
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.discrepancy.residual.rows import foot_pairs, residual_rows
from fbse_drake.discrepancy.residual.white_noise import noise_corners, step_of
from fbse_drake.effects.sensor import SensorSignals
from fbse_drake.errors import InputError
from fbse_drake.held_readings import (
    rows_of_readings,
    rows_per_reading,
    unseen_variance,
)
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import RecordingConfig, SensorsConfig
from fbse_drake.sensors.foot_force import wrench_deviations
from fbse_drake.sensors.foot_pads import measured_pad_forces

# Soles settle for this long at the start of a recording [s]. A foot that has just touched down, or
# is about to lift, may still roll over an edge: its sole is not at rest in this time [s].
_SETTLING, _ROLLING = 0.1, 0.03
# Blocks of fewer samples share much of what is sampled at their ends, or angles that their
# velocities are differenced from: their noise is not that of neighbours that are independent.
_SHARING = 3
# By how many draws it is found what the steps of encoders may feign.
_DRAWS = 16


class RecordedMotion:
    """A log seen by a model: makes residuals, and finds how they change with the signals or the
    model."""

    def __init__(
        self,
        robot: Robot,
        sensors: SensorsConfig,
        recording: RecordingConfig,
        log: Log,
        left_out: Sequence[tuple[float, float]] = (),
        stamps: np.ndarray | None = None,
    ):
        """Reads the log.

        Args:
            robot: the model.
            sensors: whose noise is believed.
            recording: how the log is read.
            left_out: start and end [s] of stretches of which nothing is known.
            stamps: of the samples, where those of the log are not as recorded (N,) [s].

        Raises:
            InputError: a log that does not fit the model, or one that is too short.
        """
        self.stamps = log.time if stamps is None else stamps
        self.robot, self.sensors, self.recording, self.log = robot, sensors, recording, log
        self.timing = Timing.of(log, recording)
        self.period = self.timing.period
        differenced = differences_angles(recording, log)
        self.signals, self.measured = read_signals(robot, log, recording, differenced=differenced)
        self.lateness = Lateness.none(len(robot.joint_names))
        if recording.is_sampled and not differenced:
            q, v = self.signals.joint_position, self.signals.joint_velocity
            lateness = Lateness.of(q, v, self.period, unbroken(self.measured))
            v, known = lateness.in_time(v, self.measured, self.period)
            self.lateness, self.measured = lateness, known
            self.signals = replace(self.signals, joint_velocity=v)
        least = _SHARING if recording.is_sampled or differenced else 1
        self.length = max(least, round(recording.block / self.period))
        if len(self.signals.joint_position) < 20 * self.length:
            raise InputError(
                f"the log is too short: {len(log.time)} samples, at least "
                f"{20 * self.length} are needed"
            )
        self.rows = residual_rows(robot, motor_encoders=self.signals.motor_position.shape[1] > 0)
        names = [row.name for row in self.rows]
        for pattern in recording.unused_rows:
            if not fnmatch.filter(names, pattern):
                raise InputError(
                    f"recording.unused_rows: {pattern}: there is no such row "
                    f"(there are: {', '.join(names)})"
                )
        self.start, self._left_out = float(log.time[0]), left_out
        self.equation = EquationOfMotion(robot)
        if not recording.is_sampled:
            position, velocity = self.signals.joint_position, self.signals.joint_velocity
            found = integration_step(position, velocity, self.period, self.measured)
            self.timing = replace(self.timing, integration=found)

    @cached_property
    def steps(self) -> Instants:
        return self.steps_of(self.signals)

    def steps_of(self, signals: SensorSignals) -> Instants:
        """Steps of other signals on the same grid; velocities without their noise, whose square
        would be a torque of its own."""
        velocity = self.without_velocity_noise(signals).joint_velocity
        amid = within_steps(velocity, self.timing.motion_share)
        return replace(steps(signals, self.timing), joint_velocity=amid)

    def low_passed(self, values: np.ndarray, corner: float) -> np.ndarray:
        """Samples (N, ...) through a low-pass without delay, gaps left out; as they are for 0
        Hz."""
        return low_passed(values, corner, self.period, self.stretches)

    @cached_property
    def stretches(self) -> list[slice]:
        """Runs of samples without a gap."""
        return unbroken(self.measured)

    def averages(self, predicted: np.ndarray) -> np.ndarray:
        """Averages over blocks of what was predicted step by step, (N - 1, ...), as the recording
        would hold it."""
        return block_means(
            low_passed(
                predicted, self.recording.recorded_cutoff, self.period, self._measured_steps
            ),
            self.length,
        )

    @cached_property
    def _measured_steps(self) -> list[slice]:
        """Runs of steps without a gap."""
        return unbroken(self.measured[:-1] & self.measured[1:])

    @cached_property
    def blocks(self) -> Instants:
        """Averages of the steps."""
        return averaged(self.steps, self.length)

    @cached_property
    def quiet_blocks(self) -> Instants:
        """The same without the noise of the joints' velocities."""
        return self.quiet_blocks_of(self.signals)

    def quiet_blocks_of(self, signals: SensorSignals) -> Instants:
        """The same of other signals on the same grid."""
        return averaged(steps(self.without_velocity_noise(signals), self.timing), self.length)

    def without_velocity_noise(self, signals: SensorSignals) -> SensorSignals:
        """Signals without frequencies in which the log has little but noise of the joints'
        velocities: in a regressor it would be the noise of the residual, which is the same (errors
        in variables)."""
        return replace(signals, joint_velocity=self.without_noise(signals.joint_velocity))

    def without_noise(self, values: np.ndarray) -> np.ndarray:
        """Values of the joints (N, n) without frequencies in which their velocities are noise."""
        smooth = [
            self.low_passed(column, corner)
            for column, corner in zip(values.T, self._velocity_corners, strict=True)
        ]
        return np.stack(smooth, axis=1)

    @cached_property
    def _velocity_corners(self) -> list[float]:
        """Frequency above which each joint's velocity is little but noise [Hz]; 0 for none, or in
        logs per step, whose impacts are as fast.

        A velocity of which no noise is known is taken to be a rate of the angles beside it.
        """
        recording, velocity = self.recording, self.signals.joint_velocity
        if not recording.is_sampled or recording.cutoff > 0:
            return [0.0] * velocity.shape[1]
        noise = joint_velocity_noise(self.sensors)
        of_rates = noise == 0 or differences_angles(recording, self.log)
        if of_rates:
            steps = np.array([step_of(q) for q in self.log["joint/position"].T])
            deviation = np.maximum(steps / np.sqrt(12.0), self.sensors.encoders.angle_noise)
        else:
            deviation = np.full(velocity.shape[1], noise)
        return noise_corners(velocity, deviation**2, self.period, of_rates=of_rates)

    @cached_property
    def rounding_noise(self) -> np.ndarray:
        """What rounding adds to the residual if the steps of the joints' encoders began elsewhere,
        K draws, (K, B, R); none where velocities are not had from angles that come in steps.

        Velocities that come late behind such angles are taken to be had from them by a filter.
        """
        step = np.array([step_of(column) for column in self.log["joint/position"].T])
        differenced = differences_angles(self.recording, self.log)
        step = np.where(differenced | (self.lateness.seconds > 0), step, 0.0)
        if not step.any():
            return np.zeros((0, len(self.time), len(self.rows)))
        angle, random = self.without_noise(self.signals.joint_position), np.random.default_rng(0)
        counts = np.divide(angle, step, out=np.zeros_like(angle), where=step > 0)
        value, draws = self.equation.residual(self.steps), []
        for _ in range(_DRAWS):
            moved = counts + random.random(len(step))
            if differenced:
                rate = np.gradient(rounding_error(moved), self.period, axis=0)
            else:
                rate = self.lateness.rounding_error(moved, self.period)
            error = self.low_passed(rate * step, self.recording.cutoff)
            velocity = self.signals.joint_velocity + error
            noisier = self.steps_of(replace(self.signals, joint_velocity=velocity))
            draws.append(block_means(self.equation.residual(noisier) - value, self.length))
        return np.array(draws)

    @cached_property
    def time(self) -> np.ndarray:
        """Centre of each block [s]."""
        return (
            self.start
            + (np.arange(len(self.blocks.joint_position)) + 0.5) * self.length * self.period
        )

    @cached_property
    def standing(self) -> np.ndarray:
        """Which soles stand throughout each block, (B, feet)."""
        return (
            block_means(self.equation.standing(self.steps.pad_force).astype(float), self.length)
            == 1.0
        )

    @cached_property
    def known(self) -> np.ndarray:
        """Which averages of which rows are known, (B, R)."""
        rows = self.rows
        # A force at the end of the sensor's range is any force beyond it.
        measured = self.measured & (
            np.abs(self.signals.pad_force) < self.sensors.foot_force.range
        ).all(axis=(1, 2))
        in_gap = block_means(1.0 - (measured[:-1] & measured[1:]), self.length) > 0
        half = 0.5 * self.length * self.period
        for start, end in self._left_out:
            in_gap |= (self.time + half > start) & (self.time - half < end)
        known = np.repeat(~in_gap[:, None], len(rows), axis=1)
        if "joint/torque_command" not in self.log:
            known[:, [row.kind == "joint" for row in rows]] = False
        known[
            :,
            [
                any(fnmatch.fnmatch(row.name, pattern) for pattern in self.recording.unused_rows)
                for row in rows
            ],
        ] = False
        least = self.robot.description.per_joint(
            self.recording.least_speed, key="recording.least_speed", default=0.0
        )
        known[:, : len(least)] &= (
            block_means(np.abs(self.steps.joint_velocity) >= least, self.length) == 1.0
        )
        kinematic = np.array([row.kind == "kinematic" for row in rows])
        settling = self.since_start <= _SETTLING
        # Nor is it known where a motor stands in its gap at first.
        begins = kinematic | np.array([row.kind == "transmission" for row in rows])
        known &= ~begins | ~settling[:, None]
        around = 2 * round(_ROLLING / (self.length * self.period)) + 1
        at_rest = binary_erosion(self.standing, np.ones((around, 1)), border_value=1)
        for foot, (side, leg) in enumerate(self.robot.description.legs.items()):
            # How a point foot is turned while it stands is not known.
            still = at_rest[:, foot, None] & (not leg.is_point)
            known[:, [row.name.startswith(f"{side}_sole/") for row in rows]] &= still
        # Of feet that stand, the velocities of each relative to the next one say all.
        pairs = foot_pairs(self.robot)
        for one, other in pairs:
            between = [foot for foot in range(one + 1, other) if (one, foot) in pairs]
            still = at_rest[:, one] & at_rest[:, other] & ~at_rest[:, between].any(axis=1)
            feet = tuple(self.robot.description.sides[foot] for foot in (one, other))
            known[:, [row.feet == feet for row in rows]] &= still[:, None]
        return known

    @cached_property
    def since_start(self) -> np.ndarray:
        """Time of each average since its recording began, (B,) [s]."""
        starts = [self.start, *(part["start"] for part in self.log.meta.get("segments", ()))]
        since = self.time[:, None] - np.array(starts)
        return np.where(since >= 0, since, np.inf).min(axis=1)

    def torque_variance(self, torque: np.ndarray) -> np.ndarray:
        """Variance of the white noise of a sample of torques (M, n), as the recording says it, (M,
        n)."""
        names, recording = self.robot.description, self.recording
        noise, share = (
            names.per_joint(getattr(recording, key), key=f"recording.{key}", default=0.0)
            for key in ("torque_noise", "torque_noise_share")
        )
        return np.where(names.has_motor, noise**2 + (share * torque) ** 2, 0.0)

    @cached_property
    def sensors_by_row(self) -> SensorsConfig:
        """The sensors with white noise in every row that leaves as much in an average over a block
        as they do, whose readings may be held for some rows."""
        imu, feet = self.sensors.imu, self.sensors.foot_force

        def spread(noise: float, names: Iterable[str]) -> float:
            held = max((rows_per_reading(self.log[n]) for n in names if n in self.log), default=1)
            return noise * math.sqrt(min(held, self.length))

        of_feet = [name for name in self.log.channels if name.startswith("foot/")]
        return replace(
            self.sensors,
            imu=replace(
                imu,
                acceleration_noise=spread(imu.acceleration_noise, ["imu/linear_acceleration"]),
            ),
            foot_force=replace(
                feet,
                noise=spread(feet.noise, of_feet),
                moment_noise=spread(feet.moment_noise, of_feet),
            ),
        )

    @cached_property
    def _unseen(self) -> Unseen:
        """Of the blocks."""
        log, sensors, timing = self.log, self.sensors, self.timing
        # A row of the log for each sample on the grid.
        grid = self.start + np.arange(len(self.measured)) * self.period
        row = np.searchsorted(log.time, grid - 0.5 * self.period).clip(max=len(log.time) - 1)
        # Samples that are the mean over nothing tell of all around them.
        seen, commanded = (
            time / self.period if time > 0 else 1.0 for time in (timing.reading, timing.command)
        )

        def of_blocks(values: np.ndarray) -> np.ndarray:
            return block_means(values[row[:-1]], self.length)

        def of_sensor(values: np.ndarray, noise: np.ndarray | float) -> np.ndarray:
            return of_blocks(unseen_variance(values, noise, seen, rows_of_readings(values)))

        torque = log.get("joint/torque_command", np.zeros_like(log["joint/position"]))
        noise = np.sqrt(self.torque_variance(torque).mean(axis=0))
        torques = unseen_variance(torque, noise, commanded, np.arange(len(torque)))
        if not self.robot.has_floating_base:
            return Unseen(of_blocks(torques), np.zeros((len(self.time), 3)), [])
        specific_force = log["imu/linear_acceleration"] @ self.equation.R_BI.T
        wrenches = self.equation.wrenches(measured_pad_forces(self.robot, log))
        deviations = wrench_deviations(sensors.foot_force, self.robot)
        return Unseen(
            of_blocks(torques),
            of_sensor(specific_force, sensors.imu.acceleration_noise),
            [of_sensor(*of_foot) for of_foot in zip(wrenches, deviations, strict=True)],
        )

    @cached_property
    def sensor_noise(self) -> SensorNoise:
        """What is believed of the sensors' noise, in steps of each block."""
        noise = self.equation.noise(self.blocks, self.sensors_by_row, self._unseen)
        torque = self.torque_variance(self.blocks.torque_command)
        noise.white[:, : torque.shape[1]] += torque
        return noise

    @cached_property
    def residual(self) -> Residual:
        """The residual of the model's rigid bodies; what its effects explain is not taken off.

        Raises:
            InputError: no row of it is known at any time.
        """
        if not self.known.any():
            lacking = (
                "" if "joint/torque_command" in self.log else ", joint/torque_command is missing"
            )
            raise InputError(
                f"the log has nothing to compare a model with{lacking} (needed: torques, or feet "
                f"and an IMU, without gaps for {self.recording.block:g} s, in rows that "
                "recording.unused_rows and recording.least_speed leave)"
            )
        value = self.equation.residual(self.steps)
        if self.recording.recorded_cutoff > 0:
            measured = np.zeros_like(value)
            measured[:, : len(self.robot.joint_names)] = self.steps.torque_command
            value = block_means(measured, self.length) + self.averages(value - measured)
        else:
            value = block_means(value, self.length)
        variance, covariance = self.sensor_noise.of_blocks(self.length, self.period)
        return Residual(
            self.rows,
            self.time,
            value,
            self.known,
            variance,
            covariance,
            self.standing,
            self.blocks,
        )
