import numpy as np
import pytest

from fbse_drake.effects.friction import CoulombViscousFriction, StribeckFriction
from fbse_drake.errors import InputError
from fbse_drake.estimators.identification import batch_least_squares, identify


def swing(samples: int = 4000) -> np.ndarray:
    """Velocities of a joint that goes to and fro, slowly and fast [rad/s]."""
    time = np.linspace(0, 20, samples)
    return 0.3 * np.sin(1.7 * time) * np.sin(0.4 * time)


def test_batch_least_squares_solves_the_normal_equations():
    rng = np.random.default_rng(0)
    phi, torque = rng.normal(size=(500, 3)), rng.normal(size=500)
    parameters, deviation = batch_least_squares(phi, torque)
    # Paper eq. (63), as it stands.
    np.testing.assert_allclose(parameters, np.linalg.inv(phi.T @ phi) @ (phi.T @ torque), rtol=1e-9)
    residual = torque - phi @ parameters
    expected = np.sqrt(np.diag(np.linalg.inv(phi.T @ phi)) * (residual @ residual) / 497)
    np.testing.assert_allclose(deviation, expected, rtol=1e-9)


def test_deviations_cover_the_error():
    velocity, phi = swing(), np.stack([np.tanh(swing() / 0.01), swing()], axis=1)
    rng, score = np.random.default_rng(1), []
    for _ in range(200):
        torque = phi @ [0.6, 0.9] + 0.2 * rng.normal(size=len(velocity))
        parameters, deviation = batch_least_squares(phi, torque)
        score.append((parameters - [0.6, 0.9]) / deviation)
    np.testing.assert_allclose(np.std(score, axis=0), 1.0, atol=0.15)


def test_a_joint_that_rests_tells_nothing():
    phi = np.stack([np.zeros(100), np.zeros(100)], axis=1)
    parameters, deviation = batch_least_squares(phi, np.ones(100))
    np.testing.assert_array_equal(parameters, 0.0)
    assert np.isinf(deviation).all()


def test_identifies_the_stribeck_curve_with_its_nonlinear_parameters():
    velocity = swing()
    # Eq. (56) written out, with the values of Table I for the hip roll joint.
    true = (
        0.6 * (np.tanh(100 * velocity) - np.tanh(10 * velocity))
        + 0.5 * np.tanh(100 * velocity)
        + 0.9 * velocity
    )
    noisy = true + 0.02 * np.random.default_rng(2).normal(size=len(velocity))
    found = identify(StribeckFriction, ["joint"], velocity[:, None], noisy[:, None])
    for name, value in {"gamma1": 0.6, "gamma3": 10, "gamma4": 0.5, "gamma6": 0.9}.items():
        assert found.values[name][0] == pytest.approx(value, rel=0.1), name
    # gamma2 and gamma5 both make the step at zero; together they make the right one.
    assert found.residual_rms[0] == pytest.approx(0.02, rel=0.05)
    simpler = identify(CoulombViscousFriction, ["joint"], velocity[:, None], noisy[:, None])
    assert simpler.residual_rms[0] > 2 * found.residual_rms[0]


def test_values_stay_physical_and_become_a_scenario_entry():
    velocity = 1e-3 * swing()
    torque = -0.2 * velocity + 0.01 * np.random.default_rng(3).normal(size=len(velocity))
    found = identify(
        CoulombViscousFriction,
        ["a", "b"],
        np.stack([velocity, swing()], axis=1),
        np.stack([torque, 0.9 * swing()], axis=1),
    )
    assert found.values["coulomb"][0] >= 0
    assert found.values["viscous"][0] >= 0
    config = found.config()
    assert isinstance(config, CoulombViscousFriction)
    assert config.viscous["b"] == pytest.approx(0.9, rel=1e-6)
    assert set(config.coulomb) == {"a", "b"}


def test_refuses_what_does_not_go_together():
    with pytest.raises(InputError, match="N x 2"):
        identify(CoulombViscousFriction, ["a", "b"], np.zeros((9, 1)), np.zeros((9, 1)))
    with pytest.raises(InputError, match="more than 3 samples"):
        identify(CoulombViscousFriction, ["a"], np.zeros((3, 1)), np.zeros((3, 1)))
