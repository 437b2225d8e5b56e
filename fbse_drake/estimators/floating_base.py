"""The equation of motion of the model, seen from its base.

The base stands at the world's origin, upright and without linear velocity, and gravity enters as the specific force that the IMU
measures. The joint rows of the equation of motion stay the same: they change neither with the attitude and the place of the whole robot nor
with a constant velocity added to it (Galilean invariance). So neither an error of the estimated attitude nor one of the estimated base
velocity can spoil the link torque.
"""

import math

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, starts
from fbse_drake.estimators.spatial import Rotation, Vector, add, cross, dot, put, rotate, rotation_at, scale, vector_at
from fbse_drake.robot.plant import Robot

_ORIGIN = np.zeros(3)


class ImuMount:
    """Where the IMU sits: takes its readings to the base frame B."""

    def __init__(self, robot: Robot):
        X_BI = robot.imu.CalcPose(robot.plant.CreateDefaultContext(), robot.base.body_frame())
        # Rotation (3, 3) and lever arm (3,) [m].
        self.R_BI, self.p_BI = X_BI.rotation().matrix(), X_BI.translation()


@njit(cache=True)
def base_specific_force(specific_force: Vector, w: Vector, w_dot: Vector, R_BI: Rotation, p_BI: Vector) -> Vector:
    """Specific force of the base's origin in base axes [m/s^2].

    Args:
        specific_force: of the IMU, in its axes [m/s^2].
        w, w_dot: angular velocity and acceleration of the base in base axes [rad/s, rad/s^2].
        R_BI, p_BI: see `ImuMount`.
    """
    # Minus w_dot x p minus w x (w x p), with w x (w x p) = (p.w) w - (w.w) p.
    turning = add(scale(-dot(p_BI, w), w), scale(dot(w, w), p_BI))
    return add(add(rotate(R_BI, specific_force), cross(p_BI, w_dot)), turning)


@njit(cache=True)
def _plant_state(
    state: np.ndarray, measured: np.ndarray, q_index: np.ndarray, v_index: np.ndarray, places: np.ndarray, R_BI: np.ndarray
) -> bool:
    """Puts joint angles and velocities and the base's angular velocity into a plant's state, in place; says whether all are finite.

    Args:
        state: [positions, velocities] of the plant.
        q_index: place of each joint's angle in it, shape (n,).
        v_index: place of each of our velocities [base angular, base linear, joints] in it, shape (6 + n,).
        places: of what is read, see the first line.
        R_BI: rotation of the IMU, shape (9,).
    """
    joint_position, joint_velocity, angular_velocity = to_fixed_tuple(places, 3)
    w = rotate(rotation_at(R_BI, 0), vector_at(measured, angular_velocity))
    for i in range(3):
        state[v_index[i]] = w[i]
    for i in range(len(q_index)):
        state[q_index[i]], state[v_index[6 + i]] = measured[joint_position + i], measured[joint_velocity + i]
    return np.isfinite(state).all()


@njit(cache=True)
def _put_terms(
    posterior: np.ndarray,
    state: np.ndarray,
    M: np.ndarray,
    bias: np.ndarray,
    feet: tuple[tuple[np.ndarray, np.ndarray], ...],
    order: np.ndarray,
    v_index: np.ndarray,
    places: np.ndarray,
) -> None:
    """Fills a posterior of `FloatingBaseModel` from what Drake says of the plant.

    Args:
        state: [positions, velocities] of the plant.
        M, bias: mass matrix and bias of the whole plant, in its order of velocities.
        feet: Jacobian (6, velocities of the plant) and bias acceleration (6,) of each sole.
        order: place of each of our velocities in the plant's, shape (6 + n,); v_index: in its state.
        places: of the fields, see the first line.
    """
    mass_matrix, bias_at, com, com_velocity, velocity, foot_jacobian, foot_bias, foot_position, foot_rotation = to_fixed_tuple(places, 9)
    v, posterior[STATUS] = len(order), 0.0
    for i in range(v):
        posterior[velocity + i] = state[v_index[i]]
    for i in range(6, v):
        row = mass_matrix + (i - 6) * v
        for j in range(v):
            posterior[row + j] = M[order[i], order[j]]
        posterior[bias_at + i - 6] = bias[order[i]]
    # The base's block of H is [[I, m [c]x], [-m [c]x, m]], for the base stands upright.
    x, y, z, mass = order[0], order[1], order[2], M[order[3], order[3]]
    put(posterior, com, (M[z, order[4]] / mass, M[x, order[5]] / mass, M[y, order[3]] / mass))
    # Its rows of linear velocity give the momentum.
    for i in range(3):
        posterior[com_velocity + i] = 0.0
        for j in range(v):
            posterior[com_velocity + i] += M[order[3 + i], order[j]] * posterior[velocity + j] / mass
    for foot in range(len(feet)):
        J, acceleration = feet[foot]
        for i in range(6):
            row = foot_jacobian + (6 * foot + i) * v
            for j in range(v):
                posterior[row + j] = J[i, order[j]]
            posterior[foot_bias + 6 * foot + i] = acceleration[i]
        # The base's columns of J hold the foot's pose: in the rows of linear velocity they are [-R_FB [p_BF]x, R_FB].
        R_BF = posterior[foot_rotation + 9 * foot : foot_rotation + 9 * foot + 9].reshape(3, 3)
        for i in range(3):
            for j in range(3):
                R_BF[j, i] = J[3 + i, order[3 + j]]
        p = posterior[foot_position + 3 * foot :]
        p[0] = p[1] = p[2] = 0.0
        for k in range(3):
            p[0] -= R_BF[2, k] * J[3 + k, y]
            p[1] -= R_BF[0, k] * J[3 + k, z]
            p[2] -= R_BF[1, k] * J[3 + k, x]


class FloatingBaseModel(RecursiveEstimator):
    """Mass matrix, bias and Jacobians of the model in the measured posture, from Drake.

    .. pydrake_system::

        name: FloatingBaseModel
        input_ports:
        - measurements
        output_ports:
        - posterior
        - at_step_start

    `measurements` is the posterior of a `SensorMonitor`. `posterior` belongs to the present tick; `at_step_start` to the tick before, where
    the step began whose accelerations and forces are measured now. Velocities are ordered [base angular (3), base linear (3), joints (n)]
    whatever the plant's order. Fields, for n joints, v = 6 + n velocities and f feet, all in base axes but those of a foot, which are in
    its sole frame F:

        mass_matrix     (n, v)     joint rows of H [kg m^2, kg m]
        bias            (n,)       joint rows of C v [Nm]
        foot_jacobian   (f, 6, v)  J_m: spatial velocity [angular, linear] of each sole in F
        foot_bias       (f, 6)     J_m_dot v [rad/s^2, m/s^2]
        foot_position   (f, 3)     p_BF_B [m]
        foot_rotation   (f, 3, 3)  R_BF
        com             (3,)       p_BC_B, of the centre of mass [m]; minus c_offset of the paper
        com_velocity    (3,)       of the centre of mass while the base's origin rests [m/s]
        velocity        (v,)       [angular velocity, 0, joint velocities]
    """

    def __init__(self, robot: Robot, measurements: dict[str, slice], clock: Clock):
        n, f = len(robot.joint_names), len(robot.description.sides)
        v = 6 + n
        super().__init__(
            {
                "status": 1,
                "mass_matrix": n * v,
                "bias": n,
                "foot_jacobian": f * 6 * v,
                "foot_bias": f * 6,
                "foot_position": f * 3,
                "foot_rotation": f * 9,
                "com": 3,
                "com_velocity": 3,
                "velocity": v,
            },
            clock,
        )
        self._plant, self._plant_context = robot.plant, robot.plant.CreateDefaultContext()
        self._world, self._soles = robot.plant.world_frame(), [robot.sole(side) for side in robot.description.sides]
        self._R_BI = ImuMount(robot).R_BI.flatten()
        # Place in the plant's velocities, and in its state, of each of ours.
        base = robot.base.floating_velocities_start_in_v()
        self._order = np.concatenate([np.arange(base, base + 6), robot.velocity_index])
        self._q_index, self._v_index = robot.position_index, robot.plant.num_positions() + self._order
        self._state = np.concatenate([robot.base_pose_positions(RigidTransform()), np.zeros(robot.plant.num_velocities())])
        self._measured_places = np.array(starts(measurements, "joint_position", "joint_velocity", "angular_velocity"))
        feet = ("foot_jacobian", "foot_bias", "foot_position", "foot_rotation")
        self._places = np.array(starts(self.fields.slices, "mass_matrix", "bias", "com", "com_velocity", "velocity", *feet))
        self._measurements = self.DeclareVectorInputPort("measurements", max(part.stop for part in measurements.values()))
        self._declare_posterior("measurements")
        self.DeclareStateOutputPort("at_step_start", self._last)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:  # noqa: ARG002
        plant, now, state, order = self._plant, self._plant_context, self._state, self._order
        measured = self._measurements.Eval(context)
        if not _plant_state(state, measured, self._q_index, self._v_index, self._measured_places, self._R_BI):
            posterior.fill(math.nan)  # Drake would refuse it.
            return
        plant.SetPositionsAndVelocities(now, state)
        world, wrt = self._world, JacobianWrtVariable.kV
        feet = tuple(
            [
                (
                    plant.CalcJacobianSpatialVelocity(now, wrt, sole, _ORIGIN, world, sole),
                    plant.CalcBiasSpatialAcceleration(now, wrt, sole, _ORIGIN, world, sole).get_coeffs(),
                )
                for sole in self._soles
            ]
        )
        M, bias = plant.CalcMassMatrix(now), plant.CalcBiasTerm(now)
        _put_terms(posterior, state, M, bias, feet, order, self._v_index, self._places)
