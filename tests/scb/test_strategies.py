"""What a strategy is given of a search's settings: deviations, each weight's unit, and how its steps shrink."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from scb.errors import UserError
from scb.evolution import EvolutionConfig, evolve
from scb.keys import root_key
from scb.strategies import STRATEGIES, Strategy
from tests.scb.probes import Slope

MANY = EvolutionConfig(population_size=400, sigma=0.1)


def test_every_weight_is_searched_in_its_own_unit():
    strategy = Strategy(MANY, jnp.zeros(2))
    state = strategy.start(root_key(0), jnp.zeros(2), jnp.array([1.0, 100.0]))
    population, _ = strategy.ask(root_key(1), state)
    np.testing.assert_allclose(np.std(population, axis=0), [0.1, 10.0], rtol=0.15)


@pytest.mark.parametrize("name", sorted(STRATEGIES))
@pytest.mark.parametrize("size", [4, 7])
def test_a_strategy_asks_for_as_many_as_it_is_given_or_refuses(name, size):
    try:
        strategy = Strategy(EvolutionConfig(strategy=name, population_size=size), jnp.zeros(8))
    except UserError as error:
        assert size == 7 and "population_size" in str(error)
        return
    population, _ = strategy.ask(root_key(1), strategy.start(root_key(0), jnp.zeros(8)))
    assert population.shape == (size, 8)


@pytest.mark.parametrize("sigma", [0.05, 2.0])
def test_a_population_is_spread_about_the_start_which_is_in_it(sigma):
    strategy = Strategy(replace(MANY, strategy="SimpleGA", sigma=sigma), jnp.zeros(2))
    population = strategy.start(root_key(0), jnp.zeros(2)).population
    assert np.std(population) == pytest.approx(sigma, rel=0.1)
    np.testing.assert_array_equal(population[0], 0.0)


@pytest.mark.parametrize(("limit", "low", "high"), [(0.0, 0.15, 0.21), (0.05, 0.9, 1.2)])
def test_the_learning_rate_decays_down_to_its_limit(limit, low, high):
    # Adam steps by the learning rate where the gradient keeps its sign: 0.1 + 0.05 + 0.025 + ... stays
    # below 0.2; with the limit it is 0.1 and 19 times 0.05.
    config = EvolutionConfig(
        strategy="Open_ES",
        population_size=64,
        num_generations=20,
        sigma=0.1,
        learning_rate=0.1,
        learning_rate_decay=0.5,
        learning_rate_limit=limit,
        mean_evaluations=1,
        evaluate_mean_every=100,
    )
    assert low < evolve(Slope(), config, quiet=True).mean["x"][0] < high
