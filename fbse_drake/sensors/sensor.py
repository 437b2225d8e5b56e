"""What a sensor is, and the library of all of them.

A sensor is one class in one file: a frozen dataclass that says how it errs (what a scenario file
says of it), the signals that it gives, and the Drake system that measures. Behind `@in_library`
its signals are in the table of all signals (`fbse_drake.signals`), and a scenario file can name
it:

    sensors: {more: {winding: !JointTemperature {noise: 0.5}}}

A sensor of a user's own is such a class in a module that the scenario names (`effect_modules`).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeVar

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort, System

from fbse_drake.errors import InputError, located
from fbse_drake.library import require_new
from fbse_drake.log import Log
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.sample_and_hold import SampleAndHold
from fbse_drake.signals import Signal, channels_of, port_values, register
from fbse_drake.wiring import connect_by_name, outputs_by_name


class Run(NamedTuple):
    """The simulation in which a sensor measures."""

    # The plant's step [s].
    time_step: float
    # Of all errors.
    seed: int
    # Errors are drawn for this time [s].
    duration: float


@dataclass(frozen=True)
class Sensor(ABC):
    """Base of the sensors: a frozen dataclass whose fields say how the sensor errs.

    One that samples has a field `period` [s]; if it is None, a scenario gives it its usual one.
    What it measures (ports `measured_...`) is then read so often, and held in between.
    """

    # What it gives: rows of the table of signals.
    signals: ClassVar[tuple[Signal, ...]]
    # Fields [s] that must be whole multiples of the plant's step, or 0.
    whole_steps: ClassVar[tuple[str, ...]] = ()
    # Has it a key of its own under `sensors`? Then it does not stand under `sensors.more`.
    has_own_key: ClassVar[bool] = False

    @staticmethod
    def alternatives() -> tuple[type["Sensor"], ...]:
        """What can stand under `sensors.more` in a scenario file (see `fbse_drake.schema`)."""
        return tuple(sensor for sensor in _LIBRARY.values() if not sensor.has_own_key)

    @classmethod
    def ports(cls) -> list[str]:
        """Names of its output ports."""
        return list(dict.fromkeys(signal.port for signal in cls.signals))

    @abstractmethod
    def system(self, robot: Robot, run: Run) -> System:
        """The system that measures.

        Its output ports are those of its signals. Its input ports are named like the robot's
        ports, of which it takes what it needs: `joint_state` [q, v], `torque_command` and
        `torque_loss` (of the step that ended), `deflection`, `body_poses`,
        `body_spatial_velocities`, `body_spatial_accelerations` and `reaction_forces` (of the step
        that ends), see `fbse_drake.station.add_robot`.
        """

    def add(
        self,
        builder: DiagramBuilder,
        name: str,
        robot: Robot,
        ports: Mapping[str, OutputPort],
        run: Run,
    ) -> dict[str, OutputPort]:
        """Adds its system, under this name, to the diagram of a robot with these ports.

        Returns:
            Its output ports by name.

        Raises:
            InputError: the system has an input that the robot has no port for, or other outputs
                than its signals.
        """
        system = builder.AddNamedSystem(name, self.system(robot, run))
        with located(f"sensor {name}: "):
            connect_by_name(builder, ports, system)
            given = outputs_by_name(system)
            if set(given) != set(self.ports()):
                expected, found = ", ".join(self.ports()), ", ".join(given) or "none"
                raise InputError(f"expected the output ports {expected}, found {found}")
        period = getattr(self, "period", None) or run.time_step
        if period < run.time_step * (1 + 1e-6):
            return given
        for port in [port for port in given if port.startswith("measured_")]:
            hold = SampleAndHold(period, given[port].size())
            builder.AddNamedSystem(f"{name}_{port}", hold)
            builder.Connect(given[port], hold.get_input_port())
            given[port] = hold.held
        return given

    def check(self, names: RobotDescription) -> None:  # noqa: B027
        """Raises InputError for values of joints that a robot has not."""

    def channels(self, robot: Robot, recorded: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Log channels, (N, ...) each, that its recorded ports, (N, size) each, become."""
        n = len(robot.joint_names)
        ports = [port for port in self.ports() if port in recorded]
        parts = (channels_of(port, recorded[port], n) for port in ports)
        return {name: values for part in parts for name, values in part.items()}

    def readings(self, robot: Robot, log: Log) -> dict[str, np.ndarray]:  # noqa: ARG002
        """What its ports told when a log was recorded, (N, size) each, as far as the log says it.

        Raises:
            InputError: channels that do not fit the robot.
        """
        values = {port: port_values(port, log) for port in self.ports()}
        return {port: value for port, value in values.items() if value is not None}


_LIBRARY: dict[str, type[Sensor]] = {}

T = TypeVar("T", bound=type[Sensor])


def in_library(sensor: T) -> T:
    """Class decorator: puts a sensor into the library and its signals into the table.

    Raises:
        InputError: it lacks its signals or its system, or there is another sensor, port or channel
            of one of its names.
    """
    if not getattr(sensor, "signals", ()):
        raise InputError(f"sensor {sensor.__name__}: the class variable signals is missing")
    require_new(_LIBRARY, "sensor", sensor)
    with located(f"sensor {sensor.__name__}: "):
        register(*sensor.signals)
    _LIBRARY[sensor.__name__] = sensor
    return sensor


def library() -> dict[str, type[Sensor]]:
    """All sensors by class name."""
    return dict(_LIBRARY)
