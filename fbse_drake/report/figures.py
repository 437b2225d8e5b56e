"""Pictures of a log: one function per figure.

Sides, joints and phases are taken from the log. Colours stand for sides, in the log's order; solid is what happened, dashed what was
planned. Nothing here touches pyplot or matplotlib's global settings.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon

from fbse_drake.log import Log
from fbse_drake.report.html import FigureBlock
from fbse_drake.report.metrics import com_rse

_SIDE_COLORS = ("#2979b5", "#d65f1a", "#2f8f6b", "#8457a8")
_PLANNED = "#555b62"
_TRUE = "#15181b"
_ZMP = "#2f8f6b"
_FRICTION = "#c81e1e"

_WIDTH = 10.0
# Points drawn of one line, about two per pixel of a wide panel.
_POINTS = 2000
# The direction of a foot's force means little below this share of the feet's mean load.
_LOADED_SHARE = 0.05


@dataclass(frozen=True)
class Phase:
    """A stretch of time [s] in which the plan stands on the same feet."""

    start: float
    end: float
    support: tuple[str, ...]

    @property
    def label(self) -> str:
        """`DS` for double support, else the supporting leg's initial and S, as `LS`; empty without support."""
        return "DS" if len(self.support) > 1 else "".join(f"{side[0].upper()}S" for side in self.support)


def support_phases(log: Log) -> list[Phase]:
    """The plan's phases in order of time; none for a log without planned support."""
    if not _has_feet(log, "reference", "support"):
        return []
    support = np.stack([log[f"reference/foot/{side}/support"] > 0 for side in log.sides], axis=1)
    starts = np.flatnonzero(np.concatenate([[True], (support[1:] != support[:-1]).any(axis=1)]))
    ends = [*log.time[starts[1:]], log.time[-1]]
    return [
        Phase(float(log.time[row]), float(end), tuple(side for side, stands in zip(log.sides, support[row], strict=True) if stands))
        for row, end in zip(starts, ends, strict=True)
    ]


def simulation_figures(
    log: Log, *, outlines: Mapping[str, np.ndarray] | None = None, pads: Mapping[str, np.ndarray] | None = None
) -> dict[str, list[FigureBlock]]:
    """The figures this log has the channels for, in order, by topic: `walk`, `joints`, `forces`, `friction`, `sensors`.

    Args:
        outlines, pads: see `footprints`.
    """
    blocks: dict[str, list[FigureBlock]] = {topic: [] for topic in ("walk", "joints", "forces", "friction", "sensors")}

    def add(topic: str, title: str, caption: str, figure: Figure) -> None:
        blocks[topic].append(FigureBlock(title, caption, figure))

    if _has_feet(log, "reference", "support") and _has_feet(log, "reference", "position"):
        add(
            "walk",
            "Footprints",
            "View from above. The ZMP should stay inside the feet that stand, and the true CoM on the planned one.",
            footprints(log, outlines=outlines, pads=pads),
        )
    if _has(log, "reference/com/position", "truth/com/position"):
        add(
            "walk",
            "Centre of mass",
            "Desired and true CoM with their root square error (RSE). An error that grows from step to step announces a fall.",
            com(log),
        )
    if _has_feet(log, "truth", "position"):
        add(
            "walk",
            "Feet",
            "Sole origins over time. DS is double support; LS and RS are single support on the left and on the right leg. "
            "A standing foot should neither move nor leave the ground.",
            feet(log),
        )
    add(
        "joints",
        "Joint angles",
        "Each joint against its reference; at this scale a visible gap is a large error.",
        joint_angles(log),
    )
    if _has(log, "reference/joint/position"):
        add(
            "joints",
            "Joint tracking error",
            "Reference minus joint angle. Steps at a change of phase come from the change of load, offsets at low speed from dry friction.",
            joint_errors(log),
        )
    add(
        "joints",
        "Joint torques",
        "Commanded torque, and the feed-forward torque inside it if there is one. What lies between the two is the position loop's work.",
        torques(log),
    )
    return blocks
