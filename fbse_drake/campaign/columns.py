"""Columns of a campaign's rows: what they are called, of which kind and in which unit."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from fbse_drake.robot.description import RobotDescription

Kind = Literal["number", "whole", "truth", "text"]

# Kinds that stand where a unit does.
_KINDS: dict[str, Kind] = {"whole": "whole", "truth": "truth", "text": "text"}


@dataclass(frozen=True)
class Column:
    """A column."""

    name: str
    kind: Kind = "number"
    # Of a number; 1 for a ratio.
    unit: str = ""
    # Does the design give it, rather than the run?
    of_design: bool = False

    @staticmethod
    def of(name: str, unit: str) -> "Column":
        """A column of numbers in a unit; or of the kind `whole`, `truth` or `text`."""
        kind = _KINDS.get(unit, "number")
        return Column(name, kind, unit if kind == "number" else "")


def design_column(name: str, values: Iterable[Any], unit: str) -> Column:
    """The column that holds these values of a design: what is no number, text or truth value
    becomes text, see `fbse_drake.campaign.rows.as_cell`."""
    kinds = {type(value) for value in values}
    if kinds <= {bool}:
        return Column(name, "truth", of_design=True)
    if kinds <= {int, float}:
        return Column(name, "whole" if kinds == {int} else "number", unit, of_design=True)
    return Column(name, "text", of_design=True)


def run_columns(names: RobotDescription) -> list[Column]:
    """Columns of a run's figures of merit, see `run_figures`."""
    joints, sides, axes = names.joint_names, names.sides, ("x", "y", "z")
    by_phase = [f"{phase}.{joint}" for phase in ("stance", "swing") for joint in joints]
    groups = (
        ("joint_tracking_rms", joints, "rad"),
        ("com_rse_mean", axes[:2], "m"),
        ("stance_creep_max", sides, "m"),
        ("friction_law_error", joints, "1"),
        ("friction_rmse", by_phase, "N m"),
        ("friction_nrmse", by_phase, "1"),
        ("attitude_rmse_deg", ("roll", "pitch"), "deg"),
        ("base_velocity_rmse", axes, "m/s"),
    )
    return [
        Column("fell", "truth"),
        Column("outcome", "text"),
        Column("simulated_time", unit="s"),
        *(Column(f"{group}.{name}", unit=unit) for group, of, unit in groups for name in of),
    ]


# Figures of a run that tell of the machine that it ran on.
_OF_THE_MACHINE = ("wall_time", "real_time_factor", "tick_us")


def run_figures(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Contents of metrics.json as cells, but for what another machine would have otherwise."""
    kept = {name: value for name, value in metrics.items() if name not in _OF_THE_MACHINE}
    return dict(_flat(kept))


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
