"""Gives one wrong file to a command, and judges what became of it."""

import contextlib
import io
import json
import shutil
import sys
import time as clock
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.fuzz import mutations
from benchmarks.fuzz.files import KINDS, Kind
from fbse_drake.cli import BAD_INPUT
from fbse_drake.errors import InputError, on_one_line
from fbse_drake.log import Log
from fbse_drake.schema import load_tree

# Reports are drawn this often; drawing takes most of the time.
_DRAWN = 0.05


class TimeLimit(BaseException):
    """An input took too long."""


@dataclass(frozen=True)
class Verdict:
    """What became of one input."""

    number: int
    kind: str
    command: tuple[str, ...]
    # "" if all is well.
    problem: str
    details: str = ""
    status: int | None = None
    # Of the processor [s].
    time: float = 0.0


def attack(number: int, seed: int, right: Path, only: str | None = None) -> Verdict:
    """Makes an input and gives it to its command, in a folder of its own which is the working one.

    Args:
        number: of the input.
        right: the folder of right files.
    """
    random = np.random.default_rng([seed, number])
    names = [only] if only else list(KINDS)
    weights = np.array([KINDS[name].weight for name in names])
    name = names[random.choice(len(names), p=weights / weights.sum())]
    kind = KINDS[name]
    for path in right.iterdir():
        shutil.copy(path, path.name)
    file = Path(str(random.choice(kind.files)))
    with contextlib.suppress(ValueError, OverflowError):
        file.write_bytes(kind.wrong(file.read_bytes(), random))
    command = kind.commands[random.integers(len(kind.commands))]
    override = f"{random.choice(OVERRIDDEN)}={random.choice(mutations.SCALARS)}"
    filled = tuple(
        override if word == "OVERRIDE" else word.replace("{}", file.name.partition(".")[0])
        for word in command
    )
    return _judged(Verdict(number, name, filled, ""), kind, drawn=random.random() < _DRAWN)


OVERRIDDEN = (
    "duration",
    "seed",
    "title",
    "robot.effects.friction",
    "robot.effects.friction.coulomb.all",
    "robot.rotor_inertia.all",
    "plant.time_step",
    "plant.contact_model",
    "sensors.encoders",
    "sensors.more.winding",
    "reference",
    "reference.amplitude.all",
    "control.kp",
    "log.period",
    "effect_modules",
    "",
    ".",
    "robot..description",
)


def _judged(verdict: Verdict, kind: Kind, *, drawn: bool) -> Verdict:
    errors = io.StringIO()
    status, problem, details = None, "", ""
    start = clock.process_time()
    picture = contextlib.nullcontext() if drawn else _undrawn()
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()), picture:
            try:
                status = kind.run(verdict.command)
            # As the command line does.
            except (InputError, OSError) as error:
                print(f"fbse: {on_one_line(str(error))}", file=sys.stderr)
                status = BAD_INPUT
    except TimeLimit:
        problem, details = "hang", traceback.format_exc()
    except BaseException:
        problem, details = "traceback", traceback.format_exc()
    said = errors.getvalue()
    if not problem:
        problem, details = _wrong_with(Path(), status, said)
    took = clock.process_time() - start
    return replace(verdict, problem=problem, details=details or said, status=status, time=took)


def _wrong_with(place: Path, status: int | None, said: str) -> tuple[str, str]:
    """What a command that came to its end left behind that it should not have."""
    if status == BAD_INPUT and (said.count("\n") != 1 or not said.startswith("fbse: ")):
        return "not one line", said
    if (place / "RAN").exists():
        return "code run", said
    if left := [str(path) for path in place.rglob(".*part")]:
        return "half-written file", ", ".join(left)
    for path in (place / "out").rglob("*") if (place / "out").is_dir() else []:
        try:
            if path.suffix == ".json":
                json.loads(path.read_text(), parse_constant=_refuse)
            elif path.suffix == ".yaml" and "effect_modules" in str(load_tree(path)):
                if "effect_modules: []" not in path.read_text():
                    return "code run", path.read_text()
            elif path.suffix == ".npz":
                Log.load(path)
            elif path.suffix == ".html" and "<script>alert" in path.read_text():
                return "code run", "a script in the report"
        except ValueError as error:
            return "half-written file", f"{path}: {error}"
    return "", ""


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON")


@contextlib.contextmanager
def _undrawn() -> Iterator[None]:
    from fbse_drake.report import html

    before = html._png_uri

    def drawn(draw: Callable[[], Figure]) -> str:
        draw()
        return ""

    html._png_uri = drawn
    try:
        yield
    finally:
        html._png_uri = before
