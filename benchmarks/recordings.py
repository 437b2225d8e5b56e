"""How well missing physics is found in recordings as strangers make them: `python -m
benchmarks.recordings [--quick] [--recordings N] [--first NUMBER] [--only NAME] [--jobs N] [--keep]
[--out DIR]`.

Serial machines of two to seven joints are drawn, what they have beside their models, how they move,
and what records them: rates from 100 Hz to 1 kHz, encoders of 12 to 20 bits, velocities that are
measured, filtered, differenced or missing, torques with noise, in steps or late, and a scenario
that tells nothing, something or everything of that. Nobody has tuned anything to them: begin with a
number that nobody has used. Prints how many diagnoses were right, and a line for each other one.
"""

import argparse
from collections.abc import Sequence

from rich.console import Console

from benchmarks.cases import add_options, drawn, share
from benchmarks.console import print_table
from benchmarks.recorded.cases import Case, sources
from benchmarks.recorded.recorder import TOLD
from benchmarks.store import Store
from fbse_drake.files import write_json
from fbse_drake.report.html import Table

_RECORDINGS, _QUICK = 60, 12
_OUTCOMES = {
    "right": "everything that shows is named, or what it cannot be told from, and nothing else",
    "missed": "something that shows is not named, and nothing is wrong",
    "unsure": "it is said that something unknown is left",
    "wrong": "something is named with confidence that is not there",
    "error": "the diagnosis ended in an error",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs what has not been run, and prints the figures of all that has."""
    parser = argparse.ArgumentParser(description="How well missing physics is found in recordings.")
    add_options(parser, "out/recordings", f"{_QUICK} recordings", "recording-7")
    count = f"so many are drawn (default {_RECORDINGS})"
    parser.add_argument("--recordings", type=int, default=_RECORDINGS, metavar="N", help=count)
    first = "number of the first one (default 0)"
    parser.add_argument("--first", type=int, default=0, metavar="NUMBER", help=first)
    options = parser.parse_args(arguments)
    console = Console(width=190)
    count = _QUICK if options.quick else options.recordings
    cases = [Case.of(options.first + k) for k in range(count)]
    store = Store(
        options.out / "cases",
        "benchmarks.recorded.cases:judge",
        drawn(cases, options),
        None if options.keep else sources(),
    )
    store.run(console, "recording and diagnosing", only=options.only, workers=options.jobs)

    trees = [result.tree for result in store.read()]
    outcomes = {
        tree["case"]["number"]: "error" if "error" in tree else tree["outcome"] for tree in trees
    }
    rows = [
        (outcome, meaning, *share(o == outcome for o in outcomes.values()))
        for outcome, meaning in _OUTCOMES.items()
    ]
    for told in TOLD:
        mine = [
            outcomes[tree["case"]["number"]] == "right"
            for tree in trees
            if tree.get("recorder", "").endswith(f"{told} told")
        ]
        rows.append((f"right, {told} told", "", *share(mine)))
    table = Table(("outcome", "", "share", "of"), tuple(rows))
    print_table(console, "Recordings of machines that were drawn", table)
    lines = [text(tree) for tree in trees if outcomes[tree["case"]["number"]] != "right"]
    console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)
    tree = {
        "cases": len(trees),
        "outcomes": outcomes,
        "figures": [dict(zip(table.header, row, strict=True)) for row in table.rows],
    }
    write_json(options.out / "figures.json", tree)
    console.print(f"{len(trees)} recordings: {options.out / 'figures.json'}", highlight=False)


def text(tree: dict) -> str:
    """One line about a recording that was not diagnosed as it should be."""
    if "error" in tree:
        return f"recording-{tree['case']['number']}:\n{tree['error']}"
    (diagnosis,) = tree["diagnoses"]
    hidden = ", ".join(f"{h['names'][0]} ({' '.join(h['targets'])})" for h in tree["hidden"])
    chosen = ", ".join(
        f"{f['effect']} ({' '.join(f['joints'])})" for f in diagnosis["ranking"] if f["chosen"]
    )
    left = " ".join(row["row"] for row in diagnosis["unexplained"])
    return (
        f"recording-{tree['case']['number']}, {tree['outcome']} ({tree['recorder']}): "
        f"{hidden or 'nothing'} -> {diagnosis['verdict']}: {chosen or 'nothing'}; unexplained: "
        f"{left or 'nothing'}"
    )


if __name__ == "__main__":
    main()
