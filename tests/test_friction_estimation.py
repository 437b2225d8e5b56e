"""From measured friction to its estimate, against textbook filters and the truth of simulated
motions."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from rig import CLOCK, TICK, Base, Rig, estimated, pack, part, rms

from fbse_drake import Log, load_scenario
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.estimators.attitude import AttitudeConfig, AttitudeEstimator
from fbse_drake.estimators.beliefs import USUAL_SENSORS
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.floating_base import ImuMount
from fbse_drake.estimators.friction_regressor import FrictionRegressor
from fbse_drake.estimators.joint_acceleration import (
    JointAccelerationConfig,
    JointAccelerationEstimator,
)
from fbse_drake.estimators.link_torque import LinkTorqueEstimator
from fbse_drake.estimators.model_aided import ModelAided, smooth_velocity, smoothing_time
from fbse_drake.estimators.recursive_least_squares import (
    RecursiveLeastSquares,
    recursive_least_squares,
)

GRAVITY = 9.81
BASE = Base.of()
READINGS, MODEL = BASE.monitor.posterior_type, BASE.model.posterior_type
ACCELERATION = JointAccelerationEstimator(
    JointAccelerationConfig(),
    USUAL_SENSORS,
    BASE.robot,
    READINGS,
    AttitudeEstimator(
        AttitudeConfig(), USUAL_SENSORS, ImuMount(BASE.robot).R_BI, READINGS, MODEL, CLOCK
    ).posterior_type,
    MODEL,
    CLOCK,
)
PAPER = load_scenario("paper_walk_fbse", "paper_method").estimator
Run = Callable[..., Log]
WALK = scenario("paper_walk_fbse", "duration=3")


def regressor(velocity: np.ndarray, transition: float = 0.01) -> np.ndarray:
    """[tanh(w / transition), w], shape (n, 2)."""
    return np.stack([np.tanh(velocity / transition), velocity], axis=-1)


@pytest.mark.parametrize("forgetting", [1.0, 0.995])
def test_recursive_least_squares_of_all_parameters_at_once(forgetting: float):
    """Equations (64)-(67) with the paper's 12 parameters of a leg in one covariance, and batch
    least squares (63)."""
    generator = np.random.default_rng(2)
    truth, ticks = generator.uniform(0.5, 5, size=12), 300
    theta, P = np.zeros(12), 10 * np.eye(12)
    parameters, covariance = np.zeros((6, 2)), np.tile(10 * np.eye(2), (6, 1, 1))
    information, weighted = np.eye(12) / 10, np.zeros(12)
    for _ in range(ticks):
        phi = regressor(generator.normal(scale=0.1, size=6))
        Phi = np.zeros((12, 6))
        for joint in range(6):
            Phi[2 * joint : 2 * joint + 2, joint] = phi[joint]
        u = Phi.T @ truth + generator.normal(scale=0.3, size=6)
        S = forgetting * np.eye(6) + Phi.T @ P @ Phi
        K = P @ Phi @ np.linalg.inv(S)
        e = u - Phi.T @ theta
        theta, P = theta + K @ e, (P - K @ Phi.T @ P) / forgetting
        parameters, covariance, innovation, variance = recursive_least_squares(
            parameters, covariance, phi, u, forgetting
        )
        np.testing.assert_allclose(parameters.ravel(), theta, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(innovation, e, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(variance, np.diag(S), rtol=1e-8)
        information, weighted = (
            forgetting * information + Phi @ Phi.T,
            forgetting * weighted + Phi @ u,
        )
    np.testing.assert_allclose(covariance[3], P[6:8, 6:8], rtol=1e-8)
    np.testing.assert_allclose(theta, np.linalg.solve(information, weighted), rtol=1e-6)
    assert np.abs(theta - truth).max() < 1.5


class Friction(Rig):
    """A friction estimator under made-up velocities and residuals."""

    def __init__(self, config: RecursiveLeastSquares | ModelAided):
        types = READINGS, MODEL, ACCELERATION.posterior_type
        self._link = LinkTorqueEstimator(USUAL_SENSORS, BASE.robot, *types, CLOCK)
        inputs = {"measurements": READINGS, "link_torque": self._link.posterior_type}
        super().__init__(config.system(USUAL_SENSORS, BASE.robot, **inputs, clock=CLOCK))

    def see(
        self,
        velocity: np.ndarray,
        residual: np.ndarray,
        torque: float = 0.01,
        impulse: float = 1e-8,
        valid: float = 1,
        support: tuple[float, float] = (1, 1),
        inertia: float = 0.0,
        late: int = 0,
    ):
        noise = {
            "torque_variance": np.full(12, torque),
            "impulse_variance": np.full(12, impulse),
            "own_inertia": np.full(12, inertia),
            "valid": np.full(12, valid),
        }
        link = pack(self._link, residual=residual, late=late, duration=TICK, **noise)
        return self.tick(
            measurements=BASE.measurements(joint_velocity=velocity, support=support),
            link_torque=link,
        )


def test_recursive_least_squares_takes_the_measurement_in_stance_and_the_model_in_swing():
    generator = np.random.default_rng(3)
    estimator = Friction(
        RecursiveLeastSquares(model=CoulombViscousFriction(transition={"all": 1e-6}))
    )
    truth = generator.uniform(1, 5, size=(12, 2))
    for _ in range(400):
        velocity = generator.normal(scale=0.3, size=12)
        phi = np.stack([np.sign(velocity), velocity], axis=1)
        residual = (phi * truth).sum(axis=1) + generator.normal(scale=0.05, size=12)
        posterior = estimator.see(velocity, residual)
        np.testing.assert_allclose(posterior["friction"], residual, atol=1e-12)
    parameters = posterior["parameters"]
    np.testing.assert_allclose(parameters, truth, atol=0.08)
    # Now the right leg swings, and what is measured there is nonsense.
    posterior = estimator.see(velocity, np.full(12, 77.0), support=(1, 0))
    np.testing.assert_allclose(posterior["friction"][:6], 77.0)
    np.testing.assert_allclose(
        posterior["friction"][6:], (phi * parameters).sum(axis=1)[6:], rtol=1e-9
    )
    np.testing.assert_array_equal(posterior["parameters"][6:], parameters[6:])


def test_model_aided_filter_is_the_textbook_kalman_filter():
    """State [impulse s, parameters, disturbance, noise e of the velocity], which is new in each
    tick.

    s' = s + T (friction at the true velocity, the measured one less e), linearised; measured is
    s - inertia e with white noise. The measured impulse is the sum of T times the residuals; what
    the estimator keeps of it is its difference from s.
    """
    generator, T = np.random.default_rng(4), TICK
    config = ModelAided(velocity_smoothing=0.0, parameter_walk=0.05, factors=[])
    torque, impulse, inertia = 0.02, 3e-7, 0.8
    of_velocity = USUAL_SENSORS.joint_velocity_noise**2
    estimator = Friction(config)
    estimator.see(np.zeros(12), np.zeros(12), torque, impulse, inertia=inertia)
    P = np.tile(
        np.diag([0, *[config.parameter_uncertainty**2] * 2, config.disturbance_uncertainty**2, 0]),
        (12, 1, 1),
    )
    X, y, H = np.zeros((12, 5)), np.zeros(12), np.array([1.0, 0, 0, 0, -inertia])
    walk = [config.parameter_walk**2 * T] * 2
    Q = np.diag([T**2 * torque, *walk, config.disturbance_walk**2 * T, of_velocity])
    rising = 0
    for _ in range(300):
        # Less noise than believed, or it would learn more.
        velocity = generator.normal(scale=0.02, size=12)
        residual = 0.2 * velocity + generator.normal(scale=0.05, size=12)
        y += T * residual
        phi = regressor(velocity)
        rise = np.stack([(1 - phi[:, 0] ** 2) / 0.01, np.ones(12)], axis=1)
        posterior = estimator.see(velocity, residual, torque, impulse, inertia=inertia)
        for j in range(12):
            slope = max(0.0, X[j, 1:3] @ rise[j])
            rising += slope > 1.0
            X[j, 4] = 0.0
            P[j, 4] = P[j, :, 4] = 0.0
            F, through = np.eye(5), np.eye(5)
            F[0, 1:4] = T * phi[j, 0], T * phi[j, 1], T
            through[0, 4] = -T * slope
            X[j], P[j] = F @ X[j], through @ (F @ P[j] @ F.T + Q) @ through.T
            S = H @ P[j] @ H + impulse - inertia**2 * of_velocity
            K, e = P[j] @ H / S, y[j] - X[j, 0]
            X[j], P[j] = X[j] + K * e, P[j] - np.outer(K, H @ P[j])
            friction = phi[j] @ X[j, 1:3] + X[j, 3] - slope * X[j, 4]
            assert posterior["innovation"][j] == pytest.approx(e, rel=1e-6, abs=1e-9)
            assert posterior["innovation_variance"][j] == pytest.approx(S, rel=1e-6)
            assert posterior["friction"][j] == pytest.approx(friction, rel=1e-6, abs=1e-8)
        np.testing.assert_allclose(posterior["parameters"], X[:, 1:3], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(posterior["disturbance"], X[:, 3], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(posterior["impulse"], y - X[:, 0], rtol=1e-6, atol=1e-10)
        left = velocity - posterior["joint_velocity"]
        np.testing.assert_allclose(left, X[:, 4], rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(posterior["covariance"], P[:, :4, :4], rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(posterior["parameter_variance"], P[:, [1, 2], [1, 2]], rtol=1e-6)
    assert rising > 200


def test_friction_tells_how_fast_a_light_joint_turns():
    """A law that is known makes the velocity better known than it is measured, if it is steep.

    So the friction of a joint that creeps is known better than from the measured velocity.
    """
    generator, T, steepness = np.random.default_rng(8), TICK, 60.0
    sigma, inertia = USUAL_SENSORS.joint_velocity_noise, 0.02
    model = CoulombViscousFriction(viscous={"all": steepness})
    fixed = ModelAided(
        model=model,
        velocity_smoothing=0.0,
        factors=[],
        parameter_uncertainty=0.0,
        disturbance_uncertainty=0.0,
        disturbance_walk=0.0,
    )
    estimator, noise, squares = Friction(fixed), np.zeros(12), np.zeros(3)
    estimator.see(np.zeros(12), np.zeros(12))
    for k in range(400):
        velocity = 0.02 * np.sin(2 * np.pi * 3 * k * T + np.arange(12))
        before, noise = noise, sigma * generator.standard_normal(12)
        residual = steepness * velocity - inertia * (noise - before) / T
        known = {"torque": 1e-8, "impulse": (inertia * sigma) ** 2, "inertia": inertia}
        posterior = estimator.see(velocity + noise, residual, **known)
        if k > 50:
            squares[0] += np.mean((posterior["friction"] - steepness * velocity) ** 2)
            squares[1] += np.mean(posterior["friction_std"] ** 2)
            squares[2] += np.mean((steepness * noise) ** 2)
    # It allows for friction that no law explains.
    assert squares[0] < squares[1] < 0.1 * squares[2]


def believed_world(believed: float) -> tuple[float, float, float]:
    """Mean normalized innovation squared of the model-aided filter in its first 0.1 s and after 0.5
    s, and the friction's rms error over that of the residual.

    Args:
        believed: the filter's noise over the true one.
    """
    generator, T, ticks = np.random.default_rng(5), TICK, 1500
    config = ModelAided(velocity_smoothing=0.0, factors=[])
    estimator = Friction(config)
    sigma_torque, sigma_impulse = 0.2, 1e-3
    parameters = generator.normal(scale=config.parameter_uncertainty, size=(12, 2))
    d = generator.normal(scale=config.disturbance_uncertainty, size=12)
    time = np.arange(ticks) * T
    velocity = 0.2 * np.sin(2 * np.pi * np.outer(time, np.linspace(1, 3, 12)))
    noise, nis, error, raw = np.zeros(12), [], [], []
    estimator.see(velocity[0], np.zeros(12))
    for k in range(1, ticks):
        friction = (regressor(velocity[k]) * parameters).sum(axis=1) + d
        previous, noise = noise, generator.normal(scale=sigma_impulse, size=12)
        residual = friction + generator.normal(scale=sigma_torque, size=12) + (noise - previous) / T
        posterior = estimator.see(
            velocity[k], residual, (believed * sigma_torque) ** 2, (believed * sigma_impulse) ** 2
        )
        nis.append(posterior["innovation"] ** 2 / posterior["innovation_variance"])
        error.append(posterior["friction"] - friction)
        raw.append(residual - friction)
        d = d + generator.normal(scale=config.disturbance_walk * math.sqrt(T), size=12)
    np.testing.assert_allclose(posterior["parameters"], parameters, atol=1.0)
    return float(np.mean(nis[:100])), float(np.mean(nis[500:])), rms(error[500:]) / rms(raw[500:])


def test_model_aided_filter_is_consistent():
    first, nis, ratio = believed_world(1.0)
    # 12000 values of chi-square with one degree of freedom, 4 sigma; and a little less, for what
    # looks like more noise is learned and what looks like less is not.
    assert 0.9 < nis < 1 + 4 * math.sqrt(2 / 12000)
    assert ratio < 0.2
    # It believes in a third of the noise at first, and learns.
    first, nis, ratio = believed_world(1 / 3)
    assert first > 2
    assert nis == pytest.approx(1, abs=0.15)
    assert ratio < 0.2


def test_model_aided_filter_leaves_an_unmeasured_joint_to_its_model():
    generator = np.random.default_rng(6)
    estimator = Friction(
        ModelAided(velocity_smoothing=0.0, disturbance_uncertainty=0.0, disturbance_walk=0.0)
    )
    truth = np.array([3.0, 2.0])
    for _ in range(1000):
        velocity = generator.normal(scale=0.1, size=12)
        estimator.see(velocity, regressor(velocity) @ truth)
    for _ in range(50):
        velocity = generator.normal(scale=0.1, size=12)
        posterior = estimator.see(velocity, np.full(12, 77.0), valid=0)
        np.testing.assert_allclose(posterior["friction"], regressor(velocity) @ truth, atol=0.05)


def friction_error(log: Log, result: Log) -> np.ndarray:
    """Root mean square error of the friction estimate by joint [Nm], without the first 0.3 s."""
    error = result["estimate/joint/friction_torque"][1:] - log["truth/joint/friction_torque"][:-1]
    return np.sqrt(np.mean(error[300:] ** 2, axis=0))


def test_friction_of_a_walk_is_estimated(run: Run):
    """Measured, mean over the joints: 12 % of the friction by the best variant, 36 % by the
    disturbance observer, 93 % by the paper's."""
    log = run("paper_walk_fbse", "duration=3")
    truth = np.sqrt(np.mean(log["truth/joint/friction_torque"][300:] ** 2, axis=0))
    best = friction_error(log, log)
    assert np.all(best < 0.12 * truth + 0.06)
    for config in (DisturbanceObserver(), PAPER):
        other = friction_error(log, estimated(log, WALK, config))
        assert other.mean() > 2 * best.mean()


def test_no_friction_no_estimate(run: Run):
    """The negative case: the robot has no friction.

    Measured, the worst of five seeds: 0.07 Nm, 0.43 Nm by the observer; means of 0.04 Nm, 0.03 Nm.
    """
    log = run("paper_walk", "duration=2", "robot.effects=null")
    assert np.all(log["truth/joint/friction_torque"] == 0)
    for config, largest in ((Fbse(), 0.12), (DisturbanceObserver(), 0.8)):
        result = estimated(log, WALK, config)
        assert friction_error(log, result).max() < largest
        # No bias either.
        assert np.abs(result["estimate/joint/friction_torque"][300:].mean(axis=0)).max() < 0.06


def test_nothing_is_identified_while_nothing_moves(run: Run):
    log = run("squat", "duration=2", "reference.amplitude=0")
    squat = scenario("squat", "duration=2", "reference.amplitude=0")
    for config, largest in ((Fbse(), ModelAided().parameter_uncertainty), (PAPER, 5.0)):
        result = estimated(log, squat, config)
        parameters = result["estimate/friction/parameters"]
        # They settle within what they may be, or near zero.
        assert np.abs(parameters[1000:]).max() < largest
        assert np.all(result["estimate/friction/parameter_variance"][1:] > 0)
        variance = result["estimate/friction/parameter_variance"]
        assert np.all(variance[-1] <= variance[1])
        if config != PAPER:
            assert friction_error(log, result).max() < 0.1
    # The negative case: an estimator that forgets is less and less sure of what does not show.
    winding_up = dataclasses.replace(PAPER, friction=RecursiveLeastSquares(forgetting=0.99))
    variance = estimated(part(log, 1.0), squat, winding_up)["estimate/friction/parameter_variance"]
    assert np.all(variance[-1, :, 1] > 10 * variance[1, :, 1])


@pytest.mark.parametrize("transition", [1e-5, 1e-3, 0.002, 0.01, 0.1, 1.0])
def test_sharp_and_blunt_signs_are_mixed_alike(transition: float):
    """The sign changes its shape with the transition velocity, viscous friction does not."""
    model = CoulombViscousFriction(transition={"all": transition})
    mixture = FrictionRegressor.of(model, BASE.robot, (0.2, 5.0))
    assert mixture.shaped.tolist() == [0]
    assert mixture.weights == 4
    assert len(FrictionRegressor.of(model, BASE.robot).shaped) == 0


@pytest.mark.parametrize("noise", [0.05, 0.2])
def test_smoothing_lags_as_much_as_it_lets_noise_through(noise: float):
    """At a steady acceleration of 3 rad/s^2, of 2000 joints over 0.2 s."""
    period, joints, ticks = 1e-3, 2000, 200
    generator, time = np.random.default_rng(3), smoothing_time(noise, period)
    kind = np.dtype([("velocity", float, joints), ("joint_velocity", float, joints)])
    reading = np.dtype([("joint_velocity", float, joints)])
    last, now, measured = np.zeros((), kind), np.zeros((), kind), np.zeros((), reading)
    for tick in range(1, ticks + 1):
        true = 3.0 * period * tick
        measured["joint_velocity"] = true + noise * generator.normal(size=joints)
        smooth_velocity(now, last, measured, period, 0.5, time)
        last[...] = now
        last["joint_velocity"] = measured["joint_velocity"]
    error = now["velocity"] - true
    assert -error.mean() == pytest.approx(3.0 * time, rel=0.2)
    assert error.std() == pytest.approx(3.0 * time, rel=0.2)
