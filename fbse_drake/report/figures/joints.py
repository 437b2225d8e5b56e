"""Angles and torques of the joints."""

from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report.figures.kind import figure_kind
from fbse_drake.report.figures.panels import (
    POSITION_SPAN,
    joint_color,
    joint_grid,
    joint_style,
    plot,
    source,
    widen,
)
from fbse_drake.report.metrics import joint_position_channel
from fbse_drake.report.style import INK, add_legend

# The least that a panel shows of an error [mrad].
_ERROR_SPAN = 0.2


@figure_kind(
    "Joint angles",
    "Reference and joint angle; a gap that can be seen at this scale is a large tracking error.",
)
def joint_angles(log: Log) -> Figure:
    """Reference and true joint angles (measured ones in a log without truth), a panel for each
    joint."""
    figure, panels = joint_grid(log, "joint angle [rad]")
    name = joint_position_channel(log)
    for joint, axes in panels.items():
        plot(axes, log, log[name][:, joint], **joint_style(log, joint, source(name)))
        if "reference/joint/position" in log:
            values = log["reference/joint/position"][:, joint]
            plot(axes, log, values, color=INK, linewidth=0.9, linestyle="--", label="reference")
    widen(panels, POSITION_SPAN)
    add_legend(figure)
    return figure


@figure_kind(
    "Joint tracking errors",
    "Reference minus joint angle. The joints of a row share one scale, so the legs can "
    "be compared.",
    needs=("reference/joint/position",),
)
def joint_errors(log: Log) -> Figure:
    """Reference minus true joint angle (measured in a log without truth), a panel for each
    joint."""
    figure, panels = joint_grid(log, "reference minus joint angle [mrad]")
    error = 1e3 * (log["reference/joint/position"] - log[joint_position_channel(log)])
    for joint, axes in panels.items():
        plot(axes, log, error[:, joint], color=joint_color(log, joint))
    widen(panels, _ERROR_SPAN)
    add_legend(figure)
    return figure


@figure_kind(
    "Joint torques",
    "Commanded torque and the feed-forward torque of the plan. What lies between the two is "
    "friction and whatever else the plan leaves out.",
    needs=("joint/torque_command",),
)
def torques(log: Log) -> Figure:
    """Commanded and, where planned, feed-forward torque, a panel for each joint."""
    figure, panels = joint_grid(log, "torque [Nm]")
    for joint, axes in panels.items():
        plot(
            axes,
            log,
            log["joint/torque_command"][:, joint],
            **joint_style(log, joint, "commanded"),
        )
        if "reference/joint/feedforward_torque" in log:
            values = log["reference/joint/feedforward_torque"][:, joint]
            plot(axes, log, values, color=INK, linewidth=0.9, linestyle="--", label="feed-forward")
    add_legend(figure)
    return figure
