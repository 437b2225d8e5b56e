"""Pictures of where a model fails, what is missing in it, and how the error falls.

Errors are in multiples of the sensors' noise wherever channels of different units stand side by
side. Nothing here touches pyplot.
"""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import LogLocator
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame

from fbse_drake.discrepancy.diagnosis.compare import (
    Bin,
    Channel,
    Comparison,
    error_over_noise,
    words,
)
from fbse_drake.discrepancy.diagnosis.diagnose import EffectStatus, Estimate, Finding
from fbse_drake.discrepancy.diagnosis.study import StudyStep
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.discrepancy.residual.rollout import RolloutError
from fbse_drake.discrepancy.residual.rows import Row
from fbse_drake.effects.effect import library, spaced
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.report.html import number
from fbse_drake.report.style import (
    ERROR,
    ESTIMATE,
    PLANNED,
    SIDE_COLORS,
    WIDTH,
    add_legend,
    decorate,
)
from fbse_drake.robot.plant import Robot

# Ratios of error to noise: white is noise alone, the darkest red is this many times it and more.
_DARKEST = 30.0
_RATIO_COLORS = LinearSegmentedColormap.from_list(
    "ratio", ["#f3f5f7", "#fbe3c8", "#f4a562", "#d65f1a", "#8f1313"]
)
_RATIO_NORM = LogNorm(1.0, _DARKEST, clip=True)
NOISE = "#8a9199"
# A model before something was added to it.
BEFORE = "#d65f1a"
# Effects that a tick names, panels in a row.
_MOST_NAMED = 3
_PANELS = 3
# Joints whose simulated positions are drawn; samples further apart than this many periods are not
# joined.
_MOST_JOINTS = 6
_GAP = 3.0
# In the drawing of a robot, joints nearer than this stand side by side, so far apart; room for a
# trunk [m].
_NEAR, _BESIDE, _TRUNK = 0.09, 0.105, 0.45
# Intervals are drawn up to this many times the largest value.
_WIDEST = 4.0
VERDICT_COLORS = {
    "present": ERROR,
    "confusable": "#e39b16",
    "absent": ESTIMATE,
    "not_visible": "#a9b0b7",
}
_ROLE_COLORS = {
    "part of the explanation": ESTIMATE,
    "part of the explanation, tentative": "#7fb2e5",
    "an alternative": VERDICT_COLORS["confusable"],
}


def robot_errors(robot: Robot, comparison: Comparison, posture: np.ndarray) -> Figure:
    """The robot from behind with every joint coloured by its error, in multiples of the noise; and
    the same by phase.

    Args:
        posture: joint angles that it is drawn in, shape (n,) [rad].
    """
    joints = [channel for channel in comparison.channels if channel.row.kind == "joint"]
    others = [channel for channel in comparison.channels if channel.row.kind != "joint"]
    # Of a log without torques nothing is known of the joints.
    groups = [
        known
        for group in (joints, others)
        if (known := [channel for channel in group if not np.isnan(channel.rmse)])
    ]
    rows = max(len(group) for group in groups)
    figure = Figure(figsize=(WIDTH, max(4.5, 1.4 + 0.24 * rows)), layout="constrained")
    body, *maps = figure.subplots(
        1, 1 + len(groups), width_ratios=[1.7, 1, 1] if len(groups) == 2 else [1.2, 1]
    )
    _draw_robot(
        body,
        robot,
        {channel.row.name: channel.ratio for channel in joints},
        posture,
    )
    for axes, channels in zip(maps, groups, strict=True):
        _draw_phases(axes, channels)
    bar = figure.colorbar(
        ScalarMappable(_RATIO_NORM, _RATIO_COLORS), ax=maps[-1], fraction=0.06, extend="max"
    )
    bar.set_label("error over noise, root mean squares [1]", fontsize=9)
    bar.set_ticks([1, 2, 5, 10, 30], labels=["1", "2", "5", "10", "30"], fontsize=9)
    bar.ax.minorticks_off()
    return figure


def _draw_robot(axes: Axes, robot: Robot, ratios: Mapping[str, float], posture: np.ndarray) -> None:
    plant = robot.plant
    context = plant.CreateDefaultContext()
    if robot.has_floating_base:
        plant.SetFloatingBaseBodyPoseInWorldFrame(context, robot.base, RigidTransform())
    robot.set_joint_positions(context, posture)

    def place(frame: Frame) -> np.ndarray:
        return frame.CalcPoseInWorld(context).translation()

    legs, trunk = robot.description.legs.values(), robot.base.body_frame()
    # Pairs of legs are drawn one above the other, those in front on top.
    hips = [place(plant.GetJointByName(leg.joints[0]).frame_on_child())[0] for leg in legs]
    pairs = sorted(hips)[::2]
    rows = [sum(hip > pair + _NEAR for pair in pairs) for hip in hips]
    height = _TRUNK - min(place(plant.GetFrameByName(leg.sole))[2] for leg in legs)

    def seen(frame: Frame, row: int) -> np.ndarray:
        # From behind: its left is on the left.
        _, y, z = place(frame)
        return np.array([-y, z + row * height])

    for row in sorted(set(rows)):
        _draw_base(axes, robot, seen(trunk, row))
    for leg, row in zip(legs, rows, strict=True):
        base = seen(trunk, row)
        places = [seen(plant.GetJointByName(name).frame_on_child(), row) for name in leg.joints]
        line = np.array([base, *places, seen(plant.GetFrameByName(leg.sole), row)])
        axes.plot(*line.T, color=PLANNED, linewidth=5, solid_capstyle="round", alpha=0.35, zorder=1)
        axes.plot(
            [line[-1, 0] - 0.05, line[-1, 0] + 0.05],
            [line[-1, 1]] * 2,
            color=PLANNED,
            linewidth=6,
            alpha=0.5,
            zorder=1,
        )
        outwards = -1.0 if places[0][0] < base[0] else 1.0
        # Joints that are near each other stand side by side, the first one outermost.
        shared: list[list[int]] = []
        for k, joint in enumerate(places):
            if shared and np.linalg.norm(joint - places[shared[-1][0]]) < _NEAR:
                shared[-1].append(k)
            else:
                shared.append([k])
        for group in shared:
            for order, k in enumerate(reversed(group)):
                spot = places[group[-1]] + [outwards * _BESIDE * order, 0.0]
                ratio = ratios[leg.joints[k]]
                axes.plot(
                    *spot,
                    "o",
                    markersize=22,
                    color=_RATIO_COLORS(_RATIO_NORM(ratio)),
                    markeredgecolor=PLANNED,
                    zorder=2,
                )
                axes.text(
                    *spot,
                    number(ratio, 2),
                    ha="center",
                    va="center",
                    fontsize=7,
                    color=_ink(ratio),
                    zorder=3,
                )
                label = robot.description.leg_joints[k].replace("_", "\n")
                plain = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.5}
                axes.text(
                    *(spot - [0, 0.05]),
                    label,
                    ha="center",
                    va="top",
                    fontsize=6.5,
                    color=PLANNED,
                    bbox=plain,
                    zorder=3,
                )
    axes.set_aspect("equal")
    axes.margins(0.09, 0.04)
    axes.set_axis_off()
    axes.set_title(
        "seen from behind" + (", front legs on top" if len(pairs) > 1 else ""),
        loc="left",
        fontsize=9,
        color=PLANNED,
    )


def _draw_base(axes: Axes, robot: Robot, base: np.ndarray) -> None:
    corner = base - [0.11, 0.0]
    axes.add_patch(
        FancyBboxPatch(
            corner,
            0.22,
            0.3,
            boxstyle="round,pad=0.02",
            facecolor="#e6e9ec",
            edgecolor=PLANNED,
            zorder=0,
        )
    )
    axes.text(
        *(base + [0, 0.15]),
        robot.description.base.replace("_", " "),
        ha="center",
        va="center",
        fontsize=8,
        color=PLANNED,
    )


def _ink(ratio: float) -> str:
    """A text's colour that shows on a ratio's colour."""
    return "white" if ratio > 0.4 * _DARKEST else "#15181b"


def _draw_phases(axes: Axes, channels: Sequence[Channel]) -> None:
    """Ratio of error to noise by channel and phase; of a short log, whose phases are not long
    enough to tell, over the whole of it."""
    found = (c.by_phase.items() for c in channels)
    phases = dict.fromkeys(
        phase for parts in found for phase, (error, _) in parts if not np.isnan(error)
    )
    parts = [c.by_phase if phases else {"whole log": (c.rmse, c.noise_floor)} for c in channels]
    names = list(phases) or ["whole log"]
    ratios = np.array(
        [[error_over_noise(*of.get(name, (np.nan, np.nan))) for name in names] for of in parts]
    )
    axes.imshow(ratios, cmap=_RATIO_COLORS, norm=_RATIO_NORM, aspect="auto")
    for (row, column), ratio in np.ndenumerate(ratios):
        text = "-" if np.isnan(ratio) else number(float(ratio), 2)
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=_ink(ratio))
    axes.set_xticks(
        range(len(names)), [words(name).replace(" ", "\n") for name in names], fontsize=8
    )
    axes.set_yticks(
        range(len(channels)), [words(channel.row.name) for channel in channels], fontsize=8
    )
    axes.tick_params(length=0)
    axes.xaxis.tick_top()
    axes.spines[:].set_visible(False)


def channel_errors(before: Sequence[Channel], after: Sequence[Channel] = ()) -> Figure:
    """Error over noise of every channel that is known; with `after`, of the same channels, also
    what is left of it."""
    figure = Figure(figsize=(WIDTH, 1.2 + 0.27 * len(before)), layout="constrained")
    axes = figure.subplots()
    ratios = [[channel.ratio for channel in channels] for channels in (before, after or before)]
    label = "the model as given"
    _draw_falls(
        axes,
        [words(channel.row.name) for channel in before],
        *ratios,
        (label, "the completed model" if after else label),
    )
    axes.set_xlabel("error over the sensors' noise, root mean squares [1]")
    add_legend(figure)
    return figure


def _draw_falls(
    axes: Axes,
    names: Sequence[str],
    before: Sequence[float],
    after: Sequence[float],
    labels: tuple[str, str | Sequence[str]],
    colors: str | Sequence[str] = ESTIMATE,
) -> None:
    """Errors over noise before and after something, a line for each name, the first on top.

    Args:
        labels, colors: of before and after; those of after may differ from name to name.
    """
    decorate(axes)
    places = range(len(names))
    labels_after = [labels[1]] * len(names) if isinstance(labels[1], str) else labels[1]
    colors = [colors] * len(names) if isinstance(colors, str) else colors
    for place, first, last, label, color in zip(
        places, before, after, labels_after, colors, strict=True
    ):
        text = number(last)
        if first != last:
            axes.hlines(place, *sorted((first, last)), color=color, linewidth=1.5, alpha=0.4)
            axes.plot(first, place, "o", color=BEFORE, markersize=6, label=labels[0])
            text = f"{number(first)} → {text}"
        axes.plot(last, place, "o", color=color, markersize=6, label=label)
        style = {"textcoords": "offset points", "va": "center", "fontsize": 8, "color": PLANNED}
        axes.annotate(text, (max(first, last), place), (8, 0), **style)
    axes.axvline(1.0, color=PLANNED, linestyle="--", linewidth=1.0, label="sensors' noise")
    axes.set_yticks(places, names, fontsize=9)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xscale("log")
    smallest, largest = min([0.8, *before, *after]), max([1.0, *before, *after])
    # Room for the numbers.
    axes.set_xlim(0.9 * smallest, largest * (largest / smallest) ** 0.2)
    _plain_log(axes.xaxis)
    axes.grid(visible=False, axis="y")


def _plain_log(axis: Axis) -> None:
    """Ticks at 1, 2, 5 and their decades, in plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


# What an error may depend on, of a revolute and of a prismatic joint, by the unit of its row.
_LABELS = {
    "turns": {
        "speed": "|velocity| [rad/s]\n(error along the motion)",
        "velocity": "velocity [rad/s]",
        "position": "angle [rad]",
        "load": "torque command [Nm]",
    },
    "slides": {
        "speed": "|velocity| [m/s]\n(error along the motion)",
        "velocity": "velocity [m/s]",
        "position": "position [m]",
        "load": "force command [N]",
    },
}


def _label(variable: str, row: Row) -> str:
    if variable == "time":
        return "time [s]"
    if not row.joint:
        return f"{variable} [N]"
    return _LABELS["slides" if row.unit in ("N", "m") else "turns"][variable]


def binned_variables(channel: Channel) -> list[str]:
    """The variables against which the channel's error is known in bins."""
    return [name for name in channel.bins if name != "none" and channel.bins[name]]


def error_bins(channels: Sequence[Channel]) -> Figure:
    """Mean error of channels against each variable, with its 95 % interval and the noise of the
    mean; a row for each channel."""
    columns = [binned_variables(channel) for channel in channels]
    width = max(map(len, columns))
    figure = Figure(figsize=(WIDTH, 0.7 + 2.1 * len(channels)), layout="constrained")
    grid = figure.subplots(len(channels), width, sharey="row", squeeze=False)
    for channel, names, panels in zip(channels, columns, grid, strict=True):
        for axes in panels[len(names) :]:
            axes.set_axis_off()
        for name, axes in zip(names, panels, strict=False):
            decorate(axes)
            _draw_bins(axes, channel.bins[name])
            axes.set_xlabel(_label(name, channel.row), fontsize=9)
        panels[0].set_ylabel(
            f"{words(channel.row.name).replace(' ', chr(10), 1)}\nerror [{channel.row.unit}]",
            fontsize=9,
        )
    add_legend(figure)
    return figure


def _draw_bins(axes: Axes, bins: Sequence[Bin]) -> None:
    centre, error = np.array([b.centre for b in bins]), np.array([b.error for b in bins])
    low, high = np.array([b.interval for b in bins]).T
    noise = 2 * np.array([b.noise_floor for b in bins])
    axes.axhline(0, color=PLANNED, linewidth=0.8)
    axes.fill_between(
        centre,
        -noise,
        noise,
        color=NOISE,
        alpha=0.45,
        linewidth=0,
        label="± 2 standard deviations of the noise",
    )
    axes.fill_between(
        centre, low, high, color=ERROR, alpha=0.18, linewidth=0, label="95 % interval"
    )
    axes.plot(
        centre, error, color=ERROR, marker="o", markersize=3.5, linewidth=1.2, label="mean error"
    )


def errors_over_time(
    residual: Residual, sides: Sequence[str], channels: Sequence[Channel]
) -> Figure:
    """Residual of channels over time, with the noise of the sensors; single supports are shaded."""
    figure = Figure(figsize=(WIDTH, 0.8 + 1.7 * len(channels)), layout="constrained")
    grid = figure.subplots(len(channels), 1, sharex=True, squeeze=False)
    for channel, axes in zip(channels, grid.flat, strict=True):
        decorate(axes)
        axes.margins(x=0)
        row = residual.row_index[channel.row.name]
        known = residual.known[:, row]
        value = np.where(known, residual.value[:, row], np.nan)
        noise = 2 * np.where(known, np.sqrt(residual.variance[:, row]), np.nan)
        axes.fill_between(
            residual.time,
            -noise,
            noise,
            color=NOISE,
            alpha=0.45,
            linewidth=0,
            label="± 2 standard deviations of the noise",
        )
        axes.plot(residual.time, value, color=ERROR, linewidth=0.9, label="error")
        _shade_supports(axes, residual, sides)
        axes.set_ylabel(
            f"{words(channel.row.name).replace(' ', chr(10), 1)}\n[{channel.row.unit}]", fontsize=9
        )
    grid[-1, 0].set_xlabel("time [s]")
    figure.align_ylabels()
    add_legend(figure)
    return figure


def torques_over_time(
    before: Residual, after: Residual, joints: Sequence[int], stretch: slice
) -> Figure:
    """Torque of joints as measured and by the model before and after something was added to it;
    below each the two models' errors.

    Args:
        before, after: what each model leaves of the same log.
        joints: their places among the rows.
        stretch: averages that are shown.
    """
    columns = min(2, len(joints))
    rows = -(-len(joints) // columns)
    figure = Figure(figsize=(WIDTH, 0.7 + 2.7 * rows), layout="constrained")
    grid = figure.subplots(
        2 * rows, columns, sharex=True, squeeze=False, height_ratios=[1.5, 1.0] * rows
    )
    for axes in grid[-2:, len(joints) - columns * (rows - 1) :].flat:
        axes.set_axis_off()
    time = before.time[stretch]
    for place, joint in enumerate(joints):
        torques, errors = grid[2 * (place // columns) : 2 * (place // columns) + 2, place % columns]
        row, known = before.rows[joint], before.known[stretch, joint]
        measured, left, rest, noise = (
            np.where(known, values[stretch, joint], np.nan)
            for values in (
                before.signals.torque_command,
                before.value,
                after.value,
                2 * np.sqrt(before.variance),
            )
        )
        for axes in (torques, errors):
            decorate(axes)
            axes.margins(x=0)
        torques.plot(time, measured, color="#15181b", linewidth=1.8, alpha=0.35, label="measured")
        torques.plot(time, measured - left, color=BEFORE, linewidth=0.9, label="the model as given")
        torques.plot(
            time, measured - rest, color=ESTIMATE, linewidth=0.9, label="the completed model"
        )
        errors.fill_between(
            time,
            -noise,
            noise,
            color=NOISE,
            alpha=0.45,
            linewidth=0,
            label="± 2 standard deviations of the noise",
        )
        errors.plot(time, left, color=BEFORE, linewidth=0.9)
        errors.plot(time, rest, color=ESTIMATE, linewidth=0.9)
        size = np.linalg.norm(measured[known])
        shares = [
            number(100 * float(np.linalg.norm(values[known]) / size), 2) if size > 0 else "n/a"
            for values in (left, rest)
        ]
        torques.set_title(words(row.name), loc="left", fontsize=10)
        torques.set_title(
            f"relative error {shares[0]} % → {shares[1]} %", loc="right", fontsize=9, color=PLANNED
        )
        torques.set_ylabel(f"{'torque' if row.unit == 'Nm' else 'force'} [{row.unit}]", fontsize=9)
        errors.set_ylabel(f"error [{row.unit}]", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    figure.align_ylabels()
    add_legend(figure)
    return figure


def position_errors(before: RolloutError, after: RolloutError, units: Sequence[str]) -> Figure:
    """Simulated less recorded position over time, before and after something was added to a model,
    of the worst joints.

    Args:
        units: of the joints' torques.
    """
    worst = sorted(np.argsort([-error for error in before.position.values()])[:_MOST_JOINTS])
    columns = min(2, len(worst))
    figure = Figure(figsize=(WIDTH, 0.7 + 1.7 * -(-len(worst) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(worst) // columns), columns, sharex=True, squeeze=False)
    for axes in grid.flat[len(worst) :]:
        axes.set_axis_off()
    for joint, axes in zip(worst, grid.flat, strict=False):
        decorate(axes)
        axes.margins(x=0)
        for error, color, label in (
            (before, BEFORE, "the model as given"),
            (after, ESTIMATE, "the completed model"),
        ):
            time = error.sample_time
            # Recordings that were joined, or gaps: nothing is drawn between them.
            apart = 1 + np.flatnonzero(np.diff(time) > _GAP * np.median(np.diff(time)))
            values = np.insert(1e3 * error.position_error[:, joint], apart, np.nan)
            axes.plot(
                np.insert(time, apart, np.nan), values, color=color, linewidth=0.9, label=label
            )
        axes.axhline(0, color=PLANNED, linewidth=0.8)
        axes.set_title(words(list(before.position)[joint]), loc="left", fontsize=10)
        axes.set_ylabel(f"error [{'mrad' if units[joint] == 'Nm' else 'mm'}]", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    figure.align_ylabels()
    add_legend(figure)
    return figure


def _shade_supports(axes: Axes, residual: Residual, sides: Sequence[str]) -> None:
    single = residual.standing.sum(axis=1) == 1
    for foot, side in enumerate(sides):
        alone = np.concatenate([[False], residual.standing[:, foot] & single, [False]]).astype(int)
        for start, end in np.flatnonzero(np.diff(alone)).reshape(-1, 2):
            first, last = residual.time[start], residual.time[end - 1]
            color = SIDE_COLORS[foot % len(SIDE_COLORS)]
            axes.axvspan(
                first, last, facecolor=color, alpha=0.12, linewidth=0, label=f"{side} leg supports"
            )


def ranking(findings: Sequence[Finding], names: Sequence[str] = ()) -> Figure:
    """Held-out error without and with each effect, in multiples of the noise.

    Args:
        names: what to call them; by default the effects and where they are.
    """
    figure = Figure(figsize=(WIDTH, 1.2 + 0.27 * len(findings)), layout="constrained")
    axes = figure.subplots()
    errors = [
        [getattr(finding, name) for finding in findings]
        for name in ("held_out_before", "held_out_after")
    ]
    labels = [f"with the effect: {_role(finding)}" for finding in findings]
    colors = [_ROLE_COLORS[_role(finding)] for finding in findings]
    _draw_falls(
        axes,
        names or [finding_name(finding) for finding in findings],
        *errors,
        ("without the effect", labels),
        colors,
    )
    axes.set_xlabel(
        "held-out error of the channels that the effect moves, in multiples "
        "of the sensors' noise [1]"
    )
    add_legend(figure)
    return figure


def _role(finding: Finding) -> str:
    if finding.tentative:
        return "part of the explanation, tentative"
    return "part of the explanation" if finding.chosen else "an alternative"


def finding_name(finding: Finding) -> str:
    """As `Coulomb friction, left knee pitch`."""
    return f"{spaced(finding.effect)}, {targets_text(finding.targets, finding.effect)}"


def targets_text(targets: Sequence[str], effect: str = "") -> str:
    """Names of an effect's targets for reading, as `left and right knee pitch`; of many only how
    many."""
    things = "bodies" if effect in library() and library()[effect].acts_on == "body" else "joints"
    sides, parts = zip(*(target.partition("_")[::2] for target in targets), strict=True)
    if len(targets) > 1 and len(set(parts)) == 1:
        return f"{' and '.join(sides)} {words(parts[0])}".rstrip()
    return ", ".join(map(words, targets)) if len(targets) < 4 else f"{len(targets)} {things}"


def detectability(statuses: Mapping[str, EffectStatus]) -> Figure:
    """Smallest size of every effect that the data would have shown, on each target, over the
    largest plausible size."""
    figure = Figure(figsize=(WIDTH, 1.1 + 0.27 * len(statuses)), layout="constrained")
    axes = figure.subplots()
    decorate(axes)
    highest = 30.0
    for place, status in enumerate(statuses.values()):
        shares = np.array(list(status.over_plausible.values()))
        shown = np.clip(np.nan_to_num(shares, posinf=highest), None, highest)
        color = VERDICT_COLORS[status.verdict]
        if len(shown):
            axes.plot(
                [shown.min(), shown.max()], [place, place], color=color, linewidth=1.2, alpha=0.5
            )
        axes.plot(
            shown,
            np.full(len(shown), place),
            "o",
            color=color,
            markersize=5.5,
            alpha=0.8,
            markeredgewidth=0,
            label=words(status.verdict),
        )
    axes.axvspan(
        1.0,
        1.3 * highest,
        facecolor=NOISE,
        alpha=0.2,
        linewidth=0,
        label="larger than plausible: could not be seen",
    )
    axes.set_yticks(range(len(statuses)), [spaced(name) for name in statuses], fontsize=9)
    axes.set_ylim(len(statuses) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlim(right=1.3 * highest)
    axes.set_xlabel(
        "smallest detectable size over largest plausible size; a dot for "
        "each joint, foot or body [1]"
    )
    add_legend(figure)
    return figure


def parameters(findings: Sequence[tuple[Finding, str]]) -> Figure:
    """Fitted values with their 95 % intervals: a panel for each parameter, rows of panels for each
    effect.

    Intervals that are many times as wide as the values are large are cut.

    Args:
        findings: with what each is called among those of its effect.
    """
    rows: list[tuple[str, list[str]]] = []
    by_name: dict[str, list[tuple[Finding, str]]] = {}
    for finding, place in findings:
        by_name.setdefault(finding.effect, []).append((finding, place))
    for effect, found in by_name.items():
        names = list(found[0][0].parameters)
        rows += [
            (effect, names[start : start + _PANELS]) for start in range(0, len(names), _PANELS)
        ]
    heights = [0.85 + 0.23 * len(by_name[effect]) for effect, _ in rows]
    figure = Figure(figsize=(WIDTH, 0.4 + sum(heights)), layout="constrained")
    columns = max(len(names) for _, names in rows)
    grid = figure.subplots(len(rows), columns, height_ratios=heights, sharey="row", squeeze=False)
    for (effect, names), panels in zip(rows, grid, strict=True):
        found, places = zip(*by_name[effect], strict=True)
        for axes in panels[len(names) :]:
            axes.set_axis_off()
        for name, axes in zip(names, panels, strict=False):
            _draw_estimates(axes, [finding.parameters[name] for finding in found])
            axes.set_xlabel(f"{words(name)} [{found[0].parameters[name].unit}]", fontsize=9)
        panels[0].set_yticks(range(len(found)), places, fontsize=9)
        panels[0].set_ylim(len(found) - 0.4, -0.6)
        panels[0].set_title(spaced(effect), loc="left", fontsize=10)
    add_legend(figure)
    return figure


def _draw_estimates(axes: Axes, estimates: Sequence[Estimate]) -> None:
    decorate(axes)
    places = np.arange(len(estimates))
    value, (low, high) = (
        np.array([e.value for e in estimates]),
        np.array([e.interval for e in estimates]).T,
    )
    limit = _WIDEST * np.abs(value).max() or np.abs([low, high]).max()
    axes.hlines(
        places,
        low.clip(-limit, limit),
        high.clip(-limit, limit),
        color=ESTIMATE,
        linewidth=3,
        alpha=0.5,
        label="95 % interval",
    )
    axes.plot(value, places, "o", color=ESTIMATE, markersize=5, label="value")
    for cut, edge, marker in ((low < -limit, -limit, "<"), (high > limit, limit, ">")):
        if cut.any():
            axes.plot(
                np.full(cut.sum(), edge),
                places[cut],
                marker,
                color=ESTIMATE,
                markersize=6,
                alpha=0.7,
                label="interval goes on",
            )
    axes.axvline(0, color=PLANNED, linewidth=0.8)
    axes.locator_params(axis="x", nbins=5)


def falling_error(steps: Sequence[StudyStep], unit: str) -> Figure:
    """Error of the residual step by step, and that of the simulated model where it was simulated.

    Args:
        unit: of a thousandth of the joints' positions.
    """
    rolled = any(step.rollout is not None for step in steps)
    figure = Figure(figsize=(WIDTH, 6.4 if rolled else 4.2), layout="constrained")
    panels = figure.subplots(2 if rolled else 1, 1, sharex=True, squeeze=False)[:, 0]
    places = np.arange(len(steps))
    labels = ["as given", *("+ " + "\n+ ".join(_added(step.added)) for step in steps[1:])]
    axes = panels[0]
    held_out, train = (
        [getattr(step, name) for step in steps] for name in ("held_out_rmse", "train_rmse")
    )
    decorate(axes)
    axes.plot(places, held_out, "o-", color=ERROR, linewidth=2, label="held-out data")
    axes.plot(
        places,
        train,
        "o--",
        color=ESTIMATE,
        linewidth=1.2,
        markersize=4,
        label="data that it was fitted to",
    )
    for place, value in zip(places, held_out, strict=True):
        axes.annotate(
            number(value, 3),
            (place, value),
            (0, 8),
            textcoords="offset points",
            ha="center",
            fontsize=9,
        )
    axes.axhline(1.0, color=PLANNED, linestyle="--", linewidth=1.0, label="sensors' noise")
    axes.set_yscale("log")
    axes.set_ylim(0.8 * min(1.0, *held_out), 1.6 * max(held_out))
    _plain_log(axes.yaxis)
    axes.set_ylabel("error of the residual\nover noise [1]")
    if rolled:
        decorate(panels[1])
        values = [
            np.nan if step.rollout is None else 1e3 * step.rollout.mean_position for step in steps
        ]
        panels[1].plot(
            places,
            values,
            "o-",
            color="#7a4fa3",
            linewidth=2,
            label="simulated model, joint positions",
        )
        for place, value in zip(places, values, strict=True):
            panels[1].annotate(
                number(value, 3),
                (place, value),
                (0, 8),
                textcoords="offset points",
                ha="center",
                fontsize=9,
            )
        panels[1].set_ylim(0, 1.25 * max(1e-6, np.nanmax(values)))
        panels[1].set_ylabel(f"error of simulated\njoints, RMS [{unit}]")
    panels[-1].set_xticks(places, labels, fontsize=8)
    panels[-1].set_xlim(-0.5, len(places) - 0.5)
    figure.align_ylabels()
    add_legend(figure)
    return figure


def _added(findings: Sequence[Finding]) -> list[str]:
    """Effects and where they are, wrapped to fit below a tick; of many the first ones."""
    named = [
        f"{spaced(effect)}\n({textwrap.fill(targets_text(targets, effect), 22)})"
        for effect, targets in by_effect(findings).items()
    ]
    return (
        named
        if len(named) <= _MOST_NAMED
        else [*named[: _MOST_NAMED - 1], f"{len(named) - _MOST_NAMED + 1} others"]
    )


def by_effect(findings: Sequence[Finding]) -> dict[str, list[str]]:
    """All targets of each effect, once.

    What others say together is said by these where one of them is found too: friction that is
    Coulomb and viscous friction in one joint, and one law for each in the next, is of two kinds.
    """
    found = {finding.effect for finding in findings}
    result: dict[str, list[str]] = {}
    for finding in findings:
        parts = _parts(finding.effect)
        for effect in parts if found & parts.keys() else [finding.effect]:
            targets = result.setdefault(effect, [])
            targets.extend(target for target in finding.targets if target not in targets)
    return result


def _parts(effect: str) -> dict[str, None]:
    """Effects that say together what a composite effect says, in their order."""
    law = library().get(effect)
    if law is None or not law.composite or not issubclass(law, JointTorqueEffect):
        return {}
    return {part.__name__: None for reduction in law.reductions for part in reduction.effects}


def small_motions(robot: Robot) -> str:
    """Unit of small motions of its joints."""
    return ", ".join(dict.fromkeys("mrad" if unit == "Nm" else "mm" for unit in robot.torque_units))
