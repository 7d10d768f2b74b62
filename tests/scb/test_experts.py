"""Experts: policies that are evolved, trained or handed over, what they earn and what they cost."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.agents.dqn import DQNConfig, DQNHyperparameters
from scb.agents.spec import AgentSpec
from scb.curriculum import CurriculumConfig
from scb.environments.registry import make
from scb.errors import UserError
from scb.evolution import EvolutionConfig
from scb.experts import PolicySearchConfig, best_agent, evolve_expert, judged, train_expert
from scb.measurement import Judge
from tests.scb.probes import (
    TWO_TARGETS,
    ContinuousCorridor,
    Corridor,
    CorridorParams,
    assert_solves_two_targets,
)

EVOLUTION = EvolutionConfig(
    population_size=16,
    num_generations=12,
    sigma=0.5,
    mean_evaluations=2,
    evaluate_mean_every=1000,
)
SEARCH = PolicySearchConfig(hidden_size=8, episodes=1, evolution=EVOLUTION)
# Action 1 pays in cells 0, 2 and 3, action 0 in cell 1: 4 in all, and 2 by chance.
CELLS = CorridorParams(
    rewards=jnp.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]),
    last=3,
    max_steps_in_episode=4,
)
BEST = [1, 0, 1, 1]


def actions(expert, cells=4):
    return jax.jit(jax.vmap(expert.policy))(np.eye(cells)).tolist()


# -- a policy that is handed over
# ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "earned"),
    [
        # 1 in cells 0, 2 and 3; 0 in cell 1; and the optimum by reading the observation.
        (lambda observation: jnp.int32(1), 3.0),
        (lambda observation: jnp.int32(0), 1.0),
        (lambda observation: jnp.array(BEST)[jnp.argmax(observation)], 4.0),
    ],
)
def test_a_hand_made_policy_is_measured(policy, earned):
    expert = judged(policy, Corridor(cells=4), CELLS, jax.random.key(0), environment_steps=7)
    assert expert.mean_return == earned
    # 20 episodes of at most 4 steps, and what it cost before.
    assert expert.environment_steps == 7 + 20 * 4
    assert expert.policy is policy


def test_a_policy_is_given_flattened_observations():
    class Folded(Corridor):
        def get_obs(self, state, params=None, key=None):
            return jnp.reshape(super().get_obs(state), (2, 2))

    def policy(observation):
        assert observation.shape == (4,)
        return jnp.array(BEST)[jnp.argmax(observation)]

    assert judged(policy, Folded(cells=4), CELLS, jax.random.key(0)).mean_return == 4.0


# -- a policy that is evolved
# -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def evolved():
    return evolve_expert(Corridor(cells=4), CELLS, SEARCH, jax.random.key(0))


def test_an_evolved_policy_solves_a_corridor(evolved):
    assert evolved.mean_return == 4.0
    assert actions(evolved) == BEST


def test_the_steps_of_an_evolution_are_counted(evolved):
    # 12 generations of 16 candidates with 1 episode of 4 steps; their mean before and after, by so many agents; then
    # 20 episodes that judge it.
    agents = EVOLUTION.mean_evaluations
    assert evolved.environment_steps == 12 * 16 * 4 + 2 * agents * 4 + 20 * 4


def test_the_key_alone_decides_the_expert(evolved):
    # The configuration's own seed does not.
    other_seed = replace(SEARCH, evolution=replace(EVOLUTION, seed=5))
    again = evolve_expert(Corridor(cells=4), CELLS, other_seed, jax.random.key(0))
    assert again.mean_return == evolved.mean_return
    between = jax.random.normal(jax.random.key(2), (400, 4))
    np.testing.assert_array_equal(
        jax.vmap(again.policy)(between), jax.vmap(evolved.policy)(between)
    )
    other = evolve_expert(Corridor(cells=4), CELLS, SEARCH, jax.random.key(1))
    assert (jax.vmap(other.policy)(between) != jax.vmap(evolved.policy)(between)).any()


def test_an_evolved_policy_finds_continuous_actions_within_the_bounds():
    search = replace(SEARCH, evolution=replace(EVOLUTION, population_size=32, num_generations=40))
    expert = evolve_expert(ContinuousCorridor(cells=2), TWO_TARGETS, search, jax.random.key(0))
    assert_solves_two_targets(expert)


@pytest.mark.parametrize("paying", [0, 1])
def test_a_curriculum_lets_a_policy_see_what_lies_beyond_the_environments_limit(paying):
    # Episodes end after 2 steps, but only the fourth cell pays. A curriculum that stays at 4 steps
    # during the whole search shows it; the expert itself is judged within the limit, and earns 0.
    rewards = jnp.zeros((4, 2)).at[3, paying].set(1.0)
    params = CorridorParams(rewards=rewards, last=3, max_steps_in_episode=2)
    curriculum = CurriculumConfig("linear", initial=4, final=2, begin=100)
    search = replace(SEARCH, curriculum=curriculum)
    expert = evolve_expert(Corridor(cells=4), params, search, jax.random.key(0))
    assert actions(expert)[3] == paying
    assert expert.mean_return == 0.0
    # Episodes of 4 steps in the search, and of 2 in the judgement.
    assert expert.environment_steps == 12 * 16 * 4 + 2 * EVOLUTION.mean_evaluations * 2 + 20 * 2


def test_an_evolved_policy_balances_a_pole():
    # CartPole pays 1 a step, 500 at most; random actions earn about 22.
    env, env_params = make("CartPole-v1")
    search = replace(
        SEARCH, episodes=2, evolution=replace(EVOLUTION, population_size=32, num_generations=12)
    )
    expert = evolve_expert(env, env_params, search, jax.random.key(0))
    assert expert.mean_return > 400


# -- an agent that is trained
# -------------------------------------------------------------------------


def test_any_agent_can_be_the_expert():
    config = DQNConfig(
        num_envs=4,
        buffer_size=400,
        prefill=80,
        batch_size=32,
        total_steps=480,
        hidden_sizes=(16,),
    )
    spec = AgentSpec("dqn", config, DQNHyperparameters(learning_rate=0.02))
    expert = train_expert(Corridor(cells=4), CELLS, spec, jax.random.key(0), num_experts=2)
    assert expert.mean_return == 4.0
    assert actions(expert) == BEST
    # Two agents of 480 steps, each judged by 20 episodes of 4, the better one by 20 more.
    assert expert.environment_steps == 2 * (480 + 20 * 4) + 20 * 4


# -- the best of several
# -------------------------------------------------------------------------


class Ranked:
    """Agents that earn what their key draws: no number for some."""

    def __init__(self, failing):
        self.failing, self.env = failing, None

    def train(self, key, hyperparameters, env_params):
        return jax.random.uniform(key)

    def evaluate(self, state, key, num_episodes, *_):
        returns = jnp.where(state > self.failing, jnp.nan, state)
        return SimpleNamespace(returns=jnp.full(num_episodes, returns))


SETTING = SimpleNamespace(hyperparameters=None)
JUDGE = Judge(None, None, episodes=3)


def test_an_agent_without_a_finite_return_is_not_the_best():
    state, returns = best_agent(Ranked(0.5), SETTING, None, jax.random.key(0), 20, JUDGE)
    assert 0.0 < float(state) == np.nanmax(returns) <= 0.5
    assert np.isnan(returns).any()


def test_agents_of_which_none_has_a_finite_return_are_refused():
    with pytest.raises(UserError, match="none of 4 agents has a finite return"):
        best_agent(Ranked(-1.0), SETTING, None, jax.random.key(0), 4, JUDGE)
