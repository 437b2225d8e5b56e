"""Joint accelerations of a robot whose standing feet do not slip (paper Sec. 5)."""

import math
from dataclasses import astuple, dataclass

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.floating_base import ImuMount, base_specific_force
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, starts
from fbse_drake.estimators.spatial import put, rotate, rotate_back, rotation_at, scale, subtract, vector_at
from fbse_drake.robot.plant import Robot


@dataclass(frozen=True)
class JointAccelerationConfig:
    """How accelerations are had, and the sensors' noise as it is believed."""

    # `minimum_norm`: the paper's (42), (46); `gyro`: the same with the base's angular acceleration from the gyro, which makes the equations
    # square; `fused`: both and the encoders by weighted least squares, which gives the swing leg as well.
    method: str = "fused"
    # Standard deviation of white noise per axis and sample: accelerometer [m/s^2], gyro [rad/s], joint velocity [rad/s].
    acceleration_noise: float = 0.02
    angular_velocity_noise: float = 1.0e-3
    joint_velocity_noise: float = 5.0e-4
    # What a standing foot accelerates in spite of all: angular [rad/s^2] and linear [m/s^2].
    foot_angular_acceleration: float = 1.0
    foot_acceleration: float = 0.1

    def __post_init__(self) -> None:
        if self.method not in ("minimum_norm", "gyro", "fused"):
            raise InputError(f"method: expected minimum_norm, gyro or fused, found {self.method}")
        require_positive(
            self, "acceleration_noise", "angular_velocity_noise", "joint_velocity_noise", "foot_angular_acceleration", "foot_acceleration"
        )


def minimum_norm(J: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Shortest solution of J x = y for a wide J: J^T (J J^T)^-1 y, paper eqs. (42), (46)."""
    return J.T @ np.linalg.solve(J @ J.T, y)


@njit(cache=True)
def solve_positive_definite(S: np.ndarray, B: np.ndarray) -> None:
    """Replaces B (c, m) by S^-1 B, by Cholesky; S (c, c) is symmetric positive definite and is overwritten."""
    c, m = B.shape
    for i in range(c):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= S[i, k] * S[j, k]
            S[i, j] = math.sqrt(total) if i == j else total / S[j, j]
    for i in range(c):
        for k in range(i):
            for j in range(m):
                B[i, j] -= S[i, k] * B[k, j]
        for j in range(m):
            B[i, j] /= S[i, i]
    for i in range(c - 1, -1, -1):
        for k in range(i + 1, c):
            for j in range(m):
                B[i, j] -= S[k, i] * B[k, j]
        for j in range(m):
            B[i, j] /= S[i, i]


@njit(cache=True)
def fuse(
    measured: np.ndarray, variance: np.ndarray, J: np.ndarray, y: np.ndarray, constraint_variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Weighted least squares of measured accelerations and J x = y.

    Args:
        measured: shape (v,), with independent errors of `variance` (v,).
        J: shape (c, v); y: shape (c,), with independent errors of `constraint_variance` (c,).

    Returns:
        The accelerations x (v,), dx/dmeasured (v, v), the innovation y - J measured (c,) and its variance (c,).
    """
    c, v = J.shape
    gain, S, innovation, x = np.empty((c, v)), np.zeros((c, c)), y.copy(), measured.copy()
    J_T = np.ascontiguousarray(J.T)
    for i in range(c):
        for k in range(v):
            gain[i, k] = J[i, k] * variance[k]
            innovation[i] -= J[i, k] * measured[k]
            for j in range(i + 1):
                S[i, j] += gain[i, k] * J_T[k, j]
        S[i, i] += constraint_variance[i]
    innovation_variance = np.diag(S).copy()
    solve_positive_definite(S, gain)  # the gain's transpose
    sensitivity = np.eye(v)
    for i in range(c):
        for k in range(v):
            x[k] += gain[i, k] * innovation[i]
            for j in range(v):
                sensitivity[k, j] -= gain[i, k] * J[i, j]
    return x, sensitivity, innovation, innovation_variance


@njit(cache=True)
def measured_acceleration(measured: np.ndarray, model: np.ndarray, elapsed: float, places: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """What gyro, accelerometer and encoders say of the accelerations of base and joints, shape (v,), see `JointAccelerationEstimator`.

    Args:
        measured, model: posteriors of `SensorMonitor`, and of `FloatingBaseModel` where the tick began.
        places: of what is read, see the first line.
        frames: rotation and lever arm of the IMU.
    """
    joint_velocity, specific_force, angular_velocity, velocity_start, velocity_stop = to_fixed_tuple(places, 5)
    R_BI, p_BI = rotation_at(frames, 0), vector_at(frames, 9)
    v = velocity_stop - velocity_start
    acceleration = np.empty(v)
    w_start = vector_at(model, velocity_start)
    w_dot = scale(1.0 / elapsed, subtract(rotate(R_BI, vector_at(measured, angular_velocity)), w_start))
    put(acceleration, 0, w_dot)
    put(acceleration, 3, base_specific_force(vector_at(measured, specific_force), w_start, w_dot, R_BI, p_BI))
    for i in range(6, v):
        acceleration[i] = (measured[joint_velocity + i - 6] - model[velocity_start + i]) / elapsed
    return acceleration


@njit(cache=True)
def no_slip_condition(
    model: np.ndarray, attitude: np.ndarray, stands: np.ndarray, places: np.ndarray, v: int, gravity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """J (c, v) and y (c,) of J a = y, eq. (41) with p_m_ddot = 0, for the feet that stand.

    The base's acceleration in `a` is its specific force, so a foot at rest accelerates with minus gravity.

    Args:
        model, attitude: posteriors of `FloatingBaseModel` where the tick began, and of `AttitudeEstimator`.
        stands: the feet that stand, shape (feet,), bool.
        places: of what is read, see the first line.
        gravity: in world axes, shape (3,) [m/s^2].
    """
    foot_jacobian, foot_bias, foot_rotation, rotation = to_fixed_tuple(places, 4)
    J, y = np.empty((6 * stands.sum(), v)), np.empty(6 * stands.sum())
    gravity_B = rotate_back(rotation_at(attitude, rotation), vector_at(gravity, 0))
    row = 0
    for foot in range(len(stands)):
        if stands[foot]:
            start = foot_jacobian + 6 * v * foot
            J[row : row + 6] = model[start : start + 6 * v].reshape(6, v)
            y[row : row + 6] = -model[foot_bias + 6 * foot : foot_bias + 6 * foot + 6]
            gravity_F = rotate_back(rotation_at(model, foot_rotation + 9 * foot), gravity_B)
            for i in range(3):
                y[row + 3 + i] -= gravity_F[i]
            row += 6
    return J, y


@njit(cache=True)
def standing_feet(support: np.ndarray, measured: np.ndarray, trust: int) -> np.ndarray:
    """Feet that stand and whose sensors are trusted, shape (feet,), bool; trust: where in `measured`."""
    stands = np.empty(len(support), dtype=np.bool_)
    for foot in range(len(support)):
        stands[foot] = support[foot] > 0 and measured[trust + 2 + foot] == 0
    return stands


@njit(cache=True)
def _begin(posterior: np.ndarray, elapsed: float, measured: np.ndarray, model: np.ndarray, trust: int, places: np.ndarray) -> bool:
    """Sets a posterior to zero but for its status; says whether there is something to estimate from.

    Args:
        trust: where in `measured`; places: see `measured_acceleration`.
    """
    posterior[:] = 0.0
    posterior[STATUS] = max(measured[trust], measured[trust + 1])
    if math.isnan(elapsed):
        return False
    # Where the tick began there may have been no measurement yet.
    return posterior[STATUS] == 0 and model[places[3] : places[4]].any()


@njit(cache=True)
def _fuse_accelerations(
    posterior: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    attitude: np.ndarray,
    model: np.ndarray,
    sensor_places: np.ndarray,
    no_slip_places: np.ndarray,
    places: np.ndarray,
    frames: np.ndarray,
    noise: np.ndarray,
) -> None:
    """One tick of `JointAccelerationEstimator` by the fused method; fills the posterior.

    Args:
        sensor_places: see `measured_acceleration`; no_slip_places: see `no_slip_condition`.
        places: of what is read and written besides, see the first lines.
        frames: rotation and lever arm of the IMU, gravity.
        noise: standard deviations, see `JointAccelerationConfig`.
    """
    trust, support_start, support_stop = to_fixed_tuple(places, 3)
    acceleration_at, known, sensitivity_at, innovation_at, variance_at = to_fixed_tuple(places[3:], 5)
    acceleration_noise, rate_noise, joint_velocity_noise, foot_angular_acceleration, foot_acceleration = to_fixed_tuple(noise, 5)
    if not _begin(posterior, elapsed, measured, model, trust, sensor_places):
        return
    stands = standing_feet(measured[support_start:support_stop], measured, trust)
    raw = measured_acceleration(measured, model, elapsed, sensor_places, frames)
    v = len(raw)
    # Differences of velocities have their noise twice.
    variance = np.full(v, 2 * (joint_velocity_noise / elapsed) ** 2)
    variance[:3], variance[3:6] = 2 * (rate_noise / elapsed) ** 2, acceleration_noise**2
    J, y = no_slip_condition(model, attitude, stands, no_slip_places, v, frames[12:])
    foot_variance = np.full(len(y), foot_acceleration**2)
    for row in range(0, len(y), 6):
        foot_variance[row : row + 3] = foot_angular_acceleration**2
    acceleration, sensitivity, innovation, innovation_variance = fuse(raw, variance, J, y, foot_variance)
    posterior[acceleration_at : acceleration_at + v], posterior[known : known + v - 6] = acceleration, 1.0
    posterior[sensitivity_at : sensitivity_at + v * v] = sensitivity.ravel()
    row = 0
    for foot in range(len(stands)):
        if stands[foot]:
            for i in range(6):
                posterior[innovation_at + 6 * foot + i] = innovation[row + i]
                posterior[variance_at + 6 * foot + i] = innovation_variance[row + i]
            row += 6


class JointAccelerationEstimator(RecursiveEstimator):
    """Accelerations of base and joints over the tick that ends now.

    .. pydrake_system::

        name: JointAccelerationEstimator
        input_ports:
        - measurements
        - attitude
        - model_at_step_start
        output_ports:
        - posterior

    Inputs: posteriors of `SensorMonitor` and `AttitudeEstimator`, and the terms of `FloatingBaseModel` where the tick began. Fields of the
    posterior:

        base_angular_acceleration, base_specific_force   (3,)  in base axes [rad/s^2, m/s^2]
        joint_acceleration    (n,)  [rad/s^2]
        known                 (n,)  1 for a joint whose acceleration is known; the paper's methods do not know the swing leg's
        sensitivity           (v, v)  of these three to what gyro, accelerometer and encoders say of them
        innovation, innovation_variance  (feet, 6)  of the no-slip condition; zero for a foot that swings
    """

    def __init__(
        self,
        config: JointAccelerationConfig,
        robot: Robot,
        measurements: dict[str, slice],
        attitude: dict[str, slice],
        model: dict[str, slice],
        clock: Clock,
    ):
        n, feet = len(robot.joint_names), len(robot.description.sides)
        v = 6 + n
        super().__init__(
            {
                "status": 1,
                "base_angular_acceleration": 3,
                "base_specific_force": 3,
                "joint_acceleration": n,
                "known": n,
                "sensitivity": v * v,
                "innovation": 6 * feet,
                "innovation_variance": 6 * feet,
            },
            clock,
        )
        self._method, self._n, self._v = config.method, n, v
        mount = ImuMount(robot)
        self._frames = np.concatenate([mount.R_BI.ravel(), mount.p_BI, robot.plant.gravity_field().gravity_vector()])
        self._noise = np.array(astuple(config)[1:], dtype=float)  # All but the method.
        self._trust, self._support = measurements["trust"].start, measurements["support"]
        self._sensor_places = np.array(
            [
                *starts(measurements, "joint_velocity", "specific_force", "angular_velocity"),
                model["velocity"].start,
                model["velocity"].stop,
            ]
        )
        self._no_slip_places = np.array([*starts(model, "foot_jacobian", "foot_bias", "foot_rotation"), *starts(attitude, "rotation")])
        written = ("base_angular_acceleration", "known", "sensitivity", "innovation", "innovation_variance")
        self._places = np.array([self._trust, self._support.start, self._support.stop, *starts(self.fields.slices, *written)])
        legs = [leg.joints for leg in robot.description.legs.values()]
        self._legs = [np.array([robot.joint_names.index(name) for name in joints]) for joints in legs]
        for name, parts in (("measurements", measurements), ("attitude", attitude), ("model_at_step_start", model)):
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        names = ("measurements", "attitude", "model_at_step_start")
        self._measurements, self._attitude, self._model = (self.GetInputPort(name) for name in names)
        self._declare_posterior(*names)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        measured, attitude, model = self._measurements.Eval(context), self._attitude.Eval(context), self._model.Eval(context)
        if last.item(STATUS):
            elapsed = math.nan  # Velocities are differentiated: both ends of the tick must be trusted.
        if self._method != "fused":
            self._solve_no_slip(posterior, elapsed, measured, attitude, model)
            return
        _fuse_accelerations(
            posterior,
            elapsed,
            measured,
            attitude,
            model,
            self._sensor_places,
            self._no_slip_places,
            self._places,
            self._frames,
            self._noise,
        )

    def _solve_no_slip(self, posterior: np.ndarray, elapsed: float, measured: np.ndarray, attitude: np.ndarray, model: np.ndarray) -> None:
        """One tick by one of the paper's methods, which have the joints of the feet that stand from the other sensors."""
        if not _begin(posterior, elapsed, measured, model, self._trust, self._sensor_places):
            return
        stands = standing_feet(measured[self._support], measured, self._trust)
        acceleration = measured_acceleration(measured, model, elapsed, self._sensor_places, self._frames)
        sensitivity, known = np.eye(self._v), np.zeros(self._n)
        acceleration[6:] = sensitivity[6:] = 0.0
        if stands.any():
            J, y = no_slip_condition(model, attitude, stands, self._no_slip_places, self._v, self._frames[12:])
            joints = np.concatenate([self._legs[k] for k in np.flatnonzero(stands)])
            known[joints] = 1.0
            columns = 6 + joints
            if self._method == "minimum_norm":
                unknown = np.concatenate([np.arange(3), columns])
                acceleration[unknown] = minimum_norm(J[:, unknown], y - J[:, 3:6] @ acceleration[3:6])
            else:
                acceleration[columns] = np.linalg.solve(J[:, columns], y - J[:, :6] @ acceleration[:6])
        posterior[STATUS + 1 : self.fields["innovation"].start] = np.concatenate([acceleration, known, sensitivity.ravel()])
