"""Charts over time that are drawn in the browser."""

import base64
import json

import numpy as np
import pytest
from plotly.graph_objects import Figure
from test_report import joints_only_log

from fbse_drake import Log
from fbse_drake.report.chart import Chart, Line, Panel, View
from fbse_drake.report.figures.joint_chart import joint_chart


def numbers(encoded: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(encoded["bdata"]), np.dtype(encoded["dtype"]))


def chart(time: np.ndarray, *views: View) -> list[dict]:
    return json.loads(Chart("title", "caption", "choice", time, views).json)


def test_a_chart_holds_its_lines():
    time = 5.0 + 0.002 * np.arange(400)
    wave, trend = np.sin(time), time**2
    lines = (Line("wave", wave, "#102030", band=0.1 + 0 * wave), Line("gone", wave, "#102030"))
    panels = (Panel("torque [Nm]", lines), Panel("angle [rad]", (Line("trend", trend, "#000000"),)))
    (view,) = chart(time, View("knee", panels))
    lower, upper, own, _, other = view["data"]
    assert [own["name"], other["name"], view["name"]] == ["wave", "trend", "knee"]
    np.testing.assert_allclose(numbers(own["y"]), wave, atol=1e-6)
    np.testing.assert_allclose(numbers(upper["y"]) - numbers(lower["y"]), 0.2, atol=1e-6)
    assert upper["fillcolor"].startswith("rgba(16,32,48,")
    assert all(trace["x0"] == 5.0 and trace["dx"] == pytest.approx(0.002) for trace in view["data"])
    # One below the other, on one time axis.
    assert [own["yaxis"], other["yaxis"]] == ["y", "y2"]
    assert view["layout"]["yaxis"]["domain"][0] > view["layout"]["yaxis2"]["domain"][1]
    # Plotly knows every option: another would raise.
    assert len(Figure(view["data"], view["layout"]).data) == len(view["data"])


def test_an_uneven_clock_is_kept():
    time = np.cumsum([0.0, 0.01, 0.01, 0.5, 0.01])
    (view,) = chart(time, View("v", (Panel("p", (Line("l", time, "#000000"),)),)))
    np.testing.assert_allclose(numbers(view["data"][0]["x"]), time, atol=1e-6)


def test_a_long_log_is_thinned_evenly():
    time = 0.001 * np.arange(1_000_000)
    (view,) = chart(time, View("v", (Panel("p", (Line("l", time, "#000000"),)),)))
    values = numbers(view["data"][0]["y"])
    assert 400_000 < len(values) <= 750_000
    np.testing.assert_allclose(np.diff(values), view["data"][0]["dx"], atol=1e-4)


def test_gaps_and_names_are_data():
    time = np.arange(3.0)
    line = Line("</script>", np.array([1.0, np.nan, 2.0]), "#000000")
    text = Chart("t", "c", "x", time, (View("<b>", (Panel("p", (line,)),)),)).json
    assert "<" not in text
    (view,) = json.loads(text)
    assert (view["name"], view["data"][0]["name"]) == ("<b>", "</script>")
    np.testing.assert_array_equal(numbers(view["data"][0]["y"]), line.values)


def test_a_joint_shows_what_its_log_has():
    log = joints_only_log()
    known = {panel.quantity for view in joint_chart(log).views for panel in view.panels}
    assert "load [N]" not in known
    without = Log({name: log[name] for name in ("time", "joint/position")}, log.meta)
    assert [len(view.panels) for view in joint_chart(without).views] == [1] * len(log.joints)
