"""What a campaign's rows say: groups, medians, intervals, a picture of one value over another."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from scipy.stats import binomtest, quantile_test

from fbse_drake.campaign.rows import design_of, units_of
from fbse_drake.errors import InputError

# A column of the design with more different values than this makes no groups by itself.
_MOST_GROUPS = 12
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Summary:
    """A value in a group of runs: the median of numbers, the share of what is true.

    The interval holds the true median or share with a probability of 95 %, whatever the
    distribution: order statistics, and Wilson's interval. It is not a number for a group that is
    too small to tell.
    """

    count: int
    middle: float
    low: float = np.nan
    high: float = np.nan

    @staticmethod
    def of(values: pa.Array) -> "Summary":
        """The summary of what is known of these values."""
        is_share = pa.types.is_boolean(values.type)
        known = np.array([float(value) for value in values.to_pylist() if value is not None])
        known = known[np.isfinite(known)]
        if len(known) == 0:
            return Summary(0, np.nan)
        if is_share:
            share = binomtest(int(known.sum()), len(known))
            interval = share.proportion_ci(_CONFIDENCE, method="wilson")
            return Summary(len(known), float(known.mean()), interval.low, interval.high)
        interval = quantile_test(known).confidence_interval(_CONFIDENCE)
        return Summary(len(known), float(np.median(known)), interval.low, interval.high)


@dataclass(frozen=True)
class Group:
    """Runs that have the same values in some columns."""

    # By column.
    same: dict[str, Any]
    rows: pa.Table

    @property
    def failed(self) -> int:
        """How many of its runs failed."""
        return len(self.rows) - self.rows["failure"].null_count

    @property
    def name(self) -> str:
        """In words."""
        return ", ".join(f"{key} {_text(value)}" for key, value in self.same.items())


def usual_groups(rows: pa.Table) -> list[str]:
    """Columns of the design with a few different values, that some runs have in common."""
    counts = {name: len(rows[name].unique()) for name in design_of(rows.schema)}
    most = min(_MOST_GROUPS, len(rows) // 2)
    return [name for name, count in counts.items() if 1 < count <= most]


def groups(rows: pa.Table, by: Sequence[str]) -> list[Group]:
    """Runs by their values in these columns, in order.

    Raises:
        InputError: no such column.
    """
    require_columns(rows, by)
    indices: dict[tuple, list[int]] = {}
    for k, key in enumerate(zip(*(rows[name].to_pylist() for name in by), strict=True)):
        indices.setdefault(key, []).append(k)
    if not by:
        indices = {(): list(range(len(rows)))}
    ordered = sorted(indices.items(), key=lambda item: [(v is None, v) for v in item[0]])
    return [
        Group(dict(zip(by, key, strict=True)), rows.take(of_group)) for key, of_group in ordered
    ]


def figures(rows: pa.Table, names: Sequence[str]) -> list[str]:
    """Columns with numbers and truth values of these names, or that begin so; without names those
    that every step gives in all.

    Raises:
        InputError: there is none of a name.
    """
    given = {"run", "seed", "failure", "log", *design_of(rows.schema)}
    found = [
        field.name
        for field in rows.schema
        if field.name not in given and not pa.types.is_string(field.type)
    ]
    if not names:
        return [name for name in found if name.count(".") == 1]
    chosen = []
    for name in names:
        of_name = [column for column in found if f"{column}.".startswith(f"{name}.")]
        if not of_name:
            raise InputError(f"{name}: no such value (there are: {', '.join(found)})")
        chosen += of_name
    return list(dict.fromkeys(chosen))


def require_columns(rows: pa.Table, names: Sequence[str]) -> None:
    """Raises InputError for a column that the rows do not have."""
    for name in names:
        if name not in rows.column_names:
            there = ", ".join(rows.column_names)
            raise InputError(f"{name}: no such column (there are: {there})")


def summary_rows(found: Sequence[Group], values: Sequence[str]) -> Iterator[list[object]]:
    """For each group its values of the columns that make it, the number of its runs and of those
    that failed, then median, lower and upper bound of each value."""
    for group in found:
        summaries = [Summary.of(group.rows[value].combine_chunks()) for value in values]
        numbers = [number for s in summaries for number in (s.middle, s.low, s.high)]
        yield [*group.same.values(), len(group.rows), group.failed, *numbers]


def picture(rows: pa.Table, y: str, x: str, by: Sequence[str]) -> Figure:
    """A value over another: a point for each run, its colour by group; where several runs share
    their x, the median with its interval.

    Raises:
        InputError: no such column, or one that holds texts.
    """
    require_columns(rows, (y, x))
    for name in (y, x):
        if pa.types.is_string(rows[name].type):
            raise InputError(f"{name}: expected a column of numbers, found one of texts")
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes, units = figure.add_subplot(), units_of(rows.schema)
    others = [name for name in by if name not in (x, y)]
    for k, group in enumerate(groups(rows, others)):
        colour = f"C{k % 10}"
        known = [
            (float(a), float(b))
            for a, b in zip(group.rows[x].to_pylist(), group.rows[y].to_pylist(), strict=True)
            if a is not None and b is not None
        ]
        if known:
            across, up = zip(*known, strict=True)
            axes.scatter(across, up, s=14, alpha=0.5, color=colour, label=group.name)
        shared = [of for of in groups(group.rows, [x]) if of.same[x] is not None]
        middles = [Summary.of(of.rows[y].combine_chunks()) for of in shared]
        if 1 < len(shared) <= _MOST_GROUPS and any(s.count > 1 for s in middles):
            places = [float(of.same[x]) for of in shared]
            bounds = [
                [s.middle - s.low for s in middles],
                [s.high - s.middle for s in middles],
            ]
            axes.errorbar(
                places, [s.middle for s in middles], bounds, color=colour, marker="o", capsize=4
            )
    for name, label in ((x, axes.set_xlabel), (y, axes.set_ylabel)):
        label(f"{name} [{units[name]}]" if units[name] not in ("", "1") else name)
    if others and axes.has_data():
        axes.legend(frameon=False, fontsize=8)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
