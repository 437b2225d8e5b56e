"""What a position servo commanded, from a recording of what it was asked for."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fbse_drake.control.position_loop import PositionLoopConfig, position_loop
from fbse_drake.errors import InputError, located
from fbse_drake.log import Log
from fbse_drake.robot.description import RobotDescription
from fbse_drake.scenario import Scenario
from fbse_drake.walking.reference import Recorded

# Shorter stretches say nothing [samples].
_FEWEST_SAMPLES = 10


def stretches(log: Log) -> Iterator[tuple[slice, Mapping[str, Any]]]:
    """The log's stretches that follow each other without a break, with their constants."""
    whole = {"start": float(log.time[0]), "end": float(log.time[-1])}
    for segment in log.meta.get("segments", [whole]):
        start, stop = np.searchsorted(log.time, [segment["start"] - 1e-9, segment["end"] + 1e-9])
        if stop - start > _FEWEST_SAMPLES:
            yield slice(int(start), int(stop)), segment


def scaled_gains(
    control: PositionLoopConfig, recorded: Recorded, constants: Mapping[str, Any]
) -> PositionLoopConfig:
    """The controller of one stretch: its gains times the number that the log keeps with the
    stretch, see `Recorded.gain`.

    Raises:
        InputError: the log keeps no such number.
    """
    if not recorded.gain:
        return control
    factor = constants.get(recorded.gain)
    if not isinstance(factor, int | float):
        numbers = [name for name, value in constants.items() if isinstance(value, int | float)]
        raise InputError(
            f"gain {recorded.gain}: expected a number that is kept with the log's stretches "
            f"(there are: {', '.join(numbers)})"
        )
    kp, kd = (
        {joint: factor * value for joint, value in gains.items()}
        for gains in (control.kp, control.kd)
    )
    return replace(control, kp=kp, kd=kd)


def with_command(scenario: Scenario, log: Log, names: RobotDescription) -> Log:
    """A log with the torques of its own position loop, where it has none but says what the robot
    was asked for (`reference: !Recorded`).

    The position loop's torque (paper eq. 68) with the gains of `control`, plus the recorded
    feed-forward, within the limits; none while a drive is off. A reference without velocities is
    taken as at rest.

    Raises:
        InputError: see `scaled_gains`; or a derivative gain, but no velocities in the log.
    """
    recorded = scenario.reference
    if (
        "joint/torque_command" in log
        or not isinstance(recorded, Recorded)
        or "reference/joint/position" not in log
    ):
        return log
    q, q_ref = log["joint/position"], log["reference/joint/position"]
    zero = np.zeros_like(q)
    torque = np.zeros_like(q)
    for rows, constants in stretches(log):
        with located("control: "):
            control = scaled_gains(scenario.control, recorded, constants)
            kp, kd, limit = (
                names.per_joint(getattr(control, key), key=key)
                for key in ("kp", "kd", "torque_limit")
            )
            if kd.any() and "joint/velocity" not in log:
                raise InputError(
                    "kd: the log has no channel joint/velocity, from which the torque of the "
                    "position loop would follow"
                )
        error, error_rate = (
            q_ref[rows] - q[rows],
            (log.get("reference/joint/velocity", zero) - log.get("joint/velocity", zero))[rows],
        )
        feedforward = (
            log.get("reference/joint/feedforward_torque", zero)[rows]
            if control.feedforward
            else 0.0
        )
        torque[rows] = np.clip(
            position_loop(error, error_rate, kp, kd) + feedforward, -limit, limit
        )
    torque *= log.get("joint/enabled", 1.0)
    return Log({**log.channels, "joint/torque_command": torque}, log.meta)
