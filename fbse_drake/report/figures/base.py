"""Estimates of the base's state and of the support."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report.figures.forces import feels_feet, foot_force
from fbse_drake.report.figures.kind import figure_kind
from fbse_drake.report.figures.panels import (
    name_phases,
    plot,
    readable,
    side_color,
    stretches,
    time_grid,
)
from fbse_drake.report.metrics import (
    attitude_error_deg,
    base_velocity_error,
    has_feet,
    roll_and_pitch_deg,
)
from fbse_drake.report.style import BROAD, ESTIMATE, INK, THIN, add_legend

# The least that a panel shows.
_ANGLE_SPAN = 0.1  # [deg]
_ANGLE_ERROR_SPAN = 0.02  # [deg]
_VELOCITY_SPAN = 0.02  # [m/s]
_VELOCITY_ERROR_SPAN = 1.0  # [mm/s]


@figure_kind(
    "Base attitude",
    lambda log: (
        "Roll and pitch of the base, and the estimate's error."
        if "truth/base/orientation" in log
        else "Roll and pitch of the base."
    ),
    needs=("estimate/base/orientation",),
)
def base_attitude(log: Log) -> Figure:
    """Roll and pitch of the base, estimated and true, and the error."""
    known = "truth/base/orientation" in log
    estimate = roll_and_pitch_deg(log["estimate/base/orientation"])
    truth = roll_and_pitch_deg(log["truth/base/orientation"]) if known else None
    error = attitude_error_deg(log) if known else None
    return _estimate_and_error(
        log,
        ("roll", "pitch"),
        ("deg", "deg"),
        (estimate, truth, error),
        (_ANGLE_SPAN, _ANGLE_ERROR_SPAN),
    )


@figure_kind(
    "Base velocity",
    lambda log: (
        "Velocity of the base in the world"
        + (", and the estimate's error." if "truth/base/velocity" in log else ".")
    ),
    needs=("estimate/base/velocity",),
)
def base_velocity(log: Log) -> Figure:
    """Velocity of the base in the world, estimated and true, and the error."""
    error = 1e3 * base_velocity_error(log) if "truth/base/velocity" in log else None
    curves = (log["estimate/base/velocity"], log.get("truth/base/velocity"), error)
    return _estimate_and_error(
        log, "xyz", ("m/s", "mm/s"), curves, (_VELOCITY_SPAN, _VELOCITY_ERROR_SPAN)
    )


@figure_kind(
    "Support",
    "Which feet stand, as planned and as estimated, and the measured load of each foot over the "
    "mean load of all feet.",
    needs=("estimate/support",),
    where=lambda log: bool(log.sides),
)
def support(log: Log) -> Figure:
    """Planned and estimated stance and measured load of each foot."""
    figure, grid = time_grid(
        log, len(log.sides), 1, height=1.0 + 1.9 * len(log.sides), phases=False
    )
    forces = {side: foot_force(log, side)[:, 2] for side in log.sides} if feels_feet(log) else {}
    weight = np.mean(sum(forces.values())) if forces else 0.0
    strips = [("estimated stance", log["estimate/support"].T > 0, 1.0)]
    if has_feet(log, "reference/foot/{}/support"):
        strips.insert(
            0,
            (
                "planned stance",
                [log[f"reference/foot/{side}/support"] > 0 for side in log.sides],
                0.45,
            ),
        )
    for foot, (side, axes) in enumerate(zip(log.sides, grid.flat, strict=True)):
        for place, (label, stands, strength) in enumerate(strips, start=1):
            style = {
                "facecolor": side_color(log, side),
                "alpha": strength,
                "linewidth": 0,
                "label": label,
            }
            axes.broken_barh(stretches(log, stands[foot]), (-0.22 * place, 0.16), **style)
        if weight > 0:
            plot(
                axes,
                log,
                forces[side] / weight,
                color=INK,
                linewidth=0.8,
                label="load / mean load of all feet",
            )
        axes.set_ylabel(f"{side} foot [1]")
        axes.set_ylim(-0.22 * len(strips) - 0.06, 1.4)
        axes.set_yticks([0, 0.5, 1])
    name_phases(grid[0, 0], log)
    add_legend(figure)
    return figure


def _estimate_and_error(
    log: Log,
    names: Sequence[str],
    units: tuple[str, str],
    curves: tuple[np.ndarray, np.ndarray | None, np.ndarray | None],
    spans: tuple[float, float],
) -> Figure:
    """A row for each quantity: estimate with truth, and, where the truth is known, the error.

    Args:
        units: of the quantity and of its error.
        curves: estimate, truth and error, (N, names) each.
        spans: the least that panels of quantity and error show.
    """
    estimate, truth, error = curves
    figure, grid = time_grid(
        log, len(names), 1 if error is None else 2, height=0.9 + 1.75 * len(names)
    )
    for column, (name, row) in enumerate(zip(names, grid, strict=True)):
        plot(row[0], log, estimate[:, column], color=ESTIMATE, label="estimated", **BROAD)
        if truth is not None:
            plot(row[0], log, truth[:, column], **THIN, label="true")
        row[0].set_ylabel(f"{name} [{units[0]}]")
        row[0].set_ylim(
            readable(
                log,
                estimate[:, column],
                whole=None if truth is None else truth[:, column],
                span=spans[0],
            )
        )
        if error is not None:
            plot(row[1], log, error[:, column], color=ESTIMATE, linewidth=0.9)
            row[1].set_ylabel(f"error of {name} [{units[1]}]")
            row[1].set_ylim(readable(log, error[:, column], span=spans[1]))
    add_legend(figure)
    return figure
