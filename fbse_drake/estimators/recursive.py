"""What all estimators share: a LeafSystem whose discrete state is its posterior, in named fields."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State


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
    see `fbse_drake.sampling`. The first field of every posterior is `status`, see `Status`; a posterior that would not be finite is not
    taken: the last one is held and the status says so.
    """

    def __init__(self, fields: Mapping[str, int], clock: Clock):
        super().__init__()
        self.fields = Fields({"status": 1, **fields})
        self._shortest = clock.shortest
        self._last = self.DeclareDiscreteState(self.fields.size)
        # Time of the last tick; NaN before the first.
        self._last_time = self.DeclareDiscreteState([math.nan])
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
    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        """The posterior of this tick.

        Args:
            last: posterior of the tick before; zeros at the first.
            elapsed: time since then [s]; NaN at the first tick.
        """

    def _calc_posterior(self, context: Context, output: BasicVector) -> None:
        last = context.get_discrete_state(self._last).value()
        elapsed = context.get_time() - context.get_discrete_state(self._last_time).value()[0]
        if elapsed < self._shortest:
            output.SetFromVector(last)
            return
        posterior = self._tick(context, last, elapsed)
        if not math.isfinite(posterior.sum()):
            posterior = last.copy()
            posterior[0] = Status.NOT_FINITE
        output.SetFromVector(posterior)

    def _remember(self, context: Context, state: State) -> None:
        time = context.get_time()
        discrete = state.get_mutable_discrete_state()
        last_time = discrete.get_mutable_value(self._last_time)
        if not time - last_time[0] < self._shortest:
            posterior = self._posterior.Eval(context)
            if math.isnan(last_time[0]) and posterior[0] == Status.NOT_FINITE:
                return  # Nothing to start from yet.
            discrete.set_value(self._last, posterior)
            last_time[0] = time
