import numpy as np
import pytest
from conftest import scenario
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.spatial.transform import Rotation

from fbse_drake import simulate
from fbse_drake.errors import InputError
from fbse_drake.estimators.zmp import zero_moment_point
from fbse_drake.sensors.encoders import EncoderConfig, Encoders, quantize
from fbse_drake.sensors.errors import held_signal, white_noise
from fbse_drake.sensors.imu import ImuConfig, imu_errors


def test_white_noise_is_white_and_its_own():
    noise = white_noise(0, "a", 20000, 3)
    assert np.abs(noise.mean(axis=0)).max() < 4 / np.sqrt(20000)
    np.testing.assert_allclose(noise.std(axis=0), 1.0, atol=0.03)
    assert np.abs(np.mean(noise[1:] * noise[:-1], axis=0)).max() < 4 / np.sqrt(20000)
    np.testing.assert_array_equal(noise, white_noise(0, "a", 20000, 3))
    assert abs(np.mean(noise * white_noise(0, "b", 20000, 3))) < 0.03
    assert abs(np.mean(noise * white_noise(1, "a", 20000, 3))) < 0.03


@pytest.mark.parametrize("step", [1e-3, 5e-4, 2.5e-4])
def test_held_signal_has_each_value_from_its_tick_on(step: float):
    values = np.arange(2000.0)[:, None]
    source = held_signal(values, 1e-3)
    context = source.CreateDefaultContext()
    for tick in range(0, 8000, 7):
        context.SetTime(tick * step)
        assert source.get_output_port().Eval(context)[0] == min(
            int(tick * step / 1e-3 + 1e-6), 1999
        )


def test_imu_bias_and_walk():
    config = ImuConfig(
        acceleration_bias=[0.1, 0.2, 0.3],
        angular_velocity_bias_walk=0.01,
        period=1e-3,
    )
    errors = imu_errors(config, 0, 400.0)
    np.testing.assert_array_equal(errors[:, :3], np.tile([0.1, 0.2, 0.3], (len(errors), 1)))
    # A random walk of density s has moved by s sqrt(T) after T.
    drift = np.concatenate([imu_errors(config, seed, 4.0)[-1, 3:] for seed in range(60)])
    assert drift.std() == pytest.approx(0.01 * 2.0, rel=0.2)


def test_quantization():
    angle = np.linspace(-1, 1, 1001)
    read = quantize(angle, 0.01)
    assert np.abs(read - angle).max() <= 0.005 + 1e-12
    np.testing.assert_allclose(read / 0.01, np.round(read / 0.01), atol=1e-9)
    np.testing.assert_array_equal(quantize(angle, 0.0), angle)


def test_differenced_velocity_of_a_joint_at_rest_is_zero():
    builder = DiagramBuilder()
    config = EncoderConfig(resolution=1e-3, velocity="differenced", period=1e-3)
    encoders = builder.AddSystem(Encoders(config, 2, seed=0, duration=1.0))
    source = builder.AddSystem(ConstantVectorSource([0.1234, -0.5, 9.0, 9.0]))
    builder.Connect(source.get_output_port(), encoders.get_input_port())
    builder.ExportOutput(encoders.get_output_port())
    diagram = builder.Build()
    reading = diagram.get_output_port().Eval(diagram.CreateDefaultContext())
    np.testing.assert_allclose(reading, [0.123, -0.5, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("config", "value", "message"),
    [
        (EncoderConfig, {"resolution": -1.0}, "resolution: expected a number >= 0"),
        (EncoderConfig, {"velocity": "none"}, "velocity: expected exact or differenced"),
        (ImuConfig, {"acceleration_bias": [1.0]}, "acceleration_bias: expected three numbers"),
    ],
)
def test_impossible_values_are_refused(config: type, value: dict, message: str):
    with pytest.raises(InputError, match=message):
        config(**value)


def test_zmp_of_two_loads():
    position = np.array([[[0.0, 0.1, 0.0], [0.2, -0.1, 0.0]]])
    force = np.array([[[5.0, 0.0, 300.0], [0.0, 7.0, 100.0]]])
    np.testing.assert_allclose(zero_moment_point(force, position), [[0.05, 0.05]])


def test_zmp_is_kept_while_nothing_stands():
    position = np.tile([[[0.0, 0.1, 0.0]]], (4, 1, 1)) + np.arange(4)[:, None, None]
    force = np.zeros((4, 1, 3))
    force[[1, 3], 0, 2] = 100.0
    np.testing.assert_allclose(zero_moment_point(force, position)[:, 0], [1, 1, 1, 3])


def test_force_sensors_read_late_and_with_a_gain():
    quiet = ("duration=0.3", "sensors.foot_force.noise=0")
    exact = simulate(scenario("paper_walk", *quiet)).log["foot/left/pad_force"]
    late = simulate(
        scenario(
            "paper_walk", *quiet, "sensors.foot_force.delay=0.005", "sensors.foot_force.gain=1.02"
        )
    ).log
    np.testing.assert_allclose(late["foot/left/pad_force"][5:], 1.02 * exact[:-5], atol=1e-9)
    assert not late["foot/left/pad_force"][:5].any()


def test_misaligned_imu_reads_the_same_vectors_in_turned_axes():
    quiet = (
        "duration=0.3",
        "sensors.imu.acceleration_noise=0",
        "sensors.imu.angular_velocity_noise=0",
    )
    exact = simulate(scenario("paper_walk", *quiet)).log
    turned = simulate(
        scenario("paper_walk", *quiet, "sensors.imu.misalignment=[0.02, -0.01, 0.03]")
    ).log
    R_IS = Rotation.from_rotvec([0.02, -0.01, 0.03])
    for channel in ("imu/linear_acceleration", "imu/angular_velocity"):
        np.testing.assert_allclose(R_IS.apply(turned[channel]), exact[channel], atol=1e-12)


def test_joint_torque_sensors_read_what_reaches_the_links():
    log = simulate(scenario("paper_walk", "duration=0.3", "sensors.joint_torque={noise: 0.0}")).log
    expected = (log["joint/torque_command"] - log["truth/joint/friction_torque"])[:-1]
    np.testing.assert_allclose(log["joint/torque_measured"][1:], expected, atol=1e-12)


def test_a_sensor_of_ones_own_diagram_needs_a_period():
    """A scenario would give it one."""
    with pytest.raises(InputError, match="period: expected a number"):
        Encoders(EncoderConfig(), joints=2, seed=0, duration=1.0)
