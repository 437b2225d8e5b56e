"""Reports: one HTML file that holds everything it shows, to be mailed, archived and printed.

A report is data (`Report`, made of `Section`s); `write_report` puts it into
`templates/report.html.j2`.
"""

import base64
import io
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jinja2
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from fbse_drake.files import write_text
from fbse_drake.report.chart import Chart, plotly_gzip

_DPI = 130


@dataclass(frozen=True)
class Step:
    """Something to do, with the command that does it, if one does."""

    text: str
    command: str = ""

    def __str__(self) -> str:
        """As in `Try it: fbse simulate squat`."""
        return " ".join(part for part in (self.text, self.command) if part)


@dataclass(frozen=True)
class Measure:
    """A number in a table beside others of its kind."""

    value: float
    # As a difference from another one.
    note: str = ""
    best: bool = False

    def __str__(self) -> str:
        return " ".join(part for part in (number(self.value), self.note) if part)


Cell = str | float | Step | Measure


@dataclass(frozen=True)
class Table:
    """Rows of texts, numbers, measures and steps under a header; numbers are shown by `number`.

    Without a header the first column names the rows.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    # What it shows, one or two sentences.
    caption: str = ""
    # Folded away behind its caption, after the figures.
    folded: bool = False


@dataclass(frozen=True)
class PictureBlock(ABC):
    """Pictures beside each other with their title and one or two sentences on what to see; drawn
    when they are shown, so that a report has one figure in memory and not all."""

    title: str
    caption: str

    @property
    @abstractmethod
    def pictures(self) -> tuple[tuple[str, Callable[[], str]], ...]:
        """The name of each, and what makes it as a data URI."""

    def drawn(self) -> "DrawnBlock":
        """The same with its pictures made."""
        made = tuple((name, picture()) for name, picture in self.pictures)
        return DrawnBlock(self.title, self.caption, made)


@dataclass(frozen=True)
class FigureBlock(PictureBlock):
    """A picture without a name of its own."""

    draw: Callable[[], Figure]

    @property
    def pictures(self) -> tuple[tuple[str, Callable[[], str]], ...]:
        return (("", partial(_png_uri, self.draw)),)


@dataclass(frozen=True)
class FigureRow(PictureBlock):
    """Pictures of the same thing, each with its name."""

    drawings: tuple[tuple[str, Callable[[], Figure]], ...]

    @property
    def pictures(self) -> tuple[tuple[str, Callable[[], str]], ...]:
        return tuple((name, partial(_png_uri, draw)) for name, draw in self.drawings)


@dataclass(frozen=True)
class DrawnBlock(PictureBlock):
    """Pictures that are drawn already, as data URIs with their names."""

    uris: tuple[tuple[str, str], ...]

    @property
    def pictures(self) -> tuple[tuple[str, Callable[[], str]], ...]:
        return tuple((name, partial(str, uri)) for name, uri in self.uris)


@dataclass(frozen=True)
class Details:
    """Preformatted text, folded away behind its title."""

    title: str
    text: str
    folded: bool = True


@dataclass(frozen=True)
class Section:
    """A titled part of a report; shows its text, tables, figures, folded tables and details in this
    order."""

    title: str
    text: str | Step = ""
    tables: tuple[Table, ...] = ()
    figures: tuple[PictureBlock | Chart, ...] = ()
    details: tuple[Details, ...] = ()


@dataclass(frozen=True)
class Report:
    """What a report says."""

    title: str
    # Colours the outcome.
    passed: bool
    # The result in one sentence.
    outcome: str
    sections: tuple[Section, ...]
    # What to do next, the most important first.
    steps: tuple[Step, ...] = ()


def number(value: float, digits: int = 3) -> str:
    """A number for reading, with this many significant digits and no exponent; `n/a` for NaN."""
    if math.isnan(value):
        return "n/a"
    if value == 0 or math.isinf(value):
        return f"{value:g}"
    rounded = float(f"{value:.{digits - 1}e}")
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(rounded))))}f}"


def percent(share: float) -> str:
    """A share for reading; `n/a` for NaN."""
    return "n/a" if math.isnan(share) else f"{100 * share:.1f} %"


def numeric_table(
    header: Sequence[str], rows: Sequence[tuple[str | float, ...]]
) -> tuple[Table, ...]:
    """The table of these rows without those whose numbers are all NaN; none if no row is left."""
    kept = tuple(
        row
        for row in rows
        if not all(math.isnan(cell) for cell in row if not isinstance(cell, str))
    )
    return (Table(tuple(header), kept),) if kept else ()


def drawn(section: Section) -> Section:
    """The same with its pictures and charts made, for another process."""
    return replace(section, figures=tuple(block.drawn() for block in section.figures))


def render_report(report: Report) -> str:
    """The report as HTML text that refers to nothing outside itself."""
    return _environment().get_template("report.html.j2").render(report=report)


def render_fragment(outcome: str, tables: Sequence[Table]) -> str:
    """A result and tables as HTML without styles, to be shown inside another page."""
    return _environment().get_template("fragment.html.j2").render(outcome=outcome, tables=tables)


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("fbse_drake.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.globals["plotly_gzip"] = plotly_gzip
    environment.tests["chart"] = lambda block: isinstance(block, Chart)
    environment.tests["measure"] = lambda cell: isinstance(cell, Measure)
    return environment


def write_report(path: str | Path, report: Report) -> None:
    """Writes the report as one HTML file, to a temporary name first."""
    write_text(Path(path), render_report(report))


def _png_uri(draw: Callable[[], Figure]) -> str:
    # What `savefig` does, without its first drawing of a figure with a layout engine.
    figure, file = draw(), io.BytesIO()
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(_DPI)
    # The page shows through, which may be dark.
    for patch in (figure.patch, *(axes.patch for axes in figure.axes)):
        patch.set_alpha(0.0)
    # Dollars that are there before ticks are labelled stand in names: no figure of ours has
    # formulas.
    for text in figure.findobj(Text):
        if "$" in text.get_text():
            text.set_parse_math(False)
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    canvas.print_png(file)
    # A figure may live on, but the pixels that it was drawn with need not.
    FigureCanvasBase(figure)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")
