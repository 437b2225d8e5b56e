"""The reports of compare, diagnose and study: they say what was found, and hold everything they
show."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fbse_drake import Log, load_scenario
from fbse_drake.discrepancy.diagnosis.compare import Comparison, compare
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, EffectStatus, Estimate, Finding
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import ModelError, Study, StudyStep
from fbse_drake.discrepancy.identification.structure import Structure
from fbse_drake.discrepancy.residual.rollout import RolloutError
from fbse_drake.report import discrepancy as reports
from fbse_drake.report import discrepancy_figures as figures
from fbse_drake.report.discrepancy_tables import findings_table
from fbse_drake.report.sentences import diagnosis_outcome, steps_after_diagnosis, verdicts_text

INPUTS = reports.Inputs("a_walk", "paper_walk", ("walk.npz",), "out/a_walk")
KNEES = ("left_knee_pitch", "right_knee_pitch")
FRICTION = Finding(
    "CoulombFriction",
    KNEES,
    8.1,
    1.02,
    {
        "coulomb": Estimate(1.5, (1.4, 1.6), "Nm"),
        "transition": Estimate(0.004, (0.001, 0.007), "rad/s"),
    },
    ("PreslidingHysteresis",),
    chosen=True,
)
RIVAL = Finding(
    "PreslidingHysteresis",
    KNEES,
    8.1,
    1.03,
    {"coulomb": Estimate(1.5, (1.4, 1.6), "Nm")},
    (),
    chosen=False,
)
MASS = Finding(
    "BodyMass", ("trunk",), 5.0, 1.01, {"mass": Estimate(2.0, (1.9, 2.1), "kg")}, (), chosen=True
)
STATUSES = {
    "CoulombFriction": EffectStatus(
        "present",
        "coulomb",
        "Nm",
        dict.fromkeys(KNEES, 0.1),
        "Move each joint to and fro.",
        largest_plausible=dict.fromkeys(KNEES, 50.0),
    ),
    "PreslidingHysteresis": EffectStatus(
        "confusable",
        "coulomb",
        "Nm",
        dict.fromkeys(KNEES, 0.1),
        "Move by small amounts.",
        "squat",
        dict.fromkeys(KNEES, 50.0),
    ),
    "TorqueBias": EffectStatus(
        "absent",
        "bias",
        "Nm",
        {"left_knee_pitch": 0.02, "right_knee_pitch": 1e9},
        "Hold each joint still.",
        largest_plausible=dict.fromkeys(KNEES, 20.0),
    ),
    "ThermalDrift": EffectStatus(
        "not_visible",
        "change",
        "Nm",
        dict.fromkeys(KNEES, np.inf),
        "Repeat one motion.",
        largest_plausible=dict.fromkeys(KNEES, 20.0),
    ),
}


def made_diagnosis(
    verdict: str = "effect_found",
    ranking: tuple[Finding, ...] = (FRICTION, RIVAL),
    **changes: object,
) -> Diagnosis:
    content = {
        "effects": STATUSES,
        "unexplained": (),
        "path": (),
        "held_out_before": 4.2,
        "held_out_after": 1.01,
        "train_after": 1.0,
    }
    return Diagnosis(verdict=verdict, ranking=ranking, **(content | changes))


NOTHING = made_diagnosis("nothing_missing", (), held_out_before=1.0)
UNKNOWN = made_diagnosis(
    "unknown_effect", (), unexplained=(Structure("left_knee_pitch", 3, 6.2, "position", 0.8),)
)


@pytest.fixture(scope="module")
def walk(run: Callable[..., Log]) -> tuple[Predictor, Comparison]:
    """A walk with friction that its model lacks."""
    predictor = Predictor(load_scenario("paper_walk"), run("paper_walk", "duration=3"))
    return predictor, compare(predictor)


def page_text(path: Path) -> str:
    """Of a report, without the labels that phones show in its cells."""
    return re.sub(r' data-label="[^"]*"', "", path.read_text(encoding="utf-8"))


def pages(text: str) -> int:
    """Number of pictures of a report, all of which are in it."""
    assert "http://" not in text.replace("http://www.w3.org", "")
    assert "https://" not in text
    sources = re.findall(r'<img src="([^"]{0,30})', text)
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not re.findall(r"<link|<script[^>]* src", text)
    return len(sources)


def test_compare_report_holds_all_it_shows(walk: tuple[Predictor, Comparison], tmp_path: Path):
    predictor, comparison = walk
    reports.write_compare_report(tmp_path / "report.html", comparison, predictor, INPUTS)
    text = page_text(tmp_path / "report.html")
    assert pages(text) == 3
    assert comparison.failures[0].text.replace("<", "&lt;").replace(">", "&gt;") in text
    assert "fbse diagnose paper_walk walk.npz" in text
    assert "accelerometer 0.02 m/s², gyroscope 0.001 rad/s" in text
    assert "!Walk" in text
    assert ">nan<" not in text


def test_of_phases_that_are_too_short_the_whole_log_is_drawn(walk: tuple[Predictor, Comparison]):
    predictor, comparison = walk
    unknown = dict.fromkeys(("stance", "swing"), (np.nan, np.nan))
    channels = [dataclasses.replace(channel, by_phase=unknown) for channel in comparison.channels]
    short = dataclasses.replace(comparison, channels=tuple(channels))
    posture = predictor.motion.blocks.joint_position[0]
    drawn = figures.robot_errors(predictor.robot, short, posture)
    for axes in drawn.axes[1:-1]:  # Robot and colours are beside them.
        assert [label.get_text() for label in axes.get_xticklabels()] == ["whole\nlog"]
        assert all(text.get_text() != "-" for text in axes.texts)


def test_study_report_holds_all_it_shows(walk: tuple[Predictor, Comparison], tmp_path: Path):
    rolled = RolloutError({"left_knee_pitch": 0.012}, {}, {"left_knee_pitch": 3.0}, 3.0, None)
    better = dataclasses.replace(rolled, position={"left_knee_pitch": 0.002})
    steps = (StudyStep((), 4.2, 4.2, rolled), StudyStep((FRICTION,), 1.01, 1.0, better))
    study = Study(
        steps, (made_diagnosis(), NOTHING), "the noise floor is reached", walk[0].scenario
    )
    reports.write_study_report(tmp_path / "report.html", study, walk, walk, INPUTS)
    text = page_text(tmp_path / "report.html")
    assert pages(text) == 10
    assert "The model lacked Coulomb friction in left and right knee pitch." in text
    assert "falls from 4.20 to 1.01 times" in text
    assert "The noise floor is reached." in text
    assert "The scenario with the completed model" in text
    # Joint positions of the simulated model [mrad].
    assert '<td class="number">12.0</td>' in text
    assert '<td class="number">2.00</td>' in text
    assert "<td>1.50 [1.40,\u00a01.60]</td>" in text
    # What was confusable when it was found stays so, whatever the last round says.
    assert "4 effects: 1 present, 1 confusable, 1 absent, 1 not visible." in text


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """All figures are empty, which saves the time to draw them."""
    for name, function in vars(figures).items():
        if (
            not name.startswith("_")
            and getattr(function, "__annotations__", {}).get("return") is figures.Figure
        ):
            monkeypatch.setattr(figures, name, lambda *_, **__: figures.Figure())


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("diagnosis", "passed", "texts"),
    [
        (
            made_diagnosis(),
            True,
            [
                (
                    "The model lacks Coulomb friction in left and right knee "
                    "pitch; this log cannot "
                    "tell that from presliding hysteresis."
                ),
                (
                    "the error of all channels falls from 4.20 to 1.01 times the "
                    "sensors&#39; noise "
                    "(1.00 on the data that it was fitted to)"
                ),
                (
                    "Presliding hysteresis explains this log as well as Coulomb "
                    "friction in left and "
                    "right knee pitch."
                ),
                (
                    "To tell them apart: Move by small amounts. It shows presliding hysteresis. "
                    "<code>fbse simulate squat"
                ),
                "fbse add paper_walk out/a_walk --out",
                "<td>1.50 [1.40,\u00a01.60]</td><td>0.00400 [0.00100,\u00a00.00700]</td>",
                "<td>bias 0.02 Nm; none in right knee pitch</td>",
                "<td>not visible</td><td>change none in left and right knee pitch</td>",
            ],
        ),
        (
            NOTHING,
            True,
            [
                "Nothing is missing",
                "1 of 4 effects would not show in this log.",
                "no effect explains enough of it on held-out data",
            ],
        ),
        (
            UNKNOWN,
            False,
            [
                (
                    "Something is missing that no effect of the library explains, "
                    "in left knee pitch "
                    "(follows position)."
                ),
                "register an effect",
            ],
        ),
        (
            made_diagnosis("not_visible", ()),
            False,
            [
                (
                    "This log cannot tell whether something is missing: 1 of 4 "
                    "effects would not show "
                    "in it."
                ),
                "Record a motion that shows more: Repeat one motion. It shows thermal drift.",
            ],
        ),
        (
            made_diagnosis(ranking=(FRICTION, MASS)),
            True,
            [
                "The model lacks Coulomb friction in left and right knee pitch and body mass in "
                "trunk"
            ],
        ),
    ],
)
def test_diagnosis_report_says_what_how_sure_what_else_and_what_next(
    diagnosis: Diagnosis,
    passed: bool,
    texts: list[str],
    walk: tuple[Predictor, Comparison],
    tmp_path: Path,
):
    reports.write_diagnosis_report(
        tmp_path / "report.html",
        diagnosis,
        walk[0],
        INPUTS,
        reports.Illustrated.of(diagnosis, walk[1], walk[0]),
    )
    text = page_text(tmp_path / "report.html")
    for expected in texts:
        assert expected in text
    assert ('class="outcome passed"' in text) == passed


@pytest.mark.usefixtures("undrawn")
def test_study_that_finds_nothing_says_so(walk: tuple[Predictor, Comparison], tmp_path: Path):
    study = Study(
        (StudyStep((), 1.0, 1.0, None),), (NOTHING,), "the noise floor is reached", walk[0].scenario
    )
    reports.write_study_report(tmp_path / "report.html", study, walk, walk, INPUTS)
    text = page_text(tmp_path / "report.html")
    assert "Nothing is missing" in text
    assert "completed" not in text


@pytest.mark.usefixtures("blank_pictures")
def test_short_and_exact_logs_have_reports(walk: tuple[Predictor, Comparison], tmp_path: Path):
    """One has no bins, the other no noise."""
    predictor, comparison = walk
    channels = [
        dataclasses.replace(channel, bins={}, noise_floor=0.0) for channel in comparison.channels
    ]
    bare = dataclasses.replace(comparison, channels=tuple(channels))
    reports.write_compare_report(tmp_path / "compare.html", bare, predictor, INPUTS)
    steps = (StudyStep((), 4.2, 4.2, None), StudyStep((FRICTION,), 1.01, 1.0, None))
    ended = "the noise floor is reached"
    study = Study(steps, (made_diagnosis(), NOTHING), ended, predictor.scenario)
    reports.write_study_report(tmp_path / "study.html", study, walk, (predictor, bare), INPUTS)
    for name in ("compare", "study"):
        text = page_text(tmp_path / f"{name}.html")
        assert ">nan<" not in text
        assert ">inf<" not in text


def test_falling_error_shows_both_errors_and_the_noise():
    steps = (
        StudyStep((), 4.2, 4.2, None),
        StudyStep((FRICTION,), 1.3, 1.2, None),
        StudyStep((MASS,), 1.01, 1.0, None),
    )
    (axes,) = figures.falling_error(steps, "mrad").axes
    lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    np.testing.assert_allclose(lines["held-out data"], [4.2, 1.3, 1.01])
    np.testing.assert_allclose(lines["data that it was fitted to"], [4.2, 1.2, 1.0])
    assert set(lines["sensors' noise"]) == {1.0}
    assert [label.get_text() for label in axes.get_xticklabels()][2] == "+ Body mass\n(trunk)"


def test_torques_over_time_are_those_of_motors_and_of_both_models(
    walk: tuple[Predictor, Comparison],
):
    residual = walk[0].residual
    halved = dataclasses.replace(residual, value=0.5 * residual.value)
    knee, pitch = (residual.row_index[name] for name in ("left_knee_pitch", "left_ankle_pitch"))
    shown = slice(100, 200)
    figure = figures.torques_over_time(residual, halved, [knee, pitch], shown)
    torques, _, errors, _ = figure.axes
    lines = {line.get_label(): line.get_ydata() for line in torques.get_lines()}
    measured, left = residual.signals.torque_command[shown, knee], residual.value[shown, knee]
    np.testing.assert_allclose(lines["measured"], measured)
    np.testing.assert_allclose(lines["the model as given"], measured - left)
    np.testing.assert_allclose(lines["the completed model"], measured - 0.5 * left)
    np.testing.assert_allclose(
        [line.get_ydata() for line in errors.get_lines()], [left, 0.5 * left]
    )
    before, after = map(float, re.findall(r"([\d.]+) %", torques.get_title(loc="right")))
    assert before == pytest.approx(100 * np.linalg.norm(left) / np.linalg.norm(measured), rel=0.05)
    assert after == pytest.approx(0.5 * before, rel=0.1)
    assert torques.get_ylabel() == "torque [Nm]"


def test_channels_that_got_better_are_drawn_from_before_to_after(
    walk: tuple[Predictor, Comparison],
):
    channels = walk[1].channels[:2]
    better = [dataclasses.replace(channels[0], rmse=channels[0].noise_floor), channels[1]]
    (axes,) = figures.channel_errors(channels, better).axes
    ratios = [channel.rmse / channel.noise_floor for channel in channels]
    dots = [float(line.get_xdata()[0]) for line in axes.get_lines() if line.get_marker() == "o"]
    np.testing.assert_allclose(dots, [ratios[0], 1.0, ratios[1]])
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "left hip yaw",
        "left hip roll",
    ]


def rolled(size: float) -> RolloutError:
    """Two recordings, joined, of a revolute and a prismatic joint."""
    time = np.concatenate([np.arange(0, 1, 0.01), np.arange(2, 3, 0.01)])
    errors = {"knee": size, "slide": 2 * size}
    shares = {"knee": 0.1 * size, "slide": 0.2 * size}
    series = np.stack([np.full(200, error) for error in errors.values()], axis=1)
    return RolloutError(
        errors, {}, {"knee": 3.0, "slide": 3.0}, 3.0, None, errors, shares, time, series
    )


def test_errors_of_the_simulated_model_over_time_are_not_joined_over_gaps():
    panels = figures.position_errors(rolled(0.02), rolled(0.005), ["Nm", "N"]).axes
    assert [axes.get_title(loc="left") for axes in panels] == ["knee", "slide"]
    assert [axes.get_ylabel() for axes in panels] == ["error [mrad]", "error [mm]"]
    lines = {line.get_label(): line.get_xydata() for line in panels[1].get_lines()}
    before, after = lines["the model as given"], lines["the completed model"]
    assert np.flatnonzero(np.isnan(before[:, 0])).tolist() == [100]
    assert np.nanmax(before[:, 1]) == pytest.approx(40.0)
    assert np.nanmax(after[:, 1]) == pytest.approx(10.0)


def test_wide_intervals_do_not_hide_values():
    wide = dataclasses.replace(
        FRICTION, parameters=FRICTION.parameters | {"coulomb": Estimate(2.0, (-1e6, 1e6), "Nm")}
    )
    axes = figures.parameters([(FRICTION, "first"), (wide, "second")]).axes[0]
    low, high = axes.get_xlim()
    assert -10 < low < high < 10
    marks = {
        line.get_marker(): line.get_ydata().tolist()
        for line in axes.get_lines()
        if line.get_label() == "interval goes on"
    }
    assert marks == {"<": [1], ">": [1]}


@pytest.mark.usefixtures("undrawn")
def test_errors_on_logs_that_were_not_fitted_are_told(
    walk: tuple[Predictor, Comparison], tmp_path: Path
):
    given = {
        "train": ModelError(0.142, {"hip": 0.2, "knee": 0.1}, {}),
        "pulses": ModelError(0.25, {"hip": 0.3, "knee": 0.2}, {}),
    }
    completed = {
        name: ModelError(error.relative / 2, {"hip": 0.1, "knee": 0.05}, {})
        for name, error in given.items()
    }
    steps = (
        StudyStep((), 4.2, 4.2, None, given),
        StudyStep((FRICTION,), 1.3, 1.2, None, completed),
    )
    study = Study(
        steps, (made_diagnosis(), NOTHING), "the noise floor is reached", walk[0].scenario
    )
    inputs = dataclasses.replace(INPUTS, tests=("pulses.npz",))
    reports.write_study_report(
        tmp_path / "report.html", study, walk, walk, inputs, {"pulses": walk[0].motion.log}
    )
    text = page_text(tmp_path / "report.html")
    assert (
        "On the log that was fitted 14.2 % before, 7.10 % after; on pulses (not fitted) 25.0 % "
        "before, 12.5 % after." in text
    )
    numbers = "".join(
        f'<td class="number">{value}</td>' for value in ("20.0", "10.0", "30.0", "10.0")
    )
    assert f"<tr><td>hip</td>{numbers}</tr>" in text
    assert "3.0 s of pulses (not fitted). Right above" in text
    assert "fbse study out/a_walk/scenario.yaml walk.npz --test pulses.npz --out" in text


@pytest.mark.usefixtures("undrawn")
def test_positions_of_the_simulated_model_are_told_by_joint(
    walk: tuple[Predictor, Comparison], tmp_path: Path
):
    def error(size: float) -> RolloutError:
        by_joint = dict.fromkeys(walk[0].robot.joint_names, size)
        return RolloutError(
            by_joint,
            {},
            by_joint,
            3.0,
            None,
            by_joint,
            by_joint,
            np.arange(3.0),
            np.full((3, 12), size),
        )

    steps = (StudyStep((), 4.2, 4.2, error(0.02)), StudyStep((FRICTION,), 1.01, 1.0, error(0.005)))
    study = Study(
        steps, (made_diagnosis(), NOTHING), "the noise floor is reached", walk[0].scenario
    )
    reports.write_study_report(tmp_path / "report.html", study, walk, walk, INPUTS)
    text = page_text(tmp_path / "report.html")
    numbers = "".join(
        f'<td class="number">{value}</td>'
        for value in ("20.0", "5.00", "20.0", "5.00", "2.00", "0.500")
    )
    assert f"<tr><td>left hip yaw</td><td>mrad</td>{numbers}</tr>" in text
    assert "The simulated model, before and after" in text


@pytest.mark.usefixtures("undrawn")
def test_of_a_long_log_the_worst_stretch_is_shown(
    walk: tuple[Predictor, Comparison], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shown = []
    monkeypatch.setattr(
        figures, "torques_over_time", lambda *arguments: shown.append(arguments) or figures.Figure()
    )
    monkeypatch.setattr(reports, "_SHOWN", 100)
    steps = (StudyStep((), 4.2, 4.2, None), StudyStep((FRICTION,), 1.01, 1.0, None))
    study = Study(
        steps, (made_diagnosis(), NOTHING), "the noise floor is reached", walk[0].scenario
    )
    reports.write_study_report(tmp_path / "report.html", study, walk, walk, INPUTS)
    (_, _, joints, stretch) = shown[0]
    residual = walk[0].residual
    power = (residual.value**2 / residual.variance)[:, joints].sum(axis=1)
    assert stretch.stop - stretch.start == 100
    assert power[stretch].sum() == pytest.approx(
        max(power[start : start + 100].sum() for start in range(len(power) - 99))
    )
    assert "the part in which the model as given errs most" in (tmp_path / "report.html").read_text(
        encoding="utf-8"
    )


@pytest.mark.usefixtures("undrawn")
def test_rounds_are_told_apart_and_what_is_left_is_said_once(
    walk: tuple[Predictor, Comparison], tmp_path: Path
):
    again = dataclasses.replace(FRICTION, targets=("left_knee_pitch",), confusable_with=())
    steps = (
        StudyStep((), 4.2, 4.2, None),
        StudyStep((FRICTION,), 1.3, 1.2, None),
        StudyStep((again,), 1.2, 1.1, None),
    )
    last = dataclasses.replace(UNKNOWN, ranking=(again,))
    study = Study(steps, (made_diagnosis(), last), "no effect explains the rest", walk[0].scenario)
    reports.write_study_report(tmp_path / "report.html", study, walk, walk, INPUTS)
    text = page_text(tmp_path / "report.html")
    assert "<th>Round</th>" in text
    assert "<tr><td>left and right knee pitch</td><td>1</td>" in text
    assert "<tr><td>left knee pitch</td><td>2</td>" in text
    assert (
        "no effect of the library explains, in left knee pitch (follows position); what is named "
        "there may stand for part of it." in text
    )
    # It was added, so it is not lacking.
    assert "The model also lacks" not in text
    assert "fbse compare out/a_walk/completed.yaml" in text


@pytest.mark.usefixtures("undrawn")
def test_effects_without_a_place_on_the_robot_are_not_spoken_of(
    walk: tuple[Predictor, Comparison], tmp_path: Path
):
    """As feet on an arm."""
    feet = EffectStatus("not_visible", "gain", "1", {}, "Stand on one foot.")
    diagnosis = made_diagnosis(effects=STATUSES | {"FootForceGain": feet})
    reports.write_diagnosis_report(
        tmp_path / "report.html",
        diagnosis,
        walk[0],
        INPUTS,
        reports.Illustrated.of(diagnosis, walk[1], walk[0]),
    )
    text = page_text(tmp_path / "report.html")
    assert "4 effects: 1 present, 1 confusable, 1 absent, 1 not visible." in text
    assert "Foot force gain" not in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_search_that_ended_early_rules_nothing_out(
    walk: tuple[Predictor, Comparison], tmp_path: Path, interrupted: bool
):
    stopped = {"partial": "the time limit of 6 s was reached"} if interrupted else {}
    diagnosis = dataclasses.replace(UNKNOWN, **stopped)
    reports.write_diagnosis_report(
        tmp_path / "report.html",
        diagnosis,
        walk[0],
        INPUTS,
        reports.Illustrated.of(diagnosis, walk[1], walk[0]),
    )
    text = page_text(tmp_path / "report.html")
    for claim in ("no effect explains enough", "No effect of the library is seen", "of your own"):
        assert (claim in text) != interrupted
    assert ("with more time" in text) == interrupted


def test_effects_in_one_place_are_named_together():
    bias = dataclasses.replace(FRICTION, effect="TorqueBias")
    text = reports.diagnosis_outcome(made_diagnosis(ranking=(FRICTION, MASS, bias)))
    assert text.startswith(
        "The model lacks Coulomb friction and torque bias in left and right knee pitch and body "
        "mass in trunk;"
    )


def test_nothing_is_missing_only_where_noise_alone_is_left():
    loud = dataclasses.replace(NOTHING, held_out_before=2.31)
    said = diagnosis_outcome(loud)
    assert said.startswith("No effect of the library is seen, but the model leaves over 2.31 times")
    assert said.endswith("more may hide in it; 1 of 4 effects would not show in this log.")


@pytest.mark.parametrize(("joints", "misread"), [(1, False), (3, False), (4, True)])
def test_what_many_joints_leave_may_be_misread(joints: int, misread: bool):
    left = [Structure(f"joint_{k}", k, 3.0, "load", 0.5) for k in range(joints)]
    left += [Structure(f"base/force_{axis}", 12, 3.0, "load", 0.5) for axis in "xyz"]
    diagnosis = dataclasses.replace(UNKNOWN, unexplained=tuple(left))
    steps = steps_after_diagnosis(diagnosis, INPUTS)
    assert any("command_time" in step.text for step in steps) == misread


def test_next_commands_read_scenario_and_logs_as_they_were_read():
    changes = ("--set", "ground.slope=[0.04, 0]")
    inputs = dataclasses.replace(INPUTS, changes=changes, reading=("--map", "a b.yaml"))
    (command, *_) = (step.command for step in steps_after_diagnosis(made_diagnosis(), inputs))
    assert command.startswith("fbse add paper_walk --set 'ground.slope=[0.04, 0]' out/a_walk --out")
    diagnose = "fbse diagnose paper_walk --set 'ground.slope=[0.04, 0]' walk.npz --map 'a b.yaml'"
    assert inputs.diagnose == diagnose


def test_what_may_stand_for_something_else_is_not_simply_added():
    unknown = made_diagnosis("unknown_effect", (FRICTION,), unexplained=UNKNOWN.unexplained)
    for diagnosis, hedged in ((unknown, True), (made_diagnosis(), False)):
        (step, *_) = steps_after_diagnosis(diagnosis, INPUTS)
        assert step.text.startswith("Add it to the model")
        assert ("may stand for part of what is left" in step.text) == hedged


def test_where_a_log_cannot_tell_a_better_one_comes_before_what_it_suggests():
    suggests = dataclasses.replace(FRICTION, chosen=False, confusable_with=(), tentative=True)
    first, *_, last = steps_after_diagnosis(made_diagnosis("not_visible", (suggests,)), INPUTS)
    assert first.text == "Record torques as often as the control gives them."
    assert last.text == "If no better log can be had, add what is tentative to the model:"
    assert last.command.startswith("fbse add")


def test_absent_means_less_where_something_unknown_is_left():
    everywhere = verdicts_text(STATUSES)
    assert everywhere.endswith("Absent means that it would have been seen.")
    somewhere = verdicts_text(STATUSES, UNKNOWN.unexplained)
    assert somewhere.endswith(
        "in the row with something unknown, that what is left does not look like it."
    )


def test_what_is_left_where_most_was_explained_is_said():
    found = made_diagnosis(ranking=(FRICTION,))
    left = dataclasses.replace(found, unexplained=UNKNOWN.unexplained)
    assert "and more than noise" not in reports.diagnosis_outcome(found)
    assert "is small beside that, and more than noise (up to " in reports.diagnosis_outcome(left)


def test_laws_of_two_effects_are_named_by_these_where_one_of_them_is_found_too():
    left, right = ((knee,) for knee in KNEES)
    both = dataclasses.replace(FRICTION, effect="CoulombViscousFriction", targets=right)
    viscous = dataclasses.replace(FRICTION, effect="ViscousFriction", targets=left)
    coulomb = dataclasses.replace(FRICTION, targets=left)
    for found, text in (
        ((both, viscous, coulomb), "Coulomb friction and viscous friction in right and left knee"),
        ((both, MASS), "Coulomb viscous friction in right knee pitch and body mass in trunk"),
        ((both, coulomb), "Coulomb friction in right and left knee pitch and viscous friction in "),
    ):
        said = reports.diagnosis_outcome(made_diagnosis(ranking=found))
        assert said.startswith(f"The model lacks {text}")


def test_one_effect_in_several_places_is_one_row_of_the_table():
    """The most important rows are not crowded out by the joints of an arm."""

    def found(effect: str, target: str, after: float, *values: float) -> Finding:
        parameters = {
            f"p{k}": Estimate(value, (value - 0.1, value + 0.1), "Nm")
            for k, value in enumerate(values)
        }
        return Finding(effect, (target,), 9.0, after, parameters, (), True)

    joints = [f"joint_{k}" for k in range(6)]
    findings = [found("CoulombFriction", joint, 1.0 + k, 2.0 + k) for k, joint in enumerate(joints)]
    findings.append(found("TorqueBias", "joint_0", 3.0, 0.5))
    findings += [found("InertialParameters", f"link_{k}", 5.0, *range(k, 10 + k)) for k in range(3)]
    findings.append(dataclasses.replace(findings[0], chosen=False))
    friction, bias, inertia, rival = findings_table(findings).rows
    assert friction[:4] == ("Coulomb friction", "6 joints", "9.00", "1.00 to 6.00")
    assert friction[4].startswith("joint 0: p0 2 Nm (1.9 to 2.1); joint 1: p0 3 Nm")
    assert bias[:2] == ("Torque bias", "joint 0")
    assert bias[4] == "p0 0.5 Nm (0.4 to 0.6)"
    assert inertia[1] == "link 0, link 1, link 2"
    assert inertia[4].endswith("p9 9.00 to 11.0 Nm")
    assert rival[0] == "(Coulomb friction)"


def test_a_table_says_what_parameters_are_whose_names_do_not():
    humped = dataclasses.replace(FRICTION, effect="StribeckFriction")
    caption = findings_table([FRICTION, humped, humped]).caption
    assert caption.startswith("Stribeck friction: gamma1 is friction at the start of a motion")
    assert "; gamma4 is Coulomb friction; " in caption
    assert caption.count("gamma4") == 1
    assert findings_table([FRICTION, MASS]).caption == ""


def test_detectability_is_relative_to_what_is_plausible():
    (axes,) = figures.detectability(STATUSES).axes
    dots = {
        line.get_label(): line.get_xdata() for line in axes.get_lines() if line.get_marker() == "o"
    }
    # Biases of up to 20 Nm are plausible; what is beyond the picture is at its edge.
    np.testing.assert_allclose(dots["absent"], [0.02 / 20, 30.0])
    np.testing.assert_allclose(dots["not visible"], [30.0, 30.0])


def test_errors_over_time_show_supports_and_noise(walk: tuple[Predictor, Comparison]):
    predictor, comparison = walk
    channels = [
        channel
        for channel in comparison.channels
        if channel.row.name in ("left_knee_pitch", "left_sole/specific_force_z")
    ]
    knee, sole = figures.errors_over_time(predictor.residual, ["left", "right"], channels).axes
    assert {"left leg supports", "right leg supports", "error"} <= set(
        knee.get_legend_handles_labels()[1]
    )
    drawn = next(line for line in sole.get_lines() if line.get_label() == "error").get_ydata()
    known = predictor.residual.known[:, predictor.residual.row_index["left_sole/specific_force_z"]]
    # Not while the foot swings.
    assert 0 < known.sum() <= predictor.residual.standing[:, 0].sum() < len(known)
    np.testing.assert_array_equal(np.isfinite(drawn), known)


def test_an_effect_that_is_found_in_several_rounds_is_named_once(
    walk: tuple[Predictor, Comparison],
):
    again = dataclasses.replace(FRICTION, targets=("left_knee_pitch", "left_hip_yaw"))
    steps = (
        StudyStep((), 4.2, 4.2, None),
        StudyStep((FRICTION,), 1.3, 1.2, None),
        StudyStep((again,), 5.0, 1.0, None),
    )
    text = reports.study_outcome(
        Study(steps, (made_diagnosis(), made_diagnosis()), "", walk[0].scenario)
    )
    assert text.startswith(
        "The model lacked Coulomb friction in left knee pitch, right knee pitch, left hip yaw."
    )
    assert "the held-out error rises from 4.20 to 5.00 times" in text


def test_many_targets_are_called_what_they_are():
    bodies = [f"link_{k}" for k in range(5)]
    assert figures.targets_text(bodies, "BodyMass") == "5 bodies"
    assert figures.targets_text(bodies, "CoulombFriction") == "5 joints"


@pytest.mark.parametrize(
    ("targets", "text"),
    [
        (("left_knee_pitch",), "left knee pitch"),
        (KNEES, "left and right knee pitch"),
        (("left_knee_pitch", "left_hip_yaw"), "left knee pitch, left hip yaw"),
        (tuple(f"left_joint_{k}" for k in range(12)), "12 joints"),
        (("left", "right"), "left and right"),
        (("trunk",), "trunk"),
    ],
)
def test_targets_in_words(targets: tuple[str, ...], text: str):
    assert figures.targets_text(targets) == text


@pytest.mark.parametrize(
    ("others", "said"),
    [
        (["left_foot"], "body mass on left foot"),
        (["left_foot", "pelvis"], "body mass on left foot or body mass on pelvis"),
        (["left_foot", "right_foot", "pelvis"], "body mass on another body"),
    ],
)
def test_a_mass_that_may_be_on_other_bodies_says_so_and_what_would_tell(
    others: list[str], said: str
) -> None:
    rivals = tuple(f"BodyMass on {body}" for body in others)
    mass = dataclasses.replace(MASS, confusable_with=(*rivals, "TorqueBias"))
    moves = EffectStatus(
        "present", "mass", "kg", {"trunk": 0.1}, "Move all joints.", None, {"trunk": 10.0}
    )
    diagnosis = made_diagnosis(ranking=(mass,), effects=STATUSES | {"BodyMass": moves})
    outcome = diagnosis_outcome(diagnosis)
    assert f"this log cannot tell that from {said} or torque bias." in outcome
    steps = steps_after_diagnosis(diagnosis, INPUTS)
    asked = [step.text for step in steps if step.text.startswith("To tell them apart")]
    assert asked == [
        "To tell them apart: Hold each joint still. It shows torque bias.",
        "To tell them apart: Move all joints. It shows body mass.",
    ]
