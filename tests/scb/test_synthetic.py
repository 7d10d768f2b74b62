import chex
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from scipy import stats

import scb
from scb.environments.synthetic import (
    ACTIVATIONS,
    LATENTS,
    BanditConfig,
    BanditParams,
    BanditState,
    SyntheticBandit,
    bandit_for,
    encode_action,
)
from scb.errors import UserError
from scb.keys import root_key
from tests.scb.probes import context_bandit

BOX = spaces.Box(-2.0, 2.0, (2,), jnp.float32)
SPACES = {"box": BOX, "discrete": spaces.Discrete(3)}


def small_bandit(space, **config):
    return SyntheticBandit(3, space, BanditConfig(hidden_size=4, **config))


def params_of(bandit, seed=0, **values):
    """Weights by chance: Flax starts biases at zero, which would hide one that is forgotten."""
    generator = np.random.default_rng(seed)
    shapes = jax.eval_shape(bandit.init_weights, jax.random.key(0))
    return BanditParams(
        weights=jax.tree.map(lambda x: generator.normal(size=x.shape).astype(np.float32), shapes),
        **values,
    )


def mlp(layers, inputs, activation):
    hidden = inputs @ np.asarray(layers["Dense_0"]["kernel"]) + layers["Dense_0"]["bias"]
    functions = {"relu": lambda x: np.maximum(x, 0.0), "swish": lambda x: x / (1 + np.exp(-x))}
    hidden = {"tanh": np.tanh, **functions}[activation](hidden)
    return hidden @ np.asarray(layers["Dense_1"]["kernel"]) + layers["Dense_1"]["bias"]


# -- contexts and rewards
# -----------------------------------------------------------------------------


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_context_is_the_network_of_its_latent(activation):
    bandit = small_bandit(BOX, activation=activation)
    params = params_of(bandit)
    latent = np.array([0.5, -1.0, 2.0], np.float32)
    np.testing.assert_allclose(
        bandit.context(jnp.array(latent), params),
        mlp(params.weights["initial_state"], latent, activation),
        rtol=1e-5,
    )


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_reward_is_the_network_of_context_and_action(activation):
    bandit = small_bandit(BOX, activation=activation)
    params = params_of(bandit)
    context, action = np.array([0.5, -1.0, 2.0]), np.array([1.5, -0.5])
    by_hand = mlp(params.weights["reward"], np.concatenate([context, action]), activation)
    reward = bandit.mean_reward(jnp.array(context), jnp.array(action), params)
    chex.assert_shape(reward, ())
    np.testing.assert_allclose(reward, by_hand[0], rtol=1e-5)


def test_a_discrete_action_enters_the_reward_one_hot():
    bandit = small_bandit(SPACES["discrete"])
    params = params_of(bandit)
    context = np.array([0.5, -1.0, 2.0])
    for action in range(3):
        inputs = np.concatenate([context, np.eye(3)[action]])
        np.testing.assert_allclose(
            bandit.mean_reward(jnp.array(context), action, params),
            mlp(params.weights["reward"], inputs, "tanh")[0],
            rtol=1e-5,
        )


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (
            jnp.zeros(1, int),
            r"an action has shape \(1,\) and type int32: it must be a whole number below 3",
        ),
        (3, "the action is 3: it must be a whole number from 0 to 2"),
        (jnp.int32(-1), "the action is -1: it must be"),
        (0.5, r"has shape \(\) and type float32: it must be a whole number below 3, of"),
    ],
)
def test_a_discrete_action_that_is_none_is_refused(action, message):
    with pytest.raises(UserError, match=message):
        encode_action(action, spaces.Discrete(3))
    np.testing.assert_array_equal(encode_action(np.int64(2), spaces.Discrete(3)), [0, 0, 1])


def test_a_step_refuses_an_action_of_another_kind():
    env, params = scb.make("Synthetic-CartPole-v1")
    _, state = env.reset(root_key(0), params)
    for action in (0.5, jnp.nan, jnp.zeros(2)):
        with pytest.raises(UserError, match="it must be a whole number below 2"):
            env.step(root_key(0), state, jnp.asarray(action), params)
    env.step(root_key(0), state, jnp.asarray(True), params)


def test_a_continuous_action_beyond_its_bounds_is_the_action_at_the_bound():
    bandit = small_bandit(BOX)
    params = params_of(bandit)
    context = jnp.array([0.5, -1.0, 2.0])

    def reward(*action):
        return bandit.mean_reward(context, jnp.array(action), params)

    assert reward(5.0, -3.0) == reward(2.0, -2.0)
    assert reward(1.9, -2.0) != reward(2.0, -2.0)


def test_the_reward_by_hand():
    # The probe's reward is -|action - context|: -|0.75 - 0.25| = -0.5, and the action 5 is cut to
    # 2: -|2 - 0.25| = -1.75.
    bandit = context_bandit()
    for action, expected in [(0.25, 0.0), (0.75, -0.5), (-0.25, -0.5), (5.0, -1.75)]:
        reward = bandit.mean_reward(jnp.array([0.25]), jnp.array([action]), bandit.default_params)
        assert reward == expected


# -- the environment
# ----------------------------------------------------------------------------------


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_every_episode_terminates_after_one_step_and_is_never_truncated(space):
    bandit = small_bandit(space)
    params = params_of(bandit)
    key_reset, key_action, key_step = jax.random.split(jax.random.key(0), 3)

    @jax.jit
    def play():
        observation, state = jax.vmap(bandit.reset, (0, None))(
            jax.random.split(key_reset, 5), params
        )
        actions = jax.vmap(space.sample)(jax.random.split(key_action, 5))
        keys = jax.random.split(key_step, 5)
        outcome = jax.vmap(bandit.step, (0, 0, 0, None))(keys, state, actions, params)
        expected = jax.vmap(bandit.mean_reward, (0, 0, None))(observation, actions, params)
        return observation, outcome, expected

    observation, outcome, expected = play()
    after, next_state, reward, terminated, truncated, info = outcome
    assert terminated.all() and not truncated.any()
    assert terminated.dtype == truncated.dtype == jnp.bool_
    # The step ends where it began; the next episode's context is already there.
    np.testing.assert_array_equal(info["final_observation"], observation)
    np.testing.assert_array_equal(next_state.context, after)
    np.testing.assert_array_equal(next_state.time, 0)
    assert not np.isclose(after, observation).all(axis=1).any()
    np.testing.assert_allclose(reward, expected, rtol=1e-4)


def test_is_terminated_says_what_step_says():
    bandit = context_bandit()
    fresh = BanditState(time=jnp.int32(0), context=jnp.zeros(1))
    over = BanditState(time=jnp.int32(1), context=jnp.zeros(1))
    assert not bandit.is_terminated(fresh, bandit.default_params)
    assert bandit.is_terminated(over, bandit.default_params)
    assert not bandit.is_truncated(over, bandit.default_params)


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_a_population_of_bandits_is_vmap_over_params(space):
    bandit = small_bandit(space)
    members = [params_of(bandit, seed) for seed in range(3)]
    population = jax.tree.map(lambda *x: np.stack(x), *members)
    key_reset, key_step = jax.random.split(jax.random.key(0))
    action = space.sample(jax.random.key(1))

    def play(params):
        observation, state = bandit.reset(key_reset, params)
        return observation, bandit.step(key_step, state, action, params)[2]

    contexts, rewards = jax.jit(jax.vmap(play))(population)
    alone = jax.jit(play)
    for i, params in enumerate(members):
        context, reward = alone(params)
        np.testing.assert_allclose(contexts[i], context, rtol=1e-5)
        np.testing.assert_allclose(rewards[i], reward, rtol=1e-5)
    assert len(np.unique(rewards)) == 3


def test_reward_noise_is_gaussian_of_that_standard_deviation():
    bandit = context_bandit()
    context, action = jnp.array([0.25]), jnp.array([0.75])
    state = BanditState(time=jnp.int32(0), context=context)

    @jax.jit
    def steps(noise, key):
        params = bandit.default_params.replace(reward_noise=noise)
        step = jax.vmap(lambda key: bandit.step_env(key, state, action, params)[2])
        return step(jax.random.split(key, 4000))

    def rewards(noise, seed):
        return np.asarray(steps(noise, jax.random.key(seed)))

    np.testing.assert_array_equal(rewards(0.0, seed=0), -0.5)
    # -0.5 + 3 N(0, 1): a Kolmogorov-Smirnov test of 4000 draws sees a deviation that is 5 % off.
    noisy = rewards(3.0, seed=0)
    assert stats.kstest((noisy + 0.5) / 3.0, "norm").pvalue > 1e-3
    assert noisy.std() == pytest.approx(3.0, rel=0.05)
    # The noise is scaled, not drawn anew: the same key has the same deviate at any level.
    np.testing.assert_allclose(rewards(1.5, seed=0) + 0.5, (noisy + 0.5) / 2, atol=1e-5)


def test_noise_levels_can_be_mapped_over():
    bandit = context_bandit()
    _, state = bandit.reset(jax.random.key(0), bandit.default_params)
    best = state.context

    def reward(noise):
        params = bandit.default_params.replace(reward_noise=noise)
        return bandit.step(jax.random.key(1), state, best, params)[2]

    rewards = jax.jit(jax.vmap(reward))(np.array([0.0, 1.0, 2.0]))
    assert rewards[0] == 0.0
    assert rewards[2] == pytest.approx(2 * float(rewards[1]))


def test_reward_scale_is_the_deviation_over_contexts_and_actions():
    # r = -|a - c|, c uniform in [0, 1], a in [-1, 2]. With d = |a - c|: E d = the mean over c of
    # ((1 + c)^2 + (2 - c)^2) / 6 = (7/3 + 7/3) / 6 = 7/9, E d^2 = Var a + Var c = 9/12 + 1/12 = 5/6
    # (the means are equal), so Var r = 5/6 - 49/81 = 0.2284 and the deviation 0.4779.
    bandit = context_bandit()
    scale = bandit.reward_scale(
        bandit.default_params.replace(reward_noise=100.0), jax.random.key(0), num_samples=20_000
    )
    assert float(scale) == pytest.approx(0.4779, rel=0.02)


# -- latents
# ------------------------------------------------------------------------------------------


def latents(name, size, count=20_000):
    keys = jax.random.split(jax.random.key(0), count)
    return np.asarray(jax.jit(jax.vmap(lambda key: LATENTS[name](key, size)))(keys))


@pytest.mark.parametrize(
    ("name", "distribution"), [("normal", stats.norm()), ("uniform", stats.uniform())]
)
def test_continuous_latents_have_independent_entries(name, distribution):
    samples = latents(name, 3)
    for entry in samples.T:
        assert stats.kstest(entry, distribution.cdf).pvalue > 1e-3
    # The error of a correlation of 20 000 pairs is 0.007.
    np.testing.assert_allclose(np.corrcoef(samples.T), np.eye(3), atol=0.03)


@pytest.mark.parametrize(
    ("name", "probabilities"),
    [
        ("categorical", [1 / 3, 1 / 3, 1 / 3]),
        # softmax(1, 2, 3) = (1, e, e^2) / (1 + e + e^2) = (0.0900, 0.2447, 0.6652).
        ("softmax_categorical", [0.09003057, 0.24472847, 0.66524096]),
    ],
)
def test_categorical_latents_are_one_hot_with_these_frequencies(name, probabilities):
    samples = latents(name, 3)
    np.testing.assert_array_equal(np.sort(samples, axis=1), np.tile([0, 0, 1], (20_000, 1)))
    expected = np.array(probabilities) * 20_000
    assert stats.chisquare(samples.sum(axis=0), expected, sum_check=False).pvalue > 1e-3


@pytest.mark.parametrize("name", LATENTS)
def test_contexts_are_drawn_through_the_configured_latent(name):
    # Latents of 2 entries, contexts of 3: what a reset shows must be a context of such a latent.
    bandit = small_bandit(BOX, latent=name, latent_size=2)
    params, key = params_of(bandit), jax.random.key(5)
    observation, _ = bandit.reset(key, params)
    assert bandit.observation_space(params).shape == observation.shape == (3,)
    np.testing.assert_allclose(
        observation, bandit.context(LATENTS[name](key, 2), params), rtol=1e-5
    )


# -- shapes and errors
# --------------------------------------------------------------------------------


def test_weight_shapes_are_those_of_the_weights():
    # [3 latent -> 4 -> 3 context] and [3 context + 2 action -> 4 -> 1].
    bandit = small_bandit(BOX)
    assert bandit.weight_shapes() == {
        "initial_state/Dense_0/bias": (4,),
        "initial_state/Dense_0/kernel": (3, 4),
        "initial_state/Dense_1/bias": (3,),
        "initial_state/Dense_1/kernel": (4, 3),
        "reward/Dense_0/bias": (4,),
        "reward/Dense_0/kernel": (5, 4),
        "reward/Dense_1/bias": (1,),
        "reward/Dense_1/kernel": (4, 1),
    }
    weights = bandit.init_weights(jax.random.key(0))
    shapes = {
        f"{network}/{layer}/{name}": array.shape
        for network, layers in weights.items()
        for layer, arrays in layers.items()
        for name, array in arrays.items()
    }
    assert shapes == bandit.weight_shapes()


@pytest.mark.parametrize(
    ("name", "observations", "actions", "discrete"),
    [
        ("Pendulum-v1", 3, 1, False),
        ("CartPole-v1", 4, 2, True),
        ("MountainCarContinuous-v0", 2, 1, False),
        # A 10 x 10 x 4 image, flattened.
        ("Breakout-MinAtar", 400, 3, True),
    ],
)
def test_a_bandit_takes_the_shapes_of_its_evaluation_environment(
    name, observations, actions, discrete
):
    env, env_params = gymnax.make(name)
    bandit = bandit_for(env, env_params, BanditConfig(), f"Synthetic-{name}")
    assert bandit.name == f"Synthetic-{name}"
    assert bandit.observation_size == bandit.latent_size == observations
    assert bandit.num_actions == actions
    assert bandit.discrete == discrete
    params = BanditParams(weights=bandit.init_weights(jax.random.key(0)))
    observation, state = bandit.reset(jax.random.key(1), params)
    action = env.action_space(env_params).sample(jax.random.key(2))
    chex.assert_shape(observation, (observations,))
    assert bool(bandit.step(jax.random.key(3), state, action, params)[3])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"activation": "tan"}, "unknown bandit activation 'tan': did you mean tanh?"),
        ({"latent": "gauss"}, "unknown latent distribution 'gauss': known are categorical, normal"),
        ({"latent": "unifrom"}, "did you mean uniform?"),
        ({"hidden_size": 0}, "hidden_size is 0: it must be at least 1"),
        ({"latent_size": -1}, "latent_size is -1: it must be at least 1"),
    ],
)
def test_impossible_configurations_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        BanditConfig(**arguments)


def test_a_bandit_without_weights_asks_for_params():
    with pytest.raises(
        UserError, match=r"'SyntheticBandit' has no weights of its own: pass params"
    ):
        small_bandit(BOX).reset(jax.random.key(0))
