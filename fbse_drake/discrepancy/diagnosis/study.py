"""The whole loop: diagnose, add, and again, until nothing is left."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fbse_drake.discrepancy.diagnosis.add import add
from fbse_drake.discrepancy.diagnosis.compare import words
from fbse_drake.discrepancy.diagnosis.confirmation import diagnose_confirmed
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, Finding, diagnosis_json
from fbse_drake.discrepancy.diagnosis.identify import identify
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.reading import Reading
from fbse_drake.discrepancy.diagnosis.validation import (
    ModelError,
    Validation,
    model_error,
    validated,
    validation_json,
)
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.rollout import Rollout, RolloutError, Rollouts
from fbse_drake.effects.effect import Effect
from fbse_drake.log import Log
from fbse_drake.processes import Processes
from fbse_drake.progress import Interrupted, Progress, silent
from fbse_drake.scenario import Scenario
from fbse_drake.walking.reference import Recorded

# Share by which a later round must lower the held-out error: the first one finds what there is, the
# others mend what is not linear.
_LEAST_GAIN = 0.01
# The same where no more than the sensors' noise was left: what is found there is mostly noise,
# unless more noise is believed than there is.
_LEAST_GAIN_IN_NOISE = 0.1
# Less of a log than this many blocks is not set aside.
_SHORTEST_REST = 40
# The log that is diagnosed, among those that models are simulated against.
_TRAIN = "train"
# The loop ends after this many rounds; a robot lacks two or three effects at a time, not ten.
_MOST_ROUNDS = 4


def train_and_rest(scenario: Scenario, log: Log) -> tuple[Log, Log | None]:
    """The share of a log that models are fitted to, and the rest; see
    `RecordingConfig.train_share`.

    The rest is None, and all of the log is fitted, where it would be too short to be read.
    """
    recording, start, end = scenario.recording, log.time[0], log.time[-1]
    if (1.0 - recording.train_share) * (end - start) < _SHORTEST_REST * recording.block:
        return log, None
    split = start + recording.train_share * (end - start)
    place = int(np.searchsorted(log.time, split, side="right"))
    return log.part(slice(0, place)), log.part(slice(place, None))


@dataclass(frozen=True)
class StudyStep:
    """The model after an addition. Errors of the residual are root mean squares in multiples of the
    sensors' noise."""

    added: tuple[Finding, ...]
    held_out_rmse: float
    train_rmse: float
    # Of the model with all that was added so far; None where it was not asked for.
    rollout: RolloutError | None
    # By log: `train` is the one that is diagnosed, the others are not fitted to.
    errors: dict[str, ModelError] = field(default_factory=dict)
    # Of those others, where they say what the robot was asked for.
    test_rollouts: dict[str, RolloutError] = field(default_factory=dict)

    @property
    def rollouts(self) -> dict[str, RolloutError]:
        """All simulations of the model against a log, by log."""
        return ({} if self.rollout is None else {"train": self.rollout}) | self.test_rollouts


@dataclass(frozen=True)
class Study:
    """What was added to a model, and what it brought. The first step adds nothing."""

    steps: tuple[StudyStep, ...]
    # One for each round; the last one found nothing more that is worth adding.
    diagnoses: tuple[Diagnosis, ...]
    stopped_because: str
    # With the effects in its model.
    scenario: Scenario
    # Was it interrupted? Then `stopped_because` says why.
    partial: bool = False
    # By log that was set aside: is the completed model better there? Empty if nothing was added.
    set_aside: Mapping[str, Validation] = field(default_factory=dict)

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
    tests: Mapping[str, Log] | None = None,
    progress: Progress = silent,
    jobs: int = 1,
    reading: Reading | None = None,
) -> Study:
    """Diagnoses a log and adds what is found to the model until nothing more is found.

    Args:
        effects: what is tried; by default the library.
        rollouts: also simulates the model after every round.
        tests: logs on which the models are tested, by name; nothing is fitted to them.
        progress: is told what is being done. If it interrupts the work, the study is partial.
        jobs: how many simulations run side by side.
        reading: of the log, if it was read already.

    Raises:
        InputError: a log that does not fit the scenario.
    """
    with Processes(jobs) as processes:
        return _study(scenario, log, effects, rollouts, tests or {}, progress, processes, reading)


def _study(
    scenario: Scenario,
    log: Log,
    effects: Iterable[type[Effect]] | None,
    rollouts: bool,
    tests: Mapping[str, Log],
    progress: Progress,
    processes: Processes,
    reading: Reading | None,
) -> Study:
    steps: list[StudyStep] = []
    diagnoses: list[Diagnosis] = []
    # Of the tests, by every model.
    tested: list[dict[str, Predictor]] = []
    interrupted: str | None = None

    simulated = _Simulated(scenario, log, tests, processes) if rollouts else None
    diagnosing = processes.beside(progress)

    def step(added: Sequence[Finding], held_out_rmse: float, train_rmse: float) -> None:
        others = {name: other.of(scenario) for name, other in given.items()}
        tested.append(others)
        errors = {name: model_error(one) for name, one in ({"train": predictor} | others).items()}
        steps.append(StudyStep(tuple(added), held_out_rmse, train_rmse, None, errors))

    effects = None if effects is None else list(effects)
    given = {name: Predictor(scenario, other) for name, other in tests.items()}
    predictor = Predictor(scenario, log, reading=reading)
    if simulated is not None:
        simulated.begin(scenario)
    while len(diagnoses) < _MOST_ROUNDS and interrupted is None:
        diagnosis = diagnose_confirmed(
            predictor,
            effects,
            {name: other.of(scenario) for name, other in given.items()},
            progress=diagnosing,
        )
        diagnoses.append(diagnosis)
        interrupted = diagnosis.partial
        if not steps:
            step((), diagnosis.held_out_before, diagnosis.held_out_before)
        least_gain = _LEAST_GAIN if diagnosis.held_out_before > 1.0 else _LEAST_GAIN_IN_NOISE
        worthwhile = (
            diagnosis.held_out_after
            < (1.0 - least_gain * (len(diagnoses) > 1)) * diagnosis.held_out_before
        )
        if not diagnosis.completing or not worthwhile:
            break
        found = diagnosis.completing
        completed = add(scenario, found)
        errors = diagnosis.held_out_after, diagnosis.train_after
        believed = predictor.of(completed)
        if len(diagnoses) == 1 and scenario.identify.inertia and interrupted is None:
            try:
                plain = identify(scenario, log, progress=diagnosing)
            except Interrupted as stop:
                interrupted = str(stop)
            else:
                rival = predictor.of(plain.scenario)
                if is_better(rival, believed):
                    found, completed, believed = list(plain.findings), plain.scenario, rival
                    errors = plain.held_out_rmse, plain.train_rmse
        # What a search promises, with laws made linear, a model need not keep.
        if len(diagnoses) > 1 and not is_better(believed, predictor):
            break
        scenario, predictor = completed, believed
        step(found, *errors)
        if simulated is not None and interrupted is None:
            simulated.begin(scenario)
    if simulated is not None and interrupted is None:
        try:
            for k, found_by_step in enumerate(simulated.results(progress)):
                steps[k] = replace(steps[k], **found_by_step)
        except Interrupted as stop:
            interrupted = str(stop)
    because = _reason(diagnoses) if interrupted is None else interrupted
    set_aside = {}
    if len(steps) > 1:
        set_aside = {name: validated(tested[0][name], one) for name, one in tested[-1].items()}
    return Study(
        tuple(steps), tuple(diagnoses), because, scenario, interrupted is not None, set_aside
    )


class _Simulated:
    """Models that are simulated against a log, and against tests that say what the robot was asked
    for, while it is diagnosed what the next one lacks."""

    def __init__(
        self, scenario: Scenario, log: Log, tests: Mapping[str, Log], processes: Processes
    ):
        played = tests if isinstance(scenario.reference, Recorded) else {}
        self._rollouts = {
            name: Rollouts(one, scenario.believed, processes)
            for name, one in {_TRAIN: log, **played}.items()
        }
        self._begun: list[dict[str, Rollout | None]] = []

    def begin(self, scenario: Scenario) -> None:
        """Begins to simulate the model of a step."""
        self._begun.append({name: of.begin(scenario) for name, of in self._rollouts.items()})

    def results(self, progress: Progress) -> Iterator[dict[str, Any]]:
        """`rollout` and `test_rollouts` of each step, when they are there.

        Raises:
            Interrupted: see `Progress`.
        """
        first = None
        for begun in self._begun:
            errors = {
                name: one.result(progress, first if name == _TRAIN else None)
                for name, one in begun.items()
                if one is not None
            }
            train = errors.pop(_TRAIN, None)
            first = first or train
            yield {"rollout": train, "test_rollouts": errors}


def is_better(model: Predictor, other: Predictor) -> bool:
    """Does a model leave less of a log than another, every row measured by how much it has
    improved?

    By the likelihood of both with the noise of the other, so that a row with a large error does not
    decide alone.
    """
    white = WhitenedResidual(other.residual)
    left = [white.whiten(row, values) for row, values in enumerate(model.residual.value.T)]
    return white.deviance((np.array(left) ** 2).sum(axis=1)) < white.deviance(white.sse)


def _reason(diagnoses: list[Diagnosis]) -> str:
    last = diagnoses[-1]
    if last.completing and len(diagnoses) == _MOST_ROUNDS and last.held_out_before > 1.0:
        return (
            f"{len(diagnoses)} rounds were made and each found something: the library "
            "does not fit this robot well"
        )
    if last.verdict == "unknown_effect":
        rows = ", ".join(words(structure.row) for structure in last.unexplained)
        return f"no effect of the library explains what is left in {rows}"
    if last.verdict == "not_visible" and last.untested:
        return "this data is too short to tell what is left from noise"
    if last.verdict == "not_visible" and last.noisy:
        rows = ", ".join(map(words, last.noisy))
        return f"what is left in {rows} is more than the sensors' noise and follows nothing"
    if last.verdict == "not_visible" and last.held_out_before > 1.0:
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
                "rollouts": {
                    name: {
                        "mean_absolute_position": error.mean_absolute_position,
                        "relative_position": error.relative_position,
                        "failure": error.failure,
                    }
                    for name, error in step.rollouts.items()
                },
                "errors": {
                    name: {
                        "relative": error.relative,
                        "relative_by_joint": error.relative_by_joint,
                        "rms": error.rms,
                    }
                    for name, error in step.errors.items()
                },
            }
            for step in result.steps
        ],
        "noise_floor": 1.0,
        "unit": "multiples of the sensors' noise",
        "partial": result.partial,
        "stopped_because": result.stopped_because,
        "set_aside": {name: validation_json(one) for name, one in result.set_aside.items()},
        "verdict": result.diagnoses[0].verdict,
        "diagnoses": [diagnosis_json(diagnosis) for diagnosis in result.diagnoses],
    }


def _rollout_json(error: RolloutError | None) -> dict[str, float]:
    if error is None:
        return {"joint_position": np.nan, "joint_torque_command": np.nan, "time": np.nan}
    return {
        "joint_position": error.mean_position,
        "joint_torque_command": error.mean_torque_command,
        "time": error.time,
    }
