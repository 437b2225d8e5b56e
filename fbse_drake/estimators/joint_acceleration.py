"""Joint accelerations of a robot whose standing feet do not slip (paper Sec. 5)."""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context
from scipy.linalg.lapack import dposv

from fbse_drake.errors import InputError
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
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
        for name in (
            "acceleration_noise",
            "angular_velocity_noise",
            "joint_velocity_noise",
            "foot_angular_acceleration",
            "foot_acceleration",
        ):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected a number > 0, found {getattr(self, name):g}")


def minimum_norm(J: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Shortest solution of J x = y for a wide J: J^T (J J^T)^-1 y, paper eqs. (42), (46)."""
    return J.T @ np.linalg.solve(J @ J.T, y)


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
    JP = J * variance
    S = JP @ J.T
    S.flat[:: len(y) + 1] += constraint_variance
    innovation = y - J @ measured
    # Gain, transposed, and correction from one Cholesky solution.
    _, gain, _ = dposv(S, JP)
    return measured + innovation @ gain, np.eye(len(measured)) - gain.T @ J, innovation, S.flat[:: len(y) + 1]


class JointAccelerationEstimator(RecursiveEstimator):
    """Accelerations of base and joints over the tick that ends now.

    .. pydrake_system::

        name: JointAccelerationEstimator
        input_ports:
        - measurements
        - attitude
        - support
        - model_at_step_start
        output_ports:
        - posterior

    Inputs: posteriors of `SensorMonitor` and `AttitudeEstimator`, a support estimate (feet,), and the terms of `FloatingBaseModel` where the
    tick began. Fields of the posterior:

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
        # All accelerations together.
        self.acceleration = slice(self.fields["base_angular_acceleration"].start, self.fields["joint_acceleration"].stop)
        self._config, self._measured, self._attitude, self._model = config, measurements, attitude, model
        self._mount, self._n, self._v, self._feet = ImuMount(robot), n, v, feet
        self._gravity = robot.plant.gravity_field().gravity_vector()
        legs = [leg.joints for leg in robot.description.legs.values()]
        self._legs = [np.array([robot.joint_names.index(name) for name in joints]) for joints in legs]
        # Noise of accelerations: differences of velocities have it twice, over the tick (see _tick).
        self._velocity_variance = np.zeros(v)
        self._velocity_variance[:3] = 2 * config.angular_velocity_noise**2
        self._velocity_variance[6:] = 2 * config.joint_velocity_noise**2
        self._acceleration_variance = np.zeros(v)
        self._acceleration_variance[3:6] = config.acceleration_noise**2
        self._foot_variance = np.repeat([config.foot_angular_acceleration**2, config.foot_acceleration**2], 3)
        for name, parts in (("measurements", measurements), ("attitude", attitude), ("model_at_step_start", model)):
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        self.DeclareVectorInputPort("support", feet)
        names = ("measurements", "attitude", "model_at_step_start", "support")
        self._ports = [self.GetInputPort(name) for name in names]
        self._declare_posterior(*names)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        if math.isnan(elapsed):
            return np.zeros(self.fields.size)
        measured, attitude, model, support = (port.Eval(context) for port in self._ports)
        config, fields = self._config, self.fields
        posterior = np.zeros(fields.size)
        trust = measured[self._measured["trust"]].tolist()
        posterior[0] = max(trust[:2])
        if trust[0] or trust[1]:
            return posterior
        v_start = model[self._model["velocity"]]
        if not v_start.any():
            return posterior
        w = self._mount.R_BI @ measured[self._measured["angular_velocity"]]
        raw = np.empty(self._v)
        w_start = v_start[:3]
        raw[:3] = w_dot = (w - w_start) / elapsed
        raw[3:6] = self._mount.base_specific_force(measured[self._measured["specific_force"]], w_start, w_dot)
        raw[6:] = (measured[self._measured["joint_velocity"]] - v_start[6:]) / elapsed
        stands = [k for k in range(self._feet) if support[k] > 0 and not trust[2 + k]]
        if config.method == "fused":
            acceleration, sensitivity = raw, np.eye(self._v)
            if stands:
                J, y = self._no_slip(model, attitude, stands)
                variance = self._velocity_variance / elapsed**2 + self._acceleration_variance
                acceleration, sensitivity, innovation, innovation_variance = fuse(
                    raw, variance, J, y, np.tile(self._foot_variance, len(stands))
                )
                for row, k in enumerate(stands):
                    part, to = slice(6 * row, 6 * row + 6), slice(6 * k, 6 * k + 6)
                    posterior[fields["innovation"]][to] = innovation[part]
                    posterior[fields["innovation_variance"]][to] = innovation_variance[part]
            known = np.ones(self._n)
        else:
            acceleration, sensitivity = raw, np.eye(self._v)
            acceleration[6:] = sensitivity[6:] = 0.0
            known = np.zeros(self._n)
            if stands:
                J, y = self._no_slip(model, attitude, stands)
                joints = np.concatenate([self._legs[k] for k in stands])
                known[joints] = 1.0
                columns = 6 + joints
                if config.method == "minimum_norm":
                    unknown = np.concatenate([np.arange(3), columns])
                    acceleration[unknown] = minimum_norm(J[:, unknown], y - J[:, 3:6] @ raw[3:6])
                else:
                    acceleration[columns] = np.linalg.solve(J[:, columns], y - J[:, :6] @ raw[:6])
        posterior[self.acceleration] = acceleration
        posterior[fields["known"]] = known
        posterior[fields["sensitivity"]] = sensitivity.ravel()
        return posterior

    def _no_slip(self, model: np.ndarray, attitude: np.ndarray, stands: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """J and y of J a = y, eq. (41) with p_m_ddot = 0, for the feet that stand.

        The base's acceleration in `a` is its specific force, so a foot at rest accelerates with minus gravity.
        """
        J = model[self._model["foot_jacobian"]].reshape(self._feet, 6, self._v)
        bias = model[self._model["foot_bias"]].reshape(self._feet, 6)
        R_FB = model[self._model["foot_rotation"]].reshape(self._feet, 3, 3).transpose(0, 2, 1)
        gravity_B = attitude[self._attitude["rotation"]].reshape(3, 3).T @ self._gravity
        y = -bias
        y[:, 3:] -= R_FB @ gravity_B
        if len(stands) == self._feet:
            return J.reshape(-1, self._v), y.ravel()
        return J[stands].reshape(-1, self._v), y[stands].ravel()
