"""The whole path, as `lpo run` does it: learn an objective on a bandit, train PPO with it, judge it, write it down.

Every stage leaves a file in the run folder; a resumed run does what is missing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import tyro
from rich.console import Console

from lpo import drift_figures, figures, report, search_figures
from lpo.certificate import certify
from lpo.commands import MetaTrain
from lpo.comparison import Comparison, compare, ppo_spec
from lpo.full_size import longer
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import (
    MetaTraining,
    environment_problem,
    learn_objective,
)
from lpo.objectives import REFERENCES, Objective, load_objective
from scb import plotting
from scb.command_line import LongRun, Output
from scb.configurations import config_dict
from scb.console import console
from scb.environments.registry import make
from scb.errors import UserError
from scb.evolution import EnvironmentSteps
from scb.files import write_json
from scb.machine import machine_description, package_versions
from scb.rows import Rows
from scb.runs import Run
from scb.seeds import reporting
from scb.stopwatch import Stopwatch


@dataclass(frozen=True)
class Evaluation:
    """Where, and how long, agents are trained with the objectives that are compared."""

    environment: str
    backend: str | None
    seeds: int
    steps: int
    points: int = 15
    episodes: int = 20


@dataclass(frozen=True)
class PipelineConfig:
    """What `lpo run` does.

    Attributes:
      seed: decides everything; the seeds that report are apart from those that learn.
      objective: take this objective (a zoo name or file.npz) instead of learning one.
      search: how the objective is learned.
      evaluations: where objectives are compared.
    """

    seed: int = 0
    objective: str | None = None
    search: tyro.conf.Suppress[MetaTrainingConfig] = field(default_factory=MetaTrainingConfig)
    evaluations: tyro.conf.Suppress[tuple[Evaluation, ...]] = ()

    def __post_init__(self) -> None:
        _ = self.meta_training

    @property
    def meta_training(self) -> MetaTrainingConfig:
        """The search with the seed."""
        return replace(self.search, evolution=replace(self.search.evolution, seed=self.seed))


def _quick(given: Mapping[str, str]) -> PipelineConfig:
    return PipelineConfig(
        search=MetaTrain.presets["quick"]({}),
        evaluations=(
            Evaluation("Pendulum-v1", None, seeds=10, steps=150_000),
            # That Brax works, within minutes: what objectives are worth there takes the full size, whose
            # measurement the report shows.
            Evaluation("hopper", "spring", seeds=4, steps=200_000, points=5, episodes=10),
        ),
    )


def _paper(given: Mapping[str, str]) -> PipelineConfig:
    return PipelineConfig(
        # So long a search overfits the bandit: the mean that was judged best on Pendulum is kept.
        search=MetaTrain.presets["paper"]({"validate": ""}),
        evaluations=(
            Evaluation("Pendulum-v1", None, seeds=20, steps=150_000),
            Evaluation("hopper", "generalized", seeds=10, steps=5 * 2**20),
        ),
    )


def run_pipeline(run: Run, config: PipelineConfig, preset: str, command: str) -> Path:
    """Runs every stage that the folder lacks.

    Args:
      run: the open run folder.
      config: what to do.
      preset: whose it is, for the report.
      command: that repeats the run, for the report.

    Returns:
      The path of report.html.
    """
    console = Console(stderr=True, markup=False)
    watch = Stopwatch()
    folder, search = run.folder, config.meta_training
    meta: dict[str, Any] = {}
    if config.objective is None:
        console.print(
            f"[1/3] learning an objective on {', '.join(search.tasks)}: "
            f"{search.evolution.num_generations} generations of "
            f"{search.evolution.population_size}"
        )
        problem = MetaTraining(search)
        objective = learn_objective(problem, run, command, "lpo.npz")
        meta = _told(problem, run)
    else:
        objective = load_objective(config.objective)
    certificate = certify(objective.drift, objective.parameters)
    objectives = _with_references(objective)

    comparisons: dict[str, Comparison] = {}
    rows = Rows(folder / "rows.jsonl")
    for evaluation in config.evaluations:
        name = evaluation.environment
        console.print(f"[2/3] training PPO with {len(objectives)} objectives on {name}")
        comparisons[name] = compare(
            name,
            objectives,
            reporting_seeds(config.seed, evaluation.seeds),
            ppo_spec(name, evaluation.steps),
            evaluation.backend,
            evaluation.points,
            evaluation.episodes,
            rows=rows,
            tell=console.print,
        )

    console.print("[3/3] figures and report")
    whole = {name: x for name, c in comparisons.items() if (x := longer(c)) is not None}
    paths = _figures(run, search, objectives, comparisons, whole, meta)
    results = {
        "schema_version": 1,
        "preset": preset,
        "command": command,
        "versions": package_versions(),
        "machine": machine_description(),
        "objective": {"name": objective.name, "certificate": certificate.as_dict()},
        "meta_training": meta,
        "comparisons": {name: c.as_dict() for name, c in comparisons.items()},
        "full_size": {name: c.as_dict() for name, c in whole.items()},
    }
    if not run.resumed:  # else it would be the time of the last stages alone
        results["seconds"] = round(watch.lap(), 1)
    write_json(folder / "results.json", results)
    return report.write_report(folder, results, paths)


def reporting_seeds(seed: int, count: int) -> list[int]:
    """The seeds that judge a run of this seed; from 20 000 on they are those of studies that compare objectives."""
    return reporting(count, offset=1000 * (seed % 10))


def _with_references(objective: Objective) -> list[Objective]:
    references = [load_objective(name) for name in REFERENCES]
    if objective.name in REFERENCES:
        raise UserError(
            f"--objective is named {objective.name!r}, as one that every run is compared with anyway: give another, "
            "under another name, or leave it out to learn one."
        )
    return [*references, objective]


def _told(problem: MetaTraining, run: Run) -> dict[str, Any]:
    """What the report says of the meta-training."""
    config = problem.config
    evaluations = config.evolution.num_generations * config.evolution.population_size

    def of_search(steps: EnvironmentSteps) -> dict[str, int]:
        return {
            name: evaluations * getattr(steps, name) for name in ("training", "evaluation", "total")
        }

    return {
        "environment": ", ".join(config.tasks),
        "evaluation_environment": ", ".join(config.homes),
        "fitness": config.fitness,
        "config": config_dict(config),
        "seconds": round(run.seconds(), 1),
        "generations": config.evolution.num_generations,
        "steps": of_search(problem.steps()),
        "environment_steps": of_search(environment_problem(config).steps()),
    }


def _figures(
    run: Run,
    config: MetaTrainingConfig,
    objectives: list[Objective],
    comparisons: Mapping[str, Comparison],
    whole: Mapping[str, Comparison],
    meta: Mapping[str, Any],
) -> dict[str, Path]:
    drawn = {}
    if meta:
        drawn["meta_training"] = search_figures.meta_training_curve(run.metrics(), config)
        drawn["environment_steps"] = search_figures.environment_steps(
            meta["steps"], meta["environment_steps"]
        )
    for name, comparison in comparisons.items():
        drawn[name] = figures.learning_curves(comparison.curves)
    for name, comparison in whole.items():
        drawn[f"{name}_full_size"] = figures.learning_curves(comparison.curves)
    drawn["drift_and_gradient"] = drift_figures.drift_and_gradient(objectives)
    folder = run.folder / "figures"
    return {
        name: plotting.save(figure, folder / f"{name.replace('/', '-')}.png")
        for name, figure in drawn.items()
    }


@dataclass(frozen=True, kw_only=True)
class RunAll(LongRun):
    """The whole path: learn an objective on the Pendulum bandit, train PPO with it, judge it.

    Meta-trains a drift on the shipped bandit, then trains PPO with its own clip, with DPO and with
    the learned drift on Pendulum and on Brax Hopper, on the same seeds, and writes report.html,
    figures and results.json.

    Attributes:
      preset: quick (eight minutes on two cores) or paper (the paper's sizes; hours).
    """

    program = "lpo run"
    presets = MappingProxyType({"quick": _quick, "paper": _paper})

    config: Annotated[PipelineConfig, tyro.conf.arg(name="")] = field(
        default_factory=lambda: _quick({})
    )
    output: Output = field(default_factory=lambda: Output(Path("runs/quick")))

    def inputs(self) -> dict[str, str]:
        return {} if self.config.objective else self.config.meta_training.checksums()

    def run(self) -> None:
        # A mistake must not leave a folder behind.
        if self.config.objective is None:
            for task in self.config.meta_training.tasks:
                make(task)
        else:
            _with_references(load_objective(self.config.objective))
        report = run_pipeline(self.open(), self.config, self.preset, self.command)
        console().print(f"report: {report}", soft_wrap=True)
