"""Effects on inertia, in sensors and in contact: what they do to plants, readings and standing
soles."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from conftest import scenario
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from fbse_drake import InputError, Log, Scenario, build_station, simulate
from fbse_drake.effects.contact import ContactEffect, FootCreep, GroundCompliance, GroundSlope
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.inertia import BodyCentreOfMass, BodyMass, ReflectedInertia
from fbse_drake.effects.sensor import (
    AccelerometerBias,
    AccelerometerGain,
    EncoderOffset,
    FootForceBias,
    FootForceGain,
    FootForceLag,
    FootForceMisalignment,
    FootMomentBias,
    GyroscopeBias,
    ImuMisalignment,
    SensorEffect,
    SensorSignals,
    TransmissionElasticity,
)
from fbse_drake.estimation import estimate
from fbse_drake.robot.plant import Ground, PointMass, Robot, make_robot
from fbse_drake.scenario import RobotConfig, build_robot, planned_reference
from fbse_drake.wiring import release

WEIGHT = 87.0 * 9.81
TICK = 1e-3
POSTURE = np.tile([0.1, 0.05, -0.4, 0.8, -0.3, -0.05], 2)
POSE = RigidTransform(
    Quaternion(Rotation.from_rotvec([0.2, -0.3, 0.5]).as_quat(scalar_first=True)), [1.0, 2.0, 0.7]
)
# More than one of each kind, where a kind has more than one value.
SENSOR_EFFECTS = [
    FootForceGain(gain={"left": 0.1, "right": -0.05}),
    FootForceBias(x={"left": 3.0}, z={"right": -4.0}),
    FootMomentBias(y={"left": 1.0, "right": -0.5}),
    FootForceMisalignment(x={"left": 0.05}, y={"all": 0.1}),
    FootForceLag({"left": 0.004, "right": 0.02}),
    AccelerometerGain(0.02),
    ImuMisalignment(0.02, -0.03, 0.1),
    AccelerometerBias(0.1, 0.2, -0.3),
    GyroscopeBias(0.01, -0.02, 0.03),
    EncoderOffset({"left_knee_pitch": 0.003}),
    TransmissionElasticity(
        {"all": 2e-5, "right_hip_roll": 5e-5}, {"all": 0.005, "right_hip_roll": 0.008}
    ),
]


def with_effects(base: Scenario, *effects: Effect) -> Scenario:
    """The scenario with a robot that has these effects besides its own."""
    added = base.robot.effects | {f"added_{k}": effect for k, effect in enumerate(effects)}
    return dataclasses.replace(base, robot=dataclasses.replace(base.robot, effects=added))


def simulated(name: str, *overrides: str, effects: Sequence[Effect] = ()) -> Log:
    return simulate(with_effects(scenario(name, *overrides, noise=False), *effects)).log


def robot_with(*effects: Effect) -> Robot:
    return build_robot(
        RobotConfig(effects={f"added_{k}": effect for k, effect in enumerate(effects)})
    )


@pytest.fixture(scope="module")
def plain() -> Robot:
    return robot_with()


def mass_matrix(robot: Robot) -> np.ndarray:
    context = robot.plant.CreateDefaultContext()
    robot.set_state(context, POSTURE, np.zeros(12), POSE)
    return robot.plant.CalcMassMatrix(context)


@pytest.mark.parametrize(
    ("body", "mass"), [("trunk", 10.0), ("trunk", -8.0), ("left_foot", 1.5), ("right_shank", -0.2)]
)
def test_mass_on_a_body_moves_with_its_centre_of_mass(plain: Robot, body: str, mass: float):
    changed = robot_with(BodyMass({body: mass}))
    plant, context = plain.plant, plain.plant.CreateDefaultContext()
    plain.set_state(context, POSTURE, np.zeros(12), POSE)
    frame, com = plain.body(body).body_frame(), plain.body(body).default_com()
    world = plant.world_frame()
    J = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, frame, com, world, world
    )
    np.testing.assert_allclose(
        mass_matrix(changed) - mass_matrix(plain), mass * J.T @ J, atol=1e-10
    )
    assert changed.plant.CalcTotalMass(changed.plant.CreateDefaultContext()) == pytest.approx(
        87.0 + mass
    )


def test_reflected_inertia_adds_to_what_is_configured():
    effect = ReflectedInertia({"all": 0.1, "left_hip_yaw": 0.4})
    changed = build_robot(
        RobotConfig(
            rotor_inertia={"knee_pitch": 0.3},
            effects={"rotors": effect, "more": ReflectedInertia({"knee_pitch": 1.0})},
        )
    )
    diagonal = np.zeros(18)
    diagonal[changed.velocity_index] = [0.4, 0.1, 0.1, 1.4, 0.1, 0.1, 0.1, 0.1, 0.1, 1.4, 0.1, 0.1]
    np.testing.assert_allclose(
        mass_matrix(changed) - mass_matrix(robot_with()), np.diag(diagonal), atol=1e-12
    )


def central_inertia(robot: Robot, body: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass of a body with its point masses, centre of mass, and rotational inertia about it."""
    plant, frame = robot.plant, robot.body(body).body_frame()
    bodies = [
        index
        for index in plant.GetBodyIndices(robot.base.model_instance())
        if plant.get_body(index).name().startswith(body)
    ]
    inertia = plant.CalcSpatialInertia(plant.CreateDefaultContext(), frame, bodies)
    return (
        inertia.get_mass(),
        inertia.get_com(),
        inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3(),
    )


def test_moved_centre_of_mass_leaves_mass_and_central_inertia(plain: Robot):
    moved = np.array([0.03, -0.01, 0.02])
    changed = robot_with(BodyCentreOfMass(*({"trunk": value} for value in moved)))
    (mass, com, inertia), (old_mass, old_com, old_inertia) = (
        central_inertia(changed, "trunk"),
        central_inertia(plain, "trunk"),
    )
    assert mass == pytest.approx(old_mass)
    np.testing.assert_allclose(com, old_com + moved, atol=1e-12)
    np.testing.assert_allclose(inertia, old_inertia, atol=1e-12)
    whole = [
        robot.plant.CalcCenterOfMassPositionInWorld(robot.plant.CreateDefaultContext())
        for robot in (plain, changed)
    ]
    np.testing.assert_allclose(whole[1] - whole[0], 50 / 87 * moved, atol=1e-12)


def test_payload_is_a_mass_and_a_moved_centre_of_mass(plain: Robot):
    """To first order in the payload."""
    place, mass = np.array([0.1, 0.05, 0.3]), 1e-3
    payload, _ = make_robot("biped", point_masses=[PointMass("trunk", mass, place)])
    shift = mass / 50.0 * (place - plain.body("trunk").default_com())
    both = robot_with(
        BodyMass({"trunk": mass}), BodyCentreOfMass(*({"trunk": value} for value in shift))
    )
    (_, com, _), (_, payload_com, _) = (
        central_inertia(both, "trunk"),
        central_inertia(payload, "trunk"),
    )
    np.testing.assert_allclose(com, payload_com, atol=1e-9)
    assert np.abs(payload_com - central_inertia(plain, "trunk")[1]).max() > 1e-6


def test_point_masses_are_no_bodies_of_their_own(plain: Robot):
    assert (
        robot_with(BodyMass({"trunk": 1.0}), BodyCentreOfMass(x={"left_foot": 0.01})).body_names
        == plain.body_names
    )
    assert "left_thigh" in plain.body_names
    assert "imu" not in plain.body_names


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (
            BodyMass({"torso": 1.0}),
            (
                r"effects\.added_0: torso: the model has no body of this name with a mass "
                r"\(there are: trunk, left_hip"
            ),
        ),
        (BodyMass({"trunk": -50.0}), r"trunk: expected a mass > 0, found 0 kg"),
        (ReflectedInertia({"elbow": 1.0}), r"effects\.added_0\.inertia\.elbow: unknown joint"),
        (
            ReflectedInertia({"all": -1.0}),
            r"the rotor inertia of left_hip_yaw, with what effects add, is -1 kg m\^2 "
            r"\(allowed: >= 0\)",
        ),
    ],
)
def test_impossible_inertia_is_refused(effect: Effect, message: str):
    with pytest.raises(InputError, match=message):
        robot_with(effect)


def test_inertia_that_no_body_has_is_refused():
    with pytest.raises(
        InputError,
        match="trunk: expected the inertia of a body, found one that no distribution of mass has",
    ):
        make_robot("biped", point_masses=[PointMass("trunk", -10.0, np.array([1.0, 0.0, 0.0]))])


def lift(robot: Robot, body: str, q: np.ndarray) -> np.ndarray:
    """How fast the centre of mass of a body rises per rate of each joint, with the base level and
    at rest, (n,) [m]."""
    plant, context = robot.plant, robot.plant.CreateDefaultContext()
    robot.set_state(context, q, np.zeros(12), RigidTransform())
    frame, com, world = (
        robot.body(body).body_frame(),
        robot.body(body).default_com(),
        plant.world_frame(),
    )
    J = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, frame, com, world, world
    )
    return J[2, robot.velocity_index]


def test_feedforward_of_a_model_bears_its_masses(plain: Robot):
    base = scenario("leg_swing_gantry", "duration=0.1", noise=False)
    loaded = dataclasses.replace(
        base, model=dataclasses.replace(base.robot, effects={"mass": BodyMass({"left_shank": 0.4})})
    )
    first, second = (planned_reference(each, build_robot(each.believed)) for each in (base, loaded))
    # At rest: the torque that holds the weight of the mass.
    weight = 0.4 * 9.81 * lift(plain, "left_shank", first.joint_position[0])
    np.testing.assert_allclose(
        second.feedforward_torque[0] - first.feedforward_torque[0], weight, atol=1e-9
    )
    assert np.abs(weight).max() > 0.1


def test_estimators_of_a_model_bear_its_masses(plain: Robot):
    base = scenario("paper_walk_fbse", "duration=0.1", noise=False)
    loaded = dataclasses.replace(
        base, model=dataclasses.replace(base.robot, effects={"mass": BodyMass({"left_thigh": 2.0})})
    )
    log = simulate(loaded).log
    in_station, replayed, unloaded = (
        each["estimate/joint/link_torque"]
        for each in (log, estimate(loaded, log).log, estimate(base, log).log)
    )
    np.testing.assert_allclose(replayed, in_station, atol=1e-9)
    weight = 2.0 * 9.81 * lift(plain, "left_thigh", log["truth/joint/position"][-1])
    np.testing.assert_allclose((in_station - unloaded)[-1], weight, atol=0.1)
    assert np.abs(weight).max() > 1.0


def test_simulated_robot_has_its_extra_mass():
    log = simulated(
        "squat",
        "duration=0.3",
        "reference.amplitude=0",
        effects=[BodyMass({"trunk": 8.7}), BodyCentreOfMass(x={"trunk": 0.02})],
    )
    force = sum(log[f"foot/{side}/pad_force"][101:, :, 2].sum(axis=1) for side in log.sides)
    gained = log["truth/com/velocity"][-1, 2] - log["truth/com/velocity"][100, 2]
    assert force.sum() * TICK == pytest.approx(
        (87.0 + 8.7) * (gained + 9.81 * (log.time[-1] - log.time[100])), rel=1e-4
    )


def true_signals(log: Log) -> SensorSignals:
    """What the sensors ought to have read, but for the IMU, which the log has as read."""
    return SensorSignals(
        log["truth/joint/position"],
        log["truth/joint/velocity"],
        log["imu/linear_acceleration"],
        log["imu/angular_velocity"],
        np.concatenate([log[f"truth/foot/{side}/pad_force"] for side in log.sides], axis=1),
        log["joint/torque_command"],
        np.zeros((len(log.time), 0)),
        load(log),
        load(log),
    )


def load(log: Log) -> np.ndarray:
    """What passed the gears in the steps that ended, of a log of every step; nothing at first."""
    left = log["joint/torque_command"] - log["truth/joint/friction_torque"]
    return np.concatenate([np.zeros((1, left.shape[1])), left[:-1]])


@pytest.mark.parametrize("name", ["paper_walk", "leg_swing_gantry"])
def test_simulated_readings_are_those_of_the_whole_log(plain: Robot, name: str):
    effects = [effect for effect in SENSOR_EFFECTS if effect.acts_on != "robot"]
    log = simulated(name, "duration=0.2", effects=effects)
    signals = true_signals(log)
    for effect in effects:
        signals = effect.distorted(signals, effect.resolve(plain.description), plain, TICK)
    np.testing.assert_allclose(log["joint/position"], signals.joint_position, atol=1e-13)
    np.testing.assert_allclose(log["joint/velocity"], signals.joint_velocity, atol=1e-12)
    read = np.concatenate([log[f"foot/{side}/pad_force"] for side in log.sides], axis=1)
    np.testing.assert_allclose(read, signals.pad_force, atol=1e-10)


def test_simulated_imu_reads_bias_and_turned_axes():
    angle, acceleration, rate = [0.02, -0.03, 0.1], [0.1, 0.2, -0.3], [0.01, -0.02, 0.03]
    effects = [ImuMisalignment(*angle), AccelerometerBias(*acceleration), GyroscopeBias(*rate)]
    station = build_station(
        with_effects(scenario("paper_walk", "duration=0.2", noise=False), *effects)
    )
    simulator = Simulator(station)
    context, imu = simulator.get_context(), station.GetSubsystemByName("imu")
    turn = Rotation.from_rotvec(angle).inv()
    for time in (0.05, 0.1, 0.2):
        simulator.AdvanceTo(time)
        true = imu.get_output_port().Eval(imu.GetMyContextFromRoot(context))
        expected = np.concatenate(
            [turn.apply(true[:3]) + acceleration, turn.apply(true[3:]) + rate]
        )
        np.testing.assert_allclose(
            station.GetOutputPort("measured_imu").Eval(context), expected, atol=1e-12
        )
        assert np.linalg.norm(true[3:]) > 1e-4
    release(station)


def test_misalignment_is_that_of_the_imu_configuration():
    angle = [0.02, -0.03, 0.1]
    base = scenario("paper_walk", "duration=0.05", noise=False)
    base = dataclasses.replace(
        base,
        sensors=dataclasses.replace(
            base.sensors, imu=dataclasses.replace(base.sensors.imu, misalignment=angle)
        ),
    )
    configured, effect = (
        simulate(base).log,
        simulated("paper_walk", "duration=0.05", effects=[ImuMisalignment(*angle)]),
    )
    for channel in ("imu/linear_acceleration", "imu/angular_velocity"):
        np.testing.assert_allclose(effect[channel], configured[channel], atol=1e-12)


def test_foot_force_errors(plain: Robot):
    force = np.random.default_rng(0).normal(size=(5, 8, 3))
    none = np.zeros((5, 12))
    still = np.zeros((5, 3))
    signals = SensorSignals(none, none, still, still, force, none, np.zeros((5, 0)), none, none)

    def read(effect: SensorEffect) -> np.ndarray:
        return (
            effect.distorted(signals, effect.resolve(plain.description), plain, TICK).pad_force
            - force
        )

    gained = read(FootForceGain({"left": 0.1}))
    np.testing.assert_allclose(gained[:, :4], 0.1 * force[:, :4])
    assert np.all(gained[:, 4:] == 0)
    biased = read(FootForceBias(y={"right": 2.0}, z={"all": -1.0}))
    np.testing.assert_allclose(
        biased,
        np.broadcast_to(np.repeat([[0, 0, -1], [0, 2, -1]], 4, axis=0), force.shape),
        atol=1e-12,
    )


def wrenches(robot: Robot, force: np.ndarray) -> np.ndarray:
    """By hand: [moment, force] of each foot from the forces on its pads or corners,
    (..., feet, 6)."""
    places = [robot.pad_positions(side) for side in robot.description.sides]
    parts = np.split(force, np.cumsum([len(p) for p in places])[:-1], axis=-2)
    return np.stack(
        [
            np.concatenate([np.cross(p, f).sum(axis=-2), f.sum(axis=-2)], axis=-1)
            for p, f in zip(places, parts, strict=True)
        ],
        axis=-2,
    )


@pytest.mark.parametrize("description", ["biped", "strider"])
def test_foot_wrench_errors(description: str):
    """Feet with pads and feet with six-axis sensors."""
    robot = build_robot(RobotConfig(description))
    n, points = len(robot.joint_names), sum(leg.points for leg in robot.description.legs.values())
    first, second = robot.description.sides
    force = np.random.default_rng(0).normal(scale=50, size=(400, points, 3))
    none, still = np.zeros((400, n)), np.zeros((400, 3))
    signals = SensorSignals(none, none, still, still, force, none, np.zeros((5, 0)), none, none)
    true = wrenches(robot, force)

    def read(effect: SensorEffect) -> np.ndarray:
        return wrenches(
            robot,
            effect.distorted(signals, effect.resolve(robot.description), robot, TICK).pad_force,
        )

    moment = read(FootMomentBias(x={first: 2.0}, z={"all": -1.0})) - true
    np.testing.assert_allclose(
        moment,
        np.broadcast_to([[2, 0, -1, 0, 0, 0], [0, 0, -1, 0, 0, 0]], moment.shape),
        atol=1e-10,
    )
    angle = np.array([0.1, -0.2, 0.3])
    turned = read(FootForceMisalignment(*({second: value} for value in angle)))
    R_FS = Rotation.from_rotvec(angle)
    np.testing.assert_allclose(turned[:, 0], true[:, 0], atol=1e-9)
    for part in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(
            turned[:, 1, part], R_FS.inv().apply(true[:, 1, part]), atol=1e-9
        )
    # A low-pass of first order that starts with the first reading.
    lag = FootForceLag({first: 0.03})
    late, stays = read(lag), 0.03 / (0.03 + TICK)
    expected = true[:, 0].copy()
    for k in range(1, len(expected)):
        expected[k] = stays * expected[k - 1] + (1 - stays) * true[k, 0]
    np.testing.assert_allclose(late[:, 0], expected, atol=1e-9)
    np.testing.assert_allclose(late[:, 1], true[:, 1], atol=1e-9)
    # And what was lost in it is had back.
    resolved = lag.resolve(robot.description)
    lagged = lag.distorted(signals, resolved, robot, TICK)
    undone = lag.undone(
        lagged, lag.memory_over_time(lagged, resolved, robot, TICK), resolved, robot, TICK
    )
    np.testing.assert_allclose(wrenches(robot, undone.pad_force), true, atol=1e-8)
    if description == "strider":
        offset = read(FootForceBias(x={first: 5.0}, z={second: -7.0})) - true
        np.testing.assert_allclose(
            offset,
            np.broadcast_to([[0, 0, 0, 5, 0, 0], [0, 0, 0, 0, 0, -7]], offset.shape),
            atol=1e-10,
        )


def test_elastic_transmission_follows_as_a_low_pass_what_friction_leaves_of_the_command():
    compliance, time_constant = 5e-5, 0.008
    log = simulated(
        "leg_swing_gantry",
        "duration=0.5",
        effects=[TransmissionElasticity({"knee_pitch": compliance}, {"all": time_constant})],
    )
    knee, other = 3, 2
    behind, friction = (each[:, knee] for each in (load(log), log["truth/joint/friction_torque"]))
    keep = np.exp(-TICK / time_constant)
    twist = lfilter([1.0 - keep], [1.0, -keep], compliance * behind)
    assert compliance * np.abs(friction).max() > 1e-5
    np.testing.assert_allclose(
        log["joint/position"][:, knee] - log["truth/joint/position"][:, knee], twist, atol=1e-13
    )
    assert np.abs(twist).max() > 1e-4
    # The exact velocity at the end of each step is the limit of the twist's slope.
    rate = (log["joint/velocity"] - log["truth/joint/velocity"])[1:, knee]
    np.testing.assert_allclose(
        rate, (compliance * behind[1:] - twist[1:]) / time_constant, atol=1e-12
    )
    np.testing.assert_array_equal(
        log["joint/position"][:, other], log["truth/joint/position"][:, other]
    )


@pytest.mark.parametrize("effect", [e for e in SENSOR_EFFECTS if e.memory_size])
def test_memory_over_a_log_is_that_of_its_ticks(plain: Robot, effect: SensorEffect):
    random, ticks = np.random.default_rng(0), 40
    shapes = {"specific_force": (3,), "angular_velocity": (3,), "motor_position": (0,)}
    shapes["pad_force"] = (sum(len(G[0]) // 3 for G in plain.grasp_maps), 3)
    names = [field.name for field in dataclasses.fields(SensorSignals)]
    signals = SensorSignals(
        *(random.normal(size=(ticks, *shapes.get(name, (12,)))) for name in names)
    )
    resolved = effect.resolve(plain.description)
    memory = effect.memory_over_time(signals, resolved, plain, TICK)
    assert np.abs(memory).max(axis=(1, 2)).min() > 0.0
    for k in range(1, ticks - 1):
        tick = SensorSignals(*(channel[k] for channel in vars(signals).values()))
        after = effect.remembered(tick, memory[:, k], resolved, plain, TICK)
        np.testing.assert_allclose(memory[:, k + 1], after, rtol=1e-12, atol=1e-14)


def test_unknown_foot_is_refused():
    with pytest.raises(
        InputError,
        match=r"robot\.effects\.added_0\.gain\.middle: unknown foot \(allowed: all, left, right\)",
    ):
        build_station(
            with_effects(scenario("squat", "duration=0.1"), FootForceGain({"middle": 0.1}))
        )


def test_forces_and_imu_on_a_slope_know_the_tilted_gravity():
    slope = GroundSlope(0.04, -0.03)
    log = simulated("squat", "duration=0.5", "reference.amplitude=0", effects=[slope])
    upward = Rotation.from_rotvec([0.04, -0.03, 0.0]).inv().apply([0.0, 0.0, 9.81])
    # Impulse of forces and of specific force: the change of velocity, and gravity's.
    steps, time = slice(101, None), log.time[-1] - log.time[100]
    force = sum(log[f"foot/{side}/pad_force"][steps].sum(axis=1) for side in log.sides)
    gained = np.diff(log["truth/com/velocity"][[100, -1]], axis=0)[0]
    # Forces are in sole frames, which are parallel to the ground to a milliradian.
    np.testing.assert_allclose(
        force.sum(axis=0) * TICK / 87.0, gained + upward * time, atol=1e-3 * 9.81 * time
    )
    orientation = Rotation.from_quat(log["truth/base/orientation"], scalar_first=True)
    lever = np.cross(log["truth/base/angular_velocity"], orientation.apply([0.01, -0.01, 0.02]))
    gained = np.diff((log["truth/base/velocity"] + lever)[[100, -1]], axis=0)[0]
    felt = orientation[steps].apply(log["imu/linear_acceleration"][steps])
    np.testing.assert_allclose(felt.sum(axis=0) * TICK, gained + upward * time, atol=2e-3)


def sole_motion(robot: Robot, log: Log, side: str) -> tuple[np.ndarray, np.ndarray]:
    """True rotation vector and displacement of a sole, against the world."""
    context, rotation = robot.plant.CreateDefaultContext(), np.empty((len(log.time), 3))
    for k in range(len(log.time)):
        X_WB = RigidTransform(
            Quaternion(log["truth/base/orientation"][k]), log["truth/base/position"][k]
        )
        robot.set_state(context, log["truth/joint/position"][k], np.zeros(12), X_WB)
        rotation[k] = Rotation.from_matrix(
            robot.sole(side).CalcPoseInWorld(context).rotation().matrix()
        ).as_rotvec()
    return rotation, log[f"truth/foot/{side}/position"]


def recovered(
    effect: type[ContactEffect], robot: Robot, log: Log, side: str, rows: slice, axes: Sequence[int]
) -> tuple[float, float]:
    """Parameter with which the predicted motion of a standing sole fits the true one best, and the
    share of that motion which it explains.

    Args:
        axes: of [rotation, displacement].
    """
    predicted, true = [
        np.concatenate(motion, axis=-1)[..., rows, :][..., axes]
        for motion in (
            effect.sole_motion(
                log[f"truth/foot/{side}/pad_force"], robot.pad_positions(side), log.time
            ),
            sole_motion(robot, log, side),
        )
    ]
    predicted, true = predicted[0] - predicted[0].mean(axis=0), true - true.mean(axis=0)
    # Each axis in units of its own motion.
    predicted, true = predicted / true.std(axis=0), true / true.std(axis=0)
    value = float(np.sum(predicted * true) / np.sum(predicted**2))
    return value, 1.0 - float(np.var(true - value * predicted) / np.var(true))


SWAY = ("sway", "duration=2", "reference.ramp=1", "reference.frequency=0.4")


def test_contact_with_effects():
    ground, plant = (
        Ground(stiffness=5e5, dissipation=80.0),
        MultibodyPlantConfig(stiction_tolerance=2e-4),
    )
    soft, same = GroundCompliance(3e-6).contact(ground, plant, 0.9)
    assert 1.0 / soft.stiffness == pytest.approx(1.0 / 5e5 + 3e-6)
    # Depth times dissipation stays.
    assert soft.dissipation / soft.stiffness == pytest.approx(80.0 / 5e5)
    assert same.stiction_tolerance == 2e-4
    same, creeping = FootCreep(0.01).contact(ground, plant, 0.9)
    assert same == ground
    assert creeping.stiction_tolerance == pytest.approx(2e-4 + 0.01 * 0.9)
    assert plant.stiction_tolerance == 2e-4
    turned, _ = GroundSlope(0.1, 0.2).contact(Ground(slope=[0.0, 0.05]), plant, 0.9)
    np.testing.assert_allclose(turned.slope, [0.1, 0.25])


def test_compliant_ground_gives_way_as_predicted(plain: Robot):
    # On top of the ground's own 1e-6 m/N.
    log = simulated(*SWAY, effects=[GroundCompliance(3e-6)])
    value, explained = recovered(GroundCompliance, plain, log, "left", slice(300, None), [0, 1, 5])
    assert value == pytest.approx(4e-6, rel=0.03)
    assert explained > 0.97


def test_standing_robot_sinks_into_compliant_ground_by_its_weight():
    logs = [
        simulated("squat", "duration=0.5", "reference.amplitude=0", effects=effects)
        for effects in ([], [GroundCompliance(5e-6)])
    ]
    firm, soft = (
        sum(log[f"truth/foot/{side}/position"][-100:, 2].mean() for side in log.sides) / 2
        for log in logs
    )
    assert firm - soft == pytest.approx(5e-6 * WEIGHT / 8, rel=0.02)


def test_soles_creep_as_predicted(plain: Robot):
    log = simulated(*SWAY, effects=[FootCreep(0.01)])
    # Friction 0.8 of the ground and 1 of the pads; the solver's own tolerance is 1e-4 m/s.
    own = 1e-4 / (2 * 0.8 / 1.8)
    value, explained = recovered(FootCreep, plain, log, "left", slice(100, 1700), [2, 4])
    assert value == pytest.approx(0.01 + own, rel=0.03)
    assert explained > 0.99


def test_a_foot_in_the_air_does_not_creep_out_of_all_numbers(plain: Robot):
    force = 0.5 * np.random.default_rng(0).normal(size=(100, 4, 3))
    rotation, displacement = FootCreep.sole_motion(
        force, plain.pad_positions("left"), TICK * np.arange(100)
    )
    assert np.all(np.isfinite(rotation))
    assert np.abs(displacement).max() < 0.1


def test_creep_needs_a_solver_that_creeps():
    with pytest.raises(
        InputError,
        match=(
            r"robot: plant\.discrete_contact_approximation: FootCreep needs lagged or "
            r"similar, found sap"
        ),
    ):
        build_station(
            with_effects(
                scenario("squat", "duration=0.1", "plant.discrete_contact_approximation=sap"),
                FootCreep(0.01),
            )
        )


def test_effects_of_size_zero_change_no_bit():
    """The paths of all sensor, contact and inertia effects, but none of their physics."""
    zero = [
        FootForceGain({"all": 0.0}),
        FootForceBias(x={"all": 0.0}),
        AccelerometerGain(),
        ImuMisalignment(),
        AccelerometerBias(),
        GyroscopeBias(),
        EncoderOffset({"all": 0.0}),
        TransmissionElasticity({"all": 0.0}),
        GroundSlope(),
        GroundCompliance(),
        FootCreep(),
        ReflectedInertia({"all": 0.0}),
    ]
    base = scenario("paper_walk", "duration=0.3")
    without, zeros = simulate(base).log, simulate(with_effects(base, *zero)).log
    for channel, values in without.channels.items():
        np.testing.assert_array_equal(values, zeros[channel], err_msg=channel)


def test_gravity_stays_upright_in_a_gantry():
    config = RobotConfig(gantry_height=1.0)
    slope = scenario("squat").ground
    tilted = dataclasses.replace(slope, slope=[0.1, 0.0])
    robots = [
        build_robot(each, plant=MultibodyPlantConfig(time_step=TICK), ground=tilted)
        for each in (config, RobotConfig())
    ]
    gravity = [robot.plant.gravity_field().gravity_vector() for robot in robots]
    np.testing.assert_array_equal(gravity[0], [0.0, 0.0, -9.81])
    np.testing.assert_allclose(gravity[1], [0.0, -9.81 * np.sin(0.1), -9.81 * np.cos(0.1)])
