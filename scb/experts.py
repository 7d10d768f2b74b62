"""Experts: good policies of an environment, to fit a bandit to.

An expert is anything that acts. Two ways to get one are here: training agents of any algorithm on
the environment and keeping the best, and evolving a small policy network on its return. The second
needs no reward along the way: with episodes that are longer at first it finds the goal of
MountainCar, where policy gradients see nothing to follow.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment

from scb.agents.agent import Agent
from scb.agents.normalization import RunningStatistics, normalize, update_statistics
from scb.agents.spec import AgentSpec
from scb.curriculum import CurriculumConfig, EpisodeLengths
from scb.errors import UserError
from scb.evaluation import evaluate, flat
from scb.evolution import EnvironmentSteps, EvolutionConfig, evolve
from scb.keys import named_key, root_key, split_key
from scb.measurement import Judge, train_and_judge
from scb.neuroevolution import network_action, policy_network
from scb.spaces import flat_size

EPISODES = 20  # by which an expert is judged


class Expert(NamedTuple):
    """A policy, what it earns, and what it cost.

    Attributes:
      policy: [O] flattened observation -> action within the bounds; traceable.
      mean_return: over 20 episodes in the environment.
      environment_steps: taken to find it, evaluation included; an upper bound where episodes end
        early.
      reaching: [O] observation -> action before it is clipped, where errors are added; None where the policy is it.
      earlier_seconds: of a search that went on from what was kept of it, those until then.
    """

    policy: Callable[[jax.Array], jax.Array]
    mean_return: float
    environment_steps: int
    reaching: Callable[[jax.Array], jax.Array] | None = None
    earlier_seconds: float = 0.0


def judged(
    policy: Callable[[jax.Array], jax.Array],
    env: environment.Environment[Any, Any],
    env_params: Any,
    key: jax.Array,
    environment_steps: int = 0,
) -> Expert:
    """An expert from any policy of flattened observations, its return measured."""
    episodes = jax.jit(lambda key: evaluate(env, env_params, flat(policy), key, EPISODES).returns)(
        key
    )
    steps = environment_steps + EPISODES * int(env_params.max_steps_in_episode)
    return Expert(policy, float(np.mean(episodes)), steps)


def best_agent(
    agent: Agent, spec: AgentSpec, params: Any, key: jax.Array, num_agents: int, judge: Judge
) -> tuple[Any, np.ndarray]:
    """The state of the best of several agents trained alike, and [num_agents] mean returns, NaN for what is not finite.

    Args:
      agent, spec: the agents, and what they are trained with.
      params: of the environment that they train in.
      key: decides everything.
      judge: of each.

    Raises:
      UserError: no agent has a finite return.
    """

    @jax.jit
    def train(key: jax.Array) -> tuple[Any, jax.Array]:
        judges = {"return": judge}
        state, earned = train_and_judge(agent, spec.hyperparameters, key, params, judges)
        return state, earned["return"].returns.mean()

    states, earned = jax.vmap(train)(split_key(key, num_agents))
    returns = np.where(np.isfinite(earned), np.asarray(earned, float), np.nan)
    if np.isnan(returns).all():
        raise UserError(
            f"none of {num_agents} agents has a finite return: lower the learning rate."
        )
    best = int(np.nanargmax(returns))
    return jax.tree.map(lambda x: x[best], states), returns


def train_expert(
    env: environment.Environment[Any, Any],
    env_params: Any,
    spec: AgentSpec,
    key: jax.Array,
    num_experts: int,
) -> Expert:
    """The best of `num_experts` agents trained on the environment itself, by 20 episodes of mode actions.

    Its return is that of other episodes than those which chose it.
    """
    agent = spec.agent(env)
    judge = Judge(env, env_params, EPISODES, mode=True)
    state, _ = best_agent(agent, spec, spec.training_params(env_params), key, num_experts, judge)

    def policy(observation: jax.Array) -> jax.Array:
        return agent.act(state, observation, key, env_params, mode=True)

    steps = spec.steps * num_experts
    evaluation = num_experts * EPISODES * int(env_params.max_steps_in_episode)
    return judged(policy, env, env_params, named_key(key, "return"), steps + evaluation)


@dataclass(frozen=True)
class PolicySearchConfig:
    """How a policy network is evolved on an environment's return.

    Attributes:
      hidden_size: of its one tanh layer; observations are normalised by what random actions see.
      episodes: of each candidate, the same for all of a generation.
      curriculum: of the episodes' length; None for the environment's own.
      evolution: the outer loop's.
    """

    hidden_size: int = 16
    episodes: int = 8
    curriculum: CurriculumConfig | None = None
    evolution: EvolutionConfig = field(
        default_factory=lambda: EvolutionConfig(
            population_size=64,
            num_generations=80,
            sigma=0.5,
            mean_evaluations=2,
            evaluate_mean_every=1000,
        )
    )


class _PolicySearch:
    """The evolution problem: a candidate is a policy network's weights."""

    def __init__(
        self, env: environment.Environment[Any, Any], env_params: Any, config: PolicySearchConfig
    ) -> None:
        self.env, self.env_params, self.config = env, env_params, config
        self.lengths = EpisodeLengths(config.curriculum, env_params)
        self.space = env.action_space(env_params)
        self.network = policy_network(self.space, (config.hidden_size,), "tanh")
        self.statistics = _random_statistics(env, env_params)

    def policy(self, weights: Any) -> Callable[[jax.Array], jax.Array]:
        def act(observation: jax.Array) -> jax.Array:
            outputs: Any = self.network.apply(weights, normalize(self.statistics, observation))
            return network_action(outputs, self.space)

        return act

    def initial_solution(self, key: jax.Array) -> Any:
        size = flat_size(self.env.observation_space(self.env_params))
        return self.network.init(key, jnp.zeros(size))

    def _returns(
        self, weights: Any, key: jax.Array, env_params: Any, limit: Any = None
    ) -> jax.Array:
        policy = flat(self.policy(weights))
        return evaluate(self.env, env_params, policy, key, self.config.episodes, limit).returns

    def evaluate(self, candidate: Any, key: jax.Array, generation: jax.Array) -> dict[str, Any]:
        limit, env_params = self.lengths.limit(generation), self.lengths.params
        return {"fitness": self._returns(candidate, key, env_params, limit).mean()}

    def evaluate_mean(self, candidate: Any, key: jax.Array) -> dict[str, Any]:
        return {"fitness": self._returns(candidate, key, self.env_params).mean()}

    def steps(self, generation: int = 0) -> EnvironmentSteps:
        return EnvironmentSteps(0, self.config.episodes * self.lengths.steps(generation))

    def judgement_steps(self) -> EnvironmentSteps:
        limit = int(self.env_params.max_steps_in_episode)
        return EnvironmentSteps(training=0, evaluation=self.config.episodes * limit)


def evolve_expert(
    env: environment.Environment[Any, Any],
    env_params: Any,
    config: PolicySearchConfig,
    key: jax.Array,
    quiet: bool = True,
) -> Expert:
    """The mean of an evolution over policy networks.

    Args:
      key: decides everything; `config.evolution.seed` is not used.
      quiet: no progress on the terminal.
    """
    key_search, key_judge = split_key(key)
    evolution = config.evolution
    problem = _PolicySearch(env, env_params, config)
    outcome = evolve(problem, evolution, quiet=quiet, key=key_search)
    cost = outcome.cost(problem, evolution, best=False)
    steps = sum(n for name, n in cost.items() if name.startswith("environment_steps"))
    return judged(problem.policy(outcome.mean), env, env_params, key_judge, steps)


def _random_statistics(
    env: environment.Environment[Any, Any], env_params: Any
) -> RunningStatistics:
    """Moments of the observations of random actions, each held for 20 steps so that they lead somewhere."""
    space = env.action_space(env_params)

    def step(carry: Any, inputs: tuple[jax.Array, jax.Array]) -> Any:
        env_state, action = carry
        time, key = inputs
        key_action, key_step = split_key(key)
        action = jnp.where(time % 20 == 0, space.sample(key_action), action)
        observation, env_state, *_ = env.step(key_step, env_state, action, env_params)
        return (env_state, action), jnp.ravel(observation)

    def roll(key: jax.Array) -> jax.Array:
        key_reset, key_action, key_steps = split_key(key, 3)
        _, env_state = env.reset(key_reset, env_params)
        number = min(200, int(env_params.max_steps_in_episode))
        inputs = (jnp.arange(number), split_key(key_steps, number))
        return jax.lax.scan(step, (env_state, space.sample(key_action)), inputs)[1]

    with jax.ensure_compile_time_eval():
        visited = jax.jit(jax.vmap(roll))(split_key(named_key(root_key(0), "statistics"), 64))
        visited = jnp.reshape(visited, (-1, visited.shape[-1]))
        return update_statistics(RunningStatistics.start(visited.shape[-1]), visited)
