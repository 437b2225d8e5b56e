"""Makes a robot ready to be simulated: description, scenario and recording map from a URDF."""

import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure

from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.errors import InputError
from fbse_drake.files import write_atomically, write_text
from fbse_drake.interop.bag_map import propose_map
from fbse_drake.interop.mapping import LogMap
from fbse_drake.log import Log
from fbse_drake.report.robot_figure import robot_figure
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot, make_robot
from fbse_drake.robot.proposal import propose
from fbse_drake.scenario import load_scenario
from fbse_drake.simulation import simulate
from fbse_drake.walking.reference import Reference, make_reference
from fbse_drake.walking.stand import Squat

# How far below its height with straight legs the centre of mass is tried to stand.
_HEIGHTS = np.arange(0.98, 0.7, -0.02)
# The same of one on point feet, of its height in the posture in which it is proposed to stand.
_SHARES = np.arange(1.02, 0.8, -0.04)
# One deeper than the highest that is possible leaves the knees room to move.
_DEEPER = 0.02
# Amplitude of the squat over the height of the centre of mass; how often and how long.
_AMPLITUDE, _FREQUENCY, _DURATION = 0.02, 0.5, 4.0
# Position gain over what a joint that carries the whole robot like a pendulum needs to hold it.
_STIFFNESS = 7.0
# The motors' rotors make a joint as fast as this with that gain [rad/s]; damping over gain [s].
_BANDWIDTH, _DAMPING = 160.0, 0.007
# Torque limit over what holds the whole robot like that; where that is less, the usual one will do.
_STRENGTH = 4.0
# Amplitude and frequency of joints that swing [rad or m], [Hz]; and the most of a joint's range.
_SWING, _SWING_FREQUENCY, _SWING_SHARE = 0.1, 0.5, 0.4
# Joints that are further from their plan do not follow it [rad or m].
_FOLLOWS = 0.01


@dataclass(frozen=True)
class Made:
    """What was written, and what was found out."""

    description: Path
    scenario: Path
    log_map: Path
    picture: Path
    # In words; and what speaks against the robot as it is.
    remarks: list[str]
    problems: list[str]


def init_robot(
    urdf: Path, out: Path | None = None, *, name: str | None = None, recording: Path | None = None
) -> Made:
    """Proposes description, scenario and recording map of a robot, writes and tries them.

    Args:
        urdf: the robot's URDF.
        out: the folder that they are written to, which is made if need be; by default one that is
            called like the robot.
        name: what the robot is called; by default as the URDF's file.
        recording: a bag, for whose topics the map is made; by default it is one of a table.

    Raises:
        InputError: no URDF, a foot that cannot be found, a description that exists already, or a
            bag that cannot be read or names no joint of the robot.
    """
    name = name or urdf.stem
    if not re.fullmatch(r"[A-Za-z0-9][\w-]*", name):
        raise InputError(f"--name {name}: expected letters, digits, _ and -")
    folder = out or Path(name)
    folder.mkdir(parents=True, exist_ok=True)
    description = folder / f"{name}.yaml"
    if description.exists():
        raise InputError(f"{description}: this exists already, and may have been edited")
    proposal = propose(urdf, _path_from(urdf, folder))
    write_text(description, _description_text(proposal.description, name, proposal.remarks))
    try:
        robot, _ = make_robot(description)
        map_text = _map_text(robot)
        about_map: list[str] = []
        if recording is not None:
            log_map, about_map = propose_map(recording, robot.description)
            map_text = _bag_map_text(log_map, recording)
        legged = bool(proposal.description.legs)
        stands = _standing(robot) if legged else None
        text = _squat(robot, name, stands) if stands else _swing(robot, name)
        posture = stands[1].joint_position[0] if stands else np.zeros(len(robot.joint_names))
    except BaseException:
        description.unlink()
        raise
    scenario = folder / f"{name}_{'squat' if stands else 'swing'}.yaml"
    write_text(scenario, text)
    map_path = folder / f"{name}.map.yaml"
    write_text(map_path, map_text)
    figure = robot_figure(robot, posture)
    picture = folder / f"{name}.png"
    write_atomically(picture, lambda partial: _save(figure, partial))
    remarks, problems = _tried(scenario, robot)
    said = [*proposal.remarks, *about_map, *remarks]
    return Made(description, scenario, map_path, picture, said, problems)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, format="png", dpi=120)


def _path_from(urdf: Path, folder: Path) -> str:
    """How a file in the folder names the URDF: by its place from there, if that is near."""
    relative = os.path.relpath(urdf.resolve(), folder.resolve())
    return relative if relative.count("..") < 3 else str(urdf.resolve())


def _standing(robot: Robot) -> tuple[Squat, Reference] | None:
    """A squat that the robot can do, and its motion.

    Raises:
        InputError: the legs do not reach the ground from any height, or their joints' limits
            forbid it; says what is in the way at the last one that was tried.
    """
    context = robot.plant.CreateDefaultContext()
    names = robot.description
    robot.set_joint_positions(context, names.per_joint(names.stance, key="stance", default=0.0))
    soles = {
        side: robot.sole(side).CalcPose(context, robot.base.body_frame()).translation()
        for side in robot.description.sides
    }
    com = robot.plant.CalcCenterOfMassPositionInWorld(context)
    base = robot.plant.EvalBodyPoseInWorld(context, robot.base).translation()
    places = np.array(list(soles.values()))
    height = float((com - base)[2] - places[:, 2].min())
    pads = {side: robot.pad_positions(side) for side in soles}
    x = np.concatenate([soles[side][0] + pads[side][:, 0] for side in soles])
    on_points = any(leg.is_point for leg in robot.description.legs.values())
    extent = np.ptp(places, axis=0)
    if on_points:
        # Below the hips, wherever the centre of mass is between them.
        forward, margin, shares = float((com - base)[0] - x.mean()), 0.2 * extent[:2].min(), _SHARES
    else:
        centres = [pad[:, 0] for pad in pads.values()]
        forward = float(np.mean([0.5 * (x.min() + x.max()) for x in centres]))
        margin, shares = 0.2 * min(float(np.ptp(x)) for x in centres), _HEIGHTS
    squat = Squat(
        amplitude=round(_AMPLITUDE * height, 4),
        frequency=_FREQUENCY,
        ramp=1.0,
        foot_spacing=round(float(extent[1]), 4),
        wheelbase=round(float(extent[0]), 4) if on_points else 0.0,
        zmp_forward=round(forward, 4),
        zmp_margin=round(float(margin), 4),
    )
    time = np.arange(0.0, _DURATION, 0.05)
    reason: InputError | None = None
    for share in shares:
        higher, lower = (
            replace(squat, com_height=round(height * float(s), 3)) for s in (share, share - _DEEPER)
        )
        try:
            make_reference(higher, robot, time)
            return lower, make_reference(lower, robot, time)
        except InputError as error:
            reason = error
    raise InputError(f"the robot cannot stand with level feet: {reason}")


@dataclass(frozen=True)
class _Drives:
    """Position loops, motors and gears that are strong enough for a robot."""

    # By joint, as in a scenario [Nm/rad], or [N/m] of a prismatic joint.
    stiffness: dict[str, float]
    # Largest torque [Nm] or force [N] of all; None where the usual one will do.
    limit: float | None

    @staticmethod
    def of(robot: Robot, arm: float) -> "_Drives":
        """
        Args:
            arm: how far the robot's weight reaches [m].
        """
        gravity = float(np.linalg.norm(robot.plant.gravity_field().gravity_vector()))
        weight = robot.total_mass * gravity
        sliding = [
            joint
            for joint, unit in zip(robot.joint_names, robot.torque_units, strict=True)
            if unit == "N"
        ]
        # What turns a joint by an angle moves the weight by that times the arm.
        needed = {"all": weight * arm} | dict.fromkeys(sliding, weight / arm)
        limit = _round(_STRENGTH * (max(weight, weight * arm) if sliding else weight * arm))
        return _Drives(
            {joint: _round(_STIFFNESS * gain) for joint, gain in needed.items()},
            limit if limit > PositionLoopConfig().torque_limit["all"] else None,
        )

    @property
    def control(self) -> str:
        """As in a scenario."""
        damping = {joint: _DAMPING * gain for joint, gain in self.stiffness.items()}
        limit = f", torque_limit: {_by_joint({'all': self.limit})}" if self.limit else ""
        return f"{{kp: {_by_joint(self.stiffness)}, kd: {_by_joint(damping)}{limit}}}"

    @property
    def rotor_inertia(self) -> str:
        """As in a scenario."""
        return _by_joint({joint: gain / _BANDWIDTH**2 for joint, gain in self.stiffness.items()})


def _round(value: float) -> float:
    return float(f"{value:.1e}")


def _by_joint(values: dict[str, float]) -> str:
    """Numbers by joint as YAML on one line."""
    tree = {joint: float(f"{value:.3g}") for joint, value in values.items()}
    return yaml.safe_dump(tree, default_flow_style=True, width=1000, sort_keys=False).strip()


_SCENARIO = """\
# Made by fbse init: {what}. Try it: fbse simulate {file}
# Then hide something in it, and find it: fbse hide {file} --seed 1 --out mystery
{name}:
  title: {title}
  duration: {duration:g}
  reference: {reference}
  robot: &robot
    description: {robot}.yaml{hanging}
    # Of motors and gears, as they act on the joints [kg m^2], [kg] where a joint slides. A guess:
    # put in those of your drives.
    rotor_inertia: {inertia}
    # What really acts in the robot; `fbse list effects` says what there is.
    effects: {{}}
  # What is believed of it: here all.
  model: *robot
  # For recordings of the machine itself: reference: !Recorded {{}}, and where torques are sampled
  # with the angles and not held over a row, recording: {{rows: instantaneous}}.
  # Noise of usual sensors, standard deviations of a sample.
  sensors:
    encoders: {{resolution: 4.8e-5, velocity_noise: 5.0e-4}}
    imu: {{acceleration_noise: 0.02, angular_velocity_noise: 1.0e-3}}
    foot_force: {{noise: 0.5, moment_noise: 0.02}}
  # Of the position loops [Nm/rad], [Nms/rad]. A guess from the robot's weight.
  control: {control}
"""


def _squat(robot: Robot, name: str, stands: tuple[Squat, Reference]) -> str:
    squat, _ = stands
    words = ", ".join(
        f"{key}: {getattr(squat, key):g}"
        for key in (
            "amplitude",
            "frequency",
            "ramp",
            "com_height",
            "foot_spacing",
            "wheelbase",
            "zmp_forward",
            "zmp_margin",
        )
    )
    return _scenario(
        name,
        "squat",
        _Drives.of(robot, squat.com_height),
        what="all feet stand, the body goes up and down",
        title=f"{name} squats.",
        reference=f"!Squat {{{words}}}",
        hanging="",
    )


def _swing(robot: Robot, name: str) -> str:
    """Every joint swings about the middle of its range, or about 0 if that is inside."""
    joints = [robot.plant.GetJointByName(joint) for joint in robot.joint_names]
    limits = {
        j.name(): (float(j.position_lower_limits()[0]), float(j.position_upper_limits()[0]))
        for j in joints
    }
    swing = {
        joint: min(_SWING, _SWING_SHARE * (high - low)) for joint, (low, high) in limits.items()
    }
    posture = {
        joint: round(0.5 * (low + high), 4)
        for joint, (low, high) in limits.items()
        if not low + swing[joint] < 0.0 < high - swing[joint]
    }
    narrow = {joint: _round(most) for joint, most in swing.items() if most < _SWING}
    reach = _reach(robot)
    reference = yaml.safe_dump(
        {
            "posture": posture,
            "amplitude": {"all": _SWING} | narrow,
            "frequency": {"all": _SWING_FREQUENCY},
        },
        default_flow_style=True,
        width=1000,
    ).strip()
    return _scenario(
        name,
        "swing",
        _Drives.of(robot, max(0.5 * reach, 0.1)),
        what="the base is held, every joint swings",
        title=f"{name} swings its joints; its base is held.",
        reference=f"!JointSines {reference}",
        hanging="" if robot.description.fixed_base else f"\n    gantry_height: {2 * reach:.2f}",
    )


def _reach(robot: Robot) -> float:
    """How far links and their centres of mass are from the base in the zero posture [m]."""
    plant, context = robot.plant, robot.plant.CreateDefaultContext()
    bodies = [plant.get_body(k) for k in plant.GetBodyIndices(robot.base.model_instance())]
    origin = plant.EvalBodyPoseInWorld(context, robot.base).translation()
    places = [
        plant.EvalBodyPoseInWorld(context, body) @ place
        for body in bodies
        for place in (np.zeros(3), body.CalcCenterOfMassInBodyFrame(context))
    ]
    return max(float(np.linalg.norm(place - origin)) for place in places)


def _scenario(robot: str, motion: str, drives: _Drives, **words: str) -> str:
    """A scenario file of a robot with these drives."""
    return _SCENARIO.format(
        file=f"{robot}_{motion}.yaml",
        name=f"{robot}_{motion}",
        robot=robot,
        duration=_DURATION,
        inertia=drives.rotor_inertia,
        control=drives.control,
        **words,
    )


def _tried(path: Path, robot: Robot) -> tuple[list[str], list[str]]:
    """What the scenario shows, and what goes wrong in it."""
    try:
        run = simulate(load_scenario(path))
    except InputError as error:
        return [], [f"it cannot be simulated: {error}"]
    if run.failure is not None:
        return [], [run.failure]
    tracking = run.metrics["joint_tracking_rms"]
    worst = max(tracking, key=lambda joint: tracking[joint])
    units = dict(zip(robot.joint_names, robot.position_units, strict=True))
    off = f"{1e3 * tracking[worst]:.2g} m{units[worst]} rms ({worst})"
    if tracking[worst] > _FOLLOWS:
        return [], [f"it does not follow its plan but misses it by {off}: see its `control`"]
    remarks = [f"It follows its plan within {off}."]
    if run.log.sides:
        remarks.append(_weight_text(run.log))
    return remarks, []


def _weight_text(log: Log) -> str:
    forces = {side: log[f"truth/foot/{side}/pad_force"][1:, :, 2] for side in log.sides}
    loads = {side: force.sum(axis=1).mean() for side, force in forces.items()}
    return "It stands: " + ", ".join(
        f"{load:.0f} N on the {side.replace('_', ' ')} foot" for side, load in loads.items()
    )


def _description_text(description: RobotDescription, name: str, remarks: list[str]) -> str:
    tree = _given(asdict(description))
    # Names from the URDF cannot end a comment.
    lines = [f"# {name}, as fbse init proposes it."]
    lines += [f"# {' '.join(remark.split())}" for remark in remarks]
    body = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=100)
    return "\n".join([*lines, body])


def _given(value: Any) -> Any:
    """Without what says nothing."""
    if not isinstance(value, dict):
        return value
    content = {key: _given(item) for key, item in value.items()}
    return {key: item for key, item in content.items() if item not in ("", [], {}, False)}


_MAP_HEADER = """\
# What the columns of a recording mean; rename them, and take out what yours has not.
# A bag with standard messages needs no map. Use: fbse convert run.csv run.npz --map FILE
"""


def _map_text(robot: Robot) -> str:
    """A map of a table with a column for each number."""
    joints = robot.joint_names
    turns, moves = (set(units) for units in (robot.torque_units, robot.position_units))

    def channel(kind: str, names: Sequence[str], unit: str) -> dict[str, Any]:
        columns = {"columns": [f"{kind}_{name}" for name in names]}
        return columns | {"unit": unit} if unit else columns

    def shared(units: set[str], per: str = "") -> str:
        """Unit of all joints; nothing, which is SI, where they have not the same."""
        return f"{min(units)}{per}" if len(units) == 1 else ""

    channels = {
        "joint/position": channel("position", joints, shared(moves)),
        "joint/velocity": channel("velocity", joints, shared(moves, "/s")),
        "joint/torque_command": channel("torque", joints, shared(turns)),
    }
    if robot.description.legs:
        channels["imu/linear_acceleration"] = channel("acc", "xyz", "m/s^2")
        channels["imu/angular_velocity"] = channel("gyro", "xyz", "rad/s")
    three = ("fx", "fy", "fz")
    for side, leg in robot.description.legs.items():
        kind, axes = (
            ("pad_force", three) if leg.is_point else ("wrench", ("mx", "my", "mz", *three))
        )
        channels[f"foot/{side}/{kind}"] = {"columns": [f"{side}_{axis}" for axis in axes]}
    tree = {
        "joints": joints,
        "time": {"column": "time", "unit": "s"},
        "channels": channels,
    }
    return _MAP_HEADER + yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=100)


def _bag_map_text(log_map: LogMap, recording: Path) -> str:
    name = " ".join(recording.name.split())
    tree = {
        "joints": log_map.joints,
        "recorded_joints": log_map.recorded_joints,
        "topics": log_map.topics,
        "channels": {key: {"topic": channel.topic} for key, channel in log_map.channels.items()},
    }
    body = yaml.safe_dump(_given(tree), sort_keys=False, default_flow_style=None, width=100)
    return f"# What the topics of {name} mean. Use: fbse convert BAG run.npz --map FILE\n{body}"
