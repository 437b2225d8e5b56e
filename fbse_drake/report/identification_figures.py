"""Pictures of identified inertial parameters and of the error that they take away.

Nothing here touches pyplot.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fbse_drake.discrepancy.diagnosis.identify import Identification
from fbse_drake.discrepancy.identification.inertial import BaseParameter
from fbse_drake.report.html import number
from fbse_drake.report.style import ERROR, ESTIMATE, PLANNED, WIDTH, add_legend, decorate

# Of a line in a picture [inch].
_LINE = 0.24


def combinations(result: Identification) -> Figure:
    """Every combination that the log tells apart, as the model has it and as identified with its
    95 % interval; a panel for each unit, those that are not known to a tenth pale."""
    by_unit: dict[str, list[BaseParameter]] = {}
    for base in result.inertia.base_parameters:
        by_unit.setdefault(base.unit, []).append(base)
    heights = [0.9 + _LINE * len(found) for found in by_unit.values()]
    figure = Figure(figsize=(WIDTH, 0.5 + sum(heights)), layout="constrained")
    panels = figure.subplots(len(by_unit), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axes, (unit, found) in zip(panels, by_unit.items(), strict=True):
        _draw_combinations(axes, found)
        axes.set_xlabel(f"[{unit}]", fontsize=9)
    add_legend(figure)
    return figure


def _draw_combinations(axes: Axes, found: Sequence[BaseParameter]) -> None:
    decorate(axes)
    for place, base in enumerate(found):
        text, alpha = ("identified", 1.0) if base.identified else ("not known to a tenth", 0.35)
        axes.hlines(place, *base.interval, color=ESTIMATE, alpha=alpha, linewidth=3)
        axes.plot(base.value, place, "o", color=ESTIMATE, alpha=alpha, markersize=5, label=text)
    places = range(len(found))
    model = [base.model for base in found]
    axes.plot(model, places, "|", color=PLANNED, markersize=11, markeredgewidth=2, label="model")
    axes.set_yticks(places, [base.short for base in found], fontsize=9)
    axes.set_ylim(len(found) - 0.4, -0.6)


def errors_by_joint(result: Identification) -> Figure:
    """Relative torque error of all joints together and of each, before and after: a panel for each
    log."""
    joints = list(next(iter(result.after.values())).relative_by_joint)
    size = (WIDTH, 1.0 + _LINE * (1 + len(joints)))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(result.after), sharey=True, squeeze=False)[0]
    for axes, (name, after) in zip(panels, result.after.items(), strict=True):
        before = result.before[name]
        _draw_errors(
            axes,
            [before.relative, *before.relative_by_joint.values()],
            [after.relative, *after.relative_by_joint.values()],
        )
        axes.set_title(name, loc="left", fontsize=10)
    panels[0].set_yticks(range(1 + len(joints)), ["all joints", *joints], fontsize=9)
    panels[0].set_ylim(len(joints) + 0.6, -0.6)
    add_legend(figure)
    return figure


def _draw_errors(axes: Axes, before: Sequence[float], after: Sequence[float]) -> None:
    """Shares of the torque, a line for each; a joint without torques, of which no share is finite,
    has none."""
    decorate(axes)
    first, last = 100 * np.array([before, after])
    places = np.arange(len(first))
    falls = last <= first
    axes.hlines(places, first, last, color=PLANNED, linewidth=1.5, alpha=0.4)
    axes.plot(first, places, "o", color=PLANNED, markersize=5, label="model as given")
    for chosen, color, text in ((falls, ESTIMATE, "identified"), (~falls, ERROR, "error rises")):
        if chosen.any():
            axes.plot(last[chosen], places[chosen], "o", color=color, markersize=6, label=text)
    for place, shares in enumerate(zip(first, last, strict=True)):
        if np.isfinite(shares).all():
            axes.annotate(
                f"{number(shares[0])} → {number(shares[1])} %",
                (max(shares), place),
                (8, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
            )
    # Room for the numbers.
    shown = np.isfinite([first, last])
    axes.set_xlim(0.0, 1.35 * np.max([first, last], initial=1e-3, where=shown))
    axes.set_xlabel("|residual| / |torque| [%]", fontsize=9)
