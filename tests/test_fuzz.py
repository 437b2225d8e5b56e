"""A small part of `make fuzz`: wrong files of every kind, through the commands that read them."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.fuzz import attack as attacking
from benchmarks.fuzz.attack import attack
from benchmarks.fuzz.files import KINDS, Kind, right_files
from fbse_drake.cli import BAD_INPUT

# Of each kind.
INPUTS = 10
# Those that take longer are in `make fuzz`.
QUICK = [name for name in KINDS if name not in ("legged log", "studied log")]


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of right files."""
    place = tmp_path_factory.mktemp("right")
    right_files(place, logs=["arm"])
    return place


@pytest.mark.parametrize("kind", QUICK)
def test_a_wrong_file_gets_one_line_or_is_read(
    kind: str, right: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    commands = [command for command in KINDS[kind].commands if command[0] != "identify"]
    monkeypatch.setitem(KINDS, kind, replace(KINDS[kind], commands=tuple(commands)))
    for number in range(INPUTS):
        (tmp_path / str(number)).mkdir()
        monkeypatch.chdir(tmp_path / str(number))
        verdict = attack(number, 0, right, kind)
        assert not verdict.problem, verdict.details


def crashes(_: object) -> int:
    raise IndexError


def prints_much(_: object) -> int:
    print("fbse: one\nand another line", file=sys.stderr)
    return BAD_INPUT


def writes(name: str, text: str) -> Callable[[object], int]:
    def run(_: object) -> int:
        Path("out").mkdir()
        Path("out", name).write_text(text)
        return 0

    return run


def runs_code(_: object) -> int:
    exec(Path("canary.py").read_text())
    return 0


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (crashes, "traceback"),
        (prints_much, "not one line"),
        (runs_code, "code run"),
        (writes("x.yaml", "a: {effect_modules: [canary.py]}"), "code run"),
        (writes("x.html", "<script>alert(1)</script>"), "code run"),
        (writes(".x.1.fbse-part", ""), "half-written file"),
        (writes("x.json", "[NaN]"), "half-written file"),
        (writes("log.npz", "PK"), "half-written file"),
        (writes("x.json", "[null]"), ""),
    ],
)
def test_the_attack_notices_what_gets_through(
    command: Callable[[object], int],
    problem: str,
    right: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    kind = Kind(("arm.yaml",), lambda content, _: content, (("x",),), run=command)
    monkeypatch.setitem(attacking.KINDS, "broken", kind)
    monkeypatch.chdir(tmp_path)
    assert attack(0, 0, right, "broken").problem == problem


def test_the_same_number_is_the_same_input(
    right: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    contents = []
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        monkeypatch.chdir(tmp_path / place)
        attack(3, 0, right, "diagnosis")
        contents.append((tmp_path / place / "diagnosis.json").read_bytes())
    assert contents[0] == contents[1] != (right / "diagnosis.json").read_bytes()
