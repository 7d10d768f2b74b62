"""What a correction can be added to: drifts that are known in closed form."""

from collections.abc import Callable
from typing import Any

import chex
import jax.numpy as jnp

from scb.agents.drift import clipped_surrogate_drift, relu

# Lu et al. (2022), eq. 6.
DPO_ALPHA = 2.0
DPO_BETA = 0.6


def discovered_drift(
    alpha: Any, beta: Any, log_ratio: Any, advantage: Any, progress: Any, xp: Any = jnp
) -> Any:
    """Discovered policy optimisation (Lu et al., 2022, eq. 6).

    Args:
      alpha, beta: where the penalty sets in, for positive and for negative advantages, > 0.
      log_ratio, advantage, progress: [B] as for every drift; progress is unused.
      xp: the arrays' library, `jax.numpy`, `numpy` or `torch`.

    Returns:
      [B] non-negative penalty.
    """
    chex.assert_equal_shape([log_ratio, advantage, progress])
    gain = xp.expm1(log_ratio) * advantage
    loss = log_ratio * advantage
    positive = relu(gain - alpha * xp.tanh(gain / alpha), xp)
    negative = relu(loss - beta * xp.tanh(loss / beta), xp)
    return xp.where(advantage >= 0, positive, negative)


def _dpo(clip: float, *arguments: Any) -> Any:
    return discovered_drift(DPO_ALPHA, DPO_BETA, *arguments)


# {name: (clip, log_ratio, advantage, progress, xp) -> penalty}; None charges nothing.
BASES: dict[str, Callable[..., Any] | None] = {
    "ppo": clipped_surrogate_drift,
    "dpo": _dpo,
    "none": None,
}
