"""Bandits of the form linear: contexts normally distributed, rewards a distance to a linear policy."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

from scb.configurations import config_dict
from scb.discovery import BanditDiscovery, DiscoveryConfig, discover
from scb.environments.linear import fitted
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig, SyntheticBandit, bandit_for
from scb.environments.synthetic_mdp import synthetic_for
from scb.environments.zoo import load_bandit, save_bandit
from scb.errors import UserError
from scb.evolution import EvolutionConfig
from scb.fitting import ExpertDataset, fit_bandit, standardize_reward
from scb.runs import Run
from scb.warm_start import WarmStartConfig

LINEAR = BanditConfig(form="linear")
SPACE = spaces.Box(jnp.array([-1.0, 0.0]), jnp.array([1.0, 4.0]), (2,), jnp.float32)
# Two entries of very different sizes, and correlated.
CENTER = np.array([5.0, -0.2])
ROOT = np.array([[10.0, 0.0], [0.03, 0.04]])
KERNEL = np.array([[0.05, 0.0], [4.0, -9.0]])
BIAS = np.array([0.3, -0.1])


def policy(states):
    return np.array([0.0, 2.0]) + np.array([1.0, 2.0]) * np.tanh((states - CENTER) @ KERNEL + BIAS)


@pytest.fixture(scope="module")
def states():
    return CENTER + np.random.default_rng(0).normal(size=(4000, 2)) @ ROOT.T


@pytest.fixture(scope="module")
def bandit(states):
    weights = fitted(states, policy(states), np.array([-1.0, 0.0]), np.array([1.0, 4.0]))
    return SyntheticBandit(2, SPACE, LINEAR, weights, "Synthetic-Pair")


def test_a_fit_is_the_policy_and_its_states(bandit, states):
    params = bandit.default_params
    contexts = np.asarray(
        jax.vmap(lambda k: bandit.draw_context(k, params))(
            jax.random.split(jax.random.key(1), 8000)
        )
    )
    np.testing.assert_array_less(
        np.abs(contexts.mean(axis=0) - CENTER), 0.05 * contexts.std(axis=0)
    )
    np.testing.assert_allclose(np.cov(contexts.T), ROOT @ ROOT.T, rtol=0.06)
    reward = jax.vmap(bandit.mean_reward, in_axes=(0, 0, None))
    best = reward(states, policy(states), params)
    # Nearly 0, the distance's own floor of sqrt(1e-4).
    np.testing.assert_allclose(best, -0.01, atol=0.01)


def test_a_steep_policy_is_fitted_by_one_as_steep(states):
    # Nearly half of the actions are at an end of their range, where 32 bits do not tell how far beyond.
    inside = 12 * ((states - CENTER) @ KERNEL + BIAS)
    actions = np.tanh(inside.astype(np.float32))
    assert 0.3 < np.mean(np.abs(actions) > 0.999) < 0.8
    ends = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    reward = fitted(states, actions, *ends)["reward"]
    np.testing.assert_allclose(reward["kernel"], 12 * KERNEL, rtol=0.02, atol=0.01)
    # Of a policy that is a sign nothing is known but the sides.
    sides = fitted(states, np.sign(inside), *ends)["reward"]
    told = (states - sides["center"]) @ sides["kernel"] + sides["bias"]
    assert np.isfinite(sides["kernel"]).all() and np.mean(np.sign(told) == np.sign(inside)) > 0.99


def test_the_reward_is_the_distance_in_halves_of_the_range(bandit):
    best = policy(CENTER[None])[0]
    off = best + np.array([0.3, -0.8])
    reward = float(bandit.mean_reward(jnp.asarray(CENTER, jnp.float32), off, bandit.default_params))
    # (0.3 / 1, 0.8 / 2) is 0.5 away.
    assert reward == pytest.approx(-0.5, abs=0.01)
    weights = dict(bandit.default_params.weights)
    weights["reward"] = {**weights["reward"], "log_power": jnp.log(2.0), "log_scale": jnp.log(3.0)}
    squared = float(
        bandit.mean_reward(jnp.asarray(CENTER, jnp.float32), off, bandit.params(weights))
    )
    assert squared == pytest.approx(-3 * 0.25, abs=0.02)


def test_units_are_what_moves_a_context_or_the_policy_by_as_much(bandit):
    units = bandit.units(bandit.default_params.weights)
    spread = np.array([10.0, 0.05])
    np.testing.assert_allclose(units["reward"]["center"], spread, rtol=0.05)
    kernel = units["initial_state"]["Dense_0"]["kernel"]
    np.testing.assert_allclose(kernel, np.tile(spread, (2, 1)), rtol=0.05)
    np.testing.assert_allclose(units["reward"]["kernel"][1], 20.0, rtol=0.05)
    networks = SyntheticBandit(2, SPACE)
    assert networks.units(networks.init_weights(jax.random.key(0))) is None


def test_a_file_gives_back_the_same_bandit(bandit, tmp_path):
    path = tmp_path / "Synthetic-Pair.npz"
    save_bandit(path, bandit, bandit.default_params.weights)
    loaded = load_bandit(path)
    assert loaded.config == BanditConfig(form="linear", latent_size=2)
    context, action = jnp.array([1.0, 0.1]), jnp.array([0.5, 3.0])
    same = [b.mean_reward(context, action, b.default_params) for b in (bandit, loaded)]
    assert same[0] == same[1]


@pytest.mark.parametrize("second", [0.0, 1.6])
def test_one_action_that_is_held_is_fitted_too(states, second):
    held = np.tile(np.array([1.0, second], np.float32), (len(states), 1))
    dataset = ExpertDataset(jnp.asarray(states), held[:, None], jnp.zeros((len(states), 1)), held)
    bandit = SyntheticBandit(2, SPACE, LINEAR)
    weights, report = fit_bandit(bandit, dataset, jax.random.key(0))
    assert report == {"action_r2": 1.0}  # there is nothing to explain
    reward = jax.vmap(bandit.mean_reward, in_axes=(0, None, None))
    # Nearly 0 there in every context; at the other end of the second action, so many halves of its range away, less.
    for action, worth in (([1.0, second], 0.0), ([1.0, 4.0], (second - 4) / 2)):
        earned = reward(states, jnp.array(action), bandit.params(weights))
        np.testing.assert_allclose(earned, worth, atol=0.02)


@pytest.mark.slow
def test_without_generations_the_fit_is_the_result():
    config = pendulum_config(num_generations=0)
    problem, outcome = discover(config, quiet=True)
    start = problem.initial_solution(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, outcome.mean, start)
    assert outcome.cost(problem, config.evolution, False)["environment_steps_training"] == 0


def test_a_constant_in_its_reward_is_scaled_with_it(bandit):
    weights = bandit.default_params.weights
    weights = {**weights, "reward": {**weights["reward"], "offset": jnp.float32(2.0)}}
    context, action = jnp.asarray(CENTER, jnp.float32), jnp.array([0.7, 1.0])
    reward, other = (
        float(bandit.mean_reward(context, action, bandit.params(x)))
        for x in (weights, bandit.with_reward(weights, 3.0, 1.0))
    )
    assert other == pytest.approx(3 * reward + 1, abs=1e-5)


def test_its_reward_can_be_given_another_scale(bandit):
    weights = standardize_reward(bandit, bandit.default_params.weights, 3.0)
    rewards = bandit.sample_rewards(bandit.params(weights), jax.random.key(5), 4000)
    assert float(rewards.std()) == pytest.approx(3.0, rel=0.05)
    assert float(rewards.mean()) == pytest.approx(0.0, abs=0.2)


def test_the_contexts_of_one_that_a_search_starts_from_are_widened(tmp_path):
    path, bandit = tmp_path / "start.npz", bandit_for(*make("Pendulum-v1"), LINEAR, "start")
    weights = bandit.init_weights(jax.random.key(3))
    save_bandit(path, bandit, weights)
    config = DiscoveryConfig(start=str(path), bandit=LINEAR)
    # That is something to be found before the first generation.
    evolution = EvolutionConfig(num_generations=0)
    wide = replace(config, warm_start=WarmStartConfig(stretch=2.0, jitter=1.0), evolution=evolution)
    with pytest.raises(UserError, match="0 generations, and nothing is found before them"):
        replace(config, evolution=evolution)
    before, after = (BanditDiscovery(c).initial_solution(jax.random.key(0)) for c in (config, wide))
    jax.tree.map(np.testing.assert_array_equal, after["reward"], before["reward"])
    own, other = (
        np.asarray(w["initial_state"]["Dense_0"]["kernel"], np.float64) for w in (before, after)
    )
    # Twice the deviations, of independent entries once more: variances times 5, covariances times 4.
    expected = np.where(np.eye(3), 5.0, 4.0) * (own.T @ own)
    np.testing.assert_allclose(other.T @ other, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(*(w["initial_state"]["Dense_0"]["bias"] for w in (before, after)))
    for changes in ({"expert": "linear"}, {"min_spread": 1.0}):
        with pytest.raises(UserError, match="and nothing is fitted to an expert"):
            replace(config, warm_start=WarmStartConfig(**changes))
    with pytest.raises(UserError, match=r"jitter.* is 1.0, and nothing is fitted to an expert"):
        DiscoveryConfig(start="Synthetic-Pendulum-v1", warm_start=WarmStartConfig(jitter=1.0))


def pendulum_config(**changes):
    return DiscoveryConfig(
        bandit=LINEAR,
        agents_per_candidate=1,
        evaluation_episodes=1,
        warm_start=WarmStartConfig(expert="linear", expert_generations=2, num_states=256),
        evolution=EvolutionConfig(
            population_size=4,
            sigma=0.1,
            mean_evaluations=2,
            **{"strategy": "SNES", "num_generations": 2, **changes},
        ),
    )


def pendulum(**changes):
    config = pendulum_config(**changes)
    return discover(config, quiet=True)


@pytest.mark.slow
def test_one_is_fitted_to_an_expert_and_evolved():
    problem, outcome = pendulum()
    assert problem.start_reports["warm_start"]["action_r2"] > 0.99
    start = problem.initial_solution(jax.random.key(0))
    moved = jax.tree.map(lambda a, b: np.abs(a - b), outcome.mean, start)
    units = problem.units(start)
    # SNES moves every number by some of its deviations, 0.1 units each.
    steps = jax.tree.leaves(jax.tree.map(lambda d, u: d / u, moved, units))
    assert all((step > 0).all() and (step < 1).all() for step in steps)


@pytest.mark.slow
def test_a_run_looks_for_its_expert_once(tmp_path, monkeypatch):
    config = pendulum_config()
    run = Run.open(tmp_path / "run", config_dict(config))
    first, outcome = discover(config, run, quiet=True)
    monkeypatch.delattr("scb.discovery.warm_start")
    run = Run.open(tmp_path / "run", config_dict(config), resume=True)
    resumed, again = discover(config, run, quiet=True)
    jax.tree.map(np.testing.assert_array_equal, again.mean, outcome.mean)
    assert resumed.start_reports == first.start_reports
    start = first.initial_solution(jax.random.key(0))
    kept = load_bandit(tmp_path / "run" / "warm_start.npz")
    jax.tree.map(np.testing.assert_array_equal, kept.default_params.weights, start)


def test_a_strategy_with_one_deviation_for_all_is_refused():
    with pytest.raises(UserError, match="Open_ES has one deviation for all weights"):
        pendulum(strategy="Open_ES")


def test_what_a_linear_bandit_cannot_be_is_refused():
    env, params = make("CartPole-v1")
    with pytest.raises(UserError, match="discrete actions, and a linear bandit continuous ones"):
        bandit_for(env, params, LINEAR, "Synthetic-CartPole-v1")
    env, params = make("Pendulum-v1")
    with pytest.raises(
        UserError, match="form is linear, a bandit's, and parameterization TI is none"
    ):
        synthetic_for(env, params, "TI", LINEAR, "x")
    with pytest.raises(UserError, match="unknown bandit form 'liner': did you mean linear"):
        BanditConfig(form="liner")
    dataset = ExpertDataset(*[jnp.zeros((4, 1))] * 4)
    with pytest.raises(UserError, match="the construction is q, and a linear bandit's reward"):
        fit_bandit(SyntheticBandit(2, SPACE, LINEAR), dataset, jax.random.key(0), "q")
