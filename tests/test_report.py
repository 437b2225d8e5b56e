"""The report of a run: what it shows, that it holds everything it shows, and that it copes with logs that lack channels."""

import base64
import dataclasses
import math
from html.parser import HTMLParser

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report import figures
from fbse_drake.report.html import Details, FigureBlock, Report, Section, number, numeric_table, render_report, write_report
from fbse_drake.report.metrics import simulation_metrics
from fbse_drake.report.simulation import write_simulation_report

SAMPLES = 400
TOPICS = ("walk", "joints", "forces", "friction", "sensors")
PADS = np.array([[0.1, 0.05, 0.0], [0.1, -0.05, 0.0], [-0.1, 0.05, 0.0], [-0.1, -0.05, 0.0]])


def walking_log(samples: int = SAMPLES, *, fell: bool = False) -> Log:
    """Two legs of two joints: a quarter of the time on both feet, then on the left, on both and on the right one."""
    joints = ["left_hip", "left_knee", "right_hip", "right_knee"]
    time = np.arange(samples) * 0.01
    wave = np.sin(time)[:, None] * np.arange(1, 5)
    quarter = np.arange(samples) * 4 // samples
    channels = {
        "time": time,
        "joint/position": wave,
        "joint/torque_command": 10 * wave,
        "imu/linear_acceleration": np.tile([0.0, 0.0, 9.81], (samples, 1)),
        "imu/angular_velocity": np.zeros((samples, 3)),
        "reference/joint/position": wave + 0.001,
        "reference/joint/feedforward_torque": 9 * wave,
        "reference/com/position": np.tile([0.0, 0.0, 0.7], (samples, 1)),
        "reference/zmp": np.zeros((samples, 2)),
        "truth/com/position": np.tile([0.002, -0.003, 0.7], (samples, 1)),
        "truth/joint/position": wave,
        "truth/joint/velocity": np.cos(time)[:, None] * np.arange(1, 5),
        "truth/joint/friction_torque": np.sign(np.cos(time))[:, None] * np.ones(4),
    }
    for side, y, swing in (("left", 0.1, 3), ("right", -0.1, 1)):
        stands = quarter != swing
        force = np.zeros((samples, 4, 3))
        # All load on the front pads.
        force[:, :2, 2] = np.where(stands, 200.0, 0.0)[:, None]
        channels |= {
            f"foot/{side}/pad_force": force,
            f"truth/foot/{side}/pad_force": force,
            f"truth/foot/{side}/position": np.tile([0.5, y, 0.0], (samples, 1)),
            f"reference/foot/{side}/position": np.tile([0.5, y, 0.0], (samples, 1)),
            f"reference/foot/{side}/support": stands.astype(float),
        }
    outcome = {"fell": fell, "reason": "t = 3.990 s: fell: <tilted>" if fell else "finished", "time": float(time[-1])}
    meta = {"joints": joints, "sides": ["left", "right"], "period": 0.01, "scenario": "walk: {seed: 0}", "outcome": outcome}
    return Log(channels, meta)


def joints_only_log() -> Log:
    """A log of an arm: no sides, no plan, no truth, no IMU."""
    log = walking_log()
    channels = {name: log[name] for name in ("time", "joint/position", "joint/torque_command")}
    return Log(channels, {"joints": ["shoulder", "elbow", "wrist_1", "wrist_2"], "period": 0.01})


class _Page(HTMLParser):
    """Collects the tags and what they refer to."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.links: list[str] = []
        self.titles: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append(tag)
        self.sources += [attributes["src"]] if "src" in attributes else []
        self.links += [attributes["href"]] if "href" in attributes else []
        self.titles += [attributes["alt"]] if tag == "img" else []


def titles(log: Log) -> list[str]:
    return [block.title for blocks in figures.simulation_figures(log).values() for block in blocks]


@pytest.fixture(scope="module")
def walk_report(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    log = walking_log()
    log = dataclasses.replace(log, meta=log.meta | {"pads": dict.fromkeys(log.sides, PADS.tolist())})
    write_simulation_report(path, log, simulation_metrics(log, 2.0), name="a_walk")
    return path.read_text(encoding="utf-8")


def test_report_refers_to_nothing_outside_itself(walk_report):
    page = _Page(walk_report)
    assert page.titles == titles(walking_log())
    assert len(page.titles) == 10
    for source in page.sources:
        assert base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True).startswith(b"\x89PNG")
    assert page.links
    assert all(link.startswith("#") for link in page.links)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert "url(" not in walk_report
    assert "@import" not in walk_report


def test_report_tells_outcome_and_figures_of_merit(walk_report):
    assert "The run finished after 3.99 s." in walk_report
    # Tracking error 1 mrad at every joint, CoM error 2 and 3 mm.
    assert '<tr><td>left hip</td><td class="number">1.00</td></tr>' in walk_report
    assert '<td>CoM error in x, mean</td><td class="number">2.00</td><td>mm</td>' in walk_report
    assert '<td>CoM error in y, mean</td><td class="number">3.00</td><td>mm</td>' in walk_report
    # No estimator ran: what it would have reported is left out, not shown as n/a.
    assert "Estimated" not in walk_report
    assert ">n/a<" not in walk_report


def test_fall_and_scenario_are_escaped_text(tmp_path, monkeypatch):
    monkeypatch.setattr("fbse_drake.report.simulation.simulation_figures", lambda *_, **__: {topic: [] for topic in TOPICS})
    log = walking_log(fell=True)
    log = dataclasses.replace(log, meta=log.meta | {"scenario": "title: <script>alert(1)</script>"})
    write_simulation_report(tmp_path / "report.html", log, simulation_metrics(log, 2.0), name="<b>")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "The run ended early at t = 3.990 s: fell: &lt;tilted&gt;." in text
    assert 'class="outcome failed"' in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert not {"script", "b", "tilted"} & set(_Page(text).tags)


def test_figures_follow_the_channels():
    log = walking_log()
    without_plan = Log({name: values for name, values in log.items() if not name.startswith("reference/")}, log.meta)
    assert [title for title in titles(log) if title not in titles(without_plan)] == [
        "Footprints",
        "Centre of mass",
        "Joint tracking errors",
    ]
    assert titles(joints_only_log()) == ["Joint angles", "Joint torques"]
    assert tuple(figures.simulation_figures(joints_only_log())) == TOPICS


def test_feet_in_the_air_have_no_force_figure():
    log = walking_log()
    hanging = {f"truth/foot/{side}/pad_force": np.zeros((SAMPLES, 4, 3)) for side in log.sides}
    assert "Foot forces" in titles(log)
    assert "Foot forces" not in titles(Log(log.channels | hanging, log.meta))


def test_a_panel_for_each_joint_of_any_robot():
    for log in (walking_log(), joints_only_log()):
        panels = [axes.get_title(loc="left") for axes in figures.joint_angles(log).axes]
        assert sorted(panels) == sorted(name.replace("_", " ") for name in log.joints)


def test_phases_are_named_as_in_the_paper():
    phases = figures.support_phases(walking_log())
    assert [phase.label for phase in phases] == ["DS", "LS", "DS", "RS"]
    assert [phase.start for phase in phases] == pytest.approx([0.0, 1.0, 2.0, 3.0])
    assert phases[-1].end == pytest.approx(3.99)
    assert figures.support_phases(joints_only_log()) == []


def test_measured_zmp_is_the_centre_of_the_pad_forces():
    log = walking_log()
    figure = figures.footprints(log, pads=dict.fromkeys(log.sides, PADS))
    expected = np.array([[0.6, 0.0], [0.6, 0.1], [0.6, 0.0], [0.6, -0.1]]).repeat(SAMPLES // 4, axis=0)
    (line,) = (line for line in figure.axes[0].get_lines() if line.get_label() == "measured ZMP")
    np.testing.assert_allclose(line.get_xydata(), expected, atol=1e-12)


def test_soles_are_drawn_where_the_feet_stand():
    log = walking_log()
    axes = figures.footprints(log, outlines={"left": PADS[:, :2], "right": 2 * PADS[:, :2]}).axes[0]
    soles = [patch.get_xy()[:4] for patch in axes.patches if patch.get_label() == "right foot"]
    # The right foot stands twice.
    np.testing.assert_allclose(soles, [[0.5, -0.1] + 2 * PADS[:, :2]] * 2)


def test_long_series_are_thinned_without_losing_a_spike():
    log = walking_log(40_003)
    torque = np.zeros((40_003, 4))
    torque[23_456, 0] = 77.0
    torque[40_002, 0] = -5.0
    figure = figures.torques(Log(log.channels | {"joint/torque_command": torque}, log.meta))
    points = figure.axes[0].get_lines()[0].get_xydata()
    assert points[:, 1].max() == 77.0
    assert points[points[:, 1].argmax(), 0] == pytest.approx(234.56)
    assert points[-1, 1] == -5.0
    assert len(points) < 2100
    assert (np.diff(points[:, 0]) >= 0).all()


def test_drawing_leaves_matplotlib_as_it_was():
    before = dict(mpl.rcParams)
    figures.joint_angles(walking_log())
    figures.footprints(walking_log())
    assert dict(mpl.rcParams) == before


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (math.nan, "n/a"),
        (0.0, "0"),
        (0.00123456, "0.00123"),
        (0.9999, "1.00"),
        (-2.5, "-2.50"),
        (99.96, "100"),
        (12345.6, "12346"),
        (math.inf, "inf"),
    ],
)
def test_numbers_are_rounded_for_reading(value, text):
    assert number(value) == text


def test_tables_leave_out_rows_without_numbers():
    (table,) = numeric_table(("Joint", "a", "b"), [("hip", math.nan, 2.0), ("knee", math.nan, math.nan)])
    assert [row[0] for row in table.rows] == ["hip"]
    text = render_report(Report("r", True, "done", (Section("s", tables=(table,)),)))
    assert '<td>hip</td><td class="number">n/a</td><td class="number">2.00</td>' in text
    assert numeric_table(("Joint", "a"), [("knee", math.nan)]) == ()


def test_report_replaces_the_old_one_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    write_report(path, Report("new", True, "done", (Section("s", "text", details=(Details("d", "t"),)),)))
    assert "<title>new</title>" in path.read_text()
    assert list(tmp_path.iterdir()) == [path]


def test_failed_report_keeps_the_old_one(tmp_path):
    class Broken(Figure):
        def savefig(self, *_, **__):
            raise RuntimeError("no picture")

    path = tmp_path / "report.html"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="no picture"):
        write_report(path, Report("new", True, "done", (Section("s", figures=(FigureBlock("f", "", Broken()),)),)))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
