"""Robots without legs: a crane of one prismatic and two revolute joints, by closed forms."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from fbse_drake import InputError, Log, Scenario, simulate
from fbse_drake.control.compensation import FeedforwardCompensation
from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.discrepancy.diagnosis.bandwidth import bandwidth
from fbse_drake.discrepancy.diagnosis.compare import compare
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import model_error, train_and_rest
from fbse_drake.discrepancy.exercises.strangers import UnevenFriction
from fbse_drake.discrepancy.residual.servo import with_command
from fbse_drake.effects.actuation import TorqueBias, TorqueDelay, TorqueGain, TorqueLag
from fbse_drake.effects.friction import CoulombFriction, CoulombViscousFriction, ViscousFriction
from fbse_drake.effects.sensor import EncoderOffset
from fbse_drake.estimators.fixed_friction import FixedFriction
from fbse_drake.report.sentences import diagnosis_outcome
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import IdentifyConfig, RecordingConfig, RobotConfig, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.walking.reference import JointSines, Recorded

TROLLEY, LOAD, LENGTH, G = 6.0, 2.0, 0.5, 9.81
# A trolley on a rail along x, a rope (a rod here) that swings about y, and a spoon below it that
# the description does not name. The shapes name meshes that are nowhere.
CRANE = f"""
<robot name="crane">
  <link name="rail"/>
  <link name="trolley">
    <inertial><mass value="{TROLLEY}"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/trolley.dae"/></geometry></visual>
  </link>
  <link name="rod">
    <inertial><origin xyz="0 0 {-LENGTH}"/><mass value="{LOAD}"/>
    <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="spoon">
    <inertial><origin xyz="0.1 0 0"/><mass value="1.0"/>
    <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="rail"/><child link="trolley"/><axis xyz="1 0 0"/>
    <limit lower="-9" upper="9" effort="3" velocity="9"/><dynamics damping="50"/>
  </joint>
  <joint name="swing" type="revolute">
    <parent link="trolley"/><child link="rod"/><axis xyz="0 1 0"/>
    <limit lower="-9" upper="9" effort="3" velocity="9"/>
  </joint>
  <joint name="spoon_hinge" type="revolute">
    <parent link="rod"/><child link="spoon"/><axis xyz="0 1 0"/>
    <limit lower="-9" upper="9" effort="3" velocity="9"/>
  </joint>
  <transmission name="slide_drive">
    <joint name="slide"/><actuator name="slide_motor"/>
    <type>transmission_interface/SimpleTransmission</type>
  </transmission>
</robot>
"""
DESCRIPTION = {
    "urdf": "crane.urdf",
    "base": "rail",
    "fixed_base": True,
    "joints": ["swing", "slide"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crane")
    (folder / "crane.urdf").write_text(CRANE)
    return folder


def described(folder: Path, **changes: object) -> str:
    """Path of the crane's description."""
    path = folder / f"crane{abs(hash(str(changes)))}.yaml"
    path.write_text(yaml.safe_dump(DESCRIPTION | changes))
    return str(path)


def crane(folder: Path, **effects: object) -> Scenario:
    return Scenario(
        duration=8.0,
        robot=RobotConfig(described(folder), effects=effects),
        reference=JointSines(
            amplitude={"swing": 0.6, "slide": 0.3},
            frequency={"swing": 0.7, "slide": 0.45},
            ramp=0.5,
        ),
        control=PositionLoopConfig(kp={"all": 4000.0}, kd={"all": 80.0}),
        sensors=SensorsConfig(encoders=EncoderConfig(velocity_noise=1e-4)),
    )


@pytest.fixture(scope="module")
def rubbing(folder: Path) -> tuple[Scenario, Log]:
    scenario = crane(
        folder, rail=CoulombFriction({"slide": 7.0}), bearing=ViscousFriction({"swing": 1.5})
    )
    return scenario, simulate(scenario).log


def test_the_residual_of_a_crane_is_what_its_equation_of_motion_says(
    folder: Path, rubbing: tuple[Scenario, Log]
):
    """q_swing, x: (m + M) x.. + m l (q.. cos q - q.^2 sin q) = F and m l^2 q.. + m l x.. cos q + m
    g l sin q = T, plus the spoon's."""
    log = rubbing[1]
    rigid = dataclasses.replace(
        rubbing[0], model=RobotConfig(described(folder, held={"spoon_hinge": np.pi / 2}))
    )
    blocks = Predictor(rigid, log).motion.steps
    q, (w, _), (q_dd, x_dd) = (
        blocks.joint_position[:, 0],
        blocks.joint_velocity.T,
        blocks.joint_acceleration.T,
    )
    # By a quarter turn about y the spoon's mass lies 0.1 m below the hinge, which is that of the
    # rod.
    moment = LOAD * LENGTH + 1.0 * 0.1
    inertia = LOAD * LENGTH**2 + 1.0 * 0.1**2
    # A rotation about +y takes what hangs down to -x.
    force = (TROLLEY + LOAD + 1.0) * x_dd - moment * (q_dd * np.cos(q) - w**2 * np.sin(q))
    torque = inertia * q_dd - moment * x_dd * np.cos(q) + moment * G * np.sin(q)
    expected = blocks.torque_command - np.stack([torque, force], axis=1)
    found = Predictor(rigid, log).motion.equation.residual(blocks)
    # Drake's g has more digits.
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_a_long_log_of_slow_motion_is_averaged_and_says_the_same(
    folder: Path, rubbing: tuple[Scenario, Log]
):
    scenario, log = rubbing
    bare = dataclasses.replace(scenario, model=RobotConfig(described(folder)))
    fine, coarse = (
        dataclasses.replace(bare, recording=RecordingConfig(block=block)) for block in (0.002, 0.01)
    )
    effects = [CoulombFriction, ViscousFriction]
    found = diagnose(Predictor(fine, log), effects)
    assert found.averaging.block == pytest.approx(0.004)
    assert found.averaging.block * found.averaging.bandwidth <= 0.5
    assert "averaged over 4 ms, not 2 ms" in found.averaging.text
    as_it_is = diagnose(Predictor(coarse, log), effects)
    assert as_it_is.averaging.text == ""
    for diagnosis in (found, as_it_is):
        named = {(f.effect, *f.targets): f.parameters for f in diagnosis.chosen}
        assert named.keys() == {("CoulombFriction", "slide"), ("ViscousFriction", "swing")}
        estimate = named["ViscousFriction", "swing"]["viscous"]
        assert estimate.interval[0] < 1.5 < estimate.interval[1]


def test_the_bandwidth_of_a_log_is_that_of_its_motion():
    rng, time = np.random.default_rng(0), np.arange(20_000) / 1000
    nothing = np.zeros((len(time), 0))
    motion = np.sin(2 * np.pi * 3.0 * time) + 0.1 * np.sin(2 * np.pi * 11.0 * time)
    signals = SimpleNamespace(
        joint_position=motion[:, None],
        joint_velocity=motion[:, None] + 1e-3 * rng.normal(size=(len(time), 1)),
        torque_command=0.1 * rng.normal(size=(len(time), 1)),
        **dict.fromkeys(("specific_force", "angular_velocity", "pad_force"), nothing),
    )
    signals.torque_command[:, 0] += 5.0 * np.sin(2 * np.pi * 3.0 * time)
    assert bandwidth(SimpleNamespace(signals=signals, period=1e-3)) == pytest.approx(11.0, abs=0.5)


def test_what_is_too_small_to_matter_is_said_to_be_so(folder: Path):
    """A bias that is eleven times as large as its uncertainty, and a third of a percent of the
    force."""
    biased = dataclasses.replace(crane(folder, bias=TorqueBias({"slide": 0.05})), duration=5.0)
    log = simulate(biased).log
    bare = dataclasses.replace(biased, model=RobotConfig(described(folder)))
    force = np.sqrt((log["joint/torque_command"][:, 1] ** 2).mean())
    for tolerance, matters in ((0.005, False), (0.001, True)):
        scenario = dataclasses.replace(bare, identify=IdentifyConfig(tolerance=tolerance))
        diagnosis = diagnose(Predictor(scenario, log), [TorqueBias, ViscousFriction])
        (finding,) = diagnosis.chosen if matters else diagnosis.too_small
        assert (finding.effect, finding.targets) == ("TorqueBias", ("slide",))
        assert finding.share == pytest.approx(0.05 / force, rel=0.3)
        assert diagnosis.verdict == ("effect_found" if matters else "nothing_missing")
        assert len(diagnosis.chosen) == matters
        said = "Nothing that matters is missing", "too small to matter: torque bias in slide"
        assert all((text in diagnosis_outcome(diagnosis)) is not matters for text in said)


@pytest.mark.parametrize("shortfall", [0.0, 0.1])
def test_noise_of_the_torque_is_no_lag(folder: Path, shortfall: float):
    """White noise is in the residual and in the columns of what depends on the torque alike: a lag
    would seem to take it off."""
    hidden = {"gain": TorqueGain({"swing": shortfall})} if shortfall else {}
    robot = dataclasses.replace(crane(folder, **hidden), duration=4.0)
    log = simulate(robot).log
    noise = np.random.default_rng(1).normal(size=log["joint/torque_command"].shape)
    channels = {"joint/torque_command": log["joint/torque_command"] + 2.0 * noise}
    scenario = dataclasses.replace(
        robot,
        model=RobotConfig(described(folder)),
        recording=RecordingConfig(torque_noise={"all": 2.0}),
    )
    effects = [TorqueLag, TorqueDelay, TorqueGain, TorqueBias]
    diagnosis = diagnose(
        Predictor(scenario, dataclasses.replace(log, channels=log.channels | channels)), effects
    )
    found = [(f.effect, *f.targets) for f in diagnosis.chosen]
    assert found == ([("TorqueGain", "swing")] if shortfall else [])
    assert diagnosis.verdict == ("effect_found" if shortfall else "nothing_missing")


def test_limits_and_damping_of_the_model_file_are_not_taken(
    folder: Path, rubbing: tuple[Scenario, Log]
):
    assert np.abs(rubbing[1]["joint/torque_command"]).max() > 4.0
    robot, _ = make_robot(described(folder))
    assert robot.torque_units == ["Nm", "N"]
    free = simulate(crane(folder)).log
    ideal = dataclasses.replace(crane(folder), sensors=SensorsConfig())
    truth = Log(
        {
            name: free[f"truth/{name}" if "position" in name or "velocity" in name else name]
            for name in free
            if name in ("time", "joint/position", "joint/velocity", "joint/torque_command")
        },
        free.meta,
    )
    assert np.abs(Predictor(ideal, truth).residual.value).max() < 1e-9


def test_hidden_friction_is_found_in_a_machine_without_legs(rubbing: tuple[Scenario, Log]):
    scenario, log = rubbing
    predictor = Predictor(scenario, log)
    failures = compare(predictor).failures
    assert {failure.row.name for failure in failures} == {"swing", "slide"}
    texts = [failure.text for failure in failures]
    assert any(text.startswith("slide: model force") for text in texts)
    assert any("model torque" in text and "rad/s" in text for text in texts)
    diagnosis = diagnose(predictor)
    found = {finding.effect: finding for finding in diagnosis.chosen}
    assert diagnosis.verdict == "effect_found"
    assert {effect: finding.targets for effect, finding in found.items()} == {
        "CoulombFriction": ("slide",),
        "ViscousFriction": ("swing",),
    }
    assert found["CoulombFriction"].parameters["coulomb"].value == pytest.approx(7.0, rel=0.02)
    assert found["ViscousFriction"].parameters["viscous"].value == pytest.approx(1.5, rel=0.02)


def test_a_crooked_sensor_of_a_machine_without_feet_is_simulated(folder: Path):
    scenario = dataclasses.replace(
        crane(folder, crooked=EncoderOffset({"swing": 0.05})), duration=0.5
    )
    log = simulate(scenario).log
    np.testing.assert_allclose(
        log["joint/position"][:, 0] - log["truth/joint/position"][:, 0], 0.05, atol=1e-9
    )


def test_friction_that_is_known_is_fed_forward_in_a_machine_without_feet(folder: Path):
    law = CoulombViscousFriction(
        coulomb={"slide": 7.0, "swing": 0.0},
        viscous={"slide": 5.0, "swing": 1.5},
        transition={"all": 0.01},
    )
    scenario = dataclasses.replace(
        crane(folder, friction=law), duration=3.0, estimator=FixedFriction(law)
    )
    fed = dataclasses.replace(scenario, compensation=FeedforwardCompensation())
    alone, compensated = (simulate(one).log for one in (scenario, fed))
    moving = np.abs(alone["joint/velocity"][:-1]).min(axis=1) > 0.05
    np.testing.assert_allclose(
        alone["estimate/joint/friction_torque"][1:][moving],
        alone["truth/joint/friction_torque"][:-1][moving],
        rtol=0.05,
    )
    left = [
        np.sqrt(np.mean((log["reference/joint/position"] - log["truth/joint/position"]) ** 2))
        for log in (alone, compensated)
    ]
    assert left[1] < 0.3 * left[0]


def test_nothing_is_found_where_nothing_is_hidden(folder: Path):
    scenario = crane(folder)
    assert diagnose(Predictor(scenario, simulate(scenario).log)).verdict == "nothing_missing"


def test_the_relative_error_is_that_of_norms_and_the_rest_of_a_log_is_its_end(
    rubbing: tuple[Scenario, Log],
):
    scenario, log = rubbing
    scenario = dataclasses.replace(scenario, recording=RecordingConfig(train_share=0.75))
    train, rest = train_and_rest(scenario, log)
    assert train.time[-1] == pytest.approx(6.0)
    np.testing.assert_array_equal(np.concatenate([train.time, rest.time]), log.time)
    predictor = Predictor(scenario, rest)
    error, residual = model_error(predictor), predictor.residual
    torque = residual.signals.torque_command
    assert error.relative == pytest.approx(np.linalg.norm(residual.value) / np.linalg.norm(torque))
    assert error.relative_by_joint["slide"] == pytest.approx(
        np.linalg.norm(residual.value[:, 1]) / np.linalg.norm(torque[:, 1])
    )
    whole = dataclasses.replace(scenario, recording=RecordingConfig(train_share=1.0))
    assert train_and_rest(whole, log)[1] is None


def test_a_recording_without_velocities_and_with_samples_at_one_instant(folder: Path):
    """A recorder that samples torque and angles at once, every 8 ms, without velocities: exact
    motions give no residual."""
    scenario = dataclasses.replace(
        crane(folder),
        recording=RecordingConfig(
            block=0.04, rows="instantaneous", velocity="differenced", cutoff=25.0
        ),
    )
    robot, _ = make_robot(described(folder))
    period, a, f = 0.008, np.array([0.6, 0.3]), 2 * np.pi * np.array([0.7, 0.45])
    t = np.arange(1000)[:, None] * period
    q, v, dv = a * np.sin(f * t), a * f * np.cos(f * t), -a * f**2 * np.sin(f * t)
    plant, context = robot.plant, robot.plant.CreateDefaultContext()
    torque = np.empty_like(q)
    for k in range(len(t)):
        robot.set_state(context, q[k], v[k])
        full = np.zeros(2)
        full[robot.velocity_index] = dv[k]
        bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        torque[k] = (plant.CalcMassMatrix(context) @ full + bias)[robot.velocity_index]
    log = Log(
        {"time": t[:, 0], "joint/position": q, "joint/torque_command": torque},
        {"joints": robot.joint_names, "period": period},
    )
    wrong = dataclasses.replace(
        scenario, recording=dataclasses.replace(scenario.recording, rows="per_step")
    )
    middle = slice(20, -20)
    error = Predictor(scenario, log).motion.residual.value[middle]
    late = Predictor(wrong, log).motion.residual.value[middle]
    assert np.abs(error).max() < 2e-3 * np.abs(torque).max()
    assert np.abs(late).max() > 5 * np.abs(error).max()


def test_a_position_servo_tells_its_torque_by_its_gains(rubbing: tuple[Scenario, Log]):
    """A recording of positions alone: the torque follows from what was asked for and the known
    gains of the loop."""
    scenario, log = rubbing
    asked = dataclasses.replace(scenario, reference=Recorded())
    without = Log(
        {name: values for name, values in log.items() if name != "joint/torque_command"}, log.meta
    )
    names = make_robot(scenario.robot.description)[0].description
    torque = with_command(asked, without, names)["joint/torque_command"]
    np.testing.assert_allclose(torque, log["joint/torque_command"], atol=1e-9)
    assert with_command(asked, log, names) is log
    limited = dataclasses.replace(
        asked, control=dataclasses.replace(asked.control, torque_limit={"all": 5.0})
    )
    assert np.abs(with_command(limited, without, names)["joint/torque_command"]).max() == 5.0
    off = Log({**without.channels, "joint/enabled": np.zeros_like(torque)}, log.meta)
    assert not with_command(asked, off, names)["joint/torque_command"].any()
    blind = Log(
        {name: values for name, values in without.items() if name != "joint/velocity"}, log.meta
    )
    with pytest.raises(InputError, match="control: kd: the log has no channel joint/velocity"):
        with_command(asked, blind, names)
    with pytest.raises(
        InputError, match="gain kp: expected a number that is kept with the log's stretches"
    ):
        with_command(dataclasses.replace(asked, reference=Recorded(gain="kp")), without, names)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"joints": ["swing", "lift"]},
            "joints: the model has no revolute or prismatic joint called lift",
        ),
        ({"joints": ["swing", "swing"]}, "joints: swing is named twice"),
        ({"joints": []}, "expected legs, joints or both, found neither"),
        (
            {"held": {"slide": 0.1}},
            (
                r"held.slide: expected a joint of the model that is not named elsewhere \(there "
                r"are: spoon_hinge\)"
            ),
        ),
        ({"urdf": "other.urdf"}, "other.urdf: no such file"),
        ({"urdf": "${NOT_SET_ANYWHERE}/crane.urdf"}, "this environment variable is not set"),
        ({"directives": "crane.dmd.yaml"}, "expected either directives or urdf"),
        ({"base": "hook"}, "base: the model has no body called hook"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(folder: Path, changes: dict, message: str):
    with pytest.raises(InputError, match=message):
        make_robot(described(folder, **changes))


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_where_friction_takes_all_that_a_joint_is_given_no_gain_is_named(
    tmp_path: Path, offset: float
):
    """A wheel that turns in balance needs next to no torque: friction of any kind is as good as a
    motor of which nothing arrives. Out of balance it needs some, and the gain is named."""
    (tmp_path / "wheel.urdf").write_text(
        f"""<robot name="wheel"><link name="stand"/><link name="wheel"><inertial>
        <origin xyz="{offset} 0 0"/><mass value="2"/>
        <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="axle" type="continuous"><parent link="stand"/><child link="wheel"/>
        <axis xyz="0 1 0"/></joint></robot>"""
    )
    text = {"urdf": "wheel.urdf", "base": "stand", "fixed_base": True, "joints": ["axle"]}
    (tmp_path / "wheel.yaml").write_text(yaml.safe_dump(text))
    motion = JointSines(amplitude={"axle": 0.1}, frequency={"axle": 0.5}, ramp=2.0)
    hidden = (
        UnevenFriction(coulomb={"axle": 4.4}, unevenness={"axle": 0.97})
        if offset == 0.0
        else TorqueGain({"axle": 0.3})
    )
    scenario = Scenario(
        duration=6.0,
        robot=RobotConfig(str(tmp_path / "wheel.yaml"), effects={"hidden": hidden}),
        reference=motion,
        control=PositionLoopConfig(kp={"all": 400.0}, kd={"all": 8.0}),
        sensors=SensorsConfig(encoders=EncoderConfig(velocity_noise=1e-4)),
    )
    believed = dataclasses.replace(scenario, model=RobotConfig(str(tmp_path / "wheel.yaml")))
    found = diagnose(Predictor(believed, simulate(scenario).log))
    named = {finding.effect for finding in found.chosen}
    assert ("TorqueGain" in named) == isinstance(hidden, TorqueGain)
