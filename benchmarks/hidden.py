"""How well missing physics is found: `python -m benchmarks.hidden [--quick] [--sample N]
[--only NAME] [--seeds N] [--sizes SIZE ...] [--jobs N] [--keep] [--out DIR]`.

Hides every effect of the library in the paper's walk, in three sizes and for several seeds; also
nothing, two effects at once, effects that the library does not have, and effects in robots that
differ from their model in contact solver, plant step or friction law. Each log is diagnosed. Every
case becomes a row of a campaign in DIR; those that are there already, made by the same sources, are
not run again. Prints the figures beside what was asked for and saves them as DIR/report.html with
the confusion matrix, which is also DIR/confusion.png.
"""

import argparse
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from benchmarks.cases import (
    NOTHING,
    UNKNOWN,
    Result,
    add_options,
    drawn,
    judged,
    share,
    sources_checksum,
)
from benchmarks.console import print_table
from benchmarks.store import Store
from fbse_drake import load_scenario, schema
from fbse_drake.campaign.steps import Material
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose, diagnosis_json
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import study, study_json
from fbse_drake.discrepancy.exercises.hidden import (
    Answer,
    HiddenEffect,
    make_exercise,
    record,
    score,
)
from fbse_drake.discrepancy.exercises.sizes import SIZES
from fbse_drake.discrepancy.exercises.strangers import STRANGERS
from fbse_drake.effects.effect import library
from fbse_drake.report.html import (
    Details,
    FigureBlock,
    Report,
    Section,
    Table,
    write_report,
)

_SCENARIO = "paper_walk"
_FRICTION = frozenset(
    {
        "CoulombFriction",
        "ViscousFriction",
        "StribeckFriction",
        "DirectionalFriction",
        "DirectionalViscousFriction",
        "LoadDependentFriction",
        "QuadraticDrag",
        "ThermalDrift",
        "PreslidingHysteresis",
    }
)


@dataclass(frozen=True)
class Mismatch:
    """A robot that differs from its model otherwise than by what is hidden."""

    description: str
    # Of the robot's scenario.
    overrides: tuple[str, ...]
    # Effects that rightly stand for the difference.
    allowed: frozenset[str] = frozenset()


_CREEP = frozenset({"FootCreep", "GroundCompliance"})
_OTHER_LAW = (
    "robot.effects.joint_friction=!CoulombViscousFriction {coulomb: {hip_yaw: 0.9, hip_roll: 0.8, "
    "hip_pitch: 0.6, knee_pitch: 0.5, "
    "ankle_pitch: 0.1, ankle_roll: 0.05}, viscous: {all: 0.9}}"
)
_MISMATCHES = {
    "similar": Mismatch(
        "contact solver (similar)", ("plant.discrete_contact_approximation=similar",), _CREEP
    ),
    "sap": Mismatch("contact solver (sap)", ("plant.discrete_contact_approximation=sap",), _CREEP),
    "step": Mismatch("plant step (0.5 ms)", ("plant.time_step=0.0005",)),
    "friction": Mismatch("friction law", (_OTHER_LAW,), _FRICTION),
}
# Effects, targets and parameters whose stated smallest size is tried, at half and at twice of it.
_THRESHOLDS = {
    "CoulombFriction": ("left_knee_pitch", "coulomb"),
    "ViscousFriction": ("left_ankle_pitch", "viscous"),
    "LoadDependentFriction": ("right_hip_roll", "coefficient"),
    "TorqueGain": ("left_hip_pitch", "shortfall"),
    "TorqueBias": ("right_hip_pitch", "bias"),
    "ReflectedInertia": ("left_knee_pitch", "inertia"),
    "BodyMass": ("trunk", "mass"),
    "FootForceGain": ("left", "gain"),
    "EncoderOffset": ("right_ankle_pitch", "offset"),
    "GyroscopeBias": ("robot", "x"),
}
# For what can only be hidden in second encoders.
_SECOND_ENCODERS = ("sensors.motor_encoders={resolution: 4.8e-5}",)
# Logs without a hidden effect whose model is simulated: they show what the sensors' noise alone
# makes of two walks.
_ROLLED_DECOYS = 4


@dataclass(frozen=True)
class Case:
    """One log and its diagnosis."""

    name: str
    group: Literal["effect", "decoy", "stranger", "pair", "mismatch", "threshold", "length"]
    # As in `fbse_drake.discrepancy.exercises.hidden.draw`.
    what: str
    size: str = "medium"
    count: int = 1
    # Of the scenario that is recorded.
    overrides: tuple[str, ...] = ()
    # Is the model simulated as well, with what was found and without?
    rollout: bool = False
    # In the place of what is drawn.
    answer: Answer | None = None

    @property
    def seed(self) -> int:
        return zlib.crc32(self.name.encode())


def cases(seeds: int, sizes: Sequence[str], *, quick: bool) -> list[Case]:
    """All cases but those at the smallest size that can be found, see `threshold_cases`."""
    effects = {
        name: effect
        for name, effect in library().items()
        if not (effect.composite or effect.needs_sampled_torque or effect.needs_fixed_base)
    }
    result = [
        Case(f"decoy-{seed}", "decoy", "decoy", rollout=seed < _ROLLED_DECOYS)
        for seed in range(4 if quick else 30)
    ]
    for seed in range(seeds):
        for size in sizes:
            rollout = size == "large" and seed == 0
            result += [
                Case(
                    f"effect-{name}-{size}-{seed}",
                    "effect",
                    name,
                    size,
                    overrides=_SECOND_ENCODERS if effect.needs_motor_encoder else (),
                    rollout=rollout,
                )
                for name, effect in effects.items()
            ]
    for seed in range(1 if quick else 2):
        result += [
            Case(f"stranger-{name}-{size}-{seed}", "stranger", name, size)
            for name in STRANGERS
            for size in SIZES[1:]
        ]
    result += [
        Case(f"pair-{seed}", "pair", "library", SIZES[1 + seed % 2], 2)
        for seed in range(3 if quick else 15)
    ]
    for name, mismatch in _MISMATCHES.items():
        for seed in range(1 if quick else 3):
            for what, size in (("decoy", "medium"), ("library", SIZES[1 + seed % 2])):
                result.append(
                    Case(
                        f"mismatch-{name}-{what}-{seed}",
                        "mismatch",
                        what,
                        size,
                        overrides=mismatch.overrides,
                    )
                )
    return result


def length_cases() -> list[Case]:
    """One effect in walks once, twice and four times as long."""
    hidden = HiddenEffect(
        "TorqueGain", ("left_knee_pitch",), 0.1, {"shortfall": {"left_knee_pitch": 0.1}}
    )
    answer = Answer("library", "large", 1.0, (hidden,))
    result = []
    for times, supports in ((1, 7), (2, 14), (4, 30)):
        overrides = (f"duration={11.5 * times}", f"reference.single_supports={supports}")
        result.append(
            Case(
                f"length-{times}",
                "length",
                "TorqueGain",
                "large",
                overrides=overrides,
                answer=answer,
            )
        )
    return result


def threshold_cases(stated: dict[str, dict[str, float]]) -> list[Case]:
    """Effects of half and of twice the smallest size that can be found.

    Args:
        stated: that size, by effect and target.
    """
    result = []
    for name, (target, parameter) in _THRESHOLDS.items():
        for label, factor in (("half", 0.5), ("twice", 2.0)):
            size = factor * stated.get(name, {}).get(target, np.inf)
            if np.isfinite(size):
                answer = Answer(
                    "library",
                    "small",
                    1.0,
                    (HiddenEffect(name, (target,), size, {parameter: {target: size}}),),
                )
                result.append(Case(f"threshold-{name}-{label}", "threshold", name, answer=answer))
    return result


def _run(case: Case) -> dict[str, Any]:
    # However small an effect is, it is to be found.
    exact = "identify.tolerance=0"
    scenario = load_scenario(_SCENARIO, overrides=[*case.overrides, exact])
    if case.answer is not None:
        exercise = record(scenario, _SCENARIO, case.answer, case.seed)
    else:
        exercise = make_exercise(
            scenario, _SCENARIO, case.seed, what=case.what, size=case.size, count=case.count
        )
    scenario = exercise.scenario
    if case.group == "mismatch":
        # What is believed knows nothing of the overrides.
        believed = load_scenario(_SCENARIO, overrides=[exact])
        scenario = replace(believed, model=believed.robot)
    start = time.perf_counter()
    if case.rollout:
        found = study_json(study(scenario, exercise.log))
    else:
        found = {
            "diagnoses": [diagnosis_json(diagnose(Predictor(scenario, exercise.log)))],
            "steps": [],
        }
    duration = time.perf_counter() - start
    return {
        "answer": asdict(exercise.answer),
        "score": asdict(score(exercise.answer, found["diagnoses"])),
        "wall_time": duration,
        "steps": found["steps"],
        "diagnoses": found["diagnoses"],
    }


def judge(material: Material) -> dict[str, str]:
    """Runs a case; see `benchmarks.store.Store`."""
    case = schema.build(Case, material.values["case"], file="", key="case")
    return judged(case, _run(case), sources_checksum())


def stated_sizes(decoys: Sequence[Result]) -> dict[str, dict[str, float]]:
    """The smallest size that can be found, by effect and target: the median of what the diagnoses
    of the decoys say."""
    sizes: dict[str, dict[str, float]] = {}
    for name in library():
        stated = [
            decoy.diagnosis["effects"].get(name, {}).get("smallest_detectable_by_target", {})
            for decoy in decoys
        ]
        targets = dict.fromkeys(target for of_decoy in stated for target in of_decoy)
        sizes[name] = {
            target: float(np.median([of_decoy.get(target, np.inf) for of_decoy in stated]))
            for target in targets
        }
    return sizes


@dataclass(frozen=True)
class Figures:
    """All figures of merit."""

    results: list[Result]

    @staticmethod
    def of_finished(results: Iterable[Result]) -> "Figures":
        """The figures of those cases that did not raise an error."""
        return Figures([result for result in results if "error" not in result.tree])

    def of(self, *groups: str) -> list[Result]:
        return [result for result in self.results if result.group in groups]

    @cached_property
    def stated(self) -> dict[str, dict[str, float]]:
        return stated_sizes(self.of("decoy"))

    @cached_property
    def visible(self) -> list[Result]:
        """Single effects of the library that are large enough."""
        return [result for result in self.of("effect") if result.is_visible(self.stated)]

    def table(self) -> Table:
        """What was asked for and what came out."""
        visible, strangers, decoys = self.visible, self.of("stranger"), self.of("decoy")
        missed = [r for r in visible if not r.score["first"]]
        pairs = [r for r in self.of("pair") if r.is_visible(self.stated)]
        small = [r for r in self.of("effect") if not r.is_visible(self.stated)]
        right = [r for r in visible if r.is_found(alternatives=False)]
        covered = [value for r in right for value in r.score["covered"].values()]
        # What is wrong with a sensor that the controller does not read changes no bit of the
        # simulated motion, and a small effect less than other noise does.
        noise = max((_rollouts(r)[0] for r in decoys if r.tree["steps"]), default=0.0)
        rolled = [
            r
            for r in self.of("effect")
            if len(r.tree["steps"]) > 1 and r.is_found() and len(set(_rollouts(r))) > 1
        ]
        walks = [(before, after) for before, after in map(_rollouts, rolled) if before > noise]
        half, twice = (
            [r for r in self.of("threshold") if r.name.endswith(label)]
            for label in ("half", "twice")
        )
        times = [
            r.tree["wall_time"] for r in self.results if r.group != "length" and not r.tree["steps"]
        ]
        lengths = {r.name: r.tree["wall_time"] for r in self.of("length")}
        rows = [
            (
                "hidden effect ranked first (above the stated smallest size)",
                ">= 95 %",
                *share(r.score["first"] for r in visible),
            ),
            (
                "  the rest: declared confusable with the first",
                "100 %",
                *share(r.is_alternative() for r in missed),
            ),
            (
                "  where it is found: on exactly the right targets",
                "",
                *share(all(r.score["targets"].values()) for r in right),
            ),
            (
                "  where it is found: no effect named that is not there",
                "",
                *share(not r.score["wrong"] for r in right),
            ),
            (
                "  where it is found: with the verdict effect_found",
                "",
                *share(r.score["verdict"] for r in right),
            ),
            (
                "nothing hidden: false alarms",
                "<= 1 of 30",
                f"{sum(not r.score['verdict'] for r in decoys)}",
                f"{len(decoys)}",
            ),
            (
                "below the stated smallest size: no other effect named",
                "",
                *share(not r.score["wrong"] for r in small),
            ),
            (
                "not in the library: unknown_effect",
                "",
                *share(r.score["verdict"] for r in strangers),
            ),
            (
                "  with exactly the right joints",
                ">= 80 %",
                *share(r.score["verdict"] and r.score["joints"] for r in strangers),
            ),
            ("  a wrong name with confidence", "<= 10 %", *share(r.is_wrong() for r in strangers)),
            ("two effects: both found", ">= 80 %", *share(r.is_found() for r in pairs)),
            (
                "held-out residual after adding <= 1.2 x noise",
                "100 %",
                *share(r.diagnosis["held_out_after"] <= 1.2 for r in right),
            ),
            (
                "rollout error falls, where it is more than noise",
                "100 %",
                *share(before > after for before, after in walks),
            ),
            ("95 % intervals that hold the true value", "88 to 99 %", *share(covered)),
            (
                "half the stated smallest size: not found",
                "100 %",
                *share(not any(r.score["found"].values()) for r in half),
            ),
            (
                "twice the stated smallest size: found",
                "100 %",
                *share(r.is_found() for r in twice),
            ),
            *(
                (
                    f"another {m.description} than the model's: a wrong name with confidence",
                    "0 %",
                    *share(bad for _, bad in self._misled(name)),
                )
                for name, m in _MISMATCHES.items()
            ),
            (
                "time of a diagnosis, median and longest, with all cores busy",
                "<= 60 s",
                _spread(times),
                f"{len(times)}",
            ),
            *(
                (
                    f"  of a log {k} times as long",
                    f"{k} times as long",
                    _ratio(lengths, f"length-{k}", "length-1"),
                    "1",
                )
                for k in (2, 4)
                if f"length-{k}" in lengths
            ),
        ]
        return Table(("figure", "asked", "measured", "of"), tuple(rows))

    def _misled(self, name: str) -> list[tuple[Result, bool]]:
        """Cases of a mismatch: do they name a wrong effect with confidence?"""
        mine = [r for r in self.of("mismatch") if r.name.startswith(f"mismatch-{name}-")]
        return [(r, r.is_wrong(_MISMATCHES[name].allowed)) for r in mine]

    def by_effect(self) -> Table:
        """What became of each effect."""
        rows = []
        for name in library():
            mine = [r for r in self.of("effect") if r.truth == name]
            if not mine:
                continue
            seen = [r for r in mine if r in self.visible]
            counts = [
                f"{sum(r.score['first'] for r in mine if r.size == size)}/"
                f"{sum(r.size == size for r in mine)}"
                for size in SIZES
            ]
            others = Counter(r.label for r in seen if not r.score["first"])
            covered = [value for r in seen for value in r.score["covered"].values()]
            after = [r.diagnosis["held_out_after"] for r in seen if r.score["first"]]
            shown = ", ".join(f"{label} {count}" for label, count in others.items())
            middle = float(np.median(after)) if after else np.nan
            shrunk = sum(r.tree["answer"]["shrunk"] < 1 for r in mine)
            rows.append(
                (
                    name,
                    *counts,
                    f"{len(mine) - len(seen)}",
                    f"{shrunk}",
                    shown,
                    share(covered)[0],
                    middle,
                )
            )
        header = (
            "hidden",
            *SIZES,
            "too small",
            "made smaller",
            "first instead",
            "intervals",
            "held-out after",
        )
        return Table(header, tuple(rows))

    def failures(self) -> list[str]:
        """A line for each case that did not go as it should."""
        bad = [r for r in self.visible if not r.score["first"]]
        bad += [r for r in self.of("effect") if r not in self.visible and r.score["wrong"]]
        bad += [r for r in self.of("decoy") if not r.score["verdict"]]
        bad += [r for r in self.of("stranger") if not (r.score["verdict"] and r.score["joints"])]
        bad += [r for r in self.of("pair") if r.is_visible(self.stated) and not r.is_found()]
        bad += [r for r in self.of("threshold") if r.is_found() != r.name.endswith("twice")]
        bad += [r for name in _MISMATCHES for r, misled in self._misled(name) if misled]
        return [r.text() for r in bad]

    def confusion(self) -> Figure:
        """How often each hidden effect led to each answer: shares of a row, with the counts."""
        shown = [
            r
            for r in self.of("effect", "decoy", "stranger")
            if r.group != "effect" or r in self.visible
        ]
        counts = Counter((r.truth, r.label) for r in shown)
        names = [*(name for name, effect in library().items() if not effect.composite), NOTHING]
        rows = [name for name in (*names, *STRANGERS) if any(truth == name for truth, _ in counts)]
        columns = [*names, UNKNOWN]
        matrix = np.array(
            [[counts[row, column] for column in columns] for row in rows], dtype=float
        ).reshape(len(rows), len(columns))
        figure = Figure(figsize=(12, 11), layout="constrained")
        axes = figure.add_subplot()
        axes.imshow(
            matrix / np.maximum(matrix.sum(axis=1, keepdims=True), 1),
            cmap="Blues",
            vmin=0,
            vmax=1.4,
        )
        for i, j in zip(*np.nonzero(matrix), strict=True):
            axes.text(j, i, f"{matrix[i, j]:.0f}", ha="center", va="center", fontsize=8)
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
        axes.set_yticks(range(len(rows)), rows, fontsize=8)
        axes.set(xlabel="ranked first", ylabel="hidden")
        return figure


def _spread(values: Sequence[float]) -> str:
    return f"{np.median(values):.0f} s, {max(values):.0f} s" if values else "n/a"


def _ratio(times: dict[str, float], name: str, reference: str) -> str:
    return f"{times[name] / times[reference]:.2f}" if reference in times else "n/a"


def _rollouts(result: Result) -> tuple[float, float]:
    """Error of the model simulated against the log [rad], as it was and with all that was added."""
    before, after = (result.tree["steps"][k]["rollout_rmse"]["joint_position"] for k in (0, -1))
    return before, after


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs what has not been run, and prints the figures of all that has."""
    parser = argparse.ArgumentParser(description="How well missing physics is found.")
    quick = "one seed, medium sizes, few of the other cases"
    add_options(parser, "out/hidden", quick, "effect-TorqueGain or decoy")
    parser.add_argument(
        "--seeds", type=int, default=3, help="number of seeds of each effect and size (default 3)"
    )
    parser.add_argument(
        "--sizes",
        nargs="+",
        choices=SIZES,
        default=SIZES,
        help="sizes of the effects (default all)",
    )
    options = parser.parse_args(arguments)
    console = Console(width=190)
    sources = None if options.keep else sources_checksum()
    seeds, sizes = (1, ("medium",)) if options.quick else (options.seeds, options.sizes)

    def store(name: str, some: Sequence[Case]) -> Store:
        return Store(options.out / name, "benchmarks.hidden:judge", some, sources)

    found = store("cases", drawn(cases(seeds, sizes, quick=options.quick), options))
    found.run(console, "hiding and finding", only=options.only, workers=options.jobs)
    stated = Figures.of_finished(found.read()).stated
    thresholds = store("thresholds", threshold_cases(stated))
    lengths = store("lengths", length_cases())
    if not options.quick and options.sample is None:
        thresholds.run(console, "at the smallest sizes", only=options.only, workers=options.jobs)
        # Alone, since their times are compared.
        lengths.run(console, "longer logs", only=options.only, workers=1)

    everything = [*found.read(), *thresholds.read(), *lengths.read()]
    figures = Figures.of_finished(everything)
    errors = [
        f"{result.name}:\n{result.tree['error']}" for result in everything if "error" in result.tree
    ]
    made = {"What was asked for": figures.table(), "By effect": figures.by_effect()}
    for title, table in made.items():
        print_table(console, title, table)
    failures = "\n".join([*figures.failures(), *errors])
    console.print(failures, highlight=False, soft_wrap=True)
    figures.confusion().savefig(options.out / "confusion.png", dpi=130)
    caption = "Hidden effects large enough to be found, decoys and strangers; numbers count cases."
    sections = (
        *(Section(title, tables=(table,)) for title, table in made.items()),
        Section(
            "Confusion",
            figures=(
                FigureBlock(
                    "What was hidden and what was ranked first", caption, figures.confusion
                ),
            ),
        ),
        Section("Cases that went wrong", details=(Details("One line each", failures or "none"),)),
    )
    versions = len({result.tree["sources"] for result in everything})
    outcome = (
        f"{len(everything)} cases, made by {versions} "
        f"version{'s' if versions != 1 else ''} of the sources."
    )
    console.print(outcome, highlight=False)
    write_report(
        options.out / "report.html",
        Report("Finding the missing physics", not errors, outcome, sections),
    )
    console.print(f"Report: {options.out / 'report.html'}", highlight=False)


if __name__ == "__main__":
    main()
