"""Walks off the beaten path: those that were chosen, and those that nobody chose."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import exp, log

import numpy as np

PAPER_WALK, HRP2_WALK, TROT = "paper_walk_fbse", "hrp2_walk_fbse", "quadruped_trot"
_RANDOM, _RANDOM_TROT = "random", "trot"
# So often each disturbance of a random walk is there.
_CHANCE = 0.25


@dataclass(frozen=True)
class Case:
    """A walk, as overrides of a scenario."""

    name: str
    # What the estimators know of, and what only happens.
    told: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()
    scenario: str = PAPER_WALK


def _steps(single: float, double: float) -> Case:
    """Steps of other durations [s]."""
    timing = (f"reference.single_support={single}", f"reference.double_support={double}")
    return Case(f"steps of {single:g} / {double:g} s", told=timing)


def _biases(acceleration: float, angular_velocity: float) -> Case:
    """Biases of all axes of the IMU [m/s^2], [rad/s]."""
    sizes = {"acceleration": acceleration, "angular_velocity": angular_velocity}
    overrides = (f"sensors.imu.{name}_bias=[{b}, {-b}, {b}]" for name, b in sizes.items())
    name = f"IMU biases {acceleration:g} m/s^2, {angular_velocity:g} rad/s"
    return Case(name, untold=tuple(overrides))


def _foot_gain(gain: float) -> Case:
    """The left foot's sensors read so many times the force."""
    effect = f"robot.effects.foot_gain=!FootForceGain {{gain: {{left: {gain - 1:.3f}}}}}"
    return Case(f"foot force x {gain:g}, left foot", untold=(effect,))


def _foot_lag(time_constant: float) -> Case:
    """Both feet's sensors are read through a low-pass of this time constant [s]."""
    of_feet = ", ".join(f"{side}: {time_constant}" for side in ("left", "right"))
    effect = f"robot.effects.foot_lag=!FootForceLag {{time_constant: {{{of_feet}}}}}"
    return Case(f"foot forces behind a low-pass of {1e3 * time_constant:g} ms", untold=(effect,))


def _rotors(inertia: float) -> Case:
    """All joints have rotors of this reflected inertia that the model lacks [kg m^2]."""
    effect = f"robot.effects.rotors=!ReflectedInertia {{inertia: {{all: {inertia}}}}}"
    return Case(f"rotors of {inertia:g} kg m^2 that the model lacks", untold=(effect,))


def _transition(velocity: float) -> Case:
    """HRP-2's walk with a friction model that changes its sign over another velocity [rad/s]."""
    model = f"estimator.friction=!WholeBody {{model: {{transition: {{all: {velocity}}}}}}}"
    told = ("compensation=!NoCompensation {}", model)
    return Case(f"HRP-2, model's transition {velocity:g} rad/s", told, scenario=HRP2_WALK)


CASES = (
    Case("nominal"),
    _steps(0.5, 0.5),
    _steps(0.4, 0.3),
    Case("ground sloped by 2 deg", untold=("ground.slope=[0.0, 0.0349]",)),
    Case("ground of 1e5 N/m", untold=("ground.stiffness=1.0e5",)),
    Case(
        "thighs 1.2 kg heavier",
        untold=("robot.effects.thighs=!BodyMass {mass: {left_thigh: 1.2, right_thigh: 1.2}}",),
    ),
    Case("accelerometer bias 0.3 m/s^2", untold=("sensors.imu.acceleration_bias=[0.3, 0, 0]",)),
    _biases(0.05, 0.01),
    _biases(0.3, 0.05),
    Case("foot force noise x 3", untold=("sensors.foot_force.noise=1.5",)),
    Case("foot forces 5 ms late", untold=("sensors.foot_force.delay=0.005",)),
    Case("foot forces 12 ms late", untold=("sensors.foot_force.delay=0.012",)),
    _foot_lag(0.002),
    _foot_lag(0.005),
    _foot_gain(1.02),
    _foot_gain(0.95),
    _rotors(0.05),
    _rotors(0.2),
    Case("HRP-2, nominal", ("compensation=!NoCompensation {}",), scenario=HRP2_WALK),
    _transition(0.002),
    _transition(0.05),
)


def random_name(number: int) -> str:
    """Name of a random walk."""
    return f"{_RANDOM} {number}"


def trot_name(number: int) -> str:
    """Name of a random trot of the quadruped."""
    return f"{_RANDOM_TROT} {number}"


def case_of(name: str) -> Case:
    """The walk of this name, chosen or random."""
    kind, _, number = name.partition(" ")
    if kind == _RANDOM:
        return _random_case(int(number))
    if kind == _RANDOM_TROT:
        return _random_trot(int(number))
    (case,) = (case for case in CASES if case.name == name)
    return case


@dataclass(frozen=True)
class _Robot:
    """Where a robot may differ from its model, and how far."""

    # Bodies of another mass [kg] or centre of mass [m]; joints whose encoders are off; feet.
    masses: tuple[str, ...]
    centres: tuple[str, ...]
    encoders: tuple[str, ...]
    feet: tuple[str, ...]
    mass: float
    centre: float
    # Coulomb friction by kind of joint [Nm], and the largest reflected inertia [kg m^2].
    coulomb: dict[str, float]
    rotors: float


_BIPED = _Robot(
    masses=("left_thigh", "right_thigh", "trunk"),
    centres=("left_thigh", "right_shank", "trunk"),
    encoders=("left_knee_pitch", "right_hip_roll"),
    feet=("left", "right"),
    mass=1.0,
    centre=0.02,
    coulomb={
        "hip_yaw": 5,
        "hip_roll": 5,
        "hip_pitch": 6,
        "knee_pitch": 5,
        "ankle_pitch": 3,
        "ankle_roll": 2,
    },
    rotors=0.1,
)
_QUADRUPED = _Robot(
    masses=("front_left_thigh", "rear_right_shank", "trunk"),
    centres=("front_left_thigh", "rear_right_shank", "trunk"),
    encoders=("front_left_knee", "rear_right_hip_flexion"),
    feet=("front_left", "front_right", "rear_left", "rear_right"),
    mass=0.3,
    centre=0.015,
    coulomb={"hip_abduction": 0.8, "hip_flexion": 1.0, "knee": 1.2},
    rotors=0.015,
)


def _random_case(number: int) -> Case:
    """The walk of this number, the same each time: its steps, and what nobody tells the estimators
    of it."""
    random = np.random.default_rng(number)
    is_paper = bool(random.random() < 0.7)
    told = _random_steps(random) if is_paper else ("compensation=!NoCompensation {}",)
    untold = _drawn(random, _BIPED, other_friction=is_paper)
    return Case(random_name(number), told, untold, PAPER_WALK if is_paper else HRP2_WALK)


def _random_trot(number: int) -> Case:
    """The trot of this number, likewise."""
    random = np.random.default_rng(number)
    ranges = {
        "single_support": (0.15, 0.25),
        "double_support": (0.12, 0.3),
        "step_length": (-0.02, 0.04),
        "step_height": (0.02, 0.04),
    }
    told = _uniform(random, ranges)
    return Case(trot_name(number), told, _drawn(random, _QUADRUPED, other_friction=True), TROT)


def _drawn(random: np.random.Generator, robot: _Robot, other_friction: bool) -> tuple[str, ...]:
    """A share of all disturbances."""
    every = _disturbances(random, robot, other_friction)
    return tuple(text for text in every if random.random() < _CHANCE)


def _random_steps(random: np.random.Generator) -> tuple[str, ...]:
    """Times of both supports [s], lengths and heights [m]."""
    ranges = {
        "single_support": (0.4, 0.9),
        "double_support": (0.3, 1.0),
        "step_length": (0.04, 0.13),
        "step_height": (0.02, 0.05),
    }
    return _uniform(random, ranges)


def _uniform(
    random: np.random.Generator, ranges: dict[str, tuple[float, float]]
) -> tuple[str, ...]:
    """Values of the reference, as overrides."""
    return tuple(f"reference.{key}={random.uniform(*r):.3f}" for key, r in ranges.items())


def _disturbances(
    random: np.random.Generator, robot: _Robot, other_friction: bool
) -> Iterator[str]:
    """Every kind once, of a size that robots have."""

    def vector(size: float, axes: int = 3) -> str:
        return f"[{', '.join(f'{value:.4f}' for value in random.uniform(-size, size, axes))}]"

    def between(low: float, high: float) -> float:
        return exp(random.uniform(log(low), log(high)))

    def effect(name: str, **values: str) -> str:
        inside = ", ".join(f"{parameter}: {value}" for parameter, value in values.items())
        return f"robot.effects.wrong_{name}=!{name} {{{inside}}}"

    def one(*targets: str, size: float) -> str:
        return f"{{{random.choice(targets)}: {random.uniform(-size, size):.4f}}}"

    yield f"ground.slope={vector(0.03, axes=2)}"
    yield f"ground.stiffness={between(8e4, 1e6):.3g}"
    yield effect("BodyMass", mass=one(*robot.masses, size=robot.mass))
    yield effect("BodyCentreOfMass", x=one(*robot.centres, size=robot.centre))
    yield f"sensors.imu.acceleration_bias={vector(0.2)}"
    yield f"sensors.imu.angular_velocity_bias={vector(0.03)}"
    yield f"sensors.imu.misalignment={vector(0.01)}"
    yield effect("ImuPosition", **{axis: f"{random.uniform(-0.02, 0.02):.4f}" for axis in "xyz"})
    yield f"sensors.imu.acceleration_noise={between(0.01, 0.2):.3f}"
    yield f"sensors.encoders.velocity_noise={between(1e-4, 5e-3):.5f}"
    yield effect("EncoderOffset", offset=one(*robot.encoders, size=0.005))
    yield f"sensors.foot_force.noise={between(0.1, 3.0):.2f}"
    yield f"sensors.foot_force.delay={random.integers(1, 12) / 1000}"
    yield effect("FootForceGain", gain=one(*robot.feet, size=0.05))
    yield effect("ReflectedInertia", inertia=f"{{all: {random.uniform(0.0, robot.rotors):.3f}}}")
    if other_friction:
        size = between(0.3, 3.0)
        of_joints = ", ".join(f"{kind}: {size * nm:.2f}" for kind, nm in robot.coulomb.items())
        yield (
            f"robot.effects.joint_friction=!CoulombViscousFriction {{coulomb: {{{of_joints}}}, "
            f"viscous: {{all: {random.uniform(0.0, 3.0):.2f}}}, "
            f"transition: {{all: {between(0.005, 0.05):.4f}}}}}"
        )
