"""Replays of a log beside the models that were simulated in its place."""

import numpy as np
import pytest

from fbse_drake import Log, load_scenario
from fbse_drake.discrepancy.diagnosis.study import Study, StudyStep
from fbse_drake.discrepancy.residual.rollout import RolloutError
from fbse_drake.report.replay import study_motions

TIME = 0.01 * np.arange(50)
JOINTS = np.sin(np.outer(TIME, [1.0, 2.0]))
UPRIGHT = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))


def step(error: np.ndarray, base: np.ndarray | None = None) -> StudyStep:
    """A step whose model was simulated until its error ends."""
    orientation = None if base is None else UPRIGHT[: len(error)]
    rollout = RolloutError(
        {}, {}, {}, 0.5, None, {}, {}, TIME[: len(error)], error, orientation, base
    )
    return StudyStep((), 1.0, 1.0, rollout)


def study(*steps: StudyStep) -> Study:
    return Study(steps, (), "nothing more was found", load_scenario("bsc_arm"))


def log(**further: np.ndarray) -> Log:
    channels = {"time": TIME, "joint/position": JOINTS}
    channels |= {f"estimate/base/{name}": values for name, values in further.items()}
    return Log(channels, {"joints": ["a", "b"], "sides": [], "period": 0.01, "source": "made"})


def test_motions_are_the_logs_and_what_was_simulated_of_it() -> None:
    error = 0.1 * np.cos(JOINTS)
    motions = study_motions(study(step(error[:30]), step(0.5 * error)), log())
    assert list(motions) == ["log", "model as given", "completed model"]
    for name, share, rows in (
        ("log", 0, 50),
        ("model as given", 1, 30),
        ("completed model", 0.5, 50),
    ):
        joints = motions[name].joint_position
        np.testing.assert_allclose(joints, (JOINTS + share * error)[:rows], atol=1e-15)
    # A model that fell stays where it ended, and nothing moves before it starts.
    ended, pose = motions["model as given"].at(0.45)
    np.testing.assert_array_equal(ended, motions["model as given"].joint_position[29])
    assert pose is None
    np.testing.assert_array_equal(motions["log"].at(-1.0)[0], JOINTS[0])
    np.testing.assert_array_equal(motions["log"].at(0.07)[0], JOINTS[7])


def test_a_base_is_where_the_log_says_or_else_where_it_was_simulated() -> None:
    error, place = np.zeros((50, 2)), np.outer(TIME, [1.0, 0.0, 0.0])
    simulated = study(step(error, 2 * place), step(error, 3 * place))
    told = study_motions(simulated, log(orientation=2 * UPRIGHT, position=place))
    for name, times in (("log", 1), ("model as given", 2), ("completed model", 3)):
        pose = told[name].at(0.3)[1]
        assert pose is not None
        assert pose.translation() == pytest.approx([0.3 * times, 0.0, 0.0])
    untold = study_motions(simulated, log())["log"].at(0.3)[1]
    assert untold is not None
    assert untold.translation() == pytest.approx([0.9, 0.0, 0.0])


def test_without_simulated_models_there_is_nothing_to_show() -> None:
    assert study_motions(study(StudyStep((), 1.0, 1.0, None)), log()) == {}
