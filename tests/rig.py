"""Drives estimators by hand: a LeafSystem with made-up inputs, or a whole EstimatorDiagram with the
samples of a log."""

import dataclasses
import shutil
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from pydrake.systems.framework import InputPort, System

from fbse_drake import Log, Scenario, resources
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.effects.sensor import SensorEffect
from fbse_drake.estimation import estimate
from fbse_drake.estimators.estimator import Estimator, EstimatorDiagram, make_estimator
from fbse_drake.estimators.floating_base import FloatingBaseModel
from fbse_drake.estimators.records import as_record, size_of
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.estimators.sensor_monitor import SensorMonitor, SensorMonitorConfig
from fbse_drake.estimators.support import MeasuredSupport
from fbse_drake.report.metrics import friction_error
from fbse_drake.robot.plant import Robot, make_robot
from fbse_drake.walking.reference import make_plan
from fbse_drake.wiring import release

TICK = 1e-3
CLOCK = Clock(TICK, TICK * (1 - 1e-6))
BENT = np.tile([0.0, 0.0, -0.4, 0.8, -0.4, 0.0], 2)


def numbers(record: np.ndarray) -> np.ndarray:
    """The numbers of a record, or of a record in it, one after the other."""
    return record.reshape(1).view(float)


class Rig:
    """One system with values on its input ports, ticked by hand."""

    def __init__(self, system: System):
        self.system, self.context = system, system.CreateDefaultContext()
        self._ticks = 0

    def fix(self, **inputs: np.ndarray) -> None:
        """Puts vectors or records on input ports."""
        for name, value in inputs.items():
            value = np.asarray(value)
            vector = numbers(value) if value.dtype.names else value.astype(float)
            self.system.GetInputPort(name).FixValue(self.context, vector)

    def tick(self, **inputs: np.ndarray) -> np.ndarray:
        """The posterior of the next tick, a record."""
        assert isinstance(self.system, RecursiveEstimator)
        self.fix(**inputs)
        self.context.SetTime(self._ticks * TICK)
        self._ticks += 1
        posterior = self.system.GetOutputPort("posterior").Eval(self.context).copy()
        self.system.ExecuteForcedEvents(self.context, publish=False)
        return as_record(posterior, self.system.posterior_type)


def pack(
    system: RecursiveEstimator,
    start: np.ndarray | None = None,
    **values: np.ndarray | float,
) -> np.ndarray:
    """A posterior as another system would send it: this one, or zeros, with these values."""
    kind = system.posterior_type
    posterior = as_record(np.zeros(size_of(kind)), kind)
    if start is not None:
        posterior[...] = start
    for name, value in values.items():
        posterior[name] = np.reshape(value, posterior[name].shape)
    return posterior


@dataclass(frozen=True)
class Base:
    """The systems that every other one is fed by."""

    robot: Robot
    monitor: SensorMonitor
    model: FloatingBaseModel

    @staticmethod
    def of(description: str = "biped") -> "Base":
        robot, _ = make_robot(description)
        monitor = SensorMonitor(SensorMonitorConfig(), MeasuredSupport(), robot, CLOCK)
        return Base(robot, monitor, FloatingBaseModel(robot, monitor.posterior_type, CLOCK))

    def measurements(self, **values: np.ndarray | float) -> np.ndarray:
        """Trusted readings of a robot that stands on level ground, but for the values given."""
        pads = sum(len(leg.pads) for leg in self.robot.description.legs.values())
        standing = np.tile([0.0, 0.0, 87.0 * 9.81 / pads], pads)
        resting = {
            "joint_position": BENT,
            "specific_force": [0, 0, 9.81],
            "pad_force": standing,
            "support": np.ones(2),
        }
        readings = pack(self.monitor, **{**resting, **values})
        for name in readings["mean"].dtype.names:
            readings["mean"][name] = readings[name]
        return readings

    def model_of(self, **values: np.ndarray | float) -> np.ndarray:
        """The posterior of the model for such readings."""
        return Rig(self.model).tick(measurements=self.measurements(**values))


def robot_copy(folder: Path, edit: Callable[[str], str]) -> str:
    """Description of a copy of the biped with another URDF."""
    shutil.copytree(resources.folder("models"), folder)
    urdf = folder / "biped.urdf"
    before = urdf.read_text()
    urdf.write_text(edit(before))
    assert urdf.read_text() != before
    return str(folder / "biped.yaml")


def part(log: Log, seconds: float) -> Log:
    """The beginning of a log."""
    rows = round(seconds / log.meta["period"]) + 1
    return dataclasses.replace(
        log, channels={name: channel[:rows] for name, channel in log.channels.items()}
    )


def estimated(log: Log, scenario: Scenario, config: Estimator, **changes: object) -> Log:
    """The log with the estimates of another estimator."""
    return estimate(dataclasses.replace(scenario, estimator=config, **changes), log).log


def coverage(log: Log) -> float:
    """Share of time in which the friction is within 2.58 stated deviations of the truth."""
    std = log["estimate/joint/friction_torque_std"]
    return float(np.mean((np.abs(friction_error(log)) < 2.58 * std)[log.time >= 1.0]))


def inputs_of(log: Log) -> dict[str, np.ndarray]:
    """Samples for the input ports of an EstimatorDiagram, (N, size) each."""
    pads = [log[f"foot/{side}/pad_force"].reshape(len(log.time), -1) for side in log.sides]
    return {
        "measured_joint_state": np.hstack([log["joint/position"], log["joint/velocity"]]),
        "measured_imu": np.hstack([log["imu/linear_acceleration"], log["imu/angular_velocity"]]),
        "measured_pad_force": np.hstack(pads),
        "torque_command": log["joint/torque_command"],
    }


def diagram(config: Estimator, scenario: Scenario) -> EstimatorDiagram:
    """The estimator as the scenario's station has it."""
    believed = scenario.believed
    robot, _ = make_robot(believed.description, rotor_inertia=believed.rotor_inertia)
    time = np.arange(round(scenario.duration / TICK) + 1) * TICK
    plan = make_plan(scenario.reference, robot, time)
    effects = partial(believed.effects_of, names=robot.description, key="model")
    in_sensors, in_joints = effects(SensorEffect), effects(JointTorqueEffect)
    estimator = make_estimator(
        config,
        robot,
        period=TICK,
        plan=plan,
        sensor_effects=in_sensors,
        torque_effects=in_joints,
    )
    assert estimator is not None
    return estimator


class Replay:
    """Feeds a diagram with samples, which need not be finite, and keeps its outputs."""

    def __init__(self, estimator: EstimatorDiagram):
        self.estimator, self.context = estimator, estimator.CreateDefaultContext()
        # Nothing else frees systems that are written in Python.
        weakref.finalize(self, release, estimator)

    def fork(self) -> "Replay":
        """A copy that goes on from here."""
        copy = Replay.__new__(Replay)
        copy.estimator, copy.context = self.estimator, self.context.Clone()
        copy.origin = self
        return copy

    def run(
        self, time: np.ndarray, inputs: Mapping[str, np.ndarray], *channels: str
    ) -> dict[str, np.ndarray]:
        """Outputs for each sample; by default all.

        A name of the form `system.field` is a field of that system's posterior.
        """
        names = channels or ("friction_estimate", *self.estimator.channels)
        # Looked up once, for there are many ticks.
        read = {name: self._reader(name) for name in names}
        outputs: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for k, now in enumerate(time):
            self.fix({name: values[k] for name, values in inputs.items()}, now)
            for name, values in outputs.items():
                values.append(read[name]().copy())
            self.estimator.ExecuteForcedEvents(self.context, publish=False)
        return {name: np.array(values) for name, values in outputs.items()}

    def fix(self, inputs: Mapping[str, np.ndarray], now: float) -> None:
        """Puts samples on the input ports."""
        self.context.SetTime(now)
        for name, port in self._input_ports.items():
            port.FixValue(self.context, inputs[name])

    @cached_property
    def _input_ports(self) -> dict[str, InputPort]:
        ports = [self.estimator.get_input_port(i) for i in range(self.estimator.num_input_ports())]
        return {port.get_name(): port for port in ports}

    def _reader(self, name: str) -> Callable[[], np.ndarray]:
        if "." not in name:
            return partial(self.estimator.GetOutputPort(name).Eval, self.context)
        system_name, field = name.split(".")
        system = self.estimator.GetSubsystemByName(system_name)
        return partial(system.GetOutputPort(field).Eval, system.GetMyContextFromRoot(self.context))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
