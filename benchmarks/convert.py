"""How long `fbse convert` takes for a long bag, and how much memory:
`python -m benchmarks.convert [MINUTES]`.

The bag is an MCAP file with 1 kHz messages of a robot with 12 joints, an IMU and two six-axis foot
sensors. It is made by a program of its own, and converted by another one, so that the memory is
that of the conversion.
"""

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fbse_drake import Log
from fbse_drake.interop.export import write_mcap

_PERIOD = 0.001


def write_bag(path: Path, minutes: float) -> None:
    """Writes a bag of noise."""
    samples, joints = round(60 * minutes / _PERIOD), [f"joint_{i}" for i in range(12)]
    noise = np.random.default_rng(0).standard_normal
    channels = {
        f"joint/{name}": noise((samples, len(joints)))
        for name in ("position", "velocity", "torque_command")
    }
    channels |= {
        f"imu/{name}": noise((samples, 3)) for name in ("linear_acceleration", "angular_velocity")
    }
    channels |= {f"foot/{side}/wrench": noise((samples, 6)) for side in ("left", "right")}
    meta = {"joints": joints, "sides": ["left", "right"], "period": _PERIOD}
    write_mcap(Log({"time": _PERIOD * np.arange(samples)} | channels, meta), path)


def main() -> None:
    """Prints seconds and the peak of the memory."""
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    with TemporaryDirectory() as folder:
        bag, log = Path(folder) / "bag.mcap", Path(folder) / "log.npz"
        write = (
            "from pathlib import Path; from benchmarks.convert import write_bag; "
            f"write_bag(Path({str(bag)!r}), {minutes})"
        )
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", write], check=True)
        written = time.perf_counter() - start
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "fbse_drake", "convert", str(bag), str(log), "--quiet"]
        )
        _, status, usage = os.wait4(process.pid, 0)
        elapsed = time.perf_counter() - start
        if status:
            sys.exit("the conversion failed")
        print(
            f"{minutes:g} min at 1 kHz: {bag.stat().st_size / 2**20:.0f} MiB of MCAP, written in "
            f"{written:.0f} s"
        )
        print(
            f"converted in {elapsed:.1f} s ({usage.ru_utime + usage.ru_stime:.1f} s of processor "
            "time)"
        )
        print(
            f"peak memory {usage.ru_maxrss / 2**10:.0f} MiB; the log's numbers alone are "
            f"{_numbers(log) / 2**20:.0f} MiB"
        )


def _numbers(path: Path) -> int:
    return sum(values.nbytes for values in Log.load(path).values())


if __name__ == "__main__":
    main()
