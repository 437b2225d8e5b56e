"""The looks that all figures have: colours, grids, legends.

Colours stand for sides, in the log's order; solid is what happened, dashed what was planned. Where
something is estimated, the estimate is coloured and the truth dashed and black, which nobody takes
for each other. Nothing here touches
pyplot or matplotlib's global settings.
"""

from collections.abc import Collection

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

SIDE_COLORS = ("#2979b5", "#d65f1a", "#2f8f6b", "#8457a8")
PLANNED = "#555b62"
INK = "#15181b"
TRUTH = INK
COM = "#7a4fa3"
ZMP = "#2f8f6b"
ERROR = "#c81e1e"
ESTIMATE = "#0b7a86"
SWING = "#8a9199"
# Estimate and truth mostly agree: a broad pale line shows beside a thin one on top of it.
BROAD = {"linewidth": 1.9, "alpha": 0.55}
THIN = {"color": TRUTH, "linestyle": (0, (4, 1.5)), "linewidth": 0.8}

# Of a figure [inch].
WIDTH = 10.0


def decorate(axes: Axes) -> None:
    """Gives a panel the looks that all have."""
    axes.grid(color="#dfe2e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#8a9199")
    axes.tick_params(labelsize=9, color="#8a9199")
    axes.locator_params(nbins="auto", steps=[1, 2, 5, 10])


def add_legend(
    figure: Figure, *, marker_size: float | None = None, without: Collection[str] = ()
) -> None:
    """One legend above all panels: every label once but for those `without`, solid lines before
    dashed ones before areas.

    Args:
        marker_size: of all markers in the legend [points]; None as they are drawn.
    """
    found: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if label not in without:
                found.setdefault(label, handle)
    if not found:
        return

    def rank(label: str) -> int:
        handle = found[label]
        return int(handle.is_dashed()) if isinstance(handle, Line2D) else 2

    labels = sorted(found, key=rank)
    columns = len(labels) if len(labels) < 6 else -(-len(labels) // 2)
    handles = [found[label] for label in labels]
    legend = figure.legend(
        handles, labels, loc="outside upper center", ncols=columns, frameon=False, fontsize=10
    )
    for mark in legend.legend_handles if marker_size is not None else ():
        if mark is not None:
            mark.set(markersize=marker_size)
