"""Estimators and compensations of a user's own, and single stages in a user's own diagram."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import scenario
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem, System
from pydrake.systems.primitives import MatrixGain
from rig import CLOCK, TICK, estimated, inputs_of

from fbse_drake import InputError, Log, estimate, load_scenario, signals, simulate
from fbse_drake.control import compensation
from fbse_drake.estimators import estimator
from fbse_drake.estimators.base_filter import InvariantBaseFilter, InvariantFilter
from fbse_drake.estimators.beliefs import USUAL_SENSORS
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver, MomentumObserver
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.floating_base import FloatingBaseModel
from fbse_drake.estimators.joint_acceleration import (
    JointAccelerationConfig,
    JointAccelerationEstimator,
)
from fbse_drake.estimators.link_torque import LinkTorqueEstimator
from fbse_drake.estimators.model_aided import ModelAided, ModelAidedEstimator
from fbse_drake.estimators.recursive_least_squares import (
    RecursiveLeastSquares,
    RecursiveLeastSquaresEstimator,
)
from fbse_drake.estimators.sensor_monitor import SensorMonitor, SensorMonitorConfig
from fbse_drake.estimators.support import MeasuredSupport
from fbse_drake.estimators.true_friction import TrueFrictionSource
from fbse_drake.estimators.whole_body import WholeBody, WholeBodyFilter
from fbse_drake.robot.plant import make_robot
from fbse_drake.sensors.errors import held_signal

Run = Callable[..., Log]

MINE = '''
"""Friction as what a gear loses, and its compensation where it is worth it."""
from dataclasses import dataclass
from functools import partial

import numpy as np
from pydrake.systems.framework import LeafSystem

from fbse_drake.control import compensation
from fbse_drake.estimators import estimator
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import RecursiveEstimator
from fbse_drake.signals import estimated


@estimator.in_library
@dataclass(frozen=True)
class GearLoss(estimator.Estimator):
    efficiency: float = 0.9

    signals = (estimated("joint/lost_power", "friction", "power", "W", ("n",)),)

    def add(self, chain):
        chain.add("friction", partial(GearLossEstimator, self, len(chain.robot.joint_names)))


class GearLossEstimator(RecursiveEstimator):
    def __init__(self, config, joints, clock):
        n = (joints,)
        super().__init__(record_type(time=(), status=(), friction=n, power=n), clock)
        self._share = 1 - config.efficiency
        self._joint_state = self.DeclareVectorInputPort("measured_joint_state", 2 * joints)
        self._torque_command = self._declare_remembered_input("torque_command", joints)
        self._declare_posterior()

    def _tick(self, context, last, elapsed, posterior):
        _, velocity = np.split(self._joint_state.Eval(context), 2)
        load = np.abs(self._torque_command.Eval(context))
        posterior["status"] = 0
        posterior["friction"] = self._share * load * np.sign(velocity)
        posterior["power"] = posterior["friction"] * velocity


@compensation.in_library
@dataclass(frozen=True)
class DeadZone(compensation.Compensation):
    threshold: float = 0.1

    def system(self, names, clock):
        return DeadZoneSystem(self, len(names.joint_names))


class DeadZoneSystem(LeafSystem):
    def __init__(self, config, joints):
        super().__init__()
        self._estimate = self.DeclareVectorInputPort("friction_estimate", joints)
        self._threshold = config.threshold
        self.DeclareVectorOutputPort("torque", joints, self._calc)

    def _calc(self, context, output):
        torque = self._estimate.Eval(context)
        output.SetFromVector(torque * (np.abs(torque) > self._threshold))
'''
SCENARIO = """
mine:
  duration: 0.5
  effect_modules: [gear.py]
  robot: {description: pendulum}
  reference: !JointSines {amplitude: {all: 0.5}, frequency: {all: 1.0}}
  estimator: !GearLoss {efficiency: 0.8}
  compensation: !DeadZone {threshold: 5.0e-6}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a user's files are; what they put into libraries and table is taken out again."""
    monkeypatch.setattr(estimator, "_LIBRARY", estimator.library())
    monkeypatch.setattr(compensation, "_LIBRARY", compensation.library())
    monkeypatch.setattr(signals, "_TABLE", list(signals._TABLE))
    (tmp_path / "mine.yaml").write_text(SCENARIO)
    return tmp_path


def test_estimator_and_compensation_of_a_user_s_own(folder: Path):
    (folder / "gear.py").write_text(MINE)
    mine = load_scenario(folder / "mine.yaml")
    log = simulate(mine).log
    command, velocity = log["joint/torque_command"], log["joint/velocity"]
    friction = log["estimate/joint/friction_torque"]
    np.testing.assert_allclose(
        friction[1:], 0.2 * np.abs(command[:-1]) * np.sign(velocity[1:]), rtol=1e-12
    )
    np.testing.assert_array_equal(log["estimate/joint/lost_power"], friction * velocity)
    kp, kd = mine.control.kp["all"], mine.control.kd["all"]
    loop = kp * (log["reference/joint/position"] - log["joint/position"])
    loop += kd * (log["reference/joint/velocity"] - velocity)
    added = command - loop - log["reference/joint/feedforward_torque"]
    # The pendulum is small: it takes some 60 uNm.
    counts = np.abs(friction) > 5e-6
    np.testing.assert_allclose(added, friction * counts, rtol=0, atol=1e-15)
    assert 0.2 < counts.mean() < 0.8
    # The log knows its channel's unit, its scenario can be read, its estimates can be repeated.
    log.save(folder / "log.npz")
    assert Log.load(folder / "log.npz").unit("estimate/joint/lost_power") == "W"
    (folder / "again.yaml").write_text(log.meta["scenario"])
    again = load_scenario(folder / "again.yaml")
    assert (again.estimator, again.compensation) == (mine.estimator, mine.compensation)
    repeated = estimate(again, log).log
    np.testing.assert_allclose(repeated["estimate/joint/lost_power"][1:], (friction * velocity)[1:])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "!GearLoss",
            "!GearLosses",
            r"estimator: expected one of !NoEst.*!Fbse.*!GearLoss, found the tag !GearLosses",
        ),
        (
            "!DeadZone",
            "!DeadZones",
            r"compensation: expected one of !NoCompensation.*!DeadZone, found the tag !DeadZones",
        ),
        ("efficiency: 0.8", "efficency: 0.8", r"did you mean efficiency\?"),
        ("GearLoss", "Fbse", r"estimator Fbse: the library has another estimator of this name, in"),
        ("DeadZone", "NoCompensation", r"the library has another compensation of this name, in"),
        ("def add", "def adds", r"estimator GearLoss: the method add is missing"),
        ("def system", "def systems", r"compensation DeadZone: the method system is missing"),
        ("joint/lost_power", "zmp", r"estimator GearLoss: channel estimate/zmp: there is one"),
        ("joint/lost_power", "joint/lost_torque", r"channel estimate/joint/lost_torque: there is"),
        (
            '("friction", p',
            '("friction", model="model", make=p',
            r"no system model \(there are: none",
        ),
        ("friction=n, ", "", r"estimator: friction: expected a posterior with a field friction"),
        ('"torque_command"', '"voltage"', r"estimator: input voltage: there is no port of this"),
        ('"friction_estimate"', '"estimate"', r"compensation: input estimate: there is no port"),
        ('Port("torque"', 'Port("moment"', r"compensation: .* output port torque, found moment"),
        (
            "    efficiency: float = 0.9\n",
            "    efficiency: float = 0.9\n    gives_friction = False\n",
            r"compensation: needs an estimator",
        ),
    ],
)
def test_what_does_not_fit_gets_one_line(folder: Path, old: str, new: str, message: str):
    in_module = old in MINE
    (folder / "gear.py").write_text(MINE.replace(old, new) if in_module else MINE)
    if not in_module:
        (folder / "mine.yaml").write_text(SCENARIO.replace(old, new))
    with pytest.raises(InputError, match=message) as error:
        simulate(load_scenario(folder / "mine.yaml"))
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("folder")
def test_a_kind_of_channel_that_nobody_estimates_yet_is_free():
    row = signals.estimated("joint/lost_torque", "friction", "lost", "Nm", ("n",))
    signals.register(row)
    assert signals.estimates()[-1] == row
    with pytest.raises(InputError, match="there is one of this name"):
        signals.register(signals.estimated("joint/lost_torque", "gear", "lost", "Nm", ("n",)))


def test_systems_of_a_chain_share_what_feeds_them():
    robot, _ = make_robot("pendulum")
    chain = Chain(robot, CLOCK, USUAL_SENSORS, None, knows_torque=True)
    for name in ("first", "friction"):
        chain.add(name, partial(TrueFrictionSource, 1))
    assert chain.finish().keys() == {"estimate/friction/status", "estimate/joint/friction_torque"}
    diagram = chain.builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.get_input_port().FixValue(context, [0.25])
    for name in ("first", "friction"):
        system = diagram.GetSubsystemByName(name)
        port = system.GetOutputPort("friction")
        assert port.Eval(system.GetMyContextFromRoot(context)) == 0.25


class LinkTorque(LeafSystem):
    """A sine's torque on a joint, and what a sensor behind the gear measures less of it."""

    def __init__(self, inertia: float):
        super().__init__()
        self._inertia = inertia
        self._acceleration = self.DeclareVectorInputPort("acceleration", 1)
        self.DeclareVectorOutputPort("torque", 1, self._calc_torque, {self.time_ticket()})
        self.DeclareVectorOutputPort("residual", 1, self._calc_residual)

    def _torque(self, time: float) -> np.ndarray:
        return np.array([3.0 * np.sin(5.0 * time)])

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._torque(context.get_time()))

    def _calc_residual(self, context: Context, output: BasicVector) -> None:
        # Of the step that ended.
        link_torque = self._inertia * self._acceleration.Eval(context)
        output.SetFromVector(self._torque(context.get_time() - TICK) - link_torque)


@pytest.mark.parametrize("damping", [0.1, 0.4])
def test_friction_from_a_measured_link_torque(damping: float):
    """A plant of Drake's alone, whose joint has viscous friction, which is found."""
    builder, inertia = DiagramBuilder(), 0.5
    plant = builder.AddSystem(MultibodyPlant(TICK))
    body = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(2.5 * inertia, 1.0))
    joint = RevoluteJoint("axis", plant.world_frame(), body.body_frame(), [0, 0, 1], damping)
    plant.AddJointActuator("motor", plant.AddJoint(joint))
    plant.Finalize()
    sensor = builder.AddSystem(LinkTorque(inertia))
    acceleration = plant.get_generalized_acceleration_output_port()
    builder.Connect(acceleration, sensor.get_input_port())
    builder.Connect(sensor.GetOutputPort("torque"), plant.get_actuation_input_port())
    velocity = builder.AddSystem(MatrixGain(np.array([[0.0, 1.0]])))
    builder.Connect(plant.get_state_output_port(), velocity.get_input_port())
    robot, _ = make_robot("pendulum")
    friction = RecursiveLeastSquaresEstimator.AddToBuilder(
        builder,
        {
            "measurements": {"joint_velocity": velocity.get_output_port()},
            "link_torque": {"residual": sensor.GetOutputPort("residual"), "valid": 1.0},
        },
        period=TICK,
        config=RecursiveLeastSquares(swing="measurement"),
        robot=robot,
    )
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.8)
    context = simulator.get_context()
    found = {
        name: friction.GetOutputPort(name).Eval(friction.GetMyContextFromRoot(context))
        for name in ("friction", "parameters")
    }
    v = velocity.get_output_port().Eval(velocity.GetMyContextFromRoot(context))
    assert abs(v) > 0.1
    np.testing.assert_allclose(found["friction"], damping * v, rtol=1e-6)
    # Coulomb and viscous; the prior counts as little as the first ticks do.
    np.testing.assert_allclose(found["parameters"], [0.0, damping], atol=2e-3)


def test_stages_in_a_diagram_of_ones_own(run: Run):
    """From the sensors of a log to base and friction, stage by stage.

    They do what the whole estimator does; only that nobody tells monitor and model of biases.
    """
    walk, builder = scenario("paper_walk_fbse", "duration=0.6"), DiagramBuilder()
    log, beliefs = run("paper_walk_fbse", "duration=0.6"), walk.believed_sensors
    robot, _ = make_robot("biped")
    channels = {
        "joint_position": "joint/position",
        "joint_velocity": "joint/velocity",
        "specific_force": "imu/linear_acceleration",
        "angular_velocity": "imu/angular_velocity",
    }
    samples = {name: log[channel] for name, channel in channels.items()}
    samples["pad_force"] = inputs_of(log)["measured_pad_force"]
    samples["torque_command"] = log["joint/torque_command"]
    ports = {
        name: builder.AddSystem(held_signal(values, TICK)).get_output_port()
        for name, values in samples.items()
    }
    command = ports.pop("torque_command")
    shared = {"period": TICK, "robot": robot}
    monitor = SensorMonitor.AddToBuilder(
        builder,
        {"sensors": ports},
        config=SensorMonitorConfig(),
        support=MeasuredSupport(),
        beliefs=beliefs,
        **shared,
    )
    measurements = {"measurements": monitor.GetOutputPort("posterior")}
    model = FloatingBaseModel.AddToBuilder(builder, measurements, **shared)
    base = InvariantBaseFilter.AddToBuilder(
        builder,
        measurements | {"model": model.GetOutputPort("posterior")},
        config=InvariantFilter(),
        sensors=beliefs,
        origin=(0.0, 0.0),
        **shared,
    )
    over_step = {"model_over_step": model.GetOutputPort("over_step")}
    acceleration = JointAccelerationEstimator.AddToBuilder(
        builder,
        measurements | over_step | {"attitude": base.GetOutputPort("posterior")},
        config=JointAccelerationConfig(),
        sensors=beliefs,
        **shared,
    )
    link_torque = LinkTorqueEstimator.AddToBuilder(
        builder,
        measurements
        | over_step
        | {
            "joint_acceleration": acceleration.GetOutputPort("posterior"),
            "torque_command": command,
        },
        sensors=beliefs,
        **shared,
    )
    friction = ModelAidedEstimator.AddToBuilder(
        builder,
        measurements | {"link_torque": link_torque.GetOutputPort("posterior")},
        config=ModelAided(),
        sensors=beliefs,
        **shared,
    )
    whole_body = WholeBodyFilter.AddToBuilder(
        builder,
        measurements
        | over_step
        | {"attitude": base.GetOutputPort("posterior"), "torque_command": command},
        config=WholeBody(),
        sensors=beliefs,
        **shared,
    )
    observer = MomentumObserver.AddToBuilder(
        builder,
        measurements
        | {
            "attitude": {"rotation": base.GetOutputPort("rotation")},
            "base_state": {"base_velocity": base.GetOutputPort("base_velocity")},
            "model": model.GetOutputPort("posterior"),
            "model_at_step_start": model.GetOutputPort("at_step_start"),
            "torque_command": command,
        },
        config=DisturbanceObserver(),
        **shared,
    )
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(log.time[-1])

    def value(system: System, field: str) -> np.ndarray:
        context = system.GetMyContextFromRoot(simulator.get_context())
        return system.GetOutputPort(field).Eval(context)

    frictions = {
        system: estimated(log, walk, config)["estimate/joint/friction_torque"][-1]
        for system, config in (
            (whole_body, Fbse()),
            (friction, Fbse(friction=ModelAided())),
            (observer, DisturbanceObserver()),
        )
    }
    told = {"orientation": "base/orientation", "base_velocity": "base/velocity"}
    for field, channel in told.items():
        found = value(base, field)
        np.testing.assert_allclose(found, log[f"estimate/{channel}"][-1], rtol=0, atol=1e-5)
    for system, tolerance in ((whole_body, 5e-3), (friction, 5e-3), (observer, 5e-2)):
        expected = frictions[system]
        assert np.abs(expected).max() > 0.5
        np.testing.assert_allclose(value(system, "friction"), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (
            {"measurements": {}},
            r"expected the inputs measurements, link_torque, found measurements",
        ),
        ({"measurements": {}, "link_torque": {"torque": 0.0}}, r"there is no field torque \(there"),
        (
            {"measurements": {}, "link_torque": {"residual": [0.0, 0.0]}},
            r"Estimator: input link_torque: field residual: expected 1 numbers",
        ),
    ],
)
def test_a_stage_that_is_wired_wrongly_gets_one_line(inputs: dict, message: str):
    robot, _ = make_robot("pendulum")
    with pytest.raises(InputError, match=message):
        RecursiveLeastSquaresEstimator.AddToBuilder(
            DiagramBuilder(), inputs, period=TICK, config=RecursiveLeastSquares(), robot=robot
        )
