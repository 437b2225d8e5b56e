"""What a machine has beside its model. None of it is made with `fbse_drake.effects`, whose names it
only gives as the answer."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from benchmarks.recorded.course import Course
from benchmarks.recorded.machine import Link, Machine

# Friction changes its sign over about this speed [rad/s], [m/s].
_TRANSITION = 0.01
# A loss has such a share of what its joint needs, but never less than of the largest joint's.
_SHARE, _LEAST = (0.05, 0.4), 0.02
# Cycles of a ripple by radian.
_CYCLES = (6, 60)


@dataclass(frozen=True)
class Hidden:
    """One thing that the machine has and its model lacks."""

    # Effects of the library, each of which says it truly.
    names: tuple[str, ...]
    # Joints or bodies.
    targets: tuple[str, ...]
    # How much it is in each of them: what the first effect calls its first parameter. Nothing where
    # it has several of a kind, as a place in space has; of a tilt its angle.
    sizes: tuple[float, ...] = ()
    # Torque that it takes beside what the links need, (N, n), of a course.
    loss: Callable[[Course], np.ndarray] = field(default=lambda c: np.zeros_like(c.torque))
    # The machine that has it.
    change: Callable[[Machine], Machine] = field(default=lambda machine: machine)
    # What the drives are told to give that the joints shall get a torque, (N, n).
    told: Callable[[np.ndarray], np.ndarray] = field(default=lambda torque: torque)
    # What encoders read of a course.
    read: Callable[[Course], Course] = field(default=lambda course: course)


def random_physics(
    random: np.random.Generator, machine: Machine, course: Course
) -> tuple[Hidden, ...]:
    """Friction in all joints or none, and up to two things more; at times nothing at all."""
    draw = _Draw(random, machine, course)
    kinds = draw.kinds
    several = [draw.friction_everywhere()] if random.random() < 0.5 else []
    for kind in random.choice(list(kinds), size=random.integers(3), replace=False):
        several.append(kinds[str(kind)]())
    return tuple(several)


@dataclass(frozen=True)
class _Draw:
    random: np.random.Generator
    machine: Machine
    # Of the machine without what is hidden.
    course: Course

    @property
    def kinds(self) -> Mapping[str, Callable[[], Hidden]]:
        return {
            "coulomb": lambda: self._law("CoulombFriction", _sign, "StribeckFriction"),
            "viscous": lambda: self._law("ViscousFriction", lambda v: v),
            "drag": lambda: self._law("QuadraticDrag", lambda v: v * np.abs(v)),
            "stribeck": self._stribeck,
            "ripple": self._ripple,
            "spring": self._spring,
            "bias": self._bias,
            "gain": self._gain,
            "rotor": self._rotor,
            "mass": self._mass,
            "centre": self._centre,
            "load": self._load,
        }

    def friction_everywhere(self) -> Hidden:
        """Coulomb and viscous friction in every joint, of sizes of their own."""
        sizes = self._sizes * self.random.uniform(*_SHARE, (2, len(self._sizes)))
        slope = sizes[1] / self.course.velocity.std(axis=0)
        return Hidden(
            ("CoulombFriction", "ViscousFriction", "CoulombViscousFriction"),
            tuple(self.machine.joints),
            tuple(sizes[0].tolist()),
            lambda course: sizes[0] * _sign(course.velocity) + slope * course.velocity,
        )

    @property
    def _sizes(self) -> np.ndarray:
        """What each joint needs as it moves, root mean square, (n,)."""
        need = np.sqrt((self.course.torque**2).mean(axis=0))
        return np.maximum(need, _LEAST * need.max())

    def _joint(self) -> int:
        return int(self.random.integers(len(self.machine.joints)))

    def _size(self, joint: int) -> float:
        return float(self._sizes[joint] * np.exp(self.random.uniform(*np.log(_SHARE))))

    def _in_joint(
        self, names: tuple[str, ...], joint: int, size: float, law: Callable[[Course], np.ndarray]
    ) -> Hidden:
        """A loss in one joint, with a law that gives (N,)."""

        def loss(course: Course) -> np.ndarray:
            result = np.zeros_like(course.torque)
            result[:, joint] = law(course)
            return result

        return Hidden(names, (self.machine.joints[joint],), (abs(size),), loss)

    def _law(
        self, name: str, law: Callable[[np.ndarray], np.ndarray], *also: str, of_size: float = 1.0
    ) -> Hidden:
        """A law of the velocity, with a factor that makes it as large as losses are.

        Args:
            of_size: how much it is without that factor, see `Hidden.sizes`.
        """
        joint = self._joint()
        factor = self._size(joint) / _rms(law(self.course.velocity[:, joint]))
        return self._in_joint(
            (name, *also), joint, factor * of_size, lambda c: factor * law(c.velocity[:, joint])
        )

    def _stribeck(self) -> Hidden:
        """Friction of a joint at rest is larger, and falls with the square of the speed."""
        hump = 0.3 + self.random.uniform()
        return self._law(
            "StribeckFriction",
            lambda v: _sign(v) * (1.0 + hump * np.exp(-((v / 0.08) ** 2))),
            of_size=hump,
        )

    def _ripple(self) -> Hidden:
        joint, cycles = self._joint(), float(self.random.integers(*_CYCLES))
        if self.machine.links[joint].slides:
            cycles *= 10.0
        size, phase = 1.4 * self._size(joint), float(self.random.uniform(0, 6.3))
        return self._in_joint(
            ("TorqueRipple",),
            joint,
            size,
            lambda c: size * np.sin(cycles * c.position[:, joint] + phase),
        )

    def _spring(self) -> Hidden:
        joint = self._joint()
        rest = self.machine.posture[joint]
        stiffness = self._size(joint) / self.course.position[:, joint].std()
        return self._in_joint(
            ("JointSpring",), joint, stiffness, lambda c: stiffness * (c.position[:, joint] - rest)
        )

    def _bias(self) -> Hidden:
        joint = self._joint()
        size = float(self.random.choice([-1, 1])) * self._size(joint)
        return self._in_joint(("TorqueBias",), joint, size, lambda c: np.full(len(c.time), size))

    def _load(self) -> Hidden:
        joint, coefficient = self._joint(), float(self.random.uniform(0.03, 0.2))
        return self._in_joint(
            ("LoadDependentFriction",),
            joint,
            coefficient,
            lambda c: coefficient * np.abs(c.torque[:, joint]) * _sign(c.velocity[:, joint]),
        )

    def _gain(self) -> Hidden:
        joint = self._joint()
        gain = np.ones(len(self.machine.joints))
        wrong = float(self.random.choice([-1, 1]) * self.random.uniform(0.04, 0.2))
        gain[joint] += wrong
        return Hidden(
            ("TorqueGain",),
            (self.machine.joints[joint],),
            (abs(wrong),),
            told=lambda torque: torque / gain,
        )

    def _rotor(self) -> Hidden:
        joint = self._joint()
        more = self._size(joint) / self.course.acceleration[:, joint].std()
        return self._in_joint(
            ("ReflectedInertia",), joint, more, lambda c: more * c.acceleration[:, joint]
        )

    def _link(self) -> tuple[int, Link]:
        number = self._joint()
        return number, self.machine.links[number]

    def _mass(self) -> Hidden:
        number, link = self._link()
        mass = link.mass * (1.0 + float(self.random.uniform(0.15, 0.6)))
        return Hidden(
            ("BodyMass", "Payload"),
            (link.name,),
            (mass - link.mass,),
            change=lambda machine: machine.with_link(number, mass=mass, size=_as_heavy(link, mass)),
        )

    def _centre(self) -> Hidden:
        number, link = self._link()
        shift = self.random.normal(size=3)
        shift *= float(self.random.uniform(0.05, 0.25)) * link.size[2] / np.linalg.norm(shift)
        centre = tuple((np.array(link.centre) + shift).tolist())
        return Hidden(
            ("BodyCentreOfMass",),
            (link.name,),
            change=lambda machine: machine.with_link(number, centre=centre),
        )


def _as_heavy(link: Link, mass: float) -> tuple[float, float, float]:
    """Lengths that keep the moments about the centre of mass: the mass is added there."""
    x, y, z = np.sqrt(link.mass / mass) * np.array(link.size)
    return float(x), float(y), float(z)


def _sign(velocity: np.ndarray) -> np.ndarray:
    return np.tanh(velocity / _TRANSITION)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
