"""Charts over time to look into, in the browser: zoom, values under the pointer, one time axis.

The reader chooses between views (joints, say). All views have the same panels one below the other,
which share the time axis, and keep the part of it that is looked at.
"""

import base64
import gzip
import json
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from fbse_drake.report.style import INK

# For captions.
HOW_TO_ZOOM = (
    "Drag over a stretch of time to look closer in all panels, double-click to see the whole again."
)
# Of all lines of a chart together so many numbers are kept: about 4 MB of a report.
_MOST_NUMBERS = 750_000
# Samples of an even clock are this close to a constant period.
_EVEN = 1e-3
# Level of gzip; with the highest a file is 4 % smaller, in more than twice the time.
_PACKING = 4
# Heights [px].
_PANEL, _AROUND = 160, 110
_BAND_OPACITY = 0.25
_GRID = "#c9ced4"
_FONT = {"family": "system-ui, sans-serif", "size": 12, "color": INK}


@dataclass(frozen=True, eq=False)
class Line:
    """A line in a panel, (N,); NaN where it has gaps."""

    label: str
    values: np.ndarray
    color: str
    dashed: bool = False
    # Half the width of a band around it, (N,).
    band: np.ndarray | None = None


@dataclass(frozen=True)
class Panel:
    """Lines over time with one scale."""

    # What is shown, and its unit.
    quantity: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class View:
    """What is shown of one of the things that the reader chooses from."""

    name: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True, eq=False)
class Chart:
    """Views over the same time [s], (N,), with a title and one or two sentences on what to see."""

    title: str
    caption: str
    # What the reader chooses, as in "Joint".
    choice: str
    time: np.ndarray
    views: tuple[View, ...]

    @cached_property
    def json(self) -> str:
        """For each view its name and what Plotly draws of it, as JSON that may stand in HTML."""
        lines = sum(len(panel.lines) for view in self.views for panel in view.panels)
        stride = max(1, -(-lines * len(self.time) // _MOST_NUMBERS))
        clock = _clock(self.time[::stride])
        content = [
            {"name": view.name, "data": _traces(view, clock, stride), "layout": _layout(view)}
            for view in self.views
        ]
        return json.dumps(content).replace("<", "\\u003c")

    def drawn(self) -> "Chart":
        """The same with its JSON made."""
        self.json  # noqa: B018 - it is kept.
        return self


@cache
def plotly_gzip() -> str:
    """The library that draws charts: JavaScript, packed by gzip, in base64."""
    # Takes a while to import, and only reports need it.
    from plotly.offline import get_plotlyjs

    packed = gzip.compress(get_plotlyjs().encode(), _PACKING, mtime=0)
    return base64.b64encode(packed).decode("ascii")


def _clock(time: np.ndarray) -> dict[str, object]:
    """Instants, in few numbers where the clock is even."""
    period = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    even = time[0] + period * np.arange(len(time))
    if np.abs(time - even).max(initial=0.0) < _EVEN * period:
        return {"x0": float(time[0]), "dx": period}
    return {"x": _packed(time)}


def _packed(values: np.ndarray) -> dict[str, str]:
    """Numbers as Plotly reads arrays of a type, NaN among them."""
    content = base64.b64encode(values.astype("<f4").tobytes())
    return {"dtype": "f4", "bdata": content.decode("ascii")}


def _traces(view: View, clock: dict[str, object], stride: int) -> list[dict[str, object]]:
    """Plotly's traces, a band before its line."""
    traces = []
    named: set[str] = set()
    for k, panel in enumerate(view.panels):
        for line in panel.lines:
            axis = {**clock, "type": "scatter", "mode": "lines", "yaxis": _axis(k)}
            axis["legendgroup"] = line.label
            values = line.values[::stride]
            if line.band is not None:
                half = line.band[::stride]
                edge = {**axis, "line": {"width": 0}, "hoverinfo": "skip", "showlegend": False}
                fill = {"fill": "tonexty", "fillcolor": _pale(line.color)}
                traces.append({**edge, "y": _packed(values - half)})
                traces.append({**edge, "y": _packed(values + half), **fill})
            traces.append(
                {
                    **axis,
                    "y": _packed(values),
                    "name": line.label,
                    "showlegend": line.label not in named,
                    "line": {
                        "color": line.color,
                        "width": 1.2,
                        "dash": "dash" if line.dashed else "solid",
                    },
                }
            )
            named.add(line.label)
    return traces


def _layout(view: View) -> dict[str, object]:
    """Panels one below the other over one time axis, which is kept when the view changes."""
    count = len(view.panels)
    height = 1.0 / (count + 0.25 * (count - 1))
    layout: dict[str, object] = {
        "height": count * _PANEL + _AROUND,
        "margin": {"l": 60, "r": 30, "t": 60, "b": 45},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": _FONT,
        "hovermode": "x unified",
        "hoversubplots": "axis",
        "hoverlabel": {"namelength": -1},
        "modebar": {"orientation": "v"},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "xaxis": {
            "title": {"text": "time [s]"},
            "hoverformat": ".3f",
            "anchor": _axis(count - 1),
            "gridcolor": _GRID,
            "zeroline": False,
            "uirevision": "time",
        },
    }
    for k, panel in enumerate(view.panels):
        top = 1.0 - 1.25 * k * height
        layout[_axis(k).replace("y", "yaxis")] = {
            "domain": [max(0.0, top - height), top],
            "title": {"text": panel.quantity.replace(" [", "<br>["), "font": {"size": 11}},
            "hoverformat": ".4g",
            "exponentformat": "power",
            "gridcolor": _GRID,
            "zerolinecolor": _GRID,
            "uirevision": view.name,
        }
    return layout


def _axis(panel: int) -> str:
    return f"y{panel + 1}" if panel else "y"


def _pale(color: str) -> str:
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{_BAND_OPACITY})"
