"""What becomes of an explanation that is taken at its word: linear about its own values, with
possible bodies, added to the model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary, depends_on
from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.fits import COMPLEXITY, MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor, probes_of
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.identification.inertial import (
    IdentifiedInertia,
    consistent_parameters,
    identified_inertia,
)
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.geometry import GeometryEffect
from fbse_drake.effects.inertia import InertiaEffect
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.effects.sensor import SensorEffect
from fbse_drake.effects.surplus import without_surplus
from fbse_drake.errors import InputError

# How often nonlinear values are moved to where they fit, in turn, where inertia is fitted along.
_POLISHINGS = 3
# How often at most, where they may be far from there, and what deviance is worth no further time.
_MOST_POLISHINGS, _NEGLIGIBLE = 10, 1.0
# Nonlinear values of what shows in a transmission are looked for within such a factor, and with
# such a relative tolerance.
_NEAR, _TOLERANCE = 1.6, 0.01
# Slopes are taken anew only where values have moved by more than this share of the steps that they
# are taken with.
_SAME = 0.5
# The same of a joint's law, where they have changed the whitened residual by more than this sum of
# squares.
_UNSEEN = 0.1
# How often untrusted bodies are measured anew, at most.
_REMEASUREMENTS = 3
# How often effects are fitted beside what they add together.
_CORRECTIONS = 8


def polished(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation made linear about the values that its fit found, where that is no worse.

    Members that have nothing to do with each other are moved each by themselves: what is worse for
    some is no reason not to move the others.
    """
    moved = list(explanation.candidates)
    for group in fits.apart(moved):
        members = tuple(moved[k] for k in group)
        better = fits.polished.or_made(members, partial(_moved, fits, members))
        for k, candidate in zip(group, better, strict=True):
            moved[k] = candidate
    return fits.explain(moved)


def converged(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation that is polished as long as that brings something: of a law that was fitted in
    another's place the values may be far from where they fit."""
    for _ in range(_MOST_POLISHINGS):
        better = polished(fits, explanation)
        if better.deviance > explanation.deviance - _NEGLIGIBLE:
            return min(better, explanation, key=lambda e: e.deviance)
        explanation = better
    return explanation


def attained(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation that laws of its kind attain: itself, or what it is at the values that were
    found where slopes promised more than is there."""
    there = fits.explain(_about_found(fits, explanation.candidates))
    return there if there.deviance > explanation.deviance + COMPLEXITY else explanation


def _moved(fits: Fits, members: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
    """Members made linear about the values that they have together; themselves if that is worse."""
    moved = fits.explain(_about_found(fits, members))
    is_worse = moved.deviance > fits.explain(members).deviance + COMPLEXITY
    return members if is_worse else moved.candidates


def _about_found(fits: Fits, members: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
    """Members made linear about the values that they have together; themselves where no body has
    them."""
    explanation = fits.explain(members)
    moved, start = [], 0
    for candidate in members:
        size, m = candidate.signature.parameters, len(candidate.nonlinear)
        shift = explanation.solved.parameters[start + size - m : start + size]
        start += size
        if not issubclass(candidate.effect, JointTorqueEffect):
            values = explanation.solved.parameters[start - size : start]
            try:
                about = candidate if _is_about(candidate, values) else fits.about(candidate, values)
            except InputError:
                return members
            others = [c for c in members if c is not candidate]
            moved.append(_narrowed(fits, others, about))
            continue
        change = candidate.signature.values[:, :, size - m :] @ shift
        if (change**2).sum() <= _UNSEEN:
            moved.append(candidate)
            continue
        rest = fits.explain([c for c in members if c is not candidate])
        nonlinear = candidate.nonlinear + shift
        moved.append(
            fits.candidate(candidate.effect, candidate.targets, nonlinear, fits.remainder(rest))
        )
    return tuple(moved)


def _is_about(candidate: Candidate, values: np.ndarray) -> bool:
    """Are these the values that a candidate is linear about, as far as differences tell slopes?"""
    moved = np.abs(values - candidate.raw.about)
    return bool(np.all(moved <= _SAME * probes_of(candidate.effect)))


def _narrowed(fits: Fits, others: list[Candidate], candidate: Candidate) -> Candidate:
    """A candidate that is no joint torque effect with its nonlinear values where they fit best
    beside others, if the log tells them at all: what shows in motion alone, or far better
    with another value."""
    needed = 0.0 if fits.dictionary.is_of_motion(candidate.signature) else MARGIN
    for k in range(len(candidate.nonlinear)):
        narrower = _with_fitting_value(fits, others, candidate, k)
        there, here = (fits.explain([*others, c]).deviance for c in (narrower, candidate))
        if here - there >= needed:
            candidate = narrower
    return candidate


def _with_fitting_value(
    fits: Fits, others: list[Candidate], candidate: Candidate, k: int
) -> Candidate:
    """A candidate with one of its nonlinear values where it fits best nearby, beside others.

    Values are rounded to what they are looked for with: what is tried again beside others is then
    known.
    """
    here = candidate.nonlinear[k]
    low, high = candidate.parameters[candidate.nonlinear_names[k]].plausible
    linear = np.broadcast_to(candidate.raw.about, len(candidate.linear_names)).copy()

    def with_value(logarithm: float) -> Candidate:
        nonlinear = candidate.nonlinear.copy()
        nonlinear[k] = np.clip(np.exp(_TOLERANCE * round(logarithm / _TOLERANCE)), low, high)
        return fits.about(replace(candidate, nonlinear=nonlinear), linear)

    found = minimize_scalar(
        lambda logarithm: fits.explain([*others, with_value(logarithm)]).deviance,
        bounds=np.log(np.clip([here / _NEAR, here * _NEAR], low, high)),
        options={"xatol": _TOLERANCE},
    )
    return with_value(found.x)


def with_slopes(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation in which the nonlinear values of what shows in motion alone are fitted along,
    so that what is not known of them is in the intervals of the others."""

    def widened(candidate: Candidate) -> Candidate:
        is_law = issubclass(candidate.effect, JointTorqueEffect)
        if is_law or not len(candidate.nonlinear):
            return candidate
        if not fits.dictionary.is_of_motion(candidate.signature):
            return candidate
        _, linear, _ = explanation.fitted(candidate)
        return fits.with_slopes(candidate, linear)

    members = [widened(candidate) for candidate in explanation.candidates]
    return explanation if members == [*explanation.candidates] else fits.explain(members)


def _where_they_hold(fits: Fits, explanation: Explanation) -> Explanation:
    """An explanation with each member about the nonlinear values that were found, one after the
    other, where that is better when these are held."""

    def deviance(members: Sequence[Candidate]) -> float:
        return fits.explain([_held(c) for c in members]).deviance

    members = explanation.candidates
    for k, candidate in enumerate(_about_found(fits, members)):
        moved = (*members[:k], candidate, *members[k + 1 :])
        if candidate is not members[k] and deviance(moved) < deviance(members):
            members = moved
    return fits.explain(members)


def _held(candidate: Candidate) -> Candidate:
    """A joint's law whose nonlinear values stay as they are; itself if it is none."""
    s, m = candidate.signature, len(candidate.nonlinear)
    if m == 0 or not issubclass(candidate.effect, JointTorqueEffect):
        return candidate
    linear = np.arange(s.parameters) < s.parameters - m
    lowest, highest = (np.where(linear, bound, 0.0) for bound in (s.lowest, s.highest))
    return replace(candidate, signature=replace(s, lowest=lowest, highest=highest))


def consistent(
    fits: Fits, explanation: Explanation
) -> tuple[Explanation, IdentifiedInertia | None]:
    """An explanation whose bodies some distribution of mass has, and what it says of their inertia.

    Nonlinear parameters are moved to where they fit, and held there.
    """
    if fits.dictionary.inertia is None:
        return explanation, None
    for _ in range(_POLISHINGS):
        explanation = polished(fits, explanation)
    explanation = _where_they_hold(fits, explanation)
    signatures = [
        *(c.signature for c in explanation.candidates),
        fits.white.whiten_signature(fits.dictionary.inertia.signature()),
    ]
    sizes = [s.parameters for s in signatures]
    weight = 1.0 / np.sqrt(fits.white.scale(explanation.sse))
    X, y = np.zeros((*fits.white.y.shape, sum(sizes))), fits.white.y.copy()
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
    bodies = len(fits.dictionary.inertia.model)
    of_free = (X * weight[:, None]).reshape(-1, sum(sizes))[:, free]
    others, z = consistent_parameters(
        of_free,
        (y * weight).ravel(),
        prior[free],
        lowest[free][:-bodies],
        fits.dictionary.inertia.own,
    )
    parameters = np.zeros(sum(sizes))
    parameters[free] = np.concatenate([others, z])
    sse = ((y - X @ parameters) ** 2).sum(axis=0) * fits.torque_factor(
        explanation.candidates, parameters
    )
    fit = replace(
        explanation.solved,
        parameters=np.concatenate([parameters[:-bodies], fits.dictionary.directions.T @ z]),
        sse=sse,
    )
    identified = identified_inertia(
        fits.dictionary.inertia, fits.white, explanation.solved, z, fits.dictionary.directions
    )
    return replace(explanation, fit=fit, sse=sse), identified


def remeasured(fits: Fits) -> Fits:
    """Fits in which what the log says clearly of untrusted bodies is not held back by the belief in
    the model.

    Plain friction is fitted along; see `inertial` for bodies that are in conflict with the model.
    """
    for _ in range(_REMEASUREMENTS):
        if fits.dictionary.inertia is None:
            break
        _, found = consistent(fits, Proposals(fits).plain_friction())
        assert found is not None
        inertia = fits.dictionary.inertia.measured_by(found.change)
        if inertia is fits.dictionary.inertia:
            break
        fits = Fits(fits.dictionary.with_inertia(inertia), fits.white)
    return fits


def added(fits: Fits, explanation: Explanation) -> tuple[Explanation, WhitenedResidual, np.ndarray]:
    """An explanation when its inertia, geometry and sensor effects are in the model, where it has
    any; the residual that is measured by; and what is left of it, whitened, (B, R).

    An impact shows a heavy foot's mass only if accelerations are not smoothed, noise grows with the
    masses, and which soles stand is seen when the forces are set right. What effects add together
    is not the sum of what each of them adds: they are fitted anew beside the difference, as long as
    less is left then.
    """
    if fits.dictionary.inertia is not None or not any(map(_is_of_model, explanation.candidates)):
        return explanation, fits.white, fits.leftover(explanation)
    inside = _in_model(fits, explanation)
    for _ in range(_CORRECTIONS):
        if fits.white.deviance(inside.sse) - fits.white.deviance(explanation.sse) < MARGIN:
            break
        corrected = _beside_interplay(fits, explanation, inside.residual)
        again = _in_model(fits, corrected)
        if fits.white.deviance(again.sse) > fits.white.deviance(inside.sse) - MARGIN:
            break
        explanation, inside = corrected, again
    white = WhitenedResidual(inside.residual)
    return (
        replace(
            explanation,
            sse=inside.sse,
            held_out_sse=inside.sse + explanation.held_out_sse - explanation.sse,
        ),
        white,
        white.y,
    )


def _is_of_model(candidate: Candidate) -> bool:
    """Is what a candidate does another one in a model that has it than linearised about one that
    does not?"""
    return issubclass(candidate.effect, InertiaEffect | GeometryEffect | SensorEffect)


def beside_model(
    fits: Fits, explanation: Explanation
) -> tuple[Fits, dict[Candidate, Candidate]] | None:
    """Fits of the residual by a model that has the inertia, geometry and sensor effects of an
    explanation, and its other members in them; None if it has not both."""
    members = explanation.candidates
    others = [c for c in members if not _is_of_model(c)]
    if fits.dictionary.inertia is not None or not 0 < len(others) < len(members):
        return None
    effects = [
        effect for effect, c in zip(explanation.effects, members, strict=True) if _is_of_model(c)
    ]
    predictor = _predictor_with(fits, effects)
    inside = Fits(fits.dictionary, WhitenedResidual(predictor.residual))
    moved = {c: replace(c, signature=inside.white.whiten_signature(c.raw)) for c in others}
    # Heavier links are another load, and an encoder whose zero is off reads another angle.
    of_model = Fits(Dictionary(predictor, fits.dictionary.effects), inside.white)
    for c in others:
        if not issubclass(c.effect, JointTorqueEffect):
            continue
        if not depends_on(c.effect, "load", "position"):
            continue
        rest = of_model.remainder(of_model.explain([moved[o] for o in others if o is not c]))
        moved[c] = of_model.candidate(c.effect, c.targets, c.nonlinear, rest)
    return inside, moved


@dataclass(frozen=True)
class _InModel:
    """What is left when effects are in the model, and its squares, (R,): as many as before, by the
    noise that was measured before where that is larger."""

    residual: Residual
    sse: np.ndarray


def _in_model(fits: Fits, explanation: Explanation) -> _InModel:
    residual = _predictor_with(fits, explanation.effects).residual
    white = WhitenedResidual(residual.by_larger_noise(fits.white.residual))
    share = fits.white.count / np.maximum(white.count, 1)
    factor = fits.torque_factor(explanation.candidates, explanation.solved.parameters)
    return _InModel(residual, white.sse * share * factor)


def _predictor_with(fits: Fits, found: Sequence[Effect]) -> Predictor:
    """By the model with effects that were found."""
    predictor = fits.dictionary.predictor
    scenario = predictor.scenario
    effects = dict(scenario.believed.effects)
    for k, effect in enumerate(found):
        effects, beside = without_surplus(effects, effect, predictor.robot.description)
        if beside is not None:
            effects[f"_found_{k}"] = beside
    believed = replace(scenario.believed, effects=effects)
    return predictor.of(replace(scenario, model=believed))


def _beside_interplay(fits: Fits, explanation: Explanation, left: Residual) -> Explanation:
    """The same effects fitted beside what they add together beyond the sum of what each adds.

    Args:
        left: when all of them are in the model. Those that need not be there are fitted, if there
            are any, as the columns that they are in a model that has the others.
    """
    moved: dict[Candidate, Candidate] = {}
    if found := beside_model(fits, explanation):
        inside, moved = found
        left = inside.white.residual
    value = left.value.copy()
    for candidate in (c for c in explanation.candidates if c not in moved):
        raw, start = candidate.raw, explanation.start(candidate)
        parameters = explanation.solved.parameters[start : start + raw.parameters]
        value[:, raw.rows] += raw.values @ parameters + raw.offset
    residual = fits.white.residual
    both = residual.known & left.known
    value = np.where(both, value, residual.value)
    white = WhitenedResidual(replace(residual, value=value, known=both))
    members = [moved.get(c, c) for c in explanation.candidates]
    return Fits(fits.dictionary, white).explain(
        [replace(c, signature=white.whiten_signature(c.raw)) for c in members]
    )
