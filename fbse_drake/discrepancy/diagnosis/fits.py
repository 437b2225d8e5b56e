"""Fits of explanations to one residual: how well effects explain it together, and what they
leave."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np
from scipy.stats import chi2

from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary, FixedColumns
from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.grid_sets import GridSets, grid_gain
from fbse_drake.discrepancy.diagnosis.remainder import Remainder
from fbse_drake.discrepancy.identification.normal_equations import bounded_least_squares
from fbse_drake.discrepancy.identification.regression import (
    Regression,
    Signature,
    WhitenedResidual,
    connected,
    leftover,
)
from fbse_drake.discrepancy.identification.rounding import chance_bound, noise_of_rounding
from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.effects.effect import Effect, Parameter
from fbse_drake.effects.inertia import InertiaEffect
from fbse_drake.effects.joint_torque import JointTorqueEffect

# Probability of any false alarm on a log that hides nothing.
FALSE_ALARM = 1e-3
# Explanations whose deviances differ by less are not told apart (a likelihood ratio of some 150).
MARGIN = 10.0
# What a parameter must earn beyond what it costs on held-out data.
COMPLEXITY = 4.0
# Share of the doubt about known laws that an effect could mimic.
_SYSTEMATIC = 0.5
# Safety on what the noise in an effect's own columns may feign.
_SPURIOUS = 3.0
# Slopes with respect to nonlinear values are taken over this share of them, and hold within such
# factors of them.
_SLOPE_STEP = 0.02
_NEARBY = (0.4, 1.6)
# They are sought that many times beyond the ends of their plausible ranges.
_BEYOND = 2.0
# So many explanations are kept, and so many numbers in columns.
_KEPT = 500
_MOST_NUMBERS = 5_000_000
_MOST_POLISHED = 5_000_000


@dataclass(frozen=True)
class ColumnSets:
    """Columns of a joint torque effect in one row for G sets of its nonlinear values."""

    # Whitened, p columns for each set, one set after the other.
    signature: Signature
    # Inner products within each set, (G, p, p).
    gram: np.ndarray

    @property
    def columns(self) -> np.ndarray:
        """By set, (B, G, p)."""
        return self.signature.values.reshape(-1, *self.gram.shape[:2])


@dataclass(frozen=True)
class Grid:
    """The first sets of nonlinear values that a search tries."""

    # (m, G, n).
    points: np.ndarray
    # By row.
    sets: Mapping[int, GridSets]


@dataclass(frozen=True, eq=False)
class Alike:
    """Candidates of one effect in several places that may be wrong together."""

    members: list[Candidate]

    @cached_property
    def signature(self) -> Signature:
        """Their columns side by side."""
        signatures = [member.signature for member in self.members]
        rows = np.unique(np.concatenate([s.rows for s in signatures]))
        values = []
        for s in signatures:
            values.append(np.zeros((len(s.values), len(rows), s.parameters)))
            values[-1][:, np.searchsorted(rows, s.rows)] = s.values
        return Signature(rows, np.concatenate(values, axis=2))

    @cached_property
    def shared(self) -> list[np.ndarray]:
        """What makes one value of the values of all, side by side: (members p, p) each. Joints may
        be wrong to either side, for their axes are mirrored or not."""
        n, p = len(self.members), self.members[0].signature.parameters
        either = (1.0, -1.0) if self.members[0].effect.acts_on == "joint" else (1.0,)
        signs = product((1.0,), *[either] * (n - 1))
        return [np.kron(np.array(of_each)[:, None], np.eye(p)) for of_each in signs]


class Fits:
    """Explanations of one residual by one dictionary, weighted by the residual's noise."""

    def __init__(self, dictionary: Dictionary, white: WhitenedResidual | None = None):
        """Nothing is fitted yet.

        Args:
            white: the residual with the noise to weigh by; by default the predictor's.
        """
        self.dictionary = dictionary
        self.white = WhitenedResidual(dictionary.predictor.residual) if white is None else white
        inertia = dictionary.inertia
        # Whitened columns of inertia that is not trusted.
        self.always = (
            [] if inertia is None else [self.white.whiten_signature(dictionary.inertia_signature)]
        )
        self.regression = Regression(self.white)
        self._grids: dict[str, Grid] = {}
        self._explanations: Memory[Explanation] = Memory(_KEPT)
        self._sets: Memory[ColumnSets] = Memory(
            _MOST_NUMBERS, lambda sets: sets.signature.values.size
        )
        self._remainders: WeakKeyDictionary[Explanation, Remainder] = WeakKeyDictionary()
        # Candidates that are no joint torque effects, made linear about values.
        self._about: Memory[Candidate] = Memory(
            _MOST_NUMBERS, lambda c: c.signature.values.size + c.raw.values.size
        )
        # Candidates that were fitted together, made linear about the values that were found.
        self.polished: Memory[tuple[Candidate, ...]] = Memory(
            _MOST_POLISHED, lambda members: sum(c.signature.values.size for c in members)
        )

    def doubting(self, explanation: Explanation) -> tuple["Fits", Explanation]:
        """Fits that weigh the residual anew, and an explanation in them: friction laws that it
        takes off make the residual noisier."""
        predictor = self.dictionary.predictor
        names = predictor.robot.description
        resolved = [effect.resolve(names, is_change=True) for effect in explanation.effects]
        left = self.white.coloured(self.leftover(explanation))
        residual = predictor.doubted(predictor.residual, resolved, left)
        if np.array_equal(residual.variance, self.white.residual.variance):
            return self, explanation
        fits = Fits(self.dictionary, WhitenedResidual(residual))
        moved = [
            replace(c, signature=fits.white.whiten_signature(c.raw)) for c in explanation.candidates
        ]
        return fits, fits.explain(moved)

    @cached_property
    def fixed_candidates(self) -> list[Candidate]:
        """All candidates that are no joint torque effects: one for each target that moves the
        residual."""
        return [
            self._fixed_candidate(effect, fixed)
            for effect, found in self.dictionary.fixed.items()
            for fixed in found
        ]

    @cached_property
    def alike(self) -> list[Alike]:
        """Candidates of one effect in all feet, or in the same joint of all legs; of robots with
        more than one."""
        description = self.dictionary.predictor.robot.description
        joints = dict.fromkeys(map(description.counterparts, self.dictionary.joints))
        groups = {"foot": [tuple(description.sides)], "joint": list(joints)}
        found: dict[type[Effect], dict[str, Candidate]] = {}
        for candidate in self.fixed_candidates:
            found.setdefault(candidate.effect, {})[candidate.targets[0]] = candidate
        return [
            Alike([of_target[target] for target in group])
            for effect, of_target in found.items()
            for group in groups.get(effect.acts_on, [])
            if len(group) > 1 and of_target.keys() >= set(group)
        ]

    def _fixed_candidate(self, effect: type[Effect], fixed: FixedColumns) -> Candidate:
        signature = self.white.whiten_signature(fixed.signature)
        candidate = Candidate(
            effect,
            (fixed.target,),
            self.dictionary.parameters(effect, fixed.target),
            fixed.nonlinear,
            signature,
            fixed.signature,
        )
        if fixed.noise is None:
            return candidate
        noise = self.white.whiten_signature(fixed.noise)
        is_measured = self.dictionary.is_measured(effect)
        return replace(
            candidate,
            noise_drop=_noise_drop(signature, noise, self._noise) if is_measured else 0.0,
            noise_power=(noise.values**2).sum(axis=0),
        )

    @cached_property
    def _noise(self) -> np.ndarray:
        """A realization of the residual's noise, whitened, (B, R)."""
        realization = self.dictionary.predictor.noise_realization
        return np.stack(
            [self.white.whiten(row, values) for row, values in enumerate(realization.T)], axis=1
        )

    @cached_property
    def _rounding(self) -> np.ndarray:
        return noise_of_rounding(self.dictionary.predictor.motion, self.white)

    def feigned(self, candidate: Candidate) -> float:
        """Drop of the deviance by a law that repeats with the angle that rounded angles feign, of
        all its nonlinear values by those that suit best; 0 for others, and where angles are not
        rounded."""
        effect = candidate.effect
        if not issubclass(effect, JointTorqueEffect) or not effect.repeats:
            return 0.0
        draws, bounds = self._rounding, [0.0]
        for row in map(int, candidate.signature.rows if len(draws) else ()):
            sets = self.grid(effect).sets[row]
            right = sets.times(draws[:, :, row].T).reshape(*sets.gram.shape[:2], -1)
            largest = [
                grid_gain(candidate.parameters, sets.gram, of_draw).max()
                for of_draw in np.moveaxis(right, 2, 0)
            ]
            bounds.append(chance_bound(np.array(largest), FALSE_ALARM / len(self.white.count)))
        return max(bounds)

    @cached_property
    def threshold(self) -> np.ndarray:
        """Drop of the deviance that k parameters must bring before they count, by k."""
        return np.array([np.inf, *map(self.needed_drop, range(1, 13))])

    def needed_drop(self, parameters: int) -> float:
        """Drop of the deviance that so many parameters must bring before they count."""
        return float(chi2.isf(FALSE_ALARM / self._tests, parameters))

    @cached_property
    def _tests(self) -> int:
        """How many additions a search tries."""
        tests = sum(map(len, self.dictionary.fixed.values()))
        for effect in self.dictionary.joint_effects:
            sets = self.dictionary.points(effect).shape[1]
            tests += len(self.dictionary.groups_of(effect)) * max(1, sets // 4)
        return max(1, tests)

    def explain(self, candidates: Sequence[Candidate]) -> Explanation:
        """Fits candidates together."""
        key = tuple(candidates)
        return self._explanations.or_made(key, lambda: self._explain(key))

    def _explain(self, candidates: tuple[Candidate, ...]) -> Explanation:
        white = self.white
        if not candidates and not self.always:
            return Explanation((), None, white.sse, white.sse, white.deviance(white.sse))
        fit = self.regression.fit([*(c.signature for c in candidates), *self.always])
        charge = COMPLEXITY * sum(c.signature.parameters for c in candidates)
        factor = self.torque_factor(candidates, fit.parameters)
        sse, held_out_sse = fit.sse * factor, fit.held_out_sse * factor
        return Explanation(
            candidates, fit, sse, held_out_sse, white.deviance(held_out_sse) + charge
        )

    def torque_factor(
        self,
        candidates: Sequence[Candidate],
        parameters: np.ndarray,
        kept: np.ndarray | float = 1.0,
    ) -> np.ndarray | float:
        """What the squares of each row are to be multiplied with where torque is measured and
        effects take a share of it, (R,).

        With u = share * torque, the rest torque - u - ... is the error of the torque times 1 -
        share: a share near 1 would explain everything. As the error of the torque itself it is the
        larger the more is taken. What gives torque makes it no smaller: regressors are free of the
        torque's noise.

        Args:
            kept: share of the torque's error that is in what effects take of it, (n,), or in all
                joints.
        """
        taking = [c for c in candidates if self.dictionary.takes_torque(c.effect)]
        if self.dictionary.per_step or not taking:
            return 1.0
        torque = self.dictionary.predictor.motion.blocks.torque_command
        kept = np.broadcast_to(kept, torque.shape[1])
        taken: dict[int, np.ndarray] = {}
        start = 0
        for c in candidates:
            stop = start + c.signature.parameters
            if c in taking:
                added = c.raw.values @ parameters[start:stop] + c.raw.offset
                for row, values in zip(c.raw.rows, added.T, strict=True):
                    if row >= torque.shape[1]:
                        continue
                    taken[row] = taken[row] + values if row in taken else values
            start = stop
        factor = np.ones(self.white.y.shape[1])
        for row, values in taken.items():
            known = self.white.residual.known[:, row]
            own, rest = (
                float((part[known] ** 2).sum())
                for part in (torque[:, row], torque[:, row] - kept[row] * values)
            )
            if own > rest > 0:
                factor[row] = own / rest
        return factor

    def if_left_is_noise(self, explanation: Explanation) -> float:
        """Its deviance if all that it leaves were white noise of the torque, of which little is in
        regressors of torques that are free of it, see `Reading.kept_noise`."""
        candidates, parameters = explanation.candidates, explanation.solved.parameters
        of_noise = self.torque_factor(
            candidates, parameters, self.dictionary.predictor.reading.kept_noise
        )
        factor = of_noise / self.torque_factor(candidates, parameters)
        deviance = self.white.deviance
        sse = explanation.held_out_sse
        return explanation.deviance + deviance(sse * factor) - deviance(sse)

    @property
    def noise_alone(self) -> Explanation:
        """What an explanation that leaves nothing but noise would be, without any effects."""
        return Explanation((), None, 1.0 * self.white.count, 1.0 * self.white.count, 0.0)

    def systematic(self, rows: np.ndarray) -> float:
        """Drop of the deviance that doubtful laws alone may give to an effect in these rows: what
        is doubted need not be random."""
        return (
            _SYSTEMATIC * float(self.white.doubt[rows].sum()) if self.dictionary.per_step else 0.0
        )

    def grid(self, effect: type[JointTorqueEffect]) -> Grid:
        """First grid of an effect's nonlinear values, in all joints."""
        if effect.__name__ not in self._grids:
            grid = self.dictionary.grid(effect)
            sets = {row: GridSets(self.white, row, columns) for row, columns in grid}
            self._grids[effect.__name__] = Grid(self.dictionary.points(effect), sets)
        return self._grids[effect.__name__]

    def sets(
        self,
        effect: type[JointTorqueEffect],
        place: int,
        points: np.ndarray,
        *,
        noisier: bool = False,
    ) -> ColumnSets:
        """Sets of an effect's nonlinear values, (m, G), in one row; if they are to be noisier,
        with the sensors' noise once more."""

        def made() -> ColumnSets:
            columns = self.dictionary.columns(effect, np.array([place]), points, noisier=noisier)
            return self._whitened(columns[:, 0], place)

        return self._sets.or_made((effect, place, points.tobytes(), noisier), made)

    def _whitened(self, columns: np.ndarray, place: int) -> ColumnSets:
        """Of columns (B, p, G)."""
        values = self.white.whiten(place, np.swapaxes(columns, 1, 2))
        by_set = np.moveaxis(values, 0, 2)
        flat = values.reshape(len(values), 1, -1)
        return ColumnSets(Signature(np.array([place]), flat), by_set @ np.swapaxes(by_set, 1, 2))

    def candidate(
        self,
        effect: type[JointTorqueEffect],
        group: tuple[str, ...],
        nonlinear: np.ndarray,
        beside: Remainder,
    ) -> Candidate:
        """A joint torque effect with nonlinear values, linearised about them.

        Args:
            beside: what the explanation leaves that it is to be added to.
        """
        places = self.dictionary.rows_of(effect, group)
        parameters = self.dictionary.parameters(effect, *group)
        smallest = np.array([p.bounds[0] for p in parameters.values() if p.linear])
        steps = _SLOPE_STEP * nonlinear
        # The values themselves, then for each of them a bit less and a bit more.
        stencil = np.repeat(nonlinear[:, None], 1 + 2 * len(nonlinear), axis=1)
        for k, step in enumerate(steps):
            stencil[k, 1 + 2 * k : 3 + 2 * k] += [-step, step]
        sets = [self.sets(effect, place, stencil) for place in places]
        amounts = np.ones(1)
        if len(smallest):
            moments = [beside.moments_of_sets(s.signature, 0, s.gram) for s in sets]
            gram, right = (sum(part[0] for part in parts) for parts in zip(*moments, strict=True))
            # A slope for an amount that cannot be would mimic just that.
            amounts = bounded_least_squares(gram, right, smallest, np.full_like(smallest, np.inf))

        def linearised(columns: np.ndarray) -> np.ndarray:
            """Columns (r, B, G, p) of the stencil: those of the amounts, then slopes for amounts
            that fit best; (B, r, P)."""
            slopes = [
                (columns[:, :, 2 + 2 * k] - columns[:, :, 1 + 2 * k]) @ amounts / (2 * step)
                for k, step in enumerate(steps)
            ]
            together = [columns[:, :, 0], *(slope[..., None] for slope in slopes)]
            return np.moveaxis(np.concatenate(together, axis=2), 0, 1)

        beliefs = _beliefs(parameters, nonlinear, np.zeros(len(smallest)), smallest)

        def signature(columns: np.ndarray) -> Signature:
            values = linearised(columns)
            if len(smallest):
                return Signature(places, values, **beliefs)
            return Signature(places, values[:, :, 1:], values[:, :, 0], **beliefs)

        # A candidate must not hold the fits that hold it.
        dictionary = self.dictionary

        def raw() -> Signature:
            # From (B, r, p, G).
            columns = dictionary.columns(effect, places, stencil)
            return signature(np.transpose(columns, (1, 0, 3, 2)))

        whitened = np.stack([s.columns for s in sets])
        here = nonlinear[:, None]
        noisier = [self.sets(effect, place, here, noisier=True).columns[:, 0] for place in places]
        both = sum(
            (noisy - clean[:, 0]).T @ self._noise[:, place]
            for noisy, clean, place in zip(noisier, whitened, places, strict=True)
        )
        spurious = _SPURIOUS * fixed_gain(sum(s.gram[0] for s in sets), both)
        return Candidate(effect, group, parameters, nonlinear, signature(whitened), raw, spurious)

    def about(self, candidate: Candidate, values: np.ndarray) -> Candidate:
        """A candidate that is no joint torque effect, made linear about values of its linear
        parameters.

        Raises:
            InputError: no body has these values.
        """
        if issubclass(candidate.effect, InertiaEffect):
            about = np.broadcast_to(candidate.raw.about, values.shape)
            values = candidate.effect.nearby(about, values)
        key = (*candidate.key, candidate.nonlinear.tobytes(), values.tobytes())
        return self._about.or_made(key, partial(self._made_about, candidate, values))

    def _made_about(self, candidate: Candidate, values: np.ndarray) -> Candidate:
        effect, target, nonlinear = candidate.effect, candidate.targets[0], candidate.nonlinear
        raw = self.dictionary.predictor.signature_near(
            effect, target, values, nonlinear, candidate.raw
        )
        signature = self.white.whiten_signature(raw)
        if not self.dictionary.is_measured(effect):
            return replace(candidate, source=raw, signature=signature)
        # A candidate must not hold the fits that hold it.
        predictor, white, realization = self.dictionary.predictor, self.white, self._noise

        def noise_drop() -> float:
            noise = white.whiten_signature(predictor.noise_in(effect, target, nonlinear, raw))
            return _noise_drop(signature, noise, realization)

        return replace(candidate, source=raw, signature=signature, noise_drop=noise_drop)

    def with_slopes(self, candidate: Candidate, linear: np.ndarray) -> Candidate:
        """A candidate that is no joint torque effect whose nonlinear values are fitted as well, by
        slopes over them.

        Args:
            linear: values of its linear parameters at which these are taken, (p,).
        """
        raw, here, predictor = candidate.raw, candidate.nonlinear, self.dictionary.predictor
        steps = _SLOPE_STEP * here

        def added(nonlinear: np.ndarray) -> np.ndarray:
            near = predictor.signature_near(
                candidate.effect, candidate.targets[0], linear, nonlinear, raw
            )
            return near.values @ linear + near.offset

        slopes = [
            (added(here + change) - added(here - change)) / (2 * step)
            for change, step in zip(np.diag(steps), steps, strict=True)
        ]
        p = len(linear)
        wider = replace(
            raw,
            values=np.concatenate([raw.values, np.stack(slopes, axis=2)], axis=2),
            **_beliefs(
                candidate.parameters,
                here,
                np.broadcast_to(raw.prior, p),
                np.broadcast_to(raw.lowest, p),
            ),
        )
        return replace(candidate, source=wider, signature=self.white.whiten_signature(wider))

    def signatures(self, explanation: Explanation) -> tuple[Signature, ...]:
        """Whitened, in the order of the explanation's parameters."""
        return (
            *(c.signature for c in explanation.candidates),
            *(self.always if explanation.fit is not None else []),
        )

    def leftover(self, explanation: Explanation) -> np.ndarray:
        """Whitened residual after an explanation, (B, R)."""
        if explanation.fit is None:
            return self.white.y
        return leftover(self.white, self.signatures(explanation), explanation.fit.parameters)

    def apart(self, candidates: Sequence[Candidate]) -> list[list[int]]:
        """Places of candidates whose fits depend on each other, group by group."""
        if self.always:
            return [list(range(len(candidates)))] if candidates else []
        return connected([c.signature for c in candidates])

    def remainder(self, explanation: Explanation) -> Remainder:
        """What further effects could take of what an explanation leaves."""
        if explanation not in self._remainders:
            parameters = np.zeros(0) if explanation.fit is None else explanation.fit.parameters
            self._remainders[explanation] = Remainder(
                self.regression,
                self.signatures(explanation),
                parameters,
                self.white.scale(explanation.sse),
                tied=bool(self.always),
            )
        return self._remainders[explanation]

    def required(self, candidate: Candidate) -> float:
        """Drop of the deviance that a candidate must bring before it counts."""
        rows, parameters = candidate.signature.rows, candidate.signature.parameters
        return float(
            self.threshold[min(12, parameters)] + self.systematic(rows) + candidate.spurious
        )

    def needed(self, parameters: int) -> float:
        """Sum of squares that an effect with so many parameters must have to be found."""
        return float(self.threshold[min(12, parameters)] + (COMPLEXITY + 1) * parameters)


def fixed_gain(gram: np.ndarray, right: np.ndarray) -> float:
    """Drop of the sum of squares by columns with these inner products, roughly."""
    return float(right @ np.linalg.lstsq(gram, right, rcond=1e-10)[0])


def _noise_drop(signature: Signature, noise: Signature, realization: np.ndarray) -> float:
    """Drop of the deviance that noise in columns may feign.

    Args:
        noise: what it adds to the columns.
        realization: what it adds to the residual, whitened, (B, R).
    """
    right = np.einsum("brp,br->p", noise.values, realization[:, signature.rows])
    gram = np.tensordot(signature.values, signature.values, axes=((0, 1), (0, 1)))
    return _SPURIOUS * fixed_gain(gram, right)


def _beliefs(
    parameters: Mapping[str, Parameter],
    nonlinear: np.ndarray,
    prior: np.ndarray,
    lowest: np.ndarray,
) -> dict[str, np.ndarray]:
    """What is believed of the parameters of an effect that is linearised about nonlinear values,
    (m,), and where that holds; see `Signature`, (p + m,) each.

    Args:
        prior, lowest: of the linear parameters, (p,).
    """
    searched = [parameter for parameter in parameters.values() if not parameter.linear]
    # A weak belief in the middle of the plausible range keeps values that the data say nothing
    # about from running away.
    ranges = np.log([parameter.plausible for parameter in searched]).reshape(-1, 2)
    spread = 0.25 * (ranges[:, 1] - ranges[:, 0]) * nonlinear
    middle = nonlinear * (ranges.mean(axis=1) - np.log(nonlinear))
    near = np.array([parameter.linear_within for parameter in searched])
    # Beyond where its slopes hold a law would mimic what no law of its kind does.
    down, up = _nearby(parameters, nonlinear)
    unknown, unbounded = np.zeros(len(prior)), np.full(len(prior), np.inf)
    return {
        "prior": np.append(prior, spread**-2.0),
        "expected": np.append(unknown, middle),
        "steadying": np.append(unknown, (near * nonlinear) ** -2.0),
        "lowest": np.append(lowest, down),
        "highest": np.append(unbounded, up),
    }


def is_smallest(parameter: Parameter, value: float) -> bool:
    """Is a nonlinear value the smallest that is sought?"""
    smallest = parameter.plausible[0] / _BEYOND
    return value < smallest or math.isclose(value, smallest, rel_tol=1e-6)


def _nearby(
    parameters: Mapping[str, Parameter], nonlinear: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far nonlinear values can be moved where slopes about them hold, down and up, (m,) each:
    not far beyond their plausible ranges either."""
    ranges = np.array([p.plausible for p in parameters.values() if not p.linear]).reshape(-1, 2)
    least, most = (factor * nonlinear for factor in _NEARBY)
    down = np.maximum(least, ranges[:, 0] / _BEYOND) - nonlinear
    up = np.minimum(most, ranges[:, 1] * _BEYOND) - nonlinear
    return np.minimum(down, 0.0), np.maximum(up, 0.0)
