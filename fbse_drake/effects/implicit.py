"""What of the joint torque effects Drake's contact solver takes itself.

As far as the loss in a joint rises with its velocity v, it is replaced by damping and by straight
pieces between corners, concave in |v|. What the pieces leave over is small, and is added explicitly
(`fbse_drake.effects.system`). An effect whose law is not the same in every step has clamps of its
own, which are moved along the velocity: with its memory, or in and out of reach with its size.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque, Rise
from fbse_drake.robot.implicit import ImplicitTorque

# By the number of straight pieces that come closest to tanh(x) for x > 0: by what share of it they
# are off at most, and their corners x. They are as much above it at every corner but the last,
# where they reach 1.
_CORNERS = {
    1: (0.1869, (1.2299,)),
    3: (0.0281, (0.4193, 1.0119, 2.1387)),
    7: (0.0058, (0.1866, 0.4090, 0.6539, 0.9394, 1.3015, 1.8305, 2.9266)),
}
# Pieces of a joint that moves: it passes the steep part of its law in a step or two. Where the law
# falls beyond by more than a single piece is off, more would not show; at so many speeds it is
# looked whether it does.
_PIECES, _FALLING_PIECES, _FALL_SAMPLES = 3, 1, 50
# A joint that stands still, or moves at less than so many times the speed at which its law levels
# off (root mean square), is on the steep part for long: so many pieces.
_SLOW, _SLOW_PIECES = 5.0, 7
# Pieces for one direction alone are left out below this share of those for both.
_ONE_SIDED = 0.01
# Parts of the largest size that an effect has in the planned motion; those in reach of the velocity
# add up to its present size.
_PARTS = np.array([1 / 2, 1 / 4, 1 / 4])
# Clamps are out of reach when they are moved so far [rad/s].
_OUT_OF_REACH = 100.0
# At so many times the speed at which a law levels off, it shows its size.
_LEVEL = 4.0

# A law of n joints: torques [Nm] at velocities [rad/s], (N, n) each.
Law = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class MovingClamps(ABC):
    """Clamps of one effect whose offsets are not the same in every step."""

    # Place of the effect among all.
    effect: int
    # Their rows among all clamps, and their slopes and limits, (rows, n) [Nm s/rad], [Nm].
    rows: slice
    slope: np.ndarray
    limit: np.ndarray

    @abstractmethod
    def offset(self, effect: ResolvedJointTorque, motion: JointMotion) -> np.ndarray:
        """Offsets in a step, (rows, n) [Nm].

        Args:
            motion: what is known of the step when it begins.
        """


class LeaningClamps(MovingClamps):
    """Those of an effect with a memory: at velocity zero its torque has a part of its size."""

    def offset(self, effect: ResolvedJointTorque, motion: JointMotion) -> np.ndarray:
        return effect.effect.lean(np.asarray(motion.memory), effect.nonlinear) * self.limit


@dataclass(frozen=True)
class PartialClamps(MovingClamps):
    """Those of an effect that changes its size: parts, in and out of reach of the velocity."""

    # Which part each row belongs to.
    part: np.ndarray
    # Where the effect shows its size, (n,) [rad/s], and its largest there, (n,) [Nm].
    speed: np.ndarray
    largest: np.ndarray

    def offset(self, effect: ResolvedJointTorque, motion: JointMotion) -> np.ndarray:
        torque = effect.torque_and_slope(motion._replace(velocity=self.speed))[0]
        size = np.divide(torque, self.largest, out=np.zeros_like(torque), where=self.largest > 0)
        left, out = size + 0.5 * _PARTS.min(), np.empty((len(_PARTS), len(size)), dtype=bool)
        for k, part in enumerate(_PARTS):
            out[k] = left < part
            left = left - np.where(out[k], 0.0, part)
        return np.where(out[self.part], self.limit + _OUT_OF_REACH * self.slope, 0.0)


@dataclass(frozen=True)
class ImplicitLaw:
    """Joint torque effects with what Drake's solver takes of them."""

    effects: tuple[ResolvedJointTorque, ...]
    torque: ImplicitTorque
    moving: tuple[MovingClamps, ...] = ()

    @property
    def moves_clamps(self) -> bool:
        """Has any clamp an offset?"""
        return bool(self.moving) or bool(np.any(self.torque.offset))


def implicit_law(effects: Sequence[ResolvedJointTorque], planned: JointMotion) -> ImplicitLaw:
    """What Drake's solver takes of the effects in n joints.

    Args:
        planned: the motion as planned, which decides how finely laws are resolved and how large
            they get: velocity, position and load (N, n), time (N, 1), the plant's step.
    """
    n = planned.velocity.shape[1]
    speed = np.sqrt(np.mean(planned.velocity**2, axis=0))
    typical = JointMotion(speed, time_step=planned.time_step)
    rises = [effect.effect.rise(effect.linear, effect.nonlinear, typical) for effect in effects]
    damping = np.asarray(sum((rise.damping for rise in rises), np.zeros(n)))
    steady = [k for k, effect in enumerate(effects) if effect.effect.of_velocity_alone]

    def law(velocity: np.ndarray) -> np.ndarray:
        torques = (effects[k].torque_and_slope(JointMotion(velocity))[0] for k in steady)
        return sum(torques, np.zeros_like(velocity))

    rise = Rise(
        damping,
        tuple(speed for k in steady for speed in rises[k].speeds),
        tuple(corner for k in steady for corner in rises[k].corners),
    )
    clamps = [_clamps(lambda v: law(v) - damping * v, rise, planned)]
    moving: list[MovingClamps] = []
    for k, (effect, rise) in enumerate(zip(effects, rises, strict=True)):
        if k in steady or not (rise.speeds or rise.corners):
            continue
        make = _leaning if effect.effect.has_memory else _partial
        own, make_moving = make(effect, rise, planned)
        start = sum(part.shape[1] for part in clamps)
        clamps.append(own)
        moving.append(make_moving(k, slice(start, start + own.shape[1]), *own[:2]))
    torque = ImplicitTorque(damping, *np.concatenate(clamps, axis=1))
    return ImplicitLaw(tuple(effects), torque, tuple(moving))


def _leaning(
    effect: ResolvedJointTorque,
    rise: Rise,
    planned: JointMotion,
) -> tuple[np.ndarray, Callable[..., MovingClamps]]:
    """Clamps of an effect with a memory, (3, m, n), and what makes them move."""
    still = JointMotion(np.zeros(planned.velocity.shape[1]), time_step=planned.time_step)
    motion = still._replace(memory=effect.effect.start(still, effect.nonlinear))
    return _clamps(_law(effect, motion), rise, planned), LeaningClamps


def _partial(
    effect: ResolvedJointTorque,
    rise: Rise,
    planned: JointMotion,
) -> tuple[np.ndarray, Callable[..., MovingClamps]]:
    """Clamps of an effect that changes its size, (3, m, n), and what makes them move."""
    level = np.max([*rise.speeds, *rise.corners], axis=0)
    speed = np.broadcast_to(_LEVEL * level, planned.velocity.shape[1])
    at_speed = planned._replace(velocity=np.broadcast_to(speed, planned.velocity.shape))
    torque = effect.torque_and_slope(at_speed)[0]
    strongest = (torque.argmax(axis=0), np.arange(torque.shape[1]))
    names = ("position", "time", "load")
    known = (np.broadcast_to(getattr(planned, name), torque.shape) for name in names)
    fields = {name: values[strongest] for name, values in zip(names, known, strict=True)}
    whole = _clamps(_law(effect, planned._replace(**fields)), rise, planned)
    moving = partial(
        PartialClamps,
        part=np.repeat(np.arange(len(_PARTS)), whole.shape[1]),
        speed=speed,
        largest=torque[strongest],
    )
    return np.concatenate([part * whole for part in _PARTS], axis=1), moving


def _law(effect: ResolvedJointTorque, motion: JointMotion) -> Law:
    """The law of one effect in a motion of one step, (n,), but for its velocity."""
    return lambda velocity: effect.torque_and_slope(motion._replace(velocity=velocity))[0]


def _clamps(law: Law, rise: Rise, planned: JointMotion) -> np.ndarray:
    """Slopes, limits and offsets of clamps that follow a law, (3, m, n).

    Args:
        law: of n joints, without damping.
        rise: where it levels off.
        planned: the motion as planned.
    """
    n, columns = planned.velocity.shape[1], []
    for j in range(n):

        def of_joint(velocity: np.ndarray, j: int = j) -> np.ndarray:
            return law(np.broadcast_to(velocity[:, None], (len(velocity), n)))[:, j]

        def at_joint(values: tuple[np.ndarray, ...], j: int = j) -> np.ndarray:
            return np.array([np.broadcast_to(value, n)[j] for value in values])

        speeds, sharp = at_joint(rise.speeds), at_joint(rise.corners)
        speeds = speeds[np.isfinite(speeds)]
        pieces = _pieces_needed(of_joint, speeds, np.abs(planned.velocity[:, j]))
        columns.append(_joint_clamps(of_joint, speeds, sharp, *_CORNERS[pieces]))
    clamps = np.zeros((3, max(map(len, columns)), n))
    for j, column in enumerate(columns):
        clamps[:, : len(column), j] = np.reshape(column, (-1, 3)).T
    return clamps


def _pieces_needed(
    law: Callable[[np.ndarray], np.ndarray],
    speeds: np.ndarray,
    planned: np.ndarray,
) -> int:
    """How many pieces a joint gets.

    Args:
        law: of the joint, takes and gives (N,).
        speeds: where it levels off [rad/s].
        planned: speeds of the planned motion, (N,) [rad/s].
    """
    if len(speeds) > 0 and math.sqrt(np.mean(planned**2)) < _SLOW * speeds.min():
        return _SLOW_PIECES
    level = _LEVEL * np.max(speeds, initial=0.0)
    torque = law(np.linspace(level, max(level, planned.max()), _FALL_SAMPLES))
    share, _ = _CORNERS[1]
    return _FALLING_PIECES if torque[0] - torque.min() > share * torque[0] else _PIECES


def _joint_clamps(
    law: Callable[[np.ndarray], np.ndarray],
    speeds: np.ndarray,
    sharp: np.ndarray,
    share: float,
    at: Sequence[float],
) -> list[tuple[float, float, float]]:
    """Slope, limit and offset of each clamp of one joint, whose law takes and gives (N,).

    Args:
        speeds, sharp: where it levels off, and its corners.
        share, at: of so many pieces, see `_CORNERS`.
    """
    raised = np.append(np.full(len(at) - 1, 1.0 + share), 1.0 / np.tanh(at[-1]))
    corner = np.concatenate([sharp, np.multiply.outer(speeds, at).ravel()])
    raised = np.concatenate([np.ones(len(sharp)), np.tile(raised, len(speeds))])
    order = np.argsort(corner)
    corner, raised = corner[order], raised[order]
    forwards, backwards = raised * law(corner), -raised * law(-corner)
    both = _pieces(corner, np.minimum(forwards, backwards))
    clamps = [(slope, limit, 0.0) for slope, limit in both]
    pieces = (np.minimum(slope * corner, limit) for slope, limit in both)
    shared = sum(pieces, np.zeros_like(corner))
    least = _ONE_SIDED * np.max(shared, initial=0.0)
    for sign, side in ((1.0, forwards - shared), (-1.0, backwards - shared)):
        if np.max(side, initial=0.0) > least:
            # From zero to twice the limit, in one direction.
            further = _pieces(corner, side)
            clamps += [(slope, limit / 2, -sign * limit / 2) for slope, limit in further]
    return clamps


def _pieces(corner: np.ndarray, torque: np.ndarray) -> list[tuple[float, float]]:
    """Slopes and limits of the terms min(slope v, limit) whose sum is the upper concave hull of the
    origin and points (v, torque), as far as it rises."""
    hull = [(0.0, 0.0)]
    for point in zip(corner.tolist(), torque.tolist(), strict=True):
        if point[0] <= hull[-1][0] or point[1] <= hull[-1][1]:
            continue
        while len(hull) > 1 and _slope(hull[-1], point) >= _slope(hull[-2], hull[-1]):
            hull.pop()
        hull.append(point)
    slopes = [*(_slope(start, end) for start, end in pairwise(hull)), 0.0]
    bends = [before - after for before, after in pairwise(slopes)]
    return [(bend, bend * v) for bend, (v, _) in zip(bends, hull[1:], strict=True)]


def _slope(start: tuple[float, float], end: tuple[float, float]) -> float:
    return (end[1] - start[1]) / (end[0] - start[0])
