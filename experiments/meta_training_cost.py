"""What meta-training costs on the bandit and on the environment that it stands for: steps and wall-clock.

    python -m experiments.meta_training_cost

Times a few generations of the same population on either, after the first, which compiles.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import exit_status
from lpo.meta_training import MetaTraining, MetaTrainingConfig
from lpo.pipeline import environment_problem
from scb.artefacts import machine_description, package_versions
from scb.cli import configure_jax
from scb.evolution import map_population
from scb.keys import root_key
from scb.runs import Stopwatch


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--population-size", type=int, default=32)
    parser.add_argument(
        "--generations", type=int, default=3, help="timed generations, the first not counted"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/meta_training_cost.json"))
    arguments = parser.parse_args()
    configure_jax()

    default = MetaTrainingConfig()
    config = replace(
        default,
        evolution=replace(default.evolution, population_size=arguments.population_size),
    )
    problems = {
        "bandit": MetaTraining(config),
        "environment": environment_problem(config),
    }
    result: dict[str, dict[str, float]] = {}
    for name, problem in problems.items():
        weights = problem.initial_solution(root_key(0))
        population = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (arguments.population_size, *x.shape)), weights
        )
        evaluate = map_population(problem.evaluate, arguments.population_size, (0, None, None))
        watch, seconds = Stopwatch(), []
        for generation in range(arguments.generations + 1):
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
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(
        json.dumps(
            {
                "population_size": arguments.population_size,
                **result,
                "ratios": ratios,
                "versions": package_versions(),
                "machine": machine_description(),
            },
            indent=2,
        )
        + "\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(exit_status("meta_training_cost", main))
