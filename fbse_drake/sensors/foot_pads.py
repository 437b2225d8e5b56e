"""Legs and the force sensors under their soles.

The wrench of a six-axis sensor is known by forces at the corners of the sole that have this wrench.
"""

import numpy as np
from numba import njit

from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot, grasp_map


class FootPads:
    """Where the force sensors sit, for all P pads of all feet in the order of their readings."""

    def __init__(self, robot: Robot):
        self._robot = robot
        legs = robot.description.legs
        # Places in the sole frame F, shape (P, 3) [m], and to which foot each belongs, shape (P,).
        self.position = np.array([p for side in legs for p in robot.pad_positions(side)]).reshape(
            -1, 3
        )
        self.foot = np.array(
            [k for k, leg in enumerate(legs.values()) for _ in range(leg.points)], dtype=int
        )

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Values of all pads, (..., P, k), by foot."""
        return [
            values[..., self.foot == foot, :] for foot in range(len(self._robot.description.legs))
        ]


def corner_forces(robot: Robot, side: str, wrench: np.ndarray) -> np.ndarray:
    """The smallest forces at the corners of a foot that have a wrench.

    Args:
        wrench: [moment, force] at the sole's origin in the sole frame, (..., 6) [Nm, N].

    Returns:
        In the sole frame, (..., corners, 3) [N].
    """
    forces = wrench @ np.linalg.pinv(grasp_map(robot.pad_positions(side))).T
    return forces.reshape(*wrench.shape[:-1], -1, 3)


def measured_pad_forces(robot: Robot, log: Log) -> np.ndarray:
    """The forces under all feet as a log has them, by pads or as wrenches, shape (N, P, 3) [N].

    Raises:
        InputError: a foot without force channel, or one with another number of pads than the model.
    """
    forces = [np.zeros((len(log.time), 0, 3))]
    for side, leg in robot.description.legs.items():
        pads, wrench = f"foot/{side}/pad_force", f"foot/{side}/wrench"
        if pads in log:
            if log[pads].shape[1] != leg.points:
                raise InputError(
                    f"channel {pads}: expected {leg.points} pads as in the model, found "
                    f"{log[pads].shape[1]}"
                )
            forces.append(log[pads])
        elif wrench in log:
            forces.append(corner_forces(robot, side, log[wrench]))
        else:
            raise InputError(f"the log has no channel {pads}, nor {wrench}")
    return np.concatenate(forces, axis=1)


def leg_of_joint(robot: Robot) -> np.ndarray:
    """Which leg each joint belongs to, shape (n,); -1 for a joint that is no leg's: what is asked
    of its leg is then asked of the last."""
    legs = list(robot.description.legs.values())
    return np.array(
        [
            next((k for k, leg in enumerate(legs) if name in leg.joints), -1)
            for name in robot.joint_names
        ]
    )


@njit(cache=True)
def vertical_loads(force: np.ndarray, pad_foot: np.ndarray, feet: int) -> np.ndarray:
    """Vertical force on each foot, in its sole frame, shape (feet,) [N].

    Args:
        force: on each pad, shape (P, 3) [N].
        pad_foot: see `FootPads`.
    """
    load = np.zeros(feet)
    for pad in range(len(pad_foot)):
        load[pad_foot[pad]] += force[pad, 2]
    return load


@njit(cache=True)
def foot_wrenches(
    force: np.ndarray, pad_position: np.ndarray, pad_foot: np.ndarray, feet: int
) -> np.ndarray:
    """Wrench [moment, force] on each foot at the sole's origin in the sole frame, shape
    (feet, 6) [Nm, N].

    Args:
        force: on each pad, shape (P, 3) [N].
        pad_position, pad_foot: see `FootPads`.
    """
    wrench = np.zeros((feet, 6))
    for pad in range(len(pad_foot)):
        foot = wrench[pad_foot[pad]]
        x, y, z = pad_position[pad, 0], pad_position[pad, 1], pad_position[pad, 2]
        fx, fy, fz = force[pad, 0], force[pad, 1], force[pad, 2]
        foot[0] += y * fz - z * fy
        foot[1] += z * fx - x * fz
        foot[2] += x * fy - y * fx
        foot[3] += fx
        foot[4] += fy
        foot[5] += fz
    return wrench
