"""The report of a run: simulated, or recorded and estimated."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fbse_drake.effects.effect import library, spaced
from fbse_drake.log import Log
from fbse_drake.report.figures import run_figures
from fbse_drake.report.figures.joint_chart import joint_chart
from fbse_drake.report.html import (
    Details,
    Report,
    Section,
    Step,
    Table,
    number,
    numeric_table,
    percent,
    write_report,
)
from fbse_drake.report.metrics import LAW_TOLERANCE, broken_laws, consistency, worst_joint


def write_run_report(
    path: str | Path,
    log: Log,
    metrics: Mapping[str, Any],
    *,
    name: str,
    folder: Path | None = None,
) -> None:
    """Writes the report of a run as one HTML file; it shows what the log has the channels for.

    Args:
        metrics: contents of metrics.json, see `run_metrics`; `remarks` of an estimate.
        name: what the scenario is called.
        folder: where log.npz and scenario.yaml lie, for the commands that the report proposes.
    """
    figures = {topic: tuple(blocks) for topic, blocks in run_figures(log).items()}
    sections = [
        Section("Summary", log.meta.get("title", ""), tables=(key_figures(metrics),)),
        Section("Motion", figures=figures["walk"]),
        Section(
            "Joints",
            tables=_tracking_table(metrics),
            figures=(joint_chart(log), *figures["joints"]),
        ),
        Section("Foot forces", figures=figures["forces"]),
        Section(
            "Friction",
            law_step(metrics["friction_law_error"]) or "",
            tables=_friction_table(metrics),
            figures=figures["friction"],
        ),
        Section("Base state", figures=figures["base"]),
        Section(
            "Consistency",
            _CONSISTENCY,
            tables=_consistency_table(log),
            figures=figures["consistency"],
        ),
        Section("Sensors", tables=_remarks_table(metrics), figures=figures["sensors"]),
        Section(
            "Scenario",
            "The scenario as it was run, with all its defaults.",
            tables=_parameter_tables(log),
            details=_scenarios(log),
        ),
    ]
    shown = tuple(
        section for section in sections if section.tables or section.figures or section.details
    )
    steps = _steps(metrics, folder) if folder is not None else ()
    write_report(path, Report(name, not metrics["fell"], run_outcome(metrics), shown, steps))


def _steps(metrics: Mapping[str, Any], folder: Path) -> tuple[Step, ...]:
    """What to do after a run."""
    study = f"fbse study {folder}/scenario.yaml {folder}/log.npz"
    steps = [
        Step("Find the physics that the scenario's model lacks:", study),
        Step("See it beside other runs:", f"fbse report {folder} ANOTHER_RUN"),
    ]
    if law := law_step(metrics["friction_law_error"]):
        steps.insert(0, law)
    return tuple(steps)


def law_step(law_error: Mapping[str, float]) -> Step | None:
    """In which joints the simulated torque is not its law, and what to do; None if it is in all.

    Args:
        law_error: see `friction_law_error`.
    """
    if not (broken := broken_laws(law_error)):
        return None
    joints = ", ".join(f"{_words(joint)} ({percent(error)})" for joint, error in broken.items())
    return Step(
        "The simulated joint torque differs from its law by more than "
        f"{100 * LAW_TOLERANCE:g} % of the law's RMS in {joints}. "
        "Steps that are solved twice bring it closer, and so do shorter ones (plant.time_step):",
        "--set solve_twice=true",
    )


_CONSISTENCY = (
    "A filter is consistent if its innovations are as large as it expects: then their normalised "
    "squares (NIS) average 1, and the mean lies between the bounds with 95 % probability if the "
    "innovations are white. Errors that last make it leave the bounds without being wrong."
)


def run_outcome(metrics: Mapping[str, Any]) -> str:
    """How a run ended, in one sentence."""
    if metrics["outcome"] == "recorded":
        return f"A recording of {number(metrics['simulated_time'])} s."
    if metrics["outcome"] != "finished":
        return f"The run ended early at {metrics['outcome']}."
    return f"The run finished after {number(metrics['simulated_time'])} s."


def key_figures(metrics: Mapping[str, Any]) -> Table:
    """The figures of a run that are known."""
    tracking, law = metrics["joint_tracking_rms"], metrics["friction_law_error"]
    worst, farthest = worst_joint(tracking), worst_joint(law)
    rows = [
        ("Length of the run", metrics["simulated_time"], "s"),
        ("Wall time", metrics["wall_time"], "s"),
        ("Length per wall time", metrics["real_time_factor"], "1"),
        (
            "Joint tracking error, RMS, mean of the joints",
            1e3 * float(np.mean(list(tracking.values()))),
            "mrad",
        ),
        (
            f"Joint tracking error, RMS, worst joint ({_words(worst)})",
            1e3 * tracking[worst],
            "mrad",
        ),
        (
            f"Simulated torque less its law, RMS, worst joint ({_words(farthest)})",
            round(100 * law[farthest], 2),
            "% of law",
        ),
        *(
            (f"CoM error in {axis}, mean", 1e3 * value, "mm")
            for axis, value in metrics["com_rse_mean"].items()
        ),
        *(
            (f"Creep of the {side} foot in a stance, largest", 1e3 * value, "mm")
            for side, value in metrics["stance_creep_max"].items()
        ),
        *(
            (f"Estimated {angle}, RMS error", value, "deg")
            for angle, value in metrics["attitude_rmse_deg"].items()
        ),
        *(
            (f"Estimated base velocity in {axis}, RMS error", 1e3 * value, "mm/s")
            for axis, value in metrics["base_velocity_rmse"].items()
        ),
        *(
            (f"Estimator tick, {statistic}", value, "µs")
            for statistic, value in metrics["tick_us"].items()
        ),
    ]
    (table,) = numeric_table(("", "Value", "Unit"), rows)
    return table


def _tracking_table(metrics: Mapping[str, Any]) -> tuple[Table, ...]:
    rows = [(_words(joint), 1e3 * value) for joint, value in metrics["joint_tracking_rms"].items()]
    return numeric_table(("Joint", "Tracking error, RMS [mrad]"), rows)


def _friction_table(metrics: Mapping[str, Any]) -> tuple[Table, ...]:
    """Errors of the estimated friction, per joint and phase of its leg."""
    kinds = [
        metrics[kind][phase]
        for phase in ("stance", "swing")
        for kind in ("friction_rmse", "friction_nrmse")
    ]
    rows = [
        (_words(joint), *(values[joint] for values in kinds))
        for joint in metrics["joint_tracking_rms"]
    ]
    return numeric_table(
        ("Joint", "Stance, RMSE [Nm]", "Stance, NRMSE [1]", "Swing, RMSE [Nm]", "Swing, NRMSE [1]"),
        rows,
    )


def _remarks_table(metrics: Mapping[str, Any]) -> tuple[Table, ...]:
    """What an estimate believed of the sensors and found, sentence by sentence."""
    rows = tuple((remark,) for remark in metrics.get("remarks", ()))
    return (Table(("What was believed of them, and what was found",), rows),) if rows else ()


def _consistency_table(log: Log) -> tuple[Table, ...]:
    rows = [
        (_words(name), _words(part), found.nis, found.lower, found.upper, float(found.count))
        for name, parts in consistency(log).items()
        for part, found in parts.items()
    ]
    return numeric_table(
        ("Filter", "Innovation of", "Mean NIS [1]", "Lower bound", "Upper bound", "Innovations"),
        rows,
    )


def _scenarios(log: Log) -> tuple[Details, ...]:
    """Scenarios that the log holds: that of the simulation, and that of the estimator which ran
    over the log later."""
    titles = {
        "scenario": "YAML",
        "estimator_scenario": "YAML of the estimator that ran over the log",
    }
    return tuple(Details(title, log.meta[key]) for key, title in titles.items() if key in log.meta)


def _parameter_tables(log: Log) -> tuple[Table, ...]:
    """What the parameters of the scenario's effects are, where their names do not say it."""
    named = " ".join(scenario.text for scenario in _scenarios(log))
    rows = tuple(
        (spaced(name), key, parameter.meaning, parameter.unit)
        for name, effect in library().items()
        for key, parameter in effect.parameters.items()
        if parameter.meaning and name in named
    )
    header = ("Effect", "Parameter", "What it is", "Unit")
    return (Table(header, rows, "What the parameters are.", folded=True),) if rows else ()


def _words(name: str) -> str:
    return name.replace("_", " ")
