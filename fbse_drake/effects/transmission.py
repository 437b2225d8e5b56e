"""Torques of gears and cables: springs, ripple, hysteresis, backlash."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numba import njit

from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import Parameter, in_library
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.effects.joint_torque import (
    JointMotion,
    JointTorqueEffect,
    Reduction,
    Rise,
    affine_recursion,
)
from fbse_drake.robot.plant import Robot

# Factor that the inertia of a rotor may be off by in a model that has one.
_KNOWN_WITHIN = 2.0
# Of the sides of a gap in a gear; and how long a step of their contact is resolved by, as a share
# of its time.
_DAMPING_RATIO, _RESOLVED = 0.7, 0.2


@in_library
@dataclass(frozen=True)
class TorqueRipple(JointTorqueEffect):
    """Torque that repeats with the joint's angle: u = sine sin(cycles q) + cosine cos(cycles q)."""

    description: ClassVar[str] = (
        "Torque that repeats with the angle of the joint, from gear teeth or motor poles."
    )
    signature: ClassVar[str] = "A wave over the joint angle, the same in both directions of motion."
    experiment: ClassVar[str] = "Move each joint slowly through a large angle."
    repeats: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "sine": Parameter("Nm", linear=True, plausible=(-5.0, 5.0), bounds=(-np.inf, np.inf)),
        "cosine": Parameter("Nm", linear=True, plausible=(-5.0, 5.0), bounds=(-np.inf, np.inf)),
        # Over 1 rad of motion, a factor of 1.02 near the upper end is a quarter of a wave off.
        "cycles": Parameter(
            "1/revolution", linear=False, plausible=(6.0, 400.0), grid=200, closed=True
        ),
    }

    sine: dict[str, float] = field(default_factory=dict)
    cosine: dict[str, float] = field(default_factory=dict)
    cycles: dict[str, float] = field(default_factory=lambda: {"all": 50.0})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        angle = nonlinear[0] * motion.position
        return (np.sin(angle), np.cos(angle)), (0.0, 0.0)

    @classmethod
    def shows_within(cls, travel: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:
        """Half a wave at least: less of it is a spring."""
        return nonlinear[0] * travel > np.pi

    @staticmethod
    def in_part() -> type[JointTorqueEffect]:
        return JointSpring


@in_library
@dataclass(frozen=True)
class JointSpring(JointTorqueEffect):
    """A spring beside the motor, as of cables and hoses over the joint: u = stiffness
    q + preload."""

    description: ClassVar[str] = "A spring across the joint, as of cables and hoses."
    signature: ClassVar[str] = "Torque rises linearly with the joint angle."
    experiment: ClassVar[str] = "Hold each joint at several angles."
    parameters: ClassVar[dict[str, Parameter]] = {
        "stiffness": Parameter("Nm/rad", linear=True, plausible=(0.0, 200.0)),
        # The torque at angle zero.
        "preload": Parameter("Nm", linear=True, plausible=(-30.0, 30.0), bounds=(-np.inf, np.inf)),
    }
    reductions: ClassVar[tuple[Reduction, ...]] = (Reduction({"stiffness": 0.0}, (TorqueBias,)),)

    stiffness: dict[str, float] = field(default_factory=dict)
    preload: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[Sequence[np.ndarray | float], Sequence[float]]:
        return (motion.position, 1.0), (0.0, 0.0)


@in_library
@dataclass(frozen=True)
class PreslidingHysteresis(JointTorqueEffect):
    """Coulomb friction that builds up over a displacement, like a bristle that bends before it
    slips (Dahl 1968):

    u = coulomb z,   dz/dt = w / displacement (1 - z sign(w))

    z, in [-1, 1], starts at 0 and is exact for a velocity that is constant over the step.
    """

    description: ClassVar[str] = (
        "Friction that builds up like a spring before the joint really slips."
    )
    signature: ClassVar[str] = (
        "After each reversal the torque changes over an angle, not at once: a loop over the joint "
        "angle."
    )
    experiment: ClassVar[str] = (
        "Move each joint to and fro by amounts from a thousandth to a tenth of a rad."
    )
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "displacement": Parameter(
            "rad", linear=False, plausible=(2e-4, 5e-2), bounds=(1e-9, np.inf)
        ),
    }
    has_memory: ClassVar[bool] = True
    is_after_turns: ClassVar[bool] = True
    reductions: ClassVar[tuple[Reduction, ...]] = (
        Reduction({"displacement": 0.0}, (CoulombFriction,)),
    )

    coulomb: dict[str, float] = field(default_factory=dict)
    displacement: dict[str, float] = field(default_factory=lambda: {"all": 0.005})

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        (z,), rate = motion.memory, motion.time_step / nonlinear[0]
        sign = np.sign(motion.velocity)
        bent = (z - sign) * np.exp(-np.abs(motion.velocity) * rate)
        return (sign + bent,), (-bent * sign * rate + (sign == 0) * rate,)

    @staticmethod
    def rise(linear: np.ndarray, nonlinear: np.ndarray, typical: JointMotion) -> Rise:  # noqa: ARG004
        return Rise(speeds=(nonlinear[0] / typical.time_step,))

    @staticmethod
    def lean(memory: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return memory[0]

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return np.zeros((1, *nonlinear.shape[1:]))

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        (z,), _ = PreslidingHysteresis.basis(motion, nonlinear)
        return z[None]

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        keep = np.exp(-np.abs(motion.velocity) * motion.time_step / nonlinear[0])
        return affine_recursion(0.0, keep, (1.0 - keep) * np.sign(motion.velocity))[None]


@in_library
@dataclass(frozen=True)
class Backlash(JointTorqueEffect):
    """Play between motor and link: when the torque changes sign the motor crosses the gap, and
    until then nothing reaches the link.

    u = rotor_inertia dv/dt, with v the rotor's velocity against the link

    In the gap that is the command, less what the model's own rotor in the joint takes to follow the
    link (its inertia times the link's acceleration in the step before); of a model without one the
    link's motion is left out. At the other side the rotor stays (a plastic impact), and all of its
    momentum reaches the link within a step from when the gap closes. An encoder on the motor's side
    shows where the rotor is in the gap.

    A contact that gives for longer than a step is a spring and a damper, which only push (Nordin
    and Gutman 2002):

    dv/dt = (command - push) / rotor_inertia - dw/dt
    push = rotor_inertia (x / contact_time^2 + 2 damping_ratio v / contact_time)

    with x by how much the rotor is beyond the gap's side, w the link's velocity and a damping ratio
    of 0.7. Then the link's acceleration is that of the step itself; a simulation takes what is
    expected of it.
    """

    description: ClassVar[str] = (
        "Play in the gear, which the motor must cross whenever its torque changes sign."
    )
    signature: ClassVar[str] = (
        "No torque reaches the link for some milliseconds after the command changes sign; then "
        "it is hit."
    )
    experiment: ClassVar[str] = "Swing each joint so that its torque changes sign often."
    needs_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        # When the gap closes shows in blocks: over some of it more of a gap changes nothing.
        "gap": Parameter(
            "rad", linear=False, plausible=(2e-4, 2e-2), neutral=0.0, grid=25, linear_within=0.1
        ),
        "rotor_inertia": Parameter(
            "kg m^2",
            linear=False,
            plausible=(0.02, 1.0),
            bounds=(1e-9, np.inf),
            grid=3,
            linear_within=0.1,
        ),
        "contact_time": Parameter(
            "s",
            linear=False,
            plausible=(1e-3, 1e-2),
            grid=4,
            linear_within=0.1,
            meaning="in which the sides of the gap stop a rotor; 0 for at once",
        ),
    }
    has_memory: ClassVar[bool] = True
    deflects: ClassVar[bool] = True

    gap: dict[str, float] = field(default_factory=dict)
    rotor_inertia: dict[str, float] = field(default_factory=lambda: {"all": 0.25})
    contact_time: dict[str, float] = field(default_factory=lambda: {"all": 0.0})

    @classmethod
    def parameters_on(cls, robot: Robot, target: str) -> dict[str, Parameter]:
        """A model that has a rotor in the joint knows its inertia well enough: of the torque alone
        only its product with the gap can be told."""
        parameters, known = super().parameters_on(robot, target), robot.rotor_inertia(target)
        if known > 0.0:
            plausible = (known / _KNOWN_WITHIN, known * _KNOWN_WITHIN)
            rotor = replace(parameters["rotor_inertia"], plausible=plausible, grid=1)
            parameters["rotor_inertia"] = rotor
        return parameters

    @staticmethod
    def basis(
        motion: JointMotion, nonlinear: np.ndarray
    ) -> tuple[Sequence[np.ndarray], Sequence[float]]:
        _, taken = _cross(motion, nonlinear)
        return (taken,), (0.0,)

    @classmethod
    def shows_in(cls, motion: JointMotion) -> bool:
        """Where the torque never changes sign the motor stays on one side, as with another zero of
        its encoder."""
        return bool(np.min(motion.command) < 0 < np.max(motion.command))

    @staticmethod
    def deflection(memory: np.ndarray, nonlinear: np.ndarray) -> np.ndarray:  # noqa: ARG004
        return memory[0]

    @staticmethod
    def start(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        gap, *_ = nonlinear
        side = 0.5 * gap * np.sign(motion.command)
        unmoved = np.zeros_like(side)
        return np.stack([side, unmoved, unmoved, motion.velocity + unmoved, unmoved])

    @staticmethod
    def advance(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        memory, _ = _cross(motion, nonlinear)
        return memory

    @staticmethod
    def memory_over_time(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        first, command, steps = _columns_of_steps(motion, nonlinear)
        memory = np.empty((len(command), *first.shape))
        _cross_gaps(first.copy(), command, *steps, motion.time_step, memory, np.empty((0, 0)))
        sets, joints = nonlinear.shape[1:-2], command.shape[1]
        ends = memory[:-1].reshape(len(memory) - 1, len(first), *sets, joints)
        starts = first.reshape(len(first), *sets, 1, joints)
        return np.concatenate([starts, np.moveaxis(ends, 0, -2)], axis=-2)

    @staticmethod
    def basis_at_once(motion: JointMotion, nonlinear: np.ndarray) -> np.ndarray:
        first, command, steps = _columns_of_steps(motion, nonlinear)
        taken = np.empty((len(command), first.shape[1]))
        _cross_gaps(first, command, *steps, motion.time_step, np.empty((0, 0, 0)), taken)
        of_sets = taken.reshape(len(taken), *nonlinear.shape[1:-2], command.shape[1])
        return np.moveaxis(of_sets, 0, -2)[None]


def _columns_of_steps(
    motion: JointMotion, nonlinear: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """What `_cross_gaps` takes of N steps of n joints, for sets of values (m, ..., 1, n): what is
    remembered at the start, the command, and the rest."""
    n = motion.command.shape[1]
    at_start = motion._replace(command=motion.command[:1], velocity=motion.velocity[:1])
    first = Backlash.start(at_start, nonlinear)
    columns = first.size // len(first)
    command, velocity = (np.ascontiguousarray(a) for a in (motion.command, motion.velocity))
    attached = np.ascontiguousarray(np.broadcast_to(motion.rotor_inertia, n), dtype=float)
    values = np.broadcast_to(nonlinear, (len(nonlinear), *first.shape[1:]))
    of_columns = values.reshape(len(nonlinear), columns)
    return first.reshape(len(first), columns), command, (velocity, attached, *of_columns)


def _cross(motion: JointMotion, nonlinear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Memory at the end of a step, (rows, ...), and the torque that rotors take in it, (...)."""
    arrays = np.broadcast_arrays(
        *motion.memory, motion.command, motion.velocity, motion.rotor_inertia, *nonlinear
    )
    rows, shape = len(motion.memory), arrays[0].shape
    flat = [np.array(array, dtype=float, order="C").reshape(-1) for array in arrays]
    command, velocity, attached, *values = flat[rows:]
    memory, taken = np.empty((1, rows, command.size)), np.empty((1, command.size))
    steps = (command[None], velocity[None], attached, *values)
    _cross_gaps(np.stack(flat[:rows]), *steps, motion.time_step, memory, taken)
    return memory.reshape(rows, *shape), taken.reshape(shape)


@njit(cache=True)
def _cross_gaps(
    state: np.ndarray,
    command: np.ndarray,
    link_velocity: np.ndarray,
    attached: np.ndarray,
    gap: np.ndarray,
    inertia: np.ndarray,
    contact_time: np.ndarray,
    time_step: float,
    memory: np.ndarray,
    torque: np.ndarray,
) -> None:
    """Moves rotors through N steps of n joints, for C sets of values; column c is of joint c % n.

    Remembered are offset [rad] and velocity [rad/s] of a rotor against its link, the offset within
    half the gap to either side, or hardly beyond; the momentum of an impact that is still to reach
    the link [Nm s]; and velocity [rad/s] and acceleration [rad/s^2] of the link.

    An impact lasts for a step from when the gap closes, so that all is smooth in the parameters.

    Args:
        state: what is remembered at the start, (5, C); at the end, when it returns.
        command, link_velocity: the command in each step, and the link's velocity at its end,
            (N, n).
        attached: inertia of the rotors that the model has, (n,).
        gap, inertia, contact_time: of the rotors that cross their gaps, (C,) each.
        memory: filled with what is remembered at the end of each step, (N, 5, C), if it has room.
        torque: filled with what rotors take in each step [Nm], (N, C), if it has room.
    """
    joints = command.shape[1]
    for k in range(command.shape[0]):
        for c in range(state.shape[1]):
            j = c % joints
            x, v, coming, last, a = (
                state[0, c],
                state[1, c],
                state[2, c],
                state[3, c],
                state[4, c],
            )
            w, R, side, contact = link_velocity[k, j], inertia[c], 0.5 * gap[c], contact_time[c]
            if contact > time_step and side > 0.0:
                a = (w - last) / time_step
                before, drive, coming = v, command[k, j] - attached[j] * a, 0.0
                x, v = _pushed_back(x, v, drive / R, side, contact, time_step)
                taken = R * (v - before) / time_step
            else:
                is_hit = coming != 0.0 and attached[j] > 0.0
                before, taken, coming = v, -coming / time_step, 0.0
                drive = command[k, j] - attached[j] * a
                v += time_step * drive / R
                travel = time_step * v
                room = side - np.sign(travel) * x
                if is_hit:
                    # What the impact adds to the link's velocity it does not add against the rotor.
                    v = 0.0
                elif abs(travel) < room:
                    x += travel
                    taken += drive
                elif travel != 0.0:
                    share = room / abs(travel)
                    momentum = R * before + share * time_step * drive
                    coming = share * momentum
                    taken += share * drive - (momentum - coming) / time_step
                    x, v = side * np.sign(travel), 0.0
                a = (w - last) / time_step
            state[0, c], state[1, c], state[2, c], state[3, c], state[4, c] = x, v, coming, w, a
            if memory.size:
                for row in range(5):
                    memory[k, row, c] = state[row, c]
            if torque.size:
                torque[k, c] = taken


@njit(cache=True)
def _pushed_back(
    x: float, v: float, drive: float, side: float, contact: float, time_step: float
) -> tuple[float, float]:
    """Offset and velocity of a rotor after a step between the sides of a gap, which push it back.

    Args:
        drive: its acceleration but for what the sides push [rad/s^2].
        side: half the gap; contact: see `contact_time` of `Backlash`.
    """
    steps = math.ceil(time_step / (_RESOLVED * contact))
    h, stiffness, damping = time_step / steps, contact**-2, 2.0 * _DAMPING_RATIO / contact
    for _ in range(steps):
        free, beyond = v + h * drive, abs(x + h * v) - side
        if beyond > 0.0:
            # Semi-implicit, so that it is stable however stiff the contact is.
            sign = np.sign(x + h * v)
            start = x - sign * side
            pushed = (free - h * stiffness * start) / (1.0 + h * damping + h * h * stiffness)
            push = stiffness * (start + h * pushed) + damping * pushed
            v = pushed if push * sign > 0.0 else free
        else:
            v = free
        x += h * v
    return x, v
