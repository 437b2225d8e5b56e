"""Clock ticks of sampled systems.

Drake's discrete plant with sampled output ports steps in an *unrestricted* update, which comes
before all *discrete* updates of the same time. So a discrete update of another system sees the
plant's state of the next tick, an unrestricted one that of the present tick. Systems here that
remember something from tick to tick do so in unrestricted updates.
"""

from pydrake.systems.framework import Context, Diagram, DiscreteValues, PortDataType, System


def tick_index(time: float, period: float) -> int:
    """Number of the last tick at or before a time; times within a millionth of a period count as on
    it."""
    return int(time / period + 1e-6)


def is_tick(time: float, period: float) -> bool:
    """Does a tick fall on this time?"""
    return abs(time - tick_index(time, period) * period) < 1e-6 * period


def state_views(system: System, context: Context) -> list[DiscreteValues]:
    """Python's views of the discrete state of a system, or of all systems in a diagram.

    As long as they are kept, a system that asks for its state is given these and no new ones, which
    would cost each of its ticks half a microsecond.
    """
    if not isinstance(system, Diagram):
        return [context.get_discrete_state()]
    return [
        view
        for inner in system.GetSystems()
        for view in state_views(inner, system.GetSubsystemContext(inner, context))
    ]


def output_views(system: System, context: Context) -> list[object]:
    """Python's views of what the output ports of a system, or of all in a diagram, hold.

    As long as they are kept, a system that fills a port is given these and no new ones, which would
    cost each of its ticks a microsecond. All ports are evaluated.
    """
    if not isinstance(system, Diagram):
        ports = [system.get_output_port(i) for i in range(system.num_output_ports())]
        vectors = [port for port in ports if port.get_data_type() == PortDataType.kVectorValued]
        return [port.EvalBasicVector(context) for port in vectors]
    return [
        view
        for inner in system.GetSystems()
        for view in output_views(inner, system.GetSubsystemContext(inner, context))
    ]
