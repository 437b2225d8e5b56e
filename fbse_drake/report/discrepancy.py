"""The reports of compare, diagnose and study."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from platform import python_version

import numpy as np

from fbse_drake.discrepancy.diagnosis.compare import Channel, Comparison, words
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, EffectStatus, Finding
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import Study, StudyStep
from fbse_drake.discrepancy.identification.structure import Structure
from fbse_drake.discrepancy.residual.equation_of_motion import joint_velocity_noise
from fbse_drake.effects.effect import library
from fbse_drake.log import Log
from fbse_drake.report import discrepancy_figures as figures
from fbse_drake.report.chart import Chart
from fbse_drake.report.discrepancy_figures import (
    finding_name,
    small_motions,
    spaced,
    targets_text,
)
from fbse_drake.report.discrepancy_tables import (
    all_failure_tables,
    channel_table,
    growth_table,
    log_name,
    reach_text,
    relative_error_tables,
    simulated_position_tables,
    spread_tables,
    value_tables,
)
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
from fbse_drake.report.residual_chart import residual_chart
from fbse_drake.report.sentences import (
    Inputs,
    applicable,
    as_sentence,
    compare_outcome,
    diagnosis_outcome,
    how_sure,
    is_refuted,
    kinds_of_failures,
    set_aside_rows,
    statuses_of,
    steps_after_compare,
    steps_after_diagnosis,
    steps_after_study,
    study_outcome,
    times_noise,
    too_small_rows,
    verdicts_text,
    what_else,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import Scenario, dump_scenario

# Pictures show this many of the worst channels, of alternatives, and of joints' torques; and of a
# log this many averages.
_CHANNELS = 4

_ALTERNATIVES = 8

_JOINTS = 6

_SHOWN = 500

# Verdicts that a report calls a success.
_PASSED = ("effect_found", "nothing_missing")

_METHOD = (
    "The recorded motion is put into the model's equation of motion. What it leaves over, the "
    "residual, is what the model does not explain; it stands beside the noise that the "
    "sensors must put into it."
)

_RATIOS = (
    "Root mean square of what the equation of motion leaves over in single averages, in multiples "
    "of the sensors' noise in them: about 1 is noise alone. In the error as a whole, as in the "
    "summary, what lasts counts more, for noise cancels from one average to the next."
)

_BY_PHASE = (
    f"{_RATIOS} No joint effect can show in the base's channels: what does is mass, foot sensor, "
    "IMU or contact. The soles' channels are the motion of feet that stand."
)

_FALLING = (
    "Root mean square of what the equation of motion leaves over, on stretches of the log that "
    "the values were not fitted to."
)


def write_compare_report(
    path: str | Path, comparison: Comparison, predictor: Predictor, inputs: Inputs
) -> None:
    """Writes where a model fails as one HTML file."""
    outcome = inputs.hygiene.before(compare_outcome(comparison))
    rows = (
        ("Error of the whole residual", times_noise(comparison.rmse)),
        (
            "Is it a mere offset?",
            "A constant taken off every channel leaves "
            f"{times_noise(comparison.held_out_rmse)} on held-out data.",
        ),
        ("Where it fails", kinds_of_failures(comparison)),
    )
    sections = [
        _summary(rows),
        where_it_fails(comparison, predictor),
        _hygiene(predictor, inputs),
        _reproduce("compare", predictor, inputs),
    ]
    write_report(
        path,
        Report(
            f"{inputs.name}: model against log",
            not comparison.failures,
            outcome,
            tuple(sections),
            steps_after_compare(comparison, inputs),
        ),
    )


@dataclass(frozen=True)
class Illustrated:
    """What the report of a diagnosis says in sections with pictures: `where_it_fails`,
    `why_it_fails`, `what_was_looked_for` and `how_it_falls`."""

    where: Section
    why: Sequence[Section]
    looked_for: Section
    path: Sequence[Section]

    @classmethod
    def of(
        cls, diagnosis: Diagnosis, comparison: Comparison, predictor: Predictor
    ) -> "Illustrated":
        """Drawn when it is shown.

        Args:
            comparison: of the model as it is.
        """
        return cls(
            where_it_fails(comparison, predictor),
            why_it_fails(diagnosis),
            what_was_looked_for(diagnosis),
            how_it_falls(diagnosis, predictor.robot),
        )


def write_diagnosis_report(
    path: str | Path,
    diagnosis: Diagnosis,
    predictor: Predictor,
    inputs: Inputs,
    illustrated: Illustrated,
) -> None:
    """Writes which effects a model lacks as one HTML file."""
    outcome, statuses = (
        inputs.hygiene.before(diagnosis_outcome(diagnosis)),
        applicable(diagnosis.effects),
    )
    rows = (
        *set_aside_rows(diagnosis.set_aside),
        (
            "How sure",
            how_sure(
                diagnosis.completing,
                diagnosis.held_out_before,
                diagnosis.held_out_after,
                diagnosis.train_after,
                partial=diagnosis.partial is not None,
            ),
        ),
        (
            "What else it could be",
            what_else(diagnosis.completing, partial=diagnosis.partial is not None),
        ),
        *too_small_rows(diagnosis.too_small),
        ("What was looked for", verdicts_text(statuses, diagnosis.unexplained)),
    )
    sections = [
        _summary(rows),
        illustrated.where,
        *illustrated.why,
        illustrated.looked_for,
        *illustrated.path,
        _hygiene(predictor, inputs),
        _reproduce("diagnose", predictor, inputs),
    ]
    passed = (
        diagnosis.partial is None
        and diagnosis.verdict in _PASSED
        and not is_refuted(diagnosis.set_aside)
    )
    write_report(
        path,
        Report(
            f"{inputs.name}: what is missing in the model",
            passed,
            outcome,
            tuple(sections),
            steps_after_diagnosis(diagnosis, inputs),
        ),
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
    first, last, statuses = study.steps[0], study.steps[-1], statuses_of(study)
    rows = (
        *set_aside_rows(study.set_aside),
        *_relative_fall(study),
        ("Why it stopped there", as_sentence(study.stopped_because)),
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
        ("What else it could be", what_else(study.found, partial=study.partial)),
        *too_small_rows(study.diagnoses[-1].too_small),
        ("What was looked for", verdicts_text(statuses, study.diagnoses[-1].unexplained)),
    )
    completed = dump_scenario(study.scenario, inputs.name) if study.found else None
    sections = [
        _summary(rows),
        where_it_fails(before[1], before[0], after[0] if study.found else None),
        *_why(
            [step.added for step in study.steps[1:]],
            study.diagnoses[0].ranking,
            study.diagnoses[-1].unexplained,
        ),
        _what_was_looked_for(statuses, study.diagnoses[-1].unexplained),
        *([_fall(study, before, after, tests or {})] if study.found else []),
        _hygiene(before[0], inputs),
        _reproduce("study", before[0], inputs, completed),
    ]
    passed = (
        not study.partial
        and study.diagnoses[-1].verdict in _PASSED
        and not is_refuted(study.set_aside)
    )
    write_report(
        path,
        Report(
            f"{inputs.name}: the missing physics",
            passed,
            inputs.hygiene.before(study_outcome(study)),
            tuple(sections),
            steps_after_study(study, inputs),
        ),
    )


def _summary(rows: Sequence[tuple[str, str]]) -> Section:
    return Section("Summary", tables=(Table(("", ""), tuple(rows)),))


def where_it_fails(
    comparison: Comparison, predictor: Predictor, completed: Predictor | None = None
) -> Section:
    """Where the model fails: in words, on the robot, against each variable and over time.

    Args:
        completed: the model with what was found, if anything was.
    """
    robot, residual, motion = predictor.robot, predictor.residual, predictor.motion
    known = [channel for channel in comparison.channels if not np.isnan(channel.rmse)]
    blocks: list[FigureBlock | Chart] = []
    if robot.description.legs:
        posture = motion.blocks.joint_position.mean(axis=0)
        drawn = partial(figures.robot_errors, robot, comparison, posture)
        blocks.append(FigureBlock("Error over noise, by joint and by phase", _BY_PHASE, drawn))
    elif len(known) > 1:
        drawn = partial(figures.channel_errors, known)
        blocks.append(FigureBlock("Error over noise, by joint", _RATIOS, drawn))
    worst = _worst(comparison)
    # A short log has no bins.
    if binned := [channel for channel in worst if figures.binned_variables(channel)]:
        blocks.append(
            FigureBlock(
                "The worst channels against what they may depend on",
                "Mean error in bins. Where the interval is narrow and away from zero, the error "
                "follows that variable; where it is wide, the error depends on something else. A "
                "positive error means that the model's torque (or force) is too low.",
                partial(figures.error_bins, binned),
            )
        )
    if worst:
        blocks += [
            FigureBlock(
                "The worst channels over time",
                f"Averages over {number(1e3 * motion.length * motion.period)} ms. Inside the grey "
                "band is what sensor noise explains.",
                partial(figures.errors_over_time, residual, robot.description.sides, worst),
            ),
        ]
    blocks.append(residual_chart(predictor, completed))
    text = _METHOD if comparison.failures else f"{_METHOD} No failure above the noise."
    return Section(
        "Where the model fails",
        text,
        (*all_failure_tables(comparison), channel_table(known)),
        tuple(blocks),
    )


def _worst(comparison: Comparison) -> list[Channel]:
    by_name = {channel.row.name: channel for channel in comparison.channels}
    return [
        by_name[name] for name in dict.fromkeys(failure.row.name for failure in comparison.failures)
    ][:_CHANNELS]


def why_it_fails(diagnosis: Diagnosis) -> list[Section]:
    """What was found, with its values and the alternatives, and what is left."""
    return _why([diagnosis.completing], diagnosis.ranking, diagnosis.unexplained)


def _why(
    rounds: Sequence[Sequence[Finding]],
    alternatives: Sequence[Finding],
    unexplained: Sequence[Structure],
) -> list[Section]:
    """What was found in each round, with its values and the alternatives, and what is left without
    an explanation."""
    chosen = [finding for found in rounds for finding in found]
    others = [f for f in alternatives if not (f.chosen or f.tentative)][:_ALTERNATIVES]
    of_round = [f", round {k}" * (k > 1) for k, found in enumerate(rounds, start=1) for _ in found]
    tables, blocks = value_tables(rounds), []
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
            "Error on held-out data of all the channels that an effect moves, taken together, "
            "without it and with it, everything else being equal; as everywhere in this report in "
            "multiples of the sensors' noise (root mean squares). The broken line is that noise. "
            + (
                "An alternative stands in the place of what was chosen."
                if chosen
                else "Each effect is tried by itself."
            )
        )
        names = [
            f"{finding_name(f)}{when}"
            for f, when in zip(chosen + others, of_round + [""] * len(others), strict=True)
        ]
        blocks.append(
            FigureBlock(
                "What explains the error",
                caption,
                partial(figures.ranking, [*chosen, *others], names),
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
        blocks.append(FigureBlock("Fitted values", caption, partial(figures.parameters, valued)))
    text = ""
    if not chosen:
        text = (
            "No effect is named: those below explain something by themselves, but not enough of "
            "it, or not in a way that can be."
            if others
            else "No effect of the library makes the error smaller on data that it was not fitted "
            "to."
        )
    return [Section("Why it fails", text, tuple(tables), tuple(blocks))] if tables or blocks else []


def what_was_looked_for(diagnosis: Diagnosis) -> Section:
    """What the data says of every effect of the library that can be in such a robot."""
    return _what_was_looked_for(applicable(diagnosis.effects), diagnosis.unexplained)


def _what_was_looked_for(
    statuses: Mapping[str, EffectStatus], unexplained: Sequence[Structure]
) -> Section:
    """What the data says of every effect of the library."""
    known = library()
    rows = []
    for name, status in statuses.items():
        reach = f"{words(status.parameter)} {reach_text(status)}"
        does = known[name].description if name in known else ""
        show = Step(status.experiment, status.command or "")
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
        "How small an effect could be and still be found, against what is plausible on a "
        "robot of this kind. What lies in the grey area is not visible in this log, which "
        "is not the same as absent.",
        partial(figures.detectability, statuses),
    )
    order = [words(verdict) for verdict in figures.VERDICT_COLORS]
    table = Table(
        header,
        tuple(sorted(rows, key=lambda row: order.index(str(row[1])))),
        "All effects of the library, one by one",
        folded=True,
    )
    text = verdicts_text(statuses, unexplained)
    return Section("What else was looked for", text, (table,), (block,))


def _fall(
    study: Study,
    before: tuple[Predictor, Comparison],
    after: tuple[Predictor, Comparison],
    tests: Mapping[str, Log],
) -> Section:
    """What the completed model brings: step by step, by channel, over time; and what it leaves."""
    robot, first, last = before[0].robot, study.steps[0].rollout, study.steps[-1].rollout
    rolled = first is not None and last is not None
    simulated = (
        " Below: the model with everything added so far is simulated in the place of the robot; "
        "its joints against the log's."
    )
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
            partial(figures.falling_error, study.steps, small_motions(robot)),
        )
    ]
    if len(known) > 1:
        drawn = partial(figures.channel_errors, *map(list, zip(*known, strict=True)))
        blocks.append(FigureBlock("Every channel, before and after", _RATIOS, drawn))
    blocks += _measured_torque(study.scenario, before[0], tests)
    if first is not None and last is not None and len(first.sample_time) and len(last.sample_time):
        caption = (
            "Simulated less recorded position of the joints that the model as given misses most, "
            "over the whole log. replay.html, which is saved beside this report, shows the log "
            "(grey), the model as given (orange) and the completed one (teal) in motion."
        )
        blocks.append(
            FigureBlock(
                "The simulated model, before and after",
                caption,
                partial(figures.position_errors, first, last, robot.torque_units),
            )
        )
    # A short log has no bins.
    if binned := list(filter(figures.binned_variables, _worst(after[1]))):
        caption = "Mean error of the completed model in bins of what it may depend on."
        blocks.append(
            FigureBlock(
                "What is left, against what it may depend on",
                caption,
                partial(figures.error_bins, binned),
            )
        )
    left = all_failure_tables(
        after[1], "What the completed model leaves: what still stands out from the noise, in words."
    )
    text = "" if left else "What the completed model leaves does not stand out from the noise."
    return Section(
        "How the error falls",
        text,
        (
            growth_table(study.steps, robot),
            *relative_error_tables(study),
            *simulated_position_tables(study, robot),
            *left,
        ),
        tuple(blocks),
    )


def _relative_fall(study: Study) -> list[tuple[str, str]]:
    """The relative error of all torques together, before and after, as a row of the summary."""
    first, last = study.steps[0].errors, study.steps[-1].errors
    falls = [
        f"on {log_name(name)} {number(100 * error.relative)} % before, "
        f"{number(100 * last[name].relative)} % after"
        for name, error in first.items()
        if np.isfinite(error.relative)
    ]
    return (
        [("Relative torque error", as_sentence("; ".join(falls)))] if falls and study.found else []
    )


def _measured_torque(
    completed: Scenario, given: Predictor, tests: Mapping[str, Log]
) -> list[FigureBlock]:
    """Measured and modelled torque of the worst joints where the model as given errs most, on a log
    that nothing was fitted to if any."""
    name, log = next(iter(tests.items()), ("train", given.motion.log))
    given = Predictor(given.scenario, log)
    after = given.of(completed)
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
        "What the motors gave, and what the model needs for the same motion; "
        f"{number(float(time[-1] - time[0]), 2)} s of {log_name(name)}{part}. Right above each "
        "panel: |error| / |measured| there (2-norms)."
    )
    drawn = partial(figures.torques_over_time, residual, after.residual, places, stretch)
    return [FigureBlock("Measured torque and the model's, before and after", caption, drawn)]


def _worst_stretch(power: np.ndarray) -> slice:
    """The `_SHOWN` averages in a row with the largest sum."""
    total = np.concatenate([[0.0], np.cumsum(power)])
    length = min(_SHOWN, len(power))
    start = int(np.argmax(total[length:] - total[:-length]))
    return slice(start, start + length)


def how_it_falls(diagnosis: Diagnosis, robot: Robot) -> list[Section]:
    """How the error falls on the way to a diagnosis."""
    if len(diagnosis.path) < 2:
        return []
    steps: list[StudyStep] = []
    taken: frozenset[tuple[str, tuple[str, ...]]] = frozenset()
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
        "The error as effects are added",
        _FALLING,
        partial(figures.falling_error, steps, small_motions(robot)),
    )
    return [Section("How the error falls", text, (growth_table(steps, robot),), (block,))]


def _hygiene(predictor: Predictor, inputs: Inputs) -> Section:
    """What was measured, and how it was read."""
    motion, robot, standing = predictor.motion, predictor.robot, predictor.motion.standing
    time, recording = motion.log.time, predictor.scenario.recording
    length = (
        f"{number(float(time[-1] - time[0]))} s, {len(time)} samples, "
        f"{number(1 / motion.period)} Hz"
    )
    if recording.train_share < 1:
        length += (
            f"; the first {number(100 * recording.train_share, 2)} % of the "
            "log, the rest is to test on"
        )
    rows = [
        ("Log", ", ".join(inputs.logs)),
        ("Length", length),
        (
            "Samples that are missing",
            f"{number(100 * float(1 - motion.measured.mean()), 2)} %; "
            "nothing is said about the gaps",
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
        (finding.severity, as_sentence(finding.text)) for finding in inputs.hygiene.findings
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
        f"fbse {command} {inputs.out}/scenario.yaml {shlex.join([*inputs.logs, *inputs.reading])}",
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
