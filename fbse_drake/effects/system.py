"""Joint torque effects in a diagram, stable at any slope."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from fbse_drake.effects.joint_torque import JointMotion, ResolvedEffect, total_torque_and_slope

# Newton's method stops when its step is this small [rad/s]; what is left is far below the change of velocity in one plant step.
_LAST_STEP = 3e-4
_MAX_ITERATIONS = 60


def implicit_torque(effects: Sequence[ResolvedEffect], free_velocity: np.ndarray, mobility: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Torque u(v) of the velocity v that solves v + mobility * u(v) = free_velocity, for each joint by itself.

    This is one step of implicit Euler: v is the velocity at the end of the step, `free_velocity` what it would be without the effects,
    `mobility` the step over the joint's inertia. The left side must grow with v, which friction does unless its negative
    (Stribeck) slope times the mobility exceeds 1. Newton's method; where it leaves the bracket seen so
    far or its steps do not halve, bisection.

    Args:
        free_velocity, mobility, guess: shape (n,) [rad/s, rad/(Nm s), rad/s].

    Returns:
        Shape (n,) [Nm].
    """
    v, low, high, last_step = guess, -np.inf, np.inf, np.inf
    for _ in range(_MAX_ITERATIONS):
        torque, slope = total_torque_and_slope(effects, JointMotion(v))
        excess = v + mobility * torque - free_velocity
        step = excess / (1.0 + mobility * slope)
        if step @ step < _LAST_STEP**2:
            break
        above = excess > 0
        high, low = np.where(above, v, high), np.where(above, low, v)
        newton, middle = v - step, (low + high) / 2
        astray = (newton < low) | (newton > high) | (np.abs(step) > 0.5 * np.abs(last_step))
        v = np.where(astray & np.isfinite(middle), middle, newton)
        last_step = step
    return torque - slope * step


class JointTorqueEffects(LeafSystem):
    """Applies joint torque effects to a plant with steps of `time_step`, semi-implicitly.

    Friction is stiff: its slope at rest times the step is often larger than the joint's inertia, where an explicit torque rings.
    Each tick solves, joint by joint, one step of implicit Euler for the effects' torque. What the joint would do without them is
    taken from its last step: with inertia I and step h, the velocity without effects is

        v[k+1] = v[k] + (v[k] - v[k-1]) + h/I u[k-1]

    and u[k] = u(v_hat[k+1]) with v_hat + h/I u(v_hat) equal to that. Where I is the joint's inertia this is implicit Euler exactly;
    linear analysis for an inertia wrong by the factor r gives poles inside the unit circle for every slope if 0 < r < 4/3, so I is
    chosen on the small side (`conservative_inertia`). In the limit of small steps u[k] = u(v[k]).

    .. pydrake_system::

        name: JointTorqueEffects
        input_ports:
        - joint_state
        output_ports:
        - torque_loss

    `joint_state` is [positions, velocities], shape (2n,) [rad, rad/s]; `torque_loss` is u [Nm], shape (n,), that acts from the tick on.
    Discrete state: the last velocity, the last torque loss, and the one expected next, (3n,).
    """

    def __init__(self, effects: Sequence[ResolvedEffect], inertia: np.ndarray, time_step: float):
        """Args:
        effects: what acts.
        inertia: effective inertia of each joint, or less, shape (n,) [kg m^2].
        time_step: the plant's step [s].
        """
        super().__init__()
        n = len(inertia)
        self._effects = list(effects)
        self._mobility = time_step / inertia
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * n)
        # Before the first tick there is no last velocity (NaN).
        self._state = self.DeclareDiscreteState(np.concatenate([np.full(n, np.nan), np.zeros(2 * n)]))
        self.torque_loss = self.DeclareVectorOutputPort(
            "torque_loss", n, self._calc_torque_loss, {self.input_port_ticket(self._joint_state.get_index()), self.xd_ticket()}
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(time_step, 0.0, self._remember)

    def _calc_torque_loss(self, context: Context, output: BasicVector) -> None:
        if not self._effects:
            output.SetFromVector(np.zeros(len(self._mobility)))
            return
        n, mobility = len(self._mobility), self._mobility
        v = self._joint_state.Eval(context)[n:]
        memory = context.get_discrete_state(self._state).value()
        v_before, u_before, u_expected = memory[:n], memory[n : 2 * n], memory[2 * n :]
        if v_before[0] != v_before[0]:
            v_before = v
            u_before = u_expected = total_torque_and_slope(self._effects, JointMotion(v))[0]
        free_velocity = v + (v - v_before) + mobility * u_before
        guess = free_velocity - mobility * u_expected
        output.SetFromVector(implicit_torque(self._effects, free_velocity, mobility, guess))

    def _remember(self, context: Context, state: State) -> None:
        n = len(self._mobility)
        u = self.torque_loss.Eval(context)
        memory = state.get_mutable_discrete_state(self._state).get_mutable_value()
        # Expected next: that the torque goes on changing as it did.
        memory[2 * n :] = 2 * u - memory[n : 2 * n]
        memory[n : 2 * n] = u
        memory[:n] = self._joint_state.Eval(context)[n:]


def conservative_inertia(compliance: np.ndarray) -> np.ndarray:
    """Inertia per joint that keeps `JointTorqueEffects` stable for coupled joints, shape (n,) [kg m^2].

    With J = diag(inertia) the eigenvalues of J W stay below 1 (Gershgorin) for the compliance W, shape (n, n), see
    `Robot.joint_compliance`; half of that leaves room for other postures.
    """
    return 0.5 / np.abs(compliance).sum(axis=1)
