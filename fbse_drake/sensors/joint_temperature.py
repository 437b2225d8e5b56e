"""Temperature of the joints' motor windings.

A winding is one heat capacity C behind one thermal resistance R to its surroundings (the
first-order model of motor data sheets),

    C dT/dt = P - (T - T_ambient) / R,    P = copper_loss * tau^2 + friction_share * max(u v, 0)

with the commanded torque tau (copper loss goes with the current squared, and the current with the
torque), the torque loss u of the joint and its velocity v. Under constant power it warms up from
T_0 as

    T(t) = T_ambient + R P + (T_0 - T_ambient - R P) exp(-t / (R C))

What is heated by friction is the gear; a share of it reaches the winding. A torque loss that gives
power back to the joint (a spring, a motor's gain) is no friction and counts as none while it does
so.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    State,
)

from fbse_drake.errors import InputError, require_not_negative, require_positive, required
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.encoders import quantize
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise
from fbse_drake.sensors.sensor import Run, Sensor, in_library
from fbse_drake.signals import Signal, signals_of
from fbse_drake.wiring import weakly


@in_library
@dataclass(frozen=True)
class JointTemperature(Sensor):
    """Thermometers in the windings, and the windings' heat; values are by joint.

    Read as `resolution * round((temperature + noise) / resolution)`. The defaults are a motor of
    some 100 W in a robot's leg.
    """

    signals: ClassVar[tuple[Signal, ...]] = signals_of("measured_temperature")
    whole_steps: ClassVar[tuple[str, ...]] = ("period",)

    # Heat in the winding per torque squared at the joint [W/(Nm)^2].
    copper_loss: dict[str, float] = field(default_factory=lambda: {"all": 0.05})
    # Share of the joint's friction power that heats the winding [1].
    friction_share: dict[str, float] = field(default_factory=lambda: {"all": 0.0})
    # Thermal resistance R from winding to surroundings [K/W].
    resistance: dict[str, float] = field(default_factory=lambda: {"all": 1.5})
    # R C [s].
    time_constant: dict[str, float] = field(default_factory=lambda: {"all": 60.0})
    # Of the surroundings, and of the windings at the start [degC].
    ambient: float = 20.0
    start: float = 20.0
    # Standard deviation of white noise [K]; one count [K], 0 reads exactly.
    noise: float = 0.0
    resolution: float = 0.0
    # Sampling period [s], over which power is taken as constant; by default
    # `Scenario.usual_period`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_not_negative(self, "noise", "resolution")
        require_positive(self, "period")
        for name in ("copper_loss", "friction_share", "resistance"):
            for joint, value in getattr(self, name).items():
                if value < 0:
                    raise InputError(f"{name}.{joint}: expected a number >= 0, found {value:g}")
        for joint, value in self.time_constant.items():
            if value <= 0:
                raise InputError(f"time_constant.{joint}: expected a number > 0, found {value:g}")

    def check(self, names: RobotDescription) -> None:
        self._by_joint(names)

    def system(self, robot: Robot, run: Run) -> "JointTemperatureSensors":
        return JointTemperatureSensors(self, self._by_joint(robot.description), run)

    def _by_joint(self, names: RobotDescription) -> "WindingHeat":
        keys = ("copper_loss", "friction_share", "resistance", "time_constant")
        values = {key: names.per_joint(getattr(self, key), key=key) for key in keys}
        return WindingHeat(**values, ambient=self.ambient)


@dataclass(frozen=True)
class WindingHeat:
    """The heat of n windings; arrays of shape (n,), see `JointTemperature` for units."""

    copper_loss: np.ndarray
    friction_share: np.ndarray
    resistance: np.ndarray
    time_constant: np.ndarray
    ambient: float

    def power(self, torque: np.ndarray, loss: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Heat [W] at a commanded torque, a torque loss [Nm] and a velocity [rad/s], (n,) each."""
        friction = np.maximum(loss * velocity, 0.0)
        return self.copper_loss * torque**2 + self.friction_share * friction

    def after(self, temperature: np.ndarray, power: np.ndarray, time: float) -> np.ndarray:
        """Temperature, (n,) [degC], after a time [s] of constant power, (n,) [W]: exact."""
        final = self.ambient + self.resistance * power
        return final + (temperature - final) * np.exp(-time / self.time_constant)


class WindingThermometers(LeafSystem):
    """Windings that warm up, and what is read of them.

    .. pydrake_system::

        name: WindingThermometers
        input_ports:
        - joint_state
        - torque_command
        - torque_loss
        - error
        output_ports:
        - measured_temperature

    `joint_state` is [positions, velocities], shape (2n,) [rad, rad/s]; torques (n,) [Nm], the
    loss of the step that ended; `error` (n,) [K] is added before the reading is rounded;
    `measured_temperature` (n,) [degC]. Discrete state: the temperatures, updated with the power at
    each tick.
    """

    def __init__(self, config: JointTemperature, heat: WindingHeat):
        super().__init__()
        n = len(heat.resistance)
        self._heat, self._resolution = heat, config.resolution
        self._period = required(config.period, "period")
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * n)
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        self._torque_loss = self.DeclareVectorInputPort("torque_loss", n)
        self._error = self.DeclareVectorInputPort("error", n)
        self._temperature = self.DeclareDiscreteState(np.full(n, config.start))
        sources = {self.input_port_ticket(self._error.get_index()), self.xd_ticket()}
        self.DeclareVectorOutputPort("measured_temperature", n, weakly(self._calc), sources)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, 0.0, weakly(self._warm_up))

    def _calc(self, context: Context, output: BasicVector) -> None:
        temperature = context.get_discrete_state(self._temperature).value()
        output.SetFromVector(quantize(temperature + self._error.Eval(context), self._resolution))

    def _warm_up(self, context: Context, state: State) -> None:
        ports = (self._torque_command, self._torque_loss)
        velocity = np.split(self._joint_state.Eval(context), 2)[1]
        command, loss = (port.Eval(context) for port in ports)
        power = self._heat.power(command, loss, velocity)
        temperature = context.get_discrete_state(self._temperature).value()
        later = self._heat.after(temperature, power, self._period)
        state.get_mutable_discrete_state(self._temperature).set_value(later)


class JointTemperatureSensors(Diagram):
    """`WindingThermometers` with their noise, whose other ports it has.

    .. pydrake_system::

        name: JointTemperatureSensors
        input_ports:
        - joint_state
        - torque_command
        - torque_loss
        output_ports:
        - measured_temperature
    """

    def __init__(self, config: JointTemperature, heat: WindingHeat, run: Run):
        super().__init__()
        builder = DiagramBuilder()
        thermometers = builder.AddNamedSystem("thermometers", WindingThermometers(config, heat))
        period = required(config.period, "period")
        ticks = ticks_until(run.duration, period)
        size = len(heat.resistance)
        noise = config.noise * white_noise(run.seed, "joint temperature", ticks, size)
        errors = builder.AddNamedSystem("errors", held_signal(noise, period))
        builder.Connect(errors.get_output_port(), thermometers.GetInputPort("error"))
        for name in ("joint_state", "torque_command", "torque_loss"):
            builder.ExportInput(thermometers.GetInputPort(name), name)
        builder.ExportOutput(thermometers.get_output_port(), "measured_temperature")
        builder.BuildInto(self)
