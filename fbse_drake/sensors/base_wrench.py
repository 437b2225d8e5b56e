"""A six-axis sensor between a fixed robot's base and what it stands on."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.tree import WeldJoint
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Adder

from fbse_drake.errors import InputError, require_not_negative, require_positive
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise
from fbse_drake.sensors.sensor import Run, Sensor, in_library
from fbse_drake.signals import Signal, signals_of
from fbse_drake.wiring import weakly


@in_library
@dataclass(frozen=True)
class BaseWrench(Sensor):
    """Errors of each axis; the defaults measure exactly.

    Measured is the wrench [moment, force] of the ground on the robot, at the base's origin in the
    base's axes.
    """

    signals: ClassVar[tuple[Signal, ...]] = signals_of("measured_base_wrench")

    # Standard deviation of white noise of force [N] and moment [Nm].
    noise: float = 0.0
    moment_noise: float = 0.0
    # Sampling period [s], held in between; by default `Scenario.usual_period`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_not_negative(self, "noise", "moment_noise")
        require_positive(self, "period")

    def system(self, robot: Robot, run: Run) -> "BaseWrenchSensor":
        return BaseWrenchSensor(self, robot, run)


class BaseReaction(LeafSystem):
    """The wrench that holds a fixed base, of the plant step that ended.

    .. pydrake_system::

        name: BaseReaction
        input_ports:
        - reaction_forces
        output_ports:
        - wrench

    `wrench` (6,) is [moment, force] [Nm, N] of the ground on the robot at the base's origin, in the
    base's axes.
    """

    def __init__(self, robot: Robot):
        """Finds where the base is held.

        Raises:
            InputError: its base is not held.
        """
        super().__init__()
        plant, base = robot.plant, robot.base
        # Reactions are counted without the joints that were taken out of the model.
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        held = [
            (number, joint)
            for number, joint in enumerate(joints)
            if isinstance(joint, WeldJoint) and joint.child_body().index() == base.index()
        ]
        if not held:
            raise InputError("a base wrench needs a robot whose base is fixed (fixed_base: true)")
        ((self._joint, weld),) = held
        # From the joint's frame on the base to the base.
        self._X_BJ = weld.frame_on_child().CalcPoseInBodyFrame(plant.CreateDefaultContext())
        self._reactions = self.DeclareAbstractInputPort(
            "reaction_forces", Value([SpatialForce.Zero()])
        )
        sources = {self.input_port_ticket(self._reactions.get_index())}
        self.DeclareVectorOutputPort("wrench", 6, weakly(self._calc), sources)

    def _calc(self, context: Context, output: BasicVector) -> None:
        reactions: Any = self._reactions.Eval(context)
        F_J = reactions[self._joint]
        R, p = self._X_BJ.rotation().matrix(), self._X_BJ.translation()
        force = R @ F_J.translational()
        moment = R @ F_J.rotational() + np.cross(p, force)
        wrench: Any = np.concatenate([moment, force])
        output.SetFromVector(wrench)


class BaseWrenchSensor(Diagram):
    """A base's reaction with the sensor's noise.

    .. pydrake_system::

        name: BaseWrenchSensor
        input_ports:
        - reaction_forces
        output_ports:
        - measured_base_wrench

    `measured_base_wrench` (6,) as `BaseReaction` has it.
    """

    def __init__(self, config: BaseWrench, robot: Robot, run: Run):
        super().__init__()
        period = config.period or run.time_step
        builder = DiagramBuilder()
        true = builder.AddNamedSystem("true", BaseReaction(robot))
        sizes = np.repeat([config.moment_noise, config.noise], 3)
        ticks = ticks_until(run.duration, period)
        noise = sizes * white_noise(run.seed, "base wrench", ticks, 6)
        errors = builder.AddNamedSystem("errors", held_signal(noise, period))
        noisy = builder.AddNamedSystem("noisy", Adder(2, 6))
        builder.Connect(true.get_output_port(), noisy.get_input_port(0))
        builder.Connect(errors.get_output_port(), noisy.get_input_port(1))
        builder.ExportInput(true.get_input_port(), "reaction_forces")
        builder.ExportOutput(noisy.get_output_port(), "measured_base_wrench")
        builder.BuildInto(self)
