"""What recorded joint velocities are worth, by the angles beside them.

Those that come out of a low-pass, or are differences to the angle before, are late, and inertia
looks like friction with them. Those of a coarse encoder are wrong, and a joint that turns has
friction of either sign for all they tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter, savgol_filter
from scipy.stats import t as student

from fbse_drake.discrepancy.residual.blocks import block_means

# Angles and velocities are compared over windows of this length [s], of which there must be so
# many with so many samples each.
_WINDOW, _FEWEST_WINDOWS, _FEWEST_SAMPLES = 2.0, 4, 20
# Probability of calling the velocity of a joint late by chance.
_FALSE_ALARM = 1e-4
# What is later than this is no filter's [s].
_LATEST = 0.05
# Angles are smoothed by polynomials of this order over times of these lengths [s], and velocities
# over this one.
_ORDER, _SMOOTHING, _SMOOTHED = 3, (0.02, 0.05, 0.1, 0.2), 0.1
# A recorder that filters velocities is taken to read so many angles while its filter lags.
_READINGS = 8
# A velocity that is a difference of the angles that it stands beside differs from that by less than
# this share of what two such differences differ by.
_SAME = 0.1


@dataclass(frozen=True)
class Lateness:
    """By how much the velocity of each joint comes after its angle [s], and the standard deviation
    of that by its own motion, (n,) each; 0 where it does not for sure, nor as the others do."""

    seconds: np.ndarray
    deviation: np.ndarray

    @staticmethod
    def none(joints: int) -> "Lateness":
        """All in time."""
        return Lateness(*np.zeros((2, joints)))

    @staticmethod
    def of(
        position: np.ndarray, velocity: np.ndarray, period: float, stretches: Sequence[slice]
    ) -> "Lateness":
        """Compares angles with what velocities add up to.

        The integral of what is late by d falls behind its angle by d times the velocity. What
        scales or offsets a velocity falls behind otherwise. Each window has its own offset and
        drift; by how much the windows differ is the doubt (cluster-robust, Liang and Zeger 1986).

        Args:
            position, velocity: (N, n) [rad, rad/s] or [m, m/s], on an even grid.
            stretches: runs of samples without gaps.
        """
        count = max(round(_WINDOW / period), _FEWEST_SAMPLES)
        windows = [
            slice(start, start + count)
            for stretch in stretches
            for start in range(stretch.start, stretch.stop - count + 1, count)
        ]
        joints = position.shape[1]
        if len(windows) < _FEWEST_WINDOWS:
            return Lateness.none(joints)
        behind, motion = np.zeros((2, len(windows), count, joints))
        # In a regressor noise would make the delay smaller.
        span = 2 * round(0.5 * _SMOOTHED / period) + 1
        smooth = savgol_filter(velocity, span, _ORDER, axis=0) if span > _ORDER + 1 else velocity
        for k, window in enumerate(windows):
            q, v = position[window], velocity[window]
            gap = q - cumulative_trapezoid(v, dx=period, axis=0, initial=0.0)
            for j in range(joints):
                nuisance = np.vander(np.arange(count) / count, 2)
                nuisance = np.column_stack([nuisance, q[:, j] - q[:, j].mean()])
                both = np.column_stack([gap[:, j], smooth[window, j]])
                left = both - nuisance @ np.linalg.lstsq(nuisance, both, rcond=None)[0]
                behind[k, :, j], motion[k, :, j] = left.T
        information = (motion**2).sum(axis=(0, 1))
        seconds = np.divide(
            (motion * behind).sum(axis=(0, 1)),
            information,
            out=np.zeros(joints),
            where=information > 0,
        )
        score = (motion * (behind - seconds * motion)).sum(axis=1)
        spread = np.sqrt((score**2).sum(axis=0) * len(windows) / (len(windows) - 1))
        deviation = np.divide(spread, information, out=np.zeros(joints), where=information > 0)
        # Of few windows their spread is not known well.
        sure = student.isf(0.5 * _FALSE_ALARM, len(windows) - 1) * deviation
        is_late = (np.abs(seconds) > sure) & (np.abs(seconds) < _LATEST)
        late = np.where(is_late, seconds, 0.0)
        if is_late.any():
            # One recorder has all joints: where this is not told well, the others tell.
            mean = np.average(seconds[is_late], weights=deviation[is_late] ** -2.0)
            agrees = (information > 0) & (np.abs(seconds - mean) <= sure)
            late = np.where(agrees & ~is_late, mean, late)
        return Lateness(late, deviation)

    def in_time(
        self, velocity: np.ndarray, known: np.ndarray, period: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Velocities (N, n) as they were at the time of their angles, interpolated linearly.

        Args:
            known: samples that are measured, (N,).

        Returns:
            The velocities, and where they come from samples that are known, (N,).
        """
        samples = np.arange(len(velocity))
        result, weight = np.empty_like(velocity), known.astype(float)
        for joint, late in enumerate(self.seconds):
            at = samples + late / period
            result[:, joint] = np.interp(at, samples, velocity[:, joint])
            weight = np.minimum(weight, np.interp(at, samples, known, left=0.0, right=0.0))
        return result, weight == 1.0

    def rounding_error(self, counts: np.ndarray, period: float) -> np.ndarray:
        """What rounding adds to velocities that come late by a filter of first order behind rounded
        angles, which it reads much oftener than it writes, when they are in time again [counts/s].

        Args:
            counts: angles in steps of their encoders, (N, n).
        """
        samples, error = np.arange(len(counts)), np.zeros_like(counts)
        for joint in np.flatnonzero(self.seconds > 0):
            late = self.seconds[joint]
            finer = int(np.ceil(_READINGS * period / late))
            fine = np.arange((len(counts) - 1) * finer + 1) / finer
            rounded = rounding_error(np.interp(fine, samples, counts[:, joint]))
            kept = np.exp(-period / finer / late)
            slow, _ = lfilter([1.0 - kept], [1.0, -kept], rounded, zi=kept * rounded[:1])
            error[:, joint] = ((rounded - slow) / late)[::finer]
        return self.in_time(error, np.ones(len(counts), dtype=bool), period)[0]


def rounding_error(counts: np.ndarray) -> np.ndarray:
    """Of angles in steps of their encoders, in such steps."""
    return np.round(counts) - counts


def velocity_error(
    position: np.ndarray,
    velocity: np.ndarray,
    period: float,
    stretches: Sequence[slice],
    length: int,
) -> np.ndarray:
    """Standard deviation of the mean error of each joint's velocity over a block, (n,).

    By what differs from the rate of the smoothed angles (Savitzky and Golay 1964). Smoothed too
    little, that is as noisy; too much, it lags behind what moves: the least difference counts.

    Args:
        position, velocity: (N, n), on an even grid.
        stretches: runs of samples without gaps.
        length: of a block [samples].
    """
    found = []
    for time in _SMOOTHING:
        window = 2 * round(0.5 * time / period) + 1
        if window <= _ORDER + 1:
            continue
        errors = [
            block_means(
                velocity[stretch]
                - savgol_filter(position[stretch], window, _ORDER, deriv=1, delta=period, axis=0),
                length,
            )
            for stretch in stretches
            if stretch.stop - stretch.start >= max(window, length)
        ]
        if errors:
            found.append(np.sqrt((np.concatenate(errors) ** 2).mean(axis=0)))
    return np.min(found, axis=0) if found else np.zeros(position.shape[1])


def are_differences(time: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> bool:
    """Are the velocities nothing but differences of the angles beside them, to the one before or
    between both neighbours?

    Args:
        time: (N,) [s]; position, velocity: (N, n).
    """
    if len(time) < _FEWEST_SAMPLES:
        return False
    backward = (np.diff(position, axis=0) / np.diff(time)[:, None])[:-1]
    central = (position[2:] - position[:-2]) / (time[2:] - time[:-2])[:, None]
    read = velocity[1:-1]
    apart = ((backward - central) ** 2).mean(axis=0)
    nearest = np.minimum(
        ((read - backward) ** 2).mean(axis=0), ((read - central) ** 2).mean(axis=0)
    )
    moving = apart > 0
    return bool(moving.any() and (nearest[moving] < _SAME**2 * apart[moving]).all())
