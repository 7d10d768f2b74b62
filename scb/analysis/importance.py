"""How much of a bandit's reward depends on each entry of the observation."""

from functools import partial

import jax
import jax.numpy as jnp

from scb.environments.synthetic import SyntheticBandit
from scb.keys import split_key

VALUES = 32  # that an entry takes in each observation


@partial(jax.jit, static_argnames="bandit")
def reward_variance(bandit: SyntheticBandit, observations: jax.Array, key: jax.Array) -> jax.Array:
    """The share of the reward's variance that one observation entry causes, alone or with others.

    Observation and action are fixed but for one entry, which takes other observations' values; the
    variance of the reward, averaged over observations and uniform actions, is divided by its
    variance over everything. Every entry is drawn from its values in `observations` apart from the
    others, so this is Sobol's total-effect index: 0 for an entry that the reward ignores, at most 1
    but for sampling, and the entries' sum exceeds 1 where they interact.

    Args:
      bandit: whose noiseless reward is examined.
      observations: [N, O], from which the entries' values come.
      key: decides actions and values.

    Returns:
      [O] non-negative.
    """
    params = bandit.default_params
    number, size = observations.shape
    key_action, key_value, key_entries = split_key(key, 3)
    independent = jnp.stack(
        [
            observations[jax.random.permutation(k, number), i]
            for i, k in enumerate(split_key(key_entries, size))
        ],
        axis=1,
    )
    actions = jax.vmap(bandit.action_space().sample)(split_key(key_action, number))
    reward = jax.vmap(bandit.mean_reward, in_axes=(0, 0, None))
    picked = jax.random.randint(key_value, (number, VALUES), 0, number)

    def entry_variance(entry: jax.Array) -> jax.Array:
        def varied(value: jax.Array) -> jax.Array:
            return reward(independent.at[:, entry].set(value), actions, params)

        rewards = jax.vmap(varied, in_axes=1)(observations[picked, entry])
        return jnp.var(rewards, axis=0, ddof=1).mean()

    shares = jax.lax.map(entry_variance, jnp.arange(size))
    return shares / (jnp.var(reward(independent, actions, params)) + 1e-12)
