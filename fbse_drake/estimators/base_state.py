"""Position and velocity of CoM and base: the paper's adaptive Kalman filter on the LIPM, and leg kinematics fused with the IMU."""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from pydrake.systems.framework import Context

from fbse_drake.errors import require_not_negative, require_positive
from fbse_drake.estimators.floating_base import ImuMount, base_specific_force
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, starts
from fbse_drake.estimators.spatial import (
    Rotation,
    Vector,
    add,
    put,
    rotate,
    rotate_back,
    rotation_at,
    scale,
    subtract,
    vector_at,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches


@dataclass(frozen=True)
class AdaptiveLipm:
    """The paper's stable adaptive Kalman filter (13)-(31); defaults are Table II."""

    # Initial process noise, measurement noise and state covariance, each times the identity.
    process_noise: float = 1.0
    measurement_noise: float = 1.0e-4
    covariance: float = 10.0
    # Memories of the adaptation of R and Q [s]: N_R and N_Q ticks of 1 ms.
    measurement_memory: float = 1.0
    process_memory: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, "process_noise", "measurement_noise", "covariance", "measurement_memory", "process_memory")


@dataclass(frozen=True)
class ContactAided:
    """Kalman filter on base position, velocity and acceleration error: predicted with the IMU, corrected with the legs that stand.

    (After Bloesch et al. 2013, with the attitude taken from the attitude estimator.)
    """

    # Standard deviations: acceleration of the base [m/s^2]; what a standing foot moves and turns, as position [m] and velocity [m/s] of the
    # base seen through the leg; error of the acceleration through bias and attitude, its size [m/s^2] and how long it lasts [s].
    acceleration_noise: float = 0.05
    position_noise: float = 3.0e-4
    velocity_noise: float = 1.5e-3
    acceleration_error: float = 0.1
    acceleration_error_time: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, "acceleration_noise", "position_noise", "velocity_noise", "acceleration_error_time")
        require_not_negative(self, "acceleration_error")


BaseStateConfig = AdaptiveLipm | ContactAided

# Acceleration of the base while the IMU is not trusted: zero, give or take this [m/s^2].
_UNKNOWN_ACCELERATION = 3.0


@dataclass(frozen=True)
class Adaptation:
    """What the adaptive filter learns of its noise; all for one axis of the LIPM. Shapes: Q, mean_correction (3,)."""

    Q: np.ndarray
    R: float
    mean_residual: float
    mean_correction: np.ndarray


@dataclass(frozen=True)
class LipmEstimate:
    """CoM position, velocity and acceleration along one axis, their covariance (3, 3), and the last innovation with its variance."""

    x: np.ndarray
    P: np.ndarray
    adaptation: Adaptation
    innovation: float = 0.0
    innovation_variance: float = 0.0


def update_lipm(
    config: AdaptiveLipm, estimate: LipmEstimate, acceleration_change: float, zmp: float, com_height: float, gravity: float, elapsed: float
) -> LipmEstimate:
    """One tick of the stable adaptive Kalman filter along one axis, paper eqs. (17)-(31).

    The input of (13) is the jerk, here as the change of the IMU-derived CoM acceleration over the tick.

    Args:
        acceleration_change: jerk times tick [m/s^2].
        zmp: measured zero moment point [m].
        elapsed: tick [s].
    """
    A = np.array([[1.0, elapsed, 0.5 * elapsed**2], [0.0, 1.0, elapsed], [0.0, 0.0, 1.0]])
    C = np.array([1.0, 0.0, -com_height / gravity])
    learnt = estimate.adaptation
    n_r, n_q = max(2.0, config.measurement_memory / elapsed), max(2.0, config.process_memory / elapsed)
    prior = A @ estimate.x
    prior[2] += acceleration_change  # (17)
    propagated = A @ estimate.P @ A.T
    P_prior = propagated + np.diag(learnt.Q)  # (18)
    e = zmp - C @ prior  # (19)
    mean_residual = (n_r - 1) / n_r * learnt.mean_residual + e / n_r  # (20)
    PC = P_prior @ C
    predicted = C @ PC
    R = abs((n_r - 1) / n_r * learnt.R + (e - mean_residual) ** 2 / (n_r - 1) - predicted / n_r)  # (22), (23)
    S = predicted + R
    K = PC / S  # (25)
    x = prior + K * e  # (24)
    P = P_prior - np.outer(K, PC)  # (26)
    correction = x - prior  # (30)
    mean_correction = (n_q - 1) / n_q * learnt.mean_correction + correction / n_q  # (31)
    Q = (n_q - 1) / n_q * learnt.Q + np.diag(P - propagated) / n_q + (correction - mean_correction) ** 2 / (n_q - 1)
    return LipmEstimate(x, P, Adaptation(np.abs(Q), R, mean_residual, mean_correction), e, S)  # (27)


class LegOdometry(NamedTuple):
    """The base seen through the legs that stand."""

    # Does any foot stand whose sensors, and the encoders, are trusted? Without one, position and velocity mean nothing.
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
    R_WB: Rotation,
    model: np.ndarray,
    pad_position: np.ndarray,
    pad_foot: np.ndarray,
    places: np.ndarray,
    origin: Vector,
) -> LegOdometry:
    """Starts a posterior of `BaseStateEstimator` as a copy of the last; anchors the feet that land; ZMP from the foot forces (eqs. 8, 9).

    Args:
        places: of what is read and written, see the first lines.
        origin: where the middle of the soles is at the start [m].
    """
    trust, pad_force, support_start, support_stop = to_fixed_tuple(places, 4)
    foot_position, foot_rotation, foot_jacobian, velocity_start, velocity_stop = to_fixed_tuple(places[4:], 5)
    base_position, zmp_at, anchors, standing = to_fixed_tuple(places[9:], 4)
    support = measured[support_start:support_stop]
    first, feet, v = math.isnan(elapsed), len(support), velocity_stop - velocity_start
    posterior[:] = last
    posterior[STATUS] = measured[trust : trust + 2 + feet].max()
    if first:
        # The soles' middle is where it is said to be.
        middle = (0.0, 0.0, 0.0)
        for foot in range(feet):
            middle = add(middle, scale(1.0 / feet, vector_at(model, foot_position + 3 * foot)))
        put(posterior, base_position, subtract(origin, rotate(R_WB, middle)))
    wrench = foot_wrenches(measured[pad_force:], pad_position, pad_foot, feet)
    total, zmp_x, zmp_y = 0.0, 0.0, 0.0
    position, velocity = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for foot in range(feet):
        anchor_at, p_BF = anchors + 3 * foot, rotate(R_WB, vector_at(model, foot_position + 3 * foot))  # world axes
        if first or (support[foot] > 0 and not last[standing + foot] > 0):
            landed = add(vector_at(posterior, base_position), p_BF)
            put(posterior, anchor_at, (landed[0], landed[1], 0.0))
        posterior[standing + foot] = support[foot]
        # Feet that stand count with their load.
        load = wrench[foot, 5]
        if support[foot] > 0 and measured[trust + 2 + foot] == 0 and load > 1.0:
            anchor, R_BF = vector_at(posterior, anchor_at), rotation_at(model, foot_rotation + 9 * foot)
            centre_of_pressure = rotate(R_WB, rotate(R_BF, (-wrench[foot, 1] / load, wrench[foot, 0] / load, 0.0)))
            zmp_x += load * (anchor[0] + centre_of_pressure[0])
            zmp_y += load * (anchor[1] + centre_of_pressure[1])
            position = add(position, scale(load, subtract(anchor, p_BF)))
            row = foot_jacobian + (6 * foot + 3) * v
            vx, vy, vz = 0.0, 0.0, 0.0
            for j in range(v):
                rate = model[velocity_start + j]
                vx += model[row + j] * rate
                vy += model[row + v + j] * rate
                vz += model[row + 2 * v + j] * rate
            velocity = subtract(velocity, scale(load, rotate(R_BF, (vx, vy, vz))))
            total += load
    if total > 0:
        posterior[zmp_at], posterior[zmp_at + 1] = zmp_x / total, zmp_y / total
        position, velocity = scale(1.0 / total, position), scale(1.0 / total, rotate(R_WB, velocity))
    return LegOdometry(total > 0 and measured[trust] == 0, position, velocity)


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

    Inputs: posteriors of `SensorMonitor`, `AttitudeEstimator` and `FloatingBaseModel`. Fields of the posterior:

        base_position, base_velocity   (3,)  of the base's origin in the world (eqs. 32, 33) [m, m/s]
        com_position, com_velocity     (3,)  [m, m/s]
        zmp                            (2,)  from the foot forces (eqs. 8, 9) [m]
        anchors                        (feet, 3)  where each foot was put down [m]; the ground is level, at z = 0
        standing                       (feet,)  who stood at the last tick
    """

    def __init__(
        self,
        robot: Robot,
        measurements: dict[str, slice],
        attitude: dict[str, slice],
        model: dict[str, slice],
        clock: Clock,
        origin: tuple[float, float],
        further_fields: Mapping[str, int],
    ):
        """Declares ports and state.

        Args:
            origin: where the middle of the soles is at the start, (x, y) [m].
            further_fields: of the posterior.
        """
        feet = len(robot.description.sides)
        super().__init__(
            {
                "status": 1,
                "base_position": 3,
                "base_velocity": 3,
                "com_position": 3,
                "com_velocity": 3,
                "zmp": 2,
                "anchors": 3 * feet,
                "standing": feet,
                **further_fields,
            },
            clock,
        )
        self._mount, self._pads, self._origin = ImuMount(robot), FootPads(robot), (*origin, 0.0)
        self._gravity = robot.plant.gravity_field().gravity_vector()
        self._leg_places = np.array(
            [
                *starts(measurements, "trust", "pad_force", "support"),
                measurements["support"].stop,
                *starts(model, "foot_position", "foot_rotation", "foot_jacobian", "velocity"),
                model["velocity"].stop,
                *starts(self.fields.slices, "base_position", "zmp", "anchors", "standing"),
            ]
        )
        for name, parts in (("measurements", measurements), ("attitude", attitude), ("model", model)):
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        names = ("measurements", "attitude", "model")
        self._measurements, self._attitude, self._model = (self.GetInputPort(name) for name in names)
        self._declare_posterior(*names)


class AdaptiveLipmEstimator(BaseStateEstimator):
    """The paper's base states observer (Sec. 4): x and y from the adaptive Kalman filter on the LIPM, z from the legs.

    .. pydrake_system::

        name: AdaptiveLipmEstimator
        input_ports:
        - measurements
        - attitude
        - model
        output_ports:
        - posterior

    Further fields, per horizontal axis: `state` (3,) CoM position, velocity, acceleration; `covariance` (3, 3); `process_noise` (3,),
    `measurement_noise`, `mean_residual`, `mean_correction` (3,); `innovation` and `innovation_variance`; and `rate` (3,) and
    `imu_acceleration` (3,) of the last tick.
    """

    def __init__(
        self,
        config: AdaptiveLipm,
        robot: Robot,
        measurements: dict[str, slice],
        attitude: dict[str, slice],
        model: dict[str, slice],
        clock: Clock,
        origin: tuple[float, float],
    ):
        further = {
            "state": 6,
            "covariance": 18,
            "process_noise": 6,
            "measurement_noise": 2,
            "mean_residual": 2,
            "mean_correction": 6,
            "innovation": 2,
            "innovation_variance": 2,
            "rate": 3,
            "imu_acceleration": 3,
        }
        super().__init__(robot, measurements, attitude, model, clock, origin, further)
        self._config = config
        self._imu_trust, self._specific_force = measurements["trust"].start + 1, measurements["specific_force"]
        self._rotation, self._angular_velocity, self._com = attitude["rotation"], attitude["angular_velocity"], model["com"]

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        measured, attitude, model = self._measurements.Eval(context), self._attitude.Eval(context), self._model.Eval(context)
        first, fields, config = math.isnan(elapsed), self.fields, self._config
        R_WB = attitude[self._rotation].reshape(3, 3)
        legs = _follow_legs(
            posterior,
            last,
            elapsed,
            measured,
            tuple(R_WB.ravel().tolist()),
            model,
            self._pads.position,
            self._pads.foot,
            self._leg_places,
            self._origin,
        )
        offset = -(R_WB @ model[self._com])  # c_offset: from CoM to base
        w_W = R_WB @ attitude[self._angular_velocity]
        w_dot = np.zeros(3) if first else (w_W - posterior[fields["rate"]]) / elapsed
        # From the IMU to the CoM: minus the sum of (16), whose sign is wrong in print.
        arm = -(R_WB @ self._mount.p_BI + offset)
        acceleration = posterior[fields["imu_acceleration"]].copy()
        if measured[self._imu_trust] == 0:
            acceleration = R_WB @ (self._mount.R_BI @ measured[self._specific_force]) + self._gravity
            acceleration += np.cross(w_dot, arm) + np.cross(w_W, np.cross(w_W, arm))  # (16)
        change = np.zeros(3) if first else acceleration - posterior[fields["imu_acceleration"]]
        posterior[fields["rate"]], posterior[fields["imu_acceleration"]] = w_W, acceleration
        base_z, velocity_z = posterior[fields["base_position"]][2], posterior[fields["base_velocity"]][2]
        if legs.stands:
            base_z, velocity_z = legs.position[2], legs.velocity[2]
        height = base_z - offset[2]
        parts = {name: posterior[fields[name]].reshape(2, -1) for name in ("state", "covariance", "process_noise", "mean_correction")}
        for axis in range(2):
            if first:
                parts["state"][axis] = [posterior[fields["base_position"]][axis] - offset[axis], 0.0, acceleration[axis]]
                parts["covariance"][axis] = config.covariance * np.eye(3).ravel()
                parts["process_noise"][axis] = config.process_noise
                posterior[fields["measurement_noise"]][axis] = config.measurement_noise
                continue
            if not legs.stands:
                # No load, no ZMP: predict only.
                A = np.array([[1.0, elapsed, 0.5 * elapsed**2], [0.0, 1.0, elapsed], [0.0, 0.0, 1.0]])
                parts["state"][axis] = A @ parts["state"][axis] + [0.0, 0.0, change[axis]]
                continue
            adaptation = Adaptation(
                parts["process_noise"][axis],
                float(posterior[fields["measurement_noise"]][axis]),
                float(posterior[fields["mean_residual"]][axis]),
                parts["mean_correction"][axis],
            )
            last = LipmEstimate(parts["state"][axis], parts["covariance"][axis].reshape(3, 3), adaptation)
            zmp = float(posterior[fields["zmp"]][axis])
            new = update_lipm(config, last, float(change[axis]), zmp, height, -self._gravity[2], elapsed)
            parts["state"][axis], parts["covariance"][axis] = new.x, new.P.ravel()
            parts["process_noise"][axis], parts["mean_correction"][axis] = new.adaptation.Q, new.adaptation.mean_correction
            posterior[fields["measurement_noise"]][axis] = new.adaptation.R
            posterior[fields["mean_residual"]][axis] = new.adaptation.mean_residual
            posterior[fields["innovation"]][axis] = new.innovation
            posterior[fields["innovation_variance"]][axis] = new.innovation_variance
        c, c_dot = parts["state"][:, 0], parts["state"][:, 1]
        posterior[fields["com_position"]] = [*c, height]
        turning = np.cross(w_W, offset)
        posterior[fields["com_velocity"]] = [*c_dot, velocity_z - turning[2]]
        posterior[fields["base_position"]] = [*(c + offset[:2]), base_z]  # (32)
        posterior[fields["base_velocity"]] = [*(c_dot + turning[:2]), velocity_z]  # (33)


class ContactAidedCovariance(NamedTuple):
    """Covariance of position, velocity and acceleration error of the base, the same for all three axes."""

    pp: float
    pv: float
    pa: float
    vv: float
    va: float
    aa: float


class ContactAidedEstimate(NamedTuple):
    """Position [m] and velocity [m/s] of the base and error of its acceleration [m/s^2], in world axes."""

    position: Vector
    velocity: Vector
    acceleration_error: Vector
    covariance: ContactAidedCovariance


@njit(cache=True)
def predict_contact_aided(
    x: ContactAidedEstimate, acceleration: Vector, noise: float, error: float, error_time: float, elapsed: float
) -> ContactAidedEstimate:
    """Prediction of one axis: p' = p + T v, v' = v - T a, a' = fade a.

    Args:
        acceleration: of the base, free of its estimated error [m/s^2]; noise: its standard deviation [m/s^2].
        error, error_time: size of the acceleration's error [m/s^2], and how long it lasts [s].
        elapsed: time step T [s].
    """
    T, fade = elapsed, math.exp(-elapsed / error_time)
    pp, pv, pa, vv, va, aa = x.covariance
    pp, pv, pa = pp + T * (2 * pv + T * vv), pv + T * (vv - pa - T * va), fade * (pa + T * va)
    vv, va, aa = vv + T * (T * aa - 2 * va) + (T * noise) ** 2, fade * (va - T * aa), fade * fade * aa
    aa += (1 - fade * fade) * error**2
    return ContactAidedEstimate(
        add(x.position, add(scale(T, x.velocity), scale(0.5 * T * T, acceleration))),
        add(x.velocity, scale(T, acceleration)),
        scale(fade, x.acceleration_error),
        ContactAidedCovariance(pp, pv, pa, vv, va, aa),
    )


@njit(cache=True)
def update_contact_aided(x: ContactAidedEstimate, innovation: Vector, covariance: Vector, S: float) -> ContactAidedEstimate:
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
        ContactAidedCovariance(pp - kp * cp, pv - kp * cv, pa - kp * ca, vv - kv * cv, va - kv * ca, aa - ka * ca),
    )


@njit(cache=True)
def _estimate_base_state(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    attitude: np.ndarray,
    model: np.ndarray,
    pad_position: np.ndarray,
    pad_foot: np.ndarray,
    leg_places: np.ndarray,
    places: np.ndarray,
    frames: np.ndarray,
    config: np.ndarray,
) -> None:
    """One tick of `ContactAidedEstimator`; fills the posterior.

    Args:
        leg_places: see `_follow_legs`; places: of what is read and written besides, see the first lines; after `com` comes `com_velocity`.
        frames: where the middle of the soles is at the start, rotation and lever arm of the IMU, gravity.
        config: the values of `ContactAided`.
    """
    imu_trust, specific_force, rotation, angular_velocity, com, base_position, further = to_fixed_tuple(places, 7)
    acceleration_noise, position_noise, velocity_noise, acceleration_error, acceleration_error_time = to_fixed_tuple(config, 5)
    origin, R_BI, p_BI, gravity = vector_at(frames, 0), rotation_at(frames, 3), vector_at(frames, 12), vector_at(frames, 15)
    R_WB, w_B = rotation_at(attitude, rotation), vector_at(attitude, angular_velocity)
    legs = _follow_legs(posterior, last, elapsed, measured, R_WB, model, pad_position, pad_foot, leg_places, origin)
    w_W = rotate(R_WB, w_B)
    covariance_at, innovation_at, variance_at, rate_at = further + 3, further + 9, further + 15, further + 17
    x = ContactAidedEstimate(
        vector_at(posterior, base_position),
        vector_at(posterior, base_position + 3),
        vector_at(posterior, further),
        ContactAidedCovariance(
            last[covariance_at],
            last[covariance_at + 1],
            last[covariance_at + 2],
            last[covariance_at + 3],
            last[covariance_at + 4],
            last[covariance_at + 5],
        ),
    )
    if math.isnan(elapsed):
        P_first = ContactAidedCovariance(position_noise**2, 0.0, 0.0, velocity_noise**2, 0.0, acceleration_error**2)
        x = ContactAidedEstimate(x.position, x.velocity, x.acceleration_error, P_first)
    else:
        acceleration, noise = (0.0, 0.0, 0.0), _UNKNOWN_ACCELERATION
        if measured[imu_trust] == 0:
            w_dot = scale(1.0 / elapsed, rotate_back(R_WB, subtract(w_W, vector_at(last, rate_at))))
            force = base_specific_force(vector_at(measured, specific_force), w_B, w_dot, R_BI, p_BI)
            acceleration = subtract(add(rotate(R_WB, force), gravity), x.acceleration_error)
            noise = acceleration_noise
        x = predict_contact_aided(x, acceleration, noise, acceleration_error, acceleration_error_time, elapsed)
        if legs.stands:
            P, innovation = x.covariance, subtract(legs.position, x.position)
            S = P.pp + position_noise**2
            x = update_contact_aided(x, innovation, (P.pp, P.pv, P.pa), S)
            put(posterior, innovation_at, innovation)
            posterior[variance_at] = S
            P, innovation = x.covariance, subtract(legs.velocity, x.velocity)
            S = P.vv + velocity_noise**2
            x = update_contact_aided(x, innovation, (P.pv, P.vv, P.va), S)
            put(posterior, innovation_at + 3, innovation)
            posterior[variance_at + 1] = S
    end = put(posterior, base_position, x.position)
    end = put(posterior, end, x.velocity)
    # Posture and leg motion take the base to the centre of mass.
    end = put(posterior, end, add(x.position, rotate(R_WB, vector_at(model, com))))
    put(posterior, end, add(x.velocity, rotate(R_WB, vector_at(model, com + 3))))
    put(posterior, further, x.acceleration_error)
    put(posterior, covariance_at, x.covariance)
    put(posterior, rate_at, w_W)


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

    Further fields: `acceleration_error` (3,) of the IMU in world axes [m/s^2]; `covariance` (6,), see `ContactAidedCovariance`;
    `innovation` (6,) of position and velocity [m, m/s] and `innovation_variance` (2,) per axis; `rate` (3,) of the last tick.
    """

    def __init__(
        self,
        config: ContactAided,
        robot: Robot,
        measurements: dict[str, slice],
        attitude: dict[str, slice],
        model: dict[str, slice],
        clock: Clock,
        origin: tuple[float, float],
    ):
        further = {"acceleration_error": 3, "covariance": 6, "innovation": 6, "innovation_variance": 2, "rate": 3}
        super().__init__(robot, measurements, attitude, model, clock, origin, further)
        self._places = np.array(
            [
                measurements["trust"].start + 1,
                *starts(measurements, "specific_force"),
                *starts(attitude, "rotation", "angular_velocity"),
                *starts(model, "com"),
                *starts(self.fields.slices, "base_position", "acceleration_error"),
            ]
        )
        self._frames = np.concatenate([self._origin, self._mount.R_BI.ravel(), self._mount.p_BI, self._gravity])
        self._config = np.array(astuple(config), dtype=float)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        _estimate_base_state(
            posterior,
            last,
            elapsed,
            self._measurements.Eval(context),
            self._attitude.Eval(context),
            self._model.Eval(context),
            self._pads.position,
            self._pads.foot,
            self._leg_places,
            self._places,
            self._frames,
            self._config,
        )
