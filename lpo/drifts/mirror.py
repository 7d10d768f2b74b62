"""A learned mirror map as a drift: the Bregman divergence of a learned convex potential.

Policy mirror descent (PMD) maximises the advantage minus a Bregman divergence from the old policy; its mirror
map decides what being near means, and negative entropy, whose divergence is KL, is the usual one. Alfano et
al. (2024, "Learning mirror maps in policy mirror descent") learn the map by evolution: the sum over
actions of one convex function of the probability, whose derivative is an increasing network.

Kept of that: one convex scalar function, strictly so and by construction; its derivative an increasing
network beside the terms that give KL and squares; evolution; a search that starts from KL. Dropped: a
drift knows ratios and not probabilities, so the potential is one of the ratio r = pi / pi_old,

    f(r) = B(r, 1) = phi(r) - phi(1) - phi'(1) (r - 1),

whose mean under pi_old is the f-divergence that phi generates. With phi = r log r that and PMD's divergence
are both KL(pi, pi_old); otherwise they differ. It is a penalty within PPO's clipless epochs rather than PMD's
step, whose size is in the weights. And of all drifts it reaches those that don't look at the advantage.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import chex
import jax
import jax.numpy as jnp

from lpo.drifts.contract import Array, Drift
from scb.agents.drift import relu
from scb.errors import at_least, positive
from scb.keys import split_key

# Units bend within a fifth of the ratio or so, which is PPO's clip, and at ratios from 1/2 to 2.
_STEEPNESS = 5.0
_FARTHEST = 0.6931472


@dataclass(frozen=True, kw_only=True)
class MirrorDrift(Drift):
    """relu(B(r, 1) - xi) for a learned convex potential phi of the ratio r.

    phi(r) = a² (r - 1)² / 2 + b² r log r + sum_k c_k² softplus(w_k (r - 1) + o_k). Squares are not negative and
    each term is convex, so B is non-negative with value and slope zero at ratio 1, for all weights.

    Attributes:
      hidden_size: units of the network, each a softplus.
      strength: factor of KL that a search starts from, the inverse of PMD's step size for normalised
        advantages.
      xi: half-width of the dead zone around ratio 1, in units of the penalty, wider than rounding.
    """

    name: ClassVar[str] = "mirror"
    learned: ClassVar[bool] = True
    always_holds: ClassVar[bool] = True

    hidden_size: int = 16
    strength: float = 2.0
    xi: float = 1e-6

    def __post_init__(self) -> None:
        at_least(1, self, "hidden_size")
        positive(strength=+self.strength, xi=+self.xi)  # + takes numbers alone

    def init(self, key: jax.Array, scale: float = 1.0) -> dict[str, jax.Array]:
        """KL times `strength`, and units of random places and slopes whose weights are normal times `scale`."""
        key_slope, key_place, key_weight = split_key(key, 3)
        size = (self.hidden_size,)
        slope = jax.random.normal(key_slope, size)
        place = jnp.exp(jax.random.uniform(key_place, size, minval=-_FARTHEST, maxval=_FARTHEST))
        return {
            "square": jnp.zeros(1),
            "entropy": jnp.full(1, jnp.sqrt(self.strength)),
            "slope": slope,
            "offset": slope * (1.0 - place),
            "weight": scale * jax.random.normal(key_weight, size),
        }

    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        chex.assert_equal_shape([log_ratio, advantage, progress])
        away = xp.expm1(log_ratio)  # r - 1
        start = _STEEPNESS * parameters["offset"]
        move = _STEEPNESS * parameters["slope"] * away[..., None]
        # Each unit's own divergence; that of softplus, whose derivative is the logistic function.
        logistic = 0.5 * (1.0 + xp.tanh(0.5 * start))
        units = _softplus(start + move, xp) - _softplus(start, xp) - logistic * move
        square, entropy = (parameters[x][0] ** 2 for x in ("square", "entropy"))  # one of each
        divergence = (
            square * 0.5 * away**2
            + entropy * ((1.0 + away) * log_ratio - away)
            + units @ parameters["weight"] ** 2
        )
        return relu(divergence - self.xi, xp)


def _softplus(x: Array, xp: Any) -> Array:
    return xp.logaddexp(x, xp.zeros_like(x))
