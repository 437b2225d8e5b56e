"""A log as the bodies and sensors of a model read it: what models have in common that differ in
effects which are taken off the residual."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.signal import savgol_filter

from fbse_drake.discrepancy.residual.equation_of_motion import joint_velocity_noise
from fbse_drake.discrepancy.residual.noise import measured_noise, measured_sensors
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants, within_steps
from fbse_drake.discrepancy.residual.servo import with_command
from fbse_drake.discrepancy.residual.time_stamps import sampled_evenly
from fbse_drake.discrepancy.residual.white_noise import noise_corners
from fbse_drake.effects.actuation import TorqueReadingLag
from fbse_drake.effects.contact import GroundEffect
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.effects.sensor import ResolvedSensorEffect, SensorEffect, SensorSignals
from fbse_drake.errors import located
from fbse_drake.log import Log
from fbse_drake.scenario import RecordingConfig, Scenario, build_robot

# Joint velocities are smoothed over this many samples, without delay, where friction laws take
# them.
_SMOOTHING = 9
# Friction changes its sign within so many deviations of the velocity's noise, and any mixture of
# these widths [rad/s].
_MOVES, _TURNS = 4.0, (1e-3, 5e-2)
# For so long a log that we did not simulate is taken to have been as it begins [s]; sources of
# those that we did.
_EARLIER, _FORGETFUL = 0.2, ("fbse_drake simulation", "planned motion")


class Reading:
    """A log, read by the bodies and sensors of a scenario's model."""

    def __init__(self, scenario: Scenario, log: Log, left_out: Sequence[tuple[float, float]] = ()):
        """Reads it.

        Args:
            left_out: start and end [s] of stretches of which nothing is said.

        Raises:
            InputError: a log that does not fit the model.
        """
        self.log, self.left_out, self._read_by = log, tuple(left_out), _reader(scenario)
        with located("model: "):
            self.robot = build_robot(scenario.believed)
        log = with_command(scenario, log, self.robot.description)
        stamps, log = log.time, sampled_evenly(log)
        sensors, self.noisier_channels = measured_sensors(scenario.sensors, scenario.recording, log)
        self.motion = RecordedMotion(
            self.robot, sensors, scenario.recording, log, self.left_out, stamps
        )
        # By how much torques are read earlier than the log has them, (n,) [s].
        self.late_torques = np.zeros(len(self.robot.joint_names))
        # What came last into the readings goes first.
        for key, effect in reversed(scenario.believed.effects.items()):
            if isinstance(effect, SensorEffect):
                known = effect.resolve(self.robot.description, key=f"model.effects.{key}")
                self.motion.signals = self.undone(known, self.remembered(known))
            elif isinstance(effect, TorqueReadingLag) and is_read(effect, scenario.recording):
                lag = effect.resolve(self.robot.description, key=f"model.effects.{key}").linear[0]
                signals = self.motion.signals
                torque = TorqueReadingLag.in_time(signals.torque_command, lag, self.motion.period)
                self.motion.signals = replace(signals, torque_command=torque)
                self.late_torques += lag

    def serves(self, scenario: Scenario) -> bool:
        """Would another scenario read the log alike?"""
        return self._read_by == _reader(scenario)

    def undone(
        self,
        effect: ResolvedSensorEffect,
        memory: np.ndarray,
        signals: SensorSignals | None = None,
    ) -> SensorSignals:
        """Signals that a sensor effect turns into those of the log, or into others.

        Args:
            memory: see `remembered`.
        """
        read = self.motion.signals if signals is None else signals
        return effect.effect.undone(read, memory, effect, self.robot, self.motion.period)

    def remembered(
        self, effect: ResolvedSensorEffect, signals: SensorSignals | None = None
    ) -> np.ndarray:
        """What a sensor effect remembers over the log, or over others, of torques without their
        white noise: it would become an acceleration.

        A simulation of ours begins with no memory; any other log begins as if it had always been as
        it is then.
        """
        motion, signals = self.motion, signals or self.motion.signals
        torque = signals.torque_command
        corners = noise_corners(torque, motion.torque_variance(torque).mean(axis=0), motion.period)
        smooth = [motion.low_passed(t, c) for t, c in zip(torque.T, corners, strict=True)]
        signals = replace(signals, torque_command=np.stack(smooth, axis=1))
        ours = self.log.meta.get("source") in _FORGETFUL and self.log.time[0] == 0.0
        earlier = 0 if ours else round(_EARLIER / motion.period)
        longer = {
            name: np.concatenate([np.repeat(values[:1], earlier, axis=0), values])
            for name, values in vars(signals).items()
        }
        signals = SensorSignals(**longer)
        memory = effect.effect.memory_over_time(signals, effect, self.robot, motion.period)
        return memory[:, earlier:]

    @cached_property
    def joint_motion(self) -> JointMotion:
        """What joint torque effects depend on, step by step, (N - 1, n) each; of rows that are
        sampled at an instant sample by sample, (N, n), for their torques are those of the samples.
        """
        return self.joint_motion_of(self.motion.signals)

    def joint_motion_of(self, signals: SensorSignals) -> JointMotion:
        """The same of other signals."""
        motion = self.motion
        velocity = motion.without_velocity_noise(signals).joint_velocity
        velocity = savgol_filter(velocity, _SMOOTHING, 2, axis=0)
        torque = self._without_noise(signals.torque_command)
        smooth = replace(signals, joint_velocity=velocity, torque_command=torque)
        at: SensorSignals | Instants = smooth
        middle = time = motion.start + np.arange(len(velocity)) * motion.period
        if not motion.recording.is_sampled:
            at, velocity = (
                motion.steps_of(smooth),
                within_steps(velocity, motion.timing.law_share),
            )
            time, middle = time[:-1], time[:-1] + 0.5 * motion.period
        return JointMotion(
            velocity=velocity,
            position=at.joint_position,
            command=at.torque_command,
            time=time[:, None],
            time_step=motion.period,
            load=at.torque_command - self._loss_at(middle, velocity, at.torque_command),
            rotor_inertia=self.robot.rotor_inertias,
        )

    def _without_noise(self, torque: np.ndarray) -> np.ndarray:
        """Torques (N, n) without frequencies in which the log has little but white noise: in a
        regressor it would take off the noise of the residual, which is the same (errors in
        variables). A command of exactly zero stays, for it may be a drive that is off."""
        result = np.empty_like(torque)
        for joint, corner in enumerate(self._torque_corners):
            result[:, joint] = self.motion.low_passed(torque[:, joint], corner)
        return np.where(torque == 0, 0.0, result)

    @cached_property
    def kept_noise(self) -> np.ndarray:
        """Share of the power of each torque's white noise that is left in it where laws take it,
        averaged over blocks, (n,)."""
        highest = 0.5 / (self.motion.length * self.motion.period)
        # A corner of 0 is none.
        return np.array([min(1.0, c / highest) if c > 0 else 1.0 for c in self._torque_corners])

    @cached_property
    def _torque_corners(self) -> list[float]:
        """Frequency above which each joint's torque is little but noise [Hz]; 0 for none."""
        motion = self.motion
        torque = motion.signals.torque_command
        # What is missing in the model has next to no part in the noise of the rows.
        noise = measured_noise(motion, motion.residual, ()).white[: torque.shape[1]]
        variance = motion.torque_variance(torque).mean(axis=0) + noise
        return noise_corners(torque, variance, motion.period)

    def _loss_at(self, time: np.ndarray, velocity: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """What the links do not get of the command by the rigid model at times (M,), smoothed over
        three blocks, (M, n); without frequencies in which velocities are noise, which is that of
        the residual.

        Friction jumps where a joint turns, by an amount that may grow with the torque: what jumps
        so, by least squares, is not smoothed.

        Args:
            velocity, torque: of the joints then, (M, n) [rad/s], [Nm].
        """
        motion, n = self.motion, len(self.robot.joint_names)
        blocks, loss = motion.blocks, motion.residual.value[:, :n]
        noise = _MOVES * joint_velocity_noise(motion.sensors)
        signs = [np.tanh(velocity / (noise + width)) for width in _TURNS]
        jumps = np.stack([s * size for s in signs for size in (1.0, np.abs(torque))])
        of_blocks = np.stack([motion.averages(in_steps(motion.recording, jump)) for jump in jumps])
        jump, of_block = np.empty(velocity.shape), np.empty(loss.shape)
        for k in range(n):
            smooth = [blocks.joint_velocity[:, k], blocks.joint_acceleration[:, k]]
            basis = np.column_stack([*of_blocks[..., k], *smooth, np.ones(len(loss))])
            known = motion.known[:, k] > 0
            size = np.linalg.lstsq(basis[known], loss[known, k])[0][: len(jumps)]
            jump[:, k], of_block[:, k] = size @ jumps[..., k], size @ of_blocks[..., k]
        rest = smoothed(loss - of_block)
        at = np.stack([np.interp(time, motion.time, column) for column in rest.T], axis=1)
        return motion.without_noise(at) + jump


def in_steps(recording: RecordingConfig, values: np.ndarray) -> np.ndarray:
    """Values (N - 1, ...) of every step: those of samples (N, ...) are averaged between neighbours,
    as torques that are sampled."""
    return within_steps(values, 0.5) if recording.is_sampled else values


def is_read(effect: Effect | type[Effect], recording: RecordingConfig) -> bool:
    """Is it a joint torque effect that a log is read by, as torques that are read earlier, and that
    is not taken off the residual?"""
    return effect.needs_sampled_torque and recording.is_sampled


def _reader(scenario: Scenario) -> tuple[Any, ...]:
    """What a reading depends on in a scenario."""
    model = scenario.believed
    bodies = {
        name: effect
        for name, effect in model.effects.items()
        if is_read(effect, scenario.recording)
        or not isinstance(effect, JointTorqueEffect | GroundEffect)
    }
    recording = scenario.recording
    model = replace(model, effects=bodies)
    return model, scenario.sensors, recording, scenario.reference, scenario.control


def smoothed(values: np.ndarray) -> np.ndarray:
    """Binomial smoothing over three blocks."""
    padded = np.concatenate([values[:1], values, values[-1:]])
    return 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
