"""The figures of docs/accuracy.md: `python -m benchmarks.figures` (some minutes)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.signal import periodogram

from fbse_drake import Log, Scenario, load_scenario, simulate
from fbse_drake.report.metrics import friction_law_error, joint_tracking_rms, stance_creep
from fbse_drake.robot.description import load_description
from fbse_drake.scenario import SensorsConfig

_SEEDS = range(10)
# Of the plant [ms], finest first.
_STEPS = (0.5, 1.0, 2.0)
# That of the scenarios, and their period of control.
_BASE = 1.0


def exact_log(name: str, step: float, *, same_damping: bool = False, twice: bool = False) -> Log:
    """A run without sensor errors at a plant step [ms].

    Args:
        twice: solves each step twice.
        same_damping: gives the position loop back what it loses where the plant makes several steps
            in one period of the control, see `with_same_damping`.
    """
    scenario = load_scenario(name, overrides=[f"plant.time_step={step}e-3"])
    scenario = dataclasses.replace(scenario, sensors=SensorsConfig(), solve_twice=twice)
    return simulate(with_same_damping(scenario) if same_damping else scenario, name=name).log


def with_same_damping(scenario: Scenario) -> Scenario:
    """A scenario whose position loop damps at its plant step h as at a step of its period T.

    A command that is held for T is late by T / 2, which takes kp T / 2 from the damping. A step of
    semi-implicit Euler moves a joint at the velocity of its end and gives kp h / 2 back.
    """
    control, h = scenario.control, scenario.plant.time_step
    names, _ = load_description(scenario.robot.description)
    kp, kd = (names.per_joint(getattr(control, key), key=key) for key in ("kp", "kd"))
    kd = kd + kp * (control.period - h) / 2
    kd = dict(zip(names.joint_names, kd.tolist(), strict=True))
    return dataclasses.replace(scenario, control=dataclasses.replace(control, kd=kd))


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


def print_steps(runs: dict[float, Log], same_damping: Log) -> None:
    """Prints what becomes of runs with their plant step [ms].

    Args:
        runs: the first is the finest.
        same_damping: the finest with the loop's damping at its period.
    """
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
    change = 1e3 * com_difference(runs[_BASE], same_damping)
    print(f"  CoM at {_BASE:g} ms to the finest with the same damping  {change:.2f} mm")


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
        print(f"  ringing of friction, exact sensors      {1e2 * ringing(runs[_BASE]):.3f} %")
        print_steps(runs, exact_log(name, _STEPS[0], same_damping=True))
        for step in _STEPS[1:]:
            error = 1e2 * law_error([exact_log(name, step, twice=True)])
            print(f"  law error at {step:g} ms, solved twice       {error:.3f} %")


if __name__ == "__main__":
    main()
