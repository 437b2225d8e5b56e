"""Pictures of what each effect of the library looks like, made by the effects themselves.

A joint torque effect is shown on one joint that moves and is loaded as `_exercise` says; any other
by what the diagnosis predicts that it adds to the residual of a short walk, or of legs that swing
in a gantry.
"""

import io
from functools import cache

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from fbse_drake import load_scenario, simulate
from fbse_drake.discrepancy.diagnosis.dictionary import usual_values
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.geometry import GeometryEffect
from fbse_drake.effects.inertia import InertiaEffect
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, basis_over_time

# Both are read on white and on a dark page.
_INK, _CURVES = "#808080", ("#2d8fd5", "#e0702a", "#3a9f74")
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "fbse_drake",
    "font.size": 9,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.edgecolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.limits": (-3, 4),
}


def signature(effect: type[Effect]) -> bytes:
    """An effect's picture, as an SVG with a transparent background."""
    with rc_context(_STYLE):
        file = io.BytesIO()
        drawn(effect).savefig(file, format="svg", transparent=True, metadata={"Date": None})
    return file.getvalue()


def drawn(effect: type[Effect]) -> Figure:
    """An effect's picture."""
    return (_joint_torque if issubclass(effect, JointTorqueEffect) else _residual)(effect)


def _exercise() -> JointMotion:
    """A joint that swings to and fro, fast and slowly, and carries a load that comes in steps."""
    step = 1e-3
    time = np.arange(0.0, 4.0, step)
    position = 0.5 * np.sin(2 * np.pi * 0.5 * time) + 0.08 * np.sin(2 * np.pi * 1.75 * time)
    command = 25 * np.sin(2 * np.pi * 0.75 * time) + 15 * np.sign(np.cos(2 * np.pi * time))
    columns = (np.gradient(position, step), position, command, time)
    velocity, position, command, time = (column[:, None] for column in columns)
    return JointMotion(velocity, position, command, time, step, load=command)


def _joint_torque(effect: type[JointTorqueEffect]) -> Figure:
    motion = _exercise()
    basis = basis_over_time(effect, motion, usual_values(effect)[:, None])[..., 0]
    # An effect without linear parameters is one basis torque as it stands.
    torque = (_sizes(effect) if _sizes(effect).size else np.ones(1)) @ basis
    figure = Figure(figsize=(5.0, 4.0), layout="constrained")
    panels = zip(
        figure.subplots(2, 2, sharey=True).flat,
        ("time", "velocity", "position", "command"),
        ("time [s]", "velocity [rad/s]", "angle [rad]", "commanded torque [Nm]"),
        strict=True,
    )
    for axes, name, label in panels:
        axes.plot(getattr(motion, name)[:, 0], torque, color=_CURVES[0], linewidth=1.2)
        axes.set_xlabel(label)
    figure.supylabel("torque lost [Nm]", color=_INK, fontsize=9)
    return figure


def _sizes(effect: type[Effect]) -> np.ndarray:
    """Values of the linear parameters: a tenth of the largest plausible ones."""
    plausible = [p.plausible for p in effect.parameters.values() if p.linear]
    return np.array([0.1 * max(map(abs, bounds)) for bounds in plausible])


@cache
def _walk(*, motor_encoders: bool = False) -> Predictor:
    overrides = ["duration=3.5"]
    if motor_encoders:
        overrides.append("sensors.motor_encoders={resolution: 4.8e-5}")
    scenario = load_scenario("frictionless_walk", overrides=overrides)
    return Predictor(scenario, simulate(scenario).log)


@cache
def _swing() -> Predictor:
    scenario = load_scenario("leg_swing_gantry", overrides=["duration=3.5"])
    return Predictor(scenario, planned_log(scenario))


def _residual(effect: type[Effect]) -> Figure:
    predictor = (
        _swing() if effect.needs_fixed_base else _walk(motor_encoders=effect.needs_motor_encoder)
    )
    residual = predictor.residual
    found = predictor.signature(effect, _target(effect), usual_values(effect))
    added = found.offset + found.values @ _sizes(effect)
    known = residual.known[:, found.rows]
    relative = np.where(known, added / residual.noise_floor[found.rows], np.nan)
    figure = Figure(figsize=(5.0, 2.8), layout="constrained")
    axes = figure.subplots()
    strongest = np.argsort(-np.nanmean(relative**2, axis=0))
    for place, color in zip(strongest, _CURVES, strict=False):
        name = residual.rows[found.rows[place]].name.replace("_", " ").replace("/", ", ")
        axes.plot(residual.time, relative[:, place], color=color, linewidth=1.2, label=name)
    axes.axhline(0.0, color=_INK, linewidth=0.6)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("residual / its noise")
    figure.legend(loc="outside upper left", frameon=False)
    return figure


def _target(effect: type[Effect]) -> str:
    robot = _walk().robot
    if issubclass(effect, InertiaEffect | GeometryEffect) and effect.acts_on == "body":
        return effect.suspected_bodies(robot)[0]
    if effect.acts_on == "joint":
        return next(name for name in robot.joint_names if "knee" in name)
    return robot.description.sides[0] if effect.acts_on == "foot" else "robot"
