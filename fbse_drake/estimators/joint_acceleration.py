"""Joint accelerations of a robot whose standing feet do not slip (paper Sec. 5)."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.floating_base import ImuMount, base_specific_force, model_type
from fbse_drake.estimators.innovations import AGREEMENT_TIME
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.estimators.spatial import (
    put,
    rotate,
    rotate_back,
    rotation,
    scale,
    subtract,
    vector,
)
from fbse_drake.robot.plant import Robot


@dataclass(frozen=True)
class JointAccelerationConfig:
    """How accelerations are had."""

    # `minimum_norm`: the paper's (42), (46); `gyro`: the same with the base's angular acceleration
    # from the gyro, which makes the equations square; `fused`: both and the encoders by weighted
    # least squares, which gives the swing leg as well.
    method: str = "fused"
    # What a standing foot accelerates in spite of all: angular [rad/s^2] and linear [m/s^2].
    foot_angular_acceleration: float = 1.0
    foot_acceleration: float = 0.1

    def __post_init__(self) -> None:
        if self.method not in ("minimum_norm", "gyro", "fused"):
            raise InputError(f"method: expected minimum_norm, gyro or fused, found {self.method}")
        require_positive(self, "foot_angular_acceleration", "foot_acceleration")


def minimum_norm(J: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Shortest solution of J x = y for a wide J: J^T (J J^T)^-1 y, paper eqs. (42), (46)."""
    return J.T @ np.linalg.solve(J @ J.T, y)


@njit(cache=True)
def solve_positive_definite(S: np.ndarray, B: np.ndarray) -> None:
    """Replaces B (c, m) by S^-1 B, by Cholesky.

    S (c, c) is symmetric positive definite and is overwritten.
    """
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
    measured: np.ndarray,
    variance: np.ndarray,
    J: np.ndarray,
    y: np.ndarray,
    constraint_variance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Weighted least squares of measured accelerations and J x = y.

    Args:
        measured: shape (v,), with independent errors of `variance` (v,).
        J: shape (c, v); y: shape (c,), with independent errors of `constraint_variance` (c,).

    Returns:
        The accelerations x (v,), dx/dmeasured (v, v), the innovation y - J measured (c,) and its
        variance (c,).
    """
    c, v = J.shape
    gain, S, innovation, x = np.empty((c, v)), np.zeros((c, c)), y.copy(), measured.copy()
    J_T, innovation_variance, sensitivity = np.empty((v, c)), np.empty(c), np.zeros((v, v))
    for k in range(v):
        sensitivity[k, k] = 1.0
        for i in range(c):
            J_T[k, i] = J[i, k]
    for i in range(c):
        for k in range(v):
            gain[i, k] = J[i, k] * variance[k]
            innovation[i] -= J[i, k] * measured[k]
            for j in range(i + 1):
                S[i, j] += gain[i, k] * J_T[k, j]
        S[i, i] += constraint_variance[i]
        innovation_variance[i] = S[i, i]
    solve_positive_definite(S, gain)  # the gain's transpose
    for i in range(c):
        for k in range(v):
            x[k] += gain[i, k] * innovation[i]
            for j in range(v):
                sensitivity[k, j] -= gain[i, k] * J[i, j]
    return x, sensitivity, innovation, innovation_variance


@njit(cache=True)
def measured_acceleration(
    last_rate: np.ndarray,
    measured: np.ndarray,
    attitude: np.ndarray,
    model: np.ndarray,
    elapsed: float,
    known: np.ndarray,
) -> np.ndarray:
    """What gyro, accelerometer and encoders say of the accelerations of base and joints.

    Args:
        last_rate: the gyro's reading a tick ago in base axes, (3,) [rad/s].
        measured, attitude, model: records of the posteriors of `SensorMonitor`, of
            `AttitudeEstimator` or `InvariantBaseFilter`, and of `FloatingBaseModel` where the tick
            began.
        known: see `_fuse_accelerations`.

    Returns:
        Shape (v,), see `JointAccelerationEstimator`.
    """
    R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    v, velocity = len(model.velocity), model.velocity
    acceleration = np.empty(v)
    w_start = vector(velocity)
    # Both readings have the same bias.
    w = rotate(R_BI, vector(measured.angular_velocity))
    w_dot = scale(1.0 / elapsed, subtract(w, vector(last_rate)))
    put(acceleration[:3], w_dot)
    force = subtract(vector(measured.mean.specific_force), vector(attitude.acceleration_bias))
    put(acceleration[3:6], base_specific_force(force, w_start, w_dot, R_BI, p_BI))
    for i in range(6, v):
        acceleration[i] = (measured.joint_velocity[i - 6] - velocity[i]) / elapsed
    return acceleration


@njit(cache=True)
def no_slip_condition(
    model: np.ndarray,
    attitude: np.ndarray,
    stands: np.ndarray,
    still_from: np.ndarray,
    gravity: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """J (c, v) and y (c,) of J a = y, eq. (41) with p_m_ddot = 0, for the feet that stand.

    The base's acceleration in `a` is its specific force, so a foot at rest accelerates with minus
    gravity. A point foot may turn: of its twist only the linear half is ruled.

    Args:
        model, attitude: records of the posteriors of `FloatingBaseModel` where the tick began, and
            of `AttitudeEstimator`.
        stands: the feet that stand, shape (feet,), bool.
        still_from: see `still_rows`, (feet,).
        gravity: in world axes, shape (3,) [m/s^2].
    """
    rows = (stands * (6 - still_from)).sum()
    J, y = np.empty((rows, len(model.velocity))), np.empty(rows)
    gravity_B = rotate_back(rotation(attitude.rotation), vector(gravity))
    row = 0
    for foot in range(len(stands)):
        if stands[foot]:
            gravity_F = rotate_back(rotation(model.foot_rotation[foot]), gravity_B)
            for i in range(still_from[foot], 6):
                for j in range(J.shape[1]):
                    J[row, j] = model.foot_jacobian[foot, i, j]
                y[row] = -model.foot_bias[foot, i]
                if i >= 3:
                    y[row] -= gravity_F[i - 3]
                row += 1
    return J, y


def still_rows(robot: Robot) -> np.ndarray:
    """Of each foot, from which row of its twist [angular, linear] on it is still while it stands,
    (feet,): 0 of a flat foot, 3 of a point foot."""
    return np.array([3 if leg.is_point else 0 for leg in robot.description.legs.values()])


@njit(cache=True)
def standing_feet(measured: np.ndarray) -> np.ndarray:
    """Feet that stand and whose sensors are trusted, shape (feet,), bool."""
    stands = np.empty(len(measured.support), dtype=np.bool_)
    for foot in range(len(stands)):
        stands[foot] = measured.support[foot] > 0 and measured.trust[2 + foot] == 0
    return stands


@njit(cache=True)
def _begin(
    posterior: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> bool:
    """Sets a posterior to zero but for its status.

    Returns:
        Is there something to estimate from?
    """
    posterior.base_angular_acceleration[:] = 0.0
    posterior.base_specific_force[:] = 0.0
    posterior.joint_acceleration[:] = 0.0
    posterior.known[:] = 0.0
    posterior.sensitivity[:] = 0.0
    posterior.innovation[:] = 0.0
    posterior.innovation_variance[:] = 0.0
    posterior.agreement[:] = 0.0
    posterior.status = max(measured.trust[0], measured.trust[1])
    w_I = vector(measured.angular_velocity)
    put(posterior.rate, rotate(rotation(known.mount.R_BI), w_I))
    if math.isnan(elapsed):
        return False
    # Where the tick began there may have been no measurement yet.
    return posterior.status == 0 and model.velocity.any()


@njit(cache=True)
def _foot_variance(
    posterior: np.ndarray,
    last: np.ndarray,
    raw: np.ndarray,
    J: np.ndarray,
    y: np.ndarray,
    stands: np.ndarray,
    elapsed: float,
    known: np.ndarray,
) -> np.ndarray:
    """Variance of what standing feet accelerate, one for each row of the no-slip condition.

    Where the other sensors keep saying that a foot does accelerate, because it slips, rolls or
    sinks, it is believed to: by the mean that their noise does not reach, for as many ticks as that
    mean lasts. The running means are filled.
    """
    keep, row, config = math.exp(-elapsed / AGREEMENT_TIME), 0, known.config
    count = (1.0 + keep) / (1.0 - keep)
    variance = np.empty(len(y))
    for foot in range(len(stands)):
        agreement = posterior.agreement[foot]
        agreement[:] = 0.0
        if not stands[foot]:
            continue
        first = known.still_from[foot]
        start_row = row - first
        for i in range(first, 6):
            innovation = y[start_row + i]
            for k in range(len(raw)):
                innovation -= J[start_row + i, k] * raw[k]
            agreement[i] = keep * last.agreement[foot, i] + (1.0 - keep) * innovation
        for start, size in ((0, config.foot_angular_acceleration), (3, config.foot_acceleration)):
            if start < first:
                continue
            x, y_, z = agreement[start], agreement[start + 1], agreement[start + 2]
            mean_square = (x * x + y_ * y_ + z * z) / 3.0
            at = start_row + start
            variance[at : at + 3] = size**2 + count * mean_square
        row += 6 - first
    return variance


@njit(cache=True)
def _fuse_accelerations(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    attitude: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> None:
    """One tick of `JointAccelerationEstimator` by the fused method; fills the posterior.

    Args:
        known: record with the numbers of `JointAccelerationConfig` and `SensorBeliefs`, `mount`,
            see `ImuMount`, `gravity` (3,) [m/s^2] and `still_from`, see `still_rows`.
    """
    posterior, last, measured = posterior[()], last[()], measured[()]
    attitude, model, known = attitude[()], model[()], known[()]
    if not _begin(posterior, elapsed, measured, model, known):
        return
    noise, stands = known.sensors, standing_feet(measured)
    raw = measured_acceleration(last.rate, measured, attitude, model, elapsed, known)
    # Differences of velocities have their noise twice.
    variance = np.full(len(raw), 2 * (noise.joint_velocity_noise / elapsed) ** 2)
    variance[:3] = 2 * (noise.angular_velocity_noise / elapsed) ** 2
    variance[3:6] = noise.acceleration_noise**2
    J, y = no_slip_condition(model, attitude, stands, known.still_from, known.gravity)
    foot_variance = _foot_variance(posterior, last, raw, J, y, stands, elapsed, known)
    fused, sensitivity, innovation, innovation_variance = fuse(raw, variance, J, y, foot_variance)
    for i in range(3):
        posterior.base_angular_acceleration[i] = fused[i]
        posterior.base_specific_force[i] = fused[3 + i]
    for i in range(len(posterior.known)):
        posterior.joint_acceleration[i] = fused[6 + i]
        posterior.known[i] = 1.0
    for i in range(len(fused)):
        for j in range(len(fused)):
            posterior.sensitivity[i, j] = sensitivity[i, j]
    row = 0
    for foot in range(len(stands)):
        if stands[foot]:
            for i in range(known.still_from[foot], 6):
                posterior.innovation[foot, i] = innovation[row]
                posterior.innovation_variance[foot, i] = innovation_variance[row]
                row += 1


@njit(cache=True)
def _no_slip_problem(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    attitude: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What the paper's methods start from; the posterior is set to zero but for its status.

    Returns:
        Is there something to estimate from? If so, the feet that stand, see `standing_feet`, their
        `no_slip_condition`, and the `measured_acceleration`.
    """
    posterior, last, measured = posterior[()], last[()], measured[()]
    attitude, model, known = attitude[()], model[()], known[()]
    stands = standing_feet(measured)
    J, y = no_slip_condition(model, attitude, stands, known.still_from, known.gravity)
    if not _begin(posterior, elapsed, measured, model, known):
        return False, stands, J, y, np.empty(0)
    acceleration = measured_acceleration(last.rate, measured, attitude, model, elapsed, known)
    return True, stands, J, y, acceleration


class JointAccelerationEstimator(RecursiveEstimator):
    """Accelerations of base and joints over the tick that ends now.

    .. pydrake_system::

        name: JointAccelerationEstimator
        input_ports:
        - measurements
        - attitude
        - model_over_step
        output_ports:
        - posterior
        - (one for each field)

    Inputs: posteriors of `SensorMonitor` and `AttitudeEstimator`, and the terms of
    `FloatingBaseModel` where the tick began. Fields of the posterior:

        base_angular_acceleration, base_specific_force   (3,)  in base axes [rad/s^2, m/s^2]
        joint_acceleration    (n,)    [rad/s^2]
        known                 (n,)    1 for a joint whose acceleration is known; the paper's methods
                                      do not know the swing leg's
        sensitivity           (v, v)  of these three to what gyro, accelerometer and encoders say
        innovation, innovation_variance  (feet, 6)  of the no-slip condition; zero for a foot that
                                      swings, and of a point foot's turning
        agreement             (feet, 6)  running mean of the innovation
        rate                  (3,)    the gyro's reading in base axes [rad/s]
    """

    def __init__(
        self,
        config: JointAccelerationConfig,
        sensors: SensorBeliefs,
        robot: Robot,
        measurements: np.dtype,
        attitude: np.dtype,
        model_over_step: np.dtype,
        clock: Clock,
    ):
        """Declares ports and state.

        Args:
            measurements, attitude, model_over_step: types of the inputs.
        """
        n, feet = len(robot.joint_names), len(robot.description.sides)
        v = 6 + n
        posterior_type = record_type(
            time=(),
            status=(),
            base_angular_acceleration=(3,),
            base_specific_force=(3,),
            joint_acceleration=(n,),
            known=(n,),
            sensitivity=(v, v),
            innovation=(feet, 6),
            innovation_variance=(feet, 6),
            agreement=(feet, 6),
            rate=(3,),
        )
        super().__init__(posterior_type, clock)
        self._method = config.method
        mount = record(**vars(ImuMount(robot)))
        gravity = robot.plant.gravity_field().gravity_vector()
        still_from = still_rows(robot)
        self._known = record(
            config=config, sensors=sensors, mount=mount, gravity=gravity, still_from=still_from
        )
        legs = [leg.joints for leg in robot.description.legs.values()]
        self._legs = [np.array([robot.joint_names.index(x) for x in joints]) for joints in legs]
        self._measurements = self._declare_record_input("measurements", measurements)
        self._attitude = self._declare_record_input("attitude", attitude)
        self._model = self._declare_record_input("model_over_step", model_over_step)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        return {
            "measurements": measurements_type(robot),
            "attitude": record_type(rotation=(3, 3), acceleration_bias=(3,)),
            "model_over_step": model_type(robot),
        }

    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        measured, attitude = self._measurements.Eval(context), self._attitude.Eval(context)
        model = self._model.Eval(context)
        if last["status"]:
            elapsed = math.nan  # Velocities are differentiated: both ends must be trusted.
        solve = _fuse_accelerations if self._method == "fused" else self._solve_no_slip
        solve(posterior, last, elapsed, measured, attitude, model, self._known)

    def _solve_no_slip(
        self,
        posterior: np.ndarray,
        last: np.ndarray,
        elapsed: float,
        measured: np.ndarray,
        attitude: np.ndarray,
        model: np.ndarray,
        known: np.ndarray,
    ) -> None:
        """One tick by one of the paper's methods.

        They have the joints of the feet that stand from the other sensors.
        """
        found, stands, J, y, acceleration = _no_slip_problem(
            posterior, last, elapsed, measured, attitude, model, known
        )
        if not found:
            return
        sensitivity = np.eye(len(acceleration))
        acceleration[6:] = sensitivity[6:] = 0.0
        if stands.any():
            joints = np.concatenate([self._legs[k] for k in np.flatnonzero(stands)])
            posterior["known"][joints] = 1.0
            columns = 6 + joints
            if self._method == "minimum_norm":
                unknown = np.concatenate([np.arange(3), columns])
                right = y - J[:, 3:6] @ acceleration[3:6]
                acceleration[unknown] = minimum_norm(J[:, unknown], right)
            else:
                right = y - J[:, :6] @ acceleration[:6]
                acceleration[columns] = np.linalg.solve(J[:, columns], right)
        posterior["base_angular_acceleration"] = acceleration[:3]
        posterior["base_specific_force"] = acceleration[3:6]
        posterior["joint_acceleration"] = acceleration[6:]
        posterior["sensitivity"] = sensitivity
