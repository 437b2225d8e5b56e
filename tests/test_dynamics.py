"""What depends on what in a plant."""

import numpy as np
import pytest

from fbse_drake.robot.dynamics import PlantDynamics, path
from fbse_drake.robot.plant import make_robot


@pytest.mark.parametrize("name", ["biped", "hexapod", "strider"])
def test_nothing_but_its_path_moves_a_sole(name: str):
    """To the last bit: what is computed for one state of its path is that of all others."""
    robot, _ = make_robot(name)
    plant, dynamics, random = robot.plant, PlantDynamics(robot.plant), np.random.default_rng(1)
    q = plant.GetPositions(plant.CreateDefaultContext())
    state = np.concatenate([q, random.normal(size=plant.num_velocities())])
    joints = np.setdiff1d(np.arange(len(state)), range(7))
    moves = 0
    for side in robot.description.sides:
        sole = robot.sole(side)
        on_path = path(plant, sole)
        columns = np.append(on_path.positions, len(q) + on_path.velocities)
        for column in joints:
            moved = state.copy()
            moved[column] += 0.1
            same_J, same_bias = (
                np.array_equal(*dynamics.evaluated([quantity], np.array([state, moved]))[0])
                for quantity in (dynamics.jacobian(sole), dynamics.bias_acceleration(sole))
            )
            if column in columns:
                moves += not same_bias
            else:
                assert same_J
                assert same_bias
        assert len(on_path.velocities) == 6 + len(robot.joint_names) / len(robot.description.sides)
    # A turning of the sole about the joint that it is nearest to is not seen by some of them.
    assert moves > len(robot.joint_names)
