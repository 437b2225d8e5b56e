"""What the project must know of a robot beyond its model file: names of its base, legs, feet and
sensors."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from fbse_drake import resources, schema
from fbse_drake.errors import InputError

# So many descriptions are kept as they were read: a robot is built again and again.
_PARSED = 8


@dataclass(frozen=True)
class Leg:
    """One leg: model names from hip to foot."""

    joints: list[str]
    # Body that carries the sole and the force sensors.
    foot: str
    # Frame: z up, origin on the ground when the foot is flat. Of a point foot: in the point, z up
    # as it mostly stands.
    sole: str
    # A foot with 3-axis force sensors: the fixed joints that hold its pads, parallel to the sole
    # frame. One alone makes a point foot, which may turn while it stands.
    pads: list[str] = field(default_factory=list)
    # A foot with a six-axis sensor instead: where it meets the ground, points in the sole
    # frame [m]. One alone, the origin, makes a point foot with a three-axis sensor.
    corners: list[list[float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if bool(self.pads) == bool(self.corners):
            raise InputError(
                "pads: expected either these (3-axis force sensors) or corners (of a foot with a "
                "six-axis sensor)"
            )
        for point in self.corners:
            if len(point) != 3:
                raise InputError(f"corners: expected points of three coordinates, found {point}")
        if len(self.corners) == 1:
            if np.any(self.corners[0]):
                raise InputError(
                    "corners: expected the origin, [0, 0, 0], as the only one of a point foot, "
                    f"found {self.corners[0]}"
                )
        elif self.corners and np.linalg.matrix_rank(np.diff(self.corners, axis=0), tol=1e-4) < 2:
            raise InputError("corners: expected at least three points that are not in one line")

    @property
    def points(self) -> int:
        """At how many places the ground's force is known."""
        return len(self.pads) or len(self.corners)

    @property
    def has_six_axes(self) -> bool:
        """Is its sensor one of six axes, rather than one of three at each point?"""
        return len(self.corners) > 1

    @property
    def is_point(self) -> bool:
        """Does it touch the ground in one point?"""
        return self.points == 1


@dataclass(frozen=True)
class AddedFrame:
    """A frame that the model lacks, fixed to a body of it."""

    body: str
    # Of its origin, in the body's frame [m].
    translation: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Roll, pitch and yaw against the body's frame [rad].
    rotation: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        for key in ("translation", "rotation"):
            if len(getattr(self, key)) != 3:
                raise InputError(f"{key}: expected three numbers, found {getattr(self, key)}")


@dataclass(frozen=True)
class RobotDescription:
    """Names of a robot's parts in its model; read from YAML by `load_description`.

    A robot has legs, further joints, or both. Joints of the model that are not named are held where
    `held` says.
    """

    # Root of the robot: floats unless `fixed_base` is true or a scenario hangs it in a gantry.
    base: str
    # The model: Drake model directives, or a URDF whose shapes are not needed. Relative to the
    # description's file; may begin with an environment variable, as
    # ${FBSE_DATA_DIR}/ur10/ur10_robot.urdf.
    directives: str = ""
    urdf: str = ""
    fixed_base: bool = False
    # Frame in whose axes the IMU measures; by default that of the base.
    imu: str = ""
    # What the joints of every leg are called in a scenario, from hip to foot.
    leg_joints: list[str] = field(default_factory=list)
    legs: dict[str, Leg] = field(default_factory=dict)
    # Further joints: of arms, of a torso, of a machine that has no legs.
    joints: list[str] = field(default_factory=list)
    # Those of all these joints that no motor moves: their torques are zero, whatever a log says.
    passive: list[str] = field(default_factory=list)
    # Angles near which the legs stand [rad], by joint or by what it is called in `leg_joints`: they
    # say which way knees bend. By default the middle of the joints' ranges.
    stance: dict[str, float] = field(default_factory=dict)
    # Angles [rad] (or places [m]) of joints that are not named above; 0 by default.
    held: dict[str, float] = field(default_factory=dict)
    # Frames that the model lacks, by name, as those of soles.
    frames: dict[str, AddedFrame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if bool(self.directives) == bool(self.urdf):
            raise InputError("expected either directives or urdf")
        for side, leg in self.legs.items():
            if len(leg.joints) != len(self.leg_joints):
                raise InputError(
                    f"legs.{side}.joints: expected {len(self.leg_joints)} names as in leg_joints, "
                    f"found {len(leg.joints)}"
                )
        twice = [name for name, count in Counter(self.joint_names).items() if count > 1]
        if twice:
            raise InputError(f"joints: {twice[0]} is named twice")
        if not self.joint_names:
            raise InputError("expected legs, joints or both, found neither")
        for joint in self.passive:
            if joint not in self.joint_names:
                raise InputError(
                    f"passive: unknown joint {joint} (allowed: {', '.join(self.joint_names)})"
                )

    @cached_property
    def joint_names(self) -> list[str]:
        """Model names of all joints, in the order of every joint vector and log column: leg by leg,
        then the further ones."""
        return [*(name for leg in self.legs.values() for name in leg.joints), *self.joints]

    @cached_property
    def roles(self) -> list[str]:
        """What each joint is called in a scenario beside its name: a joint of a leg as in
        `leg_joints`."""
        return [*(role for _ in self.legs for role in self.leg_joints), *self.joints]

    @cached_property
    def has_motor(self) -> np.ndarray:
        """Which joints a motor moves, (n,) bool."""
        return np.array([joint not in self.passive for joint in self.joint_names])

    @property
    def sides(self) -> list[str]:
        return list(self.legs)

    def counterparts(self, joint: str) -> tuple[str, ...]:
        """The same joint of every leg; a further joint has itself alone."""
        role = self.roles[self.joint_names.index(joint)]
        return tuple(
            name for name, other in zip(self.joint_names, self.roles, strict=True) if other == role
        )

    def per_joint(
        self, values: Mapping[str, float], *, key: str, default: float | None = None
    ) -> np.ndarray:
        """A value for each joint, shape (n,), from `{all: ..., <leg joint>: ..., <joint>: ...}`;
        the more special key wins.

        Raises:
            InputError: unknown joint, or (without a default) a joint that has no value.
        """
        allowed = dict.fromkeys(["all", *self.leg_joints, *self.joint_names])
        for name in values:
            if name not in allowed:
                raise InputError(f"{key}.{name}: unknown joint (allowed: {', '.join(allowed)})")
        result = []
        for joint, role in zip(self.joint_names, self.roles, strict=True):
            value = values.get(joint, values.get(role, values.get("all", default)))
            if value is None:
                keys = " or ".join(", ".join(dict.fromkeys([joint, role, "all"])).rsplit(", ", 1))
                raise InputError(f"{key}: no value for {joint} (give {keys})")
            result.append(value)
        return np.array(result, dtype=float)


def load_description(name_or_path: str | Path) -> tuple[RobotDescription, Path]:
    """Reads a robot description; returns it with the path of its file.

    Raises:
        InputError: file not found, unknown key or wrong type.
    """
    path = resources.find(name_or_path, kind="models")
    return _parsed(schema.read_text(path), str(path)), path


@lru_cache(maxsize=_PARSED)
def _parsed(text: str, file: str) -> RobotDescription:
    return schema.build(RobotDescription, schema.parse_mapping(text, file=file), file=file)
