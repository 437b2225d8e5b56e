"""The picture of a robot: its joints, soles and centre of mass from the front and from the side."""

import numpy as np
from matplotlib.figure import Figure
from pydrake.systems.framework import Context

from fbse_drake.report.style import add_legend, decorate
from fbse_drake.robot.plant import Robot

_LIMB, _SOLE, _MASS = "#5b6670", "#2979b5", "#d65f1a"


def robot_figure(robot: Robot, posture: np.ndarray) -> Figure:
    """A robot in a posture, its lowest point on the ground.

    Args:
        posture: joint angles, (n,) [rad].
    """
    context = robot.plant.CreateDefaultContext()
    robot.set_joint_positions(context, posture)
    limbs = _limbs(robot, context)
    soles = {side: _sole(robot, context, side) for side in robot.description.sides}
    com = robot.plant.CalcCenterOfMassPositionInWorld(context)
    ground = min(points[:, 2].min() for points in [*soles.values(), *limbs])
    figure = Figure(figsize=(8, 5), layout="constrained")
    views = zip(figure.subplots(1, 2, sharey=True), ((1, "y", -1), (0, "x", 1)), strict=True)
    for axes, (axis, name, sign) in views:
        for limb in limbs:
            axes.plot(limb[:, axis], limb[:, 2] - ground, "o-", color=_LIMB, markersize=4)
        for number, points in enumerate(soles.values()):
            closed = points[[0, 1, 3, 2, 0]] if len(points) == 4 else points
            label = "soles" if number == 0 else None
            marker = "o" if len(points) == 1 else None
            axes.plot(
                closed[:, axis],
                closed[:, 2] - ground,
                color=_SOLE,
                linewidth=4,
                marker=marker,
                label=label,
            )
        axes.plot(
            com[axis], com[2] - ground, "X", color=_MASS, markersize=10, label="centre of mass"
        )
        decorate(axes)
        axes.set(xlabel=f"{name} [m]", aspect="equal", adjustable="datalim")
        if sign < 0:
            axes.invert_xaxis()
            axes.set(title="from behind", ylabel="height [m]")
        else:
            axes.set(title="from the right")
    add_legend(figure)
    return figure


def _limbs(robot: Robot, context: Context) -> list[np.ndarray]:
    """From each joint to the next one towards the base, in the world, (2, 3) [m] each."""
    plant = robot.plant
    places = {
        name: plant.GetJointByName(name).frame_on_child().CalcPoseInWorld(context).translation()
        for name in robot.joint_names
    }
    carried = {
        name: set(plant.GetBodiesKinematicallyAffectedBy([plant.GetJointByName(name).index()]))
        for name in robot.joint_names
    }
    base = robot.base.body_frame().CalcPoseInWorld(context).translation()
    limbs = []
    for name, bodies in carried.items():
        inner = [other for other in carried if bodies < carried[other]]
        before = places[min(inner, key=lambda other: len(carried[other]))] if inner else base
        limbs.append(np.array([before, places[name]]))
    for side, leg in robot.description.legs.items():
        sole = robot.sole(side).CalcPoseInWorld(context).translation()
        limbs.append(np.array([places[leg.joints[-1]], sole]))
    return limbs


def _sole(robot: Robot, context: Context, side: str) -> np.ndarray:
    X_WF = robot.sole(side).CalcPoseInWorld(context)
    return X_WF.multiply(robot.pad_positions(side).T).T
