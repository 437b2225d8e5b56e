"""Parsimony: the smallest explanation that held-out data does not speak against.

A search adds what improves an explanation; what it added first may have become needless later, and
chance and errors of the model make some of it look useful. So every member has to pay once more,
beside all others; laws give way to simpler ones that they contain; and joints that agree share
values. A law that no joint proves alone may be proven by several together.

Held-out data are no independent samples where what is left is correlated in time: improvements are
divided by the number of blocks that count as one, see `blocks_per_sample`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.fft import next_fast_len
from scipy.stats import chi2
from scipy.stats import f as fisher
from scipy.stats import t as student

from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.fits import COMPLEXITY, FALSE_ALARM, MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.proposals import CATCHES_UP, Proposals
from fbse_drake.discrepancy.diagnosis.refinement import beside_model, converged, polished
from fbse_drake.discrepancy.diagnosis.selection import (
    MISFIT,
    best_additions,
    is_shown,
    is_significant,
)
from fbse_drake.discrepancy.diagnosis.spread import recordings
from fbse_drake.discrepancy.identification.regression import Signature
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.effects.joint_torque import JointTorqueEffect, Reduction

# Level of the region of confidence that must not contain "no effect".
_CONFIDENCE = 0.95
# Intervals are wide where few stretches bear on a parameter. A held-out gain of so many times what
# is required speaks for itself, unless it leaves more unexplained than it takes: of a row that
# nobody explains any law takes some.
_PLAIN = 3.0
# Share of the upper end of a range from which on a value counts as at its end.
_AT_THE_END = 0.98
# A finding takes off a row at least this share of what then is left there beyond the noise: what
# explains a large rest would also change what is small beside it.
_LEAST_OF_REST = 0.1
# A row is worse for a member if its held-out error rises by more than this share: a body that is
# heavier brings the noise of its acceleration, also where its mass hardly shows.
_WORSE = 0.01
# What a smaller law is without is a small part of what it has, if it is no more than this share.
_SMALL_PART = 0.1
# So many effects are tried beside the smaller laws that a larger one consists of.
_ADDITIONS = 3
# Share of the noise's power below which what is left is no noise but rounding: of exact sensors, or
# of two that round alike.
_ROUNDING = 1e-3


def frugal(proposals: Proposals, explanation: Explanation) -> Explanation:
    """The smallest explanation that is as good as this one, as far as held-out data can tell.

    Members that do not pay go, the least useful first; then laws are reduced, then joints pooled;
    until nothing changes.
    """
    # What is made smaller is moved to where it fits, which is no merit of what is smaller.
    explanation = converged(proposals.fits, explanation)
    judge = Judge(proposals.fits, explanation)
    while True:
        proposals.fits.dictionary.progress("looking for a smaller explanation")
        smaller = next(_smaller(proposals, judge, explanation), None)
        if smaller is None:
            return explanation
        explanation = converged(proposals.fits, smaller)
        judge = judge.after(explanation)


def without_stand_ins(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation without members that bring nothing when the others' inertia, geometry and
    sensor effects are in the model.

    Linearised, those leave something where accelerations are large, as of impacts, that looks like
    a law of its own.
    """
    found = beside_model(fits, explanation)
    if found is None:
        return explanation
    inside, moved = found
    kept = list(moved.values())
    while True:
        whole = inside.explain(kept)
        without = {c: inside.explain([o for o in kept if o is not c]) for c in kept}
        idle = [c for c in kept if not is_significant(inside, without[c], whole, c)]
        if not idle:
            break
        kept.remove(min(idle, key=lambda c: without[c].deviance))
    if len(kept) == len(moved):
        return explanation
    return fits.explain([c for c in explanation.candidates if c not in moved or moved[c] in kept])


def blocks_per_sample(scores: np.ndarray) -> np.ndarray:
    """How many blocks of a row count as one independent sample, not less than 1, shape (R,).

    The integrated autocorrelation time, over lags as long as sums of adjacent pairs are positive
    (Geyer 1992, initial positive sequence).

    Args:
        scores: columns times what is left, 0 where nothing is known, (B, R). Of slow columns they
            are correlated as what is left is; columns that change sign meanwhile are surer.
    """
    size = len(scores)
    padded = next_fast_len(2 * size, real=True)
    power = np.abs(np.fft.rfft(scores, padded, axis=0)) ** 2
    products = np.fft.irfft(power, padded, axis=0)[: size - size % 2]
    correlation = np.divide(
        products, products[0], out=np.zeros_like(products), where=products[0] > 0
    )
    # Lags 0 and 1, 2 and 3, ...
    pairs = correlation.reshape(len(correlation) // 2, 2, -1).sum(axis=1)
    positive = np.logical_and.accumulate(pairs > 0, axis=0)
    return np.maximum(2 * np.where(positive, pairs, 0.0).sum(axis=0) - 1.0, 1.0)


def _smaller(
    proposals: Proposals, judge: "Judge", explanation: Explanation
) -> Iterator[Explanation]:
    """Smaller explanations that are as good, or without what does not pay, the first to be taken
    first."""
    fits = proposals.fits
    without = {
        member: fits.explain([c for c in explanation.candidates if c is not member])
        for member in explanation.candidates
    }
    pays = cache(lambda member: judge.pays(without[member], explanation, member))
    by_gain = sorted(without, key=lambda c: judge.gain(without[c], explanation))
    for member in (c for c in by_gain if not pays(c)):
        alike = [c for c in by_gain if _is_one_law(c, member) and not pays(c)]
        if len(alike) < 2 or not judge.pay_together(explanation, alike, without):
            # A law may be none that can be, and a simpler one that it contains be there.
            yield from _simpler(proposals, judge, explanation, member)
            yield from _at_least(proposals, judge, explanation, member, without[member])
            yield without[member]
    explained = judge.explained(explanation)
    for member in by_gain:
        rows = member.signature.rows
        taken = (without[member].held_out_sse - explanation.held_out_sse)[rows]
        # Where there was next to nothing, any law explains the most of it.
        if not explained[rows[taken >= _LEAST_OF_REST * taken.max()]].any():
            yield without[member]
    yield from _on_fewer_targets(proposals, judge, explanation)
    yield from _reduced(proposals, judge, explanation)
    yield from _pooled(proposals, judge, explanation)


class Judge:
    """What members of an explanation bring, in effectively independent samples."""

    def __init__(self, fits: Fits, explanation: Explanation):
        """Measures what the best explanation leaves: what others leave is no noise."""
        self._fits, self._left, self._best = fits, fits.leftover(explanation), explanation.deviance
        parts = list(recordings(fits.dictionary.predictor.motion).values())
        self._recordings = parts if len(parts) > 1 else []

    def after(self, explanation: Explanation) -> "Judge":
        """One that knows another explanation as well."""
        is_better = explanation.deviance < self._best - MARGIN
        return Judge(self._fits, explanation) if is_better else self

    def drop_by_row(self, base: Explanation, wider: Explanation) -> np.ndarray:
        """Drop of the held-out deviance in each row, as if blocks were independent, (R,)."""
        deviance = self._fits.white.deviance_by_row
        return deviance(base.held_out_sse) - deviance(wider.held_out_sse)

    def gain_by_row(self, base: Explanation, wider: Explanation) -> np.ndarray:
        """The same in effectively independent samples, (R,)."""
        explained = self._fits.leftover(base) - self._fits.leftover(wider)
        gain = self.drop_by_row(base, wider)
        changed = explained.any(axis=0)
        scores = explained[:, changed] * self._left[:, changed]
        # That recordings differ is their spread, and no correlation in time.
        for inside in self._recordings:
            known = scores[inside] != 0
            mean = scores[inside].sum(axis=0) / np.maximum(known.sum(axis=0), 1)
            scores[inside] -= np.where(known, mean, 0.0)
        # What is left far below the noise is rounding, whose correlation tells nothing of it.
        count = np.maximum(self._fits.white.count[changed], 1)
        is_noise = (self._left[:, changed] ** 2).sum(axis=0) > _ROUNDING * count
        gain[changed] /= np.where(is_noise, blocks_per_sample(scores), 1.0)
        return gain

    def gain(self, base: Explanation, wider: Explanation) -> float:
        """The same in all rows, without what the parameters cost."""
        more = _size(wider) - _size(base)
        return float(self.gain_by_row(base, wider).sum()) - COMPLEXITY * more

    def independent_share(self, base: Explanation, wider: Explanation) -> float:
        """How much of a drop of the deviance counts, for blocks are correlated, at most 1."""
        drop, gain = (f(base, wider).sum() for f in (self.drop_by_row, self.gain_by_row))
        return min(1.0, float(gain / drop)) if min(drop, gain) > 0 else 1.0

    def least_share(self, rows: np.ndarray) -> float:
        """The same of any drop in some rows, at least: as if what explains it were constant."""
        return float(1.0 / blocks_per_sample(self._left[:, rows]).max())

    def pays(self, rest: Explanation, whole: Explanation, member: Candidate) -> bool:
        """Is a member worth its parameters, is it more than nothing, and does it worsen no row?"""
        fits = self._fits
        if fits.dictionary.inertia is not None and member.effect is CoulombViscousFriction:
            # Every joint has it: what identification begins with needs no proof against chance.
            again = fits.explain([*rest.candidates, member])
            return is_shown(fits, member) and is_significant(fits, rest, again, member)
        return self._are_proven(rest, whole, [member]) and self._is_sound(rest, whole, member)

    def all_pay(
        self, whole: Explanation, laws: Sequence[type[Effect]], targets: tuple[str, ...]
    ) -> bool:
        """Is each of these laws in some joints worth its parameters?"""
        return all(
            self.pays(self._fits.explain([c for c in whole.candidates if c is not m]), whole, m)
            for m in whole.candidates
            if m.effect in laws and set(m.targets) & set(targets)
        )

    def pay_together(
        self,
        whole: Explanation,
        members: Sequence[Candidate],
        without: Mapping[Candidate, Explanation],
    ) -> bool:
        """Do members that are one law in several joints pay as one, where none does alone?

        Drives of one kind have the same laws: that they have this one is one statement, with as
        many parameters as there are values, and is judged by what all these rows gain. In each of
        them it then has to earn what its parameters cost.

        Args:
            without: explanations without each member.
        """
        rest = self._fits.explain([c for c in whole.candidates if c not in members])
        return self._are_proven(rest, whole, members) and all(
            self.gain(without[member], whole) > 0 and self._is_sound(without[member], whole, member)
            for member in members
        )

    def _are_proven(
        self, rest: Explanation, whole: Explanation, members: Sequence[Candidate]
    ) -> bool:
        """Do members together bring more than chance, and are they more than nothing?

        Args:
            rest: the explanation without them.
        """
        gain = self.gain(rest, whole)
        required = self._fits.needed_drop(sum(c.signature.parameters for c in members))
        plain = gain >= _PLAIN * required and all(
            self._stands_out(rest, whole, member.signature.rows, 1.0)
            and not _is_repeated(rest, member)
            for member in members
        )
        return gain >= required and (plain or are_more_than_nothing(whole, members))

    def _is_sound(self, rest: Explanation, whole: Explanation, member: Candidate) -> bool:
        """Does a member worsen no row, stand out in one, and have values that can be?"""
        fits, rows = self._fits, member.signature.rows
        worse = self.gain_by_row(rest, whole) < -MARGIN
        worse &= whole.held_out_sse > (1 + _WORSE) ** 2 * rest.held_out_sse
        return (
            not worse[rows].any()
            and self._stands_out(rest, whole, rows, _LEAST_OF_REST)
            and not _is_beyond_its_range(member)
            and _is_itself(fits.dictionary, whole, member)
            and self._is_all_of_it(rest, whole, member)
            and is_shown(fits, whole.as_fitted(member))
            and is_significant(fits, rest, fits.explain([*rest.candidates, member]), member)
        )

    def _is_all_of_it(self, rest: Explanation, whole: Explanation, member: Candidate) -> bool:
        """Does a member that has no amount, which so claims how much there is, leave none of it?

        Beside a model that is not exact any such law takes some of what is left, as a limit does
        of a spike while the command is large. If the log asks for another multiple of the law, not
        by chance, and that explains more than a small part of what the law does, it is not it.
        """
        multiple = _with_amount(member)
        if multiple is None:
            return True
        others = [c for c in whole.candidates if c is not member]
        freed = self._fits.explain([*others, multiple])
        by_law, by_multiple = (
            float((a.held_out_sse - b.held_out_sse)[member.signature.rows].sum())
            for a, b in ((rest, whole), (whole, freed))
        )
        return by_multiple < _LEAST_OF_REST * by_law or self.is_as_good(whole, freed)

    def _stands_out(
        self, rest: Explanation, whole: Explanation, rows: np.ndarray, share: float
    ) -> bool:
        """Is what a member takes off any of its rows this share of what nobody explains there?"""
        taken = (rest.held_out_sse - whole.held_out_sse)[rows]
        left = (whole.held_out_sse - self._fits.white.count)[rows]
        return bool(np.any((taken > 0) & (taken >= share * left)))

    def explained(self, explanation: Explanation) -> np.ndarray:
        """Of which rows do the members that act on them explain at least half, beyond the noise,
        (R,)?

        Of a row that stays a riddle any law takes some: what takes less than it leaves is no name
        for it.
        """
        fits, members = self._fits, explanation.candidates
        result = np.ones(len(fits.white.count), dtype=bool)
        for row in np.unique(np.concatenate([[], *(c.signature.rows for c in members)])).astype(
            int
        ):
            rest = fits.explain([c for c in members if row not in c.signature.rows])
            left = explanation.held_out_sse[row]
            result[row] = rest.held_out_sse[row] - left >= left - fits.white.count[row]
        return result

    def is_as_good(self, smaller: Explanation, explanation: Explanation) -> bool:
        """May chance have brought what an explanation has more than one with fewer parameters?

        One comparison, and not the best of many: its threshold is that of a single test.
        """
        more = _size(explanation) - _size(smaller)
        least = float(chi2.isf(FALSE_ALARM, more)) if more > 0 else MARGIN
        rows = self.gain_by_row(smaller, explanation) - COMPLEXITY * more
        return self.gain(smaller, explanation) < least and rows.max() < least

    def is_nearly_as_good(
        self, smaller: Explanation, explanation: Explanation, member: Candidate
    ) -> bool:
        """Does a simpler law in a member's place take off all that it takes but for what a law of
        unknown shape may be wrong by?"""
        rest = self._fits.explain([c for c in explanation.candidates if c is not member])
        taken, lost = (
            float((worse.held_out_sse - explanation.held_out_sse)[member.signature.rows].sum())
            for worse in (rest, smaller)
        )
        return lost < MISFIT * taken


def needs_inertia(fits: Fits, explanation: Explanation, trusting: Fits) -> bool:
    """Does an explanation need inertia that is fitted along, or does that of the model do as well?

    Its parameters are fitted in every explanation, so that nothing else pays for what they explain;
    what they bring at last is a single comparison.

    Args:
        trusting: fits by the model's own inertia.
    """
    beside = Fits(fits.dictionary, trusting.white)
    wider, smaller = (polished(one, in_fits(one, explanation)) for one in (beside, trusting))
    left, left_by_model = beside.leftover(wider), trusting.leftover(smaller)
    deviance = trusting.white.deviance_by_row
    drop = deviance(smaller.held_out_sse) - deviance(wider.held_out_sse)
    gain = drop / blocks_per_sample((left_by_model - left) * left)
    more = fits.dictionary.directions.shape[1]
    return bool(gain.sum() - COMPLEXITY * more >= chi2.isf(FALSE_ALARM, more))


def in_fits(fits: Fits, explanation: Explanation) -> Explanation:
    """The members of an explanation, fitted otherwise."""
    return fits.explain(
        [replace(c, signature=fits.white.whiten_signature(c.raw)) for c in explanation.candidates]
    )


def _size(explanation: Explanation) -> int:
    return sum(c.signature.parameters for c in explanation.candidates)


def are_more_than_nothing(explanation: Explanation, members: Sequence[Candidate]) -> bool:
    """Does the interval of one of the members' amounts not hold zero, or their joint region
    (Hotelling's T squared)?

    Intervals are simultaneous: of several members each is wider (Bonferroni). Of an effect that has
    one parameter and no amount, the interval of that, if zero is neutral. (With several, that they
    are not all neutral is not said by intervals of a law made linear.)
    """
    at: list[int] = []
    parts = []
    for member in members:
        start, names = explanation.start(member), member.linear_names
        offset = np.zeros(len(names))
        if not names:
            if [member.parameters[name].neutral for name in member.nonlinear_names] != [0.0]:
                return True
            offset = member.nonlinear
        at += range(start, start + len(offset))
        parts.append(explanation.solved.parameters[start : start + len(offset)] + offset)
    values, spread = np.concatenate(parts), explanation.solved.spread
    deviation, freedom = spread.deviation[at], np.minimum(spread.freedom[at], 1e6)
    level = 1 - (1 - _CONFIDENCE) / len(members)
    if np.any(np.abs(values) > student.ppf((1 + level) / 2, freedom) * deviation):
        return True
    if not np.all(deviation > 0):
        return False
    # Units must not decide what counts as singular.
    covariance = spread.covariance[np.ix_(at, at)] / np.outer(deviation, deviation)
    scaled = values / deviation
    square = scaled @ np.linalg.pinv(covariance, hermitian=True) @ scaled
    return square > len(values) * fisher.ppf(_CONFIDENCE, len(values), freedom.min())


def _with_amount(member: Candidate) -> Candidate | None:
    """A joint torque law that has no amount with one, its last column; None for other members."""
    if member.has_linear or not issubclass(member.effect, JointTorqueEffect):
        return None

    def scaled(law: Signature) -> Signature:
        return replace(
            law,
            values=np.concatenate([law.values, np.asarray(law.offset)[..., None]], axis=2),
            prior=np.append(law.prior, 0.0),
            expected=np.append(law.expected, 0.0),
            steadying=np.append(law.steadying, 0.0),
            lowest=np.append(law.lowest, -np.inf),
            highest=np.append(law.highest, np.inf),
        )

    return replace(member, signature=scaled(member.signature), source=lambda: scaled(member.raw))


def _is_one_law(member: Candidate, other: Candidate) -> bool:
    """Are two members one law, in joints whose drives are of one kind?"""
    units = [{p.unit for p in c.parameters.values()} for c in (member, other)]
    return (
        issubclass(member.effect, JointTorqueEffect)
        and member.effect is other.effect
        and units[0] == units[1]
    )


def _is_repeated(rest: Explanation, member: Candidate) -> bool:
    """Is there a law for the same joint that contains a member's, or that it contains?"""

    def contains(effect: type[Effect], other: type[Effect]) -> bool:
        return issubclass(effect, JointTorqueEffect) and any(
            other in reduction.effects for reduction in effect.reductions
        )

    return any(
        set(c.targets) & set(member.targets)
        and (contains(c.effect, member.effect) or contains(member.effect, c.effect))
        for c in rest.candidates
    )


def _is_beyond_its_range(member: Candidate) -> bool:
    """Is a parameter at the upper end of a range that it cannot leave, or below it? Then something
    else is there."""
    values = dict(zip(member.nonlinear_names, member.nonlinear, strict=True))
    ranges = ((values[name], p) for name, p in member.parameters.items() if name in values)
    return any(
        p.closed and not p.plausible[0] <= value / _AT_THE_END <= p.plausible[1]
        for value, p in ranges
    )


def _is_itself(dictionary: Dictionary, whole: Explanation, member: Candidate) -> bool:
    """See `JointTorqueEffect.is_itself`."""
    effect = member.effect
    if not issubclass(effect, JointTorqueEffect):
        return True
    joints = dictionary.predictor.joints_of(member.signature.rows)
    reached = float(dictionary.speed[joints].max())
    return effect.is_itself(whole.values(member)[0], reached)


def _on_fewer_targets(
    proposals: Proposals, judge: Judge, explanation: Explanation
) -> Iterator[Explanation]:
    """Without targets of a member whose held-out error the shared values raise, or where it brings
    nothing and at the values that were found is nothing, or too small to matter."""
    dictionary = proposals.fits.dictionary
    tolerance = dictionary.predictor.scenario.identify.tolerance
    for member in explanation.candidates:
        if len(member.targets) == 1 or not issubclass(member.effect, JointTorqueEffect):
            continue
        others = [c for c in explanation.candidates if c is not member]
        rest = proposals.fits.explain(others)
        gain = judge.gain_by_row(rest, explanation)
        # Of a recorder all joints have what most of them show.
        is_small = dictionary.significance.shares(explanation, member) < tolerance
        matters = _acts(member.signature) & ~(is_small & (not member.effect.needs_sampled_torque))
        matter = member.signature.rows[matters]
        of_target = {t: dictionary.rows_of(member.effect, [t]) for t in member.targets}
        kept = tuple(
            t
            for t, rows in of_target.items()
            if gain[rows].sum() > (-MARGIN if np.isin(rows, matter).any() else MARGIN)
        )
        if kept and len(kept) < len(member.targets):
            yield proposals.beside(rest, member.effect, kept)


def _acts(law: Signature) -> np.ndarray:
    """In which of its rows a law does something, (r,)."""
    return law.values.any(axis=(0, 2)) | np.any(law.offset, axis=0)


def _reduced(proposals: Proposals, judge: Judge, explanation: Explanation) -> Iterator[Explanation]:
    """With simpler laws in the place of one that contains them, wherever it is: it is one law for
    all joints where it may be, for not every joint shows what it has. Where it brings less than its
    parameters cost, it is not."""
    for effect in dict.fromkeys(c.effect for c in explanation.candidates):
        keys = [c.key for c in explanation.candidates if c.effect is effect]
        smaller = explanation
        for key in keys:
            # Others may have been moved to where they fit.
            member = next(c for c in smaller.candidates if c.key == key)
            found = next(_simpler(proposals, judge.after(smaller), smaller, member), None)
            if found is None:
                break
            smaller = found
        else:
            yield smaller
        smaller = explanation
        for key in keys:
            member = next(c for c in smaller.candidates if c.key == key)
            needless = _simpler(proposals, judge.after(smaller), smaller, member, if_needless=True)
            smaller = next(needless, smaller)
        if smaller is not explanation:
            yield smaller


def _simpler(
    proposals: Proposals,
    judge: Judge,
    explanation: Explanation,
    member: Candidate,
    *,
    if_needless: bool = False,
) -> Iterator[Explanation]:
    """With the simplest laws in the place of a member that contains them and is no better; or with
    these and another effect, which explain more together with no more parameters.

    Args:
        if_needless: only where it brings less than its parameters cost.
    """
    if not issubclass(member.effect, JointTorqueEffect):
        return
    tried = set(proposals.fits.dictionary.effects)
    reductions = [
        reduction for reduction in member.effect.reductions if tried.issuperset(reduction.effects)
    ]

    @cache
    def reduced(k: int) -> Explanation:
        return _with_reduction(proposals, explanation, member, reductions[k])

    if not reductions:
        return
    # What is better and smaller comes before what is worse by no more than chance.
    yield from _with_another(proposals, judge, explanation, reduced(len(reductions) - 1), member)
    for k, reduction in enumerate(reductions):
        smaller = reduced(k)
        is_needless = smaller.deviance <= explanation.deviance or (
            _is_without(explanation, member, reduction)
            and judge.is_nearly_as_good(smaller, explanation, member)
        )
        is_smaller = is_needless or (not if_needless and judge.is_as_good(smaller, explanation))
        # What takes its place has to stay.
        if is_smaller and judge.all_pay(smaller, reduction.effects, member.targets):
            yield smaller


def _at_least(
    proposals: Proposals,
    judge: Judge,
    explanation: Explanation,
    member: Candidate,
    without: Explanation,
) -> Iterator[Explanation]:
    """With the largest laws in the place of a member that it contains and that pay, though it is
    better: more than nothing is known where it does not pay itself.

    Args:
        without: the explanation without it.
    """
    if not issubclass(member.effect, JointTorqueEffect):
        return
    tried = set(proposals.fits.dictionary.effects)
    for reduction in reversed(member.effect.reductions):
        if not tried.issuperset(reduction.effects):
            continue
        smaller = _with_reduction(proposals, explanation, member, reduction)
        pay = judge.all_pay(smaller, reduction.effects, member.targets)
        if pay and smaller.deviance < without.deviance - MARGIN:
            yield smaller


def _with_another(
    proposals: Proposals,
    judge: Judge,
    explanation: Explanation,
    smaller: Explanation,
    member: Candidate,
) -> Iterator[Explanation]:
    """With one more effect beside the laws that were put into a member's place, where it pays and
    the two explain more than the member with fewer parameters, or far more with as many."""
    fits, most = proposals.fits, len(explanation.solved.parameters)
    lost = max(0.0, smaller.deviance - explanation.deviance)
    largest = smaller.deviance - CATCHES_UP * lost
    wider = best_additions(proposals, smaller, member.signature.rows, largest)
    # The laws are where they fit without it.
    for found in [e for e in wider if len(e.solved.parameters) <= most][:_ADDITIONS]:
        better = converged(fits, found)
        margin = MARGIN if len(better.solved.parameters) == most else 0.0
        if better.deviance >= explanation.deviance - margin:
            continue
        key = found.candidates[-1].key
        (added,) = (c for c in better.candidates if c.key == key)
        rest = fits.explain([c for c in better.candidates if c is not added])
        # What is nothing of its kind beside it would be lost next.
        stays = all(is_shown(fits, better.as_fitted(c)) for c in better.candidates)
        if stays and judge.after(better).pays(rest, better, added):
            yield better


def with_smaller_law(
    proposals: Proposals, explanation: Explanation, member: Candidate
) -> Explanation | None:
    """With the best of the smaller laws that a member contains in its place; None if it contains
    none, or is but the sum of two."""
    tried, is_sum = set(proposals.fits.dictionary.effects), member.effect is CoulombViscousFriction
    if is_sum or not issubclass(member.effect, JointTorqueEffect):
        return None
    found = [
        _with_reduction(proposals, explanation, member, reduction)
        for reduction in member.effect.reductions
        if tried.issuperset(reduction.effects)
    ]
    return min(found, key=lambda e: e.deviance, default=None)


def _with_reduction(
    proposals: Proposals, explanation: Explanation, member: Candidate, reduction: Reduction
) -> Explanation:
    """With the laws of a reduction in a member's place: those whose values its joints share with
    others stay so, or they have values of their own, whichever is better."""
    shared = _shared(explanation, member, reduction)
    alone = [explanation, *_apart(proposals, explanation, member, shared)]
    found = (_with_laws(proposals, one, member, reduction.effects) for one in alone)
    return min(found, key=lambda e: e.deviance)


def _shared(explanation: Explanation, member: Candidate, reduction: Reduction) -> list[Candidate]:
    """Laws of a reduction whose values a member's joints share with others."""
    targets = set(member.targets)
    return [
        c
        for c in explanation.candidates
        if c.effect in reduction.effects and targets < set(c.targets)
    ]


def _apart(
    proposals: Proposals, explanation: Explanation, member: Candidate, shared: list[Candidate]
) -> Iterator[Explanation]:
    """With shared laws left to the other joints: what takes the member's place has values of its
    own."""
    if not shared:
        return
    result = proposals.fits.explain([c for c in explanation.candidates if c not in shared])
    for c in shared:
        assert issubclass(c.effect, JointTorqueEffect)
        others = tuple(t for t in c.targets if t not in member.targets)
        result = proposals.beside(result, c.effect, others)
    yield result


def _may_be_without(explanation: Explanation, member: Candidate, reduction: Reduction) -> bool:
    """Does nothing tell the amounts of a law that a reduction is without from zero?"""
    _, intervals = explanation.values(member)
    without = [name for name in member.linear_names if name in reduction.at]
    return bool(without) and all(intervals[n][0] <= 0.0 <= intervals[n][1] for n in without)


def _is_without(explanation: Explanation, member: Candidate, reduction: Reduction) -> bool:
    """The same; and are they a small part of the law's other amounts?"""
    values, _ = explanation.values(member)
    units = {name: member.parameters[name].unit for name in member.linear_names}
    without = [name for name in units if name in reduction.at]

    def small(name: str) -> float:
        kept = (o for o, unit in units.items() if o not in without and unit == units[name])
        return _SMALL_PART * max((abs(values[other]) for other in kept), default=0.0)

    return _may_be_without(explanation, member, reduction) and all(
        abs(values[name]) <= small(name) for name in without
    )


def _with_laws(
    proposals: Proposals,
    explanation: Explanation,
    member: Candidate,
    laws: Sequence[type[JointTorqueEffect]],
) -> Explanation:
    """With laws in the place of a member, for those of its targets that have them not yet."""
    fits, others = proposals.fits, [c for c in explanation.candidates if c is not member]
    missing = []
    for law in laws:
        there = {t for c in others if c.effect is law for t in c.targets}
        targets = tuple(t for t in member.targets if t not in there)
        missing += [(law, targets)] if targets else []
    result = fits.explain(others)
    # The others stay where they fit beside all of it: beside a part they would be moved far away.
    for law, targets in missing:
        result = proposals.beside(result, law, targets)
    result = converged(fits, result)
    # The first ones were fitted where the last ones lacked.
    for law, targets in missing[:-1]:
        rest = [c for c in result.candidates if c.key != (law, targets)]
        anew = converged(fits, proposals.beside(fits.explain(rest), law, targets))
        result = min(result, anew, key=lambda e: e.deviance)
    return result


def _pooled(proposals: Proposals, judge: Judge, explanation: Explanation) -> Iterator[Explanation]:
    """With one member for the same joint of all legs, in the place of one for each, wherever they
    agree."""
    fits, pooled = proposals.fits, explanation
    effects = dict.fromkeys(
        c.effect
        for c in explanation.candidates
        if len(c.targets) == 1 and issubclass(c.effect, JointTorqueEffect)
    )
    for group in fits.dictionary.groups:
        for effect in effects:
            keys = [(effect, (joint,)) for joint in group]
            members = [c for c in pooled.candidates if c.key in keys]
            if len(group) == 1 or len(members) < len(group):
                continue
            rest = fits.explain([c for c in pooled.candidates if c not in members])
            shared = converged(fits, proposals.beside(rest, effect, group))
            if judge.after(pooled).is_as_good(shared, pooled):
                pooled = shared
    if pooled is not explanation:
        yield pooled
