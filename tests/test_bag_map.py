"""`fbse init --recording`: what the topics of a bag mean for a robot."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore
from test_convert import ROS2, imu, joint_state, wrench, write_bag

from fbse_drake import InputError, init_robot
from fbse_drake.interop.bag_map import propose_map
from fbse_drake.interop.convert import convert
from fbse_drake.interop.mapping import load_map
from fbse_drake.resources import folder
from fbse_drake.robot.description import load_description

ROBOT = load_description("quadruped")[0]
ROWS = 6
STAMPS = [1_700_000_000_000_000_000 + 10_000_000 * row for row in range(ROWS)]
# As they are called on the robot, which names its joints in an order of its own.
NAMES = [f"{name.title().replace('_', '')}_joint" for name in reversed(ROBOT.joint_names)]
Q = np.arange(ROWS)[:, None] + 0.01 * np.arange(len(NAMES))
FEET = {
    "front_left": "/contact/FL/wrench",
    "front_right": "/contact/FR/wrench",
    "rear_left": "/contact/LH/wrench",
    "rear_right": "/force/hind_right",
}


def messages(names=NAMES, feet=FEET, imus=(("/imu/data", "imu"),), types=ROS2.types):
    """What a robot says at each of the stamps."""
    found = []
    for row, stamp in enumerate(STAMPS):
        state = joint_state(stamp, names, Q[row, : len(names)], -Q[row, : len(names)], types=types)
        found.append(("/robot/joints", stamp, state))
        for topic, frame in imus:
            message = imu(stamp, [row, 0, 0], [0, 0, 9.81], types=types)
            message.header.frame_id = frame
            found.append((topic, stamp, message))
        for number, topic in enumerate(feet.values()):
            found.append((topic, stamp, wrench(stamp, [0, 0, 10 * number + row], [0, 0, 0], types)))
    return found


@pytest.mark.parametrize("kind", [*StoragePlugin, "ros 1"])
def test_the_proposed_map_makes_a_log_of_the_bag(kind, tmp_path: Path):
    if kind == "ros 1":
        path, store = tmp_path / "log.bag", get_typestore(Stores.ROS1_NOETIC)
        with Ros1Writer(path) as writer:
            topics = {}
            for topic, stamp, message in messages(types=store.types):
                name = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, name, typestore=store)
                writer.write(topics[topic], stamp, store.serialize_ros1(message, name))
    else:
        path = write_bag(tmp_path / "bag", messages(), kind)
    log_map, remarks = propose_map(path, ROBOT)
    assert remarks == []
    text = init_robot._bag_map_text(log_map, path)
    (tmp_path / "map.yaml").write_text(text)
    log = convert([path], load_map(tmp_path / "map.yaml"))
    assert log.joints == ROBOT.joint_names
    np.testing.assert_array_equal(log["joint/position"], Q[:, ::-1])
    np.testing.assert_array_equal(log["joint/torque_command"], -Q[:, ::-1])
    np.testing.assert_array_equal(log["imu/angular_velocity"][:, 0], np.arange(ROWS))
    for number, side in enumerate(FEET):
        np.testing.assert_array_equal(
            log[f"foot/{side}/wrench"][:, 5], 10 * number + np.arange(ROWS)
        )


def test_what_a_bag_does_not_tell_is_said(tmp_path: Path):
    feet = {"a": "/contact/FL/wrench", "b": "/contact/FL/wrench_raw", "c": "/wrench/arm"}
    imus = (("/head/imu", "head"), ("/base/imu", "trunk_imu"))
    bag = write_bag(tmp_path / "bag", messages(NAMES[1:], feet, imus))
    log_map, remarks = propose_map(bag, ROBOT)
    assert log_map.joints == ROBOT.joint_names[:-1]
    assert not [name for name in log_map.channels if name.startswith("foot/")]
    said = "\n".join(remarks)
    assert "/robot/joints does not name rear_right_knee: " in said
    assert "The IMU is taken from /head/imu, not from /base/imu." in said
    assert "/head/imu measures in frame head, the description's IMU is imu" in said
    assert "several wrenches of the front left foot" in said
    assert "no wrench of the rear left foot by its name: none." in said
    assert "not mapped: /contact/FL/wrench, /contact/FL/wrench_raw, /wrench/arm." in said


def test_the_imu_is_the_one_in_the_robots_frame(tmp_path: Path):
    imus = (("/head/imu", "head"), ("/base/imu", "imu"))
    log_map, _ = propose_map(write_bag(tmp_path / "bag", messages(imus=imus)), ROBOT)
    assert log_map.channels["imu/angular_velocity"].topic == "/base/imu"


def test_a_bag_of_another_robot_gets_one_line(tmp_path: Path):
    bag = write_bag(tmp_path / "bag", messages(["elbow", "wrist"], {}, ()))
    with pytest.raises(InputError, match=r"no message names a joint of the robot .*: elbow, wrist"):
        propose_map(bag, ROBOT)
    (tmp_path / "log.csv").write_text("a,b\n")
    with pytest.raises(InputError, match=r"log\.csv: expected a bag"):
        propose_map(tmp_path / "log.csv", ROBOT)
    with pytest.raises(InputError, match="names a joint"):
        init_robot.init_robot(folder("models") / "pendulum.urdf", tmp_path / "mine", recording=bag)
    assert not list((tmp_path / "mine").iterdir())
