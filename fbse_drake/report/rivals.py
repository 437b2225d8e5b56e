"""The report of a comparison of methods."""

import math
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from fbse_drake.report.html import (
    Details,
    FigureBlock,
    Report,
    Section,
    Table,
    number,
    write_report,
)
from fbse_drake.report.style import ESTIMATE, SIDE_COLORS, WIDTH, add_legend, decorate
from fbse_drake.rivals.cases import NOMINAL
from fbse_drake.rivals.comparison import PHASES, Comparison, Mean
from fbse_drake.rivals.methods import OURS, START
from fbse_drake.rivals.runs import ORACLE, REFERENCES

_MARKERS = "osD^vPX*"


def interval_text(mean: Mean, scale: float = 1.0) -> str:
    """A mean for reading, with its interval if it has one."""
    if math.isnan(mean.low):
        return number(scale * mean.value)
    return (
        f"{number(scale * mean.value)} ({number(scale * mean.low)} to {number(scale * mean.high)})"
    )


def error_table(comparison: Comparison) -> Table:
    """Errors of the friction by method: by phase as believed, and in every other case."""
    others = [case for case in comparison.cases if case != NOMINAL]
    rows = [
        (
            name,
            *(interval_text(comparison.error(NOMINAL, name, (phase,))) for phase in PHASES),
            *(interval_text(comparison.error(case, name)) for case in others),
        )
        for name in comparison.names
    ]
    header = ("Friction NRMSE", *PHASES, *others)
    caption = (
        f"Geometric mean over the joints, from {START:g} s on; in the cases of stance and swing "
        "together. In brackets the 95 % interval of the mean over the seeds."
    )
    return Table(header, tuple(rows), caption)


def loop_table(comparison: Comparison) -> Table:
    """What feeding back is worth."""
    rows = []
    for who in (*REFERENCES, *comparison.names):
        figures = ("tracking", "com_deviation")
        shares = (interval_text(comparison.recovered(who, of), 100.0) for of in figures)
        values = (interval_text(comparison.loop(who, of), 1e3) for of in figures)
        rows.append((who, *values, *shares, str(comparison.falls(who))))
    header = (
        "Fed back",
        "Tracking [mrad]",
        "CoM deviation [mm]",
        "Tracking recovered [%]",
        "CoM recovered [%]",
        "Falls",
    )
    caption = (
        "The centre of mass deviates from that of the same walk without friction. Of what feeding "
        f"back the {ORACLE} takes away, the share that a method does; n/a where that is next to "
        "nothing."
    )
    return Table(header, tuple(rows), caption)


def needs_table(comparison: Comparison) -> Table:
    """What each method must know and measure, how it was tuned, and what a tick costs."""
    ours, rows = comparison.tick(OURS), list[tuple[str, ...]]()
    for tuned in comparison.tuned:
        estimator, name = tuned.method.estimator, tuned.method.name
        settings = ", ".join(f"{key} {getattr(estimator, key):g}" for key in estimator.tunable)
        tuning = f"{number(tuned.before)} to {number(tuned.after)}" if tuned.trials > 1 else "-"
        tick = comparison.tick(name)
        cost = (number(tick), number(tick / ours))
        needs = (estimator.knows, estimator.measures)
        rows.append((name, *needs, settings or "-", tuning, *cost))
    header = ("Method", "Knows", "Measures beside joints", "Tuned", "Score", "Tick [us]", "Of FBSE")
    caption = (
        "Each method with settings to tune had as many trials on another walk; score is the NRMSE "
        "there, as given and tuned. Ticks are medians, all measured in the same runs."
    )
    return Table(header, tuple(rows), caption)


def joint_table(comparison: Comparison) -> Table:
    """Errors by joint and phase, as believed."""
    joints = comparison.joints
    rows: list[tuple[str | float, ...]] = [
        (
            name,
            phase,
            *(comparison.joint_error(NOMINAL, name, phase, joint).value for joint in joints),
        )
        for name in comparison.names
        for phase in PHASES
    ]
    header = ("Friction NRMSE", "Leg in", *(joint.replace("_", " ") for joint in joints))
    return Table(header, tuple(rows), "Means over the seeds, by joint.", folded=True)


def ahead_text(comparison: Comparison) -> str:
    """Where others are ahead of FBSE, in a sentence for each method."""
    sentences = []
    found = list(comparison.ahead())
    for name in comparison.names:
        where = [
            f"{of.joint.replace('_', ' ')} in {of.phase} ({number(of.nrmse)} against "
            f"{number(of.ours)})"
            for of in found
            if of.method == name
        ]
        if where:
            sentences.append(f"{name} is ahead of {OURS} in {', '.join(where)}.")
    return " ".join(sentences) or f"{OURS} is ahead of all others in every joint and phase."


def errors_figure(comparison: Comparison) -> Figure:
    """Errors of all methods in all cases."""
    names, cases = comparison.names, comparison.cases
    figure = Figure(figsize=(WIDTH, 1.2 + 0.34 * len(names)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, sharex=True)
    for axes in (left, right):
        decorate(axes)
    left.set_xscale("log")  # Both share it.
    for k, phase in enumerate(PHASES):
        for row, name in enumerate(names):
            mean = comparison.error(NOMINAL, name, (phase,))
            at, colour = row + 0.16 * (2 * k - 1), SIDE_COLORS[k]
            if not math.isnan(mean.low):
                left.plot([mean.low, mean.high], [at, at], color=colour, linewidth=1.2)
            label = phase if row == 0 else None
            left.plot(mean.value, at, "o", color=colour, markersize=5, label=label)
    for k, case in enumerate(cases):
        values = [comparison.error(case, name).value for name in names]
        style = {"color": ESTIMATE if case == NOMINAL else f"C{k}", "markersize": 5}
        right.plot(values, range(len(names)), _MARKERS[k % len(_MARKERS)], label=case, **style)
    left.set_title(NOMINAL, loc="left", fontsize=10)
    right.set_title("in every case, stance and swing together", loc="left", fontsize=10)
    left.set_yticks(range(len(names)), names)
    left.set_ylim(len(names) - 0.5, -0.5)
    for axes in (left, right):
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("friction NRMSE, geometric mean of the joints [1]")
    add_legend(figure)
    return figure


def outcome_text(comparison: Comparison, seeds: int) -> str:
    """The result in one sentence."""
    ranked = sorted(comparison.names, key=lambda name: comparison.error(NOMINAL, name).value)
    best = ", ".join(
        f"{name} {number(comparison.error(NOMINAL, name).value)}" for name in ranked[:3]
    )
    of = "one seed" if seeds == 1 else f"{seeds} seeds"
    return f"Nearest to the friction, as believed, {of}: {best}."


def write_rivals_report(
    path: Path, comparison: Comparison, *, name: str, seeds: int, scenario: str
) -> None:
    """Writes the report as one HTML file.

    Args:
        name: what the scenario is called.
        seeds: how many walks each figure is of.
        scenario: its text.
    """
    caption = (
        "Left with stance and swing apart, and the 95 % interval of the mean over the seeds; right "
        "what becomes of it when something is not as the methods are told."
    )
    picture = FigureBlock("Errors of all methods", caption, partial(errors_figure, comparison))
    broken = [f"Not done: {line}." for line in comparison.broken]
    ended = [
        f"{case}, seed {seed}: {why}."
        for case, of_case in comparison.failures.items()
        for seed, why in of_case.items()
    ]
    unfit = [f"Not compared: {method}: {why}." for method, why in comparison.unfit.items()]
    tables = (error_table(comparison), joint_table(comparison))
    sections = (
        Section("Friction", ahead_text(comparison), tables=tables, figures=(picture,)),
        Section("In the loop", tables=(loop_table(comparison),)),
        Section("What each needs", " ".join(unfit), tables=(needs_table(comparison),)),
        Section("Walks that ended early", " ".join([*ended, *broken]) or "None."),
        Section("Scenario", details=(Details("As it was run", scenario),)),
    )
    write_report(
        path, Report(f"{name}: rivals", not broken, outcome_text(comparison, seeds), sections)
    )
