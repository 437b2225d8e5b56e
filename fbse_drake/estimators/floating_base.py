"""The equation of motion of the model, seen from its base.

The base stands at the world's origin, upright and without linear velocity, and gravity enters as the specific force that the IMU
measures. The joint rows of the equation of motion stay the same: they change neither with the attitude and the place of the whole robot nor
with a constant velocity added to it (Galilean invariance). So neither an error of the estimated attitude nor one of the estimated base
velocity can spoil the link torque.
"""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.robot.plant import Robot


class ImuMount:
    """Where the IMU sits: takes its readings to the base frame B."""

    def __init__(self, robot: Robot):
        X_BI = robot.imu.CalcPose(robot.plant.CreateDefaultContext(), robot.base.body_frame())
        # Rotation (3, 3) and lever arm (3,) [m].
        self.R_BI, self.p_BI = X_BI.rotation().matrix(), X_BI.translation()
        x, y, z = self.p_BI
        self._lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

    def base_specific_force(self, specific_force: np.ndarray, w: np.ndarray, w_dot: np.ndarray) -> np.ndarray:
        """Specific force of the base's origin in base axes, shape (3,) [m/s^2].

        Args:
            specific_force: of the IMU, in its axes (3,) [m/s^2].
            w, w_dot: angular velocity and acceleration of the base in base axes (3,) [rad/s, rad/s^2].
        """
        # w x (w x p) = (p.w) w - (w.w) p
        p = self.p_BI
        return self.R_BI @ specific_force + self._lever @ w_dot - (p @ w) * w + (w @ w) * p


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
    whatever the plant's order. Fields, for n joints, v = 6 + n velocities and f feet, all in base axes but those of a foot, which are in its
    sole frame F:

        mass_matrix     (n, v)     joint rows of H [kg m^2, kg m]
        bias            (n,)       joint rows of C v [Nm]
        foot_jacobian   (f, 6, v)  J_m: spatial velocity [angular, linear] of each sole in F
        foot_bias       (f, 6)     J_m_dot v [rad/s^2, m/s^2]
        foot_position   (f, 3)     p_BF_B [m]
        foot_rotation   (f, 3, 3)  R_BF
        com             (3,)       p_BC_B, of the centre of mass [m]; minus c_offset of the paper
        velocity        (v,)       [angular velocity, 0, joint velocities]
    """

    def __init__(self, robot: Robot, measurements: dict[str, slice], clock: Clock):
        n, f = len(robot.joint_names), len(robot.description.sides)
        v = 6 + n
        super().__init__(
            {
                "mass_matrix": n * v,
                "bias": n,
                "foot_jacobian": f * 6 * v,
                "foot_bias": f * 6,
                "foot_position": f * 3,
                "foot_rotation": f * 9,
                "com": 3,
                "velocity": v,
            },
            clock,
        )
        self._robot, self._soles = robot, [robot.sole(side) for side in robot.description.sides]
        self._R_BI = ImuMount(robot).R_BI
        base = robot.base.floating_velocities_start_in_v()
        # Place in the plant's velocities of each of ours; fancy indexing is saved where the orders agree.
        order = np.concatenate([np.arange(base, base + 6), robot.velocity_index])
        same = len(order) == robot.plant.num_velocities() and (order == np.arange(len(order))).all()
        self._order = slice(None) if same else order
        self._rows = slice(6, None) if same else np.ix_(robot.velocity_index, order)
        self._q = robot.base_pose_positions(RigidTransform())
        self._plant_context = robot.plant.CreateDefaultContext()
        self._inputs = measurements
        self._measurements = self.DeclareVectorInputPort("measurements", max(part.stop for part in measurements.values()))
        self._declare_posterior("measurements")
        self.DeclareStateOutputPort("at_step_start", self._last)

    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        measured, robot = self._measurements.Eval(context), self._robot
        plant, plant_context = robot.plant, self._plant_context
        q, velocity = self._q.copy(), np.zeros(6 + len(robot.joint_names))
        q[robot.position_index] = measured[self._inputs["joint_position"]]
        velocity[:3] = self._R_BI @ measured[self._inputs["angular_velocity"]]
        velocity[6:] = measured[self._inputs["joint_velocity"]]
        v = np.zeros(plant.num_velocities())
        v[self._order] = velocity
        plant.SetPositionsAndVelocities(plant_context, np.concatenate([q, v]))
        world, origin, sole_kinematics = plant.world_frame(), np.zeros(3), []
        X_WF = [sole.CalcPoseInWorld(plant_context) for sole in self._soles]
        for sole in self._soles:
            J = plant.CalcJacobianSpatialVelocity(plant_context, JacobianWrtVariable.kV, sole, origin, world, sole)
            A = plant.CalcBiasSpatialAcceleration(plant_context, JacobianWrtVariable.kV, sole, origin, world, sole)
            sole_kinematics.append((J[:, self._order].ravel(), A.get_coeffs()))
        return np.concatenate(
            [
                [0.0],
                plant.CalcMassMatrix(plant_context)[self._rows].ravel(),
                plant.CalcBiasTerm(plant_context)[robot.velocity_index],
                *(J for J, _ in sole_kinematics),
                *(A for _, A in sole_kinematics),
                *(X.translation() for X in X_WF),
                *(X.rotation().matrix().ravel() for X in X_WF),
                plant.CalcCenterOfMassPositionInWorld(plant_context),
                velocity,
            ]
        )
