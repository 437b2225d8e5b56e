"""What the controller makes of a friction estimate (paper Sec. 7.4), and the library of it.

A compensation is a frozen dataclass with its settings, which makes the system that compensates.
Behind `@in_library` a scenario file can name it:

    compensation: !FeedforwardCompensation {share: 0.8}

One of a user's own is such a class in a module that the scenario names (`effect_modules`).
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, TypeVar

import numpy as np
from pydrake.systems.framework import Context, System

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.library import require_new
from fbse_drake.robot.description import RobotDescription


class LowPass(NamedTuple):
    """What a compensation makes of the estimate: its share through a low-pass, within limits."""

    # Bandwidth of each joint, shape (n,) [rad/s].
    rate: np.ndarray
    share: float
    # Largest torque in either direction [Nm].
    limit: float


@dataclass(frozen=True)
class Compensation(ABC):
    """Base of the compensations: a frozen dataclass with their settings."""

    uses_estimate: ClassVar[bool] = True

    @staticmethod
    def alternatives() -> tuple[type["Compensation"], ...]:
        """What can stand for a compensation in a scenario file (see `fbse_drake.schema`)."""
        return tuple(_LIBRARY.values())

    @abstractmethod
    def system(self, names: RobotDescription, clock: Clock) -> System | None:
        """The system that compensates, if any.

        Its output port `torque` (n,) [Nm] is added to the command. Its input ports are named like
        the station's ports, of which it takes what it needs: `friction_estimate` (n,) [Nm] and
        others, see `fbse_drake.station.Station`.

        Raises:
            InputError: see `check`.
        """

    def check(self, names: RobotDescription) -> None:  # noqa: B027
        """Raises InputError for an unknown joint, or one without a value that it needs."""


_LIBRARY: dict[str, type[Compensation]] = {}

T = TypeVar("T", bound=type[Compensation])


def in_library(compensation: T) -> T:
    """Class decorator: puts a compensation into the library.

    Raises:
        InputError: it lacks a method, or there is another compensation of its name.
    """
    require_new(_LIBRARY, "compensation", compensation)
    _LIBRARY[compensation.__name__] = compensation
    return compensation


def library() -> dict[str, type[Compensation]]:
    """All compensations by class name."""
    return dict(_LIBRARY)


@in_library
@dataclass(frozen=True)
class NoCompensation(Compensation):
    """The estimate is only watched."""

    uses_estimate: ClassVar[bool] = False

    def system(self, names: RobotDescription, clock: Clock) -> None:
        """None."""


@dataclass(frozen=True)
class LowPassCompensation(Compensation):
    """Base of those that pass the estimate on through a low-pass of first order for each joint."""

    @abstractmethod
    def low_pass(self, names: RobotDescription) -> LowPass:
        """Raises InputError, see `check`."""

    def check(self, names: RobotDescription) -> None:
        self.low_pass(names)

    def system(self, names: RobotDescription, clock: Clock) -> "FrictionCompensation":
        return FrictionCompensation(self, names, clock)


@in_library
@dataclass(frozen=True)
class IntegralCompensation(LowPassCompensation):
    """The paper's integral law (69), read as tau_tor_dot = k_i (u_F - tau_tor).

    That is the estimate through a low-pass of bandwidth k_i.
    """

    # Integral gain by joint [rad/s]; the paper has 1 in the hip pitch, 4 in the ankle roll and 2
    # elsewhere.
    gain: dict[str, float] = field(default_factory=lambda: {"all": 2.0})

    def __post_init__(self) -> None:
        for joint, value in self.gain.items():
            if value < 0:
                raise InputError(f"gain.{joint}: expected a number >= 0, found {value:g}")

    def low_pass(self, names: RobotDescription) -> LowPass:
        return LowPass(names.per_joint(self.gain, key="gain"), 1.0, math.inf)


@in_library
@dataclass(frozen=True)
class FeedforwardCompensation(LowPassCompensation):
    """The estimate, low-passed and limited, is added to the command."""

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
        rate = np.full(len(names.joint_names), 2 * math.pi * self.cutoff)
        return LowPass(rate, self.share, self.limit)


@in_library
@dataclass(frozen=True)
class FaultReconfiguration(FeedforwardCompensation):
    """The control is reconfigured where an actuator is called faulty: only there the estimate is
    added to the command. Needs an estimator that isolates faults (`!ActuatorFault`)."""

    def system(self, names: RobotDescription, clock: Clock) -> "FaultCompensation":
        return FaultCompensation(self, names, clock)


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

    def __init__(self, config: LowPassCompensation, names: RobotDescription, clock: Clock):
        """Raises InputError for an unknown joint, or one without a gain."""
        n = len(names.joint_names)
        super().__init__(record_type(time=(), torque=(n,)), clock)
        self._rate, self._share, self._limit = config.low_pass(names)
        self._estimate = self.DeclareVectorInputPort("friction_estimate", n)
        self._declare_posterior()

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
        wanted = np.maximum(self._share * self._lost(context), -self._limit)
        wanted = np.minimum(wanted, self._limit)
        keep = np.exp(-self._rate * elapsed)
        posterior["torque"] = keep * last["torque"] + (1 - keep) * wanted

    def _lost(self, context: Context) -> np.ndarray:
        """What is to be compensated, (n,) [Nm]."""
        return np.asarray(self._estimate.Eval(context))


class FaultCompensation(FrictionCompensation):
    """Torque that compensates what faulty actuators lose.

    .. pydrake_system::

        name: FaultCompensation
        input_ports:
        - friction_estimate
        - estimate/joint/fault
        output_ports:
        - posterior
        - (one for each field)

    As `FrictionCompensation`; `estimate/joint/fault` (n,) is 1 where a joint is called faulty.
    """

    def __init__(self, config: LowPassCompensation, names: RobotDescription, clock: Clock):
        """See `FrictionCompensation`."""
        super().__init__(config, names, clock)
        size = len(names.joint_names)
        self._fault = self.DeclareVectorInputPort("estimate/joint/fault", size)

    def _lost(self, context: Context) -> np.ndarray:
        return super()._lost(context) * self._fault.Eval(context)
