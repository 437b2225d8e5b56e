"""The report of a run: what it shows, that it holds everything it shows, and that it copes with
logs that lack channels."""

import base64
import dataclasses
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report import figures
from fbse_drake.report.figures import base, consistency, joint_friction, joints, panels, walk
from fbse_drake.report.figures.kind import FigureKind
from fbse_drake.report.html import (
    Details,
    FigureBlock,
    Report,
    Section,
    number,
    numeric_table,
    render_report,
    write_report,
)
from fbse_drake.report.metrics import run_metrics
from fbse_drake.report.run import write_run_report

SAMPLES = 400
TOPICS = ("walk", "joints", "forces", "friction", "base", "consistency", "sensors")
PADS = np.array([[0.1, 0.05, 0.0], [0.1, -0.05, 0.0], [-0.1, 0.05, 0.0], [-0.1, -0.05, 0.0]])


def walking_log(samples: int = SAMPLES, *, fell: bool = False) -> Log:
    """Two legs of two joints: a quarter of the time on both feet, then on the left, on both and on
    the right one."""
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
    outcome = {
        "fell": fell,
        "reason": "t = 3.990 s: fell: <tilted>" if fell else "finished",
        "time": float(time[-1]),
    }
    meta = {
        "joints": joints,
        "sides": ["left", "right"],
        "period": 0.01,
        "scenario": "walk: {seed: 0}",
        "outcome": outcome,
    }
    return Log(channels, meta)


def joints_only_log() -> Log:
    """A log of an arm: no sides, no plan, no truth, no IMU."""
    log = walking_log()
    channels = {name: log[name] for name in ("time", "joint/position", "joint/torque_command")}
    return Log(channels, {"joints": ["shoulder", "elbow", "wrist_1", "wrist_2"], "period": 0.01})


def estimated_log(scenario: str = "walk: {estimator: !Fbse {}}") -> Log:
    """`walking_log` with estimates: friction 10 % too large, roll wrong by half a degree, filters
    that are consistent."""
    log, random = walking_log(), np.random.default_rng(0)
    truth = log["truth/joint/friction_torque"]
    tilt = math.radians(0.5) / 2
    level = np.tile([1.0, 0.0, 0.0, 0.0], (SAMPLES, 1))
    variances = {
        "attitude": (9, 3),
        "base_state": (6, 2),
        "joint_acceleration": (12, 12),
        "friction": (4, 4),
    }
    channels = {
        "estimate/joint/friction_torque": 1.1 * np.concatenate([truth[:1], truth[:-1]]),
        "estimate/friction/parameters": np.tile([2.0, 0.5], (SAMPLES, 4, 1)),
        "estimate/friction/parameter_variance": np.full((SAMPLES, 4, 2), 0.01),
        "estimate/base/orientation": np.tile(
            [math.cos(tilt), math.sin(tilt), 0.0, 0.0], (SAMPLES, 1)
        ),
        "truth/base/orientation": level,
        "estimate/base/velocity": np.tile([0.001, 0.0, 0.0], (SAMPLES, 1)),
        "truth/base/velocity": np.zeros((SAMPLES, 3)),
        "estimate/com/position": log["truth/com/position"] + [0.004, 0.0, 0.0],
        "estimate/support": np.stack(
            [log[f"reference/foot/{side}/support"] for side in log.sides], axis=1
        ),
        "estimate/sensors/status": np.zeros((SAMPLES, 4)),
    }
    for name, (components, variance) in variances.items():
        channels[f"estimate/{name}/innovation"] = random.standard_normal((SAMPLES, components))
        channels[f"estimate/{name}/innovation_variance"] = np.ones((SAMPLES, variance))
        channels[f"estimate/{name}/status"] = np.zeros(SAMPLES)
    return Log(log.channels | channels, log.meta | {"scenario": scenario})


def without(log: Log, *beginnings: str) -> Log:
    return Log(
        {name: values for name, values in log.items() if not name.startswith(beginnings)}, log.meta
    )


def line(figure: Figure, panel: int, label: str) -> np.ndarray:
    """Points of the line with this label."""
    (found,) = (line for line in figure.axes[panel].get_lines() if line.get_label() == label)
    return found.get_xydata()


def with_pads(**pads: np.ndarray) -> Log:
    """`walking_log` that knows where the pads are."""
    log = walking_log()
    places = {side: of_side.tolist() for side, of_side in pads.items()}
    return dataclasses.replace(log, meta=log.meta | {"pads": places})


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


def page_text(path: Path) -> str:
    """Of a report, without the labels that phones show in its cells."""
    return re.sub(r' data-label="[^"]*"', "", path.read_text(encoding="utf-8"))


def titles(log: Log) -> list[str]:
    """Of the figures of a log, which can be drawn."""
    blocks = [block for of_topic in figures.run_figures(log).values() for block in of_topic]
    assert all(isinstance(block.draw(), Figure) for block in blocks)
    return [block.title for block in blocks]


@pytest.fixture(scope="module")
def walk_report(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    log = walking_log()
    log = dataclasses.replace(
        log, meta=log.meta | {"pads": dict.fromkeys(log.sides, PADS.tolist())}
    )
    write_run_report(path, log, run_metrics(log, 2.0), name="a_walk")
    return path.read_text(encoding="utf-8")


def test_report_refers_to_nothing_outside_itself(walk_report):
    page = _Page(walk_report)
    assert page.titles == titles(walking_log())
    assert len(page.titles) == 10
    for source in page.sources:
        assert base64.b64decode(
            source.removeprefix("data:image/png;base64,"), validate=True
        ).startswith(b"\x89PNG")
    assert page.links
    assert all(link.startswith("#") for link in page.links)
    assert not {"link", "iframe", "object"} & set(page.tags)
    # What draws the chart is in the page.
    assert not re.search(r"<script[^>]* src", walk_report)
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


def log_with_law(*shares: float) -> Log:
    """`walking_log` whose torque is off its law by these shares, joint by joint."""
    log = walking_log()
    law = log["truth/joint/friction_torque"]
    channels = {"truth/joint/friction_law_torque": law}
    channels["truth/joint/friction_torque"] = law * (1 + np.array(shares))
    return Log(log.channels | channels, log.meta)


@pytest.mark.usefixtures("blank_pictures")
def test_report_says_where_a_law_is_not_followed(tmp_path):
    log = log_with_law(0.001, 0.25, 0.0, 0.02)
    write_run_report(tmp_path / "report.html", log, run_metrics(log, 2.0), name="a_walk")
    text = page_text(tmp_path / "report.html")
    assert 'worst joint (left knee)</td><td class="number">25.0</td><td>% of law</td>' in text
    assert "in left knee (25.0 %), right knee (2.0 %). Steps that are solved twice" in text
    assert "--set solve_twice=true" in text
    assert "Thin: the law" in text


@pytest.mark.usefixtures("blank_pictures")
def test_report_of_laws_that_are_followed_has_their_error_only(tmp_path, walk_report):
    log = log_with_law(0.001, 0.009, 0.0, 0.0)
    write_run_report(tmp_path / "report.html", log, run_metrics(log, 2.0), name="a_walk")
    text = page_text(tmp_path / "report.html")
    assert 'worst joint (left knee)</td><td class="number">0.900</td><td>% of law</td>' in text
    for words in ("Steps that are solved twice", "Thin: the law"):
        assert words not in text
    # A log without a law says nothing of it.
    assert "% of law" not in walk_report


def test_the_law_is_drawn_for_the_joint_that_is_farthest_from_it():
    log = log_with_law(0.0, 0.25, 0.5, 0.02)
    figure = joint_friction.friction(log)
    drawn = {
        axes.get_title(loc="left"): line.get_xydata()[:, 1]
        for axes in figure.axes
        for line in axes.get_lines()
        if line.get_label() == "its law, right hip"
    }
    assert list(drawn) == ["right hip"]
    np.testing.assert_array_equal(drawn["right hip"], log["truth/joint/friction_law_torque"][:, 2])
    followed = joint_friction.friction(log_with_law(0.0, 0.0, 0.005, 0.0))
    assert all(len(axes.get_lines()) == 1 for axes in followed.axes)


def test_fall_and_scenario_are_escaped_text(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "fbse_drake.report.run.run_figures", lambda *_, **__: {topic: [] for topic in TOPICS}
    )
    log = walking_log(fell=True)
    log = dataclasses.replace(log, meta=log.meta | {"scenario": "title: <script>alert(1)</script>"})
    write_run_report(tmp_path / "report.html", log, run_metrics(log, 2.0), name="<b>")
    text = page_text(tmp_path / "report.html")
    assert "The run ended early at t = 3.990 s: fell: &lt;tilted&gt;." in text
    assert 'class="outcome failed"' in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    tags = _Page(text).tags
    assert not {"b", "tilted"} & set(tags)
    # The chart's data, the library that draws it, and what does.
    assert tags.count("script") == 3


def test_figures_follow_the_channels():
    log = walking_log()
    assert [title for title in titles(log) if title not in titles(without(log, "reference/"))] == [
        "Footprints",
        "Centre of mass",
        "Joint tracking errors",
    ]
    assert titles(joints_only_log()) == ["Joint angles", "Joint torques"]
    assert tuple(figures.run_figures(joints_only_log())) == TOPICS


def test_feet_in_the_air_have_no_force_figure():
    log = walking_log()
    hanging = {f"truth/foot/{side}/pad_force": np.zeros((SAMPLES, 4, 3)) for side in log.sides}
    assert "Foot forces" in titles(log)
    assert "Foot forces" not in titles(Log(log.channels | hanging, log.meta))


def test_a_panel_for_each_joint_of_any_robot():
    for log in (walking_log(), joints_only_log()):
        panels = [axes.get_title(loc="left") for axes in joints.joint_angles(log).axes]
        assert sorted(panels) == sorted(name.replace("_", " ") for name in log.joints)


def test_phases_are_named_as_in_the_paper():
    phases = panels.support_phases(walking_log())
    assert [phase.label for phase in phases] == ["DS", "LS", "DS", "RS"]
    assert [phase.start for phase in phases] == pytest.approx([0.0, 1.0, 2.0, 3.0])
    assert phases[-1].end == pytest.approx(3.99)
    assert panels.support_phases(joints_only_log()) == []


def test_measured_zmp_is_the_centre_of_the_pad_forces():
    figure = walk.footprints(with_pads(left=PADS, right=PADS))
    expected = np.array([[0.6, 0.0], [0.6, 0.1], [0.6, 0.0], [0.6, -0.1]]).repeat(
        SAMPLES // 4, axis=0
    )
    (line,) = (line for line in figure.axes[0].get_lines() if line.get_label() == "measured ZMP")
    np.testing.assert_allclose(line.get_xydata(), expected, atol=1e-12)


def test_soles_are_drawn_where_the_feet_stand():
    axes = walk.footprints(with_pads(left=PADS, right=2 * PADS)).axes[0]
    soles = [patch.get_xy()[:4] for patch in axes.patches if patch.get_label() == "right foot"]
    # The right foot stands twice.
    expected = [0.5, -0.1] + 2 * PADS[:, :2]
    assert len(soles) == 2
    for sole in soles:
        np.testing.assert_allclose(sorted(sole.tolist()), sorted(expected.tolist()))


def test_feet_whose_pads_are_in_one_line_are_crosses():
    axes = walk.footprints(with_pads(left=PADS * [1, 0, 0], right=PADS)).axes[0]
    assert {patch.get_label() for patch in axes.patches} == {"right foot", "planned foothold"}
    crosses = [line for line in axes.get_lines() if line.get_label() == "left foot"]
    assert {line.get_marker() for line in crosses} == {"x"}


def test_long_series_are_thinned_without_losing_a_spike():
    log = walking_log(40_003)
    torque = np.zeros((40_003, 4))
    torque[23_456, 0] = 77.0
    torque[40_002, 0] = -5.0
    figure = joints.torques(Log(log.channels | {"joint/torque_command": torque}, log.meta))
    points = figure.axes[0].get_lines()[0].get_xydata()
    assert points[:, 1].max() == 77.0
    assert points[points[:, 1].argmax(), 0] == pytest.approx(234.56)
    assert points[-1, 1] == -5.0
    assert len(points) < 2100
    assert (np.diff(points[:, 0]) >= 0).all()


# As people see colours who lack the red, green or blue cones (Machado, Oliveira and Fernandes 2009,
# severity 1), for linear RGB.
_SIGHT = {
    "all cones": np.eye(3),
    "no red cones": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green cones": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "no blue cones": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
_XYZ_OF_RGB = [
    [0.4124564, 0.3575761, 0.1804375],
    [0.2126729, 0.7151522, 0.0721750],
    [0.0193339, 0.1191920, 0.9503041],
]


def difference(first: str, second: str, sight: str) -> float:
    """CIE 1976 colour difference, of which about 2 can just be seen."""
    places = []
    for color in (first, second):
        rgb = np.array(to_rgb(color))
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        seen = np.clip(_SIGHT[sight] @ linear, 0.0, 1.0)
        x, y, z = np.cbrt(_XYZ_OF_RGB @ seen / [0.95047, 1.0, 1.08883])
        places.append(np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)]))
    return float(np.linalg.norm(places[0] - places[1]))


@pytest.mark.parametrize("sight", _SIGHT)
def test_nobody_takes_the_truth_for_an_estimate(sight: str):
    log = estimated_log()
    compared = 0
    for kind in (
        joint_friction.estimated_friction,
        base.base_attitude,
        base.base_velocity,
        walk.com,
    ):
        for axes in kind(log).axes:
            lines = {line.get_label().split(",")[0]: line for line in axes.get_lines()}
            if true := lines.get("true friction", lines.get("true")):
                color = lines["estimated"].get_color()
                assert difference(true.get_color(), color, sight) > 30.0
                compared += 1
    assert compared == 4 + 2 + 3 + 2
    # What was found wanting: red over orange.
    assert difference("#c81e1e", "#d65f1a", sight) < 30.0


def test_drawing_leaves_matplotlib_as_it_was():
    before = dict(mpl.rcParams)
    joints.joint_angles(walking_log())
    walk.footprints(walking_log())
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
    (table,) = numeric_table(
        ("Joint", "a", "b"), [("hip", math.nan, 2.0), ("knee", math.nan, math.nan)]
    )
    assert [row[0] for row in table.rows] == ["hip"]
    text = render_report(Report("r", True, "done", (Section("s", tables=(table,)),)))
    assert '<td>hip</td><td class="number">n/a</td><td class="number">2.00</td>' in text
    assert numeric_table(("Joint", "a"), [("knee", math.nan)]) == ()


def test_report_replaces_the_old_one_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    write_report(
        path, Report("new", True, "done", (Section("s", "text", details=(Details("d", "t"),)),))
    )
    assert "<title>new</title>" in path.read_text()
    assert list(tmp_path.iterdir()) == [path]


def test_failed_report_keeps_the_old_one(tmp_path):
    class Broken(Figure):
        def draw(self, *_, **__):
            raise RuntimeError("no picture")

    path = tmp_path / "report.html"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="no picture"):
        write_report(
            path,
            Report("new", True, "done", (Section("s", figures=(FigureBlock("f", "", Broken),)),)),
        )
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("blank_pictures")
def test_report_of_estimates_tells_their_errors(tmp_path):
    log = estimated_log()
    write_run_report(
        tmp_path / "report.html",
        log,
        run_metrics(log, 2.0, np.full(SAMPLES, 0.0006)),
        name="a_walk",
    )
    text = page_text(tmp_path / "report.html")
    assert len(_Page(text).titles) == 17
    # Friction of 1 Nm, estimated as 1.1 Nm, in stance and in swing.
    numbers = "".join(
        f'<td class="number">{value}</td>' for value in ("0.100", "0.100", "0.100", "0.100")
    )
    assert f"<tr><td>left knee</td>{numbers}</tr>" in text
    assert '<td>Estimated roll, RMS error</td><td class="number">0.500</td><td>deg</td>' in text
    assert (
        '<td>Estimated base velocity in x, RMS error</td><td class="number">1.00</td><td>mm/s</td>'
        in text
    )
    assert '<td>Estimator tick, median</td><td class="number">600</td><td>µs</td>' in text
    assert "<tr><td>base state</td><td>velocity</td>" in text
    assert ">n/a<" not in text


@pytest.mark.usefixtures("blank_pictures")
def test_report_of_a_recording_tells_what_is_known(tmp_path):
    log = without(estimated_log(), "truth/", "reference/")
    log = dataclasses.replace(
        log,
        meta={key: log.meta[key] for key in ("joints", "sides", "period")}
        | {"estimator_scenario": "mine: {}"},
    )
    write_run_report(
        tmp_path / "report.html",
        log,
        run_metrics(log, 2.0, np.full(SAMPLES, 0.0006)),
        name="a_robot",
    )
    text = page_text(tmp_path / "report.html")
    assert "A recording of 3.99 s." in text
    assert "YAML of the estimator that ran over the log" in text
    assert "Joint tracking error" not in text
    assert "RMSE [Nm]" not in text
    assert ">n/a<" not in text


@pytest.mark.parametrize("samples", [1, 15])
def test_a_log_that_ends_before_the_filters_have_settled_has_all_figures(samples):
    log = estimated_log()
    assert "Error of the friction estimate" in titles(
        Log({name: values[:samples] for name, values in log.items()}, log.meta)
    )


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """All figures are empty, which saves the time to draw them."""
    monkeypatch.setattr(FigureKind, "block", lambda kind, _: FigureBlock(kind.title, "", Figure))


@pytest.mark.usefixtures("undrawn")
def test_figures_of_estimates_follow_the_channels():
    log = estimated_log()
    added = [
        "Estimated joint friction",
        "Error of the friction estimate",
        "Identified friction parameters",
        "Base attitude",
        "Base velocity",
        "Support",
        "Consistency of the filters",
        "Consistency of the friction filters",
    ]
    assert [title for title in titles(log) if title not in titles(walking_log())] == added
    assert "Joint friction" not in titles(log)
    recorded = without(log, "truth/", "reference/")
    assert [title for title in added if title not in titles(recorded)] == [
        "Error of the friction estimate"
    ]
    assert "Friction over velocity" not in titles(recorded)
    assert "Centre of mass" in titles(recorded)
    # An estimator of friction alone.
    friction_only = Log(
        walking_log().channels | {"estimate/joint/friction_torque": np.ones((SAMPLES, 4))}, log.meta
    )
    assert [
        title for title in titles(friction_only) if title not in titles(walking_log())
    ] == added[:2]


def test_estimate_and_truth_are_drawn_at_the_end_of_the_same_step():
    log = estimated_log()
    figure = joint_friction.estimated_friction(log)
    estimate, truth = line(figure, 0, "estimated, left"), line(figure, 0, "true friction")
    np.testing.assert_allclose(estimate[1:], truth[1:] * [1.0, 1.1])
    error = joint_friction.friction_errors(log)
    assert error.axes[0].get_title(loc="right") == "RMS 0.10 Nm"
    known = without(log, "truth/")
    assert [
        label
        for label in joint_friction.estimated_friction(known).axes[0].get_legend_handles_labels()[1]
        if "true" in label
    ] == []


def test_swings_of_the_joints_own_leg_are_shaded():
    for log in (estimated_log(), without(estimated_log(), "reference/")):
        panels = joint_friction.estimated_friction(log).axes
        spans = {
            axes.get_title(loc="left"): [patch.get_extents() for patch in axes.patches]
            for axes in panels
        }
        places = {
            name: [axes.transData.inverted().transform(box)[:, 0] for box in spans[name]]
            for axes in panels
            for name in [axes.get_title(loc="left")]
        }
        np.testing.assert_allclose(places["left hip"], [[3.0, 3.99]], atol=1e-6)
        np.testing.assert_allclose(places["right knee"], [[1.0, 2.0]], atol=1e-6)


def test_a_spike_of_an_estimate_does_not_flatten_its_panel():
    log = estimated_log()
    spiky = log["estimate/joint/friction_torque"].copy()
    spiky[200, 0] = 500.0
    axes = joint_friction.estimated_friction(
        Log(log.channels | {"estimate/joint/friction_torque": spiky}, log.meta)
    ).axes[0]
    low, high = axes.get_ylim()
    assert -1.6 < low < -1.1
    assert 1.1 < high < 1.6
    # What really acted is shown whole.
    true_spike = log["truth/joint/friction_torque"].copy()
    true_spike[200, 0] = 50.0
    assert (
        joint_friction.estimated_friction(
            Log(log.channels | {"truth/joint/friction_torque": true_spike}, log.meta)
        )
        .axes[0]
        .get_ylim()[1]
        > 50
    )


@pytest.mark.parametrize(
    ("scenario", "titles", "bands"),
    [
        ("walk: {estimator: !Fbse {}}", ["coulomb [Nm]", "viscous [Nm s/rad]"], True),
        (
            "walk: {estimator: !Fbse {friction: !RecursiveLeastSquares {}}}",
            ["coulomb [Nm]", "viscous [Nm s/rad]"],
            False,
        ),
        ("walk: {sed: 0}", ["parameter 1", "parameter 2"], False),
        ("not yaml: [", ["parameter 1", "parameter 2"], False),
    ],
)
def test_parameters_are_named_by_the_scenarios_friction_model(scenario, titles, bands):
    figure = joint_friction.friction_parameters(estimated_log(scenario))
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == titles
    found = [
        collection.get_paths()[0].vertices[:, 1]
        for axes in figure.axes
        for collection in axes.collections
    ]
    assert bool(found) == bands
    if bands:
        assert (found[0].min(), found[0].max()) == pytest.approx((1.8, 2.2))


def test_nis_is_averaged_over_half_a_second():
    log = estimated_log()
    innovation = np.ones((SAMPLES, 4)) * np.where(np.arange(SAMPLES) % 2, 1.0, -1.0)[:, None]
    innovation[200:, 0] *= 2.0
    figure = consistency.friction_consistency(
        Log(log.channels | {"estimate/friction/innovation": innovation}, log.meta)
    )
    time, nis = line(figure, 0, "NIS, left").T
    assert np.isnan(nis[time < 0.2]).all()
    assert nis[(time >= 0.2) & (time < 1.7)] == pytest.approx(1.0)
    assert nis[time > 2.3] == pytest.approx(4.0)
    assert nis[200] == pytest.approx(1 + 3 * 26 / 51)


def stuck_imu() -> Log:
    status = np.zeros((SAMPLES, 4))
    status[100:150, 1] = 2.0
    return Log(estimated_log().channels | {"estimate/sensors/status": status}, estimated_log().meta)


@pytest.mark.usefixtures("undrawn")
def test_status_is_shown_only_if_something_was_not_trusted():
    assert "Status of sensors and estimators" not in titles(estimated_log())
    assert "Status of sensors and estimators" in titles(stuck_imu())


def test_status_is_drawn_by_sensor_and_estimator():
    figure = consistency.statuses(stuck_imu())
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names[:5] == ["joints", "IMU", "left foot", "right foot", "attitude"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ok", "stuck"]
    boxes = [
        collection.get_paths()[0].get_extents()
        for collection in figure.axes[0].collections
        if len(collection.get_paths()) == 1
    ]
    stuck = next(box for box in boxes if box.width < 1)
    assert (stuck.x0, stuck.x1) == pytest.approx((1.0, 1.5))
    assert stuck.y0 < names.index("IMU") < stuck.y1
