"""Checks of the torques: is the machine set up otherwise, is the channel dead, its sign reversed or
lost, its unit wrong, its clock off, is it a torque at all?

Nothing is asserted that friction, inertia, a counterbalance, an encoder offset or a load could
explain as well; see `torque_readings`. All tests together call a good log wrong with the
probability `torque_readings.FALSE_ALARM`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from fbse_drake.discrepancy.hygiene.channel_checks import CLIPPED_SHARE
from fbse_drake.discrepancy.hygiene.setup_check import Setup, other_setups
from fbse_drake.discrepancy.hygiene.torque_readings import (
    FALSE_ALARM,
    TRANSITION,
    JointTorques,
    Reading,
    causes_of,
    chance,
    gain,
)
from fbse_drake.discrepancy.residual.evidence import (
    Evidence,
    HygieneFinding,
    Severity,
    remark,
    remarks,
)
from fbse_drake.effects.actuation import TorqueReadingLag

CHANNEL = "joint/torque_command"
# Tests of each joint: the setup is another, its sign is reversed or lost, it is dead, its unit or
# its clock is wrong.
_TESTS = 6
# A torque in another unit is off by more than this factor; by more than the smaller one its scale
# is doubtful.
_ANOTHER_UNIT, _DOUBTFUL = 3.0, 1.3
# A dead channel varies by less than this share of what the model needs; the torque of the other
# sign, of one whose sign was lost, too.
_DEAD = 0.05
# Another reading of a torque leaves at most this share of what the recorded one leaves.
_BETTER = 0.8
# What the model needs is this many times the sensors' noise, or nothing is said.
_VISIBLE = 2.0
# Largest clock offset that one joint may have by itself and that all may have [blocks], and the
# smallest that counts [samples, blocks].
_LARGEST_OFFSET, _LARGEST_OF_ALL, _SMALLEST_OFFSET = 5, 40, (1.5, 0.25)
# What the model needs, in another unit and with friction, explains at least so much of a torque's
# variance.
_EXPLAINED = 0.5
# A PWM follows the velocity: more than this share of its variance.
_BY_VELOCITY = 0.3


@dataclass
class _Found:
    """What the tests say, by joint."""

    reversed: dict[str, float] = field(default_factory=dict)
    lost: dict[str, float] = field(default_factory=dict)
    dead: dict[str, float] = field(default_factory=dict)
    duty: dict[str, float] = field(default_factory=dict)
    scale: dict[str, float] = field(default_factory=dict)
    # Scales that are as well explained by what the causes say.
    open_scale: dict[str, float] = field(default_factory=dict)
    causes: dict[str, None] = field(default_factory=dict)


def check_torque(evidence: Evidence) -> Iterable[HygieneFinding]:
    """What is wrong with the torques, joint by joint."""
    if CHANNEL not in evidence.log:
        return
    torques, found = JointTorques(evidence), _Found()
    motors = np.flatnonzero(evidence.robot.description.has_motor).tolist()
    tested = [k for k in motors if _is_visible(evidence, torques, k)]
    setups = other_setups(evidence, motors, level(torques))
    if setups:
        yield from map(_setup_finding, setups)
        return
    for k in tested:
        _test(evidence, torques, k, found)
    yield from _findings(evidence, found)
    wrong = {*found.reversed, *found.lost, *found.dead, *found.duty}
    yield from _clock(evidence, torques, [k for k in tested if evidence.joints[k] not in wrong])


def _setup_finding(setups: Sequence[Setup]) -> HygieneFinding:
    """The best of several setups, and those that are as good."""
    best = setups[0]
    text = "; or ".join(setup.text for setup in setups)
    text += "; what the model needs is wrong in all joints"
    return remark(best.kind, "untrustworthy", CHANNEL, best.size, best.unit, text)


def _is_visible(evidence: Evidence, torques: JointTorques, k: int) -> bool:
    floor = np.nan_to_num(evidence.motion.residual.noise_floor[k])
    needed = torques.needed[torques.known[:, k], k]
    return len(needed) > 0 and bool(needed.std() > max(_VISIBLE * floor, 1e-9))


def level(torques: JointTorques) -> float:
    """Probability of a false alarm that each single test may have."""
    return FALSE_ALARM / (_TESTS * torques.torque.shape[1])


def _test(evidence: Evidence, torques: JointTorques, k: int, found: _Found) -> None:
    joint, raw, known = evidence.joints[k], evidence.log[CHANNEL][:, k], torques.known[:, k]
    torque = torques.torque[known, k]

    def is_better(rival: Reading, recorded: Reading) -> bool:
        return _is_better(torques, k, rival, recorded)

    def wins(everything: bool) -> str:
        """Which other reading is believed, if any."""
        columns = torques.columns(k, everything=everything)
        needed = torques.needed[known, k].std()
        as_recorded = torques.as_recorded(k, columns)
        if torque.std() < _DEAD * needed and is_better(torques.nothing(k), as_recorded):
            return "dead"
        scaled, turned = torques.scaled(k, columns), torques.scaled(k, columns, sign=-1.0)
        # The other sign is that of what the model needs, not of a spring that moves alike.
        shown = turned.amounts[-1] * needed > _DEAD * torque.std()
        if shown and is_better(turned, scaled):
            return "reversed"
        if (
            _has_one_sign(raw)
            and torques.needs_both_signs(k)
            and is_better(torques.without_sign(k, columns), scaled)
        ):
            return "lost"
        return ""

    verdict = wins(everything=False) and wins(everything=True)
    if verdict == "dead":
        found.dead[joint] = float(np.ptp(raw))
    elif verdict == "reversed":
        found.reversed[joint] = -torques.scaled(k, torques.columns(k), sign=-1.0).amounts[-1]
    elif verdict == "lost":
        found.lost[joint] = float(np.abs(raw).max())
    elif _is_duty(evidence, torques, k):
        found.duty[joint] = float(np.abs(raw).max())
    else:
        _test_scale(torques, k, joint, found)


def _has_one_sign(raw: np.ndarray) -> bool:
    """Does a torque never change its sign, but for noise?"""
    size = np.sqrt((raw**2).mean())
    return any(np.sqrt((part**2).mean()) < _DEAD * size for part in (raw.clip(0), raw.clip(max=0)))


def _is_duty(evidence: Evidence, torques: JointTorques, k: int) -> bool:
    """Does a channel saturate and follow the velocity rather than what the model needs?"""
    raw = evidence.log[CHANNEL][:, k]
    if not (np.abs(raw) == np.abs(raw).max()).mean() > CLIPPED_SHARE:
        return False
    known = evidence.known[:, k]
    torque, v = torques.torque[known, k], evidence.motion.blocks.joint_velocity[known, k]
    needed, one = torques.needed[known, k], np.ones(len(torque))

    def explained(*columns: np.ndarray) -> tuple[float, np.ndarray]:
        X = np.stack([*columns, one], axis=1)
        amounts = np.linalg.lstsq(X, torque)[0]
        return 1 - float((torque - X @ amounts).var() / max(torque.var(), 1e-300)), amounts

    direction = np.tanh(v / TRANSITION)
    by_velocity, by_model = explained(v, direction)[0], explained(needed)[0]
    scale = explained(needed, v, direction)[1][0]
    another_unit = not 1 / _ANOTHER_UNIT < scale < _ANOTHER_UNIT
    return another_unit and by_velocity > max(by_model, _BY_VELOCITY)


def _test_scale(torques: JointTorques, k: int, joint: str, found: _Found) -> None:
    simple = torques.columns(k)
    simple = simple.part([cause in ("a bias", "friction") for cause in simple.causes])
    scaled = torques.scaled(k, simple)
    torque = torques.torque[torques.known[:, k], k]
    if scaled.left.var() > (1 - _EXPLAINED) * torque.var():
        return
    if not _off(scaled.amounts[-1], torques.largest_scale(k, simple)):
        return
    if not _is_better(torques, k, scaled, torques.as_recorded(k, simple)):
        return
    columns = torques.columns(k, everything=True)
    recorded, rival = torques.as_recorded(k, columns), torques.scaled(k, columns)
    is_off = _off(rival.amounts[-1], torques.largest_scale(k, columns))
    if is_off and _is_better(torques, k, rival, recorded):
        found.scale[joint] = float(scaled.amounts[-1])
    else:
        found.open_scale[joint] = float(scaled.amounts[-1])
        found.causes |= dict.fromkeys(causes_of(recorded, columns, torques.known[:, k]))


def _is_better(torques: JointTorques, k: int, rival: Reading, recorded: Reading) -> bool:
    """Is another reading of a joint's torque significantly likelier than the recorded one, and does
    it leave less to speak of?"""
    if not rival.left.std() < _BETTER * recorded.left.std():
        return False
    return chance(gain(recorded.left, rival.left), torques.stretches(k)) < level(torques)


def _off(least: float, largest: float) -> bool:
    """Is a scale between these off by more than a doubtful factor?"""
    return largest < 1 / _DOUBTFUL or least > _DOUBTFUL


def _findings(evidence: Evidence, found: _Found) -> Iterable[HygieneFinding]:
    units = evidence.units[CHANNEL]
    text = (
        "{where} moves but its torque does not ({size}); the channel is dead, or nothing drives "
        "the joint (then it is `passive` in the robot's description)"
    )
    yield from remarks("dead_torque", "untrustworthy", CHANNEL, found.dead, units, text)
    if found.lost:
        # A torque of one sign is not told from its reverse.
        found.lost |= dict.fromkeys(found.reversed, 0.0)
        found.reversed = {}
    text = "{where} pulls against what the model needs ({size} times); its sign is reversed"
    yield from remarks("torque_sign", "untrustworthy", CHANNEL, found.reversed, "1", text)
    text = (
        "{where} never changes its sign, though what the model needs does (up to {size}); only "
        "the absolute value was recorded: its sign is lost"
    )
    yield from remarks("torque_sign", "untrustworthy", CHANNEL, found.lost, units, text)
    text = (
        "{where} saturates at {size} and follows the velocity rather than what the model needs: "
        "this is PWM or voltage, not a torque; a motor model makes a torque of it, without one no "
        "effect found here is mechanical"
    )
    yield from remarks("not_a_torque", "untrustworthy", CHANNEL, found.duty, units, text)
    doubtful = {j: s for j, s in found.scale.items() if 1 / _ANOTHER_UNIT < s < _ANOTHER_UNIT}
    hopeless = {j: s for j, s in found.scale.items() if j not in doubtful}
    text = (
        "{where} reads {size} times what the model needs: unit, gear ratio or torque constant is "
        "wrong, or the model's masses; friction cannot be told in its unit"
    )
    yield from remarks("torque_scale", "untrustworthy", CHANNEL, hopeless, "1", text)
    yield from remarks("torque_scale", "warning", CHANNEL, doubtful, "1", text)
    text = (
        "{where} reads {size} times what the model needs; this may be its scale, but "
        + " or ".join(found.causes)
        + " that the model lacks would look the same"
    )
    yield from remarks("torque_or_model", "note", CHANNEL, found.open_scale, "1", text)


def _clock(
    evidence: Evidence, torques: JointTorques, places: list[int]
) -> Iterable[HygieneFinding]:
    """Torques that come before or after the motion that they make."""
    offsets = {evidence.joints[k]: _lateness(evidence, torques, k) for k in places}
    # By itself no joint has a clock that is off so far: something else is wrong with it.
    largest = _LARGEST_OFFSET * evidence.motion.length * evidence.period
    far = [joint for joint, seconds in offsets.items() if abs(seconds) > largest]
    if len(far) <= 0.5 * len(places):
        offsets |= dict.fromkeys(far, 0.0)
    late = {joint: seconds for joint, seconds in offsets.items() if seconds > 0}
    early = [-seconds for seconds in offsets.values() if seconds < 0]
    if late:
        where = () if len(late) > 0.5 * len(places) else tuple(late)
        seconds = float(np.median([*late.values()]))
        # A clock is that of all joints.
        cause = (
            "by its clock, by a filter before it was recorded or by a transmission that gives way"
            if where
            else "by its clock or by a filter before it was recorded, for no mechanism does that"
        )
        text = (
            f"{', '.join(where)}{' ' if where else ''}comes {1e3 * seconds:.3g} ms late against "
            f"the motion that it makes, {cause}; accelerations will look like friction and the "
            "other way round"
        )
        # A short one is looked for as an effect.
        motion = evidence.motion
        severity: Severity = "untrustworthy"
        is_sampled = motion.recording.is_sampled
        if is_sampled and seconds <= motion.length * motion.period:
            severity = "warning"
            text += f"; {TorqueReadingLag.__name__} allows for it"
        yield remark("clock_offset", severity, CHANNEL, seconds, "s", text, where)
    if early:
        seconds = float(np.median(early))
        text = (
            f"the motion follows {1e3 * seconds:.3g} ms behind it; this can be the robot's own "
            "delay or lag (TorqueDelay, TorqueLag) as well as its clocks"
        )
        yield remark("command_ahead", "note", CHANNEL, seconds, "s", text)


def _lateness(evidence: Evidence, torques: JointTorques, k: int) -> float:
    """By how much a torque is late [s], negative if it is early; 0 where that is not sure, and
    where nothing within reach or the other sign fits best."""
    columns, length = torques.columns(k), evidence.motion.length
    stretch = torques.stretches(k)
    for largest in (_LARGEST_OFFSET, _LARGEST_OF_ALL):
        if len(stretch) <= 4 * largest:
            return 0.0
        inner = slice(largest, len(stretch) - largest)
        offsets = [length * k for k in range(-largest, largest + 1)]
        left = [torques.late(k, columns, samples).left[inner] for samples in offsets]
        spread = [one.var() for one in left]
        best = int(np.argmin(spread))
        if 0 < best < len(offsets) - 1:
            break
    else:
        return 0.0
    before, here, after = spread[best - 1 : best + 2]
    samples = offsets[best] + 0.5 * length * float((before - after) / (before - 2 * here + after))
    if abs(samples) < max(_SMALLEST_OFFSET[0], _SMALLEST_OFFSET[1] * length):
        return 0.0
    if torques.scaled(k, columns, sign=-1.0).left[inner].var() < here:
        return 0.0
    gains = gain(left[largest], torques.late(k, columns, round(samples)).left[inner])
    # The best of several is the best by chance more often than one.
    sure = len(offsets) * chance(gains, stretch[inner]) < level(torques)
    return samples * evidence.period if sure else 0.0
