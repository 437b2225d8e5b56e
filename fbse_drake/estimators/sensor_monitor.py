"""Watches the raw sensors.

So the estimators behind it never see what is not a number, and know whom to trust and which feet
stand.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator, Status, start_share
from fbse_drake.estimators.spatial import vector
from fbse_drake.estimators.support import (
    MeasuredSupport,
    PlannedSupport,
    SupportConfig,
    detect_support,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, vertical_loads

_OK, _NOT_FINITE = float(Status.OK), float(Status.NOT_FINITE)
_STUCK, _LOST = float(Status.STUCK), float(Status.LOST)


# The readings whose mean over the tick is told.
_MEANT = ("specific_force", "angular_velocity", "pad_force")


@dataclass(frozen=True)
class SensorMonitorConfig:
    """When a sensor is not trusted."""

    # A channel that repeats itself to the last bit for this long is stuck [s]. Joint angles, which
    # are counted, may, and velocities that are differences of such.
    stuck_after: float = 0.05
    # Feet lose their trust when together they show less than this share of the weight ...
    smallest_load_share: float = 0.8
    # ... for longer than this [s]; those that show no load are lost. A foot that is believed for a
    # hundredth of a second more makes 80 Nm of friction out of the weight that it does not show.
    lost_after: float = 0.5e-3

    def __post_init__(self) -> None:
        require_positive(self, "stuck_after", "lost_after")
        if not 0 <= self.smallest_load_share < 1:
            raise InputError(f"smallest_load_share: expected a number in [0, 1), found {self.smallest_load_share:g}")


def _readings(robot: Robot) -> dict[str, tuple[int, ...]]:
    """Shapes of what the sensors read, by its name."""
    n, pads = len(robot.joint_names), sum(leg.points for leg in robot.description.legs.values())
    return {
        "joint_position": (n,),
        "joint_velocity": (n,),
        "specific_force": (3,),
        "angular_velocity": (3,),
        "pad_force": (pads, 3),
    }


@njit(cache=True)
def _watch_channels(
    status: float,
    reading: np.ndarray,
    unchanged: np.ndarray,
    sensed: np.ndarray,
    last_reading: np.ndarray,
    last_unchanged: np.ndarray,
    elapsed: float,
    stuck_after: float,
) -> float:
    """Status of a sensor after some of its channels, all arrays have shape (channels,).

    Args:
        status: what its other channels say.
        reading: filled with what is sensed, the last reading where that is no number.
        unchanged: filled with how long each channel has repeated itself [s].
        stuck_after: how long it may [s].
    """
    for i in range(len(reading)):
        reading[i] = sensed[i]
        if not math.isfinite(reading[i]):
            reading[i], status = last_reading[i], _NOT_FINITE
        repeats = not math.isnan(elapsed) and reading[i] == last_reading[i]
        unchanged[i] = last_unchanged[i] + elapsed if repeats else 0.0
        # Without load a sensor without noise may rest at zero.
        if unchanged[i] > stuck_after and reading[i] != 0 and status == _OK:
            status = _STUCK
    return status


@njit(cache=True)
def _watch_sensors(posterior: np.ndarray, last: np.ndarray, elapsed: float, sensors: np.ndarray, known: np.ndarray) -> None:
    """One tick of `SensorMonitor`; fills the posterior.

    Args:
        sensors: their readings, see `SensorMonitor`.
        known: record with the values of `SensorMonitorConfig`; the mass that the feet carry [kg], 0
            where they need not; which foot each pad belongs to; the thresholds of `detect_support`;
            whether joint velocities are `counted`; and how long a `reading` takes, see `Clock`.
    """
    posterior, last, sensors, known = posterior[()], last[()], sensors[()], known[()]
    trust, idle, was_idle = posterior.trust, posterior.unchanged, last.unchanged
    feet, after = len(posterior.support), known.limits.stuck_after
    trust[:] = _OK
    # Joint angles may repeat themselves, and so may their differences.
    trust[0] = _watch_channels(
        trust[0],
        posterior.joint_position,
        idle.joint_position,
        sensors.joint_position,
        last.joint_position,
        was_idle.joint_position,
        elapsed,
        math.inf,
    )
    trust[0] = _watch_channels(
        trust[0],
        posterior.joint_velocity,
        idle.joint_velocity,
        sensors.joint_velocity,
        last.joint_velocity,
        was_idle.joint_velocity,
        elapsed,
        math.inf if known.counted else after,
    )
    trust[1] = _watch_channels(
        trust[1],
        posterior.specific_force,
        idle.specific_force,
        sensors.specific_force,
        last.specific_force,
        was_idle.specific_force,
        elapsed,
        after,
    )
    trust[1] = _watch_channels(
        trust[1],
        posterior.angular_velocity,
        idle.angular_velocity,
        sensors.angular_velocity,
        last.angular_velocity,
        was_idle.angular_velocity,
        elapsed,
        after,
    )
    for pad in range(len(known.pad_foot)):
        sensor = 2 + known.pad_foot[pad]
        trust[sensor] = _watch_channels(
            trust[sensor],
            posterior.pad_force[pad],
            idle.pad_force[pad],
            sensors.pad_force[pad],
            last.pad_force[pad],
            was_idle.pad_force[pad],
            elapsed,
            after,
        )
    light, load = 0.0, vertical_loads(posterior.pad_force, known.pad_foot, feet)
    if known.weighed_mass > 0 and not math.isnan(elapsed):
        # What the feet must carry together: mass times specific force, or gravity where the IMU
        # says nothing.
        fx, fy, fz = vector(posterior.specific_force)
        weight = known.weighed_mass * max(5.0, math.sqrt(fx * fx + fy * fy + fz * fz))
        if load.sum() < known.limits.smallest_load_share * weight:
            light = last.light + elapsed
        if light > known.limits.lost_after:
            for foot in range(feet):
                if trust[2 + foot] == _OK and load[foot] < 0.02 * weight:
                    trust[2 + foot] = _LOST
    posterior.light = light
    share = start_share(elapsed, known.reading) if last.status == _OK else 0.0
    for i in range(3):
        now, before = posterior.specific_force[i], last.specific_force[i]
        posterior.mean.specific_force[i] = now + share * (before - now)
        now, before = posterior.angular_velocity[i], last.angular_velocity[i]
        posterior.mean.angular_velocity[i] = now + share * (before - now)
        for pad in range(len(known.pad_foot)):
            now, before = posterior.pad_force[pad, i], last.pad_force[pad, i]
            posterior.mean.pad_force[pad, i] = now + share * (before - now)
    posterior.status = trust.max()
    detect_support(
        posterior.support,
        posterior.waiting,
        last.support,
        last.waiting,
        elapsed,
        load,
        trust[2:],
        known.thresholds,
    )


class SensorMonitor(RecursiveEstimator):
    """Passes the sensors' readings on, with a status for each sensor; says which feet stand.

    .. pydrake_system::

        name: SensorMonitor
        input_ports:
        - sensors
        - planned_support
        output_ports:
        - posterior
        - (one for each field)

    `sensors` holds what is read, side by side: `joint_position` (n,), `joint_velocity` (n,),
    `specific_force` (3,), `angular_velocity` (3,), `pad_force` (P, 3). `planned_support` (feet,) is
    there for `PlannedSupport` only; a foot stands where it is positive. Fields of the posterior:

        trust       (2 + feet,)  status of joints, IMU and every foot
        ...                      the readings, the last good one where there is none now
        mean                     those of IMU and forces over the tick
        unchanged                for how long [s] each of their channels has repeated itself
        light       ()           for how long [s] the feet have shown too little
        support     (feet,)      1 for a foot that stands, else 0
        waiting     (feet,)      see `detect_support`
    """

    def __init__(
        self,
        config: SensorMonitorConfig,
        support: SupportConfig,
        robot: Robot,
        clock: Clock,
        *,
        counted: bool = False,
    ):
        """Declares ports and state.

        Args:
            counted: joint velocities are differences of counted angles.
        """
        readings = _readings(robot)
        sensors = record_type(**readings)
        legs = robot.description.legs
        feet = (len(legs),)
        posterior_type = record_type(
            time=(),
            status=(),
            trust=(2 + len(legs),),
            **readings,
            mean=record_type(**{name: readings[name] for name in _MEANT}),
            unchanged=sensors,
            light=(),
            support=feet,
            waiting=feet,
        )
        super().__init__(posterior_type, clock)
        self._sensors = self._declare_record_input("sensors", sensors)
        self._planned = None
        if isinstance(support, PlannedSupport):
            self._planned = self.DeclareVectorInputPort("planned_support", len(legs))
        inputs = [self.get_input_port(i) for i in range(self.num_input_ports())]
        self._declare_posterior(*(port.get_name() for port in inputs))
        checks_load = bool(legs) and robot.has_floating_base
        mass = robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
        measured = support if isinstance(support, MeasuredSupport) else MeasuredSupport()
        weight = 9.81 * mass
        self._known = record(
            limits=config,
            counted=counted,
            reading=clock.reading,
            weighed_mass=mass if checks_load else 0.0,
            pad_foot=FootPads(robot).foot,
            thresholds=record(on=measured.on * weight, off=measured.off * weight, debounce=measured.debounce),
        )

    def _tick(self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray) -> None:
        _watch_sensors(posterior, last, elapsed, self._sensors.Eval(context), self._known)
        if self._planned is not None:
            posterior["support"] = self._planned.Eval(context) > 0
