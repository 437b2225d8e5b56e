"""A robot's twin in MuJoCo: the bodies, joints and inertias of its plant in Drake."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, RigidBody, SpatialInertia

from fbse_drake.robot.plant import Ground, Robot

# MuJoCo's impedance d of the ground's contact, in (0, 1).
_IMPEDANCE = 0.95
# A pad touches the ground in one point.
_PAD_RADIUS = 1e-6
# The ground is so much stiffer along its surface: standing feet do not creep.
_FRICTION_STIFFNESS = 100.0

Edit = Callable[[mujoco.MjSpec], None]


@dataclass(frozen=True)
class Machine:
    """A robot in MuJoCo. Joint vectors have the order of the robot's description, shape (n,)."""

    robot: Robot
    model: mujoco.MjModel
    # Further joints of the same axis behind a joint, whose angles its encoder reads as well.
    behind: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def position_index(self) -> np.ndarray:
        """Place of each joint's angle in MuJoCo's positions, shape (n,)."""
        return np.array([self.model.joint(name).qposadr[0] for name in self.robot.joint_names])

    @cached_property
    def velocity_index(self) -> np.ndarray:
        """Place of each joint's rate in MuJoCo's velocities, shape (n,)."""
        return np.array([self.model.joint(name).dofadr[0] for name in self.robot.joint_names])

    @cached_property
    def _read_positions(self) -> np.ndarray:
        """Places of the angles read beside, shape (n,); a zero is behind the last for none."""
        places = [
            self.model.joint(self.behind[name]).qposadr[0] if name in self.behind else self.model.nq
            for name in self.robot.joint_names
        ]
        return np.array(places)

    @cached_property
    def _read_velocities(self) -> np.ndarray:
        places = [
            self.model.joint(self.behind[name]).dofadr[0] if name in self.behind else self.model.nv
            for name in self.robot.joint_names
        ]
        return np.array(places)

    def joint_state(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """What exact encoders read, shape (n,) each [rad], [rad/s]."""
        q, v = data.qpos[self.position_index], data.qvel[self.velocity_index]
        if self.behind:
            q = q + np.append(data.qpos, 0.0)[self._read_positions]
            v = v + np.append(data.qvel, 0.0)[self._read_velocities]
        return q, v

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Torques of a robot with a fixed base along a motion, shape (N, n) [Nm].

        Args:
            q, v, a: joint positions, velocities and accelerations, (N, n) each.
        """
        data, torque = mujoco.MjData(self.model), np.empty_like(q)
        for k in range(len(q)):
            data.qpos[self.position_index] = q[k]
            data.qvel[self.velocity_index] = v[k]
            data.qacc[self.velocity_index] = a[k]
            mujoco.mj_inverse(self.model, data)
            torque[k] = data.qfrc_inverse[self.velocity_index]
        return torque


def make_machine(
    robot: Robot,
    *,
    ground: Ground | None = None,
    edits: Sequence[Edit] = (),
    behind: Mapping[str, str] | None = None,
    time_step: float = 2.5e-4,
    integrator: str = "implicitfast",
) -> Machine:
    """Builds a robot's twin in MuJoCo.

    Args:
        robot: whose bodies, joints and rotor inertias it takes.
        ground: flat ground at z = 0 under the pads; without it there is none.
        edits: what is changed in it before it is compiled.
        behind: see `Machine`.
        time_step: MuJoCo's step [s].
        integrator: `euler`, `implicit`, `implicitfast` or `rk4`.
    """
    plant = robot.plant
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.option.gravity = plant.gravity_field().gravity_vector()
    spec.option.timestep = time_step
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = _FRICTION_STIFFNESS
    spec.option.tolerance = 1e-12
    _add_bodies(spec, robot)
    for name in robot.joint_names:
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    if ground is not None:
        _add_ground(spec, robot, ground)
    for edit in edits:
        edit(spec)
    model = spec.compile()
    if ground is not None:
        _set_stiffness(model, robot, ground)
    return Machine(robot, model, behind or {})


def pad_bodies(robot: Robot) -> list[str]:
    """Names of the bodies that touch the ground, side by side in the description's order."""
    return [
        joint.child_body().name()
        for side in robot.description.sides
        for joint in robot.pad_joints(side)
    ]


def _add_bodies(spec: mujoco.MjSpec, robot: Robot) -> None:
    plant = robot.plant
    joints: dict[str, list[Joint]] = {}
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        joints.setdefault(joint.parent_body().name(), []).append(joint)
    rotor_inertia = _rotor_inertia(plant)

    def add_children(parent: mujoco.MjsBody, name: str) -> None:
        for joint in joints.get(name, []):
            if joint.child_body() is robot.base and robot.has_floating_base:
                continue
            X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
            X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
            body = _add_body(parent, joint.child_body(), X_PF @ X_BM.inverse())
            if joint.num_velocities():
                body.add_joint(
                    name=joint.name(),
                    type=mujoco.mjtJoint.mjJNT_HINGE,
                    pos=X_BM.translation(),
                    axis=X_BM.rotation() @ joint.revolute_axis(),
                    armature=rotor_inertia.get(joint.name(), 0.0),
                )
            add_children(body, joint.child_body().name())

    if robot.has_floating_base:
        base = _add_body(spec.worldbody, robot.base, RigidTransform())
        base.add_freejoint(name="floating_base")
        add_children(base, robot.base.name())
    else:
        add_children(spec.worldbody, plant.world_body().name())


def _rotor_inertia(plant: MultibodyPlant) -> dict[str, float]:
    actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    return {a.joint().name(): a.default_reflected_inertia() for a in actuators}


def _add_body(parent: mujoco.MjsBody, body: RigidBody, X_PB: RigidTransform) -> mujoco.MjsBody:
    inertia = body.default_spatial_inertia()
    moments, R_BI = _principal(inertia)
    return parent.add_body(
        name=body.name(),
        pos=X_PB.translation(),
        quat=X_PB.rotation().ToQuaternion().wxyz(),
        mass=inertia.get_mass(),
        ipos=inertia.get_com() if inertia.get_mass() > 0 else np.zeros(3),
        inertia=moments,
        iquat=R_BI.ToQuaternion().wxyz(),
        explicitinertial=True,
    )


def _principal(inertia: SpatialInertia) -> tuple[np.ndarray, RotationMatrix]:
    """Principal moments of inertia about the centre of mass, and their axes in the body."""
    if inertia.get_mass() == 0:
        return np.zeros(3), RotationMatrix()
    central = inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    moments, axes = np.linalg.eigh(central)
    return moments, RotationMatrix(axes * np.sign(np.linalg.det(axes)))


def _add_ground(spec: mujoco.MjSpec, robot: Robot, ground: Ground) -> None:
    friction = [ground.friction, 0.0, 0.0]
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[20.0, 20.0, 1.0],
        condim=3,
        friction=friction,
    )
    for name in pad_bodies(robot):
        pad = spec.body(name)
        # Pads meet the ground, and nothing else.
        pad.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[_PAD_RADIUS, 0.0, 0.0],
            mass=0.0,
            condim=3,
            friction=friction,
            contype=2,
            conaffinity=1,
            solimp=[_IMPEDANCE, _IMPEDANCE, 0.001, 0.5, 2.0],
        )
        pad.add_site(name=name)
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_FORCE,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=name,
        )


def _set_stiffness(model: mujoco.MjModel, robot: Robot, ground: Ground) -> None:
    """Gives every pad the ground's stiffness, and the damping that Drake's has under a pad's share
    of the weight.

    MuJoCo's contact is a spring and a damper of the acceleration, k and b over d, whose force is
    theirs over (1 - d) / d times the inverse mass A that the pad has in the model's own posture.
    """
    pads = pad_bodies(robot)
    share = float(np.linalg.norm(model.opt.gravity)) * model.body_mass.sum() / len(pads)
    for name in pads:
        pad = model.geom(name)
        scale = (1.0 - _IMPEDANCE) * model.body_invweight0[pad.bodyid[0], 0]
        spring_and_damper = np.array([ground.stiffness, ground.dissipation * share])
        model.geom_solref[pad.id] = -scale * spring_and_damper
    # The ground's own softness counts for nothing in a pair.
    model.geom_solmix[model.geom("ground").id] = 0.0
