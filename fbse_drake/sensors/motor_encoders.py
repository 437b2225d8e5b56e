"""Second encoders of the joints, on the motors' side of the gears; few robots have them.

Beside them the usual encoders (`sensors.encoders`) are on the links' side, and what the
transmissions give is the difference of the two.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem

from fbse_drake.errors import require_not_negative, require_positive, required
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.encoders import quantize
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise
from fbse_drake.sensors.sensor import Run, Sensor, in_library
from fbse_drake.signals import Signal, signals_of
from fbse_drake.wiring import weakly


@in_library
@dataclass(frozen=True)
class MotorEncoderConfig(Sensor):
    """Angles are read as `resolution * round((angle + noise) / resolution)`; all of them as they
    are on the joint's side of the gear."""

    has_own_key: ClassVar[bool] = True
    signals: ClassVar[tuple[Signal, ...]] = signals_of("measured_motor_position")
    whole_steps: ClassVar[tuple[str, ...]] = ("period",)

    # One count [rad], divided by the gear's ratio; 0 reads exactly.
    resolution: float = 0.0
    # Standard deviation of the angle before it is rounded [rad].
    noise: float = 0.0
    # Sampling period [s], held in between; by default `Scenario.usual_period`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_not_negative(self, "resolution", "noise")
        require_positive(self, "period")

    @property
    def angle_noise(self) -> float:
        """Standard deviation of an angle as it is read [rad]."""
        return math.hypot(self.noise, self.resolution / math.sqrt(12.0))

    def system(self, robot: Robot, run: Run) -> "MotorEncoders":
        return MotorEncoders(self, len(robot.joint_names), run)


class MotorAngles(LeafSystem):
    """Counts of encoders on the motors' side.

    .. pydrake_system::

        name: MotorAngles
        input_ports:
        - joint_state
        - deflection
        - error
        output_ports:
        - measured_motor_position

    `joint_state` is [positions, velocities], shape (2n,) [rad, rad/s]; `deflection` (n,) [rad] is
    by how much the motors are ahead of their links; `error` (n,) [rad] is added before the angle,
    (n,) [rad], is rounded.
    """

    def __init__(self, resolution: float, joints: int):
        super().__init__()
        self._resolution, self._n = resolution, joints
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * joints)
        self._others = [
            self.DeclareVectorInputPort(name, joints) for name in ("deflection", "error")
        ]
        self.DeclareVectorOutputPort("measured_motor_position", joints, weakly(self._calc))

    def _calc(self, context: Context, output: BasicVector) -> None:
        angle = self._joint_state.Eval(context)[: self._n]
        angle = np.sum([angle, *(port.Eval(context) for port in self._others)], axis=0)
        output.SetFromVector(quantize(angle, self._resolution))


class MotorEncoders(Diagram):
    """`MotorAngles` with their noise, whose other ports it has.

    .. pydrake_system::

        name: MotorEncoders
        input_ports:
        - joint_state
        - deflection
        output_ports:
        - measured_motor_position
    """

    def __init__(self, config: MotorEncoderConfig, joints: int, run: Run):
        super().__init__()
        builder = DiagramBuilder()
        angles = builder.AddNamedSystem("angles", MotorAngles(config.resolution, joints))
        period = required(config.period, "period")
        ticks = ticks_until(run.duration, period)
        noise = config.noise * white_noise(run.seed, "motor encoders", ticks, joints)
        errors = builder.AddNamedSystem("errors", held_signal(noise, period))
        builder.Connect(errors.get_output_port(), angles.GetInputPort("error"))
        for name in ("joint_state", "deflection"):
            builder.ExportInput(angles.GetInputPort(name), name)
        builder.ExportOutput(angles.get_output_port(), "measured_motor_position")
        builder.BuildInto(self)
