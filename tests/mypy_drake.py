"""Lets mypy read Drake's stubs, which are made from C++: arrays of ours would not fit, and what a
port holds and a builder gives back is not said."""

from collections.abc import Callable

from mypy.plugin import AnalyzeTypeContext, MethodContext, Plugin
from mypy.types import AnyType, Type, TypeOfAny, UnboundType

_ARRAY = "numpy.ndarray"
_FRAMEWORK, _VALUE = "pydrake.systems.framework.", "pydrake.common.value."


class DrakeStubs(Plugin):
    """What the stubs mean."""

    def get_type_analyze_hook(self, fullname: str) -> Callable[[AnalyzeTypeContext], Type] | None:
        """Hook that mypy calls for each type that is written somewhere."""
        return _array if fullname == _ARRAY else None

    def get_method_hook(self, fullname: str) -> Callable[[MethodContext], Type] | None:
        """Hook that mypy calls for what a method gives back, by the class of its object."""
        name = fullname.removeprefix(_FRAMEWORK).removeprefix(_VALUE)
        return _METHODS.get(name) or _DECLARED.get(fullname.rpartition(".")[2])


def _array(context: AnalyzeTypeContext) -> Type:
    """`numpy.ndarray[numpy.float64, ...]` has the type of the numbers where numpy wants the shape;
    it is an array of any."""
    api, given = context.api, context.type.args
    is_drakes = given and isinstance(given[0], UnboundType) and given[0].name.startswith("numpy.")
    known = [] if is_drakes else [api.analyze_type(argument) for argument in given]
    unknown = [AnyType(TypeOfAny.special_form)] * (2 - len(known))
    return api.named_type(_ARRAY, [*known, *unknown])


def _value(_: MethodContext) -> Type:
    """What a port holds depends on the port."""
    return AnyType(TypeOfAny.special_form)


def _system(context: MethodContext) -> Type:
    """The system itself, which comes last."""
    return context.arg_types[-1][0]


def _index(context: MethodContext) -> Type:
    """Who takes an index of a state says `int`."""
    return context.api.named_generic_type("builtins.int", [])


_METHODS = {
    "AbstractValue.get_mutable_value": _value,
    "InputPort.Eval": _value,
    "OutputPort.Eval": _value,
    "DiagramBuilder.AddNamedSystem": _system,
    "DiagramBuilder.AddSystem": _system,
}
# Of systems of ours.
_DECLARED = {"DeclareAbstractState": _index, "DeclareDiscreteState": _index}


def plugin(_: str) -> type[Plugin]:
    """Where mypy begins."""
    return DrakeStubs
