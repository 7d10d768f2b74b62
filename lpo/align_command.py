"""What `lpo align` does: which inner loop on a bandit ranks objectives as an environment does."""

import itertools
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import tyro
from rich.table import Table

from lpo import figures
from lpo.alignment import Regime, known_drifts, measure_alignment
from lpo.comparison import ppo_spec
from lpo.fitness import LABELS
from lpo.measuring import Agents, OfObjectives
from lpo.objectives import same_drift
from scb import plotting
from scb.console import console
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.files import read_object, write_json
from scb.measurement import Place
from scb.statistics import correlation_text, few_agents


@dataclass(frozen=True)
class AlignConfig(Agents):
    """What `lpo align` does.

    Attributes:
      bandits: zoo names or files.
      environment: whose outcome counts; the first bandit's own where left out.
      objectives: that join the family of PPO's clips, DPO's and none: zoo names, files.
      reward_noise: in the bandit's standard deviations of reward.
      contexts: of a batch.
      iterations: of the inner loop; the environment's own setting where left out, as the following.
      learning_rates: of the inner agents.
      epochs: passes over a batch.
      minibatches: of a batch.
      policy_output_scale: factor on the policy's last layer at initialisation, in the environment as well.
      agents: of each objective, in the environment and in each regime.
    """

    bandits: tuple[str, ...] = (Regime.bandit,)
    objectives: tuple[str, ...] = ()
    reward_noise: tuple[float, ...] = (0.0, 2.0, 5.0)
    contexts: tuple[int, ...] = (Regime.contexts,)
    iterations: tuple[int, ...] = ()
    learning_rates: tuple[float, ...] = ()
    epochs: tuple[int, ...] = ()
    minibatches: tuple[int, ...] = ()
    policy_output_scale: float | None = None
    agents: int = 16
    seed: int = 500

    number_field = "agents"

    def regimes(self) -> list[Regime]:
        """Every combination of the values given."""
        found = dict.fromkeys(
            Regime(*values, policy_output_scale=self.policy_output_scale)
            for values in itertools.product(
                self.bandits,
                self.reward_noise,
                self.contexts,
                self.iterations or (None,),
                self.epochs or (None,),
                self.minibatches or (None,),
                self.learning_rates or (None,),
            )
        )
        if not found:
            raise UserError("no regimes: give at least one value of each.")
        return list(found)


@dataclass(frozen=True, kw_only=True)
class Align(OfObjectives):
    """Measure which inner loop on a bandit ranks objectives as an environment does.

    Trains agents with a family of known objectives on the environment and in every combination of
    the values given, and prints Spearman's correlation of each fitness with the environment's final
    return. Choose a regime with it before meta-training.
    """

    program = "lpo align"
    presets = MappingProxyType({"quick": lambda given: AlignConfig()})

    config: Annotated[AlignConfig, tyro.conf.arg(name="")] = field(default_factory=AlignConfig)

    def run(self) -> None:
        config: AlignConfig = self.config
        known, more = known_drifts(), self.loaded()
        for objective in more:
            if twins := [x.name for x in known if same_drift(objective, x)]:
                raise UserError(
                    f"{objective.name!r} is in the family already, as {twins[0]!r}: leave it out of --objectives."
                )
        family = [*known, *more]
        regimes, seeds = config.regimes(), config.seed_list()
        target = config.environment or environment_spec(regimes[0].bandit).evaluation_environment
        # A mistake must not leave a folder behind.
        Place.named(target, config.backend)
        ppo_spec(target, config.steps)
        folder, rows = self.opened()
        stored = None if folder is None else folder / "alignment.json"
        printer = console()
        report = measure_alignment(
            regimes,
            family,
            target,
            seeds,
            steps=config.steps,
            backend=config.backend,
            policy_output_scale=config.policy_output_scale,
            tell=printer.print,
            rows=rows,
            done=_measured(stored) if stored and stored.exists() else None,
            keep=partial(write_json, stored) if stored else lambda report: None,
        )
        table = Table("regime", *LABELS, title=f"Spearman's correlation with {target} [95 %]")
        for row in report["regimes"]:
            cells = (row["alignment"][fitness] for fitness in LABELS)
            table.add_row(row["name"], *(correlation_text(cell) for cell in cells))
        printer.print(table)
        if few := few_agents(len(seeds)):
            printer.print(few)
        if folder is not None:
            plotting.save(figures.alignment_heatmap(report), folder / "alignment.png")


def _measured(path: Path) -> dict[str, Any]:
    """What a killed measurement has kept."""
    try:
        return read_object(path, ("outcome", "outcome_iqm", "regimes"))
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} is damaged ({error}): delete it. The environment's agents are kept in rows.jsonl, and the "
            "bandits are measured again."
        ) from error
