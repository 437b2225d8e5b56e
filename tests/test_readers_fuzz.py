"""Whatever bytes a file has: it is read, or there is one line about it."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from fbse_drake import InputError, Log
from fbse_drake.interop.convert import convert
from fbse_drake.interop.mapping import ChannelMap, LogMap

MAP = LogMap(
    joints=["a"],
    channels={
        "joint/position": ChannelMap(columns=["q"]),
        "joint/torque_command": ChannelMap(columns=["tau"]),
    },
)
ROWS = 6


def columns() -> dict[str, np.ndarray]:
    return {
        "time": 0.1 * np.arange(ROWS),
        "q": np.arange(1.0, ROWS + 1),
        "tau": np.linspace(-1, 1, ROWS),
    }


def joint_states(types: dict[str, Any]) -> list[tuple[int, Any]]:
    stamps = [10**9 + 10**8 * row for row in range(ROWS)]
    sequence = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__annotations__ else {}
    headers = [
        types["std_msgs/msg/Header"](
            **sequence,
            stamp=types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)),
            frame_id="",
        )
        for stamp in stamps
    ]
    numbers = [np.array([float(row)]) for row in range(ROWS)]
    states = [
        types["sensor_msgs/msg/JointState"](header, ["a"], x, x, x)
        for header, x in zip(headers, numbers, strict=True)
    ]
    return list(zip(stamps, states, strict=True))


def ros2(folder: Path, plugin: StoragePlugin) -> bytes:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Ros2Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection(
            "/joint_states", "sensor_msgs/msg/JointState", typestore=store
        )
        for stamp, message in joint_states(store.types):
            writer.write(connection, stamp, store.serialize_cdr(message, message.__msgtype__))
    return next(path for path in (folder / "bag").iterdir() if path.suffix != ".yaml").read_bytes()


def ros1(folder: Path) -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(folder / "log.bag") as writer:
        connection = writer.add_connection(
            "/joint_states", "sensor_msgs/msg/JointState", typestore=store
        )
        for stamp, message in joint_states(store.types):
            writer.write(connection, stamp, store.serialize_ros1(message, message.__msgtype__))
    return (folder / "log.bag").read_bytes()


def matlab_7(folder: Path) -> bytes:
    with h5py.File(folder / "log.mat", "w") as file:
        for name, values in columns().items():
            file[name] = values[None, :]
    return (folder / "log.mat").read_bytes()


def saved(folder: Path, kind: str) -> bytes:
    path = folder / f"log.{kind}"
    if kind == "csv":
        np.savetxt(
            path,
            np.column_stack(list(columns().values())),
            delimiter=",",
            header="time,q,tau",
            comments="",
            fmt="%.6g",
        )
    elif kind == "json":
        path.write_text(
            json.dumps(
                [{name: values[row] for name, values in columns().items()} for row in range(ROWS)]
            )
        )
    elif kind == "npz":
        np.savez(path, **columns())
    else:
        scipy.io.savemat(path, columns())
    return path.read_bytes()


VALID = {
    "csv": (".csv", lambda folder: saved(folder, "csv")),
    "json": (".json", lambda folder: saved(folder, "json")),
    "npz": (".npz", lambda folder: saved(folder, "npz")),
    "matlab 5": (".mat", lambda folder: saved(folder, "mat")),
    "matlab 7.3": (".mat", matlab_7),
    "ros 1": (".bag", ros1),
    "sqlite": (".db3", lambda folder: ros2(folder, StoragePlugin.SQLITE3)),
    "mcap": (".mcap", lambda folder: ros2(folder, StoragePlugin.MCAP)),
}


@pytest.fixture(scope="module", params=VALID)
def valid(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, bytes]:
    """Where to put a file, and what it has when it is whole."""
    suffix, make = VALID[request.param]
    return tmp_path_factory.mktemp("fuzz") / f"log{suffix}", make(tmp_path_factory.mktemp("valid"))


def read(path: Path) -> Log:
    return convert([path], LogMap() if path.suffix in (".bag", ".db3", ".mcap") else MAP)


def test_the_whole_file_is_read(valid: tuple[Path, bytes]):
    path, content = valid
    path.write_bytes(content)
    log = read(path)
    assert len(log.time) == ROWS
    np.testing.assert_array_equal(np.diff(log["joint/position"][:, 0]), 1)


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_damaged_files_never_show_a_traceback(valid: tuple[Path, bytes], data: st.DataObject):
    path, content = valid
    damaged = bytearray(content)
    for place, value in data.draw(
        st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)), max_size=12)
    ):
        damaged[place] = value
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(content) - 1)) :]
    start, size = (
        data.draw(st.integers(0, len(content))),
        data.draw(st.sampled_from([0, 0, 1, 7, 100])),
    )
    damaged[start : start + size] = data.draw(
        st.sampled_from([b"", b"", b"\0" * size, b"\xff" * size])
    )
    path.write_bytes(damaged)
    message, log = outcome(path)
    if log is None:
        assert message.startswith(str(path))
        assert "\n" not in message
    else:
        assert np.isfinite(log["joint/position"]).all()


def outcome(path: Path) -> tuple[str, Log | None]:
    """The message, or the log. Any other exception is a failure."""
    try:
        return "", read(path)
    except InputError as error:
        return str(error), None


@settings(max_examples=100, deadline=None, derandomize=True)
@given(text=st.text(alphabet='time,q\tau;0123456789.-+e"\n\r_ naif', max_size=200))
def test_any_text_as_csv(tmp_path_factory: pytest.TempPathFactory, text: str):
    path = tmp_path_factory.getbasetemp() / "text.csv"
    path.write_text(f"time,q,tau\n0,1,2\n{text}")
    assert "\n" not in outcome(path)[0]
