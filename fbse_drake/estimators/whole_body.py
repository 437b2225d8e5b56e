"""Friction through the equation of motion of the whole robot.

One extended Kalman filter takes the velocities of base and joints from the equation of motion and
identifies the friction law in it at the same time. So the law is asked for the velocity that fits
the torques, not for the one that a noisy encoder shows, and is identified at it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.effects.friction import CoulombViscousFriction, FrictionModel
from fbse_drake.effects.joint_torque import JointMotion, ResolvedJointTorque
from fbse_drake.errors import require_not_negative, required
from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.believed_torque import BelievedTorque, believed_torque_type
from fbse_drake.estimators.equation_of_motion import (
    motion_type,
    put_equation_of_motion,
    put_push,
    touching,
)
from fbse_drake.estimators.floating_base import ImuMount, model_type
from fbse_drake.estimators.force_balance import force_balance_type, watch_balance
from fbse_drake.estimators.force_delay import remembered_ticks, tick_of
from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.estimators.implicit_friction import (
    implicit_step,
    impulse_covariance,
    inverse_of,
    linearise,
    mirror,
    own_covariance,
)
from fbse_drake.estimators.imu_noise import imu_noise_type, watch_noise
from fbse_drake.estimators.innovations import AGREEMENT_TIME
from fbse_drake.estimators.law_learning import (
    beyond_known_speeds,
    forget_laws,
    forget_unproven,
    learning_states,
    make_dissipative,
    remember_speeds,
)
from fbse_drake.estimators.link_torque import watch_forces, wrench_variance
from fbse_drake.estimators.missing_inertia import (
    full_inertia,
    make_inertia_possible,
    put_acceleration,
)
from fbse_drake.estimators.records import Record, as_record, record, record_type
from fbse_drake.estimators.recursive import (
    Clock,
    Past,
    RecursiveEstimator,
    Status,
    start_share,
    ticks_ago,
)
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.estimators.spatial import GRAVITY, dot, put, rotate, rotation, subtract, vector
from fbse_drake.estimators.whole_body_updates import (
    DOUBT_TIME,
    GATE,
    NOTICED,
    confirmed,
    forget_lacking,
    is_contradicted,
    judge,
    listen,
    listen_to_feet,
    watch_corrections,
)
from fbse_drake.robot.plant import Robot
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches
from fbse_drake.wiring import weakly

_NOT_FINITE = float(Status.NOT_FINITE)
# A gain, or a mass, that is less wrong is not told of [1].
_TOLD_GAIN, _TOLD_MASS = 0.005, 0.01
# Of no delay it is known how long it has shown.
_NO_DELAY = np.zeros(0)


@dataclass(frozen=True)
class WholeBody:
    """Extended Kalman filter for velocities and friction laws of the whole robot.

    Its states are the angular velocity of the base, the velocities of the joints, the linear
    parameters of each joint's friction law, the reflected inertia that the model lacks there, and
    what the equation of motion lacks in each of its rows (wrong masses, friction that follows no
    law), a random walk. It takes command, foot forces and accelerometer for granted but for their
    noise; gyro and encoders are measurements, and flat feet that stand do not turn. Friction that
    rises steeply with the velocity is solved implicitly, and linearised where the measurements say
    that a tick ended: velocity and law are learned together, and one that does not fit the other
    would be learned wrong.

    Foot forces that come late belong to the tick in which they were: the filter is then so many
    ticks behind, and the law is asked for the velocity that is measured now. Where measurements
    keep contradicting the model, torque is lacking in the rows that their corrections point at, and
    the laws of these joints, once known, are not learned; nor are those of joints that rest. A law
    that is contradicted before it has held for some time begins anew.

    Feet whose forces are read wrong by a share of them are told by the robot's weight, as its load
    moves from foot to foot.
    """

    # Does it go back to the tick that late forces belong to?
    allows_for_delay: ClassVar[bool] = True
    # Does it leave out of its law what effects of the model take of the torques?
    allows_for_effects: ClassVar[bool] = True
    # Does it know how well it knows the parameters of its model?
    states_variance: ClassVar[bool] = True
    # What feeds it, by input, and the stages whose work it does.
    sources: ClassVar[dict[str, str]] = {
        "measurements": "sensor_monitor",
        "model_over_step": "model.over_step",
        "attitude": "attitude",
    }
    stands_for: ClassVar[tuple[str, ...]] = ("joint_acceleration", "link_torque")

    # Friction model, of which the linear parameters are identified, from their values here on; the
    # others stay as they are.
    model: FrictionModel = field(default_factory=CoulombViscousFriction)
    # Initial standard deviation of every parameter [its unit].
    parameter_uncertainty: float = 3.0
    # By what the nonlinear parameters (a transition velocity) may be wrong: the model is a mixture
    # of such shapes; and the initial standard deviation of each one's weight [Nm].
    factors: list[float] = field(default_factory=lambda: [0.2, 5.0])
    shape_uncertainty: float = 3.0
    # Initial standard deviation of the reflected inertia that the model lacks in a joint [kg m^2].
    inertia_uncertainty: float = 0.03
    # Random walk of the torque that a joint's row lacks [Nm/sqrt(s)], and its initial standard
    # deviation [Nm]; and of the moment that the base's rows lack.
    disturbance_walk: float = 0.1
    disturbance_uncertainty: float = 0.1
    moment_walk: float = 0.5
    moment_uncertainty: float = 0.5
    # How fast a flat foot turns about its normal while it stands, in spite of all [rad/s]; more is
    # learned.
    foot_turning: float = 1.0e-4

    def __post_init__(self) -> None:
        require_not_negative(self, "parameter_uncertainty", "shape_uncertainty")
        require_not_negative(self, "inertia_uncertainty")
        require_not_negative(self, "disturbance_walk", "disturbance_uncertainty")
        require_not_negative(self, "moment_walk", "moment_uncertainty", "foot_turning")

    def system(self, sensors: SensorBeliefs, robot: Robot, **arguments: Any) -> "WholeBodyFilter":
        """The estimator with these settings; arguments as of its class."""
        return WholeBodyFilter(self, sensors, robot, **arguments)


def _tick_type(n: int, size: int) -> np.dtype:
    """What a tick's forces and equation of motion say, whatever the friction is.

    `duration` () [s], 0 where not all is known that it needs, and the rest means nothing; `inertia`
    (r, r), the model's with what it lacks; `push` (r,), commands, feet and all that is not friction
    [Nm], and its `variance` (r, r); `missed` (r,), the part of that which is missed between rare
    readings; `impulse` (r, size), covariance of the tick's impulse, but for the friction's, with
    the states; `velocity` (n,) of the joints, where the tick is expected to end; and `believed`, of
    the model's own effects, see `believed_torque_type`.
    """
    r = 3 + n
    return record_type(
        duration=(),
        inertia=(r, r),
        push=(r,),
        variance=(r, r),
        missed=(r,),
        impulse=(r, size),
        velocity=(n,),
        believed=believed_torque_type(n),
    )


@njit(cache=True)
def _begin(
    posterior: Record,
    last: Record,
    elapsed: float,
    measured: Record,
    model: Record,
    attitude: Record,
    torque_command: np.ndarray,
    believed: np.ndarray,
    pad_force: np.ndarray,
    past: Past,
    lag: float,
    delay: float,
    usual_delay: np.ndarray,
    tick: Record,
    known: Record,
) -> None:
    """Takes over what was known a tick ago, and reads the sensors.

    The law stays linearised where it was last.

    Args:
        elapsed: of the tick [s], NaN of the first.
        believed: torque loss of the model's own effects, and its slope, at the velocities that are
            measured, (2, n).
        pad_force: over the tick, without what a low-pass does to it, (P, 3) [N].
        past: of the ticks before, records as of `motion_type`.
        lag: time constant of that low-pass [s].
        delay: by how much the forces are late [s].
        usual_delay: for how long each delay has shown [s].
        tick: that to which the forces belong that are read now; filled, see `_tick_type`.
    """
    x, last, measured, model = posterior[()], last[()], measured[()], model[()]
    attitude, tick, known = attitude[()], tick[()], known[()]
    posterior[()] = last
    pads, feet = known.pads, len(known.wrench_variance)
    wrench = foot_wrenches(pad_force, pads.position, pads.foot, feet)
    watch_forces(x, last, elapsed, wrench, known)
    specific_force = vector(measured.mean.specific_force)
    watch_noise(x.accelerometer, specific_force, known.sensors.acceleration_noise, elapsed)
    x.status, now = measured.trust.max(), x.now
    if math.isnan(elapsed):
        elapsed = 0.0
    now.duration = elapsed
    rate = subtract(vector(measured.angular_velocity), vector(attitude.angular_velocity_bias))
    put(now.reading[:3], rotate(rotation(known.mount.R_BI), rate))
    now.reading[3:] = measured.joint_velocity
    now.believed.torque[:], now.believed.slope[:] = believed[0], believed[1]
    now.believed.velocity[:] = measured.joint_velocity
    if not np.isfinite(torque_command).all():
        x.status = max(x.status, _NOT_FINITE)
    is_known = x.status == 0.0 and last.status == 0.0
    is_known = is_known and elapsed > 0.0 and math.isfinite(delay) and model.velocity.any()
    now.known = 1.0 if is_known else 0.0
    if is_known:
        put_equation_of_motion(now, measured, model, attitude, torque_command, known)
    x.late = tick_of(elapsed, past, delay) if elapsed > 0.0 else 0.0
    then = _tick_of_forces(x, past)
    x.reading[:] = then.reading
    tick.believed.torque[:], tick.believed.slope[:] = then.believed.torque, then.believed.slope
    tick.believed.velocity[:] = then.believed.velocity
    r = len(x.lacking)
    for i in range(r):
        walk = known.config.moment_walk if i < 3 else known.config.disturbance_walk
        x.covariance[r + i, r + i] += walk**2 * elapsed
    T, x.lag = then.duration * then.known if is_known else 0.0, lag
    if (x.lag > 0.0) != (last.lag > 0.0):
        T = 0.0
        forget_laws(x, known)
    elif x.late != last.late:
        # The last state is of another tick; and until a delay has shown, its laws were learned with
        # forces of another time.
        T = 0.0
        if not usual_delay.any():
            forget_laws(x, known)
    touches = touching(x.pad_mean, pad_force, elapsed, x.force_noise, known)
    put_push(
        tick.push, tick.variance, then, pad_force, touches, wrench, x.force_noise,
        x.accelerometer.noise, x.force_balance.gains, known,
    )  # fmt: skip
    A, tick.duration, share = full_inertia(x, then.inertia), T, start_share(T, known.reading)
    tick.inertia[:] = A
    np.dot(A, x.covariance[:r], tick.impulse)
    for i in range(r):
        for k in range(len(x.covariance)):
            tick.impulse[i, k] -= T * x.covariance[r + i, k]
        # What rare readings leave out is as large as they differ.
        tick.missed[i] = (share * (tick.push[i] - last.pushed[i])) ** 2
        tick.variance[i, i] += tick.missed[i]
    if T == 0.0:
        _forget_motion(x, known)
        if elapsed > 0.0:
            x.joint_acceleration[:] = (now.reading - last.now.reading)[3:] / elapsed
        tick.velocity[:] = x.velocity[3:]
    else:
        velocity, _ = implicit_step(x, x.velocity, A, tick.push, T)
        tick.velocity[:] = velocity[3:]


@njit(cache=True)
def _tick_of_forces(x: Record, past: Past) -> Record:
    """What is known of the tick to which the forces belong that are read now, but for them."""
    return x.now if x.late == 0.0 else ticks_ago(past, int(x.late))


@njit(cache=True)
def _expect(
    posterior: Record,
    last: Record,
    tick: Record,
    law: np.ndarray,
    shaped: np.ndarray,
    known: Record,
) -> None:
    """Fills the velocities of the joints that the measurements let expect at the tick's end.

    Where the law is steep, velocity and law have to fit each other to be learned.

    Args:
        law, shaped: what `FrictionRegressor` says at the velocities of the tick.
    """
    x, last, tick, known = posterior[()], last[()], tick[()], known[()]
    A = np.ascontiguousarray(tick.inertia)
    linearise(x, tick.velocity, law, shaped, tick.believed)
    put_acceleration(x, tick, known)
    expected, inverse = implicit_step(x, x.velocity, A, tick.push, tick.duration)
    own = own_covariance(x, A, inverse, impulse_covariance(x, tick), tick)
    innovation, S = x.reading - expected, own.copy()
    for i in range(len(S)):
        S[i, i] += x.noise[i] * known.variance[i]
        twice = confirmed(innovation[i], last.innovation[i]) ** 2
        if twice > GATE**2 * S[i, i]:
            # As in the update.
            own[i, i] += twice
            S[i, i] += twice
        else:
            largest = GATE * math.sqrt(S[i, i])
            innovation[i] = min(max(innovation[i], -largest), largest)
    expected += own @ (inverse_of(S) @ innovation)
    tick.velocity[:] = expected[3:]


@njit(cache=True)
def _update(
    x: Record,
    last: Record,
    then: Record,
    tick: Record,
    measured: Record,
    known: Record,
) -> None:
    """Prediction and measurements of a tick, by the law as it is linearised.

    Args:
        then: equation of motion of the tick.
    """
    P, r, T = x.covariance, len(x.velocity), tick.duration
    A = np.ascontiguousarray(tick.inertia)
    predicted, inverse = implicit_step(x, x.velocity, A, tick.push, T)
    impulse = impulse_covariance(x, tick)
    expected = own_covariance(x, A, inverse, impulse, tick)
    P[:r] = inverse @ impulse
    P[:r, :r] = expected
    mirror(P, r)
    x.velocity[:], x.pushed[:] = predicted, tick.push
    change = x.reading - last.reading
    x.residual[:] = (tick.push - np.ascontiguousarray(then.inertia) @ change / T)[3:]
    missed = T * T * (inverse**2 @ tick.missed)
    excess, weight, correction = judge(x, last, missed, T, known)
    learning = learning_states(x, last, T, known)
    listen(x, excess, weight, learning, T, known)
    remember_speeds(x, tick.velocity, learning)
    listen_to_feet(x, last, then, measured, learning, T, known)
    watch_corrections(x, last, A, correction, expected, T)
    acceleration = (x.velocity - last.velocity) / T
    x.joint_acceleration[:] = acceleration[3:]
    if known.sensors.force_gain > 0.0:
        _weigh(x, then, acceleration, T, known)


@njit(cache=True)
def _weigh(x: Record, then: Record, acceleration: np.ndarray, T: float, known: Record) -> None:
    """Compares what the feet carry with the robot's weight, which shows feet that are read wrong.

    Args:
        then: equation of motion of the tick.
        acceleration: in it, (r,) [rad/s^2].
    """
    load, weight = np.empty(len(x.wrench)), then.weight
    for i in range(len(acceleration)):
        weight += dot(vector(then.of_linear[i]), vector(then.up)) * acceleration[i]
    for foot in range(len(load)):
        load[foot] = dot(vector(then.up_of_sole[foot]), vector(x.wrench[foot, 3:])) / known.weight
    watch_balance(x.force_balance, load, weight / known.weight, T, known.sensors.force_gain)


@njit(cache=True)
def _forget_motion(x: Record, known: Record) -> None:
    """Where a sensor is not trusted, velocities are what was measured, and nothing is lacking."""
    P, r = x.covariance, len(x.velocity)
    P[:r] = 0.0
    P[:, :r] = 0.0
    for i in range(r):
        P[i, i] = x.noise[i] * known.variance[i]
        forget_lacking(x, i, known)
    x.velocity[:], x.lacking[:], x.innovation[:] = x.reading, 0.0, 0.0
    x.unexplained[:], x.correction[:] = 0.0, 0.0


@njit(cache=True)
def _finish(
    posterior: Record,
    last: Record,
    elapsed: float,
    tick: Record,
    law: np.ndarray,
    law_now: np.ndarray,
    shaped: np.ndarray,
    measured: Record,
    torque_command: np.ndarray,
    past: Past,
    known: Record,
) -> None:
    """Updates the state; tells friction and its standard deviation by the law where the tick ends.

    Args:
        law, shaped: what `FrictionRegressor` says at the velocities of the tick.
        law_now: the same at those that are measured now, for forces that are late.
    """
    x, last, measured, known = posterior[()], last[()], measured[()], known[()]
    tick, velocity_now = tick[()], measured.joint_velocity
    if tick.duration > 0.0:
        linearise(x, tick.velocity, law, shaped, tick.believed)
        put_acceleration(x, tick, known)
        _update(x, last, _tick_of_forces(x, past), tick, measured, known)
        make_dissipative(x, tick.believed)
        make_inertia_possible(x, known)
        forget_unproven(x, tick.duration, known)
    if x.late == 0.0:
        velocity_now, law_now = tick.velocity, law
    linearise(x, velocity_now, law_now, shaped, x.now.believed)
    P, (n, m) = x.covariance, x.weights.shape
    r, keep = 3 + n, math.exp(-elapsed / DOUBT_TIME) if elapsed > 0.0 else 1.0
    brief = math.exp(-elapsed / AGREEMENT_TIME) if elapsed > 0.0 else 1.0
    for joint in range(n):
        of_velocity, of_lacking, first = 3 + joint, r + 3 + joint, 2 * r + m * joint
        slope, lacking = x.slope[joint], x.lacking[3 + joint]
        variance, friction = P[of_lacking, of_lacking], x.friction_there[joint] + lacking
        of_error = P[of_velocity, of_velocity] + x.contradiction[of_velocity]
        if x.late > 0.0:
            # Nobody knows more of the velocity now than is measured.
            of_error, slope = x.noise[of_velocity] * known.variance[of_velocity], 0.0
        friction += slope * (x.velocity[of_velocity] - velocity_now[joint])
        moves = x.velocity[of_velocity] ** 2 > NOTICED**2 * P[of_velocity, of_velocity]
        x.rested[joint] = 0.0 if moves else last.rested[joint] + tick.duration
        # The law's slope changes within the velocity's doubt.
        x.steepest[joint] = max(x.slope[joint], brief * last.steepest[joint])
        by_velocity = x.steepest[joint] ** 2 * of_error
        by_velocity += 2.0 * slope * P[of_velocity, of_lacking]
        unsettled = 0.0
        for j in range(m):
            share, at = x.regressor[joint, j], first + j
            by_velocity += 2.0 * share * slope * P[of_velocity, at]
            variance += 2.0 * share * P[of_lacking, at]
            for k in range(m):
                variance += share * x.regressor[joint, k] * P[at, first + k]
            settled = keep * last.settled[joint, j] + (1.0 - keep) * x.weights[joint, j]
            x.settled[joint, j] = settled
            unsettled += share * (x.weights[joint, j] - settled)
        x.friction[joint] = friction
        if math.isfinite(torque_command[joint]):
            x.link_torque[joint] = torque_command[joint] - friction
        if tick.duration == 0.0:
            x.residual[joint] = friction
        # What the law does not explain, or learned just now, is not confirmed yet; and nobody
        # knows which of model and measurement is wrong that contradict each other.
        contradicted = abs(x.unexplained[of_velocity]) if is_contradicted(x, of_velocity) else 0.0
        if x.correction[of_velocity] ** 2 > GATE**2 * x.correction_variance[of_velocity]:
            contradicted = max(contradicted, abs(x.correction[of_velocity]))
        doubt = max(abs(lacking) + abs(unsettled), contradicted)
        x.doubt[joint] = max(doubt, keep * last.doubt[joint])
        # The Birge ratio widens what follows from readings that contradict the model.
        ratio = max(x.surprise, x.agreement[of_velocity])
        by_law = abs(x.friction_there[joint])
        x.largest[joint] = max(by_law, last.largest[joint])
        # However wrong the velocity may be, the law says no more than it ever has.
        by_velocity = min(ratio * by_velocity, (by_law + x.largest[joint]) ** 2)
        variance = max(0.0, ratio * variance + by_velocity)
        variance += beyond_known_speeds(x, joint, velocity_now[joint], known) ** 2
        x.friction_std[joint] = math.sqrt(variance + x.doubt[joint] ** 2)
        x.missing_inertia[joint] = x.weights[joint, m - 1]
        x.missing_inertia_std[joint] = math.sqrt(max(0.0, P[first + m - 1, first + m - 1]))
        for k in range(x.parameters.shape[1]):
            x.parameters[joint, k] = x.weights[joint, k]
            x.parameter_variance[joint, k] = P[first + k, first + k]


class WholeBodyFilter(RecursiveEstimator):
    """Friction through the whole robot's equation of motion, see `WholeBody`.

    .. pydrake_system::

        name: WholeBodyFilter
        input_ports:
        - measurements
        - model_over_step
        - attitude
        - torque_command
        output_ports:
        - posterior
        - (one for each field)

    Inputs: posteriors of `SensorMonitor`, `FloatingBaseModel` over the step and
    `InvariantBaseFilter` (which also tells how late foot forces come) or `AttitudeEstimator`;
    `torque_command` (n,) [Nm] is remembered for the next tick. Fields of the posterior, for n
    joints, r = 3 + n and m weights of each joint:

        friction, friction_std   (n,)    the estimate for the tick that ends now [Nm]
        link_torque              (n,)    the last command that is a number, less friction; what
                                         passes the joint to its link [Nm]
        residual                 (n,)    friction as it is measured in the tick, unfiltered, with
                                         the model's own inertia [Nm]
        joint_acceleration       (n,)    mean over the tick [rad/s^2]
        parameters, parameter_variance   (n, ...)  linear parameters of the law
        velocity                 (r,)    of the base's turning in its axes, and of the joints
                                         [rad/s]
        lacking                  (r,)    torque that the equation of motion lacks [Nm]
        missing_inertia, missing_inertia_std   (n,)  reflected inertia that the model lacks
                                         [kg m^2]
        weights, settled         (n, m)  parameters, those of other shapes and the missing inertia;
                                         the same some time ago
        covariance               of [velocity, lacking, weights], (2 r + n m, 2 r + n m)
        force_balance            by what share each foot's forces are larger than read, see
                                 `force_balance_type`
        innovation, innovation_variance   (r,)  of gyro and encoders [rad/s]
        correction, correction_variance   (r,)  of the velocities in this tick, as torque [Nm]
        unexplained, unexplained_variance (r,)  running mean of the corrections [Nm]
        agreement                (r,)    running mean of the innovations squared over their variance
        contradiction            (r,)    what the innovations say, beyond chance, that the variances
                                         of the velocities lack, the largest of late [(rad/s)^2]
        surprise                 ()      mean square of the innovations as a share of their
                                         variance, the largest of late that is beyond chance; at
                                         least 1
        pushed                   (r,)    commands, feet and all that is not friction [Nm]
        noise                    (r,)    by how much the variance of gyro and encoders is larger
                                         than believed, at least 1, by steps that the model foresees
        bend_noise, reading_step (r,)    the same by second differences of the readings, which need
                                         no model; and their first differences [rad/s]
        foot_noise               (feet,) the same of standing feet's turning
        force_noise, wrench, wrench_change  see `LinkTorqueEstimator`
        pad_mean                 (P, 3)  force on each pad, mean of late [N]
        accelerometer            by how much it is noisier than believed, see `imu_noise_type`
        reading                  (r,)    what gyro and encoders read, free of the bias [rad/s]
        late                     ()      how many ticks ago the forces were what is read now: all
                                         but the friction is of that tick
        lag                      ()      time constant of the foot sensors' low-pass [s]
        now                      what is known of the present tick but for the forces, see
                                 `motion_type`; remembered as long as forces may be late
        doubt                    (n,)    the largest `lacking` of late, with what has been learned
                                         since then, or torque by which measurements contradict the
                                         model [Nm]
        rested                   (n,)    for how long a joint has not moved, beyond doubt [s]
        proven                   (n,)    for how long its law has held, see `forget_unproven` [s]
        law_velocity, friction_there, slope, regressor   the law where it was linearised
        steepest                 (n,)    the largest slope of late [Nm s/rad]
        largest                  (n,)    the largest friction by the law so far [Nm]
        fastest, at_fastest      (n,)    the highest speed that taught the law [rad/s], and the
                                         friction there [Nm]
    """

    def __init__(
        self,
        config: WholeBody,
        sensors: SensorBeliefs,
        robot: Robot,
        measurements: np.dtype,
        model_over_step: np.dtype,
        attitude: np.dtype,
        clock: Clock,
        torque_effects: Sequence[ResolvedJointTorque] = (),
    ):
        """Declares ports and state.

        Args:
            measurements, model_over_step, attitude: types of the inputs.
            torque_effects: of the model; the law that is learned is what is left beside them.
        """
        self._config, self._feet = config, tuple(robot.description.legs)
        self._regressor = FrictionRegressor.of(config.model, robot, tuple(config.factors))
        n, m = len(robot.joint_names), self._regressor.weights + 1
        r, pads, legs = 3 + n, FootPads(robot), robot.description.legs
        feet = len(legs)
        per_row = ["velocity", "lacking", "innovation", "innovation_variance", "correction"]
        per_row += ["correction_variance", "unexplained", "unexplained_variance", "noise"]
        per_row += ["bend_noise", "reading_step", "reading", "pushed", "agreement", "contradiction"]
        per_joint = ["friction", "friction_std", "link_torque", "residual", "joint_acceleration"]
        per_joint += ["doubt", "rested", "proven", "law_velocity", "friction_there", "largest"]
        per_joint += ["fastest", "at_fastest"]
        per_joint += ["slope", "steepest", "missing_inertia", "missing_inertia_std"]
        posterior_type = record_type(
            time=(),
            status=(),
            late=(),
            lag=(),
            surprise=(),
            accelerometer=imu_noise_type(),
            **dict.fromkeys(per_row, (r,)),
            **dict.fromkeys(per_joint, (n,)),
            **dict.fromkeys(("foot_noise", "force_noise"), (feet,)),
            **dict.fromkeys(("wrench", "wrench_change"), (feet, 6)),
            **dict.fromkeys(("parameters", "parameter_variance"), (n, self._regressor.parameters)),
            **dict.fromkeys(("weights", "settled", "regressor"), (n, m)),
            covariance=(2 * r + n * m, 2 * r + n * m),
            force_balance=force_balance_type(feet),
            now=motion_type(robot),
            pad_mean=(len(pads.position), 3),
        )
        super().__init__(posterior_type, clock)
        self._tick_type = _tick_type(n, 2 * r + n * m)
        gyro = required(sensors.angular_velocity_noise, "angular_velocity_noise")
        encoder = required(sensors.joint_velocity_noise, "joint_velocity_noise")
        self._known = record(
            config=config,
            sensors=sensors,
            reading=clock.reading,
            mount=record(**vars(ImuMount(robot))),
            pads=record(position=pads.position, foot=pads.foot),
            is_flat=np.array([float(not leg.is_point) for leg in legs.values()]),
            has_pads=np.array([float(not leg.has_six_axes) for leg in legs.values()]),
            wrench_variance=np.array([wrench_variance(sensors, robot, side) for side in legs]),
            learns_noise=sensors.learns_force_noise,
            weight_variance=self._weight_deviations() ** 2,
            weights=self._start()["weights"],
            variance=np.repeat([gyro**2, encoder**2], [3, n]),
            weight=GRAVITY * robot.total_mass,
            rotor_inertia=robot.rotor_inertias,
        )
        self._measurements = self._declare_record_input("measurements", measurements)
        self._model = self._declare_record_input("model_over_step", model_over_step)
        self._attitude = self._declare_record_input("attitude", attitude)
        self._hears_delay = "force_delay" in (attitude.names or ())
        self._torque_command = self._declare_remembered_input("torque_command", n)
        ticks = remembered_ticks(clock) if self._hears_delay else 1
        self._past = self._declare_history("now", ticks)
        self._believed = BelievedTorque(torque_effects, n, clock.period)
        if torque_effects:
            start, advanced = self._believed.start, weakly(self._remembered_of_effects)
            self._of_effects = self._declare_advanced(start, advanced)
        self._no_torque = np.zeros((2, n))
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        return {
            "measurements": measurements_type(robot),
            "model_over_step": model_type(robot),
            "attitude": record_type(acceleration_bias=(3,), angular_velocity_bias=(3,)),
        }

    def findings(self, context: Context) -> tuple[str, ...]:
        x = as_record(context.get_discrete_state().value(0), self.posterior_type)
        balance = x["force_balance"]
        told = [
            f"Forces of the {foot} foot were found to be read {abs(100 * gain / (1 + gain)):.1f} % "
            f"too {'small' if gain > 0 else 'large'} (in a model: !FootForceGain)."
            for foot, gain in zip(self._feet, balance["gains"], strict=True)
            if abs(gain) > _TOLD_GAIN
        ]
        mass = float(balance["mass"])
        if abs(mass) > _TOLD_MASS:
            told.append(
                f"The feet carry {abs(100 * mass):.1f} % {'more' if mass > 0 else 'less'} than the "
                "model weighs (in a model: !BodyMass; or !FootForceGain of all feet)."
            )
        return tuple(told)

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, attitude = self._measurements.Eval(context), self._attitude.Eval(context)
        torque_command, past = self._torque_command.Eval(context), self._past.Eval(context)
        model, regressor, known = self._model.Eval(context), self._regressor, self._known
        shaped, lag, delay, usual_delay = regressor.shaped, 0.0, 0.0, _NO_DELAY
        pad_force = measured["mean"]["pad_force"]
        if math.isnan(elapsed):
            last = self._start()
        if self._hears_delay:
            heard = attitude["force_delay"]
            delay, usual_delay = heard["delay"].item(), heard["usual"]
            lag, pad_force = attitude["force_lag"]["time_constant"].item(), attitude["pad_force"]
        tick, believed = np.empty((), self._tick_type), self._no_torque
        if self._believed.effects:
            memory = self._of_effects.Eval(context)
            believed = np.array(self._believed.torque_and_slope(memory, self._motion(context)))
        _begin(
            posterior, last, elapsed, measured, model, attitude, torque_command, believed,
            pad_force, past, lag, delay, usual_delay, tick, known,
        )  # fmt: skip
        law = regressor(tick["velocity"])
        if tick["duration"] > 0.0:
            _expect(posterior, last, tick, law, shaped, known)
            law = regressor(tick["velocity"])
        law_now = regressor(measured["joint_velocity"]) if posterior["late"] > 0.0 else law
        _finish(
            posterior, last, elapsed, tick, law, law_now, shaped, measured, torque_command, past,
            known,
        )  # fmt: skip

    def _motion(self, context: Context) -> JointMotion:
        """The tick that ends now, as effects in the joints see it, but for their memories."""
        last = as_record(context.get_discrete_state().value(0), self.posterior_type)
        velocity = self._measurements.Eval(context)["joint_velocity"]
        # What is no number, a status tells.
        command = np.nan_to_num(self._torque_command.Eval(context))
        start, load = np.nan_to_num(last["time"]), last["link_torque"]
        rotors = self._known["rotor_inertia"]
        return JointMotion(velocity, command=command, time=start, load=load, rotor_inertia=rotors)

    def _remembered_of_effects(self, context: Context) -> np.ndarray:
        """What effects in the joints remember at the end of the tick."""
        position, memory = self._measurements.Eval(context)["joint_position"], self._of_effects
        return self._believed.remembered(memory.Eval(context), self._motion(context), position)

    def _start(self) -> np.ndarray:
        """What is known before the first tick."""
        config, regressor, start = self._config, self._regressor, np.zeros((), self.posterior_type)
        n = len(start["weights"])
        start["weights"][:, : regressor.parameters] = regressor.initial
        start["settled"] = start["weights"]
        start["noise"] = start["bend_noise"] = start["foot_noise"] = 1.0
        start["surprise"] = start["agreement"] = 1.0
        lacking = np.repeat([config.moment_uncertainty, config.disturbance_uncertainty], [3, n])
        weights = np.tile(self._weight_deviations(), n)
        deviations = np.concatenate([np.zeros(3 + n), lacking, weights])
        start["covariance"] = np.diag(deviations**2)
        # As a posterior is: functions are compiled once for both.
        start.flags.writeable = False
        return start

    def _weight_deviations(self) -> np.ndarray:
        """Initial standard deviation of the weights of a joint, (m,)."""
        config, regressor = self._config, self._regressor
        weights = np.full(regressor.weights + 1, config.shape_uncertainty)
        weights[: regressor.parameters] = config.parameter_uncertainty
        weights[-1] = config.inertia_uncertainty
        return weights
