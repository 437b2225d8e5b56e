"""Identifies inertial parameters together with plain friction: the textbook fit, without a search
for what else may be missing."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fbse_drake.discrepancy.diagnosis.add import add
from fbse_drake.discrepancy.diagnosis.diagnose import (
    Finding,
    finding_of,
    inertia_findings,
)
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.diagnosis.refinement import consistent, remeasured
from fbse_drake.discrepancy.diagnosis.search import root_mean_square
from fbse_drake.discrepancy.diagnosis.spread import spreads, spreads_json
from fbse_drake.discrepancy.diagnosis.validation import ModelError, model_error
from fbse_drake.discrepancy.identification.inertial import PARAMETERS, IdentifiedInertia
from fbse_drake.effects.inertia import InertialParameters
from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.progress import Progress, silent
from fbse_drake.scenario import Scenario


@dataclass(frozen=True)
class Identification:
    """Inertial parameters of bodies and friction of joints, and what they bring."""

    inertia: IdentifiedInertia
    # Friction and bias of each joint, then the changes of each body's inertia.
    findings: tuple[Finding, ...]
    # By log, `train` being the one that was fitted: errors of the model as given, and of the
    # identified one.
    before: dict[str, ModelError]
    after: dict[str, ModelError]
    # Root mean square of the residual in multiples of the sensors' noise: on held-out blocks, and
    # on those that were fitted.
    held_out_rmse: float
    train_rmse: float
    # With all that in its model.
    scenario: Scenario


def identify(
    scenario: Scenario,
    log: Log,
    tests: Mapping[str, Log] | None = None,
    *,
    progress: Progress = silent,
) -> Identification:
    """Identifies the inertial parameters that a scenario does not trust, with friction and bias of
    every joint.

    Args:
        tests: logs that are not fitted, by name.
        progress: is told what is being done.

    Raises:
        InputError: a log that does not fit the scenario, or shows nothing of the inertia; or a
            scenario that trusts all of it.
    """
    if not scenario.identify.inertia:
        raise InputError(
            "identify.inertia: names no body, so there is nothing to identify (as in "
            "identify: {inertia: [all]})"
        )
    progress("predicting what each parameter would do")
    predictor = Predictor(scenario, log)
    dictionary = Dictionary(predictor, [], progress)
    if dictionary.inertia is None:
        raise InputError(
            "identify.inertia: this log shows nothing of the inertia of these bodies, beside the "
            "noise that is believed of its sensors"
        )
    fits = remeasured(Fits(dictionary))
    raw, alone = fits.white.sse, fits.explain([])
    progress("fitting plain friction")
    fitted, inertia = consistent(fits, Proposals(fits).plain_friction())
    assert inertia is not None
    spread = spreads(fits, fitted)
    findings = [
        replace(
            finding_of(fits.white, alone, fitted, member, (), chosen=True),
            spread=spread.get(member, {}),
        )
        for member in fitted.candidates
    ]
    findings += inertia_findings(fits.white, raw, alone, inertia)
    completed = add(scenario, findings)
    given = {"train": predictor}
    given |= {name: Predictor(scenario, other) for name, other in (tests or {}).items()}
    before, after = (
        {name: model_error(other.of(one)) for name, other in given.items()}
        for one in (scenario, completed)
    )
    held_out_rmse, train_rmse = (
        root_mean_square(fits.white, sse) for sse in (fitted.held_out_sse, fitted.sse)
    )
    return Identification(
        inertia, tuple(findings), before, after, held_out_rmse, train_rmse, completed
    )


def identifiability_text(inertia: IdentifiedInertia) -> str:
    """What a log can say of inertial parameters at all, in two sentences."""
    seen, known = (
        len(inertia.base_parameters),
        sum(base.identified for base in inertia.base_parameters),
    )
    text = (
        f"Of {inertia.change.size} inertial parameters of {len(inertia.bodies)} bodies this log "
        f"shows {seen} combinations (condition number {inertia.condition:.3g}), {known} of them to "
        "within a tenth of what a body of this size has; the rest stays with the model."
    )
    if inertia.at_the_edge:
        text += (
            " At the edge of what a distribution of mass can have: "
            f"{', '.join(inertia.at_the_edge)}."
        )
    return text


def identification_json(result: Identification) -> dict[str, Any]:
    """Contents of identify.json."""
    inertia = result.inertia
    units = [InertialParameters.parameters[name].unit for name in PARAMETERS]
    bodies = {}
    for k, body in enumerate(inertia.bodies):
        value = inertia.model[k] + inertia.change[k]
        between = np.stack(
            [value - inertia.half_width[k], value + inertia.half_width[k]], axis=1
        ).tolist()
        bodies[body] = {
            name: {"model": m, "value": v, "interval": i, "uncertainty": u, "unit": unit}
            for name, m, v, i, u, unit in zip(
                PARAMETERS,
                inertia.model[k].tolist(),
                value.tolist(),
                between,
                inertia.uncertainty[k].tolist(),
                units,
                strict=True,
            )
        }
    return {
        "identifiability": {
            "parameters": inertia.change.size,
            "combinations": len(inertia.base_parameters),
            "identified": sum(base.identified for base in inertia.base_parameters),
            "condition": inertia.condition,
            "at_the_edge": list(inertia.at_the_edge),
        },
        "base_parameters": [
            {
                "combination": base.text,
                "factors": [
                    {"body": body, "parameter": name, "factor": factor}
                    for (body, name), factor in {
                        (base.body, base.parameter): 1.0,
                        **base.others,
                    }.items()
                ],
                "model": base.model,
                "value": base.value,
                "interval": list(base.interval),
                "uncertainty": base.uncertainty,
                "unit": base.unit,
            }
            for base in inertia.base_parameters
        ],
        "bodies": bodies,
        "friction": [
            {
                "effect": f.effect,
                "joints": list(f.targets),
                "parameters": {
                    name: {"value": e.value, "interval": list(e.interval), "unit": e.unit}
                    for name, e in f.parameters.items()
                },
                **spreads_json(f.spread),
            }
            for f in result.findings
            if f.effect != InertialParameters.__name__
        ],
        "errors": {
            name: {
                "relative_before": result.before[name].relative,
                "relative_after": result.after[name].relative,
                "relative_by_joint_before": result.before[name].relative_by_joint,
                "relative_by_joint_after": result.after[name].relative_by_joint,
            }
            for name in result.after
        },
    }
