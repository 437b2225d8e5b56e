"""The closed loop as a Drake diagram: robot, sensors, controller, reference."""

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer, MatrixGain

from fbse_drake.control.compensation import FrictionCompensation, NoCompensation
from fbse_drake.control.position_loop import PositionLoop
from fbse_drake.effects.contact import contact_with_effects
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.effects.sensor import SensorEffect, SensorEffects
from fbse_drake.effects.system import JointTorqueEffects, conservative_inertia
from fbse_drake.errors import InputError, located
from fbse_drake.estimators.estimator import EstimatorDiagram, make_estimator
from fbse_drake.estimators.recursive import Clock
from fbse_drake.robot.plant import Ground, Robot
from fbse_drake.scenario import Scenario, build_robot
from fbse_drake.sensors.encoders import Encoders
from fbse_drake.sensors.foot_force import FootForceSensors
from fbse_drake.sensors.imu import Imu
from fbse_drake.sensors.joint_torque import JointTorqueSensors
from fbse_drake.walking.reference import Reference, ReferenceSource, make_reference


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
        - true_pad_force
        - torque_loss

    Sensor and controller ports come first, what a real robot would not tell (plant state, acceleration, ideal pad forces, torque
    loss of the effects) comes last. `friction_estimate` (n,) [Nm] is added to the command and may be left unconnected; a station that
    compensates its own estimate does not have it. A station with an estimator also has a port for each of `estimator.channels`, see
    `EstimatorDiagram`; one with joint torque sensors has `measured_torque`.
    """

    robot: Robot
    model: Robot
    reference: Reference
    # None without an estimator.
    estimator: EstimatorDiagram | None

    def __init__(self, scenario: Scenario, meshcat: Meshcat | None = None):
        super().__init__()
        builder = DiagramBuilder()
        config = scenario.robot
        with located("robot: "):
            ground, settings = contact_with_effects(config.effects.values(), scenario.ground, scenario.plant, config.description)
            self.robot = build_robot(config, builder=builder, plant=settings, ground=ground)
        with located("model: "):
            self.model = build_robot(scenario.believed)
            if self.model.joint_names != self.robot.joint_names:
                raise InputError(f"expected the robot's joints {self.robot.joint_names}, found {self.model.joint_names}")
        with located("reference: "):
            ticks = round(scenario.duration / scenario.control.period)
            self.reference = make_reference(scenario.reference, self.model, np.arange(ticks + 1) * scenario.control.period)
        robot, names, time_step = self.robot, self.robot.description, scenario.plant.time_step
        n, plant = len(robot.joint_names), self.robot.plant
        _set_initial_state(robot, self.reference, ground)

        joint_state = builder.AddNamedSystem("joint_state", MatrixGain(robot.joint_state_selector))
        builder.Connect(plant.get_state_output_port(), joint_state.get_input_port())

        # Physical effects.
        context = plant.CreateDefaultContext()
        inertia = conservative_inertia(robot.joint_compliance(context))
        resolved = [
            effect.resolve(names, key=f"robot.effects.{key}")
            for key, effect in config.effects.items()
            if isinstance(effect, JointTorqueEffect)
        ]
        effects = builder.AddNamedSystem("effects", JointTorqueEffects(resolved, inertia, time_step))
        loss_to_force = builder.AddNamedSystem("torque_loss_to_force", MatrixGain(-robot.joint_force_selector))
        builder.Connect(joint_state.get_output_port(), effects.GetInputPort("joint_state"))
        builder.Connect(effects.get_output_port(), loss_to_force.get_input_port())
        builder.Connect(loss_to_force.get_output_port(), plant.get_applied_generalized_force_input_port())

        # Sensors.
        draw = (scenario.seed, scenario.duration)
        encoders = builder.AddNamedSystem("encoders", Encoders(scenario.sensors.encoders, n, *draw))
        builder.Connect(joint_state.get_output_port(), encoders.get_input_port())
        imu = builder.AddNamedSystem("imu", Imu(scenario.sensors.imu, robot, *draw))
        for name in ("body_poses", "body_spatial_velocities", "body_spatial_accelerations"):
            builder.Connect(plant.GetOutputPort(name), imu.GetInputPort(name))
        if names.legs:
            foot_force = builder.AddNamedSystem("foot_force", FootForceSensors(scenario.sensors.foot_force, robot, time_step, *draw))
            builder.Connect(plant.get_reaction_forces_output_port(), foot_force.get_input_port())
            pad_force = {name: foot_force.GetOutputPort(name) for name in ("measured_pad_force", "true_pad_force")}
        else:
            no_force = builder.AddNamedSystem("no_foot_force", ConstantVectorSource(np.zeros(0)))
            pad_force = dict.fromkeys(("measured_pad_force", "true_pad_force"), no_force.get_output_port())
        available = {
            "measured_joint_state": encoders.get_output_port(),
            "measured_imu": imu.get_output_port(),
            "measured_pad_force": pad_force["measured_pad_force"],
        }
        distorting = [
            effect.resolve(names, key=f"robot.effects.{key}") for key, effect in config.effects.items() if isinstance(effect, SensorEffect)
        ]
        if distorting:
            sensor_effects = builder.AddNamedSystem("sensor_effects", SensorEffects(distorting, robot, scenario.control.period))
            for name, port in available.items():
                builder.Connect(port, sensor_effects.GetInputPort(name.removeprefix("measured_")))
            # A robot without feet has no forces there to split off.
            sizes = {name: port.size() for name, port in available.items() if port.size() > 0}
            split = builder.AddNamedSystem("distorted", Demultiplexer(list(sizes.values())))
            builder.Connect(sensor_effects.get_output_port(), split.get_input_port())
            available |= {name: split.get_output_port(i) for i, name in enumerate(sizes)}

        # Reference and controller.
        source = builder.AddNamedSystem("reference", ReferenceSource(self.reference))
        controller = builder.AddNamedSystem("controller", PositionLoop(scenario.control, names, time_step))
        command = builder.AddNamedSystem("torque_to_actuation", MatrixGain(robot.actuation_selector))
        builder.Connect(available["measured_joint_state"], controller.GetInputPort("estimated_state"))
        builder.Connect(source.GetOutputPort("desired_state"), controller.GetInputPort("desired_state"))
        if scenario.control.feedforward:
            builder.Connect(source.GetOutputPort("feedforward_torque"), controller.GetInputPort("feedforward_torque"))
        builder.Connect(controller.get_output_port(), command.get_input_port())
        builder.Connect(controller.get_output_port(), effects.GetInputPort("torque_command"))
        builder.Connect(command.get_output_port(), plant.get_actuation_input_port())
        if distorting:
            builder.Connect(controller.get_output_port(), sensor_effects.GetInputPort("torque_command"))

        # Estimator and compensation.
        period = scenario.control.period
        self.estimator = make_estimator(scenario.estimator, self.model, period=period, plan=self.reference.plan)
        available |= {"torque_command": controller.get_output_port(), "torque_loss": effects.get_output_port()}
        if scenario.sensors.joint_torque is not None:
            sensors = JointTorqueSensors(scenario.sensors.joint_torque, n, time_step, *draw)
            torque_sensors = builder.AddNamedSystem("joint_torque_sensors", sensors)
            for name in ("torque_command", "torque_loss"):
                builder.Connect(available[name], torque_sensors.GetInputPort(name))
            available["measured_torque"] = torque_sensors.get_output_port()
            builder.ExportOutput(torque_sensors.get_output_port(), "measured_torque")
        if self.estimator is not None:
            builder.AddNamedSystem("estimator", self.estimator)
            for i in range(self.estimator.num_input_ports()):
                port = self.estimator.get_input_port(i)
                builder.Connect(available[port.get_name()], port)
            for channel in self.estimator.channels:
                builder.ExportOutput(self.estimator.GetOutputPort(channel), channel)
        if self.estimator is not None and not isinstance(scenario.compensation, NoCompensation):
            compensation = FrictionCompensation(scenario.compensation, names, Clock(period, period * (1 - 1e-6)))
            builder.AddNamedSystem("compensation", compensation)
            torque = builder.AddNamedSystem("compensation_torque", Demultiplexer([1, n]))
            builder.Connect(self.estimator.GetOutputPort("friction_estimate"), compensation.get_input_port())
            builder.Connect(compensation.get_output_port(), torque.get_input_port())
            builder.Connect(torque.get_output_port(1), controller.GetInputPort("friction_estimate"))
        else:
            builder.ExportInput(controller.GetInputPort("friction_estimate"), "friction_estimate")

        for name in ("measured_joint_state", "measured_imu", "measured_pad_force"):
            builder.ExportOutput(available[name], name)
        builder.ExportOutput(controller.get_output_port(), "torque_command")
        builder.ExportOutput(source.GetOutputPort("desired_state"), "desired_state")
        builder.ExportOutput(source.GetOutputPort("feedforward_torque"), "feedforward_torque")
        builder.ExportOutput(plant.get_state_output_port(), "plant_state")
        builder.ExportOutput(plant.get_generalized_acceleration_output_port(), "generalized_acceleration")
        builder.ExportOutput(pad_force["true_pad_force"], "true_pad_force")
        builder.ExportOutput(effects.get_output_port(), "torque_loss")
        if meshcat is not None:
            parameters = MeshcatVisualizerParams(publish_period=1 / 32)
            MeshcatVisualizer.AddToBuilder(builder, builder.GetSubsystemByName("scene_graph"), meshcat, parameters)
        builder.BuildInto(self)


def build_station(scenario: Scenario, *, meshcat: Meshcat | None = None) -> Station:
    """Builds the closed loop of a scenario.

    Args:
        meshcat: also draws the robot there.

    Raises:
        InputError: a part of the scenario that does not fit the robot, or a motion that it cannot make.
    """
    return Station(scenario, meshcat)


def _set_initial_state(robot: Robot, reference: Reference, ground: Ground) -> None:
    """Makes the plant's default state the start of the reference, standing where the ground carries the weight."""
    plant = robot.plant
    context = plant.CreateDefaultContext()
    if robot.has_floating_base:
        pads = sum(leg.points for leg in robot.description.legs.values())
        weight = -plant.CalcTotalMass(context) * plant.gravity_field().gravity_vector()[2]
        penetration = weight / (pads * ground.stiffness)
        p_WB = reference.base.position[0] - [0.0, 0.0, penetration]
        plant.SetPositions(context, robot.base_pose_positions(RigidTransform(p_WB)))
    robot.set_joint_positions(context, reference.joint_position[0])
    plant.SetDefaultPositions(plant.GetPositions(context))
