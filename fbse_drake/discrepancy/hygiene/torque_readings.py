"""Ways to read a torque channel: as it was recorded, with its sign reversed or lost, in another
unit, late, or as no torque at all.

Every reading may have what a machine may have that its model lacks: friction, more or less
reflected inertia, a spring, a counterbalance, an offset of its current sensor, crooked encoders, a
load at its end. Another reading than the recorded one is believed
only if it is significantly likelier with all that: likelihoods are compared stretch by stretch of
time (Vuong 1989, "Likelihood ratio tests for model selection and non-nested hypotheses",
Econometrica 57), with Student's t.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import t as student

from fbse_drake.discrepancy.identification.inertial import inertial_regressor
from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.evidence import Evidence
from fbse_drake.discrepancy.residual.recorded_signals import Instants, averaged

# Probability that any reading of any torque of a log that is as recorded is called wrong.
FALSE_ALARM = 1e-3
# Stretches of time whose errors count as independent [s], and the fewest of them that a test needs.
STRETCH, FEWEST_STRETCHES = 0.25, 6
# Speed at which Coulomb friction has its full size [rad/s].
TRANSITION = 0.02
# Change of an angle by which the effect of a crooked encoder is taken, and the largest offset of
# one [rad].
_SMALL_ANGLE, _LARGEST_OFFSET = 1e-3, 0.5
# How often the sign of a torque that is recorded without one is guessed anew.
_GUESSES = 5
# A column may be a combination of others but for this share of its length.
_COLLINEAR = 1e-6
# A channel that is at an end of its range for this share of a log is constant; one that is there
# more often than so is limited.
_MOSTLY, _OFTEN = 0.5, 4
# What explains less than this share of what the largest cause explains is not named.
_GOOD_SHARE = 0.2


@dataclass(frozen=True)
class Columns:
    """What a torque may consist of: columns, and the range of the amount of each."""

    # What each of them stands for.
    causes: tuple[str, ...]
    # (B, p).
    values: np.ndarray
    # (p,).
    lowest: np.ndarray
    highest: np.ndarray

    def beside(self, cause: str, column: np.ndarray) -> "Columns":
        """With one more, (B,), the last, of which there is no negative amount."""
        return Columns(
            (*self.causes, cause),
            np.column_stack([self.values, column]),
            np.append(self.lowest, 0.0),
            np.append(self.highest, np.inf),
        )

    def part(self, chosen: list[bool]) -> "Columns":
        """Some of them."""
        causes = tuple(c for c, wanted in zip(self.causes, chosen, strict=True) if wanted)
        return Columns(causes, self.values[:, chosen], self.lowest[chosen], self.highest[chosen])


@dataclass(frozen=True)
class Reading:
    """A torque that is read in one way."""

    # Of each column, (p,), and whether it lies within its range rather than at an end of it.
    amounts: np.ndarray
    free: np.ndarray
    # What the columns leave in known blocks.
    left: np.ndarray


def fitted(torque: np.ndarray, columns: Columns, known: np.ndarray) -> Reading:
    """Least squares of a torque (B,) in known blocks (B,), with amounts within their ranges."""
    values, torque = columns.values[known], torque[known]
    norm = np.linalg.norm(values, axis=0)
    norm[norm == 0] = 1.0
    q, r = np.linalg.qr(values / norm)
    # With a little of a ridge, for columns may be collinear.
    found = lsq_linear(
        np.vstack([r, _COLLINEAR * np.eye(len(norm))]),
        np.concatenate([q.T @ torque, np.zeros(len(norm))]),
        (columns.lowest * norm, columns.highest * norm),
        method="bvls",
    )
    amounts = found.x / norm
    return Reading(amounts, found.active_mask == 0, torque - values @ amounts)


def gain(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How much likelier each block is by one reading than by another, as logarithms.

    Args:
        before, after: what the readings leave of the torque, normally distributed with a variance
            of its own.
    """
    spread = [float((left**2).mean()) + 1e-300 for left in (before, after)]
    return 0.5 * (np.log(spread[0] / spread[1]) + before**2 / spread[0] - after**2 / spread[1])


def chance(gains: np.ndarray, stretch: np.ndarray) -> float:
    """Probability that one reading seems so much likelier than another by chance alone, if both are
    equally good.

    Args:
        gains: of each block; see `gain`.
        stretch: of time to which each block belongs.
    """
    labels, of_block = np.unique(stretch, return_inverse=True)
    if len(labels) < FEWEST_STRETCHES:
        return 1.0
    by_stretch = np.bincount(of_block, gains)
    deviation = by_stretch.std(ddof=1) / np.sqrt(len(labels))
    return float(student.sf(by_stretch.mean() / max(deviation, 1e-300), len(labels) - 1))


class JointTorques:
    """Torques of a log beside what the model needs, and what else they may consist of."""

    def __init__(
        self,
        evidence: Evidence,
        blocks: Instants | None = None,
        length: int = 1,
        more_gravity: np.ndarray | None = None,
    ):
        """Nothing is fitted yet.

        Args:
            blocks: channels in another order, say; by default those of the log.
            length: so many blocks of the log are averaged; `blocks` are already.
            more_gravity: beyond the model's, on a fixed base, (3,) [m/s^2]; by default none.
        """
        self._evidence, self._length, n = evidence, length, len(evidence.joints)
        self._more_gravity = more_gravity
        self.blocks = blocks or averaged(evidence.motion.blocks, length)
        self.torque = self.blocks.torque_command
        if blocks is None:
            self.needed = block_means(evidence.link_torque, length)
        else:
            residual = evidence.motion.equation.residual(blocks, kinematic=False)
            self.needed = self.torque - residual[:, :n]
        if more_gravity is not None:
            self.needed = self.needed - self.per_gravity @ more_gravity
        # From one block to the next [s].
        self.duration = length * evidence.motion.length * evidence.period
        self._stretch = (np.arange(len(self.torque)) * self.duration / STRETCH).astype(int)

    def of(self, blocks: Instants) -> "JointTorques":
        """Of other channels in the same blocks."""
        return JointTorques(self._evidence, blocks, self._length, self._more_gravity)

    @cached_property
    def gravity(self) -> np.ndarray:
        """What is taken for gravity, (3,) [m/s^2]."""
        of_model = self._evidence.robot.plant.gravity_field().gravity_vector()
        return of_model if self._more_gravity is None else of_model + self._more_gravity

    @cached_property
    def per_gravity(self) -> np.ndarray:
        """See `EquationOfMotion.gravity_torques`, (B, n, 3)."""
        return self._evidence.motion.equation.gravity_torques(self.blocks)

    def under(self, gravity: np.ndarray) -> "JointTorques":
        """The same under another gravity."""
        more = gravity - self._evidence.robot.plant.gravity_field().gravity_vector()
        return JointTorques(self._evidence, self.blocks, self._length, more)

    @cached_property
    def known(self) -> np.ndarray:
        """Where each joint's torque is known, and not at an end of its channel's range, (B, n)."""
        evidence = self._evidence
        known = evidence.known[:, : self.torque.shape[1]].copy()
        command, length = evidence.motion.signals.torque_command[:-1], evidence.motion.length
        for k, column in enumerate(command.T):
            at_end = (column == column.min()) | (column == column.max())
            if at_end.sum() > _OFTEN and at_end.mean() < _MOSTLY:
                known[:, k] &= ~at_end[: len(known) * length].reshape(-1, length).any(axis=1)
        return block_means(known, self._length) == 1.0

    def stretches(self, k: int) -> np.ndarray:
        """Stretch of time of each known block of a joint."""
        return self._stretch[self.known[:, k]]

    def needs_both_signs(self, k: int) -> bool:
        """Does what the model needs of a joint have either sign, and that often enough to test it?
        Some blocks, as of a filter that settles, may have any."""
        needed, stretch = self.needed[self.known[:, k], k], self.stretches(k)
        return all(
            len(np.unique(stretch[of_sign])) >= FEWEST_STRETCHES
            for of_sign in (needed > 0, needed < 0)
        )

    @cached_property
    def _rotor_inertia(self) -> dict[str, float]:
        """What the model believes of each joint's reflected inertia."""
        plant = self._evidence.robot.plant
        actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
        return {
            actuator.joint().name(): actuator.default_rotor_inertia()
            * actuator.default_gear_ratio() ** 2
            for actuator in actuators
        }

    def columns(self, k: int, *, everything: bool = False) -> Columns:
        """What a joint's torque may have beside what the model needs.

        Args:
            everything: crooked encoders and a load at the end of the machine too, which take
                longer.
        """
        at, joint = self.blocks, self._evidence.joints[k]
        q, v, a = at.joint_position[:, k], at.joint_velocity[:, k], at.joint_acceleration[:, k]
        parts = [
            ("a bias", np.ones_like(q), -np.inf, np.inf),
            ("friction", v, 0.0, np.inf),
            ("friction", np.tanh(v / TRANSITION), 0.0, np.inf),
            ("reflected inertia", a, -self._rotor_inertia.get(joint, 0.0), np.inf),
            ("a spring", q, 0.0, np.inf),
            ("a counterbalance", np.cos(q), -np.inf, np.inf),
            ("a counterbalance", np.sin(q), -np.inf, np.inf),
        ]
        if everything:
            for column in self._offsets[:, k].T:
                parts.append(("an encoder offset", column, -_LARGEST_OFFSET, _LARGEST_OFFSET))
            for column, lowest in zip(self._load[:, k].T, (0.0, *[-np.inf] * 3), strict=False):
                parts.append(("a load", column, lowest, np.inf))
        causes, values, lowest, highest = zip(*parts, strict=True)
        return Columns(causes, np.stack(values, axis=1), np.array(lowest), np.array(highest))

    @cached_property
    def _offsets(self) -> np.ndarray:
        """Change of what the model needs per angle that is read too much, (B, n, n)."""
        equation, n = self._evidence.motion.equation, self.torque.shape[1]
        here = equation.residual(self.blocks, kinematic=False)[:, :n]
        result = np.empty((len(here), n, n))
        for joint in range(n):
            moved = self.blocks.joint_position.copy()
            moved[:, joint] -= _SMALL_ANGLE
            at = replace(self.blocks, joint_position=moved)
            there = equation.residual(at, kinematic=False)[:, :n]
            result[:, :, joint] = (here - there) / _SMALL_ANGLE
        return result

    @cached_property
    def _load(self) -> np.ndarray:
        """Torque per mass and first moments of a load on the last body of a machine on a fixed
        base, (B, n, 4); none on a floating one, whose base would show it."""
        evidence, n = self._evidence, self.torque.shape[1]
        if evidence.robot.has_floating_base:
            return np.zeros((len(self.torque), n, 0))
        plant = evidence.robot.plant
        last = plant.GetJointByName(evidence.joints[-1]).child_body().name()
        return inertial_regressor(evidence.motion.equation, self.blocks, last)[:, :n, :4]

    def as_recorded(self, k: int, columns: Columns) -> Reading:
        """What the model needs, and nothing but the columns beside it."""
        return fitted(self.torque[:, k] - self.needed[:, k], columns, self.known[:, k])

    def scaled(self, k: int, columns: Columns, sign: float = 1.0) -> Reading:
        """In a unit of its own, with the sign reversed if so wished; the last amount is the
        scale."""
        return fitted(sign * self.torque[:, k], self._with_scale(k, columns), self.known[:, k])

    def largest_scale(self, k: int, columns: Columns) -> float:
        """The scale of a torque by what the model needs per torque rather than the other way round.

        Noise in what the model needs, of the sensors of forces and motion, makes that of `scaled`
        too small; noise in the torque makes this one too large (Frisch 1934: the scale is between
        the two).
        """
        taken = replace(columns, values=-columns.values)
        wider = taken.beside("the torque", self.torque[:, k])
        per_torque = fitted(self.needed[:, k], wider, self.known[:, k]).amounts[-1]
        return 1.0 / max(float(per_torque), 1e-300)

    def without_sign(self, k: int, columns: Columns) -> Reading:
        """Its absolute value alone was recorded: its sign is guessed from what fits."""
        known, wider = self.known[:, k], self._with_scale(k, columns)
        size, guess = np.abs(self.torque[:, k]), np.sign(self.needed[:, k])
        for _ in range(_GUESSES):
            reading = fitted(guess * size, wider, known)
            guess = np.sign(wider.values @ reading.amounts)
        return fitted(guess * size, wider, known)

    def nothing(self, k: int) -> Reading:
        """A constant."""
        one, any_ = np.ones((len(self.torque), 1)), np.array([np.inf])
        return fitted(self.torque[:, k], Columns(("a bias",), one, -any_, any_), self.known[:, k])

    def late(self, k: int, columns: Columns, samples: int) -> Reading:
        """So many samples later than the motion that it makes, in a unit of its own."""
        motion = self._evidence.motion
        torque = block_means(np.roll(motion.steps.torque_command[:, k], -samples), motion.length)
        return fitted(torque, self._with_scale(k, columns), self.known[:, k])

    def _with_scale(self, k: int, columns: Columns) -> Columns:
        """With what the model needs as the last column."""
        return columns.beside("what the model needs", self.needed[:, k])


def causes_of(reading: Reading, columns: Columns, known: np.ndarray) -> list[str]:
    """What the columns of a reading stand for that vary by a good share of what the largest does;
    the largest first."""
    sizes = dict.fromkeys(columns.causes, 0.0)
    for cause in sizes:
        own = np.array([c == cause for c in columns.causes])
        part = columns.values[np.ix_(known, own)] @ reading.amounts[own]
        sizes[cause] = float(part.std())
    least = _GOOD_SHARE * max(sizes.values())
    return sorted((c for c in sizes if sizes[c] > least), key=lambda cause: -sizes[cause])
