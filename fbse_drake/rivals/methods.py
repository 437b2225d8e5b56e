"""Methods that are compared, and how they are tuned: each in as many trials, on another walk."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.common.yaml import yaml_load
from scipy.stats import qmc

from fbse_drake import schema
from fbse_drake.errors import InputError
from fbse_drake.estimation import friction_estimates
from fbse_drake.estimators.estimator import Estimator, library, make_estimator
from fbse_drake.log import Log
from fbse_drake.report.metrics import friction_nrmse
from fbse_drake.scenario import Scenario, build_robot, task_plan
from fbse_drake.sensors.joint_torque import JointTorqueConfig
from fbse_drake.walking.walk import Walk
from fbse_drake.wiring import release

# The method that the others are compared with.
OURS = "!Fbse"
# Figures count from here on, so that nobody's start is compared [s].
START = 1.0
# Noise of joint torque sensors where a scenario has none [Nm].
_TORQUE_NOISE = 0.3
# The walk that is tuned on: another seed, and steps shorter and faster by these factors; no longer
# than this [s].
_SEED = 1000
_STEP_LENGTH, _STEP_TIME = 0.6, 0.8
_LONGEST = 5.0


@dataclass(frozen=True)
class Method:
    """An estimator in the comparison."""

    estimator: Estimator
    # What of it, if there is more than one; see `Estimator.variants`.
    variant: str = ""

    @property
    def name(self) -> str:
        """As `!TorqueSensor`: its tag in a scenario, and the variant."""
        return ", ".join(filter(None, (f"!{type(self.estimator).__name__}", self.variant)))

    @property
    def text(self) -> str:
        """YAML that `read` makes it of."""
        return schema.dump(self)

    @staticmethod
    def read(text: str) -> "Method":
        """The method of a YAML text."""
        return schema.build(Method, yaml_load(data=text), file="method")


def candidates() -> Iterator[Method]:
    """All that estimate friction, those of the user's own among them."""
    for kind in library().values():
        for variant, estimator in kind.variants().items():
            yield Method(estimator, variant)


def methods(scenario: Scenario) -> tuple[list[Method], dict[str, str]]:
    """Methods that can be run in a scenario; and why not, of the others, by name.

    Raises:
        InputError: FBSE is none of them.
    """
    scenario = measured(scenario)
    robot = build_robot(scenario.believed)
    period = scenario.control.period or scenario.usual_period
    plan = task_plan(replace(scenario, duration=2 * period), robot)
    sensors = scenario.sensors.by_name.values()
    ports = [port for sensor in sensors for port in sensor.ports()]
    found, unfit = [], {}
    for method in candidates():
        try:
            method.estimator.check_sensors(ports)
            made = make_estimator(method.estimator, robot, period=period, plan=plan)
        except InputError as error:
            unfit[method.name] = str(error)
        else:
            found.append(method)
            if made is not None:
                release(made)
    if OURS in unfit:
        raise InputError(f"nothing to compare: {OURS}: {unfit[OURS]}")
    return found, unfit


def measured(scenario: Scenario) -> Scenario:
    """The scenario with joint torque sensors, for the method that has nothing else."""
    if scenario.sensors.joint_torque is not None:
        return scenario
    sensors = replace(
        scenario.sensors,
        joint_torque=JointTorqueConfig(noise=_TORQUE_NOISE, period=scenario.control.period),
    )
    return replace(scenario, sensors=sensors)


def tuning_walk(scenario: Scenario) -> Scenario:
    """The walk that methods are tuned on, which is none of those that they are compared on."""
    reference = scenario.reference
    if isinstance(reference, Walk):
        reference = replace(
            reference,
            step_length=_STEP_LENGTH * reference.step_length,
            single_support=_STEP_TIME * reference.single_support,
            double_support=_STEP_TIME * reference.double_support,
        )
    duration = min(scenario.duration, _LONGEST)
    return replace(scenario, reference=reference, seed=_SEED, duration=duration)


def trials(estimator: Estimator, count: int) -> Iterator[Estimator]:
    """What is tried: the settings as they are, then points of a Halton sequence over the logarithms
    of what is tunable, `count` in all; of what has nothing to tune only itself."""
    yield estimator
    ranges = estimator.tunable
    if not ranges:
        return
    sequence = qmc.Halton(len(ranges), scramble=False).fast_forward(1)
    low, high = np.log(list(ranges.values())).T
    for point in np.exp(low + sequence.random(count - 1) * (high - low)):
        # Three digits say all that so few trials know.
        settings = (float(f"{value:.3g}") for value in point)
        yield replace(estimator, **dict(zip(ranges, settings, strict=True)))


@dataclass(frozen=True)
class Tuned:
    """A method with the settings that were best on the tuning walk."""

    method: Method
    # How many were tried.
    trials: int
    # Score of the settings as they were, and of the best; see `score`.
    before: float
    after: float


def tune(method: Method, scenario: Scenario, log: Log, count: int) -> Tuned:
    """Tunes a method on a log.

    Args:
        log: of the tuning walk, with FBSE's estimates.
        count: trials.
    """
    tried = list(trials(method.estimator.identified(log), count))
    scores = [score(estimated) for estimated in with_friction(scenario, tried, log)]
    best = int(np.argmin(scores))
    return Tuned(replace(method, estimator=tried[best]), len(tried), scores[0], scores[best])


def with_friction(scenario: Scenario, estimators: Sequence[Estimator], log: Log) -> Iterator[Log]:
    """The log with the friction that each of several estimators tells."""
    for friction in friction_estimates(scenario, estimators, log):
        yield Log(log.channels | {"estimate/joint/friction_torque": friction}, log.meta)


def score(log: Log) -> float:
    """Geometric mean of the friction's NRMSE over joints and phases, so that each joint counts."""
    nrmse = friction_nrmse(counted(log))
    values = [value for phase in nrmse.values() for value in phase.values() if value > 0]
    return math.exp(np.mean(np.log(values)))


def counted(log: Log) -> Log:
    """The part of a log that figures count."""
    return log.part(slice(int(np.searchsorted(log.time, START - 1e-6)), None))
