"""Which physical effect does a model lack? Verdicts from what each effect explains of the held-out residual."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fbse_drake.discrepancy.experiment import Experiments
from fbse_drake.discrepancy.inertial import PARAMETERS, IdentifiedInertia
from fbse_drake.discrepancy.prediction import Predictor
from fbse_drake.discrepancy.regression import WhitenedResidual
from fbse_drake.discrepancy.search import MARGIN, Candidate, Explanation, Search
from fbse_drake.discrepancy.structure import Structure, leftover_structure
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.inertia import InertialParameters
from fbse_drake.effects.joint_torque import JointTorqueEffect

Verdict = Literal["effect_found", "nothing_missing", "unknown_effect", "not_visible"]
EffectVerdict = Literal["present", "absent", "not_visible", "confusable"]
# An effect counts as the explanation of a row if it takes away this share of what exceeds the noise there, and leaves no more than this
# many times the noise.
_EXPLAINED = 0.97
_LARGEST_REST = 5.0
# Bodies lighter than this share of the robot are not suspected.
_LIGHT_BODY = 0.03
# No explanation has more parts than this.
_MOST_EFFECTS = 16


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
    # Root mean square of the held-out residual, in multiples of the sensors' noise, without and with the effect.
    held_out_before: float
    held_out_after: float
    parameters: dict[str, Estimate]
    # Other effects that explain the residual as well.
    confusable_with: tuple[str, ...]
    # Is it part of the explanation, or only an alternative?
    chosen: bool


@dataclass(frozen=True)
class EffectStatus:
    """What this data says about one effect of the library."""

    verdict: EffectVerdict
    # Parameter that says how large the effect is, its unit, and the smallest value that this data would have shown, by target.
    parameter: str
    unit: str
    smallest_detectable: dict[str, float]
    # What would show it; a scenario that would, where one is known.
    experiment: str
    scenario: str | None = None

    @property
    def command(self) -> str | None:
        """The command that makes that experiment, in simulation."""
        return f"fbse simulate {self.scenario} --out out/{self.scenario}" if self.scenario else None


@dataclass(frozen=True)
class Diagnosis:
    """Which effects are missing, and how sure that is."""

    verdict: Verdict
    # Chosen effects, those that explain most first, then alternatives, best first.
    ranking: tuple[Finding, ...]
    effects: dict[str, EffectStatus]
    # What no effect of the library explains: by row.
    unexplained: tuple[Structure, ...]
    # Explanations in the order in which they were found; the first has no effects.
    path: tuple[Explanation, ...]
    # Root mean squares of the whole residual in multiples of the sensors' noise: on held-out data without and with what was chosen, and on
    # the data that it was fitted to.
    held_out_before: float
    held_out_after: float
    train_after: float
    # Inertial parameters that were identified along, of bodies whose own are not trusted; see `IdentifyConfig`.
    inertia: IdentifiedInertia | None = None

    @property
    def chosen(self) -> list[Finding]:
        return [finding for finding in self.ranking if finding.chosen]


def suspected_bodies(predictor: Predictor) -> list[str]:
    """Bodies whose masses the diagnosis tries: those that weigh something."""
    robot = predictor.robot
    total = robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
    return [
        name for name in robot.body_names if robot.body(name).default_mass() > _LIGHT_BODY * total
    ]


def plausible_effects(predictor: Predictor) -> list[type[Effect]]:
    """The library but for what the scenario rules out, and for what acts in the joints of a log without torques."""
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
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Finds the effects that a model lacks.

    Candidates are added one after the other, each the one that leaves the least deviance on held-out data; after every addition each member
    is tried against all others in its place. An effect counts if it beats what chance would bring once in a thousand logs.

    Args:
        effects: what is tried; by default `plausible_effects`.
        progress: called with a word on what is being done.
    """
    say = progress or (lambda _: None)
    say("predicting what each effect would do")
    search = Search(
        predictor,
        plausible_effects(predictor) if effects is None else effects,
        suspected_bodies(predictor),
    )
    before = search.white.sse
    path = select(search, say)
    final, inertia = search.consistent(path[-1])
    say("looking at what is left")
    path[-1], remaining, left = search.added(final)
    final = path[-1]
    unexplained = leftover_structure(predictor.motion, remaining, left)
    say("finding what would have been seen")
    rivals = _rivals(search, final)
    experiments = Experiments(predictor.scenario, suspected_bodies(predictor))
    statuses = {e.__name__: _status(search, final, e, rivals, experiments) for e in search.effects}
    if unexplained and not _well_explained(search.white, final, unexplained):
        verdict: Verdict = "unknown_effect"
    elif final.candidates or (
        inertia is not None and final.deviance < search.white.deviance(search.white.sse) - MARGIN
    ):
        verdict = "effect_found"
    else:
        hidden = sum(status.verdict == "not_visible" for status in statuses.values())
        verdict = "not_visible" if hidden > 0.5 * len(statuses) else "nothing_missing"
    white = search.white
    return Diagnosis(
        verdict,
        (
            *_ranking(search, path, rivals),
            *inertia_findings(search.white, before, path[0], inertia),
        ),
        statuses,
        tuple(unexplained),
        tuple(path),
        *(_rms(white, sse) for sse in (before, final.held_out_sse, final.sse)),
        inertia,
    )


def select(search: Search, say: Callable[[str], None] = lambda _: None) -> list[Explanation]:
    """Explanations by forward selection, from none to the last that improves significantly."""
    path = [search.explain([])]
    if search.inertia is not None:
        path.append(search.doubting(_pruned(search, search.plain_friction())))
        say("fitted inertia and plain friction")
    while len(path[-1].candidates) < _MOST_EFFECTS:
        base = path[-1]
        additions = search.best_additions(base)
        if not additions:
            break
        chosen = _spread(search, additions)
        chosen = _revise(search, chosen)
        say(
            "found " + ", ".join(f"{c.name} ({' and '.join(c.targets)})" for c in chosen.candidates)
        )
        if chosen.deviance > base.deviance - MARGIN:
            break
        path.append(search.polished(search.doubting(chosen)))
    if search.inertia is None:
        path[-1] = _pruned(search, path[-1])
    return path


def _pruned(search: Search, explanation: Explanation) -> Explanation:
    """An explanation without the members that bring no more than chance."""
    for member in explanation.candidates:
        rest = search.explain([c for c in explanation.candidates if c is not member])
        if not search.is_significant(rest, search.explain([*rest.candidates, member]), member):
            explanation = rest
    return explanation


def _spread(search: Search, additions: list[Explanation]) -> Explanation:
    """The best addition, with the same effect on all further joints where nothing else explains more.

    Joints that share values get values of their own if that explains more; then a simpler effect may do as well.
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
            options += [search.explain([*others, *own])] if own else []
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
    return search.explain(chosen) if len(chosen) > len(best.candidates) else best


def _simplest(additions: list[Explanation]) -> Explanation:
    """The best addition; among those that are told apart by nobody, the one with the fewest parameters."""
    equal = [e for e in additions if e.deviance < additions[0].deviance + MARGIN]
    return min(equal, key=lambda e: len(e.fit.parameters))


def _revise(search: Search, explanation: Explanation) -> Explanation:
    """Tries every member that shares a row with another one against all others in its place, until nothing improves."""
    improved = True
    while improved:
        improved = False
        for member in explanation.candidates:
            others = [c for c in explanation.candidates if c is not member]
            rows = member.signature.rows
            if not any(np.intersect1d(rows, c.signature.rows).size for c in others):
                continue
            rest = search.explain(others)
            additions = search.best_additions(rest, rows)
            best = _simplest(additions) if additions else rest
            if best.deviance < explanation.deviance - (MARGIN if additions else 0.0):
                explanation, improved = best, True
                break
    return explanation


def _rivals(search: Search, final: Explanation) -> dict[int, list[Explanation]]:
    """For each member: explanations with another effect in its place, best first; one for each effect and targets."""
    result = {}
    for k, member in enumerate(final.candidates):
        rest = search.explain([c for c in final.candidates if c is not member])
        additions = [
            e
            for e in search.best_additions(rest, member.signature.rows)
            if len(e.candidates) == len(final.candidates)
        ]
        result[k] = [e for e in additions if e.candidates[-1].effect is not member.effect]
    return result


def _rms(white: WhitenedResidual, sse: np.ndarray, rows: np.ndarray | slice = slice(None)) -> float:
    return float(np.sqrt(sse[rows].sum() / max(1, white.count[rows].sum())))


def _ranking(
    search: Search, path: list[Explanation], rivals: dict[int, list[Explanation]]
) -> list[Finding]:
    final, white = path[-1], search.white
    without = [
        search.explain([c for c in final.candidates if c is not member])
        for member in final.candidates
    ]
    findings = []
    for k in sorted(range(len(without)), key=lambda k: -without[k].deviance):
        member, rest = final.candidates[k], without[k]
        equal = tuple(
            dict.fromkeys(e.candidates[-1].name for e in rivals[k] if _equals(search, e, final))
        )
        findings.append(finding_of(white, rest, final, member, equal, chosen=True))
    seen = {(f.effect, f.targets) for f in findings}
    others = sorted(
        (e for alternatives in rivals.values() for e in alternatives), key=lambda e: e.deviance
    )
    for explanation in others:
        member = explanation.candidates[-1]
        if (member.name, member.targets) not in seen:
            seen.add((member.name, member.targets))
            rest = search.explain(explanation.candidates[:-1])
            findings.append(finding_of(white, rest, explanation, member, (), chosen=False))
    return findings


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
        _rms(white, before.held_out_sse, rows),
        _rms(white, after.held_out_sse, rows),
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
        errors = (_rms(white, sse) for sse in (before, alone.held_out_sse))
        findings.append(
            Finding(InertialParameters.__name__, (body,), *errors, parameters, (), chosen=True)
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
    search: Search,
    final: Explanation,
    effect: type[Effect],
    rivals: dict[int, list[Explanation]],
    experiments: Experiments,
) -> EffectStatus:
    parameter = next(iter(effect.parameters))
    smallest = search.smallest_detectable(final, effect)
    scenario = None
    mistaken_for = [
        final.candidates[k]
        for k, alternatives in rivals.items()
        if any(
            e.candidates[-1].effect is effect and _equals(search, e, final) for e in alternatives
        )
    ]
    if any(c.effect is effect for c in final.candidates):
        verdict: EffectVerdict = "present"
    elif mistaken_for:
        verdict = "confusable"
        member = mistaken_for[0]
        scenario = experiments.that_separates(
            member.effect, member.targets, final.values(member)[0], effect
        )
    elif all(size > search.largest_plausible(effect, target) for target, size in smallest.items()):
        verdict = "not_visible"
        scenario = experiments.that_shows(effect)
    else:
        verdict = "absent"
    units = dict.fromkeys(
        search.parameters(effect, target)[parameter].unit for target in smallest
    ) or [effect.parameters[parameter].unit]
    return EffectStatus(
        verdict, parameter, " or ".join(units), smallest, effect.experiment, scenario
    )


def _equals(search: Search, rival: Explanation, final: Explanation) -> bool:
    """Does a rival explain as much? One with fewer parameters does also if chance may have brought what the final explanation has more."""
    more = len(final.fit.parameters) - len(rival.fit.parameters)
    return rival.deviance < final.deviance + (
        search.threshold[min(12, more)] if more > 0 else MARGIN
    )


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Contents of diagnosis.json."""
    return {
        "verdict": diagnosis.verdict,
        "held_out_before": diagnosis.held_out_before,
        "held_out_after": diagnosis.held_out_after,
        "train_after": diagnosis.train_after,
        "noise_floor": 1.0,
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
        "unexplained": [
            {"row": u.row, "ratio": u.ratio, "variable": u.variable, "share": u.share}
            for u in diagnosis.unexplained
        ],
    }
