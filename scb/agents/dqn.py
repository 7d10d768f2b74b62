"""Deep Q-learning (Mnih et al., 2015) and double Q-learning (van Hasselt et al., 2015), one traced flag apart."""

from dataclasses import dataclass, replace
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
    require_actions,
    target_values,
)
from scb.keys import split_key
from scb.spaces import action_size


@dataclass(frozen=True)
class DQNConfig(OffPolicyConfig):
    """Defaults are the paper's inner loop.

    Attributes:
      target_update_every: environment steps between copies of the network into its target.
    """

    num_envs: int = 10
    target_update_every: int = 50


@struct.dataclass
class DQNHyperparameters:
    """Traced numbers; defaults are the paper's underlined values, which make it double DQN.

    Attributes:
      double: 1.0 to pick the next action by the network and judge it by the target (double
        Q-learning), 0.0 to do both by the target.
      epsilon_start: probability of a random action at first.
      epsilon_end: what it falls to, linearly.
      epsilon_decay: fraction of the training in which it does.
    """

    learning_rate: ArrayLike = 5e-3
    discount: ArrayLike = 0.99
    double: ArrayLike = 1.0
    epsilon_start: ArrayLike = 1.0
    epsilon_end: ArrayLike = 0.05
    epsilon_decay: ArrayLike = 0.5
    max_grad_norm: ArrayLike = 10.0


@dataclass(frozen=True, eq=False)
class DQN(OffPolicyAgent):
    """Deep Q-learning with epsilon-greedy exploration; evaluated greedily."""

    takes = DQNHyperparameters
    config: DQNConfig
    with_targets = ("q",)

    def _network(self, env_params: Any) -> Any:
        space = self.env.action_space(env_params)
        require_actions("dqn", space, "discrete")
        return networks.QNetwork(
            action_size(space), self.config.hidden_sizes, self.config.activation
        )

    def init_params(self, key: jax.Array, env_params: Any) -> dict[str, Any]:
        observation = jnp.zeros(self.observation_size(env_params))
        return {"q": self._network(env_params).init(key, observation)}

    def explore(
        self, learner: Learner, observation: jax.Array, key: jax.Array, moment: Moment
    ) -> jax.Array:
        hyperparameters: DQNHyperparameters = moment.hyperparameters
        key_coin, key_random = split_key(key)
        number = observation.shape[0]
        done = jnp.clip(moment.progress / hyperparameters.epsilon_decay, 0.0, 1.0)
        start = jnp.asarray(hyperparameters.epsilon_start)
        end = jnp.asarray(hyperparameters.epsilon_end)
        q = self._network(moment.env_params).apply(learner.params["q"], observation)
        random = jax.random.randint(key_random, (number,), 0, q.shape[-1])
        explores = jax.random.uniform(key_coin, (number,)) < start + (end - start) * done
        return jnp.where(explores, random, jnp.argmax(q, axis=-1))

    def greedy(
        self,
        learner: Learner,
        observation: jax.Array,
        key: jax.Array,
        env_params: Any,
        mode: bool,
    ) -> jax.Array:
        return jnp.argmax(
            self._network(env_params).apply(learner.params["q"], observation), axis=-1
        )

    def learn(self, learner: Learner, batch: Transition, key: jax.Array, moment: Moment) -> Learner:
        hyperparameters: DQNHyperparameters = moment.hyperparameters
        network = self._network(moment.env_params)
        if self.one_step:
            target = batch.reward
        else:
            judged = network.apply(learner.targets["q"], batch.next_observation)
            own = network.apply(learner.params["q"], batch.next_observation)
            pick = jnp.where(jnp.asarray(hyperparameters.double) > 0.5, own, judged)
            best = jax.nn.one_hot(jnp.argmax(pick, axis=-1), pick.shape[-1])
            next_value = jnp.sum(judged * best, axis=-1)
            target = target_values(batch, next_value, hyperparameters.discount)

        def loss(params: Any) -> jax.Array:
            q = network.apply(params, batch.observation)
            taken = jnp.sum(q * jax.nn.one_hot(batch.action, q.shape[-1]), axis=-1)
            return 0.5 * jnp.mean((taken - target) ** 2)

        gradient = jax.grad(loss)(learner.params["q"])
        return learner.stepped("q", self.optimizer(hyperparameters), gradient)

    def update_targets(
        self, learner: Learner, hyperparameters: DQNHyperparameters, iteration: jax.Array
    ) -> Learner:
        every = max(1, self.config.target_update_every // self.config.num_envs)
        copy = (iteration + 1) % every == 0
        targets = jax.tree.map(lambda t, p: jnp.where(copy, p, t), learner.targets, learner.params)
        return replace(learner, targets=targets)


DQN_ALGORITHM = Algorithm("dqn", DQN, DQNConfig, DQNHyperparameters, actions=("discrete",))
# Whose hyperparameters are double DQN's by default.
DDQN_ALGORITHM = Algorithm("ddqn", DQN, DQNConfig, DQNHyperparameters, actions=("discrete",))
