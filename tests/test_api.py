"""The package's front door: what `import fbse_drake` offers."""

import ast
import importlib
import json
import pickle
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import fbse_drake as fd
from fbse_drake.files import from_json, to_json
from fbse_drake.progress import Interrupted
from fbse_drake.scenario import dump_scenario

FEW = [fd.CoulombFriction, fd.ViscousFriction, fd.TorqueBias]
KNEE = "left_knee_pitch"


def built(**changes) -> fd.Scenario:
    """Legs that swing in a gantry, said in Python."""
    robot = fd.RobotConfig(
        gantry_height=1.2,
        rotor_inertia={"all": 0.3},
        effects={"friction": fd.ViscousFriction(viscous={"all": 2.0})},
    )
    sines = fd.JointSines(
        posture={"hip_pitch": -0.4, "knee_pitch": 0.8, "ankle_pitch": -0.4},
        amplitude={"all": 0.1, "hip_pitch": 0.25, "knee_pitch": 0.35},
        frequency={"all": 0.6, KNEE: 0.8},
    )
    settings = {
        "duration": 4.0,
        "robot": robot,
        "model": robot,
        "reference": sines,
        "control": fd.PositionLoopConfig(kp={"all": 3000.0}, kd={"all": 10.0}),
        "sensors": fd.SensorsConfig(
            encoders=fd.EncoderConfig(resolution=1e-5, velocity_noise=1e-4)
        ),
    }
    return fd.Scenario(**settings | changes)


@pytest.fixture(scope="module")
def rubbing() -> tuple[fd.Scenario, fd.Log]:
    """A scenario whose robot has friction in one knee that its model lacks, and its log."""
    scenario = built()
    effects = scenario.robot.effects | {"hidden": fd.CoulombFriction(coulomb={KNEE: 3.0})}
    real = built(robot=fd.RobotConfig(**vars(scenario.robot) | {"effects": effects}))
    return scenario, fd.simulate(real).log


def test_every_public_name_is_what_its_stub_says():
    stub = ast.parse(Path(fd.__file__).with_suffix(".pyi").read_text())
    for statement in stub.body:
        for alias in statement.names if isinstance(statement, ast.ImportFrom) else ():
            place = f"{fd.__name__}.{statement.module}"
            module = importlib.import_module(place)
            expected = getattr(module, alias.name, None) or importlib.import_module(
                f"{place}.{alias.name}"
            )
            assert getattr(fd, alias.asname) is expected
            assert alias.asname in fd.__all__
            documented = expected.__doc__ or isinstance(expected, fd.SensorBeliefs)
            assert documented, alias.asname


def test_everything_of_the_libraries_has_a_public_name():
    for names in (fd.effects_by_name, fd.estimators_by_name, fd.compensations_by_name):
        for name, kind in names().items():
            if kind.__module__.startswith("fbse_drake."):
                assert getattr(fd, name) is kind


def test_nothing_heavy_is_imported_before_it_is_needed():
    program = (
        "import sys, fbse_drake, fbse_drake.cli; fbse_drake.cli._parser();"
        "print({'pydrake', 'numpy', 'matplotlib', 'pandas', 'scipy'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.stdout == "set()\n", run.stderr


def test_a_built_scenario_survives_pickling_and_yaml(tmp_path: Path):
    scenario = built(seed=3)
    again = pickle.loads(pickle.dumps(scenario))
    assert dump_scenario(again, "a") == dump_scenario(scenario, "a")
    (tmp_path / "a.yaml").write_text(dump_scenario(scenario, "a"))
    assert dump_scenario(fd.load_scenario(tmp_path / "a.yaml"), "a") == dump_scenario(again, "a")
    assert again.reference == scenario.reference
    assert again.robot == scenario.robot


def test_an_effect_of_ones_own_is_pickled_with_its_scenario(monkeypatch: pytest.MonkeyPatch):
    # In a library of its own: the diagnoses of other tests would find it.
    monkeypatch.setattr("fbse_drake.effects.effect._LIBRARY", fd.effects_by_name())
    fd.in_library(Sticky)
    own = built(robot=fd.RobotConfig(gantry_height=1.2, effects={"own": Sticky(grip={KNEE: 1.5})}))
    assert pickle.loads(pickle.dumps(own)).robot.effects["own"] == Sticky(grip={KNEE: 1.5})


@dataclass(frozen=True)
class Sticky(fd.JointTorqueEffect):
    """An effect that is written with public names alone."""

    description: ClassVar[str] = "Grips."
    signature: ClassVar[str] = "A torque against the motion."
    experiment: ClassVar[str] = "Move."
    parameters: ClassVar[dict[str, fd.Parameter]] = {
        "grip": fd.Parameter("Nm", linear=True, plausible=(0.0, 5.0))
    }

    grip: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(motion: fd.JointMotion, nonlinear: np.ndarray):  # noqa: ARG004
        sign = np.tanh(motion.velocity / 0.01)
        return [sign], [(1 - sign**2) / 0.01]


def test_compare_diagnose_add_agree_and_are_saved(rubbing, tmp_path: Path):
    scenario, log = rubbing
    found = fd.diagnose(scenario, log, FEW, name="legs")
    assert (found.verdict, [f.effect for f in found.chosen]) == (
        "effect_found",
        ["CoulombFriction"],
    )
    low, high = found.chosen[0].parameters["coulomb"].interval
    assert low < 3.0 < high
    # What was set aside is better for it.
    (rest,) = found.set_aside.values()
    assert rest.after.value < 0.2 * rest.before.value
    assert "on the rest of the log, which was set aside" in found.outcome.lower()
    assert "Coulomb friction" in found._repr_html_()

    completed = fd.add(scenario, found)
    assert [type(e) for e in completed.model.effects.values()] == [
        fd.ViscousFriction,
        fd.CoulombFriction,
    ]
    before, after = (fd.compare(one, log) for one in (scenario, completed))
    assert before.failures[0].row.name == KNEE
    assert after.rmse < 0.2 * before.rmse

    found.save(tmp_path / "found")
    names = ["diagnosis.json", "log.npz", "metrics.json", "report.html", "scenario.yaml"]
    assert sorted(path.name for path in (tmp_path / "found").iterdir()) == names
    content = json.loads((tmp_path / "found/diagnosis.json").read_text())
    assert content["verdict"] == "effect_found"
    assert content.items() >= from_json(to_json(found.json())).items()
    # The commands that the report proposes can be run.
    scenario_file = tmp_path / "found/scenario.yaml"
    assert f"fbse add {scenario_file}" in (tmp_path / "found/report.html").read_text()
    assert dump_scenario(fd.load_scenario(scenario_file), "legs") == dump_scenario(scenario, "legs")
    assert np.array_equal(
        fd.Log.load(tmp_path / "found/log.npz")["joint/position"], log["joint/position"]
    )


def test_pictures_that_are_drawn_beside_a_diagnosis_are_those_of_one_job(rubbing, tmp_path: Path):
    one, two = (fd.diagnose(*rubbing, FEW, jobs=jobs) for jobs in (1, 2))
    assert one.illustrated is None
    assert two.illustrated is not None
    texts = []
    for found in (one, two):
        found.report(tmp_path / "report.html")
        texts.append((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert texts[0] == texts[1]


def test_a_diagnosis_that_is_stopped_beside_other_work_is_a_valid_partial_one(
    rubbing, tmp_path: Path
):
    stops = ["time is up"]

    def progress(text: str, share: float = 0.0) -> None:  # noqa: ARG001
        if text.startswith("predicting") and stops:
            raise Interrupted(stops.pop())

    found = fd.diagnose(*rubbing, FEW, jobs=2, progress=progress)
    assert found.partial == "time is up"
    assert not found.chosen
    found.save(tmp_path)
    assert json.loads((tmp_path / "diagnosis.json").read_text())["partial"]
    assert "time is up" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_folder_that_cannot_be_made_is_refused(rubbing, tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(fd.InputError, match="file/inside: Not a directory"):
        fd.compare(*rubbing).save(tmp_path / "file/inside")


def test_a_wrong_unit_is_refused_before_anything_is_fitted(rubbing):
    scenario, log = rubbing
    in_degrees = fd.Log(
        log.channels | {"joint/position": np.rad2deg(log["joint/position"])}, log.meta
    )
    for function in (fd.compare, fd.diagnose, fd.study, fd.identify):
        with pytest.raises(fd.InputError, match="are these degrees"):
            function(scenario, in_degrees)


def test_an_exercise_is_revealed_with_its_score(tmp_path: Path):
    exercise = fd.hide(built(duration=1.0), 5, what="CoulombFriction", size="large")
    (effect,) = exercise.answer.effects
    found = fd.diagnose(exercise.scenario, exercise.log, FEW)
    revealed = exercise.reveal(found)
    assert revealed.score.found == {"CoulombFriction": True}
    assert "Hidden: Coulomb friction in" in revealed.outcome
    exercise.save(tmp_path)
    assert fd.reveal(tmp_path).answer == exercise.answer
    assert fd.reveal(tmp_path).score is None
    assert effect.effect == "CoulombFriction"


def test_logs_as_pandas_and_xarray(rubbing):
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    _, log = rubbing
    frame, data = log.to_pandas(), log.to_xarray()
    j = log.joints.index(KNEE)
    assert np.array_equal(frame[f"joint/velocity/{KNEE}"], log["joint/velocity"][:, j])
    assert frame.attrs["units"][f"joint/velocity/{KNEE}"] == "rad/s"
    assert np.array_equal(data["joint/velocity"].sel(joint=KNEE), log["joint/velocity"][:, j])
    assert data["joint/velocity"].attrs["units"] == "rad/s"
    # A sample with two axes, in the order in which it lies in memory.
    force = log["foot/left/pad_force"]
    assert np.array_equal(frame["foot/left/pad_force[4]"], force[:, 1, 1])
    assert data["foot/left/pad_force"].shape == force.shape
    assert np.array_equal(frame.index, data["time"])


def test_a_missing_extra_is_named(rubbing, monkeypatch: pytest.MonkeyPatch):
    for module, method in (("pandas", "to_pandas"), ("xarray", "to_xarray")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(fd.InputError, match=rf"needs {module}: pip install .*\[data\]"):
            getattr(rubbing[1], method)()


def test_a_recording_is_converted_and_written_again(rubbing, tmp_path: Path):
    _, log = rubbing
    log.save(tmp_path / "log.npz")
    again = fd.convert(tmp_path / "log.npz", tmp_path / "log.mcap")
    assert np.array_equal(again["joint/position"], log["joint/position"])
    bag = fd.convert([tmp_path / "log.mcap"])
    assert np.array_equal(bag["joint/position"], log["joint/position"])
    with pytest.raises(fd.InputError, match=r"expected a file name that ends in \.npz"):
        fd.convert(tmp_path / "log.npz", tmp_path / "log.txt")


def test_a_run_shows_and_saves_itself(tmp_path: Path):
    run = fd.simulate(built(duration=0.2), name="legs")
    assert run.outcome == "The run finished after 0.200 s."
    assert run.metrics["fell"] is False
    assert "Joint tracking error" in run._repr_html_()
    run.save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "log.npz",
        "metrics.json",
        "report.html",
        "scenario.yaml",
    ]


def test_what_is_of_another_type_is_refused_in_a_line() -> None:
    """A name or a file in the place of what it stands for."""
    scenario = fd.load_scenario("bsc_arm", overrides=["duration=0.3"])
    log = fd.simulate(scenario).log
    for call, text in (
        (lambda: fd.simulate("squat"), "scenario: expected a Scenario (as load_scenario gives), "),
        (
            lambda: fd.compare(scenario, "log.npz"),
            "log: expected a Log (as Log.load or convert gives)",
        ),
        (lambda: fd.diagnose(log, scenario), "scenario: expected a Scenario"),
        (lambda: fd.diagnose(scenario, [log, log]), "log: expected a Log"),
        (lambda: fd.estimate(scenario, "log.npz"), "log: expected a Log"),
        (lambda: fd.diagnose(scenario, log, ["TorqueBias"]), "found 'TorqueBias'"),
        (lambda: fd.diagnose(scenario, log, fd.TorqueBias), "found a single one"),
        (lambda: fd.add(scenario, log.channels), "found: expected a Finding"),
        (lambda: fd.hide("squat", 1), "scenario: expected a Scenario"),
    ):
        with pytest.raises(fd.InputError, match=re.escape(text)):
            call()
