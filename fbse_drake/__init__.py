"""Friction estimation and missing physics for legged robots, on Drake."""

from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.scenario import Scenario, load_scenario
from fbse_drake.simulate import SimulationResult, simulate
from fbse_drake.station import Station, build_station

__all__ = ["InputError", "Log", "Scenario", "SimulationResult", "Station", "build_station", "load_scenario", "simulate"]
