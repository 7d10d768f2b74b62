"""Roll a frozen policy out and return what it earned."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from gymnax.environments import environment
from jax.typing import ArrayLike

from scb.agents.normalization import RunningStatistics, merge_statistics
from scb.keys import key_at, split_key
from scb.spaces import check_action

Policy = Callable[
    [jax.Array, jax.Array], jax.Array
]  # (observation, key) -> action, for one environment


class Episodes(NamedTuple):
    """What episodes were like, whose number is E."""

    returns: jax.Array  # [E] undiscounted sum of rewards
    lengths: jax.Array  # [E] steps
    observations: RunningStatistics | None = None  # of what the policy saw, where asked for
    speeds: jax.Array | None = None  # [E] mean forward velocity, of environments that have one


def flat(policy: Callable[[jax.Array], jax.Array]) -> Policy:
    """A deterministic policy of [O] flattened observations, as `evaluate` takes it."""
    return lambda observation, key: policy(jnp.ravel(observation))


def evaluate(
    env: environment.Environment[Any, Any],
    env_params: Any,
    policy: Policy,
    key: jax.Array,
    num_episodes: int,
    horizon: ArrayLike | None = None,
    moments: bool = False,
) -> Episodes:
    """Runs `num_episodes` episodes side by side, until the last has ended.

    Args:
      env: any gymnax 1.x environment. Where it has a `forward_velocity` of a state, episodes have speeds.
      env_params: its parameters.
      policy: (observation, key) -> action, for one environment.
      key: decides start states (`reset_env`'s: in Brax of a pool of 1024), transitions and the policy's randomness.
      num_episodes: E, static.
      horizon: steps after which an episode is cut even if the environment would go on; traced, so a
        curriculum does not recompile. None: the environment's own limit.
      moments: whether to keep the mean and variance of the observations.

    Returns:
      Episodes of shape [E].

    Raises:
      UserError: the policy's actions are of another kind or size than the environment's.
    """
    limit = env_params.max_steps_in_episode if horizon is None else horizon
    velocity = getattr(env, "forward_velocity", None)
    space = env.action_space(env_params)
    key_reset, key_loop = split_key(key)
    observation, state = jax.vmap(env.reset_env, in_axes=(0, None))(
        split_key(key_reset, num_episodes), env_params
    )

    def step(carry: Any) -> Any:
        time, observation, state, active, returns, lengths, seen, distance = carry
        if moments:
            flat = jnp.reshape(observation, (num_episodes, -1))
            seen = merge_statistics(seen, RunningStatistics(active, flat, jnp.zeros_like(flat)))
        key_act, key_step = split_key(key_at(key_loop, time))
        action = jax.vmap(policy)(observation, split_key(key_act, num_episodes))
        check_action(action[0], space)
        # step_env, not step: a finished episode needs no reset, and its later rewards are masked.
        observation, state, reward, terminated, _ = jax.vmap(env.step_env, in_axes=(0, 0, 0, None))(
            split_key(key_step, num_episodes), state, action, env_params
        )
        truncated = jax.vmap(env.is_truncated, in_axes=(0, None))(state, env_params)
        returns = returns + jnp.where(active, jnp.reshape(reward, (num_episodes,)), 0.0)
        lengths = lengths + active
        if velocity is not None:
            distance = distance + jnp.where(active, jax.vmap(velocity)(state), 0.0)
        active = active & ~(terminated | truncated)
        return time + 1, observation, state, active, returns, lengths, seen, distance

    start = (
        jnp.int32(0),
        observation,
        state,
        jnp.ones(num_episodes, bool),
        jnp.zeros(num_episodes),
        jnp.zeros(num_episodes, jnp.int32),
        RunningStatistics.start(observation[0].size) if moments else None,
        None if velocity is None else jnp.zeros(num_episodes),
    )
    start = jax.tree.map(lambda x: jnp.asarray(x), start)
    *_, returns, lengths, seen, distance = jax.lax.while_loop(
        lambda carry: (carry[0] < limit) & jnp.any(carry[3]), step, start
    )
    return Episodes(returns, lengths, seen, None if distance is None else distance / lengths)
