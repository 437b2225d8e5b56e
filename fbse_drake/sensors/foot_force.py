"""Three-axis force sensors under the feet."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Adder, DiscreteTimeDelay, Gain, Saturation

from fbse_drake.errors import require_not_negative, require_positive
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise


@dataclass(frozen=True)
class FootForceConfig:
    """Errors of each axis of each pad; the defaults measure exactly."""

    # Standard deviation of white noise [N].
    noise: float = 0.0
    # What is read per force.
    gain: float = 1.0
    # How late a reading comes [s], in whole plant steps.
    delay: float = 0.0
    # Largest force in either direction [N].
    range: float = 5000.0
    # Sampling period [s].
    period: float = 0.001

    def __post_init__(self) -> None:
        require_not_negative(self, "noise", "delay")
        require_positive(self, "gain", "range", "period")


class PadForces(LeafSystem):
    """Picks the force of the ground on each pad, in the axes of its sole frame: what the pad's fixed joint transmits.

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
        pads = [pad for leg in robot.description.legs.values() for pad in leg.pads]
        self._joints = [int(robot.plant.GetJointByName(pad).index()) for pad in pads]
        self._reaction_forces = self.DeclareAbstractInputPort("reaction_forces", Value([SpatialForce.Zero()]))
        sources = {self.input_port_ticket(self._reaction_forces.get_index())}
        self.DeclareVectorOutputPort("pad_force", 3 * len(pads), self._calc, sources)

    def _calc(self, context: Context, output: BasicVector) -> None:
        reactions = self._reaction_forces.Eval(context)
        # A joint's reaction acts on the pad, against the ground's force.
        output.SetFromVector(-np.array([reactions[joint].translational() for joint in self._joints]).ravel())


class FootForceSensors(Diagram):
    """Measures the force of the ground on each pad.

    .. pydrake_system::

        name: FootForceSensors
        input_ports:
        - reaction_forces
        output_ports:
        - true_pad_force
        - measured_pad_force

    Outputs as that of `PadForces`. The force is that of the plant's last step, with the foot's attitude at the start of that step;
    a delayed sensor reads zero at first.
    """

    def __init__(self, config: FootForceConfig, robot: Robot, time_step: float, seed: int, duration: float):
        """Puts the sensors together.

        Args:
            time_step: the plant's step [s].
            seed: of the errors.
            duration: noise is drawn for this time [s].
        """
        super().__init__()
        builder = DiagramBuilder()
        true = builder.AddNamedSystem("true", PadForces(robot))
        size = true.get_output_port().size()
        noise = config.noise * white_noise(seed, "foot force", ticks_until(duration, config.period), size)
        errors = builder.AddNamedSystem("errors", held_signal(noise, config.period))
        noisy = builder.AddNamedSystem("noisy", Adder(2, size))
        limit = np.full(size, config.range)
        measured = builder.AddNamedSystem("measured", Saturation(-limit, limit))
        read = true.get_output_port()
        if config.delay > 0:
            # A discrete update sees the next step's force already, and its delay is read one step later: both together are even.
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
        builder.ExportInput(true.get_input_port(), "reaction_forces")
        builder.ExportOutput(true.get_output_port(), "true_pad_force")
        builder.ExportOutput(measured.get_output_port(), "measured_pad_force")
        builder.BuildInto(self)
