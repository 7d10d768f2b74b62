"""Every purpose has seeds of its own, and a search takes no other's."""

import itertools

import pytest

from scb import seeds
from scb.errors import UserError
from scb.evolution import EvolutionConfig

PURPOSES = (seeds.SEARCHING, seeds.REPORTING, seeds.VALIDATING, seeds.ILLUSTRATING)


def test_no_seed_has_two_purposes():
    assert not any(set(a) & set(b) for a, b in itertools.combinations(PURPOSES, 2))


@pytest.mark.parametrize("seed", [-1, 10_000, 30_000, 40_000, 2**32])
def test_a_search_refuses_a_seed_that_judges(seed):
    with pytest.raises(UserError, match=f"seed is {seed}: it must be 0 or larger, and below 10000"):
        EvolutionConfig(seed=seed)
    assert EvolutionConfig(seed=9_999).seed == seeds.searching(9_999) == 9_999


def test_seeds_are_handed_out_from_their_range():
    assert seeds.validation(2) == [30_000, 30_001]
    assert seeds.reporting(2) == [10_000, 10_001]
    assert seeds.reporting(1, offset=19_999) == [29_999]


@pytest.mark.parametrize(("number", "offset"), [(0, 0), (-1, 0), (2, 19_999), (1, -1)])
def test_what_lies_outside_of_the_range_is_refused(number, offset):
    with pytest.raises(UserError, match="reporting seeds"):
        seeds.reporting(number, offset)
