import numpy as np
import pytest
from scipy.interpolate import PPoly

from fbse_drake.walking.lipm import solve_lipm

HEIGHT, GRAVITY = 0.66, 9.81


def random_zmp(seed: int) -> PPoly:
    """Quartic pieces that meet, in two axes."""
    generator = np.random.default_rng(seed)
    breaks = np.cumsum(np.concatenate([[0.0], generator.uniform(0.3, 1.2, size=6)]))
    c = generator.normal(scale=0.1, size=(5, 6, 2))
    for piece in range(5):
        c[-1, piece + 1] = (
            np.polyval(c[:, piece, 0], breaks[piece + 1] - breaks[piece]),
            np.polyval(c[:, piece, 1], breaks[piece + 1] - breaks[piece]),
        )
    return PPoly(c, breaks)


@pytest.mark.parametrize("seed", range(3))
def test_trajectory_satisfies_the_lipm(seed: int):
    zmp = random_zmp(seed)
    com = solve_lipm(zmp, HEIGHT, GRAVITY)
    t = np.linspace(0, zmp.x[-1], 5001)
    np.testing.assert_allclose(com(t, 2), GRAVITY / HEIGHT * (com(t) - zmp(t)), atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_belong_together_and_pieces_meet(seed: int):
    com = solve_lipm(random_zmp(seed), HEIGHT, GRAVITY)
    t, h = np.linspace(0.01, com.particular.x[-1] - 0.01, 2003), 1e-5
    for order in (0, 1):
        slope = (com(t + h, order) - com(t - h, order)) / (2 * h)
        np.testing.assert_allclose(slope, com(t, order + 1), atol=1e-4 if order else 1e-8)


def test_com_starts_and_ends_on_the_zmp():
    zmp = random_zmp(0)
    com = solve_lipm(zmp, HEIGHT, GRAVITY)
    ends = zmp.x[[0, -1]]
    np.testing.assert_allclose(com(ends), zmp(ends), atol=1e-12)


def test_constant_zmp_is_the_com():
    zmp = PPoly(np.full((1, 1, 2), 0.3), [0.0, 2.0])
    com = solve_lipm(zmp, HEIGHT, GRAVITY)
    np.testing.assert_allclose(com(np.linspace(0, 2, 11)), 0.3, atol=1e-15)
