"""Force sensors under the feet: three-axis sensors in pads, or one six-axis sensor per foot."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    System,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    DiscreteTimeDelay,
    Gain,
    MatrixGain,
    Saturation,
)
from scipy.linalg import block_diag

from fbse_drake.errors import require_not_negative, require_positive, required
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise
from fbse_drake.sensors.foot_pads import FootPads, measured_pad_forces
from fbse_drake.sensors.sensor import Run, Sensor, in_library
from fbse_drake.signals import Signal, signals_of
from fbse_drake.wiring import weakly


@in_library
@dataclass(frozen=True)
class FootForceConfig(Sensor):
    """Errors of each axis of each pad, or of a six-axis sensor; the defaults measure exactly."""

    has_own_key: ClassVar[bool] = True
    signals: ClassVar[tuple[Signal, ...]] = (
        *signals_of("measured_pad_force"),
        *signals_of("true_pad_force"),
    )
    whole_steps: ClassVar[tuple[str, ...]] = ("delay",)

    # Standard deviation of white noise of a force [N], and of the moment of a six-axis sensor [Nm].
    noise: float = 0.0
    moment_noise: float = 0.0
    # What is read per force, and per moment.
    gain: float = 1.0
    # How late a reading comes [s], in whole plant steps.
    delay: float = 0.0
    # Largest force in either direction [N].
    range: float = 5000.0
    # Sampling period [s], held in between; by default `Scenario.usual_period`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_not_negative(self, "noise", "moment_noise", "delay")
        require_positive(self, "gain", "range", "period")

    def system(self, robot: Robot, run: Run) -> System:
        return FootForceSensors(self, robot, *run) if robot.description.legs else NoFeet()

    def channels(self, robot: Robot, recorded: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Forces on the pads of each foot, or the wrench on its sole; of the true ones both."""
        forces, wrenches = _by_foot(robot, recorded["measured_pad_force"])
        pads = {side: force for side, force in forces.items() if side not in wrenches}
        true_forces, true_wrenches = _by_foot(robot, recorded["true_pad_force"])
        return {
            **{f"foot/{side}/pad_force": force for side, force in pads.items()},
            **{f"foot/{side}/wrench": wrench for side, wrench in wrenches.items()},
            **{f"truth/foot/{side}/pad_force": force for side, force in true_forces.items()},
            **{f"truth/foot/{side}/wrench": wrench for side, wrench in true_wrenches.items()},
        }

    def readings(self, robot: Robot, log: Log) -> dict[str, np.ndarray]:
        if robot.description.legs and not any(name.startswith("foot/") for name in log):
            return {}
        force = measured_pad_forces(robot, log)
        return {"measured_pad_force": force.reshape(len(log.time), -1)}


def _by_foot(
    robot: Robot, pad_force: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Forces at each foot's pads or corners, and the wrench on each six-axis sensor.

    Args:
        pad_force: three components pad by pad, (N, size) [N].

    Returns:
        By side, (N, points, 3) [N] and (N, 6) [Nm, N].
    """
    pad_force = pad_force.reshape(len(pad_force), -1, 3)
    forces = dict(zip(robot.description.sides, FootPads(robot).split(pad_force), strict=True))
    wrenches = {
        side: force.reshape(len(force), -1) @ G.T
        for (side, force), G in zip(forces.items(), robot.grasp_maps, strict=True)
        if robot.description.legs[side].has_six_axes
    }
    return forces, wrenches


def wrench_deviations(config: FootForceConfig, robot: Robot) -> list[np.ndarray]:
    """Standard deviation of the noise in the wrench [moment, force] that is measured on each sole,
    shape (6,) each [Nm, N]."""
    six_axis = np.repeat([config.moment_noise, config.noise], 3)
    legs = robot.description.legs.values()
    return [
        six_axis if leg.has_six_axes else config.noise * np.linalg.norm(G, axis=1)
        for leg, G in zip(legs, robot.grasp_maps, strict=True)
    ]


def force_noise(
    config: FootForceConfig, robot: Robot, samples: int, random: np.random.Generator
) -> np.ndarray:
    """Noise in the forces at the pads or corners of all feet, shape (samples, points, 3) [N]."""
    legs = list(robot.description.legs.values())
    noise = config.noise * random.standard_normal((samples, sum(leg.points for leg in legs), 3))
    first = 0
    for leg, G, deviation in zip(
        legs, robot.grasp_maps, wrench_deviations(config, robot), strict=True
    ):
        if leg.has_six_axes:
            wrench = deviation * random.standard_normal((samples, 6))
            noise[:, first : first + leg.points] = (wrench @ np.linalg.pinv(G).T).reshape(
                samples, -1, 3
            )
        first += leg.points
    return noise


class PadForces(LeafSystem):
    """Picks the force of the ground on each pad, in the axes of its sole frame: what the pad's
    fixed joint transmits.

    .. pydrake_system::

        name: PadForces
        input_ports:
        - reaction_forces
        output_ports:
        - pad_force

    `pad_force` holds three components [N] pad by pad, side by side, in the description's order.
    """

    def __init__(self, robot: Robot):
        super().__init__()
        # Reactions are counted without the joints that were taken out of the model.
        place = {index: number for number, index in enumerate(robot.plant.GetJointIndices())}
        self._joints = [
            place[joint.index()]
            for side in robot.description.sides
            for joint in robot.pad_joints(side)
        ]
        self._reaction_forces = self.DeclareAbstractInputPort(
            "reaction_forces", Value([SpatialForce.Zero()])
        )
        sources = {self.input_port_ticket(self._reaction_forces.get_index())}
        self.DeclareVectorOutputPort(
            "pad_force", 3 * len(self._joints), weakly(self._calc), sources
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        reactions = self._reaction_forces.Eval(context)
        # A joint's reaction acts on the pad, against the ground's force.
        force = output.get_mutable_value()
        np.concatenate([reactions[joint].translational() for joint in self._joints], out=force)
        np.negative(force, out=force)


class NoFeet(Diagram):
    """The force sensors of a robot without feet: ports of size 0.

    .. pydrake_system::

        name: NoFeet
        output_ports:
        - true_pad_force
        - measured_pad_force
    """

    def __init__(self):
        super().__init__()
        builder = DiagramBuilder()
        nothing = builder.AddNamedSystem("nothing", ConstantVectorSource(np.zeros(0)))
        for name in ("true_pad_force", "measured_pad_force"):
            builder.ExportOutput(nothing.get_output_port(), name)
        builder.BuildInto(self)


class FootForceSensors(Diagram):
    """Measures the force of the ground on each pad, or the wrench on the sole of a foot with a
    six-axis sensor.

    .. pydrake_system::

        name: FootForceSensors
        input_ports:
        - reaction_forces
        output_ports:
        - true_pad_force
        - measured_pad_force

    Outputs as that of `PadForces`. The force is that of the plant's last step, with the foot's
    attitude at the start of that step; a delayed sensor reads zero at first. A measured
    wrench [moment, force] at the sole's origin comes out as the smallest forces at the foot's
    corners that have this wrench, see `corner_forces`.
    """

    def __init__(
        self, config: FootForceConfig, robot: Robot, time_step: float, seed: int, duration: float
    ):
        """Puts the sensors together.

        Args:
            time_step: the plant's step [s].
            seed: of the errors.
            duration: noise is drawn for this time [s].
        """
        super().__init__()
        builder = DiagramBuilder()
        true = builder.AddNamedSystem("true", PadForces(robot))
        legs = list(robot.description.legs.values())
        has_six_axes = any(leg.has_six_axes for leg in legs)
        # What the sensors of each foot read of the forces at its pads or corners.
        maps = [
            G if leg.has_six_axes else np.eye(3 * leg.points)
            for leg, G in zip(legs, robot.grasp_maps, strict=True)
        ]
        is_force = np.concatenate(
            [
                np.arange(6) >= 3 if leg.has_six_axes else np.ones(len(G), dtype=bool)
                for leg, G in zip(legs, maps, strict=True)
            ]
        )
        size = len(is_force)
        deviation = np.where(is_force, config.noise, config.moment_noise)
        period = required(config.period, "period")
        noise = deviation * white_noise(seed, "foot force", ticks_until(duration, period), size)
        errors = builder.AddNamedSystem("errors", held_signal(noise, period))
        noisy = builder.AddNamedSystem("noisy", Adder(2, size))
        limit = np.where(is_force, config.range, np.inf)
        measured = builder.AddNamedSystem("measured", Saturation(-limit, limit))
        read = true.get_output_port()
        if has_six_axes:
            wrenches = builder.AddNamedSystem("wrenches", MatrixGain(block_diag(*maps)))
            builder.Connect(read, wrenches.get_input_port())
            read = wrenches.get_output_port()
        if config.delay > 0:
            # A discrete update sees the next step's force already, and its delay is read one step
            # later: both together are even.
            steps = round(config.delay / time_step)
            late = builder.AddNamedSystem("late", DiscreteTimeDelay(time_step, steps, size))
            builder.Connect(read, late.get_input_port())
            read = late.get_output_port()
        if config.gain != 1:
            scaled = builder.AddNamedSystem("scaled", Gain(config.gain, size))
            builder.Connect(read, scaled.get_input_port())
            read = scaled.get_output_port()
        builder.Connect(read, noisy.get_input_port(0))
        builder.Connect(errors.get_output_port(), noisy.get_input_port(1))
        builder.Connect(noisy.get_output_port(), measured.get_input_port())
        told = measured.get_output_port()
        if has_six_axes:
            corner_forces = builder.AddNamedSystem(
                "corner_forces", MatrixGain(block_diag(*(np.linalg.pinv(G) for G in maps)))
            )
            builder.Connect(told, corner_forces.get_input_port())
            told = corner_forces.get_output_port()
        builder.ExportInput(true.get_input_port(), "reaction_forces")
        builder.ExportOutput(true.get_output_port(), "true_pad_force")
        builder.ExportOutput(told, "measured_pad_force")
        builder.BuildInto(self)
