"""Watches the raw sensors, so that the estimators behind it never see what is not a number, and know whom to trust."""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status
from fbse_drake.robot.plant import Robot


@dataclass(frozen=True)
class SensorMonitorConfig:
    """When a sensor is not trusted."""

    # A channel that repeats itself to the last bit for this long is stuck [s]. Joint angles, which are counted, may.
    stuck_after: float = 0.05
    # Feet lose their trust when together they show less than this share of the weight ...
    smallest_load_share: float = 0.8
    # ... for this long [s]; those that show no load are lost.
    lost_after: float = 0.02

    def __post_init__(self) -> None:
        for name in ("stuck_after", "lost_after"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected a number > 0, found {getattr(self, name):g}")
        if not 0 <= self.smallest_load_share < 1:
            raise InputError(f"smallest_load_share: expected a number in [0, 1), found {self.smallest_load_share:g}")


def measurement_fields(robot: Robot) -> dict[str, int]:
    """Fields of the checked measurements; `trust` has a status each for joints, IMU and every foot."""
    n, pads = len(robot.joint_names), sum(len(leg.pads) for leg in robot.description.legs.values())
    return {
        "trust": 2 + len(robot.description.sides),
        "joint_position": n,
        "joint_velocity": n,
        "specific_force": 3,
        "angular_velocity": 3,
        "pad_force": 3 * pads,
    }


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
        self._count = sum(readings.values()) - readings["trust"]
        super().__init__({**readings, "unchanged": self._count, "light": 1}, clock)
        self._config = config
        n, legs = len(robot.joint_names), robot.description.legs
        self._joint_state = self.DeclareVectorInputPort("measured_joint_state", 2 * n)
        self._imu = self.DeclareVectorInputPort("measured_imu", 6)
        self._pads = self.DeclareVectorInputPort("measured_pad_force", readings["pad_force"])
        self._declare_posterior("measured_joint_state", "measured_imu", "measured_pad_force")
        # Which sensor each channel belongs to, as a sum over its channels.
        sensors = [slice(0, 2 * n), slice(2 * n, 2 * n + 6)]
        for leg in legs.values():
            sensors.append(slice(sensors[-1].stop, sensors[-1].stop + 3 * len(leg.pads)))
        self._sensors = sensors
        self._feet = range(2, len(sensors))
        self._may_repeat = np.zeros(self._count, dtype=bool)
        self._may_repeat[:n] = True
        self._mass = robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
        self._readings = slice(self.fields["joint_position"].start, self.fields["pad_force"].stop)
        self._checks_load = bool(legs) and robot.has_floating_base

    def _tick(self, context: Context, last: np.ndarray, elapsed: float) -> np.ndarray:
        raw = np.concatenate([self._joint_state.Eval(context), self._imu.Eval(context), self._pads.Eval(context)])
        first = math.isnan(elapsed)
        status = [Status.OK] * len(self._sensors)
        if not math.isfinite(raw.sum()):
            bad = ~np.isfinite(raw)
            status = [Status.NOT_FINITE if bad[part].any() else Status.OK for part in self._sensors]
            raw = np.where(bad, last[self._readings], raw)
        posterior = np.empty(self.fields.size)
        posterior[self._readings] = raw
        unchanged = posterior[self.fields["unchanged"]]
        if first:
            unchanged[:] = 0.0
        else:
            same = raw == last[self._readings]
            np.multiply(last[self.fields["unchanged"]] + elapsed, same, out=unchanged)
            if unchanged.max() > self._config.stuck_after:
                # Without load a sensor without noise may rest at zero.
                stuck = (unchanged > self._config.stuck_after) & ~self._may_repeat & (raw != 0)
                for k, part in enumerate(self._sensors):
                    if status[k] == Status.OK and stuck[part].any():
                        status[k] = Status.STUCK
        posterior[-1] = 0.0
        if self._checks_load and not first:
            posterior[-1] = self._time_light(raw, last[-1] + elapsed)
            if posterior[-1] > self._config.lost_after:
                for k in self._feet:
                    if status[k] == Status.OK and raw[self._sensors[k]][2::3].sum() < 0.02 * self._weight(raw):
                        status[k] = Status.LOST
        posterior[self.fields["trust"]] = status
        posterior[0] = max(status)
        return posterior

    def _weight(self, raw: np.ndarray) -> float:
        """What the feet must carry together [N]: mass times specific force, or gravity where the IMU says nothing."""
        force = raw[self._sensors[1]][:3]
        return self._mass * max(5.0, math.sqrt(force @ force))

    def _time_light(self, raw: np.ndarray, elapsed: float) -> float:
        load = raw[self._sensors[2].start + 2 :: 3].sum()
        return elapsed if load < self._config.smallest_load_share * self._weight(raw) else 0.0
