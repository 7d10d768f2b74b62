"""Twin delayed DDPG (Fujimoto et al., 2018); DDPG (Lillicrap et al., 2015) is its case of one critic and no delay."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import ArrayLike

from scb.agents import networks
from scb.agents.agent import Algorithm
from scb.agents.off_policy import (
    Learner,
    Moment,
    OffPolicyAgent,
    OffPolicyConfig,
    Transition,
    gradient_update,
    require_actions,
    target_values,
)
from scb.keys import split_key
from scb.spaces import action_size, scale_to_space


@dataclass(frozen=True)
class TD3Config(OffPolicyConfig):
    """Defaults are the paper's inner loop.

    Attributes:
      num_critics: 2, of which the smaller value counts; DDPG has 1.
      policy_delay: critic updates for each of the policy; DDPG has 1.
    """

    num_critics: int = 2
    policy_delay: int = 2


def ddpg_config(**fields: Any) -> TD3Config:
    """DDPG as a configuration of TD3; `ddpg_hyperparameters` belong to it, for those of TD3 smooth its targets."""
    return TD3Config(num_critics=1, policy_delay=1, **fields)


@struct.dataclass
class TD3Hyperparameters:
    """Traced numbers; defaults are the paper's underlined values.

    Attributes:
      polyak: share of the target networks that an iteration keeps: they move once after all its gradient steps.
      exploration_noise: standard deviation of the noise on actions that gather experience, in units
        of half the action space's width.
      target_noise: of the noise on the next action in the target, likewise.
      target_noise_clip: what that noise is clipped to, likewise.
    """

    learning_rate: ArrayLike = 5e-3
    discount: ArrayLike = 0.99
    polyak: ArrayLike = 0.95
    exploration_noise: ArrayLike = 0.2
    target_noise: ArrayLike = 0.2
    target_noise_clip: ArrayLike = 0.5
    max_grad_norm: ArrayLike = 10.0


def ddpg_hyperparameters(**fields: Any) -> TD3Hyperparameters:
    """DDPG's, whose targets are not smoothed."""
    return TD3Hyperparameters(**{"target_noise": 0.0, **fields})


@dataclass(frozen=True, eq=False)
class TD3(OffPolicyAgent):
    """Deterministic policy gradients with clipped double Q-learning, target smoothing and delayed updates."""

    takes = TD3Hyperparameters
    config: TD3Config
    with_targets = ("policy", "critics")

    def _networks(self, env_params: Any) -> tuple[Any, Any]:
        space = self.env.action_space(env_params)
        require_actions("ddpg" if self.config.num_critics == 1 else "td3", space, "continuous")
        shape = (self.config.hidden_sizes, self.config.activation)
        # The policy follows the first critic; the second lowers a bootstrapped target, and without bootstrapping it
        # would only count in the norm that gradients are clipped to.
        number = 1 if self.one_step else self.config.num_critics
        critics = networks.stacked(networks.Critic, number)(*shape)
        return networks.DeterministicPolicy(action_size(space), *shape), critics

    def init_params(self, key: jax.Array, env_params: Any) -> dict[str, Any]:
        policy, critics = self._networks(env_params)
        key_policy, key_critics = split_key(key)
        observation = jnp.zeros(self.observation_size(env_params))
        return {
            "policy": policy.init(key_policy, observation),
            "critics": critics.init(key_critics, observation, jnp.zeros(policy.action_size)),
        }

    def explore(
        self, learner: Learner, observation: jax.Array, key: jax.Array, moment: Moment
    ) -> jax.Array:
        policy, _ = self._networks(moment.env_params)
        squashed = policy.apply(learner.params["policy"], observation)
        spread = moment.hyperparameters.exploration_noise
        noise = spread * jax.random.normal(key, squashed.shape)
        chosen = jnp.clip(squashed + noise, -1.0, 1.0)
        return scale_to_space(chosen, self.env.action_space(moment.env_params))

    def greedy(
        self,
        learner: Learner,
        observation: jax.Array,
        key: jax.Array,
        env_params: Any,
        mode: bool,
    ) -> jax.Array:
        policy, _ = self._networks(env_params)
        squashed = policy.apply(learner.params["policy"], observation)
        return scale_to_space(squashed, self.env.action_space(env_params))

    def learn(self, learner: Learner, batch: Transition, key: jax.Array, moment: Moment) -> Learner:
        hyperparameters: TD3Hyperparameters = moment.hyperparameters
        policy, critics = self._networks(moment.env_params)
        space = self.env.action_space(moment.env_params)
        optimizer = self.optimizer(hyperparameters)
        action = jnp.reshape(batch.action, (-1, policy.action_size))
        if self.one_step:
            target = batch.reward
        else:
            squashed = policy.apply(learner.targets["policy"], batch.next_observation)
            limit = jnp.asarray(hyperparameters.target_noise_clip)
            noise = hyperparameters.target_noise * jax.random.normal(key, squashed.shape)
            squashed = jnp.clip(squashed + jnp.clip(noise, -limit, limit), -1.0, 1.0)
            next_action = scale_to_space(squashed, space)
            next_q = critics.apply(learner.targets["critics"], batch.next_observation, next_action)
            target = target_values(batch, next_q.min(axis=0), hyperparameters.discount)

        def critic_loss(critic_params: Any) -> jax.Array:
            q = critics.apply(critic_params, batch.observation, action)
            return 0.5 * jnp.sum(jnp.mean((q - target) ** 2, axis=-1))

        gradient = jax.grad(critic_loss)(learner.params["critics"])
        learner = learner.stepped("critics", optimizer, gradient)

        def policy_loss(policy_params: Any) -> jax.Array:
            chosen = scale_to_space(policy.apply(policy_params, batch.observation), space)
            return -jnp.mean(critics.apply(learner.params["critics"], batch.observation, chosen)[0])

        def update_policy(carry: tuple[Any, Any]) -> tuple[Any, Any]:
            policy_params, state = carry
            gradient = jax.grad(policy_loss)(policy_params)
            return gradient_update(optimizer, gradient, state, policy_params)

        carry = (learner.params["policy"], learner.optimizer["policy"])
        if self.config.policy_delay == 1:
            carry = update_policy(carry)
        else:
            # `step` is no member of a vmapped population: this stays a branch, and skips the work.
            due = moment.step % self.config.policy_delay == self.config.policy_delay - 1
            carry = jax.lax.cond(due, update_policy, lambda carry: carry, carry)
        return learner.replaced("policy", *carry)


TD3_ALGORITHM = Algorithm("td3", TD3, TD3Config, TD3Hyperparameters, actions=("continuous",))
DDPG_ALGORITHM = Algorithm(
    "ddpg",
    TD3,
    ddpg_config,
    ddpg_hyperparameters,
    actions=("continuous",),
)
