"""Which members of an explanation are named, and which are tentative, for they may stand for
something that the library does not have."""

from collections.abc import Sequence

import numpy as np

from fbse_drake.discrepancy.diagnosis.explanation import Candidate, Explanation
from fbse_drake.discrepancy.diagnosis.fits import is_smallest
from fbse_drake.discrepancy.diagnosis.parsimony import with_smaller_law
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.proposals import Proposals
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.identification.structure import Structure, tolerated
from fbse_drake.effects.actuation import TorqueReadingLag
from fbse_drake.effects.effect import Parameter

# A member that takes less than this share of what exceeds the noise in its rows without it is
# tentative: it leaves more than it takes.
_MOSTLY = 0.5


def is_named(
    proposals: Proposals,
    final: Explanation,
    member: Candidate,
    without: Explanation,
    unexplained: Sequence[Structure],
) -> bool:
    """Is a member of an explanation what it is called?

    Args:
        without: the explanation without it.
        unexplained: what is left in rows.
    """
    fits = proposals.fits
    return (
        not is_within_rows(fits.dictionary.predictor, final, member)
        and _takes_most(fits.white, without, final, member)
        and not _may_be_none(final, member)
        and _is_more_than_smaller(proposals, final, member, unexplained)
    )


def is_within_rows(predictor: Predictor, final: Explanation, member: Candidate) -> bool:
    """Does it say that torques come late by less than lies between samples of them?

    Between two samples they are not known: where a joint turns, friction holds it, and that looks
    so too.
    """
    return (
        predictor.motion.recording.is_sampled
        and member.effect in TorqueReadingLag.opposites
        and max(final.values(member)[0].values()) < predictor.motion.period
    )


def _takes_most(
    white: WhitenedResidual, without: Explanation, final: Explanation, member: Candidate
) -> bool:
    """Does a member take most of what exceeds the noise in its rows without it?

    Rows count by what it takes there; in one with no more than what the noise may be wrong by
    nothing is left.
    """
    rows = member.signature.rows[white.count[member.signature.rows] > 0]
    before, after, count = without.held_out_sse[rows], final.held_out_sse[rows], white.count[rows]
    most = np.array([tolerated(white, row) for row in rows])
    left = np.where(after > most**2 * count, after - count, 0.0)
    taken = np.maximum(before - after, 0.0)
    if not left.any():
        return True
    share = taken / np.maximum(taken + left, 1e-30)
    return bool(taken.any() and np.average(share, weights=taken) >= _MOSTLY)


def _may_be_none(final: Explanation, member: Candidate) -> bool:
    """Does the interval of a size without which there is no effect hold zero, as a gap's may, or
    the mass of a payload? So it does where less than the smallest that is sought would fit."""
    values, intervals = final.values(member)

    def may_be_zero(name: str, parameter: Parameter) -> bool:
        low, high = intervals[name]
        return low <= 0.0 <= high or is_smallest(parameter, values[name])

    return any(p.neutral == 0.0 and may_be_zero(name, p) for name, p in member.parameters.items())


def _is_more_than_smaller(
    proposals: Proposals, final: Explanation, member: Candidate, unexplained: Sequence[Structure]
) -> bool:
    """Does a law take more beyond the smaller ones that it contains than it leaves in its rows?

    Where something is left that nobody explains, a shape with more parameters takes some of it.
    """
    rows = [structure.index for structure in unexplained]
    if not np.isin(member.signature.rows, rows).any():
        return True
    smaller = with_smaller_law(proposals, final, member)
    return smaller is None or _takes_most(proposals.fits.white, smaller, final, member)
