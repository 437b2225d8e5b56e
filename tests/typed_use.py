"""The public names as a type checker sees them; checked by `make lint`, never run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from typing_extensions import assert_type

import fbse_drake as fd


def use(folder: Path) -> None:
    scenario = fd.load_scenario("paper_walk", overrides=["duration=2"])
    assert_type(scenario, fd.Scenario)
    assert_type(scenario.robot.effects, dict[str, fd.Effect])
    run = fd.simulate(scenario, name="walk")
    assert_type(run, fd.SimulationResult)
    assert_type(run.failure, str | None)
    log = run.log
    assert_type(log, fd.Log)
    assert_type(log["joint/position"], np.ndarray)
    assert_type(fd.estimate(scenario, log), fd.EstimationResult)

    comparison = fd.compare(scenario, log)
    assert_type(comparison, fd.ComparisonResult)
    assert_type(comparison.failures, tuple[fd.Failure, ...])
    diagnosis = fd.diagnose(scenario, log, [fd.CoulombFriction], tests={"other": log})
    assert_type(diagnosis, fd.DiagnosisResult)
    assert_type(diagnosis.chosen, list[fd.Finding])
    assert_type(diagnosis.chosen[0].parameters["coulomb"], fd.Estimate)
    assert_type(diagnosis.effects["CoulombFriction"], fd.EffectStatus)
    assert_type(fd.add(scenario, diagnosis), fd.Scenario)
    study = fd.study(scenario, log, progress=fd.ProgressLines(print, limit=60.0))
    assert_type(study, fd.StudyResult)
    assert_type(study.scenario, fd.Scenario)
    assert_type(study.set_aside, Mapping[str, fd.Validation])
    assert_type(fd.identify(scenario, log), fd.IdentificationResult)
    for result in (run, comparison, diagnosis, study):
        result.save(folder)
        result.report(folder / "report.html")
        assert_type(result.outcome, str)

    exercise = fd.hide(scenario, 3, what="library", size="large")
    assert_type(exercise, fd.Exercise)
    assert_type(exercise.reveal(diagnosis), fd.Revealed)
    assert_type(fd.reveal(folder), fd.Revealed)
    assert_type(fd.convert("recording.mcap", log_map="map.yaml"), fd.Log)
    assert_type(fd.estimators_by_name(), dict[str, type[fd.Estimator]])
    assert_type(fd.build_station(scenario), fd.Station)
    assert_type(fd.__version__, str)


def built() -> fd.Scenario:
    robot = fd.RobotConfig(effects={"friction": fd.CoulombFriction(coulomb={"all": 1.0})})
    return fd.Scenario(
        duration=1.0,
        robot=robot,
        reference=fd.Squat(amplitude=0.02),
        sensors=fd.SensorsConfig(imu=fd.ImuConfig(acceleration_noise=0.02)),
        estimator=fd.Fbse(),
        compensation=fd.FeedforwardCompensation(),
    )


@fd.in_library
@dataclass(frozen=True)
class HoseDrag(fd.JointTorqueEffect):
    """An effect of a user's own."""

    description: ClassVar[str] = "A hose that rubs."
    signature: ClassVar[str] = "Torque against the motion."
    experiment: ClassVar[str] = "Move each joint."
    parameters: ClassVar[dict[str, fd.Parameter]] = {
        "drag": fd.Parameter("Nm", linear=True, plausible=(0.0, 50.0))
    }

    drag: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(
        motion: fd.JointMotion,
        nonlinear: np.ndarray,  # noqa: ARG004
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        sign = np.tanh(motion.velocity / 0.01)
        return [sign], [(1.0 - sign**2) / 0.01]


assert_type(fd.effects_by_name()["HoseDrag"], type[fd.Effect])
