"""Bandits whose reward or contexts are replaced by an expert's, and cloning the expert instead.

Liesen et al. (2024), appendix "Replacing components of an SCB": what of a discovered bandit does an
agent need to learn well within 10 000 steps?
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnax.environments import environment, spaces
from jax.typing import ArrayLike

from scb.agents import networks
from scb.agents.ppo import PPOConfig
from scb.agents.sac import SAC
from scb.agents.spec import environment_agent
from scb.environments.synthetic import BanditParams, BanditState, SyntheticBandit
from scb.evaluation import Policy, evaluate
from scb.experts import best_agent
from scb.keys import root_key, split_key
from scb.measurement import Judge
from scb.spaces import action_size, clip_to_space, scale_to_space

Reward = Callable[[jax.Array, jax.Array], jax.Array]  # ([O] observation, action) -> []


class ReplacedBandit(SyntheticBandit):
    """A bandit with another reward, or with contexts drawn from given states.

    Args:
      bandit: whose shapes, and whose other half, are kept.
      reward: instead of the bandit's; None keeps it.
      states: [N, O], from which contexts are drawn uniformly; None keeps the bandit's.
    """

    def __init__(
        self, bandit: SyntheticBandit, reward: Reward | None = None, states: ArrayLike | None = None
    ) -> None:
        super().__init__(
            bandit.observation_size,
            bandit.action_space(),
            bandit.config,
            bandit.default_params.weights,
            bandit.name,
        )
        self._replaced_reward = reward
        self._states = None if states is None else jnp.asarray(states, jnp.float32)

    def mean_reward(self, context: jax.Array, action: ArrayLike, params: BanditParams) -> jax.Array:
        if self._replaced_reward is None:
            return super().mean_reward(context, action, params)
        return self._replaced_reward(context, jnp.asarray(action))

    @property
    def tells_best_action(self) -> bool:
        return self._replaced_reward is None and super().tells_best_action

    def reset_env(self, key: jax.Array, params: BanditParams) -> tuple[jax.Array, BanditState]:
        if self._states is None:
            return super().reset_env(key, params)
        context = self._states[jax.random.randint(key, (), 0, len(self._states))]
        return context, BanditState(time=jnp.int32(0), context=context)


@dataclass(frozen=True)
class SACExpert:
    """A SAC agent trained on an environment: its actions, its distribution over them, its Q-function."""

    agent: SAC
    state: Any
    env_params: Any
    mean_return: float  # on the episodes that chose it

    def action(self, observation: jax.Array) -> jax.Array:
        """[O] -> the most likely action, within the bounds."""
        return self.agent.act(self.state, observation, root_key(0), self.env_params, mode=True)

    def policy(self) -> Policy:
        """`action` as `scb.evaluation.evaluate` takes it."""
        return lambda observation, key: self.action(observation)

    def distribution(self, observation: jax.Array) -> distrax.Distribution:
        """As `SAC.distribution`."""
        return self.agent.distribution(self.state, observation, self.env_params)

    def q_value(self, observation: jax.Array, action: jax.Array) -> jax.Array:
        """As `SAC.q_value`."""
        return self.agent.q_value(self.state, observation, action, self.env_params)


def train_sac_expert(
    name: str,
    env: environment.Environment[Any, Any],
    env_params: Any,
    key: jax.Array,
    num_agents: int = 4,
    num_episodes: int = 50,
) -> SACExpert:
    """The best of several SAC agents with an environment's own setting, by episodes of most likely actions."""
    spec = environment_agent("sac", name)
    agent = spec.agent(env)
    assert isinstance(agent, SAC)

    judge = Judge(env, env_params, num_episodes, mode=True)
    state, returns = best_agent(
        agent, spec, spec.training_params(env_params), key, num_agents, judge
    )
    return SACExpert(agent, state, env_params, float(np.nanmax(returns)))


def action_reward(expert: SACExpert, space: spaces.Box | spaces.Discrete) -> Reward:
    """-||a - a*||, or 1 where a = a* for discrete actions: a* is the expert's."""

    def reward(observation: jax.Array, action: jax.Array) -> jax.Array:
        best = expert.action(observation)
        if isinstance(space, spaces.Discrete):
            return (action == best).astype(jnp.float32)
        difference = jnp.ravel(clip_to_space(action, space)) - jnp.ravel(best)
        # A norm has no gradient at zero; nothing differentiates this one.
        return -jnp.linalg.norm(difference)

    return reward


def q_reward(expert: SACExpert, space: spaces.Box | spaces.Discrete) -> Reward:
    """The expert's Q-function, of the action within the bounds."""
    return lambda observation, action: expert.q_value(observation, clip_to_space(action, space))


def clone(
    expert: SACExpert,
    contexts: Callable[[jax.Array], jax.Array],
    space: spaces.Box | spaces.Discrete,
    key: jax.Array,
    learning_rate: ArrayLike,
    config: PPOConfig,
) -> Policy:
    """Online behavioural cloning: steps towards smaller KL[pi || pi_expert] on batches of states.

    Args:
      contexts: key -> [O] one state.
      learning_rate: of Adam, traced.
      config: network, batches, epochs and minibatches.

    Returns:
      The trained policy's most likely actions.
    """
    discrete = isinstance(space, spaces.Discrete)
    of: Any = networks.CategoricalPolicy if discrete else networks.SquashedGaussianPolicy
    network = of(action_size(space), config.hidden_sizes, config.activation)
    optimizer = optax.adam(learning_rate)

    def distribution(weights: Any, observation: jax.Array) -> distrax.Distribution:
        outputs = network.apply(weights, observation)
        # Both policies are squashed by the same tanh, under which the divergence stays what it is.
        return outputs if discrete else distrax.MultivariateNormalDiag(*outputs)

    def loss(weights: Any, observations: jax.Array) -> jax.Array:
        divergence = jax.vmap(
            lambda o: distribution(weights, o).kl_divergence(expert.distribution(o))
        )
        return divergence(observations).mean()

    def learn(carry: Any, observations: jax.Array) -> Any:
        weights, state = carry
        updates, state = optimizer.update(jax.grad(loss)(weights, observations), state)
        return (optax.apply_updates(weights, updates), state), None

    def batch(carry: Any, key: jax.Array) -> Any:
        key_states, key_order = split_key(key)
        states = jax.vmap(contexts)(split_key(key_states, config.batch_size))

        def epoch(carry: Any, key: jax.Array) -> Any:
            order = jax.random.permutation(key, config.batch_size)
            shuffled = jnp.reshape(states[order], (config.num_minibatches, -1, states.shape[-1]))
            return jax.lax.scan(learn, carry, shuffled)

        return jax.lax.scan(
            lambda c, k: (epoch(c, k)[0], None), carry, split_key(key_order, config.num_epochs)
        )

    key_init, key_batches = split_key(key)
    weights = network.init(key_init, jnp.zeros(jax.eval_shape(contexts, key).shape))
    (weights, _), _ = jax.lax.scan(
        batch, (weights, optimizer.init(weights)), split_key(key_batches, config.num_iterations)
    )

    def policy(observation: jax.Array, key: jax.Array) -> jax.Array:
        outputs = network.apply(weights, jnp.ravel(observation))
        if isinstance(space, spaces.Discrete):
            return jnp.argmax(outputs.logits, axis=-1)
        return clip_to_space(scale_to_space(jnp.tanh(outputs[0]), space), space)

    return policy


def judge_cloning(
    expert: SACExpert,
    contexts: Callable[[jax.Array], jax.Array],
    env: environment.Environment[Any, Any],
    env_params: Any,
    key: jax.Array,
    learning_rates: jax.Array,
    num_episodes: int,
    activation: str = "tanh",
) -> np.ndarray:
    """[N] mean returns of policies cloned with each of [N] learning rates."""
    space = env.action_space(env_params)

    @jax.jit
    @jax.vmap
    def returns(key: jax.Array, learning_rate: jax.Array) -> jax.Array:
        key_clone, key_evaluate = split_key(key)
        config = PPOConfig(activation=activation)
        policy = clone(expert, contexts, space, key_clone, learning_rate, config)
        return evaluate(env, env_params, policy, key_evaluate, num_episodes).returns.mean()

    return np.asarray(returns(split_key(key, len(learning_rates)), learning_rates))
