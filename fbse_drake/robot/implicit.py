"""Joint torques that Drake's contact solver takes at the velocity that comes out of its step."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuator, PdControllerGains


@dataclass(frozen=True)
class ImplicitTorque:
    """Torque losses of n joints that grow with their velocities v,

        u = damping v + sum over clamps of clip(slope v + offset, -limit, limit).

    Drake's contact solver takes them implicitly, together with contact, so they may be as steep as
    they like: damping is the joint's own, and each clamp is an actuator with a derivative gain and
    an effort limit.
    """

    # Shape (n,) [Nm s/rad].
    damping: np.ndarray
    # Up to m clamps for each joint, (m, n) each [Nm s/rad], [Nm], [Nm]; one with limit 0 is none.
    slope: np.ndarray
    limit: np.ndarray
    # Offsets of clamps that stay where they are.
    offset: np.ndarray

    @classmethod
    def none(cls, joints: int) -> "ImplicitTorque":
        """No loss in so many joints."""
        return cls(np.zeros(joints), *np.zeros((3, 0, joints)))

    @property
    def has_clamp(self) -> np.ndarray:
        """Shape (m, n), bool."""
        return self.limit > 0

    def torque(self, velocity: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Loss at velocities (n,) [rad/s] with offsets (m, n) [Nm], shape (n,) [Nm]."""
        return implicit_loss(velocity, self.damping, self.slope, self.limit, offset)


@njit(cache=True)
def implicit_loss(
    velocity: np.ndarray,
    damping: np.ndarray,
    slope: np.ndarray,
    limit: np.ndarray,
    offset: np.ndarray,
) -> np.ndarray:
    """The sum of `ImplicitTorque`."""
    result = damping * velocity
    for k in range(len(slope)):
        for j in range(len(velocity)):
            torque = slope[k, j] * velocity[j] + offset[k, j]
            result[j] += min(max(torque, -limit[k, j]), limit[k, j])
    return result


def clamp_name(joint: str, row: int) -> str:
    """Name of the actuator that is a joint's clamp in a row of `ImplicitTorque.limit`."""
    return f"{joint}_loss_{row}"


def add_implicit_torque(
    plant: MultibodyPlant,
    joint_names: Sequence[str],
    motors: Mapping[str, JointActuator],
    torque: ImplicitTorque,
) -> None:
    """Gives a plant's joints, before it is finalized, their damping and clamps.

    Args:
        motors: the joints' actuators by joint. Each clamp repeats their rotor inertia, for Drake
            takes that of a joint's last actuator.
    """
    for j, name in enumerate(joint_names):
        motor = motors[name]
        motor.joint().set_default_damping_vector(torque.damping[j : j + 1])
        for row in np.flatnonzero(torque.has_clamp[:, j]).tolist():
            limit, gains = torque.limit[row, j], PdControllerGains(p=0.0, d=torque.slope[row, j])
            clamp = plant.AddJointActuator(clamp_name(name, row), motor.joint(), limit)
            clamp.set_default_rotor_inertia(motor.default_rotor_inertia())
            clamp.set_default_gear_ratio(motor.default_gear_ratio())
            clamp.set_controller_gains(gains)
