"""Adds what a diagnosis found to a scenario's model."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from fbse_drake.discrepancy.diagnosis.diagnose import Estimate, Finding
from fbse_drake.discrepancy.diagnosis.written import written_diagnosis
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.inertia import InertialParameters
from fbse_drake.effects.surplus import without_surplus
from fbse_drake.errors import InputError
from fbse_drake.robot.description import load_description
from fbse_drake.scenario import Scenario


def read_findings(diagnosis: Mapping[str, Any], effect: str | None = None) -> list[Finding]:
    """What there is to add according to a diagnosis.json.

    Args:
        diagnosis: its contents.
        effect: which effect of the ranking, on the targets where it explains most; by default all
            that the diagnosis chose, and what is tentative.

    Raises:
        InputError: these are not such contents, the ranking has no such effect, or there is nothing
            to add.
    """
    ranking = [
        Finding(
            entry.effect,
            tuple(entry.joints),
            np.nan if entry.held_out_before is None else entry.held_out_before,
            np.nan if entry.held_out_after is None else entry.held_out_after,
            # Bounds that were null are infinite by now.
            {
                name: Estimate(p.value, cast(tuple[float, float], tuple(p.interval)), p.unit)
                for name, p in entry.parameters.items()
            },
            tuple(entry.confusable_with),
            entry.chosen,
            entry.tentative,
        )
        for entry in written_diagnosis(diagnosis).ranking
    ]
    named = [finding for finding in ranking if effect in (None, finding.effect)]
    completing = [finding for finding in named if finding.chosen or finding.tentative]
    findings = completing or (named[:1] if effect else [])
    if not findings:
        names = ", ".join(dict.fromkeys(finding.effect for finding in ranking)) or "none"
        wanted = f"no effect {effect}" if effect else "no effect to add"
        raise InputError(f"the diagnosis has {wanted} (effects in its ranking: {names})")
    return findings


def add(scenario: Scenario, findings: Sequence[Finding]) -> Scenario:
    """The scenario with further effects in its model. What its own joint effects have too much of
    is taken from them.

    Raises:
        InputError: an effect that the library does not have.
    """
    by_effect: dict[str, dict[str, dict[str, float]]] = {}
    for finding in settled(findings):
        values = by_effect.setdefault(finding.effect, {})
        for name, estimate in finding.parameters.items():
            values.setdefault(name, {}).update(dict.fromkeys(finding.targets, estimate.value))
    model = scenario.believed
    effects = dict(model.effects)
    names, _ = load_description(model.description)
    for name, values in by_effect.items():
        effect = _make(name, values)
        if isinstance(effect, InertialParameters):
            earlier = {
                key: other
                for key, other in effects.items()
                if isinstance(other, InertialParameters)
            }
            effect = sum(earlier.values(), effect)
            effects = {key: other for key, other in effects.items() if key not in earlier}
        effects, beside = without_surplus(effects, effect, names)
        if beside is not None:
            effects[_free_key(name, effects)] = beside
    return replace(scenario, model=replace(model, effects=effects))


def settled(findings: Sequence[Finding]) -> list[Finding]:
    """Findings with the values that a model gets. A velocity of transition of which the data do not
    say that the default is wrong keeps it: friction must hold a joint at rest also where nobody saw
    how steep it is."""
    # Inertia was fitted beside just these values.
    if any(finding.effect == InertialParameters.__name__ for finding in findings):
        return list(findings)
    result = []
    for finding in findings:
        kind, estimate = library().get(finding.effect), finding.parameters.get("transition")
        if kind is not None and estimate is not None:
            default = vars(kind())["transition"]["all"]
            if estimate.interval[0] <= default <= estimate.interval[1]:
                kept = {"transition": replace(estimate, value=default)}
                finding = replace(finding, parameters={**finding.parameters, **kept})
        result.append(finding)
    return result


def _make(name: str, values: Mapping[str, Mapping[str, float]]) -> Effect:
    kind = library().get(name)
    if kind is None:
        raise InputError(f"the library has no effect {name} (there are: {', '.join(library())})")
    if not values or set(values) - set(kind.parameters):
        expected, found = ", ".join(kind.parameters), ", ".join(values) or "none"
        raise InputError(f"effect {name}: expected the parameters {expected}; found {found}")
    targets = list(next(iter(values.values())))
    if not targets or any(list(numbers) != targets for numbers in values.values()):
        raise InputError(f"effect {name}: its parameters are not of the same joints")
    return kind.from_values(
        targets,
        {
            parameter: [numbers[target] for target in targets]
            for parameter, numbers in values.items()
        },
    )


def _free_key(name: str, taken: Mapping[str, Effect]) -> str:
    """A key for an effect, as `torque_gain`, that is not taken."""
    key = re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
    number = 2
    while key in taken:
        key, number = f"{key.rstrip('0123456789_')}_{number}", number + 1
    return key
