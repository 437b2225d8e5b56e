"""Friction by a disturbance observer with a Q-filter, to be compared with FBSE."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from fbse_drake.errors import require_positive
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
class FilteredDisturbance(BandwidthObserver):
    """Disturbance observer with a Q-filter (Ohnishi 1987; Umeno and Hori 1991).

    The disturbance is the command less what the inverse of the nominal plant makes of the motion,
    both behind Q, so that Q over the nominal inertia's inverse is proper. Q is a low-pass of second
    order, w^2 / (s^2 + 2 d w s + w^2), by default Butterworth's. Friction that is constant is met
    exactly; one that rises by r a second is followed with the error 2 d r / w.
    """

    # Damping d of Q [1].
    damping: float = math.sqrt(0.5)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "damping")

    def add(self, chain: Chain) -> None:
        add_observer(chain, "friction", partial(QFilterObserver, self, chain.robot))


class QFilterObserver(MomentumBalance):
    """Disturbance observer with a filter Q of second order.

    Ports and fields are those of `MomentumBalance`, with `friction_rate` (n,) [Nm/s], the other
    state of Q.
    """

    def __init__(self, config: FilteredDisturbance, robot: Robot, **arguments: Any):
        """Declares ports and state; arguments as of `MomentumBalance`."""
        super().__init__(robot, **arguments, friction_rate=(len(robot.joint_names),))
        self._config = config

    def _observe(
        self, balance: Balance, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        states = np.stack([last["friction"], last["friction_rate"]])
        pole, damping = self._config.pole, self._config.damping
        states = second_order_low_pass(states, balance.remainder, pole, damping, elapsed)
        posterior["friction"], posterior["friction_rate"] = states


def second_order_low_pass(
    states: np.ndarray, value: np.ndarray, pole: float, damping: float, elapsed: float
) -> np.ndarray:
    """Output and its rate, (2, n), of w^2 / (s^2 + 2 d w s + w^2) after a constant input.

    Args:
        states: output and its rate before, (2, n).
        value: the input, (n,).
        pole, damping: w [rad/s] and d [1].
        elapsed: how long the input lasts [s].
    """
    # The exponential of [[0, 1], [-w^2, -2 d w]] t; complex where it rings.
    a = damping * pole
    root = np.sqrt(complex(a * a - pole * pole))
    decay, x = math.exp(-a * elapsed), root * elapsed
    c = (decay * np.cosh(x)).real
    s = (decay * (np.sinh(x) / root if abs(x) > 1e-9 else elapsed)).real
    away, rate = states[0] - value, states[1]
    return np.stack(
        [value + (c + a * s) * away + s * rate, -pole * pole * s * away + (c - a * s) * rate]
    )
