"""Discover a synthetic contextual bandit: evolve one so that agents trained in it do well in a real environment.

Liesen et al. (2024). The inner loop trains PPO agents in the candidate, with hyperparameters drawn
from the paper's lists so that the bandit suits any of them; the fitness is their return in the
evaluation environment.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from gymnax.environments import environment

from scb.agents.hyperparameters import (
    Setting,
    environment_setting,
    inner_loop_config,
    inner_loop_lists,
    sample_hyperparameters,
)
from scb.agents.ppo import PPO, PPOConfig, PPOHyperparameters
from scb.environments.registry import make
from scb.environments.synthetic import (
    BanditConfig,
    BanditParams,
    SyntheticBandit,
    Weights,
    bandit_for,
)
from scb.environments.zoo import open_bandit
from scb.errors import UserError, unknown_name
from scb.evolution import EnvironmentSteps, EvolutionConfig, Outcome, evolve, map_population
from scb.runs import Run
from scb.warm_start import WarmStartConfig, expert_dataset, fit_bandit, train_expert

INITS = ("random", "expert")


@dataclass(frozen=True)
class DiscoveryConfig:
    """What to discover, and how.

    Attributes:
      environment: the evaluation environment's name.
      bandit: the bandit's networks and latent.
      agent: PPO's static configuration in the inner loop; None takes the paper's table.
      sampled_hyperparameters: draw PPO's from the paper's lists for each agent, or keep the
        underlined ones.
      agents_per_candidate: agents whose mean return is a candidate's fitness.
      evaluation_episodes: episodes of each agent in the evaluation environment.
      mode_actions: evaluate the most likely actions rather than sampled ones.
      init: "random", or "expert" for the warm start.
      start: a bandit (name or file) whose weights to start from instead.
      warm_start: its configuration.
      evolution: the outer loop's.
    """

    environment: str = "Pendulum-v1"
    bandit: BanditConfig = field(default_factory=BanditConfig)
    agent: PPOConfig | None = None
    sampled_hyperparameters: bool = True
    agents_per_candidate: int = 4
    evaluation_episodes: int = 16
    mode_actions: bool = False
    init: str = "expert"
    start: str | None = None
    warm_start: WarmStartConfig = field(default_factory=WarmStartConfig)
    evolution: EvolutionConfig = field(default_factory=lambda: EvolutionConfig(combine="ranks"))

    def __post_init__(self) -> None:
        if self.init not in INITS:
            raise unknown_name("initialisation", self.init, INITS)
        for name in ("agents_per_candidate", "evaluation_episodes"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} is {getattr(self, name)}: it must be at least 1.")


class BanditTraining:
    """Trains one agent in a bandit and evaluates it in the evaluation environment.

    Args:
      bandit: the bandit, whose weights are given at each call.
      env, env_params: the evaluation environment.
      config: PPO's static configuration.
      lists: hyperparameters to draw from; None for the defaults.
    """

    def __init__(
        self,
        bandit: SyntheticBandit,
        env: environment.Environment[Any, Any],
        env_params: Any,
        config: PPOConfig,
        lists: Mapping[str, Sequence[float]] | None,
    ) -> None:
        self.agent = PPO(bandit, config)
        self.env, self.env_params, self.lists = env, env_params, lists

    def hyperparameters(self, key: jax.Array, number: int) -> PPOHyperparameters:
        """[N] hyperparameters for N agents."""
        return sample_hyperparameters(key, self.lists or {}, number)

    def returns(
        self,
        params: BanditParams,
        hyperparameters: PPOHyperparameters,
        key: jax.Array,
        num_episodes: int,
        mode: bool,
    ) -> jax.Array:
        """[E] returns in the evaluation environment of one agent trained in the bandit."""
        key_train, key_evaluate = jax.random.split(key)
        state = self.agent.train(key_train, hyperparameters, params)
        return self.agent.evaluate(
            state, key_evaluate, num_episodes, self.env, self.env_params, mode=mode
        ).returns


class BanditDiscovery:
    """The evolution problem: a candidate is a bandit's weights."""

    def __init__(self, config: DiscoveryConfig) -> None:
        self.config = config
        self.env, self.env_params = make(config.environment)
        name = f"Synthetic-{config.environment}"
        self.bandit = bandit_for(self.env, self.env_params, config.bandit, name)
        self.agent_config = config.agent or inner_loop_config(config.environment)
        space = self.env.action_space(self.env_params)
        lists = inner_loop_lists(space) if config.sampled_hyperparameters else None
        self.training = BanditTraining(
            self.bandit, self.env, self.env_params, self.agent_config, lists
        )
        self.warm_start_report: dict[str, float] = {}
        # Read now, so that a wrong name is told before anything is computed or written.
        self._start = None if config.start is None else self._weights_of(config.start)

    def _weights_of(self, name: str) -> Weights:
        start = open_bandit(name)
        check_fits(start, self.env, self.env_params, self.config.environment)
        if start.weight_shapes() != self.bandit.weight_shapes():
            raise UserError(
                f"{name} has other layer sizes than the bandit to discover: start from one whose hidden_size is "
                f"{self.config.bandit.hidden_size}."
            )
        return start.default_params.weights

    def initial_solution(self, key: jax.Array) -> Weights:
        if self._start is not None:
            return self._start
        if self.config.init == "random":
            return self.bandit.init_weights(key)
        return self._expert_fit

    @cached_property
    def _expert_fit(self) -> Weights:
        # Of the seed alone, so that a resumed run starts from the same fit.
        key_expert, key_data, key_fit = jax.random.split(
            jax.random.fold_in(jax.random.key(self.config.evolution.seed), 1), 3
        )
        warm = self.config.warm_start
        setting = expert_setting(self.config.environment, warm.expert_steps)
        expert = train_expert(self.env, self.env_params, setting, key_expert, warm.num_experts)
        dataset, dataset_steps = expert_dataset(expert, self.env_params, key_data, warm)
        weights, report = fit_bandit(self.bandit, dataset, key_fit, warm)
        self.warm_start_report = {
            "expert_return": expert.mean_return,
            "environment_steps": expert.environment_steps + dataset_steps,
            **report,
        }
        return weights

    def evaluate(
        self, candidate: Weights, key: jax.Array, generation: jax.Array
    ) -> dict[str, jax.Array]:
        config = self.config
        params = BanditParams(weights=candidate)
        key_draw, key_agents = jax.random.split(key)
        number = config.agents_per_candidate
        returns = jax.vmap(
            lambda h, k: self.training.returns(
                params, h, k, config.evaluation_episodes, config.mode_actions
            ).mean()
        )(self.training.hyperparameters(key_draw, number), jax.random.split(key_agents, number))
        return {"fitness": returns}

    def evaluate_mean(self, candidate: Weights, key: jax.Array) -> dict[str, jax.Array]:
        key_draw, key_agent = jax.random.split(key)
        hyperparameters = jax.tree.map(lambda x: x[0], self.training.hyperparameters(key_draw, 1))
        returns = self.training.returns(
            BanditParams(weights=candidate),
            hyperparameters,
            key_agent,
            self.config.evaluation_episodes,
            self.config.mode_actions,
        )
        return {"fitness": returns.mean()}

    def steps(self) -> EnvironmentSteps:
        agents = self.config.agents_per_candidate
        return EnvironmentSteps(
            training=agents * self.agent_config.num_iterations * self.agent_config.batch_size,
            evaluation=agents
            * self.config.evaluation_episodes
            * int(self.env_params.max_steps_in_episode),
        )


def expert_setting(name: str, steps: int | None) -> Setting:
    """PPO's setting for training an expert: the environment's, but a discount at which Pendulum is easy."""
    setting = environment_setting(name)
    config = setting.config if steps is None else replace(setting.config, total_steps=steps)
    hyperparameters = setting.hyperparameters
    if name == "Pendulum-v1":
        # Episodes without end and a reward at every step: a short horizon learns the swing-up
        # several times faster.
        hyperparameters = replace(hyperparameters, discount=0.95)
    return replace(setting, config=config, hyperparameters=hyperparameters)


def check_fits(
    bandit: SyntheticBandit,
    env: environment.Environment[Any, Any],
    env_params: Any,
    environment_name: str,
) -> None:
    """Raises a UserError where a bandit has other observation or action shapes than an environment."""
    other = bandit_for(env, env_params, bandit.config, environment_name)
    ours, theirs = (
        f"{b.observation_size} observations and {b.num_actions} "
        + ("discrete actions" if b.discrete else "action dimensions")
        for b in (bandit, other)
    )
    if ours != theirs:
        raise UserError(
            f"bandit {bandit.name} has {ours}, {environment_name} has {theirs}: take the bandit of that environment."
        )


def discover(
    config: DiscoveryConfig, run: Run | None = None, quiet: bool = False
) -> tuple[BanditDiscovery, Outcome]:
    """Evolves a bandit. The returned problem holds the bandit's shapes, the outcome its weights."""
    problem = BanditDiscovery(config)
    return problem, evolve(problem, config.evolution, run, quiet)


def judge(
    training: BanditTraining,
    weights: Weights,
    seed: int,
    num_agents: int = 20,
    num_episodes: int = 50,
    mode: bool = False,
) -> np.ndarray:
    """[num_agents] mean returns in the evaluation environment of agents trained in the bandit."""
    key_draw, key_agents = jax.random.split(jax.random.key(seed))
    returns = map_population(
        lambda weights, hyperparameters, key: training.returns(
            BanditParams(weights=weights), hyperparameters, key, num_episodes, mode
        ).mean(),
        num_agents,
        (None, 0, 0),
    )
    hyperparameters = training.hyperparameters(key_draw, num_agents)
    keys = jax.random.split(key_agents, num_agents)
    # The weights are an argument: as constants they would make another program of every bandit.
    return np.asarray(returns(weights, hyperparameters, keys))
