"""The figures of the README: `python -m benchmarks.figures` (some minutes)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.signal import periodogram

from fbse_drake import Log, load_scenario, simulate
from fbse_drake.report.metrics import friction_law_error, joint_tracking_rms, stance_creep
from fbse_drake.scenario import SensorsConfig

_SEEDS = range(10)
# Of the plant [ms], finest first.
_STEPS = (0.5, 1.0, 2.0)


def exact_log(name: str, step: float) -> Log:
    """A run without sensor errors at a plant step [ms]."""
    scenario = load_scenario(name, overrides=[f"plant.time_step={step}e-3"])
    return simulate(dataclasses.replace(scenario, sensors=SensorsConfig()), name=name).log


def falls(logs: Sequence[Log]) -> int:
    """How many of the runs ended in a fall."""
    return sum(log.meta["outcome"]["fell"] for log in logs)


def tracking(logs: Sequence[Log]) -> float:
    """Tracking error of the worst joint of all runs [rad rms]."""
    return max(joint_tracking_rms(log).max() for log in logs)


def creep(logs: Sequence[Log]) -> float:
    """How far a sole moves in the worst stance of all runs [m]."""
    return max(max(stances) for log in logs for stances in stance_creep(log).values())


def law_error(logs: Sequence[Log]) -> float:
    """Friction law error of the worst joint of all runs [1]."""
    return np.nanmax([list(friction_law_error(log).values()) for log in logs])


def ringing(log: Log) -> float:
    """Share of the friction's power above a quarter of the tick rate, in the worst joint [1]."""
    rate = 1 / log.meta["period"]
    frequency, power = periodogram(log["truth/joint/friction_torque"], rate, axis=0)
    return (power[frequency > rate / 4].sum(axis=0) / power.sum(axis=0)).max()


def com_difference(coarse: Log, fine: Log) -> float:
    """Largest difference of the CoM's coordinates at the rows of `coarse` [m]."""
    every = round(coarse.meta["period"] / fine.meta["period"])
    pair = (coarse["truth/com/position"], fine["truth/com/position"][::every])
    # One that falls is shorter.
    rows = min(map(len, pair))
    return np.abs(pair[0][:rows] - pair[1][:rows]).max()


def print_steps(runs: dict[float, Log]) -> None:
    """Prints what becomes of runs with their plant step [ms]; the first is the finest."""
    columns = ("plant step", "CoM to finest", "CoM to half step", "falls", "tracking", "law error")
    print("  exact sensors, largest or worst:")
    print("   " + "".join(f"{column:>18}" for column in columns))
    finest = next(iter(runs.values()))
    for step, log in runs.items():
        half = runs.get(step / 2)
        cells = (
            f"{step:g} ms",
            f"{1e3 * com_difference(log, finest):.2f} mm",
            "" if half is None else f"{1e3 * com_difference(log, half):.2f} mm",
            f"{falls([log])}",
            f"{1e3 * tracking([log]):.2f} mrad",
            f"{1e2 * law_error([log]):.3f} %",
        )
        print("   " + "".join(f"{cell:>18}" for cell in cells))


def main() -> None:
    """Prints them for both walks."""
    for name in ("paper_walk", "hrp2_friction_walk"):
        seeds = (load_scenario(name, overrides=[f"seed={seed}"]) for seed in _SEEDS)
        logs = [simulate(scenario, name=name).log for scenario in seeds]
        runs = {step: exact_log(name, step) for step in _STEPS}
        print(name)
        print(f"  falls in seeds 0-9                      {falls(logs)}")
        print(f"  joint tracking rms, worst               {1e3 * tracking(logs):.2f} mrad")
        print(f"  stance creep, worst                     {1e3 * creep(logs):.3f} mm")
        print(f"  friction law error, worst               {1e2 * law_error(logs):.3f} %")
        print(f"  ringing of friction, exact sensors      {1e2 * ringing(runs[1.0]):.3f} %")
        print_steps(runs)


if __name__ == "__main__":
    main()
