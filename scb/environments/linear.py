"""Bandits of some tens of numbers: a linear policy to come close to, in contexts that are normally distributed.

A network of a bandit's usual size has a thousand weights, of which an expert needs few: the reward here is the
distance to the action of a linear policy, and a context is a linear function of its latent. Evolution climbs
in so few dimensions where it hardly moves in a thousand, and the bandit can be read off its weights.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

SATURATED = 0.999  # of the end of an action's range: what lies further out is not told apart


class PolicyDistance(nn.Module):
    """offset - scale * ||a - a*||^power for a* = tanh((s - center) kernel + bias), in halves of the actions' range.

    Scale and power start at 1 and are stored as their logarithms, so that they stay positive.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """[O + A] observation and action -> [1]."""
        observation, action = jnp.split(inputs, [inputs.shape[-1] - len(self.low)])
        zeros = nn.initializers.zeros
        start = nn.initializers.lecun_normal()
        weights = {
            "center": self.param("center", zeros, observation.shape),
            "kernel": self.param("kernel", start, (observation.size, action.size)),
            "bias": self.param("bias", zeros, action.shape),
            **{x: self.param(x, zeros, ()) for x in ("log_scale", "log_power", "offset")},
        }
        distance = PolicyDistanceParts.of(weights, np.asarray(self.low), np.asarray(self.high))
        return jnp.reshape(distance(observation, action), (1,))


class PolicyDistanceParts(NamedTuple):
    """What `PolicyDistance` computes with, as arrays of `xp`, `jax.numpy` or `numpy`."""

    center: Any  # [O]
    kernel: Any  # [O, A]
    bias: Any  # [A]
    offset: Any
    scale: Any
    half_power: Any
    middle: np.ndarray  # [A] of the actions' range
    half_width: np.ndarray  # [A]
    xp: Any

    @classmethod
    def of(cls, weights: Any, low: np.ndarray, high: np.ndarray, xp: Any = jnp) -> Self:
        """Of the weights, and of the [A] actions' bounds."""
        return cls(
            center=weights["center"],
            kernel=weights["kernel"],
            bias=weights["bias"],
            offset=weights["offset"],
            scale=xp.exp(weights["log_scale"]),
            half_power=xp.exp(weights["log_power"]) / 2,
            middle=(low + high) / 2,
            half_width=(high - low) / 2,
            xp=xp,
        )

    def __call__(self, observation: Any, action: Any) -> Any:
        """[..., O] observations and [..., A] actions -> [...]."""
        difference = self.share(action) - self.best(observation)
        return self.reward((difference**2).sum(-1))

    def best(self, observation: Any) -> Any:
        """[..., O] observations -> [..., A] the best actions, -1 to 1 their range."""
        return self.xp.tanh((observation - self.center).dot(self.kernel) + self.bias)

    def share(self, action: Any) -> Any:
        """[..., A] actions, -1 to 1 their range."""
        return (action - self.middle) / self.half_width

    def action(self, share: Any) -> Any:
        """[..., A] what `share` is of."""
        return self.middle + self.half_width * share

    def reward(self, squared_distance: Any) -> Any:
        """[...] of actions that are so far from the best."""
        # A power below 2 has no gradient at zero distance.
        return self.offset - self.scale * (squared_distance + 1e-4) ** self.half_power


def fitted(
    observations: np.ndarray, actions: np.ndarray, low: np.ndarray, high: np.ndarray
) -> dict[str, Any]:
    """Weights whose contexts have the mean and covariance of states, and whose policy is closest to the actions there.

    Args:
      observations: [S, O].
      actions: [S, A] of the expert.
      low, high: [A] the actions' bounds.
    """
    states = np.asarray(observations, np.float64)
    center, covariance = moments(states)
    spread = _spread(covariance)
    shares = (np.asarray(actions, np.float64) - (low + high) / 2) / ((high - low) / 2)
    inputs = np.column_stack([(states - center) / spread, np.ones(len(states))])
    solution = _censored(inputs, np.arctanh(np.clip(shares, -SATURATED, SATURATED)))
    reward = {
        "center": center,
        "kernel": solution[:-1] / spread[:, None],
        "bias": solution[-1],
        "log_scale": np.zeros(()),
        "log_power": np.zeros(()),
        "offset": np.zeros(()),
    }
    return _weights(center, covariance, reward)


def with_states(weights: Mapping[str, Any], observations: np.ndarray) -> dict[str, Any]:
    """The bandit of the same policy whose contexts are half its own and half these [S, O] states.

    They are of the mean and covariance of the two together.
    """
    contexts, reward = weights["initial_state"]["Dense_0"], weights["reward"]
    root, own = (np.asarray(contexts[k], np.float64) for k in ("kernel", "bias"))
    other, covariance = moments(np.asarray(observations, np.float64))
    center, apart = (own + other) / 2, (own - other) / 2
    covariance = (root.T @ root + covariance) / 2 + np.outer(apart, apart)
    bias = reward["bias"] + (center - reward["center"]) @ np.asarray(reward["kernel"], np.float64)
    return _weights(center, covariance, {**reward, "center": center, "bias": bias})


def widened(weights: Mapping[str, Any], stretch: float, jitter: float) -> dict[str, Any]:
    """The bandit of the same policy whose contexts are stretched and jittered, as an expert's states are for a fit."""
    contexts = weights["initial_state"]["Dense_0"]
    root, center = (np.asarray(contexts[k], np.float64) for k in ("kernel", "bias"))
    covariance = root.T @ root
    covariance = stretch**2 * covariance + np.diag(jitter**2 * np.diag(covariance))
    return _weights(center, covariance, weights["reward"])


def moments(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[O] mean and [O, O] covariance of [S, O] states."""
    return states.mean(axis=0), np.cov(states.T).reshape(states.shape[1], -1)


def _spread(covariance: np.ndarray) -> np.ndarray:
    """[O] deviations, of which none is zero."""
    return np.sqrt(np.diag(covariance)) + 1e-6


def _weights(
    center: np.ndarray, covariance: np.ndarray, reward: Mapping[str, Any]
) -> dict[str, Any]:
    """A bandit's, of the [O] mean and [O, O] covariance of its contexts and of its reward."""
    # Entries that the others determine make a covariance singular.
    root = np.linalg.cholesky(covariance + np.diag(1e-6 * _spread(covariance) ** 2))
    contexts = {"Dense_0": {"kernel": root.T, "bias": center}}
    weights = {"initial_state": contexts, "reward": dict(reward)}
    return jax.tree.map(lambda x: np.asarray(x, np.float32), weights)


def _censored(inputs: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """[I, A] least squares where a target at the end of the range says only that it is at least so far out.

    A saturated action does not tell how far: taken at its word, a steep policy would be fitted by a flatter
    one. What the last solution says beyond the end is taken there instead, until nothing moves.
    """
    end = np.arctanh(SATURATED)
    beyond, wanted = np.abs(targets) >= end, targets
    solution = np.linalg.lstsq(inputs, wanted, rcond=None)[0]
    for _ in range(200):
        further = np.sign(targets) * np.maximum(np.sign(targets) * (inputs @ solution), end)
        wanted = np.where(beyond, further, targets)
        previous, solution = solution, np.linalg.lstsq(inputs, wanted, rcond=None)[0]
        if np.allclose(solution, previous, rtol=1e-4, atol=1e-6):
            break
    return solution


def units(weights: Any) -> Any:
    """What a change of 1 is for each weight: a deviation of a context's entry, or what moves the input of tanh by 1."""
    contexts, reward = weights["initial_state"]["Dense_0"], weights["reward"]
    spread = jnp.sqrt(jnp.sum(jnp.asarray(contexts["kernel"]) ** 2, axis=0)) + 1e-6
    return {
        "initial_state": {
            "Dense_0": {
                "kernel": jnp.broadcast_to(spread, contexts["kernel"].shape),
                "bias": spread,
            }
        },
        "reward": {
            **jax.tree.map(jnp.ones_like, reward),
            "center": spread,
            "kernel": jnp.broadcast_to(1 / spread[:, None], reward["kernel"].shape),
            # It makes no difference to most agents.
            "offset": jnp.full((), 0.01),
        },
    }
