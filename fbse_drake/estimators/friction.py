"""From the measured friction of each joint, which is noisy, to the friction estimate.

Two LeafSystems have its ports: `RecursiveLeastSquares` is the paper's: the measurement while the
leg stands, a model identified from it while the leg swings. `ModelAided` weighs both at all times.
"""

import numpy as np

from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import leg_of_joint

# What feeds such an estimator, by input.
MEASURED = {"measurements": "sensor_monitor", "link_torque": "link_torque"}


class FrictionEstimator(RecursiveEstimator):
    """What both friction estimators share.

    .. pydrake_system::

        name: FrictionEstimator
        input_ports:
        - measurements
        - link_torque
        output_ports:
        - posterior
        - (one for each field)

    Inputs: posteriors of `SensorMonitor` and `LinkTorqueEstimator`. Fields of the posterior:
    `friction` (n,) [Nm], the estimate for the tick that ends now; `parameters` (n, m), their
    `parameter_variance` (n, m) and `covariance` (n, m, m) of the model; `innovation` and
    `innovation_variance` (n,).
    """

    def __init__(
        self,
        regressor: FrictionRegressor,
        robot: Robot,
        measurements: np.dtype,
        link_torque: np.dtype,
        clock: Clock,
        covariance_size: int,
        **further: tuple[int, ...],
    ):
        """Declares ports and state.

        Args:
            regressor: of the friction.
            measurements, link_torque: types of the inputs' posteriors.
            covariance_size: how many states each joint's covariance has.
            further: shapes of further fields of the posterior.
        """
        self._regressor = regressor
        n, m = len(robot.joint_names), self._regressor.parameters
        posterior_type = record_type(
            time=(),
            status=(),
            friction=(n,),
            parameters=(n, m),
            parameter_variance=(n, m),
            covariance=(n, covariance_size, covariance_size),
            innovation=(n,),
            innovation_variance=(n,),
            **further,
        )
        super().__init__(posterior_type, clock)
        self._leg = leg_of_joint(robot)
        self._measurements = self._declare_record_input("measurements", measurements)
        self._link = self._declare_record_input("link_torque", link_torque)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        n, feet = len(robot.joint_names), len(robot.description.sides)
        measured = ("residual", "torque_variance", "impulse_variance", "own_inertia", "valid")
        return {
            # Joints of no leg ask for the last one's, so there is at least one.
            "measurements": record_type(
                trust=(2 + feet,), support=(max(1, feet),), joint_velocity=(n,)
            ),
            "link_torque": record_type(**dict.fromkeys(measured, (n,)), late=(), duration=()),
        }
