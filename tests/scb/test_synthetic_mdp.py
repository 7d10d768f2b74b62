import json
from itertools import combinations

import chex
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces

from scb import artefacts
from scb.agents.ppo import PPO, PPOConfig, PPOHyperparameters
from scb.environments.brax import BraxEnvironment
from scb.environments.registry import make
from scb.environments.synthetic import LATENTS, BanditConfig, BanditParams, SyntheticBandit
from scb.environments.synthetic_mdp import (
    MDPConfig,
    MDPParams,
    MDPState,
    SyntheticMDP,
    synthetic_for,
)
from scb.environments.zoo import load_bandit, load_synthetic, save_bandit
from scb.errors import UserError
from scb.evaluation import evaluate
from tests.scb.probes import Corridor

BOX = spaces.Box(-1.0, 2.0, (1,), jnp.float32)
SPACES = {"box": BOX, "discrete": spaces.Discrete(3)}
SMALL = {"hidden_size": 4, "activation": "relu", "latent": "softmax_categorical", "latent_size": 2}


def linear(coefficients, bias=0.0):
    """Two relu layers that compute `coefficients @ x + bias`: relu(y) - relu(-y) = y."""
    column = np.array(coefficients, np.float32)[:, None]
    return {
        "Dense_0": {"kernel": np.hstack([column, -column]), "bias": np.zeros(2, np.float32)},
        "Dense_1": {"kernel": np.float32([[1.0], [-1.0]]), "bias": np.float32([bias])},
    }


def by_hand(max_steps=5, start=1.0, transition=(2.0, 1.0), reward=(1.0, -1.0), ends_beyond=3.0):
    """One number s, one action a in [-1, 2]: s' = 2 s + a, r = s - a, terminates where s > ends_beyond."""
    weights = {
        "initial_state": linear([0.0], start),
        "reward": linear(reward),
        "transition": linear(transition),
        "termination": linear([1.0, 0.0], -ends_beyond),
    }
    config = MDPConfig(2, "relu", parameterization="TI", max_steps=max_steps)
    return SyntheticMDP(1, BOX, config, weights)


def play(mdp, actions, params=None):
    """Per step: next observation, reward, terminated, truncated, until an episode ends."""
    params = mdp.default_params if params is None else params
    _, state = mdp.reset(jax.random.key(0), params)
    steps = []
    for action in actions:
        _, state, reward, terminated, truncated, info = mdp.step(
            jax.random.key(1), state, np.array([action], np.float32), params
        )
        outcome = (info["final_observation"][0], reward, terminated, truncated)
        steps.append(tuple(x.item() for x in outcome))
        if terminated or truncated:
            break
    return steps


def stacked(*members):
    return jax.tree.map(lambda *x: np.stack(x), *members)


# -- one episode
# --------------------------------------------------------------------------------------


def test_an_episode_by_hand():
    # From s = 1 with a = 0.5, always: s' = 2.5, 5.5, 11.5; r = 0.5, 2, 5; s - 3 = -2, -0.5, 2.5.
    assert play(by_hand(), [0.5] * 5) == [
        (2.5, 0.5, False, False),
        (5.5, 2.0, False, False),
        (11.5, 5.0, True, False),
    ]


def test_a_step_terminates_only_where_the_logit_is_positive():
    # At s = 3 the logit is exactly 0.
    assert [step[2] for step in play(by_hand(start=3.0), [0.0])] == [False]
    assert [step[2] for step in play(by_hand(start=3.5), [0.0])] == [True]


def test_reaching_a_maximum_length_above_one_truncates():
    # The episode by hand would terminate in its third step.
    assert play(by_hand(max_steps=2), [0.5] * 5)[1:] == [(5.5, 2.0, False, True)]


def test_terminating_in_the_last_step_is_no_truncation():
    assert play(by_hand(max_steps=3), [0.5] * 5)[2:] == [(11.5, 5.0, True, False)]


def test_reaching_a_maximum_length_of_one_terminates_where_the_step_began():
    assert play(by_hand(max_steps=1), [0.5] * 5) == [(1.0, 0.5, True, False)]


def test_the_next_episode_starts_by_itself():
    mdp = by_hand(max_steps=2)
    params = mdp.default_params
    observation, state = mdp.reset(jax.random.key(0), params)
    times, seen = [], []
    for _ in range(4):
        seen.append(observation.item())
        observation, state, *_ = mdp.step(jax.random.key(1), state, jnp.array([0.5]), params)
        times.append(state.time.item())
    assert (times, seen) == ([1, 0, 1, 0], [1.0, 2.5, 1.0, 2.5])
    assert not state.terminated


def test_is_terminated_and_is_truncated_say_what_step_says():
    mdp = by_hand(max_steps=2)
    for time, terminated, truncated in [(1, False, False), (1, True, False), (2, False, True)]:
        state = MDPState(jnp.int32(time), jnp.zeros(1), jnp.bool_(terminated))
        assert bool(mdp.is_terminated(state, mdp.default_params)) == terminated
        assert bool(mdp.is_truncated(state, mdp.default_params)) == truncated
    over = MDPState(jnp.int32(2), jnp.zeros(1), jnp.bool_(True))
    assert not mdp.is_truncated(over, mdp.default_params)


def test_a_continuous_action_beyond_its_bounds_is_the_action_at_the_bound():
    # [-1, 2] from s = 1: s' = 2 + 2 and r = 1 - 2; s' = 2 - 1 and r = 1 + 1.
    assert play(by_hand(), [9.0]) == [(4.0, -1.0, False, False)]
    assert play(by_hand(), [-9.0]) == [(1.0, 2.0, False, False)]


def test_a_discrete_action_enters_every_network_one_hot():
    # s' = s + (10, 20, 30)[a], r = (1, 2, 3)[a], logit = (-1, 0, 1)[a].
    weights = {
        "initial_state": linear([0.0], 5.0),
        "reward": linear([0.0, 1.0, 2.0, 3.0]),
        "transition": linear([1.0, 10.0, 20.0, 30.0]),
        "termination": linear([0.0, -1.0, 0.0, 1.0]),
    }
    mdp = SyntheticMDP(1, SPACES["discrete"], MDPConfig(2, "relu", max_steps=9), weights)
    _, state = mdp.reset(jax.random.key(0))
    for action, expected in enumerate([(15.0, 1.0, 0), (25.0, 2.0, 0), (35.0, 3.0, 1)]):
        _, _, reward, terminated, _, info = mdp.step(jax.random.key(1), state, action)
        assert (info["final_observation"].item(), reward, terminated) == expected


def test_evaluation_counts_the_return_and_length_of_the_episode():
    # Rewards 0.5 + 2 + 5, as by hand; cut after two: 0.5 + 2.
    for max_steps, expected in [(5, (7.5, 3)), (2, (2.5, 2)), (1, (0.5, 1))]:
        mdp = by_hand(max_steps)
        episodes = evaluate(
            mdp, mdp.default_params, lambda *_: jnp.array([0.5]), jax.random.key(0), 2
        )
        np.testing.assert_allclose(episodes.returns, expected[0])
        np.testing.assert_array_equal(episodes.lengths, expected[1])


# -- numbers that are traced
# --------------------------------------------------------------------------


def test_maximum_lengths_can_be_mapped_over():
    mdp = by_hand(max_steps=5)

    def outcome(limit):
        params = mdp.default_params.replace(max_steps_in_episode=limit)
        episodes = evaluate(mdp, params, lambda *_: jnp.array([0.5]), jax.random.key(0), 1)
        _, state = mdp.reset(jax.random.key(0), params)
        _, _, _, terminated, truncated, info = mdp.step(
            jax.random.key(1), state, jnp.array([0.5]), params
        )
        return episodes.lengths[0], terminated, truncated, info["final_observation"][0]

    lengths, terminated, truncated, after = jax.jit(jax.vmap(outcome))(np.array([1, 2, 9]))
    assert lengths.tolist() == [1, 2, 3]
    # A first step at length 1 terminates there too, although the config promises nothing.
    assert not mdp.one_step
    assert terminated.tolist() == [True, False, False]
    assert not truncated.any()
    assert after.tolist() == [1.0, 2.5, 2.5]


def test_a_promised_length_of_one_holds_whatever_the_params_say():
    mdp = by_hand(max_steps=1)
    assert mdp.one_step
    params = mdp.default_params.replace(max_steps_in_episode=100)
    assert play(mdp, [0.5] * 5, params) == [(1.0, 0.5, True, False)]


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
@pytest.mark.parametrize("parameterization", ["T", "TI"])
def test_a_population_of_mdps_is_vmap_over_params(parameterization, space):
    config = MDPConfig(hidden_size=4, parameterization=parameterization, max_steps=3)
    env = Corridor(cells=3) if parameterization == "T" else None
    mdp = SyntheticMDP(3, space, config, env=env)
    init = jax.jit(mdp.init_weights)
    members = [mdp.params(init(jax.random.key(seed))) for seed in range(3)]
    key_reset, key_step = jax.random.split(jax.random.key(0))
    action = space.sample(jax.random.key(1))

    def after(params):
        _, state = mdp.reset(key_reset, params)
        *_, reward, terminated, truncated, info = mdp.step(key_step, state, action, params)
        return info["final_observation"], reward, terminated, truncated

    together = jax.jit(jax.vmap(after))(stacked(*members))
    alone = stacked(*map(jax.jit(after), members))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), together, alone)
    assert len(np.unique(together[1])) == 3


def test_an_overflow_is_shown_and_hurts_no_other_member():
    # s = 1, 1e20, 1e40 > 3.4e38, the largest float32; the reward -s follows, and the logit -1 keeps
    # the episode going. The other member stays at s = 1 and r = -1.
    mdps = [
        by_hand(max_steps=6, transition=(growth, 0.0), reward=(-1.0, 0.0), ends_beyond=jnp.inf)
        for growth in (1e20, 1.0)
    ]
    params = stacked(*(mdp.default_params for mdp in mdps))

    def run(params):
        return evaluate(mdps[0], params, lambda *_: jnp.zeros(1), jax.random.key(0), 1)

    episodes = jax.jit(jax.vmap(run))(params)
    assert not np.isfinite(episodes.returns[0, 0])
    assert (episodes.returns[1, 0], episodes.lengths[1, 0]) == (-6.0, 6)


# -- one step: the bandit
# -----------------------------------------------------------------------------


def bandit_and_mdp(space, latent="normal", promised=True):
    """A bandit, and a TI with its weights and two networks more, of maximum length 1."""
    layers = {"hidden_size": 4, "latent": latent}
    bandit = SyntheticBandit(3, space, BanditConfig(**layers))
    mdp = SyntheticMDP(3, space, MDPConfig(**layers, max_steps=1 if promised else 9))
    weights = jax.jit(mdp.init_weights)(jax.random.key(0))
    params = mdp.params(weights).replace(max_steps_in_episode=1)
    shared = {name: weights[name] for name in ("initial_state", "reward")}
    return (bandit, BanditParams(weights=shared)), (mdp, params)


@pytest.mark.parametrize(
    ("space", "latent", "promised"),
    [
        *(("box", latent, True) for latent in LATENTS),
        ("box", "normal", False),
        ("discrete", "normal", True),
        ("discrete", "uniform", False),
    ],
)
def test_a_ti_of_length_one_is_the_bandit(space, latent, promised):
    space = SPACES[space]
    key_reset, key_action, key_step = jax.random.split(jax.random.key(5), 3)

    def steps(env, params):
        actions = jax.vmap(space.sample)(jax.random.split(key_action, 8))
        start, state = jax.vmap(env.reset, in_axes=(0, None))(
            jax.random.split(key_reset, 8), params
        )
        after, state, *outcome, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            jax.random.split(key_step, 8), state, actions, params
        )
        info["discount"] = jnp.asarray(info["discount"])
        return start, after, state.time, *outcome, info

    steps = jax.jit(steps, static_argnums=0)
    one, other = bandit_and_mdp(space, latent, promised)
    chex.assert_trees_all_equal(steps(*one), steps(*other))


@pytest.mark.slow
def test_ppo_learns_in_a_ti_of_length_one_as_in_the_bandit():
    config = PPOConfig(4, 32, (4,), num_steps=8, num_epochs=1, num_minibatches=2)
    hyperparameters = PPOHyperparameters()
    agents = []
    for env, params in bandit_and_mdp(BOX):
        agent = PPO(env, config)
        assert agent.one_step
        agents.append(jax.jit(agent.train)(jax.random.key(1), hyperparameters, params).params)
    chex.assert_trees_all_close(*agents, rtol=1e-5, atol=1e-6)


# -- where episodes start
# -----------------------------------------------------------------------------


# MNISTBandit downloads its pictures when it is made.
@pytest.mark.parametrize("name", [n for n in gymnax.registered_envs if "MNIST" not in n])
def test_a_t_starts_where_its_evaluation_environment_does(name):
    env, env_params = gymnax.make(name)
    mdp = synthetic_for(env, env_params, "T", BanditConfig(hidden_size=4), "T", max_steps=2)
    params = MDPParams()  # no weights: where it starts depends on none
    resets = jax.jit(lambda key: (mdp.reset_env(key, params), env.reset_env(key, env_params)[0]))
    for key in jax.random.split(jax.random.key(1), 2):
        (observation, state), expected = resets(key)
        chex.assert_shape(observation, mdp.observation_space(params).shape)
        assert observation.dtype == jnp.float32
        np.testing.assert_array_equal(observation, np.ravel(expected))
        np.testing.assert_array_equal(state.observation, observation)


def test_a_t_starts_by_the_evaluation_environments_parameters():
    # Corridors start in cell 0 or, with random_start, in any up to `last`.
    env = Corridor(cells=3)
    env_params = env.default_params.replace(random_start=1)
    mdp = synthetic_for(env, env_params, "T", BanditConfig(hidden_size=4), "T")
    params = mdp.params(jax.jit(mdp.init_weights)(jax.random.key(0)))
    keys = jax.random.split(jax.random.key(1), 30)
    starts = jax.jit(jax.vmap(mdp.reset, in_axes=(0, None)))(keys, params)[0]
    np.testing.assert_array_equal(np.unique(starts, axis=0), np.eye(3)[::-1])


@pytest.mark.parametrize("latent", LATENTS)
def test_a_ti_starts_in_a_function_of_its_latent(latent):
    config = MDPConfig(hidden_size=2, activation="relu", latent=latent, max_steps=3)
    mdp = SyntheticMDP(1, BOX, config)
    # s0 = 3 z + 1.
    params = mdp.params({**by_hand().default_params.weights, "initial_state": linear([3.0], 1.0)})
    key = jax.random.key(7)
    np.testing.assert_allclose(
        mdp.reset(key, params)[0], 3.0 * LATENTS[latent](key, 1) + 1.0, rtol=1e-6
    )


# -- training
# -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("parameterization", ["T", "TI"])
def test_ppo_trains_in_a_population_of_mdps(parameterization):
    # The reward is +a in one MDP and -a in the other, a in [-1, 2]; three steps, nothing terminates.
    env = Corridor(cells=1) if parameterization == "T" else None
    config = MDPConfig(2, "relu", parameterization=parameterization, max_steps=3)
    mdp = SyntheticMDP(1, BOX, config, env=env)
    weights = [
        by_hand(transition=(0.5, 0.0), reward=(0.0, sign), ends_beyond=9.0).default_params.weights
        for sign in (1.0, -1.0)
    ]
    if parameterization == "T":
        for member in weights:
            del member["initial_state"]
    agent = PPO(mdp, PPOConfig(8, 4096, (8,), num_steps=16, num_epochs=4, num_minibatches=4))
    assert not agent.one_step

    def trained(params):
        state = agent.train(jax.random.key(0), PPOHyperparameters(learning_rate=1e-2), params)
        return agent.evaluate(state, jax.random.key(1), 4, env_params=params, mode=True)

    episodes = jax.jit(jax.vmap(trained))(stacked(*map(mdp.params, weights)))
    np.testing.assert_array_equal(episodes.lengths, 3)
    # The best returns are 3 * 2 = 6 and -3 * -1 = 3.
    assert (episodes.returns[0] > 4.5).all() and (episodes.returns[1] > 2.25).all()


# -- shapes and errors
# --------------------------------------------------------------------------------


@pytest.mark.parametrize("parameterization", ["T", "TI"])
def test_weight_shapes_are_those_of_the_weights(parameterization):
    # [3 + 3 -> 4 -> n] for transition (3), reward and termination (1); [2 latent -> 4 -> 3].
    env = Corridor(cells=3) if parameterization == "T" else None
    config = MDPConfig(**SMALL, parameterization=parameterization, max_steps=9)
    mdp = SyntheticMDP(3, SPACES["discrete"], config, env=env)
    sizes = {"reward": (6, 1), "transition": (6, 3), "termination": (6, 1)}
    if parameterization == "TI":
        sizes["initial_state"] = (2, 3)
    expected = {}
    for network, (inputs, outputs) in sizes.items():
        expected |= {
            f"{network}/Dense_0/kernel": (inputs, 4),
            f"{network}/Dense_0/bias": (4,),
            f"{network}/Dense_1/kernel": (4, outputs),
            f"{network}/Dense_1/bias": (outputs,),
        }
    assert mdp.weight_shapes() == expected
    flat = artefacts.flatten(jax.jit(mdp.init_weights)(jax.random.key(0)))
    assert {name: array.shape for name, array in flat.items()} == expected


def test_networks_start_apart():
    weights = SyntheticMDP(3, SPACES["discrete"], MDPConfig(4, max_steps=9)).init_weights(
        jax.random.key(0)
    )
    first = [np.asarray(weights[x]["Dense_0"]["kernel"]) for x in ("reward", "transition")]
    first.append(np.asarray(weights["termination"]["Dense_0"]["kernel"]))
    assert all((one != other).all() for one, other in combinations(first, 2))


@pytest.mark.parametrize("parameterization", ["T", "TI"])
def test_networks_and_latent_are_as_asked(parameterization):
    made = synthetic_for(
        *make("CartPole-v1"), parameterization, BanditConfig(8, "relu", "uniform", 2), "Synthetic"
    )
    config = made.config
    found = (config.hidden_size, config.activation, config.latent, config.latent_size)
    assert found == (8, "relu", "uniform", 2)


def test_every_parameterization_takes_the_shapes_of_the_evaluation_environment():
    env, env_params = gymnax.make("CartPole-v1")
    config = BanditConfig(hidden_size=8, activation="relu")
    made = {
        name: synthetic_for(env, env_params, name, config, f"Synthetic-{name}")
        for name in ("T", "TI", "I")
    }
    for name, synthetic in made.items():
        assert synthetic.name == f"Synthetic-{name}"
        assert (synthetic.observation_size, synthetic.num_actions) == (4, 2)
        assert (synthetic.config.hidden_size, synthetic.config.activation) == (8, "relu")
    assert isinstance(made["I"], SyntheticBandit) and made["I"].config == config
    # CartPole-v1 ends after 500 steps.
    for name in ("T", "TI"):
        assert made[name].config.parameterization == name
        assert made[name].config.max_steps == 500 and not made[name].one_step


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameterization": "IT"}, "unknown parameterization of a synthetic MDP 'IT': did you "),
        ({"parameterization": "C"}, "unknown parameterization .* 'C': known are T, TI"),
        ({"max_steps": 0}, "max_steps is 0: it must be at least 1"),
        ({"latent": "gauss"}, "unknown latent distribution 'gauss': known are categorical, normal"),
        ({"hidden_size": 0}, "hidden_size is 0: it must be at least 1"),
    ],
)
def test_impossible_configurations_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        MDPConfig(**{"max_steps": 5, **arguments})


@pytest.mark.parametrize(
    ("parameterization", "max_steps", "message"),
    [
        ("C", None, "unknown parameterization 'C': known are I, T, TI"),
        ("I", 5, "max_steps is 5, and parameterization I has episodes of 1 step: leave it out"),
        ("T", -1, "max_steps is -1: it must be at least 1"),
    ],
)
def test_impossible_choices_are_refused(parameterization, max_steps, message):
    env = Corridor()
    with pytest.raises(UserError, match=message):
        synthetic_for(
            env, env.default_params, parameterization, BanditConfig(), "x", max_steps=max_steps
        )


def test_only_a_t_takes_an_evaluation_environment():
    t, ti = (MDPConfig(parameterization=name, max_steps=5) for name in ("T", "TI"))
    with pytest.raises(UserError, match="of parameterization T without an evaluation environment"):
        SyntheticMDP(3, BOX, t)
    with pytest.raises(UserError, match="of parameterization TI with an evaluation environment"):
        SyntheticMDP(3, BOX, ti, env=Corridor())
    with pytest.raises(UserError, match="has observations of 4 entries and Corridor has 3"):
        SyntheticMDP(4, BOX, t, env=Corridor())


def test_an_mdp_without_weights_asks_for_params():
    mdp = SyntheticMDP(3, BOX, MDPConfig(max_steps=7))
    with pytest.raises(UserError, match="'SyntheticMDP' has no weights of its own: pass params"):
        mdp.reset(jax.random.key(0))


# -- files
# --------------------------------------------------------------------------------------------


def saved(folder, parameterization="TI", name="Pendulum-v1", max_steps=7, **about):
    env, env_params = make(name)
    mdp = synthetic_for(
        env, env_params, parameterization, BanditConfig(**SMALL), "x", max_steps=max_steps
    )
    weights = jax.jit(mdp.init_weights)(jax.random.key(1))
    return save_bandit(folder / "Synthetic-Test.npz", mdp, weights, about), mdp, weights


def edit(path, change):
    path = path.with_suffix(".json")
    content = json.loads(path.read_text())
    change(content["config"])
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize("parameterization", ["T", "TI"])
def test_a_saved_mdp_comes_back_exactly(tmp_path, parameterization, name):
    path, original, weights = saved(tmp_path, parameterization, name)
    mdp, params = make(str(path))
    assert isinstance(mdp, SyntheticMDP) and mdp.name == "Synthetic-Test"
    assert mdp.config == original.config
    assert params.max_steps_in_episode == 7
    chex.assert_trees_all_equal(params.weights, weights)
    # And so it plays the same, beyond the actions' bounds too.
    action = jnp.int32(1) if mdp.discrete else jnp.array([9.0])
    outcomes = []
    for env in (mdp, original):
        observation, state = env.reset(jax.random.key(2), params)
        outcomes.append((observation, env.step(jax.random.key(3), state, action, params)[2:]))
    chex.assert_trees_all_equal(*outcomes)


def test_a_saved_t_starts_in_the_same_physics_of_brax(tmp_path):
    env = BraxEnvironment("inverted_pendulum", backend="spring")
    config = MDPConfig(**SMALL, parameterization="T", max_steps=7)
    mdp = SyntheticMDP(4, env.action_space(), config, env=env)
    weights = mdp.init_weights(jax.random.key(1))
    loaded = load_synthetic(save_bandit(tmp_path / "a.npz", mdp, weights))
    assert isinstance(loaded, SyntheticMDP) and loaded.env == env


def test_a_t_is_made_again_by_the_name_that_the_metadata_gives(tmp_path):
    # gymnax registers this environment under another name than it bears itself.
    name = "DiscountingChain-bsuite"
    with pytest.raises(UserError, match="unknown environment 'DiscountingChain-v0'"):
        saved(tmp_path, "T", name)
    path, original, _ = saved(tmp_path, "T", name, config={"evaluation_environment": name})
    assert isinstance(load_synthetic(path).env, type(original.env))


def test_a_t_whose_evaluation_environment_would_not_come_back_is_not_written(tmp_path):
    env, env_params = make("Pendulum-v1")
    changed = env_params.replace(max_speed=1.0)
    mdp = synthetic_for(env, changed, "T", BanditConfig(**SMALL), "x")
    weights = mdp.init_weights(jax.random.key(0))
    with pytest.raises(UserError, match=r"a\.npz was not written, since 'Pendulum-v1' by its name"):
        save_bandit(tmp_path / "a.npz", mdp, weights)
    assert not list(tmp_path.iterdir())


def test_a_bandits_file_opens_as_a_bandit_and_an_mdps_does_not(tmp_path):
    bandit = SyntheticBandit(3, BOX, BanditConfig(**SMALL))
    path = save_bandit(tmp_path / "b.npz", bandit, bandit.init_weights(jax.random.key(0)))
    assert isinstance(load_synthetic(path), SyntheticBandit)
    assert isinstance(make(str(path))[0], SyntheticBandit)
    with pytest.raises(UserError, match="is a synthetic_mdp: give a bandit here"):
        load_bandit(saved(tmp_path)[0])


def test_an_artefact_that_is_no_environment_is_refused(tmp_path):
    metadata = {"kind": "drift", "config": {}}
    path = artefacts.save(tmp_path / "a.npz", {"x": np.zeros(2)}, metadata)
    with pytest.raises(UserError, match="is a drift: give a bandit or synthetic_mdp here"):
        load_synthetic(path)


def test_a_maximum_length_that_is_no_number_is_refused(tmp_path):
    path, *_ = saved(tmp_path, "T")
    edit(path, lambda config: config["mdp"].update(max_steps="seven"))
    said = r"Synthetic-Test\.npz: max_steps is 'seven': it must be a whole number"
    with pytest.raises(UserError, match=said):
        load_synthetic(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda config: config.pop("observation_size"),
        lambda config: config.pop("mdp"),
        lambda config: config.pop("start"),
        lambda config: config["mdp"].pop("max_steps"),
        lambda config: config["mdp"].update(depth=3),
        lambda config: config["start"].pop("environment"),
        lambda config: config.update(action_space="box"),
    ],
)
def test_a_description_that_is_no_mdps_is_refused(tmp_path, change):
    path, *_ = saved(tmp_path, "T")
    edit(path, change)
    with pytest.raises(UserError, match=r"Synthetic-Test\.npz does not describe a synthetic MDP"):
        load_synthetic(path)


def test_a_file_gives_no_arguments_to_what_it_starts_in(tmp_path):
    path, *_ = saved(tmp_path, "T")
    ran = tmp_path / "ran"
    start = {"environment": "os:makedirs", "arguments": {"name": str(ran)}}
    edit(path, lambda config: config.update(start=start))
    with pytest.raises(UserError, match=r"'os:makedirs' with the arguments .* take them out"):
        load_synthetic(path)
    assert not ran.exists()


def test_weights_of_another_parameterization_or_architecture_are_refused(tmp_path):
    path, *_ = saved(tmp_path, "T")
    edit(path, lambda config: config["mdp"].update(parameterization="TI"))
    with pytest.raises(UserError, match="has no array 'initial_state/"):
        load_synthetic(path)
    path, *_ = saved(tmp_path, "TI")
    edit(path, lambda config: config["mdp"].update(hidden_size=5))
    with pytest.raises(UserError, match=r"has shape \(4,\) where \(5,\) is expected"):
        load_synthetic(path)
