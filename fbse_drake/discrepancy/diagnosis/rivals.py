"""Rivals: other effects in the place of a member of an explanation, each at the values that fit it
best.

Far from zero an effect is not what its slope at zero says: a crooked IMU that is linearised there
looks worse than the bias that it resembles. So a rival is fitted by itself, nonlinear parameters
and all, before it is compared.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.fits import COMPLEXITY, MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.parsimony import Judge
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.diagnosis.refinement import attained, converged
from fbse_drake.discrepancy.diagnosis.selection import best_additions, is_shown
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.inertia import InertiaEffect
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.errors import InputError

# Between an effect and a body in the name of a rival that is the same effect elsewhere.
ELSEWHERE = " on "
# A rival takes off the deviance at least this share of what the member takes.
_NEAR = 0.25
# So many rivals of each member are fitted by themselves, and so often at most.
_FITTED, _ROUNDS = 4, 3
# Values of a nonlinear parameter that are tried over its plausible range, and how often the best is
# sought between its neighbours.
_POINTS, _NARROWINGS = 5, 2


def rivals(proposals: Proposals, final: Explanation) -> dict[int, list[Explanation]]:
    """For each member: explanations with another effect in its place, be it in all legs, or the
    same on another body, which comes last; best first.

    One for each effect and targets that comes near the member; the best of them fitted by
    themselves. What the log shows a part of is among them: it cannot be named, and can be what is
    there.
    """
    fits, result = proposals.fits, {}
    judge = Judge(fits, final)
    for k, member in enumerate(final.candidates):
        fits.dictionary.progress("fitting what looks alike", k / len(final.candidates))
        rest = fits.explain([c for c in final.candidates if c is not member])
        # What chance may tell apart, however little of the difference counts, and what explains
        # much of what the member does.
        share = min(judge.independent_share(rest, final), judge.least_share(member.signature.rows))
        alike = fits.threshold[-1] / share
        near = max(alike, (1.0 - _NEAR) * (rest.deviance - final.deviance))
        additions = [
            e
            for e in best_additions(
                proposals, rest, member.signature.rows, final.deviance + near, in_part=True
            )
            if rival_name(e.candidates[-1], member)
        ]
        found = [fitted(fits, e) for e in additions[:_FITTED]] + additions[_FITTED:]
        result[k] = sorted(found, key=lambda e: e.deviance)
    return result


def in_parts(proposals: Proposals, final: Explanation) -> dict[int, list[Explanation]]:
    """For each member that can do much, as a payload can: explanations with a simpler effect on the
    same body and another effect in its place, each of which comes last once.

    These never take its place: one cause is likelier than two that together look like it.
    """
    fits, found = proposals.fits, {}
    for k, member in enumerate(final.candidates):
        pairs: list[Explanation] = []
        for base in with_parts(proposals, final, member):
            most = final.deviance + fits.threshold[-1]
            for wider in best_additions(proposals, base, member.signature.rows, most):
                *_, added = wider.candidates
                if added.effect is member.effect or added.effect in _parts(member):
                    continue
                pair = fitted(fits, wider)
                *rest, one, other = pair.candidates
                pairs += [pair, fits.explain([*rest, other, one])]
        found[k] = pairs
    return found


def with_parts(
    proposals: Proposals, final: Explanation, member: Candidate
) -> Iterator[Explanation]:
    """Explanations with a simpler effect on the same body, which comes last, in the place of a
    member that can do much, as a payload can."""
    fits = proposals.fits
    others = [c for c in final.candidates if c is not member]
    for part in fits.fixed_candidates:
        if part.effect in _parts(member) and part.targets == member.targets:
            yield fits.explain([*others, proposals.settled(part, fits.explain(others))])


def _parts(member: Candidate) -> tuple[type[InertiaEffect], ...]:
    return member.effect.parts if issubclass(member.effect, InertiaEffect) else ()


def rival_name(rival: Candidate, member: Candidate) -> str:
    """What a rival of a member is called: another effect, or the same on another body; empty if it
    is neither."""
    if rival.effect is not member.effect:
        return rival.name
    on_bodies = rival.effect.acts_on == "body" and rival.targets != member.targets
    return f"{rival.name}{ELSEWHERE}{rival.targets[0]}" if on_bodies else ""


def indistinguishable(
    fits: Fits, of_members: Mapping[int, Sequence[Explanation]], final: Explanation
) -> dict[int, list[Explanation]]:
    """Rivals, by member, that explain as much as the final explanation, as far as samples are
    independent.

    One with fewer parameters does also if chance may have brought what the final explanation has
    more; and one that shifts the torque in time as a member does, if it takes off all of what that
    takes off but for what a law of unknown shape may be wrong by. Rivals that take a share of the
    torque are given the benefit of the doubt, see `Fits.if_left_is_noise`; and what stands at its
    bound is no parameter of a rival: a payload without extent is a weight at a place.
    """
    judge = Judge(fits, final)
    # Rivals are taken at what laws of their kind attain; so is the final explanation.
    by_slopes = fits.explain(final.candidates)
    promised = attained(fits, by_slopes).deviance - by_slopes.deviance

    def shifts_alike(member: Candidate, rival: Explanation) -> bool:
        if member.has_linear or rival.candidates[-1].has_linear:
            return False
        return judge.is_nearly_as_good(rival, final, member)

    def equals(member: Candidate, rival: Explanation) -> bool:
        is_larger_law = _contains(rival.candidates[-1].effect, member.effect)
        bound = 0 if is_larger_law else _at_bounds(rival)
        more = len(final.solved.parameters) - (len(rival.solved.parameters) - bound)
        least = fits.threshold[min(12, more)] if more > 0 else MARGIN
        lost = fits.if_left_is_noise(rival) - COMPLEXITY * bound - final.deviance - promised
        return lost < least or judge.independent_share(rival, final) * lost < least

    return {
        k: [e for e in found if equals(member, e) or shifts_alike(member, e)]
        for k, found in of_members.items()
        for member in (final.candidates[k],)
    }


def _at_bounds(explanation: Explanation) -> int:
    """How many amounts of the last member are the smallest that there can be."""
    member = explanation.candidates[-1]
    values, _ = explanation.values(member)
    return sum(values[name] <= member.parameters[name].bounds[0] for name in member.linear_names)


def settled(
    proposals: Proposals, final: Explanation
) -> tuple[Explanation, dict[int, list[Explanation]]]:
    """An explanation whose members no rival beats, and their rivals."""
    fits, found = proposals.fits, rivals(proposals, final)
    for _ in range(_ROUNDS):
        better = [
            e
            for k, of_member in found.items()
            for e in of_member
            if e.deviance < final.deviance - MARGIN
            and is_shown(fits, e.as_fitted(e.candidates[-1]))
            and not _contains(e.candidates[-1].effect, final.candidates[k].effect)
            and fits.dictionary.predictor.can_have(e.effects)
        ]
        if not better:
            break
        final = min(better, key=lambda e: e.deviance)
        found = rivals(proposals, final)
    return final, found


def _contains(law: type[Effect], other: type[Effect]) -> bool:
    """Is a law a larger one? Whether it pays was asked before."""
    return issubclass(law, JointTorqueEffect) and any(other in r.effects for r in law.reductions)


def fitted(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation at the values that fit it best, found by Gauss-Newton steps, and for its last
    member by a search over what is nonlinear in it."""
    return attained(fits, converged(fits, _searched(fits, explanation)))


def _searched(fits: Fits, explanation: Explanation) -> Explanation:
    """With the nonlinear parameters of the last member, one after the other, where they fit best.
    Those of joint torque effects were searched for already."""
    best, member = explanation, explanation.candidates[-1]
    if issubclass(member.effect, JointTorqueEffect):
        return explanation
    for k, name in enumerate(member.nonlinear_names):
        low, high = member.parameters[name].plausible
        values = np.geomspace(low, high, _POINTS)
        for _ in range(1 + _NARROWINGS):
            found = [_with_nonlinear(fits, best, k, value) for value in values]
            best = min([best, *found], key=lambda e: e.deviance)
            here, width = best.candidates[-1].nonlinear[k], values[1] / values[0]
            values = here * np.array([width**-0.5, width**0.5])
    return best


def _with_nonlinear(fits: Fits, explanation: Explanation, k: int, value: float) -> Explanation:
    """With another value of a nonlinear parameter of the last member."""
    *others, member = explanation.candidates
    nonlinear = member.nonlinear.copy()
    nonlinear[k] = value
    start = explanation.start(member)
    linear = explanation.solved.parameters[start : start + len(member.linear_names)]
    try:
        raw = fits.dictionary.predictor.signature_near(
            member.effect, member.targets[0], linear, nonlinear, member.raw
        )
    except InputError:
        return explanation
    signature = fits.white.whiten_signature(raw)
    return fits.explain(
        [*others, replace(member, nonlinear=nonlinear, source=raw, signature=signature)]
    )
