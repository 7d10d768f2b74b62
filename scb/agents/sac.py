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
from scb.agents.agent import Algorithm, scale_to_space
from scb.agents.off_policy import (
    OffPolicyAgent,
    OffPolicyConfig,
    OffPolicyState,
    Transition,
    gradient_update,
    polyak_average,
    target_values,
)
from scb.keys import split_key


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
      polyak: share of the target network that an update keeps.
      target_entropy_ratio: for discrete actions, the entropy that the temperature is adjusted to,
        as a share of the uniform policy's. For continuous ones it is -A, in the squashed space.
    """

    learning_rate: ArrayLike = 5e-3
    discount: ArrayLike = 0.99
    polyak: ArrayLike = 0.95
    target_entropy_ratio: ArrayLike = 0.7


@struct.dataclass
class SACLearner:
    params: dict[str, Any]  # {"policy", "critics" (two, stacked), "log_temperature"}
    targets: Any  # of the critics; empty in one-step environments
    optimizer: dict[str, optax.OptState]


@dataclass(frozen=True, eq=False)
class SAC(OffPolicyAgent):
    """Soft actor-critic with two critics and an adjusted temperature."""

    config: SACConfig

    def _space(self, env_params: Any) -> tuple[bool, int]:
        space = self.env.action_space(env_params)
        if isinstance(space, spaces.Discrete):
            return True, int(space.n)
        return False, int(np.prod(space.shape))

    def _networks(self, env_params: Any) -> tuple[Any, Any]:
        # Any: flax types `apply` as a union with mutated collections, which these never have.
        discrete, size = self._space(env_params)
        shape = (self.config.hidden_sizes, self.config.activation)
        if discrete:
            policy: nn.Module = networks.CategoricalPolicy(size, *shape)
            return policy, networks.stacked(networks.QNetwork, 2)(size, *shape)
        policy = networks.SquashedGaussianPolicy(size, *shape)
        return policy, networks.stacked(networks.Critic, 2)(*shape)

    def init_learner(
        self, key: jax.Array, hyperparameters: SACHyperparameters, env_params: Any
    ) -> SACLearner:
        policy, critics = self._networks(env_params)
        discrete, size = self._space(env_params)
        key_policy, key_critics = split_key(key)
        observation = jnp.zeros(self.observation_size(env_params))
        inputs = (observation,) if discrete else (observation, jnp.zeros(size))
        params = {
            "policy": policy.init(key_policy, observation),
            "critics": critics.init(key_critics, *inputs),
            "log_temperature": jnp.zeros(()),
        }
        optimizer = optax.adam(hyperparameters.learning_rate)
        return SACLearner(
            params=params,
            targets=None if self.one_step else params["critics"],
            optimizer={name: optimizer.init(p) for name, p in params.items()},
        )

    def explore(
        self,
        learner: SACLearner,
        hyperparameters: SACHyperparameters,
        observation: jax.Array,
        key: jax.Array,
        progress: jax.Array,
        env_params: Any,
    ) -> jax.Array:
        return self.greedy(learner, observation, key, env_params, mode=False)

    def greedy(
        self,
        learner: SACLearner,
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

    def learn(
        self,
        learner: SACLearner,
        hyperparameters: SACHyperparameters,
        batch: Transition,
        key: jax.Array,
        step: jax.Array,
        env_params: Any,
    ) -> SACLearner:
        discrete, size = self._space(env_params)
        policy, critics = self._networks(env_params)
        key_next, key_policy = split_key(key)
        params, optimizer_state = dict(learner.params), dict(learner.optimizer)
        optimizer = optax.adam(hyperparameters.learning_rate)
        temperature = jnp.exp(params["log_temperature"])

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
                params["policy"], learner.targets, batch.next_observation, key_next
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

        gradient = jax.grad(critic_loss)(params["critics"])
        params["critics"], optimizer_state["critics"] = gradient_update(
            optimizer, gradient, optimizer_state["critics"], params["critics"]
        )

        def policy_loss(policy_params: Any) -> tuple[jax.Array, jax.Array]:
            value, entropy = soft_value(
                policy_params, params["critics"], batch.observation, key_policy
            )
            return -jnp.mean(value), jnp.mean(entropy)

        gradient, entropy = jax.grad(policy_loss, has_aux=True)(params["policy"])
        params["policy"], optimizer_state["policy"] = gradient_update(
            optimizer, gradient, optimizer_state["policy"], params["policy"]
        )
        target_entropy = (
            hyperparameters.target_entropy_ratio * np.log(size) if discrete else -float(size)
        )
        # The gradient of exp(log_temperature) * (entropy - target).
        gradient = temperature * (entropy - target_entropy)
        params["log_temperature"], optimizer_state["log_temperature"] = gradient_update(
            optimizer, gradient, optimizer_state["log_temperature"], params["log_temperature"]
        )
        return SACLearner(params, learner.targets, optimizer_state)

    def update_targets(
        self, learner: SACLearner, hyperparameters: SACHyperparameters, iteration: jax.Array
    ) -> SACLearner:
        targets = polyak_average(learner.targets, learner.params["critics"], hyperparameters.polyak)
        return SACLearner(learner.params, targets, learner.optimizer)


def _sample(key: jax.Array, mean: jax.Array, std: jax.Array) -> tuple[jax.Array, jax.Array]:
    """[..., A] squashed sample, [...] its log-density in the squashed space."""
    unsquashed, log_prob = distrax.MultivariateNormalDiag(mean, std).sample_and_log_prob(seed=key)
    squashed, log_det = distrax.Tanh().forward_and_log_det(unsquashed)
    return squashed, log_prob - jnp.sum(log_det, axis=-1)


SAC_ALGORITHM = Algorithm("sac", SAC, SACConfig, SACHyperparameters)
