"""What friction takes of the joints' torques before they reach the links, tick by tick: what the
model's effects say, and the law that an estimator finds beside them."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque
from fbse_drake.estimators.believed_torque import BelievedTorque
from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.robot.plant import Robot
from fbse_drake.wiring import weakly

# Time constant with which the parameters of a law are taken over [s].
_LEARNING = 1.0


class BelievedFriction(LeafSystem):
    """Friction by its laws and the joints' readings as they are.

    .. pydrake_system::

        name: BelievedFriction
        input_ports:
        - joint_state
        - torque_command
        - parameters (optional)
        output_ports:
        - friction

    Inputs are [positions, velocities] as they are read (2n,) [rad, rad/s], torque commands (n,)
    [Nm], and parameters of the law, joint by joint (n m,), where there is one. `friction` (n,) [Nm]
    is that of the tick that ended. Discrete state: memories of the effects, the friction before,
    and the parameters, which are taken over slowly. What is no number leaves them as they are.

    The friction that is estimated does not go in here, and what is learned of it only slowly: it
    comes from readings that it would correct, and above the resonance of a link on its transmission
    this loop has a gain of more than one.
    """

    def __init__(
        self,
        effects: Sequence[ResolvedJointTorque],
        robot: Robot,
        period: float,
        law: FrictionRegressor | None = None,
    ):
        """Declares ports and state.

        Args:
            effects: of the model `robot`; what lets motors be ahead of their links is left out.
            period: of a tick [s].
            law: that is found beside them.
        """
        super().__init__()
        n, self._law = len(robot.joint_names), law
        friction = [effect for effect in effects if not effect.effect.deflects]
        self._believed, self._period = BelievedTorque(friction, n, period), period
        self._rotor_inertia = robot.rotor_inertias
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * n)
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        if law is not None:
            self._parameters = self.DeclareVectorInputPort("parameters", n * law.parameters)
            self._learned = self.DeclareDiscreteState(np.zeros(n * law.parameters))
        self._memory = self.DeclareDiscreteState(self._believed.start)
        self._before = self.DeclareDiscreteState(np.zeros(n))
        self._friction = self.DeclareVectorOutputPort("friction", n, weakly(self._calc))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, weakly(self._remember))
        self.DeclareForcedUnrestrictedUpdateEvent(weakly(self._remember))

    def _motion(self, context: Context) -> JointMotion:
        command = self._torque_command.Eval(context)
        return JointMotion(
            velocity=self._joint_state.Eval(context)[len(command) :],
            command=command,
            time=context.get_time() - self._period,
            load=command - context.get_discrete_state(self._before).value(),
            rotor_inertia=self._rotor_inertia,
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        memory, motion = context.get_discrete_state(self._memory).value(), self._motion(context)
        friction, _ = self._believed.torque_and_slope(memory, motion)
        if self._law is not None:
            learned = context.get_discrete_state(self._learned).value()
            weights = learned.reshape(-1, self._law.parameters)
            basis = self._law(motion.velocity)[0, :, : len(weights)]
            friction = friction + np.einsum("nk,kn->n", weights, basis)
        output.SetFromVector(friction)

    def _remember(self, context: Context, state: State) -> None:
        motion = self._motion(context)
        position = self._joint_state.Eval(context)[: len(motion.velocity)]
        memory = context.get_discrete_state(self._memory).value()
        later = self._believed.remembered(memory, motion, position)
        friction = self._friction.Eval(context)
        if np.isfinite([position, motion.velocity, motion.command, friction]).all():
            state.get_mutable_discrete_state(self._memory).set_value(later)
            state.get_mutable_discrete_state(self._before).set_value(friction)
        if self._law is None:
            return
        learned = context.get_discrete_state(self._learned).value()
        change = self._parameters.Eval(context) - learned
        if np.isfinite(change).all():
            share = self._period / (self._period + _LEARNING)
            state.get_mutable_discrete_state(self._learned).set_value(learned + share * change)
