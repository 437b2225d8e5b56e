"""The friction as only a simulation knows it, to be compared with estimates."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator


@in_library
@dataclass(frozen=True)
class TrueFriction(Estimator):
    """The friction that acted in the last tick, as only a simulation can tell (oracle)."""

    @classmethod
    def variants(cls) -> dict[str, Estimator]:
        return {}

    def add(self, chain: Chain) -> None:
        chain.add("friction", partial(TrueFrictionSource, len(chain.robot.joint_names)))


class TrueFrictionSource(RecursiveEstimator):
    """The oracle.

    .. pydrake_system::

        name: TrueFrictionSource
        input_ports:
        - torque_loss
        output_ports:
        - posterior
        - (one for each field)

    `torque_loss` (n,) [Nm] and field `friction` (n,) are those of the step that ends now.
    """

    def __init__(self, joints: int, clock: Clock):
        super().__init__(record_type(time=(), status=(), friction=(joints,)), clock)
        self._torque_loss = self.DeclareVectorInputPort("torque_loss", joints)
        self._declare_posterior()

    def _tick(
        self,
        context: Context,
        last: np.ndarray,  # noqa: ARG002
        elapsed: float,  # noqa: ARG002
        posterior: np.ndarray,
    ) -> None:
        posterior["status"], posterior["friction"] = 0.0, self._torque_loss.Eval(context)
