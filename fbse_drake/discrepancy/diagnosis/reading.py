"""A log as the bodies and sensors of a model read it: what models have in common that differ in
effects which are taken off the residual."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

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
from fbse_drake.effects.effect import Effect, ResolvedEffect
from fbse_drake.effects.joint_torque import (
    JointMotion,
    JointTorqueEffect,
    ResolvedJointTorque,
    law_over_time,
)
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
# It is friction that explains this share of what command and acceleration leave over in a joint;
# play in a gear, which takes the command while the motor crosses it, looks like friction to less.
_IS_FRICTION = 0.9
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
        # A model whose inertia is not trusted does not know what passes the gears.
        self._knows_load = not scenario.identify.inertia
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
        laws = friction_laws(
            scenario.believed.effects_of(JointTorqueEffect, self.robot.description, key="model")
        )
        # What came last into the readings goes first.
        for key, effect in reversed(scenario.believed.effects.items()):
            if isinstance(effect, SensorEffect):
                known = effect.resolve(self.robot.description, key=f"model.effects.{key}")
                self.motion.signals = self._undone_here(known, laws)
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
        self, effect: ResolvedSensorEffect, memory: np.ndarray, signals: SensorSignals
    ) -> SensorSignals:
        """Signals that a sensor effect turns into others, see `loaded`.

        Args:
            memory: see `remembered`.
        """
        return effect.effect.undone(signals, memory, effect, self.robot, self.motion.period)

    def _undone_here(
        self, effect: ResolvedSensorEffect, laws: Sequence[ResolvedJointTorque]
    ) -> SensorSignals:
        """Signals that a sensor effect turns into those of the log as they are until now."""
        # What is found of them is not kept: they change.
        now = copy(self)
        now.motion = copy(self.motion)
        signals = now.motion.signals
        if effect.effect.follows_load():
            signals = now.loaded(signals, now.joint_motion, laws)
        return now.undone(effect, now.remembered(effect, signals), signals)

    def remembered(self, effect: ResolvedSensorEffect, signals: SensorSignals) -> np.ndarray:
        """What a sensor effect remembers over the log with other signals, see `loaded`.

        A simulation of ours begins with no memory; any other log begins as if it had always been as
        it is then.
        """
        earlier = 0 if self._begins_anew else round(_EARLIER / self.motion.period)
        longer = {
            name: np.concatenate([np.repeat(values[:1], earlier, axis=0), values])
            for name, values in vars(signals).items()
        }
        signals = SensorSignals(**longer)
        memory = effect.effect.memory_over_time(signals, effect, self.robot, self.motion.period)
        return memory[:, earlier:]

    @property
    def _begins_anew(self) -> bool:
        """Was nothing before the log?"""
        return self.log.meta.get("source") in _FORGETFUL and self.log.time[0] == 0.0

    @cached_property
    def has_load_of_motion(self) -> np.ndarray:
        """Of which joints what passes the gear is taken from the motion, see `loaded`, (n,)."""
        n = len(self.robot.joint_names)
        if not (self._knows_load and self.motion.recording.is_sampled):
            return np.zeros(n, dtype=bool)
        loss, moved = self.motion.residual.value[:, :n], self.joint_motion
        friction = self._friction(loss, moved.velocity, np.asarray(moved.command))
        return self._is_friction(loss, friction)

    def loaded(
        self,
        signals: SensorSignals,
        joint_motion: JointMotion,
        laws: Sequence[ResolvedJointTorque],
    ) -> SensorSignals:
        """Signals with the torque that passes the gears, without white noise: it would become an
        acceleration.

        In steps it is the command less what rotors need to accelerate and less friction, as the
        model's laws say and as what they leave over looks like. Of rows that are sampled at an
        instant, in joints with friction, it is what the links need by the rigid model: so it is not
        the friction, which jumps, that must be known. (A link on a spring so soft that they swing
        together needs another torque than a rigid one; without friction that is what is commanded,
        less the rotor's.)

        Args:
            joint_motion: of these signals, see `joint_motion_of`.
            laws: of the model, see `friction_laws`.
        """
        load = np.asarray(joint_motion.command)
        if self._knows_load:
            load = load - self._rotor_torque(signals)
        if self.motion.recording.is_sampled:
            if self.has_load_of_motion.any():
                load = np.where(self.has_load_of_motion, self._needed_load(signals), load)
            begin, end = np.concatenate([load[:1], load[:-1]]), load
        else:
            if self._knows_load:
                load = load - self._friction_in(joint_motion, laws)
            first = np.zeros_like(load[:1]) if self._begins_anew else load[:1]
            begin = end = np.concatenate([first, load])[: len(signals.joint_position)]
        return replace(signals, load_begin=begin, load_end=end)

    def _friction_in(
        self, joint_motion: JointMotion, laws: Sequence[ResolvedJointTorque]
    ) -> np.ndarray:
        """What friction takes in every step, (N - 1, n) [Nm]: the model's laws, and in joints where
        what they leave looks like friction, that."""
        of_laws, velocity = law_over_time(laws, joint_motion), joint_motion.velocity
        left = self.motion.residual.value[:, : velocity.shape[1]] - self.motion.averages(of_laws)
        friction = self._friction(left, velocity, np.asarray(joint_motion.command))
        more = friction.dry + friction.viscous * velocity
        return of_laws + np.where(self._is_friction(left, friction), more, 0.0)

    def _is_friction(self, loss: np.ndarray, friction: "_Friction") -> np.ndarray:
        """Is a loss in joints what in it looks like friction, (n,)?

        Args:
            loss: averages over blocks, (B, n) [Nm].
        """
        blocks, result = self.motion.blocks, np.zeros(loss.shape[1], dtype=bool)
        of_blocks = friction.dry_of_blocks + friction.viscous * blocks.joint_velocity
        for k, known in enumerate(self.motion.known[:, : len(result)].T > 0):
            other = [blocks.torque_command[:, k], blocks.joint_acceleration[:, k]]
            basis = np.column_stack([*other, np.ones(len(loss)), of_blocks[:, k]])[known]
            without, beside = (
                np.sum((loss[known, k] - part @ np.linalg.lstsq(part, loss[known, k])[0]) ** 2)
                for part in (basis[:, :-1], basis)
            )
            result[k] = beside <= (1.0 - _IS_FRICTION) * without
        return result

    def _needed_load(self, signals: SensorSignals) -> np.ndarray:
        """What the links need at every sample by the rigid model, without noise, (N, n) [Nm]."""
        needed = self._link_torque(signals)
        at_samples = np.concatenate([needed[:1], within_steps(needed, 0.5), needed[-1:]])
        smooth = [
            self.motion.low_passed(column, corner)
            for column, corner in zip(at_samples.T, self._load_corners, strict=True)
        ]
        return self.motion.without_noise(np.stack(smooth, axis=1))

    def _link_torque(self, signals: SensorSignals) -> np.ndarray:
        """What the links need in every step by the rigid model, without rotors, (N - 1, n) [Nm]."""
        steps, n = self.motion.steps_of(signals), len(self.robot.joint_names)
        needed = steps.torque_command - self.motion.equation.residual(steps)[:, :n]
        return needed - self.robot.rotor_inertias * steps.joint_acceleration

    def _rotor_torque(self, signals: SensorSignals) -> np.ndarray:
        """What rotors need to accelerate with their joints, without noise, in every step (N - 1, n)
        or, of rows that are sampled at an instant, at every sample (N, n) [Nm]."""
        corners = zip(self._accelerations(signals).T, self._acceleration_corners, strict=True)
        smooth = [self.motion.low_passed(column, corner) for column, corner in corners]
        torque = self.robot.rotor_inertias * np.stack(smooth, axis=1)
        return torque if self.motion.recording.is_sampled else torque[:-1]

    def _accelerations(self, signals: SensorSignals) -> np.ndarray:
        """Of the joints at every sample or, where rows are steps, in the step that begins there,
        after the last as in it, (N, n) [rad/s^2]."""
        velocity = signals.joint_velocity
        if self.motion.recording.is_sampled:
            return np.gradient(velocity, axis=0) / self.motion.period
        steps = np.diff(velocity, axis=0)
        return np.concatenate([steps, steps[-1:]]) / self.motion.period

    @cached_property
    def _acceleration_corners(self) -> list[float]:
        """Frequency above which each joint's acceleration is little but noise of its velocity [Hz];
        0 for none."""
        accelerations = self._accelerations(self.motion.signals)
        variance = np.full(accelerations.shape[1], joint_velocity_noise(self.motion.sensors) ** 2)
        return noise_corners(accelerations, variance, self.motion.period, of_rates=True)

    @cached_property
    def _load_corners(self) -> list[float]:
        """Frequency above which what each link needs is little but noise of the velocities that
        are believed to have any [Hz]; 0 for none."""
        motion, signals = self.motion, self.motion.signals
        velocity, period = signals.joint_velocity, motion.period
        noise = joint_velocity_noise(motion.sensors)
        noise = noise * np.random.default_rng(0).standard_normal(velocity.shape)
        needed = self._link_torque(signals)
        change = self._link_torque(replace(signals, joint_velocity=velocity + noise)) - needed
        # An acceleration is a difference of velocities.
        variance = 0.5 * period**2 * change.var(axis=0)
        return noise_corners(needed, variance, period, of_rates=True)

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
        load = at.torque_command
        if self._knows_load:
            load = load - self._loss_at(middle, velocity, load)
        return JointMotion(
            velocity=velocity,
            position=at.joint_position,
            command=at.torque_command,
            time=time[:, None],
            time_step=motion.period,
            load=load,
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
        the residual. What jumps as dry friction does is not smoothed.

        Args:
            velocity, torque: of the joints then, (M, n) [rad/s], [Nm].
        """
        motion, loss = self.motion, self.motion.residual.value[:, : velocity.shape[1]]
        friction = self._friction(loss, velocity, torque)
        rest = smoothed(loss - friction.dry_of_blocks)
        at = np.stack([np.interp(time, motion.time, column) for column in rest.T], axis=1)
        return motion.without_noise(at) + friction.dry

    def _friction(self, loss: np.ndarray, velocity: np.ndarray, torque: np.ndarray) -> "_Friction":
        """What looks like friction in a loss, by least squares. Dry friction jumps where a joint
        turns, by an amount that may grow with the torque.

        Args:
            loss: averages over blocks, (B, n) [Nm].
            velocity, torque: of the joints at times or in steps, (M, n) [rad/s], [Nm].
        """
        motion, n, blocks = self.motion, len(self.robot.joint_names), self.motion.blocks
        noise = _MOVES * joint_velocity_noise(motion.sensors)
        signs = [np.tanh(velocity / (noise + width)) for width in _TURNS]
        jumps = np.stack([s * size for s in signs for size in (1.0, np.abs(torque))])
        of_blocks = np.stack([motion.averages(in_steps(motion.recording, jump)) for jump in jumps])
        found = _Friction(np.empty(velocity.shape), np.empty(loss.shape), np.empty(n))
        for k in range(n):
            smooth = [blocks.joint_velocity[:, k], blocks.joint_acceleration[:, k]]
            basis = np.column_stack([*of_blocks[..., k], *smooth, np.ones(len(loss))])
            known = motion.known[:, k] > 0
            sizes = np.linalg.lstsq(basis[known], loss[known, k])[0]
            *dry, viscous = sizes[: len(jumps) + 1]
            found.dry[:, k] = dry @ jumps[..., k]
            found.dry_of_blocks[:, k] = dry @ of_blocks[..., k]
            found.viscous[k] = viscous
        return found


class _Friction(NamedTuple):
    """What looks like friction in joints."""

    # Dry friction, (M, n), and its averages over blocks, (B, n) [Nm].
    dry: np.ndarray
    dry_of_blocks: np.ndarray
    # Viscous friction, (n,) [Nm s/rad].
    viscous: np.ndarray


def in_steps(recording: RecordingConfig, values: np.ndarray) -> np.ndarray:
    """Values (N - 1, ...) of every step: those of samples (N, ...) are averaged between neighbours,
    as torques that are sampled."""
    return within_steps(values, 0.5) if recording.is_sampled else values


def is_read(effect: Effect | type[Effect], recording: RecordingConfig) -> bool:
    """Is it a joint torque effect that a log is read by, as torques that are read earlier, and that
    is not taken off the residual?"""
    return effect.needs_sampled_torque and recording.is_sampled


def friction_laws(effects: Iterable[ResolvedEffect]) -> list[ResolvedJointTorque]:
    """Those of some effects that take of the joints' torques before these pass the gears."""
    return [e for e in effects if isinstance(e, ResolvedJointTorque) and not e.effect.deflects]


def _reader(scenario: Scenario) -> tuple[Any, ...]:
    """What a reading depends on in a scenario."""
    model = scenario.believed
    # What passes a gear, which an encoder may follow, depends on the friction.
    follows = any(isinstance(e, SensorEffect) and e.follows_load() for e in model.effects.values())
    other = GroundEffect if follows else JointTorqueEffect | GroundEffect
    bodies = {
        name: effect
        for name, effect in model.effects.items()
        if is_read(effect, scenario.recording) or not isinstance(effect, other)
    }
    recording = scenario.recording
    model = replace(model, effects=bodies)
    trusted = not scenario.identify.inertia
    return model, scenario.sensors, recording, scenario.reference, scenario.control, trusted


def smoothed(values: np.ndarray) -> np.ndarray:
    """Binomial smoothing over three blocks."""
    padded = np.concatenate([values[:1], values, values[-1:]])
    return 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
