"""Do the feet carry what the robot weighs? Which of them reads its forces by a share too small.

Along gravity, feet push with what the robot's mass and acceleration ask for. As its load moves from
foot to foot, the sum shows feet whose gains differ, whatever the mass is. What all feet have in
common it does not tell from a wrong mass.
"""

import math

import numpy as np
from numba import njit

from fbse_drake.estimators.implicit_friction import inverse_of
from fbse_drake.estimators.records import Record, record_type
from fbse_drake.estimators.whole_body_updates import NOTICED

# How wrong the mass of a model is that was weighed, and of one that was not: standard deviations
# [1]; how likely it is that it was not; and that feet read wrong.
_MASS, _UNKNOWN_MASS, _NOT_WEIGHED, _WRONG = 0.005, 0.05, 0.1, 0.01
# The least that the balance errs, as a share of the weight [1], for how long it errs the same way
# [s], how long it takes to learn that it errs more, and to forget [s].
_LEAST_ERROR, _ERROR_TIME, _LEARNING_TIME, _MEMORY = 0.002, 0.05, 0.3, 4.0
# In flight there is nothing to weigh: less than this share of the weight.
_LEAST_WEIGHT = 0.5


def force_balance_type(feet: int) -> np.dtype:
    """What is known of the balance of forces.

    `information` (feet + 1, feet + 1) and the `right` side (feet + 1,) of the normal equations for
    by what share each foot's forces are larger than read, and the mass than the model's; what they
    likely are, `gains` (feet,) and `mass` (); what these leave of the balance, as a share of the
    weight: `left` (), a mean of late, and its mean square, `error` ().
    """
    k = feet + 1
    numbers = dict.fromkeys(("mass", "left", "error"), ())
    return record_type(information=(k, k), right=(k,), gains=(feet,), **numbers)


@njit(cache=True)
def watch_balance(
    balance: Record, load: np.ndarray, weight: float, elapsed: float, uncertainty: float
) -> None:
    """Learns from a tick.

    Args:
        balance: record of `force_balance_type`, of the tick before.
        load: what each foot pushes along gravity, as it is read, (feet,), and `weight`, what the
            model's mass asks for, accelerations included, as shares of the robot's weight [1].
        elapsed: of the tick [s].
        uncertainty: how wrong the gain of a foot may be, standard deviation [1].
    """
    feet, row = len(load), np.empty(len(load) + 1)
    # Were it the weight, what the balance lacks would be among its own regressors: a mass and gains
    # that all agree cannot be told apart.
    row[:feet], row[feet] = load, -load.sum()
    lacks = weight + row[feet]
    left = lacks - load @ balance.gains - row[feet] * balance.mass
    if weight < _LEAST_WEIGHT or abs(left) > NOTICED * uncertainty:
        # It flies, or a sensor fails.
        return
    of_mean = 1.0 - math.exp(-elapsed / _ERROR_TIME)
    of_square = 1.0 - math.exp(-elapsed / _LEARNING_TIME)
    balance.left += of_mean * (left - balance.left)
    balance.error += of_square * (balance.left**2 - balance.error)
    # That of white noise of which this is an exponential mean.
    noise = max(balance.error, _LEAST_ERROR**2) * (2.0 - of_mean) / of_mean
    keep = math.exp(-elapsed / _MEMORY)
    for i in range(feet + 1):
        balance.right[i] = keep * balance.right[i] + row[i] * lacks / noise
        for j in range(feet + 1):
            told = row[i] * row[j] / noise
            balance.information[i, j] = keep * balance.information[i, j] + told
    _weigh_hypotheses(balance, uncertainty)


@njit(cache=True)
def _weigh_hypotheses(balance: Record, uncertainty: float) -> None:
    """Fills gains and mass: means over the hypotheses that no foot's gain is wrong, one's, or all,
    and that the mass was weighed, or not, by how likely each is (Bayesian model averaging).

    Their likelihoods are those of a linear model with normal priors.
    """
    feet, A, b = len(balance.gains), balance.information, balance.right
    gains, mass = np.zeros((2, feet + 2, feet)), np.empty((2, feet + 2))
    log_likelihood = np.empty((2, feet + 2))
    for not_weighed in range(2):
        deviation = _UNKNOWN_MASS if not_weighed else _MASS
        prior = _NOT_WEIGHED if not_weighed else 1.0 - _NOT_WEIGHED
        # The mass is eliminated first.
        of_mass = A[feet, feet] + deviation**-2
        eliminated = A[:feet, feet] / of_mass
        information = A[:feet, :feet] - np.outer(eliminated, A[feet, :feet])
        right = b[:feet] - eliminated * b[feet]
        log_likelihood[not_weighed] = math.log(prior) + 0.5 * (
            b[feet] ** 2 / of_mass - math.log(of_mass * deviation**2)
        )
        log_likelihood[not_weighed, 0] += math.log(1.0 - _WRONG)
        log_likelihood[not_weighed, 1:] += math.log(_WRONG / (feet + 1))
        for foot in range(feet):
            variance = 1.0 / (information[foot, foot] + uncertainty**-2)
            gains[not_weighed, 1 + foot, foot] = variance * right[foot]
            log_likelihood[not_weighed, 1 + foot] += 0.5 * (
                variance * right[foot] ** 2 + math.log(variance / uncertainty**2)
            )
        P = inverse_of(information + np.eye(feet) * uncertainty**-2)
        gains[not_weighed, feet + 1] = P @ right
        log_likelihood[not_weighed, feet + 1] += 0.5 * (
            right @ P @ right + math.log(np.linalg.det(P / uncertainty**2))
        )
        mass[not_weighed] = b[feet] / of_mass - gains[not_weighed] @ eliminated
    share = np.exp(log_likelihood - log_likelihood.max())
    share /= share.sum()
    balance.mass = (share * mass).sum()
    for foot in range(feet):
        balance.gains[foot] = (share * gains[:, :, foot]).sum()
