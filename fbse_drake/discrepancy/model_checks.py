"""Checks of a recording's channels against each other and against the model: clocks, torques, swapped joints, weight and gravity."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_erosion

from fbse_drake.discrepancy.channel_checks import CLIPPED_SHARE, SPECTRUM, STILL
from fbse_drake.discrepancy.evidence import Evidence, HygieneFinding, remark, remarks
from fbse_drake.discrepancy.residual import Instants, RecordedMotion, rms
from fbse_drake.discrepancy.sanity import rate_by_legs

# Largest clock offset that is looked for, and smallest that counts, in samples; and the correlation from which on a delay can be told.
_LARGEST_OFFSET, _SMALLEST_OFFSET, _CORRELATED = 20, 1.5, 0.7
# What a delay or a low-pass must take off the mismatch of two channels to be named, as a share of its sum of squares.
_WORTHWHILE = 0.1
# Root mean square rate of a joint that moves well [rad/s or m/s].
_MOVING = 0.05
# A torque scale that is off by more than a factor of this is no torque; off by more than the smaller it is doubtful.
_NO_TORQUE, _DOUBTFUL_TORQUE = 3.0, 1.3
# Two swapped joints leave at most this share of the squared residual when they are swapped back.
_SWAPPED = 0.5
_SWAP_BLOCKS = 40
# Static checks: share of the weight, tilt of the force [rad], share of gravity, share of the weight on a foot in the air.
_WEIGHT, _TILT, _GRAVITY, _AIR = 0.02, 0.025, 0.01, 0.01
# Fewest blocks from which something is said of a foot, and how long it takes a foot to read nothing after it is lifted [s].
_FEWEST, _SETTLED = 20, 0.1


def _offset(x: np.ndarray, y: np.ndarray, inside: np.ndarray | None = None) -> tuple[float, float]:
    """By how many samples y comes later than x, and the correlation of the two then; columns (M, k) count by their power.

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
            f"comes {1e3 * abs(seconds):.3g} ms {'late' if offset > 0 else 'early'} against {against}, which no mechanism "
            "does; accelerations will look like friction and the other way round"
        )
        yield remark("clock_offset", "warning", channel, seconds, "s", text)


def check_velocity_clock(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Angles and velocities of one joint are the same motion: what is between them is between their clocks."""
    if "joint/velocity" not in evidence.log:
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


def check_gyro_clock(evidence: Evidence) -> Iterable[HygieneFinding]:
    """While a sole stands, its leg tells how the base turns."""
    if not evidence.robot.has_floating_base:
        return
    motion, at = evidence.motion, evidence.instants
    by_legs, stands = rate_by_legs(motion, at)
    gyro = at.angular_velocity @ motion.equation.R_BI.T
    yield from _clock(
        evidence, "imu/angular_velocity", *_offset(by_legs, gyro, stands), "the legs that stand"
    )


def check_force_clock(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Forces under the feet against what the masses need: do they come late, as by a clock, or as by a low-pass of first order?"""
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
            f"the vertical force follows what the masses need through a low-pass of first order of {1e3 * constant:.2g} ms "
            f"({1 / (2 * np.pi * constant):.2g} Hz), not through a mere delay; the base's rows may miss force where it changes"
        )
        yield remark("low_pass", "warning", "foot/<side>", constant, "s", text)
    elif smooth.min() < (1 - _WORTHWHILE) * smooth[:, _LARGEST_OFFSET].min():
        offset = float(offsets[np.unravel_index(smooth.argmin(), smooth.shape)[1]])
        yield from _clock(evidence, "foot/<side>", offset, 1.0, "what the masses need")


@dataclass(frozen=True)
class _TorqueFit:
    """Torque of a joint as scale times what the model needs, beside viscous and Coulomb friction and a constant."""

    scale: float
    deviation: float
    # Shares of the torque's variance that are explained: by all of it, by what the model needs alone, by velocity alone.
    explained: float
    by_model: float
    by_velocity: float


def _fit_torque(torque: np.ndarray, link: np.ndarray, velocity: np.ndarray) -> _TorqueFit:
    one, direction = np.ones_like(torque), np.tanh(velocity / 0.02)
    spread = float(((torque - torque.mean()) ** 2).sum())

    def explained(*columns: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        X = np.stack([*columns, one], axis=1)
        theta = np.linalg.lstsq(X, torque)[0]
        return 1 - float(((torque - X @ theta) ** 2).sum()) / max(spread, 1e-300), theta, X

    share, theta, X = explained(link, velocity, direction)
    left = torque - X @ theta
    # What is left lasts: counts as a twentieth as many samples.
    deviation = np.sqrt(20 * (left**2).mean() * np.linalg.pinv(X.T @ X)[0, 0])
    return _TorqueFit(
        float(theta[0]),
        float(deviation),
        share,
        explained(link)[0],
        explained(velocity, direction)[0],
    )


def check_torque(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Scale, clock and nature of the torques."""
    channel = "joint/torque_command"
    if channel not in evidence.log:
        return
    motion = evidence.motion
    known = evidence.known[:, 0]
    torque, link, velocity = (
        motion.blocks.torque_command[known],
        evidence.link_torque[known],
        motion.blocks.joint_velocity[known],
    )
    floor = np.nan_to_num(motion.residual.noise_floor[: len(evidence.joints)])
    raw = evidence.log[channel]
    scales, duty, offsets = {}, {}, []
    for k, joint in enumerate(evidence.joints):
        needed = link[:, k].std()
        if needed < max(10 * floor[k], 1e-9) or np.ptp(torque[:, k]) == 0:
            continue
        fit = _fit_torque(torque[:, k], link[:, k], velocity[:, k])
        limit = np.abs(raw[:, k]).max()
        saturates = float((np.abs(raw[:, k]) == limit).mean()) > CLIPPED_SHARE
        if (
            saturates
            and fit.by_velocity > max(fit.by_model, 0.3)
            and not 1 / _NO_TORQUE < fit.scale < _NO_TORQUE
        ):
            duty[joint] = limit
            continue
        off = max(fit.scale, 1 / fit.scale) if fit.scale > 0 else np.inf
        if (
            fit.explained > 0.5
            and off > _DOUBTFUL_TORQUE
            and abs(fit.scale - 1) > 5 * fit.deviation
        ):
            scales[joint] = fit.scale
        if fit.explained > 0.8 and fit.by_model > 0.3:
            offsets.append(_torque_offset(torque[:, k], link[:, k], velocity[:, k]))
    doubtful = {
        joint: scale for joint, scale in scales.items() if 1 / _NO_TORQUE < scale < _NO_TORQUE
    }
    hopeless = {joint: scale for joint, scale in scales.items() if joint not in doubtful}
    text = (
        "{where} reads {size} times what the model needs: unit, gear ratio or torque constant is wrong, or the model's masses; "
        "friction cannot be told in its unit"
    )
    yield from remarks("torque_scale", "untrustworthy", channel, hopeless, "1", text)
    yield from remarks("torque_scale", "warning", channel, doubtful, "1", text)
    text = (
        "{where} saturates at {size} and follows the velocity rather than what the model needs: this is PWM or voltage, not a "
        "torque; a motor model makes a torque of it, without one no effect found here is mechanical"
    )
    yield from remarks("not_a_torque", "untrustworthy", channel, duty, "1", text)
    if offsets and abs(offset := float(np.median(offsets))) > 0.5:
        seconds = offset * motion.length * motion.period
        agree = np.mean(np.abs(np.array(offsets) - offset) < 0.5) > 0.7
        if agree and offset > 0:
            yield from _clock(
                evidence, channel, seconds / evidence.period, 1.0, "the motion that it makes"
            )
        elif agree:
            text = (
                f"the motion follows {-1e3 * seconds:.3g} ms behind it; this can be the robot's own delay or lag (TorqueDelay, "
                "TorqueLag) as well as its clocks"
            )
            yield remark("command_ahead", "note", channel, -seconds, "s", text)


def _torque_offset(torque: np.ndarray, link: np.ndarray, velocity: np.ndarray) -> float:
    """By how many blocks a torque comes later than the motion that it makes."""
    lags = np.arange(-5, 6)
    inner = slice(5, len(torque) - 5)
    left = np.array(
        [
            1 - _fit_torque(np.roll(torque, -lag)[inner], link[inner], velocity[inner]).explained
            for lag in lags
        ]
    )
    best = int(left.argmin())
    if not 0 < best < len(lags) - 1 or left[best] > (1 - _WORTHWHILE) * left[5]:
        return float(lags[best]) if left[best] <= (1 - _WORTHWHILE) * left[5] else 0.0
    before, here, after = left[best - 1 : best + 2]
    return float(lags[best] + 0.5 * (before - after) / (before - 2 * here + after))


def check_dead_joints(evidence: Evidence) -> Iterable[HygieneFinding]:
    """Joints that do not move, and torques that do not answer."""
    motion = evidence.motion
    resting = np.ptp(evidence.log["joint/position"], axis=0) < np.maximum(
        STILL, 3 * evidence.quantum["joint/position"]
    )
    at_rest = {
        joint: float(np.ptp(evidence.log["joint/position"][:, k]))
        for k, joint in enumerate(evidence.joints)
        if resting[k]
    }
    text = "{where} does not move ({size}); nothing can be said of its friction"
    yield from remarks(
        "no_motion", "note", "joint/position", at_rest, evidence.units["joint/position"], text
    )
    if "joint/torque_command" not in evidence.log:
        return
    torque = evidence.log["joint/torque_command"]
    floor = np.nan_to_num(motion.residual.noise_floor[: len(evidence.joints)])
    needed = evidence.link_torque.std(axis=0)
    dead = {
        joint: float(np.ptp(torque[:, k]))
        for k, joint in enumerate(evidence.joints)
        if needed[k] > 10 * floor[k]
        and needed[k] > 0
        and np.ptp(torque[:, k]) < 0.05 * np.ptp(evidence.link_torque[:, k])
    }
    text = "{where} moves but its torque does not ({size}); the channel is dead, whatever is found in this joint"
    yield from remarks(
        "dead_torque",
        "untrustworthy",
        "joint/torque_command",
        dead,
        evidence.units["joint/torque_command"],
        text,
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

    def swapped(names: Iterable[str], first: list[int], second: list[int]) -> Instants:
        order = np.arange(n)
        order[first], order[second] = second, first
        return replace(at, **{name: getattr(at, name)[:, order] for name in names})

    before = score(at)
    angles = ("joint_position", "joint_velocity", "joint_acceleration")
    for channels, what in (
        (angles, "joint/position and joint/velocity"),
        (("torque_command",), "joint/torque_command"),
        ((*angles, "torque_command"), "joint/*"),
    ):
        if "torque_command" in channels and "joint/torque_command" not in evidence.log:
            continue
        after, (first, second) = min(
            ((score(swapped(channels, *pair)), pair) for pair in pairs),
            key=lambda one: one[0],
            default=(np.inf, ([], [])),
        )
        if after < _SWAPPED * before:
            names = [evidence.joints[k] for k in (*first, *second)]
            text = (
                f"with {' and '.join(names) if len(names) == 2 else 'the legs'} in each other's place the error falls to "
                f"{100 * np.sqrt(after / before):.0f} %; they are swapped, and whatever is found in them is wrong"
            )
            yield remark("swapped_joints", "untrustworthy", what, after / before, "1", text, names)
            return


def _zero_prediction(motion: RecordedMotion, at: Instants) -> np.ndarray:
    """What the rows would be without a model: torques, wrench of the feet; the scale of each row. (B, R)"""
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
            f"the feet carry {abs(excess):.3g} N ({100 * abs(share):.2g} %) {more} than the model's masses need; {kilograms:.2g} kg {more} "
            "and a gain that all force sensors share explain this alike, and no motion tells them apart"
        )
        yield remark("weight", "warning", "foot/<side>", excess, "N", text)


def _tilt(vector: np.ndarray, axis: int) -> float:
    """Angle by which a force leans towards x (0) or y (1) [rad]."""
    return float(np.arctan2(vector[axis], vector[2]))


def check_force_frames(evidence: Evidence) -> Iterable[HygieneFinding]:
    """While one foot alone carries the robot, its force is what the masses need: in its mean direction, and in its course."""
    if not evidence.robot.has_floating_base:
        return
    motion, n = evidence.motion, len(evidence.joints)
    at, (required, _) = motion.blocks, evidence.over_blocks
    kinematic = motion.equation.residual(at)[:, n + 6 :]
    for foot, (side, R_BF) in enumerate(
        zip(evidence.sides, motion.equation.sole_rotations(at), strict=True)
    ):
        alone = np.all(
            [evidence.aloft[other] for other in range(len(evidence.sides)) if other != foot], axis=0
        )
        if len(evidence.sides) < 2 or alone.sum() < _FEWEST:
            continue
        needed = np.einsum("mij,mi->mj", R_BF[alone], required[alone, 3:])
        measured = evidence.wrenches[foot][alone, 3:]
        # Does the sole stand level, by IMU and angles? Its specific force says so.
        tilt = kinematic[alone, 6 * foot + 3 : 6 * foot + 5].mean(axis=0)
        level = np.hypot(*tilt) / motion.equation.gravity < _TILT
        lean = {
            axis: _tilt(measured.mean(axis=0), k) - _tilt(needed.mean(axis=0), k)
            for k, axis in enumerate("xy")
        }
        lean = {f"force_{axis}": angle for axis, angle in lean.items() if abs(angle) > _TILT}
        cause = (
            "stands level by IMU and angles, so that it is the force sensor's frame or cross-talk"
            if level
            else "seems tilted too"
        )
        text = (
            "{where} leans {size} from what gravity and motion need, with the load; the sole "
            + cause
            + ", and not the masses"
        )
        yield from remarks("force_frame", "warning", f"foot/{side}", lean, "rad", text)
        against = {}
        for k, axis in enumerate("xyz"):
            correlation = _correlation(needed[:, k], measured[:, k])
            if correlation < -0.2 and needed[:, k].std() > _AIR * motion.equation.weight:
                against[f"force_{axis}"] = correlation
        text = (
            "{where} moves against what the motion needs while this foot alone carries the robot (correlation {size}); its sign or "
            "calibration is wrong, and so is what is found in the base's rows that it enters"
        )
        yield from remarks(
            "force_against_motion", "untrustworthy", f"foot/{side}", against, "1", text
        )


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
        text = "{where} reads {size} while the foot is in the air; the sensor has an offset (FootForceBias)"
        yield from remarks("air_reading", "warning", f"foot/{side}", found, "N", text)


def check_gravity(evidence: Evidence) -> Iterable[HygieneFinding]:
    """In the mean the accelerometer reads gravity."""
    if not evidence.robot.has_floating_base:
        return
    equation = evidence.motion.equation
    mean = float(np.linalg.norm(evidence.motion.signals.specific_force.mean(axis=0)))
    if abs(mean / equation.gravity - 1) > _GRAVITY:
        text = f"its mean is {mean:.3f} m/s^2, gravity is {equation.gravity:.2f}; bias or scale of the accelerometer looks like mass"
        yield remark(
            "gravity", "warning", "imu/linear_acceleration", mean - equation.gravity, "m/s^2", text
        )


CHECKS = (
    check_velocity_clock,
    check_gyro_clock,
    check_force_clock,
    check_torque,
    check_dead_joints,
    check_swapped_joints,
    check_weight,
    check_force_frames,
    check_feet_in_the_air,
    check_gravity,
)
