"""Panels over time: sides, joints and phases are taken from the log."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report.metrics import joint_sides, settled, stance
from fbse_drake.report.style import (
    INK,
    PLANNED,
    SIDE_COLORS,
    SWING,
    WIDTH,
    decorate,
)
from fbse_drake.walking.plan import Phase

# Points drawn of one line, about two per pixel of a wide panel.
_POINTS = 2000
# The least that a panel shows of a position or angle [m or rad].
POSITION_SPAN = 0.05
# The least that a panel shows of friction [Nm].
FRICTION_SPAN = 0.1
# Shares of an estimate's samples that a panel shows: what is left out are spikes of a few samples,
# as when a foot lands.
_SHOWN_QUANTILES = (0.005, 0.995)


def support_phases(log: Log) -> list[Phase]:
    """The phases in order of time, by the plan, without one by the estimated support; none for a
    log without either."""
    if not (stands := stance(log)):
        return []
    support = np.stack([stands[side] for side in log.sides], axis=1)
    starts = np.flatnonzero(np.concatenate([[True], (support[1:] != support[:-1]).any(axis=1)]))
    ends = [*log.time[starts[1:]], log.time[-1]]
    return [
        Phase(
            float(log.time[row]),
            float(end),
            tuple(side for side, stands in zip(log.sides, support[row], strict=True) if stands),
            len(log.sides),
        )
        for row, end in zip(starts, ends, strict=True)
    ]


def side_color(log: Log, side: str) -> str:
    """The colour of a leg."""
    return SIDE_COLORS[log.sides.index(side) % len(SIDE_COLORS)]


def joint_color(log: Log, joint: int) -> str:
    """The colour of the leg that a joint belongs to."""
    side = joint_sides(log)[joint]
    return INK if side is None else side_color(log, side)


def joint_style(log: Log, joint: int, label: str) -> dict[str, str]:
    """The colour of a joint's line, and its label with the leg."""
    side = joint_sides(log)[joint]
    return {
        "color": joint_color(log, joint),
        "label": label if side is None else f"{label}, {side}",
    }


def joint_rows(log: Log) -> dict[str, dict[str, int]]:
    """Columns of the joints in the log by what they are called without their side, and by side."""
    rows: dict[str, dict[str, int]] = {}
    for column, (name, side) in enumerate(zip(log.joints, joint_sides(log), strict=True)):
        rows.setdefault(name if side is None else name.removeprefix(f"{side}_"), {})[side or ""] = (
            column
        )
    return rows


def source(channel: str) -> str:
    """Whether a channel is true or measured, for a label."""
    return "true" if channel.startswith("truth/") else "measured"


def time_grid(
    log: Log, rows: int, columns: int, *, height: float, phases: bool = True
) -> tuple[Figure, np.ndarray]:
    """A figure with panels over time that show the phases, if so wished; panels have shape (rows,
    columns)."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for axes in grid.flat:
        if phases:
            decorate_time(axes, log)
        else:
            decorate(axes)
            axes.margins(x=0)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    figure.align_ylabels()
    return figure, grid


def joint_grid(
    log: Log, quantity: str, *, own_swing: bool = False
) -> tuple[Figure, dict[int, Axes]]:
    """A figure with a panel over time for each joint, by its column in the log: a row for each
    role, a column for each side.

    Args:
        own_swing: shades when the joint's own leg swings instead of the single supports.
    """
    roles = list(joint_rows(log).values())
    columns = max(len(row) for row in roles)
    figure = Figure(figsize=(WIDTH, 0.8 + 1.55 * len(roles)), layout="constrained")
    grid = figure.subplots(len(roles), columns, sharex=True, sharey="row", squeeze=False)
    panels = {}
    for row, row_axes in zip(roles, grid, strict=True):
        for axes in row_axes[len(row) :]:
            axes.set_axis_off()
        for joint, axes in zip(row.values(), row_axes, strict=False):
            decorate_time(axes, log, swing_of=joint_sides(log)[joint] if own_swing else None)
            axes.set_title(log.joints[joint].replace("_", " "), loc="left", fontsize=10, pad=3)
            panels[joint] = axes
    figure.supxlabel("time [s]", fontsize=10)
    figure.supylabel(quantity, fontsize=10)
    return figure, panels


def decorate_time(axes: Axes, log: Log, *, swing_of: str | None = None) -> None:
    """Also shades the single supports in the colour of the leg that stands, or when the leg of one
    side swings."""
    decorate(axes)
    axes.margins(x=0)
    for phase in support_phases(log):
        if swing_of is not None:
            if swing_of not in phase.support:
                axes.axvspan(
                    phase.start,
                    phase.end,
                    facecolor=SWING,
                    alpha=0.22,
                    linewidth=0,
                    label="the joint's leg swings",
                )
        elif phase.is_single:
            side = phase.support[0]
            axes.axvspan(
                phase.start,
                phase.end,
                facecolor=side_color(log, side),
                alpha=0.12,
                linewidth=0,
                label=f"{' and '.join(phase.support)} leg supports",
            )


def name_phases(axes: Axes, log: Log) -> None:
    """Writes the phases' names above the panel, where there is room."""
    duration = log.time[-1] - log.time[0]
    for phase in support_phases(log):
        if phase.end - phase.start > 0.03 * duration:
            middle = (phase.start + phase.end) / 2
            axes.text(
                middle,
                1.02,
                phase.label,
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="bottom",
                fontsize=8,
                color=PLANNED,
            )


def at_least(limits: tuple[float, float], span: float) -> tuple[float, float]:
    """An axis' limits, widened on both sides to at least `span`, so that noise about a constant
    looks like a constant."""
    missing = max(0.0, span - (limits[1] - limits[0]))
    return limits[0] - missing / 2, limits[1] + missing / 2


def widen(panels: Mapping[int, Axes], span: float) -> None:
    """Widens the limits of all panels to at least `span`."""
    # Only when everything is drawn: setting limits ends the automatic scaling of the whole row.
    for axes in panels.values():
        axes.set_ylim(at_least(axes.get_ylim(), span))


def readable(
    log: Log, estimate: np.ndarray, *, whole: np.ndarray | None = None, span: float
) -> tuple[float, float]:
    """Limits that show an estimate without its shortest spikes and without the filters' settling,
    and all of `whole`; (N, ...) each."""
    curves = estimate.reshape(len(log.time), -1)
    known = np.isfinite(curves).all(axis=1)
    shown = curves[known & settled(log)] if (known & settled(log)).any() else curves[known]
    values = np.quantile(shown, _SHOWN_QUANTILES, axis=0).ravel() if len(shown) else np.zeros(1)
    if whole is not None:
        values = np.append(values, whole[np.isfinite(whole)])
    margin = 0.08 * (values.max() - values.min())
    return at_least((float(values.min() - margin), float(values.max() + margin)), span)


def limit_to_readable(
    log: Log,
    panels: Mapping[int, Axes],
    estimate: np.ndarray,
    *,
    whole: np.ndarray | None = None,
    span: float,
) -> None:
    """Gives panels of joints, which share limits along a row, limits as by `_readable`."""
    for joints in joint_rows(log).values():
        columns = [joint for joint in joints.values() if joint in panels]
        if columns:
            limits = readable(
                log,
                estimate[:, columns],
                whole=None if whole is None else whole[:, columns],
                span=span,
            )
            panels[columns[0]].set_ylim(limits)


def stride(log: Log) -> slice:
    """The samples that are drawn of what cannot be thinned by its extremes."""
    return slice(None, None, max(1, len(log.time) // (2 * _POINTS)))


def plot(axes: Axes, log: Log, values: np.ndarray, **style: Any) -> None:
    """Draws values (N,) over time; of a long series the smallest and the largest of each short
    stretch, so that no spike is lost."""
    rows = np.arange(len(values))
    stretch = len(values) // (_POINTS // 2)
    if stretch > 2:
        whole = len(values) // stretch * stretch
        blocks = np.nan_to_num(values[:whole]).reshape(-1, stretch)
        extremes = (
            np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1)
            + np.arange(0, whole, stretch)[:, None]
        )
        rows = np.concatenate([np.sort(extremes, axis=1).ravel(), rows[whole:]])
    axes.plot(log.time[rows], values[rows], **{"linewidth": 1.2, **style})


def stretches(log: Log, holds: np.ndarray) -> list[tuple[float, float]]:
    """Start and length [s] of the stretches of time in which something holds, (N,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int))).reshape(
        -1, 2
    )
    ends = np.append(log.time, log.time[-1])
    return [(float(log.time[start]), float(ends[end] - log.time[start])) for start, end in edges]
