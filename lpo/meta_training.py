"""Learn an objective: evolve a drift's weights so that agents trained with it end up good.

Lu et al. (2022), "Discovered Policy Optimisation", with the inner loop on a synthetic contextual
bandit instead of an environment (Liesen et al., 2024). The same code trains on either.

A bandit's advantages are exact; a real environment's are mostly noise, and restraint is only worth
learning under noise. A drift evolved on a noiseless bandit therefore wins there and ruins PPO
elsewhere. Here the bandit's reward carries noise of several of its own standard deviations, which
makes it rank objectives almost as the environment does.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.typing import ArrayLike

from lpo.drifts import Drift, LearnedDrift
from lpo.fitness import FITNESSES, Fitness
from lpo.objectives import Objective, load_objective, save_objective
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import AgentSpec, check_lists, environment_agent
from scb.command_line import listed, numbers, text
from scb.environments.registry import environment_spec
from scb.environments.spec import EnvironmentSpec, Made
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError, at_least, unknown_name
from scb.evolution import EnvironmentSteps, EvolutionConfig, Outcome, evolve
from scb.keys import named_key, root_key, split_key
from scb.lists import read_values, write_values
from scb.measurement import Judge, spaced, train_and_judge
from scb.runs import Run, config_dict
from scb.seeds import VALIDATING
from scb.statistics import estimate

# Agents that judge a mean on the environment, where each costs a training there.
VALIDATION_AGENTS = 16
POINTS = 5  # of the curve that the area is under


# A temporally-aware drift meets trainings from a quarter to twice as long as the setting's own.
TEMPORAL_HORIZONS = (0.25, 0.5, 1.0, 2.0)


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
      horizons: how long inner agents train, as fractions of the setting's number of updates, such as
        0.25,0.5,1; one is drawn for each generation. None: always in full. A temporally-aware drift
        learns here that the fraction of training done is what matters.
      hyperparameters: values that inner agents draw PPO's hyperparameters from, such as
        "learning_rate=0.0003,0.001 policy_output_scale=1,0.01"; the rest are those of the (evaluation)
        environment's own setting. With one initialisation of the policy alone, an objective learns to
        make up for its weakness.
      reward_noise: noise on a bandit's reward, in standard deviations of that reward over random
        contexts and actions. Without it the drift overfits the bandit. Environments have noise of
        their own and take none.
      agents_per_candidate: inner agents whose mean is a candidate's fitness.
      evaluation_episodes: of each inner agent; None takes 50 where they are of one step, else 20.
      validation: judge the mean of the search distribution by agents trained with it in the tasks'
        evaluation environments, on the settings of those, and keep the mean that was judged best,
        rather than the final one. The longer a search on a bandit, the more it learns about the bandit
        alone. Takes environment steps, of which the search itself sees none.
      backend: Brax physics, where the environment is Brax's (with transfer: the evaluation
        environment).
      initial_scale: of the drift's random start, so that the search begins near what it corrects.
      drift: the settings of what is learned.
      evolution: of the candidates.
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
        Mapping[str, tuple[float, ...]], text(read_values, write_values, "'NAME=A,B NAME=A'")
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
        if self.fitness not in FITNESSES:
            raise unknown_name("fitness", self.fitness, FITNESSES)
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
                f"fitness {self.fitness!r} needs trainings of one length: leave out the horizons, or use 'return'."
            )
        for horizon in self.horizons:
            if not 0 < horizon < math.inf:
                raise UserError(
                    f"a horizon is {horizon}: it must be larger than 0, and finite (1 is the setting's own)."
                )
        check_lists(self.hyperparameters, PPOHyperparameters())
        for name in ("drift", "horizon"):
            if name in self.hyperparameters:
                raise UserError(
                    f"{name} is not drawn from a list: the drift is what is learned, and horizons are a setting of "
                    "their own."
                )
        at_least(1, self, "agents_per_candidate", "evaluation_episodes", "contexts")
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

    def at_home(self) -> "MetaTrainingConfig":
        """The same on the tasks' evaluation environments themselves."""
        return replace(self, tasks=self.homes, fitness="return", agent=None)


def task_agent(task: str, contexts: int) -> AgentSpec:
    """PPO as the evaluation environment has it, or on a bandit its image (`AgentSpec.on_bandit`)."""
    place = environment_spec(task)
    spec = environment_agent("ppo", place.evaluation_environment)
    return spec.on_bandit(contexts) if place.synthetic else spec


class TaskTraining:
    """Trains one PPO agent with a drift in one task's environment and says what it is worth.

    Args:
      config: the meta-training's.
      environment: the task, one of the configuration's.
      drift: the family that the drift parameters belong to; None for the configuration's. Any
        member of the contract will do here.
    """

    def __init__(
        self, config: MetaTrainingConfig, environment: str, drift: Drift | None = None
    ) -> None:
        self.config, self.environment = config, environment
        spec = environment_spec(environment)
        self.home = spec.evaluation_environment

        def made(spec: EnvironmentSpec) -> Made:
            # Of several tasks some may have a choice of physics; a single one is told where it has none.
            several = len(config.tasks) > 1
            return spec.make(spec.physics(config.backend) if several else config.backend)

        if config.judgement.at_home:
            # The bandit has no physics; the environment that it stands for may.
            self.env, self.env_params = spec.make()
            judged_in = environment_spec(self.home)
            self.evaluation_env, self.evaluation_params = made(judged_in)
        else:
            self.env, self.env_params = made(spec)
            judged_in = spec
            self.evaluation_env, self.evaluation_params = self.env, self.env_params
        agent = task_agent(environment, config.contexts)
        self.spec = replace(
            agent, config=config.agent or agent.config, lists=config.hyperparameters
        )
        self.every, iterations = spaced(self.spec.config.num_iterations, POINTS)
        if config.judgement.along:
            self.spec = self.spec.with_steps(self.spec.config.steps_after(iterations))
        self.agent = self.spec.agent(self.env, drift or config.drift)
        self.evaluation_episodes = config.evaluation_episodes or (50 if judged_in.is_bandit else 20)
        self.training_params = self.env_params
        if spec.is_bandit and config.reward_noise:
            scale = self.env.reward_scale(
                self.env_params, named_key(root_key(0), f"reward scale of {self.env.name}")
            )
            self.training_params = self.env_params.replace(reward_noise=config.reward_noise * scale)

    def fitness(
        self, drift_parameters: Any, key: jax.Array, number: int, horizon: ArrayLike = 1.0
    ) -> jax.Array:
        """[number] fitnesses of as many agents, each trained with these drift parameters.

        Args:
          horizon: how long they train, as a fraction of the inner loop's iterations; traced.
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
            iterations = jnp.round(jnp.asarray(horizon) * self.spec.config.num_iterations)
            iterations = jnp.maximum(1, iterations.astype(jnp.int32))
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

    def steps(self, agents: int, share: float = 1.0) -> EnvironmentSteps:
        """Of so many agents that train for this share of the agent's steps."""
        points = 1
        if self.config.judgement.along:
            points = self.spec.config.num_iterations // self.every + 1
        return EnvironmentSteps(
            training=round(agents * self.spec.steps * share),
            evaluation=agents
            * points
            * self.evaluation_episodes
            * int(self.evaluation_params.max_steps_in_episode),
        )


class MetaTraining:
    """The evolution problem: a candidate is a drift's weights, worth what agents make of it on every task."""

    def __init__(self, config: MetaTrainingConfig) -> None:
        self.config = config
        self.tasks = {name: TaskTraining(config, name) for name in config.tasks}
        self.judges = self.tasks
        if config.validation:
            own = replace(config.at_home(), horizons=())
            self.judges = {name: TaskTraining(own, name) for name in own.tasks}
        # {judge: (return that counts as 0, return that counts as 1)}.
        self.scales = dict.fromkeys(self.judges, (0.0, 1.0))
        if config.validation and len(self.judges) > 1:
            specs, backend = map(environment_spec, self.judges), config.backend
            self.scales = {
                s.name: (s.random_return(backend), s.reference_return(backend)) for s in specs
            }

    def initial_solution(self, key: jax.Array) -> Any:
        return self.config.drift.init(key, self.config.initial_scale)

    def evaluate(
        self, candidate: Any, key: jax.Array, generation: jax.Array
    ) -> dict[str, jax.Array]:
        config = self.config
        *keys, key_horizon = split_key(key, len(self.tasks) + 1)
        horizon: Any = 1.0
        if config.horizons:
            # One for the whole generation: candidates are compared on it, and no agent waits for
            # another.
            horizon = jax.random.choice(key_horizon, jnp.asarray(config.horizons))
        fitness = {
            name: task.fitness(candidate, key_task, config.agents_per_candidate, horizon)
            for key_task, (name, task) in zip(keys, self.tasks.items(), strict=True)
        }
        combined = jnp.concatenate(list(fitness.values()))
        return {"fitness": combined, **_apart({name: x.mean() for name, x in fitness.items()})}

    def evaluate_mean(self, candidate: Any, key: jax.Array) -> dict[str, jax.Array]:
        keys = split_key(key, len(self.judges))
        fitness = {
            name: task.fitness(candidate, key_judge, 1)[0]
            for key_judge, (name, task) in zip(keys, self.judges.items(), strict=True)
        }
        scores = [
            (x - zero) / (one - zero)
            for x, (zero, one) in zip(fitness.values(), self.scales.values(), strict=True)
        ]
        return {"fitness": jnp.stack(scores).mean(), **_apart(fitness)}

    def steps(self) -> EnvironmentSteps:
        """Of one candidate; with random horizons the mean over them."""
        horizons = self.config.horizons or (1.0,)
        share = sum(horizons) / len(horizons)
        return _sum(
            task.steps(self.config.agents_per_candidate, share) for task in self.tasks.values()
        )

    def judgement_steps(self) -> EnvironmentSteps:
        """Of one agent for each judge, trained in full."""
        return _sum(judge.steps(1) for judge in self.judges.values())


def _apart(fitness: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """For the log, where there are several."""
    return {} if len(fitness) == 1 else {f"fitness/{name}": x for name, x in fitness.items()}


def _sum(counts: Iterable[EnvironmentSteps]) -> EnvironmentSteps:
    counts = list(counts)
    return EnvironmentSteps(sum(c.training for c in counts), sum(c.evaluation for c in counts))


def meta_train(config: MetaTrainingConfig, run: Run | None = None, quiet: bool = False) -> Outcome:
    """Evolves a drift; the outcome's means are its weights."""
    return evolve(MetaTraining(config), config.evolution, run, quiet)


def learn_objective(
    problem: MetaTraining, run: Run, command: str, file: str = "objective.npz"
) -> Objective:
    """The objective of a run folder: read where it is there already, else learned, or its learning resumed.

    It is saved with its certificate and its story.

    Args:
      command: that repeats the run.
      file: of the objective in the folder.
    """
    path, config = run.folder / file, problem.config
    if not path.with_suffix(".json").exists():  # it is written last
        outcome = evolve(problem, config.evolution, run)
        run.close()
        mean = outcome.best_mean if config.validation else outcome.mean
        save_objective(path, config.drift, mean, _story(problem, outcome, mean, command))
    return load_objective(path)


def environment_problem(config: MetaTrainingConfig) -> MetaTraining:
    """The same meta-training on the bandits' evaluation environments themselves."""
    return MetaTraining(config.at_home())


def _story(problem: MetaTraining, outcome: Outcome, mean: Any, command: str) -> dict[str, Any]:
    """What a learned objective's .json says of its meta-training."""
    evolution: EvolutionConfig = problem.config.evolution
    judged = [
        {"generation": line["generation"], "fitness": value}
        for line in outcome.metrics
        for key, value in line.items()
        if key in ("mean/fitness", "final_mean/fitness")
    ]
    end = outcome.validate(mean)["fitness"]
    config: dict[str, Any] = {"meta_training": config_dict(problem.config)}
    bandits = [name for name in problem.tasks if environment_spec(name).is_bandit]
    if bandits:
        # The name alone does not say which weights it stood for.
        config["bandit_sha256"] = {name: bandit_metadata(name)["sha256"] for name in bandits}
    return {
        "config": config,
        "seeds": {"meta_training": evolution.seed, "validation": VALIDATING.start},
        "results": {
            "mean_fitness": judged,
            "validation": estimate(end).as_dict() if np.isfinite(end).all() else None,
        },
        "cost": outcome.cost(problem, evolution, best=problem.config.validation),
        "command": command,
    }
