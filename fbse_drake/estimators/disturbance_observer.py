"""Friction by a disturbance observer on the momentum, to be compared with FBSE."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import in_library
from fbse_drake.estimators.momentum_balance import (
    Balance,
    BandwidthObserver,
    MomentumBalance,
    add_observer,
)
from fbse_drake.robot.plant import Robot


@in_library
@dataclass(frozen=True)
class DisturbanceObserver(BandwidthObserver):
    """Momentum-based disturbance observer of a floating-base robot (De Luca et al. 2006).

    It has the contact wrenches from the foot sensors.
    """

    def add(self, chain: Chain) -> None:
        self.add_observer(chain, "friction")

    def add_observer(self, chain: Chain, name: str) -> None:
        """Adds the observer, and before it what it needs, see `Fbse.add_base`."""
        add_observer(chain, name, partial(MomentumObserver, self, chain.robot))


class MomentumObserver(MomentumBalance):
    """Disturbance observer on the generalized momentum of the joints, p = H v.

    Ports and fields are those of `MomentumBalance`. The observer integrates
    u_dot = K (tau + J^T F + beta - p_dot - u), so that u is the friction behind a low-pass of
    first order.
    """

    def __init__(self, config: DisturbanceObserver, robot: Robot, **arguments: Any):
        """Declares ports and state; arguments as of `MomentumBalance`."""
        super().__init__(robot, **arguments)
        self._pole = config.pole

    def _observe(
        self, balance: Balance, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        keep = math.exp(-self._pole * elapsed)
        posterior["friction"] = keep * last["friction"] + (1 - keep) * balance.remainder
