"""What a physical effect is, and the library of all of them.

An effect is one class with one definition that serves three purposes: simulating it in a robot,
predicting what it adds to every channel of a log, and identifying its parameters. What kind of
thing it is, is said by its base class:

    JointTorqueEffect   a torque loss in a joint: friction, springs, ripple; also of its
                        actuation: gain, bias, delay (joint_torque.py)
    InertiaEffect       reflected inertia, masses, centres of mass (inertia.py)
    GeometryEffect      lengths of links, where the IMU sits (geometry.py)
    SensorEffect        what a sensor reads beside the truth (sensor.py)
    ContactEffect       ground and soles (contact.py)

An effect of a user's own is a subclass of one of them behind `@in_library`; from then on YAML files
can name it and the diagnosis tries it.
"""

from abc import ABC
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Literal, TypeVar

import numpy as np

from fbse_drake.errors import InputError
from fbse_drake.library import require_new
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.plant import Robot

# A prismatic joint is to a revolute one as the end of a lever of this length to its axis [m]:
# plausible values are converted with it.
_LEVER = 0.1
# Units at a revolute joint: that at a prismatic one, and the power of the lever's length by which
# values are multiplied.
_AT_PRISMATIC_JOINT = {
    "Nm": ("N", -1),
    "Nm/rad": ("N/m", -2),
    "Nm s/rad": ("N s/m", -2),
    "Nm s^2/rad^2": ("N s^2/m^2", -3),
    "rad": ("m", 1),
    "rad/s": ("m/s", 1),
    "s/rad": ("s/m", -1),
    "rad/Nm": ("m/N", 2),
    "1/revolution": ("rad/m", -1),
    "kg m^2": ("kg", -2),
}

# Robots up to this mass are usual [kg]. One that is k times as heavy is taken for one of the same
# shape and density: what is plausible of it grows, by unit, with these powers of k.
_USUAL_MASS = 100.0
_WITH_MASS = {
    "kg": 1.0,
    "N": 1.0,
    "m": 1 / 3,
    "kg m": 4 / 3,
    "kg m^2": 5 / 3,
    "Nm": 4 / 3,
    "Nm/rad": 4 / 3,
    "Nm s/rad": 4 / 3,
    "Nm s^2/rad^2": 4 / 3,
    "N/m": 2 / 3,
    "N s/m": 2 / 3,
    "N s^2/m^2": 1 / 3,
    "rad/Nm": -4 / 3,
    "m/N": -2 / 3,
    "s/N": -1.0,
}

E = TypeVar("E", bound="Effect")


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect, with a value for each target (joint, body or foot).

    >>> from fbse_drake import Parameter
    >>> viscous = Parameter("Nm s/rad", linear=True, plausible=(0.0, 30.0))
    >>> viscous.at_prismatic_joint.unit
    'N s/m'
    """

    unit: str
    # Does what the effect adds depend on it linearly?
    linear: bool
    # What it plausibly is on a robot of up to 100 kg, see `factor_with`.
    plausible: tuple[float, float]
    # What it can be at all.
    bounds: tuple[float, float] = (0.0, np.inf)
    # For a nonlinear one: at how many points of its plausible range a search for it starts.
    grid: int = 9
    # For a nonlinear one: share of its value within which slopes over it hold.
    linear_within: float = np.inf
    # The value with which there is no effect, whatever the others are; targets that are not named
    # get it, if it is of a nonlinear one.
    neutral: float | None = None
    # For a linear one: what is believed of it beforehand is 0 with this standard deviation, so that
    # a log which does not show it does not make it large; by default nothing is believed.
    belief: float = np.inf
    # For one that is a share: its value where all is taken. What may be all of it is no share.
    everything: float = np.inf
    # For a nonlinear one: is what would lie beyond its plausible range something else?
    closed: bool = False
    # What it is, where its name does not say it.
    meaning: str = ""

    @property
    def lever_factor(self) -> float:
        """What a value at a revolute joint is multiplied with to make that of a prismatic joint."""
        return _LEVER ** _AT_PRISMATIC_JOINT.get(self.unit, (self.unit, 0))[1]

    @property
    def at_prismatic_joint(self) -> "Parameter":
        """The same for a prismatic joint, with m and N in the place of rad and Nm; its bounds,
        which are of no size, stay."""
        unit, _ = _AT_PRISMATIC_JOINT.get(self.unit, (self.unit, 0))
        return replace(self.enlarged(self.lever_factor), unit=unit)

    def factor_with(self, mass: float) -> float:
        """What plausible values are multiplied with for a robot of this mass [kg]."""
        return max(1.0, mass / _USUAL_MASS) ** _WITH_MASS.get(self.unit, 0.0)

    def enlarged(self, factor: float) -> "Parameter":
        """The same with plausible values that are so many times as large."""
        low, high = self.plausible
        return replace(self, plausible=(factor * low, factor * high))


@dataclass(frozen=True)
class Effect(ABC):
    """Base of all effects: a frozen dataclass with one field per parameter. A field holds values by
    target (`{all: 0.1, left_knee: 0.2}`); if the effect acts on the robot as a whole, a number. A
    linear parameter that is not given is 0.

    >>> from fbse_drake import CoulombFriction, load_description
    >>> friction = CoulombFriction(coulomb={"all": 0.3, "left_knee_pitch": 0.9})
    >>> biped, _ = load_description("biped")
    >>> values = friction.resolve(biped)
    >>> dict(zip(values.targets, values.linear[0].tolist()))["left_knee_pitch"]
    0.9
    >>> CoulombFriction.parameters_at("N")["coulomb"].unit  # of a joint that slides
    'N'
    """

    # One sentence each: what it is, what it looks like in data, which experiment shows it.
    description: ClassVar[str]
    signature: ClassVar[str]
    experiment: ClassVar[str]
    # By name, in the order of the fields.
    parameters: ClassVar[dict[str, Parameter]]
    # What its values are given for.
    acts_on: ClassVar[Literal["joint", "body", "foot", "robot"]] = "joint"
    # Other effects can say the same together; then the diagnosis does not try it.
    composite: ClassVar[bool] = False
    # It is of a motor, its drive or its gear: a joint without any has none of it.
    needs_motor: ClassVar[bool] = False
    # It is of a joint's second encoder, on the motor's side.
    needs_motor_encoder: ClassVar[bool] = False
    # It is of a base that is fixed to the world.
    needs_fixed_base: ClassVar[bool] = False
    # It is of torques that were measured: those that a controller commands are known as they are.
    needs_sampled_torque: ClassVar[bool] = False
    # What these do it does with the other sign: where both are, only the difference shows.
    opposites: ClassVar[tuple[type["Effect"], ...]] = ()
    # Its linear parameters enter linearly only about some values: a search makes it linear about
    # those that fit.
    linear_nearby: ClassVar[bool] = False

    @staticmethod
    def alternatives() -> tuple[type["Effect"], ...]:
        """What can stand for an effect in a scenario file (see `fbse_drake.schema`)."""
        return tuple(_LIBRARY.values())

    @classmethod
    def parameters_at(cls, unit: str) -> dict[str, Parameter]:
        """Its parameters at a joint whose torque has this unit: Nm, or N for a prismatic joint."""
        return (
            cls.parameters
            if unit == "Nm"
            else {name: parameter.at_prismatic_joint for name, parameter in cls.parameters.items()}
        )

    @classmethod
    def parameters_on(cls, robot: Robot, target: str) -> dict[str, Parameter]:
        """Its parameters on a target of a robot: in the units of that target, and as large as is
        plausible of such a robot."""
        names = robot.joint_names
        unit = robot.torque_units[names.index(target)] if target in names else "Nm"
        return {
            name: parameter.enlarged(parameter.factor_with(robot.total_mass))
            for name, parameter in cls.parameters_at(unit).items()
        }

    @classmethod
    def linear_beliefs(cls) -> np.ndarray:
        """Standard deviations of what is believed of its linear parameters, (p,)."""
        return np.array([p.belief for p in cls.parameters.values() if p.linear])

    @staticmethod
    def suspected_bodies(robot: Robot) -> list[str]:  # noqa: ARG004
        """Bodies that the diagnosis tries it on, of an effect that acts on bodies."""
        return []

    @classmethod
    def lowest_values(cls, robot: Robot, target: str) -> np.ndarray:  # noqa: ARG003
        """Smallest possible values of its linear parameters on a target, (p,); a fit does not go
        below them."""
        return np.array([p.bounds[0] for p in cls.parameters.values() if p.linear])

    @classmethod
    def from_values(
        cls: type[E], targets: Sequence[str], values: Mapping[str, Sequence[float] | np.ndarray]
    ) -> E:
        """The effect with these values of each parameter, target by target; other parameters and
        targets keep their defaults.

        Args:
            targets: joints, bodies or sides; one (any) name for an effect on the robot.
        """
        defaults, arguments = cls(), {}
        for name, numbers in values.items():
            given = dict(zip(targets, (float(number) for number in numbers), strict=True))
            arguments[name] = (
                getattr(defaults, name) | given
                if cls.acts_on != "robot"
                else next(iter(given.values()))
            )
        return cls(**arguments)

    def resolve(
        self, names: RobotDescription, *, key: str = "", is_change: bool = False
    ) -> "ResolvedEffect":
        """This effect with its values as arrays.

        Args:
            is_change: is it a change of a model, which may take away what that has, and whose
                linear parameters may so be below their bounds?

        Raises:
            InputError: unknown target, a value out of bounds, or a nonlinear parameter without a
                value.
        """
        targets = self._targets(names)
        given: dict[bool, list[np.ndarray]] = {True: [], False: []}
        for name, parameter in self.parameters.items():
            where = f"{key}.{name}".lstrip(".")
            values = self._values(
                name, targets, names, where, 0.0 if parameter.linear else parameter.neutral
            )
            low, high = parameter.bounds
            if is_change and parameter.linear:
                low = -np.inf
            if not np.all((low <= values) & (values <= high)):
                raise InputError(
                    f"{where}: expected values in [{low:g}, {high:g}] {parameter.unit}, found "
                    f"{values.tolist()}"
                )
            given[parameter.linear].append(values)
        columns = len(targets)
        linear, nonlinear = (
            np.array(values, dtype=float).reshape(len(values), columns)
            for values in (given[True], given[False])
        )
        return ResolvedEffect(type(self), targets, linear, nonlinear)

    def _targets(self, names: RobotDescription) -> list[str]:
        if self.acts_on == "joint":
            return names.joint_names
        if self.acts_on == "foot":
            return names.sides
        if self.acts_on == "robot":
            return ["robot"]
        # Bodies: those that are named; whether the model has them, the plant says.
        return list(dict.fromkeys(body for name in self.parameters for body in getattr(self, name)))

    def _values(
        self,
        name: str,
        targets: list[str],
        names: RobotDescription,
        key: str,
        default: float | None,
    ) -> np.ndarray:
        values = getattr(self, name)
        if self.acts_on == "joint":
            return names.per_joint(values, key=key, default=default)
        if self.acts_on == "robot":
            return np.array([values], dtype=float)
        for target in values:
            if target not in targets and target != "all":
                raise InputError(
                    f"{key}.{target}: unknown {self.acts_on} (allowed: "
                    f"{', '.join(['all', *targets])})"
                )
        result = [values.get(target, values.get("all", default)) for target in targets]
        if None in result:
            raise InputError(f"{key}: no value for {targets[result.index(None)]}")
        return np.array(result, dtype=float)


@dataclass(frozen=True)
class ResolvedEffect:
    """An effect with values per target."""

    effect: type[Effect]
    targets: list[str]
    # In the order of the effect's `parameters`; each of shape (parameters, targets).
    linear: np.ndarray
    nonlinear: np.ndarray

    def linear_values(self, name: str) -> np.ndarray:
        """Of one linear parameter, (targets,)."""
        names = [n for n, parameter in self.effect.parameters.items() if parameter.linear]
        return self.linear[names.index(name)]


_LIBRARY: dict[str, type[Effect]] = {}

T = TypeVar("T", bound=type[Effect])


def in_library(effect: T) -> T:
    """Class decorator: puts an effect into the library, under its class name.

    Raises:
        InputError: it lacks one of the class variables or a method, has a field without a
            parameter, or another effect has its name.
    """
    for name in ("description", "signature", "experiment", "parameters"):
        if not hasattr(effect, name):
            raise InputError(f"effect {effect.__name__}: the class variable {name} is missing")
    require_new(_LIBRARY, "effect", effect)
    names = [field.name for field in fields(effect)]
    if names != list(effect.parameters):
        raise InputError(
            f"effect {effect.__name__}: expected a dataclass with the fields "
            f"{list(effect.parameters)}, found {names}"
        )
    for name, parameter in effect.parameters.items():
        if not parameter.linear and not 0 < parameter.plausible[0] < parameter.plausible[1]:
            raise InputError(
                f"effect {effect.__name__}: parameter {name} is not linear, so it is searched in "
                "its plausible range: "
                f"expected 0 < low < high, found {parameter.plausible}"
            )
    _LIBRARY[effect.__name__] = effect
    return effect


def library() -> dict[str, type[Effect]]:
    """All effects by class name."""
    return dict(_LIBRARY)


def spaced(name: str) -> str:
    """An effect's class name for reading: `CoulombFriction` -> `Coulomb friction`."""
    words = "".join(f" {letter}" if letter.isupper() else letter for letter in name).split()
    first, rest = words[:1], words[1:]
    return " ".join(
        ["IMU" if word == "Imu" else word for word in first] + [w.lower() for w in rest]
    )
