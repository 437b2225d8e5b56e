"""Rigid-body kinematics and inverse dynamics of a plant at many instants at once.

Drake computes one instant a call, and a call from Python costs more than the instant. In a
`BodyTree` one call goes through all: the recursive Newton-Euler algorithm and Jacobians over the
tree of a plant's moving bodies (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapters 4 and
5), in world axes. Bodies that are welded together are one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
from numba import njit
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Frame,
    JacobianWrtVariable,
    Joint,
    MultibodyForces,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    WeldJoint,
)

_REVOLUTE, _PRISMATIC, _FLOATING = range(3)
_KINDS = {
    RevoluteJoint.kTypeName: _REVOLUTE,
    PrismaticJoint.kTypeName: _PRISMATIC,
    QuaternionFloatingJoint.kTypeName: _FLOATING,
}
# Outside of all moving bodies.
_WORLD = -1


class Dynamics(Protocol):
    """What the equation of motion of a plant takes, at M instants."""

    def inverse_dynamics(
        self, states: np.ndarray, accelerations: np.ndarray, *, forces: bool
    ) -> np.ndarray:
        """Generalized forces that a motion needs, (M, velocities).

        Args:
            states: positions and velocities of the plant, (M, positions + velocities).
            accelerations: (M, velocities).
            forces: is there what its gravity, springs and dampers give?
        """
        ...

    def jacobians(self, frames: Sequence[Frame], positions: np.ndarray) -> np.ndarray:
        """Jacobian of the spatial velocity [angular, linear] of some frames of the plant in the
        world, in their own axes, (frames, M, 6, velocities)."""
        ...

    def bias_accelerations(
        self, frames: Sequence[Frame], states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Spatial acceleration [angular, linear] of some frames S in the world W without any
        accelerations of joints, in their own axes, (frames, M, 6), and their orientation R_WS,
        (frames, M, 3, 3)."""
        ...


def dynamics_of(plant: MultibodyPlant) -> Dynamics:
    """Of a finalized plant with its default parameters."""
    return BodyTree(plant) if has_body_tree(plant) else OneByOne(plant)


def has_body_tree(plant: MultibodyPlant) -> bool:
    """Can a `BodyTree` be made of a plant? Other joints, springs and dampers are left to Drake."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    return (
        plant.num_force_elements() == 1
        and plant.num_constraints() == 0
        and all(joint.type_name() in {*_KINDS, WeldJoint.kTypeName} for joint in joints)
        # What floats does so in the axes of the world.
        and all(
            joint.frame_on_parent().index() == plant.world_frame().index()
            for joint in joints
            if joint.type_name() == QuaternionFloatingJoint.kTypeName
        )
        and not any(np.any(joint.default_damping_vector()) for joint in joints)
    )


@dataclass(frozen=True)
class _Node:
    """A moving body N with all that is welded to it."""

    joint: Joint
    # Place of the node that it hangs on.
    parent: int
    # Of the joint's frames, on the parent and on the body.
    X_PF: RigidTransform
    X_MN: RigidTransform


class BodyTree:
    """The moving bodies of a plant, see the module."""

    def __init__(self, plant: MultibodyPlant):
        """Reads the tree.

        Args:
            plant: finalized, see `has_body_tree`; its parameters are the default ones.
        """
        self._plant = plant
        nodes: list[_Node] = []
        # Node of each body, and the body's pose in it.
        self._places = {plant.world_body().index(): (_WORLD, RigidTransform())}
        waiting = [plant.get_joint(index) for index in plant.GetJointIndices()]
        while waiting:
            joint = next(j for j in waiting if j.parent_body().index() in self._places)
            waiting.remove(joint)
            parent, X_NP = self._places[joint.parent_body().index()]
            X_PF = X_NP @ joint.frame_on_parent().GetFixedPoseInBodyFrame()
            X_MB = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
            child: BodyIndex = joint.child_body().index()
            if joint.type_name() == WeldJoint.kTypeName:
                self._places[child] = parent, X_PF @ cast(WeldJoint, joint).X_FM() @ X_MB
            else:
                self._places[child] = len(nodes), RigidTransform()
                nodes.append(_Node(joint, parent, X_PF, X_MB))
        self._tree = (
            np.array([node.parent for node in nodes]),
            np.array([_KINDS[node.joint.type_name()] for node in nodes]),
            np.array([[n.joint.position_start(), n.joint.velocity_start()] for n in nodes]),
            np.array([_axis(node.joint) for node in nodes]),
            *_stacked([node.X_PF for node in nodes]),
            *_stacked([node.X_MN for node in nodes]),
        )
        self._inertia = self._inertias(len(nodes))
        self._reflected = np.zeros(plant.num_velocities())
        for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
            inertia = actuator.default_rotor_inertia() * actuator.default_gear_ratio() ** 2
            self._reflected[actuator.joint().velocity_start()] += inertia

    def _inertias(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass, first moment and rotational inertia about the origin of each node, in its axes."""
        plant, context = self._plant, self._plant.CreateDefaultContext()
        mass, moment, inertia = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
        for index, (node, X_NB) in self._places.items():
            if node == _WORLD:
                continue
            # [[I, m c x], [-m c x, m]] about the body's origin; changes of bodies may be negative,
            # which a `SpatialInertia` is not asked to be moved with.
            M_B = plant.get_body(index).CalcSpatialInertiaInBodyFrame(context).CopyToFullMatrix6()
            R, p = X_NB.rotation().matrix(), X_NB.translation()
            m, of_body = M_B[3, 3], R @ np.array([M_B[2, 4], M_B[0, 5], M_B[1, 3]])
            P, C = _cross_matrix(p), _cross_matrix(of_body)
            mass[node] += m
            moment[node] += of_body + m * p
            inertia[node] += R @ M_B[:3, :3] @ R.T - P @ C - C @ P - m * P @ P
        return mass, moment, inertia

    def inverse_dynamics(
        self, states: np.ndarray, accelerations: np.ndarray, *, forces: bool
    ) -> np.ndarray:
        """See `Dynamics`; gravity is the only force."""
        result = np.empty(accelerations.shape)
        _fill_inverse_dynamics(
            result,
            np.ascontiguousarray(states),
            np.ascontiguousarray(accelerations),
            self._plant.num_positions(),
            self._plant.gravity_field().gravity_vector() * forces,
            *self._tree,
            *self._inertia,
        )
        return result + self._reflected * accelerations

    def jacobians(self, frames: Sequence[Frame], positions: np.ndarray) -> np.ndarray:
        """See `Dynamics`."""
        result = np.zeros((len(frames), len(positions), 6, self._plant.num_velocities()))
        none = np.zeros((0, 0, 6)), np.zeros((0, 0, 3, 3))
        of_frames, positions = self._frames(frames), np.ascontiguousarray(positions)
        _fill_frames(result, *none, positions, 0, False, *of_frames, *self._tree)
        return result

    def bias_accelerations(
        self, frames: Sequence[Frame], states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Dynamics`."""
        result = np.zeros((len(frames), len(states), 6))
        rotations = np.zeros((len(frames), len(states), 3, 3))
        of_frames, states = self._frames(frames), np.ascontiguousarray(states)
        positions, none = self._plant.num_positions(), np.zeros((0, 0, 6, 0))
        _fill_frames(none, result, rotations, states, positions, True, *of_frames, *self._tree)
        return result, rotations

    def _frames(self, frames: Sequence[Frame]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Node of each frame, and its pose in it."""
        places, poses = [], []
        for frame in frames:
            node, X_NB = self._places[frame.body().index()]
            places.append(node)
            poses.append(X_NB @ frame.GetFixedPoseInBodyFrame())
        return np.array(places), *_stacked(poses)


class OneByOne:
    """Dynamics of any plant, by Drake, one instant after the other."""

    def __init__(self, plant: MultibodyPlant):
        """Takes a finalized plant."""
        self._plant, self._context = plant, plant.CreateDefaultContext()

    def inverse_dynamics(
        self, states: np.ndarray, accelerations: np.ndarray, *, forces: bool
    ) -> np.ndarray:
        """See `Dynamics`."""
        plant, context, given = self._plant, self._context, MultibodyForces(self._plant)
        result = np.empty(accelerations.shape)
        for k, (state, acceleration) in enumerate(zip(states, accelerations, strict=True)):
            plant.SetPositionsAndVelocities(context, state)
            if forces:
                plant.CalcForceElementsContribution(context, given)
            result[k] = plant.CalcInverseDynamics(context, acceleration, given)
        return result

    def jacobians(self, frames: Sequence[Frame], positions: np.ndarray) -> np.ndarray:
        """See `Dynamics`."""
        plant, context, world = self._plant, self._context, self._plant.world_frame()
        result = np.empty((len(frames), len(positions), 6, plant.num_velocities()))
        for k, position in enumerate(positions):
            plant.SetPositions(context, position)
            for f, frame in enumerate(frames):
                result[f, k] = plant.CalcJacobianSpatialVelocity(
                    context, JacobianWrtVariable.kV, frame, np.zeros(3), world, frame
                )
        return result

    def bias_accelerations(
        self, frames: Sequence[Frame], states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Dynamics`."""
        plant, context, world = self._plant, self._context, self._plant.world_frame()
        result = np.empty((len(frames), len(states), 6))
        rotations = np.empty((len(frames), len(states), 3, 3))
        for k, state in enumerate(states):
            plant.SetPositionsAndVelocities(context, state)
            for f, frame in enumerate(frames):
                bias = plant.CalcBiasSpatialAcceleration(
                    context, JacobianWrtVariable.kV, frame, np.zeros(3), world, frame
                )
                result[f, k] = bias.get_coeffs()
                rotations[f, k] = frame.CalcRotationMatrixInWorld(context).matrix()
        return result, rotations


def _cross_matrix(p: np.ndarray) -> np.ndarray:
    return np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])


def _axis(joint: Joint) -> np.ndarray:
    if joint.type_name() == RevoluteJoint.kTypeName:
        return cast(RevoluteJoint, joint).revolute_axis()
    if joint.type_name() == PrismaticJoint.kTypeName:
        return cast(PrismaticJoint, joint).translation_axis()
    return np.zeros(3)


def _stacked(poses: Sequence[RigidTransform]) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) and translations (N, 3)."""
    rotations = np.array([X.rotation().matrix() for X in poses]).reshape(-1, 3, 3)
    return rotations, np.array([X.translation() for X in poses]).reshape(-1, 3)


@njit(cache=True)
def _multiply(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> None:
    """C = A B, (3, 3)."""
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(cache=True)
def _rotate(A: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """y = A x."""
    for i in range(3):
        y[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]


@njit(cache=True)
def _rotate_back(A: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """y = A^T x."""
    for i in range(3):
        y[i] = A[0, i] * x[0] + A[1, i] * x[1] + A[2, i] * x[2]


@njit(cache=True)
def _add(factor: float, a: np.ndarray, b: np.ndarray) -> None:
    """b = b + factor a."""
    for i in range(3):
        b[i] += factor * a[i]


@njit(cache=True)
def _add_cross(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    """c = c + a x b."""
    c[0] += a[1] * b[2] - a[2] * b[1]
    c[1] += a[2] * b[0] - a[0] * b[2]
    c[2] += a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _add_cross_twice(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    """c = c + a x (a x b)."""
    along = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    square = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    for i in range(3):
        c[i] += along * a[i] - square * b[i]


@njit(cache=True)
def _fill_poses(
    R: np.ndarray,
    p: np.ndarray,
    h: np.ndarray,
    o: np.ndarray,
    q: np.ndarray,
    parent: np.ndarray,
    kind: np.ndarray,
    start: np.ndarray,
    axis: np.ndarray,
    R_PF: np.ndarray,
    p_PF: np.ndarray,
    R_MN: np.ndarray,
    p_MN: np.ndarray,
) -> None:
    """Orientation R_WN and place p_WN of each node, axis h of its joint and origin o of the joint's
    frame on the node, in world axes."""
    R_WF, R_FM, R_WM = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    t, shift = np.empty(3), np.empty(3)
    for n in range(len(parent)):
        above, first = parent[n], start[n, 0]
        if above < 0:
            for i in range(3):
                o[n, i] = p_PF[n, i]
                for j in range(3):
                    R_WF[i, j] = R_PF[n, i, j]
        else:
            _multiply(R[above], R_PF[n], R_WF)
            _rotate(R[above], p_PF[n], t)
            for i in range(3):
                o[n, i] = p[above, i] + t[i]
        _rotate(R_WF, axis[n], h[n])
        if kind[n] == _FLOATING:
            w, x, y, z = q[first], q[first + 1], q[first + 2], q[first + 3]
            square = w * w + x * x + y * y + z * z
            for i in range(3):
                shift[i] = q[first + 4 + i]
            _rotate(R_WF, shift, t)
            _add(1.0, t, o[n])
            ww, xx, xy, xz = w * w / square, x * x / square, x * y / square, x * z / square
            yy, yz, zz = y * y / square, y * z / square, z * z / square
            wx, wy, wz = w * x / square, w * y / square, w * z / square
            R_FM[0, 0] = ww + xx - yy - zz
            R_FM[1, 1] = ww - xx + yy - zz
            R_FM[2, 2] = ww - xx - yy + zz
            R_FM[0, 1], R_FM[1, 0] = 2 * (xy - wz), 2 * (xy + wz)
            R_FM[0, 2], R_FM[2, 0] = 2 * (xz + wy), 2 * (xz - wy)
            R_FM[1, 2], R_FM[2, 1] = 2 * (yz - wx), 2 * (yz + wx)
        else:
            angle = q[first] if kind[n] == _REVOLUTE else 0.0
            if kind[n] == _PRISMATIC:
                _add(q[first], h[n], o[n])
            c, s = np.cos(angle), np.sin(angle)
            x, y, z = axis[n, 0], axis[n, 1], axis[n, 2]
            for i in range(3):
                for j in range(3):
                    R_FM[i, j] = (1.0 - c) * axis[n, i] * axis[n, j]
                R_FM[i, i] += c
            R_FM[0, 1] -= s * z
            R_FM[1, 0] += s * z
            R_FM[0, 2] += s * y
            R_FM[2, 0] -= s * y
            R_FM[1, 2] -= s * x
            R_FM[2, 1] += s * x
        _multiply(R_WF, R_FM, R_WM)
        _multiply(R_WM, R_MN[n], R[n])
        _rotate(R_WM, p_MN[n], t)
        for i in range(3):
            p[n, i] = o[n, i] + t[i]


@njit(cache=True)
def _fill_rates(
    w: np.ndarray,
    alpha: np.ndarray,
    a: np.ndarray,
    p: np.ndarray,
    h: np.ndarray,
    o: np.ndarray,
    v: np.ndarray,
    v_dot: np.ndarray,
    gravity: np.ndarray,
    parent: np.ndarray,
    kind: np.ndarray,
    start: np.ndarray,
) -> None:
    """Angular velocity and acceleration of each node, and acceleration of its origin less gravity,
    in world axes. A floating joint hangs on the world, and its velocities are in world axes."""
    r = np.empty(3)
    for n in range(len(parent)):
        above, first = parent[n], start[n, 1]
        for i in range(3):
            if above < 0:
                w[n, i], alpha[n, i], a[n, i] = 0.0, 0.0, -gravity[i]
            else:
                w[n, i], alpha[n, i], a[n, i] = w[above, i], alpha[above, i], a[above, i]
                r[i] = o[n, i] - p[above, i]
        if above >= 0:
            # Of the point of the parent where the joint is.
            _add_cross(alpha[above], r, a[n])
            _add_cross_twice(w[above], r, a[n])
        if kind[n] == _FLOATING:
            for i in range(3):
                w[n, i] += v[first + i]
                alpha[n, i] += v_dot[first + i]
                a[n, i] += v_dot[first + 3 + i]
        else:
            turning = kind[n] == _REVOLUTE
            for i in range(3):
                r[i] = v[first] * h[n, i] * (1.0 if turning else 2.0)
            _add_cross(w[n], r, alpha[n] if turning else a[n])
            _add(v_dot[first], h[n], alpha[n] if turning else a[n])
            if turning:
                _add(1.0, r, w[n])
        for i in range(3):
            r[i] = p[n, i] - o[n, i]
        _add_cross(alpha[n], r, a[n])
        _add_cross_twice(w[n], r, a[n])


@njit(cache=True)
def _fill_inverse_dynamics(
    result: np.ndarray,
    states: np.ndarray,
    accelerations: np.ndarray,
    positions: int,
    gravity: np.ndarray,
    parent: np.ndarray,
    kind: np.ndarray,
    start: np.ndarray,
    axis: np.ndarray,
    R_PF: np.ndarray,
    p_PF: np.ndarray,
    R_MN: np.ndarray,
    p_MN: np.ndarray,
    mass: np.ndarray,
    moment: np.ndarray,
    inertia: np.ndarray,
) -> None:
    count = len(parent)
    R, p, h = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    o = np.empty((count, 3))
    w, alpha, a = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    force, torque = np.empty((count, 3)), np.empty((count, 3))
    c, x, y = np.empty(3), np.empty(3), np.empty(3)
    for m in range(len(states)):
        _fill_poses(R, p, h, o, states[m], parent, kind, start, axis, R_PF, p_PF, R_MN, p_MN)
        v, v_dot = states[m, positions:], accelerations[m]
        _fill_rates(w, alpha, a, p, h, o, v, v_dot, gravity, parent, kind, start)
        for n in range(count):
            # Newton's and Euler's equations about the node's origin.
            _rotate(R[n], moment[n], c)
            for i in range(3):
                force[n, i] = mass[n] * a[n, i]
            _add_cross(alpha[n], c, force[n])
            _add_cross_twice(w[n], c, force[n])
            # The inertia is in the node's axes.
            _rotate_back(R[n], alpha[n], x)
            _rotate(inertia[n], x, y)
            _rotate(R[n], y, torque[n])
            _rotate_back(R[n], w[n], x)
            _rotate(inertia[n], x, y)
            _rotate(R[n], y, x)
            _add_cross(w[n], x, torque[n])
            _add_cross(c, a[n], torque[n])
        for n in range(count - 1, -1, -1):
            above, first = parent[n], start[n, 1]
            # About the joint.
            for i in range(3):
                x[i] = p[n, i] - o[n, i]
                y[i] = torque[n, i]
            _add_cross(x, force[n], y)
            if kind[n] == _FLOATING:
                for i in range(3):
                    result[m, first + i], result[m, first + 3 + i] = y[i], force[n, i]
            else:
                along = 0.0
                for i in range(3):
                    along += h[n, i] * (y[i] if kind[n] == _REVOLUTE else force[n, i])
                result[m, first] = along
            if above >= 0:
                for i in range(3):
                    x[i] = p[n, i] - p[above, i]
                _add(1.0, force[n], force[above])
                _add(1.0, torque[n], torque[above])
                _add_cross(x, force[n], torque[above])


@njit(cache=True)
def _fill_frames(
    jacobians: np.ndarray,
    bias: np.ndarray,
    rotations: np.ndarray,
    states: np.ndarray,
    positions: int,
    moving: bool,
    places: np.ndarray,
    R_NS: np.ndarray,
    p_NS: np.ndarray,
    parent: np.ndarray,
    kind: np.ndarray,
    start: np.ndarray,
    axis: np.ndarray,
    R_PF: np.ndarray,
    p_PF: np.ndarray,
    R_MN: np.ndarray,
    p_MN: np.ndarray,
) -> None:
    """Of moving instants bias and rotations, else Jacobians."""
    count = len(parent)
    R, p, h = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    o = np.empty((count, 3))
    w, alpha, a = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    R_WS, r, t, e, lever = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    none, still = np.zeros(3), np.zeros(states.shape[1])
    for m in range(len(states)):
        _fill_poses(R, p, h, o, states[m], parent, kind, start, axis, R_PF, p_PF, R_MN, p_MN)
        if moving:
            v = states[m, positions:]
            _fill_rates(w, alpha, a, p, h, o, v, still, none, parent, kind, start)
        for f in range(len(places)):
            n = places[f]
            if n < 0:
                for i in range(3):
                    for j in range(3):
                        R_WS[i, j] = R_NS[f, i, j]
            else:
                _multiply(R[n], R_NS[f], R_WS)
                _rotate(R[n], p_NS[f], r)
            if moving:
                for i in range(3):
                    for j in range(3):
                        rotations[f, m, i, j] = R_WS[i, j]
                    t[i] = a[n, i] if n >= 0 else 0.0
                if n >= 0:
                    _add_cross(alpha[n], r, t)
                    _add_cross_twice(w[n], r, t)
                    _rotate_back(R_WS, alpha[n], bias[f, m, :3])
                    _rotate_back(R_WS, t, bias[f, m, 3:])
                continue
            if n >= 0:
                _add(1.0, p[n], r)
            while n >= 0:
                first = start[n, 1]
                for k in range(3 if kind[n] == _FLOATING else 1):
                    for i in range(3):
                        e[i] = (1.0 if i == k else 0.0) if kind[n] == _FLOATING else h[n, i]
                    shifted = first + k
                    if kind[n] != _PRISMATIC:
                        for i in range(3):
                            lever[i], t[i] = r[i] - o[n, i], 0.0
                        _add_cross(e, lever, t)
                        _rotate_back(R_WS, e, jacobians[f, m, :3, shifted])
                        _rotate_back(R_WS, t, jacobians[f, m, 3:, shifted])
                        shifted += 3
                    if kind[n] != _REVOLUTE:
                        _rotate_back(R_WS, e, jacobians[f, m, 3:, shifted])
                n = parent[n]
