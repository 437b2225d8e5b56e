"""What a comparison of methods has shown: figures with their intervals over the seeds."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import t as student

from fbse_drake.rivals.cases import NOMINAL
from fbse_drake.rivals.methods import OURS, Tuned
from fbse_drake.rivals.runs import FRICTIONLESS, ORACLE, UNCOMPENSATED

PHASES = ("stance", "swing")
_CONFIDENCE = 0.95
# True friction recovers something if it takes away at least this share of the error.
_LEAST_GAIN = 0.05


@dataclass(frozen=True)
class Mean:
    """A mean over seeds with its 95 % interval by Student's t, which one seed does not have."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @staticmethod
    def of(values: Sequence[float]) -> "Mean":
        """Of one value for each seed; not a number of those that do not have one."""
        known = np.array(values, dtype=float)
        if len(known) == 0 or not np.isfinite(known).all():
            return Mean(math.nan)
        mean = float(known.mean())
        if len(known) == 1:
            return Mean(mean)
        half = student.ppf((1 + _CONFIDENCE) / 2, len(known) - 1)
        half *= float(known.std(ddof=1)) / math.sqrt(len(known))
        return Mean(mean, mean - half, mean + half)


@dataclass(frozen=True)
class InTheLoop:
    """What a walk in which the friction is compensated was like."""

    # Mean over the joints of their rms tracking errors [rad].
    tracking: float
    # Mean distance of the centre of mass to that of the same walk without friction [m].
    com_deviation: float
    fell: bool


@dataclass(frozen=True)
class Ahead:
    """A joint and phase in which another method was nearer to the friction than FBSE."""

    method: str
    phase: str
    joint: str
    nrmse: float
    ours: float


@dataclass
class Comparison:
    """Figures of all methods; those of a run that is missing or failed are not there."""

    tuned: list[Tuned]
    # Methods that cannot run in this scenario, and why.
    unfit: dict[str, str]
    # NRMSE of the friction by case, method, seed, phase and joint.
    nrmse: dict[str, dict[str, dict[int, dict[str, dict[str, float]]]]] = field(
        default_factory=dict
    )
    # Walks that ended early, by case: seeds and why.
    failures: dict[str, dict[int, str]] = field(default_factory=dict)
    # By method or reference, and seed.
    loops: dict[str, dict[int, InTheLoop]] = field(default_factory=dict)
    # Median time of a tick by method and seed, side by side in the same runs [us].
    ticks: dict[str, dict[int, float]] = field(default_factory=dict)
    # Runs that could not be done, in words.
    broken: list[str] = field(default_factory=list)

    def add_watched(self, case: str, seed: int, result: Mapping[str, Any]) -> None:
        """Takes what `runs.watching` gives."""
        for method, watched in result["watched"].items():
            by_case = self.nrmse.setdefault(case, {})
            by_case.setdefault(method, {})[seed] = watched["nrmse"]
            if "tick" in watched:
                self.ticks.setdefault(method, {})[seed] = watched["tick"]
        if result["failure"] is not None:
            self.failures.setdefault(case, {})[seed] = result["failure"]

    def add_loops(self, walks: Mapping[tuple[str, int], Mapping[str, Any]]) -> None:
        """Takes what `runs.feeding_back` gives, by method or reference and seed."""
        for (who, seed), walk in walks.items():
            deviation = math.nan
            if (free := walks.get((FRICTIONLESS, seed))) is not None:
                com, other = (np.array(of["com"]) for of in (walk, free))
                rows = min(len(com), len(other))
                away = com[:rows] - other[:rows]
                deviation = float(np.linalg.norm(away, axis=1).mean())
            fell = walk["failure"] is not None
            self.loops.setdefault(who, {})[seed] = InTheLoop(walk["tracking"], deviation, fell)

    @property
    def names(self) -> list[str]:
        """Of the methods."""
        return [tuned.method.name for tuned in self.tuned]

    @property
    def cases(self) -> list[str]:
        """Those that were walked."""
        return list(self.nrmse)

    def error(self, case: str, method: str, phases: Sequence[str] = PHASES) -> Mean:
        """Geometric mean over joints and phases of the friction's NRMSE."""
        seeds = self.nrmse.get(case, {}).get(method, {}).values()
        return Mean.of([_geometric([v for p in phases for v in of[p].values()]) for of in seeds])

    def joint_error(self, case: str, method: str, phase: str, joint: str) -> Mean:
        """NRMSE of the friction of one joint."""
        seeds = self.nrmse.get(case, {}).get(method, {}).values()
        return Mean.of([of[phase][joint] for of in seeds])

    @property
    def joints(self) -> list[str]:
        """Of the robot."""
        by_method = next(iter(self.nrmse.values()), {})
        seeds = next(iter(by_method.values()), {})
        return list(next(iter(seeds.values()), {PHASES[0]: {}})[PHASES[0]])

    def tick(self, method: str) -> float:
        """Median time of a tick [us]."""
        times = list(self.ticks.get(method, {}).values())
        return float(np.median(times)) if times else math.nan

    def loop(self, who: str, figure: str) -> Mean:
        """A figure of `InTheLoop`."""
        return Mean.of([getattr(walk, figure) for walk in self.loops.get(who, {}).values()])

    def recovered(self, who: str, figure: str) -> Mean:
        """Share of what feeding back the true friction takes away of a figure of `InTheLoop`.

        Not a number where the true friction takes away next to nothing: there is nothing to win.
        """
        shares = []
        for seed, walk in self.loops.get(who, {}).items():
            without, true = (self.loops.get(of, {}).get(seed) for of in (UNCOMPENSATED, ORACLE))
            if without is None or true is None:
                return Mean(math.nan)
            start, best, reached = (getattr(of, figure) for of in (without, true, walk))
            worth = start - best > _LEAST_GAIN * start
            shares.append((start - reached) / (start - best) if worth else math.nan)
        return Mean.of(shares)

    def falls(self, who: str) -> int:
        """How many of its walks ended early."""
        return sum(walk.fell for walk in self.loops.get(who, {}).values())

    def ahead(self) -> Iterator[Ahead]:
        """Where, in the walk as believed, others are ahead of FBSE's default."""
        for method in self.names:
            for phase in PHASES:
                for joint in self.joints:
                    theirs, ours = (
                        self.joint_error(NOMINAL, of, phase, joint).value for of in (method, OURS)
                    )
                    if theirs < ours:
                        yield Ahead(method, phase, joint, theirs, ours)


def _geometric(values: Sequence[float]) -> float:
    """Geometric mean of those that are positive numbers."""
    known = np.array([value for value in values if value > 0])
    return float(np.exp(np.log(known).mean())) if len(known) else math.nan


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """Contents of rivals.json."""
    return {
        "methods": {
            tuned.method.name: _method_json(comparison, tuned) for tuned in comparison.tuned
        },
        "not_compared": comparison.unfit,
        "references": {
            who: _loop_json(comparison, who) for who in (UNCOMPENSATED, ORACLE, FRICTIONLESS)
        },
        "ahead_of_fbse": [vars(ahead) for ahead in comparison.ahead()],
        "ended_early": comparison.failures,
        "not_done": comparison.broken,
    }


def _method_json(comparison: Comparison, tuned: Tuned) -> dict[str, Any]:
    name, estimator = tuned.method.name, tuned.method.estimator
    errors = {}
    for case in comparison.cases:
        by_phase = {phase: vars(comparison.error(case, name, (phase,))) for phase in PHASES}
        by_joint = {
            phase: {
                joint: vars(comparison.joint_error(case, name, phase, joint))
                for joint in comparison.joints
            }
            for phase in PHASES
        }
        errors[case] = {"mean": by_phase, "by_joint": by_joint}
    return {
        "knows": estimator.knows,
        "measures": estimator.measures,
        "settings": tuned.method.text,
        "trials": tuned.trials,
        "score_before": tuned.before,
        "score_after": tuned.after,
        "tick_us": comparison.tick(name),
        "friction_nrmse": errors,
        "in_the_loop": _loop_json(comparison, name),
    }


def _loop_json(comparison: Comparison, who: str) -> dict[str, Any]:
    figures = ("tracking", "com_deviation")
    return {
        **{figure: vars(comparison.loop(who, figure)) for figure in figures},
        **{f"{figure}_recovered": vars(comparison.recovered(who, figure)) for figure in figures},
        "falls": comparison.falls(who),
    }
