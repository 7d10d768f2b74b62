"""Learn an objective: evolve a drift's weights so that agents trained with it end up good.

Lu et al. (2022), "Discovered Policy Optimisation", with the inner loop on a synthetic contextual
bandit instead of an environment (Liesen et al., 2024). The same code trains on either.

A bandit's advantages are exact; a real environment's are mostly noise, and restraint is only worth
learning under noise. A drift evolved on a noiseless bandit therefore wins there and ruins PPO
elsewhere. Here the bandit's reward carries noise of several of its own standard deviations, which
makes it rank objectives almost as the environment does.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp

from lpo.drift import LearnedDrift
from scb.agents.ppo import PPO, PPOConfig, PPOState
from scb.agents.settings import environment_setting
from scb.environments.registry import make
from scb.environments.synthetic import SyntheticBandit
from scb.environments.zoo import home_of
from scb.errors import UserError, unknown_name
from scb.evolution import EnvironmentSteps, EvolutionConfig, Outcome, evolve
from scb.runs import Run

Fitness = Literal["return", "area", "transfer"]
FITNESSES: tuple[Fitness, ...] = ("return", "area", "transfer")


@dataclass(frozen=True)
class MetaTrainingConfig:
    """What to learn an objective on, and how.

    Attributes:
      environment: where the inner loop trains: a bandit ("Synthetic-Pendulum-v1"), or any
        environment.
      drift: the learned drift's family.
      initial_scale: factor on the output layer's random start, so that the search begins near the
        base.
      fitness: "return": of the trained agent where it was trained, without reward noise; "area":
        the mean of that over the training; "transfer": in the bandit's evaluation environment.
      agent: PPO's static configuration; None takes `inner_loop(environment, contexts)`.
      contexts: size of a batch on a bandit.
      learning_rates, entropy_coefficients: values that an inner agent's are drawn from; where
        empty, those of the (evaluation) environment's own setting.
      reward_noise: standard deviation of the noise on a bandit's reward, in standard deviations of
        that reward over random contexts and actions. Real environments have noise of their own and
        take none.
      agents_per_candidate: inner agents whose mean is a candidate's fitness.
      evaluation_episodes: of each inner agent; None takes 50 where they are of one step, else 20.
      mode_actions: evaluate the most likely actions rather than sampled ones.
      backend: Brax physics, where the environment is Brax's (with "transfer": the evaluation
        environment).
      evolution: the outer loop's.
    """

    environment: str = "Synthetic-Pendulum-v1"
    drift: LearnedDrift = field(default_factory=LearnedDrift)
    initial_scale: float = 0.1
    fitness: Fitness = "return"
    agent: PPOConfig | None = None
    contexts: int = 200
    learning_rates: tuple[float, ...] = ()
    entropy_coefficients: tuple[float, ...] = ()
    reward_noise: float = 5.0
    agents_per_candidate: int = 4
    evaluation_episodes: int | None = None
    mode_actions: bool = True
    backend: str | None = None
    evolution: EvolutionConfig = field(
        default_factory=lambda: EvolutionConfig(
            strategy="Open_ES", population_size=32, sigma=0.03, learning_rate=0.01
        )
    )

    def __post_init__(self) -> None:
        if self.fitness not in FITNESSES:
            raise unknown_name("fitness", self.fitness, FITNESSES)
        if self.fitness == "transfer" and home_of(self.environment) is None:
            raise UserError(
                f"fitness 'transfer' asks for a bandit, and {self.environment!r} is none: use 'return' or 'area', or "
                f"train on 'Synthetic-{self.environment}'."
            )
        for name in ("agents_per_candidate", "evaluation_episodes", "contexts"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise UserError(f"{name} is {value}: it must be at least 1.")
        if not 0 <= self.reward_noise < math.inf:
            raise UserError(
                f"reward_noise is {self.reward_noise}: it must be 0 or larger, and finite."
            )


def inner_loop(environment: str, contexts: int) -> PPOConfig:
    """The inner loop's static configuration: the evaluation environment's own setting, or its image on a bandit.

    On a bandit the number of updates (iterations, epochs, minibatches) stays that of the
    environment's setting, so that the objective meets the regime in which it will be used, while a
    batch holds a fraction of the transitions: contexts are independent, consecutive steps are not.
    """
    home = home_of(environment)
    if home is None:
        return environment_setting(environment).config
    setting = environment_setting(home).config
    return replace(
        setting,
        num_envs=contexts,
        num_steps=1,
        total_steps=contexts * setting.num_iterations,
        normalize_observations=False,
    )


class MetaTraining:
    """The evolution problem: a candidate is a drift's weights."""

    def __init__(self, config: MetaTrainingConfig) -> None:
        self.config = config
        self.home = home_of(config.environment) or config.environment
        physics = {} if config.backend is None else {"backend": config.backend}
        if config.fitness == "transfer":
            # The bandit has no physics; the environment that it stands for may.
            self.env, self.env_params = make(config.environment)
            self.evaluation_env, self.evaluation_params = make(self.home, **physics)
        else:
            self.env, self.env_params = make(config.environment, **physics)
            self.evaluation_env, self.evaluation_params = self.env, self.env_params
        self.agent_config = config.agent or inner_loop(config.environment, config.contexts)
        self.agent = PPO(self.env, self.agent_config, config.drift)
        one_step = isinstance(self.evaluation_env, SyntheticBandit)
        self.evaluation_episodes = config.evaluation_episodes or (50 if one_step else 20)
        self.training_params = self.env_params
        if isinstance(self.env, SyntheticBandit) and config.reward_noise:
            scale = self.env.reward_scale(self.env_params, jax.random.key(0))
            self.training_params = self.env_params.replace(reward_noise=config.reward_noise * scale)
        self.base_hyperparameters = environment_setting(self.home).hyperparameters

    def initial_solution(self, key: jax.Array) -> dict[str, jax.Array]:
        weights = self.config.drift.init(key)
        return {**weights, "output": weights["output"] * self.config.initial_scale}

    def evaluate(
        self, candidate: Any, key: jax.Array, generation: jax.Array
    ) -> dict[str, jax.Array]:
        fitness = jax.vmap(lambda k: self.train_one(candidate, k))(
            jax.random.split(key, self.config.agents_per_candidate)
        )
        return {"fitness": fitness}

    def evaluate_mean(self, candidate: Any, key: jax.Array) -> dict[str, jax.Array]:
        return {"fitness": self.train_one(candidate, key)}

    def train_one(self, drift_parameters: Any, key: jax.Array) -> jax.Array:
        """[] fitness of one agent that was trained with these drift parameters."""
        config = self.config
        key_rate, key_entropy, key_train, key_evaluate = jax.random.split(key, 4)
        hyperparameters = replace(self.base_hyperparameters, drift=drift_parameters)
        if config.learning_rates:
            rate = jax.random.choice(key_rate, jnp.asarray(config.learning_rates))
            hyperparameters = replace(hyperparameters, learning_rate=rate)
        if config.entropy_coefficients:
            entropy = jax.random.choice(key_entropy, jnp.asarray(config.entropy_coefficients))
            hyperparameters = replace(hyperparameters, entropy_coefficient=entropy)

        def judge(state: PPOState, key: jax.Array) -> jax.Array:
            return self.agent.evaluate(
                state,
                key,
                self.evaluation_episodes,
                self.evaluation_env,
                self.evaluation_params,
                mode=config.mode_actions,
            ).returns.mean()

        if config.fitness == "area":
            _, returns = self.agent.train_with_evaluations(
                key_train, hyperparameters, self.training_params, judge, every=self._area_every
            )
            return returns[1:].mean()
        state = self.agent.train(key_train, hyperparameters, self.training_params)
        return judge(state, key_evaluate)

    @property
    def _area_every(self) -> int:
        # About five points of the curve, at equal distances that divide the training.
        iterations = self.agent_config.num_iterations
        return next(n for n in range(max(1, iterations // 5), 0, -1) if iterations % n == 0)

    def steps(self) -> EnvironmentSteps:
        points = 1
        if self.config.fitness == "area":
            points = self.agent_config.num_iterations // self._area_every + 1
        agents = self.config.agents_per_candidate
        return EnvironmentSteps(
            training=agents * self.agent_config.num_iterations * self.agent_config.batch_size,
            evaluation=agents
            * points
            * self.evaluation_episodes
            * int(self.evaluation_params.max_steps_in_episode),
        )


def meta_train(config: MetaTrainingConfig, run: Run | None = None, quiet: bool = False) -> Outcome:
    """Evolves a drift; the outcome's means are its weights."""
    return evolve(MetaTraining(config), config.evolution, run, quiet)
