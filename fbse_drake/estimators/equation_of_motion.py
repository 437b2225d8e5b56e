"""Rows of the whole robot's equation of motion, seen from its IMU.

They are those of the base's turning and of the joints. The accelerometer says how the IMU
accelerates, so the base's linear rows are not needed; moments are about the IMU.
"""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.believed_torque import believed_torque_type
from fbse_drake.estimators.records import Record, record_type
from fbse_drake.estimators.spatial import (
    Vector,
    add,
    cross,
    dot,
    norm,
    put,
    rotate,
    rotation,
    scale,
    skew,
    subtract,
    vector,
)
from fbse_drake.robot.plant import Robot

# A wrench, or the force on a pad, is beyond its sensors' noise above these quantiles of chi^2 with
# six and three degrees of freedom (one in 3000).
_WRENCH_GATE, _PAD_GATE = 25.1, 18.5
# Over which time the force on a pad is averaged, to see what a tick's noise hides [s].
_CONTACT_TIME = 0.005


def motion_type(robot: Robot) -> np.dtype:
    """What is known of a tick but for its forces, with r = 3 + n rows.

    `duration` () [s]; `known` (), 1 where all was known; `reading` (r,) of gyro and encoders
    [rad/s]; of inertia a = push + what feet push - friction, with a the base's angular acceleration
    and those of the joints, `inertia` (r, r), `push` (r,), its part `of_linear` (r, 3) in the IMU's
    acceleration, and the `lever` (feet, 6, r) of the wrenches on the soles; and how soles turn
    about their normals without accelerations, `turning` (feet,) [rad/s^2]; and what the model's own
    effects take of the joints' torques, `believed`, see `believed_torque_type`. Along `up` (3,),
    against gravity in the base's axes, `up_of_sole` (feet, 3) in the soles', all feet together push
    with `weight` () [N] and what accelerations add to it.
    """
    r, feet = 3 + len(robot.joint_names), len(robot.description.legs)
    return record_type(
        duration=(),
        known=(),
        reading=(r,),
        inertia=(r, r),
        of_linear=(r, 3),
        push=(r,),
        lever=(feet, 6, r),
        turning=(feet,),
        up=(3,),
        up_of_sole=(feet, 3),
        weight=(),
        believed=believed_torque_type(r - 3),
    )


@njit(cache=True)
def put_equation_of_motion(
    now: Record,
    measured: Record,
    model: Record,
    attitude: Record,
    torque_command: np.ndarray,
    known: Record,
) -> None:
    """Fills the equation of motion of a tick.

    What the accelerometer says is no function of the unknown angular acceleration, for the base's
    acceleration is taken at the IMU.

    Args:
        now: of `motion_type`.
        torque_command: where the tick began, (n,) [Nm].
        known: record with the IMU's `mount` and `has_pads` (feet,).
    """
    R_BI, p = rotation(known.mount.R_BI), vector(known.mount.p_BI)
    # a_B = a_I - w_dot x p - w x (w x p), of the IMU's origin I seen from the base's.
    w = vector(model.velocity)
    force = subtract(vector(measured.mean.specific_force), vector(attitude.acceleration_bias))
    linear = subtract(rotate(R_BI, force), cross(w, cross(w, p)))
    base, joints, base_bias = model.base_inertia, model.mass_matrix, model.base_bias
    A, of_linear, push = now.inertia, now.of_linear, now.push
    r, bias = len(push), _about(base_bias, p)
    for j in range(3):
        column, of_acceleration = _about(base[:, j], p), _about(base[:, 3 + j], p)
        for i in range(3):
            A[i, j], of_linear[i, j] = column[i], of_acceleration[i]
        push[j] = -bias[j]
    for i in range(3, r):
        push[i] = torque_command[i - 3] - model.bias[i - 3]
        for j in range(3):
            A[i, j], of_linear[i, j] = joints[i - 3, j], joints[i - 3, 3 + j]
        for j in range(3, r):
            A[i, j] = joints[i - 3, 3 + j]
    for i in range(r):
        factor = vector(of_linear[i])
        push[i] -= dot(factor, linear)
        _move(A[i], factor, p)
    for i in range(3):
        for j in range(3, r):
            A[i, j] = A[j, i]
    up = scale(1.0 / max(norm(force), 1e-9), rotate(R_BI, force))
    put(now.up, up)
    now.weight = base[3, 3] * dot(up, linear) + dot(up, vector(base_bias[3:]))
    for foot in range(len(known.has_pads)):
        J, lever = model.foot_jacobian[foot], now.lever[foot]
        for i in range(6):
            for j in range(r):
                lever[i, j] = J[i, j if j < 3 else 3 + j]
            _move(lever[i], vector(J[i, 3:6]), p)
        for i in range(3):
            now.up_of_sole[foot, i] = dot(vector(J[3 + i, 3:6]), up)
        now.turning[foot] = model.foot_bias[foot, 2]


@njit(cache=True)
def _about(wrench: np.ndarray, p: Vector) -> Vector:
    """Moment of a wrench [moment, force], (6,), about a point."""
    return add(vector(wrench[:3]), cross(vector(wrench[3:]), p))


@njit(cache=True)
def _move(row: np.ndarray, of_linear: Vector, p: Vector) -> None:
    """A row that counts the base's angular acceleration first gets what its linear one adds.

    The base's linear acceleration is -w_dot x p, where the point p does not accelerate.
    """
    moved = cross(of_linear, p)
    for i in range(3):
        row[i] += moved[i]


@njit(cache=True)
def touching(
    mean: np.ndarray, pad_force: np.ndarray, elapsed: float, force_noise: np.ndarray, known: Record
) -> np.ndarray:
    """Does a pad touch the ground? It does if its force shows more than noise, now or on average.

    Noise that is taken for a force shakes the leg, and a force that is taken for noise is missed.

    Args:
        mean: of late, (P, 3) [N]; goes on to this tick.
        pad_force: (P, 3) [N]; elapsed: since the last [s].
        force_noise, known: see `put_push`.

    Returns:
        For each pad, (P,).
    """
    result, share = np.zeros(len(mean), dtype=np.bool_), 1.0 - math.exp(-elapsed / _CONTACT_TIME)
    for pad in range(len(mean)):
        force, before = vector(pad_force[pad]), vector(mean[pad])
        late = add(before, scale(share, subtract(force, before)))
        put(mean[pad], late)
        gate = _PAD_GATE * force_noise[known.pads.foot[pad]] * known.sensors.force_noise**2
        # The variance of an exponential mean of white noise.
        gate_of_mean = share / (2.0 - share) * gate
        touches = 0.0 < gate < dot(force, force)
        result[pad] = touches or 0.0 < gate_of_mean < dot(late, late)
    return result


@njit(cache=True)
def put_push(
    push: np.ndarray,
    variance: np.ndarray,
    of_tick: Record,
    pad_force: np.ndarray,
    pad_touches: np.ndarray,
    wrench: np.ndarray,
    force_noise: np.ndarray,
    acceleration_noise: float,
    force_gain: np.ndarray,
    known: Record,
) -> None:
    """Fills the push (r,) in an equation of motion, feet included, and its variance (r, r).

    A foot that shows no more than its sensors' noise touches nothing.

    Args:
        of_tick: see `motion_type`.
        pad_force: (P, 3) [N]; wrench: on each sole, (feet, 6) [Nm, N].
        pad_touches: see `touching`, (P,).
        force_noise, acceleration_noise: by how much the variance of each foot's forces, and of the
            accelerometer, is larger than believed.
        force_gain: by what share forces are larger than they are read, (feet,).
        known: see `put_equation_of_motion`; and the beliefs of the `sensors`, the `wrench_variance`
            (feet, 6) of each foot, and `pads`, see `FootPads`.
    """
    r, noise = len(push), acceleration_noise * known.sensors.acceleration_noise**2
    for i in range(r):
        push[i], factor = of_tick.push[i], vector(of_tick.of_linear[i])
        for j in range(r):
            variance[i, j] = noise * dot(factor, vector(of_tick.of_linear[j]))
    for foot in range(len(known.has_pads)):
        if known.has_pads[foot]:
            of_foot, of_noise = _pad_wrench(pad_force, pad_touches, foot, force_noise[foot], known)
        else:
            diagonal = force_noise[foot] * known.wrench_variance[foot]
            touches = _pushes(wrench[foot], diagonal)
            of_foot, of_noise = wrench[foot].copy(), np.diag(diagonal)
            if not touches:
                continue
        lever = of_tick.lever[foot]
        by_noise = of_noise @ lever
        for k in range(6):
            for i in range(r):
                push[i] += (1.0 + force_gain[foot]) * lever[k, i] * of_foot[k]
                for j in range(r):
                    variance[i, j] += lever[k, i] * by_noise[k, j]


@njit(cache=True)
def _pushes(wrench: np.ndarray, variance: np.ndarray) -> bool:
    """Does a foot show more than its sensor's noise? What touches nothing has no force."""
    distance = 0.0
    for i in range(len(wrench)):
        # A point foot has no moment.
        if variance[i] > 0.0:
            distance += wrench[i] ** 2 / variance[i]
    return distance > _WRENCH_GATE


@njit(cache=True)
def _pad_wrench(
    force: np.ndarray, touches: np.ndarray, foot: int, excess: float, known: Record
) -> tuple[np.ndarray, np.ndarray]:
    """Wrench of a foot's pads that touch the ground, (6,) on the sole, and its variance (6, 6).

    Args:
        force: of all pads, (P, 3) [N]; touches: see `touching`.
        excess: by how much the variance of the forces is larger than believed.
    """
    pads, of_force = known.pads, np.full(3, excess * known.sensors.force_noise**2)
    wrench, variance, arm = np.zeros(6), np.zeros((6, 6)), np.empty((3, 3))
    for pad in range(len(force)):
        if pads.foot[pad] == foot and touches[pad]:
            # A force f at p has the moment p x f.
            put(arm, skew(vector(pads.position[pad])))
            for i in range(3):
                wrench[3 + i] += force[pad, i]
                variance[3 + i, 3 + i] += of_force[0]
                for k in range(3):
                    wrench[i] += arm[i, k] * force[pad, k]
                    variance[i, 3 + k] += of_force[0] * arm[i, k]
                    variance[3 + k, i] += of_force[0] * arm[i, k]
                    for j in range(3):
                        variance[i, k] += of_force[0] * arm[i, j] * arm[k, j]
    return wrench, variance
