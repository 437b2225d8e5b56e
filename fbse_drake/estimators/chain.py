"""Estimators wired into one diagram, each fed by what others of it estimate."""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort, System
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer

from fbse_drake.effects.joint_torque import ResolvedJointTorque
from fbse_drake.effects.sensor import ResolvedSensorEffect
from fbse_drake.effects.sensor_systems import SensorCorrections
from fbse_drake.errors import InputError
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.believed_friction import BelievedFriction
from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.estimators.records import parts, size_of
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.robot.plant import Robot
from fbse_drake.signals import estimates
from fbse_drake.walking.plan import TaskPlan

S = TypeVar("S", bound=System)


class Workshop:
    """A diagram that chains are built in, side by side."""

    def __init__(self) -> None:
        self.builder = DiagramBuilder()
        self.chains = 0
        # Inputs of the diagram by signal.
        self.inputs: dict[str, InputPort] = {}
        # Readings that something is taken off first, by signal.
        self.corrected: dict[str, OutputPort] = {}
        # Takes the friction, where what is taken off may depend on it.
        self.friction: InputPort | None = None
        # What chains have in common: of what it was made, and its systems by name.
        self.parts: list[tuple[object, dict[str, RecursiveEstimator]]] = []

    def correct(
        self,
        effects: Sequence[ResolvedSensorEffect],
        robot: Robot,
        clock: Clock,
        *,
        knows_torque: bool,
    ) -> None:
        """Has effects of the sensors taken off their readings.

        Args:
            effects: in the order in which they came into the readings.
            knows_torque: the torque commands are known, else those effects that they have in the
                sensors are not.
        """
        has_imu = robot.description.imu is not None or robot.has_floating_base
        system = SensorCorrections(effects, robot, clock.period, imu=has_imu)
        self.builder.AddNamedSystem("sensor_corrections", system)
        if any(effect.effect.follows_load() for effect in effects):
            self.friction = system.GetInputPort("friction")
        split = self.builder.AddNamedSystem(
            "corrected_sensors", Demultiplexer(list(system.sizes.values()))
        )
        self.builder.Connect(system.get_output_port(), split.get_input_port())
        command = system.GetInputPort("torque_command")
        if knows_torque:
            self.feed("torque_command", command)
        else:
            zero = self.builder.AddSystem(ConstantVectorSource(np.zeros(command.size())))
            self.builder.Connect(zero.get_output_port(), command)
        for i, name in enumerate(system.sizes):
            self.feed(f"measured_{name}", system.GetInputPort(name))
            self.corrected[f"measured_{name}"] = split.get_output_port(i)

    def tell_friction(
        self,
        effects: Sequence[ResolvedJointTorque],
        robot: Robot,
        clock: Clock,
        law: FrictionRegressor | None,
        parameters: OutputPort | None,
    ) -> None:
        """Has the friction known where effects are taken off readings; that of the first chain.

        Args:
            effects: see `BelievedFriction`.
            law: that the chain finds, if it does, with these parameters.
        """
        if self.friction is None or self.builder.IsConnectedOrExported(self.friction):
            return
        system = BelievedFriction(effects, robot, clock.period, law)
        self.builder.AddNamedSystem("believed_friction", system)
        # As they are read: friction sits on the motor's side, and so does the encoder.
        read = {"joint_state": "measured_joint_state", "torque_command": "torque_command"}
        for port, signal in read.items():
            self.builder.ConnectToSame(self.inputs[signal], system.GetInputPort(port))
        if parameters is not None:
            self.builder.Connect(parameters, system.GetInputPort("parameters"))
        self.builder.Connect(system.get_output_port(), self.friction)

    def feed(self, signal: str, port: InputPort) -> None:
        """Connects an input port to a signal, an input of the whole diagram."""
        if signal in self.corrected:
            self.builder.Connect(self.corrected[signal], port)
        elif signal in self.inputs:
            self.builder.ConnectToSame(self.inputs[signal], port)
        else:
            self.builder.ExportInput(port, signal)
            self.inputs[signal] = port


class Chain:
    """What an `Estimator` adds its systems to.

    A system is called by the name under which it was added, and a port of it `system.port`. The one
    that estimates the friction is called `friction`, and so is that field of its posterior, (n,)
    [Nm].
    """

    def __init__(
        self,
        robot: Robot,
        clock: Clock,
        sensors: SensorBeliefs,
        plan: TaskPlan | None,
        *,
        knows_torque: bool,
        torque_effects: Sequence[ResolvedJointTorque] = (),
        workshop: Workshop | None = None,
    ):
        workshop = workshop or Workshop()
        # The model that is believed.
        self.robot = robot
        self.clock = clock
        # What is believed of the sensors.
        self.sensors = sensors
        # What the motion was planned from; None where nobody knows.
        self.plan = plan
        # Are the torque commands known?
        self.knows_torque = knows_torque
        # What the model says of the joints' torques.
        self.torque_effects = torque_effects
        # The law whose parameters a system estimates that is called `friction`, if one does.
        self.friction_law: FrictionRegressor | None = None
        self.builder = workshop.builder
        self._workshop = workshop
        # Sets names of this chain's systems and ports apart from those of others.
        self._suffix = f"_{workshop.chains}" if workshop.chains else ""
        workshop.chains += 1
        self._systems: dict[str, RecursiveEstimator] = {}
        # Second names of systems.
        self._aliases: set[str] = set()

    @property
    def is_empty(self) -> bool:
        """Has nobody added a system?"""
        return not self._systems

    @property
    def knows_friction(self) -> bool:
        """Is there a system that estimates the friction?"""
        return "friction" in self._systems

    @property
    def friction_port(self) -> str:
        """Name of the diagram's output port for the friction."""
        return f"friction_estimate{self._suffix}"

    def share(self, part: object, add: Callable[[], None]) -> None:
        """Has systems added to this chain, or takes those that another chain has of the same part.

        Nothing that is added later may feed them, or chains would hear each other.

        Args:
            part: all that the systems depend on beside robot, clock, plan and beliefs of the
                sensors; equal for equal ones.
            add: adds them.
        """
        part = (part, self.sensors)
        for known, systems in self._workshop.parts:
            if known == part:
                self._systems |= systems
                return
        before = set(self._systems)
        add()
        added = {name: of for name, of in self._systems.items() if name not in before}
        self._workshop.parts.append((part, added))

    def add(
        self, name: str, make: Callable[..., RecursiveEstimator], **sources: str
    ) -> RecursiveEstimator:
        """Adds a system.

        Its posterior's fields become channels as the table of signals says (`Estimator.signals`).
        Inputs that nothing is connected to take the signal of their name: what a sensor measures,
        or `torque_command` (which has to be that of the tick before where the command may depend on
        the estimate: a remembered input).

        Args:
            make: the system's class, or a partial call of it; gets the types of the inputs that
                have sources as arguments of their names, and `clock`.
            sources: by input, the system whose posterior feeds it, or another record of a system,
                `system.port`.

        Raises:
            InputError: a source that is not there.
        """
        types = {port: self._system(source).posterior_type for port, source in sources.items()}
        system = make(**types, clock=self.clock)
        self._systems[name] = self.add_plain(name, system)
        for port, source in sources.items():
            self.connect(source, f"{name}.{port}")
        return system

    def add_plain(self, name: str, system: S) -> S:
        """Adds a system that is no estimator, and that nobody calls by its name."""
        return self.builder.AddNamedSystem(f"{name}{self._suffix}", system)

    def alias(self, system: str, name: str) -> None:
        """Gives a system a second name, as one that does the work of two.

        By that name it tells what it estimates, but not its innovations a second time.
        """
        self._systems[name] = self._systems[system]
        self._aliases.add(name)

    def connect(self, source: str, target: str) -> None:
        """Connects a posterior, or an output `system.port`, to an input `system.port`."""
        output = source.partition(".")[2] or "posterior"
        port = self._system(target).GetInputPort(target.partition(".")[2])
        self.builder.Connect(self._system(source).GetOutputPort(output), port)

    def connect_field(self, source: str, field: str, target: str) -> None:
        """Connects one field of a record to an input `system.port`.

        Args:
            source: an output `system.port` that has the record of the system's posterior.
            field: its name, or `record.field` of one within.
        """
        kind, start = self._system(source).posterior_type, 0
        for name in field.split("."):
            start, kind = start + parts(kind)[name].start, kind[name]
        part = {field: slice(start, start + size_of(kind))}
        output = self._system(source).GetOutputPort(source.partition(".")[2])
        port = self._system(target).GetInputPort(target.partition(".")[2])
        self.builder.Connect(self._split(f"{source}_{field}", output, part)[field], port)

    def feed(self, signal: str, port: InputPort) -> None:
        """Connects an input port to a signal: what a sensor measures, or `torque_command`."""
        self._workshop.feed(signal, port)

    def finish(self) -> dict[str, tuple[int, ...]]:
        """Makes inputs and outputs of the diagram of what is to be seen of it.

        Returns:
            The channels that outputs become, and the shape of one sample.

        Raises:
            InputError: the system that is to estimate the friction does not.
        """
        for system in self._systems.values():
            for port in system.input_ports():
                if not self.builder.IsConnectedOrExported(port):
                    self.feed(port.get_name(), port)
        n, channels = len(self.robot.joint_names), {}
        fields = {name: self._fields(name) for name in self._systems}
        if self.knows_friction:
            friction = fields["friction"].get("friction")
            if friction is None or friction.size() != n:
                raise InputError(
                    f"estimator: friction: expected a posterior with a field friction ({n},)"
                )
            self.builder.ExportOutput(friction, self.friction_port)
        if self.knows_torque:
            law = self.friction_law
            found = None if law is None else fields["friction"]["parameters"]
            self._workshop.tell_friction(self.torque_effects, self.robot, self.clock, law, found)
        for row in estimates():
            field = fields.get(row.estimator, {}).get(row.field)
            if field is not None:
                self.builder.ExportOutput(field, f"{row.port}{self._suffix}")
                channels[row.channel] = row.sample_shape(n, field.size())
        return channels

    def _system(self, source: str) -> RecursiveEstimator:
        name = source.partition(".")[0]
        if name not in self._systems:
            known = ", ".join(self._systems) or "none"
            raise InputError(f"estimator: there is no system {name} (there are: {known})")
        return self._systems[name]

    def _fields(self, name: str) -> dict[str, OutputPort]:
        """Output ports for the fields of a posterior that the table of signals has.

        (The estimator has such ports itself, which are Python's and cost more.)
        """
        system, told = self._systems[name], {"friction"}
        told |= {row.field for row in estimates() if row.estimator == name}
        if name in self._aliases:
            told -= {"innovation", "innovation_variance"}
        spans = {
            field: part for field, part in parts(system.posterior_type).items() if field in told
        }
        if not spans:
            return {}
        return self._split(f"{name}_fields", system.GetOutputPort("posterior"), spans)

    def _split(
        self, name: str, output: OutputPort, spans: Mapping[str, slice]
    ) -> dict[str, OutputPort]:
        """Output ports for parts of a vector, as few as there must be: each costs every tick."""
        cuts = sorted({0, output.size(), *(x for s in spans.values() for x in (s.start, s.stop))})
        split = self.add_plain(name, Demultiplexer(np.diff(cuts).tolist()))
        self.builder.Connect(output, split.get_input_port())
        return {
            field: split.get_output_port(cuts.index(span.start)) for field, span in spans.items()
        }
