"""What all estimators share: a LeafSystem whose discrete state is its posterior, in named fields."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

# Place of the status in the posterior of every estimator.
STATUS = 1


class Status(IntEnum):
    """What an estimator says of its inputs."""

    OK = 0
    # An input is not a number: the last posterior is held.
    NOT_FINITE = 1
    # A sensor repeats itself to the last bit.
    STUCK = 2
    # A foot's sensors do not show the load that the foot must carry.
    LOST = 3


@dataclass(frozen=True)
class Fields:
    """Named parts of a vector, in order, with their sizes."""

    sizes: Mapping[str, int]

    @cached_property
    def size(self) -> int:
        return sum(self.sizes.values())

    @cached_property
    def slices(self) -> dict[str, slice]:
        ends = np.cumsum(list(self.sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(self.sizes.items(), ends, strict=True)}

    def __getitem__(self, name: str) -> slice:
        return self.slices[name]

    def pack(self, **values: np.ndarray | float) -> np.ndarray:
        """A vector with these values, zero where none is given."""
        vector = np.zeros(self.size)
        for name, value in values.items():
            vector[self[name]] = np.ravel(value)
        return vector

    def unpack(self, vectors: np.ndarray) -> dict[str, np.ndarray]:
        """Parts of one vector (size,) or of many (N, size)."""
        return {name: vectors[..., part] for name, part in self.slices.items()}


def starts(parts: Mapping[str, slice], *names: str) -> tuple[int, ...]:
    """Where these parts of a vector start.

    Kernels get such places, and their other constants, as arrays and name them with `to_fixed_tuple`: numba unboxes a tuple item by item.
    """
    return tuple(parts[name].start for name in names)


@dataclass(frozen=True)
class Clock:
    """When an estimator ticks."""

    # Nominal period [s].
    period: float = 0.001
    # An evaluation that comes sooner after the last tick than this [s] is no tick: the posterior is held. Over a recorded log every
    # sample is one.
    shortest: float = 0.001 * (1 - 1e-6)


class RecursiveEstimator(LeafSystem):
    """Base of the estimators.

    The output port `posterior` holds the estimator's posterior of the present tick, made from the posterior of the tick before (the
    discrete state) and the inputs of this tick; so a chain of estimators adds no delay. The state takes it over in an unrestricted update,
    see `fbse_drake.sampling`. The first field of every posterior is `time`, that of its tick [s], NaN before the first; the second one of
    an estimator is `status`, see `Status`. A posterior that would not be finite is not taken: the last one is held and the status says so.
    """

    def __init__(self, fields: Mapping[str, int], clock: Clock):
        """Declares the state.

        Args:
            fields: of the posterior, besides `time`.
        """
        super().__init__()
        self.fields = Fields({"time": 1, **fields})
        self._has_status, self._shortest = "status" in fields, clock.shortest
        self._last = self.DeclareDiscreteState([math.nan, *np.zeros(self.fields.size - 1)])
        self.DeclarePeriodicUnrestrictedUpdateEvent(clock.period, 0.0, self._remember)
        self.DeclareForcedUnrestrictedUpdateEvent(self._remember)

    def _declare_posterior(self, *inputs: str) -> None:
        """Declares the output; to be called when the input ports are declared.

        Args:
            inputs: names of the ports that it is made from.
        """
        tickets = {self.input_port_ticket(self.GetInputPort(name).get_index()) for name in inputs}
        self._posterior = self.DeclareVectorOutputPort(
            "posterior", self.fields.size, self._calc_posterior, tickets | {self.time_ticket(), self.xd_ticket()}
        )

    @abstractmethod
    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        """Makes the posterior of this tick.

        Args:
            last: posterior of the tick before, not to be written; zeros at the first.
            elapsed: time since then [s]; NaN at the first tick.
            posterior: to be filled but for its `time`; what it holds before means nothing.
        """

    def _calc_posterior(self, context: Context, output: BasicVector) -> None:
        last, time = context.get_discrete_state().value(0), context.get_time()
        elapsed = time - last.item(0)
        if elapsed < self._shortest:
            output.SetFromVector(last)
            return
        posterior = output.get_mutable_value()
        self._tick(context, last, elapsed, posterior)
        posterior[0] = time
        # Is it finite? The square is the cheapest sum over all.
        if not math.isfinite(posterior.dot(posterior)):
            posterior[1:] = last[1:]
            if self._has_status:
                posterior[STATUS] = Status.NOT_FINITE
        if math.isnan(elapsed) and self._has_status and posterior[STATUS] == Status.NOT_FINITE:
            posterior[0] = math.nan  # Nothing to start from yet.

    def _remember(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state().set_value(0, self._posterior.Eval(context))
