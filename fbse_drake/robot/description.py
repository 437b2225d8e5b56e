"""What the project must know of a robot beyond its model file: names of its base, legs, feet and sensors."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fbse_drake import resources, schema
from fbse_drake.errors import InputError


@dataclass(frozen=True)
class Leg:
    """One leg: model names from hip to foot."""

    joints: list[str]
    # Body that carries the sole and the force sensors.
    foot: str
    # Frame: z up, origin on the ground when the foot is flat.
    sole: str
    # Fixed joints that hold the foot's pads: 3-axis force sensors, parallel to the sole frame.
    pads: list[str]


@dataclass(frozen=True)
class RobotDescription:
    """Names of a legged robot's parts in its model; read from YAML by `load_description`."""

    # Drake model directives, relative to the description's file.
    directives: str
    base: str
    imu: str
    # What the joints of every leg are called in a scenario, from hip to foot.
    leg_joints: list[str]
    legs: dict[str, Leg]

    def __post_init__(self) -> None:
        for side, leg in self.legs.items():
            if len(leg.joints) != len(self.leg_joints):
                raise InputError(f"legs.{side}.joints: expected {len(self.leg_joints)} names as in leg_joints, found {len(leg.joints)}")

    @property
    def joint_names(self) -> list[str]:
        """Model names of all joints, in the order of every joint vector and log column."""
        return [name for leg in self.legs.values() for name in leg.joints]

    @property
    def sides(self) -> list[str]:
        return list(self.legs)

    def per_joint(self, values: Mapping[str, float], *, key: str, default: float | None = None) -> np.ndarray:
        """A value for each joint, shape (n,), from `{all: ..., <leg joint>: ..., <joint>: ...}`; the more special key wins.

        Raises:
            InputError: unknown joint, or (without a default) a joint that has no value.
        """
        allowed = ["all", *self.leg_joints, *self.joint_names]
        for name in values:
            if name not in allowed:
                raise InputError(f"{key}.{name}: unknown joint (allowed: {', '.join(allowed)})")
        result = []
        for leg in self.legs.values():
            for role, joint in zip(self.leg_joints, leg.joints, strict=True):
                value = values.get(joint, values.get(role, values.get("all", default)))
                if value is None:
                    raise InputError(f"{key}: no value for {joint} (give {joint}, {role} or all)")
                result.append(value)
        return np.array(result, dtype=float)


def load_description(name_or_path: str | Path) -> tuple[RobotDescription, Path]:
    """Reads a robot description; returns it with the path of its file.

    Raises:
        InputError: file not found, unknown key or wrong type.
    """
    path = resources.find(name_or_path, kind="models")
    return schema.build(RobotDescription, schema.load_tree(path), file=str(path)), path
