"""In what steps the motion of a log was integrated: where between two samples the equation of
motion holds, with the torque held from one to the other.

A real robot moves on while a command is held: what the torque is to be compared with is the motion
amid the samples. Simulators mostly take steps of semi-implicit Euler, one or several a sample, each
of which has its forces from the posture where it began. Positions and velocities tell which it is.
"""

import numpy as np

# Span of the second differences that positions and velocities are compared by [s], and in samples.
_SPAN, _FEWEST_SAMPLES = 0.1, 3
# The deviation of what a joint tells is found from so many parts of the log.
_PARTS = 8
# A joint is heard if its motion has this many times the power of its velocity's noise, and the
# standard deviation of what it tells is below this share of the period.
_POWER, _DEVIATION = 100.0, 0.1
# No step is longer than the period; what is found may be, by this share of it.
_TOLERANCE = 0.2


def integration_step(
    position: np.ndarray, velocity: np.ndarray, period: float, known: np.ndarray
) -> float:
    """Time step s of the semi-implicit Euler integration that a log's motion came from [s].

    Such steps leave q[k+1] - q[k] = T (v[k] + v[k+1]) / 2 + s (v[k+1] - v[k]) / 2 between samples
    that are T apart, continuous motion leaves s = 0. An offset of a velocity or of a position
    changes nothing. A velocity that comes late by d seems to have s = 2 d: only up to the period
    can this be a step, and it is taken for one.

    Args:
        position, velocity: of the joints, (N, n) each [rad or m, and per second].
        period: T [s].
        known: which samples are measured, (N,).

    Returns:
        The median over the joints that tell it, in [0, period]; 0 if none does, or if what is told
        can be no step.
    """
    span = max(_FEWEST_SAMPLES, round(_SPAN / period))
    whole = known[2 * span :] & known[span:-span] & known[: -2 * span]
    gaps = np.concatenate([[0], np.cumsum(~known)])
    whole &= gaps[2 * span + 1 :] == gaps[: -2 * span - 1]
    if whole.sum() < _PARTS:
        return 0.0

    def curved(values: np.ndarray) -> np.ndarray:
        return (values[2 * span :] - 2 * values[span:-span] + values[: -2 * span])[whole]

    travelled = np.zeros_like(position)
    travelled[1:] = np.cumsum(0.5 * period * (velocity[1:] + velocity[:-1]), axis=0)
    x, y = curved(velocity), curved(position - travelled)
    power = (x**2).sum(axis=0)
    # Second differences have 6 times the variance of white noise, fourth ones 70 times.
    noise = 6.0 / 70.0 * (np.diff(velocity, 4, axis=0) ** 2).mean(axis=0)
    moving = power > _POWER * noise * len(x)
    if not moving.any():
        return 0.0
    x, y, power = x[:, moving], y[:, moving], power[moving]
    slope = (x * y).sum(axis=0) / power
    scores = [part.sum(axis=0) for part in np.array_split(x * (y - slope * x), _PARTS)]
    deviation = np.sqrt((np.array(scores) ** 2).sum(axis=0)) / power
    told = 2 * slope[2 * deviation < _DEVIATION * period]
    step = float(np.median(told)) if len(told) else 0.0
    if not -_TOLERANCE * period <= step <= (1 + _TOLERANCE) * period:
        return 0.0
    return min(max(step, 0.0), period)
