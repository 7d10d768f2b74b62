"""What a discovery is asked for: the evaluation environment, the inner loop, where the search starts, the evolution."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

import tyro

from scb.agents.spec import ALGORITHMS
from scb.agents.tables import Lists, Values
from scb.command_line import GENERATIONS, listed, text
from scb.curriculum import CurriculumConfig, paper_curriculum, read_curriculum
from scb.environments.synthetic import BanditConfig
from scb.environments.synthetic_mdp import PARAMETERIZATIONS
from scb.environments.zoo import digests
from scb.errors import UserError, agents_at_least, at_least, of_classes, one_of, positive, unused
from scb.evolution import EvolutionConfig
from scb.fitting import check_linear
from scb.lists import read_configs, read_lists, write_lists
from scb.refinement import RefinementConfig
from scb.strategies import check_memory
from scb.warm_start import WarmStartConfig

INITS = ("random", "expert")
MODES = ("all", "sequential")
SELECTIONS = ("final", "best")
_OF_CONTEXTS = (
    "stretch",
    "jitter",
)  # of a warm start's settings, what a linear bandit's contexts take too


def _read_algorithms(words: str) -> tuple[str, ...]:
    if words.strip().lower() == "all":
        return ()
    return listed(words.lower(), f"algorithms, of {', '.join(ALGORITHMS)} or all,")


_Algorithms = text(_read_algorithms, lambda names: ",".join(names) or "all", "NAME,NAME")
_Curriculum = text(read_curriculum, lambda curriculum: str(curriculum or "none"), "CURRICULUM")


@dataclass(frozen=True)
class DiscoveryConfig:
    """What to discover, and how.

    Attributes:
      environment: the evaluation environment (Pendulum-v1, CartPole-v1, hopper, ..., or one's own as
        package.module:factory, which returns a gymnax environment).
      backend: Brax's physics: generalized, positional, spring or mjx.
      parameterization: I (the bandit), TI or T (fully synthetic MDPs: learned transition, reward and
        termination, with or without a learned initial state).
      max_steps: a synthetic MDP's maximum episode length; the environment's own where None.
      algorithms: of the inner loop, separated by commas (ppo,sac,dqn,ddqn,ddpg,td3); in the mode
        sequential a name may stand several times, and its algorithm then has that many turns. "all",
        which is the empty tuple, for the paper's for the action space.
      mode: all (every algorithm trains in every candidate) or sequential (one a generation, in turn).
      fixed_hyperparameters: train with the paper's underlined values instead of drawing each agent's
        from the paper's lists.
      lists: {"ppo": {"learning_rate": [0.001, 0.005], ...}, ...}, a JSON file or the text itself, to draw from instead
        of all the paper's lists of that algorithm: what has none here is at its default.
      configs: {"ppo": {"num_envs": 1, "num_steps": 2048, ...}, ...}, a JSON file or the text itself, over
        the inner loop's static configurations: batches, steps, networks.
      agents_per_candidate: agents of each trained algorithm whose returns are a candidate's fitness.
      evaluation_episodes: of each agent in the evaluation environment.
      mode_actions: evaluate the most likely actions during the search, rather than sampled ones.
      optimal_policy_episodes: of a candidate's own optimal policy in the evaluation environment, whose mean return
        counts as much as an agent's. It costs no training, and stands for agents that learn the bandit well
        but are not trained in the search. 0 leaves it out. Cheap of linear bandits and discrete actions; of
        networks with continuous ones every step climbs the reward.
      optimal_policy_errors: the scale of errors on its continuous actions in these episodes, as a share of half their
        range: a function of the observation, another one in each episode, as an agent errs. Without them
        a policy is found that earns more and bears less than its agents need.
      curriculum: of the evaluation episodes' length: paper, none, or
        SHAPE:INITIAL:FINAL:BEGIN:TRANSITION such as linear:100:1000:20:160 (lengths in steps, then
        generations).
      init: expert (fit the bandit to an expert first, in a minute) or random (as the paper).
      start: start from this bandit (a zoo name or file.npz) instead, whatever the initialisation. A linear one's
        contexts are stretched and jittered where these are given.
      reward_std: scale the reward that the search starts from to this standard deviation, over
        contexts and uniform actions, and shift it to mean zero. PPO, which normalises advantages, is
        nearly indifferent; SAC, whose temperature starts at 1 and whose critics start near 0, is not.
      select: what a search ends with: final (the mean of the last search distribution) or best (the
        mean whose judgement during the search was best, and of whose agents no more than a quarter diverged; where
        the search starts near its end, noise can lead it away again).
      bandit: the networks and the latent.
      warm_start: how the expert is found and the bandit fitted to it.
      refinement: of the bandit that the search starts from.
      evolution: of the candidates; without generations the fit, or what was refined, is the result.
    """

    environment: str = "Pendulum-v1"
    backend: str | None = None
    parameterization: str = "I"
    max_steps: int | None = None
    algorithms: Annotated[tuple[str, ...], _Algorithms] = ("ppo",)
    mode: str = "all"
    fixed_hyperparameters: bool = False
    lists: Annotated[
        Mapping[str, Lists],
        tyro.conf.arg(name="hyperparameters"),
        text(read_lists, write_lists, "FILE|JSON"),
    ] = field(default_factory=dict)
    configs: Annotated[Mapping[str, Values], text(read_configs, write_lists, "FILE|JSON")] = field(
        default_factory=dict
    )
    agents_per_candidate: int = 4
    evaluation_episodes: int = 16
    mode_actions: bool = False
    optimal_policy_episodes: int = 0
    optimal_policy_errors: float = 0.0
    curriculum: Annotated[CurriculumConfig | str | None, _Curriculum] = None
    init: str = "expert"
    start: Annotated[str | None, tyro.conf.arg(name="from-bandit")] = None
    reward_std: float | None = None
    select: str = "final"
    bandit: BanditConfig = field(default_factory=BanditConfig)
    warm_start: Annotated[WarmStartConfig, tyro.conf.arg(name="warm start")] = field(
        default_factory=WarmStartConfig
    )
    refinement: Annotated[RefinementConfig, tyro.conf.arg(name="refinement")] = field(
        default_factory=RefinementConfig
    )
    evolution: Annotated[EvolutionConfig, tyro.conf.arg(name="outer loop")] = field(
        default_factory=lambda: EvolutionConfig(combine="ranks")
    )

    @property
    def growing(self) -> tuple[str, ...]:
        """Settings of which a resumed search may have more (`Run.open`): none where a curriculum stretches to them."""
        stretched = self.curriculum == "paper" and paper_curriculum(self.environment) is not None
        return () if stretched else GENERATIONS

    def checksums(self) -> dict[str, str]:
        """{name: SHA-256} of what a name does not tell: a bandit that it starts from, an environment of one's own."""
        return digests(filter(None, [self.environment, self.start]))

    @property
    def fitted(self) -> bool:
        """Whether it starts from a fit to an expert."""
        return self.init == "expert" and self.start is None

    @property
    def widened(self) -> bool:
        """Whether it starts from a linear bandit whose contexts are stretched or jittered."""
        given = self.warm_start.stretch != 1 or self.warm_start.jitter > 0
        return self.start is not None and self.bandit.form == "linear" and given

    def __post_init__(self) -> None:
        start: Any = self.start
        if isinstance(start, Path):
            object.__setattr__(self, "start", str(start))
        algorithms: Any = self.algorithms
        if isinstance(algorithms, str):
            raise UserError(f"the algorithms are {algorithms!r}, a text: give a tuple of names.")
        for name in ("lists", "configs"):
            given: Any = getattr(self, name)
            if not isinstance(given, Mapping) or not all(
                isinstance(of_it, Mapping) for of_it in given.values()
            ):
                raise UserError(
                    f"{name} is {given!r}: give a dict of dicts, by algorithm and name."
                )
        if isinstance(self.curriculum, str):
            object.__setattr__(self, "curriculum", read_curriculum(self.curriculum))
        of_classes(
            self,
            curriculum=CurriculumConfig | str | None,
            bandit=BanditConfig,
            warm_start=WarmStartConfig,
            refinement=RefinementConfig,
            evolution=EvolutionConfig,
        )
        one_of("initialisation", self.init, INITS)
        one_of("mode", self.mode, MODES)
        one_of("selection", self.select, SELECTIONS)
        one_of("parameterization", self.parameterization, PARAMETERIZATIONS)
        if self.parameterization != "I" and self.fitted:
            raise UserError(
                f"a synthetic MDP ({self.parameterization}) cannot be fitted to an expert, as is the "
                "default: use init random."
            )
        if self.parameterization != "I" and self.start is not None:
            raise UserError("a synthetic MDP cannot start from a bandit: leave the start out.")
        if self.parameterization == "T":
            unused(
                self.bandit,
                "a synthetic MDP T starts where its environment does",
                ("latent", "latent_size"),
                "take TI or I",
            )
        if not self.fitted:
            of_contexts = _OF_CONTEXTS if self.start and self.bandit.form == "linear" else ()
            unused(
                self.warm_start,
                "nothing is fitted to an expert",
                [x.name for x in fields(self.warm_start) if x.name not in of_contexts],
                "choose init expert and no bandit to start from",
            )
        if self.bandit.form == "linear":
            because, networks = "the form linear has no networks", "take the form networks"
            unused(self.bandit, because, ("hidden_size", "activation"), networks)
            if self.fitted:
                check_linear(self.warm_start.construction)
                unused(
                    self.warm_start,
                    "the form linear is fitted in closed form, to the expert's actions alone",
                    ("fit_steps", "num_actions"),
                    networks,
                )
        if self.refinement.rounds and self.bandit.form != "linear":
            raise UserError(
                f"there are {self.refinement.rounds} refinement rounds, and only a linear bandit's policy is refined: "
                "choose the form linear, or leave them out."
            )
        if self.lists and self.fixed_hyperparameters:
            raise UserError(
                "fixed hyperparameters are not drawn from lists: leave out the lists, or draw."
            )
        if self.mode == "sequential":
            because = "which is another algorithm's in the mode sequential"
            check_memory(self.evolution.strategy, because, "use the mode all")
        before = self.fitted or self.widened or self.refinement.rounds
        if not self.evolution.num_generations and not before:
            raise UserError(
                "there are 0 generations, and nothing is found before them: choose init expert or refinement rounds, "
                "or at least 1."
            )
        positive(self, "reward_std")
        if self.reward_std is not None and self.parameterization != "I":
            raise UserError(
                f"reward_std is for bandits, and parameterization {self.parameterization} is none: leave it out."
            )
        agents_at_least(1, self, "agents_per_candidate")
        at_least(1, self, "evaluation_episodes")
        at_least(0, self, "optimal_policy_episodes", "optimal_policy_errors")
        if not self.optimal_policy_episodes:
            because, instead = "the optimal policy has no episodes", "take at least 1"
            unused(self, because, ("optimal_policy_errors",), instead)
        if self.optimal_policy_episodes and self.parameterization != "I":
            raise UserError(
                f"parameterization {self.parameterization} is no bandit, whose optimal policy is read off its reward: "
                "leave optimal_policy_episodes out."
            )
