"""Check of the setup of a machine on a fixed base: is it mounted, and do its joints count their
angles, as the model says?

A machine on a wall whose model stands upright, or a joint that counts its angle the other way or
from another zero, has torques that look like wrong signs and scales in one joint after the other.
One setup that explains the torques of all joints is likelier than any of that. Readings are
compared as in `torque_readings`.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.multibody.tree import RevoluteJoint
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation

from fbse_drake.discrepancy.hygiene.torque_readings import (
    STRETCH,
    JointTorques,
    Reading,
    chance,
    gain,
)
from fbse_drake.discrepancy.residual.evidence import Evidence
from fbse_drake.effects.geometry import BaseTilt
from fbse_drake.effects.sensor import EncoderOffset
from fbse_drake.robot.plant import slope_of_gravity

# A torque of which the model's setup leaves no more than this share of its variance is explained.
_UNEXPLAINED = 0.05
# Another setup leaves at most this share of the variance of what any other reading of such torques
# leaves, in the mean of the joints.
_BETTER = 0.5
# Setups that are worse than the best by chance more often than this are as good.
_AS_GOOD = 0.01
# Averages without which nothing is said of a joint.
_FEWEST = 20
# What is left of an exact log is rounding, as a share of the torque.
_ROUNDING = 1e-9
# How often another setup is looked for beside one that was found.
_MOST_SETUPS = 3
# Averages in a stretch of time: longer ones than elsewhere, for gravity is slow.
_IN_A_STRETCH = 2
# Tilts and offsets below this are looked for as effects, about the model's setup [rad].
_LARGE_TILT, _LARGE_OFFSET = 0.35, 0.3
# Angles that are tried [rad].
_ANGLES = 2 * np.pi / 12 * np.arange(12)


@dataclass(frozen=True)
class Setup:
    """Another setup than the model's, and the torques that it explains."""

    kind: str
    text: str
    size: float
    unit: str
    torques: JointTorques


def other_setups(evidence: Evidence, places: Sequence[int], level: float) -> list[list[Setup]]:
    """What is set up otherwise than the model says, where that explains the torques far better;
    each with what would explain them as well, the best first.

    Args:
        places: of joints whose torque is looked at.
        level: largest probability of a false alarm.
    """
    if evidence.robot.has_floating_base:
        return []
    duration = evidence.motion.length * evidence.period
    length = max(1, round(STRETCH / duration / _IN_A_STRETCH))
    torques = JointTorques(evidence, length=length)
    moved = (torques.known.sum(axis=0) >= _FEWEST) & (np.ptp(torques.torque, axis=0) > 0)
    places = [k for k in places if moved[k]]
    before, unexplained = {k: _best_reading(torques, k) for k in places}, None
    found: list[list[Setup]] = []
    chain: list[list[Setup]] = []
    while len(chain) < _MOST_SETUPS and (missed := _unexplained(torques, places)):
        unexplained = unexplained or missed
        alternatives = list(_alternatives(evidence, torques, places))
        best = min(alternatives, key=lambda setup: _size_left(setup.torques, places))
        after = _readings(best.torques, places)
        if _chance(best.torques, _readings(torques, places), after) > _AS_GOOD:
            break
        as_good = [
            setup
            for setup in alternatives
            if setup is not best
            and _chance(best.torques, _readings(setup.torques, places), after) > _AS_GOOD
        ]
        chain.append([best, *as_good])
        torques, level = best.torques, level / len(alternatives)
        # Several at a time have to explain everything.
        if (len(chain) == 1 or not _unexplained(torques, places)) and _is_better(
            torques, before, unexplained, level
        ):
            found = list(chain)
    return found


def _readings(torques: JointTorques, places: Sequence[int]) -> dict[int, Reading]:
    """Torques as recorded, with what a machine may have beside its model."""
    return {k: torques.as_recorded(k, torques.columns(k)) for k in places}


def _best_reading(torques: JointTorques, k: int) -> Reading:
    """Of a torque in the model's setup: in its unit or another, of either sign."""
    columns = torques.columns(k)
    readings = [torques.scaled(k, columns, sign=sign) for sign in (1.0, -1.0)]
    return min(readings, key=lambda reading: float(reading.left.var()))


def _size_left(torques: JointTorques, places: Sequence[int]) -> float:
    """What is left of the torques, as logarithm."""
    readings = _readings(torques, places)
    return sum(float(np.log(reading.left.var() + 1e-300)) for reading in readings.values())


def _unexplained(torques: JointTorques, places: Sequence[int]) -> list[int]:
    """Joints of whose torque more than a small share is left."""
    return [
        k
        for k, reading in _readings(torques, places).items()
        if reading.left.var() > _UNEXPLAINED * torques.torque[torques.known[:, k], k].var()
    ]


def _is_better(
    torques: JointTorques, before: dict[int, Reading], unexplained: Sequence[int], level: float
) -> bool:
    """Is another setup significantly likelier, and leaves it much less of what was unexplained?"""
    after = _readings(torques, list(before))
    shares = [after[k].left.var() / max(before[k].left.var(), 1e-300) for k in unexplained]
    return bool(np.mean(shares) < _BETTER) and _chance(torques, before, after) < level


def _chance(torques: JointTorques, before: dict[int, Reading], after: dict[int, Reading]) -> float:
    """Probability that readings of all torques seem so much likelier than others by chance."""
    gains = np.concatenate([gain(before[k].left, after[k].left) for k in before])
    return chance(gains, np.concatenate([torques.stretches(k) for k in before]))


def _alternatives(
    evidence: Evidence, torques: JointTorques, places: Sequence[int]
) -> Iterator[Setup]:
    yield from _other_gravity(evidence, torques, places)
    for joint in range(len(evidence.joints)):
        yield from _other_direction(evidence, torques, joint)
        model = evidence.robot.plant.GetJointByName(evidence.joints[joint])
        if isinstance(model, RevoluteJoint):
            yield from _other_zero(evidence, torques, joint, places)


def _other_gravity(
    evidence: Evidence, torques: JointTorques, places: Sequence[int]
) -> Iterator[Setup]:
    """A machine that is mounted elsewhere, or whose torques are without those of gravity."""
    text = (
        "torques are without what gravity needs, as where a controller takes off what it "
        "compensates"
    )
    yield Setup("without_gravity", text, 0.0, "1", torques.under(np.zeros(3)))
    believed = evidence.robot.plant.gravity_field().gravity_vector()
    gravity = _fitted_gravity(torques, places, float(np.linalg.norm(believed)))
    tilt = slope_of_gravity(gravity)
    angle = float(np.arccos(np.clip(gravity @ believed / (believed @ believed), -1.0, 1.0)))
    if angle < _LARGE_TILT:
        return
    text = (
        f"gravity pulls from elsewhere than the model says, by {np.degrees(angle):.0f} deg, as on "
        f"another mount ({BaseTilt.__name__} with x: {tilt[0]:.3g} and y: {tilt[1]:.3g} among the "
        "model's effects allows for it)"
    )
    yield Setup("mount", text, angle, "rad", torques.under(gravity))


def _fitted_gravity(torques: JointTorques, places: Sequence[int], strength: float) -> np.ndarray:
    """Gravity of this strength [m/s^2] from where it fits best, (3,): least squares of all joints,
    each weighed by what is left of it, beside whatever else its torque may consist of."""
    values, targets = [], []
    for k in places:
        known, beside = torques.known[:, k], torques.columns(k).values
        missing = (torques.torque - torques.needed)[known, k]
        pulls = -torques.per_gravity[known, k]
        q, _ = np.linalg.qr(beside[known] / np.linalg.norm(beside[known], axis=0).clip(1e-300))
        missing, pulls = (part - q @ (q.T @ part) for part in (missing, pulls))
        left = missing - pulls @ np.linalg.lstsq(pulls, missing)[0]
        deviation = float(left.std()) + _ROUNDING * float(np.abs(torques.torque[known, k]).max())
        values.append(pulls / deviation)
        targets.append(missing / deviation)
    # With the same squares in three rows.
    q, r = np.linalg.qr(np.concatenate(values))
    target = q.T @ np.concatenate(targets)

    def gravity(angles: np.ndarray) -> np.ndarray:
        return strength * Rotation.from_euler("yz", angles).apply([0.0, 0.0, -1.0])

    def misfit(angles: np.ndarray) -> float:
        return float(np.linalg.norm(target - r @ (gravity(angles) - torques.gravity)))

    start = min(map(np.array, itertools.product(_ANGLES[:7], _ANGLES)), key=misfit)
    return gravity(minimize(misfit, start, method="Nelder-Mead").x)


def _other_direction(evidence: Evidence, torques: JointTorques, joint: int) -> Iterator[Setup]:
    """A joint that counts its angle the other way, and its torque with it or not."""
    name, at = evidence.joints[joint], torques.blocks
    motion = ("joint_position", "joint_velocity", "joint_acceleration")
    for turned, what in ((motion, "angle"), ((*motion, "torque_command"), "angle and torque")):
        sign = np.ones(len(evidence.joints))
        sign[joint] = -1.0
        changed = replace(at, **{field: sign * getattr(at, field) for field in turned})
        text = f"{name} counts its {what} the other way than the model does"
        yield Setup("joint_direction", text, -1.0, "1", torques.of(changed))


def _other_zero(
    evidence: Evidence, torques: JointTorques, joint: int, places: Sequence[int]
) -> Iterator[Setup]:
    """A joint that counts its angle from another zero."""

    def turned(offset: float) -> JointTorques:
        position = torques.blocks.joint_position.copy()
        position[:, joint] -= offset
        return torques.of(replace(torques.blocks, joint_position=position))

    def left(offset: float) -> float:
        return _size_left(turned(offset), places)

    coarse = min(_ANGLES, key=left)
    step = _ANGLES[1]
    fine = minimize_scalar(left, bounds=(coarse - step, coarse + step), options={"xatol": 1e-3}).x
    offset = float((fine + np.pi) % (2 * np.pi) - np.pi)
    if abs(offset) < _LARGE_OFFSET:
        return
    name = evidence.joints[joint]
    text = (
        f"{name} counts its angle from another zero than the model does, by "
        f"{np.degrees(offset):.0f} deg ({EncoderOffset.__name__} with offset: {{{name}: "
        f"{offset:.3g}}} among the model's effects allows for it)"
    )
    yield Setup("joint_zero", text, offset, "rad", turned(offset))
