"""Every purpose has seeds of its own, and a search takes no other's."""

import ast
import itertools
import re

import pytest

from scb import seeds
from scb.errors import UserError
from scb.evolution import EvolutionConfig
from tests.scb.test_imports import MODULES, ROOT

PURPOSES = (seeds.SEARCHING, seeds.REPORTING, seeds.VALIDATING, seeds.ILLUSTRATING)


def test_no_seed_has_two_purposes():
    assert not any(set(a) & set(b) for a, b in itertools.combinations(PURPOSES, 2))


@pytest.mark.parametrize("seed", [-1, 10_000, 30_000, 40_000, 2**32])
def test_a_search_refuses_a_seed_that_judges(seed):
    with pytest.raises(UserError, match=f"seed is {seed}: it must be 0 or larger, and below 10000"):
        EvolutionConfig(seed=seed)
    with pytest.raises(UserError, match=r"seed is 1\.5: it must be a whole number"):
        EvolutionConfig(seed=1.5)
    assert EvolutionConfig(seed=9_999).seed == seeds.searching(9_999) == 9_999


def test_seeds_are_handed_out_from_their_range():
    assert seeds.validation(2) == [30_000, 30_001]
    assert seeds.reporting(2) == [10_000, 10_001]
    assert seeds.reporting(1, offset=19_999) == [29_999]


@pytest.mark.parametrize(("number", "offset"), [(0, 0), (-1, 0), (2, 19_999), (1, -1)])
def test_what_lies_outside_of_the_range_is_refused(number, offset):
    with pytest.raises(UserError, match="reporting seeds"):
        seeds.reporting(number, offset)


# What reports: `lpo run`, the zoo's tables, and the experiments. No search, and nothing that a search calls.
REPORTERS = {
    "lpo": {"lpo/full_size.py", "lpo/pipeline.py"},
    "scb": {"scb/seeds.py"},
    "experiments": {
        f"experiments/{name}.py"
        for name in (
            "brax_training",
            "component_replacement",
            "episode_lengths",
            "experts",
            "generality",
            "learning_rates",
            "linear_fits",
            "locomotion",
            "lpo_on_bandits",
            "lpo_on_bandits_page",
            "robustness",
            "sb3",
            "transfer_study",
            "zoo_table",
        )
    },
}


@pytest.mark.parametrize("package", MODULES)
def test_reporting_seeds_are_named_only_where_something_is_reported(package):
    named = set()
    for path in MODULES[package]:
        names = {n.id for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Name)}
        if names & {"REPORTING", "reporting"}:
            named.add(str(path.relative_to(ROOT)))
    assert named == REPORTERS[package]


@pytest.mark.parametrize("package", MODULES)
def test_a_seed_beyond_those_that_search_comes_from_the_registry(package):
    literal = re.compile(r"seed\w*(\"|: int)?\s*[:=]\s*[1-9]\d_?\d{3}", re.IGNORECASE)
    assert literal.search("first_seed: int = 21_000") and literal.search('"seed": 50000')
    for path in MODULES[package]:
        assert not literal.search(path.read_text()), path
