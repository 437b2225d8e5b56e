"""Checks of a recording's channels by themselves: clock, stuck, clipped, lost, held, coarse,
filtered, ringing and noisy channels."""

from collections.abc import Iterable

import numpy as np
from scipy.signal import welch
from scipy.special import comb

from fbse_drake.discrepancy.residual.evidence import (
    STILL,
    Evidence,
    HygieneFinding,
    NoiseLevel,
    Severity,
    remark,
    remarks,
)
from fbse_drake.discrepancy.residual.lost_readings import lost_readings
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.held_readings import rows_per_reading

# Scatter of the sampling period that is worth a word, and a warning, as shares of it.
_JITTER, _STRONG_JITTER = 0.01, 0.2
# Share of a log in gaps at which a gap is a warning.
_MANY_GAPS = 0.1
# Longest time for which a sensor that works repeats itself exactly [s], and number of samples.
_STUCK, _STUCK_SAMPLES = 0.25, 20
# How long a filtered velocity runs on after its joint [s].
_SETTLING = 0.1
# A velocity that adds up to less than this while an angle rests, and to less than an offset of the
# velocity would, says nothing [rad or m, rad/s or m/s].
_FAR, _VELOCITY_OFFSET = 0.02, 0.02
# White noise stays within so many of its standard deviations.
_NOISE_WIDTH = 10.0
_TORQUE = "joint/torque_command"
# Of a joint whose drive is off the model needs less than this share of the torque that it needs
# else, and of its power so much is taken from the motion.
_SMALL_FORCE, _BRAKES = 0.5, 0.5
# Shortest run at its largest value of a channel that is clipped [samples], and the share of the log
# that such runs need.
_CLIPPED_RUN, CLIPPED_SHARE = 5, 0.005
# A channel whose neighbouring samples are equal this often is sampled more slowly than the log.
_REPEATED = 0.2
# Number of samples from which on spectra are looked at.
SPECTRUM = 512
# Power at the upper end of the spectrum against that half way: of white noise 1, of what falls with
# the eighth power of the frequency, as motions do, 0.02.
_EMPTY = 0.002
# Share of a channel's variance that may lie above the corner of what filtered it.
_EDGE = 1e-6
# Correlation of a velocity's changes from sample to sample below which it alternates (white noise
# has -1/2, and -3/4 if differentiated twice), in more than half of windows of so many samples.
_ALTERNATES, _RINGING = -0.9, 50
# Ringing that is so many times the motion drowns it: a tenth of the ringing is as large as that.
_DROWNS = 10.0
# Order of the differences by which noise is told from motion.
_DIFFERENCE = 6
# Noise is taken from stretches of so many samples, and from this share of them that are quietest.
_QUIET_SAMPLES, _QUIET = 100, 0.25
# Measured noise may be below the believed by this factor.
_NOISE_FACTOR = 3.0


def check_sampling(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Gaps, and stamps that scatter."""
    steps = np.diff(evidence.log.time)
    gaps = steps > 1.5 * evidence.period
    if gaps.any():
        lost = float((steps[gaps] - evidence.period).sum())
        share = lost / float(evidence.log.time[-1] - evidence.log.time[0])
        text = (
            f"{int(gaps.sum())} gaps, {lost:.3g} s in all ({100 * share:.2g} % of the log); "
            "nothing is said about them"
        )
        yield remark("gap", "warning" if share > _MANY_GAPS else "note", "time", lost, "s", text)
    stamps = evidence.motion.stamps
    is_even = stamps is not evidence.log.time
    jitter = float(np.std(np.diff(stamps)[~gaps]) / evidence.period)
    if jitter > _JITTER:
        meaning = (
            "the angles show that the samples do not, so they are taken to be even"
            if is_even
            else "channels are interpolated on an even grid, which smoothes their noise"
        )
        scatters = f"scatters by {100 * jitter:.2g} %; {meaning}"
        text = f"the period of {1e3 * evidence.period:.4g} ms {scatters}"
        yield remark(
            "jitter",
            "warning" if jitter > _STRONG_JITTER and not is_even else "note",
            "time",
            jitter * evidence.period,
            "s",
            text,
        )


def _runs(equal: np.ndarray) -> np.ndarray:
    """Starts and stops of runs of true, (runs, 2)."""
    edges = np.flatnonzero(np.diff(equal.astype(int), prepend=0, append=0))
    return edges.reshape(-1, 2)


def check_stuck(evidence: Evidence) -> Iterable[HygieneFinding]:
    """A channel that repeats itself exactly while the robot moves; one of a joint, while that joint
    moves."""
    least = max(_STUCK_SAMPLES, round(_STUCK / evidence.period))
    position = evidence.log["joint/position"]
    # Farther than steps and noise of the encoder.
    steps = 10 * np.maximum(STILL, evidence.quantum["joint/position"])
    far_by_angles = np.fmax(steps, _NOISE_WIDTH * white_noise(evidence.motion, position))
    velocity = evidence.log.get("joint/velocity", np.zeros_like(position))
    # One count of a velocity may be its offset.
    velocity = np.where(
        np.abs(velocity) > 1.5 * evidence.quantum.get("joint/velocity", 0.0), velocity, 0.0
    )
    enabled = evidence.log.get("joint/enabled", np.ones_like(position))
    settling = round(_SETTLING / evidence.period)
    for name, (values, parts) in evidence.channels.items():
        found = {}
        for k, part in enumerate(parts):
            # An angle that is stuck does not show that the joint moves.
            travelled = (
                np.cumsum(velocity, axis=0) * evidence.period
                if name == "joint/position"
                else position
            )
            columns = [k] if name.startswith("joint/") else list(range(len(evidence.joints)))
            travel = travelled[:, columns]
            # A velocity that was filtered still runs on for a while after its joint has come to
            # rest.
            late = settling if name == "joint/position" else 0
            runs = [(a, b) for a, b in _runs(np.diff(values[:, k]) == 0) if b - a >= least + late]
            # Farther than what an offset of a velocity adds up to.
            by_offset = [_FAR + _VELOCITY_OFFSET * (b - a) * evidence.period for a, b in runs]
            far = by_offset if name == "joint/position" else [far_by_angles[columns]] * len(runs)
            runs = [
                (a, b)
                for (a, b), least in zip(runs, far, strict=True)
                if (np.ptp(travel[a + late : b + 1], axis=0) > least).any()
            ]
            if name == _TORQUE:
                # A drive may be off, or at its limit, which is another finding.
                column = values[:, k]
                runs = [
                    (a, b)
                    for a, b in runs
                    if enabled[a : b + 1, k].any()
                    and column.min() < column[a] < column.max()
                    and not (column[a] == 0.0 and _is_off(evidence, a, b))
                ]
            if name.startswith("foot/"):
                # In the air a foot may well read nothing at all.
                runs = [(a, b) for a, b in runs if values[a, k] != 0]
            if runs and np.ptp(values[:, k]) > 0:
                found[part] = sum(b - a for a, b in runs) * evidence.period
        text = (
            "{where} repeats one value for {size} while the robot moves; what is found in this "
            "time is the sensor's doing"
        )
        yield from remarks("stuck", "untrustworthy", name, found, "s", text)


def _is_off(evidence: Evidence, first: int, last: int) -> bool:
    """Is a drive off whose torque is 0 from one row of the log to another? Then the joint's motion
    takes no energy from it: what the model needs there brakes it, as friction does, and is small.

    Drives that are off at the same time are looked at together.
    """
    motion = evidence.motion
    given = evidence.log[_TORQUE][first : last + 1]
    off = np.atleast_1d((given == 0.0).all(axis=0))
    half = 0.5 * motion.length * motion.period
    within = (motion.time - half > evidence.log.time[first]) & (
        motion.time + half < evidence.log.time[last]
    )
    known = evidence.known[:, : len(off)] & off
    needed, velocity = evidence.link_torque, motion.blocks.joint_velocity
    inside, outside = known & within[:, None], known & ~within[:, None]
    if not (inside.any() and outside.any()):
        return False
    power = (needed * velocity)[inside]
    usual = np.sqrt((needed[outside] ** 2).mean())
    small = np.sqrt((needed[inside] ** 2).mean()) < _SMALL_FORCE * usual
    return bool(small and -power.sum() > _BRAKES * np.abs(power).sum())


def check_clipped(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Channels that reach one and the same limit again and again and stay there."""
    for name, (values, parts) in evidence.channels.items():
        found = {}
        for k, part in enumerate(parts):
            column = values[:, k]
            share = 0.0
            for extreme in (column.min(), column.max()):
                runs = _runs(column == extreme)
                long = [stop - start for start, stop in runs if stop - start >= _CLIPPED_RUN]
                if (
                    abs(extreme) > 0.2 * np.abs(column).max()
                    and np.ptp(column) > 20 * evidence.quantum[name][k]
                    and len(long) > 1
                ):
                    share += sum(long) / len(column)
            if share > CLIPPED_SHARE:
                found[part] = 100 * share
        text = (
            "{where} stays at its limit for {size} of the log; there it says "
            "nothing of the true value"
        )
        if name != "joint/position":
            yield from remarks("clipped", "warning", name, found, "%", text)


def check_lost(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Torques that are exactly 0 amid others that are all but that: readings that were lost."""
    if _TORQUE not in evidence.channels:
        return
    values, parts = evidence.channels[_TORQUE]
    shares = 100 * lost_readings(values).mean(axis=0)
    found = {part: float(share) for part, share in zip(parts, shares, strict=True) if share > 0}
    text = (
        "{where} is exactly 0 in {size} of the samples, amid values that are far from it: "
        "readings that were lost; "
    )
    if evidence.motion.recording.is_sampled:
        text += "they are taken to lie between those around them"
        yield from remarks("lost", "warning", _TORQUE, found, "%", text)
    else:
        yield from remarks("lost", "untrustworthy", _TORQUE, found, "%", text + "leave them out")


def check_slow_channels(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Channels that come less often than the log's samples and are held in between."""
    for name, (values, _) in evidence.channels.items():
        moving = np.ptp(values, axis=0) > 20 * np.maximum(evidence.quantum[name], 1e-12)
        if name == "joint/position" or not moving.any():
            continue
        held = (np.diff(values[:, moving], axis=0) == 0).all(axis=1)
        changing = np.abs(values[1:, moving]).max(axis=1) > 0
        if changing.any() and (share := float(held[changing].mean())) > _REPEATED:
            late = 500 * evidence.period / (1 - share)
            text = f"{100 * share:.0f} % of its samples repeat the one before: "
            is_instant = evidence.motion.recording.is_sampled
            is_command = name == "joint/torque_command" and not is_instant
            if is_command or rows_per_reading(values) == 1:
                text += f"it comes {late:.2g} ms late on average; its noise is not white"
            else:
                text += "it is interpolated between its readings; what is faster is not seen"
            yield remark("held", "warning", name, 1.0 / (1.0 - share), "samples", text)


def check_steps(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Joint channels of coarse steps that the scenario does not know of."""
    believed = evidence.motion.sensors.encoders.resolution
    for name, units in evidence.units.items():
        if name not in evidence.channels:
            continue
        (values, parts), step = evidence.channels[name], evidence.quantum[name]
        angles = name == "joint/position"
        coarse = step > (1.5 * believed if angles else 0.02 * values.std(axis=0))
        found = {
            part: float(step[k])
            for k, part in enumerate(parts)
            if step[k] > 0 and coarse[k] and np.ptp(values[:, k]) > STILL
        }
        known = (
            f"the scenario believes {believed:.2g} (sensors.encoders.resolution)"
            if angles
            else "what is smaller does not show"
        )
        yield from remarks(
            "quantised", "note", name, found, units, "{where} comes in steps of {size}; " + known
        )


def check_filtered(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Channels whose spectrum is empty at its upper end: filtered before they were recorded."""
    if len(evidence.log.time) < SPECTRUM:
        return
    for name, (values, parts) in evidence.channels.items():
        found = {}
        for k, part in enumerate(parts):
            column = values[:, k]
            if np.ptp(column) <= 20 * max(evidence.quantum[name][k], 1e-12):
                continue
            # An impact is in few of the segments.
            frequency, power = welch(
                column, 1.0 / evidence.period, nperseg=SPECTRUM, average="median"
            )
            # Relative to half the sampling rate.
            share = frequency / frequency[-1]
            middle, top = (
                power[(share > 0.5) & (share < 0.6)].mean(),
                power[(share > 0.85) & (share < 0.95)].mean(),
            )
            beyond = np.cumsum(power[::-1])[::-1] / power.sum()
            if top < _EMPTY * middle:
                found[part] = float(
                    frequency[max(1, int(np.argmax(beyond < _EDGE)))] or frequency[-1]
                )
        lowest = dict.fromkeys(found, min(found.values(), default=0.0))
        text = (
            "{where} was filtered before it was recorded: it holds nothing above {size}; "
            "intervals take its noise to be white"
        )
        yield from remarks("filtered", "note", name, lowest, "Hz", text)


def check_ringing(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Velocities that change their course with every sample: a loop on its edge of stability."""
    name = "joint/velocity"
    if name not in evidence.channels:
        return
    values, parts = evidence.channels[name]
    changes = np.diff(values, axis=0)
    count = len(changes) // _RINGING
    if count == 0:
        return
    windows = changes[: count * _RINGING].reshape(count, _RINGING, -1)
    power = (windows**2).sum(axis=1)
    products = (windows[:, 1:] * windows[:, :-1]).sum(axis=1)
    alternates = products < _ALTERNATES * power
    sizes = 0.5 * np.sqrt(np.median(power / _RINGING, axis=0))
    moves = (0.5 * (values[1:] + values[:-1])).std(axis=0)
    rings = (alternates.mean(axis=0) > 0.5) & (sizes > evidence.quantum[name])
    drowns = rings & (sizes > _DROWNS * moves)
    text = (
        "{where} goes to and fro from sample to sample, by {size} each way: its loop rings at half "
        "the rate of the log, "
    )

    def said(severity: Severity, there: np.ndarray, consequence: str) -> Iterable[HygieneFinding]:
        found = {parts[k]: float(sizes[k]) for k in np.flatnonzero(there)}
        units = evidence.units[name]
        return remarks("ringing", severity, name, found, units, text + consequence)

    yield from said("untrustworthy", drowns, "which drowns how it moves otherwise")
    yield from said("warning", rings & ~drowns, "which blurs laws of friction")


def estimated_noise(motion: RecordedMotion) -> list[NoiseLevel]:
    """White noise of the sensors, for `sensors:` and `recording:` of a scenario: from differences
    of high order, which motion hardly has.

    A filtered channel has less noise than its sensor.
    """
    sensors, torque_noise = motion.sensors, motion.recording.torque_noise
    evidence = Evidence(motion)
    believed = {
        "joint/position": max(sensors.encoders.noise, sensors.encoders.resolution / np.sqrt(12)),
        "joint/motor_position": (sensors.motor_encoders or sensors.encoders).angle_noise,
        "joint/velocity": sensors.encoders.velocity_noise
        if sensors.encoders.velocity == "exact"
        else np.nan,
        "joint/torque_command": max(torque_noise.values(), default=np.nan),
        "imu/linear_acceleration": sensors.imu.acceleration_noise,
        "imu/angular_velocity": sensors.imu.angular_velocity_noise,
    }
    result = []
    for name, (values, _) in evidence.channels.items():
        if name.startswith("foot/"):
            # Of a six-axis sensor its forces.
            forces = values[:, 3:] if name.endswith("wrench") else values
            result.append(_level(motion, name, forces, "N", sensors.foot_force.noise))
        else:
            units = evidence.units.get(name, {"": motion.log.unit(name)})
            result.append(
                _level(
                    motion, name, values, " or ".join(dict.fromkeys(units.values())), believed[name]
                )
            )
    return result


def white_noise(motion: RecordedMotion, values: np.ndarray) -> np.ndarray:
    """White noise of each component of a channel (N, components): standard deviation in the quiet
    parts of the log, which have no impacts; NaN where it has none."""
    whole = (
        np.convolve(np.diff(motion.log.time) < 1.5 * motion.period, np.ones(_DIFFERENCE), "valid")
        == _DIFFERENCE
    )
    differences = np.diff(values, _DIFFERENCE, axis=0)[whole] / np.sqrt(
        comb(2 * _DIFFERENCE, _DIFFERENCE)
    )
    parts = [
        (part**2).mean(axis=0)
        for part in np.array_split(differences, max(1, len(differences) // _QUIET_SAMPLES))
        if len(part)
    ]
    return (
        np.sqrt(np.quantile(parts, _QUIET, axis=0)) if parts else np.full(values.shape[1], np.nan)
    )


def _level(
    motion: RecordedMotion, name: str, values: np.ndarray, unit: str, believed: float
) -> NoiseLevel:
    # The typical component: joints that tremble are no noise of sensors.
    level = float(np.median(white_noise(motion, values)))
    return NoiseLevel(name, level, unit, float(believed))


def check_noise(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Channels that are quieter than the scenario believes. Of noisier ones the rows tell, see
    `noise.noise_finding`."""
    for noise in estimated_noise(evidence.motion):
        if noise.channel == "joint/position" or not noise.believed > 0 or not noise.level > 0:
            continue
        factor = noise.level / noise.believed
        if factor < 1 / _NOISE_FACTOR:
            text = (
                f"its white noise is {noise.level:.2g} {noise.unit} a sample, the scenario "
                f"believes {noise.believed:.2g}; "
            )
            text += "small effects are missed"
            yield remark("noise_level", "note", noise.channel, factor, "1", text)


CHECKS = (
    check_sampling,
    check_stuck,
    check_clipped,
    check_lost,
    check_slow_channels,
    check_steps,
    check_filtered,
    check_ringing,
    check_noise,
)
