"""The figures of the README: `python -m benchmarks.figures` (some minutes)."""

import dataclasses

import numpy as np

from fbse_drake import Log, load_scenario, simulate
from fbse_drake.report.metrics import joint_tracking_rms, stance_creep
from fbse_drake.scenario import SensorsConfig

_SEEDS = range(10)


def exact_log(name: str, *overrides: str) -> Log:
    """A run without sensor errors."""
    return simulate(dataclasses.replace(load_scenario(name, overrides=overrides), sensors=SensorsConfig()), name=name).log


def main() -> None:
    """Prints them for both walks."""
    for name in ("paper_walk", "hrp2_friction_walk"):
        logs = [simulate(load_scenario(name, overrides=[f"seed={seed}"]), name=name).log for seed in _SEEDS]
        coarse, fine = exact_log(name), exact_log(name, "plant.time_step=0.0005")
        change = np.abs(coarse["truth/com/position"] - fine["truth/com/position"]).max()
        print(name)
        print(f"  falls in seeds 0-9                     {sum(log.meta['outcome']['fell'] for log in logs)}")
        print(f"  joint tracking rms, worst              {1e3 * max(joint_tracking_rms(log).max() for log in logs):.2f} mrad")
        print(
            f"  stance creep, worst                    {1e3 * max(max(max(c) for c in stance_creep(log).values()) for log in logs):.3f} mm"
        )
        print(f"  CoM change under step halving, largest {1e3 * change:.2f} mm")


if __name__ == "__main__":
    main()
