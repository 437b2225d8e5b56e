"""The model simulated against a log: the error that a user of the model would see."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from fbse_drake.discrepancy.residual.servo import scaled_gains, stretches
from fbse_drake.effects.sensor import ResolvedSensorEffect, SensorEffect, SensorSignals
from fbse_drake.errors import InputError, located, required
from fbse_drake.estimators.estimator import NoEstimator
from fbse_drake.log import Log
from fbse_drake.processes import Processes, Task
from fbse_drake.progress import Interrupted, Progress, silent
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import RobotConfig, Scenario, build_robot, planned_reference
from fbse_drake.signals import channels_of
from fbse_drake.simulation import add_record, base_motion, recorded_run
from fbse_drake.station import build_station
from fbse_drake.walking.reference import Recorded, RecordedReference, Reference
from fbse_drake.wiring import release

# Where velocities were not measured, that at the start of a stretch is the slope of a parabola
# through so many samples.
_STARTING_SAMPLES = 10
# A walk is simulated with two draws of the sensors' noise, and with a third if their errors differ
# by more than this share of the smaller, or of what they are compared with: now and then noise
# alone lets a foot land or a joint slip otherwise, and the rest of the walk is another. The median
# of three lies between any two of them.
_AGREEMENT = 0.1
_SIMULATING = "simulating the model against the log"


@dataclass(frozen=True)
class RolloutError:
    """How far the simulated model is from a log, root mean squares over the time that both have."""

    # By joint [rad], [rad/s], [Nm].
    position: dict[str, float]
    velocity: dict[str, float]
    torque_command: dict[str, float]
    # Simulated time [s], and why it ended early, or None.
    time: float
    failure: str | None
    # By joint: mean absolute error of the position [rad], and |simulated - recorded| / |recorded|
    # of it, 2-norms.
    mean_absolute_position: dict[str, float] = field(default_factory=dict)
    relative_position: dict[str, float] = field(default_factory=dict)
    # Error over time: N sample times [s], and simulated less recorded position (N, n) [rad].
    sample_time: np.ndarray = field(default_factory=lambda: np.zeros(0))
    position_error: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    # Of the simulated base at these times, where it floats: quaternions [w, x, y, z] to the world
    # (N, 4), and its place (N, 3) [m].
    base_orientation: np.ndarray | None = None
    base_position: np.ndarray | None = None

    @property
    def mean_position(self) -> float:
        """Root mean square over all joints [rad]."""
        return float(np.sqrt(np.mean(np.square(list(self.position.values())))))

    @property
    def mean_torque_command(self) -> float:
        """Root mean square over all joints [Nm]."""
        return float(np.sqrt(np.mean(np.square(list(self.torque_command.values())))))


def rollout(
    scenario: Scenario,
    log: Log,
    *,
    planned_with: RobotConfig | None = None,
    beside: RolloutError | None = None,
    progress: Progress = silent,
    jobs: int = 1,
) -> RolloutError | None:
    """Simulates the scenario's model, with all its effects, in the place of the robot and compares
    it with a log.

    Reference and controller are the scenario's, and so are estimator and compensation where there
    is one: what is compensated moves the robot. Sensor noise is drawn anew, twice, and a third time
    where the errors do not agree; their median is returned. A `!Recorded` reference is that of the
    log: the model starts where each stretch of the log starts, its sensors are exact, and its
    position loop gets what the robot's got. Played open loop, a recorded torque would say little:
    its errors add up, and what is not stable in itself falls.

    Args:
        beside: error of another model, which this one is to be compared with: what is small beside
            that need not agree more closely.
        progress: is told what is being done.
        jobs: how many simulations run side by side, each in a process of its own.
        planned_with: the model that reference and feed-forward were planned with, and that the
            estimator believed, when the log was made, which did not know what has been added since;
            by default the scenario's.

    Returns:
        None where nobody knows what the robot was asked for: the reference is `!Recorded`, but the
        log has no `reference/joint/position`.

    Raises:
        InputError: see `simulate`; or the log and the simulation share no time.
    """
    with Processes(jobs) as processes:
        begun = Rollouts(log, planned_with or scenario.believed, processes).begin(scenario)
        return None if begun is None else begun.result(progress, beside)


class Rollouts:
    """Models that are simulated against one log, each as by `rollout`, beside other work. The
    motion is planned once for all."""

    def __init__(self, log: Log, planned_with: RobotConfig, processes: Processes):
        """Nothing is simulated yet.

        Args:
            planned_with: see `rollout`.
            processes: where it is simulated.
        """
        self._log, self._planned_with, self._processes = log, planned_with, processes
        self._reference: Reference | None = None

    def begin(self, scenario: Scenario) -> "Rollout | None":
        """Begins to simulate a scenario's model; only models differ between scenarios.

        Returns:
            None where nobody knows what the robot was asked for.
        """
        log, processes = self._log, self._processes
        believed = _believed(scenario, self._planned_with)
        if isinstance(scenario.reference, Recorded):
            if "reference/joint/position" not in log:
                return None
            played = partial(_recorded_rollout, believed, scenario.reference, log)
            return Rollout((processes.begin(played),), None, processes)
        believed = replace(believed, duration=min(scenario.duration, float(log.time[-1])))
        if self._reference is None:
            self._reference = planned_reference(believed, build_robot(believed.believed))
        first, second, third = (
            partial(_simulated_error, replace(believed, seed=seed), log, self._reference)
            for seed in range(scenario.seed + 1, scenario.seed + 4)
        )
        return Rollout((processes.begin(first), processes.begin(second)), third, processes)


@dataclass(frozen=True)
class Rollout:
    """A model that is being simulated against a log."""

    # With each draw of the sensors' noise.
    draws: tuple[Task[RolloutError], ...]
    # With another one; None where there is nothing to draw.
    further: Callable[[Progress], RolloutError] | None
    processes: Processes

    def result(self, progress: Progress, beside: RolloutError | None = None) -> RolloutError:
        """Its error, when it is there; see `rollout`."""
        errors = self.processes.results(list(self.draws), progress, _SIMULATING)
        if self.further is None:
            return errors[0]
        first, second = errors
        if not _agree(first, second, 0.0 if beside is None else beside.mean_position):
            third = self.processes.begin(self.further)
            errors += self.processes.results([third], progress, _SIMULATING)
        # Of two that agree, the worse.
        return sorted(errors, key=lambda error: (error.failure is not None, error.mean_position))[1]


def _agree(error: RolloutError, other: RolloutError, beside: float) -> bool:
    """May either stand for the median of these and any third?

    Args:
        beside: error [rad] of another model, which they are compared with.
    """
    small, large = sorted([error.mean_position, other.mean_position])
    close = large - small <= _AGREEMENT * max(small, beside)
    return error.failure is None and other.failure is None and close


def _believed(scenario: Scenario, planned_with: RobotConfig) -> Scenario:
    """The scenario with its model in the robot's place; the rest believes what it believed.

    An estimate that nobody uses does not move the robot, and takes its time.
    """
    estimator = scenario.estimator if scenario.compensation.uses_estimate else NoEstimator()
    return replace(scenario, robot=scenario.believed, model=planned_with, estimator=estimator)


def _simulated_error(
    scenario: Scenario, log: Log, reference: Reference, progress: Progress
) -> RolloutError:
    """The error of a scenario's robot as it is simulated."""

    def tell(time: float) -> None:
        progress(_SIMULATING, time / scenario.duration)

    ports = (*_COMPARED_PORTS, "plant_state")
    with recorded_run(scenario, ports=ports, reference=reference, progress=tell) as run:
        if run.end.interrupted:
            raise Interrupted("it was interrupted")
        robot, time_step = run.station.robot, scenario.plant.time_step
        rows = np.arange(
            0, run.steps, round(required(scenario.log.period, "log.period") / time_step)
        )
        time = rows * time_step
        place = np.searchsorted(time, log.time - 1e-9)
        shared = (place < len(time)) & (
            np.abs(time[np.minimum(place, len(time) - 1)] - log.time) < 1e-6
        )
        if not shared.any():
            raise InputError("the log and the simulated model have no sample time in common")
        ticks = {port: values[rows[place[shared]]] for port, values in run.ticks.items()}
        base_orientation, base_position = base_motion(robot, ticks["plant_state"])
        channels: dict[str, np.ndarray] = {}
        for port in _COMPARED_PORTS:
            channels |= channels_of(port, ticks[port], len(robot.joint_names))
        there = {name: values for name, values in channels.items() if name in log}
        error = _rollout_error(log, shared, there, float(time[-1]), run.end.failure)
    return replace(error, base_orientation=base_orientation, base_position=base_position)


# Ports of a station whose channels are compared.
_COMPARED_PORTS = ("measured_joint_state", "torque_command")
_COMPARED = ("joint/position", "joint/velocity", "joint/torque_command")


def _rollout_error(
    log: Log,
    rows: np.ndarray,
    simulated: Mapping[str, np.ndarray],
    time: float,
    failure: str | None,
) -> RolloutError:
    """The error of what was simulated.

    Args:
        rows: which of the log's samples were simulated, (N,).
        simulated: channels at these samples.
    """

    def by_joint(values: np.ndarray) -> dict[str, float]:
        return dict(zip(log.joints, values.tolist(), strict=True))

    error = {name: values - log[name][rows] for name, values in simulated.items()}
    rms = [
        by_joint(np.sqrt((error[name] ** 2).mean(axis=0))) if name in error else {}
        for name in _COMPARED
    ]
    q = error["joint/position"]
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.linalg.norm(q, axis=0) / np.linalg.norm(log["joint/position"][rows], axis=0)
    position, velocity, torque_command = rms
    return RolloutError(
        position,
        velocity,
        torque_command,
        time,
        failure,
        by_joint(np.abs(q).mean(axis=0)),
        by_joint(relative),
        log.time[rows],
        q,
    )


def _recorded_rollout(
    scenario: Scenario, recorded: Recorded, log: Log, progress: Progress
) -> RolloutError:
    rows, channels, failure, simulated_time = np.zeros(len(log.time), dtype=bool), [], None, 0.0
    for stretch, constants in stretches(log):
        with located("control: "):
            control = scaled_gains(scenario.control, recorded, constants)
        done, failure = _simulate_stretch(replace(scenario, control=control), log.part(stretch))
        count = len(next(iter(done.values())))
        rows[stretch.start : stretch.start + count] = True
        channels.append(done)
        if count:
            simulated_time += float(log.time[stretch.start + count - 1] - log.time[stretch.start])
        progress(_SIMULATING, float(rows.mean()))
        if failure is not None:
            break
    names = [name for name in _COMPARED if name in log]
    return _rollout_error(
        log,
        rows,
        {name: np.concatenate([c[name] for c in channels]) for name in names},
        simulated_time,
        failure,
    )


def _simulate_stretch(scenario: Scenario, log: Log) -> tuple[dict[str, np.ndarray], str | None]:
    """The scenario's robot, which here is the model, in the log's place, from its first state on.

    Returns:
        What it did at the log's sample times, by channel; and why these are fewer than the log's,
        or None.
    """
    time_step, start = scenario.plant.time_step, float(log.time[0])
    duration = float(log.time[-1]) - start + time_step
    exact = replace(scenario, sensors=scenario.sensors.without_errors, duration=duration)
    builder = DiagramBuilder()
    station = builder.AddSystem(build_station(exact, reference=RecordedReference(log)))
    robot = station.robot
    sink = add_record(builder, station, _COMPARED_PORTS, time_step)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    resolved = scenario.robot.effects_of(SensorEffect, robot.description, key="model")
    effects = [effect for effect in resolved if isinstance(effect, ResolvedSensorEffect)]
    period = required(scenario.control.period, "control.period")
    state = _first_state(robot, effects, log, period)
    robot.set_state(robot.plant.GetMyMutableContextFromRoot(context), *state)

    failure = None
    try:
        simulator.AdvanceTo(duration)
    except RuntimeError as error:
        failure = (
            f"t = {start + context.get_time():.3f} s: the solver failed: "
            f"{str(error).splitlines()[0]}"
        )
    found = sink.FindLog(context)
    time, rows = found.sample_times(), found.data().T
    finite = np.logical_and.accumulate(np.isfinite(rows).all(axis=1))
    if failure is None and not finite.all():
        failure = f"t = {start + time[finite.argmin()]:.3f} s: the state is not finite any more"
    time, rows = time[finite], rows[finite]
    wanted = (log.time - start)[log.time - start <= time[-1] + 1e-9]
    # Motion between the steps, and the command of the step that a sample is in.
    n = len(robot.joint_names)
    motion = np.stack([np.interp(wanted, time, column) for column in rows[:, : 2 * n].T], axis=1)
    command = rows[np.clip(np.searchsorted(time, wanted + 1e-9) - 1, 0, None), 2 * n :]
    channels = channels_of("measured_joint_state", motion, n)
    release(diagram)
    return channels | channels_of("torque_command", command, n), failure


def _first_state(
    robot: Robot,
    effects: Sequence[ResolvedSensorEffect],
    log: Log,
    period: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions and velocities with which a stretch starts, (n,) each, without what the
    model's sensors add."""
    few = slice(0, _STARTING_SAMPLES)
    q = log["joint/position"][0]
    v = (
        log["joint/velocity"][0]
        if "joint/velocity" in log
        else np.polyfit(log.time[few] - log.time[0], log["joint/position"][few], 2)[1]
    )
    points = sum(leg.points for leg in robot.description.legs.values())
    signals = SensorSignals(
        q[None],
        v[None],
        np.zeros((1, 3)),
        np.zeros((1, 3)),
        np.zeros((1, points, 3)),
        np.zeros_like(q)[None],
        log.get("joint/motor_position", np.zeros((1, 0)))[:1],
        *np.zeros((2, 1, len(q))),
    )
    for effect in reversed(effects):
        memory = np.zeros((effect.effect.memory_size, 1, len(effect.targets)))
        signals = effect.effect.undone(signals, memory, effect, robot, period)
    return signals.joint_position[0], signals.joint_velocity[0]
