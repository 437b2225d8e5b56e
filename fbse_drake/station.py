"""The closed loop as a Drake diagram.

A station is a list of steps: robot, sensors, reference, controller, estimator, compensation. Each
adds its systems to the builder, takes the ports that it needs by name and returns the ports that
it gives by name; a part that a scenario does not have gives none. What the names mean is in the
table of signals (`fbse_drake.signals`).
"""

import math
from collections.abc import Mapping
from copy import copy
from functools import partial
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Demultiplexer,
    MatrixGain,
    PassThrough,
)

from fbse_drake import signals
from fbse_drake.control.position_loop import PositionLoop
from fbse_drake.effects.contact import contact_with_effects
from fbse_drake.effects.implicit import ImplicitLaw, implicit_law
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.effects.sensor import SensorEffect
from fbse_drake.effects.sensor_systems import SensorEffects
from fbse_drake.effects.system import JointTorqueEffects
from fbse_drake.errors import InputError, located, required
from fbse_drake.estimators.estimator import EstimatorDiagram, make_estimator
from fbse_drake.estimators.recursive import Clock
from fbse_drake.robot.description import RobotDescription, load_description
from fbse_drake.robot.plant import Ground, Robot
from fbse_drake.robot.push import AppliedPushes, Push, PushSource
from fbse_drake.robot.trial_step import TrialStep
from fbse_drake.scenario import RobotConfig, Scenario, build_robot, planned_reference
from fbse_drake.sensors.sensor import Run
from fbse_drake.walking.reference import RecordedReference, Reference
from fbse_drake.wiring import connect_by_name, outputs_by_name

Ports = Mapping[str, OutputPort]


class Station(Diagram):
    """A scenario's closed loop; made by `build_station`.

    .. pydrake_system::

        name: Station
        input_ports:
        - friction_estimate
        output_ports:
        - measured_joint_state
        - measured_imu
        - measured_pad_force
        - torque_command
        - desired_state
        - feedforward_torque
        - plant_state
        - generalized_acceleration
        - net_actuation
        - explicit_force
        - true_pad_force
        - torque_loss

    Sensor and controller ports come first, what a real robot would not tell (plant state,
    acceleration, net actuation, the effects' explicit force, ideal pad forces, torque loss of the
    effects) comes last. `friction_estimate`
    (n,) [Nm] is added to the command and may be left unconnected; a station that compensates its
    own estimate does not have it. A station with an estimator also has a port for each of
    `estimator.channels`, see `EstimatorDiagram`; one with joint torque sensors has
    `measured_torque`, one with further sensors their ports. A recorded reference has a
    `feedforward_torque` where its log has one.
    """

    robot: Robot
    model: Robot
    reference: Reference | RecordedReference
    # None without an estimator.
    estimator: EstimatorDiagram | None

    def __init__(
        self,
        scenario: Scenario,
        meshcat: Meshcat | None = None,
        reference: Reference | RecordedReference | None = None,
    ):
        super().__init__()
        builder = DiagramBuilder()
        with located("model: "):
            self.model = build_robot(scenario.believed)
        expected = load_description(scenario.robot.description)[0].joint_names
        if self.model.joint_names != expected:
            found = self.model.joint_names
            raise InputError(f"model: expected the robot's joints {expected}, found {found}")
        self.reference = reference or planned_reference(scenario, self.model)
        simulated = add_robot(builder, scenario, self.reference)
        self.robot = simulated.robot
        ports = dict(simulated.ports)
        ports |= add_sensors(builder, scenario, self.robot, ports)
        ports |= add_sensor_effects(builder, scenario, self.robot, ports)
        ports |= add_reference(builder, self.reference, scenario.plant.time_step)
        controller = add_controller(builder, scenario, simulated, ports)
        believed_effects = partial(
            scenario.believed.effects_of, names=self.model.description, key="model"
        )
        self.estimator = make_estimator(
            scenario.estimator,
            self.model,
            period=_estimation_period(scenario, self.model.description),
            control=scenario.control.period,
            plan=self.reference.plan,
            sensors=scenario.believed_sensors,
            sensor_effects=believed_effects(SensorEffect),
            torque_effects=believed_effects(JointTorqueEffect),
            reading=scenario.plant.time_step,
        )
        ports |= add_estimator(builder, self.estimator, ports)
        add_compensation(builder, scenario, self.robot.description, controller, ports)
        add_meshcat(builder, meshcat)
        export(builder, ports)
        builder.BuildInto(self)


def build_station(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    reference: Reference | RecordedReference | None = None,
) -> Station:
    """Builds the closed loop of a scenario.

    Args:
        meshcat: also draws the robot there.
        reference: what the robot is asked for, by default the scenario's motion as its model plans
            it; joints start at zero in a recorded one unless the context says otherwise.

    Raises:
        InputError: a part of the scenario that does not fit the robot, or a motion that it cannot
            make.
    """
    return Station(scenario, meshcat, reference)


class SimulatedRobot(NamedTuple):
    """A robot in a diagram; see `add_robot`."""

    robot: Robot
    # Takes the torque that each joint's motor is to give, (n,) [Nm].
    torque_command: InputPort
    ports: dict[str, OutputPort]


def add_robot(
    builder: DiagramBuilder,
    scenario: Scenario,
    reference: Reference | RecordedReference,
) -> SimulatedRobot:
    """Adds the robot on its ground, with its physical effects, at the start of the reference.

    Returns:
        With ports `joint_state` [q, v] (2n,) [rad, rad/s], `torque_command` as given and
        `torque_loss` of the effects in the step that ended (n,) [Nm] with the `friction` in it, and
        what it is the sum of, `net_actuation` and `explicit_force` (see
        `fbse_drake.effects.system.loss_over_time`),
        `deflection` of the motors against their links (n,) [rad],
        `plant_state`, `generalized_acceleration` and those of the plant that sensors need:
        `body_poses`, `body_spatial_velocities`, `body_spatial_accelerations`, `reaction_forces`.

    Raises:
        InputError: effects or parts that the robot does not have.
    """
    config, time_step = scenario.robot, scenario.plant.time_step
    contact = (scenario.ground, scenario.plant, config.description)
    names, _ = load_description(config.description)
    torque_effects = config.effects_of(JointTorqueEffect, names, key="robot")
    law = implicit_law(torque_effects, _planned_motion(reference, time_step))
    with located("robot: "):
        ground, settings = contact_with_effects(config.effects.values(), *contact)
        simulated = {"builder": builder, "plant": settings, "ground": ground}
        robot = build_robot(config, **simulated, implicit=law.torque)
        trial = _trial_step(config, settings, ground, law) if scenario.solve_twice else None
        add_pushes(builder, config.pushes, robot)
    reference.set_start(robot, ground)
    plant = robot.plant
    joint_state = builder.AddNamedSystem("joint_state", MatrixGain(robot.joint_state_selector))
    builder.Connect(plant.get_state_output_port(), joint_state.get_input_port())
    command = builder.AddNamedSystem("torque_command", PassThrough(len(names.joint_names)))
    ports = {
        "joint_state": joint_state.get_output_port(),
        "torque_command": command.get_output_port(),
        "plant_state": plant.get_state_output_port(),
        "generalized_acceleration": plant.get_generalized_acceleration_output_port(),
        "net_actuation": plant.get_net_actuation_output_port(),
        "reaction_forces": plant.get_reaction_forces_output_port(),
    }
    for name in ("body_poses", "body_spatial_velocities", "body_spatial_accelerations"):
        ports[name] = plant.GetOutputPort(name)
    ports |= add_joint_torques(builder, robot, law, time_step, ports, trial)
    return SimulatedRobot(robot, command.get_input_port(), ports)


def _trial_step(
    config: RobotConfig,
    settings: MultibodyPlantConfig,
    ground: Ground,
    law: ImplicitLaw,
) -> TrialStep:
    """Of a robot like that of `add_robot`."""
    builder, settings = DiagramBuilder(), copy(settings)
    settings.use_sampled_output_ports = False
    robot = build_robot(config, builder=builder, plant=settings, ground=ground, implicit=law.torque)
    return TrialStep(robot, builder.Build(), AppliedPushes(config.pushes, robot))


def add_pushes(builder: DiagramBuilder, pushes: Mapping[str, Push], robot: Robot) -> None:
    """Adds what pushes a robot, where something does.

    Raises:
        InputError: a body that the robot has not.
    """
    if pushes:
        source = builder.AddNamedSystem("pushes", PushSource(AppliedPushes(pushes, robot)))
        port = robot.plant.get_applied_spatial_force_input_port()
        builder.Connect(source.get_output_port(), port)


def _planned_motion(reference: Reference | RecordedReference, time_step: float) -> JointMotion:
    """The motion of the joints that a run is planned to have."""
    return JointMotion(
        velocity=reference.joint_velocity,
        position=reference.joint_position,
        time=reference.time[:, None],
        time_step=time_step,
        load=reference.feedforward_torque,
    )


def add_joint_torques(
    builder: DiagramBuilder,
    robot: Robot,
    law: ImplicitLaw,
    time_step: float,
    ports: Ports,
    trial: TrialStep | None = None,
) -> dict[str, OutputPort]:
    """Adds what moves a robot's joints: commanded torque, and the losses of its effects.

    Args:
        ports: of the robot: `joint_state`, `torque_command`, `net_actuation` and `plant_state`.
        trial: where every step is tried first, what it is tried with.

    Returns:
        `torque_loss`, `friction`, `deflection` and `explicit_force`.
    """
    plant, instance = robot.plant, robot.base.model_instance()
    effects = builder.AddNamedSystem("effects", JointTorqueEffects(law, robot, time_step, trial))
    connect_by_name(builder, ports, effects)
    force = plant.get_applied_generalized_force_input_port()
    builder.Connect(effects.GetOutputPort("explicit_force"), force)

    # The clamps are controllers that want their joints to stand still.
    wanted = plant.get_desired_state_input_port(instance)
    still = builder.AddNamedSystem("stillness", ConstantVectorSource(np.zeros(wanted.size())))
    builder.Connect(still.get_output_port(), wanted)
    actuation = builder.AddNamedSystem("torque_to_actuation", MatrixGain(robot.actuation_selector))
    builder.Connect(ports["torque_command"], actuation.get_input_port())
    torque = actuation.get_output_port()
    if effects.HasOutputPort("clamp_offset"):
        offset = builder.AddNamedSystem("offset_to_actuation", MatrixGain(robot.clamp_selector))
        both = builder.AddNamedSystem("actuation", Adder(2, plant.num_actuators()))
        builder.Connect(effects.GetOutputPort("clamp_offset"), offset.get_input_port())
        builder.Connect(torque, both.get_input_port(0))
        builder.Connect(offset.get_output_port(), both.get_input_port(1))
        torque = both.get_output_port()
    builder.Connect(torque, plant.get_actuation_input_port())
    given = ("torque_loss", "friction", "deflection", "explicit_force")
    return {name: effects.GetOutputPort(name) for name in given}


def add_sensors(
    builder: DiagramBuilder,
    scenario: Scenario,
    robot: Robot,
    ports: Ports,
) -> dict[str, OutputPort]:
    """Adds the sensors to a robot with these ports; returns what they give."""
    run, given = Run(scenario.plant.time_step, scenario.seed, scenario.duration), {}
    for name, sensor in scenario.sensors.by_name.items():
        given |= sensor.add(builder, name, robot, ports, run)
    return given


def add_sensor_effects(
    builder: DiagramBuilder,
    scenario: Scenario,
    robot: Robot,
    ports: Ports,
) -> dict[str, OutputPort]:
    """Adds the robot's effects in its sensors; returns what these sensors give then instead."""
    resolved = scenario.robot.effects_of(SensorEffect, robot.description, key="robot")
    if not resolved:
        return {}
    measured = {
        name: ports[port]
        for name in ("joint_state", "imu", "pad_force", "motor_position")
        if (port := f"measured_{name}") in ports
    }
    system = SensorEffects(
        resolved,
        robot,
        scenario.control.period,
        imu="imu" in measured,
        motor_encoders="motor_position" in measured,
    )
    effects = builder.AddNamedSystem("sensor_effects", system)
    torques = {name: ports[name] for name in ("torque_command", "friction")}
    truth = {"true_joint_state": ports["joint_state"]}
    connect_by_name(builder, measured | torques | truth, effects)
    split = builder.AddNamedSystem("distorted", Demultiplexer(list(system.sizes.values())))
    builder.Connect(effects.get_output_port(), split.get_input_port())
    return {f"measured_{name}": split.get_output_port(i) for i, name in enumerate(system.sizes)}


def add_reference(
    builder: DiagramBuilder,
    reference: Reference | RecordedReference,
    time_step: float,
) -> dict[str, OutputPort]:
    """Adds what the robot is asked for; returns `desired_state` and what comes with it."""
    return outputs_by_name(builder.AddNamedSystem("reference", reference.source(time_step)))


def add_controller(
    builder: DiagramBuilder,
    scenario: Scenario,
    robot: SimulatedRobot,
    ports: Ports,
) -> PositionLoop:
    """Adds the position loop, which commands the robot; its `friction_estimate` stays open."""
    config, names = scenario.control, robot.robot.description
    wanted = ["desired_state", "enabled"]
    if config.feedforward:
        wanted.append("feedforward_torque")
    given = {name: ports[name] for name in wanted if name in ports}
    system = PositionLoop(config, names, scenario.plant.time_step, given)
    controller = builder.AddNamedSystem("controller", system)
    builder.Connect(ports["measured_joint_state"], controller.GetInputPort("estimated_state"))
    for name, port in given.items():
        builder.Connect(port, controller.GetInputPort(name))
    builder.Connect(controller.get_output_port(), robot.torque_command)
    return controller


def _estimation_period(scenario: Scenario, names: RobotDescription) -> float:
    """The fewest whole periods of the control in which all joints and feet are read [s].

    So often an estimator ticks: with held readings it would compare what was not at the same time.
    (The base moves so slowly that an IMU may be late.)
    """
    sensors, control = scenario.sensors, required(scenario.control.period, "control.period")
    slowest = required(sensors.encoders.period, "sensors.encoders.period")
    if names.legs:
        slowest = max(slowest, required(sensors.foot_force.period, "sensors.foot_force.period"))
    return control * max(math.ceil(slowest / control - 1e-6), 1)


def add_estimator(
    builder: DiagramBuilder,
    estimator: EstimatorDiagram | None,
    ports: Ports,
) -> dict[str, OutputPort]:
    """Adds the friction estimator; returns its estimates."""
    if estimator is None:
        return {}
    builder.AddNamedSystem("estimator", estimator)
    with located("estimator: "):
        connect_by_name(builder, ports, estimator)
    return outputs_by_name(estimator)


def add_compensation(
    builder: DiagramBuilder,
    scenario: Scenario,
    names: RobotDescription,
    controller: PositionLoop,
    ports: Ports,
) -> None:
    """Adds what the controller makes of the estimate; without it, an input of the station."""
    target = controller.GetInputPort("friction_estimate")
    with located("compensation: "):
        system = scenario.compensation.system(names, Clock.every(scenario.control.period))
        if system is None:
            builder.ExportInput(target, "friction_estimate")
            return
        builder.AddNamedSystem("compensation", system)
        connect_by_name(builder, ports, system)
        if not system.HasOutputPort("torque"):
            found = ", ".join(outputs_by_name(system)) or "none"
            raise InputError(f"expected an output port torque, found {found}")
    builder.Connect(system.GetOutputPort("torque"), target)


def add_meshcat(builder: DiagramBuilder, meshcat: Meshcat | None) -> None:
    """Adds what draws the robot, where it is to be drawn."""
    if meshcat is None:
        return
    parameters = MeshcatVisualizerParams(publish_period=1 / 32)
    scene_graph = builder.GetSubsystemByName("scene_graph")
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)


def export(builder: DiagramBuilder, ports: Ports) -> None:
    """Makes those of the ports that are in the table of signals output ports of the station."""
    for name in signals.ports():
        if name in ports:
            builder.ExportOutput(ports[name], name)
