from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

from scb import fitting, warm_start
from scb.agents.dqn import DQNConfig
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import ALGORITHMS, AgentSpec, environment_agent
from scb.agents.td3 import TD3Config
from scb.aggregation import Visited
from scb.curriculum import CurriculumConfig
from scb.environments.registry import make
from scb.environments.spec import EnvironmentSpec
from scb.environments.synthetic import BanditConfig, BanditParams, SyntheticBandit, bandit_for
from scb.errors import UserError
from scb.expert_data import DatasetConfig, _stretched, expert_dataset, labelled
from scb.experts import Expert, judged, train_expert
from scb.fitting import ExpertDataset, energy_distance, fit_bandit, reward_targets, unchanging
from scb.keys import root_key
from scb.linear_expert import erring, noisy
from scb.measurement import Place
from scb.warm_start import WarmStartConfig, expert_agent, find_expert
from tests.scb.probes import ContinuousCorridor, Corridor, CorridorParams, context_bandit

TINY = PPOConfig(
    num_envs=2, num_steps=8, num_epochs=1, num_minibatches=1, total_steps=16, hidden_sizes=(4,)
)


def normal(seed, size, shift=0.0):
    return np.random.default_rng(seed).normal(size=(size, 2)).astype(np.float32) + shift


distance = jax.jit(energy_distance)


# -- the distance between two samples
# -----------------------------------------------------------------


def test_energy_distance_by_hand():
    # a = {0, 2}, b = {1, 5}. Between: (1 + 5 + 1 + 3) / 4 = 2.5; within a: 2, within b: 4.
    # 2 * 2.5 - 2 - 4 = -1: unbiased, so it can be negative where the samples are small.
    a, b = np.array([[0.0], [2.0]]), np.array([[1.0], [5.0]])
    assert float(distance(a, b)) == pytest.approx(-1.0, abs=1e-4)
    # Points in the plane: (0, 0) twice and (3, 4) twice are 5 apart, 2 * 5 - 0 - 0.
    far = distance(np.zeros((2, 2)), np.tile([3.0, 4.0], (2, 1)))
    assert float(far) == pytest.approx(10.0, abs=1e-4)


def test_energy_distance_of_samples_of_one_distribution_is_zero_on_average():
    distances = [float(distance(normal(2 * i, 100), normal(2 * i + 1, 100))) for i in range(40)]
    error = np.std(distances) / np.sqrt(40)
    assert abs(np.mean(distances)) < 4 * error < 0.02


@pytest.mark.parametrize("scale_b", [0.5, 2.0])
def test_energy_distance_sees_a_shift_and_a_spread(scale_b):
    same = distance(normal(0, 500), normal(1, 500))
    assert distance(normal(0, 500), normal(1, 500, shift=0.5)) > same + 0.1
    assert distance(normal(0, 500), scale_b * normal(1, 500)) > same + 0.1


def test_energy_distance_has_a_finite_gradient_where_points_coincide():
    gradient = jax.jit(jax.grad(energy_distance))(np.zeros((3, 2)), np.zeros((3, 2)))
    assert np.isfinite(gradient).all()


# -- reward targets
# -----------------------------------------------------------------------------------


def target(construction, discrete, action, q, expert_action):
    dataset = ExpertDataset(
        np.zeros((len(q), 1)), np.array(action), np.array(q), np.array(expert_action)
    )
    return np.asarray(reward_targets(dataset, construction, discrete))


def test_the_q_construction_is_q_standardised():
    # Q = 1 2 3 6: mean 3, deviations -2 -1 0 3, variance (4 + 1 + 0 + 9) / 4 = 3.5.
    actual = target("q", True, [[0, 1], [0, 1]], [[1.0, 2.0], [3.0, 6.0]], [1, 1])
    np.testing.assert_allclose(actual, np.array([[-2, -1], [0, 3]]) / np.sqrt(3.5), rtol=1e-5)


def test_the_advantage_construction_is_q_below_each_states_best():
    # Q - max: -1 0 | -3 0, mean -1, variance (0 + 1 + 4 + 1) / 4 = 1.5. The best action of every
    # state has reward 0, however good the state is.
    actual = target("advantage", True, [[0, 1], [0, 1]], [[1.0, 2.0], [3.0, 6.0]], [1, 1])
    np.testing.assert_allclose(actual, np.array([[-1, 0], [-3, 0]]) / np.sqrt(1.5), rtol=1e-5)


def test_the_action_distance_of_discrete_actions_is_one_where_the_expert_acts_so():
    # State 0's expert takes 1, state 1's takes 0: 0 1 | 1 0, deviation 1/2.
    actual = target("action_distance", True, [[0, 1], [0, 1]], [[9.0, 9.0], [9.0, 9.0]], [1, 0])
    np.testing.assert_allclose(actual, [[0, 2], [2, 0]], rtol=1e-5)


def test_the_action_distance_of_continuous_actions_is_euclidean():
    # Expert (1, 1) and (0, 0). Distances: to (1, 1) 0, to (4, 5) 5; to (0, 1) 1, to (0, -2) 2.
    # -(0 5 1 2): mean -2, variance (4 + 9 + 1 + 0) / 4 = 3.5.
    actions = [[[1.0, 1.0], [4.0, 5.0]], [[0.0, 1.0], [0.0, -2.0]]]
    actual = target("action_distance", False, actions, np.zeros((2, 2)), [[1.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(actual, -np.array([[0, 5], [1, 2]]) / np.sqrt(3.5), rtol=1e-5)


# -- the expert's dataset
# -----------------------------------------------------------------------------


def idle(space):
    """An expert whose action is 0 everywhere."""
    action = jnp.zeros(space.shape, space.dtype)
    return Expert(lambda observation: action, mean_return=0.0, environment_steps=0)


@pytest.fixture(scope="module")
def corridor_dataset():
    # Three cells, then the end; action 0 pays 1, 2, 4 and action 1 pays 10, 20, 40.
    params = CorridorParams(rewards=jnp.array([[1.0, 10], [2, 20], [4, 40]]), random_start=1)
    config = WarmStartConfig(construction="q", discount=0.5, num_states=64, horizon=10)
    env = Corridor()
    dataset, steps = expert_dataset(
        idle(env.action_space(params)), Place(env.name, env, params), jax.random.key(1), config
    )
    return jax.tree.map(np.asarray, dataset), steps, params


def test_q_values_are_those_of_acting_once_and_then_following_the_expert(corridor_dataset):
    # The expert takes 0 everywhere. V(2) = 4, V(1) = 2 + 4/2 = 4, V(0) = 1 + 4/2 = 3; the first
    # action's own reward in front: Q(2, .) = 4 40, Q(1, .) = 2 + V(2)/2 = 4 and 20 + 2 = 22, Q(0,
    # .) = 1 + V(1)/2 = 3 and 10 + 2 = 12. Nothing is earned after the end, though the corridor
    # would go on.
    dataset, _, _ = corridor_dataset
    by_hand = np.array([[3.0, 12.0], [4.0, 22.0], [4.0, 40.0]])
    cell = dataset.observation.argmax(axis=1)
    np.testing.assert_allclose(dataset.q, by_hand[cell], rtol=1e-6)
    np.testing.assert_array_equal(dataset.action, np.tile([0, 1], (64, 1)))
    np.testing.assert_array_equal(dataset.expert_action, 0)
    assert set(cell) == {0, 1, 2}


def test_the_datasets_steps_are_counted(corridor_dataset):
    # 256 trajectories of 100 steps (the environment's limit), and 64 states x 2 actions x 10 steps.
    assert corridor_dataset[1] == 256 * 100 + 64 * 2 * 10


def test_the_action_distance_asks_the_expert_only_and_simulates_no_q_values():
    env, params = Corridor(), CorridorParams(random_start=1)
    dataset, steps = expert_dataset(
        idle(env.action_space(params)),
        Place(env.name, env, params),
        jax.random.key(1),
        WarmStartConfig(construction="action_distance", num_states=16),
    )
    assert steps == 256 * 100
    np.testing.assert_array_equal(dataset.expert_action, 0)
    # The expert takes 0 everywhere: of the two actions the first is right, half of all; deviation 1/2.
    target = reward_targets(dataset, "action_distance", discrete=True)
    np.testing.assert_allclose(target, np.tile([2.0, 0.0], (16, 1)), rtol=1e-5)


@pytest.fixture(scope="module")
def noisy_dataset():
    """Of the pendulum, whose torques lie in [-2, 2] and whose expert holds 0.5."""
    env, params = make("Pendulum-v1")
    half = Expert(lambda observation: jnp.full(1, 0.5), mean_return=0.0, environment_steps=0)
    config = WarmStartConfig(expert_noise=0.1, num_states=512, num_actions=11)
    return expert_dataset(half, Place(env.name, env, params), jax.random.key(4), config)[0]


def test_tried_actions_are_the_experts_and_uniform_ones(noisy_dataset):
    tried = np.asarray(noisy_dataset.action)[..., 0]
    np.testing.assert_array_equal(tried[:, 0], 0.5)
    assert tried[:, 1:].std() == pytest.approx(4 / np.sqrt(12), rel=0.05)
    assert len(np.unique(tried[:, 1:])) > 512 * 9


def test_what_the_expert_does_there_is_without_noise(noisy_dataset):
    np.testing.assert_array_equal(noisy_dataset.expert_action, 0.5)


class Echo(ContinuousCorridor):
    """Observes the action before, in an episode without end."""

    def step_env(self, key, state, action, params):
        _, state, reward, _, info = super().step_env(key, state, action, params)
        return jnp.full(self.cells, action[0]), state, reward, jnp.bool_(False), info


def test_states_are_those_that_the_expert_visits_under_noise():
    env = Echo(cells=1)
    params = env.default_params.replace(max_steps_in_episode=1000)
    config = WarmStartConfig(expert_noise=0.2, num_states=2048)
    dataset, _ = expert_dataset(
        idle(env.action_space(params)), Place(env.name, env, params), jax.random.key(3), config
    )
    # The expert's 0 with a deviation of 0.2 times half of a range of 3; one in 200 is a start.
    assert np.std(dataset.observation) == pytest.approx(0.3, rel=0.1)


def test_an_episodes_errors_are_a_function_of_where_it_is():
    env = Echo(cells=1)
    params = env.default_params.replace(max_steps_in_episode=50)
    config = WarmStartConfig(expert_errors=0.5, num_states=256 * 50)
    place = Place(env.name, env, params)
    dataset, _ = expert_dataset(idle(env.action_space(params)), place, jax.random.key(3), config)
    seen = np.asarray(dataset.observation)[:, 0]
    # Every episode starts in one place, and errs there by its own function: 256 numbers after the first step.
    # The expert says 0 wherever that leads.
    start, counts = np.unique(seen, return_counts=True)
    assert counts.max() >= 256 and len(start) > 256
    np.testing.assert_array_equal(dataset.expert_action, 0.0)
    spread = np.std(seen)
    assert 0.02 < spread < 0.5


def test_errors_are_made_where_an_expert_goes_before_the_clip():
    # Twenty halves of the range beyond its end no error of this size is seen; at the end of the range some are.
    env = Echo(cells=1)
    params = env.default_params.replace(max_steps_in_episode=20)
    config = WarmStartConfig(expert_errors=0.5, num_states=2000)
    place = Place(env.name, env, params)

    def visited(reaching):
        expert = Expert(lambda observation: jnp.full(1, 2.0), 0.0, 0, reaching)
        dataset, _ = expert_dataset(expert, place, jax.random.key(3), config)
        return np.unique(dataset.observation)

    # A start is 1, and every other state the action that led there.
    np.testing.assert_array_equal(visited(lambda observation: jnp.full(1, 30.0)), [1.0, 2.0])
    assert len(visited(None)) > 100


def test_errors_grow_with_the_scale_and_stay_the_same_in_a_place():
    space = make("Pendulum-v1")[0].action_space()  # -2 to 2
    places = jax.random.normal(jax.random.key(0), (100, 3))

    def errors(scale, key):
        off = erring(lambda observation: jnp.zeros(1), 3, space, scale, key)
        return np.asarray(jax.vmap(noisy(off, space, 0.0), in_axes=(0, None))(places, key))

    small, again, large, other = (
        errors(scale, jax.random.key(key))
        for scale, key in ((0.1, 1), (0.1, 1), (0.2, 1), (0.1, 2))
    )
    np.testing.assert_array_equal(small, again)
    np.testing.assert_allclose(large, 2 * small, rtol=1e-4, atol=1e-6)
    # Not a factor of the others: another function, not only another scale.
    assert abs(np.corrcoef(small[:, 0], other[:, 0])[0, 1]) < 0.99
    assert (np.abs(errors(100.0, jax.random.key(1))) <= 2).all()


def test_the_horizon_cuts_the_return():
    # Two steps: Q(0, .) = 1 + 2/2 = 2 and 10 + 1 = 11; Q(1, .) = 2 + 4/2 = 4 and 22.
    params = CorridorParams(rewards=jnp.array([[1.0, 10], [2, 20], [4, 40]]))
    config = WarmStartConfig(construction="q", discount=0.5, num_states=16, horizon=2)
    env = Corridor()
    dataset, _ = expert_dataset(
        idle(env.action_space(params)), Place(env.name, env, params), jax.random.key(1), config
    )
    by_hand = np.array([[2.0, 11.0], [4.0, 22.0], [4.0, 40.0]])
    np.testing.assert_allclose(dataset.q, by_hand[np.argmax(dataset.observation, axis=1)])


@pytest.fixture(scope="module")
def bandit_dataset():
    """Of the context bandit, whose Q is its reward: -|action - context|."""
    bandit = context_bandit()
    config = WarmStartConfig(construction="q", num_states=256, num_actions=8, horizon=3)
    expert = idle(bandit.action_space())
    return expert_dataset(
        expert, Place(bandit.name, bandit, bandit.default_params), jax.random.key(2), config
    )[0]


def test_continuous_actions_are_the_experts_and_random_ones_within_the_bounds(bandit_dataset):
    action = np.asarray(bandit_dataset.action)
    assert action.shape == (256, 8, 1) and bandit_dataset.q.shape == (256, 8)
    np.testing.assert_array_equal(action[:, 0], bandit_dataset.expert_action)
    np.testing.assert_array_equal(bandit_dataset.expert_action, 0.0)
    others = action[:, 1:]
    assert others.min() >= -1.0 and others.max() <= 2.0 and len(np.unique(others)) > 1700
    np.testing.assert_allclose(
        bandit_dataset.q, -np.abs(action[..., 0] - bandit_dataset.observation), atol=1e-6
    )


# -- stretched states
# ---------------------------------------------------------------------------------


def follow_the_context(observation):
    """[1] observation -> the context bandit's best action, within its bounds of -1 and 2."""
    return jnp.clip(observation, -1.0, 2.0)


@cache
def contexts(min_spread, **more):
    bandit = context_bandit()
    size = {"num_states": 256, "num_actions": 4}
    config = WarmStartConfig(**size, min_spread=min_spread, **more)
    expert = judged(follow_the_context, bandit, bandit.default_params, jax.random.key(0))
    key = jax.random.key(2)
    return expert_dataset(expert, Place(bandit.name, bandit, bandit.default_params), key, config)[0]


@pytest.mark.parametrize("dtype", [jnp.bool_, jnp.uint8])
def test_observations_that_are_no_floats_become_such(dtype):
    bandit = context_bandit()
    place = Place(bandit.name, bandit, bandit.default_params)
    expert = judged(follow_the_context, bandit, bandit.default_params, jax.random.key(0))
    seen = jnp.tile(jnp.arange(2), 50).reshape(10, 10, 1).astype(dtype)
    visited = Visited(jnp.zeros((10, 10)), seen)
    keys = jax.random.split(jax.random.key(1))
    dataset, _ = labelled(expert, place, visited, *keys, DatasetConfig(num_states=100, jitter=0.5))
    assert dataset.observation.dtype == jnp.float32
    assert len(np.unique(dataset.observation)) > 2  # jittered about 0 and 1
    assert not unchanging(dataset.observation).any()


@pytest.mark.parametrize("min_spread", [1.0, 3.0])
def test_an_entry_that_scatters_less_is_stretched_about_its_mean(min_spread):
    # Contexts are uniform in [0, 1]: their deviation of 0.29 is too small for either.
    plain, stretched = contexts(0.0), contexts(min_spread)
    before, after = (np.asarray(x.observation) for x in (plain, stretched))
    assert after.std() == pytest.approx(min_spread, rel=1e-4)
    assert after.mean() == pytest.approx(before.mean(), abs=1e-4)
    # A linear map that keeps the order: the same states, further apart.
    factor = min_spread / before.std()
    np.testing.assert_allclose(after, before.mean() + factor * (before - before.mean()), atol=1e-4)


def test_an_entry_that_scatters_enough_is_left_as_it_is():
    plain, stretched = contexts(0.0), contexts(0.1)
    np.testing.assert_allclose(stretched.observation, plain.observation, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, 0.1, -0.7, 9.81])
def test_an_entry_that_never_changes_is_not_stretched(value):
    states = jax.random.normal(jax.random.key(0), (4096, 2)).at[:, 1].set(value)
    stretched = _stretched(states, jax.random.key(1), DatasetConfig(min_spread=3.0, jitter=1.0))
    np.testing.assert_allclose(stretched[:, 1], value, rtol=1e-5)
    assert stretched[:, 0].std() > 3.0


@pytest.mark.parametrize("min_spread", [0.0, 1.0, 3.0])
def test_the_label_of_a_state_is_the_experts_action_in_that_very_state(min_spread):
    dataset = contexts(min_spread)
    np.testing.assert_array_equal(
        dataset.expert_action, np.clip(np.asarray(dataset.observation), -1.0, 2.0)
    )
    # It is also the first of the tried actions, so it is the one with the highest reward.
    np.testing.assert_array_equal(dataset.action[:, 0], dataset.expert_action)
    target = np.asarray(reward_targets(dataset, "action_distance", discrete=False))
    np.testing.assert_array_equal(target.argmax(axis=1), 0)


def test_jitter_widens_entries_by_noise_of_their_own():
    plain, jittered = contexts(0.0), contexts(0.0, jitter=2.0)
    before, after = (np.asarray(x.observation) for x in (plain, jittered))
    # The same states: what was added has twice their deviation, and hangs together with nothing.
    added = (after - before)[:, 0]
    assert added.std() == pytest.approx(2 * before.std(), rel=0.1)
    assert abs(np.corrcoef(added, before[:, 0])[0, 1]) < 0.2
    np.testing.assert_allclose(jittered.expert_action, np.clip(after, -1, 2), atol=1e-6)


def test_jitter_is_in_deviations_of_what_was_given_the_least_one():
    plain, jittered = (contexts(3.0, jitter=x, stretch=2.0) for x in (0.0, 1.0))
    added = np.asarray(jittered.observation - plain.observation)[:, 0]
    assert added.std() == pytest.approx(3.0, rel=0.1)


def test_discrete_labels_follow_the_stretched_state_too():
    # The expert takes 1 where the cell's first entry exceeds 0.7. One-hot entries of 0 and 1 about a
    # mean of m, stretched by a factor, go to m - f m and m + f (1 - m): with m near 1/3, a deviation
    # near 0.47 and f = 2 / 0.47, cells 1 and 2 fall far below 0.7 and cell 0 rises far above.
    params = CorridorParams(random_start=1)
    env = Corridor()
    expert = Expert(lambda observation: jnp.int32(observation[0] > 0.7), 0.0, 0)
    config = WarmStartConfig(num_states=64, min_spread=2.0)
    dataset, _ = expert_dataset(expert, Place(env.name, env, params), jax.random.key(1), config)
    np.testing.assert_allclose(dataset.observation.std(axis=0), 2.0, rtol=1e-4)
    first = np.asarray(dataset.observation[:, 0])
    assert set(np.unique(first.round(3)).tolist()).isdisjoint({0.0, 1.0})
    np.testing.assert_array_equal(dataset.expert_action, first > 0.7)
    np.testing.assert_array_equal(dataset.action, np.tile([0, 1], (64, 1)))
    assert set(np.asarray(dataset.expert_action).tolist()) == {0, 1}


def test_an_entry_that_never_changes_stays_finite():
    # A corridor of one cell always shows [1].
    env = Corridor(cells=1)
    config = WarmStartConfig(num_states=8, min_spread=1.0)
    expert = idle(env.action_space(env.default_params))
    dataset, _ = expert_dataset(
        expert, Place(env.name, env, env.default_params), jax.random.key(1), config
    )
    np.testing.assert_array_equal(dataset.observation, 1.0)


# -- the fit
# ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(bandit_dataset):
    bandit = SyntheticBandit(1, context_bandit().action_space(), BanditConfig(hidden_size=8))
    config = WarmStartConfig(construction="q", fit_steps=1000)
    return bandit, *fit_bandit(
        bandit, bandit_dataset, jax.random.key(3), config.construction, config.fit_steps
    )


def test_a_reward_that_the_network_can_represent_is_fitted(fitted, bandit_dataset):
    bandit, weights, report = fitted
    assert report["reward_r2"] > 0.9
    # The report is about these weights: measured anew, the explained variance is the same.
    predict = jax.jit(jax.vmap(jax.vmap(bandit.mean_reward, (None, 0, None)), (0, 0, None)))
    predicted = predict(
        bandit_dataset.observation, bandit_dataset.action, BanditParams(weights=weights)
    )
    wanted = reward_targets(bandit_dataset, "q", discrete=False)
    r2 = 1 - float(jnp.mean((predicted - wanted) ** 2) / wanted.var())
    assert r2 == pytest.approx(report["reward_r2"], abs=0.03)


def test_the_contexts_are_fitted_to_the_states(fitted, bandit_dataset):
    bandit, weights, report = fitted
    assert abs(report["energy_distance"]) < 0.02
    params = BanditParams(weights=weights)
    contexts, _ = jax.jit(jax.vmap(bandit.reset, (0, None)))(
        jax.random.split(jax.random.key(4), 1000), params
    )
    # Uniform in [0, 1]: mean 1/2, deviation sqrt(1/12) = 0.289.
    assert float(contexts.mean()) == pytest.approx(0.5, abs=0.08)
    assert float(contexts.std()) == pytest.approx(0.289, abs=0.06)


@pytest.mark.slow
def test_an_entry_that_never_changes_leaves_the_others_theirs(bandit_dataset):
    size, dataset = 4, jax.tree.map(jnp.asarray, bandit_dataset)
    spread = jnp.array([2.0, 0.0, 0.5, 1.0])
    at = jnp.array([0.0, 9.81, -3.0, 1.0])
    states = at + spread * jax.random.normal(jax.random.key(6), (len(dataset.observation), size))
    bandit = SyntheticBandit(size, spaces.Box(-1.0, 1.0, (1,)), BanditConfig(hidden_size=16))
    weights, report = fit_bandit(
        bandit, dataset._replace(observation=states), jax.random.key(0), "q", steps=1500
    )
    assert report["energy_distance"] < 0.05
    contexts, _ = jax.jit(jax.vmap(bandit.reset, (0, None)))(
        jax.random.split(jax.random.key(4), 1000), BanditParams(weights=weights)
    )
    np.testing.assert_allclose(contexts.mean(axis=0), at, atol=0.3)
    np.testing.assert_allclose(contexts.std(axis=0), spread, atol=0.3)
    np.testing.assert_allclose(contexts[:, 1], 9.81, rtol=1e-6)


def test_another_dataset_of_the_size_needs_no_new_program(fitted, bandit_dataset, monkeypatch):
    def traced_again(*_):
        raise AssertionError("the program is made anew")

    monkeypatch.setattr(fitting.optax, "adam", traced_again)
    bandit, _, before = fitted
    other = bandit_dataset._replace(observation=bandit_dataset.observation[::-1])
    _, report = fit_bandit(bandit, other, jax.random.key(3), "q", 1000)
    assert report["reward_r2"] != before["reward_r2"]


def test_the_fitted_weights_are_a_bandits(fitted):
    bandit, weights, _ = fitted
    shapes = {
        f"{network}/{layer}/{name}": array.shape
        for network, layers in weights.items()
        for layer, arrays in layers.items()
        for name, array in arrays.items()
    }
    assert shapes == bandit.weight_shapes()


def test_a_discrete_bandit_is_fitted_too(corridor_dataset):
    dataset, _, params = corridor_dataset
    bandit = bandit_for(Corridor(), params, BanditConfig(hidden_size=8), "Synthetic-Corridor")
    config = WarmStartConfig(construction="action_distance", fit_steps=300)
    dataset = jax.tree.map(jnp.asarray, dataset)
    weights, report = fit_bandit(
        bandit, dataset, jax.random.key(5), config.construction, config.fit_steps
    )
    assert report["reward_r2"] > 0.9
    # The expert's action 0 is the better one in every cell.
    params = BanditParams(weights=weights)
    reward = jax.jit(lambda context, action: bandit.mean_reward(context, action, params))
    for context in np.eye(3):
        assert reward(context, 0) > reward(context, 1)


# -- the expert
# ---------------------------------------------------------------------------------------


def test_the_expert_is_the_best_of_those_that_were_trained():
    # Ten cells, in each of which action 1 pays 1: an agent after one batch earns 5, give or take 1.6.
    # One in six earns 7 or more, but of 32 all but one in 400 times somebody does.
    env, key = Corridor(cells=10), jax.random.key(0)
    params = CorridorParams(rewards=jnp.tile(jnp.array([0.0, 1.0]), (10, 1)), last=9)
    spec = AgentSpec("ppo", TINY, PPOHyperparameters())
    best = train_expert(env, params, spec, key, 32)
    assert best.mean_return >= 7
    # 32 agents with one batch of 2 x 8 steps, each judged by 20 episodes of at most 100, the best by 20 more.
    assert best.environment_steps == 32 * (16 + 20 * 100) + 20 * 100
    # The agent that is handed out earns what it says.
    actions = jax.jit(jax.vmap(best.policy))(np.eye(10))
    assert actions.sum() == best.mean_return


@pytest.mark.parametrize(
    ("name", "algorithm"),
    [
        ("Pendulum-v1", "ppo"),
        ("hopper", "ppo"),
        ("humanoidstandup", "ppo"),
        ("CartPole-v1", None),
        ("MountainCar-v0", None),
        ("MountainCarContinuous-v0", None),
        ("reacher", None),
    ],
)
def test_an_expert_is_ppos_where_it_has_a_setting_of_its_own_and_evolutions_elsewhere(
    name, algorithm
):
    setting = expert_agent(name, spaces.Box(-1.0, 1.0, (1,), jnp.float32), WarmStartConfig())
    assert (setting is None) == (algorithm is None)
    if setting is not None:
        assert isinstance(setting.config, PPOConfig)


def test_experts_are_trained_as_the_environment_is_but_for_pendulums_discount():
    def of(name, **arguments):
        env, env_params = make(name)
        return expert_agent(name, env.action_space(env_params), WarmStartConfig(**arguments))

    assert of("Pendulum-v1").hyperparameters.discount == 0.95
    assert environment_agent("ppo", "Pendulum-v1").hyperparameters.discount == 0.995
    assert of("Pendulum-v1", expert="sac") == environment_agent("sac", "Pendulum-v1")
    assert of("CartPole-v1", expert="ppo") == environment_agent("ppo", "CartPole-v1")
    assert of("CartPole-v1", expert="ppo", expert_steps=3000).config.num_iterations == 3
    assert isinstance(of("CartPole-v1", expert="ddqn").config, DQNConfig)
    assert isinstance(of("Pendulum-v1", expert="ddpg").config, TD3Config)
    assert of("Pendulum-v1", expert="evolution") is None


def test_every_expert_has_an_environment_that_it_fits():
    for expert in ("auto", "evolution", *ALGORITHMS):
        for name in ("Pendulum-v1", "CartPole-v1"):
            env, env_params = make(name)
            space = env.action_space(env_params)
            config = WarmStartConfig(expert=expert)
            fits = {"dqn": "CartPole-v1", "ddqn": "CartPole-v1"}
            fits |= {"ddpg": "Pendulum-v1", "td3": "Pendulum-v1"}
            if fits.get(expert, name) == name:
                expert_agent(name, space, config)
            else:
                with pytest.raises(UserError, match=f"{expert} does not fit the environment's"):
                    expert_agent(name, space, config)


def test_a_linear_search_leaves_out_what_standing_still_earns_and_is_told_the_rest(
    monkeypatch, tmp_path
):
    seen = []
    monkeypatch.setattr(warm_start, "search_linear_expert", lambda *given: seen.append(given))
    # Of Hopper's name, where standing still earns 1000, with an episode of 200 steps.
    place = Place("hopper", *make("Pendulum-v1"))

    def worth(expert, key):
        return 0.0, 0

    find_expert(place, root_key(0), WarmStartConfig(expert="linear"), True, worth, tmp_path)
    assert seen[0][4:] == (5.0, True, worth, tmp_path)


def test_the_best_of_so_many_experts_is_asked_for(monkeypatch):
    seen = []
    monkeypatch.setattr(warm_start, "train_expert", lambda *given: seen.append(given[4]))
    config = WarmStartConfig(expert="ppo", num_experts=3)
    find_expert(Place.named("Pendulum-v1"), root_key(0), config)
    assert seen == [3]


def test_an_expert_is_compared_with_random_actions_in_the_same_physics(monkeypatch):
    asked = []

    def random_return(spec, backend=None):
        asked.append(backend)
        return 0.0

    monkeypatch.setattr(EnvironmentSpec, "random_return", random_return)
    expert = Expert(lambda observation: observation[1:2], -1.0, 7)
    monkeypatch.setattr(warm_start, "find_expert", lambda *given: expert)
    place = Place("hopper", *make("Pendulum-v1"), "spring")
    bandit = bandit_for(place.env, place.params, BanditConfig(), "Synthetic-Pendulum-v1")
    with pytest.raises(UserError, match="earns -1 and random actions 0"):
        warm_start.warm_start(bandit, {}, place, root_key(0), WarmStartConfig())
    assert asked == ["spring"]


def test_a_fit_is_made_as_asked_and_an_earlier_searchs_seconds_count(monkeypatch):
    expert = Expert(lambda observation: observation[1:2], -1000.0, 7, earlier_seconds=1e4)
    monkeypatch.setattr(warm_start, "find_expert", lambda *given: expert)
    made = []

    def fit(*given, **settings):
        made.append(settings)
        return {}, {}

    monkeypatch.setattr(warm_start, "fit_bandit", fit)
    place = Place.named("Pendulum-v1")
    bandit = bandit_for(place.env, place.params, BanditConfig(), "Synthetic-Pendulum-v1")
    config = WarmStartConfig("q", num_states=8, num_actions=2, horizon=2, fit_steps=7)
    _, report = warm_start.warm_start(bandit, {}, place, root_key(0), config)
    assert made == [{"construction": "q", "steps": 7}]
    assert report["seconds"] >= 1e4


def test_evolution_gets_the_papers_curriculum_at_its_own_length(monkeypatch):
    # MountainCar: 1000 steps until generation 200, 200 from generation 800 on, of 1000 generations.
    # Of 80 that is until generation 16, and a transition of 48.
    seen = []
    monkeypatch.setattr("scb.warm_start.evolve_expert", lambda *arguments: seen.append(arguments))
    for name in ("MountainCar-v0", "CartPole-v1"):
        find_expert(Place.named(name), jax.random.key(0), WarmStartConfig())
    searches = [arguments[2] for arguments in seen]
    assert searches[0].curriculum == CurriculumConfig("linear", 1000, 200, begin=16, transition=48)
    assert searches[1].curriculum is None
    assert [search.evolution.num_generations for search in searches] == [80, 80]


# -- configuration
# ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"construction": "Q"}, "unknown warm-start construction 'Q': did you mean q"),
        ({"num_experts": 0}, "num_experts is 0: it must be at least 1"),
        ({"num_states": 0}, "num_states is 0"),
        ({"num_actions": 1}, "num_actions is 1: it must be at least 2"),
        ({"aggregation_agents": 4}, "aggregation_agents is 4, and there are no aggregation rounds"),
        ({"expert_noise": -0.1}, "expert_noise is -0.1: it must be 0 or larger"),
        ({"expert_errors": -0.1}, "expert_errors is -0.1: it must be 0 or larger"),
        ({"jitter": -1.0}, "jitter is -1.0: it must be 0 or larger"),
        ({"jitter": 1.0, "construction": "q"}, "the construction q cannot use it: leave"),
        ({"horizon": 0}, "horizon is 0"),
        ({"fit_steps": 0}, "fit_steps is 0"),
        ({"expert_generations": 0}, "expert_generations is 0"),
        ({"expert": "pop"}, "unknown expert 'pop': did you mean ppo"),
        ({"min_spread": -1.0}, "min_spread is -1.0: it must be 0 or larger, and finite"),
        ({"min_spread": float("nan")}, "min_spread is nan: it must be 0 or larger, and finite"),
        ({"discount": 2.0}, "discount is 2.0: it must be between 0 and 1."),
        ({"min_spread": float("inf")}, "min_spread is inf: it must be 0 or larger, and finite"),
        ({"min_spread": 1.0, "construction": "q"}, "the construction q cannot use it: leave"),
        ({"min_spread": 1.0, "construction": "advantage"}, "construction advantage cannot use"),
    ],
)
def test_impossible_configurations_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        WarmStartConfig(**arguments)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("Pendulum-v1", {"expert": "dqn"}, "dqn does not fit the environment's continuous actions"),
        ("CartPole-v1", {"expert": "td3"}, "td3 does not fit the environment's discrete actions"),
        (
            "CartPole-v1",
            {"expert_steps": 9},
            "expert_steps is 9, and .* is found by evolution, which trains no agent",
        ),
        ("Pendulum-v1", {"expert_steps": 0}, "total_steps is 0"),
        ("Pendulum-v1", {"expert": "sac", "expert_steps": 10}, "prefill is 1000"),
    ],
)
def test_an_expert_that_cannot_be_trained_is_refused(name, arguments, message):
    env, env_params = make(name)
    with pytest.raises(UserError, match=message):
        expert_agent(name, env.action_space(env_params), WarmStartConfig(**arguments))


def test_an_action_space_of_one_number_has_scalar_shapes():
    # Pendulum's actions are [1]; a space of shape () must work as well.
    bandit = SyntheticBandit(1, spaces.Box(-1.0, 1.0, (), jnp.float32), BanditConfig(hidden_size=2))
    params = BanditParams(weights=bandit.init_weights(jax.random.key(0)))
    assert bandit.mean_reward(jnp.zeros(1), jnp.float32(0.5), params).shape == ()
