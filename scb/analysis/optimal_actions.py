"""The best action of a bandit in a context, found without training anything.

In a bandit the reward is the Q-function (Liesen et al., 2024, eq. 2), so the optimal policy is an
argmax over actions: all of them where they are discrete, a grid or a gradient ascent where they are
continuous. In a linear bandit it is written down.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnax.environments import spaces

from scb.environments.linear import PolicyDistanceParts
from scb.environments.synthetic import BanditParams, SyntheticBandit
from scb.errors import UserError, one_of
from scb.evaluation import Policy, flat
from scb.keys import root_key
from scb.spaces import action_size, clip_to_space, flat_bounds

METHODS = ("gradient", "grid")
GRID_POINTS = 101  # in each dimension of the action
LARGEST_GRID = 20_000
STARTS, STEPS = 16, 64  # of the gradient ascent


def optimal_actions(
    bandit: SyntheticBandit, params: BanditParams | None = None, method: str = "gradient"
) -> Callable[[jax.Array], jax.Array]:
    """The bandit's optimal policy.

    Args:
      bandit: whose noiseless reward is maximised.
      params: its parameters; its own where None.
      method: for continuous actions of a bandit with networks. "gradient" climbs from the centre and 15 random
        actions and keeps the best; "grid" tries 101 values in each dimension. A linear bandit's best
        action is written in its weights, and discrete actions are all tried.

    Returns:
      [O] context -> action within the bounds, of the action space's shape. To be jitted and vmapped
      by the caller.

    Raises:
      UserError: an unknown method; a grid over more actions than 20 000.
    """
    one_of("method", method, METHODS)
    params = bandit.default_params if params is None else params
    space = bandit.action_space()
    if isinstance(space, spaces.Discrete):
        candidates = jnp.arange(space.n)
    elif method == "grid":
        candidates = _grid(space)
    elif bandit.tells_best_action:
        return _read_off(bandit, params, space)
    else:
        return _ascent(bandit, params, space)

    def best(context: jax.Array) -> jax.Array:
        rewards = jax.vmap(bandit.mean_reward, in_axes=(None, 0, None))(context, candidates, params)
        return candidates[jnp.argmax(rewards)]

    return best


def optimal_policy(bandit: SyntheticBandit, params: BanditParams | None = None) -> Policy:
    """`optimal_actions` as `scb.evaluation.evaluate` takes a policy: of unflattened observations, with a key."""
    return flat(optimal_actions(bandit, params))


def first_action(
    space: spaces.Box | spaces.Discrete,
) -> tuple[int | None, tuple[float, float] | None]:
    """What a map of actions is drawn with: (number of discrete actions, None), or (None, bounds of the first one)."""
    if isinstance(space, spaces.Discrete):
        return action_size(space), None
    low, high = flat_bounds(space)
    return None, (float(low[0]), float(high[0]))


def _grid(space: spaces.Box) -> jax.Array:
    """[N, ...] every combination of evenly spaced values."""
    low, high = flat_bounds(space, np)
    number = GRID_POINTS**low.size
    if number > LARGEST_GRID:
        raise UserError(
            f"a grid of {GRID_POINTS} values over {low.size} action dimensions has {number:.0e} actions: "
            "use the method gradient."
        )
    axes = np.meshgrid(*np.linspace(low, high, GRID_POINTS).T, indexing="ij")
    return jnp.asarray(np.stack([x.ravel() for x in axes], axis=1).reshape(number, *space.shape))


def _read_off(
    bandit: SyntheticBandit, params: BanditParams, space: spaces.Box
) -> Callable[[jax.Array], jax.Array]:
    parts = PolicyDistanceParts.of(params.weights["reward"], *bandit.bounds)
    return lambda context: jnp.reshape(parts.action(parts.best(context)), space.shape)


def _ascent(
    bandit: SyntheticBandit, params: BanditParams, space: spaces.Box
) -> Callable[[jax.Array], jax.Array]:
    low, high = flat_bounds(space)
    # In units of the action's range, so that one step size suits every environment: the centre, and
    # random actions that are the same in every context.
    random = jax.random.uniform(root_key(0), (STARTS - 1, low.size))
    starts = jnp.concatenate([jnp.full((1, low.size), 0.5), random])
    optimizer = optax.adam(optax.cosine_decay_schedule(0.1, STEPS))

    def reward(unit: jax.Array, context: jax.Array) -> jax.Array:
        action = jnp.reshape(low + (high - low) * unit, space.shape)
        return bandit.mean_reward(context, action, params)

    def climb(start: jax.Array, context: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(carry: Any, _: None) -> Any:
            unit, state = carry
            gradient = jax.grad(reward)(unit, context)
            updates, state = optimizer.update(-gradient, state)
            return (jnp.clip(optax.apply_updates(unit, updates), 0.0, 1.0), state), None

        (unit, _), _ = jax.lax.scan(step, (start, optimizer.init(start)), None, STEPS)
        return unit, reward(unit, context)

    def best(context: jax.Array) -> jax.Array:
        ends, rewards = jax.vmap(climb, in_axes=(0, None))(starts, context)
        action = low + (high - low) * ends[jnp.argmax(rewards)]
        return clip_to_space(action, space)

    return best
