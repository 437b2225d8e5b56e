"""Diagnoses that name nothing which data set aside speaks against.

Blocks that are held out of one log lie between those that are fitted. A law of position or of time
that only mimics a motion which is repeated holds there as well; in another motion it does not. What
is found is fitted to none of the data set aside: that can take a name away, it cannot add one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from fbse_drake.discrepancy.diagnosis.add import add
from fbse_drake.discrepancy.diagnosis.diagnose import (
    Diagnosis,
    EffectStatus,
    Finding,
    diagnose,
    plausible_effects,
)
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.experiment import Experiments
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.validation import LEVEL, validated
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.inertia import InertialParameters
from fbse_drake.progress import Interrupted, Progress, silent

# How often it is searched without what was refuted.
_MOST_SEARCHES = 3


def diagnose_confirmed(
    predictor: Predictor,
    effects: Iterable[type[Effect]] | None = None,
    tests: Mapping[str, Predictor] | None = None,
    *,
    progress: Progress = silent,
    dictionary: Dictionary | None = None,
    experiments: Experiments | None = None,
) -> Diagnosis:
    """A diagnosis as by `diagnose`, without effects that raise the error of data set aside.

    Args:
        tests: the predictor's model over logs set aside, by name.
        dictionary, experiments: see `diagnose`.
    """
    tried = plausible_effects(predictor) if effects is None else list(effects)
    # Planned once for all searches.
    experiments = experiments or Experiments(predictor.scenario)
    diagnosis = diagnose(
        predictor, tried, progress=progress, dictionary=dictionary, experiments=experiments
    )
    refuted: dict[str, tuple[Finding, ...]] = {}
    statuses: dict[str, EffectStatus] = {}
    for _ in range(_MOST_SEARCHES):
        try:
            found = refuted_by(diagnosis.completing, tests or {}, progress)
        except Interrupted as stop:
            return replace(diagnosis, partial=str(stop))
        if diagnosis.partial is not None or not found:
            break
        refuted |= found
        statuses |= {
            name: replace(diagnosis.effects[name], verdict="absent")
            for name in found
            if name in diagnosis.effects
        }
        tried = [effect for effect in tried if effect.__name__ not in refuted]
        diagnosis = diagnose(predictor, tried, progress=progress, experiments=experiments)
    together = tuple(finding for findings in refuted.values() for finding in findings)
    return replace(diagnosis, effects=diagnosis.effects | statuses, refuted=together)


def refuted_by(
    findings: Sequence[Finding],
    tests: Mapping[str, Predictor],
    progress: Progress = silent,
) -> dict[str, tuple[Finding, ...]]:
    """Of several effects those without which the error on a log is smaller beyond doubt, all else
    being equal; by name.

    Intervals are simultaneous, over effects and logs (Bonferroni). Inertia is measured, and no
    effect of its own.

    Args:
        tests: the model without them over these logs, by name.
    """
    names = dict.fromkeys(f.effect for f in findings if f.effect != InertialParameters.__name__)
    if len(names) < 2 or not tests:
        return {}
    level = 1 - (1 - LEVEL) / (len(names) * len(tests))
    whole = {log: of.of(add(of.scenario, findings)) for log, of in tests.items()}
    refuted: dict[str, tuple[Finding, ...]] = {}
    for k, name in enumerate(names):
        progress("testing what was found on data set aside", k / len(names))
        others = [f for f in findings if f.effect != name]
        changes = (
            validated(of.of(add(of.scenario, others)), whole[log], level).change
            for log, of in tests.items()
        )
        if any(change.interval[0] > 1.0 for change in changes):
            refuted[name] = tuple(f for f in findings if f.effect == name)
    return refuted
