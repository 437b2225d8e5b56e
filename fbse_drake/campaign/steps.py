"""Steps that a run can have. Each hands on what it made to the next: a log, an answer to find.

A step imports what it alone needs when it runs: every worker of a campaign pays for it anew.
"""

import importlib
import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fbse_drake.campaign.columns import Column, run_columns, run_figures
from fbse_drake.discrepancy.exercises.sizes import Size
from fbse_drake.errors import InputError
from fbse_drake.estimation import estimate
from fbse_drake.interop.convert import read_log
from fbse_drake.log import Log
from fbse_drake.report.metrics import run_metrics
from fbse_drake.robot.description import load_description
from fbse_drake.scenario import Scenario, ScenarioTree
from fbse_drake.simulation import simulate

if TYPE_CHECKING:
    from fbse_drake.discrepancy.exercises.hidden import Answer


@dataclass(frozen=True)
class Material:
    """What a run is made of, and what its steps have made so far."""

    seed: int
    # By key, as the design has them.
    values: dict[str, Any]
    # The scenario with the run's seed and values; a campaign may have none.
    tree: ScenarioTree | None = None
    scenario: Scenario | None = None
    log: Log | None = None
    # What `!Hide` has hidden.
    answer: "Answer | None" = None
    # Why the robot did not get to its end.
    failure: str | None = None

    def needed(self, what: str) -> Any:
        """Its scenario or its log.

        Raises:
            InputError: it has none.
        """
        found = getattr(self, what)
        if found is None:
            raise InputError(f"there is no {what}: a step before this one has to make it")
        return found


Figures = dict[str, Any]


@dataclass(frozen=True)
class Step(ABC):
    """Base of the steps: a frozen dataclass with their settings."""

    @staticmethod
    def alternatives() -> tuple[type["Step"], ...]:
        """What can stand for a step in a campaign (see `fbse_drake.schema`)."""
        return Simulate, Estimate, Hide, Study, Call

    def beside(self, folder: Path) -> "Step":  # noqa: ARG002
        """The same, its files looked for in the folder of the campaign's file."""
        return self

    @abstractmethod
    def columns(self, scenario: Scenario | None) -> list[Column]:
        """Columns of the figures that it gives."""

    @abstractmethod
    def run(self, material: Material) -> tuple[Material, Figures]:
        """Runs; returns what there is now, and figures by column.

        Raises:
            InputError: what it needs is not there or not possible.
        """


def _robot_columns(scenario: Scenario | None) -> list[Column]:
    if scenario is None:
        raise InputError("this step needs a scenario (scenarios: [...])")
    return run_columns(load_description(scenario.robot.description)[0])


@dataclass(frozen=True)
class Simulate(Step):
    """Simulates the scenario."""

    def columns(self, scenario: Scenario | None) -> list[Column]:
        return _robot_columns(scenario)

    def run(self, material: Material) -> tuple[Material, Figures]:
        name = material.needed("tree").name
        result = simulate(material.needed("scenario"), name=name)
        made = replace(material, log=result.log, failure=result.failure)
        return made, run_figures(run_metrics(result.log, result.wall_time))


@dataclass(frozen=True)
class Estimate(Step):
    """Runs the scenario's estimator over a log: that of the step before, or a recorded one."""

    # Changes of the scenario for this step alone, as `estimator=!TorqueSensor {}`.
    set: list[str] = field(default_factory=list)
    log: str | None = None

    def beside(self, folder: Path) -> Step:
        return replace(self, log=self.log and str((folder / self.log).resolve()))

    def columns(self, scenario: Scenario | None) -> list[Column]:
        return _robot_columns(scenario)

    def run(self, material: Material) -> tuple[Material, Figures]:
        tree = material.needed("tree")
        for override in self.set:
            tree = tree.overridden(override)
        log = material.needed("log") if self.log is None else read_log(Path(self.log), None)
        estimated = estimate(tree.build(), log).log
        # The next step gets the log as it was recorded.
        return replace(material, log=log), run_figures(run_metrics(estimated, 1.0))


@dataclass(frozen=True)
class Hide(Step):
    """Hides an effect in the scenario's robot, and simulates it; see `fbse hide`."""

    what: str = "any"
    size: Size | None = None
    count: int = 1

    def columns(self, scenario: Scenario | None) -> list[Column]:  # noqa: ARG002
        texts = [Column(name, "text") for name in ("kind", "size", "effects", "targets")]
        return [*texts, Column("shrunk", unit="1")]

    def run(self, material: Material) -> tuple[Material, Figures]:
        from fbse_drake.discrepancy.exercises.hidden import make_exercise

        exercise = make_exercise(
            material.needed("scenario"),
            material.needed("tree").name,
            material.seed,
            what=self.what,
            size=self.size,
            count=self.count,
        )
        answer = exercise.answer
        figures = {
            "kind": answer.kind,
            "size": answer.size,
            "effects": ", ".join(hidden.effect for hidden in answer.effects),
            "targets": "; ".join(", ".join(hidden.targets) for hidden in answer.effects),
            "shrunk": answer.shrunk,
        }
        made = replace(material, scenario=exercise.scenario, log=exercise.log, answer=answer)
        return made, figures


@dataclass(frozen=True)
class Study(Step):
    """Adds what the scenario's model lacks until a log shows nothing more; see `fbse study`."""

    log: str | None = None
    # Is the model simulated after every round as well?
    rollouts: bool = False

    def beside(self, folder: Path) -> Step:
        return replace(self, log=self.log and str((folder / self.log).resolve()))

    def columns(self, scenario: Scenario | None) -> list[Column]:  # noqa: ARG002
        texts = ("verdict", "added", "stopped_because", "wrong")
        truths = ("right_verdict", "all_found", "first")
        return [
            *(Column(name, "text") for name in texts),
            *(Column(name, unit="1") for name in ("held_out_before", "held_out_after")),
            *(Column(name, "truth") for name in truths),
        ]

    def run(self, material: Material) -> tuple[Material, Figures]:
        from fbse_drake.discrepancy.diagnosis.diagnose import diagnosis_json
        from fbse_drake.discrepancy.diagnosis.study import study
        from fbse_drake.discrepancy.exercises.hidden import score

        log = material.needed("log") if self.log is None else read_log(Path(self.log), None)
        result = study(material.needed("scenario"), log, rollouts=self.rollouts)
        figures = {
            "verdict": result.diagnoses[0].verdict,
            "added": ", ".join(finding.effect for finding in result.found),
            "stopped_because": result.stopped_because,
            "held_out_before": result.steps[0].held_out_rmse,
            "held_out_after": result.steps[-1].held_out_rmse,
        }
        if material.answer is not None:
            diagnoses = [diagnosis_json(diagnosis) for diagnosis in result.diagnoses]
            scored = score(material.answer, diagnoses)
            figures |= {
                "right_verdict": scored.verdict,
                "all_found": all(scored.found.values()),
                "first": scored.first,
                "wrong": ", ".join(scored.wrong),
            }
        return replace(material, scenario=result.scenario, log=log), figures


@dataclass(frozen=True)
class Call(Step):
    """Calls a Python function with the `Material` of the run and these arguments; it returns
    figures by name."""

    # `package.module:function`, or `path/of/file.py:function`.
    function: str
    # Unit of each figure; or its kind, if that is `whole`, `truth` or `text`.
    gives: dict[str, str]
    arguments: dict[str, Any] = field(default_factory=dict)

    def beside(self, folder: Path) -> Step:
        module, colon, name = self.function.rpartition(":")
        if not module.endswith(".py"):
            return self
        return replace(self, function=f"{(folder / module).resolve()}{colon}{name}")

    def columns(self, scenario: Scenario | None) -> list[Column]:  # noqa: ARG002
        return [Column.of(name, unit) for name, unit in self.gives.items()]

    def run(self, material: Material) -> tuple[Material, Figures]:
        figures: Mapping[str, Any] = _function(self.function)(material, **self.arguments)
        for name in figures:
            if name not in self.gives:
                given = ", ".join(self.gives)
                raise InputError(f"{self.function} returned {name}, not in gives ({given})")
        return material, dict(figures)


def _function(place: str) -> Callable[..., Mapping[str, Any]]:
    module_name, colon, name = place.rpartition(":")
    if not colon:
        raise InputError(f"function: expected MODULE:FUNCTION or FILE.py:FUNCTION, found {place}")
    if module_name.endswith(".py"):
        spec = importlib.util.spec_from_file_location(Path(module_name).stem, module_name)
        if not Path(module_name).is_file() or spec is None or spec.loader is None:
            raise InputError(f"function: {module_name}: no such file")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    else:
        try:
            module = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            raise InputError(f"function: {place}: {error}") from None
    if not callable(getattr(module, name, None)):
        raise InputError(f"function: {place}: {module_name} has no function {name}")
    return getattr(module, name)


def settings(step: Step) -> dict[str, Any]:
    """What decides on what a step does, as plain values."""
    return {"step": type(step).__name__, **asdict(step)}
