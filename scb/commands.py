"""What the subcommands of `scb` do. Their docstrings are the command line's help."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
import tyro

from scb import experts, processes
from scb.agents.spec import bandit_agent
from scb.command_line import LongRun, Measuring, SharedOutput, flags
from scb.console import console
from scb.curriculum import paper_generations
from scb.discovery import BanditDiscovery, DiscoveryConfig
from scb.environments.registry import environment_spec
from scb.environments.zoo import load_synthetic, save_bandit
from scb.errors import agents_at_least, at_least
from scb.evolution import EvolutionConfig
from scb.judgement import (
    BRAX_EPISODES,
    EPISODES,
    counted,
    evaluation_place,
    judge,
    judge_all,
    told,
)
from scb.measurement import check_seeds
from scb.statistics import estimate


def _quick(given: Mapping[str, str]) -> DiscoveryConfig:
    """Half an hour on two cores: PPO in every candidate, agents compared by rank."""
    return DiscoveryConfig(
        environment=given.get("environment") or DiscoveryConfig.environment,
        evaluation_episodes=12,
        evolution=EvolutionConfig(population_size=32, num_generations=150, combine="ranks"),
    )


# Table "Hyperparameters for meta-training": population size, rollouts, evaluation seeds, mode, in the
# columns Pendulum, Brax and classic control.
_PAPER_OUTER_LOOP = {"Pendulum-v1": (64, 8, 50, "all"), "brax": (256, 1, 16, "sequential")}
_PAPER_OUTER_LOOP_ELSEWHERE = (128, 1, 50, "all")


def _paper(given: Mapping[str, str]) -> DiscoveryConfig:
    """The paper's tables, curricula among them, for an environment."""
    name = given.get("environment") or DiscoveryConfig.environment
    family = environment_spec(name).family
    column = _PAPER_OUTER_LOOP.get(name) or _PAPER_OUTER_LOOP.get(family)
    population, rollouts, seeds, mode = column or _PAPER_OUTER_LOOP_ELSEWHERE
    return DiscoveryConfig(
        environment=name,
        algorithms=(),
        mode=mode,
        agents_per_candidate=rollouts,
        evaluation_episodes=seeds,
        curriculum="paper",
        init="random",
        evolution=EvolutionConfig(
            population_size=population,
            num_generations=paper_generations(name),
            combine="mean",
        ),
    )


@dataclass(frozen=True)
class Judgement:
    """What agents trained in the bandit that was found are worth in the evaluation environment.

    Attributes:
      judge_agents: agents of each fitting algorithm that judge the result; 0 leaves that out.
      judge_episodes: episodes of each of them; None takes 50, and of Brax, whose physics are slow, 5.
    """

    judge_agents: int = 20
    judge_episodes: int | None = None

    def __post_init__(self) -> None:
        agents_at_least(0, self, "judge_agents")
        at_least(1, self, "judge_episodes")

    def episodes_in(self, environment: str) -> int:
        """Episodes of each agent in an environment, by name."""
        slow = environment_spec(environment).backends
        return self.judge_episodes or (BRAX_EPISODES if slow else EPISODES)


@dataclass(frozen=True, kw_only=True)
class Discover(LongRun):
    """Discover a bandit: evolve one so that agents trained in it do well in an environment.

    A resumed search may have more --generations, or fewer than were asked for, to end early; but not with
    --curriculum paper, which is stretched to them.

    Attributes:
      preset: quick (150 generations of 32, PPO) or paper (the paper's tables for the environment);
        single flags override it.
    """

    program = "scb discover"
    presets = MappingProxyType({"quick": _quick, "paper": _paper})
    deciding = ("environment",)
    together = True

    config: Annotated[DiscoveryConfig, tyro.conf.arg(name="")] = field(
        default_factory=lambda: _quick({})
    )
    judgement: Judgement = field(default_factory=Judgement)
    output: SharedOutput = field(default_factory=lambda: SharedOutput(Path("runs/discover")))

    @classmethod
    def decided(cls, config: DiscoveryConfig) -> dict[str, str]:
        return {"environment": config.environment}

    def growing(self) -> Collection[str]:
        return self.config.growing

    def inputs(self) -> dict[str, str]:
        return self.config.checksums()

    def further(self) -> Iterator[str]:
        yield from super().further()
        yield from flags(self.judgement, Judgement())

    def run(self) -> None:
        # The problem first: where a name is wrong, no folder is left behind to be in the next try's way.
        problem = BanditDiscovery(self.config)
        config, folder = problem.config, self.open()
        outcome = problem.search(folder)
        folder.end_log()
        weights, metadata = problem.selected(outcome), problem.described(outcome, self.command)
        path = folder.folder / f"{environment_spec(config.environment).bandit}.npz"
        # Before it is judged, which may take longer than the search.
        if processes.first():
            save_bandit(path, problem.bandit, weights, metadata)
        if self.judgement.judge_agents:
            if config.lists or config.configs:
                console().print(
                    "judged by agents with the paper's hyperparameters and steps: what yours earn is the search's mean",
                    soft_wrap=True,
                )
            metadata["results"] = judge_all(
                problem.bandit,
                weights,
                problem.place,
                not config.fixed_hyperparameters,
                self.judgement.judge_agents,
                self.judgement.episodes_in(config.environment),
            )
            compared = scale(config.environment, config.backend, problem.start_reports)
            console().print(compared, soft_wrap=True)
        if processes.first():
            if metadata["results"]:
                save_bandit(path, problem.bandit, weights, metadata)
            console().print(f"bandit: {path}", soft_wrap=True)


def scale(environment: str, backend: str | None, start: Mapping[str, Mapping[str, float]]) -> str:
    """What returns of an environment are to be compared with, in a sentence.

    Args:
      start: how what the search started from came about, by what it was.
    """
    spec = environment_spec(environment)
    known = {"random actions": spec.random_return(backend)}
    if "warm_start" in start:
        who = f"the expert that the bandit was fitted to, in {experts.EPISODES} episodes"
        known[who] = start["warm_start"]["expert_return"]
    if (reference := spec.reference(backend)) is not None:
        known[reference.source] = reference.value
    if (standing := spec.standing_still(backend)) is not None:
        known["standing still"] = standing
    values = "; ".join(f"{who}: {value:.4g}" for who, value in known.items())
    return f"to compare with, on {environment}: {values}"


@dataclass(frozen=True)
class TrainConfig:
    """What `scb train` does.

    Attributes:
      bandit: a zoo name such as Synthetic-Pendulum-v1, or path.npz (a synthetic MDP's too).
      algorithm: such as ppo, sac, dqn, ddqn, ddpg or td3; dqn draws whether it is double, and is with fixed
        hyperparameters.
      evaluation_environment: where to evaluate; the bandit's own where left out.
      backend: Brax's physics: generalized, positional, spring or mjx; those that the bandit was found with where left
        out.
      agents: how many to train, with the paper's 10 000 steps each.
      episodes: of each agent's evaluation.
      seed: decides everything.
      fixed_hyperparameters: the paper's underlined values instead of draws from its lists.
      sampled_actions: evaluate sampled actions rather than the most likely ones.
    """

    bandit: str = "Synthetic-Pendulum-v1"
    algorithm: str = "ppo"
    evaluation_environment: str | None = None
    backend: str | None = None
    agents: int = 20
    episodes: int = EPISODES
    seed: int = 0
    fixed_hyperparameters: bool = False
    sampled_actions: bool = False

    def __post_init__(self) -> None:
        agents_at_least(1, self, "agents")
        at_least(1, self, "episodes")
        at_least(0, self, "seed")


@dataclass(frozen=True, kw_only=True)
class Train(Measuring):
    """Train agents in a bandit and evaluate them in the environment that it stands for.

    With --out every agent's return and hyperparameters are kept in rows.jsonl, for --resume and for
    other statistics: pandas.read_json("rows.jsonl", lines=True).
    """

    program = "scb train"
    presets = MappingProxyType({"quick": lambda given: TrainConfig()})

    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def run(self) -> None:
        config: TrainConfig = self.config
        bandit = load_synthetic(config.bandit)
        judge_in = evaluation_place(
            bandit, config.bandit, config.evaluation_environment, config.backend
        )
        spec = bandit_agent(config.algorithm, judge_in.name, not config.fixed_hyperparameters)
        check_seeds([config.seed])
        _, rows = self.opened()  # last: a mistake must not leave a folder behind
        by_actions = judge(
            spec,
            bandit,
            bandit.default_params.weights,
            judge_in,
            config.seed,
            config.agents,
            config.episodes,
            mode=not config.sampled_actions,
            rows=rows,
        )
        by_actions, failed = counted(by_actions, judge_in)
        (returns,) = by_actions.values()
        print(f"returns on {judge_in}: {' '.join(f'{r:.4g}' for r in np.sort(returns))}")
        print(f"IQM: {estimate(returns)}{told(failed)}")
