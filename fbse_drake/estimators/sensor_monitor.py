"""Watches the raw sensors, so that the estimators behind it never see what is not a number, and know whom to trust."""

import math
from dataclasses import astuple, dataclass

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.foot_pads import FootPads, vertical_loads
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, Status
from fbse_drake.robot.plant import Robot

_OK, _NOT_FINITE, _STUCK, _LOST = float(Status.OK), float(Status.NOT_FINITE), float(Status.STUCK), float(Status.LOST)


@dataclass(frozen=True)
class SensorMonitorConfig:
    """When a sensor is not trusted."""

    # A channel that repeats itself to the last bit for this long is stuck [s]. Joint angles, which are counted, may.
    stuck_after: float = 0.05
    # Feet lose their trust when together they show less than this share of the weight ...
    smallest_load_share: float = 0.8
    # ... for longer than this [s]; those that show no load are lost. A foot that is believed for a hundredth of a second more makes
    # 80 Nm of friction out of the weight that it does not show.
    lost_after: float = 0.5e-3

    def __post_init__(self) -> None:
        require_positive(self, "stuck_after", "lost_after")
        if not 0 <= self.smallest_load_share < 1:
            raise InputError(f"smallest_load_share: expected a number in [0, 1), found {self.smallest_load_share:g}")


def measurement_fields(robot: Robot) -> dict[str, int]:
    """Fields of the checked measurements; `trust` has a status each for joints, IMU and every foot."""
    n, pads = len(robot.joint_names), sum(leg.points for leg in robot.description.legs.values())
    return {
        "trust": 2 + len(robot.description.sides),
        "joint_position": n,
        "joint_velocity": n,
        "specific_force": 3,
        "angular_velocity": 3,
        "pad_force": 3 * pads,
    }


@njit(cache=True)
def _watch_sensors(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    joint_state: np.ndarray,
    imu: np.ndarray,
    pad_force: np.ndarray,
    channel_sensor: np.ndarray,
    pad_foot: np.ndarray,
    sensors: int,
    weighed_mass: float,
    config: tuple[float, float, float],
) -> None:
    """One tick of `SensorMonitor`; fills the posterior.

    Args:
        channel_sensor: which sensor each channel belongs to, shape (channels,).
        weighed_mass: that the feet carry [kg]; 0 where they need not.
        config: the values of `SensorMonitorConfig`.
    """
    stuck_after, smallest_load_share, lost_after = config
    first, channels = math.isnan(elapsed), len(channel_sensor)
    n = len(joint_state) // 2
    start = STATUS + 1 + sensors
    trust, reading, unchanged = posterior[STATUS + 1 : start], posterior[start : start + channels], posterior[start + channels : -1]
    last_reading, last_unchanged = last[start : start + channels], last[start + channels : -1]
    trust[:] = _OK
    reading[: 2 * n], reading[2 * n : 2 * n + 6], reading[2 * n + 6 :] = joint_state, imu, pad_force
    for i in range(channels):
        if not math.isfinite(reading[i]):
            reading[i], trust[channel_sensor[i]] = last_reading[i], _NOT_FINITE
    for i in range(channels):
        repeats = not first and reading[i] == last_reading[i]
        unchanged[i] = last_unchanged[i] + elapsed if repeats else 0.0
        # Joint angles may repeat themselves; without load a sensor without noise may rest at zero.
        if unchanged[i] > stuck_after and i >= n and reading[i] != 0 and trust[channel_sensor[i]] == _OK:
            trust[channel_sensor[i]] = _STUCK
    light = 0.0
    if weighed_mass > 0 and not first:
        # What the feet must carry together: mass times specific force, or gravity where the IMU says nothing.
        fx, fy, fz = reading[2 * n], reading[2 * n + 1], reading[2 * n + 2]
        weight = weighed_mass * max(5.0, math.sqrt(fx * fx + fy * fy + fz * fz))
        load = vertical_loads(reading[2 * n + 6 :], pad_foot, sensors - 2)
        if load.sum() < smallest_load_share * weight:
            light = last[-1] + elapsed
        if light > lost_after:
            for foot in range(sensors - 2):
                if trust[2 + foot] == _OK and load[foot] < 0.02 * weight:
                    trust[2 + foot] = _LOST
    posterior[-1] = light
    posterior[STATUS] = trust.max()


class SensorMonitor(RecursiveEstimator):
    """Passes the sensors' readings on, the last good one where there is none now, with a status for each sensor.

    .. pydrake_system::

        name: SensorMonitor
        input_ports:
        - measured_joint_state
        - measured_imu
        - measured_pad_force
        output_ports:
        - posterior

    Fields of the posterior: see `measurement_fields`, and `unchanged`, the time [s] for which each channel has repeated itself.
    """

    def __init__(self, config: SensorMonitorConfig, robot: Robot, clock: Clock):
        readings = measurement_fields(robot)
        channels = sum(readings.values()) - readings["trust"]
        super().__init__({"status": 1, **readings, "unchanged": channels, "light": 1}, clock)
        n, legs = len(robot.joint_names), robot.description.legs
        self._joint_state = self.DeclareVectorInputPort("measured_joint_state", 2 * n)
        self._imu = self.DeclareVectorInputPort("measured_imu", 6)
        self._pads = self.DeclareVectorInputPort("measured_pad_force", readings["pad_force"])
        self._declare_posterior("measured_joint_state", "measured_imu", "measured_pad_force")
        self._pad_foot = FootPads(robot).foot
        self._channel_sensor = np.concatenate([np.zeros(2 * n, dtype=int), np.ones(6, dtype=int), np.repeat(2 + self._pad_foot, 3)])
        self._sensors = readings["trust"]
        checks_load = bool(legs) and robot.has_floating_base
        self._weighed_mass = robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext()) if checks_load else 0.0
        self._config = tuple(float(value) for value in astuple(config))

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        _watch_sensors(
            posterior,
            last,
            elapsed,
            self._joint_state.Eval(context),
            self._imu.Eval(context),
            self._pads.Eval(context),
            self._channel_sensor,
            self._pad_foot,
            self._sensors,
            self._weighed_mass,
            self._config,
        )
