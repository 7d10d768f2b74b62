"""What the subcommands of `scb` do. Their docstrings are the command line's help."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnax.environments import environment as environments
from rich.table import Column, Table

from scb.agents.spec import ALGORITHMS, algorithms_for, bandit_agent, tables_of
from scb.artefacts import machine_description
from scb.console import console
from scb.curriculum import CurriculumConfig, paper_curriculum
from scb.discovery import (
    BanditDiscovery,
    DiscoveryConfig,
    SyntheticTraining,
    check_fits,
    judge,
)
from scb.environments.brax import BRAX_NAMES
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig, SyntheticBandit, Weights
from scb.environments.synthetic_mdp import SyntheticMDP
from scb.environments.zoo import (
    PREFIX,
    bandit_metadata,
    load,
    open_bandit,
    save_bandit,
    save_synthetic_mdp,
    zoo_names,
)
from scb.errors import UserError, unknown_name
from scb.evolution import config_dict, evolve
from scb.runs import Run, command_of, settle
from scb.statistics import estimate
from scb.warm_start import WarmStartConfig

PRESETS: dict[str, dict[str, Any]] = {
    # Half an hour on two cores: PPO in every candidate, agents compared by rank.
    "quick": {
        "population_size": 32,
        "generations": 150,
        "agents_per_candidate": 4,
        "evaluation_episodes": 12,
        "combine": "ranks",
        "algorithms": "ppo",
        "mode": "all",
    },
    # Tables "Hyperparameters for meta-training", "Number of generations for each environment" and
    # "Hyperparameters for evaluation length curricula": what they say of an environment is filled
    # in by `_paper_settings`.
    "paper": {"combine": "mean", "init": "random", "curriculum": "paper"},
}
_PAPER_GENERATIONS = {
    "MountainCar-v0": 1000,
    "Pendulum-v1": 1000,
    "reacher": 30,
    "pusher": 100,
    **dict.fromkeys(
        ("hopper", "walker2d", "swimmer", "halfcheetah", "ant", "humanoidstandup"), 2000
    ),
}

# Of 32 bits, which is what an agent calculates with.
_LARGEST = float(np.finfo(np.float32).max)

# Reported on these seeds, which neither evolution nor selection sees.
FIRST_REPORTING_SEED = 10_000
SELECTIONS = ("final", "best")


def _paper_settings(environment: str) -> dict[str, Any]:
    """The paper's outer loop for an environment: columns classic control, Pendulum and Brax of its table."""
    brax = environment in BRAX_NAMES
    pendulum = environment == "Pendulum-v1"
    return {
        "generations": _PAPER_GENERATIONS.get(environment, 300),
        "population_size": 256 if brax else 64 if pendulum else 128,
        "agents_per_candidate": 8 if pendulum else 1,
        "evaluation_episodes": 16 if brax else 50,
        "mode": "sequential" if brax else "all",
    }


def discover_command(
    environment: str | None = None,
    preset: str | None = None,
    seed: int | None = None,
    out: Path = Path("runs/discover"),
    resume: Path | None = None,
    backend: str | None = None,
    parameterization: str | None = None,
    max_steps: int | None = None,
    algorithms: str | None = None,
    mode: str | None = None,
    hyperparameters: Path | None = None,
    fixed_hyperparameters: bool = False,
    init: str | None = None,
    expert: str | None = None,
    expert_steps: int | None = None,
    expert_generations: int | None = None,
    construction: str | None = None,
    min_spread: float | None = None,
    from_bandit: str | None = None,
    reward_std: float | None = None,
    strategy: str | None = None,
    population_size: int | None = None,
    generations: int | None = None,
    agents_per_candidate: int | None = None,
    combine: str | None = None,
    evaluation_episodes: int | None = None,
    mode_actions: bool = False,
    curriculum: str | None = None,
    sigma: float | None = None,
    mean_evaluations: int | None = None,
    evaluate_mean_every: int | None = None,
    activation: str | None = None,
    latent: str | None = None,
    select: str | None = None,
    judge_agents: int = 20,
    judge_episodes: int = 50,
    wandb: str | None = None,
) -> None:
    """Discover a bandit: evolve one so that agents trained in it do well in an environment.

    Args:
      environment: the evaluation environment (Pendulum-v1, CartPole-v1, hopper, ...).
      preset: quick (150 generations of 32, PPO) or paper (the paper's tables for the environment);
        single flags override it.
      seed: decides everything.
      out: folder to write; must be new or empty.
      resume: a run folder to continue; its settings apply, and a flag that contradicts them is an
        error.
      backend: Brax's physics: generalized, positional or spring.
      parameterization: I (the bandit), TI or T (fully synthetic MDPs: learned transition, reward and
        termination, with or without a learned initial state).
      max_steps: a synthetic MDP's maximum episode length; the environment's own where left out.
      algorithms: of the inner loop, separated by commas (ppo,sac,dqn,ddqn,ddpg,td3); in sequential
        mode a name may stand several times. "all" for the paper's for the action space.
      mode: all (every algorithm trains in every candidate) or sequential (one a generation, in turn).
      hyperparameters: a JSON file {"ppo": {"learning_rate": [0.001, 0.005], ...}, ...} to draw from
        instead of the paper's lists.
      fixed_hyperparameters: keep the inner agents' hyperparameters fixed instead of drawing them
        from the paper's lists.
      init: expert (fit the bandit to an expert first, in a minute) or random (as the paper).
      expert: what finds the expert: evolution, ppo, sac, dqn, ddpg, td3, or auto.
      expert_steps: environment steps that each agent trains for to become the expert.
      expert_generations: of the evolution that finds the expert.
      construction: of the expert fit: action_distance, advantage or q.
      min_spread: stretch entries of the expert's states to at least this standard deviation.
      from_bandit: start from this bandit (a zoo name or file.npz) instead.
      reward_std: scale the reward that the search starts from to this standard deviation, and shift
        it to mean zero: of use to SAC, whose temperature starts at 1.
      strategy: any of evosax's, by name (SNES, Open_ES, ...).
      population_size: candidates a generation.
      generations: how many.
      agents_per_candidate: agents of each algorithm whose returns are a candidate's fitness.
      combine: its agents' returns by mean, or by ranks (the mean over agents of a candidate's rank).
      evaluation_episodes: of each agent in the evaluation environment.
      mode_actions: evaluate the most likely actions during the search, rather than sampled ones.
      curriculum: of the evaluation episodes' length: paper, none, or SHAPE:INITIAL:FINAL:BEGIN:TRANSITION
        such as linear:100:1000:20:160 (lengths in steps, then generations).
      sigma: initial standard deviation of the search distribution.
      mean_evaluations: agents of each algorithm that judge the mean of the search distribution.
      evaluate_mean_every: generations between those judgements.
      activation: the bandit's: tanh or relu.
      latent: normal, uniform, categorical or softmax_categorical.
      select: what is saved: final (the mean of the last search distribution) or best (the mean whose
        judgement during the search was best; where the search starts near its end, noise can lead
        it away again).
      judge_agents: agents of each fitting algorithm that judge the result; 0 leaves that out.
      judge_episodes: episodes of each of them.
      wandb: project to log to, with the extra `wandb`.
    """
    if judge_agents < 0:
        raise UserError(f"judge_agents is {judge_agents}: give 0 for no judgement, or more.")
    if judge_episodes < 1:
        raise UserError(f"judge_episodes is {judge_episodes}: give at least 1.")
    flags = {
        "command": "discover",
        "environment": environment,
        "seed": seed,
        "backend": backend,
        "parameterization": parameterization,
        "max_steps": max_steps,
        "algorithms": algorithms,
        "mode": mode,
        "hyperparameters": None if hyperparameters is None else str(hyperparameters),
        "fixed_hyperparameters": fixed_hyperparameters or None,
        "init": init,
        "expert": expert,
        "expert_steps": expert_steps,
        "expert_generations": expert_generations,
        "construction": construction,
        "min_spread": min_spread,
        "from_bandit": from_bandit,
        "reward_std": reward_std,
        "strategy": strategy,
        "population_size": population_size,
        "generations": generations,
        "agents_per_candidate": agents_per_candidate,
        "combine": combine,
        "evaluation_episodes": evaluation_episodes,
        "mode_actions": mode_actions or None,
        "curriculum": curriculum,
        "sigma": sigma,
        "mean_evaluations": mean_evaluations,
        "evaluate_mean_every": evaluate_mean_every,
        "activation": activation,
        "latent": latent,
        "select": select,
    }
    settings = settle(flags, PRESETS, preset, resume)
    if settings.get("preset") == "paper":
        name = settings.get("environment") or DiscoveryConfig.environment
        settings |= {k: v for k, v in _paper_settings(name).items() if settings.get(k) is None}
    chosen = settings.get("select") or "final"
    if chosen not in SELECTIONS:
        raise unknown_name("selection", chosen, SELECTIONS)
    config = discovery_config(settings)
    # The problem first: where a name is wrong, no folder is left behind to be in the next try's way.
    problem = BanditDiscovery(config)
    folder = Run.open(resume or out, settings, resume=resume is not None, wandb_project=wandb)
    outcome = evolve(problem, config.evolution, folder)
    folder.close()
    weights = outcome.best_mean if chosen == "best" else outcome.mean
    results = {}
    if judge_agents:
        results = judge_all(
            problem.bandit,
            weights,
            config.environment,
            problem.env,
            problem.env_params,
            config.sampled_hyperparameters,
            judge_agents,
            judge_episodes,
        )
    steps = problem.steps()
    evaluations = config.evolution.num_generations * config.evolution.population_size
    metadata = {
        "config": {
            "evaluation_environment": config.environment,
            "backend": getattr(problem.env, "backend", None),
            "discovery": config_dict(problem.config),
            "settings": settings,
            "started_from": _origin(settings.get("from_bandit")),
        },
        "seeds": {"discovery": config.evolution.seed, "reporting": FIRST_REPORTING_SEED},
        "results": results,
        "cost": {
            "environment_steps_training": evaluations * steps.training,
            "environment_steps_evaluation": evaluations * steps.evaluation,
            "warm_start": problem.warm_start_report,
            "seconds": round(outcome.seconds, 1),
            **({"generation": outcome.best_mean_generation} if chosen == "best" else {}),
            "machine": machine_description(),
        },
        "command": command_of("scb", settings),
    }
    path = folder.folder / f"{PREFIX}{config.environment}.npz"
    if isinstance(problem.bandit, SyntheticBandit):
        path = save_bandit(path, problem.bandit, weights, metadata)
    else:
        path = save_synthetic_mdp(path, problem.bandit, weights, metadata)
    console().print(f"bandit: {path}", soft_wrap=True)


def judge_all(
    synthetic: SyntheticBandit | SyntheticMDP,
    weights: Weights,
    name: str,
    env: environments.Environment[Any, Any],
    env_params: Any,
    sampled: bool = True,
    num_agents: int = 20,
    num_episodes: int = 50,
    seed: int = FIRST_REPORTING_SEED,
) -> dict[str, Any]:
    """What agents of every fitting algorithm earn, by name of the algorithm in capitals, printed as it comes."""
    space = env.action_space(env_params)
    results = {}
    for algorithm in algorithms_for(space):
        training = SyntheticTraining(
            synthetic, env, env_params, bandit_agent(algorithm, name, sampled)
        )
        returns = judge(training, weights, seed, num_agents, num_episodes)
        lists = training.spec.lists
        results[algorithm.upper()] = {
            "agents": num_agents,
            "episodes": num_episodes,
            "hyperparameters": "sampled from the paper's lists" if lists else "fixed",
            **{actions: estimate(x).as_dict() for actions, x in returns.items()},
        }
        line = "; ".join(
            f"{actions.replace('_', ' ')} IQM {estimate(x)}" for actions, x in returns.items()
        )
        console().print(f"{algorithm.upper()} on {name}: {line}")
    return results


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

    def given(*names: str, **renamed: str) -> dict[str, Any]:
        fields = {name: name for name in names} | renamed
        return {
            field: settings[name]
            for field, name in fields.items()
            if settings.get(name) is not None
        }

    default = DiscoveryConfig()
    evolution = replace(
        default.evolution,
        **given(
            "strategy",
            "population_size",
            "sigma",
            "combine",
            "seed",
            "mean_evaluations",
            "evaluate_mean_every",
            num_generations="generations",
        ),
    )
    environment = settings.get("environment") or default.environment
    more: dict[str, Any] = {}
    if settings.get("algorithms") is not None:
        more["algorithms"] = _names(settings["algorithms"])
    elif settings.get("preset") == "paper":
        more["algorithms"] = ()
    if settings.get("hyperparameters") is not None:
        more["lists"] = read_lists(Path(settings["hyperparameters"]))
    return DiscoveryConfig(
        bandit=BanditConfig(**given("activation", "latent")),
        warm_start=WarmStartConfig(
            **given("expert", "expert_steps", "expert_generations", "construction", "min_spread")
        ),
        evolution=evolution,
        curriculum=parse_curriculum(
            settings.get("curriculum"), environment, evolution.num_generations
        ),
        sampled_hyperparameters=not settings.get("fixed_hyperparameters"),
        **given(
            "environment",
            "backend",
            "parameterization",
            "max_steps",
            "mode",
            "init",
            "agents_per_candidate",
            "evaluation_episodes",
            "mode_actions",
            "reward_std",
            start="from_bandit",
        ),
        **more,
    )


def _names(text: str) -> tuple[str, ...]:
    """The algorithms of "ppo,sac"; none for "all", which stands for the paper's."""
    if text.strip().lower() == "all":
        return ()
    names = tuple(name.strip().lower() for name in text.split(",") if name.strip())
    if not names:
        raise UserError(
            f"the list of algorithms is empty: give one or more of {', '.join(ALGORITHMS)}, or all."
        )
    return names


def parse_curriculum(
    text: str | None, environment: str, num_generations: int
) -> CurriculumConfig | None:
    """A curriculum from the command line: paper, none, or SHAPE:INITIAL:FINAL:BEGIN:TRANSITION."""
    if text is None or text == "none":
        return None
    if text == "paper":
        return paper_curriculum(environment, num_generations)
    shape, *numbers = text.split(":")
    try:
        initial, final, begin, transition = (int(number) for number in numbers)
    except ValueError as error:
        raise UserError(
            f"the curriculum {text!r} is not understood: give paper, none, or "
            "SHAPE:INITIAL:FINAL:BEGIN:TRANSITION such as linear:100:1000:20:160."
        ) from error
    return CurriculumConfig(shape, initial, final, begin, transition)


def read_lists(path: Path) -> dict[str, dict[str, tuple[float, ...]]]:
    """{algorithm: {hyperparameter: values}} from a JSON file; what is wrong with it is a UserError."""
    wanted = 'give {"ppo": {"learning_rate": [0.001, 0.005]}, ...}'
    try:
        content = json.loads(path.read_text(), parse_constant=_no_json)
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}): {wanted}.") from error
    except ValueError as error:
        raise UserError(f"{path} is no JSON ({error}): {wanted}.") from error
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(lists, dict) and lists for lists in content.values())
    ):
        raise UserError(f"{path} holds no hyperparameter lists: {wanted}.")
    for algorithm, lists in content.items():
        tables_of(algorithm)
        for name, values in lists.items():
            if not isinstance(values, list) or not values:
                raise UserError(
                    f"{path}: {algorithm}'s {name} is {values!r}, no list of numbers: {wanted}."
                )
            for value in values:
                number = isinstance(value, int | float) and not isinstance(value, bool)
                if not number or abs(value) > _LARGEST:
                    raise UserError(
                        f"{path}: {algorithm}'s {name} has the value {value!r}, which is no number that an "
                        "agent can take: give finite numbers only."
                    )
    return {a: {n: tuple(v) for n, v in lists.items()} for a, lists in content.items()}


def _no_json(constant: str) -> Any:
    """Raises a ValueError for NaN and infinities, which Python would read."""
    raise ValueError(f"{constant} is no JSON number")


def train(
    bandit: str = "Synthetic-Pendulum-v1",
    algorithm: str = "ppo",
    evaluation_environment: str | None = None,
    backend: str | None = None,
    agents: int = 20,
    episodes: int = 50,
    seed: int = 0,
    fixed_hyperparameters: bool = False,
    sampled_actions: bool = False,
) -> None:
    """Train agents in a bandit and evaluate them in the environment that it stands for.

    Args:
      bandit: a zoo name such as Synthetic-Pendulum-v1, or path.npz (a synthetic MDP's too).
      algorithm: ppo, sac, dqn, ddqn, ddpg or td3.
      evaluation_environment: where to evaluate; the bandit's own where left out.
      backend: Brax's physics: generalized, positional or spring.
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
    loaded: SyntheticBandit | SyntheticMDP = (
        load(bandit) if bandit.endswith(".npz") else open_bandit(bandit)
    )
    target = evaluation_environment or loaded.name.removeprefix(PREFIX)
    env, env_params = make(target, backend)
    check_fits(loaded, env, env_params, target)
    spec = bandit_agent(algorithm, target, not fixed_hyperparameters)
    training = SyntheticTraining(loaded, env, env_params, spec)
    weights = loaded.default_params.weights
    by_actions = judge(training, weights, seed, agents, episodes, mode=not sampled_actions)
    (returns,) = by_actions.values()
    print(f"returns on {target}: {' '.join(f'{r:.0f}' for r in np.sort(returns))}")
    print(f"IQM: {estimate(returns)}")


def list_command() -> None:
    """List the bandits that ship with the library, with what they are worth and what they cost."""
    algorithms = [name.upper() for name in algorithms_for()]
    table = Table(
        # In a narrow terminal names are broken, and numbers are not.
        Column("bandit", overflow="fold"),
        *(Column(name, min_width=8) for name in algorithms),
        Column("minutes", min_width=7),
        title="IQM of 20 agents with drawn hyperparameters (Brax: the paper's fixed ones) in the environment: most "
        "likely actions (sampled)",
    )
    for name in zoo_names():
        metadata = bandit_metadata(name)
        cells = []
        for algorithm in algorithms:
            result = metadata["results"].get(algorithm)
            cells.append("" if result is None else _cell(result))
        minutes = f"{metadata['cost']['seconds'] / 60:.0f}"
        table.add_row(name, *cells, minutes)
    console().print(table)
    for name in zoo_names():
        print(f"{name}: {bandit_metadata(name)['command']}")


def _cell(result: Mapping[str, Any]) -> str:
    mode, sampled = (result[x]["value"] for x in ("mode_actions", "sampled_actions"))
    return f"{mode:.1f} ({sampled:.1f})" if abs(mode - sampled) > 0.05 else f"{mode:.1f}"
