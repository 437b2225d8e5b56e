"""What a machine on a fixed base did, and the torques that this takes."""

from dataclasses import dataclass

import numpy as np
from pydrake.multibody.tree import MultibodyForces

from fbse_drake.robot.plant import Robot

# A joint swings with so many sines, of multiples of a frequency in this range [Hz].
_SINES, _LOWEST = 3, (0.15, 0.3)


@dataclass(frozen=True)
class Course:
    """What a machine did: (N, n) each, but for the time; torques are those that its links got."""

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray

    @property
    def period(self) -> float:
        return float(self.time[1] - self.time[0])

    def rate(self, values: np.ndarray) -> np.ndarray:
        """Derivative of what was sampled."""
        return np.gradient(values, self.period, axis=0, edge_order=2)


def swings(
    random: np.random.Generator, time: np.ndarray, posture: np.ndarray, amplitude: np.ndarray
) -> np.ndarray:
    """Every joint swings with several sines about its posture.

    Args:
        time: (N,) [s]; posture, amplitude: (n,) [rad] or [m].

    Returns:
        Positions, velocities and accelerations, (3, N, n).
    """
    motion = np.zeros((3, len(time), len(posture)))
    motion[0] += posture
    for joint, size in enumerate(amplitude):
        shares, lowest = random.uniform(0.4, 1.0, _SINES), random.uniform(*_LOWEST)
        for k, share in enumerate(shares / shares.sum(), 1):
            pulsation, phase = 2 * np.pi * k * lowest, random.uniform(0, 2 * np.pi)
            for order in range(3):
                wave = np.sin(pulsation * time + phase + 0.5 * np.pi * order)
                motion[order, :, joint] += size * share * pulsation**order * wave
    return motion


def inverse_dynamics(
    robot: Robot, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> np.ndarray:
    """Torques that a motion needs, (N, n)."""
    plant, context = robot.plant, robot.plant.CreateDefaultContext()
    forces, result = MultibodyForces(plant), np.empty_like(position)
    at, of = robot.position_index, robot.velocity_index
    q, v, a = np.zeros(plant.num_positions()), *np.zeros((2, plant.num_velocities()))
    for k in range(len(position)):
        q[at], v[of], a[of] = position[k], velocity[k], acceleration[k]
        plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        plant.CalcForceElementsContribution(context, forces)
        result[k] = plant.CalcInverseDynamics(context, a, forces)[of]
    return result
