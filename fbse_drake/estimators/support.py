"""Which feet stand: by the plan's clock (paper Sec. 7.3) or from the foot forces."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_not_negative
from fbse_drake.estimators.foot_pads import FootPads, vertical_loads
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, starts
from fbse_drake.robot.plant import Robot


@dataclass(frozen=True)
class PlannedSupport:
    """Feet stand when the plan says so."""


@dataclass(frozen=True)
class MeasuredSupport:
    """Feet stand when they carry load: a Schmitt trigger with a debounce."""

    # Share of the weight above which a foot begins to stand, and below which it ceases to.
    on: float = 0.10
    off: float = 0.05
    # The load must stay beyond its threshold for this long [s].
    debounce: float = 0.005

    def __post_init__(self) -> None:
        if not 0 < self.off <= self.on < 0.5:
            raise InputError(f"on, off: expected 0 < off <= on < 0.5, found on {self.on:g}, off {self.off:g}")
        require_not_negative(self, "debounce")


SupportConfig = PlannedSupport | MeasuredSupport


@njit(cache=True)
def _detect_support(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    pad_foot: np.ndarray,
    places: tuple[int, int],
    thresholds: tuple[float, float, float],
) -> None:
    """One tick of `SupportDetector`; fills the posterior.

    Args:
        places: of what is read, see the first line.
        thresholds: loads that begin and end a stance [N], and the debounce [s].
    """
    trust, pad_force = places
    on, off, debounce = thresholds
    feet = (len(posterior) - STATUS - 1) // 2
    load = vertical_loads(measured[pad_force:], pad_foot, feet)
    posterior[STATUS] = measured[trust + 2 : trust + 2 + feet].max()
    for foot in range(feet):
        support, waiting = STATUS + 1 + foot, STATUS + 1 + feet + foot
        if math.isnan(elapsed):
            posterior[support], posterior[waiting] = 1.0 if load[foot] > on else 0.0, 0.0
            continue
        posterior[support] = last[support]
        beyond = load[foot] < off if last[support] > 0 else load[foot] > on
        posterior[waiting] = last[waiting] + elapsed if beyond and measured[trust + 2 + foot] == 0 else 0.0
        if posterior[waiting] > debounce:
            posterior[support], posterior[waiting] = 1.0 - last[support], 0.0


class SupportDetector(RecursiveEstimator):
    """Which feet stand, from their vertical load.

    .. pydrake_system::

        name: SupportDetector
        input_ports:
        - measurements
        output_ports:
        - posterior

    `measurements` is the posterior of a `SensorMonitor`. Fields: `support` (feet,), 1 for a foot that stands, else 0; `waiting` (feet,),
    for how long [s] each load has been beyond its threshold. A foot whose sensors are not trusted stays what it was.
    """

    def __init__(self, config: MeasuredSupport, robot: Robot, measurements: dict[str, slice], clock: Clock):
        feet = len(robot.description.sides)
        super().__init__({"status": 1, "support": feet, "waiting": feet}, clock)
        weight = 9.81 * robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
        self._thresholds = (config.on * weight, config.off * weight, float(config.debounce))
        self._pad_foot, self._places = FootPads(robot).foot, starts(measurements, "trust", "pad_force")
        self._measurements = self.DeclareVectorInputPort("measurements", max(part.stop for part in measurements.values()))
        self._declare_posterior("measurements")

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        measured = self._measurements.Eval(context)
        _detect_support(posterior, last, elapsed, measured, self._pad_foot, self._places, self._thresholds)
