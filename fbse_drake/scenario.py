"""What can be said in a scenario file.

A file holds one or more named scenarios. What is left out has the default below;
`--set a.b.c=value` goes on top.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydrake.multibody.plant import (
    ApplyMultibodyPlantConfig,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.systems.framework import DiagramBuilder

from fbse_drake import resources, schema
from fbse_drake.control.compensation import Compensation, NoCompensation
from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.effects.effect import Effect, library
from fbse_drake.effects.geometry import shifts
from fbse_drake.effects.inertia import inertia_changes
from fbse_drake.effects.user import import_effect_modules, require_trusted
from fbse_drake.errors import (
    InputError,
    located,
    require_not_negative,
    require_positive,
    require_type,
)
from fbse_drake.estimators.beliefs import SensorBeliefs, beliefs_of
from fbse_drake.estimators.estimator import Estimator, NoEstimator
from fbse_drake.robot.description import RobotDescription, load_description
from fbse_drake.robot.implicit import ImplicitTorque
from fbse_drake.robot.plant import Ground, Robot, make_robot
from fbse_drake.robot.push import Push
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.sensors.foot_force import FootForceConfig
from fbse_drake.sensors.imu import ImuConfig
from fbse_drake.sensors.joint_torque import JointTorqueConfig
from fbse_drake.sensors.motor_encoders import MotorEncoderConfig
from fbse_drake.sensors.sensor import Sensor
from fbse_drake.walking.plan import TaskPlan
from fbse_drake.walking.reference import Reference, ReferenceConfig, make_plan, make_reference
from fbse_drake.walking.walk import Walk

# A rotor's inertia that is found to be nothing may come out below zero by this [kg m^2].
_ROUNDING = 1e-9


@dataclass(frozen=True)
class RobotConfig:
    """A robot's body and the physical effects in it; the same words for the robot and for the model
    of it."""

    # Name or path of a robot description (models/*.yaml).
    description: str = "biped"
    # Hangs the base in a gantry at this height [m], upright, instead of letting it float.
    gantry_height: float | None = None
    # Reflected rotor inertia by joint [kg m^2].
    rotor_inertia: dict[str, float] = field(default_factory=dict)
    # Physical effects, each under a name of your choice.
    effects: dict[str, Effect] = field(default_factory=dict)
    # Forces from outside that nobody measures, each under a name of your choice.
    pushes: dict[str, Push] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for joint, value in self.rotor_inertia.items():
            if value < 0:
                raise InputError(f"rotor_inertia.{joint}: expected a number >= 0, found {value:g}")

    def effects_of(self, kind: type[Effect], names: RobotDescription, *, key: str) -> list[Any]:
        """Its effects of one kind (a subclass of `Effect`), with values per target.

        Args:
            key: where the config stands in the scenario, for messages: `robot` or `model`.

        Raises:
            InputError: see `Effect.resolve`.
        """
        wanted = {name: e for name, e in self.effects.items() if isinstance(e, kind)}
        return [e.resolve(names, key=f"{key}.effects.{name}") for name, e in wanted.items()]


@dataclass(frozen=True)
class SensorsConfig:
    """Sensors of the robot; without errors by default."""

    encoders: EncoderConfig = field(default_factory=EncoderConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    foot_force: FootForceConfig = field(default_factory=FootForceConfig)
    # Joint torque sensors, for robots that have them.
    joint_torque: JointTorqueConfig | None = None
    # Second encoders, on the motors' side of the gears, for robots that have them.
    motor_encoders: MotorEncoderConfig | None = None
    # Further sensors, each under a name of your choice, as {winding: !JointTemperature {}}.
    more: dict[str, Sensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given_by: dict[str, str] = {}
        for name in self.more:
            if name in self._usual:
                raise InputError(f"more.{name}: there is a sensor of this name already")
        for name, sensor in self.by_name.items():
            for port in sensor.ports():
                if port in given_by:
                    raise InputError(f"more.{name}: gives {port}, as {given_by[port]} does already")
                given_by[port] = name

    @property
    def _usual(self) -> dict[str, Sensor]:
        names = ("encoders", "imu", "foot_force", "joint_torque", "motor_encoders")
        usual = {name: getattr(self, name) for name in names}
        return {name: sensor for name, sensor in usual.items() if sensor is not None}

    @property
    def by_name(self) -> dict[str, Sensor]:
        """All sensors of the robot."""
        return self._usual | self.more

    @property
    def deflection_noise(self) -> float:
        """Standard deviation of the difference of a joint's two encoders [rad]."""
        second = 0.0 if self.motor_encoders is None else self.motor_encoders.angle_noise
        return math.hypot(self.encoders.angle_noise, second)

    @property
    def without_errors(self) -> "SensorsConfig":
        """The same with exact sensors where controller and estimators see them."""
        return replace(
            self,
            encoders=EncoderConfig(period=self.encoders.period),
            imu=ImuConfig(),
            foot_force=FootForceConfig(),
            joint_torque=self.joint_torque and JointTorqueConfig(),
            motor_encoders=self.motor_encoders and MotorEncoderConfig(),
        )

    def with_period(self, period: float) -> "SensorsConfig":
        """The same, with this period [s] for sensors of which none is given."""
        usual = {name: _with_period(sensor, period) for name, sensor in self._usual.items()}
        more = {name: _with_period(sensor, period) for name, sensor in self.more.items()}
        return replace(self, **usual, more=more)


@dataclass(frozen=True)
class FallConfig:
    """When the robot counts as fallen."""

    # Height of the base over its height at the start.
    height_ratio: float = 0.7
    # Tilt of the base [rad].
    tilt: float = 0.8


@dataclass(frozen=True)
class RecordingConfig:
    """How a log is read before its physics is looked at. The defaults are for logs of
    `fbse simulate`."""

    # The equation of motion is averaged over blocks of this length [s], and of at least three
    # samples where rows are sampled at an instant or velocities are had from the angles.
    block: float = 0.010
    # What a row of the log holds: `per_step` (IMU and forces over the time that ends there, the
    # torque that is held over the time that begins there; the log's `reading_time` and
    # `command_time` say how long these are, by default its period), or `instantaneous` (all
    # channels sampled together). Whether a simulation made the motion, and in what steps, is told
    # by the log itself.
    rows: str = "per_step"
    # Joint velocities: `measured`, or `differenced` from the angles, as they are in any case where
    # the log has none.
    velocity: str = "measured"
    # All channels go through a low-pass without delay (Butterworth of order 4, forwards and
    # backwards) with this corner [Hz]; 0 for none.
    cutoff: float = 0.0
    # Who recorded the torques has done so already, with this corner [Hz]: predicted torques go
    # through the same before they are compared.
    recorded_cutoff: float = 0.0
    # White noise of the torque of each joint, standard deviation of a sample [Nm].
    torque_noise: dict[str, float] = field(default_factory=dict)
    # What such noise has beside, as a share of the torque: a torque that is had from a model of the
    # motor is right but for a share of it.
    torque_noise_share: dict[str, float] = field(default_factory=dict)
    # A joint's row counts where the joint moves faster than this [rad/s]: at rest friction is
    # whatever holds the joint, and no law says it.
    least_speed: dict[str, float] = field(default_factory=dict)
    # Rows of the residual, as compare.json names them (* stands for any text), that cannot close,
    # for a channel of theirs is not to be trusted: nothing is fitted to them, and nothing is said
    # about them.
    unused_rows: list[str] = field(default_factory=list)
    # Models are fitted to this first share of the log; the rest is set aside to test them.
    train_share: float = 0.8

    @property
    def is_sampled(self) -> bool:
        """Does a row hold what was so at its instant?"""
        return self.rows == "instantaneous"

    def __post_init__(self) -> None:
        require_positive(self, "block")
        require_not_negative(self, "cutoff", "recorded_cutoff")
        for key, allowed in (
            ("rows", ("per_step", "instantaneous")),
            ("velocity", ("measured", "differenced")),
        ):
            if getattr(self, key) not in allowed:
                raise InputError(
                    f"{key}: expected {' or '.join(allowed)}, found {getattr(self, key)}"
                )
        if self.cutoff > 0 and self.block * self.cutoff < 0.5:
            raise InputError(
                f"block: expected at least half a period of cutoff = {self.cutoff:g} Hz, found "
                f"{self.block:g} s"
            )
        if not 0 < self.train_share <= 1:
            raise InputError(
                f"train_share: expected a number in (0, 1], found {self.train_share:g}"
            )
        for key in ("torque_noise", "torque_noise_share", "least_speed"):
            for joint, value in getattr(self, key).items():
                if value < 0:
                    raise InputError(f"{key}.{joint}: expected a number >= 0, found {value:g}")


@dataclass(frozen=True)
class IdentifyConfig:
    """What of the model's own parameters is not trusted, so that it is identified together with the
    effects that a log shows."""

    # Bodies whose inertial parameters are not trusted; `all` for every body with a mass.
    inertia: list[str] = field(default_factory=list)
    # Effects that are not tried, for the recording itself shows that they are not there (see its
    # data hygiene).
    ruled_out: list[str] = field(default_factory=list)
    # Effects that add less than this share to the torque (root mean square) of every joint that
    # they act in are too small to matter; of the base and of soles likewise to their forces and
    # motions.
    tolerance: float = 0.005

    def __post_init__(self) -> None:
        require_not_negative(self, "tolerance")
        for name in self.ruled_out:
            if name not in library():
                raise InputError(
                    f"ruled_out: {name}: no such effect (there are: {', '.join(library())})"
                )


@dataclass(frozen=True)
class LogConfig:
    """What is recorded."""

    # Time between samples [s]; by default `Scenario.usual_period`.
    period: float | None = None


def _plant_config() -> MultibodyPlantConfig:
    # "lagged" holds stance feet still; "sap" lets them creep by millimetres over a walk.
    return MultibodyPlantConfig(
        time_step=0.001, contact_model="point", discrete_contact_approximation="lagged"
    )


# Control, log and sensors tick at least this far apart, unless they are given a period [s].
_USUAL_PERIOD = 0.001

# Of the plant, in a simulation.
_MOST_STEPS = 10**8

T = TypeVar("T")


def _with_period(config: T, period: float) -> T:
    """The same config, with this period [s] if it is to have one and none is given."""
    return replace(config, period=period) if getattr(config, "period", 0.0) is None else config


@dataclass(frozen=True)
class Scenario:
    """One experiment. SI units throughout.

    Periods that are not given become `usual_period`.

    >>> from fbse_drake import CoulombFriction, RobotConfig, Scenario, Squat
    >>> robot = RobotConfig(effects={"friction": CoulombFriction(coulomb={"all": 0.5})})
    >>> scenario = Scenario(duration=2.0, robot=robot, reference=Squat(amplitude=0.03))
    >>> scenario.believed.effects  # what `model` leaves out is not believed
    {}
    >>> scenario.usual_period
    0.001
    """

    # One sentence for the reader of the report.
    title: str = ""
    # Seed of all sensor noise.
    seed: int = 0
    # Length of the experiment [s].
    duration: float = 11.5
    # Python files (relative to the scenario's) or modules with effects, sensors, estimators and
    # compensations of your own.
    effect_modules: list[str] = field(default_factory=list)
    # What really happens.
    robot: RobotConfig = field(default_factory=RobotConfig)
    # What is believed of it (feed-forward, estimators, predictions); by default the robot's body
    # without its effects.
    model: RobotConfig | None = None
    # Drake's settings of the robot's plant, whose time_step must be > 0.
    plant: MultibodyPlantConfig = field(default_factory=_plant_config)
    # Solve every step of the plant twice, so that joint torques follow their laws ten times as
    # closely, through impacts too; the simulation takes twice as long.
    solve_twice: bool = False
    ground: Ground = field(default_factory=Ground)
    # The motion: !Walk, !Trot, !Squat, !Sway, !JointSines or !Recorded.
    reference: ReferenceConfig = field(default_factory=Walk)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    control: PositionLoopConfig = field(default_factory=PositionLoopConfig)
    # Who estimates the friction: !NoEstimator, !Fbse, a reference (!TrueFriction, !TorqueSensor),
    # or a rival: !DisturbanceObserver, !FilteredDisturbance, !ExtendedState, !ActuatorFault,
    # !FixedFriction, !FilteredModel, !AdaptiveFriction, !LuGreFriction, !RadialBasisFriction or
    # !FuzzyFriction.
    estimator: Estimator = field(default_factory=NoEstimator)
    # What the controller makes of it: !NoCompensation, !IntegralCompensation,
    # !FeedforwardCompensation or !FaultReconfiguration.
    compensation: Compensation = field(default_factory=NoCompensation)
    fall: FallConfig = field(default_factory=FallConfig)
    log: LogConfig = field(default_factory=LogConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    identify: IdentifyConfig = field(default_factory=IdentifyConfig)

    def __post_init__(self) -> None:
        schema.check(type(self), self)
        require_positive(self, "duration")
        if self.seed < 0:
            raise InputError(f"seed: expected a whole number >= 0, found {self.seed}")
        for key in ("time_step", "stiction_tolerance", "penetration_allowance"):
            if getattr(self.plant, key) <= 0:
                raise InputError(
                    f"plant.{key}: expected a number > 0, found {getattr(self.plant, key):g}"
                )
        try:
            ApplyMultibodyPlantConfig(self.plant, MultibodyPlant(self.plant.time_step))
        except RuntimeError as error:
            raise InputError(f"plant: {error}") from None
        if not self.plant.use_sampled_output_ports:
            raise InputError(
                "plant.use_sampled_output_ports: expected true (sensors measure the plant's last "
                "step), found False"
            )
        approximation = self.plant.discrete_contact_approximation
        if approximation == "tamsi":
            allowed = "sap, similar or lagged, which solve joint friction too"
            key = "plant.discrete_contact_approximation"
            raise InputError(f"{key}: expected {allowed}; found {approximation}")
        if self.duration > _MOST_STEPS * self.plant.time_step:
            raise InputError(
                f"duration: expected at most {_MOST_STEPS:g} steps of plant.time_step = "
                f"{self.plant.time_step:g} s, found {self.duration:g} s"
            )
        # Frozen from here on: nobody has seen it yet.
        usual = self.usual_period
        object.__setattr__(self, "control", _with_period(self.control, usual))
        object.__setattr__(self, "log", _with_period(self.log, usual))
        object.__setattr__(self, "sensors", self.sensors.with_period(usual))
        if self.duration < self.control.period:
            raise InputError(
                f"duration: expected at least control.period = {self.control.period:g} s, found "
                f"{self.duration:g}"
            )
        if self.compensation.uses_estimate and not self.estimator.gives_friction:
            raise InputError("compensation: needs an estimator (estimator: !Fbse {})")
        sensors = self.sensors.by_name
        with located("estimator: "):
            self.estimator.check_sensors(
                [port for sensor in sensors.values() for port in sensor.ports()]
            )
        periods = {"control.period": self.control.period, "log.period": self.log.period}
        for name, sensor in sensors.items():
            where = f"sensors.more.{name}" if name in self.sensors.more else f"sensors.{name}"
            times = {f"{where}.{key}": getattr(sensor, key) for key in sensor.whole_steps}
            periods |= {key: time for key, time in times.items() if time != 0}
        for key, period in periods.items():
            steps = period / self.plant.time_step
            if steps < 1 - 1e-9 or abs(steps - round(steps)) > 1e-6:
                raise InputError(
                    f"{key}: expected a whole multiple of plant.time_step = "
                    f"{self.plant.time_step:g} s, found {period:g}"
                )

    def __eq__(self, other: object) -> bool:
        """Drake's settings are compared one by one: two objects of them are never equal."""
        if not isinstance(other, Scenario):
            return NotImplemented
        return self._comparable == other._comparable

    @property
    def _comparable(self) -> dict[str, Any]:
        settings = {name: getattr(self.plant, name) for name in schema.fields_of(type(self.plant))}
        return vars(self) | {"plant": settings}

    def __reduce__(self) -> tuple[Any, ...]:
        """As its YAML text, for Drake's settings cannot be pickled."""
        return _from_text, (dump_scenario(self, "scenario"),)

    @property
    def usual_period(self) -> float:
        """The fewest whole steps of the plant that last a millisecond [s]."""
        steps = math.ceil(_USUAL_PERIOD / self.plant.time_step - 1e-6)
        return steps * self.plant.time_step

    @property
    def believed_sensors(self) -> SensorBeliefs:
        """What the estimator believes of the sensors."""
        sensors = self.sensors
        usual = beliefs_of(sensors.encoders, sensors.imu, sensors.foot_force)
        return self.estimator.believed_sensors(usual)

    @property
    def believed(self) -> RobotConfig:
        """The model, also where the scenario leaves it out."""
        if self.model is not None:
            return self.model
        return RobotConfig(
            self.robot.description, self.robot.gantry_height, self.robot.rotor_inertia
        )


def build_robot(
    config: RobotConfig,
    *,
    builder: DiagramBuilder | None = None,
    plant: MultibodyPlantConfig | None = None,
    ground: Ground | None = None,
    implicit: ImplicitTorque | None = None,
) -> Robot:
    """A robot's plant, with the inertia and geometry effects that the robot has.

    Args:
        builder, plant, ground, implicit: see `make_robot`.

    Raises:
        InputError: see `make_robot`; also a joint or body of an effect that the robot has not.
    """
    bare, _ = make_robot(config.description)
    added, point_masses = inertia_changes(config.effects, bare)
    rotor_inertia = added + bare.description.per_joint(
        config.rotor_inertia, key="rotor_inertia", default=0.0
    )
    for joint, inertia in zip(bare.joint_names, rotor_inertia, strict=True):
        if inertia < -_ROUNDING:
            raise InputError(
                f"effects: the rotor inertia of {joint}, with what effects add, is {inertia:g} "
                "kg m^2 (allowed: >= 0)"
            )
    robot, _ = make_robot(
        config.description,
        rotor_inertia=dict(zip(bare.joint_names, np.maximum(rotor_inertia, 0.0), strict=True)),
        point_masses=point_masses,
        shifts=shifts(config.effects, bare),
        gantry_height=config.gantry_height,
        builder=builder,
        config=plant,
        ground=ground,
        implicit=implicit,
    )
    return robot


def planned_reference(scenario: Scenario, model: Robot) -> Reference:
    """The scenario's motion as a model plans it, sampled at the ticks of the control.

    Raises:
        InputError: see `make_reference`.
    """
    with located("reference: "):
        return make_reference(scenario.reference, model, _ticks(scenario))


def task_plan(scenario: Scenario, model: Robot) -> TaskPlan | None:
    """What the scenario's motion is planned from, see `make_plan`; a fraction of the work.

    Raises:
        InputError: see `make_plan`.
    """
    with located("reference: "):
        return make_plan(scenario.reference, model, _ticks(scenario))


def _ticks(scenario: Scenario) -> np.ndarray:
    """Times of the control [s]."""
    ticks = round(scenario.duration / scenario.control.period)
    return np.arange(ticks + 1) * scenario.control.period


def require_scenario(scenario: object) -> None:
    """Refuses what is no scenario, as its name."""
    require_type("scenario", scenario, Scenario, "load_scenario")


def load_scenario(
    scenario: str | Path, name: str | None = None, overrides: Sequence[str] = ()
) -> Scenario:
    """Reads a scenario.

    Args:
        scenario: path of a file, or the name of one in `scenarios/`.
        name: which scenario of the file; by default its only one, or the one called like the file.
        overrides: `a.b.c=value` on top of the file, values in YAML.

    Raises:
        InputError: file not found, unknown key, wrong type, impossible value, unknown joint.

    >>> from fbse_drake import load_scenario
    >>> scenario = load_scenario("paper_walk", overrides=["duration=5", "seed=3"])
    >>> scenario.duration, scenario.seed
    (5.0, 3)
    >>> load_scenario("paper_walk", overrides=["duration=long"])
    Traceback (most recent call last):
    fbse_drake.errors.InputError: ...: duration: expected a number, found 'long'
    """
    return read_scenario(scenario, name, overrides)[1]


def read_scenario(
    scenario: str | Path,
    name: str | None = None,
    overrides: Sequence[str] = (),
    *,
    allow_code: bool = True,
) -> tuple[str, Scenario]:
    """As `load_scenario`; returns the scenario's name as well.

    Args:
        allow_code: may its `effect_modules` be run, also where the file came with a log or a
            download?
    """
    if isinstance(overrides, str) or not isinstance(overrides, Sequence):
        raise InputError(
            f"overrides: expected a list of 'KEY=VALUE', as in ['duration=5'], found {overrides!r}"
        )
    tree = ScenarioTree.read(scenario, name)
    if not allow_code:
        require_trusted(tree.path, tree.code)
    for override in overrides:
        tree = tree.overridden(override)
    return tree.name, tree.build()


@dataclass(frozen=True)
class ScenarioTree:
    """What a file says of a scenario, before defaults are filled in."""

    name: str
    path: Path
    tree: Any
    # What was put on top of the file, for messages.
    changes: tuple[str, ...] = ()

    @staticmethod
    def read(scenario: str | Path, name: str | None = None) -> "ScenarioTree":
        """Reads a file; see `load_scenario`.

        Raises:
            InputError: no such file, no YAML, or no scenario of this name in it.
        """
        path = resources.find(scenario, kind="scenarios")
        file = schema.load_tree(path)
        if name is None:
            name = next(iter(file)) if len(file) == 1 else path.stem
        if name not in file:
            raise InputError(
                f"{path}: no scenario called {name} (there are: {', '.join(map(str, file))})"
            )
        return ScenarioTree(name, path, file[name] if file[name] is not None else {})

    def overridden(self, override: str) -> "ScenarioTree":
        """With `a.b.c=value` on top, the value in YAML.

        Raises:
            InputError: this is no key and value.
        """
        key, value = _override(override)
        return self.changed(key, value, override)

    def changed(self, key: str, value: Any, text: str | None = None) -> "ScenarioTree":
        """With the value of a key, as `a.b.c`, on top.

        Args:
            value: as `schema.load_tree` would have it.
            text: the change, for messages.
        """
        for part in reversed(key.split(".")):
            value = {part: value}
        text = text or f"{key}={value}"
        return replace(self, tree=schema.merge(self.tree, value), changes=(*self.changes, text))

    @property
    def code(self) -> Any:
        """The Python code that it runs, as its `effect_modules` say; empty or None if none."""
        return self.tree.get("effect_modules") if isinstance(self.tree, dict) else None

    def build(self) -> Scenario:
        """The scenario; see `load_scenario`.

        Raises:
            InputError: unknown key, wrong type, impossible value, unknown joint.
        """
        with_changes = f" with {', '.join(self.changes)}" if self.changes else ""
        where, tree = f"{self.path}{with_changes}: {self.name}", self.tree
        if isinstance(tree, dict) and "effect_modules" in tree:
            entries = schema.build(
                list[str], tree["effect_modules"], file=where, key="effect_modules"
            )
            with located(f"{where}: "):
                modules = import_effect_modules(entries, self.path.parent)
            tree = {**tree, "effect_modules": modules}
        result = schema.build(Scenario, self._with_places(tree), file=where)
        with located(f"{where}: "):
            check_joints(result)
        return result

    def _with_places(self, tree: Any) -> Any:
        """With the paths of descriptions that lie beside the file."""
        if not isinstance(tree, dict):
            return tree
        found = {}
        for key in ("robot", "model"):
            config = tree.get(key)
            name = config.get("description") if isinstance(config, dict) else None
            if isinstance(name, str) and (self.path.parent / name).is_file():
                found[key] = {**config, "description": str((self.path.parent / name).resolve())}
        return {**tree, **found}


def check_joints(scenario: Scenario) -> None:
    """Refuses per-joint values of joints that the robot has not."""
    for key, config in (("robot", scenario.robot), ("model", scenario.believed)):
        with located(f"{key}."):
            names, _ = load_description(config.description)
            names.per_joint(config.rotor_inertia, key="rotor_inertia", default=0.0)
            for effect, value in config.effects.items():
                value.resolve(names, key=f"effects.{effect}")
    names, _ = load_description(scenario.robot.description)
    for name, sensor in scenario.sensors.more.items():
        with located(f"sensors.more.{name}."):
            sensor.check(names)
    for key in ("kp", "kd", "torque_limit"):
        names.per_joint(getattr(scenario.control, key), key=f"control.{key}")
    for key in ("torque_noise", "torque_noise_share", "least_speed"):
        names.per_joint(getattr(scenario.recording, key), key=f"recording.{key}", default=0.0)
    with located("compensation."):
        scenario.compensation.check(names)
    with located("estimator."):
        scenario.estimator.check(names)


def dump_scenario(scenario: Scenario, name: str) -> str:
    """YAML text that `load_scenario` reads back to an equal scenario."""
    return schema.dump(scenario, child_name=name)


def _from_text(text: str) -> Scenario:
    """Reads what `dump_scenario` wrote, with the modules that it names."""
    tree = schema.parse(text, file="pickled scenario")["scenario"]
    import_effect_modules(tree.get("effect_modules", []), Path())
    return schema.build(Scenario, tree, file="pickled scenario")


def _override(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(
            f"--set {text}: expected KEY=VALUE, as in --set reference.step_length=0.05"
        )
    tree = schema.parse(f"value: {value}", file=f"--set {text}")
    if list(tree) != ["value"]:
        raise InputError(f"--set {text}: expected one value")
    return key.strip(), tree["value"]
