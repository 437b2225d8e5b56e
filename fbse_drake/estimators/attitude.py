"""Base attitude from the IMU (paper Sec. 3, Fig. 2).

A Kalman filter for gravity feeds an extended Kalman filter on the quaternion.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit
from pydrake.math import RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort

from fbse_drake.errors import require_not_negative, require_positive
from fbse_drake.estimators.beliefs import USUAL_SENSORS, SensorBeliefs
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.estimators.spatial import (
    GRAVITY,
    Quaternion,
    Vector,
    add,
    cross,
    normalized,
    put,
    quaternion,
    quaternion_from_gravity,
    quaternion_product,
    rotate,
    rotate_back,
    rotation,
    rotation_matrix,
    rotation_vector_to_quaternion,
    scale,
    subtract,
    vector,
    yaw_of,
)
from fbse_drake.robot.plant import Robot

_NOT_FINITE = float(Status.NOT_FINITE)

# What the angular velocity is taken to be while the gyro is not trusted [rad/s].
_UNKNOWN_RATE = 0.3


@dataclass(frozen=True)
class AttitudeConfig:
    """What the filters believe of the motion, and what they estimate besides the attitude."""

    # The trunk's linear acceleration: its size [m/s^2] and how long it keeps its direction [s].
    motion_acceleration: float = 0.5
    motion_time: float = 0.3
    # How large a constant accelerometer bias [m/s^2] and gyro bias [rad/s] may be; 0 does not
    # estimate it.
    acceleration_bias: float = 0.0
    angular_velocity_bias: float = 0.0
    # Robots start standing: for this long [s] the trunk accelerates [m/s^2] and turns [rad/s] by no
    # more than this.
    standing_time: float = 0.05
    standing_acceleration: float = 0.1
    standing_rate: float = 3.0e-3
    # How level the sole of a standing foot is (standard deviation [rad]): the legs then tell the
    # tilt as well, on level ground. 0 does not use them, as the paper.
    level_feet: float = 2.0e-3
    # How long a foot keeps its error [s].
    stance_time: float = 0.5

    def __post_init__(self) -> None:
        require_not_negative(
            self,
            "acceleration_bias",
            "angular_velocity_bias",
            "standing_time",
            "standing_acceleration",
            "level_feet",
        )
        require_positive(self, "motion_acceleration", "motion_time", "stance_time")

    def add(self, chain: Chain) -> None:
        """Adds `attitude` to a chain that has `sensor_monitor` and `model`."""
        # How a point foot is turned tells nothing.
        has_points = any(leg.is_point for leg in chain.robot.description.legs.values())
        config = replace(self, level_feet=0.0) if has_points else self
        make = partial(AttitudeEstimator, config, chain.sensors, ImuMount(chain.robot).R_BI)
        chain.add("attitude", make, measurements="sensor_monitor", model="model")


class GravityEstimate(NamedTuple):
    """State of the gravity filter, in IMU axes [m/s^2].

    The three axes share one covariance, for states and noise are isotropic.
    """

    # Specific force of rest (minus gravity), linear acceleration, accelerometer bias.
    gravity: Vector
    acceleration: Vector
    bias: Vector
    # Upper triangle of the covariance of one axis: gg, ga, gb, aa, ab, bb.
    covariance: tuple[float, float, float, float, float, float]
    # Measured minus predicted specific force, and its variance per axis.
    innovation: Vector
    innovation_variance: float


@njit(cache=True)
def start_gravity(
    specific_force: Vector,
    acceleration_variance: float,
    bias_variance: float,
    noise_variance: float,
) -> GravityEstimate:
    """Decomposes the first reading by the pseudo-inverse, weighted with how large each part may be.

    (The paper's plain pseudo-inverse gives each part a third of the reading; weights put nearly all
    of it where it belongs.)

    Args:
        acceleration_variance, bias_variance, noise_variance: how large the robot's acceleration,
            the accelerometer's bias and its noise may be, per axis [m^2/s^4].
    """
    g, a, b = GRAVITY**2, acceleration_variance, bias_variance
    total = g + a + b + noise_variance
    # Covariance of one axis given the reading.
    covariance = (
        g - g * g / total,
        -g * a / total,
        -g * b / total,
        a - a * a / total,
        -a * b / total,
        b - b * b / total,
    )
    parts = (
        scale(g / total, specific_force),
        scale(a / total, specific_force),
        scale(b / total, specific_force),
    )
    return GravityEstimate(parts[0], parts[1], parts[2], covariance, (0.0, 0.0, 0.0), 0.0)


@njit(cache=True)
def predict_gravity(
    x: GravityEstimate,
    w: Vector,
    rate_variance: float,
    motion_acceleration: float,
    motion_time: float,
    elapsed: float,
) -> GravityEstimate:
    """Gravity and linear acceleration turn with the IMU.

    The acceleration fades as a first-order Gauss-Markov process.

    Args:
        w: angular velocity [rad/s].
        rate_variance: variance of w [(rad/s)^2].
        motion_acceleration, motion_time: standard deviation of the linear acceleration [m/s^2], and
            how long it keeps its direction [s].
        elapsed: time step [s].
    """
    fade = math.exp(-elapsed / motion_time)
    gravity = add(x.gravity, scale(elapsed, cross(x.gravity, w)))
    acceleration = scale(fade, add(x.acceleration, scale(elapsed, cross(x.acceleration, w))))
    gg, ga, gb, aa, ab, bb = x.covariance
    gg += (GRAVITY * elapsed) ** 2 * rate_variance
    aa = fade * fade * aa + (1 - fade * fade) * motion_acceleration**2
    return GravityEstimate(
        gravity,
        acceleration,
        x.bias,
        (gg, fade * ga, gb, aa, fade * ab, bb),
        x.innovation,
        x.innovation_variance,
    )


@njit(cache=True)
def update_gravity(
    x: GravityEstimate, specific_force: Vector, noise_variance: float
) -> GravityEstimate:
    """Kalman update with y = gravity + acceleration + bias + noise."""
    gg, ga, gb, aa, ab, bb = x.covariance
    pg, pa, pb = gg + ga + gb, ga + aa + ab, gb + ab + bb
    S = pg + pa + pb + noise_variance
    kg, ka, kb = pg / S, pa / S, pb / S
    e = subtract(subtract(subtract(specific_force, x.gravity), x.acceleration), x.bias)
    return GravityEstimate(
        add(x.gravity, scale(kg, e)),
        add(x.acceleration, scale(ka, e)),
        add(x.bias, scale(kb, e)),
        (gg - kg * pg, ga - kg * pa, gb - kg * pb, aa - ka * pa, ab - ka * pb, bb - kb * pb),
        e,
        S,
    )


class QuaternionEstimate(NamedTuple):
    """State of the quaternion filter.

    Attitude error and gyro bias are isotropic and share one 2 x 2 covariance for all axes.
    """

    # Attitude of the IMU in the world.
    q: Quaternion
    # Gyro bias in IMU axes [rad/s].
    bias: Vector
    # Covariance of [attitude error, bias error] of one axis: [rad^2], [rad^2/s], [rad^2/s^2].
    covariance: tuple[float, float, float]
    # Rotation from the predicted to the measured quaternion [rad], and its variance per axis.
    innovation: Vector
    innovation_variance: float


@njit(cache=True)
def predict_quaternion(
    x: QuaternionEstimate, w: Vector, noise_variance: float, elapsed: float
) -> QuaternionEstimate:
    """Turns the quaternion with the gyro, free of its bias.

    Args:
        noise_variance: of w [(rad/s)^2].
    """
    turn = scale(elapsed, subtract(w, x.bias))
    pp, pb, bb = x.covariance
    covariance = (pp - 2 * elapsed * pb + elapsed**2 * (bb + noise_variance), pb - elapsed * bb, bb)
    q = quaternion_product(x.q, rotation_vector_to_quaternion(turn))
    return QuaternionEstimate(q, x.bias, covariance, x.innovation, x.innovation_variance)


@njit(cache=True)
def update_quaternion(
    x: QuaternionEstimate, measured: Quaternion, variance: float, correlated: float
) -> QuaternionEstimate:
    """Extended Kalman update with a measured quaternion.

    It is written for the small rotation between prediction and measurement and followed by the norm
    correction; q and -q count as the same attitude.

    Args:
        variance: of the measured attitude about each horizontal axis [rad^2].
        correlated: number of ticks for which its error lasts; so many measurements count as one.
    """
    w, i, j, k = quaternion_product((x.q[0], -x.q[1], -x.q[2], -x.q[3]), measured)
    e = scale(2.0 if w >= 0 else -2.0, (i, j, k))
    pp, pb, bb = x.covariance
    S = pp + variance * max(1.0, correlated)
    kp, kb = pp / S, pb / S
    return QuaternionEstimate(
        normalized(quaternion_product(x.q, rotation_vector_to_quaternion(scale(kp, e)))),
        add(x.bias, scale(kb, e)),
        (pp - kp * pp, pb - kp * pb, bb - kb * pb),
        e,
        pp + variance,
    )


@njit(cache=True)
def stand_still(
    x: QuaternionEstimate,
    measured: Quaternion,
    tilt_variance: float,
    w: Vector,
    noise_variance: float,
    own_rate_variance: float,
) -> QuaternionEstimate:
    """Initialisation: the attitude is the measured one.

    What the gyro says of a standing robot is mostly its bias.

    Args:
        noise_variance: of w [(rad/s)^2].
        own_rate_variance: of the standing robot's own rate [(rad/s)^2], as it counts in one tick:
            the rate is the same in all.
    """
    bb = x.covariance[2]
    k = bb / (bb + noise_variance + own_rate_variance)
    bias = add(x.bias, scale(k, subtract(w, x.bias)))
    return QuaternionEstimate(
        measured, bias, (tilt_variance, 0.0, bb - k * bb), x.innovation, x.innovation_variance
    )


@njit(cache=True)
def level_direction(support: np.ndarray, foot_rotation: np.ndarray) -> tuple[Vector, float]:
    """Vertical direction in base axes by the soles that stand, of any length, and their number.

    Args:
        support: (feet,).
        foot_rotation: R_BF of each sole, (feet, 3, 3).
    """
    up, standing = (0.0, 0.0, 0.0), 0.0
    for foot in range(len(support)):
        R = foot_rotation[foot]
        up = add(up, scale(support[foot], (R[0, 2], R[1, 2], R[2, 2])))
        standing += support[foot]
    return up, standing


@njit(cache=True)
def _filters(last: np.ndarray) -> tuple[GravityEstimate, QuaternionEstimate]:
    """Both filters' states from the record of a posterior."""
    g, q = last.covariance.gravity, last.covariance.quaternion
    return GravityEstimate(
        vector(last.gravity),
        vector(last.acceleration),
        vector(last.acceleration_bias),
        (g.gg, g.ga, g.gb, g.aa, g.ab, g.bb),
        (0.0, 0.0, 0.0),
        0.0,
    ), QuaternionEstimate(
        quaternion(last.imu_orientation),
        vector(last.angular_velocity_bias),
        (q.pp, q.pb, q.bb),
        (0.0, 0.0, 0.0),
        0.0,
    )


@njit(cache=True)
def _estimate_attitude(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> None:
    """One tick of `AttitudeEstimator`; fills the posterior.

    Args:
        known: record with the numbers of `AttitudeConfig` and `SensorBeliefs`, the rotation of the
            IMU, and the quaternion of the base in its axes.
    """
    if math.isnan(elapsed) and measured[()].trust[1] > 0:
        # Nothing to start from.
        posterior[()] = last[()]
        posterior[()].status = _NOT_FINITE
        return
    posterior, last, known = posterior[()], last[()], known[()]
    measured, model = measured[()], model[()]
    config, R_BI, q_IB = known.config, rotation(known.R_BI), quaternion(known.q_IB)
    motion_time, rate_noise = config.motion_time, known.sensors.angular_velocity_noise
    acceleration_noise = known.sensors.acceleration_noise
    first, trust = math.isnan(elapsed), measured.trust[1]
    f, w = vector(measured.specific_force), vector(measured.angular_velocity)
    age = 0.0 if first else last.age + elapsed
    feet_innovation, feet_variance = (0.0, 0.0, 0.0), 0.0
    if first:
        x = start_gravity(
            f, config.standing_acceleration**2, config.acceleration_bias**2, acceleration_noise**2
        )
        q = quaternion_from_gravity(x.gravity, 0.0)
        # The base looks ahead, however the IMU sits on it.
        yaw = yaw_of(quaternion_product(q, q_IB))
        q = quaternion_product(rotation_vector_to_quaternion((0.0, 0.0, -yaw)), q)
        tilt_variance = x.covariance[0] / GRAVITY**2
        P = (tilt_variance, 0.0, config.angular_velocity_bias**2)
        y = QuaternionEstimate(q, (0.0, 0.0, 0.0), P, (0.0, 0.0, 0.0), 0.0)
    else:
        x, y = _filters(last)
        if trust > 0:
            # Nobody knows how the robot turns: hold, and let the next good readings have their way.
            drift = (_UNKNOWN_RATE * elapsed) ** 2
            gg, ga, gb, aa, ab, bb = x.covariance
            P_gravity = (gg + GRAVITY**2 * drift, ga, gb, aa, ab, bb)
            x = GravityEstimate(x.gravity, x.acceleration, x.bias, P_gravity, (0.0, 0.0, 0.0), 0.0)
            pp, pb, bb = y.covariance
            y = QuaternionEstimate(y.q, y.bias, (pp + drift, pb, bb), (0.0, 0.0, 0.0), 0.0)
            w = y.bias
        else:
            standing = age <= config.standing_time
            # An unknown gyro bias turns gravity the same way for as long as the filter remembers.
            rate_variance = rate_noise**2 + y.covariance[2] * 2.0 * motion_time / elapsed
            motion = config.standing_acceleration if standing else config.motion_acceleration
            w_free = subtract(w, y.bias)
            x = predict_gravity(x, w_free, rate_variance, motion, motion_time, elapsed)
            x = update_gravity(x, f, acceleration_noise**2)
            tilt_variance = x.covariance[0] / GRAVITY**2
            y = predict_quaternion(y, w, rate_noise**2, elapsed)
            by_gravity = quaternion_from_gravity(x.gravity, yaw_of(y.q))
            up_B, soles = level_direction(measured.support, model.foot_rotation)
            up_I = rotate_back(R_BI, up_B)
            use_feet = config.level_feet > 0 and soles > 0
            level_variance = config.level_feet**2 / max(1.0, soles)
            if standing:
                measured_q, variance = by_gravity, tilt_variance
                if use_feet:
                    measured_q = quaternion_from_gravity(up_I, yaw_of(y.q))
                    variance = level_variance
                own_rate_variance = config.standing_time / elapsed * config.standing_rate**2
                y = stand_still(y, measured_q, variance, w, rate_noise**2, own_rate_variance)
            else:
                # The gravity filter's error lasts about as long as the trunk's acceleration.
                y = update_quaternion(y, by_gravity, tilt_variance, 2.0 * motion_time / elapsed)
                if use_feet:
                    by_feet = quaternion_from_gravity(up_I, yaw_of(y.q))
                    z = update_quaternion(
                        y, by_feet, level_variance, 2.0 * config.stance_time / elapsed
                    )
                    feet_innovation, feet_variance = z.innovation, z.innovation_variance
                    y = QuaternionEstimate(
                        z.q, z.bias, z.covariance, y.innovation, y.innovation_variance
                    )
    q_WB = quaternion_product(y.q, q_IB)
    posterior.status = trust
    put(posterior.orientation, q_WB)
    put(posterior.rotation, rotation_matrix(q_WB))
    put(posterior.angular_velocity, rotate(R_BI, subtract(w, y.bias)))
    posterior.age = age
    put(posterior.imu_orientation, y.q)
    put(posterior.gravity, x.gravity)
    put(posterior.acceleration, x.acceleration)
    put(posterior.acceleration_bias, x.bias)
    put(posterior.angular_velocity_bias, y.bias)
    g, q_P = posterior.covariance.gravity, posterior.covariance.quaternion
    g.gg, g.ga, g.gb, g.aa, g.ab, g.bb = x.covariance
    q_P.pp, q_P.pb, q_P.bb = y.covariance
    put(posterior.innovation.gravity, x.innovation)
    put(posterior.innovation.quaternion, y.innovation)
    put(posterior.innovation.feet, feet_innovation)
    posterior.innovation_variance.gravity = x.innovation_variance
    posterior.innovation_variance.quaternion = y.innovation_variance
    posterior.innovation_variance.feet = feet_variance


class AttitudeEstimator(RecursiveEstimator):
    """Attitude of the base from accelerometer and gyro (paper Sec. 3).

    .. pydrake_system::

        name: AttitudeEstimator
        input_ports:
        - measurements
        - model
        output_ports:
        - posterior
        - (one for each field)

    Inputs: posteriors of `SensorMonitor` and `FloatingBaseModel`. Fields of the posterior:

        orientation           (4,)    quaternion [w, x, y, z] of the base in the world (eq. 6); its
                                      sign never jumps
        rotation              (3, 3)  R_WB
        angular_velocity      (3,)    of the base in base axes, free of the estimated gyro bias
                                      [rad/s]
        age                   ()      since the first tick [s]
        imu_orientation       (4,)    quaternion of the IMU in the world
        gravity, acceleration, acceleration_bias, angular_velocity_bias
                              (3,)    each, in IMU axes [m/s^2, rad/s]
        covariance                    `gravity` gg ... bb and `quaternion` pp, pb, bb, per axis, see
                                      `GravityEstimate`, `QuaternionEstimate`
        innovation            (3,)    of the filters for `gravity` and `quaternion`, and of the
        innovation_variance   ()      latter from the `feet`

    Yaw is the gyro's alone: the gravity filter borrows it for its measured quaternion.
    """

    def __init__(
        self,
        config: AttitudeConfig,
        sensors: SensorBeliefs,
        R_BI: np.ndarray,
        measurements: np.dtype,
        model: np.dtype,
        clock: Clock,
    ):
        """Declares ports and state.

        Args:
            R_BI: how the IMU sits in the base, (3, 3).
            measurements, model: types of the inputs' posteriors.
        """
        gravity, error = ("gg", "ga", "gb", "aa", "ab", "bb"), ("pp", "pb", "bb")
        posterior_type = record_type(
            time=(),
            status=(),
            orientation=(4,),
            rotation=(3, 3),
            angular_velocity=(3,),
            age=(),
            imu_orientation=(4,),
            gravity=(3,),
            acceleration=(3,),
            acceleration_bias=(3,),
            angular_velocity_bias=(3,),
            covariance=record_type(
                gravity=record_type(**dict.fromkeys(gravity, ())),
                quaternion=record_type(**dict.fromkeys(error, ())),
            ),
            innovation=record_type(gravity=(3,), quaternion=(3,), feet=(3,)),
            innovation_variance=record_type(gravity=(), quaternion=(), feet=()),
        )
        super().__init__(posterior_type, clock)
        q_IB = RotationMatrix(R_BI.T).ToQuaternion().wxyz()
        self._known = record(config=config, sensors=sensors, R_BI=R_BI, q_IB=q_IB)
        self._measurements = self._declare_record_input("measurements", measurements)
        self._model = self._declare_record_input("model", model)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot | None = None) -> dict[str, np.dtype]:  # noqa: ARG004
        """Those of an IMU alone, without feet."""
        imu = {"specific_force": (3,), "angular_velocity": (3,)}
        return {
            "measurements": record_type(trust=(2,), support=(0,), **imu),
            "model": record_type(status=(), foot_rotation=(0, 3, 3)),
        }

    @classmethod
    def AddToBuilder(
        cls,
        builder: DiagramBuilder,
        specific_force: OutputPort,
        angular_velocity: OutputPort,
        *,
        period: float,
        R_BI: np.ndarray | None = None,
        config: AttitudeConfig | None = None,
        sensors: SensorBeliefs = USUAL_SENSORS,
    ) -> "AttitudeEstimator":
        """Adds one that knows an IMU and nothing else to anybody's diagram.

        Args:
            specific_force, angular_velocity: what the IMU measures in its axes, (3,) each
                [m/s^2, rad/s].
            period: tick [s].
            R_BI: how the IMU sits in the base, (3, 3); by default in its axes.

        Returns:
            The estimator, whose output ports are `orientation` and the other fields.
        """
        imu = {"specific_force": specific_force, "angular_velocity": angular_velocity}
        return super().AddToBuilder(
            builder,
            {"measurements": imu, "model": {}},
            period=period,
            config=config or AttitudeConfig(),
            sensors=sensors,
            R_BI=np.eye(3) if R_BI is None else R_BI,
        )

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, model = self._measurements.Eval(context), self._model.Eval(context)
        _estimate_attitude(posterior, last, elapsed, measured, model, self._known)
