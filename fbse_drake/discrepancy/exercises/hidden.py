"""Blind exercises: the log of a robot with physics that its model lacks, the answer sealed, and a
score for whoever finds it."""

import base64
import hashlib
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fbse_drake import schema
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnosis_json
from fbse_drake.discrepancy.diagnosis.written import written_diagnosis, written_study
from fbse_drake.discrepancy.exercises.sizes import SIZES, Size
from fbse_drake.discrepancy.exercises.strangers import STRANGERS
from fbse_drake.effects.effect import Effect, library, spaced
from fbse_drake.errors import InputError, located
from fbse_drake.files import from_json, read_json, to_json, write_text
from fbse_drake.log import Log
from fbse_drake.results import made_folder
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import Scenario, build_robot, dump_scenario
from fbse_drake.simulation import simulate
from fbse_drake.walking.reference import Reference, make_reference

Kind = Literal["library", "decoy", "stranger"]

# Share of exercises that hide nothing, and of those that hide a stranger.
_SHARE = 1 / 8
# A robot that falls gets half the size, this often.
_HALVINGS = 6
# A sealed answer that has more bytes is none.
_LARGEST_ANSWER = 2**20
# Step at which the reference is looked at [s].
_COARSE = 0.01


@dataclass(frozen=True)
class Draw:
    """What the values of an effect on one target are drawn from."""

    random: np.random.Generator
    # Of the joint along the reference, (N,) [rad], [Nm]; empty if the target is no joint.
    position: np.ndarray
    torque: np.ndarray

    def between(self, low: float, high: float) -> float:
        """A number, uniform in its logarithm."""
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def uniform(self, low: float, high: float) -> float:
        return float(self.random.uniform(low, high))

    def either(self, size: float) -> float:
        """The size with either sign."""
        return float(self.random.choice([-size, size]))

    def vector(self, size: float, names: Sequence[str]) -> dict[str, float]:
        """A vector of this length in any direction."""
        direction = self.random.normal(size=len(names))
        return dict(
            zip(names, (size * direction / np.linalg.norm(direction)).tolist(), strict=True)
        )


Values = Callable[[Draw, float], dict[str, float]]


@dataclass(frozen=True)
class Recipe:
    """How a hidden effect is drawn."""

    # From the smallest to the largest that is drawn; most often in the unit of the first parameter.
    sizes: tuple[float, float]
    # Values of the parameters for a size on one target.
    values: Values
    # Is it likely to be in all joints at once?
    everywhere: bool = False


def _one(name: str) -> Values:
    return lambda _, size: {name: size}


def _signed(name: str) -> Values:
    return lambda draw, size: {name: draw.either(size)}


def _vector(names: Sequence[str]) -> Values:
    return lambda draw, size: draw.vector(size, names)


def _load(draw: Draw, size: float) -> dict[str, float]:
    """A point mass near the origin of its body."""
    return {"mass": size} | draw.vector(draw.between(0.02, 0.1), "xyz")


def _sharp(draw: Draw) -> dict[str, float]:
    """The velocity over which friction changes its sign."""
    return {"transition": draw.between(0.005, 0.02)}


# The paper's robot still walks with the largest sizes on most joints; the smallest are near what
# its walk can show.
_RECIPES = {
    "TorqueGain": Recipe((0.01, 0.2), _signed("shortfall")),
    "TorqueBias": Recipe((1.0, 10.0), _signed("bias")),
    "TorqueDelay": Recipe((5e-4, 3e-3), _one("delay")),
    "TorqueLag": Recipe((5e-4, 3e-3), _one("time_constant")),
    "TorqueReadingLag": Recipe((5e-4, 3e-3), _one("time_constant")),
    # Size: the share of the joint's largest torque that is cut off.
    "TorqueSaturation": Recipe(
        (0.03, 0.2), lambda draw, size: {"limit": (1 - size) * float(np.abs(draw.torque).max())}
    ),
    "CoulombFriction": Recipe(
        (0.2, 8.0), lambda draw, size: {"coulomb": size, **_sharp(draw)}, everywhere=True
    ),
    "ViscousFriction": Recipe((0.2, 8.0), _one("viscous"), everywhere=True),
    "StribeckFriction": Recipe(
        (0.5, 5.0),
        lambda draw, size: {
            "gamma1": size,
            "gamma2": draw.between(60, 200),
            "gamma3": draw.between(5, 20),
            "gamma4": size * draw.uniform(0.5, 1.5),
            "gamma5": draw.between(60, 200),
            "gamma6": size * draw.uniform(0.2, 1.0),
        },
        everywhere=True,
    ),
    "DirectionalFriction": Recipe(
        (0.5, 5.0), lambda draw, size: {"asymmetry": draw.either(size), **_sharp(draw)}
    ),
    "DirectionalViscousFriction": Recipe((0.2, 8.0), _signed("asymmetry")),
    "LoadDependentFriction": Recipe(
        (0.01, 0.2), lambda draw, size: {"coefficient": size, **_sharp(draw)}, everywhere=True
    ),
    "QuadraticDrag": Recipe((0.5, 8.0), _one("drag")),
    "ThermalDrift": Recipe(
        (1.0, 10.0),
        lambda draw, size: {"change": size, "warm_up": draw.between(2, 15), **_sharp(draw)},
    ),
    "TorqueRipple": Recipe(
        (0.3, 3.0),
        lambda draw, size: {
            **draw.vector(size, ("sine", "cosine")),
            "cycles": draw.between(10, 200),
        },
    ),
    "JointSpring": Recipe(
        (5.0, 60.0),
        lambda draw, size: {"stiffness": size, "preload": size * draw.uniform(-0.3, 0.3)},
    ),
    "Counterbalance": Recipe((5.0, 60.0), _vector(("cosine", "sine"))),
    "PreslidingHysteresis": Recipe(
        (0.5, 8.0), lambda draw, size: {"coulomb": size, "displacement": draw.between(2e-3, 2e-2)}
    ),
    "Backlash": Recipe(
        (5e-4, 5e-3), lambda draw, size: {"gap": size, "rotor_inertia": draw.between(0.1, 0.5)}
    ),
    "ReflectedInertia": Recipe((0.02, 0.4), _one("inertia"), everywhere=True),
    "BodyMass": Recipe((0.2, 4.0), _one("mass")),
    "BodyCentreOfMass": Recipe((4e-3, 3e-2), _vector("xyz")),
    "Payload": Recipe((0.3, 4.0), _load),
    "LinkLength": Recipe((2e-3, 1e-2), _signed("length")),
    "GroundSlope": Recipe((4e-3, 4e-2), _vector("xy")),
    "BaseTilt": Recipe((4e-3, 4e-2), _vector("xy")),
    "GroundCompliance": Recipe((5e-7, 5e-6), _one("compliance")),
    "FootCreep": Recipe((1e-3, 2e-2), _one("creep")),
    "FootForceGain": Recipe((5e-3, 0.1), _signed("gain")),
    "FootForceBias": Recipe((1.0, 10.0), _vector("xyz")),
    "AccelerometerBias": Recipe((0.05, 0.4), _vector("xyz")),
    "GyroscopeBias": Recipe((2e-3, 4e-2), _vector("xyz")),
    "ImuMisalignment": Recipe((5e-3, 4e-2), _vector("xyz")),
    "ImuPosition": Recipe((1e-2, 5e-2), _vector("xyz")),
    "EncoderOffset": Recipe((1e-3, 1e-2), _signed("offset")),
    "MotorEncoderOffset": Recipe((1e-3, 1e-2), _signed("offset")),
    "TransmissionElasticity": Recipe(
        (1e-5, 1e-4),
        lambda draw, size: {"compliance": size, "time_constant": draw.between(5e-3, 1.5e-2)},
    ),
    # Strangers.
    "TorqueHum": Recipe(
        (1.0, 5.0), lambda draw, size: {"amplitude": size, "frequency": draw.between(1, 8)}
    ),
    "NeighbourTorque": Recipe((0.03, 0.15), _signed("share")),
    "UnevenFriction": Recipe(
        (1.0, 8.0), lambda draw, size: {"coulomb": size, "unevenness": draw.uniform(0.6, 1.0)}
    ),
    "TorqueDropouts": Recipe((0.2, 0.8), _one("depth")),
    "RoughSpot": Recipe(
        (2.0, 12.0),
        lambda draw, size: {
            "coulomb": size,
            "angle": float(np.quantile(draw.position, draw.uniform(0.2, 0.8))),
            # A joint that stands still in the plan trembles.
            "width": max(1e-3, 0.15 * float(np.ptp(draw.position))),
        },
    ),
}


def _recipe(effect: type[Effect]) -> Recipe:
    """The recipe of an effect; one of a user's own gets a tenth to a half of the largest plausible
    value."""
    if effect.__name__ in _RECIPES:
        return _RECIPES[effect.__name__]
    name, parameter = next(iter(effect.parameters.items()))
    largest = max(abs(bound) for bound in parameter.plausible)
    return Recipe((0.1 * largest, 0.5 * largest), _one(name))


@dataclass(frozen=True)
class HiddenEffect:
    """An effect that the robot has and its model lacks."""

    effect: str
    # Joints, bodies, sides or `robot`.
    targets: tuple[str, ...]
    # In the unit of its recipe.
    size: float
    # By parameter and target.
    parameters: dict[str, dict[str, float]]

    def __post_init__(self) -> None:
        if not self.targets:
            raise InputError("targets: expected at least one, found none")
        for name, values in self.parameters.items():
            if missing := [target for target in self.targets if target not in values]:
                raise InputError(f"parameters.{name}: no value for {missing[0]}")

    @property
    def kind(self) -> type[Effect]:
        return (library() | STRANGERS)[self.effect]

    def make(self) -> Effect:
        return self.kind.from_values(
            self.targets, {name: list(values.values()) for name, values in self.parameters.items()}
        )

    def exceeds(self, target: str, size: float | None) -> bool:
        """Is it larger on a target than with this size of its first parameter?

        Of a vector the length counts; a limit is the larger an effect the lower it is.

        Args:
            size: in the parameter's unit; None for more than any.
        """
        if size is None or not np.isfinite(size):
            return False
        known = self.kind.parameters
        first, parameter = next(iter(known.items()))
        if not parameter.linear:
            value = self.parameters[first][target]
            return value < size if parameter.neutral == np.inf else value > size
        alike = [name for name in self.parameters if known[name].unit == parameter.unit]
        vector = [self.parameters[name][target] for name in alike if known[name].linear]
        return float(np.linalg.norm(vector)) > size


@dataclass(frozen=True)
class Answer:
    """What an exercise hides: library effects or a stranger; a decoy hides nothing."""

    kind: Kind
    # As it was drawn, and by how much it was made smaller for the robot not to fall.
    size: Size
    shrunk: float
    effects: tuple[HiddenEffect, ...]

    def __post_init__(self) -> None:
        if bool(self.effects) == (self.kind == "decoy"):
            raise InputError(f"effects: expected some unless the kind is decoy, found {self.kind}")


@dataclass(frozen=True)
class Exercise:
    """A log to find the missing physics in."""

    # Without what is hidden; the model has all the rest.
    scenario: Scenario
    # What sensors measured and what was commanded.
    log: Log
    answer: Answer

    def save(self, folder: str | Path) -> None:
        """Writes log.npz, scenario.yaml, and the answer sealed (answer.sealed) to a folder."""
        out = made_folder(folder)
        self.log.save(out / "log.npz")
        write_text(out / "scenario.yaml", self.log.meta["scenario"])
        write_text(out / "answer.sealed", seal(self.answer))

    def reveal(self, *diagnoses: Diagnosis) -> "Revealed":
        """The answer, with a score for what was found; of a study its `diagnoses`, in order."""
        found = [diagnosis_json(diagnosis) for diagnosis in diagnoses]
        return Revealed(self.answer, score(self.answer, found) if found else None)


def draw(
    scenario: Scenario,
    seed: int,
    *,
    what: str = "any",
    size: Size | None = None,
    count: int = 1,
    shrunk: float = 1.0,
) -> Answer:
    """Draws what is hidden.

    Args:
        scenario: whose robot it is hidden in.
        seed: the same seed hides the same.
        what: `any` of what follows (one in eight hides nothing, one in eight a stranger), `library`
            for effects of the library, `decoy` for none, `stranger` for one that the library does
            not have, or the name of an effect or stranger.
        size: a third of the sizes of each effect's recipe (in logarithms); by default drawn as
            well.
        count: how many different effects, where the library's are drawn; if more than one, each on
            one joint.
        shrunk: factor on all sizes.

    Raises:
        InputError: unknown effect or size, or more effects than the robot can have.
    """
    known = {name: effect for name, effect in library().items() if not effect.composite}
    kinds = ("any", "library", "decoy", "stranger")
    if what not in (*kinds, *known, *STRANGERS):
        raise InputError(
            f"what: expected one of {', '.join((*kinds, *known, *STRANGERS))}, found {what}"
        )
    if size not in (None, *SIZES):
        raise InputError(f"size: expected one of {', '.join(SIZES)}, found {size}")
    random = np.random.default_rng(seed)
    robot = build_robot(scenario.robot)
    chance, drawn_size = random.random(), SIZES[random.integers(len(SIZES))]
    size = size or drawn_size
    if what == "any":
        what = "decoy" if chance < _SHARE else "stranger" if chance < 2 * _SHARE else "library"
    if what == "decoy":
        return Answer("decoy", size, 1.0, ())
    pool = STRANGERS if what == "stranger" or what in STRANGERS else known
    if what in pool:
        names = [what]
    else:
        possible = [name for name, effect in pool.items() if _possible(effect, scenario, robot)]
        if not 0 < count <= len(possible):
            raise InputError(f"count: expected 1 to {len(possible)} effects, found {count}")
        names = [
            str(name)
            for name in random.choice(possible, 1 if pool is STRANGERS else count, replace=False)
        ]
    reference = make_reference(
        scenario.reference, robot, np.arange(round(scenario.duration / _COARSE) + 1) * _COARSE
    )
    hidden: list[HiddenEffect] = []
    for name in names:
        taken = [target for other in hidden for target in other.targets]
        targets = _targets(random, pool[name], robot, taken, alone=len(names) > 1)
        low, high = _recipe(pool[name]).sizes
        amount = shrunk * low * (high / low) ** ((SIZES.index(size) + random.random()) / len(SIZES))
        hidden.append(_hidden_effect(random, pool[name], targets, amount, robot, reference))
    return Answer("stranger" if pool is STRANGERS else "library", size, shrunk, tuple(hidden))


def _hidden_effect(
    random: np.random.Generator,
    effect: type[Effect],
    targets: tuple[str, ...],
    size: float,
    robot: Robot,
    reference: Reference,
) -> HiddenEffect:
    """An effect of a size: the same on every target, but on all joints different."""
    draws = []
    for target in targets:
        joints = [robot.joint_names.index(target)] if effect.acts_on == "joint" else []
        draws.append(
            Draw(
                random, reference.joint_position[:, joints], reference.feedforward_torque[:, joints]
            )
        )
    recipe = _recipe(effect)
    if len(targets) == len(_joints(effect, robot)):
        values = [recipe.values(draw, size * draw.uniform(0.5, 1.0)) for draw in draws]
    else:
        values = [recipe.values(draws[0], size)] * len(targets)
    parameters = {
        name: dict(zip(targets, (of_target[name] for of_target in values), strict=True))
        for name in values[0]
    }
    return HiddenEffect(effect.__name__, targets, size, parameters)


def _possible(effect: type[Effect], scenario: Scenario, robot: Robot) -> bool:
    """Can the robot have it, and its log show it? In a gantry, only in its joints or its mount;
    feet creep only if the contact solver lets them, few robots have second encoders, and commands
    are no measurements."""
    if effect.needs_motor_encoder and scenario.sensors.motor_encoders is None:
        return False
    if effect.needs_sampled_torque and not scenario.recording.is_sampled:
        return False
    if effect.__name__ == "FootCreep" and scenario.plant.discrete_contact_approximation not in (
        "lagged",
        "similar",
    ):
        return False
    return effect.acts_on == "joint" or robot.has_floating_base != effect.needs_fixed_base


def _targets(
    random: np.random.Generator,
    effect: type[Effect],
    robot: Robot,
    taken: Collection[str],
    *,
    alone: bool,
) -> tuple[str, ...]:
    """One target, none of those taken; or, unless it is to be alone, a joint of every leg, or all
    joints."""
    names = robot.description
    if effect.acts_on == "robot":
        return ("robot",)
    if effect.acts_on == "foot":
        return (str(random.choice(names.sides)),)
    if effect.acts_on == "body":
        return (str(random.choice(effect.suspected_bodies(robot))),)
    joints = _joints(effect, robot)
    chance, joint = (
        random.random(),
        str(random.choice([joint for joint in joints if joint not in taken])),
    )
    if alone or chance < 0.5 or len(joints) == 1:
        return (joint,)
    if _recipe(effect).everywhere and chance < 0.75:
        return tuple(joints)
    return names.counterparts(joint)


def _joints(effect: type[Effect], robot: Robot) -> list[str]:
    """Joints that can have an effect."""
    passive = robot.description.passive if effect.needs_motor else []
    return [joint for joint in robot.joint_names if joint not in passive]


def make_exercise(
    scenario: Scenario,
    name: str,
    seed: int,
    *,
    what: str = "any",
    size: Size | None = None,
    count: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Exercise:
    """Hides something in a scenario's robot and records it.

    If the robot falls, what is hidden is made half as large until it does not.

    Args:
        name: what the scenario is called in the log.
        seed: decides on everything, sensor noise included.
        what, size, count: see `draw`.
        progress: called with the simulated time [s].

    Raises:
        InputError: see `draw` and `simulate`; or nothing is small enough for the robot.
    """
    for halving in range(_HALVINGS):
        answer = draw(scenario, seed, what=what, size=size, count=count, shrunk=0.5**halving)
        exercise = record(scenario, name, answer, seed, progress=progress)
        outcome = exercise.log.meta["outcome"]
        if outcome["finished"]:
            return exercise
    raise InputError(f"nothing can be hidden in this scenario: {outcome['reason']}")


def record(
    scenario: Scenario,
    name: str,
    answer: Answer,
    seed: int,
    *,
    progress: Callable[[float], None] | None = None,
) -> Exercise:
    """Simulates a scenario's robot with what is hidden in it.

    The model becomes the robot's twin: it lacks what is hidden, and nothing else.

    Args:
        name: what the scenario is called in the log.
        seed: of the sensor noise, in a way that the scenario does not tell.
        progress: called with the simulated time [s].

    Raises:
        InputError: see `simulate`.
        KeyboardInterrupt: half a log is no exercise.
    """
    public = replace(scenario, model=scenario.robot)
    noise = int(np.random.default_rng([seed, 1]).integers(2**31))
    effects = scenario.robot.effects | {
        f"hidden_{k}": hidden.make() for k, hidden in enumerate(answer.effects)
    }
    result = simulate(
        replace(public, seed=noise, robot=replace(scenario.robot, effects=effects)),
        name=name,
        progress=progress,
    )
    outcome = result.log.meta["outcome"]
    if not outcome["finished"] and not outcome["fell"]:
        raise KeyboardInterrupt
    channels = {
        key: values
        for key, values in result.log.items()
        if not key.startswith(("truth/", "estimate/"))
    }
    return Exercise(
        public, Log(channels, result.log.meta | {"scenario": dump_scenario(public, name)}), answer
    )


def seal(answer: Answer) -> str:
    """Text of an answer that nobody reads by accident: a checksum, then the answer."""
    content = zlib.compress(to_json(asdict(answer)).encode())
    return f"{hashlib.sha256(content).hexdigest()}\n{base64.b64encode(content).decode()}\n"


def unseal(text: str) -> Answer:
    """Opens what `seal` made.

    Raises:
        InputError: it is not what it was.
    """
    try:
        checksum, content = text.split()
        data = base64.b64decode(content, validate=True)
        if hashlib.sha256(data).hexdigest() != checksum:
            raise ValueError
        opened = zlib.decompressobj()
        tree = from_json(opened.decompress(data, _LARGEST_ANSWER))
        if not opened.eof:
            raise ValueError
    except (ValueError, zlib.error):
        raise InputError("the sealed answer is damaged") from None
    return schema.build(Answer, tree, file="the sealed answer is damaged")


def reveal(folder: Path) -> "Revealed":
    """Opens the answer of an exercise; scores the diagnosis or study in the same folder, if there
    is one.

    Raises:
        InputError: no exercise, a damaged answer or diagnosis.
    """
    path = folder / "answer.sealed"
    try:
        answer = unseal(path.read_text(encoding="utf-8", errors="replace"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; fbse hide makes one") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    for file in (folder / "study.json", folder / "diagnosis.json"):
        if file.exists():
            content = read_json(file)
            with located(f"{file}: "):
                diagnoses = (
                    written_study(content).diagnoses
                    if file.stem == "study"
                    else [written_diagnosis(content)]
                )
            return Revealed(answer, score(answer, [asdict(diagnosis) for diagnosis in diagnoses]))
    return Revealed(answer, None)


@dataclass(frozen=True)
class Score:
    """How good a diagnosis of an exercise is."""

    # Does the verdict fit? `effect_found` for effects of the library, `unknown_effect` for a
    # stranger; a decoy has nothing missing, nor has a log that cannot show what is hidden, or in
    # which it is said to be too small to matter.
    verdict: bool
    # By hidden effect of the library: is it found, or larger than the smallest size that the
    # diagnosis says would have shown; was it found, or an effect that is declared to say the same;
    # and on exactly its targets?
    visible: dict[str, bool]
    found: dict[str, bool]
    confusable: dict[str, bool]
    targets: dict[str, bool]
    # Is the first of the ranking hidden?
    first: bool
    # Effects that the diagnosis chose although they are not hidden, nor said to be confusable with
    # one that is.
    wrong: tuple[str, ...]
    # Does the interval hold the true value? By effect, target and parameter, of what was found; one
    # target for a shared value.
    covered: dict[str, bool]
    # For a stranger: are exactly its joints said to have something unexplained?
    joints: bool

    @property
    def text(self) -> str:
        """As `Verdict: right; Coulomb friction found.`"""
        parts = [f"Verdict: {'right' if self.verdict else 'wrong'}"]
        for name, hit in self.found.items():
            said = "" if hit or self.visible[name] else ", and too small to show in this log"
            parts.append(f"{spaced(name)} {'found' if hit else 'not found'}{said}")
        return f"{'; '.join(parts)}."


@dataclass(frozen=True)
class Revealed:
    """The answer of an exercise, and how good a diagnosis of it is, if there is one."""

    answer: Answer
    score: Score | None

    @property
    def outcome(self) -> str:
        """What was hidden, and whether it was found."""
        hidden = "; ".join(
            f"{spaced(effect.effect)} in {', '.join(effect.targets)}"
            for effect in self.answer.effects
        )
        lines = [f"Hidden: {hidden}." if hidden else "Nothing was hidden."]
        return " ".join([*lines, *([self.score.text] if self.score else [])])

    def json(self) -> dict[str, Any]:
        """Contents of answer.json."""
        return asdict(self)

    def _repr_html_(self) -> str:
        from fbse_drake.report.html import render_fragment

        return render_fragment(self.outcome, ())


def score(answer: Answer, diagnoses: Sequence[Mapping[str, Any]]) -> Score:
    """Compares an answer with what was found.

    Args:
        diagnoses: contents of diagnosis.json of each round.
    """
    chosen = [
        finding for diagnosis in diagnoses for finding in diagnosis["ranking"] if finding["chosen"]
    ]
    # What is small and said to be so is found, too; but who names something too small to matter
    # claims nothing.
    small = [
        finding
        for diagnosis in diagnoses
        for finding in diagnosis["ranking"]
        if finding.get("too_small", False)
    ]
    hidden = (
        {effect.effect: effect for effect in answer.effects} if answer.kind == "library" else {}
    )

    statuses = diagnoses[0].get("effects", {})
    visible, found, confusable, targets = {}, {}, {}, {}
    covered: dict[str, bool] = {}
    for name, effect in hidden.items():
        named = [finding for finding in [*chosen, *small] if finding["effect"] == name]
        found[name] = bool(named)
        # What a diagnosis says nothing of is not excused.
        shown = statuses.get(name, {}).get("smallest_detectable_by_target", {})
        visible[name] = (
            found[name]
            or not shown
            or any(effect.exceeds(target, shown.get(target)) for target in effect.targets)
        )
        confusable[name] = not named and any(
            name in finding["confusable_with"] for finding in chosen
        )
        targets[name] = {target for finding in named for target in finding["joints"]} == set(
            effect.targets
        )
        for finding in named:
            shared = [target for target in effect.targets if target in finding["joints"]]
            for parameter, estimate in finding["parameters"].items():
                low, high = estimate["interval"]
                # Targets that share a value share its interval, which counts once.
                truth = (
                    {effect.parameters[parameter][target]: target for target in shared}
                    if parameter in effect.parameters
                    else {}
                )
                covered |= {
                    f"{name}.{target}.{parameter}": low <= value <= high
                    for value, target in truth.items()
                }
    wrong = [f["effect"] for f in chosen if not {f["effect"], *f["confusable_with"]} & set(hidden)]
    names_nothing = diagnoses[0]["verdict"] in ("nothing_missing", "not_visible")
    said_to_be_small = {finding["effect"] for finding in small}
    unnamed = [name for name, shows in visible.items() if shows and name not in said_to_be_small]
    verdict = {
        "library": diagnoses[0]["verdict"] == "effect_found" or (names_nothing and not unnamed),
        "decoy": names_nothing,
        "stranger": diagnoses[-1]["verdict"] == "unknown_effect",
    }[answer.kind]
    # Rows of joints are called like the joints, others have a slash in their names.
    unexplained = {row["row"] for row in diagnoses[-1]["unexplained"] if "/" not in row["row"]}
    return Score(
        verdict,
        visible,
        found,
        confusable,
        targets,
        bool(chosen) and chosen[0]["effect"] in hidden,
        tuple(dict.fromkeys(wrong)),
        covered,
        answer.kind == "stranger" and unexplained == set(answer.effects[0].targets),
    )
