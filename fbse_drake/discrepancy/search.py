"""Search for the effects that explain a residual: which, where, with which values."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from scipy.stats import chi2

from fbse_drake.discrepancy.inertial import (
    IdentifiedInertia,
    consistent_parameters,
    identified_inertia,
    untrusted_bodies,
    untrusted_inertia,
)
from fbse_drake.discrepancy.prediction import Predictor
from fbse_drake.discrepancy.regression import (
    Fit,
    Signature,
    WhitenedResidual,
    bounded_least_squares,
)
from fbse_drake.discrepancy.residual import Residual
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.effect import Effect, Parameter
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.effects.inertia import BodyMass, InertiaEffect
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, basis_over_time
from fbse_drake.effects.sensor import FootForceGain, SensorEffect
from fbse_drake.errors import InputError

# Probability of any false alarm on a log that hides nothing.
FALSE_ALARM = 1e-3
# Explanations whose deviances differ by less are not told apart (a likelihood ratio of some 150).
MARGIN = 10.0
# What a parameter must earn beyond what it costs on held-out data.
_COMPLEXITY = 4.0
# How often a grid of nonlinear values is narrowed down around its best point, and to how many points.
_NARROWINGS = 2
_POINTS = 9
# Share of the doubt about known laws that an effect could mimic.
_SYSTEMATIC = 0.5
# What an effect takes off a row may be wrong by this share; so small a rest is no evidence of another effect.
_MISFIT = 0.02
# Safety on what the noise in an effect's own columns may feign.
_SPURIOUS = 3.0
# How often nonlinear values are moved to where they fit, in turn, where inertia is fitted along.
_POLISHINGS = 3
# A size that is this many times the largest plausible one is none.
_HOPELESS = 1e3
# A value may lie beyond the plausible range by this factor.
_IMPLAUSIBLE = 3.0


@dataclass(frozen=True)
class Candidate:
    """One effect on one or more targets that share its values."""

    effect: type[Effect]
    # Joints, bodies, sides or `robot`.
    targets: tuple[str, ...]
    # Of the effect, in the units of the targets.
    parameters: Mapping[str, Parameter]
    # Values of its nonlinear parameters, shape (m,).
    nonlinear: np.ndarray
    # Whitened; columns are the linear parameters, then the change of the nonlinear ones. And as it is.
    signature: Signature
    raw: Signature
    # Drop of the deviance that it brings because the sensors' noise is in its columns and in the residual alike.
    spurious: float = 0.0

    @property
    def name(self) -> str:
        return self.effect.__name__

    @property
    def has_linear(self) -> bool:
        """Does it have an amount, or nonlinear parameters alone?"""
        return bool(self.linear_names)

    @property
    def linear_names(self) -> list[str]:
        return [name for name, parameter in self.effect.parameters.items() if parameter.linear]

    @property
    def nonlinear_names(self) -> list[str]:
        return [name for name, parameter in self.effect.parameters.items() if not parameter.linear]


@dataclass(frozen=True)
class Explanation:
    """Effects that are fitted together; their parameters stand one candidate after the other, then those of untrusted inertia."""

    candidates: tuple[Candidate, ...]
    # None for no effects at all.
    fit: Fit | None
    sse: np.ndarray
    held_out_sse: np.ndarray
    # Of held-out data, with the charge for every parameter; smaller is better.
    deviance: float

    def start(self, candidate: Candidate) -> int:
        """Place of a candidate's first parameter."""
        return sum(
            c.signature.values.shape[2]
            for c in itertools.takewhile(lambda c: c is not candidate, self.candidates)
        )

    def values(
        self, candidate: Candidate
    ) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
        """Values of a candidate's parameters and their 95 % intervals, by name, within the parameters' bounds.

        A nonlinear parameter that was not searched for has its plausible range as interval.
        """
        start, names = self.start(candidate), candidate.linear_names
        fitted = names + (
            candidate.nonlinear_names if issubclass(candidate.effect, JointTorqueEffect) else []
        )
        offsets = np.concatenate([np.zeros(len(names)), candidate.nonlinear])[: len(fitted)]
        part = slice(start, start + len(fitted))
        values, intervals = (
            self.fit.parameters[part] + offsets,
            self.fit.interval()[part] + offsets[:, None],
        )
        found, between = {}, {}
        for name, value, interval in zip(fitted, values, intervals, strict=True):
            bounds = candidate.parameters[name].bounds
            found[name], between[name] = (
                float(np.clip(value, *bounds)),
                tuple(np.clip(interval, *bounds).tolist()),
            )
        for name, value in zip(candidate.nonlinear_names, candidate.nonlinear, strict=True):
            if name not in found:
                found[name], between[name] = float(value), candidate.parameters[name].plausible
        return found, between

    @property
    def effects(self) -> list[Effect]:
        """The candidates' effects with the values that were found."""
        found = []
        for candidate in self.candidates:
            values, _ = self.values(candidate)
            same = {name: [value] * len(candidate.targets) for name, value in values.items()}
            found.append(candidate.effect.from_values(candidate.targets, same))
        return found


class Search:
    """The effects that could explain one residual, and the fits of them."""

    def __init__(
        self, predictor: Predictor, effects: Collection[type[Effect]], bodies: Sequence[str] = ()
    ):
        """Prepares the search.

        Args:
            effects: what is tried.
            bodies: whose masses are tried.
        """
        self.predictor, self.effects = (
            predictor,
            [effect for effect in effects if not effect.composite],
        )
        # In a log per step it is not known at which velocity within the step a law holds: what such a law leaves is weak evidence.
        self._per_step = predictor.scenario.recording.rows == "per_step"
        self._joints = predictor.robot.joint_names
        self._travel = np.ptp(predictor.motion.signals.joint_position, axis=0)
        self._unit = dict(zip(self._joints, predictor.robot.torque_units, strict=True))
        untrusted = untrusted_bodies(predictor.robot, predictor.scenario.identify.inertia)
        self._bodies = [body for body in bodies if body not in untrusted]
        # Inertial parameters that are not trusted are fitted in every explanation, in directions that the log shows.
        self.inertia = untrusted_inertia(predictor.motion, untrusted) if untrusted else None
        if self.inertia is not None:
            # Friction is tried as a whole: as long as half of it is missing, inertia is fitted to that half.
            self.effects += [effect for effect in effects if effect is CoulombViscousFriction]
            self._directions = self.inertia.visible_directions(WhitenedResidual(predictor.residual))
            self._inertia = self.inertia.signature(self._directions)
        # What does not depend on the noise: columns of grids of nonlinear values, and candidates that are no joint torque effects.
        self._raw_grids: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._raw_fixed: list[
            tuple[type[Effect], str, np.ndarray, Signature, Signature | None]
        ] = []
        self._weigh(predictor.residual)

    def _weigh(self, residual: Residual) -> None:
        self.white = WhitenedResidual(residual)
        self._always = [] if self.inertia is None else [self.white.whiten_signature(self._inertia)]
        self._grids: dict[str, tuple[np.ndarray, list[np.ndarray]]] = {}
        self._found: dict[tuple[str, tuple[str, ...], bytes], Candidate] = {}
        for name in ("fixed_candidates", "_noise"):
            self.__dict__.pop(name, None)

    def doubting(self, explanation: Explanation) -> Explanation:
        """Weighs the residual anew: friction laws that an explanation takes off make it noisier. Returns the explanation, fitted anew."""
        resolved = [
            effect.resolve(self.predictor.robot.description) for effect in explanation.effects
        ]
        self._weigh(self.predictor.doubted(self.predictor.residual, resolved))
        return self.explain(
            [
                replace(c, signature=self.white.whiten_signature(c.raw))
                for c in explanation.candidates
            ]
        )

    def parameters(self, effect: type[Effect], target: str) -> Mapping[str, Parameter]:
        """An effect's parameters in the units of a target."""
        return effect.parameters_at(self._unit.get(target, "Nm"))

    def largest_plausible(self, effect: type[Effect], target: str) -> float:
        """See `Effect.largest_plausible`; in the unit of a target."""
        return effect.largest_plausible(self._unit.get(target, "Nm"))

    @cached_property
    def joint_effects(self) -> list[type[JointTorqueEffect]]:
        return [effect for effect in self.effects if issubclass(effect, JointTorqueEffect)]

    @cached_property
    def groups(self) -> list[tuple[str, ...]]:
        """Joints that may share values: each alone, the same joint of every leg, all."""
        description = self.predictor.robot.description
        wider = [
            group
            for group in (*map(description.counterparts, self._joints), tuple(self._joints))
            if len(group) > 1
        ]
        # Newtons and newton metres have no values in common.
        wider = [group for group in wider if len({self._unit[joint] for joint in group}) == 1]
        return [*((joint,) for joint in self._joints), *dict.fromkeys(wider)]

    @cached_property
    def fixed_candidates(self) -> list[Candidate]:
        """All candidates that are no joint torque effects: one for each target that moves the residual."""
        if not self._raw_fixed:
            targets = {
                "joint": self._joints,
                "foot": self.predictor.robot.description.sides,
                "body": self._bodies,
                "robot": ["robot"],
            }
            for effect in self.effects:
                if issubclass(effect, JointTorqueEffect):
                    continue
                # Their nonlinear parameters keep the default.
                for target in targets[effect.acts_on]:
                    usual = self.usual_at(effect, target)
                    raw = self.predictor.signature(effect, target, usual)
                    raw = replace(
                        raw,
                        lowest=np.array(
                            [
                                parameter.bounds[0]
                                for parameter in effect.parameters.values()
                                if parameter.linear
                            ]
                        ),
                    )
                    if len(raw.rows):
                        noise = (
                            self.predictor.noise_in(effect, target, raw)
                            if issubclass(effect, InertiaEffect)
                            else None
                        )
                        self._raw_fixed.append((effect, target, usual, raw, noise))
        result = []
        for effect, target, nonlinear, raw, noise in self._raw_fixed:
            signature = self.white.whiten_signature(raw)
            spurious = (
                0.0
                if noise is None
                else self._spurious(signature, self.white.whiten_signature(noise))
            )
            result.append(
                Candidate(
                    effect,
                    (target,),
                    self.parameters(effect, target),
                    nonlinear,
                    signature,
                    raw,
                    spurious,
                )
            )
        return result

    def _spurious(self, signature: Signature, noise: Signature) -> float:
        both = np.einsum("brp,br->p", noise.values, self._noise[:, signature.rows])
        power = (signature.values**2).sum(axis=(0, 1))
        return _SPURIOUS * float((both**2 / np.maximum(power, 1e-30)).sum())

    @cached_property
    def _noise(self) -> np.ndarray:
        """A realization of the residual's noise, whitened, (B, R)."""
        realization = self.predictor.noise_realization
        return np.stack(
            [self.white.whiten(row, values) for row, values in enumerate(realization.T)], axis=1
        )

    @cached_property
    def threshold(self) -> np.ndarray:
        """Drop of the deviance that k parameters must bring before they count, by k."""
        tests = len(self.fixed_candidates)
        for effect in self.joint_effects:
            tests += len(self.groups) * max(1, self._grid(effect)[0].shape[1] // 4)
        return np.array([np.inf, *(chi2.isf(FALSE_ALARM / tests, k) for k in range(1, 13))])

    def explain(self, candidates: Sequence[Candidate]) -> Explanation:
        """Fits candidates together."""
        if not candidates and not self._always:
            return Explanation(
                (), None, self.white.sse, self.white.sse, self.white.deviance(self.white.sse)
            )
        fit = self.white.fit([*(c.signature for c in candidates), *self._always])
        charge = _COMPLEXITY * sum(c.signature.values.shape[2] for c in candidates)
        factor = self._torque_factor(candidates, fit.parameters)
        sse, held_out_sse = fit.sse * factor, fit.held_out_sse * factor
        return Explanation(
            tuple(candidates), fit, sse, held_out_sse, self.white.deviance(held_out_sse) + charge
        )

    def _takes_torque(self, effect: type[Effect]) -> bool:
        # The load of inertia that is not trusted is taken from the measured torque.
        return takes_command(effect, load_too=self.inertia is not None)

    def _torque_factor(
        self, candidates: Sequence[Candidate], parameters: np.ndarray
    ) -> np.ndarray | float:
        """What the squares of each row are to be multiplied with where torque is measured and effects take a share of it, (R,).

        With u = share * torque, the rest torque - u - ... is the error of the torque times 1 - share: a share near 1 would explain
        everything. As the error of the torque itself it is the larger the more is taken.
        """
        if self._per_step:
            return 1.0
        torque = self.predictor.motion.blocks.torque_command
        taken, start = np.zeros_like(torque), 0
        for c in candidates:
            stop = start + c.signature.values.shape[2]
            if self._takes_torque(c.effect):
                taken[:, c.raw.rows] += c.raw.values @ parameters[start:stop] + c.raw.offset
            start = stop
        known = self.white.residual.known[:, : torque.shape[1]]
        factor = np.ones(self.white.y.shape[1])
        own, rest = (
            (np.where(known, values, 0.0) ** 2).sum(axis=0) for values in (torque, torque - taken)
        )
        factor[: len(own)] = np.divide(
            own, rest, out=np.ones_like(own), where=(own > 0) & (rest > 0)
        )
        return factor

    @property
    def noise_alone(self) -> Explanation:
        """What an explanation that leaves nothing but noise would be, without any effects."""
        return Explanation((), None, 1.0 * self.white.count, 1.0 * self.white.count, 0.0)

    def best_additions(
        self, base: Explanation, rows: np.ndarray | None = None
    ) -> list[Explanation]:
        """What one more candidate makes of an explanation, for every candidate that improves it significantly, best first.

        Joints of both legs may be wrong together, and one alone look like something else: `_pairs` are tried too.

        Args:
            rows: only candidates that change one of these; by default all.
        """
        promising, found = self._promising(base, rows), []
        for added in [*([candidate] for candidate in promising), *self._pairs(promising)]:
            everything = [*base.candidates, *added]
            if self._loses_scale(everything):
                continue
            wider = self.explain(everything)
            without = (
                base
                if len(added) == 1
                else self.explain([c for c in everything if c is not member])
                for member in added
            )
            if all(
                self.is_significant(rest, wider, member)
                for rest, member in zip(without, added, strict=True)
            ):
                found.append(wider)
        return sorted(found, key=lambda e: e.deviance)

    def _pairs(self, candidates: Sequence[Candidate]) -> list[list[Candidate]]:
        """Candidates in joints that are no joint torque effects, each with its like on the other legs; with values of their own."""
        alike = dict.fromkeys(map(self.predictor.robot.description.counterparts, self._joints))
        found = {
            (c.effect, c.targets): c
            for c in candidates
            if not issubclass(c.effect, JointTorqueEffect)
        }
        result = []
        for effect in dict.fromkeys(c.effect for c in candidates):
            for targets in alike:
                members = [found.get((effect, (target,))) for target in targets]
                if len(members) > 1 and None not in members:
                    result.append(members)
        return result

    def _loses_scale(self, candidates: Sequence[Candidate]) -> bool:
        """Could everything be nothing? Without torques only the masses and the gains of the feet say how large forces are: if all of them
        are free, the smallest robot with the deafest feet explains every log."""
        names = self.predictor.robot.description
        gained = {side for c in candidates if c.effect is FootForceGain for side in c.targets}
        torques = any(self.white.count[: len(names.joint_names)])
        return (
            bool(names.sides)
            and not torques
            and gained == set(names.sides)
            and any(c.effect is BodyMass for c in candidates)
        )

    def systematic(self, rows: np.ndarray) -> float:
        """Drop of the deviance that doubtful laws alone may give to an effect in these rows: what is doubted need not be random."""
        return _SYSTEMATIC * float(self.white.doubt[rows].sum()) if self._per_step else 0.0

    def is_significant(self, base: Explanation, wider: Explanation, added: Candidate) -> bool:
        """Does a candidate bring more than chance to an explanation without it, with values that can be?"""
        rows = added.signature.rows
        if issubclass(added.effect, JointTorqueEffect) and not np.any(
            added.effect.shows_within(self._travel[rows], added.nonlinear)
        ):
            return False
        drop = base.deviance - wider.deviance
        if (
            drop
            < self.threshold[min(12, added.signature.values.shape[2])]
            + self.systematic(rows)
            + added.spurious
        ):
            return False
        taken, gained = (
            float(np.maximum(a[rows] - b[rows], 0.0).sum())
            for a, b in ((self.white.sse, base.sse), (base.sse, wider.sse))
        )
        if self._per_step and gained < _MISFIT * taken:
            return False
        start = wider.start(added)
        names = added.linear_names if added.has_linear else added.nonlinear_names
        offsets = np.zeros(len(names)) if added.has_linear else added.nonlinear
        part = slice(start, start + len(names))
        values, deviations, intervals = (
            wider.fit.parameters[part] + offsets,
            wider.fit.deviation[part],
            wider.fit.interval()[part],
        )
        for name, value, deviation, (least, most) in zip(
            names, values, deviations, intervals, strict=True
        ):
            low, high = added.parameters[name].bounds
            plausible = added.parameters[name].plausible
            widest = max(abs(bound) for bound in plausible)
            if (
                value < low
                or value > high + 3 * deviation
                or abs(value) > _IMPLAUSIBLE * widest + 3 * deviation
            ):
                return False
            # What is not told from nothing may not be implausible as well.
            if abs(value) > widest and least <= 0 <= most:
                return False
        return self.predictor.is_possible(added.effect, added.targets[0], values)

    def _promising(self, base: Explanation, rows: np.ndarray | None) -> list[Candidate]:
        """Candidates that, alone, would take off enough of what an explanation leaves over."""
        left, projection = self.room(base)
        if rows is None:
            rows = np.arange(left.shape[1])
        scale = self.white.scale(base.sse)
        result = []
        for candidate in self.fixed_candidates:
            taken = any(
                c.effect is candidate.effect and c.targets == candidate.targets
                for c in base.candidates
            )
            touches = np.intersect1d(candidate.signature.rows, rows).size > 0
            if (
                touches
                and not taken
                and self._fixed_gain(candidate, left, projection, scale) > 0.5 * self.threshold[1]
            ):
                result.append(candidate)
        coarse: dict[tuple[str, ...], list[tuple[float, type[JointTorqueEffect], int]]] = {
            group: [] for group in self.groups
        }
        for effect in self.joint_effects:
            taken = {joint for c in base.candidates if c.effect is effect for joint in c.targets}
            columns = self._grid(effect)[1]
            moments = [
                self._moments(columns[j], j, left, projection, scale)
                for j in range(len(self._joints))
            ]
            for group in self.groups:
                places = [self._joints.index(joint) for joint in group]
                if taken & set(group) or not np.intersect1d(places, rows).size:
                    continue
                gain = _gain(
                    effect, sum(moments[j][0] for j in places), sum(moments[j][1] for j in places)
                )
                coarse[group].append((float(gain.max()), effect, int(gain.argmax())))
        for group, found in coarse.items():
            # What the grid shows far behind the best does not catch up between its points.
            # (A share of measured torque seems to explain more than it does.)
            honest = (
                gain
                for gain, effect, _ in found
                if self._per_step or not self._takes_torque(effect)
            )
            least = max(0.5 * self.threshold[1], 0.4 * max(honest, default=0.0))
            for gain, effect, best in found:
                if gain > least:
                    result.append(self._best_on(effect, group, best, left, projection, scale))
        return result

    def _fixed_gain(
        self,
        candidate: Candidate,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
        scale: np.ndarray,
    ) -> float:
        """Drop of the sum of squares by a candidate that is no joint torque effect, roughly."""
        s = candidate.signature
        X = np.concatenate(
            [
                _project(s.values[:, k], projection.get(row)) / np.sqrt(scale[row])
                for k, row in enumerate(s.rows)
            ]
        )
        y = (left[:, s.rows] / np.sqrt(scale[s.rows])).T.ravel()
        right = (
            X.T @ y
            if not self._always
            else np.einsum("brp,br->p", s.values / scale[s.rows, None], left[:, s.rows])
        )
        return float(right @ np.linalg.lstsq(X.T @ X, right, rcond=1e-10)[0])

    def plain_friction(self) -> Explanation:
        """Coulomb and viscous friction and a bias in every joint, fitted together; what identification of inertia begins with."""
        explanation = self.explain([])
        for _ in range(_POLISHINGS):
            for effect in (CoulombViscousFriction, TorqueBias):
                for joint in self._joints:
                    others = [
                        c
                        for c in explanation.candidates
                        if (c.effect, c.targets) != (effect, (joint,))
                    ]
                    explanation = self.explain(
                        [*others, self._best_beside(self.explain(others), effect, joint)]
                    )
        return explanation

    def _best_beside(
        self, base: Explanation, effect: type[JointTorqueEffect], joint: str
    ) -> Candidate:
        """A joint torque effect with the nonlinear values that fit best beside an explanation."""
        left, projection = self.room(base)
        scale, row = self.white.scale(base.sse), self._joints.index(joint)
        gain = _gain(
            effect, *self._moments(self._grid(effect)[1][row], row, left, projection, scale)
        )
        return self._best_on(effect, (joint,), int(gain.argmax()), left, projection, scale)

    def _best_on(
        self,
        effect: type[JointTorqueEffect],
        group: tuple[str, ...],
        best: int,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
        scale: np.ndarray,
    ) -> Candidate:
        """A joint torque effect with the nonlinear values that fit best; found once for what is left in the group's rows."""
        places = [self._joints.index(joint) for joint in group]
        key = (effect.__name__, group, left[:, places].tobytes())
        if key not in self._found:
            nonlinear = self._narrowed(effect, places, best, left, projection, scale)
            self._found[key] = self.candidate(effect, group, nonlinear, left, projection)
        return self._found[key]

    @staticmethod
    def usual_values(effect: type[Effect]) -> np.ndarray:
        """Usual values of an effect's nonlinear parameters, (m,)."""
        return np.array(
            [
                _default(effect, name)
                for name, parameter in effect.parameters.items()
                if not parameter.linear
            ]
        )

    def candidate(
        self,
        effect: type[JointTorqueEffect],
        group: tuple[str, ...],
        nonlinear: np.ndarray,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
    ) -> Candidate:
        """A joint torque effect with nonlinear values, linearised about them."""
        places = np.array([self._joints.index(joint) for joint in group])
        columns = self._columns(effect, places, nonlinear[:, None])[..., 0]
        parameters = self.parameters(effect, group[0])
        names = [name for name, parameter in parameters.items() if not parameter.linear]
        has_linear = len(names) < len(parameters)
        amounts = np.ones(1)
        if has_linear:
            whitened = [self.white.whiten(j, columns[:, r]) for r, j in enumerate(places)]
            X = np.concatenate(
                [
                    _project(columns, projection.get(j))
                    for columns, j in zip(whitened, places, strict=True)
                ]
            )
            amounts = np.linalg.lstsq(X, left[:, places].T.ravel())[0]
            smallest = np.array([p.bounds[0] for p in parameters.values() if p.linear])
            if np.any(amounts < smallest):
                # A slope for an amount that cannot be would mimic just that.
                amounts = bounded_least_squares(X.T @ X, X.T @ left[:, places].T.ravel(), smallest)
        # Slopes with respect to the nonlinear parameters, for amounts that fit best.
        slopes = []
        for k in range(len(nonlinear)):
            step = 0.02 * nonlinear[k]
            moved = np.repeat(nonlinear[:, None], 2, axis=1)
            moved[k] += [-step, step]
            pair = self._columns(effect, places, moved)
            slopes.append((pair[..., 1] - pair[..., 0]) @ amounts / (2 * step))
        slope_columns = (
            np.stack(slopes, axis=2) if slopes else np.zeros((len(columns), len(places), 0))
        )
        # A weak belief in the plausible range keeps values that the data say nothing about from running away.
        ranges = [np.log(parameters[name].plausible) for name in names]
        belief = [
            1.0 / (0.25 * (high - low) * value) ** 2
            for (low, high), value in zip(ranges, nonlinear, strict=True)
        ]
        # Nonlinear parameters do not fall far below their plausible range.
        lows = 0.5 * np.array([parameters[name].plausible[0] for name in names])
        lowest = [parameters[name].bounds[0] for name in parameters if name not in names]
        lowest += np.maximum(-0.6 * nonlinear, np.minimum(lows - nonlinear, 0.0)).tolist()
        if has_linear:
            values = np.concatenate([columns, slope_columns], axis=2)
            raw = Signature(
                places,
                values,
                prior=np.array([0.0] * columns.shape[2] + belief),
                lowest=np.array(lowest),
            )
        else:
            raw = Signature(
                places,
                slope_columns,
                offset=columns[:, :, 0],
                prior=np.array(belief),
                lowest=np.array(lowest),
            )
        noisier = self._columns(effect, places, nonlinear[:, None], noisier=True)[..., 0] - columns
        signature = self.white.whiten_signature(raw)
        clean = self.white.whiten_signature(Signature(places, columns))
        spurious = self._spurious(clean, self.white.whiten_signature(Signature(places, noisier)))
        return Candidate(effect, group, parameters, nonlinear, signature, raw, spurious)

    def smallest_detectable(self, base: Explanation, effect: type[Effect]) -> dict[str, float]:
        """Size of an effect's first parameter that would have been found beside an explanation, by target; infinite where none would.

        The size at which the effect's sum of squares reaches what its parameters must bring and cost.
        """
        sizes = self._sizes_that_reach(base, effect)
        return {
            target: size if size < _HOPELESS * self.largest_plausible(effect, target) else np.inf
            for target, size in sizes.items()
        }

    def _sizes_that_reach(self, base: Explanation, effect: type[Effect]) -> dict[str, float]:
        _, projection = self.room(base)
        scale = self.white.scale(base.sse)
        result = {}
        if not issubclass(effect, JointTorqueEffect):
            for candidate in (c for c in self.fixed_candidates if c.effect is effect):
                s = candidate.signature
                power = sum(
                    (_project(s.values[:, k, :1], projection.get(row)) ** 2).sum() / scale[row]
                    for k, row in enumerate(s.rows)
                )
                result[candidate.targets[0]] = float(
                    np.sqrt(
                        (
                            self._needed(s.values.shape[2])
                            + self.systematic(s.rows)
                            + candidate.spurious
                        )
                        / max(power, 1e-30)
                    )
                )
            return result
        points, columns = self._grid(effect)
        has_linear = any(parameter.linear for parameter in effect.parameters.values())
        for row, joint in enumerate(self._joints):
            here = points[..., row]
            usual = (
                int(
                    np.abs(np.log(here / self.usual_at(effect, joint)[:, None]))
                    .sum(axis=0)
                    .argmin()
                )
                if len(here)
                else 0
            )
            needed = self._needed(len(effect.parameters)) + self.systematic(np.array([row]))
            first = columns[row][:, 0]
            power = (_project(first, projection.get(row)) ** 2).sum(axis=0) / scale[row]
            if not np.all(effect.shows_within(self._travel[row], self.usual_at(effect, joint))):
                result[joint] = np.inf
            elif has_linear:
                result[joint] = float(np.sqrt(needed / max(power[usual], 1e-30)))
            else:
                # Sizes in the order of the grid, from weak to strong.
                strong = power > needed
                order = np.argsort(power)
                enough = np.flatnonzero(strong[order])
                result[joint] = (
                    _crossing(here[0][order], power[order], needed) if len(enough) else np.inf
                )
        return result

    def separation(
        self,
        effect: type[Effect],
        targets: Sequence[str],
        values: Mapping[str, float],
        rival: type[Effect],
    ) -> float:
        """How much of what an effect would do here a rival could not mimic: a sum of squares in units of noise.

        Args:
            values: of the effect's parameters.
        """
        signal = np.zeros_like(self.white.y)
        names = effect.parameters
        nonlinear = np.array(
            [values[name] for name, parameter in names.items() if not parameter.linear]
        )
        amounts = np.array(
            [values[name] for name, parameter in names.items() if parameter.linear] or [1.0]
        )
        for target in targets:
            raw = self.predictor.signature(effect, target, nonlinear)
            whitened = self.white.whiten_signature(raw)
            signal[:, whitened.rows] += whitened.values @ amounts
        scale = np.ones(signal.shape[1])
        if issubclass(rival, JointTorqueEffect):
            left = 0.0
            columns = self._grid(rival)[1]
            for row, joint in enumerate(self._joints):
                power = float((signal[:, row] ** 2).sum())
                if joint in targets and power > 0:
                    power -= float(
                        _gain(rival, *self._moments(columns[row], row, signal, {}, scale)).max()
                    )
                left += power
            return left + float((signal[:, len(self._joints) :] ** 2).sum())
        total = float((signal**2).sum())
        return total - max(
            (
                self._fixed_gain(c, signal, {}, scale)
                for c in self.fixed_candidates
                if c.effect is rival
            ),
            default=0.0,
        )

    def _needed(self, parameters: int) -> float:
        return float(self.threshold[min(12, parameters)] + (_COMPLEXITY + 1) * parameters)

    def consistent(self, explanation: Explanation) -> tuple[Explanation, IdentifiedInertia | None]:
        """An explanation whose bodies some distribution of mass has, and what it says of their inertia.

        Nonlinear parameters are moved to where they fit, and held there.
        """
        if self.inertia is None:
            return explanation, None
        for _ in range(_POLISHINGS):
            explanation = self.polished(explanation)
        signatures = [
            *(c.signature for c in explanation.candidates),
            self.white.whiten_signature(self.inertia.signature()),
        ]
        sizes = [s.values.shape[2] for s in signatures]
        weight = 1.0 / np.sqrt(self.white.scale(explanation.sse))
        X, y = np.zeros((*self.white.y.shape, sum(sizes))), self.white.y.copy()
        prior, lowest, free = (
            np.zeros(sum(sizes)),
            np.full(sum(sizes), -np.inf),
            np.ones(sum(sizes), dtype=bool),
        )
        stops = np.cumsum(sizes)
        for s, start, stop in zip(signatures, stops - sizes, stops, strict=True):
            X[:, s.rows, start:stop], prior[start:stop], lowest[start:stop] = (
                s.values,
                s.prior,
                s.lowest,
            )
            y[:, s.rows] -= s.offset
        for candidate, stop in zip(explanation.candidates, stops, strict=False):
            if issubclass(candidate.effect, JointTorqueEffect):
                free[stop - len(candidate.nonlinear) : stop] = False
        bodies = len(self.inertia.model)
        of_free = (X * weight[:, None]).reshape(-1, sum(sizes))[:, free]
        others, z = consistent_parameters(
            of_free, (y * weight).ravel(), prior[free], lowest[free][:-bodies], self.inertia.own
        )
        parameters = np.zeros(sum(sizes))
        parameters[free] = np.concatenate([others, z])
        sse = ((y - X @ parameters) ** 2).sum(axis=0) * self._torque_factor(
            explanation.candidates, parameters
        )
        fit = replace(
            explanation.fit,
            parameters=np.concatenate([parameters[:-bodies], self._directions.T @ z]),
            sse=sse,
        )
        identified = identified_inertia(
            self.inertia, self.white, explanation.fit, z, self._directions
        )
        return replace(explanation, fit=fit, sse=sse), identified

    def polished(self, explanation: Explanation) -> Explanation:
        """An explanation made linear about the values that its fit found."""
        moved, start = [], 0
        for candidate in explanation.candidates:
            size, m = candidate.signature.values.shape[2], len(candidate.nonlinear)
            shift = explanation.fit.parameters[start + size - m : start + size]
            start += size
            if not issubclass(candidate.effect, JointTorqueEffect):
                values = explanation.fit.parameters[start - size : start]
                try:
                    raw = self.predictor.signature_near(
                        candidate.effect,
                        candidate.targets[0],
                        values,
                        candidate.nonlinear,
                        candidate.raw,
                    )
                except InputError:
                    # No body has these values.
                    return explanation
                moved.append(
                    replace(candidate, raw=raw, signature=self.white.whiten_signature(raw))
                )
                continue
            if m == 0:
                moved.append(candidate)
                continue
            rest = self.explain([c for c in explanation.candidates if c is not candidate])
            ranges = np.array(
                [candidate.parameters[name].plausible for name in candidate.nonlinear_names]
            )
            # The slopes hold nearby.
            near = np.clip(
                candidate.nonlinear + shift, 0.6 * candidate.nonlinear, 1.6 * candidate.nonlinear
            )
            nonlinear = np.clip(near, 0.5 * ranges[:, 0], 2.0 * ranges[:, 1])
            moved.append(
                self.candidate(candidate.effect, candidate.targets, nonlinear, *self.room(rest))
            )
        polished = self.explain(moved)
        return polished if polished.deviance <= explanation.deviance + _COMPLEXITY else explanation

    def leftover(self, base: Explanation) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Whitened residual after an explanation, (B, R), and by row an orthonormal basis of the columns it has there."""
        left, by_row = self.white.y.copy(), {}
        start = 0
        for s in self._signatures(base):
            stop = start + s.values.shape[2]
            left[:, s.rows] -= s.values @ base.fit.parameters[start:stop] + s.offset
            for k, row in enumerate(s.rows):
                by_row.setdefault(row, []).append(s.values[:, k])
            start = stop
        return left, {
            row: np.linalg.qr(np.concatenate(columns, axis=1))[0] for row, columns in by_row.items()
        }

    def added(self, explanation: Explanation) -> tuple[Explanation, WhitenedResidual, np.ndarray]:
        """An explanation when its inertia and sensor effects are in the model, where it has any; the residual that is measured by; and
        what is left of it, whitened, (B, R).

        An impact shows a heavy foot's mass only if accelerations are not smoothed, noise grows with the masses, and which soles stand is
        seen when the forces are set right.
        """
        if self.inertia is not None or not any(
            issubclass(c.effect, InertiaEffect | SensorEffect) for c in explanation.candidates
        ):
            return explanation, self.white, self.leftover(explanation)[0]
        scenario = self.predictor.scenario
        found = {f"_found_{k}": effect for k, effect in enumerate(explanation.effects)}
        believed = replace(scenario.believed, effects=scenario.believed.effects | found)
        white = WhitenedResidual(
            Predictor(replace(scenario, model=believed), self.predictor.log).residual
        )
        # As many squares as before; what is held out exceeds them by as much as it did.
        share = self.white.count / np.maximum(white.count, 1)
        sse = (
            white.sse
            * share
            * self._torque_factor(explanation.candidates, explanation.fit.parameters)
        )
        return (
            replace(
                explanation, sse=sse, held_out_sse=sse + explanation.held_out_sse - explanation.sse
            ),
            white,
            white.y,
        )

    def _signatures(self, explanation: Explanation) -> list[Signature]:
        """Whitened, in the order of the explanation's parameters."""
        return [
            *(c.signature for c in explanation.candidates),
            *(self._always if explanation.fit is not None else []),
        ]

    def room(self, base: Explanation) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """What further effects could explain: as `leftover`; columns of inertia however tie all rows together.

        With an orthonormal basis Q of all columns, rows one below the other, new columns x in one row keep x^T (1 - Q_r Q_r^T) x of their
        sum of squares, Q_r being the row's part of Q. In place of a row's basis stands the matrix B with (1 - B B^T)^2 = 1 - Q_r Q_r^T.
        """
        left, by_row = self.leftover(base)
        signatures = self._signatures(base)
        if not self._always or not signatures:
            return left, by_row
        scale = np.sqrt(self.white.scale(base.sse))
        columns = []
        for s in signatures:
            of_all = np.zeros((*left.shape, s.values.shape[2]))
            of_all[:, s.rows] = s.values / scale[s.rows, None]
            columns.append(of_all)
        X = np.concatenate(columns, axis=2)
        lengths = np.linalg.norm(X, axis=(0, 1))
        X /= np.where(lengths > 0, lengths, 1.0)
        Q = np.linalg.qr(X.reshape(-1, X.shape[2]))[0].reshape(X.shape)
        left = left - scale * (Q @ np.einsum("brp,br->p", Q, left / scale))
        for row in range(left.shape[1]):
            U, s, _ = np.linalg.svd(Q[:, row], full_matrices=False)
            by_row[row] = U * np.sqrt(1.0 - np.sqrt(np.clip(1.0 - s**2, 0.0, 1.0)))
        return left, by_row

    def _grid(self, effect: type[JointTorqueEffect]) -> tuple[np.ndarray, list[np.ndarray]]:
        """First grid of an effect's nonlinear values for each joint, (m, G, n), and its whitened columns, (B, p, G) for each joint."""
        if effect.__name__ not in self._grids:
            searched = [
                parameter for parameter in effect.parameters.values() if not parameter.linear
            ]
            most = {0: 1, 1: 1000, 2: 5}.get(len(searched), 3)
            axes = [
                np.geomspace(*parameter.plausible, min(most, parameter.grid))
                for parameter in searched
            ]
            points = (
                np.array(list(itertools.product(*axes))).T.reshape(len(searched), -1)
                if searched
                else np.zeros((0, 1))
            )
            points = (
                points[:, :, None]
                * np.stack([self._factors(effect, joint) for joint in self._joints], axis=1)[
                    :, None
                ]
            )
            if effect.__name__ not in self._raw_grids:
                self._raw_grids[effect.__name__] = (
                    points,
                    self._columns(effect, np.arange(len(self._joints)), points),
                )
            columns = self._raw_grids[effect.__name__][1]
            self._grids[effect.__name__] = (
                points,
                [self.white.whiten(j, columns[:, j]) for j in range(len(self._joints))],
            )
        return self._grids[effect.__name__]

    def _factors(self, effect: type[Effect], target: str) -> np.ndarray:
        """What values of the nonlinear parameters at a revolute joint are multiplied with for a target, shape (m,)."""
        prismatic = self._unit.get(target) == "N"
        return np.array(
            [
                p.lever_factor if prismatic else 1.0
                for p in effect.parameters.values()
                if not p.linear
            ]
        )

    def usual_at(self, effect: type[Effect], target: str) -> np.ndarray:
        """Usual values of the nonlinear parameters in the units of a target, (m,)."""
        return self.usual_values(effect) * self._factors(effect, target)

    def _columns(
        self,
        effect: type[JointTorqueEffect],
        places: np.ndarray,
        nonlinear: np.ndarray,
        *,
        noisier: bool = False,
    ) -> np.ndarray:
        """Columns for G sets of nonlinear values, (m, G) or (m, G, r), shape (B, r, p, G); see `Predictor.joint_columns`."""
        sets = (
            nonlinear
            if nonlinear.ndim == 3
            else np.repeat(nonlinear[:, :, None], len(places), axis=2)
        )
        # From (p, G, B, r).
        return np.transpose(
            self.predictor.joint_columns(effect, sets, places, noisier=noisier), (2, 3, 0, 1)
        )

    def _moments(
        self,
        columns: np.ndarray,
        row: int,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
        scale: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gram matrices (G, p, p), right sides (G, p) of a row's columns (B, p, G)."""
        X = _project(columns.reshape(len(columns), -1), projection.get(row)).reshape(columns.shape)
        # Beside inertia, what is left is orthogonal to the columns of an explanation in all rows together, not in each.
        against = columns if self._always else X
        return np.einsum("bpg,bqg->gpq", X, X, optimize=True) / scale[row], np.einsum(
            "bpg,b->gp", against, left[:, row]
        ) / scale[row]

    def _narrowed(
        self,
        effect: type[JointTorqueEffect],
        places: Sequence[int],
        best: int,
        left: np.ndarray,
        projection: dict[int, np.ndarray],
        scale: np.ndarray,
    ) -> np.ndarray:
        """Nonlinear values between the grid's points that fit best, shape (m,)."""
        points = self._grid(effect)[0][..., places[0]]
        chosen = points[:, best].copy()
        ranges = [
            p.plausible
            for p in self.parameters(effect, self._joints[places[0]]).values()
            if not p.linear
        ]
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
                columns = self._columns(effect, np.array(places), trial)
                whitened = [self.white.whiten(j, columns[:, r]) for r, j in enumerate(places)]
                moments = [
                    self._moments(X, j, left, projection, scale)
                    for X, j in zip(whitened, places, strict=True)
                ]
                gain = _gain(effect, sum(m[0] for m in moments), sum(m[1] for m in moments))
                chosen[k] = trial[k, int(gain.argmax())]
                steps[k] *= 2.0 / (_POINTS - 1)
        return chosen


@cache
def takes_command(effect: type[Effect], *, load_too: bool) -> bool:
    """Does what a joint effect takes depend on the commanded torque, or on the load?"""
    if not issubclass(effect, JointTorqueEffect):
        return False
    time = np.arange(10.0)[:, None]
    motion = JointMotion(
        velocity=np.sin(time),
        position=np.cos(time),
        command=np.exp(0.1 * time),
        time=time,
        time_step=1e-3,
    )
    nonlinear = Search.usual_values(effect)[:, None]
    motion = motion._replace(load=motion.command)
    larger = motion._replace(
        command=100 * motion.command, load=(100 if load_too else 1) * motion.load
    )
    columns = (basis_over_time(effect, one, nonlinear) for one in (motion, larger))
    return not np.array_equal(*columns)


def _gain(effect: type[Effect], gram: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Drop of the sum of squares for each set of nonlinear values, shape (G,)."""
    if not any(parameter.linear for parameter in effect.parameters.values()):
        return 2 * right[:, 0] - gram[:, 0, 0]
    if right.shape[1] == 1:
        parameter = next(p for p in effect.parameters.values() if p.linear)
        theta = np.divide(
            right[:, 0], gram[:, 0, 0], out=np.zeros(len(right)), where=gram[:, 0, 0] > 1e-12
        )
        theta = np.clip(theta, *parameter.bounds)
        return 2 * theta * right[:, 0] - theta**2 * gram[:, 0, 0]
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(
        gram.shape[1]
    ) + 1e-12 * np.eye(gram.shape[1])
    return np.einsum("gp,gp->g", right, np.linalg.solve(gram + ridge, right[:, :, None])[:, :, 0])


def _project(X: np.ndarray, Q: np.ndarray | None) -> np.ndarray:
    return X if Q is None else X - Q @ (Q.T @ X)


def _crossing(sizes: np.ndarray, power: np.ndarray, needed: float) -> float:
    """Size at which increasing power reaches what is needed, interpolated in logarithms."""
    first = int(np.argmax(power > needed))
    if first == 0:
        # Small effects grow in proportion to their size; a limit is the weaker the larger it is.
        return (
            float(sizes[0] * np.sqrt(needed / power[0]))
            if sizes[0] < sizes[-1]
            else float(sizes[0])
        )
    low, high = np.log(np.maximum(power[first - 1 : first + 1], 1e-30))
    share = (np.log(needed) - low) / (high - low)
    return float(np.exp((1 - share) * np.log(sizes[first - 1]) + share * np.log(sizes[first])))


def _default(effect: type[Effect], name: str) -> float:
    """A usual value of a nonlinear parameter: its default, or the middle of its plausible range."""
    value = getattr(effect(), name)
    if isinstance(value, dict):
        value = value.get("all", np.sqrt(np.prod(effect.parameters[name].plausible)))
    return float(value)
