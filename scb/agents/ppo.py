"""Proximal policy optimisation (Schulman et al., 2017) whose surrogate is an argument.

The update maximises `mean(ratio * A - drift(ratio, A))`. With PPO's own drift, `relu((r - clip(r))
A)`, that is exactly `mean(min(r A, clip(r) A))`; a learned drift takes its place without touching
the agent (Lu et al., 2022, "Discovered Policy Optimisation"). Everything is a pure function of
typed keys and traced numbers: one compiled program trains a population with different seeds,
hyperparameters, bandits or drifts.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import chex
import distrax
import jax
import jax.numpy as jnp
import optax
from flax import struct
from gymnax.environments import spaces
from jax.typing import ArrayLike

from scb.agents import networks
from scb.agents.agent import Agent, AgentConfig, Algorithm, clipped_adam
from scb.agents.drift import (
    MAX_LOG_RATIO,
    USUAL_CLIP,
    DriftFunction,
    check_drift,
    clipped_surrogate_drift,
)
from scb.agents.normalization import RunningStatistics, update_statistics
from scb.errors import UserError
from scb.keys import split_key
from scb.spaces import action_size

# Iterations: enough that single batches don't show, few beside a training's thousands.
DIAGNOSED = 4
DIAGNOSIS = ("kl", "outside", "gain", "value_error", "entropy")


@dataclass(frozen=True)
class PPOConfig(AgentConfig):
    """Defaults are the paper's inner loop.

    Attributes:
      num_envs: environments that step side by side.
      num_steps: of each of them, between updates: a batch is num_envs * num_steps transitions (on a bandit
        that many contexts at once).
      num_epochs: passes over a batch.
      num_minibatches: equal parts that it is cut into.
      anneal_learning_rate: linearly to zero over the training.
    """

    num_envs: int = 5
    num_steps: int = 100
    num_epochs: int = 10
    num_minibatches: int = 10
    anneal_learning_rate: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size % self.num_minibatches:
            raise UserError(
                f"num_minibatches is {self.num_minibatches}, which does not divide a batch of {self.batch_size} "
                f"({self.num_envs} environments x {self.num_steps} steps): choose a divisor of {self.batch_size}."
            )
        # Advantages are normalised within a minibatch: of one alone it is 0, and nothing would be learned.
        if self.num_minibatches == self.batch_size:
            raise UserError(
                f"num_minibatches is {self.num_minibatches}, which leaves one transition of {self.batch_size} in each, "
                "whose normalised advantage is 0: choose fewer."
            )

    @property
    def batch_size(self) -> int:
        return self.num_envs * self.num_steps

    @property
    def num_iterations(self) -> int:
        return -(-self.total_steps // self.batch_size)

    def steps_after(self, num_iterations: int) -> int:
        return num_iterations * self.batch_size


@struct.dataclass
class PPOHyperparameters:
    """What is only a number: traced, and so vmapped over a population. Defaults are the paper's underlined values.

    `drift` holds the drift's parameters, whatever pytree it takes; for PPO itself the clip epsilon.
    `horizon` is the number of iterations that the fraction of training done refers to; the
    configuration's where None. `policy_output_scale` multiplies the policy's last layer at
    initialisation: 1 leaves Flax's, as the paper's agents have it; many public PPOs take 0.01.
    """

    learning_rate: ArrayLike = 5e-3
    discount: ArrayLike = 0.99
    gae_lambda: ArrayLike = 0.95
    entropy_coefficient: ArrayLike = 0.01
    value_coefficient: ArrayLike = 0.5
    max_grad_norm: ArrayLike = 10.0
    drift: Any = USUAL_CLIP
    horizon: ArrayLike | None = None
    policy_output_scale: ArrayLike = 1.0


@struct.dataclass
class PPOState:
    """An agent: networks, optimiser, normaliser, and where its environments stand."""

    params: dict[str, Any]  # {"policy": ..., "value": ...}
    optimizer: dict[str, optax.OptState]
    statistics: RunningStatistics
    environment: Any  # [N] states and [N, O] observations, or None on the one-batch path
    iteration: jax.Array
    key: jax.Array


class Batch(NamedTuple):
    """A batch of transitions, [B] each but for observation [B, O] and continuous action [B, A]."""

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    target: jax.Array


def generalized_advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: ArrayLike,
    gae_lambda: ArrayLike,
) -> jax.Array:
    """Generalised advantage estimation (Schulman et al., 2016), with truncation told from termination.

    Args:
      reward, value, terminated, truncated: [T, N]; value is V(s_t).
      next_value: [T, N] V of the observation that the step led to, *before* any automatic reset: at
        a truncation that is the final observation's value, not the next episode's first.
      discount, gae_lambda: traced numbers.

    Returns:
      [T, N] advantages. Termination stops bootstrapping and the trace; truncation stops only the
      trace.
    """
    chex.assert_equal_shape([reward, value, next_value, terminated, truncated])
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    carry_on = jnp.where(terminated | truncated, 0.0, discount * gae_lambda)

    def backward(advantage: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> Any:
        delta, carry_on = inputs
        advantage = delta + carry_on * advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, carry_on), reverse=True
    )
    return advantages


@dataclass(frozen=True, eq=False)
class PPO(Agent):
    """PPO in one environment with one drift; every method is pure, and to be jitted and vmapped by the caller.

    Args:
      env: a gymnax 1.x environment.
      config: static configuration.
      drift: (parameters, log_ratio [B], advantage [B], progress [B]) -> penalty [B].
    """

    takes = PPOHyperparameters
    config: PPOConfig
    drift: DriftFunction = clipped_surrogate_drift

    def __post_init__(self) -> None:
        super().__post_init__()
        if not callable(self.drift):
            raise UserError(
                f"the drift is a {type(self.drift).__name__}, which is no function: of an objective give "
                "objective.drift, and objective.parameters as the hyperparameters' drift."
            )

    def _networks(self, env_params: Any) -> tuple[Any, Any]:
        # Any: flax types `apply` as a union with mutated collections, which these never have.
        space = self.env.action_space(env_params)
        sizes, activation = self.config.hidden_sizes, self.config.activation
        discrete = isinstance(space, spaces.Discrete)
        of: Any = networks.CategoricalPolicy if discrete else networks.GaussianPolicy
        policy = of(action_size(space), sizes, activation)
        return policy, networks.ValueNetwork(sizes, activation)

    def init(
        self, key: jax.Array, hyperparameters: PPOHyperparameters, env_params: Any
    ) -> PPOState:
        """A fresh agent, its environments at their first observation."""
        self.check_inputs(hyperparameters, env_params)
        check_drift(
            self.drift,
            hyperparameters.drift,
            advice="of an objective give objective.drift to the agent, and objective.parameters as the "
            "hyperparameters' drift",
            drift_name="the agent's drift",
            parameters_name="the hyperparameters' drift",
        )
        key_policy, key_value, key_reset, key_train = split_key(key, 4)
        policy, value = self._networks(env_params)
        size = self.observation_size(env_params)
        params = {
            "policy": networks.scale_output(
                policy.init(key_policy, jnp.zeros(size)), hyperparameters.policy_output_scale
            ),
            "value": value.init(key_value, jnp.zeros(size)),
        }
        standing = None
        if not self.one_step:
            standing = self._reset(key_reset, self.config.num_envs, env_params)
        return PPOState(
            params=params,
            optimizer={
                name: clipped_adam(hyperparameters, eps=1e-5).init(p) for name, p in params.items()
            },
            statistics=RunningStatistics.start(size),
            environment=standing,
            iteration=jnp.int32(0),
            key=key_train,
        )

    def choose(
        self, state: PPOState, observation: jax.Array, key: jax.Array, env_params: Any, mode: bool
    ) -> jax.Array:
        distribution = self._policy(state, observation, env_params)
        return distribution.mode() if mode else distribution.sample(seed=key)

    def learned(self, state: PPOState) -> Any:
        return state.params

    def _policy(
        self, state: PPOState, observation: jax.Array, env_params: Any
    ) -> distrax.Distribution:
        policy, _ = self._networks(env_params)
        return policy.apply(state.params["policy"], self._inputs(state, observation))

    def _value(self, state: PPOState, observation: jax.Array, env_params: Any) -> jax.Array:
        _, value = self._networks(env_params)
        return cast(jax.Array, value.apply(state.params["value"], self._inputs(state, observation)))

    def iterate(
        self, state: PPOState, hyperparameters: PPOHyperparameters, env_params: Any
    ) -> PPOState:
        return self._iterate(state, hyperparameters, env_params)[0]

    def _iterate(
        self, state: PPOState, hyperparameters: PPOHyperparameters, env_params: Any
    ) -> tuple[PPOState, Batch]:
        key, key_collect, key_update = split_key(state.key, 3)
        state = replace(state, key=key)
        if self.one_step:
            batch = self._collect_contexts(state, key_collect, env_params)
        else:
            state, batch = self._collect_steps(state, key_collect, hyperparameters, env_params)
        state = self._update(state, key_update, hyperparameters, env_params, batch)
        if self.config.normalize_observations:
            # After the update: the old log-probabilities were taken under the old statistics.
            statistics = update_statistics(state.statistics, batch.observation)
            state = replace(state, statistics=statistics)
        return replace(state, iteration=state.iteration + 1), batch

    def diagnose(
        self, state: PPOState, hyperparameters: PPOHyperparameters, env_params: Any
    ) -> dict[str, jax.Array]:
        """What an iteration does to the policy, as the mean of the next `DIAGNOSED`; the agent stays as it is.

        Returns:
          kl: mean KL(old || new) over the batch's observations, in nats.
          outside: share of the batch's actions whose ratio has left [0.8, 1.2], PPO's usual interval.
          gain: mean of ratio times normalised advantage over the batch, 0 for no change.
          value_error: variance of target less value, as a share of the target's.
          entropy: of the old policy, in nats.
        """

        def one(state: PPOState, _: None) -> tuple[PPOState, dict[str, jax.Array]]:
            after, batch = self._iterate(state, hyperparameters, env_params)
            old = self._policy(state, batch.observation, env_params)
            # Under the statistics that the update was made with.
            updated = replace(after, statistics=state.statistics)
            new = self._policy(updated, batch.observation, env_params)
            log_ratio = new.log_prob(batch.action) - batch.log_prob
            ratio = jnp.exp(jnp.clip(log_ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO))
            advantage = batch.advantage - batch.advantage.mean()
            return after, {
                "kl": jnp.mean(old.kl_divergence(new)),
                "outside": jnp.mean(jnp.abs(ratio - 1.0) > USUAL_CLIP),
                "gain": jnp.mean(ratio * advantage) / (advantage.std() + 1e-8),
                "value_error": batch.advantage.var() / (batch.target.var() + 1e-8),
                "entropy": jnp.mean(old.entropy()),
            }

        _, found = jax.lax.scan(one, state, None, DIAGNOSED)
        return {name: values.mean() for name, values in found.items()}

    def _collect_contexts(self, state: PPOState, key: jax.Array, env_params: Any) -> Batch:
        """One batch of independent one-step episodes: nothing to bootstrap, A = r - V(s)."""
        key_reset, key_act, key_step = split_key(key, 3)
        standing = self._reset(key_reset, self.config.batch_size, env_params)
        _, observation = standing
        distribution = self._policy(state, observation, env_params)
        action, log_prob = distribution.sample_and_log_prob(seed=key_act)
        _, step = self._step(standing, action, key_step, env_params)
        advantage = step.reward - self._value(state, observation, env_params)
        return Batch(observation, action, log_prob, advantage, step.reward)

    def _collect_steps(
        self,
        state: PPOState,
        key: jax.Array,
        hyperparameters: PPOHyperparameters,
        env_params: Any,
    ) -> tuple[PPOState, Batch]:

        def step(standing: Any, key: jax.Array) -> Any:
            key_act, key_step = split_key(key)
            distribution = self._policy(state, standing[1], env_params)
            action, log_prob = distribution.sample_and_log_prob(seed=key_act)
            standing, step = self._step(standing, action, key_step, env_params)
            return standing, (step, action, log_prob)

        standing, (steps, action, log_prob) = jax.lax.scan(
            step, state.environment, split_key(key, self.config.num_steps)
        )
        value = self._value(state, steps.observation, env_params)
        advantage = generalized_advantages(
            steps.reward,
            value,
            self._value(state, steps.final_observation, env_params),
            steps.terminated,
            steps.truncated,
            hyperparameters.discount,
            hyperparameters.gae_lambda,
        )
        batch = Batch(steps.observation, action, log_prob, advantage, advantage + value)
        batch = jax.tree.map(lambda x: jnp.reshape(x, (-1, *x.shape[2:])), batch)
        return replace(state, environment=standing), batch

    def _update(
        self,
        state: PPOState,
        key: jax.Array,
        hyperparameters: PPOHyperparameters,
        env_params: Any,
        batch: Batch,
    ) -> PPOState:
        config = self.config
        policy, value = self._networks(env_params)
        batch = batch._replace(observation=self._inputs(state, batch.observation))
        horizon = hyperparameters.horizon
        done = state.iteration / (config.num_iterations if horizon is None else horizon)
        # A training may go on past its horizon: it is over then, and stays so.
        progress = jnp.minimum(done, 1.0)
        fraction_left = jnp.maximum(1.0 - done, 0.0) if config.anneal_learning_rate else 1.0
        optimizer = clipped_adam(hyperparameters, eps=1e-5)

        def loss(params: dict[str, Any], minibatch: Batch) -> jax.Array:
            distribution = policy.apply(params["policy"], minibatch.observation)
            log_ratio = jnp.clip(
                distribution.log_prob(minibatch.action) - minibatch.log_prob,
                -MAX_LOG_RATIO,
                MAX_LOG_RATIO,
            )
            advantage = minibatch.advantage
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            penalty = self.drift(
                hyperparameters.drift, log_ratio, advantage, jnp.full_like(advantage, progress)
            )
            # [B, 1] against [B] would broadcast to [B, B] and train something else.
            chex.assert_equal_shape([penalty, log_ratio, advantage])
            surrogate = jnp.mean(jnp.exp(log_ratio) * advantage - penalty)
            entropy = jnp.mean(distribution.entropy())
            error = value.apply(params["value"], minibatch.observation) - minibatch.target
            value_loss = 0.5 * jnp.mean(error**2)
            return (
                -surrogate
                - hyperparameters.entropy_coefficient * entropy
                + hyperparameters.value_coefficient * value_loss
            )

        def update(carry: Any, minibatch: Batch) -> Any:
            params, optimizer_state = carry
            gradients = jax.grad(loss)(params, minibatch)
            new_params, new_optimizer_state = {}, {}
            # Clipped per network: the value error on raw returns would otherwise drown the policy's
            # gradient.
            for name, gradient in gradients.items():
                updates, new_optimizer_state[name] = optimizer.update(
                    gradient, optimizer_state[name]
                )
                updates = jax.tree.map(lambda u: u * fraction_left, updates)
                new_params[name] = optax.apply_updates(params[name], updates)
            return (new_params, new_optimizer_state), None

        def epoch(carry: Any, key: jax.Array) -> Any:
            order = random_order(key, config.batch_size)
            minibatches = jax.tree.map(
                lambda x: jnp.reshape(
                    x[order],
                    (
                        config.num_minibatches,
                        config.batch_size // config.num_minibatches,
                        *x.shape[1:],
                    ),
                ),
                batch,
            )
            return jax.lax.scan(update, carry, minibatches)

        (params, optimizer_state), _ = jax.lax.scan(
            epoch, (state.params, state.optimizer), split_key(key, config.num_epochs)
        )
        return replace(state, params=params, optimizer=optimizer_state)


def random_order(key: jax.Array, size: int) -> jax.Array:
    """[size] a random permutation of 0 ... size - 1.

    `jax.random.permutation` sorts pairs, which on a CPU costs as much as a tenth of an inner loop.
    Sorting single words, random bits above the index, is four times faster. Words that tie in their
    random bits keep their order: of a batch of 500 one word in 34 000, of 10 000 one in 52.
    """
    index_bits = max(1, (size - 1).bit_length())
    if index_bits > 16:
        return jax.random.permutation(key, size)
    mask = jnp.uint32((1 << index_bits) - 1)
    words = (jax.random.bits(key, (size,), jnp.uint32) & ~mask) | jnp.arange(size, dtype=jnp.uint32)
    return (jnp.sort(words) & mask).astype(jnp.int32)


PPO_ALGORITHM = Algorithm("ppo", PPO, PPOConfig, PPOHyperparameters)
