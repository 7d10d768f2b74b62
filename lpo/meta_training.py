"""Learn an objective: evolve a drift's weights so that agents trained with it end up good.

Lu et al. (2022), "Discovered Policy Optimisation", with the inner loop on a synthetic contextual
bandit instead of an environment (Liesen et al., 2024). The same code trains on either.

A bandit's advantages are exact; a real environment's are mostly noise, and restraint is only worth
learning under noise. Here the bandit's reward carries noise of several of its own standard deviations:
of the searches on Pendulum's bandit, those without noise ended behind on Pendulum.
"""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lpo.drifts.contract import check_static
from lpo.inner_loop import MetaTrainingConfig, TaskTraining
from lpo.objectives import Objective, load_objective, save_objective
from scb import processes
from scb.command_line import GENERATIONS
from scb.configurations import config_dict, with_defaults
from scb.environments.registry import environment_spec
from scb.environments.zoo import digests
from scb.errors import UserError, of_class
from scb.evolution import EnvironmentSteps, EvolutionConfig, Outcome, evolve, judgements
from scb.keys import root_key, split_key
from scb.runs import Run, run_of
from scb.seeds import VALIDATING
from scb.statistics import estimate

# Agents that judge a mean on the environment, where each costs a training there.
VALIDATION_AGENTS = 16
# A temporally-aware drift meets trainings from a quarter to twice as long as the setting's own.
TEMPORAL_HORIZONS = (0.25, 0.5, 1.0, 2.0)


class MetaTraining:
    """The evolution problem: a candidate is a drift's weights, worth what agents make of it on every task."""

    def __init__(self, config: MetaTrainingConfig) -> None:
        if not isinstance(jax.eval_shape(config.drift.init, root_key(0)), Mapping):
            raise UserError(
                f"the drift is of the family {config.drift.name}, which has nothing to learn: take a LearnedDrift."
            )
        # What could not be loaded or saved is refused before it is learned.
        check_static(config.drift)
        config.drift.shapes()
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

    def steps(self, generation: int = 0) -> EnvironmentSteps:
        """Of one candidate; with random horizons the mean over them."""
        each = (task.steps(self.config.agents_per_candidate) for task in self.tasks.values())
        return sum(each, EnvironmentSteps(0, 0))

    def judgement_steps(self) -> EnvironmentSteps:
        """Of one agent for each judge, trained in full."""
        each = (judge.steps(1, full=True) for judge in self.judges.values())
        return sum(each, EnvironmentSteps(0, 0))


def _apart(fitness: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """For the log, where there are several."""
    return {} if len(fitness) == 1 else {f"fitness/{name}": x for name, x in fitness.items()}


def meta_train(
    config: MetaTrainingConfig, run: Run | str | Path | None = None, quiet: bool = False
) -> Outcome:
    """Evolves a drift.

    Args:
      config: what it is learned on, and how. What is a list on the command line is a tuple here, and what has names a
        dict; `dataclasses.replace(MetaTrainingConfig().evolution, num_generations=10)` keeps the rest of its default,
        which an EvolutionConfig made anew does not.
      run: a folder for logs and checkpoints. Killed, the same call goes on from the last checkpoint, also with more
        generations, or with fewer; once it has ended, it returns the outcome. None: nothing is kept.
      quiet: no line a generation.

    Returns:
      The outcome, whose `mean` and `best_mean` are the drift's weights: what `save_objective` takes beside
      `config.drift`.

    Raises:
      UserError: the folder holds something else, or a run of another configuration.

    Warns:
      UserWarning: the drift's class is where no import finds it, so that `save_objective` would refuse it.
    """
    of_class(MetaTrainingConfig, config=config)
    problem = MetaTraining(config)  # a mistake must not leave a folder behind
    try:
        config.drift.family()
    except UserError as error:
        warnings.warn(f"What is learned here cannot be saved: {error}", stacklevel=2)
    with run_of(run, config, config.checksums(), GENERATIONS) as opened:
        return evolve(problem, config.evolution, opened, quiet)


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
    mean = None
    if not processes.told(_learned(path, config)):
        outcome = evolve(problem, config.evolution, run)
        run.end_log()
        outcome.check(best=bool(config.validation))
        mean = outcome.best_mean if config.validation else outcome.mean
        story = _story(problem, outcome, mean, command)
        if processes.first():
            save_objective(path, config.drift, mean, story)
    if not processes.first():  # which has the folder
        return Objective(path.stem, config.drift, mean)
    return load_objective(path)


def _learned(path: Path, config: MetaTrainingConfig) -> bool:
    """Whether the objective of a search, and not of one of fewer generations, is there."""
    if not path.with_suffix(".json").exists():  # it is written last
        return False
    stored = load_objective(path).metadata["config"]["meta_training"]
    return bool(with_defaults(stored, config) == config_dict(config))


def environment_problem(config: MetaTrainingConfig) -> MetaTraining:
    """The same meta-training on the bandits' evaluation environments themselves."""
    return MetaTraining(config.at_home())


def _story(problem: MetaTraining, outcome: Outcome, mean: Any, command: str) -> dict[str, Any]:
    """What a learned objective's .json says of its meta-training."""
    evolution: EvolutionConfig = problem.config.evolution
    judged = [
        {"generation": generation, "fitness": of_it["fitness"]}
        for generation, of_it in judgements(outcome.metrics)
    ]
    end = outcome.validate(mean)["fitness"]
    return {
        "config": {
            "meta_training": config_dict(problem.config),
            "homes": problem.config.homes,
            "bandit_sha256": digests(problem.config.tasks),
        },
        "seeds": {"meta_training": evolution.seed, "validation": VALIDATING.start},
        "results": {
            "mean_fitness": judged,
            "validation": estimate(end).as_dict() if np.isfinite(end).all() else None,
        },
        "cost": outcome.cost(problem, evolution, best=problem.config.validation),
        "command": command,
    }
