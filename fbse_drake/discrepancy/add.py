"""Adds what a diagnosis found to a scenario's model."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from fbse_drake.effects.effect import Effect, library
from fbse_drake.errors import InputError
from fbse_drake.scenario import Scenario


def add(scenario: Scenario, diagnosis: Mapping[str, Any], effect: str | None = None) -> Scenario:
    """The scenario with further effects in its model.

    Args:
        diagnosis: contents of diagnosis.json.
        effect: which effect of the ranking, on the targets where it explains most; by default all that the diagnosis chose.

    Raises:
        InputError: the ranking has no such effect, or there is nothing to add.
    """
    try:
        ranking = diagnosis["ranking"]
        if effect is None:
            findings = [finding for finding in ranking if finding["chosen"]]
        else:
            named = [finding for finding in ranking if finding["effect"] == effect]
            findings = [finding for finding in named if finding["chosen"]] or named[:1]
        if not findings:
            names = ", ".join(dict.fromkeys(finding["effect"] for finding in ranking)) or "none"
            wanted = f"no effect {effect}" if effect else "no effect to add"
            raise InputError(f"diagnosis: it has {wanted} (effects in its ranking: {names})")
        by_effect: dict[str, dict[str, dict[str, float]]] = {}
        for finding in findings:
            values = by_effect.setdefault(finding["effect"], {})
            for name, parameter in finding["parameters"].items():
                values.setdefault(name, {}).update({target: float(parameter["value"]) for target in finding["joints"]})
    except (KeyError, TypeError) as error:
        raise InputError(f"diagnosis: not the contents of a diagnosis.json (at {error})") from None
    model = scenario.believed
    effects = dict(model.effects)
    for name, values in by_effect.items():
        effects[_free_key(name, effects)] = _make(name, values)
    return replace(scenario, model=replace(model, effects=effects))


def _make(name: str, values: Mapping[str, Mapping[str, float]]) -> Effect:
    kind = library().get(name)
    if kind is None:
        raise InputError(f"diagnosis: the library has no effect {name} (there are: {', '.join(library())})")
    targets = list(next(iter(values.values())))
    return kind.from_values(targets, {parameter: [numbers[target] for target in targets] for parameter, numbers in values.items()})


def _free_key(name: str, taken: Mapping[str, Effect]) -> str:
    """A key for an effect, as `torque_gain`, that is not taken."""
    key = re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
    number = 2
    while key in taken:
        key, number = f"{key.rstrip('0123456789_')}_{number}", number + 1
    return key
