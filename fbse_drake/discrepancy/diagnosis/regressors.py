"""Averages of a log at which a model is differentiated.

Regressors are measured as the residual is, with the same noise (errors in variables). It is kept
out of them as far as it can be; what is left in them all the same shows in signals that have it
once more.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from fbse_drake.discrepancy.diagnosis.reading import smoothed
from fbse_drake.discrepancy.identification.inertial import inertial_regressor
from fbse_drake.discrepancy.residual.equation_of_motion import joint_velocity_noise
from fbse_drake.discrepancy.residual.noise import Noise
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants, averaged
from fbse_drake.effects.sensor import SensorSignals
from fbse_drake.sensors.foot_force import force_noise


class Regressors:
    """Averages of some signals, and what the model's equation of motion leaves at them, (B, R)."""

    def __init__(self, motion: RecordedMotion, signals: SensorSignals):
        """
        Args:
            signals: of the log, or others on the same grid.
        """
        self._motion, self.signals = motion, signals
        self._of_bodies: dict[str, np.ndarray] = {}

    @cached_property
    def _blocks(self) -> Instants:
        return averaged(self._motion.steps_of(self.signals), self._motion.length)

    @property
    def residual(self) -> np.ndarray:
        """At averages as they are measured."""
        return self._motion.equation.residual(self._blocks)

    @cached_property
    def smooth_blocks(self) -> Instants:
        """Averages without the noise of velocities, and with smoothed accelerations."""
        return self._smoothed(self._motion.quiet_blocks_of(self.signals))

    @cached_property
    def smooth_residual(self) -> np.ndarray:
        """At these."""
        return self._motion.equation.residual(self.smooth_blocks)

    def of_body(self, name: str) -> np.ndarray:
        """Regressor of a body's inertial parameters at these, see `inertial_regressor`."""
        if name not in self._of_bodies:
            self._of_bodies[name] = inertial_regressor(
                self._motion.equation, self.smooth_blocks, name
            )
        return self._of_bodies[name]

    def _smoothed(self, blocks: Instants) -> Instants:
        """Averages with accelerations that are smoothed further, for their noise is in the residual
        too. Not those of a recording that is low-passed: little noise is left in them, and
        smoothing would take motion."""
        if self._motion.recording.cutoff > 0:
            return blocks
        smooth = {
            name: smoothed(getattr(blocks, name))
            for name in ("joint_acceleration", "angular_acceleration")
        }
        return replace(blocks, **smooth)

    @cached_property
    def impact_blocks(self) -> Instants:
        """Averages with accelerations from which only noise is taken: of what smoothing takes off,
        the share is left that noise does not explain, by joint and axis (N. Wiener,
        "Extrapolation, Interpolation, and Smoothing of Stationary Time Series", 1949).

        Smoothing would make an impact smaller, and a place larger that is told by impacts.
        """
        blocks, motion, sensors = self._blocks, self._motion, self._motion.sensors
        smooth_blocks = self._smoothed(blocks)
        noise = {
            "joint_acceleration": joint_velocity_noise(sensors),
            "angular_acceleration": sensors.imu.angular_velocity_noise,
        }
        result = {}
        for name, deviation in noise.items():
            smooth = getattr(smooth_blocks, name)
            rough = getattr(blocks, name) - smooth
            # Velocities at both ends of three blocks count 1, -3, 3 and -1 quarters.
            noisy = 1.25 * (deviation / (motion.length * motion.period)) ** 2
            power = np.maximum(np.mean(rough**2, axis=0), noisy)
            share = np.divide(noisy, power, out=np.zeros_like(power), where=power > 0)
            result[name] = smooth + rough * (1.0 - share)
        return replace(blocks, **result)

    @cached_property
    def impact_residual(self) -> np.ndarray:
        """At these."""
        return self._motion.equation.residual(self.impact_blocks)


def noisier_signals(motion: RecordedMotion, noise: Noise) -> SensorSignals:
    """A log's signals if the sensors' noise were in them once more.

    Args:
        noise: of the rows, beyond what is believed.
    """
    random, sensors, read = np.random.default_rng(0), motion.sensors_by_row, motion.signals
    deviations = {
        "joint_velocity": joint_velocity_noise(sensors),
        "specific_force": sensors.imu.acceleration_noise,
        "angular_velocity": sensors.imu.angular_velocity_noise,
    }
    noisier = {}
    for name, deviation in deviations.items():
        values = getattr(read, name)
        noisier[name] = values + deviation * random.standard_normal(values.shape)
    force = force_noise(sensors.foot_force, motion.robot, len(read.pad_force), random)
    torque = read.torque_command
    deviation = np.sqrt(motion.torque_variance(torque) + noise.white[: torque.shape[1]])
    return replace(
        read,
        pad_force=read.pad_force + force,
        torque_command=torque + deviation * random.standard_normal(torque.shape),
        **noisier,
    )
