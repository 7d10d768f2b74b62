"""The learned drift of Lu et al. (2022): a small network that corrects PPO's clip, or stands alone."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp

from lpo.drifts.contract import Array, CorrectedDrift
from scb.errors import UserError, at_least
from scb.keys import split_key

# The order of the network's inputs, d = ratio - 1 side. Other code uses other orders and signs, so it
# is stored with every artefact.
FEATURES = (
    "1-r",
    "(1-r)^2",
    "log r",
    "(log r)^2",
    "A(1-r)",
    "A(1-r)^2",
    "A log r",
    "A(log r)^2",
)
# A temporally-aware drift sees every feature a second time, scaled by the fraction of training done
# (Jackson et al., 2024). A fraction as an input of its own would not vanish at ratio 1.
TEMPORAL_FEATURES = (*FEATURES, *(f"n/N {feature}" for feature in FEATURES))


@dataclass(frozen=True, kw_only=True)
class LearnedDrift(CorrectedDrift):
    """relu(base + gate * net(features) - xi) (Lu et al., 2022).

    The conditions of mirror learning hold whatever the weights: all features vanish at ratio 1 and no layer
    has a bias.

    Attributes:
      hidden_size: of the one tanh layer.
      temporal: let the drift change over an agent's training: its features come a second time scaled by
        the fraction of training done (Jackson et al., 2024, TA-LPO).
    """

    name: ClassVar[str] = "network"
    learned: ClassVar[bool] = True

    hidden_size: int = 128
    temporal: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(1, self, "hidden_size")

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the network's inputs, in their order."""
        return TEMPORAL_FEATURES if self.temporal else FEATURES

    def to_config(self) -> dict[str, Any]:
        return {**super().to_config(), "features": list(self.features)}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        features = tuple(config["features"])
        drift = super().from_config({**config, "temporal": features == TEMPORAL_FEATURES})
        if features != drift.features:
            raise UserError(
                f"the drift was learned on other features ({', '.join(map(str, features))}) than this version "
                f"computes ({', '.join(drift.features)}): use the version that made it."
            )
        return drift

    def init(self, key: jax.Array, scale: float = 1.0) -> dict[str, jax.Array]:
        """Flax's default initialisation, the output layer's times `scale`, and never zeros.

        The network is odd in its weights, net(W1, W2) = net(-W1, -W2): from zeros, antithetic pairs
        of an evolution strategy would tie exactly and the search would never leave.
        """
        key_hidden, key_output = split_key(key)
        initialize = jax.nn.initializers.lecun_normal()
        return {
            "hidden": initialize(key_hidden, (len(self.features), self.hidden_size)),
            "output": initialize(key_output, (self.hidden_size, 1)) * scale,
        }

    def correction(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any
    ) -> Array:
        inputs = drift_features(log_ratio, advantage, xp)
        if self.temporal:
            inputs = xp.concatenate([inputs, progress[..., None] * inputs], -1)
        return (xp.tanh(inputs @ parameters["hidden"]) @ parameters["output"])[..., 0]


def drift_features(log_ratio: Array, advantage: Array, xp: Any = jnp) -> Array:
    """[B], [B] -> [B, 8] features in the order of `FEATURES`, all zero at ratio 1."""
    delta = -xp.expm1(log_ratio)  # 1 - r, exact near r = 1 where exp(log r) - 1 would round
    away = xp.stack([delta, delta**2, log_ratio, log_ratio**2], -1)
    return xp.concatenate([away, advantage[..., None] * away], -1)
