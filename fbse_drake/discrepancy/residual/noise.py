"""How noisy the rows of a residual are: white noise shows in differences of neighbours, of which
what is missing in a model has next to nothing."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import toeplitz
from scipy.special import comb
from scipy.stats import chi2

from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.evidence import HygieneFinding, NoiseLevel, remark
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import differences_angles
from fbse_drake.discrepancy.residual.residual import Residual, rms
from fbse_drake.log import Log
from fbse_drake.scenario import RecordingConfig, SensorsConfig
from fbse_drake.sensors.motor_encoders import MotorEncoderConfig

# Order of the differences of neighbours, and their number in a window.
_ORDER, _WINDOW = 4, 20
# Impacts and trembling joints are no noise: this quantile of windows, and of a channel's
# components, counts. It is as good as the mean of that share of the windows.
_QUIET, _EFFICIENCY = 0.25, 0.54
# Orders at which a channel's noise is measured, which agree within this factor if it is white:
# of motion the lower shows more, of a joint that rings from sample to sample the higher.
_ORDERS, _WHITE = (3, 6), 1.1
# Smallest factor of a row's noise that is worth a word, and probability of saying so of any by
# chance.
_LEAST, _FALSE_ALARM = 1.15, 1e-3
# Averages over so many blocks show noise, and how many deviations more it may be at each.
_SCALES, _SURE = (1, 2, 4, 8), 2.0
# The same of a channel, in which motion that is as fast as noise may be most of the excess.
_LEAST_OF_CHANNEL = 1.3
# Variance below which a row without any noise is rounding.
_ROUNDING = 1e-18
# Share of the torque below which noise that nobody believes in is not worth a word.
_NEGLIGIBLE = 1e-3


@dataclass(frozen=True)
class Noise:
    """What a log shows of its white noise beyond what is believed."""

    # Channels of sensors that are noisier.
    channels: tuple[NoiseLevel, ...]
    # Variance of a step's white noise to be added in each of R rows to that of the sensors, (R,),
    # and by what that is larger than believed, (R,).
    white: np.ndarray
    sensors: np.ndarray
    # What averages over blocks differ from their neighbours, over what is believed; 1 where that
    # may be right, (R,).
    factor: np.ndarray

    def with_more(self, other: "Noise") -> "Noise":
        """With what is more than this."""
        return Noise(
            self.channels,
            self.white * other.sensors + other.white,
            self.sensors * other.sensors,
            self.factor * other.factor,
        )

    def in_rows(self, rows: np.ndarray) -> "Noise":
        """The same in these rows alone."""
        others = np.setdiff1d(np.arange(len(self.white)), rows)
        white, sensors, factor = self.white.copy(), self.sensors.copy(), self.factor.copy()
        white[others], sensors[others], factor[others] = 0.0, 1.0, 1.0
        return Noise(self.channels, white, sensors, factor)

    def added_to(self, residual: Residual, length: int) -> Residual:
        """A residual with this noise, of blocks of so many steps."""
        return replace(
            residual,
            variance=self.sensors * residual.variance + self.white / length,
            covariance=self.sensors * residual.covariance,
        )


@dataclass(frozen=True)
class Power:
    """Variance of white noise over what is believed, and its degrees of freedom, (R,) each; NaN
    where nobody knows."""

    ratio: np.ndarray
    freedom: np.ndarray


def noise_power(
    values: np.ndarray,
    known: np.ndarray,
    believed: np.ndarray,
    order: int = _ORDER,
) -> Power:
    """Compares differences of neighbours with what is believed of them, in windows.

    Args:
        values, known: (N, R) each.
        believed: mean square of a difference, normalised for white noise, (N, R).
        order: of the differences.
    """
    differences = np.diff(values, order, axis=0) / np.sqrt(comb(2 * order, order))
    gaps = np.cumsum(np.vstack([np.zeros((1, known.shape[1])), ~known]), axis=0)
    whole = gaps[order + 1 :] == gaps[: -order - 1]
    lags = np.arange(_WINDOW)
    correlation = np.where(
        lags <= order, comb(2 * order, order + lags) / comb(2 * order, order), 0.0
    )
    # Of the mean of so many squares that are correlated like this.
    freedom = _WINDOW**2 / (toeplitz(correlation) ** 2).sum()
    typical = chi2.ppf(_QUIET, freedom) / freedom
    ratio, windows = np.full((2, known.shape[1]), np.nan)
    for row in range(known.shape[1]):
        index = np.flatnonzero(whole[:, row])
        count = len(index) // _WINDOW
        if count < 2:
            continue
        windowed = index[: count * _WINDOW].reshape(count, _WINDOW)
        expected = believed[windowed + order // 2, row].mean(axis=1)
        power = (differences[windowed, row] ** 2).mean(axis=1)
        ratio[row] = np.quantile(power / np.maximum(expected, _ROUNDING), _QUIET) / typical
        windows[row] = count
    return Power(ratio, _EFFICIENCY * freedom * windows)


def measured_sensors(
    sensors: SensorsConfig, recording: RecordingConfig, log: Log
) -> tuple[SensorsConfig, tuple[NoiseLevel, ...]]:
    """Sensors with the noise that their channels have where it is more than is believed, and these
    channels. Torques are left out: they answer the noise of sensors, and are none for that."""
    encoders, imu, feet = sensors.encoders, sensors.imu, sensors.foot_force
    differenced = differences_angles(recording, log)
    usual = ("joint/velocity", "imu/linear_acceleration", "imu/angular_velocity")
    believed = dict(
        zip(
            usual,
            (encoders.velocity_noise, imu.acceleration_noise, imu.angular_velocity_noise),
            strict=True,
        )
    )
    for name in log.channels:
        if name.startswith("foot/") and name.endswith(("/pad_force", "/wrench")):
            believed[name] = feet.noise
    if encoders.velocity != "exact" or differenced:
        del believed["joint/velocity"]
    second = sensors.motor_encoders or MotorEncoderConfig(encoders.resolution, encoders.noise)
    if "joint/motor_position" in log:
        believed["joint/motor_position"] = second.angle_noise
    if "joint/motor_position" in log or differenced:
        believed["joint/position"] = encoders.angle_noise
    noisier = []
    for name, expected in believed.items():
        level = channel_noise(log, name) if name in log else np.nan
        if level > _LEAST_OF_CHANNEL * expected:
            noisier.append(NoiseLevel(name, level, log.unit(name), expected))
    level_of = believed | {noise.channel: noise.level for noise in noisier}
    feet_level = max((v for name, v in level_of.items() if name.startswith("foot/")), default=0.0)
    # Beside the rounding.
    of_link, of_motor = (
        float(np.sqrt(max(level_of.get(name, 0.0) ** 2 - encoder.resolution**2 / 12.0, 0.0)))
        for name, encoder in (("joint/position", encoders), ("joint/motor_position", second))
    )
    read = replace(encoders, noise=max(of_link, encoders.noise))
    velocity = level_of.get("joint/velocity", encoders.velocity_noise)
    if differenced and recording.cutoff == 0:
        of_angles = read.angle_noise / (np.sqrt(2) * float(log.meta["period"]))
        read, velocity = replace(read, velocity="exact"), max(velocity, of_angles)
    measured = replace(
        sensors,
        encoders=replace(read, velocity_noise=velocity),
        motor_encoders=replace(second, noise=max(of_motor, second.noise)),
        imu=replace(
            imu,
            acceleration_noise=level_of["imu/linear_acceleration"],
            angular_velocity_noise=level_of["imu/angular_velocity"],
        ),
        foot_force=replace(feet, noise=max(feet_level, feet.noise)),
    )
    return measured, tuple(noisier)


def channel_noise(log: Log, name: str) -> float:
    """Standard deviation of the white noise of a channel's quieter components; NaN if not white."""
    values = log[name].reshape(len(log.time), -1)
    values = values[:, 3:] if name.endswith("/wrench") else values
    known = np.ones(len(log.time), dtype=bool)
    known[1:] = np.diff(log.time) < 1.5 * float(log.meta["period"])
    known = np.repeat(known[:, None], values.shape[1], axis=1)
    low, high = (
        np.sqrt(noise_power(values, known, np.ones(values.shape), order).ratio) for order in _ORDERS
    )
    white = (low < _WHITE * high) & (high < _WHITE * low)
    return float(np.quantile(high[white], _QUIET)) if white.any() else np.nan


@dataclass(frozen=True)
class _Level:
    """What a residual's averages over some blocks show of white noise, (R,) each."""

    power: Power
    # Mean square of a difference that is believed, normalised for white noise.
    typical: np.ndarray
    # Variance of a block's white noise beyond that, and what it is at most.
    excess: np.ndarray
    bound: np.ndarray
    # More than this ratio is neither chance nor too little to matter.
    least: np.ndarray

    @property
    def is_shown(self) -> np.ndarray:
        """Does it show any?"""
        return self.power.ratio > self.least


def _level(residual: Residual, blocks: int) -> _Level:
    """Of averages over so many blocks.

    What the noise of angles and velocities makes of accelerations ends in the longer ones, where
    that of the torques is left.
    """
    known = block_means(residual.known, blocks) == 1.0
    variance, covariance = (
        block_means(values, blocks) for values in (residual.variance, residual.covariance)
    )
    variance = variance / blocks + 2 * (blocks - 1) / blocks**2 * covariance
    between = 2 * _ORDER / (_ORDER + 1) * covariance / blocks**2
    believed = np.maximum(variance - between, _ROUNDING)
    value = block_means(np.where(residual.known, residual.value, 0.0), blocks)
    power = noise_power(value, known, believed)
    typical = np.nan_to_num(rms(np.sqrt(believed), known)) ** 2
    doubt = _SURE * np.sqrt(2 / power.freedom) * power.ratio
    least = chi2.isf(_FALSE_ALARM / known.shape[1], power.freedom) / power.freedom
    return _Level(
        power,
        typical,
        (power.ratio - 1) * typical * blocks,
        (power.ratio - 1 + doubt) * typical * blocks,
        np.maximum(least, _LEAST**2),
    )


def measured_noise(
    motion: RecordedMotion,
    residual: Residual,
    channels: tuple[NoiseLevel, ...],
) -> Noise:
    """Noise of rows whose averages over blocks differ more from their neighbours than is believed.

    Torques that are sampled have noise that nobody may know, which shows best in longer averages.
    What the torques of some joints have more than is believed, those of others are taken to have,
    too, if it would not show in them.

    Args:
        residual: of the log, less the effects that are known.
        channels: that are noisier than the scenario believes; the residual's noise is theirs.
    """
    length, rows = motion.length, residual.value.shape[1]
    missed = np.zeros(rows)
    missed[: len(motion.robot.joint_names)] = missed_torque(motion)
    believed = replace(residual, variance=residual.variance + missed / length)
    is_sampled = motion.recording.is_sampled
    levels = [_level(believed, blocks) for blocks in (_SCALES if is_sampled else (1,))]
    # White noise is no more than what any of them shows.
    bounds = np.nan_to_num([level.bound for level in levels], nan=np.inf)
    shown = np.array([level.is_shown for level in levels])
    tightest = np.argmin(np.where(shown, bounds, np.inf), axis=0)
    excess = np.array([level.excess for level in levels])[tightest, np.arange(rows)]
    # A rotor that goes to and fro in its gap is no noise: that of encoders their channels tell.
    turns = np.array([row.kind == "transmission" for row in residual.rows])
    noisy = shown.any(axis=0) & ~turns
    more = np.where(noisy, np.minimum(excess, bounds.min(axis=0)).clip(min=0.0), 0.0)
    white = missed + more * length
    # What neighbours differ by beside that is the sensors'.
    power, typical = levels[0].power, levels[0].typical
    added = np.divide(more, typical, out=np.zeros(rows), where=typical > 0)
    beside = power.ratio - added
    sensors = np.where(noisy & (beside > levels[0].least), beside, 1.0)
    ratio = sensors + added

    torque = motion.torque_variance(motion.blocks.torque_command)
    n = torque.shape[1]
    torque = np.nan_to_num(rms(np.sqrt(torque), residual.known[:, :n])) ** 2
    telling = noisy[:n] & (torque > 0)
    if telling.any():
        share = float(np.median(white[:n][telling] / torque[telling]))
        for row in np.flatnonzero(~noisy[:n] & (typical[:n] > 0)):
            likely = 1 + share * torque[row] / length / typical[row]
            if np.log(likely / power.ratio[row]) < 2 * np.sqrt(2 / power.freedom[row]):
                white[row], ratio[row] = missed[row] + share * torque[row], likely
    return Noise(channels, white, sensors, np.sqrt(ratio))


def missed_torque(motion: RecordedMotion) -> np.ndarray:
    """Variance of what the commands of each joint do between rows that are rarer than they are
    given, (n,) [Nm^2].

    A controller answers the noise of its sensors in every period: commands have a white part, of
    which such a log has samples. Of a mean over N of them, of which the ends are known, the white
    part of all others is missing, which over many steps leaves 1 - 1/N of its variance.
    """
    timing, torque = motion.timing, motion.signals.torque_command
    unseen = 1.0 - timing.command / timing.period if timing.command > 0 else 0.0
    if unseen == 0.0:
        return np.zeros(torque.shape[1])
    known = np.repeat(motion.measured[:, None], torque.shape[1], axis=1)
    white = np.nan_to_num(noise_power(torque, known, np.ones(torque.shape)).ratio)
    return unseen * np.maximum(white - motion.torque_variance(torque).mean(axis=0), 0.0)


def noise_finding(motion: RecordedMotion, noise: Noise) -> HygieneFinding | None:
    """Says what is noisier than is believed; None if nothing is.

    Where no noise is believed, what is next to nothing beside the torque is not worth a word.
    """
    parts = [
        f"{c.channel} has white noise of {c.level:.2g} {c.unit} a sample, "
        f"{c.level / c.believed:.3g} times what the scenario believes"
        for c in noise.channels
        if c.believed > 0
    ]
    rows, n = motion.rows, len(motion.robot.joint_names)
    torque = motion.blocks.torque_command
    torque_noise = np.sqrt(motion.torque_variance(torque).mean(axis=0) + noise.white[:n])
    believed = motion.sensor_noise.white.mean(axis=0) + motion.sensor_noise.at_end.mean(axis=0)
    worth = believed > _ROUNDING
    worth[:n] |= torque_noise > _NEGLIGIBLE * rms(torque, motion.known[:, :n])
    said = [int(k) for k in np.argsort(-noise.factor) if noise.factor[k] > _LEAST and worth[k]]
    names = [rows[k].name for k in said]
    if said:
        text = f"{names[0]} and {len(said) - 1} more rows are" if said[1:] else f"{names[0]} is"
        text += f" {noise.factor[said[0]]:.3g} times as noisy from block to block as is believed"
        if said[0] < n:
            text += f", as if its torque had noise of {torque_noise[said[0]]:.2g} "
            text += f"{rows[said[0]].unit} a sample (recording.torque_noise)"
        parts.append(text)
    if not parts:
        return None
    factors = [c.level / c.believed for c in noise.channels if c.believed > 0]
    factors += [float(noise.factor[k]) for k in said]
    return remark(
        "noise_level",
        "warning",
        "noise",
        max(factors),
        "1",
        "; ".join([*parts, "what was measured is used"]),
        [*(c.channel for c in noise.channels if c.believed > 0), *names],
    )
