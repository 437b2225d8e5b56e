"""The reports of compare, diagnose and study."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from platform import python_version

import numpy as np

from fbse_drake.discrepancy.diagnosis.compare import Channel, Comparison, words
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, EffectStatus, Estimate, Finding
from fbse_drake.discrepancy.diagnosis.disturbance import Disturbance
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import Study, StudyStep
from fbse_drake.discrepancy.diagnosis.validation import Measured, Validation
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene
from fbse_drake.discrepancy.identification.structure import Structure
from fbse_drake.discrepancy.residual.residual import joint_velocity_noise
from fbse_drake.effects.effect import library
from fbse_drake.log import Log
from fbse_drake.report import discrepancy_figures as figures
from fbse_drake.report.discrepancy_figures import by_effect, finding_name, spaced, targets_text
from fbse_drake.report.html import (
    Details,
    FigureBlock,
    Report,
    Section,
    Table,
    number,
    write_report,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import Scenario, dump_scenario

# Pictures show this many of the worst channels, of alternatives, and of joints' torques; and of a log this many averages.
_CHANNELS = 4
_ALTERNATIVES = 8
_JOINTS = 6
_SHOWN = 500
# Tables show this many failures, others are folded away.
_FAILURES = 8
# So many rows of a disturbance are named.
_DISTURBED = 3


@dataclass(frozen=True)
class Inputs:
    """What was compared, in the words of the command line, for the commands that a report proposes."""

    # Of the scenario.
    name: str
    scenario: str
    logs: tuple[str, ...]
    # Folder of the results.
    out: str
    # Further logs to test on.
    tests: tuple[str, ...] = ()
    # What is remarkable about the log.
    hygiene: Hygiene = field(default_factory=Hygiene)


def write_compare_report(
    path: str | Path, comparison: Comparison, predictor: Predictor, inputs: Inputs
) -> None:
    """Writes where a model fails as one HTML file."""
    outcome = inputs.hygiene.before(compare_outcome(comparison))
    rows = (
        ("Error of the whole residual", _times_noise(comparison.rmse)),
        (
            "Is it a mere offset?",
            f"A constant taken off every channel leaves {_times_noise(comparison.held_out_rmse)} on held-out data.",
        ),
        ("Where it fails", _kinds(comparison)),
        (
            "What to do next",
            f"fbse diagnose {inputs.scenario} {' '.join(inputs.logs)}"
            if comparison.failures
            else "Nothing: there is nothing to explain.",
        ),
    )
    sections = [
        _summary(rows),
        _where(comparison, predictor),
        _hygiene(predictor, inputs),
        _reproduce("compare", predictor, inputs),
    ]
    write_report(
        path,
        Report(
            f"{inputs.name}: model against log", not comparison.failures, outcome, tuple(sections)
        ),
    )


def write_diagnosis_report(
    path: str | Path,
    diagnosis: Diagnosis,
    comparison: Comparison,
    predictor: Predictor,
    inputs: Inputs,
) -> None:
    """Writes which effects a model lacks as one HTML file.

    Args:
        comparison: of the model as it is.
    """
    outcome, statuses = (
        inputs.hygiene.before(diagnosis_outcome(diagnosis)),
        _applicable(diagnosis.effects),
    )
    rows = (
        *_on_set_aside(diagnosis.set_aside),
        (
            "How sure",
            how_sure(
                diagnosis.chosen,
                diagnosis.held_out_before,
                diagnosis.held_out_after,
                diagnosis.train_after,
                partial=diagnosis.partial is not None,
            ),
        ),
        (
            "What else it could be",
            _what_else(diagnosis.chosen, partial=diagnosis.partial is not None),
        ),
        *_too_small(diagnosis.too_small),
        ("What was looked for", _verdicts(statuses)),
        ("What to do next", next_step(diagnosis, inputs)),
    )
    sections = [
        _summary(rows),
        _where(comparison, predictor),
        *_why([diagnosis.chosen], diagnosis.ranking, diagnosis.unexplained),
        _what_was_looked_for(statuses),
        *_path(diagnosis, predictor.robot),
        _hygiene(predictor, inputs),
        _reproduce("diagnose", predictor, inputs),
    ]
    passed = (
        diagnosis.partial is None
        and diagnosis.verdict in _PASSED
        and _is_confirmed(diagnosis.set_aside)
    )
    write_report(
        path,
        Report(f"{inputs.name}: what is missing in the model", passed, outcome, tuple(sections)),
    )


def write_study_report(
    path: str | Path,
    study: Study,
    before: tuple[Predictor, Comparison],
    after: tuple[Predictor, Comparison],
    inputs: Inputs,
    tests: Mapping[str, Log] | None = None,
) -> None:
    """Writes how a model was completed as one HTML file.

    Args:
        before, after: the model as it was, and with all that was added, against the log.
        tests: logs that nothing was fitted to, by name.
    """
    first, last, statuses = study.steps[0], study.steps[-1], _statuses(study)
    rows = (
        *_on_set_aside(study.set_aside),
        *_relative_fall(study),
        ("Why it stopped there", _sentence(study.stopped_because)),
        (
            "How sure",
            how_sure(
                study.found,
                first.held_out_rmse,
                last.held_out_rmse,
                last.train_rmse,
                partial=study.partial,
            ),
        ),
        ("What else it could be", _what_else(study.found, partial=study.partial)),
        *_too_small(study.diagnoses[-1].too_small),
        ("What was looked for", _verdicts(statuses)),
        ("What to do next", _after_study(study, inputs)),
    )
    completed = dump_scenario(study.scenario, inputs.name) if study.found else None
    sections = [
        _summary(rows),
        _where(before[1], before[0]),
        *_why(
            [step.added for step in study.steps[1:]],
            study.diagnoses[0].ranking,
            study.diagnoses[-1].unexplained,
        ),
        _what_was_looked_for(statuses),
        *([_fall(study, before, after, tests or {})] if study.found else []),
        _hygiene(before[0], inputs),
        _reproduce("study", before[0], inputs, completed),
    ]
    passed = (
        not study.partial
        and study.diagnoses[-1].verdict in _PASSED
        and _is_confirmed(study.set_aside)
    )
    write_report(
        path,
        Report(
            f"{inputs.name}: the missing physics",
            passed,
            inputs.hygiene.before(study_outcome(study)),
            tuple(sections),
        ),
    )


def compare_outcome(comparison: Comparison) -> str:
    """The result of a comparison in one sentence."""
    if not comparison.failures:
        return f"No failure above the noise: the model's error is {number(comparison.rmse)} times that of the sensors."
    channels = len({failure.row.name for failure in comparison.failures})
    return (
        f"The model's error is {number(comparison.rmse)} times the sensors' noise and stands out in {channels} of "
        f"{len(comparison.channels)} channels. Worst: {comparison.failures[0].text}."
    )


def diagnosis_outcome(diagnosis: Diagnosis) -> str:
    """The verdict in one or two sentences."""
    if diagnosis.partial is not None:
        return f"Partial: {diagnosis.partial} before the search was through. {_partly(diagnosis)}"
    parts = [_verdict(diagnosis)]
    parts += [_disturbed(one) for one in diagnosis.disturbances]
    if _disagreement(diagnosis.chosen):
        parts.append(_disagreement(diagnosis.chosen))
    if diagnosis.averaging is not None and diagnosis.averaging.text:
        parts.append(diagnosis.averaging.text)
    return _headline(" ".join(parts), diagnosis.set_aside)


def failures_table(comparison: Comparison) -> Table:
    """Where the model fails, in words."""
    shown = comparison.failures[:_FAILURES]
    return Table(("failure, worst first",), tuple((failure.text,) for failure in shown))


def findings_table(findings: Sequence[Finding]) -> Table:
    """Findings with their values; what was not chosen stands in brackets."""
    header = ("effect", "in", "held-out error before", "after", "values (95 % interval)")
    rows = (
        (
            spaced(finding.effect) if finding.chosen else f"({spaced(finding.effect)})",
            targets_text(finding.targets),
            number(finding.held_out_before),
            number(finding.held_out_after),
            parameters_text(finding),
        )
        for finding in findings[:_FAILURES]
    )
    return Table(header, tuple(rows))


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


def _headline(result: str, set_aside: Mapping[str, Validation]) -> str:
    """A result with what it is worth on data that was set aside; if that is nothing, it comes first."""
    refuted = {name: one for name, one in set_aside.items() if one.course != "falls"}
    confirmed = {name: one for name, one in set_aside.items() if one.course == "falls"}
    before = [f"Not confirmed: {_course(name, one)}." for name, one in refuted.items()]
    after = [f"{_sentence(_course(name, one))}" for name, one in confirmed.items()]
    return " ".join([*before, result, *after])


_COURSES = {
    "falls": "the error falls",
    "rises": "the error rises",
    "unclear": "the error does not fall beyond doubt",
}


def _course(log: str, validation: Validation) -> str:
    """As `on the rest of the log, which was set aside, the error falls from 4.20 to 0.99 (0.95 to 1.03) times the sensors' noise`."""
    before, after = validation.before, validation.after
    text = (
        f"on {_set_aside_name(log)}, which was set aside, {_COURSES[validation.course]}: from {number(before.value)} to "
        f"{number(after.value)} ({_between(after, 1.0)}) times the sensors' noise"
    )
    if np.isfinite(validation.relative_after.value):
        shares = validation.relative_before, validation.relative_after
        text += f", from {number(100 * shares[0].value)} to {number(100 * shares[1].value)} % ({_between(shares[1], 100.0)}) of the torque"
    return text


def _between(measured: Measured, factor: float) -> str:
    """As `0.95 to 1.03`."""
    low, high = (factor * bound for bound in measured.interval)
    return f"{number(low)} to {number(high)}" if np.isfinite(high) else "too short for an interval"


def _set_aside_name(log: str) -> str:
    return f"the {log}" if log == "rest of the log" else log


def _on_set_aside(set_aside: Mapping[str, Validation]) -> list[tuple[str, str]]:
    """What data that was set aside says, as a row of the summary."""
    if not set_aside:
        return []
    texts = [
        f"{_sentence(_course(name, one))} That is {number(one.change.value)} ({_between(one.change, 1.0)}) of it."
        for name, one in set_aside.items()
    ]
    return [("On data set aside", " ".join([*texts, "Intervals are 95 %, by batch means."]))]


def _is_confirmed(set_aside: Mapping[str, Validation]) -> bool:
    return all(one.course == "falls" for one in set_aside.values())


_SPREAD_HEADER = ("Effect", "In", "Parameter", "By recording (95 % interval)", "Between", "Agree")


def _spread_rows(findings: Sequence[Finding]) -> list[tuple[str, ...]]:
    """How far recordings that were fitted together agree in what was found; see `_SPREAD_HEADER`."""
    rows = []
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


def _disturbed(disturbance: Disturbance) -> str:
    """As `Something acted on left knee pitch from 3.21 to 3.43 s, once; that was left out.`"""
    rows = _enumerated([words(row) for row in disturbance.rows[:_DISTURBED]])
    more = len(disturbance.rows) - _DISTURBED
    return (
        f"Something acted on {rows}{f' and {more} more rows' if more > 0 else ''} from "
        f"{disturbance.start:.2f} to {disturbance.end:.2f} s and not again; that was left out of the fit."
    )


def _disagreement(findings: Sequence[Finding]) -> str:
    """Says of which findings recordings do not agree; empty if they do."""
    unlike = [f for f in findings if any(s.differs for s in f.spread.values())]
    return f"The recordings do not agree in {_listed(unlike)}." if unlike else ""


def _too_small(findings: Sequence[Finding]) -> list[tuple[str, str]]:
    if not findings:
        return []
    return [
        (
            "Too small to matter",
            f"{_listed(findings)}: at most {100 * max(f.share for f in findings):.2g} % of what these rows are made of.",
        )
    ]


def _partly(diagnosis: Diagnosis) -> str:
    """What is known of a search that ended early."""
    if not diagnosis.chosen:
        return "Nothing was found until then; that rules nothing out."
    return f"Until then it seems that the model lacks {_listed(diagnosis.chosen)}; rivals were not compared."


def _verdict(diagnosis: Diagnosis) -> str:
    found = _listed(diagnosis.chosen)
    if diagnosis.verdict == "effect_found":
        doubtful = dict.fromkeys(
            name for finding in diagnosis.chosen for name in finding.confusable_with
        )
        return f"The model lacks {found}{f'; this log cannot tell that from {_either(doubtful)}' if doubtful else ''}."
    if diagnosis.verdict == "nothing_missing":
        return f"Nothing is missing: what the model leaves over is the sensors' noise ({number(diagnosis.held_out_before)} times it)."
    if diagnosis.verdict == "not_visible":
        statuses = _applicable(diagnosis.effects)
        hidden = sum(status.verdict == "not_visible" for status in statuses.values())
        return f"This log cannot tell whether something is missing: {hidden} of {len(statuses)} effects would not show in it."
    known = f" The model also lacks {found}." if found else ""
    return f"{_unexplained(diagnosis)}{known}"


def _unexplained(diagnosis: Diagnosis) -> str:
    places = ", ".join(
        f"{words(left.row)} (follows {left.variable})" for left in diagnosis.unexplained
    )
    return f"Something is missing that no effect of the library explains, in {places}."


def study_outcome(study: Study) -> str:
    """The result of a study in one or two sentences."""
    if study.partial and not study.diagnoses[-1].partial:
        return f"Partial: {study.stopped_because}. {_study_result(study)}"
    if study.partial and study.found:
        return f"Partial: {study.stopped_because} before the search was through. {_study_result(study)}"
    return _study_result(study)


def _study_result(study: Study) -> str:
    if not study.found:
        return diagnosis_outcome(study.diagnoses[-1])
    result = f"The model lacked {_listed(study.found)}."
    if study.set_aside:
        result = _headline(result, study.set_aside)
    else:
        first, last = study.steps[0], study.steps[-1]
        course = "falls" if last.held_out_rmse < first.held_out_rmse else "rises"
        result += (
            f" With it, the held-out error {course} from {number(first.held_out_rmse)} to {number(last.held_out_rmse)} times "
            "the sensors' noise; no data was set aside to test that."
        )
    if study.diagnoses[-1].verdict == "unknown_effect":
        result += f" {_unexplained(study.diagnoses[-1])}"
    return result


def how_sure(
    found: Sequence[Finding], before: float, after: float, train: float, *, partial: bool = False
) -> str:
    """What supports a verdict.

    Args:
        before, after, train: error on blocks held out in turn without and with what was found, and
            on the data that it was fitted to, in multiples of the sensors' noise.
        partial: the search ended before it was through.
    """
    if found:
        return (
            f"On blocks that were held out in turn, the error of all channels falls from {number(before)} to {number(after)} times the "
            f"sensors' noise ({number(train)} on the data that it was fitted to). Noise alone brings a finding once in a thousand logs."
        )
    nothing = (
        "nothing was found by then" if partial else "no effect makes it smaller on held-out data"
    )
    return f"The error of all channels is {number(before)} times the sensors' noise, and {nothing}."


def next_step(diagnosis: Diagnosis, inputs: Inputs) -> str:
    """What to do, with the command."""
    steps = _experiments_next(diagnosis, diagnosis.chosen)
    if diagnosis.chosen:
        steps.append(
            f"Add it to the model: fbse add {inputs.scenario} {inputs.out} --out {inputs.name}_completed.yaml"
        )
    return (
        " ".join(steps)
        or "Nothing. A motion that loads and moves the joints more would show smaller effects."
    )


def _after_study(study: Study, inputs: Inputs) -> str:
    last = study.diagnoses[-1]
    if not study.found:
        return next_step(last, inputs)
    steps = _experiments_next(last, study.found)
    steps.append(
        f"Try the completed model on a log that it has not seen: fbse compare {inputs.out}/completed.yaml ANOTHER_LOG"
    )
    return " ".join(steps)


def _experiments_next(diagnosis: Diagnosis, found: Sequence[Finding]) -> list[str]:
    """What to look at and which experiments to make."""
    statuses = _applicable(diagnosis.effects)
    doubtful = {name: statuses[name] for finding in found for name in finding.confusable_with}
    steps = []
    if diagnosis.partial is not None:
        steps.append("Let it look for longer: the same command with more time.")
    elif diagnosis.verdict == "unknown_effect":
        steps.append(
            "Look at the pictures of the channels that are left, and register an effect of your own that looks like them."
        )
    if doubtful:
        steps.append(f"To tell them apart: {_experiments(doubtful)}")
    if diagnosis.partial is None and diagnosis.verdict == "not_visible":
        hidden = {
            name: status for name, status in statuses.items() if status.verdict == "not_visible"
        }
        steps.append(f"Record a motion that shows more: {_experiments(hidden)}")
    return steps


def parameter_text(name: str, estimate: Estimate) -> str:
    """As `coulomb 1.02 Nm (0.98 to 1.06)`."""
    low, high = estimate.interval
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    return f"{words(name)} {estimate.value:.3g}{unit} ({low:.3g} to {high:.3g})"


def parameters_text(finding: Finding) -> str:
    """All parameters with their 95 % intervals."""
    return ", ".join(
        parameter_text(name, estimate) for name, estimate in finding.parameters.items()
    )


def _times_noise(value: float) -> str:
    return f"{number(value)} times the sensors' noise"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _listed(findings: Sequence[Finding]) -> str:
    """Effects and where, as `Coulomb friction and torque bias in left knee pitch and body mass in trunk`; for the inside of a sentence."""
    by_place: dict[tuple[str, ...], list[str]] = {}
    for effect, targets in by_effect(findings).items():
        by_place.setdefault(tuple(targets), []).append(effect)
    return _enumerated([_effects_in(effects, targets) for targets, effects in by_place.items()])


def _enumerated(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)


# Effects that are called after somebody.
_NAMES = ("Coulomb", "Stribeck", "IMU")


def _effects_in(effects: Sequence[str], targets: Sequence[str]) -> str:
    names = _enumerated([_inside(effect) for effect in effects])
    return (
        names if list(targets) == ["robot"] else f"{names} in {targets_text(targets, effects[0])}"
    )


def _inside(effect: str) -> str:
    """An effect's name inside a sentence."""
    name = spaced(effect)
    return name if name.startswith(_NAMES) else name[0].lower() + name[1:]


def _either(effects: Iterable[str]) -> str:
    return " or ".join(_inside(effect) for effect in effects)


def _what_else(found: Sequence[Finding], *, partial: bool) -> str:
    if partial:
        return "The search ended before other effects of the library were compared."
    equal: dict[tuple[str, ...], list[Finding]] = {}
    for finding in found:
        equal.setdefault(finding.confusable_with, []).append(finding)
    told = [
        f"{_sentence(_either(names))[:-1]} explains this log as well as {_listed(findings)}."
        for names, findings in equal.items()
        if names
    ]
    if told:
        return " ".join(told)
    if not found:
        return "Nothing else in the library: an effect smaller than the sizes below would not have shown."
    return "No other effect of the library explains this log as well."


def _experiments(statuses: dict[str, EffectStatus]) -> str:
    """What would show effects, each experiment once."""
    texts: dict[str, list[str]] = {}
    for name, status in statuses.items():
        command = f" ({status.command})" if status.command else ""
        texts.setdefault(f"{status.experiment.rstrip('.')}{command}.", []).append(spaced(name))
    return " ".join(f"{text} [{', '.join(names)}]" for text, names in texts.items())


def _summary(rows: Sequence[tuple[str, str]]) -> Section:
    return Section("Summary", tables=(Table(("", ""), tuple(rows)),))


_KINDS = {"joint": "joints", "base": "rows of the base", "kinematic": "rows of the soles"}


def _kinds(comparison: Comparison) -> str:
    """How many channels of each kind stand out from the noise."""
    failing = {failure.row.name for failure in comparison.failures}
    counts = {
        kind: [c.row.name in failing for c in comparison.channels if c.row.kind == kind]
        for kind in _KINDS
    }
    return (
        "In "
        + ", ".join(
            f"{sum(fails)} of {len(fails)} {_KINDS[kind]}"
            for kind, fails in counts.items()
            if fails
        )
        + "."
    )


def _applicable(statuses: Mapping[str, EffectStatus]) -> dict[str, EffectStatus]:
    """Effects that there is a place for on this robot: an arm has no feet."""
    return {name: status for name, status in statuses.items() if status.smallest_detectable}


def _statuses(study: Study) -> dict[str, EffectStatus]:
    """What all rounds together say of every effect: the last one, but for what was found before and what stood for it as well."""
    found = {finding.effect for finding in study.found}
    equal = {name for finding in study.found for name in finding.confusable_with}
    return {
        name: replace(
            status,
            verdict="present"
            if name in found
            else "confusable"
            if name in equal
            else status.verdict,
        )
        for name, status in _applicable(study.diagnoses[-1].effects).items()
    }


def _verdicts(statuses: Mapping[str, EffectStatus]) -> str:
    """How many effects of the library have each verdict."""
    if not statuses:
        return "The search ended before it could say what else there is."
    verdicts = [status.verdict for status in statuses.values()]
    counts = ", ".join(
        f"{verdicts.count(name)} {words(name)}"
        for name in figures.VERDICT_COLORS
        if name in verdicts
    )
    return f"{len(verdicts)} effects: {counts}. Absent means that it would have been seen."


def _where(comparison: Comparison, predictor: Predictor) -> Section:
    """Where the model fails: in words, on the robot, against each variable and over time."""
    robot, residual, motion = predictor.robot, predictor.residual, predictor.motion
    known = [channel for channel in comparison.channels if not np.isnan(channel.rmse)]
    if robot.description.legs:
        drawn = figures.robot_errors(robot, comparison, motion.blocks.joint_position.mean(axis=0))
        blocks = [FigureBlock("Error over noise, by joint and by phase", _BY_PHASE, drawn)]
    else:
        blocks = (
            [FigureBlock("Error over noise, by joint", _RATIOS, figures.channel_errors(known))]
            if len(known) > 1
            else []
        )
    worst = _worst(comparison)
    # A short log has no bins.
    if binned := [channel for channel in worst if figures.binned_variables(channel)]:
        blocks.append(
            FigureBlock(
                "The worst channels against what they may depend on",
                "Mean error in bins. Where the interval is narrow and away from zero, the error follows that variable; where it is "
                "wide, the error depends on something else. A positive error means that the model's torque (or force) is too low.",
                figures.error_bins(binned),
            )
        )
    if worst:
        blocks += [
            FigureBlock(
                "The worst channels over time",
                f"Averages over {number(1e3 * motion.length * motion.period)} ms. Inside the grey band is what sensor noise explains.",
                figures.errors_over_time(residual, robot.description.sides, worst),
            ),
        ]
    text = _METHOD if comparison.failures else f"{_METHOD} No failure above the noise."
    return Section(
        "Where the model fails",
        text,
        (*_failure_tables(comparison), _channel_table(known)),
        tuple(blocks),
    )


def _worst(comparison: Comparison) -> list[Channel]:
    by_name = {channel.row.name: channel for channel in comparison.channels}
    return [
        by_name[name] for name in dict.fromkeys(failure.row.name for failure in comparison.failures)
    ][:_CHANNELS]


# Verdicts that a report calls a success.
_PASSED = ("effect_found", "nothing_missing")
_METHOD = (
    "The recorded motion is put into the model's equation of motion. What it leaves over, the residual, is what the model does not "
    "explain; it stands beside the noise that the sensors must put into it."
)
_RATIOS = "Root mean square of what the equation of motion leaves over, in multiples of the sensors' noise: about 1 is noise alone."
_BY_PHASE = (
    f"{_RATIOS} No joint effect can show in the base's channels: what does is mass, foot sensor, IMU or contact. The soles' channels "
    "are the motion of feet that stand."
)


def _failure_tables(
    comparison: Comparison, caption: str = "What stands out from the noise, in words."
) -> list[Table]:
    """The worst failures, and the others folded away."""
    rows = tuple(
        (
            f.text,
            f.where.error,
            "\u00a0to\u00a0".join(map(_short, f.where.interval)),
            f.where.noise_floor,
            f.row.unit,
        )
        for f in comparison.failures
    )
    header = ("Failure, worst first", "Mean error", "95 % interval", "Noise in it", "Unit")
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


def _channel_table(channels: Sequence[Channel]) -> Table:
    rows = [
        (
            words(c.row.name),
            c.rmse,
            c.noise_floor,
            c.row.unit,
            c.rmse / c.noise_floor,
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
    caption = "All channels. The relative error is that beside a model without any forces, which has 100 %."
    return Table(header, tuple(rows), caption, folded=True)


def _why(
    rounds: Sequence[Sequence[Finding]],
    alternatives: Sequence[Finding],
    unexplained: Sequence[Structure],
) -> list[Section]:
    """What was found in each round, with its values and the alternatives, and what is left without an explanation."""
    chosen = [finding for found in rounds for finding in found]
    others = [finding for finding in alternatives if not finding.chosen][:_ALTERNATIVES]
    of_round = [f", round {k}" * (k > 1) for k, found in enumerate(rounds, start=1) for _ in found]
    tables, blocks = _value_tables(rounds), []
    if unexplained:
        rows = tuple((words(u.row), u.ratio, u.variable, 100 * u.share) for u in unexplained)
        header = ("Left over in", "Error over noise", "Follows most", "Which explains [%]")
        tables.append(
            Table(
                header,
                rows,
                "What no effect of the library explains, and the variable that it follows.",
            )
        )
    if chosen or others:
        caption = (
            "Error on held-out data of the channels that an effect moves, without it and with it, everything else being equal. "
            "The broken line is the sensors' noise. An alternative stands in the place of what was chosen."
        )
        names = [
            f"{finding_name(f)}{when}"
            for f, when in zip(chosen + others, of_round + [""] * len(others), strict=True)
        ]
        blocks.append(
            FigureBlock(
                "What explains the error", caption, figures.ranking([*chosen, *others], names)
            )
        )
    tables += spread_tables(chosen)
    valued = [
        (finding, f"{targets_text(finding.targets, finding.effect)}{when}")
        for finding, when in zip(chosen, of_round, strict=True)
        if finding.parameters
    ]
    if valued:
        caption = "With their 95 % intervals, which respect what is left of correlation in time."
        blocks.append(FigureBlock("Fitted values", caption, figures.parameters(valued)))
    text = (
        ""
        if chosen
        else "No effect of the library makes the error smaller on data that it was not fitted to."
    )
    return [Section("Why it fails", text, tuple(tables), tuple(blocks))] if tables or blocks else []


def _value_tables(rounds: Sequence[Sequence[Finding]]) -> list[Table]:
    """A table for each effect: its values where it was found. What a later round finds in the same place comes on top."""
    known = library()
    where: dict[str, list[tuple[int, Finding]]] = {}
    for number_of, found in enumerate(rounds, start=1):
        for finding in found:
            where.setdefault(finding.effect, []).append((number_of, finding))
    several = len(rounds) > 1
    tables = []
    for effect, findings in where.items():
        rows = []
        for number_of, finding in findings:
            values = map(_value_text, finding.parameters.values())
            errors = (finding.held_out_before, finding.held_out_after)
            place = (targets_text(finding.targets, effect), *([str(number_of)] * several))
            rows.append((*place, *values, *errors, _either(finding.confusable_with) or "no other"))
        units = [
            f"{words(name)} [{estimate.unit}]"
            for name, estimate in findings[0][1].parameters.items()
        ]
        header = (
            "In",
            *(["Round"] * several),
            *units,
            "Held-out error / noise before",
            "after",
            "Explains as much",
        )
        says = [f"{spaced(effect)}."] + (
            [known[effect].description, known[effect].signature] if effect in known else []
        )
        tables.append(Table(header, tuple(rows), f"{' '.join(says)} Values with 95 % intervals."))
    return tables


def _value_text(estimate: Estimate) -> str:
    low, high = map(_short, estimate.interval)
    return f"{_short(estimate.value)} [{low},\u00a0{high}]"


def _short(value: float) -> str:
    """A number for a narrow column; very small and very large ones with an exponent. With a minus sign, at which no line breaks."""
    text = number(value) if value == 0 or 1e-4 <= abs(value) < 1e5 else f"{value:.2e}"
    return text.replace("-", "\N{MINUS SIGN}")


def _what_was_looked_for(statuses: Mapping[str, EffectStatus]) -> Section:
    """What the data says of every effect of the library."""
    known = library()
    rows = []
    for name, status in statuses.items():
        reach = f"{words(status.parameter)} {_reach(status, name)}"
        does = known[name].description if name in known else ""
        show = f"{status.experiment} ({status.command})" if status.command else status.experiment
        rows.append((spaced(name), words(status.verdict), reach, does, show))
    header = (
        "Effect",
        "Verdict",
        "Smallest that would have been seen",
        "What it is",
        "What shows it",
    )
    block = FigureBlock(
        "What this log can show",
        "How small an effect could be and still be found, against what is plausible on a robot of this kind. What lies in the grey area is "
        "not visible in this log, which is not the same as absent.",
        figures.detectability(statuses),
    )
    order = [words(verdict) for verdict in figures.VERDICT_COLORS]
    table = Table(
        header,
        tuple(sorted(rows, key=lambda row: order.index(row[1]))),
        "All effects of the library, one by one",
        folded=True,
    )
    return Section("What else was looked for", _verdicts(statuses), (table,), (block,))


def _reach(status: EffectStatus, effect: str) -> str:
    """Smallest sizes that the data would have shown, and where it would have shown none that is plausible."""
    known = library().get(effect)
    largest = (
        np.inf
        if known is None
        else max(abs(bound) for bound in known.parameters[status.parameter].plausible)
    )
    sizes = [size for size in status.smallest_detectable.values() if size <= largest]
    hidden = [target for target, size in status.smallest_detectable.items() if not size <= largest]
    low, high = (f"{bound:.2g}" for bound in (min(sizes, default=0), max(sizes, default=0)))
    unit = "" if status.unit == "1" else f" {status.unit}"
    shown = [f"{low if low == high else f'{low} to {high}'}{unit}"] if sizes else []
    return "; ".join([*shown, *([f"none in {targets_text(hidden)}"] if hidden else [])])


_FALLING = "Root mean square of what the equation of motion leaves over, on stretches of the log that the values were not fitted to."


def _fall(
    study: Study,
    before: tuple[Predictor, Comparison],
    after: tuple[Predictor, Comparison],
    tests: Mapping[str, Log],
) -> Section:
    """What the completed model brings: step by step, by channel, over time; and what it leaves."""
    robot, (first, last) = before[0].robot, (study.steps[index].rollout for index in (0, -1))
    rolled = first is not None and last is not None
    simulated = " Below: the model with everything added so far is simulated in the place of the robot; its joints against the log's."
    channels = zip(before[1].channels, after[1].channels, strict=True)
    known = [
        (given, completed)
        for given, completed in channels
        if not np.isnan([given.rmse, completed.rmse]).any()
    ]
    blocks = [
        FigureBlock(
            "The error, step by step",
            _FALLING + (simulated if rolled else ""),
            figures.falling_error(study.steps, _moves(robot)),
        )
    ]
    if len(known) > 1:
        drawn = figures.channel_errors(*map(list, zip(*known, strict=True)))
        blocks.append(FigureBlock("Every channel, before and after", _RATIOS, drawn))
    blocks += _measured_torque(study.scenario, before[0], tests)
    if rolled and len(first.sample_time) and len(last.sample_time):
        caption = "Simulated less recorded position of the joints that the model as given misses most, over the whole log."
        blocks.append(
            FigureBlock(
                "The simulated model, before and after",
                caption,
                figures.position_errors(first, last, robot.torque_units),
            )
        )
    if worst := _worst(after[1]):
        caption = "Mean error of the completed model in bins of what it may depend on."
        blocks.append(
            FigureBlock(
                "What is left, against what it may depend on", caption, figures.error_bins(worst)
            )
        )
    left = _failure_tables(
        after[1], "What the completed model leaves: what still stands out from the noise, in words."
    )
    text = "" if left else "What the completed model leaves does not stand out from the noise."
    return Section(
        "How the error falls",
        text,
        (
            _step_table(study.steps, robot),
            *_relative_errors(study),
            *_simulated_positions(study, robot),
            *left,
        ),
        tuple(blocks),
    )


def _relative_fall(study: Study) -> list[tuple[str, str]]:
    """The relative error of all torques together, before and after, as a row of the summary."""
    first, last = study.steps[0].errors, study.steps[-1].errors
    falls = [
        f"on {_log_name(name)} {number(100 * error.relative)} % before, {number(100 * last[name].relative)} % after"
        for name, error in first.items()
        if np.isfinite(error.relative)
    ]
    return [("Relative torque error", _sentence("; ".join(falls)))] if falls and study.found else []


def _log_name(name: str) -> str:
    return "the log that was fitted" if name == "train" else f"{name} (not fitted)"


def _relative_errors(study: Study) -> list[Table]:
    """Relative errors of the model as given and completed, by joint, on the log that was diagnosed and on others."""
    first, last = study.steps[0].errors, study.steps[-1].errors
    if not any(np.isfinite(error.relative) for error in first.values()):
        return []
    joints = next(iter(first.values())).relative_by_joint
    rows = [
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
        header += [f"{_sentence(_log_name(name))[:-1]}: as given [%]", "completed [%]"]
    return [
        Table(
            tuple(header),
            tuple(rows),
            "Relative errors |residual| / |measured torque|, 2-norms over each log.",
        )
    ]


def _measured_torque(
    completed: Scenario, given: Predictor, tests: Mapping[str, Log]
) -> list[FigureBlock]:
    """Measured and modelled torque of the worst joints where the model as given errs most, on a log that nothing was fitted to if any."""
    name, log = next(iter(tests.items()), ("train", given.motion.log))
    given, after = Predictor(given.scenario, log), Predictor(completed, log)
    residual, n = given.residual, len(given.robot.joint_names)
    error = np.where(residual.known, residual.value / np.sqrt(residual.variance), np.nan)[:, :n]
    power = np.nan_to_num(error**2)
    worst = np.argsort(-power.sum(axis=0))[:_JOINTS]
    places = sorted(int(joint) for joint in worst if residual.known[:, joint].any())
    if not places:
        return []
    stretch = _worst_stretch(power[:, places].sum(axis=1))
    time = residual.time[stretch]
    part = (
        ", the part in which the model as given errs most" if len(time) < len(residual.time) else ""
    )
    caption = (
        f"What the motors gave, and what the model needs for the same motion; {number(float(time[-1] - time[0]), 2)} s of {_log_name(name)}"
        f"{part}. Right above each panel: |error| / |measured| there (2-norms)."
    )
    drawn = figures.torques_over_time(residual, after.residual, places, stretch)
    return [FigureBlock("Measured torque and the model's, before and after", caption, drawn)]


def _worst_stretch(power: np.ndarray) -> slice:
    """The `_SHOWN` averages in a row with the largest sum."""
    total = np.concatenate([[0.0], np.cumsum(power)])
    length = min(_SHOWN, len(power))
    start = int(np.argmax(total[length:] - total[:-length]))
    return slice(start, start + length)


def _path(diagnosis: Diagnosis, robot: Robot) -> list[Section]:
    """How the error falls on the way to a diagnosis."""
    if len(diagnosis.path) < 2:
        return []
    steps, taken = [], frozenset()
    for step in diagnosis.path:
        added = tuple(
            Finding(*member, np.nan, np.nan, {}, (), chosen=True)
            for member in sorted(step.members - taken)
        )
        steps.append(StudyStep(added, step.held_out_rmse, step.train_rmse, rollout=None))
        taken = step.members
    text = (
        "Effects were added one after the other, each the one that leaves least on held-out data."
    )
    block = FigureBlock(
        "The error as effects are added", _FALLING, figures.falling_error(steps, _moves(robot))
    )
    return [Section("How the error falls", text, (_step_table(steps, robot),), (block,))]


def _moves(robot: Robot) -> str:
    """Unit of small motions of its joints."""
    return ", ".join(dict.fromkeys("mrad" if unit == "Nm" else "mm" for unit in robot.torque_units))


def _simulated_positions(study: Study, robot: Robot) -> list[Table]:
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
    caption = "The model simulated in the place of the robot: errors of its positions; the relative one is |error| / |position|, 2-norms."
    return [Table(header, tuple(rows), caption)]


def _step_table(steps: Sequence[StudyStep], robot: Robot) -> Table:
    """Errors step by step, and those of the simulated model where it was simulated."""
    header = ["Added", "Held-out error / noise", "Fitted error / noise"]
    rows = [
        [
            _sentence(_listed(s.added)) if s.added else "The model as given.",
            s.held_out_rmse,
            s.train_rmse,
        ]
        for s in steps
    ]
    if any(step.rollout is not None for step in steps):
        header += [
            f"Simulated joints, RMS [{_moves(robot)}]",
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
        tuple(header), tuple(map(tuple, rows)), "Errors as the model grows, over all channels."
    )


def _hygiene(predictor: Predictor, inputs: Inputs) -> Section:
    """What was measured, and how it was read."""
    motion, robot, standing = predictor.motion, predictor.robot, predictor.motion.standing
    time, recording = motion.log.time, predictor.scenario.recording
    length = f"{number(float(time[-1] - time[0]))} s, {len(time)} samples, {number(1 / motion.period)} Hz"
    if recording.train_share < 1:
        length += f"; the first {number(100 * recording.train_share, 2)} % of the log, the rest is to test on"
    rows = [
        ("Log", ", ".join(inputs.logs)),
        ("Length", length),
        (
            "Samples that are missing",
            f"{number(100 * float(1 - motion.measured.mean()), 2)} %; nothing is said about the gaps",
        ),
        ("Joints", ", ".join(map(words, robot.joint_names))),
        (
            "Joint velocities",
            recording.velocity if "joint/velocity" in motion.log else "differenced from the angles",
        ),
        ("Low-pass without delay", f"{recording.cutoff:g} Hz" if recording.cutoff > 0 else "none"),
        ("Sensor noise that is believed", _noise_text(predictor)),
        (
            "Averages over",
            f"{number(1e3 * motion.length * motion.period)} ms; {len(motion.time)} of them",
        ),
    ]
    if robot.has_floating_base:
        share = {
            side: 100 * float(standing[:, k].mean())
            for k, side in enumerate(robot.description.sides)
        }
        rows.append(
            (
                "Share of time that a foot stands",
                ", ".join(f"{side} {number(value, 2)} %" for side, value in share.items()),
            )
        )
    found = tuple(
        (finding.severity, _sentence(finding.text)) for finding in inputs.hygiene.findings
    )
    noise = tuple(
        (words(level.channel), level.level, level.believed, level.unit)
        for level in inputs.hygiene.noise
    )
    tables = [
        Table(("", ""), tuple(rows)),
        *([Table(("Severity", "What is remarkable"), found)] if found else []),
        *(
            [Table(("Channel", "White noise of a sample", "Believed", "Unit"), noise)]
            if noise
            else []
        ),
    ]
    text = "What was measured, and how it was read." + (
        "" if found else " Nothing about it is remarkable."
    )
    return Section("Data hygiene", text, tables=tuple(tables))


def _reproduce(
    command: str, predictor: Predictor, inputs: Inputs, completed: str | None = None
) -> Section:
    """The command that makes this report again, and what it ran on."""
    packages = ", ".join(
        f"{name} {version(name)}" for name in ("fbse_drake", "drake", "numpy", "scipy")
    )
    rows = [("Software", f"Python {python_version()}, {packages}")]
    for log in map(Path, inputs.logs):
        if log.is_file():
            of = "the log" if len(inputs.logs) == 1 else log.name
            rows.append((f"SHA-256 of {of}", sha256(log.read_bytes()).hexdigest()))
    again = [
        f"fbse {command} {inputs.out}/scenario.yaml {' '.join(inputs.logs)}",
        *(f"--test {test}" for test in inputs.tests),
        f"--out {inputs.out}_again",
    ]
    believed = dump_scenario(predictor.scenario, inputs.name)
    details = [
        Details("Command", " ".join(again), folded=False),
        Details(
            "The scenario as it was believed: sensors, and the model with its effects", believed
        ),
    ]
    if completed is not None:
        details.append(Details("The scenario with the completed model", completed))
    return Section("Reproduce this", tables=(Table(("", ""), tuple(rows)),), details=tuple(details))


def _noise_text(predictor: Predictor) -> str:
    sensors, robot = predictor.scenario.sensors, predictor.robot
    imu, rotary = sensors.imu, "Nm" in robot.torque_units
    parts = [f"joint velocity {joint_velocity_noise(sensors):.2g} {'rad/s' if rotary else 'm/s'}"]
    if robot.has_floating_base:
        parts += [
            f"accelerometer {imu.acceleration_noise:g} m/s²",
            f"gyroscope {imu.angular_velocity_noise:g} rad/s",
        ]
        parts += [f"foot forces {sensors.foot_force.noise:g} N"]
    unit = "Nm" if rotary else "N"
    parts += [
        f"torque of {words(joint)} {value:g} {unit}"
        for joint, value in predictor.scenario.recording.torque_noise.items()
    ]
    return ", ".join(parts)
