"""The rows of a residual.

Per plant step, with the base's origin at rest and the measured specific force in the place of
gravity (see `estimators.floating_base`):

* joint and base rows, S tau - (H v_dot + C v - J_m^T f_m): torque that the motors gave and the
  links did not get [Nm]; and six unactuated rows [Nm, N], which no joint effect can touch;
* kinematic rows, of every standing sole but a point foot's, in its frame: angular velocity, and
  specific force less that of a level resting sole; while both feet stand also the velocity of one
  sole relative to the other; on more than two feet, of one standing point foot relative to the next
  that stands;
* transmission rows, of joints with encoders on both sides of the gear: by how much the motor is
  ahead of the link.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from fbse_drake.robot.plant import Robot

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Row:
    """One residual channel."""

    # As `left_knee_pitch`, `base/force_z`, `left_sole/angular_velocity_x`.
    name: str
    # `joint`, `base`, `kinematic` or `transmission`.
    kind: str
    unit: str
    # Sides of the feet whose soles it is about.
    feet: tuple[str, ...] = ()
    # The joint that it is about.
    joint: str = ""


def foot_pairs(robot: Robot) -> list[tuple[int, int]]:
    """Places of the feet whose velocity relative to each other is in rows: of two feet both, of
    more all pairs of point feet. How a point foot is turned while it stands is not known, but that
    it does not move."""
    legs = robot.description.legs
    if len(legs) == 2:
        return [(0, 1)]
    points = [
        foot
        for foot, (side, leg) in enumerate(legs.items())
        if leg.is_point and np.allclose(robot.pad_positions(side), 0.0, atol=1e-6)
    ]
    return list(combinations(points, 2))


def residual_rows(robot: Robot, *, motor_encoders: bool = False) -> list[Row]:
    """The residual's rows for a robot, in order; with second encoders also those that they show."""
    units = dict(zip(robot.joint_names, robot.torque_units, strict=True))
    rows = [Row(name, "joint", unit, joint=name) for name, unit in units.items()]
    rows += _rows_of_floating_base(robot) if robot.has_floating_base else []
    if motor_encoders:
        rows += [
            Row(f"{name}/deflection", "transmission", "m" if unit == "N" else "rad", joint=name)
            for name, unit in units.items()
        ]
    return rows


def _rows_of_floating_base(robot: Robot) -> list[Row]:
    rows = [
        Row(f"base/{kind}_{axis}", "base", unit)
        for kind, unit in (("moment", "Nm"), ("force", "N"))
        for axis in _AXES
    ]
    for side in robot.description.sides:
        kinds = (("angular_velocity", "rad/s"), ("specific_force", "m/s^2"))
        rows += [
            Row(f"{side}_sole/{kind}_{axis}", "kinematic", unit, (side,))
            for kind, unit in kinds
            for axis in _AXES
        ]
    sides = robot.description.sides
    for pair in foot_pairs(robot):
        feet = tuple(sides[foot] for foot in pair)
        name = "soles" if len(sides) == 2 else "-".join(feet)
        rows += [
            Row(f"{name}/relative_velocity_{axis}", "kinematic", "m/s", feet) for axis in _AXES
        ]
    return rows
