"""The outer loop of both discoveries: evolve a pytree of weights by what it is worth after an inner training.

Bandit discovery and objective discovery differ only in what a candidate is. This module owns what
they share: common random numbers across a population, what
a failed candidate gets, the sign, sharding over devices, the evaluation of the search
distribution's mean, checkpoints, resume, and logs.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from scb import termination
from scb.checkpoints import continued
from scb.console import Progress, progress_console
from scb.errors import UserError, agents_at_least, at_least, one_of, positive, unused
from scb.files import plain
from scb.keys import key_at, root_key, split_key
from scb.machine import machine_description
from scb.population import combine_tasks, map_population, rank_failed_last
from scb.runs import Run
from scb.seeds import VALIDATING, searching
from scb.statistics import iqm
from scb.stopwatch import Stopwatch
from scb.strategies import (
    DISTRIBUTIONS,
    GRADIENT_ESTIMATING,
    SCHEDULED,
    STRATEGIES,
    check_memory,
    strategy_for,
)

COMBINATIONS = ("mean", "ranks")


@dataclass(frozen=True)
class EvolutionConfig:
    """Evolution of the candidates.

    Attributes:
      strategy: any of evosax's, by name (SNES, Open_ES, CMA_ES, ...).
      population_size: candidates a generation.
      num_generations: how many of them; with 0 a search for a bandit, which alone takes that, ends with its start.
      sigma: initial standard deviation of the search distribution.
      sigma_decay: factor on it a generation, from the second on, for strategies with a schedule (Open_ES).
      sigma_limit: what it decays down to.
      learning_rate: of Adam, for Open_ES and its relatives; SNES steps by its own rule.
      learning_rate_decay: factor on it a generation.
      learning_rate_limit: what it decays down to.
      combine: how a candidate's agents and tasks count: mean, or ranks (the mean over them of its rank
        among the candidates).
      averaging: generations over which the search distribution's mean is averaged, exponentially, before it is judged
        and taken as the result; 1 takes it as it is. The search itself does not see it. Where fitness is
        noisy the mean wanders about what was found, and its average does so less.
      mean_evaluations: agents that judge the mean of the search distribution.
      evaluate_mean_every: generations between those judgements (and one after the last generation).
      checkpoint_every: generations between checkpoints.
      seed: decides everything else; 0 to 9999, which are for searches.
    """

    strategy: str = "SNES"
    population_size: int = 64
    num_generations: Annotated[int, tyro.conf.arg(name="generations")] = 100
    sigma: float = 0.05
    sigma_decay: float = 1.0
    sigma_limit: float = 0.0
    learning_rate: float = 0.01
    learning_rate_decay: float = 1.0
    learning_rate_limit: float = 0.0
    combine: str = "mean"
    averaging: int = 1
    mean_evaluations: int = 64
    evaluate_mean_every: int = 10
    checkpoint_every: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        one_of("evolution strategy", self.strategy, STRATEGIES)
        one_of("combination of tasks", self.combine, COMBINATIONS)
        at_least(0, self, "num_generations")
        agents_at_least(2, self, "population_size")  # which evolution compares
        if self.strategy == "Open_ES" and self.population_size % 2:
            raise UserError(
                f"population_size is {self.population_size}: Open_ES samples antithetic pairs, so it must be even."
            )
        if self.combine == "ranks":
            because = "which ranks among candidates of one do not allow"
            check_memory(self.strategy, because, "combine by mean")
        at_least(1, self, "averaging", "evaluate_mean_every", "checkpoint_every")
        agents_at_least(1, self, "mean_evaluations")
        if self.averaging > 1 and self.strategy not in DISTRIBUTIONS:
            because = f"{self.strategy} keeps a population and no mean"
            unused(self, because, ("averaging",), "choose a strategy such as SNES")
        searching(self.seed)
        positive(self, "sigma", "sigma_decay", "learning_rate", "learning_rate_decay")
        at_least(0, self, "sigma_limit", "learning_rate_limit")
        for needed, settings in (
            (GRADIENT_ESTIMATING, ("learning_rate", "learning_rate_decay", "learning_rate_limit")),
            (SCHEDULED, ("sigma_decay", "sigma_limit")),
        ):
            if self.strategy not in needed:
                because = f"{self.strategy} steps by a rule of its own"
                unused(self, because, settings, "choose a strategy such as Open_ES")


@dataclass(frozen=True)
class EnvironmentSteps:
    """Steps of training and of evaluation, counted apart."""

    training: int
    evaluation: int

    @property
    def total(self) -> int:
        return self.training + self.evaluation

    def __add__(self, other: "EnvironmentSteps") -> "EnvironmentSteps":
        return EnvironmentSteps(self.training + other.training, self.evaluation + other.evaluation)

    def __mul__(self, number: int) -> "EnvironmentSteps":
        return EnvironmentSteps(number * self.training, number * self.evaluation)


class Problem(Protocol):
    """What is evolved."""

    def initial_solution(self, key: jax.Array) -> Any:
        """The mean that the search starts from: a pytree of float arrays."""

    def evaluate(
        self, candidate: Any, key: jax.Array, generation: jax.Array
    ) -> dict[str, jax.Array]:
        """{"fitness": [] or [K], ...}: what a candidate is worth, to be maximised.

        K numbers are K tasks, combined as the configuration says; other entries are logged.
        """

    def evaluate_mean(self, candidate: Any, key: jax.Array) -> dict[str, jax.Array]:
        """{"fitness": [], ...} of one agent, in the setting that the result is judged by."""

    def steps(self, generation: int = 0) -> EnvironmentSteps:
        """Environment steps of one `evaluate` in this generation."""

    def judgement_steps(self) -> EnvironmentSteps:
        """Environment steps of one `evaluate_mean`."""


def evaluated(problem: Problem, config: EvolutionConfig, generations: int) -> EnvironmentSteps:
    """Environment steps of all candidates of so many generations."""
    each = [problem.steps(generation) for generation in range(generations)]
    return sum(each, EnvironmentSteps(0, 0)) * config.population_size


@runtime_checkable
class Scaled(Protocol):
    """A problem whose numbers are of different sizes."""

    def units(self, solution: Any) -> Any:
        """Of the first solution: what a change of 1 is for each number, or None where it is 1 for all."""


@dataclass(frozen=True)
class Outcome:
    """What an evolution ends with.

    Attributes:
      mean: of the final search distribution, averaged as the configuration says.
      best_mean: the mean at that generation whose evaluation (`evaluate_mean`, interquartile mean)
        was best. Chosen under noise: report it on fresh seeds only.
      best_mean_generation: which one that was; -1, and the mean that of the start, where none could be judged.
      metrics: the run's log.
      seconds: wall-clock of all generations.
      steps: that all candidates of all generations took.
      validate: {"fitness": [N], ...} of a solution, by `evaluate_mean` with N = `mean_evaluations`
        agents of validation seeds, which neither moved the search nor chose in it.
    """

    mean: Any
    best_mean: Any
    best_mean_generation: int
    metrics: list[dict[str, Any]]
    seconds: float
    steps: EnvironmentSteps
    validate: Callable[[Any], dict[str, np.ndarray]]

    def check(self, best: bool = False) -> None:
        """Raises a UserError where no candidate had a finite fitness; or, where the best is taken, no judged mean."""
        if self.metrics and not any("fitness/mean" in line for line in self.metrics):
            raise UserError(
                f"no candidate of {len(self.metrics)} generations had a finite fitness, so nothing was found: lower "
                "the learning rates, or start from something else."
            )
        if best and self.best_mean_generation < 0:
            raise UserError(
                "more than a quarter of the agents of every judgement diverged, so no mean is best: take the final "
                "one, or lower the learning rates."
            )

    def cost(self, problem: Problem, config: EvolutionConfig, best: bool) -> dict[str, Any]:
        """What an artefact says of the search's cost; `best` where the mean judged best was taken."""
        agents = len(judgements(self.metrics)) * config.mean_evaluations
        judging = problem.judgement_steps()
        return {
            "environment_steps_training": self.steps.training,
            "environment_steps_evaluation": self.steps.evaluation,
            "environment_steps_judgements_training": agents * judging.training,
            "environment_steps_judgements_evaluation": agents * judging.evaluation,
            "seconds": round(self.seconds, 1),
            **({"generation": self.best_mean_generation} if best else {}),
            "machine": machine_description(),
        }


def judgements(metrics: Sequence[Mapping[str, Any]]) -> list[tuple[int, dict[str, Any]]]:
    """(generation before which, {"fitness", "fitness_iqm", ...}) of each judgement that a search's log has of its mean.

    The last comes after all generations.
    """
    found = []
    for line in metrics:
        for later, start in enumerate(("mean/", "final_mean/")):
            judged = {k.removeprefix(start): x for k, x in line.items() if k.startswith(start)}
            if judged:
                found.append((line["generation"] + later, judged))
    return found


def evolve(
    problem: Problem,
    config: EvolutionConfig,
    run: Run | None = None,
    quiet: bool = False,
    key: jax.Array | None = None,
) -> Outcome:
    """Runs, or resumes, an evolution.

    Every generation is a function of (config, generation, strategy state), so a run that was killed
    and resumed ends with the same bytes as one that was not, on the same machine, devices and
    versions; and one that is resumed with more generations, or fewer, goes on to the same mean as one that
    had them from the start. Where they are more its log, and what is best, know one judgement more: that of its
    first end.

    Args:
      problem: what is evolved.
      config: how.
      run: where to log and checkpoint; None keeps everything in memory. A resumed run continues
        after its newest intact checkpoint.
      quiet: no progress on the terminal.
      key: of an evolution inside of another one, in place of the configuration's seed.

    Returns:
      The Outcome.
    """
    key = root_key(config.seed) if key is None else key
    key_solution, *keys = split_key(key, 4)
    solution = problem.initial_solution(key_solution)
    evaluate_mean = map_population(problem.evaluate_mean, config.mean_evaluations, (None, 0))

    def judged(solution: Any, key: jax.Array) -> dict[str, np.ndarray]:
        return dict(evaluate_mean(solution, split_key(key, config.mean_evaluations)))

    def validate(solution: Any) -> dict[str, np.ndarray]:
        return judged(solution, root_key(VALIDATING.start))

    if not config.num_generations:
        start = jax.device_get(solution)
        return Outcome(start, start, 0, [], 0.0, EnvironmentSteps(0, 0), validate)
    search = _Search(problem, config, solution, judged, keys)
    console = progress_console(quiet)
    checkpoints, first, search.state = continued(run.folder if run else None, search.state, console)
    if run and checkpoints:
        run.rewind(first)
    search.steps = evaluated(problem, config, first)
    saved = first
    # What is complete at any moment: steps into the next generation are not part of it.
    latest = first, dict(search.state)

    def save() -> str:
        """Writes a checkpoint after the latest generation, unless it is there."""
        nonlocal saved
        assert run is not None and checkpoints is not None
        with termination.writing:
            generation, kept = latest
            if generation > saved:
                checkpoints.save(generation, kept)
                saved = generation
        return f"{run.folder} is saved after {generation} generations"

    # Of several processes the first alone keeps the log.
    history, total_seconds = (run.metrics(), run.seconds()) if run and checkpoints else ([], 0.0)
    watch = Stopwatch()
    with (
        termination.saving(save) if checkpoints else nullcontext(),
        Progress(console, config.num_generations, first) as advance,
    ):
        for generation in range(first, config.num_generations):
            metrics = search.step(generation)
            last = generation + 1 == config.num_generations
            if last:
                metrics |= {f"final_{k}": v for k, v in search.judge(generation + 1).items()}
            seconds = watch.lap()
            total_seconds += seconds
            if run and checkpoints:
                run.log(generation, metrics, seconds)
            history.append({"generation": generation, **{k: plain(v) for k, v in metrics.items()}})
            latest = generation + 1, dict(search.state)
            if checkpoints and (last or (generation + 1) % config.checkpoint_every == 0):
                save()
            advance(metrics, seconds)
    if checkpoints:
        checkpoints.close()
    return Outcome(
        mean=jax.device_get(search.mean()),
        best_mean=jax.device_get(search.state["best_mean"]),
        best_mean_generation=int(search.state["best_mean_generation"]),
        metrics=history,
        seconds=total_seconds,
        steps=search.steps,
        validate=validate,
    )


class _Search:
    """What generations do to a search.

    Args:
      judged: (solution, key) -> what agents earn with it, by name.
      keys: of the strategy's start, of the generations and of the mean's judgements.

    Attributes:
      state: all of it that a checkpoint holds.
      steps: in environments, of all generations so far.
    """

    def __init__(
        self,
        problem: Problem,
        config: EvolutionConfig,
        solution: Any,
        judged: Callable[[Any, jax.Array], dict[str, np.ndarray]],
        keys: Sequence[jax.Array],
    ) -> None:
        key_strategy, self._key_generations, self._key_mean = keys
        self._problem, self._config, self._judged = problem, config, judged
        self._strategy = strategy_for(config, solution)
        self._evaluate = map_population(problem.evaluate, config.population_size, (0, None, None))
        units = problem.units(solution) if isinstance(problem, Scaled) else None
        self.steps = EnvironmentSteps(0, 0)
        self.state: dict[str, Any] = {
            "strategy": self._strategy.start(key_strategy, solution, units),
            "best_mean": solution,
            "best_mean_fitness": jnp.float32(-jnp.inf),
            "best_mean_generation": jnp.int32(-1),
        }
        if config.averaging > 1:
            self.state |= {"average": solution, "averaged": jnp.int32(0)}

    def mean(self) -> Any:
        """The search distribution's, or its average over the last generations."""
        if self._config.averaging > 1:
            return self.state["average"]
        return self._strategy.mean(self.state["strategy"])

    def judge(self, generation: int) -> dict[str, float]:
        """What the mean is worth, for the log; kept where it is the best so far."""
        mean = self.mean()
        # The same seeds at every judgement: means of different generations are then compared in
        # pairs.
        returns = self._judged(mean, self._key_mean)
        outcome = {name: float(np.mean(v)) for name, v in returns.items()}
        # The interquartile mean too: of agents with random hyperparameters a few fail far below the rest, and
        # those that diverged count as below the worst of the others.
        middles = {
            f"{name}_iqm": float(iqm(rank_failed_last(v)))
            for name, v in returns.items()
            if np.isfinite(v).any()
        }
        score = middles.get("fitness_iqm", -np.inf)
        # Where those that diverged are more than the quarter that it drops, it is no measure beside others.
        if np.sum(~np.isfinite(returns["fitness"])) > returns["fitness"].size // 4:
            score = -np.inf
        if score > float(self.state["best_mean_fitness"]):
            self.state["best_mean"] = mean
            self.state["best_mean_fitness"] = jnp.float32(score)
            self.state["best_mean_generation"] = jnp.int32(generation)
        return {f"mean/{name}": value for name, value in {**outcome, **middles}.items()}

    def step(self, generation: int) -> dict[str, Any]:
        """Asks for candidates, evaluates them, and tells what they are worth; returns what is logged of it."""
        config, state = self._config, self.state
        key_ask, key_evaluate, key_tell = split_key(key_at(self._key_generations, generation), 3)
        metrics: dict[str, Any] = {}
        due = generation % config.evaluate_mean_every == 0
        if due and (self._strategy.has_mean or generation > 0):
            metrics |= self.judge(generation)
        population, state["strategy"] = self._strategy.ask(key_ask, state["strategy"])
        # One key for all: candidates are compared on the same seeds, hyperparameters and start
        # states.
        results = self._evaluate(population, key_evaluate, jnp.int32(generation))
        tasks = np.asarray(results.pop("fitness"), np.float32).reshape(config.population_size, -1)
        fitness = tasks.mean(axis=1)
        # What failed has no fitness: it is counted, and the log's numbers are of the others.
        finite = fitness[np.isfinite(fitness)]
        if finite.size:
            told = rank_failed_last(combine_tasks(tasks, config.combine))
            state["strategy"] = self._strategy.tell(key_tell, population, told, state["strategy"])
            self._average()
            metrics |= {
                "fitness/mean": finite.mean(),
                "fitness/std": finite.std(),
                "fitness/max": finite.max(),
                "fitness/min": finite.min(),
            }
        self.steps += self._problem.steps(generation) * config.population_size
        return metrics | {
            "failed": config.population_size - finite.size,
            "steps/training": self.steps.training,
            "steps/evaluation": self.steps.evaluation,
            "steps/total": self.steps.total,
            # What has no number in this generation (an algorithm whose turn it wasn't) is left out.
            **{
                f"candidates/{name}": np.nanmean(value)
                for name, value in results.items()
                if not np.all(np.isnan(value))
            },
        }

    def _average(self) -> None:
        if self._config.averaging <= 1:
            return
        # Of fewer generations at first, all alike, but those that failed.
        self.state["averaged"] = self.state["averaged"] + 1
        share = 1 / min(int(self.state["averaged"]), self._config.averaging)
        self.state["average"] = jax.tree.map(
            lambda old, new: old + share * (new - old),
            self.state["average"],
            self._strategy.mean(self.state["strategy"]),
        )
