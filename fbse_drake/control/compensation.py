"""What the controller makes of a friction estimate (paper Sec. 7.4)."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.robot.description import RobotDescription


class LowPass(NamedTuple):
    """What a compensation makes of the estimate: its share through a low-pass, within limits."""

    # Bandwidth of each joint, shape (n,) [rad/s].
    rate: np.ndarray
    share: float
    # Largest torque in either direction [Nm].
    limit: float


@dataclass(frozen=True)
class NoCompensation:
    """The estimate is only watched."""

    uses_estimate: ClassVar[bool] = False


@dataclass(frozen=True)
class IntegralCompensation:
    """The paper's integral law (69), read as tau_tor_dot = k_i (u_F - tau_tor).

    That is the estimate through a low-pass of bandwidth k_i.
    """

    uses_estimate: ClassVar[bool] = True

    # Integral gain by joint [rad/s]; the paper has 1 in the hip pitch, 4 in the ankle roll and 2
    # elsewhere.
    gain: dict[str, float] = field(default_factory=lambda: {"all": 2.0})

    def __post_init__(self) -> None:
        for joint, value in self.gain.items():
            if value < 0:
                raise InputError(f"gain.{joint}: expected a number >= 0, found {value:g}")

    def low_pass(self, names: RobotDescription) -> LowPass:
        """Raises InputError for an unknown joint, or one without a gain."""
        return LowPass(names.per_joint(self.gain, key="compensation.gain"), 1.0, math.inf)


@dataclass(frozen=True)
class FeedforwardCompensation:
    """The estimate, low-passed and limited, is added to the command."""

    uses_estimate: ClassVar[bool] = True

    # Cut-off of the low-pass of first order [Hz].
    cutoff: float = 20.0
    # Share of the estimate that is compensated. Friction also damps; all of it is only cancelled
    # where the position loop damps by itself.
    share: float = 1.0
    # Largest torque in either direction [Nm].
    limit: float = 50.0

    def __post_init__(self) -> None:
        require_positive(self, "cutoff", "limit")
        if not 0 <= self.share <= 1:
            raise InputError(f"share: expected a number in [0, 1], found {self.share:g}")

    def low_pass(self, names: RobotDescription) -> LowPass:
        """The same for all joints."""
        rate = np.full(len(names.joint_names), 2 * math.pi * self.cutoff)
        return LowPass(rate, self.share, self.limit)


CompensationConfig = NoCompensation | IntegralCompensation | FeedforwardCompensation


class FrictionCompensation(RecursiveEstimator):
    """Torque that compensates an estimated friction.

    It is the estimate through a low-pass of first order for each joint.

    .. pydrake_system::

        name: FrictionCompensation
        input_ports:
        - friction_estimate
        output_ports:
        - posterior
        - (one for each field)

    `friction_estimate` (n,) [Nm]; field `torque` (n,) [Nm] is what is added to the command. (It has
    no status.)
    """

    def __init__(
        self,
        config: IntegralCompensation | FeedforwardCompensation,
        names: RobotDescription,
        clock: Clock,
    ):
        """Raises InputError for an unknown joint, or one without a gain."""
        n = len(names.joint_names)
        super().__init__(record_type(time=(), torque=(n,)), clock)
        self._rate, self._share, self._limit = config.low_pass(names)
        self._estimate = self.DeclareVectorInputPort("friction_estimate", n)
        self._declare_posterior("friction_estimate")

    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        if math.isnan(elapsed):
            posterior[...] = last
            return
        wanted = np.maximum(self._share * self._estimate.Eval(context), -self._limit)
        wanted = np.minimum(wanted, self._limit)
        keep = np.exp(-self._rate * elapsed)
        posterior["torque"] = keep * last["torque"] + (1 - keep) * wanted
