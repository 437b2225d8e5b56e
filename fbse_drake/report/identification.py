"""The report of identified inertial parameters."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

from fbse_drake.discrepancy.diagnosis.identify import Identification, identifiability_text
from fbse_drake.discrepancy.identification.inertial import PARAMETERS, BaseParameter
from fbse_drake.effects.inertia import InertialParameters
from fbse_drake.report.discrepancy_figures import spaced, targets_text
from fbse_drake.report.discrepancy_tables import spread_tables
from fbse_drake.report.html import (
    Details,
    FigureBlock,
    Report,
    Section,
    Step,
    Table,
    number,
    write_report,
)
from fbse_drake.report.identification_figures import combinations, errors_by_joint
from fbse_drake.report.sentences import Inputs, parameters_text
from fbse_drake.scenario import dump_scenario

BASE_HEADER = ("combination", "unit", "model", "identified", "95 % interval", "known to")
ERROR_HEADER = ("log", "joint", "model as given [%]", "identified [%]")
_BASE_TEXT = (
    "What this log tells apart. “Known to” is the standard deviation as a share of what a body of "
    "this size has, if what is left over were white noise; intervals respect that it is not."
)
_BODIES_TEXT = (
    "One of the many sets of values that have these combinations: the one nearest to the model "
    "that some distribution of mass has. First moments and rotational inertia are about the "
    "origin of the body's frame. Where “known to” is near 100 % the value is that of the model."
)

_COMBINATIONS_CAPTION = (
    "As the model has them, and as identified with 95 % intervals. Where an interval does not "
    "reach the model's mark, the log contradicts the model."
)
_ERRORS_CAPTION = "What is left of the torque, by log; “train” is the one that was fitted."


def base_row(base: BaseParameter) -> tuple[str, ...]:
    """A combination under `BASE_HEADER`."""
    return _row(base.text, base.unit, base.model, base.value, base.interval, base.uncertainty)


def _row(
    name: str,
    unit: str,
    model: float,
    value: float,
    interval: tuple[float, float],
    uncertainty: float,
) -> tuple[str, ...]:
    """What is known of a parameter or of a combination, under `BASE_HEADER`."""
    low, high = interval
    # Three digits of what is not known of it; what is less is rounding.
    digits = max(0, 3 - math.ceil(math.log10(high - low))) if 0.0 < high - low < math.inf else 6
    known = [f"{round(x, digits) + 0.0:.{digits}f}" for x in (model, value, low, high)]
    return (
        name,
        unit.replace(" ", "\N{NO-BREAK SPACE}"),
        *known[:2],
        " to ".join(known[2:]),
        f"{number(100 * uncertainty, 2)} %",
    )


def base_table(result: Identification) -> Table:
    """Combinations of inertial parameters that a log tells apart, with the first of each alone."""
    rows = ((base.short, *base_row(base)[1:]) for base in result.inertia.base_parameters)
    return Table(BASE_HEADER, tuple(rows))


def errors_table(result: Identification) -> Table:
    """Relative errors of all joints together, then of each joint, by log."""
    rows = []
    for name, after in result.after.items():
        before = result.before[name]
        rows.append((name, "all joints", 100 * before.relative, 100 * after.relative))
        for joint, share in after.relative_by_joint.items():
            rows.append((name, joint, 100 * before.relative_by_joint[joint], 100 * share))
    return Table(ERROR_HEADER, tuple(rows))


def _headed(table: Table) -> Table:
    """The table as it stands in a report, its header in capitals."""
    return replace(table, header=tuple(name[:1].upper() + name[1:] for name in table.header))


def identification_outcome(result: Identification) -> str:
    """The result in one sentence."""
    before, after = (errors["train"].relative for errors in (result.before, result.after))
    return (
        f"The relative torque error falls from {100 * before:.1f} % to {100 * after:.1f} % with "
        "identified inertia and plain friction."
    )


def write_identification_report(path: str | Path, result: Identification, inputs: Inputs) -> None:
    """Writes what was identified as one HTML file.

    Args:
        inputs: what was identified, and where the results lie.
    """
    name = inputs.name
    inertia = result.inertia
    bodies = []
    for k, body in enumerate(inertia.bodies):
        for j, parameter in enumerate(PARAMETERS):
            unit, model = InertialParameters.parameters[parameter].unit, inertia.model[k, j]
            value, width = model + inertia.change[k, j], inertia.half_width[k, j]
            between, share = (value - width, value + width), inertia.uncertainty[k, j]
            bodies.append(_row(f"{body} {parameter}", unit, model, value, between, share))
    plain = [f for f in result.findings if f.effect != InertialParameters.__name__]
    friction = Table(
        ("Effect", "In", "Values"),
        tuple((spaced(f.effect), targets_text(f.targets), parameters_text(f)) for f in plain),
    )
    sections = (
        Section("What can be known", identifiability_text(inertia)),
        Section(
            "Combinations",
            _BASE_TEXT,
            (
                _headed(
                    Table(BASE_HEADER, tuple(base_row(base) for base in inertia.base_parameters))
                ),
            ),
            (FigureBlock("Combinations", _COMBINATIONS_CAPTION, partial(combinations, result)),)
            if inertia.base_parameters
            else (),
        ),
        Section("Friction", tables=(friction, *spread_tables(plain))),
        Section(
            "Errors",
            "|residual| / |torque|, 2-norms.",
            (_headed(errors_table(result)),),
            (FigureBlock("Errors by joint", _ERRORS_CAPTION, partial(errors_by_joint, result)),),
        ),
        Section(
            "Bodies",
            _BODIES_TEXT,
            (
                _headed(
                    Table(
                        ("parameter", *BASE_HEADER[1:]),
                        tuple(bodies),
                        "All parameters of all bodies.",
                        folded=True,
                    )
                ),
            ),
        ),
        Section(
            "Scenario",
            details=(Details("With all this in its model", dump_scenario(result.scenario, name)),),
        ),
    )
    write_report(
        path,
        Report(
            f"{name}: inertial parameters",
            True,
            identification_outcome(result),
            sections,
            (
                Step(
                    "Try the completed model on a log that it has not seen:",
                    f"fbse compare {inputs.out}/completed.yaml ANOTHER_LOG",
                ),
            ),
        ),
    )
