"""What an estimator of the friction is, and the library of all of them.

An estimator is one class in one file: a frozen dataclass with its settings (what a scenario file
says of it), which adds the systems that estimate to a chain. Behind `@in_library` a scenario file
can name it:

    estimator: !TorqueSensor {cutoff: 10}

An estimator of a user's own is such a class in a module that the scenario names
(`effect_modules`).
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeVar

from pydrake.systems.framework import Diagram

from fbse_drake.effects.joint_torque import ResolvedJointTorque
from fbse_drake.effects.sensor import ResolvedSensorEffect
from fbse_drake.errors import located
from fbse_drake.estimators.beliefs import USUAL_SENSORS, SensorBeliefs
from fbse_drake.estimators.chain import Chain, Workshop
from fbse_drake.estimators.recursive import Clock
from fbse_drake.library import require_new
from fbse_drake.log import Log
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot
from fbse_drake.signals import Signal, register
from fbse_drake.walking.plan import TaskPlan


@dataclass(frozen=True)
class Estimator(ABC):
    """Base of the estimators: a frozen dataclass with their settings."""

    # Rows of the table of signals for fields of its systems that it does not have yet, see
    # `fbse_drake.signals.estimated`.
    signals: ClassVar[tuple[Signal, ...]] = ()
    # Does it estimate the friction, which can then be compensated?
    gives_friction: ClassVar[bool] = True
    # For the reader of a comparison: what it must know of the robot, and what must be measured
    # beside the joints' motion and their commanded torques.
    knows: ClassVar[str] = ""
    measures: ClassVar[str] = ""
    # Settings that are tuned for a robot before methods are compared: the range of each, which is
    # searched evenly on a logarithmic scale.
    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {}

    @staticmethod
    def alternatives() -> tuple[type["Estimator"], ...]:
        """What can stand for an estimator in a scenario file (see `fbse_drake.schema`)."""
        return tuple(_LIBRARY.values())

    @classmethod
    def variants(cls) -> dict[str, "Estimator"]:
        """What of it is compared with others, by a word for it; by default itself."""
        return {"": cls()} if cls.gives_friction else {}

    def identified(self, log: Log) -> "Estimator":  # noqa: ARG002
        """Itself, with what it learns beforehand from a log that has FBSE's estimates."""
        return self

    @abstractmethod
    def add(self, chain: Chain) -> None:
        """Adds its systems.

        Raises:
            InputError: it does not fit the robot.
        """

    def believed_sensors(self, usual: SensorBeliefs) -> SensorBeliefs:
        """What it believes of its sensors, what it is not told as usual."""
        return SensorBeliefs().completed(usual)

    def remarks(self, sensors: SensorBeliefs) -> tuple[str, ...]:  # noqa: ARG002
        """What the reader of a log that it ran over should know of it."""
        return ()

    def check(self, names: RobotDescription) -> None:  # noqa: B027
        """Raises InputError for values of joints that a robot has not."""

    def check_sensors(self, ports: Collection[str]) -> None:  # noqa: B027
        """Raises InputError if it needs sensors beside those that give these ports."""


_LIBRARY: dict[str, type[Estimator]] = {}

T = TypeVar("T", bound=type[Estimator])


def in_library(estimator: T) -> T:
    """Class decorator: puts an estimator into the library and its signals into the table.

    Raises:
        InputError: it lacks a method, or there is another estimator, port or channel of one of its
            names.
    """
    require_new(_LIBRARY, "estimator", estimator)
    with located(f"estimator {estimator.__name__}: "):
        register(*estimator.signals)
    _LIBRARY[estimator.__name__] = estimator
    return estimator


def library() -> dict[str, type[Estimator]]:
    """All estimators by class name."""
    return dict(_LIBRARY)


@in_library
@dataclass(frozen=True)
class NoEstimator(Estimator):
    """Nobody knows the friction; the estimate is zero."""

    gives_friction: ClassVar[bool] = False

    def add(self, chain: Chain) -> None:
        pass


class EstimatorDiagram(Diagram):
    """A friction estimator; made by `make_estimator`.

    .. pydrake_system::

        name: EstimatorDiagram
        input_ports:
        - measured_joint_state
        - measured_imu
        - measured_pad_force
        - torque_command
        output_ports:
        - friction_estimate
        - (one for each channel)
        - friction_estimate_1
        - (one for each further chain)

    Inputs are the signals that the estimator needs: `TorqueSensor` has `measured_torque` besides,
    `TrueFriction` `torque_loss`. `friction_estimate` (n,) [Nm] is that of the tick that ends now.
    The other outputs are named like the log channels they become, see `channels`. An `Fbse` that is
    not told the torque commands has neither `torque_command` nor `friction_estimate`.

    Further chains estimate side by side with the first, and what several have in common is done
    once. Ports and systems of the second are called as those of the first, with `_1`.
    """

    # Log channels, which are also names of output ports, and the shape of one sample.
    channels: dict[str, tuple[int, ...]]
    # Whether it estimates the friction.
    knows_friction: bool
    # Names of the ports that tell the friction, one for each chain that knows it.
    friction_ports: list[str]

    def __init__(self, chain: Chain, *further: Chain):
        """Takes over the systems of chains of one workshop."""
        super().__init__()
        self.channels, self.knows_friction = chain.finish(), chain.knows_friction
        for other in further:
            other.finish()
        self.friction_ports = [of.friction_port for of in (chain, *further) if of.knows_friction]
        chain.builder.BuildInto(self)


def make_estimator(
    config: Estimator,
    robot: Robot,
    *,
    period: float,
    plan: TaskPlan | None = None,
    every_sample: bool = False,
    control: float | None = None,
    reading: float | None = None,
    sensors: SensorBeliefs = USUAL_SENSORS,
    sensor_effects: Sequence[ResolvedSensorEffect] = (),
    torque_effects: Sequence[ResolvedJointTorque] = (),
    knows_torque: bool = True,
    beside: Sequence[Estimator] = (),
) -> EstimatorDiagram | None:
    """Builds a friction estimator, or None where there is nothing to it (`NoEstimator`).

    Args:
        robot: the model that is believed.
        period: tick [s].
        plan: for the planned support, and for where the feet stand at the start.
        every_sample: every evaluation at a later time is a tick, whatever the period; for recorded
            logs.
        control: how often the commands may change [s], by default with each tick.
        reading: what a reading of accelerometer or foot force is the mean over [s], 0 for a sample;
            by default the tick.
        sensors: what is believed of them where the config says nothing.
        sensor_effects: what is known to be in their readings, in the order in which it came; it is
            taken off them.
        torque_effects: what the model takes of the joints' torques; an `Fbse` that finds its law
            through the whole body learns what is left beside it.
        knows_torque: the torque commands are known; without them an `Fbse` estimates no friction.
        beside: further ones, see `EstimatorDiagram`.

    Raises:
        InputError: an estimator that does not fit the robot.
    """
    shortest = 1e-9 if every_sample else period * (1 - 1e-6)
    clock = Clock(period, shortest, period if reading is None else reading, control)
    workshop, chains = Workshop(), list[Chain]()
    if sensor_effects:
        workshop.correct(sensor_effects, robot, clock, knows_torque=knows_torque)
    for one in (config, *beside):
        believed = one.believed_sensors(sensors)
        chain = Chain(
            robot,
            clock,
            believed,
            plan,
            knows_torque=knows_torque,
            torque_effects=torque_effects,
            workshop=workshop,
        )
        one.add(chain)
        chains.append(chain)
    return None if chains[0].is_empty else EstimatorDiagram(*chains)
