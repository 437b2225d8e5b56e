"""Kinematics and inverse dynamics of a plant at many instants, by Drake."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable, MultibodyForces


@dataclass(frozen=True)
class KinematicPath:
    """Places in a plant's positions and velocities of the joints between a frame and the world."""

    positions: np.ndarray
    velocities: np.ndarray


def path(plant: MultibodyPlant, frame: Frame) -> KinematicPath:
    """Of a frame of a finalized plant; its motion in the world depends on nothing else."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    positions: list[int] = []
    velocities: list[int] = []
    for joint in (joint for joint in joints if joint.num_velocities()):
        if frame.body().index() in plant.GetBodiesKinematicallyAffectedBy([joint.index()]):
            q, v = joint.position_start(), joint.velocity_start()
            positions += range(q, q + joint.num_positions())
            velocities += range(v, v + joint.num_velocities())
    return KinematicPath(np.array(positions, dtype=int), np.array(velocities, dtype=int))


class PlantDynamics:
    """What the equation of motion of a plant takes, at M instants."""

    def __init__(self, plant: MultibodyPlant):
        """Takes a finalized plant, with its default parameters."""
        self._plant, self._context = plant, plant.CreateDefaultContext()

    def inverse_dynamics(
        self, states: np.ndarray, accelerations: np.ndarray, *, forces: bool
    ) -> np.ndarray:
        """Generalized forces that a motion needs, (M, velocities).

        Args:
            states: positions and velocities of the plant, (M, positions + velocities).
            accelerations: (M, velocities).
            forces: is there what its gravity, springs and dampers give?
        """
        plant, context, given = self._plant, self._context, MultibodyForces(self._plant)
        result = np.empty(accelerations.shape)
        for k, (state, acceleration) in enumerate(zip(states, accelerations, strict=True)):
            plant.SetPositionsAndVelocities(context, state)
            if forces:
                plant.CalcForceElementsContribution(context, given)
            result[k] = plant.CalcInverseDynamics(context, acceleration, given)
        return result

    def jacobians(self, frames: Sequence[Frame], positions: np.ndarray) -> np.ndarray:
        """Jacobian of the spatial velocity [angular, linear] of some frames of the plant in the
        world, in their own axes, (frames, M, 6, velocities)."""
        plant, context, world = self._plant, self._context, self._plant.world_frame()
        result = np.empty((len(frames), len(positions), 6, plant.num_velocities()))
        for k, position in enumerate(positions):
            plant.SetPositions(context, position)
            for f, frame in enumerate(frames):
                result[f, k] = plant.CalcJacobianSpatialVelocity(
                    context, JacobianWrtVariable.kV, frame, np.zeros(3), world, frame
                )
        return result

    def mass_matrices(self, positions: np.ndarray) -> np.ndarray:
        """Mass matrix of the plant, (M, velocities, velocities)."""
        velocities = self._plant.num_velocities()
        result = np.empty((len(positions), velocities, velocities))
        for k, position in enumerate(positions):
            self._plant.SetPositions(self._context, position)
            result[k] = self._plant.CalcMassMatrix(self._context)
        return result

    def bias_accelerations(self, frames: Sequence[Frame], states: np.ndarray) -> np.ndarray:
        """Spatial acceleration [angular, linear] of some frames in the world without any
        accelerations of joints, in their own axes, (frames, M, 6)."""
        plant, context, world = self._plant, self._context, self._plant.world_frame()
        result = np.empty((len(frames), len(states), 6))
        for k, state in enumerate(states):
            plant.SetPositionsAndVelocities(context, state)
            for f, frame in enumerate(frames):
                bias = plant.CalcBiasSpatialAcceleration(
                    context, JacobianWrtVariable.kV, frame, np.zeros(3), world, frame
                )
                result[f, k] = bias.get_coeffs()
        return result

    def rotations(self, frames: Sequence[Frame], positions: np.ndarray) -> np.ndarray:
        """Orientation R_WS of some frames S in the world W, (frames, M, 3, 3)."""
        result = np.empty((len(frames), len(positions), 3, 3))
        for k, position in enumerate(positions):
            self._plant.SetPositions(self._context, position)
            for f, frame in enumerate(frames):
                result[f, k] = frame.CalcRotationMatrixInWorld(self._context).matrix()
        return result
