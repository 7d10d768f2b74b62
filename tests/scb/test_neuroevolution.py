"""Neuroevolution: a policy from nothing but returns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.errors import UserError
from scb.evaluation import evaluate
from scb.neuroevolution import NeuroevolutionConfig, evolve_policy
from tests.scb.probes import ContinuousCorridor, Corridor, CorridorParams

# Action 1 pays in cells 0, 2 and 3, action 0 in cell 1: 4 in all, and 2 by chance.
CELLS = CorridorParams(
    rewards=jnp.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]),
    last=3,
    max_steps_in_episode=4,
)
CONFIG = NeuroevolutionConfig(
    population_size=16, num_generations=20, sigma=0.5, episodes=1, hidden_sizes=(8,)
)


def test_several_policies_are_evolved_side_by_side_to_the_best_return():
    env = Corridor(cells=4)

    @jax.jit
    @jax.vmap
    def returns(key):
        policy = evolve_policy(env, CELLS, key, CONFIG)
        return evaluate(env, CELLS, policy, key, 2).returns.mean()

    earned = np.asarray(returns(jax.random.split(jax.random.key(0), 3)))
    assert (earned >= 3.0).all() and earned.max() == 4.0


def test_continuous_actions_are_within_the_bounds():
    env = ContinuousCorridor()
    config = NeuroevolutionConfig(population_size=4, num_generations=1, episodes=1, sigma=5.0)
    policy = evolve_policy(env, env.default_params, jax.random.key(1), config)
    space = env.action_space(env.default_params)
    size = env.observation_space(env.default_params).shape[0]
    actions = np.asarray(jax.vmap(lambda o: policy(o, o))(10.0 * jnp.eye(size)))
    assert actions.shape == (size, *space.shape)
    assert (actions >= space.low).all() and (actions <= space.high).all()


@pytest.mark.parametrize("name", ["num_generations", "episodes"])
def test_sizes_are_at_least_one(name):
    with pytest.raises(UserError, match=f"{name} is 0: it must be at least 1"):
        NeuroevolutionConfig(**{name: 0})


def test_a_population_has_something_to_compare():
    with pytest.raises(UserError, match="population_size is 1: it must be at least 2"):
        NeuroevolutionConfig(population_size=1)
