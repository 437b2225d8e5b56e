"""What a kind of figure is: its title, its caption, the channels it needs, and how it is drawn."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report.html import FigureBlock
from fbse_drake.report.metrics import has_feet


@dataclass(frozen=True)
class FigureKind:
    """A figure that can be drawn of every log that has the channels; calling it draws it."""

    title: str
    # One or two sentences on what to see.
    caption: str | Callable[[Log], str]
    # Channels; with `{}` in the place of a side, those of all feet.
    needs: tuple[str, ...]
    # What else must hold.
    where: Callable[[Log], bool]
    draw: Callable[[Log], Figure]

    def __call__(self, log: Log) -> Figure:
        return self.draw(log)

    def available(self, log: Log) -> bool:
        """Whether this log has what the figure needs."""
        known = all(has_feet(log, name) if "{}" in name else name in log for name in self.needs)
        return known and self.where(log)

    def block(self, log: Log) -> FigureBlock:
        """The figure of a log, for a report."""
        caption = self.caption if isinstance(self.caption, str) else self.caption(log)
        return FigureBlock(self.title, caption, partial(self.draw, log))


def figure_kind(
    title: str,
    caption: str | Callable[[Log], str],
    *,
    needs: Sequence[str] = (),
    where: Callable[[Log], bool] = lambda _: True,
) -> Callable[[Callable[[Log], Figure]], FigureKind]:
    """Makes a kind of figure of the function that draws it; see `FigureKind`."""
    return lambda draw: FigureKind(title, caption, tuple(needs), where, draw)
