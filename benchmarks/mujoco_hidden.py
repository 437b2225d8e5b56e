"""How well missing physics is found in another simulator: `python -m benchmarks.mujoco_hidden
[--quick] [--sample N] [--only NAME] [--random N [--first NUMBER]] [--jobs N] [--keep] [--out DIR]`.

A biped and an arm, the same bodies as in their models, run in MuJoCo (extra `mujoco`) with physics
that MuJoCo or the loop around it makes, with nothing hidden, and with what the library of effects
does not have. Each log is diagnosed. Every case becomes a row of a campaign in DIR; those that are
there already, made by the same sources, are not run again. Prints the figures beside what was asked
for and a line for each case that went wrong, and saves both as DIR/figures.json.

With `--random` the cases are drawn, of a quadruped too: nobody has tuned anything to them. What is
hidden there may be too small to be found; then only what is named wrongly counts.
"""

import argparse
from collections.abc import Sequence
from importlib.util import find_spec

from rich.console import Console

from benchmarks.cases import Result, add_options, drawn, share
from benchmarks.console import print_table
from fbse_drake.files import write_json
from fbse_drake.report.html import Table

# Robots together.
_ALL = "all"


def is_alarm(decoy: Result) -> bool:
    """Is anything said to be missing but what rightly stands for the decoy's difference?"""
    named = {finding["effect"] for finding in decoy.chosen}
    rightly = bool(named) and named <= set(decoy.tree["case"]["allowed"])
    return not (decoy.score["verdict"] or rightly)


def is_answered(effect: Result) -> bool:
    """Is the hidden effect ranked first, or declared confusable with the first?"""
    return effect.score["first"] or effect.is_alternative()


def is_misled(result: Result) -> bool:
    """Is an effect named with confidence that is not there?"""
    return result.is_wrong(result.tree["case"]["allowed"])


def is_telling(result: Result) -> bool:
    """Does a case that was drawn say anything? Not if the robot fell by what is hidden, so that
    there is no log, nor if nothing wrong is said of what its log can hardly show: what is smaller
    than stated, or rightly called too small to matter."""
    if "error" in result.tree:
        return "FellError" not in result.tree["error"]
    if result.group != "effect" or is_answered(result) or is_misled(result):
        return True
    true = {hidden["effect"] for hidden in result.hidden}
    too_small = any(f["too_small"] and f["effect"] in true for f in result.diagnosis["ranking"])
    effects = result.diagnosis["effects"].items()
    stated = {name: of["smallest_detectable_by_target"] for name, of in effects}
    return not too_small and result.is_visible(stated)


def figures(everything: Sequence[Result]) -> Table:
    """What was asked for and what came out."""
    results = [result for result in everything if "error" not in result.tree]
    rows = []
    for robot in (*dict.fromkeys(r.tree["case"]["robot"] for r in everything), _ALL):
        mine = [r for r in results if robot in (r.tree["case"]["robot"], _ALL)]
        effects, decoys, strangers = (
            [r for r in mine if r.group == group] for group in ("effect", "decoy", "stranger")
        )
        asked = (">= 95 %", "0", "<= 1") if robot == _ALL else ("", "", "")
        exact = [value for r in effects for value in r.score["targets"].values()]
        counts = (
            (
                "hidden effect ranked first or declared confusable with the first",
                asked[0],
                *share(map(is_answered, effects)),
            ),
            ("  ranked first", "", *share(r.score["first"] for r in effects)),
            ("  on exactly the right targets", "", *share(exact)),
            (
                "a wrong name with confidence",
                asked[1],
                f"{sum(map(is_misled, mine))}",
                f"{len(mine)}",
            ),
            ("nothing hidden: alarms", asked[2], f"{sum(map(is_alarm, decoys))}", f"{len(decoys)}"),
            (
                "not in the library: unknown_effect",
                "",
                *share(r.score["verdict"] for r in strangers),
            ),
        )
        rows += [(robot, *count) for count in counts]
    failed, total = len(everything) - len(results), len(everything)
    rows.append((_ALL, "diagnoses that ended in an error", "0", f"{failed}", f"{total}"))
    return Table(("robot", "figure", "asked", "measured", "of"), tuple(rows))


def failures(results: Sequence[Result]) -> list[str]:
    """A line for each case that did not go as it should."""

    def went_wrong(result: Result) -> bool:
        if is_misled(result):
            return True
        if result.group == "decoy":
            return is_alarm(result)
        return not (is_answered(result) if result.group == "effect" else result.score["verdict"])

    errors = [r for r in results if "error" in r.tree]
    lines = [r.text() for r in results if r not in errors and went_wrong(r)]
    return lines + [f"{r.name}:\n{r.tree['error']}" for r in errors]


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs what has not been run, and prints the figures of all that has."""
    parser = argparse.ArgumentParser(
        description="How well missing physics is found in another simulator."
    )
    add_options(parser, "out/mujoco", "every fourth case", "arm or decoy-biped")
    number = "draw so many cases instead, see --first"
    parser.add_argument("--random", type=int, default=None, metavar="N", help=number)
    first = "number of the first case that is drawn (default 0)"
    parser.add_argument("--first", type=int, default=0, metavar="NUMBER", help=first)
    options = parser.parse_args(arguments)
    if find_spec("mujoco") is None:
        print("MuJoCo is not installed (pip install 'fbse_drake[mujoco]'): no case runs in it.")
        return
    from benchmarks.in_mujoco.cases import all_cases, sources
    from benchmarks.in_mujoco.random_cases import random_case
    from benchmarks.store import Store

    console = Console(width=190)
    kind = "cases" if options.random is None else "random_cases"
    if options.random is None:
        cases = [case for group in all_cases() for case in group[:: 4 if options.quick else 1]]
    else:
        cases = [random_case(options.first + k) for k in range(options.random)]
    store = Store(
        options.out / kind,
        f"benchmarks.in_mujoco.{kind}:judge",
        drawn(cases, options),
        None if options.keep else sources(),
    )
    store.run(console, "hiding in MuJoCo and finding", only=options.only, workers=options.jobs)

    everything = store.read()
    if options.random is not None:
        everything = [result for result in everything if is_telling(result)]
    table, lines = figures(everything), failures(everything)
    print_table(console, "Hidden physics in MuJoCo", table)
    console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)
    tree = {
        "cases": len(everything),
        "figures": [dict(zip(table.header, row, strict=True)) for row in table.rows],
        "failures": lines,
    }
    write_json(options.out / "figures.json", tree)
    console.print(f"{len(everything)} cases: {options.out / 'figures.json'}", highlight=False)


if __name__ == "__main__":
    main()
