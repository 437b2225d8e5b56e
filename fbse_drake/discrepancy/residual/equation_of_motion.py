"""What the equation of motion leaves over at instants, and the noise that the sensors put into it.

With the base's origin at rest and the measured specific force in the place of gravity (see
`estimators.floating_base`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pydrake.math import RigidTransform

from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.discrepancy.residual.rows import foot_pairs, residual_rows
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.robot.dynamics import PlantDynamics, Quantity, path
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import SensorsConfig
from fbse_drake.sensors.foot_force import wrench_deviations
from fbse_drake.sensors.foot_pads import FootPads

# A sole stands still while it carries more than this share of what it would if all carried alike,
# and each of its pads this share of the weight.
_STANDING = 0.3
_STANDING_PAD = 0.01
# Results that the equation of motion keeps of each of its functions, and instants that are computed
# at once: Jacobians take room.
_REMEMBERED = 3
_MOST_INSTANTS = 20_000
# The noise of so many blocks is calculated at a time, which bounds the matrices that are kept.
_AT_A_TIME = 500


@dataclass(frozen=True)
class Unseen:
    """What happened between readings and commands that a log has: variance of noise in M instants
    that is as bad, see `fbse_drake.held_readings.unseen_variance`."""

    # Of the joints, (M, n) [Nm^2].
    torque: np.ndarray
    # On the base in its axes, (M, 3) [m^2/s^4].
    specific_force: np.ndarray
    # On each sole in its frame, (M, 6) each [Nm^2, N^2].
    wrenches: list[np.ndarray]

    def part(self, instants: slice) -> "Unseen":
        """In some of the instants."""
        wrenches = [wrench[instants] for wrench in self.wrenches]
        return Unseen(self.torque[instants], self.specific_force[instants], wrenches)


@dataclass(frozen=True)
class SensorNoise:
    """What sensor noise puts into each row of one step, in M blocks of steps, to first order; (M,
    rows) each, in the rows' units squared, times s^2 where velocities are meant.

    Rates are differences of velocities: a row has S d/dt of them, with a sensitivity S that depends
    on the posture. Summed over a block, S at its ends counts, and what it changes between.
    """

    # Variance of what is white.
    white: np.ndarray
    # Of S times the velocities' noise, where a block meets the next one.
    at_end: np.ndarray
    # Of the change of S between the centres of a block and the next one times that noise.
    change: np.ndarray

    def of_blocks(self, length: int, period: float) -> tuple[np.ndarray, np.ndarray]:
        """Variance of averages over blocks of so many steps, and their covariance with the next
        one's, (M, rows) each.

        Args:
            period: from one step to the next [s].
        """
        duration = length * period
        at_start = np.concatenate([self.at_end[:1], self.at_end[:-1]])
        changed = 0.5 * (self.change + np.concatenate([self.change[:1], self.change[:-1]]))
        differenced = at_start + self.at_end + changed / length
        variance = self.white / length + differenced / duration**2
        covariance = -self.at_end / duration**2
        covariance[-1] = 0.0
        return variance, covariance


class _Remembered:
    """A function of the plant's state, with its last results by the arrays that they depend on."""

    def __init__(self, quantity: Callable[[np.ndarray], Quantity]):
        """Takes the function by the accelerations of the states, (M, velocities)."""
        self.quantity = quantity
        self.results: Memory[np.ndarray] = Memory(_REMEMBERED)


class _Sole:
    """How a sole moves with the plant.

    An effect that is tried changes some signals. What a sole's motion does not depend on, as on
    those of another leg, does not make it computed again.
    """

    def __init__(self, robot: Robot, dynamics: PlantDynamics, side: str):
        frame = robot.sole(side)
        self._path = path(robot.plant, frame)
        self._jacobian = _Remembered(lambda _: dynamics.jacobian(frame))
        self._bias_acceleration = _Remembered(lambda _: dynamics.bias_acceleration(frame))

    def jacobian(self, positions: np.ndarray) -> "_Wanted":
        """Of the sole's spatial velocity, in its frame, (M, 6, v)."""
        return _Wanted(self._jacobian, (positions[:, self._path.positions].tobytes(),))

    def bias_acceleration(self, positions: np.ndarray, velocities: np.ndarray) -> "_Wanted":
        """Of the sole's spatial acceleration, in its frame, (M, 6)."""
        at = positions[:, self._path.positions], velocities[:, self._path.velocities]
        return _Wanted(self._bias_acceleration, tuple(array.tobytes() for array in at))


@dataclass(frozen=True)
class _Wanted:
    """A function that is wanted at some states, and what its results there depend on."""

    function: _Remembered
    key: tuple[bytes, ...]


class EquationOfMotion:
    """The residual's rows for one model; see the module."""

    def __init__(self, robot: Robot):
        self.robot, plant = robot, robot.plant
        self._context = plant.CreateDefaultContext()
        self.dynamics = PlantDynamics(plant)
        self.pads = FootPads(robot)
        self.weight = plant.CalcTotalMass(self._context) * float(
            np.linalg.norm(plant.gravity_field().gravity_vector())
        )
        self.gravity = float(np.linalg.norm(plant.gravity_field().gravity_vector()))
        n = len(robot.joint_names)
        if robot.has_floating_base:
            mount = ImuMount(robot)
            self.R_BI, self.p_BI = mount.R_BI, mount.p_BI
            start = robot.base.floating_velocities_start_in_v()
            # Place of ours, [base angular, base linear, joints], in the plant's velocities.
            self._order = np.concatenate([np.arange(start, start + 6), robot.velocity_index])
        else:
            self._order = robot.velocity_index
        self._upright = robot.base_pose_positions(RigidTransform())
        self._joints = slice(len(self._order) - n, None)
        self._soles = (
            [_Sole(robot, self.dynamics, side) for side in robot.description.sides]
            if robot.has_floating_base
            else []
        )
        self._pairs = foot_pairs(robot) if robot.has_floating_base else []
        # Without the forces of the feet.
        self._inverse_dynamics = _Remembered(
            partial(self.dynamics.required_forces, forces=not robot.has_floating_base)
        )

    def sole_rotations(self, joint_position: np.ndarray) -> list[np.ndarray]:
        """R_BF of each sole, (M, 3, 3) each, in postures (M, n)."""
        soles = [self.robot.sole(side) for side in self.robot.description.sides]
        positions = np.tile(self._upright, (len(joint_position), 1))
        positions[:, self.robot.position_index] = joint_position
        return self.dynamics.evaluated([*map(self.dynamics.rotation, soles)], positions)

    def wrenches(self, pad_force: np.ndarray) -> list[np.ndarray]:
        """Wrench [moment, force] on each sole in its frame, (M, 6) each, from (M, P, 3)."""
        parts = self.pads.split(pad_force)
        return [
            part.reshape(len(part), -1) @ G.T
            for part, G in zip(parts, self.robot.grasp_maps, strict=True)
        ]

    def feet_wrench(self, at: Instants) -> np.ndarray:
        """What the feet give, [moment, force] on the base in its axes, (M, 6)."""
        unloaded = replace(at, pad_force=np.zeros_like(at.pad_force))
        n = len(self.robot.joint_names)
        with_feet, without = (self.residual(one, kinematic=False)[:, n:] for one in (at, unloaded))
        return with_feet - without

    def standing(self, pad_force: np.ndarray) -> np.ndarray:
        """Which soles stand on all their pads, (M, feet), bool."""
        feet = len(self.robot.grasp_maps)
        result, share = np.zeros((len(pad_force), feet), dtype=bool), _STANDING / max(feet, 1)
        for foot, force in enumerate(self.pads.split(pad_force)):
            normal = force[:, :, 2]
            result[:, foot] = (normal.sum(axis=1) > share * self.weight) & (
                normal.min(axis=1) > _STANDING_PAD * self.weight
            )
        return result

    def residual(self, at: Instants, *, kinematic: bool = True) -> np.ndarray:
        """All rows, shape (M, rows); kinematic ones have their value whether or not a sole stands.

        Args:
            kinematic: are the kinematic and transmission rows wanted? Else they are left out.
        """
        if len(at.joint_position) > _MOST_INSTANTS:
            parts = [
                slice(start, start + _MOST_INSTANTS)
                for start in range(0, len(at.joint_position), _MOST_INSTANTS)
            ]
            pieces = [
                Instants(**{name: values[part] for name, values in vars(at).items()})
                for part in parts
            ]
            return np.concatenate([self.residual(piece, kinematic=kinematic) for piece in pieces])
        states, accelerations = self.plant_motion(at)
        positions, velocities = np.split(states, [self.robot.plant.num_positions()], axis=1)
        wanted = [
            _Wanted(self._inverse_dynamics, (states.tobytes(), accelerations.tobytes())),
            *(sole.jacobian(positions) for sole in self._soles),
        ]
        if kinematic:
            wanted += [sole.bias_acceleration(positions, velocities) for sole in self._soles]
        required, *of_soles = self._evaluated(wanted, states, accelerations)
        generalized = required[:, self._order]
        rates, kinematic_rows = velocities[:, self._order], []
        if self.robot.has_floating_base:
            J = self._in_our_order(of_soles[: len(self._soles)], len(positions))
            for foot, wrench in enumerate(self.wrenches(at.pad_force)):
                generalized = generalized - np.einsum("mi,mij->mj", wrench, J[foot])
            if kinematic:
                velocity = np.einsum("fmij,mj->fmi", J, rates)
                specific_force = np.einsum(
                    "fmij,mj->fmi", J[:, :, 3:], accelerations[:, self._order]
                )
                for foot, bias in enumerate(of_soles[len(self._soles) :]):
                    specific_force[foot] += bias[:, 3:]
                specific_force[:, :, 2] -= self.gravity
                kinematic_rows = [
                    rows[foot]
                    for foot in range(len(J))
                    for rows in (velocity[..., :3], specific_force)
                ]
                # The base's columns of J hold R_FB.
                moving = np.einsum("fmij,fmi->fmj", J[:, :, 3:, 3:6], velocity[..., 3:])
                kinematic_rows += [moving[one] - moving[other] for one, other in self._pairs]
        if kinematic and at.motor_position.shape[1]:
            kinematic_rows.append(at.motor_position - at.joint_position)
        # Joints first.
        joints = at.torque_command - generalized[:, self._joints]
        return np.concatenate(
            [joints, -generalized[:, : self._joints.start], *kinematic_rows], axis=1
        )

    def gravity_torques(self, at: Instants) -> np.ndarray:
        """What gravity gives each joint of a machine on a fixed base per acceleration along each
        axis of the world, (M, n, 3) [kg m]."""
        states, _ = self.plant_motion(at)
        positions = states[:, : self.robot.plant.num_positions()]
        (forces,) = self.dynamics.evaluated([self.dynamics.gravity_forces()], positions)
        return np.swapaxes(forces[:, :, self._order], 1, 2)

    def joint_shares(self, at: Instants) -> np.ndarray:
        """Spatial velocity [angular, linear] that each joint gives each sole, in its frame.

        Returns:
            (feet, M, 6, joints) [rad/s, m/s].
        """
        states, _ = self.plant_motion(at)
        positions, velocities = np.split(states, [self.robot.plant.num_positions()], axis=1)
        rates = velocities[:, self._order[self._joints]]
        return self._jacobians(positions)[..., self._joints] * rates[:, None]

    def _jacobians(self, positions: np.ndarray) -> np.ndarray:
        """Jacobian of the spatial velocity of each sole, in its frame, (feet, M, 6, v)."""
        wanted = [sole.jacobian(positions) for sole in self._soles]
        found = self._evaluated(wanted, positions, np.zeros((len(positions), 0)))
        return self._in_our_order(found, len(positions))

    def _in_our_order(self, jacobians: Sequence[np.ndarray], instants: int) -> np.ndarray:
        """Jacobians of all soles by our velocities, (feet, M, 6, v)."""
        result = np.empty((len(jacobians), instants, 6, len(self._order)))
        for foot, jacobian in enumerate(jacobians):
            result[foot] = jacobian[..., self._order]
        return result

    def _evaluated(
        self, wanted: Sequence[_Wanted], states: np.ndarray, accelerations: np.ndarray
    ) -> list[np.ndarray]:
        """Functions of the plant's state; those of which no result is remembered together, see
        `PlantDynamics.evaluated`."""
        new = [one for one in wanted if one.key not in one.function.results]
        found = self.dynamics.evaluated(
            [one.function.quantity(accelerations) for one in new], states
        )
        for one, result in zip(new, found, strict=True):
            one.function.results[one.key] = result
        return [one.function.results[one.key] for one in wanted]

    @property
    def row_velocities(self) -> np.ndarray:
        """Place in the plant's velocities of each joint and base row."""
        return np.concatenate([self._order[self._joints], self._order[: self._joints.start]])

    def plant_motion(self, at: Instants) -> tuple[np.ndarray, np.ndarray]:
        """States (M, positions + velocities) and accelerations (M, velocities) of the plant, with a
        floating base's origin at rest and its specific force in the place of its acceleration."""
        robot, plant, order = self.robot, self.robot.plant, self._order
        states = np.zeros((len(at.joint_position), plant.num_multibody_states()))
        positions, rates = states[:, : plant.num_positions()], states[:, plant.num_positions() :]
        accelerations = np.zeros_like(rates)
        positions[:] = self._upright
        positions[:, robot.position_index] = at.joint_position
        rates[:, robot.velocity_index] = at.joint_velocity
        accelerations[:, robot.velocity_index] = at.joint_acceleration
        if robot.has_floating_base:
            R_BI, p_BI = self.R_BI, self.p_BI
            w, w_dot = at.angular_velocity @ R_BI.T, at.angular_acceleration @ R_BI.T
            # Specific force of the base's origin: less the lever arm's turning.
            f = at.specific_force @ R_BI.T - np.cross(w_dot, p_BI) - np.cross(w, np.cross(w, p_BI))
            rates[:, order[:3]] = w
            accelerations[:, order[:3]], accelerations[:, order[3:6]] = w_dot, f
        return states, accelerations

    def noise(self, at: Instants, sensors: SensorsConfig, unseen: Unseen) -> SensorNoise:
        """What the sensors put into the rows.

        Args:
            at: averages over blocks.
            unseen: what is as good as noise besides.
        """
        M, motors = len(at.joint_position), at.motor_position.shape[1]
        rows = len(residual_rows(self.robot, motor_encoders=motors > 0))
        noise = SensorNoise(*np.zeros((3, M, rows)))
        noise.white[:, rows - motors :] = sensors.deflection_noise**2
        for start in range(0, M, _AT_A_TIME):
            # With the next one, where there is any.
            part = slice(start, start + _AT_A_TIME + 1)
            white, sensitivity = self._noise_in(at.joint_position[part], sensors, unseen.part(part))
            place = slice(start, start + len(white))
            known = slice(0, white.shape[1])
            noise.white[place, known] = white
            following = np.concatenate([sensitivity[1:], sensitivity[-1:]])
            noise.at_end[place, known] = (0.25 * (sensitivity + following) ** 2).sum(axis=2)
            noise.change[place, known] = ((following - sensitivity) ** 2).sum(axis=2)
        return noise

    def _noise_in(
        self, joint_position: np.ndarray, sensors: SensorsConfig, unseen: Unseen
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of all rows but those of transmissions, in M postures: variance of what is white, (M,
        rows), and sensitivity to the noise of velocities of the unit deviation that they have, (M,
        rows, velocities)."""
        robot, n, v = self.robot, joint_position.shape[1], len(self._order)
        rows = len(residual_rows(robot))
        white = np.zeros((len(joint_position), rows))
        sensitivity = np.zeros((len(joint_position), rows, v))
        positions = np.tile(self._upright, (len(joint_position), 1))
        positions[:, robot.position_index] = joint_position
        gyro, accelerometer = sensors.imu.angular_velocity_noise, sensors.imu.acceleration_noise
        white[:, :n] = unseen.torque
        floating, velocity_noise = robot.has_floating_base, joint_velocity_noise(sensors)
        scale = np.concatenate(
            [np.full(3 * floating, gyro), np.zeros(3 * floating), np.full(n, velocity_noise)]
        )
        joints_first = np.concatenate([np.arange(v - n, v), np.arange(v - n)])
        (mass,) = self.dynamics.evaluated([self.dynamics.mass_matrix()], positions)
        H = mass[:, self._order[joints_first]][:, :, self._order]
        if floating:
            white[:, :v] += accelerometer**2 * (H[:, :, 3:6] ** 2).sum(axis=2)
            white[:, :v] += np.einsum("mij,mj->mi", H[:, :, 3:6] ** 2, unseen.specific_force)
            H[:, :, :3] += H[:, :, 3:6] @ _skew(self.p_BI)
        sensitivity[:, :v] = H * scale
        if not floating:
            return white, sensitivity
        place, relative = v, []
        for J, deviation, unseen_wrench in zip(
            self._jacobians(positions),
            wrench_deviations(sensors.foot_force, robot),
            unseen.wrenches,
            strict=True,
        ):
            white[:, :v] += np.einsum("mij,i->mj", J**2, deviation**2)[:, joints_first]
            white[:, :v] += np.einsum("mij,mi->mj", J**2, unseen_wrench)[:, joints_first]
            white[:, place : place + 3] = ((J[:, :3] * scale) ** 2).sum(axis=2)
            white[:, place + 3 : place + 6] = accelerometer**2
            white[:, place + 3 : place + 6] += np.einsum(
                "mij,mj->mi", J[:, 3:, 3:6] ** 2, unseen.specific_force
            )
            sensitivity[:, place + 3 : place + 6] = J[:, 3:] * scale
            relative.append(np.einsum("mij,mik->mjk", J[:, 3:, 3:6], J[:, 3:]))
            place += 6
        for one, other in self._pairs:
            apart = (relative[one] - relative[other]) * scale
            white[:, place : place + 3] = (apart**2).sum(axis=2)
            place += 3
        return white, sensitivity


def joint_velocity_noise(sensors: SensorsConfig) -> float:
    """Standard deviation of a measured joint velocity [rad/s]."""
    encoders = sensors.encoders
    if encoders.velocity == "exact":
        return encoders.velocity_noise
    return float(
        np.sqrt(2) * np.hypot(encoders.noise, encoders.resolution / np.sqrt(12)) / encoders.period
    )


def _skew(p: np.ndarray) -> np.ndarray:
    return np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])
