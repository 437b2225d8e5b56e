"""Pushes: forces on bodies from outside, for a while, that no sensor measures."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, LeafSystem

from fbse_drake.errors import InputError, located, require_not_negative, require_positive
from fbse_drake.robot.plant import Robot
from fbse_drake.wiring import weakly

# What the plant's port takes.
Forces = Value[list[ExternallyAppliedSpatialForce]]
# Times are compared give or take this [s].
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Push:
    """A constant force at a body's centre of mass."""

    # Which body is pushed.
    body: str
    # In the world's axes [N].
    force: list[float]
    # When it begins, and how long it lasts [s].
    start: float
    duration: float

    def __post_init__(self) -> None:
        if len(self.force) != 3:
            raise InputError(f"force: expected three numbers, found {self.force}")
        require_not_negative(self, "start")
        require_positive(self, "duration")

    def acts_at(self, time: float) -> bool:
        """Does it act in a step that begins at this time [s]?"""
        return self.start - _ROUNDING <= time < self.start + self.duration - _ROUNDING


class AppliedPushes:
    """Pushes of a robot, with its bodies found.

    Raises:
        InputError: a body that the robot has not.
    """

    def __init__(self, pushes: Mapping[str, Push], robot: Robot):
        self._pushes: list[tuple[Push, RigidBody]] = []
        for name, push in pushes.items():
            with located(f"pushes.{name}.body: "):
                self._pushes.append((push, robot.body(push.body)))

    def forces(self, time: float) -> list[ExternallyAppliedSpatialForce]:
        """For the plant's port, in a step that begins at this time [s]."""
        forces = []
        for push, body in self._pushes:
            if push.acts_at(time):
                force = ExternallyAppliedSpatialForce()
                force.body_index = body.index()
                force.p_BoBq_B = body.default_com()
                F: Any = np.array([0.0, 0.0, 0.0, *push.force])
                force.F_Bq_W = SpatialForce(F=F)
                forces.append(force)
        return forces


class PushSource(LeafSystem):
    """Pushes a robot.

    .. pydrake_system::

        name: PushSource
        output_ports:
        - spatial_forces

    `spatial_forces` is a list of `ExternallyAppliedSpatialForce`, for the plant's port.
    """

    def __init__(self, pushes: AppliedPushes):
        super().__init__()
        self._pushes = pushes
        self.DeclareAbstractOutputPort(
            "spatial_forces", Forces, weakly(self._calc), {self.time_ticket()}
        )

    def _calc(self, context: Context, output: Value) -> None:
        output.set_value(self._pushes.forces(context.get_time()))
