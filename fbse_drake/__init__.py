"""Friction estimation and missing physics for legged robots, on Drake."""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fbse_drake.errors import InputError
    from fbse_drake.estimate import EstimationResult, estimate
    from fbse_drake.log import Log
    from fbse_drake.scenario import Scenario, load_scenario
    from fbse_drake.simulate import SimulationResult, simulate
    from fbse_drake.station import Station, build_station

__all__ = [
    "EstimationResult",
    "InputError",
    "Log",
    "Scenario",
    "SimulationResult",
    "Station",
    "build_station",
    "estimate",
    "load_scenario",
    "simulate",
]

_MODULES = {
    "EstimationResult": "estimate",
    "InputError": "errors",
    "Log": "log",
    "Scenario": "scenario",
    "SimulationResult": "simulate",
    "Station": "station",
    "build_station": "station",
    "estimate": "estimate",
    "load_scenario": "scenario",
    "simulate": "simulate",
}


class _Package(ModuleType):
    """Imports what the package offers when it is asked for: Drake takes seconds, and `fbse --help` does without."""


def _offered(name: str) -> property:
    def load(package: ModuleType) -> object:
        return getattr(import_module(f"{package.__name__}.{_MODULES[name]}"), name)

    def keep(package: ModuleType, module: object) -> None:
        """`simulate` is the function, also when the module of that name has been imported."""

    return property(load, keep)


for _name in __all__:
    setattr(_Package, _name, _offered(_name))
sys.modules[__name__].__class__ = _Package
