"""Joint encoders."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from fbse_drake.errors import InputError
from fbse_drake.sensors.noise import white_noise


@dataclass(frozen=True)
class EncoderConfig:
    """Angles are read as `resolution * round((angle + noise) / resolution)`."""

    # One count [rad]; 0 reads exactly. A 17-bit encoder has 2 pi / 2^17 = 4.8e-5.
    resolution: float = 0.0
    # Standard deviation of the angle before it is rounded [rad].
    noise: float = 0.0
    # How the velocity is had: `exact` (a tachometer with `velocity_noise`) or `differenced` from two readings.
    velocity: str = "exact"
    # Standard deviation of an `exact` velocity [rad/s].
    velocity_noise: float = 0.0
    # Sampling period [s].
    period: float = 0.001

    def __post_init__(self) -> None:
        for name in ("resolution", "noise", "velocity_noise"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected a number >= 0, found {getattr(self, name):g}")
        if self.velocity not in ("exact", "differenced"):
            raise InputError(f"velocity: expected exact or differenced, found {self.velocity}")
        if self.period <= 0:
            raise InputError(f"period: expected a number > 0, found {self.period:g}")


def read_encoder(angle: np.ndarray, noise: np.ndarray | float, resolution: float) -> np.ndarray:
    """Angle as the encoder gives it [rad]."""
    angle = angle + noise
    return angle if resolution == 0 else resolution * np.round(angle / resolution)


class Encoders(LeafSystem):
    """Measures joint positions and velocities.

    .. pydrake_system::

        name: Encoders
        input_ports:
        - joint_state
        output_ports:
        - measured_joint_state

    Both are [positions, velocities], shape (2n,) [rad, rad/s]. The output is the reading of the present tick (it is meant to be
    sampled at the encoder's ticks). Discrete state: the reading of the last tick, for a differenced velocity.
    """

    def __init__(self, config: EncoderConfig, joints: int, seed: int):
        super().__init__()
        self._config, self._n, self._seed = config, joints, seed
        self._joint_state = self.DeclareVectorInputPort("joint_state", 2 * joints)
        # Before the first tick there is no earlier reading.
        self._previous = self.DeclareDiscreteState(np.full(joints, np.nan))
        sources = {self.input_port_ticket(self._joint_state.get_index()), self.time_ticket(), self.xd_ticket()}
        self.measured_joint_state = self.DeclareVectorOutputPort("measured_joint_state", 2 * joints, self._calc, sources)
        if config.velocity == "differenced":
            self.DeclarePeriodicUnrestrictedUpdateEvent(config.period, 0.0, self._remember)

    def _calc(self, context: Context, output: BasicVector) -> None:
        config, n = self._config, self._n
        state = self._joint_state.Eval(context)
        position, velocity = state[:n], state[n:]
        if config.noise > 0 or config.velocity_noise > 0:
            noise = white_noise(self._seed, "encoders", 2 * n, context.get_time(), config.period)
            position = read_encoder(position, config.noise * noise[:n], config.resolution)
            velocity = velocity + config.velocity_noise * noise[n:]
        else:
            position = read_encoder(position, 0.0, config.resolution)
        if config.velocity == "differenced":
            previous = context.get_discrete_state(self._previous).value()
            velocity = np.zeros(n) if np.isnan(previous[0]) else (position - previous) / config.period
        output.SetFromVector(np.concatenate([position, velocity]))

    def _remember(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._previous).set_value(self.measured_joint_state.Eval(context)[: self._n])
