"""Which feet stand: by the plan's clock (paper Sec. 7.3) or from the foot forces."""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
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
        if self.debounce < 0:
            raise InputError(f"debounce: expected a number >= 0, found {self.debounce:g}")


SupportConfig = PlannedSupport | MeasuredSupport


class SupportDetector(RecursiveEstimator):
    """Which feet stand, from their vertical load.

    .. pydrake_system::

        name: SupportDetector
        input_ports:
        - measurements
        output_ports:
        - posterior

    `measurements` is the posterior of a `SensorMonitor`. Fields: `support` (feet,), 1 for a foot that stands, else 0; `waiting` (feet,), for
    how long [s] each load has been beyond its threshold. A foot whose sensors are not trusted stays what it was.
    """

    def __init__(self, config: MeasuredSupport, robot: Robot, measurements: dict[str, slice], clock: Clock):
        feet = len(robot.description.sides)
        super().__init__({"support": feet, "waiting": feet}, clock)
        self._config, self._inputs = config, measurements
        weight = 9.81 * robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
        self._on, self._off = config.on * weight, config.off * weight
        counts = [len(leg.pads) for leg in robot.description.legs.values()]
        starts = measurements["pad_force"].start + 3 * np.cumsum([0, *counts])
        self._vertical = [slice(int(start) + 2, int(end), 3) for start, end in zip(starts, starts[1:], strict=False)]
        self._measurements = self.DeclareVectorInputPort("measurements", max(part.stop for part in measurements.values()))
        self._declare_posterior("measurements")

    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        measured = self._measurements.Eval(context)
        trust = measured[self._inputs["trust"]].tolist()[2:]
        loads = [float(measured[part].sum()) for part in self._vertical]
        if math.isnan(elapsed):
            return np.array([max(trust), *(float(load > self._on) for load in loads), *(0.0 for _ in loads)])
        feet = len(loads)
        previous = last.tolist()
        support, waiting = previous[1 : 1 + feet], previous[1 + feet :]
        for k, load in enumerate(loads):
            beyond = load < self._off if support[k] else load > self._on
            waiting[k] = waiting[k] + elapsed if beyond and not trust[k] else 0.0
            if waiting[k] > self._config.debounce:
                support[k], waiting[k] = 1.0 - support[k], 0.0
        return np.array([max(trust), *support, *waiting])
