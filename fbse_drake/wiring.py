"""Systems of a diagram are wired by name, a port goes where an input of its name is; and let go."""

import weakref
from collections.abc import Callable, Mapping
from types import MethodType
from typing import Any

from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System

from fbse_drake.errors import InputError


def connect_by_name(
    builder: DiagramBuilder,
    ports: Mapping[str, OutputPort],
    system: System,
) -> None:
    """Connects every input of a system to the port of its name.

    Raises:
        InputError: there is no port of this name.
    """
    for i in range(system.num_input_ports()):
        port = system.get_input_port(i)
        name = port.get_name()
        if name not in ports:
            known = ", ".join(ports)
            raise InputError(f"input {name}: there is no port of this name (there are: {known})")
        builder.Connect(ports[name], port)


def outputs_by_name(system: System) -> dict[str, OutputPort]:
    """The output ports of a system."""
    ports = [system.get_output_port(i) for i in range(system.num_output_ports())]
    return {port.get_name(): port for port in ports}


def weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of a system as the callback of one of its ports, events or cache entries.

    Drake keeps callbacks where Python's collector does not see them. The bound method itself would
    keep the system alive for ever, and with it all that its cache and its ports hold.
    """
    if not isinstance(method, MethodType):
        raise TypeError(f"expected a method of a system, found {method}")
    system, function = weakref.ref(method.__self__), method.__func__
    return lambda *arguments: function(system(), *arguments)


def release(system: System) -> None:
    """Lets go of a system that is done with, and of all in it; none of them can be used any more.

    What Python knows of a system refers to its diagram and back, and Python's collector does not
    see through such cycles where a system is written in Python: without this, none is ever freed.
    A system whose callbacks are not `weakly` held is emptied, and its shell stays.
    """
    if isinstance(system, Diagram):
        for inner in system.GetSystems():
            release(inner)
    vars(system).clear()
