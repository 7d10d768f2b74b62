from dataclasses import replace
from functools import cache
from operator import itemgetter

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from scb.agents.drift import clipped_surrogate_drift
from scb.agents.normalization import RunningStatistics
from scb.agents.ppo import (
    PPO,
    PPOConfig,
    PPOHyperparameters,
    generalized_advantages,
    random_order,
)
from scb.errors import UserError
from tests.scb.probes import Corridor, CorridorParams, context_bandit

NUM_SEEDS = 64

# -- diagnosis
# ---------------------------------------------------------------------------------------


def test_a_diagnosis_is_of_a_batch_before_and_after_its_update(monkeypatch):
    monkeypatch.setattr("scb.agents.ppo.DIAGNOSED", 1)
    params = CorridorParams(rewards=jnp.array([[0.0, 1.0], [3.0, 0.0], [0.5, 0.0]]), random_start=1)
    config = PPOConfig(num_envs=8, num_steps=8, num_minibatches=2, normalize_observations=True)
    agent, hyperparameters = PPO(Corridor(), config), PPOHyperparameters(learning_rate=0.005)
    state = jax.jit(agent.init)(jax.random.key(0), hyperparameters, params)
    state = jax.jit(agent.iterate)(state, hyperparameters, params)
    found = jax.jit(agent.diagnose)(state, hyperparameters, params)

    after, batch = jax.jit(agent._iterate)(state, hyperparameters, params)
    # The observations that the update saw are normalised as before it.
    seen = replace(after, statistics=state.statistics)
    before, later = (
        np.asarray(agent._policy(x, batch.observation, params).probs, np.float64)
        for x in (state, seen)
    )
    taken = np.arange(64), np.asarray(batch.action)
    ratio = later[taken] / before[taken]
    advantage = np.asarray(batch.advantage, np.float64)
    expected = {
        "kl": np.mean(np.sum(before * np.log(before / later), axis=1)),
        "outside": np.mean(np.abs(ratio - 1) > 0.2),
        "gain": np.mean(ratio * (advantage - advantage.mean())) / advantage.std(),
        "value_error": advantage.var() / np.asarray(batch.target).var(),
        "entropy": -np.mean(np.sum(before * np.log(before), axis=1)),
    }
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert float(found[name]) == pytest.approx(value, rel=1e-3, abs=1e-5), name
    assert 0.0 < expected["outside"] < 1.0 and expected["kl"] > 1e-3


@pytest.mark.parametrize(("bound", "whole"), [(20.0, True), (np.inf, False)])
def test_a_drift_meets_no_ratio_beyond_the_bound(monkeypatch, bound, whole):
    monkeypatch.setattr("scb.agents.ppo.MAX_LOG_RATIO", bound)

    def breaking(parameters, log_ratio, advantage, progress):
        return log_ratio * jnp.where(jnp.abs(log_ratio) > 20.0, jnp.nan, 0.0)

    config = PPOConfig(num_envs=8, num_steps=8, num_minibatches=2)
    agent, params = PPO(Corridor(), config, breaking), CorridorParams(random_start=1)
    hyperparameters = PPOHyperparameters(learning_rate=10.0)
    state = jax.jit(agent.init)(jax.random.key(0), hyperparameters, params)
    iterate = jax.jit(agent.iterate)
    for _ in range(3):
        state = iterate(state, hyperparameters, params)
    leaves = jax.tree.leaves(state.params["policy"])
    assert all(np.isfinite(x).all() for x in leaves) == whole


# -- advantages
# ---------------------------------------------------------------------------------------


def test_advantages_of_three_steps_by_hand():
    # discount = lambda = 1/2: the trace decays by 1/4 a step.
    # r = 1 2 3, V(s) = 2 4 6, V(s') = 4 6 8, so every delta is 1 while nothing ends:
    #   1 + 4/2 - 2 = 2 + 6/2 - 4 = 3 + 8/2 - 6 = 1.
    # Column 0, nothing ends: A2 = 1, A1 = 1 + 1/4 = 1.25, A0 = 1 + 1.25/4 = 1.3125.
    # Column 1, the second step terminates: no bootstrap, delta1 = 2 - 4 = -2, and no trace from A2:
    #   A1 = -2, A0 = 1 - 2/4 = 0.5.
    # Column 2, it is truncated: delta1 = 1 with V(s') = 6, but no trace from A2: A1 = 1, A0 = 1.25.
    def columns(x):
        return np.tile(np.float32(x)[:, None], (1, 3))

    at_second_step = np.array([[False], [True], [False]])
    advantages = generalized_advantages(
        reward=columns([1.0, 2.0, 3.0]),
        value=columns([2.0, 4.0, 6.0]),
        next_value=columns([4.0, 6.0, 8.0]),
        terminated=at_second_step & np.array([False, True, False]),
        truncated=at_second_step & np.array([False, False, True]),
        discount=0.5,
        gae_lambda=0.5,
    )
    np.testing.assert_allclose(
        advantages, [[1.3125, 0.5, 1.25], [1.25, -2.0, 1.0], [1.0, 1.0, 1.0]]
    )


advantages_of = jax.jit(generalized_advantages)
drift_of = jax.jit(clipped_surrogate_drift)


@settings(deadline=None, max_examples=20)
@given(discount=st.floats(0.0, 1.0), gae_lambda=st.floats(0.0, 1.0))
def test_bandit_advantage_is_reward_minus_value(discount, gae_lambda):
    # One-step episodes: nothing to bootstrap. A = r - V(s) = 3 - 1 = 2 and -1 - 4 = -5, whatever
    # gamma and lambda are, and whatever value the next observation has.
    ends = np.ones((2, 1), bool)
    advantages = advantages_of(
        np.array([[3.0], [-1.0]]),
        np.array([[1.0], [4.0]]),
        np.array([[100.0], [-100.0]]),
        ends,
        ~ends,
        discount,
        gae_lambda,
    )
    np.testing.assert_array_equal(advantages, [[2.0], [-5.0]])


def test_advantages_of_unequal_shapes_are_refused_not_broadcast():
    x = np.ones((3, 2))
    with pytest.raises(AssertionError):
        generalized_advantages(x, x, x[:, :1], x == 0, x == 0, 0.9, 0.9)


# -- the drift
# ----------------------------------------------------------------------------------------


def ppo_minimum(ratio, advantage, clip):
    return np.minimum(ratio * advantage, np.clip(ratio, 1 - clip, 1 + clip) * advantage)


@settings(deadline=None, max_examples=200)
@given(
    log_ratio=st.floats(-3.0, 3.0, width=32),
    advantage=st.floats(-5.0, 5.0, width=32),
    clip=st.floats(0.015625, 0.75, width=32),
)
def test_ratio_times_advantage_minus_the_drift_is_ppos_minimum(log_ratio, advantage, clip):
    arguments = np.float32([log_ratio]), np.float32([advantage]), np.zeros(1, np.float32)
    drift = drift_of(clip, *arguments)
    ratio = np.exp(np.float64(log_ratio))
    # Ratios are at most e^3 = 20 and advantages 5: float32 is exact to about 100 * 6e-8.
    np.testing.assert_allclose(
        ratio * advantage - drift, ppo_minimum(ratio, advantage, clip), atol=1e-4
    )
    assert drift >= 0


def test_the_drift_is_ppos_for_a_whole_batch():
    log_ratio, advantage = np.random.default_rng(0).normal(size=(2, 1000)).astype(np.float32)
    log_ratio *= 0.5
    drift = drift_of(0.2, log_ratio, advantage, np.zeros(1000, np.float32))
    ratio = np.exp(log_ratio)
    np.testing.assert_allclose(
        ratio * advantage - drift, ppo_minimum(ratio, advantage, 0.2), atol=1e-5
    )
    # With deviations of 0.5 in the log-ratio, a good part of the batch is clipped.
    assert 0.2 < np.mean(np.asarray(drift) > 0) < 0.8


def test_the_drift_is_flat_where_the_policy_has_not_moved():
    advantage = np.float32([-2.0, 0.0, 3.0])

    def drift(log_ratio):
        charged = clipped_surrogate_drift(0.2, log_ratio, advantage, jnp.zeros(3))
        return charged.sum(), charged

    gradient, charged = jax.jit(jax.grad(drift, has_aux=True))(np.zeros(3, np.float32))
    np.testing.assert_array_equal(charged, 0.0)
    np.testing.assert_array_equal(gradient, 0.0)


def test_a_column_against_a_vector_is_refused_not_broadcast():
    # [4, 1] with [4] would broadcast to [4, 4].
    vector, column = np.ones(4), np.ones((4, 1))
    for arguments in [(column, vector, vector), (vector, column, vector)]:
        with pytest.raises(AssertionError):
            clipped_surrogate_drift(0.2, *arguments)


def test_an_agent_refuses_a_drift_of_another_shape():
    def column(_, log_ratio, advantage, progress):
        return 0.0 * log_ratio[:, None]

    agent = PPO(context_bandit(), SMALL, drift=column)
    with pytest.raises(UserError, match=r"the agent's drift returns \(1, 1\) for one ratio"):
        jax.eval_shape(
            agent.train, jax.random.key(0), PPOHyperparameters(), agent.env.default_params
        )


# -- configuration
# ------------------------------------------------------------------------------------


def test_steps_are_rounded_up_to_whole_batches():
    # 5 x 100 = 500 a batch; 1001 steps take ceil(1001 / 500) = 3 of them, 1000 take 2.
    assert PPOConfig(total_steps=1001).num_iterations == 3
    assert PPOConfig(total_steps=1000).num_iterations == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0: it must be at least 1"),
        ({"num_steps": -1}, "num_steps is -1: it must be at least 1"),
        ({"num_epochs": 0}, "num_epochs is 0: it must be at least 1"),
        ({"num_minibatches": 0}, "num_minibatches is 0: it must be at least 1"),
        ({"total_steps": 0}, "total_steps is 0: it must be at least 1"),
        ({"num_minibatches": 3}, "num_minibatches is 3, which does not divide a batch of 500"),
        ({"num_minibatches": 500}, "leaves one transition of 500 in each"),
        ({"activation": "tan"}, "unknown activation 'tan': did you mean tanh?"),
    ],
)
def test_impossible_configurations_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        PPOConfig(**arguments)


# -- minibatches
# --------------------------------------------------------------------------------------


# 70 000 > 2^16: the range that falls back to jax.random.permutation.
@pytest.mark.parametrize("size", [1, 2, 10, 500, 512, 70_000])
def test_random_order_is_a_permutation(size):
    order = jax.jit(random_order, static_argnums=1)(jax.random.key(size), size)
    assert order.dtype == jnp.int32
    np.testing.assert_array_equal(np.sort(order), np.arange(size))


def test_every_number_is_equally_likely_in_every_place():
    # 8000 permutations of 8: each number is expected 1000 times in each place. Chi-square per
    # place; the smallest of 8 p-values is below 1e-4 once in 1250 tries of a correct shuffle.
    keys = jax.random.split(jax.random.key(0), 8000)
    orders = np.asarray(jax.jit(jax.vmap(lambda key: random_order(key, 8)))(keys))
    counts = np.stack([np.bincount(place, minlength=8) for place in orders.T])
    assert stats.chisquare(counts, axis=1).pvalue.min() > 1e-4
    # Pairs too: each of the 8 * 7 ordered pairs in the first two places is expected 143 times.
    pairs = np.bincount(8 * orders[:, 0] + orders[:, 1], minlength=64).reshape(8, 8)
    assert stats.chisquare(pairs[~np.eye(8, dtype=bool)]).pvalue > 1e-4


# -- learning
# -----------------------------------------------------------------------------------------

LEARNING = PPOConfig(
    num_envs=4,
    num_steps=32,
    num_epochs=4,
    num_minibatches=4,
    total_steps=128 * 30,
    hidden_sizes=(8,),
    normalize_observations=True,
)
CONTEXTS = np.linspace(0.05, 0.95, 10, dtype=np.float32)[:, None]


def bandit_learner(one_batch):
    """jit of [S] keys, learning rate -> ([S] agents, [S] mean returns, [S, 10] mode actions)."""
    bandit = context_bandit()
    bandit.one_step = one_batch  # which nobody but the agent looks at
    agent = PPO(bandit, LEARNING)
    params = agent.env.default_params

    def train(key, learning_rate):
        key_train, key_evaluate = jax.random.split(key)
        hyperparameters = PPOHyperparameters(learning_rate=learning_rate)
        state = agent.train(key_train, hyperparameters, params)
        returns = agent.evaluate(state, key_evaluate, 32).returns.mean()
        actions = jax.vmap(lambda c: agent.act(state, c, key_evaluate, mode=True))(CONTEXTS)
        return state, returns, actions[:, 0]

    return agent, jax.jit(jax.vmap(train, in_axes=(0, None)))


@pytest.fixture(scope="module")
def bandit_agents():
    """{one_batch: (agents, returns, mode actions)} of 64 seeds, and the returns of untrained agents."""
    trained, untrained = {}, None
    for one_batch in (True, False):
        agent, train = bandit_learner(one_batch)
        assert agent.one_step == one_batch
        trained[one_batch] = train(jax.random.split(jax.random.key(one_batch), NUM_SEEDS), 0.02)
        if one_batch:
            untrained = train(jax.random.split(jax.random.key(2), NUM_SEEDS), 0.0)[1]
    return trained, np.asarray(untrained)


@pytest.mark.parametrize("one_batch", [True, False])
def test_the_best_action_of_a_bandit_is_learned(bandit_agents, one_batch):
    # The reward is -|a - c|, c uniform in [0, 1]: the best action is the context. An agent that
    # ignores the context is off by 0.25 at best.
    actions = np.asarray(bandit_agents[0][one_batch][2])
    error = np.abs(actions - np.asarray(CONTEXTS)[:, 0]).mean(axis=1)
    assert np.median(error) < 0.1


def test_a_batch_of_contexts_and_single_steps_train_the_same_distribution_of_agents(bandit_agents):
    trained, untrained = bandit_agents
    batch, steps = (np.asarray(trained[path][1]) for path in (True, False))
    # Both learned: their agents earn more than untrained ones, which act with a deviation of 1.
    assert min(batch.mean(), steps.mean()) > untrained.mean() + 0.2
    error = np.sqrt(batch.var() / NUM_SEEDS + steps.var() / NUM_SEEDS)
    assert abs(batch.mean() - steps.mean()) < 4 * error
    assert stats.ks_2samp(batch, steps).pvalue > 1e-3


def test_both_paths_take_the_same_number_of_transitions(bandit_agents):
    # 30 iterations of 4 x 32 contexts.
    for path in (True, False):
        state = bandit_agents[0][path][0]
        np.testing.assert_array_equal(state.iteration, 30)
        np.testing.assert_array_equal(state.statistics.count, 30 * 4 * 32)
        # Uniform contexts: mean 1/2, variance 1/12; the error of a mean of 3840 is 0.005.
        np.testing.assert_allclose(state.statistics.mean, 0.5, atol=0.025)
        variance = state.statistics.squares / state.statistics.count[:, None]
        np.testing.assert_allclose(variance, 1 / 12, atol=0.01)


# What four agents of one program learn in: corridors that differ in rewards, end and discount.
CORRIDORS = {
    "cell 0 pays, the end": ([[1, 1], [0, 0], [0, 0]], 0, 0, 100, 0.9),
    "cell 1 pays, the end": ([[0, 0], [1, 1], [0, 0]], 1, 0, 100, 0.9),
    "cell 1 pays, no end": ([[0, 0], [1, 1], [0, 0]], 1000, 1, 2, 0.5),
    "the second cell wants 1": ([[1, 0], [0, 1], [1, 0]], 2, 0, 100, 0.9),
}


@pytest.fixture(scope="module")
def corridor_agents():
    """{name of a corridor: (values [3] of its cells, returns [8] of mode actions)}."""
    config = replace(LEARNING, num_epochs=8, total_steps=128 * 40, normalize_observations=False)
    agent = PPO(Corridor(), replace(config, anneal_learning_rate=True))

    def train(key, rewards, last, random_start, max_steps, discount):
        params = CorridorParams(
            rewards=rewards, last=last, random_start=random_start, max_steps_in_episode=max_steps
        )
        hyperparameters = PPOHyperparameters(learning_rate=0.02, discount=discount)
        state = agent.train(key, hyperparameters, params)
        returns = agent.evaluate(state, key, 8, env_params=params, mode=True).returns
        return agent._value(state, jnp.eye(3), params), returns

    columns = zip(*CORRIDORS.values(), strict=True)
    settings = [np.array(column) for column in columns]
    settings[0] = settings[0].astype(float)
    keys = jax.random.split(jax.random.key(0), len(CORRIDORS))
    values, returns = jax.jit(jax.vmap(train))(keys, *settings)
    return {
        name: (np.asarray(values[i]), np.asarray(returns[i])) for i, name in enumerate(CORRIDORS)
    }


def test_the_value_of_a_step_that_pays_one_and_ends_is_one(corridor_agents):
    values, _ = corridor_agents["cell 0 pays, the end"]
    np.testing.assert_allclose(values[0], 1.0, atol=0.05)


def test_the_value_of_a_step_before_is_discounted(corridor_agents):
    # V(1) = 1, V(0) = 0 + 0.9 * V(1) = 0.9.
    values, _ = corridor_agents["cell 1 pays, the end"]
    np.testing.assert_allclose(values[:2], [0.9, 1.0], atol=0.05)


def test_truncated_episodes_are_bootstrapped_from_where_they_were_cut(corridor_agents):
    # An endless corridor of 3 cells of which cell 1 pays 1, at discount 1/2, cut every 2 steps:
    # V(1) = 1 + V(1) / 8 = 8/7, V(0) = V(1) / 2 = 4/7, V(2) = V(1) / 4 = 2/7. With no bootstrapping
    # at the cut V(2) would be 0, since cell 1 is two steps away; and bootstrapping from the next
    # episode's random first cell would draw the three together.
    values, _ = corridor_agents["cell 1 pays, no end"]
    np.testing.assert_allclose(values, [4 / 7, 8 / 7, 2 / 7], atol=0.05)


def test_the_best_discrete_actions_are_learned(corridor_agents):
    # Only the actions 0, 1, 0 earn 1 each.
    _, returns = corridor_agents["the second cell wants 1"]
    np.testing.assert_array_equal(returns, 3.0)


# -- the mechanics of a training
# ----------------------------------------------------------------------

SMALL = PPOConfig(
    num_envs=2, num_steps=8, num_epochs=2, num_minibatches=2, total_steps=64, hidden_sizes=(4,)
)


def displacement(before, after):
    """What separates two agents' weights, as one flat array."""
    difference = jax.tree.map(lambda a, b: np.ravel(b - a), before, after)
    return np.concatenate(jax.tree.leaves(difference))


@pytest.fixture(scope="module")
def small():
    return PPO(Corridor(), SMALL), CorridorParams(
        rewards=np.float32([[1.0, 0], [0, 1.0], [1.0, 0]])
    )


# Each differs from the defaults in one number. A norm of 1e-4 is far below any gradient's, and
# Adam's epsilon of 1e-5 makes even a common factor felt.
CHANGED = {
    "learning_rate": 0.001,
    "discount": 0.1,
    "gae_lambda": 0.1,
    "entropy_coefficient": 1.0,
    "value_coefficient": 0.0,
    "max_grad_norm": 1e-4,
    "drift": 0.0001,
    "policy_output_scale": 0.1,
}


@pytest.fixture(scope="module")
def population(small):
    """Hyperparameters, keys and agents of one program: the defaults and all of CHANGED."""
    agent, params = small
    members = [PPOHyperparameters(learning_rate=0.02)]
    members += [members[0].replace(**{name: value}) for name, value in CHANGED.items()]
    hyperparameters = jax.tree.map(lambda *x: jnp.array(x), *members)
    key = jax.random.key(0)
    train = jax.jit(jax.vmap(lambda k, h: agent.train(k, h, params), in_axes=(None, 0)))
    return members, train(jax.random.split(key)[0], hyperparameters)


@pytest.fixture(scope="module")
def watched(small):
    """jit of hyperparameters -> (agent, evaluations), with the population's key."""
    agent, params = small

    def evaluation(state, key):
        return {"iteration": state.iteration, "key": jax.random.key_data(key)}

    return jax.jit(
        lambda h: agent.train_with_evaluations(jax.random.key(0), h, params, evaluation, every=2)
    )


def test_every_hyperparameter_has_an_effect(population):
    # The horizon has one only where a drift or an annealed learning rate asks how far training is.
    assert set(CHANGED) == set(PPOHyperparameters.__dataclass_fields__) - {"horizon"}
    base, *others = (
        jax.tree.map(itemgetter(i), population[1].params) for i in range(1 + len(CHANGED))
    )
    for name, other in zip(CHANGED, others, strict=True):
        assert np.abs(displacement(base, other)).max() > 1e-5, name


def test_the_output_scale_multiplies_the_policys_last_layer_and_nothing_else(small):
    agent, params = small
    init = jax.jit(agent.init)
    full, half = (
        init(jax.random.key(0), PPOHyperparameters(policy_output_scale=scale), params).params
        for scale in (1.0, 0.5)
    )
    name = f"Dense_{len(agent.config.hidden_sizes)}"
    last = full["policy"]["params"]["MLP_0"].pop(name)
    halved = half["policy"]["params"]["MLP_0"].pop(name)
    np.testing.assert_array_equal(halved["kernel"], 0.5 * last["kernel"])
    assert np.abs(last["kernel"]).min() > 0
    chex.assert_trees_all_equal(full, half)


def test_a_member_of_a_population_is_the_agent_that_is_trained_alone(population, watched):
    # Being watched doesn't change it either: the key's other half is for the evaluations.
    members, agents = population
    for i, hyperparameters in enumerate(members):
        alone, _ = watched(hyperparameters)
        expected = jax.tree.map(itemgetter(i), agents.params)
        chex.assert_trees_all_close(alone.params, expected, atol=1e-5)


def test_evaluations_happen_before_the_first_and_after_every_nth_iteration(watched):
    state, outcomes = watched(PPOHyperparameters())
    # 64 steps in batches of 16 are 4 iterations: evaluated at 0, 2 and 4, each time with another
    # key.
    np.testing.assert_array_equal(outcomes["iteration"], [0, 2, 4])
    assert len(np.unique(outcomes["key"], axis=0)) == 3
    assert state.iteration == 4


def test_where_evaluations_divide_a_training_unevenly_it_is_the_same(small):
    agent, params = small
    train = jax.jit(
        lambda every: agent.train_with_evaluations(
            jax.random.key(0),
            PPOHyperparameters(),
            params,
            lambda state, key: state.iteration,
            every,
        ),
        static_argnums=0,
    )
    (even, _), (uneven, at) = train(2), train(3)
    np.testing.assert_array_equal(at, [0, 3, 4])
    chex.assert_trees_all_close(uneven.params, even.params, rtol=1e-5, atol=1e-6)


def test_evaluations_after_no_iteration_are_refused(small):
    agent, params = small
    with pytest.raises(UserError, match="every 0 iterations: give a number from 1 on"):
        agent.train_with_evaluations(
            jax.random.key(0), PPOHyperparameters(), params, lambda state, key: 0, 0
        )


@pytest.fixture(scope="module")
def one_update():
    """An agent whose iteration is one update on one batch of 2 x 5 steps; 4 iterations, annealed."""
    config = PPOConfig(
        num_envs=2,
        num_steps=5,
        num_epochs=1,
        num_minibatches=1,
        total_steps=40,
        hidden_sizes=(4,),
        normalize_observations=True,
        anneal_learning_rate=True,
    )

    def watch(largest, log_ratio, advantage, progress):
        # Makes the gradient NaN where the policy that is updated isn't the one that acted, and where
        # more than all of the training is done.
        wrong = (jnp.abs(log_ratio) > 1e-5) | (progress > 1.0)
        return log_ratio * jnp.where(wrong, jnp.nan, 0.0)

    agent = PPO(Corridor(), config, drift=watch)
    params = CorridorParams(rewards=np.float32([[1.0, 0.0], [0.0, 5.0], [1.0, 0.0]]))
    start = jax.jit(agent.init)(jax.random.key(0), PPOHyperparameters(), params)
    iterate = jax.jit(lambda state, h: agent.train_iterations(state, h, params, 1))
    return agent, start, iterate


def first_moments(state, name):
    """Adam's running mean of gradients as one flat array; after one update, a tenth of the gradient."""
    (adam,) = (
        part
        for part in jax.tree.leaves(
            state.optimizer[name], is_leaf=lambda x: isinstance(x, optax.ScaleByAdamState)
        )
        if isinstance(part, optax.ScaleByAdamState)
    )
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(adam.mu)])


def test_each_networks_gradient_is_clipped_by_its_global_norm(one_update):
    _, start, iterate = one_update
    free = iterate(start, PPOHyperparameters(max_grad_norm=1e9))
    for name in ("policy", "value"):
        gradient = 10 * first_moments(free, name)
        # Half the norm: the same direction, half the length. An element-wise clip would bend it.
        limit = float(np.linalg.norm(gradient)) / 2
        clipped = iterate(start, PPOHyperparameters(max_grad_norm=limit))
        np.testing.assert_allclose(10 * first_moments(clipped, name), gradient / 2, rtol=1e-4)


def test_annealing_goes_linearly_to_zero(one_update):
    # 4 iterations: the k-th update is 1 - k/4 of what it would be, so 1, 1/2 (k = 2), 1/4 for the
    # last one (k = 3), and nothing at the end of the training (k = 4) or past it (k = 6).
    _, start, iterate = one_update
    moved = {
        k: displacement(
            start.params,
            iterate(start.replace(iteration=jnp.int32(k)), PPOHyperparameters()).params,
        )
        for k in (0, 2, 3, 4, 6)
    }
    assert np.abs(moved[0]).max() > 1e-3
    for k in (2, 3, 4, 6):
        np.testing.assert_allclose(moved[k], moved[0] * max(0, 1 - k / 4), atol=1e-6)


def test_statistics_are_those_of_all_observations_and_an_update_starts_from_the_policy_that_acted(
    one_update,
):
    # Three cells, one-hot, 5 steps and again 5: 0 1 2 0 1 | 2 0 1 2 0 in both environments. Cell 0
    # is seen in 4 of 10 steps, the others in 3; the variance of a one-hot entry is p (1 - p).
    _, start, iterate = one_update
    state = iterate(iterate(start, PPOHyperparameters()), PPOHyperparameters())
    share = np.array([0.4, 0.3, 0.3])
    assert state.statistics.count == 20
    np.testing.assert_allclose(state.statistics.mean, share, atol=1e-6)
    np.testing.assert_allclose(state.statistics.squares / 20, share * (1 - share), atol=1e-6)
    # The second batch was collected and learned under the same statistics: had they been updated in
    # between, the ratio would not be 1 at its first update, and the drift above would have made
    # NaN.
    assert np.isfinite(displacement(start.params, state.params)).all()


def test_evaluation_normalises_by_the_frozen_statistics(one_update):
    # mean 0.3 and variance 4: the cell's observation 1 becomes (1 - 0.3) / 2 = 0.35, 0 becomes
    # -0.15.
    agent, start, _ = one_update
    statistics = RunningStatistics(np.float32(10.0), np.full(3, 0.3), np.full(3, 40.0))
    state = start.replace(statistics=statistics)
    plain = PPO(agent.env, replace(agent.config, normalize_observations=False))

    @jax.jit
    def logits():
        by_hand = plain._policy(state, jnp.array([0.35, -0.15, -0.15]), None).logits
        return agent._policy(state, jnp.eye(3)[0], None).logits, by_hand

    np.testing.assert_allclose(*logits(), atol=1e-6)
    # Nothing is learned from evaluation episodes: the second of two equal ones is like the first.
    evaluate = jax.jit(lambda key: agent.evaluate(state, key, 4))
    first, second = (evaluate(jax.random.key(0)) for _ in range(2))
    np.testing.assert_array_equal(first.returns, second.returns)


@cache
def untrained_program():
    agent = PPO(context_bandit(), replace(SMALL, num_minibatches=1))

    def act(state, mode):
        keys = jax.random.split(jax.random.key(1), 16)
        return jax.vmap(lambda key: agent.act(state, jnp.array([0.3]), key, mode=mode))(keys)

    init = jax.jit(lambda key: agent.init(key, PPOHyperparameters(), agent.env.default_params))
    return init, jax.jit(act, static_argnums=1)


def untrained():
    """An untrained agent, and what makes 16 actions of one: jit of state, mode -> [16, 1]."""
    init, act = untrained_program()
    return init(jax.random.key(0)), act


def test_actions_stay_within_the_bounds():
    # A policy whose mean is 50 in an action space of [-1, 2].
    state, act = untrained()
    bias = state.params["policy"]["params"]["MLP_0"]["Dense_1"]["bias"]
    state.params["policy"]["params"]["MLP_0"]["Dense_1"]["bias"] = np.full_like(bias, 50.0)
    for mode in (True, False):
        np.testing.assert_array_equal(act(state, mode), 2.0)


def test_sampled_actions_vary_and_mode_actions_do_not():
    state, act = untrained()
    assert np.unique(act(state, True)).size == 1
    assert np.unique(act(state, False)).size > 8
