"""How a motion and its torques become a log: rates, encoders, filters, and what is told of them."""

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.signal import butter, lfilter

from benchmarks.recorded.course import Course
from fbse_drake import Log
from fbse_drake.scenario import RecordingConfig, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig

Velocity: TypeAlias = Literal["measured", "low-passed", "differenced", "missing"]
Told: TypeAlias = Literal["nothing", "something", "everything"]
VELOCITIES: tuple[Velocity, ...] = get_args(Velocity)
TOLD: tuple[Told, ...] = get_args(Told)

# Of the angle that one count is: encoders of 12 to 20 bits.
_BITS = (12, 20)
# A velocity that is measured has noise of this many counts by second.
_GOOD = 4.0
# Deviation of a torque's noise, and one step of it, over what a joint needs at most.
_NOISE, _STEPS = (2e-4, 1e-2), (2e-3, 1e-2)


@dataclass(frozen=True)
class Recorder:
    """What records a machine; channels of the log are sampled at an instant."""

    # Of the log [s], a multiple of the course's.
    period: float
    bits: int
    velocity: Velocity
    # Low-pass of such velocities [Hz].
    corner: float
    # Over the largest torque of a joint; 0 for none.
    torque_noise: float
    torque_step: float
    # Torques are recorded behind a filter of this time constant [s]; 0 for none.
    late: float
    told: Told

    @property
    def count(self) -> float:
        """The angle of one count [rad]; also of a rail [m], whose motor turns once by metre."""
        return float(2 * np.pi / 2**self.bits)

    def text(self) -> str:
        torque = f"noise {self.torque_noise:.1g} step {self.torque_step:.1g} late {self.late:.1g}"
        return (
            f"{1 / self.period:.0f} Hz, {self.bits} bits, {self.velocity} velocity, torque: "
            f"{torque}, {self.told} told"
        )

    def log(
        self, random: np.random.Generator, joints: list[str], course: Course, torque: np.ndarray
    ) -> Log:
        """What it records of a course whose drives gave these torques, (N, n)."""
        every = round(self.period / course.period)
        largest = np.abs(course.torque).max(axis=0)
        if self.late:
            share = 1.0 - np.exp(-course.period / self.late)
            first = (1.0 - share) * torque[:1]
            torque, _ = lfilter([share], [1.0, share - 1.0], torque, axis=0, zi=first)
        angle = self.count * np.round(course.position / self.count)
        channels = {
            "time": course.time[::every],
            "joint/position": angle[::every],
            "joint/torque_command": self._in_steps(
                torque[::every]
                + self.torque_noise * largest * random.standard_normal(torque[::every].shape),
                largest,
            ),
        }
        if (velocity := self._velocity(random, course, angle, every)) is not None:
            channels["joint/velocity"] = velocity
        return Log(channels, {"joints": joints, "sides": [], "period": self.period})

    def _in_steps(self, torque: np.ndarray, largest: np.ndarray) -> np.ndarray:
        if self.torque_step == 0.0:
            return torque
        step = self.torque_step * largest
        return step * np.round(torque / step)

    def _velocity(
        self, random: np.random.Generator, course: Course, angle: np.ndarray, every: int
    ) -> np.ndarray | None:
        if self.velocity == "missing":
            return None
        if self.velocity == "measured":
            noise = _GOOD * self.count * random.standard_normal(course.velocity.shape)
            return (course.velocity + noise)[::every]
        step = every if self.velocity == "differenced" else 1
        read = angle[::step]
        before = np.concatenate([read[:1] - course.velocity[:1] * course.period * step, read[:-1]])
        velocity = (read - before) / (course.period * step)
        if self.velocity == "differenced":
            return velocity
        b, a = butter(1, self.corner, fs=1 / course.period)
        start = np.array([[(1 - b[0])]]) * velocity[:1]
        return lfilter(b, a, velocity, axis=0, zi=start)[0][::every]

    def scenario(self, joints: list[str], course: Course) -> tuple[SensorsConfig, RecordingConfig]:
        """What a user writes who knows nothing of it, its torques' noise, or all."""
        velocity: Literal["measured", "differenced"] = (
            "differenced" if self.velocity in ("differenced", "missing") else "measured"
        )
        if self.told == "nothing":
            return SensorsConfig(), RecordingConfig(rows="instantaneous")
        largest = np.abs(course.torque).max(axis=0)
        deviation = np.hypot(self.torque_noise, self.torque_step / np.sqrt(12.0)) * largest
        noise = dict(zip(joints, deviation.tolist(), strict=True))
        if self.told == "something":
            return SensorsConfig(), RecordingConfig(rows="instantaneous", torque_noise=noise)
        encoders = EncoderConfig(
            resolution=self.count,
            velocity_noise=_GOOD * self.count if self.velocity == "measured" else 0.0,
        )
        return SensorsConfig(encoders=encoders), RecordingConfig(
            rows="instantaneous", torque_noise=noise, velocity=velocity
        )


def random_recorder(random: np.random.Generator) -> Recorder:
    """From a cheap logger to a good one."""
    steps = random.random() < 0.4
    return Recorder(
        period=float(random.choice([0.001, 0.002, 0.004, 0.005, 0.008, 0.01])),
        bits=int(random.integers(_BITS[0], _BITS[1] + 1)),
        velocity=VELOCITIES[random.integers(len(VELOCITIES))],
        corner=float(random.uniform(20.0, 60.0)),
        torque_noise=float(np.exp(random.uniform(*np.log(_NOISE)))),
        torque_step=float(np.exp(random.uniform(*np.log(_STEPS)))) if steps else 0.0,
        late=float(random.choice([0.0, 0.0, 0.001, 0.003])),
        told=TOLD[random.integers(len(TOLD))],
    )
