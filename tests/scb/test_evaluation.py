import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments.classic_control.pendulum import Pendulum

from scb.errors import UserError
from scb.evaluation import evaluate
from tests.scb.probes import Corridor, CorridorParams

EPISODES = 32
# Cell c pays 10^c, whatever the action; the corridor ends after cell 2. Starts are random.
PAYING = CorridorParams(rewards=jnp.array([[1.0, 1], [10, 10], [100, 100]]), random_start=1)


def right(observation, key):
    return jnp.int32(1)


@pytest.fixture(scope="module")
def corridor():
    """jit of (params, horizon) -> Episodes in the corridor; one program for the whole module."""
    return jax.jit(
        lambda params, horizon: evaluate(
            Corridor(), params, right, jax.random.key(0), EPISODES, horizon
        )
    )


def outcomes(episodes):
    assert episodes.returns.shape == episodes.lengths.shape == (EPISODES,)
    pairs = zip(episodes.returns.tolist(), episodes.lengths.tolist(), strict=True)
    return set(pairs)


def test_an_episode_earns_until_it_ends_and_nothing_after(corridor):
    # From cell 0: 1 + 10 + 100 in three steps; from cell 1: 110 in two; from cell 2: 100 in one.
    # The corridor itself would go on from cell 0 and pay again.
    assert outcomes(corridor(PAYING, 100)) == {(111.0, 3), (110.0, 2), (100.0, 1)}


def test_the_horizon_cuts_an_episode_that_would_go_on(corridor):
    # After two steps: 1 + 10; 10 + 100, which ends there anyway; 100 after one.
    assert outcomes(corridor(PAYING, 2)) == {(11.0, 2), (110.0, 2), (100.0, 1)}
    assert outcomes(corridor(PAYING, 1)) == {(1.0, 1), (10.0, 1), (100.0, 1)}


def test_the_environments_own_limit_ends_an_episode_before_the_horizon(corridor):
    # An endless corridor, cut after 4 steps: 1 + 10 + 100 + 1.
    endless = PAYING.replace(last=1000, random_start=0, max_steps_in_episode=4)
    assert outcomes(corridor(endless, 100)) == {(112.0, 4)}


def test_without_a_horizon_the_environments_limit_holds():
    endless = PAYING.replace(last=1000, random_start=0, max_steps_in_episode=5)
    episodes = evaluate(Corridor(), endless, right, jax.random.key(0), 2)
    np.testing.assert_array_equal(episodes.returns, 122.0)
    np.testing.assert_array_equal(episodes.lengths, 5)


def test_a_reward_that_is_not_finite_after_the_end_does_no_harm(corridor):
    # The episode ends after cell 1; cell 2, which masked steps go through, pays NaN.
    params = CorridorParams(
        rewards=jnp.array([[1.0, 1], [10, 10], [jnp.nan, jnp.nan]]), last=1, random_start=1
    )
    assert outcomes(corridor(params, 100)) == {(11.0, 2), (10.0, 1)}


def test_every_episode_and_step_has_its_own_randomness():
    # Coin flips in an endless corridor that pays the action: the returns of 10 steps are binomial,
    # with mean 5 and deviation 1.58; equal keys in all steps would leave only 0 and 10, equal keys
    # in all episodes only one value.
    params = CorridorParams(rewards=jnp.tile(jnp.array([0.0, 1.0]), (3, 1)), last=1000)

    def flip(observation, key):
        return jax.random.randint(key, (), 0, 2)

    returns = evaluate(Corridor(), params, flip, jax.random.key(1), 400, horizon=10).returns
    # The error of the mean of 400 is 0.08, that of the deviation 0.056.
    assert float(returns.mean()) == pytest.approx(5.0, abs=0.3)
    assert float(returns.std()) == pytest.approx(1.58, abs=0.2)


def test_another_key_gives_other_episodes_and_the_same_key_the_same():
    a, b, c = (
        evaluate(Corridor(), PAYING, right, jax.random.key(seed), EPISODES).returns
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()


class FixedPendulum(Pendulum):
    """A pendulum that always starts in the same place; its steps draw nothing."""

    def reset_env(self, key, params):
        return super().reset_env(jax.random.key(7), params)


def test_it_matches_stepping_gymnaxs_environment_by_hand():
    env, params = FixedPendulum(), Pendulum().default_params
    params = params.replace(max_steps_in_episode=25)

    def brake(observation, key):
        return -jnp.clip(observation[2:], -2.0, 2.0)

    observation, state = env.reset(jax.random.key(0), params)
    total, steps, truncated = 0.0, 0, False
    while not truncated:
        action = brake(observation, None)
        observation, state, reward, _, truncated, _ = env.step(
            jax.random.key(steps), state, action, params
        )
        total, steps = total + float(reward), steps + 1
    episodes = evaluate(env, params, brake, jax.random.key(0), 3)
    np.testing.assert_allclose(episodes.returns, total, rtol=1e-5)
    np.testing.assert_array_equal(episodes.lengths, steps)
    assert steps == 25


class Rolling(Corridor):
    """Whose forward velocity is the cell that a step ends in."""

    def forward_velocity(self, state):
        return state.cell.astype(jnp.float32)


def test_an_episodes_speed_is_the_mean_over_its_own_steps():
    found = evaluate(Rolling(), PAYING, right, jax.random.key(0), EPISODES)
    pairs = set(zip(found.lengths.tolist(), found.speeds.tolist(), strict=True))
    # From cell 0 into 1, 2 and the next round's 0; what follows the end is not counted.
    assert pairs == {(3, 1.0), (2, 1.0), (1, 0.0)}
    assert evaluate(Corridor(), PAYING, right, jax.random.key(0), 2).speeds is None


@pytest.mark.parametrize(
    ("env", "action", "message"),
    [
        (
            Corridor(),
            jnp.float32(0.7),
            r"shape \(\) and type float32: it must be a whole number bel",
        ),
        (
            Corridor(),
            jnp.array([1]),
            r"shape \(1,\) and type int32: it must be a whole number below",
        ),
        (Pendulum(), jnp.zeros(2), r"shape \(2,\) and type float32: it must be of shape \(1,\)"),
    ],
)
def test_actions_of_another_kind_or_size_are_refused(env, action, message):
    with pytest.raises(UserError, match=message):
        evaluate(env, env.default_params, lambda o, k: action, jax.random.key(0), 3)
