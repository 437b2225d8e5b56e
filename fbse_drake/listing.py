"""What there is: scenarios, robots, and the libraries of what a scenario can be made of."""

import inspect
from collections.abc import Callable

from fbse_drake import resources
from fbse_drake.libraries import (
    compensations_by_name,
    effects_by_name,
    estimators_by_name,
    sensors_by_name,
)
from fbse_drake.schema import load_tree


def listing(kind: str) -> dict[str, str]:
    """A line for each, by name.

    Args:
        kind: one of `fbse_drake.cli.LISTED`.
    """
    return _LISTINGS[kind]()


def _scenarios() -> dict[str, str]:
    """By what the command line calls them."""
    lines = {}
    for name in resources.shipped("scenarios"):
        tree = load_tree(resources.find(name, kind="scenarios"))
        usual = next(iter(tree)) if len(tree) == 1 else name.rpartition("/")[2]
        for child, content in tree.items():
            command = name if child == usual else f"{name} --name {child}"
            lines[command] = (content or {}).get("title", "")
    return lines


def _robots() -> dict[str, str]:
    """The comment that each description begins with."""
    lines = {}
    for name in resources.shipped("models"):
        first, *_ = resources.find(name, kind="models").read_text().splitlines()
        lines[name] = first.lstrip("# ") if first.startswith("#") else ""
    return lines


def _described(kinds: dict[str, type]) -> dict[str, str]:
    """The first sentence of each class, or what it says of itself."""
    return {
        name: getattr(kind, "description", "") or (inspect.getdoc(kind) or "").split("\n\n")[0]
        for name, kind in kinds.items()
    }


_LISTINGS: dict[str, Callable[[], dict[str, str]]] = {
    "scenarios": _scenarios,
    "robots": _robots,
    "effects": lambda: _described(effects_by_name()),
    "estimators": lambda: _described(estimators_by_name()),
    "sensors": lambda: _described(sensors_by_name()),
    "compensations": lambda: _described(compensations_by_name()),
}
