"""Friction by an extended state observer, to be compared with FBSE."""

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
class ExtendedState(BandwidthObserver):
    """Extended state observer, as in active disturbance rejection (Han 2009).

    It knows the angles alone and takes what the model does not explain of the acceleration, f, for
    a third state beside angle and velocity. All its poles lie at minus the bandwidth (Gao 2003), so
    that f comes behind (w / (s + w))^3: one that is constant is met exactly, one that rises by r a
    second is followed with the error 3 r / w. The friction is minus the joints' inertia times f.
    """

    def add(self, chain: Chain) -> None:
        add_observer(chain, "friction", partial(ExtendedStateObserver, self, chain.robot))


class ExtendedStateObserver(MomentumBalance):
    """Extended state observer of every joint.

    Ports and fields are those of `MomentumBalance`, with `states` (3, n): angle [rad], velocity
    [rad/s] and the acceleration [rad/s^2] that the model does not explain; and `runs`, 1 where
    they have begun.
    """

    def __init__(self, config: ExtendedState, robot: Robot, **arguments: Any):
        """Declares ports and state; arguments as of `MomentumBalance`."""
        super().__init__(robot, **arguments, states=(3, len(robot.joint_names)), runs=())
        self._pole = config.pole

    def _wait(self, last: np.ndarray, posterior: np.ndarray) -> None:
        super()._wait(last, posterior)
        posterior["runs"] = 0.0

    def _observe(
        self, balance: Balance, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        inertia = balance.inertia[:, 6:]
        explained = np.linalg.solve(inertia, balance.remainder)
        explained += balance.velocity_change / elapsed
        states = last["states"]
        if not last["runs"]:
            # It begins anew, but what it knew of the disturbance.
            velocity = np.zeros_like(explained)
            states = np.stack([balance.angle, velocity, states[2]])
        states = extended_state(states, balance.angle, explained, self._pole, elapsed)
        posterior["states"], posterior["runs"] = states, 1.0
        posterior["friction"] = -inertia @ states[2]


def extended_state_gains(pole: float, elapsed: float) -> np.ndarray:
    """Gains (3,) [1, 1/s, 1/s^2] that put all poles at exp(-pole elapsed) (Miklosovic et al.
    2006)."""
    z = math.exp(-pole * elapsed)
    gains = (1 - z**3, 1.5 * (1 - z) ** 2 * (1 + z) / elapsed, (1 - z) ** 3 / elapsed**2)
    return np.array(gains)


def extended_state(
    states: np.ndarray, angle: np.ndarray, explained: np.ndarray, pole: float, elapsed: float
) -> np.ndarray:
    """One tick of an extended state observer of double integrators, (3, n).

    Args:
        states: see `ExtendedStateObserver`.
        angle: measured where the tick ends, (n,) [rad].
        explained: acceleration by the model over the tick, (n,) [rad/s^2].
        pole: bandwidth [rad/s].
        elapsed: length of the tick [s].
    """
    q, w, f = states
    a = explained + f
    predicted = np.stack([q + elapsed * (w + 0.5 * elapsed * a), w + elapsed * a, f])
    gains = extended_state_gains(pole, elapsed)
    return predicted + gains[:, None] * (angle - predicted[0])
