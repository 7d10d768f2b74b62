"""A task of a meta-training: how long its agents train, its noise, and where it is."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

from lpo.inner_loop import TaskTraining
from lpo.meta_training import MetaTraining
from scb.environments.spec import EnvironmentSpec
from scb.environments.synthetic import BanditConfig, SyntheticBandit

PENDULUM = "Synthetic-Pendulum-v1"


def bandit(reward_factor: float = 1.0) -> SyntheticBandit:
    """A bandit of Pendulum's shapes, its rewards `reward_factor` times those of the plain one."""
    shape = SyntheticBandit(3, spaces.Box(-2.0, 2.0, (1,), jnp.float32), BanditConfig(4))
    weights = shape.init_weights(jax.random.key(0))
    last = weights["reward"]["Dense_1"]
    weights["reward"]["Dense_1"] = jax.tree.map(lambda x: reward_factor * x, last)
    return SyntheticBandit(3, shape.action_space(), shape.config, weights)


# -- horizons ------------------------------------------------------------------------------------


def test_inner_agents_train_for_the_horizon_and_know_how_far_they_are(config):
    seen = []

    def watch(parameters, log_ratio, advantage, progress):
        jax.debug.callback(lambda p: seen.append(float(p)), progress[0])
        return jnp.zeros_like(log_ratio)

    task = TaskTraining(replace(config, horizons=(0.5, 1.0, 2.0), reward_noise=0.0), PENDULUM)
    task.agent = replace(task.agent, drift=watch)
    hyperparameters = task.spec.hyperparameters
    fitness = jax.jit(task.fitness, static_argnums=2)
    for horizon, fractions in (
        (1 / 3, {0.0}),  # one batch of three
        (1.0, {0.0, 1 / 3, 2 / 3}),
        (2.0, {0.0, 1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6}),
    ):
        seen.clear()
        jax.block_until_ready(fitness(0.0, jax.random.key(0), 1, horizon))
        jax.effects_barrier()
        assert set(np.round(seen, 5)) == set(np.round(list(fractions), 5))
    assert hyperparameters.horizon is None


def test_a_generation_has_one_horizon_and_generations_differ(config):
    problem = MetaTraining(replace(config, horizons=(0.5, 1.0, 2.0), agents_per_candidate=3))

    class Echo:
        def fitness(self, candidate, key, number, horizon=1.0):
            return jnp.full(number, horizon)

    problem.tasks = {"a": Echo()}
    drawn = [
        problem.evaluate({}, jax.random.key(i), jnp.int32(i))["fitness"].tolist() for i in range(20)
    ]
    assert all(len(set(generation)) == 1 for generation in drawn)
    assert {generation[0] for generation in drawn} == {0.5, 1.0, 2.0}


def test_steps_with_horizons_are_their_mean(config):
    # Three batches of eight, half (1.5, which is rounded to 2), all or twice of them: 8 x 11 / 3.
    steps = MetaTraining(replace(config, horizons=(0.5, 1.0, 2.0), reward_noise=0.0)).steps()
    assert (steps.training, steps.evaluation) == (29, 2)
    # However short, a training has a batch.
    shortest = MetaTraining(replace(config, horizons=(0.01,), reward_noise=0.0)).steps()
    assert shortest.training == 8
    # What is judged trains in full.
    for horizons in ((0.5, 1.0, 2.0), (2.0,), ()):
        steps = MetaTraining(replace(config, horizons=horizons, reward_noise=0.0)).judgement_steps()
        assert steps.training == 3 * 8


# -- reward noise -------------------------------------------------------------------------------


def test_reward_noise_is_given_in_the_bandits_own_standard_deviations(config, monkeypatch):
    plain = bandit()
    rng = np.random.default_rng(0)
    contexts = jax.vmap(plain.reset_env, (0, None))(
        jax.random.split(jax.random.key(9), 4000), plain.default_params
    )[0]
    actions = jnp.asarray(rng.uniform(-2.0, 2.0, (4000, 1)), jnp.float32)
    rewards = jax.vmap(plain.mean_reward, (0, 0, None))(contexts, actions, plain.default_params)

    noise = {}
    for factor in (1.0, 3.0):
        scaled = bandit(factor)
        monkeypatch.setattr(EnvironmentSpec, "make", lambda *_, b=scaled: (b, b.default_params))
        problem = TaskTraining(replace(config, reward_noise=5.0), PENDULUM)
        noise[factor] = float(problem.training_params.reward_noise)
        assert problem.evaluation_params.reward_noise == 0.0
    # 4000 samples know a standard deviation to about 1 / sqrt(2 * 4000) = 1 %.
    assert noise[1.0] == pytest.approx(5.0 * float(jnp.std(rewards)), rel=0.06)
    assert noise[3.0] == pytest.approx(3.0 * noise[1.0], rel=1e-5)


def test_reward_noise_enters_training_and_not_evaluation(config):
    # Half of the agents draw the learning rate 0 and stay as they were initialised: were noise in
    # the evaluation, none of them would be worth the same as without. The other half learns, and
    # learns something else under noise.
    start = config.drift.init(jax.random.key(1))
    drawn = replace(config, hyperparameters={"learning_rate": (0.0, 0.1)})
    with_noise, without = (
        jax.jit(TaskTraining(c, PENDULUM).fitness, static_argnums=2)(start, jax.random.key(0), 16)
        for c in (replace(drawn, reward_noise=noise) for noise in (5.0, 0.0))
    )
    assert int(jnp.sum(with_noise == without)) == 8


def test_environments_take_no_reward_noise(config):
    problem = TaskTraining(replace(config, reward_noise=5.0), "Pendulum-v1")
    assert problem.training_params is problem.env_params


# -- where it trains ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("environment", "fitness", "made"),
    [
        # A bandit has no physics: the backend is for the environment that it stands for.
        ("Synthetic-hopper", "transfer", [("hopper", "spring"), ("Synthetic-hopper", None)]),
        ("hopper", "return", [("hopper", "spring")]),
    ],
)
def test_physics_go_to_the_environment_and_not_to_its_bandit(
    config, monkeypatch, environment, fitness, made
):
    calls = []

    def record(spec, backend=None):
        calls.append((spec.name, backend))
        return bandit(), bandit().default_params

    monkeypatch.setattr(EnvironmentSpec, "make", record)
    MetaTraining(replace(config, tasks=(environment,), fitness=fitness, backend="spring"))
    assert calls == made
