"""Gives the commands wrong files, and says what they make of them.

    python -m benchmarks.fuzz [--inputs 20000] [--seed 0] [--only KIND] [--out out/fuzz]

Nothing may end in a traceback, hang, leave a half-written file or run code. What does is kept in
DIR, each input in a folder with its command and what happened. Inputs follow from seed and number:
the same number is the same input.
"""

import argparse
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

import fbse_drake.commands  # noqa: F401  (once, and not in every process)
from benchmarks.fuzz.attack import TimeLimit, Verdict, attack
from benchmarks.fuzz.files import KINDS, right_files

# What an input may take of a processor's time [s], and until its process is ended, however busy the
# machine is [s].
LIMIT, PATIENCE = 20.0, 150.0
# Address space of a process [bytes].
_MEMORY = 6 * 2**30
# Inputs that are done before a new process is started.
_BATCH = 500


def _limited(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
    """Does what somebody would who waits: Ctrl-C, which keeps what is known; it is a hang if
    nothing is."""
    if Path("out").is_dir() and signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        signal.raise_signal(signal.SIGINT)
    else:
        raise TimeLimit


def _work(pipe: Connection, numbers: range, seed: int, right: Path, only: str | None) -> None:
    """Does some inputs, and tells of each before and after."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _limited)
    warnings.simplefilter("ignore")
    for number in numbers:
        pipe.send(number)
        with tempfile.TemporaryDirectory() as place:
            os.chdir(place)
            signal.setitimer(signal.ITIMER_PROF, LIMIT)
            try:
                verdict = attack(number, seed, right, only)
            except TimeLimit:
                verdict = Verdict(number, "?", (), "hang", "in the attack itself")
            signal.setitimer(signal.ITIMER_PROF, 0)
            pipe.send((verdict, _kept(Path()) if verdict.problem else {}))
    pipe.send(None)


def _kept(place: Path) -> dict[str, bytes]:
    return {
        str(path): path.read_bytes()
        for path in place.iterdir()
        if path.is_file() and path.stat().st_size < 2**20
    }


def attacks(
    numbers: range, seed: int, right: Path, only: str | None = None
) -> Iterator[tuple[Verdict, dict[str, bytes]]]:
    """Verdicts, and the files of those that failed; a process that dies is a verdict too."""
    context = multiprocessing.get_context("fork")
    done = numbers.start
    while done < numbers.stop:
        ours, theirs = context.Pipe(duplex=False)
        batch = range(done, min(done + _BATCH, numbers.stop))
        process = context.Process(target=_work, args=(theirs, batch, seed, right, only))
        process.start()
        theirs.close()
        current, ended = done, False
        while not ended:
            try:
                message = ours.recv() if ours.poll(PATIENCE) else "late"
            except EOFError:
                message = "died"
            if isinstance(message, int):
                current = message
            elif isinstance(message, tuple):
                yield message
                done = message[0].number + 1
            else:
                ended = True
                if message is not None:
                    problem = "hang" if message == "late" else "crash"
                    yield Verdict(current, "?", (), problem, f"the process {message}"), {}
                    done = current + 1
        process.kill()
        process.join()


def main() -> int:
    """Runs the attack; status 1 if anything got through."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=20000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    options = parser.parse_args()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    os.environ.setdefault("MPLBACKEND", "Agg")
    counts: Counter[tuple[str, str]] = Counter()
    said = (options.out / "said.txt").open("w", errors="backslashreplace")
    start = last = time.monotonic()
    with tempfile.TemporaryDirectory() as right:
        right_files(Path(right))
        numbers = range(options.first, options.first + options.inputs)
        for verdict, files in attacks(numbers, options.seed, Path(right), options.only):
            outcome = verdict.problem or {0: "done", 1: "failed", 2: "refused"}.get(
                verdict.status, f"status {verdict.status}"
            )
            counts[verdict.kind, outcome] += 1
            line = verdict.details.strip().rpartition("\n")[2][:300]
            what = f"{verdict.kind}, {' '.join(verdict.command[:1])}: {outcome}"
            print(f"{verdict.number} {verdict.time:.1f} s {what}: {line}", file=said, flush=True)
            if verdict.problem:
                _keep(options.out / f"{verdict.number:05d}", verdict, files)
            if time.monotonic() - last > 10:
                last = time.monotonic()
                bad = sum(count for (_, o), count in counts.items() if o not in _FINE)
                print(
                    f"{last - start:.0f} s: {counts.total()} inputs, {bad} got through", flush=True
                )
    for (kind, outcome), count in sorted(counts.items()):
        print(f"{kind:14} {outcome:18} {count}")
    bad = sum(count for (_, outcome), count in counts.items() if outcome not in _FINE)
    print(f"{counts.total()} inputs, {bad} got through; what did is in {options.out}")
    return 1 if bad else 0


_FINE = ("done", "failed", "refused")


def _keep(place: Path, verdict: Verdict, files: dict[str, bytes]) -> None:
    place.mkdir()
    for name, content in files.items():
        (place / name).write_bytes(content)
    said = f"{verdict.problem}\n{verdict.kind}: {verdict.command}\n{verdict.details}\n"
    (place / "VERDICT").write_text(said, errors="replace")


if __name__ == "__main__":
    sys.exit(main())
