"""Runs a scenario's estimator over a recorded log."""

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from fbse_drake.effects.effect import spaced
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.effects.sensor import SensorEffect
from fbse_drake.errors import InputError, located, required
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.estimator import Estimator, make_estimator
from fbse_drake.estimators.recursive import RecursiveEstimator, start_share
from fbse_drake.held_readings import rows_of_readings
from fbse_drake.log import Log, require_log
from fbse_drake.results import RunResult
from fbse_drake.robot.plant import Robot
from fbse_drake.sampling import output_views, state_views
from fbse_drake.scenario import Scenario, build_robot, dump_scenario, require_scenario, task_plan
from fbse_drake.sensors.encoders import differentiated_noise
from fbse_drake.signals import port_values, signals_of
from fbse_drake.wiring import release

# Samples of a log are apart by its period, but for gaps and stamps that scatter: by a factor.
_SAME_PERIOD = 1.5


@dataclass(frozen=True, eq=False)
class EstimationResult(RunResult):
    """A log with the estimates in its `estimate/...` channels, and the time that each tick
    took [s]."""

    log: Log
    tick_time: np.ndarray
    # For the reader: what the sensors are believed to be, what was found of them, and what could
    # not be estimated.
    remarks: tuple[str, ...]
    scenario: Scenario
    name: str

    def _metrics(self) -> dict[str, Any]:
        from fbse_drake.report.metrics import run_metrics

        metrics = run_metrics(self.log, float(self.tick_time.sum()), self.tick_time)
        return metrics | {"remarks": list(self.remarks)}


def estimate(
    scenario: Scenario,
    log: Log,
    *,
    name: str = "scenario",
    progress: Callable[[float], None] | None = None,
) -> EstimationResult:
    """Runs the scenario's estimator over a log, sample by sample, with the very LeafSystems that
    run in the station.

    Only sensor channels are used; `time` is what the log says, so samples may be missing or late.
    Where joints or feet are read more seldom than the log has rows, and held in between, the
    estimator ticks when they are read: with held readings it would compare what was not at the same
    time.
    On the log of a simulation with the same scenario the estimates are those of the simulation.
    Without `joint/velocity` the angles are differentiated and smoothed. Without
    `joint/torque_command` an `Fbse` estimates all but the friction.

    Args:
        name: what the scenario is called in the log.
        progress: called with the log's time [s] as the work goes on.

    Raises:
        InputError: no estimator in the scenario, a log that lacks a channel, other joints or feet
            than the model's.
    """
    require_scenario(scenario)
    require_log(log)
    replay = Replay(scenario, log)
    values, tick_time = replay.run(progress)
    remarks = replay.remarks + replay.findings()
    release(replay.estimator)
    kept = {
        name: channel for name, channel in log.channels.items() if not name.startswith("estimate/")
    }
    meta = log.meta | {"estimator_scenario": dump_scenario(scenario, name)}
    estimated = Log(kept | values, meta)
    return EstimationResult(estimated, tick_time, remarks, scenario, name)


def friction_estimates(
    scenario: Scenario, estimators: Sequence[Estimator], log: Log
) -> list[np.ndarray]:
    """Friction that several estimators tell over one log, (N, n) each [Nm].

    Each is what `estimate` gives for it alone; but what they have in common is done once.

    Raises:
        InputError: see `estimate`; or one of them estimates no friction.
    """
    first, *beside = estimators
    replay = Replay(replace(scenario, estimator=first), log, beside)
    ports = replay.estimator.friction_ports
    if len(ports) < len(estimators):
        raise InputError("estimator: expected estimators of the friction only")
    frictions = replay.frictions()
    release(replay.estimator)
    return frictions


def _inputs(
    scenario: Scenario, robot: Robot, log: Log, ticks: np.ndarray, at_ticks: Log
) -> dict[str, np.ndarray]:
    """What a station's ports told at some rows of a log, (ticks, size) each, if the log says it; a
    torque command is the mean over the tick that begins there.

    Args:
        ticks, at_ticks: these rows, and the log of them alone.
    """
    if log.joints != robot.joint_names:
        raise InputError(f"the log's joints {log.joints} are not the model's {robot.joint_names}")
    inputs = {}
    if (torque := port_values("torque_command", log)) is not None:
        torque = _torque_over_rows(scenario, log, torque)
        inputs["torque_command"] = _mean_over_ticks(log.time, torque, ticks)
    if (loss := port_values("torque_loss", at_ticks)) is not None:
        inputs["torque_loss"] = loss
    for sensor in scenario.sensors.by_name.values():
        inputs |= sensor.readings(robot, at_ticks)
    return inputs


def _reading_time(scenario: Scenario, log: Log) -> float:
    """What a log's reading of accelerometer or foot force is the mean over [s]."""
    if scenario.recording.is_sampled:
        return 0.0
    said = log.meta.get("reading_time")
    return scenario.plant.time_step if said is None else said


def _torque_over_rows(scenario: Scenario, log: Log, torque: np.ndarray) -> np.ndarray:
    """Mean of the torque commands from each of a log's rows to the next, (N, n) [Nm].

    A log that is slower than the control has only samples of what changed in between.
    """
    held = log.meta.get("command_time")
    if held is None:
        held = required(scenario.control.period, "control.period")
    share = start_share(float(log.meta["period"]), held)
    after = np.concatenate([torque[1:], torque[-1:]])
    return torque + share * (after - torque)


def _mean_over_ticks(time: np.ndarray, values: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Mean of values (N, n), each held from its `time` [s] to the next, from each tick to the next.

    Args:
        ticks: the rows in which they begin.
    """
    if len(ticks) == len(time):
        return values
    held = np.diff(time, append=2 * time[-1] - time[-2])
    total = np.add.reduceat(held[:, None] * values, ticks)
    return total / np.add.reduceat(held, ticks)[:, None]


def _believed_sensors(scenario: Scenario, log: Log) -> SensorBeliefs:
    """As `Scenario.believed_sensors`; velocities that the log lacks are differentiated."""
    sensors = scenario.sensors
    if "joint/velocity" not in log:
        noise = differentiated_noise(sensors.encoders.angle_noise, float(log.meta["period"]))
        encoders = replace(sensors.encoders, velocity="exact", velocity_noise=noise)
        scenario = replace(scenario, sensors=replace(sensors, encoders=encoders))
        return replace(scenario.believed_sensors, joint_velocity_derived=True)
    return scenario.believed_sensors


def _require_period(log: Log) -> None:
    """
    Raises:
        InputError: most samples are further apart, or closer together, than the log says.
    """
    if len(log.time) < 2:
        return
    said, found = float(log.meta["period"]), float(np.median(np.diff(log.time)))
    if not 1 / _SAME_PERIOD < found / said < _SAME_PERIOD:
        raise InputError(
            f"meta.period: the log says {said:.4g} s, but most of its samples are {found:.4g} s "
            "apart (`Log.part` keeps the two together)"
        )


def _ticks(log: Log) -> tuple[str | None, np.ndarray]:
    """The channel of joints or feet that is read most seldom, if one is not read in every row, and
    the rows in which it is. (The base moves so slowly that an IMU may be late.)"""
    slowest, ticks = None, np.arange(len(log.time))
    for name in log.channels:
        if name.startswith(("joint/position", "joint/velocity", "foot/")):
            rows = rows_of_readings(log[name])
            if len(rows) < len(ticks):
                slowest, ticks = name, rows
    return slowest, ticks


class Replay:
    """A scenario's estimator and a log that it runs over; see `estimate`."""

    def __init__(self, scenario: Scenario, log: Log, beside: Sequence[Estimator] = ()):
        """Builds the estimator, and others that run beside it, see `EstimatorDiagram`."""
        with located("model: "):
            robot = build_robot(scenario.believed)
        _require_period(log)
        slowest, ticks = _ticks(log)
        # The tick that each row of the log tells of.
        self._tick_of_row = np.searchsorted(ticks[1:], np.arange(len(log.time)), side="right")
        at_ticks = log if slowest is None else log.part(ticks)
        inputs = _inputs(scenario, robot, log, ticks, at_ticks)
        log = at_ticks
        sensors, knows_torque = _believed_sensors(scenario, log), "torque_command" in inputs
        believed = partial(scenario.believed.effects_of, names=robot.description, key="model")
        in_sensors = believed(SensorEffect)
        estimator = make_estimator(
            scenario.estimator,
            robot,
            period=float(log.meta["period"]),
            plan=task_plan(scenario, robot),
            every_sample=True,
            reading=_reading_time(scenario, log),
            sensors=sensors,
            sensor_effects=in_sensors,
            torque_effects=believed(JointTorqueEffect),
            knows_torque=knows_torque,
            beside=beside,
        )
        if estimator is None:
            raise InputError("estimator: the scenario has none (estimator: !Fbse {})")
        for i in range(estimator.num_input_ports()):
            name = estimator.get_input_port(i).get_name()
            if name not in inputs:
                channels = ", ".join(signal.text for signal in signals_of(name))
                where = f"the estimator's input {name} ({channels})"
                raise InputError(f"the log has no channel for {where}")
        self.estimator, self.time = estimator, log.time
        self.remarks = scenario.estimator.remarks(sensors)
        if slowest is not None:
            self.remarks += (
                f"{slowest} is read every {1e3 * log.meta['period']:.3g} ms: so often the "
                "estimator ticks, and its estimates are held in between.",
            )
        if in_sensors:
            names = ", ".join(spaced(effect.effect.__name__).lower() for effect in in_sensors)
            self.remarks += (f"Taken off the readings, as the model has it: {names}.",)
        if scenario.estimator.gives_friction and not estimator.knows_friction:
            self.remarks += ("The friction is not known: the log has no joint/torque_command.",)
        self.context = estimator.CreateDefaultContext()
        # Takes the update of every tick.
        self._next_context = estimator.CreateDefaultContext()
        self._next = self._next_context.get_mutable_state()
        self._next_values = self._next_context.get_discrete_state()
        self._sources = []
        for i in range(estimator.num_input_ports()):
            port = estimator.get_input_port(i)
            self._sources.append(
                (port.FixValue(self.context, inputs[port.get_name()][0]), inputs[port.get_name()])
            )
        self._views = [
            *state_views(estimator, self.context),
            *state_views(estimator, self._next_context),
            *output_views(estimator, self.context),
        ]

    def feed(self, sample: int) -> None:
        """Sets time and inputs to a sample of the log."""
        self.context.SetTime(self.time[sample])
        for fixed, samples in self._sources:
            fixed.GetMutableData().get_mutable_value().SetFromVector(samples[sample])

    def update(self) -> None:
        """Lets the estimators remember the tick. (`ExecuteForcedEvents` does so too, but allocates
        two states.)"""
        self.estimator.CalcForcedUnrestrictedUpdate(self.context, self._next)
        self.context.SetDiscreteState(self._next_values)

    def findings(self) -> tuple[str, ...]:
        """For the reader: what the estimators have found out of the sensors by now."""
        systems = [s for s in self.estimator.GetSystems() if isinstance(s, RecursiveEstimator)]
        found = (s.findings(s.GetMyContextFromRoot(self.context)) for s in systems)
        return tuple(text for texts in found for text in texts)

    def frictions(self) -> list[np.ndarray]:
        """The friction that each of the estimators tells, (N, n) each [Nm]."""
        ports = [self.estimator.GetOutputPort(name) for name in self.estimator.friction_ports]
        values = [np.empty((len(self.time), port.size())) for port in ports]
        for k in range(len(self.time)):
            self.feed(k)
            for port, friction in zip(ports, values, strict=True):
                friction[k] = port.Eval(self.context)
            self.update()
        return [friction[self._tick_of_row] for friction in values]

    def run(
        self, progress: Callable[[float], None] | None = None
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Estimates by channel, each (N, ...), and the time that each tick took [s]."""
        estimator, context = self.estimator, self.context
        outputs = {name: estimator.GetOutputPort(name) for name in estimator.channels}
        values = {name: np.empty((len(self.time), port.size())) for name, port in outputs.items()}
        tick_time = np.empty(len(self.time))
        # The end of the chain, which makes all the others tick.
        last = estimator.GetOutputPort(list(estimator.channels)[-1])
        for k, now in enumerate(self.time):
            self.feed(k)
            start = clock.perf_counter()
            last.Eval(context)
            evaluated = clock.perf_counter() - start
            for name, port in outputs.items():
                values[name][k] = port.Eval(context)
            start = clock.perf_counter()
            self.update()
            tick_time[k] = evaluated + clock.perf_counter() - start
            if progress is not None and k % 100 == 0:
                progress(float(now))
        return {
            name: value.reshape(len(self.time), *estimator.channels[name])[self._tick_of_row]
            for name, value in values.items()
        }, tick_time
