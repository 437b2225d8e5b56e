"""Many instants at once against Drake, one by one."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from fbse_drake.effects.inertia import BodyCentreOfMass, BodyMass
from fbse_drake.robot.body_tree import BodyTree, OneByOne, dynamics_of
from fbse_drake.scenario import build_robot, load_scenario

# A slider that carries a body on an oblique axis, all frames shifted and turned against each other;
# {joint} stands for more of the second joint.
MACHINE = """
<robot name="machine">
  <link name="rail">{inertia}</link>
  <link name="cart">{inertia}</link>
  <link name="crank">{inertia}</link>
  <link name="tool">{inertia}</link>
  <joint name="fixed" type="fixed">
    <parent link="world"/><child link="rail"/><origin xyz="0.1 0.2 0.3" rpy="0.3 -0.2 0.5"/>
  </joint>
  <joint name="slide" type="prismatic">
    <parent link="rail"/><child link="cart"/><origin xyz="-0.1 0 0.4" rpy="0.1 0.7 -0.5"/>
    <axis xyz="0.6 0 0.8"/>
  </joint>
  <joint name="turn" type="continuous">
    <parent link="cart"/><child link="crank"/><origin xyz="0 0.3 -0.2" rpy="-0.4 0.2 0.1"/>
    <axis xyz="0 0.6 0.8"/>{joint}
  </joint>
  <joint name="grasp" type="fixed">
    <parent link="crank"/><child link="tool"/><origin xyz="0.2 0.1 0.5" rpy="1 0.2 -0.3"/>
  </joint>
  <transmission><type>transmission_interface/SimpleTransmission</type><joint name="turn"/>
    <actuator name="turn"/><drake:rotor_inertia value="0.02"/><drake:gear_ratio value="5"/>
  </transmission>
</robot>
"""
INERTIA = """
<inertial><origin xyz="0.05 -0.1 0.2" rpy="0.2 0.1 0.4"/><mass value="1.5"/>
<inertia ixx="0.1" iyy="0.12" izz="0.09" ixy="0.01" ixz="-0.02" iyz="0.005"/></inertial>
"""


def machine(joint: str = "") -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    text = MACHINE.replace("{inertia}", INERTIA).replace("{joint}", joint)
    Parser(plant).AddModelsFromString(text, "urdf")
    plant.Finalize()
    return plant


def walker() -> MultibodyPlant:
    return build_robot(load_scenario("paper_walk").believed).plant


def arm() -> MultibodyPlant:
    return build_robot(load_scenario("bsc_arm").believed).plant


def changed() -> MultibodyPlant:
    """With point masses of less than nothing."""
    changes = {
        "lighter": BodyMass({"trunk": -3.0}),
        "shifted": BodyCentreOfMass(*({"trunk": c} for c in (0.03, -0.02, 0.05))),
    }
    return build_robot(replace(load_scenario("paper_walk").believed, effects=changes)).plant


def random_motion(plant: MultibodyPlant) -> tuple[np.ndarray, np.ndarray]:
    """States and accelerations."""
    random = np.random.default_rng(0)
    q = random.standard_normal((20, plant.num_positions()))
    for body in plant.GetFloatingBaseBodies():
        first = plant.get_body(body).floating_positions_start()
        q[:, first : first + 4] /= np.linalg.norm(q[:, first : first + 4], axis=1)[:, None]
    v, v_dot = random.standard_normal((2, 20, plant.num_velocities()))
    return np.hstack([q, v]), v_dot


@pytest.mark.parametrize("make", [machine, walker, arm, changed])
def test_many_instants_at_once_are_those_of_drake_one_by_one(make):
    plant = make()
    tree, drake = dynamics_of(plant), OneByOne(plant)
    assert isinstance(tree, BodyTree)
    states, v_dot = random_motion(plant)
    for forces in (False, True):
        found, right = (d.inverse_dynamics(states, v_dot, forces=forces) for d in (tree, drake))
        np.testing.assert_allclose(found, right, rtol=1e-9, atol=1e-9)
    instances = map(ModelInstanceIndex, range(plant.num_model_instances()))
    frames = [plant.get_frame(index) for one in instances for index in plant.GetFrameIndices(one)]
    positions = states[:, : plant.num_positions()]
    found, right = (d.jacobians(frames, positions) for d in (tree, drake))
    np.testing.assert_allclose(found, right, rtol=0, atol=1e-12)
    found, right = (d.bias_accelerations(frames, states) for d in (tree, drake))
    for one, other in zip(found, right, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10)


def test_what_damps_a_joint_is_left_to_drake():
    plant = machine(joint='<dynamics damping="2.0"/>')
    states, v_dot = random_motion(plant)
    damped, free = (
        dynamics_of(one).inverse_dynamics(states, v_dot, forces=True) for one in (plant, machine())
    )
    velocity = states[:, plant.num_positions() :]
    np.testing.assert_allclose(damped - free, velocity * [0.0, 2.0], rtol=0, atol=1e-9)
