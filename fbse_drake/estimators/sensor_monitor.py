"""Watches the raw sensors, so that the estimators behind it never see what is not a number, and know whom to trust and which feet stand."""

import math
from dataclasses import astuple, dataclass

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.recursive import STATUS, Clock, RecursiveEstimator, Status
from fbse_drake.estimators.support import MeasuredSupport, PlannedSupport, SupportConfig, detect_support
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, vertical_loads

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
    sensors: np.ndarray,
    joints: int,
    channel_sensor: np.ndarray,
    pad_foot: np.ndarray,
    feet: int,
    limits: np.ndarray,
) -> None:
    """One tick of `SensorMonitor`; fills the posterior.

    Args:
        sensors: their readings, see `SensorMonitor`.
        channel_sensor: which sensor each channel belongs to, shape (channels,).
        limits: the values of `SensorMonitorConfig`; the mass that the feet carry [kg], 0 where they need not; the thresholds of
            `detect_support`.
    """
    stuck_after, smallest_load_share, lost_after, weighed_mass = to_fixed_tuple(limits, 4)
    first, channels = math.isnan(elapsed), len(channel_sensor)
    n, start = joints, STATUS + 3 + feet
    light_at = start + 2 * channels
    trust, reading, unchanged = posterior[STATUS + 1 : start], posterior[start : start + channels], posterior[start + channels : light_at]
    last_reading, last_unchanged = last[start : start + channels], last[start + channels : light_at]
    trust[:] = _OK
    reading[:] = sensors
    for i in range(channels):
        if not math.isfinite(reading[i]):
            reading[i], trust[channel_sensor[i]] = last_reading[i], _NOT_FINITE
    for i in range(channels):
        repeats = not first and reading[i] == last_reading[i]
        unchanged[i] = last_unchanged[i] + elapsed if repeats else 0.0
        # Joint angles may repeat themselves; without load a sensor without noise may rest at zero.
        if unchanged[i] > stuck_after and i >= n and reading[i] != 0 and trust[channel_sensor[i]] == _OK:
            trust[channel_sensor[i]] = _STUCK
    light, load = 0.0, vertical_loads(reading[2 * n + 6 :], pad_foot, feet)
    if weighed_mass > 0 and not first:
        # What the feet must carry together: mass times specific force, or gravity where the IMU says nothing.
        fx, fy, fz = reading[2 * n], reading[2 * n + 1], reading[2 * n + 2]
        weight = weighed_mass * max(5.0, math.sqrt(fx * fx + fy * fy + fz * fz))
        if load.sum() < smallest_load_share * weight:
            light = last[light_at] + elapsed
        if light > lost_after:
            for foot in range(feet):
                if trust[2 + foot] == _OK and load[foot] < 0.02 * weight:
                    trust[2 + foot] = _LOST
    posterior[light_at] = light
    posterior[STATUS] = trust.max()
    support, waiting = light_at + 1, light_at + 1 + feet
    detect_support(
        posterior[support:waiting], posterior[waiting:], last[support:waiting], last[waiting:], elapsed, load, trust[2:], limits[4:]
    )


class SensorMonitor(RecursiveEstimator):
    """Passes the sensors' readings on, the last good one where there is none now, with a status for each sensor; says which feet stand.

    .. pydrake_system::

        name: SensorMonitor
        input_ports:
        - sensors
        - planned_support
        output_ports:
        - posterior

    `sensors` holds what is read, side by side in the order of `measurement_fields`, without `trust`. `planned_support` (feet,) is there
    for `PlannedSupport` only; a foot stands where it is positive. Fields of the posterior: see `measurement_fields`; `unchanged`, the
    time [s] for which each channel has repeated itself; `light`, for how long [s] the feet have shown too little; `support` (feet,), 1
    for a foot that stands, else 0; `waiting` (feet,), see `detect_support`.
    """

    def __init__(self, config: SensorMonitorConfig, support: SupportConfig, robot: Robot, clock: Clock):
        readings = measurement_fields(robot)
        channels = sum(readings.values()) - readings["trust"]
        n, legs = len(robot.joint_names), robot.description.legs
        feet = len(legs)
        super().__init__({"status": 1, **readings, "unchanged": channels, "light": 1, "support": feet, "waiting": feet}, clock)
        self._joints, self._feet = n, feet
        self._sensors = self.DeclareVectorInputPort("sensors", channels)
        self._planned = self.DeclareVectorInputPort("planned_support", feet) if isinstance(support, PlannedSupport) else None
        self._declare_posterior(*(self.get_input_port(i).get_name() for i in range(self.num_input_ports())))
        self._pad_foot = FootPads(robot).foot
        self._channel_sensor = np.concatenate([np.zeros(2 * n, dtype=int), np.ones(6, dtype=int), np.repeat(2 + self._pad_foot, 3)])
        checks_load = bool(legs) and robot.has_floating_base
        mass = robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
        measured = support if isinstance(support, MeasuredSupport) else MeasuredSupport()
        weight = 9.81 * mass
        thresholds = (measured.on * weight, measured.off * weight, measured.debounce)
        self._limits = np.array([*astuple(config), mass if checks_load else 0.0, *thresholds], dtype=float)
        self._support = self.fields["support"]

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        _watch_sensors(
            posterior,
            last,
            elapsed,
            self._sensors.Eval(context),
            self._joints,
            self._channel_sensor,
            self._pad_foot,
            self._feet,
            self._limits,
        )
        if self._planned is not None:
            posterior[self._support] = self._planned.Eval(context) > 0
