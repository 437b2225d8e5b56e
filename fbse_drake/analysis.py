"""What a model lacks, of a scenario and a log: the functions behind the commands of their names.

    result = diagnose(scenario, log)
    result.verdict, result.chosen      # what was found
    result                             # in a notebook: the verdict and what speaks for it
    result.save("out/diagnosis")       # what `fbse diagnose` writes
    completed = add(scenario, result)  # a scenario whose model has it

Recordings are inspected before anything is fitted to them (`result.hygiene`), and joints whose
torque cannot be trusted are left out. Models are fitted to the first share of a log
(`RecordingConfig.train_share`), and tested on the rest and on further logs, `tests`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, TypeAlias, TypeVar

from matplotlib.figure import Figure

from fbse_drake.discrepancy.diagnosis import add as addition
from fbse_drake.discrepancy.diagnosis import compare as comparing
from fbse_drake.discrepancy.diagnosis import diagnose as diagnosing
from fbse_drake.discrepancy.diagnosis import identify as identifying
from fbse_drake.discrepancy.diagnosis import study as studying
from fbse_drake.discrepancy.diagnosis.bandwidth import averaged_to_bandwidth
from fbse_drake.discrepancy.diagnosis.compare import Comparison
from fbse_drake.discrepancy.diagnosis.confirmation import diagnose_confirmed
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, Finding, plausible_effects
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.experiment import Experiments
from fbse_drake.discrepancy.diagnosis.identify import Identification
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.reading import Reading
from fbse_drake.discrepancy.diagnosis.study import Study, train_and_rest
from fbse_drake.discrepancy.diagnosis.validation import validated
from fbse_drake.discrepancy.exercises import hidden
from fbse_drake.discrepancy.exercises.hidden import Exercise, Revealed
from fbse_drake.discrepancy.exercises.sizes import Size
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene, hygiene_json, inspect
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.discrepancy.residual.evidence import Evidence
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.effects.effect import Effect
from fbse_drake.errors import InputError, require_type
from fbse_drake.files import origin, write_json, write_text
from fbse_drake.interop.convert import read_logs
from fbse_drake.interop.export import writer_for
from fbse_drake.interop.models import write_mjcf, write_urdf
from fbse_drake.log import Log, joined, require_log
from fbse_drake.processes import Processes
from fbse_drake.progress import Progress, silent
from fbse_drake.report import discrepancy_figures as figures
from fbse_drake.report.discrepancy import (
    Illustrated,
    how_it_falls,
    what_was_looked_for,
    where_it_fails,
    why_it_fails,
    write_compare_report,
    write_diagnosis_report,
    write_study_report,
)
from fbse_drake.report.discrepancy_tables import (
    failures_table,
    findings_table,
    spread_tables,
    steps_table,
)
from fbse_drake.report.html import Section, Table, drawn
from fbse_drake.report.identification import (
    errors_table,
    identification_outcome,
    write_identification_report,
)
from fbse_drake.report.replay import study_motions, write_replay
from fbse_drake.report.sentences import Inputs, compare_outcome, diagnosis_outcome, study_outcome
from fbse_drake.results import Result, made_folder
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import Scenario, dump_scenario, require_scenario

# A log, or several by name, which are fitted together.
Recordings: TypeAlias = Log | Mapping[str, Log]


@dataclass(frozen=True)
class Case:
    """A scenario's model over a log."""

    name: str
    scenario: Scenario
    # As it was given; the part of it that models are fitted to; and logs that they are not fitted
    # to, by name, the rest of the first among them.
    log: Log
    train: Log
    tests: dict[str, Log] = field(default_factory=dict)
    # Which of the tests are rests; and, if several were given that `log` and `train` are of, each.
    rests: tuple[str, ...] = ()
    recordings: dict[str, Log] = field(default_factory=dict)
    # Of the part that models are fitted to, where another case has read it.
    reading: Reading | None = None

    @cached_property
    def predictor(self) -> Predictor:
        """The model over the part that models are fitted to.

        Raises:
            InputError: a log that does not fit the model, or whose sensors cannot be what they are
                said to be.
        """
        return self._checked[0]

    @cached_property
    def _checked(self) -> tuple[Predictor, Evidence]:
        predictor = Predictor(self.scenario, self.train, reading=self.reading)
        evidence = Evidence(predictor.motion)
        check_sensors(predictor.motion, evidence)
        return predictor, evidence

    @cached_property
    def hygiene(self) -> Hygiene:
        predictor, evidence = self._checked
        return inspect(predictor.motion, predictor.noise, evidence)

    @cached_property
    def comparison(self) -> Comparison:
        return comparing.compare(self.predictor)

    @cached_property
    def trusted(self) -> Scenario:
        """The scenario with nothing fitted to joints whose torque is not to be trusted."""
        return self.hygiene.trusted(self.scenario, self.predictor.robot)

    @classmethod
    def divided(
        cls, scenario: Scenario, log: Recordings, tests: Mapping[str, Log] | None, name: str
    ) -> "Case":
        """With the rest of each log set aside."""
        require_scenario(scenario)
        given: dict[str, Log] = {"the log": log} if isinstance(log, Log) else _recordings(log)
        if not given:
            raise InputError("no log is given")
        parts = {one: train_and_rest(scenario, of) for one, of in given.items()}
        rests = {f"rest of {one}": rest for one, (_, rest) in parts.items() if rest is not None}
        return cls(
            name,
            scenario,
            joined(given),
            joined({one: train for one, (train, _) in parts.items()}),
            rests | dict(tests or {}),
            tuple(rests),
            given if len(given) > 1 else {},
        )


class AnalysisResult(Result):
    """Base of what was found out of a scenario and a log."""

    case: Case
    # What its JSON file is called.
    file: ClassVar[str]

    @property
    def hygiene(self) -> Hygiene:
        """What is remarkable about the log."""
        return self.case.hygiene

    @property
    def residual(self) -> Residual:
        """What the model as given leaves over of the part of the log that it is fitted to."""
        return self.case.predictor.residual

    @property
    def robot(self) -> Robot:
        """The model's plant."""
        return self.case.predictor.robot

    def further_tables(self) -> list[Table]:
        """What is shown beside its table."""
        return []

    def json(self) -> dict[str, Any]:
        """Contents of its JSON file, see the contracts."""
        return self._json() | {"hygiene": hygiene_json(self.hygiene)}

    def report(self, path: str | Path) -> None:
        self._report(Path(path), self._inputs_in(Path(path).parent))

    def save(self, folder: str | Path, inputs: Inputs | None = None) -> None:
        """Writes the JSON file (also as metrics.json), scenario.yaml, the completed scenario where
        there is one with its model as URDF and MJCF (completed.xml), and report.html.

        Args:
            inputs: where scenario and logs lie, for the commands that the report proposes; by
                default the logs are written to the folder as well.

        Raises:
            InputError: the folder cannot be made.
            OSError: a file cannot be written; none is half-written.
        """
        out = made_folder(folder)
        if inputs is None:
            inputs = self._inputs_in(out)
            logs = self.case.recordings.values() or [self.case.log]
            for path, log in zip(inputs.logs, logs, strict=True):
                log.save(path)
            for path, (_, log) in zip(inputs.tests, self._further_tests, strict=True):
                log.save(path)
        write_text(out / "scenario.yaml", dump_scenario(self.case.scenario, self.case.name))
        made_of = origin([*map(Path, inputs.logs)], out / "scenario.yaml")
        content = made_of | self.json()
        write_json(out / f"{self.file}.json", content)
        write_json(out / "metrics.json", content)
        if (completed := self._completed) is not None:
            write_text(out / "completed.yaml", dump_scenario(completed, self.case.name))
            write_urdf(completed.believed, out / "completed.urdf")
            write_mjcf(completed.believed, out / "completed.xml")
        self._report(out / "report.html", replace(inputs, hygiene=self.hygiene))

    def _inputs_in(self, folder: Path) -> Inputs:
        tests = tuple(str(folder / f"{name}.npz") for name, _ in self._further_tests)
        logs = tuple(str(folder / f"{name}.npz") for name in self.case.recordings or ["log"])
        scenario = str(folder / "scenario.yaml")
        return Inputs(
            self.case.name, scenario, logs, str(folder), tests=tests, hygiene=self.hygiene
        )

    @property
    def _further_tests(self) -> list[tuple[str, Log]]:
        tests = self.case.tests.items()
        return [(name, log) for name, log in tests if name not in self.case.rests]

    @property
    def _completed(self) -> Scenario | None:
        """The scenario with what was found, if that is written beside."""
        return None

    def _json(self) -> dict[str, Any]:
        raise NotImplementedError

    def _report(self, path: Path, inputs: Inputs) -> None:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class ComparisonResult(Comparison, AnalysisResult):
    """Where a model fails on a log, see `Comparison`."""

    case: Case = field(kw_only=True, repr=False)
    file: ClassVar[str] = "compare"

    @property
    def outcome(self) -> str:
        return self.hygiene.before(compare_outcome(self))

    def table(self) -> Table:
        return failures_table(self)

    def picture(self) -> Figure:
        """The errors on the robot, in its mean posture, and by phase."""
        posture = self.case.predictor.motion.blocks.joint_position.mean(axis=0)
        return figures.robot_errors(self.robot, self, posture)

    def _json(self) -> dict[str, Any]:
        return comparing.comparison_json(self)

    def _report(self, path: Path, inputs: Inputs) -> None:
        write_compare_report(path, self, self.case.predictor, inputs)


@dataclass(frozen=True, eq=False)
class DiagnosisResult(Diagnosis, AnalysisResult):
    """Which effects a model lacks, see `Diagnosis`."""

    case: Case = field(kw_only=True, repr=False)
    # Of its report, if that was drawn beside the diagnosis; else it is drawn when it is shown.
    illustrated: Illustrated | None = field(default=None, kw_only=True, repr=False)
    file: ClassVar[str] = "diagnosis"

    @property
    def outcome(self) -> str:
        return self.hygiene.before(diagnosis_outcome(self))

    def table(self) -> Table:
        return findings_table(self.ranking)

    def picture(self) -> Figure:
        """What was chosen and its rivals, by the error that they leave."""
        return figures.ranking(self.ranking)

    def further_tables(self) -> list[Table]:
        return spread_tables(self.completing)

    def _json(self) -> dict[str, Any]:
        return diagnosing.diagnosis_json(self)

    def _report(self, path: Path, inputs: Inputs) -> None:
        case = self.case
        illustrated = self.illustrated or Illustrated.of(self, case.comparison, case.predictor)
        write_diagnosis_report(path, self, case.predictor, inputs, illustrated)


@dataclass(frozen=True, eq=False)
class StudyResult(Study, AnalysisResult):
    """What was added to a model and what it brought, see `Study`; its `scenario` has it all."""

    case: Case = field(kw_only=True, repr=False)
    # With what was found in the model; None where that is nothing.
    after: Case | None = field(kw_only=True, repr=False)
    file: ClassVar[str] = "study"

    @property
    def outcome(self) -> str:
        return self.hygiene.before(f"{study_outcome(self)} Stopped because {self.stopped_because}.")

    def table(self) -> Table:
        return steps_table(self, tested=bool(self.case.tests))

    def further_tables(self) -> list[Table]:
        """What was found, with its values."""
        return [findings_table(self.found)] if self.found else []

    def picture(self) -> Figure:
        """The error falling, step by step."""
        return figures.falling_error(self.steps, figures.small_motions(self.robot))

    def _json(self) -> dict[str, Any]:
        return studying.study_json(self)

    @property
    def _completed(self) -> Scenario | None:
        return self.scenario if self.found else None

    def save(self, folder: str | Path, inputs: Inputs | None = None) -> None:
        """Also writes replay.html where something was found and models were simulated: the log,
        the model as given and the completed one in motion."""
        super().save(folder, inputs)
        if self.found and (motions := study_motions(self, self.case.train)):
            write_replay(Path(folder) / "replay.html", self.case.scenario, motions)

    def _report(self, path: Path, inputs: Inputs) -> None:
        given, completed = (
            (case.predictor, case.comparison) for case in (self.case, self.after or self.case)
        )
        write_study_report(path, self, given, completed, inputs, self.case.tests)


@dataclass(frozen=True, eq=False)
class IdentificationResult(Identification, AnalysisResult):
    """Inertial parameters and plain friction, see `Identification`; its `scenario` has them."""

    case: Case = field(kw_only=True, repr=False)
    file: ClassVar[str] = "identify"

    @property
    def outcome(self) -> str:
        return self.hygiene.before(identification_outcome(self))

    def table(self) -> Table:
        return errors_table(self)

    @property
    def identifiability(self) -> str:
        """What the log can say of inertial parameters at all, in two sentences."""
        return identifying.identifiability_text(self.inertia)

    def further_tables(self) -> list[Table]:
        return spread_tables(self.findings)

    def _json(self) -> dict[str, Any]:
        return identifying.identification_json(self)

    @property
    def _completed(self) -> Scenario | None:
        return self.scenario

    def _report(self, path: Path, inputs: Inputs) -> None:
        write_identification_report(path, self, inputs)


def compare(scenario: Scenario, log: Log, *, name: str = "scenario") -> ComparisonResult:
    """Says where a scenario's model fails on a log. Nothing is fitted.

    Args:
        scenario: whose `model` is compared.
        log: of a robot, real or simulated; truth channels are not looked at.
        name: what the scenario is called in reports.

    Raises:
        InputError: a log that does not fit the model, or whose signs, units or frames are wrong.

    >>> from fbse_drake import compare, load_scenario, simulate
    >>> scenario = load_scenario("bsc_arm", overrides=["duration=0.5"])  # believes in no friction
    >>> compare(scenario, simulate(scenario).log).failures[0].row.name
    'axis_6'
    """
    require_scenario(scenario)
    require_log(log)
    case = Case(name, scenario, log, log)
    return _with_case(ComparisonResult, case.comparison, case=case)


def diagnose(
    scenario: Scenario,
    log: Recordings,
    effects: Iterable[type[Effect]] | None = None,
    *,
    tests: Mapping[str, Log] | None = None,
    name: str = "scenario",
    progress: Progress = silent,
    jobs: int = 1,
) -> DiagnosisResult:
    """Finds the physical effects that a scenario's model lacks.

    Args:
        scenario: whose `model` is looked at.
        log: of a robot, real or simulated, or several by name, which are fitted together
            (`Finding.spread` says how far they agree); truth channels are not looked at.
        effects: what is tried; by default the library but for what `identify.ruled_out` names.
        tests: further logs to test on, by name; nothing is fitted to them.
        name: what the scenario is called in reports.
        progress: is told what is being done, and may end the work with what is known then
            (`ProgressLines(print, limit=60)`).
        jobs: how many things are done side by side: from two on, effects are predicted while the
            log is inspected, experiments planned and pictures of its report drawn while it
            searches.

    Raises:
        InputError: see `compare`; or no joint is left whose torque can be trusted.

    >>> from fbse_drake import CoulombFriction, TorqueBias, diagnose, load_scenario, simulate
    >>> scenario = load_scenario("bsc_arm", overrides=["duration=0.5"])  # believes in no friction
    >>> found = diagnose(scenario, simulate(scenario).log, [CoulombFriction, TorqueBias])
    >>> found.outcome
    'The model lacks Coulomb friction in 6 joints.'
    >>> found.chosen[0].parameters["coulomb"].unit
    'Nm'
    """
    case = Case.divided(scenario, log, tests, name)
    tried = None if effects is None else _classes(effects)
    with Processes(jobs) as processes:
        beside = processes.beside(progress)
        averaged, _ = averaged_to_bandwidth(case.predictor)
        tried = plausible_effects(averaged) if tried is None else tried
        dictionary = Dictionary(averaged, tried, beside)
        dictionary.begin(processes)
        # While it is begun the log is inspected; mostly all of it is trusted.
        trusted = case.predictor.of(case.trusted)
        experiments = Experiments(trusted.scenario)
        experiments.begin(processes, beside)

        def draw_where(_: Progress) -> Section:
            return drawn(where_it_fails(case.comparison, case.predictor))

        where = processes.begin(draw_where)
        tested = {test: Predictor(case.trusted, other) for test, other in case.tests.items()}
        diagnosis = diagnose_confirmed(
            trusted, tried, tested, progress=beside, dictionary=dictionary, experiments=experiments
        )
        if diagnosis.partial is not None:
            # It was cancelled together with the search.
            where = processes.begin(draw_where)
        others = [
            processes.begin(lambda _: [*map(drawn, why_it_fails(diagnosis))]),
            processes.begin(lambda _: [drawn(what_was_looked_for(diagnosis))]),
            processes.begin(lambda _: [*map(drawn, how_it_falls(diagnosis, trusted.robot))]),
        ]
        set_aside = {}
        if diagnosis.completing:
            completed = addition.add(case.trusted, diagnosis.completing)
            set_aside = {
                test: validated(other, other.of(completed)) for test, other in tested.items()
            }
        illustrated = None
        if jobs > 1:
            (of_where,) = processes.results([where], silent, "drawing")
            why, (looked_for,), path = processes.results(others, silent, "drawing")
            illustrated = Illustrated(of_where, why, looked_for, path)
    diagnosis = replace(diagnosis, set_aside=set_aside)
    return _with_case(DiagnosisResult, diagnosis, case=case, illustrated=illustrated)


def study(
    scenario: Scenario,
    log: Log,
    effects: Iterable[type[Effect]] | None = None,
    *,
    rollouts: bool = True,
    tests: Mapping[str, Log] | None = None,
    name: str = "scenario",
    progress: Progress = silent,
    jobs: int = 1,
) -> StudyResult:
    """Adds what a scenario's model lacks until a log shows nothing more.

    Args:
        scenario, effects, tests, name, progress: see `diagnose`.
        log: one; models are simulated against it.
        rollouts: also simulates the model in the robot's place after every round.
        jobs: how many simulations run side by side.

    Raises:
        InputError: see `diagnose`.
    """
    case = Case.divided(scenario, log, tests, name)
    found = studying.study(
        case.trusted,
        case.train,
        None if effects is None else _classes(effects),
        rollouts=rollouts,
        tests=case.tests,
        progress=progress,
        jobs=jobs,
        reading=case.predictor.reading,
    )
    completed = replace(case, scenario=found.scenario, reading=case.predictor.reading)
    after = completed if found.found else None
    return _with_case(StudyResult, found, case=case, after=after)


def identify(
    scenario: Scenario,
    log: Recordings,
    *,
    tests: Mapping[str, Log] | None = None,
    name: str = "scenario",
    progress: Progress = silent,
) -> IdentificationResult:
    """Identifies the inertial parameters that a scenario does not trust (`identify.inertia`), with
    friction and bias of every joint.

    Args:
        scenario, log, tests, name, progress: see `diagnose`.

    Raises:
        InputError: see `compare`; or the scenario trusts all inertia.
    """
    case = Case.divided(scenario, log, tests, name)
    case.hygiene  # noqa: B018 - a log that cannot be what it is said to be is refused first.
    found = identifying.identify(scenario, case.train, case.tests, progress=progress)
    return _with_case(IdentificationResult, found, case=case)


def add(scenario: Scenario, found: Diagnosis | Iterable[Finding]) -> Scenario:
    """The scenario with what was found in its model.

    Args:
        found: a diagnosis, of which everything that it chose is added, and what is tentative; or
            findings, as some of its `ranking`.

    Raises:
        InputError: an effect that the library does not have.
    """
    require_scenario(scenario)
    findings = found.completing if isinstance(found, Diagnosis) else list(found)
    for finding in findings:
        require_type("found", finding, Finding, "the ranking of a diagnosis")
    return addition.add(scenario, findings)


def hide(
    scenario: Scenario,
    seed: int,
    *,
    what: str = "any",
    size: Size | None = None,
    count: int = 1,
    name: str = "exercise",
) -> Exercise:
    """Makes an exercise: a log of the scenario's robot with a physical effect that its model lacks.

    Args:
        seed: decides on everything, sensor noise included.
        what: `any`, `library`, `decoy` (nothing), `stranger` (none of the library), or the name of
            an effect.
        size: small, medium or large; by default drawn as well.
        count: how many effects are hidden.
        name: what the scenario is called in the log.

    Raises:
        InputError: an unknown effect or size, or nothing is small enough for the robot.
    """
    require_scenario(scenario)
    return hidden.make_exercise(scenario, name, seed, what=what, size=size, count=count)


def reveal(folder: str | Path) -> Revealed:
    """Opens the answer of an exercise that lies in a folder, with a score for the diagnosis or
    study beside it.

    Raises:
        InputError: no exercise, a damaged answer or diagnosis.
    """
    return hidden.reveal(Path(folder))


def convert(
    recordings: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    log_map: str | Path | None = None,
) -> Log:
    """Makes one log of recordings: ROS bags, CSV, JSON, MATLAB, npz files and logs.

    Args:
        recordings: one or several files, one after the other in time.
        out: also writes it to this file, as its name ends: .npz (a log), .mcap or .csv.
        log_map: what columns and topics mean (yaml); standard messages need none.

    Raises:
        InputError: a file is damaged, does not fit the map, or cannot be written.
    """
    several = [recordings] if isinstance(recordings, (str, Path)) else recordings
    write = None if out is None else writer_for(Path(out))
    log = read_logs([Path(recording) for recording in several], log_map)
    if out is not None and write is not None:
        try:
            write(log, Path(out))
        except OSError as error:
            raise InputError(f"{out}: {error.strerror or error}") from None
    return log


T = TypeVar("T")


def _recordings(logs: Mapping[str, Log]) -> dict[str, Log]:
    """
    Raises:
        InputError: it is something else than logs by name.
    """
    for log in logs.values() if isinstance(logs, Mapping) else [logs]:
        require_log(log)
    return dict(logs)


def _classes(effects: Iterable[type[Effect]]) -> list[type[Effect]]:
    """
    Raises:
        InputError: it holds something else than classes of effects.
    """
    found = list(effects) if isinstance(effects, Iterable) else [effects]
    for effect in found:
        if not (isinstance(effect, type) and issubclass(effect, Effect)):
            raise InputError(
                f"effects: expected classes of effects, as [CoulombFriction], found {effect!r}"
            )
    if not isinstance(effects, Iterable):
        raise InputError("effects: expected a list of classes, found a single one")
    return found


def _with_case(kind: type[T], found: Any, **more: Any) -> T:
    """What was found, as a result that knows its case."""
    return kind(**{item.name: getattr(found, item.name) for item in fields(found)}, **more)
