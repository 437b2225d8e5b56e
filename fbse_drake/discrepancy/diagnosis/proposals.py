"""Proposals: which candidates, alone, would take off enough of what an explanation leaves over."""

from collections.abc import Iterable, Mapping, Sequence, Set

import numpy as np

from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation, Name
from fbse_drake.discrepancy.diagnosis.fits import Alike, Fits, fixed_gain
from fbse_drake.discrepancy.diagnosis.grid_sets import grid_gain
from fbse_drake.discrepancy.diagnosis.remainder import Remainder
from fbse_drake.discrepancy.identification.regression import Signature, WhitenedResidual
from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.errors import InputError

# How often a grid of nonlinear values is narrowed down around its best point, and to how many
# points.
_NARROWINGS = 2
_POINTS = 9
# How often a candidate that is linear only nearby is made linear about the values that fit best.
_EXPANSIONS = 3
# What takes off less than this share of a deviance does not reach it at other values of its
# nonlinear parameters either.
CATCHES_UP = 0.4
# What takes off this share of the sum of squares that is required is worth a fit.
_ENOUGH = 0.5
# So many numbers are kept in columns of candidates.
_MOST_NUMBERS = 3_000_000
# So many lists of additions are kept.
_KEPT = 100
# How often friction of all joints is fitted in turn.
_SWEEPS = 3


# What is said meanwhile.
LOOKING = "looking for what explains more"


class Proposals:
    """Candidates that are worth a fit; see the module."""

    def __init__(self, fits: Fits, barred: Set[Name] = frozenset()):
        """Nothing is looked at yet.

        Args:
            barred: what is not to be proposed.
        """
        self.fits, self._barred = fits, barred
        self._found: Memory[Candidate] = Memory(_MOST_NUMBERS, lambda c: c.signature.values.size)
        # What one more candidate makes of an explanation, see `best_additions`.
        self.additions: Memory[list[Explanation]] = Memory(_KEPT)
        self._moments: dict[tuple[object, ...], tuple[np.ndarray, np.ndarray]] = {}

    @property
    def unbarred(self) -> "Proposals":
        """The same with nothing barred."""
        return Proposals(self.fits) if self._barred else self

    def promising(
        self,
        base: Explanation,
        rows: np.ndarray | None,
        wanted: float = 0.0,
        share: float = _ENOUGH,
        *,
        in_part: bool = False,
        behind: bool = False,
    ) -> list[Candidate]:
        """Candidates that, alone, would take off enough of what an explanation leaves over.

        Args:
            rows: only those that change one of these; None for all.
            wanted: drop of the deviance; what is far from it, with values of its grid or linear
                about no effect at all, is left out.
            share: so much of what is required is enough.
            in_part: of groups of joints some of which have an effect already also the others.
            behind: also what is far behind the best in its joints.
        """
        fits, dictionary, beside = self.fits, self.fits.dictionary, self.fits.remainder(base)
        # First, for the other effects are being predicted beside.
        for effect in dictionary.joint_effects:
            fits.grid(effect)
        changed = np.zeros(len(beside.scale), dtype=bool)
        changed[slice(None) if rows is None else rows] = True
        enough = share * fits.threshold[1]
        known = {c.key for c in base.candidates} | self._barred
        result = [
            self.settled(candidate, base)
            for candidate in fits.fixed_candidates
            if candidate.key not in known
            and changed[candidate.signature.rows].any()
            and self._gains_enough(candidate, base, wanted, share)
        ]
        coarse: dict[tuple[str, ...], list[tuple[float, type[JointTorqueEffect], int]]] = {
            group: [] for group in dictionary.groups
        }
        for k, effect in enumerate(dictionary.joint_effects):
            dictionary.progress(LOOKING, 0.3 * k / len(dictionary.joint_effects))
            taken = {joint for c in base.candidates if c.effect is effect for joint in c.targets}
            groups = dictionary.groups_of(effect)
            for group in _free(groups, taken, in_part=in_part):
                places = dictionary.rows_of(effect, group)
                if (effect, group) in self._barred or not changed[places].any():
                    continue
                moments = self._grid_moments(effect, places, beside)
                parameters = dictionary.parameters(effect, *group)
                gain = grid_gain(parameters, *_weighted(moments, beside.scale[places]))
                best = int(gain.argmax())
                alone = [float(grid_gain(parameters, *of_row).max()) for of_row in moments]
                if self._may_reach(wanted, base, places, alone):
                    coarse.setdefault(group, []).append((float(gain[best]), effect, best))
        for group, found in coarse.items():
            # What the grid shows far behind the best does not catch up between its points.
            # (A share of measured torque seems to explain more than it does.)
            honest = (
                gain
                for gain, effect, _ in found
                if dictionary.per_step or not dictionary.takes_torque(effect)
            )
            least = enough if behind else max(enough, 0.4 * max(honest, default=0.0))
            for size, effect, best in found:
                if size > least:
                    dictionary.progress(LOOKING, 0.3)
                    result.append(self._best_on(effect, group, best, beside))
        return result

    def together(self, base: Explanation, promising: Sequence[Candidate]) -> list[list[Candidate]]:
        """Candidates of one effect in all feet, or in the same joint of all legs, with values of
        their own.

        Worth a fit where each is promising alone, or where one value for all explains more than the
        best of them: what all feet read is the robot's weight, and what one of them alone reads too
        much may be made up for by what the others leave.
        """
        beside, found = self.fits.remainder(base), []
        taken = {c.key for c in base.candidates} | self._barred
        for alike in self.fits.alike:
            members = alike.members
            keys = {c.key for c in members}
            alone = {c.targets: c for c in promising if c.key in keys}
            if not alone or keys & taken:
                continue
            if len(alone) == len(members) or self._one_value_explains_more(alike, alone, beside):
                found.append([alone.get(c.targets) or self.settled(c, base) for c in members])
        return found

    @staticmethod
    def _one_value_explains_more(
        alike: Alike, alone: Mapping[tuple[str, ...], Candidate], beside: Remainder
    ) -> bool:
        best = max(fixed_gain(*_inner_products(beside, c.signature)) for c in alone.values())
        gram, right = _inner_products(beside, alike.signature)
        return any(fixed_gain(one.T @ gram @ one, one.T @ right) > best for one in alike.shared)

    def settled(self, candidate: Candidate, base: Explanation) -> Candidate:
        """A candidate made linear about the values that fit best beside an explanation, if it is
        linear only nearby."""
        if not candidate.effect.linear_nearby:
            return candidate

        def made() -> Candidate:
            settled = candidate
            for _ in range(_EXPANSIONS):
                wider = self.fits.explain([*base.candidates, settled])
                start = wider.start(settled)
                values = wider.solved.parameters[start : start + len(settled.linear_names)]
                try:
                    settled = self.fits.about(settled, values)
                except InputError:
                    # No robot has these values.
                    break
            return settled

        return self._found.or_made((candidate, base), made)

    def plain_friction(self) -> Explanation:
        """Coulomb and viscous friction and a bias in every joint, fitted together; what
        identification of inertia begins with."""
        explanation = self.fits.explain([])
        for k in range(_SWEEPS):
            for effect in (CoulombViscousFriction, TorqueBias):
                self.fits.dictionary.progress("fitting plain friction", k / _SWEEPS)
                for joint in self.fits.dictionary.joints:
                    others = [
                        c
                        for c in explanation.candidates
                        if (c.effect, c.targets) != (effect, (joint,))
                    ]
                    explanation = self.beside(self.fits.explain(others), effect, (joint,))
        return explanation

    def beside(
        self, base: Explanation, effect: type[JointTorqueEffect], targets: tuple[str, ...]
    ) -> Explanation:
        """An explanation with one more joint torque effect, with the nonlinear values that fit best
        beside it."""
        remainder = self.fits.remainder(base)
        places = self.fits.dictionary.rows_of(effect, targets)
        moments = self._grid_moments(effect, places, remainder)
        parameters = self.fits.dictionary.parameters(effect, *targets)
        gain = grid_gain(parameters, *_weighted(moments, remainder.scale[places]))
        best = self._best_on(effect, targets, int(gain.argmax()), remainder)
        return self.fits.explain([*base.candidates, best])

    def _gains_enough(
        self, candidate: Candidate, base: Explanation, wanted: float, share: float
    ) -> bool:
        """Is a candidate that is no joint torque effect worth a fit?"""
        beside, s = self.fits.remainder(base), candidate.signature
        moments = beside.moments(s)
        gain = fixed_gain(*_weighted(moments, beside.scale[s.rows]))
        alone = (fixed_gain(*of_row) for of_row in moments)
        return gain > share * self.fits.required(candidate) and self._may_reach(
            wanted, base, s.rows, alone
        )

    def _grid_moments(
        self, effect: type[JointTorqueEffect], places: Sequence[int] | np.ndarray, beside: Remainder
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Inner products of the sets of an effect's first grid, in each of some rows."""
        grid, moments = self.fits.grid(effect), []
        for place in map(int, places):
            # Found once for what an explanation has in a row.
            key = (effect, place, *beside.beside(place).key)
            if key not in self._moments:
                self._moments[key] = beside.moments_of_grid(grid.sets[place])
            moments.append(self._moments[key])
        return moments

    def _may_reach(
        self,
        wanted: float,
        base: Explanation,
        rows: Sequence[int] | np.ndarray,
        alone: Iterable[float],
    ) -> bool:
        """May a candidate lower the deviance as much as is wanted?

        Beside it members may have values that they may not have without it: friction is none, and
        not negative, where what it shows beside is missing.

        Args:
            alone: what it would take off the sum of squares of each of these rows with values that
                suit this row best, of what members with any values leave.
        """
        if wanted <= 0:
            return True
        beside = self.fits.remainder(base)
        most = [
            of_row + beside.beside(row).held_back
            for row, of_row in zip(map(int, rows), alone, strict=True)
        ]
        return largest_drop(self.fits.white, base.sse, rows, most) > CATCHES_UP * wanted

    def _best_on(
        self,
        effect: type[JointTorqueEffect],
        group: tuple[str, ...],
        best: int,
        beside: Remainder,
    ) -> Candidate:
        """A joint torque effect with the nonlinear values that fit best; found once for what is
        left in the group's rows."""
        places = self.fits.dictionary.rows_of(effect, group)
        key = (effect, group, *(part for j in places for part in beside.beside(j).key))

        def made() -> Candidate:
            nonlinear = self._narrowed(effect, places, best, beside)
            return self.fits.candidate(effect, group, nonlinear, beside)

        return self._found.or_made(key, made)

    def _narrowed(
        self,
        effect: type[JointTorqueEffect],
        places: Sequence[int] | np.ndarray,
        best: int,
        beside: Remainder,
    ) -> np.ndarray:
        """Nonlinear values between the grid's points that fit best, shape (m,)."""
        dictionary = self.fits.dictionary
        points = self.fits.grid(effect).points[..., places[0]]
        chosen = points[:, best].copy()
        joints = dictionary.predictor.joints_of(np.asarray(places))
        parameters = dictionary.parameters(effect, *(dictionary.joints[k] for k in joints))
        ranges = [p.plausible for p in parameters.values() if not p.linear]
        steps = []
        for axis in points:
            values = np.unique(axis)
            steps.append(np.log(values[1] / values[0]) if len(values) > 1 else 0.0)
        for _ in range(_NARROWINGS):
            for k in range(len(chosen)):
                if steps[k] == 0:
                    continue
                trial = np.repeat(chosen[:, None], _POINTS, axis=1)
                trial[k] = np.clip(
                    chosen[k] * np.exp(np.linspace(-steps[k], steps[k], _POINTS)), *ranges[k]
                )
                found = [self.fits.sets(effect, place, trial) for place in places]
                moments = [beside.moments_of_sets(s.signature, 0, s.gram) for s in found]
                gain = grid_gain(parameters, *_weighted(moments, beside.scale[places]))
                chosen[k] = trial[k, int(gain.argmax())]
                steps[k] *= 2.0 / (_POINTS - 1)
        return chosen


def _inner_products(beside: Remainder, signature: Signature) -> tuple[np.ndarray, np.ndarray]:
    """Inner products of what an explanation leaves of columns, in all their rows together."""
    return _weighted(beside.moments(signature), beside.scale[signature.rows])


def _weighted(
    moments: Sequence[tuple[np.ndarray, np.ndarray]], scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over rows of inner products, weighted by the inverse of the rows' scales."""
    grams, rights = zip(*moments, strict=True)
    return (
        sum(part / s for part, s in zip(grams, scale, strict=True)),
        sum(part / s for part, s in zip(rights, scale, strict=True)),
    )


def largest_drop(
    white: WhitenedResidual,
    sse: np.ndarray,
    rows: Sequence[int] | np.ndarray,
    alone: Sequence[float],
) -> float:
    """More than this no effect lowers the deviance, whatever its values are.

    Together its rows lose no more than each of them with values that suit this row best. (Rows are
    not to be weighed against each other: where little is left in one row, it weighs more.)

    Args:
        sse: sums of squares that it is added to, (R,).
        rows: in which it acts.
        alone: what it takes off the sum of squares of each of them with such values.
    """
    left = sse.copy()
    left[rows] -= np.clip(alone, 0.0, sse[rows])
    return white.deviance(sse) - white.deviance(left)


def _free(
    groups: Sequence[tuple[str, ...]], taken: Set[str], *, in_part: bool
) -> list[tuple[str, ...]]:
    """Groups of joints of which none is taken, and of the others what is left if that is wished and
    several are."""
    whole = [group for group in groups if not taken & set(group)]
    if not in_part:
        return whole
    left = (tuple(joint for joint in group if joint not in taken) for group in groups)
    return list(dict.fromkeys([*whole, *(group for group in left if len(group) > 1)]))
