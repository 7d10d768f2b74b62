"""Synthetic contextual bandits: one-step environments whose weights are evolved.

Liesen et al. (2024), "Discovering Minimal Reinforcement Learning Environments". A context is a
learned function of a latent, `obs = initial_state(latent)`; the reward is a learned function of
context and action; the episode ends there. All weights live in the environment's parameters, so a
population of bandits is `vmap` over `params` in one program.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar, cast

import distrax
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct
from gymnax.environments import environment, spaces
from jax.typing import ArrayLike

from scb import artefacts
from scb.agents.networks import ACTIVATIONS, MLP
from scb.environments.linear import PolicyDistance, units
from scb.errors import UserError, at_least, one_of
from scb.keys import split_key
from scb.spaces import action_size, check_action, flat_bounds, flat_size

Weights: TypeAlias = dict[str, dict[str, Any]]


def _one_hot_latent(logits: jax.Array, key: jax.Array) -> jax.Array:
    return jax.nn.one_hot(distrax.Categorical(logits=logits).sample(seed=key), logits.shape[0])


LATENTS: dict[str, Callable[[jax.Array, int], jax.Array]] = {
    "normal": lambda key, size: distrax.Normal(jnp.zeros(size), jnp.ones(size)).sample(seed=key),
    "uniform": lambda key, size: distrax.Uniform(jnp.zeros(size), jnp.ones(size)).sample(seed=key),
    "categorical": lambda key, size: _one_hot_latent(jnp.zeros(size), key),
    # The paper's second categorical: probabilities softmax(1, 2, ..., n).
    "softmax_categorical": lambda key, size: _one_hot_latent(jnp.arange(1.0, size + 1.0), key),
}


FORMS = ("networks", "linear")


@struct.dataclass
class BanditState(environment.EnvState):
    context: jax.Array  # [O]


@struct.dataclass
class BanditParams(environment.EnvParams):
    """What a step may read: all traced, so bandits and noise levels vmap.

    Attributes:
      weights: {"initial_state": {...}, "reward": {...}}, of the form networks two Dense layers each.
      reward_noise: standard deviation of Gaussian noise on the reward, in the reward's own units.
        Zero for training an agent; larger than the reward's own spread for learning objectives,
        whose advantages must be as uncertain as a real environment's.
      max_steps_in_episode: 1; a bandit has no second step.
    """

    weights: Weights = struct.field(default_factory=dict)
    reward_noise: ArrayLike = 0.0
    max_steps_in_episode: int = 1


@dataclass(frozen=True)
class BanditConfig:
    """What decides a bandit's shapes and program; defaults are the paper's.

    Attributes:
      form: networks (as the paper, of one hidden layer each) or linear (contexts normally distributed, and
        the reward a distance to a linear policy's action; for continuous actions), which has no
        hidden layer and no activation.
      hidden_size: units of each network's hidden layer.
      activation: tanh, relu or swish.
      latent: normal, uniform, categorical or softmax_categorical.
      latent_size: numbers that a context is made of; None for the observation's size, as in the paper.
    """

    hidden_size: int = 32
    activation: str = "tanh"
    latent: str = "normal"
    latent_size: int | None = None
    form: str = "networks"

    def __post_init__(self) -> None:
        one_of("bandit form", self.form, FORMS)
        one_of("bandit activation", self.activation, ACTIVATIONS)
        one_of("latent distribution", self.latent, LATENTS)
        at_least(1, self, "hidden_size", "latent_size")
        if self.form == "linear" and self.latent != "normal":
            raise UserError(
                f"the contexts of the form linear are normally distributed, and the latent is {self.latent}: take "
                "normal, or the form networks."
            )


_State = TypeVar("_State", bound=environment.EnvState)
_Params = TypeVar("_Params", bound=environment.EnvParams)


class SyntheticEnvironment(environment.Environment[_State, _Params]):
    """What bandits and MDPs share: the shapes of an evaluation environment, and a learned reward.

    Args:
      observation_size: O, the flattened observation size of the evaluation environment.
      action_space: the evaluation environment's action space. A discrete action enters the
        networks one-hot, a continuous one clipped to the bounds.
      config: layer size, activation, latent distribution.
      weights: what `default_params` holds; None for one that is only ever given explicit `params`.
      name: as registered, e.g. "Synthetic-Pendulum-v1".
    """

    config: BanditConfig
    parameters: type[Any]  # of `params`
    # What is learned, in the order of the keys that its first weights are drawn with.
    learned: tuple[str, ...] = ("initial_state", "reward")
    max_steps = 1
    # Whether every episode is a single step, whatever the params; a maximum of 1 in params alone is no promise.
    one_step = True

    def __init__(
        self,
        observation_size: int,
        action_space: spaces.Box | spaces.Discrete,
        config: BanditConfig,
        weights: Weights | None,
        name: str,
    ) -> None:
        if config.form == "linear" and config.latent_size not in (None, observation_size):
            raise UserError(
                f"latent_size is {config.latent_size}, and the form linear makes the {observation_size} observations "
                "of as many numbers: leave it out, or take the form networks."
            )
        if not isinstance(action_space, spaces.Box | spaces.Discrete):
            raise UserError(
                f"the action space is a {type(action_space).__module__}.{type(action_space).__name__}: give gymnax's "
                "Box or Discrete."
            )
        self.config = config
        self.observation_size = observation_size
        self._action_space = action_space
        self._name = name
        self.discrete = isinstance(action_space, spaces.Discrete)
        self._action_size = action_size(action_space)
        self.latent_size = config.latent_size or observation_size
        self._weights = weights

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._name!r})"

    @property
    def name(self) -> str:
        return self._name

    @property
    def num_actions(self) -> int:
        return self._action_size

    @property
    def default_params(self) -> _Params:
        if self._weights is None:
            raise UserError(
                f"{self.name!r} has no weights of its own: pass params, such as params(weights)."
            )
        return self.params(self._weights)

    def params(self, weights: Weights) -> _Params:
        """These weights, without reward noise and with the maximum episode length that it is made for."""
        return cast(_Params, self.parameters(weights=weights, max_steps_in_episode=self.max_steps))

    def init_weights(self, key: jax.Array) -> Weights:
        """Random weights (Flax's default initialisation), the start of the paper's evolution."""
        keys = split_key(key, len(self.learned))
        joined = self.observation_size + self._action_size
        sizes = [self.latent_size if name == "initial_state" else joined for name in self.learned]
        return {
            name: self._network(name).init(k, jnp.zeros(size))["params"]
            for name, k, size in zip(self.learned, keys, sizes, strict=True)
        }

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """{"reward/Dense_0/kernel": (O + A, hidden), ...}: what an artefact must hold."""
        return artefacts.shapes_of(self.init_weights)

    def context(self, latent: jax.Array, params: _Params) -> jax.Array:
        """[L] latent -> [O] observation."""
        return self._learned("initial_state", latent, params)

    def draw_context(self, key: jax.Array, params: _Params) -> jax.Array:
        """[O] the observation of a random latent."""
        return self.context(LATENTS[self.config.latent](key, self.latent_size), params)

    def mean_reward(self, context: jax.Array, action: ArrayLike, params: Any) -> jax.Array:
        """[O] observation, action -> [] reward without noise: in one-step episodes the Q-function."""
        return self._learned("reward", self._inputs(context, action), params)[0]

    def _network(self, name: str) -> nn.Module:
        size = self.observation_size if name in ("initial_state", "transition") else 1
        return MLP((self.config.hidden_size,), size, self.config.activation)

    def _learned(self, name: str, inputs: jax.Array, params: Any) -> jax.Array:
        variables = {"params": params.weights[name]}
        return cast(jax.Array, self._network(name).apply(variables, inputs))

    def action_space(self, params: _Params | None = None) -> spaces.Box | spaces.Discrete:
        return self._action_space

    def observation_space(self, params: _Params | None = None) -> spaces.Box:
        return spaces.Box(-jnp.inf, jnp.inf, (self.observation_size,), jnp.float32)

    def _inputs(self, observation: jax.Array, action: ArrayLike) -> jax.Array:
        return jnp.concatenate([observation, encode_action(action, self._action_space)])


class SyntheticBandit(SyntheticEnvironment[BanditState, BanditParams]):
    """A contextual bandit with learned contexts and rewards, as a gymnax 1.x environment."""

    parameters = BanditParams

    def __init__(
        self,
        observation_size: int,
        action_space: spaces.Box | spaces.Discrete,
        config: BanditConfig | None = None,
        weights: Weights | None = None,
        name: str = "SyntheticBandit",
    ) -> None:
        super().__init__(observation_size, action_space, config or BanditConfig(), weights, name)
        if self.linear and self.discrete:
            raise UserError(
                f"{name} has discrete actions, and a linear bandit continuous ones: choose the form networks."
            )

    @property
    def linear(self) -> bool:
        """Whether it is of the form linear."""
        return self.config.form == "linear"

    @property
    def tells_best_action(self) -> bool:
        """Whether the best action of a context is written in the weights."""
        return self.linear

    def _network(self, name: str) -> nn.Module:
        if not self.linear:
            return super()._network(name)
        if name == "initial_state":
            return MLP((), self.observation_size, self.config.activation)
        return PolicyDistance(*(tuple(x.tolist()) for x in self.bounds))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """[A] lowest and [A] highest actions, of continuous ones."""
        return flat_bounds(cast(spaces.Box, self._action_space), np)

    def units(self, weights: Weights) -> Weights | None:
        """What a change of 1 is for each weight; None where it is 1 for all."""
        return units(weights) if self.linear else None

    def with_reward(self, weights: Weights, factor: float, shift: float) -> Weights:
        """The bandit whose reward is `factor * reward + shift`."""
        reward = dict(weights["reward"])
        if self.linear:
            reward["log_scale"] = reward["log_scale"] + jnp.log(factor)
            reward["offset"] = reward["offset"] * factor + shift
        else:
            # Through the network's last layer, which is linear.
            name = max(reward)
            last = jax.tree.map(lambda x: x * factor, reward[name])
            reward[name] = {**last, "bias": last["bias"] + shift}
        return {**weights, "reward": reward}

    def reset_env(self, key: jax.Array, params: BanditParams) -> tuple[jax.Array, BanditState]:
        context = self.draw_context(key, params)
        return context, BanditState(time=jnp.int32(0), context=context)

    def step_env(
        self, key: jax.Array, state: BanditState, action: ArrayLike, params: BanditParams
    ) -> tuple[jax.Array, BanditState, jax.Array, jax.Array, dict[str, Any]]:
        reward = self.mean_reward(state.context, action, params)
        reward = reward + params.reward_noise * jax.random.normal(key)
        state = state.replace(time=state.time + 1)
        return state.context, state, reward, jnp.bool_(True), {"discount": jnp.float32(0.0)}

    def is_terminated(self, state: BanditState, params: BanditParams) -> jax.Array:
        return state.time >= 1

    def is_truncated(self, state: BanditState, params: BanditParams) -> jax.Array:
        # The one step ends the episode by itself; calling it truncated too would invite
        # bootstrapping.
        return jnp.bool_(False)

    def sample_rewards(self, params: BanditParams, key: jax.Array, num_samples: int) -> jax.Array:
        """[num_samples] noiseless rewards of random contexts and uniformly random actions."""

        def sample(key: jax.Array) -> jax.Array:
            key_context, key_action = split_key(key)
            context, _ = self.reset_env(key_context, params)
            return self.mean_reward(context, self._action_space.sample(key_action), params)

        return jax.vmap(sample)(split_key(key, num_samples))

    def reward_scale(
        self, params: BanditParams, key: jax.Array, num_samples: int = 4096
    ) -> jax.Array:
        """[] standard deviation of `sample_rewards`."""
        return jnp.std(self.sample_rewards(params, key, num_samples))


def encode_action(action: ArrayLike, space: spaces.Box | spaces.Discrete) -> jax.Array:
    """An action as networks take it: [A], a discrete one one-hot, a continuous one clipped to its bounds.

    Raises:
      UserError: one of another kind or size; a discrete one that is, where it is not traced, none of the space's.
    """
    action = jnp.asarray(action)
    check_action(action, space)
    if isinstance(space, spaces.Discrete):
        if not isinstance(action, jax.core.Tracer) and action not in range(space.n):
            raise UserError(
                f"the action is {action}: it must be a whole number from 0 to {space.n - 1}."
            )
        return jax.nn.one_hot(action.astype(int), action_size(space))
    return jnp.reshape(jnp.clip(action, space.low, space.high), (action_size(space),))


def bandit_for(
    env: environment.Environment[Any, Any], env_params: Any, config: BanditConfig, name: str
) -> SyntheticBandit:
    """An untrained bandit with the (flattened) observation and action shapes of an evaluation environment."""
    observation_size = flat_size(env.observation_space(env_params))
    return SyntheticBandit(observation_size, env.action_space(env_params), config, name=name)
