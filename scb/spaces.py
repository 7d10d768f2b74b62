"""What is asked of gymnax's action and observation spaces: their kind, how many numbers, their bounds."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment, spaces

from scb.errors import UserError


def kind_of_actions(space: spaces.Box | spaces.Discrete) -> str:
    """Either "discrete" or "continuous"."""
    return "discrete" if isinstance(space, spaces.Discrete) else "continuous"


def understood(space: Any) -> bool:
    """Whether it is one `Box` or `Discrete` of gymnax's."""
    return isinstance(space, spaces.Box | spaces.Discrete)


def not_understood(space: Any, of: str) -> str:
    """What is said of a space that is not."""
    return (
        f"has a {type(space).__module__}.{type(space).__name__} of {of}: one Box or Discrete of "
        "gymnax.environments.spaces is understood"
    )


def action_size(space: spaces.Box | spaces.Discrete) -> int:
    """How many discrete actions there are, or how many numbers a flattened action has."""
    if not understood(space):
        raise UserError(f"the environment {not_understood(space, 'actions')}.")
    return int(space.n) if isinstance(space, spaces.Discrete) else math.prod(space.shape)


def flat_size(space: spaces.Box | spaces.Discrete) -> int:
    """How many numbers a flattened observation has; a discrete one is a single number."""
    if not understood(space):
        raise UserError(f"the environment {not_understood(space, 'observations')}.")
    return math.prod(space.shape)


def shapes(env: environment.Environment[Any, Any], params: Any) -> str:
    """What decides whether agents fit an environment, such as "4 observations and 2 discrete actions"."""
    actions = env.action_space(params)
    what = "discrete actions" if isinstance(actions, spaces.Discrete) else "action dimensions"
    return (
        f"{flat_size(env.observation_space(params))} observations and {action_size(actions)} {what}"
    )


def flat_bounds(space: spaces.Box, xp: Any = jnp) -> tuple[Any, Any]:
    """[A], [A] the lower and upper bounds of the flattened space, as arrays of NumPy or of JAX."""
    low, high = (
        xp.ravel(xp.broadcast_to(xp.asarray(bound, xp.float32), space.shape))
        for bound in (space.low, space.high)
    )
    return low, high


def check_bounded(space: spaces.Box | spaces.Discrete) -> None:
    """Raises a UserError where a continuous space has no bounds, between which actions could be drawn or scaled."""
    if isinstance(space, spaces.Discrete):
        return
    for bound in (space.low, space.high):
        if not isinstance(bound, jax.core.Tracer) and not np.isfinite(bound).all():
            raise UserError(
                f"an action's bound is {bound}, and actions are drawn or scaled between bounds (PPO alone trains "
                "without any): give the environment finite ones."
            )


def check_action(action: jax.Array, space: spaces.Box | spaces.Discrete) -> None:
    """Raises a UserError for an action of another kind or size; which of discrete ones it is may be traced."""
    if isinstance(space, spaces.Discrete):
        fits = action.shape == () and not jnp.issubdtype(action.dtype, jnp.inexact)
    else:
        fits = action.size == math.prod(space.shape)
    if not fits:
        raise misfit(action.shape, action.dtype, space)


def misfit(shape: tuple[int, ...], dtype: Any, space: spaces.Box | spaces.Discrete) -> UserError:
    """The error for an action of this shape and type."""
    discrete = isinstance(space, spaces.Discrete)
    allowed = (
        f"a whole number below {space.n}, of shape ()" if discrete else f"of shape {space.shape}"
    )
    return UserError(f"an action has shape {shape} and type {dtype}: it must be {allowed}.")


def clip_to_space(action: jax.Array, space: spaces.Box | spaces.Discrete) -> jax.Array:
    """A continuous action within the space's bounds and of its shape; a discrete one as it is."""
    if isinstance(space, spaces.Discrete):
        return action
    # Gymnax's Pendulum takes only the default floating-point type, which jax_enable_x64 makes one of 64 bits.
    action = jnp.asarray(action, float)
    return jnp.clip(jnp.reshape(action, space.shape), space.low, space.high)


def scale_to_space(squashed: jax.Array, space: spaces.Box) -> jax.Array:
    """[..., A] in [-1, 1] -> [..., A] between the bounds of the flattened action."""
    check_bounded(space)
    low, high = flat_bounds(space)
    return low + (squashed + 1.0) * 0.5 * (high - low)
