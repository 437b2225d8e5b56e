"""Joint torque effects in a diagram."""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    State,
    ValueProducer,
)
from pydrake.systems.primitives import Demultiplexer

from fbse_drake.effects.implicit import ImplicitLaw
from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque
from fbse_drake.effects.law_table import LawTable, law_table, look_up
from fbse_drake.robot.implicit import implicit_loss
from fbse_drake.robot.plant import Robot
from fbse_drake.robot.trial_step import TrialStep
from fbse_drake.wiring import weakly

# Share of the last step's change of velocity that is expected of the next: smooth motion would go
# on with all of it, a joint that is stopped by a contact with none.
_CARRIED_ON = 0.5
# A law that the solver takes but for this share of it is solved exactly.
_ROUNDING = 1e-12
# Rows of (n,) of what a tick remembers: explicit torque, and that of it which lets motors be ahead
# of their links; velocity when the step begins, and its change in the last step; position and
# command when it begins; then offsets of clamps and memories of effects.
_EXPLICIT, _AHEAD, _VELOCITY, _CHANGE, _POSITION, _COMMAND, _ROWS = range(7)


class Tick(NamedTuple):
    """Parts of what a tick makes, views of one vector."""

    # Generalized force in the step that begins, (velocities,) [Nm], [N].
    force: np.ndarray
    # What is remembered, in the rows named above, (rows, n).
    memory: np.ndarray


class _Solver(NamedTuple):
    """What the plant's solver takes, see `ImplicitTorque`, and where it is found."""

    damping: np.ndarray
    slope: np.ndarray
    limit: np.ndarray
    # Place of the loss in each joint's clamps in the net actuation, or -1; of each joint in the
    # velocities; (n,).
    clamp: np.ndarray
    velocity: np.ndarray


@njit(cache=True)
def _parts(vector: np.ndarray, joints: int, velocities: int) -> Tick:
    return Tick(vector[:velocities], vector[velocities:].reshape(-1, joints))


@njit(cache=True)
def _loss(
    last: np.ndarray,
    joint_state: np.ndarray,
    net_actuation: np.ndarray,
    damping: np.ndarray,
    clamp: np.ndarray,
    velocities: int,
) -> np.ndarray:
    """Loss in the step that ended: what was explicit and what the solver took, (n,) [Nm]."""
    n = len(damping)
    explicit = _parts(last, n, velocities).memory[_EXPLICIT]
    loss = np.zeros(n)
    for j in range(n):
        if not math.isnan(explicit[j]):
            loss[j] = explicit[j] + damping[j] * joint_state[n + j]
            if clamp[j] >= 0:
                loss[j] -= net_actuation[clamp[j]]
    return loss


def loss_over_time(
    robot: Robot,
    velocity: np.ndarray,
    net_actuation: np.ndarray,
    explicit_force: np.ndarray,
) -> np.ndarray:
    """What `torque_loss` told at ticks one after the other, (N, n) [Nm].

    Args:
        velocity: of the joints at every tick, (N, n) [rad/s].
        net_actuation: of the plant, of the step that ended, (N, actuators) [Nm].
        explicit_force: generalized force in the step that began, (N, velocities) [Nm], [N].
    """
    loss = np.zeros_like(velocity)
    loss[1:] = -explicit_force[:-1, robot.velocity_index]
    loss[1:] += robot.implicit.damping * velocity[1:]
    has_clamp = robot.clamp_index >= 0
    loss[1:, has_clamp] -= net_actuation[1:, robot.clamp_index[has_clamp]]
    return loss


@njit(cache=True)
def _begin(tick: Tick, last: Tick, joint_state: np.ndarray) -> np.ndarray:
    """Fills velocities and positions of a tick; returns the velocities that are expected at the
    next one, (n,) [rad/s].

    A velocity that goes on is expected to do so. One that turned back is expected amid the last
    two: where it goes to and fro, what is explicit of a law would else make it ring.
    """
    n, now, before = len(joint_state) // 2, tick.memory, last.memory
    now[_POSITION], now[_VELOCITY] = joint_state[:n], joint_state[n:]
    now[_CHANGE] = now[_AHEAD] = 0.0
    expected = joint_state[n:].copy()
    if not math.isnan(before[_VELOCITY, 0]):
        for j in range(n):
            change = joint_state[n + j] - before[_VELOCITY, j]
            now[_CHANGE, j] = change
            expected[j] += (-0.5 if change * before[_CHANGE, j] < 0 else _CARRIED_ON) * change
    return expected


@njit(cache=True)
def _finish(
    tick: Tick,
    expected: np.ndarray,
    torque: np.ndarray,
    offset: np.ndarray,
    solver: _Solver,
) -> None:
    """Fills the force of a tick: law (n,) [Nm] less what the solver takes at these velocities."""
    solved = implicit_loss(expected, solver.damping, solver.slope, solver.limit, offset)
    tick.memory[_EXPLICIT] = torque - solved
    tick.force[:] = 0.0
    tick.force[solver.velocity] = solved - torque


@njit(cache=True)
def _calc_steady(
    tick: np.ndarray,
    last: np.ndarray,
    joint_state: np.ndarray,
    is_solved: bool,
    offset: np.ndarray,
    velocities: int,
    unit: np.ndarray,
    rate: np.ndarray,
    velocity: np.ndarray,
    torque: np.ndarray,
    slope: np.ndarray,
    damping: np.ndarray,
    clamp_slope: np.ndarray,
    clamp_limit: np.ndarray,
    clamp: np.ndarray,
    velocity_index: np.ndarray,
) -> None:
    """A tick of effects that depend on the velocity alone, which the solver may take as a whole.

    Takes the parts of `LawTable` and `_Solver` one by one: from Python a tuple of arrays takes
    longer to hand over than the tick takes.
    """
    table = LawTable(unit, rate, velocity, torque, slope)
    solver = _Solver(damping, clamp_slope, clamp_limit, clamp, velocity_index)
    n = len(joint_state) // 2
    parts = _parts(tick, n, velocities)
    for row in range(len(offset)):
        for j in range(n):
            parts.memory[_ROWS + row, j] = offset[row, j]
    expected = _begin(parts, _parts(last, n, velocities), joint_state)
    _finish(parts, expected, look_up(table, expected), offset, solver)
    if is_solved:
        parts.memory[_EXPLICIT] = 0.0
        parts.force[:] = 0.0


class ExplicitTorque(LeafSystem):
    """What Drake's solver does not take of joint torque effects, and their loss as a whole.

    .. pydrake_system::

        name: ExplicitTorque
        input_ports:
        - joint_state
        - net_actuation
        - torque_command
        - plant_state (optional)
        output_ports:
        - torque_loss
        - friction
        - tick
        - deflection

    The explicit torque of a step is the law less what the solver takes of it, both at the velocity
    that is expected at its end. So its error is the slope of this difference, which is small, times
    what the expectation is wrong by. The past tells what to expect; with a `TrialStep`, where the
    step ends that is made with the torque so found does.

    `joint_state` is [positions, velocities], (2n,) [rad, rad/s]; `net_actuation` is the plant's
    [Nm], of the step that ended; `torque_command` (n,) [Nm] is of the step that begins;
    `plant_state` is there where steps are tried. `torque_loss` (n,) [Nm] is that of the step that
    ended (zero before the first), and `friction` what is left of it without what lets the motors be
    ahead of their links; `tick` has the parts of `Tick`; `deflection` (n,) [rad] is by how
    much effects let the motors be ahead of their links now. Discrete state: the last tick.
    """

    def __init__(
        self,
        law: ImplicitLaw,
        robot: Robot,
        time_step: float,
        trial: TrialStep | None = None,
    ):
        super().__init__()
        n, torque = len(robot.joint_names), law.torque
        self._law, self._time_step, self._joints = law, time_step, n
        self._rotor_inertia = robot.rotor_inertias
        self._velocities = robot.plant.num_velocities()
        places = (robot.clamp_index, robot.velocity_index)
        self._solver = _Solver(torque.damping, torque.slope, torque.limit, *places)
        steady = [effect for effect in law.effects if effect.effect.of_velocity_alone]
        self._table = law_table(steady, n)
        solved = np.array([torque.torque(v, torque.offset) for v in self._table.velocity])
        left = np.abs(self._table.torque - solved).max()
        self._is_solved = left <= _ROUNDING * np.abs(solved).max()
        # The other effects, with the rows of their memories.
        self._others: list[tuple[int, ResolvedJointTorque, slice]] = []
        self._offsets = slice(_ROWS, _ROWS + len(torque.offset))
        rows, still = self._offsets.stop, JointMotion(np.zeros(n), time_step=time_step)
        for k, effect in enumerate(law.effects):
            if effect.effect.of_velocity_alone:
                continue
            start = rows
            if effect.effect.has_memory:
                rows += len(effect.effect.start(still, effect.nonlinear))
            self._others.append((k, effect, slice(start, rows)))
        # What a tick takes of these; to put it together costs a tick as much as to read a port.
        self._known = (torque.offset, self._velocities, *self._table, *self._solver)
        self._trial = None if self._is_solved and not self._others else trial
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * n)
        actuators = robot.plant.num_actuators()
        self._net_actuation = self.DeclareVectorInputPort("net_actuation", actuators)
        self._torque_command = self.DeclareVectorInputPort("torque_command", n)
        if self._trial is not None:
            states = robot.plant.num_multibody_states()
            self._plant_state = self.DeclareVectorInputPort("plant_state", states)
            # Never computed anew: an entry of the cache is what a context can keep for itself.
            never: Any = ValueProducer.NoopCalc
            producer = ValueProducer(self._trial.allocate, never)
            self._workspace = self.DeclareCacheEntry("trial", producer, {self.nothing_ticket()})
        size = self._velocities + rows * n
        self._last = self.DeclareDiscreteState(np.full(size, math.nan))
        ended = (self._joint_state, self._net_actuation)
        sources = {self.xd_ticket(), *(self.input_port_ticket(port.get_index()) for port in ended)}
        # It depends on no command: what takes it may command.
        self._torque_loss = self.DeclareVectorOutputPort(
            "torque_loss", n, weakly(self._calc_loss), sources
        )
        self.DeclareVectorOutputPort("friction", n, weakly(self._calc_friction), sources)
        # Nor does the deflection: encoders read it before there is one.
        self.DeclareVectorOutputPort(
            "deflection", n, weakly(self._calc_deflection), {*sources, self.time_ticket()}
        )
        sources = {self.all_input_ports_ticket(), self.time_ticket(), self.xd_ticket()}
        self._tick = self.DeclareVectorOutputPort("tick", size, weakly(self._calc), sources)
        self.DeclarePeriodicUnrestrictedUpdateEvent(time_step, 0.0, weakly(self._remember))

    def _calc_loss(self, context: Context, output: BasicVector) -> None:
        last = context.get_discrete_state().value(0)
        ended = (self._joint_state.Eval(context), self._net_actuation.Eval(context))
        # As a whole the solver's part would take longer to hand over than the sum takes.
        solver = (self._solver.damping, self._solver.clamp)
        output.SetFromVector(_loss(last, *ended, *solver, self._velocities))

    def _calc_friction(self, context: Context, output: BasicVector) -> None:
        last = _parts(context.get_discrete_state().value(0), self._joints, self._velocities)
        ahead = last.memory[_AHEAD]
        output.SetFromVector(self._torque_loss.Eval(context) - np.nan_to_num(ahead))

    def _calc_deflection(self, context: Context, output: BasicVector) -> None:
        last = _parts(context.get_discrete_state().value(0), self._joints, self._velocities)
        total = np.zeros(self._joints)
        if not math.isnan(last.memory[_VELOCITY, 0]):
            for _, effect, rows in self._others:
                if effect.effect.deflects:
                    memory = self._advanced(context, last, effect, rows)
                    total += effect.effect.deflection(memory, effect.nonlinear)
        output.SetFromVector(total)

    def _advanced(
        self, context: Context, last: Tick, effect: ResolvedJointTorque, rows: slice
    ) -> np.ndarray:
        """Memory of an effect at the end of the step that ended, (rows, n)."""
        before, time_step = last.memory, self._time_step
        velocity = self._joint_state.Eval(context)[self._joints :]
        ended = (before[_POSITION], before[_COMMAND], context.get_time() - time_step, time_step)
        return effect.effect.advance(JointMotion(velocity, *ended, before[rows]), effect.nonlinear)

    def _calc(self, context: Context, output: BasicVector) -> None:
        vector, before = output.get_mutable_value(), context.get_discrete_state().value(0)
        joint_state = self._joint_state.Eval(context)
        if not self._others:
            _calc_steady(vector, before, joint_state, self._is_solved, *self._known)
            if self._trial is not None:
                tick = _parts(vector, self._joints, self._velocities)
                self._put_force(tick, JointMotion(self._tried(self._trial, context, tick)))
            return
        tick, last = (_parts(each, self._joints, self._velocities) for each in (vector, before))
        motion = self._motion(context, tick, last, _begin(tick, last, joint_state))
        self._put_force(tick, motion)
        if self._trial is not None:
            end = self._tried(self._trial, context, tick)
            self._put_force(tick, motion._replace(velocity=end))

    def _tried(self, trial: TrialStep, context: Context, tick: Tick) -> np.ndarray:
        """Velocities of the joints at the end of the step as it is, (n,) [rad/s]."""
        workspace: Any = self._workspace.Eval(context)
        time, state = context.get_time(), self._plant_state.Eval(context)
        known = (self._torque_command.Eval(context), tick.memory[self._offsets], tick.force)
        return trial.joint_velocity(workspace, time, state, *known)

    def _put_force(self, tick: Tick, motion: JointMotion) -> None:
        """Fills the force of a step that ends as is expected."""
        torque, ahead = look_up(self._table, motion.velocity), tick.memory[_AHEAD]
        ahead[:] = 0.0
        for _, effect, rows in self._others:
            more = effect.torque_and_slope(motion._replace(memory=tick.memory[rows]))[0]
            torque += more
            if effect.effect.deflects:
                ahead += more
        _finish(tick, motion.velocity, torque, tick.memory[self._offsets], self._solver)

    def _motion(
        self,
        context: Context,
        tick: Tick,
        last: Tick,
        expected: np.ndarray,
    ) -> JointMotion:
        """The step that begins, as effects see it; fills its command, memories and offsets."""
        now, before, time_step = tick.memory, last.memory, self._time_step
        first, time = math.isnan(before[_VELOCITY, 0]), context.get_time()
        command = now[_COMMAND] = self._torque_command.Eval(context)
        load = command if first else before[_COMMAND] - self._torque_loss.Eval(context)
        known = (now[_POSITION], command, time, time_step)
        motion = JointMotion(expected, *known, load=load, rotor_inertia=self._rotor_inertia)
        now[self._offsets] = self._law.torque.offset
        moving = {clamps.effect: clamps for clamps in self._law.moving}
        for k, effect, rows in self._others:
            if effect.effect.has_memory and first:
                at_start = motion._replace(velocity=now[_VELOCITY])
                now[rows] = effect.effect.start(at_start, effect.nonlinear)
            elif effect.effect.has_memory:
                now[rows] = self._advanced(context, last, effect, rows)
            if k in moving:
                offset = moving[k].offset(effect, motion._replace(memory=now[rows]))
                now[self._offsets][moving[k].rows] = offset
        return motion

    def _remember(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state().set_value(0, self._tick.Eval(context))


class JointTorqueEffects(Diagram):
    """Joint torque effects beside a plant whose solver takes a part of them.

    .. pydrake_system::

        name: JointTorqueEffects
        input_ports:
        - joint_state
        - net_actuation
        - torque_command
        output_ports:
        - torque_loss
        - friction
        - deflection
        - explicit_force
        - clamp_offset

    Inputs are those of `ExplicitTorque`. `torque_loss` (n,) [Nm] is that of the plant step that
    ended (zero before the first), `friction` and `deflection` those of `ExplicitTorque`.
    `explicit_force` goes to the plant's applied generalized force;
    `clamp_offset` are offsets of the clamps, row by row (m n,) [Nm], where any has one.
    """

    def __init__(
        self,
        law: ImplicitLaw,
        robot: Robot,
        time_step: float,
        trial: TrialStep | None = None,
    ):
        super().__init__()
        builder = DiagramBuilder()
        system = ExplicitTorque(law, robot, time_step, trial)
        explicit = builder.AddNamedSystem("explicit", system)
        n, tick = len(robot.joint_names), explicit.GetOutputPort("tick")
        sizes = [robot.plant.num_velocities(), _ROWS * n, law.torque.offset.size]
        sizes.append(tick.size() - sum(sizes))
        parts = Demultiplexer([size for size in sizes if size > 0])
        split = builder.AddNamedSystem("parts", parts)
        builder.Connect(tick, split.get_input_port())
        for i in range(explicit.num_input_ports()):
            port = explicit.get_input_port(i)
            builder.ExportInput(port, port.get_name())
        for name in ("torque_loss", "friction", "deflection"):
            builder.ExportOutput(explicit.GetOutputPort(name), name)
        builder.ExportOutput(split.get_output_port(0), "explicit_force")
        if law.moves_clamps:
            builder.ExportOutput(split.get_output_port(2), "clamp_offset")
        builder.BuildInto(self)
