"""Base attitude from the IMU: a Kalman filter for gravity feeds an extended Kalman filter on the quaternion (paper Sec. 3, Fig. 2)."""

import math
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RotationMatrix
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.robot.plant import Robot

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# What the angular velocity is taken to be while the gyro is not trusted [rad/s].
_UNKNOWN_RATE = 0.3


@dataclass(frozen=True)
class AttitudeConfig:
    """Noise as the filters believe it, and what they estimate besides the attitude."""

    # Standard deviation of white noise per axis and sample [m/s^2], [rad/s].
    acceleration_noise: float = 0.02
    angular_velocity_noise: float = 1.0e-3
    # The trunk's linear acceleration: its size [m/s^2] and how long it keeps its direction [s].
    motion_acceleration: float = 0.5
    motion_time: float = 0.3
    # How large a constant accelerometer bias [m/s^2] and gyro bias [rad/s] may be; 0 does not estimate it.
    acceleration_bias: float = 0.0
    angular_velocity_bias: float = 0.0
    # Robots start standing: for this long [s] the trunk accelerates [m/s^2] and turns [rad/s] by no more than this.
    standing_time: float = 0.05
    standing_acceleration: float = 0.1
    standing_rate: float = 3.0e-3
    # How level the sole of a standing foot is (standard deviation [rad]): the legs then tell the tilt as well, on level ground. 0 does not use
    # them, as the paper.
    level_feet: float = 2.0e-3
    # How long a foot keeps its error [s].
    stance_time: float = 0.5

    def __post_init__(self) -> None:
        for name in (
            "acceleration_bias",
            "angular_velocity_bias",
            "angular_velocity_noise",
            "standing_time",
            "standing_acceleration",
            "level_feet",
        ):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected a number >= 0, found {getattr(self, name):g}")
        for name in ("acceleration_noise", "motion_acceleration", "motion_time", "stance_time"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected a number > 0, found {getattr(self, name):g}")


def cross(a: Vector, b: Vector) -> Vector:
    """a x b. (On floats: for single vectors that is many times faster than numpy.)"""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def quaternion_product(a: Quaternion, b: Quaternion) -> Quaternion:
    """a * b of quaternions [w, x, y, z]."""
    w, x, y, z = a
    s, i, j, k = b
    return w * s - x * i - y * j - z * k, w * i + x * s + y * k - z * j, w * j - x * k + y * s + z * i, w * k + x * j - y * i + z * s


def rotation_vector_to_quaternion(r: Vector) -> Quaternion:
    """Quaternion of a rotation by |r| [rad] about r."""
    half = 0.5 * math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    scale = 0.5 if half < 1e-8 else math.sin(half) / (2.0 * half)
    return math.cos(half), scale * r[0], scale * r[1], scale * r[2]


def normalized(q: Quaternion) -> Quaternion:
    """The norm correction: the quaternion of unit length in q's direction."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale


def yaw_of(q: Quaternion) -> float:
    """z-Euler angle of a quaternion (z-y-x order) [rad]."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def quaternion_from_gravity(up: Vector, yaw: float) -> Quaternion:
    """Quaternion with the x- and y-Euler angles that make `up` vertical, and this z-Euler angle.

    Args:
        up: direction of the specific force at rest, in the rotated frame, any length.
    """
    roll = math.atan2(up[1], up[2])
    pitch = math.atan2(-up[0], math.hypot(up[1], up[2]))
    cr, sr, cp, sp, cy, sy = (f(0.5 * angle) for angle in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def rotation_matrix(q: Quaternion) -> np.ndarray:
    """Matrix of a unit quaternion, shape (3, 3)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@dataclass(frozen=True)
class GravityEstimate:
    """State of the gravity filter, in IMU axes [m/s^2]. The three axes share one covariance, for states and noise are isotropic."""

    # Specific force of rest (minus gravity), linear acceleration, accelerometer bias.
    gravity: Vector
    acceleration: Vector
    bias: Vector
    # Upper triangle of the covariance of one axis: gg, ga, gb, aa, ab, bb.
    covariance: tuple[float, float, float, float, float, float]
    # Measured minus predicted specific force, and its variance per axis.
    innovation: Vector = (0.0, 0.0, 0.0)
    innovation_variance: float = 0.0


def start_gravity(config: AttitudeConfig, specific_force: Vector) -> GravityEstimate:
    """Decomposes the first reading by the pseudo-inverse, weighted with how large each part may be.

    (The paper's plain pseudo-inverse gives each part a third of the reading; weights put nearly all of it where it belongs.)
    """
    prior = (9.81**2, config.standing_acceleration**2, config.acceleration_bias**2)
    total = sum(prior) + config.acceleration_noise**2
    parts = [tuple(variance / total * y for y in specific_force) for variance in prior]
    # Covariance of one axis given the reading.
    g, a, b = prior
    covariance = (g - g * g / total, -g * a / total, -g * b / total, a - a * a / total, -a * b / total, b - b * b / total)
    return GravityEstimate(parts[0], parts[1], parts[2], covariance)


def predict_gravity(
    config: AttitudeConfig, x: GravityEstimate, w: Vector, rate_variance: float, motion_acceleration: float, elapsed: float
) -> GravityEstimate:
    """Gravity and linear acceleration turn with the IMU; the acceleration fades as a first-order Gauss-Markov process.

    Args:
        w: angular velocity [rad/s].
        rate_variance: variance of w [(rad/s)^2].
        motion_acceleration: standard deviation of the linear acceleration [m/s^2].
        elapsed: time step [s].
    """
    fade = math.exp(-elapsed / config.motion_time)
    turned_g, turned_a = cross(x.gravity, w), cross(x.acceleration, w)
    gravity = tuple(g + elapsed * t for g, t in zip(x.gravity, turned_g, strict=True))
    acceleration = tuple(fade * (a + elapsed * t) for a, t in zip(x.acceleration, turned_a, strict=True))
    gg, ga, gb, aa, ab, bb = x.covariance
    gg += (9.81 * elapsed) ** 2 * rate_variance
    aa = fade * fade * aa + (1 - fade * fade) * motion_acceleration**2
    return GravityEstimate(gravity, acceleration, x.bias, (gg, fade * ga, gb, aa, fade * ab, bb))


def update_gravity(config: AttitudeConfig, x: GravityEstimate, specific_force: Vector) -> GravityEstimate:
    """Kalman update with y = gravity + acceleration + bias + noise."""
    gg, ga, gb, aa, ab, bb = x.covariance
    pg, pa, pb = gg + ga + gb, ga + aa + ab, gb + ab + bb
    S = pg + pa + pb + config.acceleration_noise**2
    kg, ka, kb = pg / S, pa / S, pb / S
    e = tuple(y - g - a - b for y, g, a, b in zip(specific_force, x.gravity, x.acceleration, x.bias, strict=True))
    return GravityEstimate(
        tuple(g + kg * v for g, v in zip(x.gravity, e, strict=True)),
        tuple(a + ka * v for a, v in zip(x.acceleration, e, strict=True)),
        tuple(b + kb * v for b, v in zip(x.bias, e, strict=True)),
        (gg - kg * pg, ga - kg * pa, gb - kg * pb, aa - ka * pa, ab - ka * pb, bb - kb * pb),
        e,
        S,
    )


@dataclass(frozen=True)
class QuaternionEstimate:
    """State of the quaternion filter. Attitude error and gyro bias are isotropic and share one 2 x 2 covariance for all axes."""

    # Attitude of the IMU in the world.
    q: Quaternion
    # Gyro bias in IMU axes [rad/s].
    bias: Vector
    # Covariance of [attitude error, bias error] of one axis: [rad^2], [rad^2/s], [rad^2/s^2].
    covariance: tuple[float, float, float]
    # Rotation from the predicted to the measured quaternion [rad], and its variance per axis.
    innovation: Vector = (0.0, 0.0, 0.0)
    innovation_variance: float = 0.0


def predict_quaternion(config: AttitudeConfig, x: QuaternionEstimate, w: Vector, elapsed: float) -> QuaternionEstimate:
    """Turns the quaternion with the gyro, free of its bias."""
    turn = tuple(elapsed * (rate - b) for rate, b in zip(w, x.bias, strict=True))
    pp, pb, bb = x.covariance
    covariance = (
        pp - 2 * elapsed * pb + elapsed**2 * (bb + config.angular_velocity_noise**2),
        pb - elapsed * bb,
        bb,
    )
    return QuaternionEstimate(quaternion_product(x.q, rotation_vector_to_quaternion(turn)), x.bias, covariance)


def update_quaternion(x: QuaternionEstimate, measured: Quaternion, variance: float, correlated: float) -> QuaternionEstimate:
    """Extended Kalman update with a measured quaternion, written for the small rotation between prediction and measurement,
    followed by the norm correction; q and -q count as the same attitude.

    Args:
        variance: of the measured attitude about each horizontal axis [rad^2].
        correlated: number of ticks for which its error lasts; so many measurements count as one.
    """
    w, i, j, k = quaternion_product((x.q[0], -x.q[1], -x.q[2], -x.q[3]), measured)
    sign = 2.0 if w >= 0 else -2.0
    e = (sign * i, sign * j, sign * k)
    pp, pb, bb = x.covariance
    S = pp + variance * max(1.0, correlated)
    kp, kb = pp / S, pb / S
    turn = rotation_vector_to_quaternion((kp * e[0], kp * e[1], kp * e[2]))
    return QuaternionEstimate(
        normalized(quaternion_product(x.q, turn)),
        tuple(b + kb * v for b, v in zip(x.bias, e, strict=True)),
        (pp - kp * pp, pb - kp * pb, bb - kb * pb),
        e,
        pp + variance,
    )


class AttitudeEstimator(RecursiveEstimator):
    """Attitude of the base from accelerometer and gyro (paper Sec. 3).

    .. pydrake_system::

        name: AttitudeEstimator
        input_ports:
        - measurements
        - support
        - model
        output_ports:
        - posterior

    Inputs: posteriors of `SensorMonitor` and `FloatingBaseModel`, and a support estimate (feet,). Fields of the posterior:

        orientation            (4,)  quaternion [w, x, y, z] of the base in the world (eq. 6); its sign never jumps
        rotation               (9,)  R_WB, row by row
        angular_velocity       (3,)  of the base in base axes, free of the estimated gyro bias [rad/s]
        gravity, acceleration, acceleration_bias, angular_velocity_bias   (3,) each, in IMU axes [m/s^2, rad/s]
        covariance             (9,)  gravity filter (6) and quaternion filter (3) per axis, see `GravityEstimate`, `QuaternionEstimate`
        innovation, innovation_variance   of gravity filter, quaternion filter, and quaternion filter from the feet, (9,) and (3,)

    Yaw is the gyro's alone: the gravity filter borrows it for its measured quaternion.
    """

    def __init__(self, config: AttitudeConfig, robot: Robot, measurements: dict[str, slice], model: dict[str, slice], clock: Clock):
        super().__init__(
            {
                "orientation": 4,
                "rotation": 9,
                "angular_velocity": 3,
                "age": 1,
                "imu_orientation": 4,
                "gravity": 3,
                "acceleration": 3,
                "acceleration_bias": 3,
                "angular_velocity_bias": 3,
                "covariance": 9,
                "innovation": 9,
                "innovation_variance": 3,
            },
            clock,
        )
        self._config, self._inputs = config, measurements
        self._R_BI = ImuMount(robot).R_BI
        self._q_IB = quaternion_of_matrix(self._R_BI.T)
        self._foot_rotation = model["foot_rotation"]
        self._measurements = self.DeclareVectorInputPort("measurements", max(part.stop for part in measurements.values()))
        self._support = self.DeclareVectorInputPort("support", len(robot.description.sides))
        self._model = self.DeclareVectorInputPort("model", max(part.stop for part in model.values()))
        self._declare_posterior("measurements", "support", "model")

    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        config = self._config
        measured = self._measurements.Eval(context)
        trust = measured[self._inputs["trust"]][1]
        f = tuple(measured[self._inputs["specific_force"]].tolist())
        w = tuple(measured[self._inputs["angular_velocity"]].tolist())
        feet = ((0.0, 0.0, 0.0), 0.0)
        age = 0.0 if math.isnan(elapsed) else float(last[self.fields["age"].start]) + elapsed
        if math.isnan(elapsed):
            if trust:
                return np.concatenate([[Status.NOT_FINITE], last[1:]])
            gravity = start_gravity(config, f)
            q = quaternion_from_gravity(gravity.gravity, 0.0)
            tilt = gravity.covariance[0] / 9.81**2
            quaternion = QuaternionEstimate(q, (0.0, 0.0, 0.0), (tilt, 0.0, config.angular_velocity_bias**2))
        else:
            gravity, quaternion = self._unpack(last)
            if trust:
                # Nobody knows how the robot turns: hold, and let the next good readings have their way.
                gg, pp = gravity.covariance[0], quaternion.covariance[0]
                drift = (_UNKNOWN_RATE * elapsed) ** 2
                gravity = GravityEstimate(
                    gravity.gravity, gravity.acceleration, gravity.bias, (gg + 9.81**2 * drift, *gravity.covariance[1:])
                )
                quaternion = QuaternionEstimate(quaternion.q, quaternion.bias, (pp + drift, *quaternion.covariance[1:]))
                w = quaternion.bias
            else:
                standing = age <= config.standing_time
                rate = tuple(x - b for x, b in zip(w, quaternion.bias, strict=True))
                # An unknown gyro bias turns gravity the same way for as long as the filter remembers.
                rate_variance = config.angular_velocity_noise**2 + quaternion.covariance[2] * 2.0 * config.motion_time / elapsed
                motion = config.standing_acceleration if standing else config.motion_acceleration
                gravity = update_gravity(config, predict_gravity(config, gravity, rate, rate_variance, motion, elapsed), f)
                tilt_variance = gravity.covariance[0] / 9.81**2
                quaternion = predict_quaternion(config, quaternion, w, elapsed)
                measured_q = quaternion_from_gravity(gravity.gravity, yaw_of(quaternion.q))
                level = self._level_feet(context)
                if standing and level is not None:
                    level_q = quaternion_from_gravity(level[0], yaw_of(quaternion.q))
                    quaternion = self._stand(quaternion, level_q, level[1], w, elapsed)
                elif standing:
                    quaternion = self._stand(quaternion, measured_q, tilt_variance, w, elapsed)
                else:
                    # The gravity filter's error lasts about as long as the trunk's acceleration.
                    quaternion = update_quaternion(quaternion, measured_q, tilt_variance, 2.0 * config.motion_time / elapsed)
                    if level is not None:
                        by_gravity, level_q = quaternion, quaternion_from_gravity(level[0], yaw_of(quaternion.q))
                        quaternion = update_quaternion(quaternion, level_q, level[1], 2.0 * config.stance_time / elapsed)
                        feet = quaternion.innovation, quaternion.innovation_variance
                        quaternion = replace(
                            quaternion, innovation=by_gravity.innovation, innovation_variance=by_gravity.innovation_variance
                        )
        return self._pack(trust, w, age, gravity, quaternion, feet)

    def _stand(self, x: QuaternionEstimate, measured: Quaternion, tilt_variance: float, w: Vector, elapsed: float) -> QuaternionEstimate:
        """Initialisation: the attitude is the measured one; what the gyro says of a standing robot is mostly its bias."""
        config, bb = self._config, x.covariance[2]
        # The standing robot's own rate is the same in all the ticks.
        ticks = config.standing_time / elapsed
        k = bb / (bb + config.angular_velocity_noise**2 + ticks * config.standing_rate**2)
        bias = tuple(b + k * (rate - b) for b, rate in zip(x.bias, w, strict=True))
        return QuaternionEstimate(measured, bias, (tilt_variance, 0.0, bb - k * bb))

    def _level_feet(self, context: Context) -> tuple[Vector, float] | None:
        """Vertical direction in IMU axes by the soles that stand, and its variance [rad^2]; None if nothing stands."""
        if self._config.level_feet == 0:
            return None
        support = self._support.Eval(context)
        standing = support.sum()
        if standing == 0:
            return None
        normals_B = self._model.Eval(context)[self._foot_rotation].reshape(-1, 3, 3)[:, :, 2]
        up = ((support @ normals_B) @ self._R_BI).tolist()
        return (up[0], up[1], up[2]), self._config.level_feet**2 / standing

    def _unpack(self, last: np.ndarray) -> tuple[GravityEstimate, QuaternionEstimate]:
        x = last[self.fields["imu_orientation"].start : self.fields["covariance"].stop].tolist()
        gravity = GravityEstimate(tuple(x[4:7]), tuple(x[7:10]), tuple(x[10:13]), tuple(x[16:22]))
        return gravity, QuaternionEstimate(tuple(x[0:4]), tuple(x[13:16]), tuple(x[22:25]))

    def _pack(
        self, status: float, w: Vector, age: float, gravity: GravityEstimate, quaternion: QuaternionEstimate, feet: tuple[Vector, float]
    ) -> np.ndarray:
        q_WB = quaternion_product(quaternion.q, self._q_IB)
        rate = [x - b for x, b in zip(w, quaternion.bias, strict=True)]
        return np.array(
            [
                status,
                *q_WB,
                *rotation_matrix(q_WB).ravel().tolist(),
                *(self._R_BI @ rate),
                age,
                *quaternion.q,
                *gravity.gravity,
                *gravity.acceleration,
                *gravity.bias,
                *quaternion.bias,
                *gravity.covariance,
                *quaternion.covariance,
                *gravity.innovation,
                *quaternion.innovation,
                *feet[0],
                gravity.innovation_variance,
                quaternion.innovation_variance,
                feet[1],
            ]
        )


def quaternion_of_matrix(R: np.ndarray) -> Quaternion:
    """Unit quaternion of a rotation matrix."""
    return tuple(RotationMatrix(R).ToQuaternion().wxyz().tolist())
