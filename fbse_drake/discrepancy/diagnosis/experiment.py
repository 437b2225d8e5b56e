"""Which experiment would decide between effects, told from the planned motions of scenarios."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fbse_drake import resources
from fbse_drake.discrepancy.diagnosis.detectability import separation, smallest_detectable
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.fits import MARGIN, Fits
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.equation_of_motion import EquationOfMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.effects.effect import Effect
from fbse_drake.errors import InputError, located, required
from fbse_drake.log import Log
from fbse_drake.processes import Processes
from fbse_drake.progress import Progress
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import Scenario, build_robot, load_scenario
from fbse_drake.walking.plan import YawMotion
from fbse_drake.walking.reference import make_reference

# A planned motion is evaluated at this period and interpolated [s].
_PERIOD = 0.010
# Samples in a block of a motion that is only compared with others: motions differ in what they show
# by more than the white noise that further samples would average out.
_SAMPLES = 2


def planned_log(scenario: Scenario) -> Log:
    """What ideal sensors would record if the model followed its reference exactly; no simulation.

    The trunk stays upright; feet that stand share the load with the least forces.

    Raises:
        InputError: a motion that the model cannot make.
    """
    robot, period = build_robot(scenario.believed), required(scenario.log.period, "log.period")
    coarse = np.arange(int(scenario.duration / _PERIOD) + 1) * _PERIOD
    with located("reference: "):
        reference = make_reference(scenario.reference, robot, coarse)
    n = len(robot.joint_names)
    plan, R_BI = reference.plan, _imu_axes(robot)
    gravity = robot.plant.gravity_field().gravity_vector() if plan is None else plan.gravity
    # The IMU sits in an upright trunk.
    trunk = YawMotion.none(len(coarse)) if plan is None else plan.trunk_yaw
    specific_force = np.einsum("nji,nj->ni", trunk.rotation, reference.base.acceleration - gravity)
    equation = EquationOfMotion(robot)
    pads = len(equation.pads.foot)
    at = Instants(
        reference.joint_position,
        reference.joint_velocity,
        reference.joint_acceleration,
        trunk.angular_velocity @ R_BI,
        trunk.angular_acceleration @ R_BI,
        specific_force @ R_BI,
        np.zeros((len(coarse), pads, 3)),
        np.zeros((len(coarse), n)),
        np.zeros((len(coarse), 0)),
    )
    if robot.has_floating_base and plan is not None:
        support = np.stack([plan.support(side) for side in robot.description.sides], axis=1)
        at = replace(at, pad_force=_standing_forces(equation, at, support))
    at = replace(at, torque_command=-equation.residual(at, kinematic=False)[:, :n])
    fine = np.arange(int(scenario.duration / period) + 1) * period

    def sampled(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        result = np.empty((len(fine), flat.shape[1]))
        for k, column in enumerate(flat.T):
            result[:, k] = np.interp(fine, coarse, column)
        return result.reshape(len(fine), *values.shape[1:])

    channels = {
        "time": fine,
        "joint/position": sampled(at.joint_position),
        "joint/velocity": sampled(at.joint_velocity),
        "joint/torque_command": sampled(at.torque_command),
        "imu/linear_acceleration": sampled(at.specific_force),
        "imu/angular_velocity": sampled(at.angular_velocity),
    }
    if scenario.sensors.motor_encoders is not None:
        channels["joint/motor_position"] = channels["joint/position"]
    force = sampled(at.pad_force)
    for foot, side in enumerate(robot.description.sides):
        channels[f"foot/{side}/pad_force"] = force[:, equation.pads.foot == foot]
    meta = {
        "joints": robot.joint_names,
        "sides": robot.description.sides,
        "period": period,
        "source": "planned motion",
    }
    return Log(channels, meta)


def _imu_axes(robot: Robot) -> np.ndarray:
    """R_BI of the robot's IMU."""
    X_BI = robot.imu.CalcPose(robot.plant.CreateDefaultContext(), robot.base.body_frame())
    return X_BI.rotation().matrix()


def _standing_forces(equation: EquationOfMotion, at: Instants, support: np.ndarray) -> np.ndarray:
    """Smallest pad forces on standing feet that satisfy the six unactuated rows, (M, P, 3)."""
    n, pads = len(equation.robot.joint_names), len(equation.pads.foot)
    needed = equation.residual(at, kinematic=False)[:, n:]
    # Column by column: what a unit of each force adds to the rows.
    columns = np.empty((len(needed), 6, 3 * pads))
    for k in range(3 * pads):
        unit = np.zeros((len(needed), pads, 3))
        unit.reshape(len(needed), -1)[:, k] = 1.0
        columns[:, :, k] = (
            equation.residual(replace(at, pad_force=unit), kinematic=False)[:, n:] - needed
        )
    columns *= np.repeat(support[:, equation.pads.foot], 3, axis=1)[:, None, :]
    forces = -np.einsum("mij,mj->mi", np.linalg.pinv(columns), needed)
    return forces.reshape(len(needed), pads, 3)


@dataclass(frozen=True)
class _Motion:
    """A motion of a shipped scenario, as the robot would make it."""

    shipped: Scenario
    # What it would record; what rigid bodies leave of that, and what the model leaves.
    log: Log
    rigid: Residual
    white: WhitenedResidual


class Experiments:
    """Motions that a robot could make, and what each would show."""

    def __init__(self, scenario: Scenario):
        """Nothing is planned before it is asked for.

        Args:
            scenario: whose model and sensors make the motions of the shipped scenarios.
        """
        self._scenario = scenario
        self._planned_beside: Callable[[], dict[str, _Motion]] | None = None

    def serve(self, scenario: Scenario) -> bool:
        """Would another scenario's robot make the same motions, and record the same?"""
        return all(
            getattr(self._scenario, name) == getattr(scenario, name)
            for name in ("reference", "believed", "sensors", "estimator", "compensation")
        )

    def begin(self, processes: Processes, progress: Progress) -> None:
        """Begins to plan the motions beside other work.

        Args:
            progress: is told where that is waited for.
        """
        task = processes.begin(lambda _: self._planned())

        def result() -> dict[str, _Motion]:
            (found,) = processes.results([task], progress, "planning experiments")
            return found

        self._planned_beside = result

    @cached_property
    def _motions(self) -> dict[str, _Motion]:
        """By the scenario's name."""
        return self._planned() if self._planned_beside is None else self._planned_beside()

    def _planned(self) -> dict[str, _Motion]:
        found = {}
        for name, shipped in _shipped(self._scenario).items():
            wanted = self._made_by_us(shipped)
            try:
                predictor = Predictor(wanted, planned_log(wanted))
            except InputError:
                continue  # A motion that this robot cannot make shows nothing.
            white = WhitenedResidual(predictor.residual)
            found[name] = _Motion(shipped, predictor.log, predictor.motion.residual, white)
        return found

    def _made_by_us(self, shipped: Scenario) -> Scenario:
        """A shipped scenario with our model and sensors, to which its estimator need not fit."""
        period = required(shipped.log.period, "log.period")
        period = max(period, shipped.recording.block / _SAMPLES)
        gantry_height = shipped.robot.gantry_height
        return replace(
            shipped,
            model=replace(self._scenario.believed, gantry_height=gantry_height),
            log=replace(shipped.log, period=period),
            sensors=self._scenario.sensors,
            estimator=self._scenario.estimator,
            compensation=self._scenario.compensation,
        )

    @cached_property
    def _predictors(self) -> dict[str, Predictor]:
        found = {}
        for name, motion in self._motions.items():
            predictor = found[name] = Predictor(self._made_by_us(motion.shipped), motion.log)
            # It may be another process that found it.
            predictor.motion.residual = motion.rigid
        return found

    def _fits(self, effect: type[Effect]) -> dict[str, Fits]:
        return {
            name: Fits(Dictionary(predictor, [effect]), self._motions[name].white)
            for name, predictor in self._predictors.items()
        }

    def that_shows(self, effect: type[Effect]) -> str | None:
        """Scenario that would show an effect at the smallest size, if that size is plausible."""
        sizes = {}
        for name, fits in self._fits(effect).items():
            found = smallest_detectable(fits, fits.noise_alone, effect)
            largest = fits.dictionary.largest_plausible
            shown = [size for target, size in found.items() if size < largest(effect, target)]
            sizes[name] = min(shown, default=np.inf)
        best = min(sizes, key=lambda name: sizes[name], default=None)
        return best if best is not None and sizes[best] < np.inf else None

    def that_separates(
        self,
        effect: type[Effect],
        targets: Sequence[str],
        values: Mapping[str, float],
        rival: type[Effect],
    ) -> str | None:
        """Scenario that separates an effect with its values best from a rival, if any does."""
        differences = {
            name: separation(fits, effect, targets, values, rival)
            for name, fits in self._fits(rival).items()
        }
        best = max(differences, key=lambda name: differences[name], default=None)
        return best if best is not None and differences[best] > MARGIN else None


def _shipped(scenario: Scenario) -> dict[str, Scenario]:
    """Shipped scenarios in which the same robot moves otherwise, by name."""
    found: dict[str, Scenario] = {}
    for path in sorted(resources.folder("scenarios").glob("*.yaml")):
        try:
            other = load_scenario(path)
        except InputError:
            continue
        same_robot = other.believed.description == scenario.believed.description
        if same_robot and all(
            other.reference != known.reference for known in (scenario, *found.values())
        ):
            found[path.stem] = other
    return found
