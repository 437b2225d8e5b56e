"""Logs of machines on a fixed base that nobody simulated: a motion is chosen, and the torques that
it needs are those of its inverse dynamics, sampled at an instant. What the model lacks is put into
them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.recorded.course import Course, inverse_dynamics, swings
from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.robot.plant import Robot, make_robot
from fbse_drake.scenario import RecordingConfig, RobotConfig, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.walking.reference import Recorded

VELOCITY_NOISE = 5e-4


@dataclass(frozen=True)
class Machine:
    """A machine, how it swings, and the noise of its torques."""

    description: str
    posture: tuple[float, ...]
    amplitude: tuple[float, ...]
    rotor_inertia: tuple[float, ...]
    # [Nm]
    torque_noise: tuple[float, ...]
    period: float = 4e-3
    duration: float = 8.0

    def by_joint(self, values: tuple[float, ...]) -> dict[str, float]:
        return dict(zip(self.joints, values, strict=True))

    @property
    def joints(self) -> list[str]:
        return self.robot().joint_names

    def robot(self, rotor_inertia: dict[str, float] | None = None) -> Robot:
        return make_robot(self.description, rotor_inertia=rotor_inertia or {})[0]

    @property
    def scenario(self) -> Scenario:
        """The machine that the model believes in."""
        body = RobotConfig(self.description, rotor_inertia=self.by_joint(self.rotor_inertia))
        return Scenario(
            duration=self.duration,
            robot=body,
            model=body,
            reference=Recorded(),
            sensors=SensorsConfig(encoders=EncoderConfig(velocity_noise=VELOCITY_NOISE)),
            recording=RecordingConfig(
                rows="instantaneous", torque_noise=self.by_joint(self.torque_noise)
            ),
        )

    def course(self, seed: int = 0, rotor_inertia: tuple[float, ...] | None = None) -> Course:
        """Every joint swings as three sines about its posture."""
        time = np.arange(round(self.duration / self.period) + 1) * self.period
        motion = self.motion(seed, time)
        robot = self.robot(self.by_joint(rotor_inertia or self.rotor_inertia))
        return Course(time, *motion, inverse_dynamics(robot, *motion))

    def motion(self, seed: int, time: np.ndarray) -> np.ndarray:
        """Positions, velocities and accelerations at any times, (3, N, n)."""
        random = np.random.default_rng(seed)
        return swings(random, time, np.array(self.posture), np.array(self.amplitude))

    def log(
        self,
        course: Course,
        torque: np.ndarray | None = None,
        seed: int = 0,
        read: Callable[[np.ndarray], np.ndarray] = np.array,
    ) -> Log:
        """What is recorded of a course.

        Args:
            torque: what the drives give; by default what the links get.
            seed: of the noise.
            read: what becomes of the measured torques when they are recorded, (N, n) to (N, n).
        """
        random = np.random.default_rng([seed, 7])
        given = course.torque if torque is None else torque
        channels = {
            "time": course.time,
            "joint/position": course.position,
            "joint/velocity": course.velocity
            + VELOCITY_NOISE * random.standard_normal(course.velocity.shape),
            "joint/torque_command": read(
                given + np.array(self.torque_noise) * random.standard_normal(given.shape)
            ),
        }
        meta = {"joints": self.joints, "sides": [], "period": self.period}
        return Log(channels, meta)

    def predictor(self, log: Log) -> Predictor:
        return Predictor(self.scenario, log)


ARM = Machine(
    "arm",
    posture=(0.0, 0.5, 0.2, 0.0, 0.3, 0.0),
    amplitude=(1.2, 0.5, 0.6, 1.2, 1.0, 1.5),
    rotor_inertia=(2.0, 2.0, 1.0, 0.2, 0.2, 0.1),
    torque_noise=(1.0, 1.0, 0.5, 0.2, 0.2, 0.1),
)
PENDULUM = Machine(
    "pendulum",
    posture=(0.4,),
    amplitude=(1.0,),
    rotor_inertia=(0.0,),
    torque_noise=(0.01,),
)
