"""Joint encoders."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    State,
)
from pydrake.systems.primitives import Adder

from fbse_drake.errors import InputError, require_not_negative, require_positive, required
from fbse_drake.log import Log
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.errors import held_signal, ticks_until, white_noise
from fbse_drake.sensors.sensor import Run, Sensor, in_library
from fbse_drake.signals import Signal, signals_of
from fbse_drake.wiring import weakly

# Time constant of the smoothing of joint velocities that are differentiated from angles [s]. Short:
# estimators believe in noise, but not in lag.
_DIFFERENTIATION_TIME = 0.001
# The same where the clock that stamps the samples jitters, which differences take for motion; from
# so much of a period on.
_JITTER_TIME, _JITTER = 0.004, 0.05


@in_library
@dataclass(frozen=True)
class EncoderConfig(Sensor):
    """Angles are read as `resolution * round((angle + noise) / resolution)`."""

    has_own_key: ClassVar[bool] = True
    signals: ClassVar[tuple[Signal, ...]] = signals_of("measured_joint_state")
    whole_steps: ClassVar[tuple[str, ...]] = ("period",)

    # One count [rad]; 0 reads exactly. A 17-bit encoder has 2 pi / 2^17 = 4.8e-5.
    resolution: float = 0.0
    # Standard deviation of the angle before it is rounded [rad].
    noise: float = 0.0
    # How the velocity is had: `exact` (a tachometer with `velocity_noise`) or `differenced` from
    # two readings.
    velocity: str = "exact"
    # Standard deviation of an `exact` velocity [rad/s].
    velocity_noise: float = 0.0
    # Sampling period [s], held in between; by default `Scenario.usual_period`.
    period: float | None = None

    def __post_init__(self) -> None:
        require_not_negative(self, "resolution", "noise", "velocity_noise")
        if self.velocity not in ("exact", "differenced"):
            raise InputError(f"velocity: expected exact or differenced, found {self.velocity}")
        require_positive(self, "period")

    @property
    def angle_noise(self) -> float:
        """Standard deviation of an angle as it is read [rad]."""
        return math.hypot(self.noise, self.resolution / math.sqrt(12.0))

    def system(self, robot: Robot, run: Run) -> "Encoders":
        return Encoders(self, len(robot.joint_names), run.seed, run.duration)

    def readings(self, robot: Robot, log: Log) -> dict[str, np.ndarray]:
        """Without `joint/velocity` the angles are differentiated and smoothed."""
        if "joint/velocity" not in log:
            smoothing = _smoothing_time(log.time, float(log.meta["period"]))
            velocity = differentiate(log.time, log["joint/position"], smoothing)
            log = replace(log, channels={**log.channels, "joint/velocity": velocity})
        return super().readings(robot, log)


def _smoothing_time(time: np.ndarray, period: float) -> float:
    """Time constant for `differentiate` [s]; samples may be missing, which is no jitter."""
    periods = np.diff(time) / period
    jitter = np.sqrt(np.mean((periods - np.round(periods)) ** 2)) if len(periods) else 0.0
    return _JITTER_TIME if jitter > _JITTER else _DIFFERENTIATION_TIME


def differentiate(time: np.ndarray, position: np.ndarray, time_constant: float) -> np.ndarray:
    """Causal velocity of sampled angles: differences behind two low-passes of first order.

    Args:
        time: (N,) [s]; position: (N, n) [rad]; time_constant: of each low-pass [s].

    Returns:
        Shape (N, n) [rad/s].
    """
    velocity = np.zeros_like(position)
    stage = np.zeros((2, position.shape[1]))
    for k in range(1, len(time)):
        elapsed = time[k] - time[k - 1]
        keep = np.exp(-elapsed / time_constant)
        stage[0] = keep * stage[0] + (1 - keep) * (position[k] - position[k - 1]) / elapsed
        stage[1] = keep * stage[1] + (1 - keep) * stage[0]
        velocity[k] = stage[1]
    return velocity


def differentiated_noise(noise: float, period: float) -> float:
    """White noise of angles in the velocity that `readings` makes of them [rad/s].

    Args:
        noise: standard deviation of an angle [rad]; period: between angles [s].
    """
    smoothed = math.sqrt(period / (4.0 * _DIFFERENTIATION_TIME**3))
    return noise * min(smoothed, math.sqrt(2.0) / period)


def quantize(angle: np.ndarray, resolution: float) -> np.ndarray:
    """Angle [rad], or another quantity, in whole counts; a resolution of 0 leaves it as it is."""
    return angle if resolution == 0 else resolution * np.rint(angle / resolution)


@njit(cache=True)
def _read(measured: np.ndarray, joint_state: np.ndarray, resolution: float) -> None:
    """Fills what is measured, with whole counts of the angles."""
    for j in range(len(measured)):
        measured[j] = joint_state[j]
    if resolution > 0:
        for j in range(len(measured) // 2):
            measured[j] = resolution * np.rint(measured[j] / resolution)


class EncoderReadings(LeafSystem):
    """Counts of the encoders and the velocities had from them.

    .. pydrake_system::

        name: EncoderReadings
        input_ports:
        - joint_state
        output_ports:
        - measured_joint_state

    Both are [positions, velocities], shape (2n,) [rad, rad/s]. The output is the reading of the
    present tick (it is meant to be sampled at the encoders' ticks). Discrete state: the reading of
    the last tick, for a differenced velocity.
    """

    def __init__(self, config: EncoderConfig, joints: int):
        super().__init__()
        self._config, self._n = config, joints
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * joints)
        # Before the first tick there is no last reading (NaN).
        self._last = self.DeclareDiscreteState(np.full(joints, np.nan))
        sources = {self.input_port_ticket(self._joint_state.get_index()), self.xd_ticket()}
        self.measured_joint_state = self.DeclareVectorOutputPort(
            "measured_joint_state", 2 * joints, weakly(self._calc), sources
        )
        if config.velocity == "differenced":
            period = required(config.period, "period")
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, weakly(self._remember))

    def _calc(self, context: Context, output: BasicVector) -> None:
        config, n, measured = self._config, self._n, output.get_mutable_value()
        _read(measured, self._joint_state.Eval(context), config.resolution)
        if config.velocity == "differenced":
            last = context.get_discrete_state(self._last).value()
            measured[n:] = 0.0 if np.isnan(last[0]) else (measured[:n] - last) / config.period

    def _remember(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._last).set_value(
            self.measured_joint_state.Eval(context)[: self._n]
        )


class Encoders(Diagram):
    """Measures joint positions and velocities: noise, then `EncoderReadings`, whose ports it has.

    .. pydrake_system::

        name: Encoders
        input_ports:
        - joint_state
        output_ports:
        - measured_joint_state
    """

    def __init__(self, config: EncoderConfig, joints: int, seed: int, duration: float):
        """Puts the encoders together.

        Args:
            seed: of the errors.
            duration: noise is drawn for this time [s].
        """
        super().__init__()
        builder = DiagramBuilder()
        scale = np.repeat([config.noise, config.velocity_noise], joints)
        period = required(config.period, "period")
        noise = scale * white_noise(seed, "encoders", ticks_until(duration, period), 2 * joints)
        errors = builder.AddNamedSystem("errors", held_signal(noise, period))
        noisy = builder.AddNamedSystem("noisy", Adder(2, 2 * joints))
        readings = builder.AddNamedSystem("readings", EncoderReadings(config, joints))
        builder.Connect(errors.get_output_port(), noisy.get_input_port(1))
        builder.Connect(noisy.get_output_port(), readings.get_input_port())
        builder.ExportInput(noisy.get_input_port(0), "joint_state")
        builder.ExportOutput(readings.get_output_port(), "measured_joint_state")
        builder.BuildInto(self)
