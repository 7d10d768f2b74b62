"""What meta-training costs on the bandit and on the environment that it stands for: steps and wall-clock.

    python -m experiments meta_training_cost

Times a few generations of the same population on either, after the first, which compiles.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Experiment, Save
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import MetaTraining, environment_problem
from scb.errors import at_least
from scb.keys import root_key
from scb.population import map_population
from scb.stopwatch import Stopwatch


@dataclass(frozen=True)
class Options:
    """How much is timed."""

    population_size: int = 32
    generations: int = 3
    """timed generations, the first not counted"""

    def __post_init__(self) -> None:
        at_least(1, self, "population_size", "generations")


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """The bandit, then the environment."""
    default = MetaTrainingConfig()
    config = replace(
        default, evolution=replace(default.evolution, population_size=options.population_size)
    )
    problems = {"bandit": MetaTraining(config), "environment": environment_problem(config)}
    result: dict[str, dict[str, float]] = {}
    for name, problem in problems.items():
        weights = problem.initial_solution(root_key(0))
        population = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (options.population_size, *x.shape)), weights
        )
        evaluate = map_population(problem.evaluate, options.population_size, (0, None, None))
        watch, seconds = Stopwatch(), []
        for generation in range(options.generations + 1):
            evaluate(population, root_key(generation), jnp.int32(generation))
            seconds.append(watch.lap())
        steps = problem.steps()
        result[name] = {
            "steps_per_candidate_training": steps.training,
            "steps_per_candidate_evaluation": steps.evaluation,
            "steps_per_candidate": steps.total,
            "seconds_per_generation": float(np.median(seconds[1:])),
        }
        print(f"{name}: {result[name]}")
    ratios = {
        key: result["environment"][key] / result["bandit"][key]
        for key in ("steps_per_candidate", "seconds_per_generation")
    }
    print(
        f"the bandit takes {ratios['steps_per_candidate']:.1f} times fewer environment steps and "
        f"{ratios['seconds_per_generation']:.1f} times less wall-clock"
    )
    report |= {"population_size": options.population_size, **result, "ratios": ratios}
    save()


EXPERIMENT = Experiment(
    "meta_training_cost",
    "What meta-training costs",
    measure,
    options=Options,
    out=Path("runs/meta_training_cost.json"),
)
