"""Runs a scenario and records it."""

import math
import signal
import threading
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, Multiplexer, VectorLogSink

from fbse_drake import signals
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, law_over_time
from fbse_drake.effects.system import loss_over_time
from fbse_drake.errors import InputError, required
from fbse_drake.estimators.zmp import zero_moment_point
from fbse_drake.log import Log, plausible_part
from fbse_drake.results import RunResult
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot
from fbse_drake.sampling import state_views
from fbse_drake.scenario import FallConfig, Scenario, SensorsConfig, dump_scenario, require_scenario
from fbse_drake.station import Station, build_station
from fbse_drake.walking.reference import RecordedReference, Reference
from fbse_drake.wiring import release

# Why a run failed that was stopped by Ctrl-C.
_INTERRUPTED = "interrupted"
# The run is looked at (fall, progress, interruption) this often in simulated time [s], and after so
# many steps of the plant.
_LOOK_PERIOD, _LOOK_STEPS = 0.01, 1000


@dataclass(frozen=True, eq=False)
class SimulationResult(RunResult):
    """A finished run."""

    log: Log
    # Why the run ended early, or None; also in log.meta["outcome"].
    failure: str | None
    # Time the loop took, without building and recording [s].
    wall_time: float
    scenario: Scenario
    name: str

    def _metrics(self) -> dict[str, Any]:
        from fbse_drake.report.metrics import run_metrics

        return run_metrics(self.log, self.wall_time)


def simulate(
    scenario: Scenario,
    *,
    name: str = "scenario",
    meshcat: Meshcat | None = None,
    progress: Callable[[float], None] | None = None,
) -> SimulationResult:
    """Simulates a scenario to its end, to a fall, or to an interruption (Ctrl-C); what was recorded
    is returned in any case.

    Args:
        name: what the scenario is called in the log.
        meshcat: also draws and records the robot there.
        progress: called with the simulated time [s] as the run goes on.

    Raises:
        InputError: see `build_station`.

    >>> from fbse_drake import load_scenario, simulate
    >>> run = simulate(load_scenario("bsc_arm", overrides=["duration=0.2"]))
    >>> run.failure is None, run.log["joint/position"].shape
    (True, (201, 6))
    """
    require_scenario(scenario)
    with recorded_run(scenario, meshcat=meshcat, progress=progress) as run:
        log = _make_log(scenario, name, run)
        return SimulationResult(log, run.end.failure, run.end.wall_time, scenario, name)


@dataclass(frozen=True)
class End:
    """How a run ended."""

    # Why early, or None.
    failure: str | None
    # Did the robot fall, or the solver fail?
    fell: bool
    # Did somebody stop it (Ctrl-C)?
    interrupted: bool
    # Time the loop took, without building and recording [s].
    wall_time: float


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """What ports of a station told while it ran."""

    station: Station
    # By port, at every plant tick as far as all were finite, (N, size) each.
    ticks: dict[str, np.ndarray]
    end: End

    @property
    def steps(self) -> int:
        """How many steps of the plant ended."""
        return max(len(next(iter(self.ticks.values()))) - 1, 1)


@contextmanager
def recorded_run(
    scenario: Scenario,
    *,
    ports: Sequence[str] | None = None,
    reference: Reference | None = None,
    meshcat: Meshcat | None = None,
    progress: Callable[[float], None] | None = None,
) -> Iterator[RecordedRun]:
    """Simulates a scenario as `simulate` does; afterwards its station is let go of.

    Args:
        ports: which of the station's output ports are recorded; by default `recorded_ports`. What
            nobody reads is not computed.
        reference: the scenario's motion, where it is planned already.
        meshcat, progress: see `simulate`.

    Raises:
        InputError: see `build_station`.
    """
    builder = DiagramBuilder()
    with _postponed_interruption() as interrupted:
        built = build_station(scenario, meshcat=meshcat, reference=reference)
        station = builder.AddNamedSystem("station", built)
        names = recorded_ports(station) if ports is None else list(ports)
        sink = add_record(builder, station, names, scenario.plant.time_step)
        diagram = builder.Build()
        simulator = Simulator(diagram)
        try:
            end = _advance(simulator, station.robot, scenario, meshcat, progress, interrupted)
            data = sink.FindLog(simulator.get_context()).data()
            # A run that diverges may end in rows that are not numbers.
            finite = np.logical_and.accumulate(np.isfinite(data).all(axis=0))
            if not finite.any():
                raise InputError(
                    "the state is not finite from the start: values are too large or too small"
                )
            places = np.cumsum([station.GetOutputPort(port).size() for port in names])[:-1]
            ticks = dict(zip(names, np.split(data.T[finite], places, axis=1), strict=True))
            yield RecordedRun(station, ticks, end)
        finally:
            release(diagram)


@contextmanager
def _postponed_interruption() -> Iterator[threading.Event]:
    """Tells of a Ctrl-C instead of raising it, for the run looks at it often enough: inside a
    callback of a compiler it would be lost. A second one is raised. In other threads than the main
    one, which get none, nothing changes."""
    interrupted = threading.Event()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            signal.default_int_handler(number, frame)
        interrupted.set()

    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return
    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def _advance(
    simulator: Simulator,
    robot: Robot,
    scenario: Scenario,
    meshcat: Meshcat | None,
    progress: Callable[[float], None] | None,
    interrupted: threading.Event,
) -> End:
    """Simulates a scenario to its end."""
    context = simulator.get_mutable_context()
    robot_context = robot.plant.GetMyContextFromRoot(context)
    height = _base_pose(robot, robot_context).translation()[2]
    if meshcat is not None:
        meshcat.StartRecording()

    # From here on there is something to record.
    simulator.Initialize()
    views = state_views(simulator.get_system(), context)
    failure, fell, start = None, False, clock.perf_counter()
    try:
        period = min(_LOOK_PERIOD, _LOOK_STEPS * scenario.plant.time_step)
        looks = int(np.ceil(scenario.duration / period - 1e-9))
        for look in range(1, looks + 1):
            simulator.AdvanceTo(min(look * period, scenario.duration))
            failure = fall_reason(robot, robot_context, scenario.fall, height)
            if failure is not None:
                fell = True
                break
            if progress is not None:
                progress(context.get_time())
            if interrupted.is_set():
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        failure = _INTERRUPTED
    except RuntimeError as error:
        fell = True
        failure = f"the solver failed: {str(error).splitlines()[0]}"
    wall_time, end = clock.perf_counter() - start, context.get_time()
    # What acts in the step that begins with the last row is known when that has ended. (A tick may
    # come later than a sum of steps by rounding.)
    with suppress(RuntimeError):
        simulator.AdvanceTo(end + 1.001 * scenario.plant.time_step)
    del views
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    stopped = failure == _INTERRUPTED
    if failure is not None:
        hint = _undamped(scenario, robot.description) if fell else ""
        failure = f"t = {end:.3f} s: {failure}{hint}"
    return End(failure, fell, stopped, wall_time)


def _undamped(scenario: Scenario, names: RobotDescription) -> str:
    """For the reader of a fall: the joint that the control damps least, if it does not at all."""
    reading = required(scenario.sensors.encoders.period, "sensors.encoders.period")
    damping = scenario.control.damping(names, reading, scenario.plant.time_step)
    worst = int(np.argmin(damping))
    if damping[worst] >= 0:
        return ""
    return (
        f"; held readings and commands leave the control a damping of {damping[worst]:.2g} Nms/rad "
        f"in {names.joint_names[worst]} (see control.kd, control.period, sensors.encoders.period)"
    )


def fall_reason(
    robot: Robot, context: Context, criterion: FallConfig, initial_height: float
) -> str | None:
    """Why the robot counts as fallen, in words, or None.

    Args:
        context: the plant's.
        initial_height: height of the base at the start [m].
    """
    if not np.isfinite(robot.plant.GetPositionsAndVelocities(context)).all():
        return "the state is not finite any more"
    if not robot.has_floating_base:
        return None
    X_WB = _base_pose(robot, context)
    height = X_WB.translation()[2]
    if height < criterion.height_ratio * initial_height:
        return (
            f"fell: the base is {height:.2f} m high, less than {criterion.height_ratio:g} "
            f"of {initial_height:.2f} m"
        )
    tilt = math.acos(min(1.0, X_WB.rotation().matrix()[2, 2]))
    if tilt > criterion.tilt:
        return (
            f"fell: the base is tilted by {np.rad2deg(tilt):.0f} deg, more than "
            f"{np.rad2deg(criterion.tilt):.0f} deg"
        )
    return None


def recorded_ports(station: Station) -> list[str]:
    """Output ports of the station that are recorded."""
    return [name for name in signals.ports(recorded=True) if station.HasOutputPort(name)]


def add_record(
    builder: DiagramBuilder,
    station: Station,
    names: Sequence[str],
    period: float,
) -> VectorLogSink:
    """Adds what records output ports of a station with a period [s], one after the other in a row.

    One sink for all: every sink has an event of its own, which costs more than its data.
    """
    recorded = [station.GetOutputPort(name) for name in names]
    record = builder.AddNamedSystem("record", Multiplexer([port.size() for port in recorded]))
    for i, port in enumerate(recorded):
        builder.Connect(port, record.get_input_port(i))
    return LogVectorOutput(record.get_output_port(), builder, period)


def base_motion(robot: Robot, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a robot's base in the world, by the plant's states (N, size).

    Returns:
        Orientation, a quaternion [w, x, y, z] (N, 4), and position (N, 3) [m].
    """
    context = robot.plant.CreateDefaultContext()
    orientation, position = np.empty((len(state), 4)), np.empty((len(state), 3))
    for k, row in enumerate(state):
        robot.plant.SetPositionsAndVelocities(context, row)
        X_WB = _base_pose(robot, context)
        orientation[k], position[k] = X_WB.rotation().ToQuaternion().wxyz(), X_WB.translation()
    return orientation, position


def _base_pose(robot: Robot, context: Context) -> RigidTransform:
    return robot.plant.EvalBodyPoseInWorld(context, robot.base)


def _make_log(scenario: Scenario, name: str, run: RecordedRun) -> Log:
    station, robot = run.station, run.station.robot
    time_step, steps, ticks = scenario.plant.time_step, run.steps, dict(run.ticks)
    velocity = _joint_velocity(robot, ticks["plant_state"])
    forces = (ticks["net_actuation"], ticks["explicit_force"])
    ticks["torque_loss"] = loss_over_time(robot, velocity, *forces)
    # Of the plant steps those that ended are known.
    period = scenario.log.period
    assert period is not None  # The scenario has filled it in.
    rows = np.arange(0, steps, round(period / time_step))
    raw = {
        port: values[np.minimum(rows + signals.is_late(port), len(values) - 1)]
        for port, values in ticks.items()
    }
    time = rows * time_step
    channels = {
        "time": time,
        **_port_channels(scenario.sensors, robot, raw),
        **_reference_channels(station.reference, time),
        **_truth_channels(
            robot, raw["plant_state"], raw["generalized_acceleration"], raw["true_pad_force"]
        ),
        "truth/joint/friction_law_torque": _law(scenario, robot, ticks)[
            np.minimum(rows, steps - 1)
        ],
    }
    meta = {
        "joints": robot.joint_names,
        "sides": robot.description.sides,
        "legs": {side: leg.joints for side, leg in robot.description.legs.items()},
        "frames": {
            "base": robot.description.base,
            "imu": robot.description.imu,
            "soles": {side: leg.sole for side, leg in robot.description.legs.items()},
        },
        # Places of the force sensors in each sole frame [m].
        "pads": {side: robot.pad_positions(side).tolist() for side in robot.description.sides},
        "period": scenario.log.period,
        "reading_time": scenario.plant.time_step,
        "command_time": scenario.control.period,
        "source": "fbse_drake simulation",
        "title": scenario.title,
        "scenario": dump_scenario(scenario, name),
        "outcome": {
            "finished": run.end.failure is None,
            "fell": run.end.fell,
            "reason": run.end.failure or "finished",
            "time": float(time[-1]),
        },
    }
    log = Log({key: np.ascontiguousarray(values) for key, values in channels.items()}, meta)
    return plausible_part(log)


def _joint_velocity(robot: Robot, state: np.ndarray) -> np.ndarray:
    """Of the plant's states (N, size): (N, n) [rad/s]."""
    return state[:, robot.plant.num_positions() + robot.velocity_index]


def _law(scenario: Scenario, robot: Robot, ticks: Mapping[str, np.ndarray]) -> np.ndarray:
    """What the joints' effects are by their laws, of the velocity that came out, in every plant
    step, (N - 1, n) [Nm]; of a run of one tick what it is there.

    Args:
        ticks: of every port at every plant tick, (N, size).
    """
    effects = scenario.robot.effects_of(JointTorqueEffect, robot.description, key="robot")
    state, command, loss = (
        ticks[name] for name in ("plant_state", "torque_command", "torque_loss")
    )
    velocity = _joint_velocity(robot, state)
    count, time_step = max(len(state) - 1, 1), scenario.plant.time_step
    motion = JointMotion(
        velocity=velocity[-count:],
        position=state[:count, robot.position_index],
        command=command[:count],
        time=np.arange(count)[:, None] * time_step,
        time_step=time_step,
        load=np.vstack([command[:1], command[: count - 1] - loss[1:count]]),
        rotor_inertia=robot.rotor_inertias,
    )
    return law_over_time(effects, motion)


def _port_channels(
    sensors: SensorsConfig,
    robot: Robot,
    recorded: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Channels that recorded ports, (N, size) each, become: those of a sensor as it says itself."""
    channels: dict[str, np.ndarray] = {}
    of_sensors: set[str] = set()
    for sensor in sensors.by_name.values():
        channels |= sensor.channels(robot, recorded)
        of_sensors.update(sensor.ports())
    others = {port: values for port, values in recorded.items() if port not in of_sensors}
    for port, values in others.items():
        channels |= signals.channels_of(port, values, len(robot.joint_names))
    return channels


def _reference_channels(
    reference: Reference | RecordedReference, time: np.ndarray
) -> dict[str, np.ndarray]:
    rows = np.clip(np.searchsorted(reference.time, time + 1e-9) - 1, 0, len(reference.time) - 1)
    channels = {
        "reference/joint/position": reference.joint_position[rows],
        "reference/joint/velocity": reference.joint_velocity[rows],
        "reference/joint/feedforward_torque": reference.feedforward_torque[rows],
    }
    plan = reference.plan
    if plan is not None:
        channels["reference/com/position"] = plan.com.position[rows]
        channels["reference/com/velocity"] = plan.com.velocity[rows]
        channels["reference/zmp"] = plan.zmp[rows]
        for side, foot in plan.feet.items():
            channels[f"reference/foot/{side}/position"] = foot.position[rows]
            channels[f"reference/foot/{side}/support"] = plan.support(side)[rows].astype(float)
            if plan.yaw[side].angle.any():
                channels[f"reference/foot/{side}/yaw"] = plan.yaw[side].angle[rows]
    return channels


def _truth_channels(
    robot: Robot, state: np.ndarray, acceleration: np.ndarray, pad_force: np.ndarray
) -> dict[str, np.ndarray]:
    """What a real robot would not tell: exact motion of joints, base, CoM and feet, and the ZMP of
    the exact foot forces.

    Accelerations are the plant's own, over the step that ends at the row's time; base quantities
    are those of the base frame's origin, in world axes; orientation is a quaternion [w, x, y, z]
    from base to world.
    """
    plant, samples, context = robot.plant, len(state), robot.plant.CreateDefaultContext()
    v = state[:, plant.num_positions() :]
    truth = {
        "joint/position": state[:, robot.position_index],
        "joint/velocity": v[:, robot.velocity_index],
        "joint/acceleration": acceleration[:, robot.velocity_index],
    }
    spatial = np.zeros((2, samples, 6))
    if robot.has_floating_base:
        start = robot.base.floating_velocities_start_in_v()
        spatial = np.array([v[:, start : start + 6], acceleration[:, start : start + 6]])
    for name, values in zip(("velocity", "acceleration"), spatial, strict=True):
        truth[f"base/angular_{name}"], truth[f"base/{name}"] = values[:, :3], values[:, 3:]

    soles = {side: robot.sole(side) for side in robot.description.sides}
    pads = {side: robot.pad_positions(side) for side in soles}
    for name in (
        "base/position",
        "com/position",
        "com/velocity",
        *(f"foot/{side}/position" for side in soles),
    ):
        truth[name] = np.empty((samples, 3))
    truth["base/orientation"] = np.empty((samples, 4))
    pad_force_F = pad_force.reshape(samples, -1, 3)
    pad_force_W, pad_position_W = np.empty_like(pad_force_F), np.empty_like(pad_force_F)
    for k in range(samples):
        plant.SetPositionsAndVelocities(context, state[k])
        X_WB = _base_pose(robot, context)
        truth["base/position"][k] = X_WB.translation()
        truth["base/orientation"][k] = X_WB.rotation().ToQuaternion().wxyz()
        truth["com/position"][k] = plant.CalcCenterOfMassPositionInWorld(context)
        truth["com/velocity"][k] = plant.CalcCenterOfMassTranslationalVelocityInWorld(context)
        row = 0
        for side, sole in soles.items():
            X_WF = sole.CalcPoseInWorld(context)
            rows, R_FW = slice(row, row + len(pads[side])), X_WF.rotation().matrix().T
            truth[f"foot/{side}/position"][k] = X_WF.translation()
            pad_force_W[k, rows] = pad_force_F[k, rows] @ R_FW
            pad_position_W[k, rows] = X_WF.translation() + pads[side] @ R_FW
            row = rows.stop
    if soles:
        truth["zmp"] = zero_moment_point(pad_force_W, pad_position_W)
    return {f"truth/{name}": values for name, values in truth.items()}
