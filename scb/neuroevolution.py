"""Neuroevolution: a policy network evolved on the return, by SNES and without a gradient.

Liesen et al. (2024) train such policies in discovered bandits, whose search never saw them.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from evosax.algorithms import SNES
from flax import linen as nn
from gymnax.environments import environment, spaces

from scb.agents import networks
from scb.errors import at_least
from scb.evaluation import Policy, evaluate, flat
from scb.keys import split_key
from scb.spaces import action_size, clip_to_space, flat_size, scale_to_space


@dataclass(frozen=True)
class NeuroevolutionConfig:
    """How a policy is evolved.

    Attributes:
      population_size, num_generations, sigma: of SNES; sigma is the initial standard deviation.
      episodes: of each candidate, the same for all of a generation.
      hidden_sizes, activation: of the policy.
    """

    population_size: int = 64
    num_generations: int = 100
    sigma: float = 0.1
    episodes: int = 16
    hidden_sizes: tuple[int, ...] = (64, 64)
    activation: str = "tanh"

    def __post_init__(self) -> None:
        at_least(2, self, "population_size")
        at_least(1, self, "num_generations", "episodes")


def policy_network(
    space: spaces.Box | spaces.Discrete, hidden_sizes: tuple[int, ...], activation: str
) -> nn.Module:
    """A network of one number for each discrete action, or of a continuous action squashed to [-1, 1]."""
    of = networks.QNetwork if isinstance(space, spaces.Discrete) else networks.DeterministicPolicy
    return of(action_size(space), hidden_sizes, activation)


def network_action(outputs: jax.Array, space: spaces.Box | spaces.Discrete) -> jax.Array:
    """The action that the outputs of a `policy_network` stand for, within the bounds."""
    if isinstance(space, spaces.Discrete):
        return jnp.argmax(outputs, axis=-1)
    return clip_to_space(scale_to_space(outputs, space), space)


def evolve_policy(
    env: environment.Environment[Any, Any],
    env_params: Any,
    key: jax.Array,
    config: NeuroevolutionConfig | None = None,
) -> Policy:
    """The mean of the last search distribution, as a policy; traceable, so that many run side by side.

    Args:
      env, env_params: where a candidate's return is its fitness; a bandit or any environment.
      key: decides everything.

    Returns:
      (observation, key) -> action; deterministic.
    """
    config = NeuroevolutionConfig() if config is None else config
    space = env.action_space(env_params)
    # Any: flax types `apply` as a union with mutated collections, which these never have.
    network: Any = policy_network(space, config.hidden_sizes, config.activation)
    size = flat_size(env.observation_space(env_params))

    def policy_of(weights: Any) -> Policy:
        return flat(lambda observation: network_action(network.apply(weights, observation), space))

    key_init, key_start, key_search = split_key(key, 3)
    start = network.init(key_init, jnp.zeros(size))
    snes = SNES(config.population_size, start)
    params = snes.default_params.replace(std_init=config.sigma)

    def generation(state: Any, key: jax.Array) -> tuple[Any, None]:
        key_ask, key_evaluate, key_tell = split_key(key, 3)
        population, state = snes.ask(key_ask, state, params)
        fitness = jax.vmap(
            lambda weights: evaluate(
                env, env_params, policy_of(weights), key_evaluate, config.episodes
            ).returns.mean()
        )(population)
        # evosax minimises.
        state, _ = snes.tell(key_tell, population, -fitness, state, params)
        return state, None

    state, _ = jax.lax.scan(
        generation,
        snes.init(key_start, start, params),
        split_key(key_search, config.num_generations),
    )
    return policy_of(snes.get_mean(state))
