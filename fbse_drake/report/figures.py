"""Pictures of a log: one function per figure.

Sides, joints and phases are taken from the log. Colours stand for sides, in the log's order; solid is what happened, dashed what was
planned. Nothing here touches pyplot or matplotlib's global settings.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from fbse_drake.estimators.zmp import zero_moment_point
from fbse_drake.log import Log
from fbse_drake.report.html import FigureBlock
from fbse_drake.report.metrics import com_rse
from fbse_drake.walking.plan import Phase

_SIDE_COLORS = ("#2979b5", "#d65f1a", "#2f8f6b", "#8457a8")
_PLANNED = "#555b62"
_TRUE = "#15181b"
_COM = "#7a4fa3"
_ZMP = "#2f8f6b"
_FRICTION = "#c81e1e"

_WIDTH = 10.0
# Points drawn of one line, about two per pixel of a wide panel.
_POINTS = 2000
# The least that a panel shows of a quantity.
_POSITION_SPAN = 0.05  # [m or rad]
_ERROR_SPAN = 0.2  # [mrad]
_FRICTION_SPAN = 0.1  # [Nm]
_VELOCITY_SPAN = 0.01  # [rad/s]
# The direction of a foot's force means little below this share of the feet's mean load.
_LOADED_SHARE = 0.05


def support_phases(log: Log) -> list[Phase]:
    """The plan's phases in order of time; none for a log without planned support."""
    if not _has_feet(log, "reference/foot/{}/support"):
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
    """The figures that this log has the channels for, in order, by topic: walk, joints, forces, friction, sensors.

    Args:
        outlines, pads: see `footprints`.
    """
    planned_feet = _has_feet(log, "reference/foot/{}/support") and _has_feet(log, "reference/foot/{}/position")
    loaded_feet = _has_feet(log, "foot/{}/pad_force") and not _hangs(log)
    friction_known = "truth/joint/friction_torque" in log
    supports = ", ".join(f"{Phase(0, 0, (side,)).label} support by the {side} leg alone" for side in log.sides)
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
            "Desired and true CoM, and their root square error (RSE).",
            "reference/com/position" in log and "truth/com/position" in log,
            lambda: com(log),
        ),
        (
            "walk",
            "Feet",
            f"Origins of the soles, true and planned. DS is double support, {supports}.",
            _has_feet(log, "truth/foot/{}/position"),
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
            True,
            lambda: torques(log),
        ),
        (
            "forces",
            "Foot forces",
            "Measured vertical load of each foot and of all feet together, how much of the friction cone the feet use "
            "(tangential over vertical force), and the vertical force on every pad.",
            loaded_feet,
            lambda: foot_forces(log),
        ),
        (
            "friction",
            "Joint friction",
            "True friction torque of each joint, positive when it eats positive torque. It changes its sign where the joint turns round.",
            friction_known,
            lambda: friction(log),
        ),
        (
            "friction",
            "Friction over velocity",
            "The same torque against joint velocity: a step at zero is dry friction, a slope viscous friction, "
            "and a spread at one velocity means that friction depends on more than velocity.",
            friction_known and "truth/joint/velocity" in log,
            lambda: friction_over_velocity(log),
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


def footprints(log: Log, *, outlines: Mapping[str, np.ndarray] | None = None, pads: Mapping[str, np.ndarray] | None = None) -> Figure:
    """Footholds, ZMP and CoM seen from above; the soles are taken to be parallel to the world's axes.

    Args:
        outlines: corners of each side's sole in its sole frame, (K, 2) [m]; without them a foothold is a cross.
        pads: places of each side's pads in its sole frame, (pads, 3) [m]; without them no measured ZMP is drawn.
    """
    figure = Figure(figsize=(_WIDTH, 5.2), layout="constrained")
    axes = figure.subplots()
    _decorate(axes)
    for source, label in (("truth", "{} foot"), ("reference", "planned foothold")):
        for side in log.sides if _has_feet(log, f"{source}/foot/{{}}/position") else ():
            color = _side_color(log, side) if source == "truth" else _PLANNED
            for place in _footholds(log, side, f"{source}/foot/{side}/position"):
                if outlines is None:
                    axes.plot(*place, "x" if source == "truth" else "+", color=color, markersize=10, label=label.format(side))
                else:
                    patch = Polygon(place + outlines[side], edgecolor=color, label=label.format(side))
                    patch.set(**({"facecolor": f"{color}38"} if source == "truth" else {"fill": False, "linestyle": "--"}))
                    axes.add_patch(patch)
    if pads is not None and _has_feet(log, "foot/{}/pad_force") and _has_feet(log, "truth/foot/{}/position"):
        axes.plot(*_measured_zmp(log, pads)[_stride(log)].T, color=_ZMP, linewidth=0.7, alpha=0.7, label="measured ZMP")
    for channel, color, line, width, label in (
        ("reference/zmp", _ZMP, "--", 1.4, "planned ZMP"),
        ("truth/com/position", _COM, "-", 2.0, "true CoM"),
        ("reference/com/position", _TRUE, "--", 1.0, "planned CoM"),
    ):
        if channel in log:
            axes.plot(*log[channel][_stride(log), :2].T, color=color, linestyle=line, linewidth=width, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, forward [m]")
    axes.set_ylabel("y, to the left [m]")
    _add_legend(figure)
    return figure


def com(log: Log) -> Figure:
    """Desired and true centre of mass in x and y, and their root square error (as the paper's Fig. 8)."""
    figure, grid = _time_grid(log, 2, 2, height=5.6)
    error = 1e3 * com_rse(log)
    for letter, axes in zip("abcd", grid.flat, strict=True):
        axes.set_title(f"({letter})", loc="left", fontsize=10)
    for (position, rse), name, column in zip(grid, "xy", (0, 1), strict=True):
        _plot(position, log, log["truth/com/position"][:, column], color=_COM, label="true")
        _plot(position, log, log["reference/com/position"][:, column], color=_TRUE, linestyle="--", linewidth=1.0, label="desired")
        _plot(rse, log, error[:, column], color=_COM)
        position.set_ylabel(f"CoM {name} [m]")
        rse.set_ylabel(f"RSE {name} [mm]")
        rse.set_ylim(0, max(1.0, rse.get_ylim()[1]))
        position.set_ylim(_at_least(position.get_ylim(), _POSITION_SPAN))
    _add_legend(figure)
    return figure


def feet(log: Log) -> Figure:
    """True and planned x and z of the soles, with the phases named (as the paper's Fig. 5)."""
    figure, grid = _time_grid(log, 2, 1, height=5.6)
    for axes, name, column in zip(grid.flat, "xz", (0, 2), strict=True):
        # Thinner lines on thicker ones: where the feet agree, both can be seen.
        for side, width in zip(log.sides, np.linspace(3, 2, len(log.sides)), strict=True):
            values = log[f"truth/foot/{side}/position"][:, column]
            _plot(axes, log, values, color=_side_color(log, side), linewidth=width, label=f"{side} foot")
        for side in log.sides if _has_feet(log, "reference/foot/{}/position") else ():
            values = log[f"reference/foot/{side}/position"][:, column]
            _plot(axes, log, values, color=_TRUE, linewidth=0.9, linestyle="--", label="planned")
        axes.set_ylabel(f"{name} [m]")
        axes.set_ylim(_at_least(axes.get_ylim(), _POSITION_SPAN))
    _name_phases(grid[0, 0], log)
    _add_legend(figure)
    return figure


def joint_angles(log: Log) -> Figure:
    """Reference and true joint angles (measured ones in a log without truth), a panel for each joint."""
    figure, panels = _joint_grid(log, "joint angle [rad]")
    name = _joint_position(log)
    for joint, axes in panels.items():
        _plot(axes, log, log[name][:, joint], **_joint_style(log, joint, _source(name)))
        if "reference/joint/position" in log:
            values = log["reference/joint/position"][:, joint]
            _plot(axes, log, values, color=_TRUE, linewidth=0.9, linestyle="--", label="reference")
    _widen(panels, _POSITION_SPAN)
    _add_legend(figure)
    return figure


def joint_errors(log: Log) -> Figure:
    """Reference minus true joint angle (measured in a log without truth), a panel for each joint."""
    figure, panels = _joint_grid(log, "reference minus joint angle [mrad]")
    error = 1e3 * (log["reference/joint/position"] - log[_joint_position(log)])
    for joint, axes in panels.items():
        _plot(axes, log, error[:, joint], color=_joint_color(log, joint))
    _widen(panels, _ERROR_SPAN)
    _add_legend(figure)
    return figure


def torques(log: Log) -> Figure:
    """Commanded and, where planned, feed-forward torque, a panel for each joint."""
    figure, panels = _joint_grid(log, "torque [Nm]")
    for joint, axes in panels.items():
        _plot(axes, log, log["joint/torque_command"][:, joint], **_joint_style(log, joint, "commanded"))
        if "reference/joint/feedforward_torque" in log:
            values = log["reference/joint/feedforward_torque"][:, joint]
            _plot(axes, log, values, color=_TRUE, linewidth=0.9, linestyle="--", label="feed-forward")
    _add_legend(figure)
    return figure


def foot_forces(log: Log) -> Figure:
    """Measured load of the feet: vertical, tangential over vertical, and vertical on each pad."""
    figure, grid = _time_grid(log, 2 + len(log.sides), 1, height=5 + 1.9 * len(log.sides))
    vertical, ratio, *pad_axes = grid.flat
    force = {side: log[f"foot/{side}/pad_force"].sum(axis=1) for side in log.sides}
    total = np.sum([force[side][:, 2] for side in log.sides], axis=0)
    weight = total.mean()
    _plot(vertical, log, total, color=_TRUE, linewidth=0.8, alpha=0.6, label="all feet")
    for side, width in zip(log.sides, np.linspace(1.8, 1, len(log.sides)), strict=True):
        _plot(vertical, log, force[side][:, 2], color=_side_color(log, side), linewidth=width, label=f"{side} foot")
        loaded = force[side][:, 2] > _LOADED_SHARE * weight
        used = np.full(len(total), np.nan)
        used[loaded] = np.linalg.norm(force[side][loaded, :2], axis=1) / force[side][loaded, 2]
        _plot(ratio, log, used, color=_side_color(log, side))
    vertical.axhline(weight, color=_PLANNED, linestyle="--", linewidth=0.9, label="mean of all feet")
    vertical.set_ylabel("vertical [N]")
    ratio.set_ylabel("tangential / vertical [1]")
    ratio.set_ylim(0, max(0.1, ratio.get_ylim()[1]))
    for side, axes in zip(log.sides, pad_axes, strict=True):
        pads = log[f"foot/{side}/pad_force"][:, :, 2].T
        for number, (values, shade) in enumerate(zip(pads, np.linspace(1, 0.3, len(pads)), strict=True), start=1):
            _plot(axes, log, values, color=_side_color(log, side), alpha=shade, linewidth=1.0, label=f"pad {number}")
        axes.set_ylabel(f"{side} pads, vertical [N]")
    for axes in (vertical, *pad_axes):
        axes.legend(handles=axes.get_lines(), loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    _name_phases(vertical, log)
    return figure


def friction(log: Log) -> Figure:
    """True friction torque, a panel for each joint (as the truth in the paper's Fig. 6)."""
    figure, panels = _joint_grid(log, "friction torque [Nm]")
    for joint, axes in panels.items():
        values = log["truth/joint/friction_torque"][:, joint]
        _plot(axes, log, values, color=_FRICTION, linestyle="--", linewidth=1.0, label="true friction")
    _widen(panels, _FRICTION_SPAN)
    _add_legend(figure)
    return figure


def friction_over_velocity(log: Log) -> Figure:
    """True friction torque against true joint velocity, a panel for the joints that the sides have in common."""
    rows = _joint_rows(log)
    columns = min(3, len(rows))
    figure = Figure(figsize=(_WIDTH, 0.6 + 2.6 * -(-len(rows) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(rows) // columns), columns, squeeze=False)
    for axes in grid.flat[len(rows) :]:
        axes.set_axis_off()
    for axes, (role, joints) in zip(grid.flat, rows.items(), strict=False):
        _decorate(axes)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(role.replace("_", " "), loc="left", fontsize=10)
        # Smaller dots on larger ones: where the sides agree, both can be seen.
        for (side, joint), size in zip(joints.items(), np.linspace(4.5, 2, max(2, len(joints))), strict=False):
            velocity, torque = (log[f"truth/joint/{name}"][_stride(log), joint] for name in ("velocity", "friction_torque"))
            color = _joint_color(log, joint)
            axes.plot(velocity, torque, ".", color=color, markersize=size, markeredgewidth=0, label=f"{side} leg" if side else None)
        axes.set_xlim(_at_least(axes.get_xlim(), _VELOCITY_SPAN))
        axes.set_ylim(_at_least(axes.get_ylim(), _FRICTION_SPAN))
    figure.supxlabel("joint velocity [rad/s]", fontsize=10)
    figure.supylabel("friction torque [Nm]", fontsize=10)
    _add_legend(figure, markerscale=2.5)
    return figure


def imu(log: Log) -> Figure:
    """Measured specific force and angular velocity in the IMU frame."""
    figure, grid = _time_grid(log, 3, 2, height=6.2)
    columns = (("imu/linear_acceleration", "specific force", "m/s²"), ("imu/angular_velocity", "angular velocity", "rad/s"))
    for (channel, title, unit), column in zip(columns, grid.T, strict=True):
        column[0].set_title(title, loc="left", fontsize=10)
        for axes, values, name in zip(column, log[channel].T, "xyz", strict=True):
            _plot(axes, log, values, color=_PLANNED, linewidth=0.8)
            axes.set_ylabel(f"{name} [{unit}]")
    _add_legend(figure)
    return figure


def _has_feet(log: Log, channel: str) -> bool:
    """Whether the log has this channel for every side, and has sides."""
    return bool(log.sides) and all(channel.format(side) in log for side in log.sides)


def _hangs(log: Log) -> bool:
    """Whether no foot ever touches the ground; known only from truth."""
    return _has_feet(log, "truth/foot/{}/pad_force") and not any(log[f"truth/foot/{side}/pad_force"].any() for side in log.sides)


def _joint_position(log: Log) -> str:
    return "truth/joint/position" if "truth/joint/position" in log else "joint/position"


def _source(channel: str) -> str:
    return "true" if channel.startswith("truth/") else "measured"


def _side_color(log: Log, side: str) -> str:
    return _SIDE_COLORS[log.sides.index(side) % len(_SIDE_COLORS)]


def _joint_side(log: Log, joint: str) -> str | None:
    return next((side for side in log.sides if joint.startswith(f"{side}_")), None)


def _joint_color(log: Log, joint: int) -> str:
    side = _joint_side(log, log.joints[joint])
    return _TRUE if side is None else _side_color(log, side)


def _joint_style(log: Log, joint: int, label: str) -> dict[str, str]:
    side = _joint_side(log, log.joints[joint])
    return {"color": _joint_color(log, joint), "label": label if side is None else f"{label}, {side}"}


def _joint_rows(log: Log) -> dict[str, dict[str, int]]:
    """Columns of the joints in the log by what they are called without their side, and by side."""
    rows: dict[str, dict[str, int]] = {}
    for column, name in enumerate(log.joints):
        side = _joint_side(log, name)
        rows.setdefault(name if side is None else name.removeprefix(f"{side}_"), {})[side or ""] = column
    return rows


def _footholds(log: Log, side: str, channel: str) -> Iterable[np.ndarray]:
    """Where the sole is in the middle of each planned stance, (2,) [m]."""
    standing = log[f"reference/foot/{side}/support"] > 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], standing, [False]]).astype(int)))
    return [np.median(log[channel][start:end, :2], axis=0) for start, end in edges.reshape(-1, 2)]


def _measured_zmp(log: Log, pads: Mapping[str, np.ndarray]) -> np.ndarray:
    """ZMP of the measured pad forces, (N, 2) [m]; soles taken as level."""
    force = np.concatenate([log[f"foot/{side}/pad_force"] for side in log.sides], axis=1)
    place = np.concatenate([log[f"truth/foot/{side}/position"][:, None] + pads[side] for side in log.sides], axis=1)
    return zero_moment_point(force, place)


def _stride(log: Log) -> slice:
    return slice(None, None, max(1, len(log.time) // (2 * _POINTS)))


def _plot(axes: Axes, log: Log, values: np.ndarray, **style: Any) -> None:
    """Draws values (N,) over time; of a long series the smallest and the largest of each short stretch, so that no spike is lost."""
    rows = np.arange(len(values))
    stretch = len(values) // (_POINTS // 2)
    if stretch > 2:
        whole = len(values) // stretch * stretch
        blocks = np.nan_to_num(values[:whole]).reshape(-1, stretch)
        extremes = np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1) + np.arange(0, whole, stretch)[:, None]
        rows = np.concatenate([np.sort(extremes, axis=1).ravel(), rows[whole:]])
    axes.plot(log.time[rows], values[rows], **{"linewidth": 1.2, **style})


def _time_grid(log: Log, rows: int, columns: int, *, height: float) -> tuple[Figure, np.ndarray]:
    """A figure with panels over time that show the phases; panels have shape (rows, columns)."""
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for axes in grid.flat:
        _decorate_time(axes, log)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    figure.align_ylabels()
    return figure, grid


def _joint_grid(log: Log, quantity: str) -> tuple[Figure, dict[int, Axes]]:
    """A figure with a panel over time for each joint, by its column in the log: a row for each role, a column for each side."""
    joint_rows = list(_joint_rows(log).values())
    columns = max(len(row) for row in joint_rows)
    figure = Figure(figsize=(_WIDTH, 0.8 + 1.55 * len(joint_rows)), layout="constrained")
    grid = figure.subplots(len(joint_rows), columns, sharex=True, sharey="row", squeeze=False)
    panels = {}
    for row, row_axes in zip(joint_rows, grid, strict=True):
        for axes in row_axes[len(row) :]:
            axes.set_axis_off()
        for joint, axes in zip(row.values(), row_axes, strict=False):
            _decorate_time(axes, log)
            axes.set_title(log.joints[joint].replace("_", " "), loc="left", fontsize=10, pad=3)
            panels[joint] = axes
    figure.supxlabel("time [s]", fontsize=10)
    figure.supylabel(quantity, fontsize=10)
    return figure, panels


def _decorate(axes: Axes) -> None:
    axes.grid(color="#dfe2e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#8a9199")
    axes.tick_params(labelsize=9, color="#8a9199")
    axes.locator_params(nbins="auto", steps=[1, 2, 5, 10])


def _decorate_time(axes: Axes, log: Log) -> None:
    """Also shades the plan's single supports in the colour of the leg that stands."""
    _decorate(axes)
    axes.margins(x=0)
    for phase in support_phases(log):
        if len(phase.support) == 1:
            side = phase.support[0]
            axes.axvspan(phase.start, phase.end, facecolor=_side_color(log, side), alpha=0.12, linewidth=0, label=f"{side} leg supports")


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
            axes.text(middle, 1.02, phase.label, transform=axes.get_xaxis_transform(), ha="center", va="bottom", fontsize=8, color=_PLANNED)


def _add_legend(figure: Figure, *, markerscale: float = 1.0) -> None:
    """One legend above all panels: every label once, solid lines before dashed ones before areas."""
    found: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if not found:
        return

    def rank(label: str) -> int:
        handle = found[label]
        return int(handle.get_linestyle() == "--") if isinstance(handle, Line2D) else 2

    labels = sorted(found, key=rank)
    columns = len(labels) if len(labels) < 6 else -(-len(labels) // 2)
    handles = [found[label] for label in labels]
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, markerscale=markerscale, frameon=False, fontsize=10)
