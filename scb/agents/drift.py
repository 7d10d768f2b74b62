"""What a drift is to PPO: a penalty of ratio and advantage that takes the place of the clip (Lu et al., 2022)."""

from collections.abc import Callable
from typing import Any, TypeAlias

import chex
import jax
import jax.numpy as jnp

from scb.errors import UserError, first_line

DriftFunction: TypeAlias = Callable[[Any, jax.Array, jax.Array, jax.Array], jax.Array]

# exp(20) squared still fits into float32; beyond it a learned drift would meet infinities that
# PPO's never does.
MAX_LOG_RATIO = 20.0
USUAL_CLIP = 0.2


def relu(x: Any, xp: Any = jnp) -> Any:
    """max(x, 0) of an array of `xp`, `jax.numpy`, `numpy` or `torch`, with slope 0 at 0 in each."""
    if xp is jnp:
        return jax.nn.relu(x)
    # NumPy has none, nor slopes.
    return xp.relu(x) if hasattr(xp, "relu") else xp.maximum(x, 0)


def clipped_surrogate_drift(
    clip: Any, log_ratio: Any, advantage: Any, progress: Any, xp: Any = jnp
) -> Any:
    """PPO's clip written as a drift (Lu et al., 2022, eq. 4).

    Args:
      clip: the half-width of the trust interval, > 0.
      log_ratio: [B] log pi(a|s) - log pi_behaviour(a|s), in nats.
      advantage: [B] normalised advantage.
      progress: [B] fraction of training done; unused here.
      xp: the arrays' library, `jax.numpy`, `numpy` or `torch`.

    Returns:
      [B] non-negative penalty; ratio * advantage - drift equals PPO's minimum.
    """
    chex.assert_equal_shape([log_ratio, advantage, progress])
    ratio = xp.exp(log_ratio)
    return relu((ratio - xp.clip(ratio, 1.0 - clip, 1.0 + clip)) * advantage, xp)


def check_drift(
    drift: DriftFunction,
    parameters: Any,
    *,
    advice: str,
    drift_name: str = "the drift",
    parameters_name: str = "these parameters",
) -> None:
    """A UserError where a drift cannot take its parameters, or returns no penalty for each ratio.

    Args:
      advice: what to give of an objective.
      drift_name, parameters_name: as whoever gave them knows them.
    """
    one = jnp.zeros(1)
    try:
        penalty = jax.eval_shape(drift, parameters, one, one, one)
    except UserError:  # a drift's own sentence
        raise
    except Exception as error:  # what a drift raises for parameters of another kind is its own
        raise UserError(
            f"{drift_name} cannot take {parameters_name}: {advice}; a drift of your own takes (parameters, log_ratio "
            f"[B], advantage [B], progress [B]), and says here: {first_line(error)}."
        ) from error
    if getattr(penalty, "shape", None) != one.shape:
        raise UserError(
            f"{drift_name} returns {getattr(penalty, 'shape', penalty)} for one ratio: give a penalty for each, of the "
            "shape of log_ratio."
        )
