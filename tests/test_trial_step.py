"""Steps of the plant that are solved twice: friction that falls follows its law through impacts."""

from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from fbse_drake import JointSines, Log, Scenario, StribeckFriction, simulate
from fbse_drake.report.metrics import friction_law_error
from fbse_drake.robot.implicit import ImplicitTorque
from fbse_drake.robot.plant import Ground, Robot
from fbse_drake.robot.push import AppliedPushes, Push
from fbse_drake.robot.trial_step import TrialStep
from fbse_drake.scenario import RobotConfig, build_robot

Run = Callable[..., Log]

TWICE = "solve_twice=true"
STEP = 1e-3
LIFT = "robot.pushes.lift={body: trunk, force: [0, 0, 120], start: 0.1, duration: 0.1}"


def worst(log: Log) -> float:
    """Largest friction law error of all joints."""
    return max(friction_law_error(log).values())


def biped(builder: DiagramBuilder, *, sampled: bool) -> Robot:
    """On its ground, with a clamp and damping in every joint."""
    n, ones = 12, np.ones((1, 12))
    return build_robot(
        RobotConfig(),
        builder=builder,
        plant=MultibodyPlantConfig(
            time_step=STEP,
            contact_model="point",
            discrete_contact_approximation="lagged",
            use_sampled_output_ports=sampled,
        ),
        ground=Ground(),
        implicit=ImplicitTorque(np.full(n, 0.5), 100 * ones, 0.6 * ones, 0 * ones),
    )


def test_a_trial_ends_where_the_step_does() -> None:
    """In the air and pressed into the ground, standing and thrown."""
    generator = np.random.default_rng(0)
    builder = DiagramBuilder()
    copy = biped(builder, sampled=False)
    trial = TrialStep(copy, builder.Build(), AppliedPushes({}, copy))
    context, builder = trial.allocate().get_value(), DiagramBuilder()
    robot = biped(builder, sampled=True)
    diagram = builder.Build()
    plant, n = robot.plant, len(robot.joint_names)
    lowest = robot.sole("left").CalcPoseInWorld(plant.CreateDefaultContext()).translation()[2]
    for height, speed in ((0.5, 0.0), (0.1, 2.0), (-1e-3, 0.0), (-1e-3, 2.0)):
        positions = plant.GetPositions(plant.CreateDefaultContext())
        positions[robot.base.floating_positions_start() + 6] += height - lowest
        state = np.append(positions, speed * generator.normal(size=plant.num_velocities()))
        torque, offset = 20 * generator.normal(size=n), generator.normal(size=(1, n))
        force = generator.normal(size=plant.num_velocities())
        tried = trial.joint_velocity(context, 0.0, state, torque, offset, force)

        simulator = Simulator(diagram)
        now = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        actuation = robot.actuation_selector @ torque + robot.clamp_selector @ offset.ravel()
        plant.get_actuation_input_port().FixValue(now, actuation)
        plant.get_applied_generalized_force_input_port().FixValue(now, force)
        wanted = plant.get_desired_state_input_port(robot.base.model_instance())
        wanted.FixValue(now, np.zeros(wanted.size()))
        plant.SetPositionsAndVelocities(now, state)
        simulator.AdvanceTo(STEP)
        made = plant.GetVelocities(now)[robot.velocity_index]
        assert np.abs(made - state[plant.num_positions() + robot.velocity_index]).max() > 1e-3
        np.testing.assert_allclose(tried, made, rtol=0, atol=1e-12)


def stroke_error(*, solve_twice: bool) -> float:
    """A pendulum with friction that falls is struck for a step while it hangs at rest: rms of what
    Newton's equation with the law leaves over, as a share of the law's."""
    friction = StribeckFriction(gamma1={"all": 0.02}, gamma4={"all": 0.02}, gamma6={"all": 0.0})
    strike = Push(body="arm", force=[4.0, 0.0, 0.0], start=0.1, duration=STEP)
    robot = RobotConfig("pendulum", effects={"friction": friction}, pushes={"strike": strike})
    still = JointSines(amplitude={"all": 0.0})
    log = simulate(
        Scenario(duration=0.15, robot=robot, reference=still, solve_twice=solve_twice)
    ).log
    q, v = (log[f"truth/joint/{name}"][:, 0] for name in ("position", "velocity"))
    end = v[1:]
    law = 0.02 * (np.tanh(100 * end) - np.tanh(10 * end) + np.tanh(100 * end))
    # Of models/pendulum.urdf.
    mass, length, inertia = 0.49, 0.1, 0.49 * 0.1**2 + 1.5e-4
    torque = log["joint/torque_command"][:-1, 0] - mass * 9.81 * length * np.sin(q[:-1])
    torque += 4.0 * length * np.cos(q[:-1]) * np.isclose(log.time[:-1], 0.1)
    left = torque - law - inertia * np.diff(v) / STEP
    return np.sqrt(np.mean(left**2) / np.mean(law**2))


def test_friction_that_falls_follows_its_law_through_a_stroke() -> None:
    assert stroke_error(solve_twice=False) > 0.05
    assert stroke_error(solve_twice=True) < 0.01


def test_a_walk_follows_its_law_ten_times_as_closely(run: Run) -> None:
    once, twice = (run("paper_walk", "duration=1", *more) for more in ((), (TWICE,)))
    assert worst(twice) < 0.1 * worst(once)
    # It is the same walk.
    apart = once["truth/com/position"] - twice["truth/com/position"]
    assert 0 < np.abs(apart).max() < 1e-3


def test_what_pushes_the_robot_is_tried_too(run: Run) -> None:
    once, twice = (run("paper_walk", "duration=0.5", LIFT, *more) for more in ((), (TWICE,)))
    assert worst(twice) < 0.2 * worst(once)


def test_a_law_that_is_solved_as_it_is_needs_no_second_solve() -> None:
    """Bit for bit the same run."""
    viscous = "robot.effects.joint_friction=!ViscousFriction {viscous: {all: 2.0}}"
    once, twice = (
        simulate(scenario("sway", "duration=0.2", viscous, *more)).log for more in ((), (TWICE,))
    )
    assert set(once.channels) == set(twice.channels)
    for name, values in once.channels.items():
        np.testing.assert_array_equal(values, twice[name], err_msg=name)


@pytest.mark.parametrize(
    "effect",
    ["!JointSpring {stiffness: {all: 20.0}}", "!LoadDependentFriction {coefficient: {all: 0.1}}"],
)
def test_other_effects_follow_their_laws_more_closely_too(run: Run, effect: str) -> None:
    more = f"robot.effects.more={effect}"
    once, twice = (
        run("hrp2_friction_walk", "duration=0.3", more, *also) for also in ((), (TWICE,))
    )
    assert worst(twice) < 0.5 * worst(once)
