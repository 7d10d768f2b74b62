import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from scipy import stats

from scb.agents.hyperparameters import (
    PPO_INNER_LOOP,
    environment_setting,
    environment_settings,
    inner_loop_config,
    inner_loop_lists,
    sample_hyperparameters,
)
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.environments.registry import environment_names
from scb.errors import UserError

DRAWS, AGENTS = 2000, 3


@pytest.fixture(scope="module")
def draws():
    """[DRAWS, AGENTS] hyperparameters."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return jax.vmap(lambda key: sample_hyperparameters(key, PPO_INNER_LOOP, AGENTS))(keys)


@pytest.mark.parametrize("name", PPO_INNER_LOOP)
def test_every_agent_gets_every_value_of_a_list_equally_often(draws, name):
    for agent in np.asarray(getattr(draws, name)).T:
        values, counts = np.unique(agent, return_counts=True)
        np.testing.assert_array_equal(values, np.sort(np.float32(PPO_INNER_LOOP[name])))
        assert stats.chisquare(counts).pvalue > 1e-4


def test_hyperparameters_are_drawn_independently_of_each_other(draws):
    # Of the first agent, over all draws. The error of a correlation of 2000 pairs is 0.022.
    table = np.stack([getattr(draws, name)[:, 0] for name in PPO_INNER_LOOP])
    np.testing.assert_allclose(np.corrcoef(table), np.eye(len(table)), atol=0.09)


@pytest.mark.parametrize("name", PPO_INNER_LOOP)
def test_agents_share_the_values_out(draws, name):
    # Fewer agents than values: no two of them have the same one.
    assert all(len(set(draw.tolist())) == AGENTS for draw in np.asarray(getattr(draws, name)))


@pytest.mark.parametrize("number", [1, 5, 13])
def test_no_value_is_dealt_more_than_once_more_than_another(number):
    # 13 agents and 5 values: two or three agents each.
    drawn = sample_hyperparameters(jax.random.key(number), PPO_INNER_LOOP, number)
    for name, values in PPO_INNER_LOOP.items():
        array = np.asarray(getattr(drawn, name))
        assert array.shape == (number,)
        counts = [np.sum(array == np.float32(value)) for value in values]
        assert sum(counts) == number and max(counts) - min(counts) <= 1


def test_what_has_no_list_keeps_its_default():
    drawn = sample_hyperparameters(jax.random.key(0), {"discount": [0.5]}, 2)
    np.testing.assert_array_equal(drawn.discount, 0.5)
    nothing_drawn = sample_hyperparameters(jax.random.key(0), {}, 2)
    for name, default in vars(PPOHyperparameters()).items():
        np.testing.assert_array_equal(getattr(nothing_drawn, name), np.full(2, default, np.float32))
        if name != "discount":
            np.testing.assert_array_equal(getattr(drawn, name), getattr(nothing_drawn, name))


def test_the_order_of_the_lists_does_not_matter():
    backwards = dict(reversed(PPO_INNER_LOOP.items()))
    a, b = (sample_hyperparameters(jax.random.key(3), x, 4) for x in (PPO_INNER_LOOP, backwards))
    chex.assert_trees_all_equal(a, b)


def test_the_defaults_are_values_of_the_lists():
    # The paper underlines one value of each list; those are the defaults.
    for name, values in PPO_INNER_LOOP.items():
        assert getattr(PPOHyperparameters(), name) in values


def test_continuous_actions_drop_the_largest_learning_rate():
    # Liesen et al. (2024), below the table: 0.01 is left out for continuous control.
    box, discrete = spaces.Box(-1.0, 1.0, (1,), jnp.float32), spaces.Discrete(2)
    assert inner_loop_lists(discrete) == PPO_INNER_LOOP
    assert inner_loop_lists(box)["learning_rate"] == (0.005, 0.001, 0.0005, 0.0001)
    rest = {name for name in PPO_INNER_LOOP if name != "learning_rate"}
    assert all(inner_loop_lists(box)[name] == PPO_INNER_LOOP[name] for name in rest)
    assert 0.01 in PPO_INNER_LOOP["learning_rate"]


def test_only_pendulum_has_relu_networks():
    assert inner_loop_config("Pendulum-v1").activation == "relu"
    assert inner_loop_config("CartPole-v1") == PPOConfig(activation="tanh")


def test_settings_are_for_environments_that_exist():
    assert set(environment_settings()) <= set(environment_names())


@pytest.mark.parametrize("name", environment_settings())
def test_settings_train_with_numbers_in_their_range(name):
    setting = environment_setting(name)
    hyperparameters = setting.hyperparameters
    assert 0 < hyperparameters.learning_rate <= 0.01
    assert 0 < hyperparameters.discount <= 1 and 0 <= hyperparameters.gae_lambda <= 1
    assert setting.config.batch_size <= setting.config.total_steps
    assert setting.source


def test_an_environment_without_a_setting_gets_ten_times_the_inner_loops_steps():
    assert environment_setting("CartPole-v1").config.total_steps == 10 * PPOConfig().total_steps


def test_an_unknown_hyperparameter_or_an_empty_list_is_refused():
    with pytest.raises(
        UserError, match="unknown hyperparameter 'momentum': known are learning_rate"
    ):
        sample_hyperparameters(jax.random.key(0), {"momentum": [0.9]}, 1)
    with pytest.raises(UserError, match="the list of values for discount is empty"):
        sample_hyperparameters(jax.random.key(0), {"discount": []}, 1)
