"""Two objectives of one's own: a function, and a family with numbers to be learned.

lpo evaluate --objectives ppo examples.own_objective:spo --seeds 10
lpo meta-train --drift examples.own_objective:TwoSided --sigma 0.2 --learning-rate 0.1 --out runs/two-sided

From the folder above this one, or with the module's name as Python finds it.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

import lpo


def spo(ratio, advantage, xp):
    """Simple policy optimization (Xie et al., 2024): a square that pulls the ratio back, in place of a clip."""
    return ratio * advantage - xp.abs(advantage) * (ratio - 1) ** 2 / (2 * 0.2)


@dataclass(frozen=True)
class TwoSided(lpo.Drift):
    """The same square, with a strength of its own for either sign of the advantage, which a search finds.

    Attributes:
      strength: that both begin with.
    """

    learned = True
    strength: float = 2.5

    def init(self, key, scale=1.0):
        start = jnp.log(self.strength)
        return {"log_strength": start + scale * jax.random.normal(key, (2,))}

    def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
        """[B] what PPO is charged."""
        up, down = (xp.exp(parameters["log_strength"][i]) for i in (0, 1))
        strength = xp.where(advantage > 0, up, down)
        return strength * xp.abs(advantage) * xp.expm1(log_ratio) ** 2
