"""Which feet stand: by the plan's clock (paper Sec. 7.3) or from the foot forces."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from fbse_drake.errors import InputError, require_not_negative


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
            raise InputError(
                f"on, off: expected 0 < off <= on < 0.5, found on {self.on:g}, off {self.off:g}",
            )
        require_not_negative(self, "debounce")


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
    thresholds: np.ndarray,
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
