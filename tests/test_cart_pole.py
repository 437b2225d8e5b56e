"""A cart on a rail with a pole that nothing drives: a joint that slides, one that turns as far as
it likes, and a motor's inertia that the model knows in one of them only.

The logs come from the equations of motion written down by hand.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.effects.effect import library
from fbse_drake.effects.transmission import Backlash
from fbse_drake.errors import InputError
from fbse_drake.scenario import RecordingConfig, RobotConfig, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig

# [kg], [m], [kg], [kg m^2], [m/s^2]; a step of the simulation and of the log [s].
CART, POLE, AWAY, ROTOR, INERTIA, GRAVITY = 2.0, 0.35, 0.25, 0.4, 0.0073, 9.81
STEP, PERIOD, NOISE = 5e-4, 5e-3, 0.05
TRIED = ("CoulombFriction", "ViscousFriction", "QuadraticDrag", "Backlash", "TorqueGain")
URDF = f"""<robot name="cart_pole">
<link name="stand"><inertial><mass value="30"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="cart"><inertial><mass value="{CART}"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="stand"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-3" upper="3" effort="500" velocity="30"/></joint>
<link name="bob"><inertial><origin xyz="0 0 {-AWAY}"/><mass value="{POLE}"/>
<inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pole" type="continuous"><parent link="cart"/><child link="bob"/><axis xyz="0 1 0"/>
</joint>
</robot>
"""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    folder = tmp_path_factory.mktemp("cart_pole")
    (folder / "robot.urdf").write_text(URDF)
    description = folder / "robot.yaml"
    description.write_text(
        "base: stand\nurdf: robot.urdf\njoints: [rail, pole]\nfixed_base: true\npassive: [pole]\n"
    )
    return Scenario(
        duration=8.0,
        robot=RobotConfig(str(description), rotor_inertia={"rail": ROTOR, "pole": 0.0}),
        sensors=SensorsConfig(encoders=EncoderConfig(resolution=1e-5, velocity_noise=1e-3)),
        recording=RecordingConfig(rows="instantaneous", torque_noise={"all": NOISE}),
    )


def recording(viscous: tuple[float, float], spin: float = 0.0) -> Log:
    """Runge and Kutta's method; the cart is pushed by three sines and held by a spring [N].

    Args:
        viscous: friction of rail [N s/m] and pole [Nm s/rad].
        spin: of the pole at the start [rad/s].
    """
    time, random = np.arange(0.0, 8.0, STEP), np.random.default_rng(4)

    def push(t: float, x: np.ndarray) -> float:
        drive = 9.0 * np.sin(2.7 * t) + 6.0 * np.sin(5.9 * t) + 4.0 * np.sin(11.3 * t)
        return float(drive - 25.0 * x[0] - 4.0 * x[2])

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        _, angle, speed, turning = x
        coupling = -POLE * AWAY * np.cos(angle)
        M = [[CART + POLE + ROTOR, coupling], [coupling, INERTIA + POLE * AWAY**2]]
        force = push(t, x) - viscous[0] * speed - POLE * AWAY * np.sin(angle) * turning**2
        moment = -viscous[1] * turning - POLE * GRAVITY * AWAY * np.sin(angle)
        return np.array([speed, turning, *np.linalg.solve(M, [force, moment])])

    x, states = np.array([0.0, 0.1, 0.0, spin]), []
    for t in time:
        states.append(x)
        a = rate(t, x)
        b = rate(t + STEP / 2, x + STEP / 2 * a)
        c = rate(t + STEP / 2, x + STEP / 2 * b)
        d = rate(t + STEP, x + STEP * c)
        x = x + STEP / 6 * (a + 2 * b + 2 * c + d)
    every = round(PERIOD / STEP)
    at, rows = time[::every], np.array(states)[::every]
    force = np.array([push(t, row) for t, row in zip(at, rows, strict=True)])
    torque = np.stack([force + NOISE * random.standard_normal(len(at)), 0.0 * at], axis=1)
    velocity = rows[:, 2:] + 1e-3 * random.standard_normal((len(at), 2))
    channels = {"joint/position": rows[:, :2], "joint/velocity": velocity}
    names = {"joints": ["rail", "pole"], "period": PERIOD, "sides": []}
    return Log({"time": at, **channels, "joint/torque_command": torque}, names)


def found(scenario: Scenario, log: Log) -> Diagnosis:
    return diagnose(Predictor(scenario, log), [library()[name] for name in TRIED])


def test_friction_of_both_joints_is_found(scenario: Scenario) -> None:
    diagnosis = found(scenario, recording((4.0, 0.02)))
    of = {finding.targets: finding for finding in diagnosis.chosen}
    assert {finding.effect for finding in diagnosis.chosen} == {"ViscousFriction"}
    assert sorted(target for targets in of for target in targets) == ["pole", "rail"]
    for joint, true in (("rail", 4.0), ("pole", 0.02)):
        (parameters,) = (f.parameters for targets, f in of.items() if joint in targets)
        assert parameters["viscous"].value == pytest.approx(true, rel=0.03)


def test_nothing_is_missing_where_nothing_is_hidden(scenario: Scenario) -> None:
    assert found(scenario, recording((0.0, 0.0))).verdict == "nothing_missing"


def test_joints_have_as_many_points_whatever_is_known_of_them(scenario: Scenario) -> None:
    """Of a rotor that the model has, the inertia is not searched."""
    dictionary = Dictionary(Predictor(scenario, recording((0.0, 0.0))), [Backlash])
    points = dictionary.points(Backlash)
    assert points.shape[0] == 3
    assert points.shape[2] == 2
    known = dictionary.predictor.robot.rotor_inertia("rail")
    low, high = points[1, :, 0].min(), points[1, :, 0].max()
    assert known == ROTOR
    assert low < known < high < 4.0 * known


def test_a_joint_without_limits_may_go_round(scenario: Scenario) -> None:
    log = recording((0.0, 0.0), spin=15.0)
    assert np.abs(log["joint/position"][:, 1]).max() > 8.0 * np.pi
    check_sensors(Predictor(scenario, log).motion)
    channels = {
        name: np.rad2deg(log[name]) * [np.pi / 180.0, 1.0]
        for name in ("joint/position", "joint/velocity")
    }
    with pytest.raises(InputError, match="are these degrees"):
        check_sensors(Predictor(scenario, replace(log, channels=log.channels | channels)).motion)


def test_what_a_heavy_cart_lacks_may_be_its_mass_or_its_rotor(tmp_path: Path) -> None:
    """On a level rail both only have to be accelerated."""
    heavy, lacking, time = 300.0, 130.0, np.arange(0.0, 8.0, PERIOD)
    limb = '<mass value="{}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    (tmp_path / "cart.urdf").write_text(
        f"""<robot name="cart"><link name="stand"><inertial>{limb.format(1)}</inertial></link>
        <link name="cart"><inertial>{limb.format(heavy)}</inertial></link>
        <joint name="rail" type="prismatic"><parent link="stand"/><child link="cart"/>
        <axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="5000" velocity="30"/></joint>
        </robot>"""
    )
    description = tmp_path / "cart.yaml"
    description.write_text("base: stand\nurdf: cart.urdf\njoints: [rail]\nfixed_base: true\n")
    believed = Scenario(
        duration=8.0,
        robot=RobotConfig(str(description)),
        recording=RecordingConfig(rows="instantaneous", torque_noise={"all": 5.0}),
    )
    rates, sizes = np.array([2.7, 5.9, 11.3]), np.array([0.2, 0.05, 0.01])
    phase = rates * time[:, None]
    noise = 5.0 * np.random.default_rng(2).standard_normal(len(time))
    force = -(heavy + lacking) * (sizes * rates**2 * np.sin(phase)).sum(axis=1) + noise
    channels = {
        "joint/position": (sizes * np.sin(phase)).sum(axis=1, keepdims=True),
        "joint/velocity": (sizes * rates * np.cos(phase)).sum(axis=1, keepdims=True),
        "joint/torque_command": force[:, None],
    }
    log = Log({"time": time, **channels}, {"joints": ["rail"], "period": PERIOD, "sides": []})
    tried = [library()[name] for name in ("ReflectedInertia", "BodyMass")]
    (finding,) = diagnose(Predictor(believed, log), tried).chosen
    assert {finding.effect, *finding.confusable_with} == {"ReflectedInertia", "BodyMass"}
    (value,) = finding.parameters.values()
    assert value.value == pytest.approx(lacking, rel=0.01)
