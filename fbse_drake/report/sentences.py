"""What was found, in sentences: for the terminal, for notebooks and at the head of reports."""

import shlex
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fbse_drake.discrepancy.diagnosis.compare import Comparison, words
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, EffectStatus, Estimate, Finding
from fbse_drake.discrepancy.diagnosis.disturbance import Disturbance
from fbse_drake.discrepancy.diagnosis.rivals import ELSEWHERE
from fbse_drake.discrepancy.diagnosis.study import Study
from fbse_drake.discrepancy.diagnosis.validation import Measured, Validation
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene
from fbse_drake.discrepancy.identification.structure import EXCESS, Structure
from fbse_drake.effects.effect import library
from fbse_drake.report import discrepancy_figures as figures
from fbse_drake.report.discrepancy_figures import (
    by_effect,
    spaced,
    targets_text,
)
from fbse_drake.report.html import Step, number

# So many rows of a disturbance are named, and bodies that one effect may be on.
_DISTURBED, _MOST_PLACES = 3, 2
# What is left in so many joints may be due to how the log is read.
_MANY_JOINTS = 4
# A share of the torque that falls by less than to this does not show what falls.
_SHOWS = 0.99
# What is left follows a variable that explains more than this share of it.
_FOLLOWS = 0.1
# What far more than the sensors' noise is that follows nothing.
_OF_NOTHING = "noise that nobody told of, or impacts, as in a gear with play"

_COURSES = {
    "falls": "the error falls",
    "rises": "the error rises",
    "unclear": "the error does not fall beyond doubt",
}

# Effects that are called after somebody.
_NAMES = ("Coulomb", "Stribeck", "IMU")

_NOTHING = Step(
    "Nothing. A motion that loads and moves the joints more would show smaller effects."
)

_KINDS = {
    "joint": "joints",
    "base": "rows of the base",
    "kinematic": "rows of the soles",
    "transmission": "transmissions",
}


@dataclass(frozen=True)
class Inputs:
    """What was compared, in the words of the command line, for the commands that a report
    proposes."""

    # Of the scenario.
    name: str
    scenario: str
    logs: tuple[str, ...]
    # Folder of the results.
    out: str
    # Options with which the scenario was read (`--name`, `--set`), and the logs (`--map`).
    changes: tuple[str, ...] = ()
    reading: tuple[str, ...] = ()
    # Further logs to test on.
    tests: tuple[str, ...] = ()
    # What is remarkable about the log.
    hygiene: Hygiene = field(default_factory=Hygiene)

    @property
    def changed_scenario(self) -> str:
        """The scenario as it was given."""
        return shlex.join([self.scenario, *self.changes])

    @property
    def diagnose(self) -> str:
        """The command that diagnoses the same."""
        return f"fbse diagnose {self.changed_scenario} {shlex.join([*self.logs, *self.reading])}"


def compare_outcome(comparison: Comparison) -> str:
    """The result of a comparison in one sentence."""
    if not comparison.failures:
        return (
            f"No failure above the noise: the model's error is {number(comparison.rmse)} "
            "times that of the sensors."
        )
    channels = len({failure.row.name for failure in comparison.failures})
    return (
        f"The model's error is {number(comparison.rmse)} times the sensors' noise and stands out "
        f"in {channels} of {len(comparison.channels)} channels. Worst: "
        f"{comparison.failures[0].text}."
    )


def diagnosis_outcome(diagnosis: Diagnosis) -> str:
    """The verdict in one or two sentences."""
    if diagnosis.partial is not None:
        return f"Partial: {diagnosis.partial} before the search was through. {_partly(diagnosis)}"
    parts = [_verdict(diagnosis)]
    parts += [_disturbed(one) for one in diagnosis.disturbances]
    if diagnosis.refuted:
        parts.append(_refuted(diagnosis.refuted))
    if _disagreement(diagnosis.completing):
        parts.append(_disagreement(diagnosis.completing))
    if diagnosis.noisier:
        parts.append(
            f"What is left in {_rows(diagnosis.noisier)} is white and more than is believed of "
            "the sensors' noise: it was taken for noise."
        )
    if diagnosis.averaging is not None and diagnosis.averaging.text:
        parts.append(diagnosis.averaging.text)
    return _headline(" ".join(parts), diagnosis.set_aside)


def _refuted(findings: Sequence[Finding]) -> str:
    """What is not named although it explains the log."""
    text = (
        f"{listed_effects(findings)} would explain more of the log, but raises the error of data "
    )
    return as_sentence(f"{text}that was set aside, and is not named")


def _headline(result: str, set_aside: Mapping[str, Validation]) -> str:
    """A result with what it is worth on data that was set aside; if that is nothing, it comes
    first."""
    told = [(one.refutes, _course(name, one)) for name, one in set_aside.items()]
    before = [f"Not confirmed: {text}." for refutes, text in told if refutes]
    after = [as_sentence(text) for refutes, text in told if not refutes]
    return " ".join([*before, result, *after])


def _course(log: str, validation: Validation) -> str:
    """As `on the rest of the log, which was set aside, the error falls from 4.20 to 0.99 times the
    sensors' noise, which is 0.24 (0.20 to 0.28) of it`."""
    before, after = validation.before, validation.after
    if not validation.tells:
        return (
            f"{_set_aside_name(log)}, which was set aside, shows nothing of it: the error stays "
            f"{number(before.value)} times the sensors' noise"
        )
    text = (
        f"on {_set_aside_name(log)}, which was set aside, {_said_course(validation)}: "
        f"from {number(before.value)} to {number(after.value)} times the sensors' noise, which is "
        f"{number(validation.change.value)} ({_between(validation.change)}) of it"
    )
    shares = validation.relative_before.value, validation.relative_after.value
    # Where that is of other rows, or mostly noise, what falls does not show in it.
    falls = validation.course == "falls"
    if np.isfinite(shares[1]) and (not falls or shares[1] < _SHOWS * shares[0]):
        text += f", and from {number(100 * shares[0])} to {number(100 * shares[1])} % of the torque"
    return text


def _said_course(validation: Validation) -> str:
    if validation.course == "unclear" and not validation.refutes:
        return "the error falls, as far as so short a part can tell"
    return _COURSES[validation.course]


def _between(measured: Measured) -> str:
    """As `0.95 to 1.03`."""
    low, high = measured.interval
    return f"{number(low)} to {number(high)}" if np.isfinite(high) else "too short for an interval"


def _set_aside_name(log: str) -> str:
    return f"the {log}" if log == "rest of the log" else log


def set_aside_rows(set_aside: Mapping[str, Validation]) -> list[tuple[str, str]]:
    """What data that was set aside says, as a row of the summary."""
    if not set_aside:
        return []
    texts = [as_sentence(_course(name, one)) for name, one in set_aside.items()]
    return [("On data set aside", " ".join([*texts, "Intervals are 95 %, by batch means."]))]


def is_refuted(set_aside: Mapping[str, Validation]) -> bool:
    """Does any data that was set aside speak against the model?"""
    return any(one.refutes for one in set_aside.values())


def _disturbed(disturbance: Disturbance) -> str:
    """As `Something acted on left knee pitch from 3.21 to 3.43 s, once; that was left out.`"""
    rows = _rows(disturbance.rows[:_DISTURBED])
    more = len(disturbance.rows) - _DISTURBED
    return (
        f"Something acted on {rows}{f' and {more} more rows' if more > 0 else ''} "
        f"from {disturbance.start:.2f} to {disturbance.end:.2f} s and not again; that "
        "was left out of the fit."
    )


def _disagreement(findings: Sequence[Finding]) -> str:
    """Says of which findings recordings do not agree; empty if they do."""
    unlike = [f for f in findings if any(s.differs for s in f.spread.values())]
    return f"The recordings do not agree in {listed_effects(unlike)}." if unlike else ""


def too_small_rows(findings: Sequence[Finding]) -> list[tuple[str, str]]:
    """What is too small to matter, as a row of the summary."""
    if not findings:
        return []
    return [
        (
            "Too small to matter",
            f"{listed_effects(findings)}: at most {100 * max(f.share for f in findings):.2g} % of "
            "what these rows are made of.",
        )
    ]


def _partly(diagnosis: Diagnosis) -> str:
    """What is known of a search that ended early."""
    if not diagnosis.completing:
        return "Nothing was found until then; that rules nothing out."
    return (
        f"Until then it seems that the model lacks {listed_effects(diagnosis.completing)}; "
        "rivals were not compared."
    )


def _explaining_as_well(found: Sequence[Finding]) -> dict[tuple[str, ...], list[Finding]]:
    """Findings by the effects that explain the log as well, as far as there are any."""
    equal: dict[tuple[str, ...], list[Finding]] = {}
    for finding in found:
        if finding.confusable_with:
            equal.setdefault(finding.confusable_with, []).append(finding)
    return equal


def _doubt(found: Sequence[Finding]) -> str:
    """Says which effects the log cannot tell from which others."""
    equal = _explaining_as_well(found)
    if not equal:
        return ""
    told = (
        f"{'that' if len(findings) == len(found) else listed_effects(findings)} "
        f"from {either_effect(names)}"
        for names, findings in equal.items()
    )
    return f"; this log cannot tell {', nor '.join(told)}"


def _surplus(findings: Sequence[Finding]) -> str:
    """Says that the model has too much of what cannot be negative by itself but was found so."""
    is_surplus = any(
        name in f.parameters and f.parameters[name].value < 0.0 <= parameter.plausible[0]
        for f in findings
        if f.effect in library()
        for name, parameter in library()[f.effect].parameters.items()
    )
    return " Where a value is negative, the model has too much." if is_surplus else ""


def _verdict(diagnosis: Diagnosis) -> str:
    found = listed_effects(diagnosis.chosen)
    if diagnosis.verdict == "effect_found":
        doubt = _doubt(diagnosis.chosen)
        if is_refuted(diagnosis.set_aside):
            return f"{_suggested(found)}{doubt}.{_tentative(diagnosis.tentative)}"
        text = f"The model lacks {found}{doubt}.{_surplus(diagnosis.chosen)}"
        return f"{text}{_tentative(diagnosis.tentative)}{_left(diagnosis)}{_open(diagnosis)}"
    statuses = applicable(diagnosis.effects)
    hidden = sum(status.verdict == "not_visible" for status in statuses.values())
    if diagnosis.verdict == "nothing_missing":
        unseen = (
            f"; {hidden} of {len(statuses)} effects would not show in this log" if hidden else ""
        )
        left = number(diagnosis.held_out_before)
        if diagnosis.too_small:
            return (
                f"Nothing that matters is missing: the model leaves over {left} times the sensors' "
                f"noise; too small to matter: {listed_effects(diagnosis.too_small)}{unseen}."
            )
        if diagnosis.held_out_before > EXCESS:
            return (
                f"No effect of the library is seen, but the model leaves over {left} times the "
                f"sensors' noise; it follows nothing that was measured, and more may hide in it"
                f"{unseen}."
            )
        return (
            f"Nothing is missing: what the model leaves over is the sensors' noise ({left} times "
            f"it){unseen}."
        )
    if diagnosis.verdict == "not_visible" and diagnosis.tentative:
        return (
            "This log cannot tell whether something is missing: what the model leaves over looks "
            f"like {listed_effects(diagnosis.tentative)}, but by less than the time between two "
            "samples of the torque, of which nothing is known there."
        )
    if diagnosis.verdict == "not_visible" and diagnosis.untested:
        return (
            "This log is too short to tell whether something is missing: the model leaves over "
            f"{number(diagnosis.held_out_before)} times the sensors' noise, and whether that is "
            f"noise as well does not show in so few averages of {_rows(diagnosis.untested)}."
        )
    if diagnosis.verdict == "not_visible" and diagnosis.noisy:
        return (
            "This log cannot tell whether something is missing: the model leaves over "
            f"{number(diagnosis.held_out_before)} times the sensors' noise, and what is left in "
            f"{_rows(diagnosis.noisy)} follows nothing that was measured. It is {_OF_NOTHING}."
        )
    if diagnosis.verdict == "not_visible":
        return (
            f"This log cannot tell whether something is missing: {hidden} of {len(statuses)} "
            "effects would not show in it."
        )
    known = ""
    if found:
        refuted = is_refuted(diagnosis.set_aside)
        known = f" {_suggested(found)}." if refuted else f" The model also lacks {found}."
    return f"{_unexplained(diagnosis, diagnosis.chosen)}{known}{_tentative(diagnosis.tentative)}"


def _tentative(findings: Sequence[Finding]) -> str:
    """Says what explains something and may stand for something else; empty if nothing does."""
    if not findings:
        return ""
    listed = listed_effects(findings)
    what, each, its = (
        ("it", "it takes", "its") if len(findings) == 1 else ("them", "each of them takes", "their")
    )
    return (
        f" Tentative: {listed}. The completed model has {what}, but more is left there than {each} "
        f"off, alone or beyond a simpler law, or {its} size may be none, or too small for how "
        "seldom the log is sampled, so something else may be missing in its place."
    )


def _open(diagnosis: Diagnosis) -> str:
    """Says that more may be missing than was found."""
    text = ""
    if diagnosis.untested:
        rows = _rows(diagnosis.untested)
        text += f" Whether what is left in {rows} is noise does not show in so few averages."
    if diagnosis.noisy:
        rows = _rows(diagnosis.noisy)
        text += f" More than the sensors' noise is left in {rows} and follows nothing that was "
        text += f"measured: {_OF_NOTHING}."
    return text


def _suggested(found: str) -> str:
    """What data that was set aside does not confirm, without a full stop."""
    return f"What was fitted suggests that the model lacks {found}"


def _unexplained(diagnosis: Diagnosis, found: Sequence[Finding]) -> str:
    """What is missing besides what was found; in the same place that may stand for it."""
    places = ", ".join(
        f"{words(left.row)} (follows {left.variable})" if left.share > _FOLLOWS else words(left.row)
        for left in diagnosis.unexplained
    ) or _enumerated([targets_text(f.targets, f.effect) for f in diagnosis.tentative])
    text = f"Something is missing that no effect of the library explains, in {places}"
    rows = {left.row for left in diagnosis.unexplained}
    # What is on a body shows in the joints that carry it.
    if any(rows & {*f.targets} or not _is_in_joints(f) for f in found):
        return f"{text}; what is named there may stand for part of it."
    return f"{text}."


def _is_in_joints(finding: Finding) -> bool:
    effect = library().get(finding.effect)
    return effect is None or effect.acts_on == "joint"


def _left(diagnosis: Diagnosis) -> str:
    """What is left where most was explained; empty if that is nothing but noise."""
    if not diagnosis.unexplained:
        return ""
    rows = _rows([left.row for left in diagnosis.unexplained])
    most = number(max(left.ratio for left in diagnosis.unexplained))
    size = f"more than noise (up to {most} times it)"
    return f" What is left in {rows} is small beside that, and {size}."


def study_outcome(study: Study) -> str:
    """The result of a study in one or two sentences."""
    if study.partial and not study.diagnoses[-1].partial:
        return f"Partial: {study.stopped_because}. {_study_result(study)}"
    if study.partial and study.found:
        return (
            f"Partial: {study.stopped_because} before the search was "
            f"through. {_study_result(study)}"
        )
    return _study_result(study)


def _study_result(study: Study) -> str:
    ended = study.diagnoses[-1]
    if not study.found:
        refused = ended.completing and ended.partial is None
        return _not_added(ended) if refused else diagnosis_outcome(ended)
    found = listed_effects([f for f in study.found if not f.tentative])
    refuted = is_refuted(study.set_aside)
    result = f"{_suggested(found)}." if refuted else f"The model lacked {found}."
    result = f"{result if found else ''}{_tentative([f for f in study.found if f.tentative])}"
    result = result.strip()
    if study.set_aside:
        result = _headline(result, study.set_aside)
    else:
        first, last = study.steps[0], study.steps[-1]
        course = "falls" if last.held_out_rmse < first.held_out_rmse else "rises"
        result += (
            f" With it, the held-out error {course} from "
            f"{number(first.held_out_rmse)} to {number(last.held_out_rmse)} times the "
            "sensors' noise; no data was set aside to test that."
        )
    if refused := [finding for one in study.diagnoses for finding in one.refuted]:
        result += f" {_refuted(refused)}"
    if ended.verdict == "unknown_effect":
        result += f" {_unexplained(ended, study.found)}"
    return result


def _not_added(diagnosis: Diagnosis) -> str:
    """Of what a study found and did not add."""
    result = (
        f"Nothing was added: {listed_effects(diagnosis.completing)} would not lower the held-out "
        f"error ({number(diagnosis.held_out_before)} times the sensors' noise, with it "
        f"{number(diagnosis.held_out_after)})."
    )
    if diagnosis.verdict == "unknown_effect":
        result += f" {_unexplained(diagnosis, ())}"
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
            "On blocks that were held out in turn, the error of all channels falls from "
            f"{number(before)} to {number(after)} times the sensors' noise ({number(train)} on the "
            "data that it was fitted to). Noise alone brings a finding once in a thousand logs."
        )
    nothing = (
        "nothing was found by then"
        if partial
        else "no effect explains enough of it on held-out data"
    )
    return f"The error of all channels is {number(before)} times the sensors' noise, and {nothing}."


def steps_after_compare(comparison: Comparison, inputs: Inputs) -> tuple[Step, ...]:
    """What to do after a comparison."""
    if not comparison.failures:
        return (Step("Nothing: there is nothing to explain."),)
    command = inputs.diagnose
    return (Step("Find the effects that the model lacks:", command),)


def steps_after_diagnosis(diagnosis: Diagnosis, inputs: Inputs) -> tuple[Step, ...]:
    """What to do after a diagnosis, the most important first."""
    adding: tuple[Step, ...] = ()
    cannot_tell = diagnosis.verdict == "not_visible"
    if diagnosis.completing and not is_refuted(diagnosis.set_aside):
        completed = f"{inputs.name}_completed.yaml"
        command = f"fbse add {inputs.changed_scenario} {inputs.out} --out {completed}"
        says = "Add it to the model:"
        if diagnosis.verdict == "unknown_effect":
            says = "Add it to the model; it may stand for part of what is left:"
        elif cannot_tell:
            says = "If no better log can be had, add what is tentative to the model:"
        adding = (Step(says, command),)
    elif diagnosis.completing:
        command = f"{inputs.diagnose} --test ANOTHER_LOG"
        adding = (Step("See whether another log confirms it, before it is added:", command),)
    experiments = tuple(_experiments_next(diagnosis, diagnosis.completing))
    steps = (*experiments, *adding) if cannot_tell else (*adding, *experiments)
    return steps or (_NOTHING,)


def steps_after_study(study: Study, inputs: Inputs) -> tuple[Step, ...]:
    """What to do after a study, the most important first."""
    last = study.diagnoses[-1]
    if not study.found:
        # What was found and not added is not to be added by hand either.
        return tuple(_experiments_next(last, ())) or (_NOTHING,)
    command = f"fbse compare {inputs.out}/completed.yaml ANOTHER_LOG"
    text, uses = "Try the completed model on a log that it has not seen", []
    if is_refuted(study.set_aside):
        text += ", before it is used for anything: this log does not confirm it"
    elif study.scenario.estimator.gives_friction:
        estimate = f"fbse estimate {inputs.out}/completed.yaml {inputs.logs[0]}"
        uses.append(Step("Estimate the friction with it:", estimate))
    return (Step(f"{text}:", command), *uses, *_experiments_next(last, study.found))


def _experiments_next(diagnosis: Diagnosis, found: Sequence[Finding]) -> list[Step]:
    """What to look at and which experiments to make."""
    statuses = applicable(diagnosis.effects)
    rivals = {_effect_of(name) for finding in found for name in finding.confusable_with}
    doubtful = {name: status for name, status in statuses.items() if name in rivals}
    steps = []
    if diagnosis.partial is not None:
        steps.append(Step("Let it look for longer: the same command with more time."))
    elif diagnosis.verdict == "unknown_effect":
        steps.append(
            Step(
                "Look at the pictures of the channels that are left, and register an effect of "
                "your own that looks like them."
            )
        )
        joints = [left.row for left in diagnosis.unexplained if "/" not in left.row]
        if len(joints) >= _MANY_JOINTS:
            steps.append(
                Step(
                    "So many joints at once may be misread: see what the log's rows are "
                    "(recording.rows), and by how much commands and readings are later than their "
                    "row (command_time and reading_time of the map)."
                )
            )
    if doubtful:
        steps += _experiments("To tell them apart:", doubtful)
    if diagnosis.partial is None and diagnosis.verdict == "not_visible":
        if diagnosis.tentative:
            steps.append(Step("Record torques as often as the control gives them."))
        if diagnosis.untested:
            steps.append(Step("Record for longer, or average over less (recording.block)."))
        if diagnosis.noisy:
            steps.append(
                Step(
                    f"Look at what is left in {_rows(diagnosis.noisy)}: noise is said in the "
                    "scenario (recording.torque_noise), and play is felt when the machine is off."
                )
            )
        else:
            hidden = {
                name: status for name, status in statuses.items() if status.verdict == "not_visible"
            }
            steps += _experiments("Record a motion that shows more:", hidden)
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


def times_noise(value: float) -> str:
    """As `2.31 times the sensors' noise`."""
    return f"{number(value)} times the sensors' noise"


def as_sentence(text: str) -> str:
    """With a capital letter and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def listed_effects(findings: Sequence[Finding]) -> str:
    """Effects and where, as `Coulomb friction and torque bias in left knee pitch and body mass in
    trunk`; for the inside of a sentence."""
    targets = by_effect(findings)
    by_place: dict[frozenset[str], list[str]] = {}
    for effect in targets:
        by_place.setdefault(frozenset(targets[effect]), []).append(effect)
    return _enumerated([_effects_in(there, targets[there[0]]) for there in by_place.values()])


def _enumerated(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)


def _rows(names: Sequence[str]) -> str:
    """Rows of the residual for reading."""
    return _enumerated([words(name) for name in names])


def _effects_in(effects: Sequence[str], targets: Sequence[str]) -> str:
    names = _enumerated([_inside(effect) for effect in effects])
    return (
        names if list(targets) == ["robot"] else f"{names} in {targets_text(targets, effects[0])}"
    )


def _inside(effect: str) -> str:
    """An effect's name inside a sentence."""
    name = words(spaced(effect))
    return name if name.startswith(_NAMES) else name[0].lower() + name[1:]


def either_effect(effects: Collection[str]) -> str:
    """Effects for reading, as `Coulomb friction or torque bias`; of one on several other bodies
    no more is said than that."""
    places = Counter(map(_effect_of, effects))
    names = (
        f"{_effect_of(name)}{ELSEWHERE}another body"
        if places[_effect_of(name)] > _MOST_PLACES
        else name
        for name in effects
    )
    return " or ".join(dict.fromkeys(map(_inside, names)))


def _effect_of(rival: str) -> str:
    """The effect's name in that of a rival, which may be the same effect on another body, as
    `BodyMass on trunk`."""
    return rival.split(ELSEWHERE)[0]


def what_else(found: Sequence[Finding], *, partial: bool) -> str:
    """What explains the log as well."""
    if partial:
        return "The search ended before other effects of the library were compared."
    told = [
        f"{as_sentence(either_effect(names))[:-1]} explains this log as well as "
        f"{listed_effects(findings)}."
        for names, findings in _explaining_as_well(found).items()
    ]
    if told:
        return " ".join(told)
    if not found:
        return (
            "No effect of the library is seen in this log; one that is smaller than the sizes "
            "below would not have shown."
        )
    return "No other effect of the library explains this log as well."


def _experiments(why: str, statuses: Mapping[str, EffectStatus]) -> list[Step]:
    """What would show effects, each experiment once."""
    shown: dict[tuple[str, str], list[str]] = {}
    for name, status in statuses.items():
        experiment = (as_sentence(status.experiment), status.command or "")
        shown.setdefault(experiment, []).append(_inside(name))
    return [
        Step(f"{why} {text} It shows {_enumerated(names)}.", command)
        for (text, command), names in shown.items()
    ]


def kinds_of_failures(comparison: Comparison) -> str:
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


def applicable(statuses: Mapping[str, EffectStatus]) -> dict[str, EffectStatus]:
    """Effects that there is a place for on this robot: an arm has no feet."""
    return {name: status for name, status in statuses.items() if status.smallest_detectable}


def statuses_of(study: Study) -> dict[str, EffectStatus]:
    """What all rounds together say of every effect: the last one, but for what was found before and
    what stood for it as well."""
    found = {finding.effect for finding in study.found if not finding.tentative}
    equal = {name for finding in study.found for name in (finding.effect, *finding.confusable_with)}
    return {
        name: replace(
            status,
            verdict="present"
            if name in found
            else "confusable"
            if name in equal
            else status.verdict,
        )
        for name, status in applicable(study.diagnoses[-1].effects).items()
    }


def verdicts_text(
    statuses: Mapping[str, EffectStatus], unexplained: Sequence[Structure] = ()
) -> str:
    """How many effects of the library have each verdict.

    Args:
        unexplained: what no effect explains.
    """
    if not statuses:
        return "The search ended before it could say what else there is."
    verdicts = [status.verdict for status in statuses.values()]
    counts = ", ".join(
        f"{verdicts.count(name)} {words(name)}"
        for name in figures.VERDICT_COLORS
        if name in verdicts
    )
    means = "that it would have been seen"
    if unexplained:
        k = len(unexplained)
        where = "the row" if k == 1 else f"the {k} rows"
        means += f"; in {where} with something unknown, that what is left does not look like it"
    return f"{len(verdicts)} effects: {counts}. Absent means {means}."
