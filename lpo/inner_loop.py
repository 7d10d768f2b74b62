"""What meta-training is asked for, and its inner loop: agents that train with a drift, and what that is worth."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.typing import ArrayLike

from lpo.drifts import Drift, LearnedDrift
from lpo.fitness import FITNESSES, Fitness
from scb.agents.agent import evaluated_after
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import AgentSpec, check_lists, environment_agent
from scb.command_line import listed, numbers, text
from scb.environments.registry import check_backend, environment_spec
from scb.environments.zoo import digests
from scb.errors import UserError, agents_at_least, at_least, of_classes, one_of, positive, unused
from scb.evolution import EnvironmentSteps, EvolutionConfig
from scb.keys import named_key, root_key, split_key
from scb.lists import read_values, write_values
from scb.measurement import Judge, spaced, train_and_judge
from scb.own import code_of
from scb.strategies import check_memory

_OF_BANDITS = ("contexts", "reward_noise")
POINTS = 5  # of the curve that the area is under
EPISODES_AT_HOME = 20  # in an environment, of an agent that learned in a bandit or there


def _read_horizons(words: str) -> tuple[float, ...]:
    return () if words == "None" else numbers(words, "horizons")


def _write_horizons(horizons: tuple[float, ...]) -> str:
    return ",".join(map(str, horizons)) or "None"


@dataclass(frozen=True)
class MetaTrainingConfig:
    """What to learn an objective on, and how.

    Attributes:
      tasks: where the inner loop trains: bandits (Synthetic-Pendulum-v1) or any environments
        (Pendulum-v1, hopper, ...), separated by commas; observations and actions may differ.
      fitness: return (of the trained agent where it was trained, without noise), return-sampled (with
        sampled actions rather than the most likely ones), area (the mean over the training), or
        transfer (return of the bandit-trained agent in the bandit's evaluation environment).
      agent: PPO's static configuration; None takes `task_agent`'s.
      contexts: that a batch of a bandit holds.
      horizons: how long inner agents train, as multiples of the setting's number of updates (0.25,0.5,1), of
        which one is drawn for each generation. None: always in full. A temporally-aware drift
        learns here that the fraction of training done is what matters.
      hyperparameters: values that inner agents draw PPO's hyperparameters from (such as learning_rate=0.001
        policy_output_scale=1,0.01); the rest are those of the (evaluation) environment's own setting. With one
        initialisation of the policy alone, an objective learns to make up for its weakness.
      reward_noise: noise on a bandit's reward, in standard deviations of that reward over random
        contexts and actions. Without it the drift overfits the bandit. Environments have noise of
        their own and take none.
      agents_per_candidate: inner agents whose mean is a candidate's fitness.
      evaluation_episodes: of each inner agent; None takes 50 where they are of one step, else 20.
      validation: judge the mean of the search distribution by agents trained with it in the tasks'
        evaluation environments, on the settings of those, and keep the mean that was judged best (of whose
        agents no more than a quarter diverged), rather than the final one. The longer a search on a bandit,
        the more it learns about the bandit alone. Takes environment steps, of which the search itself sees none.
      backend: Brax physics, where the environment is Brax's (with transfer: the evaluation
        environment).
      initial_scale: of the drift's random start, so that the search begins near what it corrects.
      drift: the settings of what is learned.
      evolution: of the candidates. With several tasks `combine` should be "ranks", as it is on the command line
        where nothing else is said: their returns have different scales.
    """

    tasks: Annotated[
        tuple[str, ...],
        tyro.conf.arg(aliases=("--environment",)),
        text(partial(listed, what="tasks"), ",".join, "NAME,NAME"),
    ] = ("Synthetic-Pendulum-v1",)
    fitness: str = "return"
    agent: tyro.conf.Suppress[PPOConfig | None] = None
    contexts: int = 200
    horizons: Annotated[tuple[float, ...], text(_read_horizons, _write_horizons, "A,B,C")] = ()
    hyperparameters: Annotated[
        Mapping[str, tuple[float, ...]],
        text(read_values, write_values, "NAME=A,B NAME=A", spaced=True),
    ] = field(default_factory=lambda: {"policy_output_scale": (1.0, 0.01)})
    reward_noise: float = 5.0
    agents_per_candidate: int = 4
    evaluation_episodes: int | None = None
    validation: Annotated[bool, tyro.conf.arg(name="validate")] = False
    backend: str | None = None
    initial_scale: float = 0.1
    drift: Annotated[Drift, tyro.conf.arg(prefix_name=False)] = field(default_factory=LearnedDrift)
    evolution: Annotated[EvolutionConfig, tyro.conf.arg(name="outer loop", prefix_name=False)] = (
        field(
            default_factory=lambda: EvolutionConfig(
                strategy="Open_ES", population_size=32, sigma=0.03, learning_rate=0.01
            )
        )
    )

    def __post_init__(self) -> None:
        of_classes(self, drift=Drift, evolution=EvolutionConfig, agent=PPOConfig | None)
        one_of("fitness", self.fitness, FITNESSES)
        at_least(1, self.evolution, "num_generations")
        tasks: Any = self.tasks
        if isinstance(tasks, str):
            raise UserError(f"the tasks are {self.tasks!r}, a text: give a tuple of names.")
        if isinstance(tasks, tuple | list):
            names = tuple(str(task) if isinstance(task, Path) else task for task in tasks)
            object.__setattr__(self, "tasks", names)
        hyperparameters: Any = self.hyperparameters
        if not isinstance(hyperparameters, Mapping):
            raise UserError(
                f"the hyperparameters are {hyperparameters!r}: give a dict, such as "
                "{'learning_rate': (0.001, 0.005)}."
            )
        if not isinstance(self.horizons, tuple | list):
            raise UserError(f"the horizons are {self.horizons!r}: give a tuple, () for none.")
        if not self.tasks:
            raise UserError("the list of tasks is empty: give at least one bandit or environment.")
        for name in self.tasks:
            if self.tasks.count(name) > 1:
                raise UserError(f"the task {name} is there twice: give each once.")
            if self.judgement.at_home and not environment_spec(name).synthetic:
                raise UserError(
                    f"fitness {self.fitness!r} asks for a bandit, and {name!r} is none: use 'return' or 'area', or "
                    f"train on {environment_spec(name).bandit!r}."
                )
        check_backend(self.backend, self.homes)
        if not self.validation and all(environment_spec(n).synthetic for n in self.judged_in):
            unused(
                self,
                "fitness is earned in bandits, which have no physics",
                ("backend",),
                "take validation, or the fitness transfer",
            )
        known = {n: environment_spec(n).reference(self.backend) is not None for n in self.homes}
        if self.validation and len(known) > 1 and not all(known.values()):
            raise UserError(
                "validation on several environments needs a reference return of each, and "
                f"{', '.join(n for n in known if not known[n])} has none: leave out its task, or validation."
            )
        if self.agent is not None and len(self.tasks) > 1:
            raise UserError(
                "one agent configuration does not fit several tasks: leave it out, and each takes its own."
            )
        if self.horizons and self.judgement.along:
            raise UserError(
                f"fitness {self.fitness!r} needs trainings of one length: take no horizons (--horizons None where "
                "--temporal brings them), or the fitness 'return'."
            )
        for horizon in self.horizons:
            if not isinstance(horizon, int | float | np.number):
                raise UserError(f"a horizon is {horizon!r}: it must be a number.")
            positive(horizon=horizon)
        if len(set(self.horizons)) > 1:
            because = "which is of trainings of other lengths where there are several horizons"
            check_memory(self.evolution.strategy, because, "take one")
        check_lists(self.hyperparameters, PPOHyperparameters())
        for name in ("drift", "horizon"):
            if name in self.hyperparameters:
                raise UserError(
                    f"{name} is not drawn from a list: the drift is what is learned, and horizons are a setting of "
                    "their own."
                )
        if not any(environment_spec(name).is_bandit for name in self.tasks):
            noisy = _OF_BANDITS if self.reward_noise else _OF_BANDITS[:1]  # none is what there is
            unused(self, "none of the tasks is a bandit", noisy, "take a bandit")
        agents_at_least(1, self, "agents_per_candidate")
        at_least(1, self, "evaluation_episodes", "contexts")
        at_least(0, self, "reward_noise", "initial_scale")

    @property
    def judgement(self) -> Fitness:
        """What `fitness` names."""
        return FITNESSES[self.fitness]

    @property
    def homes(self) -> tuple[str, ...]:
        """The tasks' evaluation environments, each once."""
        homes = (environment_spec(name).evaluation_environment for name in self.tasks)
        return tuple(dict.fromkeys(homes))

    @property
    def judged_in(self) -> tuple[str, ...]:
        """Where fitness is earned."""
        return self.homes if self.judgement.at_home else self.tasks

    def checksums(self) -> dict[str, str]:
        """{name: SHA-256} of the tasks' weights, and of the code of environments and drifts of one's own."""
        return digests({*self.tasks, *self.homes}) | code_of(self.drift)

    def at_home(self) -> "MetaTrainingConfig":
        """The same on the tasks' evaluation environments themselves."""
        of_bandits: Any = {f.name: f.default for f in fields(self) if f.name in _OF_BANDITS}
        return replace(self, tasks=self.homes, fitness="return", agent=None, **of_bandits)


def task_agent(task: str, contexts: int, minibatches: int | None = None) -> AgentSpec:
    """PPO as the evaluation environment has it, or on a bandit its image (`AgentSpec.on_bandit`)."""
    place = environment_spec(task)
    spec = environment_agent("ppo", place.evaluation_environment)
    if place.is_bandit:
        return spec.on_bandit(contexts, minibatches)
    return spec.with_values(num_minibatches=minibatches)


class TaskTraining:
    """Trains one PPO agent with a drift in one task's environment and says what it is worth.

    Args:
      config: the meta-training's.
      environment: the task, one of the configuration's.
    """

    def __init__(self, config: MetaTrainingConfig, environment: str) -> None:
        self.config = config
        spec = environment_spec(environment)
        self.home = spec.evaluation_environment
        judged_in = environment_spec(self.home) if config.judgement.at_home else spec
        # Some have no choice of physics, bandits among them.
        physics = judged_in.physics(config.backend)
        self.evaluation_env, self.evaluation_params = judged_in.make(physics)
        self.env, self.env_params = self.evaluation_env, self.evaluation_params
        if config.judgement.at_home:  # a bandit, which has no physics
            self.env, self.env_params = spec.make()
        agent = task_agent(environment, config.contexts)
        self.spec = replace(
            agent, config=config.agent or agent.config, lists=config.hyperparameters
        )
        self.every = spaced(self.spec.config.num_iterations, POINTS)
        self.agent = self.spec.agent(self.env, config.drift)
        self.evaluation_episodes = config.evaluation_episodes or (
            50 if judged_in.is_bandit else EPISODES_AT_HOME
        )
        self.training_params = self.spec.training_params(self.env_params)
        if spec.is_bandit and config.reward_noise:
            scale = self.env.reward_scale(
                self.env_params, named_key(root_key(0), f"reward scale of {self.env.name}")
            )
            self.training_params = replace(
                self.training_params, reward_noise=config.reward_noise * scale
            )

    def fitness(
        self, drift_parameters: Any, key: jax.Array, number: int, horizon: ArrayLike = 1.0
    ) -> jax.Array:
        """[number] fitnesses of as many agents, each trained with these drift parameters.

        Args:
          horizon: how long they train, as a multiple of the inner loop's iterations; traced.
        """
        key_draw, key_agents = split_key(key)
        hyperparameters = self.spec.sample(key_draw, number)
        return jax.vmap(lambda h, k: self._train_one(drift_parameters, h, k, horizon))(
            hyperparameters, split_key(key_agents, number)
        )

    def _train_one(
        self,
        drift_parameters: Any,
        hyperparameters: PPOHyperparameters,
        key: jax.Array,
        horizon: ArrayLike,
    ) -> jax.Array:
        fitness = self.config.judgement
        hyperparameters = replace(hyperparameters, drift=drift_parameters)
        iterations = None
        if self.config.horizons:
            iterations = self._iterations(horizon)
            hyperparameters = replace(hyperparameters, horizon=iterations)
        env, params = self.evaluation_env, self.evaluation_params
        _, earned = train_and_judge(
            self.agent,
            hyperparameters,
            split_key(key)[0] if fitness.along else key,
            self.training_params,
            {"return": Judge(env, params, self.evaluation_episodes, fitness.mode)},
            self.every if fitness.along else None,
            iterations,
        )
        returns = earned["return"].returns.mean(-1)
        return fitness.of(returns if fitness.along else returns[None])

    def _iterations(self, horizon: ArrayLike) -> jax.Array:
        """[...] of trainings of these fractions of the inner loop's iterations, at least one."""
        share = jnp.asarray(horizon) * self.spec.config.num_iterations
        return jnp.maximum(1, jnp.round(share).astype(jnp.int32))

    def steps(self, agents: int, full: bool = False) -> EnvironmentSteps:
        """Of so many agents; with several horizons the mean over them, or trained in full whatever these are."""
        config, trained = self.spec.config, [self.spec.config.num_iterations]
        if self.config.horizons and not full:
            trained = self._iterations(np.asarray(self.config.horizons)).tolist()
        training = sum(map(config.steps_after, trained)) / len(trained)
        points = 1
        if self.config.judgement.along:
            points = len(evaluated_after(config.num_iterations, self.every))
        return EnvironmentSteps(
            training=round(agents * training),
            evaluation=agents
            * points
            * self.evaluation_episodes
            * int(self.evaluation_params.max_steps_in_episode),
        )
