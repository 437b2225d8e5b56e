"""What all estimators share: a LeafSystem whose discrete state is its posterior, a record."""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DependencyTicket,
    DiagramBuilder,
    DiscreteStateIndex,
    DiscreteValues,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
    ValueProducer,
)
from pydrake.systems.primitives import ConstantVectorSource, Multiplexer

from fbse_drake.errors import InputError, located
from fbse_drake.estimators.records import Record, as_record, parts, size_of
from fbse_drake.robot.plant import Robot
from fbse_drake.wiring import weakly

# Sensors are compared with each other at ticks of at most this [s]. Between rarer readings healthy
# ones differ as much as faulty ones, and nothing is said.
LONGEST_COMPARED_TICK = 0.0025

# Of a cache entry that stands for what it depends on, and has no value.
_NOTHING = ValueProducer(AbstractValue.Make(None).Clone, ValueProducer.NoopCalc)


class Status(IntEnum):
    """What an estimator says of its inputs."""

    OK = 0
    # An input is not a number: the last posterior is held.
    NOT_FINITE = 1
    # A sensor repeats itself to the last bit.
    STUCK = 2
    # A foot's sensors do not show the load that the foot must carry.
    LOST = 3
    # A sensor contradicts itself or the others.
    IMPLAUSIBLE = 4


@dataclass(frozen=True)
class Clock:
    """When an estimator ticks."""

    # Nominal period [s].
    period: float = 0.001
    # An evaluation that comes sooner after the last tick than this [s] is no tick: the posterior is
    # held. Over a recorded log every sample is one.
    shortest: float = 0.001 * (1 - 1e-6)
    # A reading of accelerometer or foot force is the mean over this time before it [s]; 0 for a
    # sample.
    reading: float = 0.001
    # How often inputs may change that count for the whole tick, as commands [s]; None: with it.
    control: float | None = None

    @staticmethod
    def every(period: float) -> "Clock":
        """Ticks each `period` [s]; readings are means over a tick."""
        return Clock(period, period * (1 - 1e-6), period)


@njit(cache=True)
def start_share(elapsed: float, reading: float) -> float:
    """Weight of what was read where a tick began in the mean over the tick.

    It is 0 for readings that are the mean over the tick, and grows to a half (the trapezoidal
    rule) for ticks that are much longer than that.

    Args:
        elapsed: length of the tick [s], NaN at the first.
        reading: see `Clock`.
    """
    return 0.5 * (1.0 - reading / elapsed) if elapsed > 1.5 * reading else 0.0


def _is_tick(context: Context, posterior: np.ndarray) -> bool:
    """Is this posterior a new one? (Before the first tick the time is no number.)"""
    return not posterior.item(0) <= context.get_discrete_state().value(0).item(0)


@dataclass(frozen=True)
class RecordInput:
    """An input port that gets the posterior of another estimator."""

    port: InputPort
    kind: np.dtype

    def Eval(self, context: Context) -> np.ndarray:
        """The posterior as a record."""
        return as_record(self.port.Eval(context), self.kind)


@dataclass(frozen=True)
class RememberedInput:
    """An input port whose value of the tick before counts: before the first, it is zero."""

    port: InputPort
    index: DiscreteStateIndex

    def Eval(self, context: Context) -> np.ndarray:
        """The value a tick ago."""
        return context.get_discrete_state().value(self.index)

    def remember(self, context: Context, state: DiscreteValues, posterior: np.ndarray) -> None:  # noqa: ARG002
        """Keeps the present value for the next tick."""
        state.set_value(self.index, self.port.Eval(context))


@dataclass(frozen=True)
class AveragedInput(RememberedInput):
    """The same of an input that changes within a tick: its mean since the tick before counts. The
    state is the mean, then how many values it is of."""

    def Eval(self, context: Context) -> np.ndarray:
        """The mean since the tick before."""
        return super().Eval(context)[:-1]

    def remember(self, context: Context, state: DiscreteValues, posterior: np.ndarray) -> None:
        """Adds the present value to the mean, which begins anew in a tick."""
        values, present = state.get_mutable_value(self.index), self.port.Eval(context)
        if _is_tick(context, posterior):
            values[:-1], values[-1] = present, 1.0
        else:
            values[-1] += 1.0
            values[:-1] += (present - values[:-1]) / values[-1]


class Past(NamedTuple):
    """Records of the last ticks, in a ring. (An array of them is of one type, however many there
    are: functions are compiled once for all tick rates.)"""

    # Place of the last one.
    newest: int
    of_tick: np.ndarray


@njit(cache=True)
def ticks_ago(past: Past, age: int) -> Record:
    """What is remembered of the tick that ended so many ticks ago, 1 for the last one."""
    return past.of_tick[(past.newest + 1 - age) % len(past.of_tick)]


@dataclass(frozen=True)
class History:
    """A field of the posterior, a record, as it was in the last ticks; zero before the first.

    A ring of its own, of which a tick writes one place: what is long need not be copied. The state
    is the place of the newest, then the ring.
    """

    index: DiscreteStateIndex
    # Of the record.
    kind: np.dtype
    # How many ticks are remembered, and where the posterior has the field.
    ticks: int
    part: slice

    def Eval(self, context: Context) -> Past:
        """All that is remembered."""
        values = context.get_discrete_state().value(self.index)
        ring = np.ndarray((self.ticks,), self.kind, values, values.itemsize)
        return Past(int(values.item(0)), ring)

    def remember(self, context: Context, state: DiscreteValues, posterior: np.ndarray) -> None:
        """Adds the present tick, if it is one."""
        if posterior.item(0) > context.get_discrete_state().value(0).item(0):
            values, own = state.get_mutable_value(self.index), posterior[self.part]
            newest = (int(values.item(0)) + 1) % self.ticks
            start = 1 + newest * len(own)
            values[0], values[start : start + len(own)] = newest, own


@dataclass(frozen=True)
class Advanced:
    """A state beside the posterior that goes on once in a tick."""

    index: DiscreteStateIndex
    # What it is at the next tick.
    advance: Callable[[Context], np.ndarray]

    def Eval(self, context: Context) -> np.ndarray:
        """What it is now."""
        return context.get_discrete_state().value(self.index)

    def remember(self, context: Context, state: DiscreteValues, posterior: np.ndarray) -> None:
        """Goes on, if the present evaluation is a tick."""
        if _is_tick(context, posterior):
            state.set_value(self.index, self.advance(context))


T = TypeVar("T", bound="RecursiveEstimator")


class RecursiveEstimator(LeafSystem):
    """Base of the estimators.

    The output port `posterior` holds the estimator's posterior of the present tick, made from the
    posterior of the tick before (the discrete state) and the inputs of this tick; so a chain of
    estimators adds no delay. The state takes it over in an unrestricted update, see
    `fbse_drake.sampling`. A posterior is a record, see `fbse_drake.estimators.records`, and each of
    its fields is an output port of its own as well, flat. The first field of every posterior is
    `time`, that of its tick [s], NaN before the first; the second one of an estimator is `status`,
    see `Status`. A posterior that would not be finite is not taken: the last one is held and the
    status says so.

    A subclass declares its inputs (`DeclareVectorInputPort`, `_declare_record_input`,
    `_declare_remembered_input`), then calls `_declare_posterior`; its `_tick` makes the posterior.
    """

    def __init__(self, posterior_type: np.dtype, clock: Clock):
        """Declares the state.

        Args:
            posterior_type: see `record_type`.
        """
        super().__init__()
        self.posterior_type = posterior_type
        self._has_status, self._shortest = "status" in posterior_type.names, clock.shortest
        start = np.zeros(size_of(posterior_type))
        as_record(start, posterior_type)["time"] = math.nan
        self._last = DiscreteStateIndex(self.DeclareDiscreteState(start))
        # Types of the records on its input ports.
        self.record_inputs: dict[str, np.dtype] = {}
        self._remembered: list[RememberedInput | History | Advanced] = []
        self._later: set[str] = set()
        control = clock.control or clock.period
        self._changes_within_ticks = control < clock.shortest
        self.DeclarePeriodicUnrestrictedUpdateEvent(control, 0.0, weakly(self._remember))
        self.DeclareForcedUnrestrictedUpdateEvent(weakly(self._remember))

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:  # noqa: ARG004
        """Fields that it reads of the records on its input ports, by port.

        These types are arguments of the constructor, which takes any that have these fields.
        """
        return {}

    @classmethod
    def AddToBuilder(
        cls: type[T],
        builder: DiagramBuilder,
        inputs: Mapping[str, OutputPort | Mapping[str, OutputPort | ArrayLike]],
        *,
        period: float,
        **arguments: Any,
    ) -> T:
        """Adds one to anybody's diagram.

        Args:
            inputs: what feeds each input port: a port; or the fields of a record that it reads, see
                `input_types` and `connect_fields`.
            period: tick [s].
            arguments: of the constructor, but for the clock and the types of its inputs.

        Returns:
            The estimator, whose output ports are the fields of its posterior.

        Raises:
            InputError: an input or a field that it has not, or an input without a source.
        """
        whole = {name: port for name, port in inputs.items() if isinstance(port, OutputPort)}
        types = cls.input_types(arguments.get("robot"))
        for name in types.keys() & whole.keys():
            types[name] = getattr(whole[name].get_system(), "posterior_type", types[name])
        system = cls(**arguments, **types, clock=Clock.every(period))
        ports = {port.get_name(): port for port in system.input_ports()}
        with located(f"{cls.__name__}: "):
            if inputs.keys() != ports.keys():
                expected, found = ", ".join(ports), ", ".join(inputs)
                raise InputError(f"expected the inputs {expected}, found {found}")
            builder.AddSystem(system)
            for name, port in ports.items():
                if name in whole:
                    builder.Connect(whole[name], port)
                else:
                    connect_fields(builder, port, system.record_inputs[name], inputs[name])
        return system

    def _declare_record_input(self, name: str, kind: np.dtype) -> RecordInput:
        """Declares an input port for a posterior of this type."""
        self.record_inputs[name] = kind
        return RecordInput(self.DeclareVectorInputPort(name, size_of(kind)), kind)

    def _declare_remembered_input(self, name: str, size: int) -> RememberedInput:
        """Declares an input port that the posterior of the next tick depends on, not this one's."""
        port = self.DeclareVectorInputPort(name, size)
        remembered = (
            AveragedInput(port, self.DeclareDiscreteState(size + 1))
            if self._changes_within_ticks
            else RememberedInput(port, self.DeclareDiscreteState(size))
        )
        self._remembered.append(remembered)
        self._later.add(name)
        return remembered

    def _declare_history(self, field: str, ticks: int) -> History:
        """Declares a state for what a record of the posterior was in the last ticks."""
        kind = self.posterior_type[field]
        index = self.DeclareDiscreteState(1 + ticks * size_of(kind))
        history = History(index, kind, ticks, parts(self.posterior_type)[field])
        self._remembered.append(history)
        return history

    def _declare_advanced(
        self, start: np.ndarray, advance: Callable[[Context], np.ndarray]
    ) -> Advanced:
        """Declares a state that a function takes from each tick to the next."""
        advanced = Advanced(DiscreteStateIndex(self.DeclareDiscreteState(start)), advance)
        self._remembered.append(advanced)
        return advanced

    def _declare_posterior(self) -> None:
        """Declares the outputs, which depend on the input ports that are declared by now."""
        tickets = self._tickets()
        size = size_of(self.posterior_type)
        self._posterior = self.DeclareVectorOutputPort(
            "posterior",
            size,
            weakly(self._calc_posterior),
            tickets,
        )
        # Drake tells every port of every ticket that changes; so the fields share one.
        shared = {self.DeclareCacheEntry("inputs", _NOTHING, tickets).ticket()}
        for name, part in parts(self.posterior_type).items():
            calc = partial(weakly(self._calc_field), part)
            self.DeclareVectorOutputPort(name, part.stop - part.start, calc, shared)

    def _tickets(self) -> set[DependencyTicket]:
        """What the posterior of a tick depends on."""
        inputs = [port for port in self.input_ports() if port.get_name() not in self._later]
        tickets = {self.input_port_ticket(port.get_index()) for port in inputs}
        return tickets | {self.time_ticket(), self.xd_ticket()}

    def findings(self, context: Context) -> tuple[str, ...]:  # noqa: ARG002
        """For the reader: what it has found out of the sensors by now."""
        return ()

    def input_ports(self) -> list[InputPort]:
        """All of them, in order."""
        return [self.get_input_port(i) for i in range(self.num_input_ports())]

    @abstractmethod
    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        """Makes the posterior of this tick.

        Args:
            last: posterior of the tick before, not to be written; zeros at the first.
            elapsed: time since then [s]; NaN at the first tick.
            posterior: to be filled but for its `time`; what it holds before means nothing.
        """

    def _calc_posterior(self, context: Context, output: BasicVector) -> None:
        before, time = context.get_discrete_state().value(0), context.get_time()
        elapsed = time - before.item(0)
        if elapsed < self._shortest:
            output.SetFromVector(before)
            return
        now = output.get_mutable_value()
        posterior = as_record(now, self.posterior_type)
        try:
            self._tick(context, as_record(before, self.posterior_type), elapsed, posterior)
        except np.linalg.LinAlgError:
            # As of a matrix that is not finite.
            now[:] = math.nan
        now[0] = time  # The first field.
        # Is it finite? The square is the cheapest sum over all.
        if not math.isfinite(now.dot(now)):
            now[1:] = before[1:]
            if self._has_status:
                posterior["status"] = Status.NOT_FINITE
        if math.isnan(elapsed) and self._has_status and posterior["status"] == Status.NOT_FINITE:
            posterior["time"] = math.nan  # Nothing to start from yet.

    def _calc_field(self, part: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._posterior.Eval(context)[part])

    def _remember(self, context: Context, state: State) -> None:
        values = state.get_mutable_discrete_state()
        # (`Eval` would copy it.)
        posterior = self._posterior.EvalBasicVector(context).value()
        values.set_value(0, posterior)
        for remembered in self._remembered:
            remembered.remember(context, values, posterior)


def connect_fields(
    builder: DiagramBuilder,
    target: InputPort,
    kind: np.dtype,
    fields: Mapping[str, OutputPort | ArrayLike],
) -> None:
    """Feeds an input port that takes a record, field by field.

    Args:
        kind: type of the record.
        fields: by name, each a port, flat, or a constant, one number for all or each; those that
            are not given are zero.

    Raises:
        InputError: a field that the record has not, or of another size.
    """
    sizes = {name: part.stop - part.start for name, part in parts(kind).items()}
    where = f"input {target.get_name()}"
    for name in fields:
        if name not in sizes:
            raise InputError(f"{where}: there is no field {name} (there are: {', '.join(sizes)})")
    joined = builder.AddSystem(Multiplexer(list(sizes.values())))
    for i, (name, size) in enumerate(sizes.items()):
        source = fields.get(name, 0.0)
        if not isinstance(source, OutputPort):
            constant = np.full(size, source) if np.ndim(source) == 0 else np.ravel(source)
            source = builder.AddSystem(ConstantVectorSource(constant)).get_output_port()
        if source.size() != size:
            found = source.size()
            raise InputError(f"{where}: field {name}: expected {size} numbers, found {found}")
        builder.Connect(source, joined.get_input_port(i))
    builder.Connect(joined.get_output_port(), target)
