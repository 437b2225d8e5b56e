"""Position and velocity of CoM and base: the paper's adaptive Kalman filter on the LIPM, and leg kinematics fused with the IMU."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.robot.plant import Robot, grasp_map


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
        for name in ("process_noise", "measurement_noise", "covariance", "measurement_memory", "process_memory"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected a number > 0, found {getattr(self, name):g}")


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
        for name in ("acceleration_noise", "position_noise", "velocity_noise", "acceleration_error_time"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected a number > 0, found {getattr(self, name):g}")
        if self.acceleration_error < 0:
            raise InputError(f"acceleration_error: expected a number >= 0, found {self.acceleration_error:g}")


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


class BaseStateEstimator(RecursiveEstimator):
    """What both estimators of the base state share: feet that stand anchor the robot in the world.

    .. pydrake_system::

        name: BaseStateEstimator
        input_ports:
        - measurements
        - attitude
        - support
        - model
        output_ports:
        - posterior

    Inputs: posteriors of `SensorMonitor`, `AttitudeEstimator`, a support estimate (feet,) and `FloatingBaseModel`. Fields of the posterior:

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
        self._measured, self._attitude, self._model = measurements, attitude, model
        self._origin, self._mount = np.array([*origin, 0.0]), ImuMount(robot)
        self._gravity = robot.plant.gravity_field().gravity_vector()
        self._grasp = [grasp_map(robot.pad_positions(side)) for side in robot.description.sides]
        counts = np.cumsum([0, *(3 * len(leg.pads) for leg in robot.description.legs.values())])
        start = measurements["pad_force"].start
        self._pads = [slice(start + int(a), start + int(b)) for a, b in zip(counts, counts[1:], strict=False)]
        self._feet, self._velocities = feet, 6 + len(robot.joint_names)
        for name, parts in (("measurements", measurements), ("attitude", attitude), ("model", model)):
            self.DeclareVectorInputPort(name, max(part.stop for part in parts.values()))
        self.DeclareVectorInputPort("support", feet)
        self._ports = [self.GetInputPort(name) for name in ("measurements", "attitude", "model", "support")]
        self._declare_posterior("measurements", "attitude", "model", "support")

    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        measured, attitude, model, support = (port.Eval(context) for port in self._ports)
        trust = measured[self._measured["trust"]].tolist()
        fields = self.fields
        R_WB = attitude[self._attitude["rotation"]].reshape(3, 3)
        p_BF = model[self._model["foot_position"]].reshape(-1, 3) @ R_WB.T  # world axes from here on
        first = math.isnan(elapsed)
        posterior = last.copy()
        if first:
            # The soles' middle is where it is said to be.
            posterior[fields["base_position"]] = self._origin - p_BF.mean(axis=0)
        anchors = posterior[fields["anchors"]].reshape(-1, 3)
        standing = last[fields["standing"]]
        touchdown = (support > 0) & ~(standing > 0)
        if first or touchdown.any():
            landed = posterior[fields["base_position"]] + p_BF
            landed[:, 2] = 0.0
            fresh = np.ones(self._feet, dtype=bool) if first else touchdown
            anchors[fresh] = landed[fresh]
        posterior[fields["standing"]] = support
        posterior[0] = max(trust)
        # Leg kinematics of the feet that stand, weighted with their load.
        load, zmp, total = [], np.zeros(2), 0.0
        R_BF = model[self._model["foot_rotation"]].reshape(-1, 3, 3)
        for k in range(self._feet):
            moment_x, moment_y, _, _, _, vertical = (self._grasp[k] @ measured[self._pads[k]]).tolist()
            usable = support[k] > 0 and not trust[2 + k] and vertical > 1.0
            load.append(vertical if usable else 0.0)
            if usable:
                cop = R_WB @ (R_BF[k] @ np.array([-moment_y / vertical, moment_x / vertical, 0.0]))
                zmp += vertical * (anchors[k] + cop)[:2]
                total += vertical
        posterior[fields["zmp"]] = zmp / total if total > 0 else last[fields["zmp"]]
        stands = total > 0 and not trust[0]
        position = velocity = np.zeros(3)
        if stands:
            share = np.array(load) / total
            position = share @ (anchors - p_BF)
            J = model[self._model["foot_jacobian"]].reshape(self._feet, 6, self._velocities)
            v_F = J[:, 3:] @ model[self._model["velocity"]]
            velocity = -(R_WB @ (share[:, None] * (R_BF @ v_F[:, :, None])[:, :, 0]).sum(axis=0))
        offset = -(R_WB @ model[self._model["com"]])  # c_offset: from CoM to base
        w_W = R_WB @ attitude[self._attitude["angular_velocity"]]
        self._estimate(
            posterior,
            first=first,
            elapsed=elapsed,
            specific_force=None if trust[1] else measured[self._measured["specific_force"]],
            kinematics=(position, velocity) if stands else None,
            R_WB=R_WB,
            w_W=w_W,
            offset=offset,
        )
        return posterior

    @abstractmethod
    def _estimate(
        self,
        posterior: np.ndarray,
        *,
        first: bool,
        elapsed: float,
        specific_force: np.ndarray | None,
        kinematics: tuple[np.ndarray, np.ndarray] | None,
        R_WB: np.ndarray,
        w_W: np.ndarray,
        offset: np.ndarray,
    ) -> None:
        """Puts this tick's estimate into `posterior`.

        Args:
            specific_force: the IMU's, in its axes [m/s^2]; None while it is not trusted.
            kinematics: position and velocity of the base seen through the legs that stand; None when nothing stands.
            w_W: angular velocity in world axes [rad/s].
            offset: c_offset, from CoM to base in world axes [m].
        """


class AdaptiveLipmEstimator(BaseStateEstimator):
    """The paper's base states observer (Sec. 4): x and y from the adaptive Kalman filter on the LIPM, z from the legs.

    .. pydrake_system::

        name: AdaptiveLipmEstimator
        input_ports:
        - measurements
        - attitude
        - support
        - model
        output_ports:
        - posterior

    Further fields, per horizontal axis: `state` (3,) CoM position, velocity, acceleration; `covariance` (3, 3); `process_noise` (3,),
    `measurement_noise`, `mean_residual`, `mean_correction` (3,); `innovation` and `innovation_variance`; and `rate` (3,) and
    `imu_acceleration` (3,) of the last tick.
    """

    def __init__(self, config: AdaptiveLipm, *shared: object):
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
        super().__init__(*shared, further)  # type: ignore[arg-type]
        self._config = config

    def _estimate(
        self,
        posterior: np.ndarray,
        *,
        first: bool,
        elapsed: float,
        specific_force: np.ndarray | None,
        kinematics: tuple[np.ndarray, np.ndarray] | None,
        R_WB: np.ndarray,
        w_W: np.ndarray,
        offset: np.ndarray,
    ) -> None:
        fields, config = self.fields, self._config
        w_dot = np.zeros(3) if first else (w_W - posterior[fields["rate"]]) / elapsed
        # From the IMU to the CoM: minus the sum of (16), whose sign is wrong in print.
        arm = -(R_WB @ self._mount.p_BI + offset)
        acceleration = posterior[fields["imu_acceleration"]].copy()
        if specific_force is not None:
            acceleration = R_WB @ (self._mount.R_BI @ specific_force) + self._gravity
            acceleration += np.cross(w_dot, arm) + np.cross(w_W, np.cross(w_W, arm))  # (16)
        change = np.zeros(3) if first else acceleration - posterior[fields["imu_acceleration"]]
        posterior[fields["rate"]], posterior[fields["imu_acceleration"]] = w_W, acceleration
        base_z, velocity_z = posterior[fields["base_position"]][2], posterior[fields["base_velocity"]][2]
        if kinematics is not None:
            base_z, velocity_z = kinematics[0][2], kinematics[1][2]
        height = base_z - offset[2]
        parts = {name: posterior[fields[name]].reshape(2, -1) for name in ("state", "covariance", "process_noise", "mean_correction")}
        for axis in range(2):
            if first:
                parts["state"][axis] = [posterior[fields["base_position"]][axis] - offset[axis], 0.0, acceleration[axis]]
                parts["covariance"][axis] = config.covariance * np.eye(3).ravel()
                parts["process_noise"][axis] = config.process_noise
                posterior[fields["measurement_noise"]][axis] = config.measurement_noise
                continue
            if kinematics is None:
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
            new = update_lipm(config, last, float(change[axis]), zmp, height, -float(self._gravity[2]), elapsed)
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


@dataclass(frozen=True)
class ContactAidedCovariance:
    """Covariance of position, velocity and acceleration error of the base, the same for all three axes."""

    pp: float
    pv: float
    pa: float
    vv: float
    va: float
    aa: float


class ContactAidedEstimator(BaseStateEstimator):
    """Base position and velocity from the IMU and the legs that stand.

    .. pydrake_system::

        name: ContactAidedEstimator
        input_ports:
        - measurements
        - attitude
        - support
        - model
        output_ports:
        - posterior

    Further fields: `acceleration_error` (3,) of the IMU in world axes [m/s^2]; `covariance` (6,), see `ContactAidedCovariance`; `innovation`
    (6,) of position and velocity [m, m/s] and `innovation_variance` (2,) per axis; `rate` (3,) of the last tick.
    """

    def __init__(self, config: ContactAided, *shared: object):
        further = {"acceleration_error": 3, "covariance": 6, "innovation": 6, "innovation_variance": 2, "rate": 3}
        super().__init__(*shared, further)  # type: ignore[arg-type]
        self._config = config

    def _estimate(
        self,
        posterior: np.ndarray,
        *,
        first: bool,
        elapsed: float,
        specific_force: np.ndarray | None,
        kinematics: tuple[np.ndarray, np.ndarray] | None,
        R_WB: np.ndarray,
        w_W: np.ndarray,
        offset: np.ndarray,
    ) -> None:
        fields, config = self.fields, self._config
        p, v = posterior[fields["base_position"]], posterior[fields["base_velocity"]]
        error, P = posterior[fields["acceleration_error"]], posterior[fields["covariance"]]
        if first:
            P[:] = [config.position_noise**2, 0.0, 0.0, config.velocity_noise**2, 0.0, config.acceleration_error**2]
        else:
            pp, pv, pa, vv, va, aa = P.tolist()
            acceleration, noise = np.zeros(3), _UNKNOWN_ACCELERATION
            if specific_force is not None:
                w_B = w_W @ R_WB
                w_dot = (w_W - posterior[fields["rate"]]) @ R_WB / elapsed
                acceleration = R_WB @ self._mount.base_specific_force(specific_force, w_B, w_dot) + self._gravity - error
                noise = config.acceleration_noise
            T = elapsed
            p += T * v + (0.5 * T * T) * acceleration
            v += T * acceleration
            fade = math.exp(-T / config.acceleration_error_time)
            error *= fade
            # Prediction of one axis: p' = p + T v, v' = v - T a, a' = fade a.
            pp, pv, pa = pp + T * (2 * pv + T * vv), pv + T * (vv - pa - T * va), fade * (pa + T * va)
            vv, va, aa = vv + T * (T * aa - 2 * va) + (T * noise) ** 2, fade * (va - T * aa), fade * fade * aa
            aa += (1 - fade * fade) * config.acceleration_error**2
            if kinematics is not None:
                innovation = posterior[fields["innovation"]]
                variance = posterior[fields["innovation_variance"]]
                S = pp + config.position_noise**2
                e = kinematics[0] - p
                innovation[:3], variance[0] = e, S
                kp, kv, ka = pp / S, pv / S, pa / S
                p += kp * e
                v += kv * e
                error += ka * e
                pp, pv, pa, vv, va, aa = pp - kp * pp, pv - kp * pv, pa - kp * pa, vv - kv * pv, va - kv * pa, aa - ka * pa
                S = vv + config.velocity_noise**2
                e = kinematics[1] - v
                innovation[3:], variance[1] = e, S
                kp, kv, ka = pv / S, vv / S, va / S
                p += kp * e
                v += kv * e
                error += ka * e
                pp, pv, pa, vv, va, aa = pp - kp * pv, pv - kp * vv, pa - kp * va, vv - kv * vv, va - kv * va, aa - ka * va
            P[:] = pp, pv, pa, vv, va, aa
        posterior[fields["rate"]] = w_W
        posterior[fields["com_position"]] = p - offset
        posterior[fields["com_velocity"]] = v - np.cross(w_W, offset)
