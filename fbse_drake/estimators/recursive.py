"""What all estimators share: a LeafSystem whose discrete state is its posterior, a record."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

import numpy as np
from numba import njit
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
)
from pydrake.systems.primitives import ConstantVectorSource, Multiplexer

from fbse_drake.estimators.records import as_record, parts, size_of

# Sensors are compared with each other at ticks of at most this [s]. Between rarer readings healthy
# ones differ as much as faulty ones, and nothing is said.
LONGEST_COMPARED_TICK = 0.0025


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


@dataclass(frozen=True)
class RecordInput:
    """An input port that gets the posterior of another estimator."""

    port: InputPort
    kind: np.dtype

    def Eval(self, context: Context) -> np.ndarray:
        """The posterior as a record."""
        return np.ndarray((), self.kind, self.port.Eval(context))


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
        self._last = self.DeclareDiscreteState(start)
        self.DeclarePeriodicUnrestrictedUpdateEvent(clock.period, 0.0, self._remember)
        self.DeclareForcedUnrestrictedUpdateEvent(self._remember)

    def _declare_record_input(self, name: str, kind: np.dtype) -> RecordInput:
        """Declares an input port for a posterior of this type."""
        return RecordInput(self.DeclareVectorInputPort(name, size_of(kind)), kind)

    def _declare_posterior(self, *inputs: str) -> None:
        """Declares the outputs; to be called when the input ports are declared.

        Args:
            inputs: names of the ports that the posterior is made from.
        """
        tickets = {self.input_port_ticket(self.GetInputPort(name).get_index()) for name in inputs}
        tickets |= {self.time_ticket(), self.xd_ticket()}
        size = size_of(self.posterior_type)
        self._posterior = self.DeclareVectorOutputPort(
            "posterior",
            size,
            self._calc_posterior,
            tickets,
        )
        for name, part in parts(self.posterior_type).items():
            calc = partial(self._calc_field, part)
            self.DeclareVectorOutputPort(name, part.stop - part.start, calc, tickets)

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
        self._tick(context, as_record(before, self.posterior_type), elapsed, posterior)
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
        state.get_mutable_discrete_state().set_value(0, self._posterior.Eval(context))


def connect_fields(
    builder: DiagramBuilder, target: InputPort, kind: np.dtype, ports: Mapping[str, OutputPort]
) -> None:
    """Feeds an input that takes a record from plain ports, field by field.

    Args:
        kind: type of the record.
        ports: by field, flat; a field without one is zero.
    """
    sizes = {name: part.stop - part.start for name, part in parts(kind).items()}
    joined = builder.AddSystem(Multiplexer(list(sizes.values())))
    for i, (name, size) in enumerate(sizes.items()):
        zero = None if name in ports else builder.AddSystem(ConstantVectorSource(np.zeros(size)))
        source = ports[name] if zero is None else zero.get_output_port()
        builder.Connect(source, joined.get_input_port(i))
    builder.Connect(joined.get_output_port(), target)
