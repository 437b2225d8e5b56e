"""The reflected inertia that a model lacks in its joints: rotors behind gears are often left out.

It is the last weight of a joint, after those of its friction law. As a regressor of the torque it
has the joint's acceleration.
"""

import numpy as np
from numba import njit

from fbse_drake.estimators.records import Record
from fbse_drake.estimators.whole_body_updates import GATE, NOTICED, confirmed

# So much of an acceleration has to be read. (More would choose by the reading's noise.)
_READ = 0.5


@njit(cache=True)
def put_acceleration(x: Record, tick: Record, known: Record) -> None:
    """Fills the regressor: the acceleration of a joint, or 0 where that is no more than noise.

    Noise of a velocity is in its innovation as well, and would be learned as inertia.

    Args:
        x: record with the `velocity` (r,) where a tick begins.
        tick: record with that of the joints where it ends, (n,), and its `duration` [s].
        known: record with the `variance` (r,) of the readings.
    """
    for joint in range(len(tick.velocity)):
        row = 3 + joint
        change = tick.velocity[joint] - x.velocity[row]
        factor = x.noise[row]
        # Without a rotor, a light link is foreseen to move so much that its readings seem noise.
        if factor > GATE**2 * x.bend_noise[row]:
            factor = x.bend_noise[row]
        accelerates = change**2 > NOTICED**2 * 2.0 * factor * known.variance[row]
        x.regressor[joint, -1] = change / tick.duration if accelerates else 0.0


@njit(cache=True)
def is_read(x: Record, last: Record, joint: int, T: float) -> bool:
    """Does a joint's reading follow the acceleration that is its regressor?

    The velocity that is foreseen has the noise of the forces, which would be learned as inertia.

    Args:
        x: record with the regressor and the `reading` (r,) where a tick ends; last: with that
            before.
        T: duration of the tick [s].
    """
    change = T * x.regressor[joint, -1]
    read = confirmed(change, x.reading[3 + joint] - last.reading[3 + joint])
    return read >= _READ * abs(change)


@njit(cache=True)
def full_inertia(x: Record, inertia: np.ndarray) -> np.ndarray:
    """A model's inertia (r, r) with what it lacks."""
    result = inertia.copy()
    for joint in range(len(x.weights)):
        result[3 + joint, 3 + joint] += x.weights[joint, -1]
    return result


@njit(cache=True)
def make_inertia_possible(x: Record, known: Record) -> None:
    """Projects on what can be: no robot's rotor has a negative inertia.

    Beyond its doubt, a law that was learned beside it is wrong as well, and moves with it along the
    covariance. (Within it, only one side of what is noise would move the law, tick by tick.)

    Args:
        known: record with the model's own `rotor_inertia` (n,) [kg m^2].
    """
    P, (n, m) = x.covariance, x.weights.shape
    for joint in range(n):
        beyond = x.weights[joint, -1] + known.rotor_inertia[joint]
        if beyond < 0.0:
            first = len(P) + m * (joint - n)
            last = first + m - 1
            if beyond**2 > P[last, last]:
                for k in range(m - 1):
                    x.weights[joint, k] -= P[first + k, last] * beyond / P[last, last]
            x.weights[joint, -1] = -known.rotor_inertia[joint]
