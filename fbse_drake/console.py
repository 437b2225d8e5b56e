"""The terminal: texts are shown as they are, and nobody needs to listen."""

import os
import sys
from typing import Any

import rich.console


class Console(rich.console.Console):
    """A console to which names are data: no brackets in them are markup."""

    def __init__(self, **options: Any):
        super().__init__(markup=False, highlight=False, **options)

    def on_broken_pipe(self) -> None:
        """Whoever read along has left, as in `fbse ... | head`: the work goes on in silence."""
        self.quiet = True
        silence_stdout()


def silence_stdout() -> None:
    """Lets what is still written to the standard output go nowhere."""
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), sys.stdout.fileno())
