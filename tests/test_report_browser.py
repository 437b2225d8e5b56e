"""Reports and recordings of runs in a real browser, headless Chromium: they need nothing outside
themselves, and show all they hold."""

import io
import math
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from test_any_plant import CRANE, crane
from test_discrepancy_report import FRICTION, INPUTS, NOTHING, made_diagnosis
from test_report import joints_only_log

from fbse_drake import Log, load_scenario, simulate
from fbse_drake.discrepancy.diagnosis.compare import compare
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import Study, StudyStep, model_error, study
from fbse_drake.discrepancy.residual.rollout import RolloutError
from fbse_drake.effects.actuation import TorqueBias
from fbse_drake.effects.friction import CoulombFriction, ViscousFriction
from fbse_drake.report import discrepancy as reports
from fbse_drake.report.html import Report, Section, Table, write_report
from fbse_drake.report.metrics import run_metrics
from fbse_drake.report.replay import Motion, write_replay
from fbse_drake.report.run import write_run_report
from fbse_drake.report.runs import read_runs, write_runs_report

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed (pip install playwright)"
)

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Containers run as root and without a graphics card.
_OPTIONS = ["--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader"]
# Widths [px] and colour schemes.
VIEWS = ((390, "light"), (390, "dark"), (820, "light"), (1600, "dark"))
# The order of a lab report.
SUMMARY, WHERE, WHY, ELSE, FALL, HYGIENE, AGAIN = (
    "Summary",
    "Where the model fails",
    "Why it fails",
    "What else was looked for",
    "How the error falls",
    "Data hygiene",
    "Reproduce this",
)


@dataclass
class Visit:
    """What a browser says of a page."""

    # Everything that was asked for beyond the page itself and what it holds.
    requests: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    headings: list[str] = field(default_factory=list)
    # Natural and shown widths of all pictures [px].
    pictures: list[tuple[int, int]] = field(default_factory=list)
    # By how much the page is wider than the window [px].
    overflow: int = 0
    # Texts and pictures that reach beyond the window.
    cut_off: list[str] = field(default_factory=list)
    # Mean brightness of the first picture, 0 to 1.
    brightness: float = math.nan
    # Whether the contents can be seen at the end of the page.
    contents: bool = False
    # Of the window, (height, width, 3).
    screenshot: np.ndarray = field(default_factory=lambda: np.empty(0))
    # What a script of the test's own returned.
    told: dict[str, Any] = field(default_factory=dict)


Visitor = Callable[..., list[Visit]]

_LOOK = """() => {
  document.querySelectorAll("details").forEach(details => { details.open = true; });
  const page = document.documentElement;
  return {
    headings: [...document.querySelectorAll("h2")].map(heading => heading.textContent),
    pictures: [...document.querySelectorAll("img")].map(
      picture => [picture.naturalWidth, picture.clientWidth]),
    overflow: page.scrollWidth - page.clientWidth,
    cut_off: [...document.querySelectorAll("h1, h2, h3, p, li, th, td, summary, img")]
      .filter(one => one.getBoundingClientRect().right > page.clientWidth + 0.5)
      .map(one => one.textContent || one.alt),
  };
}"""

# Zooms into the first chart, then chooses its second view.
_LOOK_CLOSER = """async () => {
  const chart = document.querySelector(".chart"), plot = chart.querySelector(".plot");
  while (!plot.querySelector(".trace")) await new Promise(done => setTimeout(done, 50));
  const select = chart.querySelector("select");
  const seen = () => ({
    name: select.value, lines: plot.querySelectorAll(".trace").length,
    range: plot.layout.xaxis.range, y: plot.data.at(-1).y.bdata,
  });
  await Plotly.relayout(plot, {"xaxis.range": [0.1, 0.2]});
  const first = seen();
  select.selectedIndex = 1;
  select.dispatchEvent(new Event("change"));
  await new Promise(done => setTimeout(done, 200));
  const buttons = [...plot.querySelectorAll(".modebar-btn")].map(button => button.dataset.title);
  return {joints: [first, seen()], buttons};
}"""

_CONTENTS_AT_THE_END = """() => {
  window.scrollTo(0, document.body.scrollHeight);
  const link = document.querySelector("nav a")?.getBoundingClientRect();
  return Boolean(link) && link.top >= 0 && link.bottom <= window.innerHeight;
}"""


@pytest.fixture(scope="module")
def visit() -> Iterator[Visitor]:
    """Opens a file without a network: visit(path, (width, scheme), ...), a visit for each view."""
    executable = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if executable is None:
        pytest.skip(f"no browser is installed (looked for {', '.join(_BROWSERS)})")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=executable, args=_OPTIONS)

        def opened(path: Path, *views: tuple[int, str], script: str = "") -> list[Visit]:
            requests: list[str] = []
            errors: list[str] = []
            context = browser.new_context(offline=True)
            page, own = context.new_page(), path.as_uri()
            inside = (own, "data:", "blob:")
            page.on(
                "request",
                lambda request: requests.extend(
                    [request.url] * (not request.url.startswith(inside))
                ),
            )
            page.on("websocket", lambda socket: requests.append(socket.url))
            page.on(
                "console",
                lambda message: errors.extend([message.text] * (message.type == "error")),
            )
            page.on("pageerror", lambda error: errors.append(str(error)))
            found = []
            for width, scheme in views:
                page.set_viewport_size({"width": width, "height": 800})
                page.emulate_media(color_scheme=scheme)
                if not found:
                    page.goto(own, wait_until="networkidle")
                seen = Visit(requests, errors, **page.evaluate(_LOOK))
                seen.screenshot = _pixels(page.screenshot())
                if picture := page.query_selector("figure img"):
                    seen.brightness = float(_pixels(picture.screenshot()).mean())
                if script:
                    seen.told = page.evaluate(script)
                seen.contents = page.evaluate(_CONTENTS_AT_THE_END)
                found.append(seen)
            context.close()
            return found

        yield opened
        browser.close()


def _pixels(png: bytes) -> np.ndarray:
    return matplotlib.image.imread(io.BytesIO(png), format="png")[..., :3]


def check(visit: Visitor, path: Path, headings: list[str], pictures: int) -> None:
    """The file is whole by itself, on a phone, a tablet and a desk, in a light and a dark room."""
    for view, seen in zip(VIEWS, visit(path, *VIEWS), strict=True):
        width, scheme = view
        assert seen.requests == []
        assert seen.errors == []
        assert seen.headings == headings
        assert len(seen.pictures) == pictures
        assert all(natural > 0 and 300 < shown <= width for natural, shown in seen.pictures)
        assert seen.overflow <= 0, view
        assert seen.cut_off == [], view
        assert seen.contents, view
        # Mostly paper.
        assert (seen.brightness > 0.75) if scheme == "light" else (seen.brightness < 0.3), view


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reports")


def test_study_of_a_walk_is_a_lab_report(visit: Visitor, run: Callable[..., Log], folder: Path):
    predictor = Predictor(load_scenario("paper_walk"), run("paper_walk", "duration=3"))
    whole = (predictor, compare(predictor))
    rolled = RolloutError({"left_knee_pitch": 0.012}, {}, {"left_knee_pitch": 3.0}, 3.0, None)
    errors = {"train": model_error(predictor)}
    steps = (
        StudyStep((), 4.2, 4.2, rolled, errors),
        StudyStep((FRICTION,), 1.01, 1.0, rolled, errors),
    )
    found = Study(
        steps, (made_diagnosis(), NOTHING), "the noise floor is reached", predictor.scenario
    )
    reports.write_study_report(folder / "study.html", found, whole, whole, INPUTS)
    check(visit, folder / "study.html", [SUMMARY, WHERE, WHY, ELSE, FALL, HYGIENE, AGAIN], 10)


def test_reports_of_a_machine_without_legs_are_lab_reports(visit: Visitor, folder: Path):
    """A revolute and a prismatic joint: no feet, no phases."""
    (folder / "crane.urdf").write_text(CRANE)
    scenario = crane(
        folder, rail=CoulombFriction({"slide": 7.0}), bearing=ViscousFriction({"swing": 1.5})
    )
    log = simulate(scenario).log
    found = study(
        scenario,
        log,
        [CoulombFriction, ViscousFriction, TorqueBias],
        rollouts=False,
        tests={"another log": log},
    )
    before, after = Predictor(scenario, log), Predictor(found.scenario, log)
    comparison = compare(before)
    reports.write_compare_report(folder / "compare.html", comparison, before, INPUTS)
    check(visit, folder / "compare.html", [SUMMARY, WHERE, HYGIENE, AGAIN], 3)
    assert "In 2 of 2 joints." in (folder / "compare.html").read_text(encoding="utf-8")
    reports.write_diagnosis_report(
        folder / "diagnosis.html",
        found.diagnoses[0],
        before,
        INPUTS,
        reports.Illustrated.of(found.diagnoses[0], comparison, before),
    )
    check(visit, folder / "diagnosis.html", [SUMMARY, WHERE, WHY, ELSE, FALL, HYGIENE, AGAIN], 7)
    reports.write_study_report(
        folder / "study.html",
        found,
        (before, comparison),
        (after, compare(after)),
        INPUTS,
        {"another log": log},
    )
    check(visit, folder / "study.html", [SUMMARY, WHERE, WHY, ELSE, FALL, HYGIENE, AGAIN], 9)
    text = (folder / "study.html").read_text(encoding="utf-8")
    assert "Another log (not fitted): as given [%]" in text
    said = text[: text.index("<h2>Reproduce this")]
    assert not re.findall(r"\b(?:foot|feet|soles?|accelerometer|support)\b", said)


def test_report_of_a_run(visit: Visitor, run: Callable[..., Log], folder: Path):
    log = run("paper_walk", "duration=3")
    write_run_report(folder / "run.html", log, run_metrics(log, 1.0), name="a_walk")
    check(
        visit,
        folder / "run.html",
        [SUMMARY, "Motion", "Joints", "Foot forces", "Friction", "Sensors", "Scenario"],
        10,
    )


def test_charts_of_a_run_share_their_time_axis(visit: Visitor, folder: Path):
    """What is zoomed into stays so for another joint; nothing can be sent away."""
    log = joints_only_log()
    write_run_report(folder / "joints.html", log, run_metrics(log, 1.0), name="joints")
    (seen,) = visit(folder / "joints.html", (1280, "light"), script=_LOOK_CLOSER)
    assert (seen.requests, seen.errors) == ([], [])
    first, second = seen.told["joints"]
    assert [first["name"], second["name"]] == [name.replace("_", " ") for name in log.joints[:2]]
    assert first["lines"] == second["lines"] > 0
    assert first["range"] == second["range"] == [0.1, 0.2]
    assert first["y"] != second["y"]
    assert not any("share" in title.lower() for title in seen.told["buttons"])


def test_runs_beside_each_other(visit: Visitor, folder: Path):
    for name in ("monday", "tuesday"):
        joints_only_log().save(folder / f"{name}.npz")
    runs = read_runs([folder / "monday.npz", folder / "tuesday.npz"])
    write_runs_report(folder / "runs.html", runs)
    check(visit, folder / "runs.html", ["Runs", "Figures", "Joints"], 4)


def test_recording_of_a_run_shows_the_robot(visit: Visitor, folder: Path):
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    simulate(load_scenario("squat", overrides=["duration=0.1"]), meshcat=meshcat)
    meshcat.SetCameraPose([2.2, -2.2, 1.3], [0.2, 0.0, 0.5])
    (folder / "meshcat.html").write_text(meshcat.StaticHtml())
    (seen,) = visit(folder / "meshcat.html", (1280, "light"))
    assert seen.requests == []
    assert seen.errors == []
    assert seen.overflow <= 0
    red, green, blue = np.moveaxis(seen.screenshot, 2, 0)
    # Its right leg is orange, its left one blue; the stage is grey.
    assert (red - blue > 0.3).sum() > 1000
    assert (blue - red > 0.3).sum() > 1000
    assert ((np.abs(red - blue) < 0.1) & (np.abs(red - green) < 0.1)).mean() > 0.5


def test_replay_of_a_study_shows_each_robot_in_its_colour(visit: Visitor, folder: Path):
    """Of an arm whose model has no shapes: its limbs are drawn."""
    q = np.tile([0.0, 0.6, 0.9, 0.0, 0.8, 0.0], (2, 1))
    turned = {"log": 0.0, "model as given": 0.9, "completed model": -0.9}
    motions = {
        name: Motion(np.array([0.0, 0.1]), q + np.eye(6)[0] * angle)
        for name, angle in turned.items()
    }
    write_replay(folder / "replay.html", load_scenario("bsc_arm"), motions)
    (seen,) = visit(folder / "replay.html", (1280, "light"))
    assert seen.requests == []
    assert seen.errors == []
    # Below the bar of the controls: orange, teal and a grey that is darker than the stage.
    scene = seen.screenshot[60:]
    red, green, blue = np.moveaxis(scene, 2, 0)
    found = (red - blue > 0.2, blue - red > 0.2, (np.ptp(scene, axis=2) < 0.1) & (green < 0.3))
    assert [(color.sum() > 300) for color in found] == [True] * 3


def test_what_is_wrong_with_a_page_is_seen(visit: Visitor, tmp_path: Path):
    (tmp_path / "bad.html").write_text(
        "<h2>a</h2><img src='http://localhost:1/picture.png'><img "
        "src='data:image/png;base64,broken'>"
        "<script>new WebSocket('ws://localhost:1'); throw new Error('thrown')</script><div "
        "style='width: 2000px'>wide</div>"
    )
    (seen,) = visit(tmp_path / "bad.html", (1280, "light"))
    assert {"http://localhost:1/picture.png", "ws://localhost:1/"} <= set(seen.requests)
    assert any("thrown" in error for error in seen.errors)
    assert [natural for natural, _ in seen.pictures] == [0, 0]
    assert seen.overflow > 700


def test_a_wide_table_scrolls_by_itself(visit: Visitor, tmp_path: Path):
    header = tuple(f"a long name of column {k}" for k in range(30))
    table = Table(header, (tuple(float(k) for k in range(30)),), "Wide.")
    write_report(
        tmp_path / "report.html", Report("wide", True, "done", (Section("s", tables=(table,)),))
    )
    desk, phone = visit(tmp_path / "report.html", (1280, "light"), (390, "light"))
    assert desk.overflow <= 0
    assert any("column 29" in text for text in desk.cut_off)
    # Where each row is a card, nothing needs to scroll.
    assert phone.cut_off == []
