"""Policy and value networks: separate multilayer perceptrons, as in the paper's tables."""

from collections.abc import Callable
from typing import Any

import distrax
import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.typing import ArrayLike

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "swish": jax.nn.swish,
}


class MLP(nn.Module):
    hidden_sizes: tuple[int, ...]
    output_size: int
    activation: str

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        for size in self.hidden_sizes:
            inputs = ACTIVATIONS[self.activation](nn.Dense(size)(inputs))
        return nn.Dense(self.output_size)(inputs)


def stacked(network: type[nn.Module], number: int) -> Any:
    """Several networks of one kind that share nothing, as one whose variables and outputs have a first axis of them."""
    return nn.vmap(
        network,
        variable_axes={"params": 0},
        split_rngs={"params": True},
        in_axes=None,
        axis_size=number,
    )


def scale_output(variables: Any, scale: ArrayLike) -> Any:
    """A policy's initial variables with the weights of its MLP's last layer multiplied by `scale`.

    A small last layer makes the untrained policy the same in every state, which matters more to PPO
    on continuous actions than anything else about its networks' initialisation (Andrychowicz et al.,
    2021, "What matters in on-policy reinforcement learning?").
    """
    mlp = dict(variables["params"]["MLP_0"])
    name = f"Dense_{len(mlp) - 1}"
    mlp[name] = {**mlp[name], "kernel": mlp[name]["kernel"] * scale}
    return {**variables, "params": {**variables["params"], "MLP_0": mlp}}


class CategoricalPolicy(nn.Module):
    num_actions: int
    hidden_sizes: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array) -> distrax.Distribution:
        """[..., O] -> distribution over [...] integer actions."""
        return distrax.Categorical(
            logits=MLP(self.hidden_sizes, self.num_actions, self.activation)(observation)
        )


class GaussianPolicy(nn.Module):
    """Diagonal Gaussian whose standard deviation is a parameter, not a function of the state; it starts at 1."""

    action_size: int
    hidden_sizes: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array) -> distrax.Distribution:
        """[..., O] -> distribution over [..., A] unbounded actions."""
        mean = MLP(self.hidden_sizes, self.action_size, self.activation)(observation)
        log_std = self.param("log_std", nn.initializers.zeros, (self.action_size,))
        return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(jnp.exp(log_std), mean.shape))


class ValueNetwork(nn.Module):
    hidden_sizes: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """[..., O] -> [...] value."""
        return MLP(self.hidden_sizes, 1, self.activation)(observation)[..., 0]


class QNetwork(nn.Module):
    """Q-values of all discrete actions."""

    num_actions: int
    hidden_sizes: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """[..., O] -> [..., n]."""
        return MLP(self.hidden_sizes, self.num_actions, self.activation)(observation)


class Critic(nn.Module):
    """Q-value of a continuous action."""

    hidden_sizes: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array, action: jax.Array) -> jax.Array:
        """[..., O], [..., A] -> [...]."""
        inputs = jnp.concatenate([observation, action], axis=-1)
        return MLP(self.hidden_sizes, 1, self.activation)(inputs)[..., 0]


class DeterministicPolicy(nn.Module):
    """An action in [-1, 1] per dimension, by a tanh."""

    action_size: int
    hidden_sizes: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """[..., O] -> [..., A]."""
        return jnp.tanh(MLP(self.hidden_sizes, self.action_size, self.activation)(observation))


class SquashedGaussianPolicy(nn.Module):
    """A Gaussian, both of whose moments depend on the observation, to be squashed by a tanh."""

    action_size: int
    hidden_sizes: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """[..., O] -> ([..., A] mean, [..., A] standard deviation), before the tanh."""
        outputs = MLP(self.hidden_sizes, 2 * self.action_size, self.activation)(observation)
        mean, log_std = jnp.split(outputs, 2, axis=-1)
        # The usual bounds: below, the density overflows; above, the tanh saturates.
        return mean, jnp.exp(jnp.clip(log_std, -10.0, 2.0))
