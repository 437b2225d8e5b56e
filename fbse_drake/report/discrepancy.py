"""The reports of compare, diagnose and study."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fbse_drake.discrepancy.compare import Comparison, words
from fbse_drake.discrepancy.diagnose import Diagnosis, EffectStatus, Estimate, Finding
from fbse_drake.discrepancy.prediction import Predictor
from fbse_drake.discrepancy.residual import joint_velocity_noise
from fbse_drake.discrepancy.study import Study
from fbse_drake.effects.effect import library
from fbse_drake.report import discrepancy_figures as figures
from fbse_drake.report.discrepancy_figures import by_effect, spaced, targets_text
from fbse_drake.report.html import Details, FigureBlock, Report, Section, Table, number, write_report
from fbse_drake.scenario import SensorsConfig, dump_scenario

# Pictures show this many of the worst channels, and of alternatives.
_CHANNELS = 4
_ALTERNATIVES = 8


@dataclass(frozen=True)
class Inputs:
    """What was compared, in the words of the command line, for the commands that a report proposes."""

    # Of the scenario.
    name: str
    scenario: str
    log: str
    # Folder of the results.
    out: str


def write_compare_report(path: str | Path, comparison: Comparison, predictor: Predictor, inputs: Inputs) -> None:
    """Writes where a model fails as one HTML file."""
    outcome = compare_outcome(comparison)
    next_step = f"fbse diagnose {inputs.scenario} {inputs.log}" if comparison.failures else "none: there is nothing to explain"
    summary = Table(
        ("", ""),
        (
            ("Outcome", outcome),
            ("Error of the whole residual", _times_noise(comparison.rmse)),
            ("The same with a constant taken off each channel, on held-out data", _times_noise(comparison.held_out_rmse)),
            ("What to do next", next_step),
        ),
    )
    sections = [
        Section("Summary", tables=(summary,)),
        *_where(comparison, predictor),
        Section("Channels", _CHANNELS_TEXT, tables=(_channel_table(comparison),)),
        *_closing(predictor, inputs),
    ]
    write_report(path, Report(f"{inputs.name}: model against log", not comparison.failures, outcome, tuple(sections)))


def write_diagnosis_report(path: str | Path, diagnosis: Diagnosis, comparison: Comparison, predictor: Predictor, inputs: Inputs) -> None:
    """Writes which effects a model lacks as one HTML file.

    Args:
        comparison: of the model as it is.
    """
    outcome = diagnosis_outcome(diagnosis)
    rows = (
        ("Outcome", outcome),
        ("How sure", how_sure(diagnosis)),
        ("What else it could be", _what_else(diagnosis)),
        ("What to do next", next_step(diagnosis, inputs)),
    )
    sections = [
        Section("Summary", tables=(Table(("", ""), rows),)),
        *_why(diagnosis.ranking, diagnosis),
        *_where(comparison, predictor),
        _all_effects(diagnosis),
        *_closing(predictor, inputs),
    ]
    passed = diagnosis.verdict in ("effect_found", "nothing_missing")
    write_report(path, Report(f"{inputs.name}: what is missing in the model", passed, outcome, tuple(sections)))


def write_study_report(
    path: str | Path, study: Study, before: tuple[Predictor, Comparison], after: tuple[Predictor, Comparison], inputs: Inputs
) -> None:
    """Writes how a model was completed as one HTML file.

    Args:
        before, after: the model as it was, and with all that was added, against the log.
    """
    first, last = study.steps[0], study.steps[-1]
    found = [finding for step in study.steps for finding in step.added]
    verdict = study.diagnoses[-1 if not found else 0]
    outcome = study_outcome(study)
    rows = (
        ("Outcome", outcome),
        ("Why it stopped there", _sentence(study.stopped_because)),
        ("Error on held-out data", f"{number(first.held_out_rmse)} times the sensors' noise before, {number(last.held_out_rmse)} after"),
        ("How sure", how_sure(verdict)),
        ("What else it could be", _what_else(verdict)),
        ("What to do next", _after_study(study, inputs)),
    )
    caption = (
        "Above: root mean square of what the equation of motion leaves over, on stretches of the log that the values were not fitted to. "
        "Below: the model with everything added so far is simulated in the place of the robot; its joint angles against the log's."
    )
    falling = FigureBlock("The error, step by step", caption, figures.falling_error(study))
    sections = [
        Section("Summary", tables=(Table(("", ""), rows),)),
        Section("The error falls", tables=(_step_table(study),), figures=(falling,)),
        *_why(found, verdict),
        *_where(before[1], before[0], " before"),
        *(_where(after[1], after[0], " after") if found else ()),
        _all_effects(study.diagnoses[-1]),
        *_closing(before[0], inputs, after=dump_scenario(study.scenario, inputs.name) if found else None),
    ]
    passed = study.diagnoses[-1].verdict in ("effect_found", "nothing_missing")
    write_report(path, Report(f"{inputs.name}: the missing physics", passed, outcome, tuple(sections)))


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
    found = _listed(diagnosis.chosen)
    if diagnosis.verdict == "effect_found":
        doubtful = dict.fromkeys(name for finding in diagnosis.chosen for name in finding.confusable_with)
        return f"The model lacks {found}{f'; this log cannot tell that from {_either(doubtful)}' if doubtful else ''}."
    if diagnosis.verdict == "nothing_missing":
        return f"Nothing is missing: what the model leaves over is the sensors' noise ({number(diagnosis.held_out_before)} times it)."
    if diagnosis.verdict == "not_visible":
        hidden = sum(status.verdict == "not_visible" for status in diagnosis.effects.values())
        return f"This log cannot tell whether something is missing: {hidden} of {len(diagnosis.effects)} effects would not show in it."
    places = ", ".join(f"{words(left.row)} (follows {left.variable})" for left in diagnosis.unexplained)
    known = f" The model also lacks {found}." if found else ""
    return f"Something is missing that no effect of the library explains, in {places}.{known}"


def study_outcome(study: Study) -> str:
    """The result of a study in one or two sentences."""
    if not study.found:
        return diagnosis_outcome(study.diagnoses[-1])
    first, last = study.steps[0], study.steps[-1]
    course = "falls" if last.held_out_rmse < first.held_out_rmse else "rises"
    rest = f" {diagnosis_outcome(study.diagnoses[-1])}" if study.diagnoses[-1].verdict == "unknown_effect" else ""
    return (
        f"The model lacked {_listed(study.found)}. With it, the held-out error {course} from {number(first.held_out_rmse)} to "
        f"{number(last.held_out_rmse)} times the sensors' noise.{rest}"
    )


def how_sure(diagnosis: Diagnosis) -> str:
    """What supports the verdict."""
    before, after = number(diagnosis.held_out_before), number(diagnosis.held_out_after)
    if diagnosis.chosen:
        return (
            f"On data that nothing was fitted to, the error of all channels falls from {before} to {after} times the sensors' noise "
            f"({number(diagnosis.train_after)} on the data that it was fitted to). Noise alone brings a finding once in a thousand logs."
        )
    return f"The error of all channels is {before} times the sensors' noise, and no effect makes it smaller on held-out data."


def next_step(diagnosis: Diagnosis, inputs: Inputs) -> str:
    """What to do, with the command."""
    doubtful = {name for finding in diagnosis.chosen for name in finding.confusable_with}
    steps = []
    if diagnosis.verdict == "unknown_effect":
        steps.append("Look at the pictures of the channels that are left, and register an effect of your own that looks like them.")
    if doubtful:
        steps.append(f"To tell them apart: {_experiments({name: diagnosis.effects[name] for name in doubtful})}")
    if diagnosis.verdict == "not_visible":
        hidden = {name: status for name, status in diagnosis.effects.items() if status.verdict == "not_visible"}
        steps.append(f"Record a motion that shows more: {_experiments(hidden)}")
    if diagnosis.chosen:
        steps.append(f"Add it to the model: fbse add {inputs.scenario} {inputs.out} --out {inputs.name}_completed.yaml")
    return " ".join(steps) or "Nothing. A motion that loads and moves the joints more would show smaller effects."


def _after_study(study: Study, inputs: Inputs) -> str:
    last = study.diagnoses[-1]
    if not study.found or last.verdict == "unknown_effect":
        return next_step(last, inputs)
    return f"Use the completed model, {inputs.out}/completed.yaml, and try it on a log that it has not seen: fbse compare"


def parameter_text(name: str, estimate: Estimate) -> str:
    """As `coulomb 1.02 Nm (0.98 to 1.06)`."""
    low, high = estimate.interval
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    return f"{words(name)} {estimate.value:.3g}{unit} ({low:.3g} to {high:.3g})"


def parameters_text(finding: Finding) -> str:
    """All parameters with their 95 % intervals."""
    return ", ".join(parameter_text(name, estimate) for name, estimate in finding.parameters.items())


def _times_noise(value: float) -> str:
    return f"{number(value)} times the sensors' noise"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _listed(findings: Sequence[Finding]) -> str:
    """Effects and where, as `Coulomb friction in left knee pitch and torque bias in 3 joints`; effects in lower case inside a sentence."""
    names = [_effect_in(effect, targets) for effect, targets in by_effect(findings).items()]
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)


# Effects that are called after somebody.
_NAMES = ("Coulomb", "Stribeck", "IMU")


def _effect_in(effect: str, targets: Sequence[str]) -> str:
    name = _inside(effect)
    return name if list(targets) == ["robot"] else f"{name} in {targets_text(targets)}"


def _inside(effect: str) -> str:
    """An effect's name inside a sentence."""
    name = spaced(effect)
    return name if name.startswith(_NAMES) else name[0].lower() + name[1:]


def _either(effects: Iterable[str]) -> str:
    return " or ".join(_inside(effect) for effect in effects)


def _what_else(diagnosis: Diagnosis) -> str:
    told = [
        f"{_sentence(_either(f.confusable_with))[:-1]} explains this log as well as {_effect_in(f.effect, f.targets)}."
        for f in diagnosis.chosen
        if f.confusable_with
    ]
    if told:
        return " ".join(told)
    if not diagnosis.chosen:
        return "Nothing else in the library: an effect smaller than the sizes below would not have shown."
    return "No other effect of the library explains this log as well."


def _experiments(statuses: dict[str, EffectStatus]) -> str:
    """What would show effects, each experiment once."""
    texts: dict[str, list[str]] = {}
    for name, status in statuses.items():
        command = f" ({status.command})" if status.command else ""
        texts.setdefault(f"{status.experiment.rstrip('.')}{command}.", []).append(spaced(name))
    return " ".join(f"{text} [{', '.join(names)}]" for text, names in texts.items())


def _where(comparison: Comparison, predictor: Predictor, when: str = "") -> list[Section]:
    """Where the model fails: in words, on the robot, against each variable and over time."""
    by_name = {channel.row.name: channel for channel in comparison.channels}
    worst = [by_name[name] for name in dict.fromkeys(failure.row.name for failure in comparison.failures)][:_CHANNELS]
    blocks = [
        FigureBlock(
            "Error over noise, by joint and by phase",
            "Root mean square of what the equation of motion leaves over, in multiples of the sensors' noise: about 1 is noise alone. "
            "No joint effect can show in the base's channels: what does is mass, foot sensor, IMU or contact. The soles' channels are the "
            "motion of feet that stand.",
            figures.robot_errors(predictor.robot, comparison, predictor.motion.blocks.joint_position.mean(axis=0)),
        )
    ]
    if worst:
        blocks += [
            FigureBlock(
                "The worst channels against what they may depend on",
                "Mean error in bins. Where the interval is narrow and away from zero, the error follows that variable; where it is "
                "wide, the error depends on something else. A positive error means that the model's torque is too low.",
                figures.error_bins(worst),
            ),
            FigureBlock(
                "The worst channels over time",
                "Averages over 10 ms. Inside the grey band is what the sensors' noise explains.",
                figures.errors_over_time(predictor.residual, predictor.robot.description.sides, worst),
            ),
        ]
    rows = tuple(
        (f.text, f.where.error, f"{f.where.interval[0]:.3g} to {f.where.interval[1]:.3g}", f.where.noise_floor, f.row.unit)
        for f in comparison.failures
    )
    header = ("Failure, worst first", "Mean error", "95 % interval", "Noise in it", "Unit")
    text = "" if rows else "No failure above the noise."
    return [Section(f"Where the model fails{when}", text, tables=(Table(header, rows),) if rows else (), figures=tuple(blocks))]


_CHANNELS_TEXT = (
    "NRMSE is beside the zero predictor, a model without any forces: 1 means that the model explains nothing. The channels of the soles "
    "have none, for any model predicts that a foot that stands does not move."
)


def _channel_table(comparison: Comparison) -> Table:
    rows = [(words(c.row.name), c.rmse, c.noise_floor, c.row.unit, c.rmse / c.noise_floor, c.nrmse) for c in comparison.channels]
    known = tuple(row for row in rows if not np.isnan(row[1]))
    return Table(("Channel", "RMSE", "Noise floor", "Unit", "RMSE over noise", "NRMSE"), known)


def _why(findings: Sequence[Finding], diagnosis: Diagnosis) -> list[Section]:
    """What was found, with its values and the alternatives."""
    chosen = [finding for finding in findings if finding.chosen]
    shown = [*chosen, *[finding for finding in diagnosis.ranking if not finding.chosen][:_ALTERNATIVES]]
    if not shown:
        return []
    known = library()
    blocks = [
        FigureBlock(
            "What explains the error",
            "Error on held-out data of the channels that an effect moves, without it and with it. The broken line is the sensors' noise.",
            figures.ranking(shown),
        )
    ]
    if any(finding.parameters for finding in chosen):
        blocks.append(FigureBlock("Fitted values", "With their 95 % intervals.", figures.parameters(chosen)))
    rows = tuple(
        (
            spaced(finding.effect),
            targets_text(finding.targets),
            parameters_text(finding),
            finding.held_out_before,
            finding.held_out_after,
            known[finding.effect].signature if finding.effect in known else "",
        )
        for finding in chosen
    )
    header = ("Effect", "In", "Values (95 % interval)", "Before", "After", "What it looks like in data")
    left = tuple((words(u.row), u.ratio, u.variable, 100 * u.share) for u in diagnosis.unexplained)
    tables = [Table(header, rows)] if rows else []
    if left:
        tables.append(Table(("Left over in", "Over noise", "Follows most", "Which explains [%]"), left))
    return [Section("What explains it", tables=tuple(tables), figures=tuple(blocks))]


def _all_effects(diagnosis: Diagnosis) -> Section:
    """What the data says of every effect of the library."""
    known = library()
    rows = []
    for name, status in diagnosis.effects.items():
        reach = f"{words(status.parameter)} {_reach(status, name)}"
        does = known[name].description if name in known else ""
        show = f"{status.experiment} ({status.command})" if status.command else status.experiment
        rows.append((spaced(name), words(status.verdict), reach, does, show))
    header = ("Effect", "Verdict", "Smallest that would have been seen", "What it is", "What shows it")
    block = FigureBlock(
        "What this log can show",
        "How small an effect could be and still be found, against what is plausible on a robot of this kind. What lies in the grey area is "
        "not visible in this log, which is not the same as absent.",
        figures.detectability(diagnosis.effects),
    )
    order = ("present", "confusable", "absent", "not visible")
    return Section(
        "All effects of the library",
        "Beside what was found.",
        tables=(Table(header, tuple(sorted(rows, key=lambda row: order.index(row[1])))),),
        figures=(block,),
    )


def _reach(status: EffectStatus, effect: str) -> str:
    """Smallest sizes that the data would have shown, and where it would have shown none that is plausible."""
    known = library().get(effect)
    largest = np.inf if known is None else max(abs(bound) for bound in known.parameters[status.parameter].plausible)
    sizes = [size for size in status.smallest_detectable.values() if size <= largest]
    hidden = [target for target, size in status.smallest_detectable.items() if not size <= largest]
    low, high = (f"{bound:.2g}" for bound in (min(sizes, default=0), max(sizes, default=0)))
    unit = "" if status.unit == "1" else f" {status.unit}"
    shown = [f"{low if low == high else f'{low} to {high}'}{unit}"] if sizes else []
    return "; ".join([*shown, *([f"none in {targets_text(hidden)}"] if hidden else [])])


def _step_table(study: Study) -> Table:
    rows = []
    for step in study.steps:
        rolled = step.rollout
        rows.append(
            (
                _sentence(_listed(step.added)) if step.added else "The model as given.",
                step.held_out_rmse,
                step.train_rmse,
                np.nan if rolled is None else 1e3 * rolled.mean_position,
                np.nan if rolled is None else rolled.mean_torque_command,
                "" if rolled is None or rolled.failure is None else rolled.failure,
            )
        )
    header = ("Added", "Held-out error / noise", "Fitted error / noise", "Simulated joint angles, RMS [mrad]", "Torques, RMS [Nm]", "Fell")
    return Table(header, tuple(rows))


def _closing(predictor: Predictor, inputs: Inputs, after: str | None = None) -> list[Section]:
    """The data and the scenario."""
    motion, sensors = predictor.motion, predictor.scenario.sensors
    standing = motion.standing
    rows = [
        ("Log", inputs.log),
        ("Length", f"{number(float(motion.log.time[-1] - motion.log.time[0]))} s, {len(motion.log.time)} samples"),
        ("Samples that are missing", f"{number(100 * float(1 - motion.measured.mean()), 2)} %; nothing is said about the gaps"),
        ("Joint velocities", "measured" if "joint/velocity" in motion.log else "differenced from the angles"),
        ("Sensor noise that is believed", _noise_text(sensors)),
        ("Averages over", f"{number(1e3 * motion.length * motion.period)} ms; {len(motion.time)} of them"),
    ]
    if predictor.robot.has_floating_base:
        share = {side: 100 * float(standing[:, k].mean()) for k, side in enumerate(predictor.robot.description.sides)}
        rows.append(("Share of time that a foot stands", ", ".join(f"{side} {number(value, 2)} %" for side, value in share.items())))
    scenario = Details("YAML", dump_scenario(predictor.scenario, inputs.name))
    completed = (Details("YAML with the completed model", after),) if after is not None else ()
    return [
        Section("Data", tables=(Table(("", ""), tuple(rows)),)),
        Section("Scenario", "Sensors, and the model with its effects, as they were believed.", details=(scenario, *completed)),
    ]


def _noise_text(sensors: SensorsConfig) -> str:
    imu, feet = sensors.imu, sensors.foot_force
    return (
        f"accelerometer {imu.acceleration_noise:g} m/s², gyroscope {imu.angular_velocity_noise:g} rad/s, "
        f"pads {feet.noise:g} N, joint velocity {joint_velocity_noise(sensors):.2g} rad/s"
    )
