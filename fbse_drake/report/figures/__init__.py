"""Pictures of a log, by topic: a module for each, which holds its kinds of figures.

To add a figure, write the function that draws it behind `@figure_kind(...)`, which says its title,
its caption and the channels it needs, and name it in its module's `KINDS`.
"""

from fbse_drake.log import Log
from fbse_drake.report.figures import base, consistency, forces, friction, joints, sensors, walk
from fbse_drake.report.figures.kind import FigureKind
from fbse_drake.report.html import FigureBlock

# In the order of a report.
TOPICS: dict[str, tuple[FigureKind, ...]] = {
    "walk": walk.KINDS,
    "joints": joints.KINDS,
    "forces": forces.KINDS,
    "friction": friction.KINDS,
    "base": base.KINDS,
    "consistency": consistency.KINDS,
    "sensors": sensors.KINDS,
}


def run_figures(log: Log) -> dict[str, list[FigureBlock]]:
    """The figures that this log has the channels for, in order, by topic; see `TOPICS`."""
    return {
        topic: [kind.block(log) for kind in kinds if kind.available(log)]
        for topic, kinds in TOPICS.items()
    }
