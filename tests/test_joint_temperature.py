"""A sensor in one file: windings that warm up, by closed forms; and a sensor of a user's own."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, Sine

from fbse_drake import InputError, Log, Scenario, load_scenario, signals, simulate
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import RobotConfig, SensorsConfig, dump_scenario
from fbse_drake.sensors import sensor
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.sensors.joint_temperature import JointTemperature
from fbse_drake.sensors.sensor import Run
from fbse_drake.walking.reference import JointSines

ROBOT, _ = make_robot("pendulum")
HEAT = {"copper_loss": {"all": 2.0}, "resistance": {"all": 1.5}, "time_constant": {"all": 0.4}}
AMBIENT, START = 15.0, 25.0


def temperatures(
    config: JointTemperature,
    torque: System,
    loss: float = 0.0,
    velocity: float = 0.0,
    end: float = 1.0,
) -> np.ndarray:
    """What is read every 10 ms, from 0 to `end` [s], of a pendulum's motor."""
    builder = DiagramBuilder()
    thermometer = builder.AddSystem(config.system(ROBOT, Run(0.001, 3, end)))
    state = builder.AddSystem(ConstantVectorSource([0.3, velocity]))
    lost = builder.AddSystem(ConstantVectorSource([loss]))
    builder.AddSystem(torque)
    sources = (("joint_state", state), ("torque_loss", lost), ("torque_command", torque))
    for name, source in sources:
        builder.Connect(source.get_output_port(0), thermometer.GetInputPort(name))
    sink = LogVectorOutput(thermometer.GetOutputPort("measured_temperature"), builder, 0.01)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(end)
    return sink.FindLog(simulator.get_context()).data()[0]


def test_constant_torque_and_friction_warm_a_winding_exponentially():
    around = {"ambient": AMBIENT, "start": START}
    config = JointTemperature(**HEAT, friction_share={"all": 0.5}, **around, period=0.001)
    read = temperatures(config, ConstantVectorSource([3.0]), loss=2.0, velocity=4.0)
    power = 2.0 * 3.0**2 + 0.5 * 2.0 * 4.0
    final = AMBIENT + 1.5 * power
    time = np.arange(len(read)) * 0.01
    np.testing.assert_allclose(read, final + (START - final) * np.exp(-time / 0.4), atol=1e-9)


def test_power_that_a_spring_gives_back_does_not_cool():
    around = {"ambient": AMBIENT, "start": AMBIENT}
    config = JointTemperature(**HEAT, friction_share={"all": 1.0}, **around, period=0.001)
    read = temperatures(config, ConstantVectorSource([0.0]), loss=2.0, velocity=-4.0)
    np.testing.assert_array_equal(read, AMBIENT)


def test_half_the_step_is_half_the_error():
    """Torque a sin(w t): power k a^2 (1 - cos 2wt) / 2 through the low-pass of the winding."""
    a, w, tau, gain = 3.0, 4.0, 0.4, 1.5 * 2.0
    error = []
    for period in (0.01, 0.005, 0.0025):
        config = JointTemperature(**HEAT, ambient=0.0, start=0.0, period=period)
        read = temperatures(config, Sine(a, w, 0.0, 1))
        t = np.arange(len(read)) * 0.01
        wave = (np.cos(2 * w * t) + 2 * w * tau * np.sin(2 * w * t)) / (1 + (2 * w * tau) ** 2)
        start = 1 - 1 / (1 + (2 * w * tau) ** 2)
        exact = gain * a**2 / 2 * (1 - wave - start * np.exp(-t / tau))
        error.append(np.abs(read - exact).max())
    assert error[0] < 0.02 * gain * a**2
    np.testing.assert_allclose(np.divide(error[:-1], error[1:]), 2.0, rtol=0.1)


def swinging(seed: int = 0, **thermometer: object) -> Scenario:
    return Scenario(
        duration=0.5,
        seed=seed,
        robot=RobotConfig("pendulum"),
        reference=JointSines(amplitude={"servo": 0.5}, frequency={"servo": 1.0}, ramp=0.1),
        sensors=SensorsConfig(more={"winding": JointTemperature(**thermometer)}),
    )


def test_a_log_has_the_temperature_with_its_unit_and_noise_of_the_seed(tmp_path: Path):
    noisy = {"noise": 0.5, "resolution": 0.1, "copper_loss": {"all": 0.0}}
    log = simulate(swinging(**noisy)).log
    read = log["joint/temperature"]
    assert read.shape == (501, 1)
    assert log.unit("joint/temperature") == "degC"
    assert read.std() == pytest.approx(0.5, rel=0.15)
    np.testing.assert_allclose(read / 0.1, np.round(read / 0.1), atol=1e-9)
    np.testing.assert_array_equal(read, simulate(swinging(**noisy)).log["joint/temperature"])
    assert not np.array_equal(read, simulate(swinging(1, **noisy)).log["joint/temperature"])
    log.save(tmp_path / "log.npz")
    np.testing.assert_array_equal(Log.load(tmp_path / "log.npz")["joint/temperature"], read)
    # Nothing else in the loop is touched by it.
    without = simulate(dataclasses.replace(swinging(), sensors=SensorsConfig())).log
    assert set(log) - set(without) == {"joint/temperature"}
    assert all(np.array_equal(values, log[name]) for name, values in without.items())


def test_temperature_in_a_run_is_that_of_the_commanded_torque():
    heat = {"copper_loss": {"all": 50.0}, "resistance": {"all": 1.0}, "time_constant": {"all": 0.2}}
    log = simulate(swinging(**heat, ambient=0.0, start=0.0)).log
    keep, expected = np.exp(-0.001 / 0.2), [0.0]
    for torque in log["joint/torque_command"][:-1, 0]:
        expected.append(keep * expected[-1] + (1 - keep) * 50.0 * torque**2)
    np.testing.assert_allclose(log["joint/temperature"][:, 0], expected, rtol=1e-9, atol=1e-12)
    assert expected[-1] > 1e-3


def test_a_scenario_says_it_and_reads_it_back(tmp_path: Path):
    path = tmp_path / "warm.yaml"
    path.write_text(
        "warm:\n  sensors: {more: {winding: !JointTemperature {ambient: 30, noise: 0.2}}}\n"
    )
    warm = load_scenario(path)
    expected = JointTemperature(ambient=30.0, noise=0.2, period=warm.usual_period)
    assert warm.sensors.more == {"winding": expected}
    path.write_text(dump_scenario(warm, "warm"))
    again = load_scenario(path)
    assert again.sensors == warm.sensors
    assert dump_scenario(again, "warm") == path.read_text()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            "{a: !JointTemperature {}, b: !JointTemperature {}}",
            r"more\.b: gives measured_temperature, as a does",
        ),
        (
            "{a: !EncoderConfig {}}",
            r"more\.a: expected one of .*!JointTemperature, found the tag !EncoderConfig",
        ),
        ("{imu: !JointTemperature {}}", r"more\.imu: there is a sensor of this name already"),
        (
            "{a: !JointTemperature {period: 0.0015}}",
            r"sensors\.more\.a\.period: expected a whole multiple",
        ),
        (
            "{a: !JointTemperature {resistance: {elbow: 1}}}",
            r"sensors\.more\.a\.resistance\.elbow: unknown joint",
        ),
        (
            "{a: !JointTemperature {resistance: {all: -1}}}",
            r"resistance\.all: expected a number >= 0",
        ),
        (
            "{a: !JointTemperature {time_constant: {all: 0}}}",
            r"time_constant\.all: expected a number > 0",
        ),
        (
            "{a: !Thermometer {}}",
            r"sensors\.more\.a: expected one of .*!JointTemperature, found the tag !Thermometer",
        ),
    ],
)
def test_refusals(tmp_path: Path, more: str, message: str):
    path = tmp_path / "warm.yaml"
    path.write_text(f"warm: {{sensors: {{more: {more}}}}}\n")
    with pytest.raises(InputError, match=message):
        load_scenario(path)


MINE = """
from dataclasses import dataclass
from typing import ClassVar

from pydrake.systems.framework import LeafSystem

from fbse_drake.sensors.sensor import Sensor, in_library
from fbse_drake.signals import Signal


@in_library
@dataclass(frozen=True)
class StrainGauge(Sensor):
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("joint/strain", "1", ("n",), "measured_strain"),
    )

    gain: float = 1.0e-6

    def system(self, robot, run):
        return Gauges(self, len(robot.joint_names))


class Gauges(LeafSystem):
    def __init__(self, config, joints):
        super().__init__()
        self._torque = self.DeclareVectorInputPort("torque_command", joints)
        self._gain = config.gain
        self.DeclareVectorOutputPort("measured_strain", joints, self._calc)

    def _calc(self, context, output):
        output.SetFromVector(self._gain * self._torque.Eval(context))
"""


@pytest.fixture
def _library_as_before(monkeypatch: pytest.MonkeyPatch):
    """Takes out again what a test puts into the library and the table of signals."""
    monkeypatch.setattr(sensor, "_LIBRARY", sensor.library())
    monkeypatch.setattr(signals, "_TABLE", list(signals._TABLE))


@pytest.mark.usefixtures("_library_as_before")
def test_a_sensor_of_a_user_s_own(tmp_path: Path):
    (tmp_path / "strain.py").write_text(MINE)
    path = tmp_path / "mine.yaml"
    path.write_text(
        "mine:\n  duration: 0.05\n  effect_modules: [strain.py]\n  robot: {description: pendulum}\n"
        "  reference: !JointSines {amplitude: {all: 0.1}, frequency: {all: 1.0}}\n"
        "  sensors: {more: {gauges: !StrainGauge {gain: 2.0e-6}}}\n"
    )
    log = simulate(load_scenario(path)).log
    np.testing.assert_array_equal(log["joint/strain"], 2e-6 * log["joint/torque_command"])
    log.save(tmp_path / "log.npz")
    assert Log.load(tmp_path / "log.npz").unit("joint/strain") == "1"
    # The scenario of the log says it, too.
    path.write_text(log.meta["scenario"])
    assert load_scenario(path, "scenario").sensors.more["gauges"].gain == 2e-6


@pytest.mark.usefixtures("_library_as_before")
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("signals:", "signs:", r"sensor StrainGauge: the class variable signals is missing"),
        ("def system", "def systems", r"sensor StrainGauge: the method system is missing"),
        (
            "joint/strain",
            "joint/position",
            r"sensor StrainGauge: channel joint/position: there is one",
        ),
        ("measured_strain", "measured_imu", r"sensor StrainGauge: port measured_imu: there is one"),
        (
            "StrainGauge",
            "JointTemperature",
            r"sensor JointTemperature: the library has another sensor of this name",
        ),
    ],
)
def test_a_bad_sensor_gets_one_line(tmp_path: Path, old: str, new: str, message: str):
    (tmp_path / "strain.py").write_text(MINE.replace(old, new))
    path = tmp_path / "mine.yaml"
    path.write_text("mine: {effect_modules: [strain.py]}\n")
    with pytest.raises(InputError, match=message):
        load_scenario(path)


@pytest.mark.usefixtures("_library_as_before")
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"torque_command"',
            '"voltage"',
            r"sensor gauges: input voltage: there is no port of this name",
        ),
        (
            'Port("measured_strain"',
            'Port("strain"',
            r"sensor gauges: expected the output ports measured_strain, found strain",
        ),
    ],
)
def test_a_sensor_that_does_not_fit_the_robot_gets_one_line(
    tmp_path: Path, old: str, new: str, message: str
):
    (tmp_path / "strain.py").write_text(MINE.replace(old, new))
    path = tmp_path / "mine.yaml"
    path.write_text(
        "mine:\n  effect_modules: [strain.py]\n  robot: {description: pendulum}\n  reference: "
        "!JointSines {}\n"
        "  sensors: {more: {gauges: !StrainGauge {}}}\n"
    )
    with pytest.raises(InputError, match=message):
        simulate(load_scenario(path))


def test_the_usual_sensors_are_in_the_library():
    assert {"EncoderConfig", "ImuConfig", "FootForceConfig", "JointTorqueConfig"} < set(
        sensor.library()
    )
    assert EncoderConfig.ports() == ["measured_joint_state"]
