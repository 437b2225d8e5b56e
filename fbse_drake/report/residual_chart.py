"""What models leave of every channel over time: a chart to look into."""

from collections.abc import Iterator, Mapping
from itertools import cycle

import numpy as np

from fbse_drake.discrepancy.diagnosis.compare import words
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.report.chart import HOW_TO_ZOOM, Chart, Line, Panel, View
from fbse_drake.report.discrepancy_figures import BEFORE, NOISE
from fbse_drake.report.html import number
from fbse_drake.report.style import ESTIMATE, INK, SIDE_COLORS


def residual_chart(given: Predictor, completed: Predictor | None = None) -> Chart:
    """The error of each channel that is known, with the sensors' noise; of a joint also how it
    moves and its torque, and under a robot on legs the loads of its feet.

    Args:
        completed: a model with more effects, on the same log.
    """
    models = {"model as given": given.residual}
    if completed is not None:
        models["completed model"] = completed.residual
    motion, residual = given.motion, given.residual
    # Of noise alone the squares are 1 in the mean.
    squares = np.where(residual.known, residual.value**2 / residual.variance - 1.0, 0.0)
    views = tuple(
        View(words(residual.rows[k].name), tuple(_panels(given, models, k)))
        for k in np.argsort(-squares.sum(axis=0), kind="stable")
        if residual.known[:, k].any()
    )
    caption = (
        f"Averages over {number(1e3 * motion.length * motion.period)} ms; the channel with most "
        "error beyond the noise first. Inside the grey band is what sensor noise explains. "
        f"{HOW_TO_ZOOM}"
    )
    return Chart("One channel over time", caption, "Channel", residual.time, views)


def _panels(given: Predictor, models: Mapping[str, Residual], row: int) -> Iterator[Panel]:
    residual, robot, blocks = given.residual, given.robot, given.motion.blocks
    noise = 2 * np.where(residual.known[:, row], np.sqrt(residual.variance[:, row]), np.nan)
    errors = [Line("noise of the sensors", np.zeros(len(noise)), NOISE, band=noise)]
    for (name, left), color in zip(models.items(), (BEFORE, ESTIMATE), strict=False):
        value = np.where(left.known[:, row], left.value[:, row], np.nan)
        errors.append(Line(f"error of the {name}", value, color))
    yield Panel(f"error [{residual.rows[row].unit}]", tuple(errors))
    if row < len(robot.joint_names):
        unit = robot.torque_units[row]
        rate = "m/s" if unit == "N" else "rad/s"
        torque = Line("torque", blocks.torque_command[:, row], INK)
        velocity = Line("velocity", blocks.joint_velocity[:, row], INK)
        yield Panel(f"torque [{unit}]", (torque,))
        yield Panel(f"velocity [{rate}]", (velocity,))
    if sides := robot.description.sides:
        pads = given.motion.equation.pads.split(blocks.pad_force)
        loads = (
            Line(f"load on the {side} foot", force[..., 2].sum(axis=1), color)
            for side, force, color in zip(sides, pads, cycle(SIDE_COLORS), strict=False)
        )
        yield Panel("loads [N]", tuple(loads))
