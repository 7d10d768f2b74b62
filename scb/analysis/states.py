"""States: those that a bandit shows, and those that a policy visits in an environment."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment

from scb.environments.synthetic import SyntheticBandit
from scb.keys import split_key


class Trajectories(NamedTuple):
    """Episodes side by side; `active` is False after an episode's end.

    Attributes:
      observations: [E, T, O] flattened, before each step.
      rewards: [E, T].
      active: [E, T].
    """

    observations: np.ndarray
    rewards: np.ndarray
    active: np.ndarray

    def states(self) -> np.ndarray:
        """[N, O] every visited observation."""
        return self.observations[self.active]

    def returns(self) -> np.ndarray:
        """[E] undiscounted."""
        return np.sum(np.where(self.active, self.rewards, 0.0), axis=1)


def bandit_states(bandit: SyntheticBandit, key: jax.Array, number: int) -> np.ndarray:
    """[number, O] contexts."""
    params = bandit.default_params
    draw = jax.jit(jax.vmap(lambda key: bandit.reset_env(key, params)[0]))
    return np.asarray(draw(split_key(key, number)))


def follow(
    env: environment.Environment[Any, Any],
    env_params: Any,
    policy: Callable[[jax.Array, jax.Array], jax.Array],
    key: jax.Array,
    num_episodes: int,
) -> Trajectories:
    """Episodes of a policy, (observation, key) -> action, every step of them recorded."""
    steps = int(env_params.max_steps_in_episode)
    records = jax.jit(jax.vmap(lambda key: record_episode(env, env_params, policy, key, steps)[0]))(
        split_key(key, num_episodes)
    )
    return Trajectories(*(np.asarray(x) for x in records))


def record_episode(
    env: environment.Environment[Any, Any],
    env_params: Any,
    policy: Callable[[jax.Array, jax.Array], jax.Array],
    key: jax.Array,
    num_steps: int,
) -> tuple[Trajectories, Any]:
    """One episode of a policy, traceable: every step of it without the axis E, and the [T] states it stood in."""
    key_reset, key_steps = split_key(key)
    observation, state = env.reset_env(key_reset, env_params)

    def step(carry: Any, key: jax.Array) -> Any:
        observation, before, active = carry
        key_act, key_step = split_key(key)
        action = policy(observation, key_act)
        after, state, reward, terminated, _ = env.step_env(key_step, before, action, env_params)
        ended = terminated | env.is_truncated(state, env_params)
        record = Trajectories(jnp.ravel(observation), jnp.reshape(reward, ()), active)  # type: ignore[arg-type]
        return (after, state, active & ~ended), (record, before)

    start = (observation, state, jnp.bool_(True))
    records: tuple[Trajectories, Any] = jax.lax.scan(step, start, split_key(key_steps, num_steps))[
        1
    ]
    return records


def thinned(states: np.ndarray, number: int) -> np.ndarray:
    """[N, O] states -> every k-th of them, which are `number` at most."""
    return states[:: max(1, -(-len(states) // number))]
