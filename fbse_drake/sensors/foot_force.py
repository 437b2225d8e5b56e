"""Three-axis force sensors under the feet."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import GeometryId, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from fbse_drake.errors import InputError
from fbse_drake.robot.plant import Robot, pad_geometries
from fbse_drake.sensors.noise import white_noise


@dataclass(frozen=True)
class FootForceConfig:
    """Errors of each axis of each pad; all 0 measures exactly."""

    # Standard deviation of white noise [N].
    noise: float = 0.0
    # Largest force in either direction [N].
    range: float = 5000.0
    # Sampling period [s].
    period: float = 0.001

    def __post_init__(self) -> None:
        if self.noise < 0:
            raise InputError(f"noise: expected a number >= 0, found {self.noise:g}")
        for name in ("range", "period"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected a number > 0, found {getattr(self, name):g}")


class FootForceSensors(LeafSystem):
    """Measures the force of the ground on each pad, in the axes of its sole frame.

    .. pydrake_system::

        name: FootForceSensors
        input_ports:
        - contact_results
        - body_poses
        output_ports:
        - true_pad_force
        - measured_pad_force

    Both outputs hold, side by side and pad by pad in the description's order, three components [N]. The force is that of the plant's
    last step, turned by the foot's present attitude.
    """

    def __init__(self, config: FootForceConfig, robot: Robot, scene_graph: SceneGraph, seed: int):
        super().__init__()
        self._config, self._seed = config, seed
        plant = robot.plant
        pads = pad_geometries(robot, scene_graph)
        self._row: dict[GeometryId, int] = {pad: i for i, pad in enumerate(p for side in pads.values() for p in side)}
        self._feet, row = [], 0
        for side, leg in robot.description.legs.items():
            R_FootF = robot.sole(side).GetFixedRotationMatrixInBodyFrame().matrix()
            self._feet.append((int(plant.GetBodyByName(leg.foot).index()), R_FootF, slice(row, row + len(pads[side]))))
            row += len(pads[side])
        self._size = 3 * row
        self._contact_results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._body_poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        self._true = self.DeclareVectorOutputPort("true_pad_force", self._size, self._calc_true, {self.all_input_ports_ticket()})
        sources = {self.all_input_ports_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort("measured_pad_force", self._size, self._calc_measured, sources)

    def _calc_true(self, context: Context, output: BasicVector) -> None:
        results = self._contact_results.Eval(context)
        force_W = np.zeros((len(self._row), 3))
        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            pair = info.point_pair()
            # The contact force is the one on body B.
            if pair.id_B in self._row:
                force_W[self._row[pair.id_B]] += info.contact_force()
            elif pair.id_A in self._row:
                force_W[self._row[pair.id_A]] -= info.contact_force()
        poses = self._body_poses.Eval(context)
        for body, R_FootF, rows in self._feet:
            force_W[rows] = force_W[rows] @ poses[body].rotation().matrix() @ R_FootF
        output.SetFromVector(force_W.ravel())

    def _calc_measured(self, context: Context, output: BasicVector) -> None:
        force = self._true.Eval(context)
        if self._config.noise > 0:
            noise = white_noise(self._seed, "foot_force", self._size, context.get_time(), self._config.period)
            force = force + self._config.noise * noise
        output.SetFromVector(np.minimum(np.maximum(force, -self._config.range), self._config.range))
