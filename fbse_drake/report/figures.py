"""Pictures of a log: one function per figure.

Sides, joints and phases are taken from the log. Colours stand for sides, in the log's order; solid is what happened, dashed what was
planned. Where something is estimated, the estimate is solid and the truth dashed and red. Nothing here touches pyplot or matplotlib's
global settings.
"""

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import LogLocator, NullFormatter
from pydrake.common.yaml import yaml_load
from scipy.spatial.transform import Rotation

from fbse_drake import schema
from fbse_drake.errors import InputError
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.friction import FrictionConfig, ModelAided
from fbse_drake.estimators.recursive import Status
from fbse_drake.estimators.zmp import zero_moment_point
from fbse_drake.log import Log
from fbse_drake.report.html import FigureBlock, number
from fbse_drake.report.metrics import (
    attitude_error_deg,
    base_velocity_error,
    broken_laws,
    com_rse,
    ended_step,
    friction_error,
    friction_law_error,
    has_feet,
    joint_position_channel,
    joint_sides,
    nis_bounds,
    normalised_innovations,
    roll_and_pitch_deg,
    settled,
    stance,
)
from fbse_drake.scenario import Scenario
from fbse_drake.walking.plan import Phase

SIDE_COLORS = ("#2979b5", "#d65f1a", "#2f8f6b", "#8457a8")
PLANNED = "#555b62"
_TRUE = "#15181b"
_COM = "#7a4fa3"
_ZMP = "#2f8f6b"
TRUTH = "#c81e1e"
ESTIMATE = "#0b7a86"
_SWING = "#8a9199"
_PART_COLORS = (ESTIMATE, "#d65f1a", _COM, "#8a8f14", "#7b3fa0", "#5c5c5c", "#b8436f", "#3f6fb8")
# Estimate and truth mostly agree: a broad pale line shows beside a thin one on top of it.
_BROAD = {"linewidth": 1.9, "alpha": 0.55}
_THIN = {"color": TRUTH, "linestyle": (0, (4, 1.5)), "linewidth": 0.8}
_STATUS_COLORS = {
    Status.OK: "#cfe3d6",
    Status.NOT_FINITE: "#c81e1e",
    Status.STUCK: "#e39b16",
    Status.LOST: "#7a4fa3",
    Status.IMPLAUSIBLE: "#c9418b",
}

WIDTH = 10.0
# Points drawn of one line, about two per pixel of a wide panel.
_POINTS = 2000
# The least that a panel shows of a quantity.
_POSITION_SPAN = 0.05  # [m or rad]
_ERROR_SPAN = 0.2  # [mrad]
_FRICTION_SPAN = 0.1  # [Nm]
_VELOCITY_SPAN = 0.01  # [rad/s]
_ANGLE_SPAN = 0.1  # [deg]
_ANGLE_ERROR_SPAN = 0.02  # [deg]
_BASE_VELOCITY_SPAN = 0.02  # [m/s]
_BASE_VELOCITY_ERROR_SPAN = 1.0  # [mm/s]
# Shares of an estimate's samples that a panel shows: what is left out are spikes of a few samples, as when a foot lands.
_SHOWN_QUANTILES = (0.005, 0.995)
# NIS is averaged over this long [s], where at least half of the samples bring an update.
_NIS_WINDOW = 0.5
# The direction of a foot's force means little below this share of the feet's mean load.
_LOADED_SHARE = 0.05


def support_phases(log: Log) -> list[Phase]:
    """The phases in order of time, by the plan, without one by the estimated support; none for a log without either."""
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


def run_figures(
    log: Log,
    *,
    outlines: Mapping[str, np.ndarray] | None = None,
    pads: Mapping[str, np.ndarray] | None = None,
) -> dict[str, list[FigureBlock]]:
    """The figures that this log has the channels for, in order, by topic: walk, joints, forces, friction, base, consistency, sensors.

    Args:
        outlines, pads: see `footprints`.
    """
    planned_feet = has_feet(log, "reference/foot/{}/support") and has_feet(
        log, "reference/foot/{}/position"
    )
    loaded_feet = _feels_feet(log) and not _hangs(log)
    friction_known = "truth/joint/friction_torque" in log
    friction_estimated = "estimate/joint/friction_torque" in log
    com_known = "reference/com/position" in log and "truth/com/position" in log
    com_estimated = "estimate/com/position" in log
    innovations = normalised_innovations(log)
    supports = ", ".join(
        f"{Phase(0, 0, (side,)).label} support by the {side} leg alone" for side in log.sides
    )
    catalogue: list[tuple[str, str, str, bool, Callable[[], Figure]]] = [
        (
            "walk",
            "Footprints",
            "View from above: each foothold, the path of the zero-moment point (ZMP) and that of the centre of mass (CoM). "
            "The ZMP has to stay inside the polygon around the feet that stand.",
            planned_feet,
            lambda: footprints(log, outlines=outlines, pads=pads),
        ),
        (
            "walk",
            "Centre of mass",
            "Desired and true CoM, and their root square error (RSE)."
            + (
                " Where the CoM is estimated: the estimate, and its own error."
                if com_estimated
                else ""
            ),
            com_known or com_estimated,
            lambda: com(log),
        ),
        (
            "walk",
            "Feet",
            f"Origins of the soles, true and planned. DS is double support, {supports}.",
            has_feet(log, "truth/foot/{}/position"),
            lambda: feet(log),
        ),
        (
            "joints",
            "Joint angles",
            "Reference and joint angle; a gap that can be seen at this scale is a large tracking error.",
            True,
            lambda: joint_angles(log),
        ),
        (
            "joints",
            "Joint tracking errors",
            "Reference minus joint angle. The joints of a row share one scale, so the legs can be compared.",
            "reference/joint/position" in log,
            lambda: joint_errors(log),
        ),
        (
            "joints",
            "Joint torques",
            "Commanded torque and the feed-forward torque of the plan. What lies between the two is friction and whatever else the plan "
            "leaves out.",
            "joint/torque_command" in log,
            lambda: torques(log),
        ),
        (
            "forces",
            "Foot forces",
            "Measured vertical load of each foot and of all feet together, how much of the friction cone the feet use "
            "(tangential over vertical force), and the vertical force on every pad, or the centre of pressure under a six-axis sensor.",
            loaded_feet,
            lambda: foot_forces(log),
        ),
        (
            "friction",
            "Joint friction",
            "True friction torque of each joint, positive when it eats positive torque. "
            "It changes its sign where the joint turns round."
            + (" Thin: the law, in the joint farthest from it." if _farthest_from_law(log) else ""),
            friction_known and not friction_estimated,
            lambda: friction(log),
        ),
        (
            "friction",
            "Estimated joint friction",
            "Estimated friction torque of each joint, positive when it eats positive torque"
            + (", and the true one. " if friction_known else ". ")
            + "Grey: the joint's own leg swings, where the paper's method has no measurement and takes its model. "
            "Spikes of a few samples may leave a panel.",
            friction_estimated,
            lambda: estimated_friction(log),
        ),
        (
            "friction",
            "Error of the friction estimate",
            "Estimated minus true friction. The band is the root mean square (RMS) on either side of zero.",
            friction_known and friction_estimated,
            lambda: friction_errors(log),
        ),
        (
            "friction",
            "Friction over velocity",
            "The same torque against joint velocity: a step at zero is dry friction, a slope viscous friction, "
            "and a spread at one velocity means that friction depends on more than velocity"
            + (" (or that the estimate is noisy)." if friction_estimated else "."),
            (friction_known or friction_estimated)
            and ("truth/joint/velocity" in log or "joint/velocity" in log),
            lambda: friction_over_velocity(log),
        ),
        (
            "friction",
            "Identified friction parameters",
            "Parameters of the adopted friction model as they are learnt while the robot moves; bands are two standard deviations, where "
            "the filter knows them. A parameter settles only when its joint has moved enough to show it.",
            "estimate/friction/parameters" in log,
            lambda: friction_parameters(log),
        ),
        (
            "base",
            "Base attitude",
            "Roll and pitch of the base."
            if "truth/base/orientation" not in log
            else "Roll and pitch of the base, and the estimate's error.",
            "estimate/base/orientation" in log,
            lambda: base_attitude(log),
        ),
        (
            "base",
            "Base velocity",
            "Velocity of the base in the world"
            + (", and the estimate's error." if "truth/base/velocity" in log else "."),
            "estimate/base/velocity" in log,
            lambda: base_velocity(log),
        ),
        (
            "base",
            "Support",
            "Which feet stand, as planned and as estimated, and the measured load of each foot over the mean load of all feet.",
            "estimate/support" in log and bool(log.sides),
            lambda: support(log),
        ),
        (
            "consistency",
            "Consistency of the filters",
            f"Normalised innovation squared (NIS), averaged over the components and a sliding window of {_NIS_WINDOW:g} s. About 1: the "
            "filter's surprises are as large as it expects. Below, it trusts its measurements too little, above too much. The band holds "
            "95 % of white innovations; those that last, as of a trunk that accelerates, leave it. Feet are far below: what they do in "
            "spite of all lasts, and the filter takes it for white noise that leaves as much over many ticks.",
            bool(innovations.keys() - {"friction"})
            and any(
                _has_updates(parts) for name, parts in innovations.items() if name != "friction"
            ),
            lambda: filter_consistency(log),
        ),
        (
            "consistency",
            "Consistency of the friction filters",
            f"The same for the friction filter of each joint, averaged over {_NIS_WINDOW:g} s. Recursive least squares knows no noise in "
            "Nm; for it, this is the NIS for a noise of 1 Nm.",
            _has_updates(innovations.get("friction", {})),
            lambda: friction_consistency(log),
        ),
        (
            "consistency",
            "Status of sensors and estimators",
            "When a sensor was not trusted and which estimators that concerns. Not finite: a reading is not a number; stuck: it repeats "
            "itself to the last bit; lost: a foot does not show the load that it must carry.",
            any(values.any() for values in _statuses(log).values()),
            lambda: statuses(log),
        ),
        (
            "sensors",
            "IMU",
            "Measured specific force and angular velocity in the IMU's axes. At rest the specific force is gravity's opposite; "
            "a foot that lands shows as a spike.",
            "imu/linear_acceleration" in log and "imu/angular_velocity" in log,
            lambda: imu(log),
        ),
    ]
    topics: dict[str, list[FigureBlock]] = {}
    for topic, title, caption, available, draw in catalogue:
        blocks = topics.setdefault(topic, [])
        if available:
            blocks.append(FigureBlock(title, caption, draw()))
    return topics


def footprints(
    log: Log,
    *,
    outlines: Mapping[str, np.ndarray] | None = None,
    pads: Mapping[str, np.ndarray] | None = None,
) -> Figure:
    """Footholds, ZMP and CoM seen from above; the soles are taken to be turned as planned.

    Args:
        outlines: corners of each side's sole in its sole frame, (K, 2) [m]; of a side without it a foothold is a cross.
        pads: places of each side's pads in its sole frame, (pads, 3) [m]; without them no measured ZMP is drawn.
    """
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    axes = figure.subplots()
    decorate(axes)
    for source, label in (("truth", "{} foot"), ("reference", "planned foothold")):
        for side in log.sides if has_feet(log, f"{source}/foot/{{}}/position") else ():
            color = _side_color(log, side) if source == "truth" else PLANNED
            for place, R in _footholds(log, side, f"{source}/foot/{side}/position"):
                if outlines is None or side not in outlines:
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
    if pads is not None and _feels_feet(log) and has_feet(log, "truth/foot/{}/position"):
        axes.plot(
            *_measured_zmp(log, pads)[_stride(log)].T,
            color=_ZMP,
            linewidth=0.7,
            alpha=0.7,
            label="measured ZMP",
        )
    for channel, color, line, width, label in (
        ("reference/zmp", _ZMP, "--", 1.4, "planned ZMP"),
        ("truth/com/position", _COM, "-", 2.0, "true CoM"),
        ("reference/com/position", _TRUE, "--", 1.0, "planned CoM"),
    ):
        if channel in log:
            axes.plot(
                *log[channel][_stride(log), :2].T,
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


def com(log: Log) -> Figure:
    """Desired, true and estimated centre of mass in x and y, and the root square errors of motion and estimate (as the paper's Fig. 8)."""
    estimated, known = "estimate/com/position" in log, "truth/com/position" in log
    errors: list[tuple[str, str, np.ndarray]] = []
    if known and "reference/com/position" in log:
        errors.append(("RSE", _COM, com_rse(log)))
    if known and estimated:
        errors.append(
            (
                "RSE of estimate",
                ESTIMATE,
                np.abs(log["estimate/com/position"] - log["truth/com/position"])[:, :2],
            )
        )
    figure, grid = _time_grid(log, 2, 1 + len(errors), height=5.6)
    for letter, axes in zip("abcdef", grid.flat, strict=False):
        axes.set_title(f"({letter})", loc="left", fontsize=10)
    lines: tuple[tuple[str, dict[str, Any]], ...] = (
        ("estimate", {"color": ESTIMATE, "label": "estimated", **_BROAD}),
        ("truth", {"color": _COM, "label": "true"}),
        ("reference", {"color": _TRUE, "linestyle": "--", "linewidth": 1.0, "label": "desired"}),
    )
    for (position, *error_axes), name, column in zip(grid, "xy", (0, 1), strict=True):
        for source, style in lines:
            if f"{source}/com/position" in log:
                _plot(position, log, log[f"{source}/com/position"][:, column], **style)
        position.set_ylabel(f"CoM {name} [m]")
        position.set_ylim(_at_least(position.get_ylim(), _POSITION_SPAN))
        for axes, (label, color, error) in zip(error_axes, errors, strict=True):
            _plot(axes, log, 1e3 * error[:, column], color=color)
            axes.set_ylabel(f"{label} {name} [mm]")
            axes.set_ylim(0, max(1.0, axes.get_ylim()[1]))
    add_legend(figure)
    return figure


def feet(log: Log) -> Figure:
    """True and planned x and z of the soles, with the phases named (as the paper's Fig. 5)."""
    figure, grid = _time_grid(log, 2, 1, height=5.6)
    for axes, name, column in zip(grid.flat, "xz", (0, 2), strict=True):
        # Thinner lines on thicker ones: where the feet agree, both can be seen.
        for side, width in zip(log.sides, np.linspace(3, 2, len(log.sides)), strict=True):
            values = log[f"truth/foot/{side}/position"][:, column]
            _plot(
                axes,
                log,
                values,
                color=_side_color(log, side),
                linewidth=width,
                label=f"{side} foot",
            )
        for side in log.sides if has_feet(log, "reference/foot/{}/position") else ():
            values = log[f"reference/foot/{side}/position"][:, column]
            _plot(axes, log, values, color=_TRUE, linewidth=0.9, linestyle="--", label="planned")
        axes.set_ylabel(f"{name} [m]")
        axes.set_ylim(_at_least(axes.get_ylim(), _POSITION_SPAN))
    _name_phases(grid[0, 0], log)
    add_legend(figure)
    return figure


def joint_angles(log: Log) -> Figure:
    """Reference and true joint angles (measured ones in a log without truth), a panel for each joint."""
    figure, panels = _joint_grid(log, "joint angle [rad]")
    name = joint_position_channel(log)
    for joint, axes in panels.items():
        _plot(axes, log, log[name][:, joint], **_joint_style(log, joint, _source(name)))
        if "reference/joint/position" in log:
            values = log["reference/joint/position"][:, joint]
            _plot(axes, log, values, color=_TRUE, linewidth=0.9, linestyle="--", label="reference")
    _widen(panels, _POSITION_SPAN)
    add_legend(figure)
    return figure


def joint_errors(log: Log) -> Figure:
    """Reference minus true joint angle (measured in a log without truth), a panel for each joint."""
    figure, panels = _joint_grid(log, "reference minus joint angle [mrad]")
    error = 1e3 * (log["reference/joint/position"] - log[joint_position_channel(log)])
    for joint, axes in panels.items():
        _plot(axes, log, error[:, joint], color=_joint_color(log, joint))
    _widen(panels, _ERROR_SPAN)
    add_legend(figure)
    return figure


def torques(log: Log) -> Figure:
    """Commanded and, where planned, feed-forward torque, a panel for each joint."""
    figure, panels = _joint_grid(log, "torque [Nm]")
    for joint, axes in panels.items():
        _plot(
            axes,
            log,
            log["joint/torque_command"][:, joint],
            **_joint_style(log, joint, "commanded"),
        )
        if "reference/joint/feedforward_torque" in log:
            values = log["reference/joint/feedforward_torque"][:, joint]
            _plot(
                axes, log, values, color=_TRUE, linewidth=0.9, linestyle="--", label="feed-forward"
            )
    add_legend(figure)
    return figure


def foot_forces(log: Log) -> Figure:
    """Measured load of the feet: vertical, tangential over vertical, and vertical on each pad, or where it acts."""
    figure, grid = _time_grid(log, 2 + len(log.sides), 1, height=5 + 1.9 * len(log.sides))
    vertical, ratio, *pad_axes = grid.flat
    force = {side: _force(log, side) for side in log.sides}
    total = np.sum([force[side][:, 2] for side in log.sides], axis=0)
    weight = total.mean()
    _plot(vertical, log, total, color=_TRUE, linewidth=0.8, alpha=0.6, label="all feet")
    for side, width in zip(log.sides, np.linspace(1.8, 1, len(log.sides)), strict=True):
        _plot(
            vertical,
            log,
            force[side][:, 2],
            color=_side_color(log, side),
            linewidth=width,
            label=f"{side} foot",
        )
        loaded = force[side][:, 2] > _LOADED_SHARE * weight
        used = np.full(len(total), np.nan)
        used[loaded] = np.linalg.norm(force[side][loaded, :2], axis=1) / force[side][loaded, 2]
        _plot(ratio, log, used, color=_side_color(log, side))
    vertical.axhline(weight, color=PLANNED, linestyle="--", linewidth=0.9, label="mean of all feet")
    vertical.set_ylabel("vertical [N]")
    ratio.set_ylabel("tangential / vertical [1]")
    ratio.set_ylim(0, max(0.1, ratio.get_ylim()[1]))
    for side, axes in zip(log.sides, pad_axes, strict=True):
        if f"foot/{side}/pad_force" not in log:
            pressure = np.where(
                force[side][:, 2:] > _LOADED_SHARE * weight, _centre_of_pressure(log, side), np.nan
            )
            for values, name, shade in zip(
                pressure.T, ("ahead", "to the left"), (1, 0.5), strict=True
            ):
                _plot(
                    axes,
                    log,
                    1e3 * values,
                    color=_side_color(log, side),
                    alpha=shade,
                    linewidth=1.0,
                    label=name,
                )
            axes.set_ylabel(f"{side} pressure, centre [mm]")
            continue
        pads = log[f"foot/{side}/pad_force"][:, :, 2].T
        for pad, (values, shade) in enumerate(
            zip(pads, np.linspace(1, 0.3, len(pads)), strict=True), start=1
        ):
            _plot(
                axes,
                log,
                values,
                color=_side_color(log, side),
                alpha=shade,
                linewidth=1.0,
                label=f"pad {pad}",
            )
        axes.set_ylabel(f"{side} pads, vertical [N]")
    for axes in (vertical, *pad_axes):
        axes.legend(
            handles=axes.get_lines(), loc="center left", bbox_to_anchor=(1, 0.5), frameon=False
        )
    _name_phases(vertical, log)
    return figure


def friction(log: Log) -> Figure:
    """True friction torque, a panel for each joint (as the truth in the paper's Fig. 6).

    Where simulated joints do not follow their laws, also the law of the worst one.
    """
    figure, panels = _joint_grid(log, "friction torque [Nm]")
    for joint, axes in panels.items():
        values = log["truth/joint/friction_torque"][:, joint]
        _plot(axes, log, values, color=TRUTH, linestyle="--", linewidth=1.0, label="true friction")
    if joint := _farthest_from_law(log):
        column = log.joints.index(joint)
        law = log["truth/joint/friction_law_torque"][:, column]
        label = f"its law, {joint.replace('_', ' ')}"
        _plot(panels[column], log, law, color=_TRUE, linewidth=0.5, label=label)
    _widen(panels, _FRICTION_SPAN)
    add_legend(figure)
    return figure


def estimated_friction(log: Log) -> Figure:
    """Estimated and, where known, true friction torque, a panel for each joint, with the leg's swings shaded (as the paper's Fig. 6).

    A band is twice the estimate's standard deviation.
    """
    figure, panels = _joint_grid(log, "friction torque [Nm]", own_swing=True)
    estimate, deviation = (
        log["estimate/joint/friction_torque"],
        log.get("estimate/joint/friction_torque_std"),
    )
    truth = (
        ended_step(log["truth/joint/friction_torque"])
        if "truth/joint/friction_torque" in log
        else None
    )
    for joint, axes in panels.items():
        _plot(axes, log, estimate[:, joint], **_joint_style(log, joint, "estimated"), **_BROAD)
        if deviation is not None:
            thin = _stride(log)
            edges = (estimate[thin, joint] + sign * deviation[thin, joint] for sign in (-2, 2))
            axes.fill_between(
                log.time[thin],
                *edges,
                color=_joint_color(log, joint),
                alpha=0.2,
                linewidth=0,
                label="± 2 std",
            )
        if truth is not None:
            _plot(axes, log, truth[:, joint], **_THIN, label="true friction")
    _limit(log, panels, estimate, whole=truth, span=_FRICTION_SPAN)
    add_legend(figure)
    return figure


def friction_errors(log: Log) -> Figure:
    """Estimated minus true friction torque with its root mean square, a panel for each joint."""
    figure, panels = _joint_grid(log, "estimated minus true friction [Nm]", own_swing=True)
    error = friction_error(log)
    rms = (
        np.sqrt(np.mean(error[settled(log)] ** 2, axis=0))
        if settled(log).any()
        else np.full(len(log.joints), np.nan)
    )
    for joint, axes in panels.items():
        _plot(axes, log, error[:, joint], color=_joint_color(log, joint), linewidth=0.9)
        if np.isfinite(rms[joint]):
            axes.axhspan(
                -rms[joint],
                rms[joint],
                facecolor=TRUTH,
                alpha=0.15,
                linewidth=0,
                zorder=3,
                label="± RMS",
            )
            for edge in (-rms[joint], rms[joint]):
                axes.axhline(edge, color=TRUTH, linewidth=0.9, linestyle="--", zorder=4)
            axes.set_title(
                f"RMS {number(float(rms[joint]), 2)} Nm",
                loc="right",
                fontsize=9,
                pad=3,
                color=PLANNED,
            )
    _limit(log, panels, error, span=_FRICTION_SPAN)
    add_legend(figure)
    return figure


def friction_over_velocity(log: Log) -> Figure:
    """Friction torque, estimated and true as far as known, against joint velocity, a panel for the joints that the sides have in common.

    The torque of each step against the velocity at its end, on which its law depends.
    """
    rows = _joint_rows(log)
    columns = min(3, len(rows))
    figure = Figure(figsize=(WIDTH, 0.6 + 2.6 * -(-len(rows) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(rows) // columns), columns, squeeze=False)
    for axes in grid.flat[len(rows) :]:
        axes.set_axis_off()
    velocity = log["truth/joint/velocity" if "truth/joint/velocity" in log else "joint/velocity"]
    truth = log.get("truth/joint/friction_torque")
    if truth is not None:
        # No step ends in the first row.
        truth = np.concatenate([truth[:1], truth[:-1]])
    estimate = log.get("estimate/joint/friction_torque")
    for axes, (role, joints) in zip(grid.flat, rows.items(), strict=False):
        decorate(axes)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(role.replace("_", " "), loc="left", fontsize=10)
        shown = estimate if estimate is not None else truth
        # Smaller dots on larger ones: where the sides agree, both can be seen.
        for (side, joint), size in zip(
            joints.items(), np.linspace(4.5, 2, max(2, len(joints))), strict=False
        ):
            label = f"{'estimated, ' if estimate is not None else ''}{side} leg" if side else None
            _dots(
                axes,
                velocity[_stride(log), joint],
                shown[_stride(log), joint],
                _joint_color(log, joint),
                size,
                label,
            )
        if estimate is not None and truth is not None:
            for joint in joints.values():
                _dots(
                    axes,
                    velocity[_stride(log), joint],
                    truth[_stride(log), joint],
                    TRUTH,
                    1.8,
                    "true friction",
                )
        axes.set_xlim(_at_least(axes.get_xlim(), _VELOCITY_SPAN))
        if estimate is None:
            axes.set_ylim(_at_least(axes.get_ylim(), _FRICTION_SPAN))
        else:
            _limit(
                log,
                dict.fromkeys(joints.values(), axes),
                estimate,
                whole=truth,
                span=_FRICTION_SPAN,
            )
    figure.supxlabel("joint velocity [rad/s]", fontsize=10)
    figure.supylabel("friction torque [Nm]", fontsize=10)
    add_legend(figure, marker_size=9)
    return figure


def friction_parameters(log: Log) -> Figure:
    """Identified parameters of the friction model, a column for each parameter and a row for the joints that the sides have in common."""
    values = log["estimate/friction/parameters"]
    config = _friction_config(log)
    linear = (
        {}
        if config is None
        else {
            name: parameter
            for name, parameter in config.model.parameters.items()
            if parameter.linear
        }
    )
    titles = [f"{name} [{parameter.unit}]" for name, parameter in linear.items()]
    if len(titles) != values.shape[2]:
        titles = [f"parameter {place}" for place in range(1, values.shape[2] + 1)]
    # The variance of recursive least squares is in units of a noise that it does not know.
    deviation = None
    if isinstance(config, ModelAided) and "estimate/friction/parameter_variance" in log:
        deviation = np.sqrt(np.maximum(0.0, log["estimate/friction/parameter_variance"]))
    rows = _joint_rows(log)
    figure, grid = _time_grid(
        log, len(rows), len(titles), height=0.8 + 1.55 * len(rows), phases=False
    )
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, loc="left", fontsize=10)
    for (role, joints), row in zip(rows.items(), grid, strict=True):
        row[0].set_ylabel(role.replace("_", " "))
        for parameter, axes in enumerate(row):
            for joint in joints.values():
                curve = values[:, joint, parameter]
                _plot(axes, log, curve, **_joint_style(log, joint, "identified"))
                if deviation is not None:
                    band, color = 2 * deviation[:, joint, parameter], _joint_color(log, joint)
                    thin = _stride(log)
                    axes.fill_between(
                        log.time[thin],
                        (curve - band)[thin],
                        (curve + band)[thin],
                        color=color,
                        alpha=0.2,
                        linewidth=0,
                        label="± 2 standard deviations",
                    )
            shown = values[:, list(joints.values()), parameter]
            axes.set_ylim(_readable(log, shown, span=_FRICTION_SPAN))
    add_legend(figure)
    return figure


def base_attitude(log: Log) -> Figure:
    """Roll and pitch of the base, estimated and true, and the error."""
    channels = ("estimate/base/orientation", "truth/base/orientation")
    estimate, truth = (
        roll_and_pitch_deg(log[channel]) if channel in log else None for channel in channels
    )
    error = attitude_error_deg(log) if truth is not None else None
    return _estimate_and_error(
        log,
        ("roll", "pitch"),
        ("deg", "deg"),
        (estimate, truth, error),
        (_ANGLE_SPAN, _ANGLE_ERROR_SPAN),
    )


def base_velocity(log: Log) -> Figure:
    """Velocity of the base in the world, estimated and true, and the error."""
    error = 1e3 * base_velocity_error(log) if "truth/base/velocity" in log else None
    curves = (log["estimate/base/velocity"], log.get("truth/base/velocity"), error)
    return _estimate_and_error(
        log, "xyz", ("m/s", "mm/s"), curves, (_BASE_VELOCITY_SPAN, _BASE_VELOCITY_ERROR_SPAN)
    )


def support(log: Log) -> Figure:
    """Planned and estimated stance and measured load of each foot."""
    figure, grid = _time_grid(
        log, len(log.sides), 1, height=1.0 + 1.9 * len(log.sides), phases=False
    )
    forces = {side: _force(log, side)[:, 2] for side in log.sides} if _feels_feet(log) else {}
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
                "facecolor": _side_color(log, side),
                "alpha": strength,
                "linewidth": 0,
                "label": label,
            }
            axes.broken_barh(_stretches(log, stands[foot]), (-0.22 * place, 0.16), **style)
        if weight > 0:
            _plot(
                axes,
                log,
                forces[side] / weight,
                color=_TRUE,
                linewidth=0.8,
                label="load / mean load of all feet",
            )
        axes.set_ylabel(f"{side} foot [1]")
        axes.set_ylim(-0.22 * len(strips) - 0.06, 1.4)
        axes.set_yticks([0, 0.5, 1])
    _name_phases(grid[0, 0], log)
    add_legend(figure)
    return figure


def filter_consistency(log: Log) -> Figure:
    """NIS of the filters but those of the friction, a panel for each filter."""
    filters = {
        name: parts
        for name, parts in normalised_innovations(log).items()
        if name != "friction" and _has_updates(parts)
    }
    figure, grid = _time_grid(log, len(filters), 1, height=0.8 + 2.0 * len(filters))
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


def friction_consistency(log: Log) -> Figure:
    """NIS of the friction filter of each joint."""
    figure, panels = _joint_grid(log, "NIS [1]", own_swing=True)
    parts = list(normalised_innovations(log)["friction"].values())
    for joint, axes in panels.items():
        label = str(_joint_style(log, joint, "NIS")["label"])
        _plot_nis(axes, log, {label: parts[joint]}, {label: _joint_color(log, joint)})
    add_legend(figure)
    return figure


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
                _stretches(log, values == status),
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


def imu(log: Log) -> Figure:
    """Measured specific force and angular velocity in the IMU frame."""
    figure, grid = _time_grid(log, 3, 2, height=6.2)
    columns = (
        ("imu/linear_acceleration", "specific force", "m/s²"),
        ("imu/angular_velocity", "angular velocity", "rad/s"),
    )
    for (channel, title, unit), column in zip(columns, grid.T, strict=True):
        column[0].set_title(title, loc="left", fontsize=10)
        for axes, values, name in zip(column, log[channel].T, "xyz", strict=True):
            _plot(axes, log, values, color=PLANNED, linewidth=0.8)
            axes.set_ylabel(f"{name} [{unit}]")
    add_legend(figure)
    return figure


def _hangs(log: Log) -> bool:
    """Whether no foot ever touches the ground; known only from truth."""
    return has_feet(log, "truth/foot/{}/pad_force") and not any(
        log[f"truth/foot/{side}/pad_force"].any() for side in log.sides
    )


def _source(channel: str) -> str:
    return "true" if channel.startswith("truth/") else "measured"


def _side_color(log: Log, side: str) -> str:
    return SIDE_COLORS[log.sides.index(side) % len(SIDE_COLORS)]


def _joint_color(log: Log, joint: int) -> str:
    side = joint_sides(log)[joint]
    return _TRUE if side is None else _side_color(log, side)


def _joint_style(log: Log, joint: int, label: str) -> dict[str, str]:
    side = joint_sides(log)[joint]
    return {
        "color": _joint_color(log, joint),
        "label": label if side is None else f"{label}, {side}",
    }


def _joint_rows(log: Log) -> dict[str, dict[str, int]]:
    """Columns of the joints in the log by what they are called without their side, and by side."""
    rows: dict[str, dict[str, int]] = {}
    for column, (name, side) in enumerate(zip(log.joints, joint_sides(log), strict=True)):
        rows.setdefault(name if side is None else name.removeprefix(f"{side}_"), {})[side or ""] = (
            column
        )
    return rows


def _farthest_from_law(log: Log) -> str | None:
    """The joint whose simulated torque is farthest from its law; None if all follow theirs."""
    return next(iter(broken_laws(friction_law_error(log))), None)


def _friction_config(log: Log) -> FrictionConfig | None:
    """How the log's friction was estimated, by the scenario that it holds; None where that does not tell."""
    text = log.meta.get("estimator_scenario", log.meta.get("scenario"))
    if not text:
        return None
    try:
        tree = yaml_load(data=text)
        scenario = schema.build(Scenario, next(iter(tree.values())), file="log")
    except (InputError, yaml.YAMLError, AttributeError, StopIteration):
        # A log of another version, or of another program.
        return None
    return scenario.estimator.friction if isinstance(scenario.estimator, Fbse) else None


def _statuses(log: Log) -> dict[str, np.ndarray]:
    """Status over time (N,) by sensor and estimator."""
    found = {}
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


def _stretches(log: Log, holds: np.ndarray) -> list[tuple[float, float]]:
    """Start and length [s] of the stretches of time in which something holds, (N,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int))).reshape(
        -1, 2
    )
    ends = np.append(log.time, log.time[-1])
    return [(float(log.time[start]), float(ends[end] - log.time[start])) for start, end in edges]


def _footholds(log: Log, side: str, channel: str) -> Iterable[tuple[np.ndarray, np.ndarray]]:
    """Where the sole is in the middle of each planned stance, (2,) [m], and how it is planned to be turned, (2, 2)."""
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
            forces.append(_force(log, side)[:, None])
            centre = np.pad(_centre_of_pressure(log, side), ((0, 0), (0, 1)))
            places.append(sole + np.einsum("nij,nj->ni", R, centre)[:, None])
    return zero_moment_point(np.concatenate(forces, axis=1), np.concatenate(places, axis=1))


def _feels_feet(log: Log) -> bool:
    """Whether the forces on all feet were measured, by pads or by six-axis sensors."""
    return bool(log.sides) and all(
        f"foot/{side}/pad_force" in log or f"foot/{side}/wrench" in log for side in log.sides
    )


def _force(log: Log, side: str) -> np.ndarray:
    """Measured force on a foot, in its sole frame, (N, 3) [N]."""
    pads = f"foot/{side}/pad_force"
    return log[pads].sum(axis=1) if pads in log else log[f"foot/{side}/wrench"][:, 3:]


def _centre_of_pressure(log: Log, side: str) -> np.ndarray:
    """Where the force under a six-axis sensor acts, in the sole frame, (N, 2) [m]; the sole's origin where there is hardly any."""
    m_x, m_y, _, _, _, f_z = log[f"foot/{side}/wrench"].T
    return np.stack([-m_y, m_x], axis=1) / np.where(f_z > 1.0, f_z, np.inf)[:, None]


def _stride(log: Log) -> slice:
    return slice(None, None, max(1, len(log.time) // (2 * _POINTS)))


def _plot(axes: Axes, log: Log, values: np.ndarray, **style: Any) -> None:
    """Draws values (N,) over time; of a long series the smallest and the largest of each short stretch, so that no spike is lost."""
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


def _dots(
    axes: Axes, x: np.ndarray, y: np.ndarray, color: str, size: float, label: str | None
) -> None:
    axes.plot(x, y, ".", color=color, markersize=size, markeredgewidth=0, label=label)


def _plot_nis(
    axes: Axes, log: Log, curves: Mapping[str, np.ndarray], colors: Mapping[str, str]
) -> None:
    """Draws NIS, averaged over a sliding window, with its 95 % band on a logarithmic scale; curves (N, components) have equal shapes."""
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
        thin = _stride(log)
        axes.plot(log.time[thin], mean[thin], color=colors[label], linewidth=1.1, label=label)
    window = float(np.median(end - start)) * next(iter(curves.values())).shape[1]
    lower, upper = nis_bounds(np.array(window)).tolist()
    axes.axhspan(
        lower, upper, facecolor=_TRUE, alpha=0.25, linewidth=0, label="95 % of white innovations"
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
    figure, grid = _time_grid(
        log, len(names), 1 if error is None else 2, height=0.9 + 1.75 * len(names)
    )
    for column, (name, row) in enumerate(zip(names, grid, strict=True)):
        _plot(row[0], log, estimate[:, column], color=ESTIMATE, label="estimated", **_BROAD)
        if truth is not None:
            _plot(row[0], log, truth[:, column], **_THIN, label="true")
        row[0].set_ylabel(f"{name} [{units[0]}]")
        row[0].set_ylim(
            _readable(
                log,
                estimate[:, column],
                whole=None if truth is None else truth[:, column],
                span=spans[0],
            )
        )
        if error is not None:
            _plot(row[1], log, error[:, column], color=ESTIMATE, linewidth=0.9)
            row[1].set_ylabel(f"error of {name} [{units[1]}]")
            row[1].set_ylim(_readable(log, error[:, column], span=spans[1]))
    add_legend(figure)
    return figure


def _readable(
    log: Log, estimate: np.ndarray, *, whole: np.ndarray | None = None, span: float
) -> tuple[float, float]:
    """Limits that show an estimate without its shortest spikes and without the filters' settling, and all of `whole`; (N, ...) each."""
    curves = estimate.reshape(len(log.time), -1)
    known = np.isfinite(curves).all(axis=1)
    shown = curves[known & settled(log)] if (known & settled(log)).any() else curves[known]
    values = np.quantile(shown, _SHOWN_QUANTILES, axis=0).ravel() if len(shown) else np.zeros(1)
    if whole is not None:
        values = np.append(values, whole[np.isfinite(whole)])
    margin = 0.08 * (values.max() - values.min())
    return _at_least((float(values.min() - margin), float(values.max() + margin)), span)


def _limit(
    log: Log,
    panels: Mapping[int, Axes],
    estimate: np.ndarray,
    *,
    whole: np.ndarray | None = None,
    span: float,
) -> None:
    """Gives panels of joints, which share limits along a row, limits as by `_readable`."""
    for joints in _joint_rows(log).values():
        columns = [joint for joint in joints.values() if joint in panels]
        if columns:
            limits = _readable(
                log,
                estimate[:, columns],
                whole=None if whole is None else whole[:, columns],
                span=span,
            )
            panels[columns[0]].set_ylim(limits)


def _time_grid(
    log: Log, rows: int, columns: int, *, height: float, phases: bool = True
) -> tuple[Figure, np.ndarray]:
    """A figure with panels over time that show the phases, if so wished; panels have shape (rows, columns)."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for axes in grid.flat:
        if phases:
            _decorate_time(axes, log)
        else:
            decorate(axes)
            axes.margins(x=0)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    figure.align_ylabels()
    return figure, grid


def _joint_grid(
    log: Log, quantity: str, *, own_swing: bool = False
) -> tuple[Figure, dict[int, Axes]]:
    """A figure with a panel over time for each joint, by its column in the log: a row for each role, a column for each side.

    Args:
        own_swing: shades when the joint's own leg swings instead of the single supports.
    """
    joint_rows = list(_joint_rows(log).values())
    columns = max(len(row) for row in joint_rows)
    figure = Figure(figsize=(WIDTH, 0.8 + 1.55 * len(joint_rows)), layout="constrained")
    grid = figure.subplots(len(joint_rows), columns, sharex=True, sharey="row", squeeze=False)
    panels = {}
    for row, row_axes in zip(joint_rows, grid, strict=True):
        for axes in row_axes[len(row) :]:
            axes.set_axis_off()
        for joint, axes in zip(row.values(), row_axes, strict=False):
            _decorate_time(axes, log, swing_of=joint_sides(log)[joint] if own_swing else None)
            axes.set_title(log.joints[joint].replace("_", " "), loc="left", fontsize=10, pad=3)
            panels[joint] = axes
    figure.supxlabel("time [s]", fontsize=10)
    figure.supylabel(quantity, fontsize=10)
    return figure, panels


def decorate(axes: Axes) -> None:
    """Gives a panel the looks that all have."""
    axes.grid(color="#dfe2e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#8a9199")
    axes.tick_params(labelsize=9, color="#8a9199")
    axes.locator_params(nbins="auto", steps=[1, 2, 5, 10])


def _decorate_time(axes: Axes, log: Log, *, swing_of: str | None = None) -> None:
    """Also shades the single supports in the colour of the leg that stands, or when the leg of one side swings."""
    decorate(axes)
    axes.margins(x=0)
    for phase in support_phases(log):
        if swing_of is not None:
            if swing_of not in phase.support:
                axes.axvspan(
                    phase.start,
                    phase.end,
                    facecolor=_SWING,
                    alpha=0.22,
                    linewidth=0,
                    label="the joint's leg swings",
                )
        elif phase.is_single:
            side = phase.support[0]
            axes.axvspan(
                phase.start,
                phase.end,
                facecolor=_side_color(log, side),
                alpha=0.12,
                linewidth=0,
                label=f"{' and '.join(phase.support)} leg supports",
            )


def _at_least(limits: tuple[float, float], span: float) -> tuple[float, float]:
    """An axis' limits, widened on both sides to at least `span`, so that noise about a constant looks like a constant."""
    missing = max(0.0, span - (limits[1] - limits[0]))
    return limits[0] - missing / 2, limits[1] + missing / 2


def _widen(panels: Mapping[int, Axes], span: float) -> None:
    # Only when everything is drawn: setting limits ends the automatic scaling of the whole row.
    for axes in panels.values():
        axes.set_ylim(_at_least(axes.get_ylim(), span))


def _name_phases(axes: Axes, log: Log) -> None:
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


def add_legend(
    figure: Figure, *, marker_size: float | None = None, without: Collection[str] = ()
) -> None:
    """One legend above all panels: every label once but for those `without`, solid lines before dashed ones before areas.

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
    for handle in legend.legend_handles if marker_size is not None else ():
        handle.set(markersize=marker_size)
