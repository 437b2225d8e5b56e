"""Joint torque effects in a diagram, stable at any slope."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State, ValueProducer

from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque

# Newton's method stops at a step of this size [rad/s]; its last step is still taken. A plant step changes velocities by far more.
_LAST_STEP = 3e-4
_MAX_ITERATIONS = 60
# The left side's derivative is taken to be at least this.
_LEAST_GROWTH = 0.05
# Rows of the state before those of the effects' memories, see `JointTorqueEffects`.
_POSITION, _VELOCITY, _COMMAND, _TORQUE, _FREE, _END, _GAIN, _ROWS = range(8)


class ImplicitStep(NamedTuple):
    """Solution of `solve_implicit_step`, arrays of shape (n,)."""

    # Velocity at the end of the step [rad/s] and the torque loss of that velocity [Nm].
    velocity: np.ndarray
    torque: np.ndarray
    # Derivative of the velocity with respect to the free velocity [1].
    gain: np.ndarray


def solve_implicit_step(
    torque_and_slope: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    free_velocity: np.ndarray,
    mobility: np.ndarray,
    guess: np.ndarray,
) -> ImplicitStep:
    """Solves v + mobility * u(v) = free_velocity, for each joint by itself.

    This is one step of implicit Euler: v is the velocity at the end of the step, `free_velocity` what it would be without the effects,
    `mobility` the step over the joint's inertia. The left side grows with v, unless a negative (Stribeck) slope times the mobility exceeds
    1; then there may be several solutions, and it is one of them. Newton's method; where it leaves the bracket seen so far or its steps do
    not halve, bisection.

    Args:
        torque_and_slope: u(v) [Nm] and its derivative [Nm s/rad], each (n,), for v (n,).
        free_velocity, mobility, guess: shape (n,) [rad/s, rad/(Nm s), rad/s].
    """
    work = np.empty((6, len(guess)))
    v = work[0]
    v[:], work[3], work[4:] = guess, -math.inf, math.inf
    for _ in range(_MAX_ITERATIONS):
        torque, slope = torque_and_slope(v)
        if _newton_step(work, torque, slope, free_velocity, mobility):
            break
    return ImplicitStep(v, work[1], work[2])


@njit(cache=True)
def _newton_step(work: np.ndarray, torque: np.ndarray, slope: np.ndarray, free_velocity: np.ndarray, mobility: np.ndarray) -> bool:
    """One iteration of `solve_implicit_step` in place; says whether it was the last.

    Args:
        work: rows of (n,): the three of `ImplicitStep`, lower and upper end of the bracket, last step.
    """
    v, end_torque, gain, low, high, last_step = work[0], work[1], work[2], work[3], work[4], work[5]
    # Where the left side falls, Newton's step would lead away from the solution.
    gain[:] = 1.0 / np.maximum(1.0 + mobility * slope, _LEAST_GROWTH)
    excess = v + mobility * torque - free_velocity
    step = excess * gain
    end_torque[:] = torque - slope * step
    newton = v - step
    if (step * step).sum() < _LAST_STEP**2:
        v[:] = newton
        return True
    for i in range(len(v)):
        if excess[i] > 0:
            high[i] = v[i]
        else:
            low[i] = v[i]
        middle = (low[i] + high[i]) / 2
        astray = newton[i] < low[i] or newton[i] > high[i] or abs(step[i]) > 0.5 * abs(last_step[i])
        v[i] = middle if astray and math.isfinite(middle) else newton[i]
        last_step[i] = step[i]
    return False


@njit(cache=True)
def _begin_step(state: np.ndarray, last: np.ndarray, joint_state: np.ndarray, command: np.ndarray, mobility: np.ndarray) -> None:
    """Fills rows of the next state: what is known when a step begins, and a guess of the velocity at its end."""
    n = len(command)
    for i in range(n):
        v = joint_state[n + i]
        free_velocity = v + (v - last[_VELOCITY, i]) + mobility[i] * last[_TORQUE, i]
        state[_POSITION, i], state[_VELOCITY, i], state[_COMMAND, i], state[_FREE, i] = joint_state[i], v, command[i], free_velocity
        state[_END, i] = last[_END, i] + last[_GAIN, i] * (free_velocity - last[_FREE, i])


class JointTorqueEffects(LeafSystem):
    """Applies joint torque effects to a plant with steps of `time_step`, semi-implicitly.

    Friction is stiff: its slope at rest times the step is often larger than the joint's inertia, where an explicit torque rings.
    Each tick solves, joint by joint, one step of implicit Euler for the effects' torque. What the joint would do without them is
    taken from its last step: with inertia I and step h, the velocity without effects is

        v[k+1] = v[k] + (v[k] - v[k-1]) + h/I u[k-1]

    and u[k] = u(v_hat[k+1]) with v_hat + h/I u(v_hat) equal to that. Where I is the joint's inertia this is implicit Euler exactly;
    linear analysis for an inertia wrong by the factor r gives poles inside the unit circle for every slope if 0 < r < 4/3, so I is
    chosen on the small side (`conservative_inertia`). In the limit of small steps u[k] = u(v[k]). A sudden change of the motor's torque is
    felt one tick late by what depends on the velocity.

    .. pydrake_system::

        name: JointTorqueEffects
        input_ports:
        - joint_state
        - torque_command
        output_ports:
        - torque_loss

    `joint_state` is [positions, velocities], shape (2n,) [rad, rad/s]; `torque_command` and `torque_loss` u have shape (n,) [Nm] and act
    from the tick on. Discrete state, rows of (n,): position, velocity, command, torque loss, free and final velocity and gain of the last
    tick's step, and the memories of the effects at its start.

    Memories follow the joint's true velocity, but where the slope exceeds I/h they follow more and more the final velocity that was solved
    for: a bristle must not be stiffer than a step can follow, or an inertia that is chosen too small lets it ring.
    """

    def __init__(self, effects: Sequence[ResolvedJointTorque], inertia: np.ndarray, time_step: float):
        """Declares ports, state and updates.

        Args:
            effects: what acts.
            inertia: effective inertia of each joint, or less, shape (n,) [kg m^2].
            time_step: the plant's step [s].
        """
        super().__init__()
        n = len(inertia)
        self._n, self._time_step, self._mobility, self._nothing = n, time_step, time_step / inertia, np.zeros(n)
        self._effects, rows = [], _ROWS
        for effect in effects:
            start = rows
            if effect.effect.has_memory:
                rows += len(effect.effect.start(JointMotion(np.zeros(n), time_step=time_step), effect.nonlinear))
            self._effects.append((effect, slice(start, rows)))
        self._remembering = [(effect, rows) for effect, rows in self._effects if effect.effect.has_memory]
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * n)
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        self._state = self.DeclareDiscreteState(np.full(rows * n, math.nan))
        sources = {self.all_input_ports_ticket(), self.time_ticket(), self.xd_ticket()}
        step = ValueProducer(allocate=lambda: Value[object](), calc=self._calc_step)
        self._step = self.DeclareCacheEntry("step", step, sources)
        self.DeclareVectorOutputPort("torque_loss", n, self._calc_torque, {self._step.ticket()})
        if effects:
            self.DeclarePeriodicUnrestrictedUpdateEvent(time_step, 0.0, self._remember)

    def _calc_step(self, context: Context, output: Value) -> None:
        """The next state."""
        n, mobility, time, time_step = self._n, self._mobility, context.get_time(), self._time_step
        joint_state, command = self._joint_state.Eval(context), self._torque_command.Eval(context)
        last = context.get_discrete_state(self._state).value().reshape(-1, n)
        state = np.empty_like(last)
        _begin_step(state, last, joint_state, command, mobility)
        position, v = state[_POSITION], state[_VELOCITY]
        first = math.isnan(last[_VELOCITY, 0])
        load = command if first else last[_COMMAND] - last[_TORQUE]
        for effect, rows in self._remembering:
            if first:
                now = JointMotion(v, position, command, time, time_step)
                state[rows] = effect.effect.start(now, effect.nonlinear)
            else:
                velocity = last[_END] + np.clip(2.0 * last[_GAIN], 0.0, 1.0) * (v - last[_END])
                step = JointMotion(velocity, last[_POSITION], last[_COMMAND], time - time_step, time_step, last[rows])
                state[rows] = effect.effect.advance(step, effect.nonlinear)

        def torque_and_slope(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            torque = slope = self._nothing
            for effect, rows in self._effects:
                more = effect.torque_and_slope(JointMotion(velocity, position, command, time, time_step, state[rows], load))
                torque, slope = torque + more[0], slope + more[1]
            return torque, slope

        if first:
            # As if the joint had been moving on like this.
            state[_FREE], state[_END] = v + mobility * torque_and_slope(v)[0], v
        state[_END], state[_TORQUE], state[_GAIN] = solve_implicit_step(torque_and_slope, state[_FREE], mobility, state[_END])
        output.set_value(state)

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._step.Eval(context)[_TORQUE])

    def _remember(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._state).set_value(self._step.Eval(context).ravel())


def conservative_inertia(compliance: np.ndarray) -> np.ndarray:
    """Inertia per joint that keeps `JointTorqueEffects` stable for coupled joints, shape (n,) [kg m^2].

    The inertia of each joint alone, 1 / W[j, j], scaled by one factor so that the eigenvalues of diag(inertia) W stay below 0.75 for the
    compliance W, shape (n, n), see `Robot.joint_compliance`; what is left to 4/3 is for other postures.
    """
    alone = 1.0 / np.diag(compliance)
    correlation = compliance * np.sqrt(np.outer(alone, alone))
    return 0.75 * alone / np.linalg.eigvalsh(correlation)[-1]
