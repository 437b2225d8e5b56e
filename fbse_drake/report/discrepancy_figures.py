"""Pictures of where a model fails, what is missing in it, and how the error falls.

Errors are in multiples of the sensors' noise wherever channels of different units stand side by side. Nothing here touches pyplot.
"""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import LogLocator
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame

from fbse_drake.discrepancy.compare import Bin, Channel, Comparison, words
from fbse_drake.discrepancy.diagnose import EffectStatus, Finding
from fbse_drake.discrepancy.residual import Residual
from fbse_drake.discrepancy.study import Study
from fbse_drake.effects.effect import library
from fbse_drake.report.figures import ESTIMATE, PLANNED, SIDE_COLORS, TRUTH, WIDTH, add_legend, decorate
from fbse_drake.report.html import number
from fbse_drake.robot.plant import Robot

# Ratios of error to noise: white is noise alone, the darkest red is this many times it and more.
_DARKEST = 30.0
_RATIO_COLORS = LinearSegmentedColormap.from_list("ratio", ["#f3f5f7", "#fbe3c8", "#f4a562", "#d65f1a", "#8f1313"])
_RATIO_NORM = LogNorm(1.0, _DARKEST, clip=True)
_NOISE = "#8a9199"
# Effects that a tick names.
_MOST_NAMED = 3
VERDICT_COLORS = {"present": TRUTH, "confusable": "#e39b16", "absent": ESTIMATE, "not_visible": "#a9b0b7"}


def robot_errors(robot: Robot, comparison: Comparison, posture: np.ndarray) -> Figure:
    """The robot from behind with every joint coloured by its error, in multiples of the noise; and the same by phase.

    Args:
        posture: joint angles that it is drawn in, shape (n,) [rad].
    """
    joints = [channel for channel in comparison.channels if channel.row.kind == "joint"]
    others = [channel for channel in comparison.channels if channel.row.kind != "joint"]
    rows = max(len(joints), len(others))
    figure = Figure(figsize=(WIDTH, max(4.5, 1.4 + 0.24 * rows)), layout="constrained")
    body, *maps = figure.subplots(1, 3 if others else 2, width_ratios=[1.7, 1, 1] if others else [1.2, 1])
    _draw_robot(body, robot, {channel.row.name: _ratio(channel.rmse, channel.noise_floor) for channel in joints}, posture)
    for axes, channels in zip(maps, (joints, others), strict=False):
        _draw_phases(axes, channels)
    bar = figure.colorbar(ScalarMappable(_RATIO_NORM, _RATIO_COLORS), ax=maps[-1], fraction=0.06, extend="max")
    bar.set_label("error over noise, root mean squares [1]", fontsize=9)
    bar.set_ticks([1, 2, 5, 10, 30], labels=["1", "2", "5", "10", "30"], fontsize=9)
    bar.ax.minorticks_off()
    return figure


def _ratio(error: float, noise: float) -> float:
    return error / noise if noise > 0 else np.nan


def _draw_robot(axes: Axes, robot: Robot, ratios: Mapping[str, float], posture: np.ndarray) -> None:
    plant = robot.plant
    context = plant.CreateDefaultContext()
    if robot.has_floating_base:
        plant.SetFloatingBaseBodyPoseInWorldFrame(context, robot.base, RigidTransform())
    robot.set_joint_positions(context, posture)

    def seen(frame: Frame) -> np.ndarray:
        # From behind: its left is on the left.
        _, y, z = frame.CalcPoseInWorld(context).translation()
        return np.array([-y, z])

    size = 0.05
    base = seen(robot.base.body_frame())
    for leg in robot.description.legs.values():
        places = [seen(plant.GetJointByName(joint).frame_on_child()) for joint in leg.joints]
        line = np.array([base, *places, seen(plant.GetFrameByName(leg.sole))])
        axes.plot(*line.T, color=PLANNED, linewidth=5, solid_capstyle="round", alpha=0.35, zorder=1)
        axes.plot([line[-1, 0] - 0.05, line[-1, 0] + 0.05], [line[-1, 1]] * 2, color=PLANNED, linewidth=6, alpha=0.5, zorder=1)
        outwards = -1.0 if places[0][0] < base[0] else 1.0
        # Joints with one centre stand side by side, the first one outermost.
        shared: list[list[int]] = []
        for k, place in enumerate(places):
            if shared and np.linalg.norm(place - places[shared[-1][0]]) < size:
                shared[-1].append(k)
            else:
                shared.append([k])
        for group in shared:
            for order, k in enumerate(reversed(group)):
                spot = places[k] + [outwards * 2.1 * size * order, 0.0]
                ratio = ratios[leg.joints[k]]
                axes.plot(*spot, "o", markersize=22, color=_RATIO_COLORS(_RATIO_NORM(ratio)), markeredgecolor=PLANNED, zorder=2)
                axes.text(*spot, number(ratio, 2), ha="center", va="center", fontsize=7, color=_ink(ratio), zorder=3)
                label = robot.description.leg_joints[k].replace("_", "\n")
                plain = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.5}
                axes.text(*(spot - [0, 0.05]), label, ha="center", va="top", fontsize=6.5, color=PLANNED, bbox=plain, zorder=3)
    corner = base - [0.11, 0.0]
    axes.add_patch(FancyBboxPatch(corner, 0.22, 0.3, boxstyle="round,pad=0.02", facecolor="#e6e9ec", edgecolor=PLANNED, zorder=0))
    axes.text(*(base + [0, 0.15]), robot.description.base.replace("_", " "), ha="center", va="center", fontsize=8, color=PLANNED)
    axes.set_aspect("equal")
    axes.margins(0.09, 0.04)
    axes.set_axis_off()
    axes.set_title("seen from behind", loc="left", fontsize=9, color=PLANNED)


def _ink(ratio: float) -> str:
    """A text's colour that shows on a ratio's colour."""
    return "white" if ratio > 0.4 * _DARKEST else "#15181b"


def _draw_phases(axes: Axes, channels: Sequence[Channel]) -> None:
    """Ratio of error to noise by channel and phase."""
    phases = list(dict.fromkeys(phase for c in channels for phase, (error, _) in c.by_phase.items() if not np.isnan(error)))
    ratios = np.array([[_ratio(*channel.by_phase.get(phase, (np.nan, np.nan))) for phase in phases] for channel in channels])
    axes.imshow(ratios, cmap=_RATIO_COLORS, norm=_RATIO_NORM, aspect="auto")
    for (row, column), ratio in np.ndenumerate(ratios):
        text = "-" if np.isnan(ratio) else number(float(ratio), 2)
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=_ink(ratio))
    axes.set_xticks(range(len(phases)), [words(phase).replace(" ", "\n") for phase in phases], fontsize=8)
    axes.set_yticks(range(len(channels)), [words(channel.row.name) for channel in channels], fontsize=8)
    axes.tick_params(length=0)
    axes.xaxis.tick_top()
    axes.spines[:].set_visible(False)


_LABELS = {
    "speed": "|velocity| [rad/s]\n(error along the motion)",
    "velocity": "velocity [rad/s]",
    "position": "angle [rad]",
    "load": "torque command [Nm]",
    "time": "time [s]",
}


def error_bins(channels: Sequence[Channel]) -> Figure:
    """Mean error of channels against each variable, with its 95 % interval and the noise of the mean; a row for each channel."""
    columns = [[name for name in channel.bins if name != "none" and channel.bins[name]] for channel in channels]
    width = max(map(len, columns))
    figure = Figure(figsize=(WIDTH, 0.7 + 2.1 * len(channels)), layout="constrained")
    grid = figure.subplots(len(channels), width, sharey="row", squeeze=False)
    for channel, names, panels in zip(channels, columns, grid, strict=True):
        for axes in panels[len(names) :]:
            axes.set_axis_off()
        for name, axes in zip(names, panels, strict=False):
            decorate(axes)
            _draw_bins(axes, channel.bins[name])
            axes.set_xlabel(_LABELS.get(name, f"{name} [N]"), fontsize=9)
        panels[0].set_ylabel(f"{words(channel.row.name).replace(' ', chr(10), 1)}\nerror [{channel.row.unit}]", fontsize=9)
    add_legend(figure)
    return figure


def _draw_bins(axes: Axes, bins: Sequence[Bin]) -> None:
    centre, error = np.array([b.centre for b in bins]), np.array([b.error for b in bins])
    low, high = np.array([b.interval for b in bins]).T
    noise = 2 * np.array([b.noise_floor for b in bins])
    axes.axhline(0, color=PLANNED, linewidth=0.8)
    axes.fill_between(centre, -noise, noise, color=_NOISE, alpha=0.45, linewidth=0, label="± 2 standard deviations of the noise")
    axes.fill_between(centre, low, high, color=TRUTH, alpha=0.18, linewidth=0, label="95 % interval")
    axes.plot(centre, error, color=TRUTH, marker="o", markersize=3.5, linewidth=1.2, label="mean error")


def errors_over_time(residual: Residual, sides: Sequence[str], channels: Sequence[Channel]) -> Figure:
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
        axes.fill_between(residual.time, -noise, noise, color=_NOISE, alpha=0.45, linewidth=0, label="± 2 standard deviations of the noise")
        axes.plot(residual.time, value, color=TRUTH, linewidth=0.9, label="error")
        _shade_supports(axes, residual, sides)
        axes.set_ylabel(f"{words(channel.row.name).replace(' ', chr(10), 1)}\n[{channel.row.unit}]", fontsize=9)
    grid[-1, 0].set_xlabel("time [s]")
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
            axes.axvspan(first, last, facecolor=color, alpha=0.12, linewidth=0, label=f"{side} leg supports")


def ranking(findings: Sequence[Finding]) -> Figure:
    """Held-out error without and with each effect, in multiples of the noise."""
    figure = Figure(figsize=(WIDTH, 1.2 + 0.42 * len(findings)), layout="constrained")
    axes = figure.subplots()
    decorate(axes)
    for place, finding in enumerate(findings):
        color = TRUTH if finding.chosen else VERDICT_COLORS["confusable"]
        label = "with the effect: part of the explanation" if finding.chosen else "with the effect: an alternative"
        axes.barh(place, finding.held_out_before, height=0.7, color="#dde1e5", label="without the effect")
        axes.barh(place, finding.held_out_after, height=0.42, color=color, label=label)
        axes.annotate(
            f"{number(finding.held_out_before, 3)} → {number(finding.held_out_after, 3)}",
            (max(finding.held_out_before, finding.held_out_after), place),
            (5, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=PLANNED,
        )
    axes.axvline(1.0, color=PLANNED, linestyle="--", linewidth=1.0, label="sensors' noise")
    axes.set_yticks(range(len(findings)), [finding_name(finding) for finding in findings], fontsize=9)
    axes.invert_yaxis()
    axes.set_xscale("log")
    largest = max(max(finding.held_out_before, finding.held_out_after) for finding in findings)
    axes.set_xlim(min(0.8, *(finding.held_out_after for finding in findings)), 1.8 * largest)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("held-out error of the channels that the effect moves, in multiples of the sensors' noise [1]")
    add_legend(figure)
    return figure


def spaced(name: str) -> str:
    """An effect's class name for reading: `CoulombFriction` -> `Coulomb friction`."""
    first, *rest = "".join(f" {letter}" if letter.isupper() else letter for letter in name).split()
    return " ".join(["IMU" if first == "Imu" else first, *(part.lower() for part in rest)])


def finding_name(finding: Finding) -> str:
    """As `Coulomb friction, left knee pitch`."""
    return f"{spaced(finding.effect)}, {targets_text(finding.targets)}"


def targets_text(targets: Sequence[str]) -> str:
    """Names of targets for reading, as `left and right knee pitch`; of many only how many."""
    sides, parts = zip(*(target.partition("_")[::2] for target in targets), strict=True)
    if len(targets) > 1 and len(set(parts)) == 1:
        return f"{' and '.join(sides)} {words(parts[0])}".rstrip()
    return ", ".join(map(words, targets)) if len(targets) < 4 else f"{len(targets)} joints"


def detectability(statuses: Mapping[str, EffectStatus]) -> Figure:
    """Smallest size of every effect that the data would have shown, on each target, over the largest plausible size."""
    known = library()
    names = [name for name in statuses if name in known]
    figure = Figure(figsize=(WIDTH, 1.1 + 0.27 * len(names)), layout="constrained")
    axes = figure.subplots()
    decorate(axes)
    sizes = {}
    for name in names:
        plausible = max(abs(bound) for bound in known[name].parameters[statuses[name].parameter].plausible)
        sizes[name] = np.array(list(statuses[name].smallest_detectable.values())) / plausible
    highest = 30.0
    for place, name in enumerate(names):
        shown = np.clip(np.nan_to_num(sizes[name], posinf=highest), None, highest)
        status = statuses[name]
        color = VERDICT_COLORS[status.verdict]
        if len(shown):
            axes.plot([shown.min(), shown.max()], [place, place], color=color, linewidth=1.2, alpha=0.5)
        axes.plot(
            shown, np.full(len(shown), place), "o", color=color, markersize=5.5, alpha=0.8, markeredgewidth=0, label=words(status.verdict)
        )
    axes.axvspan(1.0, 1.3 * highest, facecolor=_NOISE, alpha=0.2, linewidth=0, label="larger than plausible: could not be seen")
    axes.set_yticks(range(len(names)), [spaced(name) for name in names], fontsize=9)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlim(right=1.3 * highest)
    axes.set_xlabel("smallest detectable size over largest plausible size; a dot for each joint, foot or body [1]")
    add_legend(figure)
    return figure


@dataclass(frozen=True)
class _Interval:
    targets: str
    value: float
    low: float
    high: float


def parameters(findings: Sequence[Finding]) -> Figure:
    """Fitted values with their 95 % intervals, a panel for each parameter of each effect."""
    panels: dict[tuple[str, str, str], list[_Interval]] = {}
    for finding in findings:
        for name, estimate in finding.parameters.items():
            interval = _Interval(targets_text(finding.targets), estimate.value, *estimate.interval)
            panels.setdefault((finding.effect, name, estimate.unit), []).append(interval)
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    sizes = list(map(len, panels.values()))
    heights = [1.0 + 0.28 * max(sizes[start : start + columns]) for start in range(0, len(sizes), columns)]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    grid = figure.subplots(rows, columns, height_ratios=heights, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for axes, ((effect, name, unit), intervals) in zip(grid.flat, panels.items(), strict=False):
        decorate(axes)
        places = np.arange(len(intervals))
        value, low, high = (np.array([getattr(interval, key) for interval in intervals]) for key in ("value", "low", "high"))
        axes.hlines(places, low, high, color=ESTIMATE, linewidth=3, alpha=0.5, label="95 % interval")
        axes.plot(value, places, "o", color=ESTIMATE, markersize=5, label="value")
        axes.axvline(0, color=PLANNED, linewidth=0.8)
        axes.locator_params(axis="x", nbins=5)
        axes.set_yticks(places, [interval.targets for interval in intervals], fontsize=9)
        axes.set_ylim(len(intervals) - 0.5, -0.5)
        axes.set_title(spaced(effect), loc="left", fontsize=10)
        axes.set_xlabel(f"{words(name)} [{unit}]")
    add_legend(figure)
    return figure


def falling_error(study: Study) -> Figure:
    """Error of the residual step by step, and that of the simulated model where it was simulated."""
    rolled = [step.rollout for step in study.steps if step.rollout is not None]
    figure = Figure(figsize=(WIDTH, 6.4 if rolled else 4.2), layout="constrained")
    panels = figure.subplots(2 if rolled else 1, 1, sharex=True, squeeze=False)[:, 0]
    places = np.arange(len(study.steps))
    labels = ["as given", *("+ " + "\n+ ".join(_added(step.added)) for step in study.steps[1:])]
    axes = panels[0]
    held_out, train = ([getattr(step, name) for step in study.steps] for name in ("held_out_rmse", "train_rmse"))
    decorate(axes)
    axes.plot(places, held_out, "o-", color=TRUTH, linewidth=2, label="held-out data")
    axes.plot(places, train, "o--", color=ESTIMATE, linewidth=1.2, markersize=4, label="data that it was fitted to")
    for place, value in zip(places, held_out, strict=True):
        axes.annotate(number(value, 3), (place, value), (0, 8), textcoords="offset points", ha="center", fontsize=9)
    axes.axhline(1.0, color=PLANNED, linestyle="--", linewidth=1.0, label="sensors' noise")
    axes.set_yscale("log")
    axes.set_ylim(min(0.8, *held_out), 1.6 * max(held_out))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.set_ylabel("error of the residual\nover noise [1]")
    if rolled:
        decorate(panels[1])
        values = [np.nan if step.rollout is None else 1e3 * step.rollout.mean_position for step in study.steps]
        panels[1].plot(places, values, "o-", color="#7a4fa3", linewidth=2, label="simulated model, joint angles")
        for place, value in zip(places, values, strict=True):
            panels[1].annotate(number(value, 3), (place, value), (0, 8), textcoords="offset points", ha="center", fontsize=9)
        panels[1].set_ylim(0, 1.25 * max(1e-6, np.nanmax(values)))
        panels[1].set_ylabel("error of simulated\njoint angles, RMS [mrad]")
    panels[-1].set_xticks(places, labels, fontsize=8)
    panels[-1].set_xlim(-0.5, len(places) - 0.5)
    figure.align_ylabels()
    add_legend(figure)
    return figure


def _added(findings: Sequence[Finding]) -> list[str]:
    """Effects and where they are, wrapped to fit below a tick; of many the first ones."""
    named = [f"{spaced(effect)}\n({textwrap.fill(targets_text(targets), 22)})" for effect, targets in by_effect(findings).items()]
    return named if len(named) <= _MOST_NAMED else [*named[: _MOST_NAMED - 1], f"{len(named) - _MOST_NAMED + 1} others"]


def by_effect(findings: Sequence[Finding]) -> dict[str, list[str]]:
    """All targets of each effect, once."""
    result: dict[str, list[str]] = {}
    for finding in findings:
        targets = result.setdefault(finding.effect, [])
        targets.extend(target for target in finding.targets if target not in targets)
    return result
