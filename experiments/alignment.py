"""Does a bandit rank objectives as the environment does?

    python -m experiments.alignment

Nine known drifts train PPO agents on Pendulum-v1, and in several regimes of the shipped Pendulum
bandit. A regime is useful for meta-training if its fitness ranks the drifts as Pendulum's final
return does (Spearman's correlation). The interval resamples the agents of each drift; nine drifts
are few, so read it with care.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from lpo.cli import configure_jax

REGIMES: list[dict[str, Any]] = [
    {"contexts": 200, "reward_noise": 0.0, "fitness": "return"},
    {"contexts": 200, "reward_noise": 2.0, "fitness": "return"},
    {"contexts": 200, "reward_noise": 5.0, "fitness": "return"},
    {"contexts": 200, "reward_noise": 2.0, "fitness": "transfer"},
    {"contexts": 200, "reward_noise": 5.0, "fitness": "transfer"},
    {"contexts": 1000, "reward_noise": 5.0, "fitness": "return"},
    {"contexts": 1000, "reward_noise": 5.0, "fitness": "transfer"},
]
FIRST_SEED = 500  # neither the seeds that meta-training sees nor those that report


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--agents", type=int, default=16, help="agents of each drift")
    parser.add_argument("--out", type=Path, default=Path("runs/alignment.json"))
    arguments = parser.parse_args()
    configure_jax()

    import jax
    import numpy as np

    from lpo.drift import ClipDrift, DPODrift, Drift, NoDrift
    from lpo.generalization import learning_curves
    from lpo.meta_training import MetaTrainingConfig, TaskTraining
    from lpo.objectives import Objective
    from scb.artefacts import machine_description, package_versions
    from scb.evolution import map_population
    from scb.statistics import iqm, spearman

    family: dict[str, Drift] = {
        **{f"ppo-{clip:g}": ClipDrift(clip) for clip in (0.05, 0.1, 0.2, 0.5, 1.0)},
        "none": NoDrift(),
        "dpo (1, 0.3)": DPODrift(1.0, 0.3),
        "dpo (2, 0.6)": DPODrift(),
        "dpo (4, 1.2)": DPODrift(4.0, 1.2),
    }
    parameters = {name: drift.init(jax.random.key(0)) for name, drift in family.items()}
    seeds = list(range(FIRST_SEED, FIRST_SEED + arguments.agents))
    outcome = {}
    for name, drift in family.items():
        objective = Objective(name, drift, parameters[name])
        outcome[name] = learning_curves("Pendulum-v1", objective, seeds, points=1).final
        print(f"Pendulum-v1 with {name}: IQM {iqm(outcome[name]):.0f}", flush=True)

    rows = []
    random = np.random.default_rng(0)
    for regime in REGIMES:
        start = time.perf_counter()
        fitness = {}
        for name, drift in family.items():
            # MetaTraining takes any member of the contract: the known drifts stand in for a
            # candidate.
            problem = TaskTraining(
                MetaTrainingConfig(drift=drift, **regime), "Synthetic-Pendulum-v1"
            )  # type: ignore[arg-type]
            train = map_population(
                lambda key, p=problem, w=parameters[name]: p.train_one(w, key),
                arguments.agents,
                (0,),
            )
            fitness[name] = np.asarray(
                train(jax.random.split(jax.random.key(FIRST_SEED), arguments.agents))
            )

        def correlation(pick: Any = slice(None), fitness: Any = fitness) -> float:
            return float(
                spearman(
                    [fitness[n][pick].mean() for n in family],
                    [iqm(outcome[n][pick]) for n in family],
                )
                or 0.0
            )

        resampled = [
            correlation(random.integers(0, arguments.agents, arguments.agents)) for _ in range(500)
        ]
        low, high = np.percentile(resampled, [2.5, 97.5])
        rows.append(
            {
                **regime,
                "spearman": correlation(),
                "low": float(low),
                "high": float(high),
                "mean_fitness": {n: float(x.mean()) for n, x in fitness.items()},
                "seconds": round(time.perf_counter() - start, 1),
            }
        )
        print(f"{regime}: {rows[-1]['spearman']:.2f} [{low:.2f}, {high:.2f}]", flush=True)

    print("\n| contexts | reward noise | fitness | Spearman [95 %] |\n| --- | --- | --- | --- |")
    for row in rows:
        print(
            f"| {row['contexts']} | {row['reward_noise']:g} | {row['fitness']} "
            f"| {row['spearman']:.2f} [{row['low']:.2f}, {row['high']:.2f}] |"
        )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    result = {
        "environment": "Pendulum-v1",
        "agents": arguments.agents,
        "first_seed": FIRST_SEED,
        "outcome_iqm": {n: float(iqm(x)) for n, x in outcome.items()},
        "regimes": rows,
        "versions": package_versions(),
        "machine": machine_description(),
    }
    arguments.out.write_text(json.dumps(result, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
