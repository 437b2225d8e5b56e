"""Pictures of a log, by topic: a module for each, which holds its kinds of figures.

    show(figures.footprints(log))

To add a figure, write the function that draws it behind `@figure_kind(...)`, which says its title,
its caption and the channels it needs, and name it here.
"""

from fbse_drake.log import Log
from fbse_drake.report.figures.base import base_attitude, base_velocity, support
from fbse_drake.report.figures.consistency import filter_consistency, friction_consistency, statuses
from fbse_drake.report.figures.forces import foot_forces
from fbse_drake.report.figures.joint_friction import (
    estimated_friction,
    friction,
    friction_errors,
    friction_over_velocity,
    friction_parameters,
)
from fbse_drake.report.figures.joints import joint_angles, joint_errors, torques
from fbse_drake.report.figures.kind import FigureKind
from fbse_drake.report.figures.sensors import imu
from fbse_drake.report.figures.walk import com, feet, footprints
from fbse_drake.report.html import FigureBlock

__all__ = [
    "TOPICS",
    "FigureKind",
    "base_attitude",
    "base_velocity",
    "com",
    "estimated_friction",
    "feet",
    "filter_consistency",
    "foot_forces",
    "footprints",
    "friction",
    "friction_consistency",
    "friction_errors",
    "friction_over_velocity",
    "friction_parameters",
    "imu",
    "joint_angles",
    "joint_errors",
    "run_figures",
    "statuses",
    "support",
    "torques",
]

# In the order of a report.
TOPICS: dict[str, tuple[FigureKind, ...]] = {
    "walk": (footprints, com, feet),
    "joints": (joint_angles, joint_errors, torques),
    "forces": (foot_forces,),
    "friction": (
        friction,
        estimated_friction,
        friction_errors,
        friction_over_velocity,
        friction_parameters,
    ),
    "base": (base_attitude, base_velocity, support),
    "consistency": (filter_consistency, friction_consistency, statuses),
    "sensors": (imu,),
}


def run_figures(log: Log) -> dict[str, list[FigureBlock]]:
    """The figures that this log has the channels for, in order, by topic; see `TOPICS`."""
    return {
        topic: [kind.block(log) for kind in kinds if kind.available(log)]
        for topic, kinds in TOPICS.items()
    }
