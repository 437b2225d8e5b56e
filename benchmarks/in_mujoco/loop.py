"""The closed loop in MuJoCo: a robot follows a plan, and its sensors are recorded as a log."""

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.in_mujoco.physics import Physics, Readings
from benchmarks.in_mujoco.robot import Machine, make_machine, pad_bodies
from fbse_drake import Log
from fbse_drake.control.position_loop import position_loop
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.robot.plant import Ground
from fbse_drake.scenario import Scenario, build_robot, dump_scenario
from fbse_drake.sensors.errors import ticks_until, white_noise
from fbse_drake.sensors.imu import imu_errors
from fbse_drake.walking.reference import Reference

# The robot stands in its first posture for this long before it is recorded [s].
_SETTLING = 0.5
# A joint that is so far from its reference has lost it [rad].
_ASTRAY = 0.5


class FellError(Exception):
    """The robot fell or lost its reference, so that its log says nothing."""


@dataclass(frozen=True)
class Run:
    """How a robot runs in MuJoCo."""

    # Sensors, gains, periods and ground; also what is believed of the robot.
    scenario: Scenario
    # Of the sensors' noise.
    seed: int
    physics: Physics
    # Gains of the controller over those of the scenario.
    gain: float = 1.0
    ground: Ground | None = None
    integrator: str = "implicitfast"
    # MuJoCo's step [s].
    time_step: float = 2.5e-4


@dataclass(frozen=True)
class _States:
    """What was recorded at every tick of the control, (N, ...) each."""

    command: np.ndarray
    # As the encoders read them.
    position: np.ndarray
    velocity: np.ndarray
    # MuJoCo's positions and velocities.
    qpos: np.ndarray
    qvel: np.ndarray
    # Mean of MuJoCo's sensors over the period that ends, (N, P, 3).
    pad_force: np.ndarray


def record(run: Run, reference: Reference, name: str) -> Log:
    """Runs a robot along a reference.

    Commands are held over the control's period, in which MuJoCo takes several steps. Of the IMU and
    of the forces a row holds the mean over the period that ends there; of the torque, the command
    of the period that begins there, with the noise that `scenario.recording.torque_noise` says.

    Args:
        reference: sampled at the ticks of the control.
        name: what the scenario is called in the log.

    Raises:
        FellError: see there.
    """
    scenario = run.scenario
    robot = build_robot(scenario.robot)
    physics, period = run.physics, scenario.control.period
    machine = make_machine(
        robot,
        ground=(run.ground or scenario.ground) if robot.has_floating_base else None,
        edits=(physics.edit,),
        behind=physics.behind,
        time_step=run.time_step,
        integrator=run.integrator,
    )
    physics.change(machine.model)
    states = _simulate(run, machine, reference)
    readings = Readings(
        *_imu(machine, states, period, physics.imu_shift)
        if robot.has_floating_base
        else np.zeros((2, len(states.command), 3)),
        states.pad_force,
    )
    return _log(run, machine, states, physics.read(robot, readings), reference, name)


def _simulate(run: Run, machine: Machine, reference: Reference) -> _States:
    scenario, robot, model = run.scenario, machine.robot, machine.model
    names, encoders, control = robot.description, scenario.sensors.encoders, scenario.control
    kp, kd, limit = (
        names.per_joint(values, key="control")
        for values in (control.kp, control.kd, control.torque_limit)
    )
    data = mujoco.MjData(model)
    _set_start(machine, data, reference, run.ground or scenario.ground)
    height = data.qpos[2] if robot.has_floating_base else 1.0
    drive = run.physics.drive(robot, run.time_step)
    substeps, n = round(control.period / run.time_step), len(robot.joint_names)
    settling, ticks = round(_SETTLING / control.period), len(reference.time)
    noise = white_noise(run.seed, "encoders", ticks + settling, 2 * n)
    rows = {name: [] for name in _States.__annotations__}
    force = np.zeros(model.nsensordata)
    for tick in range(-settling, ticks):
        row, errors = max(tick, 0), noise[tick + settling]
        q, v = machine.joint_state(data)
        angle = run.physics.encoder(robot, q) + encoders.noise * errors[:n]
        if encoders.resolution:
            angle = encoders.resolution * np.round(angle / encoders.resolution)
        rate = v + encoders.velocity_noise * errors[n:]
        torque = position_loop(
            reference.joint_position[row] - angle,
            reference.joint_velocity[row] - rate,
            run.gain * kp,
            run.gain * kd,
        )
        command = np.clip(torque + reference.feedforward_torque[row], -limit, limit)
        if tick >= 0:
            values = (command, angle, rate, data.qpos.copy(), data.qvel.copy(), force)
            for channel, value in zip(rows.values(), values, strict=True):
                channel.append(value)
        force = np.zeros(model.nsensordata)
        for _ in range(substeps):
            data.ctrl[:] = drive(
                command, data.qpos[machine.position_index], data.qvel[machine.velocity_index]
            )
            mujoco.mj_step(model, data)
            # Of the pad on its foot; what the ground does to the pad is against it.
            force -= data.sensordata / substeps
        astray = np.abs(reference.joint_position[row] - q).max()
        fell = robot.has_floating_base and data.qpos[2] < scenario.fall.height_ratio * height
        if fell or not astray < _ASTRAY:
            raise FellError(f"fell or left its reference at {tick * control.period:.2f} s")
    channels = {name: np.array(values) for name, values in rows.items()}
    channels["pad_force"] = channels["pad_force"].reshape(ticks, -1, 3)
    return _States(**channels)


def _set_start(machine: Machine, data: mujoco.MjData, reference: Reference, ground: Ground) -> None:
    """The reference's first posture, on its lowest pad and as deep in the ground as carries the
    weight."""
    data.qpos[machine.position_index] = reference.joint_position[0]
    if machine.robot.has_floating_base:
        weight = -machine.model.opt.gravity[2] * machine.model.body_mass.sum()
        data.qpos[:3] = reference.base.position[0]
        data.qpos[3:7] = [1.0, 0.0, 0.0, 0.0]
        pads = [data.body(name) for name in pad_bodies(machine.robot)]
        mujoco.mj_kinematics(machine.model, data)
        x, y, z = np.transpose([pad.xpos - data.qpos[:3] for pad in pads])
        # All pads on one plane, which is turned to be level: legs may differ.
        _, along_x, along_y = np.linalg.lstsq(np.stack([np.ones_like(x), x, y], 1), z)[0]
        level = Rotation.from_rotvec([-along_y, along_x, 0.0])
        data.qpos[3:7] = level.as_quat(scalar_first=True)
        mujoco.mj_kinematics(machine.model, data)
        data.qpos[2] -= min(pad.xpos[2] for pad in pads)
        data.qpos[2] -= weight / (machine.model.nsensor * ground.stiffness)


def _imu(
    machine: Machine, states: _States, period: float, shift: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Specific force, the mean over the period that ends, and rate at its end, in the IMU frame,
    from which the IMU is shifted.

    Returns:
        Shape (N, 3) each [m/s^2], [rad/s]; of the first row the force is that of the second.
    """
    mount = ImuMount(machine.robot)
    R_BI = Rotation.from_matrix(mount.R_BI)
    R_WB = Rotation.from_quat(states.qpos[:, 3:7], scalar_first=True)
    # MuJoCo has the rate of a free body in its own axes.
    w_B = states.qvel[:, 3:6]
    p_BI = mount.p_BI + R_BI.apply(shift)
    velocity = states.qvel[:, :3] + R_WB.apply(np.cross(w_B, p_BI))
    force_W = np.diff(velocity, axis=0) / period - machine.model.opt.gravity
    # The attitude amid the period.
    middle = R_WB[:-1] * Rotation.from_rotvec(0.5 * period * w_B[:-1])
    force_I = (middle * R_BI).inv().apply(force_W)
    return np.vstack([force_I[:1], force_I]), R_BI.inv().apply(w_B)


def _log(
    run: Run,
    machine: Machine,
    states: _States,
    readings: Readings,
    reference: Reference,
    name: str,
) -> Log:
    scenario, robot = run.scenario, machine.robot
    names, ticks = robot.description, len(reference.time)
    period = scenario.control.period
    torque_noise = names.per_joint(
        scenario.recording.torque_noise, key="recording.torque_noise", default=0.0
    )
    channels = {
        "time": reference.time,
        "joint/position": states.position,
        "joint/velocity": states.velocity,
        "joint/torque_command": states.command
        + torque_noise * white_noise(run.seed, "torque", ticks, len(torque_noise)),
        "reference/joint/position": reference.joint_position,
        "reference/joint/velocity": reference.joint_velocity,
        "reference/joint/feedforward_torque": reference.feedforward_torque,
    }
    if robot.has_floating_base:
        errors = imu_errors(scenario.sensors.imu, run.seed, ticks * period)[:ticks]
        channels["imu/linear_acceleration"] = readings.specific_force + errors[:, :3]
        channels["imu/angular_velocity"] = readings.angular_velocity + errors[:, 3:]
        force, first = readings.pad_force, 0
        noise = scenario.sensors.foot_force.noise * white_noise(
            run.seed, "foot force", ticks_until(ticks * period, period), force[0].size
        )
        force = force + noise[:ticks].reshape(force.shape)
        for side, leg in names.legs.items():
            channels[f"foot/{side}/pad_force"] = force[:, first : first + leg.points]
            first += leg.points
    meta = {
        "joints": robot.joint_names,
        "sides": names.sides,
        "legs": {side: leg.joints for side, leg in names.legs.items()},
        "frames": {
            "base": names.base,
            "imu": names.imu,
            "soles": {side: leg.sole for side, leg in names.legs.items()},
        },
        "pads": {side: robot.pad_positions(side).tolist() for side in names.sides},
        "period": period,
        "reading_time": period,
        "command_time": period,
        "source": f"MuJoCo {mujoco.__version__}",
        "title": scenario.title,
        "scenario": dump_scenario(scenario, name),
        "outcome": {
            "finished": True,
            "fell": False,
            "reason": "finished",
            "time": float(reference.time[-1]),
        },
    }
    return Log({key: np.ascontiguousarray(values) for key, values in channels.items()}, meta)
