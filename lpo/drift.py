"""Drift functionals: what a policy update pays for moving away from the behaviour policy.

A drift f(ratio, advantage) >= 0 with value and gradient zero at ratio = 1 keeps PPO-style updates
inside the mirror-learning framework (Kuba et al., 2022), whose members all improve monotonically.
PPO maximises `mean(ratio * advantage - f)`. PPO's clip, DPO's closed form and a learned network are
members of one contract, so that a training loop cannot tell them apart.
"""

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

import chex
import jax
import jax.numpy as jnp

from scb.agents.ppo import clipped_surrogate_drift
from scb.errors import UserError, unknown_name
from scb.keys import split_key

Base: TypeAlias = Literal["ppo", "none"]
BASES: tuple[Base, ...] = ("ppo", "none")

# The order of the learned drift's inputs, d = ratio - 1 side. Other code uses other orders and
# signs, so it is stored with every artefact.
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


@runtime_checkable
class Drift(Hashable, Protocol):
    """A family of drifts: a static, hashable part, and parameters that are traced, so a population of them vmaps."""

    def init(self, key: jax.Array) -> Any:
        """Parameters: a pytree of float arrays."""

    def __call__(
        self, parameters: Any, log_ratio: jax.Array, advantage: jax.Array, progress: jax.Array
    ) -> jax.Array:
        """The penalty.

        Args:
          parameters: as from `init`.
          log_ratio: [B] log pi(a|s) - log pi_behaviour(a|s), in nats.
          advantage: [B] advantage, normalised over the minibatch.
          progress: [B] fraction of training done, in [0, 1].

        Returns:
          [B] penalty.
        """


@dataclass(frozen=True)
class ClipDrift:
    """PPO's clipped surrogate as a drift; its parameter is the clip epsilon."""

    clip: float = 0.2

    def __post_init__(self) -> None:
        if not self.clip > 0:
            raise UserError(f"the clip epsilon is {self.clip}: it must be positive.")

    def init(self, key: jax.Array) -> jax.Array:
        return jnp.float32(self.clip)

    def __call__(
        self, parameters: Any, log_ratio: jax.Array, advantage: jax.Array, progress: jax.Array
    ) -> jax.Array:
        return clipped_surrogate_drift(parameters, log_ratio, advantage, progress)


@dataclass(frozen=True)
class DPODrift:
    """Discovered policy optimisation (Lu et al., 2022, eq. 6): the closed form read off a learned drift."""

    alpha: float = 2.0
    beta: float = 0.6

    def __post_init__(self) -> None:
        if not (self.alpha > 0 and self.beta > 0):
            raise UserError(
                f"DPO's alpha and beta are {self.alpha} and {self.beta}: both must be positive."
            )

    def init(self, key: jax.Array) -> dict[str, jax.Array]:
        return {"alpha": jnp.float32(self.alpha), "beta": jnp.float32(self.beta)}

    def __call__(
        self, parameters: Any, log_ratio: jax.Array, advantage: jax.Array, progress: jax.Array
    ) -> jax.Array:
        chex.assert_equal_shape([log_ratio, advantage, progress])
        alpha, beta = parameters["alpha"], parameters["beta"]
        gain = jnp.expm1(log_ratio) * advantage
        loss = log_ratio * advantage
        positive = jax.nn.relu(gain - alpha * jnp.tanh(gain / alpha))
        negative = jax.nn.relu(loss - beta * jnp.tanh(loss / beta))
        return jnp.where(advantage >= 0, positive, negative)


@dataclass(frozen=True)
class NoDrift:
    """No penalty at all: the plain policy-gradient surrogate."""

    def init(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(())

    def __call__(
        self, parameters: Any, log_ratio: jax.Array, advantage: jax.Array, progress: jax.Array
    ) -> jax.Array:
        chex.assert_equal_shape([log_ratio, advantage, progress])
        return jnp.zeros_like(log_ratio)


@dataclass(frozen=True)
class LearnedDrift:
    """A small network as a drift (Lu et al., 2022): relu(base + gate * net(features) - xi).

    The conditions of mirror learning hold whatever the weights: all features and the base vanish at
    ratio 1 together with the base's gradient, no layer has a bias, and relu(. - xi) is flat around
    0. What the network alone does not bound is the slope just outside that flat zone. There it acts
    like a penalty on |log r|, and updates whose advantages correlate with no direction more than that
    slope never leave ratio 1: found with an objective learned on minibatches of 20, which held a
    policy still on minibatches of 1000. The gate fades the network out there.

    Attributes:
      base: "ppo" adds PPO's clip drift, so that zero weights are PPO; "none" leaves the network
        alone.
      hidden_size: of the one tanh layer.
      clip: epsilon of the PPO base.
      xi: half-width of the dead zone, in units of the penalty; the original code has 1e-4.
      temporal: whether the features come a second time scaled by the fraction of training done, so
        that the drift can change while an agent learns (Jackson et al., 2024, TA-LPO).
      gate: width, in nats of log-ratio, of the region around ratio 1 where the network is faded out,
        by 1 - exp(-(log r / gate)^2). 0 leaves it as it is, as in the original.
    """

    base: Base = "ppo"
    hidden_size: int = 128
    clip: float = 0.2
    xi: float = 1e-6
    temporal: bool = False
    gate: float = 0.1

    def __post_init__(self) -> None:
        check_gate(self.gate)
        if self.base not in BASES:
            raise unknown_name("drift base", self.base, BASES)
        if self.hidden_size < 1:
            raise UserError(f"hidden_size is {self.hidden_size}: it must be at least 1.")
        if not (self.clip > 0 and self.xi > 0):
            raise UserError(f"clip and xi are {self.clip} and {self.xi}: both must be positive.")

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the network's inputs, in their order."""
        return TEMPORAL_FEATURES if self.temporal else FEATURES

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"hidden": (len(self.features), self.hidden_size), "output": (self.hidden_size, 1)}

    def init(self, key: jax.Array) -> dict[str, jax.Array]:
        """Flax's default initialisation, never zeros.

        The network is odd in its weights, net(W1, W2) = net(-W1, -W2): from zeros, antithetic pairs
        of an evolution strategy would tie exactly and the search would never leave.
        """
        key_hidden, key_output = split_key(key)
        initialize = jax.nn.initializers.lecun_normal()
        shapes = self.weight_shapes()
        return {
            "hidden": initialize(key_hidden, shapes["hidden"]),
            "output": initialize(key_output, shapes["output"]),
        }

    def __call__(
        self, parameters: Any, log_ratio: jax.Array, advantage: jax.Array, progress: jax.Array
    ) -> jax.Array:
        chex.assert_equal_shape([log_ratio, advantage, progress])
        inputs = drift_features(log_ratio, advantage)
        if self.temporal:
            inputs = jnp.concatenate([inputs, progress[..., None] * inputs], axis=-1)
        penalty = (jnp.tanh(inputs @ parameters["hidden"]) @ parameters["output"])[..., 0]
        penalty = gated(penalty, log_ratio, self.gate)
        if self.base == "ppo":
            penalty = penalty + clipped_surrogate_drift(self.clip, log_ratio, advantage, progress)
        return jax.nn.relu(penalty - self.xi)


def check_gate(width: float) -> None:
    """Raises a UserError for what is no width."""
    if not 0 <= width < math.inf:
        raise UserError(f"gate is {width}: it must be 0 or larger, and finite.")


def gated(penalty: Any, log_ratio: Any, width: float, library: Any = jnp) -> Any:
    """[B] the penalty faded out around ratio 1, by 1 - exp(-(log r / width)^2); as it is where the width is 0.

    The arrays are those of `library`: `jax.numpy`, `numpy` or `torch`.
    """
    return penalty * -library.expm1(-((log_ratio / width) ** 2)) if width else penalty


def drift_features(log_ratio: jax.Array, advantage: jax.Array) -> jax.Array:
    """[B], [B] -> [B, 8] features in the order of `FEATURES`, all zero at ratio 1."""
    chex.assert_equal_shape([log_ratio, advantage])
    delta = -jnp.expm1(log_ratio)  # 1 - r, exact near r = 1 where exp(log r) - 1 would round
    away = jnp.stack([delta, delta**2, log_ratio, log_ratio**2], axis=-1)
    return jnp.concatenate([away, advantage[..., None] * away], axis=-1)
