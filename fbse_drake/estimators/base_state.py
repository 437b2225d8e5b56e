"""Position and velocity of CoM and base.

The paper's adaptive Kalman filter on the LIPM, and leg kinematics fused with the IMU.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.errors import require_not_negative, require_positive
from fbse_drake.estimators.attitude import AttitudeConfig
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.floating_base import ImuMount, base_specific_force, model_type
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.estimators.spatial import (
    Vector,
    add,
    put,
    rotate,
    rotate_back,
    rotation,
    scale,
    subtract,
    vector,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches


@dataclass(frozen=True)
class _AfterAttitude(ABC):
    """What the estimators share that take the attitude from the stage before."""

    feeds_back: ClassVar[bool] = False

    def add(self, chain: Chain, attitude: AttitudeConfig, origin: tuple[float, float]) -> None:
        """Adds `attitude` and `base_state` to a chain that has `sensor_monitor` and `model`.

        Args:
            origin: see `BaseStateEstimator`.
        """
        attitude.add(chain)
        chain.add(
            "base_state",
            partial(self.system, chain.robot, origin=origin),
            measurements="sensor_monitor",
            attitude="attitude",
            model="model",
        )

    @abstractmethod
    def system(self, robot: Robot, **arguments: Any) -> "BaseStateEstimator":
        """The estimator with these settings; arguments as of its class."""


@dataclass(frozen=True)
class AdaptiveLipm(_AfterAttitude):
    """The paper's stable adaptive Kalman filter (13)-(31); defaults are Table II."""

    # Initial process noise, measurement noise and state covariance, each times the identity.
    process_noise: float = 1.0
    measurement_noise: float = 1.0e-4
    covariance: float = 10.0
    # Memories of the adaptation of R and Q [s]: N_R and N_Q ticks of 1 ms.
    measurement_memory: float = 1.0
    process_memory: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, "process_noise", "measurement_noise", "covariance")
        require_positive(self, "measurement_memory", "process_memory")

    def system(self, robot: Robot, **arguments: Any) -> "BaseStateEstimator":
        return AdaptiveLipmEstimator(self, robot, **arguments)


@dataclass(frozen=True)
class ContactAided(_AfterAttitude):
    """Kalman filter on base position, velocity and acceleration error.

    It is predicted with the IMU and corrected with the legs that stand.
    (After Bloesch et al. 2013, with the attitude taken from the attitude estimator.)
    """

    # Standard deviations: acceleration of the base [m/s^2]; what a standing foot moves and turns,
    # as position [m] and velocity [m/s] of the base seen through the leg; error of the
    # acceleration through bias and attitude, its size [m/s^2] and how long it lasts [s].
    acceleration_noise: float = 0.05
    position_noise: float = 3.0e-4
    velocity_noise: float = 1.5e-3
    acceleration_error: float = 0.1
    acceleration_error_time: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, "acceleration_noise", "position_noise", "velocity_noise")
        require_positive(self, "acceleration_error_time")
        require_not_negative(self, "acceleration_error")

    def system(self, robot: Robot, **arguments: Any) -> "BaseStateEstimator":
        return ContactAidedEstimator(self, robot, **arguments)


# Acceleration of the base while the IMU is not trusted: zero, give or take this [m/s^2].
_UNKNOWN_ACCELERATION = 3.0


@dataclass(frozen=True)
class Adaptation:
    """What the adaptive filter learns of its noise; all for one axis of the LIPM.

    Shapes: Q, mean_correction (3,).
    """

    Q: np.ndarray
    R: float
    mean_residual: float
    mean_correction: np.ndarray


@dataclass(frozen=True)
class LipmEstimate:
    """CoM position, velocity and acceleration along one axis, and their covariance (3, 3).

    Also the last innovation with its variance.
    """

    x: np.ndarray
    P: np.ndarray
    adaptation: Adaptation
    innovation: float = 0.0
    innovation_variance: float = 0.0


def _lipm_transition(elapsed: float) -> np.ndarray:
    """A of (13), shape (3, 3)."""
    return np.array([[1.0, elapsed, 0.5 * elapsed**2], [0.0, 1.0, elapsed], [0.0, 0.0, 1.0]])


def update_lipm(
    config: AdaptiveLipm,
    estimate: LipmEstimate,
    acceleration_change: float,
    zmp: float,
    com_height: float,
    gravity: float,
    elapsed: float,
) -> LipmEstimate:
    """One tick of the stable adaptive Kalman filter along one axis, paper eqs. (17)-(31).

    The input of (13) is the jerk, here as the change of the IMU-derived CoM acceleration over the
    tick.

    Args:
        acceleration_change: jerk times tick [m/s^2].
        zmp: measured zero moment point [m].
        elapsed: tick [s].
    """
    A = _lipm_transition(elapsed)
    C = np.array([1.0, 0.0, -com_height / gravity])
    learnt = estimate.adaptation
    n_r = max(2.0, config.measurement_memory / elapsed)
    n_q = max(2.0, config.process_memory / elapsed)
    prior = A @ estimate.x
    prior[2] += acceleration_change  # (17)
    propagated = A @ estimate.P @ A.T
    P_prior = propagated + np.diag(learnt.Q)  # (18)
    e = zmp - C @ prior  # (19)
    mean_residual = (n_r - 1) / n_r * learnt.mean_residual + e / n_r  # (20)
    PC = P_prior @ C
    predicted = C @ PC
    # (22), (23)
    R = abs((n_r - 1) / n_r * learnt.R + (e - mean_residual) ** 2 / (n_r - 1) - predicted / n_r)
    S = predicted + R
    K = PC / S  # (25)
    x = prior + K * e  # (24)
    P = P_prior - np.outer(K, PC)  # (26)
    correction = x - prior  # (30)
    mean_correction = (n_q - 1) / n_q * learnt.mean_correction + correction / n_q  # (31)
    spread = (correction - mean_correction) ** 2 / (n_q - 1)
    Q = (n_q - 1) / n_q * learnt.Q + np.diag(P - propagated) / n_q + spread
    return LipmEstimate(
        x,
        P,
        Adaptation(np.abs(Q), R, mean_residual, mean_correction),
        e,
        S,
    )  # (27)


class LegOdometry(NamedTuple):
    """The base seen through the legs that stand."""

    # Does any foot stand whose sensors, and the encoders, are trusted? Without one, position and
    # velocity mean nothing.
    stands: bool
    # Of the base's origin in the world [m], [m/s].
    position: Vector
    velocity: Vector


@njit(cache=True)
def _follow_legs(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    attitude: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> LegOdometry:
    """Starts a posterior of `BaseStateEstimator` as a copy of the last.

    Anchors the feet that land; ZMP from the foot forces (eqs. 8, 9).

    Args:
        known: record with `pads`, see `FootPads`, and `origin`, where the middle of the soles is at
            the start, (3,) [m].
    """
    posterior[()] = last[()]
    posterior, last, known = posterior[()], last[()], known[()]
    measured, attitude, model = measured[()], attitude[()], model[()]
    support, pads, R_WB = measured.support, known.pads, rotation(attitude.rotation)
    first, feet, v = math.isnan(elapsed), len(support), len(model.velocity)
    posterior.status = measured.trust.max()
    if first:
        # The soles' middle is where it is said to be.
        middle = (0.0, 0.0, 0.0)
        for foot in range(feet):
            middle = add(middle, scale(1.0 / feet, vector(model.foot_position[foot])))
        put(posterior.base_position, subtract(vector(known.origin), rotate(R_WB, middle)))
    wrench = foot_wrenches(measured.pad_force, pads.position, pads.foot, feet)
    total, zmp_x, zmp_y = 0.0, 0.0, 0.0
    position, velocity = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for foot in range(feet):
        p_BF = rotate(R_WB, vector(model.foot_position[foot]))  # world axes
        if first or (support[foot] > 0 and not last.standing[foot] > 0):
            landed = add(vector(posterior.base_position), p_BF)
            put(posterior.anchor[foot], (landed[0], landed[1], 0.0))
        posterior.standing[foot] = support[foot]
        # Feet that stand count with their load.
        load = wrench[foot, 5]
        if support[foot] > 0 and measured.trust[2 + foot] == 0 and load > 1.0:
            anchor, R_BF = vector(posterior.anchor[foot]), rotation(model.foot_rotation[foot])
            lever = (-wrench[foot, 1] / load, wrench[foot, 0] / load, 0.0)
            centre_of_pressure = rotate(R_WB, rotate(R_BF, lever))
            zmp_x += load * (anchor[0] + centre_of_pressure[0])
            zmp_y += load * (anchor[1] + centre_of_pressure[1])
            position = add(position, scale(load, subtract(anchor, p_BF)))
            J = model.foot_jacobian[foot]
            vx, vy, vz = 0.0, 0.0, 0.0
            for j in range(v):
                rate = model.velocity[j]
                vx += J[3, j] * rate
                vy += J[4, j] * rate
                vz += J[5, j] * rate
            velocity = subtract(velocity, scale(load, rotate(R_BF, (vx, vy, vz))))
            total += load
    if total > 0:
        put(posterior.zmp, (zmp_x / total, zmp_y / total))
        position = scale(1.0 / total, position)
        velocity = scale(1.0 / total, rotate(R_WB, velocity))
    return LegOdometry(total > 0 and measured.trust[0] == 0, position, velocity)


class BaseStateEstimator(RecursiveEstimator):
    """What both estimators of the base state share: feet that stand anchor the robot in the world.

    .. pydrake_system::

        name: BaseStateEstimator
        input_ports:
        - measurements
        - attitude
        - model
        output_ports:
        - posterior
        - (one for each field)

    Inputs: posteriors of `SensorMonitor`, `AttitudeEstimator` and `FloatingBaseModel`. Fields of
    the posterior:

        base_position, base_velocity   (3,)  of the base's origin in the world (eqs. 32, 33)
                                             [m, m/s]
        com_position, com_velocity     (3,)  [m, m/s]
        zmp                            (2,)  from the foot forces (eqs. 8, 9) [m]
        anchor                         (feet, 3)  where each foot was put down [m]; the ground is
                                             level, at z = 0
        standing                       (feet,)  who stood at the last tick
    """

    def __init__(
        self,
        robot: Robot,
        measurements: np.dtype,
        attitude: np.dtype,
        model: np.dtype,
        clock: Clock,
        origin: tuple[float, float],
        **further_fields: tuple[int, ...] | np.dtype,
    ):
        """Declares ports and state.

        Args:
            measurements, attitude, model: types of the inputs' posteriors.
            origin: where the middle of the soles is at the start, (x, y) [m].
            further_fields: of the posterior, see `record_type`.
        """
        feet = len(robot.description.sides)
        posterior_type = record_type(
            time=(),
            status=(),
            base_position=(3,),
            base_velocity=(3,),
            com_position=(3,),
            com_velocity=(3,),
            zmp=(2,),
            anchor=(feet, 3),
            standing=(feet,),
            **further_fields,
        )
        super().__init__(posterior_type, clock)
        self._mount, pads = ImuMount(robot), FootPads(robot)
        self._gravity = robot.plant.gravity_field().gravity_vector()
        self._legs = {
            "pads": record(position=pads.position, foot=pads.foot),
            "origin": (*origin, 0.0),
        }
        self._measurements = self._declare_record_input("measurements", measurements)
        self._attitude = self._declare_record_input("attitude", attitude)
        self._model = self._declare_record_input("model", model)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        return {
            "measurements": measurements_type(robot),
            "attitude": record_type(rotation=(3, 3), angular_velocity=(3,)),
            "model": model_type(robot),
        }


class AdaptiveLipmEstimator(BaseStateEstimator):
    """The paper's base states observer (Sec. 4).

    x and y come from the adaptive Kalman filter on the LIPM, z from the legs.

    .. pydrake_system::

        name: AdaptiveLipmEstimator
        input_ports:
        - measurements
        - attitude
        - model
        output_ports:
        - posterior
        - (one for each field)

    Further fields, per horizontal axis: `state` (2, 3) CoM position, velocity, acceleration;
    `covariance` (2, 3, 3); `process_noise` (2, 3), `measurement_noise` (2,), `mean_residual` (2,),
    `mean_correction` (2, 3); `innovation` (2,) and `innovation_variance` (2,); and `rate` (3,) and
    `imu_acceleration` (3,) of the last tick.
    """

    def __init__(
        self,
        config: AdaptiveLipm,
        robot: Robot,
        measurements: np.dtype,
        attitude: np.dtype,
        model: np.dtype,
        clock: Clock,
        origin: tuple[float, float],
    ):
        super().__init__(
            robot,
            measurements,
            attitude,
            model,
            clock,
            origin,
            state=(2, 3),
            covariance=(2, 3, 3),
            process_noise=(2, 3),
            measurement_noise=(2,),
            mean_residual=(2,),
            mean_correction=(2, 3),
            innovation=(2,),
            innovation_variance=(2,),
            rate=(3,),
            imu_acceleration=(3,),
        )
        self._config, self._known = config, record(**self._legs)

    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        measured, attitude = self._measurements.Eval(context), self._attitude.Eval(context)
        model, first, config = self._model.Eval(context), math.isnan(elapsed), self._config
        legs = _follow_legs(posterior, last, elapsed, measured, attitude, model, self._known)
        R_WB = attitude["rotation"]
        offset = -(R_WB @ model["com"])  # c_offset: from CoM to base
        w_W = R_WB @ attitude["angular_velocity"]
        w_dot = np.zeros(3) if first else (w_W - last["rate"]) / elapsed
        # From the IMU to the CoM: minus the sum of (16), whose sign is wrong in print.
        arm = -(R_WB @ self._mount.p_BI + offset)
        acceleration = last["imu_acceleration"]
        if measured["trust"][1] == 0:
            acceleration = R_WB @ (self._mount.R_BI @ measured["specific_force"]) + self._gravity
            acceleration += np.cross(w_dot, arm) + np.cross(w_W, np.cross(w_W, arm))  # (16)
        change = np.zeros(3) if first else acceleration - last["imu_acceleration"]
        posterior["rate"], posterior["imu_acceleration"] = w_W, acceleration
        base_z, velocity_z = posterior["base_position"][2], posterior["base_velocity"][2]
        if legs.stands:
            base_z, velocity_z = legs.position[2], legs.velocity[2]
        height = base_z - offset[2]
        state, covariance = posterior["state"], posterior["covariance"]
        process_noise, correction = posterior["process_noise"], posterior["mean_correction"]
        measurement_noise, residual = posterior["measurement_noise"], posterior["mean_residual"]
        for axis in range(2):
            if first:
                start = posterior["base_position"][axis] - offset[axis]
                state[axis] = [start, 0.0, acceleration[axis]]
                covariance[axis] = config.covariance * np.eye(3)
                process_noise[axis] = config.process_noise
                measurement_noise[axis] = config.measurement_noise
                continue
            if not legs.stands:
                # No load, no ZMP: predict only.
                A = _lipm_transition(elapsed)
                state[axis] = A @ state[axis] + [0.0, 0.0, change[axis]]
                continue
            adaptation = Adaptation(
                process_noise[axis],
                float(measurement_noise[axis]),
                float(residual[axis]),
                correction[axis],
            )
            before = LipmEstimate(state[axis], covariance[axis], adaptation)
            zmp = float(posterior["zmp"][axis])
            new = update_lipm(
                config,
                before,
                float(change[axis]),
                zmp,
                height,
                -self._gravity[2],
                elapsed,
            )
            state[axis], covariance[axis], learnt = new.x, new.P, new.adaptation
            process_noise[axis], correction[axis] = learnt.Q, learnt.mean_correction
            measurement_noise[axis], residual[axis] = learnt.R, learnt.mean_residual
            posterior["innovation"][axis] = new.innovation
            posterior["innovation_variance"][axis] = new.innovation_variance
        c, c_dot = state[:, 0], state[:, 1]
        posterior["com_position"] = [*c, height]
        turning = np.cross(w_W, offset)
        posterior["com_velocity"] = [*c_dot, velocity_z - turning[2]]
        posterior["base_position"] = [*(c + offset[:2]), base_z]  # (32)
        posterior["base_velocity"] = [*(c_dot + turning[:2]), velocity_z]  # (33)


class ContactAidedCovariance(NamedTuple):
    """Covariance of position, velocity and acceleration error, the same for all three axes."""

    pp: float
    pv: float
    pa: float
    vv: float
    va: float
    aa: float


class ContactAidedEstimate(NamedTuple):
    """Position [m] and velocity [m/s] of the base and error of its acceleration [m/s^2].

    All in world axes.
    """

    position: Vector
    velocity: Vector
    acceleration_error: Vector
    covariance: ContactAidedCovariance


@njit(cache=True)
def predict_contact_aided(
    x: ContactAidedEstimate,
    acceleration: Vector,
    noise: float,
    error: float,
    error_time: float,
    elapsed: float,
) -> ContactAidedEstimate:
    """Prediction of one axis: p' = p + T v, v' = v - T a, a' = fade a.

    Args:
        acceleration: of the base, free of its estimated error [m/s^2].
        noise: its standard deviation [m/s^2].
        error, error_time: size of the acceleration's error [m/s^2], and how long it lasts [s].
        elapsed: time step T [s].
    """
    T, fade = elapsed, math.exp(-elapsed / error_time)
    pp, pv, pa, vv, va, aa = x.covariance
    pp, pv, pa = pp + T * (2 * pv + T * vv), pv + T * (vv - pa - T * va), fade * (pa + T * va)
    vv, va, aa = (
        vv + T * (T * aa - 2 * va) + (T * noise) ** 2,
        fade * (va - T * aa),
        fade * fade * aa,
    )
    aa += (1 - fade * fade) * error**2
    return ContactAidedEstimate(
        add(x.position, add(scale(T, x.velocity), scale(0.5 * T * T, acceleration))),
        add(x.velocity, scale(T, acceleration)),
        scale(fade, x.acceleration_error),
        ContactAidedCovariance(pp, pv, pa, vv, va, aa),
    )


@njit(cache=True)
def update_contact_aided(
    x: ContactAidedEstimate,
    innovation: Vector,
    covariance: Vector,
    S: float,
) -> ContactAidedEstimate:
    """Kalman update with a measured position or velocity.

    Args:
        covariance: of position, velocity and acceleration error with what is measured, per axis.
        S: variance of the innovation per axis.
    """
    pp, pv, pa, vv, va, aa = x.covariance
    cp, cv, ca = covariance
    kp, kv, ka = scale(1.0 / S, covariance)
    return ContactAidedEstimate(
        add(x.position, scale(kp, innovation)),
        add(x.velocity, scale(kv, innovation)),
        add(x.acceleration_error, scale(ka, innovation)),
        ContactAidedCovariance(
            pp - kp * cp,
            pv - kp * cv,
            pa - kp * ca,
            vv - kv * cv,
            va - kv * ca,
            aa - ka * ca,
        ),
    )


@njit(cache=True)
def _estimate_base_state(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    attitude: np.ndarray,
    model: np.ndarray,
    known: np.ndarray,
) -> None:
    """One tick of `ContactAidedEstimator`; fills the posterior.

    Args:
        known: see `_follow_legs`; and the values of `ContactAided`, `mount`, see `ImuMount`, and
            `gravity` (3,) [m/s^2].
    """
    legs = _follow_legs(posterior, last, elapsed, measured, attitude, model, known)
    posterior, last, known = posterior[()], last[()], known[()]
    measured, attitude, model = measured[()], attitude[()], model[()]
    config, before = known.config, last.covariance
    R_WB, w_B = rotation(attitude.rotation), vector(attitude.angular_velocity)
    w_W = rotate(R_WB, w_B)
    x = ContactAidedEstimate(
        vector(posterior.base_position),
        vector(posterior.base_velocity),
        vector(posterior.acceleration_error),
        ContactAidedCovariance(before.pp, before.pv, before.pa, before.vv, before.va, before.aa),
    )
    if math.isnan(elapsed):
        P_first = ContactAidedCovariance(
            config.position_noise**2,
            0.0,
            0.0,
            config.velocity_noise**2,
            0.0,
            config.acceleration_error**2,
        )
        x = ContactAidedEstimate(x.position, x.velocity, x.acceleration_error, P_first)
    else:
        acceleration, noise = (0.0, 0.0, 0.0), _UNKNOWN_ACCELERATION
        if measured.trust[1] == 0:
            change = subtract(w_W, vector(last.rate))
            w_dot = scale(1.0 / elapsed, rotate_back(R_WB, change))
            R_BI, p_BI = rotation(known.mount.R_BI), vector(known.mount.p_BI)
            force = base_specific_force(vector(measured.specific_force), w_B, w_dot, R_BI, p_BI)
            free = add(rotate(R_WB, force), vector(known.gravity))
            acceleration = subtract(free, x.acceleration_error)
            noise = config.acceleration_noise
        error, error_time = config.acceleration_error, config.acceleration_error_time
        x = predict_contact_aided(x, acceleration, noise, error, error_time, elapsed)
        if legs.stands:
            P, innovation = x.covariance, subtract(legs.position, x.position)
            S = P.pp + config.position_noise**2
            x = update_contact_aided(x, innovation, (P.pp, P.pv, P.pa), S)
            put(posterior.innovation.position, innovation)
            posterior.innovation_variance.position = S
            P, innovation = x.covariance, subtract(legs.velocity, x.velocity)
            S = P.vv + config.velocity_noise**2
            x = update_contact_aided(x, innovation, (P.pv, P.vv, P.va), S)
            put(posterior.innovation.velocity, innovation)
            posterior.innovation_variance.velocity = S
    put(posterior.base_position, x.position)
    put(posterior.base_velocity, x.velocity)
    # Posture and leg motion take the base to the centre of mass.
    put(posterior.com_position, add(x.position, rotate(R_WB, vector(model.com))))
    put(posterior.com_velocity, add(x.velocity, rotate(R_WB, vector(model.com_velocity))))
    put(posterior.acceleration_error, x.acceleration_error)
    after = posterior.covariance
    after.pp, after.pv, after.pa, after.vv, after.va, after.aa = x.covariance
    put(posterior.rate, w_W)


class ContactAidedEstimator(BaseStateEstimator):
    """Base position and velocity from the IMU and the legs that stand.

    .. pydrake_system::

        name: ContactAidedEstimator
        input_ports:
        - measurements
        - attitude
        - model
        output_ports:
        - posterior
        - (one for each field)

    Further fields: `acceleration_error` (3,) of the IMU in world axes [m/s^2]; `covariance` pp,
    pv, ..., see `ContactAidedCovariance`; `innovation` of `position` and `velocity`, (3,) each
    [m, m/s], and `innovation_variance` of both per axis; `rate` (3,) of the last tick.
    """

    def __init__(
        self,
        config: ContactAided,
        robot: Robot,
        measurements: np.dtype,
        attitude: np.dtype,
        model: np.dtype,
        clock: Clock,
        origin: tuple[float, float],
    ):
        super().__init__(
            robot,
            measurements,
            attitude,
            model,
            clock,
            origin,
            acceleration_error=(3,),
            covariance=record_type(**dict.fromkeys(ContactAidedCovariance._fields, ())),
            innovation=record_type(position=(3,), velocity=(3,)),
            innovation_variance=record_type(position=(), velocity=()),
            rate=(3,),
        )
        mount = record(**vars(self._mount))
        self._known = record(**self._legs, config=config, mount=mount, gravity=self._gravity)

    def _tick(
        self,
        context: Context,
        last: np.ndarray,
        elapsed: float,
        posterior: np.ndarray,
    ) -> None:
        _estimate_base_state(
            posterior,
            last,
            elapsed,
            self._measurements.Eval(context),
            self._attitude.Eval(context),
            self._model.Eval(context),
            self._known,
        )
