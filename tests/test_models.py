"""A completed model as URDF and MJCF: who loads it gets our inverse dynamics."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces

from fbse_drake import InputError
from fbse_drake.effects.actuation import TorqueDelay
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.friction import CoulombFriction, CoulombViscousFriction, ViscousFriction
from fbse_drake.effects.geometry import LinkLength
from fbse_drake.effects.inertia import BodyMass, Payload, ReflectedInertia
from fbse_drake.interop.models import links_of, write_mjcf, write_urdf
from fbse_drake.scenario import RobotConfig, build_robot

FRICTION: dict[str, Effect] = {
    "viscous": ViscousFriction(viscous={"all": 0.3}),
    "coulomb": CoulombFriction(coulomb={"all": 0.2}),
}
LEGS = RobotConfig(
    "strider",
    rotor_inertia={"all": 0.05},
    effects={
        **FRICTION,
        "both": CoulombViscousFriction(coulomb={"all": 0.1}, viscous={"l_knee": 0.5}),
        "rotor": ReflectedInertia(inertia={"r_knee": 0.1}),
        "mass": BodyMass(mass={"torso": -0.7}),
        "load": Payload(mass={"l_tibia": 0.4}, x={"l_tibia": 0.03}, y={"l_tibia": 0.02}, z={}),
        "longer": LinkLength(length={"l_femur": 0.01}),
        "late": TorqueDelay(delay={"all": 0.002}),
    },
)
PENDULUM = RobotConfig("double_pendulum", rotor_inertia={"all": 0.01}, effects=FRICTION)
HANGING = RobotConfig(LEGS.description, 1.2, LEGS.rotor_inertia, LEGS.effects)

Torques = Callable[[dict[str, float], dict[str, float], dict[str, float]], dict[str, float]]


def in_plant(plant: MultibodyPlant) -> Torques:
    """Inverse dynamics of joints by name, of whatever else moves at rest."""

    def torques(q: dict, v: dict, a: dict) -> dict[str, float]:
        context = plant.CreateDefaultContext()
        positions = plant.GetPositions(context)
        velocities, acceleration = np.zeros((2, plant.num_velocities()))
        for name in q:
            joint = plant.GetJointByName(name)
            positions[joint.position_start()] = q[name]
            velocities[joint.velocity_start()] = v[name]
            acceleration[joint.velocity_start()] = a[name]
        plant.SetPositions(context, positions)
        plant.SetVelocities(context, velocities)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        tau = plant.CalcInverseDynamics(context, acceleration, forces)
        return {name: tau[plant.GetJointByName(name).velocity_start()] for name in q}

    return torques


def ours(config: RobotConfig) -> Torques:
    """Of the project's plant, with the viscous friction of its effects."""
    bare = in_plant(build_robot(config).plant)

    def torques(q: dict, v: dict, a: dict) -> dict[str, float]:
        viscous = {name: 0.3 + 0.5 * (name == "l_knee") for name in q}
        return {name: tau + viscous[name] * v[name] for name, tau in bare(q, v, a).items()}

    return torques


def in_drake(config: RobotConfig, folder: Path) -> Torques:
    write_urdf(config, folder / "model.urdf")
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(folder / "model.urdf"))
    plant.Finalize()
    return in_plant(plant)


def in_mujoco(config: RobotConfig, folder: Path) -> Torques:
    mujoco = pytest.importorskip("mujoco")
    write_mjcf(config, folder / "model.xml")
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    # Friction is a constraint there, which inverse dynamics solves by its own law.
    model.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT

    def torques(q: dict, v: dict, a: dict) -> dict[str, float]:
        data = mujoco.MjData(model)
        dofs = {name: model.joint(name).dofadr[0] for name in q}
        for name, dof in dofs.items():
            data.qpos[model.joint(name).qposadr[0]] = q[name]
            data.qvel[dof], data.qacc[dof] = v[name], a[name]
        mujoco.mj_inverse(model, data)
        return {name: data.qfrc_inverse[dof] for name, dof in dofs.items()}

    return torques


@pytest.mark.parametrize(
    ("config", "load"),
    [
        (HANGING, in_drake),
        (LEGS, in_drake),
        (PENDULUM, in_drake),
        (HANGING, in_mujoco),
        (PENDULUM, in_mujoco),
    ],
)
def test_inverse_dynamics_is_ours(
    config: RobotConfig, load: Callable[[RobotConfig, Path], Torques], tmp_path: Path
):
    names, random = build_robot(config).joint_names, np.random.default_rng(0)
    expected, loaded = ours(config), load(config, tmp_path)
    for _ in range(5):
        q, v, a = (
            dict(zip(names, size * random.standard_normal(len(names)), strict=True))
            for size in (0.3, 1.0, 5.0)
        )
        before, after = expected(q, v, a), loaded(q, v, a)
        np.testing.assert_allclose(
            list(after.values()), list(before.values()), rtol=1e-9, atol=1e-9
        )


def test_what_a_file_cannot_say_stands_in_a_comment(tmp_path: Path):
    assert links_of(LEGS)[1] == ["late: Torque delay"]
    for write in (write_urdf, write_mjcf):
        write(LEGS, tmp_path / "model.xml")
        assert "late: Torque delay" in (tmp_path / "model.xml").read_text()


def test_friction_has_its_tags(tmp_path: Path):
    write_urdf(LEGS, tmp_path / "model.urdf")
    write_mjcf(LEGS, tmp_path / "model.xml")
    assert 'damping="0.8" friction="0.30000000000000004"' in (tmp_path / "model.urdf").read_text()
    mjcf = (tmp_path / "model.xml").read_text()
    assert 'armature="0.15000000000000002" damping="0.3" frictionloss="0.3000' in mjcf


def test_an_unknown_body_is_refused(tmp_path: Path):
    config = RobotConfig("pendulum", effects={"mass": BodyMass(mass={"trunk": 1.0})})
    with pytest.raises(InputError, match="trunk: the model has no body of this name"):
        write_urdf(config, tmp_path / "model.urdf")
    assert not list(tmp_path.iterdir())
