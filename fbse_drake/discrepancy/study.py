"""The whole loop: diagnose, add, and again, until nothing is left."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fbse_drake.discrepancy.add import add
from fbse_drake.discrepancy.diagnose import Diagnosis, Finding, diagnose, diagnosis_json
from fbse_drake.discrepancy.prediction import Predictor
from fbse_drake.discrepancy.rollout import RolloutError, rollout
from fbse_drake.effects.effect import Effect
from fbse_drake.log import Log
from fbse_drake.scenario import Scenario

# Share by which a later round must lower the held-out error: the first one finds what there is, the others mend what is not linear.
_LEAST_GAIN = 0.01
# The loop ends after this many rounds; a robot lacks two or three effects at a time, not ten.
_MOST_ROUNDS = 4


@dataclass(frozen=True)
class StudyStep:
    """The model after an addition. Errors of the residual are root mean squares in multiples of the sensors' noise."""

    added: tuple[Finding, ...]
    held_out_rmse: float
    train_rmse: float
    # Of the model with all that was added so far; None where it was not asked for.
    rollout: RolloutError | None


@dataclass(frozen=True)
class Study:
    """What was added to a model, and what it brought. The first step adds nothing."""

    steps: tuple[StudyStep, ...]
    # One for each round; the last one found nothing more that is worth adding.
    diagnoses: tuple[Diagnosis, ...]
    stopped_because: str
    # With the effects in its model.
    scenario: Scenario

    @property
    def found(self) -> list[Finding]:
        """Everything that was added."""
        return [finding for step in self.steps for finding in step.added]


def study(
    scenario: Scenario,
    log: Log,
    effects: Iterable[type[Effect]] | None = None,
    *,
    rollouts: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Study:
    """Diagnoses a log and adds what is found to the model until nothing more is found.

    Args:
        effects: what is tried; by default the library.
        rollouts: also simulates the model after every round.
        progress: called with a word on what is being done.

    Raises:
        InputError: a log that does not fit the scenario.
    """
    say = progress or (lambda _: None)
    steps: list[StudyStep] = []
    diagnoses: list[Diagnosis] = []

    def rolled() -> RolloutError | None:
        say("simulating the model against the log")
        return rollout(scenario, log) if rollouts else None

    effects = None if effects is None else list(effects)
    while len(diagnoses) < _MOST_ROUNDS:
        say(f"round {len(diagnoses) + 1}")
        diagnosis = diagnose(Predictor(scenario, log), effects, progress=progress)
        diagnoses.append(diagnosis)
        if not steps:
            steps.append(StudyStep((), diagnosis.held_out_before, diagnosis.held_out_before, rolled()))
        worthwhile = diagnosis.held_out_after < (1.0 if len(diagnoses) == 1 else 1.0 - _LEAST_GAIN) * diagnosis.held_out_before
        if not diagnosis.chosen or not worthwhile:
            break
        scenario = add(scenario, diagnosis.chosen)
        steps.append(StudyStep(tuple(diagnosis.chosen), diagnosis.held_out_after, diagnosis.train_after, rolled()))
    return Study(tuple(steps), tuple(diagnoses), _reason(diagnoses), scenario)


def _reason(diagnoses: list[Diagnosis]) -> str:
    last = diagnoses[-1]
    if last.chosen and len(diagnoses) == _MOST_ROUNDS:
        return f"{len(diagnoses)} rounds were made and each found something: the library does not fit this robot well"
    if last.verdict == "unknown_effect":
        rows = ", ".join(structure.row for structure in last.unexplained)
        return f"no effect of the library explains what is left in {rows}"
    if last.verdict == "not_visible":
        return "this data does not excite what could still be missing"
    left = f"what is left is {last.held_out_before:.2f} times the sensors' noise"
    return f"the noise floor is reached: {left} and no effect explains a worthwhile part of it"


def study_json(result: Study) -> dict[str, Any]:
    """Contents of study.json."""
    return {
        "steps": [
            {
                "added": [{"effect": f.effect, "joints": list(f.targets)} for f in step.added],
                "held_out_rmse": step.held_out_rmse,
                "train_rmse": step.train_rmse,
                "rollout_rmse": _rollout_json(step.rollout),
            }
            for step in result.steps
        ],
        "noise_floor": 1.0,
        "unit": "multiples of the sensors' noise",
        "stopped_because": result.stopped_because,
        "verdict": result.diagnoses[0].verdict,
        "diagnoses": [diagnosis_json(diagnosis) for diagnosis in result.diagnoses],
    }


def _rollout_json(error: RolloutError | None) -> dict[str, float]:
    if error is None:
        return {"joint_position": np.nan, "joint_torque_command": np.nan, "time": np.nan}
    return {"joint_position": error.mean_position, "joint_torque_command": error.mean_torque_command, "time": error.time}
