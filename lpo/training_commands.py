"""What `lpo train`, `evaluate` and `align` do: agents train with given objectives, and their rows are kept."""

import itertools
import json
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro
from rich.table import Table

from lpo import figures
from lpo.alignment import Regime, known_drifts, measure_alignment
from lpo.comparison import Comparison, LearningCurves, compare, ppo_spec
from lpo.fitness import LABELS
from lpo.objectives import REFERENCES, Objective, learned_in, load_apart, load_objective, same_drift
from lpo.suite import SuiteScores, run_suite, suite_specs
from lpo.suite import suite as suite_environments
from scb import plotting
from scb.command_line import Measuring, text
from scb.configurations import config_dict
from scb.console import console
from scb.environments.registry import check_backend, environment_spec
from scb.environments.zoo import digests
from scb.errors import UserError, agents_at_least, at_least
from scb.files import write_json
from scb.lists import read_settings, write_settings
from scb.machine import package_versions
from scb.measurement import Place, check_seeds
from scb.runs import read_config
from scb.statistics import correlation_text, estimate, few_agents


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Agents:
    """Which agents are trained, and how.

    Attributes:
      environment: Pendulum-v1, CartPole-v1, hopper, Synthetic-Pendulum-v1, ..., or one's own as
        package.module:factory; Pendulum-v1 where nothing says another.
      steps: environment steps, rounded up to whole batches; the environment's own setting where left out.
      seed: the first of the agents' seeds.
      backend: Brax physics: generalized, positional, spring or mjx.
    """

    environment: str | None = None
    steps: int | None = None
    seed: int = 0
    backend: str | None = None

    # The field that says how many agents of each objective there are.
    number_field: ClassVar[str] = "seeds"

    def seed_list(self) -> list[int]:
        """Consecutive seeds; a UserError for none or a negative one."""
        agents_at_least(1, self, self.number_field)
        at_least(0, self, "seed")
        seeds = list(range(self.seed, self.seed + getattr(self, self.number_field)))
        check_seeds(seeds)
        return seeds


@dataclass(frozen=True)
class JudgedConfig(Agents):
    """Agents that are judged along their training.

    Attributes:
      seeds: agents of each objective.
      hyperparameters: of PPO, where they are other than the environment's own setting (such as learning_rate=0.0003
        num_envs=8 policy_output_scale=0.01): those of the PPO that an objective is to be used in.
      sampled_actions: evaluate sampled actions rather than the most likely ones.
    """

    seeds: int = 1
    hyperparameters: Annotated[
        Mapping[str, Any], text(read_settings, write_settings, "NAME=A NAME=B", spaced=True)
    ] = field(default_factory=dict)
    sampled_actions: bool = False


@dataclass(frozen=True)
class TrainConfig(JudgedConfig):
    """What `lpo train` does.

    Attributes:
      objective: ppo, ppo-0.3 (clip 0.3), dpo, dpo-4-1.2 (its alpha and beta), none, a zoo name, path.npz, or
        package.module:function of your own.
    """

    objective: str = "ppo"

    @property
    def objectives(self) -> tuple[str, ...]:
        return (self.objective,)


@dataclass(frozen=True)
class EvaluateConfig(JudgedConfig):
    """What `lpo evaluate` does.

    Attributes:
      suite: train in every environment of classic, minatar, brax or all, and aggregate normalised
        scores; a folder given as --out that holds a part of them already is completed.
      objectives: any of ppo, ppo-0.3, dpo, dpo-4-1.2, none, zoo names, files, package.module:function of your
        own; the first is the reference of the differences.
    """

    seeds: int = 10
    seed: int = 1000
    suite: str | None = None
    objectives: tuple[str, ...] = REFERENCES

    def __post_init__(self) -> None:
        if not self.objectives:
            raise UserError("no objectives: give at least one, such as --objectives ppo dpo.")
        if self.suite is not None and self.environment is not None:
            raise UserError(
                f"the environment {self.environment} and the suite {self.suite} are both given: leave one out."
            )


@dataclass(frozen=True, kw_only=True)
class OfObjectives(Measuring):
    """A command that trains with objectives in an environment."""

    def inputs(self) -> dict[str, str]:
        environment = self.config.environment
        told = digests([] if environment is None else [environment])
        for objective in self.loaded():
            told |= objective.digests
        return told

    def loaded(self) -> list[Objective]:
        """The objectives, those of a resumed run by the names under which their agents are kept."""
        resumed = self.output.resume
        kept = {} if resumed is None else read_config(resumed).get("inputs", {})
        return load_apart(self.config.objectives, kept)


@dataclass(frozen=True, kw_only=True)
class Comparing(OfObjectives):
    """A command that compares objectives on one environment."""

    def growing(self) -> Collection[str]:
        # A suite's --out that is there is completed, and grows by nothing but --resume.
        return () if self.output.out else ("seeds", "objectives")

    def compare(self, objectives: Sequence[Objective]) -> Comparison:
        """Trains with the objectives, and leaves rows, comparison.json and curves.png where a folder is named."""
        config: JudgedConfig = self.config
        environment = "Pendulum-v1" if config.environment is None else config.environment
        seeds = config.seed_list()
        spec = ppo_spec(environment, config.steps, config.hyperparameters)
        Place.named(environment, config.backend)  # a mistake must not leave a folder behind
        folder, rows = self.opened()
        comparison = compare(
            environment,
            objectives,
            seeds,
            spec=spec,
            backend=config.backend,
            mode_actions=not config.sampled_actions,
            rows=rows,
            tell=_tell,
        )
        if folder is not None:
            write_json(
                folder / "comparison.json", {**comparison.as_dict(), "versions": package_versions()}
            )
            plotting.save(figures.learning_curves(comparison.curves), folder / "curves.png")
        return comparison


@dataclass(frozen=True, kw_only=True)
class Train(Comparing):
    """Train PPO with an objective in an environment, and print how well it ends."""

    program = "lpo train"
    presets = MappingProxyType({"quick": lambda given: TrainConfig()})

    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def run(self) -> None:
        comparison = self.compare([load_objective(self.config.objective)])
        (curves,) = comparison.curves
        for point, returns in zip(curves.steps, curves.returns.T, strict=True):
            print(f"{point:>9} steps: return {np.mean(returns):.1f}")
        print(f"final return, IQM: {estimate(curves.final)}")
        if comparison.caution:
            print(comparison.caution)


@dataclass(frozen=True, kw_only=True)
class Evaluate(Comparing):
    """Compare objectives: train PPO with each on the same seeds, and print final scores with intervals.

    With --out every agent's returns are kept in rows.jsonl as they come, for --resume and for
    other statistics: pandas.read_json("rows.jsonl", lines=True). A resumed comparison may have more --seeds
    and further --objectives: what is there is kept.
    """

    program = "lpo evaluate"
    presets = MappingProxyType({"quick": lambda given: EvaluateConfig()})

    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(
        default_factory=EvaluateConfig
    )

    @classmethod
    def parse(cls, arguments: Sequence[str]) -> "Evaluate":
        command = super().parse(arguments)
        kept = command.output
        if command.config.suite is None or kept.out is None or kept.resume is not None:
            return command
        # Other flags than the folder's are refused, not replaced by its own.
        resume = kept.out if (kept.out / "config.json").exists() else None
        return replace(command, output=replace(kept, resume=resume))

    def run(self) -> None:
        objectives = self.loaded()
        if self.config.suite is not None:
            self.run_suite(self.config.suite, objectives)
            return
        comparison = self.compare(objectives)
        first, *_ = comparison.curves
        columns = ["objective", "final IQM [95 %]", "area under the curve"]
        table = Table(*columns, f"difference to {first.objective}")
        if first.standing_still is not None:
            table.add_column(f"above standing still ({first.standing_still:g})")
            table.add_column("m/s")
            table.add_column("steps an episode")
        differences = comparison.differences()
        for c in comparison.curves:
            final, area = str(estimate(c.final)), str(estimate(c.area))
            cells = [c.objective, final, area, str(differences.get(c.objective, ""))]
            table.add_row(*cells, *_moving(c))
        console().print(table)
        said = (f"after {first.steps[-1]} steps", comparison.caution, comparison.few)
        for words in filter(None, said):
            console().print(words)

    def run_suite(self, name: str, objectives: Sequence[Objective]) -> None:
        config, seeds = self.config, self.config.seed_list()
        environments = suite_environments(name)
        check_backend(config.backend, environments)
        suite_specs(name, config.steps, config.hyperparameters)
        homes = learned_in(objectives)
        (folder, rows), printer = self.opened(), console()
        scores, comparisons = run_suite(
            name,
            objectives,
            seeds,
            config.backend,
            tell=printer.print,
            rows=rows,
            steps=config.steps,
            hyperparameters=config.hyperparameters,
            mode_actions=not config.sampled_actions,
        )
        title, caption = "final return, IQM [95 %]", f"suite: {name}"
        table = Table("environment", *scores.objectives, title=title, caption=caption)
        for environment, comparison in comparisons.items():
            table.add_row(environment, *(str(estimate(c.final)) for c in comparison.curves))
        printer.print(table)
        printer.print(_scores_table(scores, "over all of them"))
        elsewhere = scores.without(*homes) if {*homes} & {*scores.environments} else None
        if elsewhere is not None:
            where = f"without {', '.join(homes)}, for which one of them was learned"
            printer.print(_scores_table(elsewhere, where))
        if few := next(iter(comparisons.values())).few:
            printer.print(few)
        if scores.left_out:
            printer.print(f"left out, nobody beat random actions: {', '.join(scores.left_out)}")
        if folder is not None:
            for environment, comparison in comparisons.items():
                path = folder / "comparisons" / f"{environment}.json"
                path.parent.mkdir(exist_ok=True)
                write_json(path, comparison.as_dict())
            content = {
                **config_dict(config),
                "seeds": seeds,
                **scores.as_dict(),
                "elsewhere": None if elsewhere is None else elsewhere.as_dict(),
                "versions": package_versions(),
            }
            write_json(folder / "suite.json", content)
            plotting.save(figures.suite_scores(scores, name), folder / "suite.png")


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
            done=json.loads(stored.read_text()) if stored and stored.exists() else None,
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


def _scores_table(scores: SuiteScores, where: str) -> Table:
    first, *_ = scores.objectives
    table = Table(
        "objective", "normalised score, IQM [95 %]", f"difference to {first}", title=where
    )
    found = zip(scores.objectives, scores.aggregate(), scores.differences(), strict=True)
    for objective, score, difference in found:
        table.add_row(objective, str(score), "" if objective == first else str(difference))
    return table


def _moving(curves: LearningCurves) -> tuple[str, ...]:
    """How many agents end above standing still, their mean speed and length of episodes; empty where none is known."""
    standing, speeds, lengths = curves.standing_still, curves.speeds, curves.lengths
    if standing is None or speeds is None or lengths is None:
        return ()
    above = int((curves.final > standing).sum())
    share = f"{above} of {len(curves.final)}"
    length = f"{np.nanmean(lengths[:, -1]):.0f}"
    # Not every environment tells a speed.
    known = np.isfinite(speeds[:, -1]).any()
    return share, f"{np.nanmean(speeds[:, -1]):.2f}" if known else "", length
