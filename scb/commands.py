"""What the subcommands of `scb` do. Their docstrings are the command line's help."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from scb.agents.hyperparameters import inner_loop_config, inner_loop_lists
from scb.artefacts import machine_description
from scb.discovery import (
    BanditDiscovery,
    BanditTraining,
    DiscoveryConfig,
    check_fits,
    judge,
)
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig
from scb.environments.zoo import PREFIX, bandit_metadata, open_bandit, save_bandit, zoo_names
from scb.errors import UserError
from scb.evolution import config_dict, evolve
from scb.runs import Run, command_of, settle
from scb.statistics import estimate
from scb.warm_start import WarmStartConfig

PRESETS: dict[str, dict[str, Any]] = {
    # Minutes to half an hour on two cores.
    "quick": {
        "population_size": 32,
        "generations": 150,
        "agents_per_candidate": 4,
        "combine": "ranks",
    },
    # Table "Hyperparameters for meta-training", Pendulum's column.
    "paper": {
        "population_size": 64,
        "generations": 1000,
        "agents_per_candidate": 8,
        "combine": "mean",
    },
}

# Reported on these seeds, which neither evolution nor selection sees.
FIRST_REPORTING_SEED = 10_000


def discover_command(
    environment: str | None = None,
    preset: str | None = None,
    seed: int | None = None,
    out: Path = Path("runs/discover"),
    resume: Path | None = None,
    init: str | None = None,
    construction: str | None = None,
    strategy: str | None = None,
    population_size: int | None = None,
    generations: int | None = None,
    agents_per_candidate: int | None = None,
    combine: str | None = None,
    evaluation_episodes: int | None = None,
    sigma: float | None = None,
    activation: str | None = None,
    latent: str | None = None,
    fixed_hyperparameters: bool | None = None,
    from_bandit: str | None = None,
    wandb: str | None = None,
) -> None:
    """Discover a bandit: evolve one so that agents trained in it do well in an environment.

    Args:
      environment: the evaluation environment (Pendulum-v1, CartPole-v1, ...).
      preset: quick (300 generations of 32) or paper (1000 of 64); single flags override it.
      seed: decides everything.
      out: folder to write; must be new or empty.
      resume: a run folder to continue; its settings apply, and a flag that contradicts them is an
        error.
      init: expert (fit the bandit to an expert first, in seconds) or random (as the paper).
      construction: of the expert fit: action_distance, advantage or q.
      strategy: any of evosax's, by name (SNES, Open_ES, ...).
      population_size: candidates a generation.
      generations: how many.
      agents_per_candidate: agents whose mean return is a candidate's fitness.
      combine: its agents' returns by mean, or by ranks (the mean over agents of a candidate's rank).
      evaluation_episodes: of each agent in the evaluation environment.
      sigma: initial standard deviation of the search distribution.
      activation: the bandit's: tanh or relu.
      latent: normal, uniform, categorical or softmax_categorical.
      fixed_hyperparameters: keep the inner agents' hyperparameters fixed instead of drawing them
        from the paper's lists.
      from_bandit: start from this bandit (a zoo name or file.npz) instead.
      wandb: project to log to, with the extra `wandb`.
    """
    flags = {
        "command": "discover",
        "environment": environment,
        "seed": seed,
        "init": init,
        "construction": construction,
        "strategy": strategy,
        "population_size": population_size,
        "generations": generations,
        "agents_per_candidate": agents_per_candidate,
        "combine": combine,
        "evaluation_episodes": evaluation_episodes,
        "sigma": sigma,
        "activation": activation,
        "latent": latent,
        "fixed_hyperparameters": fixed_hyperparameters,
        "from_bandit": from_bandit,
    }
    settings = settle(flags, PRESETS, preset, resume)
    config = discovery_config(settings)
    # The problem first: where a name is wrong, no folder is left behind to be in the next try's way.
    problem = BanditDiscovery(config)
    folder = Run.open(resume or out, settings, resume=resume is not None, wandb_project=wandb)
    outcome = evolve(problem, config.evolution, folder)
    folder.close()
    console = Console()
    results = {}
    for mode in (False, True):
        returns = judge(problem.training, outcome.mean, FIRST_REPORTING_SEED, mode=mode)
        results["mode_actions" if mode else "sampled_actions"] = estimate(returns).as_dict()
        actions = "the most likely" if mode else "sampled"
        console.print(
            f"PPO, sampled hyperparameters, {actions} actions, on {config.environment}: IQM {estimate(returns)}"
        )
    steps = problem.steps()
    evaluations = config.evolution.num_generations * config.evolution.population_size
    path = save_bandit(
        folder.folder / f"{PREFIX}{config.environment}.npz",
        problem.bandit,
        outcome.mean,
        {
            "config": {
                "evaluation_environment": config.environment,
                "discovery": config_dict(config),
                "settings": settings,
                "started_from": _origin(settings.get("from_bandit")),
            },
            "seeds": {"discovery": config.evolution.seed, "reporting": FIRST_REPORTING_SEED},
            "results": {
                "PPO": {
                    "agents": 20,
                    "episodes": 50,
                    "hyperparameters": "sampled from the paper's lists"
                    if config.sampled_hyperparameters
                    else "fixed",
                    **results,
                },
            },
            "cost": {
                "environment_steps_training": evaluations * steps.training,
                "environment_steps_evaluation": evaluations * steps.evaluation,
                "warm_start": problem.warm_start_report,
                "seconds": round(outcome.seconds, 1),
                "machine": machine_description(),
            },
            "command": command_of("scb", settings),
        },
    )
    console.print(f"bandit: {path}")


def _origin(bandit: str | None) -> dict[str, Any] | None:
    if bandit is None:
        return None
    metadata = bandit_metadata(bandit)
    return {
        "command": metadata["command"],
        "sha256": metadata["sha256"],
        "cost": metadata["cost"],
        "started_from": metadata["config"].get("started_from"),
    }


def discovery_config(settings: Mapping[str, Any]) -> DiscoveryConfig:
    """A DiscoveryConfig from flat settings; what is None keeps its default."""

    def given(**names: str) -> dict[str, Any]:
        return {
            field: settings[name] for field, name in names.items() if settings.get(name) is not None
        }

    default = DiscoveryConfig()
    evolution = replace(
        default.evolution,
        **given(
            strategy="strategy",
            population_size="population_size",
            num_generations="generations",
            sigma="sigma",
            combine="combine",
            seed="seed",
        ),
    )
    config = DiscoveryConfig(
        bandit=BanditConfig(**given(activation="activation", latent="latent")),
        warm_start=WarmStartConfig(**given(construction="construction")),
        evolution=evolution,
        sampled_hyperparameters=not settings.get("fixed_hyperparameters"),
        **given(
            environment="environment",
            init="init",
            agents_per_candidate="agents_per_candidate",
            evaluation_episodes="evaluation_episodes",
            start="from_bandit",
        ),
    )
    return config


def train(
    bandit: str = "Synthetic-Pendulum-v1",
    evaluation_environment: str | None = None,
    agents: int = 20,
    episodes: int = 50,
    seed: int = 0,
    fixed_hyperparameters: bool = False,
    sampled_actions: bool = False,
) -> None:
    """Train PPO agents in a bandit and evaluate them in the environment that it stands for.

    Args:
      bandit: a zoo name such as Synthetic-Pendulum-v1, or path.npz.
      evaluation_environment: where to evaluate; the bandit's own where left out.
      agents: how many to train, with the paper's 10 000 steps each.
      episodes: of each agent's evaluation.
      seed: decides everything.
      fixed_hyperparameters: the paper's underlined values instead of draws from its lists.
      sampled_actions: evaluate sampled actions rather than the most likely ones.
    """
    for name, value in (("agents", agents), ("episodes", episodes)):
        if value < 1:
            raise UserError(f"{name} is {value}: give at least 1.")
    if seed < 0:
        raise UserError(f"seed is {seed}: it must be 0 or larger.")
    loaded = open_bandit(bandit)
    target = evaluation_environment or loaded.name.removeprefix(PREFIX)
    env, env_params = make(target)
    check_fits(loaded, env, env_params, target)
    lists = None if fixed_hyperparameters else inner_loop_lists(loaded.action_space())
    training = BanditTraining(loaded, env, env_params, inner_loop_config(target), lists)
    returns = judge(
        training, loaded.default_params.weights, seed, agents, episodes, mode=not sampled_actions
    )
    print(f"returns on {target}: {' '.join(f'{r:.0f}' for r in np.sort(returns))}")
    print(f"IQM: {estimate(returns)}")


def list_command() -> None:
    """List the bandits that ship with the library, with what they are worth."""
    table = Table("bandit", "PPO in its environment: IQM [95 %]", "found with")
    for name in zoo_names():
        metadata = bandit_metadata(name)
        result = metadata["results"]["PPO"]["sampled_actions"]
        interval = f"{result['value']:.1f} [{result['low']:.1f}, {result['high']:.1f}]"
        table.add_row(name, interval, metadata["command"])
    Console().print(table)
