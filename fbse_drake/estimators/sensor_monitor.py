"""Watches the raw sensors.

So the estimators behind it never see what is not a number, and know whom to trust and which feet
stand. A joint's angle and velocity are measured twice over: one is the other's integral. Where they
contradict each other, the one that jumped is had from the other.
"""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit
from pydrake.systems.framework import Context
from pydrake.systems.primitives import Multiplexer

from fbse_drake.errors import InputError, require_not_negative, require_positive
from fbse_drake.estimators.beliefs import USUAL_SENSORS, SensorBeliefs
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import (
    LONGEST_COMPARED_TICK,
    Clock,
    RecursiveEstimator,
    Status,
    start_share,
)
from fbse_drake.estimators.spatial import GRAVITY, vector
from fbse_drake.estimators.support import MeasuredSupport, SupportConfig, detect_support
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, vertical_loads

_OK, _NOT_FINITE = float(Status.OK), float(Status.NOT_FINITE)
_STUCK, _LOST = float(Status.STUCK), float(Status.LOST)
_IMPLAUSIBLE = float(Status.IMPLAUSIBLE)
# What is doubted of a joint: its angle, which jumped; its velocity, or nobody knows which; both.
_ANGLE, _VELOCITY, _BOTH = 1.0, 2.0, 3.0
# The fastest that a trunk's acceleration [m/s^3] and rate [rad/s^2] change, impacts included.
_LARGEST_JERK, _LARGEST_ROTATION = 2.0e4, 200.0
# Over how long a joint's velocity is compared with its angle [s].
_PAIR_TIME = 0.02
# Standard deviations that no honest reading is off by: once in 5e8.
_GATE = 6.0
# By how much the noise of angles may be larger than believed until it is known, as variance; how
# long it takes to learn it [s], and how much of that one tick may tell.
_ROUGHEST, _ROUGHNESS_TIME, _LARGEST_SHARE = 25.0, 0.3, 9.0
# A doubted angle is believed again when it is for so long [s] where the velocity says ...
_RETURNED = 0.01
# ... give or take this share of its way, ...
_GAIN_ERROR = 2e-3
# ... (a mismatch counts for so many times its tolerance at most) ...
_MOST = 5.0
# ... or for so long [s] in accord with the velocity: had it only jumped, had it been wrong in other
# ways, too, had both jumped; other joints are believed after the last of them.
_ADOPTED, _MENDED, _BOTH_MENDED, _AGREED = 0.3, 0.1, 0.3, 0.02


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
    # How late a joint's velocity may be against its angle, or early [s].
    velocity_delay: float = 1.0e-3

    def __post_init__(self) -> None:
        require_positive(self, "stuck_after", "lost_after")
        require_not_negative(self, "velocity_delay")
        if not 0 <= self.smallest_load_share < 1:
            found = f"{self.smallest_load_share:g}"
            raise InputError(f"smallest_load_share: expected a number in [0, 1), found {found}")

    def add(
        self, chain: Chain, support: SupportConfig | None = None, *, hears_doubt: bool = False
    ) -> None:
        """Adds `sensor_monitor` to a chain, which all its sensors feed.

        Args:
            support: which feet stand; measured by default.
            hears_doubt: see `SensorMonitor`.

        Raises:
            InputError: a planned support without a plan.
        """
        support, robot = support or MeasuredSupport(), chain.robot
        watch = partial(SensorMonitor, self, support, robot, beliefs=chain.sensors)
        monitor = chain.add("sensor_monitor", partial(watch, hears_doubt=hears_doubt))
        sizes = {
            "measured_joint_state": 2 * len(robot.joint_names),
            "measured_imu": 6,
            "measured_pad_force": 3 * len(FootPads(robot).foot),
        }
        sensors = chain.add_plain("sensors", Multiplexer(list(sizes.values())))
        chain.builder.Connect(sensors.get_output_port(), monitor.GetInputPort("sensors"))
        for i, signal in enumerate(sizes):
            chain.feed(signal, sensors.get_input_port(i))
        support.add(chain, monitor)


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


def _joint_watch(n: int) -> np.dtype:
    """Type of what `SensorMonitor` remembers of each joint, see there."""
    fields = ("angle", "velocity", "is_pair", "step", "mismatch", "slow_velocity", "slow_rate")
    fields += ("roughness", "doubt", "agreed", "is_mixed", "returned", "allowance", "other")
    return record_type(**dict.fromkeys(fields, (n,)))


def measurements_type(robot: Robot) -> np.dtype:
    """Type of the posterior of `SensorMonitor`."""
    readings, feet = _readings(robot), len(robot.description.legs)
    return record_type(
        time=(),
        status=(),
        trust=(2 + feet,),
        **readings,
        mean=record_type(**{name: readings[name] for name in _MEANT}),
        unchanged=record_type(**readings),
        light=(),
        support=(feet,),
        waiting=(feet,),
        joint=_joint_watch(len(robot.joint_names)),
    )


@njit(cache=True)
def _watch_joints(
    posterior: np.ndarray, last: np.ndarray, elapsed: float, sensors: np.ndarray, known: np.ndarray
) -> bool:
    """Compares angles with velocities; where they are doubted, replaces them in the posterior.

    An angle's step less the velocity's integral is noise. Summed up over `_PAIR_TIME` it shows an
    angle that jumps at once, and a wrong velocity, or an angle that is stuck or late, as soon as it
    makes a difference. `velocity_delay` is forgiven.

    Returns:
        Is a joint doubted?
    """
    x, was, T = posterior.joint, last.joint, elapsed
    is_first, beliefs, found = math.isnan(T), known.beliefs, False
    keep, learning = math.exp(-T / _PAIR_TIME), 1.0 - math.exp(-T / _ROUGHNESS_TIME)
    # Of an angle's step, and of the sum. Nothing is more exact than the velocity's noise.
    rate_variance = (T * beliefs.joint_velocity_noise) ** 2 / 2.0
    step_variance = 2.0 * beliefs.joint_position_noise**2 + rate_variance
    variance = 1.25 * beliefs.joint_position_noise**2 + rate_variance * _PAIR_TIME / T
    for i in range(len(x.angle)):
        q, v = sensors.joint_position[i], sensors.joint_velocity[i]
        has_angle, has_velocity = math.isfinite(q), math.isfinite(v)
        is_stuck = v != 0 and posterior.unchanged.joint_velocity[i] > known.limits.stuck_after
        x.is_pair[i] = 1.0 if has_angle and has_velocity and not is_stuck else 0.0
        x.angle[i] = q if has_angle else was.angle[i]
        x.velocity[i] = v if has_velocity else was.velocity[i]
        doubt = 0.0 if is_first else was.doubt[i]
        if is_first or x.is_pair[i] == 0 or was.is_pair[i] == 0:
            # There is no step to look at.
            _pause(x, was, i, is_first)
            if not is_first:
                if doubt in (_ANGLE, _BOTH) or not has_angle:
                    predicted = last.joint_position[i] + T * last.joint_velocity[i]
                    posterior.joint_position[i] = predicted
                if doubt in (_VELOCITY, _BOTH):
                    posterior.joint_velocity[i] = last.joint_velocity[i]
            found = found or doubt > 0
            continue
        way = 0.5 * T * (v + was.velocity[i])
        jump = q - was.angle[i] - way
        step = max(abs(v - was.velocity[i]), keep * was.step[i])
        slow = keep * was.slow_velocity[i] + (1.0 - keep) * v
        mismatch, rough = keep * was.mismatch[i] + jump, math.sqrt(was.roughness[i])
        slack = known.limits.velocity_delay * abs(v - slow)
        tolerance = _GATE * rough * math.sqrt(variance) + slack
        agrees = abs(mismatch) < tolerance
        least_jump = _GATE * rough * math.sqrt(step_variance)
        # Nor does an angle jump that a velocity which has just jumped is wrong about.
        jumps = abs(jump) > least_jump + 1.5 * T * step
        x.other[i] = was.other[i] + way
        late = known.limits.velocity_delay * abs(v - was.velocity[i])
        x.allowance[i] = was.allowance[i] + _GAIN_ERROR * abs(way) + late
        # What repeats itself agrees with anything that does.
        moves = q != was.angle[i] or v != was.velocity[i]
        x.agreed[i] = was.agreed[i] + (T if moves else 0.0) if agrees else 0.0
        x.returned[i], x.is_mixed[i] = 0.0, was.is_mixed[i]
        if doubt == 0 and (jumps or not agrees):
            if jumps and abs(q - x.other[i]) < x.allowance[i]:
                mismatch = 0.0  # Back where it came from.
            else:
                doubt = _VELOCITY
                if jumps:
                    doubt = _BOTH if T * step > least_jump else _ANGLE
                    mismatch = 0.0
                    x.other[i], x.allowance[i] = last.joint_position[i] + way, tolerance
                x.agreed[i] = x.is_mixed[i] = 0.0
        elif doubt > 0 and jumps:
            mismatch = 0.0
        if doubt == _ANGLE:
            if not agrees and not jumps:
                x.is_mixed[i] = 1.0
            if abs(q - x.other[i]) < x.allowance[i] + tolerance:
                x.returned[i] = was.returned[i] + T
            patience = _MENDED if x.is_mixed[i] > 0 else _ADOPTED
            if x.returned[i] > _RETURNED or x.agreed[i] > patience:
                doubt = 0.0
        elif doubt == _BOTH:
            if abs(q - x.other[i]) < x.allowance[i] + tolerance:
                x.returned[i] = was.returned[i] + T
            if x.returned[i] > _RETURNED or x.agreed[i] > _BOTH_MENDED:
                doubt = 0.0
        elif doubt == _VELOCITY and x.agreed[i] > _AGREED:
            doubt = 0.0
        if doubt == 0:
            if abs(q - x.other[i]) < x.allowance[i] + least_jump:
                x.other[i], x.allowance[i] = q, 0.0
            share = min(_LARGEST_SHARE, jump * jump / (step_variance * was.roughness[i]))
            x.roughness[i] = max(1.0, was.roughness[i] * (1.0 + learning * (share - 1.0)))
        else:
            x.roughness[i] = was.roughness[i]
        # What jumped is not what the joint does.
        rate = v if jumps else (q - was.angle[i]) / T
        x.slow_rate[i] = 0.5 * (1.0 + keep) * was.slow_rate[i] + 0.5 * (1.0 - keep) * rate
        if doubt > 0:  # So that it is soon forgotten.
            mismatch = min(max(mismatch, -_MOST * tolerance), _MOST * tolerance)
        x.mismatch[i], x.slow_velocity[i], x.step[i], x.doubt[i] = mismatch, slow, step, doubt
        if doubt == _ANGLE:
            posterior.joint_position[i] = x.other[i]
        elif doubt == _VELOCITY:
            posterior.joint_velocity[i] = x.slow_rate[i]
        elif doubt == _BOTH:
            posterior.joint_velocity[i] = last.joint_velocity[i]
            x.other[i] = posterior.joint_position[i] = last.joint_position[i]
        found = found or doubt > 0
    return found


@njit(cache=True)
def _pause(x: np.ndarray, was: np.ndarray, i: int, is_first: bool) -> None:
    """What is remembered of a joint in a tick that has no step of both angle and velocity."""
    x.mismatch[i] = x.step[i] = x.agreed[i] = x.returned[i] = 0.0
    x.slow_velocity[i] = x.slow_rate[i] = x.velocity[i]
    x.roughness[i] = _ROUGHEST if is_first else was.roughness[i]
    # Without the velocity nobody knows where the angle has gone.
    is_lost = x.is_pair[i] == 0 and was.doubt[i] > 0
    x.doubt[i] = 0.0 if is_first else (_VELOCITY if is_lost else was.doubt[i])
    x.is_mixed[i] = 0.0 if is_first else was.is_mixed[i]
    x.allowance[i] = 0.0 if is_first else was.allowance[i]
    x.other[i] = x.angle[i] if is_first else was.other[i]


@njit(cache=True)
def _watch_sensors(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    sensors: np.ndarray,
    doubt: np.ndarray,
    known: np.ndarray,
) -> None:
    """One tick of `SensorMonitor`; fills the posterior.

    Args:
        sensors: their readings, see `SensorMonitor`.
        doubt: of IMU and feet, see there, (1 + feet,).
        known: record with the values of `SensorMonitorConfig` as `limits` and of `SensorBeliefs` as
            `beliefs`; the mass that the feet carry [kg], 0 where they need not; which foot each pad
            belongs to; whether the robot `has_imu`; the thresholds of `detect_support`; whether
            joint velocities are `counted` or `derived`; and how long a `reading` takes, see
            `Clock`.
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
        last.joint.velocity,
        was_idle.joint_velocity,
        elapsed,
        math.inf if known.counted else after,
    )
    # Velocities that are made of the angles come late and tell nothing of their own.
    comparable = elapsed
    if known.derived or known.counted or elapsed > LONGEST_COMPARED_TICK:
        comparable = math.nan
    if _watch_joints(posterior, last, comparable, sensors, known) and trust[0] == _OK:
        trust[0] = _IMPLAUSIBLE
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
    for i in range(3):
        jerk = abs(posterior.specific_force[i] - last.specific_force[i])
        turn = abs(posterior.angular_velocity[i] - last.angular_velocity[i])
        # The first tick has no elapsed time, and passes.
        leaps = jerk > _LARGEST_JERK * elapsed or turn > _LARGEST_ROTATION * elapsed
        if leaps and trust[1] == _OK:
            trust[1] = _IMPLAUSIBLE
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
    for sensor in range(1, len(trust)):
        if trust[sensor] == _OK and doubt[sensor - 1] != 0:
            trust[sensor] = _IMPLAUSIBLE
    light, load = 0.0, vertical_loads(posterior.pad_force, known.pad_foot, feet)
    if known.weighed_mass > 0 and not math.isnan(elapsed):
        # What the feet must carry together: mass times specific force, or gravity where the IMU
        # says nothing.
        fx, fy, fz = vector(posterior.specific_force)
        force = math.sqrt(fx * fx + fy * fy + fz * fz) if trust[1] == _OK else GRAVITY
        weight = known.weighed_mass * max(5.0, force)
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
    if not known.has_imu:
        trust[1] = _OK
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
        - doubt
        output_ports:
        - posterior
        - (one for each field)

    `sensors` holds what is read, side by side: `joint_position` (n,), `joint_velocity` (n,),
    `specific_force` (3,), `angular_velocity` (3,), `pad_force` (P, 3). `planned_support` (feet,) is
    there for `PlannedSupport` only; a foot stands where it is positive. `doubt` (1 + feet,) is
    there where somebody knows better: positive for the IMU and the feet that contradict the rest.
    Fields of the posterior:

        trust       (2 + feet,)  status of joints, IMU and every foot
        ...                      the readings, the last good one where there is none now
        mean                     those of IMU and forces over the tick
        unchanged                for how long [s] each of their channels has repeated itself
        light       ()           for how long [s] the feet have shown too little
        support     (feet,)      1 for a foot that stands, else 0
        waiting     (feet,)      see `detect_support`
        joint                    of each joint, all (n,): `angle` and `velocity` as read; `is_pair`:
                                 both are numbers; `step`, the largest of the velocity of late
                                 [rad/s]; `mismatch`, how
                                 far the angle went beyond the velocity's integral in the last time
                                 [rad]; `slow_velocity`, `slow_rate`, means of velocity and of the
                                 angle's rate [rad/s]; `roughness`, by how much the variance of the
                                 angle's noise is larger than believed, at least 1; `doubt`: 1 of
                                 the angle, 2 of the velocity, 3 of both; `agreed`, `returned`, for
                                 how long [s] they have not contradicted each other, and the angle
                                 has been where it is expected; `is_mixed`: since it jumped it was
                                 wrong in other ways, too; `other`, the angle by the velocity from
                                 before the last jump on, give or take `allowance` [rad]
    """

    def __init__(
        self,
        config: SensorMonitorConfig,
        support: SupportConfig,
        robot: Robot,
        clock: Clock,
        beliefs: SensorBeliefs = USUAL_SENSORS,
        *,
        hears_doubt: bool = False,
    ):
        """Declares ports and state.

        Args:
            beliefs: noise of the sensors; of good sensors by default.
            hears_doubt: has an input `doubt`.
        """
        super().__init__(measurements_type(robot), clock)
        legs = robot.description.legs
        self._sensors = self._declare_record_input("sensors", record_type(**_readings(robot)))
        self._planned = None
        if support.by_plan:
            self._planned = self.DeclareVectorInputPort("planned_support", len(legs))
        self._no_doubt, self._doubt = np.zeros(1 + len(legs)), None
        if hears_doubt:
            self._doubt = self.DeclareVectorInputPort("doubt", 1 + len(legs))
        self._declare_posterior()
        checks_load = bool(legs) and robot.has_floating_base
        mass = robot.total_mass
        measured, weight = support.trigger, GRAVITY * mass
        self._known = record(
            limits=config,
            beliefs=beliefs,
            counted=bool(beliefs.joint_velocity_counted),
            derived=bool(beliefs.joint_velocity_derived),
            reading=clock.reading,
            weighed_mass=mass if checks_load else 0.0,
            has_imu=robot.has_floating_base or bool(robot.description.imu),
            pad_foot=FootPads(robot).foot,
            thresholds=record(
                on=measured.on * weight, off=measured.off * weight, debounce=measured.debounce
            ),
        )

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        doubt = self._no_doubt if self._doubt is None else self._doubt.Eval(context)
        sensors = self._sensors.Eval(context)
        _watch_sensors(posterior, last, elapsed, sensors, doubt, self._known)
        if self._planned is not None:
            posterior["support"] = self._planned.Eval(context) > 0
