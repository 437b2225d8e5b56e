"""The equation of motion of the model, seen from its base.

The base stands at the world's origin, upright and without linear velocity, and gravity enters as
the specific force that the IMU measures. The joint rows of the equation of motion stay the same:
they change neither with the attitude and the place of the whole robot nor with a constant velocity
added to it (Galilean invariance). So neither an error of the estimated attitude nor one of the
estimated base velocity can spoil the link torque.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, ValueProducer

from fbse_drake.estimators.records import as_record, record, record_type, size_of
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, start_share
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.estimators.spatial import (
    Rotation,
    Vector,
    add,
    cross,
    dot,
    put,
    rotate,
    rotation,
    scale,
    subtract,
    vector,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.wiring import weakly

_ORIGIN = np.zeros(3)


class ImuMount:
    """Where the IMU sits: takes its readings to the base frame B."""

    def __init__(self, robot: Robot):
        X_BI = robot.imu.CalcPose(robot.plant.CreateDefaultContext(), robot.base.body_frame())
        # Rotation (3, 3) and lever arm (3,) [m].
        self.R_BI, self.p_BI = X_BI.rotation().matrix(), X_BI.translation()


@njit(cache=True)
def base_specific_force(
    specific_force: Vector, w: Vector, w_dot: Vector, R_BI: Rotation, p_BI: Vector
) -> Vector:
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
    state: np.ndarray, measured: np.ndarray, rate_bias: np.ndarray, known: np.ndarray
) -> bool:
    """Puts the measured motion into a plant's state, in place; says whether all of it is finite.

    Args:
        state: [positions, velocities] of the plant; joint angles and velocities and the base's
            angular velocity are written.
        rate_bias: of the gyro, (3,) [rad/s].
        known: record with `q_index` (n,) and `v_index` (6 + n,), places in the state of each
            joint's angle and each of our velocities [base angular, base linear, joints], and
            `mount`, see `ImuMount`.
    """
    measured, known = measured[()], known[()]
    w_I = subtract(vector(measured.angular_velocity), vector(rate_bias))
    w = rotate(rotation(known.mount.R_BI), w_I)
    for i in range(3):
        state[known.v_index[i]] = w[i]
    for i in range(len(known.q_index)):
        state[known.q_index[i]] = measured.joint_position[i]
        state[known.v_index[6 + i]] = measured.joint_velocity[i]
    return np.isfinite(state).all()


@njit(cache=True)
def _put_terms(
    posterior: np.ndarray,
    state: np.ndarray,
    M: np.ndarray,
    bias: np.ndarray,
    feet: tuple[tuple[np.ndarray, np.ndarray], ...],
    known: np.ndarray,
) -> None:
    """Fills a posterior of `FloatingBaseModel` from what Drake says of the plant.

    Args:
        state: [positions, velocities] of the plant.
        M, bias: mass matrix and bias of the whole plant, in its order of velocities.
        feet: Jacobian (6, velocities of the plant) and bias acceleration (6,) of each sole.
        known: see `_plant_state`; and `order` (6 + n,), place of each of our velocities in the
            plant's.
    """
    posterior, known = posterior[()], known[()]
    order, velocity = known.order, posterior.velocity
    v, posterior.status = len(order), 0.0
    for i in range(v):
        velocity[i] = state[known.v_index[i]]
    for i in range(6, v):
        for j in range(v):
            posterior.mass_matrix[i - 6, j] = M[order[i], order[j]]
        posterior.bias[i - 6] = bias[order[i]]
    for i in range(6):
        for j in range(6):
            posterior.base_inertia[i, j] = M[order[i], order[j]]
        posterior.base_bias[i] = bias[order[i]]
    # The base's block of H is [[I, m [c]x], [-m [c]x, m]], for the base stands upright.
    x, y, z, mass = order[0], order[1], order[2], M[order[3], order[3]]
    put(posterior.com, (M[z, order[4]] / mass, M[x, order[5]] / mass, M[y, order[3]] / mass))
    # Its rows of linear velocity give the momentum.
    for i in range(3):
        posterior.com_velocity[i] = 0.0
        for j in range(v):
            posterior.com_velocity[i] += M[order[3 + i], order[j]] * velocity[j] / mass
    for foot in range(len(feet)):
        J, acceleration = feet[foot]
        for i in range(6):
            for j in range(v):
                posterior.foot_jacobian[foot, i, j] = J[i, order[j]]
            posterior.foot_bias[foot, i] = acceleration[i]
        # The base's columns of J hold the foot's pose: in the rows of linear velocity they are
        # [-R_FB [p_BF]x, R_FB].
        R_BF, p = posterior.foot_rotation[foot], posterior.foot_position[foot]
        for i in range(3):
            for j in range(3):
                R_BF[j, i] = J[3 + i, order[3 + j]]
        p[0] = p[1] = p[2] = 0.0
        for k in range(3):
            p[0] -= R_BF[2, k] * J[3 + k, y]
            p[1] -= R_BF[0, k] * J[3 + k, z]
            p[2] -= R_BF[1, k] * J[3 + k, x]


def model_type(robot: Robot) -> np.dtype:
    """Type of the posterior of `FloatingBaseModel`."""
    n, f = len(robot.joint_names), len(robot.description.sides)
    v = 6 + n
    return record_type(
        time=(),
        status=(),
        mass_matrix=(n, v),
        bias=(n,),
        base_inertia=(6, 6),
        base_bias=(6,),
        foot_jacobian=(f, 6, v),
        foot_bias=(f, 6),
        foot_position=(f, 3),
        foot_rotation=(f, 3, 3),
        com=(3,),
        com_velocity=(3,),
        velocity=(v,),
    )


@dataclass(frozen=True)
class _Workspace:
    """Where a tick asks Drake: memory of a context's own, in which nothing lasts but the base."""

    plant_context: Context
    # [positions, velocities] of the plant.
    state: np.ndarray


class FloatingBaseModel(RecursiveEstimator):
    """Mass matrix, bias and Jacobians of the model in the measured posture, from Drake.

    .. pydrake_system::

        name: FloatingBaseModel
        input_ports:
        - measurements
        - angular_velocity_bias
        output_ports:
        - posterior
        - (one for each field)
        - at_step_start
        - over_step

    `measurements` is the posterior of a `SensorMonitor`. `angular_velocity_bias` (3,) [rad/s] of
    the gyro, as it was known a tick ago, is there where somebody estimates it. `posterior` belongs
    to the present tick; `at_step_start` to the tick before, where the step began whose
    accelerations and forces are measured now; `over_step` is the mean of both, as far as these are,
    see `start_share`, with the velocities of the start. Velocities are ordered [base angular (3),
    base linear (3), joints (n)] whatever the plant's order. Fields, for n joints, v = 6 + n
    velocities and f feet, all in base axes but those of a foot, which are in its sole frame F:

        mass_matrix     (n, v)     joint rows of H [kg m^2, kg m]
        bias            (n,)       joint rows of C v [Nm]
        base_inertia    (6, 6)     the base's block of H [kg m^2, kg m, kg]
        base_bias       (6,)       the base's rows of C v [Nm, N]
        foot_jacobian   (f, 6, v)  J_m: spatial velocity [angular, linear] of each sole in F
        foot_bias       (f, 6)     J_m_dot v [rad/s^2, m/s^2]
        foot_position   (f, 3)     p_BF_B [m]
        foot_rotation   (f, 3, 3)  R_BF
        com             (3,)       p_BC_B, of the centre of mass [m]; minus c_offset of the paper
        com_velocity    (3,)       of the centre of mass while the base's origin rests [m/s]
        velocity        (v,)       [angular velocity, 0, joint velocities]
    """

    def __init__(
        self, robot: Robot, measurements: np.dtype, clock: Clock, *, knows_bias: bool = False
    ):
        """Declares ports and state.

        Args:
            measurements: type of the input's posterior.
            knows_bias: has an input `angular_velocity_bias`.
        """
        super().__init__(model_type(robot), clock)
        self._robot, self._plant, self._world = robot, robot.plant, robot.plant.world_frame()
        self._soles = [robot.sole(side) for side in robot.description.sides]
        # Place in the plant's velocities, and in its state, of each of ours.
        base = robot.base.floating_velocities_start_in_v()
        order = np.concatenate([np.arange(base, base + 6), robot.velocity_index])
        self._known = record(
            mount=record(**vars(ImuMount(robot))),
            order=order,
            q_index=robot.position_index,
            v_index=robot.plant.num_positions() + order,
        )
        self._measurements = self._declare_record_input("measurements", measurements)
        self._bias = None
        if knows_bias:
            self._bias = self.DeclareVectorInputPort("angular_velocity_bias", 3)
        # Never computed anew: an entry of the cache is what a context can keep for itself.
        self._workspace = self.DeclareCacheEntry(
            "workspace",
            ValueProducer(weakly(self._allocate_workspace), ValueProducer.NoopCalc),
            {self.nothing_ticket()},
        )
        self._declare_posterior()
        self.DeclareStateOutputPort("at_step_start", self._last)
        size, self._reading = size_of(self.posterior_type), clock.reading
        self.DeclareVectorOutputPort(
            "over_step", size, weakly(self._calc_over_step), self._tickets()
        )

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        return {"measurements": measurements_type(robot)}

    def _calc_over_step(self, context: Context, output: BasicVector) -> None:
        start = context.get_discrete_state().value(0)
        share = start_share(context.get_time() - start.item(0), self._reading)
        if share == 0.0:
            output.SetFromVector(start)
            return
        output.SetFromVector(start + share * (self._posterior.Eval(context) - start))
        before, mean = (
            as_record(x, self.posterior_type) for x in (start, output.get_mutable_value())
        )
        mean["velocity"] = before["velocity"]

    def _allocate_workspace(self) -> AbstractValue:
        upright = self._robot.base_pose_positions(RigidTransform())
        state = np.concatenate([upright, np.zeros(self._plant.num_velocities())])
        return AbstractValue.Make(_Workspace(self._plant.CreateDefaultContext(), state))

    def _tick(
        self,
        context: Context,
        last: np.ndarray,  # noqa: ARG002
        elapsed: float,  # noqa: ARG002
        posterior: np.ndarray,
    ) -> None:
        workspace, measured = self._workspace.Eval(context), self._measurements.Eval(context)
        now, state = workspace.plant_context, workspace.state
        bias_rate = _ORIGIN if self._bias is None else self._bias.Eval(context)
        if not _plant_state(state, measured, bias_rate, self._known):
            posterior["velocity"] = math.nan  # Drake would refuse it; so it is not taken.
            return
        plant, world, wrt, origin = self._plant, self._world, JacobianWrtVariable.kV, _ORIGIN
        plant.SetPositionsAndVelocities(now, state)
        feet = tuple(
            [
                (
                    plant.CalcJacobianSpatialVelocity(now, wrt, sole, origin, world, sole),
                    plant.CalcBiasSpatialAcceleration(
                        now, wrt, sole, origin, world, sole
                    ).get_coeffs(),
                )
                for sole in self._soles
            ]
        )
        M, bias = plant.CalcMassMatrix(now), plant.CalcBiasTerm(now)
        _put_terms(posterior, state, M, bias, feet, self._known)
