"""Searches for what a model lacks, from nothing to an explanation that holds.

They are begun anew for what is learned of the log on the way.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import cast

import numpy as np

from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.disturbance import Disturbance, disturbances
from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation, Name
from fbse_drake.discrepancy.diagnosis.fits import MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.parsimony import (
    frugal,
    in_fits,
    needs_inertia,
    without_stand_ins,
)
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.diagnosis.refinement import (
    added,
    consistent,
    polished,
    remeasured,
    with_slopes,
)
from fbse_drake.discrepancy.diagnosis.rivals import (
    in_parts,
    indistinguishable,
    rivals,
    settled,
    with_parts,
)
from fbse_drake.discrepancy.diagnosis.selection import select
from fbse_drake.discrepancy.identification.inertial import IdentifiedInertia
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.identification.structure import (
    Structure,
    is_white,
    leftover_structure,
    noisy_rows,
    tolerated,
    untested_rows,
)
from fbse_drake.discrepancy.identification.untold_noise import likeliest_noise
from fbse_drake.discrepancy.residual.noise import Noise
from fbse_drake.effects.actuation import TorqueReadingLag
from fbse_drake.effects.effect import Effect
from fbse_drake.progress import Interrupted, Progress

# Where torques are read earlier, the error may be so many times as large: noise is measured anew.
_AS_GOOD = 1.02
# Lags of torques that differ by no more than this factor may be those of one recorder.
_ALIKE = 1.5
# Of fewer averages than this a test of whiteness says little.
_TELLING = 400
# A search is begun so often, at most, for noise that nobody told of.
_MOST_BEGINNINGS = 4
# A search is tried again, so often in all, if less than this share of what it explained pays.
_HOLDS, _MOST_WAYS = 0.5, 3


@dataclass(frozen=True)
class Search:
    """What a search found."""

    proposals: Proposals
    # The last is what was found, when it is in the model.
    path: list[Explanation]
    # The same before it was: linear, as the alternatives of its members are.
    linear: Explanation
    # By its member, where they were looked for.
    alternatives: dict[int, list[Explanation]]
    # Sum of squares of each row before anything is explained, (R,).
    before: np.ndarray
    inertia: IdentifiedInertia | None
    # What is left in rows, as far as it is large enough to matter, and in which stretches it stands
    # out.
    unexplained: list[Structure]
    disturbances: tuple[Disturbance, ...]
    # Rows of which a log as short as this cannot tell.
    untested: tuple[str, ...]
    # Rows in which what is left is far more than noise, and follows nothing.
    noisy: tuple[str, ...]
    # That nobody believed in, by what is left; None where there is none.
    more_noise: Noise | None
    partial: str | None

    @property
    def error(self) -> float:
        """Root mean square of what is left on held-out data, in multiples of the noise."""
        return root_mean_square(self.proposals.fits.white, self.path[-1].held_out_sse)


@dataclass(frozen=True)
class LateTorques:
    """Torques that a search found to come late."""

    fits: Fits
    explanation: Explanation
    # With their sizes, also where they are too small to matter: left unread, what they leave there
    # would be explained by something else. By place of a member rivals that explain as much.
    members: Mapping[Candidate, float]
    equal: Mapping[int, Sequence[Explanation]]

    @property
    def effect(self) -> TorqueReadingLag:
        by_joint = {
            joint: self.explanation.values(member)[0]["time_constant"]
            for member in self.members
            for joint in member.targets
        }
        return TorqueReadingLag(time_constant=by_joint)

    def everywhere(self, proposals: Proposals) -> "LateTorques | None":
        """With a lag also in the joints where none was found, if most have one and all are alike,
        for one recorder reads them all; None otherwise, or if all have one.

        Args:
            proposals: of the search.
        """
        final, is_driven = self.explanation, self.fits.dictionary.predictor.is_driven
        driven = [*compress(self.fits.dictionary.joints, is_driven)]
        shared = max(self.members, key=lambda member: len(member.targets))
        late = cast(dict[str, float], self.effect.time_constant)
        lacking = tuple(joint for joint in driven if joint not in late)
        is_one = max(late.values()) < _ALIKE * min(late.values())
        if not lacking or not is_one or 2 * len(late) <= len(driven):
            return None
        others = [c for c in final.candidates if c is not shared]
        targets = tuple(joint for joint in driven if joint in shared.targets + lacking)
        wider = proposals.beside(self.fits.explain(others), TorqueReadingLag, targets)
        now = dict(zip([*others, shared], wider.candidates, strict=True))
        members = {now[member]: share for member, share in self.members.items()}
        equal = {
            wider.candidates.index(now[final.candidates[k]]): rivals
            for k, rivals in self.equal.items()
        }
        return LateTorques(self.fits, wider, members, equal)


def _late_torques(search: Search) -> LateTorques | None:
    """What a search found to come late, if it matters in any joint."""
    fits, final = search.proposals.fits, search.path[-1]
    significance = fits.dictionary.significance
    members = {
        c: significance.share(final, c) for c in final.candidates if c.effect is TorqueReadingLag
    }
    if search.partial is not None or not any(map(significance.matters, members.values())):
        return None
    equal = indistinguishable(fits, search.alternatives, search.linear)
    return LateTorques(fits, final, members, equal)


def _with_torques_in_time(
    predictor: Predictor,
    late: LateTorques,
    effects: Sequence[type[Effect]],
    progress: Progress,
) -> Search:
    """What is found when torques are read earlier by what they come late: beside friction, which
    jumps, a rate is no delay, and other laws are found in what is left of the jumps."""
    model = predictor.scenario.believed
    model = replace(model, effects=dict(model.effects) | {"_late_torques": late.effect})
    # What is read too early is no drive that is late, unless one was found before.
    found = {c.effect for c in late.explanation.candidates}
    barred = {TorqueReadingLag, *(e for e in TorqueReadingLag.opposites if e not in found)}
    others = [effect for effect in effects if effect not in barred]
    in_time = predictor.of(replace(predictor.scenario, model=model))
    return _searched(Dictionary(in_time, others, progress), others)


@dataclass(frozen=True)
class BestSearch:
    """A search, and how the log was read for it."""

    search: Search
    # Left out; see `Diagnosis`.
    disturbances: tuple[Disturbance, ...]
    noisier: tuple[str, ...]
    # That are read earlier.
    late: LateTorques | None
    # Root mean square before anything is explained, in multiples of the noise.
    error_before: float


def best_search(dictionary: Dictionary, effects: Sequence[type[Effect]]) -> BestSearch:
    """A search by a dictionary, or the one that was begun anew for what was learned of the log:
    something acted on it for a while, there is noise that nobody told of, torques come late."""
    predictor, progress = dictionary.predictor, dictionary.progress
    noisier: set[int] = set()

    def with_noise(more: Noise) -> Predictor:
        noisier.update(np.flatnonzero(more.factor > 1.0).tolist())
        return predictor.noisier(more)

    for again in reversed(range(_MOST_BEGINNINGS)):
        is_last = again == 0 or not predictor.motion.recording.is_sampled
        try:
            search = _searched(dictionary, effects, until_noise=not is_last)
            break
        except _NoiseAlone as found:
            predictor = with_noise(found.noise)
            dictionary = Dictionary(predictor, effects, progress)
    disturbances = search.disturbances
    if disturbances:
        predictor = predictor.without([(one.start, one.end) for one in disturbances])
        search = _searched(Dictionary(predictor, effects, progress), effects)
    if search.more_noise is not None:
        predictor = with_noise(search.more_noise)
        search = _searched(Dictionary(predictor, effects, progress), effects)
    names = tuple(predictor.residual.rows[row].name for row in sorted(noisier))
    before = root_mean_square(search.proposals.fits.white, search.before)
    late = _late_torques(search)
    tried = [] if late is None else [late.everywhere(search.proposals), late]
    for one in (one for one in tried if one is not None):
        in_time = _with_torques_in_time(predictor, one, effects, progress)
        if in_time.error <= _AS_GOOD * search.error:
            return BestSearch(in_time, disturbances, names, one, before)
    return BestSearch(search, disturbances, names, None, before)


class _NoiseAlone(Exception):
    """What is left in some rows is nothing but noise that nobody told of."""

    def __init__(self, noise: Noise):
        super().__init__()
        self.noise = noise


def _searched(
    dictionary: Dictionary, effects: Sequence[type[Effect]], *, until_noise: bool = False
) -> Search:
    """What is found by a dictionary of these effects.

    Args:
        until_noise: ends where nothing is left in a row but noise that nobody told of, in which
            many effects would be tried.

    Raises:
        _NoiseAlone: it ended so.
    """
    predictor, progress, partial = dictionary.predictor, dictionary.progress, None
    proposals = Proposals(Fits(dictionary))
    path, before = [proposals.fits.explain([])], proposals.fits.white.sse
    try:
        first = remeasured(proposals.fits)
        if until_noise:
            _raise_if_noise_alone(first, path[-1])
        for path, proposals in _held(first.dictionary, first.white):
            progress("looking for what explains more")
            if until_noise:
                _raise_if_noise_alone(proposals.fits, path[-1])
    except Interrupted as stop:
        partial = str(stop)
    alternatives: dict[int, list[Explanation]] = {}
    try:
        if partial is None and dictionary.inertia is not None:
            path, proposals = _with_trust(proposals, path, effects)
        if partial is None and proposals.fits.dictionary.inertia is None:
            path[-1], alternatives = _settled_and_frugal(proposals, path[-1])
    except Interrupted as stop:
        partial = str(stop)
    linear = path[-1]
    final, inertia = consistent(proposals.fits, linear)
    path[-1], remaining, left = added(proposals.fits, with_slopes(proposals.fits, final))
    significance = proposals.fits.dictionary.significance
    structures = leftover_structure(predictor.motion, remaining, left)

    def matters(row: int) -> bool:
        return significance.matters(significance.left_share(row, left, remaining))

    unexplained = [structure for structure in structures if matters(structure.index)]
    noisy = noisy_rows(predictor.motion, remaining, left, structures)
    disturbed = disturbances(remaining, left, [structure.index for structure in unexplained])
    return Search(
        proposals,
        path,
        linear,
        alternatives,
        before,
        inertia,
        unexplained,
        disturbed,
        untested_rows(predictor.motion, remaining, left, structures),
        tuple(remaining.residual.rows[row].name for row in noisy if matters(row)),
        None
        if partial is not None
        else _more_noise(predictor, remaining, left, [s.index for s in unexplained]),
        partial,
    )


def _raise_if_noise_alone(fits: Fits, explanation: Explanation) -> None:
    """
    Raises:
        _NoiseAlone: what an explanation leaves is that, in rows in which more seems to be left.
    """
    predictor, white, left = fits.dictionary.predictor, fits.white, fits.leftover(explanation)
    motion = predictor.motion

    telling = np.flatnonzero(white.count >= _TELLING).tolist()

    def noise_of(rows: Collection[int]) -> Noise | None:
        return _more_noise(predictor, white, left, [row for row in telling if row in rows])

    size = np.sqrt((left**2).sum(axis=0) / np.maximum(white.count, 1))
    louder = {row for row in telling if size[row] > tolerated(white, row)}
    correlated = {row for row in telling if not is_white(left[:, row], int(white.count[row]))}
    # Mostly there is more than noise, which is found out sooner than what it lives in.
    if noise_of(louder | correlated) is None:
        return
    living = {structure.index for structure in leftover_structure(motion, white, left)}
    if (noise := noise_of(living | correlated)) is None:
        return
    # What is small beside the noise may live in something all the same.
    noisier = WhitenedResidual(
        noise.added_to(replace(white.residual, value=white.coloured(left)), motion.length)
    )
    lives = [structure.index for structure in leftover_structure(motion, noisier, noisier.y)]
    alone = np.setdiff1d(np.flatnonzero(noise.factor > 1.0), lives)
    if alone.size:
        raise _NoiseAlone(noise.in_rows(alone))


def _more_noise(
    predictor: Predictor, remaining: WhitenedResidual, left: np.ndarray, rows: Sequence[int]
) -> Noise | None:
    """White noise of sampled torques that shows only in what is left, whitened, (B, R); None if
    these rows have none."""
    if not predictor.scenario.recording.is_sampled or not rows:
        return None
    residual = replace(remaining.residual, value=remaining.coloured(left))
    return likeliest_noise(residual, predictor.motion.length, rows)


def _with_trust(
    proposals: Proposals, path: list[Explanation], effects: Sequence[type[Effect]]
) -> tuple[list[Explanation], Proposals]:
    """A path by the model's own inertia, if what the last explanation fits of it is not needed."""
    fits = proposals.fits
    predictor, progress = fits.dictionary.predictor.trusting_inertia(), fits.dictionary.progress
    trusting = Fits(Dictionary(predictor, effects, progress))
    trusting, explanation = trusting.doubting(in_fits(trusting, path[-1]))
    if needs_inertia(fits, path[-1], trusting):
        return path, proposals
    frugally = Proposals(trusting)
    explanation = frugal(frugally, polished(trusting, explanation))
    return [trusting.explain([]), explanation], frugally


def _held(
    dictionary: Dictionary, white: WhitenedResidual
) -> Iterator[tuple[list[Explanation], Proposals]]:
    """As `select` from nothing, by fits of its own, which are let go of as soon as the residual is
    weighed anew; the last path ends with what pays of its last explanation.

    Where that explains little of what the search did, the search began with something that does not
    hold, and left the right way: another one goes without it.
    """
    barred: frozenset[Name] = frozenset()
    best: tuple[list[Explanation], Proposals] | None = None
    for _ in range(_MOST_WAYS):
        for path, proposals in select(Fits(dictionary, white), barred):
            yield path, proposals
        nothing, found, kept = path[0], path[-1], frugal(proposals, path[-1])
        if len(kept.candidates) < len(found.candidates):
            # What is doubtful of a law is no noise without it.
            fits, kept = proposals.fits.doubting(kept)
            proposals = proposals if fits is proposals.fits else Proposals(fits, barred)
            white = fits.white
        if best is None or kept.deviance < best[0][-1].deviance - MARGIN:
            best = [*path[:-1], kept], proposals
        left = {c.key for c in kept.candidates}
        lost = [c.key for c in found.candidates if c.key not in left]
        explained, holds = (nothing.deviance - e.deviance for e in (found, kept))
        if not lost or holds >= _HOLDS * explained:
            break
        barred |= {lost[0]}
    assert best is not None
    yield best


def _settled_and_frugal(
    proposals: Proposals, explanation: Explanation
) -> tuple[Explanation, dict[int, list[Explanation]]]:
    """A frugal explanation whose members no rival beats, and their rivals.

    What took another's place has to pay as well; where it does not, and nothing is left in that
    place, the other stays.
    """
    final, found = settled(proposals, explanation)
    smaller = final
    if final is not explanation:
        smaller = frugal(proposals, final)
        if smaller.deviance > explanation.deviance + MARGIN:
            smaller = explanation
    smaller = simplified_in_model(proposals, without_stand_ins(proposals.fits, smaller))
    found = found if smaller is final else rivals(proposals, smaller)
    pairs = in_parts(proposals, smaller)
    return smaller, {k: [*of_member, *pairs[k]] for k, of_member in found.items()}


def simplified_in_model(proposals: Proposals, final: Explanation) -> Explanation:
    """An explanation with a part of a member that can do much in its place, as the mass of a body
    in that of a payload, where this explains as much when it is in the model.

    How hard a heavy foot lands is not told by accelerations that are smoothed: made linear, a
    payload takes more of that.
    """
    fits = proposals.fits

    def in_model(explanation: Explanation) -> float:
        return fits.white.deviance(added(fits, explanation)[0].sse)

    for member in final.candidates:
        simpler = [*with_parts(proposals, final, member)]
        if not simpler:
            continue
        deviance, parameters = in_model(final), len(final.solved.parameters)
        for explanation in simpler:
            more = parameters - len(explanation.solved.parameters)
            if in_model(explanation) < deviance + fits.threshold[min(12, more)]:
                final = explanation
                break
    return final


def root_mean_square(
    white: WhitenedResidual, sse: np.ndarray, rows: np.ndarray | slice = slice(None)
) -> float:
    """Of a whitened residual with these sums of squares, (R,), in some rows together."""
    return float(np.sqrt(sse[rows].sum() / max(1, white.count[rows].sum())))
