"""Selection of effects: which additions to an explanation are significant, and forward selection
among them."""

from collections.abc import Iterator, Sequence, Set

import numpy as np

from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation, Name
from fbse_drake.discrepancy.diagnosis.fits import COMPLEXITY, MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.proposals import LOOKING, Proposals
from fbse_drake.discrepancy.diagnosis.refinement import polished
from fbse_drake.discrepancy.identification.rounding import DOUBTFUL
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.inertia import BodyMass
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.effects.sensor import FootForceGain

# No explanation has more parts than this.
_MOST_EFFECTS = 16
# What an effect takes off a row may be wrong by this share, if its shape is not known but fitted
# (nonlinear parameters); so small a rest is no evidence of another effect where it is not known at
# which velocity within a step a law holds, nor of one that follows the torque.
MISFIT = 0.02
# A value may lie beyond the plausible range by this factor.
_IMPLAUSIBLE = 3.0
# Beyond that a law may take what its joint is given, if its relative deviation is less than this.
_KNOWN = 0.1
# Values that are held at the end of a range are off by this share of it.
_ROUNDING = 1e-9
# A law that levels off with speed shows that up to so many times the speed that its joint reaches.
_REACH = 2.0
# No more than so many standard deviations of what is believed of it beforehand, if anything is.
_DISBELIEVED = 3.0


def select(
    fits: Fits, barred: Set[Name] = frozenset()
) -> Iterator[tuple[list[Explanation], Proposals]]:
    """Explanations by forward selection, from none to the last that improves significantly.

    The residual is weighed anew with every addition.

    Args:
        barred: what is not tried.

    Yields:
        After every addition, before and after what was there already is checked beside it: all
        explanations so far, and the proposals for the last.
    """
    fits, nothing = fits.doubting(fits.explain([]))
    proposals, path = Proposals(fits, barred), [nothing]
    yield [*path], proposals
    if fits.dictionary.inertia is not None:
        fits, explanation = fits.doubting(_pruned(fits, proposals.plain_friction()))
        proposals = Proposals(fits, barred)
        path.append(explanation)
        yield [*path], proposals
    revised: Sequence[Candidate] = ()
    while len(path[-1].candidates) < _MOST_EFFECTS:
        base = path[-1]
        additions = best_additions(proposals, base)
        if not additions:
            break
        chosen = _spread(fits, additions)
        yield [*path, chosen], proposals
        chosen = _revise(proposals, chosen, revised)
        if chosen.deviance > base.deviance - MARGIN:
            yield [*path], proposals
            break
        weighed, explanation = fits.doubting(chosen)
        if weighed is not fits:
            fits, proposals = weighed, Proposals(weighed, barred)
        path.append(polished(fits, explanation))
        revised = path[-1].candidates
        yield [*path], proposals


def best_additions(
    proposals: Proposals,
    base: Explanation,
    rows: np.ndarray | None = None,
    most: float = np.inf,
    *,
    in_part: bool = False,
) -> list[Explanation]:
    """What one more candidate makes of an explanation, for every candidate that improves it
    significantly, best first.

    Joints or feet of all legs may be wrong together, and one alone look like something else: these
    are tried too.

    Args:
        rows: only candidates that change one of these; by default all.
        most: only explanations with a smaller deviance.
        in_part: also what the log shows too little of to be named, see `could_be`.
    """
    asked = (base, None if rows is None else rows.tobytes(), most, in_part)
    return proposals.additions.or_made(
        asked, lambda: _additions(proposals, base, rows, most, in_part=in_part)
    )


def _additions(
    proposals: Proposals,
    base: Explanation,
    rows: np.ndarray | None,
    most: float,
    *,
    in_part: bool,
) -> list[Explanation]:
    def added(*, behind: bool) -> list[Explanation]:
        promising = proposals.promising(
            base, rows, base.deviance - most, in_part=in_part, behind=behind
        )
        return _with_each(proposals, base, promising, most, in_part=in_part)

    # What is far behind in its joints may be there all the same, if nothing else is.
    found = added(behind=False) or added(behind=True)
    return sorted(found, key=lambda e: e.deviance)


def _with_each(
    proposals: Proposals,
    base: Explanation,
    promising: Sequence[Candidate],
    most: float,
    *,
    in_part: bool,
) -> list[Explanation]:
    """What each of these candidates makes of an explanation, of those that improve it
    significantly; see `best_additions`."""
    fits, found = proposals.fits, []
    tried = [
        *([candidate] for candidate in promising),
        *proposals.together(base, promising),
    ]
    for k, added in enumerate(tried):
        fits.dictionary.progress(LOOKING, 0.3 + 0.7 * k / len(tried))
        everything = [*base.candidates, *added]
        if _loses_scale(fits, everything) or _cancel(base.candidates, added):
            continue
        wider = fits.explain(everything)
        if wider.deviance >= most:
            continue
        without = (
            base if len(added) == 1 else fits.explain([c for c in everything if c is not member])
            for member in added
        )
        if all(
            (is_shown(fits, member) or (in_part and could_be(proposals, rest, wider, member)))
            and is_significant(fits, rest, wider, member)
            for rest, member in zip(without, added, strict=True)
        ):
            found.append(wider)
    return found


def single_guesses(proposals: Proposals, rows: np.ndarray) -> list[Explanation]:
    """What each candidate explains alone where nothing can be named, best first: how far a guess
    goes. Those that explain nothing of held-out data are left out.

    Args:
        rows: what counts is explained there.
    """
    proposals = proposals.unbarred
    fits = proposals.fits

    def left(explanation: Explanation) -> float:
        return float(fits.white.deviance_by_row(explanation.held_out_sse)[rows].sum())

    base = fits.explain([])
    tried = proposals.promising(base, rows, share=0.0)
    found = sorted((fits.explain([candidate]) for candidate in tried), key=left)
    return [e for e in found if left(e) < left(base) - COMPLEXITY * len(e.solved.parameters)]


def _loses_scale(fits: Fits, candidates: Sequence[Candidate]) -> bool:
    """Could everything be nothing? Without torques only the masses and the gains of the feet say
    how large forces are: if all of them are free, the smallest robot with the deafest feet explains
    every log."""
    names = fits.dictionary.predictor.robot.description
    gained = {side for c in candidates if c.effect is FootForceGain for side in c.targets}
    torques = any(fits.white.count[: len(names.joint_names)])
    return (
        bool(names.sides)
        and not torques
        and gained == set(names.sides)
        and any(c.effect is BodyMass for c in candidates)
    )


def _cancel(members: Sequence[Candidate], added: Sequence[Candidate]) -> bool:
    """Would effects undo what others do in the same place?"""
    return any(
        set(one.targets) & set(other.targets)
        and (one.effect in other.effect.opposites or other.effect in one.effect.opposites)
        for one in members
        for other in added
    )


def is_shown(fits: Fits, candidate: Candidate) -> bool:
    """Does the log show what a candidate is, so that it can be named?"""
    effect, dictionary = candidate.effect, fits.dictionary
    if not issubclass(effect, JointTorqueEffect):
        return True
    return _shows_within(fits, candidate) and any(
        dictionary.is_shown(effect, joint) for joint in candidate.targets
    )


def _shows_within(fits: Fits, candidate: Candidate) -> bool:
    """Does it act where the joints were? That others could have done the same is another
    question."""
    effect, dictionary = candidate.effect, fits.dictionary
    if not issubclass(effect, JointTorqueEffect):
        return True
    joints = dictionary.predictor.joints_of(candidate.signature.rows)
    reached, least = _REACH * float(dictionary.speed[joints].max()), dictionary.steps[joints].max()
    if effect.is_after_turns and not dictionary.per_step:
        # A torque that was recorded late does the same in this time.
        least = max(least, dictionary.turning[joints].max())

    def values(*units: str) -> np.ndarray:
        of = [candidate.parameters[name].unit in units for name in candidate.nonlinear_names]
        return candidate.nonlinear[of]

    # What is finer than the encoder's steps is not told from them.
    return bool(
        np.any(effect.shows_within(dictionary.travel[joints], candidate.nonlinear))
        and np.all(values("rad/s", "m/s") <= reached)
        and np.all(values("rad", "m") >= least)
    )


def could_be(proposals: Proposals, base: Explanation, wider: Explanation, added: Candidate) -> bool:
    """May a candidate be what is there, though the log does not show enough of it for a name?

    Args:
        base, wider: explanations without and with it.
    """
    return _shows_within(proposals.fits, added) or _shows_in_part(proposals, base, wider, added)


def _shows_in_part(
    proposals: Proposals, base: Explanation, wider: Explanation, added: Candidate
) -> bool:
    """Does the log show of a candidate at least that law which a small part of it looks like?

    It does if that law's own reductions do not explain as much: nobody calls a constant torque a
    piece of a wave.

    Args:
        base, wider: explanations without and with it.
    """
    fits, effect = proposals.fits, added.effect
    part = effect.in_part() if issubclass(effect, JointTorqueEffect) else None
    if part is None:
        return False
    if not _travel(fits, added).any():
        return False
    for reduction in part.reductions:
        simpler = base
        for law in reduction.effects:
            simpler = proposals.beside(simpler, law, added.targets)
        more = len(wider.solved.parameters) - len(simpler.solved.parameters)
        if simpler.deviance - wider.deviance < fits.threshold[min(12, max(1, more))]:
            return False
    return True


def _travel(fits: Fits, candidate: Candidate) -> np.ndarray:
    """Of the joints that a candidate acts in, (n,) [rad]."""
    return fits.dictionary.travel[fits.dictionary.predictor.joints_of(candidate.signature.rows)]


def is_significant(fits: Fits, base: Explanation, wider: Explanation, added: Candidate) -> bool:
    """Does a candidate bring more than chance to an explanation without it, with values that can
    be?"""
    gained, required = base.deviance - wider.deviance, fits.required(added)
    if gained < required:
        return False
    if gained < DOUBTFUL * required and gained < fits.feigned(added):
        return False
    if _may_be_misfit(fits, base, wider, added):
        return False
    start, is_law = wider.start(added), issubclass(added.effect, JointTorqueEffect)
    names = added.linear_names if added.has_linear else added.nonlinear_names
    offsets = np.zeros(len(names)) if added.has_linear else added.nonlinear
    part = slice(start, start + len(names))
    values = wider.solved.parameters[part] + offsets
    deviations, intervals = wider.solved.deviation[part], wider.solved.interval()[part]
    parameters = [added.parameters[name] for name in names]
    beliefs = np.array([parameter.belief for parameter in parameters])
    largest = np.array([max(map(abs, parameter.plausible)) for parameter in parameters])
    if is_disbelieved(values, beliefs, largest, deviations, intervals):
        return False
    for k, (parameter, value, widest, deviation, (least, most)) in enumerate(
        zip(parameters, values, largest, deviations, intervals, strict=True)
    ):
        if least <= parameter.everything <= most:
            # Where a joint needs next to no torque, any friction takes all that it is given.
            return False
        if least <= 0 <= most and np.isfinite(parameter.belief):
            # One of several components, which the log hardly shows.
            continue
        low, high = parameter.bounds
        if low <= value <= high and abs(value) <= widest:
            continue
        allowed = 3 * deviation
        if not is_law:
            # Masses, places and offsets have sizes that a bad fit does not widen.
            allowed = min(allowed, _IMPLAUSIBLE * widest)
        if value < low or value > high + 3 * deviation:
            return False
        if abs(value) > _IMPLAUSIBLE * widest + allowed:
            # Of what hardly moves a small torque is an enormous damping, or any other law.
            is_known = parameter.unit in ("Nm", "N") or deviation < _KNOWN * abs(value)
            if not (is_known and _is_carried(fits, wider, added)):
                return False
        # What is not told from nothing may not be implausible as well. Of a law that is not there
        # no shape would be told: whether it is, is asked with a known one.
        if abs(value) > (1 + _ROUNDING) * widest and least <= 0 <= most:
            shapes = len(added.nonlinear) if is_law and added.has_linear else 0
            kept = wider.solved.spread.if_known(slice(part.stop, part.stop + shapes), part)
            if abs(value) <= kept[k] * (most - least) / 2:
                return False
    return fits.dictionary.predictor.is_possible(added.effect, added.targets[0], values)


def _may_be_misfit(fits: Fits, base: Explanation, wider: Explanation, added: Candidate) -> bool:
    """May a candidate explain what laws of fitted shapes are wrong by?"""
    dictionary = fits.dictionary
    if not (dictionary.per_step or dictionary.follows_torque(added.effect, added.targets)):
        return False
    rows = added.signature.rows
    exact = fits.explain(
        [c for c in base.candidates if not c.nonlinear_names or _is_one_law_with(c, added)]
    )
    taken, gained = (
        float(np.maximum(a.sse[rows] - b.sse[rows], 0.0).sum())
        for a, b in ((exact, base), (base, wider))
    )
    if gained >= MISFIT * taken:
        return False
    # Between two encoders shapes are what they are.
    between = [row for row in rows if fits.white.residual.rows[row].kind == "transmission"]
    before, after = (
        fits.white.deviance_by_row(e.held_out_sse)[between].sum() for e in (base, wider)
    )
    return bool(before - after < fits.required(added))


def _is_one_law_with(member: Candidate, added: Candidate) -> bool:
    """Do two laws of a joint make up a larger one together? The shape of the one then leaves
    nothing that looks like the other."""
    return bool(set(member.targets) & set(added.targets)) and any(
        {member.effect, added.effect} <= set(reduction.effects)
        for law in library().values()
        if issubclass(law, JointTorqueEffect)
        for reduction in law.reductions
    )


def _is_carried(fits: Fits, explanation: Explanation, member: Candidate) -> bool:
    """Is what a member takes of joints' torques no more than they are given, however much that
    is?"""
    return (
        issubclass(member.effect, JointTorqueEffect)
        and fits.dictionary.significance.share(explanation, member) < 1.0
    )


def is_disbelieved(
    values: np.ndarray,
    beliefs: np.ndarray,
    plausible: np.ndarray,
    deviations: np.ndarray,
    intervals: np.ndarray,
) -> bool:
    """Are values larger than what is believed of them beforehand allows, however sure a fit is?

    Components with the same belief are a vector, which may be so long whatever its axes are. Of one
    that the log does not tell from nothing counts what is left of it beside the belief.

    Args:
        values, deviations: (p,).
        beliefs: standard deviations about 0, infinite where nothing is believed, (p,).
        plausible: the largest values that are plausible, and so are never too large, (p,).
        intervals: (p, 2).
    """
    counted, unsure = values.copy(), (intervals[:, 0] <= 0) & (intervals[:, 1] >= 0)
    for belief in np.unique(beliefs[np.isfinite(beliefs)]):
        vector = beliefs == belief
        hardly = vector & unsure
        counted[hardly] *= belief**2 / (belief**2 + deviations[hardly] ** 2)
        longest = max(_DISBELIEVED * belief, plausible[vector].max())
        if np.linalg.norm(counted[vector]) > longest:
            return True
    return False


def _pruned(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation without the members that bring no more than chance."""
    for member in explanation.candidates:
        rest = fits.explain([c for c in explanation.candidates if c is not member])
        if not is_significant(fits, rest, fits.explain([*rest.candidates, member]), member):
            explanation = rest
    return explanation


def _spread(fits: Fits, additions: list[Explanation]) -> Explanation:
    """The best addition, with the same effect on all further joints where nothing else explains
    more.

    Joints that share values get values of their own if that explains more; then a simpler effect
    may do as well.
    """
    best = _simplest(additions)
    added, others = best.candidates[-1], best.candidates[:-1]
    if not issubclass(added.effect, JointTorqueEffect):
        return best
    by_joint: dict[str, list[Explanation]] = {}
    for explanation in additions:
        candidate = explanation.candidates[-1]
        if len(candidate.targets) == 1 and issubclass(candidate.effect, JointTorqueEffect):
            by_joint.setdefault(candidate.targets[0], []).append(explanation)

    def alone(effect: type[Effect], joint: str) -> list[Explanation]:
        return [e for e in by_joint.get(joint, []) if e.candidates[-1].effect is effect]

    if len(added.targets) > 1:
        simple = [
            _simplest(by_joint[joint]).candidates[-1].effect
            for joint in added.targets
            if joint in by_joint
        ]
        options = [best]
        for effect in dict.fromkeys([added.effect, *simple]):
            own = [e.candidates[-1] for joint in added.targets for e in alone(effect, joint)]
            options += [fits.explain([*others, *own])] if own else []
        best = _simplest(sorted(options, key=lambda e: e.deviance))
    effect = best.candidates[-1].effect
    chosen, taken = (
        [*best.candidates],
        {target for c in best.candidates if c.effect is effect for target in c.targets},
    )
    for joint, there in by_joint.items():
        same = alone(effect, joint)
        if joint not in taken and same and same[0].deviance < there[0].deviance + MARGIN:
            chosen.append(same[0].candidates[-1])
    return fits.explain(chosen) if len(chosen) > len(best.candidates) else best


def _simplest(additions: list[Explanation]) -> Explanation:
    """The best addition; among those that are told apart by nobody, the one with the fewest
    parameters."""
    equal = [e for e in additions if e.deviance < additions[0].deviance + MARGIN]
    return min(equal, key=lambda e: len(e.solved.parameters))


def _revise(
    proposals: Proposals, explanation: Explanation, revised: Sequence[Candidate]
) -> Explanation:
    """Tries members against all others in their place, until nothing improves.

    A member is tried if it shares a row with another one, and anew when something changes in its
    rows.

    Args:
        revised: members that were tried before the others came.
    """
    fits = proposals.fits
    added = [c for c in explanation.candidates if c not in revised]
    settled = _untouched(revised, added)
    while True:
        waiting = [c for c in explanation.candidates if c not in settled]
        if not waiting:
            return explanation
        fits.dictionary.progress(
            "checking what was found", 1.0 - len(waiting) / len(explanation.candidates)
        )
        member = waiting[0]
        settled.append(member)
        others = [c for c in explanation.candidates if c is not member]
        if len(_untouched(others, [member])) == len(others):
            continue
        rest = fits.explain(others)
        # What is no better than the member need not be looked at, unless nothing at all may be.
        most = explanation.deviance if rest.deviance >= explanation.deviance else np.inf
        additions = best_additions(proposals, rest, member.signature.rows, most)
        best = _simplest(additions) if additions else rest
        if best.deviance < explanation.deviance - (MARGIN if additions else 0.0):
            changed = [member, *(c for c in best.candidates if c not in others)]
            explanation, settled = best, _untouched(settled, changed)


def _untouched(candidates: Sequence[Candidate], changed: Sequence[Candidate]) -> list[Candidate]:
    """Those that share no row with any that changed."""
    rows = np.concatenate([np.zeros(0, dtype=int), *(c.signature.rows for c in changed)])
    return [c for c in candidates if not np.isin(c.signature.rows, rows).any()]
