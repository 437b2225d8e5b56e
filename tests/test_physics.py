"""What a simulated robot must do because it is a physical one."""

from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from fbse_drake import Log, Scenario, build_station, simulate
from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.report.metrics import stance_creep
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import RobotConfig
from fbse_drake.walking.reference import JointSines
from fbse_drake.wiring import release

GRAVITY = 9.81
Run = Callable[..., Log]


def load(log: Log) -> np.ndarray:
    return sum(log[f"foot/{side}/pad_force"][:, :, 2].sum(axis=1) for side in log.sides)


def test_standing_feet_carry_the_weight(run: Run):
    log = run("squat", "duration=2", "reference.amplitude=0", noise=False)
    np.testing.assert_allclose(load(log)[500:], 87.0 * GRAVITY, rtol=1e-3)


def test_zmp_of_slow_sway_is_the_planned_one(run: Run):
    log = run("sway", "duration=3.5", noise=False)
    assert np.abs(log["truth/zmp"] - log["reference/zmp"])[200:].max() < 0.01
    assert np.ptp(log["truth/zmp"][:, 1]) > 0.08


@pytest.mark.parametrize("name", ["squat", "paper_walk", "leg_swing_gantry"])
def test_imu_is_the_twice_differentiated_motion_minus_gravity(run: Run, name: str):
    log = run(name, "duration=3", noise=False)
    h = log.meta["period"]
    R_WB = Rotation.from_quat(log["truth/base/orientation"], scalar_first=True)
    p_WI = log["truth/base/position"] + R_WB.apply([0.01, -0.01, 0.02])
    # Second difference over the two last steps, as the plant's own acceleration.
    acceleration = (p_WI[2:] - 2 * p_WI[1:-1] + p_WI[:-2]) / h**2
    specific_force = R_WB[2:].inv().apply(acceleration + [0, 0, GRAVITY])
    measured = log["imu/linear_acceleration"][2:]
    np.testing.assert_allclose(
        np.sqrt(np.mean((measured - specific_force) ** 2, axis=0)), 0, atol=0.01
    )
    rate = (R_WB[:-1].inv() * R_WB[1:]).as_rotvec() / h
    np.testing.assert_allclose(log["imu/angular_velocity"][1:], rate, atol=1e-4)


def test_pad_forces_are_the_contact_forces():
    station = build_station(scenario("paper_walk", "duration=1", noise=False))
    plant, simulator = station.robot.plant, Simulator(station)
    context = simulator.get_context()
    plant_context = plant.GetMyContextFromRoot(context)
    pads = [pad for leg in station.robot.description.legs.values() for pad in leg.pads]
    bodies = [plant.GetJointByName(pad).child_body().index() for pad in pads]
    for time in (0.05, 0.3, 0.7):
        simulator.AdvanceTo(time)
        results = plant.get_contact_results_output_port().Eval(plant_context)
        contact_force = np.zeros((len(pads), 3))
        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            contact_force[bodies.index(info.bodyA_index())] -= info.contact_force()
        measured = station.GetOutputPort("measured_pad_force").Eval(context).reshape(-1, 3)
        assert np.count_nonzero(contact_force[:, 2]) == (8 if time < 0.5 else 4)
        # Sole frames are level to a milliradian, world forces are up to 250 N.
        np.testing.assert_allclose(measured[:, 2], contact_force[:, 2], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(
            np.linalg.norm(measured, axis=1), np.linalg.norm(contact_force, axis=1), rtol=1e-9
        )
    release(station)


def test_position_loop_has_little_to_do_in_a_slow_frictionless_squat(run: Run):
    changes = ("duration=4", "reference.frequency=0.15", "robot.effects.joint_friction=null")
    log = run("squat", *changes, noise=False)
    assert np.all(log["truth/joint/friction_torque"] == 0)
    feedforward = log["reference/joint/feedforward_torque"]
    added = log["joint/torque_command"] - feedforward
    assert np.linalg.norm(added[1000:]) < 0.02 * np.linalg.norm(feedforward[1000:])


def tumbling_energy_drift(time_step: float) -> float:
    """Largest change of the total energy of a freely falling robot with moving joints, relative to
    its kinetic energy."""
    builder = DiagramBuilder()
    robot, _ = make_robot(
        "biped", builder=builder, config=MultibodyPlantConfig(time_step=time_step)
    )
    plant, simulator = robot.plant, Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    posture = np.tile([0.0, 0.0, -0.4, 0.8, -0.4, 0.0], 2)
    robot.set_state(
        context,
        posture,
        np.linspace(-1, 1, 12),
        RigidTransform([0, 0, 2.0]),
        np.array([1.0, 2.0, 0.5, 0.3, 0.0, 1.0]),
    )

    def energy() -> float:
        return plant.CalcKineticEnergy(context) + plant.CalcPotentialEnergy(context)

    start, kinetic = energy(), plant.CalcKineticEnergy(context)
    drift = 0.0
    for k in range(1, 11):
        simulator.AdvanceTo(0.02 * k)
        drift = max(drift, abs(energy() - start))
    return drift / kinetic


def test_falling_robot_conserves_energy():
    coarse, fine = tumbling_energy_drift(1e-3), tumbling_energy_drift(5e-4)
    assert coarse < 0.02
    assert fine == pytest.approx(coarse / 2, rel=0.2)


@pytest.mark.parametrize("name", ["paper_walk", "hrp2_friction_walk", "leg_swing_gantry"])
def test_friction_takes_energy_out_of_every_joint(run: Run, name: str):
    log = run(name, "duration=3", noise=False)
    # The torque of a step acts while the joint moves on to its next velocity.
    power = log["truth/joint/friction_torque"][:-1] * log["truth/joint/velocity"][1:]
    assert np.all(power.sum(axis=0) > 0)
    assert -power[power < 0].sum() < 1e-3 * power[power > 0].sum()


def closure(log: Log, name: str) -> tuple[np.ndarray, np.ndarray]:
    """What is left of the equation of motion in each step: on the joints against the injected
    friction, and on the base.

    Uses logged channels, true accelerations over the same step and Drake's model, nothing of the
    simulation.
    """
    config = scenario(name).robot
    robot, _ = make_robot(
        config.description, rotor_inertia=config.rotor_inertia, gantry_height=config.gantry_height
    )
    plant, context, world = (
        robot.plant,
        robot.plant.CreateDefaultContext(),
        robot.plant.world_frame(),
    )
    forces, floating = MultibodyForces(robot.plant), robot.has_floating_base
    joint_error, base_error = [], []
    for k in range(1, len(log.time)):
        before = k - 1
        X_WB = V_WB = None
        if floating:
            X_WB = RigidTransform(
                Quaternion(log["truth/base/orientation"][before]),
                log["truth/base/position"][before],
            )
            V_WB = np.concatenate(
                [log["truth/base/angular_velocity"][before], log["truth/base/velocity"][before]]
            )
        robot.set_state(
            context, log["joint/position"][before], log["joint/velocity"][before], X_WB, V_WB
        )
        acceleration = np.zeros(plant.num_velocities())
        acceleration[robot.velocity_index] = log["truth/joint/acceleration"][k]
        if floating:
            acceleration[:6] = np.concatenate(
                [log["truth/base/angular_acceleration"][k], log["truth/base/acceleration"][k]]
            )
        plant.CalcForceElementsContribution(context, forces)
        needed = plant.CalcInverseDynamics(context, acceleration, forces)
        for side in log.sides:
            sole = robot.sole(side)
            R_WF = sole.CalcPoseInWorld(context).rotation().matrix()
            pads = robot.pad_positions(side).T
            J = plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, sole, pads, world, world
            )
            needed -= J.T @ (log[f"foot/{side}/pad_force"][k] @ R_WF.T).ravel()
        link_torque = needed[robot.velocity_index]
        joint_error.append(
            log["joint/torque_command"][before]
            - link_torque
            - log["truth/joint/friction_torque"][before]
        )
        base_error.append(needed[:6] if floating else np.zeros(6))
    return np.abs(joint_error), np.abs(base_error)


def test_closure_without_contact(run: Run):
    """To rounding, but in the few steps that Drake's solver ends at its relative tolerance of 1e-6,
    as where the law has a corner."""
    joint_error, _ = closure(run("leg_swing_gantry", "duration=3", noise=False), "leg_swing_gantry")
    assert np.mean(joint_error.max(axis=1) < 1e-9) > 0.99
    assert joint_error.max() < 2e-3


@pytest.mark.parametrize("name", ["squat", "paper_walk", "hrp2_friction_walk"])
def test_closure_with_contact(run: Run, name: str):
    """The model returns the friction as exactly as Drake's contact solver closes the six unactuated
    equations.

    The solver stops at a relative tolerance of 1e-6 of the momentum; what it leaves over shows in
    the base rows, where nothing else is.
    """
    joint_error, base_error = (
        error.max(axis=1) for error in closure(run(name, "duration=3", noise=False), name)
    )
    assert np.median(joint_error) < 1e-5
    assert joint_error.max() < 5e-3
    solved = base_error < 1e-7
    assert solved.mean() > 0.1
    assert joint_error[solved].max() < 1e-6


@pytest.mark.parametrize("name", ["paper_walk", "hrp2_friction_walk", "strider_walk"])
def test_friction_does_not_ring(run: Run, name: str):
    """Of noise-free walks no more than a hundredth of the friction's power is above a quarter of
    the tick rate; hip yaws stick."""
    friction = run(name, "duration=3", noise=False)["truth/joint/friction_torque"]
    power = np.abs(np.fft.rfft(friction - friction.mean(axis=0), axis=0)) ** 2
    share = power[len(power) // 2 :].sum(axis=0) / power.sum(axis=0)
    assert share.max() < 0.0105


@pytest.mark.parametrize(
    ("name", "duration", "share"),
    [
        ("squat", 1, 0.97),
        ("sway", 1, 0.97),
        ("paper_walk", 3, 0.9),
        ("hrp2_friction_walk", 1.5, 0.9),
    ],
)
def test_closure_with_exactly_solved_contact(run: Run, name: str, duration: float, share: float):
    """Drake's `sap` contact is linear as long as pads keep standing or sliding, and joints between
    the corners of their laws; then its solver's last step is exact."""
    changes = (f"duration={duration}", "plant.discrete_contact_approximation=sap")
    joint_error, _ = closure(run(name, *changes, noise=False), name)
    assert np.mean(joint_error.max(axis=1) < 1e-6) >= share


# What acts is off its law by no more than this share of the law: of laws that fall with speed, and
# of those that rise everywhere.
FALLING_LAW, RISING_LAW = 2e-2, 5e-3


def law_error(log: Log) -> np.ndarray:
    """Rms of the simulated friction less its law over the law's rms, of joints that move at all."""
    law = log["truth/joint/friction_law_torque"]
    size = np.sqrt(np.mean(law**2, axis=0))
    error = np.sqrt(np.mean((log["truth/joint/friction_torque"] - law) ** 2, axis=0))
    return error[size > 1e-6] / size[size > 1e-6]


@pytest.mark.parametrize(
    ("name", "seed", "largest_error", "law"),
    [
        ("paper_walk", 0, 2e-3, FALLING_LAW),
        ("paper_walk", 9, 2e-3, FALLING_LAW),
        ("hrp2_friction_walk", 0, 3.5e-3, RISING_LAW),
    ],
)
def test_robot_walks(name: str, seed: int, largest_error: float, law: float):
    """On its feet to the end, and its friction follows its law all the way."""
    # Not kept: nobody else looks at so long a log.
    log = simulate(scenario(name, f"seed={seed}")).log
    assert not log.meta["outcome"]["fell"]
    assert log.time[-1] == pytest.approx(11.5)
    error = log["reference/joint/position"] - log["truth/joint/position"]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < largest_error
    creep = stance_creep(log)
    assert [len(stances) for stances in creep.values()] == [4, 5]
    assert max(max(stances) for stances in creep.values()) < 0.5e-3
    # Seven single supports: seven times one foot carries everything.
    unloaded = np.stack(
        [log[f"truth/foot/{side}/pad_force"][:, :, 2].sum(axis=1) < 1.0 for side in log.sides],
        axis=1,
    )[1:]
    assert not unloaded.all(axis=1).any()
    lifted = np.stack(
        [log[f"truth/foot/{side}/position"][:, 2] > 0.02 for side in log.sides], axis=1
    ).astype(int)
    assert np.maximum(np.diff(lifted, axis=0), 0).sum() == 7
    assert len(law_error(log)) == 12
    assert law_error(log).max() < law


def test_com_converges_under_step_halving(run: Run):
    coarse, fine = (
        run("paper_walk", "duration=3", *changes, noise=False)
        for changes in ((), ("plant.time_step=0.0005",))
    )
    np.testing.assert_allclose(fine.time, coarse.time, atol=1e-12)
    assert np.abs(coarse["truth/com/position"] - fine["truth/com/position"]).max() < 1e-3


def test_walk_at_a_step_of_two_milliseconds_is_the_same_walk(run: Run):
    shorter = run("paper_walk", "duration=3", noise=False)
    longer = run("paper_walk", "duration=1.5", "plant.time_step=0.002", noise=False)
    assert not any(log.meta["outcome"]["fell"] for log in (shorter, longer))
    shorter = shorter.part(slice(0, 2 * len(longer.time)))
    np.testing.assert_allclose(longer.time, shorter.time[::2], atol=1e-12)
    change = longer["truth/com/position"] - shorter["truth/com/position"][::2]
    assert np.abs(change).max() < 1e-3


@pytest.mark.parametrize("step", [0.004, 0.002, 0.001])
def test_a_sampled_position_loop_damps_by_its_closed_form(step: float):
    """kd - kp (T - h) / 2 at control period T and plant step h, of models/pendulum.urdf."""
    kp, period, inertia = 5.0, 0.004, 0.49 * 0.1**2 + 1.5e-4
    lost = kp * (period - step) / 2

    def growth(kd: float) -> float:
        """Of the swing about the place where a loop without feed-forward lets the arm sag [1/s]."""
        log = simulate(
            Scenario(
                robot=RobotConfig("pendulum"),
                model=RobotConfig("pendulum"),
                reference=JointSines(posture={"servo": 0.2}),
                control=PositionLoopConfig(
                    kp={"servo": kp}, kd={"servo": kd}, feedforward=False, period=period
                ),
                plant=MultibodyPlantConfig(time_step=step),
                duration=2.0,
            )
        ).log
        angle = log["truth/joint/position"][:, 0]
        quarters = np.split(angle[: len(angle) // 4 * 4] - angle.mean(), 4)
        return np.log(quarters[3].std() / quarters[0].std()) / 1.5

    assert growth(kd=0.0) == pytest.approx(lost / (2 * inertia), rel=0.03, abs=5e-3)
    assert growth(kd=lost) == pytest.approx(0.0, abs=5e-3)


# Whole walks: see `test_robot_walks`.
_FOLLOWED = [
    ("hrp2_walk_fbse", "duration=2", RISING_LAW),
    ("paper_walk_integral", "duration=1.5", FALLING_LAW),
    ("strider_walk", "duration=3", RISING_LAW),
    ("leg_swing_gantry", "duration=3", FALLING_LAW),
    ("squat", "duration=2", FALLING_LAW),
    ("sway", "duration=2", FALLING_LAW),
    ("walks/sideways", "duration=2", FALLING_LAW),
    # Its feet hit the ground, and then it falls.
    ("paper_walk_pd", "duration=3", FALLING_LAW),
]


@pytest.mark.parametrize(("name", "duration", "asked"), _FOLLOWED)
def test_simulated_friction_follows_its_law(run: Run, name: str, duration: str, asked: float):
    error = law_error(run(name, duration))
    assert len(error) == 12
    assert error.max() < asked


@pytest.mark.parametrize(
    ("name", "asked"), [("paper_walk", FALLING_LAW), ("hrp2_friction_walk", RISING_LAW)]
)
def test_at_twice_the_step_it_follows_half_as_well(run: Run, name: str, asked: float):
    assert law_error(run(name, "duration=3", "plant.time_step=0.002")).max() < 2 * asked


def test_the_same_scenario_gives_the_same_log_bit_for_bit():
    logs = [simulate(scenario("hrp2_friction_walk", "duration=0.7")).log for _ in range(2)]
    assert all(np.array_equal(values, logs[1][name]) for name, values in logs[0].items())
