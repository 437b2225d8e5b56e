"""Motors that are not commanded a torque, and motors that give less than their command: laws
against closed forms."""

import numpy as np
import pytest

from fbse_drake.effects.actuation import DcMotor, TorqueRollOff
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect
from fbse_drake.robot.description import load_description

NAMES, _ = load_description("pendulum")
KT, RESISTANCE, VOLTAGE = 0.35, 3.4, 7.4
MOTOR = DcMotor(kt={"servo": KT}, resistance={"servo": RESISTANCE})


def loss(
    effect: JointTorqueEffect, command: np.ndarray, velocity: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Loss [Nm] and its slope [Nm s/rad], (N,) each."""
    motion = JointMotion(
        np.broadcast_to(velocity, command.shape)[:, None], command=command[:, None]
    )
    torque, slope = effect.resolve(NAMES).torque_and_slope(motion)
    return torque[:, 0], np.broadcast_to(slope, torque.shape)[:, 0]


def test_a_dc_motor_stands_at_its_stall_torque_and_runs_out_of_it_at_its_no_load_speed():
    stall, no_load = KT * VOLTAGE / RESISTANCE, VOLTAGE / KT
    speed = np.linspace(-no_load, no_load, 21)
    command = np.full(21, stall)
    torque = command - loss(MOTOR, command, speed)[0]
    # The line from stall to no load, on which the voltage is V = R i + kt w and the torque kt i.
    np.testing.assert_allclose(torque, stall * (1 - speed / no_load), atol=1e-12)
    np.testing.assert_allclose(VOLTAGE, RESISTANCE * torque / KT + KT * speed)
    np.testing.assert_allclose(loss(MOTOR, command, speed)[1], KT**2 / RESISTANCE)


def test_an_open_motor_brakes_nothing():
    command = np.array([0.0, 1e-9, -0.5])
    torque, slope = loss(MOTOR, command, 3.0)
    np.testing.assert_allclose(torque, KT**2 / RESISTANCE * 3.0 * np.array([0.0, 1.0, 1.0]))
    np.testing.assert_allclose(slope, KT**2 / RESISTANCE * np.array([0.0, 1.0, 1.0]))


def test_a_joint_without_a_motor_in_the_file_loses_nothing():
    names, _ = load_description("biped")
    resolved = DcMotor(kt={"left_knee_pitch": 0.1}, resistance={"left_knee_pitch": 1.0}).resolve(
        names
    )
    torque, _ = resolved.torque_and_slope(JointMotion(np.full(12, 2.0), command=np.full(12, 1.0)))
    np.testing.assert_allclose(
        torque, np.where(np.array(names.joint_names) == "left_knee_pitch", 0.02, 0.0)
    )


@pytest.mark.parametrize("half", [0.7, 5.0])
def test_torque_rolls_off_to_half_of_the_command(half: float):
    effect = TorqueRollOff(half={"servo": half})
    command = half * np.array([-1.0, 1e-4, 1.0, 3.0])
    torque, _ = loss(effect, command)
    np.testing.assert_allclose(
        command - torque, half * np.array([-1 / 2, 1e-4 / 1.0001, 1 / 2, 3 / 4]), rtol=1e-12
    )
    # Ever more torque comes of ever more command, but never as much as `half`.
    given = (lambda c: c - loss(effect, c)[0])(np.linspace(0.0, 100 * half, 200))
    assert np.all(np.diff(given) > 0)
    assert given[-1] < half
