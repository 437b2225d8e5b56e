"""The linear inverted pendulum (LIPM): CoM motion for a given ZMP, solved over a whole walk.

Kajita et al. 2001; paper eq. (7): c'' = g / z_c (c - p_zmp).
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PPoly


@dataclass(frozen=True)
class LipmTrajectory:
    """CoM over a piecewise polynomial ZMP: in each piece the polynomial solution plus two
    exponentials."""

    # Polynomial part, in each piece a particular solution [m].
    particular: PPoly
    # Amplitudes of exp(-omega (t - piece start)) and exp(-omega (piece end - t)), shape
    # (pieces, axes) [m].
    decaying: np.ndarray
    growing: np.ndarray
    # sqrt(g / z_c) [1/s].
    omega: float

    def __call__(self, t: np.ndarray, derivative: int = 0) -> np.ndarray:
        """CoM position [m] or its derivative at times t (N,) [s], shape (N, axes)."""
        breaks = self.particular.x
        t = np.clip(t, breaks[0], breaks[-1])
        piece = np.clip(np.searchsorted(breaks, t, side="right") - 1, 0, len(breaks) - 2)
        after, before = t - breaks[piece], breaks[piece + 1] - t
        decay = (-self.omega) ** derivative * np.exp(-self.omega * after)
        growth = self.omega**derivative * np.exp(-self.omega * before)
        return (
            self.particular(t, derivative)
            + decay[:, None] * self.decaying[piece]
            + growth[:, None] * self.growing[piece]
        )


def solve_lipm(zmp: PPoly, com_height: float, gravity: float) -> LipmTrajectory:
    """CoM trajectory that satisfies the LIPM exactly for the ZMP `zmp` and starts and ends on it.

    In each piece a particular solution of c - c''/omega^2 = p is sum_k p^(2k) / omega^(2k); the
    exponentials make position and velocity continuous across pieces. One linear system over the
    whole walk, so there is no drift.

    Args:
        zmp: ZMP over time [m], polynomial pieces with values of shape (axes,).
        com_height: z_c [m] above the ground; gravity: g [m/s^2].
    """
    omega = np.sqrt(gravity / com_height)
    particular, derivative = zmp.c.copy(), zmp
    for k in range(1, zmp.c.shape[0] // 2 + 1):
        derivative = derivative.derivative(2)
        if derivative.c.shape[0] > particular.shape[0]:
            break
        particular[particular.shape[0] - derivative.c.shape[0] :] += derivative.c / omega ** (2 * k)
    particular = PPoly(particular, zmp.x)

    pieces = len(zmp.x) - 1
    across = np.exp(-omega * np.diff(zmp.x))
    matrix, right = np.zeros((2 * pieces, 2 * pieces)), np.zeros((2 * pieces, zmp.c.shape[2]))
    # Unknowns: decaying and growing amplitude of piece i in columns 2 i and 2 i + 1.
    matrix[0, :2] = 1.0, across[0]
    right[0] = zmp(zmp.x[0]) - particular(zmp.x[0])
    for i in range(pieces - 1):
        row = 2 * i + 1
        matrix[row, 2 * i : 2 * i + 4] = across[i], 1.0, -1.0, -across[i + 1]
        matrix[row + 1, 2 * i : 2 * i + 4] = (
            -omega * across[i],
            omega,
            omega,
            -omega * across[i + 1],
        )
        length = zmp.x[i + 1] - zmp.x[i]
        for order in (0, 1):
            end = _evaluate_piece(particular, i, length, order)
            right[row + order] = _evaluate_piece(particular, i + 1, 0.0, order) - end
    matrix[-1, -2:] = across[-1], 1.0
    right[-1] = zmp(zmp.x[-1]) - particular(zmp.x[-1])
    amplitudes = np.linalg.solve(matrix, right)
    return LipmTrajectory(particular, amplitudes[0::2], amplitudes[1::2], float(omega))


def _evaluate_piece(polynomial: PPoly, piece: int, local_time: float, order: int) -> np.ndarray:
    coefficients = polynomial.c[:, piece]
    powers = np.arange(coefficients.shape[0] - 1, -1, -1)
    if order == 1:
        coefficients, powers = coefficients[:-1] * powers[:-1, None], powers[:-1] - 1
    return (coefficients * (local_time**powers)[:, None]).sum(axis=0)
