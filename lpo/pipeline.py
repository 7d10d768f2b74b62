"""The whole path, as `lpo run` does it: learn an objective on a bandit, train PPO with it, judge it, write it down.

Every stage leaves a file in the run folder; a resumed run does what is missing.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from lpo import drift_figures, figures, report
from lpo.certificate import certify
from lpo.comparison import Comparison, check_names, compare
from lpo.meta_training import VALIDATION_AGENTS, MetaTraining, MetaTrainingConfig, chosen_mean
from lpo.objectives import Objective, load_objective, save_objective
from scb import plotting
from scb.agents.spec import environment_agent
from scb.artefacts import machine_description, package_versions
from scb.environments.registry import environment_spec, make
from scb.environments.zoo import bandit_metadata
from scb.evolution import EvolutionConfig, Outcome, evolve
from scb.measurement import Rows
from scb.runs import Run, Stopwatch, write_json
from scb.seeds import VALIDATING, reporting
from scb.statistics import estimate

PRESETS: dict[str, dict[str, Any]] = {
    "tiny": {
        "population_size": 4,
        "generations": 2,
        "agents_per_candidate": 1,
        "evaluations": [
            {"environment": "Pendulum-v1", "backend": None, "seeds": 2, "steps": 10_000},
        ],
    },
    "quick": {
        "population_size": 32,
        "generations": 30,
        "agents_per_candidate": 4,
        "evaluations": [
            {"environment": "Pendulum-v1", "backend": None, "seeds": 10, "steps": 150_000},
            # Ten episodes of up to 1000 steps at ten points: more would take as long as the training.
            {
                "environment": "hopper",
                "backend": "spring",
                "seeds": 4,
                "steps": 500_000,
                "points": 10,
                "episodes": 10,
            },
        ],
    },
    "paper": {
        "population_size": 64,
        "generations": 512,
        "agents_per_candidate": 4,
        # So long a search overfits the bandit: the mean that was judged best on Pendulum is kept.
        "validate": True,
        "evaluations": [
            {"environment": "Pendulum-v1", "backend": None, "seeds": 20, "steps": 150_000},
            {
                "environment": "hopper",
                "backend": "generalized",
                "seeds": 10,
                "steps": 5 * 2**20,
            },
        ],
    },
}


def run_pipeline(run: Run, settings: Mapping[str, Any], command: str) -> Path:
    """Runs every stage that the folder lacks.

    Args:
      run: the open run folder.
      settings: a preset's values, "seed", "preset" and "objective".
      command: as it was typed, for the report.

    Returns:
      The path of report.html.
    """
    console = Console(stderr=True)
    watch = Stopwatch()
    folder = run.folder
    config = pipeline_config(settings)
    meta: dict[str, Any] = {}
    if settings["objective"] is None:
        console.print(
            f"[1/3] learning an objective on {', '.join(config.tasks)}: "
            f"{config.evolution.num_generations} generations of "
            f"{config.evolution.population_size}"
        )
        objective, meta = _learn(run, config, settings, command)
    else:
        objective = load_objective(settings["objective"])
    certificate = certify(objective.drift, objective.parameters)
    objectives = _with_references(objective)

    comparisons: dict[str, Comparison] = {}
    rows = Rows(folder / "rows.jsonl")
    for evaluation in settings["evaluations"]:
        console.print(
            f"[2/3] training PPO with {len(objectives)} objectives on {evaluation['environment']}"
        )
        name = evaluation["environment"]
        comparisons[name] = compare(
            name,
            objectives,
            reporting_seeds(settings["seed"], evaluation["seeds"]),
            environment_agent("ppo", name).with_steps(evaluation["steps"]),
            evaluation["backend"],
            evaluation.get("points", 15),
            evaluation.get("episodes", 20),
            rows=rows,
            tell=console.print,
        )

    console.print("[3/3] figures and report")
    paths = _figures(folder, config, objectives, comparisons, meta)
    results = {
        "schema_version": 1,
        "preset": settings["preset"],
        "command": command,
        "versions": package_versions(),
        "machine": machine_description(),
        "objective": {"name": objective.name, "certificate": certificate.as_dict()},
        "meta_training": {k: v for k, v in meta.items() if k != "metrics"},
        "comparisons": {name: c.as_dict() for name, c in comparisons.items()},
    }
    if not run.resumed:  # else it would be the time of the last stages alone
        results["seconds"] = round(watch.lap(), 1)
    write_json(folder / "results.json", results)
    return report.write_report(folder, results, paths)


def check_settings(settings: Mapping[str, Any]) -> None:
    """Raises the UserError that `run_pipeline` would, without doing anything.

    Args:
      settings: as for `run_pipeline`.
    """
    config = pipeline_config(settings)
    if settings["objective"] is None:
        for name in config.tasks:
            make(name)
    else:
        _with_references(load_objective(settings["objective"]))


def reporting_seeds(seed: int, count: int) -> list[int]:
    """The seeds that judge a run of this seed."""
    return reporting(count, offset=1000 * (seed % 20))


def _with_references(objective: Objective) -> list[Objective]:
    objectives = [load_objective("ppo"), load_objective("dpo"), objective]
    check_names(objectives)
    return objectives


def pipeline_config(settings: Mapping[str, Any]) -> MetaTrainingConfig:
    """The meta-training of a preset."""
    default = MetaTrainingConfig()
    evolution = replace(
        default.evolution,
        population_size=settings["population_size"],
        num_generations=settings["generations"],
        seed=settings["seed"],
    )
    validate = bool(settings.get("validate"))
    if validate:
        evolution = replace(evolution, mean_evaluations=VALIDATION_AGENTS)
    return replace(
        default,
        evolution=evolution,
        agents_per_candidate=settings["agents_per_candidate"],
        validation=validate,
    )


def _learn(
    run: Run, config: MetaTrainingConfig, settings: Mapping[str, Any], command: str
) -> tuple[Objective, dict[str, Any]]:
    problem = MetaTraining(config)
    path = run.folder / "lpo.npz"
    if not path.with_suffix(".json").exists():  # it is written last
        outcome = evolve(problem, config.evolution, run)
        run.close()
        save_objective(
            path,
            config.drift,
            chosen_mean(config, outcome),
            meta_training_artefact(problem, outcome, dict(settings), command),
        )
    evaluations = config.evolution.num_generations * config.evolution.population_size
    steps = problem.steps()
    on_environment = environment_problem(config).steps()
    meta = {
        "environment": ", ".join(config.tasks),
        "evaluation_environment": ", ".join(config.homes),
        "fitness": config.fitness,
        "config": _plain(config),
        "seconds": round(run.seconds(), 1),
        "generations": config.evolution.num_generations,
        "steps": {
            name: evaluations * getattr(steps, name) for name in ("training", "evaluation", "total")
        },
        "environment_steps": {
            name: evaluations * getattr(on_environment, name)
            for name in ("training", "evaluation", "total")
        },
        "metrics": run.metrics(),
    }
    return load_objective(path), meta


def environment_problem(config: MetaTrainingConfig) -> MetaTraining:
    """The same meta-training on the bandits' evaluation environments themselves."""
    return MetaTraining(replace(config, tasks=config.homes, fitness="return", agent=None))


def meta_training_artefact(
    problem: MetaTraining, outcome: Outcome, settings: Mapping[str, Any], command: str
) -> dict[str, Any]:
    """What a learned objective's .json says of its meta-training."""
    evolution: EvolutionConfig = problem.config.evolution
    judged = [
        {"generation": line["generation"], "fitness": value}
        for line in outcome.metrics
        for key, value in line.items()
        if key in ("mean/fitness", "final_mean/fitness")
    ]
    end = outcome.validate(chosen_mean(problem.config, outcome))["fitness"]
    config = {"meta_training": _plain(problem.config), "settings": dict(settings)}
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


def _plain(config: Any) -> Any:
    return json.loads(json.dumps(asdict(config)))


def _figures(
    folder: Path,
    config: MetaTrainingConfig,
    objectives: list[Objective],
    comparisons: Mapping[str, Comparison],
    meta: Mapping[str, Any],
) -> dict[str, Path]:
    drawn = {}
    if meta:
        drawn["meta_training"] = figures.meta_training_curve(
            meta["metrics"],
            ", ".join(config.judged_in),
            config.fitness,
            config.evolution.population_size,
            config.evolution.mean_evaluations,
            ", ".join(config.homes) if config.validation else None,
        )
        drawn["environment_steps"] = figures.environment_steps(
            meta["steps"], meta["environment_steps"]
        )
    for name, comparison in comparisons.items():
        drawn[name] = figures.learning_curves(comparison.curves)
    drawn["drift_heatmaps"] = drift_figures.drift_heatmaps(objectives)
    paths = {}
    for name, figure in drawn.items():
        paths[name] = folder / "figures" / f"{name.replace('/', '-')}.png"
        paths[name].parent.mkdir(exist_ok=True)
        plotting.save(figure, paths[name])
    return paths
