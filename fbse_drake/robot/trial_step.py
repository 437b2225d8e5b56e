"""Steps of a robot's plant, tried before they are made."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, Diagram

from fbse_drake.robot.plant import Robot
from fbse_drake.robot.push import AppliedPushes, Forces


class TrialStep:
    """Tells at what velocity of the joints a step of a robot's plant would end.

    Args:
        robot: one like it, whose plant updates discrete variables alone (no sampled output ports).
        diagram: with this robot on the same ground.
        pushes: what pushes it.
    """

    def __init__(self, robot: Robot, diagram: Diagram, pushes: AppliedPushes):
        self._robot, self._diagram, self._pushes = robot, diagram, pushes
        self._joint_velocity = robot.plant.num_positions() + robot.velocity_index

    def allocate(self) -> AbstractValue:
        """The context that trials are computed in, one after the other."""
        context, plant = self._diagram.CreateDefaultContext(), self._robot.plant
        wanted = plant.get_desired_state_input_port(self._robot.base.model_instance())
        wanted.FixValue(plant.GetMyMutableContextFromRoot(context), np.zeros(wanted.size()))
        return AbstractValue.Make(context)

    def joint_velocity(
        self,
        context: Context,
        time: float,
        state: np.ndarray,
        torque: np.ndarray,
        offset: np.ndarray,
        force: np.ndarray,
    ) -> np.ndarray:
        """Velocities of the joints at the end of a step, (n,) [rad/s].

        Args:
            context: see `allocate`.
            time, state: of the plant when the step begins [s].
            torque: of the motors, (n,) [Nm].
            offset: of the clamps, (m, n) [Nm], see `ImplicitTorque`.
            force: generalized force beside these, (velocities,) [Nm], [N].
        """
        robot, plant = self._robot, self._robot.plant
        now, end = plant.GetMyMutableContextFromRoot(context), plant.AllocateDiscreteVariables()
        actuation = robot.actuation_selector @ torque + robot.clamp_selector @ offset.ravel()
        plant.get_actuation_input_port().FixValue(now, actuation)
        plant.get_applied_generalized_force_input_port().FixValue(now, force)
        pushes = plant.get_applied_spatial_force_input_port()
        pushes.FixValue(now, Forces(self._pushes.forces(time)))
        plant.SetPositionsAndVelocities(now, state)
        plant.CalcForcedDiscreteVariableUpdate(now, end)
        return end.value(0)[self._joint_velocity]
