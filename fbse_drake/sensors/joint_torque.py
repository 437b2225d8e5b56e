"""Joint torque sensors, between joint and link; few robots have them."""

from dataclasses import dataclass
from typing import ClassVar

from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    State,
)
from pydrake.systems.primitives import Adder

from fbse_drake.errors import require_not_negative, require_positive, required
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise
from fbse_drake.sensors.sensor import Run, Sensor, in_library
from fbse_drake.signals import Signal, signals_of
from fbse_drake.wiring import weakly


@in_library
@dataclass(frozen=True)
class JointTorqueConfig(Sensor):
    """Errors of every sensor."""

    has_own_key: ClassVar[bool] = True
    signals: ClassVar[tuple[Signal, ...]] = signals_of("measured_torque")

    # Standard deviation of white noise [Nm].
    noise: float = 0.0
    # Sampling period [s], held in between; by default `Scenario.usual_period`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_not_negative(self, "noise")
        require_positive(self, "period")

    def system(self, robot: Robot, run: Run) -> "JointTorqueSensors":
        return JointTorqueSensors(self, len(robot.joint_names), *run)


class TransmittedTorque(LeafSystem):
    """What reached the links in the plant step that ended: command minus torque loss.

    .. pydrake_system::

        name: TransmittedTorque
        input_ports:
        - torque_command
        - torque_loss
        output_ports:
        - link_torque

    All (n,) [Nm]; the command is of the step that begins, the loss of the one that ended. Discrete
    state: the command of the last tick.
    """

    def __init__(self, joints: int, time_step: float):
        super().__init__()
        self._torque_command = self.DeclareVectorInputPort("torque_command", joints)
        self._torque_loss = self.DeclareVectorInputPort("torque_loss", joints)
        self._last = self.DeclareDiscreteState(joints)
        sources = {self.input_port_ticket(self._torque_loss.get_index()), self.xd_ticket()}
        self.DeclareVectorOutputPort("link_torque", joints, weakly(self._calc), sources)
        self.DeclarePeriodicUnrestrictedUpdateEvent(time_step, 0.0, weakly(self._remember))

    def _calc(self, context: Context, output: BasicVector) -> None:
        command = context.get_discrete_state(self._last).value()
        output.SetFromVector(command - self._torque_loss.Eval(context))

    def _remember(self, context: Context, state: State) -> None:
        command = self._torque_command.Eval(context)
        state.get_mutable_discrete_state(self._last).set_value(command)


class JointTorqueSensors(Diagram):
    """Measures the torque that reaches the links, of the step that ends now.

    .. pydrake_system::

        name: JointTorqueSensors
        input_ports:
        - torque_command
        - torque_loss
        output_ports:
        - measured_torque

    All (n,) [Nm].
    """

    def __init__(
        self, config: JointTorqueConfig, joints: int, time_step: float, seed: int, duration: float
    ):
        """Puts the sensors together.

        Args:
            time_step: the plant's step [s].
            seed: of the errors.
            duration: noise is drawn for this time [s].
        """
        super().__init__()
        builder = DiagramBuilder()
        true = builder.AddNamedSystem("true", TransmittedTorque(joints, time_step))
        period = required(config.period, "period")
        noise = config.noise * white_noise(
            seed, "joint torque", ticks_until(duration, period), joints
        )
        errors = builder.AddNamedSystem("errors", held_signal(noise, period))
        noisy = builder.AddNamedSystem("noisy", Adder(2, joints))
        builder.Connect(true.get_output_port(), noisy.get_input_port(0))
        builder.Connect(errors.get_output_port(), noisy.get_input_port(1))
        for name in ("torque_command", "torque_loss"):
            builder.ExportInput(true.GetInputPort(name), name)
        builder.ExportOutput(noisy.get_output_port(), "measured_torque")
        builder.BuildInto(self)
