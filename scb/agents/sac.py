"""Soft actor-critic (Haarnoja et al., 2018), for continuous and discrete actions (Christodoulou, 2019)."""

from dataclasses import dataclass
from typing import Any

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from flax import struct
from gymnax.environments import spaces
from jax.typing import ArrayLike

from scb.agents import networks
from scb.agents.agent import Algorithm
from scb.agents.off_policy import (
    Learner,
    Moment,
    OffPolicyAgent,
    OffPolicyConfig,
    OffPolicyState,
    Transition,
    target_values,
)
from scb.keys import split_key
from scb.spaces import action_size, scale_to_space


@dataclass(frozen=True)
class SACConfig(OffPolicyConfig):
    """Defaults are the paper's inner loop."""

    num_envs: int = 5
    batch_size: int = 256
    gradient_steps: int = 2


@struct.dataclass
class SACHyperparameters:
    """Traced numbers; defaults are the paper's underlined values.

    Attributes:
      learning_rate: of all three optimisers.
      discount: of the return.
      polyak: share of the target network that an iteration keeps: it moves once after all its gradient steps.
      target_entropy_ratio: for discrete actions, the entropy that the temperature is adjusted to,
        as a share of the uniform policy's. For continuous ones it is -A, in the squashed space.
    """

    learning_rate: ArrayLike = 5e-3
    discount: ArrayLike = 0.99
    polyak: ArrayLike = 0.95
    target_entropy_ratio: ArrayLike = 0.7


@dataclass(frozen=True, eq=False)
class SAC(OffPolicyAgent):
    """Soft actor-critic with two critics, which are stacked, and an adjusted temperature."""

    takes = SACHyperparameters
    config: SACConfig
    with_targets = ("critics",)

    def _space(self, env_params: Any) -> tuple[bool, int]:
        space = self.env.action_space(env_params)
        return isinstance(space, spaces.Discrete), action_size(space)

    def _networks(self, env_params: Any) -> tuple[Any, Any]:
        # Any: flax types `apply` as a union with mutated collections, which these never have.
        discrete, size = self._space(env_params)
        shape = (self.config.hidden_sizes, self.config.activation)
        if discrete:
            policy: nn.Module = networks.CategoricalPolicy(size, *shape)
            return policy, networks.stacked(networks.QNetwork, 2)(size, *shape)
        policy = networks.SquashedGaussianPolicy(size, *shape)
        return policy, networks.stacked(networks.Critic, 2)(*shape)

    def optimizer(self, hyperparameters: SACHyperparameters) -> optax.GradientTransformation:
        return optax.adam(hyperparameters.learning_rate)

    def init_params(self, key: jax.Array, env_params: Any) -> dict[str, Any]:
        policy, critics = self._networks(env_params)
        discrete, size = self._space(env_params)
        key_policy, key_critics = split_key(key)
        observation = jnp.zeros(self.observation_size(env_params))
        inputs = (observation,) if discrete else (observation, jnp.zeros(size))
        return {
            "policy": policy.init(key_policy, observation),
            "critics": critics.init(key_critics, *inputs),
            "log_temperature": jnp.zeros(()),
        }

    def explore(
        self, learner: Learner, observation: jax.Array, key: jax.Array, moment: Moment
    ) -> jax.Array:
        return self.greedy(learner, observation, key, moment.env_params, mode=False)

    def greedy(
        self,
        learner: Learner,
        observation: jax.Array,
        key: jax.Array,
        env_params: Any,
        mode: bool,
    ) -> jax.Array:
        policy, _ = self._networks(env_params)
        outputs = policy.apply(learner.params["policy"], observation)
        discrete, _ = self._space(env_params)
        if discrete:
            action: jax.Array = outputs.mode() if mode else outputs.sample(seed=key)
            return action
        squashed = jnp.tanh(outputs[0]) if mode else _sample(key, *outputs)[0]
        return scale_to_space(squashed, self.env.action_space(env_params))

    def distribution(
        self, state: OffPolicyState, observation: jax.Array, env_params: Any
    ) -> distrax.Distribution:
        """[O] observation -> what the agent draws its action from; a continuous one before the tanh."""
        policy, _ = self._networks(env_params)
        inputs = self._inputs(state, jnp.ravel(observation))
        outputs = policy.apply(state.learner.params["policy"], inputs)
        if isinstance(outputs, tuple):
            return distrax.MultivariateNormalDiag(*outputs)
        return outputs

    def q_value(
        self, state: OffPolicyState, observation: jax.Array, action: jax.Array, env_params: Any
    ) -> jax.Array:
        """[O] observation, action -> [] the smaller of the two critics' values."""
        _, critics = self._networks(env_params)
        inputs = self._inputs(state, jnp.ravel(observation))
        params = state.learner.params["critics"]
        discrete, size = self._space(env_params)
        if discrete:
            q: jax.Array = critics.apply(params, inputs)[:, action]
        else:
            q = critics.apply(params, inputs, jnp.reshape(action, (size,)))
        return q.min(axis=0)

    def learn(self, learner: Learner, batch: Transition, key: jax.Array, moment: Moment) -> Learner:
        hyperparameters: SACHyperparameters = moment.hyperparameters
        env_params = moment.env_params
        discrete, size = self._space(env_params)
        policy, critics = self._networks(env_params)
        key_next, key_policy = split_key(key)
        optimizer = self.optimizer(hyperparameters)
        temperature = jnp.exp(learner.params["log_temperature"])

        def soft_value(
            policy_params: Any, critic_params: Any, observation: jax.Array, key: Any
        ) -> Any:
            """[B] E[min Q - temperature * log pi], and [B] the policy's entropy (an estimate of it)."""
            outputs = policy.apply(policy_params, observation)
            if discrete:
                q = critics.apply(critic_params, observation).min(axis=0)
                entropy = outputs.entropy()
                return jnp.sum(outputs.probs * q, axis=-1) + temperature * entropy, entropy
            squashed, log_prob = _sample(key, *outputs)
            action = scale_to_space(squashed, self.env.action_space(env_params))
            q = critics.apply(critic_params, observation, action).min(axis=0)
            return q - temperature * log_prob, -log_prob

        if self.one_step:
            target = batch.reward
        else:
            next_value, _ = soft_value(
                learner.params["policy"],
                learner.targets["critics"],
                batch.next_observation,
                key_next,
            )
            target = target_values(batch, next_value, hyperparameters.discount)

        def critic_loss(critic_params: Any) -> jax.Array:
            if discrete:
                q = critics.apply(critic_params, batch.observation)
                q = jnp.sum(q * jax.nn.one_hot(batch.action, size), axis=-1)
            else:
                action = jnp.reshape(batch.action, (-1, size))
                q = critics.apply(critic_params, batch.observation, action)
            return 0.5 * jnp.sum(jnp.mean((q - target) ** 2, axis=-1))

        gradient = jax.grad(critic_loss)(learner.params["critics"])
        learner = learner.stepped("critics", optimizer, gradient)

        def policy_loss(policy_params: Any) -> tuple[jax.Array, jax.Array]:
            value, entropy = soft_value(
                policy_params, learner.params["critics"], batch.observation, key_policy
            )
            return -jnp.mean(value), jnp.mean(entropy)

        gradient, entropy = jax.grad(policy_loss, has_aux=True)(learner.params["policy"])
        learner = learner.stepped("policy", optimizer, gradient)
        target_entropy = (
            hyperparameters.target_entropy_ratio * np.log(size) if discrete else -float(size)
        )
        # The gradient of exp(log_temperature) * (entropy - target).
        return learner.stepped(
            "log_temperature", optimizer, temperature * (entropy - target_entropy)
        )


def _sample(key: jax.Array, mean: jax.Array, std: jax.Array) -> tuple[jax.Array, jax.Array]:
    """[..., A] squashed sample, [...] its log-density in the squashed space."""
    unsquashed, log_prob = distrax.MultivariateNormalDiag(mean, std).sample_and_log_prob(seed=key)
    squashed, log_det = distrax.Tanh().forward_and_log_det(unsquashed)
    return squashed, log_prob - jnp.sum(log_det, axis=-1)


SAC_ALGORITHM = Algorithm("sac", SAC, SACConfig, SACHyperparameters)
