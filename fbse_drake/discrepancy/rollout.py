"""The model simulated against a log: the error that a user of the model would see."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fbse_drake.errors import InputError
from fbse_drake.estimators.reference_methods import NoEstimator
from fbse_drake.log import Log
from fbse_drake.scenario import Scenario
from fbse_drake.simulate import simulate


@dataclass(frozen=True)
class RolloutError:
    """How far the simulated model is from a log, root mean squares over the time that both have."""

    # By joint [rad], [rad/s], [Nm].
    position: dict[str, float]
    velocity: dict[str, float]
    torque_command: dict[str, float]
    # Simulated time [s], and why it ended early, or None.
    time: float
    failure: str | None

    @property
    def mean_position(self) -> float:
        """Root mean square over all joints [rad]."""
        return float(np.sqrt(np.mean(np.square(list(self.position.values())))))

    @property
    def mean_torque_command(self) -> float:
        """Root mean square over all joints [Nm]."""
        return float(np.sqrt(np.mean(np.square(list(self.torque_command.values())))))


def rollout(scenario: Scenario, log: Log, *, progress: Callable[[float], None] | None = None) -> RolloutError:
    """Simulates the scenario's model, with all its effects, in the place of the robot and compares it with a log.

    Reference and controller are the scenario's; sensor noise is drawn anew.

    Raises:
        InputError: see `simulate`; or the log and the simulation share no time.
    """
    duration = min(scenario.duration, float(log.time[-1]))
    believed = replace(scenario, robot=scenario.believed, estimator=NoEstimator(), seed=scenario.seed + 1, duration=duration)
    result = simulate(believed, progress=progress)
    simulated = result.log
    rows = np.searchsorted(simulated.time, log.time - 1e-9)
    shared = (rows < len(simulated.time)) & (np.abs(simulated.time[np.minimum(rows, len(simulated.time) - 1)] - log.time) < 1e-6)
    if not shared.any():
        raise InputError("the log and the simulated model have no sample time in common")
    errors = []
    for channel in ("joint/position", "joint/velocity", "joint/torque_command"):
        if channel not in log:
            errors.append({})
            continue
        difference = simulated[channel][rows[shared]] - log[channel][shared]
        errors.append(dict(zip(log.joints, np.sqrt((difference**2).mean(axis=0)).tolist(), strict=True)))
    return RolloutError(*errors, time=float(simulated.time[-1]), failure=result.failure)
