"""Runs a scenario's estimator over a recorded log."""

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fbse_drake.errors import InputError, located
from fbse_drake.estimators.estimator import make_estimator
from fbse_drake.estimators.foot_pads import measured_pad_forces
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot
from fbse_drake.sampling import state_views
from fbse_drake.scenario import Scenario, build_robot
from fbse_drake.walking.reference import make_reference

# Time constant of the smoothing of joint velocities that are differentiated from angles [s].
_DIFFERENTIATION_TIME = 0.004


@dataclass(frozen=True)
class EstimationResult:
    """A log with the estimates in its `estimate/...` channels, and the time that each tick took [s], shape (N,)."""

    log: Log
    tick_time: np.ndarray


def estimate(scenario: Scenario, log: Log, *, progress: Callable[[float], None] | None = None) -> EstimationResult:
    """Runs the scenario's estimator over a log, sample by sample, with the very LeafSystems that run in the station.

    Only sensor channels are used; `time` is what the log says, so samples may be missing or late. On the log of a simulation with the same
    scenario the estimates are those of the simulation. Without `joint/velocity` the angles are differentiated and smoothed.

    Args:
        progress: called with the log's time [s] as the work goes on.

    Raises:
        InputError: no estimator in the scenario, a log that lacks a channel, other joints or feet than the model's.
    """
    values, tick_time = Replay(scenario, log).run(progress)
    kept = {name: channel for name, channel in log.channels.items() if not name.startswith("estimate/")}
    return EstimationResult(replace(log, channels=kept | values), tick_time)


_CHANNELS_OF = {
    "measured_joint_state": "joint/position",
    "measured_imu": "imu/linear_acceleration, imu/angular_velocity",
    "measured_pad_force": "foot/<side>/pad_force",
    "torque_command": "joint/torque_command",
    "measured_torque": "joint/torque_measured",
    "torque_loss": "truth/joint/friction_torque",
}


def _inputs(robot: Robot, log: Log) -> dict[str, np.ndarray]:
    """Samples for the estimator's input ports, as far as the log has them; each (N, size)."""
    if log.joints != robot.joint_names:
        raise InputError(f"the log's joints {log.joints} are not the model's {robot.joint_names}")
    q = log["joint/position"]
    velocity = log["joint/velocity"] if "joint/velocity" in log else differentiate(log.time, q, _DIFFERENTIATION_TIME)
    inputs = {"measured_joint_state": np.hstack([q, velocity]), "torque_command": log["joint/torque_command"]}
    if "imu/linear_acceleration" in log and "imu/angular_velocity" in log:
        inputs["measured_imu"] = np.hstack([log["imu/linear_acceleration"], log["imu/angular_velocity"]])
    if any(name.startswith("foot/") for name in log):
        inputs["measured_pad_force"] = measured_pad_forces(robot, log).reshape(len(log.time), -1)
    for port, name in (("measured_torque", "joint/torque_measured"), ("torque_loss", "truth/joint/friction_torque")):
        if name in log:
            inputs[port] = log[name]
    return inputs


def differentiate(time: np.ndarray, position: np.ndarray, time_constant: float) -> np.ndarray:
    """Causal velocity of sampled angles: differences behind two low-passes of first order.

    Args:
        time: (N,) [s]; position: (N, n) [rad]; time_constant: of each low-pass [s].

    Returns:
        Shape (N, n) [rad/s].
    """
    velocity = np.zeros_like(position)
    stage = np.zeros((2, position.shape[1]))
    for k in range(1, len(time)):
        elapsed = time[k] - time[k - 1]
        keep = np.exp(-elapsed / time_constant)
        stage[0] = keep * stage[0] + (1 - keep) * (position[k] - position[k - 1]) / elapsed
        stage[1] = keep * stage[1] + (1 - keep) * stage[0]
        velocity[k] = stage[1]
    return velocity


class Replay:
    """A scenario's estimator and a log that it runs over; see `estimate`."""

    def __init__(self, scenario: Scenario, log: Log):
        with located("model: "):
            robot = build_robot(scenario.believed)
        inputs = _inputs(robot, log)
        ticks = np.arange(round(scenario.duration / scenario.control.period) + 1) * scenario.control.period
        with located("reference: "):
            plan = make_reference(scenario.reference, robot, ticks).plan
        period = float(log.meta["period"])
        estimator = make_estimator(scenario.estimator, robot, period=period, plan=plan, every_sample=True)
        if estimator is None:
            raise InputError("estimator: the scenario has none (estimator: !Fbse {})")
        for i in range(estimator.num_input_ports()):
            name = estimator.get_input_port(i).get_name()
            if name not in inputs:
                raise InputError(f"the log has no channel for the estimator's input {name} ({_CHANNELS_OF[name]})")
        self.estimator, self.time = estimator, log.time
        self.context = estimator.CreateDefaultContext()
        # Takes the update of every tick.
        self._next_context = estimator.CreateDefaultContext()
        self._next = self._next_context.get_mutable_state()
        self._next_values = self._next_context.get_discrete_state()
        self._views = [*state_views(estimator, self.context), *state_views(estimator, self._next_context)]
        self._sources = []
        for i in range(estimator.num_input_ports()):
            port = estimator.get_input_port(i)
            self._sources.append((port.FixValue(self.context, inputs[port.get_name()][0]), inputs[port.get_name()]))

    def feed(self, sample: int) -> None:
        """Sets time and inputs to a sample of the log."""
        self.context.SetTime(self.time[sample])
        for fixed, samples in self._sources:
            fixed.GetMutableData().get_mutable_value().SetFromVector(samples[sample])

    def update(self) -> None:
        """Lets the estimators remember the tick. (`ExecuteForcedEvents` does so too, but allocates two states.)"""
        self.estimator.CalcForcedUnrestrictedUpdate(self.context, self._next)
        self.context.SetDiscreteState(self._next_values)

    def run(self, progress: Callable[[float], None] | None = None) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Estimates by channel, each (N, ...), and the time that each tick took [s], shape (N,)."""
        estimator, context = self.estimator, self.context
        outputs = {name: estimator.GetOutputPort(name) for name in estimator.channels}
        values = {name: np.empty((len(self.time), port.size())) for name, port in outputs.items()}
        tick_time = np.empty(len(self.time))
        friction = estimator.GetOutputPort("friction_estimate")
        for k, now in enumerate(self.time):
            self.feed(k)
            start = clock.perf_counter()
            friction.Eval(context)
            evaluated = clock.perf_counter() - start
            for name, port in outputs.items():
                values[name][k] = port.Eval(context)
            start = clock.perf_counter()
            self.update()
            tick_time[k] = evaluated + clock.perf_counter() - start
            if progress is not None and k % 100 == 0:
                progress(float(now))
        return {name: value.reshape(len(self.time), *estimator.channels[name]) for name, value in values.items()}, tick_time
