"""Files: whole or not at all, also where programs are killed and disks are full; JSON by its
standard."""

import contextlib
import fcntl
import json
import math
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fbse_drake import InputError, Log
from fbse_drake.cli import BAD_INPUT, FAILED, main
from fbse_drake.files import from_json, origin, read_json, write_atomically, write_json, write_text
from fbse_drake.npz import read_npz


def run(script: str, **options: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, **options)


def test_what_is_no_finite_number_is_null(tmp_path: Path):
    content = {
        "a": [math.nan, math.inf, 1.5],
        "b": (np.float64("nan"), np.array([1, -np.inf])),
        "c": np.bool_(True),
    }
    write_json(tmp_path / "x.json", content)
    strict = json.loads((tmp_path / "x.json").read_text(), parse_constant=pytest.fail)
    assert strict == {"a": [None, None, 1.5], "b": [None, [1, None]], "c": True}
    assert read_json(tmp_path / "x.json") == strict


def test_older_files_are_read_as_if_they_were_strict():
    assert from_json('{"a": NaN, "b": -Infinity, "c": 1e999}') == {"a": None, "b": None, "c": None}


def test_escaped_characters_are_read_whole():
    assert from_json(r'{"a": "\ud83d\uDE00"}') == {"a": "\N{GRINNING FACE}"}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[" * 100_000,
        '{"a": 1}}',
        b"\xff\xfe",
        "9" * 5000,
        r'["\uD83d"]',
        rb'{"\ude00": 1}',
    ],
)
def test_what_is_no_json_gets_one_line(text: str | bytes, tmp_path: Path):
    path = tmp_path / "x.json"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(InputError, match=r"x\.json: not a JSON file: ") as error:
        read_json(path)
    assert "\n" not in str(error.value)


def test_a_file_says_what_it_was_made_of(tmp_path: Path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/1").write_text("ab")
    (tmp_path / "bag/2").write_text("c")
    (tmp_path / "scenario.yaml").write_text("abc")
    made_of = origin([tmp_path / "bag"], tmp_path / "scenario.yaml")
    # That of "abc" is in the standard, FIPS 180-2.
    assert made_of["scenario_sha256"].startswith("ba7816bf8f01cfea414140de5dae2223")
    assert made_of["log_sha256"] == [made_of["scenario_sha256"]]
    assert made_of["schema_version"] == 1
    assert made_of["package_version"]
    assert "log_sha256" not in origin()


KILLED = """
import os, signal, sys
from pathlib import Path
from fbse_drake.files import write_atomically
def write(partial):
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
write_atomically(Path(sys.argv[1]) / "result", write)
"""


def test_the_next_run_sweeps_up_after_one_that_was_killed(tmp_path: Path):
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    (left,) = tmp_path.iterdir()
    assert left.read_text() == "half"
    # Somebody is still writing this one, and that one is not ours.
    busy, other = tmp_path / ".other.0.fbse-part", tmp_path / ".other.part"
    other.write_text("")
    with busy.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        write_text(tmp_path / "result", "whole")
    assert sorted(tmp_path.iterdir()) == [busy, other, tmp_path / "result"]


def test_of_two_writers_at_once_the_last_one_stays(tmp_path: Path):
    path = tmp_path / "result"

    def slow(partial: Path) -> None:
        partial.write_text("first")
        write_text(path, "second")
        assert path.read_text() == "second"

    write_atomically(path, slow)
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """No file can have more than a few bytes, as on a disk that is full; not even one that pytest
    tells its progress to."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    time = 0.01 * np.arange(200)
    channels = {"time": time, "joint/position": np.sin(time)[:, None]}
    Log(channels, {"joints": ["é"], "period": 0.01}).save(tmp_path / "log.npz")
    return tmp_path / "log.npz"


@pytest.mark.parametrize("kind", ["npz", "csv", "mcap"])
def test_a_full_disk_keeps_what_was_there(kind: str, log: Path, capsys: pytest.CaptureFixture):
    out = log.with_name(f"out.{kind}")
    out.write_text("mine")
    with full_disk():
        status = main(["convert", str(log), str(out), "--force", "--quiet"])
    assert status == FAILED
    said = capsys.readouterr().err
    assert said == f"fbse: {out}: File too large; no file was left half-written\n"
    assert out.read_text() == "mine"
    assert {path.name for path in log.parent.iterdir()} == {log.name, out.name}


def test_a_folder_that_cannot_be_written_to_is_refused(log: Path, capsys: pytest.CaptureFixture):
    for arguments in (["convert", str(log), "/proc/self/out.csv"], ["reveal", "/proc/self"]):
        assert main(arguments) == BAD_INPUT
        said = capsys.readouterr().err
        assert said.startswith("fbse: ")
        assert said.count("\n") == 1


def test_no_home_an_old_locale_and_nobody_who_reads_along(log: Path):
    """Names that the terminal cannot show, and `| head` that has seen enough: the file is
    written."""
    read, write = os.pipe()
    os.close(read)
    environment = {
        name: value
        for name, value in os.environ.items()
        if name in ("PATH", "PYTHONPATH", "NUMBA_CACHE_DIR")
    }
    out = log.with_name("out.csv")
    done = subprocess.run(
        [sys.executable, "-m", "fbse_drake", "convert", str(log), str(out)],
        stdout=write,
        stderr=subprocess.PIPE,
        env=environment | {"LC_ALL": "C"},
        text=True,
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")
    assert out.read_text(encoding="utf-8").startswith("time,joint/position/é\n")


def test_a_terminal_without_a_letter_shows_a_question_mark():
    script = "from fbse_drake import cli; cli.main = lambda: print(chr(181)); cli.entry()"
    assert run(script, env=os.environ | {"PYTHONIOENCODING": "ascii"}).stdout == "?\n"


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((10**12,), r"time\.npy has 24 bytes of data, expected 8000000000000"),
        ((-1,), r"time\.npy has a shape of"),
        ((2,), r"time\.npy has 24 bytes of data, expected 16"),
    ],
)
def test_an_array_that_says_another_size_is_refused(
    shape: tuple[int], message: str, tmp_path: Path
):
    """Before anything is allocated for it."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    import zipfile

    with zipfile.ZipFile(tmp_path / "x.npz", "w") as file:
        file.writestr("time.npy", member + bytes(24))
    with pytest.raises(ValueError, match=message):
        read_npz(tmp_path / "x.npz")


def test_arrays_are_read_as_they_were_written(tmp_path: Path):
    arrays = {
        "rows": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6, dtype="i2").reshape(2, 3)),
        "text": np.array("é"),
        "none": np.zeros((0, 4)),
    }
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    read = read_npz(tmp_path / "x.npz")
    assert list(read) == list(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(read[name], values)
        assert read[name].dtype == values.dtype
