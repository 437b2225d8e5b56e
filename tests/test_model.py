from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.geometry import Box, Role
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder

from fbse_drake import InputError, resources
from fbse_drake.robot.plant import make_robot


@pytest.fixture(scope="module")
def biped():
    builder = DiagramBuilder()
    robot, scene_graph = make_robot(
        "biped", builder=builder, config=MultibodyPlantConfig(time_step=1e-3)
    )
    return robot, scene_graph


def test_every_inertia_is_that_of_its_box(biped):
    robot, scene_graph = biped
    inspector, context = scene_graph.model_inspector(), robot.plant.CreateDefaultContext()
    boxes = 0
    for index in robot.plant.GetBodyIndices(robot.plant.GetModelInstanceByName("robot")):
        body = robot.plant.get_body(index)
        for geometry in inspector.GetGeometries(
            robot.plant.GetBodyFrameIdOrThrow(index), Role.kIllustration
        ):
            shape = inspector.GetShape(geometry)
            if not isinstance(shape, Box):
                continue
            boxes += 1
            x, y, z = shape.size()
            mass = body.get_mass(context)
            central = body.CalcSpatialInertiaInBodyFrame(context).Shift(
                body.CalcCenterOfMassInBodyFrame(context)
            )
            expected = mass / 12 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
            np.testing.assert_allclose(
                central.CalcRotationalInertia().CopyToFullMatrix3(), expected, rtol=1e-6, atol=1e-9
            )
            np.testing.assert_allclose(
                body.CalcCenterOfMassInBodyFrame(context),
                inspector.GetPoseInFrame(geometry).translation(),
                atol=1e-12,
            )
    assert boxes == 13


def test_masses_and_frames_are_the_documented_ones(biped):
    robot, _ = biped
    context = robot.plant.CreateDefaultContext()
    assert robot.plant.CalcTotalMass(context) == pytest.approx(87.0)
    np.testing.assert_allclose(
        robot.imu.CalcPose(context, robot.base.body_frame()).translation(), [0.01, -0.01, 0.02]
    )
    for side in robot.description.sides:
        np.testing.assert_allclose(
            np.abs(robot.pad_positions(side)), np.tile([0.11, 0.05, 0.0], (4, 1)), atol=1e-12
        )


def test_rotor_inertia_adds_to_the_joint_and_nothing_else():
    plain, _ = make_robot("biped")
    geared, _ = make_robot(
        "biped", rotor_inertia={"all": 0.1, "knee_pitch": 0.3, "left_hip_yaw": 0.5}
    )
    difference = geared.plant.CalcMassMatrix(
        geared.plant.CreateDefaultContext()
    ) - plain.plant.CalcMassMatrix(plain.plant.CreateDefaultContext())
    expected = np.zeros(18)
    expected[geared.velocity_index] = [0.5, 0.1, 0.1, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1, 0.3, 0.1, 0.1]
    np.testing.assert_allclose(difference, np.diag(expected), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": "torso"}, r"base: the model has no body called torso"),
        ({"imu": "imu2"}, r"imu: the model has no frame called imu2"),
        (
            {"leg_joints": ["hip"]},
            r"legs\.left\.joints: expected 1 names as in leg_joints, found 6",
        ),
        ({"directives": "none.dmd.yaml"}, r"directives: "),
        ({"feet": 2}, r"feet: unknown key"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(tmp_path: Path, change: dict, message: str):
    folder = resources.folder("models")
    for name in ("biped.urdf", "biped.dmd.yaml", "package.xml"):
        (tmp_path / name).write_text((folder / name).read_text())
    description = yaml.safe_load((folder / "biped.yaml").read_text()) | change
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(description))
    with pytest.raises(InputError, match=message):
        make_robot(path)
