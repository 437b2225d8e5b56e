"""Friction of the joints: true, estimated, over velocity, and the parameters that are learnt."""

import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydrake.common.yaml import yaml_load

from fbse_drake import schema
from fbse_drake.errors import InputError
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.recursive_least_squares import RecursiveLeastSquares
from fbse_drake.estimators.whole_body import WholeBody
from fbse_drake.log import Log
from fbse_drake.report.figures.kind import figure_kind
from fbse_drake.report.figures.panels import (
    FRICTION_SPAN,
    at_least,
    joint_color,
    joint_grid,
    joint_rows,
    joint_style,
    limit_to_readable,
    plot,
    readable,
    stride,
    time_grid,
    widen,
)
from fbse_drake.report.html import number
from fbse_drake.report.metrics import (
    broken_laws,
    ended_step,
    friction_error,
    friction_law_error,
    settled,
)
from fbse_drake.report.style import (
    BROAD,
    ERROR,
    ESTIMATE,
    PLANNED,
    THIN,
    TRUTH,
    WIDTH,
    add_legend,
    decorate,
)
from fbse_drake.scenario import Scenario

_TRUE_FRICTION = "truth/joint/friction_torque"
_ESTIMATED_FRICTION = "estimate/joint/friction_torque"
# The least that a panel shows of a velocity [rad/s].
_VELOCITY_SPAN = 0.01


@figure_kind(
    "Joint friction",
    lambda log: (
        "True friction torque of each joint, positive when it eats positive torque. "
        "It changes its sign where the joint turns round."
        + (" Thin: the law, in the joint farthest from it." if _farthest_from_law(log) else "")
    ),
    needs=(_TRUE_FRICTION,),
    where=lambda log: _ESTIMATED_FRICTION not in log,
)
def friction(log: Log) -> Figure:
    """True friction torque, a panel for each joint (as the truth in the paper's Fig. 6).

    Where simulated joints do not follow their laws, also the law of the worst one.
    """
    figure, panels = joint_grid(log, "friction torque [Nm]")
    for joint, axes in panels.items():
        values = log["truth/joint/friction_torque"][:, joint]
        plot(axes, log, values, color=TRUTH, linestyle="--", linewidth=1.0, label="true friction")
    if farthest := _farthest_from_law(log):
        column = log.joints.index(farthest)
        law = log["truth/joint/friction_law_torque"][:, column]
        label = f"its law, {farthest.replace('_', ' ')}"
        plot(panels[column], log, law, color=ESTIMATE, linewidth=0.8, label=label)
    widen(panels, FRICTION_SPAN)
    add_legend(figure)
    return figure


@figure_kind(
    "Estimated joint friction",
    lambda log: (
        "Estimated friction torque of each joint, positive when it eats positive torque"
        + (", and the true one. " if _TRUE_FRICTION in log else ". ")
        + "Grey: the joint's own leg swings, where the paper's method has no measurement and takes "
        "its model. Spikes of a few samples may leave a panel."
    ),
    needs=(_ESTIMATED_FRICTION,),
)
def estimated_friction(log: Log) -> Figure:
    """Estimated and, where known, true friction torque, a panel for each joint, with the leg's
    swings shaded (as the paper's Fig. 6).

    A band is twice the estimate's standard deviation.
    """
    figure, panels = joint_grid(log, "friction torque [Nm]", own_swing=True)
    estimate, deviation = (
        log["estimate/joint/friction_torque"],
        log.get("estimate/joint/friction_torque_std"),
    )
    truth = (
        ended_step(log, "truth/joint/friction_torque")
        if "truth/joint/friction_torque" in log
        else None
    )
    for joint, axes in panels.items():
        plot(axes, log, estimate[:, joint], **joint_style(log, joint, "estimated"), **BROAD)
        if deviation is not None:
            thin = stride(log)
            edges = (estimate[thin, joint] + sign * deviation[thin, joint] for sign in (-2, 2))
            axes.fill_between(
                log.time[thin],
                *edges,
                color=joint_color(log, joint),
                alpha=0.2,
                linewidth=0,
                label="± 2 std",
            )
        if truth is not None:
            plot(axes, log, truth[:, joint], **THIN, label="true friction")
    limit_to_readable(log, panels, estimate, whole=truth, span=FRICTION_SPAN)
    add_legend(figure)
    return figure


@figure_kind(
    "Error of the friction estimate",
    "Estimated minus true friction. The band is the root mean square (RMS) on either side of zero.",
    needs=(_TRUE_FRICTION, _ESTIMATED_FRICTION),
)
def friction_errors(log: Log) -> Figure:
    """Estimated minus true friction torque with its root mean square, a panel for each joint."""
    figure, panels = joint_grid(log, "estimated minus true friction [Nm]", own_swing=True)
    error = friction_error(log)
    rms = (
        np.sqrt(np.mean(error[settled(log)] ** 2, axis=0))
        if settled(log).any()
        else np.full(len(log.joints), np.nan)
    )
    for joint, axes in panels.items():
        plot(axes, log, error[:, joint], color=joint_color(log, joint), linewidth=0.9)
        if np.isfinite(rms[joint]):
            axes.axhspan(
                -rms[joint],
                rms[joint],
                facecolor=ERROR,
                alpha=0.15,
                linewidth=0,
                zorder=3,
                label="± RMS",
            )
            for edge in (-rms[joint], rms[joint]):
                axes.axhline(edge, color=ERROR, linewidth=0.9, linestyle="--", zorder=4)
            axes.set_title(
                f"RMS {number(float(rms[joint]), 2)} Nm",
                loc="right",
                fontsize=9,
                pad=3,
                color=PLANNED,
            )
    limit_to_readable(log, panels, error, span=FRICTION_SPAN)
    add_legend(figure)
    return figure


@figure_kind(
    "Friction over velocity",
    lambda log: (
        "The same torque against joint velocity: a step at zero is dry friction, a slope viscous "
        "friction, and a spread at one velocity means that friction depends on more than velocity"
        + (" (or that the estimate is noisy)." if _ESTIMATED_FRICTION in log else ".")
    ),
    where=lambda log: (
        (_TRUE_FRICTION in log or _ESTIMATED_FRICTION in log)
        and ("truth/joint/velocity" in log or "joint/velocity" in log)
    ),
)
def friction_over_velocity(log: Log) -> Figure:
    """Friction torque, estimated and true as far as known, against joint velocity, a panel for the
    joints that the sides have in common.

    The torque of each step against the velocity at its end, on which its law depends.
    """
    rows = joint_rows(log)
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
        shown = next(values for values in (estimate, truth) if values is not None)
        # Smaller dots on larger ones: where the sides agree, both can be seen.
        for (side, joint), size in zip(
            joints.items(), np.linspace(4.5, 2, max(2, len(joints))), strict=False
        ):
            label = f"{'estimated, ' if estimate is not None else ''}{side} leg" if side else None
            _dots(
                axes,
                velocity[stride(log), joint],
                shown[stride(log), joint],
                joint_color(log, joint),
                size,
                label,
            )
        if estimate is not None and truth is not None:
            for joint in joints.values():
                _dots(
                    axes,
                    velocity[stride(log), joint],
                    truth[stride(log), joint],
                    TRUTH,
                    1.8,
                    "true friction",
                )
        axes.set_xlim(at_least(axes.get_xlim(), _VELOCITY_SPAN))
        if estimate is None:
            axes.set_ylim(at_least(axes.get_ylim(), FRICTION_SPAN))
        else:
            limit_to_readable(
                log,
                dict.fromkeys(joints.values(), axes),
                estimate,
                whole=truth,
                span=FRICTION_SPAN,
            )
    figure.supxlabel("joint velocity [rad/s]", fontsize=10)
    figure.supylabel("friction torque [Nm]", fontsize=10)
    add_legend(figure, marker_size=9)
    return figure


@figure_kind(
    "Identified friction parameters",
    lambda log: (
        "Parameters of the adopted friction model as they are learnt while the robot moves; bands "
        "are two standard deviations, where the filter knows them. A parameter settles only when "
        f"its joint has moved enough to show it.{_meanings(log)}"
    ),
    needs=("estimate/friction/parameters",),
)
def friction_parameters(log: Log) -> Figure:
    """Identified parameters of the friction model, a column for each parameter and a row for the
    joints that the sides have in common."""
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
    knows_variance = config is not None and config.states_variance
    if knows_variance and "estimate/friction/parameter_variance" in log:
        deviation = np.sqrt(np.maximum(0.0, log["estimate/friction/parameter_variance"]))
    rows = joint_rows(log)
    figure, grid = time_grid(
        log, len(rows), len(titles), height=0.8 + 1.55 * len(rows), phases=False
    )
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, loc="left", fontsize=10)
    for (role, joints), row in zip(rows.items(), grid, strict=True):
        row[0].set_ylabel(role.replace("_", " "))
        for parameter, axes in enumerate(row):
            for joint in joints.values():
                curve = values[:, joint, parameter]
                plot(axes, log, curve, **joint_style(log, joint, "identified"))
                if deviation is not None:
                    band, color = 2 * deviation[:, joint, parameter], joint_color(log, joint)
                    thin = stride(log)
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
            axes.set_ylim(readable(log, shown, span=FRICTION_SPAN))
    add_legend(figure)
    return figure


def _farthest_from_law(log: Log) -> str | None:
    """The joint whose simulated torque is farthest from its law; None if all follow theirs."""
    return next(iter(broken_laws(friction_law_error(log))), None)


def _meanings(log: Log) -> str:
    """What the learnt parameters are, where their names do not say it."""
    config = _friction_config(log)
    parameters = {} if config is None else config.model.parameters
    meanings = (
        f" {name}: {parameter.meaning}."
        for name, parameter in parameters.items()
        if parameter.linear and parameter.meaning
    )
    return "".join(meanings)


def _friction_config(log: Log) -> RecursiveLeastSquares | ModelAided | WholeBody | None:
    """How the log's friction was estimated, by the scenario that it holds; None where that does not
    tell."""
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


def _dots(
    axes: Axes, x: np.ndarray, y: np.ndarray, color: str, size: float, label: str | None
) -> None:
    axes.plot(x, y, ".", color=color, markersize=size, markeredgewidth=0, label=label)
