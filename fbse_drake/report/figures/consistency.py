"""Whether the filters are as sure as they should be, and what was not trusted."""

import itertools
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from fbse_drake.estimators.recursive import Status
from fbse_drake.log import Log
from fbse_drake.report.figures.kind import figure_kind
from fbse_drake.report.figures.panels import (
    joint_color,
    joint_grid,
    joint_style,
    stretches,
    stride,
    time_grid,
)
from fbse_drake.report.metrics import nis_bounds, normalised_innovations, settled
from fbse_drake.report.style import COM, ESTIMATE, INK, WIDTH, add_legend, decorate

_PART_COLORS = (ESTIMATE, "#d65f1a", COM, "#8a8f14", "#7b3fa0", "#5c5c5c", "#b8436f", "#3f6fb8")
_STATUS_COLORS = {
    Status.OK: "#cfe3d6",
    Status.NOT_FINITE: "#c81e1e",
    Status.STUCK: "#e39b16",
    Status.LOST: "#7a4fa3",
    Status.IMPLAUSIBLE: "#c9418b",
}
# NIS is averaged over this long [s], where at least half of the samples bring an update.
_NIS_WINDOW = 0.5


@figure_kind(
    "Consistency of the filters",
    "Normalised innovation squared (NIS), averaged over the components and a sliding window of "
    f"{_NIS_WINDOW:g} s. About 1: the filter's surprises are as large as it expects. Below, it "
    "trusts its measurements too little, above too much. The band holds 95 % of white innovations; "
    "those that last, as of a trunk that accelerates, leave it. Feet are far below: what they do "
    "in spite of all lasts, and the filter takes it for white noise that leaves as much over many "
    "ticks.",
    where=lambda log: any(
        _has_updates(parts)
        for name, parts in normalised_innovations(log).items()
        if name != "friction"
    ),
)
def filter_consistency(log: Log) -> Figure:
    """NIS of the filters but those of the friction, a panel for each filter."""
    filters = {
        name: parts
        for name, parts in normalised_innovations(log).items()
        if name != "friction" and _has_updates(parts)
    }
    figure, grid = time_grid(log, len(filters), 1, height=0.8 + 2.0 * len(filters))
    for (name, parts), axes in zip(filters.items(), grid.flat, strict=True):
        curves = {part: squares for part, squares in parts.items() if np.isfinite(squares).any()}
        _plot_nis(axes, log, curves, dict(zip(curves, itertools.cycle(_PART_COLORS), strict=False)))
        axes.set_title(name.replace("_", " "), loc="left", fontsize=10)
        axes.set_ylabel("NIS [1]")
        axes.legend(
            handles=axes.get_lines(),
            loc="center left",
            bbox_to_anchor=(1, 0.5),
            frameon=False,
            fontsize=9,
        )
    add_legend(figure, without={part for parts in filters.values() for part in parts})
    return figure


@figure_kind(
    "Consistency of the friction filters",
    f"The same for the friction filter of each joint, averaged over {_NIS_WINDOW:g} s. Recursive "
    "least squares knows no noise in Nm; for it, this is the NIS for a noise of 1 Nm.",
    where=lambda log: _has_updates(_of_joints(log)),
)
def friction_consistency(log: Log) -> Figure:
    """NIS of the friction filter of each joint."""
    figure, panels = joint_grid(log, "NIS [1]", own_swing=True)
    parts = _of_joints(log)
    for joint, axes in panels.items():
        label = str(joint_style(log, joint, "NIS")["label"])
        _plot_nis(axes, log, {label: parts[log.joints[joint]]}, {label: joint_color(log, joint)})
    add_legend(figure)
    return figure


def _of_joints(log: Log) -> dict[str, np.ndarray]:
    """The friction filter's innovations that are of joints, see `normalised_innovations`."""
    parts = normalised_innovations(log).get("friction", {})
    return {name: squares for name, squares in parts.items() if name in log.joints}


@figure_kind(
    "Status of sensors and estimators",
    "When a sensor was not trusted and which estimators that concerns. Not finite: a reading is "
    "not a number; stuck: it repeats itself to the last bit; lost: a foot does not show the load "
    "that it must carry.",
    where=lambda log: any(values.any() for values in _statuses(log).values()),
)
def statuses(log: Log) -> Figure:
    """What sensor monitor and estimators said of their inputs over time."""
    rows = _statuses(log)
    figure = Figure(figsize=(WIDTH, 1.2 + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots()
    decorate(axes)
    axes.grid(visible=False, axis="y")
    axes.margins(x=0)
    seen = sorted({int(value) for values in rows.values() for value in np.unique(values)})
    for place, values in enumerate(rows.values()):
        for status in seen:
            axes.broken_barh(
                stretches(log, values == status),
                (place - 0.36, 0.72),
                facecolor=_STATUS_COLORS[Status(status)],
                linewidth=0,
            )
    axes.set_yticks(range(len(rows)), list(rows))
    axes.invert_yaxis()
    axes.set_xlabel("time [s]")
    handles = [
        Patch(
            facecolor=_STATUS_COLORS[Status(status)],
            label=Status(status).name.lower().replace("_", " "),
        )
        for status in seen
    ]
    figure.legend(
        handles=handles, loc="outside upper center", ncols=len(seen), frameon=False, fontsize=10
    )
    return figure


def _statuses(log: Log) -> dict[str, np.ndarray]:
    """Status over time (N,) by sensor and estimator."""
    found: dict[str, np.ndarray] = {}
    if "estimate/sensors/status" in log:
        values = log["estimate/sensors/status"].T
        names = ["joints", "IMU", *(f"{side} foot" for side in log.sides)]
        found |= dict(
            zip(
                names if len(names) == len(values) else map(str, range(1, len(values) + 1)),
                values,
                strict=True,
            )
        )
    suffix = "/status"
    estimators = [
        name for name in log if name.endswith(suffix) and name != "estimate/sensors/status"
    ]
    return found | {
        name.removeprefix("estimate/").removesuffix(suffix).replace("_", " "): log[name]
        for name in estimators
    }


def _has_updates(parts: Mapping[str, np.ndarray]) -> bool:
    return any(np.isfinite(squares).any() for squares in parts.values())


def _plot_nis(
    axes: Axes, log: Log, curves: Mapping[str, np.ndarray], colors: Mapping[str, str]
) -> None:
    """Draws NIS, averaged over a sliding window, with its 95 % band on a logarithmic scale; curves
    (N, components) have equal shapes."""
    start = np.searchsorted(log.time, log.time - _NIS_WINDOW / 2, side="left")
    end = np.searchsorted(log.time, log.time + _NIS_WINDOW / 2, side="right")
    counted = settled(log)
    highest, lowest = 2.0, 0.5
    for label, squares in curves.items():
        components = squares.shape[1]
        known = np.isfinite(squares) & counted[:, None]
        totals = np.concatenate([[0.0], np.cumsum(np.where(known, squares, 0.0).sum(axis=1))])
        counts = np.concatenate([[0], np.cumsum(known.sum(axis=1))])
        total, count = totals[end] - totals[start], counts[end] - counts[start]
        enough = (count > 0) & (2 * count >= components * (end - start)) & counted
        mean = np.full(len(log.time), np.nan)
        mean[enough] = np.maximum(total[enough] / count[enough], 1e-12)
        if enough.any():
            highest, lowest = (
                max(highest, float(np.nanmax(mean))),
                min(lowest, float(np.nanmin(mean))),
            )
        thin = stride(log)
        axes.plot(log.time[thin], mean[thin], color=colors[label], linewidth=1.1, label=label)
    window = float(np.median(end - start)) * next(iter(curves.values())).shape[1]
    lower, upper = nis_bounds(np.array(window)).tolist()
    axes.axhspan(
        lower, upper, facecolor=INK, alpha=0.25, linewidth=0, label="95 % of white innovations"
    )
    axes.set_yscale("log")
    axes.set_ylim(max(1e-4, 0.7 * lowest), min(1e4, 1.4 * highest))
    axes.yaxis.set_major_locator(
        LogLocator(subs=(1.0,) if highest > 100 * lowest else (1.0, 2.0, 5.0))
    )
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    if len(log.time) > 1:
        axes.set_xlim(log.time[0], log.time[-1])
