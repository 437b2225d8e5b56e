import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fbse_drake import InputError, Log
from fbse_drake.cli import BAD_INPUT, DONE, main
from fbse_drake.interop.convert import convert, read_log
from fbse_drake.interop.mapping import ChannelMap, LogMap, TimeMap, load_map
from fbse_drake.interop.messages import Layout
from fbse_drake.interop.units import si_factor

DATA = os.environ.get("FBSE_DATA_DIR")
needs_data = pytest.mark.skipif(
    DATA is None, reason="FBSE_DATA_DIR does not say where the real measurements are"
)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
JOINTS = ["hip", "knee"]
MAP = LogMap(
    joints=JOINTS,
    channels={
        "joint/position": ChannelMap(columns=["q1", "q2"]),
        "joint/torque_command": ChannelMap(columns=["tau1", "tau2"]),
    },
)
N = 50
TIME = 0.01 * np.arange(N)
Q = np.column_stack([np.sin(TIME), np.cos(3 * TIME)])
TAU = np.column_stack([5 * TIME, 1 - TIME])


def write_csv(
    path: Path, *, time: np.ndarray = TIME, q: np.ndarray = Q, tau: np.ndarray = TAU
) -> Path:
    rows = np.column_stack([time, q, tau])
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header="time,q1,q2,tau1,tau2", comments="")
    return path


def with_position(**changes: Any) -> LogMap:
    return replace(
        MAP,
        channels=MAP.channels
        | {"joint/position": ChannelMap(**{"columns": ["q1", "q2"], **changes})},
    )


# Files of rows


def test_the_same_rows_in_every_kind_of_file(tmp_path: Path):
    columns = {"time": TIME, "q1": Q[:, 0], "q2": Q[:, 1], "tau1": TAU[:, 0], "tau2": TAU[:, 1]}
    write_csv(tmp_path / "log.csv")
    records = [{name: values[row] for name, values in columns.items()} for row in range(N)]
    (tmp_path / "log.json").write_text(json.dumps({"robot": "x", "rows": records}))
    scipy.io.savemat(tmp_path / "five.mat", columns)
    with h5py.File(tmp_path / "seven.mat", "w") as file:
        for name, values in columns.items():
            file[name] = values[None, :]
    np.savez(tmp_path / "arrays.npz", **columns)
    for path in sorted(tmp_path.iterdir()):
        log = convert([path], MAP)
        np.testing.assert_array_equal(log.time, TIME, err_msg=path.name)
        np.testing.assert_array_equal(log["joint/position"], Q, err_msg=path.name)
        np.testing.assert_array_equal(log["joint/torque_command"], TAU, err_msg=path.name)
        assert "joint/velocity" not in log
        assert (log.joints, log.meta["period"], log.meta["findings"]) == (JOINTS, 0.01, [])


def test_matrices_structs_and_parts_of_them(tmp_path: Path):
    # In MATLAB's files of version 5 a struct, with samples in columns.
    scipy.io.savemat(
        tmp_path / "five.mat",
        {"log": {"t": TIME, "q": Q.T, "wrench": np.arange(6.0) + TIME[:, None]}, "mass": 2.5},
    )
    # Version 7.3 keeps arrays transposed.
    with h5py.File(tmp_path / "seven.mat", "w") as file:
        group = file.create_group("log")
        group["t"], group["q"], group["wrench"] = (
            TIME[:, None],
            Q.T,
            (np.arange(6.0) + TIME[:, None]).T,
        )
        file["mass"] = [[2.5]]
    log_map = LogMap(
        joints=["knee", "hip"],
        time=TimeMap(column="log.t"),
        constants=["mass"],
        channels={
            "joint/position": ChannelMap(columns=["log.q[1]", "log.q[0]"]),
            "foot/left/wrench": ChannelMap(columns=["log.wrench[3:6]", "log.wrench[0:3]"]),
        },
    )
    for path in sorted(tmp_path.iterdir()):
        log = convert([path], log_map)
        np.testing.assert_array_equal(log["joint/position"], Q[:, ::-1])
        np.testing.assert_array_equal(
            log["foot/left/wrench"][7], np.array([3, 4, 5, 0, 1, 2]) + TIME[7]
        )
        assert log.sides == ["left"]
        assert log.meta["segments"][0]["mass"] == 2.5


def test_cells_of_a_csv_file_that_hold_lists(tmp_path: Path):
    """As pandas and spreadsheets write them, in whatever brackets; an empty cell is no list."""
    styles = [
        lambda q, tau: f'"[{q[0]!r}, {q[1]!r}]","({tau[0]!r}; {tau[1]!r})"',
        lambda q, tau: f"{q[0]!r} {q[1]!r},[{tau[0]!r}  {tau[1]!r}]",
    ]
    log_map = LogMap(
        joints=JOINTS,
        channels={
            "joint/position": ChannelMap(columns=["q"]),
            "joint/torque_command": ChannelMap(columns=["tau[1]", "tau[0]"]),
        },
    )
    for style in styles:
        rows = (
            f"{time!r},{style(q, tau)}"
            for time, q, tau in zip(TIME.tolist(), Q.tolist(), TAU.tolist(), strict=True)
        )
        text = "\n".join(["time,q,tau", *rows])
        (tmp_path / "log.csv").write_text(text)
        log = convert([tmp_path / "log.csv"], log_map)
        np.testing.assert_array_equal(log["joint/position"], Q)
        np.testing.assert_array_equal(log["joint/torque_command"], TAU[:, ::-1])
        (tmp_path / "gap.csv").write_text(text + f"\n{N / 100},,[1 2]\n")
        assert "without numbers" in convert([tmp_path / "gap.csv"], log_map).meta["findings"][0]
        (tmp_path / "short.csv").write_text(text + f"\n{N / 100},[1],[1 2]\n")
        message = rf"line {N + 2}, column q: expected 2 numbers, found '\[1\]'"
        with pytest.raises(InputError, match=message):
            convert([tmp_path / "short.csv"], log_map)


def test_joints_that_share_motors_are_combinations_of_columns(tmp_path: Path):
    """A differential wrist: pitch is the mean of two motors, roll half their difference. Torques
    go the other way round, so that both have the same power."""
    to_joints = np.array([[0.5, 0.5], [0.5, -0.5]])
    motors = Q @ np.linalg.inv(to_joints).T
    motor_torques = TAU @ to_joints
    rows = np.column_stack([TIME, motors, motor_torques])
    np.savetxt(
        tmp_path / "log.csv",
        rows,
        delimiter=",",
        header="time,m1,m2,t1,t2",
        comments="",
        fmt="%.17g",
    )
    log = convert(
        [tmp_path / "log.csv"],
        LogMap(
            joints=JOINTS,
            channels={
                "joint/position": ChannelMap(columns=["m1", "m2"], matrix=to_joints.tolist()),
                "joint/torque_command": ChannelMap(
                    columns=["t1", "t2"], matrix=[[1, 1], [1, -1]], gains=[1e3, 1e3], unit="mNm"
                ),
            },
        ),
    )
    np.testing.assert_allclose(log["joint/position"], Q, atol=1e-14)
    np.testing.assert_allclose(log["joint/torque_command"], TAU, atol=1e-12)


def test_files_side_by_side_meet_at_the_rows_of_the_joints(tmp_path: Path):
    """Each topic is a file, with a clock and a rate of its own; forces that are linear in time are
    interpolated exactly, and rows where a file has ended are left out."""
    slow = np.arange(0.0, 0.8 * TIME[-1], 0.025)
    forces = np.column_stack([3.0 * slow, -slow, 700.0 + slow])
    for trial, start in (("one", 0.0), ("two", 1.7e9)):
        write_csv(tmp_path / f"joints_{trial}.csv", time=start + TIME)
        np.savetxt(
            tmp_path / f"feet_{trial}.csv",
            np.column_stack([start + slow, np.zeros((len(slow), 3)), forces]),
            delimiter=",",
            header="time,mx,my,mz,fx,fy,fz",
            comments="",
            fmt="%.17g",
        )
    log_map = LogMap(
        joints=JOINTS,
        channels={
            "foot/left/wrench": ChannelMap(
                topic="feet_*", columns=["mx", "my", "mz", "fx", "fy", "fz"]
            ),
            "joint/position": ChannelMap(topic="joints_*", columns=["q1", "q2"]),
        },
    )
    names = ("joints_one", "feet_one", "joints_two", "feet_two")
    paths = [tmp_path / f"{name}.csv" for name in names]
    log = convert(paths, log_map)
    rows = int(np.searchsorted(TIME, slow[-1] + 1e-9))
    assert [segment["source"] for segment in log.meta["segments"]] == [
        "feet_one.csv and joints_one.csv",
        "feet_two.csv and joints_two.csv",
    ]
    # What is left of the clock's resolution since 1970.
    for first, last, resolution in ((0, rows, 1e-9), (len(log.time) - rows, len(log.time), 1e-6)):
        stretch = slice(first, last)
        np.testing.assert_array_equal(log["joint/position"][stretch], Q[:rows])
        expected = np.column_stack([3.0 * TIME, -TIME, 700.0 + TIME])[:rows]
        np.testing.assert_allclose(
            log["foot/left/wrench"][stretch, 3:], expected, atol=4.0 * resolution
        )
    other = {
        "joint/position": ChannelMap(topic="joints"),
        "imu/angular_velocity": ChannelMap(topic="imu"),
    }
    with pytest.raises(InputError, match=r"feet_two\.csv: .* topics joints, imu, it fits none"):
        convert(paths[-1:] * 2, replace(log_map, channels=other))
    with pytest.raises(InputError, match=r"as many files of each topic; found feet_\*: 1, join"):
        convert(paths[:3], log_map)


def test_a_csv_file_without_names_or_with_other_separators(tmp_path: Path):
    rows = np.column_stack([1e3 * TIME, Q])
    log_map = replace(
        with_position(),
        channels={"joint/position": ChannelMap(columns=["1", "2"])},
        time=TimeMap("0", "ms"),
    )
    for name, options in {"bare.csv": {"delimiter": ";"}, "tabs.txt": {"delimiter": "\t"}}.items():
        np.savetxt(tmp_path / name, rows, fmt="%.17g", **options)
        log = convert([tmp_path / name], log_map)
        np.testing.assert_array_equal(log["joint/position"], Q)
        np.testing.assert_allclose(log.time, TIME, atol=1e-15)
    # A name with a bracket is a name, not a part of something.
    (tmp_path / "plot.csv").write_text('time,"/joint_states/position[0]"\n0,1\n0.1,2\n')
    channels = {"joint/position": ChannelMap(columns=["/joint_states/position[0]"])}
    assert convert([tmp_path / "plot.csv"], LogMap(joints=["a"], channels=channels))[
        "joint/position"
    ].ravel().tolist() == [1, 2]


def test_units_gains_signs_offsets_and_products(tmp_path: Path):
    path = write_csv(tmp_path / "log.csv")
    turned = convert(
        [path], with_position(unit="deg", gain=2.0, gains=[1.0, -1.0], offsets=[0.0, 90.0])
    )["joint/position"]
    np.testing.assert_allclose(
        turned, np.deg2rad(np.column_stack([2 * Q[:, 0], 90 - 2 * Q[:, 1]])), rtol=1e-14
    )
    # Of a prismatic joint.
    np.testing.assert_allclose(
        convert([path], with_position(unit="mm"))["joint/position"], 1e-3 * Q, rtol=1e-14
    )
    product = convert([path], with_position(times=["tau1"]))["joint/position"]
    np.testing.assert_allclose(product, Q * TAU[:, :1], rtol=1e-14)


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("rpm", "rad/s", 2 * np.pi / 60),
        ("rev", "rad", 2 * np.pi),
        ("deg/s", "rad/s", np.pi / 180),
        ("g", "m/s^2", 9.80665),
        ("mNm", "Nm", 1e-3),
        ("us", "s", 1e-6),
    ],
)
def test_units(unit: str, si: str, factor: float):
    assert si_factor(unit, si) == pytest.approx(factor, rel=1e-15)


def test_signed_numbers_that_were_recorded_without_sign(tmp_path: Path):
    signed = np.array([0, 1, -1, 885, -885, 32767, -32768])
    columns = {
        "time": 0.1 * np.arange(len(signed)),
        "load": signed.astype(np.int16).view(np.uint16),
    }
    np.savez(tmp_path / "log.npz", **columns)
    log_map = LogMap(
        joints=["servo"], channels={"joint/position": ChannelMap(columns=["load"], signed_bits=16)}
    )
    np.testing.assert_array_equal(
        convert([tmp_path / "log.npz"], log_map)["joint/position"].ravel(), signed
    )


def test_frames_follow_drake(tmp_path: Path):
    rng = np.random.default_rng(1)
    sensed, acceleration = rng.standard_normal((N, 6)), rng.standard_normal((N, 3))
    np.savez(
        tmp_path / "log.npz", time=TIME, q=Q, force_then_moment=sensed, acceleration=acceleration
    )
    rotation, position = [10.0, -20.0, 100.0], [0.01, -0.02, 0.09]
    channels = {
        "joint/position": ChannelMap(columns=["q"]),
        "imu/linear_acceleration": ChannelMap(
            columns=["acceleration"], rotation_deg=rotation, unit="g"
        ),
        "foot/left/wrench": ChannelMap(
            columns=["force_then_moment[3:6]", "force_then_moment[0:3]"],
            rotation_deg=rotation,
            position=position,
        ),
    }
    log = convert([tmp_path / "log.npz"], LogMap(joints=JOINTS, channels=channels))
    X_LS = RigidTransform(RotationMatrix(RollPitchYaw(np.deg2rad(rotation))), position)
    np.testing.assert_allclose(
        log["imu/linear_acceleration"][3], 9.80665 * (X_LS.rotation() @ acceleration[3]), rtol=1e-12
    )
    F_S_L = SpatialForce(tau=X_LS.rotation() @ sensed[3, 3:], f=X_LS.rotation() @ sensed[3, :3])
    # Shifted from the sensor to the sole.
    np.testing.assert_allclose(
        log["foot/left/wrench"][3], F_S_L.Shift(-np.array(position)).get_coeffs(), rtol=1e-12
    )


def test_pads_are_rows_of_three(tmp_path: Path):
    forces = np.random.default_rng(2).standard_normal((N, 4, 3))
    np.savez(tmp_path / "log.npz", time=TIME, q=Q, pads=forces.reshape(N, 12))
    places = [[0.1, 0.05, 0], [0.1, -0.05, 0], [-0.1, 0.05, 0], [-0.1, -0.05, 0]]
    channels = {
        "joint/position": ChannelMap(columns=["q"]),
        "foot/left/pad_force": ChannelMap(columns=["pads"]),
    }
    log = convert(
        [tmp_path / "log.npz"], LogMap(joints=JOINTS, channels=channels, pads={"left": places})
    )
    np.testing.assert_array_equal(log["foot/left/pad_force"], forces)
    assert log.meta["pads"] == {"left": places}


def test_several_files_are_one_log_with_gaps(tmp_path: Path):
    for number, kp in enumerate([100, 200]):
        records = [{"time": 5.0 + t, "q1": number + t, "q2": 0, "tau1": 0, "tau2": 0} for t in TIME]
        (tmp_path / f"{number}.json").write_text(
            json.dumps({"kp": kp, "trajectory": "sine", "entries": records})
        )
    log_map = replace(MAP, constants=["kp", "trajectory"], gap=2.0)
    log = convert([tmp_path / "0.json", tmp_path / "1.json"], log_map)
    assert len(log.time) == 2 * N
    assert log.time[0] == 0
    assert log.time[N] - log.time[N - 1] == pytest.approx(2.0)
    assert log.meta["period"] == 0.01
    first, second = log.meta["segments"]
    assert first == {
        "start": 0.0,
        "end": pytest.approx(0.49),
        "source": "0.json",
        "recorded_start": 5.0,
        "kp": 100,
        "trajectory": "sine",
    }
    assert (second["kp"], second["start"]) == (200, log.time[N])
    np.testing.assert_allclose(log["joint/position"][N:, 0], 1 + TIME)


def test_a_stretch_of_a_recording(tmp_path: Path):
    log = convert(
        [write_csv(tmp_path / "log.csv", time=TIME + 7)], replace(MAP, start=0.1, end=0.25)
    )
    np.testing.assert_array_equal(log["joint/position"], Q[10:26])
    assert log.time[0] == 0
    assert log.meta["segments"][0]["recorded_start"] == pytest.approx(7.1)


def test_times_since_1970_keep_their_resolution(tmp_path: Path):
    """Nanoseconds in one number of 8 bytes are known to 128 ns; seconds would be to 240 ns."""
    stamps = 1_700_000_000_123_456_789 + 1_000_000 * np.arange(N)
    np.savez(tmp_path / "log.npz", time=stamps, q1=Q[:, 0], q2=Q[:, 1])
    channels = {"joint/position": ChannelMap(columns=["q1", "q2"])}
    log = convert(
        [tmp_path / "log.npz"], LogMap(joints=JOINTS, channels=channels, time=TimeMap(unit="ns"))
    )
    np.testing.assert_allclose(log.time, 1e-3 * np.arange(N), rtol=0, atol=129e-9)
    assert log.meta["segments"][0]["recorded_start"] == pytest.approx(
        1_700_000_000.123457, abs=1e-6
    )


def test_rows_without_a_clock_are_a_period_apart(tmp_path: Path):
    log = convert(
        [write_csv(tmp_path / "log.csv")], replace(MAP, time=TimeMap(column=""), period=0.02)
    )
    np.testing.assert_allclose(log.time, 2 * TIME)


def test_channels_that_a_file_may_lack(tmp_path: Path):
    channels = MAP.channels | {
        "joint/temperature": ChannelMap(columns=["warm1", "warm2"], optional=True)
    }
    assert "joint/temperature" not in convert(
        [write_csv(tmp_path / "log.csv")], replace(MAP, channels=channels)
    )
    channels["joint/temperature"] = ChannelMap(columns=["warm1", "warm2"])
    with pytest.raises(
        InputError,
        match=r"log.csv: column warm1 is missing \(there are: time, q1, q2, tau1, tau2\)",
    ):
        convert([tmp_path / "log.csv"], replace(MAP, channels=channels))


@pytest.mark.parametrize("size", [1, 7, 50])
def test_files_are_read_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int):
    monkeypatch.setattr("fbse_drake.interop.tables._CHUNK", size)
    monkeypatch.setattr("fbse_drake.interop.bags._BLOCK", size)
    for path in (write_csv(tmp_path / "log.csv"), write_bag(tmp_path / "bag", STATES)):
        log = convert([path], MAP if path.suffix == ".csv" else LogMap())
        np.testing.assert_array_equal(log["joint/position"], Q)
        np.testing.assert_array_equal(log["joint/torque_command"], TAU)
    lines = (tmp_path / "log.csv").read_text().splitlines()
    lines[23] = lines[23].replace(",", ",x", 1)
    (tmp_path / "log.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match="line 24, column q1: expected a number, found 'x"):
        convert([tmp_path / "log.csv"], MAP)


# What is damaged


def test_rows_without_numbers_and_repeated_rows_are_left_out_and_said(tmp_path: Path):
    time, q = TIME.copy(), Q.copy()
    q[10:15, 1] = np.nan
    time[31] = time[30]
    log = convert([write_csv(tmp_path / "log.csv", time=time, q=q)], MAP)
    kept = np.delete(np.arange(N), [10, 11, 12, 13, 14, 31])
    np.testing.assert_array_equal(log["joint/torque_command"], TAU[kept])
    assert log.meta["findings"] == [
        "5 rows without numbers in joint/position are left out (the first is row 10)",
        "1 rows at the time of the row before are left out",
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "empty, or without a first line"),
        ("time,q1,q2,tau1,tau2\n", "no rows"),
        (
            "time,q1,q2,tau1,tau2\n0,1,2,3,4\n0.1,1,2,abc,4\n",
            "line 3, column tau1: expected a number, found 'abc'",
        ),
        ("time,q1,q2,tau1,tau2\n0,1,2,3,4\n\n0.1,1,2,3\n", "line 4: expected 5 columns, found 4"),
        ("time,q1,q2,tau1,tau2\n0,1,2,3,4\n0.1,1,2,3,4,5\n", "line 3: expected 5 columns, found 6"),
        ("time,q1,q2,tau1\n0,1,2,3\n", "column tau2 is missing (there are: time, q1, q2, tau1)"),
        ("time,q1,q1,tau1,tau2\n0,1,2,3,4\n", "line 1: the column q1 is there twice"),
        ("time,q1,q2,tau1,tau2\n0,1,2,3,4\n1,,2,3,4\n", "fewer than two rows are left"),
        (
            "time,q1,q2,tau1,tau2\n0,1,2,3,4\n0.1,1,2,3,4\n0.05,1,2,3,4\n",
            "time runs backwards 1 times, first at row 2: 0.100000 s, then 0.050000 s",
        ),
    ],
)
def test_damaged_csv_gets_one_line(tmp_path: Path, content: str, message: str):
    (tmp_path / "log.csv").write_text(content)
    with pytest.raises(InputError, match=f"^{tmp_path}/log.csv: {re.escape(message)}"):
        convert([tmp_path / "log.csv"], MAP)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("log.json", b"{", "damaged, or not a JSON file"),
        ("log.json", b'{"a": 1}', "expected one list of records, found none"),
        (
            "log.json",
            b'[{"time": 0, "q1": "x", "q2": 0, "tau1": 0, "tau2": 0}]',
            "record 0, q1: expected a number, found 'x'",
        ),
        ("log.mat", b"nothing of the kind" * 20, "damaged, or not a MATLAB file"),
        ("log.npz", b"PK\3\4", "damaged, or not an npz file"),
        ("log.mcap", b"", "empty"),
        ("log.db3", b"SQLite format 3\0" + bytes(100), "damaged, or not a bag"),
        ("log.bag", b"#ROSBAG V2.0\n", "damaged, or not a bag"),
        (
            "log.xlsx",
            b"",
            "unknown kind of file (known: .csv, .txt, .json, .mat, .npz, .db3, .mcap or .bag",
        ),
        ("log.csv", None, "No such file or directory"),
        ("log.mcap", None, "No such file or directory"),
        ("log.mat", None, "No such file or directory"),
    ],
)
def test_files_of_another_kind_get_one_line(
    tmp_path: Path, name: str, content: bytes | None, message: str
):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as error:
        convert([tmp_path / name], MAP)
    assert str(error.value).startswith(f"{tmp_path}/{name}: {message}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("joint: [a]", "joint: unknown key, did you mean joints?"),
        ("joints: [a, a]", "joints: a name is given twice"),
        (
            "channels: {joint/angle: {columns: [q]}}",
            "channels.joint/angle: channel joint/angle: not a channel of a log",
        ),
        (
            "channels: {joint/position: {columns: [q], unit: deg/s}}",
            "channels.joint/position: unit: expected one of rad, mrad, deg, rev",
        ),
        (
            "channels: {joint/torque_command: {columns: [i], unit: A}}",
            "what is measured in A needs a gain that makes Nm of it",
        ),
        (
            "channels: {joint/position: {columns: [q], gain: much}}",
            "channels.joint/position.gain: expected a number, found 'much'",
        ),
        (
            "channels: {joint/position: {columns: [q], rotation_deg: [1, 2, 3]}}",
            "only channels imu/... and foot/... can be turned",
        ),
        ("time: {unit: fortnight}", "time.unit: expected one of s, ms, us, ns, found fortnight"),
        ("time: {column: ''}", "period: needed where time has no column"),
        ("{start: 2, end: 1}", "end: expected a number > start = 2, found 1"),
    ],
)
def test_maps_are_checked(tmp_path: Path, text: str, message: str):
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        load_map(tmp_path / "map.yaml")
    assert str(error.value).startswith(str(tmp_path / "map.yaml"))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("log_map", "message"),
    [
        (
            LogMap(),
            (
                "a map must name the joints and say what the columns are (columns: time, q1, q2, "
                "tau1, tau2)"
            ),
        ),
        (
            with_position(columns=["q1"]),
            (
                "channels.joint/position: columns: expected 2 in all, one for each of 2 "
                "joints, found "
                "1"
            ),
        ),
        (
            with_position(gains=[1.0]),
            "channels.joint/position: gains: expected 2 numbers, one for each component, found 1",
        ),
        (
            with_position(columns=["q1[0:2]"]),
            "channels.joint/position: q1[0:2]: q1 has 1 numbers in a row",
        ),
        (replace(MAP, constants=["kp"]), "constants: kp is not in this file (there are: none)"),
        (
            replace(MAP, time=TimeMap("time", "ms"), period=0.01),
            "time: rows are 1e-05 s apart, but the map's period is 0.01 s",
        ),
    ],
)
def test_maps_that_do_not_fit_get_one_line(tmp_path: Path, log_map: LogMap, message: str):
    path = write_csv(tmp_path / "log.csv")
    with pytest.raises(InputError) as error:
        convert([path], log_map)
    assert str(error.value).startswith(f"{path}: {message}")


# Bags


def header(stamp: int, types: dict[str, Any] = ROS2.types) -> Any:
    seconds, nanoseconds = divmod(stamp, 10**9)
    first = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__annotations__ else {}
    return types["std_msgs/msg/Header"](
        **first, stamp=types["builtin_interfaces/msg/Time"](seconds, nanoseconds), frame_id="frame"
    )


def joint_state(
    stamp: int,
    names: list[str],
    q: Any,
    tau: Any,
    *,
    velocity: Any = (),
    types: dict[str, Any] = ROS2.types,
) -> Any:
    arrays = (np.array(values, dtype=float) for values in (q, velocity, tau))
    return types["sensor_msgs/msg/JointState"](header(stamp, types), names, *arrays)


def vector(values: Any, types: dict[str, Any] = ROS2.types) -> Any:
    return types["geometry_msgs/msg/Vector3"](*map(float, values))


def wrench(stamp: int, force: Any, torque: Any, types: dict[str, Any] = ROS2.types) -> Any:
    return types["geometry_msgs/msg/WrenchStamped"](
        header(stamp, types),
        types["geometry_msgs/msg/Wrench"](vector(force, types), vector(torque, types)),
    )


def imu(stamp: int, gyro: Any, acceleration: Any, types: dict[str, Any] = ROS2.types) -> Any:
    upright = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    return types["sensor_msgs/msg/Imu"](
        header(stamp, types),
        upright,
        np.arange(9.0),
        vector(gyro, types),
        np.arange(9.0),
        vector(acceleration, types),
        np.arange(9.0),
    )


Messages = list[tuple[str, int, Any]]


def write_bag(
    path: Path, messages: Messages, plugin: StoragePlugin = StoragePlugin.MCAP, store: Any = ROS2
) -> Path:
    """Writes messages (topic, time of receipt [ns], message) with `rosbags`."""
    with Ros2Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, received, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=store
                )
            writer.write(
                connections[topic], received, store.serialize_cdr(message, message.__msgtype__)
            )
    return path


STAMPS = [1_700_000_000_000_000_000 + 10_000_000 * row for row in range(N)]
STATES = [
    ("/joint_states", stamp, joint_state(stamp, JOINTS, Q[i], TAU[i]))
    for i, stamp in enumerate(STAMPS)
]


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("bare", [False, True])
def test_a_bag_needs_no_map(tmp_path: Path, plugin: StoragePlugin, bare: bool):
    path = write_bag(tmp_path / "bag", STATES, plugin)
    if bare:
        (path / "metadata.yaml").unlink()
    file = next(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))
    for source in (path, file):
        log = read_log(source)
        np.testing.assert_allclose(log.time, TIME, atol=1e-12)
        np.testing.assert_array_equal(log["joint/position"], Q)
        np.testing.assert_array_equal(log["joint/torque_command"], TAU)
        assert "joint/velocity" not in log
        assert (log.joints, log.meta["period"], log.sides) == (JOINTS, 0.01, [])
        assert log.meta["segments"][0]["recorded_start"] == 1.7e9


def test_a_ros_1_bag(tmp_path: Path):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(tmp_path / "log.bag") as writer:
        states = writer.add_connection(
            "/joint_states", "sensor_msgs/msg/JointState", typestore=store
        )
        forces = writer.add_connection(
            "/left_foot", "geometry_msgs/msg/WrenchStamped", typestore=store
        )
        for row, stamp in enumerate(STAMPS):
            state = joint_state(
                stamp, JOINTS, Q[row], TAU[row], velocity=-Q[row], types=store.types
            )
            writer.write(states, stamp, store.serialize_ros1(state, state.__msgtype__))
            force = wrench(stamp, [0, 0, row], [1, 2, 3], store.types)
            writer.write(forces, stamp, store.serialize_ros1(force, force.__msgtype__))
    log = read_log(tmp_path / "log.bag")
    np.testing.assert_array_equal(log["joint/position"], Q)
    np.testing.assert_array_equal(log["joint/velocity"], -Q)
    np.testing.assert_array_equal(log["foot/left/wrench"][:, 5], np.arange(N))


def test_sensors_are_interpolated_between_neighbours_only(tmp_path: Path):
    """An IMU at another rate and phase, with a gap: linear signals come back exactly, and nothing
    is made up in the gap."""
    stamps = [STAMPS[0] - 3_000_000 + 7_000_000 * k for k in range(80)]
    gap = (STAMPS[0] + 200_000_000, STAMPS[0] + 260_000_000)
    linear = [(stamp - STAMPS[0]) / 1e9 for stamp in stamps]
    sensed = [
        ("/imu/data", stamp, imu(stamp, [t, 2 * t, 3 * t], [0, 0, 9.81 - t]))
        for stamp, t in zip(stamps, linear, strict=True)
        if not gap[0] < stamp < gap[1]
    ]
    log = read_log(
        write_bag(tmp_path / "bag", sorted(STATES + sensed, key=lambda message: message[1]))
    )
    np.testing.assert_allclose(
        log["imu/angular_velocity"], np.outer(log.time, [1, 2, 3]), atol=1e-9
    )
    np.testing.assert_allclose(log["imu/linear_acceleration"][:, 2], 9.81 - log.time, atol=1e-9)
    silent = [row for row, t in enumerate(TIME) if 0.20 < t < 0.26]
    lost = np.setdiff1d(np.arange(N), np.rint(100 * log.time).astype(int))
    assert set(silent) <= set(lost.tolist())
    assert len(lost) <= len(silent) + 2
    assert any(
        "rows without numbers in imu/angular_velocity are left out" in finding
        for finding in log.meta["findings"]
    )


def test_joints_are_found_by_name(tmp_path: Path):
    """Messages may name joints in changing orders, and a gripper may share the topic."""
    messages = []
    for row, stamp in enumerate(STAMPS):
        order = [1, 0] if row % 3 else [0, 1]
        messages.append(
            (
                "/joint_states",
                stamp,
                joint_state(stamp, [JOINTS[i] for i in order], Q[row, order], TAU[row, order]),
            )
        )
        messages.append(
            ("/joint_states", stamp + 1, joint_state(stamp + 1, ["gripper"], [9.0], [9.0]))
        )
    path = write_bag(tmp_path / "bag", messages)
    log = convert([path], LogMap(joints=["thigh", "shank"], recorded_joints=["hip", "knee"]))
    np.testing.assert_array_equal(log["joint/position"], Q)
    assert log.joints == ["thigh", "shank"]
    assert log.meta["findings"] == [
        "50 messages of /joint_states are left out: they have not all of the joints hip, knee"
    ]
    with pytest.raises(InputError, match="joints: elbow is not in the messages of /joint_states"):
        convert([path], LogMap(joints=["hip", "elbow"]))


def test_topics_are_chosen_and_changed_by_a_map(tmp_path: Path):
    messages = list(STATES)
    for stamp in STAMPS:
        messages += [
            (f"/{name}", stamp, wrench(stamp, [1, 2, 300], [4, 5, 6]))
            for name in ("l_foot/ft", "rear_leg", "hand")
        ]
        messages += [(f"/imu_{k}", stamp, imu(stamp, [k, 0, 0], [0, 0, 9.81])) for k in (1, 2)]
    path = write_bag(tmp_path / "bag", messages)
    with pytest.raises(
        InputError,
        match=r"several sensor_msgs/msg/Imu topics \(/imu_1, /imu_2\); a map's key topics chooses",
    ):
        convert([path], LogMap())
    channels = {
        "imu/angular_velocity": ChannelMap(topic="/imu_2"),
        "foot/left/wrench": ChannelMap(gain=-1.0),
        "foot/rear/wrench": ChannelMap(topic="/rear_leg"),
        "joint/torque_measured": ChannelMap(
            topic="/hand", columns=["wrench.force.x", "wrench.torque[2]"]
        ),
    }
    log = convert([path], LogMap(channels=channels))
    np.testing.assert_array_equal(log["imu/angular_velocity"][0], [2, 0, 0])
    np.testing.assert_array_equal(log["foot/left/wrench"][0], [-4, -5, -6, -1, -2, -300])
    np.testing.assert_array_equal(log["foot/rear/wrench"][0], [4, 5, 6, 1, 2, 300])
    np.testing.assert_array_equal(log["joint/torque_measured"][0], [1, 6])
    assert log.meta["findings"] == []
    alone = convert([path], LogMap(topics=["/joint_states", "/hand"]))
    assert list(alone) == ["time", "joint/position", "joint/torque_command"]
    assert alone.meta["findings"] == [
        "topic /hand, a wrench, is left out: its name says neither left nor right; a map can"
    ]


def test_what_a_driver_never_fills_in_is_left_out(tmp_path: Path):
    nothing = [np.nan, np.nan]
    states = [
        ("/joint_states", stamp, joint_state(stamp, JOINTS, Q[row], nothing, velocity=Q[row]))
        for row, stamp in enumerate(STAMPS)
    ]
    path = write_bag(tmp_path / "bag", states)
    log = read_log(path)
    assert list(log) == ["time", "joint/position", "joint/velocity"]
    assert log.meta["findings"] == ["joint/torque_command is left out: no row has numbers in it"]
    with pytest.raises(InputError, match="no row has numbers in joint/torque_command"):
        convert([path], LogMap(channels={"joint/torque_command": ChannelMap(gain=-1.0)}))


def test_clocks_of_headers_and_of_the_recorder_are_not_mixed(tmp_path: Path):
    unstamped = [
        ("/foot/left", stamp + 5_000_000, wrench(0, [0, 0, row], [0, 0, 0]))
        for row, stamp in enumerate(STAMPS)
    ]
    stamped = [
        ("/joint_states", stamp, joint_state(stamp - 10**12, JOINTS, Q[row], TAU[row]))
        for row, stamp in enumerate(STAMPS)
    ]
    log = read_log(write_bag(tmp_path / "bag", stamped + unstamped))
    np.testing.assert_allclose(log["foot/left/wrench"][:, 5], np.arange(N - 1) + 0.5, atol=1e-6)


def test_a_type_of_somebody_elses(tmp_path: Path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    motor = "float32 angle\nbool on\nint16 current\n"
    store.register(
        get_types_from_msg(
            (
                f"std_msgs/Header header\nstring note\nx/Motor[2] motors\n{'=' * 80}\nMSG: "
                f"x/Motor\n{motor}"
            ),
            "x/msg/State",
        )
    )
    types = store.types
    messages = []
    for row, stamp in enumerate(STAMPS):
        motors = [
            types["x/msg/Motor"](float(q), row % 2 == 0, 100 * i + row)
            for i, q in enumerate(Q[row])
        ]
        messages.append(
            ("/state", stamp, types["x/msg/State"](header(stamp, types), "n" * (row % 3), motors))
        )
    channels = {
        "joint/position": ChannelMap(topic="/state", columns=["motors.angle"]),
        "joint/torque_command": ChannelMap(topic="/state", columns=["motors.current"], gain=0.1),
    }
    path = write_bag(tmp_path / "bag", messages, store=store)
    log = convert([path], LogMap(joints=JOINTS, channels=channels))
    np.testing.assert_array_equal(log["joint/position"], Q.astype(np.float32))
    np.testing.assert_allclose(
        log["joint/torque_command"], 0.1 * (np.array([0, 100]) + np.arange(N)[:, None])
    )
    channels["joint/position"] = ChannelMap(topic="/state", columns=["motors.speed"])
    with pytest.raises(
        InputError,
        match=(
            r"topic /state: its messages have no numbers motors.speed \(there are: "
            r"header.stamp.sec"
        ),
    ):
        convert([path], LogMap(joints=JOINTS, channels=channels))


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    names=st.lists(st.text(max_size=9), max_size=4),
    frame=st.text(max_size=9),
    sizes=st.tuples(*[st.integers(0, 4)] * 3),
    order=st.booleans(),
)
def test_layouts_are_those_of_the_library(
    names: list[str], frame: str, sizes: tuple[int, int, int], order: bool
):
    """What rosbags writes, in both byte orders, is found where the layout says."""
    names = [name.replace("\0", "") for name in names]
    fields = dict(
        zip(
            ("position", "velocity", "effort"),
            (np.random.default_rng(k).standard_normal(k) for k in sizes),
            strict=True,
        )
    )
    message = ROS2.types["sensor_msgs/msg/JointState"](
        replace(header(1_500_000_007), frame_id=frame.replace("\0", "")), names, **fields
    )
    raw = bytes(ROS2.serialize_cdr(message, message.__msgtype__, little_endian=order))
    layout = Layout.of(raw, message.__msgtype__, ROS2.fielddefs, cdr=True)
    block = np.frombuffer(raw, np.uint8)[None, :]
    assert layout.texts.get("name", []) == names
    assert layout.fits(block).all()
    np.testing.assert_array_equal(layout.decode(block, "header.stamp"), [[1, 500_000_007]])
    for name, values in fields.items():
        np.testing.assert_array_equal(layout.decode(block, name), values[None, :])


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("kept", [0.02, 0.5, 0.97])
def test_a_truncated_bag_gets_one_line(tmp_path: Path, plugin: StoragePlugin, kept: float):
    path = next(
        file
        for file in write_bag(tmp_path / "bag", STATES, plugin).iterdir()
        if file.suffix != ".yaml"
    )
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(InputError) as error:
        read_log(path)
    assert str(error.value).startswith(f"{path}: damaged, or not a bag: ")
    assert "\n" not in str(error.value)


# The command


def test_convert_writes_a_log_and_says_what_it_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture
):
    q = Q.copy()
    q[3] = np.nan
    write_csv(tmp_path / "in.csv", q=q)
    channels = (
        "{joint/position: {columns: [q1, q2]}, joint/torque_command: {columns: [tau1, tau2]}}"
    )
    (tmp_path / "map.yaml").write_text(f"joints: [hip, knee]\nchannels: {channels}\n")
    command = [
        "convert",
        str(tmp_path / "in.csv"),
        str(tmp_path / "new/out.npz"),
        "--map",
        str(tmp_path / "map.yaml"),
    ]
    assert main([*command, "--strict"]) == BAD_INPUT
    printed = capsys.readouterr().err
    assert (
        printed
        == "fbse: 1 rows without numbers in joint/position are left out (the first is row 3)\n"
    )
    assert not (tmp_path / "new").exists()
    assert main(command) == DONE
    assert "1 rows without numbers in joint/position" in " ".join(capsys.readouterr().out.split())
    assert len(Log.load(tmp_path / "new/out.npz").time) == N - 1
    assert main(command) == BAD_INPUT
    assert "this exists already; --force replaces it" in capsys.readouterr().err
    assert main([*command, "--force", "--quiet"]) == DONE
    assert capsys.readouterr() == ("", "")
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["out.npz"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["in.csv"], "the following arguments are required: OUT"),
        (["in.csv", "out.xyz"], "out.xyz: expected a file name that ends in .npz, .mcap, .csv"),
        (["in.csv", "in.csv", "--force"], "in.csv: this is what is to be converted"),
        (
            ["in.csv", "out.npz", "--map", "nowhere"],
            "nowhere: no such file, and no such map in scenarios/ (there are: real/",
        ),
        (["nowhere.bag", "out.npz"], "nowhere.bag: No such file or directory"),
    ],
)
def test_bad_conversions_are_one_line_and_status_2(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
):
    monkeypatch.chdir(tmp_path)
    write_csv(tmp_path / "in.csv")
    before = (tmp_path / "in.csv").read_bytes()
    assert main(["convert", *arguments]) == BAD_INPUT
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert (tmp_path / "in.csv").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["in.csv"]


@pytest.mark.parametrize("command", ["estimate", "compare", "diagnose", "study"])
def test_a_recording_can_be_given_in_place_of_a_log(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture
):
    """It is converted, with a map if need be; here its joints turn out to be those of another
    robot."""
    (tmp_path / "map.yaml").write_text(
        "joints: [hip, knee]\nchannels: {joint/position: {columns: [q1, q2]}}\n"
    )
    table, bag = write_csv(tmp_path / "in.csv"), write_bag(tmp_path / "bag", STATES)
    for recording, options in ((table, ["--map", str(tmp_path / "map.yaml")]), (bag, [])):
        assert (
            main(
                [
                    command,
                    "leg_swing_gantry",
                    str(recording),
                    *options,
                    "--out",
                    str(tmp_path / "out"),
                ]
            )
            == BAD_INPUT
        )
        assert "'hip', 'knee'" in capsys.readouterr().err
    assert (
        main([command, "leg_swing_gantry", str(table), "--out", str(tmp_path / "out")]) == BAD_INPUT
    )
    assert "a map must name the joints" in capsys.readouterr().err


# Real recordings


@needs_data
@pytest.mark.parametrize(
    ("files", "log_map", "rows", "period"),
    [
        ("emps/DATA_EMPS.mat", "real/emps", 24841, 0.001),
        ("emps/DATA_EMPS_PULSES.mat", "real/emps", 24841, 0.001),
        ("double_pendulum/*061157*.csv", "real/double_pendulum", 21969, 0.00333381),
        ("bam_xl330/raw/*.json", "real/xl330", 19452, 0.0052955),
        ("ur10/*.db3", None, 3441, 0.008),
        ("icub_walking/*.mat", "real/icub", 8851, 0.01),
    ],
)
def test_real_recordings_convert(files: str, log_map: str | None, rows: int, period: float):
    paths = sorted(Path(DATA).glob(files))
    log = convert(paths, load_map(log_map) if log_map else LogMap())
    assert len(log.time) == rows
    assert log.meta["period"] == pytest.approx(period, rel=1e-4)
    assert log.meta["findings"] == []
    assert len(log.meta["segments"]) == len(paths)
    # Velocities are those of the positions: signs and units of both agree.
    if "joint/velocity" in log:
        moving = [
            joint
            for joint in range(len(log.joints))
            if np.ptp(log["joint/position"][:, joint]) > 0.1
        ]
        for joint in moving:
            steps = np.diff(log.time) < 2 * period
            slope = (np.diff(log["joint/position"][:, joint]) / np.diff(log.time))[steps]
            middle = (0.5 * (log["joint/velocity"][1:, joint] + log["joint/velocity"][:-1, joint]))[
                steps
            ]
            assert np.polyfit(middle, slope, 1)[0] == pytest.approx(1.0, abs=0.25), log.joints[
                joint
            ]


@needs_data
def test_real_forces_carry_the_weight():
    """iCub, 33 kg, stands in the first second: the ground pushes its soles upwards, and the IMU
    feels it."""
    log = convert(sorted(Path(DATA).glob("icub_walking/*.mat")), load_map("real/icub"))
    force = sum(log[f"foot/{side}/wrench"][:100, 5].mean() for side in ("left", "right"))
    assert force == pytest.approx(33.1 * 9.81, rel=0.05)
    assert np.linalg.norm(log["imu/linear_acceleration"][:100].mean(axis=0)) == pytest.approx(
        9.81, rel=0.03
    )


@needs_data
def test_real_duty_cycles_have_a_sign():
    """XL330: at most all of the supply voltage, in the direction of the error that the servo
    sees."""
    log = convert(sorted(Path(DATA).glob("bam_xl330/raw/*.json")), load_map("real/xl330"))
    voltage, error = (
        log["joint/voltage_command"][:, 0],
        (log["reference/joint/position"] - log["joint/position"])[:, 0],
    )
    driven = (log["joint/enabled"][:, 0] == 1) & (np.abs(error) > 0.02)
    assert np.abs(voltage).max() < 7.6
    assert np.mean(np.sign(voltage[driven]) == np.sign(error[driven])) > 0.95
    assert {segment["kp"] for segment in log.meta["segments"]} == {100, 200, 400, 800}
    # At standstill, of a motor with kt = 0.3036 Nm/A and R = 2.445 ohm, at 7.4 V.
    records = json.loads(sorted(Path(DATA).glob("bam_xl330/raw/*.json"))[0].read_text())["entries"]
    duty = np.array([(entry["load"] + 2**15) % 2**16 - 2**15 for entry in records]) / 885
    np.testing.assert_allclose(
        log["joint/torque_command"][: len(duty), 0], 0.3036 / 2.445 * 7.4 * duty, rtol=1e-3
    )
