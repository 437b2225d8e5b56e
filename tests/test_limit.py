"""The smallest error of the friction: its covariances against closed forms, batch solutions, a
Monte Carlo and Drake's own step."""

import dataclasses
import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.stats import chi2

from benchmarks.limit import (
    FrictionPrior,
    Noise,
    Row,
    Step,
    WalkModel,
    filtered_covariance,
    foot_motion,
    future_information,
    headline,
    priors,
    require_known,
    rows_of,
    smoothed_covariance,
    walk_model,
)
from fbse_drake import load_scenario
from fbse_drake.errors import InputError
from fbse_drake.robot.implicit import ImplicitTorque
from fbse_drake.robot.plant import make_robot

PERIOD = 1e-3


def random_steps(seed: int, count: int) -> list[Step]:
    """Steps of a stable model of three states, two disturbances and two measurements."""
    rng = np.random.default_rng(seed)
    return [
        Step(
            transition=0.9 * np.linalg.qr(rng.normal(size=(3, 3)))[0],
            drive=0.5 * rng.normal(size=(3, 2)),
            after=rng.normal(size=(2, 3)),
            before=rng.normal(size=(2, 3)),
            variance=rng.uniform(0.1, 1.0, size=2),
        )
        for _ in range(count)
    ]


def batch(steps: list[Step], P: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """All states and measurements as linear maps of unit normal numbers: start, w and e."""
    sizes = [len(P)] + [step.drive.shape[1] + len(step.variance) for step in steps]
    parts = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
    states, measured = [np.linalg.cholesky(P) @ parts[0]], []
    for step, part in zip(steps, parts[1:], strict=True):
        w, e = np.split(part, [step.drive.shape[1]])
        states.append(step.transition @ states[-1] + step.drive @ w)
        noise = np.sqrt(step.variance)[:, None] * e
        measured.append(step.after @ states[-1] + step.before @ states[-2] + noise)
    return states, measured


def conditional(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain of the best estimate of x from y, and the covariance of its error."""
    gain = x @ y.T @ np.linalg.inv(y @ y.T)
    error = x - gain @ y
    return gain, error @ error.T


def test_steady_covariance_of_a_scalar_is_the_root_of_its_riccati_equation() -> None:
    a, q, r = 0.95, 0.02, 0.5
    one = np.ones((1, 1))
    step = Step(a * one, math.sqrt(q) * one, one, 0 * one, np.array([r]))
    P = 100 * one
    for _ in range(300):
        P = filtered_covariance(P, step)
    # The predicted variance m solves m = a^2 m r / (m + r) + q.
    b = r * (1 - a * a) - q
    predicted = (-b + math.sqrt(b * b + 4 * q * r)) / 2
    assert P[0, 0] == pytest.approx(predicted * r / (predicted + r), rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_covariances_are_those_of_all_numbers_at_once(seed: int) -> None:
    steps, P = random_steps(seed, 8), np.diag([1.0, 4.0, 0.3])
    states, measured = batch(steps, P)
    filtered = []
    for k, step in enumerate(steps):
        P = filtered_covariance(P, step)
        filtered.append(P)
        np.testing.assert_allclose(
            P, conditional(states[k + 1], np.vstack(measured[: k + 1]))[1], rtol=1e-9, atol=1e-12
        )
    information = np.zeros((3, 3))
    for k in reversed(range(len(steps))):
        expected = conditional(states[k + 1], np.vstack(measured))[1]
        found = smoothed_covariance(filtered[k], information)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-12)
        assert np.trace(found) < np.trace(filtered[k]) or k == len(steps) - 1
        information = future_information(information, steps[k])


def test_best_filter_errs_as_much_and_another_one_more() -> None:
    """Monte Carlo: the optimal estimate of the last state in 20000 simulated runs."""
    steps, P, runs = random_steps(7, 10), np.diag([1.0, 4.0, 0.3]), 20000
    states, measured = batch(steps, P)
    gain, _ = conditional(states[-1], np.vstack(measured))
    drawn = np.random.default_rng(1).standard_normal((states[-1].shape[1], runs))
    for step in steps:
        P = filtered_covariance(P, step)
    lower, upper = chi2.ppf((1e-4, 1 - 1e-4), runs) / runs
    x, y = states[-1] @ drawn, np.vstack(measured) @ drawn
    share = np.mean((x - gain @ y) ** 2, axis=1) / np.diag(P)
    assert np.all((lower < share) & (share < upper)), share
    careless = np.mean((x - 0.9 * gain @ y) ** 2, axis=1) / np.diag(P)
    assert np.all(careless > upper), careless


def one_joint(rows: int, slope: float, prior: FrictionPrior, noise: float) -> WalkModel:
    """A joint of 0.2 kg m^2 with friction of one parameter, and no other sensor than its
    encoder."""
    nothing = np.zeros((rows, 0, 6, 1))
    return WalkModel(
        period=PERIOD,
        noise=Noise(noise, 1.0, 1.0),
        prior=prior,
        joint=np.array([0]),
        mass_matrix=np.full((rows, 1, 1), 0.2),
        imu_jacobian=np.zeros((rows, 6, 1)),
        sole_jacobian=nothing,
        basis=np.ones((rows, 1, 1)),
        slope=np.full((rows, 1), slope),
        wrench_noise=nothing,
        foot_motion=np.zeros((rows, 0, 6)),
    )


def test_constant_friction_is_known_as_well_as_the_slope_of_a_line() -> None:
    """The velocity falls linearly with the friction; so it is a regression on a straight line."""
    rows, noise, prior = 200, 5e-4, 3.0
    model = one_joint(rows, 0.0, FrictionPrior(prior), noise)
    limit, smoother = model.filtered_variance(), model.smoothed_variance()
    regressor = np.stack([np.ones(rows - 1), -np.arange(1, rows) * PERIOD / 0.2], axis=1)
    information = np.diag([1.0, 1 / prior**2]) + regressor.T @ regressor / noise**2
    expected = np.linalg.inv(information)[1, 1]
    assert limit[-1, 0] == pytest.approx(expected, rel=1e-6)
    # A constant is known at all times as well as at the end.
    assert smoother[10, 0] == pytest.approx(expected, rel=1e-6)
    assert np.isnan(limit[0, 0])
    assert np.all(np.diff(limit[1:, 0]) <= 0)


def test_friction_that_walks_is_known_as_in_continuous_time() -> None:
    """Velocity as the integral of a random walk: the steady state of Kalman and Bucy."""
    walk, noise, inertia = 0.15, 0.05, 0.2
    model = one_joint(1500, 0.0, FrictionPrior(1e-9, walk, 0.1), noise)
    limit, smoother = model.filtered_variance(), model.smoothed_variance()
    density = noise * math.sqrt(PERIOD)
    steady = math.sqrt(2 * inertia * density * walk**3)
    assert limit[-1, 0] == pytest.approx(steady, rel=0.03)
    # Nothing is known better by waiting than at a quarter of that.
    assert 0.2 * steady < smoother[700, 0] < 0.3 * steady


def test_step_is_that_of_the_plant() -> None:
    """A robot in the air, with viscous friction that Drake's solver takes."""
    viscous = np.linspace(0.5, 150.0, 12)
    builder = DiagramBuilder()
    implicit = ImplicitTorque(viscous, *np.zeros((3, 0, 12)))
    robot, _ = make_robot("biped", implicit=implicit, builder=builder)
    diagram, plant = builder.Build(), robot.plant
    v, q = plant.num_velocities(), np.tile([0.1, -0.05, -0.4, 0.8, -0.4, 0.02], 2)
    rng, start = np.random.default_rng(3), 1e-3

    def after(velocity: np.ndarray) -> np.ndarray:
        simulator = Simulator(diagram)
        context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
        robot.set_state(context, q, np.zeros(12))
        plant.SetVelocities(context, velocity)
        simulator.AdvanceTo(PERIOD)
        return plant.GetVelocities(context)

    assert plant.time_step() == PERIOD
    context = plant.CreateDefaultContext()
    robot.set_state(context, q, np.zeros(12))
    mass_matrix = np.tile(plant.CalcMassMatrix(context), (2, 1, 1))
    nothing = np.zeros((2, 0, 6, v))
    model = WalkModel(
        period=PERIOD,
        noise=Noise(1.0, 1.0, 1.0),
        prior=FrictionPrior(1.0),
        joint=robot.velocity_index,
        mass_matrix=mass_matrix,
        imu_jacobian=np.zeros((2, 6, v)),
        sole_jacobian=nothing,
        basis=np.ones((2, 12, 1)),
        slope=np.tile(viscous, (2, 1)),
        wrench_noise=nothing,
        foot_motion=np.zeros((2, 0, 6)),
    )
    change = start * rng.normal(size=v)
    found = after(change) - after(np.zeros(v))
    np.testing.assert_allclose(model.step(1).transition[:v, :v] @ change, found, atol=1e-4 * start)
    # It is not as if there were no friction.
    frictionless = dataclasses.replace(model, slope=np.zeros((2, 12)))
    assert np.abs(frictionless.step(1).transition[:v, :v] @ change - found).max() > 0.1 * start


def test_foot_moves_as_feet_do_under_such_a_load() -> None:
    motion = np.zeros((4, 1, 6))
    motion[:, 0, 0] = [3.0, 1.0, 7.0, 100.0]
    found = foot_motion(motion, np.array([[0.6], [0.15], [0.9], [0.01]]))
    assert found[[0, 2], 0, 0].tolist() == pytest.approx([math.sqrt(29.0)] * 2)
    assert found[1, 0, 0] == 1.0
    assert np.isinf(found[3]).all()


def test_nobody_is_below_the_limit_and_finer_sensors_lower_it(run) -> None:
    scenario = load_scenario("paper_walk_fbse", overrides=["duration=0.3"])
    log = run("paper_walk_fbse", "duration=0.3")
    rows = [row for row in rows_of(scenario, log) if row.phase == "stance"]
    assert len(rows) == 12
    for row in rows:
        assert 0 < row.smoother <= row.limit <= row.limit_with_walk, row.joint
        # What is bounded is an expected value, and one walk may be luckier in a joint.
        assert row.ratio > 0.5, row.joint
    assert np.mean([row.ratio for row in rows]) > 1
    model = walk_model(scenario, log, priors(scenario)["law"])
    until_now = model.filtered_variance()
    finer = model.noise._replace(joint_velocity=0.5 * model.noise.joint_velocity)
    lower = dataclasses.replace(model, noise=finer).filtered_variance()
    assert np.all(lower[1:] <= until_now[1:] * (1 + 1e-9))
    assert lower[-1].mean() < 0.9 * until_now[-1].mean()


def test_headline_is_of_the_hip_yaws_in_swing() -> None:
    """Mean squares 1.0 and 3.0 over limits of 0.01 and 0.03: ten times the limit."""
    yaws = [
        Row(f"{side}_hip_yaw", "swing", 4.0, limit, limit, 4 * limit, ours)
        for side, limit, ours in (("left", 0.01, 1.0), ("right", 0.03, 3.0))
    ]
    others = [dataclasses.replace(yaws[0], phase="stance", ours=1e3)]
    others += [dataclasses.replace(yaws[0], joint="left_knee_pitch", ours=1e3)]
    text = headline([*yaws, *others])
    assert text.startswith("Hip yaw in swing: NRMSE 0.707, 10.0 times the limit of 0.071")
    assert "(5.0 times that with walk, 0.141)" in text
    assert headline(others) == ""


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("sensors.encoders.velocity_noise=0", r"sensors\.encoders\.velocity_noise"),
        ("sensors.encoders.velocity=differenced", r"sensors\.encoders\.velocity: expected exact"),
        ("sensors.imu.acceleration_noise=0", r"sensors\.imu\.acceleration_noise"),
        ("sensors.imu.period=0.002", r"sensors\.imu\.period"),
        ("log.period=0.002", r"log\.period"),
        ("estimator=!NoEstimator {}", "estimator: the scenario has none"),
    ],
)
def test_what_has_no_known_limit_is_named(override: str, named: str) -> None:
    with pytest.raises(InputError, match=named):
        require_known(load_scenario("paper_walk_fbse", overrides=[override]))
