"""Friction by least squares on the filtered equation of motion, to be compared with FBSE."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from fbse_drake.errors import require_positive
from fbse_drake.estimators.adaptive_friction import AdaptiveFriction
from fbse_drake.estimators.estimator import in_library
from fbse_drake.estimators.learned import FrictionLearner
from fbse_drake.robot.plant import Robot

# Parameters are believed to be near zero as if that had been seen for so long [s].
_PRIOR = 1e-3


@in_library
@dataclass(frozen=True)
class FilteredModel(AdaptiveFriction):
    """Both sides of the equation of motion through one low-pass, and least squares between them.

    No acceleration is measured or estimated (Hsu et al. 1987; Middleton and Goodwin 1988). What is
    regressed on is that of `AdaptiveFriction`; where that follows a gradient, this one weighs all
    that it has seen, back to its `memory`. A parameter that the motion does not excite keeps its
    value.
    """

    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {
        "bandwidth": (2.0, 100.0),
        "memory_time": (0.2, 50.0),
    }

    # How far back the past counts [s].
    memory_time: float = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "memory_time")

    def learner(self, robot: Robot, **arguments: Any) -> "LeastSquaresLearner":
        return LeastSquaresLearner(self, robot, **arguments)


class LeastSquaresLearner(FrictionLearner):
    """Learns the parameters of a friction law by least squares over what it has seen of late.

    Ports and fields are those of `FrictionLearner`, with the weighted sums of least squares over
    time: `information` (n, k, k), phi phi^T, and `seen` (n, k), phi u. The parameters are those of
    least squares within their range: every tick takes one step of projected Gauss-Seidel towards
    them from those of the tick before.
    """

    def __init__(self, config: FilteredModel, robot: Robot, **arguments: Any):
        """Declares ports and state; arguments as of `FrictionLearner`."""
        n, k = len(robot.joint_names), config.parameters
        super().__init__(config, robot, **arguments, information=(n, k, k), seen=(n, k))
        self._memory = config.memory_time

    def _learn(
        self, last: np.ndarray, torque: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        phi, keep = posterior["regressor"], math.exp(-elapsed / self._memory)
        information = keep * last["information"] + elapsed * phi[:, :, None] * phi[:, None, :]
        seen = keep * last["seen"] + elapsed * phi * torque[:, None]
        limits = (self._law.smallest, self._law.largest)
        posterior["information"], posterior["seen"] = information, seen
        posterior["parameters"] = gauss_seidel(last["parameters"], information, seen, limits)


def gauss_seidel(
    parameters: np.ndarray,
    information: np.ndarray,
    seen: np.ndarray,
    limits: tuple[float, float],
) -> np.ndarray:
    """One step, for n joints, towards the least squares parameters within limits, (n, k).

    Args:
        parameters: from which it goes, (n, k).
        information, seen: sums of phi phi^T (n, k, k) and of phi u (n, k) over time.
    """
    theta = parameters.copy()
    for j in range(theta.shape[1]):
        own = information[:, j, j]
        others = (information[:, j] * theta).sum(axis=1) - own * theta[:, j]
        theta[:, j] = ((seen[:, j] - others) / (own + _PRIOR)).clip(*limits)
    return theta
