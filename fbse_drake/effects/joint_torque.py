"""Joint torque effects: one definition each for simulation, prediction and identification.

An effect is a torque loss u in `tau_command = u + tau_link` (paper eq. 34), positive when it eats
positive torque. It is written as

    u(motion) = sum over linear parameters k of  theta_k * basis_k(motion; nonlinear parameters)

so that the same lines simulate it, predict it over a whole log and give the regressor to identify
it. An effect without linear parameters is one basis torque as it stands.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numba import njit

from fbse_drake.effects.effect import Effect, Parameter, ResolvedEffect
from fbse_drake.robot.description import RobotDescription

# A law that rises as tanh(v / speed) has levelled off at so many of these speeds.
_LEVEL = 3.0


class JointMotion(NamedTuple):
    """A plant step, or many, as joint torque effects see it: arrays that broadcast to (..., n), the
    last axis is the joints.

    An effect that depends on the velocity alone can be given the velocity alone.
    """

    # At the end of the step [rad/s].
    velocity: np.ndarray
    # At its start [rad].
    position: np.ndarray | float = 0.0
    # Commanded torque during the step [Nm].
    command: np.ndarray | float = 0.0
    # When it starts [s], and how long it is [s].
    time: np.ndarray | float = 0.0
    time_step: float = 0.0
    # What the effect remembers at its start, (rows, ..., n).
    memory: np.ndarray | tuple[()] = ()
    # Torque that passes the gear: the command less what was lost just before [Nm].
    load: np.ndarray | float = 0.0
    # Reflected inertia of the rotor that the model has in the joint [kg m^2].
    rotor_inertia: np.ndarray | float = 0.0

    def of_joints(self, joints: np.ndarray) -> "JointMotion":
        """Of some joints, of a motion of several that was measured: (N, n) each, time (N, 1),
        rotor inertia (n,)."""
        names = ("velocity", "position", "command", "load")
        own = {name: getattr(self, name)[:, joints] for name in names}
        return self._replace(**own, rotor_inertia=np.asarray(self.rotor_inertia)[joints])


class Rise(NamedTuple):
    """How a torque loss of n joints rises with their velocities."""

    # Part damping * velocity, (n,) or a number [Nm s/rad].
    damping: np.ndarray | float = 0.0
    # Speeds at which other parts level off, as tanh(v / speed) does, (n,) each [rad/s].
    speeds: tuple[np.ndarray, ...] = ()
    # Speeds between which a law is straight; one that has no other speeds is solved exactly.
    corners: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class Reduction:
    """How a law turns into simpler ones."""

    # Parameters, and the values at which it does.
    at: Mapping[str, float]
    # Of the library; what the law says there is what these say together.
    effects: tuple[type["JointTorqueEffect"], ...]


@dataclass(frozen=True)
class JointTorqueEffect(Effect):
    """Base of the joint torque effects.

    A subclass gives the class variables of `Effect` and the basis; one with memory also
    `has_memory`, `start` and `advance`. How it is simulated, it says by `rise` (and `lean`): the
    part that rises with the velocity is solved by Drake's contact solver together with contact, at
    any slope. What is left of the law is taken at the velocity that is expected at the end of the
    step, so it must not be steep.

    >>> from dataclasses import dataclass, field
    >>> from fbse_drake import JointMotion, JointTorqueEffect, Parameter
    >>> @dataclass(frozen=True)
    ... class CubicDrag(JointTorqueEffect):
    ...     description = "Drag that grows with the third power of the speed."
    ...     signature = "Torque against the motion that only shows at high speed."
    ...     experiment = "Move each joint slowly and as fast as it can."
    ...     parameters = {"drag": Parameter("Nm s^3/rad^3", linear=True, plausible=(0.0, 1.0))}
    ...     drag: dict[str, float] = field(default_factory=dict)
    ...
    ...     @staticmethod
    ...     def basis(motion, nonlinear):
    ...         return (motion.velocity**3,), (3 * motion.velocity**2,)
    >>> import numpy as np
    >>> (torque,), (slope,) = CubicDrag.basis(JointMotion(np.array([-2.0, 1.0])), np.empty((0, 2)))
    >>> torque.tolist(), slope.tolist()
    ([-8.0, 1.0], [12.0, 3.0])

    It is a tag for YAML files, and searched for, behind `@in_library`.
    """

    has_memory: ClassVar[bool] = False
    # Does it differ from its reductions only right after a joint turned?
    is_after_turns: ClassVar[bool] = False
    # Does it let the motor turn against the link, so that encoders on both sides show it? Such an
    # effect also gives `deflection` and `memory_over_time`.
    deflects: ClassVar[bool] = False
    # Does the torque depend on nothing but the velocity? (Then it is simulated faster.)
    of_velocity_alone: ClassVar[bool] = False
    # Does it repeat with the angle, as the error of a rounded angle does?
    repeats: ClassVar[bool] = False
    # Can it be told in a joint that rests, as what the drive makes of its command can?
    shows_at_rest: ClassVar[bool] = False
    # Simpler laws that it contains, the simplest first: a diagnosis names the smallest that holds.
    reductions: ClassVar[tuple[Reduction, ...]] = ()

    @staticmethod
    @abstractmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray | float], Sequence[np.ndarray | float]]:
        """Torque per unit of each linear parameter, and its derivative with respect to the joint
        velocity.

        Args:
            nonlinear: values of the nonlinear parameters in the order of `parameters`, shape
                (parameters, ..., n).

        Returns:
            Two sequences in the order of the linear parameters (one item if there are none), items
            that broadcast to (..., n).
        """

    @classmethod
    def shares(cls, name: str, other: type[Effect]) -> bool:
        """Has another effect a linear parameter of this name that stands for the same? So has the
        same effect, and among laws of the velocity alone, each with one of this name. What
        remembers may remember something else."""
        return (
            not cls.has_memory
            and issubclass(other, JointTorqueEffect)
            and (other is cls or (cls.of_velocity_alone and other.of_velocity_alone))
            and name in other.parameters
            and other.parameters[name].linear
        )

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        """How it rises with the velocity; by default it does not.

        Args:
            linear, nonlinear: values of the parameters, shape (parameters, n).
            typical: speed, load and time in the run that is to be simulated, and the plant's step.
        """
        return Rise()

    @staticmethod
    def lean(memory: np.ndarray, nonlinear: np.ndarray) -> np.ndarray | float:  # noqa: ARG004
        """Where in its range, from -1 to 1, the torque of a memory stands at velocity zero,
        (n,)."""
        return 0.0

    @staticmethod
    def deflection(memory: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:
        """By how much a motor is ahead of its link [rad] with a memory (rows, ..., n), of one that
        `deflects`; (..., n)."""
        raise NotImplementedError

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        """Memory at the start of the first step, shape (rows, ..., n). Everything about the step is
        known but its velocity."""
        raise NotImplementedError

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        """Memory at the end of the step, shape (rows, ..., n)."""
        raise NotImplementedError

    @classmethod
    def shows_within(cls, travel: np.ndarray, nonlinear: np.ndarray) -> np.ndarray | bool:  # noqa: ARG003
        """Does a joint that moves through a range of angles show what the effect is, and not just
        its value and slope there?

        Args:
            travel: from the smallest to the largest angle, 0 of a joint that rests, (n,) [rad].
            nonlinear: values of the nonlinear parameters, shape (m,) or (m, n).
        """
        return cls.shows_at_rest or travel > 0

    @staticmethod
    def in_part() -> "type[JointTorqueEffect] | None":
        """What a part of it looks like that is too small to show what it is, see `shows_within`;
        that is named in its place, and it is told that it may be this one."""
        return None

    @staticmethod
    def is_itself(values: Mapping[str, float], reached: float) -> bool:  # noqa: ARG004
        """Is it with these values of its parameters what it is called, and not another shape of a
        law that it contains, up to the speed that a joint reached [rad/s] or [m/s]?"""
        return True

    @classmethod
    def shows_in(cls, motion: JointMotion) -> bool:  # noqa: ARG003
        """Does what a joint did in N steps, (N, 1) each, show what the effect is?"""
        return True

    @classmethod
    def parameters_in(
        cls,
        motion: JointMotion,  # noqa: ARG003
        parameters: dict[str, Parameter],
    ) -> dict[str, Parameter]:
        """Its parameters in a joint with what that joint did in N steps, (N, 1) each: some values
        are not plausible then."""
        return parameters

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray | None:  # noqa: ARG004
        """Memory at the start of each of N steps that follow each other, (rows, ..., N, n), where
        that can be had faster than step by step.

        Args:
            motion: arrays (N, n).
            nonlinear: shape (m, ..., 1, n).
        """
        return None

    @staticmethod
    def basis_at_once(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray | None:  # noqa: ARG004
        """Torque per unit of each linear parameter in each of N steps that follow each other,
        (p, ..., N, n), where that can be had faster than by the memory of each.

        Args:
            motion: arrays (N, n).
            nonlinear: shape (m, ..., 1, n).
        """
        return None

    def resolve(
        self, names: RobotDescription, *, key: str = "", is_change: bool = False
    ) -> "ResolvedJointTorque":
        """See `Effect.resolve`."""
        resolved = super().resolve(names, key=key, is_change=is_change)
        linear = resolved.linear if len(resolved.linear) else np.ones((1, len(resolved.targets)))
        return ResolvedJointTorque(type(self), resolved.targets, linear, resolved.nonlinear)


class OnDemand(Sequence[np.ndarray | float]):
    """Slopes that are found when they are asked for: a search asks for torques alone."""

    def __init__(self, find: Callable[[], Sequence[np.ndarray | float]]):
        self._find = find

    @cached_property
    def _found(self) -> Sequence[np.ndarray | float]:
        return self._find()

    def __getitem__(self, place: Any) -> Any:
        return self._found[place]

    def __len__(self) -> int:
        return len(self._found)


@dataclass(frozen=True)
class ResolvedJointTorque(ResolvedEffect):
    """A joint torque effect with values per joint; without linear parameters `linear` is one row of
    ones."""

    effect: type[JointTorqueEffect]

    def torque_and_slope(self, motion: JointMotion) -> tuple[np.ndarray, np.ndarray]:
        """Torque loss u [Nm] and its derivative with respect to the joint velocity [Nm s/rad], each
        of shape (..., n)."""
        nonlinear = self.nonlinear
        if motion.velocity.ndim > 1:
            # (parameters, n) -> (parameters, 1, ..., n), to go with the leading axes of the motion.
            nonlinear = np.expand_dims(nonlinear, tuple(range(1, motion.velocity.ndim)))
        basis, slopes = self.effect.basis(motion, nonlinear)
        torque, slope = self.linear[0] * basis[0], self.linear[0] * slopes[0]
        for theta, b, db in zip(self.linear[1:], basis[1:], slopes[1:], strict=True):
            torque, slope = torque + theta * b, slope + theta * db
        return torque, slope

    def held_at_rest(self, motion: JointMotion) -> np.ndarray:
        """By how much it may hold joints that rest, to either side, (..., n) [Nm]: by all by which
        it jumps when they begin to move. 0 of a law that does not jump.

        Args:
            motion: arrays (N, n).
        """
        rise = self.effect.rise(self.linear, self.nonlinear, motion)
        if not rise.speeds:
            return np.zeros(motion.velocity.shape)
        with np.errstate(invalid="ignore"):
            speed = np.broadcast_to(_LEVEL * np.max(rise.speeds, axis=0), motion.velocity.shape)
            either = []
            for velocity in (speed, -speed):
                moving = motion._replace(velocity=velocity)
                if self.effect.has_memory:
                    moving = moving._replace(memory=self.effect.start(moving, self.nonlinear))
                either.append(self.torque_and_slope(moving)[0])
            jump = 0.5 * (either[0] - either[1]) - rise.damping * speed
        return np.where(np.isfinite(jump), jump, 0.0)


def basis_over_time(
    effect: type[JointTorqueEffect], motion: JointMotion, nonlinear: np.ndarray
) -> np.ndarray:
    """Basis torques of an effect over N steps that follow each other, memory included.

    Args:
        motion: arrays that broadcast to (N, n); the memory is made here.
        nonlinear: values of the nonlinear parameters, shape (m, n), or (m, G, n) for G sets of
            values.

    Returns:
        Shape (p, N, n), or (p, G, N, n), for the p linear parameters, or one basis torque if there
        are none.
    """
    samples, n = motion.velocity.shape
    sets = nonlinear.shape[1:-1]
    at_once = effect.basis_at_once(motion, nonlinear[..., None, :])
    if at_once is not None:
        return at_once
    memory = effect.memory_over_time(motion, nonlinear[..., None, :]) if effect.has_memory else ()
    if memory is not None:
        basis, _ = effect.basis(motion._replace(memory=memory), nonlinear[..., None, :])
        columns = [np.broadcast_to(b, (*sets, samples, n)) for b in basis]
        return np.stack(columns) if columns[1:] else columns[0][None]
    names = ("velocity", "position", "command", "time")
    columns = [np.broadcast_to(getattr(motion, name), (samples, n)) for name in names]
    result: list[list[np.ndarray]] = []
    for velocity, position, command, time in zip(*columns, strict=True):
        step = motion._replace(velocity=velocity, position=position, command=command, time=time)
        if memory is None:
            memory = effect.start(step, nonlinear)
        now = step._replace(memory=memory)
        basis, _ = effect.basis(now, nonlinear)
        result.append([np.broadcast_to(b, (*sets, n)) for b in basis])
        memory = effect.advance(now, nonlinear)
    return np.moveaxis(np.array(result), 0, -2)


def deflection_over_time(
    effect: type[JointTorqueEffect], motion: JointMotion, nonlinear: np.ndarray
) -> np.ndarray:
    """By how much motors are ahead of their links at the start of each of N steps [rad].

    Args:
        motion, nonlinear: see `basis_over_time`.

    Returns:
        Shape (N, n), or (G, N, n).
    """
    of_steps = nonlinear[..., None, :]
    memory = effect.memory_over_time(motion, of_steps)
    if memory is None:
        raise NotImplementedError(f"{effect.__name__}.memory_over_time")
    return effect.deflection(memory, of_steps)


def law_over_time(effects: Sequence[ResolvedJointTorque], motion: JointMotion) -> np.ndarray:
    """Torque loss of some effects over N steps that follow each other, memory included,
    (N, n) [Nm].

    Args:
        motion: arrays that broadcast to (N, n); the memory is made here.
    """
    total = np.zeros(motion.velocity.shape)
    for effect in effects:
        basis = basis_over_time(effect.effect, motion, effect.nonlinear)
        total += np.einsum("pn,pNn->Nn", effect.linear, basis)
    return total


def affine_recursion(start: np.ndarray | float, keep: np.ndarray, add: np.ndarray) -> np.ndarray:
    """Memory z of each step with z[0] = start and z[k + 1] = keep[k] z[k] + add[k]; time is the
    last axis but one.

    Args:
        start: broadcasts to (..., n).
        keep, add: broadcast to each other, (..., N, n).
    """
    keep, add = (np.ascontiguousarray(values) for values in np.broadcast_arrays(keep, add))
    first = np.broadcast_to(start, (*add.shape[:-2], add.shape[-1]))
    result = np.empty(add.shape)
    rows = (-1, *add.shape[-2:])
    _fill_recursion(
        result.reshape(rows),
        np.ascontiguousarray(first).reshape(-1, add.shape[-1]),
        keep.reshape(rows),
        add.reshape(rows),
    )
    return result


@njit(cache=True)
def _fill_recursion(
    result: np.ndarray, start: np.ndarray, keep: np.ndarray, add: np.ndarray
) -> None:
    for row in range(result.shape[0]):
        result[row, 0] = start[row]
        for k in range(result.shape[1] - 1):
            for j in range(result.shape[2]):
                result[row, k + 1, j] = keep[row, k, j] * result[row, k, j] + add[row, k, j]
