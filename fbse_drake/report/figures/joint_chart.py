"""One joint over time, with all that is known of it: a chart to look into."""

from collections.abc import Iterator

import numpy as np

from fbse_drake.log import Log
from fbse_drake.report.chart import HOW_TO_ZOOM, Chart, Line, Panel, View
from fbse_drake.report.figures.forces import feels_feet, foot_force
from fbse_drake.report.figures.panels import joint_color, side_color, source
from fbse_drake.report.metrics import ended_step, joint_position_channel, joint_sides
from fbse_drake.report.style import ESTIMATE, INK, TRUTH

_CAPTION = (
    f"What is known of a joint; the band is twice the estimate's standard deviation. {HOW_TO_ZOOM}"
)


def joint_chart(log: Log) -> Chart:
    """Friction, torque, velocity and tracking error of a joint, and the load on its foot, as far as
    the log has them."""
    views = (
        View(name.replace("_", " "), tuple(_panels(log, joint)))
        for joint, name in enumerate(log.joints)
    )
    return Chart("One joint over time", _CAPTION, "Joint", log.time, tuple(views))


def _panels(log: Log, joint: int) -> Iterator[Panel]:
    def of_joint(channel: str) -> np.ndarray | None:
        return log[channel][:, joint] if channel in log else None

    color, position = joint_color(log, joint), joint_position_channel(log)
    angle = log[position][:, joint]
    if friction := tuple(_friction_lines(log, joint)):
        yield Panel("friction [Nm]", friction)
    torque = {
        "commanded torque": (of_joint("joint/torque_command"), color, False),
        "feed-forward": (of_joint("reference/joint/feedforward_torque"), INK, True),
    }
    if lines := _lines(torque):
        yield Panel("torque [Nm]", lines)
    velocity = {
        "measured velocity": (of_joint("joint/velocity"), color, False),
        "true velocity": (of_joint("truth/joint/velocity"), TRUTH, True),
    }
    if lines := _lines(velocity):
        yield Panel("velocity [rad/s]", lines)
    reference = of_joint("reference/joint/position")
    if reference is None:
        yield Panel("angle [rad]", (Line(f"{source(position)} angle", angle, color),))
    else:
        error = Line("reference minus angle", 1e3 * (reference - angle), color)
        yield Panel("error [mrad]", (error,))
    side = joint_sides(log)[joint]
    if side is not None and feels_feet(log):
        force = foot_force(log, side)[:, 2]
        yield Panel("load [N]", (Line("load on its foot", force, side_color(log, side)),))


def _friction_lines(log: Log, joint: int) -> Iterator[Line]:
    if "estimate/joint/friction_torque" in log:
        estimate = log["estimate/joint/friction_torque"][:, joint]
        deviation = log.get("estimate/joint/friction_torque_std")
        band = None if deviation is None else 2 * deviation[:, joint]
        yield Line("estimated friction", estimate, ESTIMATE, band=band)
    if "truth/joint/friction_torque" in log:
        truth = ended_step(log, "truth/joint/friction_torque")[:, joint]
        yield Line("true friction", truth, TRUTH, dashed=True)


def _lines(found: dict[str, tuple[np.ndarray | None, str, bool]]) -> tuple[Line, ...]:
    """Of what is known: values, colour, and whether it is dashed, by label."""
    return tuple(
        Line(label, values, color, dashed)
        for label, (values, color, dashed) in found.items()
        if values is not None
    )
