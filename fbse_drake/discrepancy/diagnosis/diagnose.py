"""Which physical effect does a model lack? Verdicts from what each effect explains of the held-out
residual."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from fbse_drake.discrepancy.diagnosis.bandwidth import Averaging, averaged_to_bandwidth
from fbse_drake.discrepancy.diagnosis.detectability import smallest_detectable
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.disturbance import Disturbance
from fbse_drake.discrepancy.diagnosis.experiment import Experiments
from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.fits import MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.naming import is_named, is_within_rows
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.rivals import indistinguishable, rival_name, rivals
from fbse_drake.discrepancy.diagnosis.search import LateTorques, best_search, root_mean_square
from fbse_drake.discrepancy.diagnosis.selection import single_guesses
from fbse_drake.discrepancy.diagnosis.spread import Spread, spreads, spreads_json
from fbse_drake.discrepancy.diagnosis.validation import Validation, validation_json
from fbse_drake.discrepancy.identification.inertial import PARAMETERS, IdentifiedInertia
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.identification.structure import Structure
from fbse_drake.effects.actuation import TorqueReadingLag
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.inertia import InertialParameters
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.progress import Interrupted, Progress, silent

Verdict = Literal["effect_found", "nothing_missing", "unknown_effect", "not_visible"]
EffectVerdict = Literal["present", "absent", "not_visible", "confusable"]
# An effect counts as the explanation of a row if it takes away this share of what exceeds the noise
# there, and leaves no more than this many times the noise.
_EXPLAINED = 0.97
_LARGEST_REST = 5.0


@dataclass(frozen=True)
class Estimate:
    """A parameter's value with its 95 % confidence interval."""

    value: float
    interval: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Finding:
    """What one effect on one or more targets explains."""

    effect: str
    # Joints, bodies, sides or `robot`; they share the values.
    targets: tuple[str, ...]
    # Root mean square of the held-out residual, in multiples of the sensors' noise, without and
    # with the effect.
    held_out_before: float
    held_out_after: float
    parameters: dict[str, Estimate]
    # Other effects that explain the residual as well.
    confusable_with: tuple[str, ...]
    # Is it named, or only an alternative, tentative, or too small to matter?
    chosen: bool
    # Is it part of the explanation, but takes less off its rows than what is left there? It may
    # stand for what the library does not have: the completed model gets it, nobody is told that it
    # is there.
    tentative: bool = False
    # Of the explanation, but smaller than `IdentifyConfig.tolerance`; and its size as that is
    # measured, NaN where it is not known.
    too_small: bool = False
    share: float = np.nan
    # Of what is chosen, where several recordings were fitted together: how far they agree, by
    # parameter.
    spread: Mapping[str, Spread] = field(default_factory=dict)


@dataclass(frozen=True)
class EffectStatus:
    """What this data says about one effect of the library."""

    verdict: EffectVerdict
    # Parameter that says how large the effect is, its unit, and the smallest value that this data
    # would have shown, by target.
    parameter: str
    unit: str
    smallest_detectable: dict[str, float]
    # What would show it; a scenario that would, where one is known.
    experiment: str
    scenario: str | None = None
    # The largest value that is plausible, by target.
    largest_plausible: dict[str, float] = field(default_factory=dict)

    @property
    def over_plausible(self) -> dict[str, float]:
        """The smallest value that would have been shown, over the largest plausible one, by
        target."""
        return {
            target: size / self.largest_plausible.get(target, np.inf)
            for target, size in self.smallest_detectable.items()
        }

    def hidden_in(self, rows: Sequence[str]) -> "EffectStatus":
        """The same, where what is left in some rows is no noise that is known: there an effect may
        hide, however large it is."""
        if self.verdict != "absent" or not self.smallest_detectable.keys() & set(rows):
            return self
        sizes = {t: np.inf if t in rows else s for t, s in self.smallest_detectable.items()}
        return replace(self, verdict="not_visible", smallest_detectable=sizes)

    @property
    def command(self) -> str | None:
        """The command that makes that experiment, in simulation."""
        return f"fbse simulate {self.scenario} --out out/{self.scenario}" if self.scenario else None


@dataclass(frozen=True)
class SelectionStep:
    """An explanation on the way to a diagnosis; without the columns that it was fitted with."""

    # Effects and their targets.
    members: frozenset[tuple[str, tuple[str, ...]]]
    # Root mean squares of the whole residual in multiples of the sensors' noise: on held-out data,
    # and on what was fitted.
    held_out_rmse: float
    train_rmse: float


@dataclass(frozen=True)
class Diagnosis:
    """Which effects are missing, and how sure that is."""

    verdict: Verdict
    # Chosen effects, those that explain most first, then alternatives, best first; where nothing
    # can be named of what is there, what each effect explains by itself.
    ranking: tuple[Finding, ...]
    effects: dict[str, EffectStatus]
    # What no effect of the library explains: by row, as far as it is large enough to matter.
    unexplained: tuple[Structure, ...]
    # Explanations in the order in which they were found; the first has no effects.
    path: tuple[SelectionStep, ...]
    # Root mean squares of the whole residual in multiples of the sensors' noise: on held-out data
    # without and with what was chosen, and on the data that it was fitted to.
    held_out_before: float
    held_out_after: float
    train_after: float
    # Inertial parameters that were identified along, of bodies whose own are not trusted; see
    # `IdentifyConfig`.
    inertia: IdentifiedInertia | None = None
    # Over what the log was averaged.
    averaging: Averaging | None = None
    # Why the search ended before it was through; None if it was. What a partial diagnosis does not
    # name was not ruled out.
    partial: str | None = None
    # By log that was set aside: is the model with what was chosen better there? See `study` for a
    # search that goes on.
    set_aside: Mapping[str, Validation] = field(default_factory=dict)
    # In which something acted that no law explains; they were left out.
    disturbances: tuple[Disturbance, ...] = ()
    # Rows in which more than noise is left, but in too few averages to say that it is none.
    untested: tuple[str, ...] = ()
    # Rows in which far more than the sensors' noise is left, and follows nothing.
    noisy: tuple[str, ...] = ()
    # Rows in which what was left is white, and was taken for noise that nobody believed in.
    noisier: tuple[str, ...] = ()
    # What explains the log and raises the error of data that was set aside: it is not named.
    refuted: tuple[Finding, ...] = ()

    @property
    def chosen(self) -> list[Finding]:
        return [finding for finding in self.ranking if finding.chosen]

    @property
    def tentative(self) -> list[Finding]:
        """What explains something, but may stand for something else."""
        return [finding for finding in self.ranking if finding.tentative]

    @property
    def completing(self) -> list[Finding]:
        """What the completed model gets: what was chosen, and what is tentative."""
        return [finding for finding in self.ranking if finding.chosen or finding.tentative]

    @property
    def too_small(self) -> list[Finding]:
        """What is there, but too small to matter."""
        return [finding for finding in self.ranking if finding.too_small]


def plausible_effects(predictor: Predictor) -> list[type[Effect]]:
    """The library but for what the scenario rules out, and for what acts in the joints of a log
    without torques."""
    torques = "joint/torque_command" in predictor.motion.log
    known = {
        name: effect
        for name, effect in library().items()
        if name not in predictor.scenario.identify.ruled_out
    }
    return [
        effect for effect in known.values() if torques or not issubclass(effect, JointTorqueEffect)
    ]


def diagnose(
    predictor: Predictor,
    effects: Iterable[type[Effect]] | None = None,
    *,
    progress: Progress = silent,
    dictionary: Dictionary | None = None,
    experiments: Experiments | None = None,
) -> Diagnosis:
    """Finds the effects that a model lacks.

    Candidates are added one after the other, each the one that leaves the least deviance on
    held-out data; after every addition each member is tried against all others in its place. An
    effect counts if it beats what chance would bring once in a thousand logs.

    Args:
        effects: what is tried; by default `plausible_effects`.
        progress: is told what is being done. If it interrupts the work, the diagnosis is partial.
        dictionary: of these effects, begun already; it is used where it is of this log and model.
        experiments: of this robot, begun already; they are used where they serve this model.
    """
    predictor, averaging = averaged_to_bandwidth(predictor)
    tried = plausible_effects(predictor) if effects is None else list(effects)
    if dictionary is None or not dictionary.serves(predictor, tried):
        dictionary = Dictionary(predictor, tried, progress)
    found = best_search(dictionary, tried)
    search, late = found.search, found.late
    proposals, path, alternatives = search.proposals, search.path, search.alternatives
    before, inertia, unexplained = search.before, search.inertia, search.unexplained
    partial, final, fits = search.partial, path[-1], proposals.fits
    white, dictionary = fits.white, fits.dictionary
    predictor, significance = dictionary.predictor, dictionary.significance
    shares = {c: significance.share(final, c) for c in final.candidates}
    matters = [c for c, share in shares.items() if significance.matters(share)]
    without = {
        c: fits.explain([other for other in final.candidates if other is not c])
        for c in final.candidates
    }
    within_rows = [c for c in matters if is_within_rows(predictor, final, c)]

    def members_named() -> list[Candidate]:
        return [c for c in matters if is_named(proposals, final, c, without[c], unexplained)]

    try:
        named = members_named()
    except Interrupted as stop:
        # Work is interrupted once.
        partial, named = str(stop), members_named()
    tentative = [c for c in matters if c not in named]
    statuses: dict[str, EffectStatus] = {}
    equal: dict[int, list[Explanation]] = {}
    guesses: list[Explanation] = []
    try:
        if partial is None:
            if unexplained and not final.candidates:
                left = np.array([structure.index for structure in unexplained])
                guesses = single_guesses(proposals, left)
            linear = search.linear
            if dictionary.inertia is not None:
                alternatives, linear = rivals(proposals, final), final
            equal = indistinguishable(fits, alternatives, linear)
            if experiments is None or not experiments.serve(predictor.scenario):
                experiments = Experiments(predictor.scenario)
            for k, effect in enumerate(dictionary.effects):
                progress("finding what would have been seen", k / len(dictionary.effects))
                status = _status(fits, final, tentative, effect, equal, experiments)
                statuses[effect.__name__] = status.hidden_in(search.noisy)
            if late is not None:
                statuses[TorqueReadingLag.__name__] = _status(
                    late.fits, late.explanation, (), TorqueReadingLag, {}, experiments
                )
    except Interrupted as stop:
        partial = str(stop)
    hidden = sum(status.verdict == "not_visible" for status in statuses.values())
    has_inertia = inertia is not None and final.deviance < white.deviance(white.sse) - MARGIN
    if unexplained and not _well_explained(white, final, unexplained):
        verdict: Verdict = "unknown_effect"
    elif named or late is not None or has_inertia:
        verdict = "effect_found"
    elif len(within_rows) < len(matters):
        verdict = "unknown_effect"
    elif hidden > 0.5 * len(statuses) or any(
        (partial is not None, within_rows, search.untested, search.noisy)
    ):
        verdict = "not_visible"
    else:
        verdict = "nothing_missing"
    members = [
        replace(
            finding,
            tentative=member in tentative,
            too_small=member not in matters,
            share=shares[member],
        )
        for member, finding in _members(fits, final, without, equal, named)
    ]
    if late is not None:
        members += _late_findings(late)
    others = (e for of_member in alternatives.values() for e in of_member)
    return Diagnosis(
        verdict,
        (
            *members,
            *_ranked(fits, sorted(others, key=lambda e: e.deviance), members),
            *_ranked(fits, guesses, ()),
            *inertia_findings(white, before, path[0], inertia),
        ),
        statuses,
        tuple(unexplained),
        _steps(path, found.error_before, [] if late is None else late.members),
        held_out_before=found.error_before,
        held_out_after=root_mean_square(white, final.held_out_sse),
        train_after=root_mean_square(white, final.sse),
        inertia=inertia,
        averaging=averaging,
        partial=partial,
        disturbances=found.disturbances,
        untested=search.untested,
        noisy=search.noisy,
        noisier=found.noisier,
    )


def _steps(
    path: Sequence[Explanation], before: float, beside: Collection[Candidate]
) -> tuple[SelectionStep, ...]:
    """What is kept of explanations.

    Args:
        before: root mean square of the residual before anything is explained.
        beside: what every one but the first has as well.
    """
    whole = path[0].held_out_sse.sum()
    return tuple(
        SelectionStep(
            frozenset(
                (c.name, c.targets)
                for c in (*explanation.candidates, *(beside if explanation.candidates else ()))
            ),
            *(
                before * float(np.sqrt(sse.sum() / whole))
                for sse in (explanation.held_out_sse, explanation.sse)
            ),
        )
        for explanation in path
    )


def _members(
    fits: Fits,
    final: Explanation,
    without: Mapping[Candidate, Explanation],
    equal: Mapping[int, Sequence[Explanation]],
    named: Collection[Candidate],
) -> Iterator[tuple[Candidate, Finding]]:
    """Members of the explanation with what they bring, those that explain most first.

    Args:
        without: the explanation without each of them.
        equal: by place of a member, rivals that explain as much.
    """
    spread = spreads(fits, final)
    places = range(len(final.candidates))
    for k in sorted(places, key=lambda k: -without[final.candidates[k]].deviance):
        member = final.candidates[k]
        names = tuple(dict.fromkeys(rival_name(e.candidates[-1], member) for e in equal.get(k, ())))
        finding = finding_of(fits.white, without[member], final, member, (), chosen=member in named)
        names = tuple(dict.fromkeys((*names, *smaller_laws(member, finding.parameters))))
        yield member, replace(finding, confusable_with=names, spread=spread.get(member, {}))


def smaller_laws(member: Candidate, found: Mapping[str, Estimate]) -> tuple[str, ...]:
    """Effects of the library that a law turns into at values that the log does not exclude, or that
    are as good as there: friction that builds up within a displacement smaller than any real one
    holds a joint that rests, as Coulomb friction does.

    The law was kept, for the smaller one at its usual values leaves more.
    """
    if not issubclass(member.effect, JointTorqueEffect):
        return ()

    def is_there(name: str, value: float) -> bool:
        estimate, parameter = found[name], member.parameters[name]
        (low, high), rounding = estimate.interval, max(0.0, parameter.bounds[0])
        is_smaller = not parameter.linear and value < estimate.value <= parameter.plausible[0]
        return low - rounding <= value <= high or is_smaller

    for reduction in member.effect.reductions:
        if all(is_there(name, value) for name, value in reduction.at.items()):
            return tuple(effect.__name__ for effect in reduction.effects)
    return ()


def _late_findings(late: LateTorques) -> list[Finding]:
    """Of torques that come late, by the search that found them."""
    fits, final = late.fits, late.explanation
    without = {
        member: fits.explain([c for c in final.candidates if c is not member])
        for member in final.candidates
    }
    significance = fits.dictionary.significance
    matters = [member for member, share in late.members.items() if significance.matters(share)]
    return [
        replace(finding, too_small=member not in matters, share=late.members[member])
        for member, finding in _members(fits, final, without, late.equal, matters)
        if member in late.members
    ]


def _ranked(
    fits: Fits, explanations: Sequence[Explanation], findings: Sequence[Finding]
) -> list[Finding]:
    """What the last members of explanations bring, each effect and targets once.

    Args:
        findings: what is told already.
    """
    seen, result = {(f.effect, f.targets) for f in findings}, []
    for explanation in explanations:
        member = explanation.candidates[-1]
        if (member.name, member.targets) not in seen:
            seen.add((member.name, member.targets))
            rest = fits.explain(explanation.candidates[:-1])
            result.append(finding_of(fits.white, rest, explanation, member, (), chosen=False))
    return result


def finding_of(
    white: WhitenedResidual,
    before: Explanation,
    after: Explanation,
    member: Candidate,
    equal: tuple[str, ...],
    *,
    chosen: bool,
) -> Finding:
    """What a member of an explanation brings.

    Args:
        before, after: explanations without and with it.
        equal: effects that explain as much.
    """
    values, intervals = after.values(member)
    parameters = {
        name: Estimate(values[name], intervals[name], member.parameters[name].unit)
        for name in values
    }
    rows = member.signature.rows
    return Finding(
        member.name,
        member.targets,
        root_mean_square(white, before.held_out_sse, rows),
        root_mean_square(white, after.held_out_sse, rows),
        parameters,
        equal,
        chosen,
    )


def inertia_findings(
    white: WhitenedResidual,
    before: np.ndarray,
    alone: Explanation,
    inertia: IdentifiedInertia | None,
) -> list[Finding]:
    """Changes of the inertial parameters of each body.

    Args:
        before: sum of squares of each row of the model as it is.
        alone: the explanation by inertia alone.
    """
    if inertia is None:
        return []
    findings = []
    for body, values, widths in zip(
        inertia.bodies, inertia.change, inertia.half_width, strict=True
    ):
        parameters = {
            name: Estimate(
                float(value),
                (float(value - width), float(value + width)),
                InertialParameters.parameters[name].unit,
            )
            for name, value, width in zip(PARAMETERS, values, widths, strict=True)
        }
        findings.append(
            Finding(
                InertialParameters.__name__,
                (body,),
                root_mean_square(white, before),
                root_mean_square(white, alone.held_out_sse),
                parameters,
                (),
                chosen=True,
            )
        )
    return findings


def _well_explained(
    white: WhitenedResidual, final: Explanation, unexplained: Sequence[Structure]
) -> bool:
    """Is what is left small beside what the explanation takes away, in every row?"""
    if not final.candidates:
        return False
    for structure in unexplained:
        row = structure.index
        before, after = (
            white.sse[row] - white.count[row],
            final.held_out_sse[row] - white.count[row],
        )
        if after > (1 - _EXPLAINED) * before or structure.ratio > _LARGEST_REST:
            return False
    return True


def _status(
    fits: Fits,
    final: Explanation,
    tentative: Collection[Candidate],
    effect: type[Effect],
    equal: Mapping[int, Sequence[Explanation]],
    experiments: Experiments,
) -> EffectStatus:
    parameter = next(iter(effect.parameters))
    smallest, scenario = smallest_detectable(fits, final, effect), None
    largest = {target: fits.dictionary.largest_plausible(effect, target) for target in smallest}
    mistaken_for = [
        final.candidates[k]
        for k, of_member in equal.items()
        if any(e.candidates[-1].effect is effect for e in of_member)
    ]
    if any(c.effect is effect and c not in tentative for c in final.candidates):
        verdict: EffectVerdict = "present"
    elif any(c.effect is effect for c in tentative):
        verdict = "confusable"
    elif mistaken_for:
        verdict = "confusable"
        member = mistaken_for[0]
        scenario = experiments.that_separates(
            member.effect, member.targets, final.values(member)[0], effect
        )
    elif all(size > largest[target] for target, size in smallest.items()):
        verdict = "not_visible"
        scenario = experiments.that_shows(effect)
    else:
        verdict = "absent"
    units = dict.fromkeys(
        fits.dictionary.parameters(effect, target)[parameter].unit for target in smallest
    ) or [effect.parameters[parameter].unit]
    unit = " or ".join(units)
    return EffectStatus(verdict, parameter, unit, smallest, effect.experiment, scenario, largest)


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Contents of diagnosis.json."""
    return {
        "verdict": diagnosis.verdict,
        "partial": diagnosis.partial is not None,
        "interrupted_because": diagnosis.partial,
        "held_out_before": diagnosis.held_out_before,
        "held_out_after": diagnosis.held_out_after,
        "train_after": diagnosis.train_after,
        "set_aside": {name: validation_json(one) for name, one in diagnosis.set_aside.items()},
        "noise_floor": 1.0,
        "block": None if diagnosis.averaging is None else diagnosis.averaging.block,
        "ranking": [
            {
                "effect": f.effect,
                "joints": list(f.targets),
                "held_out_before": f.held_out_before,
                "held_out_after": f.held_out_after,
                "parameters": {
                    n: {"value": e.value, "interval": list(e.interval), "unit": e.unit}
                    for n, e in f.parameters.items()
                },
                "confusable_with": list(f.confusable_with),
                "chosen": f.chosen,
                "tentative": f.tentative,
                "too_small": f.too_small,
                "share": f.share,
                **spreads_json(f.spread),
            }
            for f in diagnosis.ranking
        ],
        "effects": {
            name: {
                "verdict": s.verdict,
                "smallest_detectable": max(
                    (size for size in s.smallest_detectable.values() if np.isfinite(size)),
                    default=np.inf,
                ),
                "parameter": s.parameter,
                "unit": s.unit,
                "smallest_detectable_by_target": s.smallest_detectable,
                "experiment": s.experiment,
                "scenario": s.scenario,
                "command": s.command,
            }
            for name, s in diagnosis.effects.items()
        },
        "untested": list(diagnosis.untested),
        "noisy": list(diagnosis.noisy),
        "noisier": list(diagnosis.noisier),
        "refuted": [{"effect": f.effect, "joints": list(f.targets)} for f in diagnosis.refuted],
        "left_out": [
            {"start": d.start, "end": d.end, "rows": list(d.rows)} for d in diagnosis.disturbances
        ],
        "unexplained": [
            {"row": u.row, "ratio": u.ratio, "variable": u.variable, "share": u.share}
            for u in diagnosis.unexplained
        ],
    }
