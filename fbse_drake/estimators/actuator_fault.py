"""Friction as a fault of the actuators, to be compared with FBSE."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from scipy.stats import chi2

from fbse_drake.errors import InputError, require_not_negative, require_positive
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.momentum_balance import Balance, MomentumBalance, add_observer
from fbse_drake.robot.plant import Robot


@in_library
@dataclass(frozen=True)
class ActuatorFault(Estimator):
    """Faults of the actuators by a Kalman filter whose state they are a part of.

    What an actuator loses, here all friction, is an additive fault that walks at random beside the
    momentum of its joint (augmented-state observer; Keller and Darouach 1997). A second filter for
    each joint believes that there is no fault. Its innovations are white then, so that a fault is
    told by their exponentially weighted mean (Roberts 1959) with a known rate of false alarms, and
    joint by joint, for a fault of one joint is in no other's momentum.
    """

    knows: ClassVar[str] = "inertia of all links, noise of the sensors"
    measures: ClassVar[str] = "IMU, foot forces"
    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {"walk": (0.1, 30.0)}

    # Random walk of a fault [Nm/sqrt(s)], and its standard deviation at first [Nm].
    walk: float = 3.0
    uncertainty: float = 3.0
    # How far back the mean goes that a fault is told by [s].
    window: float = 0.1
    # Probability that a joint without fault is called faulty in a tick.
    false_alarms: float = 1e-4
    # A fault that is estimated as smaller than this is none [Nm]: the model is not that exact.
    smallest: float = 0.1

    def __post_init__(self) -> None:
        require_positive(self, "walk", "uncertainty", "window")
        require_not_negative(self, "smallest")
        if not 0 < self.false_alarms < 1:
            raise InputError(
                f"false_alarms: expected a number in (0, 1), found {self.false_alarms:g}"
            )

    def add(self, chain: Chain) -> None:
        make = partial(ActuatorFaultObserver, self, chain.sensors, chain.robot)
        add_observer(chain, "friction", make)


class ActuatorFaultObserver(MomentumBalance):
    """Estimates and isolates a fault in every joint.

    Ports and fields are those of `MomentumBalance`, of which `friction` is the fault, with

        fault         (n,)    1 where the joint is called faulty
        friction_std  (n,)    standard deviation of the fault [Nm]
        augmented     (4, n)  momentum [Nm s], and variances of its error [(Nm s)^2], of both
                              [Nm^2 s] and of the fault [Nm^2]
        healthy       (2, n)  momentum as it were without fault, and its error's variance
        evidence      (n,)    weighted mean of the innovations without fault over their deviations
        runs          ()      1 where the filters have begun
    """

    def __init__(
        self, config: ActuatorFault, sensors: SensorBeliefs, robot: Robot, **arguments: Any
    ):
        """Declares ports and state; arguments as of `MomentumBalance`."""
        n = len(robot.joint_names)
        super().__init__(
            robot,
            **arguments,
            fault=(n,),
            friction_std=(n,),
            augmented=(4, n),
            healthy=(2, n),
            evidence=(n,),
            runs=(),
        )
        self._config = config
        self._velocity_variance = _square(sensors.joint_velocity_noise)
        self._rate_variance = _square(sensors.angular_velocity_noise)
        self._threshold = float(chi2.isf(config.false_alarms, 1))
        legs = robot.description.legs
        moment, force = _square(sensors.moment_noise), _square(sensors.force_noise)
        self._wrench_variance = np.concatenate(
            [
                np.repeat([moment, force], 3)
                if leg.has_six_axes
                else force * (grasp**2).sum(axis=1)
                for leg, grasp in zip(legs.values(), robot.grasp_maps, strict=True)
            ]
        )

    def _wait(self, last: np.ndarray, posterior: np.ndarray) -> None:
        super()._wait(last, posterior)
        posterior["runs"] = 0.0

    def _observe(
        self, balance: Balance, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        config, T = self._config, elapsed
        momentum = posterior["momentum"]
        squares = balance.inertia**2
        noise = self._velocity_variance * squares[:, 6:].sum(axis=1)
        noise += self._rate_variance * squares[:, :3].sum(axis=1)
        disturbance = T**2 * (self._wrench_variance @ balance.foot_jacobian**2)
        impulse = T * balance.remainder + balance.momentum_change
        augmented, healthy, fault = last["augmented"], last["healthy"], last["friction"]
        if not last["runs"]:
            start = momentum - balance.momentum_change
            known = augmented[3].any()
            variance = augmented[3] if known else np.full_like(start, config.uncertainty**2)
            augmented = np.stack([start, noise, 0.0 * start, variance])
            healthy = np.stack([start, noise])
        augmented, fault = with_fault(
            augmented, fault, momentum, impulse, (noise, disturbance, config.walk), T
        )
        healthy, innovation = without_fault(healthy, momentum, impulse, noise, disturbance)
        keep = math.exp(-T / config.window)
        evidence = keep * last["evidence"] + (1 - keep) * innovation
        told = is_fault(evidence, keep, self._threshold)
        posterior["augmented"], posterior["healthy"] = augmented, healthy
        posterior["friction"], posterior["friction_std"] = fault, np.sqrt(augmented[3])
        posterior["evidence"], posterior["runs"] = evidence, 1.0
        posterior["fault"] = told & (np.abs(fault) > config.smallest)


def _square(noise: float | None) -> float:
    """Variance of a noise that is believed; none of what nobody believes anything of."""
    return (noise or 0.0) ** 2


def is_fault(evidence: np.ndarray, keep: float, threshold: float) -> np.ndarray:
    """Is a weighted mean of innovations too large for white ones of variance 1?

    Args:
        evidence: m of m = keep m + (1 - keep) innovation, which has the variance
            (1 - keep) / (1 + keep), (n,).
        threshold: of a chi-square variable of one degree of freedom.
    """
    return evidence**2 * (1 + keep) / (1 - keep) > threshold


def with_fault(
    augmented: np.ndarray,
    fault: np.ndarray,
    momentum: np.ndarray,
    impulse: np.ndarray,
    noise: tuple[np.ndarray, np.ndarray, float],
    elapsed: float,
) -> tuple[np.ndarray, np.ndarray]:
    """One tick of the Kalman filters for momentum and fault of n joints.

    Args:
        augmented: see `ActuatorFaultObserver`, (4, n).
        fault: (n,) [Nm].
        momentum: measured where the tick ends, (n,) [Nm s].
        impulse: of all that is known over the tick, (n,) [Nm s].
        noise: variances of the measured momentum and of the impulse, (n,) each [(Nm s)^2], and the
            fault's walk [Nm/sqrt(s)].
        elapsed: length of the tick [s].

    Returns:
        Both anew.
    """
    p, pp, pu, uu = augmented
    measurement, disturbance, walk = noise
    p = p + impulse - elapsed * fault
    pp = pp - 2 * elapsed * pu + elapsed**2 * uu + disturbance
    pu, uu = pu - elapsed * uu, uu + walk**2 * elapsed
    S = pp + measurement
    to_p, to_u, innovation = pp / S, pu / S, momentum - p
    # pp - pp^2 / S, without the difference of large numbers.
    after = np.stack(
        [p + to_p * innovation, to_p * measurement, to_u * measurement, uu - to_u * pu]
    )
    return after, fault + to_u * innovation


def without_fault(
    healthy: np.ndarray,
    momentum: np.ndarray,
    impulse: np.ndarray,
    measurement: np.ndarray,
    disturbance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """One tick of the Kalman filters for the momentum of n joints that have no fault.

    Args:
        healthy: see `ActuatorFaultObserver`, (2, n); others as for `with_fault`.

    Returns:
        That anew, and the innovations over their standard deviations, (n,).
    """
    p, variance = healthy
    p, variance = p + impulse, variance + disturbance
    S = variance + measurement
    gain, innovation = variance / S, momentum - p
    after = np.stack([p + gain * innovation, gain * measurement])
    return after, innovation / np.sqrt(S)
