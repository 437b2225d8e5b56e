"""Attitude, velocity and position of the base, the feet that stand and the IMU's biases together.

A right-invariant extended Kalman filter after R. Hartley, M. Ghaffari, R. M. Eustice and
J. W. Grizzle, "Contact-aided invariant extended Kalman filtering for robot state estimation",
Int. J. Robotics Research 39(4), 2020; with the orientation of feet that stand, after M. Bloesch et
al., "State estimation for legged robots on unstable and slippery terrain", IROS 2013; and with the
acceleration of the centre of mass from the foot forces.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.errors import require_not_negative, require_positive, required
from fbse_drake.estimators.attitude import AttitudeConfig
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.bias_limits import leash_biases, remember_biases
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.cross_check import (
    cross_check,
    cross_check_type,
    firm_foot_rate,
    force_contradiction,
)
from fbse_drake.estimators.floating_base import ImuMount, model_type
from fbse_drake.estimators.foot_force_balance import force_errors, listen_to_forces
from fbse_drake.estimators.force_delay import (
    force_delay_type,
    forget_force_delay,
    take_force_delay,
    watch_force_delay,
)
from fbse_drake.estimators.force_lag import (
    force_lag_type,
    forget_force_lag,
    undo_lag,
    watch_force_lag,
)
from fbse_drake.estimators.imu_noise import imu_noise_type, watch_noise
from fbse_drake.estimators.innovations import AGREEMENT_TIME
from fbse_drake.estimators.invariant_error import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    FEET,
    GYRO_BIAS,
    IDENTITY,
    POSITION,
    VELOCITY,
    add_noise,
    add_noise_along,
    add_product,
    correct,
    isotropic,
    moved_std,
    propagate,
    put_columns,
    turn_to,
    update,
)
from fbse_drake.estimators.lost_velocity import (
    TILT_BY_VELOCITY,
    doubt_velocity,
    forget_sliding,
    never_lost,
    watch_for_losses,
)
from fbse_drake.estimators.records import Record, as_record, record, record_type
from fbse_drake.estimators.recursive import LONGEST_COMPARED_TICK, Clock, RecursiveEstimator, Status
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.estimators.spatial import (
    GRAVITY,
    Vector,
    add,
    cross,
    norm,
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
    skew,
    subtract,
    transposed,
    vector,
)
from fbse_drake.estimators.standing_foot import (
    FIRM_SHARE,
    FOOT_ORIENTATION,
    FOOT_POSITION,
    FOOT_RATE,
    FOOT_VELOCITY,
    TOLD,
    centre_of_pressure,
    land,
    listen_to_foot,
    trusted,
    unrest,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches

_NOT_FINITE, _IMPLAUSIBLE = float(Status.NOT_FINITE), float(Status.IMPLAUSIBLE)
# How wrong the first posterior may be: the tilt [rad]; the velocity, in rest [m/s] and for each
# rad/s of the fastest joint [m]; and that the accelerometer shows gravity [m/s^2], [m/s].
_START = {
    "tilt": 0.2,
    "velocity": 0.1,
    "velocity_by_rate": 0.5,
    "acceleration": 0.1,
    "acceleration_by_rate": 5.0,
}
# While the IMU is not trusted, what its readings are taken to be wrong by [rad/s, m/s^2], and how
# long that lasts [s].
_UNKNOWN_RATE, _UNKNOWN_ACCELERATION, _UNKNOWN_TIME = 0.3, 3.0, 0.1
# What the rate is off by that standing feet show [rad/s].
_FOOT_RATE_ERROR = 0.05
# Below this share of its weight, the robot is not carried by its feet.
_CARRIED = 0.3


@dataclass(frozen=True)
class InvariantFilter:
    """What the filter believes of the robot; what it believes of the sensors, see `SensorBeliefs`.

    Errors that last are given by their size (standard deviation) and by how long they last. Feet
    and forces that show less than that are trusted more, up to ten times as much; the more, the
    longer they do so.
    """

    # Do monitor and model hear what it knows?
    feeds_back: ClassVar[bool] = True

    # What a standing foot does in spite of all, because it rolls, tilts, slips or sinks: position
    # [m], orientation [rad], velocity [m/s] and angular velocity [rad/s] ...
    foot_position: float = 3.5e-4
    foot_orientation: float = 5.0e-3
    foot_velocity: float = 1.5e-3
    foot_rate: float = 1.5e-2
    # ... and how long that lasts [s].
    foot_time: float = 0.1
    # How far a standing foot creeps: random walk of position [m/sqrt(s)] and orientation
    # [rad/sqrt(s)].
    foot_creep: float = 1.0e-3
    foot_turning: float = 1.0e-3
    # How wrong the mean acceleration of the robot by its foot forces is: any way [m/s^2] and as a
    # share of the whole, through wrong masses and gains; and how long that lasts [s].
    force_error: float = 0.05
    force_gain_error: float = 0.05
    force_time: float = 0.3
    # How level the ground is under standing soles [rad], an error that lasts as long as a foot
    # stands; 0 says nothing of it.
    level_ground: float = 0.0
    # Random walks of the biases of gyro [rad/s/sqrt(s)] and accelerometer [m/s^2/sqrt(s)].
    gyro_walk: float = 1.0e-5
    accelerometer_walk: float = 1.0e-4

    def __post_init__(self) -> None:
        require_positive(
            self,
            "foot_position",
            "foot_orientation",
            "foot_velocity",
            "foot_rate",
            "foot_time",
            "force_error",
            "force_time",
        )
        require_not_negative(
            self,
            "foot_creep",
            "foot_turning",
            "force_gain_error",
            "level_ground",
            "gyro_walk",
            "accelerometer_walk",
        )

    def add(self, chain: Chain, attitude: AttitudeConfig, origin: tuple[float, float]) -> None:  # noqa: ARG002
        """Adds `base_state`, which is `attitude` as well, to a chain.

        Args:
            attitude: of the stage that it replaces.
            origin: see `InvariantBaseFilter`.
        """
        make = partial(InvariantBaseFilter, self, chain.sensors, chain.robot, origin=origin)
        chain.add("base_state", make, measurements="sensor_monitor", model="model")
        chain.alias("base_state", "attitude")
        chain.connect_field(
            "base_state.last", "angular_velocity_bias", "model.angular_velocity_bias"
        )
        chain.connect_field("base_state.last", "check.doubt", "sensor_monitor.doubt")


@njit(cache=True)
def _predict(
    x: Record,
    P: np.ndarray,
    w: Vector,
    f: Vector,
    rate_variance: float,
    T: float,
    known: Record,
) -> None:
    """The step that ends now, in place.

    Args:
        x: record of the posterior where the step begins.
        w, f: angular velocity and specific force of the IMU in base axes, free of biases.
        rate_variance: of w and of the velocity change by f over the step, see below.
        known: see `_estimate_base`.
    """
    config, gravity = known.config, vector(known.gravity)
    propagate(P, x, gravity, T)
    # Noise of the gyro turns attitude, and by the group all that turns with it: also feet, or what
    # is known of the legs would depend on how far from the world's origin they are.
    v, p = vector(x.imu_velocity), vector(x.imu_position)
    G = np.zeros((3, len(P)))
    put_columns(G, ATTITUDE, IDENTITY)
    put_columns(G, VELOCITY, transposed(skew(v)))
    put_columns(G, POSITION, transposed(skew(p)))
    for foot in range(len(x.foot_standing)):
        if x.foot_standing[foot] > 0:
            put_columns(G, FEET + 6 * foot, transposed(skew(vector(x.foot_position[foot]))))
    q = rate_variance * T * T
    for i in range(len(P)):
        for j in range(len(P)):
            P[i, j] += q * (G[0, i] * G[0, j] + G[1, i] * G[1, j] + G[2, i] * G[2, j])
    add_noise(P, GYRO_BIAS, config.gyro_walk**2 * T)
    add_noise(P, ACCELEROMETER_BIAS, config.accelerometer_walk**2 * T)
    creep, turn, lasts = np.empty(3), np.empty(3), 2.0 * AGREEMENT_TIME
    for foot in range(len(x.foot_standing)):
        if x.foot_standing[foot] > 0:
            at, restless = FEET + 6 * foot, x.foot_restlessness[foot]
            # A foot that moves more than it does in spite of all does not stay.
            moving, turning = lasts * config.foot_velocity**2, lasts * config.foot_rate**2
            F = rotation_matrix(quaternion(x.foot_orientation[foot]))
            for i in range(3):
                creep[i] = trusted(x, foot, FOOT_POSITION, i) * config.foot_creep**2
                creep[i] += max(0.0, restless[FOOT_VELOCITY, i] - 1.0) * moving
                turn[i] = trusted(x, foot, FOOT_ORIENTATION, i) * config.foot_turning**2
                if i == 2:
                    turn[i] *= unrest(v) ** 2
                turn[i] += max(0.0, restless[FOOT_RATE, i] - 1.0) * turning
            add_noise_along(P, at, F, creep, T)
            add_noise_along(P, at + 3, F, turn, T)
    acceleration = add(rotate(rotation(x.rotation), f), gravity)
    put(x.imu_position, add(p, add(scale(T, v), scale(0.5 * T * T, acceleration))))
    put(x.imu_velocity, add(v, scale(T, acceleration)))
    turn_to(
        x, quaternion_product(quaternion(x.orientation), rotation_vector_to_quaternion(scale(T, w)))
    )


@njit(cache=True)
def _start(x: Record, measured: Record, model: Record, known: Record) -> None:
    """The first posterior: upright by the accelerometer, looking ahead, soles where they are said
    to be."""
    sensors, P = known.sensors, x.error_covariance
    R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    f = rotate(R_BI, vector(measured.specific_force))
    turn_to(x, quaternion_from_gravity(f, 0.0))
    x.foot_restlessness[:] = 1.0
    x.foot_habit[:] = 1.0
    x.foot_age[:] = known.config.foot_time
    x.force_habit[:] = 1.0
    never_lost(x)
    R, middle, feet = rotation(x.rotation), (0.0, 0.0, 0.0), len(x.foot_standing)
    for foot in range(feet):
        middle = add(middle, scale(1.0 / feet, vector(model.foot_position[foot])))
    base = subtract(vector(known.origin), rotate(R, middle))
    put(x.imu_position, add(base, rotate(R, p_BI)))
    for i in range(2):  # Yaw is what it is said to be ...
        P[ATTITUDE + i, ATTITUDE + i] = known.start.tilt**2
    # ... and so is the place of the soles, about which the error of the tilt turns the base.
    about = skew(vector(known.origin))
    add_product(P, POSITION, about, P, ATTITUDE)
    add_product(P.T, POSITION, about, P.T, ATTITUDE)
    fastest = np.abs(measured.joint_velocity).max()
    moving = (known.start.velocity_by_rate * fastest) ** 2
    add_noise(P, VELOCITY, known.start.velocity**2 + moving)
    add_noise(P, GYRO_BIAS, sensors.angular_velocity_bias**2 + 1e-12)
    add_noise(P, ACCELEROMETER_BIAS, sensors.acceleration_bias**2 + 1e-12)
    correction, spare = np.zeros(len(P)), np.zeros(3)
    # What the accelerometer reads is gravity, its bias and some motion.
    reading = rotate(R, f)
    z = add(reading, vector(known.gravity))
    own = known.start.acceleration**2 + (known.start.acceleration_by_rate * fastest) ** 2
    noise = isotropic(own + sensors.acceleration_noise**2)
    update(
        P, correction, z, ATTITUDE, skew(reading), ACCELEROMETER_BIAS, R, noise, 0.0, spare,
        spare.copy(), np.empty((2, 3)),
    )  # fmt: skip
    correct(x, correction)


@njit(cache=True)
def _estimate_base(
    posterior: Record,
    last: Record,
    elapsed: float,
    measured: Record,
    model: Record,
    known: Record,
) -> None:
    """One tick of `InvariantBaseFilter`; fills the posterior.

    Args:
        known: record with the numbers of `InvariantFilter` and `SensorBeliefs`, `mount`, see
            `ImuMount`, `pads`, see `FootPads`, `soles` (feet, 2, 2), least and largest x and y of
            their pads [m], `is_flat` (feet,), 1 of a foot that is no point,
            `mass` [kg], `gravity` (3,) [m/s^2], `start`, how sure the first posterior is, `origin`,
            where the middle of the soles is at the start (3,) [m], and the `period` of ticks [s].
    """
    posterior[()] = last[()]
    x, last, measured, model, known = posterior[()], last[()], measured[()], model[()], known[()]
    trust, feet, sensors, P = (
        measured.trust,
        len(measured.support),
        known.sensors,
        x.error_covariance,
    )
    first = math.isnan(elapsed)
    if first and trust[:2].max() > 0:
        x.status = _NOT_FINITE
        return
    x.status = trust.max()
    R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    w_raw = rotate(R_BI, vector(measured.angular_velocity))
    f_mean = rotate(R_BI, vector(measured.mean.specific_force))
    if trust[0] == 0 and trust[1] == 0:
        watch_noise(x.gyro, w_raw, sensors.angular_velocity_noise, elapsed)
        watch_noise(x.accelerometer, f_mean, sensors.acceleration_noise, elapsed)
    gyro_noise = math.sqrt(x.gyro.noise) * sensors.angular_velocity_noise
    accelerometer_noise = math.sqrt(x.accelerometer.noise) * sensors.acceleration_noise
    wrench = foot_wrenches(measured.pad_force, known.pads.position, known.pads.foot, feet)
    x.pad_force_read[:] = x.pad_force[:] = measured.mean.pad_force
    read_wrench = foot_wrenches(x.pad_force, known.pads.position, known.pads.foot, feet)
    lag = x.force_lag.time_constant
    if lag > 0.0 and not first and trust.max() == 0 and last.status == 0:
        undo_lag(x.pad_force, x.pad_force_read, last.pad_force_read, lag, elapsed)
    mean_wrench = foot_wrenches(x.pad_force, known.pads.position, known.pads.foot, feet)
    weight = known.mass * GRAVITY
    w_now = subtract(w_raw, vector(x.gyro_bias_B))
    firm = x.foot_standing * known.is_flat
    rests, rolling = firm_foot_rate(firm, wrench, known.soles, weight, w_now, model)
    contradiction = force_contradiction(x.check, force_errors(f_mean, known.config))
    if first:
        _start(x, measured, model, known)
    else:
        w = rotate(R_BI, vector(measured.mean.angular_velocity))
        w = subtract(w, vector(x.gyro_bias_B))
        f = subtract(f_mean, vector(x.accelerometer_bias_B))
        rate_noise, force_noise = gyro_noise, accelerometer_noise
        if trust[1] > 0:
            f = rotate_back(rotation(x.rotation), scale(-1.0, vector(known.gravity)))
            rate_noise, force_noise = _UNKNOWN_RATE, _UNKNOWN_ACCELERATION
            if rests and trust[0] == 0 and trust[2:].max() == 0:
                w, rate_noise = subtract(w_now, rolling), _FOOT_RATE_ERROR
            else:
                w = (0.0, 0.0, 0.0)
            lasting = math.sqrt(max(1.0, 2.0 * _UNKNOWN_TIME / elapsed))
            rate_noise, force_noise = lasting * rate_noise, lasting * force_noise
        elif contradiction > 0.0:
            # Or velocities that it makes would be put down to a tilt.
            force_noise += contradiction * math.sqrt(max(1.0, 2.0 * _UNKNOWN_TIME / elapsed))
        _predict(x, P, w, f, rate_noise**2, elapsed, known)
        add_noise(P, VELOCITY, (force_noise * elapsed) ** 2)
    force, force_read, carried = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    load_by_mass = np.empty((feet, 3))
    x.foot_innovation[:] = 0.0
    x.foot_innovation_variance[:] = 0.0
    correction = np.zeros(len(P))
    all_move, resting, least_moved, least_slides = True, False, math.inf, math.inf
    sliding = (math.inf, math.inf, math.inf)
    for foot in range(feet):
        load, stands = wrench[foot, 5], measured.support[foot] > 0
        if stands and not x.foot_standing[foot] > 0:
            land(x, P, correction, foot, model, known)
        elif stands and not first and trust[0] == 0 and trust[1] == 0 and trust[2 + foot] == 0:
            share = max(load, 1.0) / weight
            pivot = centre_of_pressure(wrench[foot], known.soles[foot])
            moves, slides, velocity = listen_to_foot(
                x, P, correction, foot, share, pivot, w_raw, model, elapsed, known
            )
            all_move, resting = all_move and moves, True
            if share > FIRM_SHARE:
                least_slides = min(least_slides, slides)
                if norm(velocity) <= norm(sliding):
                    sliding = velocity
            least_moved = min(least_moved, norm(vector(x.foot_agreement[foot, FOOT_VELOCITY])))
        x.foot_standing[foot] = measured.support[foot]
        R_BF = rotation(model.foot_rotation[foot])
        in_foot = (mean_wrench[foot, 3], mean_wrench[foot, 4], mean_wrench[foot, 5])
        foot_force = rotate(R_BF, in_foot)
        force = add(force, foot_force)
        force_read = add(force_read, rotate(R_BF, vector(read_wrench[foot, 3:])))
        put(load_by_mass[foot], scale(1.0 / known.mass, foot_force))
        carried += load
    # Velocity of the centre of mass relative to the IMU.
    w = subtract(w_raw, vector(x.gyro_bias_B))
    away = subtract(vector(model.com_velocity), cross(w, p_BI))
    was_known = last.away_known > 0 and not first
    is_fresh = trust[0] == 0
    for sensor in range(1, len(trust)):
        is_fresh = is_fresh and (trust[sensor] == 0 or trust[sensor] == _IMPLAUSIBLE)
    if was_known and is_fresh and elapsed <= LONGEST_COMPARED_TICK:
        relative = scale(1.0 / elapsed, subtract(away, vector(last.away)))
        relative = add(relative, cross(w, away))
        push = scale(1.0 / known.mass, force)
        # The gyro's own reading: a bias that is learned within a tick is no step of it.
        late = round(x.force_delay.delay / known.period)
        cross_check(
            x.check, f_mean, relative, push, load_by_mass, rests, rolling, w_raw, late, elapsed
        )
        if trust.max() == 0:
            shown = subtract(add(f_mean, relative), vector(x.accelerometer_bias_B))
            noise, period = sensors.acceleration_noise, known.period
            watch_force_delay(x.force_delay, shown, push, noise, elapsed, period)
            push_read = scale(1.0 / known.mass, force_read)
            if watch_force_lag(x.force_lag, shown, push_read, noise, elapsed, period):
                take_force_delay(x.force_delay, x.force_lag.delay * period)
        else:
            forget_force_delay(x.force_delay)
            forget_force_lag(x.force_lag)
    else:
        forget_force_delay(x.force_delay)
        forget_force_lag(x.force_lag)
        if not is_fresh or elapsed > LONGEST_COMPARED_TICK:
            x.check.age = 0.0
            x.check.doubt[:] = 0.0
    if was_known and trust.max() == 0 and carried > _CARRIED * weight:
        before = vector(last.away)
        listen_to_forces(x, P, correction, force, f_mean, w, away, before, model, elapsed, known)
    put(x.away, away)
    x.away_known = 1.0 if trust[0] == 0 and trust[1] in (0.0, _IMPLAUSIBLE) else 0.0
    correct(x, correction)
    if resting:
        x.lost_for = x.lost_for + elapsed if all_move and contradiction == 0.0 else 0.0
    x.lost_by = least_moved if resting and all_move else 0.0
    x.slides_by = 0.0
    if trust.max() > 0 or contradiction > 0.0 or x.lost_for > 0.0:
        forget_sliding(x)
    elif least_slides < math.inf:
        doubt_velocity(x, least_slides, sliding, elapsed, model, known)
    if not first:
        watch_for_losses(x, trust[1] == _IMPLAUSIBLE, elapsed, model, known)
    leash_biases(x, first, elapsed, known.config)
    is_doubtful = trust.max() > 0 or x.check.doubt.max() > 0
    is_doubtful = is_doubtful or contradiction > 0.0 or x.lost_for > 0.0
    remember_biases(x, is_doubtful, first, elapsed)
    _conclude(x, w_raw, wrench, measured, model, known)


@njit(cache=True)
def _conclude(
    x: Record,
    w_raw: Vector,
    wrench: np.ndarray,
    measured: Record,
    model: Record,
    known: Record,
) -> None:
    """Fills what follows from the state: the base, the centre of mass and the ZMP."""
    P, R = x.error_covariance, rotation(x.rotation)
    R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    w = subtract(w_raw, vector(x.gyro_bias_B))
    if measured.trust[1] == 0:
        put(x.angular_velocity, w)
    w = vector(x.angular_velocity)
    position = subtract(vector(x.imu_position), rotate(R, p_BI))
    velocity = subtract(vector(x.imu_velocity), rotate(R, cross(w, p_BI)))
    put(x.base_position, position)
    put(x.base_velocity, velocity)
    put(x.com_position, add(position, rotate(R, vector(model.com))))
    put(x.com_velocity, add(velocity, rotate(R, vector(model.com_velocity))))
    put(x.angular_velocity_bias, rotate_back(R_BI, vector(x.gyro_bias_B)))
    put(x.acceleration_bias, rotate_back(R_BI, vector(x.accelerometer_bias_B)))
    total, zmp_x, zmp_y = 0.0, 0.0, 0.0
    for foot in range(len(x.foot_standing)):
        load = wrench[foot, 5]
        if x.foot_standing[foot] > 0 and measured.trust[2 + foot] == 0 and load > 1.0:
            lever = (-wrench[foot, 1] / load, wrench[foot, 0] / load, 0.0)
            R_WF = rotation_matrix(quaternion(x.foot_orientation[foot]))
            centre = add(vector(x.foot_position[foot]), rotate(R_WF, lever))
            zmp_x, zmp_y, total = zmp_x + load * centre[0], zmp_y + load * centre[1], total + load
    if total > 0:
        put(x.zmp, (zmp_x / total, zmp_y / total))
    # The group's errors turn with the attitude's: v - v_hat = xi_v + phi x v.
    for i in range(3):
        tilted = x.slides_by * TILT_BY_VELOCITY if i < 2 else 0.0
        x.attitude_std[i] = math.hypot(math.sqrt(max(0.0, P[ATTITUDE + i, ATTITUDE + i])), tilted)
        x.angular_velocity_bias_std[i] = math.sqrt(max(0.0, P[GYRO_BIAS + i, GYRO_BIAS + i]))
        at = ACCELEROMETER_BIAS + i
        x.acceleration_bias_std[i] = math.sqrt(max(0.0, P[at, at]))
        # Whether it is the feet that move or the robot nobody knows yet.
        unsure = math.hypot(x.lost_by, x.slides_by)
        x.velocity_std[i] = math.hypot(moved_std(P, VELOCITY, i, velocity), unsure)
        x.position_std[i] = moved_std(P, POSITION, i, position)


class InvariantBaseFilter(RecursiveEstimator):
    """Attitude, velocity and position of the base with the IMU's biases, see `InvariantFilter`.

    .. pydrake_system::

        name: InvariantBaseFilter
        input_ports:
        - measurements
        - model
        output_ports:
        - posterior
        - (one for each field)
        - last

    Inputs: posteriors of `SensorMonitor` and `FloatingBaseModel`. `last` is the posterior of the
    tick before, for those that feed it. World axes unless said. Yaw and place are those of the
    start, as far as standing feet hold them. Fields of the posterior:

        orientation            (4,)    quaternion [w, x, y, z] of the base; its sign never jumps
        rotation               (3, 3)  R_WB
        angular_velocity       (3,)    of the base in base axes, free of the bias [rad/s]
        base_position, base_velocity   (3,)  of the base's origin [m, m/s]
        com_position, com_velocity     (3,)  [m, m/s]
        zmp                    (2,)    from the foot forces (eqs. 8, 9) [m]
        attitude_std, velocity_std, position_std   (3,)  standard deviations, of a rotation vector
                                       in world axes [rad], [m/s], [m]
        angular_velocity_bias, acceleration_bias   (3,)  of the IMU in its axes [rad/s, m/s^2], and
                                       `..._std` in base axes
        imu_position, imu_velocity     (3,)  of the IMU [m, m/s]
        gyro_bias_B, accelerometer_bias_B   (3,)  in base axes
        foot_standing          (feet,)     who stood at the last tick
        foot_position, foot_orientation   (feet, 3), (feet, 4)  of each sole while it stands
        error_covariance       (n, n)  of the errors [attitude, velocity, position, gyro bias,
                                       accelerometer bias, (position, orientation) of each foot] on
                                       the group, n = 15 + 6 feet
        foot_innovation, foot_innovation_variance   (feet, 4, 3)  of a standing foot's position,
                                       orientation, velocity and angular velocity, in axes of the
                                       sole
        force_innovation, force_innovation_variance   (3,)  of the centre of mass's acceleration, in
                                       base axes
        foot_agreement, force_agreement   running means of the innovations
        foot_restlessness, foot_habit  (feet, 4, 3)  of what a standing foot may do, in these four,
                                       how much it does at present and usually, as a share of the
                                       variance
        force_habit            (3,)    the same of the forces' error
        foot_age, force_age    (feet,), ()  for how long each has been listened to [s]
        foot_stood             (feet,)     for how long of that, since it landed [s]
        gyro, accelerometer    by how much each is noisier than believed, see `imu_noise_type`
        check                  what `cross_check` remembers: `doubt` (1 + feet,), positive for the
                               IMU and the feet that contradict the rest; `mean` (2, 3, 3) and
                               `load` (2, feet, 3) of the last 10 ms and 50 ms; `spread`; `rolling`
                               (3,); `habit` (3 + feet,), what always contradicts: an acceleration
                               and a share of what each foot carries, `habit_covariance`, and
                               `habit_known`, 1 from when it has been learned;
                               `last_rate`, `last_rolling` (3,) and `was_firm` of the tick before;
                               `stepped`, `age` and `agreed`, for how long the gyro is doubted for
                               its step, all is watched, and nothing contradicts [s]
        force_delay            what `watch_force_delay` remembers: the `delay` of the foot forces
                               [s], and more, see `force_delay_type`
        force_lag              what `watch_force_lag` remembers: the `time_constant` of the foot
                               sensors' low-pass [s], and more, see `force_lag_type`
        pad_force, pad_force_read      (P, 3)  force on each pad over the tick, and as it was read
                                       before that low-pass was undone [N]
        kept_biases, kept_for  (2, 4, 3), ()  biases of gyro and accelerometer in base axes and
                               their variances, older and newer, and the newer's age [s]
        sliding_share, slides_by       (), ()  for what share of the last second all feet slid that
                               carry the robot, and how fast they do if they keep doing so [m/s]
        sliding, sliding_square        (3,), ()  mean velocity and mean square velocity, over that
                               second, of the foot that slid least [m/s], [m^2/s^2]
        lost_for, lost_by      (), ()  for how long all feet that stand have contradicted the
                                       velocity [s], and by how much [m/s]
        lost_since, lost_ago   (), ()  how long ago that made the filter start over, for the first
                                       and for the last time of late [s]
        leash, leashed_for     (2, 4, 3), ()  biases and their variances, older and newer,
                               and the newer's age [s]
        away, away_known       (3,), ()  velocity of the centre of mass relative to the IMU in base
                                       axes [m/s], and whether it was measured
    """

    def __init__(
        self,
        config: InvariantFilter,
        sensors: SensorBeliefs,
        robot: Robot,
        measurements: np.dtype,
        model: np.dtype,
        clock: Clock,
        origin: tuple[float, float],
    ):
        """Declares ports and state.

        Args:
            measurements, model: types of the inputs' posteriors.
            origin: where the middle of the soles is at the start, (x, y) [m].
        """
        super().__init__(base_filter_type(robot, clock), clock)
        pads, plant = FootPads(robot), robot.plant
        self._known = record(
            config=config,
            sensors=sensors,
            mount=record(**vars(ImuMount(robot))),
            pads=record(position=pads.position, foot=pads.foot),
            soles=np.array(
                [[of.min(axis=0)[:2], of.max(axis=0)[:2]] for of in pads.split(pads.position)]
            ).reshape(-1, 2, 2),
            is_flat=np.array([float(not leg.is_point) for leg in robot.description.legs.values()]),
            force_variance=required(sensors.force_noise, "force_noise") ** 2 * len(pads.foot),
            mass=robot.total_mass,
            gravity=plant.gravity_field().gravity_vector(),
            start=record(**_START),
            origin=np.array([*origin, 0.0]),
            period=clock.period,
        )
        self._measurements = self._declare_record_input("measurements", measurements)
        self._model = self._declare_record_input("model", model)
        self._declare_posterior()
        self.DeclareStateOutputPort("last", self._last)

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        return {"measurements": measurements_type(robot), "model": model_type(robot)}

    def findings(self, context: Context) -> tuple[str, ...]:
        x = as_record(context.get_discrete_state().value(0), self.posterior_type)
        delay, lag = x["force_delay"]["delay"], x["force_lag"]["time_constant"]
        found = [f"{1e3 * delay:.3g} ms late"] if delay > 0 else []
        if lag > 0:
            found.append(f"behind a low-pass of {1e3 * lag:.2g} ms (in a model: !FootForceLag)")
        return (f"Foot forces were found to be {' and '.join(found)}.",) if found else ()

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, model = self._measurements.Eval(context), self._model.Eval(context)
        _estimate_base(posterior, last, elapsed, measured, model, self._known)


def base_filter_type(robot: Robot, clock: Clock) -> np.dtype:
    """Type of the posterior of `InvariantBaseFilter`."""
    feet = len(robot.description.sides)
    n, pads = FEET + 6 * feet, sum(leg.points for leg in robot.description.legs.values())
    triples = (
        "angular_velocity",
        "base_position",
        "base_velocity",
        "com_position",
        "com_velocity",
        "attitude_std",
        "velocity_std",
        "position_std",
        "angular_velocity_bias",
        "acceleration_bias",
        "angular_velocity_bias_std",
        "acceleration_bias_std",
        "imu_position",
        "imu_velocity",
        "gyro_bias_B",
        "accelerometer_bias_B",
        "away",
        "force_innovation",
        "force_agreement",
        "sliding",
    )
    return record_type(
        time=(),
        status=(),
        orientation=(4,),
        rotation=(3, 3),
        **dict.fromkeys(triples, (3,)),
        zmp=(2,),
        away_known=(),
        force_innovation_variance=(3,),
        force_habit=(3,),
        force_age=(),
        foot_standing=(feet,),
        foot_position=(feet, 3),
        foot_orientation=(feet, 4),
        foot_agreement=(feet, TOLD, 3),
        foot_restlessness=(feet, TOLD, 3),
        foot_habit=(feet, TOLD, 3),
        foot_age=(feet,),
        foot_stood=(feet,),
        foot_innovation=(feet, TOLD, 3),
        foot_innovation_variance=(feet, TOLD, 3),
        error_covariance=(n, n),
        kept_biases=(2, 4, 3),
        kept_for=(),
        leash=(2, 4, 3),
        leashed_for=(),
        sliding_share=(),
        sliding_square=(),
        slides_by=(),
        lost_for=(),
        lost_by=(),
        lost_since=(),
        lost_ago=(),
        **dict.fromkeys(("gyro", "accelerometer"), imu_noise_type()),
        check=cross_check_type(feet, clock),
        force_delay=force_delay_type(clock),
        force_lag=force_lag_type(clock),
        **dict.fromkeys(("pad_force", "pad_force_read"), (pads, 3)),
    )
