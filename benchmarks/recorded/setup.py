"""How a machine was set up: its mount, the zeros of its encoders, the clock of its recorder."""

from dataclasses import replace

import numpy as np

from benchmarks.recorded.course import Course
from benchmarks.recorded.machine import Machine
from benchmarks.recorded.physics import Hidden
from fbse_drake import Log

# How often a machine is mounted askew, has an encoder whose zero is off, and stamps that scatter.
_ASKEW, _HOMED_BADLY, _STAMPED_LATE = 0.12, 0.12, 0.2
# By what angle [rad], and by what share of a period.
_TILT, _ZERO, _SCATTER = (0.01, 0.1), (0.01, 0.08), (0.02, 0.3)


def random_setup(random: np.random.Generator, machine: Machine) -> tuple[Hidden, ...]:
    """What of it the model does not know; mostly nothing."""
    askew, homed_badly = random.random(2) < (_ASKEW, _HOMED_BADLY)
    result = []
    if askew:
        heading, angle = random.uniform(0, 2 * np.pi), random.uniform(*_TILT)
        tilt = (float(angle * np.cos(heading)), float(angle * np.sin(heading)))
        sizes = (float(angle),)
        result.append(
            Hidden(("BaseTilt",), ("robot",), sizes, change=lambda m: replace(m, tilt=tilt))
        )
    turning = [k for k, link in enumerate(machine.links) if not link.slides]
    if homed_badly and turning:
        joint = int(random.choice(turning))
        offset = np.zeros(len(machine.links))
        offset[joint] = float(random.choice([-1, 1]) * random.uniform(*_ZERO))

        def read(course: Course) -> Course:
            return replace(course, position=course.position + offset)

        sizes = (float(abs(offset[joint])),)
        result.append(Hidden(("EncoderOffset",), (machine.joints[joint],), sizes, read=read))
    return tuple(result)


def stamped(random: np.random.Generator, log: Log) -> Log:
    """The log as a recorder stamps it, which at times comes to its samples by chance."""
    if random.random() > _STAMPED_LATE:
        return log
    scatter = random.uniform(*_SCATTER) * log.meta["period"]
    stamps = log.time + scatter * random.uniform(-1, 1, len(log.time))
    return Log(log.channels | {"time": stamps}, log.meta)
