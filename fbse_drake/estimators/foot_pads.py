"""Legs and the force sensors under their soles."""

import numpy as np
from numba import njit

from fbse_drake.robot.plant import Robot


class FootPads:
    """Where the force sensors sit, for all P pads of all feet in the order of their readings."""

    def __init__(self, robot: Robot):
        legs = robot.description.legs
        # Places in the sole frame F, shape (P, 3) [m], and to which foot each belongs, shape (P,).
        self.position = np.array([p for side in legs for p in robot.pad_positions(side)]).reshape(-1, 3)
        self.foot = np.array([k for k, leg in enumerate(legs.values()) for _ in leg.pads], dtype=int)


def leg_of_joint(robot: Robot) -> np.ndarray:
    """Which leg each joint belongs to, shape (n,)."""
    legs = list(robot.description.legs.values())
    return np.array([next(k for k, leg in enumerate(legs) if name in leg.joints) for name in robot.joint_names])


@njit(cache=True)
def vertical_loads(force: np.ndarray, pad_foot: np.ndarray, feet: int) -> np.ndarray:
    """Vertical force on each foot, in its sole frame, shape (feet,) [N].

    Args:
        force: on each pad, [x, y, z] pad by pad, at the beginning of a vector [N].
        pad_foot: see `FootPads`.
    """
    load = np.zeros(feet)
    for pad in range(len(pad_foot)):
        load[pad_foot[pad]] += force[3 * pad + 2]
    return load


@njit(cache=True)
def foot_wrenches(force: np.ndarray, pad_position: np.ndarray, pad_foot: np.ndarray, feet: int) -> np.ndarray:
    """Wrench [moment, force] on each foot at the sole's origin in the sole frame, shape (feet, 6) [Nm, N].

    Args:
        force: on each pad, [x, y, z] pad by pad, at the beginning of a vector [N].
        pad_position, pad_foot: see `FootPads`.
    """
    wrench = np.zeros((feet, 6))
    for pad in range(len(pad_foot)):
        foot = wrench[pad_foot[pad]]
        x, y, z = pad_position[pad, 0], pad_position[pad, 1], pad_position[pad, 2]
        fx, fy, fz = force[3 * pad], force[3 * pad + 1], force[3 * pad + 2]
        foot[0] += y * fz - z * fy
        foot[1] += z * fx - x * fz
        foot[2] += x * fy - y * fx
        foot[3] += fx
        foot[4] += fy
        foot[5] += fz
    return wrench
