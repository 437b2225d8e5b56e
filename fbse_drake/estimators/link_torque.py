"""Torque that reaches the links, and what of the motor's torque does not: the measured friction.

(Paper eqs. 34-49.)
"""

import math

import numpy as np
from numba import njit
from pydrake.systems.framework import Context

from fbse_drake.estimators.beliefs import SensorBeliefs
from fbse_drake.estimators.floating_base import model_type
from fbse_drake.estimators.force_delay import remembered_ticks, tick_of
from fbse_drake.estimators.innovations import LOG_OF_SIX, LOG_OF_THREE, learned_noise
from fbse_drake.estimators.records import record, record_type
from fbse_drake.estimators.recursive import Clock, Past, RecursiveEstimator, Status, ticks_ago
from fbse_drake.estimators.sensor_monitor import measurements_type
from fbse_drake.robot.plant import Robot, grasp_map
from fbse_drake.sensors.foot_pads import FootPads, foot_wrenches, leg_of_joint

_NOT_FINITE = float(Status.NOT_FINITE)
# A wrench is beyond its sensors' noise above this quantile of chi^2 with six degrees of freedom
# (one in 3000).
_GATE = 25.1


@njit(cache=True)
def _clear(posterior: np.ndarray, status: float) -> None:
    """Sets a posterior to zero but for its status."""
    posterior.status = status
    posterior.link_torque[:] = 0.0
    posterior.residual[:] = 0.0
    posterior.torque_variance[:] = 0.0
    posterior.impulse_variance[:] = 0.0
    posterior.own_inertia[:] = 0.0
    posterior.valid[:] = 0.0
    now = posterior.now
    now.valid[:] = 0.0
    now.duration = 0.0
    now.torque_command[:] = 0.0
    now.inertial_torque[:] = 0.0
    now.torque_variance[:] = 0.0
    now.impulse_variance[:] = 0.0
    now.own_inertia[:] = 0.0
    now.lever[:] = 0.0


@njit(cache=True)
def watch_forces(
    posterior: np.ndarray, last: np.ndarray, elapsed: float, wrench: np.ndarray, known: np.ndarray
) -> None:
    """Fills by how much the variance of each foot's wrench is larger than believed.

    It shows in second differences, to which forces that change smoothly add little; one tick does
    not tell much, for a foot may just have landed.
    """
    for foot in range(len(wrench)):
        for i in range(6):
            posterior.wrench[foot, i] = wrench[foot, i]
            posterior.wrench_change[foot, i] = wrench[foot, i] - last.wrench[foot, i]
        excess = last.force_noise[foot]
        if math.isnan(elapsed) or not known.learns_noise or excess == 0.0:
            posterior.force_noise[foot] = 1.0
            continue
        variance, measured = known.wrench_variance[foot], 0
        for i in range(6):  # A point foot has no moment.
            measured += variance[i] > 0.0
        share = 0.0
        for i in range(6):
            if variance[i] > 0.0:
                bend = posterior.wrench_change[foot, i] - last.wrench_change[foot, i]
                share += bend * bend / (6.0 * measured * excess * variance[i])
        mean_log = LOG_OF_SIX if measured == 6 else LOG_OF_THREE
        posterior.force_noise[foot] = learned_noise(excess, share, mean_log, elapsed)


@njit(cache=True)
def is_loaded(wrench: np.ndarray, variance: np.ndarray) -> bool:
    """Does a foot show more than its sensors' noise, as load or otherwise?

    One that touches the ground may be held sideways before it carries anything.

    Args:
        wrench, variance: of a foot, and of the noise in it, (6,).
    """
    distance = 0.0
    for i in range(6):
        if variance[i] > 0.0:
            distance += wrench[i] ** 2 / variance[i]
    return wrench[5] > math.sqrt(variance[5]) or distance > _GATE


@njit(cache=True)
def _estimate_link_torque(
    posterior: np.ndarray,
    last: np.ndarray,
    elapsed: float,
    measured: np.ndarray,
    model: np.ndarray,
    acceleration: np.ndarray,
    torque_command: np.ndarray,
    pad_force: np.ndarray,
    delay: float,
    past: Past,
    known: np.ndarray,
) -> None:
    """One tick of `LinkTorqueEstimator`; fills the posterior.

    Args:
        pad_force: over the tick, without what a low-pass does to it, (P, 3) [N].
        delay: by how much the forces are late [s].
        past: the posterior's `now` in the last ticks.
        torque_command: where the tick began, shape (n,) [Nm].
        known: record with the numbers of `SensorBeliefs` as `noise`; `pads`, see `FootPads`;
            `wrench_variance` (feet, 6) of each foot's measured wrench [(Nm)^2, N^2] as believed;
            `joint_leg` (n,), which leg each joint belongs to; `moved` (levers, 2), joints and the
            feet that they move; and `learns_noise`.
    """
    posterior, last, measured = posterior[()], last[()], measured[()]
    model, acceleration, known = model[()], acceleration[()], known[()]
    pads, feet = known.pads, len(known.wrench_variance)
    wrench = foot_wrenches(pad_force, pads.position, pads.foot, feet)
    posterior.late = posterior.duration = 0.0
    watch_forces(posterior, last, elapsed, wrench, known)
    if not np.isfinite(torque_command).all() or not math.isfinite(delay):
        _clear(posterior, _NOT_FINITE)
        return
    if math.isnan(elapsed):
        _clear(posterior, measured.trust.max())
        return
    noise, trust, sensitivity = known.noise, measured.trust, acceleration.sensitivity
    n = len(torque_command)
    v = 6 + n
    posterior.status = trust.max()
    a, to_sensors = np.empty(v), np.empty(v)
    for i in range(3):
        a[i] = acceleration.base_angular_acceleration[i]
        a[3 + i] = acceleration.base_specific_force[i]
    for i in range(n):
        a[6 + i] = acceleration.joint_acceleration[i]
    # What is known now, forces apart, belongs to the forces that are read so much later.
    now, moved = posterior.now, known.moved
    now.duration = elapsed
    for at in range(len(moved)):
        for k in range(6):
            now.lever[at, k] = model.foot_jacobian[moved[at, 1], k, 6 + moved[at, 0]]
    for i in range(n):
        now.torque_command[i] = torque_command[i]
        # Inertia and bias forces, (35) without the wrenches; and what the sensors' noise makes of
        # them.
        inertial_torque = model.bias[i]
        to_sensors[:] = 0.0
        for k in range(v):
            inertia = model.mass_matrix[i, k]
            if inertia != 0.0:  # A joint of another leg.
                inertial_torque += inertia * a[k]
                for j in range(v):
                    to_sensors[j] += inertia * sensitivity[k, j]
        torque_variance, impulse_variance = 0.0, 0.0
        for j in range(v):
            if j < 3:
                impulse_variance += (to_sensors[j] * noise.angular_velocity_noise) ** 2
            elif j < 6:
                torque_variance += (to_sensors[j] * noise.acceleration_noise) ** 2
            else:
                impulse_variance += (to_sensors[j] * noise.joint_velocity_noise) ** 2
        now.inertial_torque[i], now.torque_variance[i] = inertial_torque, torque_variance
        now.impulse_variance[i], now.own_inertia[i] = impulse_variance, to_sensors[6 + i]
        is_known = trust[0] == 0 and trust[1] == 0
        now.valid[i] = acceleration.known[i] if is_known else 0.0
    late = tick_of(elapsed, past, delay)
    then = ticks_ago(past, late) if late > 0 else now
    posterior.late, posterior.duration = late, then.duration
    for i in range(n):
        posterior.link_torque[i] = then.inertial_torque[i]
        posterior.torque_variance[i] = then.torque_variance[i]
        posterior.impulse_variance[i] = then.impulse_variance[i]
        posterior.own_inertia[i] = then.own_inertia[i]
    for foot in range(feet):
        variance = posterior.force_noise[foot] * known.wrench_variance[foot]
        if not is_loaded(wrench[foot], variance):
            continue
        for at in range(len(moved)):
            if moved[at, 1] == foot:
                i = moved[at, 0]
                for k in range(6):
                    lever = then.lever[at, k]
                    posterior.link_torque[i] -= wrench[foot, k] * lever
                    posterior.torque_variance[i] += variance[k] * lever * lever
    for i in range(n):
        posterior.residual[i] = then.torque_command[i] - posterior.link_torque[i]
        is_trusted = trust[2 + known.joint_leg[i]] == 0
        posterior.valid[i] = then.valid[i] if is_trusted else 0.0


def moved_feet(robot: Robot) -> np.ndarray:
    """Which feet each joint moves: pairs of a joint and a foot, (levers, 2)."""
    plant, soles = robot.plant, [robot.sole(side).body() for side in robot.description.sides]
    pairs = [
        (i, foot)
        for i, name in enumerate(robot.joint_names)
        for foot, sole in enumerate(soles)
        if sole.index()
        in plant.GetBodiesKinematicallyAffectedBy([plant.GetJointByName(name).index()])
    ]
    return np.array(pairs, dtype=int).reshape(-1, 2)


def wrench_variance(sensors: SensorBeliefs, robot: Robot, side: str) -> np.ndarray:
    """Of the noise in a foot's measured wrench [moment, force], (6,) [(Nm)^2, N^2]."""
    if robot.description.legs[side].has_six_axes:
        return np.repeat([sensors.moment_noise**2, sensors.force_noise**2], 3)
    return sensors.force_noise**2 * (grasp_map(robot.pad_positions(side)) ** 2).sum(axis=1)


class LinkTorqueEstimator(RecursiveEstimator):
    """Link torque by the reduced model, and the friction measured with it.

    The friction is u_F = tau - tau_link (eqs. 34-38, 45, 49).

    .. pydrake_system::

        name: LinkTorqueEstimator
        input_ports:
        - measurements
        - model_over_step
        - joint_acceleration
        - base_state
        - torque_command
        output_ports:
        - posterior
        - (one for each field)

    All terms belong to the tick that ends now: posture, velocities and torque command where it
    began, accelerations and forces over it. So they have one group delay, and only their
    difference, the friction, is ever filtered. `torque_command` (n,) [Nm] is remembered for the
    next tick, so that the estimate of a tick does not depend on the command that is made from it.
    Fields of the posterior, each (n,):

        link_torque        tau_link [Nm]; what passes the joint to its link
        residual           tau - tau_link [Nm]; friction, with the sensors' noise unfiltered
        torque_variance    of the residual's part that is white: accelerometer and foot forces
                           [Nm^2]
        impulse_variance   of that part's time integral that is white: gyro and encoders, which are
                           differentiated [(Nm s)^2]
        own_inertia        by which noise of the joint's own velocity is in that integral [kg m^2]
        valid              1 where all that the residual needs was known

    `base_state` is there where somebody knows that foot forces come late: then all this is of the
    tick in which they were what is read now. Further `late`, how many ticks ago that was, and its
    `duration` [s]; `now`, what is known of the tick that ends now but for the forces: `duration`;
    `valid`, `torque_command`, `inertial_torque` and the noise's `torque_variance`,
    `impulse_variance` and `own_inertia`, (n,); and the `lever` of a foot's wrench at each joint
    that moves it, (levers, 6), see `moved_feet`; it is remembered as long as forces may be late;
    and `force_noise` (feet,), by how much the variance of each foot's wrench is larger than
    believed, at least 1; `wrench` (feet, 6) [Nm, N] and its last change `wrench_change`.

    A foot that shows no more than its sensors' noise counts as unloaded.
    """

    def __init__(
        self,
        sensors: SensorBeliefs,
        robot: Robot,
        measurements: np.dtype,
        model_over_step: np.dtype,
        joint_acceleration: np.dtype,
        clock: Clock,
        base_state: np.dtype | None = None,
    ):
        """Declares ports and state.

        Args:
            measurements, model_over_step, joint_acceleration: types of the inputs.
            base_state: of that of `InvariantBaseFilter`, where somebody asks how late forces are.
        """
        n, legs = len(robot.joint_names), robot.description.legs
        kept = ("valid", "torque_command", "inertial_torque")
        kept += ("torque_variance", "impulse_variance", "own_inertia")
        moved = moved_feet(robot)
        posterior_type = record_type(
            time=(),
            status=(),
            link_torque=(n,),
            residual=(n,),
            torque_variance=(n,),
            impulse_variance=(n,),
            own_inertia=(n,),
            valid=(n,),
            force_noise=(len(legs),),
            wrench=(len(legs), 6),
            wrench_change=(len(legs), 6),
            late=(),
            duration=(),
            now=record_type(**dict.fromkeys(kept, (n,)), duration=(), lever=(len(moved), 6)),
        )
        super().__init__(posterior_type, clock)
        pads = FootPads(robot)
        variance = np.array([wrench_variance(sensors, robot, side) for side in legs])
        self._known = record(
            noise=sensors,
            pads=record(position=pads.position, foot=pads.foot),
            wrench_variance=variance,
            learns_noise=sensors.learns_force_noise,
            moved=moved,
            joint_leg=leg_of_joint(robot),
        )
        self._measurements = self._declare_record_input("measurements", measurements)
        self._model = self._declare_record_input("model_over_step", model_over_step)
        self._acceleration = self._declare_record_input("joint_acceleration", joint_acceleration)
        self._base_state = None
        if base_state is not None:
            self._base_state = self._declare_record_input("base_state", base_state)
        self._torque_command = self._declare_remembered_input("torque_command", n)
        ticks = 1 if base_state is None else remembered_ticks(clock)
        self._past = self._declare_history("now", ticks)
        self._declare_posterior()

    @staticmethod
    def input_types(robot: Robot) -> dict[str, np.dtype]:
        n = len(robot.joint_names)
        v = 6 + n
        return {
            "measurements": measurements_type(robot),
            "model_over_step": model_type(robot),
            "joint_acceleration": record_type(
                base_angular_acceleration=(3,),
                base_specific_force=(3,),
                joint_acceleration=(n,),
                known=(n,),
                sensitivity=(v, v),
            ),
        }

    def _tick(
        self, context: Context, last: np.ndarray, elapsed: float, posterior: np.ndarray
    ) -> None:
        measured, delay = self._measurements.Eval(context), 0.0
        pad_force = measured["mean"]["pad_force"]
        if self._base_state is not None:
            heard = self._base_state.Eval(context)
            delay, pad_force = float(heard["force_delay"]["delay"]), heard["pad_force"]
        _estimate_link_torque(
            posterior,
            last,
            elapsed,
            measured,
            self._model.Eval(context),
            self._acceleration.Eval(context),
            self._torque_command.Eval(context),
            pad_force,
            delay,
            self._past.Eval(context),
            self._known,
        )
