import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from fbse_drake import InputError, Log
from fbse_drake.interop.convert import read_log
from fbse_drake.interop.export import write_csv, write_mcap
from fbse_drake.resources import folder
from fbse_drake.robot.plant import make_robot

WALK = ("paper_walk", "duration=1")
FIELDS = {"position": "position", "velocity": "velocity", "effort": "torque_command"}


@pytest.fixture
def log(run: Callable[..., Log]) -> Log:
    return run(*WALK)


@pytest.fixture
def bag(log: Log, tmp_path: Path) -> Path:
    write_mcap(log, tmp_path / "walk.mcap")
    return tmp_path / "walk.mcap"


def with_rosbags(path: Path) -> Iterator[tuple[str, int, Any]]:
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            yield connection.topic, time, reader.deserialize(raw, connection.msgtype)


def with_mcap(path: Path) -> Iterator[tuple[str, int, Any]]:
    """The container by `mcap`; types from the definitions that the file itself carries are checked
    by `with_rosbags`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert message.publish_time == message.log_time
            yield channel.topic, message.log_time, store.deserialize_cdr(message.data, schema.name)


@pytest.mark.parametrize("read", [with_rosbags, with_mcap])
def test_a_bag_is_read_back_equal(
    log: Log, bag: Path, read: Callable[[Path], Iterator[tuple[str, int, Any]]]
):
    topics: dict[str, list[Any]] = {}
    times: dict[str, list[int]] = {}
    for topic, time, message in read(bag):
        topics.setdefault(topic, []).append(message)
        times.setdefault(topic, []).append(time)
        if hasattr(message, "header"):
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time
    standard = {"/joint_states", "/imu", "/foot/left/wrench", "/foot/right/wrench"}
    others = set(log) - {"time", *(f"joint/{name}" for name in FIELDS.values())}
    others -= {"imu/angular_velocity", "imu/linear_acceleration"}
    once = {"/tf_static", "/robot_description"}
    assert set(topics) == standard | once | {"/tf"} | {f"/{name}" for name in others}
    assert [times[topic] for topic in once] == [[round(1e9 * log.time[0])]] * 2
    for name in ("reference/zmp", "truth/foot/left/pad_force", "truth/joint/friction_torque"):
        values = np.array([message.data for message in topics[f"/{name}"]])
        np.testing.assert_array_equal(values.reshape(log[name].shape), log[name])
    for stamps in (times[topic] for topic in set(times) - once):
        np.testing.assert_array_equal(stamps, np.rint(1e9 * log.time))
    states = topics["/joint_states"]
    assert all(state.name == log.joints for state in states)
    for field, channel in FIELDS.items():
        np.testing.assert_array_equal(
            [getattr(state, field) for state in states], log[f"joint/{channel}"]
        )
    for field in ("angular_velocity", "linear_acceleration"):
        np.testing.assert_array_equal(
            [vector(getattr(message, field)) for message in topics["/imu"]], log[f"imu/{field}"]
        )
    assert all(message.orientation_covariance[0] == -1 for message in topics["/imu"])
    for side in ("left", "right"):
        messages = topics[f"/foot/{side}/wrench"]
        assert {message.header.frame_id for message in messages} == {f"{side}_sole"}
        forces = log[f"foot/{side}/pad_force"]
        np.testing.assert_allclose(
            [vector(message.wrench.force) for message in messages], forces.sum(axis=1), atol=1e-12
        )
        for row in (0, len(log.time) // 2):
            # Each pad's force, moved to the sole frame by Drake.
            places = log.meta["pads"][side]
            pads = [
                SpatialForce(np.zeros(3), f).Shift(-np.array(p))
                for p, f in zip(places, forces[row], strict=True)
            ]
            np.testing.assert_allclose(
                vector(messages[row].wrench.torque),
                sum(pad.rotational() for pad in pads),
                atol=1e-12,
            )


def found_by(transforms: list[Any], names: list[str]) -> dict[str, RigidTransform]:
    """Poses of frames in the world, by going up from each one."""
    parents = {}
    for transform in transforms:
        p, q = transform.transform.translation, transform.transform.rotation
        X = RigidTransform(Quaternion(q.w, q.x, q.y, q.z), vector(p))
        parents[transform.child_frame_id] = (transform.header.frame_id, X)
    poses = {}
    for name in names:
        pose, parent = RigidTransform(), name
        while parent != "world":
            parent, X = parents[parent]
            pose = X @ pose
        poses[name] = pose
    return poses


@pytest.mark.parametrize("name", ["walk", "arm"])
def test_transforms_are_drakes_forward_kinematics(
    name: str, log: Log, run: Callable[..., Log], tmp_path: Path
):
    """On a floating base, and on one that is fixed; every link, sole and the IMU."""
    recorded = log if name == "walk" else run("bsc_arm", "duration=0.3")
    description = "biped" if name == "walk" else "arm"
    write_mcap(recorded, tmp_path / "log.mcap")
    messages = list(with_mcap(tmp_path / "log.mcap"))
    fixed = next(message for topic, _, message in messages if topic == "/tf_static").transforms
    moving = [message for topic, _, message in messages if topic == "/tf"]
    robot, _ = make_robot(description, gantry_height=None)
    plant, context = robot.plant, robot.plant.CreateDefaultContext()
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(robot.base.model_instance())]
    frames = {body.name(): body.body_frame() for body in bodies}
    frames |= {f"{side}_sole": robot.sole(side) for side in recorded.sides}
    frames |= {"imu": robot.imu} if recorded.sides else {}
    for row in (0, len(moving) // 2, len(moving) - 1):
        quaternion, place = np.array([1.0, 0, 0, 0]), np.zeros(3)
        if robot.has_floating_base:
            quaternion = recorded["truth/base/orientation"][row]
            place = recorded["truth/base/position"][row]
        X_WB = RigidTransform(Quaternion(quaternion / np.linalg.norm(quaternion)), place)
        q = recorded["truth/joint/position"][row]
        robot.set_state(context, q, np.zeros(len(q)), X_WB if robot.has_floating_base else None)
        found = found_by([*fixed, *moving[row].transforms], list(frames))
        for frame, pose in found.items():
            known = frames[frame].CalcPoseInWorld(context)
            assert pose.IsNearlyEqualTo(known, 1e-12), frame
        stamps = {
            t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in moving[row].transforms
        }
        assert stamps == {round(1e9 * recorded.time[row])}


def test_the_robots_description_is_its_model_with_shapes(bag: Path):
    text = next(m.data for topic, _, m in with_mcap(bag) if topic == "/robot_description")
    known, _ = make_robot("biped")
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(text, "urdf")
    plant.Finalize()
    mass = plant.CalcTotalMass(plant.CreateDefaultContext())
    assert mass == pytest.approx(known.plant.CalcTotalMass(known.plant.CreateDefaultContext()))
    assert plant.num_actuated_dofs() == len(known.joint_names)
    shapes = sum(len(link.findall("visual")) for link in ElementTree.fromstring(text).iter("link"))
    shipped = ElementTree.parse(folder("models") / "biped.urdf")
    assert shapes == sum(len(link.findall("visual")) for link in shipped.iter("link")) > 10


def test_a_layout_names_topics_that_are_there_and_is_not_replaced(bag: Path):
    beside = bag.with_suffix(".layout.json")
    layout = json.loads(beside.read_text())
    with bag.open("rb") as file:
        summary = make_reader(file).get_summary()
    topics = {channel.topic for channel in summary.channels.values()}
    panels = layout["configById"]
    plots = [panel for name, panel in panels.items() if name.startswith("Plot!")]
    named = {line["value"].partition(".")[0] for panel in plots for line in panel["paths"]}
    named |= {layer["topic"] for layer in panels["3D!robot"]["layers"].values()}
    assert named <= topics
    assert len(plots) == 4

    def leaves(tree: Any) -> list[str]:
        return [tree] if isinstance(tree, str) else leaves(tree["first"]) + leaves(tree["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    beside.write_text("mine")
    write_mcap(read_log(bag), bag)
    assert beside.read_text() == "mine"


def test_a_log_of_an_unknown_robot_has_no_frames(log: Log, tmp_path: Path):
    """No scenario, one of a robot that is not there, or with code, which must not run."""
    code = tmp_path / "effect.py"
    code.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    scenario = log.meta["scenario"]
    texts = (
        "",
        scenario.replace("description: biped", "description: nobody"),
        scenario.replace("  description: biped", f"  description: {code}")
        + f"  effect_modules: [{code}]\n",
    )
    for text in texts:
        write_mcap(Log(log.channels, {**log.meta, "scenario": text}), tmp_path / "log.mcap")
        topics = {topic for topic, _, _ in with_mcap(tmp_path / "log.mcap")}
        assert not topics & {"/tf", "/tf_static", "/robot_description"}
    assert not (tmp_path / "ran").exists()


def vector(message: Any) -> list[float]:
    return [message.x, message.y, message.z]


def test_a_log_survives_the_bag(log: Log, bag: Path):
    again = read_log(bag)
    assert set(again) == set(log)
    np.testing.assert_allclose(again.time, log.time, rtol=0, atol=1e-12)
    for name in set(log) - {"time"}:
        np.testing.assert_array_equal(again[name], log[name], err_msg=name)
    assert again.meta == log.meta


def test_the_topics_say_their_units(bag: Path):
    with bag.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    units = {channel.topic: channel.metadata for channel in summary.channels.values()}
    assert units["/joint_states"] == {"position": "rad", "velocity": "rad/s", "effort": "Nm"}
    assert units["/truth/foot/left/pad_force"] == {"data": "N"}
    assert units["/reference/com/velocity"] == {"data": "m/s"}


def test_what_was_not_measured_is_not_written(tmp_path: Path):
    channels = {
        "time": np.array([0.0, 0.1]),
        "joint/position": np.array([[1.0], [2.0]]),
        "foot/left/wrench": np.ones((2, 6)),
    }
    write_mcap(
        Log(channels, {"joints": ["slide"], "sides": ["left"], "period": 0.1}),
        tmp_path / "log.mcap",
    )
    messages = list(with_rosbags(tmp_path / "log.mcap"))
    assert [topic for topic, _, _ in messages] == ["/joint_states", "/foot/left/wrench"] * 2
    state = messages[0][2]
    assert (state.position.tolist(), state.velocity.size, state.effort.size) == ([1.0], 0, 0)
    assert set(read_log(tmp_path / "log.mcap")) == set(channels)


def test_numbers_of_a_log_may_be_written_as_texts(tmp_path: Path):
    channels = {"time": np.array([0.0, 0.1]), "joint/position": np.zeros((2, 1))}
    channels["foot/left/pad_force"] = np.array([[[0.0, 0.0, 2.0]]] * 2)
    texts = {"period": "1e-1", "pads": {"left": [["0.1", "0", "0"]]}}
    texts["segments"] = [{"file": "a", "start": "0", "end": "0.1"}]
    log = Log(channels, {"joints": ["slide"], "sides": ["left"]} | texts)
    assert log.meta["period"] == 0.1
    assert log.meta["segments"] == [{"file": "a", "start": 0.0, "end": 0.1}]
    write_mcap(log, tmp_path / "log.mcap")
    topic = "/foot/left/wrench"
    wrenches = [m.wrench for name, _, m in with_mcap(tmp_path / "log.mcap") if name == topic]
    np.testing.assert_allclose(vector(wrenches[0].torque), [0, -0.2, 0])


def test_logs_that_cannot_be_messages_get_one_line(tmp_path: Path, log: Log):
    with pytest.raises(InputError, match=r"channel foot/left/pad_force: meta has no pads for it"):
        write_mcap(
            Log(log.channels, {key: value for key, value in log.meta.items() if key != "pads"}),
            tmp_path / "log.mcap",
        )
    early = log.channels | {"time": log.time - 5.0}
    with pytest.raises(
        InputError, match="messages cannot have times before 0; this log begins at -5 s"
    ):
        write_mcap(Log(early, log.meta), tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []


def test_messages_are_made_piece_by_piece(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("fbse_drake.interop.export._BLOCK", 300)
    write_mcap(log, tmp_path / "log.mcap")
    np.testing.assert_array_equal(
        read_log(tmp_path / "log.mcap")["joint/torque_command"], log["joint/torque_command"]
    )


def test_the_same_log_gives_the_same_bytes(log: Log, bag: Path, tmp_path: Path):
    write_mcap(log, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == bag.read_bytes()


def test_csv_has_a_column_for_every_number(log: Log, tmp_path: Path):
    write_csv(log, tmp_path / "log.csv")
    table = np.genfromtxt(
        tmp_path / "log.csv", delimiter=",", names=True, deletechars="", replace_space="_"
    )
    assert len(table) == len(log.time)
    assert len(table.dtype.names) == sum(values[0].size for values in log.values())
    np.testing.assert_array_equal(
        table["joint/torque_command/left_knee_pitch"], log["joint/torque_command"][:, 3]
    )
    np.testing.assert_array_equal(
        table["foot/right/pad_force[4]"], log["foot/right/pad_force"][:, 1, 1]
    )
