"""Checks of a recording's channels against each other and against the model: clocks, torques,
swapped joints, weight and gravity."""

import itertools
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion, uniform_filter1d

from fbse_drake.discrepancy.hygiene.channel_checks import SPECTRUM
from fbse_drake.discrepancy.hygiene.sanity import rate_by_legs
from fbse_drake.discrepancy.hygiene.torque_checks import check_torque
from fbse_drake.discrepancy.hygiene.torque_readings import (
    FALSE_ALARM,
    STRETCH,
    Columns,
    JointTorques,
    chance,
    fitted,
    gain,
)
from fbse_drake.discrepancy.residual.evidence import (
    Evidence,
    HygieneFinding,
    remark,
    remarks,
    travel_of,
)
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.discrepancy.residual.residual import rms

# Largest clock offset that is looked for, and smallest that counts, in samples; and the correlation
# from which on a delay can be told.
_LARGEST_OFFSET, _SMALLEST_OFFSET, _CORRELATED = 20, 1.5, 0.7
# What is allowed for is said from so many samples on.
_WORTH_SAYING = 0.25
# Moments of feet are smoothed over so many samples before they are differenced.
_SMOOTHED = 11
# What a delay or a low-pass must take off the mismatch of two channels to be named, as a share of
# its sum of squares.
_WORTHWHILE = 0.1
# Root mean square rate of a joint that moves well [rad/s or m/s].
_MOVING = 0.05
# Two swapped joints leave at most this share of the squared residual when they are swapped back.
_SWAPPED = 0.5
_SWAP_BLOCKS = 40
# Static checks: share of the weight, tilt of the force [rad], share of gravity, share of the weight
# on a foot in the air.
_WEIGHT, _TILT, _GRAVITY, _AIR = 0.02, 0.025, 0.01, 0.01
# Correlation below which a force moves against what is needed of it, of means over this long [s].
_AGAINST, _SLOW = -0.2, 0.1
# Fewest blocks from which something is said of a foot, and how long it takes a foot to read nothing
# after it is lifted [s].
_FEWEST, _SETTLED = 20, 0.1


def _offset(x: np.ndarray, y: np.ndarray, inside: np.ndarray | None = None) -> tuple[float, float]:
    """By how many samples y comes later than x, and the correlation of the two then; columns (M, k)
    count by their power.

    Args:
        inside: samples of x that count, (M,).
    """
    inside = np.ones(len(x), dtype=bool) if inside is None else inside
    inside = inside.copy()
    inside[:_LARGEST_OFFSET] = inside[len(x) - _LARGEST_OFFSET :] = False
    at = np.flatnonzero(inside)
    lags = np.arange(-_LARGEST_OFFSET, _LARGEST_OFFSET + 1)
    if len(at) < 10 * _LARGEST_OFFSET:
        return 0.0, 0.0
    x0 = x[at] - x[at].mean(axis=0)
    correlation = []
    for lag in lags:
        y0 = y[at + lag] - y[at + lag].mean(axis=0)
        correlation.append((x0 * y0).sum() / np.sqrt((x0**2).sum() * (y0**2).sum() + 1e-300))
    best = int(np.argmax(correlation))
    if not 0 < best < len(lags) - 1:
        return float(lags[best]), float(correlation[best])
    before, here, after = correlation[best - 1 : best + 2]
    return float(lags[best] + 0.5 * (before - after) / (before - 2 * here + after)), float(here)


def _clock(
    evidence: Evidence, channel: str, offset: float, correlation: float, against: str
) -> Iterable[HygieneFinding]:
    """
    Args:
        offset: by how many samples the channel is late.
    """
    if correlation > _CORRELATED and abs(offset) > _SMALLEST_OFFSET:
        seconds = offset * evidence.period
        text = (
            f"comes {1e3 * abs(seconds):.3g} ms {'late' if offset > 0 else 'early'} "
            f"against {against}, which no mechanism does; accelerations will look like "
            "friction and the other way round"
        )
        yield remark("clock_offset", "warning", channel, seconds, "s", text)


def check_velocity_clock(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Angles and velocities of one joint are the same motion: what is between them is between their
    clocks, or a filter."""
    if "joint/velocity" not in evidence.log:
        return
    if (late := evidence.motion.lateness.seconds).any():
        yield from _read_in_time(evidence, late)
        return
    velocity = evidence.log["joint/velocity"]
    differenced = np.gradient(evidence.log["joint/position"], evidence.log.time, axis=0)
    moving = np.sqrt((velocity**2).mean(axis=0)) > _MOVING
    if moving.any():
        yield from _clock(
            evidence,
            "joint/velocity",
            *_offset(differenced[:, moving], velocity[:, moving]),
            "the rate of the angles",
        )


def _read_in_time(evidence: Evidence, late: np.ndarray) -> Iterable[HygieneFinding]:
    """
    Args:
        late: by what the velocity of each joint comes late, (n,) [s].
    """
    worst = int(np.argmax(np.abs(late)))
    if abs(late[worst]) < _WORTH_SAYING * evidence.period:
        return
    seconds = float(late[worst])
    text = (
        f"comes {1e3 * abs(seconds):.3g} ms {'late' if seconds > 0 else 'early'} against the rate "
        "of the angles, as behind a filter; it is read in time with them"
    )
    yield remark("velocity_clock", "note", "joint/velocity", seconds, "s", text)


def check_gyro_clock(evidence: Evidence) -> Iterable[HygieneFinding]:
    """While a sole stands, its leg tells how the base turns. So does a sole that rolls or gives
    way, or an angle that is read too much, look like a clock."""
    if not evidence.robot.has_floating_base:
        return
    motion, at = evidence.motion, evidence.instants
    by_legs, stands = rate_by_legs(motion, at)
    gyro = at.angular_velocity @ motion.equation.R_BI.T
    offset, correlation = _offset(by_legs, gyro, stands)
    against = "the legs that stand"
    if not (correlation > _CORRELATED and abs(offset) > _SMALLEST_OFFSET):
        return
    if _is_late(evidence, by_legs, gyro, stands, round(offset)):
        yield from _clock(evidence, "imu/angular_velocity", offset, correlation, against)
        return
    seconds = offset * evidence.period
    text = (
        f"seems {1e3 * abs(seconds):.3g} ms {'late' if offset > 0 else 'early'} against "
        f"{against}; this may be its clock, but soles that roll or give way, or angles that are "
        "read too much, look the same"
    )
    yield remark("clock_or_sole", "note", "imu/angular_velocity", seconds, "s", text)


def _is_late(
    evidence: Evidence, by_legs: np.ndarray, gyro: np.ndarray, stands: np.ndarray, samples: int
) -> bool:
    """Is a gyro (M, 3) so many samples late for sure, whatever mixes its axes and however soles
    turn with their moments?"""
    motion = evidence.motion
    moments = np.hstack([w[:, :3] for w in motion.equation.wrenches(evidence.instants.pad_force)])
    turning = uniform_filter1d(np.gradient(moments, axis=0), _SMOOTHED, axis=0)
    values = np.column_stack([by_legs, turning, np.ones(len(gyro))])
    anything = np.full(values.shape[1], np.inf)
    columns = Columns(("a sole that turns",) * values.shape[1], values, -anything, anything)
    inside = stands.copy()
    inside[:_LARGEST_OFFSET] = inside[len(inside) - _LARGEST_OFFSET :] = False
    stretch = (np.flatnonzero(inside) * evidence.period / STRETCH).astype(int)
    chances = [
        chance(
            gain(*(fitted(np.roll(rate, -late), columns, inside).left for late in (0, samples))),
            stretch,
        )
        for rate in gyro.T
    ]
    # The best of several offsets and axes is the best by chance more often than one.
    return len(chances) * (2 * _LARGEST_OFFSET + 1) * min(chances) < FALSE_ALARM


def check_force_clock(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Forces under the feet against what the masses need: do they come late, as by a clock, or as
    by a low-pass of first order?"""
    if not evidence.robot.has_floating_base or len(evidence.instants.joint_position) < SPECTRUM:
        return
    # Impacts are vertical.
    needed, given = (
        wrench[:, 5] - wrench[:, 5].mean()
        for wrench in evidence.needed_and_given(evidence.instants)
    )
    pulsation = 2 * np.pi * np.fft.rfftfreq(len(needed), evidence.period)
    spectrum, inner = np.fft.rfft(needed), given[_LARGEST_OFFSET:-_LARGEST_OFFSET]

    def mismatch(response: np.ndarray) -> float:
        """Share of what the feet give that is not what the masses need behind a filter."""
        return (
            1.0
            - _correlation(
                np.fft.irfft(spectrum * response, len(needed))[_LARGEST_OFFSET:-_LARGEST_OFFSET],
                inner,
            )
            ** 2
        )

    constants = evidence.period * np.geomspace(0.5, 50, 20)
    offsets = np.linspace(-0.5 * _LARGEST_OFFSET, 0.5 * _LARGEST_OFFSET, 2 * _LARGEST_OFFSET + 1)
    filters = [1.0 / (1.0 + 1j * pulsation * constant) for constant in constants]
    shifts = [np.exp(-1j * pulsation * offset * evidence.period) for offset in offsets]
    causal = np.array([[mismatch(filter_ * shift) for shift in shifts] for filter_ in filters])
    # As smooth, for what the masses need is noisy, but not late.
    smooth = np.array(
        [[mismatch(np.abs(filter_) * shift) for shift in shifts] for filter_ in filters]
    )
    if min(causal.min(), smooth.min()) > 1 - _CORRELATED**2:
        return
    if causal.min() < (1 - _WORTHWHILE) * smooth.min():
        constant = float(constants[np.unravel_index(causal.argmin(), causal.shape)[0]])
        text = (
            "the vertical force follows what the masses need through a low-pass of first order of "
            f"{1e3 * constant:.2g} ms ({1 / (2 * np.pi * constant):.2g} Hz), not through a mere "
            "delay; the base's rows may miss force where it changes"
        )
        yield remark("low_pass", "warning", "foot/<side>", constant, "s", text)
    elif smooth.min() < (1 - _WORTHWHILE) * smooth[:, _LARGEST_OFFSET].min():
        offset = float(offsets[np.unravel_index(smooth.argmin(), smooth.shape)[1]])
        yield from _clock(evidence, "foot/<side>", offset, 1.0, "what the masses need")


def check_resting_joints(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Joints that do not move."""
    position = evidence.log["joint/position"]
    resting, size = travel_of(position) == 0, np.ptp(position, axis=0)
    at_rest = {joint: float(size[k]) for k, joint in enumerate(evidence.joints) if resting[k]}
    text = "{where} does not move ({size}); nothing can be said of its friction"
    yield from remarks(
        "no_motion", "note", "joint/position", at_rest, evidence.units["joint/position"], text
    )


def check_swapped_joints(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Does the equation of motion close far better if two joints, or two legs, change places?"""
    motion, n = evidence.motion, len(evidence.joints)
    every = max(1, len(motion.time) // _SWAP_BLOCKS)
    at = Instants(**{name: values[::every] for name, values in vars(motion.blocks).items()})
    known = evidence.known[::every]
    legs = [
        [evidence.joints.index(joint) for joint in leg.joints]
        for leg in evidence.robot.description.legs.values()
    ]
    pairs = [([a], [b]) for a, b in itertools.combinations(range(n), 2)] + list(
        itertools.combinations(legs, 2)
    )
    scale = np.maximum(rms(_zero_prediction(motion, at), known), 1e-9)

    def score(instants: Instants) -> float:
        left = np.where(known, motion.equation.residual(instants) / scale, 0.0)
        return float((left**2).sum())

    def swapped(
        at: Instants, names: Iterable[str], first: list[int], second: list[int]
    ) -> Instants:
        order = np.arange(n)
        order[first], order[second] = second, first
        return replace(at, **{name: getattr(at, name)[:, order] for name in names})

    before = score(at)
    angles = ("joint_position", "joint_velocity", "joint_acceleration")
    kinds = {
        "joint/position and joint/velocity": angles,
        "joint/torque_command": ("torque_command",),
        "joint/*": (*angles, "torque_command"),
    }
    if "joint/torque_command" not in evidence.log:
        kinds = {what: names for what, names in kinds.items() if names == angles}
    # Pair by pair: what moves alike needs the same, and that is computed once.
    scores: dict[str, list[float]] = {what: [] for what in kinds}
    for pair in pairs:
        for what, channels in kinds.items():
            scores[what].append(score(swapped(at, channels, *pair)))
    for what, channels in kinds.items():
        after, (first, second) = min(
            zip(scores[what], pairs, strict=True),
            key=lambda one: one[0],
            default=(np.inf, ([], [])),
        )
        if after < _SWAPPED * before and _fits_better(
            evidence, swapped(motion.blocks, channels, first, second), [*first, *second]
        ):
            names = [evidence.joints[k] for k in (*first, *second)]
            text = (
                f"with {' and '.join(names) if len(names) == 2 else 'the legs'} in each other's "
                f"place the error falls to {100 * np.sqrt(after / before):.0f} %; they are "
                "swapped, and whatever is found in them is wrong"
            )
            yield remark("swapped_joints", "untrustworthy", what, after / before, "1", text, names)
            return


def _fits_better(evidence: Evidence, other: Instants, places: list[int]) -> bool:
    """Do the torques of some joints fit significantly better in another order, and none of them
    worse, whatever friction, inertia or offsets they may have? Without torques there is nothing to
    doubt it by."""
    if "joint/torque_command" not in evidence.log:
        return True
    recorded, rival = JointTorques(evidence), JointTorques(evidence, other)
    gains = []
    for k in places:
        left = [t.as_recorded(k, t.columns(k, everything=True)).left for t in (recorded, rival)]
        gains.append(gain(*left))
        if chance(-gains[-1], recorded.stretches(k)) < FALSE_ALARM:
            return False
    stretch = np.concatenate([recorded.stretches(k) for k in places])
    return chance(np.concatenate(gains), stretch) < FALSE_ALARM


def _zero_prediction(motion: RecordedMotion, at: Instants) -> np.ndarray:
    """What the rows would be without a model: torques, wrench of the feet; the scale of each row.
    (B, R)"""
    n = len(motion.robot.joint_names)
    rows = motion.equation.residual(at)
    rows[:, :n] = at.torque_command
    if motion.robot.has_floating_base:
        weight, gravity = motion.equation.weight, motion.equation.gravity
        rows[:, n : n + 3], rows[:, n + 3 : n + 6] = 0.1 * weight, weight
        rows[:, n + 6 :] = gravity
        for foot in range(len(motion.robot.description.sides)):
            rows[:, n + 6 + 6 * foot : n + 9 + 6 * foot] = 1.0
    return rows


# Gravity and the weight.


def check_weight(evidence: Evidence) -> Iterable[HygieneFinding]:
    """The feet carry the weight."""
    if not evidence.robot.has_floating_base:
        return
    needed, given = (wrench[:, 3:].mean(axis=0) for wrench in evidence.over_blocks)
    excess = float(np.linalg.norm(given) - np.linalg.norm(needed))
    share = excess / evidence.motion.equation.weight
    if abs(share) > _WEIGHT:
        more, kilograms = (
            "more" if share > 0 else "less",
            abs(excess) / evidence.motion.equation.gravity,
        )
        text = (
            f"the feet carry {abs(excess):.3g} N ({100 * abs(share):.2g} %) {more} than the "
            f"model's masses need; {kilograms:.2g} kg {more} and a gain that all force sensors "
            "share explain this alike, and no motion tells them apart"
        )
        yield remark("weight", "warning", "foot/<side>", excess, "N", text)


def _tilt(vector: np.ndarray, axis: int) -> float:
    """Angle by which a force leans towards x (0) or y (1) [rad]."""
    return float(np.arctan2(vector[axis], vector[2]))


def check_force_frames(evidence: Evidence) -> Iterable[HygieneFinding]:
    """While one foot alone carries the robot, its force is what the masses need: in its mean
    direction, and in its course."""
    if not evidence.robot.has_floating_base:
        return
    motion, n = evidence.motion, len(evidence.joints)
    at, (required, _) = motion.blocks, evidence.over_blocks
    kinematic = motion.equation.residual(at)[:, n + 6 :]
    against_motion: dict[str, dict[str, float]] = {}
    for foot, (side, R_BF) in enumerate(
        zip(evidence.sides, motion.equation.sole_rotations(at.joint_position), strict=True)
    ):
        alone = np.all(
            [evidence.aloft[other] for other in range(len(evidence.sides)) if other != foot], axis=0
        )
        if len(evidence.sides) < 2 or alone.sum() < _FEWEST:
            continue
        of_all = np.einsum("mij,mi->mj", R_BF, required[:, 3:]), evidence.wrenches[foot][:, 3:]
        needed, measured = (force[alone] for force in of_all)
        # Does the sole stand level, by IMU and angles? Its specific force says so.
        tilt = kinematic[alone, 6 * foot + 3 : 6 * foot + 5].mean(axis=0)
        level = np.hypot(*tilt) / motion.equation.gravity < _TILT
        lean = {
            axis: _tilt(measured.mean(axis=0), k) - _tilt(needed.mean(axis=0), k)
            for k, axis in enumerate("xy")
        }
        lean = {f"force_{axis}": angle for axis, angle in lean.items() if abs(angle) > _TILT}
        cause = (
            "the sole stands level by IMU and angles, so that it is the force sensor's frame or "
            "cross-talk, and not the masses"
            if level
            else "the sole seems tilted too, by IMU and angles"
        )
        text = "{where} leans {size} from what gravity and motion need, with the load; " + cause
        yield from remarks("force_frame", "warning", f"foot/{side}", lean, "rad", text)
        # A robot may tremble faster than its rows can show, so that neither says what it does then.
        window = max(1, round(_SLOW / (motion.length * evidence.period)))
        within = binary_erosion(alone, np.ones(window))
        if within.sum() < _FEWEST:
            continue
        needed, measured = (uniform_filter1d(force, window, axis=0)[within] for force in of_all)
        against_motion[side] = {
            f"force_{axis}": correlation
            for k, axis in enumerate("xyz")
            if needed[:, k].std() > _AIR * motion.equation.weight
            and (correlation := _correlation(needed[:, k], measured[:, k])) < _AGAINST
        }
    feet = list(against_motion.values())
    others = (
        ", or, as every foot shows it, the accelerometer's axes are"
        if len(feet) > 1 and set.intersection(*map(set, feet))
        else ""
    )
    text = (
        "{where} moves against what the motion needs while this foot alone carries the robot "
        f"(correlation {{size}}); its sign or calibration is wrong{others}, and so is what is "
        "found in the base's rows that it enters"
    )
    for side, sizes in against_motion.items():
        channel = f"foot/{side}"
        yield from remarks("force_against_motion", "untrustworthy", channel, sizes, "1", text)


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / np.sqrt((x**2).sum() * (y**2).sum() + 1e-300))


def check_feet_in_the_air(evidence: Evidence) -> Iterable[HygieneFinding]:
    """A foot in the air must read nothing."""
    if not evidence.robot.has_floating_base or len(evidence.sides) < 2:
        return
    motion = evidence.motion
    weight, margin = motion.equation.weight, max(1, round(_SETTLED / evidence.period))
    wrenches = motion.equation.wrenches(motion.steps.pad_force)
    for side, wrench, aloft in zip(
        evidence.sides, wrenches, evidence.aloft_among(wrenches), strict=True
    ):
        inside = binary_erosion(aloft, iterations=margin)
        if inside.sum() < margin:
            continue
        reading = np.median(wrench[inside, 3:], axis=0)
        found = {
            f"force_{axis}": float(reading[k])
            for k, axis in enumerate("xyz")
            if abs(reading[k]) > _AIR * weight
        }
        text = (
            "{where} reads {size} while the foot is in the air; the sensor has "
            "an offset (FootForceBias)"
        )
        yield from remarks("air_reading", "warning", f"foot/{side}", found, "N", text)


def check_gravity(evidence: Evidence) -> Iterable[HygieneFinding]:
    """In the mean the accelerometer reads gravity."""
    if not evidence.robot.has_floating_base:
        return
    equation = evidence.motion.equation
    mean = float(np.linalg.norm(evidence.motion.signals.specific_force.mean(axis=0)))
    if abs(mean / equation.gravity - 1) > _GRAVITY:
        text = (
            f"its mean is {mean:.3f} m/s^2, gravity is {equation.gravity:.2f}; bias or scale of "
            "the accelerometer looks like mass"
        )
        yield remark(
            "gravity", "warning", "imu/linear_acceleration", mean - equation.gravity, "m/s^2", text
        )


def check_model_file(evidence: Evidence) -> Iterable[HygieneFinding]:
    """The model is as its file has it."""
    for text in evidence.robot.remarks:
        yield remark("model_file", "warning", "model", 1.0, "1", text)


CHECKS = (
    check_model_file,
    check_velocity_clock,
    check_gyro_clock,
    check_force_clock,
    check_torque,
    check_resting_joints,
    check_swapped_joints,
    check_weight,
    check_force_frames,
    check_feet_in_the_air,
    check_gravity,
)
