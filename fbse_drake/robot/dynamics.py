"""Kinematics and inverse dynamics of a plant at many instants, by Drake."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

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


@dataclass(frozen=True)
class Quantity:
    """A function of a plant's state."""

    shape: tuple[int, ...]
    # Of the state that the plant is in, the k-th of several.
    at: Callable[[int], np.ndarray]


class PlantDynamics:
    """What the equation of motion of a plant takes, at M instants."""

    def __init__(self, plant: MultibodyPlant):
        """Takes a finalized plant, with its default parameters."""
        self._plant, self._context = plant, plant.CreateDefaultContext()

    def evaluated(self, quantities: Sequence[Quantity], states: np.ndarray) -> list[np.ndarray]:
        """Values of several quantities, (M, ...) each.

        State by state: the kinematics that Drake finds for one of them serve the others.

        Args:
            states: positions and velocities of the plant, (M, positions + velocities), or
                positions alone where no quantity depends on more.
        """
        plant, context = self._plant, self._context
        whole = states.shape[1] == plant.num_multibody_states()
        take = plant.SetPositionsAndVelocities if whole else plant.SetPositions
        results = [np.empty((len(states), *quantity.shape)) for quantity in quantities]
        for k, state in enumerate(states if quantities else ()):
            take(context, state)
            for result, quantity in zip(results, quantities, strict=True):
                result[k] = quantity.at(k)
        return results

    def required_forces(self, accelerations: np.ndarray, *, forces: bool) -> Quantity:
        """Generalized forces that a motion needs, (velocities,).

        Args:
            accelerations: of each state, (M, velocities).
            forces: is there what its gravity, springs and dampers give?
        """
        plant, context, given = self._plant, self._context, MultibodyForces(self._plant)

        def at(k: int) -> np.ndarray:
            if forces:
                plant.CalcForceElementsContribution(context, given)
            return plant.CalcInverseDynamics(context, accelerations[k], given)

        return Quantity((plant.num_velocities(),), at)

    def jacobian(self, frame: Frame) -> Quantity:
        """Of the spatial velocity [angular, linear] of a frame of the plant in the world, in its
        own axes, (6, velocities)."""
        calculate, how = self._plant.CalcJacobianSpatialVelocity, self._how(frame)
        return Quantity((6, self._plant.num_velocities()), lambda _: calculate(*how))

    def bias_acceleration(self, frame: Frame) -> Quantity:
        """Spatial acceleration [angular, linear] of a frame in the world without any accelerations
        of joints, in its own axes, (6,)."""
        calculate, how = self._plant.CalcBiasSpatialAcceleration, self._how(frame)
        return Quantity((6,), lambda _: calculate(*how).get_coeffs())

    def _how(self, frame: Frame) -> tuple[Any, ...]:
        """For Drake: of the frame's origin, in the world, in the frame's axes."""
        world = self._plant.world_frame()
        return self._context, JacobianWrtVariable.kV, frame, np.zeros(3), world, frame

    def gravity_forces(self) -> Quantity:
        """Generalized forces per acceleration of gravity along each axis of the world, (3,
        velocities) [kg, kg m]."""
        plant, context, world = self._plant, self._context, self._plant.world_frame()
        mass, how = plant.CalcTotalMass(context), (JacobianWrtVariable.kV, world, world)
        calculate = plant.CalcJacobianCenterOfMassTranslationalVelocity
        return Quantity((3, plant.num_velocities()), lambda _: mass * calculate(context, *how))

    def mass_matrix(self) -> Quantity:
        """Of the plant, (velocities, velocities)."""
        size, calculate = self._plant.num_velocities(), self._plant.CalcMassMatrix
        return Quantity((size, size), lambda _: calculate(self._context))

    def rotation(self, frame: Frame) -> Quantity:
        """Orientation R_WS of a frame S in the world W, (3, 3)."""
        calculate = frame.CalcRotationMatrixInWorld
        return Quantity((3, 3), lambda _: calculate(self._context).matrix())
