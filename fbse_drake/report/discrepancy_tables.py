"""What was found, in tables."""

from collections.abc import Sequence

import numpy as np

from fbse_drake.discrepancy.diagnosis.compare import Channel, Comparison, words
from fbse_drake.discrepancy.diagnosis.diagnose import EffectStatus, Estimate, Finding
from fbse_drake.discrepancy.diagnosis.study import Study, StudyStep
from fbse_drake.effects.effect import Effect, library
from fbse_drake.report.discrepancy_figures import (
    by_effect,
    small_motions,
    spaced,
    targets_text,
)
from fbse_drake.report.html import (
    Cell,
    Table,
    number,
)
from fbse_drake.report.sentences import (
    as_sentence,
    either_effect,
    listed_effects,
    parameter_text,
    parameters_text,
)
from fbse_drake.robot.plant import Robot

# Tables show this many failures, others are folded away.
_FAILURES = 8
# A row of a table of findings tells of so many values one by one, and of more their range.
_MOST_VALUES = 18

_SPREAD_HEADER = ("Effect", "In", "Parameter", "By recording (95 % interval)", "Between", "Agree")


def failures_table(comparison: Comparison) -> Table:
    """Where the model fails, in words."""
    shown = comparison.failures[:_FAILURES]
    return Table(("failure, worst first",), tuple((failure.text,) for failure in shown))


def findings_table(findings: Sequence[Finding]) -> Table:
    """Findings with their values; what is not part of the explanation stands in brackets.

    One effect that was found in several places is one row, with the values of each, or, where
    these are many, with their range.
    """
    header = ("effect", "in", "held-out error before", "after", "values (95 % interval)")
    groups: dict[object, list[Finding]] = {}
    for k, finding in enumerate(findings):
        is_alternative = not (finding.chosen or finding.tentative)
        key = k if is_alternative else (finding.effect, finding.tentative)
        groups.setdefault(key, []).append(finding)
    shown = list(groups.values())[:_FAILURES]
    known, named = library(), dict.fromkeys(group[0].effect for group in shown)
    meanings = {name: parameters_explained(known[name]) for name in named if name in known}
    caption = " ".join(f"{spaced(name)}: {text}." for name, text in meanings.items() if text)
    return Table(header, tuple(_findings_row(group) for group in shown), caption)


def _findings_row(group: Sequence[Finding]) -> tuple[str, ...]:
    """Of findings of one effect."""
    effect = group[0].effect
    targets = by_effect(group)[effect]
    values = [parameters_text(finding) for finding in group]
    if sum(len(finding.parameters) for finding in group) > _MOST_VALUES:
        values = _spans_of_values(group)
    elif len(group) > 1:
        places = (targets_text(finding.targets, effect) for finding in group)
        values = [f"{place}: {text}" for place, text in zip(places, values, strict=True) if text]
    return (
        _with_role(spaced(effect), group[0]),
        targets_text(targets, effect),
        *(
            _span([getattr(finding, name) for finding in group])
            for name in ("held_out_before", "held_out_after")
        ),
        "; ".join(values),
    )


def _with_role(name: str, finding: Finding) -> str:
    """The name of an effect with what it is of the explanation."""
    if finding.tentative:
        return f"{name}, tentative"
    return name if finding.chosen else f"({name})"


def _spans_of_values(group: Sequence[Finding]) -> list[str]:
    """As `mass -0.196 to 11.3 kg`, for each parameter."""
    by_name: dict[str, list[Estimate]] = {}
    for finding in group:
        for name, estimate in finding.parameters.items():
            by_name.setdefault(name, []).append(estimate)
    return [
        f"{words(name)} {_span([e.value for e in estimates])} {estimates[0].unit}"
        for name, estimates in by_name.items()
    ]


def _span(values: Sequence[float]) -> str:
    """As `1.62`, or `1.62 to 3.71`."""
    least, most = number(min(values)), number(max(values))
    return least if least == most else f"{least} to {most}"


def steps_table(study: Study, *, tested: bool) -> Table:
    """What was added, step by step, and the errors that were left.

    Args:
        tested: also says the relative errors on the logs that the model was tested on.
    """
    first = study.steps[0].errors
    logs = [name for name in first if np.isfinite(first[name].relative)] if tested else []
    header = ("added", "held-out error / noise", "fitted error / noise")
    rows = []
    for step in study.steps:
        effects = (
            f"{spaced(effect)} ({targets_text(targets)})"
            for effect, targets in by_effect(step.added).items()
        )
        shares = (f"{100 * step.errors[name].relative:.2f} %" for name in logs)
        added = ", ".join(effects) or "the model as given"
        rows.append((added, number(step.held_out_rmse), number(step.train_rmse), *shares))
    return Table((*header, *(f"relative error, {name}" for name in logs)), tuple(rows))


def _spread_rows(findings: Sequence[Finding]) -> list[tuple[str, ...]]:
    """How far recordings that were fitted together agree in what was found; see
    `_SPREAD_HEADER`."""
    rows: list[tuple[str, ...]] = []
    for finding in findings:
        for name, spread in finding.spread.items():
            unit = finding.parameters[name].unit
            each = [
                f"{log}: {parameter_text('', Estimate(own.value, own.interval, unit)).strip()}"
                for log, own in spread.by_log.items()
            ]
            agree = f"no (p = {spread.probability:.1g})" if spread.differs else "yes"
            place = targets_text(finding.targets, finding.effect)
            between = f"{spread.between:.2g}{'' if unit == '1' else f' {unit}'}"
            rows.append(
                (spaced(finding.effect), place, words(name), "; ".join(each), between, agree)
            )
    return rows


def spread_tables(findings: Sequence[Finding]) -> list[Table]:
    """For a report; none if one recording was fitted."""
    rows = _spread_rows(findings)
    caption = (
        "Each recording fitted alone. Between: standard deviation of the value from recording to "
        "recording, beyond its own uncertainty (DerSimonian and Laird); they agree unless "
        "Cochran's Q is as large as chance makes it once in a thousand times."
    )
    return [Table(_SPREAD_HEADER, tuple(rows), caption)] if rows else []


def all_failure_tables(
    comparison: Comparison, caption: str = "What stands out from the noise, in words."
) -> list[Table]:
    """The worst failures, and the others folded away."""
    rows = tuple(
        (
            f.text,
            f.where.error,
            "\u00a0to\u00a0".join(map(_short, f.where.interval)),
            f.row.unit,
        )
        for f in comparison.failures
    )
    header = ("Failure, worst first", "Mean error", "95 % interval", "Unit")
    tables = [Table(header, rows[:_FAILURES], caption)] if rows else []
    more = rows[_FAILURES:]
    return (
        [
            *tables,
            Table(
                header,
                more,
                f"{len(more)} more {'failures' if len(more) > 1 else 'failure'}",
                folded=True,
            ),
        ]
        if more
        else tables
    )


def channel_table(channels: Sequence[Channel]) -> Table:
    """The error of every channel, by phase."""
    rows = [
        (
            words(c.row.name),
            c.rmse,
            c.noise_floor,
            c.row.unit,
            "" if np.isnan(c.ratio) else c.ratio,
            "" if np.isnan(c.nrmse) else 100 * c.nrmse,
        )
        for c in channels
    ]
    header = (
        "Channel",
        "Error, RMS",
        "Noise, RMS",
        "Unit",
        "Error over noise",
        "Relative error [%]",
    )
    caption = (
        "All channels. The relative error is that beside a model without any "
        "forces, which has 100 %."
    )
    return Table(header, tuple(rows), caption, folded=True)


def value_tables(rounds: Sequence[Sequence[Finding]]) -> list[Table]:
    """A table for each effect: its values where it was found. What a later round finds in the same
    place comes on top."""
    known = library()
    where: dict[str, list[tuple[int, Finding]]] = {}
    for number_of, found in enumerate(rounds, start=1):
        for finding in found:
            where.setdefault(finding.effect, []).append((number_of, finding))
    several = len(rounds) > 1
    tables = []
    for effect, findings in where.items():
        rows: list[tuple[Cell, ...]] = []
        for number_of, finding in findings:
            values = map(_value_text, finding.parameters.values())
            errors = (finding.held_out_before, finding.held_out_after)
            place = (targets_text(finding.targets, effect), *([str(number_of)] * several))
            rows.append((*place, *values, *errors, _explaining_as_much(finding)))
        units = [
            f"{words(name)} [{estimate.unit}]"
            for name, estimate in findings[0][1].parameters.items()
        ]
        header = (
            "In",
            *(["Round"] * several),
            *units,
            "Held-out error / noise before",
            "Held-out error / noise after",
            "Explains as much",
        )
        says = [f"{spaced(effect)}."]
        if effect in known:
            says += [known[effect].description, known[effect].signature]
            if meanings := parameters_explained(known[effect]):
                says.append(f"Here {meanings}.")
        tables.append(Table(header, tuple(rows), f"{' '.join(says)} Values with 95 % intervals."))
    return tables


def _explaining_as_much(finding: Finding) -> str:
    others = either_effect(finding.confusable_with)
    if finding.tentative:
        return f"{others}, or something else" if others else "maybe something else"
    return others or "no other"


def parameters_explained(effect: type[Effect]) -> str:
    """What its parameters are, where their names do not say it; "" where they do."""
    meanings = [
        f"{name} is {one.meaning}" for name, one in effect.parameters.items() if one.meaning
    ]
    return "; ".join(meanings)


def _value_text(estimate: Estimate) -> str:
    low, high = map(_short, estimate.interval)
    return f"{_short(estimate.value)} [{low},\u00a0{high}]"


def _short(value: float) -> str:
    """A number for a narrow column; very small and very large ones with an exponent. With a minus
    sign, at which no line breaks."""
    text = number(value) if value == 0 or 1e-4 <= abs(value) < 1e5 else f"{value:.2e}"
    return text.replace("-", "\N{MINUS SIGN}")


def reach_text(status: EffectStatus) -> str:
    """Smallest sizes that the data would have shown, and where it would have shown none that is
    plausible."""
    hidden = [target for target, share in status.over_plausible.items() if not share <= 1.0]
    sizes = [size for target, size in status.smallest_detectable.items() if target not in hidden]
    low, high = (f"{bound:.2g}" for bound in (min(sizes, default=0), max(sizes, default=0)))
    unit = "" if status.unit == "1" else f" {status.unit}"
    shown = [f"{low if low == high else f'{low} to {high}'}{unit}"] if sizes else []
    return "; ".join([*shown, *([f"none in {targets_text(hidden)}"] if hidden else [])])


def log_name(name: str) -> str:
    """A log for reading: that which was fitted, or one that was not."""
    return "the log that was fitted" if name == "train" else f"{name} (not fitted)"


def relative_error_tables(study: Study) -> list[Table]:
    """Relative errors of the model as given and completed, by joint, on the log that was diagnosed
    and on others."""
    first, last = study.steps[0].errors, study.steps[-1].errors
    if not any(np.isfinite(error.relative) for error in first.values()):
        return []
    joints = next(iter(first.values())).relative_by_joint
    rows: list[tuple[Cell, ...]] = [
        (
            words(joint),
            *(
                100 * errors[name].relative_by_joint[joint]
                for name in first
                for errors in (first, last)
            ),
        )
        for joint in joints
    ]
    if len(rows) > 1:
        rows.append(
            (
                "all joints",
                *(100 * errors[name].relative for name in first for errors in (first, last)),
            )
        )
    header = ["Joint"]
    for name in first:
        header += [f"{as_sentence(log_name(name))[:-1]}: as given [%]", "completed [%]"]
    return [
        Table(
            tuple(header),
            tuple(rows),
            "Relative errors |residual| / |measured torque|, 2-norms over each log.",
        )
    ]


def simulated_position_tables(study: Study, robot: Robot) -> list[Table]:
    """How far the simulated model is from the log, as given and completed, by joint."""
    first, last = study.steps[0].rollout, study.steps[-1].rollout
    if first is None or last is None or not first.relative_position:
        return []
    rows = [
        (
            words(joint),
            "mrad" if unit == "Nm" else "mm",
            *(1e3 * error.position[joint] for error in (first, last)),
            *(1e3 * error.mean_absolute_position[joint] for error in (first, last)),
            *(100 * error.relative_position[joint] for error in (first, last)),
        )
        for joint, unit in zip(robot.joint_names, robot.torque_units, strict=True)
    ]
    header = (
        "Joint",
        "Unit",
        "RMS, as given",
        "completed",
        "Mean |error|, as given",
        "completed",
        "Relative [%], as given",
        "completed",
    )
    caption = (
        "The model simulated in the place of the robot: errors of its positions; the relative one "
        "is |error| / |position|, 2-norms."
    )
    return [Table(header, tuple(rows), caption)]


def growth_table(steps: Sequence[StudyStep], robot: Robot) -> Table:
    """Errors step by step, and those of the simulated model where it was simulated."""
    header = ["Added", "Held-out error / noise", "Fitted error / noise"]
    rows: list[list[Cell]] = [
        [
            as_sentence(listed_effects(s.added)) if s.added else "The model as given.",
            s.held_out_rmse,
            s.train_rmse,
        ]
        for s in steps
    ]
    if any(step.rollout is not None for step in steps):
        header += [
            f"Simulated joints, RMS [{small_motions(robot)}]",
            f"Torques, RMS [{', '.join(dict.fromkeys(robot.torque_units))}]",
            "Simulation",
        ]
        for row, rolled in zip(rows, (step.rollout for step in steps), strict=True):
            if rolled is None:
                row += [np.nan, np.nan, "none"]
            else:
                row += [
                    1e3 * rolled.mean_position,
                    rolled.mean_torque_command,
                    rolled.failure or "complete",
                ]
    return Table(
        tuple(header),
        tuple(tuple(row) for row in rows),
        "Errors as the model grows, over all channels.",
    )
