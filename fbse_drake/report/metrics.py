"""Figures of merit of a run, computed from its log.

Estimates are compared with the truth from `_SETTLING_TIME` on. Friction is that of a step: row k of
the estimate belongs to the step that ends at `time[k]`, row k of the truth to the step that begins
then.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from fbse_drake.log import Log

# A foot counts as standing while it carries at least this share of the weight.
_STANDING_SHARE = 0.05
# The beginning of a log that no figure of an estimate counts: the filters start from wide priors
# and settle [s].
_SETTLING_TIME = 0.2
PHASES = ("stance", "swing")
# A joint's simulated torque follows its law if it differs by at most this share of the law's rms.
LAW_TOLERANCE = 0.01


@dataclass(frozen=True)
class Consistency:
    """A filter's mean normalised innovation squared (NIS), about 1 if its noise is as large as the
    filter believes."""

    nis: float
    # Between these lie 95 % of such means, if the innovations are white.
    lower: float
    upper: float
    # Innovations that the mean is over.
    count: int


def run_metrics(log: Log, wall_time: float, tick_time: np.ndarray | None = None) -> dict[str, Any]:
    """Contents of metrics.json for a simulated log or one with estimates.

    What does not apply is NaN (None for `fell`), which becomes null in the file.

    Args:
        wall_time: time the run took [s].
        tick_time: time that each of the estimator's ticks took [s], if it was measured.
    """
    joints = log.joints
    simulated = float(log.time[-1] - log.time[0])
    outcome = log.meta.get("outcome") or {"fell": None, "reason": "recorded"}
    return {
        "fell": outcome["fell"],
        "outcome": outcome["reason"],
        "simulated_time": simulated,
        "wall_time": wall_time,
        "real_time_factor": simulated / wall_time,
        "joint_tracking_rms": dict(zip(joints, joint_tracking_rms(log).tolist(), strict=True)),
        "com_rse_mean": com_rse_mean(log),
        "stance_creep_max": {
            side: max(creep, default=math.nan) for side, creep in stance_creep(log).items()
        },
        "friction_law_error": friction_law_error(log),
        "friction_rmse": friction_rmse(log),
        "friction_nrmse": friction_nrmse(log),
        "attitude_rmse_deg": attitude_rmse_deg(log),
        "base_velocity_rmse": base_velocity_rmse(log),
        "tick_us": tick_us(tick_time),
    }


def joint_tracking_rms(log: Log) -> np.ndarray:
    """Root mean square of reference minus joint angle (see `joint_position_channel`) over the run,
    shape (n,) [rad].

    NaN without a reference.
    """
    if "reference/joint/position" not in log:
        return np.full(len(log.joints), math.nan)
    return _rms(log["reference/joint/position"] - log[joint_position_channel(log)])


def joint_position_channel(log: Log) -> str:
    """The channel of the joint angles: the true ones, the measured ones in a log without truth."""
    return "truth/joint/position" if "truth/joint/position" in log else "joint/position"


def com_rse(log: Log) -> np.ndarray:
    """Root square error of the CoM in x and y over time (paper eq. 70), shape (N, 2) [m]."""
    return np.abs(log["reference/com/position"] - log["truth/com/position"])[:, :2]


def com_rse_mean(log: Log) -> dict[str, float]:
    """Mean of `com_rse` over the run [m]; NaN for a motion without a planned CoM, or without
    truth."""
    if "reference/com/position" not in log or "truth/com/position" not in log:
        return {"x": math.nan, "y": math.nan}
    return dict(zip("xy", com_rse(log).mean(axis=0).tolist(), strict=True))


def stance_creep(log: Log) -> dict[str, list[float]]:
    """How far each foot's sole moves over the ground in each stance [m], by side.

    A stance is one stretch of time in which the plan has the foot on the ground; it counts from
    when the foot takes up 5 % of the feet's mean load to when it falls below, around the time of
    its largest load. (A foot that carries next to nothing may slide.) A log without truth has no
    creep.
    """
    if not has_feet(log, "truth/foot/{}/pad_force") or not has_feet(log, "truth/foot/{}/position"):
        return {side: [] for side in log.sides}
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


def settled(log: Log) -> np.ndarray:
    """Rows that figures of an estimate count, shape (N,), bool."""
    return log.time >= log.time[0] + _SETTLING_TIME


def has_feet(log: Log, channel: str) -> bool:
    """Whether the log has this channel, as in `foot/{}/pad_force`, for every side, and has
    sides."""
    return bool(log.sides) and all(channel.format(side) in log for side in log.sides)


def joint_sides(log: Log) -> list[str | None]:
    """Whose leg each joint belongs to: as the log says, else by its name (`left_knee_pitch`), or by
    its place.

    Legs follow one another in the order of the sides, with equally many joints. A recording of
    which only some feet are left names legs that are none of its sides.
    """
    if "legs" in log.meta:
        legs = {side: joints for side, joints in log.meta["legs"].items() if side in log.sides}
        return [
            next((side for side, joints in legs.items() if joint in joints), None)
            for joint in log.joints
        ]
    named = [
        next((side for side in log.sides if joint.startswith(f"{side}_")), None)
        for joint in log.joints
    ]
    if log.sides and not any(named):
        return [
            log.sides[joint * len(log.sides) // len(log.joints)] for joint in range(len(log.joints))
        ]
    return named


def stance(log: Log) -> dict[str, np.ndarray]:
    """When each foot stands, (N,) bool by side: by the plan, without one by the estimated support;
    empty if neither is known."""
    if has_feet(log, "reference/foot/{}/support"):
        return {side: log[f"reference/foot/{side}/support"] > 0 for side in log.sides}
    if log.sides and "estimate/support" in log:
        return dict(zip(log.sides, log["estimate/support"].T > 0, strict=True))
    return {}


def ended_step(log: Log, channel: str) -> np.ndarray:
    """What a channel says of steps that begin at its rows' times, (N, ...), moved to the rows where
    they end; NaN before the first. Where rows are rarer than steps the step of the same row is the
    nearest."""
    values, period = log[channel], log.meta["period"]
    rows = round(log.meta.get("reading_time", period) / period)
    return np.concatenate([np.full_like(values[:rows], math.nan), values[: len(values) - rows]])


def friction_law_error(log: Log) -> dict[str, float]:
    """How far the simulated torque loss of each joint is from the laws of its effects [1].

    The root mean square of what acted less the law at the velocity that came out, over that of the
    law. NaN without truth, and for a joint without an effect.
    """
    names = ("truth/joint/friction_torque", "truth/joint/friction_law_torque")
    if not all(name in log for name in names):
        return dict.fromkeys(log.joints, math.nan)
    torque, law = (log[name] for name in names)
    error, size = _rms(torque - law), _rms(law)
    share = np.divide(error, size, out=np.full_like(size, math.nan), where=size > 0)
    return dict(zip(log.joints, share.tolist(), strict=True))


def broken_laws(law_error: Mapping[str, float]) -> dict[str, float]:
    """The joints of a `friction_law_error` that are above `LAW_TOLERANCE`, worst first."""
    above = {joint: error for joint, error in law_error.items() if error > LAW_TOLERANCE}
    return dict(sorted(above.items(), key=lambda item: -item[1]))


def worst_joint(figures: Mapping[str, float]) -> str:
    """The joint whose figure is largest; one whose figure is NaN only if there is no other."""
    return max(figures, key=lambda joint: np.nan_to_num(figures[joint], nan=-math.inf))


def friction_error(log: Log) -> np.ndarray:
    """Estimated minus true friction of the step that ends at each row, shape (N, n) [Nm]; NaN in
    the first row, in which no step ends."""
    return log["estimate/joint/friction_torque"] - ended_step(log, "truth/joint/friction_torque")


def friction_rmse(log: Log) -> dict[str, dict[str, float]]:
    """Root mean square of `friction_error` by phase of the joint's leg (`stance`, `swing`) and
    joint [Nm]; NaN where it is not known.

    A joint of no leg, which nothing stands on, swings.
    """
    return _friction_figures(log, normalised=False)


def friction_nrmse(log: Log) -> dict[str, dict[str, float]]:
    """`friction_rmse` over the root mean square of the true friction in the same rows [1]; NaN for
    a joint without friction."""
    return _friction_figures(log, normalised=True)


def attitude_error_deg(log: Log) -> np.ndarray:
    """Estimated minus true roll and pitch of the base, shape (N, 2) [deg]."""
    error = roll_and_pitch_deg(log["estimate/base/orientation"]) - roll_and_pitch_deg(
        log["truth/base/orientation"]
    )
    return (error + 180.0) % 360.0 - 180.0


def roll_and_pitch_deg(orientation: np.ndarray) -> np.ndarray:
    """x- and y-Euler angles (z-y-x order) of quaternions [w, x, y, z] (N, 4), shape (N, 2)
    [deg]."""
    w, x, y, z = orientation.T
    to_the_left, up = 2 * (w * x + y * z), w * w - x * x - y * y + z * z
    roll, pitch = (
        np.arctan2(to_the_left, up),
        np.arctan2(2 * (w * y - x * z), np.hypot(to_the_left, up)),
    )
    return np.rad2deg(np.stack([roll, pitch], axis=1))


def attitude_rmse_deg(log: Log) -> dict[str, float]:
    """Root mean square of `attitude_error_deg` [deg]; NaN without estimate or truth."""
    if "estimate/base/orientation" not in log or "truth/base/orientation" not in log:
        return dict.fromkeys(("roll", "pitch"), math.nan)
    return dict(
        zip(("roll", "pitch"), _rms(attitude_error_deg(log)[settled(log)]).tolist(), strict=True)
    )


def base_velocity_error(log: Log) -> np.ndarray:
    """Estimated minus true velocity of the base, shape (N, 3) [m/s]."""
    return log["estimate/base/velocity"] - log["truth/base/velocity"]


def base_velocity_rmse(log: Log) -> dict[str, float]:
    """Root mean square of `base_velocity_error` [m/s]; NaN without estimate or truth."""
    if "estimate/base/velocity" not in log or "truth/base/velocity" not in log:
        return dict.fromkeys("xyz", math.nan)
    return dict(zip("xyz", _rms(base_velocity_error(log)[settled(log)]).tolist(), strict=True))


def tick_us(tick_time: np.ndarray | None) -> dict[str, float]:
    """Median and 99th percentile of the time that a tick took [us]; NaN if it was not measured.

    Args:
        tick_time: shape (N,) [s].
    """
    if tick_time is None:
        return dict.fromkeys(("median", "p99"), math.nan)
    return dict(
        zip(("median", "p99"), (1e6 * np.percentile(tick_time, (50, 99))).tolist(), strict=True)
    )


def normalised_innovations(log: Log) -> dict[str, dict[str, np.ndarray]]:
    """Innovations squared over their variances, by filter and part of its measurement; each (N,
    components) [1].

    NaN where there was no update: where the variance or the innovation is zero, or both are still
    those of the row before.
    """
    result = {}
    for name in ("attitude", "base_state", "joint_acceleration", "friction"):
        parts: dict[str, np.ndarray] = {}
        for source in ("", "foot_", "force_"):
            squares = _normalised_squares(log, f"estimate/{name}/{source}innovation")
            if squares is not None:
                components = squares.shape[1]
                is_force = source == "force_"
                names = ["forces"] if is_force else _measurement_parts(log, name, components)
                parts |= dict(zip(names, np.split(squares, len(names), axis=1), strict=True))
        if parts:
            result[name] = parts
    return result


def _normalised_squares(log: Log, channel: str) -> np.ndarray | None:
    """Of an innovation (N, components), see `normalised_innovations`; None without it."""
    channels = (channel, f"{channel}_variance")
    if not all(name in log for name in channels):
        return None
    innovation, variance = (log[name] for name in channels)
    # Components of one measurement may share a variance.
    variance = np.repeat(variance, innovation.shape[1] // variance.shape[1], axis=1)
    updated = (variance > 0) & (innovation != 0)
    updated[1:] &= (innovation[1:] != innovation[:-1]) | (variance[1:] != variance[:-1])
    squares = np.full(innovation.shape, math.nan)
    return np.divide(innovation**2, variance, out=squares, where=updated)


def consistency(log: Log) -> dict[str, dict[str, Consistency]]:
    """Mean normalised innovation squared (NIS) by filter and part of its measurement, as in
    `normalised_innovations`.

    The bounds are those of a chi-square variable with as many degrees of freedom as there are
    innovations, divided by their number. They hold for white innovations; errors that last make a
    mean scatter more, without being wrong. The NIS of recursive least squares, which has no
    measurement noise in Nm, is that for a noise of 1 Nm.
    """
    result: dict[str, dict[str, Consistency]] = {}
    for name, parts in normalised_innovations(log).items():
        for part, squares in parts.items():
            values = squares[settled(log)]
            values = values[np.isfinite(values)]
            if len(values):
                lower, upper = nis_bounds(np.array(len(values))).tolist()
                result.setdefault(name, {})[part] = Consistency(
                    float(values.mean()), lower, upper, len(values)
                )
    return result


def nis_bounds(count: np.ndarray) -> np.ndarray:
    """Lower and upper 95 % bound of the mean of `count` (...) normalised squares of white
    innovations, shape (2, ...)."""
    return np.stack([chi2.ppf(probability, count) / count for probability in (0.025, 0.975)])


def _measurement_parts(log: Log, name: str, components: int) -> list[str]:
    """What the innovation of a filter is of, in order; parts have equally many components."""
    parts = {
        "attitude": ["gravity", "attitude by gravity", "attitude by level feet"],
        "base_state": _base_state_parts(log, components),
        "joint_acceleration": [
            f"{side} foot, {kind}" for side in log.sides for kind in ("angular", "linear")
        ],
        "friction": _friction_parts(log, components),
    }[name]
    return (
        parts
        if parts and components % len(parts) == 0
        else [str(number) for number in range(1, components + 1)]
    )


def _friction_parts(log: Log, components: int) -> list[str]:
    """Of filters joint by joint, or of one that hears the gyro, too."""
    gyro = [f"gyro, {axis}" for axis in "xyz"] if components == 3 + len(log.joints) else []
    return [*gyro, *log.joints]


def _base_state_parts(log: Log, components: int) -> list[str]:
    """Of the filter with the feet in its state, of that on legs and IMU, or of that on the LIPM,
    axis by axis."""
    if "estimate/base_state/foot_innovation" in log:
        kinds = ("position", "orientation", "velocity", "angular velocity")
        return [f"{side} foot, {kind}" for side in log.sides for kind in kinds]
    return ["position", "velocity"] if components == 6 else ["ZMP x", "ZMP y"]


def _friction_figures(log: Log, *, normalised: bool) -> dict[str, dict[str, float]]:
    figures = {phase: dict.fromkeys(log.joints, math.nan) for phase in PHASES}
    if "estimate/joint/friction_torque" not in log or "truth/joint/friction_torque" not in log:
        return figures
    error, truth = friction_error(log), ended_step(log, "truth/joint/friction_torque")
    stands, rows = stance(log), settled(log)
    never = np.zeros(len(log.time), dtype=bool)
    for joint, (name, side) in enumerate(zip(log.joints, joint_sides(log), strict=True)):
        if side is not None and side not in stands:
            continue
        stand = never if side is None else stands[side]
        for phase, counted in zip(PHASES, (rows & stand, rows & ~stand), strict=True):
            rmse = float(_rms(error[counted, joint]))
            size = float(_rms(truth[counted, joint])) if normalised else 1.0
            figures[phase][name] = rmse / size if size > 0 else math.nan
    return figures


def _rms(values: np.ndarray) -> np.ndarray:
    """Root mean square over the first axis; NaN of no values."""
    return (
        np.sqrt(np.mean(values**2, axis=0)) if len(values) else np.full(values.shape[1:], math.nan)
    )
