"""Learning an objective from flat settings: what `lpo meta-train` does, and experiments that do the same."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lpo import figures
from lpo.certificate import Certificate
from lpo.drifts import LearnedDrift, learned_drift
from lpo.meta_training import VALIDATION_AGENTS, MetaTraining, MetaTrainingConfig, chosen_mean
from lpo.objectives import Objective, load_objective, save_objective
from lpo.pipeline import meta_training_artefact
from scb import plotting
from scb.errors import UserError, unknown_name
from scb.evolution import EvolutionConfig, evolve
from scb.runs import Run, read_config

PRESETS: dict[str, dict[str, Any]] = {
    "quick": {"population_size": 32, "generations": 30},
    "paper": {"population_size": 64, "generations": 512},
}

# A temporally-aware drift meets trainings from a quarter to twice as long as the setting's own.
TEMPORAL_HORIZONS = (0.25, 0.5, 1.0, 2.0)


def learn_objective(
    settings: Mapping[str, Any], folder: Path, resume: bool = False, wandb: str | None = None
) -> tuple[Path, Certificate]:
    """What `lpo meta-train` does: evolves a drift in a run folder, and saves it with its certificate.

    Args:
      settings: the command's flags by name, "command" among them; what is left out keeps its default.
      folder: of the run; new or empty, or with `resume` that of a run with these settings.
      resume: continue after the folder's newest checkpoint.
      wandb: project to log to.
    """
    config = meta_training_config(settings)
    problem = MetaTraining(config)
    run = Run.open(folder, dict(settings), resume=resume, wandb_project=wandb)
    outcome = evolve(problem, config.evolution, run)
    run.close()
    path, certificate = save_objective(
        run.folder / "objective.npz",
        config.drift,
        chosen_mean(config, outcome),
        meta_training_artefact(problem, outcome, settings, command_of("lpo", settings)),
    )
    plotting.save(
        figures.meta_training_curve(
            outcome.metrics,
            ", ".join(config.judged_in),
            config.fitness,
            config.evolution.population_size,
            config.evolution.mean_evaluations,
            ", ".join(config.homes) if config.validation else None,
        ),
        run.folder / "figures" / "meta_training.png",
    )
    return path, certificate


def objective_of_run(settings: Mapping[str, Any], folder: Path) -> Objective:
    """The objective of a run folder with these settings: read, or learned first, or its run resumed."""
    path = folder / "objective.npz"
    if not path.with_suffix(".json").exists():  # it is written last
        learn_objective(settings, folder, resume=(folder / "config.json").exists())
    return load_objective(path)


def meta_training_config(settings: Mapping[str, Any]) -> MetaTrainingConfig:
    """A MetaTrainingConfig from flat settings; what is None keeps its default."""

    def given(**names: str) -> dict[str, Any]:
        return {
            field: settings[name] for field, name in names.items() if settings.get(name) is not None
        }

    default = MetaTrainingConfig()
    if settings.get("environment") and settings.get("tasks"):
        raise UserError(
            f"the environment {settings['environment']} and the tasks {settings['tasks']} are both given: name all "
            "in the tasks."
        )
    tasks = _listed(settings.get("tasks") or settings.get("environment"), "tasks") or default.tasks
    horizons = _numbers(settings.get("horizons"), "horizons")
    if settings.get("temporal") and not horizons:
        horizons = TEMPORAL_HORIZONS
    evolution = EvolutionConfig(
        **{
            "strategy": default.evolution.strategy,
            "sigma": default.evolution.sigma,
            "learning_rate": default.evolution.learning_rate,
            "mean_evaluations": VALIDATION_AGENTS
            if settings.get("validate")
            else default.evolution.mean_evaluations,
            "combine": "mean" if len(tasks) == 1 else "ranks",
            **given(
                strategy="strategy",
                population_size="population_size",
                num_generations="generations",
                sigma="sigma",
                learning_rate="learning_rate",
                combine="combine",
                mean_evaluations="mean_evaluations",
                evaluate_mean_every="evaluate_mean_every",
                seed="seed",
            ),
        }
    )
    drift = learned_drift(
        settings.get("drift") or LearnedDrift.name,
        **given(base="base", temporal="temporal", xi="xi", gate="gate"),
    )
    return MetaTrainingConfig(
        tasks=tasks,
        drift=drift,
        horizons=horizons,
        evolution=evolution,
        hyperparameters=_lists(settings.get("hyperparameters")) or default.hyperparameters,
        **given(
            fitness="fitness",
            reward_noise="reward_noise",
            agents_per_candidate="agents_per_candidate",
            contexts="contexts",
            evaluation_episodes="evaluation_episodes",
            validation="validate",
            backend="backend",
        ),
    )


def _listed(text: str | None, what: str) -> tuple[str, ...]:
    """The names in "a,b"; none for None."""
    names = tuple(name.strip() for name in (text or "").split(",") if name.strip())
    if text is not None and not names:
        raise UserError(f"the list of {what} is empty: give one or more, separated by commas.")
    return names


def _numbers(text: str | None, what: str) -> tuple[float, ...]:
    listed = _listed(text, what)
    try:
        return tuple(float(x) for x in listed)
    except ValueError as error:
        raise UserError(
            f"{what} {text!r} are no numbers: give them separated by commas, such as 0.25,0.5,1."
        ) from error


def _lists(text: str | None) -> dict[str, tuple[float, ...]]:
    """The values in "learning_rate=0.0003,0.001 policy_output_scale=1,0.01" by name."""
    lists = {}
    for part in (text or "").split():
        name, equals, values = part.partition("=")
        if not equals:
            raise UserError(
                f"hyperparameters {text!r} have the part {part!r}, which is no NAME=VALUE,VALUE: write such as "
                "learning_rate=0.0003,0.001."
            )
        lists[name] = _numbers(values, name)
    return lists


def command_of(program: str, settings: Mapping[str, Any]) -> str:
    """The command that starts a run with these settings afresh, however it was typed or resumed."""
    flags = [
        f"--{name.replace('_', '-')}" if value is True else f"--{name.replace('_', '-')}={value}"
        for name, value in settings.items()
        if name != "command" and value is not None and value is not False
    ]
    return shlex.join([program, str(settings["command"]), *flags])


def settle(
    flags: Mapping[str, Any],
    presets: Mapping[str, Mapping[str, Any]],
    preset: str | None,
    resume: Path | None,
) -> dict[str, Any]:
    """The settings of a run: the flags that were given, over the preset, over nothing.

    With `resume`, the stored run's settings; a flag that says otherwise is an error, found by
    `Run.open`.
    """
    given = {name: value for name, value in flags.items() if value is not None}
    if resume is not None:
        stored = read_config(resume)
        if preset is not None:
            given["preset"] = preset
        return {**stored, **given}
    chosen = preset or "quick"
    if chosen not in presets:
        raise unknown_name("preset", chosen, presets)
    return {**flags, "preset": chosen, **presets[chosen], **given}
