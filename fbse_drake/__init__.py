"""Friction estimation and missing physics for legged robots, on Drake."""

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
