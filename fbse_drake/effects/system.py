"""Joint torque effects in a diagram, stable at any slope."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from fbse_drake.effects.joint_torque import JointMotion, ResolvedEffect, total_torque_and_slope

# Newton's method stops at a step of this size [rad/s]; its last step is still taken. A plant step changes velocities by far more.
_LAST_STEP = 3e-4
_MAX_ITERATIONS = 60


@dataclass(frozen=True)
class ImplicitStep:
    """Solution of `solve_implicit_step`, arrays of shape (n,)."""

    # Velocity at the end of the step [rad/s] and the torque loss of that velocity [Nm].
    velocity: np.ndarray
    torque: np.ndarray
    # Derivative of the velocity with respect to the free velocity [1].
    gain: np.ndarray


def solve_implicit_step(
    effects: Sequence[ResolvedEffect], free_velocity: np.ndarray, mobility: np.ndarray, guess: np.ndarray
) -> ImplicitStep:
    """Solves v + mobility * u(v) = free_velocity, for each joint by itself.

    This is one step of implicit Euler: v is the velocity at the end of the step, `free_velocity` what it would be without the effects,
    `mobility` the step over the joint's inertia. The left side must grow with v, which friction does unless its negative
    (Stribeck) slope times the mobility exceeds 1. Newton's method; where it leaves the bracket seen so far or its steps do not halve,
    bisection.

    Args:
        free_velocity, mobility, guess: shape (n,) [rad/s, rad/(Nm s), rad/s].
    """
    v, low, high, last_step = guess, -np.inf, np.inf, np.inf
    for _ in range(_MAX_ITERATIONS):
        torque, slope = total_torque_and_slope(effects, JointMotion(v))
        gain = 1.0 / (1.0 + mobility * slope)
        excess = v + mobility * torque - free_velocity
        step = excess * gain
        if step @ step < _LAST_STEP**2:
            break
        above = excess > 0
        high, low = np.where(above, v, high), np.where(above, low, v)
        newton, middle = v - step, (low + high) / 2
        astray = (newton < low) | (newton > high) | (np.abs(step) > 0.5 * np.abs(last_step))
        v = np.where(astray & np.isfinite(middle), middle, newton)
        last_step = step
    return ImplicitStep(v - step, torque - slope * step, gain)


class JointTorqueEffects(LeafSystem):
    """Applies joint torque effects to a plant with steps of `time_step`, semi-implicitly.

    Friction is stiff: its slope at rest times the step is often larger than the joint's inertia, where an explicit torque rings.
    Each tick solves, joint by joint, one step of implicit Euler for the effects' torque. What the joint would do without them is
    taken from its last step: with inertia I and step h, the velocity without effects is

        v[k+1] = v[k] + (v[k] - v[k-1]) + h/I u[k-1]

    and u[k] = u(v_hat[k+1]) with v_hat + h/I u(v_hat) equal to that. Where I is the joint's inertia this is implicit Euler exactly;
    linear analysis for an inertia wrong by the factor r gives poles inside the unit circle for every slope if 0 < r < 4/3, so I is
    chosen on the small side (`conservative_inertia`). In the limit of small steps u[k] = u(v[k]). A sudden change of the motor's torque is
    felt one tick late.

    .. pydrake_system::

        name: JointTorqueEffects
        input_ports:
        - joint_state
        output_ports:
        - torque_loss

    `joint_state` is [positions, velocities], shape (2n,) [rad, rad/s]; `torque_loss` is u [Nm], shape (n,), that acts from the tick on.
    Discrete state: the torque loss, (n,), and for the next tick the velocity and the free, final velocity and gain of the step, (4, n).
    The state of a tick is made in a discrete update, which sees the velocities of that tick (see `fbse_drake.sampling`).
    """

    def __init__(self, effects: Sequence[ResolvedEffect], inertia: np.ndarray, time_step: float):
        """Declares ports, state and updates.

        Args:
            effects: what acts.
            inertia: effective inertia of each joint, or less, shape (n,) [kg m^2].
            time_step: the plant's step [s].
        """
        super().__init__()
        n = len(inertia)
        self._effects = list(effects)
        self._mobility = time_step / inertia
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * n)
        self._torque = self.DeclareDiscreteState(n)
        self._memory = self.DeclareDiscreteState(4 * n)
        self.DeclareStateOutputPort("torque_loss", self._torque)
        if effects:
            self.DeclareInitializationDiscreteUpdateEvent(self._start)
            self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, self._step)

    def _start(self, context: Context, state: DiscreteValues) -> None:
        v = self._joint_state.Eval(context)[len(self._mobility) :]
        torque, slope = total_torque_and_slope(self._effects, JointMotion(v))
        state.set_value(self._torque, torque)
        # As if the joint had been moving on like this.
        state.set_value(self._memory, np.concatenate([v, v + self._mobility * torque, v, 1.0 / (1.0 + self._mobility * slope)]))

    def _step(self, context: Context, state: DiscreteValues) -> None:
        n = len(self._mobility)
        v = self._joint_state.Eval(context)[n:]
        memory = state.get_mutable_value(self._memory)
        last_v, last_free, last_end, last_gain = memory[:n], memory[n : 2 * n], memory[2 * n : 3 * n], memory[3 * n :]
        free_velocity = v + (v - last_v) + self._mobility * state.get_value(self._torque)
        guess = last_end + last_gain * (free_velocity - last_free)
        solution = solve_implicit_step(self._effects, free_velocity, self._mobility, guess)
        state.set_value(self._torque, solution.torque)
        last_v[:], last_free[:], last_end[:], last_gain[:] = v, free_velocity, solution.velocity, solution.gain


def conservative_inertia(compliance: np.ndarray) -> np.ndarray:
    """Inertia per joint that keeps `JointTorqueEffects` stable for coupled joints, shape (n,) [kg m^2].

    The inertia of each joint alone, 1 / W[j, j], scaled by one factor so that the eigenvalues of diag(inertia) W stay below 0.75 for the
    compliance W, shape (n, n), see `Robot.joint_compliance`; what is left to 4/3 is for other postures.
    """
    alone = 1.0 / np.diag(compliance)
    correlation = compliance * np.sqrt(np.outer(alone, alone))
    return 0.75 * alone / np.linalg.eigvalsh(correlation)[-1]
