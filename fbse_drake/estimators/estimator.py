"""Friction estimators as diagrams: what a scenario's `estimator` can be."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Demultiplexer, Multiplexer

from fbse_drake.errors import InputError
from fbse_drake.estimators.attitude import AttitudeConfig, AttitudeEstimator
from fbse_drake.estimators.base_filter import InvariantBaseFilter, InvariantFilter
from fbse_drake.estimators.base_state import (
    AdaptiveLipm,
    AdaptiveLipmEstimator,
    BaseStateEstimator,
    ContactAided,
    ContactAidedEstimator,
)
from fbse_drake.estimators.beliefs import USUAL_SENSORS, SensorBeliefs
from fbse_drake.estimators.floating_base import FloatingBaseModel, ImuMount
from fbse_drake.estimators.friction import (
    FrictionConfig,
    FrictionEstimator,
    ModelAided,
    ModelAidedEstimator,
    RecursiveLeastSquaresEstimator,
)
from fbse_drake.estimators.joint_acceleration import (
    JointAccelerationConfig,
    JointAccelerationEstimator,
)
from fbse_drake.estimators.link_torque import LinkTorqueEstimator
from fbse_drake.estimators.records import parts
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.estimators.reference_methods import (
    DisturbanceObserver,
    FixedFriction,
    FixedFrictionModel,
    MomentumObserver,
    NoEstimator,
    TorqueSensor,
    TorqueSensorEstimator,
    TrueFriction,
    TrueFrictionSource,
)
from fbse_drake.estimators.sensor_monitor import SensorMonitor, SensorMonitorConfig
from fbse_drake.estimators.support import MeasuredSupport, PlannedSupport, SupportConfig
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.errors import held_signal
from fbse_drake.sensors.foot_pads import FootPads
from fbse_drake.signals import estimates
from fbse_drake.walking.plan import TaskPlan

BaseStateConfig = InvariantFilter | AdaptiveLipm | ContactAided


@dataclass(frozen=True)
class Fbse:
    """Foot base sensor estimation.

    It goes by attitude, base state, joint accelerations and link torque to the friction. The
    defaults are the best variant of every stage; `scenarios/paper_walk_fbse.yaml` also has the
    paper's.
    """

    sensor_monitor: SensorMonitorConfig = field(default_factory=SensorMonitorConfig)
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)
    # !ContactAided or the paper's !AdaptiveLipm.
    base_state: BaseStateConfig = field(default_factory=InvariantFilter)
    # What is not given follows from the scenario's `sensors`.
    sensors: SensorBeliefs = field(default_factory=SensorBeliefs)
    # !MeasuredSupport or the paper's !PlannedSupport.
    support: SupportConfig = field(default_factory=MeasuredSupport)
    joint_acceleration: JointAccelerationConfig = field(default_factory=JointAccelerationConfig)
    # !ModelAided or the paper's !RecursiveLeastSquares.
    friction: FrictionConfig = field(default_factory=ModelAided)


_Reference = TrueFriction | TorqueSensor | DisturbanceObserver | FixedFriction
EstimatorConfig = NoEstimator | Fbse | _Reference


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

    Inputs are those of the sensors that the estimator needs (`TorqueSensor` has `measured_torque` besides, `TrueFriction` `torque_loss`).
    `friction_estimate` (n,) [Nm] is that of the tick that ends now. The other outputs are named like the log channels they become, see
    `channels`. An `Fbse` that is not told the torque commands has neither `torque_command` nor
    `friction_estimate`.
    """

    # Log channels, which are also names of output ports, and the shape of one sample.
    channels: dict[str, tuple[int, ...]]
    # Whether it estimates the friction.
    knows_friction: bool

    def __init__(
        self,
        config: EstimatorConfig,
        robot: Robot,
        clock: Clock,
        plan: TaskPlan | None,
        sensors: SensorBeliefs,
        *,
        knows_torque: bool = True,
    ):
        """Wires the estimator, see `make_estimator`."""
        super().__init__()
        self.knows_friction = knows_torque or not isinstance(config, Fbse)
        self._sensors = sensors
        self.channels = {}
        self._builder = DiagramBuilder()
        self._systems: dict[str, RecursiveEstimator] = {}
        self._split: dict[str, Demultiplexer] = {}
        n = len(robot.joint_names)
        if isinstance(config, TrueFriction):
            friction = self._add("friction", TrueFrictionSource(n, clock))
            self._feed(friction, "torque_loss")
        elif isinstance(config, TorqueSensor):
            friction = self._add("friction", TorqueSensorEstimator(config, n, clock))
            self._feed(friction, "measured_torque", "torque_command")
        elif isinstance(config, FixedFriction):
            self._add_monitor(SensorMonitorConfig(), MeasuredSupport(), robot, clock)
            friction = self._add(
                "friction", FixedFrictionModel(config, robot, self._type("sensor_monitor"), clock)
            )
            self._join(friction, measurements="sensor_monitor")
        elif isinstance(config, DisturbanceObserver):
            self._add_momentum_observer(config, robot, clock, plan)
        elif isinstance(config, Fbse):
            self._add_fbse(config, robot, clock, plan)
        else:
            raise TypeError(f"no estimator: {config}")
        self._export(n)
        self._builder.BuildInto(self)
        del self._builder

    def _add_fbse(self, config: Fbse, robot: Robot, clock: Clock, plan: TaskPlan | None) -> None:
        self._add_base(config, robot, clock, plan)
        chain = ("sensor_monitor", "attitude", "model")
        measurements, attitude, model = (self._type(name) for name in chain)
        sensors, kinds = self._sensors, (measurements, attitude, model)
        acceleration = self._add(
            "joint_acceleration",
            JointAccelerationEstimator(config.joint_acceleration, sensors, robot, *kinds, clock),
        )
        self._join(acceleration, measurements="sensor_monitor", attitude="attitude")
        self._connect_model(acceleration, "over_step")
        if not self.knows_friction:
            return
        kinds = (measurements, model, self._type("joint_acceleration"))
        link_torque = self._add("link_torque", LinkTorqueEstimator(sensors, robot, *kinds, clock))
        self._join(
            link_torque, measurements="sensor_monitor", joint_acceleration="joint_acceleration"
        )
        self._connect_model(link_torque, "over_step")
        self._feed(link_torque, "torque_command")
        shared = (robot, measurements, self._type("link_torque"), clock)
        friction: FrictionEstimator
        if isinstance(config.friction, ModelAided):
            friction = ModelAidedEstimator(config.friction, sensors, *shared)
        else:
            friction = RecursiveLeastSquaresEstimator(config.friction, *shared)
        self._add("friction", friction)
        self._join(friction, measurements="sensor_monitor", link_torque="link_torque")

    def _add_momentum_observer(
        self, config: DisturbanceObserver, robot: Robot, clock: Clock, plan: TaskPlan | None
    ) -> None:
        self._add_base(Fbse(), robot, clock, plan)
        parts = [self._type(name) for name in ("sensor_monitor", "attitude", "base_state", "model")]
        friction = self._add("friction", MomentumObserver(config, robot, *parts, clock))
        self._join(
            friction,
            measurements="sensor_monitor",
            attitude="attitude",
            base_state="base_state",
            model="model",
        )
        self._connect_model(friction, "at_step_start")
        self._feed(friction, "torque_command")

    def _add_base(self, config: Fbse, robot: Robot, clock: Clock, plan: TaskPlan | None) -> None:
        """Sensor monitor with support, model, attitude and base state."""
        if not robot.has_floating_base or not robot.description.legs:
            raise InputError(
                "estimator: needs a robot with a floating base and feet (no gantry_height)"
            )
        invariant = isinstance(config.base_state, InvariantFilter)
        monitor = (config.sensor_monitor, config.support)
        self._add_monitor(*monitor, robot, clock, hears_doubt=invariant)
        measurements = self._type("sensor_monitor")
        model = self._add(
            "model", FloatingBaseModel(robot, measurements, clock, knows_bias=invariant)
        )
        self._join(model, measurements="sensor_monitor")
        sides = robot.description.sides
        if isinstance(config.support, PlannedSupport):
            if plan is None:
                instead = "needs a planned walk or stand (use !MeasuredSupport)"
                raise InputError(f"estimator.support: !PlannedSupport {instead}")
            support = np.stack([plan.support(side) for side in sides], axis=1).astype(float)
            source = self._builder.AddNamedSystem(
                "planned_support", held_signal(support, float(plan.time[1] - plan.time[0]))
            )
            self._builder.Connect(
                source.get_output_port(),
                self._systems["sensor_monitor"].GetInputPort("planned_support"),
            )
        feet = [] if plan is None else [plan.feet[side].position[0, :2] for side in sides]
        x, y = np.mean(feet, axis=0) if feet else (0.0, 0.0)
        add = self._add_invariant_base if invariant else self._add_base_in_stages
        add(config, robot, clock, (float(x), float(y)))

    def _add_invariant_base(
        self, config: Fbse, robot: Robot, clock: Clock, origin: tuple[float, float]
    ) -> None:
        """Attitude and base state in one."""
        types = (self._type("sensor_monitor"), self._type("model"))
        base = InvariantBaseFilter(config.base_state, self._sensors, robot, *types, clock, origin)
        self._systems["attitude"] = self._add("base_state", base)
        self._join(base, measurements="sensor_monitor", model="model")
        bias = base.GetOutputPort("last_angular_velocity_bias")
        self._builder.Connect(bias, self._systems["model"].GetInputPort("angular_velocity_bias"))
        doubt = base.GetOutputPort("last_doubt")
        self._builder.Connect(doubt, self._systems["sensor_monitor"].GetInputPort("doubt"))

    def _add_base_in_stages(
        self, config: Fbse, robot: Robot, clock: Clock, origin: tuple[float, float]
    ) -> None:
        """Attitude first, then the base state."""
        measurements, model = self._type("sensor_monitor"), self._type("model")
        kinds = (measurements, model)
        R_BI = ImuMount(robot).R_BI
        attitude = self._add(
            "attitude", AttitudeEstimator(config.attitude, self._sensors, R_BI, *kinds, clock)
        )
        self._join(attitude, measurements="sensor_monitor", model="model")
        shared = (robot, measurements, self._type("attitude"), model, clock, origin)
        base_state: BaseStateEstimator
        if isinstance(config.base_state, AdaptiveLipm):
            base_state = AdaptiveLipmEstimator(config.base_state, *shared)
        else:
            base_state = ContactAidedEstimator(config.base_state, *shared)
        self._add("base_state", base_state)
        self._join(base_state, measurements="sensor_monitor", attitude="attitude", model="model")

    def _add_monitor(
        self,
        config: SensorMonitorConfig,
        support: SupportConfig,
        robot: Robot,
        clock: Clock,
        *,
        hears_doubt: bool = False,
    ) -> None:
        watch = (config, support, robot, clock, self._sensors)
        monitor = self._add("sensor_monitor", SensorMonitor(*watch, hears_doubt=hears_doubt))
        joints, pads = len(robot.joint_names), len(FootPads(robot).foot)
        sizes = {
            "measured_joint_state": 2 * joints,
            "measured_imu": 6,
            "measured_pad_force": 3 * pads,
        }
        sensors = self._builder.AddNamedSystem("sensors", Multiplexer(list(sizes.values())))
        self._builder.Connect(sensors.get_output_port(), monitor.GetInputPort("sensors"))
        for i, port in enumerate(sizes):
            self._builder.ExportInput(sensors.get_input_port(i), port)

    def _add(self, name: str, system: RecursiveEstimator) -> RecursiveEstimator:
        self._systems[name] = self._builder.AddNamedSystem(name, system)
        return system

    def _type(self, name: str) -> np.dtype:
        return self._systems[name].posterior_type

    def _join(self, system: RecursiveEstimator, **sources: str) -> None:
        """Connects the posteriors of estimators to input ports of these names."""
        for port, source in sources.items():
            self._builder.Connect(
                self._systems[source].GetOutputPort("posterior"), system.GetInputPort(port)
            )

    def _connect_model(self, system: RecursiveEstimator, output: str) -> None:
        """Connects the model where the tick began, `at_step_start`, or `over_step`."""
        source = self._systems["model"].GetOutputPort(output)
        self._builder.Connect(source, system.GetInputPort(f"model_{output}"))

    def _feed(self, system: RecursiveEstimator, *ports: str) -> None:
        """Makes inputs of the diagram of a system's input ports."""
        for port in ports:
            self._builder.ExportInput(system.GetInputPort(port), port)

    def _field_port(self, system: str, name: str) -> OutputPort:
        """The output port of one field of a posterior."""
        sizes = self._sizes(system)
        if system not in self._split:
            # The estimator has such a port itself, which is Python's and costs more.
            split = Demultiplexer(list(sizes.values()))
            self._split[system] = self._builder.AddNamedSystem(f"{system}_fields", split)
            posterior = self._systems[system].GetOutputPort("posterior")
            self._builder.Connect(posterior, split.get_input_port())
        return self._split[system].get_output_port(list(sizes).index(name))

    def _sizes(self, system: str) -> dict[str, int]:
        """How many numbers the fields of a posterior have, if any: of a system that is there."""
        if system not in self._systems:
            return {}
        return {name: part.stop - part.start for name, part in parts(self._type(system)).items()}

    def _export(self, n: int) -> None:
        if self.knows_friction:
            friction = self._field_port("friction", "friction")
            self._builder.ExportOutput(friction, "friction_estimate")
        for row in estimates():
            size = self._sizes(row.estimator).get(row.field)
            if size is not None:
                port = self._field_port(row.estimator, row.field)
                self._builder.ExportOutput(port, row.port)
                self.channels[row.channel] = row.sample_shape(n, size)


def make_estimator(
    config: EstimatorConfig,
    robot: Robot,
    *,
    period: float,
    plan: TaskPlan | None = None,
    every_sample: bool = False,
    reading: float | None = None,
    sensors: SensorBeliefs = USUAL_SENSORS,
    knows_torque: bool = True,
) -> EstimatorDiagram | None:
    """Builds a friction estimator, or None for `NoEstimator`.

    Args:
        robot: the model that is believed.
        period: tick [s].
        plan: for the planned support, and for where the feet stand at the start.
        every_sample: every evaluation at a later time is a tick, whatever the period; for recorded logs.
        reading: what a reading of accelerometer or foot force is the mean over [s], 0 for a sample;
            by default the tick.
        sensors: what is believed of them where the config says nothing.
        knows_torque: the torque commands are known; without them an `Fbse` estimates no friction.

    Raises:
        InputError: an estimator that does not fit the robot.
    """
    if isinstance(config, NoEstimator):
        return None
    shortest = 1e-9 if every_sample else period * (1 - 1e-6)
    clock = Clock(period, shortest, period if reading is None else reading)
    believed = believed_sensors(config, sensors)
    return EstimatorDiagram(config, robot, clock, plan, believed, knows_torque=knows_torque)


def believed_sensors(config: EstimatorConfig, usual: SensorBeliefs) -> SensorBeliefs:
    """What an estimator believes of its sensors, what it is not told as usual."""
    given = config.sensors if isinstance(config, Fbse) else SensorBeliefs()
    return given.completed(usual)
