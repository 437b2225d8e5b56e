"""Joint torque effects in a diagram, stable at any slope."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from fbse_drake.effects.joint_torque import JointMotion, ResolvedEffect

# A step's velocity is found to this [rad/s]; the torque is that of exactly the velocity found.
_VELOCITY_TOLERANCE = 1e-7
_MAX_ITERATIONS = 60


def total_torque(effects: Sequence[ResolvedEffect], velocity: np.ndarray) -> np.ndarray:
    """Torque loss of several effects together [Nm], same shape as the joint velocity [rad/s]."""
    motion = JointMotion(velocity)
    return sum((effect.torque(motion) for effect in effects), np.zeros_like(velocity))


def implicit_velocity(
    effects: Sequence[ResolvedEffect], free_velocity: np.ndarray, mobility: np.ndarray, guess: np.ndarray
) -> np.ndarray:
    """Solves v + mobility * u(v) = free_velocity for each joint by itself.

    This is one step of implicit Euler: `free_velocity` is what the joint would have at the end of the step without the effects,
    `mobility` the step over the joint's inertia. The left side must grow with v, which friction does unless its negative
    (Stribeck) slope times the mobility exceeds 1. Newton's method inside a shrinking bracket.

    Args:
        free_velocity, mobility, guess: shape (n,) [rad/s, rad/(Nm s), rad/s].

    Returns:
        The velocity at the end of the step, shape (n,).
    """
    end = free_velocity - mobility * total_torque(effects, np.zeros_like(guess))
    low, high = np.minimum(0.0, end), np.maximum(0.0, end)
    v = np.minimum(np.maximum(guess, low), high)
    for _ in range(_MAX_ITERATIONS):
        motion = JointMotion(v)
        excess, slope = v - free_velocity, 1.0
        for effect in effects:
            excess = excess + mobility * effect.torque(motion)
            slope = slope + mobility * effect.slope(motion)
        above = excess > 0
        high, low = np.where(above, v, high), np.where(above, low, v)
        step = -excess / slope
        if np.abs(step).max() < _VELOCITY_TOLERANCE:
            break
        v = v + step
        outside = (v < low) | (v > high)
        if outside.any():
            v = np.where(outside, (low + high) / 2, v)
    return v


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
    Discrete state: previous velocity and previous torque loss.
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
        # Before the first tick there is no previous velocity.
        self._state = self.DeclareDiscreteState(np.concatenate([np.full(n, np.nan), np.zeros(n)]))
        self.torque_loss = self.DeclareVectorOutputPort(
            "torque_loss", n, self._calc_torque_loss, {self.input_port_ticket(self._joint_state.get_index()), self.xd_ticket()}
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(time_step, 0.0, self._remember)

    def _calc_torque_loss(self, context: Context, output: BasicVector) -> None:
        if not self._effects:
            return
        v = self._joint_state.Eval(context)[len(self._mobility) :]
        previous = context.get_discrete_state(self._state).value()
        v_before, u_before = np.split(previous, 2)
        if np.isnan(v_before[0]):
            v_before, u_before = v, total_torque(self._effects, v)
        predicted = 2 * v - v_before
        v_next = implicit_velocity(self._effects, predicted + self._mobility * u_before, self._mobility, predicted)
        output.SetFromVector(total_torque(self._effects, v_next))

    def _remember(self, context: Context, state: State) -> None:
        v = self._joint_state.Eval(context)[len(self._mobility) :]
        state.get_mutable_discrete_state(self._state).set_value(np.concatenate([v, self.torque_loss.Eval(context)]))


def conservative_inertia(compliance: np.ndarray) -> np.ndarray:
    """Inertia per joint that keeps `JointTorqueEffects` stable for coupled joints, shape (n,) [kg m^2].

    With J = diag(inertia) the eigenvalues of J W stay below 1 (Gershgorin) for the compliance W, shape (n, n), see
    `Robot.joint_compliance`; half of that leaves room for other postures.
    """
    return 0.5 / np.abs(compliance).sum(axis=1)
