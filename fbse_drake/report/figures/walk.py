"""The walk seen from above, its centre of mass and its feet."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from fbse_drake.estimators.zmp import zero_moment_point
from fbse_drake.log import Log
from fbse_drake.report.figures.forces import centre_of_pressure, feels_feet, foot_force
from fbse_drake.report.figures.kind import figure_kind
from fbse_drake.report.figures.panels import (
    POSITION_SPAN,
    at_least,
    name_phases,
    plot,
    side_color,
    stride,
    time_grid,
)
from fbse_drake.report.metrics import com_rse, has_feet
from fbse_drake.report.style import (
    BROAD,
    COM,
    ESTIMATE,
    INK,
    PLANNED,
    TRUTH,
    WIDTH,
    ZMP,
    add_legend,
    decorate,
)
from fbse_drake.walking.plan import Phase


@figure_kind(
    "Footprints",
    "View from above: each foothold, the path of the zero-moment point (ZMP) and that of the "
    "centre of mass (CoM). The ZMP has to stay inside the polygon around the feet that stand.",
    needs=("reference/foot/{}/support", "reference/foot/{}/position"),
)
def footprints(log: Log) -> Figure:
    """Footholds, ZMP and CoM seen from above; the soles are taken to be turned as planned.

    Of a foot whose pads the log does not know, or whose pads are in one line, a foothold is a
    cross; without pads no measured ZMP is drawn.
    """
    pads = {side: np.array(places) for side, places in log.meta.get("pads", {}).items() if places}
    outlines = _outlines(pads)
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    axes = figure.subplots()
    decorate(axes)
    for source, label in (("truth", "{} foot"), ("reference", "planned foothold")):
        for side in log.sides if has_feet(log, f"{source}/foot/{{}}/position") else ():
            color = side_color(log, side) if source == "truth" else PLANNED
            for place, R in _footholds(log, side, f"{source}/foot/{side}/position"):
                if side not in outlines:
                    axes.plot(
                        *place,
                        "x" if source == "truth" else "+",
                        color=color,
                        markersize=10,
                        label=label.format(side),
                    )
                else:
                    patch = Polygon(
                        place + outlines[side] @ R.T, edgecolor=color, label=label.format(side)
                    )
                    patch.set(
                        **(
                            {"facecolor": f"{color}38"}
                            if source == "truth"
                            else {"fill": False, "linestyle": "--"}
                        )
                    )
                    axes.add_patch(patch)
    if pads and feels_feet(log) and has_feet(log, "truth/foot/{}/position"):
        axes.plot(
            *_measured_zmp(log, pads)[stride(log)].T,
            color=ZMP,
            linewidth=0.7,
            alpha=0.7,
            label="measured ZMP",
        )
    for channel, color, line, width, label in (
        ("reference/zmp", ZMP, "--", 1.4, "planned ZMP"),
        ("truth/com/position", TRUTH, "-", 1.6, "true CoM"),
        ("reference/com/position", COM, "--", 1.2, "planned CoM"),
    ):
        if channel in log:
            axes.plot(
                *log[channel][stride(log), :2].T,
                color=color,
                linestyle=line,
                linewidth=width,
                label=label,
            )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, forward [m]")
    axes.set_ylabel("y, to the left [m]")
    add_legend(figure)
    return figure


@figure_kind(
    "Centre of mass",
    lambda log: (
        "Desired and true CoM, and their root square error (RSE)."
        + (
            " Where the CoM is estimated: the estimate, and its own error."
            if "estimate/com/position" in log
            else ""
        )
    ),
    where=lambda log: (
        ("reference/com/position" in log and "truth/com/position" in log)
        or "estimate/com/position" in log
    ),
)
def com(log: Log) -> Figure:
    """Desired, true and estimated centre of mass in x and y, and the root square errors of motion
    and estimate (as the paper's Fig. 8)."""
    estimated, known = "estimate/com/position" in log, "truth/com/position" in log
    errors: list[tuple[str, str, np.ndarray]] = []
    if known and "reference/com/position" in log:
        errors.append(("RSE", COM, com_rse(log)))
    if known and estimated:
        errors.append(
            (
                "RSE of estimate",
                ESTIMATE,
                np.abs(log["estimate/com/position"] - log["truth/com/position"])[:, :2],
            )
        )
    figure, grid = time_grid(log, 2, 1 + len(errors), height=5.6)
    for letter, axes in zip("abcdef", grid.flat, strict=False):
        axes.set_title(f"({letter})", loc="left", fontsize=10)
    lines: tuple[tuple[str, dict[str, Any]], ...] = (
        ("estimate", {"color": ESTIMATE, "label": "estimated", **BROAD}),
        ("truth", {"color": TRUTH, "label": "true"}),
        ("reference", {"color": COM, "linestyle": "--", "linewidth": 1.2, "label": "desired"}),
    )
    for (position, *error_axes), name, column in zip(grid, "xy", (0, 1), strict=True):
        for source, style in lines:
            if f"{source}/com/position" in log:
                plot(position, log, log[f"{source}/com/position"][:, column], **style)
        position.set_ylabel(f"CoM {name} [m]")
        position.set_ylim(at_least(position.get_ylim(), POSITION_SPAN))
        for axes, (label, color, error) in zip(error_axes, errors, strict=True):
            plot(axes, log, 1e3 * error[:, column], color=color)
            axes.set_ylabel(f"{label} {name} [mm]")
            axes.set_ylim(0, max(1.0, axes.get_ylim()[1]))
    add_legend(figure)
    return figure


@figure_kind(
    "Feet",
    lambda log: (
        "Origins of the soles, true and planned. DS is double support, "
        + ", ".join(
            f"{Phase(0, 0, (side,)).label} support by the {side} leg alone" for side in log.sides
        )
        + "."
    ),
    needs=("truth/foot/{}/position",),
)
def feet(log: Log) -> Figure:
    """True and planned x and z of the soles, with the phases named (as the paper's Fig. 5)."""
    figure, grid = time_grid(log, 2, 1, height=5.6)
    for axes, name, column in zip(grid.flat, "xz", (0, 2), strict=True):
        # Thinner lines on thicker ones: where the feet agree, both can be seen.
        for side, width in zip(log.sides, np.linspace(3, 2, len(log.sides)), strict=True):
            values = log[f"truth/foot/{side}/position"][:, column]
            plot(
                axes,
                log,
                values,
                color=side_color(log, side),
                linewidth=width,
                label=f"{side} foot",
            )
        for side in log.sides if has_feet(log, "reference/foot/{}/position") else ():
            values = log[f"reference/foot/{side}/position"][:, column]
            plot(axes, log, values, color=INK, linewidth=0.9, linestyle="--", label="planned")
        axes.set_ylabel(f"{name} [m]")
        axes.set_ylim(at_least(axes.get_ylim(), POSITION_SPAN))
    name_phases(grid[0, 0], log)
    add_legend(figure)
    return figure


def _outlines(pads: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Corners of each side's sole in its sole frame, (K, 2) [m]: it reaches as far as its pads."""
    return {
        side: places[ConvexHull(places[:, :2]).vertices, :2]
        for side, places in pads.items()
        if np.linalg.matrix_rank(np.diff(places[:, :2], axis=0)) == 2
    }


def _footholds(log: Log, side: str, channel: str) -> Iterable[tuple[np.ndarray, np.ndarray]]:
    """Where the sole is in the middle of each planned stance, (2,) [m], and how it is planned to be
    turned, (2, 2)."""
    standing = log[f"reference/foot/{side}/support"] > 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], standing, [False]]).astype(int)))
    R = _level_rotation(log, side)
    return [
        (np.median(log[channel][start:end, :2], axis=0), R[start, :2, :2])
        for start, end in edges.reshape(-1, 2)
    ]


def _level_rotation(log: Log, side: str) -> np.ndarray:
    """R_WF of a level sole that is turned as planned, (N, 3, 3)."""
    yaw = log.get(f"reference/foot/{side}/yaw", np.zeros(len(log.time)))
    return Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_matrix()


def _measured_zmp(log: Log, pads: Mapping[str, np.ndarray]) -> np.ndarray:
    """ZMP of the measured foot forces, (N, 2) [m]; soles taken as level."""
    forces, places = [], []
    for side in log.sides:
        sole, R = log[f"truth/foot/{side}/position"][:, None], _level_rotation(log, side)
        if f"foot/{side}/pad_force" in log:
            forces.append(log[f"foot/{side}/pad_force"])
            places.append(sole + pads[side] @ R.transpose(0, 2, 1))
        else:
            forces.append(foot_force(log, side)[:, None])
            centre = np.pad(centre_of_pressure(log, side), ((0, 0), (0, 1)))
            places.append(sole + np.einsum("nij,nj->ni", R, centre)[:, None])
    return zero_moment_point(np.concatenate(forces, axis=1), np.concatenate(places, axis=1))
