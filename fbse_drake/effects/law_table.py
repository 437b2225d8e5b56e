"""Laws of the velocity alone as tables: a look-up costs a tick far less than the law itself."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque


class LawTable(NamedTuple):
    """Torque loss of each of n joints over its velocity: cubic pieces between 2 K + 1 velocities
    unit * sinh(k * rate), k = -K ... K, that lie densely about zero; straight beyond."""

    # Shape (n,) [rad/s], [1].
    unit: np.ndarray
    rate: np.ndarray
    # Shape (2 K + 1, n) [rad/s], [Nm], [Nm s/rad].
    velocity: np.ndarray
    torque: np.ndarray
    slope: np.ndarray


# Pieces of a table on either side, and its largest velocity [rad/s].
_PIECES, _FASTEST = 600, 100.0
# The velocity about which it begins to spread is this share of the smallest speed at which a law
# levels off, or of that speed where none does [rad/s].
_DENSE, _NO_SPEED = 0.5, 1.0


def law_table(effects: Sequence[ResolvedJointTorque], joints: int) -> LawTable:
    """The sum of effects that depend on the velocity alone."""
    typical = JointMotion(np.zeros(joints))
    rises = [effect.effect.rise(effect.linear, effect.nonlinear, typical) for effect in effects]
    speeds = [np.broadcast_to(speed, joints) for rise in rises for speed in rise.speeds]
    unit = _DENSE * np.min([*speeds, np.full(joints, _NO_SPEED)], axis=0)
    rate = np.arcsinh(_FASTEST / unit) / _PIECES
    velocity = unit * np.sinh(np.arange(-_PIECES, _PIECES + 1)[:, None] * rate)
    torque, slope = np.zeros_like(velocity), np.zeros_like(velocity)
    for effect in effects:
        more = effect.torque_and_slope(JointMotion(velocity))
        torque, slope = torque + more[0], slope + more[1]
    return LawTable(unit, rate, velocity, torque, slope)


@njit(cache=True)
def look_up(table: LawTable, at: np.ndarray) -> np.ndarray:
    """Torque loss at velocities (n,) [rad/s], shape (n,) [Nm]."""
    result = np.empty_like(at)
    last = len(table.velocity) - 2
    for j in range(len(at)):
        k = last // 2 + 1 + math.floor(math.asinh(at[j] / table.unit[j]) / table.rate[j])
        k = min(max(k, 0), last)
        h = table.velocity[k + 1, j] - table.velocity[k, j]
        x = (at[j] - table.velocity[k, j]) / h
        # A chord, and what its ends' slopes differ from it by; straight where x is beyond them.
        rise = table.torque[k + 1, j] - table.torque[k, j]
        a, b = h * table.slope[k, j] - rise, h * table.slope[k + 1, j] - rise
        bend = x * (1 - x) * ((1 - x) * a - x * b)
        if x < 0:
            bend = a * x
        elif x > 1:
            bend = b * (x - 1)
        result[j] = table.torque[k, j] + x * rise + bend
    return result
