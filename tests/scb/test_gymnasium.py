"""Gymnasium's environments do what the JAX ones do, keep its contract, and reset as they say."""

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import scb
from scb.environments.in_numpy import InNumpy
from scb.environments.synthetic import LATENTS, BanditConfig, SyntheticBandit
from scb.environments.synthetic_mdp import synthetic_for
from scb.environments.zoo import load_bandit, zoo_names
from scb.errors import UserError
from scb.gymnasium import SyntheticEnv, SyntheticVectorEnv

BANDIT = "scb/Synthetic-Pendulum-v1"


class Given:
    """A generator whose latents are known."""

    def __init__(self, latents):
        self.latents = latents

    def standard_normal(self, shape, dtype):
        assert shape == self.latents.shape
        return self.latents.astype(dtype)


def mdp(parameterization, environment="Pendulum-v1", max_steps=3):
    config = BanditConfig(hidden_size=4, activation="relu")
    made = synthetic_for(*scb.make(environment), parameterization, config, "made", max_steps)
    made._weights = made.init_weights(jax.random.key(0))
    return made


@pytest.fixture(scope="module", params=["T", "TI"])
def file(request, tmp_path_factory):
    made = mdp(request.param)
    path = tmp_path_factory.mktemp("mdp") / "made.npz"
    return str(scb.save_bandit(path, made, made._weights))


def actions_of(space, number, seed=0):
    """Some beyond the bounds, where there are any."""
    rng = np.random.default_rng(seed)
    if hasattr(space, "n"):
        return rng.integers(space.n, size=number)
    return rng.normal(0.0, 2.0 * np.max(np.asarray(space.high)), (number, *space.shape))


@pytest.mark.parametrize("name", zoo_names())
def test_a_bandit_in_numpy_says_what_it_says_in_jax(name):
    bandit = load_bandit(name)
    functions, params = InNumpy(bandit), bandit.default_params
    latents = np.random.default_rng(1).normal(size=(50, bandit.latent_size)).astype(np.float32)
    contexts = jax.vmap(bandit.context, (0, None))(latents, params)
    found = functions.start(Given(latents), 50)
    np.testing.assert_allclose(found, contexts, rtol=1e-4, atol=1e-5)
    actions = actions_of(bandit.action_space(), 50)
    rewards = jax.vmap(bandit.mean_reward, (0, 0, None))(contexts, actions, params)
    after, earned, terminated = functions.step(found, actions)
    np.testing.assert_allclose(earned, rewards, rtol=1e-3, atol=2e-4 * np.abs(rewards).max())
    np.testing.assert_array_equal(after, found)
    assert terminated.all() and functions.one_step


@pytest.mark.parametrize("environment", ["Pendulum-v1", "CartPole-v1"])
def test_an_mdp_in_numpy_says_what_it_says_in_jax(environment):
    made = mdp("TI", environment)
    functions, params = InNumpy(made), made.default_params
    observations = np.random.default_rng(2).normal(size=(60, made.observation_size))
    observations = observations.astype(np.float32)
    actions = actions_of(made.action_space(), 60)
    inputs = observations, actions, params
    after, rewards, terminated = functions.step(observations, actions)
    axes = (0, 0, None)
    np.testing.assert_allclose(
        after, jax.vmap(made.transition, axes)(*inputs), rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(
        rewards, jax.vmap(made.mean_reward, axes)(*inputs), rtol=1e-4, atol=1e-5
    )
    logits = jax.vmap(made.termination_logit, axes)(*inputs)
    np.testing.assert_array_equal(terminated, logits > 0)
    assert 0 < terminated.sum() < 60


@pytest.mark.parametrize("latent", LATENTS)
@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
def test_contexts_have_the_distribution_that_they_have_in_jax(latent, activation):
    config = BanditConfig(hidden_size=4, latent=latent, activation=activation)
    bandit = SyntheticBandit(3, scb.make("Pendulum-v1")[0].action_space(), config, name="made")
    bandit._weights = bandit.init_weights(jax.random.key(3))
    keys = jax.random.split(jax.random.key(4), 4000)
    expected = np.asarray(jax.vmap(bandit.draw_context, (0, None))(keys, bandit.default_params))
    found = InNumpy(bandit).start(np.random.default_rng(5), 4000)
    np.testing.assert_allclose(found.mean(0), expected.mean(0), atol=0.1 * expected.std())
    np.testing.assert_allclose(found.std(0), expected.std(0), rtol=0.1)


def test_an_mdp_of_the_environments_start_states_starts_there():
    found = InNumpy(mdp("T")).start(np.random.default_rng(0), 500)
    np.testing.assert_allclose((found[:, :2] ** 2).sum(1), 1.0, rtol=1e-5)  # cosine and sine
    assert np.abs(found[:, 2]).max() <= 1 and found.std(0).min() > 0.3


def registered():
    return [name for name in gymnasium.registry if name.startswith("scb/Synthetic-")]


def test_all_bandits_of_the_zoo_are_registered():
    assert registered() == [f"scb/{name}" for name in zoo_names()]


@pytest.mark.parametrize("name", registered())
def test_gymnasiums_own_checks_pass(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Bounds of observations that are infinite, and of actions that are not those of [-1, 1].
        warnings.filterwarnings("ignore", message=".*Box.*")
        check_env(gymnasium.make(name).unwrapped, skip_render_check=True)


def test_gymnasiums_own_checks_pass_for_a_file(file):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box.*")
        check_env(gymnasium.make("scb/Synthetic", file=file).unwrapped, skip_render_check=True)


def test_a_module_in_the_name_is_all_that_has_to_be_imported():
    code = f"import gymnasium; print(gymnasium.make('scb:{BANDIT}').reset(seed=0)[0].shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "(3,)\n", done.stderr


@pytest.mark.parametrize("name", zoo_names())
def test_a_single_step_pays_what_many_together_pay(name):
    env = gymnasium.make(f"scb/{name}").unwrapped
    functions = InNumpy(load_bandit(name))
    actions = actions_of(env.action_space, 300)  # more than are drawn together
    observations, rewards = [], []
    env.reset(seed=4)
    for action in actions:
        observations.append(env.reset()[0])
        rewards.append(env.step(action)[1])
    _, expected, _ = functions.step(np.stack(observations), actions)
    np.testing.assert_allclose(rewards, expected, rtol=1e-3, atol=2e-4 * np.abs(expected).max())


@pytest.mark.parametrize("number", [1, 3])
def test_observations_are_of_their_space_whatever_precision_actions_have(file, number):
    env = SyntheticEnv(file) if number == 1 else SyntheticVectorEnv(file, number)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float64)
    assert env.observation_space.contains(env.step(action)[0])


@pytest.mark.parametrize("action", [-1, 2])
def test_an_action_that_is_none_is_refused(action):
    for env in (
        SyntheticEnv("Synthetic-CartPole-v1"),
        SyntheticVectorEnv("Synthetic-CartPole-v1", 2),
    ):
        env.reset(seed=0)
        with pytest.raises(UserError, match=f"an action is {action}: it must be 0 or larger, and"):
            env.step(np.broadcast_to(action, env.action_space.shape))


@pytest.mark.parametrize(
    ("name", "action", "message"),
    [
        (
            "hopper",
            0.5,
            r"an action has shape \(\) and type float32: it must be of shape \(3,\)\.",
        ),
        ("hopper", [0.5], r"an action has shape \(1,\) and type"),
        ("hopper", "a", r"an action has shape \(\) and type <U1: it must be of shape \(3,\)"),
        (
            "hopper",
            [np.nan] * 3,
            r"an action is \[nan, nan, nan\], which gives no reward: it must be finite\.",
        ),
        (
            "CartPole-v1",
            0.0,
            r"has shape \(\) and type float64: it must be a whole number below 2, of shape \(\)\.",
        ),
        ("CartPole-v1", [1], r"has shape \(1,\) and type int64: it must be"),
    ],
)
def test_an_action_of_another_shape_or_type_is_refused(name, action, message):
    env = gymnasium.make(f"scb/Synthetic-{name}", disable_env_checker=True)
    env.reset(seed=0)
    with pytest.raises(UserError, match=message):
        env.step(action)


@pytest.mark.parametrize(
    ("name", "actions", "message"),
    [
        ("hopper", np.zeros((2, 1)), r"an action has shape \(1,\) .* it must be of shape \(3,\)"),
        ("hopper", np.zeros((3, 3)), "there are 3 actions for 2 environments"),
        ("hopper", np.float32(0), "there are 0 actions for 2 environments"),
        ("hopper", np.full((2, 3), np.nan), "gives no reward: it must be finite"),
        ("CartPole-v1", np.zeros(2), "type float64: it must be a whole number"),
        ("CartPole-v1", np.zeros((2, 1), int), r"an action has shape \(1,\) and type int64"),
    ],
)
def test_actions_that_are_none_are_refused(name, actions, message):
    envs = gymnasium.make_vec(f"scb/Synthetic-{name}", 2)
    envs.reset(seed=0)
    with pytest.raises(UserError, match=message):
        envs.step(actions)


def test_nothing_is_rendered():
    name = "scb/Synthetic-Pendulum-v1"
    assert gymnasium.make(name, render_mode=None).reset(seed=0)[0].shape == (3,)
    with pytest.raises(
        UserError, match="render_mode is 'rgb_array', and a bandit has nothing to show"
    ):
        SyntheticEnv("Synthetic-Pendulum-v1", render_mode="rgb_array")
    assert gymnasium.make_vec(name, num_envs=2, render_mode=None).num_envs == 2
    with pytest.raises(UserError, match="a bandit has nothing to show"):
        SyntheticVectorEnv("Synthetic-Pendulum-v1", 2, render_mode="rgb_array")
    # After which Stable-Baselines3 makes it without.
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"), pytest.raises(TypeError):
        gymnasium.make(name, render_mode="rgb_array")


def test_a_bandits_episode_is_one_step():
    env = gymnasium.make(BANDIT)
    first, info = env.reset(seed=1)
    after, reward, terminated, truncated, _ = env.step(np.array([0.5], np.float32))
    np.testing.assert_array_equal(after, first)
    assert (terminated, truncated, info) == (True, False, {}) and type(reward) is float
    assert type(after) is np.ndarray and after.dtype == np.float32
    with pytest.raises(UserError, match="call reset first"):
        env.unwrapped.step(np.array([0.5]))


def test_a_seed_decides_the_contexts_whatever_was_drawn_before():
    env, other = gymnasium.make(BANDIT), gymnasium.make(BANDIT)
    for _ in range(5):
        other.reset()
    for seed in (7, 8):
        drawn = [[e.reset(seed=seed)[0], *(e.reset()[0] for _ in range(300))] for e in (env, other)]
        np.testing.assert_array_equal(*drawn)
        assert len({tuple(x) for x in drawn[0]}) == 301


@pytest.mark.parametrize(
    "name", ["Synthetic-Pendulum-v1", "Synthetic-CartPole-v1", "Synthetic-hopper"]
)
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_as_its_original_would(name, copied):
    env = gymnasium.make(f"scb/{name}")
    env.reset(seed=3)
    env.action_space.seed(3)
    for _ in range(2):
        env.step(env.action_space.sample())
        env.reset()
    other = copied(env)
    for _ in range(3):
        action = env.action_space.sample()
        (observation, *ours), (copy_, *theirs) = env.step(action), other.step(action)
        np.testing.assert_array_equal(observation, copy_)
        assert ours == theirs
        np.testing.assert_array_equal(env.reset()[0], other.reset()[0])


def test_what_a_caller_does_to_an_observation_is_his_own_matter():
    env = gymnasium.make(BANDIT).unwrapped
    first, _ = env.reset(seed=3)
    kept = first.copy()
    first[:] = 1e9
    np.testing.assert_array_equal(env.step(np.array([0.0]))[0], kept)


def test_episodes_of_an_mdp_end_and_are_cut(file):
    env = gymnasium.make("scb/Synthetic", file=file).unwrapped
    env.action_space.seed(0)
    lengths = {"terminated": [], "truncated": []}
    for seed in range(1000):
        env.reset(seed=seed)
        for step in range(1, 10):
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            assert not (terminated and truncated)
            if terminated or truncated:
                lengths["terminated" if terminated else "truncated"].append(step)
                break
    assert set(lengths["truncated"]) == {3} and min(lengths["terminated"]) < 3


def test_start_states_of_an_environment_are_compiled_for_few_numbers(file):
    functions = SyntheticVectorEnv(file, 2)._functions
    if functions._starts is None:
        pytest.skip("start states of its own are NumPy's")
    rng = np.random.default_rng
    many = functions.start(rng(0), 13)
    np.testing.assert_array_equal(functions.start(rng(0), 16)[:13], many)
    for number in range(1, 17):
        assert len(functions.start(rng(1), number)) == number
    assert functions._starts._cache_size() <= 5  # 1, 2, 4, 8, 16


def test_an_mdp_that_overflows_is_told_from_an_action_that_is_not_finite(file):
    ours, one = SyntheticVectorEnv(file, 2), SyntheticEnv(file)
    for env, action in ((ours, [[0.3], [0.3]]), (one, [0.3])):
        env.reset(seed=0)
        network = env._functions._networks["reward"]
        network._bias = np.full_like(network._bias, np.nan)
        env.step(np.array(action, np.float32))  # passed on, as in JAX
        env.reset(seed=0)
        with pytest.raises(UserError, match=r"an action is \[nan\], which gives no reward"):
            env.step(np.array(action, np.float32) * np.nan)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_vector_steps_and_resets_as_gymnasiums_own(file, mode):
    """Side by side with one copy an environment: all that doesn't depend on what is drawn is the same."""
    ours = SyntheticVectorEnv(file, 3, mode)
    theirs = SyncVectorEnv([lambda: SyntheticEnv(file)] * 3, autoreset_mode=mode)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    waiting = np.zeros(3, bool)
    for _ in range(30):
        # What they are in need not be the same, so ours is put into it.
        ours._observations[:] = [
            e._observation[0] if e._observation is not None else o
            for e, o in zip(theirs.envs, ours._observations, strict=True)
        ]
        actions = theirs.action_space.sample()
        a, b = ours.step(actions), theirs.step(actions)
        for x, y in zip(a[1:4], b[1:4], strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5)
            assert x.dtype == y.dtype
        assert set(a[4]) == set(b[4])
        over = a[2] | a[3]
        drawn = over if mode is AutoresetMode.SAME_STEP else waiting
        assert a[0].dtype == b[0].dtype and a[0].shape == b[0].shape
        np.testing.assert_allclose(a[0][~drawn], b[0][~drawn], rtol=1e-4, atol=1e-5)
        if "final_obs" in a[4]:
            np.testing.assert_array_equal(a[4]["_final_obs"], b[4]["_final_obs"])
            for x, y in zip(a[4]["final_obs"], b[4]["final_obs"], strict=True):
                assert (x is None) == (y is None)
                if x is not None:
                    np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5)
        if mode is AutoresetMode.DISABLED and over.any():
            for envs in (ours, theirs):
                envs.reset(options={"reset_mask": over.copy()})
        waiting = over & (mode is AutoresetMode.NEXT_STEP)


def test_a_mask_has_a_place_for_each_and_their_number_is_whole():
    envs = gymnasium.make_vec(BANDIT, num_envs=4)
    envs.reset(seed=0)
    for mask in (np.ones(2, bool), np.ones(4)):
        with pytest.raises(UserError, match="give a bool for each of the 4 environments"):
            envs.reset(options={"reset_mask": mask})
    envs.reset(options={"reset_mask": [True, False, True, False]})
    with pytest.raises(UserError, match=r"num_envs is 2\.5: it must be a whole number"):
        gymnasium.make_vec(BANDIT, num_envs=2.5)


def test_many_bandits_step_together():
    envs = gymnasium.make_vec(BANDIT, num_envs=64)
    assert isinstance(envs.unwrapped, SyntheticVectorEnv)
    observations, _ = envs.reset(seed=0)
    actions = envs.action_space.sample()
    after, rewards, terminated, truncated, infos = envs.step(actions)
    alone = InNumpy(load_bandit("Synthetic-Pendulum-v1")).step(observations, actions)
    np.testing.assert_allclose(rewards, alone[1], rtol=1e-5)
    assert terminated.all() and not truncated.any()
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), observations)
    assert not (after == observations).all(axis=1).any()
    np.testing.assert_array_equal(envs.reset(seed=0)[0], observations)


def test_with_next_step_every_other_step_of_a_bandit_is_a_reset():
    envs = gymnasium.make_vec(BANDIT, num_envs=4, autoreset_mode="NextStep")
    envs.reset(seed=0)
    ends = [envs.step(envs.action_space.sample())[1:3] for _ in range(4)]
    assert [terminated.all() for _, terminated in ends] == [True, False, True, False]
    assert [bool(rewards.any()) for rewards, _ in ends] == [True, False, True, False]
    # Where an episode only begins, what the action is is nobody's concern, as in Gymnasium's own vectors.
    envs.step(envs.action_space.sample())
    envs.step(np.full((4, 1), np.nan))
    with pytest.raises(UserError, match="it must be finite"):
        envs.step(np.full((4, 1), np.nan))


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda: gymnasium.make("scb/Synthetic", file="missing.npz"), "missing.npz"),
        (lambda: gymnasium.make("scb/Synthetic"), "no bandit is named: give file='path/to"),
        (lambda: gymnasium.make_vec("scb/Synthetic", 2), "no bandit is named: give file="),
        (lambda: gymnasium.make_vec(BANDIT, autoreset_mode="never"), "autoreset mode"),
        (lambda: gymnasium.make_vec(BANDIT, num_envs=0), "num_envs is 0"),
        *(
            (
                lambda mode=mode: SyntheticVectorEnv("Synthetic-Pendulum-v1", 1, mode).step(
                    np.zeros((1, 1))
                ),
                "reset first",
            )
            for mode in ("SameStep", "NextStep", "Disabled")
        ),
    ],
)
def test_what_cannot_be_made_is_refused(made, message):
    with pytest.raises(UserError, match=message):
        made()


def test_a_vector_takes_one_seed():
    with pytest.raises(UserError, match="draw from one generator, so give one whole number"):
        gymnasium.make_vec(BANDIT, num_envs=2).reset(seed=[3, 4])
