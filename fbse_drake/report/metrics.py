"""Figures of merit of a run, computed from its log."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from fbse_drake.files import write_text
from fbse_drake.log import Log

# A foot counts as standing while it carries at least this share of the weight.
_STANDING_SHARE = 0.05


def simulation_metrics(log: Log, wall_time: float) -> dict[str, Any]:
    """Contents of metrics.json for a simulated log; NaN where a figure does not apply.

    Args:
        wall_time: time the run took [s].
    """
    joints = log.joints
    simulated = float(log.time[-1] - log.time[0])
    unknown = {phase: dict.fromkeys(joints, math.nan) for phase in ("stance", "swing")}
    return {
        "fell": bool(log.meta["outcome"]["fell"]),
        "outcome": log.meta["outcome"]["reason"],
        "simulated_time": simulated,
        "wall_time": wall_time,
        "real_time_factor": simulated / wall_time,
        "joint_tracking_rms": dict(zip(joints, joint_tracking_rms(log).tolist(), strict=True)),
        "com_rse_mean": com_rse_mean(log),
        "stance_creep_max": {side: max(creep, default=math.nan) for side, creep in stance_creep(log).items()},
        "friction_rmse": unknown,
        "friction_nrmse": unknown,
        "attitude_rmse_deg": dict.fromkeys(("roll", "pitch"), math.nan),
        "base_velocity_rmse": dict.fromkeys("xyz", math.nan),
        "tick_us": dict.fromkeys(("median", "p99"), math.nan),
    }


def joint_tracking_rms(log: Log) -> np.ndarray:
    """Root mean square of reference minus true joint angle over the run, shape (n,) [rad]."""
    error = log["reference/joint/position"] - log["truth/joint/position"]
    return np.sqrt(np.mean(error**2, axis=0))


def com_rse(log: Log) -> np.ndarray:
    """Root square error of the CoM in x and y over time (paper eq. 70), shape (N, 2) [m]."""
    return np.abs(log["reference/com/position"] - log["truth/com/position"])[:, :2]


def com_rse_mean(log: Log) -> dict[str, float]:
    """Mean of `com_rse` over the run [m]; NaN for a motion without a planned CoM."""
    if "reference/com/position" not in log.channels:
        return {"x": math.nan, "y": math.nan}
    return dict(zip("xy", com_rse(log).mean(axis=0).tolist(), strict=True))


def stance_creep(log: Log) -> dict[str, list[float]]:
    """How far each foot's sole moves over the ground in each stance [m], by side.

    A stance is one stretch of time in which the plan has the foot on the ground; it counts from when the foot takes up 5 % of the
    feet's mean load to when it falls below, around the time of its largest load. (A foot that carries next to nothing may slide.)
    """
    load = {side: log[f"truth/foot/{side}/pad_force"][:, :, 2].sum(axis=1) for side in log.sides}
    threshold = _STANDING_SHARE * np.mean(sum(load.values()))
    creep: dict[str, list[float]] = {side: [] for side in log.sides}
    for side in log.sides:
        if f"reference/foot/{side}/support" not in log.channels:
            continue
        planned = np.concatenate([[0.0], log[f"reference/foot/{side}/support"], [0.0]])
        for start, end in np.flatnonzero(np.diff(planned)).reshape(-1, 2):
            peak = start + int(load[side][start:end].argmax())
            light = np.flatnonzero(load[side] < threshold)
            first = max(start, light[light < peak].max(initial=-1) + 1)
            last = min(end, light[light > peak].min(initial=len(log.time)))
            position = log[f"truth/foot/{side}/position"][first:last, :2]
            creep[side].append(float(np.linalg.norm(position - position[0], axis=1).max()))
    return creep


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Writes JSON; what is not a number becomes `NaN`."""
    write_text(Path(path), json.dumps(content, indent=2) + "\n")
