"""A log and the models that were simulated in its place, moving side by side in one page.

The page is Meshcat's: it needs no network, plays, stops and steps, and each robot can be switched
off in its controls.
"""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    Capsule,
    GeometryInstance,
    IllustrationProperties,
    MakePhongIllustrationProperties,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
    RoleAssign,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import DiagramBuilder

from fbse_drake.discrepancy.diagnosis.study import Study
from fbse_drake.files import write_text
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import Scenario, build_robot
from fbse_drake.wiring import release

# Of the page.
_FRAMES_PER_SECOND = 32.0
# Colours and how solid they are, red, green, blue, alpha, in the order of the motions.
_COLORS = ((0.35, 0.38, 0.42, 1.0), (0.84, 0.37, 0.10, 0.45), (0.04, 0.48, 0.53, 0.45))
# Where the camera stands, seen from the middle of the robot, in multiples of its size.
_CAMERA = np.array([1.3, -1.6, 0.5])
# Limbs of a robot whose model has no shapes are so thick as a share of its longest.
_THICKNESS = 0.06
_SHORTEST = 1e-3


@dataclass(frozen=True, eq=False)
class Motion:
    """What one robot did at N times."""

    # Shape (N,) [s]; joint positions (N, n) [rad or m].
    time: np.ndarray
    joint_position: np.ndarray
    # Quaternions [w, x, y, z] from base to world (N, 4), and its place (N, 3) [m]; None of a base
    # that is fixed.
    base_orientation: np.ndarray | None = None
    base_position: np.ndarray | None = None

    def at(self, time: float) -> tuple[np.ndarray, RigidTransform | None]:
        """Joint positions (n,) and pose of the base at the last sample until a time [s], or at the
        first."""
        row = max(int(np.searchsorted(self.time, time + 1e-9)) - 1, 0)
        if self.base_orientation is None or self.base_position is None:
            return self.joint_position[row], None
        quaternion = self.base_orientation[row] / np.linalg.norm(self.base_orientation[row])
        X_WB = RigidTransform(Quaternion(quaternion), self.base_position[row])
        return self.joint_position[row], X_WB


def study_motions(study: Study, log: Log) -> dict[str, Motion]:
    """What the log's robot did, the model as given and the completed one; empty where a study has
    simulated nothing, or nobody knows where a floating base was.

    A base that the log says nothing of moves as the completed model's.

    Args:
        log: that the study is of.
    """
    simulated = {
        "model as given": study.steps[0].rollout,
        "completed model": study.steps[-1].rollout,
    }
    motions = {}
    for name, error in simulated.items():
        if error is None or not len(error.sample_time):
            return {}
        rows = np.searchsorted(log.time, error.sample_time - 1e-9)
        joints = log["joint/position"][rows] + error.position_error
        motions[name] = Motion(
            error.sample_time, joints, error.base_orientation, error.base_position
        )
    recorded = Motion(log.time, log["joint/position"], *_base_of(log))
    if recorded.base_position is None:
        last = motions["completed model"]
        rows = np.searchsorted(log.time, last.time - 1e-9)
        base = (last.base_orientation, last.base_position)
        recorded = Motion(last.time, log["joint/position"][rows], *base)
    return {"log": recorded, **motions}


def _base_of(log: Log) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Orientation and place of the base, as far as a log knows them."""
    for kind in ("truth", "estimate"):
        if f"{kind}/base/orientation" in log and f"{kind}/base/position" in log:
            return log[f"{kind}/base/orientation"], log[f"{kind}/base/position"]
    return None, None


def write_replay(path: str | Path, scenario: Scenario, motions: Mapping[str, Motion]) -> None:
    """Writes the motions as one HTML page, in one time.

    Args:
        scenario: whose model is drawn.
        motions: by what they are called; up to three.
    """
    begin = min(motion.time[0] for motion in motions.values())
    end = max(motion.time[-1] for motion in motions.values())
    times = np.arange(begin, end + 1e-9, 1 / _FRAMES_PER_SECOND)
    with _quiet():
        meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
        _look_at(meshcat, scenario, next(iter(motions.values())))
        meshcat.StartRecording(_FRAMES_PER_SECOND, set_visualizations_while_recording=False)
        for (name, motion), color in zip(motions.items(), _COLORS, strict=False):
            _record(meshcat, scenario, name, motion, Rgba(*color), times)
        meshcat.StopRecording()
        meshcat.PublishRecording()
    write_text(Path(path), meshcat.StaticHtml())


def _look_at(meshcat: Meshcat, scenario: Scenario, motion: Motion) -> None:
    """Places the camera so that all of the robot is seen where it starts."""
    robot = build_robot(scenario.believed)
    context, (q, X_WB) = robot.plant.CreateDefaultContext(), motion.at(motion.time[0])
    robot.set_state(context, q, np.zeros_like(q), X_WB if robot.has_floating_base else None)
    ends = np.array([link.EvalPoseInWorld(context) @ end for link, end in _limbs(robot)])
    middle, size = (ends.max(axis=0) + ends.min(axis=0)) / 2, np.ptp(ends, axis=0).max()
    meshcat.SetCameraPose(middle + max(size, 0.1) * _CAMERA, middle)


@contextmanager
def _quiet() -> Iterator[None]:
    """Drake tells its log of every page, and of colours."""
    drake = logging.getLogger("drake")
    level = drake.level
    drake.setLevel(logging.ERROR)
    try:
        yield
    finally:
        drake.setLevel(level)


def _record(
    meshcat: Meshcat,
    scenario: Scenario,
    name: str,
    motion: Motion,
    color: Rgba,
    times: np.ndarray,
) -> None:
    builder = DiagramBuilder()
    robot = build_robot(scenario.believed, builder=builder, plant=scenario.plant)
    scene_graph = builder.GetSubsystemByName("scene_graph")
    assert isinstance(scene_graph, SceneGraph)
    _paint(scene_graph, robot, color)
    parameters = MeshcatVisualizerParams(prefix=name, delete_on_initialization_event=False)
    shapes = scene_graph.GetOutputPort("query")
    MeshcatVisualizer.AddToBuilder(builder, shapes, meshcat, parameters)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = robot.plant.GetMyMutableContextFromRoot(context)
    still = np.zeros(len(robot.joint_names))
    for time in times:
        q, X_WB = motion.at(time)
        context.SetTime(time - times[0])
        robot.set_state(plant_context, q, still, X_WB if robot.has_floating_base else None)
        diagram.ForcedPublish(context)
    release(diagram)


def _paint(scene_graph: SceneGraph, robot: Robot, color: Rgba) -> None:
    """Gives all that is drawn of a robot one colour; limbs, where its model has no shapes."""
    source = robot.plant.get_source_id()
    assert source is not None
    drawn = scene_graph.model_inspector().GetAllGeometryIds(Role.kIllustration)
    for geometry in drawn:
        properties = IllustrationProperties()
        properties.AddProperty("phong", "diffuse", color)
        scene_graph.AssignRole(source, geometry, properties, RoleAssign.kReplace)
    if drawn:
        return
    limbs = _limbs(robot)
    longest = max((float(np.linalg.norm(limb)) for _, limb in limbs), default=0.0)
    radius = _THICKNESS * (longest or 1.0)
    for number, (body, limb) in enumerate(limbs):
        length, X_BL = float(np.linalg.norm(limb)), RigidTransform()
        shape: Capsule | Sphere = Sphere(radius)
        if length > _SHORTEST:
            along = RotationMatrix.MakeFromOneVector(limb / length, 2)  # type: ignore[arg-type]
            X_BL = RigidTransform(along, limb / 2)  # type: ignore[arg-type]
            shape = Capsule(radius / 2, length)
        instance = GeometryInstance(X_BL, shape, f"limb_{number}")
        instance.set_illustration_properties(MakePhongIllustrationProperties(color.rgba))
        frame = robot.plant.GetBodyFrameIdOrThrow(body.index())
        scene_graph.RegisterGeometry(source, frame, instance)


def _limbs(robot: Robot) -> list[tuple[RigidBody, np.ndarray]]:
    """From the origin of each link to each joint that it carries, (3,) [m] in the link's frame; of
    one that carries none, its centre of mass."""
    plant = robot.plant
    limbs: list[tuple[RigidBody, np.ndarray]] = []
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    context = plant.CreateDefaultContext()
    for joint in joints:
        link = joint.child_body()
        carried = [
            other.frame_on_parent().CalcPose(context, link.body_frame()).translation()
            for other in joints
            if other.parent_body().index() == link.index()
        ]
        ends = carried or [link.CalcCenterOfMassInBodyFrame(context)]
        limbs += [(link, np.asarray(end)) for end in ends]
    return limbs
