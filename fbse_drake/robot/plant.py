"""Plants: a robot's model in Drake, with the names of its description resolved."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from os.path import expandvars
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import AddContactMaterial, Box, ProximityProperties, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import LoadModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    Joint,
    JointActuator,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)
from pydrake.systems.framework import Context, DiagramBuilder
from scipy.spatial.transform import Rotation

from fbse_drake.errors import InputError, located, require_not_negative, require_positive
from fbse_drake.robot.bare_urdf import bare_urdf
from fbse_drake.robot.description import Leg, RobotDescription, load_description
from fbse_drake.robot.implicit import ImplicitTorque, add_implicit_torque, clamp_name

# The instance that holds a robot's model: the first after Drake's own two.
_MODEL = ModelInstanceIndex(2)
# So many names are offered in the place of a wrong one.
_NAMED = 12
# Between a body's name and the number in the names of the bodies that carry its point masses.
_POINT_MASS = "_point_mass_"
# Name of the frame of what is elsewhere than the model has it.
_SHIFTED = "{}_shifted"
# A corner of a foot touches the ground in one point, and is far stiffer than any ground.
_CORNER_RADIUS, _CORNER_STIFFNESS = 1e-9, 1e12


@dataclass(frozen=True)
class Stairs:
    """Steps across the world's x axis, as wide as the ground; before the first and beyond the last
    it is even."""

    # Where the first step begins [m], how far it is from one to the next [m], how far each is above
    # the one before (below it, if negative) [m], and how many there are.
    begin: float
    depth: float
    rise: float
    count: int

    def __post_init__(self) -> None:
        require_positive(self, "depth", "count")


@dataclass(frozen=True)
class Ground:
    """Flat ground with point contact. The world's frame is fixed to it: its surface is z = 0 also
    where it slopes, but for its stairs."""

    # Coulomb friction coefficient of the ground's surface; the pads' own is in the robot's model.
    friction: float = 0.8
    # Contact stiffness [N/m] and Hunt-Crossley dissipation [s/m] of one point. A foot of 5.5 kg
    # that lands at millimetres per second bounces for a tenth of a second below some 20 s/m, and
    # then slips; 100 s/m is a rubber sole.
    stiffness: float = 1.0e6
    dissipation: float = 100.0
    # Rotation vector, about world x and y, that tilts it from level [rad]. A robot in a gantry
    # hangs level all the same.
    slope: list[float] = field(default_factory=lambda: [0.0, 0.0])
    stairs: Stairs | None = None

    def __post_init__(self) -> None:
        if len(self.slope) != 2:
            raise InputError(f"slope: expected two numbers, found {self.slope}")
        require_positive(self, "stiffness")
        require_not_negative(self, "friction", "dissipation")


@dataclass(frozen=True)
class PointMass:
    """A mass fixed to a body B at one point, beside the mass that the robot's model gives the
    body."""

    body: str
    # May be negative [kg].
    mass: float
    # p_BoP_B, shape (3,) [m].
    position: np.ndarray

    @property
    def inertia(self) -> SpatialInertia:
        """About Bo, in B; no body has that of a negative mass."""
        return SpatialInertia(
            self.mass, self.position, UnitInertia.PointMass(self.position), skip_validity_check=True
        )


@dataclass(frozen=True)
class Robot:
    """A finalized plant together with its description. Joint vectors have the description's order,
    shape (n,)."""

    plant: MultibodyPlant
    description: RobotDescription
    # What its solver takes of the joints' losses.
    implicit: ImplicitTorque
    # What of its model's file could not be taken as it is, in words.
    remarks: tuple[str, ...] = ()

    @property
    def joint_names(self) -> list[str]:
        return self.description.joint_names

    @cached_property
    def has_floating_base(self) -> bool:
        return self.base.is_floating_base_body()

    @cached_property
    def base(self) -> RigidBody:
        return self.plant.GetBodyByName(self.description.base)

    @cached_property
    def imu(self) -> Frame:
        """Where it really is, which may not be where the description has it."""
        name = self.description.imu or self.description.base
        moved = _SHIFTED.format(name)
        return self.plant.GetFrameByName(moved if self.plant.HasFrameNamed(moved) else name)

    @cached_property
    def total_mass(self) -> float:
        """[kg]."""
        return self.plant.CalcTotalMass(self.plant.CreateDefaultContext())

    @cached_property
    def joint_inertia(self) -> np.ndarray:
        """What each joint moves in the default posture, rotors included: the mass matrix's
        diagonal, (n,) [kg m^2, or kg of a prismatic joint]."""
        M = self.plant.CalcMassMatrix(self.plant.CreateDefaultContext())
        return M.diagonal()[self.velocity_index]

    @cached_property
    def torque_units(self) -> list[str]:
        """Unit of each joint's torque, or of the force of a prismatic joint."""
        return [
            "N" if self.plant.GetJointByName(name).type_name() == PrismaticJoint.kTypeName else "Nm"
            for name in self.joint_names
        ]

    @cached_property
    def position_units(self) -> list[str]:
        """Unit of each joint's angle, or of the place of a prismatic joint."""
        return ["m" if unit == "N" else "rad" for unit in self.torque_units]

    @cached_property
    def body_names(self) -> list[str]:
        """Model names of all bodies with a mass, but for point masses."""
        bodies = [
            self.plant.get_body(index)
            for index in self.plant.GetBodyIndices(self.base.model_instance())
        ]
        return [
            body.name()
            for body in bodies
            if body.default_mass() > 0 and _POINT_MASS not in body.name()
        ]

    def body(self, name: str) -> RigidBody:
        """Raises InputError where there is none of this name that has a mass."""
        if name not in self.body_names:
            raise InputError(
                f"{name}: the model has no body of this name with a mass (there are: "
                f"{', '.join(self.body_names)})"
            )
        return self.plant.GetBodyByName(name)

    def rotor_inertia(self, joint: str) -> float:
        """Reflected rotor inertia of a joint [kg m^2]; 0 without a motor."""
        motors = _actuators(self.plant)
        return motors[joint].default_rotor_inertia() if joint in motors else 0.0

    @cached_property
    def rotor_inertias(self) -> np.ndarray:
        """That of every joint, (n,) [kg m^2]."""
        return np.array([self.rotor_inertia(joint) for joint in self.joint_names])

    def added_to(self, name: str) -> list[RigidBody]:
        """Bodies that carry the point masses of a body, in its frame."""
        bodies = [
            self.plant.get_body(index)
            for index in self.plant.GetBodyIndices(self.base.model_instance())
        ]
        return [body for body in bodies if body.name().rpartition(_POINT_MASS)[0] == name]

    def sole(self, side: str) -> Frame:
        return self.plant.GetFrameByName(self.description.legs[side].sole)

    def pad_positions(self, side: str) -> np.ndarray:
        """Places in the sole frame F where the ground's force is known: the foot's force sensors,
        or the corners of a foot with a six-axis sensor, shape (points, 3) [m]."""
        leg = self.description.legs[side]
        return np.array(leg.corners or [X_FP.translation() for X_FP in self._pad_poses(side)])

    @cached_property
    def grasp_maps(self) -> list[np.ndarray]:
        """Of each foot, from the forces at these places to the wrench, (6, 3 points) each; see
        `grasp_map`."""
        return [grasp_map(self.pad_positions(side)) for side in self.description.sides]

    def pad_joints(self, side: str) -> list[Joint]:
        """The fixed joints through which the ground's force passes at these places. (Corners have
        them only on a ground.)"""
        leg = self.description.legs[side]
        return [self.plant.GetJointByName(name) for name in leg.pads or _corner_joints(side, leg)]

    def _pad_poses(self, side: str) -> list[RigidTransform]:
        context = self.plant.CreateDefaultContext()
        joints = [self.plant.GetJointByName(name) for name in self.description.legs[side].pads]
        return [joint.frame_on_child().CalcPose(context, self.sole(side)) for joint in joints]

    @cached_property
    def position_index(self) -> np.ndarray:
        """Place of each joint's angle in the plant's positions, shape (n,)."""
        return np.array(
            [self.plant.GetJointByName(name).position_start() for name in self.joint_names]
        )

    @cached_property
    def velocity_index(self) -> np.ndarray:
        """Place of each joint's rate in the plant's velocities, shape (n,)."""
        return np.array(
            [self.plant.GetJointByName(name).velocity_start() for name in self.joint_names]
        )

    @cached_property
    def joint_state_selector(self) -> np.ndarray:
        """Matrix that takes the plant's state to [joint positions, joint velocities], shape
        (2n, state)."""
        columns = np.concatenate(
            [self.position_index, self.plant.num_positions() + self.velocity_index]
        )
        return np.eye(self.plant.num_multibody_states())[columns]

    @cached_property
    def actuation_selector(self) -> np.ndarray:
        """Matrix that takes joint torques to the plant's actuation vector, shape (actuators, n)."""
        selector = np.zeros((self.plant.num_actuators(), len(self.joint_names)))
        for j, motor in enumerate(_motors(self.plant, self.joint_names).values()):
            selector[motor.input_start(), j] = 1.0
        return selector

    @cached_property
    def clamp_selector(self) -> np.ndarray:
        """Matrix that takes the offsets of all clamps, row by row, to the actuation vector, shape
        (actuators, m n)."""
        selector = np.zeros((self.plant.num_actuators(), self.implicit.limit.size))
        for k, clamp in self._clamps:
            selector[clamp.input_start(), k] = -1.0
        return selector

    @cached_property
    def clamp_index(self) -> np.ndarray:
        """Place of each joint's clamps in the plant's net actuation, or -1 for a joint without,
        shape (n,).

        Drake reports the torque of all clamps of a joint together, at each of them.
        """
        index = np.full(len(self.joint_names), -1)
        for k, clamp in self._clamps:
            index[k % len(index)] = clamp.input_start()
        return index

    @property
    def _clamps(self) -> list[tuple[int, JointActuator]]:
        """Clamps with their places in the rows of `implicit`."""
        rows, columns = np.nonzero(self.implicit.has_clamp)
        names = [clamp_name(self.joint_names[j], row) for row, j in zip(rows, columns, strict=True)]
        places = (rows * len(self.joint_names) + columns).tolist()
        return [
            (k, self.plant.GetJointActuatorByName(name))
            for k, name in zip(places, names, strict=True)
        ]

    def base_pose_positions(self, X_WB: RigidTransform) -> np.ndarray:
        """Default positions of the plant with the base at X_WB, shape (positions,)."""
        context = self.plant.CreateDefaultContext()
        if self.has_floating_base:
            self.plant.SetFloatingBaseBodyPoseInWorldFrame(context, self.base, X_WB)
        return self.plant.GetPositions(context)

    def set_joint_positions(self, context: Context, q: np.ndarray) -> None:
        positions = self.plant.GetPositions(context)
        positions[self.position_index] = q
        self.plant.SetPositions(context, positions)

    def set_state(
        self,
        context: Context,
        q: np.ndarray,
        v: np.ndarray,
        X_WB: RigidTransform | None = None,
        V_WB: np.ndarray | None = None,
    ) -> None:
        """Sets the whole state of the plant.

        Args:
            q, v: joint positions [rad] and velocities [rad/s], shape (n,).
            X_WB: pose of a floating base.
            V_WB: its spatial velocity [angular, linear] in world axes, shape (6,) [rad/s, m/s]; at
                rest by default.
        """
        velocities = np.zeros(self.plant.num_velocities())
        velocities[self.velocity_index] = v
        if X_WB is not None:
            self.plant.SetFloatingBaseBodyPoseInWorldFrame(context, self.base, X_WB)
            start = self.base.floating_velocities_start_in_v()
            velocities[start : start + 6] = 0.0 if V_WB is None else V_WB
        self.set_joint_positions(context, q)
        self.plant.SetVelocities(context, velocities)


def is_point_mass(body: RigidBody) -> bool:
    """Does the body carry point masses of another one?"""
    return _POINT_MASS in body.name()


def grasp_map(pad_positions: np.ndarray) -> np.ndarray:
    """Matrix that takes the forces on all pads of a foot, [x, y, z] pad by pad, to the
    wrench [moment, force] at the sole's origin in the sole frame.

    Args:
        pad_positions: (pads, 3) [m].

    Returns:
        Shape (6, 3 pads) [m, 1].
    """
    moments = [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in pad_positions]
    return np.concatenate([np.concatenate([moment, np.eye(3)]) for moment in moments], axis=1)


def gravity_on_slope(gravity: np.ndarray, slope: Sequence[float] | np.ndarray) -> np.ndarray:
    """Gravity as a world has it that is fixed to sloping ground, (3,) [m/s^2].

    Args:
        gravity: where the ground is level, (3,) [m/s^2].
        slope: see `Ground.slope` [rad].
    """
    return Rotation.from_rotvec([*slope, 0.0]).inv().apply(gravity)


def slope_of_gravity(gravity: np.ndarray) -> np.ndarray:
    """The slope on which level ground's gravity pulls like that, (2,) [rad]; see
    `gravity_on_slope`."""
    down = gravity / np.linalg.norm(gravity)
    across = np.array([-down[1], down[0]])
    size = np.linalg.norm(across)
    if size == 0.0:
        return np.array([0.0 if down[2] < 0 else np.pi, 0.0])
    return across / size * np.arctan2(size, -down[2])


@dataclass(frozen=True)
class Shifts:
    """How far parts of a robot are from where its model has them."""

    # Joints in the frames of the bodies that carry them, (3,) by name [m].
    joints: Mapping[str, np.ndarray] = field(default_factory=dict)
    # The IMU in its own axes, (3,) [m].
    imu: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # Of a base that is fixed: by what rotation vector about world x and y it is not level, (2,)
    # [rad].
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(2))


def make_robot(
    description: str | Path,
    *,
    rotor_inertia: Mapping[str, float] | None = None,
    point_masses: Sequence[PointMass] = (),
    shifts: Shifts | None = None,
    gantry_height: float | None = None,
    builder: DiagramBuilder | None = None,
    config: MultibodyPlantConfig | None = None,
    ground: Ground | None = None,
    implicit: ImplicitTorque | None = None,
) -> tuple[Robot, SceneGraph]:
    """Loads a robot's model into a plant.

    Args:
        description: name or path of a robot description (`models/*.yaml`).
        rotor_inertia: reflected rotor inertia [kg m^2] by joint, see `RobotDescription.per_joint`.
        point_masses: further masses on bodies of the model.
        shifts: what is elsewhere than the model has it; by default nothing.
        gantry_height: hangs the base in a gantry: welds it to the world at this height [m],
            upright.
        builder: the diagram that gets the plant and its scene graph; by default one that is thrown
            away, which is what a model needs that is only computed with.
        config: Drake's plant settings.
        ground: ground at z = 0; without it there is none.
        implicit: losses of the joints that the plant's solver takes; by default none.

    Raises:
        InputError: unknown file, joint, frame, body or pad; point masses that leave a body with an
            impossible inertia.
    """
    names, path = load_description(description)
    diagram = builder or DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(config or MultibodyPlantConfig(), diagram)
    with located(f"{path}: "):
        remarks = _add_model(plant, names, path)
        _add_frames(plant, names)
        _check_names(plant, names)
        _hold_other_joints(plant, names)
    shifts = shifts or Shifts()
    _shift_joints(plant, shifts.joints)
    _shift_imu(plant, names, shifts.imu)
    inertia = names.per_joint(rotor_inertia or {}, key="rotor_inertia", default=0.0)
    _add_actuators(plant, dict(zip(names.joint_names, inertia, strict=True)))
    implicit = implicit or ImplicitTorque.none(len(names.joint_names))
    add_implicit_torque(plant, names.joint_names, _motors(plant, names.joint_names), implicit)
    _add_point_masses(plant, names, point_masses)
    if gantry_height is None and names.fixed_base:
        gantry_height = 0.0
    if gantry_height is not None and not _is_carried(plant, names.base):
        plant.WeldFrames(
            plant.world_frame(),
            plant.GetFrameByName(names.base),
            RigidTransform([0, 0, gantry_height]),
        )
    if ground is not None:
        _add_ground(plant, ground)
        for side, leg in names.legs.items():
            _add_corners(plant, side, leg, ground)
    if gantry_height is not None:
        _tilt_world(plant, shifts.tilt)
    elif shifts.tilt.any():
        raise InputError("effects: only a base that is fixed can be mounted tilted")
    elif ground is not None:
        _tilt_world(plant, ground.slope)
    plant.Finalize()
    if plant.CalcTotalMass(plant.CreateDefaultContext()) <= 0.0:
        raise InputError(f"{path}: expected a robot with a mass, found none in its model")
    if builder is None:
        # A builder that never builds is never freed.
        diagram.Build()
    robot = Robot(plant, names, implicit, remarks)
    for side in names.sides:
        for pad, X_FP in zip(names.legs[side].pads, robot._pad_poses(side), strict=True):
            if not X_FP.rotation().IsNearlyIdentity(1e-9):
                raise InputError(
                    f"{path}: legs.{side}.pads: {pad} is not parallel to {names.legs[side].sole}"
                )
    if robot.has_floating_base and robot.imu.body() not in plant.GetBodiesWeldedTo(robot.base):
        raise InputError(
            f"{path}: imu: {names.imu} moves against {names.base}; expected a frame that is fixed "
            "to it"
        )
    return robot, scene_graph


def _add_model(plant: MultibodyPlant, names: RobotDescription, path: Path) -> tuple[str, ...]:
    """Adds what a description describes; what of its file could not be taken as it is, in words."""
    key, file = ("urdf", names.urdf) if names.urdf else ("directives", names.directives)
    source = path.parent / expandvars(file)
    if "$" in str(source):
        raise InputError(f"{key}: {file}: this environment variable is not set")
    if not source.is_file():
        raise InputError(f"{key}: {source}: no such file")
    parser = Parser(plant)
    try:
        if names.urdf:
            urdf = bare_urdf(source)
            parser.AddModelsFromString(urdf.text, "urdf")
            return urdf.remarks
        parser.package_map().AddPackageXml(str(path.parent / "package.xml"))
        ProcessModelDirectives(LoadModelDirectives(str(source)), parser)
        return ()
    # Drake's parsers say it in several ways; where they do not, SystemExit stands for an assertion.
    except (Exception, SystemExit) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{key}: {reason}") from None


def _add_frames(plant: MultibodyPlant, names: RobotDescription) -> None:
    for name, frame in names.frames.items():
        if not plant.HasBodyNamed(frame.body):
            raise InputError(f"frames.{name}.body: {_no_such(plant, 'body', frame.body)}")
        if plant.HasFrameNamed(name):
            raise InputError(f"frames.{name}: the model has a frame of this name already")
        body = plant.GetBodyByName(frame.body)
        X_BF = RigidTransform(RollPitchYaw(frame.rotation), frame.translation)
        plant.AddFrame(FixedOffsetFrame(name, body.body_frame(), X_BF, body.model_instance()))


def _no_such(plant: MultibodyPlant, kind: str, name: str) -> str:
    """That the model lacks something of this name, and the nearest names that it has."""
    known = {
        "body": lambda: (plant.get_body(k).name() for k in plant.GetBodyIndices(_MODEL)),
        "frame": lambda: (plant.get_frame(k).name() for k in plant.GetFrameIndices(_MODEL)),
        "joint": lambda: (plant.get_joint(k).name() for k in plant.GetJointIndices(_MODEL)),
    }[kind.split()[-1]]()
    names = sorted(known)
    near = get_close_matches(name, names, n=_NAMED, cutoff=0.0) if len(names) > _NAMED else names
    more = ", ..." if len(near) < len(names) else ""
    return f"the model has no {kind} called {name} (there are: {', '.join(near)}{more})"


def _moving_joints(plant: MultibodyPlant) -> list[Joint]:
    return [
        joint
        for joint in (plant.get_joint(index) for index in plant.GetJointIndices())
        if joint.num_velocities() > 0
    ]


def _is_carried(plant: MultibodyPlant, body: str) -> bool:
    """Has a joint this body as its child?"""
    return any(
        plant.get_joint(index).child_body().name() == body for index in plant.GetJointIndices()
    )


def _check_names(plant: MultibodyPlant, names: RobotDescription) -> None:
    def check(key: str, name: str, exists: bool, kind: str) -> None:
        if not exists:
            raise InputError(f"{key}: {_no_such(plant, kind, name)}")

    check("base", names.base, plant.HasBodyNamed(names.base), "body")
    if names.imu:
        check("imu", names.imu, plant.HasFrameNamed(names.imu), "frame")
    single = [
        joint.name()
        for joint in _moving_joints(plant)
        if joint.type_name() in (RevoluteJoint.kTypeName, PrismaticJoint.kTypeName)
    ]
    for side, leg in names.legs.items():
        for joint in leg.joints:
            check(f"legs.{side}.joints", joint, joint in single, "revolute or prismatic joint")
        check(f"legs.{side}.foot", leg.foot, plant.HasBodyNamed(leg.foot), "body")
        check(f"legs.{side}.sole", leg.sole, plant.HasFrameNamed(leg.sole), "frame")
        for pad in leg.pads:
            check(f"legs.{side}.pads", pad, plant.HasJointNamed(pad), "joint")
    for joint in names.joints:
        check("joints", joint, joint in single, "revolute or prismatic joint")
    for joint in names.held:
        if joint not in single or joint in names.joint_names:
            others = ", ".join(name for name in single if name not in names.joint_names) or "none"
            raise InputError(
                f"held.{joint}: expected a joint of the model that is not named elsewhere (there "
                f"are: {others})"
            )


def _hold_other_joints(plant: MultibodyPlant, names: RobotDescription) -> None:
    """Welds the joints that the description does not name."""
    others = [joint for joint in _moving_joints(plant) if joint.name() not in names.joint_names]
    idle = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    for actuator in idle:
        if actuator.joint() in others:
            plant.RemoveJointActuator(actuator)
    for joint in others:
        place = names.held.get(joint.name(), 0.0)
        if isinstance(joint, RevoluteJoint):
            X_FM = RigidTransform(AngleAxis(place, joint.revolute_axis()), np.zeros(3))
        elif isinstance(joint, PrismaticJoint):
            X_FM = RigidTransform(place * joint.translation_axis())
        else:
            raise InputError(
                f"joint {joint.name()} is {joint.type_name()}: expected only revolute and "
                "prismatic joints"
            )
        parent, child = joint.frame_on_parent(), joint.frame_on_child()
        plant.RemoveJoint(joint)
        plant.WeldFrames(parent, child, X_FM)


def _shift_joints(plant: MultibodyPlant, shifts: Mapping[str, np.ndarray]) -> None:
    """Moves joints in the frames of the bodies that carry them; they lose their actuators, which
    every named joint gets anyhow."""
    for name, shift in shifts.items():
        joint, body = plant.GetJointByName(name), plant.GetJointByName(name).parent_body()
        X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
        for index in plant.GetJointActuatorIndices():
            if plant.get_joint_actuator(index).joint() is joint:
                plant.RemoveJointActuator(plant.get_joint_actuator(index))
        moved = FixedOffsetFrame(
            _SHIFTED.format(name),
            body.body_frame(),
            RigidTransform(X_PF.rotation(), X_PF.translation() + shift),
            joint.model_instance(),
        )
        axis = (
            joint.revolute_axis() if isinstance(joint, RevoluteJoint) else joint.translation_axis()
        )
        again = type(joint)(
            name,
            plant.AddFrame(moved),
            joint.frame_on_child(),
            axis,
            joint.position_lower_limits()[0],
            joint.position_upper_limits()[0],
        )
        again.set_velocity_limits(joint.velocity_lower_limits(), joint.velocity_upper_limits())
        plant.RemoveJoint(joint)
        plant.AddJoint(again)


def _tilt_world(plant: MultibodyPlant, slope: Sequence[float] | np.ndarray) -> None:
    """Turns gravity as a world has it that is fixed to what a robot stands on."""
    field = plant.mutable_gravity_field()
    field.set_gravity_vector(gravity_on_slope(field.gravity_vector(), slope))


def _shift_imu(plant: MultibodyPlant, names: RobotDescription, shift: np.ndarray) -> None:
    """Adds the frame of an IMU that is moved in its own axes; see `Robot.imu`."""
    if shift.any():
        frame = plant.GetFrameByName(names.imu or names.base)
        plant.AddFrame(
            FixedOffsetFrame(_SHIFTED.format(frame.name()), frame, RigidTransform(shift))
        )


def _add_actuators(plant: MultibodyPlant, rotor_inertia: Mapping[str, float]) -> None:
    """Gives every named joint an actuator and its rotor inertia.

    Damping and limits of torque that the model file has are dropped: friction is an effect, and
    torque is limited by the controller.
    """
    actuators = _actuators(plant)
    for name, inertia in rotor_inertia.items():
        joint = plant.GetJointByName(name)
        actuator = actuators[name] if name in actuators else plant.AddJointActuator(name, joint)
        actuator.set_default_rotor_inertia(inertia)
        actuator.set_default_gear_ratio(1.0)
        actuator.set_effort_limit(np.inf)
        joint.set_default_damping(0.0)


def _actuators(plant: MultibodyPlant) -> dict[str, JointActuator]:
    """The first actuator of each joint that has any, by joint."""
    found = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    return {actuator.joint().name(): actuator for actuator in reversed(found)}


def _motors(plant: MultibodyPlant, joint_names: Sequence[str]) -> dict[str, JointActuator]:
    """The actuators that take commands, by joint: a joint's clamps come after."""
    actuators = _actuators(plant)
    return {name: actuators[name] for name in joint_names}


def _add_point_masses(
    plant: MultibodyPlant, names: RobotDescription, point_masses: Sequence[PointMass]
) -> None:
    instance = plant.GetBodyByName(names.base).model_instance()
    inertias: dict[str, SpatialInertia] = {}
    # One carrier for all that is added to a body, one for all that is taken away. What takes mass
    # away comes last: Drake does not add to a composite without mass.
    carried: dict[tuple[str, bool], SpatialInertia] = {}
    for point in sorted(point_masses, key=lambda point: -point.mass):
        if not plant.HasBodyNamed(point.body, instance):
            raise InputError(f"{point.body}: the model has no body of this name")
        body = plant.GetBodyByName(point.body, instance)
        added = point.inertia
        # A sum in place, but not in the body's own inertia.
        inertia = inertias.setdefault(point.body, copy(body.default_spatial_inertia()))
        if inertia.get_mass() + point.mass <= 0:
            raise InputError(
                f"{point.body}: expected a mass > 0, found {inertia.get_mass() + point.mass:g} kg"
            )
        inertia += added
        key = (point.body, point.mass < 0)
        if key in carried:
            carried[key] += added
        else:
            carried[key] = added
    for number, ((name, _), added) in enumerate(carried.items()):
        carrier = plant.AddRigidBody(f"{name}{_POINT_MASS}{number}", instance, added)
        plant.WeldFrames(plant.GetBodyByName(name, instance).body_frame(), carrier.body_frame())
    for name, inertia in inertias.items():
        if not inertia.IsPhysicallyValid():
            raise InputError(
                f"{name}: expected the inertia of a body, found one that no distribution of mass "
                "has"
            )


def _corner_joints(side: str, leg: Leg) -> list[str]:
    return [f"{side}_corner_{number}" for number in range(len(leg.corners))]


def _add_corners(plant: MultibodyPlant, side: str, leg: Leg, ground: Ground) -> None:
    """Lets a foot that has no pads meet the ground: each corner is a massless body, as the pads of
    other feet are."""
    properties = ProximityProperties()
    AddContactMaterial(
        properties=properties,
        friction=CoulombFriction(ground.friction, ground.friction),
        point_stiffness=_CORNER_STIFFNESS,
        dissipation=ground.dissipation,
    )
    sole = plant.GetFrameByName(leg.sole)
    for name, p_FC in zip(_corner_joints(side, leg), leg.corners, strict=True):
        corner = plant.AddRigidBody(name, sole.model_instance(), SpatialInertia.Zero())
        plant.AddJoint(WeldJoint(name, sole, corner.body_frame(), RigidTransform(p_FC)))
        plant.RegisterCollisionGeometry(
            corner, RigidTransform(), Sphere(_CORNER_RADIUS), name, properties
        )


def _add_ground(plant: MultibodyPlant, ground: Ground) -> None:
    size, thickness = 20.0, 1.0
    properties = ProximityProperties()
    AddContactMaterial(
        properties=properties,
        friction=CoulombFriction(ground.friction, ground.friction),
        point_stiffness=ground.stiffness,
        dissipation=ground.dissipation,
    )
    # Where each even part begins and ends in x, and its height.
    parts = [(-size / 2, size / 2, 0.0)]
    if (stairs := ground.stairs) is not None:
        edges = stairs.begin + stairs.depth * np.arange(stairs.count)
        if not -size / 2 < edges[0] <= edges[-1] < size / 2:
            raise InputError(
                f"stairs: expected them within {size / 2:g} m of the origin, found {edges[0]:g} to "
                f"{edges[-1]:g} m"
            )
        begins, ends = [-size / 2, *edges], [*edges, size / 2]
        parts = zip(begins, ends, stairs.rise * np.arange(stairs.count + 1), strict=True)
    for number, (begin, end, height) in enumerate(parts):
        name = f"ground_{number}" if number else "ground"
        X_WG = RigidTransform([(begin + end) / 2, 0.0, height - thickness / 2])
        shape = Box(end - begin, size, thickness)
        plant.RegisterCollisionGeometry(plant.world_body(), X_WG, shape, name, properties)
        color = np.array([0.86, 0.88, 0.9, 1.0])
        plant.RegisterVisualGeometry(plant.world_body(), X_WG, shape, name, color)
