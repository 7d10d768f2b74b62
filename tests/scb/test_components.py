from dataclasses import replace

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import scb
from scb.agents.ppo import PPOConfig
from scb.agents.sac import SAC, SACConfig, SACHyperparameters
from scb.agents.spec import AgentSpec
from scb.analysis import components
from scb.analysis.components import ReplacedBandit, SACExpert
from scb.analysis.optimal_actions import optimal_actions
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.environments.zoo import load_bandit

SMALL = SACConfig(
    num_envs=1, prefill=8, total_steps=12, batch_size=4, buffer_size=16, hidden_sizes=(8,)
)


def untrained(name: str) -> SACExpert:
    env, env_params = scb.make(name)
    agent = SAC(env, SMALL)
    state = agent.init(jax.random.key(0), SACHyperparameters(), env_params)
    return SACExpert(agent, state, env_params, 0.0)


@pytest.fixture(scope="module")
def pendulum():
    return untrained("Pendulum-v1")


@pytest.fixture(scope="module")
def cart():
    return untrained("CartPole-v1")


def test_contexts_come_from_the_states_that_are_given():
    bandit = load_bandit("Synthetic-Pendulum-v1")
    states = np.arange(12.0).reshape(4, 3)
    replaced = ReplacedBandit(bandit, states=states)
    params = replaced.default_params
    shown, _ = jax.vmap(replaced.reset_env, (0, None))(
        jax.random.split(jax.random.key(0), 200), params
    )
    assert {tuple(x) for x in np.asarray(shown).tolist()} == {tuple(x) for x in states.tolist()}
    # The other half stays the bandit's.
    action = jnp.array([0.5])
    np.testing.assert_array_equal(
        replaced.mean_reward(shown[0], action, params),
        bandit.mean_reward(shown[0], action, bandit.default_params),
    )


def test_the_best_action_of_a_replaced_reward_is_not_the_linear_bandits():
    bandit = load_bandit("Synthetic-MountainCarContinuous-v0")
    best = optimal_actions(ReplacedBandit(bandit, reward=lambda o, a: -((a[0] + 0.25) ** 2)))
    assert best(jnp.zeros(2))[0] == pytest.approx(-0.25, abs=0.01)
    other_contexts = ReplacedBandit(bandit, states=np.zeros((1, 2)))
    np.testing.assert_array_equal(
        optimal_actions(other_contexts)(jnp.ones(2)), optimal_actions(bandit)(jnp.ones(2))
    )


def test_the_reward_is_what_is_given_and_contexts_stay():
    bandit = load_bandit("Synthetic-Pendulum-v1")
    replaced = ReplacedBandit(bandit, reward=lambda o, a: o[0] + 10 * a[0])
    key = jax.random.key(1)
    observation, state = replaced.reset_env(key, replaced.default_params)
    np.testing.assert_array_equal(observation, bandit.reset_env(key, bandit.default_params)[0])
    _, _, reward, terminated, _ = replaced.step_env(
        key, state, jnp.array([0.5]), replaced.default_params
    )
    assert float(reward) == pytest.approx(float(observation[0]) + 5.0)
    assert bool(terminated)


@pytest.mark.parametrize("name", ["pendulum", "cart"])
def test_an_experts_parts_agree_with_the_agent(name, request):
    expert = request.getfixturevalue(name)
    env, env_params = expert.agent.env, expert.env_params
    observation = env.reset_env(jax.random.key(2), env_params)[0]
    action = expert.action(observation)
    distribution = expert.distribution(observation)
    _, critics = expert.agent._networks(env_params)
    params = expert.state.learner.params
    if name == "cart":
        assert isinstance(distribution, distrax.Categorical)
        assert int(action) == int(jnp.argmax(distribution.probs))
        both = critics.apply(params["critics"], observation)[:, int(action)]
    else:
        # A pendulum's torque is twice the squashed mean.
        np.testing.assert_allclose(action, 2 * jnp.tanh(distribution.mean()), atol=1e-5)
        both = critics.apply(params["critics"], observation, action)
    assert both.shape == (2,)
    assert float(expert.q_value(observation, action)) == pytest.approx(float(both.min()))


def test_action_reward_is_largest_where_the_expert_acts(pendulum, cart):
    observation = jnp.array([1.0, 0.0, 0.3])
    space = pendulum.agent.env.action_space(pendulum.env_params)
    reward = components.action_reward(pendulum, space)
    best = pendulum.action(observation)
    assert float(reward(observation, best)) == 0.0
    assert float(reward(observation, best + 0.25)) == pytest.approx(-0.25, abs=1e-5)
    # Beyond the bounds an action is the bound.
    far = float(reward(observation, jnp.array([50.0])))
    assert far == pytest.approx(-float(2.0 - best[0]), abs=1e-5)
    observation = jnp.zeros(4)
    reward = components.action_reward(cart, cart.agent.env.action_space(cart.env_params))
    best = int(cart.action(observation))
    assert float(reward(observation, jnp.int32(best))) == 1.0
    assert float(reward(observation, jnp.int32(1 - best))) == 0.0


def test_q_reward_is_the_experts_q_within_the_bounds(pendulum):
    space = pendulum.agent.env.action_space(pendulum.env_params)
    reward = components.q_reward(pendulum, space)
    observation = jnp.array([1.0, 0.0, 0.3])
    assert float(reward(observation, jnp.array([9.0]))) == pytest.approx(
        float(pendulum.q_value(observation, jnp.array([2.0])))
    )


@pytest.mark.parametrize("name", ["pendulum", "cart"])
def test_cloning_comes_close_to_the_expert(name, request):
    expert = request.getfixturevalue(name)
    env, env_params = expert.agent.env, expert.env_params
    space = env.action_space(env_params)
    bandit = bandit_for(env, env_params, BanditConfig(), "untrained")
    params = bandit.params(bandit.init_weights(jax.random.key(3)))

    def contexts(key):
        return bandit.reset_env(key, params)[0]

    @jax.jit
    def agreement(rate):
        config = PPOConfig(num_steps=40, total_steps=1000)
        policy = components.clone(expert, contexts, space, jax.random.key(4), rate, config)
        states = jax.vmap(contexts)(jax.random.split(jax.random.key(5), 300))
        actions = jax.vmap(lambda o: policy(o, jax.random.key(0)))(states)
        wanted = jax.vmap(expert.action)(states)
        return jnp.mean(jnp.abs(jnp.ravel(actions).astype(float) - jnp.ravel(wanted)))

    trained, unchanged = float(agreement(5e-3)), float(agreement(0.0))
    assert trained < 0.1
    assert trained < 0.5 * unchanged


@pytest.mark.slow
def test_the_best_of_several_agents_is_the_expert(monkeypatch):
    spec = AgentSpec("sac", replace(SMALL, prefill=4, total_steps=8), SACHyperparameters())
    monkeypatch.setattr(components, "environment_agent", lambda algorithm, name: spec)
    env, env_params = scb.make("CartPole-v1")
    key = jax.random.key(0)
    best = components.train_sac_expert("CartPole-v1", env, env_params, key, 3, 4)
    agent = best.agent

    @jax.jit
    @jax.vmap
    def returns_of(key):
        key_train, key_evaluate = jax.random.split(key)
        state = agent.train(key_train, spec.hyperparameters, env_params)
        episodes = agent.evaluate(state, key_evaluate, 4, env_params=env_params, mode=True)
        return episodes.returns.mean()

    returns = returns_of(jax.random.split(key, 3)).tolist()
    assert best.mean_return == pytest.approx(max(returns), rel=1e-3)
    assert len(set(returns)) > 1
