"""What can be said in a campaign's file, and the runs that follow from it."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from fbse_drake import schema
from fbse_drake.campaign.columns import Column, design_column
from fbse_drake.campaign.design import Design, Grid
from fbse_drake.campaign.steps import Call, Step, settings
from fbse_drake.errors import InputError, located
from fbse_drake.scenario import ScenarioTree

# Columns that every row has, before those of the design and after those of the steps.
_FIRST = (
    Column("run", "text"),
    Column("scenario", "text", of_design=True),
    Column("seed", "whole"),
)
_LAST = (Column("failure", "text"), Column("log", "text"))


@dataclass(frozen=True)
class Run:
    """One run of a campaign; it becomes one row."""

    # Of everything that decides on the row.
    key: str
    scenario: str
    seed: int
    # By key of the scenario.
    values: dict[str, Any]
    tree: ScenarioTree | None


@dataclass(frozen=True)
class Campaign:
    """Steps that are run for every point of a design, in every scenario.

    Values of a design, and `set`, go on top of the scenario, as `--set` does. Without scenarios
    they are only handed to the steps.
    """

    # The steps, each under a name of your choice, one after the other.
    steps: dict[str, Step]
    # One sentence.
    title: str = ""
    # Names or paths; `FILE:NAME` for one of several in a file.
    scenarios: list[str] = field(default_factory=list)
    # Changes of all scenarios, as `duration=3`.
    set: list[str] = field(default_factory=list)
    design: Design = field(default_factory=Grid)
    # Is the log of each run kept?
    logs: bool = False

    def __post_init__(self) -> None:
        if not self.steps:
            raise InputError("steps: expected at least one, found none")
        names = {column.name for column in (*_FIRST, *_LAST)}
        for key in (*self.steps, *self.keys):
            if key in names:
                raise InputError(f"{key}: there is a column of this name in every table")
        for key in self.keys:
            if key.split(".")[0] in self.steps:
                raise InputError(f"steps.{key.split('.')[0]}: a value of the design begins so too")

    @cached_property
    def keys(self) -> list[str]:
        """Keys of the scenario that the design gives values to."""
        first = next(self.design.points(), None)
        return [] if first is None else list(first.values)

    @cached_property
    def trees(self) -> dict[str, ScenarioTree]:
        """What the scenarios' files say, with `set`, by scenario."""
        trees = {}
        for name in self.scenarios:
            path, colon, child = name.rpartition(":")
            tree = ScenarioTree.read(path, child) if colon else ScenarioTree.read(name)
            for override in self.set:
                tree = tree.overridden(override)
            trees[name] = tree
        return trees

    @property
    def code(self) -> list[Any]:
        """The Python code that it runs: functions of its steps, modules of its scenarios."""
        functions = [step.function for step in self.steps.values() if isinstance(step, Call)]
        return [*functions, *(tree.code for tree in self.trees.values() if tree.code)]

    @cached_property
    def runs(self) -> list[Run]:
        """All runs, each once."""
        steps = [[name, settings(step)] for name, step in self.steps.items()]
        runs: dict[str, Run] = {}
        for point in self.design.points():
            trees: Mapping[str, ScenarioTree | None] = self.trees or {"": None}
            for scenario, tree in trees.items():
                decides = [steps, tree and tree.tree, point.seed, point.values]
                text = json.dumps(decides, sort_keys=True, default=str)
                key = hashlib.sha256(text.encode()).hexdigest()[:16]
                runs[key] = Run(key, scenario, point.seed, point.values, tree)
        return list(runs.values())

    @cached_property
    def columns(self) -> list[Column]:
        """All columns of the rows.

        Raises:
            InputError: a scenario that cannot be built with the first values of the design.
        """
        drawn = list(self.design.points())
        # Scenarios are in SI units.
        unit = "SI" if self.scenarios else ""
        values = [
            design_column(key, [point.values[key] for point in drawn], unit) for key in self.keys
        ]
        figures: dict[str, Column] = {}
        for scenario in self.trees or [None]:
            first = next((run for run in self.runs if run.scenario == scenario), None)
            built = None if first is None else tree_of(first).build()
            for name, step in self.steps.items():
                with located(f"steps.{name}: "):
                    for column in step.columns(built):
                        whole = Column(f"{name}.{column.name}", column.kind, column.unit)
                        figures[whole.name] = whole
        return [*_FIRST, *values, *figures.values(), *_LAST]


def tree_of(run: Run) -> ScenarioTree:
    """The run's scenario with its seed and values on top.

    Raises:
        InputError: the run has no scenario.
    """
    if run.tree is None:
        raise InputError("the campaign has no scenarios")
    tree = run.tree.changed("seed", run.seed)
    for key, value in run.values.items():
        tree = tree.changed(key, value)
    return tree


def load_campaign(path: str | Path) -> Campaign:
    """Reads a campaign's file; files that it names are looked for beside it.

    Raises:
        InputError: no such file, unknown key, wrong type, impossible value.
    """
    path = Path(path)
    tree = schema.load_tree(path)
    campaign = schema.build(Campaign, tree, file=str(path))
    beside = [path.parent / name.partition(":")[0] for name in campaign.scenarios]
    scenarios = [
        str(path.parent.resolve() / name) if file.is_file() else name
        for name, file in zip(campaign.scenarios, beside, strict=True)
    ]
    steps = {name: step.beside(path.parent) for name, step in campaign.steps.items()}
    return replace(campaign, steps=steps, scenarios=scenarios)


def dump_campaign(campaign: Campaign) -> str:
    """YAML text that `load_campaign` reads back, with all defaults."""
    return schema.dump(campaign)
