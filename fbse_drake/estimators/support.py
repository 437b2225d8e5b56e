"""Which feet stand: by the plan's clock (paper Sec. 7.3) or from the foot forces."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import System

from fbse_drake.errors import InputError, require_not_negative
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.records import Record
from fbse_drake.sensors.errors import held_signal


@dataclass(frozen=True)
class PlannedSupport:
    """Feet stand when the plan says so."""

    by_plan: ClassVar[bool] = True

    @property
    def trigger(self) -> "MeasuredSupport":
        """What the foot forces are asked for all the same."""
        return MeasuredSupport()

    def add(self, chain: Chain, monitor: System) -> None:
        """Adds what tells a chain's sensor monitor of the plan.

        Raises:
            InputError: nobody knows the plan.
        """
        if chain.plan is None:
            instead = "needs a planned walk or stand (use !MeasuredSupport)"
            raise InputError(f"estimator.support: !PlannedSupport {instead}")
        plan, sides = chain.plan, chain.robot.description.sides
        support = np.stack([plan.support(side) for side in sides], axis=1).astype(float)
        signal = held_signal(support, float(plan.time[1] - plan.time[0]))
        source = chain.add_plain("planned_support", signal)
        chain.builder.Connect(source.get_output_port(), monitor.GetInputPort("planned_support"))


@dataclass(frozen=True)
class MeasuredSupport:
    """Feet stand when they carry load: a Schmitt trigger with a debounce."""

    by_plan: ClassVar[bool] = False

    # Share of the weight above which a foot begins to stand, and below which it ceases to.
    on: float = 0.10
    off: float = 0.05
    # The load must stay beyond its threshold for this long [s].
    debounce: float = 0.005

    def __post_init__(self) -> None:
        if not 0 < self.off <= self.on < 0.5:
            raise InputError(
                f"on, off: expected 0 < off <= on < 0.5, found on {self.on:g}, off {self.off:g}",
            )
        require_not_negative(self, "debounce")

    @property
    def trigger(self) -> "MeasuredSupport":
        """Itself."""
        return self

    def add(self, chain: Chain, monitor: System) -> None:
        """A chain's sensor monitor has all that it needs."""


SupportConfig = PlannedSupport | MeasuredSupport


@njit(cache=True)
def detect_support(
    support: np.ndarray,
    waiting: np.ndarray,
    last_support: np.ndarray,
    last_waiting: np.ndarray,
    elapsed: float,
    load: np.ndarray,
    trust: np.ndarray,
    thresholds: Record,
) -> None:
    """One tick of `MeasuredSupport`; all arrays have shape (feet,).

    A foot whose sensors are not trusted stays what it was.

    Args:
        support: filled with 1 for a foot that stands, else 0.
        waiting: filled with how long each load has been beyond its threshold [s].
        last_support, last_waiting: the same of the last tick.
        elapsed: time since then [s], NaN at the first tick.
        load: vertical force on each foot [N].
        trust: status of each foot's sensors, 0 for trusted ones.
        thresholds: record with the loads that begin and end a stance, `on` and `off` [N], and the
            `debounce` [s].
    """
    for foot in range(len(support)):
        if math.isnan(elapsed):
            support[foot], waiting[foot] = 1.0 if load[foot] > thresholds.on else 0.0, 0.0
            continue
        support[foot] = last_support[foot]
        stood, on, off = last_support[foot] > 0, thresholds.on, thresholds.off
        beyond = load[foot] < off if stood else load[foot] > on
        waiting[foot] = last_waiting[foot] + elapsed if beyond and trust[foot] == 0 else 0.0
        if waiting[foot] > thresholds.debounce:
            support[foot], waiting[foot] = 1.0 - last_support[foot], 0.0
