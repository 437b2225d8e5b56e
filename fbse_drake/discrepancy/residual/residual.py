"""What the equation of motion leaves over on a log: joint, base, kinematic and transmission
residuals, with the noise that the sensors put into them.

Per plant step, with the base's origin at rest and the measured specific force in the place of
gravity (see `estimators.floating_base`):

* joint and base rows, S tau - (H v_dot + C v - J_m^T f_m): torque that the motors gave and the
  links did not get [Nm]; and six unactuated rows [Nm, N], which no joint effect can touch;
* kinematic rows, of every standing sole but a point foot's, in its frame: angular velocity, and
  specific force less that of a level resting sole; while both feet stand also the velocity of one
  sole relative to the other; on more than two feet, of one standing point foot relative to the next
  that stands;
* transmission rows, of joints with encoders on both sides of the gear: by how much the motor is
  ahead of the link.

All are averaged over blocks of time. Averages of one and the same window have one group delay,
telescope what is differentiated, and leave noise whose covariance is known: white noise
(accelerometer, forces) stays white, differenced noise (gyro, joint velocity) becomes a moving
average of order one, so that each row's covariance is tridiagonal.
"""

import fnmatch
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import combinations, pairwise

import numpy as np
from pydrake.math import RigidTransform
from scipy.ndimage import binary_erosion
from scipy.signal import butter, sosfiltfilt

from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.integration import integration_step
from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.discrepancy.residual.recorded_velocity import Lateness, are_differences
from fbse_drake.discrepancy.residual.white_noise import noise_corners, step_of
from fbse_drake.effects.sensor import SensorSignals
from fbse_drake.errors import InputError
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.held_readings import (
    between_readings,
    rows_of_readings,
    rows_per_reading,
    unseen_variance,
)
from fbse_drake.log import Log
from fbse_drake.robot.dynamics import PlantDynamics, Quantity, path
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import RecordingConfig, SensorsConfig
from fbse_drake.sensors.foot_force import wrench_deviations
from fbse_drake.sensors.foot_pads import FootPads, measured_pad_forces

# Order of the low-pass of a recording, and how far it continues a stretch beyond its ends
# [samples].
_ORDER, _PADDING = 4, 100
# A sole stands still while it carries more than this share of what it would if all carried alike,
# and each of its pads this share of the weight.
_STANDING = 0.3
_STANDING_PAD = 0.01
# Soles settle for this long at the start of a recording [s]. A foot that has just touched down, or
# is about to lift, may still roll over an edge: its sole is not at rest in this time [s].
_SETTLING, _ROLLING = 0.1, 0.03
_AXES = ("x", "y", "z")
# Results that the equation of motion keeps of each of its functions, and instants that are computed
# at once: Jacobians take room.
_REMEMBERED = 3
_MOST_INSTANTS = 20_000
# Blocks of fewer samples share much of what is sampled at their ends, or angles that their
# velocities are differenced from: their noise is not that of neighbours that are independent.
_SHARING = 3
# The noise of so many blocks is calculated at a time, which bounds the matrices that are kept.
_AT_A_TIME = 500


@dataclass(frozen=True)
class Row:
    """One residual channel."""

    # As `left_knee_pitch`, `base/force_z`, `left_sole/angular_velocity_x`.
    name: str
    # `joint`, `base`, `kinematic` or `transmission`.
    kind: str
    unit: str
    # Sides of the feet whose soles it is about.
    feet: tuple[str, ...] = ()
    # The joint that it is about.
    joint: str = ""


def foot_pairs(robot: Robot) -> list[tuple[int, int]]:
    """Places of the feet whose velocity relative to each other is in rows: of two feet both, of
    more all pairs of point feet. How a point foot is turned while it stands is not known, but that
    it does not move."""
    legs = robot.description.legs
    if len(legs) == 2:
        return [(0, 1)]
    points = [
        foot
        for foot, (side, leg) in enumerate(legs.items())
        if leg.is_point and np.allclose(robot.pad_positions(side), 0.0, atol=1e-6)
    ]
    return list(combinations(points, 2))


def residual_rows(robot: Robot, *, motor_encoders: bool = False) -> list[Row]:
    """The residual's rows for a robot, in order; with second encoders also those that they show."""
    units = dict(zip(robot.joint_names, robot.torque_units, strict=True))
    rows = [Row(name, "joint", unit, joint=name) for name, unit in units.items()]
    rows += _rows_of_floating_base(robot) if robot.has_floating_base else []
    if motor_encoders:
        rows += [
            Row(f"{name}/deflection", "transmission", "m" if unit == "N" else "rad", joint=name)
            for name, unit in units.items()
        ]
    return rows


def _rows_of_floating_base(robot: Robot) -> list[Row]:
    rows = [
        Row(f"base/{kind}_{axis}", "base", unit)
        for kind, unit in (("moment", "Nm"), ("force", "N"))
        for axis in _AXES
    ]
    for side in robot.description.sides:
        kinds = (("angular_velocity", "rad/s"), ("specific_force", "m/s^2"))
        rows += [
            Row(f"{side}_sole/{kind}_{axis}", "kinematic", unit, (side,))
            for kind, unit in kinds
            for axis in _AXES
        ]
    sides = robot.description.sides
    for pair in foot_pairs(robot):
        feet = tuple(sides[foot] for foot in pair)
        name = "soles" if len(sides) == 2 else "-".join(feet)
        rows += [
            Row(f"{name}/relative_velocity_{axis}", "kinematic", "m/s", feet) for axis in _AXES
        ]
    return rows


def read_signals(
    robot: Robot, log: Log, recording: RecordingConfig, *, differenced: bool
) -> tuple[SensorSignals, np.ndarray]:
    """Sensor channels of a log on an even grid of its nominal period.

    Late samples are interpolated, and what sensors hold between their readings; what lies in a gap
    is marked. Without `joint/torque_command` torques are 0.

    Args:
        differenced: see `differences_angles`.

    Returns:
        The signals, N samples, and which of them are measured (not interpolated over a gap), shape
        (N,).

    Raises:
        InputError: other joints than the model's, missing IMU or foot channels of a floating robot.
    """
    if log.joints != robot.joint_names:
        raise InputError(f"the log's joints {log.joints} are not the model's {robot.joint_names}")
    period, time = float(log.meta["period"]), log.time
    grid = time[0] + np.arange(round((time[-1] - time[0]) / period) + 1) * period
    even = len(grid) == len(time) and np.allclose(grid, time, rtol=0, atol=1e-6 * period)
    after = (
        np.clip(np.searchsorted(time, grid - 1e-9 * period), 1, len(time) - 1)
        if len(time) > 1
        else np.zeros(1, dtype=int)
    )
    known = np.ones(len(grid), dtype=bool)
    if not even:
        known = (time[after] - time[after - 1] < 1.5 * period) | (
            time[after] - grid < 1e-3 * period
        )
    # What is smoothed or differenced is not so across the switching of a drive, where torques jump.
    latest = np.clip(np.searchsorted(time, grid + 1e-9 * period) - 1, 0, None)
    stretches = _stretches(known, log["joint/enabled"][latest] if "joint/enabled" in log else None)

    def low_passed(values: np.ndarray) -> np.ndarray:
        return _low_passed(values, recording.cutoff, period, stretches)

    def on_grid(values: np.ndarray) -> np.ndarray:
        values = between_readings(values)
        if even:
            return low_passed(values)
        share = ((grid - time[after - 1]) / (time[after] - time[after - 1])).clip(0.0, 1.0)
        share = share.reshape(-1, *[1] * (values.ndim - 1))
        return low_passed((1 - share) * values[after - 1] + share * values[after])

    def held(values: np.ndarray) -> np.ndarray:
        return low_passed(values if even else values[latest])

    def rate(values: np.ndarray) -> np.ndarray:
        result = np.zeros_like(values)
        for stretch in stretches:
            if len(values[stretch]) > 1:
                result[stretch] = np.gradient(values[stretch], period, axis=0)
        return result

    zeros = np.zeros((len(grid), 3))
    specific_force = angular_velocity = zeros
    pad_force = np.zeros((len(grid), len(FootPads(robot).foot), 3))
    if robot.has_floating_base:
        for name in ("imu/linear_acceleration", "imu/angular_velocity"):
            if name not in log:
                raise InputError(
                    f"the log has no channel {name}, which the residual of a floating robot needs"
                )
        specific_force, angular_velocity = (
            on_grid(log["imu/linear_acceleration"]),
            on_grid(log["imu/angular_velocity"]),
        )
        pad_force = on_grid(measured_pad_forces(robot, log))
    q = on_grid(log["joint/position"])
    if differenced:
        # Where a stretch ends there is no central difference.
        inside = np.zeros_like(known)
        for stretch in stretches:
            inside[stretch.start + 1 : stretch.stop - 1] = True
        known = inside
    torque = log.get("joint/torque_command", np.zeros_like(log["joint/position"]))
    torque = np.where(robot.description.has_motor, torque, 0.0)
    signals = SensorSignals(
        joint_position=q,
        joint_velocity=rate(q) if differenced else on_grid(log["joint/velocity"]),
        specific_force=specific_force,
        angular_velocity=angular_velocity,
        pad_force=pad_force,
        torque_command=on_grid(torque) if recording.is_sampled else held(torque),
        motor_position=on_grid(log.get("joint/motor_position", np.zeros((len(log.time), 0)))),
    )
    return signals, known


def differences_angles(recording: RecordingConfig, log: Log) -> bool:
    """Are velocities had from the angles, by central differences? Also where those of a log that is
    sampled are such differences, which would be half a sample late as they are."""
    if recording.velocity == "differenced" or "joint/velocity" not in log:
        return True
    return recording.is_sampled and are_differences(
        log.time, log["joint/position"], log["joint/velocity"]
    )


def _low_passed(
    values: np.ndarray, cutoff: float, period: float, stretches: list[slice]
) -> np.ndarray:
    """Values (N, ...) through a low-pass without delay, stretch by stretch; as they are for a
    corner of 0, or of half the rate of samples, beyond which they hold nothing."""
    if cutoff == 0 or 2 * cutoff * period >= 1:
        return values
    result = values.copy()
    filter_ = _butterworth(cutoff, period)
    for stretch in stretches:
        result[stretch] = sosfiltfilt(
            filter_, values[stretch], axis=0, padlen=min(len(values[stretch]) - 1, _PADDING)
        )
    return result


@cache
def _butterworth(cutoff: float, period: float) -> np.ndarray:
    return butter(_ORDER, cutoff, fs=1 / period, output="sos")


def _stretches(known: np.ndarray, enabled: np.ndarray | None = None) -> list[slice]:
    """Runs of samples between gaps, in which no drive is switched on or off.

    Args:
        enabled: which drives are on, (N, n).
    """
    switched = np.zeros(len(known), dtype=bool)
    if enabled is not None:
        switched[1:] = np.any(np.diff(enabled, axis=0) != 0, axis=1)
    run = np.where(known, 1 + np.cumsum(switched), 0)
    edges = np.flatnonzero(np.diff(run, prepend=0, append=0))
    return [slice(start, stop) for start, stop in pairwise(edges) if known[start]]


@dataclass(frozen=True)
class Instants:
    """What the equation of motion needs at M instants; IMU quantities in the IMU frame."""

    joint_position: np.ndarray
    joint_velocity: np.ndarray
    joint_acceleration: np.ndarray
    angular_velocity: np.ndarray
    angular_acceleration: np.ndarray
    specific_force: np.ndarray
    # (M, P, 3) [N].
    pad_force: np.ndarray
    torque_command: np.ndarray
    # (M, n), or (M, 0) without second encoders.
    motor_position: np.ndarray


@dataclass(frozen=True)
class Timing:
    """When what a row of a log tells is so, see `RecordingConfig.rows`; all in [s]."""

    # From one row to the next.
    period: float
    # A reading of accelerometer or foot force is the mean over this before its row.
    reading: float = 0.0
    # The command of a row is held for this from then on.
    command: float = 0.0
    # Steps in which the motion was integrated; 0 for continuous motion.
    integration: float = 0.0

    @staticmethod
    def of(log: Log, recording: RecordingConfig) -> "Timing":
        """That of a log's rows, but for the integration of its motion."""
        period = float(log.meta["period"])
        if recording.is_sampled:
            return Timing(period)
        said = (log.meta.get(key) for key in ("reading_time", "command_time"))
        reading, command = (period if time is None else min(time, period) for time in said)
        return Timing(period, reading, command)

    @property
    def reading_share(self) -> float:
        """Between the readings at both ends of a step, where that of its middle is, as a share."""
        return 0.5 + 0.5 * self.reading / self.period

    @property
    def command_share(self) -> float:
        """The same of commands."""
        return 0.5 - 0.5 * self.command / self.period

    @property
    def motion_share(self) -> float:
        """Where in a step its forces have their posture and velocities: a simulation has its forces
        from where its own, semi-implicit steps began, which is half of such a step earlier."""
        return 0.5 - 0.5 * self.integration / self.period

    @property
    def law_share(self) -> float:
        """Where in a step the velocity is that friction has: a simulated law holds at the end of
        its integration step."""
        return 0.5 + 0.5 * self.integration / self.period


def steps(signals: SensorSignals, timing: Timing) -> Instants:
    """Every step between two samples, M = N - 1: all that is measured is taken amid the step, the
    accelerations are those over it."""
    at_readings, at_commands = timing.reading_share, timing.command_share
    at_motion, period = timing.motion_share, timing.period
    return Instants(
        joint_position=within_steps(signals.joint_position, at_motion),
        joint_velocity=within_steps(signals.joint_velocity, at_motion),
        joint_acceleration=np.diff(signals.joint_velocity, axis=0) / period,
        angular_velocity=within_steps(signals.angular_velocity, at_motion),
        angular_acceleration=np.diff(signals.angular_velocity, axis=0) / period,
        specific_force=within_steps(signals.specific_force, at_readings),
        pad_force=within_steps(signals.pad_force, at_readings),
        torque_command=within_steps(signals.torque_command, at_commands),
        motor_position=within_steps(signals.motor_position, at_motion),
    )


def within_steps(values: np.ndarray, share: float) -> np.ndarray:
    """Samples (N, ...) interpolated in every step, (N - 1, ...): at its start for a share of 0, at
    its end for 1."""
    return (1.0 - share) * values[:-1] + share * values[1:]


def averaged(instants: Instants, length: int) -> Instants:
    """The instants averaged over blocks."""
    return Instants(
        **{name: block_means(values, length) for name, values in vars(instants).items()}
    )


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

    def noise(
        self, at: Instants, sensors: SensorsConfig, unseen: Unseen
    ) -> tuple[np.ndarray, np.ndarray]:
        """Variance that sensor noise puts into each row of one step, to first order.

        Args:
            unseen: what is as good as noise besides.

        Returns:
            Of what is white, and of the integral over time of what is differenced white noise, each
            (M, rows), in the rows' units squared (the second times s^2).
        """
        M, motors = len(at.joint_position), at.motor_position.shape[1]
        rows = len(residual_rows(self.robot, motor_encoders=motors > 0))
        white, differenced = np.zeros((M, rows)), np.zeros((M, rows))
        white[:, rows - motors :] = sensors.deflection_noise**2
        for start in range(0, M, _AT_A_TIME):
            part = slice(start, start + _AT_A_TIME)
            outputs = white[part], differenced[part]
            self._fill_noise(at.joint_position[part], sensors, unseen.part(part), *outputs)
        return white, differenced

    def _fill_noise(
        self,
        joint_position: np.ndarray,
        sensors: SensorsConfig,
        unseen: Unseen,
        white: np.ndarray,
        differenced: np.ndarray,
    ) -> None:
        """Fills what `noise` returns, in some postures."""
        robot, n, v = self.robot, joint_position.shape[1], len(self._order)
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
        differenced[:, :v] = ((H * scale) ** 2).sum(axis=2)
        if not floating:
            return
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
            differenced[:, place + 3 : place + 6] = ((J[:, 3:] * scale) ** 2).sum(axis=2)
            relative.append(np.einsum("mij,mik->mjk", J[:, 3:, 3:6], J[:, 3:]))
            place += 6
        for one, other in self._pairs:
            apart = (relative[one] - relative[other]) * scale
            white[:, place : place + 3] = (apart**2).sum(axis=2)
            place += 3


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


@dataclass(frozen=True)
class Residual:
    """Block averages of the residual of a model over a log; B blocks, R rows."""

    rows: list[Row]
    # Centre of each block [s], shape (B,).
    time: np.ndarray
    # (B, R); and which are known: no gap in the log and no force at the end of its sensor's range,
    # for joint rows a torque, for kinematic rows a sole that stands; no unused row.
    value: np.ndarray
    known: np.ndarray
    # Noise of the sensors: variance of each average, and its covariance with the next block's, each
    # (B, R).
    variance: np.ndarray
    covariance: np.ndarray
    # Which soles stand, (B, feet).
    standing: np.ndarray
    # Averages of the signals, for tables and plots.
    signals: Instants
    # What of the variance is no noise of sensors but doubt about laws that were taken off, (B, R)
    # or 0.
    doubt: np.ndarray | float = 0.0

    @cached_property
    def row_index(self) -> dict[str, int]:
        return {row.name: k for k, row in enumerate(self.rows)}

    @cached_property
    def noise_floor(self) -> np.ndarray:
        """Root mean square of the sensors' noise in each row, shape (R,); NaN for a row that is
        never known."""
        return rms(np.sqrt(self.variance), self.known)

    def minus(self, predicted: np.ndarray) -> "Residual":
        """What is left when a prediction (B, R) is taken off."""
        return replace(self, value=self.value - predicted)


def rms(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Root mean square over the first axis where known; NaN where nothing is."""
    counts = known.sum(axis=0)
    total = (np.where(known, values, 0.0) ** 2).sum(axis=0)
    return np.sqrt(np.divide(total, counts, out=np.full(total.shape, np.nan), where=counts > 0))


class RecordedMotion:
    """A log seen by a model: makes residuals, and finds how they change with the signals or the
    model."""

    def __init__(
        self,
        robot: Robot,
        sensors: SensorsConfig,
        recording: RecordingConfig,
        log: Log,
        left_out: Sequence[tuple[float, float]] = (),
    ):
        """Reads the log.

        Args:
            robot: the model.
            sensors: whose noise is believed.
            recording: how the log is read.
            left_out: start and end [s] of stretches of which nothing is known.

        Raises:
            InputError: a log that does not fit the model, or one that is too short.
        """
        self.robot, self.sensors, self.recording, self.log = robot, sensors, recording, log
        self.timing = Timing.of(log, recording)
        self.period = self.timing.period
        differenced = differences_angles(recording, log)
        self.signals, self.measured = read_signals(robot, log, recording, differenced=differenced)
        self.lateness = Lateness.none(len(robot.joint_names))
        if recording.is_sampled and not differenced:
            q, v = self.signals.joint_position, self.signals.joint_velocity
            lateness = Lateness.of(q, v, self.period, _stretches(self.measured))
            v, known = lateness.in_time(v, self.measured, self.period)
            self.lateness, self.measured = lateness, known
            self.signals = replace(self.signals, joint_velocity=v)
        least = _SHARING if recording.is_sampled or differenced else 1
        self.length = max(least, round(recording.block / self.period))
        if len(self.signals.joint_position) < 20 * self.length:
            raise InputError(
                f"the log is too short: {len(log.time)} samples, at least "
                f"{20 * self.length} are needed"
            )
        self.rows = residual_rows(robot, motor_encoders=self.signals.motor_position.shape[1] > 0)
        names = [row.name for row in self.rows]
        for pattern in recording.unused_rows:
            if not fnmatch.filter(names, pattern):
                raise InputError(
                    f"recording.unused_rows: {pattern}: there is no such row "
                    f"(there are: {', '.join(names)})"
                )
        self.start, self._left_out = float(log.time[0]), left_out
        self.equation = EquationOfMotion(robot)
        if not recording.is_sampled:
            position, velocity = self.signals.joint_position, self.signals.joint_velocity
            found = integration_step(position, velocity, self.period, self.measured)
            self.timing = replace(self.timing, integration=found)

    @cached_property
    def steps(self) -> Instants:
        return self.steps_of(self.signals)

    def steps_of(self, signals: SensorSignals) -> Instants:
        """Steps of other signals on the same grid."""
        return steps(signals, self.timing)

    def low_passed(self, values: np.ndarray, corner: float) -> np.ndarray:
        """Samples (N, ...) through a low-pass without delay, gaps left out; as they are for 0
        Hz."""
        return _low_passed(values, corner, self.period, self.stretches)

    @cached_property
    def stretches(self) -> list[slice]:
        """Runs of samples without a gap."""
        return _stretches(self.measured)

    def averages(self, predicted: np.ndarray) -> np.ndarray:
        """Averages over blocks of what was predicted step by step, (N - 1, ...), as the recording
        would hold it."""
        return block_means(
            _low_passed(
                predicted, self.recording.recorded_cutoff, self.period, self._measured_steps
            ),
            self.length,
        )

    @cached_property
    def _measured_steps(self) -> list[slice]:
        """Runs of steps without a gap."""
        return _stretches(self.measured[:-1] & self.measured[1:])

    @cached_property
    def blocks(self) -> Instants:
        """Averages of the steps."""
        return averaged(self.steps, self.length)

    @cached_property
    def quiet_blocks(self) -> Instants:
        """The same without the noise of the joints' velocities."""
        return averaged(self.steps_of(self.without_velocity_noise(self.signals)), self.length)

    def without_velocity_noise(self, signals: SensorSignals) -> SensorSignals:
        """Signals without frequencies in which the log has little but noise of the joints'
        velocities: in a regressor it would be the noise of the residual, which is the same (errors
        in variables)."""
        velocity = [
            self.low_passed(v, corner)
            for v, corner in zip(signals.joint_velocity.T, self._velocity_corners, strict=True)
        ]
        return replace(signals, joint_velocity=np.stack(velocity, axis=1))

    @cached_property
    def _velocity_corners(self) -> list[float]:
        """Frequency above which each joint's velocity is little but noise [Hz]; 0 for none, or in
        logs per step, whose impacts are as fast.

        A velocity of which no noise is known is taken to be a rate of the angles beside it.
        """
        recording, velocity = self.recording, self.signals.joint_velocity
        if not recording.is_sampled or recording.cutoff > 0:
            return [0.0] * velocity.shape[1]
        noise = joint_velocity_noise(self.sensors)
        of_rates = noise == 0 or differences_angles(recording, self.log)
        if of_rates:
            steps = np.array([step_of(q) for q in self.log["joint/position"].T])
            deviation = np.maximum(steps / np.sqrt(12.0), self.sensors.encoders.angle_noise)
        else:
            deviation = np.full(velocity.shape[1], noise)
        return noise_corners(velocity, deviation**2, self.period, of_rates=of_rates)

    @cached_property
    def time(self) -> np.ndarray:
        """Centre of each block [s]."""
        return (
            self.start
            + (np.arange(len(self.blocks.joint_position)) + 0.5) * self.length * self.period
        )

    @cached_property
    def standing(self) -> np.ndarray:
        """Which soles stand throughout each block, (B, feet)."""
        return (
            block_means(self.equation.standing(self.steps.pad_force).astype(float), self.length)
            == 1.0
        )

    @cached_property
    def known(self) -> np.ndarray:
        """Which averages of which rows are known, (B, R)."""
        rows = self.rows
        # A force at the end of the sensor's range is any force beyond it.
        measured = self.measured & (
            np.abs(self.signals.pad_force) < self.sensors.foot_force.range
        ).all(axis=(1, 2))
        in_gap = block_means(1.0 - (measured[:-1] & measured[1:]), self.length) > 0
        half = 0.5 * self.length * self.period
        for start, end in self._left_out:
            in_gap |= (self.time + half > start) & (self.time - half < end)
        known = np.repeat(~in_gap[:, None], len(rows), axis=1)
        if "joint/torque_command" not in self.log:
            known[:, [row.kind == "joint" for row in rows]] = False
        known[
            :,
            [
                any(fnmatch.fnmatch(row.name, pattern) for pattern in self.recording.unused_rows)
                for row in rows
            ],
        ] = False
        least = self.robot.description.per_joint(
            self.recording.least_speed, key="recording.least_speed", default=0.0
        )
        known[:, : len(least)] &= (
            block_means(np.abs(self.steps.joint_velocity) >= least, self.length) == 1.0
        )
        kinematic = np.array([row.kind == "kinematic" for row in rows])
        starts = [self.start, *(part["start"] for part in self.log.meta.get("segments", ()))]
        since = self.time[:, None] - np.array(starts)
        settling = np.any((since >= 0) & (since <= _SETTLING), axis=1)
        # Nor is it known where a motor stands in its gap at first.
        begins = kinematic | np.array([row.kind == "transmission" for row in rows])
        known &= ~begins | ~settling[:, None]
        around = 2 * round(_ROLLING / (self.length * self.period)) + 1
        at_rest = binary_erosion(self.standing, np.ones((around, 1)), border_value=1)
        for foot, (side, leg) in enumerate(self.robot.description.legs.items()):
            # How a point foot is turned while it stands is not known.
            still = at_rest[:, foot, None] & (not leg.is_point)
            known[:, [row.name.startswith(f"{side}_sole/") for row in rows]] &= still
        # Of feet that stand, the velocities of each relative to the next one say all.
        pairs = foot_pairs(self.robot)
        for one, other in pairs:
            between = [foot for foot in range(one + 1, other) if (one, foot) in pairs]
            still = at_rest[:, one] & at_rest[:, other] & ~at_rest[:, between].any(axis=1)
            feet = tuple(self.robot.description.sides[foot] for foot in (one, other))
            known[:, [row.feet == feet for row in rows]] &= still[:, None]
        return known

    def torque_variance(self, torque: np.ndarray) -> np.ndarray:
        """Variance of the white noise of a sample of torques (M, n), as the recording says it, (M,
        n)."""
        names, recording = self.robot.description, self.recording
        noise, share = (
            names.per_joint(getattr(recording, key), key=f"recording.{key}", default=0.0)
            for key in ("torque_noise", "torque_noise_share")
        )
        return np.where(names.has_motor, noise**2 + (share * torque) ** 2, 0.0)

    @cached_property
    def sensors_by_row(self) -> SensorsConfig:
        """The sensors with white noise in every row that leaves as much in an average over a block
        as they do, whose readings may be held for some rows."""
        imu, feet = self.sensors.imu, self.sensors.foot_force

        def spread(noise: float, names: Iterable[str]) -> float:
            held = max((rows_per_reading(self.log[n]) for n in names if n in self.log), default=1)
            return noise * math.sqrt(min(held, self.length))

        of_feet = [name for name in self.log.channels if name.startswith("foot/")]
        return replace(
            self.sensors,
            imu=replace(
                imu,
                acceleration_noise=spread(imu.acceleration_noise, ["imu/linear_acceleration"]),
            ),
            foot_force=replace(
                feet,
                noise=spread(feet.noise, of_feet),
                moment_noise=spread(feet.moment_noise, of_feet),
            ),
        )

    @cached_property
    def _unseen(self) -> Unseen:
        """Of the blocks."""
        log, sensors, timing = self.log, self.sensors, self.timing
        # A row of the log for each sample on the grid.
        grid = self.start + np.arange(len(self.measured)) * self.period
        row = np.searchsorted(log.time, grid - 0.5 * self.period).clip(max=len(log.time) - 1)
        # Samples that are the mean over nothing tell of all around them.
        seen, commanded = (
            time / self.period if time > 0 else 1.0 for time in (timing.reading, timing.command)
        )

        def of_blocks(values: np.ndarray) -> np.ndarray:
            return block_means(values[row[:-1]], self.length)

        def of_sensor(values: np.ndarray, noise: np.ndarray | float) -> np.ndarray:
            return of_blocks(unseen_variance(values, noise, seen, rows_of_readings(values)))

        torque = log.get("joint/torque_command", np.zeros_like(log["joint/position"]))
        noise = np.sqrt(self.torque_variance(torque).mean(axis=0))
        torques = unseen_variance(torque, noise, commanded, np.arange(len(torque)))
        if not self.robot.has_floating_base:
            return Unseen(of_blocks(torques), np.zeros((len(self.time), 3)), [])
        specific_force = log["imu/linear_acceleration"] @ self.equation.R_BI.T
        wrenches = self.equation.wrenches(measured_pad_forces(self.robot, log))
        deviations = wrench_deviations(sensors.foot_force, self.robot)
        return Unseen(
            of_blocks(torques),
            of_sensor(specific_force, sensors.imu.acceleration_noise),
            [of_sensor(*of_foot) for of_foot in zip(wrenches, deviations, strict=True)],
        )

    @cached_property
    def step_noise(self) -> tuple[np.ndarray, np.ndarray]:
        """Believed variance of a step's white noise and of the integral over time of what is
        differenced white noise, (B, R) each."""
        white, differenced = self.equation.noise(self.blocks, self.sensors_by_row, self._unseen)
        torque = self.torque_variance(self.blocks.torque_command)
        white[:, : torque.shape[1]] += torque
        return white, differenced

    @cached_property
    def residual(self) -> Residual:
        """The residual of the model's rigid bodies; what its effects explain is not taken off.

        Raises:
            InputError: no row of it is known at any time.
        """
        if not self.known.any():
            lacking = (
                "" if "joint/torque_command" in self.log else ", joint/torque_command is missing"
            )
            raise InputError(
                f"the log has nothing to compare a model with{lacking} (needed: torques, or feet "
                f"and an IMU, without gaps for {self.recording.block:g} s, in rows that "
                "recording.unused_rows and recording.least_speed leave)"
            )
        value = self.equation.residual(self.steps)
        if self.recording.recorded_cutoff > 0:
            measured = np.zeros_like(value)
            measured[:, : len(self.robot.joint_names)] = self.steps.torque_command
            value = block_means(measured, self.length) + self.averages(value - measured)
        else:
            value = block_means(value, self.length)
        white, differenced = self.step_noise
        duration = self.length * self.period
        variance = white / self.length + 2 * differenced / duration**2
        covariance = -np.sqrt(differenced[:-1] * differenced[1:]) / duration**2
        covariance = np.concatenate([covariance, np.zeros((1, covariance.shape[1]))])
        return Residual(
            self.rows,
            self.time,
            value,
            self.known,
            variance,
            covariance,
            self.standing,
            self.blocks,
        )
