"""Friction as the disturbance of two observers of control engineering, compared with FBSE.

Both see what `MomentumBalance` leaves of the equation of motion.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from fbse_drake.errors import require_positive
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.momentum_balance import Balance, MomentumBalance, add_observer
from fbse_drake.robot.plant import Robot


@dataclass(frozen=True)
class BandwidthObserver(Estimator):
    """Base of both: their only setting is a bandwidth."""

    knows: ClassVar[str] = "inertia of all links"
    measures: ClassVar[str] = "IMU, foot forces"
    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {"bandwidth": (1.0, 100.0)}

    # Of the observer [Hz].
    bandwidth: float = 20.0

    def __post_init__(self) -> None:
        require_positive(self, "bandwidth")

    @property
    def pole(self) -> float:
        """Absolute value of its poles [rad/s]."""
        return 2 * math.pi * self.bandwidth


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
    """Gains (3,) [1, 1/s, 1/s^2] that put all poles at exp(-pole elapsed) (Miklosovic et al. 2006)."""
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
