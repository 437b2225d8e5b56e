"""Walks that the off-nominal benchmark draws."""

from collections import Counter
from collections.abc import Callable

import pytest

from benchmarks.off_nominal import run
from benchmarks.off_nominal_walks import CASES, case_of, random_name, trot_name
from fbse_drake import load_scenario

NUMBERS = range(60)
random_gaits = pytest.mark.parametrize("name", [random_name, trot_name])


@random_gaits
def test_a_random_walk_is_the_same_each_time_and_another_for_each_number(
    name: Callable[[int], str],
):
    walks = [case_of(name(number)) for number in NUMBERS]
    assert walks == [case_of(name(number)) for number in NUMBERS]
    assert len({(walk.told, walk.untold) for walk in walks}) == len(walks)
    assert case_of(CASES[0].name) == CASES[0]


@random_gaits
def test_random_walks_are_scenarios_in_which_everything_goes_wrong_sometimes(
    name: Callable[[int], str],
):
    keys = Counter()
    for number in NUMBERS:
        walk = case_of(name(number))
        assert load_scenario(walk.scenario, overrides=[*walk.told, *walk.untold])
        keys.update(text.partition("=")[0] for text in walk.untold)
    # A quarter each, as far as chance lets expect: binomial, 1e-4 to either side.
    assert len(keys) == 16
    assert all(3 <= count <= 30 for count in keys.values())
    told = {text.partition("=")[0] for n in NUMBERS for text in case_of(name(n)).told}
    assert not told & set(keys)


def test_what_has_shown_to_be_in_time_is_not_late_by_a_single_step():
    """Forces of one foot are read 4 % too large, on a slope; where that foot had left the ground
    they seemed 10 ms late for 40 ms, and friction was 10 Nm off."""
    walked = run(case_of("random 5410"), 0, 2.6, alone=True)
    (default,) = walked.figures.values()
    assert default.nrmse_stance < 0.15
    assert default.covered_stance > 0.95
