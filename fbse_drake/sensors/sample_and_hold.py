"""Sensors that are read more seldom than the plant steps."""

from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from fbse_drake.sampling import is_tick
from fbse_drake.wiring import weakly


class SampleAndHold(LeafSystem):
    """Reads a signal at ticks and holds it in between.

    .. pydrake_system::

        name: SampleAndHold
        input_ports:
        - signal
        output_ports:
        - held

    Both are of the same size; at a tick, `held` is the signal of this time. Discrete state: the
    last reading. (Drake's `ZeroOrderHold` gives a reading after its tick only, and reads the
    plant's next state, see `fbse_drake.sampling`.)
    """

    def __init__(self, period: float, size: int):
        """Declares the ports.

        Args:
            period: from tick to tick [s], the first at 0.
        """
        super().__init__()
        self._period = period
        self._signal = self.DeclareVectorInputPort("signal", size)
        self._last = self.DeclareDiscreteState(size)
        sources = {
            self.input_port_ticket(self._signal.get_index()),
            self.xd_ticket(),
            self.time_ticket(),
        }
        self.held = self.DeclareVectorOutputPort("held", size, weakly(self._calc), sources)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, weakly(self._remember))

    def _calc(self, context: Context, output: BasicVector) -> None:
        if is_tick(context.get_time(), self._period):
            output.SetFromVector(self._signal.Eval(context))
        else:
            output.SetFromVector(context.get_discrete_state(self._last).value())

    def _remember(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._last).set_value(self.held.Eval(context))
