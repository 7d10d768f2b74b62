from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

from scb.agents.hyperparameters import (
    Setting,
    environment_setting,
    inner_loop_config,
    inner_loop_lists,
)
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.discovery import (
    BanditDiscovery,
    BanditTraining,
    DiscoveryConfig,
    check_fits,
    discover,
    expert_setting,
    judge,
)
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig, BanditParams, SyntheticBandit, bandit_for
from scb.environments.zoo import PREFIX, bandit_metadata, load_bandit, save_bandit, zoo_names
from scb.errors import UserError
from scb.evolution import EvolutionConfig, map_population
from scb.statistics import iqm
from scb.warm_start import WarmStartConfig
from tests.scb.probes import Corridor, CorridorParams

METADATA = {"seeds": {}, "results": {}, "cost": {}, "command": "scb discover", "config": {}}
TINY = PPOConfig(
    num_envs=2, num_steps=8, num_epochs=1, num_minibatches=1, total_steps=20, hidden_sizes=(4,)
)
CONFIG = DiscoveryConfig(
    environment="CartPole-v1",
    bandit=BanditConfig(hidden_size=4),
    agent=TINY,
    agents_per_candidate=3,
    evaluation_episodes=2,
    init="random",
    evolution=EvolutionConfig(
        population_size=4, num_generations=2, mean_evaluations=2, evaluate_mean_every=1
    ),
)


def flat(weights):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(weights)])


def shapes(weights):
    return {
        f"{network}/{layer}/{name}": array.shape
        for network, layers in weights.items()
        for layer, arrays in layers.items()
        for name, array in arrays.items()
    }


# -- a bandit that stands for an environment
# ----------------------------------------------------------


def two_cell_bandit():
    """Contexts are the two cells, one-hot; action 1 pays 1 in cell 0 and action 0 in cell 1.

    initial_state: the identity of a categorical latent. reward: relu(c0 + a1 - 1) + relu(c1 + a0 -
      1).
    """
    weights = {
        "initial_state": {
            "Dense_0": {"kernel": jnp.eye(2), "bias": jnp.zeros(2)},
            "Dense_1": {"kernel": jnp.eye(2), "bias": jnp.zeros(2)},
        },
        "reward": {
            "Dense_0": {
                "kernel": jnp.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 0.0]]),
                "bias": -jnp.ones(2),
            },
            "Dense_1": {"kernel": jnp.ones((2, 1)), "bias": jnp.zeros(1)},
        },
    }
    config = BanditConfig(hidden_size=2, activation="relu", latent="categorical")
    return SyntheticBandit(2, spaces.Discrete(2), config, weights)


def test_agents_trained_in_a_bandit_do_in_the_environment_what_the_bandit_rewards():
    # A corridor of two cells where action 1 pays 1 in cell 0 and action 0 in cell 1: the bandit's
    # own optimum earns 2, that of the bandit with its sign turned 0, and chance 1.
    bandit = two_cell_bandit()
    good = bandit.default_params.weights
    turned = {**good["reward"]["Dense_1"], "kernel": -good["reward"]["Dense_1"]["kernel"]}
    bad = {**good, "reward": {**good["reward"], "Dense_1": turned}}
    corridor = CorridorParams(rewards=jnp.array([[0.0, 1.0], [1.0, 0.0]]), last=1)
    config = replace(TINY, num_steps=64, num_epochs=4, num_minibatches=4, total_steps=128 * 20)
    training = BanditTraining(bandit, Corridor(cells=2), corridor, config, lists=None)

    def returns(reward_weights, key):
        hyperparameters = PPOHyperparameters(learning_rate=0.02)
        params = BanditParams(weights=reward_weights)
        return training.returns(params, hyperparameters, key, 4, mode=True).mean()

    population = map_population(returns, 8, (None, 0))
    keys = jax.random.split(jax.random.key(0), 8)
    np.testing.assert_array_equal(population(good, keys), 2.0)
    np.testing.assert_array_equal(population(bad, keys), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo_names())
def test_a_bandit_of_the_zoo_is_worth_what_it_says(name):
    # On seeds that were not reported: within the reported interval, widened by its own width.
    claimed = bandit_metadata(name)["results"]["PPO"]["sampled_actions"]
    target = name.removeprefix(PREFIX)
    env, env_params = make(target)
    bandit, params = make(name)
    lists = inner_loop_lists(bandit.action_space())
    training = BanditTraining(bandit, env, env_params, inner_loop_config(target), lists)
    measured = iqm(judge(training, params.weights, seed=123_456))
    width = claimed["high"] - claimed["low"]
    assert claimed["low"] - width < measured < claimed["high"] + width


# -- a discovery
# --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def discovered():
    return discover(CONFIG, quiet=True)


def test_a_discovery_ends_with_weights_of_its_bandit(discovered):
    problem, outcome = discovered
    assert problem.bandit.name == "Synthetic-CartPole-v1"
    assert shapes(outcome.mean) == shapes(outcome.best_mean) == problem.bandit.weight_shapes()
    assert len(outcome.metrics) == 2
    for line in outcome.metrics:
        # CartPole pays 1 a step until the pole falls, after 500 at most.
        assert 8 <= line["fitness/min"] <= line["fitness/max"] <= 500
        assert line["failed"] == 0


def test_a_discovered_bandit_is_saved_and_loaded(discovered, tmp_path):
    problem, outcome = discovered
    path = save_bandit(tmp_path / "Synthetic-CartPole-v1", problem.bandit, outcome.mean, METADATA)
    bandit = load_bandit(path)
    np.testing.assert_array_equal(flat(bandit.default_params.weights), flat(outcome.mean))
    check_fits(bandit, problem.env, problem.env_params, "CartPole-v1")


def test_a_candidate_is_judged_by_the_return_of_every_agent(discovered):
    problem, outcome = discovered
    result = jax.eval_shape(problem.evaluate, outcome.mean, jax.random.key(0), jnp.int32(0))
    assert result["fitness"].shape == (3,)
    result = jax.eval_shape(problem.evaluate_mean, outcome.mean, jax.random.key(0))
    assert result["fitness"].shape == ()


def test_environment_steps_of_a_candidate(discovered):
    # 3 agents; 20 steps are rounded up to two batches of 2 x 8; 2 episodes of at most 500 steps
    # each.
    steps = discovered[0].steps()
    assert (steps.training, steps.evaluation) == (3 * 2 * 16, 3 * 2 * 500)


def test_judging_takes_new_agents_for_another_seed(discovered):
    problem, outcome = discovered
    a, b, c = (
        judge(problem.training, outcome.mean, seed, num_agents=5, num_episodes=2)
        for seed in (1, 1, 2)
    )
    assert a.shape == (5,)
    np.testing.assert_array_equal(a, b)
    assert (a != c).any() and len(set(a)) > 1


# -- where a discovery starts
# -------------------------------------------------------------------------


def test_a_random_start_is_drawn_from_the_key():
    problem = BanditDiscovery(CONFIG)
    key = jax.random.key(3)
    start = problem.initial_solution(key)
    np.testing.assert_array_equal(flat(start), flat(problem.bandit.init_weights(key)))
    assert (flat(start) != flat(problem.initial_solution(jax.random.key(4)))).any()


def test_an_expert_start_is_fitted_once_and_from_the_seed_alone(monkeypatch):
    setting = Setting(TINY, PPOHyperparameters(), source="this test")
    monkeypatch.setattr("scb.discovery.expert_setting", lambda name, steps: setting)
    warm = WarmStartConfig(num_experts=2, num_states=16, horizon=3, fit_steps=20)
    problem = BanditDiscovery(replace(CONFIG, init="expert", warm_start=warm))
    start = problem.initial_solution(jax.random.key(3))
    assert shapes(start) == problem.bandit.weight_shapes()
    # A resumed run asks again, whatever its key: same weights.
    assert problem.initial_solution(jax.random.key(4)) is start
    report = problem.warm_start_report
    assert set(report) == {"expert_return", "environment_steps", "reward_r2", "energy_distance"}
    # Two experts of two batches of 2 x 8 steps, 256 trajectories of 200 steps, and 16 states with 2
    # actions of 3 steps.
    assert report["environment_steps"] == 2 * 2 * 16 + 256 * 200 + 16 * 2 * 3
    assert 8 <= report["expert_return"] <= 500


def saved(folder, environment, **config):
    bandit = bandit_for(*make(environment), BanditConfig(**config), f"Synthetic-{environment}")
    weights = bandit.init_weights(jax.random.key(1))
    return save_bandit(folder / f"Synthetic-{environment}", bandit, weights, METADATA), weights


def test_a_discovery_starts_from_a_bandit_in_a_file(tmp_path):
    path, weights = saved(tmp_path, "CartPole-v1", hidden_size=4)
    problem = BanditDiscovery(replace(CONFIG, start=str(path)))
    start = problem.initial_solution(jax.random.key(0))
    np.testing.assert_array_equal(flat(start), flat(weights))


@pytest.mark.parametrize(
    ("environment", "size", "message"),
    [
        ("CartPole-v1", 8, r"has other layer sizes .* whose hidden_size is 4"),
        (
            "Acrobot-v1",
            4,
            r"bandit Synthetic-Acrobot-v1 has 6 observations and 3 discrete actions, CartPole-v1 has 4 "
            r"observations and 2 discrete actions: take the bandit of that environment",
        ),
    ],
)
def test_a_start_of_other_shapes_is_refused_at_once(tmp_path, environment, size, message):
    path, _ = saved(tmp_path, environment, hidden_size=size)
    with pytest.raises(UserError, match=message):
        BanditDiscovery(replace(CONFIG, start=str(path)))


def test_a_bandit_fits_the_environments_of_its_shapes_only():
    cartpole = bandit_for(*make("CartPole-v1"), BanditConfig(), "a")
    check_fits(cartpole, *make("CartPole-v1"), "CartPole-v1")
    for other in ("Pendulum-v1", "Acrobot-v1", "MountainCar-v0"):
        with pytest.raises(UserError, match=f"bandit a has 4 observations .*, {other} has "):
            check_fits(cartpole, *make(other), other)
    # Two numbers seen and three pushed: discrete or not, the number alone doesn't make it fit.
    box = SyntheticBandit(2, spaces.Box(-1.0, 1.0, (3,), jnp.float32), name="b")
    with pytest.raises(UserError, match="2 observations and 3 action dimensions, MountainCar-v0"):
        check_fits(box, *make("MountainCar-v0"), "MountainCar-v0")


# -- configuration
# ------------------------------------------------------------------------------------


def test_hyperparameters_are_drawn_from_the_papers_lists_or_fixed():
    sampled, fixed = (
        BanditDiscovery(replace(CONFIG, sampled_hyperparameters=yes)).training.hyperparameters(
            jax.random.key(0), 5
        )
        for yes in (True, False)
    )
    np.testing.assert_array_equal(fixed.learning_rate, np.full(5, 5e-3, np.float32))
    # Five agents share the five learning rates out, 0.01 among them where actions are discrete.
    assert sorted(sampled.learning_rate.tolist()) == sorted(
        np.float32([0.01, 0.005, 0.001, 0.0005, 0.0001]).tolist()
    )


def test_the_inner_loop_is_the_papers_where_no_agent_is_given():
    problem = BanditDiscovery(replace(CONFIG, environment="Pendulum-v1", agent=None))
    assert problem.agent_config == inner_loop_config("Pendulum-v1")
    # 10 000 steps each, and 2 episodes of Pendulum's 200.
    assert problem.steps().training == 3 * 10_000
    assert problem.steps().evaluation == 3 * 2 * 200
    assert 0.01 not in problem.training.lists["learning_rate"]


def test_experts_are_trained_as_the_environment_is_but_for_pendulums_discount():
    assert expert_setting("Pendulum-v1", None).hyperparameters.discount == 0.95
    assert environment_setting("Pendulum-v1").hyperparameters.discount == 0.995
    assert expert_setting("CartPole-v1", None) == environment_setting("CartPole-v1")
    assert expert_setting("CartPole-v1", 3000).config.num_iterations == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"init": "exprt"}, "unknown initialisation 'exprt': did you mean expert"),
        ({"agents_per_candidate": 0}, "agents_per_candidate is 0: it must be at least 1"),
        ({"evaluation_episodes": -1}, "evaluation_episodes is -1: it must be at least 1"),
        (
            {"environment": "Pendulum-v2"},
            "unknown environment 'Pendulum-v2': did you mean Pendulum",
        ),
        ({"start": "Synthetic-Pendulum"}, "unknown bandit 'Synthetic-Pendulum'"),
    ],
)
def test_impossible_discoveries_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        BanditDiscovery(replace(CONFIG, **arguments))
